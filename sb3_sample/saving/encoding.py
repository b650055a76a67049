"""
Values as trees of JSON with their arrays beside them, and back: what a file that runs no code can hold.

In a tree None, booleans, texts, lists, and numbers that JSON has stand for themselves. Anything else is an object with
one key, which says what it is: ``{"tuple": [1, 2]}``, ``{"array": "observations"}``. Reading makes nothing but what
this file and the tables of ``classes.py`` name, whatever stands in the tree.
"""

import base64
import collections
import enum
import math
import random
import types
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from sb3_sample.saving.classes import (
    BIT_GENERATORS,
    DTYPE_TEXT,
    ENUMERATIONS,
    HOW,
    INT_MAX,
    MAX_DEPTH,
    NAMED_TUPLES,
    OBJECTS,
    SPACES,
    NotPortable,
    check_attribute,
    check_trusted,
    checked_path,
    object_path,
    torch_has,
)
from sb3_sample.saving.container import DTYPES
from sb3_sample.saving.decoding import decode

__all__ = ["NotPortable", "decode", "encode"]


def encode(value: Any, name: str, tensors: dict[str, torch.Tensor], trusted: Sequence[str] = ()) -> Any:
    """
    A value as a tree of JSON. Tensors on other devices are copied to the CPU, where :func:`decode` leaves them. A value
    that occurs twice is two values afterwards, and a generator can draw on, but not spawn as before.

    :param value: the value
    :param name: what it is, for messages and for the names of its arrays
    :param tensors: takes its arrays and tensors, without copying what is on the CPU already
    :param trusted: modules, or packages of modules, whose classes and functions it may name
    :return: the tree
    :raises NotPortable: if it holds what has no place in such a file; the message says what and where
    """
    return _Encoder(tensors, check_trusted(trusted)).encode(value, name, 0)


class _Encoder:
    def __init__(self, tensors: dict[str, torch.Tensor], trusted: tuple[str, ...]):
        self.tensors, self.trusted = tensors, trusted

    def put(self, tensor: torch.Tensor, name: str) -> str:
        unique, n = name, 1
        while unique in self.tensors:
            n += 1
            unique = f"{name} ({n})"
        self.tensors[unique] = tensor
        return unique

    def encode(self, value: Any, name: str, depth: int) -> Any:
        if depth > MAX_DEPTH:
            raise NotPortable(f"{name} is nested more than {MAX_DEPTH} times, or holds itself")
        cls = type(value)
        if value is None or cls is bool or cls is str:
            return value
        if cls is int:
            # JSON's readers differ beyond, and hexadecimal digits are read in linear time.
            return value if -INT_MAX <= value < INT_MAX else {"int": hex(value)}
        if cls is float:
            return value if math.isfinite(value) else {"float": repr(value)}
        if cls is list:
            return self._items(value, name, depth)
        tagged = self._plain(value, name, depth) or self._numbers(value, name) or self._objects(value, name, depth)
        if tagged is None:
            raise NotPortable(
                f"{name}: an object of {cls.__module__}.{cls.__qualname__} cannot be written to a file that runs no "
                f"code. {HOW}"
            )
        return tagged

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
        if type(tensor) is not torch.Tensor or tensor.layout != torch.strided or tensor.dtype not in DTYPES.values():
            raise NotPortable(
                f"{name}: a {type(tensor).__name__} of {tensor.dtype} and {tensor.layout} cannot be written to the file"
            )
        encoded: dict[str, Any] = {"tensor": self.put(tensor.detach().cpu(), name)}
        if tensor.requires_grad:
            encoded["requires_grad"] = True
        return encoded

    def _objects(self, value: Any, name: str, depth: int) -> dict[str, Any] | None:
        if isinstance(value, type) and issubclass(value, np.generic):
            return {"numpy_type": np.dtype(value).str}
        if isinstance(value, (type, types.FunctionType, types.BuiltinFunctionType)):
            return {"import": checked_path(value, name, self.trusted)}
        if isinstance(value, enum.Enum) and (path := object_path(value, ENUMERATIONS)):
            return {"enum": path, "member": value.name}
        if path := object_path(value, NAMED_TUPLES):
            return {"named_tuple": path, "items": self._items(value, name, depth)}
        if path := object_path(value, OBJECTS):
            if vars(value).keys() != OBJECTS[path].keys():
                raise NotPortable(f"{name}: an object of {path} with other attributes than {sorted(OBJECTS[path])}")
            state = {}
            for key, item in vars(value).items():
                # An argument is known to the user by its own name, not by that of what Stable-Baselines3 wraps it in.
                state[key] = self.encode(item, name if key == "value_schedule" else f"{name}.{key}", depth + 1)
                check_attribute(path, key, item, name, NotPortable)
            return {"object": path, "attributes": state}
        if type(value) in SPACES:
            return self._space(value, name, depth)
        return self._generator(value, name, depth)

    def _space(self, space: Any, name: str, depth: int) -> dict[str, Any]:
        arguments: dict[str, Any]
        match space:
            case spaces.Box():
                arguments = {"low": space.low, "high": space.high, "dtype": space.dtype}
            case spaces.Discrete():
                arguments = {"n": int(space.n), "start": int(space.start)}
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


def _checked(dtype: np.dtype, name: str) -> np.dtype:
    if not DTYPE_TEXT.fullmatch(dtype.str) or dtype.itemsize == 0 or np.dtype(dtype.str) != dtype:
        raise NotPortable(f"{name}: an array of {dtype} cannot be written to a file that runs no code")
    return dtype
