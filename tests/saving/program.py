"""
A training program that the tests start, kill and start again, in processes of their own; and what it leaves behind, as
checksums by name, so that two runs can be compared bit by bit.
"""

import collections
import errno
import hashlib
import json
import multiprocessing
import os
import random
import re
import resource
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_sample import MBMAPPO, MBPOPPO, QMAPPO, RewoundPPO, make_atari_env
from sb3_sample.diagnostics import DiagnosticsCallback, NoiseScaleCallback
from sb3_sample.envs import make_env
from sb3_sample.envs.registration import is_atari_id
from sb3_sample.replay.buffers import DeviceReplayBuffer
from sb3_sample.replay.compact import CompactReplay
from sb3_sample.replay.frames import OLDER, OLDER_FRAMES, StackedFrames
from sb3_sample.replay.weighted import FadedReplayBuffer, PrioritizedReplayBuffer
from sb3_sample.saving import training_state, vec_envs
from sb3_sample.saving.callbacks import walk
from sb3_sample.saving.folders import Folder
from tests.agents import OFF_POLICY
from tests.ppo.common import TINY, TINY_MODELS, arguments_of
from tests.sac.pixels import Frames
from tests.srspr import common as srspr

PPOS = {"MBMA": MBMAPPO, "QMA": QMAPPO, "MBPO": MBPOPPO, "rewound": RewoundPPO}


class Goal(gym.Env):
    """A point that has to reach a goal, for hindsight."""

    def __init__(self) -> None:
        box = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Dict({"observation": box, "achieved_goal": box, "desired_goal": box})
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def _observation(self) -> dict[str, np.ndarray]:
        return {"observation": self.place, "achieved_goal": self.place, "desired_goal": self.goal}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.uniform(-1, 1, (2, 2)).astype(np.float32)
        self.t = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.place = np.clip(self.place + 0.2 * action, -1, 1).astype(np.float32)
        self.t += 1
        reward = float(self.compute_reward(self.place, self.goal, {}))
        return self._observation(), reward, False, self.t >= 9, {"is_success": reward == 0}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return -(np.linalg.norm(achieved - desired, axis=-1) > 0.3).astype(np.float32)


def make(env: str) -> gym.Env:
    """A monitored environment by its id, with short episodes."""
    if env == "goal":
        return Monitor(Goal())
    if env == "frames":
        return Monitor(Frames())
    if env == "stacks":
        return Monitor(srspr.Frames())
    if is_atari_id(env):
        return make_atari_env(env)
    return Monitor(make_env(env) if env.startswith("dmc/") else make_env(env, max_episode_steps=30))


def environment(env: str = "Pendulum-v1", n: int = 1, workers: bool | str = False, wrap: str = "") -> Any:
    """One environment, or several in this process or in workers; perhaps normalised or stacked."""
    if n == 1 and not workers and not wrap:
        return make(env)
    makers: list[Callable[[], gym.Env]] = [lambda: make(env)] * n
    start = workers if isinstance(workers, str) else "fork"
    venv: Any = SubprocVecEnv(makers, start_method=start) if workers else DummyVecEnv(makers)
    if "stack" in wrap:
        venv = VecFrameStack(venv, 2)
    return VecNormalize(venv) if "normalize" in wrap else venv


def model(algorithm: str, folder: str, env: dict[str, Any], **kwargs: Any) -> Any:
    """A tiny model of an algorithm by its name."""
    venv = environment(**env)
    if algorithm in PPOS:
        cls = PPOS[algorithm]
        models = {} if kwargs.get("n_simulated") == 0 else TINY_MODELS[cls]
        arguments = {**TINY, **models, **kwargs}
        if kwargs.get("n_simulated") == 0:
            arguments.pop("warm_up_until")
        return cls("MlpPolicy", venv, **arguments_of(cls, arguments))
    if kwargs.pop("her", False):
        kwargs |= {"replay_buffer_class": HerReplayBuffer, "policy": "MultiInputPolicy", "learning_starts": 60}
    buffers = {"plain": ReplayBuffer, "device": DeviceReplayBuffer, "faded": FadedReplayBuffer,
               "prioritized": PrioritizedReplayBuffer}  # fmt: skip
    if "buffer" in kwargs:
        kwargs["replay_buffer_class"] = buffers[kwargs.pop("buffer")]
    if kwargs.pop("noise", False):
        kwargs["action_noise"] = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.full(1, 0.3))
    return OFF_POLICY[algorithm](venv, **kwargs)


