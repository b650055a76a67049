"""
Gradient steps and actions a second on a GPU: one learner and several, eager and captured, compiled and not.

    python benchmarks/gpu.py [--parts bro,bro-x10,...] [--seconds 200] [--device cuda]

Each part is a process, of which all compile at the same time and one measures; rows are printed as they come. A part
that is not done after ``--seconds`` is left out, with a word. A gradient step includes drawing its batch of 128 (BRO)
or 256 transitions with 17 observed numbers and 6 actions, as in ``update_speed.py``. "One a call" is ``train(1)``, as
replay ratio 1 takes it, "many" ``train(100)``; "graph" the launch alone, on inputs that stay; "acting" an action of the
explorer for one observation. Rows "x 10" are of ten learners in one update (``LearnerGroup``): updates, and actions, of
all together, on batches and observations that lie on the device; those of "drawn" draw them in the step, from a
``DeviceReplayBuffer``. "training" is ``train_many`` of ten learners on
HalfCheetah-v5, in updates of all.
"""

import argparse
import fcntl
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from update_speed import ACTION, OBSERVATION, acting, build, training_step

from sb3_sample import (
    BRC,
    DAC,
    SAC,
    VPLSAC,
    XQC,
    BROFast,
    CrossQ,
    DebiasedRQ,
    DeviceReplayBuffer,
    FlashSAC,
    SimBa,
    SimbaV2,
    train_many,
)
from sb3_sample.learner.batch import Batch, Noise
from sb3_sample.learner.group import LearnerGroup

#: Arguments of agents whose gradient step draws its batch itself.
DRAWN: dict[str, Any] = {"replay_buffer_class": DeviceReplayBuffer, "replay_buffer_kwargs": {"sampling": "device"}}
#: Agents by label: class, arguments.
AGENTS: dict[str, tuple[type[SAC], dict[str, Any]]] = {
    "bro": (BROFast, {"model_size": "4.92M"}),
    "sac": (SAC, {}),
    "bro-small": (BROFast, {"model_size": "0.55M"}),
    "dac": (DAC, {}),
    "vpl": (VPLSAC, {}),
    "simba": (SimBa, {}),
    "simbav2": (SimbaV2, {}),
    "brc": (BRC, {"critic_width": 512}),
    "crossq": (CrossQ, {}),
    "xqc": (XQC, {}),
    "flash": (FlashSAC, {}),
    "dr_q": (DebiasedRQ, {}),
    "sac-drawn": (SAC, DRAWN),
    "bro-drawn": (BROFast, {"model_size": "4.92M", **DRAWN}),
}
#: What is measured, in this order: label, number of learners, whether compiled.
PARTS: dict[str, tuple[str, int, bool]] = {
    "bro": ("bro", 1, True),
    "sac": ("sac", 1, True),
    "bro-x10": ("bro", 10, True),
    "sac-x10": ("sac", 10, True),
    "sac-drawn": ("sac-drawn", 1, True),
    "bro-drawn": ("bro-drawn", 1, True),
    "sac-drawn-x10": ("sac-drawn", 10, True),
    "bro-drawn-x10": ("bro-drawn", 10, True),
    "dac": ("dac", 1, True),
    "vpl": ("vpl", 1, True),
    "bro-small": ("bro-small", 1, True),
    "bro-small-x10": ("bro-small", 10, True),
    "bro-uncompiled": ("bro", 1, False),
    "bro-x10-uncompiled": ("bro", 10, False),
    "sac-uncompiled": ("sac", 1, False),
    "bro-small-uncompiled": ("bro-small", 1, False),
    "bro-x4": ("bro", 4, False),
    "bro-x32": ("bro", 32, False),
    **{f"{label}-uncompiled": (label, 1, False) for label in ("dac", "vpl", "simba", "simbav2", "brc")},
    **{f"{label}-uncompiled": (label, 1, False) for label in ("crossq", "xqc", "flash", "dr_q")},
}
OTHERS = ("peers", "training")
HEADER = "| | run | one a call | many a call | graph | graph, TF32 | acting | peak memory, MB | compiling, s |"


