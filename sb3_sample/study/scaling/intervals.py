"""Intervals by the bootstrap over seeds."""

import numpy as np
from scipy.special import ndtr, ndtri, stdtrit

from sb3_sample.study.aggregate import check_samples

#: Number of seeds below which the percentiles' distances are multiplied.
FEW = 5


def draw(rng: np.random.Generator, reps: int, n: int) -> np.ndarray:
    """
    :param rng: generator
    :param reps: samples
    :param n: seeds
    :return: numbers of the seeds of each sample, (reps, n)
    """
    return rng.integers(0, n, (reps, n))


def interval(
    point: np.ndarray | float, reps: np.ndarray, n: int | None, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """
    Percentiles of bootstrap samples, widened for few seeds: the variance of a bootstrap sample of n seeds is too small
    by the factor (n - 1) / n, and n seeds estimate their variance only as well as Student's t allows for (the expanded
    percentile interval of Hesterberg 2015, "What teachers should know about the bootstrap", section 5.3).

    Samples of three or four seeds do not reach that far out: there the distances of the plain percentiles from the
    point estimate are multiplied, in logarithms if all are positive.

    BCa and studentised intervals have lower coverage here (``benchmarks/scaling_coverage.py``).

    :param point: (...) estimates from all seeds
    :param reps: (R, ...) estimates from the bootstrap samples
    :param n: seeds of a configuration, at least 2; None for plain percentiles
    :param confidence: of the interval
    :return: lower and upper bounds, (...); NaN where fewer than half of the samples have a value
    """
    check_samples(len(reps), confidence)
    level = (1 - confidence) / 2
    factor = 1.0
    if n is not None:
        wide = float(stdtrit(n - 1, level) * np.sqrt(n / (n - 1)))
        if n < FEW:
            factor = wide / float(ndtri(level))
        else:
            level = float(ndtr(wide))
    there = np.isfinite(reps)
    enough = (2 * there.sum(axis=0) >= len(reps)) & np.isfinite(point)
    # Zeros where there are not enough, to avoid warnings about values that are not used.
    center, known = np.where(enough, point, 0.0), np.where(enough, np.where(there, reps, np.nan), 0.0)
    ends = np.nanquantile(known, [level, 1 - level], axis=0)
    if factor != 1:
        positive = (center > 0) & (ends > 0).all(axis=0)
        with np.errstate(all="ignore"):
            logs = center * (ends / center) ** factor
        ends = np.where(positive, logs, center + factor * (ends - center))
        ends = np.stack([np.minimum(ends[0], center), np.maximum(ends[1], center)])
    low, high = (np.where(enough, end, np.nan)[()] for end in ends)
    return low, high
