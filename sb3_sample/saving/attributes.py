"""
Convert attributes of objects to trees of plain values, and restore them in objects that were made in the same way.

No object is ever made from a tree: the program defines the classes, and only the values of the attributes come from the
tree. An object that attributes share, often a random generator, is shared again afterwards.
"""

import collections
import copy
import datetime
import decimal
import enum
import fractions
import functools
import inspect
import pathlib
import random
import re
import struct
import types
import uuid
import weakref
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from sb3_sample.saving.classes import in_program, may_be_set, member_of, of_member, path_of
from sb3_sample.saving.container import BadFile
from sb3_sample.saving.functions import FUNCTIONS, OtherKind, held, holding, name_of
from sb3_sample.saving.hashes import distinct_hashes, part_name
from sb3_sample.saving.moments import check_moments
from sb3_sample.saving.places import is_elsewhere, is_moved
from sb3_sample.saving.shared_memory import as_array, block_of, group, view_at

_CONSTANTS = (type(None), bool, int, float, complex, str, bytes, np.generic, np.dtype, torch.dtype, torch.device)
_GENERATORS = (np.random.Generator, np.random.RandomState, random.Random)
_CONTAINERS = (list, tuple, dict, set, frozenset, collections.deque, np.ndarray)
#: Descriptions that do not change; parts of a program.
_INERT = (gym.envs.registration.EnvSpec, types.ModuleType, pathlib.PurePath, *FUNCTIONS)
#: The generators of a process, which are saved with it.
_GLOBAL = (random._inst, np.random.mtrand._rand, torch.default_generator)  # type: ignore[attr-defined]
#: Modules for drawing and writing, whose state affects nothing that follows.
_INERT_MODULES = (
    "gymnasium.envs.mujoco.mujoco_rendering", "pygame", "glfw", "OpenGL", "matplotlib", "moviepy", "logging", "tqdm",
    "rich", "stable_baselines3.common.logger",
)  # fmt: skip
_INERT_CLASSES = ("stable_baselines3.common.monitor.ResultsWriter",)
#: Modules whose objects have a state that their attributes do not show.
_FOREIGN_MODULES = ("mujoco", "dm_control", "gymnasium.envs", "multiprocessing", "threading", "subprocess", "socket")

#: Packages whose classes keep nothing that a training changes.
_LIBRARIES = (
    "builtins", "abc", "typing", "collections", "enum", "numpy", "torch", "gymnasium", "stable_baselines3",
    "sb3_contrib", "sb3_sample", "mujoco", "dm_control", "dm_env", "metaworld", "myosuite",
)  # fmt: skip
#: Immutable types that are not plain values; comparing values shows whether they stayed the same.
IMMUTABLE = (
    range, slice, re.Pattern, datetime.date, datetime.time, datetime.timedelta, datetime.tzinfo, decimal.Decimal,
    fractions.Fraction, uuid.UUID,
)  # fmt: skip
#: Types of class attributes that are not data.
_OF_CLASSES = (type, types.FunctionType, classmethod, staticmethod, property)
_POINTER = struct.calcsize("P")

Node = dict[str, Any]

#: Attributes of a class as they were first seen in this process, by name.
_FIRST: weakref.WeakKeyDictionary[type, dict[str, Node]] = weakref.WeakKeyDictionary()


#: Types of dict that can be made anew.
_DICTS: dict[str, type[dict[Any, Any]]] = {
    f"{cls.__module__}.{cls.__qualname__}": cls for cls in (dict, collections.OrderedDict, collections.Counter)
}


class Opaque(ValueError):
    """A value that cannot be broken down into plain ones."""


class DoesNotFit(ValueError):
    """A tree that does not belong to the object in which it is to be restored."""


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
    :return: whether it has no state that affects anything that follows
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


