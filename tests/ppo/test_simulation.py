"""The simulated returns against what can be computed by hand."""

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from sb3_sample import MBMAPPO, MBPOPPO, QMAPPO
from sb3_sample.ppo.model_based import lambda_returns
from tests.ppo.common import (
    ALGORITHMS,
    GAIN,
    OFFSET,
    Linear,
    TrueModel,
    collected,
    linear_model,
    tiny,
    true_q,
    true_value,
)
from tests.sac.common import Toy

STATES = torch.randn(5, 2, generator=torch.Generator().manual_seed(0))


def antithetic(shape: tuple[int, ...], axis: int) -> torch.Tensor:
    """Noise of which the two halves along an axis cancel."""
    half = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    return torch.cat([half, -half], dim=axis)


# ---------------------------------------------------------------- TD(lambda)


def test_lambda_returns_are_the_mixture_of_n_step_returns() -> None:
    generator = torch.Generator().manual_seed(0)
    rewards, values = torch.randn(2, 4, 3, generator=generator, dtype=torch.float64)
    gamma, gae_lambda = 0.9, 0.7

    def n_step(k: int, n: int) -> torch.Tensor:
        return sum(gamma**i * rewards[k + i] for i in range(n)) + gamma**n * values[k + n - 1]

    got = lambda_returns(rewards, values, None, gamma, gae_lambda)
    for k in range(4):
        last = 4 - k
        weighted = [(1 - gae_lambda) * gae_lambda ** (n - 1) * n_step(k, n) for n in range(1, last)]
        torch.testing.assert_close(got[k], sum(weighted) + gae_lambda ** (last - 1) * n_step(k, last))


def test_after_an_end_nothing_counts() -> None:
    rewards, values = torch.ones(3, 1), torch.full((3, 1), 10.0)
    got = lambda_returns(rewards, values, torch.tensor([[1.0], [0.0], [1.0]]), 0.5, 1.0)
    assert got.flatten().tolist() == [1.5, 1.0, 6.0]
    assert lambda_returns(rewards, values, None, 0.5, 0.0).flatten().tolist() == [6.0, 6.0, 6.0]


# ---------------------------------------------------------------- the true model plugged in


@pytest.mark.parametrize("horizon", [1, 2, 12])
@pytest.mark.parametrize("gae_lambda", [0.0, 0.95, 1.0])
def test_mbma_has_the_analytic_q_with_the_true_model_and_critic(horizon: int, gae_lambda: float) -> None:
    agent = linear_model(value=true_value(0.9), simulation_horizon=horizon, gae_lambda=gae_lambda)
    first = torch.randn(1, 5, 3, 1, generator=torch.Generator().manual_seed(2)).repeat(1, 2, 1, 1)
    noise = torch.cat([first, antithetic((horizon - 1, 5, 3, 1), axis=1)])
    samples = agent.simulate(STATES.repeat(2, 1), n_simulated=3, noise=noise)
    # The environment is linear: over a noise and its opposite, the mean is the expectation, exactly.
    got = samples.q_values.view(2, 5, 3).mean(dim=0)
    actions = samples.actions[:5].numpy()
    expected = [true_q(STATES.numpy(), actions[:, x], 0.9) for x in range(3)]
    np.testing.assert_allclose(got, np.stack(expected, axis=1), rtol=1e-5, atol=1e-5)
    values = STATES.numpy() @ true_value(0.9)[0] + true_value(0.9)[1]
    np.testing.assert_allclose(
        samples.advantages, samples.q_values.numpy() - np.tile(values, 2)[:, None], rtol=1e-5, atol=1e-5
    )


def test_without_a_critic_a_long_horizon_has_the_analytic_q_of_a_quadratic_cost() -> None:
    model = TrueModel(quadratic=True)
    agent = linear_model(log_std=-30, simulation_horizon=300, gae_lambda=1.0, model=model)
    agent.policy.action_net.bias.data.zero_()
    samples = agent.simulate(STATES, n_simulated=2)
    # V(s) = -s' P s with P = I + K'K + gamma (A + BK)' P (A + BK).
    closed = Linear.A + Linear.B @ GAIN
    kronecker = np.eye(4) - 0.9 * np.kron(closed.T, closed.T)
    P = np.linalg.solve(kronecker, (np.eye(2) + GAIN.T @ GAIN).ravel()).reshape(2, 2)
    states = STATES.numpy().astype(np.float64)
    for x in range(2):
        actions = samples.actions[:, x].numpy().astype(np.float64)
        following = states @ Linear.A.T + actions @ Linear.B.T
        q = -(states**2).sum(1) - (actions**2).sum(1) - 0.9 * np.einsum("bi,ij,bj->b", following, P, following)
        np.testing.assert_allclose(samples.q_values[:, x], q, rtol=1e-5, atol=1e-5)


