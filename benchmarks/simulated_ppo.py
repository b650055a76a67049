"""
Time of one iteration of PPO with simulated samples, by phase, beside Stable-Baselines3's PPO and beside what the
machine can do, all in one run.

    python benchmarks/simulated_ppo.py [--threads 1] [--rounds 3] [--device cpu]
    python benchmarks/simulated_ppo.py --memory    # peak memory of one iteration of 4,096 steps and 16 actions
    python benchmarks/simulated_ppo.py --short --device cuda    # each row as soon as it is measured

An iteration is that of the MBMA paper (https://arxiv.org/abs/2210.13011): 2,048 steps, minibatches of 64, 10 epochs,
networks of 512 (actor) and 1024 (critic and models), horizon 12; observations and actions of cheetah-run. The
environment costs next to nothing. The contenders take turns; figures are medians over the rounds, and the ratios
medians of each round's ratio. "of matmul" is the rate of the phases' matrix multiplications (counted by torch) over the
rate at which this machine multiplies 2048 x 1024 by 1024 x 1024, measured in the same rounds. Leave the machine alone
meanwhile: a run takes some ten minutes on a CPU.

``--short`` measures one iteration of each, right after one of PPO's, and counts no multiplications. On a CPU an
iteration is then of 256 steps, unless ``--steps`` says otherwise: all of its phases grow with them, so that times are
of one real step.
"""

import argparse
import platform
import resource
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from torch.utils.flop_counter import FlopCounterMode

from sb3_sample import MBMAPPO, MBPOPPO, QMAPPO
from sb3_sample.ppo.simulated_ppo import NET_ARCH

OBSERVATION, ACTION = 17, 6  # cheetah-run
PHASES = ("collect", "dynamics", "simulate", "policy")
PPO = "PPO (stable_baselines3)"
#: Times on a GPU, relative to PPO (MBMA, table B.3).
PUBLISHED = {"MBMA 4": 1.59, "MBMA 8": 2.31, "MBMA 16": 3.60, "QMA 4": 1.22, "QMA 8": 1.62, "QMA 16": 2.07}


class Noise(gym.Env):
    """Random observations and rewards; episodes of 250 steps that end by a time limit."""

    observation_space = spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float32)
    action_space = spaces.Box(-1, 1, (ACTION,), np.float32)

    def __init__(self) -> None:
        self.numbers = np.random.default_rng(0).normal(size=(250, OBSERVATION + 1)).astype(np.float32)
        self.t = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.t = 0
        return self.numbers[0, :OBSERVATION], {}

    def step(self, action: np.ndarray) -> Any:
        row = self.numbers[self.t]
        self.t += 1
        return row[:OBSERVATION], float(row[OBSERVATION]), False, self.t == 250, {}


