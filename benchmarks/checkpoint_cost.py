"""
Cost of a checkpoint: its seconds, its bytes, and its share of the training, as the replay buffer fills.

    python benchmarks/checkpoint_cost.py [--agent BROFast] [--sizes 100000 500000 1000000] [--folder /tmp/cost]

On dog-run of the DeepMind Control suite (observation 223, action 38). The buffer is filled with random numbers instead
of by training, 10,000 steps are added to it, and the checkpoint after them is measured: what it writes, verifies and
removes. The training's own time is that of some hundred steps of ``learn`` after the warm-up, times 10,000. Leave the
machine alone meanwhile; the folder must be on the disk that is asked about.
"""

import argparse
import shutil
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.monitor import Monitor

import sb3_sample
from sb3_sample.envs import make_env
from sb3_sample.saving.checkpoint import Checkpointer

EVERY = 10_000
TRAINED_STEPS = 300
#: Smaller than the default, so that the training is as cheap as it gets beside the checkpoints.
KWARGS: dict[str, dict[str, Any]] = {"BROFast": {"model_size": "0.55M"}}


def build(agent: str, size: int) -> Any:
    """An agent on dog-run, at its first step, with room for a million transitions."""
    env = Monitor(make_env("dmc/dog-run-v0"))
    kwargs = KWARGS.get(agent, {})
    return getattr(sb3_sample, agent)(
        "MlpPolicy", env, buffer_size=max(size, 1_000_000), seed=0, device="cpu", compile=False, **kwargs
    )


def seconds_of_training(agent: str) -> float:
    """Time that ``EVERY`` environment steps of the training take."""
    model = build(agent, 1)
    model.learning_starts = 1_000
    model.learn(1_100)
    start = time.perf_counter()
    model.learn(TRAINED_STEPS, reset_num_timesteps=False)
    return (time.perf_counter() - start) / TRAINED_STEPS * EVERY


def add_rows(model: Any, n: int, rng: np.random.Generator) -> None:
    """Random transitions of one long episode, at once."""
    buffer = model.replay_buffer
    pos = buffer.pos
    for array in (buffer.observations, buffer.actions, buffer.rewards):
        for first in range(pos, pos + n, 10_000):
            rows = array[first : min(first + 10_000, pos + n)]
            rows[...] = rng.standard_normal(rows.shape, dtype=np.float32)
    # The last one is stored as ever, so that the buffer knows its end.
    buffer.slot[pos : pos + n] = -1
    buffer.pos = pos + n - 1
    row = rng.standard_normal((2, 1, *model.observation_space.shape), dtype=np.float32)
    buffer.add(row[0], row[1], np.zeros((1, *model.action_space.shape)), np.zeros(1), np.zeros(1), [{}])
    model.num_transitions += n
    model.num_timesteps += n


def files_in(folder: Path) -> dict[tuple[str, int], int]:
    """Sizes of all files, each file known by what it is, not by its name alone."""
    return {(str(path), path.stat().st_ino): path.stat().st_size for path in folder.rglob("*") if path.is_file()}


def measure(agent: str, size: int, folder: Path, rounds: int) -> tuple[float, int, float]:
    """
    :param agent: class of the algorithm
    :param size: transitions in the buffer
    :param folder: where
    :param rounds: checkpoints to take the median of
    :return: seconds and bytes of a checkpoint, and seconds to go on from it
    """
    shutil.rmtree(folder, ignore_errors=True)
    rng = np.random.default_rng(0)
    model = build(agent, size)
    total, callback = model._setup_learn(10**9)
    # Moments, without which the model's file is half as large.
    model.learning_starts = 0
    add_rows(model, 1_000, rng)
    model.train(2, model.batch_size)
    add_rows(model, size - 1_000 - rounds * EVERY, rng)
    seconds, written = [], []
    with Checkpointer(model, callback, folder, EVERY) as checkpointer:
        callback.on_training_start({"total_timesteps": total}, {})
        checkpointer.start()
        for _ in range(rounds):
            add_rows(model, EVERY, rng)
            before = files_in(folder)
            start = time.perf_counter()
            checkpointer.after_turn()
            seconds.append(time.perf_counter() - start)
            after = files_in(folder)
            written.append(sum(after[name] for name in after.keys() - before.keys()))
        total = model.num_timesteps
    again = build(agent, size)
    again.learning_starts = 0
    start = time.perf_counter()
    again.learn(total, checkpoint=folder)
    going_on = time.perf_counter() - start
    assert again.num_transitions == model.num_transitions
    assert np.array_equal(again.replay_buffer.observations, model.replay_buffer.observations)
    shutil.rmtree(folder)
    return statistics.median(seconds), int(statistics.median(written)), going_on


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agent", default="BROFast")
    parser.add_argument("--sizes", type=int, nargs="+", default=[100_000, 500_000, 1_000_000])
    parser.add_argument("--folder", type=Path, default=Path("/tmp/checkpoint_cost"))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    training = seconds_of_training(args.agent)
    print(f"{args.agent} on dog-run: {EVERY} environment steps take {training:.0f} s of training")
    print("| transitions | checkpoint (s) | written (MB) | share of the time | going on (s) |")
    print("| --- | --- | --- | --- | --- |")
    for size in args.sizes:
        seconds, written, going_on = measure(args.agent, size, args.folder, args.rounds)
        share = seconds / (training + seconds)
        print(f"| {size:,} | {seconds:.2f} | {written / 1e6:.1f} | {share:.2%} | {going_on:.1f} |", flush=True)


if __name__ == "__main__":
    main()
