"""``sb3-sample variance``."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_sample import MBMAPPO, SAC
from sb3_sample.cli import main
from sb3_sample.saving import save_vec_normalize
from sb3_sample.variance import command
from sb3_sample.variance.command import Question, draw, format_choices, format_components, verdict
from sb3_sample.variance.decomposition import Components
from sb3_sample.variance.estimate import Estimate
from tests.ppo.common import tiny

QUICK = ["--n-steps", "6", "--n-rollouts", "4", "--horizon", "2", "--burn-in", "3"]


def run(*arguments: str, env: str = "Pendulum-v1") -> None:
    untrained = [] if {"--model", "--train-steps"} & set(arguments) else ["--train-steps", "0"]
    main(["variance", "--env", env, *QUICK, *untrained, *arguments])


def estimate(margin: float, noise: float = 0.01, m: int = 20) -> Estimate:
    """Of a bandit with equal costs and one action, where the margin is minus half the variance over states."""

    def components(marginal: Any) -> Components:
        zeros = np.zeros((*np.shape(marginal), 3))
        return Components(np.asarray(marginal), zeros, np.ones_like(marginal), zeros)

    values = -2 * margin * 10 + noise * np.random.default_rng(0).normal(size=m)
    return Estimate(components(values.mean()), components((values.sum() - values) / (m - 1)), 1.0, 4)


def test_verdict() -> None:
    question = Question(n_steps=10, n_actions=1, action_cost=1.0)
    assert question.delta == 1.0
    assert verdict(estimate(0.1), question) == "actions"
    assert verdict(estimate(-0.1), question) == "steps"
    assert verdict(estimate(0.0, noise=1.0), question) == "undecided"
    assert verdict(estimate(-0.1), Question(10, 1, action_cost=0.01)) == "actions"  # almost for nothing


def test_tables() -> None:
    result, question = estimate(-0.1), Question(10, 1, 0.5)
    table = format_components(result, question)
    assert "| variance over actions, E_s Var_a | 1 | 1 to 1 | 0.25 | 33 % |" in table
    assert "Delta_T, T = 10 to 15 (delta = 0.5)" in table
    choices = format_choices(result, question).splitlines()
    assert choices[2] == "| 1 | 10 | 0.2998 | 1.00 (1 to 1) |"
    # (2 + 1/2) / (10 / 1.5) against (2 + 1) / 10.
    assert choices[3].startswith("| 2 | 6.667 | 0.3747 | 1.25 (")


def test_picture() -> None:
    figure = draw("title", estimate(-0.1), Question(10, 1, 1.0))
    assert [len(axes.lines) >= 1 for axes in figure.axes] == [True] * 3


def test_a_picture_and_tables_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "new" / "picture.png"
    run("-o", str(picture))
    first = capsys.readouterr().out
    assert picture.stat().st_size > 10_000
    for line in ("**marginalized-policy variance**", "equation 14, left side", "| actions | states at equal cost"):
        assert line in first
    run("-o", str(picture))
    assert capsys.readouterr().out == first
    run("-o", str(picture), "--seed", "1")
    assert capsys.readouterr().out != first


def test_a_dmc_task_with_arguments_and_a_longer_trajectory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["--trajectory", "2048", "--now", "2", "--action-cost", "0.5", "--max-lag", "3", "--no-baseline"]
    run("--env-kwargs", "action_repeat=4", *arguments, env="dmc/cartpole-swingup-v0")
    assert (tmp_path / "dmc-cartpole-swingup-v0-variance.png").exists()
    out = capsys.readouterr().out
    assert "variance V of T = 2048, N = 2" in out
    assert "delta = 0.333" in out


@pytest.mark.parametrize(
    ("normalized", "safe"),
    [(True, True), (False, False), *(pytest.param(a, not a, marks=pytest.mark.slow) for a in (False, True))],
)
def test_a_saved_model(normalized: bool, safe: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    venv: Any = DummyVecEnv([lambda: gym.make("Pendulum-v1")])
    arguments = ["--model", str(tmp_path / "model.zip"), "-o", str(tmp_path / "picture.png")]
    if normalized:
        venv = VecNormalize(venv)
        arguments += ["--vecnormalize", str(tmp_path / "vecnormalize.pkl")]
    cls: Any = MBMAPPO if safe else PPO
    model = cls("MlpPolicy", venv, n_steps=64, device="cpu", policy_kwargs={"net_arch": [8]}).learn(64)
    model.save(tmp_path / "model.zip")
    if normalized and safe:
        save_vec_normalize(venv, tmp_path / "vecnormalize.pkl")
    elif normalized:
        venv.save(tmp_path / "vecnormalize.pkl")
    if not safe:
        with pytest.raises(SystemExit, match="model .*model.zip is pickled, .* pass --allow-pickle"):
            run(*arguments)
        arguments.append("--allow-pickle")
    run(*arguments)
    assert "gradient of 42 parameters" in capsys.readouterr().out
    if normalized:
        del arguments[4:6]
        with pytest.raises(SystemExit, match="model has learned in a VecNormalize, .* with --vecnormalize"):
            run(*arguments)


@pytest.mark.parametrize("cls", [MBMAPPO, PPO])
def test_statistics_of_a_model_that_learned_in_several_environments(
    cls: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    venv = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 4))
    kwargs = {"n_steps": 32, "batch_size": 128, "device": "cpu", "policy_kwargs": {"net_arch": [8]}}
    cls("MlpPolicy", venv, **kwargs).learn(256).save(tmp_path / "model.zip")
    save_vec_normalize(venv, tmp_path / "statistics")
    run("--model", str(tmp_path / "model.zip"), "--vecnormalize", str(tmp_path / "statistics"), "--allow-pickle",
        "-o", str(tmp_path / "picture.png"))  # fmt: skip
    assert "gradient of 42 parameters" in capsys.readouterr().out


def test_what_is_trained_and_what_a_file_is_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = ["-o", str(tmp_path / "picture.png")]
    run("--algo", "a2c", "--train-steps", "10", *picture)
    first = capsys.readouterr().out
    run("--train-steps", "0", *picture)
    assert capsys.readouterr().out != first
    model = ["--model", str(tmp_path / "m.zip")]
    tiny(env=gym.make("Pendulum-v1")).save(model[1])
    with pytest.raises(SystemExit, match="m.zip holds a model of sb3_sample.ppo.mbma:MBMAPPO, but algo is qma_ppo"):
        run(*model, "--algo", "qma_ppo")
    run(*model, "--algo", "mbma_ppo", *picture)
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10).save(model[1])
    with pytest.raises(SystemExit, match="m.zip holds a model of .*SAC, but algo is one of ppo, a2c, mbma_ppo"):
        run(*model)
    with pytest.raises(SystemExit, match="train_steps=5 means nothing with --model: leave it out"):
        run(*model, "--train-steps", "5")


def test_bias_from_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from sb3_sample.variance import command

    samples = command.compare_gradients

    def small(*args: Any, **kwargs: Any) -> Any:
        kwargs |= {"n_fits": 1, "dynamics_kwargs": {"width": 8}, "q_kwargs": {"width": 8}}
        return samples(*args, **kwargs)

    monkeypatch.setattr(command, "compare_gradients", small)
    run("--bias", "4", "--bias-steps", "32", "-o", str(tmp_path / "picture.png"))
    out = capsys.readouterr().out
    assert "| PPO | 0 |" in out
    assert "| MBPO | " in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--n-rollouts", "2"], "n_rollouts must be a whole number of at least 3, not 2"),
        (["--max-lag", "6"], "max_lag must be below n_steps, which is 6, not 6"),
        (["--trajectory", "0"], "trajectory .* not 0"),
        (["--now", "0"], "now .* not 0"),
        (["--action-cost", "0"], "action_cost must be above 0 and finite, not 0.0"),
        (["--action-cost", "nan"], "action_cost .* not nan"),
        (["--confidence", "95"], "confidence must be between 0 and 1, not 95.0"),
        (["--bias", "3"], "bias .* at least 4, not 3"),
        (["--bias", "4", "--bias-steps", "1"], "bias_steps .* at least 2, not 1"),
        (["--bias-steps", "64"], "bias_steps=64 means nothing without --bias: leave it out"),
        (["--seed", "-1"], "seed .* at least 0, not -1"),
        (["-o", "out.xyz"], r"output must end in one of .*\.png, .*, not be out.xyz"),
        (["-o", "out"], r"output must end in one of .*\.png, .*, not be out"),
        (["--env-kwargs", "action_repeat"], "env_kwargs must be of the form NAME=VALUE, not 'action_repeat'"),
        (["--model", "/nowhere.zip"], "model must be a file, not /nowhere.zip"),
        (["--vecnormalize", "x.pkl"], "vecnormalize must come with the model"),
        (["--train-steps", "-1"], "train_steps .* not -1"),
    ],
)
def test_errors_at_the_door(arguments: list[str], message: str) -> None:
    with pytest.raises(SystemExit, match=f"sb3-sample variance: .*{message}"):
        run(*arguments)


def test_a_space_that_no_policy_takes_is_one_line() -> None:
    with pytest.raises(SystemExit, match="sb3-sample variance: .*Tuple.* not supported"):
        run(env="Blackjack-v1")


def test_spaces_that_no_model_is_learned_of_are_refused_before_the_rollouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = ["-o", str(tmp_path / "variance.png")]
    refused = r"the observation space must be a Box of floats .*, not Discrete\(16\)$"
    with monkeypatch.context() as patched:
        patched.delattr(command, "_model")  # and before the training
        with pytest.raises(SystemExit, match=refused):
            run("--bias", "4", *picture, env="FrozenLake-v1")
    run(*picture, env="FrozenLake-v1")
    assert (tmp_path / "variance.png").exists()


def test_environments_that_do_not_fit() -> None:
    with pytest.raises(SystemExit, match="sb3-sample variance: env_id 'Nowhere-v0' is not a registered environment"):
        run(env="Nowhere-v0")
    with pytest.raises(SystemExit, match="sb3-sample variance: .*state can be saved and restored"):
        run(env="tests/Hidden-v0")


class Hidden(gym.Env):
    """Keeps its state where nobody finds it."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self) -> None:
        self.simulator = iter(range(10**6))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.array([next(self.simulator)], np.float32), 0.0, False, False, {}


gym.register("tests/Hidden-v0", entry_point=Hidden, disable_env_checker=True)
