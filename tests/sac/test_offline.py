"""Learning from data: the objectives of BC, IQL and TD3+BC, and ``learn_offline`` of every agent."""

import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback, EvalCallback
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample import BC, BRO, IQL, SAC, TD3BC, VPLSAC, Dataset, PrioritizedReplayBuffer, SimBa
from sb3_sample.learner import losses
from sb3_sample.sac.checks import check_dataset
from sb3_sample.sac.policies import MultiInputPolicy
from tests.sac.common import MAKERS, TINY_RESIDUAL, TINY_SAC, differing, sac, state, vec

ACTIONS = spaces.Box(-1, 1, (2,), np.float32)


#: Agents that scale rewards by returns in the environment.
SCALING = ("BRC", "FlashSAC", "SimbaV2", "XQC")


def data(n: int = 200, seed: int = 0, **kwargs: Any) -> Dataset:
    """Random transitions that fit the toy environment."""
    rng = np.random.default_rng(seed)
    observations = rng.normal(size=(n + 1, 3)).astype(np.float32)
    ends = (rng.random(n) < 0.1).astype(np.float32)
    given = (observations[:-1], rng.uniform(-1, 1, (n, 2)).astype(np.float32), rng.normal(size=n), ends, ends * 0)
    return Dataset.from_arrays(*given, next_observations=observations[1:], **kwargs)


def offline(cls: type[SAC], env: Any = None, **kwargs: Any) -> Any:
    return cls("MlpPolicy", env, **{"seed": 0, **TINY_SAC, **kwargs})


# ---------------------------------------------------------------- losses


def test_expectile_loss_by_hand() -> None:
    u = torch.tensor([[2.0], [-1.0], [0.5]])
    # 0.9 * 4 + 0.1 * 1 + 0.9 * 0.25 = 3.925
    assert losses.expectile_loss(u, 0.9).item() == pytest.approx(3.925 / 3)
    assert losses.expectile_loss(u, 0.5).item() == pytest.approx(0.5 * (4 + 1 + 0.25) / 3)


@pytest.mark.parametrize(("expectile", "expected"), [(0.5, 3.0), (0.9, None)])
def test_the_minimum_of_the_loss_is_the_expectile(expectile: float, expected: float | None) -> None:
    """At 0.5 it is the mean; else where the weighted distances on both sides are equal."""
    q = torch.tensor([0.0, 1.0, 8.0])
    v = torch.zeros((), requires_grad=True)
    for _ in range(300):
        (gradient,) = torch.autograd.grad(losses.expectile_loss(q - v, expectile), v)
        v.data -= 0.5 * gradient
    found = v.item()
    if expected is not None:
        assert found == pytest.approx(expected, abs=1e-4)
    above, below = (q - v).clamp(min=0).sum().item(), (v - q).clamp(min=0).sum().item()
    assert expectile * above == pytest.approx((1 - expectile) * below, rel=1e-4)


def test_advantage_weights_are_clipped_at_100() -> None:
    weights = losses.advantage_weights(torch.tensor([-1.0, 0.0, 1.0, 2.0]), 3.0, 100.0)
    np.testing.assert_allclose(weights.numpy(), [math.exp(-3), 1, math.exp(3), 100], rtol=1e-6)


def test_the_normaliser_of_td3_bc_by_hand() -> None:
    value = torch.tensor([2.0, -4.0, 6.0], requires_grad=True)
    actions = torch.tensor([[0.5, 0.0], [0.0, 0.0], [0.0, 1.0]])
    cloned = torch.zeros(3, 2)
    loss = losses.cloned_value_loss(value, actions, cloned, 2.5)
    # mean |Q| is 4, so lambda is 0.625; mean Q is 4 / 3; squared distances 0.25 and 1 of 6 numbers.
    assert loss.item() == pytest.approx(1.25 / 6 - 0.625 * 4 / 3)
    (gradient,) = torch.autograd.grad(loss, value)
    np.testing.assert_allclose(gradient.numpy(), np.full(3, -0.625 / 3), rtol=1e-6)  # none through lambda


def test_the_likelihood_of_an_action() -> None:
    """That of a transformed Gaussian, by torch's own distributions; on a bound that of a little inside."""
    model = sac()
    observations = torch.randn(5, 3)
    actions = torch.tensor([[0.3, -0.9], [0.0, 0.99], [1.0, -1.0], [-1.0, 1.0], [0.5, 0.5]])
    mean, log_std, _ = model.actor.get_action_dist_params(observations)
    inside = actions.clamp(-1 + 1e-5, 1 - 1e-5)
    gaussian = torch.distributions.Normal(mean.double(), log_std.double().exp())
    tanh = torch.distributions.TransformedDistribution(gaussian, [torch.distributions.TanhTransform()])
    expected = tanh.log_prob(inside.double()).sum(1, keepdim=True)
    found = model.actor.log_prob_of(observations, actions)
    assert found.isfinite().all()
    torch.testing.assert_close(found.double(), expected, rtol=2e-3, atol=2e-3)


# ---------------------------------------------------------------- the agents


