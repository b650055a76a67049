"""Batch transforms: what is done to transitions between the replay and the gradient step."""

import torch

from sb3_sample.learner.batch import Batch
from sb3_sample.learner.parts import Learning, Part


class BatchTransform(Part):
    """
    Identity, and the base class of transforms. One hears of the environment as every part does, has its statistics in
    buffers, and is applied to the step's batch and to the further transitions of a rule of pessimism, before the step.

    :param learner: the learner, whose networks exist already
    """

    def __init__(self, learner: Learning):
        super().__init__()

    def draw(self, batch: Batch) -> torch.Tensor | None:
        """
        :param batch: transitions
        :return: the random numbers that :meth:`transform` needs for them; None if there are none
        """
        return None

    def transform(self, batch: Batch, noise: torch.Tensor | None) -> Batch:
        """
        :param batch: transitions
        :param noise: from :meth:`draw`
        :return: the transitions that are learned from
        """
        return batch
