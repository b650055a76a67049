"""The check at the vectorised environment."""

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecFrameStack, VecNormalize

from sb3_sample.envs.vec_check_finite import VecCheckFinite
from tests.sac.common import Toy, vec


def chain(env: VecEnv) -> list[str]:
    """Names of the wrappers from the outside in."""
    names = [type(env).__name__]
    while isinstance(env, VecEnvWrapper):
        env = env.venv
        names.append(type(env).__name__)
    return names


def test_goes_around_the_innermost() -> None:
    assert chain(VecCheckFinite.insert(vec())) == ["VecCheckFinite", "DummyVecEnv"]
    outer = VecNormalize(VecFrameStack(vec(), 2))
    assert VecCheckFinite.insert(outer) is outer
    assert chain(outer) == ["VecNormalize", "VecFrameStack", "VecCheckFinite", "DummyVecEnv"]


def test_is_inserted_once() -> None:
    env = VecCheckFinite.insert(VecNormalize(vec()))
    assert VecCheckFinite.insert(env) is env
    assert chain(env).count("VecCheckFinite") == 1
    plain = VecCheckFinite.insert(vec())
    assert VecCheckFinite.insert(plain) is plain


def test_passes_everything_through() -> None:
    plain, checked = vec(2), VecCheckFinite(vec(2))
    np.testing.assert_array_equal(plain.reset(), checked.reset())
    for _ in range(20):
        actions = np.zeros((2, 2), np.float32)
        for theirs, ours in zip(plain.step(actions)[:3], checked.step(actions)[:3], strict=True):
            np.testing.assert_array_equal(theirs, ours)
    assert checked.get_attr("length") == [7, 7]
    assert checked.env_is_wrapped(Monitor) == [True, True]
    checked.set_attr("length", 3)
    assert checked.get_attr("length") == [3, 3] or checked.env_method("get_wrapper_attr", "length") == [3, 3]
    checked.close()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_names_environment_step_and_value(value: float) -> None:
    env = VecCheckFinite(vec(3))
    env.venv.envs[1].unwrapped.poison = lambda total, o, r: (o, value if total == 9 else r)
    env.reset()
    for _ in range(8):
        env.step(np.zeros((3, 2), np.float32))
    with pytest.raises(ValueError, match=rf"environment 1 gave a reward .*step 9: {value}"):
        env.step(np.zeros((3, 2), np.float32))


@pytest.mark.parametrize("space", [spaces.Discrete(5), spaces.MultiDiscrete([3, 4]), spaces.MultiBinary(3)])
def test_integers_pass(space: spaces.Space) -> None:
    """Also where the environment gives Python's own integers, and at the end of an episode."""

    class Integers(Toy):
        def _observation(self, space: spaces.Space) -> int | np.ndarray:
            sample = space.sample()
            return int(sample) if isinstance(space, spaces.Discrete) else sample

    env = VecCheckFinite(DummyVecEnv([lambda: Integers(space)]))
    env.reset()
    for _ in range(20):
        env.step(np.zeros((1, 2), np.float32))


def test_dict_with_an_integer() -> None:
    space = spaces.Dict({"a": spaces.Box(-10, 10, (2,)), "b": spaces.Discrete(4)})
    env = VecCheckFinite(vec(2, obs_space=space))
    env.reset()
    for _ in range(20):
        env.step(np.zeros((2, 2), np.float32))
