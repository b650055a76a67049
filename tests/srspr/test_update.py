"""The parts of SR-SPR's gradient step by themselves, and the whole of it by hand."""

import copy
import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from sb3_sample.learner.augmentation import shifted
from sb3_sample.srspr import losses
from sb3_sample.srspr.augmentation import SHIFT, augmented
from sb3_sample.srspr.learner import AugmentationNoise
from sb3_sample.srspr.networks import NETWORKS, NoisyLinear, SPRNetwork, renormalize
from sb3_sample.srspr.replay import StateWindows
from tests.srspr.common import SIZE, TINY, tiny

ATOMS = torch.linspace(-10, 10, 51, dtype=torch.float64)

# ---------------------------------------------------------------- the distribution of returns


def test_a_target_inside_of_the_support_keeps_its_mean() -> None:
    generator = torch.Generator().manual_seed(0)
    probabilities = torch.rand(20, 51, generator=generator, dtype=torch.float64).softmax(dim=1)
    rewards = torch.linspace(-3, 3, 20, dtype=torch.float64)[:, None]
    positions = rewards + 0.6 * ATOMS
    moved = losses.project(probabilities, positions, ATOMS)
    assert torch.allclose(moved.sum(dim=1), torch.ones(20, dtype=torch.float64))
    assert torch.allclose((moved * ATOMS).sum(dim=1), (probabilities * positions).sum(dim=1))
    # By the formula, atom by atom.
    for j in range(51):
        shares = (1 - (positions.clamp(-10, 10) - ATOMS[j]).abs() / 0.4).clamp(0, 1)
        assert torch.allclose(moved[:, j], (probabilities * shares).sum(dim=1))


def test_without_bootstrap_two_atoms_hold_the_reward() -> None:
    probabilities = torch.full((1, 51), 1 / 51, dtype=torch.float64)
    moved = losses.project(probabilities, torch.full((1, 51), 0.5, dtype=torch.float64), ATOMS)[0]
    assert moved.nonzero().flatten().tolist() == [26, 27] and moved[26] == pytest.approx(0.75)
    outside = losses.project(probabilities, torch.full((1, 51), 12.0, dtype=torch.float64), ATOMS)[0]
    assert outside[50] == pytest.approx(1)


def test_returns_and_masks_of_an_episode_that_ends_at_each_place() -> None:
    """A terminal in the last of the n steps is seen: published replays bootstrap over it."""
    gamma, n = 0.9, 10
    rewards = torch.arange(1.0, n + 1).double()[None]
    for last in range(n + 1):
        terminated = torch.zeros(1, n, dtype=torch.float64)
        terminated[0, last:] = 1.0 if last < n else 0.0  # what lies behind an end may be anything
        terminated[0, last + 1 :] = 0.0
        value, discount = losses.n_step_return(rewards, terminated, gamma)
        counted = min(last + 1, n)
        assert value.item() == pytest.approx(sum(gamma**k * (k + 1) for k in range(counted)))
        assert discount.item() == pytest.approx(gamma**n if last == n else 0)
        # State k is masked if one of the steps before it was terminal, not if the step from it is.
        assert losses.alive_after(terminated)[0].tolist() == [float(k < last) for k in range(n)]


# ---------------------------------------------------------------- predictions


def test_the_loss_of_predictions() -> None:
    generator = torch.Generator().manual_seed(0)
    targets = torch.randn(6, 5, 7, generator=generator)
    mask = torch.ones(6, 5)
    assert losses.spr_loss(3 * targets, targets, mask).abs().max() < 1e-6
    assert losses.spr_loss(-targets, targets, mask).tolist() == pytest.approx([4.0] * 6)
    others = torch.randn(6, 5, 7, generator=generator)
    loss = losses.spr_loss(others, targets, mask)
    assert (loss <= 4).all()
    assert torch.allclose(loss, (2 - 2 * F.cosine_similarity(others, targets, dim=2)).mean(dim=1), atol=1e-6)
    mask[0, 2:] = 0
    masked = losses.spr_loss(others, targets, mask)
    cosines = F.cosine_similarity(others, targets, dim=2)[0]
    assert masked[0].item() == pytest.approx((2 - 2 * cosines[:2]).sum().item() / 5, rel=1e-5)
    # Row 0 is masked as any other: published code never masks it.
    assert torch.equal(masked[1:], loss[1:])


# ---------------------------------------------------------------- augmentation


