"""A check at the vectorised environment of observations and rewards."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvStepReturn

from sb3_sample.envs.numbers import counts, outside

#: The largest number of single precision, in which buffers and networks compute: larger ones are infinite there.
LARGEST = float(np.finfo(np.float32).max)


class FiniteCheck:
    """
    Stop with an error when an environment gives a NaN, an infinity, or a number outside of a Discrete or MultiDiscrete
    space, before anything learns from it.

    The check sits at the innermost vectorised environment: ``VecNormalize`` would otherwise carry the value into its
    running statistics first. It takes the place of that environment's ``reset`` and ``step_wait`` instead of being one
    more wrapper, because Stable-Baselines3 compares the wrappers of the training and the evaluation environment
    (``sync_envs_normalization``).

    :param venv: the innermost vectorised environment
    """

    def __init__(self, venv: VecEnv):
        self._reset, self._step_wait = venv.reset, venv.step_wait
        space = venv.observation_space
        parts = space.spaces.items() if isinstance(space, spaces.Dict) else (("", space),)
        self._counting = {key: part for key, part in parts if counts(part)}
        self.n_steps = 0

    @classmethod
    def install(cls, venv: VecEnv) -> None:
        """
        Put the check into a vectorised environment, unless it is there.

        :param venv: a vectorised environment, wrapped or not
        """
        innermost = venv.unwrapped
        if not isinstance(getattr(innermost.step_wait, "__self__", None), cls):
            check = cls(innermost)
            innermost.reset, innermost.step_wait = check.reset, check.step_wait  # type: ignore[method-assign]

    def reset(self) -> Any:
        """
        :return: first observations, as the environment gave them
        :raises ValueError: if one is not finite, or outside of its space
        """
        observations = self._reset()
        self._check_observations("observation", observations, "at reset")
        return observations

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: the step's results, as the environment gave them
        :raises ValueError: if an observation or reward is not finite, or an observation lies outside of its space
        """
        observations, rewards, dones, infos = self._step_wait()
        self.n_steps += 1
        when = f"at its step {self.n_steps}"
        self._check("reward", rewards, when)
        self._check_observations("observation", observations, when)
        for index in np.flatnonzero(dones):
            terminal = infos[index].get("terminal_observation")
            if isinstance(terminal, dict):
                terminal = {key: np.asarray(value)[None] for key, value in terminal.items()}
            elif terminal is not None:
                terminal = np.asarray(terminal)[None]
            if terminal is not None:
                self._check_observations("last observation of the episode", terminal, when, offset=int(index))
        return observations, rewards, dones, infos

    def _check_observations(self, what: str, values: Any, when: str, offset: int = 0) -> None:
        self._check(what, values, when, offset)
        for key, space in self._counting.items():
            wrong = outside(space, values[key] if key else values)
            if wrong.any():
                index = int(wrong.argmax())
                raise ValueError(
                    f"environment {index + offset} gave {_named(what, key)} that is not of {space} {when}: "
                    f"{(values[key] if key else values)[index]!s:.300}. Training stopped before the value reached the "
                    "replay buffer."
                )

    @staticmethod
    def _check(what: str, values: Any, when: str, offset: int = 0) -> None:
        for key, array in values.items() if isinstance(values, dict) else (("", values),):
            if _is_fine(array):
                continue
            index = next(i for i in range(len(array)) if not _is_fine(np.asarray(array[i])))
            raise ValueError(
                f"environment {index + offset} gave {_named(what, key)} that is not finite {when}: "
                f"{array[index]!s:.300}. Allowed are finite numbers, up to {LARGEST:.3g}, the largest that networks "
                "take. Training stopped before the value reached the replay buffer."
            )


def _named(what: str, key: str) -> str:
    """Name of an environment's value, with its article, and its key in dict observations."""
    article = "an" if what == "observation" else "a"
    return f"{article} {what} {key!r}" if key else f"{article} {what}"


def _is_fine(array: np.ndarray) -> bool:
    """Whether all values are numbers that are finite in single precision."""
    kind = array.dtype.kind
    if kind == "f":
        if array.dtype.itemsize <= 4:
            return bool(np.isfinite(array).all())
        # No comparison with NaN holds.
        return bool((np.abs(array) <= LARGEST).all())
    # Any other values from a worker become an array of objects: None becomes NaN here.
    if kind != "O":
        # Integers (images) are always finite.
        return kind in "iub"
    try:
        return _is_fine(array.astype(np.float64))
    except (TypeError, ValueError, ArithmeticError):
        return False
