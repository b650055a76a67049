"""The files of the zoo's commands run no code; what could is refused, unless it is asked for."""

import builtins
import pickle
import sys
from pathlib import Path
from typing import Any, ClassVar

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch
import yaml
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

pytest.importorskip("rl_zoo3")

import rl_zoo3.exp_manager
import rl_zoo3.utils

from sb3_sample import cli, make_env, zoo
from sb3_sample.saving import container
from sb3_sample.saving.container import BadFile, PickledFile
from sb3_sample.saving.encoding import decode
from sb3_sample.saving.normalization import load_vec_normalize
from sb3_sample.zoo.files import PlottedRuns
from sb3_sample.zoo.settings import check_settings

zoo.register()

SMALL = ["learning_starts:20", "buffer_size:2000", "replay_ratio:0.5", "policy_kwargs:dict(net_arch=[8])"]
TRAIN = [
    "train", "--algo", "sac_sample", "--env", "Pendulum-v1", "--device", "cpu", "--eval-freq", "30",
    "--eval-episodes", "1", "-n", "60", "--verbose", "0", "--save-replay-buffer", "-params", *SMALL, "normalize:True",
]  # fmt: skip
SHOW = ["enjoy", "--algo", "sac_sample", "--env", "Pendulum-v1", "-f", "logs", "--no-render", "-n", "5"]
RUN = Path("logs/sac_sample/Pendulum-v1_1")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Runs the command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    return lambda *arguments: cli.main([str(argument) for argument in arguments])


class Payload:
    """Leaves a trace when it is unpickled."""

    def __reduce__(self) -> Any:
        return Path.touch, (Path("code was run"),)


@pytest.fixture
def no_code(tmp_path: Path):
    """Checks that nothing of a payload was run."""
    yield
    assert not (tmp_path / "code was run").exists()


