"""Arguments of the algorithms' constructors, of both families."""

import inspect
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from numbers import Integral, Real
from typing import Any, TypeGuard

from sb3_sample.errors import ParametersDoNotFit


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


def names_for_load(cls: type, base: type) -> set[str]:
    """
    :param cls: class of an algorithm
    :param base: its family's first class
    :return: the arguments that ``load`` may change: those of the class and of its bases in the family, and
        ``policy_class``, Stable-Baselines3's name for what the policy is of
    """
    names = {name for c in cls.__mro__ if issubclass(c, base) for name in inspect.signature(c).parameters}
    return (names | {"policy_class"}) - {"env", "kwargs", "_init_setup_model"}


def check_known(cls: type, base: type, kwargs: dict[str, Any]) -> None:
    """
    :param cls: class of an algorithm
    :param base: its family's first class
    :param kwargs: what ``load`` is to change
    :raises ValueError: if one of them is no argument of the class
    """
    unknown = sorted(kwargs.keys() - names_for_load(cls, base))
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: not an argument of {cls.__name__}, so load cannot change it")


def default_of(cls: type, name: str) -> Any:
    """
    :param cls: class of an algorithm
    :param name: an argument of its constructor, or of a base's that it hands it on to
    :return: the argument's default
    """
    signatures = (inspect.signature(c).parameters for c in cls.__mro__)
    return next(parameters[name].default for parameters in signatures if name in parameters)


@contextmanager
def naming_changes(kwargs: dict[str, Any]) -> Iterator[None]:
    """
    Where a file is loaded: that its parameters do not fit is laid to the arguments that are to differ from the file's.

    :param kwargs: these arguments
    :raises ValueError: if they are not of the model's networks and parts
    """
    try:
        yield
    except (RuntimeError, ValueError) as error:
        words = ("loading state_dict", "is an invalid object name", "do not match agents' parameters")
        if kwargs and (isinstance(error, ParametersDoNotFit) or any(word in str(error) for word in words)):
            raise ValueError(
                f"{', '.join(sorted(kwargs))}: with these arguments the model has other networks or parts than the "
                f"file ({str(error).splitlines()[0]})"
            ) from error
        raise


def check_unused(agent: Any, names: Sequence[str], choice: str) -> None:
    """
    :param agent: an algorithm
    :param names: arguments of its constructor that mean nothing under a choice
    :param choice: that choice, for the error
    :raises ValueError: if one of them is not at its default
    """
    for name in names:
        default = default_of(type(agent), name)
        if getattr(agent, name) != default:
            raise ValueError(
                f"{name}={getattr(agent, name)!r} means nothing with {choice}: leave it out, or at {default!r}"
            )
