"""BRC: defaults, and several tasks told by the observations: embeddings, rewards by task, files, acting."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_sample.networks import BroNet
from sb3_sample.sac import BRC
from sb3_sample.sac.brc import TaskEmbedding
from tests.sac.common import MAKERS, Toy, differing, state, vec

OBSERVATION = spaces.Box(-10, 10, (3,), np.float32)


class Task(gym.Wrapper[Any, Any, Any, Any]):
    """A toy that tells its number, by which the reward is multiplied."""

    def __init__(self, task: int, n_tasks: int = 3):
        super().__init__(Toy(truncate=True))
        self.task = task
        self.observation_space = spaces.Dict({"observation": OBSERVATION, "task": spaces.Discrete(n_tasks)})

    def told(self, observation: np.ndarray) -> dict[str, Any]:
        return {"observation": observation, "task": self.task}

    def reset(self, **kwargs: Any) -> Any:
        observation, info = self.env.reset(**kwargs)
        return self.told(observation), info

    def step(self, action: np.ndarray) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self.told(observation), (self.task + 1) * float(reward), terminated, truncated, info


def tasks(*numbers: int) -> DummyVecEnv:
    return DummyVecEnv([lambda task=task: Monitor(Task(task)) for task in numbers])


def brc(env: Any = None, **kwargs: Any) -> Any:
    env = tasks(0, 2, 2) if env is None else env
    return MAKERS["BRC"](env, policy="MultiInputPolicy", embedding_size=4, **kwargs)


def test_the_extractor_of_the_embeddings_is_not_described_twice() -> None:
    for kwargs, words in (
        ({"features_extractor_kwargs": {"size": 8}}, "has 'size', which is the argument embedding_size here"),
        ({"share_features_extractor": False}, "share_features_extractor=False in policy_kwargs"),
    ):
        with pytest.raises(ValueError, match=words):
            brc(policy_kwargs=kwargs)
    with pytest.raises(TypeError, match="no_such"):
        brc(policy_kwargs={"features_extractor_kwargs": {"no_such": 1}})
    own = {"features_extractor_class": TaskEmbedding, "features_extractor_kwargs": {"size": 8}}
    model = MAKERS["BRC"](tasks(0, 2, 2), policy="MultiInputPolicy", policy_kwargs=own)
    assert model.critic.features_extractor.table.shape == (3, 8) and not model.actor.shares_encoder


def test_defaults() -> None:
    """The published sizes and numbers but for the width, which takes a while to be drawn."""
    model = BRC("MlpPolicy", vec(), critic_width=16, buffer_size=10, device="cpu")
    assert BRC.constructor_arguments["critic_width"].default == 4096
    # Critics of the published width are not made here: they take minutes.
    sizes = {"actor_network_kwargs": {"width": 8, "n_blocks": 1}, "n_critics": 1}
    with pytest.warns(UserWarning, match="Critics 2,048 wide .* are for a GPU.* critic_width=512 is for CPUs") as seen:
        BRC("MlpPolicy", vec(), critic_width=2048, policy_kwargs=sizes, buffer_size=10, device="cpu")
    assert len(seen) == 1
    for trunk, width, n_blocks in ((model.critic.trunk, 16, 2), (model.actor.trunk, 256, 1)):
        assert isinstance(trunk, BroNet) and (trunk.out_features, len(trunk.blocks)) == (width, n_blocks)
    assert (model.head.n_outputs, model.head.v_min, model.head.v_max) == (101, -10, 10)
    assert model.reward_scaler.max_return == 10 and model.pessimism_rule.beta() == 0
    assert model.temperature().item() == pytest.approx(0.1)
    assert (model.replay_ratio, model.learning_starts, model.batch_size, model.learning_rate) == (2, 5_000, 256, 3e-4)
    assert model.temperature_optimizer is not None
    assert model.temperature_optimizer.param_groups[0]["betas"] == (0.5, 0.999)
    assert model.critic.optimizer.param_groups[0]["weight_decay"] == 1e-4
    assert model.plasticity.steps == () and not model.normalize_observations


def test_embeddings_have_length_1_and_are_the_critics() -> None:
    model = brc()
    extractor: Any = model.critic.features_extractor
    assert isinstance(extractor, TaskEmbedding) and extractor.table.shape == (3, 4)
    observations = {"observation": torch.randn(5, 3), "task": torch.tensor([[0], [1], [2], [2], [0]])}
    features = model.actor.features(observations)
    torch.testing.assert_close(features[:, 3:].norm(dim=1), torch.ones(5))
    assert torch.equal(features[2, 3:], features[3, 3:]) and not torch.equal(features[0, 3:], features[1, 3:])
    assert not features.requires_grad
    assert any(p is extractor.table for p in model.critic.optimizer.param_groups[0]["params"])
    assert not any(p is extractor.table for p in model.actor.parameters())
    before = extractor.table.clone()
    model.learn(60)
    # Of the task that no environment has, the decay moves the row, and nothing else does.
    moved = (extractor.table - before).detach().abs().amax(dim=1)
    assert moved[0] > 1e-4 and moved[2] > 1e-4 and moved[1] < 1e-5
    assert not torch.equal(model.critic_target.features_extractor.table, extractor.table)


def test_rewards_by_task() -> None:
    model = brc()
    model.learn(30)  # Ten steps each, and one episode of seven.
    returns, rewards = [], np.arange(1.0, 8.0)
    following = rewards.mean() / (1 - 0.99)
    for reward in rewards[::-1]:
        following = reward + 0.99 * following
        returns.append(following)
    largest = model.reward_scaler.largest
    assert largest[0].item() == pytest.approx(max(returns), rel=1e-5)
    assert largest[2].item() == pytest.approx(3 * max(returns), rel=1e-5)
    assert largest[1].item() == -np.inf
    batch = next(iter(model._source.batches(1, 32)))
    scaled = model.reward_scaler.transform(batch, None).rewards
    task = batch.observations["task"].flatten().long()
    divisor = model.reward_scaler.divisors[task][:, None]
    torch.testing.assert_close(scaled, (batch.rewards / divisor).float())
    assert set(task.tolist()) == {0, 2}


def test_acts_by_task_saves_and_resumes(tmp_path: Path) -> None:
    model = brc().learn(60)
    observation = np.ones((1, 3), np.float32)
    actions = [
        model.predict({"observation": observation, "task": np.array([task])}, deterministic=True)[0]
        for task in range(3)
    ]
    assert not np.array_equal(actions[0], actions[2])
    model.save(tmp_path / "model")
    loaded = BRC.load(tmp_path / "model", env=tasks(0, 1, 2))
    assert not differing(state(model), state(loaded))
    loaded.learn(12)

    def run(folder: Path, stop: int | None = None) -> Any:
        again = brc()
        stopped = (lambda _l, _g: again.num_timesteps < stop) if stop else None
        return again.learn(60, callback=stopped, checkpoint=folder, checkpoint_freq=12)

    whole = run(tmp_path / "a")
    run(tmp_path / "b", stop=35)
    assert not differing(state(whole), state(run(tmp_path / "b")))


def test_one_task_has_no_embedding() -> None:
    model = MAKERS["BRC"]()
    assert not isinstance(model.critic.features_extractor, TaskEmbedding)
    assert len(model.reward_scaler.largest) == 1
    # A dict without a task is one of several observations, of one task.
    space = spaces.Dict({"observation": OBSERVATION, "goal": OBSERVATION})
    model = MAKERS["BRC"](vec(obs_space=space), policy="MultiInputPolicy").learn(20)
    assert not isinstance(model.critic.features_extractor, TaskEmbedding)


def test_embeddings_do_not_stand_beside_images() -> None:
    space = spaces.Dict({"observation": spaces.Box(0, 255, (3, 36, 36), np.uint8), "task": spaces.Discrete(2)})
    env = DummyVecEnv([lambda: Toy(space)])
    with pytest.raises(
        ValueError, match="embeddings of tasks stand beside vectors, not beside images .*multitask=True"
    ):
        brc(env)
    MAKERS["BRC"](env, policy="MultiInputPolicy", multitask=True)


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"policy_kwargs": {"critic_network": "mlp"}}, "pass critic_width=None"),
        ({"critic_width": 0}, "critic_width must be an integer of at least 1, or None for what policy_kwargs say"),
        ({"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0}}}, "weight_decay is an argument of the algorithm"),
        (
            {"embedding_size": 7, "policy_kwargs": {"features_extractor_class": FlattenExtractor}},
            r"embedding_size=7 means nothing with policy_kwargs\['features_extractor_class'\]",
        ),
        ({"embedding_size": 0}, "embedding_size must be an integer of at least 1, not 0"),
    ],
)
def test_refused(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        MAKERS["BRC"](**kwargs)
