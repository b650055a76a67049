"""
Time of one gradient step, beside what the machine can do and beside the peers, all in one run.

    python benchmarks/update_speed.py [--threads 2] [--rounds 5] [--only SAC] [--agents published]

Peers are measured where they are installed: ``pip install sb3-contrib`` (TQC, CrossQ) and ``pip install sbx-rl`` (SAC,
TQC, CrossQ in JAX). All have the same networks (two layers of 256), the same batch of 256 and the same task shapes. A
gradient step includes drawing its batch; BRO has its own networks and its batch of 128. With ``--agents published`` the
agents after BRO are measured beside BRO 4.92M and SAC, each with its published networks and batch (BRC's critics 512
wide); where actors move every so many steps, figures are the mean over as many. DR.Q takes as many steps of its encoder
as of values and policy, so that its update is the sum of its two lines.

The contenders take turns, so that a drift of the machine's speed touches all alike; figures are medians over the
rounds, with the range, and the ratios medians of each round's ratio. Leave the machine alone meanwhile: with a busy
second core, two threads can be ten times slower than one. "x matmul" is the time over the time of the step's matrix
multiplications at the rate at which this machine multiplies 2 x 128 x 512 by 2 x 512 x 512 (FLOPs counted by torch),
"rate" its inverse.

    python benchmarks/update_speed.py --against WORKTREE --rounds 15

compares this checkout with another one, each in a process of its own, which take turns: our lines only, the median of
the ratios of each round, and an interval that holds the true median with 95% at least (of order statistics).
"""

import argparse
import importlib
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from torch.utils.flop_counter import FlopCounterMode

import sb3_sample
from sb3_sample.sac.bro import MODEL_SIZES

OBSERVATION, ACTION = 17, 6  # cheetah-run
#: Peers by label: module, class.
PEERS = {
    "SAC (stable_baselines3)": ("stable_baselines3", "SAC"),
    "TQC (sb3_contrib)": ("sb3_contrib", "TQC"),
    "CrossQ (sb3_contrib)": ("sb3_contrib", "CrossQ"),
    "SAC (sbx)": ("sbx", "SAC"),
    "TQC (sbx)": ("sbx", "TQC"),
    "CrossQ (sbx)": ("sbx", "CrossQ"),
}
#: Ours by label: class, arguments, batch size (None: its own); by what ``--agents`` calls them.
AGENTS: dict[str, dict[str, tuple[str, dict[str, Any], int | None]]] = {
    "family": {
        **{f"BRO {size}": ("BRO", {"model_size": size}, 128) for size in MODEL_SIZES},
        **{name: (name, {}, 256) for name in ("SAC", "DAC", "VPLSAC")},
    },
    "published": {
        "BRO 4.92M": ("BRO", {"model_size": "4.92M"}, 128),
        "SAC": ("SAC", {}, 256),
        "BRC 512": ("BRC", {"critic_width": 512}, None),
        **{name: (name, {}, None) for name in ("SimBa", "SimbaV2", "XQC", "CrossQ", "FlashSAC", "DebiasedRQ")},
    },
}
#: Aims: label, numerator, denominator (None: the step's matrix multiplications), ratio.
AIMS = [
    ("BRO 4.92M / its matmul", "BRO 4.92M, compiled", None, 1 / 0.7),
    ("BRO 0.55M / its matmul", "BRO 0.55M, compiled", None, 2.0),
    ("SAC / SAC of stable_baselines3", "SAC, compiled", "SAC (stable_baselines3)", 0.5),
    ("SAC / SAC of sbx", "SAC, compiled", "SAC (sbx)", 0.8),
    ("DAC / SAC", "DAC, compiled", "SAC, compiled", 1.15),
    ("VPL-SAC / SAC", "VPLSAC, compiled", "SAC, compiled", 1.05),
    ("acting / gradient step, BRO 4.92M", "acting: BRO 4.92M", "BRO 4.92M, compiled", 0.1),
    ("acting / gradient step, SAC", "acting: SAC", "SAC, compiled", 0.1),
]


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
    if isinstance(model, sb3_sample.DebiasedRQ):
        # Between two blocks of the encoder, which are measured by themselves.
        model.target_update_interval, model._n_updates = 10**9, 1
    return lambda: model.train(gradient_steps=1, batch_size=batch_size)


def encoder_step(model: Any) -> Callable[[], None]:
    """One step of DR.Q's encoder, with sampling of its windows."""

    def step() -> None:
        model.learner.prepared_execution()
        for windows in model._source.windows(1, model.batch_size):
            model.learner.update_encoder(windows)

    return step


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


def measure(contenders: dict[str, Callable[[], Any]], rounds: int, periods: dict[str, int]) -> dict[str, list[float]]:
    """Seconds a call by name, one figure a round; the contenders take turns, each for whole periods of its calls."""
    repeats = {}
    for name, call in contenders.items():
        for _ in range(3):
            call()
        start = time.perf_counter()
        call()
        period, n = periods.get(name, 1), max(3, int(0.2 / (time.perf_counter() - start)))
        repeats[name] = period * math.ceil(n / period)
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, call in contenders.items():
            start = time.perf_counter()
            for _ in range(repeats[name]):
                call()
            seconds[name].append((time.perf_counter() - start) / repeats[name])
    return seconds


