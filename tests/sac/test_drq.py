"""DrQ and DrQ-v2: the shift, the encoder's choices, the targets, and resets that keep the encoder."""

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_sample import (
    BC,
    BRO,
    IQL,
    SAC,
    CompactNStepReplayBuffer,
    CompactReplayBuffer,
    DebiasedRQ,
    DrQ,
    DrQv2,
    SimBa,
    SimbaV2,
)
from sb3_sample.learner.augmentation import RandomShift, shifted
from sb3_sample.learner.batch import Batch, Noise
from sb3_sample.learner.transforms import BatchTransform
from sb3_sample.sac.encoders import ConvEncoder
from tests.sac.common import COMPILES, MAKERS, differing, sac, sampled, state
from tests.sac.pixels import TINY, TINY_DRQ, Frames, drq, drqv2, frames
from tests.sac.streams import same_bits

IMAGE = spaces.Box(0, 255, (3, 8, 8), np.uint8)
TINY_ENCODER = {"features_extractor_kwargs": TINY["features_extractor_kwargs"]}


def batch_of(n: int, seed: int = 0, gamma: float = 0.9, shape: tuple[int, ...] = (3, 8, 8)) -> Batch:
    g = torch.Generator().manual_seed(seed)
    images = torch.randint(0, 256, (2, n, *shape), generator=g, dtype=torch.uint8)
    return Batch(
        images[0],
        torch.rand(n, 2, generator=g) * 1.8 - 0.9,
        images[1],
        (torch.arange(n) % 3 == 1).float()[:, None],
        torch.randn(n, 1, generator=g),
        gamma,
    )


# ---------------------------------------------------------------- the shift


def test_the_shift_is_a_crop_of_the_padded_image() -> None:
    images = torch.randint(0, 256, (81, 2, 7, 9), dtype=torch.uint8)
    offsets = torch.cartesian_prod(torch.arange(9), torch.arange(9))
    found = shifted(images, offsets, 4)
    padded = F.pad(images.float(), (4, 4, 4, 4), mode="replicate").to(torch.uint8)
    for image, (i, j), whole in zip(found, offsets.tolist(), padded, strict=True):
        assert torch.equal(image, whole[:, i : i + 7, j : j + 9])
    assert found.dtype is torch.uint8
    assert torch.equal(shifted(images, torch.full((81, 2), 4), 4), images), "no offset leaves images as they are"
    assert torch.equal(shifted(images, torch.zeros(81, 2, dtype=torch.int64), 0), images)


def test_every_offset_is_as_likely() -> None:
    """χ² of 81 offsets, and of pairs of an image's and its next image's first: far from what chance hardly gives."""
    torch.manual_seed(0)
    transform = RandomShift(None, pad=4)  # type: ignore[arg-type]
    n = 40_500
    batch = batch_of(1)._replace(observations=torch.empty(n, 1), next_observations=torch.empty(n, 1))
    drawn = transform.draw(batch)
    assert drawn is not None and drawn.shape == (2 * n, 2)
    now, after = drawn.split(n)
    for pair in (now, after, torch.stack((now[:, 0], after[:, 0]), dim=1)):
        counts = torch.bincount(pair[:, 0] * 9 + pair[:, 1], minlength=81).double()
        assert len(counts) == 81
        chi2 = ((counts - n / 81) ** 2 / (n / 81)).sum().item()
        # 80 degrees of freedom: mean 80, standard deviation 12.6.
        assert 30 < chi2 < 145


def test_wrong_shifts() -> None:
    with pytest.raises(ValueError, match="pad"):
        drq(augmentation_kwargs={"pad": -1})
    with pytest.raises(ValueError, match="copies"):
        drq(target_copies=0)
    with pytest.raises(ValueError, match="argument target_copies"):
        drq(augmentation_kwargs={"target_copies": 3})
    with pytest.raises(ValueError, match="augmentation=None has none"):
        drq(augmentation=None, augmentation_kwargs=None)
    with pytest.raises(ValueError, match="augmentation must be one of"):
        drq(augmentation="crop")


# ---------------------------------------------------------------- the update


