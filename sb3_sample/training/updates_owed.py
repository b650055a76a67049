"""Gradient steps due for collected transitions, in every algorithm with a replay buffer."""

from typing import Any

from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit


class UpdatesOwed:
    """
    Part of an algorithm with ``replay_ratio``, ``train_freq``, ``gradient_steps`` and ``_updates_owed``, before
    Stable-Baselines3's class.
    """

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
