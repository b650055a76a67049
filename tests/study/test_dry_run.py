"""What a plan costs, measured before it is run."""

import dataclasses
import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

pytest.importorskip("rl_zoo3")

from sb3_sample import cli, study
from sb3_sample.study import dry_run as module
from sb3_sample.study.dry_run import Cost
from sb3_sample.study.plan import Plan, Run
from sb3_sample.study.runs import StudyFolder
from sb3_sample.study.stopwatch import Stopwatch
from sb3_sample.study.worker import train


@pytest.mark.slow
def test_a_dry_run_measures_and_runs_nothing(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(module, "SECONDS", 0.2)
    plan = tmp_path / "tiny.yml"
    plan.write_text(
        "agents:\n  SAC: {algo: sac_sample, replay_ratio: 0.5, buffer_size: 1000, policy_kwargs: {net_arch: [8]}}\n"
        "tasks: [Pendulum-v1]\nseeds: 4\nsteps: 30_000\n"
    )
    cli.main(["study", "run", str(plan), "--folder", str(tmp_path / "folder"), "--workers", "2", "--dry-run"])
    said = capsys.readouterr()
    assert said.out.startswith("4 runs, 0 of them done. The others take ")
    assert said.err == "measuring SAC on Pendulum-v1\n"
    assert sorted(os.listdir(tmp_path)) == ["tiny.yml"]


def test_a_pair_that_was_not_measured_is_the_product_of_two_ratios(tmp_path: Path, monkeypatch) -> None:
    measured = {
        ("A", "x"): Cost(1.0, 100.0, 10.0), ("B", "x"): Cost(3.0, 400.0, 10.0), ("A", "y"): Cost(2.0, 200.0, 50.0),
    }  # fmt: skip
    asked = []

    def measure(run: Run, threads: int, device: str) -> Cost:
        asked.append((run.agent, run.task))
        return measured[run.agent, run.task]

    monkeypatch.setattr(module, "measure", measure)
    base = Run("A", "sac_sample", {"buffer_size": 20}, {}, "x", 0, 3600)
    runs = [dataclasses.replace(base, agent=a, task=t, seed=s) for s in (0, 1) for a in "AB" for t in "xy"]
    found = study.estimate(Plan("made up", tuple(runs)), tmp_path, workers=3)
    assert sorted(asked) == sorted(measured)
    assert found.n_runs == 8 and found.n_done == 0 and found.workers == 3
    assert found.hours == pytest.approx(2 * (1 + 2 + 3 + 3 * 2))
    # Of each run all but the replay buffer, and its 20 rows.
    assert found.n_bytes == pytest.approx(2 * (100 + 200 + 400 + 800 + 20 * (10 + 50 + 10 + 50)))


def test_steps_that_runs_under_way_have_made_are_not_counted(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(module, "measure", lambda run, threads, device: Cost(1.0, 100.0, 10.0))
    base = Run("A", "sac_sample", {}, {}, "x", 0, 3600, 500, 3)
    runs = [base, dataclasses.replace(base, seed=1)]
    (StudyFolder(tmp_path).place(base) / "checkpoint-000000000900").mkdir(parents=True)
    found = study.estimate(Plan("made up", tuple(runs)), tmp_path, workers=1)
    assert found.hours == pytest.approx(1.75) and found.n_done == 0
    # Seven evaluations of three episodes, and six that are left of the other's.
    assert found.n_episodes == 39 and "1.75 with 1 at once (evaluations of 39 episodes apart)" in str(found)
    assert found.n_bytes == pytest.approx(2 * (100 + 3600 * 10))


def test_agents_are_measured_on_the_data_that_they_have(tmp_path: Path, monkeypatch) -> None:
    asked = []

    def measure(run: Run, threads: int, device: str) -> Cost:
        asked.append((run.agent, run.task, run.data))
        return Cost({"A": 1.0, "B": 3.0}[run.agent], 1.0, 0.0)

    monkeypatch.setattr(module, "measure", measure)
    base = Run("A", "iql", {}, {}, "x", 0, 3600, data={"dataset": "of x"})
    elsewhere = dataclasses.replace(base, task="y", data={"dataset": "of y"})
    found = study.estimate(Plan("made up", (base, elsewhere, dataclasses.replace(elsewhere, agent="B"))), tmp_path)
    assert asked == [(agent, task, {"dataset": f"of {task}"}) for agent, task in (("A", "x"), ("A", "y"), ("B", "y"))]
    assert found.hours == pytest.approx(1 + 1 + 3)
    timed = dataclasses.replace(base, algo="bro_fast", task="dmc/cheetah-run-v0", arguments={"model_size": "0.55M"})
    times: Any = SimpleNamespace(gradient_step={"0.55M": 0.5}, how="eager")
    assert module.seconds_of_learning(timed, times) is None
    assert module.seconds_of_learning(dataclasses.replace(timed, data={}), times) == 1.0


class _Run:
    """As much of a training as the stopwatch asks for."""

    def __init__(self, buffer: ReplayBuffer):
        self.num_timesteps, self._n_updates, self.replay_buffer, self.logger = 0, 0, buffer, None

    def get_env(self) -> None:
        return None


def test_a_run_that_ends_early_is_measured_and_so_is_its_replay_buffer(tmp_path: Path) -> None:
    observations, actions = spaces.Box(-1, 1, (50,)), spaces.Box(-1, 1, (10,))
    model: Any = _Run(ReplayBuffer(1000, observations, actions, handle_timeout_termination=False))
    watch = Stopwatch(str(tmp_path / "times.json"), 1e6)
    watch.init_callback(model)
    row = np.zeros((1, 50), np.float32)
    for step in range(20):
        watch.on_rollout_start()
        model.replay_buffer.add(row, row, np.zeros((1, 10)), np.zeros(1), np.zeros(1), [{}])
        model.num_timesteps, model._n_updates = step + 1, step
        assert watch.on_step()
    assert not os.listdir(tmp_path)
    watch.on_training_end()
    found = json.loads((tmp_path / "times.json").read_text())
    assert 0 < found["steps"] < 20 and found["seconds"] > 0
    assert found["bytes_of_step"] == 4 * (50 + 50 + 10 + 1 + 1 + 1)  # reward, done, timeout


@pytest.mark.slow
def test_the_replay_buffer_that_is_foretold_is_that_of_a_run(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(module, "SECONDS", 1e6)
    run = Run("A", "sac_sample", {"replay_ratio": 0.1}, {}, "Pendulum-v1", 0, 900, eval_freq=900, eval_episodes=1)
    found = module.measure(run, 1, "cpu")
    train(run, tmp_path / "run", ["--device", "cpu"])
    real = sum(path.stat().st_size for path in (tmp_path / "run/replay").iterdir()) / 900
    assert real / 2 < found.bytes_of_step < 2 * real


@pytest.mark.slow
def test_what_cannot_be_measured_is_an_error(tmp_path: Path) -> None:
    run = Run("A", "sac_sample", {}, {}, "CartPole-v1", 0, 30_000)
    with pytest.raises(RuntimeError, match="A on CartPole-v1, seed 0 cannot be measured: .*Discrete") as caught:
        study.estimate(Plan("bad", (run,)), tmp_path, workers=1)
    assert isinstance(caught.value, module.MeasurementFailed) and "Traceback" in caught.value.output
