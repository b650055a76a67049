"""Many runs as one table, their statistics, and the figures of the papers' studies."""

from sb3_sample.envs.scores import Score
from sb3_sample.study.aggregate import aggregate, performance_profiles, probability_of_improvement
from sb3_sample.study.analysis import correlate, cost, heatmap, marginalize, regress
from sb3_sample.study.table import load, published_curves, published_runs, read, write

__all__ = [
    "Score",
    "aggregate",
    "correlate",
    "cost",
    "heatmap",
    "load",
    "marginalize",
    "performance_profiles",
    "probability_of_improvement",
    "published_curves",
    "published_runs",
    "read",
    "regress",
    "write",
]
