"""Going on from a checkpoint imports nothing that the program has not imported: whoever wrote the checkpoint."""

import hashlib
import json
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from sb3_sample.saving import BadFile, container
from sb3_sample.saving.classes import importing_nothing, resolve
from sb3_sample.saving.decoding import decode
from tests.sac.common import sac
from tests.saving.hostile import Original, with_entries
from tests.saving.test_hostile import watch

#: Names of what is not imported: of a package that is, as a program, with a lazy module, and that files may import.
NAMES = (
    "unittest.__main__:main", "json.tool:main", "package_of_the_program.evil:f", "antigravity:fly", "this:s",
    "sb3_contrib.common.maskable.policies:MaskableActorCriticPolicy", "torch.distributed.run:main",
)  # fmt: skip


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A package that this program has imported, with a module that it has not, and which leaves a trace."""
    folder = tmp_path / "modules" / "package_of_the_program"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("def known():\n    pass\n")
    (folder / "evil.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')\ndef f():\n    pass\n")
    monkeypatch.syspath_prepend(folder.parent)
    yield __import__("package_of_the_program")
    assert not (tmp_path / "imported").exists()
    sys.modules.pop("package_of_the_program", None)


def forget(name: str) -> None:
    for module in [name.partition(":")[0]]:
        sys.modules.pop(module, None)


@pytest.mark.parametrize("name", NAMES)
def test_names_are_of_modules_that_are_there(name: str, program: Any) -> None:
    forget(name)
    trusted = (name.split(".")[0].split(":")[0],)
    with importing_nothing(), watch().watching(), pytest.raises(BadFile, match="imports none"):
        decode({"import": name}, {}, "it", trusted)
    assert name.partition(":")[0] not in sys.modules and not watch().seen
    with importing_nothing():
        assert resolve("package_of_the_program:known", ("package_of_the_program",)) is program.known


def test_objects_are_of_modules_that_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rl_zoo3")
    monkeypatch.delitem(sys.modules, "rl_zoo3.utils", raising=False)
    tree = {"object": "rl_zoo3.utils:SimpleLinearSchedule", "attributes": {"initial_value": 1.0}}
    with importing_nothing(), pytest.raises(BadFile, match="imports none"):
        decode(tree, {}, "it")
    assert "rl_zoo3.utils" not in sys.modules


def test_other_threads_import_meanwhile(program: Any) -> None:
    found: list[Any] = []
    with importing_nothing():
        thread = threading.Thread(target=lambda: found.append(resolve("json.tool:main", ("json",))))
        thread.start()
        thread.join()
    assert found[0].__module__ == "json.tool"


def replace(run: Path, name: str, data: bytes) -> None:
    """Change a file of the newest checkpoint, and what its manifest says of it."""
    folder = max(run.glob("checkpoint-*"))
    (folder / name).write_bytes(data)
    manifest = json.loads((folder / "manifest.json").read_text())
    del manifest["sha256"]
    manifest["files"][name] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    body = json.dumps(manifest, indent=1)
    digest = hashlib.sha256(body.encode()).hexdigest()
    (folder / "manifest.json").write_text(f'{body[:-2]},\n "sha256": "{digest}"\n}}')


@pytest.mark.parametrize("file", ["model.zip", "state.zip"])
@pytest.mark.parametrize("name", NAMES)
def test_going_on_imports_nothing(file: str, name: str, tmp_path: Path, program: Any) -> None:
    run = tmp_path / "run"
    sac().learn(20, checkpoint=run, checkpoint_freq=10)
    path = max(run.glob("checkpoint-*")) / file
    original = Original(file, path.read_bytes())
    content = json.loads(json.dumps(original.content))
    tree = content["tree"]
    place = tree["parameters"]["policy"]["ordered_dict"] if file == "model.zip" else tree["dict"]["logger"]["dict"]
    place["x"] = {"import": name}
    replace(run, file, with_entries(original, data=json.dumps(content).encode()))
    container.read(path, "model" if file == "model.zip" else "checkpoint")
    forget(name)
    with watch().watching(), pytest.raises(ValueError, match="imports none|not trusted"):
        sac().learn(40, checkpoint=run, checkpoint_freq=10)
    assert name.partition(":")[0] not in sys.modules
    assert not {module for module in watch().modules if module.startswith(name.split(".")[0].split(":")[0])}
