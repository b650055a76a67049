"""Trial construction of a plan's agents: checks their arguments together, and whether they can act in a task."""

import contextlib
import functools
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import yaml
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.overrides import TorchFunctionMode

from sb3_sample.replay.dataset import Dataset
from sb3_sample.warn import warn

#: Arguments of the constructors that belong to the run, not the agent; ``frame_stack`` is the zoo's VecFrameStack.
NOT_OF_AGENTS = {
    "_init_setup_model", "action_space", "device", "env", "frame_stack", "observation_space", "prior_data", "seed",
    "tensorboard_log", "verbose",
}  # fmt: skip


def algorithms() -> dict[str, Any]:
    """Algorithms by name. Imported here, since reading a study does not need the zoo."""
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
    :param value: its value in a plan
    :return: the value for the constructor: the class for a name of this package's replay buffers, all else unchanged
    """
    from sb3_sample.zoo.algorithms import BUFFERS

    return BUFFERS.get(value, value) if name == "replay_buffer_class" and isinstance(value, str) else value


def make(
    algo: str,
    arguments: dict[str, Any],
    actions: "spaces.Space[Any] | None" = None,
    has_prior_data: bool = False,
) -> "spaces.Space[Any]":
    """
    Make an agent, on a small task and with the settings of ``hyperparams/<algo>.yml``, so that its arguments are
    checked together.

    :param algo: its algorithm
    :param arguments: its arguments; the observations of the task are chosen for ``policy``
    :param actions: action space of the task; None: one that the agent supports
    :param has_prior_data: whether a share of its batches is of a data set, which is read only when a run begins; here
        it is a single transition
    :return: action space of the agent that was made
    :raises ValueError: they contradict each other, or one is out of range; a ``TypeError`` if they are of another kind
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
        settings["buffer_size"] = 1_000  # images, hardly any of which are stored here
    observations = _observations(algo, policy)
    errors: list[Exception] = []
    usual = _USUAL_ACTIONS[::-1] if _is_for_games(algo) else _USUAL_ACTIONS
    for space in usual if actions is None else [actions]:
        env = DummyVecEnv([functools.partial(_TrialEnv, observations, space)])
        if has_prior_data and isinstance(space, spaces.Box) and space.is_bounded():
            settings["prior_data"] = _transition(env)
        try:
            with _NotOrthogonal():
                algorithm(**{"device": "cpu", **settings, "env": env})
            return space
        except (ValueError, TypeError, AssertionError) as error:
            errors.append(error)
    # For example, "all actions of a discrete space" exists only with discrete actions.
    raise errors[0]


def _transition(env: DummyVecEnv) -> Dataset:
    """A data set of one transition in an environment's spaces, whose actions are bounded numbers."""
    observation, actions = env.reset(), env.action_space
    assert isinstance(actions, spaces.Box)
    return Dataset.from_arrays(
        observation, actions.low[None], [0.0], [False], [True],
        next_observations=observation, observation_space=env.observation_space, action_space=actions,
    )  # fmt: skip


class _NotOrthogonal(TorchFunctionMode):
    """
    Leaves kernels as they were drawn, before they are made orthogonal: no argument depends on it, and it is most of the
    time that large networks take to make.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.linalg.qr:
            (kernel,) = args
            return kernel, kernel[: kernel.shape[1]]
        return func(*args, **(kwargs or {}))


class _TrialEnv(gym.Env[Any, Any]):
    """
    Environment of given spaces in which nothing happens. It can be reset, copied and restored, which ``RewoundPPO``
    checks at construction.

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


#: Small action spaces, one of which each algorithm supports.
_USUAL_ACTIONS: "list[spaces.Space[Any]]" = [spaces.Box(-1, 1, (1,), np.float32), spaces.Discrete(3)]


def _is_for_games(algo: str) -> bool:
    """Check whether an algorithm is only for Atari's games."""
    algorithm: Any = algorithms()[algo].algorithm
    return "MlpPolicy" not in algorithm.policy_aliases and not hasattr(algorithm, "learn_offline")


def _observations(algo: str, policy: str) -> "spaces.Space[Any]":
    if policy == "CnnPolicy":
        return spaces.Box(0, 255, (4, 84, 84) if _is_for_games(algo) else (3, 64, 64), np.uint8)
    numbers = spaces.Box(-1, 1, (3,), np.float32)
    return numbers if policy == "MlpPolicy" else spaces.Dict({"observation": numbers})


def action_space(task: str, env_kwargs: dict[str, Any]) -> "spaces.Space[Any] | None":
    """
    Look up the action space of a task. The task is made for this, unless it is of this package, where actions are
    bounded numbers.

    :param task: id of the environment, which is registered
    :param env_kwargs: its arguments
    :return: the space; None, with a warning, if the environment cannot be made here
    """
    if str(gym.spec(task).entry_point).startswith("sb3_sample.envs."):
        return spaces.Box(-1, 1, (1,), np.float32)
    try:
        env = gym.make(task, **env_kwargs)
    except Exception as error:  # the task's code may raise anything; the run will report it
        warn(f"{task} cannot be made here, so that nothing is known of its actions before the runs: {error}")
        return None
    with contextlib.suppress(Exception):
        env.close()
    return env.action_space


def why_not_acting(
    algo: str,
    arguments: dict[str, Any],
    actions: "spaces.Space[Any]",
    made_on: "spaces.Space[Any]",
    has_prior_data: bool = False,
) -> str | None:
    """
    Find why an agent does not support an action space.

    :param algo: its algorithm
    :param arguments: its arguments
    :param actions: action space of the task
    :param made_on: action space on which it could be made
    :param has_prior_data: as in :func:`make`
    :return: the reason; None if it supports them
    """
    if isinstance(actions, type(made_on)) and _is_plain(actions):
        return None
    try:
        make(algo, arguments, actions, has_prior_data)
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
