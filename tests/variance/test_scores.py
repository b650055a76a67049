"""Products and sums of gradients that are never written out, against the gradients written out."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import A2C, PPO, SAC

from sb3_sample.variance.scores import Scores, check_policy

T, K = 6, 3


class Spaces(gym.Env):
    def __init__(self, observation_space: gym.Space, action_space: gym.Space):
        self.observation_space, self.action_space = observation_space, action_space


def box(n: int) -> spaces.Box:
    return spaces.Box(-1, 1, (n,), np.float32)


MODELS: dict[str, dict[str, Any]] = {
    "gaussian": {"action": box(2)},
    "wide": {"action": box(1), "policy_kwargs": {"net_arch": [16, 8], "activation_fn": torch.nn.ReLU}},
    "linear": {"action": box(2), "policy_kwargs": {"net_arch": []}},
    "categorical": {"action": spaces.Discrete(3)},
    "multi-discrete": {"action": spaces.MultiDiscrete([2, 3])},
    "discrete observation": {"action": spaces.Discrete(2), "observation": spaces.Discrete(4)},
    "matrix observation": {"action": box(2), "observation": spaces.Box(-1, 1, (2, 3), np.float32)},
}


def model(action: gym.Space, observation: gym.Space | None = None, **kwargs: Any) -> PPO:
    env = Spaces(box(4) if observation is None else observation, action)
    return PPO("MlpPolicy", env, seed=0, device="cpu", **kwargs)


def samples(agent: PPO) -> tuple[np.ndarray, np.ndarray]:
    torch.manual_seed(0)
    agent.observation_space.seed(0)
    observations = np.stack([agent.observation_space.sample() for _ in range(T)])
    tensor = agent.policy.obs_to_tensor(observations)[0]
    with torch.no_grad():
        actions = np.stack([agent.policy.get_distribution(tensor).sample().numpy() for _ in range(K)], axis=1)
    return observations, actions


def explicit(agent: PPO, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Gradients of log pi by autograd, one by one, (T, K, P)."""
    gradients = []
    for t in range(T):
        tensor = agent.policy.obs_to_tensor(observations[t : t + 1])[0]
        for k in range(K):
            log_prob = agent.policy.get_distribution(tensor).log_prob(torch.as_tensor(actions[t : t + 1, k]))
            parts = torch.autograd.grad(log_prob.sum(), [*agent.policy.parameters()], allow_unused=True)
            gradients.append(torch.cat([part.flatten() for part in parts if part is not None]).double().numpy())
    return np.stack(gradients).reshape(T, K, -1)


@pytest.mark.parametrize("name", MODELS)
def test_products_and_sums(name: str) -> None:
    agent = model(**MODELS[name])
    check_policy(agent.policy)
    observations, actions = samples(agent)
    expected, scores = explicit(agent, observations, actions), Scores(agent.policy, observations, actions)
    np.testing.assert_allclose(scores.squared_norms(), (expected**2).sum(axis=2), rtol=1e-4)

    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, T, K))
    x, y = ((weights[..., None] * expected).sum(axis=1) for weights in (first, second))
    mine, other = scores.weighted(first), scores.weighted(second)
    np.testing.assert_allclose(mine.squared_norms(), (x**2).sum(axis=1), rtol=1e-4)
    products = [np.mean([x[i] @ y[i + lag] for i in range(T - lag)]) for lag in range(1, T)]
    np.testing.assert_allclose(mine.lagged_products(other, T - 1), products, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(mine.lagged_products(other, 2), products[:2], rtol=1e-4, atol=1e-4)
    # The order of the parameters is the layers', that of the explicit gradient the module's: the same numbers.
    np.testing.assert_allclose(np.sort(mine.mean()), np.sort(x.mean(axis=0)), rtol=1e-3, atol=1e-5)


def test_nothing_is_left_behind() -> None:
    agent = model(**MODELS["gaussian"])
    Scores(agent.policy, *samples(agent))
    assert all(parameter.grad is None for parameter in agent.policy.parameters())
    assert not any(module._forward_hooks for module in agent.policy.modules())


def test_policies_that_are_refused() -> None:
    with pytest.raises(TypeError, match="ActorCriticPolicy, .* not SACPolicy"):
        check_policy(SAC("MlpPolicy", Spaces(box(4), box(2)), buffer_size=1).policy)
    with pytest.raises(ValueError, match="use_sde must be False"):
        check_policy(model(box(2), use_sde=True).policy)
    recurrent = RecurrentPPO("MlpLstmPolicy", Spaces(box(4), box(2)), n_steps=8, batch_size=8)
    with pytest.raises(TypeError, match="policy must depend on the observation alone, and Recurrent.* does not"):
        check_policy(recurrent.policy)
    image = spaces.Box(0, 255, (3, 36, 36), np.uint8)
    with pytest.raises(ValueError, match=r"policy must be of linear layers.*cnn\.0\.weight"):
        check_policy(A2C("CnnPolicy", Spaces(image, spaces.Discrete(2)), device="cpu").policy)
    several = Spaces(spaces.Dict({"a": box(2), "b": box(1)}), box(2))
    with pytest.raises(ValueError, match="observations that are one array, not Dict"):
        check_policy(PPO("MultiInputPolicy", several, device="cpu").policy)
    norm = {"activation_fn": lambda: torch.nn.LayerNorm(64)}
    with pytest.raises(ValueError, match="policy must be of linear layers"):
        check_policy(model(box(2), policy_kwargs=norm).policy)
