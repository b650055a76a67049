"""
Make a table of the published runs of BRO at five replay ratios and five sizes, in the format of ``sb3-sample study``.

    python studies/published_grid.py bro_grid.npz grid.csv
    sb3-sample study heatmap grid.csv -x model_size -y replay_ratio --step 500k --group dmc
    python studies/published_grid.py bro_grid.npz small.csv --ratios 2 --sizes 0.55M
    sb3-sample study report runs/my_study --published small.csv
    python studies/published_grid.py bro_grid.npz sb3_sample/data/bro_grid.csv.gz --statistics

The runs are of "Compute-Optimal Scaling for Value-Based Deep RL" (value-scaling.github.io, ``dmc_bro_ablations.zip``),
gathered in one file: ``returns`` [replay ratio, size, task, seed, evaluation], labels of the axes, and ``n_runs``, how
many of the seeds are runs and not copies. The site gives no licence: the table stays where it was made; statistics over
seeds may be shown if the source is named. With ``--statistics`` the file contains the statistics that
``sb3-sample advise`` reads instead: the interquartile mean with its 95% interval by suite, replay ratio, size and
evaluation.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_sample import study
from sb3_sample.envs.suites import published_id, published_key
from sb3_sample.study.aggregate import REPS, at_steps, blocks_of, bootstrap, iqm, scored
from sb3_sample.study.table import COLUMNS, to_json


def read_grid(
    path: str | Path,
    agent: str = "BRO, published",
    ratios: Sequence[int] | None = None,
    sizes: Sequence[str] | None = None,
) -> pd.DataFrame:
    """
    :param path: of ``bro_grid.npz``
    :param agent: its name in the table
    :param ratios: replay ratios; all if None
    :param sizes: of the model; all if None
    :return: the runs, copies left out, with the arguments ``replay_ratio`` and ``model_size``
    """
    with np.load(path) as data:
        returns, n_runs, steps = data["returns"].astype(float), data["n_runs"], data["env_steps"]
        ratio, size, seeds = data["replay_ratio"].tolist(), data["size"].tolist(), data["seed"]
        keys = list(zip(data["suite"], data["task"], strict=True))
    for name, asked, known in (("ratios", ratios, ratio), ("sizes", sizes, size)):
        if unknown := set(asked or ()) - set(known):
            raise ValueError(f"{name} must be of {', '.join(map(str, known))}, not {', '.join(map(str, unknown))}")
    parts = []
    for i, j, k in np.ndindex(returns.shape[:3]):
        if ratio[i] not in (ratios or ratio) or size[j] not in (sizes or size):
            continue
        suite, task = map(str, keys[k])
        n = int(n_runs[i, j, k])
        head = {
            "agent": agent,
            "arguments": to_json({"replay_ratio": ratio[i], "model_size": size[j]}),
            "task": published_id(suite, task),
            "seed": np.repeat(seeds[:n], len(steps)),
            "step": np.tile(steps, n),
            "metric": "return" if suite == "dmc" else "success_rate",
            "value": returns[i, j, k, :n].ravel(),
        }
        parts.append(pd.DataFrame(head))
    return pd.concat(parts, ignore_index=True).astype({"seed": "Int64"})[COLUMNS]


def statistics(table: pd.DataFrame, reps: int = REPS) -> pd.DataFrame:
    """
    :param table: of :func:`read_grid`
    :param reps: bootstrap samples, which redraw the runs of each task
    :return: a row a suite, replay ratio, size and evaluation: ``suite``, ``replay_ratio``, ``model_size``,
        ``env_step``; ``iqm`` of the normalised returns or success rates, over the runs of all its tasks, with its 95%
        interval ``low`` and ``high``; ``tasks`` and ``runs``, how many it is over
    """
    found = []
    rows = scored(table)
    for (arguments, suite), part in rows.groupby(
        ["arguments", rows["task"].map(lambda task: published_key(task)[0])], sort=False
    ):
        given = json.loads(arguments)
        matrix, steps = at_steps(part, None)
        of_task = matrix.reset_index("agent", drop=True)
        values, low, high = bootstrap(iqm, blocks_of(of_task), reps, 0.95, seed=0)
        head = {
            "suite": suite, "replay_ratio": given["replay_ratio"], "model_size": given["model_size"], "env_step": steps,
        }  # fmt: skip
        tail = {"iqm": values.round(4), "low": low.round(4), "high": high.round(4)}
        size = {"tasks": of_task.index.nunique(), "runs": len(of_task)}
        found.append(pd.DataFrame(head | tail | size))
    return pd.concat(found, ignore_index=True)


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grid", type=Path, help="bro_grid.npz")
    parser.add_argument("output", type=Path, help="file to write, .csv or .parquet")
    parser.add_argument("--agent", default="BRO, published", help="name of the agent (default: BRO, published)")
    parser.add_argument("--ratios", nargs="+", type=int, help="replay ratios (default: all)")
    parser.add_argument("--sizes", nargs="+", help="sizes of the model, as 0.55M (default: all)")
    parser.add_argument("--statistics", action="store_true", help="statistics over the seeds, as .csv or .csv.gz")
    options = parser.parse_args()
    try:
        table = read_grid(options.grid, options.agent, options.ratios, options.sizes)
        if options.statistics:
            statistics(table).to_csv(options.output, index=False, compression={"method": "infer", "mtime": 0})
        else:
            study.write(table, options.output)
    except ValueError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
