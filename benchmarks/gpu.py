"""
Gradient steps and actions a second on a GPU: one learner and several, eager and captured, compiled and not.

    python benchmarks/gpu.py [--parts bro,bro-x10,...] [--seconds 200] [--device cuda]

Each part is a process. All compile at the same time, and one measures, in the order of the parts; rows are printed as
they come. A part that is not done after ``--seconds``, or measures longer than its own limit, is left out, with a word.
On a CPU nothing is captured, and what is of graphs and of memory stays empty.

A gradient step includes drawing its batch of 128 (BRO) or 256 transitions with 17 observed numbers and 6 actions, as in
``update_speed.py``. "One a call" is ``train(1)``, as replay ratio 1 takes it, "many" ``train(100)``; "graph" the launch
alone, on inputs that stay; "acting" an action of the explorer for one observation. Rows "x 10" are of ten learners in
one update (``LearnerGroup``): updates, and actions, of all together, on batches and observations that lie on the
device; those of "drawn" draw them in the step, from a ``DeviceReplayBuffer``. "mbma-ppo" is an iteration of ``MBMAPPO``
over one of Stable-Baselines3's PPO (``simulated_ppo.py``), "mbma-ppo-cpu" the same on the CPU, where PPO is said to
belong. Peers have networks of two layers of 256 and batches of 256: Stable-Baselines3's, LeanRL's recipe
(``lean_sac.py``), and SBX's where it is installed. "training" is ``train_many`` of ten learners on HalfCheetah-v5, in
updates of all.
"""

import argparse
import fcntl
import importlib
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from lean_sac import LeanSAC
from simulated_ppo import short_rows
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
    "vpl-drawn": (VPLSAC, DRAWN),
}
#: Agents after BRO. Compiled, they are parts of a run of their own, so that not all compile at the same time.
AFTER_BRO = ("simba", "simbav2", "brc", "crossq", "xqc", "flash", "dr_q")
#: Measurements in their order: label, number of learners, whether compiled.
PARTS: dict[str, tuple[str, int, bool]] = {
    "bro": ("bro", 1, True),
    "sac": ("sac", 1, True),
    "bro-x10": ("bro", 10, True),
    "sac-x10": ("sac", 10, True),
    "sac-drawn": ("sac-drawn", 1, True),
    "bro-drawn": ("bro-drawn", 1, True),
    "vpl-drawn": ("vpl-drawn", 1, True),
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
    **{f"{label}-uncompiled": (label, 1, False) for label in ("dac", "vpl", *AFTER_BRO)},
    **{label: (label, 1, True) for label in AFTER_BRO},
}
HEADER = "| | run | one a call | many a call | graph | graph, TF32 | acting | peak memory, MB | compiling, s |"
#: Seconds that a part may measure.
LIMIT, LIMITS = 30, {"mbma-ppo": 90, "mbma-ppo-cpu": 60, "lean-sac-compiled": 60, "training": 90}
#: Seconds that one figure may take, by about.
FIGURE = 3.0


def rate(call: Callable[[], Any], n: int) -> float:
    """Calls a second: the median of three times ``n``, fewer where they would take too long."""

    def seconds(n: int) -> float:
        start = time.perf_counter()
        for _ in range(n):
            call()
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        return time.perf_counter() - start

    n = max(1, min(n, int(FIGURE / 3 / seconds(1))))
    return n / statistics.median(seconds(n) for _ in range(3))


class Turn:
    """
    Turn to measure, which one process has at a time, in the order of the parts. The first begins when all are ready, or
    after ``PATIENCE`` seconds. A process that measures longer than its limit is ended.

    :param name: of this process's part
    :param names: of all parts, in their order
    :param folder: of all processes
    """

    PATIENCE = 100.0

    def __init__(self, name: str, names: list[str], folder: str):
        self._name, self._names, self._folder, self._start = name, names, Path(folder), time.perf_counter()

    def __enter__(self) -> None:
        self._told("ready", self._name).touch()
        while self._others_are_first():
            time.sleep(0.1)
        self._file = open(self._folder / "turn", "w")
        fcntl.flock(self._file, fcntl.LOCK_EX)
        # Without a handler it ends the process, whatever that is waiting for.
        signal.alarm(LIMITS.get(self._name, LIMIT))

    def __exit__(self, *error: Any) -> None:
        signal.alarm(0)
        self._file.close()

    def _told(self, what: str, name: str) -> Path:
        return self._folder / f"{what}-{name}"

    def _others_are_first(self) -> bool:
        ended = {name for name in self._names if self._told("ended", name).exists()}
        ready = {name for name in self._names if self._told("ready", name).exists()} - ended
        if len(ready | ended) < len(self._names) and time.perf_counter() - self._start < self.PATIENCE:
            return True
        return any(name in ready for name in self._names[: self._names.index(self._name)])


