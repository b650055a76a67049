"""Section of a report on scaling laws."""

from collections.abc import Sequence

import numpy as np

from sb3_sample.study.reporting.pieces import N_COLORS, Agent, Cell, Figure, Line, Lines, Section, Table
from sb3_sample.study.scaling.page import beginning, limits, parts
from sb3_sample.study.scaling.result import Laws

#: Points of a line.
_POINTS = 60


def scaling(laws: Laws) -> Section:
    """
    :param laws: of ``sb3-sample scaling fit``
    :return: a section on the laws, with their limits
    """
    head = f"Laws of {', '.join(laws.tasks)}, {laws.seeds} seeds at least; sigma is the replay ratio. {beginning(laws)}"
    section = Section("scaling", "Scaling laws", [head, _figure(laws)])
    for part in parts(laws):
        rows: list[list[Cell]] = [list(map(str, row)) for row in part.table.itertuples(index=False)]
        section.parts.append(Table(part.title, list(part.table), rows))
        if part.words:
            section.parts.append(f"{part.words}.")
    section.parts += [f"Limit: {limit}." for limit in limits(laws)]
    return section


def _figure(laws: Laws) -> Figure:
    """Steps of each level and best values of each task by replay ratio, with their laws."""
    end = laws.replay_ratios[-1] * 1.05
    fine = np.linspace(laws.replay_ratios[0], end, _POINTS)
    looks = _looks([f"level {level.level:.0f}" for level in laws.levels])
    lines = []
    for level, agent in zip(laws.levels, looks, strict=True):
        lines.append(Line(agent, fine.tolist(), level.law().steps(fine).tolist()))
        lines += _dots(agent, laws.replay_ratios, level.points, level.censored)
    panels = [Lines("Steps to a level", "replay ratio", "environment steps", lines, end)]
    tasks = dict(zip(laws.tasks, _looks(laws.tasks, len(looks)), strict=True))
    for name, law in laws.hyperparameters.items():
        lines = []
        values = law.values.dropna(subset=["value"])
        for task in law.tasks:
            own = values[values["task"] == task]
            lines.append(Line(tasks[task], fine.tolist(), law.law().value(task, fine).tolist()))
            lines += _dots(tasks[task], own["replay_ratio"].to_numpy(), own["value"].to_numpy())
        panels.append(Lines(f"Best {name}", "replay ratio", name, lines, end))
    shown = looks + (list(tasks.values()) if laws.hyperparameters else [])
    bounds = ", of these lower bounds hollow triangles" if any(each.censored.any() for each in laws.levels) else ""
    return Figure("scaling", f"Laws (lines) and what they were fitted to (points{bounds})", panels, shown)


def _looks(names: Sequence[str], first: int = 0) -> list[Agent]:
    return [Agent(name, i % N_COLORS, i // N_COLORS, label=name) for i, name in enumerate(names, first)]


def _dots(agent: Agent, x: Sequence[float] | np.ndarray, y: np.ndarray, bounds: np.ndarray | None = None) -> list[Line]:
    """A line of one point has a marker."""
    hits = np.zeros(len(y), bool) if bounds is None else bounds
    return [Line(agent, [float(a)], [float(b)], bound=bool(hit)) for a, b, hit in zip(x, y, hits, strict=True)]
