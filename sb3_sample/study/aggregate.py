"""
Scores over tasks and seeds, by rliable (Agarwal et al. 2021, "Deep reinforcement learning at the edge of the
statistical precipice"): interquartile mean, mean, median and optimality gap with stratified bootstrap intervals,
performance profiles and the probability of improvement.
"""

import contextlib
import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sb3_sample.envs.scores import SCORED, Score, score_of
from sb3_sample.envs.suites import DAC_NAMED
from sb3_sample.extras import install
from sb3_sample.run_settings import plain_id
from sb3_sample.study.table import RUN, plain_texts
from sb3_sample.study_list import ABSENT, word
from sb3_sample.warn import warn

#: Scores of tasks without a common score, or in place of it; the other tasks have ``score_of``.
Scores = Mapping[str, Score | float]
#: Groups of tasks: names in :data:`GROUPS`, or tasks by the group's name.
Groups = Sequence[str] | Mapping[str, Sequence[str]]

_DOGS = tuple(task for task in DAC_NAMED if task.startswith("dmc/dog-"))
#: Named groups of tasks.
GROUPS: dict[str, Callable[[str], bool]] = {
    "all": lambda task: True,
    "dmc": lambda task: task.startswith("dmc/"),
    "metaworld": lambda task: task.startswith("metaworld/"),
    "myosuite": lambda task: task.startswith("myosuite/"),
    "dog & humanoid": lambda task: task in DAC_NAMED,
    "dogs": lambda task: task in _DOGS,
    "dmc without dogs": lambda task: task.startswith("dmc/") and task not in _DOGS,
}
#: Groups of BRO's table 9, shown by default.
DEFAULT_GROUPS = ("all", "dmc", "metaworld", "myosuite", "dog & humanoid")
#: Bootstrap samples.
REPS = 2_000
#: Metrics of an evaluation, of which a task's score is one.
_MEASURED = ("return", "success_rate", "episode_length")
_STATISTICS = ("iqm", "mean", "median", "optimality_gap")


# ---------------------------------------------------------------- scores


def scored(table: pd.DataFrame, scores: Scores | None = None) -> pd.DataFrame:
    """
    Scores of a table's runs: the one metric that counts for each task, on a common scale for averaging over tasks.

    Returns of DeepMind Control divided by 1,000; success rates of Meta-World, MyoSuite and Fetch unchanged; returns of
    MuJoCo's HalfCheetah, Walker2d, Ant and Humanoid divided by 8,500, 4,500, 6,625 and 6,125. Nothing is clipped.

    :param table: of :func:`~sb3_sample.study.read`
    :param scores: of other tasks, by their ids: a :class:`Score`, or the return whose score is 1
    :return: columns agent, arguments, task, seed, step, score, sorted by step within a run, the runs in their order
    :raises ValueError: a task has no score, or its runs have not recorded the score's metric
    """
    parts, reasons = _by_task(table, scores)
    if reasons:
        raise ValueError(next(iter(reasons.values())))
    if not parts:
        raise ValueError("table must have returns or success rates of runs, and has none")
    columns = [*RUN, "step", "score"]
    found = plain_texts(pd.concat(parts)[columns].sort_index(kind="stable"))
    twice = found.duplicated([*RUN, "step"])
    if twice.any():
        row = found[twice].iloc[0]
        raise ValueError(
            f"table must have one value a run and step: there are two of {row['agent']}, {row['task']}, seed "
            f"{row['seed']} at {row['step']:,}"
        )
    if found["score"].isna().any():
        row = found[found["score"].isna()].iloc[0]
        raise ValueError(
            f"table must have numbers, not NaN, as of {row['agent']}, {row['task']}, seed {row['seed']} at "
            f"{row['step']:,}"
        )
    return found.reset_index(drop=True)


