"""A small world of stacked frames, and small agents for it."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_sample import SRSPR

SIZE = 12
TINY: dict[str, Any] = {"channels": (2, 3, 4), "width": 8, "n_blocks": 1}


class Frames(gym.Env[np.ndarray, int]):
    """
    Stacks of four frames of noise. The action that counts, 1 or 2, is the half of the newest frame that is bright.

    :param length: steps of an episode
    :param terminates: whether it ends by termination and not by truncation
    """

    def __init__(self, length: int = 9, terminates: bool = True):
        self.observation_space = spaces.Box(0, 255, (4, SIZE, SIZE), np.uint8)
        self.action_space = spaces.Discrete(3)
        self.length, self.terminates = length, terminates
        self.stack = np.zeros((4, SIZE, SIZE), np.uint8)
        self.n, self.right = 0, 0

    def _see(self) -> np.ndarray:
        frame = self.np_random.integers(0, 80, (SIZE, SIZE)).astype(np.uint8)
        self.right = int(self.np_random.integers(2))
        frame[:, self.right * SIZE // 2 : (self.right + 1) * SIZE // 2] += 150
        self.stack = np.concatenate((self.stack[1:], frame[None]))
        return self.stack.copy()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.n, self.stack = 0, np.zeros_like(self.stack)
        return self._see(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reward = float(action == 1 + self.right)
        self.n += 1
        ends = self.n == self.length
        return self._see(), reward, ends and self.terminates, ends and not self.terminates, {}


def tiny(env: Any = None, **kwargs: Any) -> SRSPR:
    kwargs = {
        "learning_starts": 30,
        "buffer_size": 500,
        "batch_size": 4,
        "n_steps": 3,
        "n_predictions": 2,
        "exploration_steps": 20,
        "reset_interval": None,
        "policy_kwargs": TINY,
        "seed": 0,
        "device": "cpu",
        **kwargs,
    }
    return SRSPR("CnnPolicy", Frames() if env is None else env, **kwargs)


def venv(n: int) -> DummyVecEnv:
    return DummyVecEnv([Frames for _ in range(n)])
