"""Log of the off-policy family beside the metrics of its gradient steps."""

from typing import Any

from sb3_sample.replay.buffers import ValidationSplit
from sb3_sample.training.metrics_log import MetricsLog


class FamilyLog(MetricsLog):
    """Part of an off-policy algorithm, before Stable-Baselines3's class: resets, the validation set, tasks."""

    def _rate_in_force(self: Any) -> float:
        rate = self.learner.scheduled_rate
        return super()._rate_in_force() if rate is None else float(rate)

    def _record_counts(self: Any) -> None:
        super()._record_counts()
        self.logger.record("plasticity/reset", self.plasticity.n_done)
        if isinstance(self.replay_buffer, ValidationSplit):
            self.logger.record("validation/size", self.replay_buffer.n_validation)

    def _record_tasks(self: Any) -> None:
        """
        Record each task's mean return and success rate over the episodes of ``ep_info_buffer``, which have the task's
        id from ``multi_task_env``. They are not shown in the terminal, where 50 tasks would be 100 lines.
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
        self._record_tasks()
        super().dump_logs()
