"""What the family's parts add up to: other people's algorithms, each other, and the arguments given to ``load``."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3 as sb3
import torch
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_sample.learner.batch import Batch, Noise
from sb3_sample.sac import BROTD3, SAC
from tests.sac.common import MAKERS, bro, differing, random_batch, sac, state, taken_or_refused, vec
from tests.sac.test_spaces_and_wrappers import Reach
from tests.sac.test_update import NoSynchronisation

# ---------------------------------------------------------------- Stable-Baselines3's SAC


def copy_weights(theirs: sb3.SAC, ours: SAC, log_std: float) -> None:
    """
    Their weights into ours. Their log standard deviation is clipped to [-20, 2], ours squashed into [-10, 2]: both get
    a constant, by biases that the two ways make the same number.
    """

    def dense(source: nn.Linear, layer: Any, copy: int | None = None) -> None:
        if copy is None:
            layer.weight.copy_(source.weight)
            layer.bias.copy_(source.bias)
        else:
            layer.weight[copy].copy_(source.weight.T)
            layer.bias[copy, 0].copy_(source.bias)

    with torch.no_grad():
        for a, b in ((theirs.critic, ours.critic), (theirs.critic_target, ours.critic_target)):
            for e, network in enumerate(a.q_networks):
                sources = [layer for layer in network if isinstance(layer, nn.Linear)]
                layers = [b.trunk.layers[0], b.trunk.layers[2], b.head]
                for source, layer in zip(sources, layers, strict=True):
                    dense(source, layer, e)
        # Actions well inside the bounds: their log-probability adds 1e-6 to 1 - a^2, ours is exact.
        theirs.actor.mu.weight.mul_(0.3)
        for i in (0, 2):
            dense(theirs.actor.latent_pi[i], ours.actor.trunk.layers[i])
        dense(theirs.actor.mu, ours.actor.mean)
        for layer, bias in (
            (theirs.actor.log_std, log_std),
            (ours.actor.log_std, math.atanh((log_std + 10) / 6 - 1)),
        ):
            layer.weight.zero_()
            layer.bias.fill_(bias)


@pytest.mark.parametrize("gamma", [0.9, 0.99])
def test_losses_of_stable_baselines3(gamma: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """
    For the same weights, batch and noise: their critics' loss is half of ours (the mean of two halves of squares,
    summed over the critics), and so their target is ours; the actor's loss is the same. The learning rate is zero,
    since theirs judges the actor with critics that have already moved.
    """
    shared: dict[str, Any] = dict(learning_rate=0.0, gamma=gamma, ent_coef=0.3, seed=0, device="cpu", buffer_size=10)
    theirs = sb3.SAC("MlpPolicy", vec(), policy_kwargs={"net_arch": [8, 8]}, **shared)
    ours = sac(learning_rate=0.0, gamma=gamma, ent_coef=0.3)
    # Targets of their own.
    with torch.no_grad():
        for p in theirs.critic_target.parameters():
            p.add_(0.1 * torch.randn_like(p))
    copy_weights(theirs, ours, log_std=-1.2)
    batch = random_batch(ours, 32)
    of_actor, of_critic = torch.randn(2, 32, 2)

    samples = ReplayBufferSamples(*batch[:5])
    theirs.replay_buffer.sample = lambda *args, **kwargs: samples  # type: ignore[union-attr, method-assign, assignment]
    drawn = [of_actor, of_critic]
    monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda *args, **kwargs: drawn.pop(0))
    logger = Logger(None, [])
    theirs.set_logger(logger)
    theirs.train(1, 32)
    assert not drawn
    metrics = ours._update(batch, Noise(critic=of_critic, actor=of_actor))
    assert metrics["train/critic_loss"].item() == pytest.approx(2 * logger.name_to_value["train/critic_loss"], rel=1e-5)
    assert metrics["train/actor_loss"].item() == pytest.approx(logger.name_to_value["train/actor_loss"], rel=1e-4)
    observations = batch.observations.numpy()
    np.testing.assert_allclose(
        ours.predict(observations, deterministic=True)[0],
        theirs.predict(observations, deterministic=True)[0],
        rtol=1e-5,
        atol=1e-6,
    )


# ---------------------------------------------------------------- no targets


@pytest.mark.parametrize("maker", ["SAC", "BRO", "BROTD3", "RegularizedSAC"])
def test_tau_of_one_is_no_target(maker: str) -> None:
    model = MAKERS[maker](tau=1.0, target_update_interval=1, learning_rate=1e-2)
    for step in range(3):  # fewer than the period of RegularizedSAC's recycling, which comes after the targets
        model._update(random_batch(model, seed=step))
        for target, online in zip(model.critic_target.parameters(), model.critic.parameters(), strict=True):
            assert torch.equal(target, online)
    if model.policy.actor_target is not None:
        for target, online in zip(model.policy.actor_target.parameters(), model.actor.parameters(), strict=True):
            assert torch.equal(target, online)


def test_without_targets_their_values_are_the_critics_too() -> None:
    """Also with a spectral norm, if not to the last bit: the targets' directions follow their kernel by themselves."""
    kwargs = {"critic_network_kwargs": {"hidden_sizes": [8, 8], "spectral_norm": True}}
    model = sac(tau=1.0, policy_kwargs=kwargs, learning_rate=1e-3).learn(40)
    model.policy.set_training_mode(False)
    batch = random_batch(model)
    with torch.no_grad():
        q, of_target = (critic(batch.observations, batch.actions) for critic in (model.critic, model.critic_target))
    torch.testing.assert_close(q, of_target, rtol=1e-2, atol=1e-2)


