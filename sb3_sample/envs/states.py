"""
Save and restore the state of an environment, so that other actions can be tried at a visited state.

A saved state is all that decides the future: the state of the simulator (or of Atari's console) and of the task, the
counters of time limits and wrappers, and the random generators. The simulator's state is ``mjData``, with the
quantities derived from positions and velocities, and the numbers of the model, which some tasks and wrappers draw anew
for each episode: options such as gravity, contact masks and colours are among them, kinds of parts and indices are not.
A state can be restored any number of times, in its own environment or in another one that was made in the same way.
"""

import collections
import copy
import enum
import functools
import io
import random
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor

from sb3_sample.envs.atari import is_atari
from sb3_sample.envs.mujoco_model import model_numbers, set_model_numbers
from sb3_sample.saving.attributes import IMMUTABLE, attributes_of, is_view_of_foreign_memory, keeps_more

#: Attributes of these types cannot change, so that they are kept as they are.
_CONSTANTS = (type(None), bool, int, float, complex, str, bytes, np.generic, enum.Enum, *IMMUTABLE)
#: Attributes of these types are part of the state, with what they contain.
_CONTAINERS = (list, tuple, dict, set, frozenset, collections.deque)
_GENERATORS = (np.random.Generator, np.random.RandomState, random.Random)
#: Descriptions of an environment or its interface: never a part of the state.
_NOT_STATE = (
    gym.Env, gym.Space, gym.envs.registration.EnvSpec, io.IOBase, type, types.ModuleType, types.FunctionType
)  # fmt: skip
#: Attributes of Monitor that report on all episodes so far. Nothing depends on them, nor on its clock.
EPISODES = ("episode_returns", "episode_lengths", "episode_times")
#: Attribute of Monitor that holds the rewards of the episode under way, of which it reports the sum and the number.
REWARDS = "rewards"
#: Callables that hold references to objects.
BOUND = (types.MethodType, functools.partial)


class EnvState(NamedTuple):
    """
    State of an environment, made by :func:`save_state`.

    :param layers: attributes of the environment's wrappers, outermost first, of the environment itself, and of its task
        and control loop if it is one of dm_control
    :param data: copy of MuJoCo's data; None without MuJoCo
    :param model: arrays of MuJoCo's model and numbers of its options, by name: ``body_mass``, ``opt.gravity``
    :param console: state of the Arcade Learning Environment's console, including its generator; None for other
        environments
    :param names: names of all attributes of each layer, for those that an environment gets later
    """

    layers: list[dict[str, Any]]
    data: Any
    model: dict[str, Any]
    console: Any
    names: tuple[frozenset[str], ...]


def save_state(env: gym.Env) -> EnvState:
    """
    :param env: environment of this package's ``dmc/``, of Gymnasium's MuJoCo, of Atari (``ale-py``), or one whose state
        is in its Python attributes (Gymnasium's classic control), wrapped or not
    :return: its state
    :raises TypeError: ``env`` is not a ``gymnasium.Env``
    """
    layers, simulator = layers_of(env), simulator_of(env)
    data, model = None, {}
    if simulator is not None:
        data = copy.copy(simulator[1])
        model = model_numbers(simulator[0])
    # Copied together, so that a generator that two of them share is shared in the copy.
    attributes = _copies(layers, [state_attributes(layer) for layer in layers])
    base: Any = env.unwrapped
    console = base.clone_state(include_rng=True) if is_atari(env) else None
    return EnvState(attributes, data, model, console, tuple(frozenset(vars(layer)) for layer in layers))


