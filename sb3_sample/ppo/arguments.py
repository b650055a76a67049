"""Checks of the on-policy family's arguments."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from sb3_sample.arguments import check_unused, is_integer, is_number

if TYPE_CHECKING:
    from sb3_sample.ppo.simulated_ppo import SimulatedPPO


def check(agent: "SimulatedPPO") -> None:
    """
    :param agent: an algorithm whose arguments are stored and whose networks do not exist yet
    :raises ValueError: if an argument is out of range or contradicts another
    """
    check_counts(agent.n_steps, agent.batch_size, agent.n_epochs, agent.normalize_advantage)
    _check_numbers(agent)
    check_integer("n_simulated", agent.n_simulated, 0)
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
    for name, value in (("n_steps", n_steps), ("batch_size", batch_size), ("n_epochs", n_epochs)):
        check_integer(name, value, 1)
    if not isinstance(normalize_advantage, (bool, np.bool_)):
        raise ValueError(f"normalize_advantage must be True or False, not {normalize_advantage!r}")
    if normalize_advantage and batch_size == 1:
        raise ValueError("batch_size must be at least 2 with normalize_advantage=True, not 1")


def _check_numbers(agent: "SimulatedPPO") -> None:
    for name in ("gamma", "gae_lambda"):
        value = getattr(agent, name)
        if not is_number(value) or not 0 <= value <= 1:
            raise ValueError(f"{name} must lie in [0, 1], not {value!r}")
    value = agent.learning_rate
    if not callable(value) and (not is_number(value) or not 0 <= value < math.inf):
        raise ValueError(f"learning_rate must be at least 0 and finite, or a schedule, not {value!r}")
    for name, otherwise in (("clip_range", ""), ("clip_range_vf", ", or None")):
        value = getattr(agent, name)
        if value is None and otherwise:
            continue
        if not callable(value) and (not is_number(value) or not 0 < value < math.inf):
            raise ValueError(f"{name} must be above 0 and finite, or a schedule{otherwise}, not {value!r}")
    if not is_number(agent.ent_coef) or not math.isfinite(agent.ent_coef):
        raise ValueError(f"ent_coef must be a finite number, not {agent.ent_coef!r}")
    if not is_number(agent.vf_coef) or not 0 <= agent.vf_coef < math.inf:
        raise ValueError(f"vf_coef must be at least 0 and finite, not {agent.vf_coef!r}")
    if not is_number(agent.max_grad_norm) or not agent.max_grad_norm > 0:
        raise ValueError(f"max_grad_norm must be above 0 (float('inf') for no limit), not {agent.max_grad_norm!r}")
    if agent.target_kl is not None and (not is_number(agent.target_kl) or not agent.target_kl > 0):
        raise ValueError(f"target_kl must be above 0, or None for no limit, not {agent.target_kl!r}")


def _check_schedule(agent: "SimulatedPPO") -> None:
    """When there are how many simulated samples."""
    anneal, warm_up = agent.anneal_until, agent.warm_up_until
    if anneal is not None and (not is_number(anneal) or not 0 < anneal <= 1):
        raise ValueError(f"anneal_until must lie in (0, 1], a share of the training, or be None, not {anneal!r}")
    if warm_up is not None and (not is_number(warm_up) or not 0 <= warm_up <= 1):
        raise ValueError(f"warm_up_until must lie in [0, 1], a share of the training, or be None, not {warm_up!r}")
    if anneal is not None and (warm_up or 0) >= anneal:
        raise ValueError(f"warm_up_until must be below anneal_until={anneal}, not {warm_up}")


def _check_simulation(agent: "SimulatedPPO") -> None:
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


def check_integer(name: str, value: Any, low: int) -> None:
    """
    :param name: name of an argument
    :param value: its value
    :param low: the smallest allowed
    :raises ValueError: if it is no integer, or below that
    """
    if not is_integer(value) or value < low:
        raise ValueError(f"{name} must be an integer of at least {low}, not {value!r}")


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
    for key, value in kwargs.items():
        if key not in allowed:
            raise ValueError(f"{name} has {key!r}, but takes {list(allowed)}")
        if isinstance(allowed[key], bool):
            if not isinstance(value, bool):
                raise ValueError(f"{name}[{key!r}] must be True or False, not {value!r}")
        elif key == "learning_rate":
            if not is_number(value) or not 0 <= value < math.inf:
                raise ValueError(f"{name}['learning_rate'] must be at least 0 and finite, not {value!r}")
        elif not (key == "epochs" and value is None):
            check_integer(f"{name}[{key!r}]", value, 1)
    # torch does not take NumPy's numbers everywhere.
    plain = {key: value.item() if isinstance(value, np.generic) else value for key, value in kwargs.items()}
    return {**allowed, **plain}
