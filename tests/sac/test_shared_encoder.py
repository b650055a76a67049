"""``share_features_extractor=True``: one encoder, trained by the critics alone, whose features the actors read."""

import copy
import pickle
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sample import SAC
from sb3_sample.learner.batch import Encoded, Noise
from sb3_sample.networks.modes import evaluated
from sb3_sample.optim import AdamW
from tests.sac.common import COMPILES, MAKERS, REPRESENTATIVE, bro, differing, random_batch, sac, sampled, state, vec
from tests.sac.test_execution import TOLERANCE, captured, largest_difference, updates

IMAGE = spaces.Box(0, 255, (3, 36, 36), np.uint8)


class Encoder(BaseFeaturesExtractor):
    """A layer with batch norm."""

    def __init__(self, observation_space: spaces.Space, features_dim: int = 6):
        super().__init__(observation_space, features_dim)
        assert observation_space.shape is not None
        # Without the bias, which batch norm takes out again: its gradient is rounding.
        self.dense = nn.Linear(observation_space.shape[0], features_dim, bias=False)
        self.norm = nn.BatchNorm1d(features_dim)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.norm(self.dense(observations)))


class WithoutNorm(Encoder):
    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.dense(observations))


class Dense(BaseFeaturesExtractor):
    """A layer alone."""

    def __init__(self, observation_space: spaces.Space):
        super().__init__(observation_space, 6)
        assert observation_space.shape is not None
        self.dense = nn.Linear(observation_space.shape[0], 6)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.dense(observations))


def shared(maker: str = "SAC", extractor: Any = Encoder, **kwargs: Any) -> Any:
    """A tiny model with one encoder."""
    make = MAKERS[maker]
    given = {**make().policy_kwargs, "share_features_extractor": True}
    if extractor is not None:
        given["features_extractor_class"] = extractor
    return make(policy_kwargs={**given, **kwargs.pop("policy_kwargs", {})}, **kwargs)


def encoder_of(model: SAC) -> nn.Module:
    assert model.critic.features_extractor is not None
    return model.critic.features_extractor


def actors(model: SAC) -> list[Any]:
    return [
        a for a in (model.actor, model.policy.actor_target, getattr(model.explorer, "actor", None)) if a is not None
    ]


# ---------------------------------------------------------------- who owns it


@pytest.mark.parametrize("maker", ["SAC", "BRO", "BROTD3", "DAC"])
def test_it_is_the_critics(maker: str) -> None:
    model = shared(maker)
    own = {id(p) for p in encoder_of(model).parameters()}
    assert len(own) == 3

    def optimized(optimizer: Any) -> set[int]:
        return {id(p) for group in optimizer.param_groups for p in group["params"]}

    for name, optimizer in model.learner.optimizers().items():
        assert own <= optimized(optimizer) if name == "critic.optimizer" else own.isdisjoint(optimized(optimizer))
    for actor in actors(model):
        assert not any("extractor" in name for name, _ in actor.named_modules())
        assert own.isdisjoint({id(p) for p in actor.parameters()})
        assert not any("extractor" in name for name in actor.state_dict())
    # As in Stable-Baselines3, that of the target actor is that of the target critics.
    assert model.actor.features_extractor is model.critic.features_extractor
    if model.policy.actor_target is not None:
        assert model.policy.actor_target.features_extractor is model.critic_target.features_extractor
    in_file = [name for name in model.policy.state_dict() if "dense.weight" in name and "features" in name]
    assert in_file == ["critic.features_extractor.dense.weight", "critic_target.features_extractor.dense.weight"]


def test_refused_where_it_is_no_boolean() -> None:
    with pytest.raises(ValueError, match="share_features_extractor must be True or False, not 'yes'"):
        shared(policy_kwargs={"share_features_extractor": "yes"})


# ---------------------------------------------------------------- a gradient step


@pytest.mark.parametrize("maker", ["SAC", "BRO", "BROTD3", "DAC"])
def test_only_the_critics_loss_moves_it(maker: str) -> None:
    """With critics that stand still, it does; and moved by them it changes what the actors do, whose weights do not."""
    model = shared(maker, seed=1)
    batch = random_batch(model, 16)
    before = [p.detach().clone() for p in encoder_of(model).parameters()]
    (group,) = model.critic.optimizer.param_groups
    rate, group["lr"] = group["lr"], 0.0
    weights = [p.detach().clone() for p in model.actor.parameters()]
    for _ in range(3):
        model.learner.update(batch)
    assert all(map(torch.equal, before, encoder_of(model).parameters()))
    assert not all(map(torch.equal, weights, model.actor.parameters()))
    # Now the critics alone.
    for name, optimizer in model.learner.optimizers().items():
        for each in optimizer.param_groups:
            each["lr"] = 10 * rate if name == "critic.optimizer" else 0.0
    actions = [actor(batch.observations, deterministic=True) for actor in actors(model)]
    weights = [p.detach().clone() for p in model.actor.parameters()]
    model.tau = model.learner.tau = 0.5
    for _ in range(3):
        model.learner.update(batch)
    assert all(map(torch.equal, weights, model.actor.parameters()))
    assert not any(map(torch.equal, before, encoder_of(model).parameters()))
    for actor, then in zip(actors(model), actions, strict=True):
        assert not torch.allclose(actor(batch.observations, deterministic=True), then, rtol=1e-4)


