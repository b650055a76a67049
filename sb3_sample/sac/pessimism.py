"""
Pessimism: how an ensemble of Q becomes one value, and how the weight of its spread moves.

Everywhere in this package pessimism beta >= 0 is subtracted: ``Q_mean - beta * Q_std``, with the population
standard deviation over the critics. With two critics the spread is ``|Q1 - Q2| / 2``, so 1 is clipped double
Q-learning (the minimum) and 0 the mean.
"""

from typing import TYPE_CHECKING

import torch

from sb3_sample.sac.parts import Part

if TYPE_CHECKING:
    from sb3_sample.sac.algorithm import SAC
    from sb3_sample.sac.batch import Batch


def epistemic_std(q: torch.Tensor) -> torch.Tensor:
    """
    Disagreement of the critics: population standard deviation over E, quantile by quantile.

    :param q: (E, B, K)
    :return: (B, K)
    """
    if q.shape[0] == 2:
        # Equal to the formula below, and differentiable where the critics agree.
        return (q[0] - q[1]).abs() / 2
    # The floor keeps the gradient of the root finite where all critics agree.
    return q.var(dim=0, unbiased=False).clamp_min(1e-12).sqrt()


class Pessimism(Part):
    """Base class of the rules. A rule has a weight ``beta`` and may move it once a gradient step."""

    def beta(self) -> torch.Tensor | float:
        """
        :return: the weight in force, at least 0, a scalar
        """
        raise NotImplementedError

    def value(self, q: torch.Tensor) -> torch.Tensor:
        """
        The one value of an ensemble, ``Q_mean - beta * Q_std``, quantile by quantile.

        :param q: (E, B, K)
        :return: (B, K)
        """
        return q.mean(dim=0) - self.beta() * epistemic_std(q)

    def update(self, agent: "SAC", batch: "Batch") -> dict[str, torch.Tensor]:
        """
        Move the weight; called last in every gradient step.

        :param agent: the algorithm, its networks already updated
        :param batch: the step's batch
        :return: what to log, by name, scalars
        """
        return {}


class FixedPessimism(Pessimism):
    """
    A constant weight: 1 is clipped double Q-learning, 0 the mean (BRO).

    :param beta: the weight
    :raises ValueError: if it is negative
    """

    def __init__(self, beta: float):
        super().__init__()
        if not beta >= 0:
            raise ValueError(f"pessimism must be at least 0 (0 is the mean, 1 the minimum of two), not {beta}")
        self._beta = float(beta)

    def beta(self) -> float:
        return self._beta

    def value(self, q: torch.Tensor) -> torch.Tensor:
        if self._beta == 0:
            return q.mean(dim=0)
        if self._beta == 1 and q.shape[0] == 2:
            return torch.minimum(q[0], q[1])
        return super().value(q)
