"""Every algorithm with a replay buffer: tiny, with what it learns from, and with what it sees there."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from tests.sac.common import MAKERS, PIXEL_MAKERS, vec
from tests.sac.pixels import Pictures
from tests.srspr.common import Frames, tiny


def _srspr(env: Any = None, **kwargs: Any) -> Any:
    own: dict[str, Any] = {"learning_starts": 10, "replay_ratio": 1, "exploration_steps": 0}
    return tiny(env_of("SRSPR") if env is None else env, **{**own, **kwargs})


#: Every algorithm with a replay buffer, by its name.
OFF_POLICY: dict[str, Callable[..., Any]] = {**MAKERS, **PIXEL_MAKERS, "SRSPR": _srspr}
#: What the first metric of a gradient step is called.
LOSS: dict[str, str] = dict.fromkeys(OFF_POLICY, "train/critic_loss") | {"SRSPR": "train/loss"}


def env_of(maker: str, n_envs: int = 1) -> VecEnv:
    """Environments of the kind that the agents of a maker are made with."""
    if maker == "SRSPR":
        return DummyVecEnv([lambda: Monitor(Frames())] * n_envs)
    return Pictures(vec(n_envs)) if maker in PIXEL_MAKERS else vec(n_envs)


def seen_by(model: Any, n: int = 16) -> np.ndarray:
    """Observations drawn from a model's space, (n, ...), always the same."""
    space = copy.deepcopy(model.observation_space)
    space.seed(0)
    return np.stack([space.sample() for _ in range(n)])


def value_network(model: Any) -> Any:
    """What the first loss of a gradient step is of."""
    return model.policy.q_net if hasattr(model.policy, "q_net") else model.critic
