"""Stand-in for the environment of a training that has none, or that does not use its own."""

from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv


class _Nothing(gym.Env[Any, Any]):
    """
    Environment that refuses to be reset.

    :param observation_space: observation space
    :param action_space: action space
    """

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space):
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        raise RuntimeError("there is no environment in a training on a data set: pass env=, or call set_env")


class NoEnvironment(DummyVecEnv):
    """
    Vectorised environment of one that cannot be reset; a ``DummyVecEnv``, since callbacks compare the type of their own
    environment with the training's.

    :param observation_space: observation space
    :param action_space: action space
    """

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space):
        super().__init__([lambda: _Nothing(observation_space, action_space)])