# ---------------------------------------------------------------- REDQ and DroQ

FIVE: dict[str, Any] = {"net_arch": [8], "n_critics": 5}


def test_redq_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """The target is the minimum of the two critics drawn, for all five; the actor climbs the mean of all."""
    model = sac(target_subset=2, actor_pessimism=0.0, gamma=0.9, ent_coef=0.3, learning_rate=0.0, policy_kwargs=FIVE)
    batch, noise = random_batch(model), Noise(*torch.randn(2, 8, 2))
    monkeypatch.setattr(torch, "randperm", lambda n, **kwargs: torch.tensor([3, 1, 0, 2, 4]))
    with torch.no_grad():
        action, log_prob = model.actor.sample(batch.next_observations, noise.critic)
        q = model.critic_target(batch.next_observations, action)
        target = batch.rewards + 0.9 * (1 - batch.dones) * (torch.minimum(q[1], q[3]) - 0.3 * log_prob)
        critic_loss = (model.critic(batch.observations, batch.actions) - target).square().mean(dim=(1, 2)).sum()
        action, log_prob = model.actor.sample(batch.observations, noise.actor)
        actor_loss = (0.3 * log_prob - model.critic(batch.observations, action).mean(dim=0)).mean()
        assert not torch.allclose(torch.minimum(q[1], q[3]), q.min(dim=0).values)
    metrics = model._update(batch, noise)
    assert metrics["train/critic_loss"].item() == pytest.approx(critic_loss.item(), rel=1e-5)
    assert metrics["train/actor_loss"].item() == pytest.approx(actor_loss.item(), rel=1e-4)


def test_every_pair_is_drawn() -> None:
    model = sac(target_subset=2, actor_pessimism=0.0, policy_kwargs=FIVE, learning_rate=0.0, tau=1e-9)
    with torch.no_grad():
        # Each critic is the constant of its number.
        model.critic_target.head.weight.zero_()
        model.critic_target.head.bias.copy_(torch.arange(5.0).view(5, 1, 1))
    batch = random_batch(model)
    model._update(batch)  # The first step, before which shapes are checked with all critics.
    pairs: list[tuple[int, ...]] = []
    value = model.pessimism_rule.value
    model.pessimism_rule.value = lambda q: pairs.append(tuple(int(x) for x in q[:, 0, 0].round())) or value(q)
    for _ in range(150):
        model._update(batch)
    assert all(len(set(pair)) == 2 for pair in pairs), "twice the same critic"
    assert {frozenset(pair) for pair in pairs} == {frozenset((i, j)) for i in range(5) for j in range(i)}


