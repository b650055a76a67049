"""
Gradient steps and actions a second on a GPU, eager and captured as a CUDA graph.

    python benchmarks/gpu.py [--seconds 60] [--device cuda]

Rows are printed as they come; what has not begun after ``--seconds`` is left out, with a word. A gradient step includes
drawing its batch of 128 (BRO) or 256 transitions with 17 observed numbers and 6 actions, as in ``update_speed.py``.
"One a call" is ``train(1)``, as replay ratio 1 takes it, "many" ``train(100)``; "acting" is ``predict`` of one
observation, with noise.
"""

import argparse
import statistics
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from update_speed import OBSERVATION, build, training_step

from sb3_sample.sac import DAC, SAC, VPLSAC, BROFast

#: Agents by label: class, arguments.
AGENTS: dict[str, tuple[type[SAC], dict[str, Any]]] = {
    "BRO 4.92M": (BROFast, {"model_size": "4.92M"}),
    "SAC": (SAC, {}),
    "BRO 0.55M": (BROFast, {"model_size": "0.55M"}),
    "DAC": (DAC, {}),
    "VPL-SAC": (VPLSAC, {}),
}


def rate(call: Callable[[], Any], n: int, device: torch.device) -> float:
    """Calls a second: the median of three times ``n``."""
    rates = []
    for _ in range(3):
        start = time.perf_counter()
        for _ in range(n):
            call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        rates.append(n / (time.perf_counter() - start))
    return statistics.median(rates)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60, help="after which nothing new is begun")
    parser.add_argument("--device", default="cuda", help="of the models")
    args = parser.parse_args()
    device, start = torch.device(args.device), time.perf_counter()
    card = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(f"{card}, torch {torch.__version__}, TF32 {torch.backends.cuda.matmul.allow_tf32}\n")
    print("| | step | one a call | many | acting |\n| --- | --- | ---: | ---: | ---: |", flush=True)
    for label, (cls, kwargs) in AGENTS.items():
        for how, compile in (("captured", True), ("eager", False)):
            if time.perf_counter() - start > args.seconds:
                print(f"| {label} | {how} | left out: {args.seconds:.0f} s are over | | |", flush=True)
                continue
            with warnings.catch_warnings():
                # An older torch captures the eager step: the label of the row.
                warnings.filterwarnings("ignore", message="The gradient step is not compiled")
                model = build(cls, compile=compile, device=device, **kwargs)
                model.train(5, model.batch_size)
            n = 100 if compile else 20
            one = rate(training_step(model, model.batch_size), n, device)
            many = n * rate(lambda model=model, n=n: model.train(n, model.batch_size), 1, device)  # type: ignore[misc]
            observation = np.zeros((1, OBSERVATION), np.float32)
            acts = rate(lambda model=model, o=observation: model.predict(o), 100, device)  # type: ignore[misc]
            print(f"| {label} | {how} | {one:.0f} | {many:.0f} | {acts:.0f} |", flush=True)


if __name__ == "__main__":
    main()
