"""Numbers of a report: averages, profiles and improvement of its runs, each computed once by ``aggregate.py``."""

import dataclasses
import itertools
import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sb3_sample.study.aggregate import (
    DEFAULT_GROUPS,
    Groups,
    Scores,
    aggregate,
    group_tasks,
    performance_profiles,
    probability_of_improvement,
    scored,
    unscored,
)
from sb3_sample.study.reporting.absent import without_runs
from sb3_sample.study.reporting.pieces import counted, one_line, range_text
from sb3_sample.study.reporting.reading import Gathered
from sb3_sample.study.table import RUN

#: Most points of a curve.
POINTS = 40
#: Most agents for comparing all pairs; with more agents, the best is compared with each other one.
ALL_PAIRS = 6


@dataclasses.dataclass
class Facts:
    """
    :param lacking: tasks without a score, with the reason
    :param reason: why there are no averages; empty if there are
    :param tasks: the tasks averaged over, of all agents together
    :param tasks_of: those of each agent at the last step
    :param n_scored: number of tasks with a score
    :param steps: steps at which averages are reported
    :param groups: of tasks, by name; profiles and improvement are of the first
    :param averages: result of :func:`~sb3_sample.study.aggregate` at ``steps``
    :param curves: the same along the training
    :param profiles: at the last step, of the first group; None without averages
    :param improvement: likewise, of pairs, the agent with the better average first; None with one agent
    :param all_pairs: whether all pairs are compared, not only those with the best agent
    :param left_out: agents without averages, with the reason
    :param notes: warnings
    :param confidence: of the intervals
    """

    lacking: dict[str, str]
    reason: str = ""
    tasks: list[str] = dataclasses.field(default_factory=list)
    tasks_of: dict[str, set[str]] = dataclasses.field(default_factory=dict)
    n_scored: int = 0
    steps: list[int] = dataclasses.field(default_factory=list)
    groups: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    averages: pd.DataFrame | None = None
    curves: pd.DataFrame | None = None
    profiles: pd.DataFrame | None = None
    improvement: pd.DataFrame | None = None
    all_pairs: bool = True
    left_out: dict[str, str] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)
    confidence: float = 0.95

    @property
    def step(self) -> int:
        """The step of profiles and improvement."""
        return self.steps[-1]

    @property
    def group(self) -> str:
        """The group of profiles and improvement."""
        return next(iter(self.groups))

    def at(self, step: int, group: str | None = None) -> pd.DataFrame:
        """
        :param step: one of ``steps``
        :param group: one of ``groups``; the first if None
        :return: the averages there, the highest first
        """
        assert self.averages is not None
        rows = self.averages[(self.averages["step"] == step) & (self.averages["group"] == (group or self.group))]
        return rows.sort_values("iqm", ascending=False, kind="stable")

    def number_of_tasks(self, group: str | None = None) -> tuple[str, bool]:
        """
        :param group: one of ``groups``; all tasks if None
        :return: number of tasks that an agent is averaged over at the last step, in words, and whether these are the
            same tasks for all agents
        """
        tasks = set(self.tasks if group is None else self.groups[group])
        own = [found & tasks for found in self.tasks_of.values() if found & tasks]
        return range_text(map(len, own), "task"), all(found == tasks for found in own)

    def why_no_pair(self, gathered: Gathered) -> str:
        """
        :param gathered: runs
        :return: why there is no improvement, in words
        """
        agents = list(self.at(self.step)["agent"])
        of_group = f" of the group {self.group}" if len(self.groups[self.group]) < len(self.tasks) else ""
        if len(agents) > 1:
            return f"no two agents have a task{of_group} in common"
        if set(gathered.agents) == set(agents) and not self.left_out:
            return "there is one agent"
        return f"only {one_line(agents[0])} has averages{of_group}"


