"""Several tasks as one vectorised environment, whose observations include the task."""

import difflib
import functools
import os
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_sample.envs.registration import PACKAGE, make_env, register_all
from sb3_sample.envs.suites import SUITES
from sb3_sample.kinds import SEED, check_value


class TaskEnv(gym.Wrapper):
    """
    One of several tasks: the observation is padded with zeros at the end and accompanied by the task's number, and
    dimensions that the task does not use are cut from the end of the action.

    At the end of an episode, ``info["episode"]`` of ``Monitor`` gets "task", the task's id, and "is_success" if the
    environment reports it, so that Stable-Baselines3's ``ep_info_buffer`` can be read by task.

    :param env: the task's environment, with vectors as observations and actions
    :param task_id: its id
    :param task: its number
    :param observation_space: Dict of "observation", a Box of shape (O,), and "task", a Discrete
    :param action_space: Box of shape (A,). If it is the environment's own, actions pass unchanged; otherwise actions
        are in [-1, 1], and are scaled to the environment's bounds
    """

    def __init__(
        self, env: gym.Env, task_id: str, task: int, observation_space: spaces.Dict, action_space: spaces.Box
    ) -> None:
        super().__init__(env)
        self.observation_space, self.action_space = observation_space, action_space
        self.task_id, self.task = task_id, task
        own: Any = env.action_space
        self._low, self._high = own.low, own.high
        self._rescales = action_space != own and bool((own.low != -1).any() or (own.high != 1).any())

    def _observed(self, observation: np.ndarray) -> dict[str, Any]:
        space = self.observation_space["observation"]  # type: ignore[index]
        padded = np.zeros(space.shape, space.dtype)
        padded[: len(observation)] = observation
        return {"observation": padded, "task": self.task}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict]:
        """
        :param seed: as the environment takes it
        :param options: likewise
        :return: "observation", (O,), and "task"; and the environment's info
        """
        observation, info = self.env.reset(seed=seed, options=options)
        return self._observed(observation), info

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """
        :param action: (A,), of which the first dimensions are the task's
        :return: "observation", (O,), and "task"; reward, terminated, truncated and info are the environment's
        """
        own = np.asarray(action)[: len(self._low)]
        if self._rescales:
            own = np.clip(self._low + 0.5 * (own + 1.0) * (self._high - self._low), self._low, self._high)
        observation, reward, terminated, truncated, info = self.env.step(own)
        if "episode" in info:
            info["episode"]["task"] = self.task_id
            if "is_success" in info:
                info["episode"]["is_success"] = float(info["is_success"])
        return self._observed(observation), float(reward), terminated, truncated, info


def multi_task_env(
    ids: str | Sequence[str],
    seed: int | None = None,
    env_kwargs: dict[str, Any] | None = None,
    vec_env_cls: type[VecEnv] | None = None,
    vec_env_kwargs: dict[str, Any] | None = None,
    monitor_dir: str | os.PathLike[str] | None = None,
) -> VecEnv:
    """
    Make several tasks one vectorised environment: task k is its environment k, and all take a step together.

    Observations are a Dict of "observation", padded with zeros at the end to the size of the largest, and "task", the
    task's number (Discrete). Actions have the size of the largest, and each task gets the first dimensions. Actions are
    in [-1, 1] and scaled to the bounds of each task; a single task keeps its own spaces and actions. Each environment
    is wrapped in ``Monitor``, and ``env.get_attr("task_id")`` gives the ids in their order.

    :param ids: ids of environments and names of ``sb3_sample.envs.suites``, such as "MT10", "MT50" and "DMC_DOGS"; one
        of them, or a list
    :param seed: seed of the first task; the others have the following ones, as in ``make_vec_env``; None for none
    :param env_kwargs: arguments of ``make_env`` for each task, e.g. ``{"max_episode_steps": 500}``
    :param vec_env_cls: ``DummyVecEnv`` (None), ``SubprocVecEnv`` or another
    :param vec_env_kwargs: its arguments
    :param monitor_dir: folder of Monitor's files, ``<task>.monitor.csv``; None for none
    :return: the vectorised environment
    :raises ValueError: if an id is unknown or given twice, a task has other observations than vectors of floats, or
        other actions than a bounded Box of one axis, or the seed is none; the message names it
    :raises ImportError: the library of a task is not installed; the message says how to install it
    """
    check_value("seed", seed, SEED.or_none())
    task_ids = _task_ids(ids)
    kwargs = dict(env_kwargs or {})
    made: list[gym.Env] = []
    try:
        for task_id in task_ids:
            made.append(make_env(task_id, **kwargs))
            _check(task_id, made[-1])
    except BaseException:
        _close(made)
        raise
    observation_space, action_space = _common_spaces(made)
    wrap = [
        functools.partial(
            _wrapped, task_id, task, observation_space, action_space, None if seed is None else seed + task, monitor_dir
        )
        for task, task_id in enumerate(task_ids)
    ]
    if monitor_dir is not None:
        os.makedirs(monitor_dir, exist_ok=True)
    makers: list[Callable[[], gym.Env]]
    if vec_env_cls is None or vec_env_cls is DummyVecEnv:
        makers = [functools.partial(each, env) for each, env in zip(wrap, made, strict=True)]
    else:
        # Other classes make the environments anew: these were only needed for their spaces.
        _close(made)
        makers = [functools.partial(_remade, each, kwargs) for each in wrap]
    make: Any = vec_env_cls or DummyVecEnv
    env: VecEnv = make(makers, **(vec_env_kwargs or {}))
    if seed is not None:
        env.seed(seed)
    return env


