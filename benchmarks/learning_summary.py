"""
Table and picture of the runs that ``learning_curves.py`` made.

    python benchmarks/learning_summary.py runs --picture agents.png

It needs rliable, which comes with the extra [zoo]. For each agent, over its seeds: interquartile mean and 95%
stratified bootstrap interval (rliable) of the return, of the last evaluations and of all of them. With few seeds the
interval says little more than how far apart they lie.
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np
from rliable import library, metrics

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def read(folder: Path) -> dict[str, dict[int, tuple[np.ndarray, np.ndarray]]]:
    """By agent and seed: environment steps, (T,), and mean return of the evaluation, (T,)."""
    runs: dict[str, dict[int, tuple[np.ndarray, np.ndarray]]] = {}
    for path in sorted(folder.glob("*/seed_*/evaluations.npz")):
        data = np.load(path)
        seed = int(path.parent.name.removeprefix("seed_"))
        runs.setdefault(path.parents[1].name, {})[seed] = (data["timesteps"], data["results"].mean(axis=1))
    if not runs:
        raise SystemExit(f"no AGENT/seed_SEED/evaluations.npz below {folder}")
    return runs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--picture", type=Path, default=Path("agents.png"))
    parser.add_argument("--last", type=int, default=2, help="evaluations that count as the last ones")
    parser.add_argument("--title", default="")
    args = parser.parse_args()

    runs = read(args.folder)
    complete = max(steps[-1] for seeds in runs.values() for steps, _ in seeds.values())
    for agent, seeds in runs.items():
        for seed in [seed for seed, (steps, _) in seeds.items() if steps[-1] < complete]:
            print(f"left out, it ends at {seeds.pop(seed)[0][-1]} of {complete} steps: {agent}, seed {seed}")
    runs = {agent: seeds for agent, seeds in runs.items() if seeds}
    common = sorted(set.intersection(*(set(steps) for seeds in runs.values() for steps, _ in seeds.values())))
    # (seeds, T) by agent
    scores = {
        agent: np.array([values[np.isin(steps, common)] for steps, values in seeds.values()])
        for agent, seeds in runs.items()
    }

    def interval(table: dict[str, np.ndarray]) -> dict[str, str]:
        def iqm(x: np.ndarray) -> np.ndarray:
            return np.array([metrics.aggregate_iqm(x)])

        points, bounds = library.get_interval_estimates(
            {agent: x[:, None] for agent, x in table.items()}, iqm, reps=10_000, random_state=np.random.RandomState(0)
        )
        return {name: f"{points[name][0]:.0f} ({bounds[name][0, 0]:.0f}-{bounds[name][1, 0]:.0f})" for name in table}

    last = interval({agent: x[:, -args.last :].mean(axis=1) for agent, x in scores.items()})
    whole = interval({agent: x.mean(axis=1) for agent, x in scores.items()})
    steps = " and ".join(f"{step:,}" for step in common[-args.last :])
    print(f"| agent | seeds | at {steps} steps: IQM (95%) | all evaluations: IQM (95%) | seeds at {common[-1]:,} |")
    print("| --- | ---: | ---: | ---: | --- |")
    for agent in sorted(scores, key=lambda name: -scores[name][:, -args.last :].mean()):
        each = ", ".join(f"{value:.0f}" for value in scores[agent][:, -1])
        print(f"| {agent} | {len(scores[agent])} | {last[agent]} | {whole[agent]} | {each} |")

    figure, axes = plt.subplots(figsize=(9, 5.5), layout="constrained")
    for agent, x in scores.items():
        (line,) = axes.plot(common, x.mean(axis=0), label=f"{agent} ({len(x)})")
        axes.fill_between(common, x.min(axis=0), x.max(axis=0), color=line.get_color(), alpha=0.12)
    axes.set(xlabel="environment steps", ylabel="return: mean and range over seeds", title=args.title)
    axes.legend(title="agent (seeds)", fontsize="small")
    figure.savefig(args.picture, dpi=110)
    print(f"\npicture: {args.picture}")


if __name__ == "__main__":
    main()
