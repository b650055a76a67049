"""Where files are, by Stable-Baselines3's rules, and whether they are pickled."""

import contextlib
import errno
import io
import os
import pathlib
from collections.abc import Iterator
from typing import IO, Any

from stable_baselines3.common.save_util import open_path

from sb3_sample.saving.untrusted import check_regular
from sb3_sample.warn import warn

PathOrFile = str | pathlib.Path | io.BufferedIOBase


def to_write(path: PathOrFile, suffix: str, *only: str) -> Any:
    """
    :param path: a path, to which the suffix is added if it has none, or a binary file open for writing
    :param suffix: without its dot
    :param only: if given, the only suffixes that count: a name with a dot in it, "lr0.001", may be the model's file,
        which is not to be overwritten
    :return: the path, in a folder that was made if it was not there, or the file
    :raises ValueError: if a file is not open for writing
    """
    if not isinstance(path, (str, pathlib.Path)):
        return open_path(path, "w")
    path = pathlib.Path(path)
    if path.suffix == "" or (only and path.suffix[1:] not in only):
        path = path.with_name(f"{path.name}.{suffix}")
    while path.is_dir():
        other = path.with_name(f"{path.name}_2")
        warn(f"Path {str(path)!r} is a folder, written is {str(other)!r} instead")
        path = other
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def find(path: PathOrFile, *suffixes: str, first: bool = False) -> Any:
    """
    :param path: a path, with or without a suffix, or a binary file open for reading
    :param suffixes: those that may have been added to it, without their dots, the likeliest first
    :param first: whether a file with one of the suffixes is likelier than one at the path itself
    :return: the path of the file that is there, or the file
    :raises FileNotFoundError: if there is none
    :raises ValueError: if a file is not open for reading
    """
    if not isinstance(path, (str, pathlib.Path)):
        return open_path(path, "r")
    path = pathlib.Path(path)
    candidates = [path, *(path.with_name(f"{path.name}.{suffix}") for suffix in suffixes)]
    if first:
        candidates = [*candidates[1:], path]
    for candidate in candidates:
        if candidate.exists() and not candidate.is_dir():
            return candidate
    tried = " and ".join(str(candidate) for candidate in candidates)
    raise FileNotFoundError(errno.ENOENT, f"{os.strerror(errno.ENOENT)} (looked for {tried})", str(path))


@contextlib.contextmanager
def opened(path: PathOrFile, *suffixes: str) -> Iterator[IO[bytes]]:
    """
    :param path: as in :func:`find`
    :param suffixes: as in :func:`find`
    :return: the file, which is closed afterwards if it was opened here
    :raises FileNotFoundError: if there is none
    :raises BadFile: if it is a pipe or a device
    """
    found = find(path, *suffixes)
    if isinstance(found, pathlib.Path):
        check_regular(found)
        with found.open("rb") as file:
            yield file
    else:
        yield found
