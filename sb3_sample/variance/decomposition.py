"""
Variance of a policy gradient (MBMA, lemma 3.1), and its reduction by one more action or a longer trajectory (lemma 3.2,
theorem 3.3 and corollary 3.4). Numbers in, numbers out: nothing here samples anything.

The gradient is the mean over T states of a trajectory of the mean over N actions of Y(s, a) = Q(s, a) grad log pi(a|s)
(MBMA, equation 3, without its factor gamma^t, as in appendix A: with it equation 4 does not hold); only the first of
the N actions is carried out. Variances and covariances are traces: sums over the policy's parameters of the quantities
that the paper writes for each. Y_t is Y at the state t steps later.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True)
class Components:
    """
    Components of the variance, which depend neither on N nor on T.

    All may have leading axes (...), for replicates; operations work on the last axis.

    :param marginal_variance: variance over states of Y's mean over actions, lemma 3.1's ``Var_s[mean Y]``, (...)
    :param marginal_covariance: covariances of Y's means over actions at two states t = 1, ..., L steps apart,
        ``Cov[mean Y, mean Y_t]``, (..., L)
    :param policy_variance: mean over states of the variance over actions, ``E_s Var_a[Y]``, (...)
    :param policy_covariance: mean over states s of the covariance, given s, between Y(s, a) and Y t = 1, ..., L steps
        after taking a there, ``E_s Cov[Y, Y_t | s]``, (..., L)
    """

    marginal_variance: np.ndarray
    marginal_covariance: np.ndarray
    policy_variance: np.ndarray
    policy_covariance: np.ndarray

    @property
    def max_lag(self) -> int:
        """L. Covariances at larger distances are taken to be 0."""
        return self.marginal_covariance.shape[-1]

    def marginal_covariance_sum(self, n_steps: int) -> np.ndarray:
        """
        :param n_steps: T
        :return: ``2 sum_t (T - t)/T Cov[mean Y, mean Y_t]``, (...)
        """
        return 2 * _dot(self._fading(n_steps), self.marginal_covariance)

    def policy_covariance_sum(self, n_steps: int) -> np.ndarray:
        """
        :param n_steps: T
        :return: ``2 sum_t (T - t)/T E_s Cov[Y, Y_t | s]``, (...)
        """
        return 2 * _dot(self._fading(n_steps), self.policy_covariance)

    def marginalized_policy_variance(self, n_steps: int) -> np.ndarray:
        """
        :param n_steps: T
        :return: equation 6's first part: T times the variance that remains with any number of actions, (...)
        """
        return self.marginal_variance + self.marginal_covariance_sum(n_steps)

    def policy_dependent_variance(self, n_steps: int) -> np.ndarray:
        """
        :param n_steps: T
        :return: equation 6's second part without its factor 1/N, (...)
        """
        return self.policy_variance + self.policy_covariance_sum(n_steps)

    def variance(self, n_steps: float, n_actions: int = 1) -> np.ndarray:
        """
        Equation 6: the variance of the gradient.

        :param n_steps: T; for fractions, as in a comparison at equal cost, the sums are interpolated linearly
        :param n_actions: N
        :return: variance, (...)
        :raises ValueError: an argument is out of range
        """
        _check_counts(n_steps, n_actions)
        fading = self._fading(n_steps)
        marginal = self.marginal_variance + 2 * _dot(fading, self.marginal_covariance)
        policy = self.policy_variance + 2 * _dot(fading, self.policy_covariance)
        return (marginal + policy / n_actions) / n_steps

    def gain_of_action(self, n_steps: int, n_actions: int = 1) -> np.ndarray:
        """
        Lemma 3.2's Delta_N.

        :param n_steps: T
        :param n_actions: N
        :return: change of the variance by one more action at each state, from N to N + 1; below 0 is a reduction, (...)
        :raises ValueError: an argument is out of range
        """
        _check_counts(n_steps, n_actions)
        return -self.policy_dependent_variance(n_steps) / (n_steps * n_actions * (n_actions + 1))

    def gain_of_steps(self, n_steps: int, delta: float, n_actions: int = 1, tail: bool = True) -> np.ndarray:
        """
        Delta_T: change of the variance by ``delta * T`` more steps; below 0 is a reduction.

        Lemma 3.2 leaves out the covariances at distances of T steps and more, assuming that a trajectory of length T
        reaches a regenerative state. With ``tail`` these covariances are included as far as they are known, and Delta_T
        is V(T + delta T) - V(T) without that assumption; if all of them are 0, the two are equal.

        :param n_steps: T
        :param delta: share of T by which the trajectory gets longer, above 0
        :param n_actions: N
        :param tail: whether to count the covariances that the lemma leaves out
        :return: change of the variance, (...)
        :raises ValueError: an argument is out of range
        """
        _check_counts(n_steps, n_actions)
        _check_delta(delta)
        longer = n_steps * (1 + delta)
        if tail:
            return self.variance(longer, n_actions) - self.variance(n_steps, n_actions)
        lags = self._lags()
        weights = np.where(lags < n_steps, (n_steps - lags) / n_steps - lags / longer, 0.0)
        variance = self.marginal_variance + self.policy_variance / n_actions
        covariance = self.marginal_covariance + self.policy_covariance / n_actions
        return -delta / longer * (variance + 2 * _dot(weights, covariance))

    def theorem_3_3(self, n_steps: int, delta: float = 1.0, n_actions: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """
        The two sides of equation 14, of which theorem 3.3 is the case N = 1, delta = 1 (with equal terms moved between
        the sides) and corollary 3.4 the case without covariances. One more action lowers the variance at least as much
        as ``delta * T`` more steps if the left side is at least the right side.

        :param n_steps: T
        :param delta: cost of one more action at all T states, in units of the cost of those T states
        :param n_actions: N
        :return: left and right side, (...) each
        :raises ValueError: an argument is out of range
        """
        _check_counts(n_steps, n_actions)
        _check_delta(delta)
        lags, n, longer = self._lags(), n_actions, n_steps * (1 + delta)
        known = lags < n_steps
        scale = delta * (n**2 + n)
        policy_weights = (
            (1 + delta - delta * n - delta**2 * n) * n_steps - (1 - 2 * delta * n - delta**2 * n) * lags
        ) / (scale * longer)
        left = (1 - delta * n) / scale * self.policy_variance + 2 * _dot(
            np.where(known, policy_weights, 0.0), self.policy_covariance
        )
        marginal_weights = np.where(known, (n_steps - lags) / n_steps - lags / longer, 0.0)
        right = self.marginal_variance + 2 * _dot(marginal_weights, self.marginal_covariance)
        return left, right

    def _lags(self) -> np.ndarray:
        return np.arange(1, self.max_lag + 1)

    def _fading(self, n_steps: float) -> np.ndarray:
        """(T - t)/T for t = 1, ..., L, 0 from t = T on."""
        return np.maximum(1 - self._lags() / n_steps, 0.0)


class Choice(NamedTuple):
    """
    A number of actions, and its variance at the same cost as T states with a single action.

    :param n_actions: N
    :param n_steps: number of states for that cost, possibly fractional
    :param variance: of the gradient
    """

    n_actions: int
    n_steps: float
    variance: np.ndarray


def at_equal_cost(components: Components, n_steps: int, action_cost: float, max_actions: int = 16) -> list[Choice]:
    """
    Variance with 1, 2, ... actions when each shortens the trajectory by its cost.

    :param components: components of the variance
    :param n_steps: T, states of the trajectory with a single action
    :param action_cost: cost of an additional action at one state, in units of the cost of a state with a single action
        (0 if it costs nothing): with N actions there are ``T / (1 + action_cost (N - 1))`` states
    :param max_actions: largest number of actions
    :return: one choice for each number of actions
    :raises ValueError: an argument is out of range
    """
    _check_cost(action_cost)
    lengths = [n_steps / (1 + action_cost * (n - 1)) for n in range(1, max_actions + 1)]
    return [Choice(n, length, components.variance(length, n)) for n, length in enumerate(lengths, start=1)]


def relative_cost(action_cost: float, n_actions: int = 1) -> float:
    """
    Lemma 3.2's delta: one more action at all T states costs as much as ``delta * T`` states with N actions each.

    :param action_cost: cost of an additional action at one state, in units of the cost of a state with a single action
    :param n_actions: N, actions at each state so far
    :return: delta
    :raises ValueError: an argument is out of range
    """
    _check_cost(action_cost)
    _check_counts(1, n_actions)
    return action_cost / (1 + action_cost * (n_actions - 1))


def _check_counts(n_steps: float, n_actions: float) -> None:
    if not n_steps > 0:  # below 1 is possible in a comparison at equal cost
        raise ValueError(f"n_steps must be above 0, not {n_steps!r}")
    if not n_actions >= 1:
        raise ValueError(f"n_actions must be at least 1, not {n_actions!r}")


def _check_delta(delta: float) -> None:
    if not delta > 0:
        raise ValueError(f"delta must be above 0, not {delta!r}")


def _check_cost(action_cost: float) -> None:
    if not action_cost >= 0:
        raise ValueError(f"action_cost must be at least 0, not {action_cost!r}")


def _dot(weights: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    return np.sum(weights * covariances, axis=-1)
