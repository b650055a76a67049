"""
Do two sets of runs differ at a step? The Mann-Whitney test on each task, and all tasks together by Fisher's method.

    python studies/published_grid.py bro_grid.npz published.csv --ratios 2 --sizes 0.55M
    python studies/rank_tests.py docs/evidence/bro_fast_seeds.csv published.csv --step 50k

Both tables are as ``sb3-sample study table`` writes them, with one agent each. Printed: seeds, means and ranges of
both, and p of the first table's returns being lower (one-sided) and of the two being unlike (two-sided), exact where no
returns are equal. Tasks that only one table has are left out, and named.
"""

import argparse
from pathlib import Path

import pandas as pd
from scipy import stats

from sb3_sample import study
from sb3_sample.study.analysis_command import steps_of


def rank_tests(ours: pd.DataFrame, others: pd.DataFrame, step: int, metric: str = "return") -> pd.DataFrame:
    """
    :param ours: a table of runs of one agent
    :param others: the same of another
    :param step: of the simulator, at which both were evaluated
    :param metric: what is compared
    :return: a row a task and one of all, ``task`` then being "all": ``n``, ``mean``, ``low``, ``high`` (range) of the
        first and with ``_others`` of the second, ``p_lower`` (one-sided: the first is lower) and ``p`` (two-sided)
    :raises ValueError: a table has more than one agent, or no task was evaluated in both at that step
    """
    values = []
    for name, table in (("first", ours), ("second", others)):
        agents = table["agent"].unique()
        if len(agents) != 1:
            raise ValueError(f"the {name} table must have one agent, not {', '.join(map(str, agents)) or 'none'}")
        rows = table[(table["step"] == step) & (table["metric"] == metric)]
        values.append({str(task): group["value"].to_numpy(float) for task, group in rows.groupby("task")})
    tasks = sorted(values[0].keys() & values[1].keys())
    if not tasks:
        raise ValueError(f"no task has {metric!r} at step {step:,} in both tables")
    rows = []
    for task in tasks:
        a, b = values[0][task], values[1][task]
        row = {"task": task, "n": len(a), "mean": a.mean(), "low": a.min(), "high": a.max()}
        row |= {"n_others": len(b), "mean_others": b.mean(), "low_others": b.min(), "high_others": b.max()}
        row |= {
            name: float(stats.mannwhitneyu(a, b, alternative=side).pvalue)
            for name, side in (("p_lower", "less"), ("p", "two-sided"))
        }
        rows.append(row)
    result = pd.DataFrame(rows)
    together = {name: float(stats.combine_pvalues(result[name], method="fisher").pvalue) for name in ("p_lower", "p")}
    return pd.concat([result, pd.DataFrame([{"task": "all", **together}])], ignore_index=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ours", type=Path)
    parser.add_argument("others", type=Path)
    parser.add_argument("--step", type=steps_of, required=True)
    parser.add_argument("--metric", default="return")
    args = parser.parse_args()
    ours, others = study.load(args.ours), study.load(args.others)
    result = rank_tests(ours, others, args.step, args.metric)
    if missing := sorted(set(ours["task"]) ^ set(others["task"])):
        print("In one table only:", ", ".join(missing))
    for row in result.to_dict("records"):
        words = [
            f"  {row['n' + o]:.0f} seeds, mean {row['mean' + o]:.0f} ({row['low' + o]:.0f} to {row['high' + o]:.0f});"
            for o in ("", "_others")
            if row["task"] != "all"
        ]
        print(f"{row['task']}:{''.join(words)}  p {row['p']:.3f}, lower {row['p_lower']:.3f}")


if __name__ == "__main__":
    main()
