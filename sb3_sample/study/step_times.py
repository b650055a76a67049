"""Times of BRO's gradient steps on this machine by critic size, measured once and stored in the user's cache."""

import dataclasses
import functools
import json
import os
import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import get_device
from torch.utils.flop_counter import FlopCounterMode

from sb3_sample.learner.execution import why_not_compiled
from sb3_sample.sac.bro import BRO, MODEL_SIZES
from sb3_sample.saving.temporary import becoming
from sb3_sample.saving.training_state import processor

#: Dimensions of an observation and of an action, as in cheetah-run.
OBSERVATION, ACTION = 17, 6
#: Seconds of each measurement, and of each quick measurement.
SECONDS, QUICK_SECONDS = 3.0, 1.0
#: Shape of the matrix product that a quick measurement times: critics, rows, features.
_PRODUCT = (2, 128, 512)


@dataclasses.dataclass(frozen=True)
class StepTimes:
    """
    Times of BRO's steps, in seconds.

    :param processor: name of the processor or GPU
    :param torch: version
    :param threads: of torch
    :param how: execution of the gradient steps: "compiled", "captured", "eager", or "quick" for an estimate
    :param gradient_step: by size of the model, including the drawing of the batch
    :param preparation: compile time before the first gradient step, by size of the model
    :param acting: of an environment step, without the environment itself and gradient steps
    """

    processor: str
    torch: str
    threads: int
    how: str
    gradient_step: dict[str, float]
    preparation: dict[str, float]
    acting: float

    @property
    def key(self) -> tuple[str, str, int]:
        """Processor, torch and threads: the key under which times are stored."""
        return self.processor, self.torch, self.threads

    def __str__(self) -> str:
        times = ", ".join(f"{size} {1e3 * seconds:.3g}" for size, seconds in self.gradient_step.items())
        threads = f"{self.threads} thread{'s' if self.threads > 1 else ''}"
        how = "estimated" if self.how == "quick" else self.how
        return f"{self.processor}, {threads}, torch {self.torch}; gradient steps ({how}), ms: {times}"


def _key(threads: int, device: torch.device) -> tuple[str, str, int]:
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else processor()
    return name, str(torch.__version__), threads


# ---------------------------------------------------------------- the cache


def cache_file() -> Path:
    """
    :return: file of the step times, in ``$XDG_CACHE_HOME`` or ``~/.cache``
    """
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "sb3_sample" / "step_times.json"


def _read() -> list[StepTimes]:
    path = cache_file()
    try:
        text = path.read_text()
    except FileNotFoundError:
        return []
    try:
        found = [StepTimes(**each) for each in json.loads(text)]
        numbers = [[each.acting, *each.gradient_step.values(), *each.preparation.values()] for each in found]
        if any(not 0 <= float(number) < np.inf for row in numbers for number in row):
            raise ValueError("times must be numbers of at least 0")
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} holds no step times ({error}): remove it, and they are measured anew") from error
    return found


def stored(threads: int, device: torch.device | str = "auto") -> StepTimes | None:
    """
    :param threads: of torch
    :param device: a device
    :return: the times stored for this processor, torch and number of threads; None if there are none
    :raises ValueError: their file does not hold step times
    """
    return next((each for each in _read() if each.key == _key(threads, get_device(device))), None)


def keep(times: StepTimes) -> Path:
    """
    Store step times, in place of those of the same processor, torch and number of threads.

    :param times: of this machine
    :return: the file
    """
    path = cache_file()
    others = [each for each in _read() if each.key != times.key]
    path.parent.mkdir(parents=True, exist_ok=True)
    with becoming(path) as file:
        file.write(json.dumps([dataclasses.asdict(each) for each in [*others, times]], indent=1).encode())
    return path


# ---------------------------------------------------------------- measuring


