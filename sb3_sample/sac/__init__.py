"""The off-policy family."""

from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.bro import BRO, BROFast

__all__ = ["BRO", "SAC", "BROFast"]
