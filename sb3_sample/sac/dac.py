"""DAC."""

from typing import Any

from stable_baselines3.common.type_aliases import Schedule

from sb3_sample.arguments import check_unused
from sb3_sample.constructor import argument
from sb3_sample.kinds import AT_LEAST_0, FINITE, TRUE_OR_FALSE, Kind
from sb3_sample.learner.exploration import Exploration, ScaledNoise, check_uncertainty
from sb3_sample.learner.learner import Learner
from sb3_sample.learner.objectives import Objective, OptimisticValue
from sb3_sample.sac import checks
from sb3_sample.sac.algorithm import SAC

#: Arguments of the optimistic actor that also apply if it is the only actor.
OPTIMISTIC_SETTINGS = ("std_multiplier", "uncertainty", "initial_optimism")
#: Arguments that tie it to the pessimistic actor.
DIVERGENCE_SETTINGS = (
    "kl_target",
    "initial_kl_weight",
    "adjustment_learning_rate",
    "optimism_learning_rate",
    "kl_weight_learning_rate",
    "kl_direction",
    "reinitialize_every",
)
#: All arguments of the optimistic actor.
OPTIMISTIC_ACTOR_SETTINGS = (*OPTIMISTIC_SETTINGS, *DIVERGENCE_SETTINGS)

_ACTORS = Kind("be 'stochastic' or 'deterministic'", lambda value: value in ("stochastic", "deterministic"))


