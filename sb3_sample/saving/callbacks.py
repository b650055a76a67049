"""
The state of callbacks: their own if they have one (``state_dict`` and ``load_state_dict``), otherwise the attributes
that have changed in a training, so that attributes that never changed keep the values of the present program.
"""

import inspect
from collections.abc import Iterator, MutableMapping, Set
from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, ProgressBarCallback
from stable_baselines3.common.vec_env import VecEnv
from torch.utils.weak import WeakIdKeyDictionary

from sb3_sample.envs.portable_states import pack, unpack
from sb3_sample.saving import vec_envs
from sb3_sample.saving.attributes import (
    Describer,
    DoesNotFit,
    Node,
    Opaque,
    Restorer,
    attributes_of,
    class_name,
    same,
    with_what_they_refer_to,
)
from sb3_sample.saving.classes import may_be_set
from sb3_sample.saving.places import brings_text
from sb3_sample.warn import warn

#: Attributes that every callback has and that are not its own.
_NOT_OWN = ("model", "parent", "locals", "globals", "verbose")
#: Names of the attributes that this process's trainings have changed. The checkpoints of a second training of the same
#: callback also hold the attributes that only the first one has changed.
_CHANGED: MutableMapping[BaseCallback, set[str]] = WeakIdKeyDictionary()

#: Attributes that this process's trainings have changed, as they were when the first of these began, each with those
#: that hold the values it refers to; None for attributes that were not there.
_FIRST: MutableMapping[BaseCallback, dict[str, dict[str, Node] | None]] = WeakIdKeyDictionary()


def without_progress_bar(callback: BaseCallback) -> BaseCallback:
    """
    :param callback: the callback of a training
    :return: the same without the progress bar that ``learn`` put beside it, which parts of a run may or may not have
    """
    if isinstance(callback, CallbackList):
        others = [child for child in callback.callbacks if not isinstance(child, ProgressBarCallback)]
        if len(others) == 1 and len(callback.callbacks) == 2:
            return others[0]
    return callback


def walk(callback: BaseCallback, path: str = "callback") -> Iterator[tuple[str, BaseCallback]]:
    """
    :param callback: a callback
    :param path: its name
    :return: it and the callbacks that it calls, by their path
    """
    if isinstance(callback, ConvertCallback) and callback.callback is None:
        return  # Stable-Baselines3's stand-in for no callback
    yield path, callback
    for name, value in vars(callback).items():
        if name in _NOT_OWN:
            continue
        if isinstance(value, BaseCallback):
            yield from walk(value, f"{path}.{name}")
        elif isinstance(value, list):
            for i, item in enumerate(value):
                if isinstance(item, BaseCallback):
                    yield from walk(item, f"{path}.{name}[{i}]")


def environments(callback: BaseCallback) -> Iterator[tuple[str, VecEnv | gym.Env]]:
    """
    :param callback: a callback
    :return: its own environments, by the name of the attribute
    """
    for name, value in vars(callback).items():
        if name not in _NOT_OWN and isinstance(value, (VecEnv, gym.Env)):
            yield name, value


def _gives_state(callback: BaseCallback) -> bool:
    return hasattr(callback, "state_dict") and hasattr(callback, "load_state_dict")


def _state_of(callback: BaseCallback) -> tuple[Node | None, list[str]]:
    """The callback's own state, None if it has none; and the reason if a checkpoint cannot hold that state."""
    if not _gives_state(callback):
        return None, []
    try:
        return Describer().describe(callback.state_dict()), []  # type: ignore[attr-defined]
    except (Opaque, RecursionError) as error:
        return None, [f"state_dict ({error})"]


