"""Who acts while training: the actor, or BRO's optimistic shift of it."""

from typing import Any

import numpy as np
import pytest
import torch

from sb3_sample.learner.exploration import Exploration, OptimisticShift
from tests.sac.common import bro, random_batch, sac, vec


def optimistic(**kwargs: Any) -> tuple[Any, OptimisticShift]:
    model = bro(**kwargs)
    assert isinstance(model.explorer, OptimisticShift)
    return model, model.explorer


def shift_by(exploration: OptimisticShift, value: float) -> None:
    """Make the shift of the mean a constant."""

    class Constant(torch.nn.Module):
        def forward(self, h: torch.Tensor) -> torch.Tensor:
            return torch.full((h.shape[0], 2), value)

    exploration.shift = Constant()  # type: ignore[assignment]


def samples(model: Any, observation: torch.Tensor, n: int = 4000) -> torch.Tensor:
    """Pre-tanh samples of who acts while training, (n, A)."""
    torch.manual_seed(0)
    with torch.no_grad():
        return torch.atanh(model.explorer.act(model.learner, observation.expand(n, -1)).double())


def test_plain_exploration_samples_the_actor() -> None:
    model = sac()
    assert type(model.explorer) is Exploration
    observations = torch.randn(5, 3)
    torch.manual_seed(0)
    actions = model.explorer.act(model.learner, observations)
    torch.manual_seed(0)
    assert torch.equal(actions, model.actor.sample(observations)[0])
    assert model.explorer.update(model.learner, random_batch(model)) == {}


def test_starts_near_the_pessimistic_actor() -> None:
    model, exploration = optimistic()
    observations = torch.randn(100, 3)
    with torch.no_grad():
        features = model.actor.features(observations)
        mean, _log_std = model.actor.gaussian(features)
        shift = exploration._gaussian(None, features, mean, mean)[0] - mean
    # Kernel gain 0.01 and no bias. The trunk's width is 8, its features of order 3.
    assert 0 < shift.abs().max() < 0.15


@pytest.mark.parametrize("multiplier", [0.75, 1.5])
def test_acting_has_the_multiplied_deviation(multiplier: float) -> None:
    model, _exploration = optimistic(std_multiplier=multiplier)
    with torch.no_grad():
        # A std well inside what atanh can give back.
        model.actor.log_std.weight.zero_()
        model.actor.log_std.bias.fill_(float(np.arctanh((np.log(0.3) + 10) / 6 - 1)))
        model.actor.mean.weight.mul_(0.1)
    observation = torch.tensor([[0.1, -0.2, 0.3]])
    x = samples(model, observation)
    np.testing.assert_allclose(x.std(dim=0), 0.3 * multiplier, rtol=0.06)
    with torch.no_grad():
        mean = model.actor.gaussian(model.actor.features(observation))[0]
    np.testing.assert_allclose(x.mean(dim=0), mean[0], atol=0.1)


def test_acting_is_shifted() -> None:
    model, exploration = optimistic()
    with torch.no_grad():
        model.actor.log_std.weight.zero_()
        model.actor.log_std.bias.fill_(float(np.arctanh((np.log(0.1) + 10) / 6 - 1)))
    observation = torch.zeros(1, 3)
    before = samples(model, observation).mean(dim=0)
    shift_by(exploration, 0.25)
    after = samples(model, observation).mean(dim=0)
    np.testing.assert_allclose(after - before, 0.25, atol=0.02)


