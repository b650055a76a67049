"""The algorithms in the RL Zoo: registration, search spaces, hyperparameter files, and the stock zoo's way in."""

import argparse
import inspect
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("rl_zoo3")

import optuna
import rl_zoo3
import rl_zoo3.exp_manager
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from sb3_sample import BRO, BROFast, zoo

ROOT = Path(__file__).parent.parent
#: Keys that the zoo takes out of an entry, or turns into constructor arguments, before it builds the model.
ZOO_KEYS = {
    "n_timesteps", "n_envs", "normalize", "env_wrapper", "vec_env_wrapper", "env_kwargs", "monitor_kwargs",
    "frame_stack", "callback", "noise_type", "noise_std",
}  # fmt: skip
NO_HER: dict[str, Any] = {"using_her_replay_buffer": False, "her_kwargs": {}}
HER: dict[str, Any] = {
    "using_her_replay_buffer": True,
    "her_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
}

zoo.register()


def entries(name: str) -> dict[str, dict[str, Any]]:
    return yaml.safe_load((zoo.HYPERPARAMS / f"{name}.yml").read_text())


ALL_ENTRIES = [(name, env_id) for name in zoo.ALGORITHMS for env_id in entries(name)]


def arguments_of(name: str) -> dict[str, Any]:
    """Arguments of an algorithm's constructor and their defaults, with those that it passes on to its bases."""
    arguments: dict[str, Any] = {}
    for cls in reversed(zoo.ALGORITHMS[name].algorithm.__mro__):
        if "__init__" in vars(cls):
            parameters = inspect.signature(vars(cls)["__init__"]).parameters
            if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
                arguments = {}
            named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
            arguments |= {name: p.default for name, p in parameters.items() if p.kind in named}
    return arguments


def manager(name: str, env_id: str, folder: Path, **kwargs: Any) -> ExperimentManager:
    kwargs = {"eval_freq": -1, "device": "cpu", "verbose": 0, **kwargs}
    return ExperimentManager(argparse.Namespace(), name, env_id, str(folder), **kwargs)


# ---------------------------------------------------------------- registration


def test_register_puts_the_algorithms_into_the_zoo_once() -> None:
    init, create_envs = ExperimentManager.__init__, ExperimentManager.create_envs
    zoo.register()
    assert (ExperimentManager.__init__, ExperimentManager.create_envs) == (init, create_envs)
    assert rl_zoo3.ALGOS["bro"] is rl_zoo3.exp_manager.ALGOS["bro"] is BRO
    assert rl_zoo3.ALGOS["bro_fast"] is BROFast
    assert zoo.ALGORITHMS.keys() <= HYPERPARAMS_SAMPLER.keys() & HYPERPARAMS_CONVERTER.keys()


def test_our_file_is_read_unless_another_is_given(tmp_path: Path) -> None:
    assert manager("bro", "Pendulum-v1", tmp_path).config == str(ROOT / "sb3_sample/hyperparams/bro.yml")
    assert manager("bro", "Pendulum-v1", tmp_path, config="other.yml").config == "other.yml"
    zoos_own = str(Path(rl_zoo3.__file__).parent / "hyperparams/sac.yml")
    assert manager("sac", "Pendulum-v1", tmp_path).config == zoos_own


def test_trial_zero_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="trial_id must be at least 1, not 0"):
        manager("bro", "Pendulum-v1", tmp_path, trial_id=0)


def test_successes_are_recorded_where_they_are_reported() -> None:
    assert ExperimentManager.is_robotics_env("metaworld/push-v3")
    assert ExperimentManager.is_robotics_env("myosuite/pose-v0")
    assert not ExperimentManager.is_robotics_env("dmc/cheetah-run-v0")


# ---------------------------------------------------------------- search


@pytest.mark.parametrize("name", zoo.ALGORITHMS)
@pytest.mark.parametrize("additional_args", [NO_HER, HER], ids=["plain", "HER"])
def test_a_stored_trial_gives_the_arguments_it_was_run_with(name: str, additional_args: dict[str, Any]) -> None:
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    accepted = arguments_of(name)
    for _ in range(5):
        trial = study.ask()
        sampled = HYPERPARAMS_SAMPLER[name](trial, 1, 1, dict(additional_args))
        assert HYPERPARAMS_CONVERTER[name](trial.params) == sampled
        assert sampled.keys() <= accepted.keys()
        assert ("replay_buffer_kwargs" in sampled) == additional_args["using_her_replay_buffer"]


