"""Dense layers each of whose units keeps input weights of length 1."""

import torch
from torch import nn

from sb3_sample.networks.ensemble import EnsembleLinear


class UnitNorm(nn.Module):
    """
    Mixin of a dense layer: :meth:`project` divides the input weights of each unit by their length, per copy. Forward
    passes do not, so that code which changes the weights must project them.
    """

    weight: torch.Tensor
    #: Whether a unit's bias counts as one of its weights; False: biases are left alone.
    joint_bias: bool = False

    @torch.no_grad()
    def project(self) -> None:
        """Bring the weights back to length 1, in place."""
        # The inputs are axis 1 of (out, in) and of (E, in, out) alike. Over those of the second, vector_norm takes ten
        # times as long on a CPU.
        length = self.weight.square().sum(dim=1, keepdim=True).sqrt()
        if not self.joint_bias:
            self.weight.div_(length.clamp_min(1e-8))
            return
        bias = self.bias
        assert isinstance(bias, torch.Tensor)
        # A bias is (out,), or (E, 1, out).
        length = torch.hypot(length, bias.view_as(length)).clamp_min(1e-8)
        self.weight.div_(length)
        bias.div_(length.view_as(bias))


class UnitLinear(UnitNorm, nn.Linear):
    """``nn.Linear`` whose units have input weights of length 1."""


class UnitEnsembleLinear(UnitNorm, EnsembleLinear):
    """E independent dense layers whose units have input weights of length 1."""


def project_weights(module: nn.Module) -> None:
    """
    Project every layer of unit norm, in place.

    :param module: a network, a head, or one such layer
    """
    for layer in module.modules():
        if isinstance(layer, UnitNorm):
            layer.project()
