"""Classes in the places of names: each is one class, used, saved by its import path, and compiled if it says so."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from sb3_sample import BRO, DAC, SAC, DiagnosticsCallback
from sb3_sample.learner.execution import foreign_parts
from sb3_sample.parts import (
    Batch,
    BatchTransform,
    Exploration,
    Network,
    Noise,
    Part,
    Pessimism,
    ValueHead,
    epistemic_std,
    linear,
    values,
)
from sb3_sample.saving.container import BadFile
from tests.sac.common import COMPILES, bro, differing, random_batch, sac, state, vec


class Rule(Pessimism):
    """Halfway between mean and minimum, and counts what it hears."""

    compilable = True

    def __init__(self, learner: Any, weight: float = 0.5):
        super().__init__(weight)
        self.register_buffer("n_updates", torch.tensor(0))

    def after_update(self, learner: Any, batch: Batch) -> dict[str, torch.Tensor]:
        self.n_updates += 1
        return {"rule/n": self.n_updates.clone()}


class Uniform(Exploration):
    def act(self, learner: Any, observations: Any) -> torch.Tensor:
        return 2 * torch.rand_like(super().act(learner, observations)) - 1


class BatchNorm(Network):
    """One layer with batch norm, each critic its own statistics."""

    trains_in_target = False

    def __init__(self, in_features: int, n_copies: int | None = None, width: int = 8):
        super().__init__()
        self.out_features, self.n_copies = width, n_copies
        self.dense = linear(in_features, width, n_copies)
        self.norm = nn.BatchNorm1d((n_copies or 1) * width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        h = self.dense(x)
        if self.n_copies is None:
            return torch.relu(self.norm(h))
        e, b, f = h.shape
        normed = self.norm(h.transpose(0, 1).reshape(b, e * f)).view(b, e, f)
        return torch.relu(normed.transpose(0, 1))


class Unit(Network):
    """A layer whose kernel is brought back to rows of length 1 after every step."""

    compilable = True

    def __init__(self, in_features: int, n_copies: int | None = None):
        super().__init__()
        self.out_features = 8
        self.dense = linear(in_features, 8, n_copies)
        self.project()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.dense(x))

    @torch.no_grad()
    def project(self) -> None:
        self.dense.weight.div_(self.dense.weight.norm(dim=-1, keepdim=True))

    def refresh(self) -> None:
        self.project()


class TwoHot(ValueHead):
    """A categorical head in small: logits over a support, the expectation as value, cross-entropy as loss."""

    compilable = True
    support: torch.Tensor

    def __init__(self, low: float = -5.0, high: float = 5.0, n_outputs: int = 11):
        super().__init__()
        self.n_outputs = n_outputs
        self.register_buffer("support", torch.linspace(low, high, n_outputs))

    def values(self, outputs: torch.Tensor) -> torch.Tensor:
        return (outputs.softmax(-1) * self.support).sum(-1, keepdim=True)

    def loss(self, q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        spacing = self.support[1] - self.support[0]
        weights = (1 - (target - self.support).abs() / spacing).clamp(min=0)  # (B, n_outputs)
        return -(weights * q.log_softmax(-1)).sum() / len(target)


class Scaled(BatchTransform):
    """Rewards divided by the largest seen so far, and a jitter of the observations."""

    scale: torch.Tensor

    def __init__(self, learner: Any, jitter: float = 0.0):
        super().__init__(learner)
        self.jitter = jitter
        self.register_buffer("scale", torch.tensor(1.0))

    def on_step(self, learner: Any, rewards: Any, dones: Any, infos: Any) -> None:
        self.scale.clamp_(min=float(np.abs(rewards).max()))

    def draw(self, batch: Batch) -> torch.Tensor | None:
        return torch.randn_like(batch.observations) if self.jitter else None

    def transform(self, batch: Batch, noise: torch.Tensor | None) -> Batch:
        shift = 0 if noise is None else self.jitter * noise
        return batch._replace(rewards=batch.rewards / self.scale, observations=batch.observations + shift)


#: An argument and its value; with what the model has then.
CHOICES: list[tuple[dict[str, Any], Any]] = [
    ({"pessimism": Rule}, lambda m: m.pessimism_rule.beta() == 0.5),
    ({"pessimism": Rule, "pessimism_kwargs": {"weight": 0.25}}, lambda m: m.pessimism_rule.beta() == 0.25),
    ({"exploration": Uniform}, lambda m: type(m.explorer) is Uniform),
    ({"policy_kwargs": {"critic_network": BatchNorm}}, lambda m: type(m.critic_target.trunk) is BatchNorm),
    (
        {"policy_kwargs": {"actor_network": BatchNorm, "actor_network_kwargs": {"width": 4}}},
        lambda m: m.actor.trunk.out_features == 4,
    ),
    ({"value_head": TwoHot, "value_head_kwargs": {"n_outputs": 7}}, lambda m: m.critic.head.weight.shape[-2:].count(7)),
    ({"batch_transforms": [Scaled, (Scaled, {"jitter": 0.5})]}, lambda m: [t.jitter for t in m.transforms] == [0, 0.5]),
]
IDS = ["rule", "rule with arguments", "explorer", "critic", "actor", "head", "transforms"]


@pytest.mark.parametrize(("kwargs", "check"), CHOICES, ids=IDS)
def test_classes_in_the_place_of_names(kwargs: dict[str, Any], check: Any, tmp_path: Path) -> None:
    model = sac(**kwargs).learn(40)
    assert check(model) and all(np.isfinite(value.item()) for value in model._metrics.values())
    model.save(tmp_path / "m")
    with pytest.raises(BadFile, match=r"test_parts_of_ones_own.*trusted_modules"):
        SAC.load(tmp_path / "m", env=vec())
    loaded = SAC.load(tmp_path / "m", env=vec(), trusted_modules=[__name__])
    assert check(loaded) and not differing(state(model), state(loaded))
    # The same steps afterwards.
    torch.manual_seed(0)
    first = model._update(random_batch(model))
    torch.manual_seed(0)
    second = loaded._update(random_batch(loaded))
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"pessimism": Part}, "pessimism must be a number, or one of .*, or a class derived from Pessimism"),
        ({"pessimism": Pessimism(1.0)}, "not an object of Pessimism: pass the class, and its arguments"),
        ({"pessimism": Rule, "pessimism_kwargs": {"other": 1}}, r"pessimism_kwargs has 'other', .*takes \['weight'\]"),
        ({"exploration": Pessimism}, "exploration must be one of .*, or a class derived from Exploration, not"),
        ({"value_head": nn.Module}, "value_head must be one of .*, or a class derived from ValueHead, or None"),
        ({"value_head": TwoHot, "n_quantiles": 5}, r"n_quantiles=5 and value_head=.* value_head=None .* n_quantiles"),
        ({"value_head_kwargs": {"low": 1}}, "value_head_kwargs"),
        ({"batch_transforms": [Part]}, "batch_transforms must be classes derived from BatchTransform"),
        ({"batch_transforms": Scaled}, "batch_transforms must be classes derived from BatchTransform"),
        ({"policy_kwargs": {"critic_network": nn.Linear}}, "critic_network must be one of .* derived from Network"),
        ({"policy_kwargs": {"critic_network": BatchNorm, "critic_network_kwargs": {"x": 1}}}, r"takes \['width'\]"),
        ({"policy_kwargs": {"actor_network": BatchNorm, "net_arch": [8]}}, "net_arch describes an MLP"),
    ],
)  # fmt: skip
def test_what_is_no_such_class(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        sac(**kwargs)


def test_every_class_takes_them() -> None:
    model = bro(pessimism=Rule, value_head=TwoHot, n_quantiles=None, batch_transforms=(Scaled,)).learn(30)
    assert type(model.learner.head) is TwoHot and type(model.pessimism_rule) is Rule and isinstance(model, BRO)
    other = DAC("MlpPolicy", vec(), pessimism=Rule, learning_starts=10, policy_kwargs={"net_arch": [8]}, seed=0).learn(
        20
    )
    assert other.learner._counts is other and other._n_updates > 0


# ---------------------------------------------------------------- hooks


def test_after_update_is_called_after_every_step() -> None:
    model = sac(pessimism=Rule)
    for n in (1, 2):
        assert model._update(random_batch(model))["rule/n"].item() == n


def test_running_statistics_go_to_the_targets_whole() -> None:
    # Without the actor's loss, whose pass through the critics moves the statistics once more.
    model = sac(policy_kwargs={"critic_network": BatchNorm}, tau=0.1, policy_delay=2, target_update_interval=1)
    model.policy.set_training_mode(True)
    critic, target = model.critic.trunk, model.critic_target.trunk
    assert critic.training and not target.training
    before = target.dense.weight.clone()
    model._update(random_batch(model))
    assert critic.norm.running_mean.abs().sum() > 0
    assert torch.equal(critic.norm.running_mean, target.norm.running_mean)
    assert torch.equal(critic.norm.running_var, target.norm.running_var)
    torch.testing.assert_close(target.dense.weight, torch.lerp(before, critic.dense.weight, 0.1))


def test_acting_leaves_statistics_alone() -> None:
    model = sac(policy_kwargs={"actor_network": BatchNorm}, learning_starts=0)
    before = model.actor.trunk.norm.running_mean.clone()
    model.learn(1)
    assert torch.equal(before, model.actor.trunk.norm.running_mean) or model._n_updates


@pytest.mark.parametrize("compile", [False, pytest.param(True, marks=[COMPILES, pytest.mark.slow])])
def test_weights_are_projected_after_every_step(compile: bool) -> None:
    kwargs: dict[str, Any] = {"critic_network": Unit, "actor_network": Unit}
    model = sac(policy_kwargs=kwargs, learning_rate=0.1, compile=compile, resets=(25,), reset_shrink=0.5).learn(40)
    assert model.plasticity.n_done == 1
    for trunk in (model.actor.trunk, model.critic.trunk):
        torch.testing.assert_close(trunk.dense.weight.norm(dim=-1), torch.ones(trunk.dense.weight.shape[:-1]))


def test_a_transform_is_applied_to_every_batch() -> None:
    """What the critics learn from, by hand: the same step as on the transformed batch."""
    model, plain = sac(batch_transforms=[Scaled, (Scaled, {"jitter": 0.5})]), sac()
    first = model.transforms[0]
    first.scale.fill_(4.0)
    batch = random_batch(model)
    noise = torch.randn_like(batch.observations)
    drawn = {name: torch.randn(8, 2) for name in ("critic", "actor", "exploration")}
    model._update(batch, Noise(**drawn, transforms=(None, noise)))
    plain._update(
        batch._replace(rewards=batch.rewards / 4, observations=batch.observations + 0.5 * noise), Noise(**drawn)
    )
    ours, theirs = model.policy.state_dict(), plain.policy.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_a_transform_hears_of_the_environment_and_is_saved(tmp_path: Path) -> None:
    model = sac(batch_transforms=[Scaled]).learn(20)
    assert model.transforms[0].scale.item() > 1
    model.save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=vec(), trusted_modules=[__name__])
    assert loaded.transforms[0].scale == model.transforms[0].scale


def test_a_head_gives_values_to_rules_and_actors() -> None:
    model = sac(value_head=TwoHot, pessimism=0.0)
    batch = random_batch(model)
    q = values(model.learner, model.critic, batch.observations, batch.actions)
    assert q.shape == (2, 8, 1) and q.abs().max() <= 5
    torch.testing.assert_close(model._update(batch)["train/q_mean"], q.mean())


def test_what_a_head_keeps_is_saved(tmp_path: Path) -> None:
    model = sac(value_head=TwoHot)
    model.head.support.mul_(2)
    model.save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", trusted_modules=[__name__])
    assert torch.equal(loaded.learner.head.support, torch.linspace(-10, 10, 11))
    assert torch.equal(model.learner.state_dict()["head"]["support"], loaded.head.support)


def test_a_head_learns() -> None:
    """Rewards of 1 and terminations: the value is 1."""
    model = sac(value_head=TwoHot, learning_rate=1e-2)
    batch = random_batch(model)
    batch = batch._replace(rewards=torch.ones(8, 1), dones=torch.ones(8, 1))
    for _ in range(300):
        model._update(batch)
    assert model._update(batch)["train/q_mean"].item() == pytest.approx(1, abs=0.1)


# ---------------------------------------------------------------- compiling


class Silent(Rule):
    """Says nothing of its own: its base, not of the package, does."""


class Refusing(Rule):
    compilable = False


@pytest.mark.parametrize(
    ("kwargs", "foreign"),
    [
        ({}, []),
        ({"pessimism": Rule}, []),
        ({"pessimism": Silent}, []),
        ({"pessimism": Refusing}, ["pessimism=Refusing"]),
        ({"pessimism": Refusing, "exploration": Uniform}, ["exploration=Uniform", "pessimism=Refusing"]),
        ({"policy_kwargs": {"critic_network": Unit}}, []),
        ({"policy_kwargs": {"critic_network": BatchNorm}}, ["critic_network=BatchNorm"]),
        ({"policy_kwargs": {"actor_network": BatchNorm}}, ["actor_network=BatchNorm"]),
        ({"value_head": TwoHot}, []),
        # Behind a projection too.
        ({"policy_kwargs": {"critic_network": Unit, "projection": 4}}, []),
        ({"policy_kwargs": {"critic_network": BatchNorm, "projection": 4}}, ["critic_network=BatchNorm"]),
        ({"policy_kwargs": {"actor_network": BatchNorm, "projection": 4}}, ["actor_network=BatchNorm"]),
    ],
)
def test_which_parts_are_compiled_unasked(
    kwargs: dict[str, Any], foreign: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert foreign_parts(sac(**kwargs).learner) == foreign
    if not foreign:
        return
    sac(**kwargs, verbose=1).learn(12)
    assert "not compiled" not in capsys.readouterr().out  # few steps, which would not be compiled anyway
    monkeypatch.setattr("sb3_sample.training.compiling.PAYS_FROM", 1)
    sac(**kwargs, verbose=1).learn(12)
    does = "does" if len(foreign) == 1 else "do"
    line = f"The gradient step is not compiled: {', '.join(foreign)} {does} not declare compilable = True\n"
    assert line in capsys.readouterr().out
    sac(**kwargs, verbose=0).learn(12)
    assert capsys.readouterr().out == ""


@pytest.mark.slow
@COMPILES
def test_parts_that_say_so_are_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_sample.training.compiling.PAYS_FROM", 5)
    kwargs: dict[str, Any] = {"pessimism": Rule, "value_head": TwoHot, "policy_kwargs": {"critic_network": Unit}}
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*not compiled")
        model = sac(**kwargs, batch_transforms=[Scaled]).learn(40)
    assert model.compiled
    eager = sac(**kwargs, batch_transforms=[Scaled], compile=False).learn(40)
    pairs = zip(model.policy.parameters(), eager.policy.parameters(), strict=True)
    assert max((a - b).abs().max().item() for a, b in pairs) < 1e-4


def test_diagnostics_see_values_and_no_logits() -> None:
    model = sac(value_head=TwoHot)
    callback = DiagnosticsCallback(vec(), every=40, n_start_states=2, rollout_length=5)
    model.learn(60, callback=callback)
    assert np.isfinite(callback.measure()["td_error_training"])
    batch = random_batch(model)
    q = values(model.learner, model.critic, batch.observations, batch.actions)
    measured = callback._networks(batch)["critic_disagreement"]
    assert measured == pytest.approx(epistemic_std(q).mean().item(), rel=1e-5)
