"""States on disk: restored in another environment, or another process, they are exact, bit by bit."""

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor

from sb3_sample.envs import make_env
from sb3_sample.envs.mujoco_model import more_model_arrays
from sb3_sample.envs.portable_states import pack, unpack
from sb3_sample.envs.states import layers_of, restore_state, save_state, simulator_of
from sb3_sample.saving import container
from sb3_sample.saving.attributes import Describer, DoesNotFit, Restorer, class_name, same
from sb3_sample.saving.encoding import decode, encode
from tests.envs.test_states import assert_equal, random_actions, randomized, steps

FAST = [
    "dmc/cartpole-swingup-v0",  # physics alone
    "dmc/finger-turn_easy-v0",  # contacts, and a target drawn anew for each episode
    "metaworld/pick-place-v3",  # whose task keeps views of the simulator's memory
    "Ant-v5",  # rewards by contact forces
    "Humanoid-v5",  # rewards by what the last step left over
    "Pendulum-v1",
    "CartPole-v1",
]
SLOW = [
    *(f"dmc/{task}-v0" for task in (
        "quadruped-escape", "reacher-hard", "point_mass-hard", "fish-swim", "swimmer-swimmer6", "walker-walk",
        "manipulator-bring_ball", "humanoid-run", "dog-run", "dog-fetch", "stacker-stack_4", "humanoid_CMU-run",
        "ball_in_cup-catch", "hopper-hop", "quadruped-fetch", "cheetah-run", "acrobot-swingup", "pendulum-swingup",
    )),
    *(f"metaworld/{task}-v3" for task in (
        "push", "drawer-open", "hammer", "door-open", "coffee-pull", "peg-insert-side", "soccer", "assembly",
        "basketball",
    )),
    "Hopper-v5", "Walker2d-v5", "HalfCheetah-v5", "Reacher-v5", "Pusher-v5", "Swimmer-v5", "InvertedPendulum-v5",
    "InvertedDoublePendulum-v5", "HumanoidStandup-v5", "MountainCarContinuous-v0", "MountainCar-v0", "Acrobot-v1",
    "Taxi-v3", "FrozenLake-v1", "CliffWalking-v1", "Blackjack-v1",
]  # fmt: skip


def make(env_id: str) -> gym.Env:
    return Monitor(make_env(env_id))


def through_a_file(state: Any, path: Path) -> Any:
    tensors: dict[str, Any] = {}
    container.write(path, "state", encode(state, "state", tensors), tensors)
    return decode(*container.read(path, "state"), "state")


def check(env_id: str, path: Path) -> None:
    env, other = make(env_id), make(env_id)
    # Right after a reset too: there dm_control has computed other things than after a step.
    for n in (0, 30):
        env.reset(seed=1)
        other.reset(seed=2)
        for each in (env, other):
            steps(each, random_actions(each, n, seed=n))
        state, opaque = pack(env)
        assert not opaque
        state = through_a_file(state, path)
        actions = random_actions(env, 40, seed=2)
        expected = steps(env, actions)
        for again in (other, env, other):
            unpack(again, state)
            assert_equal(steps(again, actions), expected)


@pytest.mark.parametrize("env_id", FAST)
def test_restored_from_disk_in_another_environment(env_id: str, tmp_path: Path) -> None:
    check(env_id, tmp_path / "state")


@pytest.mark.slow
@pytest.mark.parametrize("env_id", SLOW)
def test_restored_from_disk_in_another_environment_everywhere(env_id: str, tmp_path: Path) -> None:
    check(env_id, tmp_path / "state")


def test_the_saved_arrays_are_those_whose_size_the_model_determines() -> None:
    import mujoco

    for env_id in ("dmc/walker-walk-v0", "metaworld/pick-place-v3", "Ant-v5"):
        env = make(env_id)
        env.reset(seed=0)
        model, data = simulator_of(env)  # type: ignore[misc]
        for i in range(200):
            steps(env, random_actions(env, 1, seed=i))
            if data.ncon > 0:
                break
        fresh = mujoco.MjData(model)
        saved = pack(env)[0]["simulator"]["data"]
        assert data.ncon > 0
        for name, array in saved.items():
            assert array.shape == getattr(fresh, name).shape
        # And no other array of floats has such a size, but for matrices of the islands of bodies that touch.
        floats = {n for n in dir(fresh) if getattr(getattr(fresh, n), "dtype", None) == np.float64}
        assert {name for name in floats - saved.keys() if getattr(fresh, name).size} <= {"iLD", "iM", "iLDiagInv"}


def test_a_view_of_the_simulators_memory_follows_it() -> None:
    """Meta-World's ``init_left_pad`` is the pad's place at every moment; a copy of it would change the rewards."""
    env = make("metaworld/pick-place-v3")
    env.reset(seed=0)
    steps(env, random_actions(env, 10))
    state, actions = save_state(env), random_actions(env, 20, seed=1)
    expected = steps(env, actions)
    restore_state(env, state)
    assert_equal(steps(env, actions), expected)


