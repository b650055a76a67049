"""Open files that anybody may have written, with errors that say what is wrong with one."""

import json
import os
import pathlib
import stat
from typing import IO, Any

#: Largest number of characters of a message.
MAX_MESSAGE = 1000
#: A pipe does not block, and a terminal does not become this process's controlling one.
_FLAGS = sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC"))


class BadFile(ValueError):
    """
    A file that is damaged, of another kind, or not made by this package.

    :param message: what is wrong; cut if a file makes it longer than anybody reads
    """

    def __init__(self, message: str):
        super().__init__(message if len(message) <= MAX_MESSAGE else f"{message[:MAX_MESSAGE]} ...")


class PickledFile(BadFile):
    """A file that could run code when it is read."""


def open_regular(path: str | pathlib.Path) -> IO[bytes]:
    """
    :param path: of a regular file, or of a link to one
    :return: the file, open for reading
    :raises BadFile: if it is a pipe or a device, which may never end
    :raises OSError: if it cannot be opened, as a folder or a socket
    """
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | _FLAGS))  # noqa: SIM115
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise BadFile(f"{path} is no regular file")
    return file


def check_regular(path: str | pathlib.Path) -> None:
    """
    :param path: of something that other code is about to open
    :raises BadFile: if it is a pipe or a device, which may never end
    """
    try:
        kind = os.stat(path).st_mode
    except OSError:  # opening it will report the error, as for a folder
        return
    if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
        raise BadFile(f"{path} is no regular file")


def read_regular(path: str | pathlib.Path, limit: int) -> bytes:
    """
    :param path: of a regular file
    :param limit: largest size allowed, in bytes
    :return: its content
    :raises BadFile: if it is no regular file, or longer
    :raises OSError: if it cannot be read
    """
    with open_regular(path) as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise BadFile(f"{path} has more than the {limit:,} bytes that are allowed for such a file")
    return data


def parse_json(data: bytes, name: str) -> Any:
    """
    :param data: JSON, of a length that was limited
    :param name: what it is, for messages
    :return: the parsed value
    :raises BadFile: if it is no JSON, or nested too deeply
    """
    try:
        return json.loads(data)
    except RecursionError as error:
        raise BadFile(f"{name} is nested too deeply") from error
    except ValueError as error:
        raise BadFile(f"{name} is no JSON: {error}") from error
