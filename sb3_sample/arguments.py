"""Arguments of the algorithms' constructors, of both families."""

import inspect
from collections.abc import Sequence
from typing import Any


def names_for_load(cls: type, base: type) -> set[str]:
    """
    :param cls: class of an algorithm
    :param base: its family's first class
    :return: the arguments that ``load`` may change: those of the class and of its bases in the family
    """
    names = {name for c in cls.__mro__ if issubclass(c, base) for name in inspect.signature(c).parameters}
    return names - {"policy", "env", "kwargs", "_init_setup_model"}


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


def check_unused(agent: Any, names: Sequence[str], choice: str) -> None:
    """
    :param agent: an algorithm
    :param names: arguments of its constructor that mean nothing under a choice
    :param choice: that choice, for the error
    :raises ValueError: if one of them is not at its default
    """
    for name in names:
        signatures = (inspect.signature(cls).parameters for cls in type(agent).__mro__)
        default = next(parameters[name].default for parameters in signatures if name in parameters)
        if getattr(agent, name) != default:
            raise ValueError(f"{name}={getattr(agent, name)!r} means nothing with {choice}: leave it out")
