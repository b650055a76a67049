"""Steps of a data set, and the checks that they pass."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces

#: Most rows, and most bytes, that are checked or copied at a time, so that data larger than the memory are never in it
#: as a whole.
CHUNK, CHUNK_BYTES = 65_536, 64 * 2**20


class Steps(NamedTuple):
    """
    N steps as data sets hold them, and M >= N observations. ``at`` and ``next_at`` are the places of a step's
    observation and next observation, (N,) each; without ``next_at``, ``next_observations`` has the latter, (N, O).

    ``actions`` are in the environment's units, (N, A); ``terminations`` and ``truncations`` say whether the episode
    ended with the step, (N,), the latter also where the data end or continue elsewhere.
    """

    observations: Any
    at: Any
    next_at: Any
    next_observations: Any
    actions: Any
    rewards: Any
    terminations: Any
    truncations: Any
    columns: dict[str, Any]


def observation_dtypes(space: Any) -> Any:
    """
    :param space: of observations
    :return: the type in which they are stored, floats as float32; for a Dict by key
    """
    if isinstance(space, spaces.Dict):
        return {key: observation_dtypes(part) for key, part in space.spaces.items()}
    dtype = np.dtype(space.dtype)
    return np.dtype(np.float32) if dtype.kind == "f" else dtype


def action_dtype(space: spaces.Box) -> Any:
    """
    :param space: of actions
    :return: the type in which they are stored, always a float
    """
    dtype = np.dtype(space.dtype)
    return dtype if dtype.kind == "f" else np.dtype(np.float32)


def as_numpy(values: Any) -> np.ndarray:
    """
    :param values: an array, a tensor on any device, or a list
    :return: the same as an array
    """
    return values.cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)


def pieces(n: int, *arrays: Any) -> Iterator[slice]:
    """
    Divide rows into pieces that fit in memory.

    :param n: number of rows
    :param arrays: what is read of them: arrays with the rows as their first axis, or dicts of such arrays
    :return: the rows of each piece, in order
    """
    parts = [part for each in arrays for part in (each.values() if isinstance(each, dict) else (each,))]
    of_a_row = sum(math.prod(part.shape[1:]) * part.dtype.itemsize for part in parts)
    size = max(1, min(CHUNK, CHUNK_BYTES // max(of_a_row, 1)))
    for first in range(0, n, size):
        yield slice(first, min(first + size, n))


def put(name: str, values: Any, out: np.ndarray) -> None:
    """
    Convert values to the type in which they are stored.

    :param name: what they are, for the error
    :param values: an array, or an object that is read like one
    :param out: array of the same shape to which they are written
    :raises ValueError: if they are not finite in the type of ``out`` (for actions :func:`check_actions` raises it), or
        if that is a type of integers that cannot hold them
    """
    for rows in pieces(len(out), values, out):
        given = np.asarray(values[rows])
        with np.errstate(over="ignore", invalid="ignore"):
            piece = given.astype(out.dtype)
        if name != "actions" and piece.dtype.kind == "f" and not np.isfinite(piece).all():
            raise ValueError(f"{name} must be finite, within {out.dtype}")
        if piece.dtype != given.dtype and piece.dtype.kind in "iu" and (piece != given).any():
            wrong = given[piece != given][0]
            raise ValueError(f"{name} must be whole numbers within {out.dtype}, as their space has them, not {wrong}")
        out[rows] = piece


def check_action_space(shape: tuple[int, ...], action_space: Any) -> None:
    """
    :param shape: of an action
    :param action_space: the space
    :raises ValueError: if it is not a bounded Box of this shape
    """
    bounded = isinstance(action_space, spaces.Box) and np.isfinite([action_space.low, action_space.high]).all()
    if not bounded or tuple(shape) != action_space.shape or not (action_space.low < action_space.high).all():
        raise ValueError(
            f"actions of shape (N, {', '.join(map(str, shape))}) are none of action_space={action_space}, which must "
            "be a bounded Box of their shape"
        )


def check_actions(actions: np.ndarray, action_space: spaces.Box) -> None:
    """
    :param actions: (N, A)
    :param action_space: their space
    :raises ValueError: if one lies outside of it
    """
    low, high = (bound.astype(np.float64) for bound in (action_space.low, action_space.high))
    # float32 rounds a bound given in float64.
    margin = 1e-5 * (high - low)
    for rows in pieces(len(actions), actions):
        piece = actions[rows]
        wrong = ~((piece >= low - margin) & (piece <= high + margin)).reshape(len(piece), -1).all(1)
        if wrong.any():
            step = rows.start + int(np.flatnonzero(wrong)[0])
            raise ValueError(
                f"actions must lie within the bounds of action_space={action_space}, in the environment's units, not "
                f"{actions[step]} as in step {step}: pass the environment's action_space, of arrays [-1, 1] otherwise"
            )
