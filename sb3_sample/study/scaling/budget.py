"""
Compute as a function of the replay ratio, its frontier with the environment steps, and the paper's three questions
("Value-Based Deep RL Scales Predictably", Rybkin et al. 2025, problems 3.1 and 3.2, equations 4.2, 4.5, A.4 and A.7).

All laws may hold arrays (R,) of R bootstrap samples instead of numbers; answers are then (R,), NaN where no answer
exists.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_sample.study.scaling.laws import DataLaw, HyperparameterLaw

#: FLOPs of a gradient step per parameter of the critics and row of the batch.
FLOPS = 10.0
#: Cost of an environment step in FLOPs (appendix B, DeepMind Control).
DELTA = 1e10
#: Range of the searched replay ratios, as logarithms.
_ENDS = (-25.0, 25.0)


class Point(NamedTuple):
    """
    A point on the frontier of a level.

    :param replay_ratio: gradient steps per environment step
    :param steps: environment steps
    :param compute: FLOPs
    """

    replay_ratio: Any
    steps: Any
    compute: Any


class ComputeLaw(NamedTuple):
    """
    FLOPs by replay ratio sigma: ``10 N B(sigma) sigma D(sigma)`` with ``B(sigma) = batch_size * sigma ** slope`` (4.2).

    :param data: law of the environment steps
    :param batch_size: at replay ratio 1, the mean over the tasks
    :param slope: of the batch size; 0 for the same batch size at all replay ratios
    :param critic_params: parameters N of the critics
    """

    data: DataLaw
    batch_size: Any
    slope: Any
    critic_params: float

    @classmethod
    def of(cls, data: DataLaw, batch_size: HyperparameterLaw | float, critic_params: float) -> "ComputeLaw":
        """
        :param data: law of the environment steps
        :param batch_size: its law, or one value for all replay ratios
        :param critic_params: parameters of the critics
        :return: the law
        :raises ValueError: a number is not positive
        """
        if not critic_params > 0:
            raise ValueError(f"critic_params must be a positive number, not {critic_params!r}")
        if isinstance(batch_size, HyperparameterLaw):
            return cls(data, float(np.mean(list(batch_size.intercepts.values()))), batch_size.slope, critic_params)
        if not batch_size > 0:
            raise ValueError(f"batch_size must be a positive number, not {batch_size!r}")
        return cls(data, float(batch_size), 0.0, critic_params)

    def at(self, replay_ratio: Any) -> Point:
        """
        :param replay_ratio: broadcast against the parameters
        :return: the point there
        """
        ratio = np.asarray(replay_ratio, float)
        if (ratio <= 0).any():
            raise ValueError(f"replay_ratio must be positive, not {replay_ratio!r}")
        steps = self.data.steps(ratio) if np.isfinite(ratio).all() else self._steps(ratio)
        return Point(
            replay_ratio, steps, FLOPS * self.critic_params * self.batch_size * ratio ** (1 + self.slope) * steps
        )

    def _steps(self, ratio: np.ndarray) -> Any:
        return self.data.d_min * (1 + (self.data.beta / ratio) ** self.data.alpha)

    def least(self) -> Any:
        """
        :return: replay ratio of the least compute; 0 if compute grows from the smallest replay ratio on. Below it both
            compute and steps fall with the replay ratio, so that nothing there is on the frontier; inf if they do so
            everywhere
        """
        grows, falls = 1 + self.slope, self.data.alpha - (1 + self.slope)
        with np.errstate(all="ignore"):
            found = self.data.beta * np.where(grows > 0, falls / grows, np.inf) ** (1 / self.data.alpha)
        found = np.where(np.asarray(grows) <= 0, np.inf, np.where(np.asarray(falls) <= 0, 0.0, found))
        return found[()]

    def most_data_efficient(self, compute: float) -> Point:
        """
        Find the fewest environment steps under a limit of compute: the largest replay ratio whose compute is within the
        limit (problem 3.1).

        :param compute: FLOPs
        :return: the point
        :raises ValueError: the limit is below the least compute that reaches the level, or is not a positive number
        """
        _check("compute", compute)
        floor = np.log(np.maximum(self.least(), np.exp(_ENDS[0])))
        shape = np.broadcast(floor, self.data.d_min, self.batch_size).shape
        low, high = np.broadcast_to(floor, shape), np.full(shape, _ENDS[1])
        impossible = ~np.isfinite(low) | (self.at(np.exp(np.where(np.isfinite(low), low, 0.0))).compute > compute)
        low = np.where(np.isfinite(low), low, _ENDS[1])
        for _ in range(80):
            middle = (low + high) / 2
            within = self.at(np.exp(middle)).compute <= compute
            low, high = np.where(within, middle, low), np.where(within, high, middle)
        if not shape and impossible:
            ratio = self.least()
            if not np.isfinite(ratio):
                raise ValueError(
                    "compute cannot be traded for steps here: both fall with the replay ratio, since the batch size "
                    "falls as fast as it rises"
                )
            least = self.at(max(float(ratio), float(np.exp(_ENDS[0])))).compute
            raise ValueError(
                f"compute must be at least {least:.4g} FLOPs, with which the level is reached at the replay ratio "
                f"{ratio:.4g}, not {compute:.4g}"
            )
        return self.at(np.where(impossible, np.nan, np.exp(low))[()])

    def cheapest(self, steps: float) -> Point:
        """
        Find the least compute under a limit of environment steps (problem 3.2; A.7, which is printed with the opposite
        sign).

        :param steps: environment steps
        :return: the point
        :raises ValueError: the limit is not above ``d_min``, or is not a positive number
        """
        _check("steps", steps)
        d_min, beta, alpha = self.data
        if np.ndim(d_min) == 0 and steps <= d_min:
            raise ValueError(
                f"steps must be above {d_min:.4g}, what the level takes at any replay ratio, not {steps:.4g}"
            )
        with np.errstate(all="ignore"):
            ratio = beta * (steps / d_min - 1) ** (-1 / alpha)
        found = np.maximum(np.where(np.asarray(steps) > d_min, ratio, np.nan), self.least())
        if np.ndim(d_min) == 0 and not np.isfinite(found):
            raise ValueError("steps limit nothing here: compute falls with the replay ratio without end")
        return self.at(np.where(np.isfinite(found), found, np.nan)[()])

    def best(self, delta: float = DELTA, ends: Sequence[float] | None = None) -> Point:
        """
        Find the least total C + δ D that reaches the level.

        :param delta: cost of an environment step in FLOPs
        :param ends: smallest and largest replay ratio; any if None
        :return: the point
        :raises ValueError: delta is not a positive number
        """
        _check("delta", delta)
        shape = np.broadcast(self.data.d_min, self.batch_size).shape
        low, high = (np.full(shape, end) for end in (_ENDS if ends is None else np.log(np.asarray(ends, float))))

        def total(log_ratio: np.ndarray) -> Any:
            point = self.at(np.exp(log_ratio))
            return point.compute + delta * point.steps

        # A sum of exponentials of log sigma, hence convex.
        for _ in range(120):
            left, right = low + (high - low) / 3, high - (high - low) / 3
            less = total(left) < total(right)
            low, high = np.where(less, low, left), np.where(less, right, high)
        middle = (low + high) / 2
        # The search ends somewhere even where there is no law.
        return self.at(np.exp(np.where(np.isfinite(total(middle)), middle, np.nan))[()])

    def frontier(self, low: float, high: float, n: int = 100) -> Point:
        """
        :param low: smallest replay ratio
        :param high: largest replay ratio
        :param n: number of points
        :return: the points from the least compute upwards, at logarithmically spaced replay ratios; arrays (m,)
        """
        if not 0 < low < high:
            raise ValueError(f"replay ratios must ascend from above 0, not {low}, {high}")
        first = max(low, min(float(self.least()), high))
        return self.at(np.geomspace(first, high, n))


class BudgetLaw(NamedTuple):
    """
    Best replay ratio by budget F = C + δ D: ``coefficient * F ** exponent`` (4.5).

    :param log_coefficient: natural logarithm of the coefficient, the replay ratio at a budget of one FLOP
    :param exponent: of the budget
    """

    log_coefficient: Any
    exponent: Any

    @property
    def coefficient(self) -> Any:
        """The replay ratio at a budget of one FLOP."""
        return np.exp(self.log_coefficient)

    def replay_ratio(self, budget: float | np.ndarray) -> Any:
        """
        :param budget: FLOPs
        :return: the replay ratio
        """
        return np.exp(self.log_coefficient + self.exponent * np.log(np.asarray(budget, float)))


def fit_budget(budget: Sequence[float] | np.ndarray, replay_ratio: Sequence[float] | np.ndarray) -> BudgetLaw:
    """
    Fit the best replay ratios of several levels against their budgets, by least squares of logarithms.

    :param budget: (..., L) FLOPs
    :param replay_ratio: (..., L)
    :return: the law, of shape (...); NaN for samples with a level without a law, or with all budgets equal
    :raises ValueError: no sample has two different budgets, or a number is not positive
    """
    budgets, ratios = np.asarray(budget, float), np.asarray(replay_ratio, float)
    if budgets.shape != ratios.shape or budgets.shape[-1:] < (2,):
        raise ValueError(f"budgets must be as many as replay ratios, at least two, not {budgets.shape}, {ratios.shape}")
    if (budgets <= 0).any() or (ratios <= 0).any():
        raise ValueError("budgets and replay ratios must be positive")
    x, y = np.log(budgets), np.log(ratios)
    centred = x - x.mean(axis=-1, keepdims=True)
    spread = (centred**2).sum(axis=-1)
    known = np.isfinite(spread) & (spread > 1e-12)
    if not known.any():
        raise ValueError("budgets must differ: an exponent cannot be had from one")
    exponent = (centred * y).sum(axis=-1) / np.where(known, spread, np.nan)
    return BudgetLaw((y.mean(axis=-1) - exponent * x.mean(axis=-1))[()], exponent[()])


def _check(name: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be a positive number, not {value!r}")
