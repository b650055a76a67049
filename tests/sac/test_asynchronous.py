"""Acting in a thread while learning: order, age of parameters, replay ratio, stopping. By clocks of the tests' own."""

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_sample import SAC
from sb3_sample.learner.execution import CAPTURING
from sb3_sample.sac.apart import MAX_AGE, Apart
from sb3_sample.saving.checkpoint import Checkpointer
from sb3_sample.training import acting
from sb3_sample.training.acting import ActingThread, Chosen, Step
from tests.sac.common import MAKERS, Toy, sac, vec
from tests.sac.pixels import drq


class Counter(gym.Env):
    """Observations and rewards are the number of the step, episodes have ten steps."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = spaces.Box(-2, 2, (2,), np.float32)

    def __init__(self, fails_at: int = -1) -> None:
        self.n, self.fails_at, self.threads = 0, fails_at, set()
        self.actions: list[np.ndarray] = []

    def reset(self, **kwargs: Any) -> Any:
        super().reset(**kwargs)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.threads.add(threading.current_thread().name)
        self.n += 1
        if self.n == self.fails_at:
            raise OSError("the robot is unplugged")
        self.actions.append(action.copy())
        return self._observation(), float(self.n), False, self.n % 10 == 0, {}

    def _observation(self) -> np.ndarray:
        return np.array([self.n, 0, 1], np.float32)


class Made:
    """A clock that goes on when it is waited for, and when it is told."""

    def __init__(self, waits: Callable[[], None] = lambda: None):
        self.time, self._waits = 0.0, waits

    def now(self) -> float:
        return self.time

    def wait_until(self, when: float) -> None:
        self._waits()
        self.time = max(self.time, when)


class Durations:
    """A vectorised environment whose steps last as told."""

    num_envs = 1

    def __init__(self, clock: Made, durations: list[float]):
        self._clock, self._durations = clock, durations
        self.starts: list[float] = []

    def step(self, actions: np.ndarray) -> Any:
        self.starts.append(self._clock.time)
        self._clock.time += self._durations[len(self.starts) - 1]
        return np.zeros((1, 1)), np.zeros(1), np.zeros(1, bool), [{}]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Made:
    made = Made()
    monkeypatch.setattr(acting, "CLOCK", made)
    return made


def until(what: Callable[[], bool]) -> None:
    """Wait for what another thread is about to do."""
    for _ in range(60_000):
        if what():
            return
        time.sleep(0.001)
    raise AssertionError("it has not come about")


def asynchronous(env: Any = None, **kwargs: Any) -> Any:
    env = env or DummyVecEnv([Counter])
    return sac(env, **{"learning_starts": 20, "replay_ratio": 2, **kwargs})


def env_of(model: Any) -> Any:
    return model.env.envs[0].unwrapped


def paced(model: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the environment so slow that the learner has done what is due before the next step, unless it is to rest."""

    def is_idle() -> bool:
        apart = model._apart
        if apart is None or apart.thread._rests or apart.thread._stops:
            return True
        return apart.n_due == 0 and model.num_transitions == env_of(model).n

    def wait() -> None:
        until(is_idle)

    monkeypatch.setattr(acting, "CLOCK", Made(wait))


# ---------------------------------------------------------------- the thread


def test_steps_begin_with_their_periods(clock: Made) -> None:
    # 30 ms each, then one of 130 ms, then one that ends 1 ms late, which is no reason to leave out a period.
    env: Any = Durations(clock, [0.03, 0.03, 0.13, 0.03, 0.0495, 0.03])

    def choose(observations: Any, n_before: int) -> Chosen:
        clock.time += 0.0015
        return Chosen(np.zeros((1, 1)), np.zeros((1, 1)), 3)

    thread = ActingThread(env, choose, np.zeros((1, 1)), 6, 0.05)
    thread.start()
    thread._thread.join(30)
    steps = thread.taken(wait=False)
    thread.stop()
    # From the first on: the third lasts until 0.23, so that the periods of 0.15 and 0.2 are missed.
    begin = env.starts[0]
    np.testing.assert_allclose(np.array(env.starts) - begin, [0, 0.05, 0.1, 0.25, 0.3, 0.351], atol=1e-9)
    assert [step.missed for step in steps] == [0, 0, 0, 2, 0, 0]
    np.testing.assert_allclose([step.late for step in steps], [0, 0, 0, 0, 0, 0.001], atol=1e-9)