def test_a_step_by_hand() -> None:
    """The whole step in plain torch: the features that the actor learns on are those after the critics' step."""
    model = shared(seed=3, ent_coef=0.2, policy_kwargs={"net_arch": [8]}, learning_rate=1e-2, tau=0.1)
    learner, batch = model.learner, random_batch(model, 16)
    noise = Noise(torch.randn(16, 2), torch.randn(16, 2), torch.randn(16, 2))
    own, ours = copy.deepcopy(model.policy), model.policy
    own.set_training_mode(True)
    norm = own.critic.features_extractor.norm

    def encode(extractor: Any, observations: torch.Tensor) -> torch.Tensor:
        """In evaluation mode, by the formula."""
        at = extractor.norm
        h = extractor.dense(observations)
        scaled = (h - at.running_mean) / (at.running_var + at.eps).sqrt() * at.weight + at.bias
        return torch.tanh(scaled)

    def act(features: torch.Tensor, e: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean, log_std = own.actor.gaussian(features)
        x = mean + log_std.exp() * e
        log_prob = torch.distributions.Normal(mean, log_std.exp()).log_prob(x) - torch.log(1 - torch.tanh(x) ** 2)
        return torch.tanh(x), log_prob.sum(1, keepdim=True)

    def q(critic: Any, features: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return critic.head(critic.trunk(torch.cat((features, actions), 1)))

    with torch.no_grad():
        actions, log_prob = act(encode(own.critic.features_extractor, batch.next_observations), noise.critic)
        following = q(own.critic_target, encode(own.critic_target.features_extractor, batch.next_observations), actions)
        value = following.amin(0) - 0.2 * log_prob
        target = batch.rewards + (1 - batch.dones) * model.gamma * value
    h = own.critic.features_extractor.dense(batch.observations)
    mean, var = h.mean(0), h.var(0, unbiased=False)
    features = torch.tanh((h - mean) / (var + norm.eps).sqrt() * norm.weight + norm.bias)
    loss = (q(own.critic, features, batch.actions) - target).square().mean(1).sum()
    parameters = list(own.critic.parameters())
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient
    AdamW(parameters, lr=1e-2).step()
    with torch.no_grad():
        norm.running_mean.lerp_(mean, norm.momentum)
        norm.running_var.lerp_(h.var(0), norm.momentum)
    features = encode(own.critic.features_extractor, batch.observations).detach()
    actions, log_prob = act(features, noise.actor)
    loss = (0.2 * log_prob - q(own.critic, features, actions).amin(0)).mean()
    parameters = list(own.actor.parameters())
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient
    AdamW(parameters, lr=1e-2).step()

    learner.update(batch, noise)
    for (name, mine), theirs in zip(ours.named_parameters(), own.parameters(), strict=True):
        if not name.startswith("critic_target"):
            torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-5, msg=name)
    # Once a step, of the current rows only.
    extractor: Any = encoder_of(model)
    torch.testing.assert_close(extractor.norm.running_mean, norm.running_mean)
    torch.testing.assert_close(extractor.norm.running_var, norm.running_var)
    assert extractor.norm.num_batches_tracked == 1


def test_the_targets_follow() -> None:
    model = shared(tau=0.25, learning_rate=1e-2)
    target: Any = model.critic_target.features_extractor
    before = target.dense.weight.clone()
    model.learner.update(random_batch(model))
    extractor: Any = encoder_of(model)
    torch.testing.assert_close(target.dense.weight, torch.lerp(before, extractor.dense.weight, 0.25))
    assert torch.equal(target.norm.running_mean, extractor.norm.running_mean)


@COMPILES
@pytest.mark.slow
@pytest.mark.parametrize("maker", ["DAC", "SAC", "BRO", "BROTD3"])
def test_compiled_as_eager(maker: str) -> None:
    models = [shared(maker, compile=compile, learning_rate=1e-3) for compile in (False, True)]
    noise = torch.Generator().manual_seed(0)
    for model in models:
        noise.manual_seed(0)
        for i in range(5):
            drawn = Noise(*(torch.randn(16, 2, generator=noise) for _ in range(3)))
            model.learner.update(random_batch(model, 16, seed=i), drawn)
    assert models[1].compiled and models[1].learner.seconds_compiling > 0
    for (name, a), b in zip(models[0].policy.state_dict().items(), models[1].policy.state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5, msg=name)


@pytest.mark.parametrize("maker", ["SAC", "BRO", "DAC", "BROTD3"])
def test_captured_as_eager(maker: str) -> None:
    model, other = (shared(maker, WithoutNorm).learn(20) for _ in range(2))
    recorder = captured(other)
    for each in (model, other):
        updates(each, 20)
    assert recorder.n_repetitions > 10 and largest_difference(model, other) < TOLERANCE


# ---------------------------------------------------------------- it stays one


def check_one(model: SAC) -> None:
    """The actors act by the critics' encoder as it is now."""
    extractor: Any = encoder_of(model)
    observations = torch.randn(5, 3)
    for actor in (model.actor, getattr(model.explorer, "actor", model.actor)):
        assert actor.features_extractor is extractor
        extractor.eval()
        torch.testing.assert_close(actor.features(observations), extractor(observations))
        with torch.no_grad():
            extractor.dense.weight.add_(0.1)
        torch.testing.assert_close(actor.features(observations), extractor(observations))
        assert not actor.features(observations).requires_grad


@pytest.mark.parametrize("maker", [name for name in REPRESENTATIVE if name != "DebiasedRQ"])
def test_saved_loaded_and_going_on(maker: str, tmp_path: Path) -> None:
    model = shared(maker).learn(40)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = type(model).load(tmp_path / "m", env=vec(), trusted_modules=[__name__])
    assert not differing(state(model), state(loaded))
    observations = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    actions = [m.predict(observations, deterministic=True)[0] for m in (model, loaded)]
    assert np.array_equal(*actions)
    check_one(loaded)
    other = shared(maker, seed=5)
    other.set_parameters(model.get_parameters())
    assert np.array_equal(other.predict(observations, deterministic=True)[0], actions[0])
    check_one(other)


@pytest.mark.parametrize("maker", sampled(("SAC", "DAC", "BROTD3"), ("DAC",)))
def test_resumed_bit_by_bit(maker: str, tmp_path: Path) -> None:
    straight = shared(maker).learn(60, checkpoint=tmp_path / "a", checkpoint_freq=100)
    shared(maker).learn(33, checkpoint=tmp_path / "b", checkpoint_freq=100)
    resumed = shared(maker).learn(60, checkpoint=tmp_path / "b", checkpoint_freq=100)
    assert resumed._n_updates == straight._n_updates
    assert not differing(state(straight), state(resumed))
    check_one(resumed)


@pytest.mark.parametrize("maker", ["SAC", "DAC", "BROTD3"])
def test_copied_and_pickled(maker: str) -> None:
    model = shared(maker).learn(20)
    for policy in (copy.deepcopy(model.policy), pickle.loads(pickle.dumps(model.policy))):
        assert policy.actor.features_extractor is policy.critic.features_extractor is not encoder_of(model)
        with torch.no_grad():
            policy.critic.features_extractor.norm.bias.add_(3.0)
        observations = torch.randn(4, 3)
        expected = evaluated(policy.critic.features_extractor)(observations)
        assert torch.equal(policy.actor.features(observations), expected)
        assert not torch.equal(model.actor.features(observations), expected)
        if policy.actor_target is not None:
            assert policy.actor_target.features_extractor is policy.critic_target.features_extractor


def test_moved() -> None:
    """To another type, as to another device: in place for parameters, by new tensors for buffers."""
    model = shared().learn(15)
    observations = torch.randn(4, 3)
    expected = model.actor.features(observations)
    model.policy.double()
    features = model.actor.features_extractor.norm, model.actor._encoder.norm
    assert all(norm.running_mean.dtype == norm.weight.dtype == torch.float64 for norm in features)
    torch.testing.assert_close(model.actor._encoder(observations.double()).float(), expected)


@pytest.mark.parametrize("shrink", [0.0, 0.5])
@pytest.mark.parametrize("maker", ["SAC", "DAC", "BROTD3"])
def test_starts_anew(maker: str, shrink: float) -> None:
    model = shared(maker).learn(30)
    extractor: Any = encoder_of(model)
    before = extractor.dense.weight.detach().clone()
    model.reinitialize(shrink)
    assert encoder_of(model) is extractor and not torch.equal(extractor.dense.weight, before)
    assert torch.equal(extractor.dense.weight, model.critic_target.features_extractor.dense.weight) or shrink > 0
    check_one(model)
    model.learn(20)


def test_an_explorer_that_starts_anew_leaves_it() -> None:
    model = shared("DAC", reinitialize_every=None).learn(20)
    before = [p.detach().clone() for p in encoder_of(model).parameters()]
    trunk = next(model.explorer.actor.parameters()).detach().clone()
    model.learner.restart(model.explorer, model.learner.make_explorer())
    assert all(map(torch.equal, before, encoder_of(model).parameters()))
    assert not torch.equal(trunk, next(model.explorer.actor.parameters()))
    check_one(model)


def test_with_redo_sam_and_resets() -> None:
    model = shared("RegularizedSAC", resets=25).learn(60)
    assert model.plasticity.n_done == 2 and model._n_updates > 30
    check_one(model)


@pytest.mark.parametrize("features", ["after", "before"])
def test_sam_encodes_uphill(features: str) -> None:
    """Whoever encodes the observations once, the critics' second gradient is that of the encoder uphill."""
    found = []
    for radius in (0.05, None):
        model = shared("SAC", Dense, policy_kwargs={"actor_features": features}, sam_radius=radius)
        torch.manual_seed(0)
        model._update(random_batch(model))
        found.append([p.detach().clone() for p in model.critic.parameters()])
    reference = shared("SAC", Dense, sam_radius=0.05)
    torch.manual_seed(0)
    reference._update(random_batch(reference))
    assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(found[0], reference.critic.parameters(), strict=True))
    assert not all(map(torch.equal, *found))


