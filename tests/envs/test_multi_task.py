"""Several tasks as one vectorised environment: spaces, numbers, padding, seeds, ends of episodes, refusals."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_sample import make_env, multi_task_env
from sb3_sample.envs import suites

PENDULUM, CAR = "Pendulum-v1", "MountainCarContinuous-v0"


class Task(gym.Env):
    """
    Episodes of ``length`` steps; the observation is ``size`` times the step, the reward the sum of the action.

    :param terminates: whether an episode ends by termination; else by truncation
    """

    def __init__(self, size: int, n_actions: int, bound: float, length: int, terminates: bool):
        self.observation_space = spaces.Box(-1, 100, (size,), np.float32)
        self.action_space = spaces.Box(-bound, bound, (n_actions,), np.float32)
        self.length, self.terminates = length, terminates
        self.actions: list[np.ndarray] = []

    def _observation(self) -> np.ndarray:
        return np.full(self.observation_space.shape, 1.0 + self.t, np.float32)  # type: ignore[arg-type]

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.t += 1
        self.actions.append(np.array(action))
        over = self.t >= self.length
        info = {"is_success": self.length == 3}
        return self._observation(), float(action.sum()), over and self.terminates, over and not self.terminates, info


IDS = ("multi-task/short-v0", "multi-task/long-v0")


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    for task_id, kwargs in (
        (IDS[0], {"size": 2, "n_actions": 3, "bound": 2.0, "length": 3, "terminates": True}),
        (IDS[1], {"size": 4, "n_actions": 1, "bound": 1.0, "length": 5, "terminates": False}),
    ):
        gym.register(task_id, entry_point=Task, kwargs=kwargs, disable_env_checker=True, order_enforce=False)  # type: ignore[arg-type]
    yield
    for task_id in IDS:
        del gym.registry[task_id]


def test_spaces_numbers_and_padding() -> None:
    env = multi_task_env(IDS)
    assert isinstance(env, DummyVecEnv) and env.num_envs == 2
    assert env.get_attr("task_id") == list(IDS) and env.get_attr("task") == [0, 1]
    observation: Any = env.observation_space["observation"]  # type: ignore[index]
    assert env.observation_space["task"] == spaces.Discrete(2)  # type: ignore[index]
    assert observation.shape == (4,) and observation.dtype == np.float32
    # The zeros of the padding lie in the bounds.
    assert observation.low.tolist() == [-1] * 4 and observation.high.tolist() == [100] * 4
    assert env.action_space == spaces.Box(-1.0, 1.0, (3,), np.float32)
    found: Any = env.reset()
    assert found["task"].tolist() == [0, 1]
    assert found["observation"].tolist() == [[1, 1, 0, 0], [1, 1, 1, 1]]
    assert all(env.env_is_wrapped(Monitor))


def test_rewards_and_ends_are_each_tasks_own_and_actions_are_cut_and_scaled() -> None:
    env = multi_task_env(IDS)
    env.reset()
    ends, rewards = [], []
    for _ in range(5):
        found, reward, dones, infos = env.step(np.array([[0.5, -1.0, 1.0], [0.25, 9.0, 9.0]]))
        rewards.append(reward.tolist())
        ends.append(dones.tolist())
        assert found["task"].tolist() == [0, 1]  # type: ignore[call-overload]
        if dones[0]:
            # Terminated, and successful.
            assert not infos[0]["TimeLimit.truncated"] and infos[0]["episode"]["task"] == IDS[0]
            assert infos[0]["episode"]["is_success"] == 1.0 and infos[0]["episode"]["r"] == 3.0
            assert infos[0]["terminal_observation"]["observation"].tolist() == [4, 4, 0, 0]
            assert infos[0]["terminal_observation"]["task"] == 0
    # [-1, 1] to [-2, 2] for the first, as they are for the second.
    assert rewards == [[1.0, 0.25]] * 5
    first, second = (each.unwrapped for each in env.envs)  # type: ignore[attr-defined]
    assert first.actions[0].tolist() == [1, -2, 2] and second.actions[0].tolist() == [0.25]
    assert ends == [[False, False], [False, False], [True, False], [False, False], [False, True]]
    assert infos[1]["TimeLimit.truncated"] and infos[1]["episode"]["task"] == IDS[1]
    assert infos[1]["episode"]["is_success"] == 0.0 and infos[1]["episode"]["l"] == 5


def test_one_task_is_the_environment_as_it_is() -> None:
    env = multi_task_env([PENDULUM], seed=3)
    alone = make_env(PENDULUM)
    assert env.observation_space["observation"] == alone.observation_space  # type: ignore[index]
    assert env.action_space == alone.action_space
    found: Any = env.reset()
    observation, _ = alone.reset(seed=3)
    for _ in range(5):
        assert found["observation"][0].tolist() == observation.tolist() and found["task"].tolist() == [0]
        action = np.array([1.7], np.float32)
        found, rewards, _, _ = env.step(action[None])
        observation, reward, *_ = alone.step(action)
        assert rewards[0] == np.float32(reward)


def test_seeds_are_those_of_the_tasks_alone_in_workers_too() -> None:
    found = []
    for cls in (DummyVecEnv, SubprocVecEnv):
        env = multi_task_env([PENDULUM, CAR], seed=7, vec_env_cls=cls)
        assert type(env) is cls and env.get_attr("task_id") == [PENDULUM, CAR]
        found.append(env.reset())
        env.close()
    (first, second) = found
    for task, (task_id, size) in enumerate(((PENDULUM, 3), (CAR, 2))):
        alone, _ = make_env(task_id).reset(seed=7 + task)
        for each in (first, second):
            assert each["observation"][task].tolist() == [*alone.tolist(), *[0.0] * (3 - size)]
    again: Any = multi_task_env([PENDULUM, CAR], seed=8).reset()
    assert not np.array_equal(again["observation"], first["observation"])


def test_what_users_of_stable_baselines3_do_with_it(tmp_path: Path) -> None:
    env = multi_task_env([PENDULUM, CAR], seed=0, env_kwargs={"max_episode_steps": 6}, monitor_dir=tmp_path / "log")

    class Still:
        def predict(self, observation: Any, **_: Any) -> Any:
            return np.zeros((2, 1)), None

    returns, lengths = evaluate_policy(Still(), env, n_eval_episodes=4, return_episode_rewards=True)  # type: ignore[arg-type]
    assert lengths == [6] * 4 and len(returns) == 4  # type: ignore[arg-type]
    assert {path.name for path in (tmp_path / "log").iterdir()} == {"0.monitor.csv", "1.monitor.csv"}
    assert f'"env_id": "{CAR}"' in (tmp_path / "log" / "1.monitor.csv").read_text()
    normalized = VecNormalize(env, norm_obs_keys=["observation"])
    assert normalized.reset()["task"].tolist() == [0, 1] and normalized.get_attr("task_id") == [PENDULUM, CAR]  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("ids", "words"),
    [
        ([], "ids must be an id, the name of a suite, or a list of them that is not empty, not \\[\\]"),
        (3, "ids must be an id, .*, not 3"),
        ([PENDULUM, 3], "ids must be an id"),
        (["Pendulum-v2000"], "ids has 'Pendulum-v2000', which is neither .* nor a suite; close are .*Pendulum-v1"),
        ("MT11", "ids has 'MT11', which is neither .*; close are .*MT10.* Suites are BRO_DMC"),
        ([PENDULUM, CAR, PENDULUM], "ids has 'Pendulum-v1' twice"),
        ([PENDULUM, "CartPole-v1"], "bounded vectors of floats, and 'CartPole-v1' has Discrete\\(2\\)"),
        (["Blackjack-v1"], "vectors of floats, and 'Blackjack-v1' has Tuple"),
    ],
)
def test_refused(ids: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        multi_task_env(ids)


@pytest.mark.parametrize("seed", ["a", 1.5, -1, 2**32])
def test_seeds_are_checked(seed: Any) -> None:
    with pytest.raises(ValueError, match=f"seed must be an integer of at least 0 .*, or None, not {seed!r}"):
        multi_task_env([PENDULUM], seed=seed)


def test_dict_observations_are_refused() -> None:
    class Goal(gym.Env):
        observation_space = spaces.Dict({"observation": spaces.Box(-1, 1, (2,)), "desired_goal": spaces.Box(-1, 1)})
        action_space = spaces.Box(-1, 1, (2,))

    gym.register("multi-task/goal-v0", entry_point=Goal, disable_env_checker=True)
    try:
        with pytest.raises(ValueError, match="observations are vectors of floats, and 'multi-task/goal-v0' has Dict"):
            multi_task_env([PENDULUM, "multi-task/goal-v0"])
    finally:
        del gym.registry["multi-task/goal-v0"]


def test_suites() -> None:
    metaworld = pytest.importorskip("metaworld.env_dict")
    assert list(suites.MT10) == [f"metaworld/{task}" for task in metaworld.MT10_V3]
    assert list(suites.MT50) == [f"metaworld/{task}" for task in metaworld.MT50_V3]
    env = multi_task_env("mt10", seed=0, env_kwargs={"max_episode_steps": 3})
    assert tuple(env.get_attr("task_id")) == suites.MT10
    assert env.observation_space["observation"].shape == (39,)  # type: ignore[index]
    assert env.action_space.shape == (4,)
    env.reset()
    for _ in range(3):
        _, rewards, dones, infos = env.step(np.zeros((10, 4)))
    assert dones.all() and (rewards >= 0).all()
    assert [info["episode"]["task"] for info in infos] == list(suites.MT10)
    assert all(info["episode"]["is_success"] in (0.0, 1.0) for info in infos)
    env.close()


def test_the_hard_tasks_of_dmc_have_the_dogs_sizes() -> None:
    pytest.importorskip("dm_control")
    env = multi_task_env(["dmc/humanoid-run-v0", "dmc/dog-run-v0"], seed=0)
    assert len(suites.DMC_HARD) == 7 and {"dmc/humanoid-run-v0", "dmc/dog-run-v0"} <= set(suites.DMC_HARD)
    found: Any = env.reset()
    assert found["observation"].shape == (2, 223) and env.action_space.shape == (38,)
    assert not found["observation"][0, 67:].any() and found["observation"][0, :67].any()
    env.step(np.zeros((2, 38)))
    env.close()
