"""
Cost of fitting the scaling laws: 40 tasks, 25 configurations each, ten seeds, with bootstrap intervals.

    python benchmarks/scaling_fit.py [--tasks 40] [--seeds 10] [--evaluations 40] [--reps 100]

Five replay ratios, five batch sizes, ten levels; K = 100 draws of the best batch size, again for each bootstrap sample.
Prints seconds of this process and of the clock.
"""

import argparse
import time

import numpy as np
import pandas as pd

from sb3_sample.envs.suites import BRO
from sb3_sample.study import scaling
from sb3_sample.study.table import COLUMNS, to_json


def made_up(tasks: int, seeds: int, evaluations: int) -> pd.DataFrame:
    """The table."""
    rng = np.random.default_rng(0)
    metric = {True: "return", False: "success_rate"}
    parts = []
    for task in BRO[:tasks]:
        d_min = 1e5 * np.exp(rng.normal(0, 0.3))
        steps = np.tile((d_min * 6 / evaluations * np.arange(1, evaluations + 1)).astype(int), seeds)
        for ratio in (1, 2, 4, 8, 16):
            for batch in (32, 64, 128, 256, 512):
                slower = 1 + np.log(batch / (256 * ratio**-0.5)) ** 2 / 8
                own = (
                    d_min * (1 + (1.5 / ratio) ** 0.8) * slower * np.exp(rng.normal(0, 0.1, seeds)).repeat(evaluations)
                )
                values = 1 - 0.3 ** (steps / own) + rng.normal(0, 0.02, len(steps))
                of_dmc = task.startswith("dmc/")
                head = {"agent": "made up", "task": task, "seed": np.arange(seeds).repeat(evaluations), "step": steps}
                head["arguments"] = to_json({"replay_ratio": ratio, "batch_size": batch, "model_size": "0.55M"})
                values = values * 1_000 if of_dmc else values
                parts.append(pd.DataFrame({**head, "metric": metric[of_dmc], "value": values}))
    return pd.concat(parts, ignore_index=True).astype({"seed": "Int64"})[COLUMNS]


def main() -> None:
    """Make the table, fit it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", type=int, default=40)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--evaluations", type=int, default=40)
    parser.add_argument("--reps", type=int, default=100, help="bootstrap samples")
    options = parser.parse_args()
    table = made_up(options.tasks, options.seeds, options.evaluations)
    print(f"{len(table):,} rows")
    busy, start = time.process_time(), time.perf_counter()
    laws = scaling.fit(table, reps=options.reps)
    scaling.summary(laws)
    print(f"{time.process_time() - busy:.1f} s of the processor, {time.perf_counter() - start:.1f} s")
    print(f"batch size: slope {laws.interval(laws.hyperparameters['batch_size'].slopes)}, -0.5 in the runs")
    print(f"alpha at {laws.levels[-1].level:g}: {laws.interval([law.alpha for law in laws.levels[-1].laws])}, 0.8")


if __name__ == "__main__":
    main()