def test_without_a_frequency_one_step_follows_the_other(clock: Made) -> None:
    env: Any = Durations(clock, [0.03, 0.2, 0.01])
    thread = ActingThread(env, lambda *_: Chosen(np.zeros((1, 1)), np.zeros((1, 1)), None), None, 3, None)
    thread.start()
    thread._thread.join(30)
    np.testing.assert_allclose(env.starts, [0, 0.03, 0.23])
    assert [(step.missed, step.late) for step in thread.taken(wait=False)] == [(0, 0.0)] * 3
    thread.stop()


def test_at_rest_no_step_begins(clock: Made) -> None:
    env: Any = Durations(clock, [0.0] * 10_000)
    thread = ActingThread(env, lambda *_: Chosen(np.zeros((1, 1)), np.zeros((1, 1)), None), None, 10_000, 0.05)
    thread.start()
    until(lambda: len(env.starts) > 5)
    thread.rest()
    n = len(env.starts)
    assert len(thread.taken(wait=True)) == n and thread.taken(wait=True) == []
    time.sleep(0.02)
    assert len(env.starts) == n
    thread.go_on()
    assert len(thread.taken(wait=True)) >= 1
    thread.stop()
    assert not thread._thread.is_alive()


def test_after_a_rest_an_action_is_chosen_anew_for_a_period_that_can_be_met(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[int] = []

    def wait() -> None:
        waits.append(1)
        if len(waits) == 3:  # for the period at 0.1
            until(lambda: thread._rests)

    clock = Made(wait)
    monkeypatch.setattr(acting, "CLOCK", clock)
    env: Any = Durations(clock, [0.03] * 4)
    chosen: list[float] = []

    def choose(observations: Any, n_before: int) -> Chosen:
        chosen.append(clock.time)
        return Chosen(np.full((1, 1), clock.time), np.zeros((1, 1)), 3)

    thread = ActingThread(env, choose, np.zeros((1, 1)), 4, 0.05)
    thread.start()
    until(lambda: len(waits) == 3)
    thread.rest()
    clock.time += 0.23
    thread.go_on()
    thread._thread.join(30)
    steps = thread.taken(wait=False)
    thread.stop()
    np.testing.assert_allclose(env.starts, [0, 0.05, 0.35, 0.4])
    np.testing.assert_allclose([step.actions.item() for step in steps], [0, 0.03, 0.33, 0.38])
    assert [step.missed for step in steps] == [0, 0, 5, 0] and len(chosen) == 5
    np.testing.assert_allclose([step.begun for step in steps], [0, 0.05, 0.12, 0.17])


# ---------------------------------------------------------------- learn


def test_what_was_acted_is_stored_in_its_order_and_learned_from_by_the_replay_ratio(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = asynchronous()
    paced(model, monkeypatch)
    seen: list[tuple[int, float]] = []
    model.learn(
        60, lambda local, _: seen.append((local["self"].num_timesteps, local["rewards"][0])) is None,
        asynchronous=True, control_frequency=20,
    )  # fmt: skip
    env = env_of(model)
    assert env.threads == {"acting"} and env.n == model.num_timesteps == model.num_transitions == 60
    assert seen == [(n, float(n)) for n in range(1, 61)]
    buffer = model.replay_buffer
    assert buffer.rewards[:60, 0].tolist() == list(range(1, 61))
    np.testing.assert_allclose(
        model.policy.unscale_action(buffer.actions[:60, 0]), np.array(env.actions), rtol=1e-5, atol=1e-5
    )
    # Two gradient steps a transition after the warm-up, but for the last, when the training has ended.
    assert 2 * 38 <= model._n_updates <= 2 * 40
    assert model._episode_num == 6
    assert model.learn(30)._n_updates > 2 * 60  # as ever, and with the environment in this thread


def test_parameters_are_handed_over_at_a_bounded_age(monkeypatch: pytest.MonkeyPatch) -> None:
    model = asynchronous(replay_ratio=5, exploration="optimistic_shift")
    paced(model, monkeypatch)

    def acting_on(learner: Any) -> list[torch.Tensor]:
        tensors = [*learner.actor.parameters(), *learner.explorer.parameters()]
        return [each.detach().clone() for each in tensors]

    learned = {0: acting_on(model.learner)}
    plain_update = SAC._update

    def update(self: Any, *args: Any) -> Any:
        metrics = plain_update(self, *args)
        learned[self._n_updates] = acting_on(self.learner)
        return metrics

    ages: list[Any] = []
    same: list[bool] = []
    plain_choose = Apart._choose

    def choose(self: Apart, *args: Any) -> Chosen:
        found = plain_choose(self, *args)
        with self._lock:
            expected = learned[self._handed_over_at]
            same.append(all(map(torch.equal, acting_on(self._learner), expected)))
        ages.append(found.age)
        return found

    monkeypatch.setattr(SAC, "_update", update)
    monkeypatch.setattr(Apart, "_choose", choose)
    model.learn(50, asynchronous=True, control_frequency=20)
    assert ages[:20] == [None] * 20 and all(same) and len(learned) > 120
    assert max(age for age in ages if age is not None) <= MAX_AGE
    assert len({sum(float(each.sum()) for each in tensors) for tensors in learned.values()}) > 100


def test_learning_goes_on_after_gradient_steps_of_a_callback(monkeypatch: pytest.MonkeyPatch) -> None:
    model = asynchronous()
    paced(model, monkeypatch)

    def callback(local: Any, _: Any) -> bool:
        if local["self"].num_timesteps == 30:
            local["self"].train(2 * MAX_AGE)
        return True

    model.learn(60, callback, asynchronous=True, control_frequency=20)
    # Two a transition after the warm-up, but for the last ones, and the callback's.
    assert model._n_updates >= 2 * 38 + 2 * MAX_AGE


def test_a_signal_while_it_acts_is_saved_at_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the signal comes just after it was asked whether the turn is to be saved."""
    model = asynchronous()
    paced(model, monkeypatch)
    resting: list[bool] = []
    plain_save, plain_due = Checkpointer._save, Checkpointer.is_due

    def save(self: Any) -> None:
        thread = None if self._model._apart is None else self._model._apart.thread
        resting.append(thread is None or thread._at_rest or not thread._thread.is_alive())
        plain_save(self)

    def is_due(self: Any) -> bool:
        due = plain_due(self)
        if self._model.num_timesteps == 33 and not due and self._interrupts.received is None:
            os.kill(os.getpid(), signal.SIGINT)
        return due

    monkeypatch.setattr(Checkpointer, "_save", save)
    monkeypatch.setattr(Checkpointer, "is_due", is_due)
    with pytest.raises(KeyboardInterrupt):
        model.learn(300, checkpoint=tmp_path / "run", asynchronous=True, control_frequency=20)
    assert resting == [True, True]


def test_it_does_not_act_during_a_capture() -> None:
    """A GPU's generator and memory are the capture's meanwhile; what acts is never captured itself."""
    model = sac().learn(24)
    apart = Apart(model, None)
    chosen: list[Chosen] = []
    thread = threading.Thread(target=lambda: chosen.append(apart._choose(model._last_obs, 0)))
    with CAPTURING:
        thread.start()
        thread.join(0.2)
        assert thread.is_alive() and not chosen
    thread.join(10)
    assert len(chosen) == 1 and apart._learner.make_acting(apart._learner) is None


def test_an_environment_that_is_too_fast_does_not_wait_and_the_log_says_so(clock: Made) -> None:
    model = asynchronous(replay_ratio=5, learning_starts=5)
    lines: list[dict[str, Any]] = []
    plain = model.dump_logs

    def dump() -> None:
        lines.append(dict(model.logger.name_to_value))
        plain()

    model.dump_logs = dump
    with pytest.warns(UserWarning, match=r"\d+ of \d+ gradient steps have lapsed: .*than replay_ratio=5 a transition"):
        model.learn(800, log_interval=1, asynchronous=True, control_frequency=4)
    assert env_of(model).n == 800 and model._n_updates < 5 * 795
    last = lines[-1]
    assert last["asynchronous/lapsed_updates"] > 0 and last["asynchronous/replay_ratio"] < 5
    assert last["asynchronous/largest_parameter_age"] <= MAX_AGE
    assert last["asynchronous/missed_periods"] == 0 and last["asynchronous/largest_lateness_ms"] == 0


@pytest.mark.parametrize("frequency", [None, 50])
def test_gradient_steps_lapse_after_a_second(frequency: float | None) -> None:
    """Whether the environment keeps its own time, here 50 Hz, or is kept to it."""
    apart = Apart(sac(replay_ratio=2).learn(24), frequency)

    def note(begun: float) -> None:
        given: list[Any] = [None, None, None, None, None, np.zeros(1, bool), [{}], 0, 0.0, 0]
        apart.note(Step(*given, begun=begun), 2)

    for n in range(50):
        note(0.02 * n)
    assert apart.n_due == 100 and apart._n_lapsed == 0
    note(1.01)
    assert apart.n_due == 100 and apart._n_lapsed == 2
    apart.n_due = 0
    note(1.03)
    assert apart.n_due == 2
    note(60.0)
    assert apart.n_due == 2 and apart._n_lapsed == 4


def test_missed_periods_are_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Made()
    monkeypatch.setattr(acting, "CLOCK", clock)

    class Slow(Counter):
        def step(self, action: np.ndarray) -> Any:
            clock.time += 0.12 if self.n % 20 == 0 else 0.02
            return super().step(action)

    with pytest.warns(UserWarning, match=r"\d+ of \d+ periods of 1 / 10.0 s were missed: .* smaller control_frequency"):
        asynchronous(DummyVecEnv([Slow]), learning_starts=500).learn(
            150, asynchronous=True, control_frequency=10.0
        )  # fmt: skip


@pytest.mark.parametrize("ends", ["callback", "interrupt", "environment"])
def test_it_ends_with_the_training(ends: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fails_at = 35 if ends == "environment" else -1
    model = asynchronous(DummyVecEnv([lambda: Counter(fails_at)]))
    paced(model, monkeypatch)

    class Ends(BaseCallback):
        acts_at_the_end = False

        def _on_step(self) -> bool:
            if ends == "interrupt" and self.num_timesteps == 30:
                raise KeyboardInterrupt
            return ends != "callback" or self.num_timesteps < 30

        def _on_training_end(self) -> None:
            self.acts_at_the_end = "acting" in {thread.name for thread in threading.enumerate()}

    callback = Ends()

    def learn() -> None:
        model.learn(300, callback, asynchronous=True, control_frequency=20)

    if ends == "callback":
        learn()
    else:
        with pytest.raises(KeyboardInterrupt if ends == "interrupt" else OSError):
            learn()
    assert "acting" not in {thread.name for thread in threading.enumerate()} and not callback.acts_at_the_end
    assert model.num_timesteps == (34 if ends == "environment" else 30)
    n = env_of(model).n
    # Steps that nobody stored are behind the next training, which begins an episode.
    model.learn(5, reset_num_timesteps=False)
    assert env_of(model).n == n + 5 and model.replay_buffer.size() == model.num_transitions


def test_checkpoints_are_made_at_rest_and_gone_on_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resting: list[bool] = []
    plain = Checkpointer._save

    def save(self: Any) -> None:
        apart = self._model._apart
        thread = None if apart is None else apart.thread
        resting.append(thread is None or thread._at_rest or not thread._thread.is_alive())
        n_stored = self._model.num_transitions
        assert n_stored == env_of(self._model).n
        plain(self)

    monkeypatch.setattr(Checkpointer, "_save", save)

    def learn(stop: int) -> Any:
        model = asynchronous(DummyVecEnv([Counter]))
        paced(model, monkeypatch)
        callback = lambda local, _: local["self"].num_timesteps < stop  # noqa: E731
        return model.learn(
            120, callback, checkpoint=tmp_path / "run", checkpoint_freq=20, asynchronous=True, control_frequency=20
        )

    first = learn(70)
    # At the beginning, and at 20, 40 and 60.
    assert first.num_timesteps == 70 and len(resting) == 4 and all(resting)
    again = learn(1_000)
    assert again.num_timesteps == again.num_transitions == 120 and all(resting)
    rewards = again.replay_buffer.rewards[: again.replay_buffer.size(), 0].tolist()
    assert rewards == list(range(1, 121))
    assert len(list((tmp_path / "run").glob("checkpoint-*"))) == 2


@pytest.mark.parametrize("maker", ["BRO", "DAC", "OAC", "FlashSAC", "TD3BC", "DebiasedRQ"])
def test_agents_with_explorations_of_their_own(maker: str, clock: Made) -> None:
    model = MAKERS[maker](env=vec())
    model.learn(40, asynchronous=True, control_frequency=20)
    assert model._n_updates > 0 and len(model.env.envs[0].unwrapped.actions) == 40


def test_several_environments(clock: Made) -> None:
    model = asynchronous(DummyVecEnv([Counter, Counter])).learn(60, asynchronous=True, control_frequency=20)
    assert model.num_timesteps == 60 and [env.unwrapped.n for env in model.env.envs] == [30, 30]


class Goals(Toy):
    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, infos: Any) -> np.ndarray:
        return np.zeros(len(achieved))


def goals() -> DummyVecEnv:
    keys = ("observation", "achieved_goal", "desired_goal")
    space = spaces.Dict({key: spaces.Box(-9, 9, (3,)) for key in keys})
    return DummyVecEnv([lambda: Goals(obs_space=space)])


@pytest.mark.parametrize(
    ("make", "given", "words"),
    [
        (sac, {"asynchronous": 1}, "asynchronous must be True or False, not 1"),
        (sac, {"control_frequency": 20}, "control_frequency=20 means nothing without asynchronous=True"),
        (
            sac,
            {"asynchronous": True, "control_frequency": 0},
            "control_frequency must be above 0 and finite.* not 0",
        ),
        (lambda: sac(train_freq=1), {"asynchronous": True}, "by replay_ratio, which train_freq and gradient_steps"),
        (lambda: sac(VecNormalize(vec())), {"asynchronous": True}, "does not go with VecNormalize"),
        (
            lambda: sac(goals(), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer),
            {"asynchronous": True},
            "does not go with HerReplayBuffer",
        ),
        (
            lambda: sac(action_noise=NormalActionNoise(np.zeros(2), np.ones(2))),
            {"asynchronous": True},
            "does not go with action_noise=",
        ),
    ],
)
def test_what_is_refused(make: Callable[..., Any], given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make().learn(10, **given)


@pytest.mark.parametrize("maker", ["DrQ", "SAC", "DAC"])
def test_a_shared_encoder_is_handed_over(maker: str, clock: Made) -> None:
    """It is among the critics' parameters, which who acts without them does not get otherwise."""
    if maker == "DrQ":
        model = drq(replay_ratio=1)
    else:
        shared = {"features_extractor_class": Embedding, "share_features_extractor": True}
        model = MAKERS[maker](env=vec(), policy_kwargs={"net_arch": [8], **shared})
    model.learn(40, asynchronous=True, control_frequency=20)
    apart = Apart(model, None)
    theirs, ours = (each.networks.critic.features_extractor.state_dict() for each in (model.learner, apart._learner))
    assert ours and all(torch.equal(ours[name], theirs[name]) for name in theirs)
    acting, learning = (each.networks.actor for each in (apart._learner, model.learner))
    observations = torch.as_tensor(model._last_obs)
    assert torch.equal(acting.features(observations), learning.features(observations))


def test_running_statistics_of_an_explorer_are_handed_over(clock: Made) -> None:
    """Batch moments of an optimistic actor: without them its copy acts by another policy."""
    model = MAKERS["CrossQ"](env=vec(), exploration="optimistic_actor", policy_delay=1)
    model.learn(60, asynchronous=True, control_frequency=20)
    apart = Apart(model, None)
    for value in model.explorer.actor.buffers():
        value += 1
    apart.hand_over()
    theirs, ours = (dict(each.explorer.actor.named_buffers()) for each in (model.learner, apart._learner))
    assert any("running_mean" in name for name in theirs)
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_running_statistics_of_observations_are_those_of_the_steps_taken_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the warm-up too, which has no gradient steps after which parameters would be handed over."""
    found = []
    note = Apart.note

    def noted(self: Apart, *args: Any) -> None:
        note(self, *args)
        ours, theirs = (each.networks.observation_norm for each in (self._learner, self._model.learner))
        found.append((float(ours.count), float(theirs.count), torch.equal(ours.mean, theirs.mean)))

    monkeypatch.setattr(Apart, "note", noted)
    MAKERS["SimBa"](learning_starts=40, replay_ratio=0.1).learn(30, asynchronous=True, control_frequency=100)
    assert len(found) == 30 and all(ours == theirs and same for ours, theirs, same in found)
    assert found[-1][0] > found[0][0] > 0


class Embedding(BaseFeaturesExtractor):
    def __init__(self, observation_space: Any):
        super().__init__(observation_space, 4)
        self.layer = torch.nn.Linear(observation_space.shape[0], 4)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return self.layer(observations)
