"""Agents of a plan made on trial: their arguments, whether these go together, and whether they can act in a task."""

import contextlib
import functools
from typing import Any

import gymnasium as gym
import numpy as np
import yaml
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_sample.warn import warn

#: Arguments of the constructors that are the run's, not the agent's; ``frame_stack`` is the zoo's VecFrameStack.
NOT_OF_AGENTS = {
    "_init_setup_model", "action_space", "device", "env", "frame_stack", "observation_space", "prior_data", "seed",
    "tensorboard_log", "verbose",
}  # fmt: skip


def algorithms() -> dict[str, Any]:
    """The algorithms by their names. Imported here: a study that is only looked at needs no zoo."""
    from sb3_sample.zoo import ALGORITHMS

    return ALGORITHMS


def constructor_arguments(algo: str) -> dict[str, Any]:
    """
    :param algo: name of an algorithm
    :return: by name, the arguments of its constructor that an agent of a plan may have
    """
    declared = algorithms()[algo].algorithm.constructor_arguments
    return {name: argument for name, argument in declared.items() if name not in NOT_OF_AGENTS}


def constructor_value(name: str, value: Any) -> Any:
    """
    :param name: of an argument
    :param value: as a plan has it
    :return: the value for the constructor: a replay buffer of this package by its name, all else as it is
    """
    from sb3_sample.zoo.algorithms import BUFFERS

    return BUFFERS.get(value, value) if name == "replay_buffer_class" and isinstance(value, str) else value


def make(algo: str, arguments: dict[str, Any], actions: "spaces.Space[Any] | None" = None) -> "spaces.Space[Any]":
    """
    Make an agent, on a small task and with the settings of ``hyperparams/<algo>.yml``, to have its arguments checked
    together.

    :param algo: its algorithm
    :param arguments: its arguments; the observations of the task are those that ``policy`` is for
    :param actions: action space of the task; None: one that the agent is for
    :return: action space of the agent that was made
    :raises ValueError: they do not go together, or one is out of range; a ``TypeError`` where they are of another kind
    """
    from rl_zoo3.exp_manager import ExperimentManager

    arguments = {name: constructor_value(name, value) for name, value in arguments.items()}
    known = constructor_arguments(algo)
    entries = settings_of(algo)
    default = entries.get("default") or entries["atari"]
    settings = {name: value for name, value in default.items() if name in known and not isinstance(value, str)}
    settings = ExperimentManager._preprocess_schedules({**settings, **arguments})
    algorithm: Any = algorithms()[algo].algorithm
    policy = settings.setdefault("policy", "MlpPolicy" if "MlpPolicy" in algorithm.policy_aliases else "CnnPolicy")
    if policy == "CnnPolicy" and "buffer_size" in known:
        settings["buffer_size"] = 1_000  # pictures, of which hardly anything is stored here
    observations = _observations(algo, policy)
    errors: list[Exception] = []
    for space in _USUAL_ACTIONS if actions is None else [actions]:
        env = DummyVecEnv([functools.partial(_TrialEnv, observations, space)])
        try:
            algorithm(**{"device": "cpu", **settings, "env": env})
            return space
        except (ValueError, TypeError, AssertionError) as error:
            errors.append(error)
    # All actions of a discrete space, say, are only there where actions are discrete.
    raise errors[-1 if _is_for_games(algo) else 0]


class _TrialEnv(gym.Env[Any, Any]):
    """
    Environment of given spaces in which nothing happens. One that can be reset, copied and restored: ``RewoundPPO``
    tries that when it is made.

    :param observation_space: observation space
    :param action_space: action space
    """

    def __init__(self, observation_space: "spaces.Space[Any]", action_space: "spaces.Space[Any]"):
        self.observation_space, self.action_space = observation_space, action_space
        self._observation = observation_space.sample()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._observation, 0.0, False, False, {}


#: Small action spaces, for one of which each algorithm is.
_USUAL_ACTIONS: "list[spaces.Space[Any]]" = [spaces.Box(-1, 1, (1,), np.float32), spaces.Discrete(3)]


def _is_for_games(algo: str) -> bool:
    """Check whether an algorithm is for Atari's games alone."""
    algorithm: Any = algorithms()[algo].algorithm
    return "MlpPolicy" not in algorithm.policy_aliases and not hasattr(algorithm, "learn_offline")


def _observations(algo: str, policy: str) -> "spaces.Space[Any]":
    if policy == "CnnPolicy":
        return spaces.Box(0, 255, (4, 84, 84) if _is_for_games(algo) else (3, 64, 64), np.uint8)
    numbers = spaces.Box(-1, 1, (3,), np.float32)
    return numbers if policy == "MlpPolicy" else spaces.Dict({"observation": numbers})


def action_space(task: str, env_kwargs: dict[str, Any]) -> "spaces.Space[Any] | None":
    """
    Look up the action space of a task, which is made for that, unless it is of this package: bounded numbers.

    :param task: id of the environment, which is registered
    :param env_kwargs: its arguments
    :return: the space; None, with a warning, if the environment cannot be made here
    """
    if str(gym.spec(task).entry_point).startswith("sb3_sample.envs."):
        return spaces.Box(-1, 1, (1,), np.float32)
    try:
        env = gym.make(task, **env_kwargs)
    except Exception as error:  # its own code; the run that meets it again says so
        warn(f"{task} cannot be made here, so that nothing is known of its actions before the runs: {error}")
        return None
    with contextlib.suppress(Exception):
        env.close()
    return env.action_space


def why_not_acting(
    algo: str, arguments: dict[str, Any], actions: "spaces.Space[Any]", made_on: "spaces.Space[Any]"
) -> str | None:
    """
    Find why an agent does not take an action space.

    :param algo: its algorithm
    :param arguments: its arguments
    :param actions: action space of the task
    :param made_on: one on which it could be made
    :return: the reason; None if it takes them
    """
    if isinstance(actions, type(made_on)) and _is_plain(actions):
        return None
    try:
        make(algo, arguments, actions)
    except (ValueError, TypeError, AssertionError) as error:
        return str(error)
    return None


def _is_plain(actions: "spaces.Space[Any]") -> bool:
    if isinstance(actions, spaces.Box):
        return actions.is_bounded() and bool((actions.low < actions.high).all())
    return bool(getattr(actions, "start", 0) == 0)


@functools.cache
def settings_of(algo: str) -> dict[str, Any]:
    """Content of ``hyperparams/<algo>.yml``, by task."""
    from sb3_sample.zoo import HYPERPARAMS

    found: dict[str, Any] = yaml.safe_load((HYPERPARAMS / f"{algo}.yml").read_text())
    return found