def test_the_mean_over_drawn_noise_is_the_analytic_q() -> None:
    agent = linear_model(value=true_value(0.9), simulation_horizon=6)
    torch.manual_seed(0)
    samples = agent.simulate(STATES[:1], n_simulated=20_000, noise=None)
    q = true_q(np.repeat(STATES[:1].numpy(), 20_000, axis=0), samples.actions[0].numpy(), 0.9)
    error = samples.q_values[0].numpy() - q
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(len(error))
    assert error.std() > 0.1
    assert abs(samples.actions.mean() - (GAIN @ STATES[0].numpy() + OFFSET)[0]) < 0.02


def test_the_pieces_of_a_simulation_make_the_whole() -> None:
    agent = linear_model(simulation_horizon=3)
    noise = torch.randn(3, 5, 4, 1)
    whole = agent.simulate(STATES, n_simulated=4, noise=noise)
    agent._rows_at_once = lambda: 3
    pieces = agent.simulate(STATES, n_simulated=4, noise=noise)
    torch.testing.assert_close(whole.q_values, pieces.q_values)
    agent = linear_model(MBPOPPO, simulation_horizon=3, n_simulated=2)
    whole = agent.simulate(STATES, noise=noise[:, :, 0])
    agent._rows_at_once = lambda: 2
    pieces = agent.simulate(STATES, noise=noise[:, :, 0])
    for ours, theirs in zip(whole, pieces, strict=True):
        assert ours is theirs is None or torch.allclose(ours, theirs, atol=1e-6)


def test_the_model_gets_clipped_actions_in_its_own_units() -> None:
    bound = 0.5
    agent = linear_model(value=true_value(0.9), bound=bound, simulation_horizon=1)
    noise = torch.tensor([-50.0, 0.1, 50.0]).expand(5, 3)[None, :, :, None]
    samples = agent.simulate(STATES, n_simulated=3, noise=noise)
    assert samples.actions.abs().max() > 10  # the policy's own
    for x in range(3):
        clipped = samples.actions[:, x].clamp(-bound, bound).numpy()
        np.testing.assert_allclose(samples.q_values[:, x], true_q(STATES.numpy(), clipped, 0.9), rtol=1e-5, atol=1e-5)


def test_termination_cuts_the_return() -> None:
    agent = linear_model(model=TrueModel(continues=0.0), simulation_horizon=5)
    samples = agent.simulate(STATES, n_simulated=2)
    rewards = STATES @ torch.as_tensor(Linear.c).float()
    torch.testing.assert_close(samples.q_values, rewards[:, None] + 0.3 * samples.actions[..., 0])


