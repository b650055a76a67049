"""Sample-efficient reinforcement learning for users of Stable-Baselines3."""

from sb3_sample.envs import make_env
from sb3_sample.sac import BRO, DAC, GPLSAC, OAC, OPLSAC, SAC, SRSAC, TOPSAC, VPLSAC, BROFast
from sb3_sample.version import __version__

__all__ = [
    "BRO",
    "DAC",
    "GPLSAC",
    "OAC",
    "OPLSAC",
    "SAC",
    "SRSAC",
    "TOPSAC",
    "VPLSAC",
    "BROFast",
    "__version__",
    "make_env",
]