def test_drq_without_shifts_is_sac() -> None:
    """With one copy of each image and no shift: SAC on the same networks, batches and noise, to the last bit."""
    ours = drq(target_copies=1, online_copies=1, augmentation_kwargs={"pad": 0}, policy_delay=1, tau=0.005)
    theirs = SAC(
        "CnnPolicy",
        frames(),
        policy_kwargs={
            **TINY,
            "features_extractor_class": ConvEncoder,
            "share_features_extractor": True,
            "actor_network_kwargs": {"gain": 1.0},
            "critic_network_kwargs": {"gain": 1.0},
        },
        **{"learning_rate": 1e-3, "ent_coef": "auto_0.1", "target_entropy": -2.0, "target_update_interval": 2},
        **{key: TINY_DRQ[key] for key in ("learning_starts", "batch_size", "buffer_size", "seed")},
    )
    before = state(theirs)
    assert not differing(state(ours), before)
    for i in range(4):
        batch, g = batch_of(5, i), torch.Generator().manual_seed(i)
        noise = Noise(*(torch.randn(5, 2, generator=g) for _ in range(3)))
        zeros = torch.zeros(10, 2, dtype=torch.int64)
        ours.learner.update(batch, noise._replace(transforms=(zeros,)))
        theirs.learner.update(batch, noise)
        assert not differing(state(ours), state(theirs))
    assert len(differing(state(ours), before)) > 10


def test_several_copies_of_a_transition() -> None:
    """The target is the mean over K shifts, each with its own action, the loss the sum over M; the actor sees one."""
    k, m, n = 3, 2, 4
    model = drq(target_copies=k, online_copies=m, policy_delay=1, pessimism=1.0)
    learner, batch = model.learner, batch_of(n)
    g = torch.Generator().manual_seed(5)
    offsets = torch.randint(3, ((k + m) * n, 2), generator=g)
    noise = Noise(
        torch.randn(k * n, 2, generator=g), torch.randn(n, 2, generator=g), torch.randn(n, 2, generator=g),
        transforms=(offsets,),
    )  # fmt: skip
    online, following = offsets.split((m * n, k * n))
    with torch.no_grad():
        targets = []
        for copy in range(k):
            rows = slice(copy * n, (copy + 1) * n)
            images = shifted(batch.next_observations, following[rows], 1)
            actions, log_prob = model.actor.sample(images, noise.critic[rows])  # type: ignore[index]
            q = model.critic_target.q_values(images, actions).amin(dim=0)
            targets.append(batch.rewards + (1 - batch.dones) * 0.9 * (q - model.temperature() * log_prob))
        target = torch.stack(targets).mean(dim=0)
        shifts = [shifted(batch.observations, part, 1) for part in online.split(n)]
        q_values = [model.critic.q_values(images, batch.actions) for images in shifts]
        loss = sum(((q - target) ** 2).mean(dim=1).sum() for q in q_values)
        log_prob = model.actor.sample(shifts[0], noise.actor)[1]
    metrics = learner.update(batch, noise)
    torch.testing.assert_close(metrics["train/critic_loss"], loss)
    torch.testing.assert_close(metrics["train/q_mean"], q_values[0].mean())
    # The actor of before its own step, on the first shift, by the encoder after its step.
    assert abs(metrics["train/entropy"] + log_prob.mean()) < 0.5
    assert metrics["train/entropy"] != -log_prob.mean()


class Nothing(BatchTransform):
    def transform(self, batch: Batch, noise: Any) -> Batch:
        return batch


@pytest.mark.parametrize(("k", "m"), [(2, 1), (1, 2)])
def test_a_transform_may_return_the_batch_of_copies_itself(k: int, m: int) -> None:
    models = [drq(target_copies=k, online_copies=m, batch_transforms=each) for each in ([], [Nothing])]
    for model in models:
        torch.manual_seed(0)
        model.learner.update(batch_of(4))
    assert not differing(*map(state, models))


def test_copies_have_offsets_and_actions_of_their_own() -> None:
    model = drq(target_copies=3, online_copies=2)
    drawn: list[Any] = []
    transform = model.transforms[0]
    draw = transform.draw
    transform.draw = lambda batch: drawn.append(draw(batch)) or drawn[-1]  # type: ignore[func-returns-value]
    torch.manual_seed(0)
    model.learner.update(batch_of(4))
    assert drawn[0].shape == (4 * 5, 2) and len(drawn[0].unique(dim=0)) > 3


