"""Trainings that diverge, and callbacks that raise: the fault is put in, and the run has to notice."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback

from sb3_sample import SAC, TrainingDiverged
from sb3_sample.faults import HoldBack, MetricWatch, check_finite_parameters
from sb3_sample.sac import algorithm
from tests.agents import LOSS, OFF_POLICY, value_network
from tests.ppo.common import ALGORITHMS, TINY, tiny
from tests.sac.common import COMPILES, MAKERS, PIXEL_MAKERS, Toy, random_batch, sac, sampled, vec
from tests.sac.test_execution import captured

NAN, INF = float("nan"), float("inf")


class At(BaseCallback):
    """Does something to the model at an environment step."""

    def __init__(self, step: int, do: Callable[[Any], Any]):
        super().__init__()
        self.step, self.do = step, do

    def _on_step(self) -> bool:
        if self.num_timesteps == self.step:
            with torch.no_grad():
                self.do(self.model)
        return True


def poison_critic(model: Any, value: float = NAN) -> None:
    next(value_network(model).parameters()).view(-1)[0] = value


def poison_value(model: Any) -> None:
    """Not in what acts, so that the update is what fails."""
    model.policy.value_net.weight.view(-1)[0] = NAN


# ---------------------------------------------------------------- off-policy


@pytest.mark.parametrize("maker", sampled(OFF_POLICY))
def test_a_nan_in_a_parameter_stops_the_run_and_is_named(maker: str) -> None:
    model = OFF_POLICY[maker](compile=False)
    with pytest.raises(TrainingDiverged, match=f"{LOSS[maker]} is nan") as caught:
        model.learn(60, callback=At(30, poison_critic))
    # A transition a step, one gradient step a transition after the first ten, or the parts' own beginning.
    assert model.num_timesteps == caught.value.environment_step == 30
    assert f"at gradient step {model._n_updates} (environment step 30)" in str(caught.value)
    assert np.isnan(caught.value.values[LOSS[maker]])


@pytest.mark.parametrize("value", [INF, -INF])
def test_an_infinity_too(value: float) -> None:
    with pytest.raises(TrainingDiverged, match=r"at gradient step 20 \(environment step 30\)"):
        sac(compile=False).learn(60, callback=At(30, lambda model: poison_critic(model, value)))


def test_rewards_out_of_all_proportion_diverge() -> None:
    """By nothing but the environment: finite rewards whose square is infinite."""
    env = vec(poison=lambda total, observation, reward: (observation, 1e30 if total >= 20 else reward))
    with pytest.raises(TrainingDiverged, match="train/critic_loss is inf"):
        sac(env, compile=False).learn(300)


def test_the_first_of_several_gradient_steps_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    model = sac(replay_ratio=5, compile=False)
    plain = SAC._update

    def update(self: SAC, batch: Any, noise: Any = None) -> dict[str, torch.Tensor]:
        if self._n_updates == 17:
            with torch.no_grad():
                poison_critic(self)
        return plain(self, batch, noise)

    monkeypatch.setattr(SAC, "_update", update)
    with pytest.raises(TrainingDiverged, match=r"at gradient step 18 \(environment step 14\)"):
        model.learn(60)
    assert model._n_updates == 20


@pytest.mark.parametrize("compile", [False, pytest.param(True, marks=[COMPILES, pytest.mark.slow])])
def test_it_changes_nothing(compile: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.sac.common import differing, state

    watched = sac(compile=compile).learn(60)
    monkeypatch.setattr(algorithm, "MetricWatch", lambda device: _Blind())
    assert not differing(state(watched), state(sac(compile=compile).learn(60)))


class _Blind:
    def note(self, *args: Any) -> None:
        pass

    def check(self) -> None:
        pass


def test_captured_steps_are_watched() -> None:
    """The metrics of a captured step lie where the next one's will."""
    model = sac(compile=False, learning_starts=60, replay_ratio=4).learn(60)
    recorder = captured(model)
    model.train(5, 8)
    poison_at = model._n_updates + 3
    seen: list[int] = []

    plain = model._watch.note

    def note(metrics: Any, gradient_step: int, environment_step: int) -> None:
        plain(metrics, gradient_step, environment_step)
        seen.append(gradient_step)
        if gradient_step == poison_at - 1:
            with torch.no_grad():
                poison_critic(model)

    model._watch.note = note
    with pytest.raises(TrainingDiverged, match=f"train/critic_loss is nan.* at gradient step {poison_at} "):
        model.train(8, 8)
    assert len(seen) == 8 and recorder.n_repetitions > 5


@COMPILES
@pytest.mark.slow
def test_compiled_steps_are_watched() -> None:
    with pytest.raises(TrainingDiverged, match=r"train/critic_loss is nan.* at gradient step 20 "):
        sac(compile=True).learn(60, callback=At(30, poison_critic))


