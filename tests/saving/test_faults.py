"""What a fault during a training leaves in its folder: the last good state, from which the run goes on."""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_sample import SAC, EnvironmentDied, SupervisedSubprocVecEnv, TrainingDiverged
from sb3_sample.faults import check_finite_parameters
from tests.ppo.common import tiny
from tests.sac.common import Toy, differing, sac, state

pytestmark = pytest.mark.filterwarnings("ignore:Evaluation environment is not wrapped")


def make(family: str, env: Any = None) -> Any:
    return sac(env, compile=False) if family == "SAC" else tiny(env=env)


def at(step: int, do: Callable[[Any], Any]) -> BaseCallback:
    class At(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == step:
                do(self.model)
            return True

    return At()


def poison(model: Any) -> None:
    module = model.critic.head if hasattr(model, "critic") else model.policy.value_net
    module.weight.data.view(-1)[0] = np.nan


@pytest.mark.parametrize("family", ["SAC", "PPO"])
def test_a_divergence_leaves_the_last_good_checkpoint(family: str, tmp_path: Path) -> None:
    """At the very step at which one is due, and from there the run goes on as if nothing had been."""
    with pytest.raises(TrainingDiverged, match=r"\(environment step 64\)"):
        make(family).learn(96, at(64, poison), checkpoint=tmp_path, checkpoint_freq=32)
    heard: list[int] = []
    model = make(family).learn(
        96, at(33, lambda m: heard.append(m.num_timesteps)), checkpoint=tmp_path, checkpoint_freq=32
    )
    assert heard == [33]
    check_finite_parameters(model)
    plain = make(family).learn(96, at(33, lambda m: None), checkpoint=tmp_path / "plain", checkpoint_freq=32)
    assert not differing(tensors(model), tensors(plain))


def tensors(model: Any) -> dict[str, torch.Tensor]:
    return {name: value for name, value in state(model).items() if "transitions" not in name}


def test_parameters_alone_keep_a_checkpoint_from_being_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no loss and no action shows it."""
    plain = SAC.train

    def train(self: SAC, gradient_steps: int, batch_size: int) -> None:
        plain(self, gradient_steps, batch_size)
        if self.num_timesteps == 40:
            self.critic_target.head.weight.data.view(-1)[0] = np.inf

    monkeypatch.setattr(SAC, "train", train)
    with pytest.raises(TrainingDiverged, match=r"critic_target\S* is inf at gradient step 30 \(environment step 40\)"):
        sac(compile=False).learn(60, checkpoint=tmp_path, checkpoint_freq=20)
    monkeypatch.undo()
    heard: list[int] = []
    sac(compile=False).learn(60, hears(heard), checkpoint=tmp_path, checkpoint_freq=20)
    assert heard[0] == 21 and heard[-1] == 60


def hears(steps: list[int]) -> BaseCallback:
    class Hears(BaseCallback):
        def _on_step(self) -> bool:
            steps.append(self.num_timesteps)
            return True

    return Hears()


class Breaks(Toy):
    """An environment to evaluate in, whose simulator is gone until a file says otherwise."""

    def __init__(self, mended: Path):
        super().__init__()
        self.mended = mended

    def step(self, action: Any) -> Any:
        if not self.mended.exists():
            raise OSError("the simulator is gone")
        return super().step(action)


@pytest.mark.parametrize("family", ["SAC", "PPO"])
def test_an_evaluation_that_raises_costs_nothing_of_the_training(family: str, tmp_path: Path) -> None:
    """All of the turn is in the checkpoint, and the run that goes on from it is the one with no fault, bit by bit."""
    mended, turn = tmp_path / "mended", 1 if family == "SAC" else 16
    run: dict[str, Any] = {"checkpoint": tmp_path / "run", "checkpoint_freq": 1_000}

    heard: list[int] = []

    def callback() -> CallbackList:
        evaluation = EvalCallback(Monitor(Breaks(mended)), eval_freq=37, n_eval_episodes=1, verbose=0)
        return CallbackList([evaluation, hears(heard)])

    model = make(family)
    with pytest.raises(OSError, match="the simulator is gone"):
        model.learn(64, callback(), **run)
    assert model.num_timesteps == -(-37 // turn) * turn
    mended.touch()
    heard.clear()
    again = make(family).learn(64, callback(), **run)
    assert heard == list(range(model.num_timesteps + 1, 65))
    plain = make(family).learn(64, callback(), checkpoint=tmp_path / "plain", checkpoint_freq=1_000)
    assert plain.num_timesteps == again.num_timesteps == 64
    assert not differing(tensors(again), tensors(plain))


@pytest.mark.parametrize("checkpoint", [True, False])
def test_without_checkpoints_it_is_raised_at_once(checkpoint: bool, tmp_path: Path) -> None:
    def broken(model: Any) -> None:
        raise RuntimeError("broken")

    model = sac(compile=False)
    with pytest.raises(RuntimeError, match="broken"):
        model.learn(60, at(30, broken), checkpoint=tmp_path if checkpoint else None)
    assert model.num_transitions == (30 if checkpoint else 29)


def test_a_callback_that_raises_when_the_training_ends(tmp_path: Path) -> None:
    class Ends(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_training_end(self) -> None:
            raise RuntimeError("the report cannot be written")

    with pytest.raises(RuntimeError, match="the report"):
        sac(compile=False).learn(60, Ends(), checkpoint=tmp_path, checkpoint_freq=1_000)
    model = sac(compile=False)
    with pytest.raises(RuntimeError, match="the report"):
        model.learn(60, Ends(), checkpoint=tmp_path, checkpoint_freq=1_000)
    assert model.num_timesteps == 60 and model._n_updates == 50


def test_an_exception_and_an_end_in_one_step(tmp_path: Path) -> None:
    class Stops(BaseCallback):
        def _on_step(self) -> bool:
            return self.num_timesteps < 30

    def broken(model: Any) -> None:
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        sac(compile=False).learn(60, CallbackList([at(30, broken), Stops()]), checkpoint=tmp_path, checkpoint_freq=20)


@pytest.mark.parametrize(
    ("family", "cls"),
    [
        ("SAC", SubprocVecEnv), ("PPO", SupervisedSubprocVecEnv),
        pytest.param("SAC", SupervisedSubprocVecEnv, marks=pytest.mark.slow),
        pytest.param("PPO", SubprocVecEnv, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_a_dead_worker_leaves_the_last_checkpoint(family: str, cls: Any, tmp_path: Path) -> None:
    def envs() -> Any:
        return cls([lambda: Monitor(Toy()) for _ in range(2)], start_method="fork")

    def kill(model: Any) -> None:
        process = model.get_env().unwrapped.processes[1]
        os.kill(process.pid, signal.SIGKILL)

    run: dict[str, Any] = {"checkpoint": tmp_path / "run", "checkpoint_freq": 32}
    before = signal.getsignal(signal.SIGINT)
    model = make(family, envs())
    with pytest.raises(EnvironmentDied, match="environment 1 died at 'step'.*SIGKILL"):
        model.learn(96, at(50, kill), **run)
    assert signal.getsignal(signal.SIGINT) is before
    model.get_env().close()
    heard: list[int] = []
    again = make(family, envs()).learn(96, at(34, lambda m: heard.append(m.num_timesteps)), **run)
    assert heard == [34] and again.num_timesteps == 96
    plain = make(family, envs()).learn(96, at(34, lambda m: None), checkpoint=tmp_path / "plain", checkpoint_freq=32)
    assert not differing(tensors(again), tensors(plain))
    for each in (again, plain):
        each.get_env().close()


@pytest.mark.parametrize("cls", [SubprocVecEnv, SupervisedSubprocVecEnv])
def test_a_dead_worker_of_an_evaluation_costs_no_checkpoint(cls: Any, tmp_path: Path) -> None:
    evaluated = cls([lambda: Monitor(Toy())], start_method="fork")

    def kill(model: Any) -> None:
        os.kill(evaluated.processes[0].pid, signal.SIGKILL)
        evaluated.processes[0].join()

    evaluation = EvalCallback(evaluated, eval_freq=37, n_eval_episodes=1, verbose=0)
    model = sac(compile=False)
    with (
        pytest.warns(UserWarning, match="does not hold the state of EvalCallback.*eval_env, a worker does not answer"),
        pytest.raises(EnvironmentDied, match="environment 0 died"),
    ):
        model.learn(64, [at(15, kill), evaluation], checkpoint=tmp_path, checkpoint_freq=10)
    # That at which the evaluation raises is the last.
    assert sorted(int(path.name[-12:]) for path in tmp_path.glob("checkpoint-*"))[-2:] == [30, 37]
    evaluated.close()


def test_a_worker_of_an_evaluation_that_dies_between_two_trainings_is_replaced(tmp_path: Path) -> None:
    evaluated = SupervisedSubprocVecEnv([lambda: Monitor(Toy())], start_method="fork", restart_envs=True)
    model = sac(compile=False)
    for n, folder in enumerate(("first", "second")):
        evaluation = EvalCallback(evaluated, eval_freq=15, n_eval_episodes=1, verbose=0)
        model.learn(20, evaluation, checkpoint=tmp_path / folder)
        assert evaluated.n_restarts == n and np.isfinite(evaluation.last_mean_reward)
        os.kill(evaluated.processes[0].pid, signal.SIGKILL)
        evaluated.processes[0].join()
    evaluated.close()


def test_a_worker_that_dies_between_two_turns_costs_no_checkpoint(tmp_path: Path) -> None:
    def envs() -> Any:
        return SupervisedSubprocVecEnv([lambda: Monitor(Toy())] * 2, start_method="fork", restart_envs=True)

    def kill(model: Any) -> None:
        process = model.get_env().unwrapped.processes[1]
        os.kill(process.pid, signal.SIGKILL)
        process.join()

    model = sac(envs(), compile=False)
    with (
        pytest.warns(UserWarning, match="does not hold the episodes in progress: a worker does not answer"),
        pytest.warns(UserWarning, match="It is restarted"),
    ):
        model.learn(40, at(20, kill), checkpoint=tmp_path, checkpoint_freq=20)
    assert model.num_timesteps == 40 and model.get_env().unwrapped.n_restarts == 1
    model.get_env().close()


def test_a_worker_that_dies_just_after_the_run_went_on(tmp_path: Path) -> None:
    """Its episode is cut off with what it had observed before the checkpoint."""

    def envs() -> Any:
        return SupervisedSubprocVecEnv(
            [lambda: Monitor(Toy()) for _ in range(2)], start_method="fork", restart_envs=True
        )

    first = sac(envs(), compile=False).learn(22, checkpoint=tmp_path, checkpoint_freq=22)
    first.get_env().close()

    infos: list[Any] = []

    class Kills(BaseCallback):
        def _on_step(self) -> bool:
            infos.append(self.locals["infos"][1])
            return True

        def _on_rollout_start(self) -> None:
            if self.model.num_timesteps == 22:
                os.kill(self.model.get_env().unwrapped.processes[1].pid, signal.SIGKILL)

    again = sac(envs(), compile=False)
    with pytest.warns(UserWarning, match="It is restarted"):
        again.learn(30, Kills(), checkpoint=tmp_path, checkpoint_freq=22)
    again.get_env().close()
    assert again.num_timesteps == 30
    # Eleven steps of each: the fourth of its second episode was its last.
    np.testing.assert_array_equal(infos[0]["terminal_observation"], [4, 4, 4])
    assert infos[0]["TimeLimit.truncated"] and "SIGKILL" in infos[0]["worker_died"]
    np.testing.assert_array_equal(again._last_obs[:, 0], [1, 3])
