"""Planned runs, recognised by the names and arguments of the runs that are there."""

import functools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from sb3_sample.study.plan import Run
from sb3_sample.study_list import ABSENT


def missing_runs(planned: Sequence[Run], runs: pd.DataFrame) -> list[Run]:
    """
    :param planned: runs of a plan
    :param runs: agent, arguments, task and seed of the runs that are there
    :return: the planned runs that are not there; the time taken grows with the number of runs, not with its square
    """
    arguments = _read(runs["arguments"].unique())
    grids: dict[str, set[tuple[str, ...]]] = {}
    for run in planned:
        grids.setdefault(run.agent, set()).add(tuple(run.grid))
    there = {
        (agent, task, seed, grid, _values(arguments[text], grid))
        for agent, text, task, seed in zip(runs["agent"], runs["arguments"], runs["task"], runs["seed"], strict=True)
        for grid in grids.get(agent, ())
    }
    return [
        run
        for run in planned
        if (run.agent, run.task, run.seed, tuple(run.grid), _values(run.grid, tuple(run.grid))) not in there
    ]


def namer(shown: Mapping[tuple[str, str], str]) -> Callable[[str, Run], list[str]]:
    """
    :param shown: agents as a report shows them, by their names in the sources and their arguments (JSON)
    :return: function of an agent's name in the sources and a planned run: the shown agents that the run is of. Several
        if the plan does not tell them apart; none if no run of its agent and place in the grid is there
    """
    arguments = _read(text for _, text in shown)
    by_name: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for (name, text), agent in shown.items():
        by_name.setdefault(name, []).append((agent, arguments[text]))

    @functools.cache
    def by_place(name: str, grid: tuple[str, ...]) -> dict[tuple[Any, ...], list[tuple[str, dict[str, Any]]]]:
        found: dict[tuple[Any, ...], list[tuple[str, dict[str, Any]]]] = {}
        for agent, given in by_name.get(name, ()):
            found.setdefault(_values(given, grid), []).append((agent, given))
        return found

    def agents(name: str, run: Run) -> list[str]:
        grid = tuple(run.grid)
        there = by_place(name, grid).get(_values(run.grid, grid), [])
        # A label may have brought agents with other arguments under one name.
        fitting = [agent for agent, given in there if _fits(run.arguments, given)]
        return list(dict.fromkeys(fitting or [agent for agent, _ in there]))

    return agents


def _read(texts: Iterable[str]) -> dict[str, dict[str, Any]]:
    return {text: json.loads(text) for text in texts}


def _values(arguments: Mapping[str, Any], names: Iterable[str]) -> tuple[Any, ...]:
    return tuple(_frozen(arguments.get(name, ABSENT)) for name in names)


def _fits(planned: Mapping[str, Any], given: Mapping[str, Any]) -> bool:
    return all(_frozen(given[name]) == _frozen(value) for name, value in planned.items() if name in given)


def _frozen(value: Any) -> Any:
    """A value in JSON's types as one that can be hashed; numbers are equal where they are in Python."""
    if isinstance(value, dict):
        return frozenset((str(name), _frozen(each)) for name, each in value.items())
    return tuple(map(_frozen, value)) if isinstance(value, (list, tuple)) else value
