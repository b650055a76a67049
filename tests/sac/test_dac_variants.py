"""DAC, table 1: each row's equations by hand, in float64."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sb3_sample import DAC
from sb3_sample.learner.batch import Batch, Noise
from sb3_sample.learner.exploration import OptimisticActor, ScaledNoise
from tests.sac.common import differing, random_batch, sac, state, vec
from tests.sac.test_dac import constant_gaussian

DIRECTIONS = ["optimistic_to_pessimistic", "pessimistic_to_optimistic"]
#: By the paper's name of a row, its arguments.
ROWS: dict[str, dict[str, Any]] = {
    "ONLY OPTIMISTIC": {"pessimistic_actor": None},
    "ONLY OPTIMISTIC, entropy": {"pessimistic_actor": None, "optimistic_entropy": True},
    "NO KL REG": {"initial_kl_weight": 0},
    "DETERMINISTIC OPTIMISTIC": {"optimistic_actor": "deterministic"},
    "DETERMINISTIC PESSIMISTIC": {"pessimistic_actor": "deterministic"},
    "NO ADJUSTMENTS": {"adjustment_learning_rate": 0},
    "NO KL WEIGHT ADJUSTMENT": {"kl_weight_learning_rate": 0},
    "NO OPTIMISM ADJUSTMENT": {"optimism_learning_rate": 0},
}


class Critic(torch.nn.Module):
    """Two critics of the first action dimension a and the second b: 3a + b^2 + 1 and a - b, in float64."""

    trunk = type("Trunk", (), {"stacks_rows": None})

    def forward(self, observations: Any, actions: torch.Tensor) -> torch.Tensor:
        a, b = actions[:, :1], actions[:, 1:]
        return torch.stack((3 * a + b.square() + 1, a - b))


def exact(model: Any) -> Any:
    """The model in float64, with critics that are known and of which nothing is learned."""
    model.policy.double()
    model.explorer.double()
    object.__setattr__(model.policy, "critic", Critic())
    for actor in (model.actor, getattr(model.explorer, "actor", model.actor)):
        # Stable-Baselines3's extractors give float32.
        object.__setattr__(actor, "features", lambda observations: observations)
    return model


def doubled(batch: Batch) -> Batch:
    tensors = ("observations", "actions", "next_observations", "dones", "rewards")
    return batch._replace(**{name: getattr(batch, name).double() for name in tensors})


def dac(**kwargs: Any) -> Any:
    return sac(cls=DAC, **kwargs)


def known(optimistic: tuple[float, float], pessimistic: tuple[float, float], **kwargs: Any) -> Any:
    """Mean and deviation of both actors' Gaussians, the same everywhere."""
    model = exact(dac(**kwargs))
    for actor, (mean, std) in ((model.explorer.actor, optimistic), (model.actor, pessimistic)):
        constant_gaussian(actor, mean, std)
    return model


def scalars(model: Any) -> tuple[float, float]:
    return model.explorer.optimism_distance().item(), model.explorer.kl_weight().item()


# ---------------------------------------------------------------- every row


@pytest.mark.parametrize("row", ROWS)
def test_every_row_learns_and_is_saved(row: str, tmp_path: Path) -> None:
    """What is loaded goes on as what was saved."""
    model = dac(**ROWS[row], learning_rate=1e-2).learn(16)
    model.save(tmp_path / "m")
    loaded = DAC.load(tmp_path / "m")
    assert not differing(state(model), state(loaded))
    batch, noise = random_batch(model), Noise(*(torch.randn(8, 2) for _ in range(3)))
    for each in (model, loaded):
        metrics = each._update(batch, noise)
        assert all(torch.isfinite(value) for value in metrics.values())
    assert not differing(state(model), state(loaded))


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
def test_every_row_compiled(row: str) -> None:
    """The compiled gradient step is the eager one."""
    models = [dac(**ROWS[row], learning_rate=1e-2, compile=compile) for compile in (False, True)]
    batch, noise = random_batch(models[0]), Noise(*(torch.randn(8, 2) for _ in range(3)))
    for model in models:
        for _ in range(3):
            model._update(batch, noise)
    ours, theirs = map(state, models)
    for name in ours:
        torch.testing.assert_close(ours[name], theirs[name], rtol=1e-4, atol=1e-5, msg=name)


