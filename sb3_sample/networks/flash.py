"""FlashSAC's residual network with batch norm, all of whose layers keep their norms."""

import torch
from torch import nn

from sb3_sample.networks.batch_norm import BatchNorm
from sb3_sample.networks.ensemble import Dense
from sb3_sample.networks.initialization import linear
from sb3_sample.networks.unit_norm import UnitNorm
from sb3_sample.networks.unit_norm_blocks import UnitNormBlocks


class UnitBatchNorm(UnitNorm, BatchNorm):
    """Batch norm whose scales and shifts together have root mean square 1, counted as one number per feature."""

    @torch.no_grad()
    def project(self) -> None:
        """Bring scale and shift, together, back to the length of a vector of ones, one per feature, in place."""
        square = (self.weight.square() + self.bias.square()).sum(dim=-1, keepdim=True)
        factor = (self.n_features / (square + 1e-8)).sqrt()
        self.weight.mul_(factor)
        self.bias.mul_(factor)


class UnitRMSNorm(UnitNorm):
    """
    Division by the root mean square of the features, and a learned scale of root mean square 1.

    :param n_features: width of the normalised axis
    :param n_copies: E for E independent ones, None for one
    :param eps: added to the mean square
    """

    def __init__(self, n_features: int, n_copies: int | None, eps: float = 1e-6):
        super().__init__()
        self.n_features, self.eps = n_features, eps
        self.weight = nn.Parameter(torch.ones((n_features,) if n_copies is None else (n_copies, 1, n_features)))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, features), or (E, B, features)
        :return: the same shape
        """
        return x * (x.square().mean(dim=-1, keepdim=True) + self.eps).rsqrt() * self.weight

    @torch.no_grad()
    def project(self) -> None:
        """Bring the scale back to the length of a vector of ones, in place."""
        square = self.weight.square().sum(dim=-1, keepdim=True)
        self.weight.mul_((self.n_features / (square + 1e-8)).sqrt())


def _norm(width: int, n_copies: int | None) -> UnitBatchNorm:
    # Normalises by the biased variance, while the running variance is unbiased, as in torch's own batch norm.
    return UnitBatchNorm(width, n_copies, eps=1e-5, momentum=0.01, running_unbiased=True)


def _dense(in_features: int, out_features: int, n_copies: int | None, bias: bool = False) -> Dense:
    return linear(in_features, out_features, n_copies, bias=bias, gain=1.0, unit_norm=True)


class FlashBlock(nn.Module):
    """
    ``x + (Dense, BatchNorm, ReLU, Dense, BatchNorm, ReLU)(x)``.

    :param width: width of input and output
    :param expansion: hidden neurons per input
    :param n_copies: E for E independent blocks, None for one
    """

    def __init__(self, width: int, expansion: int, n_copies: int | None):
        super().__init__()
        self.dense1 = _dense(width, expansion * width, n_copies)
        self.norm1 = _norm(expansion * width, n_copies)
        self.activation = nn.ReLU()
        self.dense2 = _dense(expansion * width, width, n_copies)
        self.norm2 = _norm(width, n_copies)
        self.activation2 = nn.ReLU()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        h = self.activation(self.norm1(self.dense1(x)))
        return x + self.activation2(self.norm2(self.dense2(h)))


class FlashNet(UnitNormBlocks):
    """
    FlashSAC's trunk (Holiday Robot 2026): batch norm of the input, a dense layer, residual blocks with inverted
    bottlenecks and batch norm, and an RMS norm. No biases but the head's. The units of all dense layers, the head
    included, have input weights of length 1, and scale and shift of each norm have a fixed length; :meth:`project`
    restores both after each step of the optimizer. Critics have targets, in training mode; actors learn with current
    and next rows stacked, as critics do.

    :param in_features: width of the input
    :param width: width of the stream
    :param n_blocks: number of blocks, at least 0
    :param expansion: hidden neurons of a block per width, at least 1
    :param n_copies: E for E independent trunks, None for one
    :raises ValueError: if an argument is out of range
    """

    stacks_rows = "target"
    stacks_actor_rows = True

    def __init__(
        self,
        in_features: int,
        width: int = 256,
        n_blocks: int = 2,
        expansion: int = 4,
        n_copies: int | None = None,
    ):
        super().__init__()
        if width < 1 or n_blocks < 0 or expansion < 1:
            raise ValueError(
                f"FlashNet needs width >= 1, n_blocks >= 0 and expansion >= 1, not width={width}, n_blocks={n_blocks}, "
                f"expansion={expansion}"
            )
        self.out_features = width
        self.input_norm = _norm(in_features, n_copies)
        self.dense = _dense(in_features, width, n_copies)
        self.blocks = nn.ModuleList(FlashBlock(width, expansion, n_copies) for _ in range(n_blocks))
        self.norm = UnitRMSNorm(width, n_copies)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, width), or (E, B, width) if there are copies
        """
        h = self.dense(self.input_norm(x))
        for block in self.blocks:
            h = block(h)
        return self.norm(h)

    def make_head(self, n_outputs: int, n_copies: int | None = None, gain: float | None = None) -> nn.Module:
        return _dense(self.out_features, n_outputs, n_copies, bias=True)
