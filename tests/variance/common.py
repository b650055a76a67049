"""
A tabular task, all of whose gradients and covariances can be written down, and the same by enumeration of all paths.

Nothing in here uses the package: it is what the package is compared with.
"""

import functools
import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO

GAMMA = 0.8


class Tabular(gym.Env):
    """
    S states, A actions, random transitions and rewards, no end; a wrapper may set a time limit.

    :param n_states: S
    :param n_actions: A
    :param bandit: whether the next state depends on neither state nor action
    :param seed: of the tables
    """

    def __init__(self, n_states: int = 3, n_actions: int = 2, bandit: bool = False, seed: int = 0):
        rng = np.random.default_rng(seed)
        #: P(s' | s, a), (S, A, S), far from uniform so that what happens depends on the actions
        self.kernel = rng.dirichlet(np.full(n_states, 0.3), size=(n_states, n_actions))
        self.start = rng.dirichlet(np.ones(n_states))
        if bandit:
            self.kernel[:] = self.start
        #: (S, A)
        self.rewards = rng.normal(size=(n_states, n_actions))
        self.observation_space = spaces.Discrete(n_states)
        self.action_space = spaces.Discrete(n_actions)
        self.state = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict]:
        super().reset(seed=seed)
        self.state = int(self.np_random.choice(len(self.start), p=self.start))
        return self.state, {}

    def step(self, action: Any) -> tuple[int, float, bool, bool, dict]:
        reward = float(self.rewards[self.state, int(action)])
        self.state = int(self.np_random.choice(len(self.start), p=self.kernel[self.state, int(action)]))
        return self.state, reward, False, False, {}


class Exact:
    """
    What there is to know of a policy in a ``Tabular``, by linear algebra.

    :param env: task
    :param policy: pi(a | s), (S, A)
    :param limit: steps of an episode; None for one that never ends
    :param baseline: whether Y is (Q - V) grad log pi instead of Q grad log pi
    """

    def __init__(self, env: Tabular, policy: np.ndarray, limit: int | None = None, baseline: bool = False):
        n_states, n_actions = policy.shape
        # A time limit makes the step of the episode a part of the state: (step, s) is number step * S + s.
        n_phases = 1 if limit is None else limit
        self.n, self.policy = n_phases * n_states, np.tile(policy, (n_phases, 1))
        self.kernel = np.zeros((self.n, n_actions, self.n))
        for phase, s in itertools.product(range(n_phases), range(n_states)):
            following = (phase + 1) % n_phases
            ends = limit is not None and following == 0
            to = slice(following * n_states, (following + 1) * n_states)
            self.kernel[phase * n_states + s, :, to] = env.start if ends else env.kernel[s]
        self.chain = np.einsum("sa,sat->st", self.policy, self.kernel)
        self.stationary = self._stationary()
        # The values are those of the task without its limit, as the critic's are.
        chain = np.einsum("sa,sat->st", policy, env.kernel)
        self.values = np.linalg.solve(np.eye(n_states) - GAMMA * chain, (policy * env.rewards).sum(axis=1))
        self.q = env.rewards + GAMMA * env.kernel @ self.values
        weights = self.q - self.values[:, None] * baseline
        # Gradients of log softmax of a linear layer on one-hot states: (1[a] - pi) at the state's column, and the bias.
        y = np.zeros((n_states, n_actions, n_actions * (n_states + 1)))
        for s, a in itertools.product(range(n_states), range(n_actions)):
            direction = np.eye(n_actions)[a] - policy[s]
            y[s, a] = weights[s, a] * np.outer(direction, [*np.eye(n_states)[s], 1.0]).ravel()
        self.y = np.tile(y, (n_phases, 1, 1))

    def _stationary(self) -> np.ndarray:
        system = np.vstack([self.chain.T - np.eye(self.n), np.ones(self.n)])
        return np.linalg.lstsq(system, np.array([0.0] * self.n + [1.0]), rcond=None)[0]

    def components(self, max_lag: int) -> tuple[float, np.ndarray, float, np.ndarray]:
        """In the order of ``Components``."""
        mean_y = np.einsum("sa,sap->sp", self.policy, self.y)
        mean = self.stationary @ mean_y
        marginal, policy = [], []
        later = mean_y  # the mean of Y at the state t - 1 steps after a state
        for _ in range(max_lag):
            after = np.einsum("sat,tp->sap", self.kernel, later)  # ... t steps after a state and action
            later = self.chain @ later
            marginal.append(self.stationary @ (mean_y * later).sum(axis=1) - mean @ mean)
            products = ((self.y - mean_y[:, None]) * after).sum(axis=2)
            policy.append(self.stationary @ (self.policy * products).sum(axis=1))
        variances = (self.policy * ((self.y - mean_y[:, None]) ** 2).sum(axis=2)).sum(axis=1)
        return (
            float(self.stationary @ (mean_y**2).sum(axis=1) - mean @ mean),
            np.array(marginal),
            float(self.stationary @ variances),
            np.array(policy),
        )

    def enumerated_variance(self, n_steps: int, n_actions: int, discount: float = 1.0) -> float:
        """
        Trace of the covariance of the gradient of equation 3, by all states and actions of all paths.

        :param n_steps: T
        :param n_actions: N
        :param discount: gamma of equation 3's factor gamma^t
        """
        first, second = 0.0, 0.0
        for probability, gradient in self._paths(n_steps, n_actions, discount):
            first = first + probability * gradient
            second += probability * gradient @ gradient
        return float(second - np.sum(first**2))

    def _paths(self, n_steps: int, n_actions: int, discount: float) -> Any:
        choices = [*itertools.product(range(self.policy.shape[1]), repeat=n_actions)]
        # (probability, last state, its executed action, sum of gradients)
        paths: list[Any] = [(p, s, 0.0) for s, p in enumerate(self.stationary) if p > 0]
        for t in range(n_steps):
            extended = []
            for probability, s, total in paths:
                for actions in choices:
                    p = probability * float(np.prod(self.policy[s, list(actions)]))
                    gradient = total + discount**t * self.y[s, list(actions)].mean(axis=0) / n_steps
                    if t == n_steps - 1:
                        extended.append((p, None, gradient))
                    else:
                        extended += [
                            (p * q, successor, gradient)
                            for successor, q in enumerate(self.kernel[s, actions[0]])
                            if q > 0
                        ]
            paths = extended
        return ((probability, gradient) for probability, _, gradient in paths)


