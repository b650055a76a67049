"""Sample-efficient reinforcement learning for users of Stable-Baselines3."""

from sb3_sample.diagnostics import DiagnosticsCallback
from sb3_sample.envs import EnvironmentDied, SupervisedSubprocVecEnv, make_env
from sb3_sample.faults import TrainingDiverged
from sb3_sample.ppo import MBMAPPO, MBPOPPO, QMAPPO
from sb3_sample.replay.buffers import DeviceReplayBuffer
from sb3_sample.replay.compact import CompactDictReplayBuffer, CompactReplayBuffer
from sb3_sample.replay.dataset import Dataset
from sb3_sample.replay.recording import record
from sb3_sample.sac import (
    BC,
    BRO,
    BROTD3,
    DAC,
    GPLSAC,
    IQL,
    OAC,
    OPLSAC,
    SAC,
    SRSAC,
    TD3BC,
    TOPSAC,
    VPLSAC,
    BROFast,
    RegularizedSAC,
)
from sb3_sample.version import __version__

__all__ = [
    "BC",
    "BRO",
    "BROTD3",
    "DAC",
    "GPLSAC",
    "IQL",
    "MBMAPPO",
    "MBPOPPO",
    "OAC",
    "OPLSAC",
    "QMAPPO",
    "SAC",
    "SRSAC",
    "TD3BC",
    "TOPSAC",
    "VPLSAC",
    "BROFast",
    "CompactDictReplayBuffer",
    "CompactReplayBuffer",
    "Dataset",
    "DeviceReplayBuffer",
    "DiagnosticsCallback",
    "EnvironmentDied",
    "RegularizedSAC",
    "SupervisedSubprocVecEnv",
    "TrainingDiverged",
    "__version__",
    "make_env",
    "record",
]