def restore_state(env: gym.Env, state: EnvState, rng: np.random.Generator | None = None) -> None:
    """
    Restore a saved state: the same actions then give the same observations and rewards, bit for bit.

    :param env: the environment that the state was saved from, or one made in the same way
    :param state: from :func:`save_state`; it is not changed
    :param rng: if given, the environment's random generators, NumPy's and Python's, in attributes and in containers and
        objects there, are replaced by others with seeds drawn from it, so that a task that is random after its reset
        continues at random from the state. The generator of Atari's console, which draws sticky actions, cannot be
        seeded and is restored. The action that a sticky action of the next step would repeat is not: it is the last one
        taken in ``env``
    :raises ValueError: ``state`` is of an environment with other wrappers, or of another model
    """
    layers, simulator = layers_of(env), simulator_of(env)
    if len(layers) != len(state.layers):
        raise ValueError(
            f"state must be of an environment wrapped like env: it has {len(state.layers)} layers, env {len(layers)}"
        )
    if (simulator is None) != (state.data is None):
        raise ValueError("state must be of an environment like env: only one of the two is simulated by MuJoCo")
    if simulator is not None:
        import mujoco

        model, data = simulator
        if model.nq != len(state.data.qpos) or model.nbody != len(state.data.xpos):
            raise ValueError(
                f"state must be of env's model: it has {len(state.data.qpos)} positions of {len(state.data.xpos)} "
                f"bodies, env {model.nq} of {model.nbody}"
            )
        set_model_numbers(model, state.model)
        mujoco.mj_copyData(data, model, state.data)
    if is_atari(env) != (state.console is not None):
        raise ValueError("state must be of an environment like env: only one of the two is Atari's")
    if state.console is not None:
        base: Any = env.unwrapped
        base.restore_state(state.console)
    fresh: dict[int, Any] = {}
    if rng is not None:
        values = [
            value
            for layer, each in zip(layers, state.layers, strict=True)
            for name, value in each.items()
            if not (isinstance(layer, Monitor) and name == REWARDS)  # numbers, which grow with the episode
        ]
        fresh = {id(each): _seeded(each, int(rng.integers(2**63))) for each in _generators_in(values, set())}
    for layer, attributes in zip(layers, _copies(layers, state.layers, fresh), strict=True):
        for name, value in attributes.items():
            setattr(layer, name, value)
    for layer, names in zip(layers, state.names, strict=True):
        for name in vars(layer).keys() - names:
            if _is_state(vars(layer)[name], set()):
                delattr(layer, name)


def check_restorable(env: gym.Env, other: gym.Env | None = None, n_steps: int = 20, seed: int = 0) -> None:
    """
    Try saving and restoring: reach a state by random actions, take further ones, and repeat these from the restored
    state.

    :param env: environment; it is reset
    :param other: environment to restore the state in, after a reset with another seed; ``env`` itself if None
    :param n_steps: steps before the state and, at most, from it
    :param seed: of the reset and the actions
    :raises ValueError: the two differ in an observation, reward or end of the episode
    """
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    for _ in range(n_steps):
        _, _, terminated, truncated, _ = env.step(random_action(env.action_space, rng))
        if terminated or truncated:
            env.reset()
    state = save_state(env)
    actions = [random_action(env.action_space, rng) for _ in range(n_steps)]
    first = list(_follow(env, actions))
    other = env if other is None else other
    # Numbers that a reset draws must be restored, too.
    other.reset(seed=seed + 1)
    message = (
        f"env must be an environment whose state can be saved and restored, as those of dmc/, Gymnasium's MuJoCo and "
        f"classic control, and Atari's, not {env}: "
    )
    restore_state(other, state)
    try:
        second = list(_follow(other, actions))
    except Exception as error:  # an environment whose state is restored only in part may raise anything
        raise ValueError(f"{message}it fails after its state was restored ({error!r})") from error
    if not _equal(first, second):
        raise ValueError(f"{message}the same actions gave something else after its state was restored")


