"""Update of the off-policy family, independent of environments, files, replay buffers and Stable-Baselines3."""

from sb3_sample.learner.learner import Learner

__all__ = ["Learner"]
