"""Gradient steps due for collected transitions, in every algorithm with a replay buffer."""

from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_sample.constructor import Given
from sb3_sample.warn import warn


def replacing_replay_ratio(passed: Mapping[str, Any]) -> str:
    """
    Find which of Stable-Baselines3's arguments replaces ``replay_ratio``.

    :param passed: arguments that were passed, by name
    :return: ``train_freq`` or ``gradient_steps`` with its value, in the form of the call; empty if neither was passed
    """
    for name in ("train_freq", "gradient_steps"):
        if passed.get(name) is not None:
            return f"{name}={passed[name]!r}"
    return ""


class UpdatesOwed:
    """
    Part of an algorithm with ``replay_ratio``, ``train_freq``, ``gradient_steps`` and ``_updates_owed``, before
    Stable-Baselines3's class.
    """

    @staticmethod
    def _settle_replay_ratio(given: Given) -> None:
        """
        Decide between ``replay_ratio`` and Stable-Baselines3's two arguments, which are 1 unless they were passed.

        :param given: arguments of the constructor, changed in place
        """
        if replacing := replacing_replay_ratio(given):
            if "replay_ratio" in given.passed and given["replay_ratio"] is not None:
                warn(f"replay_ratio={given['replay_ratio']!r} has no effect with {replacing}: pass one of the two")
            given["replay_ratio"] = None
        for name in "train_freq", "gradient_steps":
            given[name] = 1 if given[name] is None else given[name]

    @classmethod
    def _implied(cls, kwargs: dict[str, Any]) -> dict[str, Any]:
        implied: dict[str, Any] = super()._implied(kwargs)  # type: ignore[misc]
        replay_ratio = kwargs.get("replay_ratio")
        if replacing := replacing_replay_ratio(kwargs):
            if replay_ratio is not None:
                raise ValueError(f"replay_ratio={replay_ratio!r} has no effect with {replacing}: pass one of the two")
            implied["replay_ratio"] = None
        elif replay_ratio is not None:
            implied |= {"train_freq": 1, "gradient_steps": 1}
        return implied

    @classmethod
    def _completed(cls, content: Any, kwargs: dict[str, Any]) -> dict[str, Any]:
        kwargs = super()._completed(content, kwargs)  # type: ignore[misc]
        nothing = [name for name in ("train_freq", "gradient_steps") if kwargs.get(name, name) is None]
        return {**kwargs, **dict.fromkeys(nothing, 1)}

    @property
    def _tasks_together(self: Any) -> int:
        """Number of tasks that take a step together; 1 if a single environment has them one after the other."""
        return 1

    def _updates_in(self: Any, n_steps: int) -> float:
        """
        Count the gradient steps to come.

        :param n_steps: environment steps after the warm-up
        :return: gradient steps in them; 0 if unknown
        """
        if self.replay_ratio is not None:
            return float(self.replay_ratio * n_steps / self._tasks_together)
        assert isinstance(self.train_freq, TrainFreq)
        if self.gradient_steps < 0:
            return n_steps
        if self.train_freq.unit is TrainFrequencyUnit.EPISODE:
            return 0  # The length of episodes is unknown.
        return float(self.gradient_steps * n_steps / (self.n_envs * self.train_freq.frequency))

    def _updates_for(self: Any, n_collected: int) -> int:
        """
        Count the gradient steps due for transitions, and keep the fraction that a replay ratio leaves over.

        :param n_collected: transitions just collected, after the warm-up
        :return: gradient steps to take now
        """
        if self.replay_ratio is None:
            return self.gradient_steps if self.gradient_steps >= 0 else n_collected
        self._updates_owed += self.replay_ratio * n_collected / self._tasks_together
        # The tolerance keeps 10 times 0.1 from falling short of 1 by rounding.
        n_updates = int(self._updates_owed + 1e-6)
        self._updates_owed -= n_updates
        return n_updates
