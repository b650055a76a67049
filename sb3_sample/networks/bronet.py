"""BroNet, the residual network of BRO (paper, figure 5)."""

import torch
from torch import nn

from sb3_sample.networks.ensemble import Dense, layer_norm
from sb3_sample.networks.initialization import linear
from sb3_sample.networks.network import HiddenUnits, Network


class ResidualBlock(nn.Module):
    """
    ``x + (Dense, LayerNorm, ReLU, Dense, LayerNorm)(x)``; nothing follows the addition.

    :param width: width of input, hidden layer and output
    :param n_copies: E for E independent blocks, None for one
    """

    def __init__(self, width: int, n_copies: int | None):
        super().__init__()
        self.dense1 = linear(width, width, n_copies)
        self.norm1 = layer_norm(width, n_copies)
        self.activation = nn.ReLU(inplace=True)
        self.dense2 = linear(width, width, n_copies)
        self.norm2 = layer_norm(width, n_copies)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        residual = self.activation(self.norm1(self.dense1(x)))
        return self.norm2(self.dense2(residual)).add_(x)


class BroNet(Network):
    """
    The trunk of BRO's critics and actors: Dense, LayerNorm, ReLU, then residual blocks. The output layer
    (quantiles, mean, log standard deviation) belongs to the trunk's owner.

    :param in_features: width of the input
    :param width: width of every layer
    :param n_blocks: number of residual blocks, at least 0
    :param n_copies: E for E independent trunks, None for one
    :param first_layer_norm: False for "BRO wo first LN" (BRO, figure 14): Dense, ReLU, then the blocks
    :raises ValueError: if a size is out of range
    """

    def __init__(
        self,
        in_features: int,
        width: int = 512,
        n_blocks: int = 2,
        n_copies: int | None = None,
        first_layer_norm: bool = True,
    ):
        super().__init__()
        if width < 1 or n_blocks < 0:
            raise ValueError(f"BroNet needs width >= 1 and n_blocks >= 0, not width={width}, n_blocks={n_blocks}")
        self.out_features = width
        self.dense = linear(in_features, width, n_copies)
        self.norm = layer_norm(width, n_copies) if first_layer_norm else None
        self.activation = nn.ReLU(inplace=True)
        self.blocks = nn.ModuleList(ResidualBlock(width, n_copies) for _ in range(n_blocks))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, width), or (E, B, width) if there are copies
        """
        h = self.dense(x)
        if self.norm is not None:
            h = self.norm(h)
        h = self.activation(h)
        for block in self.blocks:
            h = block(h)
        return h

    def hidden_units(self, head: Dense | None) -> list[HiddenUnits]:
        """
        The first layer opens the residual stream, which every block and the head read: its neurons are listed for
        inspection, not for recycling (``outgoing`` is None). Neurons inside a block are read by its second layer alone.
        The stream after a block is not an activation and is not listed.

        :param head: the layer that reads the network's output; not used here
        :return: the first layer, then the hidden layer of each block
        """
        units = [HiddenUnits("dense", self.dense, self.norm, self.activation, None)]
        for k, block in enumerate(self.blocks):
            assert isinstance(block, ResidualBlock)
            units.append(HiddenUnits(f"blocks.{k}.dense1", block.dense1, block.norm1, block.activation, block.dense2))
        return units
