"""States of a study's runs (done, running, failed, waiting), and the remaining time."""

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from sb3_sample.study.plan import Run
from sb3_sample.study.runs import Outcome, Progress, StudyFolder

DONE, RUNNING, FAILED, WAITING = "done", "running", "failed", "waiting"
STATES = (DONE, RUNNING, FAILED, WAITING)


class RunStatus(NamedTuple):
    """
    :param run: a run
    :param state: ``"done"``, ``"running"``, ``"failed"`` or ``"waiting"``
    :param outcome: its outcome so far
    """

    run: Run
    state: str
    outcome: Outcome


class Status:
    """
    State of a study at a moment.

    :param folder: the study's
    :param runs: its runs, in their order
    :param ended: those that have ended since the scheduler's last status
    """

    def __init__(self, folder: StudyFolder, runs: list[RunStatus], ended: Sequence[RunStatus] = ()):
        self.folder, self.runs, self.ended = folder, runs, list(ended)

    def of(self, state: str) -> list[RunStatus]:
        """
        :param state: one of the four
        :return: the runs in this state
        """
        return [each for each in self.runs if each.state == state]

    @property
    def counts(self) -> dict[str, int]:
        """Number of runs by state."""
        return {state: len(self.of(state)) for state in STATES}

    @property
    def failures(self) -> dict[str, str]:
        """Tracebacks of failed runs by their titles."""
        return {each.run.title: each.outcome.traceback for each in self.of(FAILED)}

    @property
    def last_return(self) -> tuple[Run, float] | None:
        """The run that was completed last, and the mean return of its last evaluation; None before the first."""
        ended = [each for each in self.of(DONE) if each.outcome.last_return is not None]
        if not ended:
            return None
        last = max(ended, key=lambda each: each.outcome.finished)
        assert last.outcome.last_return is not None
        return last.run, last.outcome.last_return

    def progress(self) -> list[tuple[Run, Progress]]:
        """
        :return: progress of each running run, read now from its own files
        """
        return [(each.run, self.folder.progress(each.run)) for each in self.of(RUNNING)]

    def seconds_left(self, progress: list[tuple[Run, Progress]]) -> float | None:
        """
        Estimate the remaining time from the seconds per environment step in finished runs and in the logs of running
        ones, of the same agent and task if there are any, and from the number of runs at once.

        :param progress: of the runs that are running
        :return: seconds; None while no run is running, or none has logged a time and none is done
        """
        steps, seconds = {"": 0}, {"": 0.0}
        made = [(each.run, each.outcome.steps_made, each.outcome.seconds) for each in self.of(DONE)]
        made += [(run, found.timed_steps, found.seconds) for run, found in progress]
        for run, n_made, took in made:
            for key in ("", run.kind):
                steps[key] = steps.get(key, 0) + n_made
                seconds[key] = seconds.get(key, 0.0) + took
        if not steps[""] or not progress:
            return None
        rest = [(run, run.steps - min(found.steps, run.steps)) for run, found in progress]
        rest += [(each.run, each.run.steps - each.outcome.steps) for each in self.of(WAITING)]
        total = 0.0
        for run, left in rest:
            key = run.kind if steps.get(run.kind) else ""
            total += left * seconds[key] / steps[key]
        return total / len(progress)

    def line(self) -> str:
        """
        :return: counts, the last return and the time left in one line
        """
        progress = self.progress()
        parts = [f"{count} {state}" for state, count in self.counts.items()]
        if (last := self.last_return) is not None:
            parts.append(f"last return {last[1]:.1f} ({last[0].title})")
        left = self.seconds_left(progress)
        if left is not None:
            parts.append(f"about {duration(left)} left")
        return ", ".join(parts)

    def __str__(self) -> str:
        lines = [self.line()]
        for run, found in self.progress():
            last = "" if found.last_return is None else f", last return {found.last_return:.1f}"
            lines.append(
                f"running: {run.title}: {found.steps:,} of {run.steps:,} steps{last} ({self.folder.holder(run)})"
            )
        for each in self.of(FAILED):
            lines.append(f"failed after {_times(each.outcome.attempts)}: {each.run.title}")
            lines.append("    " + each.outcome.traceback.rstrip().replace("\n", "\n    "))
        return "\n".join(lines)


def _times(number: int) -> str:
    return f"{number} attempt" + ("s" if number != 1 else "")


def duration(seconds: float) -> str:
    """
    :param seconds: a time
    :return: the time as hours, minutes and seconds
    """
    return str(datetime.timedelta(seconds=round(seconds)))


def status(folder: str | Path) -> Status:
    """
    Read the state of a study, whichever process or machine runs it.

    :param folder: the study's
    :return: its state. A run is running while a process has claimed it, and has failed if its last attempt failed and
        no process has claimed it
    :raises StudyError: it is not a study's folder
    """
    place = StudyFolder(folder)
    found = []
    for run in place.runs():
        outcome = place.outcome(run)
        if outcome.done:
            state = DONE
        elif place.is_claimed(run):
            state = RUNNING
        else:
            state = FAILED if outcome.traceback else WAITING
        found.append(RunStatus(run, state, outcome))
    return Status(place, found)
