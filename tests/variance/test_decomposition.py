"""The paper's lemmas against the enumeration of all paths of a tabular task, and each other."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sb3_sample.variance.decomposition import Components, at_equal_cost, relative_cost
from tests.variance.common import GAMMA, Exact, Tabular, softmax_policy


def task(bandit: bool = False, n_states: int = 2, limit: int | None = None, seed: int = 0) -> Exact:
    return Exact(Tabular(n_states, 2, bandit, seed), softmax_policy(n_states, 2)[2], limit)


def components(exact: Exact, max_lag: int = 10) -> Components:
    return Components(*(np.asarray(entry) for entry in exact.components(max_lag)))


def random_components(seed: int, max_lag: int = 10) -> Components:
    rng = np.random.default_rng(seed)
    return Components(
        np.asarray(rng.exponential()),
        rng.normal(size=max_lag),
        np.asarray(rng.exponential()),
        rng.normal(size=max_lag),
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("n_steps", "n_actions"), [(1, 1), (1, 3), (2, 1), (2, 2), (3, 2), (4, 1)])
def test_lemma_3_1_is_the_variance_over_all_paths(n_steps: int, n_actions: int, seed: int) -> None:
    exact = task(seed=seed)
    value = components(exact).variance(n_steps, n_actions)
    assert value == pytest.approx(exact.enumerated_variance(n_steps, n_actions), rel=1e-10)


def test_lemma_3_1_with_three_states_and_with_a_time_limit() -> None:
    for exact in (task(n_states=3), task(limit=2), task(limit=3)):
        assert components(exact).variance(3, 2) == pytest.approx(exact.enumerated_variance(3, 2), rel=1e-10)


def test_covariances_matter_and_change_sign() -> None:
    # Were they 0 the tests above would say nothing of the sums; and "Cov_t >= Cov_t+1" (MBMA) does not hold in general.
    parts = [components(task(seed=seed)) for seed in range(3)]
    sizes = [abs(p.policy_covariance_sum(4)) / p.policy_variance for p in parts]
    assert max(sizes) > 0.1
    assert any((np.diff(p.marginal_covariance) > 1e-3).any() for p in parts)


def test_equation_4_holds_without_the_factor_gamma_to_the_t() -> None:
    # As printed, Y_t has the factor gamma^t, in the estimator (equations 2 and 3) and in the covariances (equation 4).
    # The sum is then not that of a stationary process, and equation 4, which counts pairs by their distance, not its
    # variance. MBMA's appendix A leaves the factor out, and so does PPO.
    exact = task()
    parts = components(exact)
    t = np.arange(1, 3)
    covariance = (parts.marginal_covariance + parts.policy_covariance)[:2]
    printed = (parts.marginal_variance + parts.policy_variance) / 3 + 2 * np.sum((3 - t) / 9 * GAMMA**t * covariance)
    assert abs(printed / exact.enumerated_variance(3, 1, discount=GAMMA) - 1) > 0.1
    assert parts.variance(3, 1) == pytest.approx(exact.enumerated_variance(3, 1, discount=1.0))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("n_steps", "n_actions"), [(1, 1), (2, 1), (3, 2)])
def test_delta_n_of_lemma_3_2(n_steps: int, n_actions: int, seed: int) -> None:
    exact = task(seed=seed)
    change = exact.enumerated_variance(n_steps, n_actions + 1) - exact.enumerated_variance(n_steps, n_actions)
    assert components(exact).gain_of_action(n_steps, n_actions) == pytest.approx(change, rel=1e-9)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("n_steps", "delta", "n_actions"), [(2, 1.0, 1), (2, 0.5, 2), (1, 2.0, 1), (2, 1.0, 2)])
def test_delta_t_of_lemma_3_2(n_steps: int, delta: float, n_actions: int, seed: int) -> None:
    exact = task(seed=seed)
    parts = components(exact)
    longer = int(n_steps * (1 + delta))
    change = exact.enumerated_variance(longer, n_actions) - exact.enumerated_variance(n_steps, n_actions)
    assert parts.gain_of_steps(n_steps, delta, n_actions) == pytest.approx(change, rel=1e-9)
    # As printed, the lemma leaves out the distances from T on, and only those (appendix A.2's sum over k).
    lags = np.arange(n_steps, longer)
    covariance = (parts.marginal_covariance + parts.policy_covariance / n_actions)[lags - 1]
    tail = 2 * np.sum((longer - lags) / longer**2 * covariance)
    assert parts.gain_of_steps(n_steps, delta, n_actions, tail=False) == pytest.approx(change - tail, rel=1e-9)
    assert abs(tail) > 1e-3 * abs(change)


def test_the_lemma_is_exact_where_covariances_fade_within_the_trajectory() -> None:
    parts = random_components(0, max_lag=4)
    for n_steps in (5, 9):
        assert parts.gain_of_steps(n_steps, 0.5, 2, tail=False) == pytest.approx(parts.gain_of_steps(n_steps, 0.5, 2))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("n_steps", "delta", "n_actions"), [(3, 1.0, 1), (12, 1.0, 1), (7, 0.2, 3), (20, 2.5, 4)])
def test_equation_14_decides_as_lemma_3_2_does(n_steps: int, delta: float, n_actions: int, seed: int) -> None:
    parts = random_components(seed)
    left, right = parts.theorem_3_3(n_steps, delta, n_actions)
    margin = parts.gain_of_steps(n_steps, delta, n_actions, tail=False) - parts.gain_of_action(n_steps, n_actions)
    # Equation 14 is the comparison of the two changes, divided by delta / (T + delta T).
    assert left - right == pytest.approx(margin * n_steps * (1 + delta) / delta, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_theorem_3_3_as_printed_is_equation_14_with_equal_costs(seed: int) -> None:
    parts = random_components(seed)
    n_steps, lags = 12, np.arange(1, 11)
    printed_left = np.sum(lags / n_steps * (parts.marginal_covariance + parts.policy_covariance))
    printed_right = parts.marginal_variance + 2 * np.sum((n_steps - lags) / n_steps * parts.marginal_covariance)
    left, right = parts.theorem_3_3(n_steps)
    assert left - right == pytest.approx(printed_left - printed_right, rel=1e-9)


def test_theorem_3_3_against_all_paths() -> None:
    for seed in range(6):
        exact = task(seed=seed)
        parts = components(exact, max_lag=7)
        margin = exact.enumerated_variance(6, 1) - exact.enumerated_variance(3, 2)
        assert (parts.gain_of_steps(3, 1.0) >= parts.gain_of_action(3)) == (margin >= 0)


@pytest.mark.parametrize("delta", [0.1, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("n_actions", [1, 2])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_corollary_3_4_for_bandits(delta: float, n_actions: int, seed: int) -> None:
    exact = task(bandit=True, seed=seed)
    parts = components(exact)
    np.testing.assert_allclose(parts.marginal_covariance, 0, atol=1e-12)
    np.testing.assert_allclose(parts.policy_covariance, 0, atol=1e-12)
    n_steps = 10
    corollary = parts.marginal_variance / parts.policy_variance <= (1 - delta * n_actions) / (
        delta * (n_actions**2 + n_actions)
    )
    more_actions = parts.gain_of_action(n_steps, n_actions) <= parts.gain_of_steps(n_steps, delta, n_actions)
    left, right = parts.theorem_3_3(n_steps, delta, n_actions)
    assert corollary == more_actions == (left >= right)
    if delta * n_actions >= 1:
        assert not more_actions  # never for bandits


def test_bandit_of_all_paths() -> None:
    exact = task(bandit=True)
    assert components(exact).variance(3, 2) == pytest.approx(exact.enumerated_variance(3, 2), rel=1e-10)


def test_at_equal_cost() -> None:
    parts = random_components(1)
    free = at_equal_cost(parts, 100, action_cost=0.0, max_actions=4)
    assert [choice.n_steps for choice in free] == [100.0] * 4
    assert [choice.n_actions for choice in free] == [1, 2, 3, 4]
    costly = at_equal_cost(parts, 100, action_cost=0.5, max_actions=3)
    assert [choice.n_steps for choice in costly] == pytest.approx([100, 100 / 1.5, 50])
    assert costly[2].variance == pytest.approx(parts.variance(50, 3))


def test_relative_cost_is_that_of_states_with_their_actions() -> None:
    assert relative_cost(0.5) == 0.5
    # A state with 3 actions costs 2; another action at 10 states costs 5, a quarter of what the 10 states cost.
    assert relative_cost(0.5, 3) == 0.25


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c: c.variance(0), "n_steps must be above 0, not 0"),
        (lambda c: c.variance(float("nan")), "n_steps must be above 0, not nan"),
        (lambda c: c.gain_of_action(10, 0), "n_actions must be at least 1, not 0"),
        (lambda c: c.gain_of_steps(10, -1.0), "delta must be above 0, not -1.0"),
        (lambda c: c.gain_of_steps(10, 0.0, tail=False), "delta must be above 0, not 0.0"),
        (lambda c: c.theorem_3_3(10, 0.0), "delta must be above 0, not 0.0"),
        (lambda c: at_equal_cost(c, 10, -2.0), "action_cost must be at least 0, not -2.0"),
        (lambda c: at_equal_cost(c, 0, 1.0), "n_steps must be above 0, not 0"),
        (lambda c: relative_cost(1.0, 0), "n_actions must be at least 1, not 0"),
        (lambda c: relative_cost(-0.5), "action_cost must be at least 0, not -0.5"),
    ],
)
def test_what_is_refused(call: Callable[[Components], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(random_components(0))
