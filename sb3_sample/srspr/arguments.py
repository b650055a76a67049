"""Arguments of SR-SPR: their meanings and allowed values."""

from typing import Any

import gymnasium as gym
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.constructor import argument
from sb3_sample.kinds import (
    AT_LEAST_0,
    DICT,
    FINITE,
    LEARNING_RATE,
    TRUE_OR_FALSE,
    UNIT,
    Kind,
    integer,
    number,
    subclass,
)
from sb3_sample.srspr.networks import NETWORKS
from sb3_sample.srspr.policies import SPRPolicy
from sb3_sample.srspr.replay import SPRReplayBuffer
from sb3_sample.training.resumable import Resumable


class SRSPRArguments(Resumable):
    """Arguments of SR-SPR; those of Stable-Baselines3's ``DQN`` have the same names."""

    _policy: str | type[SPRPolicy] = argument(alias="policy", kw_only=False)
    """"CnnPolicy" or a policy class"""
    _env: gym.Env[Any, Any] | VecEnv | str | None = argument(alias="env", kw_only=False)
    """the environment, a vectorised environment, or an id; an Atari game (``"ALE/Pong-v5"``) is made with all its
    wrappers (``make_atari_env``). Observations are stacks of uint8 frames, (frame_stack * C, height, width), actions
    ``Discrete``"""
    learning_rate: float | Schedule = argument(default=1e-4, kind=LEARNING_RATE, kw_only=False)
    """a number or a function of the remaining progress (from 1 to 0)"""
    buffer_size: int = argument(default=200_000, kind=integer(1), kw_only=False)
    """capacity of the replay buffer in transitions, where each end of an episode takes one more"""
    learning_starts: int = argument(default=2_000, kind=integer(0), kw_only=False)
    """decisions at random before the first gradient step, counted over the model's life"""
    batch_size: int = argument(default=32, kind=integer(1), kw_only=False)
    """windows per gradient step"""
    tau: float = argument(default=0.005, kind=number("lie in (0, 1]", lambda value: 0 < value <= 1), kw_only=False)
    """weight of the network in the Polyak average of the target network at each gradient step; in (0, 1]"""
    gamma: float = argument(default=0.99, kind=UNIT, kw_only=False)
    """discount factor"""
    _train_freq: int | tuple[int, str] | None = argument(alias="train_freq", default=None, kw_only=False)
    """as in Stable-Baselines3, number of steps, or ``(n, "episode")``, between two trainings; if given, it replaces
    ``replay_ratio``, together with ``gradient_steps``"""
    _gradient_steps: int | None = argument(
        alias="gradient_steps",
        default=None,
        kind=Kind("be an integer of at least 0, or -1 for as many as transitions", integer(-1).fits),
        kw_only=False,
    )
    """as in Stable-Baselines3, gradient steps per training (-1: one per collected transition); if given, it replaces
    ``replay_ratio``"""
    replay_buffer_class: type[ReplayBuffer] | None = argument(
        default=None, kind=subclass(SPRReplayBuffer).or_none(), kw_only=False
    )
    """class of the replay buffer; None for ``SPRReplayBuffer``"""
    _replay_buffer_kwargs: dict[str, Any] | None = argument(
        alias="replay_buffer_kwargs", default=None, kind=DICT, kw_only=False
    )
    """its arguments; ``memory_map="folder"`` keeps it in files"""
    optimize_memory_usage: bool = argument(default=False, kw_only=False)
    """no effect, since the buffer stores each frame once anyway"""
    n_steps: int = argument(default=10, kind=integer(1), kw_only=False)
    """steps whose rewards a TD target sums"""
    replay_ratio: float | None = argument(default=2, kind=AT_LEAST_0.or_none())
    """gradient steps per decision after the warm-up, whatever the number of environments; may be below 1"""
    network: str = argument(default="nature", kind=Kind(f"be one of {list(NETWORKS)}", lambda value: value in NETWORKS))
    """network after the encoder: "nature", the regular Q-network; "bronet", BroNet on the latent state (BRO, table 8),
    with SPR's projection as its first layer; "bronet_after_projection", the projection, followed by BroNet"""
    noisy: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """whether projection and head have noisy layers, as in SPR but not in SR-SPR's published settings"""
    n_atoms: int = argument(default=51, kind=integer(2))
    """atoms of the distribution of returns"""
    v_min: float = argument(default=-10.0, kind=FINITE)
    """the lowest atom"""
    v_max: float = argument(default=10.0, kind=FINITE)
    """the highest atom"""
    n_predictions: int = argument(default=5, kind=integer(1))
    """number of future steps whose latent states are predicted"""
    spr_weight: float = argument(default=5.0, kind=AT_LEAST_0)
    """weight of the prediction loss relative to the TD loss; 0 learns without it"""
    reset_interval: int | None = argument(default=20_000, kind=integer(1).or_none("no resets"))
    """decisions between two resets, over the model's life; there is no reset unless a whole interval is left after it.
    Projection, predictor and head are reinitialised, in the target network too, and so is Adam's state; the replay
    buffer stays"""
    shrink: float = argument(default=0.8, kind=number("lie in [0, 1]", lambda value: 0 <= value <= 1))
    """share of encoder and transition model that a reset keeps, mixed with a fresh initialisation (shrink and
    perturb)"""
    exploration_initial_eps: float = argument(default=1.0, kind=UNIT)
    """rate of random decisions until ``learning_starts``"""
    exploration_final_eps: float = argument(default=0.0, kind=UNIT)
    """final rate of random decisions"""
    exploration_steps: int = argument(default=2_001, kind=integer(0))
    """decisions after ``learning_starts`` over which the rate changes linearly from initial to final"""
    evaluation_eps: float = argument(default=0.001, kind=UNIT)
    """rate of random actions of ``predict`` with ``deterministic=False``"""
    frame_stack: int = argument(default=4, kind=integer(1))
    """number of frames in an observation along its first axis, the newest last; each is stored once"""
    compile: bool | str = argument(
        default="auto", kind=Kind('be True, False or "auto"', lambda value: value in (True, False, "auto"))
    )
    """whether Inductor compiles the gradient step; "auto": if that pays off within the run. On a GPU the step is
    captured as a CUDA graph unless this is False"""
