"""
Process that makes runs, started by the scheduler with the study's folder as its argument.

It takes one order after another, as lines of JSON on its standard input, and answers each with a line on its standard
output. An order is for one run, or for several that are made together. The output of a run goes to a separate file.
When the input ends, because the scheduler has no more runs or is gone, the process stops: a running training finishes
its current iteration and writes a checkpoint, as after SIGTERM.
"""

import contextlib
import functools
import gc
import json
import os
import queue
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

from sb3_sample.lockstep import present
from sb3_sample.study.plan import Run
from sb3_sample.study.runs import Outcome, StudyFolder, checkpointed, this_process

#: Makes a run: the run, its folder, and options of ``sb3-sample train``.
Train = Callable[[Run, Path, list[str]], None]
#: Exit code of a process that ended in an orderly way after SIGTERM.
TERMINATED = 128 + signal.SIGTERM
#: Answer of a process that has not completed a run, which has to be looked at again.
TAKEN = {"taken": True}


def train(run: Run, folder: Path, options: list[str]) -> None:
    """
    Make a run like ``sb3-sample train``.

    :param run: the run
    :param folder: its folder
    :param options: more options
    :raises Exception: any error that makes the run fail
    """
    with training() as make:
        make(run, folder, options)


@contextlib.contextmanager
def training() -> Iterator[Train]:
    """
    :return: function that makes a run like ``sb3-sample train``. Trainings in lockstep call it concurrently
    """
    from sb3_sample import zoo
    from sb3_sample.zoo import train as command
    from sb3_sample.zoo.patches import reading
    from sb3_sample.zoo.runs import Data

    zoo.register()

    def make(run: Run, folder: Path, options: list[str]) -> None:
        given, rest = command.train_parser().parse_known_args([*run.command(folder), *options])
        start = command.plan(given, rest)
        assert start is not None
        train_in_zoo(start, start.arguments, Data.of(given))

    with reading(), command.training() as train_in_zoo:
        yield make


def serve(make: Train = train) -> None:
    """
    Make runs until the standard input ends.

    :param make: function that makes a run
    """
    folder = StudyFolder(sys.argv[1])
    # Only the scheduler handles the terminal's Ctrl-C.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with os.fdopen(os.dup(sys.stdout.fileno()), "w") as replies:
        nothing = os.open(os.devnull, os.O_RDWR)
        os.dup2(nothing, sys.stdout.fileno())
        os.close(nothing)
        orders: queue.Queue[dict[str, Any] | None] = queue.Queue()
        # Not sys.stdin, which cannot be closed while a thread reads it.
        orders_file = os.fdopen(os.dup(sys.stdin.fileno()), "rb")
        threading.Thread(target=_listen, args=(orders_file, orders), daemon=True).start()
        n_made = 0
        while (order := orders.get()) is not None:
            if n_made < 2:
                # Imported modules stay, including the zoo's, which the first run imports: collecting over all of them
                # after each run would take a quarter of a second.
                gc.collect()
                gc.freeze()
            n_made += 1
            runs = [Run.of_json(run) for run in order["runs"]]
            outcomes = attempt_all(folder, runs, order["options"], order["threads"], make)
            reply = [TAKEN if outcome is None else outcome._asdict() for outcome in outcomes]
            print(json.dumps(reply), file=replies, flush=True)
            if any(outcome is not None and outcome.traceback for outcome in outcomes):
                return  # a failed run leaves the process in an unknown state


def _listen(file: IO[bytes], orders: "queue.Queue[dict[str, Any] | None]") -> None:
    for line in file:
        orders.put(json.loads(line))
    orders.put(None)
    # A training finishes its current iteration and saves; anything else ends here.
    os.kill(os.getpid(), signal.SIGTERM)


