"""
Attributes of objects as trees of plain values, and back into objects that were made in the same way.

No object is ever made from a tree: what a class is stays the business of the program, only the values of the attributes
come from the tree. What is shared between attributes, as a random generator often is, is shared again afterwards.
"""

import collections
import copy
import enum
import functools
import inspect
import pathlib
import random
import types
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from sb3_sample.saving.classes import may_be_set
from sb3_sample.saving.hashes import distinct_hashes, part_name
from sb3_sample.saving.moments import check_moments
from sb3_sample.saving.places import is_elsewhere, is_moved

_CONSTANTS = (type(None), bool, int, float, complex, str, bytes, np.generic, np.dtype, torch.dtype, torch.device)
_GENERATORS = (np.random.Generator, np.random.RandomState, random.Random)
_CONTAINERS = (list, tuple, dict, set, frozenset, collections.deque, np.ndarray)
#: What describes and does not change; what a program is made of.
_INERT = (
    gym.envs.registration.EnvSpec, type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType,
    types.MethodType, pathlib.PurePath,
)  # fmt: skip
#: Modules of what draws and what writes, whose state decides nothing that follows.
_INERT_MODULES = (
    "gymnasium.envs.mujoco.mujoco_rendering", "pygame", "glfw", "OpenGL", "matplotlib", "moviepy", "logging", "tqdm",
    "rich", "stable_baselines3.common.logger",
)  # fmt: skip
_INERT_CLASSES = ("stable_baselines3.common.monitor.ResultsWriter",)
#: Modules whose objects have a state that their attributes do not show.
_FOREIGN_MODULES = ("mujoco", "dm_control", "gymnasium.envs", "multiprocessing", "threading", "subprocess", "socket")

Node = dict[str, Any]


class Opaque(ValueError):
    """A value that cannot be told apart into plain ones."""


class DoesNotFit(ValueError):
    """A tree that is not of the object that it is to be restored in."""


def class_name(value: Any) -> str:
    """
    :param value: an object
    :return: the import path of its class
    """
    return f"{type(value).__module__}.{type(value).__qualname__}"


def _in(value: Any, modules: Sequence[str]) -> bool:
    module = type(value).__module__
    return any(module == name or module.startswith(f"{name}.") for name in modules)


def is_inert(value: Any) -> bool:
    """
    :param value: the value of an attribute
    :return: whether it has no state that anything that follows depends on
    """
    return isinstance(value, _INERT) or _in(value, _INERT_MODULES) or class_name(value) in _INERT_CLASSES


def is_view_of_foreign_memory(array: np.ndarray) -> bool:
    """
    :param array: an array
    :return: whether its numbers lie in the memory of another library, as a simulator's do
    """
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return type(base).__name__ == "PyCapsule"


def _place(view: np.ndarray, origin: int) -> list[Any]:
    return [view.__array_interface__["data"][0] - origin, list(view.shape), list(view.strides), view.dtype.str]


def _has_state_dict(value: Any) -> bool:
    return callable(getattr(value, "state_dict", None)) and callable(getattr(value, "load_state_dict", None))


def _generators_of(space: gym.Space) -> Iterator[gym.Space]:
    """A space and the spaces in it, each of which has a generator of its own."""
    yield space
    inside: Any = getattr(space, "spaces", ())
    for part in inside.values() if isinstance(inside, dict) else inside:
        yield from _generators_of(part)


def without_generators(space: gym.Space) -> gym.Space:
    """
    :param space: a space
    :return: the same, not yet seeded
    """
    bare = copy.deepcopy(space)
    for part in _generators_of(bare):
        part._np_random = None
    return bare


def _is_opaque(value: Any) -> bool:
    """Whether a value is more than its attributes, so that none of them is described."""
    foreign = isinstance(value, (gym.Env, *_CONTAINERS)) or _in(value, _FOREIGN_MODULES)
    return foreign or not hasattr(value, "__dict__")


def _may_have(owner: Any, name: str) -> bool:
    """
    Whether an object can have an attribute: one that is there, or comes in the course of its life, and is never what
    its class does, but for a value that a class keeps once it is computed.
    """
    kept = isinstance(inspect.getattr_static(type(owner), name, None), functools.cached_property)
    return name in vars(owner) or may_be_set(type(owner), name) or kept


