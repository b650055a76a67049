"""What is replaced in the zoo is replaced by one file, and only as long as that file says."""

import ast
import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")

import rl_zoo3.enjoy
import rl_zoo3.exp_manager
import rl_zoo3.train
import yaml
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample.saving.model import SafeFiles
from sb3_sample.saving.replay import SafeReplayBuffers
from sb3_sample.zoo import patches, register
from sb3_sample.zoo.algorithms import BUFFERS
from sb3_sample.zoo.files import PlottedRuns
from tests.test_architecture import circles, imports

ROOT = Path(__file__).parents[1]
ZOO = sorted((ROOT / "sb3_sample/zoo").glob("*.py"))
#: What other files of the zoo's commands may set: the command line, which the zoo reads, the writer of a TensorBoard
#: log that a run goes on with, and the environment of this package's own callback.
OWN = {"sys.argv", "each.writer", "model.num_timesteps", "callback.eval_env"}
#: What ``register`` replaces in ``rl_zoo3``.
FOR_GOOD = {
    "rl_zoo3.exp_manager.VecNormalize", "rl_zoo3.utils.VecNormalize",
    "rl_zoo3.callbacks.SaveVecNormalizeCallback._on_step",
    *(
        f"rl_zoo3.exp_manager.ExperimentManager.{name}"
        for name in (
            "__init__", "_maybe_normalize", "hyperparameters_optimization", "is_robotics_env", "load_trial",
            "read_hyperparameters", "save_trained_model",
        )
    ),
}  # fmt: skip
PROGRAM = """
import sys
import sb3_sample
assert not [name for name in sys.modules if name.startswith(("rl_zoo3", "optuna"))]
import rl_zoo3.exp_manager
from tests.test_zoo_patches import attributes
from sb3_sample.zoo import patches, register

before = attributes()
register()
for name, value in attributes().items():
    if value is not before.get(name):
        function = getattr(value, "__func__", value)
        print(name, getattr(function, "__globals__", {}).get("__name__", type(function).__module__))
"""


def attributes() -> dict[str, Any]:
    """The attributes of the zoo's modules, and of the classes that they define, by their whole names."""
    found = {}
    for module in [module for name, module in sys.modules.items() if name.startswith("rl_zoo3")]:
        for name, value in vars(module).items():
            found[f"{module.__name__}.{name}"] = value
            if isinstance(value, type) and value.__module__ == module.__name__:
                found |= {f"{module.__name__}.{name}.{key}": part for key, part in vars(value).items()}
    return found


def set_elsewhere(file: Path) -> set[str]:
    """What a file sets of objects that are not its own."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("setattr", "delattr"):
            found.add(ast.unparse(node))
        stored = isinstance(getattr(node, "ctx", None), (ast.Store, ast.Del))
        if stored and isinstance(node, ast.Subscript):
            node = node.value
        if stored and isinstance(node, ast.Attribute) and not ast.unparse(node).startswith(("self.", "cls.")):
            found.add(ast.unparse(node))
    return found


def test_one_file_replaces_what_is_the_zoos() -> None:
    found = {file.name: set_elsewhere(file) for file in (*ZOO, ROOT / "sb3_sample/cli.py", ROOT / "custom_envs.py")}
    own = found.pop("patches.py")
    assert {"manager.load_trial", "rl_zoo3.utils.ALGOS", "setattr(owner, name, value)"} <= own
    assert set().union(*found.values()) <= OWN


@pytest.mark.slow
def test_register_replaces_what_it_says_and_nothing_else() -> None:
    result = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    replaced = dict(line.split() for line in result.stdout.splitlines() if line.startswith("rl_zoo3."))
    assert replaced.pop("rl_zoo3.exp_manager.ExperimentManager._adapted_by_sb3_sample") == "builtins"
    # By these names the zoo finds them, classes whose class is of the module abc.
    assert {replaced.pop(f"rl_zoo3.exp_manager.{name}") for name in BUFFERS} == {"abc"}
    assert replaced.keys() == FOR_GOOD
    assert set(replaced.values()) == {"sb3_sample.zoo.patches"}


@contextlib.contextmanager
def everything() -> Iterator[None]:
    """All patches of the commands at once."""
    plots: Any = SimpleNamespace(np=SimpleNamespace(load=None), pickle=None, load_results=None)
    with contextlib.ExitStack() as stack:
        for patch in (
            patches.managed_by(print, rl_zoo3.train),
            patches.monitors_go_on(rl_zoo3.exp_manager),
            patches.reading(allow_pickle=True),
            patches.watched_with(print, print, print, rl_zoo3.enjoy, rl_zoo3.utils),
            patches.models_checked(print),
            patches.reading_settings(),
            patches.reading_monitors(plots),
            patches.reading_tables(plots, PlottedRuns()),
        ):
            stack.enter_context(patch)
        assert plots.load_results is not None and plots.open == PlottedRuns.open
        yield
    assert plots.load_results is plots.pickle is None and not hasattr(plots, "open")


def test_the_patches_of_a_command_end_with_it() -> None:
    register()

    def now() -> dict[str, Any]:
        others = {
            f"{owner.__name__}.{name}": value
            for owner in (yaml, VecNormalize, SafeFiles, SafeReplayBuffers, patches)
            for name, value in vars(owner).items()
        }
        return attributes() | others

    before, during = now(), {}
    with contextlib.suppress(ZeroDivisionError), everything():
        during = now()
        raise ZeroDivisionError
    changed = {name for name, value in during.items() if value is not before[name]}
    assert changed >= {
        "rl_zoo3.train.ExperimentManager", "rl_zoo3.train.StoreDict", "rl_zoo3.exp_manager.make_vec_env",
        "rl_zoo3.enjoy.get_model_path", "rl_zoo3.utils.create_test_env", "yaml.load", "SafeFiles.load",
        "SafeReplayBuffers.load_replay_buffer", "sb3_sample.zoo.patches._allow_pickle",
    }  # fmt: skip
    after = now()
    assert after.keys() == before.keys()
    assert [name for name, value in after.items() if value is not before[name]] == []


def test_the_files_import_each_other_in_one_direction() -> None:
    graph = imports(ROOT / "sb3_sample")
    inside = {name: {other for other in used if other.startswith("sb3_sample.zoo")} for name, used in graph.items()
              if name.startswith("sb3_sample.zoo")}  # fmt: skip
    assert len(inside) == len(ZOO) and "sb3_sample.zoo.runs" in inside["sb3_sample.zoo.train"]
    assert circles(inside) == []
