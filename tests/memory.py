"""Peak of this process's memory."""

import contextlib
import resource
from pathlib import Path


def peak() -> int:
    """
    Bytes that were in memory at most, since ``forget_peak`` where Linux has it, else since the start. Linux passes
    ``ru_maxrss`` on from a process to the programs it starts.
    """
    try:
        status = Path("/proc/self/status").read_text()
        return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) * 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def forget_peak() -> None:
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
