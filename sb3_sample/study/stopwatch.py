"""Callback that measures the time of an environment step and then ends the training."""

import json
import time
from pathlib import Path

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sample.saving.rings import Ring

#: Turns after the first gradient steps that are not counted, since one-time compiling and allocation falls into them.
SKIPPED = 5
#: Rows of the replay buffer whose bytes are counted.
_ROWS = 100


class Stopwatch(BaseCallback):
    """
    Measure the time between the starts of turns (collect, then learn), beginning some turns after the first gradient
    steps.

    :param path: JSON file for the results: "steps", their "seconds", and "bytes_of_step", of the replay buffer in
        checkpoints
    :param seconds: how long to measure; at least one turn, and at most the run
    """

    def __init__(self, path: str, seconds: float):
        super().__init__()
        self.path, self.seconds = path, seconds
        self._turns = 0
        self._collects = False
        self._first: tuple[int, float] | None = None
        self._last: tuple[int, float] | None = None

    def _on_rollout_start(self) -> None:
        self._collects = True
        self._turn()

    def _turn(self) -> None:
        now = time.monotonic()
        if self._first is None:
            if self.model._n_updates == 0:
                return
            # A turn of PPO takes as long as hundreds of SAC's.
            if self._turns == (0 if hasattr(self.model, "rollout_buffer") else SKIPPED):
                self._first = (self.num_timesteps, now)
            self._turns += 1
            return
        self._last = (self.num_timesteps, now)
        if now - self._first[1] >= self.seconds:
            self._write()

    def _write(self) -> None:
        if self._first is None or self._last is None:
            return
        steps, seconds = self._last[0] - self._first[0], self._last[1] - self._first[1]
        if steps:
            # A data set is not saved with the run.
            buffer = getattr(self.model, "replay_buffer", None) if self._collects else None
            found = {"steps": steps, "seconds": seconds, "bytes_of_step": 0.0 if buffer is None else _bytes(buffer)}
            Path(self.path).write_text(json.dumps(found))

    def _on_training_end(self) -> None:
        if not Path(self.path).exists():  # the run was shorter than the measurement
            self._write()

    def _on_step(self) -> bool:
        if not self._collects:  # on a data set, a turn is a step
            self._turn()
        return not Path(self.path).exists()


def _bytes(buffer: ReplayBuffer) -> float:
    """Bytes of an environment step in the form in which checkpoints save it."""
    ring = Ring(buffer, lambda: 0)
    n_rows = min(ring.size(), _ROWS)
    rows = ring.rows(ring.n_rows - n_rows)
    return sum(array.nbytes for array in rows.values()) / max(n_rows * buffer.n_envs, 1)
