"""
Scheduling of a study: the choice of the next run, the process that makes it, and its outcome.

Worker processes of this machine (:mod:`sb3_sample.study.worker`) are reused for runs that differ only in their seed, so
that imports are paid for once; in a Ray cluster (:mod:`sb3_sample.study.cluster`) each run has its own process. The
scheduler holds no locks while they work and reads nothing from them except their answers: the folder records which runs
are done, failed and claimed, so that the scheduler may be killed at any moment, and others may work beside it.
"""

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any, Protocol

from sb3_sample.kinds import check_value, integer
from sb3_sample.study import cluster
from sb3_sample.study.cores import free_cores, threads_of_libraries
from sb3_sample.study.plan import Plan, Run
from sb3_sample.study.plan_file import read_plan
from sb3_sample.study.runs import Outcome, StudyFolder, checkpointed
from sb3_sample.study.states import DONE, FAILED, RUNNING, WAITING, RunStatus, Status

#: Command of a process that makes runs, before the study's folder.
WORKER = (sys.executable, "-c", "from sb3_sample.study.worker import serve; serve()")
#: Seconds between two status updates, and between two checks of runs that other machines have.
REFRESH, ELSEWHERE = 2.0, 5.0


class Stopped(Exception):
    """
    SIGTERM or SIGHUP, raised while the scheduler waits.

    :param number: the signal
    """

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.number = number


