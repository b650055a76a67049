"""SimBa's residual network (Lee et al. 2024)."""

import functools

import torch
from torch import nn

from sb3_sample.networks.ensemble import Dense, layer_norm
from sb3_sample.networks.initialization import draw_normal, linear
from sb3_sample.networks.network import HiddenUnits, Network


class SimbaBlock(nn.Module):
    """
    ``x + (LayerNorm, Dense, ReLU, Dense)(x)``, the hidden layer wider than the rest; He-normal kernels.

    :param width: width of input and output
    :param expansion: hidden neurons per input
    :param n_copies: E for E independent blocks, None for one
    """

    def __init__(self, width: int, expansion: int, n_copies: int | None):
        super().__init__()
        self.norm = layer_norm(width, n_copies)
        self.dense1 = linear(width, expansion * width, n_copies, kernels="he_normal")
        self.activation = nn.ReLU(inplace=True)
        self.dense2 = linear(expansion * width, width, n_copies, kernels="he_normal")

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.dense2(self.activation(self.dense1(self.norm(x)))) + x


class SimbaNet(Network):
    """
    SimBa's trunk: Dense, residual blocks with a leading layer norm and an inverted bottleneck, and a final layer norm.
    The output layer belongs to the trunk's owner; its kernel and the first layer's are orthogonal of gain 1.

    :param in_features: width of the input
    :param width: width of the residual stream
    :param n_blocks: number of residual blocks, at least 0
    :param expansion: hidden neurons of a block per width, at least 1
    :param n_copies: E for E independent trunks, None for one
    :raises ValueError: if a size is out of range
    """

    head_gain = 1.0

    def __init__(
        self, in_features: int, width: int = 512, n_blocks: int = 2, expansion: int = 4, n_copies: int | None = None
    ):
        super().__init__()
        if width < 1 or n_blocks < 0 or expansion < 1:
            raise ValueError(
                f"SimbaNet needs width >= 1, n_blocks >= 0 and expansion >= 1, not width={width}, "
                f"n_blocks={n_blocks}, expansion={expansion}"
            )
        self.out_features = width
        self.dense = linear(in_features, width, n_copies, gain=1.0)
        self.blocks = nn.ModuleList(SimbaBlock(width, expansion, n_copies) for _ in range(n_blocks))
        self.norm = layer_norm(width, n_copies)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, width), or (E, B, width) if there are copies
        """
        h = self.dense(x)
        for block in self.blocks:
            h = block(h)
        return self.norm(h)

    def hidden_units(self, head: Dense | None) -> list[HiddenUnits]:
        """
        :param head: the layer that reads the network's output; not used here
        :return: the hidden layer of each block, which its second layer alone reads
        """
        units = []
        for k, block in enumerate(self.blocks):
            assert isinstance(block, SimbaBlock)
            layers = (block.dense1, None, block.activation, block.dense2)
            draw = functools.partial(draw_normal, fan_in=block.dense1.in_features, distribution="he_normal")
            units.append(HiddenUnits(f"blocks.{k}.dense1", *layers, draw))
        return units