def check_step(env: gym.Env, state: EnvState, action: Any, observation: Any, reward: float, ended: bool) -> None:
    """
    Take an action once more from a saved state, and compare with what came of it.

    :param env: environment to restore the state in
    :param state: the state in which the action was taken
    :param action: the action
    :param observation: the observation that followed; not compared at an end, as the environment may have changed it in
        the reset that came after
    :param reward: the reward
    :param ended: whether the episode ended
    :raises ValueError: if another observation, reward or end follows
    """
    restore_state(env, state)
    try:
        again, its_reward, terminated, truncated, _ = env.step(action)
    except Exception as error:  # an environment whose state is restored only in part may raise anything
        raise ValueError(f"it fails after its state was restored ({error!r})") from error
    got = {
        "observation": ended or _equal(_as_given(again, observation), observation),
        "reward": np.float32(its_reward) == np.float32(reward),
        "end of the episode": (terminated or truncated) == ended,
    }
    wrong = [name for name, same in got.items() if not same]
    if wrong:
        raise ValueError(f"after its state was restored, the same action gave another {' and another '.join(wrong)}")


def _as_given(observation: Any, given: Any) -> Any:
    """An observation in the types of another, in which a vectorised environment holds it."""
    if isinstance(given, dict):
        return {key: _as_given(observation[key], value) for key, value in given.items()}
    return np.asarray(observation).astype(np.asarray(given).dtype)


def random_action(space: gym.Space, rng: np.random.Generator) -> Any:
    """
    :param space: space of actions; its own generator is not used
    :param rng: generator
    :return: a random element
    """
    space = copy.deepcopy(space)
    space.seed(int(rng.integers(2**31)))
    return space.sample()


# ---------------------------------------------------------------- where the state is


def layers_of(env: gym.Env) -> list[Any]:
    """
    :param env: an environment, wrapped or not
    :return: the objects whose attributes are part of its state: wrappers, environment, dm_control's loop and task
    :raises TypeError: ``env`` is not a ``gymnasium.Env``
    """
    if not isinstance(env, gym.Env):
        raise TypeError(f"env must be a gymnasium.Env, not {env!r}")
    layers: list[Any] = [env]
    while isinstance(layers[-1], gym.Wrapper):
        layers.append(layers[-1].env)
    dm_env = getattr(layers[-1], "dm_env", None)
    if dm_env is not None:
        return [*layers, dm_env, dm_env.task]
    # An environment around one of another library, as in metaworld/.
    inside = [layer for value in vars(layers[-1]).values() if isinstance(value, gym.Env) for layer in layers_of(value)]
    return layers + inside


def simulator_of(env: gym.Env) -> tuple[Any, Any] | None:
    """
    :param env: an environment, wrapped or not
    :return: MuJoCo's model and data; None if MuJoCo does not simulate it
    """
    base = env.unwrapped
    if hasattr(base, "dm_env"):
        physics = base.dm_env.physics
        return physics.model.ptr, physics.data.ptr
    for layer in reversed(layers_of(env)):
        model, data = vars(layer).get("model"), vars(layer).get("data")
        if type(model).__module__.startswith("mujoco"):
            return model, data
    return None


def state_attributes(layer: Any) -> dict[str, Any]:
    """
    Select the attributes of a wrapper or an environment that may change.

    :param layer: the wrapper or environment
    :return: its attributes that consist of data only, by name, not copied; without Monitor's lists of all episodes,
        which grow with the training
    """
    is_monitor = isinstance(layer, Monitor)
    left_out = (*EPISODES, "t_start") if is_monitor else ()
    # Numbers: looking at each would take the longer, the older the episode is.
    numbers = (REWARDS,) if is_monitor else ()
    return {
        name: value
        for name, value in vars(layer).items()
        if name not in left_out and (name in numbers or _is_state(value, set()))
    }


def _copies(
    layers: Sequence[Any], attributes: list[dict[str, Any]], replaced: Mapping[int, Any] | None = None
) -> list[dict[str, Any]]:
    """
    Deep copies of the layers' attributes; Monitor's rewards of this episode, which are numbers, as a whole. Of objects
    whose ids are in ``replaced``, the objects there in place of a copy.
    """
    rewards = [
        each[REWARDS]
        for layer, each in zip(layers, attributes, strict=True)
        if isinstance(layer, Monitor) and REWARDS in each
    ]
    return copy.deepcopy(attributes, {**{id(each): list(each) for each in rewards}, **(replaced or {})})