def wanted(args: argparse.Namespace, name: str) -> bool:
    return args.only is None or name.startswith(tuple(args.only))


def our_steps(args: argparse.Namespace) -> tuple[dict[str, Callable[[], Any]], dict[str, Any], dict[str, float]]:
    """Gradient steps by label, their models, and the seconds that compiling took."""
    steps: dict[str, Callable[[], Any]] = {}
    models: dict[str, Any] = {}
    compiling: dict[str, float] = {}
    for name, (cls, kwargs, batch_size) in AGENTS[args.agents].items():
        for how, compile in (("eager", False), ("compiled", True)):
            if not wanted(args, f"{name}, {how}"):
                continue
            model = build(getattr(sb3_sample, cls), compile=compile, device=args.device, **kwargs)
            made = {f"{name}, {how}": training_step(model, batch_size or model.batch_size)}
            if name == "DebiasedRQ":
                made[f"{name} encoder, {how}"] = encoder_step(model)
            for label, step in made.items():
                models[label], steps[label] = model, step
                start = time.perf_counter()
                for _ in range(model.policy_delay):
                    step()
                if compile:
                    compiling[label] = time.perf_counter() - start
    return steps, models, compiling


def serve(args: argparse.Namespace) -> None:
    """Take the gradient steps that the standard input asks for, ``[label, how many]``, and answer with seconds each."""
    steps, _, compiling = our_steps(args)
    print(json.dumps({"labels": list(steps), "compiling": compiling}), flush=True)
    for line in sys.stdin:
        label, n = json.loads(line)
        start = time.perf_counter()
        for _ in range(n):
            steps[label]()
        print(json.dumps((time.perf_counter() - start) / n), flush=True)


def median_interval(values: list[float]) -> tuple[float, float]:
    """An interval that holds the median of what the values are drawn from with a probability of 95% at least."""
    n, ordered = len(values), sorted(values)
    below = 0
    while 2 * sum(math.comb(n, i) for i in range(below + 1)) / 2**n <= 0.05:
        below += 1
    return ordered[max(below - 1, 0)], ordered[n - max(below, 1)]


def compare(args: argparse.Namespace) -> None:
    """The gradient steps of this checkout and of another one."""
    trees = {"here": Path(__file__).parents[1], "there": args.against.resolve()}
    options = ["--serve", "--threads", str(args.threads), "--device", args.device, "--agents", args.agents]
    options += [] if args.only is None else ["--only", *args.only]
    servers: dict[str, subprocess.Popen[str]] = {}
    told: dict[str, Any] = {}
    for name, tree in trees.items():
        # The second would find what the first has compiled, were the caches not apart.
        with tempfile.TemporaryDirectory() as cache:
            variables = {"OMP_NUM_THREADS": str(args.threads), "TORCHINDUCTOR_CACHE_DIR": cache}
            servers[name] = subprocess.Popen(
                [sys.executable, __file__, *options],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env={**os.environ, **variables, "PYTHONPATH": str(tree)},
            )
            told[name] = answer(servers[name])

    def seconds(name: str, label: str, n: int) -> float:
        stdin = servers[name].stdin
        assert stdin is not None
        stdin.write(json.dumps([label, n]) + "\n")
        stdin.flush()
        return float(answer(servers[name]))

    print(f"{'':24}{'here, ms':>10}{'there, ms':>11}{'ratio':>8}{'95% interval':>16}{'compiling, s':>15}")
    for label in [label for label in told["here"]["labels"] if label in told["there"]["labels"]]:
        n = max(3, int(0.3 / max(seconds(name, label, 3) for name in trees)))
        times: dict[str, list[float]] = {name: [] for name in trees}
        for i in range(args.rounds):
            for name in trees if i % 2 else reversed(trees):
                times[name].append(seconds(name, label, n))
        ratios = [a / b for a, b in zip(times["here"], times["there"], strict=True)]
        low, high = median_interval(ratios)
        line = "".join(
            f"{1e3 * statistics.median(times[name]):{width}.3f}" for name, width in (("here", 10), ("there", 11))
        )
        line += f"{statistics.median(ratios):8.3f}{low:9.3f} -{high:6.3f}"
        if label in told["here"]["compiling"]:
            line += "".join(f"{told[name]['compiling'][label]:7.1f}" for name in trees)
        print(f"{label:24}{line}", flush=True)
    for server in servers.values():
        server.terminate()


