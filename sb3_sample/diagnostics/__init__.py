"""Diagnostics of the papers: overestimation, overfitting, signs of a loss of plasticity, noise of the gradient."""

from sb3_sample.diagnostics.callback import DiagnosticsCallback
from sb3_sample.diagnostics.gradient_noise import NoiseScaleCallback
from sb3_sample.diagnostics.measures import (
    Rollout,
    average_value,
    discounted_return,
    dormant_shares,
    effective_rank,
    global_norm,
    noise_scale,
)

__all__ = [
    "DiagnosticsCallback",
    "NoiseScaleCallback",
    "Rollout",
    "average_value",
    "discounted_return",
    "dormant_shares",
    "effective_rank",
    "global_norm",
    "noise_scale",
]
