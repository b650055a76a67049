"""
Do two sets of runs differ at a step? The Mann-Whitney test on each task, and all tasks together by Fisher's method.

    python studies/published_grid.py bro_grid.npz published.csv --ratios 2 --sizes 0.55M
    python studies/rank_tests.py docs/evidence/bro_fast_seeds.csv published.csv --step 25k 50k

Both tables are as ``sb3-sample study table`` writes them, with one agent each. Printed are seeds, means and ranges of
both, and p-values that the first table's returns are lower (one-sided) and that the two differ (two-sided), exact if no
returns are equal. Exact p-values of few runs are coarse, and Fisher's method on them errs towards no difference. Tasks
that only one table has are left out, and named. ``evidence_pages.py`` puts such into pages.
"""

import argparse
from pathlib import Path
from typing import Any

import pandas as pd
from scipy import stats

from sb3_sample import study
from sb3_sample.study.analysis_command import steps_of


def rank_tests(ours: pd.DataFrame, others: pd.DataFrame, step: int, metric: str = "return") -> pd.DataFrame:
    """
    :param ours: a table of runs of one agent
    :param others: the same of another
    :param step: of the simulator, at which both were evaluated
    :param metric: the metric compared
    :return: a row for each task and one for all, where ``task`` is "all": ``n``, ``mean``, ``low``, ``high`` (range) of
        the first and with ``_others`` of the second, ``p_lower`` (one-sided: the first is lower) and ``p`` (two-sided)
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
        # By default SciPy approximates from nine runs on.
        method = "exact" if len({*a, *b}) == len(a) + len(b) else "asymptotic"
        row |= {
            name: float(stats.mannwhitneyu(a, b, alternative=side, method=method).pvalue)
            for name, side in (("p_lower", "less"), ("p", "two-sided"))
        }
        rows.append(row)
    result = pd.DataFrame(rows)
    together = {name: float(stats.combine_pvalues(result[name], method="fisher").pvalue) for name in ("p_lower", "p")}
    return pd.concat([result, pd.DataFrame([{"task": "all", **together}])], ignore_index=True)


def _mean_and_range(row: dict[Any, Any], of: str) -> str:
    return f"{row['mean' + of]:.0f} ({row['low' + of]:.0f} to {row['high' + of]:.0f})"


def markdown(found: dict[int, pd.DataFrame]) -> str:
    """
    :param found: results of ``rank_tests`` by step
    :return: a table in Markdown
    """
    lines = [
        "| step | task | seeds | mean (range) | others' seeds | mean (range) | p, two-sided | p, the first is lower |",
        "| ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for step, result in found.items():
        for row in result.to_dict("records"):
            cells = ["", "", "", ""]
            if row["task"] != "all":
                cells = [x for o in ("", "_others") for x in (f"{row['n' + o]:.0f}", _mean_and_range(row, o))]
            lines.append(f"| {step:,} | {row['task']} | {' | '.join(cells)} | {row['p']:.2f} | {row['p_lower']:.2f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ours", type=Path)
    parser.add_argument("others", type=Path)
    parser.add_argument("--step", type=steps_of, required=True, nargs="+")
    parser.add_argument("--metric", default="return")
    args = parser.parse_args()
    ours, others = study.load(args.ours), study.load(args.others)
    found = {step: rank_tests(ours, others, step, args.metric) for step in args.step}
    if missing := sorted(set(ours["task"]) ^ set(others["task"])):
        print("In one table only:", ", ".join(missing))
    for step, result in found.items():
        for row in result.to_dict("records"):
            words = [
                f"  {row['n' + o]:.0f} seeds, mean {_mean_and_range(row, o)};"
                for o in ("", "_others")
                if row["task"] != "all"
            ]
            print(f"{step:,} steps, {row['task']}:{''.join(words)}  p {row['p']:.3f}, lower {row['p_lower']:.3f}")


if __name__ == "__main__":
    main()
