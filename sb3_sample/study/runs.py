"""
The folder of a study: a folder a run, as ``sb3-sample train --run-dir`` makes it, and beside these what a study says of
its runs.

A run is claimed by the lock of a file, which the process holds that makes the run. So no two processes have the same
run, on one machine or on several that share the folder, and one that is dead has none.
"""

import json
import os
import re
import socket
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from sb3_sample.run_logs import EVALUATIONS, OFFLINE, read_evaluations
from sb3_sample.run_settings import STUDY_LIST, STUDY_RUNS
from sb3_sample.saving import temporary
from sb3_sample.saving.locks import Lock, is_taken, take
from sb3_sample.saving.untrusted import BadFile, parse_json, read_regular
from sb3_sample.study.plan import Comparison, Plan, Run

#: Content of a study's folder: its runs, the outcome of each, the list of them and the plan as it was read.
RUNS, STATE, LIST, PLAN = STUDY_RUNS, "state", STUDY_LIST, "plan.yml"
#: In the list: runs that were in it and are not in the plan any more, by their names.
FORMER = "former"
_LOG = "progress.jsonl"
#: Bytes of the list, of what is said of one run, and of the end of a log that is looked at.
MAX_LIST, MAX_OUTCOME, TAIL = 2**28, 2**20, 2**14
#: Characters of a traceback that are kept.
MAX_TRACEBACK = 20_000


class StudyError(ValueError):
    """A study that cannot be made or read as asked."""


def this_process() -> str:
    """
    :return: machine and process, in words
    """
    return f"{socket.gethostname()}, process {os.getpid()}"


class Outcome(NamedTuple):
    """
    What became of a run.

    :param done: whether it was made to its end
    :param attempts: attempts that failed
    :param traceback: of the last that failed
    :param steps: environment steps that it has
    :param seconds: of the last attempt
    :param steps_made: environment steps of the last attempt, which goes on from a checkpoint
    :param last_return: mean return of the last evaluation, if there was one
    :param host: machine of the last attempt
    :param threads: its threads
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
    How far a run is, by its own files.

    :param steps: environment steps
    :param last_return: mean return of the last evaluation; None before the first
    :param timed_steps: those of the steps whose time its log has told, of all attempts; 0 before the first line
    :param seconds: that time
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
        Make the folder that of a plan. A plan that has been run there may have got more runs and more steps since.

        :param plan: the plan
        :param keep: whether runs stay in the list that are there and not in the plan
        :raises StudyError: a run of its is there with other settings
        :raises OSError: the folder cannot be made or written to, or has no locks
        """
        for name in (RUNS, STATE):
            (self.path / name).mkdir(parents=True, exist_ok=True)
        # Two machines that begin at the same time.
        while (lock := take(self.path / STATE / ".lock")) is None:
            time.sleep(0.01)
        with lock:
            runs, comparison = {run.name: run for run in plan.runs}, plan.comparison
            known: list[Run] = []
            former: list[Run] = []
            if (self.path / LIST).exists():
                known, former = self.runs(), self._former()
                _check_same(self.path, [*former, *known], plan.runs)
                if keep:
                    runs = {run.name: run for run in known} | runs
                    comparison = comparison if any(comparison) else self.comparison()
            listed = [run.as_json() for run in runs.values()]
            # Runs that were taken out of the plan: their folders are there, and they may be put back.
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
        :raises StudyError: there is none, or its list is not what was written
        """
        content = self._list()
        try:
            return [Run.of_json(run) for run in content["runs"]]
        except (ValueError, KeyError, TypeError) as error:
            raise StudyError(f"{self.path / LIST} is not what sb3-sample study run has written: {error}") from error

    def _former(self) -> list[Run]:
        """Runs of earlier plans that are not in the last one and whose folders are there still."""
        content = self._list()
        try:
            found = [Run.of_json(run) for run in content.get(FORMER, {}).values()]
        except (ValueError, AttributeError, TypeError) as error:
            raise StudyError(f"{self.path / LIST} is not what sb3-sample study run has written: {error}") from error
        return [run for run in found if self.place(run).is_dir()]

    def comparison(self) -> Comparison:
        """
        :return: how the runs are compared, as the plan says that was last run there
        :raises StudyError: there is none, or its list is not what was written
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
        :return: its folder, as ``sb3-sample train --run-dir`` has it
        """
        return self.path / RUNS / run.name

    def _beside(self, run: Run, suffix: str) -> Path:
        return self.path / STATE / f"{run.name}{suffix}"

    def output(self, run: Run) -> Path:
        """
        :param run: a run
        :return: the file of what its process prints
        """
        return self._beside(run, ".txt")

    def claim(self, run: Run) -> Lock | None:
        """
        :param run: a run
        :return: its lock; None while another process has it
        :raises OSError: the folder has no locks
        """
        path = self._beside(run, ".lock")
        path.parent.mkdir(parents=True, exist_ok=True)
        return take(path)

    def holder(self, run: Run) -> str:
        """
        :param run: a run that a process has claimed
        :return: the process, as it has said
        """
        try:
            found = read_regular(self._beside(run, ".lock"), 1000).decode(errors="replace")
        except (OSError, BadFile):
            return ""
        return "".join(letter for letter in found if letter.isprintable())

    def is_claimed(self, run: Run) -> bool:
        """
        :param run: a run
        :return: whether a process has it at present
        :raises OSError: its lock cannot be read, or the folder has no locks
        """
        return is_taken(self._beside(run, ".lock"))

    def outcome(self, run: Run) -> Outcome:
        """
        :param run: a run
        :return: what became of it so far. A run whose folder was removed is as one that was never made, and so is one
            that shall have more steps
        :raises StudyError: the file is not what was written
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
        if outcome.done and (outcome.steps < run.steps or not self.place(run).is_dir()):
            return Outcome(False)
        return outcome

    def write_outcome(self, run: Run, outcome: Outcome) -> Outcome:
        """
        :param run: a run that this process has claimed
        :param outcome: what became of it
        :return: the same, with machine and time
        """
        whole = outcome._replace(
            traceback=outcome.traceback[-MAX_TRACEBACK:], host=socket.gethostname(), finished=time.time()
        )
        _write(self._beside(run, ".json"), json.dumps(whole._asdict(), indent=1))
        return whole

    def progress(self, run: Run) -> Progress:
        """
        :param run: a run
        :return: how far it is, by its checkpoints, its log and its evaluations, of which the last counts
        """
        folder = self.place(run)
        logged, timed_steps, seconds = _logged(folder / _LOG)
        steps = max(checkpointed(folder), logged)
        try:
            found = read_evaluations(folder / EVALUATIONS)
        except (OSError, BadFile):  # none so far, or one is being written
            return Progress(steps, None, timed_steps, seconds)
        steps = max(steps, int(found["timesteps"][-1]))
        return Progress(steps, float(found["results"][-1].mean()), timed_steps, seconds)


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(each, str) for each in value)


