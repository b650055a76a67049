"""
What an update from pixels costs beside its convolutions, and beside Stable-Baselines3's SAC, all in one run.

    python benchmarks/pixel_cost.py [--threads 2] [--batch-size 64] [--pixels 84] [--steps 2] [--rounds 3]

"ms" is one gradient step with the sampling of its batch; "GFLOP" are the multiplications and additions of its
convolutions (a backward pass counts as two forward passes); "floor" is the time that those take at the rate of the
encoder's forward and backward pass, measured in the same run; and "x floor" the ratio that is to stay below 1.5
compiled. Stable-Baselines3's SAC has the same encoder, three times, and the same layers behind it, without projection
or shifts. The contenders take turns; figures are medians over the rounds. Leave the machine alone meanwhile.
"""

import argparse
import statistics
import time
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3.common.logger import Logger

from sb3_sample import ConvEncoder, DrQ, DrQv2


class Noise(gym.Env):
    """
    Stacks of three random frames in colours; episodes of 100 steps.

    :param pixels: height and width
    """

    stacked_frames = 3
    action_space = spaces.Box(-1, 1, (6,), np.float32)

    def __init__(self, pixels: int) -> None:
        self.frames = np.random.default_rng(0).integers(0, 256, (103, 3, pixels, pixels)).astype(np.uint8)
        self.observation_space = spaces.Box(0, 255, (9, pixels, pixels), np.uint8)
        self.t = 0

    def _observation(self) -> np.ndarray:
        return np.concatenate([self.frames[max(self.t - back, 0)] for back in (2, 1, 0)])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.t = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.t += 1
        return self._observation(), 0.0, False, self.t == 100, {}


def flop(encoder: ConvEncoder, shape: tuple[int, ...]) -> float:
    """Operations of a forward pass of one image."""
    total, x = 0.0, torch.zeros(1, *shape)
    for layer in encoder.layers:
        x = layer(x)
        if isinstance(layer, torch.nn.Conv2d):
            total += 2 * layer.weight[0].numel() * x.numel()
    return total


def seconds(encoder: ConvEncoder, images: torch.Tensor) -> float:
    """Time of a forward and a backward pass."""
    start = time.perf_counter()
    encoder(images).sum().backward()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--batch-size", type=int, default=64)
    parser.add_argument("--pixels", type=int, default=84)
    parser.add_argument("--steps", type=int, default=2, help="gradient steps a round, even")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--eager", action="store_true", help="without the compiled steps")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    size, env = args.batch_size, lambda: Noise(args.pixels)
    common: dict[str, Any] = {"learning_starts": 150, "buffer_size": 200, "batch_size": size, "seed": 0}

    models: dict[str, Any] = {}
    for compiled in (False,) if args.eager else (False, True):
        how = "compiled" if compiled else "eager"
        models[f"DrQ, {how}"] = DrQ("CnnPolicy", env(), compile=compiled, **common)
        models[f"DrQv2, {how}"] = DrQv2("CnnPolicy", env(), compile=compiled, **common)
    kwargs: Any = {"features_extractor_class": ConvEncoder, "net_arch": [1024, 1024]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        models["stable_baselines3.SAC"] = stable_baselines3.SAC("CnnPolicy", env(), policy_kwargs=kwargs, **common)
    # Encoded images of an update in forward passes, a backward pass for two. DrQ: K = M = 2; its actor every second
    # step. Of the others: next actions, target critics, critics and actor, the last two with a backward pass.
    passes = {"DrQ": 2 * 2 + 3 * 2 + 0.5, "DrQv2": 1 + 3, "stable_baselines3.SAC": 1 + 1 + 3 + 3}
    for model in models.values():
        model.set_logger(Logger(None, []))
        with warnings.catch_warnings():
            # That nothing was learned.
            warnings.simplefilter("ignore")
            model.learn(150)
        model.train(2, size)  # compiles, and sets up what is set up once

    encoder = ConvEncoder(env().observation_space)
    images = torch.rand(size, *env().observation_space.shape)
    one = flop(encoder, images.shape[1:])
    seconds(encoder, images)
    of_encoder: list[float] = []
    of_model: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(args.rounds):
        of_encoder.append(seconds(encoder, images))
        for name, model in models.items():
            start = time.perf_counter()
            model.train(args.steps, size)
            of_model[name].append((time.perf_counter() - start) / args.steps)
    rate = 3 * one * size / statistics.median(of_encoder)
    print(
        f"{args.threads} threads, torch {torch.__version__}, stable_baselines3 {stable_baselines3.__version__}, "
        f"batch of {size}, {args.pixels} pixels, convolutions at {rate / 1e9:.0f} GFLOP/s"
    )
    print(f"{'':24}{'ms':>9}{'range':>18}{'GFLOP':>9}{'floor':>9}{'x floor':>9}")
    for name, times in of_model.items():
        work = passes[name.partition(",")[0]] * one * size
        ms = [1e3 * each for each in times]
        floor = 1e3 * work / rate
        median = statistics.median(ms)
        print(
            f"{name:24}{median:9.0f}{min(ms):10.0f} -{max(ms):6.0f}{work / 1e9:9.1f}{floor:9.0f}{median / floor:9.2f}"
        )


if __name__ == "__main__":
    main()
