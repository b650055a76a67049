"""
State of a training run besides parameters, replay buffer, environments and callbacks: the algorithm's counters, random
generators and logger; and the arguments and circumstances that tell runs apart.
"""

import contextlib
import functools
import importlib.metadata
import inspect
import os
import pathlib
import platform
import random
import subprocess
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger

from sb3_sample.learner.randomness import checked_state
from sb3_sample.replay.dataset import Dataset
from sb3_sample.saving.attributes import Describer, Node, Opaque, Restorer, without_generators
from sb3_sample.saving.classes import NotPortable
from sb3_sample.saving.generators import check_python_state, set_numpy_state
from sb3_sample.saving.kept import Kept, declared
from sb3_sample.version import __version__
from sb3_sample.warn import warn

#: Buffers of Monitor's results for the last episodes. Their texts name tasks and levels ("metaworld/reach-v3"), never a
#: place where a program writes.
_OF_EPISODES = ("ep_info_buffer", "ep_success_buffer")
#: Arguments that may differ between the parts of a run: where it computes, and what it prints.
HARMLESS = ("verbose", "device", "tensorboard_log", "compile", "_init_setup_model")


def argument_names(cls: type) -> set[str]:
    """
    :param cls: class of an algorithm
    :return: the arguments of its constructor and of those of its bases
    """
    signatures = (inspect.signature(base).parameters for base in cls.__mro__ if issubclass(base, BaseAlgorithm))
    return {name for parameters in signatures for name in parameters} - {"args", "kwargs", "_init_setup_model"}


def _not_saved(model: BaseAlgorithm) -> set[str]:
    # Variables, too, are saved with the parameters.
    modules = {name.split(".")[0] for names in model._get_torch_save_params() for name in names}
    where = declared(type(model))
    kept = {name for name, places in where.items() if Kept.IN_CHECKPOINTS in places}
    return {*modules, *model._excluded_save_params(), *argument_names(type(model)), *where} - kept


def save_attributes(model: BaseAlgorithm) -> dict[str, Node]:
    """
    :param model: the algorithm, at the end of a turn of its loop
    :return: everything that its turns change and that is not saved elsewhere
    :raises NotPortable: (a ``ValueError``) the action noise, or an attribute of a subclass, cannot be described
    """
    described, opaque = Describer().attributes(model, _not_saved(model))
    if opaque:
        raise NotPortable(f"{type(model).__name__} has attributes that a checkpoint cannot hold: {', '.join(opaque)}")
    return described


def restore_attributes(model: BaseAlgorithm, described: dict[str, Node]) -> None:
    """
    :param model: an algorithm made like the saved one
    :param described: from :func:`save_attributes`
    """
    if getattr(model, "compile", "auto") != "auto":
        # The present program decides whether to compile; an earlier decision of "auto" stays.
        described = {name: node for name, node in described.items() if name != "compiled"}
    restorer = Restorer()
    restorer.attributes(model, described, _not_saved(model), anywhere=_OF_EPISODES)
    if restorer.kept:
        warn(f"{', '.join(restorer.kept)} of the checkpoint may name files, and stay as they are")


# ---------------------------------------------------------------- generators


def save_generators(device: torch.device) -> dict[str, Any]:
    """
    :param device: where the algorithm computes
    :return: the states of the generators of Python, NumPy and torch
    """
    cuda = torch.cuda.get_rng_state(device) if device.type == "cuda" else None
    numpy_state = np.random.get_state()  # noqa: NPY002  # Stable-Baselines3 draws from this one
    return {"python": random.getstate(), "numpy": numpy_state, "torch": torch.get_rng_state(), "cuda": cuda}


def restore_generators(state: dict[str, Any], device: torch.device) -> None:
    """
    :param state: from :func:`save_generators`
    :param device: where the algorithm computes
    """
    check_python_state(state["python"], "Python")
    random.setstate(state["python"])
    set_numpy_state(state["numpy"])
    torch.set_rng_state(checked_state(state["torch"], "the generator of torch"))
    if device.type == "cuda" and state["cuda"] is not None:
        torch.cuda.set_rng_state(state["cuda"], device)


# ---------------------------------------------------------------- logger


def save_logger(logger: Logger) -> dict[str, Any]:
    """
    :param logger: the algorithm's logger
    :return: the values recorded since the log was last written; without pictures and the like
    """
    values = {}
    describer = Describer()
    for name, value in logger.name_to_value.items():
        try:
            described = describer.describe(value)
        except Opaque:
            continue
        if "value" in described:
            values[name] = described["value"]
    counts = {name: count for name, count in logger.name_to_count.items() if name in values}
    excluded = {name: list(formats) for name, formats in logger.name_to_excluded.items() if name in values}
    return {"values": values, "counts": counts, "excluded": excluded}


def restore_logger(logger: Logger, state: dict[str, Any]) -> None:
    """
    :param logger: the algorithm's logger
    :param state: from :func:`save_logger`
    """
    for own, saved in (
        (logger.name_to_value, state["values"]),
        (logger.name_to_count, state["counts"]),
        (logger.name_to_excluded, {name: tuple(formats) for name, formats in state["excluded"].items()}),
    ):
        own.clear()
        own.update(saved)


# ---------------------------------------------------------------- which run it is


def arguments_of(model: BaseAlgorithm) -> dict[str, Any]:
    """
    :param model: the algorithm, before its training
    :return: its class and the values of its arguments that decide what is computed
    """
    own = vars(model)
    values: dict[str, Any] = {"class": f"{type(model).__module__}.{type(model).__qualname__}"}
    values["policy"] = model.policy_class
    for name in ("observation_space", "action_space"):
        values[name] = without_generators(getattr(model, name))
    for name in sorted(argument_names(type(model)) - {"env", "policy", *HARMLESS}):
        if name in own and name not in values:
            # For a data set, the text that identifies it.
            values[name] = repr(own[name]) if isinstance(own[name], Dataset) else own[name]
    return values


def circumstances(device: torch.device) -> dict[str, str]:
    """
    :param device: where the algorithm computes
    :return: further circumstances on which the last bits of a result depend, by name
    """
    found = {
        "sb3_sample": __version__,
        "stable_baselines3": stable_baselines3.__version__,
        "gymnasium": gymnasium.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "device": device.type if device.type != "cuda" else torch.cuda.get_device_name(device),
        "torch threads": str(torch.get_num_threads()),
    }
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        found["mujoco"] = importlib.metadata.version("mujoco")
    return found | {name: value for name, value in (("commit", commit()), ("processor", processor())) if value}


@functools.cache
def commit() -> str:
    """
    :return: the commit of the checkout that this package is imported from, with "-dirty" if files were changed since;
        empty outside of a checkout and without git
    """
    root = pathlib.Path(__file__).parents[2]
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    # In a git hook, variables may name another checkout.
    env = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    try:
        found = subprocess.run(command, env=env, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return found.stdout.strip()


@functools.cache
def processor() -> str:
    """
    :return: the processor's name, as far as the system tells it
    """
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()
