"""Kinds of values that arguments take, and the one check of a value against its kind."""

import math
from collections.abc import Callable, Collection, Mapping
from numbers import Integral, Real
from typing import Any, NamedTuple, TypeGuard

import numpy as np


def is_integer(value: Any) -> TypeGuard[int]:
    """
    :param value: any value
    :return: whether it is an integer, Python's or NumPy's
    """
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """
    :param value: any value
    :return: whether it is a real number, Python's or NumPy's
    """
    return isinstance(value, Real) and not isinstance(value, bool)


class Kind(NamedTuple):
    """
    Kind of value that an argument takes.

    :param words: the kind after "must", for the error
    :param fits: whether a value is of this kind
    """

    words: str
    fits: Callable[[Any], bool]

    def otherwise(self, words: str, fits: Callable[[Any], bool]) -> "Kind":
        """
        :param words: another kind, after "or"
        :param fits: whether a value is of that kind
        :return: the kind of values of either kind
        """
        return Kind(f"{self.words}, or {words}", lambda value: self.fits(value) or fits(value))

    def or_none(self, meaning: str = "") -> "Kind":
        """
        :param meaning: meaning of None, for the error
        :return: this kind, or None
        """
        return self.otherwise(f"None{meaning and ' for '}{meaning}", lambda value: value is None)


def integer(low: int, high: int | None = None) -> Kind:
    """
    :param low: the smallest allowed
    :param high: the largest allowed; None for no limit
    :return: the kind of integers, Python's or NumPy's
    """
    words = f"be an integer of at least {low}" + ("" if high is None else f" and at most {high}")
    highest = math.inf if high is None else high
    return Kind(words, lambda value: is_integer(value) and low <= value <= highest)


def number(words: str, fits: Callable[[float], bool]) -> Kind:
    """
    :param words: the range, after "must"
    :param fits: whether a number is in it
    :return: the kind of real numbers, Python's or NumPy's
    """
    return Kind(words, lambda value: is_number(value) and fits(value))


def subclass(of: type) -> Kind:
    """
    :param of: a class
    :return: the kind of that class and those derived from it
    """
    return Kind(f"be {of.__name__} or derived from it", lambda value: isinstance(value, type) and issubclass(value, of))


def instance(of: type) -> Kind:
    """
    :param of: a class
    :return: the kind of its objects
    """
    return Kind(f"be of {of.__name__}", lambda value: isinstance(value, of))


def maker(of: type, example: str) -> Kind:
    """
    :param of: a class
    :param example: one derived from it, for the error
    :return: the kind of everything that can be called to make its objects
    """

    def fits(value: Any) -> bool:
        return issubclass(value, of) if isinstance(value, type) else callable(value)

    return Kind(f"be a class of {of.__name__}, such as {example}", fits)


UNIT = number("lie in [0, 1]", lambda value: 0 <= value <= 1)
AT_LEAST_0 = number("be at least 0 and finite", lambda value: 0 <= value < math.inf)
ABOVE_0 = number("be above 0 and finite", lambda value: 0 < value < math.inf)
LEARNING_RATE = AT_LEAST_0.otherwise("a schedule", callable)
#: Seeds that NumPy takes.
SEED = integer(0, 2**32 - 1)
FINITE = number("be a finite number", math.isfinite)
DICT = Kind("be a dict", lambda value: isinstance(value, dict)).or_none()
TRUE_OR_FALSE = Kind("be True or False", lambda value: isinstance(value, (bool, np.bool_)))
# True and False are 1 and 0, as Stable-Baselines3 takes them.
VERBOSE = Kind("be an integer of at least 0", lambda value: isinstance(value, (Integral, np.bool_)) and int(value) >= 0)


def check_value(name: str, value: Any, kind: Kind) -> Any:
    """
    :param name: name of an argument
    :param value: its value
    :param kind: what it must be
    :return: the value; a NumPy number as Python's, since torch, Gymnasium and files do not accept NumPy's everywhere
    :raises ValueError: if it is something else
    """
    if not kind.fits(value):
        raise ValueError(f"{name} must {kind.words}, not {value!r}")
    return value.item() if isinstance(value, np.generic) else value


def one_of(table: Collection[str], base: type | None = None) -> Kind:
    """
    :param table: choices by name, or their names
    :param base: base class of the choices; None if there are only names
    :return: the kind of their names, and of the classes derived from ``base``
    """
    names = sorted(table)
    words = f"be one of {names}" + ("" if base is None else f", or a class derived from {base.__name__}")
    return Kind(
        words,
        lambda value: (
            (isinstance(value, str) and value in table)
            or (base is not None and isinstance(value, type) and issubclass(value, base))
        ),
    )


def chosen(name: str, value: Any, table: Mapping[str, Any], base: type) -> Any:
    """
    :param name: name of an argument
    :param value: its value
    :param table: choices by name
    :param base: base class of the choices
    :return: the choice of that name, or the class itself
    :raises ValueError: if it is neither
    """
    check_value(name, value, one_of(table, base))
    return choice_of(value, table)


def choice_of(value: Any, table: Mapping[str, Any]) -> Any:
    """
    :param value: value of an argument, the name of a choice or anything else
    :param table: choices by name
    :return: the choice of that name, None for a name that is none; anything else as it is
    """
    return table.get(value) if isinstance(value, str) else value
