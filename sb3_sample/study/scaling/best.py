"""Best batch size and learning rate for each task and replay ratio (paper, D.1 and D.4)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from sb3_sample.study.aggregate import Scores
from sb3_sample.study.scaling.crossings import Configuration, check_levels, configurations, number
from sb3_sample.warn import warn

#: Bootstrap draws for each choice (K).
DRAWS = 100
#: Most values of one array at a time.
_CHUNK = 2**23
NAMES = ("batch_size", "learning_rate")


class Cell(NamedTuple):
    """
    All configurations of one task and replay ratio.

    :param task: id of the environment
    :param replay_ratio: gradient steps per environment step
    :param batch_sizes: one per configuration, NaN if its runs were not given one
    :param learning_rates: one per configuration, NaN if its runs were not given one
    :param members: the configurations
    """

    task: str
    replay_ratio: float
    batch_sizes: np.ndarray
    learning_rates: np.ndarray
    members: list[Configuration]

    def lines(self, name: str) -> list[np.ndarray]:
        """
        :param name: "batch_size" or "learning_rate"
        :return: for each value of the other hyperparameter, the numbers of the configurations that differ only in this
            one, at least two
        """
        own, other = self.batch_sizes, self.learning_rates
        if name == "learning_rate":
            own, other = other, own
        keys = np.nan_to_num(other, nan=-1.0)
        found = [np.flatnonzero(keys == key) for key in np.unique(keys)]
        return [each[np.argsort(own[each])] for each in found if len(each) > 1 and np.isfinite(own[each]).all()]


def cells(found: Sequence[Configuration]) -> list[Cell]:
    """
    :param found: configurations of one agent and size
    :return: the configurations by task and replay ratio, in the order of the tasks and sorted by replay ratio
    :raises ValueError: one has no replay ratio, or two differ in another argument
    """
    tasks = list(dict.fromkeys(each.task for each in found))
    by: dict[tuple[int, float], list[Configuration]] = {}
    for each in found:
        ratio = number(each.argument("replay_ratio"))
        if ratio is None or not ratio > 0:
            raise ValueError(
                f"runs must have been given a replay_ratio, a positive number; those of {each.agent} on {each.task} "
                f"have {each.argument('replay_ratio')!r}"
            )
        by.setdefault((tasks.index(each.task), ratio), []).append(each)
    cells = []
    for (task, ratio), members in sorted(by.items(), key=lambda item: item[0]):
        values = {name: np.array([_or_nan(number(each.argument(name))) for each in members], float) for name in NAMES}
        pairs = list(zip(*(np.nan_to_num(value, nan=-1.0) for value in values.values()), strict=True))
        if len(set(pairs)) < len(pairs):
            raise ValueError(
                f"runs on {tasks[task]} at replay ratio {ratio:g} have one batch size and learning rate and differ in "
                "another argument: give the runs of one agent (agent=, --agent) and size (model_size=, --size)"
            )
        cells.append(Cell(tasks[task], ratio, values["batch_size"], values["learning_rate"], members))
    return cells


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def choose(
    cell: Cell, level: float, samples: dict[int, np.ndarray], draws: int, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """
    Choose the hyperparameters of a cell for resampled seeds.

    :param cell: the cell
    :param level: of the return
    :param samples: numbers of the seeds of each sample, (R, m), by number of seeds
    :param draws: K, draws from each sample
    :param rng: of the draws
    :return: chosen values by hyperparameter, (R, K, lines), NaN where no value reaches the level; only hyperparameters
        of which the cell has several values. Ties give the mean of the tied values
    """
    lines = {name: cell.lines(name) for name in NAMES}
    used = sorted({int(i) for found in lines.values() for line in found for i in line})
    if not used:
        return {}
    reached = {i: _drawn(cell.members[i], level, samples[len(cell.members[i].curves)], draws, rng) for i in used}
    chosen = {}
    for name, found in lines.items():
        own = cell.batch_sizes if name == "batch_size" else cell.learning_rates
        values = []
        for line in found:
            steps = np.stack([reached[int(i)] for i in line], axis=-1)
            first = steps.min(axis=-1, keepdims=True)
            ties = (steps == first) & np.isfinite(first)
            with np.errstate(invalid="ignore"):
                values.append((ties * own[line]).sum(axis=-1) / ties.sum(axis=-1))
        if values:
            chosen[name] = np.stack(values, axis=-1)
    return chosen


def _drawn(
    member: Configuration, level: float, samples: np.ndarray, draws: int, rng: np.random.Generator
) -> np.ndarray:
    """Steps (R, K) of ``draws`` bootstrap draws of each sample."""
    n_samples, m = samples.shape
    own = len(member.curves)
    parts = []
    for rows in np.array_split(samples, max(1, n_samples * draws * member.curves.shape[1] // _CHUNK)):
        picked = np.take_along_axis(rows, rng.integers(0, m, (len(rows), draws * m)), axis=1)
        offset = np.arange(len(rows) * draws)[:, None] * own
        counts = np.bincount((picked.reshape(-1, m) + offset).reshape(-1), minlength=len(rows) * draws * own)
        steps = member.reached_by(np.array([level]), counts.reshape(-1, own).astype(float))
        parts.append(steps.reshape(len(rows), draws))
    return np.concatenate(parts)


def best_hyperparameters(
    table: pd.DataFrame,
    level: float,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    scores: Scores | None = None,
    keep_after_reset: bool = False,
    resets: int | Sequence[int] | None = None,
) -> pd.DataFrame:
    """
    Find the best batch size and learning rate for each task and replay ratio: in each of K bootstrap draws of the
    seeds, the batch size that reaches a level first at each learning rate, and the learning rate that does at each
    batch size; then the mean over draws and over the values of the other hyperparameter.

    A value that does not reach the level ranks after all values that do. If none does, there is no choice, and the draw
    is left out of the mean; the authors' code takes the smallest value there. Values that reach the level at the same
    evaluation are averaged.

    :param table: of :func:`~sb3_sample.study.read`, runs of one agent and size
    :param level: of the return, from 0 to 1000; the authors use the largest that they fit, 800
    :param draws: K
    :param seed: of the draws
    :param scores: as for :func:`crossings`
    :param keep_after_reset: as for :func:`crossings`
    :param resets: as for :func:`crossings`
    :return: columns ``task``, ``replay_ratio``, ``name``, ``value`` (NaN if fewer than half of the draws have a
        choice), ``std`` over the draws, ``decided`` (share of the draws with a choice) and ``edge`` (share of these
        whose choice is the smallest or largest value tried)
    :raises ValueError: no task and replay ratio has two batch sizes or learning rates, or no draw reaches the level
    """
    check_levels([level])
    if draws < 1:
        raise ValueError(f"draws must be at least 1, not {draws!r}")
    found = cells(configurations(table, scores=scores, keep_after_reset=keep_after_reset, resets=resets))
    rng = np.random.default_rng(seed)
    rows = []
    for cell in found:
        samples = {len(each.curves): np.arange(len(each.curves))[None] for each in cell.members}
        rows += [summarize(cell, name, values[0]) for name, values in choose(cell, level, samples, draws, rng).items()]
    if not rows:
        raise ValueError(
            "runs must have at least two batch sizes at one learning rate, or two learning rates at one batch size, "
            "on a task at a replay ratio"
        )
    summary = pd.DataFrame(rows)
    undecided = summary[summary["value"].isna()]
    if len(undecided) == len(summary):
        raise ValueError(f"level must be one that runs reach: {level:g} is reached in fewer than half of the draws")
    for row in undecided.itertuples():
        warn(
            f"{row.name} on {row.task} at replay ratio {row.replay_ratio:g}: the level {level:g} is reached in "
            f"{row.decided:.0%} of the draws only, and no value is chosen"
        )
    return summary


def summarize(cell: Cell, name: str, values: np.ndarray) -> dict[str, object]:
    """
    :param cell: the cell
    :param name: "batch_size" or "learning_rate"
    :param values: its choices, (K, lines)
    :return: a row of :func:`best_hyperparameters`
    """
    own = cell.batch_sizes if name == "batch_size" else cell.learning_rates
    decided = np.isfinite(values)
    ends = np.stack([own[line][[0, -1]] for line in cell.lines(name)])
    edge = (values == ends[:, 0]) | (values == ends[:, 1])
    share = float(decided.mean())
    enough = share >= 0.5
    by_draw = np.nanmean(values[decided.any(axis=1)], axis=1) if decided.any() else np.array([np.nan])
    return {
        "task": cell.task,
        "replay_ratio": cell.replay_ratio,
        "name": name,
        "value": float(np.nanmean(values)) if enough else np.nan,
        "std": float(by_draw.std()) if enough else np.nan,
        "decided": share,
        "edge": float(edge.sum() / decided.sum()) if decided.any() else np.nan,
    }