def _slots(cls: type) -> dict[str, Any]:
    """Members that a class and its bases keep in slots, by name; those of a subclass hide those of its bases."""
    members: dict[str, Any] = {}
    for base in reversed(cls.__mro__):
        if "__slots__" in vars(base):
            found = ((name, member) for name, member in vars(base).items() if inspect.ismemberdescriptor(member))
            members.update(found)
    return members


def attributes_of(owner: Any) -> dict[str, Any]:
    """
    :param owner: an object
    :return: its attributes, including those in slots
    """
    slots = {name: getattr(owner, name) for name in _slots(type(owner)) if hasattr(owner, name)}
    return {**slots, **getattr(owner, "__dict__", {})}


def keeps_more(cls: type) -> bool:
    """
    :param cls: a class
    :return: whether its objects have state besides their attributes, in memory that a C library has added
    """
    n_pointers = len(_slots(cls)) + (cls.__dictoffset__ > 0) + (cls.__weakrefoffset__ > 0)
    return cls.__itemsize__ != 0 or cls.__basicsize__ > object.__basicsize__ + n_pointers * _POINTER


def _data_of(cls: type) -> dict[str, Any]:
    """A class's own attributes that may be data which a program changes."""
    return {
        name: value
        for name, value in vars(cls).items()
        if not name.startswith(("__", "_abc_"))
        and not isinstance(value, _OF_CLASSES)
        and (isinstance(value, types.MethodType) or not hasattr(type(value), "__get__"))
        and (isinstance(value, FUNCTIONS) or not is_inert(value))
    }


def _classes_of(value: Any) -> list[type]:
    """The classes of an object that come from the program itself or from an unknown library."""
    mro = type(value).__mro__
    return [cls for cls in mro if cls.__module__.partition(".")[0] not in _LIBRARIES]


def _has_state_dict(value: Any) -> bool:
    return callable(getattr(value, "state_dict", None)) and callable(getattr(value, "load_state_dict", None))


def _generators_of(space: gym.Space) -> Iterator[gym.Space]:
    """A space and the spaces in it, each of which has its own generator."""
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
    return foreign or keeps_more(type(value)) or not (hasattr(value, "__dict__") or _slots(type(value)))


def _may_have(owner: Any, name: str) -> bool:
    """
    Whether an object can have an attribute: one that it has, or may get later, but nothing that defines the behaviour
    of its class, except the kept value of a ``cached_property``.
    """
    kept = isinstance(inspect.getattr_static(type(owner), name, None), functools.cached_property)
    known = name in attributes_of(owner) or name in _slots(type(owner))
    return known or may_be_set(type(owner), name) or kept


def _enumeration(path: Any) -> type[enum.Enum] | None:
    """Find the enumeration of a path in this program; None if there is none."""
    found = in_program(path) if isinstance(path, str) else None
    return found if isinstance(found, type) and issubclass(found, enum.Enum) else None


