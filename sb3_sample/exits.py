"""How ``sb3-sample`` ends when it refuses something, or is interrupted."""

import sys
from typing import NoReturn

#: The process's exit code, as that of a wrong option.
CODE = 2
#: The same after Ctrl-C, as a shell has it: 128 and the number of SIGINT.
INTERRUPTED = 130
_MAX = 2000


class Refusal(SystemExit):
    """
    The end of a command that has said why.

    :param message: what it has said
    """

    def __init__(self, message: str):
        super().__init__(message)
        self.code = CODE


def refuse(command: str, reason: object) -> NoReturn:
    """
    End the process with one line on stderr and exit code 2.

    :param command: name of the command; none if empty
    :param reason: why; what a file brings into it is not trusted to be one line, short or printable
    :raises Refusal: always
    """
    raise Refusal(_say(command, reason))


def interrupt(command: str, reason: object) -> NoReturn:
    """
    End the process after Ctrl-C, with one line on stderr and exit code 130.

    :param command: name of the command; none if empty
    :param reason: what there is to say
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