def test_mbpo_samples_the_states_of_its_rollouts() -> None:
    horizon, n = 5, 3
    agent = linear_model(MBPOPPO, value=true_value(0.9), simulation_horizon=horizon, n_simulated=n)
    noise = torch.randn(horizon, 5, 1, generator=torch.Generator().manual_seed(3))
    samples = agent.simulate(STATES, noise=noise)
    state, std = STATES.numpy().astype(np.float64), np.exp(-0.5)
    states, actions, rewards = [], [], []
    for k in range(horizon):
        action = state @ GAIN.T + OFFSET + std * noise[k].numpy()
        rewards.append(state @ Linear.c + action @ Linear.d)
        states.append(state)
        actions.append(action)
        state = state @ Linear.A.T + action @ Linear.B.T
    states.append(state)
    v, v_0 = true_value(0.9)
    for k in range(1, n + 1):
        following = states[-1] @ v + v_0
        for i in reversed(range(k, horizon)):
            next_value = states[i + 1] @ v + v_0
            following = rewards[i] + 0.9 * ((1 - 0.95) * next_value + 0.95 * following)
        np.testing.assert_allclose(samples.observations[:, k - 1], states[k], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(samples.actions[:, k - 1], actions[k], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(samples.q_values[:, k - 1], following, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(
            samples.advantages[:, k - 1], following - (states[k] @ v + v_0), rtol=1e-5, atol=1e-5
        )
        density = torch.distributions.Normal(torch.as_tensor(states[k] @ GAIN.T + OFFSET), std)
        log_prob = density.log_prob(torch.as_tensor(actions[k])).sum(dim=1)
        np.testing.assert_allclose(samples.log_probs[:, k - 1], log_prob, rtol=1e-5, atol=1e-5)
    assert samples.weights is None


def test_mbpo_weighs_a_state_by_the_chance_of_coming_there() -> None:
    agent = linear_model(
        MBPOPPO, simulation_horizon=4, n_simulated=3, model=TrueModel(continues=0.5), predict_termination=True
    )
    samples = agent.simulate(STATES)
    torch.testing.assert_close(samples.weights, torch.tensor([0.5, 0.25, 0.125]).expand(5, 3))
    samples = agent.simulate(STATES, n_simulated=7)  # three rollouts of three, three and one states, in step
    torch.testing.assert_close(samples.weights, torch.tensor([0.5] * 3 + [0.25] * 3 + [0.125]).expand(5, 7))


def test_mbpo_branches_as_often_as_its_samples_need() -> None:
    """Seven states at a horizon of four: three rollouts, each as a simulation of fewer states with its own noise."""
    agent = linear_model(MBPOPPO, value=true_value(0.9), simulation_horizon=4, n_simulated=7)
    noise = torch.randn(4, 3, 5, 1, generator=torch.Generator().manual_seed(3))
    samples = agent.simulate(STATES, noise=noise.flatten(1, 2))
    assert samples.observations.shape == (5, 7, 2) and samples.weights is None
    rollouts = [agent.simulate(STATES, n_simulated=3, noise=noise[:, r]) for r in range(3)]
    for j in range(7):
        step, r = divmod(j, 3)
        for ours, theirs in zip(samples[:5], rollouts[r][:5], strict=True):
            torch.testing.assert_close(ours[:, j], theirs[:, step], msg=f"sample {j}")
    agent._rows_at_once = lambda: 4
    pieces = agent.simulate(STATES, noise=noise.flatten(1, 2))
    torch.testing.assert_close(samples.q_values, pieces.q_values)


@pytest.mark.parametrize(("n", "n_rollouts"), [(8, 1), (11, 1), (12, 2), (16, 2), (32, 3), (64, 6)])
def test_mbpo_of_the_papers_ablation(n: int, n_rollouts: int) -> None:
    """Many-actions paper, appendix D: N of 8, 16, 32 and 64 at a horizon of 12."""
    agent = linear_model(MBPOPPO, simulation_horizon=12, n_simulated=n)
    rolled: list[tuple[int, int]] = []
    roll_out = agent.roll_out
    agent.roll_out = lambda starts, *args, n_kept: (
        rolled.append((len(starts), n_kept)), roll_out(starts, *args, n_kept=n_kept)
    )[1]  # fmt: skip
    samples = agent.simulate(STATES)
    assert sum(rows for rows, _ in rolled) == 5 * n_rollouts
    assert {kept for _, kept in rolled} == {-(-n // n_rollouts)} and max(kept for _, kept in rolled) <= 11
    assert samples.q_values.shape == samples.advantages.shape == samples.log_probs.shape == (5, n)
    # The rollouts from a state are not the same.
    assert len(torch.unique(samples.observations[0], dim=0)) == n


def test_mbpo_learns_with_more_states_than_its_horizon() -> None:
    model = tiny(MBPOPPO, n_simulated=9, simulation_horizon=3, warm_up_until=0.0).learn(32)
    assert model.logger.name_to_value["simulation/n_simulated"] == 9


def test_qma_takes_the_smaller_of_two() -> None:
    agent = linear_model(QMAPPO)
    samples = agent.simulate(STATES, n_simulated=4)
    assert samples.observations is None and samples.weights is None
    for x in range(4):
        with torch.no_grad():
            both = agent.q_networks(STATES, agent.model_actions(samples.actions[:, x]))
        assert both.shape == (2, 5)
        torch.testing.assert_close(samples.q_values[:, x], torch.minimum(*both))
    torch.testing.assert_close(samples.advantages, samples.q_values)  # the critic says 0


# ---------------------------------------------------------------- what is drawn


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_samples_have_the_policys_log_probabilities(cls: Any) -> None:
    agent = tiny(cls)
    observations = torch.randn(6, 3)
    samples = agent.simulate(observations)
    assert samples.actions.shape == (6, 3, 2)
    states = observations[:, None].expand(6, 3, 3) if samples.observations is None else samples.observations
    _, log_prob, _ = agent.policy.evaluate_actions(states.flatten(0, 1), samples.actions.flatten(0, 1))
    torch.testing.assert_close(samples.log_probs.flatten(), log_prob.detach())
    assert not any(x is not None and x.requires_grad for x in samples)


@pytest.mark.parametrize("cls", [MBMAPPO, QMAPPO])
def test_discrete_actions_are_enumerated_with_the_weight_of_the_draws(cls: Any) -> None:
    agent = tiny(cls, Toy(action_space=spaces.Discrete(4)))
    samples = agent.simulate(torch.randn(6, 3), n_simulated=5)
    assert samples.actions.tolist() == [[0, 1, 2, 3]] * 6
    torch.testing.assert_close(samples.weights, 5 * samples.log_probs.exp())
    torch.testing.assert_close(samples.weights.sum(dim=1), torch.full((6,), 5.0))


def test_mbpo_draws_discrete_actions() -> None:
    agent = tiny(MBPOPPO, Toy(action_space=spaces.Discrete(4)), predict_termination=False)
    samples = agent.simulate(torch.randn(6, 3), n_simulated=2)
    assert samples.actions.shape == (6, 2) and samples.weights is None
    assert set(samples.actions.flatten().tolist()) <= {0, 1, 2, 3}


def test_a_simulation_of_the_present_rollout() -> None:
    agent = collected(tiny(n_simulated=2))
    rollout = agent.current_rollout()
    assert rollout.observations.shape == (16, 3) and rollout.actions.shape == (16, 2)
    torch.testing.assert_close(agent.values_of(rollout.observations).detach(), rollout.values)
    samples = agent.simulate(rollout.observations)
    torch.testing.assert_close(samples.advantages, samples.q_values - rollout.values[:, None])


@pytest.mark.usefixtures("checks_of_distributions")
@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize(("network", "what"), [("reward", "returns"), ("transition", "states")])
def test_a_diverged_model_is_an_error(network: str, what: str, discrete: bool) -> None:
    for cls in (MBMAPPO, MBPOPPO):
        agent = tiny(cls, env="CartPole-v1") if discrete else tiny(cls)
        with torch.no_grad():
            getattr(agent.dynamics, network)[-1].bias.fill_(torch.inf)
        with pytest.raises(ValueError, match=f"simulated {what} are not finite: the model has diverged"):
            agent.simulate(torch.randn(6, 4 if discrete else 3))


@pytest.mark.usefixtures("checks_of_distributions")
@pytest.mark.parametrize(("env", "size", "parameter"), [(None, 3, "loc"), ("CartPole-v1", 4, "logits")])
def test_a_policy_that_is_not_finite_is_an_error(env: str | None, size: int, parameter: str) -> None:
    for cls in (MBMAPPO, MBPOPPO, QMAPPO):
        agent = tiny(cls, env=env)
        agent.simulate(torch.randn(6, size))
        with torch.no_grad():
            agent.policy.action_net.bias.fill_(torch.nan)
        with pytest.raises(ValueError, match=f"Expected parameter {parameter} "):
            agent.simulate(torch.randn(6, size))


# ---------------------------------------------------------------- the schedule of X


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({}, {0.0: 0, 0.01: 1, 0.075: 4, 0.15: 8, 1.0: 8}),
        ({"warm_up_until": 0.0}, {0.0: 8, 0.5: 8, 1.0: 8}),
        ({"warm_up_until": 0.5}, {0.0: 0, 0.25: 4, 0.5: 8, 1.0: 8}),
        ({"anneal_until": 0.15}, {0.0: 8, 0.01: 8, 0.075: 4, 0.14: 1, 0.15: 0, 1.0: 0}),
        ({"anneal_until": 1.0}, {0.0: 8, 0.5: 4, 0.99: 1, 1.0: 0}),
        ({"anneal_until": 1.0, "warm_up_until": 0.5}, {0.0: 0, 0.25: 3, 0.5: 4, 0.75: 2, 1.0: 0}),
    ],
)
def test_the_number_of_samples_follows_the_training(arguments: dict[str, Any], expected: dict[float, int]) -> None:
    agent = tiny(**{"n_simulated": 8, "warm_up_until": None, **arguments})
    for progress, n in expected.items():
        agent._progress = progress
        assert agent.current_n_simulated() == n, progress


def test_progress_is_that_at_which_the_rollout_began() -> None:
    agent = tiny(n_simulated=8, anneal_until=0.5, n_steps=10, batch_size=10)
    seen = []
    agent._update_policy = lambda rollout, samples: seen.append(samples.actions.shape[1])
    agent.learn(100)
    assert seen == [8, 7, 5, 4, 2]  # ceil(8 (1 - p / 0.5)), p = 0, 0.1, ..., 0.4
    seen.clear()
    agent.learn(100)
    assert seen == [8, 7, 5, 4, 2]
    seen.clear()
    agent.learn(100, reset_num_timesteps=False)  # the second half of 200 steps
    assert seen == []
