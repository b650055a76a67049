"""BRO on TD3: deterministic actors, a target actor, smoothed targets, delayed updates, no entropy."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sb3_sample import BROTD3
from sb3_sample.learner.batch import Noise
from sb3_sample.learner.exploration import Exploration, OptimisticShift
from sb3_sample.networks.spectral_norm import SpectralNorm
from sb3_sample.sac.actors import DeterministicActor
from tests.sac.common import bro, differing, random_batch, sac, state, vec


def td3(env: Any = None, **kwargs: Any) -> Any:
    model = bro(env, cls=BROTD3, **kwargs)
    assert type(model.actor) is DeterministicActor and model.policy.actor_target is not None
    return model


def constant_action(actor: Any, action: float) -> None:
    with torch.no_grad():
        actor.mean.weight.zero_()
        actor.mean.bias.fill_(math.atanh(action))


def snapshot(module: torch.nn.Module) -> list[torch.Tensor]:
    return [p.detach().clone() for p in module.parameters()]


def moved(before: list[torch.Tensor], module: torch.nn.Module) -> bool:
    """All of them, or none."""
    flags = {not torch.equal(a, b) for a, b in zip(before, module.parameters(), strict=True)}
    assert len(flags) == 1, "some parameters moved, others did not"
    return flags.pop()


# ---------------------------------------------------------------- acting


def test_predictions() -> None:
    model = td3()
    observations = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    with torch.no_grad():
        actor = model.actor
        expected = torch.tanh(actor.mean(actor.trunk(torch.as_tensor(observations))))
    np.testing.assert_allclose(model.predict(observations, deterministic=True)[0], expected, rtol=1e-5, atol=1e-6)
    # The noise is the explorer's, not the policy's, as in stable_baselines3's TD3.
    np.testing.assert_allclose(model.predict(observations, deterministic=False)[0], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("exploration", "exploration_noise", "std_multiplier"),
    [
        ("actor", 0.1, 1.0),
        ("actor", 0.05, 1.0),
        ("optimistic_shift", 0.1, 1.0),
        ("optimistic_shift", 0.05, 2.0),
        ("optimistic_shift", 0.2, 0.5),
    ],
)
def test_exploration_noise(exploration: str, exploration_noise: float, std_multiplier: float) -> None:
    """Gaussian around the action, not before the tanh, and clipped to the bounds."""
    model = td3(exploration=exploration, exploration_noise=exploration_noise, std_multiplier=std_multiplier,
                exploration_kwargs={})  # fmt: skip
    shifted = exploration == "optimistic_shift"
    assert type(model.explorer) is (OptimisticShift if shifted else Exploration)
    if shifted:
        with torch.no_grad():
            model.explorer.shift.weight.zero_()
    expected = exploration_noise * (std_multiplier if shifted else 1)
    observations = torch.zeros(10_000, 3)
    for action in (0.3, 0.99):
        constant_action(model.actor, action)
        torch.manual_seed(0)
        with torch.no_grad():
            actions = model.explorer.act(model.learner, observations)
        if action == 0.3:
            np.testing.assert_allclose(actions.mean(dim=0), 0.3, atol=0.01)
            np.testing.assert_allclose(actions.std(dim=0), expected, rtol=0.05)
        else:
            assert actions.max() == 1 and 0.3 < (actions == 1).float().mean() < 0.6


def test_exploration_adds_the_shift(monkeypatch: pytest.MonkeyPatch) -> None:
    model = td3()
    constant_action(model.actor, 0.3)

    class Constant(torch.nn.Module):
        def forward(self, h: torch.Tensor) -> torch.Tensor:
            return torch.full((h.shape[0], 2), 0.5)

    model.explorer.shift = Constant()
    monkeypatch.setattr(torch, "randn_like", torch.ones_like)
    actions = model.explorer.act(model.learner, torch.randn(4, 3))
    np.testing.assert_allclose(actions.detach(), math.tanh(math.atanh(0.3) + 0.5) + 0.1, rtol=1e-5)


# ---------------------------------------------------------------- the update


def test_target_action_by_hand() -> None:
    """clip(0.3 + clip(0.2 * noise, -0.5, 0.5), -1, 1), and the same around 0.8."""
    model = td3()
    noise = torch.tensor([[0.0, 1.0], [2.0, -2.0], [3.0, -3.0], [10.0, -10.0]])
    for action, expected in (
        (0.3, [[0.3, 0.5], [0.7, -0.1], [0.8, -0.2], [0.8, -0.2]]),
        (0.8, [[0.8, 1.0], [1.0, 0.4], [1.0, 0.3], [1.0, 0.3]]),
    ):
        constant_action(model.policy.actor_target, action)
        actions, log_prob = model.policy.next_actions(torch.randn(4, 3), noise)
        torch.testing.assert_close(actions, torch.tensor(expected), atol=1e-6, rtol=1e-6)
        assert torch.equal(log_prob, torch.zeros(4, 1))


def test_smoothing_by_other_arguments() -> None:
    model = td3(target_noise=0.1, target_noise_clip=0.15)
    constant_action(model.policy.actor_target, 0.3)
    actions, _ = model.policy.next_actions(torch.randn(2, 3), torch.tensor([[1.0, 2.0], [-1.0, -2.0]]))
    torch.testing.assert_close(actions, torch.tensor([[0.4, 0.45], [0.2, 0.15]]), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("pessimism", [0.0, 1.0])
def test_critics_loss_by_hand(pessimism: float) -> None:
    """The target actor's smoothed action, the target critics, and no entropy."""
    model = td3(n_quantiles=None, gamma=0.9, pessimism=pessimism)
    constant_action(model.policy.actor_target, -0.4)
    batch, noise = random_batch(model), torch.randn(8, 2) * 3
    action = (-0.4 + (0.2 * noise).clamp(-0.5, 0.5)).clamp(-1, 1)
    with torch.no_grad():
        q = model.critic_target(batch.next_observations, action)
        value = q.mean(dim=0) if pessimism == 0 else q.min(dim=0).values
        target = batch.rewards + 0.9 * (1 - batch.dones) * value
        loss = (model.critic(batch.observations, batch.actions) - target).square().mean(dim=(1, 2)).sum()
    metrics = model._update(batch, Noise(critic=noise))
    assert metrics["train/critic_loss"].item() == pytest.approx(loss.item(), rel=1e-5)
    assert not any("ent" in name for name in metrics)


