"""The gradient step as a whole: no wait for the device, nothing drawn when the noise is given, who moves."""

from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_sample.learner.batch import Noise
from sb3_sample.sac import SAC
from tests.sac.common import MAKERS, bro, differing, random_batch, sac, state

#: Operations whose result the host must have: on a GPU each is a wait for the device.
SYNCHRONISING = {
    "aten::_local_scalar_dense",
    "aten::item",
    "aten::nonzero",
    "aten::masked_select",
    "aten::is_nonzero",
    "aten::equal",
    "aten::unique_dim",
    "aten::_unique2",
    "aten::repeat_interleave",
}


class NoSynchronisation(TorchDispatchMode):
    """Refuses every operation that makes the host wait."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func._schema.name
        if name in SYNCHRONISING:
            raise AssertionError(f"{name} makes the host wait for the device")
        if name in ("aten::index", "aten::index_put_", "aten::index_put"):
            masks = [i for i in args[1] if i is not None and i.dtype in (torch.bool, torch.uint8)]
            assert not masks, f"{name} with a mask makes the host wait for the device"
        return func(*args, **(kwargs or {}))


class Fixed(BaseFeaturesExtractor):
    """A layer that does not learn, as if learned before."""

    def __init__(self, observation_space: Any):
        super().__init__(observation_space, 6)
        self.layer = nn.Linear(observation_space.shape[0], 6).requires_grad_(False)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return self.layer(observations)  # type: ignore[no-any-return]


def test_the_guard_works() -> None:
    x = torch.ones(3)
    for offence in (
        lambda: x[0].item(),
        lambda: bool(x[0] > 0),
        lambda: x.nonzero(),
        lambda: x[x > 0],
        lambda: x.numpy()[0] if float(x.sum()) else None,
    ):
        with pytest.raises(AssertionError, match="makes the host wait"), NoSynchronisation():
            offence()


@pytest.mark.parametrize(
    ("maker", "kwargs"),
    [
        ("SAC", {}),
        ("SAC", {"pessimism": 0.5, "ent_coef": 0.1}),
        ("SAC", {"policy_kwargs": {"net_arch": [8], "n_critics": 3}}),
        ("BRO", {}),
        ("BRO", {"n_quantiles": None, "target_update_interval": 2}),
    ],
)
def test_update_makes_the_host_wait_for_nothing(maker: str, kwargs: dict[str, Any]) -> None:
    model = MAKERS[maker](**kwargs)
    batch = random_batch(model)
    for _ in range(3):
        with NoSynchronisation():
            model._update(batch)


@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_train_makes_the_host_wait_for_nothing(maker: str) -> None:
    """The whole call, sampling included."""
    model = MAKERS[maker]().learn(30)
    with NoSynchronisation():
        model.train(5, 8)


@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_given_noise_reproduces_a_step(maker: str) -> None:
    models = [MAKERS[maker]() for _ in range(2)]
    g = torch.Generator().manual_seed(0)
    noise = Noise(*(torch.randn(8, 2, generator=g) for _ in range(3)))
    for i, model in enumerate(models):
        torch.manual_seed(i)
        before = torch.get_rng_state()
        model._update(random_batch(model), noise)
        assert torch.equal(before, torch.get_rng_state())
    assert not differing(state(models[0]), state(models[1]))


def test_every_network_moves_once() -> None:
    model = bro(learning_rate=1e-2)
    before = state(model)
    metrics = model._update(random_batch(model))
    assert model._n_updates == 1
    after = state(model)
    for name in before:
        if name.startswith(("policy", "explorer/", "temperature/")):
            assert not torch.equal(before[name], after[name]), name
    assert all(value.shape == () and torch.isfinite(value) and not value.requires_grad for value in metrics.values())


@pytest.mark.parametrize("sam_radius", [None, 0.3])
def test_frozen_parameters_stay_and_others_learn(sam_radius: float | None) -> None:
    noise = Noise(*torch.randn(3, 8, 2))
    model, other = sac(sam_radius=sam_radius), sac(sam_radius=sam_radius)
    for m in (model, other):
        if m is model:
            m.critic.trunk.requires_grad_(False)
        before = {name: p.detach().clone() for name, p in m.policy.named_parameters()}
        m.learner.step(random_batch(m), noise)
    trunk = {f"critic.trunk.{name}" for name, _ in model.critic.trunk.named_parameters()}
    moved = {name for name, p in model.policy.named_parameters() if not torch.equal(p, before[name])}
    assert moved == before.keys() - trunk - {name for name in before if name.startswith("critic_target.trunk")}
    if sam_radius is None:
        assert torch.equal(model.critic.head.weight, other.critic.head.weight)
    model.critic.trunk.requires_grad_(True)
    model.learner.step(random_batch(model), noise)
    assert all(not torch.equal(p, before[name]) for name, p in model.policy.named_parameters())


def test_a_frozen_actor_and_a_frozen_encoder() -> None:
    model = sac(policy_kwargs={"net_arch": [8], "share_features_extractor": True, "features_extractor_class": Fixed})
    model.actor.requires_grad_(False)
    before = {name: p.detach().clone() for name, p in model.policy.named_parameters()}
    model.learn(20)
    moved = {name for name, p in model.policy.named_parameters() if not torch.equal(p, before[name])}
    assert moved == {
        name for name in before if name.startswith(("critic.", "critic_target.")) and "extractor" not in name
    }


def test_polyak() -> None:
    model = sac(tau=0.1, learning_rate=1e-2)
    before = [p.clone() for p in model.critic_target.parameters()]
    model._update(random_batch(model))
    for old, target, critic in zip(before, model.critic_target.parameters(), model.critic.parameters(), strict=True):
        torch.testing.assert_close(target, 0.9 * old + 0.1 * critic)


def test_the_targets_value_by_hand() -> None:
    """The critics' loss of a first step, assembled from the networks as the paper writes it."""
    model = sac(gamma=0.9, ent_coef=0.3)
    batch = random_batch(model)
    noise = torch.randn(8, 2)
    with torch.no_grad():
        action, log_prob = model.actor.sample(batch.next_observations, noise)
        smaller = model.critic_target(batch.next_observations, action).min(dim=0).values
        target = batch.rewards + 0.9 * (1 - batch.dones) * (smaller - 0.3 * log_prob)
        loss = (model.critic(batch.observations, batch.actions) - target).square().mean(dim=(1, 2)).sum()
    metrics = model._update(batch, Noise(critic=noise))
    assert metrics["train/critic_loss"].item() == pytest.approx(loss.item(), rel=1e-5)


def test_constant_reward_is_learned() -> None:
    """Reward 1 for ever, no entropy: every Q goes to 1 / (1 - gamma), in both kinds of critics."""
    for model in (
        sac(gamma=0.5, ent_coef=0.0, tau=0.5, learning_rate=1e-2),
        bro(gamma=0.5, ent_coef=0.0, tau=0.5, learning_rate=1e-2),
    ):
        assert isinstance(model, SAC)
        for step in range(200):
            batch = random_batch(model, 32, seed=step % 50)
            model._update(batch._replace(rewards=torch.ones(32, 1), dones=torch.zeros(32, 1)))
        with torch.no_grad():
            q = model.critic(batch.observations, batch.actions)
        np.testing.assert_allclose(q.mean(dim=(1, 2)), 2.0, atol=0.2)
