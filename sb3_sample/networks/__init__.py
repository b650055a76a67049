"""Networks, independent of reinforcement learning."""

from sb3_sample.networks.activations import CReLU
from sb3_sample.networks.batch_norm import BatchNorm, BatchRenorm
from sb3_sample.networks.batch_normed import CrossQNet, XQCNet
from sb3_sample.networks.bronet import BroNet
from sb3_sample.networks.dormant import neuron_scores, recycle
from sb3_sample.networks.ensemble import EnsembleLayerNorm, EnsembleLinear
from sb3_sample.networks.flash import FlashNet
from sb3_sample.networks.initialization import init_orthogonal, linear
from sb3_sample.networks.mlp import MLP
from sb3_sample.networks.network import HiddenUnits, Network, widened
from sb3_sample.networks.normalization import RunningMoments, RunningNorm
from sb3_sample.networks.projected import Projected
from sb3_sample.networks.simba import SimbaNet
from sb3_sample.networks.simbav2 import SimbaV2Net
from sb3_sample.networks.spectral_net import SpectralNet
from sb3_sample.networks.spectral_norm import SpectralEnsembleLinear, SpectralLinear
from sb3_sample.networks.unit_norm import UnitEnsembleLinear, UnitLinear, UnitNorm, project_weights

#: Trunks by the name that a policy's ``critic_network`` and ``actor_network`` take.
NETWORKS: dict[str, type[Network]] = {
    "mlp": MLP,
    "bronet": BroNet,
    "crossq": CrossQNet,
    "flash": FlashNet,
    "simba": SimbaNet,
    "simbav2": SimbaV2Net,
    "spectral": SpectralNet,
    "xqc": XQCNet,
}

__all__ = [
    "MLP",
    "NETWORKS",
    "BatchNorm",
    "BatchRenorm",
    "BroNet",
    "CReLU",
    "CrossQNet",
    "EnsembleLayerNorm",
    "EnsembleLinear",
    "FlashNet",
    "HiddenUnits",
    "Network",
    "Projected",
    "RunningMoments",
    "RunningNorm",
    "SimbaNet",
    "SimbaV2Net",
    "SpectralEnsembleLinear",
    "SpectralLinear",
    "SpectralNet",
    "UnitEnsembleLinear",
    "UnitLinear",
    "UnitNorm",
    "XQCNet",
    "init_orthogonal",
    "linear",
    "neuron_scores",
    "project_weights",
    "recycle",
    "widened",
]
