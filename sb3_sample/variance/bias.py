"""
Bias and variance of policy gradients from simulated samples, relative to the gradient's size (MBMA, appendix B and
table 3). M estimates of each method, P policy parameters that the actions depend on.
"""

import copy
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_sample.ppo import MBMAPPO, MBPOPPO, QMAPPO
from sb3_sample.ppo.arguments import check_action_space
from sb3_sample.ppo.samples import Rollout, SimulatedSamples, log_prob_of_many
from sb3_sample.ppo.simulated_ppo import SimulatedPPO
from sb3_sample.ppo.spaces import FlatObservations
from sb3_sample.variance.estimate import Interval, check_counts, check_same_spaces, jackknife, seeded
from sb3_sample.variance.returns import Agent

R = TypeVar("R")
#: Estimates the gradient, (P,), from a rollout.
Estimator = Callable[[R], np.ndarray]
#: The method without simulated samples, whose gradient has no bias: the actor-critic (AC) of the MBMA paper's tables.
ORACLE = "PPO"


@dataclass(frozen=True)
class GradientSamples:
    """
    Estimates of one policy's gradient by several methods, each from the same M rollouts.

    ``relative_bias`` and ``relative_variance`` are as in MBMA, appendix B, "Table 3": means over the parameters of each
    parameter's ratio to the method's own mean gradient. If the mean of a parameter's gradient is close to 0, its ratio
    is huge, and the noise of the means counts as bias: the ``relative_bias`` of an unbiased method vanishes only as M
    grows (``noise_floor`` gives its size). ``bias`` and ``variance`` are of the gradient as a whole, with that noise
    subtracted, so that they do not depend on M.

    :param gradients: by method, (M, P) each
    :param oracle: the method that is taken to be without bias
    """

    gradients: Mapping[str, np.ndarray]
    oracle: str = ORACLE

    def __post_init__(self) -> None:
        if self.oracle not in self.gradients:
            raise ValueError(f"oracle must be one of the methods, {', '.join(self.gradients)}, not {self.oracle!r}")
        shapes = {name: np.shape(gradients) for name, gradients in self.gradients.items()}
        if len(set(shapes.values())) > 1 or len(shapes[self.oracle]) != 2 or shapes[self.oracle][0] < 4:
            raise ValueError(f"gradients must all be of one shape (M, P), with M at least 4, not {shapes}")

    @property
    def n_estimates(self) -> int:
        """M."""
        return len(self.gradients[self.oracle])

    def relative_bias(self, method: str) -> float:
        """
        :param method: name
        :return: ``1/P sum_p |mean g*_p - mean g_p| / |mean g*_p|``, g* the method's, g the oracle's gradient
        """
        mine, oracle = (self.gradients[name].mean(axis=0, dtype=float) for name in (method, self.oracle))
        return _mean_ratio(np.abs(mine - oracle), np.abs(mine))

    def relative_variance(self, method: str) -> float:
        """
        :param method: name
        :return: ``1/P sum_p Var[g*_p] / (mean g*_p)^2``
        """
        mine = self.gradients[method]
        return _mean_ratio(mine.var(axis=0, ddof=1, dtype=float), mine.mean(axis=0, dtype=float) ** 2)

    def noise_floor(self) -> float:
        """
        :return: ``relative_bias`` of one half of the oracle's estimates against the other half: the value of an
            unbiased method with independent and half as many estimates
        """
        half = self.n_estimates // 2
        gradients = self.gradients[self.oracle]
        halves = {"half": gradients[:half], self.oracle: gradients[half : 2 * half]}
        return _mean_ratio(*_difference_and_size(*(halves[name].mean(axis=0, dtype=float) for name in halves)))

    def bias(self, method: str, confidence: float = 0.95) -> Interval:
        """
        :param method: name
        :param confidence: of the interval
        :return: ``|E g* - E g|^2 / |E g*|^2`` without the bias of squared means, 0 for the oracle; by the jackknife
        """
        mine, oracle = (np.asarray(self.gradients[name], float) for name in (method, self.oracle))
        squares = jackknife_squares(mine - oracle), jackknife_squares(mine)
        return jackknife(squares[0][0] / squares[1][0], squares[0][1] / squares[1][1], confidence)

    def variance(self, method: str, confidence: float = 0.95) -> Interval:
        """
        :param method: name
        :param confidence: of the interval
        :return: ``tr Var[g*] / |E g*|^2`` without the bias of squared means; by the jackknife
        """
        mine = np.asarray(self.gradients[method], float)
        squares = jackknife_squares(mine)
        norms = (mine**2).sum(axis=1)
        without = (norms.sum() - norms) / (len(norms) - 1)
        return jackknife(norms.mean() / squares[0] - 1, without / squares[1] - 1, confidence)

    def difference(self, quantity: str, first: str, second: str, confidence: float = 0.95) -> Interval:
        """
        Compare two methods on their common rollouts.

        :param quantity: "bias", "variance", "relative_bias" or "relative_variance"
        :param first: a method
        :param second: another
        :param confidence: of the interval
        :return: the first one's minus the second one's, by the jackknife
        :raises ValueError: ``quantity`` is none of these, or M is below 5, too few for leaving one out
        """
        if quantity not in ("bias", "variance", "relative_bias", "relative_variance"):
            raise ValueError(
                f"quantity must be 'bias', 'variance', 'relative_bias' or 'relative_variance', not {quantity!r}"
            )

        if self.n_estimates < 5:
            raise ValueError(f"difference needs at least 5 estimates of the gradients, not {self.n_estimates}")

        def value(samples: "GradientSamples") -> float:
            of_first, of_second = (getattr(samples, quantity)(name) for name in (first, second))
            if isinstance(of_first, Interval):
                return of_first.value - of_second.value
            return of_first - of_second

        names = {first, second, self.oracle}
        kept = np.ones(self.n_estimates, bool)
        left_out = []
        for index in range(self.n_estimates):
            kept[index] = False
            left_out.append(value(GradientSamples({name: self.gradients[name][kept] for name in names}, self.oracle)))
            kept[index] = True
        return jackknife(value(self), np.array(left_out), confidence)


