"""Gradient steps that collected transitions call for, of every algorithm with a replay buffer."""

from typing import Any


class UpdatesOwed:
    """
    Part of an algorithm with ``replay_ratio``, ``gradient_steps`` and ``_updates_owed``, before Stable-Baselines3's
    class.
    """

    def _updates_for(self: Any, n_collected: int, n_tasks: int = 1) -> int:
        """
        Count the gradient steps of transitions, and keep the fraction that a replay ratio leaves over.

        :param n_collected: transitions just collected, after the warm-up
        :param n_tasks: tasks that they are of, together
        :return: gradient steps to take now
        """
        if self.replay_ratio is None:
            return self.gradient_steps if self.gradient_steps >= 0 else n_collected
        self._updates_owed += self.replay_ratio * n_collected / n_tasks
        # The tolerance keeps 10 times 0.1 from falling short of 1 by rounding.
        n_updates = int(self._updates_owed + 1e-6)
        self._updates_owed -= n_updates
        return n_updates
