"""
A process that makes runs of an agent that does nothing on a task that does nothing, as the scheduler's ``worker``.

What it is to do beside that stands in the arguments of a run: "fail" and "die", how many attempts end so, and "sleep",
seconds. Each attempt is a line in ``made.txt`` of the study's folder, when it begins and when it ends; the files that
it opens and the locks that it takes for the study are counted in ``work.txt``.
"""

import os
import signal
import sys
import time
from collections import Counter
from pathlib import Path

from sb3_sample.study.plan import Plan, Run
from sb3_sample.study.worker import serve

COMMAND = (sys.executable, __file__)


def plan(n_seeds: int, **arguments: object) -> Plan:
    """A plan with a number of runs that differ in their seed alone."""
    return Plan("nothing", tuple(Run("Nothing", "nothing", arguments, {}, "nothing-v0", i, 1) for i in range(n_seeds)))


def count_work(folder: Path) -> Counter[str]:
    """Counts of what this process opens below a folder and locks anywhere, from now on."""
    counts: Counter[str] = Counter()

    def hear(event: str, args: tuple[object, ...]) -> None:
        if event == "open" and isinstance(args[0], str) and args[0].startswith(str(folder)):
            counts["opened"] += 1
        elif event in ("fcntl.flock", "os.listdir"):
            counts[event] += 1

    sys.addaudithook(hear)
    return counts


def append(path: Path, line: str) -> None:
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.write(file, f"{line}\n".encode())
    os.close(file)


def make(run: Run, folder: Path, options: list[str]) -> None:
    log = Path(sys.argv[1]) / "made.txt"
    before = log.read_text().splitlines().count(f"begin {run.name}") if run.arguments else 0
    append(log, f"begin {run.name}")
    folder.mkdir(parents=True, exist_ok=True)
    time.sleep(run.arguments.get("sleep", 0))
    if before < run.arguments.get("die", 0):
        os.kill(os.getpid(), signal.SIGKILL)
    if before < run.arguments.get("fail", 0):
        raise RuntimeError(f"nothing comes of seed {run.seed}")
    append(log, f"end {run.name}")


if __name__ == "__main__":
    (Path(sys.argv[1]) / "made.txt").touch()
    counts = count_work(Path(sys.argv[1]))

    def make_and_count(run: Run, folder: Path, options: list[str]) -> None:
        make(run, folder, options)
        append(Path(sys.argv[1]) / "work.txt", repr(dict(counts)))

    serve(make_and_count)