class Replay:
    """IQL's update as published, in torch's own modules and optimizers."""

    def __init__(self, model: IQL):
        self.model = model
        networks = model.learner.networks
        self.actor, self.critic = copy.deepcopy(networks.actor), copy.deepcopy(networks.critic)
        self.target, self.value = copy.deepcopy(networks.critic_target), copy.deepcopy(model.objective.value)
        self.optimizers = [torch.optim.Adam(m.parameters(), lr=3e-4) for m in (self.value, self.actor, self.critic)]

    @staticmethod
    def descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def step(self, batch: Any) -> None:
        model, (of_value, of_actor, of_critic) = self.model, self.optimizers
        with torch.no_grad():
            q = self.target.q_values(batch.observations, batch.actions).min(dim=0).values
        difference = q - self.value(batch.observations)
        weight = torch.abs(model.expectile - (difference < 0).float())
        self.descend(of_value, (weight * difference**2).mean())
        with torch.no_grad():
            v, next_v = self.value(batch.observations), self.value(batch.next_observations)
            weights = torch.minimum(torch.exp((q - v) * model.inverse_temperature), torch.tensor(100.0))
        mean, log_std = self.actor.gaussian(self.actor.features(batch.observations))
        gaussian = torch.distributions.Normal(mean, log_std.exp())
        policy = torch.distributions.TransformedDistribution(gaussian, [torch.distributions.TanhTransform()])
        log_prob = policy.log_prob(batch.actions.clamp(-1 + 1e-5, 1 - 1e-5)).sum(1, keepdim=True)
        self.descend(of_actor, -(weights * log_prob).mean())
        target = batch.rewards + model.gamma * (1 - batch.dones) * next_v
        q_values = self.critic.q_values(batch.observations, batch.actions)
        self.descend(of_critic, sum(((q - target) ** 2).mean() for q in q_values))
        with torch.no_grad():
            for ours, theirs in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                ours.copy_(model.tau * theirs + (1 - model.tau) * ours)


@pytest.mark.parametrize("network", ["mlp", "bronet"])
def test_iql_against_a_replay_of_its_published_update(network: str) -> None:
    kwargs = {"net_arch": [16, 16]}
    if network == "bronet":
        small = {"width": 16, "n_blocks": 1}
        kwargs = dict(critic_network=network, actor_network=network, critic_network_kwargs=small)
        kwargs["actor_network_kwargs"] = small
    model = offline(IQL, vec(), policy_kwargs=kwargs, expectile=0.8, inverse_temperature=5.0)
    published, transitions = Replay(model), data()
    model._take_settings()
    for _ in range(5):
        batch = transitions.sample(32)
        published.step(batch)
        metrics = model._update(batch._replace(discounts=model.gamma))
    assert abs(metrics["train/advantage_weight"] - 1) > 0.02
    networks = model.learner.networks
    pairs = [(model.objective.value, published.value), (networks.actor, published.actor)]
    pairs += [(networks.critic, published.critic), (networks.critic_target, published.target)]
    for ours, theirs in pairs:
        for (name, a), b in zip(ours.named_parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=2e-5, msg=name)


@pytest.mark.parametrize("deterministic", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_bc_recovers_a_linear_policy(deterministic: bool) -> None:
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(2_000, 3)).astype(np.float32)
    weights = rng.normal(size=(3, 2)) * 0.4
    actions = np.tanh(observations @ weights)
    if not deterministic:
        # The mean of many actions for an observation is what it learns: noise before the squashing.
        actions = np.tanh(observations @ weights + rng.choice([-0.02, 0.02], size=(2_000, 2)))
    ends = np.ones(len(actions))
    transitions = Dataset.from_arrays(observations, actions, ends, ends, ends * 0)
    model = BC(
        "MlpPolicy", None, deterministic=deterministic, seed=0, batch_size=256, buffer_size=1, device="cpu",
        learning_rate=lambda left: (0.03 if deterministic else 0.01) * left**2, policy_kwargs={"net_arch": []},
    )  # fmt: skip
    model.learn_offline(transitions, 600 if deterministic else 1_500)
    expected = np.tanh(observations @ weights)
    found = model.predict(observations, deterministic=True)[0]
    # Of the noise remains the error of its mean over the data, as least squares has it.
    least = np.linalg.lstsq(observations, np.arctanh(actions), rcond=None)[0]
    assert np.abs(found - np.tanh(observations @ least)).mean() < 1e-3
    if deterministic:
        assert np.abs(found - expected).max() < 1e-3
    else:
        log_std = model.actor.get_action_dist_params(torch.from_numpy(observations))[1]
        np.testing.assert_allclose(log_std.detach().exp().numpy().mean(0), 0.02, rtol=0.05)


def test_bc_takes_numpys_truth() -> None:
    for value in (True, False):
        model = offline(BC, vec(), deterministic=np.bool_(value))
        assert model.deterministic is value and model.backbone == ("td3" if value else "sac")


