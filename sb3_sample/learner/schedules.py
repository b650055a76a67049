"""Learning rates over the planned gradient steps."""

import math
from typing import NamedTuple

#: Kinds of schedules.
SCHEDULES = ("linear", "cosine")


class LearningRateSchedule(NamedTuple):
    """
    Learning rate as a function of the steps that an optimizer has taken: a linear warm-up from ``start`` to ``peak``,
    then a decay to ``end`` over the rest of the planned steps, and ``end`` from there on.

    :param kind: of the decay, "linear" or "cosine"
    :param peak: rate after the warm-up
    :param end: rate after the planned steps
    :param warm_up: steps of the warm-up
    :param start: rate of the first step, if there is a warm-up
    """

    kind: str
    peak: float
    end: float
    warm_up: int = 0
    start: float = 0.0

    def rate(self, n_taken: int, n_planned: int | None) -> float:
        """
        Compute the rate of a step.

        :param n_taken: steps that the optimizer has taken before
        :param n_planned: planned steps, warm-up included; None while they are not known: no decay
        :return: the rate
        """
        if n_taken < self.warm_up:
            return self.start + (self.peak - self.start) * n_taken / self.warm_up
        if n_planned is None:
            return self.peak
        progress = min((n_taken - self.warm_up) / max(n_planned - self.warm_up, 1), 1.0)
        left = 1 - progress if self.kind == "linear" else (1 + math.cos(math.pi * progress)) / 2
        return self.end + (self.peak - self.end) * left
