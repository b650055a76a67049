"""The check at the vectorised environment."""

from decimal import Decimal
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_sample.envs.finite_check import FiniteCheck
from tests.sac.common import Toy, vec


def checked(venv: VecEnv) -> VecEnv:
    FiniteCheck.install(venv)
    return venv


def steps(venv: VecEnv, n: int) -> None:
    venv.reset()
    for _ in range(n):
        venv.step(np.zeros((venv.num_envs, 2), np.float32))


def test_sits_at_the_innermost_and_adds_no_wrapper() -> None:
    inner = vec()
    normalized = VecNormalize(VecFrameStack(inner, 2))
    FiniteCheck.install(normalized)
    assert type(inner.step_wait.__self__) is FiniteCheck
    assert normalized.venv.venv is inner


def test_is_installed_once() -> None:
    env = vec()
    FiniteCheck.install(env)
    check = env.step_wait.__self__
    FiniteCheck.install(VecNormalize(env))
    assert env.step_wait.__self__ is check


def test_passes_everything_through() -> None:
    plain, ours_too = vec(2), checked(vec(2))
    np.testing.assert_array_equal(plain.reset(), ours_too.reset())
    for _ in range(20):
        actions = np.zeros((2, 2), np.float32)
        for theirs, ours in zip(plain.step(actions)[:3], ours_too.step(actions)[:3], strict=True):
            np.testing.assert_array_equal(theirs, ours)
    ours_too.close()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_names_environment_step_and_value(value: float) -> None:
    env = checked(vec(3))
    env.envs[1].unwrapped.poison = lambda total, o, r: (o, value if total == 9 else r)
    env.reset()
    for _ in range(8):
        env.step(np.zeros((3, 2), np.float32))
    with pytest.raises(ValueError, match=rf"environment 1 gave a reward .*step 9: {value}"):
        env.step(np.zeros((3, 2), np.float32))


#: What an environment gives as observation (None: its own) and reward, and what is said of it; nothing if it is fine.
LARGEST = float(np.finfo(np.float32).max)
GIVEN: list[tuple[Any, Any, str | None]] = [
    (None, 0.0, None), (LARGEST, Decimal("1.5"), None), (-LARGEST, 2, None),
    (1e39, 0.0, r"an observation .*1\.e\+39"), (-1e300, 0.0, r"an observation .*-1\.e\+300"),
    (np.nan, 0.0, "an observation .*nan"), (None, np.nan, "a reward .*nan"), (None, 1e39, "a reward .*(1e|inf)"),
    (None, 10**50, "a reward .*(1e|10000|inf)"), (None, None, "a reward .*(None|nan)"),
    (None, Decimal("NaN"), "a reward .*(NaN|nan)"), (None, Decimal("1e400"), "a reward .*(1E|inf)"),
]  # fmt: skip


class Says(Toy):
    """Gives what its action says, by its place in the list."""

    def __init__(self) -> None:
        super().__init__(spaces.Box(-np.inf, np.inf, (3,), np.float64))

    def step(self, action: Any) -> Any:
        there, _, *rest = super().step(action)
        observation, reward, _ = GIVEN[int(action[0])]
        return (there.astype(np.float64) if observation is None else np.full(3, observation)), reward, *rest


@pytest.mark.parametrize("kind", [DummyVecEnv, SubprocVecEnv])
def test_what_no_network_takes_is_said_to_be_the_environments(kind: type[VecEnv]) -> None:
    """
    Of the 32 bits of buffers and networks, and whatever a worker sends: arrays of its rewards are of objects if one is
    no number.
    """
    env = checked(kind([Says, Says]))
    env.reset()
    with np.errstate(over="ignore"):
        for place, (_, reward, words) in enumerate(GIVEN):
            actions = np.array([[0, 0], [place, 0]], np.float32)
            if words is None:
                assert float(env.step(actions)[1][1]) == float(reward)
                continue
            with pytest.raises(ValueError, match=rf"(?s)environment 1 gave {words}.*Allowed are finite numbers"):
                env.step(actions)
    env.close()


@pytest.mark.parametrize("space", [spaces.Discrete(5), spaces.MultiDiscrete([3, 4]), spaces.MultiBinary(3)])
def test_integers_pass(space: spaces.Space) -> None:
    """Also where the environment gives Python's own integers, and at the end of an episode."""

    class Integers(Toy):
        def _observation(self, space: spaces.Space) -> int | np.ndarray:
            sample = space.sample()
            return int(sample) if isinstance(space, spaces.Discrete) else sample

    env = checked(DummyVecEnv([lambda: Integers(space)]))
    env.reset()
    for _ in range(20):
        env.step(np.zeros((1, 2), np.float32))


def test_dict_with_an_integer() -> None:
    space = spaces.Dict({"a": spaces.Box(-10, 10, (2,)), "b": spaces.Discrete(4)})
    env = checked(vec(2, obs_space=space))
    env.reset()
    for _ in range(20):
        env.step(np.zeros((2, 2), np.float32))


@pytest.mark.parametrize("as_dict", [False, True])
@pytest.mark.parametrize(
    ("space", "right", "wrong"),
    [
        (spaces.Discrete(3), 2, 3),
        (spaces.Discrete(3, start=-1), -1, 2),
        (spaces.MultiDiscrete([3, 4]), np.array([2, 3]), np.array([2, 4])),
        (spaces.MultiDiscrete([3, 4]), np.array([0, 0]), np.array([-1, 0])),
    ],
)
def test_numbers_outside_of_their_space(space: spaces.Space, right: Any, wrong: Any, as_dict: bool) -> None:
    """At a reset, in a step, and at the end of an episode."""

    class Counts(Toy):
        at = 0

        def _observation(self, space: spaces.Space) -> Any:
            Counts.at -= 1
            number = wrong if Counts.at == 0 else right
            return {"k": number} if as_dict else number

    name = " 'k'" if as_dict else ""
    for at, what in ((1, f"an observation{name} .* at reset"), (3, f"an observation{name} .* at its step 2"),
                     (8, f"a last observation of the episode{name} .* at its step 7")):  # fmt: skip
        env = checked(DummyVecEnv([lambda: Counts(spaces.Dict({"k": space}) if as_dict else space)]))
        Counts.at = at
        with pytest.raises(ValueError, match=rf"environment 0 gave {what}: .*before the value reached"):
            steps(env, 10)