def test_td3_bc_moves_its_actor_every_second_step_towards_value_and_data() -> None:
    model, transitions = offline(TD3BC, vec()), data()
    model._take_settings()
    batches = [transitions.sample(32)._replace(discounts=model.gamma) for _ in range(2)]
    before = copy.deepcopy(model.actor.state_dict())
    assert "train/actor_loss" not in model._update(batches[0])
    assert not differing(before, model.actor.state_dict())
    actor = copy.deepcopy(model.actor)
    metrics = model._update(batches[1])
    q = model.critic.q_values(batches[1].observations, actor(batches[1].observations)).mean(0)
    distance = (actor(batches[1].observations) - batches[1].actions).square().mean()
    expected = distance - 2.5 / q.abs().mean() * q.mean()
    assert metrics["train/actor_loss"].item() == pytest.approx(expected.item(), rel=1e-4)


@pytest.mark.parametrize(
    ("cls", "kwargs", "words"),
    [
        (BC, {"backbone": "td3"}, "backbone='td3' of BC follows from deterministic=False"),
        (BC, {"ent_coef": 0.1}, "ent_coef=0.1 means nothing with BC"),
        (BC, {"target_entropy": -7}, "target_entropy=-7 means nothing with BC"),
        (BC, {"n_quantiles": 5}, "n_quantiles=5 means nothing with BC"),
        (BC, {"pessimism": 0.7}, "pessimism=0.7 means nothing with BC"),
        (BC, {"actor_pessimism": 0.3}, "actor_pessimism=0.3 means nothing with BC"),
        (BC, {"gamma": 0.9}, "gamma=0.9 means nothing with BC"),
        (BC, {"tau": 0.1}, "tau=0.1 means nothing with BC"),
        (BC, {"target_update_interval": 2}, "target_update_interval=2 means nothing with BC"),
        (BC, {"redo_period": 2}, "redo_period=2 means nothing with BC"),
        (BC, {"exploration": "oac"}, "exploration='oac'"),
        (BC, {"policy_kwargs": {"n_critics": 2}}, r"describe critics \(n_critics\), which BC has not"),
        (BC, {"deterministic": "no"}, "deterministic must be True or False, not 'no'"),
        (IQL, {"expectile": 1.0}, r"expectile must lie in \(0, 1\), not 1.0"),
        (IQL, {"inverse_temperature": -1}, "inverse_temperature must be at least 0 and finite, not -1"),
        (IQL, {"backbone": "td3"}, "backbone='td3' means nothing with IQL"),
        (IQL, {"pessimism": "gpl"}, "pessimism='gpl' learns from TD errors of the actor"),
        (BC, {"reward_scale": "xqc"}, "reward_scale='xqc' means nothing with BC"),
        (BC, {"actor_first": True}, "actor_first=True means nothing with BC"),
        (IQL, {"policy_kwargs": {"critic_network": "crossq"}}, "critic_network=CrossQ.* of which IQL takes none"),
        (IQL, {"policy_kwargs": {"actor_network": "xqc"}}, "initial_std=1.0 is set by a plain output layer.*XQC"),
        (IQL, {"policy_kwargs": {"actor_kwargs": {"initial_std": 9.0}}}, "initial_std must lie between .*, not be 9.0"),
        (IQL, {"sam_radius": 0.1}, "sam_radius=0.1 means nothing with IQL"),
        (IQL, {"policy_kwargs": {"share_features_extractor": True}}, "share_features_extractor=True is not supported"),
        (TD3BC, {"alpha": 0}, "alpha must be above 0 and finite, not 0"),
        (TD3BC, {"backbone": "sac"}, "backbone='sac' means nothing with TD3BC"),
    ],
)  # fmt: skip
def test_what_the_agents_refuse(cls: type[SAC], kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        offline(cls, vec(), **kwargs)


def test_bc_does_not_learn_in_an_environment() -> None:
    with pytest.raises(ValueError, match=r"call learn_offline\(dataset, gradient_steps"):
        offline(BC, vec()).learn(10)


@pytest.mark.parametrize("cls", [BC, IQL, TD3BC])
def test_files_of_the_agents(cls: type[SAC], tmp_path: Path) -> None:
    model = offline(cls).learn_offline(data(), 6)
    model.save(tmp_path / "m")
    again = cls.load(tmp_path / "m")
    assert not differing(state(model), state(again))
    observations = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    np.testing.assert_array_equal(*(m.predict(observations, deterministic=True)[0] for m in (model, again)))
    if cls is IQL:
        assert any(name.startswith("objective/value") for name in state(model))
    for each in (model, again):
        np.random.seed(1)
        torch.manual_seed(1)
        each.learn_offline(data(), 3)
    assert not differing(state(model), state(again))


# ---------------------------------------------------------------- learn_offline


@pytest.mark.parametrize("maker", [*(name for name in MAKERS if name != "DebiasedRQ"), "BC"])
def test_every_agent_learns_offline_and_leaves_its_environment_alone(maker: str) -> None:
    env = vec()
    scaled = {"reward_scale": None} if maker in SCALING else {}
    model: Any = offline(BC, env) if maker == "BC" else MAKERS[maker](env, **scaled)
    before = state(model)
    assert model.learn_offline(data(), 12, log_interval=None) is model
    toy = env.envs[0].unwrapped
    assert toy.total == 0 and model._last_obs is None and model.num_transitions == 0
    assert model.num_timesteps == model._n_updates == model._n_offline_updates == 12
    assert any("actor" in name or "policy" in name for name in differing(before, state(model)))
    if maker == "BC":
        return
    model.learn(3)
    # It acts by what it has learned, also in the steps before its first gradient step.
    assert model._n_updates == 12 and len(toy.actions) == 3


def test_a_fresh_model_acts_at_random_and_one_that_learned_offline_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    model = offline(IQL, vec())
    plain = model.learner.explore
    monkeypatch.setattr(model.learner, "explore", lambda obs: calls.append(1) or plain(obs))
    model.learn(3)
    assert calls == []
    model.learn_offline(data(), 2).learn(3)
    assert len(calls) == 3


@pytest.mark.parametrize("where", ["dataset", "arguments", "environment"])
def test_spaces_come_from_the_data_the_arguments_or_the_environment(where: str) -> None:
    transitions = data(action_space=ACTIONS)
    given: dict[str, Any] = {}
    if where == "arguments":
        given = {"observation_space": transitions.observation_space, "action_space": ACTIONS}
    model = offline(SAC, vec() if where == "environment" else None, **given)
    assert hasattr(model, "policy") == (where != "dataset") or model.policy is None
    model.learn_offline(transitions, 2)
    assert model.action_space == ACTIONS
    if where != "environment":
        with pytest.raises(ValueError, match="env: the model was made or loaded without one"):
            model.learn(1)
        model.set_env(vec(obs_space=model.observation_space))
    model.learn(1)


def test_an_environment_whose_numbers_are_of_another_type(tmp_path: Path) -> None:
    """As those of Gymnasium's MuJoCo, of float64, where data have float32 and no bounds."""
    env = vec(obs_space=spaces.Box(-9, 9, (3,), np.float64))
    model = offline(IQL).learn_offline(data(), 2)
    words = r"save the model, and load\(path, env=env, observation_space=env.observation_space, action_space="
    with pytest.raises(ValueError, match=words):
        model.set_env(env)
    model.save(tmp_path / "m")
    with pytest.raises(ValueError, match=words):
        IQL.load(tmp_path / "m", env=env)
    given = {"observation_space": env.observation_space, "action_space": env.action_space}
    again = IQL.load(tmp_path / "m", env=env, **given)
    assert not differing(state(model), state(again)) and again.learn(12)._n_updates > 2
    for other in (vec(obs_space=spaces.Box(-9, 9, (4,))), vec(action_space=spaces.Box(-2, 2, (2,)))):
        with pytest.raises(ValueError, match=r"spaces do not match: .*\)$"):
            model.set_env(other)


@pytest.mark.parametrize("where", ["dataset", "arguments", "environment", "learner"])
def test_the_policy_of_spaces_that_become_known(where: str) -> None:
    """MlpPolicy reads observations that tell the task, as in a model made with its environment, and no other dicts."""
    box, rng = spaces.Box(-9, 9, (3,), np.float32), np.random.default_rng(0)
    told = spaces.Dict({"observation": box, "task": spaces.Discrete(2)})

    def made(space: Any) -> Any:
        given = {"observation_space": space, "action_space": ACTIONS}
        if where == "learner":
            return SAC.learner(space, ACTIONS, policy="MlpPolicy", policy_kwargs={"net_arch": [8]})
        model = offline(SAC, **given if where == "arguments" else {})
        if where == "environment":
            model.set_env(vec(obs_space=space))
        if where == "dataset":
            rows = {name: np.array([part.sample() for _ in range(20)]) for name, part in space.spaces.items()}
            actions, zeros = rng.uniform(-1, 1, (20, 2)), np.zeros(20)
            model.learn_offline(Dataset.from_arrays(rows, actions, zeros, zeros, zeros, **given), 1)
        return model

    model = made(told)
    assert model.critic.features_extractor.features_dim == 5
    if where != "learner":
        assert type(model.policy) is MultiInputPolicy and model.predict(told.sample())[0].shape == (2,)
    with pytest.raises(ValueError, match="policy='MlpPolicy' is not for Dict observations, .*: use 'MultiInputPolicy'"):
        made(spaces.Dict({"observation": box, "b": box}))


def test_a_model_without_spaces_takes_those_of_its_first_environment() -> None:
    model = offline(SAC)
    with pytest.raises(ValueError, match="env: the model was made or loaded without one: pass env= to it, or call set"):
        model.learn(1)
    model.set_env(vec(2))
    assert model.n_envs == 2 and model.learn(4).num_timesteps == 4


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"action_space": ACTIONS}, "belong together: pass observation_space= too"),
        ({"observation_space": 3, "action_space": ACTIONS}, "observation_space must be a space of Gymnasium's, or"),
        ({"observation_space": ACTIONS, "action_space": spaces.Discrete(3)}, "action_space must be a bounded Box"),
        ({"observation_space": ACTIONS, "action_space": ACTIONS, "env": "toy"}, "must be the environment's"),
    ],
)  # fmt: skip
def test_what_of_the_spaces_is_refused(given: dict[str, Any], words: str) -> None:
    env = vec() if given.pop("env", None) else None
    with pytest.raises(ValueError, match=words):
        offline(SAC, env, **given)


