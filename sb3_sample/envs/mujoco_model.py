"""Copy and set the numbers of a MuJoCo model that tasks and wrappers change."""

import functools
import operator
from typing import Any

import numpy as np

#: Suffixes of the names of those integer arrays of MuJoCo's model that are masks, switches and classes.
_SWITCHES = (
    "contype", "conaffinity", "condim", "_priority", "_group", "limited", "_active0", "_active", "_castshadow",
    "_actearly", "_actgravcomp", "_gaintype", "_biastype",
)  # fmt: skip


def model_numbers(model: Any) -> dict[str, Any]:
    """
    :param model: MuJoCo's model
    :return: copies of its arrays that are not empty, and of the numbers of :func:`model_options`
    """
    names = (*model_arrays(), *more_model_arrays())
    numbers = {name: array.copy() for name in names if (array := getattr(model, name)).size}
    return {**numbers, **options_of(model)}


def options_of(model: Any) -> dict[str, Any]:
    """
    :param model: MuJoCo's model
    :return: copies of the numbers of :func:`model_options`, by name
    """
    options: dict[str, Any] = {}
    for structure, names in model_options().items():
        owner = operator.attrgetter(structure)(model)
        for name in names:
            value = getattr(owner, name)
            options[f"{structure}.{name}"] = value.copy() if isinstance(value, np.ndarray) else value
    return options


def set_model_numbers(model: Any, numbers: dict[str, Any]) -> None:
    """
    :param model: MuJoCo's model
    :param numbers: from :func:`model_numbers`, or some of them; unchecked
    """
    owners = {"": model, **{structure: operator.attrgetter(structure)(model) for structure in model_options()}}
    for name, value in numbers.items():
        structure, _, last = name.rpartition(".")
        if isinstance(value, np.ndarray):
            getattr(owners[structure], last)[...] = value
        else:
            setattr(owners[structure], last, value)


@functools.cache
def model_arrays() -> tuple[str, ...]:
    """
    :return: names of the arrays of a model that a task may draw anew: all of MuJoCo's own float type, and heights of
        the ground. Meshes, their search trees and textures, the megabytes of a model, are not among them: no task of
        these suites changes them
    """
    arrays = _arrays_of_a_model()
    return tuple(name for name, array in arrays.items() if array.dtype == np.float64 or name == "hfield_data")


@functools.cache
def more_model_arrays() -> tuple[str, ...]:
    """
    :return: names of further arrays that a task or a wrapper may change: appearance, contact masks and switches.
        Indices into MuJoCo's memory, which it follows unchecked, are not among them
    """
    arrays, known = _arrays_of_a_model(), model_arrays()
    return tuple(
        name
        for name, array in arrays.items()
        if name not in known and not name.startswith("flex") and (array.dtype == np.float32 or name.endswith(_SWITCHES))
    )


@functools.cache
def model_options() -> dict[str, tuple[str, ...]]:
    """
    :return: names of the numbers and arrays of a model's structures, by structure: options of the physics, mean values
        by which the solver measures, and the light at the camera
    """
    model = _smallest_model()
    return {
        structure: tuple(name for name in dir(operator.attrgetter(structure)(model)) if not name.startswith("_"))
        for structure in ("opt", "stat", "vis.headlight")
    }


@functools.cache
def _smallest_model() -> Any:
    import mujoco

    return mujoco.MjModel.from_xml_string("<mujoco/>")


def _arrays_of_a_model() -> dict[str, np.ndarray]:
    """All arrays but those of meshes, skins and textures."""
    model = _smallest_model()
    names = [name for name in dir(model) if not name.startswith(("_", "mesh_", "tex_", "skin_", "bvh_", "oct_"))]
    return {name: value for name in names if isinstance(value := getattr(model, name), np.ndarray)}
