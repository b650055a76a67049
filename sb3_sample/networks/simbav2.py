"""SimbaV2's hyperspherical network (Lee et al. 2025)."""

import math

import torch
import torch.nn.functional as F
from torch import nn

from sb3_sample.networks.ensemble import Dense
from sb3_sample.networks.initialization import linear
from sb3_sample.networks.unit_norm_blocks import UnitNormBlocks


def on_sphere(x: torch.Tensor) -> torch.Tensor:
    """
    Divide by the length, at least 1e-8.

    :param x: (..., features)
    :return: the same, of length 1
    """
    return F.normalize(x, dim=-1, eps=1e-8)


class Scaler(nn.Module):
    """
    Learned factor of each feature that starts at ``init`` and is stored as a multiple of it: the parameter starts at
    ``scale``, and ``parameter * init / scale`` multiplies, so that ``init / scale`` is a factor on its learning rate.

    :param n_features: number of features
    :param init: factor at the start
    :param scale: parameter at the start
    :param n_copies: E for E independent ones, None for one
    """

    def __init__(self, n_features: int, init: float, scale: float, n_copies: int | None):
        super().__init__()
        self.factor = init / scale
        shape = (n_features,) if n_copies is None else (n_copies, 1, n_features)
        self.scaler = nn.Parameter(torch.full(shape, scale))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x * (self.scaler * self.factor)


def _dense(in_features: int, out_features: int, n_copies: int | None, bias: bool = False) -> Dense:
    return linear(in_features, out_features, n_copies, bias=bias, gain=1.0, unit_norm=True)


class HyperBlock(nn.Module):
    """
    Inverted bottleneck of ``x``, projected onto the sphere as ``h``, and the interpolation ``x + alpha * (h - x)``,
    projected onto the sphere.

    :param width: width of input and output
    :param expansion: hidden neurons per input
    :param n_blocks: number of blocks of the network, on which alpha's start depends
    :param n_copies: E for E independent blocks, None for one
    """

    def __init__(self, width: int, expansion: int, n_blocks: int, n_copies: int | None):
        super().__init__()
        scale = math.sqrt(2 / width / expansion)
        self.dense1 = _dense(width, expansion * width, n_copies)
        self.scaler = Scaler(expansion * width, scale, scale, n_copies)
        self.activation = nn.ReLU()
        self.dense2 = _dense(expansion * width, width, n_copies)
        self.alpha = Scaler(width, 1 / (n_blocks + 1), 1 / math.sqrt(width), n_copies)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        # The small constant gives a gradient to a unit that is off on the whole batch, as in the published code.
        h = on_sphere(self.dense2(self.activation(self.scaler(self.dense1(x))) + 1e-8))
        return on_sphere(x + self.alpha(h - x))


class HyperHead(nn.Module):
    """
    SimbaV2's output layer: two dense layers of unit norm with a scaler between them, and a bias.

    :param in_features: width of the input
    :param n_outputs: number of outputs
    :param n_copies: E for E independent heads, None for one
    """

    def __init__(self, in_features: int, n_outputs: int, n_copies: int | None):
        super().__init__()
        self.dense1 = _dense(in_features, in_features, n_copies)
        self.scaler = Scaler(in_features, 1.0, 1.0, n_copies)
        self.dense2 = _dense(in_features, n_outputs, n_copies, bias=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.dense2(self.scaler(self.dense1(x)))


class SimbaV2Net(UnitNormBlocks):
    """
    SimbaV2's trunk: the input with an appended constant, projected onto the sphere; a dense layer and a scaler,
    projected onto the sphere; blocks that move on it. The units of every dense layer, the network's own head included,
    have input weights of length 1, which :meth:`project` restores after each step of the optimizer. No biases but the
    head's.

    :param in_features: width of the input
    :param width: width of the stream
    :param n_blocks: number of blocks, at least 0
    :param expansion: hidden neurons of a block per width, at least 1
    :param shift: the constant that is appended to the input, above 0
    :param n_copies: E for E independent trunks, None for one
    :raises ValueError: if an argument is out of range
    """

    def __init__(
        self,
        in_features: int,
        width: int = 512,
        n_blocks: int = 2,
        expansion: int = 4,
        shift: float = 3.0,
        n_copies: int | None = None,
    ):
        super().__init__()
        if width < 1 or n_blocks < 0 or expansion < 1 or not shift > 0:
            raise ValueError(
                f"SimbaV2Net needs width >= 1, n_blocks >= 0, expansion >= 1 and shift > 0, not width={width}, "
                f"n_blocks={n_blocks}, expansion={expansion}, shift={shift}"
            )
        self.out_features, self.shift = width, shift
        scale = math.sqrt(2 / width)
        self.dense = _dense(in_features + 1, width, n_copies)
        self.scaler = Scaler(width, scale, scale, n_copies)
        self.blocks = nn.ModuleList(HyperBlock(width, expansion, n_blocks, n_copies) for _ in range(n_blocks))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, width), or (E, B, width) if there are copies; of length 1
        """
        # Not F.pad, which takes no tensor: the constant is one where it differs between the learners of a group.
        constant = x.new_zeros((*x.shape[:-1], 1)) + self.shift
        h = on_sphere(self.scaler(self.dense(on_sphere(torch.cat((x, constant), dim=-1)))))
        for block in self.blocks:
            h = block(h)
        return h

    def make_head(self, n_outputs: int, n_copies: int | None = None, gain: float | None = None) -> nn.Module:
        return HyperHead(self.out_features, n_outputs, n_copies)