def test_noise_schedule() -> None:
    """DrQ-v2's linear(1.0, 0.1, 100), by hand, on the actor that acts, that learns and that makes targets."""
    model = drqv2(noise_schedule=(1.0, 0.1, 100))
    assert model.actor.noise_std == 1
    for n, std in ((1, 0.991), (10, 0.91), (50, 0.55), (99, 0.109), (100, 0.1), (250, 0.1)):
        model.num_transitions = n - 1
        model.learner.on_step(np.zeros(1), np.zeros(1, bool), [{}])
        assert model.actor.noise_std.item() == pytest.approx(std)
    model.num_transitions = 50
    model.reinitialize()
    assert model.actor.noise_std.item() == pytest.approx(0.55), "a reset does not start the noise anew"
    for wrong in ((1.0, 0.1), (1.0, 0.0, 5), (1.0, 0.1, math.inf), 3):
        with pytest.raises(ValueError, match="noise_schedule"):
            drqv2(noise_schedule=wrong)
    with pytest.raises(ValueError, match="noise_std of DrQv2"):
        sac(exploration="scheduled_noise")


def test_noise_of_another_exploration_is_the_schedules_first() -> None:
    """In exploration, TD target and actor's loss, also after a reset."""
    model = drqv2(exploration="actor", noise_schedule=(0.5, 0.1, 100))
    for _ in range(2):
        assert model.actor.noise_std == 0.5
        model.learner.on_step(np.zeros(1), np.zeros(1, bool), [{}])
        model.reinitialize()
    with pytest.raises(ValueError, match="argument noise_schedule"):
        drqv2(policy_kwargs={**TINY, "actor_kwargs": {"noise_std": 0.2}})


def test_the_update_of_drqv2() -> None:
    """Clipped noise in target and actor's loss, features of one encoder from before its step, no target encoder."""
    model = drqv2(augmentation_kwargs={"pad": 0}, noise_schedule=(0.5, 0.1, 100), tau=0.25)
    batch, g = batch_of(6, gamma=0.9**3), torch.Generator().manual_seed(1)
    noise = Noise(*(3 * torch.randn(6, 2, generator=g) for _ in range(3)), transforms=(torch.zeros(12, 2).long(),))
    actor, critic, target = model.actor, model.critic, model.critic_target
    assert model.policy.actor_target is None

    def features(images: torch.Tensor) -> torch.Tensor:
        return critic.features_extractor(images.float() / 255)  # type: ignore[operator, no-any-return]

    def action(f: torch.Tensor, normal: Any) -> torch.Tensor:
        mean = torch.tanh(actor.mean(actor.trunk(f)))
        return (mean + (0.5 * normal).clamp(-0.3, 0.3)).clamp(-1 + 1e-6, 1 - 1e-6)

    with torch.no_grad():
        f, following = features(batch.observations), features(batch.next_observations)
        torch.testing.assert_close(critic.features(batch.observations), f)
        a = action(following, noise.critic)
        assert ((a - torch.tanh(actor.mean(actor.trunk(following)))).abs() <= 0.3 + 1e-6).all()
        q = target.head(target.trunk(torch.cat((following, a), dim=1))).amin(dim=0)
        y = batch.rewards + (1 - batch.dones) * 0.9**3 * q
        loss = ((critic.q_values(batch.observations, batch.actions) - y) ** 2).mean(dim=1).sum()
        before = [p.clone() for p in target.parameters()]
        learned = action(f, noise.actor)
    encoder = [p.clone() for p in model.policy.encoders()[0].parameters()]
    metrics = model.learner.update(batch, noise)
    torch.testing.assert_close(metrics["train/critic_loss"], loss)
    with torch.no_grad():
        # The new critics' heads on the features of before, by the actor of before.
        q = critic.head(critic.trunk(torch.cat((f, learned), dim=1)))
        torch.testing.assert_close(metrics["train/actor_loss"], -q.amin(dim=0).mean())
    assert all((p != q).any() for p, q in zip(encoder, model.policy.encoders()[0].parameters(), strict=True))
    assert len(model.policy.encoders()) == 1
    # Polyak averages of what is behind the encoder.
    own = list(critic.parameters())[len(encoder) :]
    for p, old, new in zip(target.parameters(), before, own, strict=True):
        torch.testing.assert_close(p, torch.lerp(old, new, 0.25))


def test_the_gradient_of_a_clamped_action() -> None:
    """Straight through: an action on the bound has a gradient."""
    model = drqv2()
    model.actor.mean.bias.data.fill_(3.0)
    actions, _ = model.actor.sample(batch_of(4).observations, torch.full((4, 2), 5.0))
    assert (actions == actions.new_tensor(1 - 1e-6)).all()
    actions.sum().backward()
    assert model.actor.mean.bias.grad is not None and (model.actor.mean.bias.grad > 0).all()
    quiet = model.actor(batch_of(4).observations, deterministic=True)
    assert torch.equal(
        quiet, torch.tanh(model.actor.mean(model.actor.trunk(model.actor.features(batch_of(4).observations))))
    )


