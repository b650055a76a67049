"""Going back to a state is exact: the same actions give the same observations, rewards and ends, bit by bit."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor

from sb3_sample.envs import make_env, states
from sb3_sample.envs.rewinding import sibling_of
from sb3_sample.envs.states import check_restorable, random_action, restore_state, save_state
from tests.variance.common import Tabular

#: Among them tasks that draw numbers of the model anew for each episode: a target's place or size, tendons, a terrain.
DMC = [
    "cartpole-swingup",
    "reacher-hard",
    "finger-turn_easy",
    "point_mass-hard",
    "fish-swim",
    "swimmer-swimmer6",
    "walker-walk",
    "quadruped-escape",
    "manipulator-bring_ball",
    "humanoid-run",
]
OTHERS = ["Hopper-v5", "Humanoid-v5", "Reacher-v5", "Pendulum-v1", "CartPole-v1", "metaworld/push-v3"]


def make(env_id: str) -> gym.Env:
    return make_env(f"dmc/{env_id}-v0", action_repeat=3) if env_id in DMC else make_env(env_id)


def steps(env: gym.Env, actions: list[Any]) -> list[Any]:
    """All that an agent sees, over the ends of episodes."""
    seen = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append((np.array(observation), reward, terminated, truncated))
        if terminated or truncated:
            seen.append((np.array(env.reset()[0]), 0.0, False, False))
    return seen


def assert_equal(first: list[Any], second: list[Any]) -> None:
    assert len(first) == len(second)
    for (observation, *rest), (other, *other_rest) in zip(first, second, strict=True):
        np.testing.assert_array_equal(observation, other)
        assert rest == other_rest


def random_actions(env: gym.Env, n: int, seed: int = 0) -> list[Any]:
    rng = np.random.default_rng(seed)
    return [random_action(env.action_space, rng) for _ in range(n)]


@pytest.mark.parametrize("env_id", DMC + OTHERS)
def test_restored_in_the_same_environment_and_in_another(env_id: str) -> None:
    env, other = make(env_id), make(env_id)
    env.reset(seed=1)
    other.reset(seed=2)
    steps(env, random_actions(env, 25, seed=1))
    state = save_state(env)
    actions = random_actions(env, 25, seed=2)
    expected = steps(env, actions)
    assert len({observation.tobytes() for observation, *_ in expected}) > 10
    steps(env, random_actions(env, 5, seed=3))
    env.reset()  # another episode, with another model
    for again in (env, other, env):
        restore_state(again, state)
        assert_equal(steps(again, actions), expected)


def test_the_time_limit_of_dmc_is_kept() -> None:
    env = make_env("dmc/cartpole-swingup-v0", action_repeat=300)
    env.reset(seed=0)
    steps(env, random_actions(env, 2))
    state = save_state(env)
    actions = random_actions(env, 3, seed=1)
    expected = steps(env, actions)
    # 1,000 control steps are four decisions, the last one shorter.
    assert [truncated for *_, truncated in expected] == [False, True, False, False]
    for _ in range(2):
        restore_state(env, state)
        assert_equal(steps(env, actions), expected)


def test_the_time_limit_of_gymnasium_is_kept() -> None:
    env = make_env("HalfCheetah-v5", max_episode_steps=7)
    env.reset(seed=0)
    steps(env, random_actions(env, 5))
    state = save_state(env)
    actions = random_actions(env, 4, seed=1)
    expected = steps(env, actions)
    assert [truncated for *_, truncated in expected] == [False, True, False, False, False]
    for _ in range(2):
        restore_state(env, state)
        assert_equal(steps(env, actions), expected)


def test_a_state_after_the_end_of_an_episode() -> None:
    env = make_env("Hopper-v5")
    env.reset(seed=0)
    action = env.action_space.high
    while not env.step(action)[2]:
        pass
    state = save_state(env)
    first = env.reset()[0]
    restore_state(env, state)
    np.testing.assert_array_equal(env.reset()[0], first)


def test_wrappers_with_a_state() -> None:
    env: gym.Env = gym.wrappers.FrameStackObservation(make_env("dmc/cartpole-swingup-v0"), 3)
    env = gym.wrappers.NormalizeReward(gym.wrappers.NormalizeObservation(gym.wrappers.RescaleAction(env, -2, 2)))
    env = gym.wrappers.DelayObservation(gym.wrappers.ClipAction(env), 2)
    env.reset(seed=0)
    steps(env, random_actions(env, 10))
    state = save_state(env)
    actions = random_actions(env, 10, seed=1)
    expected = steps(env, actions)
    for _ in range(2):
        restore_state(env, state)
        assert_equal(steps(env, actions), expected)


def test_a_saved_state_stays_as_it_is_and_the_original_goes_on() -> None:
    env, twin = (make_env("dmc/reacher-easy-v0") for _ in range(2))
    for each in (env, twin):
        each.reset(seed=0)
    actions = random_actions(env, 10)
    for action in actions:
        save_state(env)
        seen = env.step(action)[0]
        np.testing.assert_array_equal(seen, twin.step(action)[0])


def test_new_randomness_from_a_state() -> None:
    env = Tabular(n_states=6)
    env.reset(seed=0)
    state = save_state(env)
    actions = [0] * 30

    def follow(seed: int | None) -> list[int]:
        restore_state(env, state, None if seed is None else np.random.default_rng(seed))
        return [int(observation) for observation, *_ in steps(env, actions)]

    assert follow(None) == follow(None)
    assert follow(1) == follow(1)
    assert len({tuple(follow(seed)) for seed in (None, 1, 2, 3)}) == 4


def test_new_randomness_of_a_dmc_task_is_that_of_its_resets() -> None:
    env = make_env("dmc/cartpole-swingup-v0")
    env.reset(seed=0)
    state = save_state(env)
    starts = []
    for seed in (1, 1, 2):
        restore_state(env, state, np.random.default_rng(seed))
        starts.append(env.reset()[0])
    np.testing.assert_array_equal(starts[0], starts[1])
    assert (starts[0] != starts[2]).any()


@pytest.mark.parametrize("env_id", [*DMC[:2], *OTHERS])
def test_check_restorable(env_id: str) -> None:
    check_restorable(make(env_id))
    check_restorable(make(env_id), make(env_id))


class Randomized(gym.Wrapper):
    """Draws numbers of the model's physics anew for each episode, as domain randomisation does."""

    def reset(self, **kwargs: Any) -> Any:
        observation, info = self.env.reset(**kwargs)
        model, rng = self.unwrapped.model, self.unwrapped.np_random  # type: ignore[attr-defined]
        model.opt.gravity[2] = rng.uniform(-20, -1)
        model.opt.wind[:] = rng.uniform(-5, 5, 3)
        model.opt.timestep = rng.uniform(0.005, 0.012)
        model.opt.integrator = int(rng.integers(4))
        model.stat.meaninertia = rng.uniform(1, 2)
        model.geom_contype[:] = rng.integers(2, size=model.ngeom)
        model.geom_rgba[:] = rng.uniform(size=(model.ngeom, 4))
        return observation, info