@functools.cache
def softmax_policy(n_states: int, n_actions: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights (A, S), bias (A,) and pi(a | s), (S, A), of a linear softmax policy."""
    rng = np.random.default_rng(seed)
    weights, bias = rng.normal(size=(n_actions, n_states)), rng.normal(size=n_actions)
    logits = weights.T + bias
    policy = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    return weights, bias, policy


def tabular_model(env: gym.Env) -> PPO:
    """``PPO`` with the policy of ``softmax_policy`` and the exact values as its critic."""
    tabular: Any = env.unwrapped
    n_states, n_actions = tabular.rewards.shape
    weights, bias, policy = softmax_policy(n_states, n_actions)
    model = PPO("MlpPolicy", env, gamma=GAMMA, policy_kwargs={"net_arch": []}, device="cpu")
    with torch.no_grad():
        model.policy.action_net.weight.copy_(torch.as_tensor(weights))
        model.policy.action_net.bias.copy_(torch.as_tensor(bias))
        model.policy.value_net.weight.copy_(torch.as_tensor(Exact(tabular, policy).values)[None])
        model.policy.value_net.bias.zero_()
    return model


class Regulator(gym.Env):
    """
    A linear-quadratic task in one dimension, quick to simulate and quick to learn a model of: keep x at 0.

    :param noise: standard deviation of what is added to x
    """

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Box(-10, 10, (1,), np.float32)

    def __init__(self, noise: float = 0.0):
        self.noise = noise
        self.x = 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.x = float(self.np_random.normal())
        return self._observation(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        reward = -(self.x**2) - 0.1 * float(action[0]) ** 2
        self.x = 0.9 * self.x + 0.3 * float(action[0]) + self.noise * float(self.np_random.normal())
        return self._observation(), reward, False, False, {}

    def _observation(self) -> np.ndarray:
        return np.array([self.x], np.float32)
