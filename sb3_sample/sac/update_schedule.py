"""How many gradient steps follow the environment steps."""

from typing import Any

from sb3_sample.replay.buffers import ValidationSplit
from sb3_sample.replay.weighted import PrioritizedReplay
from sb3_sample.sac import checks
from sb3_sample.training.compiling import DecidesCompiling
from sb3_sample.training.updates_owed import UpdatesOwed
from sb3_sample.warn import warn


class UpdateSchedule(DecidesCompiling, UpdatesOwed):
    """Part of an off-policy algorithm, before Stable-Baselines3's class: when it learns, and how many steps at once."""

    def _before_turns(self: Any) -> None:
        """
        Plan the gradient steps of the first ``learn``, and decide, with ``compile="auto"`` once and for all, whether
        the coming environment steps pay for compiling.
        """
        checks.check_one_reward_scale(self)
        if self._learns_from is None and self.prior_data is not None:
            self._tell_of(self.prior_data)
        checks.check_scale_is_known(self)
        if self.replay_ratio is not None and self.gradient_steps != 1:
            warn(
                f"gradient_steps={self.gradient_steps} was assigned, and has no effect beside replay_ratio="
                f"{self.replay_ratio}: assign replay_ratio, or replay_ratio=None too"
            )
        n_steps = self._total_timesteps - self.num_timesteps
        if self._n_updates == 0:
            # A ``learn`` that ended before its first gradient step leaves no plan.
            self.planned_updates = self.schedule_steps
        if self.learning_rate_schedule is not None and self.planned_updates is None:
            # Of a run that goes on in its warm-up, the steps before count as well.
            begin = self._num_timesteps_at_start if self._n_updates == 0 else self.num_timesteps
            # Optimizers count their steps over the model's life.
            coming = round(self._updates_in(self._total_timesteps - begin))
            self.planned_updates = self._n_updates + coming if coming else None
            # With a replay ratio of 0, or less than one step in all, a later call that takes some plans them. So does
            # ``train`` itself where ``learn`` is to take none.
            is_unknown = self.replay_ratio is None and self.gradient_steps != 0
            if self.planned_updates is None and n_steps > 0 and is_unknown:
                raise ValueError(
                    f"schedule_steps must be given, as learning_rate_schedule={self.learning_rate_schedule!r} needs to "
                    "know how many gradient steps are planned, and the arguments do not say it"
                )
        n_of_warm_up = 0 if self._learns_from is not None else max(self.learning_starts - self.num_transitions, 0)
        coming = self._updates_in(n_steps - n_of_warm_up)
        self._warn_of_rate_zero(coming)
        self._decide_compiling(coming)

    def _warn_of_rate_zero(self: Any, coming: float) -> None:
        """Warn if the critics' learning rate is 0 in some of the coming gradient steps, since the plan ends before."""
        schedule, planned = self.learner.schedule, self.planned_updates
        if schedule is None or planned is None or schedule.end > 0:
            return
        # A part of a step, that a replay ratio leaves over, is none.
        at_zero = int(min(self._n_updates + coming - planned, coming))
        if at_zero > 1:
            warn(
                f"in {at_zero:,} of the {int(coming):,} coming gradient steps the critics' learning rate is "
                f"final_learning_rate=0: they come after the {planned:,} planned ones of learning_rate_schedule="
                f"{self.learning_rate_schedule!r}. Pass schedule_steps=, the gradient steps of all training, or "
                "final_learning_rate=, to the constructor or to load"
            )

    @property
    def _tasks_together(self: Any) -> int:
        return min(self.n_tasks, self.n_envs)

    def _updates_in(self: Any, n_steps: int) -> float:
        return n_steps if self._learns_from is not None else super()._updates_in(n_steps)

    def _after_turns(self: Any) -> None:
        """Warn if nothing was learned because there were too few steps; the next ``learn`` then plans."""
        if self._n_updates == 0:
            self.planned_updates = self.schedule_steps
        wanted = self.gradient_steps if self.replay_ratio is None else self.replay_ratio
        if self._n_updates > 0 or self.num_transitions == 0 or wanted == 0 or not self._is_warming_up():
            return
        assert self.replay_buffer is not None
        warn(
            f"learn ended without a single gradient step: learning_starts={self.learning_starts} transitions come "
            f"before the first, and the replay buffer has {self.replay_buffer.size() * self.n_envs} of the "
            f"{self.num_transitions} of this model's life. Train for more than {self.learning_starts} steps, or pass a "
            "smaller learning_starts= to the constructor or to load (Stable-Baselines3's SAC has 100)"
        )

    def _is_warming_up(self: Any) -> bool:
        """Whether there are too few transitions for a gradient step."""
        assert self.replay_buffer is not None
        if self._n_of_warm_up <= self.learning_starts:
            return True
        # A model loaded without its buffer fills the buffer first, acting by its learned policy.
        capacity = self.replay_buffer.buffer_size * self.n_envs
        return self._n_in_buffer < min(self.learning_starts, capacity)

    @property
    def _n_of_warm_up(self: Any) -> int:
        """Transitions over the model's life, which ``learning_starts`` counts."""
        return self.num_transitions

    @property
    def _n_in_buffer(self: Any) -> int:
        """Transitions in the replay buffer, counted in the same way."""
        assert self.replay_buffer is not None
        return self.replay_buffer.size() * self.n_envs

    def _updates_due(self: Any, n_collected: int) -> int:
        """
        :param n_collected: transitions just collected
        :return: gradient steps to take now
        """
        if self._is_warming_up():
            return 0
        if isinstance(self.replay_buffer, ValidationSplit) and self.replay_buffer.n_training == 0:
            return 0
        if isinstance(self.replay_buffer, PrioritizedReplay) and self.replay_buffer.n_drawable == 0:
            return 0
        return self._updates_for(n_collected)  # type: ignore[no-any-return]
