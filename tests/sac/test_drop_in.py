"""What scripts, callbacks and other libraries read of ``stable_baselines3.SAC``: losses in the logger, and names."""

import copy
import csv
import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger, configure
from torch.nn import functional

from sb3_sample import TrainingDiverged
from sb3_sample.learner.q_values import QValues
from sb3_sample.sac import SAC
from tests.sac.common import MAKERS, Toy, bro, random_batch, sac, state, vec
from tests.sac.test_execution import captured, pair
from tests.test_logged_values import Fetches

# ---------------------------------------------------------------- losses in the logger


class Reads(BaseCallback):
    """Reads a loss before every step, as callbacks that stop early do."""

    def __init__(self, name: str = "train/critic_loss"):
        super().__init__()
        self.name, self.read = name, []

    def _on_step(self) -> bool:
        self.read.append(self.logger.name_to_value[self.name])
        return True


@pytest.fixture(params=["at once", "when read"])
def fetched(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """A model on a CPU, and one that takes it for a device which the host would have to wait for."""
    if request.param == "when read":
        monkeypatch.setattr(SAC, "_metrics_wait", True)
    return request.param


@pytest.mark.parametrize("maker", MAKERS)
def test_every_metric_is_in_the_logger_after_train(maker: str, fetched: str) -> None:
    # The ends of two episodes count too where they take places in the buffer.
    model = MAKERS[maker](learning_starts=22 if maker == "DebiasedRQ" else 20).learn(20)
    assert not any(name.startswith("train/") for name in model.logger.name_to_value)
    model.learn(3, reset_num_timesteps=False, log_interval=None)
    model.train(4)
    values = model.logger.name_to_value
    assert {"train/critic_loss", "train/actor_loss", "train/q_mean"} <= model._metrics.keys() <= values.keys()
    for name, metric in model._metrics.items():
        assert type(values[name]) is float and values[name] == metric.item(), name
    rate = model.learning_rate if model.learner.schedule is None else model.learner.scheduled_rate
    assert values["train/n_updates"] == model._n_updates and values["train/learning_rate"] == rate
    model.logger.dump(0)
    assert not values


def test_a_callback_sees_the_losses(fetched: str) -> None:
    reads = Reads()
    sac(learning_starts=20, replay_ratio=1).learn(40, callback=reads)
    # Of the gradient step after the step before; the log is written, and emptied, after the step only.
    assert reads.read[:21] == [0.0] * 21 and all(value > 0 for value in reads.read[21:])
    assert all(type(value) is float for value in reads.read) and len(set(reads.read)) == 20


def test_a_callback_that_stops_below_a_loss_stops_there() -> None:
    class Stops(Reads):
        def _on_step(self) -> bool:
            super()._on_step()
            return not 0 < self.read[-1] < 60

    stops = Stops()
    model = sac(learning_starts=20, policy_kwargs={"net_arch": [32]}, learning_rate=1e-2).learn(400, callback=stops)
    assert 21 < model.num_timesteps < 400 and stops.read[-1] < 60
    assert all(value == 0 or value >= 60 for value in stops.read[:-1])


class Keeps(KVWriter):
    def __init__(self) -> None:
        self.lines: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        assert key_values.keys() == key_excluded.keys()
        self.lines.append({"step": step, **key_values})

    def close(self) -> None:
        pass


def test_logs_are_what_they_were(fetched: str, tmp_path: Path) -> None:
    """What is written is the latest gradient step's, also where there was none since the last line."""
    logger, keeps = configure(str(tmp_path), ["csv"]), Keeps()
    logger.output_formats.append(keeps)
    model = sac(learning_starts=20, replay_ratio=0.1, train_freq=None)
    model.set_logger(logger)
    model.learn(70, log_interval=1)
    logger.close()
    assert [line["step"] for line in keeps.lines] == list(range(7, 71, 7))
    losses = [line.get("train/critic_loss") for line in keeps.lines]
    # Steps are taken after 30, 40, ...: none between the lines of 35 and 42 is none, of 42 and 49 there is none.
    assert losses[:4] == [None] * 4 and losses[5] != losses[4] > 0 and None not in losses[4:]
    assert all(type(value) in (int, float) for line in keeps.lines for value in line.values())
    with (tmp_path / "progress.csv").open() as file:
        written = [row["train/critic_loss"] for row in csv.DictReader(file)]
    assert [float(value) for value in written if value] == losses[4:]


def test_what_a_callback_records_under_the_same_name_is_written() -> None:
    class Records(BaseCallback):
        def _on_step(self) -> bool:
            self.logger.record("train/critic_loss", -1.0)
            self.logger.record_mean("mine", float(self.num_timesteps))
            return True

    model, keeps = sac(learning_starts=20), Keeps()
    model.set_logger(Logger(None, [keeps]))
    model.learn(42, callback=Records(), log_interval=1)
    assert {line["train/critic_loss"] for line in keeps.lines} == {-1.0}
    assert [line["mine"] for line in keeps.lines] == [4, 11, 18, 25, 32, 39]


def test_the_update_does_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither eager nor captured gradient steps, nor what is recorded of them; whoever reads does, once."""
    monkeypatch.setattr(SAC, "_metrics_wait", True)
    for maker in ("BRO", "VPLSAC", "DAC"):
        model = pair(maker)[0]
        if maker != "VPLSAC":
            captured(model)
        model.set_logger(Logger(None, []))
        model.train(1)  # The first step, before which shapes and the pessimism are looked at.
        with Fetches() as fetches:
            for _ in range(8):
                model.train(2)
            assert fetches.n == 0
            assert model.logger.name_to_value["train/critic_loss"] == model._metrics["train/critic_loss"].numpy()
            assert fetches.n == 1
            assert dict(model.logger.name_to_value).keys() >= model._metrics.keys()
            assert fetches.n == 1


def test_values_held_by_a_callback_stay_the_loggers() -> None:
    class Holds(BaseCallback):
        def _on_training_start(self) -> None:
            self.values = self.logger.name_to_value

        def _on_step(self) -> bool:
            assert self.values is self.logger.name_to_value
            return True

    model = sac(learning_starts=20)
    for logger in (None, Logger(None, []), configure(None, [])):
        if logger is not None:
            model.set_logger(logger)
            assert model.logger is logger
        holds = Holds()
        model.learn(30, callback=holds, log_interval=None)
        assert holds.values["train/critic_loss"] > 0


def test_a_logger_that_is_none_of_stable_baselines3(fetched: str) -> None:
    """It calls ``record`` and ``dump``, and asks for nothing else."""

    class Own:
        def __init__(self) -> None:
            self.lines, self.now = [], {}

        def record(self, name: str, value: Any, exclude: Any = None) -> None:
            assert type(value) in (int, float)
            self.now[name] = value

        def dump(self, step: int) -> None:
            self.lines.append(self.now)
            self.now = {}

    model, own = sac(learning_starts=20), Own()
    model.set_logger(own)
    model.learn(42, log_interval=1)
    assert ["train/critic_loss" in line for line in own.lines] == [False] * 3 + [True] * 3


def test_a_diverged_loss_is_not_recorded(fetched: str) -> None:
    model = sac(learning_starts=20, compile=False).learn(25, log_interval=None)
    with torch.no_grad():
        model.critic.head.weight.fill_(float("nan"))
    if fetched == "at once":
        with pytest.raises(TrainingDiverged, match="train/critic_loss"):
            model.train(1)
        assert np.isfinite(model.logger.name_to_value["train/critic_loss"])
    else:
        model.train(1)
        with pytest.raises(TrainingDiverged, match="train/critic_loss"):
            model.dump_logs()


def test_train_without_a_logger_and_without_a_batch_size() -> None:
    model = sac(learning_starts=20)
    model.replay_buffer.add(np.zeros((1, 3)), np.ones((1, 3)), np.zeros((1, 2)), np.ones(1), np.zeros(1), [{}])
    seen = []
    model._update = lambda batch, own=model._update: seen.append(len(batch.actions)) or own(batch)
    model.train(gradient_steps=2)
    model.train(1, 5)
    assert seen == [model.batch_size] * 2 + [5]


# ---------------------------------------------------------------- arguments


@pytest.mark.parametrize("maker", MAKERS)
def test_arguments_of_zoo_files(maker: str, tmp_path: Path) -> None:
    kwargs = dict(use_sde=False, sde_sample_freq=8, use_sde_at_warmup=True)
    model = MAKERS[maker](**kwargs)
    assert (model.use_sde, model.sde_sample_freq, model.use_sde_at_warmup) == (False, 8, True)
    model.save(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m", sde_sample_freq=4, use_sde_at_warmup=False)
    assert (loaded.sde_sample_freq, loaded.use_sde_at_warmup) == (4, False)
    assert type(model).load(tmp_path / "m").sde_sample_freq == 8
    with pytest.raises(ValueError, match="use_sde=True is not supported"):
        type(model).load(tmp_path / "m", use_sde=True)


def test_every_argument_of_stable_baselines3_is_there() -> None:
    theirs = inspect.signature(stable_baselines3.SAC).parameters
    assert theirs.keys() <= inspect.signature(SAC).parameters.keys()


# ---------------------------------------------------------------- target entropy and temperature


def test_target_entropy_is_a_number(tmp_path: Path) -> None:
    model = sac()
    assert type(model.target_entropy) is float and model.target_entropy == -1.0
    assert sac(target_entropy="-3").target_entropy == -3.0
    assert sac(target_entropy=np.float32(-3)).target_entropy == -3.0
    model.target_entropy = -2
    model.save(tmp_path / "m")
    for kwargs, expected in (({}, -2.0), ({"target_entropy": "auto"}, -1.0), ({"target_entropy": 0.5}, 0.5)):
        assert SAC.load(tmp_path / "m", **kwargs).target_entropy == expected
    # A deterministic actor has none, and a file says so.
    model = MAKERS["BROTD3"]()
    model.save(tmp_path / "td3")
    assert type(model).load(tmp_path / "td3").target_entropy == model.target_entropy == "auto"


@pytest.mark.parametrize("how", ["eager", pytest.param("compiled", marks=pytest.mark.slow), "captured"])
def test_target_entropy_set_on_the_way_counts(how: str) -> None:
    model = sac(learning_starts=60, compile=how == "compiled", learning_rate=1e-2).learn(60)
    if how == "captured":
        captured(model)
    losses = []
    for target in (-100.0, 100, "auto"):
        model.target_entropy = target
        for _ in range(5):
            before = model.ent_coef_tensor.item()
            model.train(1)
        metrics = {name: value.item() for name, value in model._metrics.items()}
        assert type(model.target_entropy) is float
        assert metrics["train/ent_coef"] == pytest.approx(before, rel=1e-5)
        expected = before * (metrics["train/entropy"] - (-1 if target == "auto" else target))
        assert metrics["train/ent_coef_loss"] == pytest.approx(expected, rel=1e-4)
        losses.append(metrics["train/ent_coef_loss"])
    assert losses[1] < 0 < losses[0]
    for wrong in (float("nan"), "much"):
        model.target_entropy = wrong
        with pytest.raises(ValueError, match=f"target_entropy must be .*not '?{wrong}"):
            model.train(1)


def test_names_of_a_learned_temperature() -> None:
    model = sac(ent_coef="auto_0.5", learning_rate=1e-2).learn(20)
    assert model.log_ent_coef is model.temperature.log_value and model.ent_coef_optimizer is model.temperature_optimizer
    assert not model.ent_coef_tensor.requires_grad
    assert model.ent_coef_tensor.item() == torch.exp(model.log_ent_coef.detach()).item() != 0.5
    kept = model.log_ent_coef
    model.log_ent_coef = torch.full((1,), -3.0)
    assert model.log_ent_coef is kept and model.temperature().item() == pytest.approx(np.exp(-3), rel=1e-6)
    before = kept.item()
    model.train(1)
    assert 0 < abs(kept.item() - before) < 0.1
    with pytest.raises(ValueError, match="log_ent_coef must be finite"):
        model.log_ent_coef = float("nan")
    with pytest.raises(ValueError, match=r"ent_coef_tensor cannot be set to 0\.3: .*learned"):
        model.ent_coef_tensor = 0.3


@pytest.mark.parametrize("how", ["eager", pytest.param("compiled", marks=pytest.mark.slow), "captured"])
def test_names_of_a_fixed_temperature(how: str, tmp_path: Path) -> None:
    model = sac(ent_coef=0.25, learning_starts=60, compile=how == "compiled").learn(60)
    if how == "captured":
        captured(model)
    assert model.log_ent_coef is None and model.ent_coef_optimizer is None and model.ent_coef_tensor.item() == 0.25
    for value in (0.25, 0.125, torch.tensor(0.0)):
        model.ent_coef_tensor = value
        model.train(4)
        assert model._metrics["train/ent_coef"].item() == float(value)
    with pytest.raises(ValueError, match="ent_coef_tensor must be at least 0"):
        model.ent_coef_tensor = -1.0
    with pytest.raises(ValueError, match=r"log_ent_coef cannot be set to 0\.5"):
        model.log_ent_coef = 0.5
    model.save(tmp_path / "m")
    assert SAC.load(tmp_path / "m").ent_coef_tensor.item() == 0.0


def test_names_without_a_temperature() -> None:
    model = MAKERS["BROTD3"]()
    assert model.log_ent_coef is None and model.ent_coef_optimizer is None and model.ent_coef_tensor.item() == 0
    with pytest.raises(ValueError, match="deterministic"):
        model.ent_coef_tensor = 0.5


def test_stable_baselines3s_own_update_runs_on_the_model() -> None:
    """Its ``SAC.train``, which knows nothing of this package, finds all that it needs."""
    model = sac(learning_starts=20).learn(25, log_interval=None)
    before, n_updates = state(model), model._n_updates
    stable_baselines3.SAC.train(model, gradient_steps=3, batch_size=8)
    assert model._n_updates == n_updates + 3
    values = model.logger.name_to_value
    assert all(np.isfinite(values[f"train/{name}_loss"]) for name in ("critic", "actor", "ent_coef"))
    after = state(model)
    for name, value in before.items():
        if name.startswith(("policy", "temperature/")):
            assert not torch.equal(value, after[name]), name


# ---------------------------------------------------------------- actor


def test_names_of_the_actor() -> None:
    model = sac().learn(20)
    actor, observations = model.actor, random_batch(model).observations
    mean, log_std, kwargs = actor.get_action_dist_params(observations)
    assert kwargs == {} and mean.shape == log_std.shape == (8, 2)
    assert torch.equal(torch.tanh(mean), actor(observations, deterministic=True))
    torch.manual_seed(1)
    actions, log_prob = actor.action_log_prob(observations)
    torch.manual_seed(1)
    expected, expected_log_prob = actor.sample(observations)
    assert log_prob.shape == (8,)
    torch.testing.assert_close(actions, expected)
    torch.testing.assert_close(log_prob[:, None], expected_log_prob)
    # As in Stable-Baselines3's own objective, gradients go through both.
    assert torch.autograd.grad((log_prob - actions.sum(dim=1)).sum(), actor.mean.weight)[0].abs().sum() > 0
    # The distribution is that of the last call.
    torch.testing.assert_close(actor.action_dist.distribution.mean, mean)
    torch.testing.assert_close(actor.action_dist.distribution.stddev, log_std.exp())
    theirs = actor.action_dist.log_prob(actions, actor.action_dist.gaussian_actions)
    # Its 1e-6 shows near the bounds.
    inside = actions.abs().amax(dim=1) < 0.99
    assert inside.sum() > 3
    torch.testing.assert_close(theirs[inside], log_prob[inside], rtol=1e-3, atol=1e-3)
    assert torch.equal(actor.action_dist.proba_distribution(mean, log_std).mode(), torch.tanh(mean))
    # What it holds has a gradient, which no copy could take along.
    assert torch.equal(copy.deepcopy(model).actor(observations, deterministic=True), torch.tanh(mean))


def test_a_deterministic_actor_has_no_distribution() -> None:
    actor = MAKERS["BROTD3"]().actor
    assert not hasattr(actor, "action_dist")
    for method in (actor.get_action_dist_params, actor.action_log_prob):
        with pytest.raises(AttributeError, match="backbone='td3'.* has no distribution"):
            method(torch.zeros(4, 3))


@pytest.mark.parametrize("maker", ["SAC", "BRO", "BROTD3", "RegularizedSAC"])
def test_actor_and_critic_are_saved_and_loaded_alone(maker: str, tmp_path: Path) -> None:
    model = MAKERS[maker]().learn(15)
    batch = random_batch(model)
    model.actor.action_log_prob(batch.observations) if model.actor.has_entropy else None
    model.actor.save(tmp_path / "actor")
    model.critic.save(tmp_path / "critic")
    actor = type(model.actor).load(tmp_path / "actor", device="cpu")
    critic = type(model.critic).load(tmp_path / "critic", device="cpu")
    for module in (actor, critic):
        module.set_training_mode(False)
    assert type(actor) is type(model.actor)
    assert torch.equal(*(a(batch.observations, deterministic=True) for a in (actor, model.actor)))
    assert torch.equal(*(c.q_values(batch.observations, batch.actions) for c in (critic, model.critic)))
    if maker == "BROTD3":
        torch.manual_seed(0)
        expected = model.actor.smoothed(batch.observations)[0]
        torch.manual_seed(0)
        assert torch.equal(actor.smoothed(batch.observations)[0], expected)
    observation = np.zeros(3, np.float32)
    np.testing.assert_array_equal(*(a.predict(observation, deterministic=True)[0] for a in (actor, model.policy)))


def test_what_reads_through_the_policys_statistics_is_not_saved_alone(tmp_path: Path) -> None:
    model = MAKERS["SimBa"]()
    for module in (model.actor, model.critic):
        with pytest.raises(ValueError, match="would be without the statistics"):
            module.save(tmp_path / "alone")
    model.policy.save(tmp_path / "policy")
    loaded = type(model.policy).load(tmp_path / "policy", device="cpu")
    assert loaded.observation_norm is not None


# ---------------------------------------------------------------- critics


def test_critics_as_stable_baselines3_has_them() -> None:
    """Its own two losses, term by term."""
    model = sac(policy_kwargs={"net_arch": [8, 8], "n_critics": 3}).learn(15)
    batch = random_batch(model)
    tensor = model.critic.q_values(batch.observations, batch.actions)
    q = model.critic(batch.observations, batch.actions)
    assert isinstance(q, tuple) and len(q) == 3 and all(type(one) is torch.Tensor and one.shape == (8, 1) for one in q)
    assert torch.equal(torch.cat(q, dim=1), tensor[..., 0].T)
    assert torch.equal(torch.cat(q[:2], dim=1), tensor[:2, :, 0].T)
    first, *_, last = q
    assert torch.equal(first, tensor[0]) and torch.equal(q[-1], last)
    target = torch.zeros(8, 1)
    loss = 0.5 * sum(functional.mse_loss(one, target) for one in q)
    torch.testing.assert_close(loss, 0.5 * tensor.square().mean(dim=1).sum())
    ours = torch.autograd.grad(loss, model.critic.head.weight)[0]
    theirs = torch.autograd.grad(0.5 * tensor.square().mean(dim=1).sum(), model.critic.head.weight)[0]
    torch.testing.assert_close(ours, theirs)
    smallest, _ = torch.min(torch.cat(model.critic_target(batch.observations, batch.actions), dim=1), dim=1)
    expected = model.critic_target.q_values(batch.observations, batch.actions).amin(dim=(0, 2))
    assert torch.equal(smallest, expected)


def test_critics_as_one_tensor() -> None:
    model = bro().learn(15)
    batch = random_batch(model)
    with torch.no_grad():
        q = model.critic(batch.observations, batch.actions)
        tensor = model.critic.q_values(batch.observations, batch.actions)
    assert q.shape == tensor.shape == (2, 8, 5) and torch.cat(q, dim=1).shape == (8, 10)
    other = torch.full((8, 1), 2.0)
    for ours, expected in (
        (q - other, tensor - other),
        (other - q, other - tensor),
        (2 * q + q, 3 * tensor),
        (-q / 2, -tensor / 2),
        (q.mean(dim=(0, 2)), tensor.mean(dim=(0, 2))),
        (torch.mean(q, dim=0), tensor.mean(dim=0)),
        (torch.stack([q, q]), torch.stack([tensor, tensor])),
        (functional.mse_loss(input=q, target=tensor), torch.tensor(0.0)),
        (q[..., 0], tensor[..., 0]),
        (q[torch.tensor([1, 0])], tensor.flip(0)),
        (q == tensor, torch.ones(2, 8, 5, dtype=torch.bool)),
        (q > 1e9, torch.zeros(2, 8, 5, dtype=torch.bool)),
        (q.tensor, tensor),
    ):
        assert type(ours) is torch.Tensor
        torch.testing.assert_close(ours, expected)
    np.testing.assert_array_equal(np.asarray(q), tensor.numpy())
    for again in (copy.copy(q), copy.deepcopy(q)):
        assert type(again) is QValues and torch.equal(again, tensor) and len(again) == 2
    assert "QValues" in repr(q)
    with pytest.raises(AttributeError, match="no attribute 'colour'"):
        _ = q.colour


@pytest.mark.parametrize("name", ["SAC", "BRO", "BRC", "DebiasedRQ"])
def test_values_of_critics_whatever_their_outputs(name: str, tmp_path: Path) -> None:
    model = MAKERS[name]()
    batch = random_batch(model)
    given = batch.observations, batch.actions
    outputs = model.critic.q_values(*given)
    expected = (
        (outputs.softmax(dim=2) * torch.linspace(-10, 10, 21)).sum(dim=2) if name == "BRC" else outputs.mean(dim=2)
    )
    torch.testing.assert_close(model.head.values(model.critic(*given)).mean(dim=2).T, expected.T)
    torch.testing.assert_close(model.critic.q1_forward(*given), expected[0][:, None])
    torch.testing.assert_close(model.critic_target.q1_forward(*given), expected[0][:, None])
    model.policy.save(tmp_path / "p")
    alone = type(model.policy).load(tmp_path / "p").critic
    if outputs.shape[2] == 1:
        assert torch.equal(alone.q1_forward(*given), model.critic.q1_forward(*given))
    else:
        with pytest.raises(ValueError, match=f"says what {outputs.shape[2]} outputs a critic mean"):
            alone.q1_forward(*given)


@pytest.mark.parametrize("make", [sac, bro])
def test_critics_one_by_one(make: Any) -> None:
    model = make().learn(15)
    batch = random_batch(model)
    critic = model.critic
    tensor = critic.q_values(batch.observations, batch.actions)
    torch.testing.assert_close(critic.q1_forward(batch.observations, batch.actions), tensor[0].mean(dim=1)[:, None])
    features = critic.extract_features(batch.observations, critic.features_extractor)
    inputs = torch.cat([features, batch.actions], dim=1)
    assert len(critic.q_networks) == critic.n_critics == 2
    for network, expected in zip(critic.q_networks, tensor, strict=True):
        torch.testing.assert_close(network(inputs), expected)


@pytest.mark.slow
@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_own_parts_may_ask_critics_as_before(maker: str) -> None:
    """A part that calls ``agent.critic(...)`` as a tensor, run in each of the three ways."""
    states = []
    for how in ("eager", "compiled", "captured"):
        torch._dynamo.reset()
        model = MAKERS[maker](learning_starts=60, compile=how == "compiled").learn(60)
        rule = model.pessimism_rule

        def update(agent: Any, batch: Any, step: Any, noise: Any = None, extra: Any = None) -> dict[str, torch.Tensor]:
            with torch.no_grad():
                q = agent.critic(batch.observations, batch.actions)
            return {"mine": (q - q.mean(dim=0)).square().sum() + q[0].mean() + torch.amax(q)}

        rule.update = update
        if how == "captured":
            captured(model)
        np.random.seed(0)
        torch.manual_seed(0)
        for _ in range(6):
            model.train(1)
        if how == "compiled":
            assert model.learner._execution.compiled
        states.append({name: value.item() for name, value in model._metrics.items()})
    for other in states[1:]:
        assert other == pytest.approx(states[0], rel=1e-2, abs=1e-3)


def test_names_do_not_change_what_is_saved() -> None:
    """They are properties: neither attributes of the file nor parameters."""
    model = sac()
    own = vars(model)
    assert not {"log_ent_coef", "ent_coef_tensor", "ent_coef_optimizer", "logger"} & own.keys()
    assert not any("action_dist" in name for name in state(model))
    assert isinstance(Toy().action_space.sample(), np.ndarray) and vec().num_envs == 1
