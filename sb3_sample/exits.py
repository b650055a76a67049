"""How ``sb3-sample`` ends when it refuses something, or is interrupted; packages that it is to import."""

import importlib
import sys
from collections.abc import Iterable
from typing import NoReturn

#: The process's exit code, the same as after a wrong option.
CODE = 2
#: The exit code after Ctrl-C, as in shells: 128 plus the number of SIGINT.
INTERRUPTED = 130
_MAX = 2000


class Refusal(SystemExit):
    """
    The end of a command that has printed the reason.

    :param message: the printed line
    """

    def __init__(self, message: str):
        super().__init__(message)
        self.code = CODE


def refuse(command: str, reason: object) -> NoReturn:
    """
    End the process with one line on stderr and exit code 2.

    :param command: name of the command; none if empty
    :param reason: the reason; text from a file is not trusted to be one line, short or printable
    :raises Refusal: always
    """
    raise Refusal(_say(command, reason))


def import_packages(command: str, names: Iterable[str]) -> None:
    """
    Import the modules of ``--gym-packages``, which register environments.

    :param command: name of the command
    :param names: their names
    :raises Refusal: if one cannot be imported
    """
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError as error:
            refuse(command, f"--gym-packages {name} cannot be imported: {error}")


def interrupt(command: str, reason: object) -> NoReturn:
    """
    End the process after Ctrl-C, with one line on stderr and exit code 130.

    :param command: name of the command; none if empty
    :param reason: the message
    :raises SystemExit: always
    """
    _say(command, reason)
    raise SystemExit(INTERRUPTED)


def _say(command: str, reason: object) -> str:
    name = f"sb3-sample {command}".strip()
    text = " ".join(f"{name}: {reason}".split())
    text = "".join(letter if letter.isprintable() else "?" for letter in text[:_MAX])
    print(text, file=sys.stderr)
    return text
