"""Arguments of the on-policy family: their meanings, allowed values and forbidden combinations."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.arguments import check_every, check_net_arch, check_unused, named_policy
from sb3_sample.constructor import argument
from sb3_sample.kinds import (
    ABOVE_0,
    AT_LEAST_0,
    DICT,
    FINITE,
    LEARNING_RATE,
    TRUE_OR_FALSE,
    UNIT,
    Kind,
    check_value,
    integer,
    is_number,
    number,
    subclass,
)
from sb3_sample.training.resumable import Resumable

_CLIPPING = ABOVE_0.otherwise("a schedule", callable)


class PPOArguments(Resumable):
    """Arguments of every on-policy algorithm; those of Stable-Baselines3 come first and may be given by position."""

    _policy: str | type[ActorCriticPolicy] = argument(alias="policy", kw_only=False)
    """"MlpPolicy", "MultiInputPolicy" or a policy class; without further samples any policy that PPO accepts"""
    _env: gym.Env[Any, Any] | VecEnv | str | None = argument(alias="env", kw_only=False)
    """the environment, an id, or a vectorised environment"""
    learning_rate: float | Schedule = argument(default=3e-4, kind=LEARNING_RATE, kw_only=False)
    """of actor and critic; a number or a function of the remaining progress (from 1 to 0)"""
    n_steps: int = argument(default=2048, kind=integer(1), kw_only=False)
    """T, steps of each environment between two updates"""
    batch_size: int = argument(default=64, kind=integer(1), kw_only=False)
    """real samples per minibatch"""
    n_epochs: int = argument(default=10, kind=integer(1), kw_only=False)
    """passes over the rollout"""
    gamma: float = argument(default=0.99, kind=UNIT, kw_only=False)
    """discount factor, of real and simulated returns"""
    gae_lambda: float = argument(default=0.95, kind=UNIT, kw_only=False)
    """lambda of GAE and of the simulated TD(lambda) returns"""
    clip_range: float | Schedule = argument(default=0.2, kind=_CLIPPING, kw_only=False)
    """PPO's clipping of the probability ratio, of real and simulated samples; also a schedule"""
    clip_range_vf: float | Schedule | None = argument(default=None, kind=_CLIPPING.or_none(), kw_only=False)
    """clipping of the value's change; None for no clipping"""
    normalize_advantage: bool = argument(default=False, kind=TRUE_OR_FALSE, kw_only=False)
    """whether advantages are normalised, in each minibatch, real and simulated samples together. MBMA turns it off:
    "it has no grounding in SPG theory" (section 5.1)"""
    ent_coef: float = argument(default=0.0, kind=FINITE, kw_only=False)
    """weight of the entropy at the real states"""
    vf_coef: float = argument(default=0.5, kind=AT_LEAST_0, kw_only=False)
    """weight of the value loss"""
    max_grad_norm: float = argument(
        default=0.5, kind=number("be above 0 (float('inf') for no limit)", lambda value: value > 0), kw_only=False
    )
    """maximum norm of the gradient of actor and critic together"""
    use_sde: bool = argument(default=False, kw_only=False)
    """not allowed with simulated actions, since all actions at a state would share their noise"""
    sde_sample_freq: int = argument(default=-1, kind=integer(-1), kw_only=False)
    """as in Stable-Baselines3"""
    rollout_buffer_class: type[RolloutBuffer] | None = argument(
        default=None, kind=subclass(RolloutBuffer).or_none(), kw_only=False
    )
    """as in Stable-Baselines3"""
    _rollout_buffer_kwargs: dict[str, Any] | None = argument(
        alias="rollout_buffer_kwargs", default=None, kind=DICT, kw_only=False
    )
    """as in Stable-Baselines3"""
    target_kl: float | None = argument(
        default=None, kind=number("be above 0", lambda value: value > 0).or_none("no limit"), kw_only=False
    )
    """an iteration's updates end when the divergence over all samples of the policy loss exceeds 1.5 times this value;
    None for no limit"""
    _policy_kwargs: dict[str, Any] | None = argument(alias="policy_kwargs", default=None)
    """arguments of the policy. Without ``net_arch``, "MlpPolicy" and "MultiInputPolicy" have the paper's two hidden
    layers of 512 (actor) and 1024 (critic)"""
    anneal_until: float | None = argument(
        default=None,
        kind=Kind(
            "lie in (0, 1], a share of the training, or be None",
            lambda value: value is None or (is_number(value) and 0 < value <= 1),
        ),
    )
    """share of the training, of ``total_timesteps``, after which nothing is simulated any more: in an iteration whose
    rollout began at the share p of the training, X = ceil(``n_simulated`` (1 - p / ``anneal_until``)). None: X does not
    decline. A second ``learn`` starts counting from 0, or continues with ``reset_num_timesteps=False``"""
    warm_up_until: float | None = argument(
        default=None,
        kind=Kind(
            "lie in [0, 1], a share of the training, or be None", lambda value: value is None or UNIT.fits(value)
        ),
    )
    """share of the training over which X rises linearly from 0 to ``n_simulated`` while the models learn, rounded up
    too; 0 for no rise. None: 0.15, or 0 if ``anneal_until`` is given. With both, the two factors are multiplied. MBMA,
    section 5.1: "We anneal the number of additional samples until 15% step of the training for all methods". The
    default reads it as a rise that ends at 15%; ``anneal_until=0.15`` is the other reading, a decline to 0 that ends at
    15%, which leaves no gain over PPO (docs/many_actions.md)"""


