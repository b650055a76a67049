"""Arguments of the algorithms' constructors and of ``learn``, of both families."""

import difflib
import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_sample.envs.registration import check_game, is_atari_id
from sb3_sample.errors import ParametersDoNotFit
from sb3_sample.kinds import AT_LEAST_0, DICT, VERBOSE, Kind, check_value, integer, maker
from sb3_sample.warn import warn


class NotAllowed(ValueError, AssertionError):
    """
    Refusal that is an assertion in Stable-Baselines3: a ``ValueError``, like every refusal here, and an
    ``AssertionError``.
    """


class NoPolicy(ValueError):
    """The policy is not one of this family."""


#: Entries of ``policy_kwargs`` that Stable-Baselines3's policies and those here have in common.
EVERY_POLICY: dict[str, Kind] = {
    "optimizer_class": maker(torch.optim.Optimizer, "torch.optim.Adam"),
    "optimizer_kwargs": DICT,
    "features_extractor_class": maker(BaseFeaturesExtractor, "NatureCNN"),
    "features_extractor_kwargs": DICT,
    "activation_fn": maker(nn.Module, "torch.nn.ReLU").or_none(),
}
#: Arguments of policies, optimizers and replay buffers that follow from the algorithm's.
_OF_POLICY = dict.fromkeys(("observation_space", "action_space", "lr_schedule"), "")
_OF_OPTIMIZER = {"params": "", "lr": "learning_rate"}
OF_BUFFER = {
    **dict.fromkeys(("observation_space", "action_space", "env", "n_envs"), "env"),
    **{name: name for name in ("buffer_size", "device", "optimize_memory_usage")},
}
_ENVIRONMENT = Kind(
    "be an environment, a vectorised environment or the id of one",
    lambda value: isinstance(value, (str, VecEnv)) or (hasattr(value, "action_space") and hasattr(value, "step")),
)
#: Arguments that may be functions of the remaining progress, with values of at least 0. The zoo passes a function that
#: is 0 when it loads a model to act.
_SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf")
#: Arguments of ``learn`` in both families.
_LEARN: dict[str, Kind] = {
    "total_timesteps": AT_LEAST_0,
    "callback": Kind(
        "be a callback, a list of callbacks or a function",
        lambda value: callable(value) or isinstance(value, (list, BaseCallback)),
    ).or_none(),
    "log_interval": integer(1).or_none(),
    "tb_log_name": Kind("be a name", lambda value: isinstance(value, str)).or_none(),
}


def check_every(agent: Any, needs_spaces: bool = True) -> None:
    """
    Check every argument that has a kind, and the arguments that all policies take. There are spaces unless a model is
    made without an environment.

    :param agent: an algorithm whose arguments are stored and whose networks do not exist yet
    :param needs_spaces: whether missing spaces are an error
    :raises ValueError: if one of them is of another kind, or the policy is not one for the observations, or takes none
        of an entry's name in ``policy_kwargs``
    """
    if needs_spaces and not hasattr(agent, "observation_space"):
        raise ValueError(f"env must {_ENVIRONMENT.words}, not None")
    for name, argument in type(agent).constructor_arguments.items():
        if argument.kind is not None:
            # Stable-Baselines3 stores some under the argument's name, though they are declared under another for their
            # type.
            attribute = argument.attribute if argument.attribute in vars(agent) else name
            setattr(agent, attribute, check_value(name, getattr(agent, attribute), argument.kind))
            if name in _SCHEDULED and callable(getattr(agent, attribute)):
                _check_schedule(name, getattr(agent, attribute))
    kwargs, space = agent.policy_kwargs, getattr(agent, "observation_space", None)
    for name, kind in EVERY_POLICY.items():
        if name in kwargs:
            check_value(f"policy_kwargs[{name!r}]", kwargs[name], kind)
    check_kwargs("policy_kwargs", kwargs, agent.policy_class, _OF_POLICY)
    optimizer = kwargs.get("optimizer_class") or default_of(agent.policy_class, "optimizer_class")
    if isinstance(optimizer, type):
        of_optimizer = kwargs.get("optimizer_kwargs") or {}
        check_kwargs("policy_kwargs['optimizer_kwargs']", of_optimizer, optimizer, _OF_OPTIMIZER)
    policy = named_policy(agent)
    if policy is None or space is None or "features_extractor_class" in kwargs:
        return
    if policy == "MultiInputPolicy" and not isinstance(space, spaces.Dict):
        raise ValueError(f"policy='MultiInputPolicy' needs Dict observations, not {space}: use 'MlpPolicy'")
    if policy == "MlpPolicy" and isinstance(space, spaces.Dict):
        raise ValueError(f"policy='MlpPolicy' is not for Dict observations, {space}: use 'MultiInputPolicy'")
    extractor = kwargs.get("features_extractor_kwargs") or {}
    normalized = not kwargs.get("normalize_images", True) or extractor.get("normalized_image", False)
    if policy == "CnnPolicy" and not is_image_space(space, check_channels=False, normalized_image=normalized):
        raise NotAllowed(
            "policy='CnnPolicy' needs images, of integers in [0, 255] (with policy_kwargs={'normalize_images': False} "
            f"of any numbers), not {space}: use 'MlpPolicy' for vectors"
        )


