"""Classes in place of names: what they must define, how they are made, and errors that name class and argument."""

import difflib
import inspect
import types
import weakref
from collections.abc import Callable, Iterator
from typing import Any

from torch import nn
from torch.optim import Optimizer

from sb3_sample.warn import warn

#: Classes whose names were already checked.
_told: weakref.WeakSet[type] = weakref.WeakSet()


def make(
    argument: str, choice: Any, cls: Callable[..., Any], base: type, *given: Any, kwargs: dict[str, Any], **fixed: Any
) -> Any:
    """
    Make an object of a class that an argument has chosen.

    :param argument: name of the argument
    :param choice: its value
    :param cls: the class
    :param base: base class of the choices
    :param given: what it is made from, by position
    :param kwargs: its arguments, those of the argument ``<argument>_kwargs``
    :param fixed: what else it is made from, by name
    :return: the object
    :raises ValueError: if the class lacks a method, does not take these arguments, has not made its base, or does not
        list an optimizer that it has
    """
    if isinstance(cls, type):
        check(argument, cls, base)
    check_arguments(argument, choice, cls, *given, kwargs=kwargs, **fixed)
    try:
        made = cls(*given, **fixed, **kwargs)
    except Exception as error:
        # From torch, when something is assigned.
        if isinstance(error, AttributeError) and "__init__() call" in str(error):
            raise ValueError(_without_base(argument, cls)) from error
        name = next(iter(inspect.signature(cls).parameters), "")
        # The class has taken the learner for one of its arguments.
        if not fixed and name != _first(fixed) and any(type(each).__name__ in str(error) for each in given):
            raise ValueError(f"{_without_first(argument, cls, fixed)}, not {name} ({error})") from error
        raise
    if isinstance(made, nn.Module) and "_modules" not in vars(made):
        raise ValueError(_without_base(argument, type(made)))
    _check_optimizers(argument, made)
    return made


def _check_optimizers(argument: str, made: Any) -> None:
    """Check that a part lists its optimizers: others are neither saved nor started anew at a reset."""
    if not hasattr(made, "optimizers"):
        return
    listed = {id(optimizer) for optimizer in made.optimizers().values()}
    for name, value in vars(made).items():
        if isinstance(value, Optimizer) and id(value) not in listed:
            raise ValueError(
                f"{argument}: {type(made).__name__}.optimizers() must list self.{name}, so that it is saved: "
                f"return {{{name!r}: self.{name}}}"
            )


def _without_base(argument: str, cls: Any) -> str:
    return f"{argument}: {cls.__name__}.__init__ must call super().__init__(...) before anything else"


def check(argument: str, cls: type, base: type) -> None:
    """
    Check what a class defines. A warning is given for names that are close to the base's and that the class itself does
    not use.

    :param argument: name of the argument that has chosen it
    :param cls: the class
    :param base: base class of the choices
    :raises ValueError: if it lacks a method that its base leaves to it, or one takes other arguments than the base's
    """
    for name in dir(cls):
        if getattr(inspect.getattr_static(cls, name), "__isabstractmethod__", False):
            raise ValueError(f"{argument}: {cls.__name__} must define {name}(), which {base.__name__} leaves to it")
    own = [c for c in cls.__mro__ if issubclass(c, base) and c.__module__.split(".")[0] != __name__.split(".")[0]]
    defined = {name for c in own for name in vars(c)}
    hooks = [name for name in dir(base) if not name.startswith("_") and not hasattr(nn.Module, name)]
    for name in (*hooks, "forward"):
        if name in defined:
            _check_signature(argument, cls, base, name)
    if cls in _told:
        return
    _told.add(cls)
    hooks = [name for name in (*hooks, "forward", "get_extra_state", "set_extra_state") if name not in defined]
    used = {name for c in own for value in vars(c).values() for name in names_in(value)}
    for c in own:
        for name in vars(c):
            near = difflib.get_close_matches(name, hooks, 1, 0.8)
            if near and not name.startswith("_") and not hasattr(base, name) and name not in used:
                warn(f"{c.__name__}.{name} is called by nobody; did you mean {near[0]}? ({argument}={c.__name__})")


