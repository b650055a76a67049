"""From a table of runs to its laws, with intervals by the bootstrap over seeds."""

import functools
import json
import math
import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sb3_sample.study.aggregate import Scores
from sb3_sample.study.scaling.best import DRAWS, NAMES, Cell, cells, choose, summarize
from sb3_sample.study.scaling.budget import DELTA
from sb3_sample.study.scaling.crossings import (
    Configuration,
    check_levels,
    configurations,
    default_levels,
    number,
    sorted_levels,
)
from sb3_sample.study.scaling.intervals import draw
from sb3_sample.study.scaling.laws import DataLaw, fit_logs, fit_squared, shared_slope
from sb3_sample.study.scaling.result import HELD_OUT, Hyperparameter, Laws, Level

#: Bootstrap samples of the intervals.
REPS = 400


def normalize(
    steps: np.ndarray, last: np.ndarray, *, across_levels: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Average environment steps over tasks that need different numbers of steps: each task's steps are divided by their
    median over the replay ratios, and multiplied by the median of these medians.

    :param steps: (..., tasks, S, L), inf where a level is not reached
    :param last: (tasks, S) steps of the last evaluation, which replace unreached levels in the means, as a lower bound.
        In the medians an unreached level ranks after all reached ones, however early its runs ended
    :param across_levels: whether the median is over replay ratios and levels together, as in the authors' code;
        otherwise it is over the replay ratios at each level, as in the paper
    :return: means (..., S, L), whether any task does not reach the level (..., S, L), and the factors from the means to
        the steps of each task (..., tasks, L). NaN if half or more of a task's values are not reached, so that it has
        no median
    """
    bounded = ~np.isfinite(steps)
    filled = np.where(bounded, last[..., None], steps)
    axes = (-2, -1) if across_levels else (-2,)
    medians = np.median(np.where(bounded, np.inf, steps), axis=axes, keepdims=True)
    medians = np.where(np.isfinite(medians), medians, np.nan)
    middle = np.median(medians, axis=-3, keepdims=True)
    scaled = filled * (middle / medians)
    factors = np.broadcast_to((medians / middle)[..., 0, :], (*filled.shape[:-2], filled.shape[-1]))
    return scaled.mean(axis=-3), bounded.any(axis=-3), factors


#: Seeds drawn in each sample, as indices (R, m), by number of seeds of a configuration.
_Samples = dict[int, np.ndarray]


def fit(
    table: pd.DataFrame,
    levels: Sequence[float] | None = None,
    *,
    choice_level: float | None = None,
    critic_params: float | None = None,
    delta: float = DELTA,
    agent: str | None = None,
    model_size: Any = None,
    loss: str = "log",
    across_levels: bool = False,
    draws: int = DRAWS,
    reps: int = REPS,
    seed: int = 0,
    batch_size: float | None = None,
    scores: Scores | None = None,
    keep_after_reset: bool = False,
    resets: int | Sequence[int] | None = None,
) -> Laws:
    """
    Fit all laws that a table of runs allows.

    Batch size and learning rate: if runs of a task and replay ratio differ in them, the best by
    :func:`best_hyperparameters`, then :func:`fit_hyperparameter`. Data: for each task and replay ratio, the only
    configuration, or the one nearest to these laws (not the one that happened to be first, whose steps would be too
    few). Among configurations that differ in a hyperparameter without a law, it is the one with a value that all replay
    ratios share, so that the data law does not mix values, else the one nearest to the best value there. Tasks are
    averaged by :func:`normalize`, then :func:`fit_data`. A level that a run does not reach enters as a lower bound; a
    task that reaches it at half of the replay ratios or fewer has no median and is left out and named. Compute and
    budget follow from these laws.

    Intervals are from the bootstrap over seeds (:mod:`sb3_sample.study.scaling.intervals`): everything from the choice
    of hyperparameters on is repeated for each sample, but with the same configurations of the data law.

    :param table: of :func:`~sb3_sample.study.read`
    :param levels: of the return, from 0 to 1000; the authors' ten if None
    :param choice_level: level at which batch size and learning rate are chosen; the largest of ``levels`` if None
    :param critic_params: parameters of the critics, for compute; from ``model_size`` if None
    :param delta: cost of an environment step in FLOPs
    :param agent: agent of the runs; needed if the table has several
    :param model_size: of the runs; needed if the table has several
    :param loss: as for :func:`fit_data`; with "squared", tasks that do not reach a level are left out at that level
    :param across_levels: as for :func:`normalize`
    :param draws: as for :func:`best_hyperparameters`
    :param reps: bootstrap samples of the intervals
    :param seed: of all draws
    :param batch_size: of all runs, for compute, if their arguments do not give it
    :param scores: as for :func:`crossings`
    :param keep_after_reset: as for :func:`crossings`
    :param resets: as for :func:`crossings`
    :return: the laws
    :raises ValueError: there is only one replay ratio, no level is reached at three of them, or an argument is out of
        range
    """
    wanted = check_levels(list(sorted_levels(default_levels() if levels is None else levels)))
    if reps < 2 or draws < 1 or not delta > 0:
        raise ValueError(f"reps must be at least 2, draws at least 1 and delta above 0, not {reps}, {draws}, {delta}")
    if loss not in ("log", "squared"):
        raise ValueError(f"loss must be 'log' or 'squared', not {loss!r}")
    found = _of_one(
        configurations(table, scores=scores, keep_after_reset=keep_after_reset, resets=resets), agent, model_size
    )
    grid = cells(found)
    ratios = sorted({cell.replay_ratio for cell in grid})
    if len(ratios) < 2:
        raise ValueError(f"runs must have at least two replay ratios, three for the data law; all have {ratios[0]:g}")
    repeats = {each.repeat for each in found}
    if len(repeats) > 1:
        raise ValueError(
            "runs must have one action repeat (action_repeat times frames that env_wrapper skips), not "
            f"{sorted(repeats)}: replay ratios do not compare"
        )
    rng = np.random.default_rng(seed)
    n_seeds = {len(each.curves) for each in found}
    fewest = min(n_seeds)
    notes: list[str] = []
    if len({cell.task for cell in grid}) == 1:
        notes.append("one task: slopes and exponents are its own, and nothing says that they hold for others")
    samples = {n: draw(rng, reps, n) for n in n_seeds}
    whole = {n: np.arange(n)[None] for n in n_seeds}
    stages = [whole, samples]
    if fewest < 2:
        notes.append("one seed a configuration: there are no intervals")
    elif fewest < 5:
        unknown = "" if fewest > 2 else ", and how often they hold was not measured"
        notes.append(f"{fewest} seeds a configuration: the intervals are wide{unknown}")

    choice = float(wanted[-1] if choice_level is None else check_levels([choice_level])[0])
    hyperparameters, chosen = _hyperparameters(grid, choice, stages, draws, rng, notes)
    for name, each in hyperparameters.items():
        at_edge = each.values[each.values["edge"] > 0.5]
        if len(at_edge):
            notes.append(
                f"{name}: the best is the smallest or largest that was tried in most draws of {len(at_edge)} of "
                f"{len(each.values)} choices; the law is too flat there"
            )
    picked = _pick(grid, hyperparameters, chosen)
    data = _data(picked, ratios, wanted, stages, loss, across_levels, int(repeats.pop()), notes)
    params = critic_params
    if params is None:
        sizes = {number(each.argument("model_size")) for each in found}
        params = sizes.pop() if len(sizes) == 1 else None
    if params is None:
        notes.append("critic_params (--critic-params) is not known: there is no law of compute and budget")
    elif not params > 0:
        raise ValueError(f"critic_params must be a positive number, not {params!r}")
    fixed, rate = (
        _only(getattr(cell, name)[0] for cell in picked.values()) for name in ("batch_sizes", "learning_rates")
    )
    if fixed is None and batch_size is not None and "batch_size" not in hyperparameters:
        if not batch_size > 0:
            raise ValueError(f"batch_size must be a positive number, not {batch_size!r}")
        fixed = float(batch_size)
    if params is not None and "batch_size" not in hyperparameters and fixed is None:
        notes.append("batch sizes differ or are not known, and have no law: there is no law of compute and budget")
    laws = Laws(
        tasks=list(dict.fromkeys(cell.task for cell in grid)),
        replay_ratios=ratios,
        seeds=fewest,
        hyperparameters=hyperparameters,
        levels=data,
        critic_params=params,
        delta=float(delta),
        batch_size=fixed,
        learning_rate=rate,
        loss=loss,
        choice_level=choice,
        notes=notes,
        others=_others(found),
        without_law=[name for name in chosen if name not in hyperparameters],
    )
    if laws.has_compute and len(data) <= HELD_OUT + 1:
        notes.append(
            f"{len(data)} levels: the law of the budget needs at least {HELD_OUT + 2}, of which two are held out"
        )
    return laws


def _others(found: list[Configuration]) -> dict[str, Any]:
    """Arguments that all runs share, without those of the laws and without the default policy."""
    first, *rest = (json.loads(each.arguments) for each in found)
    own = {"replay_ratio", *NAMES} | ({"policy"} if first.get("policy") == "MlpPolicy" else set())
    return {
        name: value
        for name, value in first.items()
        if name not in own and all(name in each and each[name] == value for each in rest)
    }


def _only(values: Iterable[float]) -> float | None:
    """The value that all share; None if they differ or one is not known."""
    found = set(values)
    value = found.pop()
    return None if found or math.isnan(value) else float(value)


def _of_one(found: list[Configuration], agent: str | None, model_size: Any) -> list[Configuration]:
    """The configurations of one agent and size."""
    agents = list(dict.fromkeys(each.agent for each in found))
    if agent is not None and agent not in agents:
        raise ValueError(f"agent must be one of {', '.join(agents)}, not {agent!r}")
    if agent is None and len(agents) > 1:
        raise ValueError(f"agent must be given (--agent), one of {', '.join(agents)}: a law is of one")
    found = [each for each in found if agent is None or each.agent == agent]
    sizes = list(dict.fromkeys(str(each.argument("model_size")) for each in found))
    if model_size is not None and str(model_size) not in sizes:
        raise ValueError(f"model_size must be one of {', '.join(sizes)}, not {model_size!r}")
    if model_size is None and len(sizes) > 1:
        raise ValueError(
            f"model_size must be given (--size), one of {', '.join(sizes)}: fit_model_size is over several"
        )
    return [each for each in found if model_size is None or str(each.argument("model_size")) == str(model_size)]


def _hyperparameters(
    grid: list[Cell], level: float, stages: list[_Samples], draws: int, rng: np.random.Generator, notes: list[str]
) -> tuple[dict[str, Hyperparameter], dict[str, pd.DataFrame]]:
    """The laws, and the choices of all swept hyperparameters, some of which may have no law."""
    rows: dict[str, list[dict[str, object]]] = {}
    values: dict[str, list[list[np.ndarray]]] = {}
    for cell in grid:
        for stage, samples in enumerate(stages):
            for name, chosen in choose(cell, level, samples, draws, rng).items():
                if stage == 0:
                    rows.setdefault(name, []).append(summarize(cell, name, chosen[0]))
                    values.setdefault(name, []).append([])
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", RuntimeWarning)  # from samples without any choice
                    values[name][-1].append(np.nanmean(chosen, axis=(1, 2)))
    found = {}
    tables = {name: pd.DataFrame(rows[name]) for name in NAMES if name in rows}
    for name, table in tables.items():
        known = table["value"].notna().to_numpy()
        for row in table[~known].itertuples():
            notes.append(
                f"{name} on {row.task} at replay ratio {row.replay_ratio:g}: {level:g} is reached in {row.decided:.0%} "
                "of the draws only, no value is chosen"
            )
        spread = table[known].groupby("task")["replay_ratio"].nunique()
        if not len(spread) or spread.max() < 2:
            notes.append(f"{name} was chosen at one replay ratio only: it has no law")
            continue
        x = np.log(table["replay_ratio"].to_numpy(float)[known])
        groups, tasks = pd.factorize(table["task"][known])
        slopes, intercepts = [], []
        for stage in range(len(stages)):
            y = np.stack([each[stage] for each, there in zip(values[name], known, strict=True) if there], axis=1)
            # A sample that does not reach the level anywhere gets the mean of the other samples.
            y = np.where(np.isfinite(y), y, np.nanmean(y, axis=0))
            slope, intercept = shared_slope(x, groups, np.log(y))
            slopes.append(slope)
            intercepts.append(np.exp(intercept))
        found[name] = Hyperparameter(table, list(tasks), slopes, intercepts)
    return found, tables


def _pick(
    grid: list[Cell], hyperparameters: dict[str, Hyperparameter], chosen: dict[str, pd.DataFrame]
) -> dict[tuple[str, float], Cell]:
    """For each cell, a cell of only the configuration nearest to the laws."""
    # A hyperparameter without a law, for example swept at only one replay ratio, does not enter the distance.
    values = {name: [_values(cell, name) for cell in grid] for name in NAMES if name not in hyperparameters}
    common = {name: functools.reduce(np.intersect1d, of_cells) for name, of_cells in values.items()}
    picked = {}
    for cell in grid:
        distance = np.zeros(len(cell.members))
        for name, law in hyperparameters.items():
            own = cell.batch_sizes if name == "batch_size" else cell.learning_rates
            at = (
                law.law().value(cell.task, cell.replay_ratio)
                if cell.task in law.tasks
                else law.law().mean(cell.replay_ratio)
            )
            distance += np.abs(np.log(np.where(np.isfinite(own), own, at) / at))
        nearest = np.flatnonzero(distance <= distance.min() + 1e-9)
        for name, shared in common.items():
            nearest = _one_value(cell, name, nearest, shared, chosen.get(name))
        i = int(nearest[0])
        one = cell.members[i : i + 1]
        picked[cell.task, cell.replay_ratio] = Cell(
            cell.task, cell.replay_ratio, cell.batch_sizes[i : i + 1], cell.learning_rates[i : i + 1], one
        )
    return picked


def _values(cell: Cell, name: str) -> np.ndarray:
    """One value per configuration; -1 if its runs were not given one, which stands for the default."""
    return np.nan_to_num(cell.batch_sizes if name == "batch_size" else cell.learning_rates, nan=-1.0)


def _one_value(
    cell: Cell, name: str, members: np.ndarray, common: np.ndarray, chosen: pd.DataFrame | None
) -> np.ndarray:
    """Configurations with one value of a hyperparameter without a law: one that all cells have, else the best."""
    own = _values(cell, name)
    if np.isin(own[members], common).any():
        members = members[np.isin(own[members], common)]
    tried = np.unique(own[members])
    if len(tried) < 2:
        return members
    best = math.nan
    if chosen is not None:
        here = (chosen["task"] == cell.task) & (chosen["replay_ratio"] == cell.replay_ratio)
        best = float(chosen.loc[here, "value"].mean())
    given = tried[tried > 0]
    if math.isnan(best) or not len(given):
        raise ValueError(
            f"runs on {cell.task} at replay ratio {cell.replay_ratio:g} have {len(tried)} values of {name}, of which "
            "none could be chosen, and the data law is of one: give a level that they reach (choice_level=, "
            f"--choice-level), or runs of one {name} only"
        )
    return members[own[members] == given[np.abs(np.log(given / best)).argmin()]]


def _data(
    picked: dict[tuple[str, float], Cell],
    ratios: list[float],
    levels: np.ndarray,
    stages: list[_Samples],
    loss: str,
    across_levels: bool,
    repeat: int,
    notes: list[str],
) -> list[Level]:
    all_tasks = list(dict.fromkeys(task for task, _ in picked))
    tasks = [task for task in all_tasks if all((task, ratio) in picked for ratio in ratios)]
    if len(tasks) < len(all_tasks):
        without = [task for task in all_tasks if task not in tasks]
        notes.append(f"without runs at every replay ratio, and left out of the data law: {', '.join(without)}")
    if not tasks:
        raise ValueError("runs must be of at least one task at every replay ratio: the data law compares these")
    members = [[picked[task, ratio].members[0] for ratio in ratios] for task in tasks]
    last = np.array([[each.steps[-1] for each in row] for row in members], float) / repeat
    steps = [
        np.stack(
            [np.stack([each.reached(levels, samples[len(each.curves)]) for each in row], axis=1) for row in members],
            axis=1,
        )
        / repeat
        for samples in stages
    ]  # (R, tasks, S, L)
    x = np.array(ratios)
    found = []
    there = np.isfinite(steps[0][0])  # (tasks, S, L)
    # The median over the replay ratios exists if more than half reach the level.
    known = there.all(axis=1) if loss == "squared" else 2 * there.sum(axis=1) > len(ratios)  # (tasks, L)
    for i, level in enumerate(levels):
        reached, kept = there[:, :, i], known[:, i]
        enough = reached[kept].all(axis=0).sum() if kept.any() else 0
        if enough < 3:
            notes.append(
                f"level {level:g}: reached at {enough} of {len(ratios)} replay ratios by the tasks that have a median; "
                "a data law needs three, and there is none"
            )
            continue
        # Across levels, a level without a median would leave none.
        used = np.flatnonzero(known[kept].all(axis=0)) if across_levels else np.array([i])
        fits, means = [], []
        for each in steps:
            mean, bounded, factors = normalize(each[:, kept][..., used], last[kept], across_levels=across_levels)
            j = int(np.searchsorted(used, i))
            y = mean[:, :, j]
            fits.append(_fits(x, y, bounded[:, :, j], loss))
            means.append((y, bounded[:, :, j], factors[:, :, j]))
        found.append(
            Level(
                level=float(level),
                tasks=[task for task, has in zip(tasks, kept.tolist(), strict=True) if has],
                left_out=[task for task, has in zip(tasks, kept.tolist(), strict=True) if not has],
                points=means[0][0][0],
                censored=means[0][1][0],
                factors=means[0][2][0],
                laws=fits,
            )
        )
    if not found:
        raise ValueError(
            "levels must be reached at three replay ratios or more: none of "
            f"{', '.join(f'{level:g}' for level in levels)} is. {' '.join(notes)}"
        )
    return found


def _fits(ratios: np.ndarray, steps: np.ndarray, censored: np.ndarray, loss: str) -> DataLaw:
    """Laws (R,) of samples; NaN for samples without a median, or with only bounds."""
    law = DataLaw(*np.full((3, len(steps)), np.nan))
    known = np.isfinite(steps).all(axis=1) & ~censored.all(axis=1)
    if known.any():
        found = fit_logs(ratios, steps[known], censored[known]) if loss == "log" else fit_squared(ratios, steps[known])
        for all_of, own in zip(law, found, strict=True):
            all_of[known] = own
    return law