def run(
    plan: str | Path | Plan,
    folder: str | Path | None = None,
    *,
    workers: int | None = None,
    retries: int = 1,
    threads: int = 1,
    device: str = "auto",
    ray: str | None = None,
    gpus: float | None = None,
    batch_seeds: bool = False,
    show: Callable[[Status], None] | None = None,
    worker: Sequence[str] = WORKER,
) -> Status:
    """
    Make or resume all runs of a plan. Finished runs are not made again, interrupted ones resume from their last
    checkpoint, and failed ones are tried again. Runs that other processes make in the folder are waited for.

    :param plan: a plan or its file
    :param folder: the study's folder; ``runs/<name of the plan>`` if None
    :param workers: processes, each with one run at a time; if None, as many as there are free cores for; in a cluster,
        as many as its machines have room for
    :param retries: how often a failed run is tried again
    :param threads: of each process
    :param device: of each run, as for ``sb3-sample train --device``
    :param ray: Ray cluster that makes the runs: ``"local"`` for one on this machine, ``"auto"`` for the one of this
        machine, else its address; None for processes of this machine without Ray. All machines of the cluster must see
        the folder
    :param gpus: GPUs of each run, or its share of one; only with ``ray``
    :param batch_seeds: whether runs that differ only in their seed are made together, by one process, if their
        algorithm supports it (docs/many_learners.md); a failed run is tried again separately
    :param show: called with the status, at the beginning, every two seconds and at the end
    :param worker: command of a process that makes runs without Ray, before the study's folder
    :return: final status of the runs
    :raises PlanError: the plan cannot be run as it is written; nothing was run
    :raises StudyError: the folder has runs with other settings, and nothing was changed; or there is no such cluster,
        or it has no room for a run
    :raises ImportError: ``ray`` is given, and Ray is not installed
    :raises KeyboardInterrupt: after Ctrl-C, when the current runs have written their checkpoints; a ``Stopped`` after
        SIGTERM and SIGHUP. A second one exits at once
    :raises OSError: the folder cannot be written to, or does not support locks
    """
    check_value("retries", retries, integer(0))
    check_value("threads", threads, integer(1))
    check_value("workers", workers, integer(1).or_none())
    if ray is not None:
        cluster.check(ray, gpus)
    elif gpus is not None:
        raise ValueError(f"gpus is for runs in a Ray cluster: leave it out, or give ray, not gpus={gpus!r} alone")
    if not isinstance(plan, Plan):
        plan = read_plan(plan)
    place = StudyFolder(Path("runs") / plan.name if folder is None else folder)
    place.enter(plan)
    crew: Crew
    if ray is None:
        slots = max(free_cores() // threads, 1) if workers is None else workers
        crew = Processes([*worker, str(place.path)], slots, threads)
    else:
        crew = cluster.Cluster(ray, place.path, workers, threads, gpus)
    with _signals(), crew:
        return Scheduler(plan.runs, place, crew, retries, threads, device, show or (lambda _: None), batch_seeds).run()


@contextlib.contextmanager
def _signals() -> Iterator[None]:
    """Make SIGTERM and SIGHUP raise, like SIGINT."""

    def stop(number: int, frame: Any) -> None:
        raise Stopped(number)

    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
            if signal.getsignal(number) is signal.SIG_DFL:
                before[number] = signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Worker(Protocol):
    """Maker of one run at a time, or of several together: a process of this machine, or a place in a cluster."""

    #: The runs that it is making; none while it is idle.
    runs: tuple[Run, ...]
    #: Kind of these runs, or of the last ones.
    kind: str

    def give(self, runs: tuple[Run, ...], options: list[str], threads: int) -> None:
        """
        :param runs: runs to make
        :param options: options of ``sb3-sample train``
        :param threads: its threads
        """

    def leave(self) -> None:
        """Let it end: a training under way is saved first."""

    def kill(self) -> None:
        """End it at once."""

    def wait(self) -> None:
        """Wait until it has ended."""

    def why_ended(self) -> str:
        """
        :return: how it has ended without an answer, in words
        """


#: Answers of workers: a list with the outcome of each run, or that it has to be looked at again; None when the worker
#: has ended.
Events = queue.Queue[tuple[Worker, Any]]


class Crew(Protocol):
    """Source of workers, for the duration of its ``with``."""

    def __enter__(self) -> Any: ...

    def __exit__(self, *_: object) -> None: ...

    def slots(self) -> int:
        """
        :return: workers at once
        """

    def hire(self, events: Events) -> Worker:
        """
        :param events: queue for the worker's answers
        :return: a new one
        """


class Processes(contextlib.nullcontext[None]):
    """
    Crew of workers that are processes of this machine.

    :param command: of each
    :param slots: number at once
    :param threads: of each
    """

    def __init__(self, command: Sequence[str], slots: int, threads: int):
        super().__init__()
        self._command, self._slots, self._threads = command, slots, threads

    def slots(self) -> int:
        """
        :return: workers at once
        """
        return self._slots

    def hire(self, events: Events) -> "Process":
        """
        :param events: queue for the worker's answers
        :return: a new one
        """
        return Process(self._command, self._threads, events)


class Process:
    """
    A process of this machine that makes runs.

    :param command: of the process
    :param threads: its threads
    :param events: queue for its answers, and for None when it has ended, each with the worker
    """

    def __init__(self, command: Sequence[str], threads: int, events: Events):
        # A separate session: only the scheduler gets the terminal's Ctrl-C, and it tells its workers.
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **threads_of_libraries(threads)},
            start_new_session=True,
        )
        self.runs: tuple[Run, ...] = ()
        self.kind = ""
        threading.Thread(target=self._listen, args=(self.process.stdout, events), daemon=True).start()

    def _listen(self, answers: IO[str], events: Events) -> None:
        try:
            with answers:
                for line in answers:
                    # A worker that is killed while it answers leaves an incomplete last line.
                    if line.endswith("\n"):
                        events.put((self, json.loads(line)))
        finally:
            events.put((self, None))

    def give(self, runs: tuple[Run, ...], options: list[str], threads: int) -> None:
        """
        :param runs: runs to make
        :param options: options of ``sb3-sample train``
        :param threads: its threads
        """
        self.runs, self.kind = runs, runs[0].kind
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has died, and the event of its end follows
            print(
                json.dumps({"runs": [run.as_json() for run in runs], "options": options, "threads": threads}),
                file=self.process.stdin,
                flush=True,
            )

    def leave(self) -> None:
        """Let it end: a training under way is saved first."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()

    def kill(self) -> None:
        """End it at once."""
        self.process.kill()

    def wait(self) -> None:
        """Wait until it has ended."""
        self.process.wait()

    def why_ended(self) -> str:
        """
        :return: how the process has ended, in words
        """
        code = self.process.wait()
        if code < 0:
            return f"the process that made the run was ended by {signal.Signals(-code).name}"
        return f"the process that made the run has ended with exit code {code}"


def _batches(runs: Sequence[Run]) -> list[tuple[Run, ...]]:
    """Group runs that differ only in their seed, if they can be made together; in the order of the first of each."""
    from sb3_sample.zoo.train import can_train_together

    found: dict[str, list[Run]] = {}
    for run in runs:
        alike = {name: value for name, value in run.as_json().items() if name != "seed"}
        # Learning from a data set has no steps of an environment, at which trainings in lockstep wait for each other.
        together = can_train_together(run.algo) and "dataset" not in run.data
        key = json.dumps(alike, sort_keys=True) if together else run.name
        found.setdefault(key, []).append(run)
    return [tuple(each) for each in found.values()]


class Scheduler:
    """
    :param runs: runs in their order
    :param folder: the study's
    :param crew: source of workers
    :param retries: how often a failed run is tried again
    :param threads: of each run
    :param device: of each run
    :param show: called with the status
    :param batch_seeds: whether runs that differ only in their seed are made together
    """

    def __init__(
        self,
        runs: Sequence[Run],
        folder: StudyFolder,
        crew: Crew,
        retries: int,
        threads: int,
        device: str,
        show: Callable[[Status], None],
        batch_seeds: bool = False,
    ):
        self._runs, self._folder, self._crew, self._retries = runs, folder, crew, retries
        self._threads, self._options = threads, ["--num-threads", str(threads), "--device", device]
        self._show, self._batch_seeds = show, batch_seeds
        self._events: Events = queue.Queue()
        self._workers: list[Worker] = []
        self._pending: deque[tuple[Run, ...]] = deque()
        #: Runs that other processes have, and when to look at them again, by name.
        self._elsewhere: dict[str, tuple[Run, float]] = {}
        #: Failed attempts from before, which do not count.
        self._before: dict[str, int] = {}
        self._states: dict[str, RunStatus] = {}
        self._ended: list[RunStatus] = []
        self._shown = time.monotonic()

    def run(self) -> Status:
        """
        :return: final status of the runs
        """
        left = []
        for run in self._runs:
            outcome = self._folder.outcome(run)
            self._before[run.name] = outcome.attempts
            self._states[run.name] = RunStatus(run, DONE if outcome.done else WAITING, outcome)
            if not outcome.done:
                left.append(run)
        self._pending.extend(_batches(left) if self._batch_seeds else ((run,) for run in left))
        try:
            self._tell()
            while True:
                self._look_elsewhere()
                self._give_out()
                if not (self._pending or self._elsewhere or any(worker.runs for worker in self._workers)):
                    break
                self._hear()
        finally:
            self._end()
        return self._tell()

    # ------------------------------------------------ giving out

    def _give_out(self) -> None:
        while self._pending:
            runs = self._pending[0]
            idle = [worker for worker in self._workers if not worker.runs]
            fitting = [worker for worker in idle if worker.kind == runs[0].kind]
            slots = self._crew.slots()
            if fitting and len(self._workers) <= slots:
                worker = fitting[0]
            elif len(self._workers) >= slots:
                if not idle:
                    return
                idle[0].leave()
                self._workers.remove(idle[0])
                continue
            else:
                worker = self._crew.hire(self._events)
                self._workers.append(worker)
            self._pending.popleft()
            worker.give(runs, self._options, self._threads)
            for run in runs:
                self._set(run, RUNNING)

    def _look_elsewhere(self) -> None:
        now = time.monotonic()
        for name, (run, when) in list(self._elsewhere.items()):
            if when > now:
                continue
            if self._folder.is_claimed(run):
                self._elsewhere[name] = (run, now + ELSEWHERE)
                continue
            # It is done or has failed there, or the other process has died.
            del self._elsewhere[name]
            self._judge(run, self._folder.outcome(run))

    # ------------------------------------------------ hearing

    def _hear(self) -> None:
        wait = self._shown + REFRESH - time.monotonic()
        if wait <= 0:
            self._tell()
            wait = REFRESH
        try:
            worker, answer = self._events.get(timeout=wait)
        except queue.Empty:
            return
        runs, worker.runs = worker.runs, ()
        if answer is None:
            if worker in self._workers:
                self._workers.remove(worker)
            for run in runs:
                self._judge(run, self._died(run, worker))
            return
        for run, said in zip(runs, answer, strict=True):
            if said.get("taken"):
                self._elsewhere[run.name] = (run, time.monotonic() + ELSEWHERE)
                self._set(run, RUNNING)
                continue
            if not said["done"] and worker in self._workers:
                self._workers.remove(worker)  # it ends by itself
            self._judge(run, Outcome(**said))

    def _died(self, run: Run, worker: Worker) -> Outcome:
        """Outcome of a run whose process has ended without an answer."""
        outcome = self._folder.outcome(run)
        lock = self._folder.claim(run)
        if outcome.done or lock is None:  # another process has it already
            return outcome
        with lock:
            steps = checkpointed(self._folder.place(run))
            outcome = outcome._replace(attempts=outcome.attempts + 1, traceback=worker.why_ended(), steps=steps)
            return self._folder.write_outcome(run, outcome)

    def _judge(self, run: Run, outcome: Outcome) -> None:
        """Decide whether a run is done, is tried again or has failed."""
        if outcome.done:
            self._set(run, DONE, outcome)
        elif outcome.attempts - self._before[run.name] > self._retries:
            self._set(run, FAILED, outcome)
        else:
            self._pending.append((run,))
            self._set(run, WAITING, outcome)

    def _set(self, run: Run, state: str, outcome: Outcome | None = None) -> None:
        before = self._states[run.name]
        self._states[run.name] = RunStatus(run, state, outcome or before.outcome)
        if state in (DONE, FAILED):
            self._ended.append(self._states[run.name])

    # ------------------------------------------------ telling

    def _tell(self) -> Status:
        status = Status(self._folder, list(self._states.values()), self._ended)
        self._ended = []
        self._show(status)
        self._shown = time.monotonic()
        return status

    # ------------------------------------------------ the end

    def _end(self) -> None:
        """End the workers after their checkpoints; a second Ctrl-C ends them at once."""
        for worker in self._workers:
            worker.leave()
        try:
            for worker in self._workers:
                worker.wait()
        except BaseException:
            for worker in self._workers:
                worker.kill()
            raise
