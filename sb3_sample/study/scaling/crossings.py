"""
Steps at which runs reach a level: the first evaluation at which the return, averaged over the seeds and made
non-decreasing, is at least the level ("Value-Based Deep RL Scales Predictably", Rybkin et al. 2025, appendix D).
"""

import json
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sb3_sample import sac
from sb3_sample.run_settings import simulator_steps
from sb3_sample.study.aggregate import Scores, scored
from sb3_sample.warn import warn

#: Levels and returns are on a scale from 0 to this value.
SCALE = 1_000.0
#: Arguments of runs that enter the laws.
ARGUMENTS = ("replay_ratio", "batch_size", "learning_rate", "model_size")
#: A mean return this close to a level counts as reaching it, since sums of floats are not exact.
_CLOSE = 1e-9


def default_levels(low: float = 200.0, high: float = 800.0, n: int = 10) -> list[float]:
    """
    The authors' levels, which are closer together towards the highest: 1000 minus logarithmically spaced distances.

    :param low: lowest level
    :param high: highest, below 1000
    :param n: how many
    :return: ascending levels; by default 200, 314, 412, 496, 568, 630, 683, 728, 767, 800
    """
    if not 0 < low < high < SCALE or n < 2:
        raise ValueError(f"levels must ascend between 0 and 1000, at least two of them, not {low}, {high}, {n}")
    return [SCALE - float(gap) for gap in np.geomspace(SCALE - low, SCALE - high, n)]


def isotonic(values: Sequence[float] | np.ndarray) -> np.ndarray:
    """
    Isotonic regression with equal weights, by pooling adjacent violators.

    :param values: (T,)
    :return: (T,)
    """
    means: list[float] = []
    sizes: list[int] = []
    for value in np.asarray(values, float):
        mean, size = float(value), 1
        while means and means[-1] >= mean:
            before = sizes.pop()
            mean = (means.pop() * before + mean * size) / (before + size)
            size += before
        means.append(mean)
        sizes.append(size)
    return np.repeat(means, sizes)


def first_crossing(curves: np.ndarray, levels: np.ndarray, kept: np.ndarray | None = None) -> np.ndarray:
    """
    Number of the first evaluation at which the isotonic regression of a curve is at least a level.

    The points at which the regression is below a level are the shortest prefix with the least sum of (value - level),
    so that a cumulative sum replaces the regression.

    :param curves: (..., T) mean returns
    :param levels: (L,)
    :param kept: (..., T) evaluations that count; all if None
    :return: (..., L) integers, T for never
    """
    levels = np.asarray(levels, float)
    n = curves.shape[-1]
    if kept is None:
        sums = np.cumsum(curves, axis=-1)
        counts = np.broadcast_to(np.arange(1.0, n + 1), sums.shape)
    else:
        sums, counts = np.cumsum(np.where(kept, curves, 0.0), axis=-1), np.cumsum(kept, axis=-1, dtype=float)
    found = np.empty((*curves.shape[:-1], len(levels)), np.intp)
    for i, level in enumerate(levels):
        excess = sums - level * counts
        least = np.minimum(excess.min(axis=-1), 0.0)
        close = excess <= (least + _CLOSE * max(abs(level), 1.0))[..., None]
        # The empty prefix has the sum zero.
        found[..., i] = np.where(least >= -_CLOSE * max(abs(level), 1.0), 0, close.argmax(axis=-1) + 1)
    if kept is not None:
        number = np.where(kept, np.arange(n), n)
        following = np.minimum.accumulate(number[..., ::-1], axis=-1)[..., ::-1]
        following = np.concatenate([following, np.full((*following.shape[:-1], 1), n)], axis=-1)
        found = np.take_along_axis(following, found, axis=-1)
    return found


def kept_evaluations(steps: np.ndarray, curves: np.ndarray, resets: Sequence[float]) -> np.ndarray:
    """
    Select evaluations, without those after a reset at which the mean return has not yet recovered its value before the
    reset.

    :param steps: (T,) of the evaluations
    :param curves: (..., T) mean returns
    :param resets: steps of the resets, ascending. An evaluation at the step of a reset comes before it
    :return: (..., T)
    """
    kept = np.ones(curves.shape, bool)
    for i, reset in enumerate(resets):
        first = int(np.searchsorted(steps, reset, side="right"))
        if first == 0:
            continue
        end = len(steps) if i + 1 == len(resets) else int(np.searchsorted(steps, resets[i + 1], side="right"))
        # Before this reset, the curve may itself still be recovering from the previous one.
        before = np.where(kept[..., :first], np.arange(first), -1).max(axis=-1)
        value = np.take_along_axis(curves, np.maximum(before, 0)[..., None], axis=-1)
        back = np.maximum.accumulate(curves[..., first:end] >= value, axis=-1)
        kept[..., first:end] = back
    return kept