# ---------------------------------------------------------------- rates


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize(
    ("rates", "moves"),
    [
        ({"adjustment_learning_rate": 0}, (False, False)),
        ({"optimism_learning_rate": 0}, (False, True)),
        ({"kl_weight_learning_rate": 0}, (True, False)),
        ({"adjustment_learning_rate": 0, "kl_weight_learning_rate": 0.1}, (False, True)),
        ({"adjustment_learning_rate": 0, "optimism_learning_rate": 0.1}, (True, False)),
    ],
)
def test_a_rate_of_zero_leaves_the_number_bit_equal(
    direction: str, rates: dict[str, float], moves: tuple[bool, bool]
) -> None:
    model = dac(kl_direction=direction, **{"adjustment_learning_rate": 0.01, **rates})
    before = scalars(model)
    raw = [p.detach().clone() for p in (model.explorer.optimism_distance.log_value, model.explorer.kl_weight.log_value)]
    for seed in range(5):
        model._update(random_batch(model, seed=seed))
    after = scalars(model)
    for i, p in enumerate((model.explorer.optimism_distance.log_value, model.explorer.kl_weight.log_value)):
        assert torch.equal(raw[i], p) == (not moves[i])
        assert (before[i] == after[i]) == (not moves[i])


def test_rates_of_their_own_by_hand() -> None:
    """Adam's first step is its rate: log(beta_o + beta) and log(tau) move by it, against and with the divergence."""
    model = known((1.0, 1.0), (0.0, 1.0), optimism_learning_rate=0.25, kl_weight_learning_rate=0.125)
    metrics = model.explorer.update(model.learner, doubled(random_batch(model)))
    assert metrics["exploration/kl"].item() == pytest.approx(0.5, rel=1e-12)  # (1 - 0)^2 / 2
    model = known((2.0, 1.0), (0.0, 1.0), optimism_learning_rate=0.25, kl_weight_learning_rate=0.125)
    model.explorer.update(model.learner, doubled(random_batch(model)))  # a divergence of 2, 1.5 above the target
    assert model.explorer.optimism_distance.log_value.item() == pytest.approx(math.log(0.5) - 0.25, rel=1e-6)
    assert model.explorer.kl_weight.log_value.item() == pytest.approx(0.125, rel=1e-6)


@pytest.mark.parametrize(("common", "own"), [(0.02, None), (0.02, 0.01), (0.02, 0)])
def test_rates_at_loading(common: float, own: float | None, tmp_path: Path) -> None:
    dac().learn(12).save(tmp_path / "m")
    loaded = DAC.load(
        tmp_path / "m", env=vec(), learning_starts=0, adjustment_learning_rate=common, optimism_learning_rate=own
    )
    loaded.learn(3)  # the schedule of the others must not take them back
    rates = [group["lr"] for group in loaded.explorer.scalar_optimizer.param_groups]
    assert rates == [common if own is None else own, common]


# ---------------------------------------------------------------- no divergence in the loss


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_without_a_weight_the_divergence_is_no_part_of_the_loss(direction: str) -> None:
    """The loss is -(Q_mean + beta_o Q_std); optimism is adjusted by the divergence all the same."""
    kwargs = {"initial_kl_weight": 0, "adjustment_learning_rate": 0.1, "kl_direction": direction}
    model = known((0.3, 0.5), (-0.2, 0.25), **kwargs)
    noise = torch.zeros(8, 2, dtype=torch.float64)
    metrics = model.explorer.update(model.learner, doubled(random_batch(model)), noise)
    a = math.tanh(0.3)
    q = (3 * a + a * a + 1, a - a)
    mean, spread = (q[0] + q[1]) / 2, abs(q[0] - q[1]) / 2
    assert metrics["exploration/actor_loss"].item() == pytest.approx(-(mean - 0.5 * spread), rel=1e-6)
    there, back = math.log(0.25 / 0.5) + (0.25 + 0.25) / 0.125 - 0.5, math.log(2) + (0.0625 + 0.25) / 0.5 - 0.5
    kl = there if direction == "optimistic_to_pessimistic" else back
    assert metrics["exploration/kl"].item() == pytest.approx(kl, rel=1e-6)
    assert metrics["exploration/kl_weight_loss"].item() == 0
    # Farther than the target: optimism falls by Adam's first step, and the weight stays where it is.
    assert model.explorer.optimism_distance.log_value.item() == pytest.approx(math.log(0.5) - 0.1, rel=1e-6)
    assert model.explorer.kl_weight().item() == 0