def test_actors_losses_by_hand() -> None:
    """Both learn through their actions without noise: -mean Q, and the optimistic bound less the divergence."""
    model = td3(learning_rate=0.0, policy_delay=1, n_quantiles=None)
    batch = random_batch(model)
    metrics = model._update(batch, Noise(actor=torch.full((8, 2), 9.0), exploration=torch.full((8, 2), 9.0)))
    with torch.no_grad():
        mean = model.actor.mean(model.actor.trunk(batch.observations))
        q = model.critic(batch.observations, torch.tanh(mean))
        assert metrics["train/actor_loss"].item() == pytest.approx(-q.mean().item(), rel=1e-4)
        explorer = model.explorer
        shifted = mean + explorer.shift(explorer.trunk(torch.cat((batch.observations, mean), dim=1)))
        q = model.critic(batch.observations, torch.tanh(shifted))
        upper = q.mean(dim=0) + 1.0 * (q[0] - q[1]).abs() / 2
        kl = ((torch.tanh(shifted) - torch.tanh(mean)) / 0.1).square().sum(dim=1).mean() / 2
    assert metrics["exploration/kl"].item() == pytest.approx(kl.item() / 2, rel=1e-3, abs=1e-6)
    assert metrics["exploration/actor_loss"].item() == pytest.approx((0.25 * kl - upper.mean()).item(), rel=1e-4)


