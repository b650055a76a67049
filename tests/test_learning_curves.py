"""Runs of benchmarks/learning_curves.py that are interrupted."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.monitor import load_results

PROGRAM = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "learning_curves.py"))


@pytest.mark.parametrize("agent", ["SAC (stable_baselines3)", "CrossQ (sb3_contrib)"])
def test_runs_of_peers_resume(agent: str, tmp_path: Path) -> None:
    given = ["--agent", agent, "--env", "Pendulum-v1", "--eval-freq", "600", "--eval-episodes", "1"]
    given += ["--output", str(tmp_path), "--steps"]
    PROGRAM["main"]([*given, "1300"])  # 300 steps and an evaluation, at 1,200, after the last state
    folder = tmp_path / agent / "seed_0"
    first = np.load(folder / "evaluations.npz")["results"][0]
    (folder / "states" / "incomplete").mkdir()  # of a process that was killed
    (folder / "states" / "incomplete" / "model.zip").write_bytes(b"half of it")
    assert [state.name for state in PROGRAM["saved_states"](folder)] == ["1000"]

    PROGRAM["main"]([*given, "2000"])
    both = np.load(folder / "evaluations.npz")
    assert both["timesteps"].tolist() == [600, 1200, 1800]
    assert both["results"][0] == first
    assert [state.name for state in (folder / "states").iterdir()] == ["2000"]
    # Episodes of 200 steps: 5 up to the state, and 5 after it. The sixth before the interruption was run again.
    assert len(load_results(str(folder))) == 5 + 5
