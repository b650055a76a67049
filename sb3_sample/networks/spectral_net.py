"""The residual network with spectral norms that BroNet was compared with (BRO, figure 14)."""

import torch
from torch import nn

from sb3_sample.networks.ensemble import Dense, layer_norm
from sb3_sample.networks.initialization import linear
from sb3_sample.networks.network import HiddenUnits, Network


class SpectralBlock(nn.Module):
    """
    ``x + (LayerNorm, Dense, ReLU, Dense)(x)``, both kernels of spectral norm 1; nothing follows the addition.

    :param width: width of input, hidden layer and output
    :param n_copies: E for E independent blocks, None for one
    """

    def __init__(self, width: int, n_copies: int | None):
        super().__init__()
        self.norm = layer_norm(width, n_copies)
        self.dense1 = linear(width, width, n_copies, spectral_norm=True)
        self.activation = nn.ReLU(inplace=True)
        self.dense2 = linear(width, width, n_copies, spectral_norm=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.dense2(self.activation(self.dense1(self.norm(x)))) + x


class SpectralNet(Network):
    """
    "Spectral" of the BRO paper, figure 14 and table 1, the design of Bjorck et al. (2021): Dense, ReLU, then residual
    blocks with a leading layer norm and spectral norms inside.

    The paper does not say what follows the first Dense. There is a ReLU and no norm here, since the paper gets its "BRO
    wo first LN" from this network by replacing the spectral norms "in the residual blocks": outside of the blocks the
    two are then the same. As in BroNet, nothing follows the last addition.

    :param in_features: width of the input
    :param width: width of every layer
    :param n_blocks: number of residual blocks, at least 0
    :param n_copies: E for E independent trunks, None for one
    :raises ValueError: if a size is out of range
    """

    def __init__(self, in_features: int, width: int = 512, n_blocks: int = 2, n_copies: int | None = None):
        super().__init__()
        if width < 1 or n_blocks < 0:
            raise ValueError(f"SpectralNet needs width >= 1 and n_blocks >= 0, not width={width}, n_blocks={n_blocks}")
        self.out_features = width
        self.dense = linear(in_features, width, n_copies)
        self.activation = nn.ReLU(inplace=True)
        self.blocks = nn.ModuleList(SpectralBlock(width, n_copies) for _ in range(n_blocks))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, width), or (E, B, width) if there are copies
        """
        h = self.activation(self.dense(x))
        for block in self.blocks:
            h = block(h)
        return h

    def hidden_units(self, head: Dense | None) -> list[HiddenUnits]:
        """
        As in BroNet: the first layer's neurons are listed but cannot be recycled (``outgoing`` is None), since the
        residual stream that they open has many readers.

        :param head: the layer that reads the network's output; not used here
        :return: the first layer, then the hidden layer of each block
        """
        units = [HiddenUnits("dense", self.dense, None, self.activation, None)]
        for k, block in enumerate(self.blocks):
            assert isinstance(block, SpectralBlock)
            units.append(HiddenUnits(f"blocks.{k}.dense1", block.dense1, None, block.activation, block.dense2))
        return units