def _own_extractor(**choice: str) -> SAC:
    return sac(frames(), policy="CnnPolicy", batch_size=4, policy_kwargs={
        "net_arch": [8], "features_extractor_class": ConvEncoder, "share_features_extractor": True,
        "features_extractor_kwargs": TINY["features_extractor_kwargs"], **choice,
    })  # fmt: skip


@pytest.mark.parametrize(
    "make", [lambda **choice: drq(policy_kwargs={**TINY, **choice}, policy_delay=1), _own_extractor]
)
@pytest.mark.parametrize("choice", [{}, {"target_encoder": "online"}, {"actor_features": "before"}])
def test_choices_of_the_encoder(choice: dict[str, str], make: Any) -> None:
    """Each by itself, on DrQ and on SAC with an extractor of one's own: what differs after a step, what not."""
    models, changed = [make(**choice), make()], []
    for step in range(2):
        for model in models:
            torch.manual_seed(step)
            model.learner.update(batch_of(4, seed=step), Noise())
        changed.append(set(differing(*(state(model) for model in models))))
    first, second = changed
    if not choice:
        assert not first | second
    elif "target_encoder" in choice:
        # A target's own encoder lags behind from the first step on, and is used in the second.
        assert {name.rsplit(".layers", 1)[0] for name in first} == {"policy/critic_target.features_extractor"}
        assert {name for name in second if name.startswith("critic.optimizer")}
    else:
        # The critics' step has changed the encoder by the time that the actor uses it.
        assert {name for name in first if name.startswith("actor.optimizer")}
        assert not [name for name in first if "critic" in name]
    if choice:
        with pytest.raises(ValueError, match="share_features_extractor=True"):
            sac(frames(), policy="CnnPolicy", policy_kwargs={**choice, "features_extractor_class": ConvEncoder})


def test_a_rate_of_the_encoders_own() -> None:
    model = drq(policy_kwargs={**TINY, "encoder_learning_rate": 1e-5}, learning_rate=lambda left: 1e-4 + 1e-3 * left)
    encoder = {id(p) for p in model.policy.encoders()[0].parameters()}
    first, rest = model.critic.optimizer.param_groups
    assert {id(p) for p in first["params"]} == encoder and not encoder & {id(p) for p in rest["params"]}
    model.learn(12)
    assert first["lr"] == 1e-5 and rest["lr"] == pytest.approx(1e-4)


# ---------------------------------------------------------------- the encoder


def test_encoders_of_the_published_codes() -> None:
    drq_encoder = ConvEncoder(spaces.Box(0, 255, (9, 84, 84), np.uint8))
    assert drq_encoder.features_dim == 39_200
    assert sum(p.numel() for p in drq_encoder.parameters()) == 9 * 9 * 32 + 3 * 9 * 32 * 32 + 4 * 32
    jax = ConvEncoder(
        spaces.Box(0, 255, (3, 64, 64), np.uint8), filters=(32, 64, 128, 256), strides=(2, 2, 2, 2), padding="same"
    )
    assert jax.features_dim == 4096
    images = torch.rand(2, 3, 64, 64)
    padded = F.pad(images, (0, 1, 0, 1))
    first: Any = jax.layers[1]
    torch.testing.assert_close(jax.layers[:3](images), F.relu(F.conv2d(padded, first.weight, first.bias, stride=2)))
    with pytest.raises(ValueError, match="too small"):
        ConvEncoder(IMAGE, filters=(4,) * 4, strides=(2,) * 4)
    with pytest.raises(ValueError, match="strides must be as many"):
        ConvEncoder(IMAGE, filters=(4,))
    with pytest.raises(ValueError, match="padding"):
        ConvEncoder(IMAGE, padding="reflect")


