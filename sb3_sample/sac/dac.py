"""DAC."""

from typing import Any

from stable_baselines3.common.type_aliases import Schedule

from sb3_sample.arguments import check_unused
from sb3_sample.constructor import argument
from sb3_sample.kinds import FINITE
from sb3_sample.learner.exploration import Exploration
from sb3_sample.sac import checks
from sb3_sample.sac.algorithm import SAC

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

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_rate: float | Schedule = argument(default=3e-4, kw_only=False)
    """of both actors, critics and temperature; a number or a function of the remaining progress (from 1 to 0)"""
    kl_target: float = argument(default=0.5)
    """KL divergence per action dimension between the two actors that optimism is adjusted to"""
    std_multiplier: float = argument(default=1.25)
    """factor on the optimistic actor's standard deviation while exploring"""
    uncertainty: str = argument(default="epistemic")
    """spread that optimism adds: "epistemic"; with ``n_quantiles`` also "aleatoric" or "both", the sum"""
    initial_optimism: float | None = argument(default=None, kind=FINITE.or_none())
    """weight of the critics' spread for the optimistic actor at the start, above minus the pessimism; None: 0.5 above
    it, as published"""
    initial_kl_weight: float = argument(default=1.0)
    """weight of the divergence in its loss, at the start"""
    adjustment_learning_rate: float = argument(default=3e-5)
    """learning rate of optimism and of the divergence's weight"""
    kl_direction: str = argument(default="optimistic_to_pessimistic")
    """"optimistic_to_pessimistic", or "pessimistic_to_optimistic" as in the paper's text"""
    reinitialize_every: int | None = argument(default=25_000)
    """environment steps after which the optimistic actor starts anew; None for never"""
    exploration: str | type[Exploration] = argument(default="optimistic_actor")
    """policy that acts while training: "optimistic_actor", or "actor", which makes it plain SAC"""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.exploration == "optimistic_actor":
            same = {name: name for name in OPTIMISTIC_ACTOR_SETTINGS}
            checks.check_once("exploration_kwargs", self.exploration_kwargs, same)
        start, beta = self.initial_optimism, self.pessimism
        if start is not None and isinstance(beta, (int, float)) and not start > -beta:
            raise ValueError(f"initial_optimism must be above minus the pessimism, {-beta}, not {start}")
        if self.exploration != "optimistic_actor":
            check_unused(self, OPTIMISTIC_ACTOR_SETTINGS, f"exploration={self.exploration!r}")

    def _full_exploration_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_exploration_kwargs()
        if self.exploration == "optimistic_actor":
            kwargs = {**{name: getattr(self, name) for name in OPTIMISTIC_ACTOR_SETTINGS}, **kwargs}
        return kwargs
