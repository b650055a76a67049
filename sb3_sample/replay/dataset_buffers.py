"""Replay buffers as sources of data sets."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_sample.replay.columns import (
    NEXT_OBSERVATIONS,
    OBSERVATIONS,
    Column,
    observations_at,
    own_columns_of,
    rows_at,
)
from sb3_sample.replay.steps import as_numpy, check_action_space


def arrays_of(buffer: Any) -> dict[str, Any]:
    """
    Collect the transitions of a replay buffer, each one step and as stored, environment after environment.

    :param buffer: Stable-Baselines3's replay buffer, or one of this package
    :return: arguments of ``Dataset.from_arrays``; observations are gathered from the buffer as they are read
    :raises ValueError: if the buffer is empty, or its actions are not of a bounded Box
    """
    space = buffer.action_space
    if not isinstance(space, spaces.Box):
        raise ValueError(f"buffer must have actions of a Box, as those of a data set are, not of {space}")
    check_action_space(space.shape, space)
    size, first = buffer.size(), int(buffer.pos) if buffer.full else 0
    if buffer.full and getattr(buffer, "optimize_memory_usage", False):
        # The observation of the oldest row was overwritten by the newest next observation.
        size, first = size - 1, first + 1
    if size < 1:
        raise ValueError("buffer must have at least one transition, not 0")
    positions = np.tile((first + np.arange(size)) % buffer.buffer_size, buffer.n_envs)
    env_indices = np.repeat(np.arange(buffer.n_envs), size)

    def taken(array: Any) -> np.ndarray:
        return as_numpy(rows_at(array, positions, env_indices))

    truncations = taken(buffer.timeouts)[:, 0].astype(bool)
    # A time limit does not end the bootstrap.
    terminations = taken(buffer.dones)[:, 0].astype(bool) & ~truncations
    truncations[size - 1 :: size] |= ~terminations[size - 1 :: size]  # of each environment
    low, high = space.low.astype(np.float64).ravel(), space.high.astype(np.float64).ravel()
    actions = low + 0.5 * (taken(buffer.actions).astype(np.float64) + 1) * (high - low)
    return {
        "observations": _places(buffer, positions, env_indices, OBSERVATIONS),
        "actions": np.clip(actions, low, high).astype(np.float32).reshape(-1, *space.shape),
        "rewards": taken(buffer.rewards),
        "terminations": terminations,
        "truncations": truncations,
        "next_observations": _places(buffer, positions, env_indices, NEXT_OBSERVATIONS),
        "observation_space": buffer.observation_space,
        "action_space": space,
        "columns": own_columns_of(buffer, lambda column, array: taken(array)),
    }


class _Places:
    """
    Observations at places of a replay buffer, gathered as they are read: as a whole they would take several times the
    buffer's memory.

    :param gather: returns those at some of the places, (n, O)
    :param n: number of places, at least one
    """

    def __init__(self, gather: Callable[[slice], np.ndarray], n: int):
        first = gather(slice(0, 1))
        self._gather, self.shape, self.dtype = gather, (n, *first.shape[1:]), first.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> np.ndarray:
        return self._gather(rows)


def _places(buffer: Any, positions: np.ndarray, env_indices: np.ndarray, column: Column) -> Any:
    def gather(rows: slice, key: str | None) -> np.ndarray:
        return as_numpy(observations_at(buffer, positions[rows], env_indices[rows], column, key))

    n, space = len(positions), buffer.observation_space
    if isinstance(space, spaces.Dict):
        return {key: _Places(functools.partial(gather, key=key), n) for key in space.spaces}
    return _Places(functools.partial(gather, key=None), n)
