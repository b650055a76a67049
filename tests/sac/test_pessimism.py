"""How an ensemble becomes one value."""

from contextlib import nullcontext

import pytest
import torch

from sb3_sample.learner.batch import Noise
from sb3_sample.learner.pessimism import Pessimism, epistemic_std, pessimistic_value
from sb3_sample.sac import VPLSAC
from tests.sac.common import TINY_SAC, bro, differing, random_batch, sac, state, vec

Q = torch.tensor([[[1.0, 2.0], [3.0, 0.0]], [[3.0, -2.0], [3.0, 4.0]]])  # (E, B, K) = (2, 2, 2)


def test_spread_by_hand() -> None:
    # |1 - 3| / 2, |2 + 2| / 2, |3 - 3| / 2, |0 - 4| / 2: per quantile, before any average over quantiles.
    torch.testing.assert_close(epistemic_std(Q), torch.tensor([[1.0, 2.0], [0.0, 2.0]]))


@pytest.mark.parametrize("n_critics", [1, 2, 3, 5])
def test_spread_is_the_population_deviation(n_critics: int) -> None:
    q = torch.randn(n_critics, 4, 3, generator=torch.Generator().manual_seed(n_critics))
    torch.testing.assert_close(epistemic_std(q), q.std(dim=0, unbiased=False), rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("n_critics", [1, 2, 3])
def test_spread_of_agreeing_critics_has_a_finite_gradient(n_critics: int) -> None:
    q = torch.ones(n_critics, 4, 3, requires_grad=True)
    epistemic_std(q).sum().backward()
    assert q.grad is not None and torch.isfinite(q.grad).all()


@pytest.mark.parametrize(
    ("beta", "expected"),
    [
        (0.0, [[2.0, 0.0], [3.0, 2.0]]),  # the mean
        (1.0, [[1.0, -2.0], [3.0, 0.0]]),  # the minimum
        (0.5, [[1.5, -1.0], [3.0, 1.0]]),
        (2.0, [[0.0, -4.0], [3.0, -2.0]]),
    ],
)
def test_value_by_hand(beta: float, expected: list[list[float]]) -> None:
    torch.testing.assert_close(Pessimism(beta).value(Q), torch.tensor(expected))


def test_three_critics_by_hand() -> None:
    q = torch.tensor([1.0, 2.0, 6.0]).reshape(3, 1, 1)
    # Mean 3, population variance (4 + 1 + 9) / 3.
    value = Pessimism(1.0).value(q)
    assert value.item() == pytest.approx(3 - (14 / 3) ** 0.5, rel=1e-6)


def test_shortcuts_are_the_formula() -> None:
    q = torch.randn(2, 5, 4)
    for beta in (0.0, 1.0):
        torch.testing.assert_close(
            Pessimism(beta).value(q), q.mean(dim=0) - beta * q.std(dim=0, unbiased=False), rtol=1e-5, atol=1e-6
        )


@pytest.mark.parametrize("beta", [-0.1, float("nan")])
def test_bad_beta(beta: float) -> None:
    with pytest.raises(ValueError, match=f"pessimism.*{beta}"):
        Pessimism(beta)
    with pytest.raises(ValueError, match=f"pessimism.*{beta}"):
        bro(pessimism=beta)


def test_more_pessimism_lower_targets() -> None:
    """The argument reaches the update: the learned values are lower."""
    means = []
    for beta in (0.0, 1.0, 5.0):
        model = sac(pessimism=beta, ent_coef=0.0, gamma=0.9, tau=0.1, learning_rate=1e-2)
        batch = random_batch(model, 32)
        for _ in range(60):
            torch.manual_seed(0)
            metrics = model._update(batch)
        means.append(metrics["train/q_mean"].item())
    assert means[0] > means[1] > means[2], means


@pytest.mark.parametrize("n_critics", [1, 3])
def test_other_ensemble_sizes_learn(n_critics: int) -> None:
    for make in (sac, bro):
        kwargs = {"policy_kwargs": {"n_critics": n_critics}}
        no_spread = make is bro and n_critics == 1
        with pytest.warns(UserWarning, match="is 0 with n_critics=1") if no_spread else nullcontext():
            model = make(**kwargs)
        metrics = model._update(random_batch(model))
        assert all(torch.isfinite(value).all() for value in metrics.values())
        assert model.critic(torch.zeros(4, 3), torch.zeros(4, 2)).shape[0] == n_critics


# ------------------------------------------------------------------ what fixed pessimism is equal to


@pytest.mark.parametrize("beta", [0.0, 0.3, 1.0, 2.5])
@pytest.mark.parametrize("n_critics", [1, 2, 3])
def test_a_tensor_weighs_as_a_number(beta: float, n_critics: int) -> None:
    q = torch.randn(n_critics, 5, 4, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(pessimistic_value(q, torch.tensor(beta)), pessimistic_value(q, beta))


@pytest.mark.parametrize("beta", [0.0, 1.0])
@pytest.mark.parametrize("n_quantiles", [None, 5])
def test_one_is_the_minimum_and_zero_the_mean_in_both_losses(beta: float, n_quantiles: int | None) -> None:
    """The critics' target and the actor's objective of a step, assembled from the networks."""
    # With learning rate 0 the actor sees the critics that the test sees.
    model = sac(pessimism=beta, n_quantiles=n_quantiles, gamma=0.9, ent_coef=0.3, learning_rate=0.0)
    batch = random_batch(model)
    noise = Noise(torch.randn(8, 2), torch.randn(8, 2))

    def value(q: torch.Tensor) -> torch.Tensor:
        return q.min(dim=0).values if beta == 1 else q.mean(dim=0)

    with torch.no_grad():
        action, log_prob = model.actor.sample(batch.next_observations, noise.critic)
        next_value = value(model.critic_target(batch.next_observations, action))
        target = batch.rewards + 0.9 * (1 - batch.dones) * (next_value - 0.3 * log_prob)
        critic_loss = model.learner.head.loss(model.critic(batch.observations, batch.actions), target)
        action, log_prob = model.actor.sample(batch.observations, noise.actor)
        actor_loss = (0.3 * log_prob.flatten() - value(model.critic(batch.observations, action)).mean(dim=1)).mean()
    metrics = model._update(batch, noise)
    assert metrics["train/critic_loss"].item() == pytest.approx(critic_loss.item(), rel=1e-5)
    assert metrics["train/actor_loss"].item() == pytest.approx(actor_loss.item(), rel=1e-4)


@pytest.mark.parametrize("beta", [0.0, 0.5, 1.0])
def test_vpl_with_fixed_pessimism_and_nothing_held_out_is_sac_step_for_step(beta: float) -> None:
    plain = sac(pessimism=beta)
    ours = VPLSAC("MlpPolicy", vec(), **TINY_SAC, seed=0, validation_proportion=0, pessimism=beta)
    assert not differing(state(ours), state(plain))
    for seed in range(10):
        metrics = []
        for model in (ours, plain):
            torch.manual_seed(seed)
            metrics.append(model._update(random_batch(model, seed=seed)))
        assert metrics[0] == metrics[1]
        assert not differing(state(ours), state(plain))


def test_the_actors_own_pessimism() -> None:
    """``actor_pessimism`` changes the actor's objective, and nothing of the critics' first step."""
    batch = random_batch(sac())
    rows = []
    for kwargs in ({}, {"actor_pessimism": 1.0}, {"actor_pessimism": 0.0}, {"pessimism": 0.0}):
        model = sac(learning_rate=0.0, **kwargs)
        torch.manual_seed(0)
        metrics = model._update(batch)
        rows.append([metrics[f"train/{name}_loss"].item() for name in ("critic", "actor")])
    assert rows[0] == rows[1]
    assert rows[2][0] == rows[0][0] != rows[3][0]
    assert rows[2][1] == rows[3][1] < rows[0][1]
