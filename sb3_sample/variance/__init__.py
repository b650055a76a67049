"""
Variance of policy gradients, decomposed as in the MBMA paper (Nauman and Cygan 2023, https://arxiv.org/abs/2210.13011):
whether more actions at each state or a longer trajectory lower it more, and how much bias simulated samples cause.
"""

from sb3_sample.envs.states import EnvState, check_restorable, restore_state, save_state
from sb3_sample.variance.bias import GradientSamples, compare_gradients, policy_gradient
from sb3_sample.variance.decomposition import Choice, Components, at_equal_cost, relative_cost
from sb3_sample.variance.estimate import Estimate, Interval, estimate_components

__all__ = [
    "Choice",
    "Components",
    "EnvState",
    "Estimate",
    "GradientSamples",
    "Interval",
    "at_equal_cost",
    "check_restorable",
    "compare_gradients",
    "estimate_components",
    "policy_gradient",
    "relative_cost",
    "restore_state",
    "save_state",
]
