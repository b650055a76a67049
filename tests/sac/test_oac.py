"""OAC: the actor's mean shifted along the gradient of an upper bound, as far as a divergence allows."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from sb3_sample import OAC
from sb3_sample.learner.exploration import OptimisticGradient
from sb3_sample.learner.losses import gaussian_kl
from tests.sac.common import differing, sac, state, vec

DICT = spaces.Dict({"a": spaces.Box(-10, 10, (3,), np.float32), "b": spaces.Box(-5, 5, (2, 2), np.float64)})


def oac(env: Any = None, **kwargs: Any) -> Any:
    model = sac(env, cls=OAC, **kwargs)
    assert isinstance(model.explorer, OptimisticGradient)
    return model


def constant_gaussian(model: Any, mean: list[float], std: list[float]) -> None:
    with torch.no_grad():
        model.actor.mean.weight.zero_()
        model.actor.mean.bias.copy_(torch.tensor(mean))
        model.actor.log_std.weight.zero_()
        model.actor.log_std.bias.copy_(torch.atanh((torch.tensor(std).log() + 10) / 6 - 1))


class LinearCritics(torch.nn.Module):
    """Q1 = 4 a + 2 b + 1 and Q2 = 2 a + 2 b: their mean climbs by (3, 2), half their distance by (1, 0)."""

    def forward(self, obs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        a, b = actions[:, :1], actions[:, 1:]
        return torch.stack((4 * a + 2 * b + 1, 2 * a + 2 * b))


@pytest.mark.parametrize(
    ("optimism", "shift"),
    [
        # g = (3, 2) + 2 (1, 0), S g = (0.25 * 5, 2), g'Sg = 10.25, sqrt(2 * 0.5) = 1
        (2.0, (1.25 / math.sqrt(10.25), 2 / math.sqrt(10.25))),
        # g = (3, 2), S g = (0.75, 2), g'Sg = 6.25
        (0.0, (0.3, 0.8)),
    ],
)
def test_shift_by_hand(optimism: float, shift: tuple[float, float]) -> None:
    model = oac(optimism=optimism, kl_radius=0.5)
    constant_gaussian(model, [0.0, 0.0], [0.5, 1.0])
    object.__setattr__(model.policy, "critic", LinearCritics())
    mean, std = model.explorer.shifted_mean(model.learner, torch.randn(4, 3))
    torch.testing.assert_close(mean, torch.tensor([shift] * 4), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(std, torch.tensor([[0.5, 1.0]] * 4))


@pytest.mark.parametrize("n_quantiles", [None, 5])
def test_shift_maximises_the_linear_approximation(n_quantiles: int | None) -> None:
    """Against a dense grid of all shifts of the largest divergence allowed, in two dimensions."""
    model = oac(optimism=1.7, kl_radius=0.8, n_quantiles=n_quantiles, seed=4)
    with torch.no_grad():
        model.critic.head.weight.mul_(30)  # far from the floor of the gradient's length
    observations = torch.randn(16, 3)
    with torch.no_grad():
        mean, log_std = model.actor.gaussian(model.actor.features(observations))
    std = log_std.exp()
    at = mean.clone().requires_grad_()
    q = model.critic(observations, torch.tanh(at))
    bound = (q.mean(dim=0) + 1.7 * (q[0] - q[1]).abs() / 2).mean(dim=1)
    (g,) = torch.autograd.grad(bound.sum(), at)

    angles = torch.linspace(0, 2 * math.pi, 20_001)
    circle = torch.stack((angles.cos(), angles.sin()), dim=1)
    candidates = math.sqrt(2 * 0.8) * std[:, None] * circle  # (B, angles, A)
    gains = (candidates * g[:, None]).sum(dim=2)
    best = gains.max(dim=1)
    shifted, _ = model.explorer.shifted_mean(model.learner, observations)
    torch.testing.assert_close(((shifted - mean) * g).sum(dim=1), best.values, rtol=1e-3, atol=1e-6)
    expected = candidates[torch.arange(16), best.indices]
    assert ((shifted - mean - expected) / std).abs().max() < 5e-3


def test_divergence_is_the_radius() -> None:
    model = oac()
    with torch.no_grad():
        model.critic.head.weight.mul_(30)
    assert model.explorer.kl_radius == pytest.approx(6.80805)
    observations = torch.randn(16, 3)
    shifted, std = model.explorer.shifted_mean(model.learner, observations)
    with torch.no_grad():
        mean, _ = model.actor.gaussian(model.actor.features(observations))
    np.testing.assert_allclose(gaussian_kl(shifted, std, mean, std), 3.69**2 / 2, rtol=1e-3)


def test_radius_zero_is_the_actor() -> None:
    model = oac(kl_radius=0.0)
    observations = torch.randn(8, 3)
    torch.manual_seed(0)
    actions = model.explorer.act(model.learner, observations)
    torch.manual_seed(0)
    assert torch.equal(actions, model.actor.sample(observations)[0])


def test_gradient_of_zero() -> None:
    """Critics that do not see the action: no shift, and no NaN."""
    model = oac()
    with torch.no_grad():
        model.critic.head.weight.zero_()
    observations = torch.randn(8, 3)
    shifted, _ = model.explorer.shifted_mean(model.learner, observations)
    with torch.no_grad():
        mean, _ = model.actor.gaussian(model.actor.features(observations))
    torch.testing.assert_close(shifted, mean, rtol=1e-6, atol=1e-6)


def test_acts_around_the_shifted_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    model = oac(optimism=0.0, kl_radius=0.5)
    constant_gaussian(model, [0.0, 0.0], [0.5, 1.0])
    object.__setattr__(model.policy, "critic", LinearCritics())
    monkeypatch.setattr(torch, "randn_like", torch.ones_like)
    actions = model.explorer.act(model.learner, torch.randn(3, 3))
    torch.testing.assert_close(actions, torch.tanh(torch.tensor([[0.3 + 0.5, 0.8 + 1.0]] * 3)))


def test_acts_in_inference_mode_and_leaves_no_gradient() -> None:
    model = oac()
    observations = torch.randn(4, 3)
    torch.manual_seed(0)
    expected = model.explorer.act(model.learner, observations)
    torch.manual_seed(0)
    with torch.inference_mode():
        actions = model.explorer.act(model.learner, observations * 1)
        assert torch.is_inference_mode_enabled()
    assert torch.equal(actions, expected)
    for name in ("actor", "critic"):
        assert all(p.grad is None for p in getattr(model, name).parameters())


@pytest.mark.parametrize("n_envs", [1, 3])
def test_dict_observations(n_envs: int) -> None:
    model = oac(vec(n_envs, obs_space=DICT), policy="MultiInputPolicy").learn(21)
    assert model._n_updates > 0
    assert all(torch.isfinite(p).all() for p in model.policy.parameters())
    assert np.isfinite(model.replay_buffer.actions[: model.replay_buffer.pos]).all()


def test_predict_is_the_actors() -> None:
    model, plain = oac(), sac()
    observations = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    for deterministic in (True, False):
        torch.manual_seed(0)
        ours, _ = model.predict(observations, deterministic=deterministic)
        torch.manual_seed(0)
        np.testing.assert_array_equal(ours, plain.predict(observations, deterministic=deterministic)[0])


def test_warm_up_is_random_and_exploration_is_shifted() -> None:
    model = oac(learning_starts=5, replay_ratio=0, kl_radius=2e4)
    constant_gaussian(model, [0.0, 0.0], [0.5, 1.0])
    critics = LinearCritics()
    # learn looks at the moments of every optimizer at its end.
    critics.optimizer = model.critic.optimizer
    object.__setattr__(model.policy, "critic", critics)
    model.learn(15)
    taken = model.replay_buffer.actions[:15].reshape(15, 2)
    assert (taken[5:] > 0.999).all() and not (taken[:5] > 0.999).all()


def test_needs_a_gaussian() -> None:
    with pytest.raises(ValueError, match="oac.*backbone='sac'"):
        sac(cls=OAC, backbone="td3")


@pytest.mark.parametrize(
    ("name", "value"), [("optimism", -1.0), ("optimism", math.inf), ("kl_radius", -0.5), ("kl_radius", math.nan)]
)
def test_bad_arguments(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name) as caught:
        sac(cls=OAC, **{name: value})
    assert str(value) in str(caught.value)


def test_without_its_exploration_it_is_sac() -> None:
    ours, theirs = sac(cls=OAC, exploration="actor", seed=3).learn(30), sac(seed=3).learn(30)
    assert not differing(state(ours), state(theirs))


def test_arguments_at_loading(tmp_path: Path) -> None:
    oac().save(tmp_path / "m")
    loaded = OAC.load(tmp_path / "m", env=vec(), optimism=1.5, kl_radius=0.25)
    assert loaded.explorer.optimism == 1.5 and loaded.explorer.kl_radius == 0.25