def without_looking(model: Any) -> Any:
    """The model, whose ``train`` does not look, as on a GPU, where that would make the host wait."""
    watch, plain = model._watch, model.train

    def train(*args: Any) -> None:
        watch.check = lambda: None
        plain(*args)
        del watch.check

    model.train = train
    return model


def test_on_a_gpu_it_is_noticed_by_the_next_action_or_the_log() -> None:
    model = without_looking(sac(compile=False))
    with pytest.raises(TrainingDiverged, match=r"critic_loss is nan.* at gradient step 16 \(environment step 26\)"):
        model.learn(60, callback=At(26, poison_critic))
    assert model.num_timesteps == 26 and model._n_updates == 16
    # With what acts untouched, by the log, after the fourth episode of seven steps.
    model = without_looking(sac(compile=False, policy_delay=1_000))
    with pytest.raises(TrainingDiverged, match=r"critic_loss is nan.* at gradient step 11 \(environment step 21\)"):
        model.learn(60, callback=At(21, poison_critic))
    assert model.num_timesteps == 28


def test_what_is_kept_is_bounded_and_looked_at_in_time() -> None:
    watch, one = MetricWatch(torch.device("cpu")), torch.tensor(1.0)
    for step in range(1, 2_501):
        watch.note({"train/a": one}, step, step)
    # Some steps have more metrics than others.
    watch.note({"train/a": one, "train/b": torch.tensor(INF)}, 2_501, 7)
    for step in range(2_502, 2_502 + watch.WINDOW - 2):
        watch.note({"train/a": one}, step, 8)
    with pytest.raises(TrainingDiverged, match=r"train/b is inf at gradient step 2501 \(environment step 7\)"):
        watch.note({"train/a": one}, 3_500, 8)
    # What was found is not found again.
    watch.check()
    watch.note({"train/a": torch.tensor(1.0)}, 1, 1)
    watch.check()


def test_an_actor_that_is_nan_does_not_act() -> None:
    model = sac(compile=False)
    model.learn(30)
    actions = model.env.envs[0].unwrapped.actions
    next(model.actor.parameters()).data.fill_(NAN)
    with pytest.raises(TrainingDiverged, match=r"policy\.actor.* is nan at gradient step 20"):
        model.learn(1, reset_num_timesteps=False)
    assert np.isfinite(actions).all()


def test_parameters_are_looked_at_at_the_end() -> None:
    """After the last gradient step, with no metric and no action to show it."""
    model = sac(compile=False)
    plain = model.train

    def train(*args: Any) -> None:
        plain(*args)
        if model.num_timesteps == 60:
            model.critic_target.head.weight.data.fill_(NAN)

    model.train = train
    with pytest.raises(TrainingDiverged, match=r"critic_target\S* is nan at gradient step 50 \(environment step 60"):
        model.learn(60)


def test_check_finite_parameters_by_itself() -> None:
    for model in (sac(compile=False).learn(30), tiny().learn(32), PPO("MlpPolicy", vec(), n_steps=16, batch_size=8)):
        check_finite_parameters(model)
    model = sac(compile=False).learn(30)
    moments = next(iter(model.critic.optimizer.state.values()))
    name = next(
        name for name, value in moments.items() if isinstance(value, torch.Tensor) and value.is_floating_point()
    )
    moments[name].view(-1)[0] = INF
    with pytest.raises(TrainingDiverged, match=r"critic\.optimizer \(\w+ of its parameter 0\) is inf at gradient"):
        check_finite_parameters(model)
    # Large numbers are not infinite, whatever their squares are.
    model = sac(compile=False)
    model.critic.head.weight.data.fill_(1e30)
    check_finite_parameters(model)


def test_the_error_survives_pickling_and_is_a_value_error() -> None:
    error = pickle.loads(pickle.dumps(TrainingDiverged({f"m{i}": NAN for i in range(5)}, "gradient step 3", 4)))
    assert isinstance(error, ValueError) and isinstance(error, FloatingPointError)
    assert str(error).startswith("m0 is nan, m1 is nan, m2 is nan and 2 more are not finite at gradient step 3 (env")


# ---------------------------------------------------------------- on-policy


def ppo(cls: Any = ALGORITHMS[0], simulates: bool = True) -> Any:
    """A tiny model, or plain PPO by its name."""
    return tiny(cls) if simulates else cls("MlpPolicy", vec(), **{**TINY, "n_simulated": 0, "warm_up_until": None})


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("simulates", [False, True])
def test_ppo_stops(cls: Any, simulates: bool) -> None:
    model = ppo(cls, simulates)
    with pytest.raises(TrainingDiverged, match=r"(is nan|are not finite) at .*\(environment step 32\)"):
        model.learn(64, callback=At(32, poison_value))
    assert model.num_timesteps == 32


