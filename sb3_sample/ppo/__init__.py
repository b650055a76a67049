"""The on-policy family: PPO whose policy gradient also uses further samples (MBMA, 2210.13011)."""

from sb3_sample.ppo.mbma import MBMAPPO
from sb3_sample.ppo.mbpo import MBPOPPO
from sb3_sample.ppo.qma import QMAPPO
from sb3_sample.ppo.rewound import RewoundPPO
from sb3_sample.ppo.samples import Rollout, SimulatedSamples
from sb3_sample.ppo.simulated_ppo import ExtraSamplesPPO, SimulatedPPO

__all__ = [
    "MBMAPPO",
    "MBPOPPO",
    "QMAPPO",
    "ExtraSamplesPPO",
    "RewoundPPO",
    "Rollout",
    "SimulatedPPO",
    "SimulatedSamples",
]