def sample_gradients(
    rollouts: Iterable[R], estimators: Mapping[str, Estimator[R]], oracle: str = ORACLE
) -> GradientSamples:
    """
    :param rollouts: M independent rollouts of one policy
    :param estimators: estimators by name of the method, each called with every rollout
    :param oracle: the method that is taken to be without bias
    :return: their gradients
    """
    rows: dict[str, list[np.ndarray]] = {name: [] for name in estimators}
    for rollout in rollouts:
        for name, estimator in estimators.items():
            rows[name].append(np.asarray(estimator(rollout), dtype=np.float32))
    return GradientSamples({name: np.stack(gradients) for name, gradients in rows.items()}, oracle)


def policy_gradient(model: SimulatedPPO, rollout: Rollout, samples: SimulatedSamples | None = None) -> np.ndarray:
    """
    Gradient of PPO's policy objective at the policy that collected the rollout, where all probability ratios are 1 and
    nothing is clipped: the mean of advantage times score over real and simulated samples.

    :param model: model whose policy is differentiated
    :param rollout: real samples
    :param samples: simulated samples; None for PPO's gradient
    :return: gradient with respect to the parameters that the actions depend on, in the policy's order, (P,)
    """
    distribution = model.distribution_at(rollout.observations)
    log_probs, advantages = distribution.log_prob(rollout.actions), rollout.advantages
    objective, weight = (advantages * log_probs).sum(), float(len(advantages))
    if samples is not None:
        if samples.observations is None:
            log_probs = log_prob_of_many(distribution, samples.actions)
        else:
            distribution = model.distribution_at(samples.observations.flatten(0, 1))
            log_probs = distribution.log_prob(samples.actions.flatten(0, 1)).view(samples.actions.shape[:2])
        weights = torch.ones_like(log_probs) if samples.weights is None else samples.weights
        objective = objective + (weights * samples.advantages * log_probs).sum()
        weight += float(weights.sum())
    parameters = [parameter for parameter in model.policy.parameters() if parameter.requires_grad]
    gradients = torch.autograd.grad(objective / weight, parameters, allow_unused=True)
    return torch.cat([gradient.flatten() for gradient in gradients if gradient is not None]).cpu().numpy()


