"""Base of the residual networks whose dense layers have unit norm."""

from typing import Any

from sb3_sample.networks.ensemble import Dense
from sb3_sample.networks.network import HiddenUnits, Network
from sb3_sample.networks.unit_norm import project_weights


class UnitNormBlocks(Network):
    """Base class: ``blocks`` of unit-norm layers, each with a hidden layer ``dense1`` and its ``activation``."""

    blocks: Any

    def project(self) -> None:
        project_weights(self)

    def hidden_units(self, head: Dense | None) -> list[HiddenUnits]:
        """
        List the neurons for inspection, not for recycling: ReDo's fresh weights have another length.

        :param head: the layer that reads the network's output; not used here
        :return: the hidden layer of each block
        """
        return [
            HiddenUnits(f"blocks.{k}.dense1", block.dense1, None, block.activation, None)
            for k, block in enumerate(self.blocks)
        ]