def warn_of_unknown(table: pd.DataFrame, scores: Scores | None) -> None:
    """
    Warn of scores that are of no task in the table, which have no effect.

    :param table: all that the scores are for
    :param scores: see :func:`scored`
    """
    if unknown := sorted({*map(plain_id, scores or {})} - {*table["task"]}):
        warn(f"scores has {', '.join(unknown)}, of which the table has no run: {', '.join(table['task'].unique())}")


def unscored(table: pd.DataFrame, scores: Scores | None = None) -> dict[str, str]:
    """
    :param table: of :func:`~sb3_sample.study.read`
    :param scores: see :func:`scored`
    :return: the tasks that :func:`scored` rejects, with the reason
    """
    return _by_task(table, scores)[1]


def score_for(task: str, scores: Scores | None = None) -> Score | None:
    """
    :param task: id of an environment
    :param scores: see :func:`scored`
    :return: its score, if it has one
    """
    given = {plain_id(name): score for name, score in (scores or {}).items()}.get(task)
    if given is None:
        return score_of(task)
    return given if isinstance(given, Score) else Score("return", float(given))


def _by_task(table: pd.DataFrame, scores: Scores | None) -> tuple[list[pd.DataFrame], dict[str, str]]:
    """Rows of each task with their scores, and the tasks without a score, with the reason."""
    named = {score.metric for score in (scores or {}).values() if isinstance(score, Score)}
    parts, reasons = [], {}
    for task, rows in table[table["metric"].isin({*_MEASURED, *named})].groupby("task", sort=False):
        score = score_for(task, scores)
        # A run that has recorded other metrics only, e.g. of training episodes, has not been evaluated yet.
        rows = rows[rows["metric"].isin([*_MEASURED, *([] if score is None else [score.metric])])]
        if not len(rows):
            continue
        if score is None:
            reasons[task] = (
                f"scores must say how {task} is scored: there is a common scale for {SCORED} only. Give the return "
                f"whose score is 1, scores={{{task!r}: 1000.0}} (--score {task}=1000), or Score(metric, high, low) "
                f"(--score {task}=LOW:HIGH)"
            )
            continue
        # With a single negative return, such as -150 over a low of 0, the worst run would have the highest score.
        if not (math.isfinite(score.high) and math.isfinite(score.low) and score.high > score.low):
            raise ValueError(
                f"scores must have a finite high above the low, not {score.low:g}:{score.high:g} of {task}: where "
                f"returns are negative give both, Score(metric, high, low) "
                f"(--score {task}=LOW:HIGH, as Pendulum-v1=-1500:-150)"
            )
        found = rows[rows["metric"] == score.metric]
        without = rows.merge(found[RUN].drop_duplicates(), how="left", indicator=True)
        without = without[without["_merge"] == "left_only"]
        if len(without):
            reasons[task] = (
                f"{task} is scored by {score.metric}, which the runs of {', '.join(without['agent'].unique())} there "
                "have not recorded; scores (--score) can name another metric"
            )
            continue
        parts.append(found.assign(score=score.of(found["value"])))
    return parts, reasons


def named_apart(table: pd.DataFrame) -> pd.DataFrame:
    """
    :param table: columns agent, arguments, task and any others
    :return: the same table, where agents whose arguments differ on the same task have these in their names
    """
    table = plain_texts(table)
    kinds = table[["agent", "task", "arguments"]].drop_duplicates()
    names: dict[tuple[str, str], str] = {}
    for agent, rows in kinds.groupby("agent", sort=False):
        differing = differing_arguments(rows)
        if differing:
            for text in rows["arguments"].unique():
                arguments = json.loads(text)
                words = ", ".join(f"{name}={word(arguments.get(name, ABSENT))}" for name in differing)
                names[agent, text] = f"{agent} ({words})"
    if not names:
        return table
    pairs = zip(table["agent"], table["arguments"], strict=True)
    return table.assign(agent=[names.get(pair, pair[0]) for pair in pairs])


