"""The paper's figures 1 to 7 and 9 to 11, for the user's own runs."""

import argparse
import json
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sb3_sample.diagnostics.gradient_noise import LARGE, SMALL
from sb3_sample.diagnostics.measures import noise_scale
from sb3_sample.run_settings import simulator_steps
from sb3_sample.study.analysis import argument
from sb3_sample.study.analysis_command import new_figure
from sb3_sample.study.scaling.best import cells, choose
from sb3_sample.study.scaling.crossings import configurations, isotonic
from sb3_sample.study.scaling.fitting import fit
from sb3_sample.study.scaling.result import Laws

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Data of figure 4: values by replay ratio, one line for each value of an argument; the first recorded metric is used.
_LOGGED = {
    "batch_size": ("diagnostics/overfitting_newest", "diagnostics/overfitting"),
    "learning_rate": ("diagnostics/parameter_norm_critic",),
}
#: Data of figures 10 and 11: squared norms of the critics' gradients at two batch sizes.
_SQUARES = {size: f"diagnostics/gradient_square_{size}" for size in (SMALL, LARGE)}
#: Number of measurements averaged in figure 10.
_WINDOW = 10


def draw_all(
    laws: Laws, table: pd.DataFrame, options: argparse.Namespace
) -> tuple[dict[str, "Figure"], dict[str, str]]:
    """
    :param laws: of the runs
    :param table: the runs
    :param options: of ``sb3-sample scaling plot``
    :return: figures by name, and for figures that cannot be drawn the reasons by name
    :raises ImportError: matplotlib is not installed
    """
    of_one = table
    for name, chosen in (("agent", options.agent), ("model_size", options.size)):
        if chosen is not None:
            of_one = of_one[[value == chosen for value in argument(of_one, name)]]
    figures: dict[str, Callable[[], Figure]] = {
        "figure_1_frontier": lambda: frontier(laws),
        "figure_2_steps_and_compute": lambda: steps_and_compute(laws),
        "figure_3_budgets": lambda: budgets(laws),
        "figure_4_overfitting": lambda: logged(of_one),
        "figure_5_hyperparameters": lambda: hyperparameters(laws),
        "figure_6_extrapolation": lambda: extrapolation(laws, table, options),
        "figure_7_choice": lambda: choice(laws, table, options),
        "figure_9_levels": lambda: levels(laws),
        "figure_10_critical_batch_size": lambda: critical(of_one),
        "figure_11_critical_and_best": lambda: critical_and_best(laws, of_one),
    }
    drawn, without = {}, {}
    for name, draw in figures.items():
        try:
            drawn[name] = draw()
        except ValueError as error:
            without[name] = str(error)
    return drawn, without


def _axes(n: int, width: float = 4.5) -> tuple["Figure", Any]:
    figure = new_figure(width * n, 4)
    axes = figure.subplots(1, n, squeeze=False)[0]
    for each in axes:
        each.grid(alpha=0.3)
    return figure, axes


