"""
Estimate the components of a policy gradient's variance from rollouts with further actions tried at every state.

Shapes: M rollouts, T states of each, K actions at each state (the first is carried out), R returns of each action,
L lags, P parameters.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import torch
from scipy.special import stdtrit
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.envs.states import check_restorable, save_state
from sb3_sample.kinds import is_integer
from sb3_sample.variance.decomposition import Components
from sb3_sample.variance.returns import Agent, sample_returns
from sb3_sample.variance.scores import Scores


class Interval(NamedTuple):
    """
    :param value: estimate
    :param low: lower bound of its confidence interval
    :param high: upper bound
    """

    value: float
    low: float
    high: float


class RolloutSamples(NamedTuple):
    """
    A rollout with several actions at each of its states.

    :param observations: as the policy gets them, (T, ...)
    :param actions: as the policy sampled them, (T, K, ...)
    :param returns: samples of their Q-values, minus the baseline, (T, K, R)
    """

    observations: np.ndarray
    actions: np.ndarray
    returns: np.ndarray


class Moments(NamedTuple):
    """
    A rollout's unbiased estimates of the products whose means make up the components. Y is as in
    :mod:`~sb3_sample.variance.decomposition`, <x, y> an inner product.

    :param squared: <Y, Y> of one action
    :param crossed: <Y, Y'> of two actions at the same state
    :param marginal_lagged: <Y', Y_t>, with Y' of an action that is not carried out and Y_t at the state t steps later,
        (L,)
    :param policy_lagged: <Y - Y', Y_t>, with Y of the action that is carried out, (L,)
    :param gradient: the mean of Y, (P,)
    """

    squared: float
    crossed: float
    marginal_lagged: np.ndarray
    policy_lagged: np.ndarray
    gradient: np.ndarray


@dataclass(frozen=True)
class Estimate:
    """
    Estimated components.

    :param components: the estimate
    :param replicates: the estimate without each of the M rollouts, for the jackknife; entries (M,) and (M, L)
    :param squared_gradient: squared length of the gradient, without the bias from noise
    :param n_parameters: P
    """

    components: Components
    replicates: Components
    squared_gradient: float
    n_parameters: int

    @property
    def n_rollouts(self) -> int:
        """M."""
        return len(self.replicates.policy_variance)

    def interval(self, quantity: Callable[[Components], np.ndarray], confidence: float = 0.95) -> Interval:
        """
        Confidence interval of a quantity by the jackknife over the rollouts, which are independent, with Student's t.

        :param quantity: function of components, with any leading axes, that returns one number for each
        :param confidence: nominal coverage probability of the interval
        :return: estimate and interval
        """
        left_out = np.asarray(quantity(self.replicates), dtype=float)
        return jackknife(float(quantity(self.components)), left_out, confidence)


def jackknife(value: float, left_out: np.ndarray, confidence: float = 0.95) -> Interval:
    """
    :param value: estimate from all M samples
    :param left_out: estimates without each of them, (M,)
    :param confidence: nominal coverage probability of the interval
    :return: estimate, and its interval by the jackknife with Student's t
    :raises ValueError: ``confidence`` is out of range
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, not {confidence!r}")
    m = len(left_out)
    deviation = math.sqrt((m - 1) / m * np.sum((left_out - left_out.mean()) ** 2))
    half = float(stdtrit(m - 1, 0.5 + confidence / 2)) * deviation
    return Interval(float(value), float(value) - half, float(value) + half)