def test_sizes_of_the_primacy_biass_code() -> None:
    """What its resets keep, and what they renew of critics and actor, for six actions."""
    model = DrQ(
        "CnnPolicy", None, observation_space=spaces.Box(0, 255, (3, 64, 64), np.uint8),
        action_space=spaces.Box(-1, 1, (6,), np.float32), buffer_size=10, target_copies=1, online_copies=1,
        policy_kwargs={"net_arch": [256, 256], "features_extractor_kwargs": {
            "filters": (32, 64, 128, 256), "strides": (2, 2, 2, 2), "padding": "same"}},
    )  # fmt: skip

    def size(*modules: torch.nn.Module) -> int:
        return sum(p.numel() for module in modules for p in module.parameters())

    assert size(model.policy.encoders()[0]) == 388_416
    assert size(model.critic.trunk, model.critic.head) == 366_232
    assert size(model.actor) == 286_882


@pytest.mark.parametrize("make", [drq, drqv2])
def test_defaults_of_the_published_codes(make: Any) -> None:
    cls = type(make())
    model = cls("CnnPolicy", None, observation_space=spaces.Box(0, 255, (9, 84, 84), np.uint8),
                action_space=spaces.Box(-1, 1, (6,), np.float32), buffer_size=10)  # fmt: skip
    trunk = model.critic.trunk
    assert trunk.projection[0].in_features == 39_200 and trunk.projection[0].out_features == 50
    assert [each.dense.weight.shape for each in trunk.hidden_units(model.critic.head)] == [
        (2, 56, 1024),
        (2, 1024, 1024),
    ]
    assert [tuple(each.dense.weight.shape) for each in model.actor.trunk.hidden_units(None)] == [
        (1024, 50),
        (1024, 1024),
    ]
    # Orthogonal with a gain of 1, but for the convolutions.
    rows = model.actor.trunk.network.layers[2].weight
    torch.testing.assert_close(rows @ rows.T, torch.eye(1024), atol=1e-4, rtol=0)
    assert model.policy.encoders()[0].offset == (0.5 if cls is DrQv2 else 0)
    assert model.learner.target_entropy == (-6 if cls is DrQ else -3)
    assert not any(isinstance(m, torch.nn.LayerNorm) for m in trunk.network.modules())
    normed = make(layer_norm=True)
    assert normed.critic.trunk.hidden_units(normed.critic.head)[0].norm is not None
    assert normed.actor.trunk.hidden_units(None)[0].norm is None


@pytest.mark.parametrize("make", [drq, drqv2])
@pytest.mark.parametrize(("own", "other"), [("critic", "actor"), ("actor", "critic")])
def test_another_network_of_one_leaves_the_sizes_of_the_other(make: Any, own: str, other: str) -> None:
    small = {key: value for key, value in TINY.items() if key != "net_arch"}
    chosen = {f"{own}_network": "bronet", f"{own}_network_kwargs": {"width": 8, "n_blocks": 1}}
    model = make(policy_kwargs={**small, **chosen})
    sizes = [each.dense.weight.shape[-2] for each in model.actor.trunk.hidden_units(None)]
    if other == "critic":
        sizes = [each.dense.weight.shape[-1] for each in model.critic.trunk.hidden_units(None)]
    assert sizes == [1024, 1024]


def test_any_features_extractor_can_be_the_encoder() -> None:
    kwargs = {"net_arch": [8], "features_extractor_class": NatureCNN, "features_extractor_kwargs": {"features_dim": 9}}
    model = drq(frames(size=36), policy_kwargs=kwargs).learn(12)
    assert isinstance(model.policy.encoders()[0], NatureCNN) and model.learner.n_updates > 0


# ---------------------------------------------------------------- resets


@pytest.mark.parametrize("make", [drq, drqv2])
@pytest.mark.parametrize("shrink", [0.0, 0.8])
def test_resets_that_keep_the_encoder(make: Any, shrink: float) -> None:
    """Convolutions, those of the targets and their moments stay to the last bit; nothing else does."""
    model = make(resets=100, resets_keep=("encoder",), reset_shrink=shrink).learn(20)
    before, optimizer = state(model), model.critic.optimizer
    encoders = model.policy.encoders()
    assert len(encoders) == (2 if make is drq else 1)
    n_steps = optimizer.state[next(encoders[0].parameters())]["step"].item()
    assert n_steps > 5
    moments = {p: {k: v.clone() for k, v in optimizer.state[p].items()} for p in encoders[0].parameters()}
    model.reinitialize(shrink, model.resets_keep)
    after = state(model)
    changed = differing(after, before)
    kept = [name for name in before if "features_extractor" in name and name.startswith("policy")]
    assert kept and not set(kept) & set(changed)
    weights = [name for name in before if name.startswith("policy") and "weight" in name and name not in kept]
    weights = [name for name in weights if "projection/1" not in name and "projection.1" not in name]
    assert weights and set(weights) <= set(changed)
    for p, values in moments.items():
        assert all(torch.equal(optimizer.state[p][name], value) for name, value in values.items())
    assert set(optimizer.state) == set(encoders[0].parameters())
    # And it goes on: each parameter by its own count of steps.
    model.learn(10, reset_num_timesteps=False)
    others = {int(optimizer.state[p]["step"]) for p in list(model.critic.parameters())[len(moments) :]}
    assert len(others) == 1 and others.pop() == optimizer.state[next(iter(moments))]["step"] - n_steps


