"""
What 1,000,000 transitions of dog-run (observation 223, action 38, episodes of 1,000 steps) take, and cost.

    OMP_NUM_THREADS=1 python benchmarks/replay_memory.py [--transitions 1000000] [--folder /var/tmp/replay]

Each buffer is filled in a process of its own, beyond its capacity. "own memory" is what the process gained that cannot
be evicted (RssAnon); "of files", what of its files lies in memory at the end, which the system evicts where it needs
the space (RssFile). "batch" is what a gradient step's batch of 256 takes, 20 of them drawn at once: by ``BatchMemory``
where it serves the buffer, by the buffer's own ``sample`` elsewhere.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_sample import CompactReplayBuffer
from sb3_sample.sac.batch import draw_batches
from sb3_sample.sac.buffers import BatchMemory

OBSERVATION, ACTION, EPISODE, BATCHES, BATCH = 223, 38, 1_000, 20, 256

BUFFERS: dict[str, tuple[type[ReplayBuffer], dict[str, Any]]] = {
    "stable_baselines3": (ReplayBuffer, {}),
    "stable_baselines3, optimize_memory_usage": (
        ReplayBuffer,
        {"optimize_memory_usage": True, "handle_timeout_termination": False},
    ),
    "sb3_sample": (CompactReplayBuffer, {}),
    "sb3_sample, memory_map": (CompactReplayBuffer, {"memory_map": None}),
}


def resident() -> tuple[int, int]:
    """Bytes of the process in memory: its own, and of files."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    own, of_files = (1024 * int(lines[name].split()[0]) for name in ("RssAnon", "RssFile"))
    return own, of_files


def measure(name: str, n: int, folder: str) -> dict[str, float]:
    cls, kwargs = BUFFERS[name]
    if "memory_map" in kwargs:
        kwargs = {"memory_map": folder}
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    np.random.seed(0)  # noqa: NPY002  # the buffers draw from it
    rows = rng.normal(size=(4_999, 1, OBSERVATION)).astype(np.float32)
    action, reward, infos = rng.uniform(-1, 1, (1, ACTION)).astype(np.float32), np.ones(1), [{}]
    start = resident()
    box = spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float32)
    buffer = cls(n, box, spaces.Box(-1, 1, (ACTION,), np.float32), device="cpu", **kwargs)
    now = rows[0]
    begun = time.perf_counter()
    for step in range(n + n // 10):
        ends = step % EPISODE == EPISODE - 1
        after = rows[(step + 1) % len(rows)]
        buffer.add(now, after, action, reward, np.array([ends]), infos)
        now = rows[(step * 7) % len(rows)] if ends else after
    added = time.perf_counter() - begun
    memory, taken = BatchMemory(), []
    for _ in range(101):
        begun = time.perf_counter()
        draw_batches(buffer, BATCHES, BATCH, 0.99, None, memory)
        taken.append(time.perf_counter() - begun)
    own, of_files = (end - before for end, before in zip(resident(), start, strict=True))
    return {
        "own memory, MB": own / 1e6,
        "of files, MB": of_files / 1e6,
        "add, µs": 1e6 * added / (n + n // 10),
        "batch, µs": 1e6 * float(np.median(taken[1:])) / BATCHES,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--transitions", type=int, default=1_000_000)
    parser.add_argument("--folder", help="where the mapped buffer's files are made; a temporary folder if left out")
    parser.add_argument("--only", choices=BUFFERS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.only is not None:
        print(json.dumps(measure(args.only, args.transitions, args.folder)))
        return
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        head = True
        for name in BUFFERS:
            command = [sys.executable, __file__, "--transitions", str(args.transitions), "--folder", folder]
            output = subprocess.run([*command, "--only", name], check=True, capture_output=True, text=True).stdout
            figures = json.loads(output.splitlines()[-1])
            if head:
                print("| buffer | " + " | ".join(figures) + " |\n| --- |" + " ---: |" * len(figures))
                head = False
            print(f"| {name} | " + " | ".join(f"{value:,.1f}" for value in figures.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
