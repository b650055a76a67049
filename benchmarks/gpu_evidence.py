"""
Learning curves of BRO Fast on a GPU, ten seeds at a time, as far as the time goes.

    python benchmarks/gpu_evidence.py FOLDER [--task cheetah-run] [--seconds 300] [--processes 3]

The seeds are shared out to processes, each of which trains its own with ``train_many``: what is done on the host, and
the environments, then take as many cores. Every ``--eval-freq`` environment steps (action repeat 1) the mean return of
``--episodes`` episodes is written to ``FOLDER/<task>.csv``: columns ``task``, ``seed``, ``step``, ``return``,
``episodes``, ``seconds`` and ``updates``.
"""

import argparse
import csv
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_sample import BROFast, train_many

COLUMNS = ("task", "seed", "step", "return", "episodes", "seconds", "updates")


class Curve(BaseCallback):
    """Evaluates at regular steps, and ends the training when the time is over."""

    def __init__(self, args: argparse.Namespace, seed: int, path: Path, end: float):
        super().__init__()
        self.args, self.seed, self.path, self.end, self.start = args, seed, path, end, time.time()
        self.env = make_vec_env(f"dmc/{args.task}-v0", args.episodes)
        self.env.seed(10_000 + seed)

    def _on_step(self) -> bool:
        now = self.model.num_timesteps
        is_over = now % 100 == 0 and time.time() > self.end
        if now % self.args.eval_freq == 0 or is_over:
            self.evaluate(now)
        return not is_over

    def evaluate(self, now: int) -> None:
        """Write the mean return of some episodes."""
        mean, _ = evaluate_policy(self.model, self.env, self.args.episodes, deterministic=True)
        model: Any = self.model
        row = (self.args.task, self.seed, now, f"{mean:.2f}", self.args.episodes)
        with open(self.path, "a", newline="") as file:
            csv.writer(file).writerow((*row, f"{time.time() - self.start:.0f}", model._n_updates))


def train(args: argparse.Namespace, seeds: list[int], end: float) -> None:
    torch.set_num_threads(1)
    start = time.time()
    models = train_many(
        BROFast,
        "MlpPolicy",
        f"dmc/{args.task}-v0",
        seeds=seeds,
        total_timesteps=args.steps,
        callback=lambda index: Curve(args, seeds[index], args.folder / f"{args.task}-{seeds[index]}.csv", end),
        model_size=args.model_size,
        device=args.device,
        compile=args.device != "cpu",
    )
    steps = sum(model.num_timesteps for model in models)
    updates = sum(model._n_updates for model in models)
    compiling = models[0].learner.seconds_compiling
    print(
        f"seeds {seeds}: {steps} steps, {updates} updates in {time.time() - start:.0f} s (compiling {compiling:.0f} s)",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the results")
    parser.add_argument("--task", default="cheetah-run", help="of DeepMind Control")
    parser.add_argument("--seconds", type=float, default=300, help="after which trainings end")
    parser.add_argument("--processes", type=int, default=3)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)))
    parser.add_argument("--steps", type=int, default=100_000, help="of a learner")
    parser.add_argument("--eval-freq", type=int, default=25_000)
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--model-size", default="0.55M")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--end", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    if args.end is not None:
        train(args, args.seeds, args.end)
        return
    # Each seed's rows are added to a file of its own; those of a call that was interrupted are not of this one.
    for path in args.folder.glob(f"{args.task}-*.csv"):
        path.unlink()
    end = time.time() + args.seconds
    shares = [args.seeds[i :: args.processes] for i in range(args.processes)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "TORCHINDUCTOR_COMPILE_THREADS": "5"}
    arguments = sys.argv[1:]
    running = [
        subprocess.Popen(
            [sys.executable, __file__, *arguments, "--end", str(end), "--seeds", *map(str, share)], env=environment
        )
        for share in shares
        if share
    ]
    codes = [process.wait() for process in running]
    rows = [row for path in args.folder.glob(f"{args.task}-*.csv") for row in csv.reader(path.open())]
    rows.sort(key=lambda row: (int(row[1]), int(row[2])))
    with open(args.folder / f"{args.task}.csv", "w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
    for path in args.folder.glob(f"{args.task}-*.csv"):
        path.unlink()
    print(f"{len(rows)} evaluations in {args.folder / f'{args.task}.csv'}")
    # A process that was killed has a negative one.
    raise SystemExit(int(any(codes)))


if __name__ == "__main__":
    main()