def ended(name: str, folder: str) -> None:
    """Note that a part's process has ended, for those that wait for it."""
    (Path(folder) / f"ended-{name}").touch()


def row(how: str, *figures: float | None) -> str:
    """A row of the table, without its first column."""
    cells = ["" if figure is None else f"{figure:.0f}" for figure in figures]
    return " | ".join([how, *cells, *[""] * (7 - len(cells))])


def is_cuda(device: str) -> bool:
    return torch.device(device).type == "cuda"


def forget_memory(device: str) -> None:
    if is_cuda(device):
        torch.cuda.reset_peak_memory_stats(device)


def memory(device: str) -> float | None:
    """Peak memory in MB since the last :func:`forget_memory`; None on a CPU."""
    return torch.cuda.max_memory_allocated(device) / 2**20 if is_cuda(device) else None


def inputs_of(model: Any) -> tuple[Any, ...]:
    """The arguments of a gradient step, on the device."""
    device, n = model.device, model.batch_size

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, device=device)

    actions = torch.rand((n, ACTION), device=device) * 2 - 1
    zeros = torch.zeros((n, 1), device=device)
    batch = Batch(normal(n, OBSERVATION), actions, normal(n, OBSERVATION), zeros, normal(n, 1), 0.99)
    return batch, Noise(*(normal(n, ACTION) for _ in range(3))), None, True, True


def captured_by(owner: Any) -> Any:
    """Graphs of the steps of a learner or a group; None if they are run as they are."""
    return (owner._drawing or owner._execution)._captured


def graph_rate(owner: Any, n: int) -> float | None:
    """Rate of the launch of a captured step; None if there is none."""
    captured = captured_by(owner)
    return None if captured is None else rate(next(iter(captured._recorded.values()))[1], n)


def with_tf32(call: Callable[[], float | None]) -> float | None:
    """A figure with TF32."""
    torch.backends.cuda.matmul.allow_tf32 = True
    try:
        return call()
    finally:
        torch.backends.cuda.matmul.allow_tf32 = False


def tf32_rate(owner: Any, step: Callable[[], Any], n: int) -> float | None:
    """Rate of the graph, captured anew with TF32; None if there is none."""
    captured = captured_by(owner)
    if captured is None:
        return None

    def anew() -> float | None:
        captured._recorded.clear()
        step()
        return graph_rate(owner, n)

    return with_tf32(anew)


def way(owner: Any, compiled: bool) -> str:
    words = ["compiled"] * compiled + ["captured"] * (captured_by(owner) is not None)
    return ", ".join(words) or "as it is"


def one(label: str, compiled: bool, device: str, turn: Turn) -> Iterator[str]:
    """Gradient steps and actions of one learner."""
    cls, kwargs = AGENTS[label]
    model = build(cls, compile=True, device=device, **kwargs)
    model.compiled = compiled
    model.train(5, model.batch_size)
    step = training_step(model, model.batch_size)
    with turn:
        forget_memory(device)
        one_a_call, many = rate(step, 100), 100 * rate(lambda: model.train(100, model.batch_size), 1)
        learner = model.learner
        graph, tf32 = graph_rate(learner, 200), tf32_rate(learner, step, 200)
        act = acting(model)
        for _ in range(5):
            act()
        actions = rate(act, 200)
        how = way(learner, compiled)
        if not compiled:
            eager = rate(lambda: learner.step(*inputs_of(model)[:2], eager=True), 10)
            how += f" (eager: {eager:.0f})"
        yield row(how, one_a_call, many, graph, tf32, actions, memory(device), learner.seconds_compiling)


