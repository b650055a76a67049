"""A network that first projects the features of an encoder to few dimensions."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from sb3_sample.networks.ensemble import Dense
from sb3_sample.networks.initialization import DEFAULT_GAIN, linear
from sb3_sample.networks.network import HiddenUnits, Network


class Projected(Network):
    """
    Dense layer, layer norm and tanh on the features of an encoder (DrQ; SAC-AE, Yarats et al. 2021), and a network on
    their result and the inputs beside the features. All copies of the network share one projection.

    :param in_features: F plus the number of inputs beside the features
    :param n_features: F, number of features, which come first among the inputs
    :param width: of the projection
    :param network: class of the network behind the projection
    :param network_kwargs: its arguments
    :param gain: of the projection's orthogonal kernel
    :param n_copies: E for E copies of the network, None for one
    """

    def __init__(
        self,
        in_features: int,
        n_features: int,
        width: int,
        network: type[Network],
        network_kwargs: Mapping[str, Any],
        gain: float = DEFAULT_GAIN,
        n_copies: int | None = None,
    ):
        super().__init__()
        self.n_features = n_features
        #: Arguments of the projection.
        self.of_projection = {"n_features": n_features, "width": width, "gain": gain}
        self.projection = nn.Sequential(linear(n_features, width, None, gain=gain), nn.LayerNorm(width), nn.Tanh())
        self.network = network(in_features - n_features + width, n_copies=n_copies, **network_kwargs)
        self.out_features = self.network.out_features
        # Requirements of the network to its owner.
        self.trains_in_target = self.network.trains_in_target
        self.stacks_rows, self.stacks_actor_rows = self.network.stacks_rows, self.network.stacks_actor_rows
        self.statistics_every_step = self.network.statistics_every_step

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in_features)
        :return: (B, out_features), or (E, B, out_features) if there are copies
        """
        projected = self.projection(x[:, : self.n_features])
        if x.shape[1] > self.n_features:
            projected = torch.cat((projected, x[:, self.n_features :]), dim=1)
        return self.network(projected)  # type: ignore[no-any-return]

    def hidden_units(self, head: Dense | None) -> list[HiddenUnits]:
        """
        :param head: the layer that reads the network's output, None if several do
        :return: every hidden layer of the network behind the projection
        """
        return [units._replace(name=f"network.{units.name}") for units in self.network.hidden_units(head)]

    def make_head(self, n_outputs: int, n_copies: int | None = None, gain: float | None = None) -> nn.Module:
        return self.network.make_head(n_outputs, n_copies, gain)

    def project(self) -> None:
        self.network.project()

    def refresh(self) -> None:
        self.network.refresh()

    def statistics(self) -> list[torch.Tensor]:
        """
        :return: the statistics of the network
        """
        return self.network.statistics()

    def copied_parameters(self) -> list[nn.Parameter]:
        """
        :return: the parameters that are separate for each copy
        """
        return self.network.copied_parameters()
