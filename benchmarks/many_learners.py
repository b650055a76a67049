"""
Gradient steps of several learners on a CPU: in one process as one update, against processes of one thread each.

    python benchmarks/many_learners.py [--learners 8] [--agents bro-small,sac] [--seconds 20]

Figures are updates a second of all learners together. "apart" are as many processes as there are cores, each with one
thread and its share of the learners, which take turns, compiled; "together" is one process with all of them in one
update (``LearnerGroup``), eager and compiled, with one thread and with one for each core. The contenders take turns,
alone on the machine.
"""

import argparse
import multiprocessing
import os
import time
import warnings
from typing import Any

import torch
from gpu import AGENTS, inputs_of
from update_speed import build

from sb3_sample.learner.group import LearnerGroup


def made(label: str, n: int, compiled: bool) -> list[Any]:
    """Models, whose gradient steps are compiled or not."""
    cls, kwargs = AGENTS[label]
    models = [build(cls, compile=compiled, device="cpu", **kwargs) for _ in range(n)]
    for model in models:
        model.compiled = compiled
        model.learner.set_training_mode(True)
    return models


def rate(step: Any, seconds: float) -> float:
    """Calls a second."""
    for _ in range(3):
        step()
    start, n = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        step()
        n += 1
    return n / (time.perf_counter() - start)


def apart(label: str, seconds: float, barrier: Any, results: Any) -> None:
    """One process: one of its learners, whose rate is that of all by turns."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    (model,) = made(label, 1, compiled=True)
    batch, noise, *_ = inputs_of(model)
    model.learner.step(batch, noise)
    barrier.wait()
    results.put(rate(lambda: model.learner.step(batch, noise), seconds))


def together(label: str, n: int, seconds: float, compiled: bool, threads: int, results: Any) -> None:
    """One process: all learners in one update."""
    torch.set_num_threads(threads)
    warnings.simplefilter("ignore")
    models = made(label, n, compiled)
    group = LearnerGroup([model.learner for model in models])
    inputs = [inputs_of(model) for model in models]
    results.put(n * rate(lambda: group.step(inputs), seconds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--learners", type=int, default=8)
    parser.add_argument("--agents", default="bro-small,sac")
    parser.add_argument("--seconds", type=float, default=20, help="of each measurement")
    args = parser.parse_args()
    cores = os.cpu_count() or 1
    context = multiprocessing.get_context("spawn")
    print(f"{args.learners} learners, {cores} cores, torch {torch.__version__}\n")
    print("| | threads | updates a second | / apart |\n| --- | ---: | ---: | ---: |", flush=True)
    for label in args.agents.split(","):
        results = context.Queue()
        barrier = context.Barrier(cores)
        processes = [context.Process(target=apart, args=(label, args.seconds, barrier, results)) for _ in range(cores)]
        for process in processes:
            process.start()
        base = sum(results.get() for _ in processes)
        print(f"| {label}, apart, compiled | {cores} x 1 | {base:.0f} | 1 |", flush=True)
        for compiled in (False, True):
            for threads in sorted({1, cores}):
                process = context.Process(
                    target=together, args=(label, args.learners, args.seconds, compiled, threads, results)
                )
                process.start()
                found = results.get()
                process.join()
                how = "compiled" if compiled else "eager"
                print(f"| {label}, together, {how} | {threads} | {found:.0f} | {found / base:.2f} |", flush=True)


if __name__ == "__main__":
    main()