@pytest.mark.parametrize("multiplier", [1.0, 3.0])
def test_divergence_by_hand(multiplier: float) -> None:
    """Actions 0.3 and 0.1 with noise 0.1: ((0.3 - 0.1) / 0.1)^2 / 2 = 2 a dimension; the multiplier is taken out."""
    model = td3(std_multiplier=multiplier)
    std = torch.full((5, 2), 0.1)
    means = (torch.full((5, 2), math.atanh(action)) for action in (0.3, 0.1))
    first, second = means
    torch.testing.assert_close(model.actor.kl(first, std, second, std), torch.full((5, 1), 4.0))
    constant_action(model.actor, 0.1)

    class Constant(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.value = torch.nn.Parameter(torch.tensor(math.atanh(0.3) - math.atanh(0.1)))

        def forward(self, h: torch.Tensor) -> torch.Tensor:
            return self.value.expand(h.shape[0], 2)

    model.explorer.shift = Constant()
    model.explorer.actor_optimizer = torch.optim.SGD(model.explorer.shift.parameters(), lr=0.0)
    assert model.explorer.update(model.learner, random_batch(model))["exploration/kl"].item() == pytest.approx(
        2, rel=1e-3
    )


@pytest.mark.parametrize(
    ("kwargs", "delay", "interval"),
    [({}, 2, 2), ({"policy_delay": 3}, 3, 3), ({"target_update_interval": 1}, 2, 1), ({"policy_delay": 1}, 1, 1)],
)
def test_who_moves_when(kwargs: dict[str, Any], delay: int, interval: int) -> None:
    model = td3(learning_rate=1e-2, tau=0.1, **kwargs)
    delayed = [model.actor, model.policy.actor_target, model.explorer]
    for step in range(1, 7):
        before = [snapshot(module) for module in delayed]
        critic, target = snapshot(model.critic), snapshot(model.critic_target)
        metrics = model._update(random_batch(model, seed=step))
        assert moved(critic, model.critic)
        assert moved(target, model.critic_target) == (step % interval == 0)
        for old, module in zip(before, delayed, strict=True):
            assert moved(old, module) == (step % delay == 0), type(module).__name__
        assert ("train/actor_loss" in metrics) == ("exploration/kl" in metrics) == (step % delay == 0)


def test_polyak_average_of_the_target_actor() -> None:
    model = td3(learning_rate=1e-2, tau=0.1)
    assert all(
        torch.equal(a, b) for a, b in zip(snapshot(model.actor), snapshot(model.policy.actor_target), strict=True)
    )
    old = snapshot(model.policy.actor_target)
    for step in range(2):
        model._update(random_batch(model, seed=step))
    for before, target, actor in zip(
        old, model.policy.actor_target.parameters(), model.actor.parameters(), strict=True
    ):
        torch.testing.assert_close(target, 0.9 * before + 0.1 * actor)
        assert not target.requires_grad


def test_policy_delay_with_sac() -> None:
    """The temperature waits as well."""
    model = sac(policy_delay=2, learning_rate=1e-2)
    for step in range(1, 5):
        actor, temperature, critic = (snapshot(m) for m in (model.actor, model.temperature, model.critic))
        metrics = model._update(random_batch(model, seed=step))
        assert moved(critic, model.critic)
        assert moved(actor, model.actor) == moved(temperature, model.temperature) == (step % 2 == 0)
        assert ("train/ent_coef_loss" in metrics) == (step % 2 == 0)


# ---------------------------------------------------------------- arguments


@pytest.mark.parametrize(("name", "value"), [("ent_coef", 0.2), ("ent_coef", "auto_0.1"), ("target_entropy", -1.0)])
def test_entropy_is_refused(name: str, value: Any) -> None:
    for make in (lambda **kwargs: td3(**kwargs), lambda **kwargs: sac(backbone="td3", **kwargs)):
        with pytest.raises(ValueError, match=f"{name}.*deterministic") as caught:
            make(**{name: value})
        assert str(value) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [("exploration_noise", 0.0), ("exploration_noise", -0.1), ("target_noise", -0.2), ("target_noise_clip", -0.5),
     ("target_noise", math.nan), ("policy_delay", 0), ("backbone", "sac"), ("backbone", "foo")],
)  # fmt: skip
def test_bad_arguments(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name) as caught:
        td3(**{name: value})
    assert str(value) in str(caught.value)


def test_actor_kwargs_of_the_other_backbone() -> None:
    with pytest.raises(ValueError, match="target_noise.*backbone='sac'"):
        sac(policy_kwargs={"net_arch": [8], "actor_kwargs": {"target_noise": 0.1}})


# ---------------------------------------------------------------- saving, loading, resets


