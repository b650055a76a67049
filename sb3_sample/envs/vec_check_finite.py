"""A check at the vectorised environment that observations and rewards are finite."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvStepReturn, VecEnvWrapper


class VecCheckFinite(VecEnvWrapper):
    """
    Stop with an error when an environment gives a NaN or an infinity, before anything learns from it.

    It belongs right around the innermost vectorised environment: ``VecNormalize`` would otherwise carry the
    value into its running statistics first (see ``insert``).

    :param venv: the vectorised environment
    """

    def __init__(self, venv: VecEnv):
        super().__init__(venv)
        self.n_steps = 0

    @classmethod
    def insert(cls, venv: VecEnv) -> VecEnv:
        """
        Put the check around the innermost vectorised environment, below wrappers that are there already;
        do nothing if it is there.

        :param venv: a vectorised environment, wrapped or not
        :return: the outermost environment
        """
        outer: VecEnvWrapper | None = None
        inner = venv
        while isinstance(inner, VecEnvWrapper):
            if isinstance(inner, cls):
                return venv
            outer, inner = inner, inner.venv
        if outer is None:
            return cls(inner)
        outer.venv = cls(inner)
        return venv

    def reset(self) -> Any:
        observations = self.venv.reset()
        self._check("observation", observations, "at reset")
        return observations

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        self.n_steps += 1
        when = f"at its step {self.n_steps}"
        self._check("reward", rewards, when)
        self._check("observation", observations, when)
        for index in np.flatnonzero(dones):
            terminal = infos[index].get("terminal_observation")
            if terminal is not None:
                batched = {k: v[None] for k, v in terminal.items()} if isinstance(terminal, dict) else terminal[None]
                self._check("last observation of the episode", batched, when, offset=int(index))
        return observations, rewards, dones, infos

    def _check(self, what: str, values: Any, when: str, offset: int = 0) -> None:
        for key, array in values.items() if isinstance(values, dict) else (("", values),):
            # Integers (images) are always finite.
            if array.dtype.kind != "f" or np.isfinite(array).all():
                continue
            index = int(np.argwhere(~np.isfinite(array))[0][0])
            name = f"{what} {key!r}" if key else what
            raise ValueError(
                f"environment {index + offset} gave a {name} that is not finite {when}: {array[index]}. Allowed are "
                "finite numbers. Training stopped before the value reached the replay buffer."
            )
