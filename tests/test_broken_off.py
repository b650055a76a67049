"""Episodes that are broken off: no transition, return or window that is learned from leads over the break."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.her import HerReplayBuffer

from sb3_sample import MBMAPPO, Dataset
from sb3_sample.replay.weighted import WindowReplay
from sb3_sample.srspr.replay import SPRReplayBuffer
from tests.sac.common import MAKERS, sac, vec
from tests.sac.test_spaces_and_wrappers import Reach
from tests.srspr.common import tiny as srspr


class Stop(BaseCallback):
    """Ends the training at a step, or raises an error there."""

    def __init__(self, at: int, error: type[BaseException] | None = None):
        super().__init__()
        self.at, self.error = at, error

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at and self.error is not None:
            raise self.error
        return self.num_timesteps != self.at


def assert_transitions_lead_on(model: Any) -> None:
    """Of ``Toy``, whose observations count the steps of an episode."""
    buffer = model.replay_buffer
    n = buffer.size()
    assert n > 0
    ours, following = buffer.observations[:n], buffer.next_observations[:n]
    np.testing.assert_array_equal(following, ours + 1)
    np.testing.assert_array_equal(buffer.rewards[:n], following[..., 0])


# In the midst of an episode (18 of one environment), and at its end.
@pytest.mark.parametrize(
    ("maker", "n_envs", "error", "at"),
    [
        ("SAC", 1, None, 18),
        ("SAC", 2, KeyboardInterrupt, 28),
        pytest.param("BRO", 1, None, 28, marks=pytest.mark.slow),
        pytest.param("DebiasedRQ", 1, KeyboardInterrupt, 18, marks=pytest.mark.slow),
        ("DebiasedRQ", 2, None, 28),
    ],
)
def test_after_a_callback_has_ended_a_training(
    maker: str, n_envs: int, error: type[BaseException] | None, at: int
) -> None:
    model = MAKERS[maker](vec(n_envs))
    if error is None:
        model.learn(60, Stop(at))
    else:
        with pytest.raises(error):
            model.learn(60, Stop(at, error))
    assert model._last_obs is None
    model.learn(60, reset_num_timesteps=False)
    assert_transitions_lead_on(model)
    if isinstance(model.replay_buffer, WindowReplay):
        assert_windows_lead_on(model.replay_buffer)


def test_a_rollout_of_ppo_begins_where_the_environment_is() -> None:
    class Looks(BaseCallback):
        seen: list[float] = []

        def _on_step(self) -> bool:
            self.seen.append(float(self.locals["new_obs"][0, 0] - self.locals["obs_tensor"][0, 0]))
            return True

    model = MBMAPPO("MlpPolicy", vec(), n_steps=16, batch_size=8, n_simulated=0, device="cpu")
    model.learn(64, Stop(19))
    looks = Looks()
    model.learn(64, looks, reset_num_timesteps=False)
    # An episode of seven steps ends with the first observation of the next.
    assert set(looks.seen) == {1.0, -6.0} and looks.seen[:7] == [1.0] * 6 + [-6.0]


def test_offline_learning_leaves_the_environment_alone() -> None:
    model = sac().learn(24)
    last = model._last_obs
    assert last is not None
    model.learn_offline(Dataset.from_replay_buffer(model.replay_buffer), 10, Stop(4))
    assert model.num_timesteps == 4 and np.array_equal(model._last_obs, last)


# ---------------------------------------------------------------- n-step returns


def assert_returns_lead_on(model: Any) -> None:
    buffer = model.replay_buffer
    assert isinstance(buffer, NStepReplayBuffer)
    samples = buffer._get_samples(np.arange(buffer.size()))
    first, last = samples.observations[:, 0].numpy(), samples.next_observations[:, 0].numpy()
    n = last - first
    assert set(np.unique(n)) == {1.0, 2.0, 3.0}
    expected = [sum(buffer.gamma**k * (t + 1 + k) for k in range(int(m))) for t, m in zip(first, n, strict=True)]
    np.testing.assert_allclose(samples.rewards[:, 0].numpy(), expected, rtol=1e-6)
    # Where fewer steps are summed, the episode has ended or was broken off, in which case the bootstrap goes on.
    np.testing.assert_array_equal(samples.dones[:, 0].numpy(), last == 7)


@pytest.mark.parametrize(
    "breaks",
    [
        lambda model: model.learn(20),
        lambda model: model.learn(20, reset_num_timesteps=False),
        lambda model: model.set_env(vec()) or model.learn(20, reset_num_timesteps=False),
        lambda model: model.learn(20, Stop(8)).learn(20, reset_num_timesteps=False),
    ],
    ids=["another learn", "the same episode", "another environment", "a callback"],
)
def test_returns_of_several_steps(breaks: Callable[[Any], Any]) -> None:
    model = sac(n_steps=3, gamma=0.9).learn(25)
    breaks(model)
    assert_returns_lead_on(model)


def test_returns_after_a_buffer_was_loaded(tmp_path: Path) -> None:
    model = sac(n_steps=3, gamma=0.9).learn(25)
    model.save_replay_buffer(tmp_path / "b")
    model.learn(5, reset_num_timesteps=False)
    model.load_replay_buffer(tmp_path / "b")
    model.learn(20, reset_num_timesteps=False)
    assert_returns_lead_on(model)


# ---------------------------------------------------------------- goals


@pytest.mark.parametrize(
    ("breaks", "starts"),
    [
        (lambda model: model.learn(20), {0, 10, 20, 25, 35}),
        (lambda model: model.learn(20, reset_num_timesteps=False), {0, 10, 20, 30, 40}),
        (lambda model: model.set_env(Reach()) or model.learn(20, reset_num_timesteps=False), {0, 10, 20, 25, 35}),
    ],
    ids=["another learn", "the same episode", "another environment"],
)
def test_goals_are_of_the_same_episode(breaks: Callable[[Any], Any], starts: set[int]) -> None:
    model = sac(Reach(), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, learning_starts=20).learn(25)
    breaks(model)
    buffer = model.replay_buffer
    ended = buffer.ep_length[: buffer.size(), 0] > 0
    assert set(buffer.ep_start[: buffer.size(), 0][ended]) <= starts and buffer.ep_length.max() == 10
    assert starts - set(buffer.ep_start[: buffer.size(), 0]) == set()
    assert buffer.env is model.get_env()


# ---------------------------------------------------------------- windows


def assert_windows_lead_on(buffer: Any) -> None:
    slots = np.flatnonzero(buffer.weights.ready)
    assert len(slots) > 0
    steps, envs = np.divmod(buffer.places(slots), buffer.n_envs)
    first, ended = buffer.observations[steps, envs, 0], np.zeros(len(slots), bool)
    for j in range(buffer.horizon):
        at = (steps + j) % buffer.buffer_size
        assert (ended | (buffer.observations[at, envs, 0] == first + j)).all()
        ended |= buffer.dones[at, envs] == 1


def test_windows_after_a_buffer_was_loaded(tmp_path: Path) -> None:
    model = MAKERS["DebiasedRQ"]().learn(25)
    model.save_replay_buffer(tmp_path / "b")
    model.learn(15, reset_num_timesteps=False)
    model.load_replay_buffer(tmp_path / "b")
    model.learn(30, reset_num_timesteps=False)
    assert_windows_lead_on(model.replay_buffer)


def test_sr_sprs_windows_are_as_long_as_it_needs(tmp_path: Path) -> None:
    model = srspr().learn(40)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    env = model.get_env()
    same = type(model).load(tmp_path / "m", env)
    same.load_replay_buffer(tmp_path / "b")
    assert isinstance(same.replay_buffer, SPRReplayBuffer) and same.replay_buffer.horizon == 3
    longer = type(model).load(tmp_path / "m", env, n_steps=5)
    with pytest.raises(
        ValueError, match="SPRReplayBuffer of windows of 3 steps, but this model needs .* of 5, the lar"
    ):
        longer.load_replay_buffer(tmp_path / "b")
    model.n_steps = 5
    with pytest.raises(ValueError, match="n_steps=5 and n_predictions=2 must be at most the 3 steps of the replay"):
        model.train(1)