def _check_schedule(name: str, schedule: Callable[[float], Any]) -> None:
    """Check that a function gives a number at the begin, where Stable-Baselines3 first calls it."""
    try:
        first = float(schedule(1.0))
    except Exception as error:
        raise ValueError(
            f"{name} must be a function of the remaining progress, from 1 to 0, that returns a number, but at 1.0 "
            f"{schedule!r} fails: {type(error).__name__}: {error}"
        ) from error
    check_value(f"{name}, {schedule!r}, at the begin", first, AT_LEAST_0)


def check_kwargs(argument: str, kwargs: Iterable[str], of: type, fixed: Mapping[str, str]) -> None:
    """
    Check the names of a class's arguments.

    :param argument: name of the argument that has them
    :param kwargs: their names
    :param of: the class
    :param fixed: names of those that follow from the algorithm's arguments, and from which; "" if from none
    :raises ValueError: if the class takes no argument of a name, or it follows from another
    """
    allowed: set[str] = set()
    for base in of.__mro__:
        if "__init__" in vars(base):
            parameters = list(inspect.signature(vars(base)["__init__"]).parameters.values())
            allowed |= {each.name for each in parameters if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)}
            if not any(each.kind is each.VAR_KEYWORD for each in parameters):
                break
    allowed -= {"self", *fixed}
    for name in kwargs:
        if name in allowed:
            continue
        if other := fixed.get(name):
            raise ValueError(f"{argument} has {name!r}, which follows from {other}: pass that instead")
        near = difflib.get_close_matches(str(name), allowed, 1)
        meant = f"Did you mean {near[0]!r}?" if near else f"It takes {sorted(allowed) or 'none'}"
        raise ValueError(f"{argument} has {name!r}, which is no argument of {of.__name__}. {meant}")


def named_policy(agent: Any) -> str | None:
    """
    :param agent: an algorithm
    :return: the name of its policy; None for a class of the user's own, which may use its arguments as it likes
    """
    return next((name for name, cls in agent.policy_aliases.items() if cls is agent.policy_class), None)


def check_net_arch(net_arch: Any, keys: tuple[str, str], both: bool) -> None:
    """
    :param net_arch: the policy's argument
    :param keys: keys of a dict, for the actor and the critic
    :param both: whether a dict must have both
    :raises ValueError: if it is neither a list of widths nor a dict of such lists with these keys
    """
    width = integer(1)

    def is_list(value: Any) -> bool:
        return isinstance(value, Sequence) and not isinstance(value, str) and all(map(width.fits, value))

    if isinstance(net_arch, Mapping):
        known = net_arch.keys() == set(keys) if both else net_arch.keys() <= set(keys)
        fits = known and all(map(is_list, net_arch.values()))
    else:
        fits = net_arch is None or is_list(net_arch)
    if not fits:
        raise ValueError(
            f"net_arch must be a list of widths, integers of at least 1, or a dict of such lists, {keys[0]!r} for the "
            f"actor and {keys[1]!r} for the critic, not {net_arch!r}"
        )


def check_policy_class(cls: Any, policy: Any) -> None:
    """
    :param cls: class of an algorithm
    :param policy: the argument of its constructor
    :raises NoPolicy: (a ``ValueError``) if it is no policy of this family
    """
    aliases, base = cls.policy_aliases, cls.policy_base
    if isinstance(policy, str) and policy in aliases:
        return
    if not (isinstance(policy, type) and issubclass(policy, base)):
        shown = f"{policy.__module__}.{policy.__qualname__}" if isinstance(policy, type) else repr(policy)
        raise NoPolicy(
            f"policy must be one of {list(aliases)}, or a policy class derived from {base.__module__}."
            f"{base.__qualname__}, not {shown}"
        )


def check_device(device: Any) -> None:
    """
    :param device: the argument
    :raises ValueError: if torch has no device of this name
    """
    try:
        used = get_device(device)
    except (RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"device must be 'auto', 'cpu', 'cuda' or another of torch's, not {device!r}") from error
    if device != "auto" and torch.device(device).type != used.type:
        # Stable-Baselines3 does the same silently.
        warn(f"device={str(device)!r}: torch finds no such device here, so {used} is used")


