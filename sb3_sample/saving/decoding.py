"""Read values that ``encoding.py`` wrote: only objects that this file and ``classes.py`` name are made."""

import base64
import binascii
import collections
import enum
import math
import pathlib
import random
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from sb3_sample.learner.randomness import checked_state
from sb3_sample.saving.classes import (
    DTYPE_TEXT,
    ENUMERATIONS,
    INT_MAX,
    MAX_DEPTH,
    NAMED_TUPLES,
    OBJECTS,
    SPACES,
    check_attribute,
    check_trusted,
    class_of,
    may_be_set,
    of_member,
    resolve,
    torch_has,
    within,
)
from sb3_sample.saving.container import BadFile
from sb3_sample.saving.generators import check_python_state, numpy_generator
from sb3_sample.saving.hashes import distinct_hashes, part_name

#: Errors of a library's constructors if a file holds nonsense.
_NONSENSE = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, AssertionError, RuntimeError)


class NotTrusted(BadFile):
    """
    A file names a class or function that nobody vouches for, or that is not there.

    :param message: where, and which
    :param path: its import path, from the file
    """

    def __init__(self, message: str, path: str):
        super().__init__(message)
        self.path = path


def decode(tree: Any, tensors: dict[str, torch.Tensor], name: str, trusted: Sequence[str] = ()) -> Any:
    """
    Rebuild the value that ``encode`` was given. Tensors that it refers to are taken out of ``tensors``, so that none is
    used twice and unused ones are left.

    :param tree: the tree
    :param tensors: its arrays and tensors; the value keeps their memory
    :param name: what it is, for messages
    :param trusted: modules, or packages of modules, whose classes and functions it may name
    :return: the value
    :raises NotTrusted: (a ``BadFile``) if it names others
    :raises BadFile: if the tree is not one that ``encode`` makes
    """
    return _Decoder(tensors, check_trusted(trusted)).decode(tree, name, 0)


