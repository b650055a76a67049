"""Sharpness-aware minimisation of the critics' loss: the update against two explicit gradients."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from sb3_sample import SAC
from sb3_sample.learner.batch import Batch, Noise
from sb3_sample.networks.batch_norm import running_moments
from tests.sac.common import MAKERS, bro, differing, random_batch, sac, state, vec
from tests.sac.test_update import NoSynchronisation

IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)
#: Plain gradient descent, whose steps show the gradient.
DESCENT: dict[str, Any] = {"optimizer_class": torch.optim.SGD, "net_arch": [8]}


def named(model: SAC) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in model.critic.named_parameters()}


def step_by_hand(model: SAC, batch: Batch, noise: Noise, radius: float, rate: float) -> dict[str, torch.Tensor]:
    """
    The critics' parameters after one step, from two explicit gradients: each critic, and the features extractor that
    they share, goes uphill by the radius.
    """
    with torch.no_grad():
        action, log_prob = model.actor.sample(batch.next_observations, noise.critic)
        q = model.critic_target(batch.next_observations, action)
        value = q.mean(dim=0) - float(model.pessimism) * (q[0] - q[1]).abs() / 2
        bonus = -model.temperature() * log_prob
        target = batch.rewards + model.gamma * (1 - batch.dones) * (value + bonus)

    def gradients() -> list[torch.Tensor]:
        loss = model.learner.head.loss(model.critic(batch.observations, batch.actions), target)
        return list(torch.autograd.grad(loss, list(model.critic.parameters())))

    names = [name for name, _ in model.critic.named_parameters()]
    shared = [name.startswith("features_extractor") for name in names]
    before, first = named(model), gradients()
    with torch.no_grad():
        together = [g for g, is_shared in zip(first, shared, strict=True) if is_shared]
        length = torch.sqrt(sum((g**2).sum() for g in together)) if together else None
        for p, g, is_shared in zip(model.critic.parameters(), first, shared, strict=True):
            if is_shared:
                p += radius * g / length
                continue
            for e in range(2):
                squares = sum((h[e] ** 2).sum() for h, other in zip(first, shared, strict=True) if not other)
                p[e] += radius * g[e] / torch.sqrt(squares)
    second = gradients()
    with torch.no_grad():
        for name, p in model.critic.named_parameters():
            p.copy_(before[name])
    assert any(not torch.allclose(a, b, rtol=1e-2) for a, b in zip(first, second, strict=True)), "no difference"
    return {name: before[name] - rate * g for name, g in zip(names, second, strict=True)}


@pytest.mark.parametrize("n_quantiles", [None, 5])
def test_one_step_by_hand(n_quantiles: int | None) -> None:
    model = sac(sam_radius=0.3, learning_rate=0.01, n_quantiles=n_quantiles, policy_kwargs=DESCENT)
    batch, noise = random_batch(model), Noise(*torch.randn(3, 8, 2))
    expected = step_by_hand(model, batch, noise, 0.3, 0.01)
    before = named(model)
    model._update(batch, noise)
    for name, value in named(model).items():
        assert not torch.equal(value, before[name]), name
        torch.testing.assert_close(value, expected[name], rtol=1e-4, atol=1e-6)


def test_one_step_with_a_features_extractor() -> None:
    """The CNN that both critics share is no stack of two."""
    kwargs = {**DESCENT, "features_extractor_kwargs": {"features_dim": 8}}
    model = sac(vec(obs_space=IMAGE), policy="CnnPolicy", sam_radius=0.3, learning_rate=0.01, buffer_size=50,
                policy_kwargs=kwargs)  # fmt: skip
    g = torch.Generator().manual_seed(0)
    batch = random_batch(model)
    images = torch.randint(0, 256, (2, 8, *model.observation_space.shape), generator=g, dtype=torch.uint8)
    batch = batch._replace(observations=images[0], next_observations=images[1])
    noise = Noise(*torch.randn(3, 8, 2))
    expected = step_by_hand(model, batch, noise, 0.3, 0.01)
    assert any(name.startswith("features_extractor") for name in expected)
    model._update(batch, noise)
    for name, value in named(model).items():
        torch.testing.assert_close(value, expected[name], rtol=1e-3, atol=1e-6)


def test_the_loss_reported_is_the_one_at_the_parameters() -> None:
    noise = Noise(*torch.randn(3, 8, 2))
    with_sam, without = sac(sam_radius=0.3), sac()
    losses = [model._update(random_batch(model), noise)["train/critic_loss"] for model in (with_sam, without)]
    assert torch.equal(*losses)
    assert differing(state(with_sam), state(without))


@pytest.mark.parametrize("maker", ["CrossQ", "CrossQ+WN", "XQC", "FlashSAC"])
def test_the_pass_uphill_leaves_running_moments_alone(maker: str) -> None:
    """A gradient step moves them once, and by the same as a step without a pass uphill."""
    noise = Noise(*torch.randn(3, 16, 2))
    moments = []
    for radius in (0.5, None):
        model = MAKERS[maker](sam_radius=radius)
        before = {name: each.clone() for name, each in running_moments(model.critic)}
        model.learner.update(random_batch(model, 16), noise)
        moments.append({name: each.clone() for name, each in running_moments(model.critic)})
        assert all(not torch.equal(each, before[name]) for name, each in moments[-1].items())
    assert not differing(*moments)
    passes = [each.item() for name, each in moments[0].items() if name.endswith("n_passes")]
    assert set(passes) == ({1} if maker == "CrossQ" else set())


def test_a_tiny_radius_is_no_radius() -> None:
    noise = Noise(*torch.randn(3, 8, 2))
    models = sac(sam_radius=1e-7, policy_kwargs=DESCENT), sac(policy_kwargs=DESCENT)
    for model in models:
        model._update(random_batch(model), noise)
    for ours, theirs in zip(*(model.critic.parameters() for model in models), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)


def test_critics_that_are_right_already() -> None:
    """A gradient of zero: nothing moves, nothing is NaN."""
    model = sac(sam_radius=0.05, gamma=0.0)
    with torch.no_grad():
        model.critic.head.weight.zero_()
    before = named(model)
    batch = random_batch(model)
    model._update(batch._replace(rewards=torch.zeros(8, 1)))
    assert all(torch.equal(value, before[name]) for name, value in named(model).items())


@pytest.mark.parametrize("make", [sac, bro])
def test_learns_without_waiting_for_the_device(make: Callable[..., Any]) -> None:
    model = make(sam_radius=0.05).learn(14)
    assert all(torch.isfinite(p).all() for p in model.policy.parameters())
    with NoSynchronisation():
        model._update(random_batch(model))


@pytest.mark.parametrize("radius", [0.0, -0.1, float("nan"), float("inf")])
def test_bad_radius(radius: float) -> None:
    with pytest.raises(ValueError, match="sam_radius") as caught:
        sac(sam_radius=radius)
    assert str(radius) in str(caught.value)


@pytest.mark.parametrize("radius", [0.2, None])
def test_radius_at_loading(radius: float | None, tmp_path: Path) -> None:
    sac(sam_radius=0.05).save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=vec(), sam_radius=radius)
    reference = sac(sam_radius=radius)
    noise = Noise(*torch.randn(3, 8, 2))
    for model in (loaded, reference):
        model._update(random_batch(model), noise)
    assert not differing(state(loaded), state(reference))