def differing_arguments(runs: pd.DataFrame) -> list[str]:
    """
    :param runs: columns task and arguments
    :return: the arguments that differ between runs of the same task, sorted
    """
    differing: set[str] = set()
    for _, texts in runs.groupby("task")["arguments"]:
        found = [json.loads(text) for text in texts.unique()]
        names = set().union(*found)
        # As texts: true is not 1, and null is not absent.
        texts_of = (
            {json.dumps(each[name], sort_keys=True) if name in each else "" for each in found} for name in names
        )
        differing |= {name for name, texts in zip(names, texts_of, strict=True) if len(texts) > 1}
    return sorted(differing)


def group_tasks(groups: Groups | None, tasks: Sequence[str], in_table: Iterable[str] = ()) -> dict[str, list[str]]:
    """
    :param groups: names of :data:`GROUPS`, or tasks by name of the group; None for :data:`DEFAULT_GROUPS`
    :param tasks: to be grouped
    :param in_table: all tasks of the table, if some of them are not to be grouped, e.g. before their first evaluation
    :return: those of ``tasks`` in each group; groups without any are left out
    :raises ValueError: there is no such group, a task is not in the table, or no group has a task
    """
    if isinstance(groups, Mapping):
        unknown = sorted(set(itertools.chain(*groups.values())) - {*tasks, *in_table})
        if unknown:
            raise ValueError(f"groups must be of tasks in the table, not {', '.join(unknown)}")
        found = {name: [task for task in tasks if task in members] for name, members in groups.items()}
    else:
        names = DEFAULT_GROUPS if groups is None else [groups] if isinstance(groups, str) else groups
        for name in names:
            if name not in GROUPS:
                raise ValueError(f"groups must be of {', '.join(GROUPS)}, or tasks by name of the group, not {name!r}")
        found = {name: [task for task in tasks if GROUPS[name](task)] for name in names}
    if not any(found.values()):
        where = ", ".join(found) or "those that were chosen"
        raise ValueError(f"groups must have a task of the runs, and there is none in {where}")
    return {name: members for name, members in found.items() if members}


# ---------------------------------------------------------------- scores at common steps


def at_steps(scores: pd.DataFrame, steps: Sequence[int] | None) -> tuple[pd.DataFrame, list[int]]:
    """
    :param scores: of :func:`scored`
    :param steps: simulator steps; None for the evaluation steps that all runs share or, if they share none, those of
        the run with the fewest, within the range that all runs cover
    :return: one row per run, indexed by agent and task, and one column per step with the score there, linearly
        interpolated between two evaluations of the run, NaN before its first and after its last; and the steps
    :raises ValueError: there are no such steps
    """
    numbers = scores.groupby(RUN, sort=False, dropna=False).ngroup().to_numpy()
    order = np.lexsort((scores["step"], numbers))
    starts = np.flatnonzero(np.diff(numbers[order], prepend=-1))
    heads = scores[["agent", "task"]].iloc[order[starts]]
    runs = list(
        zip(
            np.split(scores["step"].to_numpy()[order], starts[1:]),
            np.split(scores["score"].to_numpy()[order], starts[1:]),
            strict=True,
        )
    )
    if steps is None:
        common = runs[0][0]
        for own, _ in runs[1:]:
            common = np.intersect1d(common, own)
        if not len(common):
            common = min((own for own, _ in runs), key=len)
            first, last = max(own[0] for own, _ in runs), min(own[-1] for own, _ in runs)
            common = common[(first <= common) & (common <= last)]
        if not len(common):
            raise ValueError("steps must be given: the runs do not overlap")
        steps = [int(step) for step in common]
    elif not len(steps) or any(step != int(step) or step < 0 for step in steps) or len(set(steps)) < len(steps):
        raise ValueError(f"steps must be whole numbers from 0 on, each once, not {list(steps)}")
    values = [np.interp(steps, own, score, left=np.nan, right=np.nan) for own, score in runs]
    matrix = pd.DataFrame(values, index=pd.MultiIndex.from_frame(heads), columns=list(steps))
    return matrix, [int(step) for step in steps]