class Describer:
    """
    Makes trees of the attributes of several objects that may share values.

    :param inert: further objects (by identity) whose state is saved elsewhere
    :param whole: whether to describe also the values that functions hold, the memory that arrays share
        (:meth:`finish`), and the data that classes keep (:meth:`classes`); otherwise functions are inert
    """

    def __init__(self, inert: Collection[Any] = (), whole: bool = False):
        self._whole = whole
        self._origin: int | None = None
        self._inert = {id(value) for value in (*_GLOBAL, *inert)}
        # References keep the objects alive, so that no identity is given twice.
        self._seen: dict[int, tuple[int, Any]] = {}
        self._count = 0
        self._place = ""
        #: Arrays: the description, the array, and the attribute that it belongs to.
        self._arrays: list[tuple[Node, Any, str]] = []
        self._classes: dict[type, None] = {}
        self._n_classes = 0

    def enter(self, inert: Collection[Any], origin: int | None) -> None:
        """
        Continue with further objects, which may share values with those described so far.

        :param inert: further objects (by identity) whose state is saved elsewhere
        :param origin: address of memory that is saved elsewhere; a view of it is described by its place alone
        """
        self._inert |= {id(value) for value in inert}
        self._origin = origin

    def attributes(self, owner: Any, skip: Collection[str] = ()) -> tuple[dict[str, Node], list[str]]:
        """
        :param owner: an object
        :param skip: names of attributes to leave out
        :return: its attributes, without the inert ones; and those that cannot be described, as ``name (class)``
        """
        self._note_classes(owner)
        own = {name: value for name, value in attributes_of(owner).items() if name not in skip}
        return self._describe_each(own, type(owner).__name__)

    def _describe_each(self, values: dict[str, Any], place: str) -> tuple[dict[str, Node], list[str]]:
        described: dict[str, Node] = {}
        opaque: list[str] = []
        for name, value in values.items():
            if id(value) in self._inert or (is_inert(value) and not self._is_function(value)):
                continue
            self._place = f"{place}: {name}"
            if isinstance(value, gym.Space) and all(part._np_random is None for part in _generators_of(value)):
                continue
            known, n_arrays = len(self._seen), len(self._arrays)
            try:
                described[name] = self.describe(value)
            except (Opaque, RecursionError) as error:
                opaque.append(f"{name} ({error})")
                # Later references must not lead to objects that were described only in part.
                for key in list(self._seen)[known:]:
                    del self._seen[key]
                del self._arrays[n_arrays:]
        return described, opaque

    def _is_function(self, value: Any) -> bool:
        return self._whole and isinstance(value, FUNCTIONS)

    def _note_classes(self, value: Any) -> None:
        if self._whole:
            self._classes.update(dict.fromkeys(_classes_of(value)))

    def classes(self) -> tuple[dict[str, dict[str, Node]], list[str]]:
        """
        :return: for the classes of the objects described since the last call, by the name of the class, the attributes
            that have changed since they were first looked at in this process; and those that cannot be described, as
            ``class: name (class)``
        """
        described: dict[str, dict[str, Node]] = {}
        opaque: list[str] = []
        # Describing their values may add further classes.
        while self._n_classes < len(self._classes):
            cls = list(self._classes)[self._n_classes]
            self._n_classes += 1
            data = _data_of(cls)
            now = {name: self._glance(value) for name, value in data.items()}
            first = _FIRST.setdefault(cls, now)
            changed = {
                name: value
                for name, value in data.items()
                if "opaque" in now[name] or name not in first or not same(now[name], first[name])
            }
            attributes, unknown = self._describe_each(changed, cls.__name__)
            if attributes:
                described[f"{cls.__module__}.{cls.__qualname__}"] = attributes
            opaque += [f"{cls.__name__}: {what}" for what in unknown]
        return described, opaque

    def _glance(self, value: Any) -> Node:
        """A description that can be compared with one made at another time."""
        if isinstance(value, IMMUTABLE):
            return {"value": value}
        other = Describer(whole=True)
        other._inert = self._inert
        try:
            return other.describe(value)
        except Opaque:
            return {"opaque": class_name(value)}

    def finish(self) -> list[str]:
        """
        Record in the descriptions which arrays share memory, once everything that may share it is described.

        :return: the attributes that share memory in a way that cannot be described, as ``class: name (why)``
        """
        opaque = []
        arrays = [array for _, value, _ in self._arrays if (array := as_array(value)) is not None]
        for indices in group(arrays):
            found = block_of([arrays[i] for i in indices])
            nodes = [self._arrays[i][0] for i in indices]
            if found is None:
                opaque += [f"{self._arrays[i][2]} (an array that shares the memory of another)" for i in indices]
                continue
            block, places = found
            for node, place in zip(nodes, places, strict=True):
                what = node.pop("value")
                node |= {"memory": block if node is nodes[0] else nodes[0]["id"], "place": place}
                node |= {"dtype": what.dtype} if isinstance(what, torch.Tensor) else {}
        self._arrays = []
        return opaque

    def describe(self, value: Any) -> Node:
        """
        :param value: any value
        :return: its tree
        :raises Opaque: it cannot be described; the message names the class of the offending part
        """
        if isinstance(value, enum.Enum):
            return {"enum": member_of(value), "of": path_of(type(value))}
        if isinstance(value, _CONSTANTS):
            return {"value": value}
        if id(value) in self._seen:
            return {"same": self._seen[id(value)][0]}
        number, self._count = self._count, self._count + 1
        self._seen[id(value)] = (number, value)
        node = {"id": number, **self._describe(value)}
        if self._whole and "value" in node and as_array(value) is not None:
            self._arrays.append((node, value, self._place))
        return node

    def _describe(self, value: Any) -> Node:
        if id(value) in self._inert:
            return {"inert": class_name(value)}
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
            # Long lists, such as the returns of all episodes, are small as arrays.
            for number, dtype in ((float, np.float64), (int, np.int64)):
                if len(value) > 16 and all(type(item) is number and abs(item) < 2**63 for item in value):
                    return {"numbers": np.array(value, dtype)}
            if all(isinstance(item, _CONSTANTS) and not isinstance(item, enum.Enum) for item in value):
                return {"value": list(value)}
            return {"list": [self.describe(item) for item in value]}
        if type(value) in (set, frozenset):
            if not all(isinstance(item, _CONSTANTS) and not isinstance(item, enum.Enum) for item in value):
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
        if self._is_function(value):
            return self._describe_function(value)
        if is_inert(value):
            return {"inert": class_name(value)}
        if _has_state_dict(value):
            n_arrays = len(self._arrays)
            node = {"state_dict": self.describe(value.state_dict())}
            # Its tensors are loaded into the present ones, which share memory as before.
            del self._arrays[n_arrays:]
            return node
        if _is_opaque(value):
            raise Opaque(class_name(value))
        self._note_classes(value)
        attributes = {name: self.describe(item) for name, item in attributes_of(value).items()}
        return {"object": class_name(value), "attributes": attributes}

    def _describe_function(self, function: Any) -> Node:
        name, holds = name_of(function), {}
        for where, value in held(function).items():
            try:
                holds[where] = self.describe(value)
            except Opaque as error:
                raise Opaque(f"{name} with {where}: {error}") from error
        return {"function": name, "holds": holds}


