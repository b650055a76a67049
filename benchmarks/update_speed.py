"""
Time of one gradient step, beside what the machine can do and beside Stable-Baselines3, all in one run.

    python benchmarks/update_speed.py [--threads 2] [--rounds 7]

The contenders take turns, so that a drift of the machine's speed touches all alike; figures are medians over the
rounds, with the range. Leave the machine alone meanwhile: with a busy second core, two threads can be ten times slower
than one. "x matmul" is the time over the time of the step's matrix multiplications at the rate at which this machine
multiplies 2 x 128 x 512 by 2 x 512 x 512 (FLOPs counted by torch).
"""

import argparse
import platform
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
from torch.utils.flop_counter import FlopCounterMode

from sb3_sample import BRO, SAC
from sb3_sample.sac.bro import MODEL_SIZES
from sb3_sample.sac.losses import quantile_huber

OBSERVATION, ACTION = 17, 6  # cheetah-run


class Shapes(gym.Env):
    """An environment that has only shapes: this benchmark is about the update."""

    observation_space = spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float32)
    action_space = spaces.Box(-1, 1, (ACTION,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return np.zeros(OBSERVATION, np.float32), {}

    def step(self, action: np.ndarray) -> Any:
        return np.zeros(OBSERVATION, np.float32), 0.0, False, False, {}


def build(algorithm: Any, **kwargs: Any) -> Any:
    """A model with random transitions in its buffer."""
    model = algorithm("MlpPolicy", Shapes(), buffer_size=2_000, seed=0, **kwargs)
    model.set_logger(Logger(None, []))
    rng = np.random.default_rng(0)
    for _ in range(1_000):
        obs, next_obs = rng.normal(size=(2, 1, OBSERVATION))
        action, reward = rng.uniform(-1, 1, (1, ACTION)), rng.uniform(size=1)
        model.replay_buffer.add(obs, next_obs, action, reward, np.zeros(1), [{}])
    model._last_obs = np.zeros((1, OBSERVATION), np.float32)
    return model


def training_step(model: Any, batch_size: int) -> Callable[[], None]:
    """One gradient step as training takes it, with sampling of the batch."""
    return lambda: model.train(gradient_steps=1, batch_size=batch_size)


def acting(model: Any) -> Callable[[], None]:
    """One action for one observation, after the warm-up."""
    model.num_transitions = model.num_timesteps = 10**6
    return lambda: model._sample_action(learning_starts=0)


def pairwise_quantile_huber(q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """The same loss from its definition, over all pairs of quantiles, by autograd."""
    difference = target[None, :, None, :] - q[..., None]
    huber = torch.where(difference.abs() <= 1, 0.5 * difference.square(), difference.abs() - 0.5)
    midpoints = (torch.arange(q.shape[2]) + 0.5) / q.shape[2]
    weight = (midpoints[:, None] - (difference < 0).float()).abs()
    return (weight * huber).sum() / (target.shape[0] * target.shape[1])


def loss_step(loss: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> Callable[[], None]:
    torch.manual_seed(0)
    q = torch.randn(2, 128, 100).sort(dim=2).values.add_(0.3 * torch.randn(2, 128, 100)).requires_grad_()
    target = torch.randn(128, 100)
    return lambda: torch.autograd.grad(loss(q, target), q)


def measure(contenders: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Seconds a call by name, one figure a round; the contenders take turns."""
    repeats = {}
    for name, call in contenders.items():
        for _ in range(3):
            call()
        start = time.perf_counter()
        call()
        repeats[name] = max(3, int(0.1 / (time.perf_counter() - start)))
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, call in contenders.items():
            start = time.perf_counter()
            for _ in range(repeats[name]):
                call()
            seconds[name].append((time.perf_counter() - start) / repeats[name])
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--device", default="cpu", help="of the models; the ratios to matmul are a CPU's")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)

    bros = {name: build(BRO, model_size=name, device=args.device) for name in MODEL_SIZES if name != "26.31M"}
    sac = build(SAC, device=args.device)
    theirs = build(stable_baselines3.SAC, device=args.device)
    x, w = torch.randn(2, 128, 512), torch.randn(2, 512, 512)
    steps = {f"BRO {name}": training_step(model, 128) for name, model in bros.items()}
    steps["SAC (sb3_sample)"] = training_step(sac, 256)
    steps["SAC (stable_baselines3)"] = training_step(theirs, 256)
    flops = {}
    for name, step in steps.items():
        with FlopCounterMode(display=False) as counter:
            step()
        flops[name] = counter.get_total_flops()

    contenders: dict[str, Callable[[], Any]] = {"matmul": lambda: torch.bmm(x, w), **steps}
    contenders["acting: BRO 4.92M"] = acting(bros["4.92M"])
    contenders["acting: SAC (sb3_sample)"] = acting(sac)
    contenders["acting: SAC (stable_baselines3)"] = acting(theirs)
    contenders["quantile Huber, sorted"] = loss_step(quantile_huber)
    contenders["quantile Huber, pairs"] = loss_step(pairwise_quantile_huber)
    seconds = measure(contenders, args.rounds)

    median = {name: statistics.median(values) for name, values in seconds.items()}
    rate = 2 * 2 * 128 * 512 * 512 / median["matmul"]
    print(f"{platform.processor() or platform.machine()}, {args.threads} threads, torch {torch.__version__}, "
          f"stable_baselines3 {stable_baselines3.__version__}, device {args.device}")  # fmt: skip
    print(f"matmul 2x128x512 by 2x512x512: {rate / 1e9:.0f} GFLOP/s\n")
    print(f"{'':34}{'ms':>9}{'range':>18}{'GFLOP':>8}{'x matmul':>10}")
    for name, values in seconds.items():
        line = f"{name:34}{1e3 * median[name]:9.3f}{1e3 * min(values):9.3f} -{1e3 * max(values):7.3f}"
        if name in flops:
            line += f"{flops[name] / 1e9:8.2f}{median[name] / (flops[name] / rate):10.2f}"
        print(line)
    print()

    def ratio(label: str, name: str, other: str) -> None:
        print(f"{label}: {median[name] / median[other]:.2f}")

    ratio("SAC, sb3_sample / stable_baselines3", "SAC (sb3_sample)", "SAC (stable_baselines3)")
    ratio("BRO 4.92M, acting / gradient step", "acting: BRO 4.92M", "BRO 4.92M")
    ratio("SAC, acting / gradient step", "acting: SAC (sb3_sample)", "SAC (sb3_sample)")
    ratio("quantile Huber, pairs / sorted", "quantile Huber, pairs", "quantile Huber, sorted")


if __name__ == "__main__":
    main()