def test_target_actor_is_saved_and_reset(tmp_path: Path) -> None:
    model = td3(learning_rate=1e-2).learn(17)
    assert any(name.startswith("policy/actor_target.") for name in state(model))
    pairs = zip(model.actor.parameters(), model.policy.actor_target.parameters(), strict=True)
    assert not any(torch.equal(a, b) for a, b in pairs)
    model.save(tmp_path / "m")
    loaded = BROTD3.load(tmp_path / "m", env=vec())
    assert not differing(state(model), state(loaded))
    model.policy.save(tmp_path / "p")
    policy = type(model.policy).load(tmp_path / "p")
    for (name, ours), theirs in zip(model.policy.state_dict().items(), policy.state_dict().values(), strict=True):
        assert torch.equal(ours, theirs), name
    assert policy.actor_target.target_noise == 0.2 and type(policy.actor) is DeterministicActor
    model.reinitialize()
    for actor, target in zip(model.actor.parameters(), model.policy.actor_target.parameters(), strict=True):
        assert torch.equal(actor, target) and not target.requires_grad


def test_arguments_at_loading(tmp_path: Path) -> None:
    td3().save(tmp_path / "m")
    new = {"exploration_noise": 0.3, "target_noise": 0.4, "target_noise_clip": 0.7}
    loaded = BROTD3.load(tmp_path / "m", env=vec(), **new, weight_decay=0.5, adjustment_learning_rate=0.01)
    assert math.exp(loaded.actor.log_exploration_noise) == pytest.approx(0.3)
    assert (loaded.policy.actor_target.target_noise, loaded.policy.actor_target.target_noise_clip) == (0.4, 0.7)
    assert {group["weight_decay"] for group in loaded.critic.optimizer.param_groups} == {0.5}
    assert {group["lr"] for group in loaded.explorer.scalar_optimizer.param_groups} == {0.01}
    constant_action(loaded.policy.actor_target, 0.1)
    actions, _ = loaded.policy.next_actions(torch.zeros(1, 3), torch.tensor([[1.0, 100.0]]))
    torch.testing.assert_close(actions, torch.tensor([[0.5, 0.8]]), atol=1e-6, rtol=1e-6)


def test_policy_delay_at_loading(tmp_path: Path) -> None:
    """The actors and, as at construction where nothing else is asked for, the targets."""
    td3().save(tmp_path / "m")
    loaded = BROTD3.load(tmp_path / "m", env=vec(), policy_delay=3)
    moves, targets = [], []
    for step in range(1, 7):
        actor, target = snapshot(loaded.actor), snapshot(loaded.critic_target)
        loaded._update(random_batch(loaded, seed=step))
        moves += [step] * moved(actor, loaded.actor)
        targets += [step] * moved(target, loaded.critic_target)
    assert moves == [3, 6]
    assert targets == [3, 6]


@pytest.mark.parametrize(
    ("name", "value"), [("exploration_noise", -1.0), ("ent_coef", 0.2), ("backbone", "sac"), ("policy_delay", 0)]
)
def test_bad_arguments_at_loading(name: str, value: Any, tmp_path: Path) -> None:
    td3().save(tmp_path / "m")
    with pytest.raises(ValueError, match=name):
        BROTD3.load(tmp_path / "m", env=vec(), **{name: value})


def test_a_target_actor_follows_with_directions_of_its_own() -> None:
    """It is never in training mode, and its kernels are the average of others'."""
    kwargs = {"actor_network_kwargs": {"hidden_sizes": [8, 8], "spectral_norm": True}}
    model = bro(cls=BROTD3, learning_starts=8, policy_kwargs={"actor_network": "mlp", **kwargs}, tau=0.5)
    target = model.policy.actor_target
    (layer,) = (each for each in target.modules() if isinstance(each, SpectralNorm))
    with torch.no_grad():
        for each in model.policy.actor.modules():
            if isinstance(each, SpectralNorm):
                # Another kernel altogether, of one strong direction.
                each.weight.copy_(torch.outer(torch.arange(8.0), torch.linspace(-1, 2, 8)))
                each.find_direction()
    model.learn(40)
    assert not layer.training
    norm = torch.linalg.matrix_norm(layer.normalized_weight(), 2)
    torch.testing.assert_close(norm, torch.ones(()), rtol=0.02, atol=0)
