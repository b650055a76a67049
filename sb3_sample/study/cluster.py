"""
Runs of a study as tasks of a Ray cluster: a run is a task with its cores or its share of a GPU, in a separate process,
on any machine that has room. Its folder, which all machines see, is its checkpoint, and the process that makes it holds
its lock, as without Ray.
"""

import contextlib
import dataclasses
import importlib.util
import math
import os
import queue
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sb3_sample.extras import install
from sb3_sample.kinds import check_value, number
from sb3_sample.replay.reading import HDF5
from sb3_sample.study.cores import free_cores, threads_of_libraries
from sb3_sample.study.plan import Run
from sb3_sample.study.runs import LIST, Outcome, StudyError, StudyFolder
from sb3_sample.study.worker import TAKEN, TERMINATED, attempt_all

#: Seconds between two checks of the number of machines.
LOOK_EVERY = 2.0
#: Bytes of a local cluster's object store; tasks pass only a few kilobytes.
OBJECT_STORE = 100_000_000
#: Values of ``ray=`` besides an address.
LOCAL, AUTO = "local", "auto"
#: GPUs of a run.
GPUS = number("be above 0, and whole above 1", lambda share: 0 < share <= 1 or (share > 1 and share == int(share)))


def check(address: str, gpus: float | None) -> None:
    """
    :param address: of a cluster, see :class:`Cluster`
    :param gpus: of a run
    :raises ValueError: an argument is out of range
    :raises ImportError: Ray is not installed
    """
    if not isinstance(address, str) or not address:
        raise ValueError(f"ray must be {LOCAL!r}, {AUTO!r} or a cluster's address, not {address!r}")
    check_value("gpus", gpus, GPUS.or_none())
    if importlib.util.find_spec("ray") is None:
        raise ImportError(f"ray={address!r} needs Ray. Install it with: {install('cluster')}")