class DAC(SAC):
    """
    DAC: decoupled policy actor-critic (Nauman and Cygan 2023, https://arxiv.org/abs/2310.19527, algorithm 1).

    Soft actor-critic with a second actor, a separate network, that explores by maximising an optimistic value, while
    the pessimistic actor learns from its data, makes the TD targets and is evaluated. Optimism and the weight of the
    divergence between the two are learned.

    Where the paper's text and the published code differ, the update follows the code and reproduces its every number;
    :class:`~sb3_sample.learner.exploration.OptimisticActor` names the differences. The networks follow the paper, two
    hidden layers of 256 without layer norm, which the comparisons of the DAC, VPL and BRO papers use; the published
    code has ``policy_kwargs=dict(net_arch=[256] * 3, critic_network_kwargs=dict(layer_norm=True))``.

    The variants of the paper's table 1 are arguments: docs/dac.md has them row by row.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_rate: float | Schedule = argument(default=3e-4, kw_only=False)
    """learning rate of both actors, critics and temperature; a number or a function of the remaining progress (from 1
    to 0)"""
    kl_target: float = argument(default=0.5)
    """target for the KL divergence per action dimension between the two actors, to which optimism is adjusted"""
    std_multiplier: float = argument(default=1.25)
    """factor on the optimistic actor's standard deviation while exploring"""
    uncertainty: str = argument(default="epistemic")
    """spread that optimism adds: "epistemic"; with ``n_quantiles`` also "aleatoric" or "both", the sum"""
    initial_optimism: float | None = argument(default=None, kind=FINITE.or_none())
    """weight of the critics' spread for the optimistic actor at the start, above minus the pessimism; None: 0.5 above
    it, as published; with ``pessimistic_actor=None`` and a bandit, above minus its smallest arm"""
    initial_kl_weight: float = argument(default=1.0, kind=AT_LEAST_0)
    """weight of the divergence in the optimistic actor's loss, at the start; at 0 it stays 0, while optimism is still
    adjusted"""
    adjustment_learning_rate: float = argument(default=3e-5)
    """learning rate of optimism and of the divergence's weight"""
    optimism_learning_rate: float | None = argument(default=None, kind=AT_LEAST_0.or_none("adjustment_learning_rate"))
    """learning rate of optimism alone; None: ``adjustment_learning_rate``; 0: it stays at its start"""
    kl_weight_learning_rate: float | None = argument(default=None, kind=AT_LEAST_0.or_none("adjustment_learning_rate"))
    """learning rate of the divergence's weight alone; None: ``adjustment_learning_rate``; 0: it stays at its start"""
    kl_direction: str = argument(default="optimistic_to_pessimistic")
    """"optimistic_to_pessimistic", or "pessimistic_to_optimistic" as in the paper's text"""
    reinitialize_every: int | None = argument(default=25_000)
    """environment steps after which the optimistic actor starts anew; None for never"""
    exploration: str | type[Exploration] = argument(default="optimistic_actor")
    """policy that acts while training: "optimistic_actor", or "actor", which makes it plain SAC"""
    optimistic_actor: str = argument(default="stochastic", kind=_ACTORS)
    """"stochastic", or "deterministic": it explores and learns by its mean, and has the pessimistic actor's standard
    deviation in the divergence"""
    pessimistic_actor: str | None = argument(
        default="stochastic",
        kind=_ACTORS.or_none("one optimistic actor that explores, makes the targets and is evaluated"),
    )
    """"stochastic", or "deterministic": no entropy, no temperature, no noise on the target's action, and the optimistic
    actor's standard deviation in the divergence. None: a single optimistic actor, of constant optimism, explores, makes
    the TD targets and is evaluated. For two deterministic actors, pass ``backbone="td3"``"""
    optimistic_entropy: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """with ``pessimistic_actor=None``, whether the actor's loss rewards the entropy, as the TD target does anyway"""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.exploration != "optimistic_actor":
            own = (*OPTIMISTIC_ACTOR_SETTINGS, "optimistic_actor", "pessimistic_actor", "optimistic_entropy")
            check_unused(self, own, f"exploration={self.exploration!r}")
            return
        same = {name: name for name in OPTIMISTIC_ACTOR_SETTINGS}
        checks.check_once("exploration_kwargs", self.exploration_kwargs, {**same, "deterministic": "optimistic_actor"})
        start, beta = self.initial_optimism, self.pessimism
        if start is not None and isinstance(beta, (int, float)) and not start > -beta:
            raise ValueError(f"initial_optimism must be above minus the pessimism, {-beta}, not {start}")
        if self.initial_kl_weight == 0:
            check_unused(self, ("kl_weight_learning_rate",), "initial_kl_weight=0")
        self._check_actors()

    def _check_actors(self) -> None:
        """Check the variants of table 1."""
        alone = self.pessimistic_actor is None
        if self.backbone == "td3":
            check_unused(self, ("optimistic_actor", "pessimistic_actor"), "backbone='td3', whose actors are both")
        if self.optimistic_actor == "deterministic":
            if self.pessimistic_actor != "stochastic":
                raise ValueError(
                    f"pessimistic_actor={self.pessimistic_actor!r} leaves optimistic_actor='deterministic' no standard "
                    "deviation for the divergence: make one of them 'stochastic', or pass backbone='td3' for two "
                    "deterministic actors"
                )
            check_unused(self, ("std_multiplier",), "optimistic_actor='deterministic'")
        if self.pessimistic_actor == "deterministic":
            for name in ("ent_coef", "target_entropy", "task_temperatures"):
                check_unused(self, (name,), "pessimistic_actor='deterministic', which has no entropy")
        if not alone:
            check_unused(self, ("optimistic_entropy",), f"pessimistic_actor={self.pessimistic_actor!r}")
            return
        check_unused(self, (*DIVERGENCE_SETTINGS, "actor_pessimism"), "pessimistic_actor=None")
        if self.exploration_kwargs:
            raise ValueError(f"exploration_kwargs={self.exploration_kwargs} mean nothing with pessimistic_actor=None")

    @property
    def _has_entropy(self) -> bool:
        return self.pessimistic_actor != "deterministic" and super()._has_entropy

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_policy_kwargs()
        return {**kwargs, "backbone": "mean"} if self.pessimistic_actor == "deterministic" else kwargs

    def _full_exploration_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_exploration_kwargs()
        if self.exploration == "optimistic_actor":
            own = {name: getattr(self, name) for name in OPTIMISTIC_ACTOR_SETTINGS}
            kwargs = {**own, "deterministic": self.optimistic_actor == "deterministic", **kwargs}
        return kwargs

    def make_explorer(self, learner: Learner) -> Exploration:
        if self.pessimistic_actor is None:
            return ScaledNoise(learner, self.std_multiplier)
        return super().make_explorer(learner)

    def make_objective(self, learner: Learner) -> Objective:
        if self.pessimistic_actor is not None:
            return super().make_objective(learner)
        check_uncertainty(self.uncertainty, learner)
        start = self.initial_optimism
        # Above minus every arm of a bandit, and not by the arm that it happens to have drawn.
        optimism = 0.5 - learner.pessimism_rule.smallest_beta() if start is None else start
        return OptimisticValue(optimism, self.uncertainty, self.optimistic_entropy)
