"""DAC."""

from typing import Any

from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_sample.arguments import check_unused
from sb3_sample.kinds import FINITE, check_value
from sb3_sample.learner.exploration import Exploration
from sb3_sample.sac import arguments
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.policies import SACPolicy

#: Arguments that are the optimistic actor's.
OPTIMISTIC_ACTOR_SETTINGS = (
    "kl_target",
    "std_multiplier",
    "uncertainty",
    "initial_optimism",
    "initial_kl_weight",
    "adjustment_learning_rate",
    "kl_direction",
    "reinitialize_every",
)


class DAC(SAC):
    """
    DAC: decoupled policy actor-critic (Nauman and Cygan 2023, https://arxiv.org/abs/2310.19527, algorithm 1).

    Soft actor-critic with a second actor, a network of its own, that explores by climbing an optimistic value, while
    the pessimistic actor learns from its data, makes the TD targets and is evaluated. Optimism and the weight of the
    divergence between the two are learned.

    Where the paper's text and the published code differ, the update follows the code, whose every number it
    reproduces; :class:`~sb3_sample.learner.exploration.OptimisticActor` names the differences. The networks follow the
    paper, two hidden layers of 256 without layer norm, with which the DAC, VPL and BRO papers compare; the published
    code has ``policy_kwargs=dict(net_arch=[256] * 3, critic_network_kwargs=dict(layer_norm=True))``.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: of both actors, critics and temperature; a number or a function of the remaining progress
        (from 1 to 0)
    :param kl_target: KL divergence per action dimension between the two actors that optimism is adjusted to
    :param std_multiplier: factor on the optimistic actor's standard deviation while exploring
    :param uncertainty: what optimism adds: "epistemic", or with ``n_quantiles`` "aleatoric" or "both"
    :param initial_optimism: weight of the critics' spread for the optimistic actor at the start, above minus the
        pessimism; None: 0.5 above it, as published
    :param initial_kl_weight: weight of the divergence in its loss, at the start
    :param adjustment_learning_rate: learning rate of optimism and of the divergence's weight
    :param kl_direction: "optimistic_to_pessimistic", or "pessimistic_to_optimistic" as in the paper's text
    :param reinitialize_every: environment steps after which the optimistic actor starts anew; None for never
    :param exploration: who acts while training: "optimistic_actor", or "actor", which makes it plain SAC
    :param kwargs: every other argument of :class:`SAC`, by name
    :raises ValueError: if an argument is out of range or contradicts another
    """

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        kl_target: float = 0.5,
        std_multiplier: float = 1.25,
        uncertainty: str = "epistemic",
        initial_optimism: float | None = None,
        initial_kl_weight: float = 1.0,
        adjustment_learning_rate: float = 3e-5,
        kl_direction: str = "optimistic_to_pessimistic",
        reinitialize_every: int | None = 25_000,
        exploration: str | type[Exploration] = "optimistic_actor",
        **kwargs: Any,
    ):
        self.kl_target = kl_target
        self.std_multiplier = std_multiplier
        self.uncertainty = uncertainty
        self.initial_optimism = initial_optimism
        self.initial_kl_weight = initial_kl_weight
        self.adjustment_learning_rate = adjustment_learning_rate
        self.kl_direction = kl_direction
        self.reinitialize_every = reinitialize_every
        super().__init__(policy, env, learning_rate, exploration=exploration, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.exploration == "optimistic_actor":
            same = {name: name for name in OPTIMISTIC_ACTOR_SETTINGS}
            arguments.check_once("exploration_kwargs", self.exploration_kwargs, same)
        start, beta = check_value("initial_optimism", self.initial_optimism, FINITE.or_none()), self.pessimism
        if start is not None and isinstance(beta, (int, float)) and not start > -beta:
            raise ValueError(f"initial_optimism must be above minus the pessimism, {-beta}, not {start}")
        if self.exploration != "optimistic_actor":
            check_unused(self, OPTIMISTIC_ACTOR_SETTINGS, f"exploration={self.exploration!r}")

    def _full_exploration_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_exploration_kwargs()
        if self.exploration == "optimistic_actor":
            kwargs = {**{name: getattr(self, name) for name in OPTIMISTIC_ACTOR_SETTINGS}, **kwargs}
        return kwargs