def _warn_of_runs(matrix: pd.DataFrame) -> None:
    """Warn where an average is not over all runs."""
    for step in matrix:
        left_out = int(matrix[step].isna().sum())
        if left_out:
            warn(f"{left_out} of {len(matrix)} runs have no evaluations around step {step:,} and are left out there")


def _warn_of_tasks(matrix: pd.DataFrame, groups: Mapping[str, Sequence[str]]) -> None:
    """Warn where an average is not over the same tasks for all agents."""
    by_agent = {agent: set(rows.index.get_level_values("task")) for agent, rows in matrix.groupby("agent", sort=False)}
    for name, members in groups.items():
        counts = {agent: len(tasks & set(members)) for agent, tasks in by_agent.items() if tasks & set(members)}
        if any(by_agent[agent] & set(members) != set(members) for agent in counts):
            found = ", ".join(f"{agent} {n}" for agent, n in counts.items())
            warn(
                f"agents have not the same tasks of the {len(members)} of {name!r} ({found}): common=True (--common) "
                "compares them on those that all have"
            )


def _common_tasks(scores: pd.DataFrame) -> pd.DataFrame:
    tasks = [set(found) for _, found in scores.groupby("agent")["task"]]
    common = set.intersection(*tasks)
    if not common:
        raise ValueError("common: there is no task that all agents have")
    return scores[scores["task"].isin(common)]


def compared(
    scores: pd.DataFrame, steps: Sequence[int] | None, groups: Groups | None, common: bool, tasks: Iterable[str]
) -> tuple[pd.DataFrame, list[int], dict[str, list[str]]]:
    """
    :param scores: of :func:`scored`, agents named apart
    :param steps: see :func:`at_steps`
    :param groups: see :func:`group_tasks`
    :param common: whether to compare at each step only the tasks that all agents that reach it have in common; a
        warning names what is left out
    :param tasks: all tasks of the runs' table, with or without a score
    :return: the result of :func:`at_steps`, also NaN for tasks left out, and the tasks of each group
    :raises ValueError: there are no such steps, no run reaches one, or no task is left
    """
    # From all tasks, since a group may contain tasks that not all agents have.
    members = group_tasks(groups, list(scores["task"].unique()), tasks)
    if common:
        scores = _common_tasks(scores)
        kept = set(scores["task"])
        members = {name: [task for task in of_group if task in kept] for name, of_group in members.items()}
        members = {name: of_group for name, of_group in members.items() if of_group}
        if not members:
            raise ValueError("common: the groups have no task that all agents have")
    matrix, steps = at_steps(scores, steps)
    for step in steps:
        if matrix[step].isna().all():
            raise ValueError(f"steps must be within those of the runs, {_extent(scores)}, not {step:,}")
    _warn_of_runs(matrix)
    if common:
        for step in steps:
            matrix[step] = _common_at(matrix[step], step)
    return matrix, steps, members


def _common_at(values: pd.Series, step: int) -> pd.Series:
    """Values of the tasks that all agents that reach the step have in common, NaN for other tasks."""
    there = values.dropna().index.to_frame(index=False).drop_duplicates()
    n_agents = there.groupby("task")["agent"].nunique()
    common = n_agents[n_agents == there["agent"].nunique()].index
    if not len(common):
        raise ValueError(f"common: there is no task that all agents have at {step:,}")
    if len(common) < len(n_agents):
        warn(f"{len(common)} of {len(n_agents)} tasks are common to all agents at step {step:,}")
    return values.where(values.index.get_level_values("task").isin(common))


# ---------------------------------------------------------------- statistics


def blocks_of(rows: pd.DataFrame) -> list[np.ndarray]:
    """
    :param rows: rows of one agent, indexed by task; without NaN
    :return: arrays (runs, tasks, steps), one for all tasks with the same number of runs
    """
    values = {task: group.to_numpy() for task, group in rows.groupby("task", sort=False)}
    by_runs: dict[int, list[np.ndarray]] = {}
    for each in values.values():
        by_runs.setdefault(len(each), []).append(each)
    return [np.stack(by_runs[n], axis=1) for n in sorted(by_runs)]


