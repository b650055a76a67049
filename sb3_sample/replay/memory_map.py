"""Arrays in files, for replay buffers larger than the memory."""

import math
import mmap
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np


def n_bytes(shape: tuple[int, ...], dtype: Any) -> int:
    """
    Compute the size of an array.

    :param shape: of an array
    :param dtype: of an array
    :return: its bytes
    """
    return math.prod(shape) * np.dtype(dtype).itemsize


def check_folder(folder: Any, needed: int) -> str:
    """
    Check that a folder can hold the files, and make it.

    :param folder: folder of the files; made if it is missing
    :param needed: how many bytes they will have
    :return: its path
    :raises ValueError: if files cannot be written there, or the disk lacks the space
    """
    if not isinstance(folder, (str, os.PathLike)) or not os.fspath(folder):
        raise ValueError(f"memory_map must be a folder, or None for the memory, not {folder!r}")
    path = Path(folder).absolute()
    try:
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()
        free = shutil.disk_usage(path).free
    except OSError as error:
        raise ValueError(
            f"memory_map={os.fspath(folder)!r} must be a folder that can be written to: {error}"
        ) from error
    if needed > free:
        raise ValueError(
            f"memory_map={os.fspath(folder)!r} has {free / 1e9:.2f} GB free, and {needed / 1e9:.2f} GB are needed: "
            "name a folder on another disk, or store less (for a replay buffer: a smaller buffer_size)"
        )
    return str(path)


def zeros(folder: str | None, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """
    Make an array in memory or in a file.

    :param folder: folder of the file; None for the memory
    :param shape: its shape
    :param dtype: its type
    :return: an array of zeros. The file has no name and is freed with the array: no other run can open it, and nothing
        is left of it when the process is killed
    :raises OSError: if the disk lacks the space
    """
    size = n_bytes(shape, dtype)
    if folder is None or size == 0:
        return np.zeros(shape, dtype=dtype)
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            if hasattr(os, "posix_fallocate"):
                # The space is allocated now: a disk that is full at a later write to the array would kill the process.
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
            mapped = mmap.mmap(file.fileno(), size)
    except OSError as error:
        what = f"{error.strerror}, for {size / 1e9:.3f} GB of a replay buffer with memory_map"
        raise OSError(error.errno, what, folder) from error
    if hasattr(mmap, "MADV_RANDOM"):
        # Rows are drawn at random: their neighbours are not worth reading.
        mapped.madvise(mmap.MADV_RANDOM)
    return np.frombuffer(mapped, dtype=dtype).reshape(shape)


def moved(folder: str, array: np.ndarray) -> np.ndarray:
    """
    Copy an array into a file.

    :param folder: folder of the file
    :param array: an array
    :return: the same in a file
    """
    copy = zeros(folder, array.shape, array.dtype)
    copy[...] = array
    return copy
