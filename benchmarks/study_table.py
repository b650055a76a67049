"""
Cost of a table of many runs: reading their folders, and the averages over tasks and seeds with intervals.

    python benchmarks/study_table.py [--runs 1000] [--evaluations 100] [--folder /tmp/study_table]

The folders are as ``sb3-sample train --run-dir`` leaves them: a record, evaluations of five episodes, a Monitor file,
and a log with a line every 4,000 steps. Reads from the page cache; imports apart. Seconds of this process, and of the
clock.
"""

import argparse
import contextlib
import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rliable.library  # noqa: F401  # before the clock

from sb3_sample import study
from sb3_sample.envs.suites import BRO

SEEDS = 10


def write_run(folder: Path, task: str, agent: int, seed: int, evaluations: int, rng: np.random.Generator) -> None:
    """A run of ``evaluations`` times 25,000 steps."""
    (folder / "checkpoint-000000000000").mkdir(parents=True)
    settings = {
        "algo": "bro",
        "env": task,
        "seed": seed,
        "env_kwargs": None,
        "replay_ratio": agent,
        "policy": "MlpPolicy",
    }
    record = {"algo": "bro", "env": task, "seed": seed, "n_timesteps": -1, "checkpoint_freq": 10_000}
    record |= {"settings": {name: repr(value) for name, value in settings.items()}, "tensorboard": None}
    (folder / "run.json").write_text(json.dumps(record))
    steps = 25_000 * np.arange(1, evaluations + 1)
    success = rng.integers(0, 2, (evaluations, 5)).astype(bool)
    arrays = {} if task.startswith("dmc/") else {"successes": success}
    np.savez(
        folder / "evaluations.npz",
        timesteps=steps,
        results=rng.random((evaluations, 5)) * 1_000,
        ep_lengths=np.full((evaluations, 5), 1_000),
        **arrays,  # type: ignore[arg-type]
    )
    n_episodes = int(steps[-1]) // 1_000
    rows = "".join(f"{100 * i / n_episodes:.3f},1000,{2 * i:.3f}\n" for i in range(1, n_episodes + 1))
    (folder / "0.monitor.csv").write_text(f'#{{"t_start": 0.0, "env_id": "{task}"}}\nr,l,t\n{rows}')
    names = [f"train/metric_{i}" for i in range(25)]
    lines = [
        {"step": step, "time/time_elapsed": step // 500, **dict.fromkeys(names, 0.123456789)}
        for step in range(4_000, int(steps[-1]) + 1, 4_000)
    ]
    (folder / "progress.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


@contextlib.contextmanager
def timed(words: str) -> Iterator[None]:
    """Print the seconds of a piece of work."""
    busy, start = time.process_time(), time.perf_counter()
    yield
    print(f"{words}: {time.process_time() - busy:.1f} s of the processor, {time.perf_counter() - start:.1f} s")


def main() -> None:
    """Write the folders, read them, average them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1_000)
    parser.add_argument("--evaluations", type=int, default=100)
    parser.add_argument("--folder", type=Path, default=Path("/tmp/study_table"))
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    shutil.rmtree(options.folder, ignore_errors=True)
    for i in range(options.runs):
        agent, task, seed = i // (len(BRO) * SEEDS), BRO[i // SEEDS % len(BRO)], i % SEEDS
        write_run(options.folder / f"a{agent}" / str(i), task, agent, seed, options.evaluations, rng)

    with timed(f"table of {options.runs:,} runs x {options.evaluations} evaluations"):
        table = study.read([f"agent {path.name}={path}" for path in sorted(options.folder.iterdir())])
    print(f"{len(table):,} rows")
    with timed("written and read back as .csv"):
        study.write(table, options.folder / "table.csv")
        study.load(options.folder / "table.csv")
    with timed("IQM, mean, median, optimality gap at four steps, 2,000 bootstrap samples"):
        study.aggregate(table, [100_000, 200_000, 500_000, 1_000_000])
    shutil.rmtree(options.folder)


if __name__ == "__main__":
    main()