def test_without_a_weight_it_stays_without_through_a_restart() -> None:
    model = dac(initial_kl_weight=0, reinitialize_every=12, learning_rate=1e-2).learn(30)
    assert model.explorer.kl_weight().item() == 0
    assert model.explorer.optimism_distance().item() != 0.5


# ---------------------------------------------------------------- deterministic actors


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_deterministic_optimistic_actor_by_hand(direction: str) -> None:
    """KL = sum (mu_o - mu_p)^2 / (2 sigma_p^2); the mean acts, and the value is the mean action's."""
    model = known((0.3, 2.0), (-0.2, 0.25), optimistic_actor="deterministic", kl_direction=direction)
    noise = torch.full((8, 2), 5.0, dtype=torch.float64)
    metrics = model.explorer.update(model.learner, doubled(random_batch(model)), noise)
    kl = 0.5**2 / (2 * 0.25**2)  # a dimension
    assert metrics["exploration/kl"].item() == pytest.approx(kl, rel=1e-6)
    a = math.tanh(0.3)
    q = (3 * a + a * a + 1, 0.0)
    upper = sum(q) / 2 - 0.5 * abs(q[0]) / 2
    assert metrics["exploration/actor_loss"].item() == pytest.approx(1.0 * 2 * kl - upper, rel=1e-6)


def test_deterministic_optimistic_actor_learns_its_mean_alone() -> None:
    model = dac(optimistic_actor="deterministic", learning_rate=1e-2)
    before = state(model)
    for seed in range(3):
        model._update(random_batch(model, seed=seed))
    changed = differing(before, state(model))
    assert not [name for name in changed if name.startswith("explorer/actor.log_std")]
    assert [name for name in changed if name.startswith("explorer/actor.mean")]
    assert [name for name in changed if name.startswith("policy/actor.log_std")], "the other one is a Gaussian"


def test_deterministic_optimistic_actor_acts_by_its_mean() -> None:
    model = dac(optimistic_actor="deterministic")
    constant_gaussian(model.explorer.actor, 0.2, 0.4)
    with torch.no_grad():
        actions = model.explorer.act(model.learner, torch.randn(5, 3))
    np.testing.assert_allclose(actions, math.tanh(0.2), rtol=1e-5)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_deterministic_pessimistic_actor_in_the_divergence(direction: str) -> None:
    """KL = sum (mu_o - mu_p)^2 / (2 sigma_o^2), whose gradient reaches sigma_o too."""
    model = known((0.3, 0.5), (-0.2, 0.01), pessimistic_actor="deterministic", kl_direction=direction)
    optimistic = (torch.tensor([[0.3]]), torch.tensor([[0.5]], requires_grad=True))
    kl = model.explorer._kl(model.learner, optimistic, (torch.tensor([[-0.2]]), torch.tensor([[0.01]])))
    assert kl.item() == pytest.approx(0.5**2 / (2 * 0.5**2), rel=1e-6)
    kl.backward()
    assert optimistic[1].grad is not None
    assert optimistic[1].grad.item() == pytest.approx(-(0.5**2) / 0.5**3, rel=1e-5)
    metrics = model.explorer.update(model.learner, doubled(random_batch(model)))
    assert metrics["exploration/kl"].item() == pytest.approx(0.5, rel=1e-6)


def test_deterministic_pessimistic_actors_target_and_loss() -> None:
    """Target r + gamma Q^beta(s', tanh mu_p(s')), loss -Q^beta(s, tanh mu_p(s)): no entropy, whatever the noise."""
    model = exact(dac(pessimistic_actor="deterministic"))
    constant_gaussian(model.actor, 0.4, 0.7)
    learner, batch = model.learner, doubled(random_batch(model))
    noise = torch.full((8, 2), 9.0, dtype=torch.float64)
    actions, log_prob = learner.next_actions(batch.next_observations, noise)
    np.testing.assert_allclose(actions.detach(), math.tanh(0.4), rtol=1e-6)
    assert (log_prob == 0).all() and model.policy.actor_target is None
    loss, _ = learner.objective.actor_loss(
        learner, batch, batch.observations, torch.tensor(0.3), noise, learner.objective.prepare(learner, batch)[1]
    )
    a = math.tanh(0.4)
    assert loss.item() == pytest.approx(-min(3 * a + a * a + 1, 0.0), abs=1e-6)
    assert model.temperature().item() == 0 and model.temperature_optimizer is None
    # The other one explores by a Gaussian of its own.
    constant_gaussian(model.explorer.actor, 0.2, 0.4)
    with torch.no_grad():
        explored = model.explorer.sampled(learner, batch.observations, torch.ones(8, 2, dtype=torch.float64))
    np.testing.assert_allclose(explored, math.tanh(0.2 + 1.25 * 0.4), rtol=1e-5)