def _check_env(env: Any) -> None:
    """Check an environment argument. Atari's games are registered: Gymnasium does not know them by itself."""
    check_value("env", env, _ENVIRONMENT.or_none())
    if is_atari_id(env):
        check_game(env)


def check_program(cls: type, given: Mapping[str, Any]) -> None:
    """
    Check the arguments that Stable-Baselines3's constructor uses.

    :param cls: class of an algorithm
    :param given: its arguments by name; env is None when a model is loaded
    :raises ValueError: if one of them is of another kind
    :raises ImportError: if env is the id of an Atari game without ``ale-py``, or without its ROM
    """
    check_policy_class(cls, given["policy"])
    _check_env(given["env"])
    check_device(given["device"])
    check_value("verbose", given["verbose"], VERBOSE)


def check_learn(agent: Any, learn: Mapping[str, Any]) -> int:
    """
    :param agent: an algorithm
    :param learn: the arguments of its ``learn``, by name
    :return: ``total_timesteps`` as an integer, with which the same steps are taken
    :raises ValueError: if one of them is of another kind, or there is no environment
    """
    if agent.env is None:
        raise NotAllowed(
            "env: the model was made or loaded without one: pass env= to it, or call set_env, before learn"
        )
    for name, kind in _LEARN.items():
        check_value(name, learn[name], kind)
    return math.ceil(learn["total_timesteps"])


def check_n_envs(agent: Any, env: GymEnv) -> None:
    """
    :param agent: an algorithm
    :param env: the environment that it is to go on with
    :raises ValueError: if it has another number of environments
    """
    n_envs = env.num_envs if isinstance(env, VecEnv) else 1
    if n_envs != agent.n_envs:
        raise NotAllowed(
            f"env has {n_envs} environments, but set_env takes as many as the model was made with, {agent.n_envs}: "
            f"use {type(agent).__name__}.load(path, env) for another number"
        )


def names_for_load(cls: type, base: type) -> set[str]:
    """
    :param cls: class of an algorithm
    :param base: base class of the algorithms
    :return: the arguments that ``load`` may change: those of the class and of its bases below ``base``, and
        ``policy_class``, Stable-Baselines3's name for the policy's class
    """
    classes = [c for c in cls.__mro__ if issubclass(c, base) and c is not base]
    names = {name for c in classes for name in inspect.signature(c).parameters}
    return (names | {"policy_class"}) - {"env", "kwargs", "_init_setup_model"}


def check_load(cls: type, base: type, env: Any, device: Any, kwargs: dict[str, Any]) -> None:
    """
    :param cls: class of an algorithm
    :param base: base class of the algorithms
    :param env: environment with which it is to be loaded
    :param device: device to which it is to be loaded
    :param kwargs: arguments that ``load`` is to change
    :raises ValueError: if one of them is no argument of the class, or of another kind where that is not found later
    :raises ImportError: if env is the id of an Atari game without ``ale-py``, or without its ROM
    """
    _check_env(env)
    check_device(device)
    if "verbose" in kwargs:
        check_value("verbose", kwargs["verbose"], VERBOSE)
    unknown = sorted(kwargs.keys() - names_for_load(cls, base))
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: not an argument of {cls.__name__}, so load cannot change it")


def default_of(cls: type, name: str) -> Any:
    """
    :param cls: class of an algorithm
    :param name: an argument of its constructor, or of a base's constructor to which it is passed on
    :return: the argument's default
    """
    signatures = (inspect.signature(c).parameters for c in cls.__mro__)
    return next(parameters[name].default for parameters in signatures if name in parameters)


@contextmanager
def naming_changes(kwargs: dict[str, Any]) -> Iterator[None]:
    """
    While a file is loaded: blame parameters that do not fit on the arguments that are to differ from the file's.

    :param kwargs: these arguments
    :raises ValueError: if they are not of the model's networks and parts
    """
    try:
        yield
    except (RuntimeError, ValueError) as error:
        words = ("loading state_dict", "is an invalid object name", "do not match agents' parameters")
        names = sorted(kwargs.keys() - {"seed", "tensorboard_log", "verbose"})
        if names and (isinstance(error, ParametersDoNotFit) or any(word in str(error) for word in words)):
            raise ValueError(
                f"{', '.join(names)}: with these arguments the model has other networks or parts than the "
                f"file ({str(error).splitlines()[0]})"
            ) from error
        raise


def check_unused(agent: Any, names: Sequence[str], choice: str) -> None:
    """
    :param agent: an algorithm
    :param names: arguments of its constructor that mean nothing under a choice
    :param choice: that choice, for the error
    :raises ValueError: if one of them is not at its default
    """
    for name in names:
        default = default_of(type(agent), name)
        if getattr(agent, name) != default:
            raise ValueError(
                f"{name}={getattr(agent, name)!r} means nothing with {choice}: leave it out, or at {default!r}"
            )
