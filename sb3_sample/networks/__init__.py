"""Networks that know nothing of reinforcement learning."""

from sb3_sample.networks.activations import CReLU
from sb3_sample.networks.bronet import BroNet
from sb3_sample.networks.dormant import neuron_scores, recycle
from sb3_sample.networks.ensemble import EnsembleLayerNorm, EnsembleLinear
from sb3_sample.networks.initialization import init_orthogonal, linear
from sb3_sample.networks.mlp import MLP
from sb3_sample.networks.network import HiddenUnits, Network
from sb3_sample.networks.spectral_net import SpectralNet
from sb3_sample.networks.spectral_norm import SpectralEnsembleLinear, SpectralLinear

#: Trunks by the name that a policy's ``critic_network`` and ``actor_network`` take.
NETWORKS: dict[str, type[Network]] = {"mlp": MLP, "bronet": BroNet, "spectral": SpectralNet}

__all__ = [
    "MLP",
    "NETWORKS",
    "BroNet",
    "CReLU",
    "EnsembleLayerNorm",
    "EnsembleLinear",
    "HiddenUnits",
    "Network",
    "SpectralEnsembleLinear",
    "SpectralLinear",
    "SpectralNet",
    "init_orthogonal",
    "linear",
    "neuron_scores",
    "recycle",
]