def test_no_command_needs_a_pickle(run, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("a pickle is read or written")

    with monkeypatch.context() as patch:
        for module in (pickle, cloudpickle):
            for name in ("dump", "dumps", "load", "loads"):
                patch.setattr(module, name, refuse)
        for name in ("load", "save"):
            patch.setattr(torch, name, refuse)
        run(*TRAIN)
        assert {"replay_buffer.pkl", "best_model.zip", "Pendulum-v1.zip"} <= {path.name for path in RUN.iterdir()}
        assert (RUN / "Pendulum-v1/vecnormalize.pkl").exists()
        run(*TRAIN, "-i", RUN / "Pendulum-v1.zip")
        run(*SHOW)
        run(*SHOW, "--load-best")
    assert rl_zoo3.utils.ALGOS["sac_sample"].load(RUN / "Pendulum-v1.zip").num_timesteps == 60


def test_statistics_are_those_of_the_run(run, capsys: pytest.CaptureFixture[str]) -> None:
    run(*TRAIN)
    saved = load_vec_normalize(RUN / "Pendulum-v1/vecnormalize.pkl", DummyVecEnv([lambda: make_env("Pendulum-v1")]))
    # One observation for the reset.
    assert saved.obs_rms.count == pytest.approx(61, abs=0.01) and saved.norm_reward
    capsys.readouterr()
    run(*SHOW)
    assert "Loading running average" in capsys.readouterr().out
    run(*TRAIN, "-i", RUN / "Pendulum-v1.zip", "--eval-freq", "-1")
    second = load_vec_normalize(
        str(RUN / "Pendulum-v1/vecnormalize.pkl").replace("_1/", "_2/"), DummyVecEnv([lambda: make_env("Pendulum-v1")])
    )
    assert second.obs_rms.count == pytest.approx(122, abs=0.01)


def test_statistics_go_on_with_their_model_whatever_the_settings_say(run, capsys: pytest.CaptureFixture[str]) -> None:
    run(*TRAIN)
    later = RUN.with_name("Pendulum-v1_2")
    *plain, _ = TRAIN
    run(*plain, "-i", RUN / "Pendulum-v1.zip", "--eval-freq", "-1")
    env = DummyVecEnv([lambda: make_env("Pendulum-v1")])
    statistics = later / "Pendulum-v1/vecnormalize.pkl"
    assert load_vec_normalize(statistics, env).obs_rms.count == pytest.approx(122, abs=0.01)
    settings = yaml.unsafe_load((later / "Pendulum-v1/config.yml").read_text())
    assert settings["normalize"] is True
    capsys.readouterr()
    run(*SHOW)
    assert "Loading running average" in capsys.readouterr().out
    (later / "Pendulum-v1/config.yml").write_text("normalize: false")
    with pytest.raises(
        SystemExit, match=r"enjoy: the model has learned in a VecNormalize, .* must say normalize: true"
    ):
        run(*SHOW)
    statistics.unlink()
    with pytest.raises(SystemExit, match=r"train: -i .* learned in a VecNormalize, whose statistics must be in logs/"):
        run(*plain, "-i", later / "Pendulum-v1.zip")
    run(*plain, "normalize:True", "-i", later / "Pendulum-v1.zip", "--eval-freq", "-1")


class Drawn(gym.Env):
    """Draws black pictures."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}
    observation_space = gym.spaces.Box(-1, 1, (3,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, render_mode: str | None = None):
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.zeros(3, np.float32), 0.0, False, False, {}

    def render(self) -> np.ndarray:
        return np.zeros((16, 16, 3), np.uint8)


@pytest.mark.parametrize("algo", ["flash_sac", "simbav2"])
def test_agents_whose_rates_decay_are_shown(
    run, algo: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("moviepy")
    spec = gym.envs.registration.EnvSpec("Drawn-v0", entry_point=Drawn, max_episode_steps=20)
    monkeypatch.setitem(gym.registry, "Drawn-v0", spec)
    networks = "{who: dict(width=8, n_blocks=1) for who in ('actor_network_kwargs', 'critic_network_kwargs')}"
    small = ["learning_starts:20", "buffer_size:500", "batch_size:8", "replay_ratio:0.2", f"policy_kwargs:{networks}"]
    run("train", "--algo", algo, "--env", "Drawn-v0", "-n", "30", "--eval-freq", "-1", "--device", "cpu", "-params",
        *small)  # fmt: skip
    shown = ["--algo", algo, "--env", "Drawn-v0", "-f", "logs", "-n", "20"]
    run("enjoy", *shown, "--no-render")
    assert "1 Episodes" in capsys.readouterr().out
    run("record_video", *shown)
    assert list(Path("logs").glob(f"{algo}/Drawn-v0_1/videos/*.mp4"))


class Tinted(Drawn):
    """Keeps the arguments that it is made with."""

    made: ClassVar[list[dict[str, int]]] = []

    def __init__(self, render_mode: str | None = None, **arguments: int):
        super().__init__(render_mode)
        self.made.append(arguments)


def test_a_run_is_shown_with_the_arguments_of_its_environment(run, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("moviepy")
    spec = gym.envs.registration.EnvSpec("Tinted-v0", entry_point=Tinted, max_episode_steps=20)
    monkeypatch.setitem(gym.registry, "Tinted-v0", spec)
    run("train", "--algo", "sac_sample", "--env", "Tinted-v0", "-n", "30", "--eval-freq", "-1", "-params", *SMALL,
        "env_kwargs:dict(hue=3, shade=1)")  # fmt: skip
    shown = ["--algo", "sac_sample", "--env", "Tinted-v0", "-f", "logs", "-n", "5"]
    for command in (["enjoy", *shown, "--no-render"], ["record_video", *shown]):
        for given, shade in (([], 1), (["--env-kwargs", "shade:2"], 2)):
            Tinted.made.clear()
            run(*command, *given)
            assert Tinted.made == [{"hue": 3, "shade": shade}]


def test_arguments_of_the_command_line_are_added_to_those_of_the_entry(run, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = gym.envs.registration.EnvSpec("Tinted-v0", entry_point=Tinted, max_episode_steps=20)
    monkeypatch.setitem(gym.registry, "Tinted-v0", spec)

    def made(*command: Any) -> list[dict[str, int]]:
        Tinted.made.clear()
        run(*command)
        return list(Tinted.made)

    command = ["train", "--algo", "sac_sample", "--env", "Tinted-v0", "--eval-freq", "15", "--eval-episodes", "1",
               "--env-kwargs", "shade:2"]  # fmt: skip
    entry = ["-params", *SMALL, "env_kwargs:dict(hue=3, shade=1)"]
    both = [{"hue": 3, "shade": 2}] * 2
    for n in (30, 40):  # the second time, the run goes on
        assert made(*command, "--run-dir", "a", "--seed", 1, "-n", n, *entry) == both
    assert made("enjoy", "--run-dir", "a", "--no-render", "-n", "5") == both[:1]
    apart = [{"hue": 4, "shade": 1}, {"hue": 3, "shade": 2}]  # that of evaluations is made first
    assert made(*command, "--eval-env-kwargs", "hue:4", "-n", 30, *entry) == apart


class Pictures(Drawn):
    """Has pictures, with their channels last, as observations."""

    observation_space = gym.spaces.Box(0, 255, (36, 36, 3), np.uint8)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.observation_space.sample(), super().reset(seed=seed)[1]

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), *super().step(action)[1:]


class NamedPictures(Pictures):
    """Has pictures by name."""

    observation_space = gym.spaces.Dict({"eye": Pictures.observation_space})  # type: ignore[assignment]


@pytest.mark.parametrize(("env", "policy"), [(Pictures, "MlpPolicy"), (NamedPictures, "MultiInputPolicy")])
def test_models_of_images_whose_channels_are_last_are_shown(
    run, env: type[Drawn], policy: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = gym.envs.registration.EnvSpec("Pictures-v0", entry_point=env, max_episode_steps=5)
    monkeypatch.setitem(gym.registry, "Pictures-v0", spec)
    run("train", "--algo", "sac_sample", "--env", "Pictures-v0", "-n", "25", "--eval-freq", "-1", "-params", *SMALL,
        "batch_size:4", f"policy:'{policy}'")  # fmt: skip
    shown = ["enjoy", "--algo", "sac_sample", "--env", "Pictures-v0", "-f", "logs", "--no-render", "-n", "5"]
    run(*shown)
    assert "1 Episodes" in capsys.readouterr().out
    pictures = gym.spaces.Box(0, 255, (36, 40, 3), np.uint8)
    space = gym.spaces.Dict({"eye": pictures}) if env is NamedPictures else pictures
    monkeypatch.setattr(env, "observation_space", space)
    with pytest.raises(SystemExit, match="the model is of .* the run's environment of "):
        run(*shown)


class Goals(Drawn):
    """Has goals that are never reached."""

    observation_space = gym.spaces.Dict(  # type: ignore[assignment]
        {name: gym.spaces.Box(-1, 1, (3,)) for name in ("observation", "achieved_goal", "desired_goal")}
    )

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        observation, info = super().reset(seed=seed)
        return dict.fromkeys(self.observation_space, observation), info

    def step(self, action: Any) -> Any:
        observation, *rest = super().step(action)
        return (dict.fromkeys(self.observation_space, observation), *rest)

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return np.zeros(len(achieved))


def test_a_model_of_relabelled_goals_goes_on_and_is_shown(
    run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = gym.envs.registration.EnvSpec("Goals-v0", entry_point=Goals, max_episode_steps=10)
    monkeypatch.setitem(gym.registry, "Goals-v0", spec)
    command = ["train", "--algo", "sac_sample", "--env", "Goals-v0", "-n", "40", "--eval-freq", "-1"]
    run(*command, "-params", *SMALL, "policy:'MultiInputPolicy'", "replay_buffer_class:'HerReplayBuffer'")
    # The entry, "default", has neither the policy nor the buffer.
    run(*command, "-i", "logs/sac_sample/Goals-v0_1/Goals-v0.zip")
    run("enjoy", "--algo", "sac_sample", "--env", "Goals-v0", "-f", "logs", "--no-render", "-n", "10")
    output = capsys.readouterr().out
    assert "Loading logs/sac_sample/Goals-v0_2/" in output and "1 Episodes" in output


@pytest.mark.usefixtures("no_code")
@pytest.mark.parametrize("name", ["Pendulum-v1.zip", "Pendulum-v1/vecnormalize.pkl", "replay_buffer.pkl"])
def test_a_pickle_in_the_place_of_a_file_is_refused(run, name: str) -> None:
    run(*TRAIN)
    (RUN / name).write_bytes(pickle.dumps(Payload()))
    with pytest.raises(SystemExit, match=rf"train: .*{name} .*pickle.* Here it is the option --allow-pickle"):
        run(*TRAIN, "-i", RUN / "Pendulum-v1.zip")
    if name != "replay_buffer.pkl":
        with pytest.raises(SystemExit, match=rf"enjoy: .*{name} .*pickle.* Here it is the option --allow-pickle"):
            run(*SHOW, "--exp-id", "1")


def test_pickles_are_read_if_they_are_asked_for(run, capsys: pytest.CaptureFixture[str]) -> None:
    run(*TRAIN)
    model: Any = rl_zoo3.utils.ALGOS["sac_sample"].load(RUN / "Pendulum-v1.zip")
    model.load_replay_buffer(RUN / "replay_buffer.pkl")
    model.save(RUN / "Pendulum-v1.zip", allow_pickle=True)
    model.save_replay_buffer(RUN / "replay_buffer.pkl", allow_pickle=True)
    statistics = RUN / "Pendulum-v1/vecnormalize.pkl"
    load_vec_normalize(statistics, DummyVecEnv([lambda: make_env("Pendulum-v1")])).save(str(statistics))
    for command in (SHOW, [*TRAIN, "-i", RUN / "Pendulum-v1.zip"]):
        with pytest.raises(SystemExit, match="--allow-pickle"):
            run(*command)
        run(*command, "--allow-pickle")
    assert "Loading replay buffer" in capsys.readouterr().out
    # What is written is safe again; and that pickles were allowed is over.
    second = RUN.with_name("Pendulum-v1_2")
    run(*TRAIN, "-i", second / "Pendulum-v1.zip")
    with pytest.raises(PickledFile):
        rl_zoo3.utils.ALGOS["sac_sample"].load(RUN / "Pendulum-v1.zip")


def test_the_files_of_the_zoos_own_algorithms_are_as_ever(run) -> None:
    run("train", "--algo", "ppo", "--env", "Pendulum-v1", "-n", "64", "--device", "cpu", "--eval-freq", "-1", "-params",
        "n_steps:32", "batch_size:32", "normalize:True", "n_envs:1")  # fmt: skip
    with open("logs/ppo/Pendulum-v1_1/Pendulum-v1/vecnormalize.pkl", "rb") as file:
        assert type(pickle.load(file)) is VecNormalize
    run("enjoy", "--algo", "ppo", *SHOW[3:])


def test_what_cannot_be_saved_is_said_before_the_training_and_does_not_stop_it(run) -> None:
    command = [*TRAIN[:-1], "policy_kwargs:dict(net_arch=[8], activation_fn=lambda: th.nn.ReLU())"]
    with pytest.warns(UserWarning, match="policy_kwargs is left out .*the function.*load needs policy_kwargs="):
        run(*command)
    with pytest.raises(SystemExit, match="sb3-sample enjoy: .*args.yml: .*lambda.*--allow-pickle"):
        run(*SHOW)
    policy_kwargs = {"net_arch": [8], "activation_fn": torch.nn.ReLU}
    rl_zoo3.utils.ALGOS["sac_sample"].load(RUN / "Pendulum-v1.zip", policy_kwargs=policy_kwargs)


def test_classes_of_trusted_modules(run, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("my_networks.py").write_text("from torch import nn\nclass Sine(nn.Tanh):\n    pass\n")
    monkeypatch.syspath_prepend(Path.cwd())
    monkeypatch.setattr(builtins, "my_networks", __import__("my_networks"), raising=False)
    command = [*TRAIN, "policy_kwargs:dict(net_arch=[8], activation_fn=my_networks.Sine)"]
    with pytest.warns(UserWarning, match="my_networks:Sine, for which load needs trusted_modules="):
        run(*command)
    trust = ["--trusted-modules", "my_networks"]
    run(*command, *trust)
    run(*SHOW, "--exp-id", "2", *trust)
    with pytest.raises(SystemExit, match="my_networks"):
        run(*SHOW, "--exp-id", "2")
    # With checkpoints as well, and when the run goes on.
    for n in ("60", "90"):
        run("train", "--run-dir", "a", "--seed", "1", *trust, *command[1:11], "-n", n, *command[13:])
    assert Path("a/checkpoint-000000000090").is_dir()


# ---------------------------------------------------------------- settings


@pytest.mark.usefixtures("no_code")
@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("args.yml", "a: !!python/object/apply:os.system ['touch \"code was run\"']", "it makes an object.*os.system"),
        ("args.yml", "? !!python/object/new:os.system [x]\n: 1", "it makes an object"),
        ("args.yml", "a: [{b: !!python/object:argparse.Namespace {}}]", "it makes an object"),
        ("args.yml", "a: !!python/module:antigravity", "it makes an object"),
        ("args.yml", "a: !!python/name:os.system", "os:system' is of a module that is not trusted"),
        ("config.yml", "a: !!python/name:torch.nn.modules.module.warnings", "is no class or function"),
        ("config.yml", "normalize: __import__('os').system('touch code')", "normalize is Python"),
        ("config.yml", "normalize: dict(a=print(1))", "normalize is Python"),
        ("config.yml", "normalize: dict(**vars())", "normalize is Python"),
        ("config.yml", "env_wrapper: os.system", "env_wrapper is 'os.system'"),
        ("config.yml", "vec_env_wrapper: [gymnasium.make]", "vec_env_wrapper is 'gymnasium.make'"),
        ("config.yml", "env_wrapper: [{my.Wrapper: {a: 1}}]", "env_wrapper is"),
        ("config.yml", "- 1", "does not hold settings"),
        ("config.yml", "a: [", "is no YAML file"),
        ("config.yml", "a: " + "[" * 5000, "is no YAML file"),
    ],
)
def test_settings_that_could_run_code_are_refused(
    name: str, text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(BadFile, match=message):
        check_settings(tmp_path)


def test_settings_as_the_zoo_writes_them_are_read(run) -> None:
    run(
        *TRAIN[:-1], "normalize:'dict(norm_obs=True, norm_reward=False)'",
        "policy_kwargs:dict(activation_fn=th.nn.ReLU)",
        "env_wrapper:[{'gymnasium.wrappers.ClipReward': dict(min_reward=-5.0)}]",
        "vec_env_wrapper:'stable_baselines3.common.vec_env.VecMonitor'", "resets:(40,)", "--env-kwargs", "g:3.0",
    )  # fmt: skip
    text = (RUN / "Pendulum-v1/config.yml").read_text()
    assert "python/name:torch.nn.modules.activation.ReLU" in text and "python/tuple" in text
    run(*SHOW)


@pytest.mark.usefixtures("no_code")
def test_enjoy_looks_at_the_settings_first(run) -> None:
    run(*TRAIN)
    code = "!!python/object/apply:os.mkdir ['code was run']"
    (RUN / "Pendulum-v1/args.yml").write_text(f"env_kwargs: {code}")
    with pytest.raises(SystemExit, match=r"enjoy: .*args\.yml: it makes an object.*--allow-pickle"):
        run(*SHOW)
    yaml.load(f"a: {code}", Loader=yaml.UnsafeLoader)
    assert Path("code was run").exists()  # as it would have been
    Path("code was run").rmdir()


# ---------------------------------------------------------------- runs in folders of their own


def test_a_run_is_shown_by_its_folder(run, capsys: pytest.CaptureFixture[str]) -> None:
    run(*TRAIN, "--run-dir", "runs/a", "--checkpoint-freq", "50")
    show = ["enjoy", "--run-dir", "runs/a", "--no-render", "-n", "5"]
    for which, file in (
        ([], "runs/a/Pendulum-v1.zip"),
        (["--load-best"], "runs/a/best_model.zip"),
        (["--load-last-checkpoint"], "runs/a/checkpoint-000000000060/model.zip"),
    ):
        capsys.readouterr()
        run(*show, *which)
        assert f"Loading {file}" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"logs is no folder of a run of sb3-sample train: it has no run\.json"):
        run("enjoy", "--run-dir", "logs", "--no-render")


def test_the_checkpoint_of_that_many_steps_is_shown(run, capsys: pytest.CaptureFixture[str]) -> None:
    run(*TRAIN, "--run-dir", "a", "--checkpoint-freq", "20", "--save-freq", "20", "--verbose", "0")
    assert {path.name for path in Path("a").glob("rl_*")} == {f"rl_model_{n}_steps.zip" for n in (20, 40, 60)}
    Path("a/rl_model_40_steps.zip").unlink()
    capsys.readouterr()
    for steps, file in ((40, "checkpoint-000000000040/model.zip"), (60, "rl_model_60_steps.zip")):
        run("enjoy", "--run-dir", "a", "--no-render", "-n", "5", "--load-checkpoint", steps)
        assert f"Loading a/{file}" in capsys.readouterr().out
    with pytest.raises(
        SystemExit, match="a has no such model of sac_sample on Pendulum-v1. Its checkpoints: checkpoint"
    ):
        run("enjoy", "--run-dir", "a", "--no-render", "--load-checkpoint", "50")


def test_a_checkpoint_is_shown_with_its_own_statistics(run, monkeypatch: pytest.MonkeyPatch) -> None:
    run(*TRAIN, "--eval-freq", "-1", "--run-dir", "a", "--checkpoint-freq", "20")
    # As it is before the end.
    Path("a/Pendulum-v1.zip").unlink()
    (Path("a") / "Pendulum-v1/vecnormalize.pkl").unlink()
    seen = []
    predict = rl_zoo3.utils.ALGOS["sac_sample"].predict

    def spy(self: Any, *args: Any, **kwargs: Any) -> Any:
        seen.append(args[0])
        return predict(self, *args, **kwargs)

    monkeypatch.setattr(rl_zoo3.utils.ALGOS["sac_sample"], "predict", spy)
    run("enjoy", "--run-dir", "a", "--no-render", "-n", "3", "--seed", "1")
    env = DummyVecEnv([lambda: make_env("Pendulum-v1")])
    env.seed(1)
    raw = env.reset()
    state: Any = decode(*container.read("a/checkpoint-000000000060/state.zip", "checkpoint"), "state")
    attributes = state["env"]["wrappers"][0]["attributes"]["obs_rms"]["attributes"]
    mean, var = (attributes[name]["value"] for name in ("mean", "var"))
    assert attributes["count"]["value"] == pytest.approx(61, abs=0.01)
    np.testing.assert_allclose(seen[0], (raw - mean) / np.sqrt(var + 1e-8), rtol=1e-5)
    state = Path("a/checkpoint-000000000060/state.zip")
    container.write(state, "checkpoint", {"env": {"dict": {}}}, {})
    with pytest.raises(SystemExit, match=r"enjoy: .*state\.zip"):
        run("enjoy", "--run-dir", "a", "--no-render", "-n", "3")


def test_help_of_enjoy_has_both_kinds_of_options(run, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run("enjoy", "--help")
    output = capsys.readouterr().out
    assert all(option in output for option in ("--run-dir DIR", "--allow-pickle", "--load-best"))


# ---------------------------------------------------------------- plots


@pytest.mark.usefixtures("no_code")
def test_tables_of_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    runs = {"Pendulum-v1": {"bro-logs": {"timesteps": np.arange(3), "mean": np.ones((3, 2)), "last_evals": [1.0, 2.0]}}}
    with open("all.pkl", "wb") as file:
        PlottedRuns().dump(runs, file)
    with open("all.pkl", "rb") as file:
        read = PlottedRuns().load(file)
    np.testing.assert_equal(read, runs)
    Path("evil.pkl").write_bytes(pickle.dumps(Payload()))
    with open("evil.pkl", "rb") as file, pytest.raises(PickledFile):
        PlottedRuns().load(file)
    Path("old.pkl").write_bytes(pickle.dumps(runs))
    with open("old.pkl", "rb") as file:
        np.testing.assert_equal(PlottedRuns(allow_pickle=True).load(file), runs)
