"""
The environments of the papers under short ids, registered with Gymnasium when this package is imported.

``dmc/<domain>-<task>-v0``, ``metaworld/<task>-v3`` and ``myosuite/<task>-v0``; the libraries behind them are imported
when an environment is made.
"""

from sb3_sample.envs.atari import make_atari_env
from sb3_sample.envs.multi_task import TaskEnv, multi_task_env
from sb3_sample.envs.registration import (
    ALL_IDS,
    DMC_IDS,
    METAWORLD_IDS,
    MYOSUITE_IDS,
    make_env,
    register_all,
    register_in_workers,
)
from sb3_sample.envs.suites import published_key
from sb3_sample.envs.workers import EnvironmentDied, SupervisedSubprocVecEnv

register_all()
register_in_workers()

__all__ = [
    "ALL_IDS",
    "DMC_IDS",
    "METAWORLD_IDS",
    "MYOSUITE_IDS",
    "EnvironmentDied",
    "SupervisedSubprocVecEnv",
    "TaskEnv",
    "make_atari_env",
    "make_env",
    "multi_task_env",
    "published_key",
]