def _check_signature(argument: str, cls: type, base: type, name: str) -> None:
    """Check that a method takes the arguments that the base's is called with, all by position."""
    own, wanted = inspect.getattr_static(cls, name), inspect.getattr_static(base, name, None)
    if not (isinstance(own, types.FunctionType) and isinstance(wanted, types.FunctionType)):
        return
    signature, expected = inspect.signature(own), inspect.signature(wanted)
    try:
        signature.bind(*expected.parameters)
    except TypeError as error:
        words = ", ".join(
            str(each.replace(annotation=inspect.Parameter.empty)) for each in expected.parameters.values()
        )
        raise ValueError(
            f"{argument}: {cls.__name__}.{name} must take ({words}), as {base.__name__}.{name} does: {error}"
        ) from error


def is_derived(cls: Any, base: type) -> bool:
    """
    :param cls: a class, or anything else
    :param base: base class
    :return: whether it is a class derived from the base
    """
    return isinstance(cls, type) and issubclass(cls, base)


def defaults_for(cls: Any, base: type, **defaults: Any) -> dict[str, Any]:
    """
    Find which of an agent's defaults a part has.

    :param cls: class of the part, or anything else
    :param base: base class of the parts that the defaults are for
    :param defaults: arguments with the agent's defaults
    :return: those that the class takes by name; none if it is not derived from the base
    """
    taken = inspect.signature(cls).parameters if is_derived(cls, base) else {}
    return {name: value for name, value in defaults.items() if name in taken}


def names_in(value: Any) -> Iterator[str]:
    """Attributes and functions that a method uses."""
    functions = (value.fget, value.fset) if isinstance(value, property) else (inspect.unwrap(_function_of(value)),)
    codes = [function.__code__ for function in functions if isinstance(function, types.FunctionType)]
    while codes:
        code = codes.pop()
        yield from code.co_names
        codes += [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]


def _function_of(value: Any) -> Any:
    return value.__func__ if isinstance(value, (classmethod, staticmethod)) else value


def _first(fixed: dict[str, Any]) -> str:
    """Name of the first argument that a network, or another part, is made with."""
    return "in_features" if fixed else "learner"


def _without_first(argument: str, cls: Any, fixed: dict[str, Any]) -> str:
    return f"{argument}: {cls.__name__}.__init__ must take {', '.join(['self', _first(fixed), *fixed])} first"


def _check_first(
    argument: str,
    cls: Callable[..., Any],
    signature: inspect.Signature,
    *given: Any,
    kwargs: dict[str, Any],
    fixed: dict[str, Any],
) -> None:
    """Check that what a part is made from does not take the place of one of its arguments."""
    first = next(iter(signature.parameters.values()), None)
    if not given or (first is not None and first.name == _first(fixed)):
        return
    if first is None or first.name in kwargs or first.default is not first.empty:
        raise ValueError(f"{_without_first(argument, cls, fixed)}, not {'nothing' if first is None else first.name}")


def check_arguments(
    argument: str, choice: Any, cls: Callable[..., Any], *given: Any, kwargs: dict[str, Any], **fixed: Any
) -> None:
    """
    Check the arguments of a class against its signature.

    :param argument: name of the argument that has chosen it
    :param choice: its value
    :param cls: the class
    :param given: what it is made from, by position
    :param kwargs: its arguments, those of the argument ``<argument>_kwargs``
    :param fixed: what else it is made from, by name
    :raises ValueError: if it takes other ones
    """
    signature = inspect.signature(cls)
    _check_first(argument, cls, signature, *given, kwargs=kwargs, fixed=fixed)
    kinds = {name: parameter.kind for name, parameter in signature.parameters.items()}
    many = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    allowed = [name for name, kind in list(kinds.items())[len(given) :] if kind not in many and name not in fixed]
    # torch's __init__ takes any arguments, to refuse them.
    if inspect.Parameter.VAR_KEYWORD not in kinds.values() or getattr(cls, "__init__", None) is nn.Module.__init__:
        for name in kwargs:
            if name not in allowed:
                where = argument if argument.endswith("]") else f"{argument}_kwargs"
                raise ValueError(f"{where} has {name!r}, but {argument}={choice!r} takes {allowed or 'none'}")
    try:
        signature.bind(*given, **fixed, **kwargs)
    except TypeError as error:
        words = ", ".join([_first(fixed)] * len(given) + [f"{name}=..." for name in fixed])
        name = getattr(cls, "__name__", repr(cls))
        raise ValueError(
            f"{argument}: {name} is made as {name}({words}) with the arguments {kwargs}, and its __init__ does not "
            f"take that: {error}"
        ) from error
