"""
Scaling laws: batch size and learning rate by replay ratio, environment steps by replay ratio and model size
("Value-Based Deep RL Scales Predictably", Rybkin et al. 2025, "paper" below; "Compute-Optimal Scaling for Value-Based
Deep RL", Fu et al. 2025, "follow-up").
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

#: Range of searched exponents.
ALPHA = (0.02, 20.0)
#: How far the smaller of the two terms of the data law may fall below the steps, as a logarithm; the data do not show
#: it then.
_FAR = 12.0
_GRID_ALPHA, _GRID_BETA = 40, 60
_ITERATIONS = 200


# ---------------------------------------------------------------- batch size and learning rate


class HyperparameterLaw(NamedTuple):
    """
    Best value of a hyperparameter by replay ratio sigma: ``intercepts[task] * sigma ** slope``.

    :param slope: shared by all tasks
    :param intercepts: value at sigma = 1 by task
    """

    slope: float
    intercepts: dict[str, float]

    def value(self, task: str, replay_ratio: float | np.ndarray) -> Any:
        """
        :param task: a task of the fit
        :param replay_ratio: any shape
        :return: the value, same shape
        """
        if task not in self.intercepts:
            raise ValueError(f"task must be one of the fit, {', '.join(self.intercepts)}, not {task!r}")
        return self.intercepts[task] * _positive(replay_ratio, "replay_ratio") ** self.slope

    def mean(self, replay_ratio: float | np.ndarray) -> Any:
        """
        :param replay_ratio: any shape
        :return: the arithmetic mean over the tasks, same shape
        """
        return np.mean(list(self.intercepts.values())) * _positive(replay_ratio, "replay_ratio") ** self.slope


def fit_hyperparameter(values: pd.DataFrame) -> HyperparameterLaw:
    """
    Fit a power law with one slope for all tasks and an intercept for each, by least squares of logarithms (paper, C.1
    and C.2; the multiplicative form of its tables).

    :param values: columns ``task``, ``replay_ratio``, ``value``; rows without a value are left out
    :return: the law. With one task nothing is shared
    :raises ValueError: a column is missing, a number is not positive, or no task has two replay ratios
    """
    missing = {"task", "replay_ratio", "value"} - set(values)
    if missing:
        raise ValueError(
            f"values must have columns task, replay_ratio and value; missing: {', '.join(sorted(missing))}"
        )
    rows = values.dropna(subset=["value"])
    if not len(rows):
        raise ValueError("values must have at least one row with a value")
    ratios, found = _positive(rows["replay_ratio"], "replay_ratio"), _positive(rows["value"], "value")
    tasks, names = pd.factorize(rows["task"])
    slope, intercepts = shared_slope(np.log(ratios), tasks, np.log(found)[None])
    return HyperparameterLaw(float(slope[0]), dict(zip(names, map(float, np.exp(intercepts[0])), strict=True)))


def shared_slope(x: np.ndarray, groups: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Least squares with one slope and an intercept per group.

    :param x: (m,)
    :param groups: (m,) integers from 0 on
    :param y: (R, m)
    :return: slopes (R,), intercepts (R, groups)
    :raises ValueError: no group has two values of x
    """
    member = (groups[:, None] == np.arange(groups.max() + 1)).astype(float)
    sizes = member.sum(axis=0)
    x_mean, y_mean = x @ member / sizes, y @ member / sizes
    centred = x - x_mean[groups]
    spread = centred @ centred
    if not spread > 1e-12:
        raise ValueError("replay_ratio must have at least two values on one task: a slope cannot be had from one")
    slopes = (y - y_mean[:, groups]) @ centred / spread
    return slopes, y_mean - slopes[:, None] * x_mean


# ---------------------------------------------------------------- data


