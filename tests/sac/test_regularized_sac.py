"""The regularized agents: every combination, and what each choice does to the model."""

import io
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from sb3_sample import RegularizedSAC
from sb3_sample.learner.pessimism import TOP, LearnedPessimism
from sb3_sample.networks import CReLU, EnsembleLayerNorm, SpectralEnsembleLinear
from sb3_sample.networks.spectral_norm import SpectralNorm
from tests.sac.common import differing, random_batch, sac, state, taken_or_refused, vec

CRITIC = ("none", "cdq", "gpl", "top")
NETWORK = ("none", "layer_norm", "spectral_norm", "weight_decay")
PLASTICITY = ("none", "crelu", "resets", "sam")
COMBINATIONS = list(itertools.product(CRITIC, NETWORK, PLASTICITY))
OBSERVATIONS = np.random.default_rng(0).normal(size=(16, 3)).astype(np.float32)


def regularized(env: Any = None, **kwargs: Any) -> Any:
    return sac(env, cls=RegularizedSAC, **kwargs)


def chosen(critic: str = "cdq", network: Any = "none", plasticity: Any = "none", **kwargs: Any) -> Any:
    return regularized(
        critic_regularization=critic, network_regularization=network, plasticity_regularization=plasticity, **kwargs
    )


def round_trip(model: Any, **kwargs: Any) -> Any:
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    return RegularizedSAC.load(file, env=vec(), **kwargs)


# ---------------------------------------------------------------- combinations


def check(model: Any) -> None:
    """It takes 20 updates, stays finite, and is the same after loading, in which it learns on."""
    model.policy.set_training_mode(True)
    for step in range(20):
        model._update(random_batch(model, seed=step))
    assert all(torch.isfinite(value).all() for value in model.policy.state_dict().values())
    loaded = round_trip(model)
    assert not differing(state(model), state(loaded))
    np.testing.assert_array_equal(
        model.predict(OBSERVATIONS, deterministic=True)[0], loaded.predict(OBSERVATIONS, deterministic=True)[0]
    )
    loaded._update(random_batch(model))


def test_there_are_64() -> None:
    assert len(set(COMBINATIONS)) == 64


def _with_any_other(critic: str, network: str, plasticity: str) -> bool:
    """Whether it is one of sixteen combinations that have each two of any two groups once."""
    return (CRITIC.index(critic) + NETWORK.index(network) + PLASTICITY.index(plasticity)) % 4 == 0


@pytest.mark.parametrize(
    ("critic", "network", "plasticity"),
    [
        pytest.param(*each, id="-".join(each), marks=[] if _with_any_other(*each) else pytest.mark.slow)
        for each in COMBINATIONS
    ],
)
def test_every_combination(critic: str, network: str, plasticity: str) -> None:
    check(chosen(critic, network, plasticity))


@pytest.mark.parametrize(
    ("network", "plasticity"),
    [
        (("layer_norm", "weight_decay"), ("resets", "sam")),
        (["spectral_norm", "layer_norm"], ["redo", "crelu"]),
        (NETWORK[1:], ("crelu", "redo", "resets", "sam")),
        (("weight_decay",), ("redo",)),
        ((), ()),
        ("none", ("none",)),
    ],
)
@pytest.mark.parametrize("critic", ["cdq", "gpl"])
def test_several_of_a_group(critic: str, network: Any, plasticity: Any) -> None:
    settings = {"redo_period": 7} if "redo" in plasticity else {}
    check(chosen(critic, network, plasticity, **settings))


def test_everything_at_once_learns(tmp_path: Path) -> None:
    model = chosen("top", NETWORK[1:], ("crelu", "redo", "resets", "sam"), resets=20, redo_period=7).learn(50)
    assert model.plasticity.n_done == 2 and model._n_updates == 40
    loaded = round_trip(model)
    assert loaded.plasticity.n_done == 2 and loaded.plasticity.period == 20


# ---------------------------------------------------------------- what the choices are


def test_by_default_it_is_sac() -> None:
    """Clipped double Q-learning and no regularizer, bit for bit."""
    for kwargs in ({}, {"critic_regularization": "cdq", "network_regularization": "none"}):
        ours, theirs = regularized(seed=3, **kwargs).learn(30), sac(seed=3).learn(30)
        assert not differing(state(ours), state(theirs))
        np.testing.assert_array_equal(ours.replay_buffer.actions, theirs.replay_buffer.actions)
    assert type(ours.critic.trunk.layers[1]) is nn.ReLU and ours.sam_radius is None and ours.redo is None
    assert ours.plasticity.period is None and ours.plasticity.steps == ()


