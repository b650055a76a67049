"""The log of a whole run in one file, however often it was interrupted."""

import collections
import contextlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.logger import KVWriter, filter_excluded_keys

from sb3_sample.saving.folders import Folder
from sb3_sample.saving.run_folder import LOG
from sb3_sample.warn import warn

#: Largest number of characters in the lines that are kept while they cannot be written.
MAX_PENDING = 2**20


class ProgressFile(KVWriter):
    """
    Appends a line of JSON for each time the log is written: ``{"step": ..., "train/critic_loss": ..., ...}``. Numbers
    are written so that they can be read back exactly.

    The training continues whether or not the file can be written: lines that cannot be written are kept for the next
    time, with a warning.

    :param folder: the run's folder; the file is opened by :meth:`restore`
    """

    def __init__(self, folder: Path):
        self.folder, self.path = folder, folder / LOG
        self._file = -1
        #: Bytes of the file that belong to the run.
        self._size = 0
        #: Lines that could not be written yet.
        self._pending: collections.deque[str] = collections.deque()
        self._warned = False

    def state(self) -> dict[str, Any]:
        """
        :return: how many bytes of the file belong to the run so far, which are on the disk when this returns, and the
            lines that are not in the file
        """
        self._flush()
        try:
            if self._file >= 0:
                os.fsync(self._file)
        except OSError as error:
            self._fail(error)
        return {"size": self._size, "pending": list(self._pending)}

    def restore(self, state: dict[str, Any]) -> None:
        """
        Cut off the lines written after the checkpoint, since they will be written again.

        :param state: from :meth:`state`
        :raises ValueError: it is something else
        """
        size, pending = state.get("size"), state.get("pending")
        lines = isinstance(pending, list) and all(isinstance(line, str) and line.isascii() for line in pending)
        if type(size) is not int or not 0 <= size < 2**63 or not isinstance(pending, list) or not lines:
            raise ValueError(f"{LOG} cannot go on: its size is no number of bytes, or its lines are no text")
        self._size, self._pending = size, collections.deque(pending)
        try:
            self._open()
        except OSError as error:
            self._fail(error)

    def _open(self) -> None:
        with Folder.at(self.folder) as folder:
            folder.separate(LOG)
            self._file = folder.descriptor(LOG, os.O_RDWR | os.O_CREAT)
        there = os.lseek(self._file, 0, os.SEEK_END)
        if there < self._size:
            warn(f"{self.path} has {there} bytes instead of {self._size}: lines are missing")
            self._size = there
        elif there > self._size:
            os.ftruncate(self._file, self._size)

    def _fail(self, error: OSError) -> None:
        """Warn that writing fails, once until it works again. The next attempt opens the file anew."""
        file, self._file = self._file, -1
        if file >= 0:
            # Half a line is cut off where that is possible; opening the file does it in any case.
            with contextlib.suppress(OSError):
                os.ftruncate(file, self._size)
            with contextlib.suppress(OSError):
                os.close(file)
        if not self._warned:
            self._warned = True
            warn(
                f"{self.path} cannot be written to ({error}): its lines are kept, the last {MAX_PENDING} characters of "
                "them. The training goes on."
            )

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """
        :param key_values: the log, by name
        :param key_excluded: formats that exclude a value, by its name; ours is called "json"
        :param step: environment steps
        """
        kept = filter_excluded_keys(key_values, key_excluded, "json")
        plain = {name: _plain(value) for name, value in kept.items()}
        line = {"step": step, **{name: value for name, value in plain.items() if value is not None}}
        self._pending.append(json.dumps(line) + "\n")
        self._flush()
        n_characters = sum(map(len, self._pending))
        while n_characters > MAX_PENDING:
            n_characters -= len(self._pending.popleft())

    def _flush(self) -> None:
        """Write what is pending, or keep it for the next time."""
        try:
            while self._pending:
                if self._file < 0:
                    self._open()
                data = self._pending[0].encode()
                os.lseek(self._file, self._size, os.SEEK_SET)
                if os.write(self._file, data) < len(data):
                    raise OSError(None, "only a part could be written", str(self.path))
                self._size += len(data)
                self._pending.popleft()
                self._warned = False
        except OSError as error:
            self._fail(error)

    def close(self) -> None:
        """Write what is pending and close the file."""
        self._flush()
        file, self._file = self._file, -1
        if file >= 0:
            try:
                os.close(file)
            except OSError as error:
                self._fail(error)


def _plain(value: Any) -> Any:
    """A number or string; None for values that a line cannot hold: pictures, videos, arrays."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, (np.ndarray, np.generic)):
        if value.size != 1:
            return None
        value = value.item()
    return value if isinstance(value, (bool, int, float, str)) else None
