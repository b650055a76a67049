"""Warnings, attributed to the line of the user's program that they are about."""

import sys
import warnings

#: Packages and modules between that line and the code that warns.
_BETWEEN = {"sb3_sample", "stable_baselines3", "contextlib", "functools"}


def warn(message: str) -> None:
    """
    Warn, attributing the warning to the innermost line outside this package and Stable-Baselines3. A thread of this
    package's own has no such line: there it is attributed to the line that warns.

    :param message: what to say
    """
    frame, level = sys._getframe(1), 2
    outer = frame.f_back
    while frame.f_globals.get("__name__", "").partition(".")[0] in _BETWEEN and outer is not None:
        frame, outer, level = outer, outer.f_back, level + 1
    if frame.f_globals.get("__name__", "").partition(".")[0] in {*_BETWEEN, "threading"}:
        level = 2
    warnings.warn(message, stacklevel=level)
