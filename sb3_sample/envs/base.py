"""Parts that the suites share: checks of arguments, the missing library's message, the choice of an OpenGL."""

import contextlib
import ctypes
import importlib
import os
import sys
from types import ModuleType

import numpy as np
from gymnasium import spaces

from sb3_sample.extras import install


def import_library(module: str, extra: str, then: str = "") -> ModuleType:
    """
    Import an optional library when an environment of it is made.

    :param module: Name of the module, e.g. ``"dm_control.suite"``.
    :param extra: The extra of this package that installs it, e.g. ``"dmc"``.
    :param then: A command to be typed after that, if the extra alone is not enough.
    :return: The module.
    :raises ImportError: The library, or something that it needs, is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"The {extra}/ environments need {module.split('.')[0]} ({error}). "
            f"Install it with: {install(extra)}{then and f', then: {then}'}"
        ) from error


def select_gl_backend() -> None:
    """
    Set ``MUJOCO_GL`` to ``egl`` or ``osmesa``, whichever library is there, on a Linux machine without a screen.

    MuJoCo's libraries read the variable when they are imported and otherwise take GLFW, which cannot draw without a
    screen. A value that the user has set stays; if neither library is found, nothing is set, and everything but
    ``render`` works.

    Call it before the import of a library that opens its OpenGL when imported. Mesa's OpenGL and the Triton of
    PyTorch's CUDA builds each bring an LLVM. With Mesa's loaded first (PyOpenGL loads it with global symbols), Triton
    ends the process with a segmentation fault when PyTorch's optimizers import it. In the other order both work, so
    Triton is imported here.
    """
    with contextlib.suppress(ImportError):  # PyTorch's CPU builds come without it
        importlib.import_module("triton")
    has_screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not sys.platform.startswith("linux") or has_screen or "MUJOCO_GL" in os.environ:
        return
    for backend, library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8"), ("osmesa", "libOSMesa.so.6")):
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        os.environ["MUJOCO_GL"] = backend
        return


def check_render_arguments(render_mode: str | None, width: int, height: int) -> None:
    """
    :param render_mode: Must be ``None`` or ``"rgb_array"``.
    :param width: Width of the picture in pixels, at least 1.
    :param height: Height of the picture in pixels, at least 1.
    :raises ValueError: An argument has another value.
    """
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
    for name, value in (("width", width), ("height", height)):
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"{name} must be a positive int (pixels), got {value!r}")


def unbounded_box(size: int) -> spaces.Box:
    """
    :param size: Length O of the observation.
    :return: Float32 ``Box(-inf, inf)`` of shape (O,).
    """
    return spaces.Box(-np.inf, np.inf, shape=(size,), dtype=np.float32)


def unit_box(size: int) -> spaces.Box:
    """
    :param size: Length A of the action.
    :return: Float32 ``Box(-1, 1)`` of shape (A,).
    """
    return spaces.Box(-1.0, 1.0, shape=(size,), dtype=np.float32)
