"""DAC: an actor of its own that explores by climbing an optimistic value, held near the pessimistic one."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sb3_sample import DAC, VPLSAC
from sb3_sample.learner.batch import Noise
from sb3_sample.learner.exploration import Exploration, OptimisticActor, spread
from tests.sac.common import differing, random_batch, sac, state, vec


def dac(env: Any = None, **kwargs: Any) -> Any:
    model = sac(env, cls=DAC, **kwargs)
    assert isinstance(model.explorer, OptimisticActor)
    return model


def constant_gaussian(actor: Any, mean: float, std: float) -> None:
    """Make an actor's pre-tanh Gaussian the same everywhere."""
    with torch.no_grad():
        for layer, value in ((actor.mean, mean), (actor.log_std, math.atanh((math.log(std) + 10) / 6 - 1))):
            layer.weight.zero_()
            layer.bias.fill_(value)


def without_updates(model: Any) -> Any:
    """Let the gradient steps do nothing."""

    def update(*args: Any) -> dict[str, Any]:
        model._n_updates += 1
        return {}

    model._update = update
    return model


def copies(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in module.named_parameters()}


# ---------------------------------------------------------------- optimism and the divergence's weight


@pytest.mark.parametrize(
    ("pessimism", "initial", "expected"),
    # By default 0.5 above minus the pessimism; else what is asked for.
    [(1.0, None, -0.5), (0.25, None, 0.25), (0.0, None, 0.5), (1.0, 2.0, 2.0), (1.0, -0.75, -0.75), (0.0, 1.5, 1.5)],
)
def test_optimism_at_the_start(pessimism: float, initial: float | None, expected: float) -> None:
    model = dac(pessimism=pessimism, initial_optimism=initial)
    assert model.explorer._optimism(model.learner).item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("pessimism", "initial"), [(1.0, -1.0), (1.0, -2.0), (0.0, 0.0), (0.5, -0.5)])
def test_optimism_must_lie_above_minus_the_pessimism(pessimism: float, initial: float) -> None:
    with pytest.raises(ValueError, match="initial_optimism") as caught:
        dac(pessimism=pessimism, initial_optimism=initial)
    assert str(initial) in str(caught.value)


@pytest.mark.parametrize(
    ("distance", "loss", "gradient"),
    [
        # 0.5 above the bound of -1: 0.5 * 0.2 - (-1 + 0.001); the barrier's term is constant.
        (0.5, 1.099, 0.2),
        # 0.0005 above it: 0.0005 * 0.2 - (-0.9995); the barrier pushes up by 1.
        (0.0005, 0.9996, -0.8),
    ],
)
def test_barrier_by_hand(distance: float, loss: float, gradient: float) -> None:
    model = dac()
    optimism = torch.tensor(distance - 1.0, requires_grad=True)
    value = model.explorer._optimism_loss(model.learner, optimism, torch.tensor(0.2))
    assert value.item() == pytest.approx(loss, rel=1e-5, abs=1e-6)
    value.backward()
    assert optimism.grad is not None and optimism.grad.item() == pytest.approx(gradient, rel=1e-5, abs=1e-6)


def test_weight_of_the_divergence_is_clipped_in_the_actors_loss_alone() -> None:
    model = dac(initial_kl_weight=50.0, kl_target=1e-3, adjustment_learning_rate=1e-2, initial_optimism=0.75)
    metrics = model.explorer.update(model.learner, random_batch(model), torch.zeros(8, 2))
    kl = 2 * metrics["exploration/kl"]  # logged per dimension, penalised as a sum
    upper = metrics["exploration/q_mean"] + 0.75 * metrics["exploration/q_std"]
    assert metrics["exploration/actor_loss"].item() == pytest.approx((20 * kl - upper).item(), rel=1e-4)
    assert kl.item() > 0.1, "the weight would not show"
    assert metrics["exploration/kl_weight"].item() == pytest.approx(50, rel=1e-5)
    gap = metrics["exploration/kl"].item() - 1e-3
    assert metrics["exploration/kl_weight_loss"].item() == pytest.approx(-50 * gap, rel=1e-4)
    # Farther than the target: the weight grows, also above 20.
    assert model.explorer.kl_weight().item() > 50.1


