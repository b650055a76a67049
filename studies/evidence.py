"""
Make the project's own evidence: the runs of the plans in studies/evidence and studies/small, in the order of the file
studies/evidence/QUEUE.

    make evidence [WORKERS=2] [THREADS=1]

A new run is made from the last commit, in a separate git worktree and environment, never from the files of the
checkout; an interrupted run resumes under the commit that it began with. All this lies in
``~/.cache/sb3_sample/evidence``, which may be removed: unfinished runs then start again. Finished runs are written to
``docs/evidence`` of the checkout: evaluations as a table (``<plan>.csv``, in the format of ``sb3-sample study table``),
and settings, commit, versions and machine of each run (``<plan>.json``).

A program ``<plan>.py`` beside the plan makes the files that its runs read, such as data sets; it is called before each
run, and makes the files that are missing.

Runs have a low priority and one thread each, unless THREADS says otherwise. On Ctrl-C and SIGTERM they save and end;
after ``kill -9`` of this program they do so by themselves. To pause a run, ``kill -STOP`` its process number, which is
printed when the run begins.
"""

import argparse
import contextlib
import fcntl
import hashlib
import json
import os
import platform
import runpy
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

CHECKOUT = Path(__file__).resolve().parents[1]
PLANS = Path(__file__).with_name("evidence")
#: Folders in the folder of the evidence: worktrees by commit, environments by lock file, studies by plan and commit.
TREES, ENVIRONMENTS, STUDIES = "trees", "environments", "studies"
#: File that marks a complete worktree.
COMPLETE = ".complete"
#: How often a failing run is tried.
ATTEMPTS = 2
#: Variable of the environment that tells a run how many threads it has.
THREADS = "OMP_NUM_THREADS"
#: Settings of a run that do not change its result.
FREE = {"checkpoint_freq", "gym_packages", "measure", "diagnostics"}


# ---------------------------------------------------------------- with the standard library: where runs are made


class Order(NamedTuple):
    """
    :param plan: name of the plan
    :param commit: commit from which the run is made
    :param folder: of the study
    :param name: of the run in it
    :param title: the run in words
    """

    plan: str
    commit: str
    folder: str
    name: str
    title: str