def _task_ids(ids: str | Sequence[str]) -> list[str]:
    register_all()
    given = [ids] if isinstance(ids, str) else ids
    if not isinstance(given, Sequence) or not given or not all(isinstance(each, str) for each in given):
        raise ValueError(f"ids must be an id, the name of a suite, or a list of them that is not empty, not {ids!r}")
    found: list[str] = []
    for name in given:
        suite = SUITES.get(name.upper().replace("-", "_"))
        task_id = name.removeprefix(f"{PACKAGE}:")
        # "module:id" is Gymnasium's way to have a module imported, which registers the id.
        if suite is None and task_id not in gym.registry and ":" not in task_id:
            close = difflib.get_close_matches(name, [*gym.registry, *SUITES], 5, 0.5)
            raise ValueError(
                f"ids has {name!r}, which is neither the id of a registered environment nor a suite"
                + (f"; close are {', '.join(close)}" if close else "")
                + f". Suites are {', '.join(SUITES)}; ids are those of sb3_sample.envs.ALL_IDS and Gymnasium's"
            )
        found += suite or (task_id,)
    twice = [each for i, each in enumerate(found) if each in found[:i]]
    if twice:
        raise ValueError(f"ids has {twice[0]!r} twice: each task can be there once")
    return found


def _check(task_id: str, env: gym.Env) -> None:
    observations, actions = env.observation_space, env.action_space
    kind = "tasks of several kinds have no common space"
    is_vector = isinstance(observations, spaces.Box) and len(observations.shape) == 1
    if not is_vector or not np.issubdtype(observations.dtype, np.floating):
        raise ValueError(
            f"ids must be tasks whose observations are vectors of floats, and {task_id!r} has {observations}: {kind}"
        )
    is_vector = isinstance(actions, spaces.Box) and len(actions.shape) == 1
    if not is_vector or not np.issubdtype(actions.dtype, np.floating) or not actions.is_bounded():  # type: ignore[attr-defined]
        raise ValueError(
            f"ids must be tasks whose actions are bounded vectors of floats, and {task_id!r} has {actions}: {kind}"
        )


def _common_spaces(envs: Sequence[gym.Env]) -> tuple[spaces.Dict, spaces.Box]:
    """Common spaces of all tasks; a single task keeps its own."""
    observations: list[Any] = [env.observation_space for env in envs]
    actions: list[Any] = [env.action_space for env in envs]
    observation, action = observations[0], actions[0]
    if len(envs) > 1:
        sizes = [space.shape[0] for space in observations]
        # Padded entries are zero, and so are their bounds.
        low, high = np.zeros((2, len(envs), max(sizes)))
        for i, space in enumerate(observations):
            low[i, : sizes[i]], high[i, : sizes[i]] = space.low, space.high
        dtype = np.result_type(*(space.dtype for space in observations))
        observation = spaces.Box(low.min(axis=0).astype(dtype), high.max(axis=0).astype(dtype), dtype=dtype.type)
        action = spaces.Box(-1.0, 1.0, (max(space.shape[0] for space in actions),), np.float32)
    return spaces.Dict({"observation": observation, "task": spaces.Discrete(len(envs))}), action


def _wrapped(
    task_id: str,
    task: int,
    observation_space: spaces.Dict,
    action_space: spaces.Box,
    seed: int | None,
    monitor_dir: str | os.PathLike[str] | None,
    env: gym.Env,
) -> gym.Env:
    file = None if monitor_dir is None else os.path.join(monitor_dir, str(task))
    wrapped = TaskEnv(Monitor(env, file), task_id, task, observation_space, action_space)
    if seed is not None:
        wrapped.action_space.seed(seed)
    return wrapped


def _remade(wrap: "functools.partial[gym.Env]", kwargs: dict[str, Any]) -> gym.Env:
    return wrap(make_env(wrap.args[0], **kwargs))


def _close(envs: Sequence[gym.Env]) -> None:
    for env in envs:
        env.close()
