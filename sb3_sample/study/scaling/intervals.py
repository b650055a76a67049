"""Intervals by the bootstrap over seeds."""

import numpy as np
from scipy.stats import norm, t

from sb3_sample.study.aggregate import check_samples


def draw(rng: np.random.Generator, reps: int, n: int) -> np.ndarray:
    """
    :param rng: generator
    :param reps: samples
    :param n: seeds
    :return: numbers of the seeds of each sample, (reps, n)
    """
    return rng.integers(0, n, (reps, n))


def interval(reps: np.ndarray, n: int | None, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """
    Percentiles of bootstrap samples, widened for few seeds: a bootstrap sample of n seeds has a variance that is too
    small by (n - 1) / n, and n seeds know their own no better than Student's t says (the expanded percentile interval
    of Hesterberg 2015, "What teachers should know about the bootstrap", section 5.3).

    BCa intervals, whose correction of a bias is itself estimated, cover less here (``benchmarks/scaling_coverage.py``).

    :param reps: (R, ...)
    :param n: seeds of a configuration, at least 2; None for plain percentiles
    :param confidence: of the interval
    :return: lower and upper ends, (...); NaN where fewer than half of the samples have a value
    """
    check_samples(len(reps), confidence)
    level = (1 - confidence) / 2
    if n is not None:
        level = float(norm.cdf(t.ppf(level, n - 1) * np.sqrt(n / (n - 1))))
    there = np.isfinite(reps)
    enough = 2 * there.sum(axis=0) >= len(reps)
    known = np.where(enough, np.where(there, reps, np.nan), 0.0)
    low, high = np.nanquantile(known, [level, 1 - level], axis=0)
    return np.where(enough, low, np.nan)[()], np.where(enough, high, np.nan)[()]