class DataLaw(NamedTuple):
    """
    Environment steps by replay ratio sigma: ``d_min * (1 + (beta / sigma) ** alpha)`` (paper, D.5).

    The authors' code fits ``c + (sigma / b) ** -a`` and prints it as ``c * (1 + (sigma / b) ** -a)``; the two are equal
    with ``beta = b * c ** (-1 / a)`` in place of ``b``, which is the form used here.

    :param d_min: steps at infinite replay ratio; a number, or (R,) of R laws
    :param beta: replay ratio at which twice as many steps are needed
    :param alpha: exponent
    """

    d_min: Any
    beta: Any
    alpha: Any

    def steps(self, replay_ratio: float | np.ndarray) -> Any:
        """
        :param replay_ratio: broadcast against the parameters
        :return: environment steps
        """
        return self.d_min * (1 + (self.beta / _positive(replay_ratio, "replay_ratio")) ** self.alpha)

    def doubts(self, replay_ratio: Sequence[float] | np.ndarray) -> list[str]:
        """
        :param replay_ratio: replay ratios of the fit
        :return: doubts about parameters that they did not determine, in words
        """
        return [words for words, _ in self._doubts(replay_ratio)]

    def undetermined(self, replay_ratio: Sequence[float] | np.ndarray) -> set[str]:
        """
        :param replay_ratio: replay ratios of the fit
        :return: names of the parameters that they did not determine
        """
        return {name for _, names in self._doubts(replay_ratio) for name in names}

    def _doubts(self, replay_ratio: Sequence[float] | np.ndarray) -> list[tuple[str, tuple[str, ...]]]:
        """Doubts in words, each with the names of the parameters concerned."""
        found: list[tuple[str, tuple[str, ...]]] = []
        ratios = _positive(replay_ratio, "replay_ratio")
        if not ALPHA[0] * 1.01 < self.alpha < ALPHA[1] * 0.99:
            found.append((f"alpha is at the end of what is searched, {ALPHA[0]} to {ALPHA[1]}", ("alpha",)))
        falling = (self.beta / ratios) ** self.alpha
        if falling.min() > 20:
            # For a pure power law only the product d_min * beta ** alpha is known.
            words = "d_min and beta are not determined: at the largest replay ratio steps still fall as a power of it"
            found.append((words, ("d_min", "beta")))
        if falling.max() < 0.02:
            words = "alpha and beta are not determined: the steps hardly depend on the replay ratio"
            found.append((words, ("alpha", "beta")))
        return found


def fit_data(
    replay_ratio: Sequence[float] | np.ndarray,
    steps: Sequence[float] | np.ndarray,
    loss: str = "log",
    *,
    alpha: float | None = None,
    censored: Sequence[bool] | np.ndarray | None = None,
) -> DataLaw:
    """
    Fit the environment steps needed for a level, by replay ratio.

    The least squares of logarithms are found on a grid of ``alpha`` and ``beta``, then by damped Gauss-Newton steps
    (the paper uses L-BFGS; the minimum is the same). With "squared" the law is linear in the other two parameters for
    each ``alpha``, which is searched on a grid and then refined, so that the minimum is global.

    :param replay_ratio: (S,)
    :param steps: (S,) environment steps, or any multiple of them
    :param loss: "log" for squared differences of logarithms, as in the paper, or "squared" for those of the steps
        themselves, as in the authors' code
    :param alpha: exponent, if it is known
    :param censored: (S,) where the level was not reached and ``steps`` has the last step tried: a law above it has no
        error there. Only with "log"
    :return: the law; :meth:`DataLaw.doubts` lists what is not determined
    :raises ValueError: fewer different replay ratios that reach the level than parameters, or numbers that are not
        positive and finite
    """
    ratios = _positive(replay_ratio, "replay_ratio").reshape(-1)
    values = np.asarray(steps, float).reshape(-1)
    if len(values) != len(ratios):
        raise ValueError(f"steps must be as many as replay ratios, {len(ratios)}, not {len(values)}")
    if not np.isfinite(values).all():
        raise ValueError(
            "steps must be finite: for a level that was not reached give the steps that were made, and censored=True "
            f"there, not {values.tolist()}"
        )
    _positive(values, "steps")
    bounds = np.zeros(len(values), bool) if censored is None else np.asarray(censored, bool).reshape(-1)
    if bounds.shape != values.shape:
        raise ValueError(f"censored must be as many as steps, {len(values)}, not {len(bounds)}")
    if alpha is not None and not (np.isfinite(alpha) and alpha > 0):
        raise ValueError(f"alpha must be a positive number, not {alpha!r}")
    needed = 3 if alpha is None else 2
    n = len(np.unique(ratios[~bounds]))
    if n < needed:
        raise ValueError(
            f"replay_ratio must have at least {needed} values at which the level is reached, for as many parameters, "
            f"not {n}"
        )
    if loss == "squared":
        if bounds.any():
            raise ValueError("censored is of loss='log' only: a squared error of steps has no such side")
        found = fit_squared(ratios, values[None], alpha)
    elif loss == "log":
        found = fit_logs(ratios, values[None], bounds[None], alpha)
    else:
        raise ValueError(f"loss must be 'log' or 'squared', not {loss!r}")
    return DataLaw(*(float(each[0]) for each in found))


