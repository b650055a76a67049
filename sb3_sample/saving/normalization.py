"""The statistics of Stable-Baselines3's VecNormalize in files that run no code."""

import pathlib
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_sample.saving import container
from sb3_sample.saving.container import BadFile, PickledFile
from sb3_sample.saving.encoding import decode, encode
from sb3_sample.saving.statistics import ARGUMENTS, check_normalization, shapes_of

KIND = "VecNormalize"


def lacks_vec_normalize(model: BaseAlgorithm) -> bool:
    """
    :param model: an algorithm
    :return: whether it has learned in a ``VecNormalize``, but now has none around its environment, or no environment
    """
    # With a ``VecNormalize``, Stable-Baselines3 keeps, and saves, the last unnormalised observation too.
    return model.get_vec_normalize_env() is None and model._last_original_obs is not None


def save_vec_normalize(venv: VecEnv, path: str | pathlib.Path) -> None:
    """
    Save the settings and the statistics of a ``VecNormalize``, as its own ``save`` does, but to a file that runs no
    code when it is loaded.

    :param venv: the ``VecNormalize``
    :param path: path, written as it is
    :raises ValueError: if it is something else, or has settings or statistics that :func:`load_vec_normalize` refuses
    :raises OSError: if the file cannot be written
    """
    if type(venv) is not VecNormalize:
        raise ValueError(f"venv must be a VecNormalize, not a {type(venv).__name__}")
    tensors: dict[str, torch.Tensor] = {}
    state = {name: getattr(venv, name) for name in ARGUMENTS}
    # Statistics of observations exist even if observations are no longer normalised.
    state.update(obs_rms=getattr(venv, "obs_rms", None), ret_rms=venv.ret_rms)
    check_normalization(state, "venv")
    tree = encode(state, "VecNormalize", tensors)
    container.write(path, KIND, tree, tensors)


def load_vec_normalize(path: str | pathlib.Path, venv: VecEnv, *, allow_pickle: bool = False) -> VecNormalize:
    """
    Wrap an environment into a ``VecNormalize`` with saved settings and statistics, as ``VecNormalize.load`` does.
    Nothing in the file is run, whoever wrote it.

    :param path: where :func:`save_vec_normalize` wrote it
    :param venv: the environment
    :param allow_pickle: whether a file of ``VecNormalize.save`` is loaded too, which can run any code that its author
        wanted
    :return: the wrapped environment
    :raises BadFile: (a ``ValueError``) if the file is damaged, hostile or pickled
    :raises ValueError: if the statistics are of other observations
    """
    try:
        tree, tensors = container.read(path, KIND)
    except PickledFile:
        if not allow_pickle:
            raise
        return VecNormalize.load(str(path), venv)
    state: Any = decode(tree, tensors, str(path))
    if not isinstance(state, dict) or state.keys() != {*ARGUMENTS, "obs_rms", "ret_rms"}:
        raise BadFile(f"{path} does not hold what a VecNormalize consists of")
    check_normalization(state, str(path))
    arguments = {name: state[name] for name in ARGUMENTS}
    try:
        wanted = VecNormalize(venv, **{**arguments, "norm_obs": state["obs_rms"] is not None or arguments["norm_obs"]})
        wanted.norm_obs = arguments["norm_obs"]
    except (ValueError, TypeError, AssertionError) as error:
        raise BadFile(f"{path} does not fit to the environment: {error}") from error
    for name in ("obs_rms", "ret_rms"):
        own, saved = getattr(wanted, name, None), state[name]
        if shapes_of(own, f"{path}: {name}") != shapes_of(saved, f"{path}: {name}"):
            raise ValueError(
                f"{path}: {name} is of shape {shapes_of(saved, name)}, but the environment needs {shapes_of(own, name)}"
            )
        if saved is not None:
            setattr(wanted, name, saved)
    return wanted