def iqm(*blocks: np.ndarray) -> np.ndarray:
    """
    Interquartile mean over all runs of all tasks together: a quarter of them, rounded down, is cut at both ends. If
    tasks have different numbers of runs, runs are weighted as if repeated until all tasks have the same number.

    :param blocks: scores (runs, tasks, steps), each of different tasks
    :return: (steps,)
    """
    if len(blocks) == 1:
        scores = blocks[0].reshape(-1, blocks[0].shape[-1])
        first, last = len(scores) // 4, len(scores) - len(scores) // 4
        middle: np.ndarray = np.partition(scores, (first, last - 1), axis=0)[first:last]
        return middle.mean(axis=0)  # type: ignore[no-any-return]
    pooled = np.concatenate([block.reshape(-1, block.shape[-1]) for block in blocks])
    weights = np.concatenate([np.full(block.shape[0] * block.shape[1], 1 / block.shape[0]) for block in blocks])
    order = np.argsort(pooled, axis=0)
    pooled, weights = np.take_along_axis(pooled, order, axis=0), weights[order] / weights.sum()
    n = math.lcm(*(len(block) for block in blocks)) * sum(block.shape[1] for block in blocks)
    cut = n // 4 / n
    ends = np.cumsum(weights, axis=0)
    kept = np.clip(np.minimum(ends, 1 - cut) - np.maximum(ends - weights, cut), 0, None)
    return (kept * pooled).sum(axis=0) / kept.sum(axis=0)  # type: ignore[no-any-return]


def _of_tasks(*blocks: np.ndarray) -> np.ndarray:
    """Means over the runs of each task, (tasks, steps)."""
    return np.concatenate([block.mean(axis=0) for block in blocks])


def _all_statistics(*blocks: np.ndarray) -> np.ndarray:
    """``_STATISTICS`` by step, concatenated, as rliable expects for its intervals."""
    tasks = _of_tasks(*blocks)
    gap = 1 - _of_tasks(*(np.minimum(block, 1) for block in blocks)).mean(axis=0)
    return np.concatenate([iqm(*blocks), tasks.mean(axis=0), np.median(tasks, axis=0), gap])


@contextlib.contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Seed NumPy's global generator, which rliable draws from, and restore it afterwards."""
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(state)  # noqa: NPY002