def test_shifts() -> None:
    pictures = torch.arange(2 * 3 * 6 * 5).view(2, 3, 6, 5).to(torch.uint8)
    padded = F.pad(pictures.float(), (4, 4, 4, 4), mode="replicate").to(torch.uint8)
    for row, column in itertools.product(range(9), range(9)):
        got = shifted(pictures, torch.tensor([[row, column], [4, 4]]), SHIFT)
        assert torch.equal(got[0], padded[0, :, row : row + 6, column : column + 5])
        assert torch.equal(got[1], pictures[1])
    noise = AugmentationNoise.draw(81 * 200, torch.device("cpu"))
    counts = torch.bincount(noise.offsets[:, 0] * 9 + noise.offsets[:, 1], minlength=81)
    # All 9 x 9 offsets equally often: chi-square of 80 degrees of freedom, 124 is its 0.1% quantile.
    assert ((counts - 200.0).square() / 200).sum() < 124
    assert noise.brightness.std() == pytest.approx(1, abs=0.03)


def test_brightness_is_of_a_picture_and_bounded() -> None:
    pictures = torch.full((3, 4, 6, 5), 255, dtype=torch.uint8)
    got = augmented(pictures, torch.full((3, 2), 4), torch.tensor([0.0, 1.0, -5.0]))
    assert torch.allclose(got.amin(dim=(1, 2, 3)), torch.tensor([1.0, 1.05, 0.9]))
    assert torch.allclose(got.amax(dim=(1, 2, 3)), torch.tensor([1.0, 1.05, 0.9]))


# ---------------------------------------------------------------- networks


def test_the_network_has_the_published_sizes_and_initialisation() -> None:
    network = SPRNetwork((4, 84, 84), 6)
    assert network.encoder.latent_shape == (64, 11, 11)
    assert sum(p.numel() for p in network.parameters()) == pytest.approx(4.57e6, rel=0.002)
    weight = network.projection.weight
    assert isinstance(weight, torch.Tensor)
    bound = math.sqrt(6 / (7744 + 512))
    assert 0.99 * bound < weight.abs().max() <= bound
    assert all((p == 0).all() for name, p in network.named_parameters() if name.endswith("bias"))


def test_borders_are_those_of_same_padding() -> None:
    """An odd zero comes after, as in TensorFlow and JAX."""
    network = SPRNetwork((4, 84, 84), 3, **TINY)
    x = torch.rand(2, 4, 84, 84)
    y = x
    for layer, pads in zip(network.encoder.convolutions, ((2, 2), (1, 2), (1, 1)), strict=True):
        y = F.relu(F.conv2d(F.pad(y, (*pads, *pads)), layer.weight, layer.bias, layer.stride))
    assert y.shape[2:] == (11, 11)
    assert torch.allclose(network.encoder(x), renormalize(y), atol=1e-6)


def test_latent_states_are_scaled_by_their_own_extremes() -> None:
    latent = torch.rand(3, 2, 4, 4) * torch.tensor([1.0, 10.0, 0.0])[:, None, None, None]
    scaled = renormalize(latent)
    assert scaled[:2].amin(dim=(1, 2, 3)).tolist() == [0, 0] and (scaled[2] == 0).all()
    assert scaled[:2].amax(dim=(1, 2, 3)).tolist() == pytest.approx([1, 1], abs=1e-4)


@pytest.mark.parametrize("network", NETWORKS)
def test_projection_and_head_of_each_reading(network: str) -> None:
    made = SPRNetwork((4, SIZE, SIZE), 3, network=network, **TINY)
    latent = torch.rand(5, *made.encoder.latent_shape)
    h: Any = made.projection(latent.flatten(1))
    assert torch.equal(made.project(latent), h) and h.min() < 0  # without an activation
    head = made.head
    if network == "bronet_after_projection":
        h = head.dense(h)
    if network != "nature":
        h = F.layer_norm(h, (8,), eps=1e-6)
    h = F.relu(h)
    if network != "nature":
        assert len(head.blocks) == 1
        h = head.blocks[0](h.clone())
    advantage = head.advantage(h).view(5, 3, 51)
    expected = head.value(h)[:, None] + advantage - advantage.mean(dim=1, keepdim=True)
    assert torch.allclose(made.logits(latent), expected, atol=1e-6)


def test_the_factors_of_noise_are_independent() -> None:
    """Published code draws both from one key."""
    torch.manual_seed(0)
    layer = NoisyLinear(4, 4)
    draws = []
    for _ in range(4000):
        layer.draw()
        draws.append(torch.cat((layer.noise_in, layer.noise_out)))
    correlation = torch.corrcoef(torch.stack(draws).T) - torch.eye(8)
    assert correlation.abs().max() < 0.08
    x = torch.rand(2, 4)
    weight = layer.weight + layer.weight_scale * layer.noise_out[:, None] * layer.noise_in
    assert torch.allclose(layer(x), F.linear(x, weight, layer.bias + layer.bias_scale * layer.noise_out), atol=1e-6)
    layer.silence()
    assert torch.allclose(layer(x), F.linear(x, layer.weight, layer.bias))