def answer(server: "subprocess.Popen[str]") -> Any:
    assert server.stdout is not None
    line = server.stdout.readline()
    if not line:
        raise RuntimeError(f"the process of {server.args} ended")
    return json.loads(line)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", nargs="*", help="contenders whose name begins with one of these")
    parser.add_argument("--agents", choices=list(AGENTS), default="family", help="which agents of this package")
    parser.add_argument("--device", default="cpu", help="of the models; the ratios to matmul are a CPU's")
    parser.add_argument("--against", type=Path, metavar="WORKTREE", help="another checkout, to compare this one with")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    warnings.simplefilter("ignore")
    if args.serve:
        return serve(args)
    if args.against is not None:
        return compare(args)

    def synchronised(call: Callable[[], Any]) -> Callable[[], Any]:
        return call if args.device == "cpu" else lambda: (call(), torch.cuda.synchronize())

    steps, models, compiling = our_steps(args)
    flops: dict[str, float] = {}
    periods = {label: model.policy_delay for label, model in models.items()}
    for label in steps:
        if label in compiling:
            flops[label] = flops.get(label.replace("compiled", "eager"), 0)
        else:
            with FlopCounterMode(display=False) as counter:
                for _ in range(periods[label]):
                    steps[label]()
            flops[label] = counter.get_total_flops() / periods[label]
    versions = [f"torch {torch.__version__}", f"stable_baselines3 {stable_baselines3.__version__}"]
    for label, (module, cls) in PEERS.items():
        if not wanted(args, label):
            continue
        try:
            peer = getattr(importlib.import_module(module), cls)
        except ImportError:
            print(f"not installed: {module}")
            continue
        versions.append(f"{module} {importlib.import_module(module).__version__}")
        device = {} if module == "sbx" else {"device": args.device}
        net = {"pi": [256, 256], "qf": [256, 256]}
        steps[label] = training_step(build(peer, policy_kwargs={"net_arch": net}, **device), 256)
        if module != "sbx":
            with FlopCounterMode(display=False) as counter:
                steps[label]()
            flops[label] = counter.get_total_flops()

    x, w = torch.randn(2, 128, 512), torch.randn(2, 512, 512)
    contenders: dict[str, Callable[[], Any]] = {"matmul": lambda: torch.bmm(x, w)}
    contenders |= {name: synchronised(step) for name, step in steps.items()}
    for name in ("BRO 4.92M", "SAC"):
        if f"{name}, compiled" in models and wanted(args, "acting"):
            contenders[f"acting: {name}"] = acting(models[f"{name}, compiled"])
    if wanted(args, "quantile Huber"):
        from sb3_sample.learner.losses import quantile_huber

        contenders["quantile Huber, sorted (eager)"] = loss_step(quantile_huber)
        contenders["quantile Huber, by definition"] = loss_step(pairwise_quantile_huber)
    seconds = measure(contenders, args.rounds, periods)

    matmul_flops = 2 * 2 * 128 * 512 * 512
    #: Ratios of the times in one and the same round.
    times_matmul = {
        name: statistics.median(
            t * matmul_flops / (flops[name] * m) for t, m in zip(seconds[name], seconds["matmul"], strict=True)
        )
        for name in seconds
        if flops.get(name)
    }
    rate = matmul_flops / statistics.median(seconds["matmul"])
    print(f"{platform.processor() or platform.machine()}, {args.threads} threads, device {args.device}")
    print(", ".join(dict.fromkeys(versions)))
    print(f"matmul 2x128x512 by 2x512x512: {rate / 1e9:.0f} GFLOP/s\n")
    print(f"{'':32}{'ms':>9}{'range':>18}{'GFLOP':>8}{'x matmul':>10}{'rate':>6}{'compiling, s':>14}")
    for name, values in seconds.items():
        line = f"{name:32}{1e3 * statistics.median(values):9.3f}{1e3 * min(values):9.3f} -{1e3 * max(values):7.3f}"
        if name in times_matmul:
            line += f"{flops[name] / 1e9:8.2f}{times_matmul[name]:10.2f}{1 / times_matmul[name]:6.0%}"
        if name in compiling:
            line += f"{compiling[name]:{14 if name in times_matmul else 38}.1f}"
        print(line)

    same = [name for name in seconds if name in PEERS]
    if same:
        best = min(same, key=lambda name: statistics.median(seconds[name]))
        print(f"\nAt the same networks and batch, over {best}, the fastest peer:")
        for name in [n for n in seconds if n in PEERS or n.startswith(("SAC", "DAC", "VPL"))]:
            ratio = statistics.median(a / b for a, b in zip(seconds[name], seconds[best], strict=True))
            print(f"{name:32}{ratio:9.2f}")
    print(f"\n{'':40}{'aim':>8}{'measured':>10}")
    for label, name, other, aim in AIMS:
        if name in seconds and ((other is None and name in times_matmul) or other in seconds):
            ratio = (
                times_matmul[name]
                if other is None
                else statistics.median(a / b for a, b in zip(seconds[name], seconds[other], strict=True))
            )
            print(f"{label:40}{aim:8.2f}{ratio:10.2f}")


if __name__ == "__main__":
    main()
