"""
Thousands of damaged, truncated and hostile files: each is a clean error, or harmless; none runs code, takes the
interpreter down, or takes more than a moment and some memory.

``python -m tests.saving.test_hostile TARGET SEED FIRST N FOLDER`` throws N files at one loader and prints a line of
JSON for each, before and after: who watches it knows by which it was taken down.
"""

import contextlib
import io
import json
import os
import re
import resource
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.save_util import recursive_getattr

from sb3_sample.errors import ParametersDoNotFit
from sb3_sample.ppo import MBMAPPO
from sb3_sample.sac import SAC
from sb3_sample.sac.bro import BRO
from sb3_sample.saving import BadFile, container, load_vec_normalize, save_vec_normalize
from tests.memory import forget_peak, peak
from tests.ppo.common import tiny
from tests.sac.common import bro, differing, sac, state, vec
from tests.saving import hostile_values
from tests.saving.hostile import FAMILIES, Case, Original, case_of, with_entries
from tests.saving.test_replay import goals

OBSERVATIONS = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
#: Seconds of the processor and bytes that one file may take; measured were at most 0.3 s and 64 MiB, for 3 MB of JSON.
SECONDS, BYTES = 10.0, 128 * 2**20
#: Of address space, in which more is taken than is ever filled: a crash before the machine's memory is gone.
HEADROOM = 16 * 2**30


@cache
def model_of(target: str) -> Any:
    make: dict[str, Callable[[], Any]] = {
        "SAC": sac, "BRO": bro, "MBMAPPO": lambda: tiny(MBMAPPO), "set_parameters": sac, "buffer": sac,
        "her": lambda: _her(),
    }  # fmt: skip
    return make[target]().learn(16)


def _her() -> Any:
    from stable_baselines3.her import HerReplayBuffer

    return sac(
        goals(1), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"copy_info_dict": True}, learning_starts=20,
    )  # fmt: skip


@cache
def original_of(target: str) -> Original:
    file = io.BytesIO()
    if target == "VecNormalize":
        from stable_baselines3.common.vec_env import VecNormalize

        env = VecNormalize(vec())
        env.reset()
        env.step(np.zeros((1, 2)))
        save_vec_normalize(env, file)  # type: ignore[arg-type]
    elif target in ("buffer", "her"):
        model_of(target).save_replay_buffer(file)
    else:
        model_of(target).save(file)
    return Original(target, file.getvalue())


def load(target: str, path: Path) -> Any:
    """What the loader makes of a file, used once, as far as using it is in the loader's hands."""
    if target == "VecNormalize":
        env = load_vec_normalize(path, vec())
        env.reset()
        return env
    if target in ("buffer", "her"):
        model = model_of(target)
        model.load_replay_buffer(path)
        return model.replay_buffer
    if target == "set_parameters":
        model = sac()
        model.set_parameters(path)
        return model
    return {"SAC": SAC, "BRO": BRO, "MBMAPPO": MBMAPPO}[target].load(path, device="cpu")  # type: ignore[attr-defined]


def content(target: str, loaded: Any) -> Any:
    """All of what was loaded, to compare."""
    if target == "VecNormalize":
        rms = loaded.obs_rms
        return {"mean": torch.tensor(rms.mean), "var": torch.tensor(rms.var), "clip": torch.tensor(loaded.clip_obs)}
    if target in ("buffer", "her"):
        arrays = {key: value for key, value in _flat(vars(loaded)) if isinstance(value, (np.ndarray, torch.Tensor))}
        return {key: torch.as_tensor(value).clone() for key, value in arrays.items() if value.dtype != object}
    return state(loaded)


def attributes(target: str, loaded: Any) -> Any:
    """All attributes of a model, by what would be saved again."""
    if target not in ("SAC", "BRO", "MBMAPPO"):
        return None
    file = io.BytesIO()
    loaded.save(file)
    return Original(target, file.getvalue()).content["tree"]["attributes"]