def several(label: str, n: int, compiled: bool, device: str, turn: Turn) -> Iterator[str]:
    """Gradient steps and actions of several learners in one update."""
    cls, kwargs = AGENTS[label]
    models = [build(cls, compile=True, device=device, **kwargs) for _ in range(n)]
    for model in models:
        model.compiled = compiled
        model.learner.set_training_mode(True)
    group = LearnerGroup([model.learner for model in models])
    inputs = [inputs_of(model) for model in models]
    observed = [(own[0].observations[:1], own[1].critic[:1]) for own in inputs]
    if all(model._draws_in_steps() for model in models):
        inputs = [(model.batch_size, 0, True, True) for model in models]
    for _ in range(6):
        group.step(inputs)
    with turn:
        forget_memory(device)
        steps = n * rate(lambda: group.step(inputs), 50)
        graphs = graph_rate(group, 100), tf32_rate(group, lambda: group.step(inputs), 100)
        graph, tf32 = (None if figure is None else n * figure for figure in graphs)
        with torch.inference_mode():
            for _ in range(5):
                group.act(observed)
            actions = n * rate(lambda: group.act(observed), 200)
        yield row(way(group, compiled), steps, None, graph, tf32, actions, memory(device), group.seconds_compiling)


def mbma(at: str | None, device: str, turn: Turn) -> Iterator[str]:
    """An iteration of MBMA-PPO over one of PPO's."""
    at = at or device
    with turn:
        for name, ms, ratio in short_rows([0, 4, 8, 16], at):
            yield row(f"{name}: {ratio:.2f} of PPO's iteration, {ms:.2f} ms a real step on {at}")


def theirs(name: str, device: str, turn: Turn) -> Iterator[str]:
    """A gradient step of Stable-Baselines3."""
    import stable_baselines3

    model = build(getattr(stable_baselines3, name), device=device, policy_kwargs={"net_arch": [256, 256]})
    step, act = training_step(model, 256), acting(model)
    with turn:
        forget_memory(device)
        step()
        act()
        one_a_call, actions = rate(step, 50), rate(act, 200)
        yield row(f"stable_baselines3's {name}", one_a_call, None, None, None, actions, memory(device))


def lean(compiled: bool, device: str, turn: Turn) -> Iterator[str]:
    """A gradient step by LeanRL's recipe."""
    agent = LeanSAC(OBSERVATION, ACTION, device=device, compiled=compiled)
    sizes = (OBSERVATION, ACTION, OBSERVATION, 1, 1)
    store = [torch.rand((2_000, size), device=device) for size in sizes]
    store[3].zero_()
    start = time.perf_counter()
    agent.step(store)
    seconds = time.perf_counter() - start if compiled else None
    agent.capture()

    def anew() -> float:
        agent.capture()
        return rate(agent.launch, 200)

    with turn:
        forget_memory(device)
        one_a_call = rate(lambda: agent.step(store), 200)
        graph, tf32 = (rate(agent.launch, 200), with_tf32(anew)) if is_cuda(device) else (None, None)
        how = "LeanRL's recipe" + ", compiled" * compiled + ", captured" * is_cuda(device)
        yield row(how, one_a_call, None, graph, tf32, None, memory(device), seconds)


def sbx(device: str, turn: Turn) -> Iterator[str]:
    """A gradient step of SBX, which computes where JAX does."""
    try:
        agents, jax = importlib.import_module("sbx"), importlib.import_module("jax")
    except ImportError as error:
        with turn:
            yield row(f"SBX's SAC: not measured, {error}")
            return
    model = build(agents.SAC, policy_kwargs={"net_arch": {"pi": [256, 256], "qf": [256, 256]}})
    step, act = training_step(model, 256), acting(model)
    start = time.perf_counter()
    step()
    seconds = time.perf_counter() - start
    with turn:
        act()
        one_a_call, actions = rate(step, 100), rate(act, 200)
        how = f"SBX's SAC {agents.__version__}, JAX {jax.__version__} on {jax.default_backend()}"
        yield row(how, one_a_call, None, None, None, actions, None, seconds)


