"""
How often intervals of the scaling laws cover what the same computation finds with a thousand seeds.

    python benchmarks/scaling_coverage.py coverage.jsonl [--seeds 3 5 10] [--repetitions 200] [--minutes 25] [--seed 0]
    python benchmarks/scaling_coverage.py coverage.jsonl more.jsonl --summary

Made-up runs of three tasks at five replay ratios, with known laws: each seed learns at a speed of its own (standard
deviation 25%), and its evaluations, one every 1% of the steps to 700, have noise (60 of 1000). Of the levels 400 and
700 d_min, beta, alpha and the fitted steps at four replay ratios, one of them outside of the runs. Prints the share of
repetitions in which an interval of 95% holds the thousand seeds' value: those of sb3_sample, plain percentiles, BCa and
studentised ones (standard errors by the jackknife, of logarithms).

A line a repetition is appended to the file, whose random numbers depend on --seed and its number alone: so the
simulation may be interrupted and go on, or be made in pieces of --minutes, and files of several --seed be put together.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

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


def studentised(point: np.ndarray, reps: np.ndarray, errors: np.ndarray, error: np.ndarray) -> tuple[Any, Any]:
    """
    Studentised intervals of logarithms.

    :param point: (names,) of all seeds
    :param reps: (R, names)
    :param errors: standard errors of the samples' logarithms, (R, names)
    :param error: of all seeds', (names,)
    :return: both ends
    """
    with np.errstate(all="ignore"):
        ratios = (np.log(reps) - np.log(point)) / errors
    # A sample of one seed over and over has no standard error.
    ratios[~np.isfinite(ratios)] = np.nan
    low, high = np.nanquantile(ratios, [0.025, 0.975], axis=0)
    with np.errstate(over="ignore"):
        return point * np.exp(-high * error), point * np.exp(-low * error)


def jackknifed(without: np.ndarray) -> np.ndarray:
    """Standard errors of the logarithms of what is found without one seed each, (..., n, names)."""
    logs = np.log(without)
    n = logs.shape[-2]
    squares = (logs - logs.mean(axis=-2, keepdims=True)) ** 2
    error: np.ndarray = np.sqrt((n - 1) / n * squares.sum(axis=-2))
    return error


def simulated(rng: np.random.Generator, n: int, reps: int, truth: np.ndarray) -> dict[str, Any]:
    """
    One simulated study: by kind of interval whether it holds the truth, a value a name of :data:`NAMES`, and the median
    over the names of its upper over its lower end.
    """
    runs, whole = made_up(rng, n), np.arange(n)
    samples = draw(rng, reps, n)
    others = np.array([np.delete(whole, i) for i in range(n)])
    point, found = laws(runs, whole[None])[0], laws(runs, samples)
    without = laws(runs, others)
    of_samples = laws(runs, samples[:, others].reshape(reps * n, n - 1)).reshape(reps, n, -1)
    intervals = {
        "sb3_sample": interval(point, found, n),
        "percentiles": interval(point, found, None),
        "BCa": bca(point, found, without),
        "studentised": studentised(point, found, jackknifed(of_samples), jackknifed(without)),
    }
    with np.errstate(all="ignore"):
        return {
            "held": {name: ((low <= truth) & (truth <= high)).tolist() for name, (low, high) in intervals.items()},
            "ratio": {name: float(np.median(high / low)) for name, (low, high) in intervals.items()},
        }


def simulate(options: argparse.Namespace) -> None:
    """Append the repetitions that the file does not have yet, the same number of each number of seeds."""
    path, until = options.files[0], time.monotonic() + 60 * options.minutes
    there = {(line["n"], line["seed"], line["repetition"], line["reps"]) for line in read([path])}
    truth = laws(made_up(np.random.default_rng(0), 1_000), np.arange(1_000)[None])[0]
    for repetition in range(options.repetitions):
        for n in options.seeds:
            if (n, options.seed, repetition, options.reps) in there:
                continue
            if time.monotonic() > until:
                return
            rng = np.random.default_rng([1, options.seed, n, repetition])
            line = {"n": n, "seed": options.seed, "repetition": repetition, "reps": options.reps}
            with path.open("a") as file:
                file.write(json.dumps(line | simulated(rng, n, options.reps, truth)) + "\n")


def read(paths: list[Path]) -> list[dict[str, Any]]:
    """The repetitions of some files, of which the first may not be there yet."""
    return [json.loads(line) for path in paths if path.exists() for line in path.read_text().splitlines()]


def summarize(lines: list[dict[str, Any]]) -> None:
    """Print the shares."""
    for n in sorted({line["n"] for line in lines}):
        of = [line for line in lines if line["n"] == n]
        print(f"{n} seeds, {len(of)} repetitions; the upper end over the lower is a median")
        for kind in of[0]["held"]:
            shares = np.mean([line["held"][kind] for line in of], axis=0)
            worst, ratio = NAMES[int(shares.argmin())], np.median([line["ratio"][kind] for line in of])
            print(
                f"  {kind:<12} mean {shares.mean():.1%}, from {shares.min():.1%} ({worst}) to {shares.max():.1%}; "
                f"upper / lower {ratio:.3g}"
            )


def main() -> None:
    """Simulate and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "files", type=Path, nargs="+", metavar="FILE", help="repetitions; simulated ones go to the first"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 5, 10], help="of a simulated study")
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--reps", type=int, default=150, help="bootstrap samples")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="after which no repetition is begun")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers")
    parser.add_argument("--summary", action="store_true", help="simulate nothing")
    options = parser.parse_args()
    if not options.summary:
        simulate(options)
    summarize(read(options.files))


if __name__ == "__main__":
    main()
