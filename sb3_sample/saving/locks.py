"""
Locks of files and folders that this process holds: its forked children do not have them, and a process that has ended
has none.
"""

import contextlib
import errno
import os
import weakref
from pathlib import Path

from sb3_sample.saving import temporary

#: Locks that this process has. Workers that are forked later must not keep them.
_HELD: weakref.WeakSet["Lock"] = weakref.WeakSet()


def _let_go() -> None:
    for lock in list(_HELD):
        lock.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go)


class Lock:
    """
    Lock of a file or folder, held until ``release`` or the end of the process.

    :param descriptor: of the open file or folder, which this process has locked
    """

    def __init__(self, descriptor: int):
        self._descriptor: int | None = descriptor
        _HELD.add(self)

    def write(self, text: str) -> None:
        """
        :param text: who has the lock, for readers of the file; it stays there
        """
        if self._descriptor is not None:
            os.ftruncate(self._descriptor, 0)
            os.write(self._descriptor, text.encode())

    def release(self) -> None:
        """Let others have it. More than one call does no harm."""
        descriptor, self._descriptor = self._descriptor, None
        _HELD.discard(self)
        if descriptor is not None:
            os.close(descriptor)

    def __enter__(self) -> "Lock":
        return self

    def __exit__(self, *error: object) -> None:
        self.release()


def _without_locks(path: Path) -> OSError:
    return OSError(errno.ENOLCK, "the system or the file system has no locks", str(path))


def is_taken(path: Path) -> bool:
    """
    Whether a process has the lock of a file. The file is only read, since its folder may be one that cannot be written
    to.

    :param path: of the file
    :return: whether it is there and locked
    :raises OSError: the file cannot be read, or its file system has no locks
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
    except FileNotFoundError:
        return False
    try:
        held = temporary.lock(descriptor, shared=True)
    finally:
        os.close(descriptor)
    if held is None:
        raise _without_locks(path)
    return not held


def take_folder(folder: Path) -> Lock | None:
    """
    Lock a folder, without waiting and without a file in it.

    :param folder: the folder
    :return: the lock; None where folders cannot be locked (on Windows, and in some network file systems)
    :raises FileNotFoundError: the folder is not there, or was removed meanwhile
    :raises BlockingIOError: another process has it, on this machine or on another that shares the folder
    """
    if not hasattr(os, "O_DIRECTORY"):
        return None
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    with contextlib.ExitStack() as on_return:
        on_return.callback(os.close, descriptor)
        held = temporary.lock(descriptor)
        if held is False:
            raise BlockingIOError(errno.EAGAIN, "another process has locked it", str(folder))
        if not os.path.samestat(os.fstat(descriptor), os.stat(folder)):
            raise FileNotFoundError(errno.ENOENT, "it was replaced while it was locked", str(folder))
        if held:
            on_return.pop_all()
            return Lock(descriptor)
    return None


def take(path: Path) -> Lock | None:
    """
    Lock a file, without waiting.

    :param path: of the file, made if it is not there
    :return: the lock; None while another process has it, on this machine or on another that shares the folder
    :raises OSError: the file cannot be opened, or its file system has no locks
    """
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o644)
        with contextlib.ExitStack() as on_return:
            on_return.callback(os.close, descriptor)
            held = temporary.lock(descriptor)
            if held is None:
                raise _without_locks(path)
            if held is False:
                return None
            # If the file was removed since it was opened, others would lock another one of its name.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                    on_return.pop_all()
                    return Lock(descriptor)