def attempt_all(
    folder: StudyFolder, runs: Sequence[Run], options: list[str], threads: int, make: Train = train
) -> list[Outcome | None]:
    """
    Make runs in this process, several in lockstep; see :func:`attempt`.

    :param folder: the study's
    :param runs: some of its runs, which differ in their seeds
    :param options: options of ``sb3-sample train``
    :param threads: of this process, for the record
    :param make: function that makes a single run
    :return: outcome of each; None for runs that another process has
    :raises SystemExit: after SIGTERM, when the runs have written their checkpoints; a ``KeyboardInterrupt`` after
        SIGINT
    :raises OSError: if the folder cannot be written to, or has no locks
    """
    if len(runs) == 1:
        return [attempt(folder, runs[0], options, threads, make)]
    from sb3_sample.lockstep import Seat
    from sb3_sample.sac.many import train_together

    outcomes: dict[str, Outcome | None] = {}
    # Saved once, since each training begins while another's streams are in place.
    with training() as make, _streams_in_force() as before:

        def body(run: Run) -> None:
            outcomes[run.name] = attempt(folder, run, options, threads, make, before)

        seats = [Seat(run.title, functools.partial(body, run), folder.place(run)) for run in runs]
        try:
            train_together(seats, folder.path)
        except Exception:
            # The outcome of each run has the reason why they were not made together.
            if outcomes.keys() != {run.name for run in runs}:
                raise
    return [outcomes[run.name] for run in runs]


def attempt(
    folder: StudyFolder,
    run: Run,
    options: list[str],
    threads: int,
    make: Train = train,
    before: Sequence[int] | None = None,
) -> Outcome | None:
    """
    Make or resume a run in this process, and record its outcome.

    :param folder: the study's
    :param run: one of its runs
    :param options: options of ``sb3-sample train``
    :param threads: of this process, for the record
    :param make: makes a run
    :param before: descriptors to restore for standard output and error when it has ended; None: the current ones
    :return: its outcome; None if another process has it
    :raises SystemExit: after SIGTERM, when the run has written its checkpoint; a ``KeyboardInterrupt`` after SIGINT
    :raises OSError: if the folder cannot be written to, or has no locks
    """
    lock = folder.claim(run)
    if lock is None:
        return None
    with lock:
        lock.write(this_process())
        earlier = folder.outcome(run)
        if earlier.done:  # by another process in the meantime
            return earlier
        place, start = folder.place(run), time.monotonic()
        first = checkpointed(place)
        outcome = Outcome(False, earlier.attempts, threads=threads)
        if earlier.traceback:
            # If this attempt is interrupted, the run waits for the next one.
            folder.write_outcome(run, earlier._replace(traceback=""))
        with _printing_to(folder.output(run), before):
            try:
                make(run, place, options)
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt) or (isinstance(error, SystemExit) and error.code == TERMINATED):
                    raise
                text = traceback.format_exc()
                print(text, file=sys.stderr)
                outcome = outcome._replace(attempts=earlier.attempts + 1, traceback=text)
        gc.collect()  # networks and environments are in reference cycles
        progress = folder.progress(run)
        outcome = outcome._replace(
            done=not outcome.traceback,
            steps=progress.steps if outcome.traceback else run.steps,
            seconds=time.monotonic() - start,
            last_return=progress.last_return,
        )
        outcome = outcome._replace(steps_made=max(outcome.steps - first, 0))
        return folder.write_outcome(run, outcome)


@contextlib.contextmanager
def _streams_in_force() -> Iterator[list[int]]:
    """Copies of the current descriptors of standard output and error."""
    descriptors = [os.dup(stream.fileno()) for stream in (sys.stdout, sys.stderr)]
    try:
        yield descriptors
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


def _switch(descriptors: Sequence[int]) -> None:
    """Redirect standard output and error to descriptors."""
    for stream, descriptor in zip((sys.stdout, sys.stderr), descriptors, strict=True):
        stream.flush()
        os.dup2(descriptor, stream.fileno())


@contextlib.contextmanager
def _printing_to(path: Path, before: Sequence[int] | None = None) -> Iterator[None]:
    """
    Append the output of this process and of those that it starts to a file. Each of several trainings in lockstep has
    its own file during its turns; ``before`` are then the descriptors from before any of them began.
    """
    with contextlib.ExitStack() as stack:
        before = stack.enter_context(_streams_in_force()) if before is None else before
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        stack.callback(os.close, file)
        seat = present()
        try:
            _switch([file, file])
            if seat is not None:
                seat.on_turn = lambda: _switch([file, file])
            yield
        finally:
            if seat is not None:
                seat.on_turn = lambda: None
            _switch(before)
