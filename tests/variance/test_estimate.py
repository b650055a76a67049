"""Estimates against the exact values of a tabular task."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_sample.envs import make_env
from sb3_sample.envs.states import save_state
from sb3_sample.variance.decomposition import Components
from sb3_sample.variance.estimate import Estimate, Interval, combine, estimate_components, jackknife
from sb3_sample.variance.returns import Agent, sample_returns
from tests.variance.common import GAMMA, Exact, Tabular, softmax_policy, tabular_model

T = 6
QUANTITIES: dict[str, Callable[[Components], np.ndarray]] = {
    "marginal variance": lambda c: c.marginal_variance,
    "marginal covariances": lambda c: c.marginal_covariance_sum(T),
    "policy variance": lambda c: c.policy_variance,
    "policy covariances": lambda c: c.policy_covariance_sum(T),
    "first covariance": lambda c: c.policy_covariance[..., 0],
    "variance": lambda c: c.variance(T, 2),
    "gain of an action": lambda c: c.gain_of_action(T),
    "gain of steps": lambda c: c.gain_of_steps(T, 1.0),
    "margin": lambda c: c.gain_of_steps(T, 1.0, 2) - c.gain_of_action(T, 2),
}


def tabular(limit: int | None = None, bandit: bool = False) -> gym.Env:
    env = Tabular(bandit=bandit)
    return env if limit is None else gym.wrappers.TimeLimit(env, limit)


def estimate(seed: int, n_rollouts: int, limit: int | None = None, bandit: bool = False, **kwargs: Any) -> Estimate:
    make = functools.partial(tabular, limit, bandit)
    arguments: dict[str, Any] = {"n_steps": T, "horizon": 3, "burn_in": 6 if limit is None else limit, **kwargs}
    return estimate_components(tabular_model(make()), make, n_rollouts=n_rollouts, seed=seed, **arguments)


def exact(limit: int | None = None, bandit: bool = False, baseline: bool = True) -> Components:
    parts = Exact(Tabular(bandit=bandit), softmax_policy(3, 2)[2], limit, baseline).components(T - 1)
    return Components(*(np.asarray(part) for part in parts))


@pytest.mark.parametrize(
    ("kwargs", "of_exact"),
    [
        ({}, {}),
        pytest.param({"baseline": False}, {"baseline": False}, marks=pytest.mark.slow),
        pytest.param({"n_actions": 3, "n_returns": 3}, {}, marks=pytest.mark.slow),
        ({"limit": 4}, {"limit": 4}),
        pytest.param({"bandit": True}, {"bandit": True}, marks=pytest.mark.slow),
    ],
    ids=["plain", "no baseline", "three actions and returns", "time limit", "bandit"],
)
def test_intervals_cover_the_exact_values(kwargs: dict[str, Any], of_exact: dict[str, Any]) -> None:
    result, truth = estimate(1, 60, **kwargs), exact(**of_exact)
    for name, quantity in QUANTITIES.items():
        # All of them together in 95 % (Bonferroni).
        interval = result.interval(quantity, confidence=1 - 0.05 / len(QUANTITIES))
        assert interval.low <= quantity(truth) <= interval.high, name
    assert result.n_rollouts == 60
    assert result.n_parameters == 8


@pytest.mark.slow
def test_intervals_are_narrow_enough_to_say_something() -> None:
    result, truth = estimate(0, 200), exact()
    for name in ("policy variance", "gain of steps", "margin"):
        interval, value = result.interval(QUANTITIES[name]), QUANTITIES[name](truth)
        assert interval.high - interval.low < abs(value), name


@pytest.mark.slow
@pytest.mark.parametrize("limit", [None, 4])
def test_coverage_is_95_percent(limit: int | None) -> None:
    n_seeds, truth = 80, exact(limit)
    covered = dict.fromkeys(QUANTITIES, 0)
    values: dict[str, list[float]] = {name: [] for name in QUANTITIES}
    for seed in range(n_seeds):
        result = estimate(seed, 60, limit)
        for name, quantity in QUANTITIES.items():
            interval = result.interval(quantity)
            covered[name] += interval.low <= quantity(truth) <= interval.high
            values[name].append(interval.value)
    for name, quantity in QUANTITIES.items():
        # A standard error is 0.024; variances of 60 rollouts are skewed, which takes as much off the coverage.
        assert covered[name] / n_seeds >= 0.87, name
        error = (np.mean(values[name]) - quantity(truth)) / (np.std(values[name], ddof=1) / np.sqrt(n_seeds))
        assert abs(error) < 3.5, name


@pytest.mark.slow
def test_noise_of_the_returns_adds_no_variance() -> None:
    # With one return for each action the square of Q keeps the noise's variance, and the policy's variance has it.
    truth = exact()
    biased, unbiased = (estimate(0, 200, n_returns=n, horizon=6) for n in (1, 2))
    quantity = QUANTITIES["policy variance"]
    assert biased.interval(quantity).low > 1.5 * truth.policy_variance
    assert unbiased.interval(quantity, 0.99).low <= truth.policy_variance <= unbiased.interval(quantity, 0.99).high


class Shaped(gym.Env):
    """
    Moves to where its action, of any shape, points.

    :param shape: shape of an action
    :param in_place: whether the observation is the environment's own array, which the next step changes
    """

    def __init__(self, shape: tuple[int, ...] = (2,), in_place: bool = False):
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = spaces.Box(-1, 1, shape, np.float32)
        self.in_place, self.x = in_place, np.zeros(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.x[:] = self.np_random.normal(size=2)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        assert action.shape == self.action_space.shape
        assert self.action_space.contains(action)
        self.x *= 0.9
        self.x += [action.flat[0], action.flat[-1]]
        return self._observation(), -float(self.x @ self.x), False, False, {}

    def _observation(self) -> np.ndarray:
        return self.x if self.in_place else self.x.copy()


def components_of(make: Callable[[], gym.Env]) -> Components:
    model = PPO("MlpPolicy", make(), seed=0, device="cpu", policy_kwargs={"net_arch": [4]}, gamma=0.9)
    return estimate_components(model, make, n_steps=5, n_rollouts=4, horizon=3, burn_in=2).components


@pytest.mark.parametrize("shape", [(2, 2), (1, 3), (2, 1), (3,)])
def test_actions_have_the_shape_of_their_space(shape: tuple[int, ...]) -> None:
    assert np.isfinite(components_of(functools.partial(Shaped, shape)).policy_variance)


def test_observations_that_are_changed_in_place() -> None:
    copied, in_place = (components_of(functools.partial(Shaped, in_place=each)) for each in (False, True))
    for name, values in vars(copied).items():
        np.testing.assert_array_equal(getattr(in_place, name), values, err_msg=name)


def test_lags_beyond_max_lag_are_zero() -> None:
    result = estimate(0, 10, max_lag=2)
    assert result.components.max_lag == 2
    full = estimate(0, 10)
    np.testing.assert_allclose(result.components.policy_covariance, full.components.policy_covariance[:2])


def test_the_jackknife_of_a_mean_is_its_students_interval() -> None:
    values = np.random.default_rng(0).normal(size=12)
    left_out = (values.sum() - values) / 11

    def with_variance(variance: np.ndarray) -> Components:
        return Components(variance, variance[..., None], variance, variance[..., None])

    result = Estimate(with_variance(np.asarray(values.mean())), with_variance(left_out), 0.0, 1)
    interval = result.interval(lambda c: c.policy_variance)
    half = 2.200985 * values.std(ddof=1) / np.sqrt(12)
    assert interval == pytest.approx(Interval(values.mean(), values.mean() - half, values.mean() + half), rel=1e-5)


def test_a_confidence_in_percent_is_refused() -> None:
    for confidence in (95, 1.0, 0.0, float("nan")):
        with pytest.raises(ValueError, match=f"confidence must be between 0 and 1, not {confidence}"):
            jackknife(1.0, np.arange(4.0), confidence)


def test_replicates_are_the_estimates_without_a_rollout(monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_sample.variance import estimate as module

    kept: list[Any] = []
    monkeypatch.setattr(module, "combine", lambda moments: kept.extend(moments) or combine(moments))
    result = estimate(0, 6)
    without = combine(kept[:2] + kept[3:]).components
    for name in ("marginal_variance", "marginal_covariance", "policy_variance", "policy_covariance"):
        np.testing.assert_allclose(getattr(result.replicates, name)[2], getattr(without, name))


def test_the_seed_fixes_the_estimate_and_nothing_else_is_touched() -> None:
    model, np_state = tabular_model(tabular()), np.random.get_state()[1].copy()
    torch.manual_seed(7)
    expected = torch.rand(1)
    torch.manual_seed(7)
    first, second, third = (
        estimate_components(model, tabular, n_steps=T, n_rollouts=4, horizon=3, burn_in=6, seed=seed)
        for seed in (0, 0, 1)
    )
    assert torch.rand(1) == expected
    np.testing.assert_array_equal(np.random.get_state()[1], np_state)
    assert first.components.policy_variance == second.components.policy_variance
    np.testing.assert_array_equal(first.components.marginal_covariance, second.components.marginal_covariance)
    assert first.components.policy_variance != third.components.policy_variance


@pytest.mark.slow
def test_returns_are_unbiased_for_any_horizon() -> None:
    env, (_, _, policy) = Tabular(), softmax_policy(3, 2)
    truth = Exact(env, policy)
    agent = Agent(tabular_model(env))
    env.reset(seed=0)
    env.state = 1
    torch.manual_seed(0)
    state, rng, copies = save_state(env), np.random.default_rng(0), [Tabular() for _ in range(8)]
    for horizon in (1, 4):
        returns = sample_returns(agent, copies, [state] * 4000, np.ones(4000, int), horizon, rng)
        assert abs(returns.mean() - truth.q[1, 1]) < 4 * returns.std() / np.sqrt(4000)


class Ending(Tabular):
    """The second step of an episode gives 1 and ends it."""

    def reset(self, **kwargs: Any) -> tuple[int, dict]:
        self.count = 0
        return super().reset(**kwargs)

    def step(self, action: Any) -> tuple[int, float, bool, bool, dict]:
        self.count += 1
        return super().step(action)[0], 1.0, self.count == 2, False, {}


def test_returns_at_the_end_of_an_episode() -> None:
    for env in (Ending(), gym.wrappers.TimeLimit(Tabular(), 2)):
        agent = Agent(tabular_model(env))
        env.reset(seed=0)
        state = save_state(env)
        [value] = sample_returns(agent, [env], [state], np.zeros(1, int), 5, np.random.default_rng(0))
        if isinstance(env, Ending):
            assert value == pytest.approx(1 + GAMMA)  # nothing follows
        else:
            tables: Any = env.unwrapped
            rewards = np.unique(tables.rewards)
            possible = [
                a + GAMMA * b + GAMMA**2 * v for a in rewards for b in rewards for v in agent.values(np.arange(3))
            ]
            assert np.min(np.abs(np.array(possible) - value)) < 1e-5  # the critic's value at the time limit


def test_normalized_observations_and_rewards() -> None:
    venv = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    model = PPO("MlpPolicy", venv, n_steps=64, seed=0, device="cpu").learn(64)
    agent = Agent(model)
    observation = np.array([[1.0, 0.0, 5.0]], np.float32)
    np.testing.assert_array_equal(agent.normalize_observations(observation), venv.normalize_obs(observation))
    reward = agent.normalize_rewards(np.array([-3.0]))
    assert reward == venv.normalize_reward(np.array([-3.0])) != -3.0
    statistics = venv.obs_rms.mean.copy()
    estimate_components(model, lambda: gym.make("Pendulum-v1"), n_steps=4, n_rollouts=3, horizon=2, burn_in=2)
    np.testing.assert_array_equal(venv.obs_rms.mean, statistics)


def test_a_dmc_task() -> None:
    make = functools.partial(make_env, "dmc/cartpole-swingup-v0", action_repeat=4)
    model, counted = PPO("MlpPolicy", make(), seed=0, device="cpu"), []
    result = estimate_components(
        model, make, n_steps=8, n_rollouts=3, horizon=1, n_returns=1, burn_in=2, n_envs=2, on_rollout=counted.append
    )
    assert counted == [1, 2, 3]
    assert result.n_parameters == 5 * 64 + 64 + 64 * 64 + 64 + 64 + 2
    assert result.components.policy_variance > 0
    assert result.components.marginal_covariance.shape == (7,)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_steps": 1}, "n_steps .* at least 2, not 1"),
        ({"n_rollouts": 2}, "n_rollouts .* at least 3, not 2"),
        ({"n_actions": 1}, "n_actions .* at least 2, not 1"),
        ({"n_returns": 0}, "n_returns .* at least 1, not 0"),
        ({"horizon": 2.5}, "horizon .* whole number .* not 2.5"),
        ({"max_lag": 0}, "max_lag .* at least 1, not 0"),
        ({"max_lag": 6}, "max_lag must be below n_steps, which is 6, not 6"),
        ({"burn_in": -1}, "burn_in .* at least 0, not -1"),
        ({"n_envs": True}, "n_envs .* not True"),
    ],
)
def test_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        estimate(0, **{"n_rollouts": 3, **kwargs})


def test_a_negative_seed() -> None:
    with pytest.raises(ValueError, match="seed .* at least 0, not -1"):
        estimate(-1, 3)


def test_models_and_environments_that_do_not_fit() -> None:
    with pytest.raises(TypeError, match="model must be a PPO or A2C, .* not SAC"):
        estimate_components(SAC("MlpPolicy", "Pendulum-v1", buffer_size=1), tabular)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="observation_space Box.*but the model has Discrete"):
        estimate_components(tabular_model(tabular()), lambda: gym.make("CartPole-v1"))
    shared = tabular()
    with pytest.raises(ValueError, match="make_env must make a new environment each time it is called"):
        estimate_components(tabular_model(tabular()), lambda: shared)
    with pytest.raises(ValueError, match="env must be an environment whose state can be saved and restored"):
        estimate_components(tabular_model(tabular()), Hidden)


class Hidden(Tabular):
    """Keeps its state where nobody finds it, as an environment does that runs in another process."""

    def step(self, action: Any) -> tuple[int, float, bool, bool, dict]:
        self.simulator = getattr(self, "simulator", None) or iter(range(10**6))
        return next(self.simulator) % 3, 0.0, False, False, {}
