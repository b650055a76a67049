"""FlashSAC."""

import math
from typing import Any

from stable_baselines3.common.type_aliases import Schedule

from sb3_sample.arguments import default_of
from sb3_sample.constructor import Given, argument
from sb3_sample.kinds import ABOVE_0, choice_of
from sb3_sample.learner.categorical import VALUE_HEADS, CategoricalHead
from sb3_sample.learner.exploration import Exploration
from sb3_sample.learner.heads import ValueHead
from sb3_sample.learner.reward_scale import RewardScale
from sb3_sample.own_classes import defaults_for
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.policy_kwargs import with_networks

#: Width and blocks of the published networks.
_SIZES: dict[str, dict[str, Any]] = {
    "critic": {"width": 256, "n_blocks": 2},
    "actor": {"width": 128, "n_blocks": 2},
}


class FlashSAC(SAC):
    """
    FlashSAC (Holiday Robot 2026, https://arxiv.org/abs/2604.04539), with the settings of its runs on CPU simulators.

    Residual networks with batch norm whose weights, scales and shifts keep their norms ("flash"), critics as
    classifiers over 101 atoms in [-5, 5], rewards divided by a running measure of the return, noise that is held for
    some steps while exploring, and a learning rate that falls along a cosine to half over the planned gradient steps.
    Critics, their targets and the actor see current and next states in one forward pass, so that batch statistics cover
    both. Actor and temperature learn in the first of every two gradient steps, before the critics.

    Defaults are those of the published runs on DeepMind Control, with one environment step per action.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_rate: float | Schedule = argument(default=3e-4, kw_only=False)
    """learning rate of actor, critics and temperature at the start; a function of the remaining progress (from 1 to 0)
    requires ``learning_rate_schedule=None``"""
    batch_size: int = argument(default=512, kw_only=False)
    """transitions per gradient step"""
    tau: float = argument(default=0.01, kw_only=False)
    """weight of the new critics in the Polyak average of the targets, in (0, 1]"""
    ent_coef: str | float = argument(default="auto_0.01", kw_only=False)
    """temperature: "auto_0.01" learns it from that start, a number fixes it"""
    target_entropy: str | float = argument(default="auto", kw_only=False)
    """entropy that the learned temperature aims at; "auto" is that of a Gaussian with the standard deviation
    ``target_std``"""
    target_std: float = argument(default=0.15, kind=ABOVE_0)
    """standard deviation, in each action dimension, of the Gaussian whose entropy is ``target_entropy="auto"``"""
    replay_ratio: float | None = argument(default=1)
    """gradient steps per environment transition after the warm-up, whatever the number of environments; may be below
    1"""
    value_head: str | type[ValueHead] | None = argument(default="categorical")
    """"categorical" or "hl_gauss", from -5 to 5 and with the mean of the critics' losses unless ``value_head_kwargs``
    say otherwise, "half_squared", or a class derived from ``ValueHead``; None: scalar critics, or ``n_quantiles``"""
    exploration: str | type[Exploration] = argument(default="held_noise")
    """policy that acts while training: "held_noise", or another of ``SAC``'s"""
    policy_delay: int = argument(default=2)
    """gradient steps between two updates of actors and temperature"""
    actor_at_once: bool = argument(default=True)
    """whether the actors learn in the first of every ``policy_delay`` gradient steps instead of the last"""
    actor_first: bool = argument(default=True)
    """whether actors and temperature learn before the critics in a gradient step"""
    learning_rate_schedule: str | None = argument(default="cosine")
    """"linear" or "cosine": decay to ``final_learning_rate`` over the planned gradient steps; None for none"""
    final_learning_rate: float = argument(default=1.5e-4)
    """rate at the end of the schedule"""
    warm_up_steps: int = argument(default=1)
    """planned gradient steps before the decay, in which the rate rises linearly to ``learning_rate``"""
    warm_up_learning_rate: float | None = argument(default=None)
    """learning rate at the start of the warm-up; None: ``learning_rate``, throughout the warm-up"""
    reward_scale: str | type[RewardScale] | None = argument(default="flashsac")
    """rule by which rewards are divided by a running measure of the return; None for none"""

    def _construct(self, given: Given) -> None:
        # Only arguments that are passed: in a model already made, or loaded, target_entropy is the number that "auto"
        # stood for.
        if "target_std" in given.passed and given["target_std"] != default_of(type(self), "target_std"):
            self._check_one_target({name: value for name, value in given.items() if name in given.passed})
            if given["backbone"] == "td3":
                raise ValueError(
                    f"target_std={given['target_std']!r} means nothing with backbone='td3', which has no entropy: "
                    "leave one of them out"
                )
        super()._construct(given)

    @staticmethod
    def _check_one_target(passed: dict[str, Any]) -> None:
        if "target_std" in passed and passed.get("target_entropy", "auto") != "auto":
            raise ValueError(
                f"target_std={passed['target_std']!r} means nothing with target_entropy="
                f"{passed['target_entropy']!r}: leave one of them out"
            )

    @classmethod
    def _implied(cls, kwargs: dict[str, Any]) -> dict[str, Any]:
        implied: dict[str, Any] = super()._implied(kwargs)
        cls._check_one_target(kwargs)
        if "target_std" in kwargs and "target_entropy" not in kwargs:
            implied["target_entropy"] = "auto"
        return implied

    def _auto_target_entropy(self, action_dim: int) -> float:
        return action_dim * math.log(2 * math.pi * math.e * self.target_std**2) / 2

    def _value_head_defaults(self) -> dict[str, Any]:
        return defaults_for(choice_of(self.value_head, VALUE_HEADS), CategoricalHead, average_critics=True)

    def _full_policy_kwargs(self) -> dict[str, Any]:
        return with_networks(super()._full_policy_kwargs(), "flash", _SIZES)
