"""Agents of a plan made on trial: their arguments, whether these go together, and whether they can act in a task."""

import contextlib
import functools
from typing import Any

import gymnasium as gym
import numpy as np
import yaml
from gymnasium import spaces

from sb3_sample.envs.no_environment import NoEnvironment
from sb3_sample.study.plan import Plan, PlanError, Run
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


def make(algo: str, arguments: dict[str, Any], actions: "spaces.Space[Any] | None" = None) -> None:
    """
    Make an agent, on a small task and with the settings of ``hyperparams/<algo>.yml``, to have its arguments checked
    together.

    :param algo: its algorithm
    :param arguments: its arguments; a ``policy`` decides what the task's observations are
    :param actions: action space of the task; None: one that the algorithm is for
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
    if policy == "MlpPolicy" and actions is None:
        settings["env"] = "Pendulum-v1"
    else:
        settings["env"] = NoEnvironment(
            _observations(algo, policy), usual_actions(algo) if actions is None else actions
        )
    if policy == "CnnPolicy" and "buffer_size" in known:
        settings["buffer_size"] = 1_000  # pictures, of which hardly anything is stored here
    algorithm(**{"device": "cpu", **settings})


def usual_actions(algo: str) -> "spaces.Space[Any]":
    """
    :param algo: name of an algorithm
    :return: a small action space that it is for
    """
    return spaces.Discrete(3) if _is_for_games(algo) else spaces.Box(-1, 1, (1,), np.float32)


def _is_for_games(algo: str) -> bool:
    """Whether an algorithm is for Atari's games alone."""
    algorithm: Any = algorithms()[algo].algorithm
    return "MlpPolicy" not in algorithm.policy_aliases and not hasattr(algorithm, "learn_offline")


def _observations(algo: str, policy: str) -> "spaces.Space[Any]":
    if policy == "CnnPolicy":
        return spaces.Box(0, 255, (4, 84, 84) if _is_for_games(algo) else (3, 64, 64), np.uint8)
    numbers = spaces.Box(-1, 1, (3,), np.float32)
    return numbers if policy == "MlpPolicy" else spaces.Dict({"observation": numbers})


def check_actions(plan: Plan) -> None:
    """
    Check that the agents of a plan can act in its tasks. An environment that cannot be made here, or that the settings
    wrap, is left to its runs, and so is an agent that cannot be made on a small task of the kind that it is for.

    :param plan: the plan
    :raises PlanError: one cannot, the message names agent, task and reason; or its algorithm is none
    """
    spaces_of: dict[str, spaces.Space[Any] | None] = {}
    tried: set[tuple[str, str]] = set()
    for run in plan.runs:
        if run.algo not in algorithms():
            raise PlanError(f"algo of agent {run.agent!r} must be one of {', '.join(algorithms())}, not {run.algo!r}")
        if run.task not in spaces_of:
            spaces_of[run.task] = _action_space(run)
        space, usual = spaces_of[run.task], usual_actions(run.algo)
        if space is None or (run.variant, repr(space)) in tried or _is_wrapped(run):
            continue
        tried.add((run.variant, repr(space)))
        if type(space) is type(usual) and (not isinstance(space, spaces.Box) or space.is_bounded()):
            continue
        # Prior data are read when a run begins; without them their share means nothing.
        arguments = {name: value for name, value in run.arguments.items() if name != "prior_share"}
        if _why_not_made(run.algo, arguments, usual) is None and (why := _why_not_made(run.algo, arguments, space)):
            raise PlanError(f"agent {run.agent!r} cannot act in task {run.task!r}: {why}")


def _is_wrapped(run: Run) -> bool:
    """Whether the settings of the run's task put a wrapper around it, which may change its actions."""
    return "env_wrapper" in (settings_of(run.algo).get(run.task) or {})


def _action_space(run: Run) -> "spaces.Space[Any] | None":
    """Action space of a run's task; None if that cannot be made. Those of this package are of bounded numbers."""
    try:
        if str(gym.spec(run.task).entry_point).startswith("sb3_sample.envs."):
            return spaces.Box(-1, 1, (1,), np.float32)
        with contextlib.closing(gym.make(run.task, **run.env_kwargs)) as env:
            return env.action_space
    except Exception as error:  # its own code; the run that meets it again says so
        warn(f"{run.task} cannot be made here, so that its actions are not judged before the runs: {error}")
        return None


def _why_not_made(algo: str, arguments: dict[str, Any], actions: "spaces.Space[Any]") -> str | None:
    try:
        make(algo, arguments, actions)
    except (ValueError, TypeError, AssertionError) as error:
        return str(error)
    return None


@functools.cache
def settings_of(algo: str) -> dict[str, Any]:
    """Content of ``hyperparams/<algo>.yml``, by task."""
    from sb3_sample.zoo import HYPERPARAMS

    found: dict[str, Any] = yaml.safe_load((HYPERPARAMS / f"{algo}.yml").read_text())
    return found
