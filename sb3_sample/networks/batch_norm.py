"""Batch norm of one network or of a stack of independent ones, and batch renormalisation."""

from collections.abc import Iterator

import torch
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm

from sb3_sample.kinds import ABOVE_0, Kind, check_value, is_number

#: Kind of an argument that is the share of the new batch in a running mean.
MOMENTUM = Kind("lie in (0, 1]", lambda value: is_number(value) and 0 < value <= 1)


class BatchNorm(nn.Module):
    """
    Batch norm over the rows: ``(x - mean) / sqrt(var + eps) * weight + bias``, in training mode with the moments of the
    batch, through which the gradient goes, in evaluation mode with running moments. A training pass updates these:
    ``running += momentum * (of the batch - running)``. Each copy of a stack has its own moments.

    :param n_features: number of features
    :param n_copies: E for E independent ones, None for one
    :param eps: added to the variance
    :param momentum: share of the batch in the running moments, in (0, 1]
    :param unbiased: whether the batch is normalised by the unbiased variance (divided by n - 1 for n rows) and not by
        the biased one
    :param running_unbiased: whether the unbiased variance enters the running one; None: as ``unbiased``
    """

    running_mean: torch.Tensor
    running_var: torch.Tensor

    def __init__(
        self,
        n_features: int,
        n_copies: int | None = None,
        eps: float = 1e-3,
        momentum: float = 0.01,
        unbiased: bool = False,
        running_unbiased: bool | None = None,
    ):
        super().__init__()
        check_value("eps", eps, ABOVE_0)
        check_value("momentum", momentum, MOMENTUM)
        self.n_features, self.n_copies, self.eps, self.momentum = n_features, n_copies, eps, momentum
        self.unbiased = unbiased
        self.running_unbiased = unbiased if running_unbiased is None else running_unbiased
        shape = (n_features,) if n_copies is None else (n_copies, 1, n_features)
        self.weight: torch.Tensor = nn.Parameter(torch.ones(shape))
        self.bias: torch.Tensor = nn.Parameter(torch.zeros(shape))
        self.register_buffer("running_mean", torch.zeros(shape))
        self.register_buffer("running_var", torch.ones(shape))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: input, (B, features), or (E, B, features) if there are copies; (B, features) is shared by them
        :return: output, (B, features), or (E, B, features) if there are copies
        :raises ValueError: in training mode, if there is one row
        """
        if not self.training:
            scale = self.weight * (self.running_var + self.eps).rsqrt()
            return torch.addcmul(self.bias, x - self.running_mean, scale)
        n = x.shape[-2]
        if n < 2:
            raise ValueError(
                "batch norm needs at least 2 rows in training mode, whose mean and variance it takes, not "
                f"{n}: pass larger batches"
            )
        # Two passes over the rows: torch.var_mean takes nine times as long on a CPU.
        has_copies = self.n_copies is not None
        mean = x.mean(dim=-2, keepdim=has_copies)
        centred = x - mean
        var = centred.square().sum(dim=-2, keepdim=has_copies) / (n - int(self.unbiased))
        scale, offset = self._scale_and_offset(mean, var)
        self._follow(mean, var, n)
        return torch.addcmul(offset, centred, scale)

    def _scale_and_offset(self, mean: torch.Tensor, var: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Factor and offset of a batch from which its mean has been subtracted, given its moments."""
        return self.weight * (var + self.eps).rsqrt(), self.bias

    @torch.no_grad()
    def _follow(self, mean: torch.Tensor, var: torch.Tensor, n: int) -> None:
        if self.running_unbiased and not self.unbiased:
            var = var * (n / (n - 1))
        elif self.unbiased and not self.running_unbiased:
            var = var * ((n - 1) / n)
        # Not in place: torch.vmap, which maps the step over many learners, has a rule for this form.
        for running, now in ((self.running_mean, mean), (self.running_var, var)):
            running.copy_(running.lerp(now.detach().to(running.dtype), self.momentum))

    def extra_repr(self) -> str:
        return f"n_features={self.n_features}, n_copies={self.n_copies}, eps={self.eps}, momentum={self.momentum}"


class BatchRenorm(BatchNorm):
    """
    Batch renormalisation (Ioffe 2017) as in CrossQ: batch norm in the first ``warm_up`` training passes; after them the
    batch is normalised so that the result is that of the running moments, as far as these lie within a factor of 3 of
    the batch's standard deviation and 5 standard deviations of its mean. The gradient treats the correction as
    constant.

    :param n_features: number of features
    :param n_copies: E for E independent ones, None for one
    :param eps: added to the variance
    :param momentum: share of the batch in the running moments, in (0, 1]
    :param unbiased: whether variances are unbiased
    :param warm_up: number of initial training passes with batch norm
    """

    #: Bounds of the ratio of standard deviations (and its inverse), and of the distance of means.
    MAX_RATIO, MAX_DISTANCE = 3.0, 5.0
    n_passes: torch.Tensor

    def __init__(
        self,
        n_features: int,
        n_copies: int | None = None,
        eps: float = 1e-3,
        momentum: float = 0.01,
        unbiased: bool = False,
        warm_up: int = 100_000,
    ):
        super().__init__(n_features, n_copies, eps, momentum, unbiased)
        self.warm_up = warm_up
        #: Training passes so far.
        self.register_buffer("n_passes", torch.zeros((), dtype=torch.long))

    def _scale_and_offset(self, mean: torch.Tensor, var: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        with torch.no_grad():
            running_std, is_warm = (self.running_var + self.eps).sqrt(), self.n_passes > self.warm_up
            ratio = ((var + self.eps).sqrt() / running_std).clamp(1 / self.MAX_RATIO, self.MAX_RATIO)
            ratio = torch.where(is_warm, ratio, 1.0)
            distance = ((mean - self.running_mean) / running_std).clamp(-self.MAX_DISTANCE, self.MAX_DISTANCE)
            distance = torch.where(is_warm, distance, 0.0)
            self.n_passes.add_(1)
        # Where a feature is the same in all rows, as for a silent neuron, the root would have an infinite gradient.
        is_flat = var == 0
        std = torch.where(is_flat, 0.0, torch.where(is_flat, 1.0, var).sqrt())
        scale = self.weight * (var / ratio.square() + self.eps).rsqrt()
        return scale, torch.addcmul(self.bias, distance * std / ratio, scale)


def running_moments(module: nn.Module) -> Iterator[tuple[str, torch.Tensor]]:
    """
    Find the buffers of batch norms, torch's own among them: running moments and counts of passes.

    :param module: a network, or any module that contains batch norms
    :return: the buffers, with the names that they have in the module's state
    """
    for prefix, layer in module.named_modules():
        if isinstance(layer, (BatchNorm, _BatchNorm)):
            yield from layer.named_buffers(prefix, recurse=False)
