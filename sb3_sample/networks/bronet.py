"""BroNet, the residual network of BRO (paper, figure 5)."""

import torch
import torch.nn.functional as F
from torch import nn

from sb3_sample.networks.ensemble import layer_norm
from sb3_sample.networks.initialization import linear


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
        self.dense2 = linear(width, width, n_copies)
        self.norm2 = layer_norm(width, n_copies)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        residual = F.relu(self.norm1(self.dense1(x)), inplace=True)
        return self.norm2(self.dense2(residual)).add_(x)


class BroNet(nn.Module):
    """
    The trunk of BRO's critics and actors: Dense, LayerNorm, ReLU, then residual blocks. The output layer
    (quantiles, mean, log standard deviation) belongs to whoever uses the trunk.

    :param in_features: width of the input
    :param width: width of every layer
    :param n_blocks: number of residual blocks, at least 0
    :param n_copies: E for E independent trunks, None for one
    :raises ValueError: if a size is out of range
    """

    def __init__(self, in_features: int, width: int = 512, n_blocks: int = 2, n_copies: int | None = None):
        super().__init__()
        if width < 1 or n_blocks < 0:
            raise ValueError(f"BroNet needs width >= 1 and n_blocks >= 0, not width={width}, n_blocks={n_blocks}")
        self.out_features = width
        self.dense = linear(in_features, width, n_copies)
        self.norm = layer_norm(width, n_copies)
        self.blocks = nn.ModuleList(ResidualBlock(width, n_copies) for _ in range(n_blocks))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, width), or (E, B, width) if there are copies
        """
        h = F.relu(self.norm(self.dense(x)), inplace=True)
        for block in self.blocks:
            h = block(h)
        return h
