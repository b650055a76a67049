"""The classes and functions that a file may name, and the classes of the objects that it may hold."""

import contextlib
import contextvars
import enum
import importlib
import inspect
import re
import sys
import types
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.noise import ActionNoise
from torch import nn

from sb3_sample.saving.container import DTYPES, BadFile

#: How deep trees may be nested: far above what occurs, and far below what Python's stack holds.
MAX_DEPTH = 60
INT_MAX = 2**63
DTYPE_TEXT = re.compile(r"[<>|=][biufcSUMm][0-9]{1,9}(\[[0-9]*[a-zA-Z]+\])?")
SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Dict, spaces.Tuple)
#: Packages whose classes a file may name, if they are of the kinds below.
PACKAGES = ("torch.nn", "torch.optim", "stable_baselines3", "sb3_contrib", "sb3_sample")
#: Those of them that reading a file may import. Modules of the others must be imported already: some write files on
#: import.
IMPORTED = ("sb3_contrib", "stable_baselines3.common.sb2_compat")
#: Classes that can be arguments of an algorithm: networks, policies, features extractors and activations;
#: optimizers; buffers.
KINDS = (nn.Module, torch.optim.Optimizer, BaseBuffer)


class NotPortable(ValueError):
    """A value that cannot stand in a file that runs no code."""


#: Whether modules may be imported that the program has not imported yet.
_imports = contextvars.ContextVar("imports", default=True)


@contextlib.contextmanager
def importing_nothing() -> Iterator[None]:
    """
    Restrict reading, meanwhile, to classes and functions of modules that the program has imported. Checkpoints are read
    in this way: they may name any part of the program, but must not decide what else is run.
    """
    token = _imports.set(False)
    try:
        yield
    finally:
        _imports.reset(token)


def _module(name: str) -> types.ModuleType:
    if _imports.get():
        return importlib.import_module(name)
    module = sys.modules.get(name)
    if not isinstance(module, types.ModuleType):
        raise ImportError(f"the module {name!r} is not imported by this program, and a checkpoint imports none")
    return module


def check_trusted(trusted: Sequence[str]) -> tuple[str, ...]:
    """
    :param trusted: names of modules or packages
    :return: the same
    :raises ValueError: if it is something else
    """
    if isinstance(trusted, str) or not all(isinstance(name, str) and name for name in trusted):
        raise ValueError(f"trusted_modules must be a list of names of modules, not {trusted!r}")
    return tuple(trusted)


def within(module: str, packages: Sequence[str]) -> bool:
    """
    :param module: name of a module
    :param packages: names of modules or packages
    :return: whether it is one of them, or in one of them
    """
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def path_of(value: Any) -> str:
    """
    :param value: a class or a function
    :return: where it can be imported from
    """
    return f"{value.__module__}:{value.__qualname__}"


def member_of(value: enum.Enum) -> str | int:
    """
    :param value: a member of an enumeration, or flags of one
    :return: its name; for a combination of flags, or none, their number
    """
    if isinstance(value, enum.Flag) and value.name not in type(value).__members__:
        return int(value.value)
    return value.name


def of_member(cls: type[enum.Enum], member: Any) -> enum.Enum:
    """
    :param cls: an enumeration
    :param member: from :func:`member_of`
    :return: the member
    :raises KeyError: it has no such member
    :raises ValueError: it has no such flags
    """
    return cls(member) if type(member) is int and issubclass(cls, enum.Flag) else cls[member]


def is_importable(value: Any) -> bool:
    """
    :param value: a class or a function
    :return: whether its path leads to it in this program, as it never does for anything made inside a function
    """
    return in_program(path_of(value)) is value


def in_program(path: str) -> Any:
    """
    :param path: what ``path_of`` gave
    :return: what it leads to in this program, without any import; None if it leads to nothing
    """
    module, _, name = path.partition(":")
    return _at(sys.modules.get(module), name.split("."))


def _at(module: Any, names: Sequence[str]) -> Any:
    found = module
    for name in names:
        found = vars(found).get(name) if isinstance(found, (types.ModuleType, type)) else None
    return found


def resolve(path: str, trusted: Sequence[str]) -> Any:
    """
    :param path: what ``path_of`` gave
    :param trusted: modules, or packages of modules, of which any class and any function may be named
    :return: the class or function
    :raises ValueError: if it may not be named, or is not there
    """
    module, _, name = path.partition(":")
    names = name.split(".")
    if "<locals>" in names:
        raise ValueError(f"{path!r:.300} was made inside of a function, where no import finds it")
    if not all(part.isidentifier() for part in (*module.split("."), *names)) or any(n.startswith("__") for n in names):
        raise ValueError(f"{path!r:.300} is no name in a module")
    is_trusted = within(module, trusted)
    if not is_trusted:
        _check_known(path, module, names)
    try:
        value = _at(_module(module), names)
    except ImportError as error:
        raise ValueError(f"{path!r:.300} cannot be imported: {error}") from error
    # Names that a module has imported from elsewhere are not its own.
    is_own = isinstance(value, type) or inspect.isroutine(value)
    if not is_own or getattr(value, "__module__", None) != module or getattr(value, "__qualname__", None) != name:
        raise ValueError(f"{path!r:.300} is no class or function of this module")
    if not is_trusted and not (isinstance(value, type) and issubclass(value, KINDS)):
        raise ValueError(f"{path!r:.300} is no network, policy, optimizer or buffer")
    return value