class CallbackStates:
    """
    The states of the callbacks of one training.

    :param callback: the callback, after its ``on_training_start``
    """

    def __init__(self, callback: BaseCallback):
        self._callbacks = dict(walk(without_progress_bar(callback)))
        self._before = {path: _each_apart(each) for path, each in self._callbacks.items()}
        self._there = {path: set(vars(each)) for path, each in self._callbacks.items()}
        self._start = {path: self._attributes(each)[0] for path, each in self._callbacks.items()}
        self._first = {path: _FIRST.setdefault(each, {}) for path, each in self._callbacks.items()}
        # Paths of the callbacks for which a warning was given that something is lost.
        self._told: set[str] = set()
        # Attributes that an earlier part of the run has changed belong to the state as well.
        self._changed = {path: _CHANGED.setdefault(each, set()) for path, each in self._callbacks.items()}

    def _attributes(self, callback: BaseCallback) -> tuple[dict[str, Node], list[str]]:
        return Describer().attributes(callback, _skipped(callback))

    def lost(self) -> list[str]:
        """
        :return: the parts of the callbacks that a checkpoint cannot hold
        """
        lost = []
        for path, callback in self._callbacks.items():
            what = [*self._attributes(callback)[1], *_state_of(callback)[1]]
            for name, env in environments(callback):
                what += [f"{name}, {reason}" for reason in _save_env(env)[1]]
            self._told |= {path} if what else set()
            lost += [f"{type(callback).__name__} ({path}): {each}" for each in what]
        return lost

    def save(self) -> dict[str, Any]:
        """
        :return: the state of each callback, by its path
        """
        return {path: self._save(path, callback) for path, callback in self._callbacks.items()}

    def note_changes(self) -> None:
        """Add the attributes that have changed since these states were made to the state in every training."""
        for path, callback in self._callbacks.items():
            self._note(path, callback)

    def _note(self, path: str, callback: BaseCallback) -> None:
        before, changed = self._before[path], self._changed[path]
        now = _each_apart(callback, changed)
        new = {name for name, node in now.items() if name not in before or not same(node, before[name])}
        changed |= new
        described = with_what_they_refer_to(new & before.keys(), self._start[path])
        for name in new:
            if name in described or name not in self._there[path]:
                self._first[path].setdefault(name, described if name in described else None)

    def _save(self, path: str, callback: BaseCallback) -> dict[str, Any]:
        now = self._attributes(callback)[0]
        self._note(path, callback)
        state, opaque = _state_of(callback)
        saved = {}
        for name, env in environments(callback):
            saved[name], reasons = _save_env(env)
            opaque += [f"{name}, {reason}" for reason in reasons]
        if opaque and path not in self._told:
            self._told.add(path)
            warn(f"A checkpoint does not hold the state of {type(callback).__name__} ({path}): {opaque[0]}")
        return {
            "class": class_name(callback),
            "attributes": with_what_they_refer_to(self._changed[path], now),
            "state": state,
            "environments": saved,
        }

    def restore(self, states: dict[str, Any]) -> None:
        """
        Give each callback the state saved at its path; warn if the callback there is another one, or missing.

        :param states: from :meth:`save`
        """
        for path, state in states.items():
            callback = self._callbacks.get(path)
            if callback is None or class_name(callback) != state["class"]:
                warn(f"The checkpoint has the state of a {state['class']} ({path}), which this training is without.")
                continue
            try:
                self._restore(path, callback, state)
            except DoesNotFit as error:
                warn(f"{type(callback).__name__} ({path}) starts anew: {error}")
        for path, callback in self._callbacks.items():
            if path not in states:
                warn(f"{type(callback).__name__} ({path}) starts anew: it is not in the checkpoint")

    def _restore(self, path: str, callback: BaseCallback, state: dict[str, Any]) -> None:
        attributes, own, arguments = state["attributes"], vars(callback), _arguments(callback)
        for name in attributes:
            if name in _skipped(callback) or not may_be_set(type(callback), name):
                raise DoesNotFit(f"{name!r:.100} is not saved of it")
        # The present program decides where it writes, and what.
        said = [name for name in attributes if name in arguments and brings_text(attributes[name], own.get(name))]
        restorer = Restorer()
        for name in said:
            restorer.leave(attributes[name], own.get(name))
        restorer.attributes(callback, {name: node for name, node in attributes.items() if name not in said})
        kept = [*(f"{type(callback).__name__}.{name}" for name in said), *restorer.kept]
        if kept:
            warn(f"{', '.join(kept)} of the checkpoint may name files, and stay as they are ({path})")
        self._changed[path] |= attributes.keys()
        if state["state"] is not None:
            own_state = callback.state_dict()  # type: ignore[attr-defined]
            callback.load_state_dict(Restorer().restore(state["state"], own_state, path))  # type: ignore[attr-defined]
        for name, env in environments(callback):
            if name in state["environments"]:
                _restore_env(env, state["environments"][name], f"{type(callback).__name__}.{name}")
        self._take_back(path, callback, attributes.keys())

    def _take_back(self, path: str, callback: BaseCallback, restored: Set[str]) -> None:
        """
        Give attributes that a checkpoint lacks, since nothing had changed them by then, the values that they had before
        an earlier call in this process changed them.
        """
        lacking = {
            name: of for name, of in self._first[path].items() if name not in restored and name in vars(callback)
        }
        for name in [name for name, of in lacking.items() if of is None]:
            delattr(callback, name)
            del lacking[name]
        # Attributes that were changed together may have values in common.
        for described in {id(of): of for of in lacking.values()}.values():
            assert described is not None
            nodes = {name: node for name, node in described.items() if name not in restored}
            try:
                Restorer().attributes(callback, nodes)
            except DoesNotFit as error:
                warn(f"{', '.join(nodes)} of {type(callback).__name__} ({path}) cannot be taken back: {error}")


def _skipped(callback: BaseCallback) -> Set[str]:
    """Names of the attributes of a callback that are not saved, or are saved otherwise."""
    if _gives_state(callback):
        return vars(callback).keys() - {"n_calls", "num_timesteps"}
    children = {name for name, value in vars(callback).items() if _is_or_holds_callbacks(value)}
    return {*_NOT_OWN, *children, *(name for name, _ in environments(callback))}


def _each_apart(callback: BaseCallback, skip: Set[str] = frozenset()) -> dict[str, Node]:
    """
    Describe each attribute but some by itself, to be compared at another time: in a common description an attribute
    that grows changes the numbers of those after it.
    """
    names, described = attributes_of(callback).keys(), dict[str, Node]()
    for name in names - _skipped(callback) - skip:
        described |= Describer().attributes(callback, names - {name})[0]
    return described


def _arguments(callback: BaseCallback) -> set[str]:
    """Names of the arguments that a callback is made with."""
    return {
        name
        for cls in type(callback).__mro__
        if (init := vars(cls).get("__init__")) is not None and inspect.isfunction(init)
        for name in inspect.signature(init).parameters
    }


def _is_or_holds_callbacks(value: Any) -> bool:
    return isinstance(value, BaseCallback) or (
        isinstance(value, list) and any(isinstance(item, BaseCallback) for item in value)
    )


def _save_env(env: VecEnv | gym.Env) -> tuple[dict[str, Any] | None, list[str]]:
    if isinstance(env, VecEnv):
        return vec_envs.save(env)
    state, opaque = pack(env)
    return (None if opaque else state), opaque


def _restore_env(env: VecEnv | gym.Env, state: dict[str, Any] | None, name: str) -> None:
    if isinstance(env, VecEnv):
        assert state is not None
        reasons = vec_envs.restore(env, state)
        if reasons and state["environments"] is not None:
            raise DoesNotFit(f"{name}: {'; '.join(reasons)}")
    elif state is not None:
        unpack(env, state)