def rate(call: Callable[[], Any], n: int) -> float:
    """Calls a second: the median of three times ``n``."""
    rates = []
    for _ in range(3):
        start = time.perf_counter()
        for _ in range(n):
            call()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        rates.append(n / (time.perf_counter() - start))
    return statistics.median(rates)


class Turn:
    """
    Turn to measure, which one process has at a time. It begins when all are ready, or after ``PATIENCE`` seconds.

    :param folder: of all processes
    :param n: how many there are
    """

    PATIENCE = 100.0

    def __init__(self, folder: str, n: int):
        self._folder, self._n, self._start = Path(folder), n, time.perf_counter()

    def __enter__(self) -> None:
        (self._folder / f"ready-{os.getpid()}").touch()
        while len(list(self._folder.glob("ready-*"))) < self._n:
            if time.perf_counter() - self._start > self.PATIENCE:
                break
            time.sleep(0.1)
        self._file = open(self._folder / "turn", "w")
        fcntl.flock(self._file, fcntl.LOCK_EX)

    def __exit__(self, *error: Any) -> None:
        self._file.close()


def row(how: str, *figures: float | None) -> str:
    """A row of the table, without its first column."""
    cells = ["" if figure is None else f"{figure:.0f}" for figure in figures]
    return " | ".join([how, *cells, *[""] * (7 - len(cells))])


def inputs_of(model: Any) -> tuple[Any, ...]:
    """The arguments of a gradient step, on the device."""
    device, n = model.device, model.batch_size

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, device=device)

    actions = torch.rand((n, ACTION), device=device) * 2 - 1
    zeros = torch.zeros((n, 1), device=device)
    batch = Batch(normal(n, OBSERVATION), actions, normal(n, OBSERVATION), zeros, normal(n, 1), 0.99)
    return batch, Noise(*(normal(n, ACTION) for _ in range(3))), None, True, True


def recorded(owner: Any) -> dict[Any, Any]:
    """The captured steps of a learner or a group."""
    return (owner._drawing or owner._execution)._captured._recorded  # type: ignore[no-any-return]


def graph_of(owner: Any) -> Callable[[], None]:
    """The launch of a captured step."""
    return next(iter(recorded(owner).values()))[1]  # type: ignore[no-any-return]


def with_tf32(call: Callable[[], float]) -> float:
    """A figure with TF32."""
    torch.backends.cuda.matmul.allow_tf32 = True
    try:
        return call()
    finally:
        torch.backends.cuda.matmul.allow_tf32 = False


def recaptured(owner: Any, step: Callable[[], Any]) -> float:
    """Rate of the graph, captured anew."""
    recorded(owner).clear()
    step()
    return rate(graph_of(owner), 200)


def one(label: str, compiled: bool, device: str, turn: Turn) -> str:
    cls, kwargs = AGENTS[label]
    model = build(cls, compile=True, device=device, **kwargs)
    model.compiled = compiled
    model.train(5, model.batch_size)
    step = training_step(model, model.batch_size)
    with turn:
        torch.cuda.reset_peak_memory_stats()
        one_a_call, many = rate(step, 100), 100 * rate(lambda: model.train(100, model.batch_size), 1)
        learner = model.learner
        graph = rate(graph_of(learner), 200)
        tf32 = with_tf32(lambda: recaptured(learner, step))
        act = acting(model)
        for _ in range(5):
            act()
        actions = rate(act, 200)
        eager = rate(lambda: learner.step(*inputs_of(model)[:2], eager=True), 10)
    how = "compiled, captured" if compiled else f"captured (eager: {eager:.0f})"
    memory, seconds = torch.cuda.max_memory_allocated() / 2**20, learner.seconds_compiling
    return row(how, one_a_call, many, graph, tf32, actions, memory, seconds)