def test_arguments_of_a_model_without_spaces_are_checked_at_once() -> None:
    with pytest.raises(ValueError, match="gamma must lie in"):
        offline(SAC, gamma=3)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"dataset": [1]}, r"dataset must be of Dataset, not \[1\]"),
        ({"gradient_steps": 1.5}, "gradient_steps must be an integer of at least 0, not 1.5"),
        ({"callback": 1}, "callback must be a callback"),
        ({"log_interval": 0}, "log_interval must be an integer of at least 1"),
        ({"checkpoint_freq": 5}, "checkpoint_freq=5 means nothing without checkpoint"),
    ],
)  # fmt: skip
def test_what_learn_offline_refuses(given: dict[str, Any], words: str) -> None:
    model = offline(SAC, vec())
    with pytest.raises(ValueError, match=words):
        model.learn_offline(**{"dataset": data(), "gradient_steps": 2, **given})


def test_data_of_other_spaces_are_refused() -> None:
    with pytest.raises(ValueError, match="dataset must have actions in the units of the model"):
        offline(SAC, vec(action_space=spaces.Box(-2, 2, (2,)))).learn_offline(data(), 1)
    with pytest.raises(ValueError, match=r"dataset must have observations of the model's shape, \(5,\), not \(3,\)"):
        offline(SAC, vec(obs_space=spaces.Box(-1, 1, (5,)))).learn_offline(data(), 1)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (spaces.Discrete(5), spaces.Discrete(10)),
        (spaces.MultiDiscrete([3, 4]), spaces.MultiDiscrete([4, 4])),
        (spaces.Box(0, 1, (3, 4, 4)), spaces.Box(0, 255, (3, 4, 4), np.uint8)),
    ],
)
@pytest.mark.parametrize("as_dict", [False, True])
def test_data_of_other_classes_or_pictures_are_refused(ours: Any, theirs: Any, as_dict: bool) -> None:
    observations: Any = np.zeros((4, *(theirs.shape or (1,))), theirs.dtype)
    if as_dict:
        ours, theirs, observations = spaces.Dict(a=ours), spaces.Dict(a=theirs), {"a": observations}
    ends = np.ones(4)
    transitions = Dataset.from_arrays(observations, np.zeros((4, 2)), ends, ends, ends * 0, observation_space=theirs)
    check_dataset("dataset", transitions, theirs, ACTIONS)
    with pytest.raises(ValueError, match="dataset must have observations.* that mean the same numbers as the model's"):
        check_dataset("dataset", transitions, ours, ACTIONS)


