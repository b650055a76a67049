"""Tiny models, and a linear environment of which everything is known, that the tests of the on-policy family share."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.logger import Logger

from sb3_sample import MBMAPPO, MBPOPPO, QMAPPO, RewoundPPO
from sb3_sample.ppo import ExtraSamplesPPO
from sb3_sample.ppo.dynamics import Prediction
from tests.sac.common import vec

#: Arguments that make a model small and quick.
TINY: dict[str, Any] = dict(
    n_steps=16,
    batch_size=8,
    n_epochs=2,
    n_simulated=3,
    warm_up_until=0.0,
    policy_kwargs={"net_arch": [8]},
    device="cpu",
    seed=0,
)
TINY_MODELS: dict[type[ExtraSamplesPPO], dict[str, Any]] = {
    MBMAPPO: dict(dynamics_kwargs={"width": 8, "depth": 1}, simulation_horizon=4, dynamics_buffer_size=100),
    MBPOPPO: dict(dynamics_kwargs={"width": 8, "depth": 1}, simulation_horizon=4, dynamics_buffer_size=100),
    QMAPPO: dict(q_kwargs={"width": 8, "depth": 1}),
    RewoundPPO: dict(copies=4),
}
#: Those that simulate by something learned, and with the one that takes the environment itself.
ALGORITHMS: list[Any] = [MBMAPPO, QMAPPO, MBPOPPO]
EVERY: list[Any] = [*ALGORITHMS, RewoundPPO]


def arguments_of(cls: Any, arguments: dict[str, Any]) -> dict[str, Any]:
    """Arguments with ``n_simulated`` as the class has it; those of the further actions only where there are some."""
    if cls is not RewoundPPO:
        return arguments
    arguments = dict(arguments)
    n_simulated = arguments.pop("n_simulated", None)
    if n_simulated is not None:
        arguments.setdefault("n_actions", n_simulated + 1)
    if arguments.get("n_actions") == 1 and arguments.get("copies") == TINY_MODELS[RewoundPPO]["copies"]:
        del arguments["copies"]
    return arguments


def tiny(cls: Any = MBMAPPO, env: Any = None, policy: str = "MlpPolicy", **kwargs: Any) -> Any:
    """A tiny model; arguments given replace the tiny ones."""
    arguments = {**TINY, **TINY_MODELS[cls], **kwargs}
    return cls(policy, vec() if env is None else env, **arguments_of(cls, arguments))


def quiet(model: Any) -> Any:
    """The model with a logger that keeps what it is told."""
    model.set_logger(Logger(None, []))
    return model


def collected(model: Any, callback: Any = None) -> Any:
    """The model with one rollout and no update."""
    quiet(model)
    model.train = lambda: None
    model.learn(model.n_steps * model.n_envs, callback)
    del model.train
    return model


class Linear(gym.Env):
    """
    ``s' = A s + B a`` and ``r = c s + d a``, without end.

    :param bound: of the actions
    """

    A = np.array([[0.9, 0.2], [-0.1, 0.8]])
    B = np.array([[0.1], [0.5]])
    c = np.array([1.0, -0.5])
    d = np.array([0.3])

    def __init__(self, bound: float = 64.0):
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Box(-bound, bound, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.state = self.np_random.normal(size=2)
        return self.state.astype(np.float32), {}

    def step(self, action: np.ndarray) -> Any:
        reward = float(self.c @ self.state + self.d @ action)
        self.state = self.A @ self.state + self.B @ action
        return self.state.astype(np.float32), reward, False, False, {}


class TrueModel:
    """
    The linear environment in place of the learned model.

    :param quadratic: whether the reward is ``-|s|^2 - a^2`` instead
    :param continues: probability that an episode goes on, None if episodes do not end
    """

    #: What an action in the models' units is multiplied by: the bound of the action space.
    scale = 64.0

    def __init__(self, quadratic: bool = False, continues: float | None = None):
        self.quadratic, self.continues = quadratic, continues
        self.A, self.B, self.c, self.d = (
            torch.as_tensor(x, dtype=torch.float32) for x in (Linear.A, Linear.B, Linear.c, Linear.d)
        )

    def predict(self, observations: torch.Tensor, actions: torch.Tensor) -> Prediction:
        actions = self.scale * actions
        rewards = observations @ self.c + actions @ self.d
        if self.quadratic:
            rewards = -observations.square().sum(dim=1) - actions.square().sum(dim=1)
        continues = None if self.continues is None else torch.full_like(rewards, self.continues)
        return Prediction(observations @ self.A.T + actions @ self.B.T, rewards, continues)


#: The policy's mean is GAIN s + OFFSET.
GAIN = np.array([[-0.4, 0.3]])
OFFSET = np.array([0.2])


def linear_model(
    cls: Any = MBMAPPO,
    value: tuple[np.ndarray, float] = (np.zeros(2), 0.0),
    log_std: float = -0.5,
    bound: float = 64.0,
    model: TrueModel | None = None,
    **kwargs: Any,
) -> Any:
    """A model with a linear policy and critic, and the true environment for a model."""
    arguments: dict[str, Any] = dict(policy_kwargs={"net_arch": [], "log_std_init": log_std}, gamma=0.9)
    agent = tiny(cls, Linear(bound), **{**arguments, **kwargs})
    with torch.no_grad():
        agent.policy.action_net.weight.copy_(torch.as_tensor(GAIN))
        agent.policy.action_net.bias.copy_(torch.as_tensor(OFFSET))
        agent.policy.value_net.weight.copy_(torch.as_tensor(value[0])[None])
        agent.policy.value_net.bias.fill_(value[1])
    if cls is not QMAPPO:
        agent.dynamics = TrueModel() if model is None else model
        agent.dynamics.scale = bound
    return agent


def true_value(gamma: float) -> tuple[np.ndarray, float]:
    """The weights and the bias of the linear policy's value: ``V(s) = v s + v_0``."""
    closed = Linear.A + Linear.B @ GAIN
    v = np.linalg.solve(np.eye(2) - gamma * closed.T, Linear.c + GAIN.T @ Linear.d)
    v_0 = (Linear.d @ OFFSET + gamma * v @ Linear.B @ OFFSET) / (1 - gamma)
    return v, float(v_0)


def true_q(states: np.ndarray, actions: np.ndarray, gamma: float) -> np.ndarray:
    """Q of the linear policy for states (B, 2) and actions (B, 1)."""
    v, v_0 = true_value(gamma)
    following = states @ Linear.A.T + actions @ Linear.B.T
    return states @ Linear.c + actions @ Linear.d + gamma * (following @ v + v_0)
