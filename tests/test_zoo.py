"""The algorithms in the RL Zoo: registration, search spaces, hyperparameter files, and the stock zoo's way in."""

import argparse
import inspect
import math
import os
import re
import shlex
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
import stable_baselines3
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import StoreDict

from sb3_sample import BRO, DAC, MBMAPPO, SAC, XQC, BROFast, RegularizedSAC, zoo
from sb3_sample.envs import suites
from sb3_sample.ppo import ExtraSamplesPPO
from sb3_sample.sac.bro import BRO_RESETS
from tests.sac.common import sampled
from tests.sac.pixels import TINY, frames
from tests.srspr import common as srspr

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
#: One file of a kind; the others' entries are nearly the same.
SAMPLE = ("bro", "bro_fast", "regularized_sac", "top_sac")
BUILT = [
    pytest.param(name, env_id, marks=() if name in SAMPLE or env_id in ("default", "atari") else pytest.mark.slow)
    for name, env_id in ALL_ENTRIES
]
#: Those of the MBMA paper.
ON_POLICY = sorted(name for name, entry in zoo.ALGORITHMS.items() if issubclass(entry.algorithm, ExtraSamplesPPO))
#: What came after BRO, each with settings of its own.
SUCCESSORS = ("brc", "crossq", "dr_q", "flash_sac", "simba", "simbav2", "xqc")
#: What learns from pictures, in environments that draw them.
PIXELS = ("drq", "drqv2")
#: What learns from data.
OFFLINE = ("bc", "iql", "td3bc")
#: What learns from pictures, and discrete actions.
PICTURES = ("srspr",)
#: Algorithms with the settings that DAC, VPL and the regularization study (2403.00514) share.
FAMILY = sorted(
    name
    for name, entry in zoo.ALGORITHMS.items()
    if not issubclass(entry.algorithm, BRO) and name not in (*ON_POLICY, *SUCCESSORS, *OFFLINE, *PIXELS, *PICTURES)
)


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


def small_buffer(name: str) -> dict[str, Any]:
    """What keeps a model's memory small."""
    width = {"critic_width": 16} if name == "brc" else {}
    return {} if name in ON_POLICY else {"buffer_size": 1000, **width}


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
    assert rl_zoo3.ALGOS["dac"] is DAC
    assert rl_zoo3.ALGOS["sac_sample"] is SAC
    assert rl_zoo3.ALGOS["sac"] is stable_baselines3.SAC
    assert zoo.ALGORITHMS.keys() <= HYPERPARAMS_SAMPLER.keys() & HYPERPARAMS_CONVERTER.keys()


def test_our_file_is_read_unless_another_is_given(tmp_path: Path) -> None:
    assert manager("bro", "Pendulum-v1", tmp_path).config == str(ROOT / "sb3_sample/hyperparams/bro.yml")
    assert manager("bro", "Pendulum-v1", tmp_path, config="other.yml").config == "other.yml"
    zoos_own = str(Path(rl_zoo3.__file__).parent / "hyperparams/sac.yml")
    assert manager("sac", "Pendulum-v1", tmp_path).config == zoos_own


def test_trial_zero_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="trial_id must be at least 1, not 0"):
        manager("bro", "Pendulum-v1", tmp_path, trial_id=0)


@pytest.mark.parametrize(
    ("given", "lacking"),
    [
        ({}, "--storage and --study-name"),
        ({"storage": "sqlite:///a.db"}, "--study-name"),
        ({"study_name": "a"}, "--storage"),
    ],
)
def test_a_trial_without_its_study_is_refused(given: dict[str, Any], lacking: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"trial_id=3 is the number of a trial in a study: give {lacking} too"):
        manager("bro", "Pendulum-v1", tmp_path, trial_id=3, **given)


def test_successes_are_recorded_where_they_are_reported() -> None:
    assert ExperimentManager.is_robotics_env("metaworld/push-v3")
    assert ExperimentManager.is_robotics_env("myosuite/pose-v0")
    assert not ExperimentManager.is_robotics_env("dmc/cheetah-run-v0")


# ---------------------------------------------------------------- search