def test_dict_observations_and_hindsight_goals() -> None:
    n, rng = 50, np.random.default_rng(0)
    keys = ("observation", "achieved_goal", "desired_goal")
    observations = {key: rng.normal(size=(n, 2)).astype(np.float32) for key in keys}
    ends = np.ones(n)
    transitions = Dataset.from_arrays(observations, rng.uniform(-1, 1, (n, 2)), ends, ends, ends * 0)
    model = IQL("MultiInputPolicy", None, **TINY_SAC).learn_offline(transitions, 3)
    assert np.isfinite(model.predict({key: value[:2] for key, value in observations.items()})[0]).all()


def test_evaluation_and_log_without_an_environment(tmp_path: Path) -> None:
    evaluation = EvalCallback(vec(), n_eval_episodes=1, eval_freq=4, verbose=0)
    model = offline(IQL)
    model.learn_offline(data(), 10, callback=evaluation, log_interval=5, checkpoint=tmp_path / "run")
    assert evaluation.n_calls == 10 and evaluation.last_mean_reward == 28
    lines = [json.loads(line) for line in (tmp_path / "run" / "progress.jsonl").read_text().splitlines()]
    steps = [line["step"] for line in lines]
    assert steps == [4, 5, 8, 10] and "train/value_loss" in lines[1] and lines[0]["eval/mean_reward"] == 28


def test_a_callback_ends_the_training() -> None:
    model = offline(SAC, vec()).learn_offline(data(), 10, callback=lambda local, all: local["self"].num_timesteps < 4)
    assert model.num_timesteps == 4


