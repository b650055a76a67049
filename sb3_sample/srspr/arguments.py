"""Arguments of SR-SPR: what each is, and what it may be."""

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
    """Arguments of SR-SPR, those of Stable-Baselines3's ``DQN`` under the same names."""

    _policy: str | type[SPRPolicy] = argument(alias="policy", kw_only=False)
    """"CnnPolicy" or a policy class"""
    _env: gym.Env[Any, Any] | VecEnv | str | None = argument(alias="env", kw_only=False)
    """the environment, a vectorised environment, or an id; of an Atari game (``"ALE/Pong-v5"``) it is made with all its
    wrappers (``make_atari_env``). Observations are stacks of uint8 frames, (frame_stack * C, height, width), actions
    ``Discrete``"""
    learning_rate: float | Schedule = argument(default=1e-4, kind=LEARNING_RATE, kw_only=False)
    """a number or a function of the remaining progress (from 1 to 0)"""
    buffer_size: int = argument(default=200_000, kind=integer(1), kw_only=False)
    """capacity of the replay buffer in transitions, and ends of episodes"""
    learning_starts: int = argument(default=2_000, kind=integer(0), kw_only=False)
    """decisions at random before the first gradient step, counted over the model's life"""
    batch_size: int = argument(default=32, kind=integer(1), kw_only=False)
    """windows a gradient step"""
    tau: float = argument(default=0.005, kind=number("lie in (0, 1]", lambda value: 0 < value <= 1), kw_only=False)
    """weight of the network in the average that the target network is, each gradient step; in (0, 1]"""
    gamma: float = argument(default=0.99, kind=UNIT, kw_only=False)
    """discount factor"""
    _train_freq: int | tuple[int, str] | None = argument(alias="train_freq", default=None, kw_only=False)
    """as in Stable-Baselines3, every how many steps (or ``(n, "episode")``) to train; if given, with
    ``gradient_steps``, it replaces ``replay_ratio``"""
    _gradient_steps: int | None = argument(
        alias="gradient_steps",
        default=None,
        kind=Kind("be an integer of at least 0, or -1 for as many as transitions", integer(-1).fits),
        kw_only=False,
    )
    """as in Stable-Baselines3, gradient steps each time (-1: as many as transitions were collected); if given, it
    replaces ``replay_ratio``"""
    replay_buffer_class: type[ReplayBuffer] | None = argument(
        default=None, kind=subclass(SPRReplayBuffer).or_none(), kw_only=False
    )
    """class of the replay buffer; None for ``SPRReplayBuffer``"""
    _replay_buffer_kwargs: dict[str, Any] | None = argument(
        alias="replay_buffer_kwargs", default=None, kind=DICT, kw_only=False
    )
    """its arguments; ``memory_map="folder"`` keeps it in files"""
    optimize_memory_usage: bool = argument(default=False, kw_only=False)
    """the buffer stores each frame once anyway, and takes either value"""
    n_steps: int = argument(default=10, kind=integer(1), kw_only=False)
    """steps whose rewards a TD target sums"""
    replay_ratio: float | None = argument(default=2, kind=AT_LEAST_0.or_none())
    """gradient steps per decision after the warm-up, whatever the number of environments; may be below 1"""
    network: str = argument(default="nature", kind=Kind(f"be one of {list(NETWORKS)}", lambda value: value in NETWORKS))
    """what follows the encoder: "nature", the regular Q-network; "bronet", BroNet on the latent state (BRO, table 8),
    SPR's projection being its first layer; "bronet_after_projection", the projection, and BroNet on it"""
    noisy: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """whether projection and head have noisy layers, as SPR had and SR-SPR's published settings have not"""
    n_atoms: int = argument(default=51, kind=integer(2))
    """atoms of the distribution of returns"""
    v_min: float = argument(default=-10.0, kind=FINITE)
    """the lowest of them"""
    v_max: float = argument(default=10.0, kind=FINITE)
    """the highest of them"""
    n_predictions: int = argument(default=5, kind=integer(1))
    """steps whose latent states are predicted"""
    spr_weight: float = argument(default=5.0, kind=AT_LEAST_0)
    """weight of the predictions' loss beside the TD loss; 0 learns without it"""
    reset_interval: int | None = argument(default=20_000, kind=integer(1).or_none("no resets"))
    """decisions between two resets, over the model's life; the last is the one after which a whole interval is left.
    Projection, predictor and head start anew, target network and Adam too; the replay buffer stays"""
    shrink: float = argument(default=0.8, kind=number("lie in [0, 1]", lambda value: 0 <= value <= 1))
    """share of encoder and transition model that a reset leaves, the rest being a fresh draw (shrink and perturb)"""
    exploration_initial_eps: float = argument(default=1.0, kind=UNIT)
    """rate of random decisions until ``learning_starts``"""
    exploration_final_eps: float = argument(default=0.0, kind=UNIT)
    """rate of random decisions in the end"""
    exploration_steps: int = argument(default=2_001, kind=integer(0))
    """decisions after ``learning_starts`` in which the one becomes the other, linearly"""
    evaluation_eps: float = argument(default=0.001, kind=UNIT)
    """rate of random actions of ``predict`` with ``deterministic=False``"""
    frame_stack: int = argument(default=4, kind=integer(1))
    """frames that an observation consists of along its first axis, the newest last; each is stored once"""
    compile: bool | str = argument(
        default="auto", kind=Kind('be True, False or "auto"', lambda value: value in (True, False, "auto"))
    )
    """whether Inductor makes one program of the gradient step; "auto": where that pays back within the run. On a GPU
    the step is captured as a CUDA graph unless this is False"""
