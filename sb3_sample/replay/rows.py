"""Shapes and types of one step of all environments before it is stored in a replay buffer."""

from typing import Any

import numpy as np
from gymnasium import spaces

FLOAT32 = np.dtype(np.float32)


def as_row(name: str, given: Any, shape: tuple[int, ...], dtype: Any = FLOAT32) -> np.ndarray:
    """
    Convert values to a row of the buffer by the rules of array assignment: repeated along axes that are missing or of
    length one, as in Stable-Baselines3, and never reordered.

    :param name: what it is, for the error
    :param given: one value, or one of each environment
    :param shape: of a row, (n_envs, ...)
    :param dtype: of a row
    :return: the row, of that shape and type; ``given`` itself if it is one already
    :raises ValueError: if it has another shape
    """
    given = np.asarray(given)
    if given.shape == shape:
        return given if given.dtype is dtype else np.ascontiguousarray(given, dtype=dtype)
    own = given.shape
    while len(own) > len(shape) and own[0] == 1:
        own = own[1:]
    if len(own) > len(shape) or any(n not in (1, m) for n, m in zip(own[::-1], shape[::-1], strict=False)):
        hint = ""
        if len(shape) == 4 and own == (shape[0], *shape[2:], shape[1]):
            hint = ": images need their channels first, as VecNormalize(VecTransposeImage(env)) gives them"
        raise ValueError(
            f"could not broadcast the {name} of shape {given.shape} into shape {shape} of the replay buffer, "
            f"environments first{hint}"
        )
    row = np.empty(shape, dtype)
    row[...] = given
    return row


def as_observation(name: str, given: Any, shape: tuple[int, ...], space: spaces.Space) -> np.ndarray:
    """
    Convert an observation to a row of the buffer.

    :param name: what it is, for the error
    :param given: one observation, or one of each environment
    :param shape: of a row, (n_envs, O)
    :param space: of one environment's observations
    :return: the row, (n_envs, O)
    :raises ValueError: if it has another shape
    """
    if isinstance(space, spaces.Discrete) and np.size(given) == shape[0]:
        # (n_envs,), which cannot be assigned to (n_envs, 1)
        given = np.reshape(given, shape)
    return as_row(name, given, shape, space.dtype)


def as_actions(given: Any, shape: tuple[int, int], space: spaces.Space) -> np.ndarray:
    """
    Convert actions to a row of the buffer.

    :param given: one action, or one of each environment, with the axes of the space or flat
    :param shape: of a row, (n_envs, A)
    :param space: of one environment's actions
    :return: the row, (n_envs, A)
    :raises ValueError: if it has another shape
    """
    given = np.asarray(given)
    if given.shape == shape:
        return given

    def long(axes: tuple[int, ...]) -> tuple[int, ...]:
        return tuple(n for n in axes if n != 1)

    with_axes = (shape[0], *(space.shape or ()))
    if long(given.shape) not in (long(with_axes), long(shape)):
        raise ValueError(
            f"could not put the action of shape {given.shape} into shape {with_axes}, environments first, or {shape} "
            "of the replay buffer"
        )
    return given.reshape(shape)


def as_timeouts(infos: Any, n_envs: int) -> np.ndarray:
    """
    Convert the infos' time-limit flags to a row of the buffer.

    :param infos: each environment's info; ``TimeLimit.truncated`` in it may be an array, of one element or of one for
        each environment
    :param n_envs: number of environments
    :return: whether a time limit ended the episode, (n_envs,)
    :raises ValueError: if there are flags of another number of environments
    """
    flags: Any = [info.get("TimeLimit.truncated", False) for info in infos]
    if all(flag is True or flag is False for flag in flags):
        if len(flags) == n_envs:
            return np.array(flags, FLOAT32)
    else:
        flags = np.concatenate([np.ravel(flag) for flag in flags])
    return as_row("flags TimeLimit.truncated of the infos", flags, (n_envs,))


def action_dtype(space: spaces.Space) -> Any:
    """
    Choose the type of stored actions.

    :param space: of the actions
    :return: the type in which a buffer stores actions: those of a Box lie in [-1, 1], so that they are floats even if
        the space is one of integers
    """
    if space.dtype == np.float64 or (isinstance(space, spaces.Box) and not np.issubdtype(space.dtype, np.floating)):
        return np.float32
    return space.dtype
