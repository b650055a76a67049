"""DR.Q: what moves when, its arguments, spaces, the learner alone; tests/sac/test_golden_dr_q.py has its numbers."""

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_sample import DebiasedRQ, WindowDictReplayBuffer, WindowReplayBuffer
from sb3_sample.learner.batch import Noise, Windows
from sb3_sample.learner.embedding_losses import infonce, symexp_atoms, two_hot
from sb3_sample.sac.embeddings import DebiasedRQPolicy
from tests.sac.common import MAKERS, TINY_DR_Q, differing, random_batch, state, vec


def dr_q(env: Any = None, **kwargs: Any) -> DebiasedRQ:
    return MAKERS["DebiasedRQ"](env, **kwargs)  # type: ignore[no-any-return]


def copies(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in module.state_dict().items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


# ---------------------------------------------------------------- what moves when


def test_the_defaults_are_the_published_ones() -> None:
    model = DebiasedRQ("MlpPolicy", gym.make("Pendulum-v1"), buffer_size=1_000, device="cpu")
    policy: Any = model.policy
    sizes = {
        name: sum(p.numel() for p in module.parameters())
        for name, module in (("encoder", policy.encoder), ("critic", policy.critic), ("actor", policy.actor))
    }
    o, a = 3, 1
    state_net = 750 * o + 750 + 750 * 750 + 750 + 512 * 750 + 512
    pair_net = 750 * 768 + 750 + 750 * 750 + 750 + 512 * 750 + 512
    assert sizes == {
        "encoder": state_net + 256 * a + 256 + pair_net + 578 * 513,
        "critic": 2 * (3 * 512 * 513 + 513),
        "actor": 2 * 512 * 513 + a * 513,
    }
    assert (model.batch_size, model.gamma, model.learning_starts, model.replay_ratio) == (256, 0.99, 10_000, 1)
    buffer: Any = model.replay_buffer
    weights = buffer.weights
    assert (weights.fade, weights.fade_floor, weights.priority_exponent, weights.smallest_error) == (
        0.9999,
        0.1,
        0.4,
        1,
    )
    assert (buffer.horizon, model.n_steps, model.encoder_horizon, model.target_update_interval) == (5, 3, 5, 250)
    # Xavier's uniform distribution with gain √2, no biases; targets are copies.
    weight = policy.encoder.state.layers[1].weight
    assert weight.abs().max() <= np.sqrt(2) * np.sqrt(6 / 1500) < 1.05 * weight.abs().max()
    assert all((p == 0).all() for name, p in policy.named_parameters() if name.endswith("bias"))
    for name in ("encoder", "critic", "actor"):
        assert same(copies(getattr(policy, name)), copies(getattr(policy, f"{name}_target")))


def test_encoder_and_targets_stand_still_between_blocks() -> None:
    model = dr_q(learning_starts=20).learn(30)
    learner: Any = model.learner
    policy: Any = model.policy
    while learner.n_encoder_steps_due == 0:
        model.train(1)
    online = {name: copies(getattr(policy, name)) for name in ("encoder", "critic", "actor")}
    model.train(1)
    # The copies are of before the encoder's steps.
    for name, before in online.items():
        assert same(copies(getattr(policy, f"{name}_target")), before)
        assert not same(copies(getattr(policy, name)), before)
    encoder, critic = copies(policy.encoder), copies(policy.critic)
    targets = {name: copies(getattr(policy, name)) for name in ("encoder_target", "critic_target", "actor_target")}
    for _ in range(4):
        assert learner.n_encoder_steps_due == 0
        model.train(1)
    assert same(copies(policy.encoder), encoder) and not same(copies(policy.critic), critic)
    assert all(same(copies(getattr(policy, name)), before) for name, before in targets.items())
    assert learner.n_encoder_steps_due == 5
    step = policy.encoder.optimizer.state[policy.encoder.action.weight]["step"].item()
    model.train(1)
    assert policy.encoder.optimizer.state[policy.encoder.action.weight]["step"].item() == step + 5


def test_blocks_come_within_many_gradient_steps() -> None:
    counts = []
    for steps in ([12], [5, 7]):
        model = dr_q(learning_starts=200).learn(40)
        for n in steps:
            model.train(n)
        counts.append(model.encoder.optimizer.state[model.encoder.action.weight]["step"].item())
        assert model._n_updates == 12
    assert counts == [15, 15]


def test_the_output_for_the_end_of_an_episode_only_decays() -> None:
    model = dr_q(learning_starts=20, weight_decay=0.1)
    before = model.encoder.model.weight[0].detach().clone()
    model.learn(60)
    n = model.encoder.optimizer.state[model.encoder.model.weight]["step"].item()
    torch.testing.assert_close(model.encoder.model.weight[0], before * (1 - 3e-4 * 0.1) ** n, rtol=1e-5, atol=0)


def test_what_follows_a_termination_does_not_count_but_in_infonce() -> None:
    model = dr_q(infonce_weight=0.0)
    learner: Any = model.learner
    g = torch.Generator().manual_seed(0)
    dones = torch.zeros(6, 5)
    dones[:, 2] = 1
    windows = Windows(
        torch.randn(6, 3, generator=g), torch.rand(6, 5, 2, generator=g), torch.randn(6, 5, 3, generator=g), dones,
        torch.randn(6, 5, generator=g),
    )  # fmt: skip
    others = windows._replace(
        next_observations=torch.where(torch.arange(5)[:, None] > 2, 9.0, windows.next_observations),
        rewards=torch.where(torch.arange(5) > 2, 100.0, windows.rewards),
        actions=torch.where(torch.arange(5)[:, None] > 2, 0.5, windows.actions),
    )
    losses = []
    for batch in (windows, others):
        fresh: Any = dr_q(infonce_weight=0.0).learner
        losses.append(fresh.update_encoder(batch)["encoder/loss"])
    assert losses[0] == losses[1]
    last = windows._replace(rewards=windows.rewards + (torch.arange(5) == 2))
    assert learner.update_encoder(last)["encoder/loss"] != losses[0]


def test_losses_by_hand() -> None:
    atoms = symexp_atoms(-1, 1, 3, like=torch.zeros(()))
    torch.testing.assert_close(atoms, torch.tensor([1 - np.e, 0, np.e - 1], dtype=torch.float32))
    codes = two_hot(torch.tensor([0.0, (np.e - 1) / 4, -100.0, 100.0, 1 - np.e]), atoms)
    expected = [[0, 1, 0], [0, 0.75, 0.25], [1, 0, 0], [0, 0, 1], [1, 0, 0]]
    torch.testing.assert_close(codes, torch.tensor(expected))
    # Two orthogonal targets, one prediction right and one in between.
    predicted, target = torch.tensor([[2.0, 0], [3, 3]]), torch.tensor([[1.0, 0], [0, 5]])
    found = infonce(predicted, target, 0.5)
    torch.testing.assert_close(found, torch.tensor([np.log(1 + np.exp(-2)), np.log(2)], dtype=torch.float32))


def test_a_reset_starts_the_encoder_anew_too() -> None:
    model = dr_q(resets=(30,), learning_starts=20).learn(29)
    before = copies(model.encoder)
    model.learn(1, reset_num_timesteps=False)
    assert model.plasticity.n_done == 1 and not same(copies(model.encoder), before)


def test_a_block_of_the_encoder_follows_a_reset_at_once(tmp_path: Path) -> None:
    model = dr_q(learning_starts=20).learn(30)
    learner: Any = model.learner
    step = learner.n_updates
    assert step % 5 not in (0, 4) and learner.n_encoder_steps_due == 0
    model.reinitialize()
    assert learner.n_encoder_steps_due == 5
    model.save(tmp_path / "m")
    loaded: Any = DebiasedRQ.load(tmp_path / "m")
    assert loaded.learner.n_encoder_steps_due == 5
    model.train(1)
    assert model.encoder.optimizer.state[model.encoder.action.weight]["step"].item() == 5
    assert learner.n_updates == step + 1 and learner.n_encoder_steps_due == 0


# ---------------------------------------------------------------- spaces and wrappers


@pytest.mark.parametrize(
    ("policy", "space", "buffer"),
    [
        ("MlpPolicy", spaces.Discrete(9), WindowReplayBuffer),
        ("MlpPolicy", spaces.Box(-10, 10, (2, 3), np.float64), WindowReplayBuffer),
        ("CnnPolicy", spaces.Box(0, 255, (36, 36, 3), np.uint8), WindowReplayBuffer),
        (
            "MultiInputPolicy",
            spaces.Dict({"a": spaces.Box(-10, 10, (3,), np.float32), "b": spaces.Discrete(9)}),
            WindowDictReplayBuffer,
        ),
    ],
)
def test_spaces(policy: str, space: spaces.Space, buffer: type, tmp_path: Path) -> None:
    model = dr_q(vec(2, obs_space=space), policy=policy, batch_size=4, buffer_size=80).learn(50)
    assert type(model.replay_buffer) is buffer and model._n_updates > 30
    assert all(torch.isfinite(p).all() for p in model.policy.parameters())
    model.save(tmp_path / "m")
    assert not differing(state(model), state(DebiasedRQ.load(tmp_path / "m")))


def test_normalised_windows() -> None:
    env = VecNormalize(vec())
    model = dr_q(env, learning_starts=20).learn(60)
    np.random.seed(0)
    windows = model.replay_buffer.windows(8, 3, env)  # type: ignore[union-attr]
    np.random.seed(0)
    raw = model.replay_buffer.windows(8, 3)  # type: ignore[union-attr]
    torch.testing.assert_close(windows.observations, torch.as_tensor(env.normalize_obs(raw.observations.numpy())))
    following = env.normalize_obs(raw.next_observations.numpy())
    torch.testing.assert_close(windows.next_observations, torch.as_tensor(following))
    torch.testing.assert_close(windows.rewards, torch.as_tensor(env.normalize_reward(raw.rewards.numpy())).float())


def test_episodes_too_short_for_windows_are_told_of() -> None:
    needed = "needs more than 5 steps of an episode, or a termination, which no episode has had"
    with pytest.warns(UserWarning, match=needed):
        model = dr_q(vec(length=4, truncate=True)).learn(60)
    assert model._n_updates == 0
    with pytest.warns(UserWarning, match=needed):
        dr_q(learning_starts=2).learn(4)


def test_no_warning_of_stable_baselines3() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dr_q()


# ---------------------------------------------------------------- the learner alone


def random_windows(n: int, g: torch.Generator) -> list[Windows]:
    return [
        Windows(torch.randn(8, 3, generator=g), torch.rand(8, 5, 2, generator=g), torch.randn(8, 5, 3, generator=g),
                torch.zeros(8, 5), torch.randn(8, 5, generator=g)) for _ in range(n)
    ]  # fmt: skip


def test_the_learner_asks_for_windows_where_they_are_due() -> None:
    space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    kwargs = dict(TINY_DR_Q)
    learner: Any = DebiasedRQ.learner(space, spaces.Box(-1, 1, (2,), np.float32), **kwargs)
    batch = random_batch(dr_q())
    assert learner.n_encoder_steps_due == 5
    with pytest.raises(ValueError, match=r"windows must be 5 batches before gradient step 1, .*not 0"):
        learner.update(batch)
    g = torch.Generator().manual_seed(0)
    windows = random_windows(5, g)
    before = copies(learner.encoder)
    metrics = learner.update(batch, windows=windows)
    assert {"encoder/loss", "train/critic_loss"} <= metrics.keys() and not same(copies(learner.encoder), before)
    assert learner.n_encoder_steps_due == 0
    with pytest.raises(ValueError, match="windows must be 0 batches before gradient step 2"):
        learner.update(batch, windows=windows)
    learner.update(batch)
    other: Any = DebiasedRQ.learner(space, spaces.Box(-1, 1, (2,), np.float32), seed=5, **kwargs)
    other.load_state_dict(learner.state_dict())
    assert same(copies(other.networks), copies(learner.networks)) and other.n_updates == 2


@pytest.mark.parametrize("resets", [{"reset_gradient_steps": 7}, {"resets": (8,)}, {"resets": 8}])
def test_the_learner_asks_for_windows_where_a_reset_is_due(resets: dict[str, Any]) -> None:
    """A gradient step after each environment step: the eighth follows a reset, and those before 1, 6 and 11 a block."""
    space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    kwargs = {**TINY_DR_Q, **resets}
    learner: Any = DebiasedRQ.learner(space, spaces.Box(-1, 1, (2,), np.float32), **kwargs)
    batch, g = random_batch(dr_q()), torch.Generator().manual_seed(0)
    due, steps = [], []
    for _ in range(11):
        learner.on_step(np.zeros(1), np.zeros(1, bool), [{}])
        due.append(learner.n_encoder_steps_due)
        learner.update(batch, windows=random_windows(due[-1], g))
        steps.append(learner.encoder.optimizer.state[learner.encoder.action.weight]["step"].item())
    assert learner.plasticity.n_done == 1
    assert due == [5, 0, 0, 0, 0, 5, 0, 5, 0, 0, 5]
    assert steps == [5] * 5 + [10] * 2 + [5] * 3 + [10]


# ---------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"tau": 0.005}, "DebiasedRQ has tau=1.0, not 0.005"),
        ({"backbone": "mean"}, r"backbone must be one of \['sac', 'td3'\], not 'mean'"),
        ({"backbone": "sac", "target_noise": 0.1}, "target_noise=0.1 means nothing with backbone='sac'"),
        (
            {"policy_kwargs": {"actor_kwargs": {"log_std_min": -5}}},
            "actor_kwargs has 'log_std_min', but backbone='td3' takes",
        ),
        ({"backbone": "sac", "task_temperatures": True}, "task_temperatures=True needs observations that tell the"),
        ({"exploration": "oac"}, "DebiasedRQ has exploration='actor', not 'oac'"),
        ({"validation_proportion": 0.1}, "DebiasedRQ has validation_proportion=0.0, not 0.1"),
        ({"batch_transforms": [int]}, "DebiasedRQ has batch_transforms"),
        ({"reward_scale": "xqc"}, "DebiasedRQ has reward_scale"),
        ({"normalize_observations": True}, "DebiasedRQ has normalize_observations"),
        ({"learning_rate_schedule": "linear"}, "DebiasedRQ has learning_rate_schedule"),
        ({"actor_first": True}, "DebiasedRQ has actor_first"),
        ({"redo_period": 10}, "DebiasedRQ has redo_period=None, not 10"),
        ({"pessimism": "gpl"}, "DebiasedRQ has a fixed pessimism, a number, not 'gpl'"),
        (
            {"replay_buffer_class": HerReplayBuffer},
            "must be WindowReplayBuffer .*, not HerReplayBuffer",
        ),
        ({"replay_buffer_class": NStepReplayBuffer}, "must be WindowReplayBuffer .*, not NStepReplayBuffer"),
        ({"ent_coef": 0.1}, "ent_coef=0.1 asks for an entropy"),
        ({"target_entropy": -1.0}, "target_entropy=-1.0 asks for an entropy"),
        ({"encoder_horizon": 0}, "encoder_horizon must be an integer of at least 1, not 0"),
        ({"infonce_temperature": 0.0}, "infonce_temperature must be above 0 and finite, not 0.0"),
        ({"reward_range": (1, -1)}, r"reward_range must be two finite numbers, the smaller first, not \(1, -1\)"),
        ({"reward_range": 10}, "reward_range must be two finite numbers"),
        ({"exploration_noise": 0}, "exploration_noise must be above 0 and finite, not 0"),
        ({"weight_decay": -1}, "weight_decay must be at least 0 and finite, not -1"),
        (
            {"replay_buffer_kwargs": {"horizon": 7}},
            "replay_buffer_kwargs has 'horizon', which is the argument enc",
        ),
        ({"replay_buffer_kwargs": {"fade": 2}}, r"replay_buffer_kwargs\['fade'\] must lie in \(0, 1\], not 2"),
        ({"policy_kwargs": {"encoder_width": 0}}, "encoder_width must be an integer of at least 1, not 0"),
        ({"policy_kwargs": {"n_reward_atoms": 1}}, "n_reward_atoms must be an integer of at least 2, not 1"),
        (
            {"policy_kwargs": {"critic_network": "mlp"}},
            "policy_kwargs has 'critic_network', which is no argument of",
        ),
        (
            {"policy_kwargs": {"actor_kwargs": {"target_noise": 1}}},
            "'target_noise', which is the argument target_",
        ),
        ({"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0}}}, "weight_decay is an argument of the algorithm"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        dr_q(**kwargs)


def test_policies_are_its_own() -> None:
    assert isinstance(dr_q(policy=DebiasedRQPolicy).policy, DebiasedRQPolicy)
    from sb3_sample.sac.policies import SACPolicy

    with pytest.raises(ValueError, match="policy must be one of .*or a policy class derived from .*DebiasedRQPolicy"):
        dr_q(policy=SACPolicy)


def test_arguments_at_loading(tmp_path: Path) -> None:
    dr_q().learn(30).save(tmp_path / "m")
    loaded = DebiasedRQ.load(
        tmp_path / "m", env=vec(), infonce_weight=0.5, exploration_noise=0.3, n_steps=2, gamma=0.9,
        replay_buffer_kwargs={"fade": 0.9},
    )  # fmt: skip
    assert loaded.learner.embedding_loss.infonce_weight == 0.5
    assert loaded.actor.log_exploration_noise == pytest.approx(np.log(0.3))
    buffer: Any = loaded.replay_buffer
    assert (buffer.weights.fade, buffer.horizon) == (0.9, 5)
    loaded.learn(30)
    with pytest.raises(ValueError, match="tau=1.0, not 0.5"):
        DebiasedRQ.load(tmp_path / "m", tau=0.5)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"n_quantiles": 5},
        {"sam_radius": 0.05},
        {"policy_delay": 2},
        {"reset_shrink": 0.5, "resets": 25},
        {"policy_kwargs": {**TINY_DR_Q["policy_kwargs"], "n_critics": 3}},
    ],
)
@pytest.mark.slow
def test_parts_of_the_family(kwargs: dict[str, Any]) -> None:
    model = dr_q(**kwargs).learn(50)
    assert model._n_updates > 30 and all(torch.isfinite(p).all() for p in model.policy.parameters())


