"""
How often intervals of the scaling laws cover what the same computation finds with a thousand seeds.

    python benchmarks/scaling_coverage.py [--seeds 3 5 10] [--repetitions 200] [--reps 150]

Made-up runs of three tasks at five replay ratios, with known laws: each seed learns at a speed of its own (standard
deviation 25%), and its evaluations, one every 1% of the steps to 700, have noise (60 of 1000). Of the levels 400 and
700 d_min, beta, alpha and the fitted steps at four replay ratios, one of them outside of the runs. Prints the share of
repetitions in which an interval of 95% holds the thousand seeds' value: plain percentiles, those of sb3_sample, and
BCa.
"""

import argparse

import numpy as np
from scipy.stats import norm

from sb3_sample.study.scaling.crossings import Configuration
from sb3_sample.study.scaling.fitting import normalize
from sb3_sample.study.scaling.intervals import draw, interval
from sb3_sample.study.scaling.laws import DataLaw, fit_logs

RATIOS = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
D_MIN = (2e5, 3e5, 5e5)
LEVELS = np.array([400.0, 700.0])
AT = (1.0, 4.0, 16.0, 32.0)
NAMES = [
    f"{name} at {level:.0f}" for level in LEVELS for name in ("d_min", "beta", "alpha", *(f"D({r:g})" for r in AT))
]


def made_up(rng: np.random.Generator, n: int) -> list[list[Configuration]]:
    """Runs by task and replay ratio."""
    found = []
    for d_min in D_MIN:
        row = []
        for ratio, steps_to in zip(RATIOS, DataLaw(d_min, 1.5, 0.8).steps(RATIOS), strict=True):
            steps = np.round(steps_to * 0.01 * np.arange(1, 161))
            x = steps / steps_to / np.exp(rng.normal(0, 0.25, (n, 1)))
            curves = np.clip(1_000 * x**2 / (x**2 + 3 / 7) + rng.normal(0, 60, x.shape), 0, 1_000)
            row.append(Configuration("made up", "{}", f"{d_min:g}, {ratio:g}", steps, curves))
        found.append(row)
    return found


def laws(runs: list[list[Configuration]], samples: np.ndarray) -> np.ndarray:
    """Numbers of :data:`NAMES` for each sample, (R, names)."""
    steps = np.stack([np.stack([each.reached(LEVELS, samples) for each in row], axis=1) for row in runs], axis=1)
    last = np.array([[each.steps[-1] for each in row] for row in runs])
    found = []
    for i in range(len(LEVELS)):
        y, bounded, _ = normalize(steps[..., i : i + 1], last)
        law = fit_logs(RATIOS, y[..., 0], bounded[..., 0])
        found += [*law, *(law.steps(ratio) for ratio in AT)]
    return np.stack(found, axis=1)


def bca(point: np.ndarray, reps: np.ndarray, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bias-corrected and accelerated intervals (Efron 1987)."""
    n = len(reps)
    below = (reps < point).mean(axis=0) + (reps == point).mean(axis=0) / 2
    bias = norm.ppf(np.clip(below, 0.5 / n, 1 - 0.5 / n))
    gaps = without.mean(axis=0) - without
    skew = (gaps**3).sum(axis=0) / (6 * (gaps**2).sum(axis=0) ** 1.5)
    ends = []
    for z in norm.ppf([0.025, 0.975]):
        level = norm.cdf(bias + (bias + z) / (1 - skew * (bias + z)))
        ends.append(np.array([np.quantile(reps[:, i], level[i]) for i in range(reps.shape[1])]))
    return ends[0], ends[1]


def main() -> None:
    """Simulate and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 5, 10])
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--reps", type=int, default=150, help="bootstrap samples")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    truth = laws(made_up(rng, 1_000), np.arange(1_000)[None])[0]
    for n in options.seeds:
        hits = {name: np.zeros(len(NAMES)) for name in ("percentiles", "sb3_sample", "BCa")}
        for _ in range(options.repetitions):
            runs = made_up(rng, n)
            point, reps = laws(runs, np.arange(n)[None])[0], laws(runs, draw(rng, options.reps, n))
            without = laws(runs, np.array([np.delete(np.arange(n), i) for i in range(n)]))
            found = {"percentiles": interval(point, reps, None), "sb3_sample": interval(point, reps, n)}
            found["BCa"] = bca(point, reps, without)
            for name, (low, high) in found.items():
                hits[name] += (low <= truth) & (truth <= high)
        print(f"{n} seeds, {options.repetitions} repetitions")
        for name, counts in hits.items():
            shares = counts / options.repetitions
            worst = NAMES[int(shares.argmin())]
            print(
                f"  {name:<12} mean {shares.mean():.1%}, from {shares.min():.1%} ({worst}) to {shares.max():.1%}",
                flush=True,
            )


if __name__ == "__main__":
    main()