@pytest.mark.parametrize(
    ("name", "additional_args"),
    [(name, args) for name in zoo.ALGORITHMS for args in (NO_HER, HER) if args is NO_HER or name not in ON_POLICY],
)
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
    trial = optuna.create_study().ask()
    defaults = {key: arguments_of(name)[key] for key in sample(trial, 1, 1, NO_HER)}
    if name == "vpl_sac":
        defaults["validation_proportion"] = 1 / 32  # what its None stands for
    # What stands for the default of a regularization's setting, which is None where the regularization is not chosen.
    in_force = {"weight_decay": 0.01, "sam_radius": 0.05, "resets": 160_000, "redo_period": 1_000}

    def encode(key: str) -> Any:
        if key.startswith("one_minus_"):
            return 1 - defaults[key.removeprefix("one_minus_")]
        if key.endswith("_pow"):
            return round(math.log2(defaults[key.removesuffix("_pow")]))
        if key.startswith("final_share_of_"):
            rate = key.removeprefix("final_share_of_")
            return defaults[f"final_{rate}"] / defaults[rate]
        return in_force[key] if defaults[key] is None else defaults[key]

    stored = {key: encode(key) for key in trial.params}
    # FixedTrial refuses a value outside of its range.
    assert sample(optuna.trial.FixedTrial(stored), 1, 1, NO_HER) == pytest.approx(defaults)


@pytest.mark.parametrize(
    "name", sampled(zoo.ALGORITHMS, ("sac_sample", "bro", "dac", "vpl_sac", "debiased_rq", "mbma_ppo"))
)
def test_what_the_search_samples_builds_a_model(name: str) -> None:
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(3):
        arguments = HYPERPARAMS_SAMPLER[name](study.ask(), 1, 1, dict(NO_HER))
        seen: Any = frames() if name in PIXELS else srspr.Frames() if name in PICTURES else "Pendulum-v1"
        made: Any = ("MlpPolicy" if isinstance(seen, str) else "CnnPolicy", seen)
        pictures = {"policy_kwargs": TINY if name in PIXELS else srspr.TINY} if name in (*PIXELS, *PICTURES) else {}
        model: Any = zoo.ALGORITHMS[name].algorithm(*made, device="cpu", **pictures, **small_buffer(name), **arguments)  # type: ignore[call-arg]
        for argument in arguments.keys() - {"learning_rate"}:
            if name != "regularized_sac" or arguments[argument] is not None:
                value = getattr(model, argument)
                assert (value(1) if argument == "clip_range" else value) == arguments[argument]


def test_regularizations_are_mixed_and_only_the_chosen_have_settings() -> None:
    settings = {"weight_decay": 0.02, "sam_radius": 0.1, "resets": 20_000, "redo_period": 500}
    groups = {
        "critic_regularization": "gpl",
        "network_regularization": "layer_norm+weight_decay",
        "plasticity_regularization": "redo",
    }
    assert zoo.decode_regularized({**groups, **settings}) == {
        "critic_regularization": "gpl",
        "network_regularization": ["layer_norm", "weight_decay"],
        "plasticity_regularization": "redo",
        "weight_decay": 0.02,
        "sam_radius": None,
        "resets": None,
        "redo_period": 500,
    }


def test_every_mixture_of_regularizations_can_be_drawn_and_built() -> None:
    trial = optuna.create_study().ask()
    HYPERPARAMS_SAMPLER["regularized_sac"](trial, 1, 1, dict(NO_HER))
    choices = {
        name: distribution.choices
        for name, distribution in trial.distributions.items()
        if isinstance(distribution, optuna.distributions.CategoricalDistribution)
    }
    assert {name: len(options) for name, options in choices.items()} == {
        "critic_regularization": 4,
        "network_regularization": 2**3,
        "plasticity_regularization": 2**4,
    }
    for name, options in choices.items():
        for option in options:
            arguments = zoo.decode_regularized({**trial.params, name: option})
            RegularizedSAC("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu", **arguments)


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


@pytest.mark.parametrize(("name", "env_id"), BUILT)
def test_an_entry_builds_a_model(name: str, env_id: str, tmp_path: Path) -> None:
    if env_id.startswith("Fetch"):
        pytest.importorskip("gymnasium_robotics")
    elif env_id.endswith("-v5"):
        pytest.importorskip("mujoco")
    elif env_id.startswith("dmc/"):
        pytest.importorskip("dm_control")
    if name in PIXELS and env_id == "default":
        pytest.skip("its pictures are asked for on the command line")
    if env_id == "atari":
        pytest.importorskip("ale_py")
        env_id = "ALE/Pong-v5"
    # Any task without an entry has the default.
    env_id = "MountainCarContinuous-v0" if env_id == "default" else env_id
    experiment = manager(name, env_id, tmp_path, hyperparams=small_buffer(name))
    try:
        result = experiment.setup_experiment()
    except ImportError as error:
        if name not in PIXELS:
            raise
        pytest.skip(f"no pictures can be drawn here: {error}")
    assert result is not None
    model: Any = result[0]
    assert type(model) is zoo.ALGORITHMS[name].algorithm
    assert experiment.n_timesteps > (model.n_steps if name in ON_POLICY else model.learning_starts)
    assert model.env is not None
    model.env.close()