# ---------------------------------------------------------------- SAC's actor


def test_a_step_of_sacs_actor_by_hand() -> None:
    """Losses and entropy, written out: target actor and noise are gone, and the entropy is there."""
    model = dr_q(backbone="sac", ent_coef="auto_0.5", gamma=0.9)
    policy: Any = model.policy
    assert policy.actor_target is None
    with torch.no_grad():
        # A block of the encoder has been: it is no longer its target.
        for parameter in policy.encoder.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    batch, noise = random_batch(model, 16), torch.randn(16, 2, generator=torch.Generator().manual_seed(2))
    encoder = copies(policy.encoder)

    def action(observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        hidden = policy.actor.trunk(policy.encoder(observations))
        low, high = policy.actor.log_std_min, policy.actor.log_std_max
        log_std = low + (high - low) / 2 * (1 + torch.tanh(policy.actor.log_std(hidden)))
        normal = torch.distributions.Normal(policy.actor.mean(hidden), log_std.exp())
        x = normal.mean + normal.stddev * noise
        log_prob = normal.log_prob(x) - torch.log(1 - torch.tanh(x).square())
        return torch.tanh(x), log_prob.sum(1, keepdim=True)

    def value(critic: Any, of: Any, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return critic.head(critic.trunk(of.pair(of(observations), actions))).squeeze(2)  # type: ignore[no-any-return]

    with torch.no_grad():
        actions, log_prob = action(batch.next_observations)
        following = value(policy.critic_target, policy.encoder_target, batch.next_observations, actions)
        soft = following.amin(0).unsqueeze(1) - 0.5 * log_prob
        target = batch.rewards + 0.9 * (1 - batch.dones) * soft
        error = value(policy.critic, policy.encoder, batch.observations, batch.actions) - target.T
        critic_loss = torch.nn.functional.huber_loss(error, torch.zeros_like(error))
        actions, log_prob = action(batch.observations)

    metrics = model.learner.step(batch, Noise(noise, noise, noise), eager=True)
    torch.testing.assert_close(metrics["train/critic_loss"], critic_loss, rtol=1e-4, atol=0)
    torch.testing.assert_close(metrics["train/entropy"], -log_prob.mean(), rtol=1e-4, atol=1e-4)
    with torch.no_grad():
        # The actor learns on the new critics.
        mean_value = value(policy.critic, policy.encoder, batch.observations, actions).mean(0).unsqueeze(1)
    torch.testing.assert_close(metrics["train/actor_loss"], (0.5 * log_prob - mean_value).mean(), rtol=1e-4, atol=1e-4)
    assert same(copies(policy.encoder), encoder) and model.temperature() != 0.5


def test_sacs_actor_trains_saves_and_resumes(tmp_path: Path) -> None:
    def make() -> DebiasedRQ:
        return dr_q(
            backbone="sac",
            resets=40,
            policy_kwargs={**TINY_DR_Q["policy_kwargs"], "actor_kwargs": {"initial_std": 0.5}},
        )

    model = make()
    observation = torch.randn(64, 3, generator=torch.Generator().manual_seed(0))
    policy: Any = model.policy
    _, log_std = policy.actor.gaussian(policy.encoder(observation))
    torch.testing.assert_close(log_std.exp(), torch.full_like(log_std, 0.5), rtol=0.1, atol=0)
    model.learn(60, checkpoint=tmp_path / "a", checkpoint_freq=100)
    assert model.plasticity.n_done == 1
    make().learn(33, checkpoint=tmp_path / "b", checkpoint_freq=100)
    assert not differing(state(model), state(make().learn(60, checkpoint=tmp_path / "b", checkpoint_freq=100)))
    model.save(tmp_path / "m")
    loaded = DebiasedRQ.load(tmp_path / "m", env=vec())
    assert loaded.backbone == "sac" and not differing(state(model), state(loaded))
    acted = [each.predict(observation.numpy(), deterministic=True)[0] for each in (model, loaded)]
    np.testing.assert_array_equal(*acted)
    again = [model.predict(observation.numpy())[0] for _ in range(2)]
    assert not np.array_equal(*again)


# ---------------------------------------------------------------- learning


@pytest.mark.slow
@pytest.mark.parametrize(("backbone", "steps"), [("td3", 4_000), ("sac", 8_000)])
def test_it_learns_pendulum(backbone: str, steps: int) -> None:
    """A random policy has about -1200, a good one about -150."""
    model = DebiasedRQ(
        "MlpPolicy", "Pendulum-v1", gamma=0.95, learning_rate=1e-3, learning_starts=500, batch_size=128,
        target_update_interval=50, buffer_size=5_000, seed=0, device="cpu", backbone=backbone,
        policy_kwargs={"net_arch": [64, 64], "encoder_width": 64, "state_embedding": 32, "action_embedding": 16,
                       "pair_embedding": 32},
    )  # fmt: skip
    model.learn(steps)
    env = Monitor(gym.make("Pendulum-v1"))
    env.reset(seed=100)
    assert np.mean(evaluate_policy(model, env, 10, deterministic=True)[0]) > -300