def callbacks(folder: str, env: dict[str, Any], evaluate: bool = False, diagnose: bool = False) -> Any:
    """Callbacks that remember things."""
    if not evaluate:
        return None
    single: Any = environment(**{**env, "n": 1})
    evaluated = DummyVecEnv([lambda: single]) if isinstance(single, gym.Env) else single
    evaluated.seed(7)
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1000)
    n = env.get("n", 1)
    evaluation = EvalCallback(
        evaluated, callback_after_eval=stop, n_eval_episodes=1, eval_freq=max(1, 24 // n),
        log_path=f"{folder}-eval", best_model_save_path=f"{folder}-eval", verbose=0,
    )  # fmt: skip
    others: list[Any] = [StopTrainingOnMaxEpisodes(1000)]
    if diagnose:
        # At steps where the last gradients are those from before a checkpoint, too.
        others.append(DiagnosticsCallback(environment(**{**env, "n": 1}), every=97, rollout_length=20, seed=3))
        others.append(NoiseScaleCallback(every=31, window=3, seed=4))
    return [evaluation, *others]


_RUN_NAMES = re.compile(r"\.?(model|state|manifest|checkpoint-|writing-|removed-|replay|progress|lock)")


def kill_in_writing(folder: str, k: int) -> Callable[[], int]:
    """
    End this process by SIGKILL at the k-th thing that it does to the files in a folder from now on.

    :return: tells how many there were
    """
    count = 0

    def hook(event: str, args: Any) -> None:
        nonlocal count
        if (event == "open" or event.startswith("os.")) and args:
            # Files of a run's folder are reached by their names, from the folder.
            if folder not in str(args[0]) and not _RUN_NAMES.match(str(args[0])):
                return
            count += 1
            if count == k:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
    return lambda: count


class _Kill(threading.Thread):
    """Sends this process SIGKILL, or another signal, a while after a checkpoint is there, wherever it is then."""

    def __init__(self, folder: str, after_steps: int, seconds: float, number: int = signal.SIGKILL):
        super().__init__(daemon=True)
        self.folder, self.after, self.seconds = Path(folder), f"checkpoint-{after_steps:012d}", seconds
        self.number = number

    def run(self) -> None:
        while not any(path.name >= self.after for path in self.folder.glob("checkpoint-*")):
            time.sleep(0.0005)
        time.sleep(self.seconds)
        os.kill(os.getpid(), self.number)


class _Trouble(BaseCallback):
    """
    What is wrong with the machine from some step on.

    :param kind: "full disk": no file grows beyond some bytes, for some steps; "no log": the log's file cannot be
        opened, written to or cut; "tee": nobody reads what is printed; "nothing"
    :param rng: draws when it begins, and ends
    """

    def __init__(self, kind: str, rng: random.Random):
        super().__init__()
        self.kind, self.begin = kind, rng.randrange(20, 150)
        self.end = self.begin + rng.randrange(10, 60)

    # Not part of what is saved: it is no business of the run.
    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass

    def _on_step(self) -> bool:
        begins = self.num_timesteps >= self.begin
        if self.kind == "full disk":
            _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
            limited = begins and self.num_timesteps < self.end
            resource.setrlimit(resource.RLIMIT_FSIZE, (700 if limited else hard, hard))
        elif begins and self.kind == "no log":
            Folder.descriptor = _no_log(Folder.descriptor)  # type: ignore[method-assign]
            os.write = os.ftruncate = _read_only
            self.kind = "nothing"
        elif begins and self.kind == "tee":
            reader, writer = os.pipe()
            os.close(reader)
            os.dup2(writer, 1)
            os.dup2(writer, 2)
            self.kind = "nothing"
        return True


def _read_only(*args: Any, **kwargs: Any) -> Any:
    raise OSError(errno.EROFS, os.strerror(errno.EROFS))


def _no_log(descriptor: Any) -> Any:
    return lambda folder, name, flags: (_read_only if name == "progress.jsonl" else descriptor)(folder, name, flags)


def train(
    case: dict[str, Any],
    steps: int,
    every: int,
    folder: str,
    kill: tuple[int, float] | None = None,
    trouble: tuple[str, int] | None = None,
) -> None:
    """
    Train, as a user's program does, and write down what came out.

    :param case: ``algorithm``, its arguments ``kwargs``, ``env``, and ``evaluate``
    :param steps: environment steps
    :param every: steps between two checkpoints
    :param folder: the run's
    :param kill: after the checkpoint of how many steps, and how many seconds later, the process is killed; or -1, and
        at which of the things that it does to the folder's files
    :param trouble: what else goes wrong, and the seed by which it is drawn when; the kill is an interrupt if it is
        "tee", as by Ctrl-C
    """
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    env = case.get("env", {})
    agent = model(case["algorithm"], folder, env, **case.get("kwargs", {}))
    callback = callbacks(folder, env, case.get("evaluate", False), case.get("diagnose", False))
    if trouble is not None:
        agent.verbose = 1
        callback = [*(callback or []), _Trouble(trouble[0], random.Random(trouble[1]))]
    if kill is not None and kill[0] < 0:
        n_done = kill_in_writing(folder, int(kill[1]))
    elif kill is not None:
        tee = trouble is not None and trouble[0] == "tee"
        _Kill(folder, *kill, signal.SIGINT if tee else signal.SIGKILL).start()
    agent.learn(steps, callback=callback, log_interval=1, checkpoint=folder, checkpoint_freq=every)
    Path(f"{folder}.json").write_text(json.dumps(outcome(agent, folder, callback)))
    if kill is not None and kill[0] < 0:
        Path(f"{folder}.count").write_text(str(n_done()))


# ---------------------------------------------------------------- what came out


def outcome(agent: Any, folder: str, callback: Any = None) -> dict[str, str]:
    """
    :param agent: a trained model
    :param folder: of its run
    :param callback: its callbacks
    :return: checksums of everything that a run is, but times
    """
    found: dict[str, str] = {}

    def note(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, item in value.items():
                # Seconds that an episode took, and a whole run: they are what may differ; and the generators of workers
                # and of observation spaces, from which nothing is drawn, are seeded by the system.
                system = ("generators", "observation_space", "_observation_space")
                if key not in ("t", "episode_times", "id", *system) and not str(key).startswith("time/"):
                    note(f"{name}/{key}", item)
        elif isinstance(value, (list, tuple, collections.deque)):
            found[f"{name}/length"] = str(len(value))
            for i, item in enumerate(value):
                # A dict is described by pairs of a key and a value.
                pair = isinstance(item, list) and len(item) == 2 and isinstance(item[0], dict) and "value" in item[0]
                if not (pair and item[0]["value"] == "t"):
                    note(f"{name}/{i}", item)
        elif isinstance(value, (np.ndarray, torch.Tensor)):
            array = np.asarray(value.detach().cpu()) if isinstance(value, torch.Tensor) else value
            found[name] = hashlib.sha256(array.tobytes()).hexdigest()[:16] + str(array.dtype)
        elif isinstance(value, np.random.Generator):
            note(name, value.bit_generator.state)
        elif isinstance(value, np.random.RandomState):
            note(name, value.get_state())
        elif isinstance(value, random.Random):
            note(name, value.getstate())
        else:
            found[name] = repr(value)

    note("parameters", agent.get_parameters())
    note("attributes", training_state.save_attributes(agent))
    note("generators", training_state.save_generators(agent.device))
    note("logger", training_state.save_logger(agent.logger))
    note("env", vec_envs.save(agent.env)[0])
    buffer = getattr(agent, "replay_buffer", None)
    if buffer is not None:
        # Where the compact buffers keep their next observations is not the same, what they are is.
        own = {k: v for k, v in vars(buffer).items() if k not in ("infos", "slot", "_ring", "_first", "_last", "aside")}
        note("buffer", {k: v for k, v in own.items() if isinstance(v, (np.ndarray, dict, int, float))})
        if isinstance(buffer, CompactReplay):
            rows = buffer.new_rows(buffer.size())
            if isinstance(buffer.observations, StackedFrames):
                # Nor is where the older frames of a stack are.
                newest_last = np.arange(buffer.pos - buffer.size(), buffer.pos) % buffer.buffer_size
                rows = {name: rows[name] for name in rows.keys() - {OLDER, OLDER_FRAMES}}
                note("buffer/stacks", buffer.observations[newest_last])
            note("buffer/rows", rows)
            note("buffer/changing", buffer.changing_state())
        if hasattr(buffer, "_ring"):
            note("buffer/_ring", buffer._ring[np.arange(buffer._first, buffer._last) % len(buffer._ring)])
    for each in callback or []:
        for path, part in walk(each, type(each).__name__):
            names = (
                "best_mean_reward", "evaluations_timesteps", "evaluations_results", "n_calls", "n_episodes",
                "no_improvement_evals", "last_best_mean_reward", "num_timesteps", "evaluations_length", "last_results",
            )  # fmt: skip
            note(path, {name: vars(part)[name] for name in names if name in vars(part)})
    for i, line in enumerate((Path(folder) / "progress.jsonl").read_text().splitlines()):
        note(f"log/{i}", json.loads(line))
    return found


# ---------------------------------------------------------------- processes


def start(target: Callable[..., None], *args: Any) -> Any:
    """
    A process of its own, quickly: one that has imported everything already is forked (``tests/conftest.py``).

    :param target: what it runs
    :param args: its arguments
    :return: the process
    """
    process = multiprocessing.get_context("forkserver").Process(target=target, args=args)
    process.start()
    return process


def run(*args: Any, target: Callable[..., None] = train, code: int = 0, seconds: float = 120) -> None:
    """Run a program and check how it ends."""
    process = start(target, *args)
    process.join(seconds)
    alive = process.is_alive()
    if alive:
        process.kill()
    assert not alive, f"{args} is not done after {seconds} s"
    assert process.exitcode == code, (args, process.exitcode)


def result(folder: Any) -> dict[str, str]:
    """What a program wrote down at its end."""
    return json.loads(Path(f"{folder}.json").read_text())