def test_a_full_reset_keeps_nothing() -> None:
    model = drq(resets=10).learn(20)
    assert model.plasticity.n_done == 2
    before = state(model)
    model.reinitialize()
    assert [name for name in differing(state(model), before) if "features_extractor" in name and "weight" in name]


def test_what_resets_cannot_keep() -> None:
    with pytest.raises(ValueError, match="share_features_extractor=True"):
        sac(resets=10, resets_keep=("encoder",))
    with pytest.raises(ValueError, match="resets_keep"):
        drq(resets_keep=("encoder",))
    for wrong in ("encoder", ("actor",), 3):
        with pytest.raises(ValueError, match="resets_keep"):
            drq(resets=10, resets_keep=wrong)
    with pytest.raises(ValueError, match="resets_keep"):
        DebiasedRQ("MlpPolicy", "Pendulum-v1", resets=10, resets_keep=("encoder",))


# ---------------------------------------------------------------- other agents


def test_the_shift_for_bro() -> None:
    model = BRO(
        "CnnPolicy", frames(), augmentation="shift", augmentation_kwargs={"pad": 1}, model_size=(1, 8), n_quantiles=4,
        resets=(12,), resets_keep=("encoder",), learning_starts=6, batch_size=4, replay_ratio=1, buffer_size=50, seed=0,
        policy_kwargs={"features_extractor_class": ConvEncoder, "projection": 5,
                       "features_extractor_kwargs": TINY["features_extractor_kwargs"]},
    ).learn(16)  # fmt: skip
    assert model.policy.share_features_extractor and model.plasticity.n_done == 1
    assert model.explorer.trunk.projection[0].out_features == 5, "the optimistic actor has a projection of its own"
    assert model.replay_buffer.frame_stack == 3


def _shifting(make: Any, **kwargs: Any) -> Any:
    """An agent of :data:`MAKERS` that learns from shifted pictures by small convolutions."""
    plain = make()
    encoder = {"features_extractor_class": ConvEncoder, **TINY_ENCODER}
    if plain.normalize_observations:
        kwargs["normalize_observations"] = False
    env = DummyVecEnv([lambda: Monitor(Frames())])
    return make(
        env, policy="CnnPolicy", augmentation="shift", augmentation_kwargs={"pad": 1},
        policy_kwargs={**plain.policy_kwargs, **encoder}, **kwargs,
    )  # fmt: skip


def _convolutions(model: SAC) -> list[torch.Tensor]:
    """Those by which the actor acts."""
    own = model.actor.features_extractor
    encoder = model.policy.encoders()[0] if own is None else own
    return [p.detach().clone() for p in encoder.parameters() if p.dim() == 4]


@pytest.mark.parametrize("name", sampled([name for name in MAKERS if name != "DebiasedRQ"], ("SAC", "IQL", "TD3BC")))
def test_the_shift_for_every_agent(name: str) -> None:
    model = _shifting(MAKERS[name])
    before = _convolutions(model)
    model.learn(20)
    assert before and model._n_updates > 5
    assert all((old != new).any() for old, new in zip(before, _convolutions(model), strict=True))


@pytest.mark.parametrize("deterministic", [False, True])
def test_the_shift_for_cloning(deterministic: bool) -> None:
    """The actor learns its own convolutions: nothing else would, since critics do not."""
    model = _shifting(lambda env=None, **kwargs: sac(env, cls=BC, **kwargs), deterministic=deterministic)
    before = _convolutions(model)
    for i in range(3):
        model.learner.update(batch_of(4, i))
    assert not model.policy.share_features_extractor
    assert all((old != new).any() for old, new in zip(before, _convolutions(model), strict=True))


