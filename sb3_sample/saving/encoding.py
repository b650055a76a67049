"""
Values as trees of JSON with their arrays beside them, and back: the content of files that run no code.

In a tree, None, booleans, texts, lists, and numbers that JSON has stand for themselves. Anything else is an object with
a key that says what it is, some with further ones: ``{"tuple": [1, 2]}``, ``{"array": "observations"}``. Whatever the
tree holds, reading makes only objects that this file and the tables of ``classes.py`` name.
"""

import base64
import collections
import contextlib
import enum
import math
import pathlib
import random
import types
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.saving.classes import (
    DTYPE_TEXT,
    ENUMERATIONS,
    INT_MAX,
    MAX_DEPTH,
    NAMED_TUPLES,
    OBJECTS,
    PACKAGES,
    SPACES,
    NotPortable,
    check_attribute,
    is_importable,
    may_be_set,
    member_of,
    object_path,
    path_of,
    resolve,
    torch_has,
    within,
)
from sb3_sample.saving.container import DTYPES
from sb3_sample.saving.decoding import decode
from sb3_sample.saving.generators import BIT_GENERATORS
from sb3_sample.saving.schedules import ScheduleTable

__all__ = ["Encoder", "Lenient", "NotPortable", "decode", "encode", "is_left_out"]

#: Replaces a value that is left out, and holds the reason.
LEFT_OUT = "left_out"
#: Longer lists of numbers are arrays in the file.
LONG = 16
#: Types of objects that take part in a training and hold more state than their attributes.
_OF_TRAINING = (BaseAlgorithm, BaseBuffer, BaseCallback, VecEnv, gym.Env, gym.Space)
#: Random generators, which are written by their state.
GENERATORS = (np.random.Generator, np.random.RandomState, random.Random, torch.Generator)
#: Objects that are written by their names.
NAMED = (type, types.FunctionType, types.BuiltinFunctionType)


class _Plain:
    """A class whose objects consist of their attributes alone."""


def bytes_of(tensor: torch.Tensor) -> bytes:
    """
    :param tensor: of any dtype, including those that NumPy lacks
    :return: the bytes of its numbers
    """
    flat = tensor.detach().cpu().contiguous().reshape(-1)
    return flat.view(torch.uint8).numpy().tobytes()


def encode(value: Any, name: str, tensors: dict[str, torch.Tensor], schedule: bool = False) -> Any:
    """
    Encode a value as a tree of JSON. Tensors on other devices are copied to the CPU, where :func:`decode` leaves them.
    A value that occurs twice becomes two values, and a generator can continue to draw, but not spawn as before.

    Classes and functions of any origin are written by their names, and objects of a class by their attributes; the
    reader decides whether they may be named.

    :param value: the value
    :param name: what it is, for messages and for the names of its arrays
    :param tensors: takes its arrays and tensors, without copying what is on the CPU already
    :param schedule: whether it is a schedule, for which a table can stand if it has no name
    :return: the tree
    :raises NotPortable: if it holds something that such a file cannot; the message says what and where
    """
    return Encoder(tensors).encode(value, name, schedule=schedule)


