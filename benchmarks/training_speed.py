"""
Environment steps a second of whole training, the time to the first gradient step, and where the time of a step goes.

    python benchmarks/training_speed.py [--threads 2] [--env dmc/cheetah-run-v0] [--steps 200] [--rounds 3]

The peers, stable_baselines3's and sbx's SAC, are measured where they are installed, with the same networks (two layers
of 256) and batch (256) as SAC and DAC here; BRO Fast has its own. The contenders take turns; figures are medians over
the rounds. "to first update" is the time from the constructor's call to the end of the first gradient step, compilation
included, with 100 random steps before it. Leave the machine alone meanwhile.
"""

import argparse
import importlib
import statistics
import time
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import torch

import sb3_sample  # registers the environments

REPLAY_RATIOS = (1, 2, 10)
WARM_UP = 100
PARTS = ("updates", "acting", "environment", "storing", "rest")
#: Label: module, class, arguments.
CONTENDERS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "SAC, eager": ("sb3_sample", "SAC", {"compile": False}),
    "SAC, compiled": ("sb3_sample", "SAC", {"compile": True}),
    "DAC, compiled": ("sb3_sample", "DAC", {"compile": True}),
    "BRO Fast, eager": ("sb3_sample", "BROFast", {"compile": False}),
    "BRO Fast, compiled": ("sb3_sample", "BROFast", {"compile": True}),
    "SAC (stable_baselines3)": ("stable_baselines3", "SAC", {}),
    "SAC (sbx)": ("sbx", "SAC", {}),
}


def make(label: str, replay_ratio: int, env: str) -> Any:
    """A model of one of the contenders; None if it is not installed."""
    module, cls, kwargs = CONTENDERS[label]
    try:
        algorithm = getattr(importlib.import_module(module), cls)
    except ImportError:
        return None
    if module == "sb3_sample":
        kwargs = {**kwargs, "replay_ratio": replay_ratio}
    else:
        kwargs = {**kwargs, "gradient_steps": replay_ratio, "batch_size": 256}
        kwargs["policy_kwargs"] = {"net_arch": [256, 256]}
    return algorithm("MlpPolicy", gym.make(env), learning_starts=WARM_UP, buffer_size=100_000, seed=0, **kwargs)


def timed(owner: Any, name: str, seconds: dict[str, float], label: str) -> None:
    """Let calls of a method be timed."""
    method = getattr(owner, name)

    def call(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        result = method(*args, **kwargs)
        seconds[label] = seconds.get(label, 0.0) + time.perf_counter() - start
        return result

    setattr(owner, name, call)


def shares(model: Any, steps: int) -> dict[str, float]:
    """Seconds a step of the parts of a training step, and of the whole."""
    seconds: dict[str, float] = {}
    timed(model, "train", seconds, "updates")
    timed(model, "_sample_action", seconds, "acting")
    timed(model.env, "step", seconds, "environment")
    timed(model, "_store_transition", seconds, "storing")
    start = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False, log_interval=10**9)
    total = time.perf_counter() - start
    seconds["rest"] = total - sum(seconds.values())
    return {"whole": total / steps, **{label: seconds[label] / steps for label in PARTS}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--env", default="dmc/cheetah-run-v0")
    parser.add_argument("--steps", type=int, default=200, help="environment steps a round at replay ratio 1")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", nargs="*", help="contenders whose name begins with one of these")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    warnings.simplefilter("ignore")

    models: dict[tuple[str, int], Any] = {}
    first: dict[tuple[str, int], float] = {}
    for label in CONTENDERS:
        if args.only is not None and not label.startswith(tuple(args.only)):
            continue
        for ratio in REPLAY_RATIOS:
            start = time.perf_counter()
            model = make(label, ratio, args.env)
            if model is None:
                print(f"not installed: {label}")
                break
            model.learn(WARM_UP + 1, log_interval=10**9)
            first[label, ratio] = time.perf_counter() - start
            models[label, ratio] = model
    per_step: dict[tuple[str, int], list[float]] = {key: [] for key in models}
    for _ in range(args.rounds):
        for (label, ratio), model in models.items():
            steps = max(20, args.steps // ratio)
            start = time.perf_counter()
            model.learn(steps, reset_num_timesteps=False, log_interval=10**9)
            per_step[label, ratio].append((time.perf_counter() - start) / steps)
    print(f"{args.env}, {args.threads} threads, torch {torch.__version__}, sb3_sample {sb3_sample.__version__}\n")
    columns: list[tuple[str, Callable[[tuple[str, int]], str]]] = [
        *((f"steps/s, RR {r}", lambda key: f"{1 / statistics.median(per_step[key]):.1f}") for r in REPLAY_RATIOS)
    ]
    print(f"{'':26}" + "".join(f"{name:>16}" for name, _ in columns) + f"{'to first update, s':>21}")
    for label in dict.fromkeys(label for label, _ in models):
        row = "".join(f"{f((label, r)):>16}" for (_, f), r in zip(columns, REPLAY_RATIOS, strict=True))
        print(f"{label:26}{row}{first[label, REPLAY_RATIOS[0]]:21.1f}")

    print("\nwhere a step's time goes, ms (share)")
    print(
        f"{'':34}" + "".join(f"{name:>17}" for name in ("whole", "updates", "acting", "environment", "storing", "rest"))
    )
    for (label, ratio), model in models.items():
        if "sbx" in label or ratio == 10:
            continue
        parts = shares(model, max(20, args.steps // ratio))
        whole = parts["whole"]
        print(f"{label + f', RR {ratio}':34}" + "".join(f"{1e3 * s:10.2f} ({s / whole:4.0%})" for s in parts.values()))


if __name__ == "__main__":
    main()
