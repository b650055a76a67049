"""
The public interface for user-defined parts: everything here keeps its name, wherever it moves inside the package.

A part is a class, accepted where a name is: ``pessimism=``, ``exploration=``, ``value_head=``, ``reward_scale=``,
``batch_transforms=``, ``policy_kwargs=dict(critic_network=..., actor_network=...)``. A user-defined agent is a class
that declares its arguments by ``argument``. docs/parts.md says what each must define.
"""

from sb3_sample import kinds
from sb3_sample.constructor import argument
from sb3_sample.learner.augmentation import RandomShift
from sb3_sample.learner.batch import Batch, CriticStep, Extra, Noise
from sb3_sample.learner.categorical import VALUE_HEADS, CategoricalHead
from sb3_sample.learner.exploration import EXPLORATIONS, Exploration, OptimisticExploration
from sb3_sample.learner.heads import QuantileHead, ValueHead
from sb3_sample.learner.learner import Learner
from sb3_sample.learner.parts import Learning, Part
from sb3_sample.learner.pessimism import PESSIMISMS, LearnedPessimism, Pessimism, epistemic_std, pessimistic_value
from sb3_sample.learner.reward_scale import REWARD_SCALES, RewardScale
from sb3_sample.learner.target import bootstrap, td_target, values
from sb3_sample.learner.transforms import BatchTransform
from sb3_sample.networks import (
    NETWORKS,
    BatchNorm,
    BatchRenorm,
    EnsembleLayerNorm,
    EnsembleLinear,
    HiddenUnits,
    Network,
    UnitNorm,
    linear,
    project_weights,
)
from sb3_sample.optim import AdamW
from sb3_sample.replay.buffers import (
    DeviceReplayBuffer,
    DeviceValidationReplayBuffer,
    ValidationDictReplayBuffer,
    ValidationReplayBuffer,
)
from sb3_sample.replay.columns import Column, Step
from sb3_sample.replay.compact import CompactDictReplayBuffer, CompactReplayBuffer

__all__ = [
    "EXPLORATIONS",
    "NETWORKS",
    "PESSIMISMS",
    "REWARD_SCALES",
    "VALUE_HEADS",
    "AdamW",
    "Batch",
    "BatchNorm",
    "BatchRenorm",
    "BatchTransform",
    "CategoricalHead",
    "Column",
    "CompactDictReplayBuffer",
    "CompactReplayBuffer",
    "CriticStep",
    "DeviceReplayBuffer",
    "DeviceValidationReplayBuffer",
    "EnsembleLayerNorm",
    "EnsembleLinear",
    "Exploration",
    "Extra",
    "HiddenUnits",
    "LearnedPessimism",
    "Learner",
    "Learning",
    "Network",
    "Noise",
    "OptimisticExploration",
    "Part",
    "Pessimism",
    "QuantileHead",
    "RandomShift",
    "RewardScale",
    "Step",
    "UnitNorm",
    "ValidationDictReplayBuffer",
    "ValidationReplayBuffer",
    "ValueHead",
    "argument",
    "bootstrap",
    "epistemic_std",
    "kinds",
    "linear",
    "pessimistic_value",
    "project_weights",
    "td_target",
    "values",
]