class Restorer:
    """
    Gives objects the attributes that trees describe.

    :param inert: as for the :class:`Describer`, the same objects in this process
    """

    def __init__(self, inert: Collection[Any] = ()) -> None:
        self._inert = {id(value) for value in (*_GLOBAL, *inert)}
        self._origin: int | None = None
        self._made: dict[int, Any] = {}
        self._blocks: dict[int, np.ndarray] = {}
        self._classes: dict[str, type] = {}
        #: Attributes that were left as they are, since the tree names other files in them; each is listed once, however
        #: many objects of a class have it.
        self.kept: list[str] = []

    def enter(self, inert: Collection[Any], origin: int | None) -> None:
        """
        Continue with further objects, as in :meth:`Describer.enter`.

        :param inert: the same objects in this process
        :param origin: the same memory in this process
        """
        self._inert |= {id(value) for value in inert}
        self._origin = origin

    def attributes(
        self, owner: Any, described: dict[str, Node], skip: Collection[str] = (), anywhere: Collection[str] = ()
    ) -> None:
        """
        :param owner: the object, made in the same way as the one that was described
        :param described: from :meth:`Describer.attributes`
        :param skip: names of attributes that were left out
        :param anywhere: names of attributes whose texts are never taken as names of files
        :raises DoesNotFit: it is of another class, or was made in another way; or the tree describes an attribute that
            is never saved
        """
        own, slots = attributes_of(owner), _slots(type(owner))
        self._classes.update((f"{cls.__module__}.{cls.__qualname__}", cls) for cls in _classes_of(owner))
        for name in described:
            if name in skip or not _may_have(owner, name):
                raise DoesNotFit(f"{name!r:.100} is not saved of a {type(owner).__name__}")
        for name, value in self._restored(described, own, type(owner).__name__, anywhere):
            if name in slots:
                slots[name].__set__(owner, value)
            else:
                vars(owner)[name] = value

    def _restored(
        self, described: dict[str, Node], own: dict[str, Any], place: str, anywhere: Collection[str] = ()
    ) -> Iterator[tuple[str, Any]]:
        """Restored attributes by name, without those that name other files than the object's present ones."""
        for name, node in described.items():
            present = own.get(name)
            if name in anywhere or not is_elsewhere(name, node, present):
                yield name, self.restore(node, present, part_name(place, f".{name}"))
                continue
            self.leave(node, present)
            if not is_moved(node, present) and f"{place}.{name}" not in self.kept:
                self.kept.append(f"{place}.{name}")

    def leave(self, node: Node, present: Any) -> None:
        """
        Make references to an attribute that is left as it is lead to its present value.

        :param node: the attribute's description
        :param present: the value that is there now
        """
        if type(node.get("id")) is int:
            self._made[node["id"]] = present

    def classes(self, described: dict[str, dict[str, Node]]) -> None:
        """
        :param described: from :meth:`Describer.classes`, for the classes of the objects that were restored
        :raises DoesNotFit: it describes other classes
        """
        for class_, attributes in described.items():
            if class_ not in self._classes:
                raise DoesNotFit(f"{class_!r:.100} is no class of what was saved")
            cls = self._classes[class_]
            data = _data_of(cls)
            for name in attributes:
                if name not in data and not (may_be_set(cls, name) and not hasattr(cls, name)):
                    raise DoesNotFit(f"{name!r:.100} is not saved of {class_}")
            for name, value in self._restored(attributes, data, cls.__name__):
                setattr(cls, name, value)

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
            value = self._made[node["same"]]
        else:
            if self._is_inert(present) and not {"inert", "function"} & node.keys():
                raise DoesNotFit(f"{name} is a {class_name(present)}, which stays as it is")
            # Numbers were counted up on writing; within this bound each has a distinct hash.
            if type(node.get("id", 0)) is not int or not 0 <= node.get("id", 0) < 2**60:
                raise DoesNotFit(f"{name} cannot have the number {node['id']!r:.50}")
            try:
                value = self._restore(node, present, name)
            except (DoesNotFit, BadFile):
                raise
            except Exception as error:
                raise DoesNotFit(f"{name}: {type(error).__name__}: {error!s:.300}") from error
        # A function may be bound to another object of the same kind.
        rebound = isinstance(present, FUNCTIONS) and type(value) is type(present) and id(present) not in self._inert
        if self._is_inert(present) and value is not present and not rebound:
            raise DoesNotFit(f"{name} is a {class_name(present)}, which stays as it is")
        if "id" in node:
            self._made[node["id"]] = value
        return value

    def _restore(self, node: Node, present: Any, name: str) -> Any:
        def need(fits: bool, what: Any) -> None:
            if not fits:
                raise DoesNotFit(f"{name} is {class_name(present)}, but was {what}")

        def early(value: Any) -> Any:
            """Register a value before its parts, which may refer to it."""
            if "id" in node:
                self._made[node["id"]] = value
            return value

        match node:
            case {"value": torch.Tensor() as value} if isinstance(present, torch.Tensor):
                fits = present.shape == value.shape and present.dtype == value.dtype
                need(fits or not present.requires_grad, f"a tensor of {tuple(value.shape)} and {value.dtype}")
                if present.requires_grad:
                    # It is learned: an optimizer refers to it.
                    present.data.copy_(value)
                    return present
                return value.clone().to(present.device)
            case {"value": value}:
                return copy.deepcopy(value)
            case {"numbers": array}:
                return array.tolist()
            case {"memory": memory, "place": where}:
                return self._view(node, memory, where, name)
            case {"function": what, "holds": holds}:
                need(isinstance(present, FUNCTIONS) and name_of(present) == what, f"the function {what!r:.100}")
                return self._function(early(present), holds, name)
            case {"view": place}:
                there = isinstance(present, np.ndarray) and is_view_of_foreign_memory(present)
                fits = there and self._origin is not None and _place(present, self._origin) == list(place)
                need(fits, f"a view of the simulator's memory at {place}")
                return present
            case {"enum": member}:
                cls = type(present) if isinstance(present, enum.Enum) else _enumeration(node.get("of"))
                if cls is None:
                    raise DoesNotFit(f"{name} is {class_name(present)}, but was the member {member} of an enumeration")
                return of_member(cls, member)
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
                if what == "builtins.tuple":
                    return tuple(values)
                # Named tuples take their items as separate arguments, torch.Size and the like as one sequence.
                return type(present)(*values) if hasattr(present, "_fields") else type(present)(values)
            case {"deque": items, "maxlen": maxlen}:
                return collections.deque((self.restore(item, None, name) for item in items), maxlen)
            case {"dict": items, "of": what}:
                before = present if isinstance(present, dict) else {}
                mapping: Any = _DICTS.get(what, dict)()
                if class_name(mapping) != what:
                    # A dict with its own default.
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
                restored = self.restore(state, present.state_dict(), name)
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

    def _view(self, node: Node, memory: Any, place: Any, name: str) -> Any:
        if isinstance(memory, np.ndarray) and memory.dtype == np.uint8 and memory.ndim == 1 and "id" in node:
            memory, self._blocks[node["id"]] = node["id"], memory.copy()
        if not isinstance(memory, int) or memory not in self._blocks:
            raise DoesNotFit(f"{name} lies in memory that is not there")
        try:
            array = view_at(self._blocks[memory], place)
        except ValueError as error:
            raise DoesNotFit(f"{name}: {error}") from error
        if "dtype" not in node:
            return array
        tensor = torch.from_numpy(array)
        return tensor if tensor.dtype == node["dtype"] else tensor.view(torch.bfloat16)

    def _function(self, function: Any, described: dict[str, Node], name: str) -> Any:
        holds = held(function)
        if described.keys() != holds.keys():
            raise DoesNotFit(f"{name} holds {sorted(holds)}, but held {sorted(described)}")
        # Names of files stay as they are.
        values = {**holds, **dict(self._restored(described, holds, name))}
        try:
            return holding(function, values)
        except OtherKind as error:
            raise DoesNotFit(f"{name}: {error}") from error


def with_what_they_refer_to(names: Iterable[str], described: dict[str, Node]) -> dict[str, Node]:
    """
    :param names: of attributes
    :param described: from :meth:`Describer.attributes`
    :return: these attributes and those that hold the values that they refer to, the latter first
    """
    holders = {number: name for name, node in described.items() for number in _numbers(node, "id")}
    found, ahead = set(names) & described.keys(), list(names)
    while ahead:
        for number in _numbers(described.get(ahead.pop(), {}), "same"):
            if (holder := holders[number]) not in found:
                found.add(holder)
                ahead.append(holder)
    # In the order of the description, every value comes before the references to it.
    return {name: node for name, node in described.items() if name in found}


def _numbers(tree: Any, key: str) -> Iterator[int]:
    """The numbers under a key, anywhere in a tree."""
    if isinstance(tree, dict):
        # An attribute of an object may have this name, but its value is a tree.
        if type(tree.get(key)) is int:
            yield tree[key]
        tree = tree.values()
    elif not isinstance(tree, (list, tuple)):
        return
    for part in tree:
        yield from _numbers(part, key)


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