def several(label: str, n: int, compiled: bool, device: str, turn: Turn) -> str:
    cls, kwargs = AGENTS[label]
    models = [build(cls, compile=True, device=device, **kwargs) for _ in range(n)]
    for model in models:
        model.compiled = compiled
        model.learner.set_training_mode(True)
    group = LearnerGroup([model.learner for model in models])
    inputs = [inputs_of(model) for model in models]
    observed = [(own[0].observations[:1], own[1].critic[:1]) for own in inputs]
    if all(model._draws_in_steps() for model in models):
        inputs = [(model.batch_size, True, True) for model in models]
    for _ in range(6):
        group.step(inputs)
    with turn:
        torch.cuda.reset_peak_memory_stats()
        steps = n * rate(lambda: group.step(inputs), 50)
        graph = n * rate(graph_of(group), 100)
        tf32 = n * with_tf32(lambda: recaptured(group, lambda: group.step(inputs)))
        with torch.inference_mode():
            for _ in range(5):
                group.act(observed)
            actions = n * rate(lambda: group.act(observed), 200)
    how = "compiled, captured" if compiled else "captured"
    memory, seconds = torch.cuda.max_memory_allocated() / 2**20, group.seconds_compiling
    return row(how, steps, None, graph, tf32, actions, memory, seconds)


def peers(device: str, turn: Turn) -> str:
    from stable_baselines3 import SAC as Theirs

    model = build(Theirs, device=device, policy_kwargs={"net_arch": [256, 256]})
    step = lambda: model.train(gradient_steps=1, batch_size=256)  # noqa: E731
    with turn:
        step()
        return row("stable_baselines3's SAC", rate(step, 50))


def training(device: str, turn: Turn) -> str:
    steps, n = 3_000, 10
    with turn:
        start = time.perf_counter()
        models = train_many(
            SAC, "MlpPolicy", "HalfCheetah-v5", seeds=range(n), total_timesteps=steps, learning_starts=1_000,
            device=device, compile=True,
        )  # fmt: skip
        seconds = time.perf_counter() - start
    updates = sum(model._n_updates for model in models)
    return row(f"SAC, {updates} updates in {seconds:.0f} s with warm-up", updates / seconds)


def run_part(name: str, device: str, turn: Turn) -> None:
    torch.set_num_threads(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if name == "peers":
            found = peers(device, turn)
        elif name == "training":
            found = training(device, turn)
        else:
            label, n, compiled = PARTS[name]
            found = one(label, compiled, device, turn) if n == 1 else several(label, n, compiled, device, turn)
    print(f"| {name} | {found} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default=",".join([*PARTS, *OTHERS]), help="what to measure")
    parser.add_argument("--seconds", type=float, default=200, help="for all parts")
    parser.add_argument("--device", default="cuda", help="of the models")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    parser.add_argument("--of", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.part:
        run_part(args.part, args.device, Turn(args.folder, args.of))
        return
    names = args.parts.split(",")
    unknown = [name for name in names if name not in PARTS and name not in OTHERS]
    if unknown:
        raise SystemExit(f"--parts has {unknown}, which are none of {[*PARTS, *OTHERS]}")
    card = torch.cuda.get_device_name(args.device) if args.device.startswith("cuda") else "CPU"
    print(f"{card}, torch {torch.__version__}\n\n{HEADER}\n| {'--- | ' * 9}", flush=True)
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "TORCHINDUCTOR_COMPILE_THREADS": "4"}
        command = [sys.executable, __file__, "--device", args.device, "--folder", folder, "--of", str(len(names))]
        running = {
            name: subprocess.Popen([*command, "--part", name], env=environment, stderr=subprocess.PIPE, text=True)
            for name in names
        }
        for name, process in running.items():
            try:
                _, error = process.communicate(timeout=max(args.seconds - (time.perf_counter() - start), 0.1))
                if process.returncode != 0:
                    print(f"| {name} | failed: {error.strip().splitlines()[-1]} | | | | | | | |", flush=True)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
                print(f"| {name} | left out: {args.seconds:.0f} s are over | | | | | | | |", flush=True)


if __name__ == "__main__":
    main()
