"""Arrays that live in files of a folder, for replay buffers larger than the memory."""

import itertools
import math
import mmap
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any, NoReturn

import numpy as np

try:
    import fcntl
except ImportError:  # Windows, which does not let files in use be removed: that refuses a second run there
    fcntl = None  # type: ignore[assignment]

_LOCK, _FILES = "replay_buffer.lock", "replay_buffer.*.bin"
#: The folders that this process holds, by path: a second buffer of the same process makes files of its own there.
_HELD: dict[str, IO[str]] = {}
#: Of the files of this process: no name occurs twice, so that its buffers cannot meet in a file.
_NUMBERS = itertools.count()


class MemoryMap:
    """
    A folder with the arrays of one replay buffer. It is scratch memory: nothing is ever read from it by another
    process, and what an earlier run left there is replaced.

    :param folder: the folder; it is made if it is not there
    :param n_bytes: what the arrays will take
    :raises ValueError: if it cannot be written to, has not the space, or a living process has its buffer there
    """

    def __init__(self, folder: Any, n_bytes: int):
        if not isinstance(folder, (str, os.PathLike)) or not os.fspath(folder):
            raise ValueError(f"memory_map must be a folder, or None for the memory, not {folder!r}")
        self.folder = Path(folder).resolve()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._take_over()
            free = shutil.disk_usage(self.folder).free
        except OSError as error:
            raise ValueError(f"memory_map={str(folder)!r} must be a folder that can be written to: {error}") from error
        if n_bytes > free:
            raise ValueError(
                f"memory_map={str(folder)!r}: the replay buffer takes {n_bytes / 1e9:.2f} GB, and {free / 1e9:.2f} GB "
                "are free there: name a folder on another disk, or pass a smaller buffer_size"
            )

    def _take_over(self) -> None:
        """Hold the folder for as long as the process lives, and remove what is left of an earlier buffer."""
        lock, left = self.folder / _LOCK, list(self.folder.glob(_FILES))
        if left and not lock.exists():
            raise ValueError(
                f"memory_map={str(self.folder)!r} holds files that are no replay buffer's, as {left[0].name}"
            )
        if str(self.folder) not in _HELD:
            file = lock.open("a+")
            try:
                if fcntl is not None:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                owner = file.read().strip()
                file.close()
                raise ValueError(
                    f"memory_map={str(self.folder)!r} holds the replay buffer of another run, process {owner}: name a "
                    "folder of this run's own"
                ) from None
            file.truncate(0)
            file.write(f"{os.getpid()}\n")
            file.flush()
            _HELD[str(self.folder)] = file
        # An array of this process that still uses one of them keeps it until it is gone itself.
        for path in left:
            path.unlink()

    def zeros(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """
        :param shape: its shape
        :param dtype: its type
        :return: an array of zeros in a file of its own
        :raises OSError: if the disk has not the space
        """
        return self._mapped(self.folder / _FILES.replace("*", str(next(_NUMBERS))), shape, dtype, "w+b")

    def longer(self, array: Any, length: int) -> np.ndarray:
        """
        :param array: from :meth:`zeros`
        :param length: of the first axis
        :return: the same array, longer, its new part undefined; the old one is not to be used any more
        :raises OSError: if the disk has not the space
        """
        path = Path(array.filename)
        if not path.exists():
            # A later buffer of the process has the folder.
            grown = self.zeros((length, *array.shape[1:]), array.dtype)
            grown[: len(array)] = array
            return grown
        return self._mapped(path, (length, *array.shape[1:]), array.dtype, "r+b")

    def _mapped(self, path: Path, shape: tuple[int, ...], dtype: Any, mode: str) -> np.ndarray:
        size = max(math.prod(shape) * np.dtype(dtype).itemsize, 1)
        with path.open(mode) as file:
            if hasattr(os, "posix_fallocate"):
                # The space is taken now: a disk that is full at a later write to the array would kill the process.
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
            array = np.memmap(file, dtype=dtype, mode="r+", shape=shape)
        if hasattr(mmap, "MADV_RANDOM"):
            # Rows are drawn at random: what lies around them is not worth reading.
            array._mmap.madvise(mmap.MADV_RANDOM)  # type: ignore[attr-defined]
        return array

    def __reduce__(self) -> NoReturn:
        raise TypeError(f"a replay buffer with memory_map={str(self.folder)!r} cannot be pickled or copied")


def n_bytes(arrays: Iterable[tuple[tuple[int, ...], Any]]) -> int:
    """
    :param arrays: shape and type of each
    :return: how much memory they take
    """
    return sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in arrays)
