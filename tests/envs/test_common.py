"""What holds for the environments of all suites."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env

from sb3_sample.envs import ALL_IDS, make_env

SAMPLE = [
    "dmc/acrobot-swingup-v0",
    "dmc/quadruped-walk-v0",
    "dmc/humanoid-stand-v0",
    "metaworld/push-v3",
    "metaworld/lever-pull-v3",
    "myosuite/pen-twirl-hard-v0",
    "myosuite/reach-v0",
]
REST = [pytest.param(env_id, marks=pytest.mark.slow) for env_id in ALL_IDS if env_id not in SAMPLE]
IDS = [*SAMPLE, *REST]

# MyoSuite's "Fixed" tasks have one start and one goal: all their episodes are the same.
FIXED = ["key-turn", "obj-hold", "pen-twirl", "pose", "reach"]
FIXED_IDS = [f"myosuite/{task}-v0" for task in FIXED]


def play(env: gym.Env, seed: int, n_steps: int = 12) -> list[np.ndarray]:
    """Two episodes with the same actions, the second without a seed: one array of observations and rewards each."""
    assert env.action_space.shape is not None
    actions = np.random.default_rng(0).uniform(-1, 1, (n_steps, *env.action_space.shape)).astype(np.float32)
    episodes = []
    for reset_seed in (seed, None):
        observation, _ = env.reset(seed=reset_seed)
        steps = [np.append(observation, 0.0)]
        for action in actions:
            observation, reward, *_ = env.step(action)
            steps.append(np.append(observation, float(reward)))
        episodes.append(np.array(steps))
    return episodes


@pytest.mark.parametrize("env_id", IDS)
def test_passes_the_checker_and_has_flat_float32_spaces(env_id: str) -> None:
    env = gym.make(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)
    for space in (env.observation_space, env.action_space):
        assert isinstance(space, gym.spaces.Box)
        assert space.dtype == np.float32 and len(space.shape) == 1
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, env.action_space.shape)
    observation, _ = env.reset(seed=0)
    assert observation.dtype == np.float32
    observation, reward, *_ = env.step(env.action_space.sample())
    assert observation.dtype == np.float32 and type(reward) is float
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_a_seed_fixes_the_stream_of_episodes(env_id: str) -> None:
    fresh, used = gym.make(env_id), gym.make(env_id)
    expected = play(fresh, seed=7)
    other = play(used, seed=8)
    np.random.seed(0)  # NumPy's global generator plays no part
    again = play(used, seed=7)
    for first, second in zip(expected, again, strict=True):
        np.testing.assert_array_equal(first, second)
    if env_id not in FIXED_IDS:
        assert not np.array_equal(expected[0], other[0])
        assert not np.array_equal(expected[0], expected[1])
    fresh.close()
    used.close()


@pytest.mark.parametrize("env_id", ["dmc/acrobot-swingup-v0", "metaworld/reach-v3", "myosuite/reach-hard-v0"])
def test_the_two_ways_to_make_an_environment_are_the_same(env_id: str) -> None:
    envs = [gym.make(env_id), gym.make(f"sb3_sample:{env_id}"), make_env(env_id), make_env(f"sb3_sample:{env_id}")]
    assert len({str(env) for env in envs}) == 1
    assert all(env.spec == envs[0].spec for env in envs)
    episodes = [play(env, seed=1) for env in envs]
    for other in episodes[1:]:
        np.testing.assert_array_equal(episodes[0], other)
    assert envs[0].spec is not None
    np.testing.assert_array_equal(episodes[0], play(gym.make(envs[0].spec), seed=1))


@pytest.mark.parametrize("env_id", ["dmc/acrobot-swingup-v0", "metaworld/reach-v3", "myosuite/reach-v0"])
@pytest.mark.parametrize("argument", [{"render_mode": "human"}, {"width": 0}, {"height": 1.5}])
def test_wrong_render_arguments_are_named(env_id: str, argument: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(argument))):
        make_env(env_id, **argument)


@pytest.mark.parametrize("env_id", ["dmc/cheetah-run-v0", "metaworld/reach-v3", "myosuite/pose-v0"])
def test_pictures(env_id: str, opengl: None) -> None:
    env = gym.make(env_id, render_mode="rgb_array", width=96, height=64)
    env.reset(seed=0)
    picture: object = env.render()
    assert isinstance(picture, np.ndarray)
    assert picture.shape == (64, 96, 3) and picture.dtype == np.uint8
    assert picture.std() > 1.0  # not a blank picture
    env.close()
    assert gym.make(env_id).unwrapped.render() is None