# ---------------------------------------------------------------- the whole


def some_windows(n: int, k: int, batch_size: int = 4) -> StateWindows:
    rng = np.random.default_rng(0)
    terminated = np.zeros((batch_size, max(n, k)), np.float32)
    terminated[1, 1] = terminated[2, n - 1] = 1
    return StateWindows(
        torch.from_numpy(rng.integers(0, 256, (k + 2, batch_size, 4, SIZE, SIZE), np.uint8)),
        torch.from_numpy(rng.integers(0, 3, (batch_size, k))),
        torch.from_numpy(rng.normal(size=terminated.shape).astype(np.float32)),
        torch.from_numpy(terminated),
        torch.tensor([1.0, 0.5, 0.25, 0.75])[:batch_size],
    )


@pytest.mark.parametrize("network", ["nature", "bronet"])
def test_a_gradient_step_by_hand(network: str) -> None:
    """Window by window, in float64, by the specification's formulas; Adam and the average that follows it."""
    n, k, gamma = 3, 2, 0.97
    model = tiny(network=network, gamma=gamma, v_min=-5.0, v_max=5.0, learning_rate=1e-2)
    learner, windows = model.learner, some_windows(n, k)
    with torch.no_grad():
        for p in learner.target.parameters():
            p.add_(0.05 * torch.randn_like(p))
    online, target = (copy.deepcopy(each).double() for each in (learner.online, learner.target))
    old_target = copy.deepcopy(target)
    noise = AugmentationNoise.draw(4 * (k + 2), torch.device("cpu"))
    metrics, td_losses = learner.step(windows, noise)

    states = augmented(windows.states.flatten(0, 1), noise.offsets, noise.brightness).double().unflatten(0, (k + 2, 4))
    atoms = torch.linspace(-5, 5, 51, dtype=torch.float64)
    total, expected = torch.zeros((), dtype=torch.float64), []
    for i in range(4):
        ends = windows.terminated[i].tolist()
        first = ends.index(1) if 1 in ends else None
        counted = n if first is None else min(first + 1, n)
        reward = sum(gamma**j * windows.rewards[i, j].item() for j in range(counted))
        discount = 0 if first is not None and first < n else gamma**n
        with torch.no_grad():
            values = online(states[-1, i : i + 1]).softmax(dim=-1) @ atoms
            p = target(states[-1, i : i + 1]).softmax(dim=-1)[0, int(values.argmax())]
            shares = (1 - ((reward + discount * atoms).clamp(-5, 5) - atoms[:, None]).abs() / 0.2).clamp(0, 1)
            m = (p * shares).sum(dim=1)
        z = online.encoder(states[0, i : i + 1])
        ce = -(m * online.logits(z)[0, windows.actions[i, 0]].log_softmax(dim=0)).sum()
        spr = torch.zeros((), dtype=torch.float64)
        for j in range(k):
            z = online.transition(z, windows.actions[i : i + 1, j])
            y = target.project(target.encoder(states[j + 1, i : i + 1])).detach()
            if first is None or first > j:
                spr = spr + 2 - 2 * F.cosine_similarity(online.predictor(online.project(z)), y)[0]
        expected.append(ce.item())
        total = total + windows.weights[i] * (ce + 5 * spr / k) / 4
    total.backward()
    assert td_losses.tolist() == pytest.approx(expected, rel=1e-4)
    assert metrics["train/loss"].item() == pytest.approx(total.item(), rel=1e-4)
    new = dict(learner.online.named_parameters())
    compared = 0
    for (name, p), before, after in zip(
        online.named_parameters(), old_target.parameters(), learner.target.parameters(), strict=True
    ):
        gradient = p.grad if p.grad is not None else torch.zeros_like(p)
        # The first step of Adam: m / (sqrt(v) + eps), both corrected. Where the gradient is far from eps.
        clear = gradient.abs() > 1e-5
        step = gradient / (gradient.abs() + 1.5e-4)
        assert torch.allclose(new[name].double()[clear], (p - 1e-2 * step)[clear], atol=2e-4), name
        compared += int(clear.sum())
        assert torch.allclose(after.double(), torch.lerp(before, new[name].double(), 0.005), atol=1e-6)
    assert compared > 500
    assert all(p.grad is None for p in learner.target.parameters())
