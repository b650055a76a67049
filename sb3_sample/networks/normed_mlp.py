"""Multi-layer perceptron of MR.Q and DR.Q, whose layer norms have no parameters."""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from sb3_sample.networks.ensemble import Dense, EnsembleLinear
from sb3_sample.networks.network import HiddenUnits, Network


def draw_xavier(weight: torch.Tensor, fans: int) -> torch.Tensor:
    """
    Draw kernels from Xavier's uniform distribution, gain √2, in place.

    :param weight: kernel, or a stack of kernels
    :param fans: inputs and outputs of the layer together
    :return: the same tensor
    """
    bound = math.sqrt(2) * math.sqrt(6 / fans)
    return nn.init.uniform_(weight, -bound, bound)


def xavier_linear(in_features: int, out_features: int, n_copies: int | None = None) -> Dense:
    """
    A dense layer with weights of Xavier's uniform distribution, gain √2, and zero biases.

    :param in_features: width of the input
    :param out_features: width of the output
    :param n_copies: E for a stack of E layers, None for a plain ``nn.Linear``
    """
    layer: Dense
    if n_copies is None:
        layer = nn.Linear(in_features, out_features)
    else:
        layer = EnsembleLinear(n_copies, in_features, out_features)
    draw_xavier(layer.weight, in_features + out_features)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer


class NormedMLP(Network):
    """
    Hidden layers, each Dense, layer norm without scale and shift, activation; the output layer belongs to their owner.

    :param in_features: width of the input
    :param hidden_sizes: widths of the hidden layers
    :param activation_fn: activation after each layer norm
    :param n_copies: E for E independent networks, None for one
    :raises ValueError: if a width is below 1
    """

    def __init__(
        self,
        in_features: int,
        hidden_sizes: Sequence[int] = (512, 512),
        activation_fn: type[nn.Module] = nn.ELU,
        n_copies: int | None = None,
    ):
        super().__init__()
        if any(width < 1 for width in hidden_sizes):
            raise ValueError(f"the widths in hidden_sizes must be at least 1, not {list(hidden_sizes)}")
        widths = [in_features, *hidden_sizes]
        self.layers = nn.ModuleList(xavier_linear(*pair, n_copies) for pair in itertools.pairwise(widths))
        self.activations = nn.ModuleList(activation_fn() for _ in hidden_sizes)
        self.out_features = widths[-1]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, out_features), or (E, B, out_features) if there are copies
        """
        for layer, activation in zip(self.layers, self.activations, strict=True):
            x = layer(x)
            x = activation(F.layer_norm(x, x.shape[-1:]))
        return x

    def hidden_units(self, head: Dense | None) -> list[HiddenUnits]:
        """
        :param head: the layer that reads the network's output, None if several do
        :return: every hidden layer, in the order of the forward pass
        """
        units = []
        readers: list[Any] = [*list(self.layers)[1:], head]
        layers: list[Any] = list(self.layers)
        for i, (layer, activation, reader) in enumerate(zip(layers, self.activations, readers, strict=True)):
            draw = functools.partial(draw_xavier, fans=layer.in_features + layer.out_features)
            units.append(HiddenUnits(f"layers.{i}", layer, None, activation, reader, draw))
        return units
