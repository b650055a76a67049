"""Validate a model's file before torch and the algorithms, which check little themselves, use it."""

import collections.abc
import functools
import inspect
import math
import numbers
import pathlib
import types
import typing
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.her import HerReplayBuffer

from sb3_sample.errors import ParametersDoNotFit as ParametersDoNotFit
from sb3_sample.saving.classes import PACKAGES, may_be_set, within
from sb3_sample.saving.container import BadFile
from sb3_sample.saving.replay import MAX_HER_TRANSITIONS, MAX_TRANSITIONS
from sb3_sample.saving.statistics import check_finite_numbers

#: The largest number of environments that a file can ask for.
MAX_ENVS = 100_000
#: The largest width, depth or number of networks that a file can ask for. Python makes lists of such lengths.
MAX_WIDTH = 1_000_000
#: The largest values that a file can ask for in arguments whose value alone costs work or memory: far above what
#: anybody trains with.
MOST = {
    "replay_ratio": 10_000, "gradient_steps": 1_000_000, "batch_size": 10_000_000, "n_steps": 10_000_000,
    "n_epochs": 100_000, "n_simulated": 1_000_000, "simulation_horizon": 100_000, "dynamics_batch_size": 10_000_000,
    "dynamics_buffer_size": MAX_TRANSITIONS, "train_freq": 10_000_000, "n_actions": 1_000_000, "horizon": 100_000,
    "copies": 100_000,
}  # fmt: skip
#: Bytes of a replay buffer that no machine holds.
MAX_BUFFER_BYTES = 2**44
#: Counts of what was done.
_COUNTS = (
    "num_timesteps", "_num_timesteps_at_start", "_total_timesteps", "_episode_num", "_n_updates", "num_transitions",
    "_iteration", "_n_new", "_n_offline_updates", "num_rewound_steps", "num_task_steps", "_began_at",
)  # fmt: skip
_MAX_COUNT = 2**53
_NUMBER = (int, float, np.integer, np.floating)
#: Attributes that belong to the program in which a model is, and to no file.
NEVER = (
    "policy", "env", "replay_buffer", "rollout_buffer", "_vec_normalize_env", "_logger", "_custom_logger",
    "_trusted_modules", "_told",
)  # fmt: skip


def _tensors_in(value: Any, name: str) -> Iterator[tuple[str, torch.Tensor]]:
    if isinstance(value, torch.Tensor):
        yield name, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _tensors_in(item, f"{name}.{key}")
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value):
            yield from _tensors_in(item, f"{name}.{i}")


def check_finite(owner: Any, state: Any, name: str, words: str, error: type[ValueError]) -> None:
    """
    Check that parameters and the state of optimizers are finite; a buffer, such as a mask, may hold infinity, but not
    NaN.
    """
    learned = None
    if isinstance(owner, torch.nn.Module):
        learned = {f"{name}.{key}" for key, _ in owner.named_parameters(remove_duplicate=False)}
    for key, tensor in _tensors_in(state, name):
        if not (tensor.is_floating_point() or tensor.is_complex()):
            continue
        bad = tensor.float().isnan() if learned is not None and key not in learned else ~tensor.float().isfinite()
        if bad.any():
            raise error(f"{key} {words + ' ' if words else ''}holds {int(bad.sum())} numbers that are not finite")


def library_class(cls: type) -> type:
    """
    :param cls: class of an algorithm
    :return: the nearest class at or above it that belongs to a library
    """
    return next(base for base in cls.__mro__ if within(base.__module__, PACKAGES))


def check_names(model: Any, attributes: dict[str, Any], name: str) -> None:
    """Check that a file sets only attributes: no method, and nothing that belongs to the class or the program."""
    left_out = model._excluded_save_params()
    for key, value in attributes.items():
        own = vars(model).get(key)
        if key in NEVER or (key in left_out and type(own) is not type(value) and own is not None):
            raise BadFile(f"{name} is damaged or hostile: it sets {key!r:.100}, which is not in a model's file")
        if not may_be_set(type(model), key):
            raise BadFile(f"{name} is damaged or hostile: it sets {key!r:.100}, which is no attribute of a model")