def test_no_critic_regularization_is_the_mean() -> None:
    ours, theirs = chosen("none", seed=3).learn(20), sac(pessimism=0.0, seed=3).learn(20)
    assert not differing(state(ours), state(theirs))


def test_learned_pessimism() -> None:
    rule = chosen("gpl").pessimism_rule
    assert isinstance(rule, LearnedPessimism) and (rule.loss, rule.source) == ("dual", "replay")
    assert rule.optimizer.param_groups[0]["lr"] == 1e-5
    assert isinstance(chosen("top").pessimism_rule, TOP)
    assert chosen("cdq").pessimism_rule.beta() == 1 and chosen("none").pessimism_rule.beta() == 0


def critics_modules(model: Any, kind: Any) -> list[list[nn.Module]]:
    """Modules of a kind in the critics, in the targets, in the actor."""
    return [[m for m in n.modules() if isinstance(m, kind)] for n in (model.critic, model.critic_target, model.actor)]


def test_layer_norm() -> None:
    """After both hidden layers of the critics; none in the actor."""
    critic, target, actor = critics_modules(chosen(network="layer_norm"), (EnsembleLayerNorm, nn.LayerNorm))
    assert (len(critic), len(target), len(actor)) == (2, 2, 0)
    assert not any(critics_modules(chosen(), (EnsembleLayerNorm, nn.LayerNorm)))


def test_spectral_norm() -> None:
    """On the last hidden layer of the critics alone: its directions are the only buffers."""
    model = chosen(network="spectral_norm")
    critic, target, actor = critics_modules(model, SpectralNorm)
    assert (len(critic), len(target), len(actor)) == (1, 1, 0)
    assert critic[0] is model.critic.trunk.layers[2] and isinstance(critic[0], SpectralEnsembleLinear)
    assert {name for name, _ in model.critic.named_buffers()} == {"trunk.layers.2.u", "trunk.layers.2.v"}
    assert not list(model.actor.buffers())
    values = torch.linalg.svdvals(critic[0].normalized_weight().detach())
    torch.testing.assert_close(values[:, 0], torch.ones(2), rtol=1e-3, atol=1e-3)


def test_weight_decay() -> None:
    """Of every parameter of the critics, of nothing else."""
    model = chosen(network="weight_decay")
    decays = {
        name: {group.get("weight_decay") for group in optimizer.param_groups}
        for name, optimizer in model._optimizers().items()
    }
    assert decays.pop("critic.optimizer") == {0.01}
    assert set(decays) == {"actor.optimizer", "temperature_optimizer"} and all(d == {0} for d in decays.values())
    assert {id(p) for group in model.critic.optimizer.param_groups for p in group["params"]} == {
        id(p) for p in model.critic.parameters()
    }
    assert chosen(network="weight_decay", weight_decay=0.3).critic.optimizer.param_groups[0]["weight_decay"] == 0.3
    assert chosen().critic.optimizer.param_groups[0]["weight_decay"] == 0


def test_crelu() -> None:
    """Twice the width after each hidden layer of critics and actor; network regularizations are the critics' alone."""
    model = chosen(plasticity="crelu", network=("layer_norm", "spectral_norm"))
    assert not critics_modules(model, (EnsembleLayerNorm, nn.LayerNorm, SpectralNorm))[2]
    model = chosen(plasticity="crelu")
    assert [len(modules) for modules in critics_modules(model, CReLU)] == [2, 2, 2]
    layers = model.critic.trunk.layers
    assert (layers[0].weight.shape, layers[2].weight.shape) == ((2, 5, 8), (2, 16, 8))
    assert model.critic.head.weight.shape == (2, 16, 1)
    layers = model.actor.trunk.layers
    assert [type(m) for m in layers] == [nn.Linear, CReLU, nn.Linear, CReLU]
    assert (layers[0].weight.shape, layers[2].weight.shape) == ((8, 3), (8, 16))
    assert model.actor.mean.weight.shape == model.actor.log_std.weight.shape == (2, 16)
    assert not any(critics_modules(chosen(), CReLU))


