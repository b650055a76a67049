"""Base class of networks, and hidden neurons as a network lists them."""

import inspect
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from torch import nn

from sb3_sample.networks.ensemble import Dense, Norm
from sb3_sample.networks.initialization import DEFAULT_GAIN, draw_orthogonal, linear
from sb3_sample.networks.spectral_norm import SpectralNorm


class HiddenUnits(NamedTuple):
    """One layer of hidden neurons, as a network's ``hidden_units`` lists them."""

    #: The dense layer's name inside the network
    name: str
    #: The layer whose N outputs are the neurons
    dense: Dense
    #: The layer norm between the neurons and their activation, if there is one
    norm: Norm | None
    #: The module whose output is the neurons' activation
    activation: nn.Module
    #: The one layer that reads the activation; None if others read it too, and the neurons cannot be recycled
    outgoing: Dense | None
    #: Draws a kernel like the dense layer's as at initialisation, in place, and returns it
    draw: Callable[[torch.Tensor], torch.Tensor] = draw_orthogonal


class Network(nn.Module):
    """
    Base class of trunks, the networks of actors and critics up to the output layer, which belongs to the trunk's owner.

    A trunk is made as ``Trunk(in_features, n_copies=E, **kwargs)``: for E independent critics it takes (B, in_features)
    and returns (E, B, out_features), for an actor (``n_copies=None``) it returns (B, out_features).
    """

    #: Width of the last layer.
    out_features: int
    #: Whether it can be compiled. A class from outside of this package declares it itself.
    compilable: ClassVar[bool] = True
    #: Whether its copy in the target critics is in training mode during gradient steps, as dropout needs (DroQ). Batch
    #: norm does not need it: with False the targets use the running statistics.
    trains_in_target: bool = True
    #: Whether the critics' step stacks the current and the next rows for one forward pass of 2B rows, so that batch
    #: statistics cover both: "online" takes the next values from that pass (CrossQ, Bhatt et al. 2024, which has no
    #: targets), "target" from the target critics' own pass over the same rows; None: separate passes. Where rows are
    #: stacked, everything else (actors' objectives, rules of pessimism, TD targets' actions) uses the network in
    #: evaluation mode, so that running statistics are those of the stacked rows alone.
    stacks_rows: str | None = None
    #: Whether an actor's own step stacks the current and the next rows too; it learns from the current ones alone.
    stacks_actor_rows: bool = False
    #: Whether an actor's running statistics move in every gradient step, even if it does not learn by ``policy_delay``.
    statistics_every_step: bool = False

    #: Gain of the output layer's kernel, unless its owner asks for another.
    head_gain: float = DEFAULT_GAIN

    @abstractmethod
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in_features), or (E, B, in_features)
        :return: (B, out_features), or (E, B, out_features) if there are copies
        """
        raise NotImplementedError

    def hidden_units(self, head: Dense | None) -> list[HiddenUnits]:
        """
        :param head: the layer that reads the network's output, None if several do
        :return: every hidden layer, in the order of the forward pass, for ReDo and the diagnostics; none by default
        """
        return []

    def make_head(self, n_outputs: int, n_copies: int | None = None, gain: float | None = None) -> nn.Module:
        """
        Make an output layer that reads the network's output.

        :param n_outputs: number of outputs
        :param n_copies: E for E independent layers, None for one
        :param gain: of an orthogonal kernel, as its owner asks for; None: the network's ``head_gain``
        :return: the layer, (B, out_features) to (B, n_outputs), or with an axis E in front
        """
        return linear(self.out_features, n_outputs, n_copies, gain=self.head_gain if gain is None else gain)

    def project(self) -> None:
        """
        Project the weights back onto their constraints, in place; called after every step of the optimizer. Dense
        layers of unit norm in the head are projected by its owner.
        """

    def refresh(self) -> None:
        """Recompute what is derived from the weights; called after they were overwritten, as by shrink and perturb."""
        for layer in self.modules():
            if isinstance(layer, SpectralNorm):
                layer.find_direction()

    def copied_parameters(self) -> list[nn.Parameter]:
        """
        :return: the parameters that are separate for each copy, (E, ...) each; here all
        """
        return list(self.parameters())

    def follow_directions(self) -> None:
        """
        Update the directions of spectral norms by one power iteration where no forward pass does so: in a target that
        is never in training mode.
        """
        for layer in self.modules():
            if isinstance(layer, SpectralNorm) and not layer.training:
                layer.find_direction(1)

    def statistics(self) -> list[torch.Tensor]:
        """
        :return: running statistics that a target copies unchanged; here all buffers but the directions of spectral
            norms, which follow the target's own weights
        """
        layers = [layer for layer in self.modules() if not isinstance(layer, SpectralNorm)]
        return [buffer for layer in layers for buffer in layer.buffers(recurse=False)]


def widened(network: type[Network], kwargs: Mapping[str, Any], factor: int) -> dict[str, Any]:
    """
    Compute the arguments of a wider network.

    :param network: its class, whose width is its argument "width" or "hidden_sizes"
    :param kwargs: its arguments
    :param factor: factor on the width of every hidden layer
    :return: the same arguments with other widths
    :raises ValueError: if it has neither of the two arguments
    """
    if factor == 1:
        return dict(kwargs)
    defaults = {name: each.default for name, each in inspect.signature(network).parameters.items()}
    names = [name for name in ("width", "hidden_sizes") if name in {**defaults, **kwargs}]
    if not names:
        raise ValueError(
            f"a network whose width is to be multiplied must have an argument width or hidden_sizes, and "
            f"{network.__name__} has neither"
        )
    (name,) = names
    size = kwargs.get(name, defaults.get(name))
    return {**kwargs, name: [factor * width for width in size] if name == "hidden_sizes" else factor * size}
