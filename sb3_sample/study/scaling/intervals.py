"""Intervals by the bootstrap over seeds: bias-corrected and accelerated (BCa; Efron 1987), and percentiles."""

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


def percentile(reps: np.ndarray, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """
    :param reps: (R, ...) of bootstrap samples
    :param confidence: share of them inside
    :return: lower and upper ends, (...)
    """
    check_samples(len(reps), confidence)
    low, high = np.nanquantile(reps, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return low, high


def bca(
    point: np.ndarray, reps: np.ndarray, without: np.ndarray, confidence: float = 0.95, n: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """
    BCa intervals, widened for few seeds: a bootstrap sample of n seeds has a variance that is too small by (n - 1) / n,
    and n seeds know their own only as Student's t does (Hesterberg 2015, "What teachers should know about the
    bootstrap", section 5.3).

    :param point: (...) of all seeds
    :param reps: (R, ...) of bootstrap samples
    :param without: (n, ...) of all seeds but one
    :param confidence: of the intervals
    :param n: seeds of a configuration; None for no widening
    :return: lower and upper ends, (...); NaN where fewer than half of the samples have a value
    """
    check_samples(len(reps), confidence)
    point, reps, without = np.asarray(point, float), np.asarray(reps, float), np.asarray(without, float)
    shape = point.shape
    point, reps = point.reshape(-1), reps.reshape(len(reps), -1)
    without = without.reshape(len(without), -1)
    there = np.isfinite(reps)
    count = there.sum(axis=0)
    below = ((reps < point) & there).sum(axis=0) + ((reps == point) & there).sum(axis=0) / 2
    bias = norm.ppf(np.clip(below / np.maximum(count, 1), 0.5 / len(reps), 1 - 0.5 / len(reps)))
    gaps = np.nanmean(without, axis=0) - without if len(without) else np.zeros((1, len(point)))
    squares = np.nansum(gaps**2, axis=0)
    with np.errstate(all="ignore"):
        skew = np.where(squares > 0, np.nansum(gaps**3, axis=0) / (6 * squares**1.5), 0.0)
    z = norm.ppf((1 + confidence) / 2)
    if n is not None:
        z = t.ppf((1 + confidence) / 2, n - 1) * np.sqrt(n / (n - 1))
    ends = []
    for sign in (-1, 1):
        level = norm.cdf(bias + (bias + sign * z) / np.maximum(1 - skew * (bias + sign * z), 0.1))
        ends.append(_quantile(reps, there, level))
    enough = (2 * count >= len(reps)) & np.isfinite(point)
    low, high = (np.where(enough, end, np.nan).reshape(shape) for end in ends)
    return low, high


def _quantile(reps: np.ndarray, there: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Quantiles of each column at a level of its own."""
    ordered = np.sort(np.where(there, reps, np.inf), axis=0)
    place = np.clip(levels, 0, 1) * np.maximum(there.sum(axis=0) - 1, 0)
    low = np.floor(place).astype(int)
    high = np.minimum(low + 1, np.maximum(there.sum(axis=0) - 1, 0))
    columns = np.arange(reps.shape[1])
    with np.errstate(invalid="ignore"):
        share = place - low
        found: np.ndarray = ordered[low, columns] * (1 - share) + ordered[high, columns] * share
    return found
