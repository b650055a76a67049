"""A study of agents that learn from data, run for real."""

import dataclasses
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("h5py")

from sb3_sample import study
from sb3_sample.study import dry_run
from tests.test_zoo_data import write

PLAN = """
agents:
  BC: {algo: bc, dataset: FOLDER/{task}.hdf5, batch_size: 16, steps: 90}
  IQL: &iql
    algo: iql
    dataset: FOLDER/{task}.hdf5
    prior_data: FOLDER/{task}.hdf5
    offline_steps: 60
    batch_size: 16
    learning_starts: 20
tasks: [Pendulum-v1]
seeds: 1
steps: 120
evaluation: {every: 30, episodes: 1}
checkpoint_freq: 50
"""


@pytest.mark.slow
def test_a_study_of_agents_that_learn_from_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "Pendulum-v1.hdf5")
    path = tmp_path / "plan.yml"
    path.write_text(PLAN.replace("FOLDER/{task}", f"'{tmp_path}/{{task}}").replace(".hdf5", ".hdf5'"))
    found = study.run(path, tmp_path / "study", workers=1)
    assert found.counts["done"] == 2, found.failures
    table = study.read(tmp_path / "study")
    evaluations = table[table["metric"] == "return"]
    steps = {agent: sorted(rows["step"]) for agent, rows in evaluations.groupby("agent")}
    assert steps == {"BC": [30, 60, 90], "IQL": [30, 60, 90, 120]}
    # The step time is that of a gradient step, also where nothing is collected.
    monkeypatch.setattr(dry_run, "SECONDS", 0.2)
    for run in study.read_plan(path).runs:
        data = {**run.data, **({"offline_steps": 5_000} if "offline_steps" in run.data else {})}
        assert dry_run.measure(dataclasses.replace(run, steps=10_000, data=data), 1, "cpu").seconds > 0