class Encoder:
    """
    Makes trees of several values.

    :param tensors: takes their arrays and tensors
    """

    def __init__(self, tensors: dict[str, torch.Tensor]):
        self.tensors = tensors
        #: Paths of classes and functions that a reader of the file has to vouch for, by the name of the value.
        self.foreign: dict[str, str] = {}
        self._inside: set[int] = set()

    def put(self, tensor: torch.Tensor, name: str) -> str:
        unique, n = name, 1
        while unique in self.tensors:
            n += 1
            unique = f"{name} ({n})"
        self.tensors[unique] = tensor
        return unique

    @contextlib.contextmanager
    def all_or_nothing(self) -> Iterator[None]:
        """Remove what was written of a value that is refused half-way."""
        before = [(kept, len(kept)) for kept in (self.tensors, self.foreign)]
        try:
            yield
        except NotPortable:
            for kept, n in before:
                for key in list(kept)[n:]:
                    del kept[key]  # type: ignore[attr-defined]
            raise

    def encode(self, value: Any, name: str, depth: int = 0, schedule: bool = False) -> Any:
        """
        :param value: the value
        :param name: what it is
        :param depth: how deeply it is nested
        :param schedule: whether it is a schedule
        :return: its tree
        :raises NotPortable: as in :func:`encode`
        """
        cls = type(value)
        if depth > MAX_DEPTH or id(value) in self._inside:
            raise NotPortable(f"{name} is nested more than {MAX_DEPTH} times, or holds itself")
        if value is None or cls is bool or cls is str:
            return value
        if cls is int:
            # Beyond this range JSON's readers differ; hexadecimal digits are read in linear time.
            return value if -INT_MAX <= value < INT_MAX else {"int": hex(value)}
        if cls is float:
            return value if math.isfinite(value) else {"float": repr(value)}
        if schedule and callable(value):
            return self._schedule(value, name, depth)
        self._inside.add(id(value))
        try:
            return self._encode(value, name, depth)
        finally:
            self._inside.discard(id(value))

    def _schedule(self, value: Any, name: str, depth: int) -> Any:
        """
        Encode a schedule by its name, or an object by its attributes; by a table if no name leads to it, or its
        attributes are not plain.
        """
        if is_importable(value if isinstance(value, NAMED) else type(value)):
            with contextlib.suppress(NotPortable), self.all_or_nothing():
                return Encoder.encode(self, value, name, depth)
        try:
            table = ScheduleTable.of(value)
        except ValueError as error:
            raise NotPortable(f"{name}: no table can be made of the schedule, since {error}") from error
        return self.encode(table, name, depth)

    def _encode(self, value: Any, name: str, depth: int) -> Any:
        cls = type(value)
        if cls is list:
            return self._list(value, name, depth)
        tagged = self._plain(value, name, depth) or self._numbers(value, name) or self._objects(value, name, depth)
        if tagged is None:
            kind = f"{cls.__module__}.{cls.__qualname__}"
            raise NotPortable(f"{name}: an object of {kind} cannot be written to a file that runs no code")
        return tagged

    def _list(self, values: list[Any], name: str, depth: int) -> Any:
        for number, dtype in ((float, torch.float64), (int, torch.int64)):
            if len(values) > LONG and all(type(item) is number and not abs(item) >= INT_MAX for item in values):
                return {"numbers": self.put(torch.tensor(values, dtype=dtype), name)}
        return self._items(values, name, depth)

    def _items(self, values: Any, name: str, depth: int) -> list[Any]:
        return [self.encode(value, f"{name}[{i}]", depth + 1) for i, value in enumerate(values)]

    def _plain(self, value: Any, name: str, depth: int) -> dict[str, Any] | None:
        cls = type(value)
        if cls in (tuple, set, frozenset):
            return {cls.__name__: self._items(value, name, depth)}
        if cls is collections.deque:
            return {"deque": self._items(value, name, depth), "maxlen": value.maxlen}
        if cls is dict or cls is collections.OrderedDict:
            tag = "dict" if cls is dict else "ordered_dict"
            if all(type(key) is str for key in value):
                return {tag: {key: self.encode(item, f"{name}.{key}", depth + 1) for key, item in value.items()}}
            keys, items = self._items(value, name, depth), [*value.values()]
            named = zip(value, keys, items, strict=True)
            return {f"{tag}_items": [[key, self.encode(item, f"{name}[{k!r}]", depth + 1)] for k, key, item in named]}
        if cls is bytes:
            return {"bytes": base64.b64encode(value).decode()}
        if cls is complex:
            return {"complex": [self.encode(part, name, depth) for part in (value.real, value.imag)]}
        if isinstance(value, pathlib.PurePath):
            return {"path": str(value)}
        return None

    def _numbers(self, value: Any, name: str) -> dict[str, Any] | None:
        if type(value) is np.ndarray:
            return self._array(value, name)
        if isinstance(value, np.generic):
            dtype = _checked(value.dtype, name)
            if dtype.kind in "biuf" and dtype.itemsize <= 8:
                return {"scalar": [dtype.str, self.encode(value.item(), name, 0)]}
            return {"scalar_bytes": [dtype.str, base64.b64encode(value.tobytes()).decode()]}
        if isinstance(value, torch.Tensor):
            return self._tensor(value, name)
        if isinstance(value, np.dtype):
            return {"dtype": _checked(value, name).str}
        if isinstance(value, torch.dtype):
            return {"torch_dtype": str(value).removeprefix("torch.")}
        if isinstance(value, torch.device):
            return {"device": str(value)}
        return None

    def _array(self, array: np.ndarray, name: str) -> dict[str, Any]:
        dtype = _checked(array.dtype, name)
        array = array if array.flags.c_contiguous and array.flags.writeable else array.copy(order="C")
        if dtype.isnative and torch_has(dtype):
            return {"array": self.put(torch.from_numpy(array), name)}
        raw = np.frombuffer(bytearray(array.tobytes()), np.uint8) if array.nbytes else np.zeros(0, np.uint8)
        return {"raw_array": self.put(torch.from_numpy(raw), name), "dtype": dtype.str, "shape": list(array.shape)}

    def _tensor(self, tensor: torch.Tensor, name: str) -> dict[str, Any]:
        has_numbers = type(tensor) is torch.Tensor and tensor.layout == torch.strided and not tensor.is_meta
        if not has_numbers or tensor.dtype not in DTYPES.values():
            raise NotPortable(
                f"{name}: a {type(tensor).__name__} of {tensor.dtype} and {tensor.layout} cannot be written to the file"
            )
        encoded: dict[str, Any] = {"tensor": self.put(tensor.detach().cpu(), name)}
        if tensor.requires_grad:
            encoded["requires_grad"] = True
        return encoded

    def _objects(self, value: Any, name: str, depth: int) -> dict[str, Any] | None:
        if isinstance(value, type) and issubclass(value, np.generic):
            return {"numpy_type": _checked(np.dtype(value), name).str}
        if isinstance(value, NAMED):
            return {"import": self._path(value, name)}
        if isinstance(value, enum.Enum):
            if object_path(value, ENUMERATIONS) is None:
                self.foreign[name] = path_of(type(value))
            return {"enum": path_of(type(value)), "member": member_of(value)}
        if path := object_path(value, NAMED_TUPLES):
            return {"named_tuple": path, "items": self._items(value, name, depth)}
        if path := object_path(value, OBJECTS):
            return self._known_object(value, path, name, depth)
        if type(value) in SPACES:
            return self._space(value, name, depth)
        return self._generator(value, name, depth) or self._instance(value, name, depth)

    def _path(self, value: Any, name: str) -> str:
        """The path of a class or function; noted in ``foreign`` if a reader has to vouch for it."""
        path = path_of(value)
        if not isinstance(value, type) and not is_importable(value):
            raise NotPortable(
                f"{name}: the function {value!r} has no name that a file can hold: it is not that of a module"
            )
        try:
            if resolve(path, ()) is value:
                return path
        except ValueError:
            self.foreign[name] = path
            return path
        raise NotPortable(f"{name}: {value!r} is not what {path!r} names")

    def _known_object(self, value: Any, path: str, name: str, depth: int) -> dict[str, Any]:
        if vars(value).keys() != OBJECTS[path].keys():
            raise NotPortable(f"{name}: an object of {path} with other attributes than {sorted(OBJECTS[path])}")
        state = {}
        for key, item in vars(value).items():
            # The user knows an argument by its own name, not by that of Stable-Baselines3's wrapper.
            wraps = key == "value_schedule"
            state[key] = self.encode(item, name if wraps else f"{name}.{key}", depth + 1, schedule=wraps)
            check_attribute(path, key, item, name, NotPortable)
        return {"object": path, "attributes": state}

    def _instance(self, value: Any, name: str, depth: int) -> dict[str, Any] | None:
        """Encode an object of a user's class by its attributes, if it consists of nothing else."""
        cls = type(value)
        is_plain = cls.__basicsize__ == _Plain.__basicsize__ and cls.__dictoffset__ != 0
        has_more = issubclass(cls, _OF_TRAINING) or within(cls.__module__, PACKAGES)
        has_more |= hasattr(cls, "state_dict") or hasattr(cls, "__del__")
        if not is_plain or has_more:
            return None
        attributes = {}
        path = self.foreign[name] = path_of(cls)
        for key, item in vars(value).items():
            if not may_be_set(cls, key):
                raise NotPortable(f"{name}: its {key!r} takes the place of what {path} does")
            attributes[key] = self.encode(item, f"{name}.{key}", depth + 1)
        return {"instance": path, "attributes": attributes}

    def _space(self, space: Any, name: str, depth: int) -> dict[str, Any]:
        arguments: dict[str, Any]
        match space:
            case spaces.Box():
                arguments = {"low": space.low, "high": space.high, "dtype": space.dtype}
            case spaces.Discrete():
                arguments = {"n": int(space.n), "start": int(space.start)}
                if space.dtype != np.int64:
                    arguments["dtype"] = space.dtype
            case spaces.MultiDiscrete():
                arguments = {"nvec": space.nvec, "start": space.start, "dtype": space.dtype}
            case spaces.MultiBinary():
                arguments = {"n": space.n}
            case _:
                inside = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
                arguments = {"spaces": [list(item) for item in inside]}
        encoded = {key: self.encode(value, f"{name}.{key}", depth + 1) for key, value in arguments.items()}
        drawn = self.encode(space._np_random, f"{name}.np_random", depth + 1)
        return {"space": type(space).__name__, "arguments": encoded, "np_random": drawn}

    def _generator(self, value: Any, name: str, depth: int) -> dict[str, Any] | None:
        if type(value) in (np.random.Generator, np.random.RandomState):
            bits = value.bit_generator if type(value) is np.random.Generator else value._bit_generator
            if type(bits).__name__ not in BIT_GENERATORS:
                raise NotPortable(f"{name}: a generator of {type(bits).__name__}, not of {sorted(BIT_GENERATORS)}")
            state = bits.state if type(value) is np.random.Generator else value.get_state(legacy=False)
            return {"numpy_random": type(value).__name__, "state": self.encode(state, name, depth + 1)}
        if type(value) is random.Random:
            version, words, gauss = value.getstate()
            state = [version, np.array(words, dtype=np.int64), gauss]
            return {"random": self.encode(state, name, depth + 1)}
        if type(value) is torch.Generator:
            state = self.encode(value.get_state(), name, depth + 1)
            return {"torch_generator": state, "device": str(value.device)}
        return None


