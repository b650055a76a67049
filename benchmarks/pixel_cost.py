"""
Cost of an update from pixels beside its multiplications, and beside Stable-Baselines3's, all in one run.

    python benchmarks/pixel_cost.py [--threads 2] [--batch-size 64] [--pixels 84] [--steps 2] [--rounds 3]

"ms" is one gradient step with the sampling of its batch; "GFLOP" are its multiplications and additions, forward and
backward, counted by ``torch.utils.flop_counter`` over two eager ones; "floor" is the time that those take at the rate
of a forward and a backward pass of the agent's own encoder on one batch, measured in the same run; and "x floor" the
ratio that is to stay below 1.5 compiled. Stable-Baselines3's SAC has DrQ's encoder, three times, and the same layers
behind it, without projection or shifts; its DQN sees SR-SPR's observations, in batches of as many, through its own
encoder. The contenders take turns; figures are medians over the rounds. Leave the machine alone meanwhile.
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
from stable_baselines3.common.torch_layers import NatureCNN
from torch.utils.flop_counter import FlopCounterMode

from sb3_sample import SRSPR, ConvEncoder, DrQ, DrQv2
from sb3_sample.srspr.networks import Encoder

#: Random transitions before the first gradient step.
ROWS = 150
#: SR-SPR's own batch size.
SRSPR_BATCH = 32


class Noise(gym.Env):
    """
    Stacks of random frames; episodes of 100 steps.

    :param pixels: height and width
    :param n_frames: of a stack
    :param n_channels: of a frame
    :param action_space: of the actions, which change nothing
    """

    def __init__(self, pixels: int, n_frames: int, n_channels: int, action_space: spaces.Space[Any]) -> None:
        shape = (100 + n_frames, n_channels, pixels, pixels)
        self.frames = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
        self.stacked_frames, self.action_space = n_frames, action_space
        self.observation_space = spaces.Box(0, 255, (n_frames * n_channels, pixels, pixels), np.uint8)
        self.t = 0

    def _observation(self) -> np.ndarray:
        return np.concatenate([self.frames[max(self.t - back, 0)] for back in reversed(range(self.stacked_frames))])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.t = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.t += 1
        return self._observation(), 0.0, False, self.t == 100, {}


def gflop(model: Any) -> float:
    """Work of a gradient step, the mean of two."""
    with FlopCounterMode(display=False) as counter:
        model.train(2, model.batch_size)
    return counter.get_total_flops() / 2e9


def encoder_of(model: Any) -> torch.nn.Module:
    """A fresh one of the agent's encoder."""
    if isinstance(model, SRSPR):
        return Encoder(model.observation_space.shape, (32, 64, 64))
    if isinstance(model, stable_baselines3.DQN):
        return NatureCNN(model.observation_space)
    return ConvEncoder(model.observation_space)


def encoder_rate(model: Any, rounds: int) -> float:
    """GFLOP/s of the encoder, forward and backward, on a batch in the layout in which it is quicker."""
    encoder, images = encoder_of(model), torch.rand(model.batch_size, *model.observation_space.shape)
    with FlopCounterMode(display=False) as counter:
        encoder(images).sum().backward()
    medians = []
    for layout in (torch.contiguous_format, torch.channels_last):
        turned, seconds = images.contiguous(memory_format=layout), []
        for _ in range(rounds + 1):
            start = time.perf_counter()
            encoder(turned).sum().backward()
            seconds.append(time.perf_counter() - start)
        medians.append(statistics.median(seconds[1:]))
    return counter.get_total_flops() / 1e9 / min(medians)


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
    size, actions = args.batch_size, spaces.Box(-1, 1, (6,), np.float32)
    colours: Any = lambda: Noise(args.pixels, 3, 3, actions)  # noqa: E731
    atari: Any = lambda: Noise(84, 4, 1, spaces.Discrete(6))  # noqa: E731
    common: dict[str, Any] = {"learning_starts": ROWS, "buffer_size": 2 * ROWS, "seed": 0}
    of_atari = {**common, "batch_size": SRSPR_BATCH}

    models: dict[str, Any] = {}
    for compiled in (False,) if args.eager else (False, True):
        how = "compiled" if compiled else "eager"
        models[f"DrQ, {how}"] = DrQ("CnnPolicy", colours(), compile=compiled, batch_size=size, **common)
        models[f"DrQv2, {how}"] = DrQv2("CnnPolicy", colours(), compile=compiled, batch_size=size, **common)
        models[f"SRSPR, {how}"] = SRSPR("CnnPolicy", atari(), compile=compiled, network="bronet", **of_atari)
    kwargs: Any = {"features_extractor_class": ConvEncoder, "net_arch": [1024, 1024]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        models["stable_baselines3.SAC"] = stable_baselines3.SAC(
            "CnnPolicy", colours(), policy_kwargs=kwargs, batch_size=size, **common
        )
        models["stable_baselines3.DQN"] = stable_baselines3.DQN("CnnPolicy", atari(), **of_atari)
    work: dict[str, float] = {}
    rate: dict[str, float] = {}
    for name, model in models.items():
        model.set_logger(Logger(None, []))
        with warnings.catch_warnings():
            # That nothing was learned.
            warnings.simplefilter("ignore")
            model.learn(ROWS)
        agent, _, how = name.partition(", ")
        if how == "compiled":
            model.train(2, model.batch_size)
        else:
            work[agent], rate[agent] = gflop(model), encoder_rate(model, args.rounds)

    of_model: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(args.rounds):
        for name, model in models.items():
            start = time.perf_counter()
            model.train(args.steps, model.batch_size)
            of_model[name].append((time.perf_counter() - start) / args.steps)
    print(
        f"{args.threads} threads, torch {torch.__version__}, stable_baselines3 {stable_baselines3.__version__}, "
        f"batches of {size} (SR-SPR and DQN {SRSPR_BATCH}), {args.pixels} pixels"
    )
    print(f"{'':24}{'ms':>9}{'range':>18}{'GFLOP':>9}{'GFLOP/s':>9}{'floor':>9}{'x floor':>9}")
    for name, times in of_model.items():
        agent = name.partition(",")[0]
        ms = [1e3 * each for each in times]
        floor, median = 1e3 * work[agent] / rate[agent], statistics.median(ms)
        print(
            f"{name:24}{median:9.0f}{min(ms):10.0f} -{max(ms):6.0f}{work[agent]:9.1f}{rate[agent]:9.0f}{floor:9.0f}"
            f"{median / floor:9.2f}"
        )


if __name__ == "__main__":
    main()
