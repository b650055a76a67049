"""Validate settings and running statistics of Stable-Baselines3's VecNormalize from files."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd

from sb3_sample.saving.untrusted import BadFile


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.floating, np.integer)) and not isinstance(value, bool)


def _is_limit(value: Any) -> bool:
    return _is_number(value) and value > 0


def _is_bool(value: Any) -> bool:
    return isinstance(value, (bool, np.bool_))


def _is_keys(value: Any) -> bool:
    return value is None or (isinstance(value, (list, tuple)) and all(isinstance(key, str) for key in value))


#: Check of each argument, and the allowed values in words.
_ALLOWED: dict[str, tuple[Callable[[Any], bool], str]] = {
    "training": (_is_bool, "True or False"),
    "norm_obs": (_is_bool, "True or False"),
    "norm_reward": (_is_bool, "True or False"),
    "clip_obs": (_is_limit, "a number above 0"),
    "clip_reward": (_is_limit, "a number above 0"),
    "gamma": (lambda value: _is_number(value) and 0 <= value <= 1, "a number in [0, 1]"),
    "epsilon": (lambda value: _is_number(value) and 0 <= value < math.inf, "a finite number of at least 0"),
    "norm_obs_keys": (_is_keys, "None or a list of names"),
}
#: The arguments of VecNormalize, which are its attributes' names.
ARGUMENTS = tuple(_ALLOWED)


def check_normalization(values: Mapping[str, Any], name: str) -> None:
    """
    :param values: the arguments of a ``VecNormalize``, and its statistics as far as it has some, by name
    :param name: where they are from, for messages
    :raises BadFile: if one of them cannot occur in the normalisation of a training
    """
    for key, (fits, words) in _ALLOWED.items():
        if not fits(values[key]):
            raise BadFile(f"{name}: {key} of a VecNormalize must be {words}, not {values[key]!r:.100}")
    for key in ("obs_rms", "ret_rms"):
        shapes_of(values.get(key), f"{name}: {key}")
    # The discounted sum of the rewards of each environment's episode, and the results of the last step.
    for key in ("returns", "old_reward", "old_obs"):
        check_finite_numbers(values.get(key), f"{name}: {key} of a VecNormalize")


def check_finite_numbers(value: Any, name: str) -> None:
    """
    :param value: an array, a dict of arrays, or None
    :param name: what it is, for messages
    :raises BadFile: if it is something else, or a number in it is not finite
    """
    for key, array in value.items() if isinstance(value, dict) else (("", value),):
        if array is not None and not (isinstance(array, np.ndarray) and _is_finite(array)):
            shown = f" {key!r:.100}" if key else ""
            raise BadFile(f"{name}{shown} must be finite numbers, not {array!r:.100}")


def shapes_of(statistics: Any, name: str) -> Any:
    """
    :param statistics: a ``RunningMeanStd``, a dict of them, or None
    :param name: where they are from, for messages
    :return: the shape of their means, None for None
    :raises BadFile: if they are something else, or not possible as statistics
    """
    if statistics is None:
        return None
    if isinstance(statistics, dict):
        return {key: shapes_of(part, f"{name}[{key!r:.100}]") for key, part in statistics.items()}
    if not isinstance(statistics, RunningMeanStd):
        raise BadFile(f"{name} holds no statistics")
    mean, var, count = statistics.mean, statistics.var, statistics.count
    if not (_is_finite(mean) and _is_finite(var)) or np.shape(mean) != np.shape(var) or (np.asarray(var) < 0).any():
        raise BadFile(f"{name} holds no statistics: mean and variance must be finite and of one shape, no variance < 0")
    if not (_is_number(count) and 0 < count < math.inf):
        raise BadFile(f"{name} holds no statistics: count must be a finite number above 0, not {count!r:.100}")
    return np.shape(mean)


def _is_finite(value: Any) -> bool:
    """Whether numbers are real and finite."""
    array = np.asarray(value)
    return array.dtype.kind in "fiub" and bool(np.isfinite(array).all())
