"""The plain multi-layer perceptron of SAC, with optional layer norm, spectral norm and dropout."""

import functools
from collections.abc import Sequence

import torch
from torch import nn

from sb3_sample.networks.activations import width_factor
from sb3_sample.networks.ensemble import Dense, Norm
from sb3_sample.networks.ensemble import layer_norm as make_layer_norm
from sb3_sample.networks.initialization import DEFAULT_GAIN, draw_orthogonal, linear
from sb3_sample.networks.network import HiddenUnits, Network


class MLP(Network):
    """
    Hidden layers of an MLP; the output layer belongs to their owner. A hidden layer is Dense, dropout, layer norm,
    activation; the last kernel may have spectral norm 1 (regularization study, 2403.00514, appendix B).

    :param in_features: width of the input
    :param hidden_sizes: widths of the hidden layers
    :param activation_fn: activation after each hidden layer; ``CReLU`` doubles the input of the next layer
    :param layer_norm: whether each hidden layer is normalised before its activation
    :param n_copies: E for E independent networks, None for one
    :param spectral_norm: whether the last hidden layer's kernel is divided by its largest singular value
    :param dropout: probability of dropping a neuron in training mode, each copy its own (DroQ, Hiraoka et al. 2021)
    :param gain: factor on the orthogonal kernels, the output layer's included unless its owner asks for another
    :raises ValueError: if a width is below 1, the dropout is out of range, or there is no layer for the spectral norm
    """

    def __init__(
        self,
        in_features: int,
        hidden_sizes: Sequence[int] = (256, 256),
        activation_fn: type[nn.Module] = nn.ReLU,
        layer_norm: bool = False,
        n_copies: int | None = None,
        spectral_norm: bool = False,
        dropout: float = 0.0,
        gain: float = DEFAULT_GAIN,
    ):
        super().__init__()
        self.gain = self.head_gain = gain
        if any(width < 1 for width in hidden_sizes):
            raise ValueError(f"the widths in hidden_sizes must be at least 1, not {list(hidden_sizes)}")
        if spectral_norm and not hidden_sizes:
            raise ValueError("spectral_norm needs a hidden layer, but hidden_sizes is empty")
        if not 0 <= dropout < 1:
            raise ValueError(f"dropout must be at least 0 and below 1, not {dropout}")
        layers: list[nn.Module] = []
        self._hidden: list[tuple[str, Dense, Norm | None, nn.Module]] = []
        for i, width in enumerate(hidden_sizes):
            is_last = i == len(hidden_sizes) - 1
            dense = linear(in_features, width, n_copies, gain=gain, spectral_norm=spectral_norm and is_last)
            norm = make_layer_norm(width, n_copies) if layer_norm else None
            activation = activation_fn()
            self._hidden.append((f"layers.{len(layers)}", dense, norm, activation))
            layers.append(dense)
            if dropout > 0:
                layers.append(nn.Dropout(dropout))
            if norm is not None:
                layers.append(norm)
            layers.append(activation)
            in_features = width * width_factor(activation)
        self.layers = nn.Sequential(*layers)
        self.out_features = in_features

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, out_features), or (E, B, out_features) if there are copies
        """
        return self.layers(x)

    def hidden_units(self, head: Dense | None) -> list[HiddenUnits]:
        """
        :param head: the layer that reads the network's output, None if several do
        :return: every hidden layer, in the order of the forward pass
        """
        outgoing = [*(dense for _, dense, _, _ in self._hidden[1:]), head]
        draw = functools.partial(draw_orthogonal, gain=self.gain)
        return [HiddenUnits(*layer, reader, draw) for layer, reader in zip(self._hidden, outgoing, strict=False)]
