"""Curves of single tasks, published curves beside them, and the look of each agent."""

import itertools
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import pandas as pd

from sb3_sample.plots import Curve, Run, summarize
from sb3_sample.run_settings import simulator_steps
from sb3_sample.study.aggregate import Scores, score_for
from sb3_sample.study.reporting.facts import spacing
from sb3_sample.study.reporting.pieces import BESIDE, N_COLORS, Agent, counted, distinct, range_text
from sb3_sample.study.reporting.published import chosen_curves, differences
from sb3_sample.study.reporting.reading import Gathered
from sb3_sample.study.table import RUN


class Curves(NamedTuple):
    """
    Curves of one task.

    :param task: id of the environment
    :param metric: the metric drawn
    :param own: curves of the table's agents by agent: mean and range over the runs that get farthest
    :param under_way: the other runs, by agent
    :param others: published curves
    """

    task: str
    metric: str
    own: dict[str, Curve]
    under_way: dict[str, list[Run]]
    others: list[Curve]


def task_curves(gathered: Gathered, task: str, scores: Scores | None, names: Sequence[str] | None) -> Curves:
    """
    :param gathered: runs
    :param task: id of the environment
    :param scores: see :func:`~sb3_sample.study.aggregate.scored`
    :param names: of published curves, see :func:`~sb3_sample.study.reporting.published.chosen_curves`
    :return: the task's curves
    """
    table = gathered.table[gathered.table["task"] == task]
    score = score_for(task, scores)
    metric = score.metric if score is not None and (table["metric"] == score.metric).any() else "return"
    if not (table["metric"] == metric).any():
        metric = "success_rate"
    own: dict[str, Curve] = {}
    under_way: dict[str, list[Run]] = {}
    for agent in gathered.agents:
        rows = table[(table["agent"] == agent) & (table["metric"] == metric)].sort_values("step", kind="stable")
        runs = [
            Run(agent, None, run["step"].to_numpy(), run["value"].to_numpy())  # type: ignore[arg-type]
            for _, run in rows.groupby(RUN, sort=False, dropna=False)
        ]
        if not runs:
            continue
        last = max(run.steps[-1] for run in runs)
        # Episodes of a training do not all end at the same step.
        there = [run.steps[-1] + spacing(run.steps) > last or run.steps[-1] == last for run in runs]
        if max(run.steps[0] for run in itertools.compress(runs, there)) > min(
            run.steps[-1] for run in itertools.compress(runs, there)
        ):  # Early in training, the first episode of one run may end after the last of another.
            farthest = next(i for i, run in enumerate(runs) if run.steps[-1] == last)
            there = [i == farthest for i in range(len(runs))]
        own[agent] = Curve(agent, summarize(list(itertools.compress(runs, there))))
        under_way[agent] = [run for run, far in zip(runs, there, strict=True) if not far]
    others = [*gathered.curves.get((task, metric), []), *chosen_curves(names, gathered.asked, task, metric)]
    return Curves(task, metric, own, under_way, others)


class Looks(NamedTuple):
    """
    Looks of agents, the same in all figures. A published agent has the colour of our agent of the same name, else its
    own colour.

    :param runs: looks of the table's agents, by name
    :param curves: looks of published curves, by algorithm, which may have the same name as an agent
    """

    runs: dict[str, Agent]
    curves: dict[str, Agent]


def dressed(gathered: Gathered, curves: Sequence[Curves]) -> Looks:
    """
    :param gathered: runs
    :param curves: curves of all tasks
    :return: looks
    """
    own = gathered.table[~gathered.table["agent"].isin(gathered.published)]
    repeats = _repeats(own)
    of_others: dict[str, list[tuple[Curves, Curve]]] = {}
    for each in curves:
        for curve in each.others:
            of_others.setdefault(curve.label, []).append((each, curve))
    looks = Looks({}, {})
    shorts = distinct(gathered.agents, BESIDE)
    of_ours: dict[str, int] = {}
    free = itertools.count()

    def dress(name: str, published: bool, label: str) -> Agent:
        base = name.partition(",")[0].partition(" (")[0].lower().replace(" ", "_")
        color = of_ours.pop(base) if published and base in of_ours else next(free)
        if not published:
            of_ours.setdefault(base, color)
        return Agent(name, color % N_COLORS, color // N_COLORS, published, label, shorts.get(name, name))

    for name in gathered.agents:
        if name not in gathered.published:
            looks.runs[name] = dress(name, False, name)
            continue
        base = name.removesuffix(", published")
        found = [(each, Curve(base, each.own[name].data, True)) for each in curves if name in each.own]
        words = _difference_words(found, repeats) if base in gathered.asked else _seeds_words(found)
        looks.runs[name] = dress(name, True, f"{name}: {words}")
    for name, found in of_others.items():
        looks.curves[name] = dress(name, True, f"{name}, published: {_difference_words(found, repeats)}")
    return looks


def _seeds_words(found: Sequence[tuple[Curves, Curve]]) -> str:
    return range_text({int(n) for _, curve in found for n in curve.data["n_seeds"]}, "seed")


def _difference_words(found: Sequence[tuple[Curves, Curve]], repeats: Mapping[str, set[int]]) -> str:
    """Seeds of a published curve over all its tasks, and differences in its measurement."""
    words = [_seeds_words(found)]
    notes = Counter(
        note
        for each, curve in found
        for note in differences(curve, each.task, each.metric, repeats.get(each.task, {1}))
    )
    for note, n in notes.items():
        everywhere = n == len(found)
        if note.removesuffix(" only") not in words:
            words.append(note if everywhere else f"{note} on {n} of {counted(len(found), 'task')}")
    return "; ".join(words)


def _repeats(table: pd.DataFrame) -> dict[str, set[int]]:
    """Action repeats of the runs of each task, including frames skipped by wrappers."""
    found: dict[str, set[int]] = {}
    for task, rows in table.groupby("task", sort=False):
        for text in rows["arguments"].unique():
            found.setdefault(task, set()).add(simulator_steps(json.loads(text)))
    return found
