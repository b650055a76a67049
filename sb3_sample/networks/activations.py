"""Activations that torch does not have."""

import torch
from torch import nn


class CReLU(nn.Module):
    """
    Concatenated ReLU: a neuron's positive and negative part, so that no neuron can die (Shang et al. 2016; against
    the loss of plasticity, Abbas et al. 2023). The layer after it is ``width_factor`` times as wide.
    """

    width_factor = 2

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (..., N)
        :return: (..., 2 N): relu(x) of all neurons, then relu(-x) of all neurons
        """
        return torch.cat((x, -x), dim=-1).relu_()


def width_factor(activation: nn.Module) -> int:
    """
    :param activation: an activation
    :return: outputs per neuron: its attribute ``width_factor``, 1 if it has none
    """
    return getattr(activation, "width_factor", 1)
