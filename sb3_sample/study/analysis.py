"""
The papers' studies as functions of one table: marginalisation and correlation (the regularization study, Nauman et al.
2024, sections 4 and 5), a score over two arguments, and the score against the time (BRO, figure 13).
"""

import fnmatch
import itertools
import json
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sb3_sample.study.aggregate import (
    REPS,
    Groups,
    Scores,
    aggregate,
    at_steps,
    blocks_of,
    bootstrap,
    check_samples,
    compared,
    differing_arguments,
    group_tasks,
    iqm,
    named_apart,
    scored,
)
from sb3_sample.study.table import RUN, plain_texts
from sb3_sample.study_list import ABSENT, word
from sb3_sample.warn import warn

#: Evaluations at the end of a run that are averaged (the regularization study, appendix A).
LAST = 10
#: Bootstrap samples of the regularization study.
STUDY_REPS = 500
#: Variables of its correlations, besides the score.
VARIABLES = (
    "diagnostics/overestimation",
    "diagnostics/overfitting",
    "diagnostics/dormant_critic",
    "diagnostics/effective_rank",
    "diagnostics/gradient_norm_critic",
    "diagnostics/parameter_norm_critic",
)
#: Patterns of the variables that its regressions use unchanged; the others enter as logarithms.
LINEAR = ("*dormant*",)


def final(
    table: pd.DataFrame, metrics: Sequence[str] = (), *, last: int = LAST, scores: Scores | None = None
) -> pd.DataFrame:
    """
    Summarise each run at its end, by the mean of its last values.

    :param table: of :func:`~sb3_sample.study.read`
    :param metrics: metrics to return besides the score
    :param last: number of values averaged per run; all, if it has fewer
    :param scores: see :func:`~sb3_sample.study.aggregate.scored`
    :return: one row per run: agent, arguments, task, seed, ``step`` of its last evaluation, ``score``, and one column
        per metric, NaN if the run has not recorded it
    :raises ValueError: no run has recorded a metric, or an argument is out of range
    """
    if type(last) is not int or last < 1:
        raise ValueError(f"last must be a whole number from 1 on, not {last!r}")
    rows = scored(table, scores).sort_values("step", kind="stable")
    found = rows.groupby(RUN, sort=False, dropna=False).agg(step=("step", "last")).join(_ends(rows, "score", last))
    steps = found["step"]
    if steps.nunique() > 1:
        warn(f"runs end at different steps, from {steps.min():,} to {steps.max():,}; each is taken at its own end")
    for metric in metrics:
        rows = table[table["metric"] == metric].sort_values("step", kind="stable")
        if not len(rows):
            how = ""
            if metric.startswith("diagnostics/"):
                how = ", which DiagnosticsCallback records: 'diagnostics: 10_000' in a plan, every 10,000 steps"
            raise ValueError(f"metrics must be of {', '.join(sorted(table['metric'].unique()))}, not {metric!r}{how}")
        found = found.join(_ends(rows, "value", last).rename(metric))
    return found.reset_index()


def _ends(rows: pd.DataFrame, column: str, last: int) -> pd.Series:
    """Mean of each run's last rows."""
    ends = rows.groupby(RUN, sort=False, dropna=False).tail(last)
    return ends.groupby(RUN, sort=False, dropna=False)[column].mean()


def argument(runs: pd.DataFrame, name: str) -> list[str]:
    """
    :param runs: with columns ``agent`` and ``arguments``
    :param name: of an argument, with a dot for an entry of a dict, ``policy_kwargs.net_arch``; or "agent"
    :return: its value as text for each row, "default" if the run was not given it
    :raises ValueError: no run was given it
    """
    if name == "agent":
        return list(runs["agent"])
    runs = plain_texts(runs)
    values: dict[str, Any] = {}
    for text in runs["arguments"].unique():
        value: Any = json.loads(text)
        for key in [name] if name in value else name.split("."):
            value = value.get(key, ABSENT) if isinstance(value, dict) else ABSENT
        values[text] = value
    if all(value is ABSENT for value in values.values()):
        known = sorted({key for text in values for key in json.loads(text)})
        raise ValueError(
            f"arguments must be of those of the runs, {', '.join(known) or 'which have none'}, not {name!r}"
        )
    texts = {text: word(value) for text, value in values.items()}
    return [texts[text] for text in runs["arguments"]]