def check(agent: Any) -> None:
    """
    :param agent: an algorithm whose arguments are stored and whose networks do not exist yet
    :raises ValueError: if an argument is out of range or contradicts another
    """
    check_every(agent)
    _check_minibatches(agent.batch_size, agent.normalize_advantage)
    if named_policy(agent) is not None:
        _check_net_arch(agent.policy_kwargs.get("net_arch"))
    _check_buffer_class(agent)
    _check_schedule(agent)
    if agent._n_extra == 0:
        check_unused(agent, agent.simulation_arguments, agent.plain)
    else:
        _check_simulation(agent)


def check_counts(cls: type[PPOArguments], given: Mapping[str, Any]) -> None:
    """
    Check the arguments that ``PPO.__init__`` divides by or makes assertions about.

    :param cls: class of an algorithm
    :param given: its arguments by name
    :raises ValueError: if one of them is out of range
    """
    for name in "n_steps", "batch_size", "n_epochs", "normalize_advantage":
        kind = cls.constructor_arguments[name].kind
        assert kind is not None
        check_value(name, given[name], kind)
    _check_minibatches(given["batch_size"], given["normalize_advantage"])


def _check_minibatches(batch_size: int, normalize_advantage: bool) -> None:
    if normalize_advantage and batch_size == 1:
        raise ValueError("batch_size must be at least 2 with normalize_advantage=True, not 1")


def _check_net_arch(net_arch: Any) -> None:
    if isinstance(net_arch, list) and len(net_arch) == 1 and isinstance(net_arch[0], dict):
        net_arch = net_arch[0]  # The old form; Stable-Baselines3 warns about it.
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
    """Check the schedule of the number of simulated samples."""
    anneal, warm_up = agent.anneal_until, agent.warm_up_until
    if anneal is not None and (warm_up or 0) >= anneal:
        raise ValueError(f"warm_up_until must be below anneal_until={anneal}, not {warm_up}")


def _check_simulation(agent: Any) -> None:
    if agent.use_sde:
        raise ValueError(
            "use_sde=True draws one noise for all actions at a state, so that simulated actions would be equal: "
            f"leave it out, or pass {agent.plain}"
        )
    check_action_space(agent.action_space, agent.plain)
    cls = agent.rollout_buffer_class
    if cls is not None and cls.get not in (RolloutBuffer.get, DictRolloutBuffer.get):
        raise ValueError(
            f"rollout_buffer_class={cls.__name__} draws its minibatches itself, but here they hold simulated "
            f"samples too: leave it out, or pass {agent.plain}"
        )


def check_action_space(space: spaces.Space, plain: str | None) -> None:
    """
    :param space: the action space
    :param plain: the argument that gives plain PPO, for the error message; None where there is no such argument
    :raises ValueError: no actions can be simulated in it
    """
    if isinstance(space, spaces.Discrete):
        if space.start != 0:
            raise ValueError(f"the action space must start at 0, not be {space}")
    elif not isinstance(space, spaces.Box):
        advice = "" if plain is None else f": pass {plain} for plain PPO"
        raise ValueError(
            f"the action space must be a Box or Discrete, whose actions can be drawn or enumerated, not {space}{advice}"
        )


def check_network_kwargs(name: str, kwargs: dict[str, Any] | None, allowed: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param name: name of the argument
    :param kwargs: its value: width, depth, learning rate, epochs, and switches; None for none
    :param allowed: its allowed entries, with the defaults
    :return: the value with the defaults filled in
    :raises ValueError: if it has another entry, or a value is out of range
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
