"""Recording of data sets: a policy's episodes."""

import contextlib
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_sample.kinds import check_value, integer
from sb3_sample.learner.batch import for_each
from sb3_sample.replay.dataset import Dataset
from sb3_sample.replay.steps import check_action_space
from sb3_sample.saving.normalization import lacks_vec_normalize
from sb3_sample.warn import warn


def record(
    model: Any, env: gym.Env | VecEnv | str, episodes: int, *, deterministic: bool = True, seed: int | None = None
) -> Dataset:
    """
    Record episodes of a policy, as it acts in evaluation.

    :param model: any object with Stable-Baselines3's ``predict``
    :param env: environment, vectorised environment or id. With a ``VecNormalize`` the policy gets observations
        normalised by its current statistics, and the data set the original ones
    :param episodes: number of whole episodes; several environments share them evenly, as in ``evaluate_policy``
    :param deterministic: whether the policy's mean action is taken instead of a sample
    :param seed: of the environment; None: as it is
    :return: the data set
    :raises ValueError: if ``episodes`` is not a number above 0, if the model's spaces are not the environment's, if the
        actions are not of a bounded Box, or if the model learned from observations that a ``VecNormalize`` normalised
        and ``env`` is in none
    """
    check_value("episodes", episodes, integer(1))
    if isinstance(env, str):
        with contextlib.closing(make_vec_env(env)) as made:
            return record(model, made, episodes, deterministic=deterministic, seed=seed)
    venv: VecEnv = BaseAlgorithm._wrap_env(env)
    for name in "observation_space", "action_space":
        theirs, of_model = getattr(venv, name), getattr(model, name, None)
        if of_model is not None and of_model != theirs:
            raise ValueError(f"env: its {name} is {theirs}, and the model's is {of_model}")
    actions_of = venv.action_space
    if not isinstance(actions_of, spaces.Box):
        raise ValueError(f"env: its actions must be of a Box, as those of a data set are, not of {actions_of}")
    check_action_space(actions_of.shape, actions_of)
    normalize = unwrap_vec_normalize(venv)
    if normalize is None and isinstance(model, BaseAlgorithm):
        _check_not_normalized(model)
    venv = _below(venv, normalize)
    if seed is not None:
        venv.seed(seed)
    n_envs = venv.num_envs
    wanted = (episodes + np.arange(n_envs)) // n_envs
    done: list[list[dict[str, Any]]] = []
    under_way: list[list[dict[str, Any]]] = [[] for _ in range(n_envs)]
    counts = np.zeros(n_envs, int)
    observations, state, starts = venv.reset(), None, np.ones(n_envs, bool)
    while (counts < wanted).any():
        seen = observations if normalize is None else normalize.normalize_obs(observations)  # type: ignore[arg-type]
        actions, state = model.predict(seen, state=state, episode_start=starts, deterministic=deterministic)
        following, rewards, starts, infos = venv.step(actions)
        for i in range(n_envs):
            ends, info = bool(starts[i]), infos[i]
            if "worker_died" in info:
                # The step was not taken; another episode is recorded.
                under_way[i] = []
                continue
            step = {
                "observations": for_each(lambda part, i=i: part[i].copy(), observations),  # type: ignore[misc]
                "actions": np.array(actions[i]),
                "rewards": rewards[i],
                "terminations": ends and not info.get("TimeLimit.truncated", False),
                "truncations": ends and info.get("TimeLimit.truncated", False),
                "next_observations": info["terminal_observation"]
                if ends
                else for_each(lambda part, i=i: part[i].copy(), following),  # type: ignore[misc]
            }
            under_way[i].append(step)
            if ends:
                if counts[i] < wanted[i]:
                    done.append(under_way[i])
                counts[i], under_way[i] = counts[i] + 1, []
        observations = following
    steps = [step for episode in done for step in episode]
    arrays = {name: _stacked([step[name] for step in steps]) for name in steps[0]}
    for name in ("observations", "next_observations"):
        # The number of a Discrete space is a row of one.
        arrays[name] = for_each(lambda part: part[:, None] if part.ndim == 1 else part, arrays[name])
    return Dataset.from_arrays(
        **arrays,
        observation_space=venv.observation_space,
        action_space=actions_of,
    )


def _check_not_normalized(model: BaseAlgorithm) -> None:
    """
    :raises ValueError: if the model learned from normalised observations, and would get the environment's own
    """
    own = model.get_vec_normalize_env()
    if not (lacks_vec_normalize(model) if own is None else own.norm_obs):
        return
    message = (
        "env must be in a VecNormalize with the statistics that the model has learned with, such as "
        "load_vec_normalize(file, venv), on the command line --vecnormalize: without them its policy sees other "
        "numbers than it knows"
    )
    if own is None and model.env is not None:
        # It may have been trained further in an environment without one.
        warn(message)
    else:
        raise ValueError(message)


def _below(venv: VecEnv, normalize: VecNormalize | None) -> VecEnv:
    """The environments without their normalisation, which must be their outermost wrapper."""
    if normalize is None:
        return venv
    if venv is not normalize:
        raise ValueError("env must have VecNormalize as its outermost wrapper, if it has one")
    return normalize.venv


def _stacked(values: list[Any]) -> Any:
    if isinstance(values[0], dict):
        return {key: _stacked([value[key] for value in values]) for key in values[0]}
    return np.stack([np.asarray(value) for value in values])