@pytest.mark.parametrize("simulates", [False, True])
def test_ppo_with_a_nan_in_what_acts(simulates: bool) -> None:
    """Where torch's distributions check their arguments, they raise an error of their own; else the losses are NaN."""
    words = r"(policy\.action_net\.weight is nan|train/policy_gradient_loss is nan).* at .*\(environment step 32\)"
    with pytest.raises(TrainingDiverged, match=words):
        ppo(simulates=simulates).learn(64, callback=At(32, lambda m: m.policy.action_net.weight.fill_(NAN)))


def test_ppo_names_the_minibatch() -> None:
    model = tiny()
    calls = 0
    plain = model._losses

    def losses(*args: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 7:  # Four minibatches an iteration.
            model.policy.value_net.weight.data.fill_(NAN)
        return plain(*args)

    model._losses = losses
    with pytest.raises(TrainingDiverged, match=r"train/value_loss is nan.* at minibatch 3 of the iteration \(environ"):
        model.learn(64)


def test_ppo_dynamics_that_diverge_are_named() -> None:
    model = tiny()
    with pytest.raises(TrainingDiverged, match=r"dynamics\S+ is nan"):
        model.learn(64, callback=At(20, lambda m: next(m.dynamics.parameters()).fill_(NAN)))


# ---------------------------------------------------------------- callbacks that raise


class Broken(BaseCallback):
    """Raises at some of its calls, and counts them."""

    def __init__(self, *at: int):
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        if self.n_calls in self.at:
            raise RuntimeError(f"broken at {self.n_calls}")
        return True


class Counter(BaseCallback):
    def _on_step(self) -> bool:
        return True


def held(model: Any, callback: BaseCallback, steps: int = 60) -> HoldBack:
    hold = HoldBack(callback)
    model.learn(steps, callback=hold)
    return hold


def test_what_a_callback_raises_is_kept_until_the_turn_is_over() -> None:
    """Everything of the turn happens, and the other callbacks hear of every step."""
    plain, model = sac(compile=False).learn(60), sac(compile=False)
    broken, before, after = Broken(25, 26), Counter(), Counter()
    hold = held(model, CallbackList([before, broken, CallbackList([after])]))
    assert hold.has_raised()
    assert model.replay_buffer.pos == plain.replay_buffer.pos == 60 and model._n_updates == plain._n_updates
    assert before.n_calls == broken.n_calls == after.n_calls == after.num_timesteps == 60
    with pytest.raises(RuntimeError, match="broken at 25"):
        hold.raise_kept()
    hold.raise_kept()
    assert not hold.has_raised()


@pytest.mark.parametrize("answer", [False, np.False_, 0, None])
def test_any_false_value_ends_a_training(answer: Any, tmp_path: Path) -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return True if self.n_calls < 3 else answer

    for name, callback in (("one", Stop()), ("list", CallbackList([Counter(), Stop()]))):
        assert sac(compile=False).learn(10, callback, checkpoint=tmp_path / name).num_timesteps == 3
    assert sac(compile=False).learn(10, Stop()).num_timesteps == 3


def test_it_calls_as_the_callback_is_called() -> None:
    calls: list[str] = []

    class All(BaseCallback):
        def _init_callback(self) -> None:
            calls.append("init")

        def _on_training_start(self) -> None:
            calls.append("start")

        def _on_rollout_start(self) -> None:
            calls.append("rollout start")

        def _on_step(self) -> bool:
            calls.append(f"step {self.locals['num_collected_steps']} {self.num_timesteps}")
            return self.num_timesteps < 3

        def _on_rollout_end(self) -> None:
            calls.append("rollout end")

        def _on_training_end(self) -> None:
            calls.append("end")

    sac(compile=False).learn(10, callback=All())
    plain, calls[:] = calls.copy(), []
    sac(compile=False).learn(10, callback=HoldBack(CallbackList([All(), Counter()])))
    assert calls == plain and "step 1 1" in plain


def test_interrupts_are_not_kept() -> None:
    class Interrupted(BaseCallback):
        def _on_step(self) -> bool:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        held(sac(compile=False), Interrupted())


def test_an_evaluation_that_raises(tmp_path: Path) -> None:
    class Breaks(Toy):
        def step(self, action: Any) -> Any:
            raise OSError("the simulator is gone")

    hold = held(sac(compile=False), EvalCallback(Breaks(), eval_freq=20, n_eval_episodes=1, verbose=0))
    with pytest.raises(OSError, match="the simulator is gone"):
        hold.raise_kept()
    # Without anything that keeps it, at once.
    with pytest.raises(OSError, match="the simulator is gone"):
        sac(compile=False).learn(60, callback=EvalCallback(Breaks(), eval_freq=20, n_eval_episodes=1, verbose=0))


def test_a_step_is_finite() -> None:
    """The metrics of every algorithm, which are looked at, are finite by themselves."""
    for make in (*MAKERS.values(), *PIXEL_MAKERS.values()):
        model = make(compile=False)
        assert all(torch.isfinite(value) for value in model._update(random_batch(model)).values())