@pytest.mark.parametrize("subset", [0, -1, 6])
def test_subset_out_of_range(subset: int, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="target_subset.*5") as caught:
        sac(target_subset=subset, policy_kwargs=FIVE)
    assert str(subset) in str(caught.value)
    sac(target_subset=2, policy_kwargs=FIVE).save(tmp_path / "m")
    with pytest.raises(ValueError, match="target_subset"):
        SAC.load(tmp_path / "m", env=vec(), target_subset=subset)
    with pytest.raises(ValueError, match="target_subset"):
        bro(target_subset=3)


def dropout_model(**kwargs: Any) -> SAC:
    policy_kwargs = {
        "critic_network_kwargs": {"hidden_sizes": [16], "dropout": 0.5, "layer_norm": True},
        "actor_network_kwargs": {"hidden_sizes": [16], "dropout": 0.5},
    }
    return sac(policy_kwargs=policy_kwargs, **kwargs)


def test_dropout_while_training_alone() -> None:
    """Active in critics and targets at every gradient step (DroQ), off in predictions and while collecting."""
    model = dropout_model()
    modes: dict[str, set[bool]] = {"critic": set(), "critic_target": set(), "actor": set()}
    for name, seen in modes.items():
        dropout = getattr(model, name).trunk.layers[1]
        assert isinstance(dropout, nn.Dropout)
        dropout.register_forward_hook(lambda module, *args, seen=seen: seen.add(module.training))
    acting: set[bool] = set()
    act = model.explorer.act
    model.explorer.act = lambda *args: acting.add(model.actor.training) or act(*args)  # type: ignore[func-returns-value]
    model.learn(20)
    assert modes["critic"] == modes["critic_target"] == {True}
    assert acting == {False}
    observations = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    first, second = (model.predict(observations, deterministic=True)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert not model.critic.trunk.training and not model.critic_target.trunk.training


def test_features_extractors_of_targets_are_in_evaluation_mode() -> None:
    """Always, as in Stable-Baselines3: batch norm or dropout there would make targets of each other's samples."""
    for model in (sac(), bro(cls=BROTD3)):
        model.learn(12)
        targets = [model.critic_target, *([model.policy.actor_target] if model.policy.actor_target else [])]
        for mode in (True, False):
            model.policy.set_training_mode(mode)
            assert not any(target.features_extractor.training for target in targets)


def test_copies_drop_neurons_of_their_own() -> None:
    model = dropout_model()
    with torch.no_grad():
        for p in (*model.critic.trunk.parameters(), *model.critic.head.parameters()):
            p[1].copy_(p[0])  # two equal critics
    model.policy.set_training_mode(True)
    batch = random_batch(model)
    with torch.no_grad():
        q = model.critic(batch.observations, batch.actions)
        assert not torch.allclose(q[0], q[1])
        model.policy.set_training_mode(False)
        q = model.critic(batch.observations, batch.actions)
        torch.testing.assert_close(q[0], q[1])


def test_dropout_is_off_after_learning() -> None:
    model = dropout_model().learn(14)
    batch = random_batch(model)
    with torch.no_grad():
        first, second = (model.critic(batch.observations, batch.actions) for _ in range(2))
    assert torch.equal(first, second)


# ---------------------------------------------------------------- replay


@pytest.mark.parametrize("maker", ["DAC", "GPLSAC"])
def test_n_step_returns(maker: str) -> None:
    model = MAKERS[maker](n_steps=3, gamma=0.5)
    batches: list[Batch] = []
    update = model._update
    model._update = lambda batch, *args: batches.append(batch) or update(batch, *args)
    model.learn(30)
    discounts = torch.cat([batch.discounts for batch in batches])  # type: ignore[arg-type]
    assert set(discounts.unique().tolist()) <= {0.5, 0.25, 0.125} and (discounts == 0.125).any()
    # The toy's rewards count 1, 2, ...: three steps from the start are worth 1 + 2 / 2 + 3 / 4.
    rewards, starts = (
        torch.cat(column) for column in zip(*((b.rewards, b.observations) for b in batches), strict=True)
    )
    full = (discounts == 0.125)[:, 0] & (starts[:, 0] == 0)
    assert set(rewards[full].unique().tolist()) == {2.75}
    assert all(torch.isfinite(p).all() for p in model.policy.parameters())


@pytest.mark.parametrize("maker", ["SAC", "DAC", "GPLSAC", "RegularizedSAC"])
def test_her(maker: str) -> None:
    model = MAKERS[maker](Reach(), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, learning_starts=20,
                          replay_buffer_kwargs={"n_sampled_goal": 4})  # fmt: skip
    model.learn(35)
    assert model._n_updates == 15
    assert all(torch.isfinite(p).all() for p in model.policy.parameters())


@pytest.mark.parametrize("gamma", [1, 0])
def test_integer_discount(gamma: int) -> None:
    assert sac(gamma=gamma).learn(14)._n_updates == 4


# ---------------------------------------------------------------- the whole family


@pytest.mark.parametrize("maker", MAKERS)
def test_update_makes_the_host_wait_for_nothing(maker: str) -> None:
    model = MAKERS[maker](learning_starts=20, replay_ratio=0.1).learn(20)
    batch = random_batch(model)
    model._update(batch)  # The first step, before which shapes are checked.
    for _ in range(2):
        with NoSynchronisation():
            model._update(batch)


@pytest.mark.parametrize("maker", MAKERS)
def test_nothing_is_drawn_where_the_noise_is_given(maker: str) -> None:
    models = [MAKERS[maker](redo_period=None, plasticity_regularization="resets") if maker == "RegularizedSAC"
              else MAKERS[maker]() for _ in range(2)]  # fmt: skip
    noise = Noise(*torch.randn(4, 8, 2))
    for i, model in enumerate(models):
        torch.manual_seed(i)
        before = torch.get_rng_state()
        model._update(random_batch(model), noise)
        assert torch.equal(before, torch.get_rng_state())
    # Fresh models draw their bandit's arm from the seed, as everything else.
    assert not differing(state(models[0]), state(models[1]))


# ---------------------------------------------------------------- arguments at loading


def in_force(model: Any, name: str) -> Any:
    """The value that the model works with, read where it works with it."""
    explorer, rule = model.explorer, model.pessimism_rule
    return {
        "validation_proportion": lambda: model.replay_buffer.validation_proportion,
        "pessimism_learning_rate": lambda: rule.optimizer.param_groups[0]["lr"],
        "pessimism_source": lambda: rule.source,
        "pessimism_loss": lambda: rule.loss,
        "segment_length": lambda: rule.segment_length,
        "td_lambda": lambda: rule.td_lambda,
        "arms": lambda: tuple(rule.arms),
        "bandit_learning_rate": lambda: rule.learning_rate,
        "kl_target": lambda: explorer.kl_target,
        "std_multiplier": lambda: explorer.std_multiplier,
        "adjustment_learning_rate": lambda: explorer.scalar_optimizer.param_groups[0]["lr"],
        "weight_decay": lambda: model.critic.optimizer.param_groups[0]["weight_decay"],
        "sam_radius": lambda: model.sam_radius,
        "redo_period": lambda: None if model.redo is None else model.redo.period,
        "redo_threshold": lambda: model.redo.threshold,
        "resets": lambda: model.plasticity.period,
        "reset_shrink": lambda: model.plasticity.shrink,
        "resets_to": lambda: model.plasticity.returns_to,
        "policy_delay": lambda: model.policy_delay,
        "actor_pessimism": lambda: model.actor_pessimism,
        "ent_coef": lambda: model.temperature().item(),
        "target_entropy": lambda: model._target_entropy,
    }[name]()


@pytest.mark.parametrize(
    ("maker", "name", "value"),
    [
        ("SAC", "actor_pessimism", 0.25),
        ("SAC", "policy_delay", 3),
        ("SAC", "sam_radius", 0.2),
        ("SRSAC", "reset_shrink", 0.5),
        ("BRO", "resets_to", "fresh"),
        ("SAC", "target_entropy", -3.0),
        ("SAC", "ent_coef", 0.125),
        ("BRO", "adjustment_learning_rate", 0.02),
        ("BRO", "weight_decay", 0.3),
        ("BRO", "kl_target", 0.3),
        ("BRO", "std_multiplier", 0.3),
        ("BROTD3", "policy_delay", 5),
        ("VPLSAC", "validation_proportion", 0.5),
        ("VPLSAC", "pessimism_learning_rate", 0.3),
        ("VPLSAC", "pessimism_source", "replay"),
        ("VPLSAC", "pessimism_loss", "dual"),
        ("SRSAC", "resets", 77),
        ("TOPSAC", "arms", (0.25, 0.75)),
        ("TOPSAC", "arms", (0.25, 0.5, 0.75)),
        ("TOPSAC", "bandit_learning_rate", 0.3),
        ("GPLSAC", "pessimism_learning_rate", 0.3),
        ("OPLSAC", "pessimism_learning_rate", 0.3),
        ("OPLSAC", "segment_length", 3),
        ("OPLSAC", "td_lambda", 0.3),
        ("RegularizedSAC", "sam_radius", 0.3),
        ("RegularizedSAC", "redo_period", 77),
        ("RegularizedSAC", "redo_threshold", 0.3),
        ("RegularizedSAC", "resets", 77),
        ("RegularizedSAC", "weight_decay", 0.3),
    ],
)
def test_arguments_at_loading_are_in_force(maker: str, name: str, value: Any, tmp_path: Path) -> None:
    """Or refused with an error that names them."""
    model = MAKERS[maker]().learn(14)
    assert in_force(model, name) != value
    model.save(tmp_path / "m")
    loaded = taken_or_refused(lambda: type(model).load(tmp_path / "m", env=vec(), **{name: value}), name)
    if loaded is None:
        # Another number of arms, another kind of temperature.
        assert (name, value) in [("arms", (0.25, 0.5, 0.75)), ("ent_coef", 0.125)]
        return
    assert in_force(loaded, name) == value
    loaded.learning_starts = 0
    loaded.learn(5)  # which sets the scheduled learning rates
    if name not in ("ent_coef",):
        assert in_force(loaded, name) == value


def test_arm_in_force_after_loading_other_arms(tmp_path: Path) -> None:
    model = MAKERS["TOPSAC"]()
    model.save(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m", env=vec(), arms=(0.25, 0.75))
    assert loaded.pessimism_rule.beta().item() == (0.25, 0.75)[model.pessimism_rule.arm]


@pytest.mark.parametrize("maker", ["GPLSAC", "OPLSAC", "TOPSAC"])
def test_pessimism_of_a_rule_cannot_be_changed_at_loading(maker: str, tmp_path: Path) -> None:
    model = MAKERS[maker]()
    model.save(tmp_path / "m")
    with pytest.raises(ValueError, match="pessimism.*0.5"):
        type(model).load(tmp_path / "m", env=vec(), pessimism=0.5)
    with pytest.raises(ValueError, match="pessimism.*0.5"):
        MAKERS[maker](pessimism=0.5)


def test_no_validation_at_loading(tmp_path: Path) -> None:
    """VPL cannot go on without transitions held out; with a fixed pessimism the model is another one."""
    MAKERS["VPLSAC"]().save(tmp_path / "m")
    with pytest.raises(ValueError, match="validation_proportion=0"):
        type(MAKERS["VPLSAC"]()).load(tmp_path / "m", env=vec(), validation_proportion=0.0)


def test_target_update_interval_of_none_at_loading(tmp_path: Path) -> None:
    """BROTD3 takes None for its policy_delay: it is in force, or refused."""
    model = MAKERS["BROTD3"]()
    model.save(tmp_path / "m")
    loaded = taken_or_refused(
        lambda: type(model).load(tmp_path / "m", env=vec(), target_update_interval=None), "target_update_interval"
    )
    if loaded is not None:
        loaded._update(random_batch(loaded))