def training(device: str, turn: Turn) -> Iterator[str]:
    """Ten learners with their environments."""
    steps, n = 3_000, 10
    with turn:
        start = time.perf_counter()
        models = train_many(
            SAC, "MlpPolicy", "HalfCheetah-v5", seeds=range(n), total_timesteps=steps, learning_starts=1_000,
            device=device, compile=True,
        )  # fmt: skip
        seconds = time.perf_counter() - start
        updates = sum(model._n_updates for model in models)
        yield row(f"SAC, {updates} updates in {seconds:.0f} s with warm-up", updates / seconds)


#: Measurements after those of the agents, in their order.
OTHERS: dict[str, Callable[[str, Turn], Iterator[str]]] = {
    "mbma-ppo": partial(mbma, None),
    "mbma-ppo-cpu": partial(mbma, "cpu"),
    "sb3-sac": partial(theirs, "SAC"),
    "sb3-td3": partial(theirs, "TD3"),
    "lean-sac": partial(lean, False),
    "lean-sac-compiled": partial(lean, True),
    "sbx-sac": sbx,
    "training": training,
}


def rows_of(name: str, device: str, turn: Turn) -> Iterator[str]:
    if name in OTHERS:
        return OTHERS[name](device, turn)
    label, n, compiled = PARTS[name]
    return one(label, compiled, device, turn) if n == 1 else several(label, n, compiled, device, turn)


def run_part(name: str, device: str, turn: Turn) -> None:
    torch.set_num_threads(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for found in rows_of(name, device, turn):
            print(f"| {name} | {found} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    usual = [name for name in (*PARTS, *OTHERS) if name not in AFTER_BRO]
    parser.add_argument(
        "--parts", default=",".join(usual), help="what to measure, in this order (default: %(default)s)"
    )
    parser.add_argument("--seconds", type=float, default=200, help="for all parts")
    parser.add_argument("--device", default="cuda", help="of the models")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    args = parser.parse_args()
    names = args.parts.split(",")
    if args.part:
        run_part(args.part, args.device, Turn(args.part, names, args.folder))
        return
    unknown = [name for name in names if name not in PARTS and name not in OTHERS]
    if unknown or len(set(names)) < len(names):
        raise SystemExit(f"--parts must be some of {[*PARTS, *OTHERS]}, each once, not {names}")
    if is_cuda(args.device) and not torch.cuda.is_available():
        raise SystemExit(f"--device {args.device}: there is no GPU; --device cpu runs the parts on the CPU")
    card = torch.cuda.get_device_name(args.device) if is_cuda(args.device) else "CPU"
    print(f"{card}, torch {torch.__version__}\n\n{HEADER}\n| {'--- | ' * 9}", flush=True)
    end = time.perf_counter() + args.seconds
    with tempfile.TemporaryDirectory() as folder:
        running = {name: started(name, args, folder) for name in names}
        while running and time.perf_counter() < end:
            for name, process in list(running.items()):
                if process.poll() is not None:
                    ended(name, folder)
                    told(name, running.pop(name).returncode, folder)
            time.sleep(0.05)
        late = {name: process for name, process in running.items() if process.poll() is None}
        for process in late.values():
            process.kill()
        for name, process in running.items():
            if name not in late:
                told(name, process.returncode, folder)
                continue
            process.wait()
            said(name, f"left out: {args.seconds:.0f} s are over")


def started(name: str, args: argparse.Namespace, folder: str) -> "subprocess.Popen[bytes]":
    """The process of a part."""
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "TORCHINDUCTOR_COMPILE_THREADS": "4",
        # JAX would take most of the memory that the others need.
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    }
    options = ["--device", args.device, "--folder", folder, "--parts", args.parts, "--part", name]
    with open(Path(folder) / f"errors-{name}", "w") as errors:
        return subprocess.Popen([sys.executable, __file__, *options], env=environment, stderr=errors)


def told(name: str, code: int, folder: str) -> None:
    """Print how a part ended, unless it ended well."""
    if code == -signal.SIGALRM:
        said(name, f"left out: its {LIMITS.get(name, LIMIT)} s are over")
    elif code != 0:
        lines = (Path(folder) / f"errors-{name}").read_text().strip().splitlines()
        said(name, f"failed: {lines[-1] if lines else f'exit status {code}'}")


def said(name: str, words: str) -> None:
    print(f"| {name} | {row(words)} |", flush=True)


if __name__ == "__main__":
    main()