def _natural(text: str) -> tuple[int, float, str]:
    """Sort key: numbers, also with a unit ("0.55M"), by their size, and before words."""
    number = re.match(r"-?\d+(\.\d+)?(e[-+]?\d+)?", text)
    return (0, float(number[0]), text) if number else (1, 0.0, text)


# ---------------------------------------------------------------- marginalisation


def marginalize(
    table: pd.DataFrame,
    factors: Mapping[str, Sequence[str]] | None = None,
    order: int = 1,
    *,
    by: Sequence[str] = (),
    groups: Groups | None = None,
    last: int = LAST,
    scores: Scores | None = None,
    reps: int = STUDY_REPS,
    confidence: float = 0.95,
    seed: int = 0,
) -> pd.DataFrame:
    """
    Marginal effect of a choice over all other choices: scores at the end of training over all runs with the choice.

    The runs are made with one choice for each of several factors, e.g. a critic regularization, a network
    regularization and a plasticity regularization. First order: all runs with a choice for one factor, over the choices
    for the others. Second order: a pair of choices, over those for the rest. If the order is the number of factors:
    each combination separately.

    :param table: of :func:`~sb3_sample.study.read`
    :param factors: arguments by name of the factor; "agent", the agent's name, counts as an argument. None: every
        argument that differs between runs of the same task is a factor, except those in ``by``
    :param order: how many factors are fixed, 1 to the number of factors
    :param by: arguments by which the runs are parted, e.g. ``["replay_ratio"]``
    :param groups: of tasks, see :func:`~sb3_sample.study.aggregate`
    :param last: evaluations at the end of a run that are averaged
    :param scores: see :func:`~sb3_sample.study.aggregate.scored`
    :param reps: bootstrap samples
    :param confidence: of the interval
    :param seed: of the bootstrap
    :return: one row per group of tasks, value of ``by`` and combination of choices. Columns ``group``, those of ``by``,
        one per factor with the choice, empty if the row is over all choices; ``mean`` (of the tasks' means) and
        ``standard_error`` over the runs; ``iqm``, ``low``, ``high``; ``tasks``, ``runs``
    :raises ValueError: an argument is not one of the runs', or is out of range
    :raises ImportError: rliable is not installed
    """
    check_samples(reps, confidence)
    runs = final(table, last=last, scores=scores)
    if factors is None:
        factors = {name: (name,) for name in differing_arguments(runs) if name not in by}
    if not factors:
        raise ValueError("factors must be given: the runs differ in no argument")
    if type(order) is not int or not 1 <= order <= len(factors):
        raise ValueError(
            f"order must be a whole number from 1 to {len(factors)}, the number of factors ({', '.join(factors)}), not "
            f"{order!r}"
        )
    taken = {*by, *runs, "group", "mean", "standard_error", "iqm", "low", "high", "tasks", "runs"} - {"agent"}
    clash = taken & set(factors) | {"agent"} & set(factors) & set(by)
    if clash:
        raise ValueError(f"factors must have other names than the table's columns, not {', '.join(sorted(clash))}")
    for name in by:
        runs[name] = argument(runs, name)
    for factor, names in factors.items():
        columns = [argument(runs, name) for name in names]
        runs[factor] = (
            columns[0]
            if len(names) == 1
            else [", ".join(f"{n}={v}" for n, v in zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
        )
    rows: list[dict[str, Any]] = []
    for group, tasks in group_tasks(groups, list(runs["task"].unique()), table["task"].unique()).items():
        in_group = runs[runs["task"].isin(tasks)]
        for head, part in _parted(in_group, list(by)):
            _warn_of_missing(part, list(factors), group)
            for fixed in itertools.combinations(factors, order):
                for choices, chosen in _parted(part, list(fixed)):
                    row = {"group": group, **head, **dict.fromkeys(factors, ""), **choices}
                    rows.append(row | _marginal(chosen, reps, confidence, seed))
    return pd.DataFrame(rows)


def _parted(runs: pd.DataFrame, columns: list[str]) -> list[tuple[dict[str, str], pd.DataFrame]]:
    """Runs by the values of columns, sorted."""
    if not columns:
        return [({}, runs)]
    parts = [(dict(zip(columns, values, strict=True)), rows) for values, rows in runs.groupby(columns)]
    return sorted(parts, key=lambda part: [_natural(value) for value in part[0].values()])


def _warn_of_missing(runs: pd.DataFrame, factors: list[str], group: str) -> None:
    there = runs.groupby("task")[factors].apply(lambda rows: len(rows.drop_duplicates()))
    counts = runs.groupby(["task", *factors]).size()
    if counts.nunique() > 1:
        warn(
            f"combinations of choices and tasks have {counts.min()} to {counts.max()} runs in {group!r}: those with "
            "more weigh more in what is averaged over them"
        )
    combinations = math.prod(runs[factor].nunique() for factor in factors)
    missing = int((combinations - there).sum())
    if missing:
        warn(
            f"{missing} of {combinations * len(there)} combinations of choices and tasks have no run in {group!r}: "
            "what is averaged over is not the same for all choices"
        )


def _marginal(runs: pd.DataFrame, reps: int, confidence: float, seed: int) -> dict[str, Any]:
    blocks = blocks_of(runs.set_index("task")[["score"]])
    point, low, high = bootstrap(iqm, blocks, reps, confidence, seed)
    n = len(runs)
    return {
        "mean": runs.groupby("task")["score"].mean().mean(),
        "standard_error": runs["score"].std(ddof=1) / math.sqrt(n) if n > 1 else math.nan,
        "iqm": point[0],
        "low": low[0],
        "high": high[0],
        "tasks": runs["task"].nunique(),
        "runs": n,
    }


# ---------------------------------------------------------------- correlation


def symlog(values: Any) -> Any:
    """
    :param values: any numbers
    :return: sign(x) log(1 + |x|), of the same shape
    """
    values = np.asarray(values, float)
    return np.sign(values) * np.log1p(np.abs(values))


def correlate(
    table: pd.DataFrame,
    metrics: Sequence[str] = VARIABLES,
    *,
    by: Sequence[str] = (),
    groups: Groups | None = None,
    level: float = 0.05,
    last: int = LAST,
    scores: Scores | None = None,
) -> pd.DataFrame:
    """
    Spearman's rank correlation between the score at the end of training and the metrics measured there, and between the
    metrics, over all runs of all agents. A logarithm would not change it.

    :param table: of :func:`~sb3_sample.study.read`
    :param metrics: variables besides "score"
    :param by: arguments by which the runs are parted, e.g. ``["replay_ratio"]``
    :param groups: of tasks, see :func:`~sb3_sample.study.aggregate`
    :param level: correlations with a p above it are NaN
    :param last: values at the end of a run that are averaged
    :param scores: see :func:`~sb3_sample.study.aggregate.scored`
    :return: columns ``group``, those of ``by``, ``x``, ``y``, ``spearman``, ``p``, ``runs``; both orders of each pair,
        and a variable with itself. Runs that lack one of the two are left out; fewer than three runs, or a variable
        that is equal for all, give NaN
    :raises ValueError: no run has recorded a metric, or an argument is out of range
    """
    if not 0 <= level <= 1:
        raise ValueError(f"level must be between 0 and 1, not {level!r}")
    runs = final(table, metrics, last=last, scores=scores)
    for name in by:
        runs[name] = argument(runs, name)
    rows: list[dict[str, Any]] = []
    variables = ["score", *metrics]
    for group, tasks in group_tasks(groups, list(runs["task"].unique()), table["task"].unique()).items():
        for head, part in _parted(runs[runs["task"].isin(tasks)], list(by)):
            for x, y in itertools.product(variables, repeat=2):
                both = part[[x]].assign(other=part[y]).dropna()
                rho, p = _spearman(both[x], both["other"])
                shown = rho if p <= level else math.nan
                rows.append({"group": group, **head, "x": x, "y": y, "spearman": shown, "p": p, "runs": len(both)})
    return pd.DataFrame(rows)


def _spearman(x: pd.Series, y: pd.Series) -> tuple[float, float]:
    if len(x) < 3 or x.nunique() < 2 or y.nunique() < 2:
        return math.nan, math.nan
    from scipy.stats import spearmanr  # takes longer to import than the rest of this package's studies

    found = spearmanr(x, y)
    return float(found.statistic), float(found.pvalue)


def regress(
    table: pd.DataFrame,
    metrics: Sequence[str] = VARIABLES,
    *,
    linear: Sequence[str] = LINEAR,
    last: int = LAST,
    scores: Scores | None = None,
) -> pd.DataFrame:
    """
    Ordinary least squares of the score on one metric at a time, task by task, over all runs of all agents. Metrics
    enter as symmetric logarithms (:func:`symlog`), except shares.

    :param table: of :func:`~sb3_sample.study.read`
    :param metrics: explanatory variables
    :param linear: patterns of the metrics that are used unchanged
    :param last: values at the end of a run that are averaged
    :param scores: see :func:`~sb3_sample.study.aggregate.scored`
    :return: columns ``task``, ``metric``, ``log`` (whether the logarithm was taken), ``slope``, ``standard_error`` of
        the slope, ``intercept``, ``r_squared``, ``p`` (of a slope of 0), ``spearman``, ``spearman_p``, ``runs``. Runs
        that lack the metric are left out, with a warning those for which it is infinite. NaN if there are fewer than
        three runs, or all have the same value
    :raises ValueError: no run has recorded a metric, or an argument is out of range
    """
    from scipy.stats import linregress

    runs = final(table, metrics, last=last, scores=scores)
    rows: list[dict[str, Any]] = []
    for task, of_task in runs.groupby("task", sort=False):
        for metric in metrics:
            both = of_task[["score", metric]].dropna()
            finite = both[np.isfinite(both).all(axis=1)]
            if len(finite) < len(both):
                warn(
                    f"{len(both) - len(finite)} of {len(both)} runs on {task} have an infinite {metric} or score and "
                    "are left out there"
                )
                both = finite
            is_log = not any(fnmatch.fnmatchcase(metric, pattern) for pattern in linear)
            x = symlog(both[metric]) if is_log else both[metric].to_numpy(float)
            row = {"task": task, "metric": metric, "log": is_log}
            fit = [math.nan] * 5
            if len(both) >= 3 and len(np.unique(x)) > 1:
                found = linregress(x, both["score"])
                fit = [found.slope, found.stderr, found.intercept, found.rvalue**2, found.pvalue]
            row |= dict(zip(("slope", "standard_error", "intercept", "r_squared", "p"), fit, strict=True))
            rho, p = _spearman(both[metric], both["score"])
            rows.append(row | {"spearman": rho, "spearman_p": p, "runs": len(both)})
    return pd.DataFrame(rows)


# ---------------------------------------------------------------- two arguments, and costs


def heatmap(
    table: pd.DataFrame,
    x: str,
    y: str,
    value: str = "score",
    *,
    step: int | None = None,
    group: str | Sequence[str] = "all",
    scores: Scores | None = None,
) -> pd.DataFrame:
    """
    Tabulate a value over two arguments, e.g. the model's size and the replay ratio.

    :param table: of :func:`~sb3_sample.study.read`
    :param x: argument of the columns; a dot stands for an entry of a dict
    :param y: argument of the rows
    :param value: "score", shown as interquartile mean over tasks and seeds, or a metric, e.g. "hours", shown as mean of
        the tasks' means
    :param step: simulator step; None for the last one that all runs reach
    :param group: of tasks: a name, or the tasks
    :param scores: see :func:`~sb3_sample.study.aggregate.scored`
    :return: values of ``y`` as index and of ``x`` as columns, both sorted; NaN where there is no run. The step is in
        ``attrs["step"]``. Warnings name the cells from which runs are left out, and say if cells are not of the same
        tasks
    :raises ValueError: no run was given an argument, has recorded the metric, or reaches the step
    """
    rows = scored(table, scores) if value == "score" else table[table["metric"] == value]
    if not len(rows):
        raise ValueError(f"value must be score or of {', '.join(sorted(table['metric'].unique()))}, not {value!r}")
    rows = rows.rename(columns={"value": "score"})
    groups = [group] if isinstance(group, str) else {"tasks": group}
    (tasks,) = group_tasks(groups, list(table["task"].unique())).values()
    rows = rows[rows["task"].isin(tasks)]
    if not len(rows):
        raise ValueError(f"group must be one of the table's tasks, and there are none of {group!r}")
    # A cell contains the runs of all agents.
    rows = rows.assign(x=argument(rows, x), y=argument(rows, y))
    step = int(rows.groupby(RUN, dropna=False)["step"].max().min()) if step is None else step
    cells: dict[tuple[str, str], float] = {}
    tasks_of: dict[str, frozenset[str]] = {}
    for (x_value, y_value), cell in rows.groupby(["x", "y"], sort=False):
        matrix, _ = at_steps(cell, [step])
        kept = matrix.dropna()
        name = f"{x}={x_value}, {y}={y_value}"
        if len(kept) < len(matrix):
            warn(
                f"{len(matrix) - len(kept)} of {len(matrix)} runs of {name} have no evaluations around step {step:,} "
                "and are left out"
            )
        tasks_of[name] = frozenset(kept.index.get_level_values("task"))
        blocks = blocks_of(kept)
        if blocks:
            means = np.concatenate([block.mean(axis=0) for block in blocks])
            cells[x_value, y_value] = float(iqm(*blocks)[0] if value == "score" else means.mean())
    if not cells:
        raise ValueError(f"step must be within those of the runs, up to {rows['step'].max():,}, not {step:,}")
    if len({each for each in tasks_of.values() if each}) > 1:
        found_tasks = "; ".join(f"{name} {len(each)}" for name, each in tasks_of.items())
        warn(f"cells are not of the same tasks ({found_tasks} of {len(set().union(*tasks_of.values()))})")
    found = pd.Series(cells).unstack(level=0)  # a series with two levels, not a table
    found.index.name, found.columns.name = y, x
    found.attrs["step"] = step
    return found.loc[sorted(found.index, key=_natural), sorted(found.columns, key=_natural)]


def cost(
    table: pd.DataFrame,
    steps: Sequence[int] | None = None,
    groups: Groups | None = None,
    *,
    scores: Scores | None = None,
    common: bool = False,
    reps: int = REPS,
    confidence: float = 0.95,
    seed: int = 0,
) -> pd.DataFrame:
    """
    Score against the time that the runs took. Times are comparable only if measured on one machine, with the same
    number of threads and of concurrent runs.

    :param table: of :func:`~sb3_sample.study.read`, with the metric "hours"; see
        :func:`~sb3_sample.study.aggregate` for the other arguments
    :return: the table of :func:`~sb3_sample.study.aggregate`, with ``hours``, the mean of the tasks' means, NaN for
        agents without it, and ``steps_per_second``, simulator steps divided by that time
    :raises ValueError: no run has recorded its time; see :func:`~sb3_sample.study.aggregate`
    :raises ImportError: rliable is not installed
    """
    table = named_apart(table)
    if not (table["metric"] == "hours").any():
        raise ValueError("table must have the metric 'hours' of at least one run, and has it of none")
    found = aggregate(table, steps, groups, scores=scores, common=common, reps=reps, confidence=confidence, seed=seed)
    steps = list(dict.fromkeys(found["step"]))
    with warnings.catch_warnings():  # aggregate has already warned
        warnings.simplefilter("ignore", UserWarning)
        averaged, _, members = compared(scored(table, scores), steps, groups, common, table["task"].unique())
    timed = table[table["metric"] == "hours"].rename(columns={"value": "score"})
    matrix, _ = at_steps(timed, steps)
    by_agent = dict(list(matrix.groupby("agent")))
    hours = []
    for row in found.itertuples():
        if row.agent not in by_agent:
            hours.append(math.nan)
            continue
        of_agent = by_agent[row.agent].droplevel("agent")[row.step].dropna()
        # Only the tasks of the score at that step, so that score and hours are of the same tasks.
        there = averaged.loc[row.agent][row.step].dropna().index
        of_tasks = of_agent[of_agent.index.isin(members[row.group]) & of_agent.index.isin(there)]
        hours.append(of_tasks.groupby(level=0).mean().mean())
    found["hours"] = hours
    found["steps_per_second"] = found["step"] / found["hours"] / 3_600
    return found
