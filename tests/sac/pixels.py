"""Tiny environments with images, and models that learn from them."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from sb3_sample import DrQ, DrQv2

#: An encoder of 8 by 8 pixels, and little behind it.
TINY = {
    "net_arch": [8],
    "projection": 5,
    "features_extractor_kwargs": {"filters": (4, 4), "strides": (2, 1)},
}
TINY_DRQ = {
    "learning_starts": 6,
    "batch_size": 4,
    "buffer_size": 100,
    "policy_kwargs": TINY,
    "augmentation_kwargs": {"pad": 1},
    "seed": 0,
}


class Frames(gym.Env[np.ndarray, np.ndarray]):
    """
    A square that is moved to the right; the reward is its place. Observations are stacks of the latest frames.

    :param frame_stack: frames of an observation
    :param size: height and width
    :param channels: of a frame
    :param length: steps of an episode, by truncation
    """

    def __init__(self, frame_stack: int = 3, size: int = 8, channels: int = 1, length: int = 7):
        self.stacked_frames, self.size, self.channels, self.length = frame_stack, size, channels, length
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Box(0, 255, (frame_stack * channels, size, size), np.uint8)

    def _frame(self) -> np.ndarray:
        frame = np.full((self.channels, self.size, self.size), 10, np.uint8)
        frame[:, 2:5, int(self.x) : int(self.x) + 3] = 200
        frame[:, 0, 0] = self.t
        return frame

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.x, self.t = float(self.np_random.integers(self.size - 3)), 0
        self.stack = np.concatenate([self._frame()] * self.stacked_frames)
        return self.stack.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.x, self.t = float(np.clip(self.x + action[0], 0, self.size - 3)), self.t + 1
        self.stack = np.concatenate([self.stack[self.channels :], self._frame()])
        return self.stack.copy(), self.x, False, self.t >= self.length, {}


class Pictures(VecEnvWrapper):
    """
    Environments whose observations, flat numbers, are drawn as stacks of three small frames.

    :param venv: the environments
    """

    def __init__(self, venv: VecEnv):
        super().__init__(venv, observation_space=spaces.Box(0, 255, (3, 8, 8), np.uint8))
        self._stacks = np.zeros((venv.num_envs, 3, 8, 8), np.uint8)

    def _drawn(self, observation: np.ndarray) -> np.ndarray:
        levels = 127 + 120 * np.tanh(np.resize(observation, 8))
        return np.rint(np.outer(levels, np.linspace(0.5, 1, 8))).astype(np.uint8)

    def reset(self) -> Any:
        observations = self.venv.reset()
        for i, observation in enumerate(observations):
            self._stacks[i] = self._drawn(observation)
        return self._stacks.copy()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        for i, done in enumerate(dones):
            last = infos[i].get("terminal_observation", observations[i])
            self._stacks[i] = np.concatenate([self._stacks[i, 1:], self._drawn(last)[None]])
            if done:
                infos[i]["terminal_observation"] = self._stacks[i].copy()
                self._stacks[i] = self._drawn(observations[i])
        return self._stacks.copy(), rewards, dones, infos


def frames(n_envs: int = 1, **kwargs: Any) -> VecEnv:
    return DummyVecEnv([lambda: Frames(**kwargs)] * n_envs)


def drq(env: Any = None, **kwargs: Any) -> DrQ:
    return DrQ("CnnPolicy", frames() if env is None else env, **{**TINY_DRQ, **kwargs})


def drqv2(env: Any = None, **kwargs: Any) -> DrQv2:
    return DrQv2("CnnPolicy", frames() if env is None else env, **{**TINY_DRQ, "replay_ratio": 1, **kwargs})
