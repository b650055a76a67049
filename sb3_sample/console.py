"""Lines for a terminal, a pipe or a file that may be gone or full: the training continues without them."""

import contextlib
import os
import sys
from typing import Any

from sb3_sample.warn import warn


def standard_error() -> int | None:
    """
    :return: the descriptor of the standard error; None if the program has none, or no longer has one, so that its
        number may be another file's
    :raises OSError: there is no such descriptor
    """
    stream = sys.__stderr__
    if stream is None or stream.closed:
        return None
    descriptor = stream.fileno()
    # Files that Python opens are not inherited by other programs; the standard error that the program was given is.
    return descriptor if os.get_inheritable(descriptor) else None


def tell(text: str) -> None:
    """
    Write to the standard error from a signal handler. Nothing is raised, whatever the state of the standard error,
    since the handler can interrupt any code.

    :param text: a line
    """
    with contextlib.suppress(OSError, ValueError):
        descriptor = standard_error()
        if descriptor is not None:
            os.write(descriptor, text.encode())


def say(text: str) -> None:
    """
    Print a line during a turn. It is lost if the output does not accept it.

    :param text: the line
    """
    # A pipe without a reader or a full disk is no reason to lose the turn.
    with contextlib.suppress(OSError):
        print(text)


class LossyLog:
    """
    While in force, lines of the log that a terminal, a pipe or a file does not accept are lost with a warning, instead
    of ending the training during a turn.

    :param logger: the algorithm's, of Stable-Baselines3
    """

    def __init__(self, logger: Any):
        self._formats: list[Any] = list(logger.output_formats)
        for each in self._formats:
            each.write = _Lossy(each)

    def close(self) -> None:
        """Leave the log as it was."""
        for each in self._formats:
            del each.write
        self._formats = []


class _Lossy:
    def __init__(self, output: Any):
        self._name, self._write = type(output).__name__, output.write
        self._warned = False

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        try:
            self._write(*args, **kwargs)
        except OSError as error:
            if not self._warned:
                self._warned = True
                warn(
                    f"{self._name} of the log cannot be written to ({error}): lines of it are lost. The training goes "
                    "on."
                )