class Describer:
    """
    Makes trees of the attributes of several objects that may share values.

    :param inert: further objects (by identity) whose state is saved elsewhere
    :param origin: address of memory that is saved elsewhere: where a view of it lies is all that is described of it
    """

    def __init__(self, inert: Collection[Any] = (), origin: int | None = None):
        self._origin = origin
        self._inert = {id(value) for value in inert}
        # The objects are kept, so that no identity is given twice.
        self._seen: dict[int, tuple[int, Any]] = {}
        self._count = 0

    def attributes(self, owner: Any, skip: Collection[str] = ()) -> tuple[dict[str, Node], list[str]]:
        """
        :param owner: an object
        :param skip: names of attributes to leave out
        :return: its attributes, without those that are inert; and what of them cannot be described, as
            ``name (class)``
        """
        described: dict[str, Node] = {}
        opaque: list[str] = []
        for name, value in vars(owner).items():
            if name in skip or id(value) in self._inert or is_inert(value):
                continue
            if isinstance(value, gym.Space) and all(part._np_random is None for part in _generators_of(value)):
                continue
            known = len(self._seen)
            try:
                described[name] = self.describe(value)
            except Opaque as error:
                opaque.append(f"{name} ({error})")
                # What was described half way is not there to be referred to.
                for key in list(self._seen)[known:]:
                    del self._seen[key]
        return described, opaque

    def describe(self, value: Any) -> Node:
        """
        :param value: any value
        :return: its tree
        :raises Opaque: it cannot be described; the message names the class of what cannot
        """
        if isinstance(value, enum.Enum):
            return {"enum": value.name}
        if isinstance(value, _CONSTANTS):
            return {"value": value}
        if id(value) in self._seen:
            return {"same": self._seen[id(value)][0]}
        number, self._count = self._count, self._count + 1
        self._seen[id(value)] = (number, value)
        return {"id": number, **self._describe(value)}

    def _describe(self, value: Any) -> Node:
        if isinstance(value, np.ndarray) and value.dtype != object:
            if not is_view_of_foreign_memory(value):
                return {"value": value.copy()}
            if self._origin is None:
                raise Opaque("a view of the memory of another library")
            return {"view": _place(value, self._origin)}
        if isinstance(value, torch.Tensor):
            return {"value": value.detach().clone()}
        if isinstance(value, _GENERATORS):
            return {"value": copy.deepcopy(value)}
        if isinstance(value, torch.Generator):
            return {"torch_generator": value.get_state()}
        if type(value) is list:
            # Long ones, as of all episodes' returns, are small as arrays.
            for number, dtype in ((float, np.float64), (int, np.int64)):
                if len(value) > 16 and all(type(item) is number and abs(item) < 2**63 for item in value):
                    return {"numbers": np.array(value, dtype)}
            if all(isinstance(item, _CONSTANTS) and not isinstance(item, enum.Enum) for item in value):
                return {"value": list(value)}
            return {"list": [self.describe(item) for item in value]}
        if type(value) in (set, frozenset):
            if not all(isinstance(item, _CONSTANTS) for item in value):
                raise Opaque(class_name(value))
            return {"value": set(value) if type(value) is set else frozenset(value)}
        if isinstance(value, tuple):
            return {"tuple": [self.describe(item) for item in value], "of": class_name(value)}
        if type(value) is collections.deque:
            return {"deque": [self.describe(item) for item in value], "maxlen": value.maxlen}
        if isinstance(value, dict) and type(value).__module__ in ("builtins", "collections"):
            items = [[self.describe(key), self.describe(item)] for key, item in value.items()]
            return {"dict": items, "of": class_name(value)}
        if isinstance(value, gym.Space):
            return {"space": [self.describe(part._np_random) for part in _generators_of(value)]}
        if is_inert(value) or id(value) in self._inert:
            return {"inert": class_name(value)}
        if _has_state_dict(value):
            return {"state_dict": self.describe(value.state_dict())}
        if _is_opaque(value):
            raise Opaque(class_name(value))
        return {"object": class_name(value), "attributes": {k: self.describe(v) for k, v in vars(value).items()}}