def fit_logs(
    ratios: np.ndarray, steps: np.ndarray, censored: np.ndarray | None = None, alpha: float | None = None
) -> DataLaw:
    """
    Do many fits of :func:`fit_data` at once, with loss "log".

    :param ratios: (S,)
    :param steps: (R, S)
    :param censored: (R, S)
    :param alpha: exponent, if it is known
    :return: laws, (R,)
    """
    logs, x = np.log(steps), np.log(ratios)
    bound = np.zeros(logs.shape, bool) if censored is None else censored
    theta = _start(x, logs, bound, alpha)
    low, top = logs.min(axis=1) - _FAR, logs.max(axis=1) + _FAR
    free = slice(0, 3 if alpha is None else 2)

    def evaluate(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals and their Jacobian for steps = exp(t0) + exp(t1 - exp(t2) x)."""
        first, rate = theta[:, :1], np.exp(theta[:, 2:])
        second = theta[:, 1:2] - rate * x
        model = np.logaddexp(first, second)
        share = np.exp(second - model)
        residual = model - logs
        idle = bound & (residual > 0)
        jacobian = np.stack([1 - share, share, -share * rate * x], axis=2)
        jacobian[idle] = 0
        residual = np.where(idle, 0.0, residual)
        return residual, jacobian[:, :, free], (residual**2).sum(axis=1)

    damping = np.full(len(theta), 1e-2)
    residual, jacobian, error = evaluate(theta)
    for _ in range(_ITERATIONS):
        normal = np.einsum("rsi,rsj->rij", jacobian, jacobian)
        gradient = np.einsum("rsi,rs->ri", jacobian, residual)
        size = normal.shape[1]
        diagonal = np.einsum("rii->ri", normal) + 1e-12
        damped = normal + (damping[:, None] * diagonal)[:, :, None] * np.eye(size)
        change = -np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        new = theta.copy()
        new[:, free] += np.clip(change, -2, 2)
        new[:, :2] = np.clip(new[:, :2], low[:, None], None)
        new[:, 0] = np.minimum(new[:, 0], top)
        if alpha is None:
            new[:, 2] = np.clip(new[:, 2], math.log(ALPHA[0]), math.log(ALPHA[1]))
        found = evaluate(new)
        better = found[2] <= error
        moved = np.abs(new - theta).max(axis=1)
        gained = error - found[2]
        theta[better] = new[better]
        residual, jacobian = (
            np.where(better[:, None], found[0], residual),
            np.where(better[:, None, None], found[1], jacobian),
        )
        error = np.where(better, found[2], error)
        damping = np.clip(np.where(better, damping * 0.2, damping * 8), 1e-14, 1e8)
        still = np.where(better, (moved > 1e-10) & (gained > 1e-14 * error), damping < 1e8)
        if not still.any():
            break
    rates = np.exp(theta[:, 2])
    return DataLaw(np.exp(theta[:, 0]), np.exp((theta[:, 1] - theta[:, 0]) / rates), rates)


def _start(x: np.ndarray, logs: np.ndarray, bound: np.ndarray, alpha: float | None) -> np.ndarray:
    """Best grid points, (R, 3): logarithms of the two terms at sigma = 1 and of the exponent."""
    rates = np.geomspace(0.1, 6, _GRID_ALPHA) if alpha is None else np.array([alpha])
    scales = np.linspace(x.min() - 4, x.max() + 6, _GRID_BETA)
    rate, scale = (each.reshape(-1) for each in np.meshgrid(rates, scales, indexing="ij"))
    shape = np.logaddexp(0, rate[:, None] * (scale[:, None] - x))
    weight = (~bound).astype(float)
    counts = weight.sum(axis=1, keepdims=True)
    level = ((weight * logs).sum(axis=1, keepdims=True) - weight @ shape.T) / counts
    error = weight @ (shape**2).T - 2 * (weight * logs) @ shape.T - counts * level**2
    chosen = error.argmin(axis=1)
    first = np.take_along_axis(level, chosen[:, None], axis=1)[:, 0]
    return np.stack([first, first + rate[chosen] * scale[chosen], np.log(rate[chosen])], axis=1)


def fit_squared(ratios: np.ndarray, steps: np.ndarray, alpha: float | None = None) -> DataLaw:
    """
    Do many fits of :func:`fit_data` at once, with loss "squared".

    :param ratios: (S,)
    :param steps: (R, S)
    :param alpha: exponent, if it is known
    :return: laws, (R,)
    """
    scale = steps.mean(axis=1, keepdims=True)
    y = steps / scale

    def profile(rates: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The other two parameters, non-negative, for exponents (R, A), and the error."""
        # Normalised to 1 at the smallest ratio, so that no power overflows.
        x = np.exp(-rates[..., None] * np.log(ratios / ratios.min()))
        centred, target = x - x.mean(axis=-1, keepdims=True), y[:, None] - y[:, None].mean(axis=-1, keepdims=True)
        factor = np.maximum((centred * target).sum(axis=-1) / np.maximum((centred**2).sum(axis=-1), 1e-300), 0)
        constant = y.mean(axis=1)[:, None] - factor * x.mean(axis=-1)
        alone = (x * y[:, None]).sum(axis=-1) / (x**2).sum(axis=-1)
        factor, constant = np.where(constant < 0, alone, factor), np.maximum(constant, 0)
        error = ((constant[..., None] + factor[..., None] * x - y[:, None]) ** 2).sum(axis=-1)
        return constant, factor, error

    n = len(y)
    if alpha is None:
        rates = np.tile(np.geomspace(*ALPHA, 400), (n, 1))
        chosen = profile(rates)[2].argmin(axis=1)
        rows = np.arange(n)
        low, high = rates[rows, np.maximum(chosen - 1, 0)], rates[rows, np.minimum(chosen + 1, rates.shape[1] - 1)]
        for _ in range(80):
            left, right = low + (high - low) / 3, high - (high - low) / 3
            error = profile(np.stack([left, right], axis=1))[2]
            less = error[:, 0] < error[:, 1]
            low, high = np.where(less, low, left), np.where(less, right, high)
        found = (low + high) / 2
    else:
        found = np.full(n, float(alpha))
    constant, factor, _ = (each[:, 0] for each in profile(found[:, None]))
    constant = np.maximum(constant, math.exp(-_FAR))
    factor = np.maximum(factor, math.exp(-_FAR))
    return DataLaw(constant * scale[:, 0], ratios.min() * (factor / constant) ** (1 / found), found)


def shared_alpha(
    replay_ratio: Sequence[float] | np.ndarray, steps: np.ndarray, censored: np.ndarray | None = None
) -> float:
    """
    Find the exponent with which the laws of several levels fit best together, each with its own ``d_min`` and ``beta``,
    by squared differences of logarithms. For few replay ratios: three of them leave no degree of freedom for a single
    level.

    :param replay_ratio: (S,)
    :param steps: (levels, S)
    :param censored: (levels, S), as for :func:`fit_data`
    :return: the exponent
    """
    ratios = _positive(replay_ratio, "replay_ratio").reshape(-1)
    values = _positive(steps, "steps")
    bound = np.zeros(values.shape, bool) if censored is None else np.asarray(censored, bool)
    if len(np.unique(ratios)) < 3 or values.shape[0] < 2:
        raise ValueError(
            f"steps must be of at least two levels and three replay ratios, not of {values.shape[0]} and "
            f"{len(np.unique(ratios))}"
        )

    def error(rates: np.ndarray) -> np.ndarray:
        found = []
        for rate in rates:
            law = fit_logs(ratios, values, bound, float(rate))
            predicted = law.d_min[:, None] * (1 + (law.beta[:, None] / ratios) ** rate)
            residual = np.log(predicted / values)
            found.append((np.where(bound & (residual > 0), 0.0, residual) ** 2).sum())
        return np.array(found)

    rates = np.geomspace(0.05, 10, 20)
    chosen = int(error(rates).argmin())
    low, high = rates[max(chosen - 1, 0)], rates[min(chosen + 1, len(rates) - 1)]
    for _ in range(3):
        rates = np.linspace(low, high, 7)
        chosen = int(error(rates).argmin())
        low, high = rates[max(chosen - 1, 0)], rates[min(chosen + 1, 6)]
    return float((low + high) / 2)


# ---------------------------------------------------------------- model size


class SizeLaw(NamedTuple):
    """
    Environment steps by replay ratio sigma and parameters N of the critics: ``c * (1 + (a / sigma) ** alpha +
    (b / N) ** beta)`` (follow-up).

    :param c: steps at infinite replay ratio and size
    :param a: replay ratio at which its term is 1
    :param alpha: exponent of the replay ratio
    :param b: number of parameters at which its term is 1
    :param beta: exponent of the parameters
    """

    c: float
    a: float
    alpha: float
    b: float
    beta: float

    def steps(self, replay_ratio: float | np.ndarray, critic_params: float | np.ndarray) -> Any:
        """
        :param replay_ratio: any shape
        :param critic_params: broadcast against it
        :return: environment steps
        """
        ratio, size = _positive(replay_ratio, "replay_ratio"), _positive(critic_params, "critic_params")
        return self.c * (1 + (self.a / ratio) ** self.alpha + (self.b / size) ** self.beta)


def fit_model_size(
    replay_ratio: Sequence[float] | np.ndarray,
    critic_params: Sequence[float] | np.ndarray,
    steps: Sequence[float] | np.ndarray,
) -> SizeLaw:
    """
    Fit the environment steps needed for a level, by replay ratio and size: least squares of logarithms, from several
    starts.

    :param replay_ratio: (m,)
    :param critic_params: (m,)
    :param steps: (m,)
    :return: the law
    :raises ValueError: fewer than three replay ratios or sizes, fewer than six points, or numbers that are not positive
    """
    from scipy.optimize import least_squares  # takes as long to import as all of this package's studies

    ratios, sizes = _positive(replay_ratio, "replay_ratio").reshape(-1), _positive(critic_params, "critic_params")
    sizes, values = sizes.reshape(-1), _positive(steps, "steps").reshape(-1)
    if not len(ratios) == len(sizes) == len(values):
        raise ValueError(f"points must be equally many, not {len(ratios)}, {len(sizes)} and {len(values)}")
    if len(np.unique(ratios)) < 3 or len(np.unique(sizes)) < 3 or len(values) < 6:
        raise ValueError(
            "points must be at least six, of three replay ratios and three sizes, for five parameters; they are "
            f"{len(values)}, of {len(np.unique(ratios))} and {len(np.unique(sizes))}"
        )
    x, z, y = np.log(ratios), np.log(sizes), np.log(values)
    # The terms are then of the order of the steps, which bound them.
    middle_x, middle = x.mean(), z.mean()
    x, z = x - middle_x, z - middle

    def residual(theta: np.ndarray) -> np.ndarray:
        c, first, second, log_alpha, log_beta = theta
        terms = [np.full(len(y), c), first - np.exp(log_alpha) * x, second - np.exp(log_beta) * z]
        return np.logaddexp.reduce(terms, axis=0) - y  # type: ignore[no-any-return]

    starts = [
        np.array([y.min() - 0.7, y.mean() - 1, y.mean() - 1, math.log(a), math.log(b)])
        for a in (0.3, 0.8, 2.0)
        for b in (0.3, 0.8, 2.0)
    ]
    ends = [np.array([y.min() - _FAR] * 3 + [math.log(ALPHA[0])] * 2)]
    ends.append(np.array([y.max() + 1] * 3 + [math.log(ALPHA[1])] * 2))
    found = min((least_squares(residual, start, bounds=ends, x_scale="jac") for start in starts), key=lambda f: f.cost)
    c, first, second, log_alpha, log_beta = map(float, found.x)
    alpha, beta = math.exp(log_alpha), math.exp(log_beta)
    b = math.exp(middle + (second - c) / beta)
    return SizeLaw(math.exp(c), math.exp(middle_x + (first - c) / alpha), alpha, b, beta)


def _positive(values: Any, name: str) -> np.ndarray:
    found = np.asarray(values, float)
    if not found.size or not np.isfinite(found).all() or (found <= 0).any():
        raise ValueError(f"{name} must be positive and finite, not {np.array2string(found, threshold=6)}")
    return found