@pytest.mark.parametrize("multiplier", [0.5, 0.75, 2.0])
def test_kl_is_the_squared_shift_alone(multiplier: float) -> None:
    """With the multiplier removed the deviations are equal: KL / A = mean of (shift / std)^2 / 2."""
    model, exploration = optimistic(std_multiplier=multiplier)
    batch = random_batch(model)
    # The metric is computed with the parameters before the shift's own update but after the actor's.
    exploration.actor_optimizer.param_groups[0]["lr"] = 0.0
    with torch.no_grad():
        # A wide Gaussian, so that the divergence is not all shift.
        model.actor.log_std.weight.zero_()
        model.actor.log_std.bias.fill_(float(np.arctanh((np.log(0.5) + 10) / 6 - 1)))
        exploration.shift.weight.mul_(10)
    metrics = exploration.update(model.learner, batch)
    with torch.no_grad():
        features = model.actor.features(batch.observations)
        mean, log_std = model.actor.gaussian(features)
        shift = exploration._gaussian(None, features, mean, mean)[0] - mean
    expected = (shift / log_std.exp()).square().mean() / 2
    assert metrics["exploration/kl"].item() == pytest.approx(expected.item(), rel=1e-4)


@pytest.mark.parametrize(("scale", "rises"), [(0.0, True), (1000.0, False)])
def test_adjustment_signs(scale: float, rises: bool) -> None:
    """Nearer than the target: more optimism, less weight of the divergence. Farther: the other way round."""
    model, exploration = optimistic(adjustment_learning_rate=1e-2)
    with torch.no_grad():
        exploration.shift.weight.mul_(scale)
    optimism, weight = exploration.optimism().item(), exploration.kl_weight().item()
    assert optimism == pytest.approx(1.0, rel=1e-5)
    assert weight == pytest.approx(0.25, rel=1e-5)
    metrics = exploration.update(model.learner, random_batch(model))
    kl = metrics["exploration/kl"].item()
    assert (kl < exploration.kl_target) == rises
    # The losses by hand: (beta_o - 0) * gap and -weight * gap.
    gap = kl - exploration.kl_target
    assert metrics["exploration/optimism_loss"].item() == pytest.approx(1.0 * gap, rel=1e-3, abs=1e-7)
    assert metrics["exploration/kl_weight_loss"].item() == pytest.approx(-0.25 * gap, rel=1e-3, abs=1e-7)
    assert (exploration.optimism().item() > optimism) == rises
    assert (exploration.kl_weight().item() < weight) == rises


def test_shift_climbs_the_optimistic_value() -> None:
    """
    Critics that value the first action dimension (mean) and whose disagreement grows with the second (spread):
    the optimistic actor moves up in both, the pessimistic one in the first alone.
    """

    class Critic(torch.nn.Module):
        def forward(self, obs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
            spread = 5 * (actions[:, 1:] + 1)
            return torch.stack((actions[:, :1] + spread, actions[:, :1] - spread))

    model, exploration = optimistic(learning_rate=1e-2, n_quantiles=None)
    batch = random_batch(model)
    object.__setattr__(model.policy, "critic", Critic())
    with torch.no_grad():
        model.actor.mean.weight.zero_()  # a pre-tanh mean of zero
        # A wide Gaussian, so that the divergence permits a shift that can be seen.
        model.actor.log_std.weight.zero_()
        model.actor.log_std.bias.fill_(float(np.arctanh((np.log(0.5) + 10) / 6 - 1)))
    for _ in range(40):
        metrics = exploration.update(model.learner, batch, torch.zeros(8, 2))
    with torch.no_grad():
        features = model.actor.features(batch.observations)
        mean, _ = model.actor.gaussian(features)
        shift = exploration._gaussian(None, features, mean, mean)[0] - mean
    assert shift[:, 0].mean() > 0.1 and shift[:, 1].mean() > 0.1, shift
    assert metrics["exploration/q_std"].item() > 5


def test_update_leaves_the_others_alone() -> None:
    model, exploration = optimistic()
    exploration.update(model.learner, random_batch(model))
    fresh = bro()
    for name in ("actor", "critic", "critic_target", "temperature"):
        ours, theirs = getattr(model, name).state_dict(), getattr(fresh, name).state_dict()
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs), name
    moved = exploration.state_dict()
    assert any(not torch.equal(moved[key], value) for key, value in fresh.explorer.state_dict().items())