def checkpointed(folder: Path) -> int:
    """
    :param folder: a run's
    :return: steps of its newest checkpoint, those on a data set included; 0 without one
    """
    try:
        names = os.listdir(folder)
        if OFFLINE in names:
            names += os.listdir(folder / OFFLINE)
    except OSError:
        return 0
    return max((int(m[1]) for name in names if (m := re.fullmatch(r"checkpoint-(\d{12,})", name))), default=0)


def _logged(path: Path) -> tuple[int, int, float]:
    """Environment steps by the last whole line of a run's log, and steps and seconds by the last that has a time."""
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
            if type(seconds) in (int, float):  # an evaluation's line has none
                return last, steps, seconds
    return last, 0, 0.0


def _write(path: Path, text: str) -> None:
    with temporary.becoming(path) as file:
        file.write(text.encode())


def _check_same(path: Path, before: Iterable[Run], now: Iterable[Run]) -> None:
    known = {run.name: run.as_json() for run in before}
    for run in now:
        if (there := known.get(run.name)) is None:
            continue
        here = run.as_json()
        free = {"checkpoint_freq", "gym_packages"} | ({"steps"} if run.steps >= there["steps"] else set())
        for name in (here.keys() | there.keys()) - free:
            if here.get(name) != there.get(name):
                raise StudyError(
                    f"{path} has {run.title}, with {_pair(name, there, here)}. Nothing was changed: run the plan as it "
                    "was, or in another --folder"
                )


def _pair(name: str, there: dict[str, Any], here: dict[str, Any]) -> str:
    return f"{name} {there.get(name)!r:.200}, and the plan now says {here.get(name)!r:.200}"
