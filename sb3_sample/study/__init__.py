"""Studies: a plan of many runs, made on as many cores as are free and on as many machines as share a folder."""

from sb3_sample.study.dry_run import Estimate, estimate
from sb3_sample.study.plan import Plan, PlanError, Run, read_plan
from sb3_sample.study.runs import Outcome, StudyError
from sb3_sample.study.schedule import Stopped, run
from sb3_sample.study.states import RunStatus, Status, status

__all__ = [
    "Estimate",
    "Outcome",
    "Plan",
    "PlanError",
    "Run",
    "RunStatus",
    "Status",
    "Stopped",
    "StudyError",
    "estimate",
    "read_plan",
    "run",
    "status",
]
