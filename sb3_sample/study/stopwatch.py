"""Callback that measures what an environment step takes, and ends the training when that is known."""

import json
import time
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

#: Turns after the first gradient steps that are not counted: what is compiled or allocated once falls into them.
SKIPPED = 5


class Stopwatch(BaseCallback):
    """
    Measure the time between the beginnings of turns (collect, then learn), from some turns after the first gradient
    steps on.

    :param path: gets what was measured, as JSON: "steps" and their "seconds"
    :param seconds: how long to measure; at least one turn
    """

    def __init__(self, path: str, seconds: float):
        super().__init__()
        self.path, self.seconds = path, seconds
        self._turns = 0
        self._collects = False
        self._first: tuple[int, float] | None = None

    def _on_rollout_start(self) -> None:
        self._collects = True
        self._turn()

    def _turn(self) -> None:
        now = time.monotonic()
        if self._first is None:
            if self.model._n_updates == 0:
                return
            # A turn of PPO is as long as hundreds of SAC's.
            if self._turns == (0 if hasattr(self.model, "rollout_buffer") else SKIPPED):
                self._first = (self.num_timesteps, now)
            self._turns += 1
            return
        steps, seconds = self.num_timesteps - self._first[0], now - self._first[1]
        if seconds >= self.seconds and steps:
            Path(self.path).write_text(json.dumps({"steps": steps, "seconds": seconds}))

    def _on_step(self) -> bool:
        if not self._collects:  # on a data set, a turn is a step
            self._turn()
        return not Path(self.path).exists()
