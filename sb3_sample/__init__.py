"""Sample-efficient reinforcement learning for users of Stable-Baselines3."""

from sb3_sample.envs import make_env
from sb3_sample.sac import BRO, SAC, BROFast
from sb3_sample.version import __version__

__all__ = ["BRO", "SAC", "BROFast", "__version__", "make_env"]