def compute(
    gathered: Gathered,
    *,
    steps: Sequence[int] | None,
    groups: Groups | None,
    scores: Scores | None,
    all_tasks: bool,
    reps: int,
    confidence: float,
    seed: int,
) -> Facts:
    """
    :param gathered: runs
    :param steps: steps at which averages are reported; None for the last step that half of each agent's runs have
        reached
    :param groups: see :func:`~sb3_sample.study.aggregate`, as ``scores``, ``reps``, ``confidence`` and ``seed``
    :param scores: likewise
    :param all_tasks: whether to average each agent over all its tasks, not only over those that all agents have
    :param reps: bootstrap samples
    :param confidence: of the intervals
    :param seed: of the bootstrap
    :return: the numbers
    :raises ValueError: an argument is out of range, or no run reaches a step
    """
    measured = gathered.evaluated
    facts = Facts(unscored(measured, scores), confidence=confidence)
    rows = measured[~measured["task"].isin(list(facts.lacking))]
    if not len(rows):
        facts.reason = "No task of these runs has a score." if facts.lacking else "No run has been evaluated yet."
        return facts
    facts.n_scored = rows["task"].nunique()
    runs = scored(rows, scores).groupby(RUN, sort=False, dropna=False)["step"]
    ends = runs.agg(["min", "max", spacing]).reset_index()
    own = ends[~ends["agent"].isin(gathered.published)]
    if not len(own) and len(gathered.table[~gathered.table["agent"].isin(gathered.published)]):
        facts.reason = "No run has been evaluated yet."
        return facts
    facts.steps = sorted(steps) if steps else [_reached(own)]
    reaching = ends[(ends["min"] <= facts.step) & (ends["max"] >= facts.step)]
    if not len(reaching):
        raise ValueError(f"steps must be within those of the runs, up to {own['max'].max():,}, not {facts.step:,}")
    reaching = _comparable(reaching, ends, gathered, facts, all_tasks)
    facts.tasks = list(dict.fromkeys(reaching["task"]))
    facts.tasks_of = {agent: set(found) for agent, found in reaching.groupby("agent")["task"]}
    rows = rows.merge(reaching[RUN], on=RUN)
    agents = [agent for agent in gathered.agents if agent in set(reaching["agent"])]
    rows = rows.sort_values("agent", key=lambda names: names.map(agents.index), kind="stable")
    facts.groups = _groups(groups, facts.tasks, gathered.table["task"].unique())
    _leave_out(gathered, facts)
    grid = _grid(rows, int(reaching["min"].max()), facts.step)
    shared: dict[str, Any] = {"scores": scores, "reps": reps, "confidence": confidence, "seed": seed}
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", UserWarning)
        # Separate, so that the numbers equal those of "study aggregate": samples depend on the number of steps.
        facts.averages = aggregate(rows, facts.steps, facts.groups, **shared)
        facts.curves = aggregate(rows, grid, facts.groups, **shared)
        first = {facts.group: facts.groups[facts.group]}
        best = list(facts.at(facts.step)["agent"])
        facts.profiles = performance_profiles(rows, facts.step, groups=first, **shared)
        facts.all_pairs = len(best) <= ALL_PAIRS
        pairs = itertools.combinations(best, 2) if facts.all_pairs else ((best[0], other) for other in best[1:])
        members = set(facts.groups[facts.group])
        chosen = [(x, y) for x, y in pairs if facts.tasks_of[x] & facts.tasks_of[y] & members]
        if chosen:
            facts.improvement = probability_of_improvement(rows, facts.step, first, pairs=chosen, **shared)
    facts.notes += dict.fromkeys(str(warning.message) for warning in told)
    return facts


def spacing(steps: Any) -> int:
    """
    :param steps: of a run's evaluations, increasing
    :return: steps between its last two evaluations; 0 if there is only one
    """
    last = np.asarray(steps)[-2:]
    return int(last[-1] - last[0])


def _reached(ends: pd.DataFrame) -> int:
    """Last step that half of the runs of each agent have reached, or will reach by their next evaluation."""
    halves = ends.groupby("agent")["max"].apply(lambda last: sorted(last)[len(last) // 2])
    step = int(halves.min())
    # Episodes of a training do not all end at the same step.
    near = ends[(ends["max"] < step) & (ends["max"] + ends["spacing"] > step)]
    return int(min([step, *near["max"]]))


def _comparable(
    reaching: pd.DataFrame, ends: pd.DataFrame, gathered: Gathered, facts: Facts, all_tasks: bool
) -> pd.DataFrame:
    """Runs on the tasks that all our agents have; agents of others are included if they have all these tasks."""
    tasks = {agent: set(found) for agent, found in reaching.groupby("agent")["task"]}
    ours = [agent for agent in gathered.agents if agent in tasks and agent not in gathered.published]
    for agent in ends["agent"].unique():
        if agent not in tasks:
            facts.left_out[agent] = f"no run of it was evaluated around {facts.step:,} steps"
    if all_tasks or not ours:
        return reaching
    common = set.intersection(*(tasks[agent] for agent in ours))
    if not common:
        facts.notes.append("There is no task that all agents have reached that step on: each is averaged over its own.")
        return reaching
    for agent in tasks:
        if not common <= tasks[agent]:
            facts.left_out[agent] = f"it has {len(tasks[agent] & common)} of the {counted(len(common), 'task')}"
    return reaching[reaching["task"].isin(common) & ~reaching["agent"].isin(list(facts.left_out))]


def _leave_out(gathered: Gathered, facts: Facts) -> None:
    """Name the other agents without an average: not evaluated, without a score, or without any run."""
    evaluated = set(gathered.evaluated["agent"])
    averaged = set().union(*facts.groups.values())
    for agent in gathered.agents:
        if facts.tasks_of.get(agent, set()) & averaged or agent in facts.left_out:
            continue
        if agent not in evaluated:
            facts.left_out[agent] = "no run of it has been evaluated"
        elif agent not in facts.tasks_of:
            facts.left_out[agent] = "none of its tasks has a score"
        else:
            facts.left_out[agent] = "it has no task of the groups"
    facts.left_out |= without_runs(gathered)


def _groups(groups: Groups | None, tasks: list[str], in_table: Iterable[str]) -> dict[str, list[str]]:
    """The groups; of the default groups, those that contain all tasks are left out, except the first."""
    found = group_tasks(groups, tasks, in_table)
    if groups is None:
        all_of_them = found[DEFAULT_GROUPS[0]]
        found = {name: each for name, each in found.items() if name == DEFAULT_GROUPS[0] or each != all_of_them}
    return found


def _grid(rows: pd.DataFrame, first: int, last: int) -> list[int]:
    """Steps of a curve, chosen from the evaluations of all runs."""
    steps = np.unique(rows["step"])
    steps = steps[(first <= steps) & (steps <= last)]
    if len(steps) > POINTS:
        steps = steps[np.unique(np.linspace(0, len(steps) - 1, POINTS).round().astype(int))]
    return [int(step) for step in steps]
