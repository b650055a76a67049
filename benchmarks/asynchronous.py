"""
Acting beside learning: an environment whose step blocks for 30 ms, at 20 Hz, with BRO of 0.55M parameters.

    OMP_NUM_THREADS=1 python benchmarks/asynchronous.py [--seconds 60]

First a program that only sleeps until each period begins, which is as punctual as the machine lets it be. Then three
trainings: the learner alone (an environment without delay, as many gradient steps as it can take), acting in a thread
of its own (``learn(asynchronous=True, control_frequency=20)``), and one after the other. By how much steps begin after
the periods of 50 ms, and how many periods have none; gradient steps a second. The first seconds, in which the gradient
step is compiled, are not counted.
"""

import argparse
import json
import math
import time
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sample import BRO

STEP, PERIOD = 0.03, 0.05


class Blocking(gym.Wrapper):
    """
    An environment whose steps block, and that notes when they begin.

    :param env: the environment
    :param seconds: of a step
    """

    def __init__(self, env: gym.Env, seconds: float):
        super().__init__(env)
        self.seconds, self.starts = seconds, []  # type: ignore[var-annotated]

    def step(self, action: Any) -> Any:
        now = time.perf_counter()
        self.starts.append(now)
        found = self.env.step(action)
        time.sleep(max(now + self.seconds - time.perf_counter(), 0.0))
        return found


class Stop(BaseCallback):
    """
    Ends the training some seconds after the gradient step is compiled, and counts the gradient steps since.

    :param seconds: how many
    """

    def __init__(self, seconds: float):
        super().__init__()
        self.seconds = seconds
        self.began: float | None = None
        self.updates = self.before = 0

    def _on_step(self) -> bool:
        now, done = time.perf_counter(), self.model._n_updates
        if self.began is None:
            if done > 50:
                self.began, self.before = now, done
            return True
        self.updates, self.lasted = done - self.before, now - self.began
        return self.lasted < self.seconds


def lateness(periods: np.ndarray) -> dict[str, float]:
    """
    :param periods: when steps began, in periods since the first
    :return: by how much they were late
    """
    late = 1_000 * PERIOD * (periods - np.floor(periods + 1e-4))
    return {f"late_ms_{q}": float(np.percentile(late, q)) for q in (50, 99)}


def bare(seconds: float) -> dict[str, float]:
    """
    :param seconds: how long
    :return: how late a program begins its periods that does nothing else
    """
    begin, starts = time.perf_counter(), []
    for number in range(int(seconds / PERIOD)):
        time.sleep(max(begin + number * PERIOD - time.perf_counter(), 0.0))
        starts.append(time.perf_counter() - begin)
        time.sleep(STEP)
    return lateness(np.array(starts) / PERIOD)


def measure(kind: str, seconds: float, compile: bool) -> dict[str, float]:
    """
    :param kind: "alone", "asynchronous" or "synchronous"
    :param seconds: how long
    :param compile: whether the gradient step is compiled
    :return: what was measured
    """
    env = Blocking(gym.make("Pendulum-v1"), 0.0 if kind == "alone" else STEP)
    model = BRO(
        "MlpPolicy", env, model_size="0.55M", learning_starts=50, seed=0, device="cpu", compile=compile,
        resets=(), buffer_size=100_000,
    )  # fmt: skip
    stop = Stop(seconds)
    more: dict[str, Any] = {"asynchronous": True, "control_frequency": 1 / PERIOD} if kind == "asynchronous" else {}
    model.learn(10_000_000, stop, log_interval=None, **more)
    found = {"updates_per_second": stop.updates / stop.lasted}
    if kind != "alone":
        assert stop.began is not None
        starts = np.array([each for each in env.starts if each >= stop.began])
        found["steps_per_second"] = len(starts) / (starts[-1] - starts[0])
        # The raster is that of the first step of the training.
        periods = (starts - env.starts[0]) / PERIOD
        found |= lateness(periods)
        every = math.floor(periods[-1] + 1e-4) - math.floor(periods[0] + 1e-4) + 1
        found["missed_share"] = 1 - len(np.unique(np.floor(periods + 1e-4))) / every
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60, help="of each training (60)")
    parser.add_argument("--no-compile", action="store_true", help="gradient steps as PyTorch takes them")
    parser.add_argument("--rounds", type=int, default=1, help="how often all of them (1)")
    options = parser.parse_args()
    for _ in range(options.rounds):
        for kind in ("bare", "alone", "asynchronous", "synchronous"):
            found = bare(options.seconds) if kind == "bare" else measure(kind, options.seconds, not options.no_compile)
            print(json.dumps({"kind": kind, **{name: round(value, 3) for name, value in found.items()}}), flush=True)


if __name__ == "__main__":
    main()
