"""Diagnostics of the papers: overestimation, overfitting and signs of a loss of plasticity."""

from sb3_sample.diagnostics.callback import DiagnosticsCallback
from sb3_sample.diagnostics.measures import (
    Rollout,
    average_value,
    discounted_return,
    dormant_shares,
    effective_rank,
    global_norm,
)

__all__ = [
    "DiagnosticsCallback",
    "Rollout",
    "average_value",
    "discounted_return",
    "dormant_shares",
    "effective_rank",
    "global_norm",
]
