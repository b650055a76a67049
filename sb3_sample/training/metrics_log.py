"""Metrics of the gradient steps in Stable-Baselines3's logger, for every algorithm with a replay buffer."""

from typing import Any

from stable_baselines3.common.logger import Logger

from sb3_sample.logged_values import LoggedValues


class MetricsLog:
    """
    Part of an algorithm with a learner, ``_metrics`` and ``_watch``, before Stable-Baselines3's class: what it logs,
    and when.
    """

    @property
    def logger(self: Any) -> Logger:
        """The logger. Metrics in it may be on the device until they are read."""
        if isinstance(self._logger, Logger):
            LoggedValues.of(self._logger)
        return self._logger

    @property
    def _metrics_wait(self: Any) -> bool:
        """Whether the host would wait for the device if it read a metric now."""
        return self.device.type != "cpu"

    def _record_metrics(self: Any) -> None:
        """Record the latest gradient step's metrics: numbers on a CPU, on a GPU values that become numbers if read."""
        if not hasattr(self, "_logger"):
            return  # There is no logger before ``learn`` or ``set_logger``.
        if self._metrics_wait:
            LoggedValues.record_later(self.logger, self._metrics)
        else:
            for name, value in self._metrics.items():
                self.logger.record(name, float(value.numpy()))
        self._record_counts()

    def _rate_in_force(self: Any) -> float:
        """Learning rate of the next gradient step."""
        return float(self.lr_schedule(self._current_progress_remaining))

    def _record_counts(self: Any) -> None:
        """Record numbers that are known whether or not a gradient step was taken."""
        self.logger.record("train/learning_rate", self._rate_in_force())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if self.learner.seconds_compiling > 0:
            self.logger.record("time/seconds_compiling", self.learner.seconds_compiling)

    def dump_logs(self: Any) -> None:
        """
        Write the log. On a GPU the host waits here for the metrics, at the latest.

        :raises TrainingDiverged: if one of them was NaN or infinite since the last time
        """
        self._watch.check()
        # Metrics of the latest gradient step are logged even if there was none since the last log, except those that a
        # callback has replaced.
        recorded = getattr(self.logger, "name_to_excluded", ())
        for name, value in self._metrics.items():
            if name not in recorded:
                self.logger.record(name, float(value))
        self._record_counts()
        super().dump_logs()  # type: ignore[misc]  # of Stable-Baselines3's algorithm
