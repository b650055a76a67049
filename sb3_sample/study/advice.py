"""
Choice of BRO's critic size and replay ratio for a number of hours on a machine, from published runs: 25 configurations
of BRO on 40 tasks ("Compute-Optimal Scaling for Value-Based Deep RL", Fu et al. 2025; ``data/README.md``).
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_sample.sac.bro import BRO
from sb3_sample.study.plan import EPISODES, EVERY
from sb3_sample.study.step_times import StepTimes

GRID = Path(__file__).parents[1] / "data" / "bro_grid.csv.gz"
#: Suites of the published runs: their names, and their default tasks.
SUITES = {
    "dmc": ("DeepMind Control", "dmc/cheetah-run-v0"),
    "metaworld": ("Meta-World", "metaworld/push-v3"),
    "myosuite": ("MyoSuite", "myosuite/key-turn-v0"),
}
#: Environment steps before the first gradient step.
_WARM_UP = BRO.constructor_arguments["learning_starts"].default


@functools.cache
def published_grid() -> pd.DataFrame:
    """
    :return: statistics of the published runs, one row per suite, replay ratio, size and evaluation: ``suite``,
        ``replay_ratio``, ``model_size``, ``env_step``; ``iqm`` of the normalised returns or success rates with its 95%
        interval ``low`` and ``high``; ``tasks`` and ``runs``
    """
    return pd.read_csv(GRID, dtype={"model_size": str})


@dataclasses.dataclass(frozen=True)
class Advice:
    """
    Answer to "how far do I get in these hours?".

    :param suite: "dmc", "metaworld" or "myosuite"
    :param env: id of the environment of the command
    :param hours: hours available
    :param options: further options of the command
    :param table: one row per size and replay ratio, best first: ``model_size``, ``replay_ratio``, ``steps`` in these
        hours, a million at most; ``hours`` of these steps; ``iqm``, ``low``, ``high``, NaN before the first published
        evaluation; ``ends_early``, whether a million steps take less than the hours
    """

    suite: str
    env: str
    hours: float
    options: tuple[str, ...]
    table: pd.DataFrame

    @property
    def best(self) -> Any:
        """The row with the largest expected return."""
        return self.table.iloc[0]

    @property
    def equals(self) -> pd.DataFrame:
        """Other rows whose interval reaches that of the best row."""
        others = self.table.iloc[1:]
        return others[others["high"] >= self.best["low"]]

    @property
    def command(self) -> str:
        """The command that trains the best configuration."""
        ratio, size = int(self.best["replay_ratio"]), self.best["model_size"]
        # In the published code two gradient steps per step go with the first reset only, which is BRO Fast.
        algo, params = ("bro_fast", "") if ratio == 2 else ("bro", f" replay_ratio:{ratio}")
        options = "".join(f"{option} " for option in self.options)
        return (
            f"sb3-sample train --algo {algo} --env {self.env} -n {int(self.best['steps'])} --eval-freq {EVERY} "
            f"--eval-episodes {EPISODES} {options}-params model_size:\"'{size}'\"{params}"
        )


def advise(
    hours: float,
    times: StepTimes,
    environment: float,
    *,
    suite: str = "dmc",
    env: str | None = None,
    episode: int = 1_000,
    options: Sequence[str] = (),
) -> Advice:
    """
    Find the size and replay ratio that get furthest in a number of hours: for each of the 25 published configurations,
    the environment steps that fit into them, and its interquartile mean there, interpolated between published
    evaluations.

    The hours of n steps comprise compiling, acting and the environment, evaluations as in ``sb3-sample train``, and
    replay ratio times (n - 2,500) gradient steps.

    :param hours: hours of training
    :param times: step times of the machine
    :param environment: seconds per step of the environment
    :param suite: of the published runs: "dmc", "metaworld" or "myosuite"
    :param env: id of the environment of the command; a task of the suite if None
    :param episode: steps of an episode
    :param options: further options of the command
    :return: the answer
    :raises ValueError: an argument is out of range, or no configuration makes the 25,000 steps of the first published
        evaluation in these hours
    """
    if suite not in SUITES:
        raise ValueError(f"suite must be one of {', '.join(SUITES)}, not {suite!r}")
    if not (np.isfinite(hours) and hours > 0):
        raise ValueError(f"hours must be a positive number, not {hours!r}")
    if not (np.isfinite(environment) and environment >= 0) or episode < 1:
        raise ValueError(
            "environment must be seconds of at least 0 and episode at least one step, not "
            f"{environment!r} and {episode!r}"
        )
    grid = published_grid()
    grid = grid[grid["suite"] == suite]
    first, last = int(grid["env_step"].min()), int(grid["env_step"].max())
    acting = (times.acting + environment) * (1 + EPISODES * episode / EVERY)
    rows, shortest = [], np.inf
    for (size, ratio), curve in grid.groupby(["model_size", "replay_ratio"], sort=False):
        if size not in times.gradient_step:
            raise ValueError(f"times must be of every model_size, and have none of {size}")
        learning = ratio * times.gradient_step[size]
        before = times.preparation.get(size, 0.0) - _WARM_UP * learning
        steps = (3600 * hours - before) / (acting + learning)
        shortest = min(shortest, (before + first * (acting + learning)) / 3600)
        made = int(min(max(steps, 0), last)) // 1_000 * 1_000
        row = {
            "model_size": size, "replay_ratio": int(ratio), "steps": made,
            "hours": (before + made * (acting + learning)) / 3600, "ends_early": steps > last,
        }  # fmt: skip
        for name in ("iqm", "low", "high"):
            row[name] = np.interp(made, curve["env_step"], curve[name]) if made >= first else np.nan
        rows.append(row)
    table = pd.DataFrame(rows)
    if table["iqm"].isna().all():
        raise ValueError(
            f"hours must be at least {shortest:.2g} here: the published runs were first evaluated after {first:,} "
            f"steps, and no number stands for fewer; in {hours:g} hours at most {table['steps'].max():,} are made"
        )
    # Among equal returns, the one that is reached earlier.
    table = table.sort_values(["iqm", "hours"], ascending=[False, True], ignore_index=True)
    return Advice(suite, env or SUITES[suite][1], float(hours), tuple(options), table)