class _Shapes(gym.Env):
    """Environment with only shapes, whose steps take no time."""

    observation_space = spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float32)
    action_space = spaces.Box(-1, 1, (ACTION,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return np.zeros(OBSERVATION, np.float32), {}

    def step(self, action: np.ndarray) -> Any:
        return np.zeros(OBSERVATION, np.float32), 0.0, False, False, {}


def measure(
    threads: int,
    device: torch.device | str = "auto",
    *,
    quick: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> StepTimes:
    """
    Measure the times of BRO's steps as in long runs: compiled if possible, which takes some minutes for all sizes.

    With ``quick`` nothing is compiled. The time of a compiled step lies between that of its matrix multiplications, at
    the processor's rate of multiplication, and that of the eager step; their geometric mean is the estimate. On the
    machine of ``docs/performance.md`` it is 4% to 14% below the time of compiled steps.

    :param threads: of torch
    :param device: a device
    :param quick: whether to estimate the compiled steps
    :param say: called with a message on each measurement
    :return: the times
    :raises ValueError: ``quick`` on a GPU, where eager steps say little about captured ones
    """
    place = get_device(device)
    if quick and place.type != "cpu":
        raise ValueError(
            f"quick must be of a CPU, not of {place}: there eager steps say little, and measuring is short"
        )
    seconds = QUICK_SECONDS if quick else SECONDS
    steps: dict[str, float] = {}
    preparation: dict[str, float] = {}
    how = "quick"
    with _threads(threads), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rate = _rate(seconds) if quick else 0.0
        for size in MODEL_SIZES:
            say(f"measuring {size}" + ("" if quick else " (compiling can take a minute)"))
            model = _model(size, place)
            if not quick:
                reason = why_not_compiled(model.learner)
                how = "compiled" if reason is None else "captured" if place.type == "cuda" else "eager"
                # Not False, which would prevent the capture on a GPU.
                model = _model(size, place, compile="auto" if reason else True)
            start = time.perf_counter()
            _train(model)
            first = time.perf_counter() - start
            steps[size] = _median(functools.partial(_train, model), seconds)
            preparation[size] = 0.0 if quick else max(first - steps[size], 0.0)
            if quick:
                with FlopCounterMode(display=False) as counter:
                    _train(model)
                # Geometric mean of the time of the multiplications and of the eager step.
                steps[size] = float(np.sqrt(steps[size] * min(counter.get_total_flops() / rate, steps[size])))
        acting = _acting(place, seconds)
    return StepTimes(*_key(threads, place), how, steps, preparation, acting)


@contextmanager
def _threads(threads: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _model(size: str, device: torch.device, compile: bool | str = False) -> Any:
    """BRO with random transitions in its buffer."""
    model = BRO("MlpPolicy", _Shapes(), model_size=size, buffer_size=2_000, seed=0, device=device, compile=compile)
    model.set_logger(Logger(None, []))
    rng = np.random.default_rng(0)
    assert model.replay_buffer is not None
    for _ in range(1_000):
        obs, next_obs = rng.normal(size=(2, 1, OBSERVATION)).astype(np.float32)
        action, reward = rng.uniform(-1, 1, (1, ACTION)).astype(np.float32), rng.uniform(size=1)
        model.replay_buffer.add(obs, next_obs, action, reward, np.zeros(1), [{}])
    return model


def _train(model: Any) -> None:
    model.train(gradient_steps=1, batch_size=model.batch_size)
    if model.device.type == "cuda":
        torch.cuda.synchronize()


def _median(call: Callable[[], Any], seconds: float) -> float:
    """Median time of a call, over at least three calls."""
    times: list[float] = []
    until = time.perf_counter() + seconds
    while len(times) < 3 or time.perf_counter() < until:
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def _rate(seconds: float) -> float:
    """Floating-point operations per second of a batched matrix product as wide as the critics'."""
    copies, rows, width = _PRODUCT
    x, w = torch.randn(copies, rows, width), torch.randn(copies, width, width)
    return 2 * copies * rows * width**2 / _median(lambda: torch.bmm(x, w), seconds)


def _acting(device: torch.device, seconds: float) -> float:
    """Time of an environment step of ``learn`` in an environment that takes no time, without gradient steps."""
    model = BRO("MlpPolicy", _Shapes(), model_size=next(iter(MODEL_SIZES)), replay_ratio=0, device=device, seed=0,
                learning_starts=0, buffer_size=20_000)  # fmt: skip
    model.set_logger(Logger(None, []))
    model.learn(20)
    return _median(lambda: model.learn(50, reset_num_timesteps=False), seconds) / 50


def environment_seconds(env: gym.Env, seconds: float = SECONDS) -> float:
    """
    :param env: an environment
    :param seconds: how long to measure
    :return: seconds per step with random actions, including resets
    """
    env.action_space.seed(0)
    env.reset(seed=0)
    steps, start = 0, time.perf_counter()
    while steps < 10 or time.perf_counter() - start < seconds:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        steps += 1
        if terminated or truncated:
            env.reset()
    return (time.perf_counter() - start) / steps