@pytest.mark.parametrize(
    ("cls", "name", "words"),
    [
        (IQL, "target_copies", "target_copies=2 .* value network"),
        (BC, "target_copies", "target_copies=2 .* no critics"),
        (BC, "online_copies", "online_copies=2 .* no critics"),
    ],
)
def test_copies_that_nothing_learns_from(cls: Any, name: str, words: str) -> None:
    kwargs: dict[str, Any] = {"policy_kwargs": {"features_extractor_class": ConvEncoder, **TINY_ENCODER}}
    with pytest.raises(ValueError, match=words):
        cls("CnnPolicy", frames(), augmentation="shift", augmentation_kwargs={name: 2}, buffer_size=20, **kwargs)


def test_a_learner_chooses_its_policy_by_the_observations() -> None:
    pictures, actions = spaces.Box(0, 255, (3, 40, 40), np.uint8), spaces.Box(-1, 1, (2,), np.float32)
    learners = [DrQ.learner(IMAGE, actions, policy_kwargs=TINY, device="cpu")]
    learners.append(SAC.learner(pictures, actions, augmentation="shift", device="cpu"))
    for learner, cls in zip(learners, (ConvEncoder, NatureCNN), strict=True):
        assert type(learner.critic.features_extractor) is cls


# ---------------------------------------------------------------- replay


def test_the_replay_follows_the_environment(tmp_path: Path) -> None:
    """Frames once where the environment says that it stacks them, or ``VecFrameStack`` does it, or one asks for it."""
    model = drq(frames(2))
    assert type(model.replay_buffer) is CompactReplayBuffer and model.replay_buffer.frame_stack == 3
    assert type(drqv2().replay_buffer) is CompactNStepReplayBuffer
    assert drqv2(n_steps=1).replay_buffer.frame_stack == 3
    stacked = VecFrameStack(DummyVecEnv([lambda: Frames(1)]), 3, channels_order="first")
    assert drq(stacked).replay_buffer.frame_stack == 3
    assert drq(frames(frame_stack=1)).replay_buffer.frame_stack is None
    single = frames(frame_stack=1, channels=3)
    assert drq(single, replay_buffer_kwargs={"frame_stack": 3}).replay_buffer.frame_stack == 3
    assert drqv2(replay_buffer_kwargs={"memory_map": str(tmp_path)}).replay_buffer.memory_map
    both = {"frame_stack": 3, "memory_map": str(tmp_path)}
    assert drqv2(single, replay_buffer_kwargs=both).replay_buffer.memory_map
    model.learn(20).save(tmp_path / "m")
    loaded = DrQ.load(tmp_path / "m")
    assert loaded.replay_buffer.frame_stack == 3
    model.save_replay_buffer(tmp_path / "b")
    loaded.load_replay_buffer(tmp_path / "b")
    for seed in range(2):
        samples = []
        for buffer in (model.replay_buffer, loaded.replay_buffer):
            np.random.seed(seed)
            samples.append(buffer.sample(8))
        assert all(torch.equal(a, b) for a, b in zip(*samples, strict=True) if b is not None)


@pytest.mark.parametrize("make", [drq, drqv2])
def test_trains_as_with_stable_baselines3s_buffer(make: Any) -> None:
    from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

    theirs = NStepReplayBuffer if make is drqv2 else ReplayBuffer
    kwargs = {"n_steps": 3, "gamma": 0.99} if make is drqv2 else {}
    models = [make(frames(2), buffer_size=24).learn(40)]
    models.append(make(frames(2), buffer_size=24, replay_buffer_class=theirs, replay_buffer_kwargs=kwargs).learn(40))
    assert not differing(*(state(model) for model in models))


# ---------------------------------------------------------------- files


@pytest.mark.parametrize("make", [drq, pytest.param(drqv2, marks=pytest.mark.slow)])
def test_saved_loaded_exported_and_resumed(make: Any, tmp_path: Path) -> None:
    kwargs: dict[str, Any] = {"buffer_size": 40}
    if make is drqv2:
        kwargs["noise_schedule"] = (1.0, 0.1, 30)
    straight = make(frames(2), **kwargs).learn(60, checkpoint=tmp_path / "a", checkpoint_freq=100)
    make(frames(2), **kwargs).learn(34, checkpoint=tmp_path / "b", checkpoint_freq=16)
    resumed = make(frames(2), **kwargs).learn(60, checkpoint=tmp_path / "b", checkpoint_freq=16)
    assert not differing(state(resumed), state(straight))
    assert same_bits(resumed.replay_buffer.observations[:], straight.replay_buffer.observations[:])
    straight.save(tmp_path / "m")
    loaded = type(straight).load(tmp_path / "m", env=frames(2), device="cpu")
    assert not differing(state(loaded), state(straight))
    images = batch_of(5).observations.numpy()
    expected = straight.predict(images, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(images, deterministic=True)[0], expected)
    # Skips where there is no ONNX.
    from tests.test_export import check

    check(straight, tmp_path)


