"""XQC."""

from typing import Any

from stable_baselines3.common.type_aliases import Schedule

from sb3_sample.constructor import argument
from sb3_sample.kinds import ABOVE_0, check_value, integer
from sb3_sample.learner.heads import ValueHead
from sb3_sample.learner.reward_scale import RewardScale
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.policy_kwargs import with_hidden_sizes


class XQC(SAC):
    """
    XQC: well-conditioned optimisation by batch norm, unit-norm weights and a cross-entropy loss (Palenicek et al. 2026,
    https://arxiv.org/abs/2509.25174).

    Networks with batch norm before every activation and weights of unit norm ("xqc"), critics as classifiers over 101
    atoms in [-5, 5], rewards divided by the standard deviation of the return, and a learning rate that falls linearly
    to a tenth over the planned gradient steps. Critics and their targets evaluate current and next states and actions
    in one forward pass each, so that batch statistics cover both. The actor learns in the first of every three gradient
    steps.

    Defaults are those of the published runs on DeepMind Control, with two environment steps per action
    (``action_repeat=2`` of the environment). For other runs, :meth:`discount` gives ``gamma``.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_rate: float | Schedule = argument(default=3e-4, kw_only=False)
    """learning rate of actor, critics and temperature at the start; a function of the remaining progress (from 1 to 0)
    requires ``learning_rate_schedule=None``"""
    learning_starts: int = argument(default=5_000, kw_only=False)
    """transitions with uniformly random actions before the first gradient step, counted over the model's life"""
    ent_coef: str | float = argument(default="auto_0.01", kw_only=False)
    """temperature: "auto_0.01" learns it from that start, a number fixes it"""
    value_head: str | type[ValueHead] | None = argument(default="categorical")
    """"categorical" or "hl_gauss", from -5 to 5 unless ``value_head_kwargs`` say otherwise, "half_squared", or a class
    derived from ``ValueHead``; None: scalar critics, or ``n_quantiles``"""
    policy_delay: int = argument(default=3)
    """gradient steps between two updates of actors and temperature"""
    actor_at_once: bool = argument(default=True)
    """whether the actors learn in the first of every ``policy_delay`` gradient steps instead of the last"""
    learning_rate_schedule: str | None = argument(default="linear")
    """"linear" or "cosine": decay to ``final_learning_rate`` over the planned gradient steps; None for none"""
    final_learning_rate: float = argument(default=3e-5)
    """rate at the end of the schedule"""
    reward_scale: str | type[RewardScale] | None = argument(default="xqc")
    """rule by which rewards are divided by a running measure of the return; None for none"""

    @staticmethod
    def discount(episode_steps: int, action_repeat: int = 1) -> float:
        """
        Compute the published discount factor, ``1 - 5 / T`` within [0.95, 0.995].

        :param episode_steps: environment steps of an episode
        :param action_repeat: environment steps per action; T is ``episode_steps / action_repeat``
        :return: the discount factor, for ``gamma``
        :raises ValueError: if an argument is out of range
        """
        check_value("episode_steps", episode_steps, ABOVE_0)
        check_value("action_repeat", action_repeat, integer(1))
        return min(max(1 - 5 * action_repeat / episode_steps, 0.95), 0.995)

    def _full_policy_kwargs(self) -> dict[str, Any]:
        sizes = {"critic": (512,) * 4, "actor": (256,) * 4}
        return with_hidden_sizes(super()._full_policy_kwargs(), "xqc", sizes, {}, {"clip_log_std": True})
