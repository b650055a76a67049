"""Pictures as observations of ``dmc/``."""

import os
import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.preprocessing import is_image_space

import sb3_sample  # noqa: F401
from sb3_sample.envs.portable_states import pack, unpack
from sb3_sample.envs.states import check_restorable


def make(task: str = "cartpole-swingup", **kwargs: Any) -> Any:
    return gym.make(f"dmc/{task}-v0", **{"pixels": 24, "action_repeat": 8, **kwargs})


def test_the_latest_pictures_channels_first(opengl: None) -> None:
    """Beside the suite's own pictures: the first one fills the stack, the newest comes last."""
    env = make(frame_stack=3)
    assert env.unwrapped.stacked_frames == 3
    assert env.observation_space == gym.spaces.Box(0, 255, (9, 24, 24), np.uint8)
    assert is_image_space(env.observation_space)
    check_env(env, skip_render_check=True)
    physics = env.unwrapped.dm_env.physics

    def picture() -> np.ndarray:
        return physics.render(height=24, width=24, camera_id=0).transpose(2, 0, 1).copy()

    for seed in (3, None):
        observation, _ = env.reset(seed=seed)
        drawn = [picture()] * 3
        np.testing.assert_array_equal(observation, np.concatenate(drawn))
        for _ in range(4):
            observation, *_ = env.step(np.ones(1, np.float32))
            drawn = [*drawn[1:], picture()]
            np.testing.assert_array_equal(observation, np.concatenate(drawn))
        assert (drawn[0] != drawn[2]).any(), "something moves"
        observation[...] = 0
        np.testing.assert_array_equal(env.step(np.ones(1, np.float32))[0][:6], np.concatenate(drawn[1:]))
    env.close()


def test_gray(opengl: None) -> None:
    env = make(frame_stack=2, gray=True)
    assert env.observation_space.shape == (2, 24, 24)
    observation, _ = env.reset(seed=0)
    colors = env.unwrapped.dm_env.physics.render(height=24, width=24, camera_id=0)
    luma = colors @ [0.299, 0.587, 0.114]
    assert np.abs(observation[1] - luma).max() <= 0.5 + 1e-9 and luma.std() > 1
    env.close()


def test_the_quadruped_has_another_camera(opengl: None) -> None:
    env = make("quadruped-walk")
    assert env.unwrapped.camera == 2 and make().unwrapped.camera == 0
    assert make(camera="lookatcart").unwrapped.camera == "lookatcart"
    env.close()


def test_rewards_and_ends_are_those_without_pictures(opengl: None) -> None:
    pictures, plain = make(), gym.make("dmc/cartpole-swingup-v0", action_repeat=8)
    pictures.reset(seed=1), plain.reset(seed=1)
    assert gym.make("dmc/cartpole-swingup-v0").unwrapped.stacked_frames is None  # type: ignore[attr-defined]
    for _ in range(125):
        ours, theirs = (env.step(np.full(1, 0.3, np.float32)) for env in (pictures, plain))
        assert ours[1:] == theirs[1:]
    assert ours[3]
    pictures.close()


def test_states(opengl: None) -> None:
    """The stack is a part of the state, in memory and in files."""
    env, other = make(), make()
    check_restorable(env, other, n_steps=5)
    env.reset(seed=2)
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 1)).astype(np.float32)
    for action in actions[:3]:
        env.step(action)
    state, unknown = pack(env)
    assert unknown == []
    first = [env.step(action)[0] for action in actions]
    other.reset(seed=5)
    unpack(other, state)
    for action, observation in zip(actions, first, strict=True):
        np.testing.assert_array_equal(other.step(action)[0], observation)
    env.close()


@pytest.mark.parametrize("task", ["finger-spin", "fish-upright"])
def test_colours_that_a_task_sets_at_its_reset_are_part_of_a_state(task: str, opengl: None) -> None:
    env, other = (gym.make(f"dmc/{task}-v0", pixels=64, action_repeat=4) for _ in range(2))
    check_restorable(env, other, n_steps=2)
    state, _ = pack(env)
    fresh = gym.make(f"dmc/{task}-v0", pixels=64, action_repeat=4)
    action = np.zeros(env.action_space.shape, np.float32)
    unpack(fresh, state)
    np.testing.assert_array_equal(fresh.unwrapped.step(action)[0], env.unwrapped.step(action)[0])
    for each in (env, other, fresh):
        each.close()


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"pixels": 0}, "pixels must be a positive int"),
        ({"pixels": 84.0}, "pixels must be a positive int"),
        ({"pixels": 24, "frame_stack": 0}, "frame_stack must be a positive int"),
        ({"pixels": 24, "gray": 1}, "gray must be"),
        ({"frame_stack": 3}, "pass pixels=84"),
        ({"gray": True}, "pass pixels=84"),
    ],
)
def test_wrong_arguments(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        gym.make("dmc/cartpole-swingup-v0", **kwargs)


@pytest.mark.slow
def test_wrong_pictures(opengl: None) -> None:
    with pytest.raises(ValueError, match="camera=17"):
        make(camera=17)
    with pytest.raises(ValueError, match="pixels=5000"):
        make(pixels=5000)


def test_without_opengl() -> None:
    """The error comes where the environment is made, and names what to set."""
    program = (
        "import gymnasium as gym, sb3_sample\n"
        "gym.make('dmc/cartpole-swingup-v0').reset(seed=0)\n"
        "try:\n"
        "    gym.make('dmc/cartpole-swingup-v0', pixels=84)\n"
        "except ImportError as error:\n"
        "    print(error)\n"
    )
    environment = {**os.environ, "MUJOCO_GL": "disabled"}
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr
    assert "pixels=84" in result.stdout and "MUJOCO_GL=egl" in result.stdout and "'disabled'" in result.stdout