@pytest.mark.parametrize("name", FAMILY)
def test_the_files_of_the_family_differ_in_nothing_but_what_they_say(name: str) -> None:
    ours, shared = entries(name), entries("sac_sample")
    for entry in ours.values():
        if name == "top_sac":
            entry.pop("bandit_learning_rate", None)
    if name == "vpl_sac":
        shared = {env_id: entry for env_id, entry in shared.items() if not env_id.startswith("Fetch")}
    assert ours == shared


@pytest.mark.parametrize("name", ON_POLICY)
def test_the_tasks_of_p1_have_entries_with_its_settings(name: str) -> None:
    ours = entries(name)
    for env_id in suites.MBMA + suites.MBMA_HARD:
        assert ours[env_id]["env_kwargs"] == {"action_repeat": 4}
    steps = {env_id: 4 * ours[env_id]["n_timesteps"] for env_id in suites.MBMA + suites.MBMA_HARD}
    assert {steps[env_id] for env_id in suites.MBMA} == {1e6}
    assert [steps[env_id] for env_id in suites.MBMA_HARD] == [3e6, 3e6, 6e6, 6e6]
    for env_id in suites.MBMA_HARD:
        assert (ours[env_id]["n_steps"], ours[env_id]["batch_size"]) == (4096, 128)
        if name not in ("qma_ppo", "rewound_ppo"):
            assert ours[env_id]["dynamics_buffer_size"] == 2_000_000 and ours[env_id]["dynamics_batch_size"] == 256


@pytest.mark.parametrize("name", ["dr_q", "simba", "simbav2", "xqc"])
def test_the_published_tasks_have_the_published_action_repeat(name: str) -> None:
    ours = {env_id: entry for env_id, entry in entries(name).items() if env_id.startswith("dmc/")}
    assert len(ours) == 28
    default: Any = arguments_of(name)["gamma"]
    assert default == XQC.discount(1_000, 2) and not any("gamma" in entry for entry in ours.values())
    assert all(entry["env_kwargs"] == {"action_repeat": 2} for entry in ours.values())
    assert {2 * entry["n_timesteps"] for entry in ours.values()} == {1e6}


@pytest.mark.parametrize("name", ON_POLICY)
def test_the_commands_in_the_files_of_p1(name: str, tmp_path: Path) -> None:
    pytest.importorskip("dm_control")
    head = (zoo.HYPERPARAMS / f"{name}.yml").read_text().partition("default:")[0]
    parser = argparse.ArgumentParser()
    for option in ("--algo", "--env", "--eval-freq"):
        parser.add_argument(option)
    parser.add_argument("-params", nargs="+", action=StoreDict, default={})
    found = []
    for command in re.findall(r"sb3-sample train (.*)", head):
        given = parser.parse_args(shlex.split(command))
        assert given.algo == name
        result = manager(name, given.env, tmp_path, hyperparams=given.params).setup_experiment()
        assert result is not None
        model: Any = result[0]
        found.append((model._n_extra, model.anneal_until))
    assert found == ([(1, None), (1, None)] if name == "rewound_ppo" else [(8, None), (8, 0.15)])


def test_action_repeat_of_the_file_holds_for_evaluation_too(tmp_path: Path) -> None:
    pytest.importorskip("dm_control")
    small = {"policy_kwargs": {"net_arch": [8]}, "dynamics_kwargs": {"width": 8}}
    experiment = manager("mbma_ppo", "dmc/cartpole-swingup-v0", tmp_path, hyperparams=small)
    result = experiment.setup_experiment()
    assert result is not None
    model: Any = result[0]
    assert isinstance(model, MBMAPPO) and model.predict_termination is False
    for env in (model.env, experiment.create_envs(1, eval_env=True)):
        assert env.get_attr("action_repeat") == [4]
    given = manager(
        "mbma_ppo", "dmc/cartpole-swingup-v0", tmp_path, hyperparams=small, eval_env_kwargs={"action_repeat": 2}
    )
    given.setup_experiment()
    assert given.create_envs(1, eval_env=True).get_attr("action_repeat") == [2]


