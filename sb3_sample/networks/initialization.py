"""Initialisation of the layers of every network: orthogonal kernels, zero biases."""

import math

from torch import nn

from sb3_sample.networks.ensemble import EnsembleLinear

#: Gain of every kernel unless a head asks for another one (BRO's and DAC's published code).
DEFAULT_GAIN = math.sqrt(2)


def init_orthogonal(layer: nn.Linear | EnsembleLinear, gain: float = DEFAULT_GAIN) -> None:
    """
    Draw an orthogonal kernel, each copy of an ensemble its own, and set the bias to zero, in place.

    :param layer: the layer to initialise
    :param gain: factor on the orthogonal matrix
    """
    # torch's own helper treats a stack of matrices as one matrix, hence the loop over copies.
    for kernel in layer.weight if isinstance(layer, EnsembleLinear) else [layer.weight]:
        nn.init.orthogonal_(kernel, gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)


def linear(
    in_features: int, out_features: int, n_copies: int | None, bias: bool = True, gain: float = DEFAULT_GAIN
) -> nn.Linear | EnsembleLinear:
    """
    A dense layer with orthogonal kernels: one, or a stack of independent ones.

    :param in_features: width of the input
    :param out_features: width of the output
    :param n_copies: E for a stack of E layers, None for a plain ``nn.Linear``
    :param bias: whether the layer has a bias
    :param gain: factor on the orthogonal kernel
    """
    layer: nn.Linear | EnsembleLinear
    if n_copies is None:
        layer = nn.Linear(in_features, out_features, bias=bias)
    else:
        layer = EnsembleLinear(n_copies, in_features, out_features, bias=bias)
    init_orthogonal(layer, gain)
    return layer
