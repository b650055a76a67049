"""The log of a whole run in one file, however often it was interrupted."""

import json
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.logger import KVWriter, filter_excluded_keys

FILE = "progress.jsonl"


class ProgressFile(KVWriter):
    """
    Appends a line of JSON for each time the log is written: ``{"step": ..., "train/critic_loss": ..., ...}``. Numbers
    are written so that they are read back bit by bit.

    :param folder: the run's folder
    """

    def __init__(self, folder: Path):
        self.path = folder / FILE
        self._file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        self._size = os.lseek(self._file, 0, os.SEEK_END)
        #: Lines that could not be written yet.
        self._pending: list[str] = []
        self._warned = False

    def state(self) -> dict[str, Any]:
        """
        :return: how much of the file belongs to the run so far; it is on the disk when this returns
        """
        self._flush()
        os.fsync(self._file)
        return {"size": self._size, "pending": list(self._pending)}

    def restore(self, state: dict[str, Any]) -> None:
        """
        Cut back what was written after the checkpoint, since it will be written once more.

        :param state: from :meth:`state`
        """
        if self._size < state["size"]:
            warnings.warn(
                f"{self.path} has {self._size} bytes, {state['size']} at the checkpoint: lines are missing",
                stacklevel=5,
            )
        self._size = min(self._size, state["size"])
        os.ftruncate(self._file, self._size)
        self._pending = list(state["pending"])

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """
        :param key_values: the log, by name
        :param key_excluded: formats that shall not have it, by name; ours is called "json"
        :param step: environment steps
        """
        kept = filter_excluded_keys(key_values, key_excluded, "json")
        plain = {name: _plain(value) for name, value in kept.items()}
        line = {"step": step, **{name: value for name, value in plain.items() if value is not None}}
        self._pending.append(json.dumps(line) + "\n")
        self._flush()

    def _flush(self) -> None:
        """Write what is pending, or keep it for the next time: a full disk does not end the training."""
        while self._pending:
            data = self._pending[0].encode()
            try:
                os.lseek(self._file, self._size, os.SEEK_SET)
                if os.write(self._file, data) < len(data):
                    raise OSError(None, "only a part could be written", str(self.path))
            except OSError as error:
                os.ftruncate(self._file, self._size)
                if not self._warned:
                    warnings.warn(f"{self.path} cannot be written to ({error}): its lines are kept", stacklevel=4)
                    self._warned = True
                return
            self._size += len(data)
            self._warned = False
            self._pending.pop(0)

    def close(self) -> None:
        """Write what is pending and close the file."""
        if self._file >= 0:
            self._flush()
            os.close(self._file)
            self._file = -1


def _plain(value: Any) -> Any:
    """A number or string; None for what has no place in a line: pictures, videos, arrays."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, (np.ndarray, np.generic)):
        if value.size != 1:
            return None
        value = value.item()
    return value if isinstance(value, (bool, int, float, str)) else None