@pytest.mark.parametrize(
    ("direction", "expected"),
    # From N(1, 2^2) to N(0, 1): log(1/2) + (4 + 1) / 2 - 1/2; back: log(2) + (1 + 1) / 8 - 1/2; per dimension.
    [("optimistic_to_pessimistic", 1.306853), ("pessimistic_to_optimistic", 0.443147)],
)
@pytest.mark.parametrize("multiplier", [0.5, 1.25])
def test_direction_of_the_divergence(direction: str, expected: float, multiplier: float) -> None:
    """The multiplier of the sampled deviation plays no part in it."""
    model = dac(kl_direction=direction, std_multiplier=multiplier)
    constant_gaussian(model.explorer.actor, 1.0, 2.0)
    constant_gaussian(model.actor, 0.0, 1.0)
    metrics = model.explorer.update(model.learner, random_batch(model))
    assert metrics["exploration/kl"].item() == pytest.approx(expected, abs=1e-4)


def test_default_direction() -> None:
    assert dac().explorer.kl_direction == "optimistic_to_pessimistic"
    with pytest.raises(ValueError, match="kl_direction.*'foo'"):
        dac(kl_direction="foo")


# ---------------------------------------------------------------- acting


def test_acting_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sample of the optimistic Gaussian, its deviation 0.4 times 1.25: tanh(0.2 + 0.5 * noise)."""
    model = dac(std_multiplier=1.25)
    constant_gaussian(model.explorer.actor, 0.2, 0.4)
    for noise in (0.0, 1.0, -2.0):
        monkeypatch.setattr(torch, "randn_like", lambda x, noise=noise: torch.full_like(x, noise))
        action = model.explorer.act(model.learner, torch.randn(5, 3))
        np.testing.assert_allclose(action.detach(), math.tanh(0.2 + 0.5 * noise), rtol=1e-5)


def test_statistics_of_acting() -> None:
    model = dac(std_multiplier=1.25)
    constant_gaussian(model.explorer.actor, 0.2, 0.4)
    torch.manual_seed(0)
    with torch.no_grad():
        x = torch.atanh(model.explorer.act(model.learner, torch.zeros(10_000, 3)).double())
    np.testing.assert_allclose(x.mean(dim=0), 0.2, atol=0.02)
    np.testing.assert_allclose(x.std(dim=0), 0.5, rtol=0.03)


def test_learning_samples_as_acting_does() -> None:
    model = dac(std_multiplier=1.25)
    constant_gaussian(model.explorer.actor, 0.2, 0.4)
    seen: list[torch.Tensor] = []
    model.critic.register_forward_pre_hook(lambda module, args: seen.append(args[1].detach()))
    noise = torch.randn(8, 2)
    model.explorer.update(model.learner, random_batch(model), noise)
    torch.testing.assert_close(seen[0], torch.tanh(0.2 + 0.5 * noise))


def test_evaluation_is_the_pessimistic_actors() -> None:
    model = dac(vec(), learning_starts=5, replay_ratio=0)
    constant_gaussian(model.explorer.actor, 30.0, 0.1)
    observations = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    with torch.no_grad():
        expected = torch.tanh(model.actor.gaussian(model.actor.features(torch.as_tensor(observations)))[0])
    np.testing.assert_allclose(model.predict(observations, deterministic=True)[0], expected, rtol=1e-5, atol=1e-6)
    assert (np.abs(model.predict(observations, deterministic=False)[0]) < 0.999).any()
    model.learn(15)
    taken = model.replay_buffer.actions[:15].reshape(15, 2)
    assert (taken[5:] > 0.999).all() and not (taken[:5] > 0.999).all()


def test_dropout_is_off_while_acting(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is for the pessimistic actor: Stable-Baselines3 collects transitions in evaluation mode."""
    actor = {"hidden_sizes": [16], "dropout": 0.5}
    model = dac(policy_kwargs={"actor_network_kwargs": actor, "critic_network_kwargs": {"hidden_sizes": [8]}})
    model.policy.set_training_mode(False)
    monkeypatch.setattr(torch, "randn_like", torch.zeros_like)
    observations = torch.randn(4, 3)
    assert torch.equal(model.explorer.act(model.learner, observations), model.explorer.act(model.learner, observations))


# ---------------------------------------------------------------- what optimism adds


@pytest.mark.parametrize(
    ("uncertainty", "expected"),
    [
        # Half the distance of the two critics, quantile by quantile.
        ("epistemic", [[1.0, 0.0, 3.0]]),
        # The mean critic is (1, 2, 7), its variance 62/9.
        ("aleatoric", [[math.sqrt(62 / 9)]]),
        # The epistemic variances are (1, 0, 9), on average 30/9.
        ("both", [[math.sqrt(92 / 9)]]),
    ],
)
def test_uncertainty_by_hand(uncertainty: str, expected: list[list[float]]) -> None:
    q = torch.tensor([[[0.0, 2.0, 4.0]], [[2.0, 2.0, 10.0]]])
    torch.testing.assert_close(spread(q, uncertainty), torch.tensor(expected))


