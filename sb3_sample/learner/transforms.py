"""Batch transforms: changes to transitions between the replay and the gradient step."""

from abc import abstractmethod

import torch

from sb3_sample.learner.batch import Batch
from sb3_sample.learner.parts import Learning, Part


class BatchTransform(Part):
    """
    Base class of transforms. Like every part, a transform receives the environment's steps; it holds its statistics in
    buffers, and is applied before the gradient step to the step's batch and to the further transitions of a rule of
    pessimism.

    :param learner: the learner, whose networks exist already
    """

    #: Copies of each transition that it requires in the TD target, which is the mean over them.
    target_copies: int = 1
    #: Copies that it requires in the critics' loss, which is the sum over them. In the critics' step the copies lie one
    #: after the other (``batch.widened``); all other steps take the first.
    online_copies: int = 1

    def __init__(self, learner: Learning):
        super().__init__()

    def draw(self, batch: Batch) -> torch.Tensor | None:
        """
        Draw the random numbers of a transform.

        :param batch: transitions
        :return: the random numbers that :meth:`transform` needs for them; None if there are none
        """
        return None

    @abstractmethod
    def transform(self, batch: Batch, noise: torch.Tensor | None) -> Batch:
        """
        Transform a batch.

        :param batch: transitions
        :param noise: from :meth:`draw`
        :return: the transitions that are learned from
        """
        raise NotImplementedError
