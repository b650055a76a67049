"""Algorithms that the papers compare with: rules of pessimism (TOP, GPL, OPL), OAC's exploration, SR-SAC's resets."""

from collections.abc import Sequence
from typing import Any, ClassVar

from sb3_sample.arguments import check_unused
from sb3_sample.constructor import argument
from sb3_sample.learner.exploration import Exploration
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.sac import checks
from sb3_sample.sac.algorithm import SAC

#: SR-SAC's environment steps between two resets. A separate object, recognised by identity: no literal 160_000 in a
#: program is the same.
SR_SAC_RESETS = int("160_000")


class _RuleSAC(SAC):
    """SAC with one rule that moves pessimism, by the name that ``pessimism`` would take."""

    rule: ClassVar[str]
    #: The rule's arguments by their names here.
    rule_arguments: ClassVar[dict[str, str]]

    def _full_pessimism_kwargs(self) -> dict[str, Any]:
        own = {name: getattr(self, argument) for name, argument in self.rule_arguments.items()}
        return {**own, **super()._full_pessimism_kwargs()}

    def _check_arguments(self) -> None:
        if self.pessimism != self.rule:
            raise ValueError(
                f"{type(self).__name__} moves the pessimism itself, pessimism={self.rule!r}, "
                f"not {self.pessimism!r}: leave pessimism={self.pessimism!r} out, or use SAC"
            )
        checks.check_once("pessimism_kwargs", self.pessimism_kwargs, self.rule_arguments)
        super()._check_arguments()


class TOPSAC(_RuleSAC):
    """
    Soft actor-critic with tactical optimism and pessimism (Moskovitz et al. 2021): a bandit chooses the pessimism of
    each episode. The settings are those of the VPL paper and of the regularization study (2403.00514);
    :class:`~sb3_sample.learner.pessimism.TOP` has the details.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    rule = "top"
    rule_arguments: ClassVar[dict[str, str]] = {"arms": "arms", "learning_rate": "bandit_learning_rate"}

    pessimism: float | str | type[Pessimism] = argument(default="top")
    """the rule, "top"; no other"""
    arms: Sequence[float] = argument(default=(0.0, 1.0))
    """the pessimisms to choose among"""
    bandit_learning_rate: float = argument(default=0.1)
    """learning rate of the bandit, for returns of up to 1000"""


class GPLSAC(_RuleSAC):
    """
    Soft actor-critic with generalized pessimism learning (Cetin and Celiktutan 2023): the dual step on replay
    transitions.
    :class:`~sb3_sample.learner.pessimism.LearnedPessimism` has the details.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    rule = "gpl"
    rule_arguments: ClassVar[dict[str, str]] = {
        "initial_pessimism": "initial_pessimism",
        "learning_rate": "pessimism_learning_rate",
    }

    pessimism: float | str | type[Pessimism] = argument(default="gpl")
    """the rule, "gpl"; no other"""
    initial_pessimism: float = argument(default=1.0)
    """pessimism at the start and after a reset"""
    pessimism_learning_rate: float = argument(default=5e-5)
    """learning rate of the pessimism; 5e-5 as in the VPL paper (1e-5 in the regularization study, 2403.00514)"""


class OPLSAC(_RuleSAC):
    """
    Soft actor-critic with on-policy pessimism learning (Kuznetsov et al. 2021): the dual step against the TD(lambda)
    returns of the latest steps. :class:`~sb3_sample.learner.pessimism.LearnedPessimism` has the details.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    rule = "opl"
    rule_arguments: ClassVar[dict[str, str]] = {
        "initial_pessimism": "initial_pessimism",
        "learning_rate": "pessimism_learning_rate",
        "segment_length": "segment_length",
        "td_lambda": "td_lambda",
    }

    pessimism: float | str | type[Pessimism] = argument(default="opl")
    """the rule, "opl"; no other"""
    initial_pessimism: float = argument(default=1.0)
    """pessimism at the start and after a reset"""
    pessimism_learning_rate: float = argument(default=5e-5)
    """learning rate of the pessimism"""
    segment_length: int = argument(default=8)
    """latest steps of each environment that the rule uses"""
    td_lambda: float = argument(default=0.95)
    """lambda of the returns"""


class OAC(SAC):
    """
    Optimistic actor-critic (Ciosek et al. 2019): soft actor-critic that explores with its actor's mean shifted along
    the gradient of an upper bound. The settings are those of the DAC paper's comparison;
    :class:`~sb3_sample.learner.exploration.OptimisticGradient` has the details.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    optimism: float = argument(default=4.36)
    """weight of the critics' spread in the upper bound"""
    kl_radius: float = argument(default=3.69**2 / 2)
    """KL divergence to the actor, summed over the action's dimensions, that the shift may cause"""
    exploration: str | type[Exploration] = argument(default="oac")
    """policy that acts while training: "oac", or another of ``SAC``'s"""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.exploration == "oac":
            same = {"optimism": "optimism", "kl_radius": "kl_radius"}
            checks.check_once("exploration_kwargs", self.exploration_kwargs, same)
        else:
            check_unused(self, ("optimism", "kl_radius"), f"exploration={self.exploration!r}")

    def _full_exploration_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_exploration_kwargs()
        if self.exploration == "oac":
            kwargs = {"optimism": self.optimism, "kl_radius": self.kl_radius, **kwargs}
        return kwargs


class SRSAC(SAC):
    """
    SR-SAC: soft actor-critic scaled by resetting (D'Oro et al. 2022), with the settings of DAC, VPL and the
    regularization study (2403.00514): sixteen gradient steps a transition, and full-parameter resets every 160,000
    environment steps. (The BRO paper compares with ``replay_ratio=32``.) The original resets every 2,560,000 gradient
    steps, whatever the replay ratio: ``reset_gradient_steps=2_560_000``; at sixteen gradient steps a transition that is
    equally often.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    replay_ratio: float | None = argument(default=16)
    """gradient steps per environment transition"""
    resets: Sequence[int] | int = argument(default=SR_SAC_RESETS)
    """environment steps between two resets, or the steps of all of them; ``reset_gradient_steps`` replaces the
    default"""
    resets_to: str = argument(default="start")
    """parameters after a reset: "start", those that the model began with, as in the original's code, or "fresh", newly
    drawn ones"""
