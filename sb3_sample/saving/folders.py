"""
Access to the files of a folder that somebody else may have filled: regular files only, by plain names from the folder
itself, never through a link.
"""

import contextlib
import errno
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

#: Whether the system opens files relative to an open folder, so that no part of their path can be exchanged meanwhile.
_AT = os.open in os.supports_dir_fd and os.scandir in os.supports_fd
_READ = os.O_RDONLY | getattr(os, "O_BINARY", 0)
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
#: A link is an error, a pipe does not block, and a terminal does not become this process's controlling one.
_GUARD = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC"))


class NotPlain(OSError):
    """A link, a pipe or a device where a file or a folder has to be."""


def is_plain(name: Any) -> bool:
    """
    :param name: anything
    :return: whether it is the name of something in a folder, and leads nowhere else
    """
    return isinstance(name, str) and name not in ("", ".", "..") and not set(name) & {"/", "\\", "\0", os.sep}


class Folder:
    """
    An open folder. Names with more than one part are refused.

    :param path: of the folder, for messages, and to reach its files where the system knows no other way
    :param descriptor: of the open folder; None where the system has none
    """

    def __init__(self, path: Path, descriptor: int | None):
        self.path, self._descriptor = path, descriptor

    @classmethod
    @contextlib.contextmanager
    def at(cls, path: Path) -> Iterator["Folder"]:
        """
        :param path: of a folder that the caller names, which may itself be a link
        :return: the folder, closed afterwards
        :raises OSError: it cannot be opened
        """
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC) if _AT else None
        with cls(path, descriptor)._closing() as folder:
            yield folder

    @contextlib.contextmanager
    def _closing(self) -> Iterator["Folder"]:
        try:
            yield self
        finally:
            if self._descriptor is not None:
                os.close(self._descriptor)

    def _place(self, name: str) -> dict[str, Any]:
        """Arguments that name a file to functions of ``os``."""
        if not is_plain(name):
            raise NotPlain(errno.EINVAL, "is no plain name of a file", name)
        if self._descriptor is None:
            return {"path": self.path / name}
        return {"path": name, "dir_fd": self._descriptor}

    # ---------------------------------------------------------------- looking

    def names(self) -> list[str]:
        """
        :return: the names of everything in it, sorted
        """
        with os.scandir(self.path if self._descriptor is None else self._descriptor) as entries:
            return sorted(entry.name for entry in entries)

    def look(self, name: str) -> os.stat_result | None:
        """
        :param name: of something in it
        :return: its status, of a link itself and not of its target; None if it is not there
        """
        try:
            return os.stat(**self._place(name), follow_symlinks=False)
        except FileNotFoundError:
            return None

    def is_link(self, name: str) -> bool:
        """
        :param name: of something in it
        :return: whether it is a link
        """
        found = self.look(name)
        return found is not None and stat.S_ISLNK(found.st_mode)

    # ---------------------------------------------------------------- opening

    @contextlib.contextmanager
    def inside(self, name: str) -> Iterator["Folder"]:
        """
        :param name: of a folder in it
        :return: that folder, closed afterwards
        :raises NotPlain: it is a link
        :raises OSError: it cannot be opened
        """
        self._refuse_link(name)
        descriptor = os.open(**self._place(name), flags=_READ | _GUARD | os.O_DIRECTORY) if _AT else None
        with Folder(self.path / name, descriptor)._closing() as folder:
            yield folder

    def descriptor(self, name: str, flags: int) -> int:
        """
        :param name: of a file in it
        :param flags: as ``os.open`` takes them
        :return: a descriptor of the file
        :raises NotPlain: it is a link, a pipe, a device or a folder; or it is to be written to, and has further names
            (hard links)
        :raises OSError: it cannot be opened
        """
        self._refuse_link(name)
        opened = _above_the_standard_streams(os.open(**self._place(name), flags=flags | _GUARD, mode=0o644))
        try:
            facts = os.fstat(opened)
            if not stat.S_ISREG(facts.st_mode):
                raise NotPlain(errno.EINVAL, "is no regular file", str(self.path / name))
            if flags & (os.O_WRONLY | os.O_RDWR) and facts.st_nlink > 1:
                raise NotPlain(errno.EMLINK, "is a file elsewhere, too (a hard link)", str(self.path / name))
        except BaseException:
            os.close(opened)
            raise
        return opened

    def _refuse_link(self, name: str) -> None:
        # Opening a link fails too, with another error on each system.
        if self.is_link(name):
            raise NotPlain(errno.ELOOP, "is a link, and none is followed there", str(self.path / name))

    def read(self, name: str) -> IO[bytes]:
        """
        :param name: of a file in it
        :return: the file, open for reading
        :raises NotPlain: it is no regular file
        :raises OSError: it cannot be read
        """
        return open(self.path / name, "rb", opener=lambda _, __: self.descriptor(name, _READ))

    def create(self, name: str) -> IO[bytes]:
        """
        :param name: of a file that is not there yet
        :return: the file, open for writing
        :raises OSError: it is there, or cannot be made
        """
        return open(self.path / name, "xb", opener=lambda _, __: self.descriptor(name, _NEW))

    # ---------------------------------------------------------------- changing

    def separate(self, name: str) -> None:
        """
        Replace a file that has further names (hard links, as ``cp -al`` makes) by a copy, so that writing to it changes
        nothing elsewhere.

        :param name: of a file in it, which need not be there
        """
        found = self.look(name)
        if found is None or not stat.S_ISREG(found.st_mode) or found.st_nlink == 1:
            return
        beside = f".{name}.{secrets.token_hex(6)}"
        try:
            with self.read(name) as source, self.create(beside) as copy:
                shutil.copyfileobj(source, copy)
            self.rename(beside, name)
        except BaseException:
            self.remove(beside)
            raise

    def make(self, name: str) -> None:
        """
        :param name: of a folder that is to be made in it
        """
        os.mkdir(**self._place(name))

    def rename(self, old: str, new: str) -> None:
        """
        :param old: name of something in it
        :param new: its new name; a file there is replaced
        """
        source, target = self._place(old), self._place(new)
        if self._descriptor is None:
            os.replace(source["path"], target["path"])
        else:
            os.rename(old, new, src_dir_fd=self._descriptor, dst_dir_fd=self._descriptor)

    def remove(self, name: str) -> None:
        """
        :param name: of a file in it, or of a link, which is removed itself, not its target; nothing happens if it is
            not there
        """
        with contextlib.suppress(FileNotFoundError):
            os.unlink(**self._place(name))

    def remove_folder(self, name: str) -> None:
        """
        :param name: of an empty folder in it
        """
        os.rmdir(**self._place(name))


def _above_the_standard_streams(descriptor: int) -> int:
    """
    A descriptor of the same file whose number is not that of a standard stream. Such a number is free if the program
    has closed the stream, and its output would then be written into the file.
    """
    if descriptor > 2 or fcntl is None:
        return descriptor
    try:
        return fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 3)
    finally:
        os.close(descriptor)
