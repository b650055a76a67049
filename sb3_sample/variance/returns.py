"""Q-values of actions at visited states: the environment is rewound to the state and the policy continues there."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_sample.envs.rewinding import rewound_returns
from sb3_sample.envs.states import EnvState
from sb3_sample.saving.normalization import lacks_vec_normalize
from sb3_sample.variance.scores import check_policy
from sb3_sample.warn import warn


class Agent:
    """
    Interface to a model: samples of its policy, its critic, and the units in which it learns.

    :param model: a ``PPO`` or ``A2C``, or a subclass. The statistics of a ``VecNormalize`` around its environment are
        used unchanged
    :raises TypeError: ``model`` is of another family
    :raises ValueError: its policy is of a kind that :func:`~sb3_sample.variance.scores.check_policy` rejects, or it has
        learned in a ``VecNormalize`` and now has no environment
    """

    def __init__(self, model: OnPolicyAlgorithm):
        if not isinstance(model, OnPolicyAlgorithm):
            raise TypeError(f"model must be a PPO or A2C, or a subclass, not {type(model).__name__}")
        check_policy(model.policy)
        self.model = model
        self.policy: Any = model.policy
        self.gamma = model.gamma
        self._normalize = model.get_vec_normalize_env()
        if lacks_vec_normalize(model):
            message = (
                "model has learned in a VecNormalize, without whose statistics its policy sees other numbers than it "
                "knows: load it with env=VecNormalize.load(...), on the command line with --vecnormalize"
            )
            if model.env is None:
                raise ValueError(message)
            # Its training may have continued in an environment without one.
            warn(message)

    def normalize_observations(self, observations: np.ndarray) -> np.ndarray:
        """
        :param observations: the environment's, (B, ...)
        :return: the policy's, (B, ...)
        """
        return observations if self._normalize is None else np.asarray(self._normalize.normalize_obs(observations))

    def normalize_rewards(self, rewards: np.ndarray) -> np.ndarray:
        """
        :param rewards: the environment's, (B,)
        :return: the critic's, (B,)
        """
        return rewards if self._normalize is None else self._normalize.normalize_reward(rewards)

    def sample(self, observations: np.ndarray) -> np.ndarray:
        """
        :param observations: the environment's, (B, ...)
        :return: actions as the policy samples them, with torch's global generator, (B, ...)
        """
        with torch.no_grad():
            return self.policy.get_distribution(self._tensor(observations)).sample().cpu().numpy()

    def values(self, observations: np.ndarray) -> np.ndarray:
        """
        :param observations: the environment's, (B, ...)
        :return: the critic's values, (B,)
        """
        with torch.no_grad():
            # Not every device has float64.
            return self.policy.predict_values(self._tensor(observations)).flatten().cpu().double().numpy()

    def to_env(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: from :meth:`sample`, (B, ...)
        :return: actions for the environment, as in ``OnPolicyAlgorithm.collect_rollouts``: in the shape of the space
            and clipped to it
        """
        space = self.model.action_space
        if not isinstance(space, spaces.Box):
            return actions
        return np.clip(actions.reshape(-1, *space.shape), space.low, space.high)

    def _tensor(self, observations: np.ndarray) -> Any:
        return self.policy.obs_to_tensor(self.normalize_observations(observations))[0]


def sample_returns(
    agent: Agent,
    envs: Sequence[gym.Env],
    states: Sequence[EnvState],
    actions: np.ndarray,
    horizon: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """
    Draw one sample of Q(s, a) for each state and action: the discounted rewards of the action and of the policy after
    it, bootstrapped with the critic's value after ``horizon`` steps or at a time limit.

    :param agent: policy and critic
    :param envs: environments to restore the states in, as many as are to be stepped side by side
    :param states: B states
    :param actions: as the policy samples them, (B, ...)
    :param horizon: steps, at least 1
    :param rng: generator for the randomness in the environments after the states
    :return: (B,)
    """
    return rewound_returns(agent, envs, states, actions, [horizon] * len(states), rng)[0]
