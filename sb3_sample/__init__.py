"""Sample-efficient reinforcement learning for users of Stable-Baselines3."""

from sb3_sample.diagnostics import DiagnosticsCallback, NoiseScaleCallback
from sb3_sample.envs import EnvironmentDied, SupervisedSubprocVecEnv, make_atari_env, make_env, multi_task_env
from sb3_sample.faults import TrainingDiverged
from sb3_sample.ppo import MBMAPPO, MBPOPPO, QMAPPO, RewoundPPO
from sb3_sample.replay.buffers import DeviceReplayBuffer
from sb3_sample.replay.compact import CompactDictReplayBuffer, CompactNStepReplayBuffer, CompactReplayBuffer
from sb3_sample.replay.dataset import Dataset
from sb3_sample.replay.recording import record
from sb3_sample.replay.weighted import (
    FadedDictReplayBuffer,
    FadedReplayBuffer,
    PrioritizedDictReplayBuffer,
    PrioritizedReplayBuffer,
    WindowDictReplayBuffer,
    WindowReplayBuffer,
)
from sb3_sample.sac import (
    BC,
    BRC,
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
    XQC,
    BROFast,
    CrossQ,
    DebiasedRQ,
    DrQ,
    DrQv2,
    FlashSAC,
    RegularizedSAC,
    SimBa,
    SimbaV2,
)
from sb3_sample.sac.encoders import ConvEncoder
from sb3_sample.sac.many import train_many
from sb3_sample.srspr import SRSPR
from sb3_sample.training.task_evaluation import MultiTaskEvalCallback, evaluate_tasks
from sb3_sample.version import __version__

__all__ = [
    "BC",
    "BRC",
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
    "SRSPR",
    "TD3BC",
    "TOPSAC",
    "VPLSAC",
    "XQC",
    "BROFast",
    "CompactDictReplayBuffer",
    "CompactNStepReplayBuffer",
    "CompactReplayBuffer",
    "ConvEncoder",
    "CrossQ",
    "Dataset",
    "DebiasedRQ",
    "DeviceReplayBuffer",
    "DiagnosticsCallback",
    "DrQ",
    "DrQv2",
    "EnvironmentDied",
    "FadedDictReplayBuffer",
    "FadedReplayBuffer",
    "FlashSAC",
    "MultiTaskEvalCallback",
    "NoiseScaleCallback",
    "PrioritizedDictReplayBuffer",
    "PrioritizedReplayBuffer",
    "RegularizedSAC",
    "RewoundPPO",
    "SimBa",
    "SimbaV2",
    "SupervisedSubprocVecEnv",
    "TrainingDiverged",
    "WindowDictReplayBuffer",
    "WindowReplayBuffer",
    "__version__",
    "evaluate_tasks",
    "make_atari_env",
    "make_env",
    "multi_task_env",
    "record",
    "train_many",
]
