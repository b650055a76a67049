"""Running mean and variance of a network's inputs."""

from collections.abc import Sequence

import torch
from torch import nn


class RunningMoments(nn.Module):
    """
    Running mean and population variance, updated from batches by the parallel formula (Chan et al. 1979).

    :param shape: of one value
    :param count: weight of the start values, in samples
    :param dtype: precision of the statistics
    """

    mean: torch.Tensor
    var: torch.Tensor
    count: torch.Tensor

    def __init__(self, shape: Sequence[int] = (), count: float = 1e-4, dtype: torch.dtype = torch.float64):
        super().__init__()
        self.register_buffer("mean", torch.zeros(tuple(shape), dtype=dtype))
        self.register_buffer("var", torch.ones(tuple(shape), dtype=dtype))
        self.register_buffer("count", torch.tensor(count, dtype=dtype))

    @torch.no_grad()
    def update(self, values: torch.Tensor, more_count: float = 0.0) -> None:
        """
        Add samples.

        :param values: n samples, (n, ...)
        :param more_count: added to the count where it weights the old variance
        """
        values = values.to(self.mean.dtype)
        n, count = len(values), self.count
        total = count + n
        mean, var = values.mean(dim=0), values.var(dim=0, unbiased=False)
        delta = mean - self.mean
        self.var.copy_((self.var * (count + more_count) + var * n + delta.square() * (count * n / total)) / total)
        self.mean.add_(delta * (n / total))
        self.count.copy_(total)


class RunningNorm(RunningMoments):
    """
    Observation minus its running mean, divided by the root of its running variance, not clipped (SimbaV2's published
    code; statistics in float64, whose start values, mean 0 and variance 1, count as 1e-4 samples).

    :param shape: of an observation
    :param eps: added to the variance
    """

    def __init__(self, shape: Sequence[int], eps: float = 1e-8):
        super().__init__(shape)
        self.eps = eps

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: observations, (B, ...)
        :return: the same normalised, (B, ...), rounded once to the precision of the input
        """
        return ((x - self.mean) / (self.var + self.eps).sqrt()).to(x.dtype)
