"""Made-up runs: folders as the train command and the zoo leave them, and tables."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_sample.study.table import COLUMNS, to_json

STEPS = (1_000, 2_000, 3_000)


def write_run(
    folder: Path,
    task: str = "dmc/cheetah-run-v0",
    algo: str = "bro",
    seed: int = 0,
    steps: Sequence[int] = STEPS,
    values: Sequence[float] = (10.0, 20.0, 30.0),
    successes: Sequence[float] | None = None,
    arguments: Mapping[str, Any] | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    log: Sequence[Mapping[str, Any]] = (),
) -> Path:
    """A folder of ``sb3-sample train --run-dir``; two episodes an evaluation, one above its value, one below."""
    folder.mkdir(parents=True)
    settings = {"algo": algo, "env": task, "seed": seed, "eval_freq": 1_000, "env_kwargs": env_kwargs}
    settings |= dict(arguments or {})
    record = {"algo": algo, "env": task, "seed": seed, "n_timesteps": -1, "checkpoint_freq": 10}
    record |= {"settings": {name: repr(value) for name, value in settings.items()}, "tensorboard": None}
    (folder / "run.json").write_text(json.dumps(record))
    write_monitor(folder, task)
    write_evaluations(folder, steps, values, successes)
    if log:
        (folder / "progress.jsonl").write_text("".join(json.dumps(line) + "\n" for line in log))
    return folder


def write_evaluations(
    folder: Path, steps: Sequence[int], values: Sequence[float], successes: Sequence[float] | None = None
) -> None:
    arrays = {"timesteps": np.array(steps), "results": np.array(values)[:, None] + [[-1.0, 1.0]]}
    if successes is not None:
        arrays["successes"] = np.array(successes)[:, None] + [[0.0, 0.0]]
    np.savez(folder / "evaluations.npz", **arrays)  # type: ignore[arg-type]


def write_monitor(
    folder: Path,
    task: str = "dmc/cheetah-run-v0",
    lengths: Sequence[int] = (1_000, 1_000, 1_000),
    returns: Sequence[float] = (1.0, 2.0, 3.0),
    times: Sequence[float] = (1_800.0, 3_600.0, 5_400.0),
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    rows = "".join(f"{r},{n},{t}\n" for r, n, t in zip(returns, lengths, times, strict=True))
    (folder / "0.monitor.csv").write_text(f'#{{"t_start": 0.0, "env_id": "{task}"}}\nr,l,t\n{rows}')


def write_zoo_run(
    folder: Path, task: str = "dmc/cheetah-run-v0", algo: str = "sac", seed: int = 7, config: str = "", kwargs: str = ""
) -> Path:
    """A folder of the zoo, whose settings are as the zoo writes them."""
    folder.mkdir(parents=True)
    settings = folder / task.replace("/", "-")
    settings.mkdir()
    (settings / "args.yml").write_text(
        "!!python/object/apply:collections.OrderedDict\n- - - algo\n    - "
        f"{algo}\n  - - env\n    - {task}\n  - - env_kwargs\n    - {kwargs or 'null'}\n  - - seed\n    - {seed}\n"
    )
    (settings / "config.yml").write_text(
        "!!python/object/apply:collections.OrderedDict\n- - - n_timesteps\n    - 1000.0\n"
        f"  - - policy\n    - MlpPolicy\n{config}"
    )
    write_monitor(folder, task)
    write_evaluations(folder, STEPS, (10.0, 20.0, 30.0))
    return folder


def made_up(rows: Sequence[tuple[Any, ...]]) -> pd.DataFrame:
    """
    :param rows: agent, arguments, task, seed, step, metric, value
    """
    table = pd.DataFrame([(row[0], to_json(row[1]), *row[2:]) for row in rows], columns=COLUMNS)
    return table.astype({"seed": "Int64", "step": np.int64, "value": float})
