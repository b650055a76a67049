"""
Cost of each agent beside SAC, all in one run.

    python benchmarks/agent_cost.py [--threads 2] [--rounds 7]

"gradient step" is one update with the sampling of its batch; "environment step" is one step of ``learn`` at replay
ratio 2: acting, storing, two updates. The environment itself costs next to nothing, so that a real one brings the
ratios nearer to 1. The contenders take turns; figures are medians over the rounds, and the ratios medians of each
round's ratio. Leave the machine alone meanwhile.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3.common.logger import Logger

import sb3_sample

#: Agents with the same networks, batch and replay ratio, and the ratio to SAC that was aimed at.
AGENTS: dict[str, float | None] = {
    "SAC": None,
    "DAC": 1.15,
    "VPLSAC": 1.05,
    "GPLSAC": 1.01,
    "TOPSAC": 1.01,
    "OPLSAC": 1.07,
    "OAC": None,
}


class Noise(gym.Env):
    """Random observations and rewards; episodes of 1000 steps."""

    observation_space = spaces.Box(-np.inf, np.inf, (17,), np.float32)
    action_space = spaces.Box(-1, 1, (6,), np.float32)

    def __init__(self) -> None:
        self.numbers = np.random.default_rng(0).normal(size=(1_000, 18)).astype(np.float32)
        self.t = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.t = 0
        return self.numbers[0, :17], {}

    def step(self, action: np.ndarray) -> Any:
        row = self.numbers[self.t]
        self.t += 1
        return row[:17], float(row[17]), False, self.t == 1_000, {}


def build(agent: str) -> Any:
    """An agent in the midst of training."""
    model = getattr(sb3_sample, agent)("MlpPolicy", Noise(), learning_starts=600, buffer_size=100_000, seed=0)
    model.set_logger(Logger(None, []))
    return model.learn(650)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, default=100, help="environment steps a round")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)

    models = {name: build(name) for name in AGENTS}
    work: dict[str, Callable[[Any], Any]] = {
        "gradient step": lambda model: model.train(args.steps, 256),
        "environment step": lambda model: model.learn(args.steps, reset_num_timesteps=False, log_interval=10**9),
    }
    print(f"{args.threads} threads, torch {torch.__version__}, stable_baselines3 {stable_baselines3.__version__}")
    for what, do in work.items():
        seconds: dict[str, list[float]] = {name: [] for name in models}
        for _ in range(args.rounds):
            for name, model in models.items():
                start = time.perf_counter()
                do(model)
                seconds[name].append((time.perf_counter() - start) / args.steps)
        print(f"\n{what:18}{'ms':>9}{'range':>18}{'x SAC':>8}{'aim':>7}")
        for name, aim in AGENTS.items():
            ratio = statistics.median(a / b for a, b in zip(seconds[name], seconds["SAC"], strict=True))
            ms = [1e3 * s for s in seconds[name]]
            line = f"{name:18}{statistics.median(ms):9.2f}{min(ms):10.2f} -{max(ms):6.2f}{ratio:8.2f}"
            print(line if aim is None else f"{line}{aim:7.2f}")


if __name__ == "__main__":
    main()
