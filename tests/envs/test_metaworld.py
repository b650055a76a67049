"""Meta-World: its episodes, its goals and when a success counts."""

import gymnasium as gym
import numpy as np
import pytest
from metaworld.policies import SawyerReachV3Policy

from sb3_sample.envs.metaworld import MetaWorldEnv


def test_episodes_are_truncated_after_200_steps() -> None:
    env = gym.make("metaworld/push-v3")
    assert env.observation_space.shape == (39,) and env.action_space.shape == (4,)
    env.reset(seed=0)
    ends = [env.step(np.zeros(4, np.float32))[2:4] for _ in range(200)]
    assert ends == [(False, False)] * 199 + [(False, True)]


@pytest.mark.parametrize("task", ["reach", "push", "assembly", "sweep"])
def test_each_episode_has_a_new_goal_that_is_observed(task: str) -> None:
    env = gym.make(f"metaworld/{task}-v3")
    starts = np.array([env.reset(seed=0 if episode == 0 else None)[0] for episode in range(4)])
    assert len(np.unique(starts, axis=0)) == 4
    for _ in range(2):
        observation, *_ = env.step(np.zeros(4, np.float32))
        target = env.unwrapped.sawyer._target_pos  # type: ignore[attr-defined]
        np.testing.assert_allclose(observation[-3:], target, rtol=1e-6)
    assert np.any(observation[-3:] != 0)


def test_a_success_stays_and_the_library_s_flag_does_not() -> None:
    env = gym.make("metaworld/reach-v3")
    policy = SawyerReachV3Policy()
    observation, _ = env.reset(seed=0)
    _, _, _, _, info = env.step(np.zeros(4, np.float32))
    assert info["success"] == 0.0 and info["is_success"] is False
    while not info["success"]:
        action = np.clip(policy.get_action(observation), -1, 1).astype(np.float32)
        observation, _, _, truncated, info = env.step(action)
        assert not truncated, "the scripted policy did not reach the goal"
        assert info["is_success"] is bool(info["success"])
    while info["success"]:
        *_, info = env.step(np.array([0, -1, 1, 0], np.float32))
    assert info["success"] == 0.0 and info["is_success"] is True
    env.reset()
    *_, info = env.step(np.zeros(4, np.float32))
    assert info["is_success"] is False


def test_an_unknown_task_is_refused() -> None:
    with pytest.raises(ValueError, match="task must be one of .*'push-v3'"):
        MetaWorldEnv("push-v2")