@pytest.mark.parametrize("several", [True, False])
def test_a_progress_bar_stands_beside_the_callback(
    several: bool, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    for bar, steps in ((True, 4), (False, 8), (True, 12)):
        counting = Counting()
        callback: Any = [counting] if several else counting
        offline(SAC, vec()).learn_offline(data(), steps, callback, progress_bar=bar, checkpoint=tmp_path)
        assert counting.n_calls == steps and counting.n_initialised == 1
    assert not [each for each in recwarn if "callback" in str(each.message)]


@pytest.mark.parametrize("listed", [True, False])
def test_a_function_is_called_beside_the_progress_bar(listed: bool) -> None:
    steps = []

    def note(names: dict[str, Any], _: Any) -> bool:
        steps.append(names["self"].num_timesteps)
        return True

    callback: Any = [ConvertCallback(note)] if listed else note
    offline(SAC, vec()).learn_offline(data(), 3, callback, progress_bar=True)
    assert steps == [1, 2, 3]
    offline(SAC, vec()).learn_offline(data(), 3, progress_bar=True)


class Counting(BaseCallback):
    n_initialised = 0

    def _init_callback(self) -> None:
        self.n_initialised += 1

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize("maker", SCALING)
def test_rewards_scaled_by_returns_of_an_environment_are_refused(maker: str) -> None:
    with pytest.raises(ValueError, match="reward_scale=.* learn_offline takes no steps there: pass reward_scale=None"):
        MAKERS[maker]().learn_offline(data(), 1)


@pytest.mark.parametrize("kwargs", [{"shift": -1.0}, {"factor": 4.0}, {"return_range": 1_000.0, "shift": 0.5}])
def test_rewards_scaled_as_iql_does(kwargs: dict[str, Any], tmp_path: Path) -> None:
    transitions = data()
    model = offline(IQL, vec(), reward_scale="linear", reward_scale_kwargs=kwargs)
    assert model.learn_offline(transitions, 2).num_timesteps == 2
    rewards, episodes = transitions.plain(slice(None))["rewards"], transitions.episodes()
    returns = [float(rewards[rows].astype(float).sum()) for rows in episodes]
    assert len(returns) > 10
    factor = kwargs.get("factor", 1.0)
    if "return_range" in kwargs:
        factor = 1_000.0 / (max(returns) - min(returns))
    batch = transitions.take(torch.arange(5))
    scaled = model.learner.reward_scaler.transform(batch, None).rewards
    np.testing.assert_allclose(scaled[:, 0], rewards[:5] * factor + kwargs.get("shift", 0.0), rtol=1e-5, atol=1e-5)
    # The scale stays that of the first data set, in files and with others too.
    model.save(tmp_path / "m")
    again = IQL.load(tmp_path / "m", env=vec()).learn_offline(data(seed=7), 1)
    np.testing.assert_array_equal(again.learner.reward_scaler.transform(batch, None).rewards, scaled)
    assert again.learn(12)._n_updates > 3


def test_another_range_of_returns_at_loading(tmp_path: Path) -> None:
    transitions, given = data(), {"reward_scale": "linear", "reward_scale_kwargs": {"return_range": 1_000.0}}
    model = offline(IQL, vec(), **given).learn_offline(transitions, 1)
    factor = model.reward_scaler.factor.item()
    model.save(tmp_path / "m")
    for kwargs, expected in (({"return_range": 1_000.0}, factor), ({"return_range": 10.0, "shift": 1.0}, factor / 100)):
        loaded = IQL.load(tmp_path / "m", reward_scale_kwargs=kwargs)
        for seed in (None, 7):
            if seed is not None:
                loaded.learn_offline(data(seed=seed), 1)
            assert loaded.reward_scaler.factor.item() == pytest.approx(expected, rel=1e-6)
    # Of a file without a range, that of the first data set counts.
    IQL.load(tmp_path / "m", reward_scale_kwargs={"factor": 3.0}).save(tmp_path / "n")
    loaded = IQL.load(tmp_path / "n", reward_scale_kwargs={"return_range": 1_000.0})
    assert loaded.reward_scaler.waits_for_data
    assert loaded.learn_offline(transitions, 1).reward_scaler.factor.item() == factor


def test_a_range_of_returns_needs_data() -> None:
    kwargs: dict[str, Any] = {"reward_scale": "linear", "reward_scale_kwargs": {"return_range": 1_000.0}}
    with pytest.raises(ValueError, match="return_range=1000.0 of reward_scale_kwargs is that of a data set: call"):
        offline(IQL, vec(), **kwargs).learn(12)
    assert offline(SAC, vec(), prior_data=data(), **kwargs).learn(12)._n_updates > 0
    order, given = np.random.default_rng(0).permutation(200), data().rows(slice(None))
    names = ("observations", "actions", "rewards", "terminations", "truncations", "next_observations")
    *now, following = (given[name][order] for name in names)
    with pytest.warns(UserWarning, match="not in the order"):
        shuffled = Dataset.from_arrays(*now, next_observations=following)
    with pytest.raises(ValueError, match="in the order in which they were taken"):
        offline(IQL, vec(), **kwargs).learn_offline(shuffled, 1)
    assert offline(IQL, vec(), reward_scale="linear").learn_offline(shuffled, 1)._n_updates == 1
    # It is that of the first data set learned from, not of prior data for later.
    model = offline(IQL, vec(), prior_data=data(seed=7), **kwargs)
    assert model.learner.reward_scaler.waits_for_data
    factor = model.learn_offline(data(), 1).learn(12).learner.reward_scaler.factor.item()
    assert factor == pytest.approx(1_000 / data().return_range)
    ends = np.ones(4)
    same = Dataset.from_arrays(np.eye(4, 3), np.zeros((4, 2)), ends, ends, ends * 0)
    with pytest.raises(ValueError, match="whose episodes all have the same return: pass factor"):
        offline(IQL, vec(), **kwargs).learn_offline(same, 1)


def test_returns_of_several_steps_are_refused() -> None:
    with pytest.raises(ValueError, match="n_steps=3 asks for returns of several steps, .*: pass n_steps=1"):
        sac(n_steps=3).learn_offline(data(), 1)


def test_an_agent_that_learns_from_windows_is_refused() -> None:
    with pytest.raises(ValueError, match="learn_offline: DebiasedRQ learns from windows of several steps"):
        MAKERS["DebiasedRQ"]().learn_offline(data(), 1)


def test_observations_are_normalised_by_the_data_and_then_by_what_is_acted_on_too() -> None:
    transitions = data()
    model = offline(IQL, vec(), normalize_observations=True).learn_offline(transitions, 2)
    norm, seen = model.policy.observation_norm, transitions.rows(slice(None))["observations"].astype(np.float64)
    np.testing.assert_allclose(norm.mean, seen.mean(0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(norm.var, seen.var(0), rtol=1e-4)
    assert model.objective.value.observation_norm is norm
    model.learn_offline(transitions, 2)
    assert norm.count == pytest.approx(200 + 1e-4)
    model.learn(8)
    assert 205 < norm.count < 209


def test_statistics_that_were_interrupted_leave_the_model_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    transitions, model = data(), offline(IQL, vec(), normalize_observations=True)
    norm = model.policy.observation_norm
    before, update = copy.deepcopy(norm.state_dict()), type(norm).update

    def interrupted(self: Any, values: torch.Tensor) -> None:
        update(self, values)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(type(norm), "update", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model.learn_offline(transitions, 2)
    assert not differing(before, norm.state_dict())
    # It acts again, and learns from the data when asked once more.
    model.learn(12)
    assert model.num_transitions == 12 and model.replay_buffer.size() == 12
    fresh = offline(IQL, vec(), normalize_observations=True).learn_offline(transitions, 2)
    assert fresh.policy.observation_norm.count == pytest.approx(200 + 1e-4)


def test_a_schedule_of_the_learning_rate_counts_the_steps_offline() -> None:
    model = offline(IQL, learning_rate=1e-3, learning_rate_schedule="linear", final_learning_rate=5e-4)
    model.learn_offline(data(), 10)
    assert model.planned_updates == 10
    assert model.objective.optimizer.param_groups[0]["lr"] == pytest.approx(5.5e-4, abs=6e-5)


@pytest.mark.parametrize("cls", [IQL, TD3BC])
def test_the_actor_first_is_on_the_critics_from_before_the_step(cls: type[SAC]) -> None:
    model, transitions = offline(cls, vec(), actor_first=True, policy_delay=1), data()
    model._take_settings()
    batch = transitions.sample(32)._replace(discounts=model.gamma)
    actor, critic = copy.deepcopy(model.actor), copy.deepcopy(model.critic)
    metrics = model._update(batch)
    assert differing(actor.state_dict(), model.actor.state_dict())
    if cls is TD3BC:
        q = critic.q_values(batch.observations, actor(batch.observations)).mean(0)
        distance = (actor(batch.observations) - batch.actions).square().mean()
        expected = distance - 2.5 / q.abs().mean() * q.mean()
        assert metrics["train/actor_loss"].item() == pytest.approx(expected.item(), rel=1e-4)


def test_priorities_of_an_objective_with_a_target_of_its_own() -> None:
    model = offline(IQL, vec(), replay_buffer_class=PrioritizedReplayBuffer).learn(40)
    assert model.learner.td_errors.shape == (8,) and (model.learner.td_errors > 0).all()


class Break(BaseCallback):
    """Raises at a step, as a program that is killed ends there."""

    def __init__(self, at: int):
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            raise KeyboardInterrupt
        return True


@pytest.mark.parametrize(
    "cls", [IQL, BRO, *(pytest.param(cls, marks=pytest.mark.slow) for cls in (BC, TD3BC, VPLSAC, SimBa))]
)
def test_a_run_that_goes_on_is_the_same_bit_by_bit(cls: type[SAC], tmp_path: Path) -> None:
    kwargs: dict[str, Any] = {"learning_rate": lambda left: 1e-3 * left}
    if cls is BRO:
        kwargs |= {"model_size": (1, 8), "n_quantiles": 5, "policy_kwargs": {}}
    if cls is SimBa:
        kwargs["policy_kwargs"] = TINY_RESIDUAL
    if cls is VPLSAC:
        kwargs["validation_proportion"] = 0.25
    whole = offline(cls, **kwargs).learn_offline(data(), 25)
    with pytest.raises(KeyboardInterrupt):
        offline(cls, **kwargs).learn_offline(data(), 25, Break(17), checkpoint=tmp_path, checkpoint_freq=10)
    np.random.seed(99)
    torch.manual_seed(99)
    on = offline(cls, **kwargs).learn_offline(data(), 25, checkpoint=tmp_path, checkpoint_freq=10)
    assert on.num_timesteps == on._n_offline_updates == 25 and not differing(state(whole), state(on))


def test_a_folder_of_another_data_set_or_kind_of_training_is_refused(tmp_path: Path) -> None:
    offline(SAC, vec()).learn_offline(data(), 4, checkpoint=tmp_path / "a", checkpoint_freq=2)
    with pytest.raises(ValueError, match=r"dataset=Dataset\(200 transitions, sha256 .*was made with dataset=Dataset\("):
        offline(SAC, vec()).learn_offline(data(seed=1), 8, checkpoint=tmp_path / "a")
    with pytest.raises(ValueError, match=r"a training on a data set \(learn_offline\), and this is one in an environ"):
        offline(SAC, vec()).learn(8, checkpoint=tmp_path / "a")
    offline(SAC, vec()).learn(4, checkpoint=tmp_path / "b")
    with pytest.raises(ValueError, match=r"a training in an environment \(learn\), and this is one on a data set"):
        offline(SAC, vec()).learn_offline(data(), 4, checkpoint=tmp_path / "b")


def test_normalisation_is_that_of_the_environment() -> None:
    venv = VecNormalize(vec(), norm_reward=True, gamma=0.9)
    venv.reset()
    for _ in range(30):
        venv.step(np.zeros((1, 2)))
    model, transitions = offline(SAC, venv), data()
    with model._learning_from(transitions):
        np.random.seed(0)
        batch = model._source.sample(16)
    np.random.seed(0)
    raw = transitions.take(torch.from_numpy(np.random.randint(0, 200, 16)))
    np.testing.assert_array_equal(batch.observations, venv.normalize_obs(raw.observations.numpy()))
    np.testing.assert_array_equal(batch.next_observations, venv.normalize_obs(raw.next_observations.numpy()))
    np.testing.assert_allclose(batch.rewards, venv.normalize_reward(raw.rewards.numpy()), rtol=1e-6)
    assert not torch.equal(batch.observations, raw.observations)


@pytest.mark.parametrize("kwargs", [{"norm_reward": False}, {"norm_obs": False}])
def test_a_normalisation_without_statistics_is_refused(kwargs: dict[str, Any]) -> None:
    """It would clip the numbers as they are."""
    venv = VecNormalize(vec(), gamma=0.9, **kwargs)
    venv.reset()
    model = offline(SAC, venv)
    with pytest.raises(ValueError, match="VecNormalize has no statistics yet, .* load saved ones"):
        model.learn_offline(data(), 1)
    venv.training = False
    for _ in range(2):
        with pytest.raises(ValueError, match="VecNormalize has no statistics yet"):
            model.learn_offline(data(), 1)
        venv.step(np.zeros((1, 2)))
    venv.training = True
    venv.step(np.zeros((1, 2)))
    assert model.learn_offline(data(), 1)._n_updates == 1


def test_transitions_held_out_are_never_trained_on() -> None:
    transitions = data()
    model = offline(VPLSAC, vec(), validation_proportion=0.25)
    with model._learning_from(transitions):
        source = model._source
        trained = {row.item() for batch in source.batches(40, 64) for row in batch.rewards}
        held = {row.item() for _ in range(300) for row in source.held_out().rewards}
    assert len(trained) == 150 and len(held) == 50 and not trained & held


def test_images_with_their_channels_last_are_refused_before_anything_learns() -> None:
    space = spaces.Box(0, 255, (40, 40, 3), np.uint8)
    images = np.random.default_rng(0).integers(0, 256, (20, 40, 40, 3)).astype(np.uint8)
    given: Any = (np.zeros((20, 1)), np.zeros(20), np.arange(20) == 9, np.arange(20) == 19)
    turned = np.moveaxis(images, -1, 1)
    data = Dataset.from_arrays(images, *given, next_observations=images, observation_space=space)
    model = BC("CnnPolicy", None, compile=False, batch_size=4)
    with pytest.raises(
        ValueError, match=r"dataset must have images in observations with their channels first.*moveaxis"
    ):
        model.learn_offline(data, 1)
    first = spaces.Box(0, 255, (3, 40, 40), np.uint8)
    model.learn_offline(Dataset.from_arrays(turned, *given, next_observations=turned, observation_space=first), 1)


@pytest.mark.parametrize("shape", [(12, 10, 10), (16, 8, 8), (3, 40, 40)])
def test_more_channels_than_pixels_are_not_taken_for_channels_last(shape: tuple[int, ...]) -> None:
    space = spaces.Box(0, 255, shape, np.uint8)
    images = np.random.default_rng(0).integers(0, 256, (21, *shape)).astype(np.uint8)
    data = Dataset.from_arrays(
        images[:-1], np.zeros((20, 1)), np.zeros(20), np.arange(20) == 9, np.arange(20) == 19,
        next_observations=images[1:], observation_space=space,
    )  # fmt: skip
    assert BC("MlpPolicy", None, compile=False, batch_size=4, policy_kwargs={"net_arch": [4]}).learn_offline(data, 1)