def _log(axes: Any, x: str, y: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(x)
    axes.set_ylabel(y)


def _points(
    axes: Any,
    x: Any,
    y: np.ndarray,
    censored: np.ndarray,
    color: Any = "C1",
    label: str = "runs",
    bound: str = "a lower bound",
) -> None:
    """Steps of runs as dots; lower bounds, for levels that not every task reaches, as hollow triangles."""
    x = np.asarray(x, float)
    if not censored.all():
        axes.plot(x[~censored], y[~censored], "o", color=color, label=label)
    if censored.any():
        axes.plot(x[censored], y[censored], "^", color=color, mfc="none", label=bound)


def _fine(laws: Laws) -> np.ndarray:
    return np.geomspace(laws.replay_ratios[0] / 2, laws.replay_ratios[-1] * 2, 200)


def frontier(laws: Laws) -> "Figure":
    """
    :param laws: of runs
    :return: figure 1: steps against compute at the largest level, best replay ratio against budget, frontiers of levels
    :raises ValueError: the laws have no compute
    """
    figure, (left, middle, right) = _axes(3)
    ratios, level = np.array(laws.replay_ratios), laws.levels[-1]
    law = laws.compute_laws(level.level)[0]
    line = law.at(_fine(laws))
    left.plot(line.compute, line.steps)
    compute = law.at(ratios).compute / level.law().steps(ratios) * level.points
    _points(left, compute, level.points, level.censored)
    if "d_min" not in level.law().undetermined(ratios):
        left.axhline(level.law().d_min, linestyle="--", color="gray", label="d_min")
    for ratio, x, y in zip(ratios, compute, level.points, strict=True):
        left.annotate(f"{ratio:g}", (x, y))
    left.set_title(f"J = {level.level:.0f}")
    left.legend(frameon=False)
    _log(left, "C (FLOPs)", "D (environment steps)")
    table = laws.budgets()
    kept = table["within"]
    middle.plot(table["budget"][kept], table["replay_ratio"][kept], "o", label="least C + δ D")
    middle.plot(table["budget"][~kept], table["replay_ratio"][~kept], "o", mfc="none", label="outside of the runs")
    if len(table) >= 4:
        middle.plot(table["budget"][-2:], table["replay_ratio"][-2:], "rx", label="held out")
        middle.plot(table["budget"], laws.budget_laws()[0].replay_ratio(table["budget"].to_numpy()))
    middle.legend(frameon=False)
    _log(middle, "budget F (FLOPs)", "best replay ratio")
    for each in laws.levels:
        line = laws.compute_laws(each.level)[0].at(_fine(laws))
        right.plot(line.compute, line.steps, label=f"{each.level:.0f}")
    right.legend(title="J", frameon=False, fontsize=7)
    _log(right, "C (FLOPs)", "D (environment steps)")
    return figure


def steps_and_compute(laws: Laws) -> "Figure":
    """
    :param laws: of runs
    :return: figure 2: steps and compute by replay ratio, at the largest level
    :raises ValueError: the laws have no compute
    """
    figure, (left, right) = _axes(2)
    level, fine = laws.levels[-1], _fine(laws)
    law = laws.compute_laws(level.level)[0]
    _points(left, laws.replay_ratios, level.points, level.censored)
    left.plot(fine, level.law().steps(fine), label="law")
    left.legend(frameon=False)
    right.plot(fine, law.at(fine).compute)
    _log(left, "replay ratio", "D (environment steps)")
    _log(right, "replay ratio", "C (FLOPs)")
    return figure


def budgets(laws: Laws) -> "Figure":
    """
    :param laws: of runs
    :return: figure 3: frontiers, lines of equal budget, and the optima; compute and steps on linear axes
    :raises ValueError: the laws have no compute
    """
    figure, (axes,) = _axes(1, 6)
    best = []
    for each in laws.levels:
        law = laws.compute_laws(each.level)[0]
        line, point = law.at(_fine(laws)), law.best(laws.delta)
        color = axes.plot(line.compute, line.steps, label=f"{each.level:.0f}")[0].get_color()
        total = float(point.compute[0] + laws.delta * point.steps[0])
        x = np.linspace(0, total, 50)
        axes.plot(x, (total - x) / laws.delta, ":", color=color, linewidth=0.8)
        best.append((float(point.compute[0]), float(point.steps[0])))
    axes.plot(*zip(*best, strict=True), "k*-", label="best")
    axes.set_xlabel("C (FLOPs)")
    axes.set_ylabel("D (environment steps)")
    axes.legend(title="J", frameon=False, fontsize=7)
    return figure


def logged(table: pd.DataFrame) -> "Figure":
    """
    :param table: of runs that have recorded diagnostics
    :return: figure 4: overfitting by replay ratio for each batch size, norm of the critics' parameters for each
        learning rate; lines from least squares
    :raises ValueError: the runs have recorded neither, or no run was given such an argument
    """
    recorded = set(table["metric"])
    there = {name: [metric for metric in metrics if metric in recorded] for name, metrics in _LOGGED.items()}
    found = {name: metrics[0] for name, metrics in there.items() if metrics}
    if not found:
        raise ValueError(
            f"the runs have recorded none of {', '.join(sum(_LOGGED.values(), ()))} (NoiseScaleCallback, "
            "DiagnosticsCallback)"
        )
    figure, axes = _axes(len(found))
    for each, (name, metric) in zip(axes, found.items(), strict=True):
        rows = table[table["metric"] == metric].dropna(subset=["value"])
        rows = rows.assign(own=argument(rows, name), ratio=pd.to_numeric(argument(rows, "replay_ratio")))
        for own, part in rows.groupby("own"):
            means = part.groupby("ratio")["value"].mean()
            color = each.plot(means.index, means, "o", label=f"{own}")[0].get_color()
            if len(means) > 1:
                slope, at = np.polyfit(np.log(means.index.to_numpy(float)), means, 1)
                each.plot(means.index, at + slope * np.log(means.index.to_numpy(float)), color=color)
        each.set_xscale("log")
        each.set_xlabel("replay ratio")
        each.set_ylabel(metric)
        each.legend(title=name, frameon=False, fontsize=7)
    return figure


def hyperparameters(laws: Laws) -> "Figure":
    """
    :param laws: of runs
    :return: figure 5: best values by replay ratio relative to those at replay ratio 1, and against each other
    :raises ValueError: nothing was swept
    """
    if not laws.hyperparameters:
        raise ValueError("neither batch size nor learning rate was swept")
    n = len(laws.hyperparameters)
    figure, axes = _axes(n + (n == 2))
    fine, scaled = _fine(laws), {}
    for each, (name, law) in zip(axes, laws.hyperparameters.items(), strict=False):
        values = law.values.dropna(subset=["value"])
        values = values[values["task"].isin(law.tasks)]
        values = values.assign(scaled=values["value"] / values["task"].map(law.law().intercepts))
        scaled[name] = values.set_index(["task", "replay_ratio"])["scaled"]
        for task, part in values.groupby("task"):
            each.plot(part["replay_ratio"], part["scaled"], "o", label=task)
        each.plot(fine, fine ** law.law().slope, "k")
        each.legend(frameon=False, fontsize=7)
        _log(each, "replay ratio", f"{name} / that at sigma = 1")
    if n == 2:
        both = pd.concat(scaled, axis=1).dropna()
        axes[-1].plot(both["learning_rate"], both["batch_size"], "o")
        if len(both) > 2:
            r = np.corrcoef(np.log(both["learning_rate"]), np.log(both["batch_size"]))[0, 1]
            axes[-1].set_title(f"R = {r:.2f}")
        _log(axes[-1], "learning_rate / that at sigma = 1", "batch_size / that at sigma = 1")
    return figure


def _again(options: argparse.Namespace, level: float) -> dict[str, Any]:
    resets = options.resets
    return {
        "levels": [level],
        "choice_level": options.choice_level,
        "critic_params": options.critic_params,
        "delta": options.delta,
        "agent": options.agent,
        "model_size": options.size,
        "batch_size": options.batch_size,
        "loss": options.loss,
        "reps": 2,
        "scores": dict(options.score),
        "keep_after_reset": options.keep_after_reset,
        "resets": resets[0] if resets is not None and len(resets) == 1 else resets,
    }


def extrapolation(laws: Laws, table: pd.DataFrame, options: argparse.Namespace) -> "Figure":
    """
    :param laws: of all runs
    :param table: the runs
    :param options: of the fit
    :return: figure 6: steps at the smallest and at the largest replay ratio, each predicted by a fit without it; no
        error if they are a lower bound that the law exceeds
    :raises ValueError: there are fewer than four replay ratios
    """
    if len(laws.replay_ratios) < 4:
        raise ValueError(f"it needs four replay ratios, of which one is held out; there are {len(laws.replay_ratios)}")
    level = laws.levels[-1]
    figure, axes = _axes(2)
    numbers = pd.to_numeric(pd.Series(argument(table, "replay_ratio"), index=table.index))
    for each, held in zip(axes, (laws.replay_ratios[0], laws.replay_ratios[-1]), strict=True):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # already shown once, for all runs
            rest = fit(table[numbers != held], **_again(options, level.level))
        law, fine = rest.levels[-1].law(), _fine(laws)
        at = laws.replay_ratios.index(held)
        # The mean over the tasks uses their medians, which differ without one replay ratio.
        kept = np.array([ratio != held for ratio in laws.replay_ratios])
        factor = float(np.exp(np.mean(np.log(level.points[kept] / rest.levels[-1].points))))
        _points(each, np.array(laws.replay_ratios)[kept], level.points[kept], level.censored[kept])
        bound = bool(level.censored[at])
        each.plot(held, level.points[at], "r^" if bound else "rx", mfc="none", label="held out" + ", a bound" * bound)
        each.plot(fine, factor * law.steps(fine))
        error = f"{factor * law.steps(held) / level.points[at] - 1:+.0%}"
        if bound:
            error = "above the bound" if factor * law.steps(held) >= level.points[at] else f"{error} of the bound"
        each.set_title(f"J = {level.level:.0f}, sigma = {held:g} held out: {error}")
        each.legend(frameon=False)
        _log(each, "replay ratio", "D (environment steps)")
    return figure


def choice(laws: Laws, table: pd.DataFrame, options: argparse.Namespace) -> "Figure":
    """
    :param laws: of the runs
    :param table: the runs
    :param options: of the fit
    :return: figure 7: mean return and its isotonic regression for one configuration, and the choices of the draws
    :raises ValueError: nothing was swept
    """
    again = _again(options, laws.choice_level)
    found = configurations(
        table, scores=again["scores"], keep_after_reset=again["keep_after_reset"], resets=again["resets"]
    )
    found = [each for each in found if options.agent in (None, each.agent)]
    found = [each for each in found if options.size in (None, str(each.argument("model_size")))]
    for cell in cells(found):
        whole = {len(each.curves): np.arange(len(each.curves))[None] for each in cell.members}
        chosen = choose(cell, laws.choice_level, whole, 100, np.random.default_rng(options.seed))
        if chosen:
            break
    else:
        raise ValueError("neither batch size nor learning rate was swept")
    figure, axes = _axes(1 + len(chosen))
    member = cell.members[0]
    mean = member.curves.mean(axis=0)
    steps = member.steps / member.repeat
    axes[0].plot(steps, member.curves.T, color="gray", linewidth=0.5)
    axes[0].plot(steps, mean, label="mean over the seeds")
    axes[0].plot(steps, isotonic(mean), label="isotonic")
    axes[0].axhline(laws.choice_level, linestyle="--", color="black")
    axes[0].set_title(f"{cell.task}, sigma = {cell.replay_ratio:g}")
    axes[0].set_xlabel("environment steps")
    axes[0].legend(frameon=False)
    for each, (name, values) in zip(axes[1:], chosen.items(), strict=True):
        tried, counts = np.unique(values[np.isfinite(values)], return_counts=True)
        each.bar([f"{value:g}" for value in tried], counts)
        each.set_xlabel(name)
        each.set_ylabel("draws in which it is first")
    return figure


def levels(laws: Laws) -> "Figure":
    """
    :param laws: of runs
    :return: figure 9: steps by replay ratio and their fits, of all levels
    """
    figure, (axes,) = _axes(1, 6)
    fine = _fine(laws)
    for each in laws.levels:
        color = axes.plot(fine, each.law().steps(fine), label=f"{each.level:.0f}")[0].get_color()
        _points(axes, laws.replay_ratios, each.points, each.censored, color, label="_runs", bound="_bound")
    if any(each.censored.any() for each in laws.levels):
        axes.plot([], [], "^", color="gray", mfc="none", label="a lower bound")
    axes.legend(title="J", frameon=False, fontsize=7)
    _log(axes, "replay ratio", "D (environment steps)")
    return figure


def squares(table: pd.DataFrame) -> dict[tuple[str, float], pd.DataFrame]:
    """
    :param table: of runs that have recorded the norms of their gradients (NoiseScaleCallback)
    :return: by task and replay ratio, the squared norms by environment step (rows) and batch size (columns 64 and
        1,024), averaged over the seeds and all other differences between runs
    :raises ValueError: the runs have recorded none, or have no replay ratio
    """
    rows = table[table["metric"].isin(list(_SQUARES.values()))].dropna(subset=["value"])
    if not len(rows):
        raise ValueError(f"the runs have not recorded {' and '.join(_SQUARES.values())} (NoiseScaleCallback)")
    repeats = {text: simulator_steps(json.loads(text)) for text in rows["arguments"].unique()}
    rows = rows.assign(
        ratio=pd.to_numeric(pd.Series(argument(rows, "replay_ratio"), index=rows.index), "coerce"),
        # The table has simulator steps.
        step=rows["step"] / rows["arguments"].map(repeats),
    )
    if rows["ratio"].isna().any():
        raise ValueError("runs must have been given a replay_ratio")
    found = {}
    for (task, ratio), part in rows.groupby(["task", "ratio"], sort=True):
        means = part.pivot_table(index="step", columns="metric", values="value")
        found[str(task), float(ratio)] = means.rename(columns={name: size for size, name in _SQUARES.items()})
    return found


def critical(table: pd.DataFrame) -> "Figure":
    """
    :param table: as for :func:`squares`
    :return: figure 10: critical batch size over the training, from rolling means of the squared norms; gaps where these
        show only noise and no gradient
    """
    found = squares(table)
    tasks = list(dict.fromkeys(task for task, _ in found))
    figure, axes = _axes(len(tasks))
    for each, task in zip(axes, tasks, strict=True):
        for (own, ratio), means in found.items():
            if own == task:
                rolled = means.rolling(_WINDOW, min_periods=1).mean()
                sizes = [noise_scale(row[SMALL], row[LARGE], SMALL, LARGE)[2] for _, row in rolled.iterrows()]
                each.plot(rolled.index, np.where(np.isfinite(sizes), sizes, np.nan), label=f"{ratio:g}")
        each.set_yscale("log")
        each.set_title(task)
        each.set_xlabel("environment steps")
        each.set_ylabel("critical batch size")
        each.legend(title="replay ratio", frameon=False, fontsize=7)
    return figure


def critical_and_best(laws: Laws, table: pd.DataFrame) -> "Figure":
    """
    :param laws: of the runs
    :param table: as for :func:`squares`
    :return: figure 11: the best batch size against the critical one, which is from the mean squared norms over the
        second half of the training, one point per task and replay ratio
    :raises ValueError: there is no best batch size, or no critical batch size beside it
    """
    if "batch_size" not in laws.hyperparameters:
        raise ValueError("batch size has no law")
    best = laws.hyperparameters["batch_size"].values.set_index(["task", "replay_ratio"])["value"].dropna()
    points: dict[str, list[tuple[float, float]]] = {}
    for key, means in squares(table).items():
        late = means[means.index >= means.index[-1] / 2].mean()
        size = noise_scale(late[SMALL], late[LARGE], SMALL, LARGE)[2]
        if key in best.index and np.isfinite(size):
            points.setdefault(key[0], []).append((size, float(best[key])))
    if not points:
        raise ValueError("no task and replay ratio has both a best and a critical batch size")
    figure, (axes,) = _axes(1, 6)
    for task, pairs in points.items():
        axes.plot(*zip(*pairs, strict=True), "o", label=task)
    sizes = np.log([pair for pairs in points.values() for pair in pairs])
    if len(sizes) > 2:
        axes.set_title(f"R = {np.corrcoef(sizes.T)[0, 1]:.2f}")
    axes.legend(frameon=False, fontsize=7)
    _log(axes, "critical batch size", "best batch size")
    return figure
