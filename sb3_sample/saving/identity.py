"""Identity of a run: its arguments, as far as two programs can be compared by them."""

import json
from hashlib import sha256
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.saving import training_state, vec_envs
from sb3_sample.saving.checks import library_class
from sb3_sample.saving.classes import path_of
from sb3_sample.saving.encoding import GENERATORS, NAMED, Encoder, NotPortable, bytes_of
from sb3_sample.saving.model_tree import schedule_names
from sb3_sample.saving.schedules import ScheduleTable


class _Comparable(Encoder):
    """
    Describes the values that a program passes anew whenever it is started. Values that no file can hold are compared by
    their import path; generators, whose states a checkpoint holds, by their type.
    """

    def encode(self, value: Any, name: str, depth: int = 0, schedule: bool = False) -> Any:
        try:
            return super().encode(value, name, depth, schedule)
        except NotPortable:
            return {"of": path_of(value if isinstance(value, NAMED) else type(value))}

    def _plain(self, value: Any, name: str, depth: int) -> dict[str, Any] | None:
        found = super()._plain(value, name, depth)
        if found is not None and type(value) in (set, frozenset):
            # Their order is that of hashes, which differ between processes.
            return {tag: sorted(items, key=json.dumps) for tag, items in found.items()}
        return found

    def _generator(self, value: Any, name: str, depth: int) -> dict[str, Any] | None:
        return {"generator": path_of(type(value))} if isinstance(value, GENERATORS) else None


def identity_of(model: BaseAlgorithm, env: VecEnv) -> dict[str, list[str]]:
    """
    :param model: the algorithm, before its training
    :param env: the environment in which it is trained
    :return: by the argument's name: a digest to compare, and the value to show
    """
    values = {**training_state.arguments_of(model), "env": vec_envs.fingerprint(env)}
    schedules = schedule_names(library_class(type(model)))
    identity = {}
    for name, value in values.items():
        tensors: dict[str, torch.Tensor] = {}
        tree = _Comparable(tensors).encode(value, name, schedule=name in schedules)
        digest = sha256(json.dumps(tree, sort_keys=True).encode())
        for key in sorted(tensors):
            digest.update(key.encode())
            digest.update(bytes_of(tensors[key]))
        identity[name] = [digest.hexdigest(), _shown(value, name in schedules)]
    return identity


def _shown(value: Any, is_schedule: bool) -> str:
    """A value in words: a schedule by its values, since the names of two closures say nothing."""
    try:
        return repr(ScheduleTable.of(value)) if is_schedule and callable(value) else repr(value)
    except ValueError:
        return repr(value)