class Restorer:
    """
    Gives objects the attributes that trees describe.

    :param inert: as of the :class:`Describer`, the same objects in this process
    :param origin: as of the :class:`Describer`, the same memory in this process
    """

    def __init__(self, inert: Collection[Any] = (), origin: int | None = None) -> None:
        self._origin = origin
        self._inert = {id(value) for value in inert}
        self._made: dict[int, Any] = {}
        #: Attributes that stayed as they are, since the tree names other files in them.
        self.kept: list[str] = []

    def attributes(self, owner: Any, described: dict[str, Node], skip: Collection[str] = ()) -> None:
        """
        :param owner: the object, made as the one that was described
        :param described: from :meth:`Describer.attributes`
        :param skip: names of attributes that were left out
        :raises DoesNotFit: it is of another class, or was made in another way; or an attribute is described that never
            is
        """
        own = vars(owner)
        for name, node in described.items():
            present, whole = own.get(name), part_name(type(owner).__name__, f".{name}")
            if name in skip or not _may_have(owner, name):
                raise DoesNotFit(f"{name!r:.100} is not saved of a {type(owner).__name__}")
            if is_elsewhere(name, node, present):
                if not is_moved(node, present):
                    self.kept.append(f"{type(owner).__name__}.{name}")
                continue
            value = self.restore(node, present, whole)
            if self._is_inert(present) and value is not present:
                raise DoesNotFit(f"{whole} is a {class_name(present)}, which stays as it is")
            own[name] = value

    def _is_inert(self, value: Any) -> bool:
        return id(value) in self._inert or is_inert(value)

    def restore(self, node: Node, present: Any, name: str) -> Any:
        """
        :param node: from :meth:`Describer.describe`
        :param present: the value that is there now
        :param name: for messages
        :return: the value
        :raises DoesNotFit: ``present`` is not of the kind that was described
        """
        if "same" in node:
            if type(node["same"]) is not int or node["same"] not in self._made:
                raise DoesNotFit(f"{name} refers to something that is not there")
            return self._made[node["same"]]
        if self._is_inert(present) and "inert" not in node:
            raise DoesNotFit(f"{name} is a {class_name(present)}, which stays as it is")
        # Counted up when it was written, so that each has a hash of its own.
        if type(node.get("id", 0)) is not int or not 0 <= node.get("id", 0) < 2**60:
            raise DoesNotFit(f"{name} cannot have the number {node['id']!r:.50}")
        value = self._restore(node, present, name)
        if "id" in node:
            self._made[node["id"]] = value
        return value

    def _restore(self, node: Node, present: Any, name: str) -> Any:
        def need(fits: bool, what: Any) -> None:
            if not fits:
                raise DoesNotFit(f"{name} is {class_name(present)}, but was {what}")

        def early(value: Any) -> Any:
            """Known before its parts are, which may refer to it."""
            if "id" in node:
                self._made[node["id"]] = value
            return value

        match node:
            case {"value": value}:
                return copy.deepcopy(value)
            case {"numbers": array}:
                return array.tolist()
            case {"view": place}:
                there = isinstance(present, np.ndarray) and is_view_of_foreign_memory(present)
                fits = there and self._origin is not None and _place(present, self._origin) == list(place)
                need(fits, f"a view of the simulator's memory at {place}")
                return present
            case {"enum": member}:
                need(isinstance(present, enum.Enum), f"the member {member} of an enumeration")
                return type(present)[member]
            case {"torch_generator": state}:
                need(isinstance(present, torch.Generator), "a torch.Generator")
                present.set_state(state)
                return present
            case {"list": items}:
                old = present if isinstance(present, list) and len(present) == len(items) else [None] * len(items)
                made: list[Any] = early([])
                made.extend(self.restore(item, old[i], part_name(name, f"[{i}]")) for i, item in enumerate(items))
                return made
            case {"tuple": items, "of": what}:
                need(what == "builtins.tuple" or class_name(present) == what, what)
                parts = present if isinstance(present, tuple) and len(present) == len(items) else (None,) * len(items)
                values = [self.restore(item, parts[i], part_name(name, f"[{i}]")) for i, item in enumerate(items)]
                # Named tuples take their items one by one.
                return tuple(values) if what == "builtins.tuple" else type(present)(*values)
            case {"deque": items, "maxlen": maxlen}:
                return collections.deque((self.restore(item, None, name) for item in items), maxlen)
            case {"dict": items, "of": what}:
                before = present if isinstance(present, dict) else {}
                mapping: Any = collections.OrderedDict() if what == "collections.OrderedDict" else {}
                if class_name(mapping) != what:
                    # One with a default of its own.
                    need(class_name(present) == what, what)
                    mapping = copy.copy(present)
                    mapping.clear()
                early(mapping)
                keys = distinct_hashes([self.restore(key, None, name) for key, _ in items], name)
                for key, (_, item) in zip(keys, items, strict=True):
                    mapping[key] = self.restore(item, before.get(key), part_name(name, f"[{key!r:.100}]"))
                return mapping
            case {"space": generators}:
                need(isinstance(present, gym.Space), "a space")
                subspaces = list(_generators_of(present))
                need(len(subspaces) == len(generators), "another space")
                for part, generator in zip(subspaces, generators, strict=True):
                    part._np_random = self.restore(generator, part._np_random, name)
                return present
            case {"state_dict": state}:
                need(_has_state_dict(present), "something with load_state_dict")
                restored = self.restore(state, None, name)
                if isinstance(present, torch.optim.Optimizer):
                    check_moments(present, restored, name)
                present.load_state_dict(restored)
                return present
            case {"inert": what}:
                need(class_name(present) == what, what)
                return present
            case {"object": what, "attributes": attributes}:
                need(class_name(present) == what and not _is_opaque(present), what)
                early(present)
                self.attributes(present, attributes)
                return present
        raise DoesNotFit(f"{name} is described by {sorted(node)}")


def same(first: Any, second: Any) -> bool:
    """
    :param first: a tree
    :param second: another
    :return: whether they are equal, arrays and generators element by element
    """
    if type(first) is not type(second):
        return False
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(value, second[key]) for key, value in first.items())
    if isinstance(first, (list, tuple, collections.deque)):
        return len(first) == len(second) and all(map(same, first, second))
    if isinstance(first, np.ndarray):
        return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()
    if isinstance(first, torch.Tensor):
        return first.dtype == second.dtype and torch.equal(first, second)
    if isinstance(first, np.random.Generator):
        return same(first.bit_generator.state, second.bit_generator.state)
    if isinstance(first, np.random.RandomState):
        return same(first.get_state(), second.get_state())
    if isinstance(first, random.Random):
        return first.getstate() == second.getstate()
    return bool(first == second) or (first != first and second != second)
