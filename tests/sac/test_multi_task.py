"""Agents of several tasks: what networks read, pace, temperatures by task, files, logs, evaluation by task."""

import functools
import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.her import HerReplayBuffer

from sb3_sample import Dataset, DiagnosticsCallback, MultiTaskEvalCallback, evaluate_tasks, multi_task_env, study
from sb3_sample.learner.batch import Batch, Noise
from sb3_sample.learner.group import LearnerGroup
from sb3_sample.learner.reward_scale import TaskScale
from sb3_sample.learner.scalars import TaskLogScalar
from sb3_sample.learner.target import next_step
from sb3_sample.learner.transforms import BatchTransform
from sb3_sample.networks import MLP, BroNet, Network, widened
from sb3_sample.sac import BRC, BRO, SAC, BROFast
from sb3_sample.sac.multi_task import TaskEmbedding, TaskOneHot
from tests.sac.common import COMPILES, MAKERS, Toy, bro, differing, sac, sampled, state, vec
from tests.sac.test_execution import captured

ROOT = Path(__file__).parents[2]
PENDULUM, CAR = "Pendulum-v1", "MountainCarContinuous-v0"
#: A Dict that tells no task.
GOALS = spaces.Dict({name: spaces.Box(-10, 10, (3,), np.float32) for name in ("observation", "goal")})
#: Of episodes of eight steps.
SHORT = {"max_episode_steps": 8}
#: Agents of each kind of network and explorer.
WITH_TASKS = (
    "BRC", "BRO", "SAC", "SimBa", "DebiasedRQ", "SimbaV2", "XQC", "CrossQ", "CrossQ+WN", "FlashSAC", "DAC", "OAC",
)  # fmt: skip


def tasks(*ids: str, seed: int = 0) -> Any:
    return multi_task_env(ids or (PENDULUM, CAR), seed=seed, env_kwargs=SHORT)


def make(name: str, env: Any = None, policy: str = "MultiInputPolicy", **kwargs: Any) -> Any:
    return MAKERS[name](tasks() if env is None else env, policy=policy, **kwargs)


def told(task: Any, n: int | None = None) -> dict[str, Any]:
    shape = (3,) if n is None else (n, 3)
    return {"observation": np.linspace(-1, 1, 3 * (n or 1), dtype=np.float32).reshape(shape), "task": task}


# ---------------------------------------------------------------- one task


@pytest.mark.parametrize("policy", [pytest.param("MlpPolicy", marks=pytest.mark.slow), "MultiInputPolicy"])
@pytest.mark.parametrize("name", sampled(WITH_TASKS, ("BRC", "DebiasedRQ")))
def test_one_task_is_single_task_bit_by_bit(name: str, policy: str) -> None:
    """Nothing is appended and nothing widened, whatever is asked of several tasks."""
    single = make(name, make_vec_env(PENDULUM, seed=0, env_kwargs=SHORT), "MlpPolicy").learn(40)
    asked: dict[str, Any] = {} if name == "BRC" else {"multitask": True}
    if name != "DebiasedRQ":
        asked |= {"task_temperatures": True, "target_entropy": [single.target_entropy]}
    multi = make(name, tasks(PENDULUM), policy, **asked).learn(40)
    # DR.Q's random steps include the ends of episodes.
    assert multi._n_updates == single._n_updates == (31 if name == "DebiasedRQ" else 30)
    assert len(state(single)) > 30 and not differing(state(multi), state(single))
    single_action, _ = single.predict(told(0)["observation"], deterministic=True)
    assert np.array_equal(multi.predict(told(0), deterministic=True)[0], single_action)


# ---------------------------------------------------------------- what networks read


def test_the_multitask_bro_reads_the_one_hot_vector_and_is_twice_as_wide() -> None:
    model = BRO(
        "MultiInputPolicy", tasks(), model_size=(1, 8), n_quantiles=5, multitask=True, buffer_size=100, device="cpu"
    )
    plain = BRO("MultiInputPolicy", tasks(), model_size=(1, 8), n_quantiles=5, buffer_size=100, device="cpu")
    for each, width, of_actors in ((model, 16, 512), (plain, 8, 256)):
        assert isinstance(each.critic.features_extractor, TaskOneHot)
        for trunk, size in (
            (each.critic.trunk, width),
            (each.critic_target.trunk, width),
            (each.actor.trunk, of_actors),
            (each.explorer.trunk, of_actors),
        ):
            assert isinstance(trunk, BroNet) and trunk.out_features == size and len(trunk.blocks) == 1
        # Observation of 3 and two tasks; beside the action, or the actor's mean, of 1.
        assert each.actor.trunk.dense.in_features == 5
        assert each.critic.trunk.dense.in_features == each.explorer.trunk.dense.in_features == 6
    observations, _ = model.policy.obs_to_tensor(told(np.array([0, 1]), 2))
    features = model.actor.features(observations)
    assert features[:, :3].numpy().tolist() == told(0, 2)["observation"].tolist()
    assert features[:, 3:].tolist() == [[1, 0], [0, 1]]