def test_the_search_space_of_mbpo_keeps_its_horizon_above_its_states() -> None:
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(50):
        arguments = HYPERPARAMS_SAMPLER["mbpo_ppo"](study.ask(), 1, 1, dict(NO_HER))
        assert arguments["simulation_horizon"] > arguments["n_simulated"]


#: The two commands at the head of each file: replay ratio and resets of the model.
REGIMES = {
    **dict.fromkeys(FAMILY, ((2, ()), (16, 160_000))),
    "bro_td3": ((10, BRO_RESETS), (2, (15_000,))),
}


@pytest.mark.parametrize("name", REGIMES)
def test_the_commands_in_the_file_give_the_regimes_of_the_papers(name: str, tmp_path: Path) -> None:
    head = (zoo.HYPERPARAMS / f"{name}.yml").read_text().partition("default:")[0]
    head = re.sub(r"\\\n#", "", head)
    parser = argparse.ArgumentParser()
    for option in ("--algo", "--env"):
        parser.add_argument(option)
    parser.add_argument("-params", nargs="+", action=StoreDict, default={})
    found = []
    for command in re.findall(r"sb3-sample train (.*)", head):
        given = parser.parse_args(shlex.split(command))
        assert (given.algo, given.env) == (name, "dmc/cheetah-run-v0")
        # Pendulum's model is the smaller one; the regime is the same.
        experiment = manager(name, "Pendulum-v1", tmp_path, hyperparams={"buffer_size": 1000, **given.params})
        result = experiment.setup_experiment()
        assert result is not None
        model: Any = result[0]
        found.append((model.replay_ratio, model.resets))
        assert model.plasticity.period == (160_000 if model.resets == 160_000 else None)
    assert tuple(found) == REGIMES[name]


@pytest.mark.parametrize("name", [name for name in FAMILY if name != "sr_sac"])
def test_a_search_keeps_the_replay_ratio(name: str) -> None:
    space = zoo.ALGORITHMS[name].space
    assert "replay_ratio" not in space
    assert "resets" not in space or name == "regularized_sac"  # of which resets are a regularization


@pytest.mark.parametrize(
    ("name", "hyperparams", "words"),
    [
        ("bro", {"gradient_steps": 1}, "gradient_steps=1 replaces replay_ratio, which is searched"),
        ("srspr", {"train_freq": 4}, "train_freq=4 replaces replay_ratio, which is searched"),
        ("sr_sac", {"reset_gradient_steps": 10}, "reset_gradient_steps=10 replaces resets, which is searched"),
    ],
)
def test_a_search_refuses_what_replaces_a_searched_argument(
    name: str, hyperparams: dict[str, Any], words: str, tmp_path: Path
) -> None:
    if name == "srspr":
        pytest.importorskip("ale_py")
    env_id = "ALE/Pong-v5" if name == "srspr" else "Pendulum-v1"
    with pytest.raises(ValueError, match=words):
        manager(name, env_id, tmp_path, hyperparams=hyperparams, optimize_hyperparameters=True).setup_experiment()
    # SAC's search has no replay ratio.
    searched = manager("sac_sample", "Pendulum-v1", tmp_path, hyperparams=hyperparams, optimize_hyperparameters=True)
    assert searched.read_hyperparameters()[0].items() >= hyperparams.items()


def test_vpl_sac_refuses_relabelled_goals(tmp_path: Path) -> None:
    pytest.importorskip("gymnasium_robotics")
    her = {"policy": "MultiInputPolicy", "replay_buffer_class": "HerReplayBuffer", "buffer_size": 1000}
    with pytest.raises(ValueError, match="leave replay_buffer_class out, or pass validation_proportion=0"):
        manager("vpl_sac", "FetchReach-v4", tmp_path, hyperparams=her).setup_experiment()


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


@pytest.mark.slow
@pytest.mark.parametrize("module", ["rl_zoo3.train", "rl_zoo3.record_video"])
def test_the_stock_zoo_knows_the_algorithms_whichever_module_comes_first(module: str) -> None:
    result = in_repository("-m", module, "--help")
    assert result.returncode == 0, result.stderr
    assert "bro_fast" in result.stdout


@pytest.mark.slow
def test_the_stock_zoo_does_not_hide_a_failure() -> None:
    result = in_repository("-c", "import sys; sys.modules['sb3_sample.sac'] = None; import rl_zoo3.import_envs")
    assert result.returncode != 0
    assert "RuntimeError: sb3_sample could not be put into the zoo" in result.stderr
