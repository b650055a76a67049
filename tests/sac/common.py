"""Tiny environments and models that the tests of the off-policy family share."""

import re
from collections.abc import Callable, Collection, Iterable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.td3.policies import TD3Policy

from sb3_sample import BRO
from sb3_sample.learner.execution import old_torch
from sb3_sample.sac import (
    BRC,
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
from tests.sac.pixels import TINY_DRQ, Pictures

#: Of tests whose gradient step is compiled.
COMPILES = pytest.mark.skipif(old_torch() is not None, reason="compiling needs a newer torch")
#: Arguments that make a model small and quick.
TINY_BRO: dict[str, Any] = dict(
    model_size=(1, 8),
    n_quantiles=5,
    batch_size=8,
    learning_starts=10,
    buffer_size=500,
    replay_ratio=1,
    policy_kwargs={"actor_network_kwargs": {"width": 8, "n_blocks": 1}},
    exploration_kwargs={"network_kwargs": {"width": 8, "n_blocks": 1}},
    device="cpu",
)
TINY_RESIDUAL: dict[str, Any] = {f"{who}_network_kwargs": {"width": 8, "n_blocks": 1} for who in ("actor", "critic")}
TINY_SAC: dict[str, Any] = dict(
    batch_size=8,
    learning_starts=10,
    buffer_size=500,
    replay_ratio=1,
    policy_kwargs={"net_arch": [8, 8]},
    device="cpu",
)
#: FlashSAC's networks, made small.
TINY_FLASH: dict[str, Any] = {f"{who}_network_kwargs": {"width": 8, "n_blocks": 1} for who in ("critic", "actor")}


TINY_DR_Q: dict[str, Any] = dict(
    policy_kwargs={
        "net_arch": [8, 8], "encoder_width": 8, "state_embedding": 6, "action_embedding": 4, "pair_embedding": 6,
        "n_reward_atoms": 5,
    },
    target_update_interval=5,
)  # fmt: skip


#: Arguments of every algorithm that are of another kind than it takes: name, value, and what the error says.
WRONG_ARGUMENTS: list[tuple[str, Any, str]] = [
    ("policy", "FooPolicy", "policy must be one of .*'MlpPolicy'.* derived from .*, not 'FooPolicy'"),
    ("policy", 1, "policy must be one of .*, not 1"),
    ("policy", TD3Policy, "policy must be one of .*, not stable_baselines3.td3.policies.TD3Policy"),
    ("policy", "CnnPolicy", r"policy='CnnPolicy' needs images, .* not Box\(.*use 'MlpPolicy'"),
    ("policy", "MultiInputPolicy", r"policy='MultiInputPolicy' needs Dict observations, not Box\(.*use 'MlpPolicy'"),
    ("env", 1, "env must be an environment, a vectorised environment or the id of one, or None, not 1"),
    ("learning_rate", "3e-4", "learning_rate must be at least 0 and finite, or a schedule, not '3e-4'"),
    ("learning_rate", None, "learning_rate must .*, not None"),
    ("learning_rate", True, "learning_rate must .*, not True"),
    ("gamma", "0.9", r"gamma must lie in \[0, 1\], not '0.9'"),
    ("batch_size", 16.0, "batch_size must be an integer of at least 1, not 16.0"),
    ("n_steps", "8", "n_steps must be an integer of at least 1, not '8'"),
    ("stats_window_size", 0, "stats_window_size must be an integer of at least 1, not 0"),
    ("stats_window_size", 2.5, "stats_window_size must be an integer of at least 1, not 2.5"),
    ("verbose", "info", "verbose must be an integer of at least 0, not 'info'"),
    ("verbose", -1, "verbose must be an integer of at least 0, not -1"),
    ("seed", "7", r"seed must be an integer of at least 0 and at most \d+, or None, not '7'"),
    ("seed", -1, "seed must be .*, not -1"),
    ("seed", 1.0, "seed must be .*, not 1.0"),
    ("device", "gpu", "device must be 'auto', 'cpu', 'cuda' .*, not 'gpu'"),
    ("device", 1.5, "device must be .*, not 1.5"),
    ("device", None, "device must be .*, not None"),
    ("tensorboard_log", 1, "tensorboard_log must be the path of a folder, or None, not 1"),
    ("policy_kwargs", [("net_arch", [8])], r"policy_kwargs must be a dict, or None, not \[\("),
    ("policy_kwargs", "net_arch", "policy_kwargs must be a dict, or None, not 'net_arch'"),
    (
        "policy_kwargs",
        {"net_arhc": [64]},
        "policy_kwargs has 'net_arhc', which is no argument of .*Policy. Did you mean 'net_arch'",
    ),
    ("policy_kwargs", {"net_arch": "64"}, "net_arch must be a list of widths, .*, not '64'"),
    ("policy_kwargs", {"net_arch": 64}, "net_arch must be .*, not 64"),
    ("policy_kwargs", {"net_arch": [8.0]}, r"net_arch must be .*, not \[8.0\]"),
    ("policy_kwargs", {"net_arch": {"pi": [8], "xf": [8]}}, "net_arch must be .* 'pi' for the actor and '.f' for the"),
    (
        "policy_kwargs",
        {"optimizer_class": "adam"},
        r"\['optimizer_class'\] must be a class of Optimizer, .*, not 'adam'",
    ),
    ("policy_kwargs", {"optimizer_class": dict}, r"\['optimizer_class'\] must be .*, not <class 'dict'>"),
    ("policy_kwargs", {"optimizer_kwargs": 3}, r"\['optimizer_kwargs'\] must be a dict, or None, not 3"),
    ("policy_kwargs", {"activation_fn": "relu"}, r"\['activation_fn'\] must be a class of Module, .*, not 'relu'"),
    ("policy_kwargs", {"features_extractor_class": 1}, r"\['features_extractor_class'\] must be .*, not 1"),
]
#: Arguments of ``learn`` in the same way.
WRONG_ARGUMENTS_OF_LEARN: list[tuple[dict[str, Any], str]] = [
    ({"total_timesteps": -1}, "total_timesteps must be at least 0 and finite, not -1"),
    ({"total_timesteps": "100"}, "total_timesteps must be at least 0 and finite, not '100'"),
    ({"total_timesteps": float("nan")}, "total_timesteps must be at least 0 and finite, not nan"),
    ({"total_timesteps": float("inf")}, "total_timesteps must be at least 0 and finite, not inf"),
    ({"total_timesteps": None}, "total_timesteps must be at least 0 and finite, not None"),
    ({"log_interval": 0}, "log_interval must be an integer of at least 1, or None, not 0"),
    ({"tb_log_name": 1}, "tb_log_name must be a name, or None, not 1"),
    ({"callback": 1}, "callback must be a callback, a list of callbacks or a function, or None, not 1"),
    ({"checkpoint_freq": 500}, "checkpoint_freq=500 means nothing without checkpoint, the folder of the run"),
]


class Toy(gym.Env):
    """
    A short deterministic episode of ``length`` steps: the observation counts the steps, the reward is their number.

    :param obs_space: observation space, a small Box by default
    :param action_space: action space, [-1, 1]^2 by default
    :param length: steps an episode; it ends by a time limit if ``truncate``, else by termination
    :param truncate: how the episodes end
    :param poison: called with the total number of steps, observation and reward; returns what is given instead
    """

    def __init__(
        self,
        obs_space: spaces.Space | None = None,
        action_space: spaces.Space | None = None,
        length: int = 7,
        truncate: bool = False,
        poison: Callable[[int, Any, float], tuple[Any, float]] | None = None,
    ):
        self.observation_space = spaces.Box(-10, 10, (3,), np.float32) if obs_space is None else obs_space
        self.action_space = spaces.Box(-1, 1, (2,), np.float32) if action_space is None else action_space
        self.length, self.truncate, self.poison = length, truncate, poison
        self.t = self.total = 0
        #: every action received
        self.actions: list[np.ndarray] = []

    def _observation(self, space: spaces.Space) -> Any:
        if isinstance(space, spaces.Dict):
            return {key: self._observation(sub) for key, sub in space.items()}
        if isinstance(space, spaces.Discrete):
            return self.t % int(space.n)
        assert isinstance(space, spaces.Box)
        return np.full(space.shape, self.t, space.dtype)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return self._observation(self.observation_space), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.actions.append(np.array(action))
        self.t += 1
        self.total += 1
        observation, reward = self._observation(self.observation_space), float(self.t)
        if self.poison is not None:
            observation, reward = self.poison(self.total, observation, reward)
        over = self.t >= self.length
        return observation, reward, over and not self.truncate, over and self.truncate, {}


def vec(n_envs: int = 1, **kwargs: Any) -> DummyVecEnv:
    """A DummyVecEnv of monitored toys."""
    return DummyVecEnv([lambda: Monitor(Toy(**kwargs)) for _ in range(n_envs)])


def bro(env: Any = None, cls: type[BRO] = BRO, policy: str = "MlpPolicy", **kwargs: Any) -> BRO:
    """A tiny BRO; arguments given replace the tiny ones."""
    return cls(policy, vec() if env is None else env, **{"seed": 0, **TINY_BRO, **kwargs})


def sac(env: Any = None, cls: type[SAC] = SAC, policy: str = "MlpPolicy", **kwargs: Any) -> Any:
    """A tiny SAC, or an algorithm of its family on MLPs; arguments given replace the tiny ones."""
    return cls(policy, vec() if env is None else env, **{"seed": 0, **TINY_SAC, **kwargs})


def _maker(make: Callable[..., Any], cls: type[SAC], **defaults: Any) -> Callable[..., Any]:
    return lambda env=None, **kwargs: make(env, **{"cls": cls, **defaults, **kwargs})


def from_pixels(cls: type[SAC], **defaults: Any) -> Callable[..., Any]:
    """Maker of a tiny algorithm that learns from images, of flat observations drawn as pictures if there are none."""

    def make(env: Any = None, cls: type[SAC] = cls, policy: str = "CnnPolicy", **kwargs: Any) -> Any:
        env = vec() if env is None else DummyVecEnv([lambda: Monitor(gym.make(env))]) if isinstance(env, str) else env
        env = Pictures(env) if len(env.observation_space.shape or ()) == 1 else env
        return cls(policy, env, **{**TINY_SAC, **TINY_DRQ, **defaults, **kwargs})

    return make


#: Every algorithm, by its name: tiny, and with what it does happening within a few steps.
MAKERS: dict[str, Callable[..., Any]] = {
    "SAC": sac,
    "BRO": bro,
    "BROFast": _maker(bro, BROFast),
    "BROTD3": _maker(bro, BROTD3),
    "DAC": _maker(sac, DAC, reinitialize_every=25),
    "VPLSAC": _maker(sac, VPLSAC, validation_proportion=0.25, pessimism_learning_rate=1e-2),
    "SRSAC": _maker(sac, SRSAC, resets=20),
    "OAC": _maker(sac, OAC),
    "TOPSAC": _maker(sac, TOPSAC),
    "GPLSAC": _maker(sac, GPLSAC, pessimism_learning_rate=1e-2),
    "OPLSAC": _maker(sac, OPLSAC, pessimism_learning_rate=1e-2, segment_length=4),
    "IQL": _maker(sac, IQL),
    "TD3BC": _maker(sac, TD3BC),
    "SimBa": _maker(sac, SimBa, policy_kwargs=TINY_RESIDUAL),
    "SimbaV2": _maker(
        sac, SimbaV2, n_critics=2, value_head_kwargs={"n_atoms": 11}, policy_kwargs=TINY_RESIDUAL, learning_rate=1e-3
    ),
    "BRC": _maker(
        sac,
        BRC,
        critic_width=8,
        value_head_kwargs={"n_atoms": 21},
        policy_kwargs={"actor_network_kwargs": {"width": 8, "n_blocks": 1}},
    ),
    "RegularizedSAC": _maker(
        sac,
        RegularizedSAC,
        critic_regularization="gpl",
        network_regularization=("layer_norm", "spectral_norm", "weight_decay"),
        plasticity_regularization=("crelu", "redo", "resets", "sam"),
        redo_period=5,
    ),
    "DebiasedRQ": _maker(sac, DebiasedRQ, **TINY_DR_Q),
    "CrossQ": _maker(sac, CrossQ),
    "CrossQ+WN": _maker(sac, CrossQ, weight_norm=True),
    "XQC": _maker(sac, XQC),
    "FlashSAC": _maker(sac, FlashSAC, policy_kwargs=TINY_FLASH),
}
#: Those that learn from images, where observations are no vectors.
PIXEL_MAKERS: dict[str, Callable[..., Any]] = {
    "DrQ": from_pixels(DrQ),
    "DrQv2": from_pixels(DrQv2, noise_schedule=(1.0, 0.1, 20)),
}
#: One of each kind of part, for the slower tests.
REPRESENTATIVE = ["SAC", "BRO", "BROTD3", "DAC", "VPLSAC", "OPLSAC", "TOPSAC", "RegularizedSAC", "DebiasedRQ"]


def sampled(names: Iterable[str], sample: Collection[str] = REPRESENTATIVE) -> list[Any]:
    """Parameters of a test that all pass in the long tests, and a sample of them in the short ones."""
    return [name if name in sample else pytest.param(name, marks=pytest.mark.slow) for name in names]


def state(model: SAC) -> dict[str, torch.Tensor]:
    """A copy of every tensor that the model's file holds, optimizers' moments included."""
    flat: dict[str, torch.Tensor] = {}

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, torch.Tensor):
            flat[prefix] = value.detach().clone()
        elif isinstance(value, dict):
            for key, sub in value.items():
                walk(f"{prefix}/{key}", sub)
        elif isinstance(value, (list, tuple)):
            for i, sub in enumerate(value):
                walk(f"{prefix}/{i}", sub)
        elif isinstance(value, (int, float)):
            flat[prefix] = torch.tensor(float(value), dtype=torch.float64)

    for name, value in model.get_parameters().items():
        walk(name, value)
    if getattr(getattr(model, "learner", None), "schedule", None) is not None:
        # Each step sets the rates that it takes.
        flat = {name: value for name, value in flat.items() if not name.endswith("/lr")}
    return flat