def _is_state(value: Any, seen: set[int]) -> bool:
    """
    Whether a value consists of data only: numbers, arrays, generators, containers and objects of them.

    :param value: any
    :param seen: ids of the values examined so far, which may refer to themselves in a cycle
    """
    if isinstance(value, np.ndarray):
        # A view of the simulator's own memory, as some tasks of Meta-World keep, is restored with that memory.
        return not is_view_of_foreign_memory(value)
    if isinstance(value, (*_CONSTANTS, *_GENERATORS)):
        return True
    if id(value) in seen:
        return True
    seen.add(id(value))
    if not isinstance(value, (*_CONTAINERS, *BOUND)):
        # Objects of a wrapper, such as the running mean and variance of a normalisation. A simulator's are the layers'
        # and the data's; an environment inside of another attribute is none of the wrappers that this module knows.
        if isinstance(value, _NOT_STATE) or type(value).__module__.startswith(
            ("mujoco", "dm_control", "gymnasium.envs")
        ):
            return False
        if not hasattr(value, "__dict__") and (keeps_more(type(value)) or not attributes_of(value)):
            return False
    return all(_is_state(item, seen) for item in _inside(value))


def _inside(value: Any) -> Iterable[Any]:
    """Values that a container, an object or a callable bound to objects holds."""
    if isinstance(value, dict):
        return value.values()
    if isinstance(value, _CONTAINERS):
        return value  # type: ignore[no-any-return]
    if isinstance(value, types.MethodType):
        # A method of an environment or a wrapper is no state: its copy would be bound to a copy of them, which nothing
        # steps.
        return (value.__self__,)
    if isinstance(value, functools.partial):
        called = () if isinstance(value.func, types.FunctionType) else (value.func,)
        return (*called, *value.args, *value.keywords.values())
    return attributes_of(value).values()


def _generators_in(value: Any, seen: set[int]) -> Iterator[Any]:
    """
    Random generators in a value of state attributes, each once, in the order of the attributes.

    :param value: any that consists of data only, or a container of such
    :param seen: ids of the values examined so far
    """
    if isinstance(value, (np.ndarray, *_CONSTANTS, *_NOT_STATE)) or id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, _GENERATORS):
        yield value
        return
    for item in _inside(value):
        yield from _generators_in(item, seen)


def is_simulator(value: Any) -> bool:
    """
    :param value: value of an attribute of an environment
    :return: whether it may be the environment's simulator: neither a part of the state nor a description
    """
    return not _is_state(value, set()) and not isinstance(value, (*_NOT_STATE, *BOUND))


def _seeded(generator: Any, seed: int) -> Any:
    """A generator of the same kind with a seed of its own, for numbers and for the generators that it spawns."""
    if isinstance(generator, np.random.RandomState):
        return np.random.RandomState(type(generator._bit_generator)(seed))  # type: ignore[attr-defined]
    if isinstance(generator, np.random.Generator):
        return type(generator)(type(generator.bit_generator)(seed))
    other = copy.deepcopy(generator)
    other.seed(seed)
    return other


# ---------------------------------------------------------------- the check


def _follow(env: gym.Env, actions: list[Any]) -> Iterator[tuple[Any, ...]]:
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        yield copy.deepcopy(observation), float(reward), terminated, truncated
        if terminated or truncated:
            # The next episode depends on the state as well: on that of the generators.
            yield copy.deepcopy(env.reset()[0]), 0.0, False, False


def _equal(first: Any, second: Any) -> bool:
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(_equal(first[key], second[key]) for key in first)
    if isinstance(first, (list, tuple)):
        return len(first) == len(second) and all(_equal(a, b) for a, b in zip(first, second, strict=True))
    return np.array_equal(first, second, equal_nan=np.asarray(first).dtype.kind == "f")