@pytest.mark.parametrize("name", zoo.ALGORITHMS)
def test_the_defaults_lie_in_the_search_space(name: str) -> None:
    sample: Any = HYPERPARAMS_SAMPLER[name]
    sampled = sample(optuna.create_study().ask(), 1, 1, NO_HER)
    defaults = {key: arguments_of(name)[key] for key in sampled}
    stored = {key: value for key, value in defaults.items() if key not in ("gamma", "batch_size")}
    stored |= {"one_minus_gamma": 1 - defaults["gamma"], "batch_size_pow": round(math.log2(defaults["batch_size"]))}
    # FixedTrial refuses a value outside of its range.
    assert sample(optuna.trial.FixedTrial(stored), 1, 1, NO_HER) == pytest.approx(defaults)


# ---------------------------------------------------------------- hyperparameter files


def test_every_algorithm_has_a_file_and_every_file_an_algorithm() -> None:
    assert {path.stem for path in zoo.HYPERPARAMS.glob("*.yml")} == zoo.ALGORITHMS.keys()
    assert (ROOT / "hyperparams").resolve() == zoo.HYPERPARAMS.resolve()


@pytest.mark.parametrize(("name", "env_id"), ALL_ENTRIES)
def test_an_entry_has_known_keys_and_repeats_no_default(name: str, env_id: str) -> None:
    entry = entries(name)[env_id]
    arguments = arguments_of(name)
    assert {"n_timesteps", "policy"} <= entry.keys() <= arguments.keys() | ZOO_KEYS
    assert [key for key, value in entry.items() if key in arguments and arguments[key] == value] == []


@pytest.mark.parametrize(("name", "env_id"), ALL_ENTRIES)
def test_an_entry_builds_a_model(name: str, env_id: str, tmp_path: Path) -> None:
    if env_id.startswith("Fetch"):
        pytest.importorskip("gymnasium_robotics")
    elif env_id.endswith("-v5"):
        pytest.importorskip("mujoco")
    # Any task without an entry has the default.
    env_id = "MountainCarContinuous-v0" if env_id == "default" else env_id
    experiment = manager(name, env_id, tmp_path, hyperparams={"buffer_size": 1000})
    result = experiment.setup_experiment()
    assert result is not None
    model, _ = result
    assert type(model) is zoo.ALGORITHMS[name].algorithm
    assert experiment.n_timesteps > model.learning_starts  # type: ignore[attr-defined]
    assert model.env is not None
    model.env.close()


# ---------------------------------------------------------------- the stock zoo


def in_repository(*arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120
    )


def test_the_stock_command_trains_in_the_repository(tmp_path: Path) -> None:
    pytest.importorskip("dm_control")
    result = in_repository(
        "-m", "rl_zoo3.train", "--algo", "bro", "--env", "dmc/pendulum-swingup-v0", "-n", "30", "--eval-freq", "-1",
        "-f", str(tmp_path), "-params", "model_size:'0.55M'", "learning_starts:25", "replay_ratio:1",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert f"Loading hyperparameters from: {ROOT / 'sb3_sample/hyperparams/bro.yml'}" in result.stdout
    assert (tmp_path / "bro/dmc-pendulum-swingup-v0_1/dmc-pendulum-swingup-v0.zip").exists()


@pytest.mark.parametrize("module", ["rl_zoo3.train", "rl_zoo3.record_video"])
def test_the_stock_zoo_knows_the_algorithms_whichever_module_comes_first(module: str) -> None:
    result = in_repository("-m", module, "--help")
    assert result.returncode == 0, result.stderr
    assert "bro_fast" in result.stdout


def test_the_stock_zoo_does_not_hide_a_failure() -> None:
    result = in_repository("-c", "import sys; sys.modules['sb3_sample.sac'] = None; import rl_zoo3.import_envs")
    assert result.returncode != 0
    assert "RuntimeError: sb3_sample could not be put into the zoo" in result.stderr