def differing(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> list[str]:
    """Names of the tensors that are not equal bit for bit, or that only one of the two has."""
    return sorted(set(a) ^ set(b)) + sorted(k for k in set(a) & set(b) if not torch.equal(a[k], b[k]))


def taken_or_refused(load: Callable[[], Any], words: str) -> Any:
    """What ``load`` gives; None where it is refused with a ValueError whose message holds the words."""
    try:
        return load()
    except ValueError as error:
        message = str(error)
    assert re.search(words, message), message
    return None


def random_batch(model: SAC, n: int = 8, seed: int = 0) -> Any:
    """A batch of random transitions for a model with flat observations."""
    from sb3_sample.learner.batch import Batch

    g = torch.Generator().manual_seed(seed)
    assert model.observation_space.shape is not None
    shape, a = model.observation_space.shape, model.actor.action_dim

    def observations() -> torch.Tensor:
        if len(shape) == 3:
            return torch.randint(256, (n, *shape), generator=g, dtype=torch.uint8)
        return torch.randn(n, *shape, generator=g)

    return Batch(
        observations(),
        torch.rand(n, a, generator=g) * 2 - 1,
        observations(),
        (torch.rand(n, 1, generator=g) < 0.2).float(),
        torch.randn(n, 1, generator=g),
        model.gamma,
    )