@pytest.mark.parametrize("uncertainty", ["aleatoric", "both"])
@pytest.mark.parametrize("n_quantiles", [None, 1])
def test_aleatoric_uncertainty_needs_quantiles(uncertainty: str, n_quantiles: int | None) -> None:
    with pytest.raises(ValueError, match=f"uncertainty='{uncertainty}'.*n_quantiles={n_quantiles}"):
        dac(uncertainty=uncertainty, n_quantiles=n_quantiles)


def test_unknown_uncertainty() -> None:
    with pytest.raises(ValueError, match="uncertainty must be one of.*'foo'"):
        dac(uncertainty="foo", n_quantiles=5)


@pytest.mark.parametrize("uncertainty", ["epistemic", "aleatoric", "both"])
def test_quantiles_and_layer_norm(uncertainty: str) -> None:
    """Everything moves; the loss is that of the chosen spread."""
    model = dac(
        n_quantiles=5,
        uncertainty=uncertainty,
        initial_optimism=2.0,
        learning_rate=1e-2,
        policy_kwargs={"net_arch": [8], "critic_network_kwargs": {"layer_norm": True}},
    )
    assert any("layers.1.weight" in name for name in model.critic.trunk.state_dict())
    batch, noise = random_batch(model), torch.randn(8, 2)
    before = state(model)
    metrics = model._update(batch, Noise(exploration=noise))
    assert all(torch.isfinite(value) for value in metrics.values())
    after = state(model)
    for name in before:
        if name.startswith(("policy", "explorer/actor", "explorer/optimism", "explorer/kl_weight", "temperature/")):
            assert not torch.equal(before[name], after[name]), name
    seen: list[torch.Tensor] = []
    hook = model.critic.register_forward_hook(lambda module, args, q: seen.append(q.detach()))
    metrics = model.explorer.update(model.learner, batch, noise)
    hook.remove()
    assert metrics["exploration/q_std"].item() == pytest.approx(spread(seen[0], uncertainty).mean().item(), rel=1e-5)


def test_with_validation_pessimism() -> None:
    """Pessimism and optimism move at once; optimism stays above minus the pessimism."""
    model = dac(
        pessimism="vpl",
        pessimism_kwargs={"learning_rate": 0.05},
        validation_proportion=0.25,
        adjustment_learning_rate=0.3,
        kl_target=1e-3,
    )
    betas, optimisms = [], []
    update = model._update

    def recorded(*args: Any) -> Any:
        metrics = update(*args)
        betas.append(metrics["pessimism/beta"].item())
        optimisms.append(metrics["exploration/optimism"].item())
        return metrics

    model._update = recorded
    model.learn(50)
    assert len(betas) == 40 and len(set(betas)) > 10 and len(set(optimisms)) > 10
    assert all(optimism > -beta for optimism, beta in zip(optimisms, betas, strict=True))
    assert min(optimisms[i] + betas[i] for i in range(40)) < 0.1, "optimism hardly moved towards its bound"
    beta = model.pessimism_rule.beta()
    expected = model.explorer.optimism_distance().item() - beta.item()
    assert model.explorer._optimism(model.learner).item() == pytest.approx(expected)


# ---------------------------------------------------------------- starting anew


@pytest.mark.parametrize(
    ("n_envs", "expected"), [(1, [20, 40, 60]), (3, [21, 42, 60]), (8, [24, 40, 64]), (24, [24, 48, 72])]
)
def test_starts_anew_once_an_interval(n_envs: int, expected: list[int]) -> None:
    model = without_updates(dac(vec(n_envs), reinitialize_every=20))
    at: list[int] = []
    make_explorer = model.learner.make_explorer
    model.learner.make_explorer = lambda: at.append(model.num_transitions) or make_explorer()
    model.learn(70)
    assert at == expected


def test_never() -> None:
    model = without_updates(dac(reinitialize_every=None))
    before = copies(model.explorer)
    model.learn(30)
    assert all(torch.equal(before[name], value) for name, value in copies(model.explorer).items())


@pytest.mark.parametrize("value", [0, -5, 0.5])
def test_bad_interval(value: float) -> None:
    with pytest.raises(ValueError, match="reinitialize_every") as caught:
        dac(reinitialize_every=value)
    assert str(value) in str(caught.value)