def test_one_running_norm_is_of_the_observations_of_all_tasks(tmp_path: Path) -> None:
    model = make("SimbaV2").learn(40)
    norm = model.learner.observation_norm
    # Of 20 steps of each task, without the first observation.
    assert norm.mean.shape == (3,) and norm.count.item() == pytest.approx(2 * 19, abs=1e-3)
    seen = model.policy.obs_to_tensor(told(np.array([0, 1]), 2))[0]
    expected = (seen["observation"] - norm.mean) / (norm.var + 1e-8).sqrt()
    features = model.actor.features(seen)
    torch.testing.assert_close(features[:, :3], expected.float())
    assert features[:, 3:].tolist() == [[1, 0], [0, 1]]
    model.save(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m", env=tasks())
    assert not differing(state(model), state(loaded)) and loaded.learn(10, reset_num_timesteps=False)._n_updates > 0
    model.policy.save(tmp_path / "p")
    action, _ = type(model.policy).load(tmp_path / "p").predict(told(np.array([0, 1]), 2), deterministic=True)
    assert np.array_equal(action, model.predict(told(np.array([0, 1]), 2), deterministic=True)[0])


def test_every_algorithm_can_be_widened() -> None:
    """The actors of MLPs and of TD3, the optimistic actor of DAC; a network without a width says so."""
    for name, trunks in (("SAC", "actor critic"), ("DAC", "actor critic"), ("BROTD3", "actor critic")):
        model = make(name, multitask=True)
        for trunk in trunks.split():
            assert getattr(model, trunk).trunk.out_features == 16
    assert make("DAC", multitask=True).explorer.actor.trunk.out_features == 16
    assert make("BROTD3", multitask=True).policy.actor_target.trunk.out_features == 16
    plain, model = make("DebiasedRQ"), make("DebiasedRQ", multitask=True)
    for trunk in ["actor", "critic"]:
        assert getattr(model, trunk).trunk.out_features == 2 * getattr(plain, trunk).trunk.out_features
    model = make("BRC", multitask=True)
    assert isinstance(model.critic.features_extractor, TaskOneHot) and model.critic.trunk.out_features == 16
    assert isinstance(make("BRC").critic.features_extractor, TaskEmbedding)
    with pytest.raises(ValueError, match="embedding_size=7 means nothing with multitask=True"):
        make("BRC", multitask=True, embedding_size=7)
    assert widened(MLP, {}, 2) == {"hidden_sizes": [512, 512]} and widened(MLP, {}, 1) == {}

    class Fixed(Network):
        def __init__(self, in_features: int, n_copies: int | None = None):
            super().__init__()

    with pytest.raises(ValueError, match="argument width or hidden_sizes, and Fixed has neither"):
        widened(Fixed, {}, 2)


# ---------------------------------------------------------------- pace


def test_replay_ratio_and_resets_count_the_steps_of_each_task() -> None:
    model = make("SAC", tasks(PENDULUM, CAR, seed=0), replay_ratio=2, learning_starts=10, resets=(15,))
    model.learn(48)
    # 24 steps of each task, of which six (more than ten transitions) come before the first gradient steps.
    assert model.num_transitions == 48 and model._n_updates == 2 * (24 - 5)
    assert model.plasticity.n_done == 1 and model.plasticity._reached == 24
    # A single environment that has one task after the other takes a step of one task at a time.
    space = spaces.Dict({"observation": spaces.Box(-10, 10, (3,), np.float32), "task": spaces.Discrete(2)})
    model = make("SAC", vec(obs_space=space), replay_ratio=2, learning_starts=10)
    model.learn(24)
    assert model._n_updates == 2 * (24 - 10)


def test_steps_of_each_task_are_saved(tmp_path: Path) -> None:
    """A loaded model is as far as it was, before it has taken a step and with another number of environments too."""
    model = make("BRO", learning_starts=10, resets=(40,)).learn(48)
    assert model.num_task_steps == 24 and model.plasticity.n_done == 0
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    for env in tasks(), None:
        loaded = BRO.load(tmp_path / "m", env=env)
        if env is not None:
            loaded.load_replay_buffer(tmp_path / "b")
            loaded.set_logger(configure(None, []))
            loaded.train(1)
        assert loaded.learner.environment_steps == 24 and loaded.plasticity.n_done == 0
    assert model.learner.state_dict()["counts"]["num_task_steps"] == 24


# ---------------------------------------------------------------- temperatures


def test_rewards_are_scaled_by_task_by_name_and_class() -> None:
    class Mine(TaskScale):
        pass

    for rule in ("brc", TaskScale, Mine):
        assert make("BRC", reward_scale=rule).reward_scaler.divisors.shape == (2,)


def test_one_observation_is_a_batch_if_only_its_task_is_a_number() -> None:
    learner = make("BRC").learner
    rows = torch.zeros(1, *learner.networks.observation_space["observation"].shape)
    for task in (np.array(1), np.array([1])):
        assert learner.act({"observation": rows.numpy(), "task": task}).shape == (1, learner.actor.action_dim)
    assert learner.act({"observation": rows[0].numpy(), "task": np.array(1)}).shape == (learner.actor.action_dim,)


def batch_of(model: Any, n: int = 6, seed: int = 0) -> Any:
    """A random batch whose tasks are 0 and 1, unequally often."""
    generator = torch.Generator().manual_seed(seed)
    random = {name: torch.randn(n, 3, generator=generator) for name in ("observations", "next_observations")}
    task = torch.tensor([[0], [1], [1], [0], [1], [1]])
    model.learn(30)
    batch = next(iter(model._source.batches(1, n)))
    return batch._replace(**{name: {"observation": value, "task": task} for name, value in random.items()})


def test_temperatures_are_set_one_by_one_or_all_at_once() -> None:
    model = make("SAC", task_temperatures=True)
    model.log_ent_coef = [-1.0, -2.0]
    model.log_ent_coef = model.log_ent_coef
    assert model.log_ent_coef is model.temperature.log_value and model.log_ent_coef.tolist() == [-1.0, -2.0]
    model.log_ent_coef = -3
    assert model.log_ent_coef.tolist() == [-3.0, -3.0]
    for value, words in (
        ([1.0, 2.0, 3.0], "a number for each of the 2 tasks, or one for"),
        ([0.0, math.nan], "finite"),
    ):
        with pytest.raises(ValueError, match=f"log_ent_coef must be {words}"):
            model.log_ent_coef = value
    with pytest.raises(ValueError, match="log_ent_coef must be one number"):
        make("SAC").log_ent_coef = [1.0, 2.0]


@pytest.mark.parametrize("target_entropy", ["auto", [-0.25, -2.0]])
def test_temperatures_by_task_by_hand(target_entropy: Any) -> None:
    model = make("SAC", task_temperatures=True, ent_coef="auto_0.5", target_entropy=target_entropy)
    batch = batch_of(model)
    learner, temperature = model.learner, model.temperature
    assert isinstance(temperature, TaskLogScalar) and model.log_ent_coef is temperature.log_value
    with torch.no_grad():
        temperature.log_value.copy_(torch.tensor([math.log(0.2), math.log(3.0)]))
    alphas = torch.tensor([[0.2], [3.0]])[batch.observations["task"][:, 0]]
    targets = torch.tensor([-0.5, -0.5] if target_entropy == "auto" else target_entropy)
    targets = targets[batch.observations["task"]]
    torch.testing.assert_close(learner.temperature_of(batch), alphas)
    noise = torch.randn(6, 1, generator=torch.Generator().manual_seed(1))

    # The TD target's bonus.
    action, bonus = next_step(learner, batch, learner.temperature_of(batch), noise)
    same_action, log_prob = learner.next_actions(batch.next_observations, noise)
    assert torch.equal(action, same_action)
    torch.testing.assert_close(bonus, -alphas * log_prob)

    # The loss, and its gradient, which is each task's own.
    _, log_prob = model.actor.sample(batch.observations, noise)
    excess = -log_prob.detach() - targets
    metrics = learner.step(batch, Noise(noise, noise, noise), eager=True)
    assert metrics["train/ent_coef_loss"].item() == pytest.approx((alphas * excess).mean().item(), rel=1e-5)
    assert metrics["train/ent_coef"].item() == pytest.approx(alphas.mean().item(), rel=1e-5)
    of_task = [(alphas * excess)[batch.observations["task"] == k].sum() / 6 for k in range(2)]
    torch.testing.assert_close(temperature.log_value.grad, torch.stack(of_task), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("k", "m"), [(3, 1), (1, 2), (2, 3)])
def test_copies_of_transitions_have_the_temperatures_of_their_tasks(k: int, m: int) -> None:
    """Equal copies with equal noise have the target of one, and ``m`` times its loss."""

    class Copies(BatchTransform):
        target_copies, online_copies = k, m

        def transform(self, batch: Batch, noise: Any) -> Batch:
            return batch

    noise = torch.randn(6, 1, generator=torch.Generator().manual_seed(1))
    steps = []
    for transforms, n in ([], 1), ([Copies], k):
        model = make("SAC", task_temperatures=True, batch_transforms=transforms)
        batch = batch_of(model)
        # Both models and both batches alike, whatever they have learned.
        torch.manual_seed(0)
        with torch.no_grad():
            for parameter in model.policy.parameters():
                parameter.normal_(0, 0.3)
            model.temperature.log_value.copy_(torch.tensor([math.log(0.2), math.log(3.0)]))
        batch = batch._replace(actions=batch.actions * 0, rewards=batch.rewards * 0, dones=batch.dones * 0)
        steps.append(model.learner.step(batch, Noise(noise.repeat(n, 1), noise, noise), eager=True))
    one, copies = steps
    assert copies["train/critic_loss"].item() == pytest.approx(m * one["train/critic_loss"].item(), rel=1e-4)
    assert copies["train/ent_coef_loss"].item() == pytest.approx(one["train/ent_coef_loss"].item(), rel=1e-4)


def test_the_actors_loss_weighs_each_tasks_entropy() -> None:
    model = make("SAC", task_temperatures=True)
    batch = batch_of(model)
    with torch.no_grad():
        model.temperature.log_value.copy_(torch.tensor([math.log(0.2), math.log(3.0)]))
    noise = torch.randn(6, 1, generator=torch.Generator().manual_seed(1))
    # With the critics after their step, and the actor and temperatures before theirs.
    model.policy_delay = model.learner.policy_delay = 10**9
    model.learner.step(batch, Noise(noise, noise, noise), eager=True)
    actions, log_prob = model.actor.sample(batch.observations, noise)
    value = model.critic.q_values(batch.observations, actions).amin(dim=0)
    alphas = torch.tensor([[0.2], [3.0]])[batch.observations["task"][:, 0]]
    expected = (alphas * log_prob).mean().item() - value.mean().item()
    rate = model.critic.optimizer.param_groups[0]
    rate["lr"] = 0.0
    model.learner.policy_delay = 1
    metrics = model.learner.step(batch, Noise(noise, noise, noise), eager=True)
    assert metrics["train/actor_loss"].item() == pytest.approx(expected, rel=1e-5)
    # As published, there is one temperature for both.
    assert make("SAC").temperature().shape == () and model.temperature().shape == (2,)


@pytest.mark.parametrize("name", ["SAC", "BRC"])
def test_features_from_before_the_step_keep_the_temperatures_of_the_tasks(name: str) -> None:
    """With critics that stay as they are, features from before and after their step are the same."""
    generator, found = torch.Generator().manual_seed(0), []
    task = torch.tensor([[0], [1], [1], [0], [1], [1]])
    now, following = ({"observation": torch.randn(6, 3, generator=generator), "task": task} for _ in range(2))
    noise = torch.randn(6, 1, generator=generator)
    batch = Batch(now, noise.tanh(), following, torch.zeros(6, 1), noise.cos())
    for features in ("after", "before"):
        kwargs = {**make(name).policy_kwargs, "actor_features": features, "share_features_extractor": True}
        model = make(name, task_temperatures=True, target_entropy=[-1.0, 3.0], policy_kwargs=kwargs)
        with torch.no_grad():
            model.temperature.log_value.copy_(torch.tensor([math.log(0.2), math.log(3.0)]))
        model.critic.optimizer.param_groups[0]["lr"] = 0.0
        metrics = model.learner.step(batch, Noise(noise, noise, noise), eager=True)
        found.append({**metrics, **state(model)})
    assert not differing(*found)


def test_rewards_are_divided_by_each_tasks_temperature_and_target() -> None:
    model = make("BRC", task_temperatures=True, target_entropy=np.array([-1.0, -3.0])).learn(30)
    assert model.target_entropy == [-1.0, -3.0]
    scaler = model.reward_scaler
    with torch.no_grad():
        model.temperature.log_value.copy_(torch.tensor([math.log(0.2), math.log(3.0)]))
    scaler.before_updates(model.learner)
    size = torch.maximum(scaler.largest, scaler.smallest.abs()).double()
    assert size.isfinite().all()
    expected = (size - torch.tensor([0.2, 3.0]) * torch.tensor([-1.0, -3.0]) / (2 * 0.01)) / 10
    torch.testing.assert_close(scaler.divisors, expected, rtol=1e-5, atol=0)


@pytest.mark.slow
@COMPILES
def test_compiled_as_eager() -> None:
    found = []
    for compile in (False, True):
        # Few steps: sooner or later, rounding puts an input of a ReLU on its other side.
        model = make("BRC", task_temperatures=True, target_entropy=[-1.0, -0.5], compile=compile).learn(24)
        assert model._n_updates == 7
        found.append(state(model))
    assert found[0].keys() == found[1].keys()
    for name, value in found[0].items():
        torch.testing.assert_close(found[1][name], value, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("how", [pytest.param("compiled", marks=[COMPILES, pytest.mark.slow]), "captured"])
@pytest.mark.parametrize("targets", [(-0.5, [-5.0, 3.0]), ([-5.0, 3.0], 2.0), ([-5.0, 3.0], [1.0, -1.0])])
def test_target_entropies_changed_on_the_way_count(how: str, targets: tuple[Any, Any]) -> None:
    """From one for all tasks to one for each, back, and from one for each to others."""
    found = []
    for run in (how, "eager", "unchanged"):
        kwargs = {"learning_rate": 1e-2, "compile": run == "compiled", "learning_starts": 10}
        model = make("SAC", task_temperatures=True, target_entropy=targets[0], **kwargs)
        recorder = captured(model) if run == "captured" else None
        model.learn(30)
        model.target_entropy = targets[0 if run == "unchanged" else 1]
        model.learn(20, reset_num_timesteps=False)
        found.append(model.log_ent_coef.detach())
        assert recorder is None or recorder.n_repetitions > 10
    assert (found[0] - found[1]).abs().max() < 1e-4 < (found[1] - found[2]).abs().min()


def test_learners_of_a_group_agree_in_the_target_entropies() -> None:
    def group_of(*targets: Any) -> tuple[LearnerGroup, list[Any]]:
        models = [make("SAC", task_temperatures=True, target_entropy=each, compile=False) for each in targets]
        return LearnerGroup([model.learner for model in models]), models

    with pytest.raises(ValueError, match="learners must agree in target_entropy where each task has its own"):
        group_of([-1.0, -3.0], [-1.0, -2.0])
    group, models = group_of(-0.5, -0.75)
    models[0].learner.set_target_entropy([-1.0, -3.0])
    with pytest.raises(ValueError, match="learners must agree in target_entropy where each task has its own"):
        group._take_changes()
    models[1].learner.set_target_entropy([-1.0, -3.0])
    group._take_changes()
    for model in models:
        model.learner.set_target_entropy(-0.5)
    group._take_changes()


# ---------------------------------------------------------------- predict


def test_predict_is_told_the_task() -> None:
    model = make("BRC")
    actions = [model.predict(told(task), deterministic=True)[0] for task in (0, 1)]
    assert actions[0].shape == (1,) and not np.array_equal(*actions)
    batch, _ = model.predict(told(1, 4), deterministic=True)
    each, _ = model.predict(told(np.array([1, 1, 1, 1]), 4), deterministic=True)
    assert batch.shape == (4, 1) and np.array_equal(batch, each)
    single, _ = model.predict(told(np.array([[1]])), deterministic=True)
    assert single.shape == (1,)
    one_of_batch, _ = model.predict(told(np.array([1]), 1), deterministic=True)
    assert one_of_batch.shape == (1, 1)
    for tasks_told, n in ((np.array([1, 1]), 4), (np.array([1, 1]), None), (np.ones((4, 1), int), 4)):
        with pytest.raises(
            ValueError, match="(must have one task, or one each|one observation has one task), not tasks of the shape"
        ):
            model.predict(told(tasks_told, n))
    for task in (2, -1, 1.0, "car"):
        with pytest.raises(ValueError, match="task of an observation must be its number, an integer from 0 to 1, not"):
            model.predict(told(task))
    with pytest.raises(ValueError, match=r"entries 'observation' and 'task', not \['observation'\]"):
        model.predict({"observation": told(0)["observation"]})
    with pytest.raises(ValueError, match=r"must be a dict with the keys \['observation', 'task'\], not a ndarray"):
        model.predict(told(0)["observation"])


class FromFive(gym.ObservationWrapper):
    """Two tasks, numbered 5 and 6."""

    def __init__(self) -> None:
        super().__init__(Toy())
        self.observation_space = spaces.Dict({"observation": self.env.observation_space, "task": TASKS_FROM_FIVE})

    def observation(self, observation: Any) -> Any:
        return {"observation": observation, "task": 5 + int(observation[0]) % 2}


TASKS_FROM_FIVE = spaces.Discrete(2, start=5)


def test_tasks_that_do_not_count_from_0() -> None:
    env = DummyVecEnv([lambda: Monitor(FromFive())])
    model = make("SAC", env, learning_starts=4).learn(12)
    vector = np.ones(3, np.float32)
    actions = [model.predict({"observation": vector, "task": task}, deterministic=True)[0] for task in (5, 6)]
    assert not np.array_equal(*actions)
    for task in (0, 1, 4, 7):
        with pytest.raises(ValueError, match="an integer from 5 to 6, not"):
            model.predict({"observation": vector, "task": task})
    for name, kwargs in ("BRC", {}), ("SAC", {"reward_scale": "brc"}), ("SAC", {"task_temperatures": True}):
        with pytest.raises(ValueError, match="needs tasks that count from 0, not Discrete"):
            make(name, env, **kwargs)
    make("BRC", env, reward_scale=None, learning_starts=4).learn(12)


# ---------------------------------------------------------------- files


def test_one_model_is_saved_and_loaded(tmp_path: Path) -> None:
    model = make("BRC", task_temperatures=True, target_entropy=[-1.0, -0.5]).learn(40)
    model.save(tmp_path / "model")
    loaded = BRC.load(tmp_path / "model", env=tasks())
    assert not differing(state(model), state(loaded)) and loaded.target_entropy == [-1.0, -0.5]
    assert loaded.learner.target_entropy.tolist() == [-1.0, -0.5]
    loaded.learn(20)
    alone = BRC.load(tmp_path / "model")
    for task in (0, 1):
        expected, _ = model.predict(told(task), deterministic=True)
        assert np.array_equal(alone.predict(told(task), deterministic=True)[0], expected)
    bro(tasks(), policy="MultiInputPolicy", multitask=True).learn(30).save(tmp_path / "bro")
    assert BRO.load(tmp_path / "bro").critic.trunk.out_features == 16


def test_tasks_keep_their_numbers(tmp_path: Path) -> None:
    """Spaces are the same in another order, and each task would have the other's embedding, one-hot and scale."""
    model = make("BRC").learn(20)
    model.save(tmp_path / "model")
    assert model.task_ids == [PENDULUM, CAR]
    words = rf"must have the model's tasks in their order, \['{PENDULUM}', '{CAR}'\], not \['{CAR}', '{PENDULUM}'\]"
    with pytest.raises(ValueError, match=f"^env {words}.*'{CAR}' was 1"):
        BRC.load(tmp_path / "model", env=tasks(CAR, PENDULUM))
    loaded = BRC.load(tmp_path / "model")
    for refused in (model.set_env, loaded.set_env, lambda env: evaluate_tasks(model, env)):
        with pytest.raises(ValueError, match=f"^env {words}"):
            refused(tasks(CAR, PENDULUM))
    with pytest.raises(ValueError, match=f"^eval_env {words}"):
        model.learn(2, callback=MultiTaskEvalCallback(tasks(CAR, PENDULUM)))
    loaded.set_env(tasks())
    other = "Pendulum-v1000"
    gym.register(other, "gymnasium.envs.classic_control:PendulumEnv", max_episode_steps=8)
    try:
        with pytest.warns(UserWarning, match=rf"env has the tasks \['{other}', '{CAR}'\], numbered as those that"):
            loaded = BRC.load(tmp_path / "model", env=tasks(other, CAR))
    finally:
        del gym.registry[other]
    assert loaded.task_ids == [other, CAR]
    assert sac().task_ids is None


@pytest.mark.parametrize("name", ["BRC", "BRO", "VPLSAC"])
def test_goes_on_bit_by_bit(name: str, tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"task_temperatures": True, "multitask": name == "BRO"}

    def run(folder: Path, stop: int = 10**9) -> Any:
        model = make(name, tasks(seed=3), **arguments)
        evaluation = MultiTaskEvalCallback(
            tasks(seed=9), eval_freq=8, n_eval_episodes=2, log_path=folder / "log", verbose=0
        )
        stopping = ConvertCallback(lambda *_: model.num_timesteps < stop)
        model.learn(64, callback=[evaluation, stopping], checkpoint=folder, checkpoint_freq=16)
        return model, evaluation

    whole, evaluation = run(tmp_path / "a")
    run(tmp_path / "b", stop=44)
    again, evaluation_again = run(tmp_path / "b")
    assert whole._n_updates == again._n_updates > 20 and not differing(state(whole), state(again))
    assert evaluation.evaluations_timesteps == evaluation_again.evaluations_timesteps == [0, 8, 16, 24, 32]
    assert evaluation.evaluations_results == evaluation_again.evaluations_results
    first, second = (study.read(tmp_path / run / "log") for run in "ab")
    assert first.equals(second) and set(first["task"]) == {PENDULUM, CAR}


def test_an_evaluation_before_the_first_step_outlives_a_kill(tmp_path: Path) -> None:
    """The run is cut off before the first evaluation that follows."""

    class Counting(BaseCallback):
        def _on_step(self) -> bool:
            return True

    def run(stop: int = 10**9) -> Any:
        model = make("SAC", tasks(seed=3))
        evaluation = MultiTaskEvalCallback(
            tasks(seed=9), Counting(), Counting(), eval_freq=20, n_eval_episodes=1, verbose=0, log_path=tmp_path
        )
        stopping = ConvertCallback(lambda *_: model.num_timesteps < stop)
        model.learn(48, callback=[evaluation, stopping], checkpoint=tmp_path, checkpoint_freq=8)
        return evaluation

    first = run(stop=20)
    assert first.evaluations_timesteps == [0]
    again = run()
    assert again.evaluations_timesteps == [0, 20] and again.evaluations_results[0] == first.evaluations_results[0]
    assert again.best_mean_reward >= first.best_mean_reward
    assert again.callback.n_calls == 2 and again.callback_on_new_best.n_calls >= 1
    assert study.read(tmp_path)["step"].tolist() == [0, 20] * 2


@pytest.mark.slow
def test_exported(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    model = make("BRC").learn(30)
    onnx, _ = model.export(tmp_path / "policy")
    inputs = {"observation": told(0, 4)["observation"], "task": np.array([0, 1, 0, 1])}
    (found,) = runtime.InferenceSession(onnx).run(None, inputs)
    np.testing.assert_allclose(found, model.predict(inputs, deterministic=True)[0], rtol=1e-4, atol=1e-5)


# ---------------------------------------------------------------- logs and evaluation


def test_the_log_has_each_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = make("SAC")
    model.set_logger(configure(str(tmp_path), ["json", "stdout"]))
    model.learn(64)
    lines = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    returns = {name: value for name, value in lines[-1].items() if name.startswith("rollout_return/")}
    assert returns.keys() == {f"rollout_return/{PENDULUM}", f"rollout_return/{CAR}"}
    for task_id in (PENDULUM, CAR):
        its = [each["r"] for each in model.ep_info_buffer if each["task"] == task_id]
        assert len(its) == 4 and returns[f"rollout_return/{task_id}"] == pytest.approx(np.mean(its))
    assert "rollout_return" not in capsys.readouterr().out


class ByTask:
    """Successful where the action has the sign of the task."""

    def predict(self, observation: Any, **_: Any) -> Any:
        return np.where(observation["task"] == 1, 1.0, -1.0)[:, None], None


def test_evaluation_by_task() -> None:
    env = tasks(seed=5)
    found = evaluate_tasks(ByTask(), env, n_eval_episodes=3)
    assert list(found) == [PENDULUM, CAR]
    assert all(each.lengths == [8] * 3 and each.successes == [] for each in found.values())
    assert found[CAR].success_rate is None
    # A force of 1 costs 0.1 a step.
    assert found[CAR].returns == pytest.approx([-0.8] * 3)
    alone: Any = make_vec_env(PENDULUM, seed=5, env_kwargs=SHORT)
    alone.reset()
    returns = [sum(alone.step(np.array([[-2.0]]))[1][0] for _ in range(8)) for _ in range(3)]
    assert found[PENDULUM].returns == pytest.approx(returns, rel=1e-4)
    assert found[PENDULUM].mean_return == pytest.approx(np.mean(returns), rel=1e-4)


def test_evaluations_from_a_data_set_are_at_gradient_steps(tmp_path: Path) -> None:
    data = Dataset.from_replay_buffer(make("SAC").learn(24).replay_buffer)
    callback = MultiTaskEvalCallback(tasks(seed=9), eval_freq=10, n_eval_episodes=1, log_path=tmp_path, verbose=0)
    make("SAC").learn_offline(data, 20, callback=callback)
    assert np.load(tmp_path / PENDULUM / "evaluations.npz")["timesteps"].tolist()[-2:] == [10, 20]


def test_a_later_training_in_the_same_folder_is_recorded_as_its_own(tmp_path: Path) -> None:
    for seed in (4, 5):
        callback = MultiTaskEvalCallback(tasks(seed=9), eval_freq=10, n_eval_episodes=1, log_path=tmp_path, verbose=0)
        make("SAC", seed=seed).learn(24, callback=callback)
    assert set(study.read(tmp_path)["seed"]) == {5}


def test_callback_logs_and_writes_what_a_study_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = make("BRC", seed=4)
    model.set_logger(configure(str(tmp_path / "logger"), ["json"]))
    callback = MultiTaskEvalCallback(
        tasks(seed=9),
        eval_freq=10,
        n_eval_episodes=2,
        log_path=tmp_path / "runs",
        best_model_save_path=tmp_path / "best",
    )
    model.learn(48, callback=callback)
    table = study.read(tmp_path / "runs")
    assert set(table["agent"]) == {"BRC"} and set(table["arguments"]) == {'{"n_tasks": 2}'}
    assert set(table["seed"]) == {4} and set(table["metric"]) == {"return"}
    for number, task_id in enumerate((PENDULUM, CAR)):
        its = table[table["task"] == task_id]
        # Steps of this task.
        assert its["step"].tolist() == [0, 10, 20]
        expected = [np.mean(each[number]) for each in callback.evaluations_results]
        assert its["value"].tolist() == pytest.approx(expected)
        assert callback.last_results[task_id].mean_return == pytest.approx(expected[-1])
    lines = [json.loads(line) for line in (tmp_path / "logger" / "progress.json").read_text().splitlines()]
    evaluated = [line for line in lines if f"eval_return/{CAR}" in line]
    assert [line["time/total_timesteps"] for line in evaluated] == [0, 20, 40]
    assert evaluated[-1][f"eval_return/{CAR}"] == pytest.approx(expected[-1])
    assert evaluated[-1]["eval/mean_reward"] == pytest.approx(callback.last_mean_reward)
    assert (tmp_path / "best" / "best_model.zip").exists()
    assert f"{PENDULUM}: return " in capsys.readouterr().out


@pytest.mark.parametrize("at_start", [True, False])
def test_the_callback_after_an_evaluation_is_started(at_start: bool) -> None:
    class After(BaseCallback):
        def _on_training_start(self) -> None:
            self.calls = [0]

        def _on_step(self) -> bool:
            self.calls.append(self.num_timesteps)
            return True

    after = After()
    evaluation = MultiTaskEvalCallback(
        tasks(seed=9), callback_after_eval=after, eval_freq=10, n_eval_episodes=1, verbose=0, at_start=at_start
    )
    make("SAC").learn(40, callback=evaluation)
    assert after.calls == [0, *([0] if at_start else []), 20, 40]


def test_runs_without_a_seed_are_numbered(tmp_path: Path) -> None:
    for name in "ab":
        callback = MultiTaskEvalCallback(tasks(seed=9), n_eval_episodes=1, log_path=tmp_path / name, verbose=0)
        make("SAC", seed=None).learn(4, callback=callback)
    assert sorted(set(study.read([tmp_path / "a", tmp_path / "b"])["seed"])) == [0, 1]


def test_successes_are_of_each_task(tmp_path: Path) -> None:
    pytest.importorskip("metaworld")
    ids = ("metaworld/reach-v3", "metaworld/push-v3")
    env = multi_task_env(ids, seed=0, env_kwargs={"max_episode_steps": 4})
    found = evaluate_tasks(_Zeros(), env, n_eval_episodes=2)
    assert [each.successes for each in found.values()] == [[False] * 2] * 2
    assert found[ids[0]].success_rate == 0.0
    callback = MultiTaskEvalCallback(env, n_eval_episodes=2, log_path=tmp_path, verbose=0)
    training = multi_task_env(ids, seed=1, env_kwargs={"max_episode_steps": 4})
    make("SAC", training).learn(8, callback=callback)
    assert set(study.read(tmp_path)["metric"]) == {"return", "success_rate"}


def test_steps_that_a_study_reads_are_the_simulators(tmp_path: Path) -> None:
    pytest.importorskip("dm_control")
    made = functools.partial(
        multi_task_env, ("dmc/cartpole-balance-v0", "dmc/cartpole-swingup-v0"), env_kwargs={"action_repeat": 250}
    )
    callback = MultiTaskEvalCallback(
        made(seed=9), n_eval_episodes=1, eval_freq=4, log_path=tmp_path, verbose=0, at_start=False
    )
    make("SAC", made(seed=0)).learn(8, callback=callback)
    rows = study.read(tmp_path)
    assert callback.evaluations_timesteps == [4] and set(rows["step"]) == {1_000}


class _Zeros:
    def predict(self, observation: Any, **_: Any) -> Any:
        return np.zeros((len(observation["task"]), 4)), None


# ---------------------------------------------------------------- what goes together, and what does not


def test_validation_goes_with_tasks() -> None:
    model = make("VPLSAC").learn(60)
    assert model._n_updates > 10 and model.replay_buffer.n_validation > 0


@pytest.mark.parametrize(
    ("name", "kwargs", "words"),
    [
        ("SAC", {"env": vec(), "policy": "MlpPolicy", "multitask": True}, "multitask=True needs .* multi_task_env do"),
        ("SAC", {"env": vec(), "policy": "MlpPolicy", "task_temperatures": True}, "task_temperatures=True needs"),
        ("SAC", {"multitask": 2}, "multitask must be True or False, not 2"),
        ("SAC", {"task_temperatures": True, "ent_coef": 0.1}, "task_temperatures=True learns .* ent_coef=0.1 fixes"),
        ("BROTD3", {"task_temperatures": True}, "task_temperatures=True .*backbone='td3'"),
        ("SAC", {"target_entropy": [-1.0, -2.0]}, "with task_temperatures=True one for each of the 2 tasks, not"),
        ("SAC", {"target_entropy": [-1.0], "task_temperatures": True}, "one for each of the 2 tasks, not"),
        ("SAC", {"target_entropy": [-1.0, math.inf], "task_temperatures": True}, "a task must be finite, not inf"),
        ("SAC", {"target_entropy": [-1.0, "x"], "task_temperatures": True}, "target_entropy of a task must be a num"),
        ("SAC", {"replay_buffer_class": HerReplayBuffer}, "replay_buffer_class=HerReplayBuffer needs .*desired_goal"),
        ("SAC", {"policy_kwargs": {"width_factor": 2}}, "width_factor is an argument of the algorithm"),
        ("SAC", {"policy": "CnnPolicy"}, "CnnPolicy"),
        ("SAC", {"n_steps": 3}, "n_steps=3 is not supported with Dict"),
        (
            "SimBa",
            {"env": vec(obs_space=GOALS)},
            r"needs observations of a Box of floats, .*VecNormalize\(env, norm_obs_keys=\['goal', 'observation'\]\)",
        ),
        (
            "SimBa",
            {"env": vec(obs_space=spaces.Discrete(3)), "policy": "MlpPolicy"},
            r"needs observations of a Box of floats, not of Discrete\(3\): pass normalize_observations=False$",
        ),
    ],
)
def test_refused(name: str, kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises((ValueError, AssertionError), match=words):
        make(name, **kwargs)


def test_callbacks_of_one_task_and_of_another_are_refused() -> None:
    with pytest.raises(ValueError, match="eval_env must be of multi_task_env, whose environments have a task_id"):
        MultiTaskEvalCallback(make_vec_env(PENDULUM))
    with pytest.raises(ValueError, match="env must be of multi_task_env"):
        evaluate_tasks(ByTask(), DummyVecEnv([lambda: vec().envs[0]]))
    with pytest.raises(ValueError, match="eval_freq must be an integer of at least 1, not 0"):
        MultiTaskEvalCallback(tasks(), eval_freq=0)
    with pytest.raises(ValueError, match="n_eval_episodes must be an integer of at least 1, not 0"):
        evaluate_tasks(ByTask(), tasks(), n_eval_episodes=0)
    with pytest.raises(ValueError, match="eval_env has the observation_space"):
        sac(tasks(), policy="MultiInputPolicy").learn(2, callback=MultiTaskEvalCallback(tasks(PENDULUM)))
    with pytest.raises(ValueError, match="DiagnosticsCallback measures models of one task, and this one has 2"):
        sac(tasks(), policy="MultiInputPolicy").learn(2, callback=DiagnosticsCallback(vec()))


# ---------------------------------------------------------------- the page and the program


def test_the_pages_program(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The code of docs/multi_task.md, with small numbers in the place of its own."""
    pytest.importorskip("metaworld")
    page = (ROOT / "docs" / "multi_task.md").read_text()
    code = page.partition("```python\n")[2].partition("```")[0]
    for theirs, ours in (
        ("critic_width=512, batch_size=1024", "critic_width=8, batch_size=8, learning_starts=10, device='cpu'"),
        ("100_000", "60"),
        ("eval_freq=5_000", "eval_freq=4, n_eval_episodes=1, verbose=0"),
        ('"MT10", seed', '"MT10", env_kwargs={"max_episode_steps": 2}, seed'),
    ):
        assert theirs in code
        code = code.replace(theirs, ours)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(code, names)
    assert names["model"]._n_updates > 0 and names["action"].shape == (4,)
    assert study.read("runs/mt10")["task"].nunique() == 10


def test_the_example(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("multi_task", ROOT / "examples" / "multi_task.py")
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    given = f"--steps 20 --eval-every 10 --episodes 1 --critic-width 8 --batch-size 8 --folder {tmp_path} --tasks"
    example.main([*given.split(), PENDULUM, CAR, "--random-steps", "5", "--max-episode-steps", "5"])
    table = study.read(tmp_path / "seed_0" / "tasks", ["return"])
    assert sorted(set(table["task"])) == [CAR, PENDULUM] and sorted(set(table["step"])) == [0, 10, 20]
    model = BRC.load(tmp_path / "seed_0" / "final_model")
    # Two for each step of both tasks after the random ones.
    assert model._n_updates == 2 * 15 and model.learning_starts == 10
    assert model.buffer_size == 2_000_000, "a million transitions of each task"
    # Further steps go on from there.
    given = given.replace("--steps 20", "--steps 24")
    example.main([*given.split(), PENDULUM, CAR, "--random-steps", "5", "--max-episode-steps", "5"])
    assert BRC.load(tmp_path / "seed_0" / "final_model")._n_updates == 2 * 19


@pytest.mark.slow
def test_the_published_study_of_bro(tmp_path: Path) -> None:
    """The program that trains as published, in small, up to its networks and its table."""
    given = "--steps 10 --eval-every 10 --episodes 1 --batch-size 8 --random-steps 9 --max-episode-steps 5"
    subprocess.run(
        ["sh", ROOT / "studies/papers/bro_multi_task.sh", PENDULUM, *given.split()],
        cwd=tmp_path,
        env={**os.environ, "SEEDS": "3", "PYTHON": sys.executable, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        check=True,
    )
    table = study.load(tmp_path / f"runs/bro_multi_task_{PENDULUM}.csv")
    assert set(table["agent"]) == {f"BRO Fast {PENDULUM}", f"SAC {PENDULUM}"} and set(table["seed"]) == {3}
    for name, agent in (("bro_fast", BROFast), ("sac", SAC)):
        model = agent.load(tmp_path / f"runs/bro_multi_task_{PENDULUM}/{name}/seed_3/final_model")
        assert model.multitask and model.replay_ratio == 2 and model.learning_starts == 9


@pytest.mark.slow
def test_the_published_study(tmp_path: Path) -> None:
    """The program that trains as published, in small."""
    given = "--steps 20 --eval-every 10 --episodes 1 --critic-width 8 --batch-size 8 --random-steps 5"
    subprocess.run(
        ["sh", ROOT / "studies/papers/brc_multi_task.sh", PENDULUM, *given.split(), "--max-episode-steps", "5"],
        cwd=tmp_path,
        env={**os.environ, "SEEDS": "3 4", "PYTHON": sys.executable, "PYTHONPATH": str(ROOT)},
        check=True,
    )
    table = study.load(tmp_path / f"runs/brc_{PENDULUM}.csv")
    returns = table[table["metric"] == "return"]
    assert set(returns["agent"]) == {f"BRC {PENDULUM}"} and set(returns["step"]) == {0, 10, 20}
    assert set(returns["seed"]) == {3, 4} and len(returns) == 6
