"""Trainings in one process that are killed and started again are those that were never killed, bit by bit."""

import json
import os
import random
import signal
import threading
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_sample import train_many
from sb3_sample.sac import many
from tests.sac.common import TINY_BRO, TINY_SAC
from tests.sac.test_many import OneAfterTheOther
from tests.saving import program

SEEDS, STEPS, EVERY = (3, 0, 5), 96, 12
CASES: dict[str, dict[str, Any]] = {
    "BRO": {"algorithm": "BRO", "n_envs": 2, "arguments": {**TINY_BRO, "resets": (40,)}},
    "BRO, workers": {"algorithm": "BRO", "n_envs": 2, "workers": True, "arguments": TINY_BRO},
    "VPLSAC": {"algorithm": "VPLSAC", "arguments": {**TINY_SAC, "validation_proportion": 0.25}},
    "SAC, normalised": {"algorithm": "SAC", "normalize": True, "arguments": TINY_SAC},
    "SAC, episodes": {
        "algorithm": "SAC",
        "arguments": {**TINY_SAC, "replay_ratio": None, "train_freq": (1, "episode"), "gradient_steps": -1},
    },
    "SAC, HER": {"algorithm": "SAC", "env": "goal", "arguments": {**TINY_SAC, "learning_starts": 40}},
}


class Forked(SubprocVecEnv):
    def __init__(self, env_fns: Any):
        super().__init__(env_fns, start_method="fork")


def kill(folder: Path, after: int, seconds: float) -> None:
    """SIGKILL this process a while after any run has a checkpoint of so many steps."""
    while not any(int(path.name[-12:]) >= after for path in folder.glob("seed-*/checkpoint-*")):
        time.sleep(0.0005)
    time.sleep(seconds)
    os.kill(os.getpid(), signal.SIGKILL)


def train(case: dict[str, Any], folder: str, together: bool, killed: tuple[int, float] | None = None) -> None:
    """Train all, and write down what came out."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    if together:
        many.joint_of = OneAfterTheOther  # type: ignore[assignment, attr-defined]
    if killed is not None:
        threading.Thread(target=kill, args=(Path(folder), *killed), daemon=True).start()
    env, arguments = case.get("env", "Pendulum-v1"), dict(case["arguments"])
    if env == "goal":
        arguments["replay_buffer_class"] = program.HerReplayBuffer
    makes: Any = lambda: program.make(env)  # noqa: E731
    if case.get("normalize"):
        makes = lambda: VecNormalize(DummyVecEnv([lambda: program.make(env)]))  # noqa: E731
    import sb3_sample

    models = train_many(
        getattr(sb3_sample, case["algorithm"]), "MultiInputPolicy" if env == "goal" else "MlpPolicy", makes,
        seeds=SEEDS, total_timesteps=STEPS, checkpoint=folder, checkpoint_freq=EVERY, n_envs=case.get("n_envs", 1),
        vec_env_cls=Forked if case.get("workers") else None, eval_env=makes,
        eval_freq=24, n_eval_episodes=1, **arguments,
    )  # fmt: skip
    found = {}
    for seed, model in zip(SEEDS, models, strict=True):
        for name, value in program.outcome(model, f"{folder}/seed-{seed}").items():
            # Generators of the process are the caller's again.
            if not name.startswith("generators"):
                found[f"{seed}/{name}"] = value
    Path(f"{folder}.json").write_text(json.dumps(found))


@pytest.mark.slow
@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_killed_and_started_again(name: str, together: bool, tmp_path: Path) -> None:
    rng = random.Random(f"{name} {together}")
    whole = str(tmp_path / "whole")
    program.run(CASES[name], whole, together, target=train)
    assert len(program.result(whole)) > 300
    for i in range(2):
        killed = str(tmp_path / f"killed-{i}")
        when = (rng.choice([24, 36, 48, 60]), rng.uniform(0, 0.05))
        program.run(CASES[name], killed, together, when, target=train, code=-9)
        program.run(CASES[name], killed, together, target=train)
        ours, theirs = program.result(whole), program.result(killed)
        assert not sorted(key for key in ours.keys() | theirs.keys() if ours.get(key) != theirs.get(key))