class Evidence:
    """
    :param root: folder of worktrees, environments and studies
    :param results: folder of the results
    :param python: interpreter of all runs, with all packages that they need; None: a separate environment
    :param threads: of each run
    """

    def __init__(self, root: Path, results: Path, python: str | None, threads: int = 1):
        self.root, self.results, self._python, self._threads = root.resolve(), results, python, threads
        self.root.mkdir(parents=True, exist_ok=True)

    def tree(self, commit: str) -> Path:
        """
        :param commit: a commit
        :return: a worktree of it
        :raises CalledProcessError: git does not have it
        """
        path = self.root / TREES / commit
        complete = path / COMPLETE
        with alone(self.root):
            if not complete.exists():
                git("worktree", "prune")
                shutil.rmtree(path, ignore_errors=True)
                git("worktree", "add", "--quiet", "--force", "--detach", str(path), commit)
                complete.touch()
        return path

    def python(self, tree: Path) -> str:
        """
        :param tree: a worktree
        :return: an interpreter with all packages that it needs
        """
        if self._python is not None:
            return self._python
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        lock = (tree / "constraints" / f"{version}.txt").read_bytes()
        place = self.root / ENVIRONMENTS / f"{version}-{hashlib.sha256(lock).hexdigest()[:12]}"
        with alone(self.root):
            if not (place / ".all").exists():
                shutil.rmtree(place, ignore_errors=True)
                command = ["make", "--silent", "-C", str(tree), f"VENV={place}", f"PYTHON={sys.executable}"]
                subprocess.run([*command, str(place / ".all")], check=True)
        return str(place / "bin" / "python")

    def process(self, commit: str, *command: str, **options: Any) -> "subprocess.Popen[str]":
        """
        :param commit: a commit
        :param command: arguments of the interpreter, in its worktree
        :param options: of ``Popen``
        :return: a process
        """
        tree = self.tree(commit)
        threads = dict.fromkeys((THREADS, "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(self._threads))
        # The checkout's variables do not apply to the worktree.
        inherited = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "MAKE"))}
        environment = {**inherited, **threads, "PYTHONPATH": str(tree)}
        return subprocess.Popen((self.python(tree), *command), cwd=tree, env=environment, text=True, **options)

    def next(self, left_out: list[str]) -> Order | None:
        """
        Record the runs that have ended and choose the next one, with the last commit's plans and package.

        :param left_out: runs that are not to be chosen, ``<plan>/<name>``
        :return: the next run; None if all are done or in progress
        :raises RuntimeError: the commit's own program fails
        """
        last = git("rev-parse", "HEAD").strip()
        words = ("next", str(self.root), str(self.results), *left_out)
        process = self.process(last, script(self.tree(last)), *words, stdout=subprocess.PIPE)
        answer, _ = process.communicate()
        if process.returncode:
            raise RuntimeError(f"studies/evidence.py next, of commit {last}: exit code {process.returncode}")
        found = json.loads(answer)
        return None if found is None else Order(**found)

    def make(self, workers: int, most: int | None) -> list[str]:
        """
        Make all runs that are not done.

        :param workers: runs at once
        :param most: how many runs; None: all
        :return: titles of the runs that have failed
        """
        running: dict[subprocess.Popen[str], Order] = {}
        failures: dict[str, int] = {}
        began = 0
        try:
            while True:
                left_out = [f"{order.plan}/{order.name}" for order in running.values()]
                left_out += [name for name, times in failures.items() if times >= ATTEMPTS]
                order = self.next(left_out)
                if order is not None and (most is None or began < most):
                    process = self._start(order)
                    running[process] = order
                    began += 1
                    print(f"began {order.title}: commit {order.commit[:12]}, process {process.pid}", flush=True)
                    if len(running) < workers:
                        continue
                if not running:
                    break
                process = ended(list(running))
                order = running.pop(process)
                if process.returncode == 0:
                    print(f"done: {order.title}", flush=True)
                else:
                    name = f"{order.plan}/{order.name}"
                    failures[name] = failures.get(name, 0) + 1
        finally:
            leave(list(running))
        return [name for name, times in failures.items() if times >= ATTEMPTS]

    def _start(self, order: Order) -> "subprocess.Popen[str]":
        # The end of the pipe tells the run that this process is gone; only this process handles the terminal's Ctrl-C.
        return self.process(
            order.commit,
            script(self.tree(order.commit)),
            "run",
            order.folder,
            order.name,
            stdin=subprocess.PIPE,
            start_new_session=True,
        )


