"""Networks that know nothing of reinforcement learning."""

from sb3_sample.networks.bronet import BroNet
from sb3_sample.networks.ensemble import EnsembleLayerNorm, EnsembleLinear
from sb3_sample.networks.initialization import init_orthogonal, linear
from sb3_sample.networks.mlp import MLP

#: A trunk; its last layer's width is ``out_features``.
Network = MLP | BroNet

#: Trunks by the name that a policy's ``critic_network`` and ``actor_network`` take.
NETWORKS: dict[str, type[Network]] = {"mlp": MLP, "bronet": BroNet}

__all__ = ["MLP", "NETWORKS", "BroNet", "EnsembleLayerNorm", "EnsembleLinear", "Network", "init_orthogonal", "linear"]