class Configuration(NamedTuple):
    """
    The runs of one agent with the same arguments on one task.

    :param agent: name
    :param arguments: JSON
    :param task: id of the environment
    :param steps: (T,) simulator steps of the evaluations that all seeds have
    :param curves: (n, T) returns of the seeds, from 0 to 1000
    :param resets: simulator steps at which the agent was reset, as far as the runs reach
    :param repeat: simulator steps per step of the agent
    """

    agent: str
    arguments: str
    task: str
    steps: np.ndarray
    curves: np.ndarray
    resets: tuple[float, ...] = ()
    repeat: int = 1

    def argument(self, name: str) -> Any:
        """
        :param name: of an argument
        :return: its value; None if the runs were not given it
        """
        return json.loads(self.arguments).get(name)

    def reached(self, levels: np.ndarray, samples: np.ndarray | None = None) -> np.ndarray:
        """
        Steps at which the mean over the seeds reaches levels.

        :param levels: (L,)
        :param samples: (..., m) numbers of the seeds to average; all of them once if None
        :return: (..., L), inf for never
        """
        if samples is None:
            samples = np.arange(len(self.curves))
        counts = np.zeros((samples.size // samples.shape[-1], len(self.curves)))
        rows = np.repeat(np.arange(len(counts)), samples.shape[-1])
        np.add.at(counts, (rows, samples.reshape(-1)), 1.0)
        return self.reached_by(levels, counts).reshape(*samples.shape[:-1], len(levels))

    def reached_by(self, levels: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """
        :param levels: (L,)
        :param counts: (R, n) how often each seed is in a sample
        :return: (R, L), inf for never
        """
        means = counts @ self.curves / counts.sum(axis=1, keepdims=True)
        kept = kept_evaluations(self.steps, means, self.resets) if self.resets else None
        number = first_crossing(means, levels, kept)
        found: np.ndarray = np.append(self.steps.astype(float), np.inf)[number]
        return found


def configurations(
    table: pd.DataFrame,
    *,
    scores: Scores | None = None,
    keep_after_reset: bool = False,
    resets: int | Sequence[int] | None = None,
) -> list[Configuration]:
    """
    Group the runs of a table by agent, arguments and task.

    :param table: see :func:`crossings`, also for the other arguments
    :return: the configurations in the order of the table
    """
    found = []
    rows = scored(table, scores)
    numbers = rows.groupby(["agent", "arguments", "task"], sort=False).ngroup().to_numpy()
    order = np.lexsort((rows["step"], rows["seed"], numbers))
    starts = np.flatnonzero(np.diff(numbers[order], prepend=-1))
    heads = rows[["agent", "arguments", "task"]].iloc[order[starts]].to_records(index=False)
    parts = (np.split(rows[name].to_numpy()[order], starts[1:]) for name in ("seed", "step", "score"))
    for (agent, arguments, task), seed, step, score in zip(heads, *parts, strict=True):
        steps, curves = _common(seed, step, score)
        n_steps = len(np.unique(step))
        if not len(steps):
            raise ValueError(
                f"the {len(curves)} runs of {agent} on {task} have no evaluation at a common step, and returns are "
                "averaged over the seeds first: give runs with evaluations at fixed steps"
            )
        if len(steps) < n_steps:
            warn(
                f"{n_steps - len(steps)} of {n_steps} evaluations of {agent} on {task} are not of all its "
                f"{len(curves)} runs and are left out"
            )
        given = json.loads(arguments)
        repeat = simulator_steps(given)
        at = () if keep_after_reset else _resets(agent, given, resets, repeat, int(steps[-1]))
        found.append(Configuration(agent, arguments, task, steps, curves * SCALE, at, repeat))
    return found


def _common(seeds: np.ndarray, steps: np.ndarray, scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    :param seeds: (m,) ascending
    :param steps: (m,) ascending for each seed
    :param scores: (m,)
    :return: (T,) steps that all seeds have, and the scores there, (seeds, T)
    """
    ends = np.flatnonzero(seeds[1:] != seeds[:-1]) + 1
    own, values = np.split(steps, ends), np.split(scores, ends)
    common = own[0]
    for each in own[1:]:
        if not np.array_equal(common, each):
            common = np.intersect1d(common, each)
    kept = [value[np.isin(step, common)] for step, value in zip(own, values, strict=True)]
    return common, np.stack(kept)


def _resets(
    agent: str, arguments: dict[str, Any], given: int | Sequence[int] | None, repeat: int, last: int
) -> tuple[float, ...]:
    """Simulator steps of the resets of a run, up to its last evaluation."""
    gradient_steps = arguments.get("reset_gradient_steps")
    if given is None and gradient_steps is not None:
        ratio = number(arguments.get("replay_ratio"))
        if ratio is None:
            raise ValueError("runs with reset_gradient_steps must have a replay_ratio, which says when the resets are")
        first, period = _warm_up(agent, arguments), max(gradient_steps / ratio, 1.0)
        return tuple(float(step) for step in np.arange(first + period, last / repeat + 1e-6, period) * repeat)
    if given is None:
        given = arguments.get("resets") or ()
    if isinstance(given, (int, float)):
        if given < 1:
            raise ValueError(f"resets must be at least one step apart, not {given!r}")
        return tuple(float(step) for step in np.arange(given * repeat, last + 1, given * repeat))
    return tuple(float(step * repeat) for step in sorted(given) if step * repeat <= last)


def _warm_up(agent: str, arguments: dict[str, Any]) -> float:
    """
    Transitions before the first gradient step: the run's argument, else the default of the class with the agent's name,
    else 0.
    """
    given = number(arguments.get("learning_starts"))
    if given is not None:
        return given
    of_name = {name.lower(): each for name, each in vars(sac).items() if isinstance(each, type)}
    of_name["dr_q"] = sac.DebiasedRQ  # not DrQ, which is "drq"
    named = of_name.get(agent.lower()) or of_name.get(re.sub(r"[\W_]", "", agent).lower())
    declared = getattr(named, "constructor_arguments", {})
    return float(declared["learning_starts"].default) if "learning_starts" in declared else 0.0


def number(value: Any) -> float | None:
    """
    :param value: an argument of a run: a number, or a model size as "0.55M"
    :return: the value as a number; None if it is not a number
    """
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, str):
        factor = {"k": 1e3, "M": 1e6, "B": 1e9}.get(value[-1:], 1.0)
        try:
            return round(float(value if factor == 1.0 else value[:-1]) * factor, 6)
        except ValueError:
            return None
    return None


def crossings(
    table: pd.DataFrame,
    levels: Sequence[float],
    *,
    scores: Scores | None = None,
    keep_after_reset: bool = False,
    resets: int | Sequence[int] | None = None,
) -> pd.DataFrame:
    """
    Find the environment steps at which runs reach levels of the return.

    Returns of the seeds are averaged first, evaluation by evaluation; isotonic regression over the evaluations then
    makes the mean non-decreasing; a level is reached at the first evaluation at which this mean is at least the level.
    Nothing is interpolated.

    :param table: of :func:`~sb3_sample.study.read`
    :param levels: on the scale from 0 to 1000, where 1000 is a score of 1 (:mod:`sb3_sample.envs.scores`)
    :param scores: of tasks without a common scale, as for :func:`~sb3_sample.study.aggregate`
    :param keep_after_reset: whether evaluations after a reset count even if the mean return has not yet recovered its
        value before the reset. They count in the authors' crossings, but not here by default
    :param resets: environment steps of the resets, or the steps between two; None to take them from the arguments of
        the runs (``resets``, ``reset_gradient_steps``), without resets if these are not given: an agent's default
        (BRO's) is not among the arguments of its runs. ``reset_gradient_steps`` are counted from ``learning_starts``
        on: the run's, else the default of the class with the agent's name ("bro_fast", "BRO Fast"), else 0
    :return: one row per configuration (agent, arguments, task) and level: ``agent``, ``arguments``, ``task``,
        ``replay_ratio``, ``batch_size``, ``learning_rate``, ``model_size`` as far as a run was given them, ``level``,
        ``step`` (simulator steps, NaN if the level is never reached), ``last_step`` (of the evaluations: a lower bound
        for a level that is never reached), ``runs``
    :raises ValueError: a level is out of range, or seeds have no evaluations in common
    """
    wanted = check_levels(levels)
    rows = []
    for each in configurations(table, scores=scores, keep_after_reset=keep_after_reset, resets=resets):
        given = json.loads(each.arguments)
        head = {"agent": each.agent, "arguments": each.arguments, "task": each.task}
        head |= {name: given[name] for name in ARGUMENTS if name in given}
        steps = each.reached(wanted)
        rows += [
            head | {"level": level, "step": _or_nan(step), "last_step": int(each.steps[-1]), "runs": len(each.curves)}
            for level, step in zip(levels, steps, strict=True)
        ]
    found = pd.DataFrame(rows)
    ordered = ["agent", "arguments", "task", *ARGUMENTS, "level", "step", "last_step", "runs"]
    return found[[name for name in ordered if name in found]]


def _or_nan(step: float) -> float:
    return step if math.isfinite(step) else math.nan


def check_levels(levels: Sequence[float]) -> np.ndarray:
    """
    :param levels: of the return
    :return: (L,)
    :raises ValueError: there are none, or one is not a positive number
    """
    found = np.asarray(levels, float).reshape(-1)
    if not len(found) or not np.isfinite(found).all() or (found <= 0).any():
        raise ValueError(f"levels must be positive numbers of the scale of 0 to 1000, at least one, not {levels!r}")
    return found


def sorted_levels(levels: Sequence[float]) -> Iterator[float]:
    """
    :param levels: of the return
    :return: the levels, ascending and without repeats
    """
    yield from sorted(set(map(float, levels)))
