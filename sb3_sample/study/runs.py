"""
Folder of a study: one folder per run, as ``sb3-sample train --run-dir`` makes it, and beside them the study's records
of its runs.

A run is claimed by a file lock that the process making the run holds. So no two processes make the same run, on one
machine or on several that share the folder, and a dead process holds no run.
"""

import json
import os
import re
import socket
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sb3_sample.run_logs import EVALUATIONS, OFFLINE, read_evaluations
from sb3_sample.run_settings import STUDY_LIST, STUDY_RUNS
from sb3_sample.saving import temporary
from sb3_sample.saving.locks import Lock, is_taken, take
from sb3_sample.saving.untrusted import BadFile, parse_json, read_regular
from sb3_sample.study.plan import Comparison, Plan, Run
from sb3_sample.study_list import FORMER, MAX_LIST, to_json

#: Content of a study's folder: its runs, their outcomes, the list of runs and the plan as read.
RUNS, STATE, LIST, PLAN = STUDY_RUNS, "state", STUDY_LIST, "plan.yml"
_LOG = "progress.jsonl"
#: Most bytes of the outcome of one run, and of the end of a log that is read.
MAX_OUTCOME, TAIL = 2**20, 2**14
#: Most characters of a traceback that are kept.
MAX_TRACEBACK = 20_000


class StudyError(ValueError):
    """A study that cannot be made or read as requested."""


def this_process() -> str:
    """
    :return: machine and process, in words
    """
    return f"{socket.gethostname()}, process {os.getpid()}"


class Outcome(NamedTuple):
    """
    Outcome of a run.

    :param done: whether it is complete
    :param attempts: failed attempts
    :param traceback: of the last failed attempt
    :param steps: its environment steps so far
    :param seconds: of the last attempt
    :param steps_made: environment steps of the last attempt, which may have resumed from a checkpoint
    :param last_return: mean return of the last evaluation, if there was one
    :param host: machine of the last attempt
    :param threads: threads of the last attempt
    :param finished: when it ended, in seconds since 1970
    """

    done: bool
    attempts: int = 0
    traceback: str = ""
    steps: int = 0
    seconds: float = 0.0
    steps_made: int = 0
    last_return: float | None = None
    host: str = ""
    threads: int = 1
    finished: float = 0.0


class Progress(NamedTuple):
    """
    Progress of a run, from its own files.

    :param steps: environment steps
    :param last_return: mean return of the last evaluation; None before the first
    :param timed_steps: steps whose time its log gives, over all attempts; 0 before the first line
    :param seconds: time of these steps
    """

    steps: int
    last_return: float | None
    timed_steps: int = 0
    seconds: float = 0.0


