"""MyoSuite: dimensions, episodes that never end early and when a success counts."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

DIMENSIONS = {"key-turn": 93, "obj-hold": 91, "pen-twirl": 83, "pose": 108, "reach": 115}


@pytest.mark.parametrize("hard", ["", "-hard"])
@pytest.mark.parametrize("task", DIMENSIONS)
def test_dimensions_and_episodes(task: str, hard: str) -> None:
    env = gym.make(f"myosuite/{task}{hard}-v0")
    assert env.observation_space.shape == (DIMENSIONS[task],) and env.action_space.shape == (39,)
    env.reset(seed=0)
    env.action_space.seed(0)
    ends, done = [], False
    for _ in range(100):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        ends.append((terminated, truncated))
        done = done or info["done"]
    assert ends == [(False, False)] * 99 + [(False, True)]
    if task == "pen-twirl":
        assert done  # random muscles drop the pen: the library would have stopped


def test_a_success_stays_and_the_library_s_flag_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    env = gym.make("myosuite/pose-v0")
    library = env.unwrapped.myo  # type: ignore[attr-defined]
    step = library.step
    solved = iter([False, True, False, False])

    def scripted_step(action: np.ndarray) -> tuple[Any, ...]:
        observation, reward, terminated, truncated, info = step(action)
        return observation, reward, terminated, truncated, {**info, "solved": next(solved)}

    monkeypatch.setattr(library, "step", scripted_step)
    env.reset(seed=0)
    action = np.zeros(39, np.float32)
    infos = [env.step(action)[4] for _ in range(3)]
    assert [info["solved"] for info in infos] == [False, True, False]
    assert [info["is_success"] for info in infos] == [False, True, True]
    env.reset()
    assert env.step(action)[4]["is_success"] is False
    assert "obs_dict" not in infos[0] and "rwd_dict" not in infos[0]