def test_crelu_is_the_activation_of_both() -> None:
    with pytest.raises(ValueError, match="'crelu', the activation of actor and critics, .* activation_fn"):
        chosen(plasticity="crelu", policy_kwargs={"activation_fn": nn.Tanh})
    for who in ("actor", "critic"):
        with pytest.raises(ValueError, match=f"{who}_network_kwargs.* has 'activation_fn'"):
            chosen(plasticity="crelu", policy_kwargs={f"{who}_network_kwargs": {"activation_fn": nn.Tanh}})
        with pytest.raises(ValueError, match=f"regularize an MLP, not {who}_network='bronet'"):
            chosen(plasticity="crelu", policy_kwargs={f"{who}_network": "bronet"})
    # The network regularizations leave the actor alone, whatever it is.
    chosen(network="layer_norm", policy_kwargs={"actor_network": "bronet"})


def test_sam_resets_and_redo() -> None:
    model = chosen(plasticity="sam")
    assert model.sam_radius == 0.05 and model.redo is None and model.plasticity.period is None
    model = chosen(plasticity="resets")
    assert model.plasticity.period == 160_000 and model.sam_radius is None and model.redo is None
    model = chosen(plasticity="redo")
    assert (model.redo.period, model.redo.threshold) == (1000, 0.025)
    assert model.sam_radius is None and model.plasticity.period is None
    model = chosen(plasticity=("sam", "resets", "redo"), sam_radius=0.1, resets=(30, 40), redo_period=5)
    assert (model.sam_radius, model.plasticity.steps, model.redo.period) == (0.1, (30, 40), 5)


def test_resets_by_gradient_steps() -> None:
    model = chosen(plasticity="resets", reset_gradient_steps=30)
    assert model.plasticity.gradient_steps == 30 and model.plasticity.period is None and model.resets == ()
    assert round_trip(model).plasticity.gradient_steps == 30
    assert round_trip(chosen(plasticity="resets"), reset_gradient_steps=7).plasticity.gradient_steps == 7
    with pytest.raises(ValueError, match="resets=20 and reset_gradient_steps=30"):
        chosen(plasticity="resets", reset_gradient_steps=30, resets=20)


def test_resets_as_an_array() -> None:
    """As in the other algorithms."""
    assert tuple(chosen(plasticity="resets", resets=np.array([30, 40])).plasticity.steps) == (30, 40)


def test_choices_move_the_critics() -> None:
    """Each one makes another model of the same seed."""
    batches = [random_batch(sac(), seed=step) for step in range(3)]
    outcomes: dict[str, torch.Tensor] = {}
    for network, plasticity in [(n, "none") for n in NETWORK] + [("none", p) for p in ("crelu", "sam")]:
        model = chosen("cdq", network, plasticity)
        for batch in batches:
            torch.manual_seed(0)
            model._update(batch)
        with torch.no_grad():
            outcomes[f"{network}-{plasticity}"] = model.critic(batches[0].observations, batches[0].actions)
    for (one, a), (other, b) in itertools.combinations(outcomes.items(), 2):
        assert not torch.equal(a, b), f"{one} is {other}"


# ---------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("group", "value", "words"),
    [
        ("critic", "foo", "critic_regularization.*'foo'"),
        ("critic", "vpl", "critic_regularization.*'vpl'"),
        ("network", "foo", "network_regularization.*'foo'"),
        ("network", ("layer_norm", "foo"), "network_regularization.*foo"),
        ("network", ("layer_norm", "none"), "network_regularization.*'none' beside others"),
        ("network", ("layer_norm", "layer_norm"), "network_regularization.*at most once"),
        ("network", "crelu", "network_regularization.*'crelu'"),
        ("plasticity", "foo", "plasticity_regularization.*'foo'"),
        ("plasticity", ("none", "sam"), "plasticity_regularization.*'none' beside others"),
        ("plasticity", ["sam", "sam"], "plasticity_regularization.*at most once"),
        ("plasticity", "layer_norm", "plasticity_regularization.*'layer_norm'"),
    ],
)
def test_names(group: str, value: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        chosen(**{group: value})


@pytest.mark.parametrize("critic", [("cdq",), None, 1.0, ["gpl"]])
def test_critic_regularization_of_another_type(critic: Any) -> None:
    with pytest.raises(ValueError, match="critic_regularization"):
        chosen(critic)


def test_arguments_of_the_rule() -> None:
    assert regularized(critic_regularization="gpl").pessimism_rule.optimizer.param_groups[0]["lr"] == 1e-5
    other = regularized(critic_regularization="gpl", pessimism_kwargs={"learning_rate": 1e-3})
    assert other.pessimism_rule.optimizer.param_groups[0]["lr"] == 1e-3
    with pytest.raises(ValueError, match="pessimism_kwargs"):
        regularized(critic_regularization="cdq", pessimism_kwargs={"learning_rate": 1e-3})


@pytest.mark.parametrize("kwargs", [{"pessimism": 0.5}, {"pessimism": 1.0}])
def test_pessimism_is_chosen_by_name(kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(kwargs))}.*critic_regularization"):
        regularized(**kwargs)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("weight_decay", 0.1),
        ("sam_radius", 0.1),
        ("resets", 30),
        ("resets", (30,)),
        ("reset_gradient_steps", 9),
        ("redo_period", 7),
    ],
)
def test_setting_of_a_regularization_that_is_not_chosen(name: str, value: Any) -> None:
    """Not dropped without a word."""
    with pytest.raises(ValueError, match=name):
        regularized(**{name: value})


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_bad_weight_decay(value: float) -> None:
    with pytest.raises(ValueError, match="weight_decay"):
        chosen(network="weight_decay", weight_decay=value)


