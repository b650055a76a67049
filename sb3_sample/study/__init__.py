"""
Studies: a plan of many runs, made on all free cores and on all machines that share a folder; their table, its
statistics, and the figures of the papers' studies.
"""

from sb3_sample.envs.scores import Score
from sb3_sample.study.aggregate import aggregate, performance_profiles, probability_of_improvement
from sb3_sample.study.analysis import correlate, cost, heatmap, marginalize, regress
from sb3_sample.study.comparison import comparison
from sb3_sample.study.dry_run import Estimate, estimate
from sb3_sample.study.plan import Comparison, Plan, PlanError, Run
from sb3_sample.study.plan_file import read_plan
from sb3_sample.study.reporting.command import report
from sb3_sample.study.runs import Outcome, StudyError
from sb3_sample.study.schedule import Stopped, run
from sb3_sample.study.states import RunStatus, Status, status
from sb3_sample.study.table import load, published_curves, published_runs, read, write

__all__ = [
    "Comparison",
    "Estimate",
    "Outcome",
    "Plan",
    "PlanError",
    "Run",
    "RunStatus",
    "Score",
    "Status",
    "Stopped",
    "StudyError",
    "aggregate",
    "comparison",
    "correlate",
    "cost",
    "estimate",
    "heatmap",
    "load",
    "marginalize",
    "performance_profiles",
    "probability_of_improvement",
    "published_curves",
    "published_runs",
    "read",
    "read_plan",
    "regress",
    "report",
    "run",
    "status",
    "write",
]
