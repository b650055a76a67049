"""
A table of the published runs of BRO at five replay ratios and five sizes, as ``sb3-sample study`` takes it.

    python studies/published_grid.py bro_grid.npz grid.csv
    sb3-sample study heatmap grid.csv -x model_size -y replay_ratio --step 500k --group dmc

The runs are of "Compute-Optimal Scaling for Value-Based Deep RL" (value-scaling.github.io, ``dmc_bro_ablations.zip``),
gathered in one file: ``returns`` [replay ratio, size, task, seed, evaluation], labels of the axes, and ``n_runs``, how
many of the seeds are runs and not copies. The site gives no licence: the table stays where it was made, statistics over
the seeds may be shown with their source named.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_sample import study
from sb3_sample.envs.suites import published_id
from sb3_sample.study.table import COLUMNS, to_json


def read_grid(path: str | Path, agent: str = "BRO, published") -> pd.DataFrame:
    """
    :param path: of ``bro_grid.npz``
    :param agent: its name in the table
    :return: the runs, copies left out, with the arguments ``replay_ratio`` and ``model_size``
    """
    with np.load(path) as data:
        returns, n_runs, steps = data["returns"].astype(float), data["n_runs"], data["env_steps"]
        ratios, sizes, seeds = data["replay_ratio"], data["size"], data["seed"]
        keys = list(zip(data["suite"], data["task"], strict=True))
    parts = []
    for i, j, k in np.ndindex(returns.shape[:3]):
        suite, task = map(str, keys[k])
        n = int(n_runs[i, j, k])
        head = {
            "agent": agent,
            "arguments": to_json({"replay_ratio": int(ratios[i]), "model_size": str(sizes[j])}),
            "task": published_id(suite, task),
            "seed": np.repeat(seeds[:n], len(steps)),
            "step": np.tile(steps, n),
            "metric": "return" if suite == "dmc" else "success_rate",
            "value": returns[i, j, k, :n].ravel(),
        }
        parts.append(pd.DataFrame(head))
    return pd.concat(parts, ignore_index=True).astype({"seed": "Int64"})[COLUMNS]


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grid", type=Path, help="bro_grid.npz")
    parser.add_argument("output", type=Path, help=".csv or .parquet")
    parser.add_argument("--agent", default="BRO, published", help="name of the agent (default: BRO, published)")
    options = parser.parse_args()
    study.write(read_grid(options.grid, options.agent), options.output)


if __name__ == "__main__":
    main()