def estimate_components(
    model: OnPolicyAlgorithm,
    make_env: Callable[[], gym.Env],
    n_steps: int = 128,
    n_rollouts: int = 16,
    n_actions: int = 2,
    n_returns: int = 2,
    horizon: int = 12,
    max_lag: int | None = None,
    burn_in: int | None = None,
    baseline: bool = True,
    seed: int = 0,
    n_envs: int = 16,
    on_rollout: Callable[[int], None] | None = None,
) -> Estimate:
    """
    Estimate the components of lemma 3.1 for a policy in an environment.

    Each of ``n_rollouts`` independent rollouts starts after a random number of steps from a reset, so that its states
    are those of a long run, and continues across the ends of episodes like PPO's. At each state ``n_actions`` actions
    are sampled; ``n_returns`` returns of each, from the restored state, are samples of its Q-value, independent of the
    rest of the rollout. No averaged product has the same noise in both factors, except for the square of Q, from which
    the variance of its noise is subtracted. So the noise of Q, which lemma 3.1 does not include (the paper averages it
    away with 100 returns of each action), widens the intervals, but does not bias the components.

    Most of the time goes into environment steps, about ``n_rollouts * n_steps * n_actions * n_returns * horizon``.

    :param model: a ``PPO`` or ``A2C``, or a subclass, which is not changed. Its critic ends the returns and is the
        baseline
    :param make_env: makes the environment; called ``n_envs + 1`` times, and has to make a new, equal one each time
    :param n_steps: T, steps of a rollout
    :param n_rollouts: M, at least 3. The intervals are taken over these independent rollouts, so that more rollouts
        narrow them in a way that longer rollouts would not
    :param n_actions: K, at least 2
    :param n_returns: R. 1 only if Q-values have no noise: deterministic environments with ``horizon=1``
    :param horizon: steps after which the critic's value ends a return
    :param max_lag: L, largest distance between two states whose covariance is measured, below ``n_steps``; covariances
        beyond it are taken to be 0. ``n_steps - 1`` if None
    :param burn_in: each rollout starts after ``burn_in`` to ``2 * burn_in - 1`` steps, all equally likely. None: the
        environment's time limit in steps, 1,000 if it has none. If all episodes have that length, every step of an
        episode is equally likely to be the first of a rollout
    :param baseline: whether the critic's value is subtracted from the returns. It changes the variance, not the
        gradient; MBMA, table 1, does without it
    :param seed: of everything random; the global generators are left unchanged
    :param n_envs: environments in which returns are sampled side by side
    :param on_rollout: called after each rollout, with the number of rollouts so far
    :return: estimate
    :raises TypeError: ``model`` or its policy is of another kind
    :raises ValueError: an argument is out of range, an environment does not fit the model, or its state cannot be
        saved and restored
    """
    agent = Agent(model)
    check_arguments(n_steps, n_rollouts, n_actions, n_returns, horizon, max_lag, burn_in, n_envs)
    check_counts({"seed": (seed, 0)})
    lags = n_steps - 1 if max_lag is None else max_lag
    env, *copies = [make_env() for _ in range(n_envs + 1)]
    try:
        if len({id(made.unwrapped) for made in (env, *copies)}) <= n_envs:
            raise ValueError(
                "make_env must make a new environment each time it is called, not give the same one again: "
                "returns are sampled in the copies while the rollout waits"
            )
        check_same_spaces(model, env)
        check_restorable(env, copies[0])
        rng = np.random.default_rng(seed)
        with seeded(model, int(rng.integers(2**31))):
            env.reset(seed=int(rng.integers(2**31)))
            sampler = _RolloutSampler(agent, env, copies, rng, n_actions, n_returns, horizon, baseline)
            steps = _episode_steps(env) if burn_in is None else burn_in
            moments = []
            for index in range(n_rollouts):
                rollout = sampler.sample(n_steps, steps)
                moments.append(rollout_moments(model, rollout, lags))
                if on_rollout is not None:
                    on_rollout(index + 1)
    finally:
        for made in (env, *copies):
            made.close()
    return combine(moments)