def bootstrap(
    statistic: Callable[..., np.ndarray], blocks: Sequence[np.ndarray], reps: int, confidence: float, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Compute a statistic and its percentile interval with rliable's stratified bootstrap, which redraws the runs of each
    task.

    :param statistic: function of arrays (runs, tasks, steps) with values (n,)
    :param blocks: the arrays
    :param reps: bootstrap samples
    :param confidence: share of them in the interval
    :param seed: of the samples
    :return: statistic, lower and upper bound, (n,) each; the bounds are NaN if a task has only one run
    :raises ImportError: rliable is not installed
    """
    point = statistic(*blocks)
    # A single run is always redrawn as itself: its task would add nothing to the interval, however noisy its runs are.
    if any(len(block) < 2 for block in blocks):
        return point, np.full_like(point, np.nan), np.full_like(point, np.nan)
    library = _rliable()
    score = blocks[0] if len(blocks) == 1 else list(blocks)
    with _seeded(seed):
        _, intervals = library.get_interval_estimates(
            {"": score}, statistic, reps=reps, confidence_interval_size=confidence
        )
    low, high = intervals[""]
    return point, low, high


def _rliable() -> Any:
    try:
        import rliable.library
    except ImportError as error:  # also from its own imports, with another pandas
        raise ImportError(f"intervals need rliable ({error}). Install it with: {install('study')}") from error
    return rliable.library


def check_samples(reps: int, confidence: float) -> None:
    """
    :param reps: bootstrap samples
    :param confidence: of an interval
    :raises ValueError: one is out of range
    """
    if type(reps) is not int or reps < 1:
        raise ValueError(f"reps must be a whole number from 1 on, not {reps!r}")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, not {confidence!r}")


def _complete(rows: pd.DataFrame) -> Iterator[tuple[list[int], pd.DataFrame]]:
    """Runs of an agent by steps, where steps with the same runs are grouped; steps without runs are left out."""
    there = rows.notna()
    for _, steps in itertools.groupby(
        sorted(rows, key=lambda step: there[step].to_numpy().tobytes()),
        key=lambda step: there[step].to_numpy().tobytes(),
    ):
        found = list(steps)
        kept = rows.loc[there[found[0]].to_numpy(), found]
        if len(kept):
            yield found, kept


def aggregate(
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
    Aggregate scores of agents over tasks and seeds, at given steps or along the training.

    If the runs of an agent on one task have different arguments, they count as several agents, whose names include the
    differing arguments, e.g. "bro (replay_ratio=2)".

    :param table: of :func:`~sb3_sample.study.read`
    :param steps: simulator steps. A run's score at a step is its evaluation there, or the linear interpolation between
        two evaluations; runs that do not reach the step are left out there, with a warning. None: a curve, at the steps
        that all runs share
    :param groups: names of :data:`GROUPS`, or tasks by name of the group; None for :data:`DEFAULT_GROUPS`. Groups
        without a task in the table are left out
    :param scores: see :func:`scored`
    :param common: whether to average only over the tasks that all agents have, at each step over those of the agents
        that reach it
    :param reps: bootstrap samples
    :param confidence: of the intervals
    :param seed: of the bootstrap
    :return: one row per agent, group and step: ``agent``, ``group``, ``step``; ``iqm`` with its interval ``low`` and
        ``high``; ``mean``, ``median`` and ``optimality_gap`` with theirs (``mean_low``, ...); ``tasks`` and ``runs``,
        the numbers averaged over. Intervals are NaN if a task has only one run
    :raises ValueError: a task has no score, an argument is out of range, or no run reaches a step
    :raises ImportError: rliable is not installed
    """
    check_samples(reps, confidence)
    tasks_of_table = table["task"].unique()
    matrix, steps, members = compared(named_apart(scored(table, scores)), steps, groups, common, tasks_of_table)
    _warn_of_tasks(matrix, members)
    rows = []
    for agent, of_agent in matrix.groupby("agent", sort=False):
        for group, tasks in members.items():
            of_group = of_agent[of_agent.index.get_level_values("task").isin(tasks)]
            by_step: dict[int, dict[str, Any]] = {}
            for some, runs in _complete(of_group):
                estimates = np.stack(bootstrap(_all_statistics, blocks_of(runs), reps, confidence, seed))
                estimates = estimates.reshape(3, len(_STATISTICS), len(some))
                n_tasks = runs.index.get_level_values("task").nunique()
                for i, step in enumerate(some):
                    by_step[step] = _row(agent, group, step, estimates[:, :, i], n_tasks, len(runs))
            rows += [by_step[step] for step in steps if step in by_step]
    return pd.DataFrame(rows)


def _extent(scores: pd.DataFrame) -> str:
    return f"{scores['step'].min():,} to {scores['step'].max():,}"


def _row(agent: str, group: str, step: int, estimates: np.ndarray, tasks: int, runs: int) -> dict[str, Any]:
    row: dict[str, Any] = {"agent": agent, "group": group, "step": step}
    for name, (value, low, high) in zip(_STATISTICS, estimates.T, strict=True):
        prefix = "" if name == "iqm" else f"{name}_"
        row |= {name: value, f"{prefix}low": low, f"{prefix}high": high}
    return row | {"tasks": tasks, "runs": runs}


# ---------------------------------------------------------------- profiles and improvement


def performance_profiles(
    table: pd.DataFrame,
    step: int,
    thresholds: Sequence[float] | None = None,
    groups: Groups | None = None,
    *,
    scores: Scores | None = None,
    common: bool = False,
    reps: int = REPS,
    confidence: float = 0.95,
    seed: int = 0,
) -> pd.DataFrame:
    """
    Share of an agent's runs whose score is above a threshold, with equal weights of the tasks (rliable's score
    distribution).

    :param table: see :func:`aggregate`, also for the other arguments
    :param step: simulator step
    :param thresholds: scores; None for 0, 0.01, ..., 1
    :return: columns ``agent``, ``group``, ``step``, ``threshold``, ``share``, ``low``, ``high``
    """
    check_samples(reps, confidence)
    taus = np.linspace(0, 1, 101) if thresholds is None else np.asarray(thresholds, float)

    def profile(*blocks: np.ndarray) -> np.ndarray:
        above = [(block[:, :, :1] > taus).mean(axis=0) for block in blocks]
        shares: np.ndarray = np.concatenate(above).mean(axis=0)
        return shares

    parts = []
    for agent, group, runs in _at_step(table, step, groups, scores, common):
        share, low, high = bootstrap(profile, blocks_of(runs), reps, confidence, seed)
        values = {"threshold": taus, "share": share, "low": low, "high": high}
        parts.append(pd.DataFrame({"agent": agent, "group": group, "step": step, **values}))
    return pd.concat(parts, ignore_index=True)


def probability_of_improvement(
    table: pd.DataFrame,
    step: int,
    groups: Groups | None = None,
    *,
    pairs: Sequence[tuple[str, str]] | None = None,
    scores: Scores | None = None,
    reps: int = REPS,
    confidence: float = 0.95,
    seed: int = 0,
) -> pd.DataFrame:
    """
    Probability that a run of one agent scores higher than a run of another on the same task, averaged over the tasks
    that both have; a tie counts as a half (rliable's ``probability_of_improvement``).

    The bootstrap's interval is too narrow if tasks have few runs: with n runs it has (n - 1) / n of the variance. So
    there is also the p of a permutation test, which is valid with any number of runs.

    :param table: see :func:`aggregate`, also for the other arguments
    :param step: simulator step
    :param pairs: agents x and y; every pair once, in the table's order, if None
    :param reps: bootstrap samples, and permutations unless all are taken
    :return: columns ``x``, ``y``, ``group``, ``step``, ``probability``, ``low``, ``high``, ``p`` (two-sided, from
        exchanging runs between the two agents within each task) and ``tasks``. Intervals are NaN if a task has only one
        run of either agent
    :raises ValueError: an agent of a pair is not in the table, or the two have no task in common
    """
    check_samples(reps, confidence)
    by_group: dict[str, dict[str, pd.DataFrame]] = {}
    agents: list[str] = []
    for agent, group, runs in _at_step(table, step, groups, scores, None):
        by_group.setdefault(group, {})[agent] = runs
        agents += [] if agent in agents else [agent]
    for agent in itertools.chain(*(pairs or [])):
        if agent not in agents:
            raise ValueError(f"pairs must be of {', '.join(agents)}, not {agent!r}")
    rows = []
    for group, found in by_group.items():
        for x, y in itertools.combinations(agents, 2) if pairs is None else pairs:
            if x not in found or y not in found:
                continue
            ours, theirs = (
                {task: each[step].to_numpy() for task, each in found[agent].groupby("task", sort=False)}
                for agent in (x, y)
            )
            tasks = [task for task in ours if task in theirs]
            if not tasks:
                continue
            # Tasks with the same numbers of runs are grouped; the two agents are redrawn separately.
            alike: dict[tuple[int, int], list[str]] = {}
            for task in tasks:
                alike.setdefault((len(ours[task]), len(theirs[task])), []).append(task)
            arrays = [np.stack([side[t] for t in some], axis=1) for side in (ours, theirs) for some in alike.values()]
            probability, low, high = bootstrap(_improvement, arrays, reps, confidence, seed)
            rows.append(
                {
                    "x": x, "y": y, "group": group, "step": step, "probability": probability[0], "low": low[0],
                    "high": high[0], "p": _permutation_p(arrays, reps, seed), "tasks": len(tasks),
                }
            )  # fmt: skip
    if not rows:
        raise ValueError("pairs must be of agents that have a task in common at that step")
    return pd.DataFrame(rows)


def _improvement(*arrays: np.ndarray) -> np.ndarray:
    """
    :param arrays: (runs, tasks) of one agent, then of the other for the same tasks
    :return: (1,)
    """
    n = len(arrays) // 2
    shares = []
    for ours, theirs in zip(arrays[:n], arrays[n:], strict=True):
        difference = ours[:, None] - theirs[None]
        shares.append(((difference > 0) + (difference == 0) / 2).mean(axis=(0, 1)))
    return np.array([np.concatenate(shares).mean()])


def _permutation_p(arrays: Sequence[np.ndarray], reps: int, seed: int) -> float:
    """
    :param arrays: see :func:`_improvement`
    :param reps: permutations to draw if there are more than ``reps`` and :data:`REPS`; otherwise all are taken
    :param seed: of the permutations
    :return: probability that the probability of improvement is at least as far from a half, in either direction, if the
        two agents are equal, so that any run of a task could be either's
    """
    half = len(arrays) // 2
    pairs = [(np.concatenate([x, y]), len(x)) for x, y in zip(arrays[:half], arrays[half:], strict=True)]
    # Mann and Whitney: a sum of ranks is the number of pairs won, with ties as a half, plus a constant.
    ranks = [(pd.DataFrame(values).rank().to_numpy(), n) for values, n in pairs]
    n_tasks = sum(values.shape[1] for values, _ in ranks)
    weights = [1 / (n * (len(values) - n) * n_tasks) for values, n in ranks]
    middle = [n * (len(values) + 1) / 2 for values, n in ranks]
    observed = sum(
        w * (values[:n].sum(axis=0) - m).sum() for (values, n), w, m in zip(ranks, weights, middle, strict=True)
    )
    labelings = math.prod(math.comb(len(values), n) ** values.shape[1] for values, n in ranks)
    is_exact = labelings <= max(reps, REPS)
    sums = np.zeros(1 if is_exact else reps)
    rng = np.random.default_rng(seed)
    for (values, n), weight, mean in zip(ranks, weights, middle, strict=True):
        for of_task in values.T:
            if is_exact:
                chosen = np.array(list(itertools.combinations(of_task, n))).sum(axis=1)
                sums = (sums[:, None] + weight * (chosen - mean)).ravel()
            else:
                drawn = rng.permuted(np.tile(of_task, (reps, 1)), axis=1)[:, :n].sum(axis=1)
                sums += weight * (drawn - mean)
    extreme = int((np.abs(sums) >= abs(observed) - 1e-9).sum())
    # The actual labels count as one of the permutations, so that p is never 0.
    return extreme / len(sums) if is_exact else (extreme + 1) / (reps + 1)


def _at_step(
    table: pd.DataFrame, step: int, groups: Groups | None, scores: Scores | None, common: bool | None
) -> Iterator[tuple[str, str, pd.DataFrame]]:
    """
    The runs of each agent and group that reach a step.

    :param common: None if the tasks are compared pair by pair
    """
    tasks_of_table = table["task"].unique()
    matrix, _, members = compared(named_apart(scored(table, scores)), [step], groups, bool(common), tasks_of_table)
    _warn_of_tasks(matrix, {} if common is None else members)
    matrix = matrix.dropna()
    for group, tasks in members.items():
        in_group = matrix[matrix.index.get_level_values("task").isin(tasks)]
        for agent, runs in in_group.groupby("agent", sort=False):
            yield agent, group, runs