class _Decoder:
    def __init__(self, tensors: dict[str, torch.Tensor], trusted: tuple[str, ...]):
        self.tensors, self.trusted = tensors, trusted

    def decode(self, tree: Any, name: str, depth: int) -> Any:
        if depth > MAX_DEPTH:
            raise BadFile(f"{name} is nested more than {MAX_DEPTH} times")
        if tree is None or isinstance(tree, (bool, int, float, str)):
            return tree
        if isinstance(tree, list):
            return [self.decode(item, part_name(name, f"[{i}]"), depth + 1) for i, item in enumerate(tree)]
        if not isinstance(tree, dict) or not tree:
            raise BadFile(f"{name} is not described as it must be")
        tag, *further = tree
        expected = _FURTHER.get(tag, ())
        if tag not in _READERS or not set(further) <= set(expected):
            raise BadFile(f"{name} is described by {sorted(tree)}, which is unknown to this version")
        try:
            return _READERS[tag](self, tree[tag], tree, name, depth)
        except BadFile:
            raise
        except (*_NONSENSE, binascii.Error) as error:
            raise BadFile(f"{name}: the file's {tag} is none: {error}") from error

    def take(self, key: Any, name: str) -> torch.Tensor:
        if not isinstance(key, str) or key not in self.tensors:
            raise BadFile(f"{name} refers to the tensor {key!r}, which is not in the file, or refers to it again")
        return self.tensors.pop(key)

    def _left_out(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        raise BadFile(f"{name} was left out when the file was written ({tree!r:.200})")

    def _list(self, tree: Any, name: str, depth: int) -> list[Any]:
        if not isinstance(tree, list):
            raise BadFile(f"{name} must be a list in the file, not {type(tree).__name__}")
        decoded: list[Any] = self.decode(tree, name, depth)
        return decoded

    def _numbers(self, tree: Any, whole: Any, name: str, depth: int) -> list[Any]:
        tensor = self.take(tree, name)
        if tensor.dtype not in (torch.float64, torch.int64) or tensor.dim() != 1:
            raise BadFile(f"{name} must be a list of numbers in the file, not a tensor of {tensor.dtype}")
        return tensor.tolist()

    def _complex(self, tree: Any, whole: Any, name: str, depth: int) -> complex:
        real, imaginary = self._list(tree, name, depth)
        if type(real) is not float or type(imaginary) is not float:
            raise BadFile(f"{name}: {real!r} and {imaginary!r} are no complex number")
        return complex(real, imaginary)

    def _deque(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        maxlen = whole["maxlen"]
        items = self._list(tree, name, depth)
        if maxlen is not None and not (type(maxlen) is int and len(items) <= maxlen < INT_MAX):
            raise BadFile(f"{name}: a deque of {len(items)} items cannot have maxlen={maxlen!r}")
        return collections.deque(items, maxlen)

    def _dict(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        if not isinstance(tree, dict):
            raise BadFile(f"{name} must be an object in the file, not {type(tree).__name__}")
        items = {key: self.decode(value, part_name(name, f".{key}"), depth + 1) for key, value in tree.items()}
        return items if "dict" in whole else collections.OrderedDict(items)

    def _dict_items(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        keys = distinct_hashes((self.decode(key, name, depth + 1) for key, _ in tree), name)
        items = {
            key: self.decode(value, part_name(name, f"[{key!r:.100}]"), depth + 1)
            for key, (_, value) in zip(keys, tree, strict=True)
        }
        return items if "dict_items" in whole else collections.OrderedDict(items)

    def _set(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        items = distinct_hashes(self._list(tree, name, depth), name)
        return set(items) if "set" in whole else frozenset(items)

    def _scalar(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        text, item = tree
        value = self.decode(item, name, depth + 1)
        dtype = _read_dtype(text, name)
        if dtype.kind not in "biuf" or type(value) is not {"b": bool, "f": float}.get(dtype.kind, int):
            raise BadFile(f"{name}: {value!r} is no {text!r}")
        return np.array(value, dtype)[()]

    def _scalar_bytes(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        text, data = tree
        return _from_bytes(base64.b64decode(data, validate=True), text, [], name)[()]

    def _array(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        tensor = self.take(tree, name)
        if tensor.dtype == torch.bfloat16 or not torch_has(np.dtype(str(tensor.dtype).removeprefix("torch."))):
            raise BadFile(f"{name} must be an array in the file, not a tensor of {tensor.dtype}")
        return tensor.numpy()

    def _raw_array(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        raw = self.take(tree, name)
        if raw.dtype != torch.uint8 or raw.dim() != 1:
            raise BadFile(f"{name}: the bytes of an array must be a vector of them")
        return _from_bytes(raw.numpy().tobytes(), whole["dtype"], whole["shape"], name)

    def _tensor(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        return self.take(tree, name).requires_grad_(bool(whole.get("requires_grad", False)))

    def _enum(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        known = isinstance(tree, str) and tree in ENUMERATIONS
        cls: Any = class_of(tree, ENUMERATIONS, name) if known else self._import(tree, whole, name, depth)
        if not issubclass(cls, enum.Enum):
            raise BadFile(f"{name}: {tree!r:.100} is no enumeration")
        return of_member(cls, whole["member"])

    def _named_tuple(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        cls = class_of(tree, NAMED_TUPLES, name)
        items = self._list(whole["items"], name, depth)
        wanted = NAMED_TUPLES[tree]
        if len(items) != len(wanted) or not all(map(isinstance, items, wanted)):
            raise BadFile(f"{name}: {items} are no items of {tree}")
        return cls(*items)

    def _import(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        if not isinstance(tree, str):
            raise BadFile(f"{name}: {tree!r:.100} is no name of a class or function")
        try:
            return resolve(tree, self.trusted)
        except ValueError as error:
            raise NotTrusted(f"{name}: {error}", tree) from error

    def _instance(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        cls = self._import(tree, whole, name, depth)
        module = tree.partition(":")[0]
        if not isinstance(cls, type) or not within(module, self.trusted):
            raise NotTrusted(f"{name}: {tree!r:.300} is no class of a module that is trusted", tree)
        if hasattr(cls, "__del__"):
            raise BadFile(f"{name}: an object of {tree} does something when it goes away, and none is made from a file")
        attributes = whole["attributes"]
        made: Any = object.__new__(cls)
        for key, item in attributes.items():
            if not may_be_set(cls, key):
                raise BadFile(f"{name}: an object of {tree} must not have its {key!r:.100} set")
            vars(made)[key] = self.decode(item, part_name(name, f".{key}"), depth + 1)
        return made

    def _object(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        cls: Any = class_of(tree, OBJECTS, name)
        attributes = whole["attributes"]
        if not isinstance(attributes, dict) or attributes.keys() != OBJECTS[tree].keys():
            raise BadFile(f"{name}: an object of {tree} must have the attributes {sorted(OBJECTS[tree])}")
        made = cls.__new__(cls)
        for key, item in attributes.items():
            value = self.decode(item, part_name(name, f".{key}"), depth + 1)
            check_attribute(tree, key, value, name, BadFile)
            vars(made)[key] = value
        return made

    def _space(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        by_name: dict[str, Any] = {cls.__name__: cls for cls in SPACES}
        cls, described = by_name[tree], whole["arguments"]
        arguments = {key: self.decode(value, part_name(name, f".{key}"), depth + 1) for key, value in described.items()}
        if cls is spaces.Box:
            low, high = arguments["low"], arguments["high"]
            if not (isinstance(low, np.ndarray) and isinstance(high, np.ndarray)) or low.shape != high.shape:
                raise BadFile(f"{name}: the bounds of a Box must be arrays of one shape")
            if np.isnan(low).any() or np.isnan(high).any():
                raise BadFile(f"{name}: the bounds of a Box must be numbers, not NaN")
            space: Any = cls(low, high, dtype=arguments["dtype"])
        elif cls in (spaces.Dict, spaces.Tuple):
            inside = dict(arguments["spaces"])
            if not all(isinstance(part, spaces.Space) for part in inside.values()):
                raise BadFile(f"{name}: the parts of a space must be spaces")
            # Ordered, so that the keys are not sorted.
            ordered = collections.OrderedDict(inside)
            space = cls(ordered) if cls is spaces.Dict else cls(list(inside.values()))
            if cls is spaces.Dict:
                space.spaces = inside
        else:
            space = cls(**arguments)
        drawn = self.decode(whole["np_random"], f"{name}.np_random", depth + 1)
        if drawn is not None and type(drawn) is not np.random.Generator:
            raise BadFile(f"{name}: the generator of a space must be one of numpy.random")
        space._np_random = drawn
        return space

    def _numpy_random(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        return numpy_generator(tree, self.decode(whole["state"], name, depth + 1), name)

    def _random(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        version, words, gauss = self.decode(tree, name, depth + 1)
        state = (version, tuple(words.tolist()), gauss)
        check_python_state(state, name)
        made = random.Random(0)
        made.setstate(state)
        return made

    def _torch_generator(self, tree: Any, whole: Any, name: str, depth: int) -> Any:
        made = torch.Generator(_read_device(whole["device"], name))
        state = self.decode(tree, name, depth + 1)
        made.set_state(checked_state(state, name) if made.device.type == "cpu" else state)
        return made


def _read_dtype(text: Any, name: str) -> np.dtype:
    if not isinstance(text, str) or not DTYPE_TEXT.fullmatch(text) or np.dtype(text).itemsize == 0:
        raise BadFile(f"{name}: {text!r} is no kind of number that the file may hold")
    return np.dtype(text)


def _read_torch_dtype(text: Any, name: str) -> torch.dtype:
    # Not by getattr, which triggers torch's lazy imports.
    dtype = vars(torch).get(text) if isinstance(text, str) else None
    if not isinstance(dtype, torch.dtype):
        raise BadFile(f"{name}: {text!r} is no kind of number of torch")
    return dtype


def _read_device(text: Any, name: str) -> torch.device:
    if not isinstance(text, str):
        raise BadFile(f"{name}: {text!r} is no device")
    return torch.device(text)


def _from_bytes(data: bytes, dtype_text: Any, shape: Any, name: str) -> np.ndarray:
    dtype = _read_dtype(dtype_text, name)
    if not isinstance(shape, list) or not all(type(n) is int and n >= 0 for n in shape) or len(shape) > 64:
        raise BadFile(f"{name}: {shape!r} is no shape")
    if math.prod(shape) * dtype.itemsize != len(data):
        raise BadFile(f"{name}: {len(data)} bytes are no array of shape {shape} and {dtype}")
    array = np.ndarray(shape, dtype, data).copy()
    if dtype.kind == "U" and (array.ravel().view(f"{dtype.byteorder}u4") > sys.maxunicode).any():
        raise BadFile(f"{name}: a text holds what are no characters")
    return array


#: Readers by tag. Their arguments: the decoder, the value of the tag, the whole object, its name and its depth.
_READERS: dict[str, Callable[[_Decoder, Any, Any, str, int], Any]] = {
    "left_out": _Decoder._left_out,
    "int": lambda d, tree, whole, name, depth: int(tree, 16),
    "float": lambda d, tree, whole, name, depth: {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}[tree],
    "complex": _Decoder._complex,
    "numbers": _Decoder._numbers,
    "bytes": lambda d, tree, whole, name, depth: base64.b64decode(tree, validate=True),
    "tuple": lambda d, tree, whole, name, depth: tuple(d._list(tree, name, depth)),
    "set": _Decoder._set,
    "frozenset": _Decoder._set,
    "deque": _Decoder._deque,
    "dict": _Decoder._dict,
    "ordered_dict": _Decoder._dict,
    "dict_items": _Decoder._dict_items,
    "ordered_dict_items": _Decoder._dict_items,
    "scalar": _Decoder._scalar,
    "scalar_bytes": _Decoder._scalar_bytes,
    "array": _Decoder._array,
    "raw_array": _Decoder._raw_array,
    "tensor": _Decoder._tensor,
    "dtype": lambda d, tree, whole, name, depth: _read_dtype(tree, name),
    "numpy_type": lambda d, tree, whole, name, depth: _read_dtype(tree, name).type,
    "torch_dtype": lambda d, tree, whole, name, depth: _read_torch_dtype(tree, name),
    "device": lambda d, tree, whole, name, depth: _read_device(tree, name),
    "path": lambda d, tree, whole, name, depth: pathlib.Path(tree),
    "import": _Decoder._import,
    "enum": _Decoder._enum,
    "named_tuple": _Decoder._named_tuple,
    "object": _Decoder._object,
    "instance": _Decoder._instance,
    "space": _Decoder._space,
    "numpy_random": _Decoder._numpy_random,
    "random": _Decoder._random,
    "torch_generator": _Decoder._torch_generator,
}
#: Further entries that may stand beside a tag.
_FURTHER: dict[str, tuple[str, ...]] = {
    "deque": ("maxlen",),
    "raw_array": ("dtype", "shape"),
    "tensor": ("requires_grad",),
    "enum": ("member",),
    "named_tuple": ("items",),
    "object": ("attributes",),
    "instance": ("attributes",),
    "space": ("arguments", "np_random"),
    "numpy_random": ("state",),
    "torch_generator": ("device",),
}