def randomized() -> Any:
    return Randomized(make_env("HalfCheetah-v5"))


def test_numbers_of_the_model_that_a_wrapper_draws() -> None:
    env, other = randomized(), randomized()
    env.reset(seed=1)
    steps(env, random_actions(env, 5))
    state, actions = save_state(env), random_actions(env, 15, seed=1)
    model = env.unwrapped.model
    drawn = model.opt.gravity.copy(), model.opt.integrator, model.geom_contype.copy(), model.geom_rgba.copy()
    expected = steps(env, actions)
    env.reset()
    for again in (env, other):
        restore_state(again, state)
        model = again.unwrapped.model
        for value, before in zip(
            (model.opt.gravity, model.opt.integrator, model.geom_contype, model.geom_rgba), drawn, strict=True
        ):
            np.testing.assert_array_equal(value, before)
        assert_equal(steps(again, actions), expected)
    check_restorable(env, other)


class Node:
    """Knows its parent, as its parent knows it, and can be asked for a method of its own."""

    def __init__(self, parent: Any = None) -> None:
        self.parent, self.children, self.n = parent, [], 0

    def count(self) -> int:
        self.n += 1
        return self.n


class Bound(gym.Env):
    """Holds methods, of its own and of an object of its state, and objects that refer to each other."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, kind: str = "method") -> None:
        self.t, self.root = 0.0, Node()
        self.root.children.append(Node(self.root))
        self.reward = self.dense if kind == "method" else functools.partial(Bound.dense, self)
        self.count = self.root.children[0].count

    def dense(self) -> float:
        return self.t

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.t = self.np_random.random()
        return np.zeros(2), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.t += float(action[0])
        return np.array([self.count(), self.root.children[0].n], float), self.reward(), False, False, {}


@pytest.mark.parametrize("kind", ["method", "partial"])
def test_methods_stay_those_of_the_environment(kind: str) -> None:
    env, other = Bound(kind), Bound(kind)
    check_restorable(env)
    check_restorable(env, other)
    for each in (env, other):
        of = each.reward.__self__ if kind == "method" else each.reward.args[0]  # type: ignore[attr-defined]
        assert of is each
        node = each.root.children[0]
        assert node.parent is each.root and each.count.__self__ is node


def test_a_state_late_in_an_episode_is_as_quick_as_an_early_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Monitor's rewards of the episode are copied as a whole, not looked at one by one."""
    n_looks, is_state = 0, states._is_state

    def looks(value: Any, seen: set[int]) -> bool:
        nonlocal n_looks
        n_looks += 1
        return is_state(value, seen)

    class Reward(float):
        def __deepcopy__(self, memo: Any) -> float:
            raise AssertionError("copied by itself")

    monkeypatch.setattr(states, "_is_state", looks)
    env = Monitor(make_env("CartPole-v1"))
    env.reset(seed=0)
    env.rewards = [Reward(1.0)] * 20_000
    state = save_state(env)
    assert n_looks < 1_000
    env.step(0)
    assert len(state.layers[0]["rewards"]) == 20_000
    for _ in range(2):
        restore_state(env, state)
        terminated, n = False, 0
        while not terminated:
            _, _, terminated, _, info = env.step(0)
            n += 1
        assert info["episode"]["r"] == info["episode"]["l"] == 20_000 + n