def _check_known(path: str, module: str, names: Sequence[str]) -> None:
    """Check a module that nobody vouches for: only public names at the top of modules of ``PACKAGES`` are allowed."""
    if not within(module, PACKAGES) or any(part.startswith("_") for part in module.split(".")):
        raise ValueError(f"{path!r:.300} is of a module that is not trusted")
    if len(names) > 1 or names[0].startswith("_"):
        raise ValueError(f"{path!r:.300} is no public name at the top of a module")
    if module not in sys.modules and not within(module, IMPORTED):
        raise ValueError(f"{path!r:.300} is of a module that is not there, or not imported")


def has_state(cls: type) -> bool:
    """
    :param cls: any class
    :return: whether its objects can save and load a state, as torch's modules and optimizers can
    """
    return hasattr(cls, "state_dict") and hasattr(cls, "load_state_dict")


def may_be_set(cls: type, name: str) -> bool:
    """
    Whether a file may set an attribute on an object, and so whether it is written: never a class's behaviour.

    :param cls: the object's class
    :param name: name of an attribute
    :return: whether the name is a plain one, and the class has nothing under it, or only a default that is plain data:
        no method, property, class or function
    """
    if not name.isidentifier() or name.startswith("__"):
        return False
    found = next((vars(base)[name] for base in cls.__mro__ if name in vars(base)), None)
    return not callable(found) and not any(hasattr(type(found), f"__{word}__") for word in ("get", "set", "delete"))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray) or _is_number(value)


def _is_optional_array(value: Any) -> bool:
    return value is None or _is_array(value)


def _is_dtype(value: Any) -> bool:
    return isinstance(value, (str, np.dtype)) or (isinstance(value, type) and issubclass(value, np.generic))


def _is_noise(value: Any) -> bool:
    return isinstance(value, ActionNoise)


def _are_noises(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_noise, value))


def _is_table(value: Any) -> bool:
    is_table = isinstance(value, np.ndarray) and value.ndim == 2 and len(value) == 2 and value.dtype == np.float64
    return is_table and value.size > 0 and bool(np.isfinite(value).all() and (np.diff(value[0]) > 0).all())


#: Attributes of the classes whose objects a file may hold, and what their values must be.
OBJECTS: dict[str, dict[str, Callable[[Any], bool]]] = {
    "stable_baselines3.common.utils:ConstantSchedule": {"val": _is_number},
    "stable_baselines3.common.utils:LinearSchedule": {
        "start": _is_number, "end": _is_number, "end_fraction": _is_number,
    },
    "stable_baselines3.common.utils:FloatSchedule": {"value_schedule": callable},
    "rl_zoo3.utils:SimpleLinearSchedule": {"initial_value": _is_number},
    "sb3_sample.saving.schedules:ScheduleTable": {"table": _is_table},
    "stable_baselines3.common.running_mean_std:RunningMeanStd": {
        "mean": _is_array, "var": _is_array, "count": _is_number,
    },
    "stable_baselines3.common.noise:NormalActionNoise": {"_mu": _is_array, "_sigma": _is_array, "_dtype": _is_dtype},
    "stable_baselines3.common.noise:OrnsteinUhlenbeckActionNoise": {
        "_theta": _is_number, "_mu": _is_array, "_sigma": _is_array, "_dt": _is_number, "_dtype": _is_dtype,
        "initial_noise": _is_optional_array, "noise_prev": _is_array,
    },
    "stable_baselines3.common.noise:VectorizedActionNoise": {
        "n_envs": _is_number, "_base_noise": _is_noise, "_noises": _are_noises,
    },
}  # fmt: skip
#: Enumerations whose members a file may name.
ENUMERATIONS = (
    "stable_baselines3.common.type_aliases:TrainFrequencyUnit",
    "stable_baselines3.her.goal_selection_strategy:GoalSelectionStrategy",
)
#: Named tuples that a file may hold, and the types of their items.
NAMED_TUPLES: dict[str, tuple[type, ...]] = {
    "stable_baselines3.common.type_aliases:TrainFreq": (int, enum.Enum),
}


def class_of(path: Any, table: Any, name: str) -> type:
    """
    :param path: import path, from a file
    :param table: the paths that are allowed
    :param name: what it is for, for messages
    :return: the class
    :raises BadFile: if it is not in the table, or not installed
    """
    if not isinstance(path, str) or path not in table:
        raise BadFile(f"{name}: the file holds an object of {path!r}, which is not allowed")
    module, _, attribute = path.partition(":")
    try:
        cls = getattr(_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise BadFile(f"{name}: the file holds an object of {path!r}, which is not installed: {error}") from error
    assert isinstance(cls, type)  # the tables name classes
    return cls


def object_path(value: Any, table: Any) -> str | None:
    """
    :param value: an object
    :param table: allowed paths
    :return: the path of its class, if it is in the table and leads to that class; otherwise None
    """
    path = path_of(type(value))
    if path not in table:
        return None
    module, _, attribute = path.partition(":")
    return path if getattr(sys.modules.get(module), attribute, None) is type(value) else None


def check_attribute(path: str, key: str, value: Any, name: str, error: type[ValueError]) -> None:
    """
    :param path: of a class in ``OBJECTS``
    :param key: its attribute
    :param value: that attribute's value
    :param name: what the object is for, for messages
    :param error: the exception to raise if the value is not allowed
    """
    if not OBJECTS[path][key](value):
        raise error(f"{name}: {key} of {path} cannot be {value!r}")


def torch_has(dtype: np.dtype) -> bool:
    """
    :param dtype: a NumPy dtype
    :return: whether torch's tensors and files have it
    """
    return dtype.kind in "biufc" and getattr(torch, dtype.name, None) in DTYPES.values()