def test_deterministic_pessimistic_actor_is_evaluated_by_its_action() -> None:
    model = dac(pessimistic_actor="deterministic")
    constant_gaussian(model.actor, 0.4, 0.7)
    for deterministic in (False, True):
        actions = model.predict(np.zeros((4, 3), np.float32), deterministic=deterministic)[0]
        np.testing.assert_allclose(actions, math.tanh(0.4), rtol=1e-5)
    assert "train/ent_coef" not in model._update(random_batch(model))


# ---------------------------------------------------------------- one optimistic actor


@pytest.mark.parametrize("entropy", [False, True])
@pytest.mark.parametrize(("initial", "optimism"), [(None, -0.5), (0.75, 0.75)])
def test_one_optimistic_actor_by_hand(entropy: bool, initial: float | None, optimism: float) -> None:
    """Its loss is -(Q_mean + beta_o Q_std), of its own samples, and alpha log pi besides if asked for."""
    model = exact(dac(pessimistic_actor=None, optimistic_entropy=entropy, initial_optimism=initial))
    constant_gaussian(model.actor, 0.2, 0.4)
    learner, batch = model.learner, doubled(random_batch(model))
    noise = torch.full((8, 2), 0.5, dtype=torch.float64)
    loss, log_prob = learner.objective.actor_loss(
        learner, batch, batch.observations, torch.tensor(0.3), noise, learner.objective.prepare(learner, batch)[1]
    )
    x = 0.2 + 0.4 * 0.5  # without the multiplier, which is for exploring
    a = math.tanh(x)
    q = (3 * a + a * a + 1, 0.0)
    upper = sum(q) / 2 + optimism * abs(q[0]) / 2
    density = -0.5 * 0.25 - math.log(0.4) - 0.5 * math.log(2 * math.pi) - math.log(1 - a * a)
    assert log_prob is not None and log_prob[0].item() == pytest.approx(2 * density, rel=1e-5)
    assert loss.item() == pytest.approx(0.3 * 2 * density * entropy - upper, rel=1e-5)


@pytest.mark.parametrize(("arms", "optimism"), [((0.0, 1.0), 0.5), ((1.0, 0.75), -0.25)])
def test_one_optimistic_actor_beside_a_bandit(arms: tuple[float, float], optimism: float, tmp_path: Path) -> None:
    """Its optimism is the same whichever arm is drawn first, in files too."""
    bandit = {"pessimism": "top", "pessimism_kwargs": {"arms": arms}}
    models = [dac(pessimistic_actor=None, seed=seed, **bandit) for seed in range(6)]
    assert len({model.pessimism_rule.arm for model in models}) == 2
    models[0].save(tmp_path / "m")
    models += [DAC.load(tmp_path / "m") for _ in range(4)]
    models[1].reinitialize()
    assert {model.objective.optimism for model in models} == {optimism}


def test_one_optimistic_actor_does_everything() -> None:
    """It explores with its deviation multiplied, makes the targets without, and is evaluated by its mean."""
    model = dac(pessimistic_actor=None)
    assert type(model.explorer) is ScaledNoise and not list(model.explorer.parameters())
    constant_gaussian(model.actor, 0.2, 0.4)
    observations, noise = torch.zeros(4, 3), torch.ones(4, 2)
    with torch.no_grad():
        np.testing.assert_allclose(
            model.explorer.sampled(model.learner, observations, noise), math.tanh(0.2 + 1.25 * 0.4), rtol=1e-5
        )
        actions, log_prob = model.learner.next_actions(observations, noise)
    np.testing.assert_allclose(actions, math.tanh(0.6), rtol=1e-5)
    assert (log_prob != 0).all()
    mean = model.predict(np.zeros((4, 3), np.float32), deterministic=True)[0]
    np.testing.assert_allclose(mean, math.tanh(0.2), rtol=1e-5)
    metrics = model._update(random_batch(model))
    assert {"train/ent_coef_loss", "train/entropy"} <= metrics.keys()
    assert not [name for name in metrics if name.startswith("exploration/")]


