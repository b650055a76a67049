"""Whole trainings, and the memory of a large one."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

from sb3_sample import MBMAPPO, MBPOPPO

ROOT = Path(__file__).parents[2]


def final_return(cls: Any, **kwargs: Any) -> float:
    """Mean return of the last 20 episodes of a training on Pendulum."""
    env = make_vec_env("Pendulum-v1", 2, seed=0)
    policy_kwargs = {"net_arch": [64, 64]}
    common: dict[str, Any] = dict(n_steps=512, learning_rate=1e-3, gamma=0.9, seed=0, policy_kwargs=policy_kwargs)
    model = cls("MlpPolicy", env, device="cpu", **common, **kwargs).learn(21_504)
    assert model.ep_info_buffer is not None
    return float(np.mean([episode["r"] for episode in list(model.ep_info_buffer)[-20:]]))


@pytest.mark.slow
def test_simulated_samples_learn_faster_than_ppo() -> None:
    model = {"dynamics_kwargs": {"width": 128, "learning_rate": 1e-3}}
    ppo = final_return(MBMAPPO, n_simulated=0)
    for cls in (MBMAPPO, MBPOPPO):
        assert final_return(cls, **model) > ppo + 200, cls


@pytest.mark.slow
def test_a_large_iteration_takes_less_than_two_gigabytes() -> None:
    # Horizon and epochs do not change the peak: pieces of a simulation and minibatches come one after another.
    command = [sys.executable, "benchmarks/simulated_ppo.py", "--memory", "--horizon", "2", "--epochs", "1"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    options: dict[str, Any] = dict(env=environment, capture_output=True, text=True, timeout=300, check=True)
    printed = subprocess.run(command, cwd=ROOT, **options).stdout
    assert float(printed.split("actions: ")[1].split(" GiB")[0]) < 2e9 / 2**30
