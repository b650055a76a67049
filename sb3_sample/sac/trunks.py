"""Trunks of actors and critics: their arguments, how they are made, and their modes."""

import copy
import inspect
from typing import Any

from gymnasium import spaces
from torch import nn

from sb3_sample import own_classes
from sb3_sample.kinds import DICT, check_value, chosen, integer
from sb3_sample.networks import NETWORKS, Network, widened
from sb3_sample.networks.modes import evaluated

#: Names of the networks that ``net_arch`` and ``activation_fn`` describe.
OF_HIDDEN_LAYERS = ("mlp", "crossq", "xqc")


def network_args(
    who: str,
    network: str | type[Network],
    kwargs: dict[str, Any] | None,
    net_arch: list[int] | None,
    activation_fn: type[nn.Module] | None,
    width_factor: int = 1,
) -> tuple[type[Network], dict[str, Any]]:
    """Class and arguments of a trunk, from its name and from Stable-Baselines3's shorthand."""
    check_value(f"{who}_network_kwargs", kwargs, DICT)
    cls = chosen(f"{who}_network", network, NETWORKS, Network)
    kwargs = dict(kwargs or {})
    for name, key, value in (("net_arch", "hidden_sizes", net_arch), ("activation_fn", "activation_fn", activation_fn)):
        if value is None:
            continue
        if network not in OF_HIDDEN_LAYERS:
            own = ", ".join(key for key in inspect.signature(cls).parameters if key not in ("in_features", "n_copies"))
            raise ValueError(
                f"{name} describes an MLP, but {who}_network is {network!r}: use critic_network_kwargs and "
                f"actor_network_kwargs (its own are {own}), or {who}_network='mlp'"
            )
        if key in kwargs:
            raise ValueError(f"{name} and {who}_network_kwargs[{key!r}] say the same thing: give one of them")
        kwargs[key] = value
    own_classes.check_arguments(f"{who}_network", network, cls, 1, kwargs=kwargs, n_copies=None)
    return cls, widened(cls, kwargs, width_factor)


def make_trunk(argument: str, cls: type[Network], in_features: int, kwargs: dict[str, Any], **copies: int) -> Network:
    trunk: Network = own_classes.make(argument, cls, cls, Network, in_features, kwargs=kwargs, **copies)
    check_value(f"{cls.__name__}.out_features", getattr(trunk, "out_features", None), integer(1))
    return trunk


def with_plain_sizes(space: spaces.Space) -> spaces.Space:
    """Copy of a space whose Discrete parts have Python's integers as sizes: compilers do not accept NumPy's."""
    space = copy.copy(space)
    if isinstance(space, spaces.Dict):
        space.spaces = {key: with_plain_sizes(part) for key, part in space.spaces.items()}
    elif isinstance(space, spaces.Discrete):
        space.n = int(space.n)  # type: ignore[assignment]
    return space


def keep_at_rest(owner: Any) -> None:
    """Give an actor or critics, once complete, their view in evaluation mode if they stack rows."""
    choice = owner.trunk.stacks_rows
    if choice not in (None, "online", "target"):
        raise ValueError(f"stacks_rows of a network must be None, 'online' or 'target', not {choice!r}")
    if choice == "target" and not owner.trunk.trains_in_target:
        raise ValueError(
            f"{type(owner.trunk).__name__}: stacks_rows='target' has the targets use statistics of the stacked rows, "
            "and trains_in_target=False the running ones: leave one of them out"
        )
    if choice is not None:
        # Bypass nn.Module's own setattr, which would register it.
        vars(owner)["at_rest"] = evaluated(owner)