# ---------------------------------------------------------------- at the door


@pytest.mark.parametrize(
    ("space", "words"),
    [
        (spaces.Dict({"image": IMAGE, "x": spaces.Box(-1, 1, (2,))}), "the image alone"),
        (spaces.Box(0, 1, (3, 8, 8), np.float32), "uint8"),
        (spaces.Box(0, 255, (8, 8, 3), np.uint8), r"channels last.*\(3, 8, 8\)"),
        (spaces.Box(0, 255, (3, 8, 8, 3), np.uint8), "along their channels"),
        (spaces.Box(0, 1, (3, 8, 8), np.uint8), "bounds 0 and 255"),
        (spaces.Box(-1, 1, (4,), np.float32), "pixels=84"),
        (spaces.Discrete(3), "one image"),
    ],
)
def test_observations_that_are_no_images(space: spaces.Space, words: str) -> None:
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    for make in (DrQ.learner, DrQv2.learner):
        with pytest.raises(ValueError, match=words):
            make(space, action_space, policy="CnnPolicy")
    with pytest.raises(ValueError, match=words):
        BRO.learner(space, action_space, policy="CnnPolicy", augmentation="shift")


@pytest.mark.parametrize("cls", [SimBa, SimbaV2])
def test_agents_that_normalize_vectors_say_what_to_pass_for_images(cls: Any) -> None:
    arguments: dict[str, Any] = {"augmentation": "shift", "device": "cpu", "buffer_size": 20}
    with pytest.raises(ValueError, match="divided by 255.*pass normalize_observations=False"):
        cls("CnnPolicy", frames(), **arguments)
    with pytest.raises(ValueError, match="not of float32.*norm_obs=False"):
        cls("CnnPolicy", VecNormalize(frames()), **arguments)


def test_images_that_come_channels_last_in_an_environment() -> None:
    """Stable-Baselines3 transposes them by itself."""

    class Last(gym.ObservationWrapper):  # type: ignore[type-arg]
        observation_space = spaces.Box(0, 255, (8, 8, 3), np.uint8)

        def observation(self, observation: np.ndarray) -> np.ndarray:
            return observation.transpose(1, 2, 0)

    model = drq(DummyVecEnv([lambda: Last(Frames())])).learn(12)
    assert model.observation_space.shape == (3, 8, 8) and model.learner.n_updates > 0


def test_wrong_arguments() -> None:
    with pytest.raises(ValueError, match="backbone='td3'"):
        drqv2(backbone="sac")
    with pytest.raises(ValueError, match="argument noise_clip"):
        drqv2(policy_kwargs={**TINY, "actor_kwargs": {"noise_clip": 0.2}})
    with pytest.raises(ValueError, match="layer_norm"):
        drq(layer_norm=True, policy_kwargs={**TINY, "critic_network": "bronet"})
    with pytest.raises(ValueError, match="MlpPolicy"):
        DrQ("MlpPolicy", frames(), learning_starts=6)


# ---------------------------------------------------------------- compiled


@COMPILES
@pytest.mark.slow
@pytest.mark.parametrize("make", [drq, drqv2])
def test_compiled(make: Any) -> None:
    models = [make(compile=compiled, policy_delay=1) for compiled in (False, True)]
    for model in models:
        torch.manual_seed(0)
        for i in range(3):
            model.learner.update(batch_of(4, i))
    assert models[1].compiled
    a, b = (state(model) for model in models)
    assert a.keys() == b.keys()
    for name in a:
        torch.testing.assert_close(a[name], b[name], rtol=1e-3, atol=1e-4, msg=name)


def test_drqv2_with_a_batch_normed_actor() -> None:
    """Its view in evaluation mode has the noise, too."""
    model = drqv2(policy_kwargs={**TINY, "actor_network": "crossq"}).learn(60)
    assert model._n_updates > 0 and model.policy.actor.at_rest.noise_clip == model.policy.actor.noise_clip
