"""The plain multi-layer perceptron of SAC, with optional layer norm."""

from collections.abc import Sequence

import torch
from torch import nn

from sb3_sample.networks.ensemble import layer_norm as make_layer_norm
from sb3_sample.networks.initialization import linear


class MLP(nn.Module):
    """
    Hidden layers of an MLP; the output layer belongs to whoever uses them.

    :param in_features: width of the input
    :param hidden_sizes: widths of the hidden layers
    :param activation_fn: activation after each hidden layer
    :param layer_norm: whether each hidden layer is normalised before its activation
    :param n_copies: E for E independent networks, None for one
    :raises ValueError: if a width is below 1
    """

    def __init__(
        self,
        in_features: int,
        hidden_sizes: Sequence[int] = (256, 256),
        activation_fn: type[nn.Module] = nn.ReLU,
        layer_norm: bool = False,
        n_copies: int | None = None,
    ):
        super().__init__()
        if any(width < 1 for width in hidden_sizes):
            raise ValueError(f"the widths in hidden_sizes must be at least 1, not {list(hidden_sizes)}")
        layers: list[nn.Module] = []
        for width in hidden_sizes:
            layers.append(linear(in_features, width, n_copies))
            if layer_norm:
                layers.append(make_layer_norm(width, n_copies))
            layers.append(activation_fn())
            in_features = width
        self.layers = nn.Sequential(*layers)
        self.out_features = in_features

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, last width), or (E, B, last width) if there are copies
        """
        return self.layers(x)
