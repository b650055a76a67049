"""What of a model's file is looked at before torch and the algorithms see it, who take much on trust."""

import collections.abc
import functools
import inspect
import numbers
import pathlib
import types
import typing
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
import torch
from stable_baselines3.her import HerReplayBuffer

from sb3_sample.saving.classes import PACKAGES, may_be_set, within
from sb3_sample.saving.container import BadFile
from sb3_sample.saving.replay import MAX_HER_TRANSITIONS, MAX_TRANSITIONS

#: Environments that a file can ask for.
MAX_ENVS = 100_000
#: The largest width, depth or number of networks that a file can ask for. Python makes lists of such lengths.
MAX_WIDTH = 1_000_000
#: What belongs to the program in which a model is, and to no file.
NEVER = (
    "policy", "env", "replay_buffer", "rollout_buffer", "_vec_normalize_env", "_logger", "_custom_logger",
    "_trusted_modules", "_told",
)  # fmt: skip
#: What the common optimizers keep of each parameter, in its shape. torch's fused kernels do not check it.
_MOMENTS = ("exp_avg", "exp_avg_sq", "max_exp_avg_sq", "momentum_buffer", "square_avg", "grad_avg")


class ParametersDoNotFit(ValueError, RuntimeError):
    """
    Parameters that are loaded are not those of this model. Also a ``RuntimeError``, as torch's own, since
    Stable-Baselines3's ``load`` takes a mere ``ValueError`` for a file of an old version of its own.
    """


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
    """Parameters and what optimizers keep must be finite; a buffer, such as a mask, may hold infinity, but not NaN."""
    learned = None
    if isinstance(owner, torch.nn.Module):
        learned = {f"{name}.{key}" for key, _ in owner.named_parameters(remove_duplicate=False)}
    for key, tensor in _tensors_in(state, name):
        if not (tensor.is_floating_point() or tensor.is_complex()):
            continue
        bad = tensor.float().isnan() if learned is not None and key not in learned else ~tensor.float().isfinite()
        if bad.any():
            raise error(f"{key} {words + ' ' if words else ''}holds {int(bad.sum())} numbers that are not finite")


def check_moments(optimizer: torch.optim.Optimizer, state: Any, name: str) -> None:
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    moments = state.get("state") if isinstance(state, dict) else None
    groups = state.get("param_groups") if isinstance(state, dict) else None
    if not isinstance(moments, dict) or not isinstance(groups, list):
        raise BadFile(f"{name} is no state of an optimizer")
    group_of: dict[int, int] = {}
    for n, group in enumerate(groups):
        indices = group.get("params") if isinstance(group, dict) else None
        if not isinstance(indices, list) or not all(type(i) is int for i in indices):
            raise BadFile(f"{name} does not say which parameters are in group {n}")
        group_of.update(dict.fromkeys(indices, n))
    order = list(group_of)
    kinds: dict[Any, set[Any]] = {}
    for index, kept in moments.items():
        if index not in order or order.index(index) >= len(parameters) or not isinstance(kept, dict):
            raise BadFile(f"{name} keeps something of a parameter {index!r:.50} that is not there")
        shape = parameters[order.index(index)].shape
        for key, value in kept.items():
            wanted = shape if key in _MOMENTS else torch.Size(()) if key == "step" else None
            if wanted is not None and (not isinstance(value, torch.Tensor) or value.shape != wanted):
                raise BadFile(f"{name}: {key} of parameter {index} must be a tensor of shape {tuple(wanted)}")
        # An optimizer may keep something else of vectors than of matrices, but the same of all matrices.
        if kinds.setdefault((group_of[index], len(shape)), set(kept)) != set(kept):
            raise BadFile(f"{name} keeps {sorted(map(str, kept))} of parameter {index}, but others of other parameters")


def library_class(cls: type) -> type:
    """
    :param cls: class of an algorithm
    :return: the nearest class above it that is of a library, itself perhaps
    """
    return next(base for base in cls.__mro__ if within(base.__module__, PACKAGES))


def check_names(model: Any, attributes: dict[str, Any], name: str) -> None:
    """A file sets attributes, but never in the place of a method or of what belongs to the class or the program."""
    left_out = model._excluded_save_params()
    for key, value in attributes.items():
        own = vars(model).get(key)
        if key in NEVER or (key in left_out and type(own) is not type(value) and own is not None):
            raise BadFile(f"{name} is damaged or hostile: it sets {key!r:.100}, which is not in a model's file")
        if not may_be_set(type(model), key):
            raise BadFile(f"{name} is damaged or hostile: it sets {key!r:.100}, which is no attribute of a model")


def check_sizes(model: Any, name: str, given: Collection[str]) -> None:
    """
    What is allocated without torch, or object by object, and so out of the budget's sight, as far as it is not
    ``given`` by the caller.
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
    if "buffer_size" not in given and (type(size) is not int or not 1 <= size <= most):
        raise BadFile(f"{name}: buffer_size must lie in [1, {most}], not be {size!r:.100}: pass another one to load")


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
    :param model: a model of a library's class that is not set up: what a class of the user's own adds can be anything
    :param attributes: what a file sets
    :param name: the file, for messages
    :raises BadFile: if a value is of another kind than the constructor or its present value say: a text for a number
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
            # A default of the class, as no instance has one.
            fits = key in vars(model) or own is None or isinstance(value, type(own))
        if not fits:
            raise BadFile(f"{name} is damaged: {key} cannot be {value!r:.100}")


@functools.cache
def hints_of(cls: type) -> dict[str, Any]:
    """
    :param cls: class of an algorithm
    :return: what its constructor and those of the classes above it take, by the argument's name
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
    """Whether a value is of an annotated kind, as far as that can be said; any number passes for any other."""
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
    :param module: which knows what it keeps besides tensors
    :param state: what a file has for it
    :param name: the file and the module, for messages
    :raises BadFile: if that is of another kind
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
