"""Checks of the on-policy family's arguments."""

from collections.abc import Mapping
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from sb3_sample.arguments import check_every, check_net_arch, check_table, check_unused, named_policy
from sb3_sample.kinds import (
    ABOVE_0,
    AT_LEAST_0,
    DICT,
    FINITE,
    TRUE_OR_FALSE,
    UNIT,
    Kind,
    check_value,
    integer,
    is_number,
    number,
    subclass,
)

_CLIPPING = ABOVE_0.otherwise("a schedule", callable)
#: By argument, what it must be.
ARGUMENTS: dict[str, Kind] = {
    "n_steps": integer(1),
    "batch_size": integer(1),
    "n_epochs": integer(1),
    "gamma": UNIT,
    "gae_lambda": UNIT,
    "clip_range": _CLIPPING,
    "clip_range_vf": _CLIPPING.or_none(),
    "normalize_advantage": TRUE_OR_FALSE,
    "ent_coef": FINITE,
    "vf_coef": AT_LEAST_0,
    "max_grad_norm": number("be above 0 (float('inf') for no limit)", lambda value: value > 0),
    "rollout_buffer_class": subclass(RolloutBuffer).or_none(),
    "rollout_buffer_kwargs": DICT,
    "target_kl": number("be above 0", lambda value: value > 0).or_none("no limit"),
    "n_simulated": integer(0),
    "anneal_until": Kind(
        "lie in (0, 1], a share of the training, or be None",
        lambda value: value is None or (is_number(value) and 0 < value <= 1),
    ),
    "warm_up_until": Kind(
        "lie in [0, 1], a share of the training, or be None", lambda value: value is None or UNIT.fits(value)
    ),
}


def check(agent: Any) -> None:
    """
    :param agent: an algorithm whose arguments are stored and whose networks do not exist yet
    :raises ValueError: if an argument is out of range or contradicts another
    """
    check_every(agent)
    check_table(agent, ARGUMENTS)
    _check_minibatches(agent.batch_size, agent.normalize_advantage)
    if named_policy(agent) is not None:
        _check_net_arch(agent.policy_kwargs.get("net_arch"))
    _check_buffer_class(agent)
    _check_schedule(agent)
    if agent.n_simulated == 0:
        check_unused(agent, agent.simulation_arguments, "n_simulated=0")
    else:
        _check_simulation(agent)


def check_counts(n_steps: Any, batch_size: Any, n_epochs: Any, normalize_advantage: Any) -> None:
    """
    What ``PPO.__init__`` divides by and asserts.

    :raises ValueError: if one of them is out of range
    """
    given = {"n_steps": n_steps, "batch_size": batch_size, "n_epochs": n_epochs}
    for name, value in {**given, "normalize_advantage": normalize_advantage}.items():
        check_value(name, value, ARGUMENTS[name])
    _check_minibatches(batch_size, normalize_advantage)


def _check_minibatches(batch_size: int, normalize_advantage: bool) -> None:
    if normalize_advantage and batch_size == 1:
        raise ValueError("batch_size must be at least 2 with normalize_advantage=True, not 1")


def _check_net_arch(net_arch: Any) -> None:
    if isinstance(net_arch, list) and len(net_arch) == 1 and isinstance(net_arch[0], dict):
        net_arch = net_arch[0]  # As of old; Stable-Baselines3 warns of it.
    check_net_arch(net_arch, ("pi", "vf"), both=False)


def _check_buffer_class(agent: Any) -> None:
    cls, space = agent.rollout_buffer_class, agent.observation_space
    if cls is not None and issubclass(cls, DictRolloutBuffer) and not isinstance(space, spaces.Dict):
        raise ValueError(
            f"rollout_buffer_class={cls.__name__} needs a Dict observation space, not {space}: leave it out"
        )
    if cls is RolloutBuffer and isinstance(space, spaces.Dict):
        raise ValueError(f"rollout_buffer_class={cls.__name__} cannot hold the observations of {space}: leave it out")


def _check_schedule(agent: Any) -> None:
    """When there are how many simulated samples."""
    anneal, warm_up = agent.anneal_until, agent.warm_up_until
    if anneal is not None and (warm_up or 0) >= anneal:
        raise ValueError(f"warm_up_until must be below anneal_until={anneal}, not {warm_up}")


def _check_simulation(agent: Any) -> None:
    if agent.use_sde:
        raise ValueError(
            "use_sde=True draws one noise for all actions at a state, so that simulated actions would be equal: "
            "leave it out, or pass n_simulated=0"
        )
    space = agent.action_space
    if isinstance(space, spaces.Discrete):
        if space.start != 0:
            raise ValueError(f"the action space must start at 0, not be {space}")
    elif not isinstance(space, spaces.Box):
        raise ValueError(
            f"the action space must be a Box or Discrete, whose actions can be drawn or enumerated, not {space}: "
            "pass n_simulated=0 for plain PPO"
        )
    cls = agent.rollout_buffer_class
    if cls is not None and cls.get not in (RolloutBuffer.get, DictRolloutBuffer.get):
        raise ValueError(
            f"rollout_buffer_class={cls.__name__} draws its minibatches itself, but here they hold simulated "
            "samples too: leave it out, or pass n_simulated=0"
        )


def check_network_kwargs(name: str, kwargs: dict[str, Any] | None, allowed: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param name: name of the argument
    :param kwargs: its value: width, depth, learning rate, epochs, and switches; None for none
    :param allowed: what it may hold, with the defaults
    :return: the value with the defaults filled in
    :raises ValueError: if there is something else in it, or a value is out of range
    """
    if kwargs is None:
        return dict(allowed)
    if not isinstance(kwargs, Mapping):
        raise ValueError(f"{name} must be a dict with some of {list(allowed)}, or None, not {kwargs!r}")
    plain: dict[str, Any] = {}
    for key, value in kwargs.items():
        if key not in allowed:
            raise ValueError(f"{name} has {key!r}, but takes {list(allowed)}")
        if isinstance(allowed[key], bool):
            kind = TRUE_OR_FALSE
        elif key == "learning_rate":
            kind = AT_LEAST_0
        else:
            kind = integer(1).or_none() if key == "epochs" else integer(1)
        plain[key] = check_value(f"{name}[{key!r}]", value, kind)
    return {**allowed, **plain}
