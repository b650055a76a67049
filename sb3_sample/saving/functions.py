"""
State that functions keep from one call to the next: the object that they are bound to, the arguments of a ``partial``,
the variables of a closure, defaults and attributes.
"""

import functools
import types
from typing import Any

import numpy as np

#: Types of callables, whose behaviour the program defines.
FUNCTIONS = (
    type, types.FunctionType, types.BuiltinFunctionType, types.MethodType, functools.partial,
    functools._lru_cache_wrapper, np.ufunc,
)  # fmt: skip
#: Types of ``__self__`` of a C function that is not a method of an object.
_UNBOUND = (type(None), type, types.ModuleType)
_CONSTANTS = (type(None), bool, int, float, complex, str, bytes)


class OtherKind(ValueError):
    """A function's variable is of another kind than the one that a checkpoint has for it."""


def name_of(function: Any) -> str:
    """
    :param function: one of :data:`FUNCTIONS`
    :return: its name in its module
    """
    if isinstance(function, functools.partial):
        return "functools.partial"
    return str(getattr(function, "__qualname__", None) or function.__name__)


def held(function: Any) -> dict[str, Any]:
    """
    :param function: one of :data:`FUNCTIONS`
    :return: the values that it holds, by place; functions made in the same way have the same places
    """
    if isinstance(function, functools.partial):
        keywords = {f"keyword {name}": value for name, value in function.keywords.items()}
        return {"of": function.func, "arguments": function.args, **keywords}
    if isinstance(function, types.MethodType):
        return {**held(function.__func__), "self": function.__self__}
    if isinstance(function, functools._lru_cache_wrapper):
        return held(function.__wrapped__)
    if isinstance(function, types.BuiltinFunctionType):
        return {} if isinstance(function.__self__, _UNBOUND) else {"self": function.__self__}
    if not isinstance(function, types.FunctionType):
        return {}
    holds = {}
    for name, cell in _cells(function).items():
        try:
            holds[f"variable {name}"] = cell.cell_contents
        except ValueError:  # Nothing was assigned to it yet.
            continue
    for where in ("__defaults__", "__kwdefaults__"):
        defaults = getattr(function, where)
        values = defaults.values() if isinstance(defaults, dict) else defaults or ()
        if not all(isinstance(value, _CONSTANTS) for value in values):
            holds[where] = defaults
    holds |= {f"attribute {name}": value for name, value in vars(function).items()}
    return holds


def holding(function: Any, values: dict[str, Any]) -> Any:
    """
    :param function: one of :data:`FUNCTIONS`
    :param values: the values that it is to hold, by place, as :func:`held` gives them; with the same places
    :return: the function with these values: itself, as far as its values can be exchanged
    :raises OtherKind: a value that cannot change in the course of a program is of another kind
    """
    before = held(function)
    for where, value in values.items():
        if not where.startswith(("variable ", "attribute ")):
            _check_kind(where, value, before[where])
    if isinstance(function, functools.partial):
        keywords = {where.partition(" ")[2]: value for where, value in values.items() if where.startswith("keyword ")}
        return type(function)(values["of"], *values["arguments"], **keywords)
    if isinstance(function, types.MethodType):
        holding(function.__func__, {where: value for where, value in values.items() if where != "self"})
        owner = values["self"]
        return function if owner is function.__self__ else types.MethodType(function.__func__, owner)
    if isinstance(function, functools._lru_cache_wrapper):
        holding(function.__wrapped__, values)
    if isinstance(function, types.BuiltinFunctionType) and values and values["self"] is not function.__self__:
        return getattr(values["self"], function.__name__)
    if isinstance(function, types.FunctionType):
        cells = _cells(function)
        for where, value in values.items():
            kind, _, name = where.partition(" ")
            if kind == "variable":
                cells[name].cell_contents = value
            elif kind == "attribute":
                vars(function)[name] = value
            else:
                setattr(function, where, value)
    return function


def _cells(function: types.FunctionType) -> dict[str, Any]:
    return dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))


def _check_kind(where: str, value: Any, before: Any) -> None:
    if type(value) is not type(before):
        raise OtherKind(f"{where} is {type(before).__name__}, but was {type(value).__name__}")
    if isinstance(before, (tuple, dict)) and len(value) != len(before):
        raise OtherKind(f"{where} has {len(before)} items, but had {len(value)}")
    if isinstance(before, tuple):
        for item, old in zip(value, before, strict=True):
            _check_kind(where, item, old)
    if isinstance(before, dict) and value.keys() != before.keys():
        raise OtherKind(f"{where} has {sorted(before)}, but had {sorted(value)}")