def _flat(values: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{inner}", item) for inner, item in _flat(value))
        else:
            yield str(key), value


@cache
def wanted(target: str, folder: Path) -> Any:
    model_of("SAC")  # whose transitions the others learn from
    path = folder / "good.zip"
    path.write_bytes(original_of(target).data)
    loaded = load(target, path)
    path.unlink()
    return {"content": content(target, loaded), "attributes": attributes(target, loaded)}


# ---------------------------------------------------------------- watching


class Watch:
    """
    Notes what the interpreter is asked to do while it is on: to run another program, to read a pickle, to write, remove
    or rename a file, to open a connection. Python offers no way to remove a hook, so that it can be switched off.
    """

    EVENTS = (
        "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "subprocess.Popen", "pickle.find_class",
        "os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod",
        "os.putenv",
        "shutil.rmtree", "shutil.copyfile", "shutil.unpack_archive", "socket.connect", "socket.bind", "ctypes.dlopen",
        "webbrowser.open", "urllib.Request",
    )  # fmt: skip

    def __init__(self) -> None:
        self.on = False
        self.seen: list[str] = []
        self.modules: set[str] = set()
        sys.addaudithook(self._hear)

    def _hear(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "open" and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            self.seen.append(f"open {args[0]!r} for writing")
        elif event == "import" and args[0] not in sys.modules:
            self.modules.add(args[0])
        elif event in self.EVENTS:
            self.seen.append(f"{event} {args!r:.100}")

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        # What is imported for the first time is not compiled to a file.
        writes, sys.dont_write_bytecode = sys.dont_write_bytecode, True
        self.seen, self.modules, self.on = [], set(), True
        try:
            yield
        finally:
            self.on, sys.dont_write_bytecode = False, writes


@cache
def watch() -> Watch:
    return Watch()


def throw(target: str, case: Case, folder: Path) -> dict[str, Any]:
    """
    :param target: which loader
    :param case: what is thrown at it
    :param folder: the present one, in which nothing else is
    :return: what went wrong, None if nothing, and what it took
    """
    path = folder / "case.zip"
    path.write_bytes(case.data)
    good = wanted(target, folder)
    wrong, loaded, outcome, message = None, None, "loaded", ""
    forget_peak()
    before = peak()
    start = time.process_time()
    with warnings.catch_warnings(), watch().watching():
        warnings.simplefilter("ignore")
        try:
            loaded = load(target, path)
        except (BadFile, ParametersDoNotFit) as error:
            outcome, message = type(error).__name__, str(error)
            if len(str(error)) > 3000:
                wrong = f"a message of {len(str(error))} characters"
        except ValueError as error:
            outcome, message = "ValueError", str(error)
            # Documented of a buffer or statistics of other spaces.
            documented = target in ("buffer", "her", "VecNormalize") and str(error).startswith(str(path))
            wrong = None if documented and len(str(error)) < 3000 else f"ValueError: {error!s:.300}"
        except BaseException as error:  # of any kind: that is what is tested
            outcome = type(error).__name__
            wrong = f"{outcome}: {error!s:.300}"
    taken = {"seconds": time.process_time() - start, "bytes": peak() - before}
    path.unlink()
    seen = watch().seen
    if loaded is not None:
        wrong = wrong or _wrong_with(target, case, loaded, good)
        with warnings.catch_warnings(), watch().watching():
            warnings.simplefilter("ignore")
            outcome = f"loaded, {use(target, loaded)}"
        seen += watch().seen
    if seen:
        wrong = f"{wrong or ''} it did {seen}"
    if left := os.listdir(folder):
        wrong = f"{wrong or ''} it left {left}"
    if taken["seconds"] > SECONDS or taken["bytes"] > BYTES:
        wrong = f"{wrong or ''} it took {taken}, with imports of {sorted(watch().modules)!r:.200}"
    return {"case": case.words, "outcome": outcome, "message": message, "wrong": wrong, **taken}


def _wrong_with(target: str, case: Case, loaded: Any, good: Any) -> str | None:
    found = content(target, loaded)
    if case.damaged:
        same = not differing(found, good["content"]) and attributes(target, loaded) == good["attributes"]
        return None if same else f"it was loaded, with other {differing(found, good['content']) or 'attributes'}"
    if target in ("buffer", "her", "VecNormalize"):
        return None
    # What optimizers keep can be missing, as in a new one.
    named = {f"{name}/{key}" for name in loaded.get_parameters() for key in _learned(loaded, name)}
    if other := [key for key in named if key not in found or key not in good["content"]]:
        return f"it was loaded, as another network: {other}"
    if other := [key for key in named if found[key].shape != good["content"][key].shape]:
        return f"it was loaded, with other shapes of {other}"
    bad = [key for key in named if not found[key].isfinite().all()]
    return f"it was loaded, with {bad} not finite" if bad else None


def _learned(model: Any, name: str) -> list[str]:
    owner = recursive_getattr(model, name)
    return [key for key, _ in owner.named_parameters()] if isinstance(owner, torch.nn.Module) else []


def use(target: str, loaded: Any) -> str:
    """
    Act and learn with a forged model, buffer or optimizer: what a file says can be wrong, as a discount of 7 can, and
    raise sooner or later, but torch's kernels must not be given what they write beside.
    """
    try:
        if target in ("SAC", "BRO", "set_parameters"):
            loaded.predict(OBSERVATIONS)
            loaded.replay_buffer = model_of("SAC").replay_buffer
            loaded.set_logger(Logger(None, []))
            loaded.compiled = False  # a file may ask for it, and then a compiler is run
            loaded.train(1, 4)
        elif target == "MBMAPPO":
            loaded.predict(OBSERVATIONS)
        elif target in ("buffer", "her"):
            loaded.sample(8)
        else:
            loaded.step(np.zeros((1, 2)))
    except Exception as error:
        return f"{type(error).__name__}: {error!s:.200}"
    return "used"


TARGETS = ("SAC", "BRO", "MBMAPPO", "set_parameters", "buffer", "her", "VecNormalize")


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("target", TARGETS)
def test_some_files(target: str, empty: Path) -> None:
    """One of each family, three of the tree."""
    for number in range(len(FAMILIES)):
        result = throw(target, case_of(0, number, original_of(target)), empty)
        assert result["wrong"] is None, result


def test_the_watch_notices(empty: Path) -> None:
    """A test that could not fail would be none."""
    import pickle

    from tests.saving.hostile import MARKER, Payload

    with watch().watching():
        pickle.loads(pickle.dumps(Payload()))
        Path("written").write_text("x")
        os.system("true")
    seen = " ".join(watch().seen)
    assert all(word in seen for word in ("pickle.find_class", "os.mkdir", "for writing", "os.system")), seen
    assert {MARKER, "written"} == set(os.listdir(empty))


def test_a_good_file_is_loaded(empty: Path) -> None:
    """What is thrown is refused for what was done to it."""
    for target in TARGETS:
        result = throw(target, Case("nothing changed", original_of(target).data, True), empty)
        assert result["outcome"] == "loaded, used" and result["wrong"] is None, result


def forged(target: str, change: Callable[[Any], Any]) -> Case:
    """A good file with its tree changed, behind right checksums."""
    original = original_of(target)
    content = json.loads(json.dumps(original.content))
    change(content["tree"])
    return Case("", with_entries(original, data=json.dumps(content).encode()), False)


def _attribute(name: str, value: Any) -> Callable[[Any], Any]:
    return lambda tree: tree["attributes"].update({name: value})


@pytest.mark.parametrize(
    ("target", "change", "words"),
    [
        ("SAC", _attribute("gamma", "x"), "gamma cannot be 'x'"), ("SAC", _attribute("n_steps", []), "n_steps cannot"),
        ("SAC", _attribute("num_timesteps", "x"), "num_timesteps cannot be 'x'"),
        ("SAC", _attribute("_logger", 3), "sets '_logger', which is not in"),
        ("MBMAPPO", _attribute("clip_range", "x"), "clip_range cannot be 'x'"),
        ("SAC", _attribute("policy_delay", {"dict": {}}), "policy_delay cannot be {}"),
        ("SAC", _attribute("exploration_kwargs", {"dict": {"x": 1}}), r"case\.zip: no SAC can be made .* takes none"),
        ("SAC", _attribute("replay_buffer_class", {"import": "stable_baselines3.common.results_plotter:X"}),
         "is of a module that is not there, or not imported"),
        ("SAC", lambda tree: tree["parameters"]["plasticity"]["ordered_dict"]["_extra_state"]["dict"].update(n_done=[]),
         "plasticity._extra_state cannot be"),
        ("SAC", lambda tree: tree["parameters"]["actor.optimizer"]["dict"]["state"]["dict_items"][0][1]["dict"].pop(
            "exp_avg"), "but others of other parameters"),
        ("set_parameters", lambda tree: tree["metadata"]["policy"]["ordered_dict"].update({"": "x"}), "no versions of"),
        ("set_parameters", lambda tree: tree["parameters"]["policy"]["ordered_dict"].popitem(), "Missing key"),
        ("set_parameters", lambda tree: tree["parameters"]["actor.optimizer"]["dict"]["param_groups"][0]["dict"].update(
            params=[[]]), "which parameters are in group 0"),
        ("her", lambda tree: tree["attributes"].pop("handle_timeout_termination"), "has no handle_timeout_termination"),
        ("her", lambda tree: tree["attributes"].update(her_ratio={"whole": "x"}), "her_ratio is a str, not a float"),
        ("VecNormalize", lambda tree: tree["dict"].update(norm_obs_keys=["x"]), "case.zip does not fit to the env"),
        ("VecNormalize", lambda tree: tree["dict"].update(norm_reward=["x" * 999]), "must be True or False"),
    ],
)  # fmt: skip
def test_what_was_found(target: str, change: Any, words: str, empty: Path) -> None:
    """Files that once raised something else, were loaded as something else, or had a plotting library write files."""
    path = empty / "case.zip"
    path.write_bytes(forged(target, change).data)
    with pytest.raises((BadFile, ParametersDoNotFit), match=words) as raised:
        load(target, path)
    assert len(str(raised.value)) < 1100 or target == "set_parameters"


def refused(target: str, data: bytes, words: str, empty: Path) -> None:
    """A file is refused, in these words, within the bounds of all."""
    result = throw(target, Case(words, data, False), empty)
    assert result["wrong"] is None and "loaded" not in result["outcome"], result
    assert re.search(words, result["message"]), result


@pytest.mark.parametrize("row", hostile_values.TREE, ids=lambda row: f"{row[0]}-{row[1][-1]}-{row[2]!r:.30}")
def test_values_that_no_training_writes(row: Any, empty: Path) -> None:
    target, place, value, words = row
    refused(target, hostile_values.with_value(original_of(target), place, value), words, empty)


@pytest.mark.parametrize("row", hostile_values.NUMBERS, ids=lambda row: "-".join(map(str, row[:3])))
def test_numbers_that_no_training_writes(row: Any, empty: Path) -> None:
    target, name, value, words = row
    refused(target, hostile_values.with_number(original_of(target), name, value), words, empty)


@pytest.mark.parametrize("case", hostile_values.GENERATORS, ids=str)
def test_states_of_generators(case: Any, empty: Path) -> None:
    """NumPy takes each of them, and draws from what lies beside its numbers, or crashes."""
    for target, place in (
        ("SAC", ("attributes", "observation_space", "np_random")), ("BRO", ("attributes", "action_space", "np_random")),
        ("MBMAPPO", ("attributes", "seed")), ("her", ("attributes", "observation_space", "whole", "np_random")),
        ("her", ("attributes", "her_ratio", "whole")), ("VecNormalize", ("dict", "norm_obs_keys")),
    ):  # fmt: skip
        refused(target, hostile_values.with_generator(original_of(target), place, case), case[3], empty)


@pytest.mark.slow
@pytest.mark.parametrize("target", ["SAC", "buffer"])
def test_more_than_the_bytes_of_a_file_say(target: str, empty: Path) -> None:
    most = container.MAX_JSON_OF["model"] if target == "SAC" else container.MAX_JSON
    for _, data, words in hostile_values.too_much(original_of(target), most):
        refused(target, data, words, empty)


def test_what_is_as_large_is_loaded(empty: Path) -> None:
    """Where it is no attack: many integers in a set, and counts up to the bounds."""
    for name, value in (("seed_", {"set": list(range(100_000))}), ("replay_ratio", 10_000), ("_updates_owed", 0.75)):
        case = Case(name, hostile_values.with_value(original_of("SAC"), ("attributes", name), value), False)
        path = empty / "case.zip"
        path.write_bytes(case.data)
        loaded = load("SAC", path)
        assert getattr(loaded, name) == (set(value["set"]) if isinstance(value, dict) else value)


def test_large_json_is_read_as_fast_as_small(empty: Path) -> None:
    """Python's collector went through all of it again and again."""
    data = b"[" + b"[]," * 190_000 + b"[]]"
    result = throw("SAC", Case("", with_entries(original_of("SAC"), data=data), False), empty)
    assert result["wrong"] is None and result["seconds"] < 0.7, result


def thrown(module: str, *arguments: str, n: int, **kwargs: Any) -> list[dict[str, Any]]:
    """Run a test's module as a program that throws n cases; the lines it gives of them, none of which is wrong."""
    command = [sys.executable, "-m", module, *arguments]
    root = Path(__file__).parents[2]
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join([str(root), *sys.path])}
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, env=env, **kwargs)
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    results = [line for line in lines if "outcome" in line]
    assert done.returncode == 0, (done.returncode, lines[-1:], done.stderr[-2000:])
    assert len(results) == n
    wrong = [(line["number"], line["case"], line["wrong"]) for line in results if line["wrong"]]
    assert not wrong, f"{len(wrong)} of {n}: {wrong[:20]}"
    return results


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_thousands_of_files(target: str, tmp_path: Path) -> None:
    n, seed = 360, 1
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    results = thrown("tests.saving.test_hostile", target, str(seed), "0", str(n), str(folder), n=n, timeout=1200)
    worst = {key: max(line[key] for line in results) for key in ("seconds", "bytes")}
    counts = Counter(line["outcome"].split(",")[0] for line in results)
    print(f"{target}: {counts}, at most {worst}")
    assert counts["BadFile"] > n / 2


def main(target: str, seed: str, first: str, n: str, folder: str) -> None:
    torch.set_num_threads(1)
    os.chdir(folder)
    original = original_of(target)
    wanted(target, Path(folder))
    size = int(next(line for line in Path("/proc/self/status").read_text().splitlines() if "VmSize" in line).split()[1])
    resource.setrlimit(resource.RLIMIT_AS, (size * 1024 + HEADROOM,) * 2)
    for number in range(int(first), int(first) + int(n)):
        case = case_of(int(seed), number, original)
        print(json.dumps({"number": number, "case": case.words}), flush=True)
        print(json.dumps({"number": number, **throw(target, case, Path(folder))}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
