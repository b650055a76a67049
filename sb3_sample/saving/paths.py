"""Where files are, by Stable-Baselines3's rules, and whether they are pickled."""

import contextlib
import io
import pathlib
import warnings
from collections.abc import Iterator
from typing import IO, Any

from stable_baselines3.common.save_util import open_path

from sb3_sample.saving.untrusted import check_regular

PathOrFile = str | pathlib.Path | io.BufferedIOBase


def to_write(path: PathOrFile, suffix: str) -> Any:
    """
    :param path: a path, to which the suffix is added if it has none, or a binary file open for writing
    :param suffix: without its dot
    :return: the path, in a folder that was made if it was not there, or the file
    :raises ValueError: if a file is not open for writing
    """
    if not isinstance(path, (str, pathlib.Path)):
        return open_path(path, "w")
    path = pathlib.Path(path)
    if path.suffix == "":
        path = path.with_name(f"{path.name}.{suffix}")
    while path.is_dir():
        other = path.with_name(f"{path.name}_2")
        warnings.warn(f"Path {str(path)!r} is a folder, written is {str(other)!r} instead", stacklevel=4)
        path = other
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


@contextlib.contextmanager
def opened(path: PathOrFile, suffix: str) -> Iterator[IO[bytes]]:
    """
    :param path: a path, with or without the suffix, or a binary file open for reading
    :param suffix: without its dot
    :return: the file, which is closed afterwards if it was opened here
    :raises FileNotFoundError: if there is none
    :raises BadFile: if it is a pipe or a device
    """
    if isinstance(path, (str, pathlib.Path)):
        for name in (path, f"{path}.{suffix}"):
            check_regular(name)
    file: Any = open_path(path, "r", suffix=suffix)
    try:
        yield file
    finally:
        if isinstance(path, (str, pathlib.Path)):
            file.close()
