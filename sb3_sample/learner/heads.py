"""Value heads: meaning of the critics' outputs, their target, and the loss."""

from collections.abc import Callable
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import nn

from sb3_sample.learner import losses
from sb3_sample.learner.batch import Batch
from sb3_sample.learner.target import td_target


class ValueHead(nn.Module):
    """
    Head of scalar critics, trained by the squared error; base class of other heads.

    A head is a module: its buffers move with the learner's device and are saved. ``n_outputs`` is the number of outputs
    per critic; ``n_quantiles`` the same if they are quantiles, else None. A head from outside of this package that does
    not branch on a tensor's value may declare ``compilable = True``.
    """

    compilable: ClassVar[bool] = True

    n_outputs: int = 1
    n_quantiles: int | None = None

    def values(self, outputs: torch.Tensor) -> torch.Tensor:
        """
        Convert outputs to values.

        :param outputs: of critics, (E, B, n_outputs)
        :return: input of the rules of pessimism and of the actors, (E, B, K): values, or quantiles of a value
        """
        return outputs

    def target(
        self,
        batch: Batch,
        next_q: torch.Tensor,
        value: Callable[[torch.Tensor], torch.Tensor],
        entropy_bonus: torch.Tensor,
    ) -> torch.Tensor:
        """
        Compute the target of the critics.

        :param batch: transitions
        :param next_q: outputs of the target critics for the next state and action, (E, B, n_outputs)
        :param value: value of the ensemble by the rule of pessimism, (E, B, K) to (B, K)
        :param entropy_bonus: ``-alpha * log pi`` of that action, (B, 1)
        :return: the target of every critic in :meth:`loss`, (B, K) here
        """
        return td_target(batch, value(self.values(next_q)), entropy_bonus)

    def mean_target(self, target: torch.Tensor) -> torch.Tensor:
        """
        Compute the value that a target stands for.

        :param target: from :meth:`target`
        :return: (B, 1)
        """
        return target.mean(dim=1, keepdim=True)

    def loss(self, q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """
        Compute the critics' loss.

        :param q: outputs of the critics, (E, B, n_outputs)
        :param target: from :meth:`target`, without gradient
        :return: scalar
        """
        return losses.squared_error(q, target)


class HalfSquaredHead(ValueHead):
    """Head of scalar critics, trained by half the squared error, as in Stable-Baselines3 and CrossQ."""

    def loss(self, q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return super().loss(q, target) / 2


class QuantileHead(ValueHead):
    """
    Head of critics with quantiles of the return, trained by the quantile Huber loss (BRO, algorithm 2, line 8).

    :param n_quantiles: K, at least 1
    """

    def __init__(self, n_quantiles: int):
        super().__init__()
        self.n_outputs = self.n_quantiles = n_quantiles

    def loss(self, q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return losses.quantile_huber(q, target)


class HuberHead(ValueHead):
    """
    Head of scalar critics, trained by the Huber loss with threshold 1, its mean over batch and critics (DR.Q; LAP,
    Fujimoto et al. 2020).
    """

    def loss(self, q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return F.smooth_l1_loss(q, target.expand_as(q))
