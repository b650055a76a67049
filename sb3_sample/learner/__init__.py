"""The update of the off-policy family: it knows no environment, no file, no replay buffer and no Stable-Baselines3."""

from sb3_sample.learner.learner import Learner

__all__ = ["Learner"]
