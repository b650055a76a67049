"""
MBMA, figure 1, of the runs of a study: steps to solve CartPole, and the gain of one update, by T and N.

    python benchmarks/rewound_actions.py runs/mbma_figure1_small|TABLE.csv [--solved 190]

A run has solved the task at its first evaluation whose mean reaches ``--solved``; one that never does counts with the
plan's steps, and how many they are is printed. The gain of an update is the rise of the evaluations, from the first to
the one that solves it, or the last, by the updates in between. Intervals: 95 %, bootstrap over seeds.
"""

import argparse

import numpy as np
import pandas as pd

from sb3_sample import study


def interval(values: np.ndarray, rng: np.random.Generator) -> str:
    """
    :param values: one a seed
    :param rng: generator
    :return: their mean, and its interval
    """
    means = rng.choice(values, size=(10_000, len(values))).mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return f"{values.mean():.2f} ({low:.2f} to {high:.2f})"


def figure(table: pd.DataFrame, solved: float = 190.0) -> str:
    """
    :param table: runs of the plan's agents, whose names begin with T and its number
    :param solved: mean return of a solution
    :return: a table in Markdown, a line an agent
    """
    table = table[table["metric"] == "return"]
    rng = np.random.default_rng(0)
    lines = [
        "| agent | seeds | thousands of steps to solve | unsolved | gain of an update |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for agent, runs in table.groupby("agent", sort=False):
        steps, gains, unsolved = [], [], 0
        for _, run in runs.groupby("seed"):
            run = run.sort_values("step")
            at, scores = run["step"].to_numpy(), run["value"].to_numpy()
            reached = np.flatnonzero(scores >= solved)
            end = reached[0] if len(reached) else len(at) - 1
            unsolved += not len(reached)
            steps.append(at[end] / 1_000)
            n_steps = int(str(agent).split()[0].removeprefix("T"))
            gains.append((scores[end] - scores[0]) / max((at[end] - at[0]) / n_steps, 1))
        cells = [interval(np.array(steps), rng), unsolved, interval(np.array(gains), rng)]
        lines.append(f"| {agent} | {len(steps)} | {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="folder of the study, or its table")
    parser.add_argument("--solved", type=float, default=190.0, help="mean return of a solution")
    given = parser.parse_args()
    print(figure(study.read([given.source]), given.solved))


if __name__ == "__main__":
    main()