@contextlib.contextmanager
def alone(root: Path) -> Iterator[None]:
    """
    Exclude other processes from this block with the same folder.

    :param root: folder of the evidence
    """
    with (root / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def script(tree: Path) -> str:
    """
    :param tree: a worktree
    :return: this file there
    """
    return str(tree / "studies" / "evidence.py")


def ended(processes: "list[subprocess.Popen[str]]") -> "subprocess.Popen[str]":
    """
    :param processes: at least one
    :return: the first that has ended; waits until one has
    """
    while True:
        for process in processes:
            if process.poll() is not None:
                return process
        time.sleep(0.5)


def leave(processes: "list[subprocess.Popen[str]]") -> None:
    """
    Make processes save and end; end them at once if interrupted again.

    :param processes: that make runs
    """
    try:
        for process in processes:
            assert process.stdin is not None
            process.stdin.close()
        for process in processes:
            process.wait()
    except BaseException:
        for process in processes:
            process.kill()
        raise


def git(*words: str) -> str:
    """
    :param words: of a git command, which runs in the checkout
    :return: its output
    :raises CalledProcessError: it fails
    """
    return subprocess.run(["git", *words], cwd=CHECKOUT, check=True, stdout=subprocess.PIPE, text=True).stdout


# ---------------------------------------------------------------- with the package of a worktree: done and next runs


class Found(NamedTuple):
    """
    A run of a plan that has been begun.

    :param commit: commit with which it was begun
    :param folder: of the study
    :param done: whether it has ended
    """

    commit: str
    folder: Any
    done: bool


def same(here: dict[str, Any], there: dict[str, Any]) -> bool:
    """
    :param here: a run, as JSON
    :param there: another one
    :return: whether they have the same result
    """
    return all(here.get(name) == there.get(name) for name in (here.keys() | there.keys()) - FREE)


def is_at_hand(root: Path, commit: str) -> bool:
    """
    :param root: folder of the evidence
    :param commit: a commit
    :return: whether there is a worktree of it, or git can make one
    """
    if (root / TREES / commit / COMPLETE).exists():
        return True
    command = ["git", "cat-file", "-e", f"{commit}^{{commit}}"]
    return subprocess.run(command, cwd=CHECKOUT, stderr=subprocess.DEVNULL).returncode == 0


def found(root: Path, plan: str, run: Any) -> Found | None:
    """
    :param root: folder of the evidence
    :param plan: name of a plan
    :param run: one of its runs
    :return: the attempt that has ended, else the one with the most steps; None if it was never begun
    """
    from sb3_sample.study.runs import LIST, StudyFolder

    places = []
    for path in sorted((root / STUDIES / plan).glob("*")):
        if not (path / LIST).exists():  # a process was killed while making the folder
            continue
        folder = StudyFolder(path)
        listed = {each.name: each.as_json() for each in folder.runs()}
        if run.name in listed and same(listed[run.name], run.as_json()) and folder.place(run).is_dir():
            outcome, steps = folder.outcome(run), folder.progress(run).steps
            if outcome.done or is_at_hand(root, path.name):
                places.append((outcome.done, steps, Found(path.name, folder, outcome.done)))
    return max(places, key=lambda place: place[:2])[2] if places else None


def recorded(results: Path, plan: str) -> list[dict[str, Any]]:
    """
    :param results: folder of the results
    :param plan: name of a plan
    :return: the records of its finished runs
    """
    path = results / f"{plan}.json"
    return json.loads(path.read_text()) if path.exists() else []


def queue() -> list[tuple[str, int]]:
    """
    :return: names of plans, and how many of their seeds to run, in the order of the file
    :raises ValueError: a line is something else
    """
    lines = [line.split() for line in (PLANS / "QUEUE").read_text().splitlines() if not line.startswith("#")]
    return [(name, int(seeds)) for name, seeds in lines]


def plan_file(name: str) -> Path:
    """
    :param name: of a plan
    :return: its file, in studies/evidence or else in studies/small
    """
    path = PLANS / f"{name}.yml"
    return path if path.exists() else PLANS.parent / "small" / path.name


def plan_of(name: str) -> Any:
    """
    :param name: of a plan
    :return: the plan
    """
    from sb3_sample import study

    return study.read_plan(plan_file(name))


def choose(root: Path, results: Path, left_out: list[str]) -> Order | None:
    """
    :param root: folder of the evidence
    :param results: folder of the results
    :param left_out: runs that are not to be chosen, ``<plan>/<name>``
    :return: the next run, in the study of the commit that makes it; None if all are done or in progress
    """
    from sb3_sample.study.plan import Plan
    from sb3_sample.study.runs import StudyFolder

    plans = {name: plan_of(name) for name, _ in queue()}
    for name, n_seeds in queue():
        seeds = sorted({run.seed for run in plans[name].runs})[:n_seeds]
        ended = [record["run"] for record in recorded(results, name)]
        for run in plans[name].runs:
            if run.seed not in seeds or f"{name}/{run.name}" in left_out:
                continue
            if any(same(run.as_json(), there) for there in ended):
                continue
            here = found(root, name, run)
            if here is None:
                last = Path(__file__).resolve().parents[1].name
                here = Found(last, StudyFolder(root / STUDIES / name / last), False)
                here.folder.enter(Plan(name, (run,)), keep=True)
            if not here.done and not here.folder.is_claimed(run):
                return Order(name, here.commit, str(here.folder.path), run.name, run.title)
    return None


def collect(root: Path, results: Path) -> None:
    """
    Record the runs that have ended and are not recorded yet.

    :param root: folder of the evidence
    :param results: folder of the results
    """
    import pandas as pd

    from sb3_sample import study
    from sb3_sample.saving.temporary import becoming
    from sb3_sample.saving.training_state import processor
    from sb3_sample.study.reporting.reading import made_with
    from sb3_sample.study.table import RUN

    for name in dict.fromkeys(name for name, _ in queue()):
        records = recorded(results, name)
        path = results / f"{name}.csv"
        table = study.load(path) if path.exists() else None
        before = len(records)
        for run in plan_of(name).runs:
            here = found(root, name, run)
            if here is None or not here.done or any(same(run.as_json(), record["run"]) for record in records):
                continue
            outcome = here.folder.outcome(run)
            records.append(
                {
                    "run": run.as_json(),
                    **made_with(here.folder.place(run)),
                    "commit": here.commit,
                    "python": platform.python_version(),
                    "processor": processor(),
                    "threads": outcome.threads,
                }
            )
            rows = study.read(f"{run.agent}={here.folder.place(run)}")
            if table is not None:
                # Rows of a run without a record: the process was killed after writing the table.
                table = table[~table.set_index(RUN).index.isin(rows.set_index(RUN).index)]
            table = rows if table is None else pd.concat([table, rows], ignore_index=True)
        if table is not None and len(records) > before:
            results.mkdir(parents=True, exist_ok=True)
            # The records come last, so that every recorded run is in the table.
            with becoming(path) as file:
                file.write(table.to_csv(index=False).encode())
            with becoming(results / f"{name}.json") as file:
                file.write((json.dumps(records, indent=1) + "\n").encode())


def prepare(plan: str) -> None:
    """
    Make the files that the runs of a plan read, such as data sets, by the program of the same name beside it, if there
    is one.

    :param plan: its name
    """
    program = PLANS / f"{plan}.py"
    if program.exists():
        runpy.run_path(str(program))["main"]([])


def run(folder: str, name: str) -> None:
    """
    Make or resume a run, until this process gets a signal to end or its standard input ends.

    :param folder: of the study
    :param name: of the run in it
    """
    from sb3_sample.study.runs import StudyFolder
    from sb3_sample.study.worker import attempt

    def listen() -> None:
        while os.read(0, 1):  # not sys.stdin, which cannot be closed while a thread reads it
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    os.nice(10)
    threading.Thread(target=listen, daemon=True).start()
    place = StudyFolder(folder)
    prepare(place.path.parent.name)
    (chosen,) = (each for each in place.runs() if each.name == name)
    threads = int(os.environ[THREADS])
    outcome = attempt(place, chosen, ["--num-threads", str(threads), "--device", "cpu"], threads=threads)
    if outcome is not None and outcome.traceback:
        print(f"failed: {chosen.title}\n{outcome.traceback}", file=sys.stderr)
        raise SystemExit(1)


def main() -> None:
    """Answer a request of another process, or make the evidence."""
    if sys.argv[1:2] == ["run"]:
        return run(*sys.argv[2:])
    if sys.argv[1:2] == ["next"]:
        root, results = map(Path, sys.argv[2:4])
        with alone(root):  # results are read, extended and written
            collect(root, results)
            order = choose(root, results, sys.argv[4:])
        return print(json.dumps(None if order is None else order._asdict()))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="runs at once (default: 1)")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="of each run (default: 1)")
    parser.add_argument("--most", type=int, metavar="N", help="how many runs to make or to go on with (default: all)")
    parser.add_argument("--root", type=Path, default=Path("~/.cache/sb3_sample/evidence").expanduser())
    parser.add_argument("--results", type=Path, default=CHECKOUT / "docs" / "evidence")
    parser.add_argument(
        "--python", help="interpreter that has all that is needed, instead of an environment of its own"
    )
    options = parser.parse_args()
    for name in ("workers", "threads", "most"):
        value = getattr(options, name)
        if value is not None and value < 1:
            parser.error(f"--{name} must be at least 1, not {value}")
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    evidence = Evidence(options.root, options.results.resolve(), options.python, options.threads)
    if failed := evidence.make(options.workers, options.most):
        sys.exit("failed: " + ", ".join(failed))


if __name__ == "__main__":
    main()