class Cluster:
    """
    Ray cluster for the runs of a study. If it was started or connected to here, it is left at the end of the ``with``.

    :param address: ``"local"`` for a cluster on this machine; ``"auto"`` for the cluster of this machine; else an
        address, as for ``ray.init``
    :param folder: the study's folder, which all machines of the cluster have under the same path
    :param workers: runs at once; if None, as many as the machines of the cluster have room for at the moment
    :param threads: cores of a run
    :param gpus: GPUs of a run, or its share of one; None for none
    """

    def __init__(self, address: str, folder: Path, workers: int | None, threads: int, gpus: float | None):
        self._address, self._folder, self._workers = address, folder.absolute(), workers
        self._threads, self._gpus = threads, gpus
        self._room, self._looked = 0, -math.inf
        self._entered = False

    def __enter__(self) -> "Cluster":
        """
        :raises StudyError: there is no such cluster, or it has no room for a run
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        with _keeping_sigterm():
            import ray

            if not ray.is_initialized():
                try:
                    ray.init(**self._options())
                except (ConnectionError, ValueError, RuntimeError) as error:
                    raise StudyError(f"ray={self._address!r} cannot be connected to: {error}") from error
                self._entered = True
        self._task = ray.remote(
            num_cpus=self._threads,
            num_gpus=self._gpus or 0,
            # A process for each run, with its own imports and threads; the scheduler handles its death.
            max_calls=1,
            max_retries=0,
            runtime_env={"env_vars": threads_of_libraries(self._threads)},
        )(make)
        if not self.slots():
            wanted = _words(CPU=self._threads, GPU=self._gpus or 0)
            there = "; ".join(_words(**each) for each in _machines()) or "no machine"
            self.__exit__()
            raise StudyError(
                f"ray={self._address!r} has no room for a run with {wanted}: it has {there}. A cluster that grows when "
                "it is asked to needs workers=, the number of runs at once"
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._entered:
            import ray

            ray.shutdown()

    def _options(self) -> dict[str, Any]:
        if self._address != LOCAL:
            return {"address": self._address, "log_to_driver": False}
        return {
            "address": LOCAL,
            "num_cpus": self._threads * (self._workers or max(free_cores() // self._threads, 1)),
            "object_store_memory": OBJECT_STORE,
            "include_dashboard": False,
            "log_to_driver": False,
        }

    def slots(self) -> int:
        """
        :return: runs at once
        """
        if self._workers is not None:
            return self._workers
        if (now := time.monotonic()) - self._looked > LOOK_EVERY:
            self._looked = now
            gpus = self._gpus
            self._room = sum(
                int(min(each["CPU"] / self._threads, math.inf if gpus is None else each["GPU"] / gpus))
                for each in _machines()
            )
        return self._room

    def hire(self, events: "queue.Queue[tuple[Any, Any]]") -> "Slot":
        """
        :param events: queue for the answers
        :return: a place for one run at a time
        """
        return Slot(self._task, str(self._folder), events)


class Slot:
    """
    Place for one run at a time in a cluster, or for several together, the counterpart of a worker on this machine.

    :param task: Ray's remote function that makes runs
    :param folder: the study's
    :param events: queue for the answers, or None if a process has ended without one, each with the slot
    """

    def __init__(self, task: Any, folder: str, events: "queue.Queue[tuple[Any, Any]]"):
        self.runs: tuple[Run, ...] = ()
        self.kind = ""
        self._task, self._folder, self._events = task, folder, events
        self._order: Any = None
        self._listener: threading.Thread | None = None
        self._why = ""

    def give(self, runs: tuple[Run, ...], options: list[str], threads: int) -> None:
        """
        :param runs: runs to make
        :param options: options of ``sb3-sample train``
        :param threads: of the task
        """
        self.runs, self.kind = runs, runs[0].kind
        orders = [_with_absolute_paths(run).as_json() for run in runs]
        self._order = self._task.remote(self._folder, orders, options, threads)
        self._listener = threading.Thread(target=self._listen, args=(self._order,), daemon=True)
        self._listener.start()

    def _listen(self, order: Any) -> None:
        import ray

        n = len(self.runs)

        answer = None
        try:
            answer = ray.get(order)
        except ray.exceptions.NodeDiedError:
            answer = [TAKEN] * n  # not the runs' fault: they resume elsewhere when their locks are free
        except Exception as error:
            self._why = f"the process that made the run has ended: {error}"
        self._events.put((self, answer))

    def leave(self) -> None:
        """End the current run after saving its training."""
        self._cancel(force=False)

    def kill(self) -> None:
        """End the current run at once."""
        self._cancel(force=True)

    def _cancel(self, force: bool) -> None:
        import ray

        if self.runs:
            ray.cancel(self._order, force=force)

    def wait(self) -> None:
        """Wait until the current run has ended, if there is one."""
        if self._listener is not None:
            self._listener.join()

    def why_ended(self) -> str:
        """
        :return: the reason why there was no answer, in words
        """
        return self._why


def make(folder: str, runs: list[dict[str, Any]], options: list[str], threads: int) -> list[dict[str, Any]]:
    """
    Make a run, or several together, in a process of the cluster. On Ray's cancel and SIGTERM a training finishes its
    current iteration and saves.

    :param folder: the study's
    :param runs: the runs, as JSON
    :param options: options of ``sb3-sample train``
    :param threads: of the process
    :return: outcome of each run, or that it has to be looked at again
    :raises FileNotFoundError: this machine does not see the folder
    """
    if not (Path(folder) / LIST).is_file():
        raise FileNotFoundError(
            f"{socket.gethostname()} does not see {folder}: the study's folder must be one that all machines of the "
            "cluster have under the same path"
        )
    outcomes: list[Outcome | None] = [None] * len(runs)
    # Replaces Ray's handler, whose exception an attempt would take for a failure of the run.
    signal.signal(signal.SIGTERM, _terminate)
    with contextlib.suppress(KeyboardInterrupt, SystemExit):
        outcomes = attempt_all(StudyFolder(folder), [Run.of_json(run) for run in runs], options, threads)
    return [TAKEN if outcome is None else outcome._asdict() for outcome in outcomes]


def _with_absolute_paths(run: Run) -> Run:
    """A run with absolute paths of its data sets, since a process of Ray has another working directory."""

    def absolute(value: Any) -> Any:
        is_path = isinstance(value, str) and (Path(value).suffix in HDF5 or Path(value).exists())
        # Each machine has its own home; an id of Minari is not a path.
        return str(Path(value).absolute()) if is_path and not value.startswith("~") else value

    return dataclasses.replace(run, data={name: absolute(value) for name, value in run.data.items()})


def _terminate(number: int, frame: Any) -> None:
    raise SystemExit(TERMINATED)


def _machines() -> list[dict[str, float]]:
    """Cores and GPUs of the cluster's machines."""
    import ray

    return [{name: each["Resources"].get(name, 0) for name in ("CPU", "GPU")} for each in ray.nodes() if each["Alive"]]


def _words(CPU: float, GPU: float) -> str:
    return f"{CPU:g} cores" + (f" and {GPU:g} GPUs" if GPU else "")


@contextlib.contextmanager
def _keeping_sigterm() -> Iterator[None]:
    """Restore the scheduler's handler of SIGTERM, which Ray's import and start replace."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