def test_monitors_past_episodes_are_no_part_of_a_state() -> None:
    env = Monitor(make_env("CartPole-v1"))
    env.reset(seed=0)
    steps(env, random_actions(env, 100))
    n = len(env.episode_returns)
    state = save_state(env)
    held = [name for name, value in state.layers[0].items() if isinstance(value, list)]
    assert n > 0 and held == ["rewards"]
    steps(env, random_actions(env, 100))
    later = list(env.episode_returns)
    restore_state(env, state)
    assert env.episode_returns == later and len(later) > n
    sibling = sibling_of(env)
    for _ in range(2):
        restore_state(sibling, state)
        steps(sibling, random_actions(env, 50))
    assert not sibling.get_wrapper_attr("episode_returns")


class Hidden(gym.Env):
    """Keeps its state where nobody finds it, as an environment does that runs in another process."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self) -> None:
        self.simulator = iter(range(10**6))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        return np.zeros(1), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.array([next(self.simulator)], dtype=float), 0.0, False, False, {}


class OfTheReset(Hidden):
    """What a reset draws is hidden, and nothing else."""

    def __init__(self) -> None:
        self.drawn = iter([0.0])  # the iterator's place is no data

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        gym.Env.reset(self, seed=seed)
        self.drawn = iter([self.np_random.random()] * 10**3)
        return np.zeros(1), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.array([next(self.drawn)]), 0.0, False, False, {}


def test_environments_that_cannot_be_restored() -> None:
    with pytest.raises(ValueError, match="env must be an environment whose state can be saved .* not <.*Hidden"):
        check_restorable(Hidden())
    with pytest.raises(ValueError, match="the same actions gave something else"):
        check_restorable(OfTheReset())
    with pytest.raises(TypeError, match=r"env must be a gymnasium.Env, not 'Hopper-v5'"):
        save_state("Hopper-v5")  # type: ignore[arg-type]


def test_states_of_other_environments() -> None:
    state = save_state(make_env("Hopper-v5"))
    with pytest.raises(ValueError, match="3 layers|layers, env"):
        restore_state(gym.wrappers.ClipAction(make_env("Hopper-v5")), state)
    with pytest.raises(ValueError, match="env's model"):
        restore_state(make_env("Walker2d-v5"), state)
    with pytest.raises(ValueError, match="only one of the two is simulated"):
        restore_state(make_env("Pendulum-v1"), state)