def test_numbers_of_the_model_that_a_wrapper_draws(tmp_path: Path) -> None:
    env, other = Monitor(randomized()), Monitor(randomized())
    env.reset(seed=1)
    steps(env, random_actions(env, 5))
    state, opaque = pack(env)
    assert not opaque
    state = through_a_file(state, tmp_path / "state")
    actions = random_actions(env, 15, seed=1)
    expected = steps(env, actions)
    unpack(other, state)
    assert_equal(steps(other, actions), expected)


def test_states_of_earlier_versions_have_no_options_and_masks(simulated: tuple[gym.Env, dict[str, Any]]) -> None:
    env, state = simulated
    state = copy.deepcopy(state)
    del state["simulator"]["options"]
    for name in more_model_arrays():
        del state["simulator"]["model"][name]
    unpack(env, state)


#: Arrays of the simulator that a state could bring: those that are indices in its memory, which MuJoCo follows without
#: a check, and those that are saved, as something else.
HOSTILE = [
    *(("model", name, value) for value in (10**6, 0) for name in (
        "jnt_qposadr", "jnt_dofadr", "body_parentid", "body_jntadr", "dof_bodyid", "geom_bodyid", "actuator_trnid",
        "sensor_adr", "dof_parentid",
    )),
    *(("data", name, 10**6) for name in ("efc_J", "M_rownnz", "tree_asleep", "contact")),
    ("model", "body_mass", "int"), ("model", "body_mass", "long"), ("model", "body_mass", "list"),
    ("model", "body_mass", "left out"), ("model", "body_mass", np.nan), ("model", "geom_size", np.inf),
    ("model", "geom_condim", 7), ("model", "geom_contype", "left out"), ("model", "geom_rgba", "long"),
    ("options", "opt.gravity", "long"), ("options", "opt.gravity", np.inf), ("options", "opt.wind", "left out"),
    *(("options", name, number) for name, number in (
        ("opt.timestep", 1), ("opt.more", "int"), ("opt.timestep", float("nan")), ("opt.integrator", 4),
        ("opt.integrator", -1), ("opt.solver", True), ("opt.iterations", 2**31), ("opt.disableflags", 2**30),
        ("opt.cone", "1"),
    )),
    ("data", "qacc_warmstart", np.nan), ("data", "xpos", "int"), ("data", "qM", "left out"), ("data", "qpos", "long"),
    (None, "integration", np.nan), (None, "integration", "long"), (None, "integration", "int"),
    (None, "integration", "list"), (None, "integration", "left out"), (None, "model", "list"), (None, "more", 1),
]  # fmt: skip


@pytest.fixture(scope="module")
def simulated() -> tuple[gym.Env, dict[str, Any]]:
    env = make("dmc/cheetah-run-v0")
    env.reset(seed=0)
    steps(env, random_actions(env, 5))
    return env, pack(env)[0]


@pytest.mark.parametrize(("part", "name", "value"), HOSTILE, ids=str)
def test_the_simulators_memory_is_given_what_is_saved_of_it(
    part: str | None, name: str, value: Any, simulated: tuple[gym.Env, dict[str, Any]], tmp_path: Path
) -> None:
    """Anything else is refused with nothing changed: at the next step it would take the process down."""
    env, good = simulated
    model, data = simulator_of(env)  # type: ignore[misc]
    state = through_a_file(good, tmp_path / "state")
    arrays = state["simulator"] if part is None else state["simulator"][part]
    if name in arrays:
        array = arrays[name]
    else:
        own = getattr(model if part == "model" else data, name, None)
        array = np.array(own) if isinstance(own, np.ndarray) else np.zeros(3, np.int32)
    changed: Any = value if part == "options" and not isinstance(array, np.ndarray) else {
        "int": lambda: array.astype(np.int64), "long": lambda: np.zeros((len(array) + 1, *array.shape[1:])),
        "list": lambda: [1.0], "left out": lambda: None,
    }.get(value, lambda: np.full_like(array, value))()  # fmt: skip
    arrays[name] = changed
    if value == "left out":
        del arrays[name]
    state = through_a_file(state, tmp_path / "state")
    before = data.qpos.copy(), {n: np.array(getattr(model, n)) for n in ("jnt_qposadr", "body_parentid", "body_mass")}
    with pytest.raises(DoesNotFit):
        unpack(env, state)
    np.testing.assert_array_equal(data.qpos, before[0])
    for each, array in before[1].items():
        np.testing.assert_array_equal(getattr(model, each), array)
    unpack(env, good)
    steps(env, random_actions(env, 2))


@pytest.mark.parametrize(
    ("name", "node"),
    [
        ("env", {"value": 3}), ("step", {"value": 3}), ("reset", {"same": 0}), ("_sb3_sample_state", {"value": 3}),
        ("__class__", {"value": 3}), ("t_start", {"value": 0.0}), ("rewards", {"id": 2**61 - 1, "list": []}),
        ("rewards", {"id": -1, "list": []}), ("rewards", {"same": [1]}),
    ],
)  # fmt: skip
def test_attributes_that_are_never_saved(name: str, node: Any, simulated: tuple[gym.Env, dict[str, Any]]) -> None:
    env, good = simulated
    state = copy.deepcopy(good)
    state["layers"][0]["attributes"][name] = node
    with pytest.raises(DoesNotFit):
        unpack(env, state)
    unpack(env, good)