def test_what_starts_anew() -> None:
    model = dac(reinitialize_every=25, adjustment_learning_rate=1e-2, learning_rate=1e-2)
    model.learn(24)
    explorer = model.explorer
    trained, others = copies(explorer), state(model)
    assert explorer._optimism(model.learner).item() != pytest.approx(-0.5, abs=1e-4)
    assert explorer.kl_weight().item() != pytest.approx(1.0, abs=1e-4)
    assert all(optimizer.state for optimizer in explorer.optimizers().values())
    model.num_transitions = 25
    explorer.before_updates(model.learner)
    started = copies(explorer)
    for name, value in started.items():
        assert not torch.equal(value, trained[name]), f"{name} was kept"
    assert explorer._optimism(model.learner).item() == pytest.approx(-0.5, rel=1e-5)
    assert explorer.kl_weight().item() == pytest.approx(1.0, rel=1e-5)
    assert not any(optimizer.state for optimizer in explorer.optimizers().values())
    # The kernel is orthogonal again, gain sqrt(2).
    kernel = explorer.actor.trunk.layers[2].weight
    torch.testing.assert_close(kernel @ kernel.T, 2 * torch.eye(8), atol=1e-5, rtol=1e-5)
    # Nothing else does.
    assert all(name.startswith("explorer") for name in differing(others, state(model)))
    explorer.before_updates(model.learner)
    assert all(torch.equal(started[name], value) for name, value in copies(explorer).items()), "twice"


def loaded_at_45(path: Path, **kwargs: Any) -> tuple[Any, list[int]]:
    """Saved with an interval of 20 after 45 transitions; and where the loaded one starts anew."""
    model = without_updates(dac(reinitialize_every=20)).learn(45)
    del model._update
    model.save(path / "m")
    model.save_replay_buffer(path / "b")
    loaded = without_updates(DAC.load(path / "m", env=vec(), **kwargs))
    loaded.load_replay_buffer(path / "b")
    at: list[int] = []
    make_explorer = loaded.learner.make_explorer
    loaded.learner.make_explorer = lambda: at.append(loaded.num_transitions) or make_explorer()
    return loaded, at


def test_not_again_after_loading(tmp_path: Path) -> None:
    loaded, at = loaded_at_45(tmp_path)
    loaded.learn(40)
    assert at == [60, 80]


@pytest.mark.parametrize(("every", "expected"), [(50, [50, 100]), (15, [60, 75, 90, 105]), (None, [])])
def test_another_interval_at_loading(every: int | None, expected: list[int], tmp_path: Path) -> None:
    loaded, at = loaded_at_45(tmp_path, reinitialize_every=every)
    loaded.learn(65)
    assert at == expected


def test_start_below_zero_with_a_pessimism_that_moves() -> None:
    """An optimism of -0.5 is allowed at a pessimism of 1, which may since have fallen to 0.3."""
    model = dac(pessimism="gpl", initial_optimism=-0.5, reinitialize_every=25)
    model.learn(12)
    with torch.no_grad():
        model.pessimism_rule.weight.fill_(0.3)
    model.num_transitions = 25
    model.explorer.before_updates(model.learner)
    assert model.explorer._optimism(model.learner).item() > -0.3


# ---------------------------------------------------------------- as another algorithm


def test_without_its_explorer_it_is_sac() -> None:
    ours = sac(cls=DAC, exploration="actor", seed=3).learn(40)
    theirs = sac(seed=3).learn(40)
    assert type(ours.explorer) is Exploration
    assert ours._n_updates == 30 and not differing(state(ours), state(theirs))
    np.testing.assert_array_equal(ours.replay_buffer.actions, theirs.replay_buffer.actions)


def test_as_an_argument_of_another_algorithm() -> None:
    """The explorer goes with any of the family."""
    model = sac(cls=VPLSAC, exploration="optimistic_actor", exploration_kwargs={"kl_target": 0.1}).learn(20)
    assert isinstance(model.explorer, OptimisticActor) and model.explorer.kl_target == 0.1
    model = sac(exploration="optimistic_actor", backbone="td3")
    assert torch.isfinite(model._update(random_batch(model))["exploration/actor_loss"])


# ---------------------------------------------------------------- arguments at loading


@pytest.mark.parametrize(
    ("name", "value"),
    [("kl_target", 0.11), ("std_multiplier", 2.5), ("kl_direction", "pessimistic_to_optimistic"),
     ("uncertainty", "both"), ("adjustment_learning_rate", 0.02)],
)  # fmt: skip
def test_arguments_at_loading(name: str, value: Any, tmp_path: Path) -> None:
    dac(n_quantiles=5).learn(12).save(tmp_path / "m")
    loaded = DAC.load(tmp_path / "m", env=vec(), learning_starts=0, **{name: value})
    if name == "adjustment_learning_rate":
        loaded.learn(3)  # the schedule of the others must not take it back
        assert {group["lr"] for group in loaded.explorer.scalar_optimizer.param_groups} == {value}
    else:
        assert getattr(loaded.explorer, name) == value