class _RolloutSampler:
    """Rollouts with further actions at each state; the arguments are those of :func:`estimate_components`."""

    def __init__(
        self,
        agent: Agent,
        env: gym.Env,
        copies: Sequence[gym.Env],
        rng: np.random.Generator,
        n_actions: int,
        n_returns: int,
        horizon: int,
        baseline: bool,
    ):
        self.agent, self.env, self.copies, self.rng = agent, env, copies, rng
        self.n_actions, self.n_returns, self.horizon, self.baseline = n_actions, n_returns, horizon, baseline

    def sample(self, n_steps: int, burn_in: int) -> RolloutSamples:
        """
        :param n_steps: T
        :param burn_in: least number of steps before the rollout
        :return: the rollout
        """
        agent = self.agent
        observation = self.env.reset()[0]
        for _ in range(burn_in + int(self.rng.integers(burn_in)) if burn_in else 0):
            observation = self._step(agent.sample(np.asarray(observation)[None]))
        all_observations, all_actions, all_returns = [], [], []
        states, pending = [], []
        # States wait until there is work for all copies of the environment.
        at_once = max(1, len(self.copies) // (self.n_actions * self.n_returns))
        for step in range(n_steps):
            actions = agent.sample(np.stack([observation] * self.n_actions))
            # A copy, since an environment may change its observation in place.
            all_observations.append(np.array(observation))
            all_actions.append(actions)
            states.append(save_state(self.env))
            pending.append(actions)
            if len(states) == at_once or step == n_steps - 1:
                repeats = self.n_actions * self.n_returns
                returns = sample_returns(
                    agent,
                    self.copies,
                    [state for state in states for _ in range(repeats)],
                    np.repeat(np.concatenate(pending), self.n_returns, axis=0),
                    self.horizon,
                    self.rng,
                )
                all_returns.append(returns.reshape(len(states), self.n_actions, self.n_returns))
                states, pending = [], []
            observation = self._step(actions[:1])
        observations, returns = np.stack(all_observations), np.concatenate(all_returns)
        if self.baseline:
            returns = returns - agent.values(observations)[:, None, None]
        return RolloutSamples(agent.normalize_observations(observations), np.stack(all_actions), returns)

    def _step(self, action: np.ndarray) -> np.ndarray:
        """Take one step, into the next episode if this one ends; ``action`` is (1, ...)."""
        observation, _, terminated, truncated, _ = self.env.step(self.agent.to_env(action)[0])
        return self.env.reset()[0] if terminated or truncated else observation


def rollout_moments(model: OnPolicyAlgorithm, rollout: RolloutSamples, max_lag: int) -> Moments:
    """
    :param model: the model whose policy made the rollout
    :param rollout: rollout
    :param max_lag: L
    :return: its moments
    """
    n_actions, n_returns = rollout.returns.shape[1:]
    weights = rollout.returns.mean(axis=2)
    noise = rollout.returns.var(axis=2, ddof=1) / n_returns if n_returns > 1 else 0.0
    scores = Scores(model.policy, rollout.observations, rollout.actions)  # type: ignore[arg-type]
    norms = scores.squared_norms()
    total = scores.weighted(weights)
    # All pairs of actions at a state, minus those of an action with itself.
    crossed = (total.squared_norms() - (weights**2 * norms).sum(axis=1)) / (n_actions * (n_actions - 1))
    others = weights / (n_actions - 1)
    others[:, 0] = 0
    difference = -others
    difference[:, 0] = weights[:, 0]
    mean = scores.weighted(weights / n_actions)
    return Moments(
        squared=float(((weights**2 - noise) * norms).mean()),
        crossed=float(crossed.mean()),
        marginal_lagged=scores.weighted(others).lagged_products(mean, max_lag),
        policy_lagged=scores.weighted(difference).lagged_products(mean, max_lag),
        gradient=mean.mean(),
    )


def combine(moments: Sequence[Moments]) -> Estimate:
    """
    :param moments: of M independent rollouts, M at least 3
    :return: estimate of the components
    """
    gradients = np.stack([entry.gradient for entry in moments])
    products = gradients @ gradients.T
    squared, crossed, marginal, policy = (
        np.stack([np.asarray(entry[i]) for entry in moments]) for i in range(len(Moments._fields) - 1)
    )
    # Squared length of the expected gradient, from pairs of different rollouts: of all, and without each of them.
    m, between = len(moments), products - np.diag(np.diag(products))
    square = between.sum() / (m * (m - 1))
    squares = (between.sum() - 2 * between.sum(axis=1)) / ((m - 1) * (m - 2))

    def without_each(values: np.ndarray) -> np.ndarray:
        return (values.sum(axis=0) - values) / (m - 1)

    def components(s: np.ndarray, c: np.ndarray, a: np.ndarray, b: np.ndarray, g: np.ndarray) -> Components:
        return Components(c - g, a - g[..., None], s - c, b)

    return Estimate(
        components(
            squared.mean(axis=0), crossed.mean(axis=0), marginal.mean(axis=0), policy.mean(axis=0), np.asarray(square)
        ),
        components(without_each(squared), without_each(crossed), without_each(marginal), without_each(policy), squares),
        float(square),
        gradients.shape[1],
    )


def check_arguments(
    n_steps: int,
    n_rollouts: int,
    n_actions: int,
    n_returns: int,
    horizon: int,
    max_lag: int | None,
    burn_in: int | None,
    n_envs: int,
) -> None:
    """
    Check the arguments of :func:`estimate_components`.

    :raises ValueError: one of them is out of range
    """
    check_counts(
        {
            "n_steps": (n_steps, 2),
            "n_rollouts": (n_rollouts, 3),
            "n_actions": (n_actions, 2),
            "n_returns": (n_returns, 1),
            "horizon": (horizon, 1),
            "n_envs": (n_envs, 1),
            "max_lag": (1 if max_lag is None else max_lag, 1),
            "burn_in": (0 if burn_in is None else burn_in, 0),
        }
    )
    if max_lag is not None and max_lag >= n_steps:
        raise ValueError(f"max_lag must be below n_steps, which is {n_steps}, not {max_lag}")


def check_same_spaces(model: OnPolicyAlgorithm, env: gym.Env | VecEnv) -> None:
    """
    :param model: a model
    :param env: environment that ``make_env`` has made
    :raises ValueError: it has other spaces than the model
    """
    for name in ("observation_space", "action_space"):
        ours, theirs = getattr(model, name), getattr(env, name)
        if ours != theirs:
            raise ValueError(f"make_env makes an environment with the {name} {theirs}, but the model has {ours}")


def check_counts(counts: dict[str, tuple[int, int]]) -> None:
    """
    :param counts: by name, an argument and its minimum
    :raises ValueError: one of them is not a whole number, or is below its minimum
    """
    for name, (value, low) in counts.items():
        if not is_integer(value) or value < low:
            raise ValueError(f"{name} must be a whole number of at least {low}, not {value!r}")


@contextlib.contextmanager
def seeded(model: OnPolicyAlgorithm, seed: int) -> Iterator[None]:
    """
    Put the policy into evaluation mode and seed the global generators of torch and NumPy; all are restored at the end.

    :param model: model of the policy, and of the device whose generators are seeded
    :param seed: below 2**32
    """
    training, numpy_state = model.policy.training, np.random.get_state()  # noqa: NPY002
    model.policy.set_training_mode(False)
    devices = [model.device] if model.device.type == "cuda" else []
    try:
        with torch.random.fork_rng(devices=devices):
            torch.manual_seed(seed)
            np.random.seed(seed)  # noqa: NPY002
            yield
    finally:
        np.random.set_state(numpy_state)  # noqa: NPY002
        model.policy.set_training_mode(training)


def _episode_steps(env: gym.Env) -> int:
    """Steps of an episode that only its time limit ends; 1,000 if there is no limit."""
    dm_env = getattr(env.unwrapped, "dm_env", None)
    if dm_env is not None:
        from sb3_sample.envs.dmc import EPISODE_STEPS

        return math.ceil(EPISODE_STEPS / env.unwrapped.action_repeat)  # type: ignore[attr-defined]
    limit = None if env.spec is None else env.spec.max_episode_steps
    return 1000 if limit is None else limit