def test_an_object_that_is_saved_elsewhere_is_not_looked_into(simulated: tuple[gym.Env, dict[str, Any]]) -> None:
    """The simulator and its task are objects of Python's, too, and have attributes."""
    env, good = simulated
    seen = set()
    for layer, value in zip(layers_of(env), good["layers"], strict=True):
        for name, own in vars(layer).items():
            if not hasattr(own, "__dict__") or isinstance(own, gym.Space) or name in value["attributes"]:
                continue
            state = copy.deepcopy(good)
            (described,) = [each for each, there in zip(state["layers"], layers_of(env), strict=True) if there is layer]
            described["attributes"][name] = {"object": class_name(own), "attributes": {"hostile": {"value": 1}}}
            with pytest.raises(DoesNotFit):
                unpack(env, state)
            assert "hostile" not in vars(own)
            seen.add(class_name(own))
    assert any(name.endswith(".Physics") for name in seen), seen
    unpack(env, good)


class Sharing(gym.Env):
    """Two names for one generator and one list, its spaces' own generators, and an object."""

    def __init__(self, limit: int = 5) -> None:
        self.observation_space = spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Discrete(7)})
        self.action_space = spaces.Box(-1, 1, (1,))
        self.limit = limit
        self.inner = Inner()

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.generator = self.np_random
        self.trace = self.inner.trace = []
        return self._observation(), {}

    def _observation(self) -> Any:
        observation = self.observation_space.sample()
        observation["a"] = np.float32([self.generator.random(), self.np_random.random()])
        return observation

    def step(self, action: Any) -> Any:
        self.inner.trace.append(len(self.trace))
        return self._observation(), float(len(self.trace)), False, len(self.trace) >= 15, {}


class Inner:
    def __init__(self) -> None:
        self.trace: list[int] = []


def test_what_is_shared_is_shared_afterwards(tmp_path: Path) -> None:
    env, other = Sharing(), Sharing()
    for i, each in enumerate((env, other)):
        each.reset(seed=i)
    actions = random_actions(env, 40)
    follow = lambda each: [str(part) for part in _steps(each, actions)]  # noqa: E731
    state = through_a_file(pack(env)[0], tmp_path / "state")
    expected = follow(env)
    unpack(other, state)
    assert other.generator is other.np_random and other.trace is other.inner.trace
    assert follow(other) == expected
    # In memory as well, but for the generators of spaces.
    saved = save_state(env)
    restore_state(other, saved)
    assert other.generator is other.np_random and other.trace is other.inner.trace


def _steps(env: gym.Env, actions: list[Any]) -> list[Any]:
    seen = []
    for action in actions:
        observation, reward, _, truncated, _ = env.step(action)
        seen.append((observation, reward, env.reset()[0] if truncated else None))
    return seen


def test_what_is_not_known_is_named() -> None:
    env = Sharing()
    env.secret = iter([])  # type: ignore[attr-defined]
    env.inner.deeper = {"a": [open]}  # type: ignore[attr-defined]  # a function is no state
    assert pack(Monitor(env))[1] == ["Sharing: secret (builtins.list_iterator)"]


def test_states_of_other_environments() -> None:
    state = pack(make("Hopper-v5"))[0]
    with pytest.raises(DoesNotFit, match=r"consists of .*Walker2dEnv.* the saved one of .*HopperEnv"):
        unpack(make("Walker2d-v5"), state)
    env = make_env("dmc/walker-run-v0")
    env.reset()
    state = pack(env)[0]
    state["simulator"]["data"]["qpos"] = np.zeros(3)
    with pytest.raises(DoesNotFit, match="another MuJoCo model than the saved one: qpos"):
        unpack(env, state)
    assert same(pack(env)[0]["simulator"]["data"]["xpos"], state["simulator"]["data"]["xpos"])
    sharing, other = Sharing(), Sharing()
    sharing.reset(seed=0)
    other.reset(seed=0)
    other.inner = None  # type: ignore[assignment]
    with pytest.raises(DoesNotFit, match="Sharing.inner is builtins.NoneType, but was .*Inner"):
        unpack(other, pack(sharing)[0])
    assert len(layers_of(Monitor(sharing))) == 2


def test_long_lists_of_numbers_come_back_as_they_were(tmp_path: Path) -> None:
    values: list[Any] = [
        [0.1 * i for i in range(40)],
        list(range(-20, 20)),
        [float("nan"), float("inf"), *[-0.0] * 30],
        [2**80] * 20,
        [True] * 20,
        [np.float64(0.1)] * 20,
        [1, 2.0] * 10,
    ]
    node = through_a_file(Describer().describe(values), tmp_path / "state")
    assert sum("numbers" in item for item in node["list"]) == 2
    again = Restorer().restore(node, None, "values")
    assert [[(type(x), repr(x)) for x in items] for items in again] == [
        [(type(x), repr(x)) for x in items] for items in values
    ]