def check_sizes(model: Any, name: str, given: Collection[str]) -> None:
    """
    Limit sizes that the budget does not see, since they are allocated without torch or object by object; those that
    the caller has ``given`` are not limited.
    """
    if type(model.n_envs) is not int or not 1 <= model.n_envs <= MAX_ENVS:
        raise BadFile(f"{name}: n_envs must lie in [1, {MAX_ENVS}], not be {model.n_envs!r:.100}")
    for key, value in vars(model).items():
        if key.endswith("_kwargs") and key not in ("replay_buffer_kwargs", "rollout_buffer_kwargs", *given):
            _check_widths(value, key, f"{name}: {key}")
    buffer_class, size = getattr(model, "replay_buffer_class", None), getattr(model, "buffer_size", 1)
    most = MAX_TRANSITIONS
    if isinstance(buffer_class, type) and issubclass(buffer_class, HerReplayBuffer):
        most = MAX_HER_TRANSITIONS
    if "buffer_size" not in given:
        if type(size) is not int or not 1 <= size <= most:
            raise BadFile(
                f"{name}: buffer_size must lie in [1, {most}], not be {size!r:.100}: pass buffer_size= to load"
            )
        n_bytes = size * _bytes_of(model.observation_space) if hasattr(model, "buffer_size") else 0
        if n_bytes > MAX_BUFFER_BYTES:
            raise BadFile(
                f"{name}: a buffer_size of {size} takes {n_bytes} bytes, more than any machine has: pass buffer_size= "
                "to load"
            )
    for key, limit in MOST.items():
        value = getattr(model, key, None)
        number = value.frequency if isinstance(value, TrainFreq) else value
        # Anything but a number is refused by the algorithm.
        if key not in given and isinstance(number, _NUMBER) and number > limit:
            raise BadFile(f"{name}: {key} must be at most {limit}, not {number!r:.100}: pass {key}= to load")


def _bytes_of(space: Any) -> int:
    """Bytes of an observation, as a replay buffer holds it."""
    inside = getattr(space, "spaces", None)
    if inside is not None:
        return sum(map(_bytes_of, inside.values() if isinstance(inside, dict) else inside))
    return math.prod(space.shape or ()) * np.dtype(space.dtype or np.float32).itemsize


def check_counts(model: Any, name: str) -> None:
    """
    :param model: a model with the attributes from a file
    :param name: the file, for messages
    :raises BadFile: if a count is out of reach of any training, or it owes more gradient steps than a turn can leave
    """
    for key in _COUNTS:
        value = getattr(model, key, 0)
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value < _MAX_COUNT:
            raise BadFile(f"{name}: {key} must be an integer of at least 0, not {value!r:.100}")
    owed = getattr(model, "_updates_owed", 0.0)
    if not isinstance(owed, _NUMBER) or not -1 <= owed <= 1:
        raise BadFile(f"{name}: _updates_owed must lie in [-1, 1], not be {owed!r:.100}")


def check_last_observations(model: Any, may_be_none: bool = False) -> None:
    """
    :param model: a model with the attributes from a checkpoint, among them the observations with which its next step is
        stored
    :param may_be_none: whether its environments need not have been reset yet
    :raises BadFile: if its environments cannot have given these observations
    """
    for name in ("_last_obs", "_last_original_obs"):
        value = getattr(model, name)
        check_finite_numbers(value, name)
        arrays = value.values() if isinstance(value, dict) else [] if value is None else [value]
        if any(array.shape[:1] != (model.n_envs,) for array in arrays):
            raise BadFile(f"{name} is not one of each of {model.n_envs} environments")
    if may_be_none and model._last_obs is None:
        return
    if _shapes_of(model._last_obs) != _shapes_in(model.observation_space):
        raise BadFile(f"_last_obs is of shape {_shapes_of(model._last_obs)}, not of {model.observation_space}")


def _shapes_of(observations: Any) -> Any:
    """Shapes without the axis of the environments."""
    if isinstance(observations, dict):
        return {key: array.shape[1:] for key, array in observations.items()}
    return None if observations is None else observations.shape[1:]


def _shapes_in(space: Any) -> Any:
    return {key: part.shape for key, part in space.spaces.items()} if isinstance(space, spaces.Dict) else space.shape


def _check_widths(value: Any, argument: str, name: str) -> None:
    if isinstance(value, int) and abs(value) > MAX_WIDTH:
        raise BadFile(
            f"{name} holds {value!r:.100}, but sizes of networks are at most {MAX_WIDTH}: pass {argument}= to load"
        )
    if isinstance(value, dict):
        for key, item in value.items():
            _check_widths(item, argument, f"{name}.{key}")
    elif isinstance(value, (list, tuple)):
        for item in value:
            _check_widths(item, argument, name)


def check_kinds(model: Any, attributes: dict[str, Any], name: str) -> None:
    """
    :param model: a model of a library's class that is not set up: attributes that a user's own class adds can be
        anything
    :param attributes: what a file sets
    :param name: the file, for messages
    :raises BadFile: if a value is of another kind than the constructor or the present value has, such as a text for a
        number
    """
    cls: Any = type(model)
    hints = hints_of(cls)
    for key, value in attributes.items():
        own = getattr(model, key, None)
        # Some arguments are None once they are replaced by others.
        if value is None:
            fits = True
        elif key in hints:
            fits = _fits(value, hints[key])
        elif isinstance(own, numbers.Real):
            fits = isinstance(value, numbers.Real)
        else:
            # The present value is a default of the class, since the instance has none.
            fits = key in vars(model) or own is None or isinstance(value, type(own))
        if not fits:
            raise BadFile(f"{name} is damaged: {key} cannot be {value!r:.100}")


