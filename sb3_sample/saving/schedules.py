"""Schedules as tables of their values: what a function computes, without the function."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

#: Number of cells of equal width into which [0, 1] is divided at first.
CELLS = 1000
#: A cell is halved if the value in its middle is further than TOLERANCE from the line through its ends, in units of the
#: table's largest absolute value, and there are fewer than MAX_POINTS points.
TOLERANCE, MAX_POINTS = 1e-6, 20_000


class ScheduleTable:
    """
    A schedule that interpolates a table linearly, and stays at the first and last value outside of it.

    :param table: (2, n): the remaining progress, rising within [0, 1], and the schedule's values there
    """

    def __init__(self, table: np.ndarray):
        self.table = table

    def __call__(self, progress_remaining: float) -> float:
        return float(np.interp(progress_remaining, self.table[0], self.table[1]))

    def __repr__(self) -> str:
        shown = ", ".join(f"{progress:g}: {self(progress):g}" for progress in (1, 0.75, 0.5, 0.25, 0))
        return f"ScheduleTable({shown})"

    @classmethod
    def of(cls, schedule: Callable[[float], float]) -> "ScheduleTable":
        """
        Tabulate a schedule at 1,001 equidistant points, and at more where it bends or jumps in between: linear pieces
        are reproduced exactly, and a jump lies between two neighbouring floating-point numbers.

        :param schedule: a function of the remaining progress
        :return: its table
        :raises ValueError: if it has no finite value at one of the points
        """
        grid = [i / CELLS for i in range(CELLS + 1)]
        values = {progress: _value(schedule, progress) for progress in grid}
        allowed = TOLERANCE * max(map(abs, values.values()))
        cells = list(pairwise(grid))
        while cells and len(values) < MAX_POINTS:
            left, right = cells.pop()
            middle = (left + right) / 2
            if not left < middle < right:
                continue
            value = _value(schedule, middle)
            if abs(value - (values[left] + values[right]) / 2) > allowed:
                values[middle] = value
                cells += [(left, middle), (middle, right)]
        points = sorted(values)
        return cls(np.array([points, [values[point] for point in points]]))


def _value(schedule: Callable[[float], float], progress: float) -> float:
    try:
        value = float(schedule(progress))
    except Exception as error:
        raise ValueError(f"it has no value at {progress:g}: {type(error).__name__}: {error}") from error
    if not np.isfinite(value):
        raise ValueError(f"its value at {progress:g} is {value}")
    return value