class Lenient(Encoder):
    """
    An encoder that leaves out what no file can hold.

    :param tensors: takes the values' arrays and tensors
    """

    def __init__(self, tensors: dict[str, torch.Tensor]):
        super().__init__(tensors)
        #: Values that are left out, by name, with the reason.
        self.left_out: dict[str, str] = {}

    def attempt(self, value: Any, name: str, schedule: bool = False) -> Any:
        """
        :param value: the value
        :param name: what it is
        :param schedule: whether it is a schedule
        :return: its tree; or, if no file can hold a part of it, the placeholder (:func:`is_left_out`)
        """
        try:
            with self.all_or_nothing():
                return self.encode(value, name, schedule=schedule)
        except NotPortable as error:
            return self.leave_out(name, str(error).removeprefix(f"{name}: "))

    def leave_out(self, name: str, reason: str) -> dict[str, str]:
        """
        :param name: the value to leave out
        :param reason: why
        :return: its placeholder
        """
        self.left_out[name] = reason
        return {LEFT_OUT: reason}


def is_left_out(tree: Any) -> bool:
    """
    :param tree: of a value, perhaps from a file
    :return: whether it stands for one that was left out
    """
    return isinstance(tree, dict) and tree.keys() == {LEFT_OUT} and isinstance(tree[LEFT_OUT], str)


def _checked(dtype: np.dtype, name: str) -> np.dtype:
    if not DTYPE_TEXT.fullmatch(dtype.str) or dtype.itemsize == 0 or np.dtype(dtype.str) != dtype:
        raise NotPortable(f"{name}: an array of {dtype} cannot be written to a file that runs no code")
    return dtype