@functools.cache
def hints_of(cls: type) -> dict[str, Any]:
    """
    :param cls: class of an algorithm
    :return: the annotations of its constructor and of those of the classes above it, by the argument's name
    """
    hints: dict[str, Any] = {}
    for base in reversed(cls.__mro__):
        init = vars(base).get("__init__")
        if inspect.isfunction(init):
            try:
                hints.update(typing.get_type_hints(init))
            except NameError:  # named for the type checker only
                continue
    return hints


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of an annotated kind, as far as can be decided; any kind of number passes for any other."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, part) for part in arguments)
    if origin is typing.Literal:
        return isinstance(value, str) or value in arguments
    if hint is None or hint is type(None):
        return value is None
    kind = origin or hint
    if kind is collections.abc.Callable:
        return callable(value)
    if kind in (tuple, list, collections.abc.Sequence, collections.abc.Iterable):
        return isinstance(value, (tuple, list, np.ndarray))
    if kind is str:
        return isinstance(value, (str, pathlib.PurePath))
    if kind in (bool, int, float):
        return isinstance(value, (numbers.Real, np.bool_))
    return isinstance(value, kind) if isinstance(kind, type) else True


def check_extra(module: torch.nn.Module, state: Any, name: str) -> None:
    """
    :param module: the module; its own state shows what it keeps besides tensors
    :param state: its state in a file
    :param name: the file and the module, for messages
    :raises BadFile: if a part besides tensors is of another kind
    """
    for key, own in module.state_dict().items():
        if key.endswith("_extra_state") and isinstance(state, dict) and key in state and not _is_like(state[key], own):
            raise BadFile(f"{name}.{key} cannot be {state[key]!r:.200}")


def _is_like(value: Any, own: Any) -> bool:
    if isinstance(own, dict):
        return (
            isinstance(value, dict)
            and value.keys() == own.keys()
            and all(_is_like(value[key], own[key]) for key in own)
        )
    if isinstance(own, (list, tuple)):
        return isinstance(value, (list, tuple)) and all(_is_numbers(item) for item in value)
    if isinstance(own, numbers.Integral):
        return isinstance(value, numbers.Integral)
    return isinstance(value, numbers.Real) if isinstance(own, numbers.Real) else True


def _is_numbers(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return all(map(_is_numbers, value))
    return isinstance(value, numbers.Real)


def check_metadata(metadata: Any, name: str) -> None:
    """
    :param metadata: what a file says of the versions of a network's layers
    :param name: the file and the network, for messages
    :raises BadFile: if it is something else
    """
    if not isinstance(metadata, dict) or not all(
        isinstance(key, str) and isinstance(kept, dict) and isinstance(kept.get("version", 1), (int, type(None)))
        for key, kept in metadata.items()
    ):
        raise BadFile(f"{name}: {metadata!r:.200} are no versions of layers")


def check_environment(env: Any, observation_space: Any, action_space: Any) -> None:
    """
    Check that an environment fits a model.

    :param env: the environment
    :param observation_space: the model's
    :param action_space: the model's
    :raises ValueError: if its spaces differ; if they hold the same numbers, the message says how to proceed
    """
    try:
        check_for_correct_spaces(env, observation_space, action_space)
    except ValueError as error:
        theirs, ours = env.action_space, action_space
        same = _hold_alike(env.observation_space, observation_space) and _hold_alike(theirs, ours)
        if same and isinstance(ours, spaces.Box):
            same = np.allclose([theirs.low, theirs.high], [ours.low, ours.high])
        if not same:
            raise
        raise ValueError(
            f"{error}. Both hold the same numbers: save the model, and load(path, env=env, "
            "observation_space=env.observation_space, action_space=env.action_space) goes on with the environment's"
        ) from None


def _hold_alike(theirs: Any, ours: Any) -> bool:
    """Whether spaces are of one shape and one kind of numbers."""
    if isinstance(theirs, spaces.Dict) and isinstance(ours, spaces.Dict):
        return theirs.spaces.keys() == ours.spaces.keys() and all(
            _hold_alike(part, ours.spaces[key]) for key, part in theirs.spaces.items()
        )
    if type(theirs) is not type(ours) or theirs.shape != ours.shape:
        return False
    floats = isinstance(ours, spaces.Box) and np.dtype(theirs.dtype).kind == np.dtype(ours.dtype).kind == "f"
    return floats or bool(theirs == ours)
