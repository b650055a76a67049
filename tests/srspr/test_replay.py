"""Windows of the replay buffer, and how they are drawn."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_sample.srspr.replay import SPRReplayBuffer

SPACE = spaces.Box(0, 255, (4, 2, 2), np.uint8)


def buffer(size: int = 100, horizon: int = 10, n_envs: int = 1) -> SPRReplayBuffer:
    return SPRReplayBuffer(size, SPACE, spaces.Discrete(3), "cpu", n_envs, horizon=horizon, frame_stack=4)


def seen(number: int) -> np.ndarray:
    """The observation of this number: frames number - 3, ..., number, each distinct from all others."""
    return np.stack([np.full((2, 2), max(number - age, 0), np.uint8) for age in (3, 2, 1, 0)])


def fill(into: SPRReplayBuffer, ends: dict[int, bool], n: int, begin: int = 0) -> None:
    """Transitions of which number t leads from observation t to t + 1, but where an episode ends."""
    for t in range(begin, n):
        done = t in ends
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": done and not ends[t]}]
        into.add(seen(t)[None], seen(t + 1)[None], np.array([t % 3]), np.array([t / 10]), np.array([done]), infos)


def startable(into: SPRReplayBuffer) -> list[int]:
    """Numbers of the transitions that may start a window."""
    return sorted(into.weights.ordinal[np.flatnonzero(into.weights.ready)].tolist())


@pytest.mark.parametrize("last", range(12))
def test_every_window_of_an_episode_that_ends_at_each_place(last: int) -> None:
    n_steps, k = 4, 5
    held = buffer(horizon=5)
    fill(held, {last: True}, 30)
    # All of the episode that terminated, and of the next one all that 5 more follow.
    assert startable(held) == list(range(25))
    slots = np.flatnonzero(held.weights.ready)
    windows = held.states_of(slots, n_steps, k)
    assert windows.states.shape == (k + 2, 25, 4, 2, 2) and windows.states.dtype.is_floating_point is False
    for i, t in enumerate(held.weights.ordinal[slots]):
        alive = last - t + 1 if t <= last else 10**9  # steps up to and with the terminal one
        for j in range(k + 1):
            if j <= alive:  # the terminal observation is the episode's own
                assert np.array_equal(windows.states[j, i].numpy(), seen(t + j))
        if n_steps <= alive:
            assert np.array_equal(windows.states[k + 1, i].numpy(), seen(t + n_steps)), "s_{t+n}, not s_{t+n-1}"
        m = min(k, alive)
        assert windows.actions[i, :m].tolist() == [(t + j) % 3 for j in range(m)]
        assert windows.rewards[i, :m].tolist() == pytest.approx([(t + j) / 10 for j in range(m)])
        assert windows.terminated[i, :m].tolist() == [float(t + j == last) for j in range(m)]


def test_no_window_crosses_a_time_limit_or_the_newest_step() -> None:
    held = buffer(horizon=5)
    fill(held, {11: False}, 30)
    assert startable(held) == [*range(7), *range(12, 25)]
    held.cut_episodes()  # the environment was reset
    fill(held, {}, 40, begin=30)
    assert startable(held) == [*range(7), *range(12, 25), *range(30, 35)]


def test_a_full_buffer_draws_nothing_that_was_overwritten() -> None:
    held = buffer(size=40, horizon=5)
    fill(held, dict.fromkeys(range(6, 200, 7), True), 200)
    for _ in range(20):
        slots = held.draw(8)
        windows = held.states_of(slots, 5, 5)
        for i, t in enumerate(held.weights.ordinal[slots]):
            assert 160 <= t < 200
            assert np.array_equal(windows.states[0, i].numpy(), seen(t))


def test_draws_follow_the_roots_of_the_losses() -> None:
    held = buffer(size=100, horizon=1)
    fill(held, {}, 41)
    ready = np.flatnonzero(held.weights.ready)
    assert len(ready) == 40 and (held.weights.priority[ready] == 1).all()  # the largest so far
    losses = np.linspace(0.1, 4, 40)
    held.weights.renew(ready, losses)
    # Each row has its own: published code averages the loss over the batch first, so that one row gets its mean.
    assert held.weights.priority[ready] == pytest.approx(np.sqrt(losses), rel=1e-6)
    np.random.seed(0)
    counts = np.bincount(np.concatenate([held.draw(32) for _ in range(3125)]), minlength=100)[ready]
    expected = 1e5 * np.sqrt(losses) / np.sqrt(losses).sum()
    # One a stratum: the counts spread less than of independent draws, of which 72 is the 0.1% quantile.
    assert ((counts - expected) ** 2 / expected).sum() < 72
    assert counts == pytest.approx(expected, rel=0.12)
    weights = held.importance_weights(ready)
    assert weights == pytest.approx((losses / losses.min()) ** -0.25, rel=1e-5) and weights.max() == 1
    fill(held, {}, 44, begin=41)
    newest = np.flatnonzero(held.weights.ready)[-2:]
    assert held.weights.priority[newest] == pytest.approx([2, 2])


def test_each_share_of_the_total_gives_one() -> None:
    held = buffer(size=100, horizon=1)
    fill(held, {}, 33)
    for _ in range(10):
        # 32 windows of the same weight: one each.
        assert sorted(held.draw(32)) == list(range(32))
    held.weights.renew(np.arange(32), np.array([31.0**2] + [1.0] * 31))
    for _ in range(10):
        assert np.bincount(held.draw(2), minlength=32)[0] == 1


def test_frames_are_stored_once() -> None:
    held = buffer(size=250)
    fill(held, {}, 200)
    assert held.observations.frames.nbytes == 251 * 4
    assert len(held.observations.aside) == 0
