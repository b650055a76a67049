"""A study of SAC that is killed in several ways, beside one that nobody disturbs."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("rl_zoo3")

from sb3_sample import SAC, study

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.slow
PLAN = """\
agents:
  SAC:
    algo: sac_sample
    learning_starts: 50
    buffer_size: 2000
    replay_ratio: 0.5
    policy_kwargs: {net_arch: [8]}
tasks: [Pendulum-v1]
seeds: [3, 4]
steps: 1_500
evaluation: {every: 500, episodes: 1}
checkpoint_freq: 300
"""


def start(plan: Path, folder: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sb3_sample.cli", "study", "run", str(plan), "--folder", str(folder)]
    return subprocess.Popen(
        [*command, "--workers", "1", "--device", "cpu", *options],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(scheduler: subprocess.Popen[str]) -> str:
    said = scheduler.communicate(timeout=500)[0]
    assert scheduler.returncode == 0, said
    return said


def process_of(folder: Path, seed: int, checkpoint: int, scheduler: subprocess.Popen[str]) -> int:
    """The process that makes a run, as soon as that has a checkpoint, and before it has the last one."""
    run, end = folder / f"runs/SAC/Pendulum-v1/{seed}", time.monotonic() + 300
    while not (run / f"checkpoint-{checkpoint:012d}").exists():
        assert scheduler.poll() is None and time.monotonic() < end
        time.sleep(0.005)
    assert not (run / "Pendulum-v1.zip").exists()
    return int((folder / f"state/SAC/Pendulum-v1/{seed}.lock").read_text().split()[-1])


def settled(folder: Path) -> study.Status:
    """The status when no process has a run any more."""
    end = time.monotonic() + 60
    while (found := study.status(folder)).counts["running"]:
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def outcome(folder: Path, seed: int) -> Iterator[tuple[str, Any]]:
    run = folder / f"runs/SAC/Pendulum-v1/{seed}"
    model = SAC.load(run / "Pendulum-v1.zip", device="cpu")
    yield "steps", model.num_timesteps
    yield "updates", model._n_updates
    for name, state in model.get_parameters().items():
        yield from ((f"{name}.{key}", value.numpy()) for key, value in state.items() if isinstance(value, torch.Tensor))
    yield from np.load(run / "evaluations.npz").items()
    yield "episodes", [line.split(",")[:2] for line in (run / "0.monitor.csv").read_text().splitlines()[1:]]


def test_killed_studies_end_where_an_undisturbed_one_does(tmp_path: Path) -> None:
    plan, whole, killed = tmp_path / "plan.yml", tmp_path / "whole", tmp_path / "killed"
    plan.write_text(PLAN)
    finish(start(plan, whole))

    # The process that makes the first run is killed.
    scheduler = start(plan, killed)
    first = process_of(killed, 3, 600, scheduler)
    os.kill(first, signal.SIGKILL)
    # Another one makes the second run meanwhile, which is killed with the scheduler, as in a power cut.
    second = process_of(killed, 4, 300, scheduler)
    scheduler.kill()
    os.kill(second, signal.SIGKILL)
    scheduler.wait()
    found = settled(killed)
    assert [each.state for each in found.runs] == ["failed", "waiting"]
    assert found.failures[found.runs[0].run.title] == "the process that made the run was ended by SIGKILL"
    # Then the scheduler alone, ...
    scheduler = start(plan, killed)
    third = process_of(killed, 3, 900, scheduler)
    scheduler.kill()
    scheduler.wait()
    settled(killed)  # the process writes a checkpoint, and ends
    # ... and at last there is Ctrl-C.
    scheduler = start(plan, killed)
    fourth = process_of(killed, 4, 900, scheduler)
    assert len({first, second, third, fourth}) == 4
    scheduler.send_signal(signal.SIGINT)
    said = scheduler.communicate(timeout=100)[0]
    assert scheduler.returncode == 130 and "the same command goes on" in said
    assert "2 done, 0 running, 0 failed, 0 waiting" in finish(start(plan, killed))

    # The undisturbed study's two runs were made by one process, one after the other.
    assert len({(whole / f"state/SAC/Pendulum-v1/{seed}.lock").read_text() for seed in (3, 4)}) == 1
    for seed in (3, 4):
        undisturbed, disturbed = dict(outcome(whole, seed)), dict(outcome(killed, seed))
        assert undisturbed.keys() == disturbed.keys() and undisturbed["steps"] == 1500
        assert [name for name in undisturbed if not np.array_equal(undisturbed[name], disturbed[name])] == []
    assert not np.array_equal(dict(outcome(whole, 3))["results"], dict(outcome(whole, 4))["results"])


BROKEN = """\
import gymnasium as gym
from gymnasium.envs.classic_control import PendulumEnv

class Broken(PendulumEnv):
    def step(self, action):
        raise RuntimeError("the cable is off")

gym.register("Broken-v0", Broken, max_episode_steps=200)
"""


def test_a_failed_run_is_named_and_the_others_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, folder = tmp_path / "plan.yml", tmp_path / "study"
    (tmp_path / "robots_of_ones_own.py").write_text(BROKEN)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    plan.write_text(
        "gym_packages: [robots_of_ones_own]\n"
        + PLAN.replace("[Pendulum-v1]", "[Broken-v0, Pendulum-v1]").replace("[3, 4]", "[3]")
    )
    scheduler = start(plan, folder, "--retries", "0")
    said = scheduler.communicate(timeout=500)[0]
    assert scheduler.returncode == 1, said
    assert "1 done, 0 running, 1 failed, 0 waiting" in said
    assert "failed after 1 attempt: SAC on Broken-v0, seed 3\n    Traceback" in said and "the cable is off" in said
    assert (folder / "runs/SAC/Pendulum-v1/3/Pendulum-v1.zip").exists()