def test_predict_is_the_pessimistic_actors_and_acting_is_not() -> None:
    model, exploration = optimistic(learning_starts=0)
    observation = np.zeros((4, 3), np.float32)
    expected, _ = model.predict(observation, deterministic=True)
    torch.manual_seed(0)
    sampled, _ = model.predict(observation, deterministic=False)
    calls = []
    act = exploration.act
    exploration.act = lambda *args: calls.append(1) or act(*args)  # type: ignore[method-assign, func-returns-value]
    shift_by(exploration, 50.0)
    actions, _ = model.predict(observation, deterministic=True)
    np.testing.assert_array_equal(actions, expected)
    torch.manual_seed(0)
    np.testing.assert_array_equal(model.predict(observation, deterministic=False)[0], sampled)
    assert not calls, "predict used the optimistic actor"
    # The shift drives every training action to its upper bound.
    env = vec()
    model = bro(env, learning_starts=5, replay_ratio=0)
    shift_by(model.explorer, 50.0)
    model.learn(15)
    taken = model.replay_buffer.actions[:15].reshape(15, 2)
    assert (taken[5:] > 0.999).all()
    assert not (taken[:5] > 0.999).all()


def test_warm_up_is_uniformly_random() -> None:
    model = bro(vec(4), learning_starts=400, replay_ratio=1)
    shift_by(model.explorer, 50.0)
    model.learn(400)
    taken = model.replay_buffer.actions[:100].reshape(-1, 2)
    assert model._n_updates == 0
    assert abs(taken.mean()) < 0.1
    assert abs(taken.std() - 1 / np.sqrt(3)) < 0.05


def test_partial_arguments_of_the_actors_networks_leave_their_depth() -> None:
    """One residual block, 256 wide, but for what is given."""
    for given, sizes in (
        ({"width": 8}, (8, 1)),
        ({"width": 8, "n_blocks": 2}, (8, 2)),
        ({"first_layer_norm": False}, (256, 1)),
        ({}, (256, 1)),
        (None, (256, 1)),
    ):
        model = bro(policy_kwargs={"actor_network_kwargs": given}, exploration_kwargs={"network_kwargs": given})
        for trunk in (model.actor.trunk, model.explorer.trunk):
            assert (trunk.out_features, len(trunk.blocks)) == sizes
            assert (trunk.norm is None) == (given == {"first_layer_norm": False})


def test_without_an_optimistic_actor() -> None:
    model = bro(exploration="actor", exploration_kwargs={})
    assert type(model.explorer) is Exploration
    model.learn(20)
    assert model._n_updates == 10


@pytest.mark.parametrize(
    ("name", "value"),
    [("kl_target", 0.0), ("kl_target", -1.0), ("std_multiplier", 0.0), ("initial_optimism", 0.0),
     ("initial_optimism", -1.0), ("initial_kl_weight", 0.0), ("adjustment_learning_rate", -1e-3)],
)  # fmt: skip
def test_bad_arguments(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name) as caught:
        bro(**{name: value})
    assert str(value) in str(caught.value)


def test_shift_network_of_another_kind() -> None:
    """The trunk's name alone must do: the default sizes belong to the default trunk."""
    model = bro(exploration_kwargs={"network": "mlp"})
    assert torch.isfinite(model._update(random_batch(model))["exploration/actor_loss"])


def test_unknown_shift_network() -> None:
    with pytest.raises(ValueError, match="network.*'foo'"):
        bro(exploration_kwargs={"network": "foo"})


def test_unknown_exploration_argument() -> None:
    with pytest.raises((ValueError, TypeError), match="foo"):
        bro(exploration_kwargs={"foo": 1})


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"policy_kwargs": {"actor_network_kwargs": 3}}, "actor_network_kwargs must be a dict, or None, not 3"),
        ({"exploration_kwargs": {"network_kwargs": 3}}, "network_kwargs must be a dict, or None, not 3"),
    ],
)
def test_arguments_of_networks_are_dicts(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        bro(**given)