def compare_gradients(
    model: OnPolicyAlgorithm,
    make_env: Callable[[], gym.Env],
    n_estimates: int = 30,
    n_steps: int = 2048,
    n_fits: int = 5,
    n_simulated: int = 8,
    simulation_horizon: int = 12,
    dynamics_kwargs: dict[str, Any] | None = None,
    q_kwargs: dict[str, Any] | None = None,
    seed: int = 0,
    on_estimate: Callable[[int], None] | None = None,
) -> GradientSamples:
    """
    Compute gradients of one policy by PPO, MBMA, QMA and MBPO, as in MBMA, table 3: all from the same rollouts of that
    policy, and none is applied.

    First the learned models, the dynamics (one for MBMA and MBPO) and the Q-networks, are trained on ``n_fits``
    rollouts of the policy as in their algorithms; then they are frozen, so that the estimates are independent, given
    the models, and their bias comes from these models.

    :param model: a ``PPO`` or ``A2C``, or a subclass; nothing in it changes
    :param make_env: makes the environment
    :param n_estimates: M, at least 4 (MBMA: 125). The gradients take ``16 * M * P`` bytes
    :param n_steps: states of each rollout (MBMA: 2,500)
    :param n_fits: rollouts that the learned models are trained on
    :param n_simulated: samples simulated for each real one
    :param simulation_horizon: steps of the model, at least 2
    :param dynamics_kwargs: of :class:`~sb3_sample.ppo.MBMAPPO`
    :param q_kwargs: of :class:`~sb3_sample.ppo.QMAPPO`
    :param seed: of everything random; the global generators are left unchanged
    :param on_estimate: called after each estimate, with the number of estimates so far
    :return: the gradients by method: "PPO", the oracle, "MBMA", "QMA", "MBPO"
    :raises TypeError: ``model`` is of another family
    :raises ValueError: an argument is out of range, :class:`Agent` rejects the model, :func:`check_spaces` rejects its
        spaces, or the environment has others
    """
    Agent(model)
    check_spaces(model.observation_space, model.action_space)
    check_counts({"n_estimates": (n_estimates, 4), "n_steps": (n_steps, 2), "n_fits": (n_fits, 1), "seed": (seed, 0)})
    check_counts({"n_simulated": (n_simulated, 1), "simulation_horizon": (simulation_horizon, 2)})
    rng = np.random.default_rng(seed)
    env = _environment(model, make_env)
    try:
        check_same_spaces(model, env)
        with seeded(model, int(rng.integers(2**31))):
            env.seed(int(rng.integers(2**31)))
            settings: dict[str, Any] = {
                "n_steps": n_steps,
                "batch_size": min(64, n_steps),
                "gamma": model.gamma,
                "gae_lambda": model.gae_lambda,
                "device": model.device,
                "n_simulated": n_simulated,
                # Small networks, since the model's policy replaces the one built here.
                "policy_kwargs": {"net_arch": [1]},
            }
            dynamics: dict[str, Any] = {"simulation_horizon": simulation_horizon, "dynamics_kwargs": dynamics_kwargs}
            mbma = MBMAPPO("MlpPolicy", env, **settings, **dynamics)
            mbpo = MBPOPPO("MlpPolicy", env, **settings, **dynamics)
            qma = QMAPPO("MlpPolicy", env, **settings, q_kwargs=q_kwargs)
            mbpo.dynamics, qma.rollout_buffer = mbma.dynamics, mbma.rollout_buffer
            for rival in (mbma, mbpo, qma):
                rival.policy = model.policy
            _, callback = mbma._setup_learn(n_steps * (n_fits + n_estimates), None)
            qma.set_logger(mbma.logger)

            def rollout() -> Rollout:
                mbma.collect_rollouts(env, callback, mbma.rollout_buffer, n_steps)
                return mbma.current_rollout()

            for _ in range(n_fits):
                rollout()
                mbma.fit_models()
                qma.fit_models()

            def rollouts() -> Iterable[Rollout]:
                for index in range(n_estimates):
                    yield rollout()
                    if on_estimate is not None:
                        on_estimate(index + 1)

            def simulated(rival: SimulatedPPO) -> Estimator[Rollout]:
                return lambda rollout: policy_gradient(
                    rival, rollout, rival.simulate(rollout.observations, rollout.values, n_simulated)
                )

            return sample_gradients(
                rollouts(),
                {
                    ORACLE: lambda rollout: policy_gradient(mbma, rollout),
                    "MBMA": simulated(mbma),
                    "QMA": simulated(qma),
                    "MBPO": simulated(mbpo),
                },
            )
    finally:
        env.close()


def jackknife_squares(samples: np.ndarray) -> tuple[float, np.ndarray]:
    """
    Squared length of an expectation, from pairs of different samples, so that their noise adds no bias.

    :param samples: (M, P)
    :return: estimate, and the estimates without each sample, (M,)
    """
    m, total = len(samples), samples.sum(axis=0)
    norms, with_total = (samples**2).sum(axis=1), samples @ total
    pairs = total @ total - norms.sum()
    left_out = pairs - 2 * (with_total - norms)
    return pairs / (m * (m - 1)), left_out / ((m - 1) * (m - 2))


def check_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """
    :param observation_space: of the task in which gradients are to be compared
    :param action_space: likewise
    :raises ValueError: a dynamics model or a Q-network cannot learn from its observations or actions
    """
    FlatObservations(observation_space, plain=None)
    check_action_space(action_space, plain=None)


def _environment(model: OnPolicyAlgorithm, make_env: Callable[[], gym.Env]) -> VecEnv:
    """A single environment, normalised by the model's statistics, which are frozen."""
    env: VecEnv = DummyVecEnv([make_env])
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        # A copy as from VecNormalize's own file, without its environment.
        own = copy.deepcopy(normalize)
        own.set_venv(env)
        own.training = False
        env = own
    return env


def _difference_and_size(mine: np.ndarray, oracle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.abs(mine - oracle), np.abs(mine)


def _mean_ratio(numerator: np.ndarray, denominator: np.ndarray) -> float:
    """Mean over the parameters except those with a gradient of exactly 0, from neurons that no state activates."""
    used = denominator > 0
    return float((numerator[used] / denominator[used]).mean()) if used.any() else float("nan")
