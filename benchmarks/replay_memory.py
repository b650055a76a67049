"""
Memory and time of replay buffers, with the sizes of dog-run: observation 223, action 38, episodes of 1,000 steps.

    python benchmarks/replay_memory.py [--transitions 1000000] [--folder .]

Each buffer is filled beyond its capacity, in a process of its own. "memory" is what the process then has resident of
its own (RssAnon), less what it had before; "of files" the same of files (RssFile), which the system takes back when it
needs the space. "add" is one step of one environment, in the fastest of all runs of 1,000; "batch" a gradient step's
batch of 256 when 20 are drawn at once, as the algorithms do, the fastest of 200: so other programs on the machine count
as little as possible.
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
from sb3_sample.replay.buffers import BatchMemory
from sb3_sample.replay.sources import draw_batches

OBSERVATION, ACTION, EPISODE, BATCHES, BATCH, ROUNDS = 223, 38, 1_000, 20, 256, 200

BUFFERS: dict[str, tuple[type[ReplayBuffer], dict[str, Any]]] = {
    "stable_baselines3": (ReplayBuffer, {}),
    "stable_baselines3, optimize_memory_usage=True": (
        ReplayBuffer,
        {"optimize_memory_usage": True, "handle_timeout_termination": False},
    ),
    "sb3_sample": (CompactReplayBuffer, {}),
    "sb3_sample, memory_map": (CompactReplayBuffer, {"memory_map": ...}),
}


def resident() -> np.ndarray:
    """
    :return: bytes of this process in memory: of its own, of files
    """
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return np.array([1024 * int(lines[name].split()[0]) for name in ("RssAnon", "RssFile")])


def measure(name: str, n: int, folder: str) -> dict[str, float]:
    """
    :param name: which buffer
    :param n: its capacity
    :param folder: where files are
    :return: the table's row
    """
    cls, kwargs = BUFFERS[name]
    if "memory_map" in kwargs:
        kwargs = {"memory_map": folder}
    torch.set_num_threads(1)
    np.random.seed(0)  # noqa: NPY002  # the buffers draw from it
    rng = np.random.default_rng(0)
    # More than the processor keeps near itself, and no multiple of the episode's length.
    observations = rng.normal(size=(20_011, 1, OBSERVATION)).astype(np.float32)
    action, reward, infos = rng.uniform(-1, 1, (1, ACTION)).astype(np.float32), np.ones(1), [{}]
    before = resident()
    box = spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float32)
    buffer = cls(n, box, spaces.Box(-1, 1, (ACTION,), np.float32), device="cpu", **kwargs)
    now, adding = observations[0], np.zeros((n + n // 10) // EPISODE)
    for step in range(len(adding) * EPISODE):
        ends = step % EPISODE == EPISODE - 1
        after, done = observations[(step + 1) % len(observations)], np.array([ends])
        begun = time.perf_counter()
        buffer.add(now, after, action, reward, done, infos)
        adding[step // EPISODE] += time.perf_counter() - begun
        now = observations[(7 * step) % len(observations)] if ends else after
    own, of_files = resident() - before
    memory, drawing = BatchMemory(), []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        draw_batches(buffer, BATCHES, BATCH, 0.99, None, memory)
        drawing.append(time.perf_counter() - begun)
    return {
        "memory, MB": own / 1e6,
        "of files, MB": of_files / 1e6,
        "add, µs": 1e6 * adding.min() / EPISODE,
        "batch, µs": 1e6 * min(drawing) / BATCHES,
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--transitions", type=int, default=1_000_000, help="capacity of the buffers")
    parser.add_argument("--folder", default=".", help="on the disk that takes the mapped buffer")
    parser.add_argument("--only", choices=BUFFERS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.only is not None:
        print(json.dumps(measure(args.only, args.transitions, args.folder)))
        return
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        for number, name in enumerate(BUFFERS):
            command = [sys.executable, __file__, "--transitions", str(args.transitions), "--folder", folder]
            output = subprocess.run([*command, "--only", name], check=True, stdout=subprocess.PIPE, text=True).stdout
            row = json.loads(output.splitlines()[-1])
            if number == 0:
                print(f"| | {' | '.join(row)} |\n| --- |{' ---: |' * len(row)}")
            print(f"| {name} | {' | '.join(f'{value:,.1f}' for value in row.values())} |", flush=True)


if __name__ == "__main__":
    main()
