"""Metrics of the gradient steps in Stable-Baselines3's logger."""

from typing import Any

from stable_baselines3.common.logger import Logger

from sb3_sample.logged_values import LoggedValues
from sb3_sample.replay.buffers import ValidationSplit


class MetricsLog:
    """Part of an off-policy algorithm, before Stable-Baselines3's class: what it logs, and when."""

    @property
    def logger(self: Any) -> Logger:
        """The logger. Metrics in it may be on the device until somebody reads them."""
        if isinstance(self._logger, Logger):
            LoggedValues.of(self._logger)
        return self._logger

    @property
    def _metrics_wait(self: Any) -> bool:
        """Whether the host would wait for the device if it read a metric now."""
        return self.device.type != "cpu"

    def _record_metrics(self: Any) -> None:
        """Record the metrics of the latest gradient step: numbers on a CPU, on a GPU what becomes them when read."""
        if not hasattr(self, "_logger"):
            return  # There is none before ``learn`` or ``set_logger``.
        if self._metrics_wait:
            LoggedValues.record_later(self.logger, self._metrics)
        else:
            for name, value in self._metrics.items():
                self.logger.record(name, float(value.numpy()))
        self._record_counts()

    def _record_counts(self: Any) -> None:
        rate = self.learner.scheduled_rate
        if rate is None:
            rate = self.lr_schedule(self._current_progress_remaining)
        self.logger.record("train/learning_rate", rate)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if self.learner.seconds_compiling > 0:
            self.logger.record("time/seconds_compiling", self.learner.seconds_compiling)
        self.logger.record("plasticity/reset", self.plasticity.n_done)
        if isinstance(self.replay_buffer, ValidationSplit):
            self.logger.record("validation/size", self.replay_buffer.n_validation)

    def _record_tasks(self: Any) -> None:
        """
        Record each task's mean return and success rate over the episodes of ``ep_info_buffer``, which have the task's
        id from ``multi_task_env``. Not for the terminal, where 50 tasks would be 100 lines.
        """
        episodes: dict[str, list[dict[str, Any]]] = {}
        for episode in self.ep_info_buffer or ():
            if self.n_tasks > 1 and "task" in episode:
                episodes.setdefault(episode["task"], []).append(episode)
        for task_id, its in sorted(episodes.items()):
            self.logger.record(f"rollout_return/{task_id}", sum(e["r"] for e in its) / len(its), exclude="stdout")
            rates = [e["is_success"] for e in its if "is_success" in e]
            if rates:
                self.logger.record(f"rollout_success/{task_id}", sum(rates) / len(rates), exclude="stdout")

    def dump_logs(self: Any) -> None:
        """
        Write the log. On a GPU the host waits here for the metrics, at the latest.

        :raises TrainingDiverged: if one of them was NaN or infinite since the last time
        """
        self._watch.check()
        # Those of the latest gradient step also where there was none since the last time; a callback may have put
        # others in the place of those that there are.
        recorded = getattr(self.logger, "name_to_excluded", ())
        for name, value in self._metrics.items():
            if name not in recorded:
                self.logger.record(name, float(value))
        self._record_counts()
        self._record_tasks()
        super().dump_logs()  # type: ignore[misc]  # of Stable-Baselines3's algorithm
