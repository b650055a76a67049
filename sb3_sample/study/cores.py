"""Cores of this machine, and threads of libraries."""

import contextlib
import os
import time
from pathlib import Path

#: Variables that libraries take their number of threads from.
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
#: Number of seconds for which idle cores are counted.
_LOOK = 0.3


def threads_of_libraries(threads: int) -> dict[str, str]:
    """
    :param threads: of a process
    :return: the variables of its environment that libraries take their number of threads from
    """
    return dict.fromkeys(_THREADS, str(threads))


def free_cores() -> int:
    """
    :return: number of cores that this process may use and that are idle, at least 1
    """
    return max(round(idle_cores()), 1)


def idle_cores() -> float:
    """
    :return: number of cores that this process may use and that are idle, including fractions; all that it may use if
        the system does not tell
    """
    usable = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))
    free = float(len(usable))
    with contextlib.suppress(OSError, ValueError):
        before = _idle(usable)
        time.sleep(_LOOK)
        after = _idle(usable)
        free = sum((after[core][0] - before[core][0]) / max(after[core][1] - before[core][1], 1) for core in after)
    with contextlib.suppress(OSError, ValueError):
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        free = min(free, int(quota) / int(period))  # "max" raises a ValueError
    return free


def _idle(usable: set[int]) -> dict[int, tuple[int, int]]:
    """Idle ticks and all ticks by core (Linux)."""
    found = {}
    for line in Path("/proc/stat").read_text().splitlines():
        name, *ticks = line.split()
        core = name.removeprefix("cpu")
        if name.startswith("cpu") and core.isdigit() and int(core) in usable:
            numbers = [int(tick) for tick in ticks[:8]]
            found[int(core)] = (numbers[3] + numbers[4], sum(numbers))
    if not found:
        raise ValueError("no cores")
    return found
