"""Runs and agents that a report's numbers lack: missing, failed, or not evaluated."""

import dataclasses
from collections import Counter
from collections.abc import Iterator

from sb3_sample.study.plan import Run
from sb3_sample.study.reporting.pieces import counted
from sb3_sample.study.reporting.planned import namer
from sb3_sample.study.reporting.reading import Gathered
from sb3_sample.study.states import FAILED, STATES, RunStatus
from sb3_sample.study.table import RUN


def missing(gathered: Gathered) -> dict[tuple[str, str], list[int]]:
    """
    :param gathered: runs
    :return: seeds of the given plan's runs that are missing, by agent (with the grid's arguments) and task
    """
    found: dict[tuple[str, str], list[int]] = {}
    for run in gathered.missing:
        found.setdefault((run.label, run.task), []).append(run.seed)
    return found


def holes(gathered: Gathered) -> list[tuple[str, str]]:
    """
    :param gathered: runs
    :return: agents and tasks that have runs, but no evaluated one with each other
    """
    own = gathered.table[~gathered.table["agent"].isin(gathered.published)]
    there = set(zip(gathered.evaluated["agent"], gathered.evaluated["task"], strict=True))
    return [(a, t) for a in own["agent"].unique() for t in own["task"].unique() if (a, t) not in there]


def unevaluated(gathered: Gathered) -> int:
    """
    :param gathered: runs
    :return: number of the sources' runs in the table that have no evaluation
    """
    runs, evaluated = (
        table.loc[~table["agent"].isin(gathered.published), RUN].drop_duplicates()
        for table in (gathered.table, gathered.evaluated)
    )
    return len(runs) - len(evaluated)


def without_runs(gathered: Gathered) -> dict[str, str]:
    """
    :param gathered: runs
    :return: agents of the studies and of the given plan, with their place in the grid, of which no run is in the table,
        with the reason
    """
    agents_of = namer(gathered.shown)
    counts: dict[str, Counter[str]] = {}
    for name, each in _of_studies(gathered):
        if not agents_of(name, each.run):
            counts.setdefault(dataclasses.replace(each.run, agent=name).label, Counter())[each.state] += 1
    found = {agent: _reason(states) for agent, states in counts.items()}
    planned = Counter(run.label for run in gathered.missing if not agents_of(run.agent, run))
    for agent, n in planned.items():
        found.setdefault(agent, f"none of its {counted(n, 'planned run')} is here")
    return found


def _reason(states: Counter[str]) -> str:
    n = states.total()
    if states[FAILED] == n:
        return "its only run failed" if n == 1 else f"all of its {n:,} runs failed"
    rest = ", ".join(f"{states[state]} {state}" for state in STATES if states[state])
    return f"none of its {counted(n, 'run')} has been evaluated ({rest})"


def lost(gathered: Gathered, step: int) -> dict[str, Counter[str]]:
    """
    Count by agent the runs that have failed, or may have failed (planned, but not here), before a step and are in no
    average there: without its worst runs an agent looks better than it is.

    :param gathered: runs
    :param step: of the averages
    :return: numbers of runs by agent, "failed" and "planned"
    """
    ends = gathered.evaluated.groupby(["agent", "task", "seed"])["step"].max()
    agents_of = namer(gathered.shown)

    def counts(runs: Iterator[tuple[str, Run]]) -> Counter[str]:
        found: Counter[str] = Counter()
        for name, run in runs:
            for agent in agents_of(name, run):
                found[agent] += ends.get((agent, run.task, run.seed), -1) < step
        return +found

    failed = ((name, each.run) for name, each in _of_studies(gathered) if each.state == FAILED)
    return {"failed": counts(failed), "planned": counts((run.agent, run) for run in gathered.missing)}


def _of_studies(gathered: Gathered) -> Iterator[tuple[str, RunStatus]]:
    """Runs of the studies, with the name that their agents have in the table."""
    for state, label in zip(gathered.states, gathered.labels, strict=True):
        for each in state.runs:
            yield label or each.run.agent, each
