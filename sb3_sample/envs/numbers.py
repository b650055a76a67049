"""Numbers of Discrete and MultiDiscrete spaces, which networks read as one-hot vectors."""

from typing import Any

import numpy as np
from gymnasium import spaces


def counts(space: spaces.Space[Any]) -> bool:
    """
    :param space: of one observation, or of a part of one
    :return: whether its numbers are read as one-hot vectors
    """
    return isinstance(space, (spaces.Discrete, spaces.MultiDiscrete))


def outside(space: spaces.Space[Any], values: Any) -> np.ndarray:
    """
    Find numbers outside of their space.

    :param space: a Discrete or MultiDiscrete space
    :param values: numbers of one or several observations
    :return: whether an observation has a number outside of the space, (n,)
    """
    assert isinstance(space, (spaces.Discrete, spaces.MultiDiscrete))
    first = np.asarray(space.start)
    last = first + np.asarray(space.n if isinstance(space, spaces.Discrete) else space.nvec) - 1
    given = np.asarray(values).reshape(-1, *first.shape)
    wrong: np.ndarray = ((given < first) | (given > last)).reshape(len(given), -1).any(axis=1)
    return wrong


def check_numbers(name: str, space: spaces.Space[Any], values: Any) -> None:
    """
    Check that numbers are of their space.

    :param name: name of the observations, for the error
    :param space: observation space
    :param values: one or several observations of it, or a dict of their parts; parts that are left out are not checked
    :raises ValueError: if a number of a Discrete or MultiDiscrete part lies outside of its space
    """
    if isinstance(space, spaces.Dict):
        for key in space.spaces.keys() & values.keys():
            check_numbers(f"{name}[{key!r}]", space[key], values[key])
    elif counts(space):
        wrong = outside(space, values)
        if wrong.any():
            bad = np.asarray(values).reshape(len(wrong), -1)[wrong][0]
            raise ValueError(f"{name} must be numbers of {space}, not {bad[0] if len(bad) == 1 else bad}")
