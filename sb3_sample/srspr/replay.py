"""Replay of windows of stacked frames, drawn by priority."""

# NumPy's global generator, which Stable-Baselines3 seeds and its buffers use:
# ruff: noqa: NPY002

from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample.replay.compact import CompactReplayBuffer
from sb3_sample.replay.next_observations import ONLY, taken
from sb3_sample.replay.weighted import WindowReplay

#: Added to a priority before its square root is taken.
_SMALL = 1e-10


#: Settings of ``WindowReplay``: windows do not fade, and the priority of a window is the square root of its loss.
SETTINGS = {"fade": 1.0, "fade_floor": 0.1, "priority_exponent": 0.5, "smallest_error": 0.0}


class StateWindows(NamedTuple):
    """
    Windows of consecutive states.

    :param states: s_t, ..., s_{t+K} and s_{t+n}, uint8, (K + 2, B, C, height, width). States after an episode's end are
        arbitrary
    :param actions: a_t, ..., a_{t+K-1}, as integers, (B, K)
    :param rewards: r_t, ..., r_{t+L-1}, L being the larger of n and K, (B, L)
    :param terminated: 1 where a step ended the episode, (B, L)
    :param weights: importance weights, the largest 1, (B,)
    """

    states: torch.Tensor
    actions: torch.Tensor
    rewards: torch.Tensor
    terminated: torch.Tensor
    weights: torch.Tensor


class SPRReplay(WindowReplay):
    """
    Replay buffer of windows, drawn in proportion to the square root of their loss, one from each of B equal shares of
    the total (Schaul et al. 2016), with importance weights that undo half of this prioritisation. New windows have the
    largest priority so far.

    A window may start where ``WindowReplay`` allows it: not where it would cross an episode's end without termination,
    or the newest steps. A binary search in the cumulative sums finds the slots.

    :param args: as for ``CompactReplayBuffer``
    :param kwargs: as for ``CompactReplayBuffer``
    :param horizon: steps of a window
    """

    def __init__(self, *args: Any, horizon: int = 10, **kwargs: Any):
        super().__init__(*args, horizon=horizon, **SETTINGS, **kwargs)

    def draw(self, n: int) -> np.ndarray:
        """
        Draw slots in proportion to their weights, one from each of n equal shares of the sum.

        :param n: how many
        :return: slots, (n,)
        :raises ValueError: if no window may be drawn
        """
        return self.weights.draw((np.arange(n) + 1 - np.random.random(n)) / n)

    def importance_weights(self, slots: np.ndarray) -> np.ndarray:
        """
        Compute the weights of a batch's losses.

        :param slots: of the batch, (B,)
        :return: the inverse square roots of the priorities, divided by the largest of them, float32, (B,)
        """
        weights = 1 / np.sqrt(self.weights.priority[slots].astype(np.float64) + _SMALL)
        return (weights / weights.max()).astype(np.float32)

    def states_of(
        self, slots: np.ndarray, n_steps: int, n_predictions: int, env: VecNormalize | None = None
    ) -> StateWindows:
        """
        Gather windows.

        :param slots: slots where the windows start, (B,)
        :param n_steps: n
        :param n_predictions: K
        :param env: normalises rewards
        :return: the windows
        :raises ValueError: if they are longer than ``horizon``
        """
        assert isinstance(self, ReplayBuffer)
        first, n = self.places(slots), self.buffer_size * self.n_envs
        length = max(n_steps, n_predictions)
        if length > self.horizon:
            raise ValueError(
                f"n_steps={n_steps} and n_predictions={n_predictions} must be at most the {self.horizon} steps of the "
                "replay buffer's windows, with which it was made"
            )
        places = (first[:, None] + np.arange(length) * self.n_envs) % n

        def flat(array: np.ndarray) -> np.ndarray:
            return array.reshape(n, *array.shape[2:])

        after = np.concatenate((places[:, :n_predictions], places[:, n_steps - 1 : n_steps]), axis=1).T
        states = np.empty((n_predictions + 2, len(slots), *self.obs_shape), np.uint8)
        states[0] = taken(self.stored()[ONLY], first)
        states[1:] = self._following(after.reshape(-1))[ONLY].reshape(states[1:].shape)
        # A time limit does not end the bootstrap.
        terminated = flat(self.dones)[places] * (1 - flat(self.timeouts)[places])
        return StateWindows(
            self.to_torch(states),
            self.to_torch(flat(self.actions)[places[:, :n_predictions]].reshape(len(slots), -1)).long(),
            self.to_torch(self._normalize_reward(flat(self.rewards)[places], env)).float(),
            self.to_torch(terminated).float(),
            self.to_torch(self.importance_weights(slots)),
        )


class SPRReplayBuffer(SPRReplay, CompactReplayBuffer):  # type: ignore[misc, override]
    __doc__ = SPRReplay.__doc__