# ---------------------------------------------------------------- arguments at loading


@pytest.mark.parametrize(
    "kwargs",
    [
        {"critic_regularization": "none"},
        {"critic_regularization": "gpl"},
        {"critic_regularization": "foo"},
        {"pessimism": 0.0},
        {"pessimism": "gpl"},
        {"network_regularization": "layer_norm"},
        {"network_regularization": "spectral_norm"},
        {"network_regularization": "foo"},
        {"plasticity_regularization": "sam"},
        {"plasticity_regularization": "resets"},
        {"plasticity_regularization": "redo"},
        {"plasticity_regularization": "crelu"},
        {"plasticity_regularization": ("none", "sam")},
        {"sam_radius": 0.05},
        {"redo_period": 7},
        {"resets": 30},
        {"resets": (30,)},
        {"reset_gradient_steps": 30},
    ],
    ids=str,
)
def test_other_regularizations_at_loading_are_refused(kwargs: dict[str, Any]) -> None:
    file = io.BytesIO()
    regularized().save(file)
    file.seek(0)
    RegularizedSAC.load(file, env=vec())  # it can be loaded at all
    file.seek(0)
    with pytest.raises(ValueError, match="regularization|with these arguments"):
        RegularizedSAC.load(file, env=vec(), **kwargs)


@pytest.mark.parametrize("kwargs", [{"sam_radius": None}, {"resets": ()}, {"redo_period": None}])
def test_taking_one_away_at_loading_is_refused(kwargs: dict[str, Any]) -> None:
    model = chosen(plasticity=("sam", "resets", "redo"))
    with pytest.raises(ValueError, match="plasticity_regularization"):
        round_trip(model, **kwargs)


def test_settings_at_loading() -> None:
    model = chosen(network="weight_decay", plasticity=("sam", "resets", "redo"))
    loaded = round_trip(model, weight_decay=0.3, sam_radius=0.2, resets=(70,), redo_period=9)
    assert {group["weight_decay"] for group in loaded.critic.optimizer.param_groups} == {0.3}
    assert {group["weight_decay"] for group in loaded.actor.optimizer.param_groups} == {0}
    assert (loaded.sam_radius, loaded.plasticity.steps, loaded.redo.period) == (0.2, (70,), 9)


def test_weight_decay_without_its_name_at_loading() -> None:
    with pytest.raises(ValueError, match="weight_decay|network_regularization"):
        round_trip(chosen(), weight_decay=0.3)


@pytest.mark.parametrize(("before", "after", "decay"), [("none", "weight_decay", 0.02), ("weight_decay", "none", None)])
def test_weight_decay_taken_up_or_given_up_at_loading(before: str, after: str, decay: float | None) -> None:
    """It is no network: with its setting it can come and go; its name alone is in force or refused."""
    loaded = round_trip(chosen(network=before), network_regularization=after, weight_decay=decay)
    assert loaded.critic.optimizer.param_groups[0]["weight_decay"] == (decay or 0)
    model = chosen(network=before)
    loaded = taken_or_refused(lambda: round_trip(model, network_regularization=after), "network_regularization")
    if loaded is not None:
        assert loaded.critic.optimizer.param_groups[0]["weight_decay"] == (0.01 if after == "weight_decay" else 0)
