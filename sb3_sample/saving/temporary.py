"""
Temporary files that replace others when complete, and those left by a program that was killed before that.

A writer locks its temporary file, and the system releases the locks of a process that has ended: a file that can be
locked has no writer any more, on this machine or on another that shares the folder.
"""

import contextlib
import os
import re
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

_NAME = re.compile(r"\..+\.[0-9a-f]{12}\.tmp", re.DOTALL)


@contextlib.contextmanager
def becoming(path: Path) -> Iterator[IO[bytes]]:
    """
    A file beside another, which it replaces at the end, when all of it is on the disk.

    :param path: the other, which need not be there
    :return: the file, open for writing
    :raises OSError: it cannot be written; nothing of it is left then
    """
    while True:
        temporary = path.with_name(f".{path.name[:100]}.{secrets.token_hex(6)}.tmp")
        with temporary.open("xb") as file:
            # Before it was locked, another program may have taken it for abandoned.
            if lock(file.fileno()) is False or os.fstat(file.fileno()).st_nlink == 0:
                continue
            try:
                yield file
                file.flush()
                os.fsync(file.fileno())
                if fcntl is None:
                    file.close()  # Windows renames no open file
                os.replace(temporary, path)
            except BaseException:
                # Writing the rest of its buffer may fail once more.
                with contextlib.suppress(OSError):
                    file.close()
                temporary.unlink(missing_ok=True)
                raise
            return


def lock(descriptor: int, shared: bool = False) -> bool | None:
    """
    Lock a file, without waiting if another process has locked it.

    :param descriptor: of the open file
    :param shared: whether others may have a shared lock at the same time
    :return: whether this process has the lock now; None if the system or the file system has no locks
    """
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def is_temporary(name: str) -> bool:
    """
    :param name: of a file
    :return: whether it is the name of a temporary file
    """
    return _NAME.fullmatch(name) is not None


def remove_abandoned(folder: Path) -> None:
    """
    Remove the temporary files of this user in a folder whose writers are gone. Those that cannot be removed stay.

    :param folder: the folder
    """
    names: list[str] = []
    with contextlib.suppress(OSError):
        names = os.listdir(folder)
    for name in names:
        if is_temporary(name):
            with contextlib.suppress(OSError):
                _remove_if_abandoned(folder / name)


def _remove_if_abandoned(path: Path) -> None:
    facts = path.lstat()
    if fcntl is None or not stat.S_ISREG(facts.st_mode) or facts.st_uid != os.geteuid() or facts.st_nlink != 1:
        return
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if lock(descriptor):
            path.unlink()
    finally:
        os.close(descriptor)