class StudyFolder:
    """
    :param path: the folder of a study
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)

    # ---------------------------------------------------------------- the list of runs

    def enter(self, plan: Plan, keep: bool = False) -> None:
        """
        Set up the folder for a plan. A plan that was run there before may have more runs and more steps now.

        :param plan: the plan
        :param keep: whether runs that are in the list but not in the plan stay in the list
        :raises StudyError: one of its runs exists with other settings
        :raises OSError: the folder cannot be made or written to, or does not support locks
        """
        for name in (RUNS, STATE):
            (self.path / name).mkdir(parents=True, exist_ok=True)
        # Two machines may begin at the same time.
        while (lock := take(self.path / STATE / ".lock")) is None:
            time.sleep(0.01)
        with lock:
            runs, comparison = {run.name: run for run in plan.runs}, plan.comparison
            known: list[Run] = []
            former: list[Run] = []
            if (self.path / LIST).exists():
                known, former = self.runs(), self._former()
                # Runs that were never begun, or were removed, have no settings to keep.
                there = [*former, *(run for run in known if self.place(run).is_dir())]
                _check_same(self.path, there, plan.runs)
                _check_names(self.path, there, plan.runs)
                if keep:
                    runs = {run.name: run for run in known} | runs
                    comparison = comparison if any(comparison) else self.comparison()
            listed = [run.as_json() for run in runs.values()]
            # Runs that were removed from the plan: their folders still exist, and they may be put back.
            left = {run.name: run.as_json() for run in (*former, *known) if run.name not in runs}
            content = {"name": plan.name, **comparison._asdict(), "runs": listed, FORMER: left}
            _write(self.path / LIST, json.dumps(content, indent=1))
            if plan.text:
                _write(self.path / PLAN, plan.text)

    def _list(self) -> Any:
        path = self.path / LIST
        try:
            return parse_json(read_regular(path, MAX_LIST), "it")
        except FileNotFoundError as error:
            raise StudyError(f"{self.path} is no folder of sb3-sample study run: it has no {LIST}") from error
        except (OSError, BadFile) as error:
            raise StudyError(f"{path} is not what sb3-sample study run has written: {error}") from error

    def runs(self) -> list[Run]:
        """
        :return: the runs of the plan that was last run there
        :raises StudyError: there is no list of runs, or it is damaged
        """
        content = self._list()
        try:
            return [Run.of_json(run) for run in content["runs"]]
        except (ValueError, KeyError, TypeError) as error:
            raise StudyError(f"{self.path / LIST} is not what sb3-sample study run has written: {error}") from error

    def _former(self) -> list[Run]:
        """Runs of earlier plans that are not in the last one and whose folders still exist."""
        content = self._list()
        try:
            found = [Run.of_json(run) for run in content.get(FORMER, {}).values()]
        except (ValueError, AttributeError, TypeError) as error:
            raise StudyError(f"{self.path / LIST} is not what sb3-sample study run has written: {error}") from error
        return [run for run in found if self.place(run).is_dir()]

    def comparison(self) -> Comparison:
        """
        :return: how the runs are compared, from the plan that was last run there
        :raises StudyError: there is no list of runs, or it is damaged
        """
        content = self._list()
        found: list[Any] = [content.get(n, {}) if isinstance(content, dict) else None for n in Comparison._fields]
        if not all(isinstance(each, dict) and all(map(_are_texts, each.values())) for each in found):
            raise StudyError(f"{self.path / LIST} is not what sb3-sample study run has written: {found!r:.200}")
        return Comparison(*found)

    # ---------------------------------------------------------------- one run

    def place(self, run: Run) -> Path:
        """
        :param run: a run
        :return: its folder, as for ``sb3-sample train --run-dir``
        """
        return self.path / RUNS / run.name

    def _beside(self, run: Run, suffix: str) -> Path:
        return self.path / STATE / f"{run.name}{suffix}"

    def output(self, run: Run) -> Path:
        """
        :param run: a run
        :return: the file of its process's output
        """
        return self._beside(run, ".txt")

    def claim(self, run: Run) -> Lock | None:
        """
        :param run: a run
        :return: its lock; None while another process holds it
        :raises OSError: the folder has no locks
        """
        path = self._beside(run, ".lock")
        path.parent.mkdir(parents=True, exist_ok=True)
        return take(path)

    def holder(self, run: Run) -> str:
        """
        :param run: a run that a process has claimed
        :return: the process, as recorded in the lock
        """
        try:
            found = read_regular(self._beside(run, ".lock"), 1000).decode(errors="replace")
        except (OSError, BadFile):
            return ""
        return "".join(letter for letter in found if letter.isprintable())

    def is_claimed(self, run: Run) -> bool:
        """
        :param run: a run
        :return: whether a process holds it now
        :raises OSError: its lock cannot be read, or the folder does not support locks
        """
        return is_taken(self._beside(run, ".lock"))

    def outcome(self, run: Run) -> Outcome:
        """
        :param run: a run
        :return: its outcome so far. A run whose folder was removed counts as never made; one that is to have more steps
            goes on from those it has
        :raises StudyError: its file is damaged
        """
        path = self._beside(run, ".json")
        try:
            found = parse_json(read_regular(path, MAX_OUTCOME), "it")
        except FileNotFoundError:
            return Outcome(False)
        except (OSError, BadFile) as error:
            raise StudyError(f"{path} is not what sb3-sample study run has written: {error}") from error
        if not isinstance(found, dict) or not {"done"} <= found.keys() <= set(Outcome._fields):
            raise StudyError(f"{path} is not what sb3-sample study run has written: remove it, and the run goes on")
        outcome = Outcome(**found)
        if outcome.done and not self.place(run).is_dir():
            return Outcome(False)
        if outcome.done and outcome.steps < run.steps:
            return Outcome(False, steps=outcome.steps)
        return outcome

    def write_outcome(self, run: Run, outcome: Outcome) -> Outcome:
        """
        :param run: a run that this process has claimed
        :param outcome: its outcome
        :return: the outcome with machine and time
        """
        whole = outcome._replace(
            traceback=outcome.traceback[-MAX_TRACEBACK:], host=socket.gethostname(), finished=time.time()
        )
        _write(self._beside(run, ".json"), json.dumps(whole._asdict(), indent=1))
        return whole

    def progress(self, run: Run) -> Progress:
        """
        :param run: a run
        :return: its progress, from whichever of its checkpoints, log and evaluations is farthest
        """
        folder = self.place(run)
        logged, timed_steps, seconds = _logged(folder / _LOG)
        if "dataset" in run.data:
            # The steps on a data set come first, and have a log and a clock of their own.
            first_logged, first_steps, first_seconds = _logged(folder / OFFLINE / _LOG)
            logged, timed_steps = max(logged, first_logged), max(timed_steps, first_steps)
            seconds += first_seconds
        steps = max(checkpointed(folder), logged)
        try:
            found = read_evaluations(folder / EVALUATIONS)
        except (OSError, BadFile):  # no evaluations yet, or a file that is being written
            return Progress(steps, None, timed_steps, seconds)
        steps = max(steps, int(found["timesteps"][-1]))
        return Progress(steps, float(found["results"][-1].mean()), timed_steps, seconds)


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(each, str) for each in value)


def checkpointed(folder: Path) -> int:
    """
    :param folder: folder of a run
    :return: steps of its newest checkpoint, including those on a data set; 0 without one
    """
    try:
        names = os.listdir(folder)
        if OFFLINE in names:
            names += os.listdir(folder / OFFLINE)
    except OSError:
        return 0
    return max((int(m[1]) for name in names if (m := re.fullmatch(r"checkpoint-(\d{12,})", name))), default=0)


def _logged(path: Path) -> tuple[int, int, float]:
    """Environment steps in a run's last whole log line, and steps and seconds in the last one with a time."""
    try:
        with path.open("rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - TAIL, 0))
            lines = file.read().split(b"\n")
    except OSError:
        return 0, 0, 0.0
    last = 0
    for line in reversed(lines[:-1]):
        try:
            found = json.loads(line)
            steps, seconds = found["time/total_timesteps"], found.get("time/time_elapsed")
        except (ValueError, KeyError, TypeError):
            continue
        if type(steps) is int:
            last = last or steps
            if type(seconds) in (int, float):  # an evaluation's line has no time
                return last, steps, seconds
    return last, 0, 0.0


def _write(path: Path, text: str) -> None:
    with temporary.becoming(path) as file:
        file.write(text.encode())


#: Settings of a run that may differ when it goes on.
_FREE = frozenset({"checkpoint_freq", "gym_packages"})


def _check_same(path: Path, before: Iterable[Run], now: Iterable[Run]) -> None:
    known = {run.name: run.as_json() for run in before}
    for run in now:
        if (there := known.get(run.name)) is None:
            continue
        here = run.as_json()
        free = _FREE | ({"steps"} if run.steps >= there["steps"] else set())
        for name in (here.keys() | there.keys()) - free:
            if here.get(name) != there.get(name):
                raise StudyError(
                    f"{path} has {run.title}, with {_pair(name, there, here)}. Nothing was changed: run the plan as it "
                    "was, or in another --folder"
                )


def _check_names(path: Path, before: Iterable[Run], now: Sequence[Run]) -> None:
    """Refuse runs that are there under another name: with the grid in another order, or 1.0 in it for 1."""
    names = {run.name for run in now}
    renamed = {_settings(run): run for run in before if run.name not in names}
    known = {run.name for run in before}
    for run in now:
        if run.name not in known and (there := renamed.get(_settings(run))) is not None:
            raise StudyError(
                f"{path} has {there.title}, in {RUNS}/{there.name}, which the plan now names {run.name}: its grid is "
                "written in another order, or its numbers are. Nothing was changed: write the grid as it was, or use "
                "another --folder"
            )


def _settings(run: Run) -> str:
    return to_json({name: value for name, value in run.as_json().items() if name not in _FREE | {"steps"}})


def _pair(name: str, there: dict[str, Any], here: dict[str, Any]) -> str:
    return f"{name} {there.get(name)!r:.200}, and the plan now says {here.get(name)!r:.200}"