def test_one_optimistic_actor_differs_from_sac_in_its_loss_and_noise_alone() -> None:
    """With optimism at minus the pessimism and the entropy it is SAC with a larger deviation while exploring."""
    batch, noise = random_batch(sac()), Noise(*(torch.randn(8, 2) for _ in range(3)))
    ours = dac(pessimistic_actor=None, optimistic_entropy=True, initial_optimism=-0.999999, seed=3)
    theirs = sac(seed=3)
    ours._update(batch, noise)
    theirs._update(batch, noise)
    mine, base = state(ours), state(theirs)
    for name in base:
        torch.testing.assert_close(mine[name], base[name], rtol=1e-4, atol=1e-6, msg=name)


# ---------------------------------------------------------------- at the door


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"optimism_learning_rate": -1e-3}, "optimism_learning_rate must be at least 0 .*adjustment_learning_rate"),
        ({"kl_weight_learning_rate": "1"}, "kl_weight_learning_rate must be at least 0 .*not '1'"),
        ({"initial_kl_weight": -1}, "initial_kl_weight must be at least 0 and finite, not -1"),
        ({"initial_kl_weight": 0, "kl_weight_learning_rate": 1e-3}, "kl_weight_learning_rate=0.001 means nothing with"),
        ({"optimistic_actor": "greedy"}, "optimistic_actor must be 'stochastic' or 'deterministic', not 'greedy'"),
        ({"optimistic_actor": None}, "optimistic_actor must be .*, not None"),
        ({"pessimistic_actor": "none"}, "pessimistic_actor must be .*None for one optimistic actor.*not 'none'"),
        ({"optimistic_actor": "deterministic", "pessimistic_actor": "deterministic"}, "backbone='td3'"),
        ({"optimistic_actor": "deterministic", "pessimistic_actor": None}, "backbone='td3'"),
        ({"optimistic_actor": "deterministic", "std_multiplier": 2.0}, "std_multiplier=2.0 means nothing"),
        ({"optimistic_actor": "deterministic", "backbone": "td3"}, "optimistic_actor='deterministic' means nothing"),
        ({"pessimistic_actor": "deterministic", "backbone": "td3"}, "pessimistic_actor='deterministic' means nothing"),
        ({"pessimistic_actor": "deterministic", "ent_coef": 0.1}, "ent_coef=0.1 means nothing"),
        ({"pessimistic_actor": "deterministic", "target_entropy": -1.0}, "target_entropy=-1.0 means nothing"),
        ({"pessimistic_actor": None, "kl_target": 0.1}, "kl_target=0.1 means nothing with pessimistic_actor=None"),
        ({"pessimistic_actor": None, "optimism_learning_rate": 0}, "optimism_learning_rate=0 means nothing"),
        ({"pessimistic_actor": None, "actor_pessimism": 0.0}, "actor_pessimism=0.0 means nothing"),
        ({"pessimistic_actor": None, "uncertainty": "both"}, "uncertainty='both'.*n_quantiles"),
        ({"pessimistic_actor": None, "initial_optimism": -1.0}, "initial_optimism must be above"),
        ({"pessimistic_actor": None, "exploration_kwargs": {"foo": 1}}, "exploration_kwargs"),
        ({"pessimistic_actor": None, "std_multiplier": 0.0}, "std_multiplier must be above 0"),
        ({"optimistic_entropy": True}, "optimistic_entropy=True means nothing"),
        ({"exploration": "actor", "pessimistic_actor": None}, "pessimistic_actor=None means nothing"),
        ({"exploration": "actor", "kl_weight_learning_rate": 0}, "kl_weight_learning_rate=0 means nothing"),
        ({"exploration_kwargs": {"deterministic": True}}, "argument optimistic_actor"),
        ({"backbone": "mean"}, r"backbone must be one of \['sac', 'td3'\], not 'mean'"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        dac(**kwargs)


def test_by_default_nothing_of_this() -> None:
    explorer = dac().explorer
    assert type(explorer) is OptimisticActor and not explorer.deterministic
    assert [group["lr"] for group in explorer.scalar_optimizer.param_groups] == [3e-5, 3e-5]


@pytest.mark.slow
@pytest.mark.parametrize("row", ["DETERMINISTIC PESSIMISTIC", "ONLY OPTIMISTIC"])
def test_rows_with_another_actor_are_exported(row: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    from tests.test_export import check, shake

    check(shake(dac(**ROWS[row])), tmp_path)
