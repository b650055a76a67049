"""Initialisation of the layers of every network: orthogonal or normal kernels, zero biases."""

import math

import torch
from torch import nn

from sb3_sample.networks.ensemble import Dense, EnsembleLinear
from sb3_sample.networks.spectral_norm import SpectralEnsembleLinear, SpectralLinear, SpectralNorm
from sb3_sample.networks.unit_norm import UnitEnsembleLinear, UnitLinear, UnitNorm

#: Gain of every kernel unless a head asks for another one (BRO's and DAC's published code).
DEFAULT_GAIN = math.sqrt(2)


def draw_orthogonal(weight: torch.Tensor, gain: float = DEFAULT_GAIN) -> torch.Tensor:
    """
    Draw orthogonal kernels, each copy its own, in place.

    :param weight: (in, out) or (out, in), or a stack of E of them
    :param gain: factor on the orthogonal matrix
    :return: the same tensor
    """
    # torch's own helper treats a stack of matrices as one matrix, hence the loop over copies.
    for kernel in weight if weight.dim() == 3 else [weight]:
        nn.init.orthogonal_(kernel, gain)
    return weight


def init_orthogonal(layer: Dense, gain: float = DEFAULT_GAIN) -> None:
    """
    Draw an orthogonal kernel, each copy of an ensemble its own, and set the bias to zero, in place.

    :param layer: the layer to initialise
    :param gain: factor on the orthogonal matrix
    """
    draw_orthogonal(layer.weight, gain)
    _complete(layer)


def _complete(layer: Dense) -> None:
    """Set the bias to zero, and bring a new kernel onto its constraint."""
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    if isinstance(layer, SpectralNorm):
        layer.find_direction()
    if isinstance(layer, UnitNorm):
        layer.project()


#: Distributions of kernels that are normal, and their variance times the fan-in.
NORMAL_KERNELS = {"he_normal": 2.0, "lecun_normal": 1.0}


def draw_normal(weight: torch.Tensor, fan_in: int, distribution: str) -> torch.Tensor:
    """
    Draw kernels from a normal distribution truncated at two standard deviations, in place.

    :param weight: kernel, or a stack of kernels
    :param fan_in: inputs of the layer
    :param distribution: "he_normal" (variance after truncation 2 / fan-in) or "lecun_normal" (1 / fan-in)
    :return: the same tensor
    """
    # Standard deviation of the standard normal distribution truncated to [-2, 2].
    std = math.sqrt(NORMAL_KERNELS[distribution] / fan_in) / 0.8796256610342398
    return nn.init.trunc_normal_(weight, 0.0, std, -2 * std, 2 * std)


@torch.no_grad()
def init_normal(layer: Dense, distribution: str) -> None:
    """
    Draw a kernel by :func:`draw_normal`, and set the bias to zero, in place.

    :param layer: the layer to initialise
    :param distribution: "he_normal" or "lecun_normal"
    """
    draw_normal(layer.weight, layer.in_features, distribution)
    _complete(layer)


def linear(
    in_features: int,
    out_features: int,
    n_copies: int | None,
    bias: bool = True,
    gain: float = DEFAULT_GAIN,
    spectral_norm: bool = False,
    unit_norm: bool = False,
    kernels: str = "orthogonal",
) -> Dense:
    """
    A dense layer: one, or a stack of independent ones.

    :param in_features: width of the input
    :param out_features: width of the output
    :param n_copies: E for a stack of E layers, None for a plain ``nn.Linear``
    :param bias: whether the layer has a bias
    :param gain: factor on an orthogonal kernel
    :param spectral_norm: whether the kernel is divided by its largest singular value, which undoes the gain
    :param unit_norm: whether each unit's input weights have length 1, which ``project`` restores; not with
        ``spectral_norm``
    :param kernels: their distribution, "orthogonal", "he_normal" or "lecun_normal"; the last two without the gain
    """
    layer: Dense
    if n_copies is None:
        single = SpectralLinear if spectral_norm else UnitLinear if unit_norm else nn.Linear
        layer = single(in_features, out_features, bias=bias)
    else:
        ensemble = SpectralEnsembleLinear if spectral_norm else UnitEnsembleLinear if unit_norm else EnsembleLinear
        layer = ensemble(n_copies, in_features, out_features, bias=bias)
    if kernels == "orthogonal":
        init_orthogonal(layer, gain)
    else:
        init_normal(layer, kernels)
    return layer
