"""
Train BRO with the mean of every metric over each 500 steps in a log, and evaluations as published, to set beside the
logs and the seeds of the authors' code.

    OMP_NUM_THREADS=1 python benchmarks/bro_log.py --task cheetah-run --seed 0 --steps 50000

``--resets-to fresh``: the reset draws new parameters, unlike the published code, whose runs return to their own
first ones.

A line of JSON every ``--every`` steps goes to ``OUTPUT/TASK/rr<replay ratio>_seed<seed>.jsonl``: means of the metrics
since the line before, norms of all parameters of actor, optimistic actor and critics, and at multiples of
``--eval-freq`` the return of 5 episodes of the mean action.
"""

import argparse
import json
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_sample import BROFast
from sb3_sample.learner.plasticity import RESETS_TO


class Logged(BROFast):
    """BRO Fast that adds up what its gradient steps report."""

    def _update(self, *args: Any, **kwargs: Any) -> dict[str, torch.Tensor]:
        metrics = super()._update(*args, **kwargs)
        for name, value in metrics.items():
            SUMS[name] += float(value)
            COUNTS[name] += 1
        return metrics


SUMS: dict[str, float] = defaultdict(float)
COUNTS: dict[str, int] = defaultdict(int)


def norm(module: torch.nn.Module) -> float:
    return float(torch.stack([p.detach().square().sum() for p in module.parameters()]).sum().sqrt())


class Log(BaseCallback):
    def __init__(self, file: Path, every: int, eval_freq: int, env: Any):
        super().__init__()
        self.file, self.every, self.eval_freq, self.eval_env = file, every, eval_freq, env
        self.start = time.time()

    def _on_step(self) -> bool:
        step = self.num_timesteps
        if step % self.every == 0:
            # The step just taken has had no gradient steps yet: the line covers those of the steps before.
            line: dict[str, Any] = {"step": step, "seconds": round(time.time() - self.start)}
            line |= {name: SUMS[name] / COUNTS[name] for name in SUMS}
            SUMS.clear()
            COUNTS.clear()
            assert isinstance(self.model, BROFast)
            modules = {"actor": self.model.actor, "explorer": self.model.explorer, "critic": self.model.critic}
            line |= {f"norm/{name}": norm(module) for name, module in modules.items()}
            if step % self.eval_freq == 0:
                returns, _ = evaluate_policy(self.model, self.eval_env, 5, return_episode_rewards=True)
                line |= {"mean": float(np.mean(returns)), "returns": [round(float(r), 1) for r in returns]}
            with self.file.open("a") as out:
                out.write(json.dumps(line) + "\n")
        return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="cheetah-run")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--replay-ratio", type=int, default=2)
    parser.add_argument("--model-size", default="0.55M")
    parser.add_argument("--every", type=int, default=500)
    parser.add_argument("--eval-freq", type=int, default=12_500)
    parser.add_argument("--resets-to", default="start", choices=RESETS_TO)
    parser.add_argument("--output", type=Path, default=Path("runs"))
    args = parser.parse_args()
    torch.set_num_threads(1)

    file = args.output / args.task / f"rr{args.replay_ratio}_seed{args.seed}.jsonl"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.unlink(missing_ok=True)
    env_id = f"dmc/{args.task}-v0"
    model = Logged(
        "MlpPolicy", make_vec_env(env_id, seed=args.seed), replay_ratio=args.replay_ratio, model_size=args.model_size,
        seed=args.seed, resets_to=args.resets_to, device="cpu",
    )  # fmt: skip
    log = Log(file, args.every, args.eval_freq, make_vec_env(env_id, seed=args.seed + 1_000))
    model.learn(args.steps, callback=log)


if __name__ == "__main__":
    main()
