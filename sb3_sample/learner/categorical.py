"""Categorical value heads: critics as classifiers over a fixed support of values."""

import math
from collections.abc import Callable

import torch

from sb3_sample.kinds import ABOVE_0, FINITE, TRUE_OR_FALSE, check_value, integer
from sb3_sample.learner.batch import Batch
from sb3_sample.learner.heads import HalfSquaredHead, ValueHead
from sb3_sample.learner.projection import project
from sb3_sample.learner.target import td_target


class CategoricalHead(ValueHead):
    """
    Head of critics that classify the return: K logits over atoms spaced evenly in [v_min, v_max], trained by the
    cross-entropy with the projected target (C51, Bellemare et al. 2017). The value is the expectation.

    The E target critics become one distribution whose expectation is the value by the rule of pessimism: per sample, a
    mixture of the mean of their distributions and the distribution of the critic with the smallest value. Pessimism 0
    thus takes the mean distribution (BRC), and the minimum of two critics (pessimism 1) the distribution of the smaller
    one (SimbaV2, XQC, FlashSAC). If the value is below the smallest critic's, the atoms of that critic are shifted by
    the difference.

    Each atom z moves to ``r + discount * (1 - done) * (z + entropy bonus)``, clipped to the support; its probability is
    shared linearly between the two neighbouring atoms.

    :param n_atoms: K, at least 2
    :param v_min: the first atom
    :param v_max: the last atom
    :param average_critics: whether the loss is the mean over the critics (FlashSAC) and not their sum
    :raises ValueError: if an argument is out of range, or the support is empty
    """

    support: torch.Tensor

    def __init__(
        self, n_atoms: int = 101, v_min: float = -5.0, v_max: float = 5.0, average_critics: bool = False
    ) -> None:
        super().__init__()
        check_value("n_atoms", n_atoms, integer(2))
        check_value("v_min", v_min, FINITE)
        check_value("v_max", v_max, FINITE)
        check_value("average_critics", average_critics, TRUE_OR_FALSE)
        if not v_min < v_max:
            raise ValueError(f"v_min must lie below v_max={v_max}, not be {v_min}")
        self.n_outputs, self.v_min, self.v_max = n_atoms, float(v_min), float(v_max)
        self.average_critics = average_critics
        #: Distance of two neighbouring atoms.
        self.spacing = (self.v_max - self.v_min) / (n_atoms - 1)
        self.register_buffer("support", torch.linspace(v_min, v_max, n_atoms), persistent=False)

    def values(self, outputs: torch.Tensor) -> torch.Tensor:
        """
        Compute the expectations.

        :param outputs: logits of critics, (E, B, K)
        :return: (E, B, 1)
        """
        return self._expectation(outputs.softmax(dim=-1))

    def _expectation(self, probabilities: torch.Tensor) -> torch.Tensor:
        return (probabilities * self.support).sum(dim=-1, keepdim=True)

    def mean_target(self, target: torch.Tensor) -> torch.Tensor:
        return self._expectation(target)

    def target(
        self,
        batch: Batch,
        next_q: torch.Tensor,
        value: Callable[[torch.Tensor], torch.Tensor],
        entropy_bonus: torch.Tensor,
    ) -> torch.Tensor:
        """
        Compute the target distribution.

        :param batch: transitions
        :param next_q: logits of the target critics for the next state and action, (E, B, K)
        :param value: value of the ensemble by the rule of pessimism, (E, B, 1) to (B, 1)
        :param entropy_bonus: ``-alpha * log pi`` of that action, (B, 1)
        :return: probabilities of the atoms, (B, K)
        """
        probabilities, shift = self._ensemble(next_q, value)
        return self.project(probabilities, td_target(batch, self.support + shift, entropy_bonus))

    def _ensemble(
        self, next_q: torch.Tensor, value: Callable[[torch.Tensor], torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Distribution of an ensemble, (B, K), and the shift of its atoms, (B, 1)."""
        every = next_q.softmax(dim=-1)
        if len(every) == 1:
            return every[0], torch.zeros_like(every[0, :, :1])
        q = self._expectation(every)
        mean, wanted = q.mean(dim=0), value(q)
        smallest, index = q.min(dim=0)
        of_smallest = every.gather(0, index.expand(1, -1, every.shape[-1])).squeeze(0)
        weight = ((mean - wanted) / (mean - smallest)).nan_to_num(0.0).clamp(0, 1)
        shift = (wanted - smallest).clamp(max=0)
        return torch.lerp(every.mean(dim=0), of_smallest, weight), shift

    def project(self, probabilities: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
        """
        Move probabilities back to the atoms.

        :param probabilities: (B, K)
        :param positions: positions of these probabilities, (B, K); clipped to the support
        :return: probabilities of the atoms, (B, K)
        """
        place = (self._clipped(positions) - self.v_min) / self.spacing
        return project(probabilities, place.clamp(0, self.n_outputs - 1))

    def _clipped(self, values: torch.Tensor) -> torch.Tensor:
        # One end after the other: torch refuses a number beside a tensor, which an end that differs between the
        # learners of a group is.
        return values.clamp(min=self.v_min).clamp(max=self.v_max)

    def loss(self, q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """
        Compute the cross-entropy: mean over the batch, sum or mean over the critics.

        :param q: logits of the critics, (E, B, K)
        :param target: probabilities of the atoms, (B, K), without gradient
        :return: scalar
        """
        loss = -(target * q.log_softmax(dim=-1)).sum() / target.shape[0]
        return loss / q.shape[0] if self.average_critics else loss


class HLGaussHead(CategoricalHead):
    """
    Categorical head with the target of HL-Gauss (Imani and White 2018; Farebrother et al. 2024): the probabilities of a
    Gaussian around the TD target, a single number, in the bins around the atoms, normalised over all bins.

    :param n_atoms: K, at least 2
    :param v_min: centre of the first bin
    :param v_max: centre of the last bin
    :param sigma: standard deviation of the Gaussian in widths of a bin; 0.75 as in Farebrother et al.
    :param average_critics: whether the loss is the mean over the critics and not their sum
    :raises ValueError: if an argument is out of range, or the support is empty
    """

    def __init__(
        self,
        n_atoms: int = 101,
        v_min: float = -5.0,
        v_max: float = 5.0,
        sigma: float = 0.75,
        average_critics: bool = False,
    ) -> None:
        super().__init__(n_atoms, v_min, v_max, average_critics)
        check_value("sigma", sigma, ABOVE_0)
        self.sigma = float(sigma)

    def target(
        self,
        batch: Batch,
        next_q: torch.Tensor,
        value: Callable[[torch.Tensor], torch.Tensor],
        entropy_bonus: torch.Tensor,
    ) -> torch.Tensor:
        y = self._clipped(td_target(batch, value(self.values(next_q)), entropy_bonus))
        edges = torch.cat((self.support - self.spacing / 2, self.support[-1:] + self.spacing / 2))
        below = torch.special.erf((edges - y) / (math.sqrt(2) * self.sigma * self.spacing))
        mass = below.diff(dim=-1)
        return mass / (below[:, -1:] - below[:, :1])


#: Heads by the name that ``value_head`` takes.
VALUE_HEADS: dict[str, type[ValueHead]] = {
    "categorical": CategoricalHead,
    "half_squared": HalfSquaredHead,
    "hl_gauss": HLGaussHead,
}