class Contender:
    """
    An algorithm, its iterations, and where their time goes.

    :param cls: the algorithm
    :param kwargs: its arguments
    """

    def __init__(self, cls: Any, **kwargs: Any):
        self.model = cls("MlpPolicy", Noise(), seed=0, **kwargs)
        self.model.set_logger(Logger(None, []))
        self.seconds: dict[str, list[float]] = {name: [] for name in (*PHASES, "iteration")}
        self.flops: dict[str, int] = {}
        if cls is stable_baselines3.PPO:
            collect, train = self.model.collect_rollouts, self.model.train
            self.model.collect_rollouts = lambda *args, **kwargs: self._timed("collect", collect, *args, **kwargs)
            self.model.train = lambda: self._timed("policy", train)

    def _timed(self, phase: str, call: Any, *args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        result = call(*args, **kwargs)
        if self.model.device.type == "cuda":
            torch.cuda.synchronize()
        self.model.logger.record(f"time/{phase}_seconds", time.perf_counter() - start)
        return result

    def iterate(self) -> None:
        """One iteration, whose times are kept."""
        start = time.perf_counter()
        self.model.learn(self.model.n_steps, log_interval=None, reset_num_timesteps=False)
        self.seconds["iteration"].append(time.perf_counter() - start)
        for phase in PHASES:
            self.seconds[phase].append(self.model.logger.name_to_value.get(f"time/{phase}_seconds", 0.0))

    def count(self) -> None:
        """One iteration in which the matrix multiplications of each phase are counted, and no times are kept."""
        phase = getattr(self.model, "_phase", None)
        if phase is not None:

            @contextmanager
            def counted(name: str) -> Iterator[None]:
                with phase(name), FlopCounterMode(display=False) as counter:
                    yield
                self.flops[name] = counter.get_total_flops()

            self.model._phase = counted
        self.iterate()
        if phase is not None:
            del self.model._phase
        for values in self.seconds.values():
            values.clear()

    def arithmetic(self, what: str) -> tuple[int, float]:
        """FLOPs of a phase, or of the three beside collecting, and its median time."""
        phases = PHASES[1:] if what == "work" else (what,)
        times = [sum(times) for times in zip(*(self.seconds[phase] for phase in phases), strict=True)]
        return sum(self.flops.get(phase, 0) for phase in phases), statistics.median(times)


def contenders_of(
    actions: Sequence[int], device: str, steps: int, epochs: int, horizon: int, rivals: bool = False
) -> dict[str, Callable[[], Contender]]:
    """
    List the contenders.

    :param actions: numbers of simulated actions; with 0, MBMA's base, which is to cost what PPO does
    :param device: of the models
    :param steps: of an iteration
    :param epochs: of an iteration
    :param horizon: of the simulation
    :param rivals: whether QMA and MBPO are among them
    :return: what makes each, by name, PPO first
    """
    sizes: dict[str, Any] = dict(n_steps=steps, n_epochs=epochs, device=device)
    ours: dict[str, Any] = {**sizes, "warm_up_until": 0}
    rollouts: dict[str, Any] = {**ours, "simulation_horizon": horizon}
    theirs: dict[str, Any] = dict(normalize_advantage=False, policy_kwargs=dict(net_arch=dict(NET_ARCH)))
    made: dict[str, Callable[[], Contender]] = {PPO: partial(Contender, stable_baselines3.PPO, **sizes, **theirs)}
    for n in actions:
        made[f"MBMA {n}"] = partial(Contender, MBMAPPO, n_simulated=n, **(rollouts if n > 0 else sizes))
    for n in (n for n in actions if n > 0 and rivals):
        made[f"QMA {n}"] = partial(Contender, QMAPPO, n_simulated=n, **ours)
        enough = {**rollouts, "simulation_horizon": max(horizon, n + 1)}
        made[f"MBPO {n}"] = partial(Contender, MBPOPPO, n_simulated=n, **enough)
    return made


def short_rows(
    actions: Sequence[int], device: str, steps: int | None = None, epochs: int = 10, horizon: int = 12
) -> Iterator[tuple[str, float, float]]:
    """
    Measure an iteration of PPO, then one of MBMA for each number of actions, each right after another of PPO's; before,
    a small one of each that sets the libraries up.

    :param actions: numbers of simulated actions
    :param device: of the models
    :param steps: of an iteration; None: 2,048, on a CPU 256
    :param epochs: of an iteration
    :param horizon: of the simulation
    :return: name, milliseconds of one real step, and the iteration's time over PPO's, each when it is measured
    """
    if steps is None:
        steps = 256 if device == "cpu" else 2048
    for make in contenders_of(actions, device, 64, 1, horizon).values():
        make().iterate()
    made = contenders_of(actions, device, steps, epochs, horizon)
    ppo = made.pop(PPO)()
    ppo.iterate()
    yield PPO, 1e3 * ppo.seconds["iteration"][-1] / steps, 1.0
    for name, make in made.items():
        contender = make()
        for each in (ppo, contender):
            each.iterate()
        ours, theirs = (each.seconds["iteration"][-1] for each in (contender, ppo))
        yield name, 1e3 * ours / steps, ours / theirs


def matmul_seconds(device: str, x: torch.Tensor, w: torch.Tensor) -> float:
    """Seconds of one multiplication."""
    n = 20
    torch.mm(x, w)
    if device != "cpu":
        torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(n):
        torch.mm(x, w)
    if device != "cpu":
        torch.cuda.synchronize()
    return (time.perf_counter() - start) / n


def peak() -> float:
    """
    GiB that were in memory at most. Linux passes ``ru_maxrss`` on from a process to the programs it starts, a test's to
    this one; ``VmHWM`` is this program's own.
    """
    try:
        status = Path("/proc/self/status").read_text()
        kibibytes = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        kibibytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kibibytes / 2**20


def peak_memory(args: argparse.Namespace) -> None:
    before = peak()
    contender = Contender(
        MBMAPPO, n_steps=4096, n_simulated=16, warm_up_until=0, simulation_horizon=args.horizon, n_epochs=args.epochs,
        device="cpu",
    )  # fmt: skip
    contender.iterate()
    print(f"peak memory, 4,096 steps and 16 actions: {peak():.2f} GiB, {before:.2f} of it for the imports")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--actions", type=int, nargs="+", default=[0, 4, 8, 16])
    parser.add_argument("--steps", type=int, help="of an iteration; 2,048, in short on a CPU 256")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--horizon", type=int, default=12)
    parser.add_argument("--rivals", action="store_true", help="QMA and MBPO too")
    parser.add_argument("--memory", action="store_true", help="only the peak memory")
    parser.add_argument("--short", action="store_true", help="one iteration of each, without QMA and MBPO")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.memory:
        peak_memory(args)
        return
    if args.short:
        if args.rivals:
            raise SystemExit("--rivals are none of --short: leave one of them out")
        print(f"{'':26}{'ms a step':>10}{'x PPO':>8}{'paper GPU':>11}", flush=True)
        for name, ms, ratio in short_rows(args.actions, args.device, args.steps, args.epochs, args.horizon):
            published = f"{PUBLISHED[name]:11.2f}" if name in PUBLISHED else ""
            print(f"{name:26}{ms:10.3f}{ratio:8.2f}{published}", flush=True)
        return

    args.steps = 2048 if args.steps is None else args.steps
    made = contenders_of(args.actions, args.device, args.steps, args.epochs, args.horizon, args.rivals)
    contenders = {name: make() for name, make in made.items()}

    x, w = torch.randn(2048, 1024, device=args.device), torch.randn(1024, 1024, device=args.device)
    for contender in contenders.values():
        contender.count()
    rates = []
    for _ in range(args.rounds):
        for contender in contenders.values():
            rates.append(2 * 2048 * 1024 * 1024 / matmul_seconds(args.device, x, w))
            contender.iterate()
    rate = statistics.median(rates)

    print(f"{platform.processor() or platform.machine()}, {args.threads} threads, torch {torch.__version__}, "
          f"stable_baselines3 {stable_baselines3.__version__}, device {args.device}; {args.steps} steps, "
          f"{args.epochs} epochs, horizon {args.horizon}")  # fmt: skip
    print(
        f"matmul 2048x1024 by 1024x1024: {rate / 1e9:.0f} GFLOP/s ({min(rates) / 1e9:.0f} - {max(rates) / 1e9:.0f})\n"
    )
    heads = "".join(f"{phase:>10}" for phase in PHASES)
    print(f"{'seconds':26}{'iteration':>10}{heads}{'x PPO':>8}{'paper GPU':>11}")
    reference = contenders[PPO].seconds["iteration"]
    for name, contender in contenders.items():
        medians = {phase: statistics.median(values) for phase, values in contender.seconds.items()}
        pairs = zip(contender.seconds["iteration"], reference, strict=True)
        ratio = statistics.median(a / b for a, b in pairs)
        phases = "".join(f"{medians[phase]:10.2f}" for phase in PHASES)
        published = f"{PUBLISHED[name]:11.2f}" if name in PUBLISHED else ""
        print(f"{name:26}{medians['iteration']:10.2f}{phases}{ratio:8.2f}{published}")
    print(f"\n{'of matmul':26}{'TFLOP':>10}{'all three':>10}{''.join(f'{phase:>10}' for phase in PHASES[1:])}")
    for name, contender in contenders.items():
        if not contender.flops:
            continue
        line = f"{name:26}{contender.arithmetic('work')[0] / 1e12:10.2f}"
        for what in ("work", *PHASES[1:]):
            flops, seconds = contender.arithmetic(what)
            line += f"{flops / seconds / rate:10.0%}" if flops > 0 else f"{'':10}"
        print(line)


if __name__ == "__main__":
    main()