def test_modes() -> None:
    model = shared()
    view = model.actor._encoder
    for mode in (True, False):
        model.policy.set_training_mode(mode)
        assert encoder_of(model).training == mode and not any(m.training for m in view.modules())
        assert not any(m.training for m in model.critic_target.features_extractor.modules())


@pytest.mark.slow
def test_exported(tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    model = shared("DAC").learn(30)
    onnx_path, script_path = model.export(tmp_path / "policy")
    observations = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    expected = model.predict(observations, deterministic=True)[0]
    session = onnxruntime.InferenceSession(str(onnx_path))
    assert np.allclose(session.run(None, {"observation": observations})[0], expected, rtol=1e-4, atol=1e-5)
    assert np.allclose(torch.jit.load(str(script_path))(torch.as_tensor(observations)), expected, rtol=1e-4, atol=1e-5)


def test_without_it_observations_stay_what_they_are() -> None:
    model, other = sac(), bro()
    observations = torch.randn(4, 3)
    assert model.learner.encoded(observations) is observations is other.learner.encoded(observations)
    assert isinstance(shared().learner.encoded(observations), Encoded)


# ---------------------------------------------------------------- it learns


@pytest.mark.parametrize("maker", ["SAC", "BRO", "BROTD3"])
def test_images(maker: str) -> None:
    model = shared(
        maker, None, env=vec(obs_space=IMAGE), policy="CnnPolicy", buffer_size=60, learning_rate=1e-3,
        policy_kwargs={"features_extractor_kwargs": {"features_dim": 8}},
    )  # fmt: skip
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(25)
    for name, value in model.policy.state_dict().items():
        assert not torch.equal(value, before[name]), f"{name} does not learn"


class Match(gym.Env):
    """One step: the reward is minus the squared distance of the action to a number that is shown in brightness."""

    observation_space = spaces.Box(0, 255, (1, 36, 36), np.uint8)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.wanted = float(self.np_random.uniform(-0.9, 0.9))
        return self._shown(), {}

    def _shown(self) -> np.ndarray:
        return np.full((1, 36, 36), 127.5 + 127 * self.wanted).astype(np.uint8)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return self._shown(), -float((action[0] - self.wanted) ** 2), True, False, {}


@pytest.mark.slow
def test_learns_from_images() -> None:
    """A mean squared distance that no constant action reaches: the actor sees through the critics' encoder."""
    kwargs = dict(features_extractor_kwargs=dict(features_dim=16), net_arch=[32], share_features_extractor=True)
    model = SAC(
        "CnnPolicy", Match(), learning_starts=100, buffer_size=2_000, batch_size=32, learning_rate=1e-3, ent_coef=0.01,
        replay_ratio=1, policy_kwargs=kwargs, seed=0, device="cpu",
    )  # fmt: skip
    model.learn(700)
    env = Match()
    wanted = np.linspace(-0.9, 0.9, 13)
    shown = np.stack([(env.__dict__.update(wanted=w), env._shown())[1] for w in wanted])
    actions = model.predict(shown, deterministic=True)[0][:, 0]
    # A constant action has at least the variance, 0.31.
    assert np.square(actions - wanted).mean() < 0.1


def test_a_learning_rate_of_an_encoder_without_parameters() -> None:
    with pytest.raises(ValueError, match="encoder_learning_rate=0.0001 is of an encoder with parameters, and Flatten"):
        sac(policy_kwargs={"net_arch": [8], "share_features_extractor": True, "encoder_learning_rate": 1e-4})
