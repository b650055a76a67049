"""
The DeepMind Control suite as Gymnasium environments, ``dmc/<domain>-<task>-v0``.

They use ``dm_control`` itself. Shimmy's ``DmControlCompatibilityV0`` (2.0.1) was examined and not used: around it
``FlattenObservation`` concatenates the observation in alphabetical order, not in the order of the suite's observation
spec that the published agents saw; observations and actions are float64 with the suite's own action bounds, so three
more wrappers are needed, which together cost half a simulation step of cheetah-run; ``render_fps`` is the control
period in milliseconds, written to an attribute that all instances share; and every step carries two entries in ``info``
that SB3 copies and nobody reads.
"""

import os
import sys
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_sample.envs.base import (
    check_render_arguments,
    import_library,
    select_gl_backend,
    unbounded_box,
    unit_box,
)

EPISODE_STEPS = 1000
#: Cameras of observations where the model's first one does not show enough: the quadruped's follows it (DrQ's code).
PIXEL_CAMERAS = {"quadruped": 2}
#: Weights of red, green and blue in a gray picture, in thousandths (luma of ITU-R BT.601).
_GRAY = np.array([299, 587, 114], np.uint32)
#: Default number of pictures in an observation.
FRAME_STACK = 3
#: dm-control requires labmaze, which has no wheel after Python 3.12 and which the suite never imports. On later
#: versions the extra has everything but dm-control itself (setup.cfg).
_THEN = "pip install --no-deps dm-control" if sys.version_info >= (3, 13) else ""


class DMCEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    One task of the DeepMind Control suite.

    Observation: float32, shape (O,), the entries of the suite's observation in the order of its spec. With ``pixels``
    it is the latest pictures instead, uint8, channels first, the newest picture's channels last: (9, 84, 84) with
    ``pixels=84`` and ``frame_stack=3``. At a reset the first picture fills the stack. Action: float32 in [-1, 1], shape
    (A,), rescaled to the bounds of the suite's action spec where these differ (the quadruped). An episode has 1,000
    control steps and then is ``truncated``; a task that ended with discount 0 would be ``terminated``, but no task of
    the suite does.

    ``reset(seed=s)`` fixes this and all following episodes: with ``s < 2**32`` they are those of
    ``suite.load(domain, task, task_kwargs={"random": s})``.

    :param domain: Domain of the suite, e.g. ``"cheetah"``.
    :param task: Task of the domain, e.g. ``"run"``.
    :param action_repeat: Control steps for which an action is held, 1 to 1,000; their rewards are summed. The episode
        stays at 1,000 control steps, so it has ``ceil(1000 / action_repeat)`` decisions, the last one shorter if it
        does not divide 1,000.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :param width: Width of a picture in pixels.
    :param height: Height of a picture in pixels.
    :param camera: Number or name of the camera; default: the model's first, or 2 for observations of the quadruped.
    :param pixels: Height and width of the pictures that are observed; ``None``: the suite's own observation.
    :param frame_stack: Number of pictures in an observation, one for each of the latest decisions; with ``pixels``
        only.
    :param gray: Whether these pictures have one channel, the luma, and not three; with ``pixels`` only.
    :raises ImportError: dm_control is not installed; or ``pixels`` are asked for, and no OpenGL can draw them.
    :raises ValueError: An argument is out of range, or the suite has no such task.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}
    #: Says that episodes end by their time limit alone, so that a model of the environment need not predict their end.
    never_terminates = True

    def __init__(
        self,
        domain: str,
        task: str,
        action_repeat: int = 1,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: int | str | None = None,
        pixels: int | None = None,
        frame_stack: int | None = None,
        gray: bool = False,
    ) -> None:
        check_render_arguments(render_mode, width, height)
        _check_pixels(pixels, frame_stack, gray)
        if (
            isinstance(action_repeat, bool)
            or not isinstance(action_repeat, int)
            or not 1 <= action_repeat <= EPISODE_STEPS
        ):
            raise ValueError(f"action_repeat must be an int from 1 to {EPISODE_STEPS}, got {action_repeat!r}")
        self.dm_env = _import_suite().load(domain, task)
        self.action_repeat = action_repeat
        self.render_mode = render_mode
        self.width = width
        self.height = height
        self.camera = camera
        decision_seconds = self.dm_env.control_timestep() * action_repeat
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": max(1, round(1.0 / decision_seconds))}

        self.pixels, self.gray = pixels, gray
        #: Number of pictures in an observation, along its first axis; ``None`` without pictures. Read by replay buffers
        #: that store each picture once.
        self.stacked_frames = None if pixels is None else FRAME_STACK if frame_stack is None else frame_stack
        self.observation_space: spaces.Box
        if pixels is None:
            observation_spec = self.dm_env.observation_spec()
            self.observation_space = unbounded_box(sum(int(np.prod(spec.shape)) for spec in observation_spec.values()))
        else:
            assert self.stacked_frames is not None
            if camera is None:
                self.camera = PIXEL_CAMERAS.get(domain, 0)
            self.observation_space = spaces.Box(
                0, 255, (self.stacked_frames * (1 if gray else 3), pixels, pixels), np.uint8
            )
            self._check_renders()
        # The latest pictures, the oldest first.
        self._stack: np.ndarray | None = None
        action_spec = self.dm_env.action_spec()
        self.action_space = unit_box(action_spec.shape[0])
        low = np.broadcast_to(action_spec.minimum, action_spec.shape)
        high = np.broadcast_to(action_spec.maximum, action_spec.shape)
        self._action_low = low
        self._action_scale = 0.5 * (high - low)
        self._rescales_actions = bool(np.any(low != -1.0) or np.any(high != 1.0))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """
        :param seed: Restarts the stream of episodes; ``None`` continues it.
        :param options: Not used.
        :return: Observation and an empty dict.
        """
        super().reset(seed=seed)
        if seed is not None:
            # The suite's tasks draw from one legacy generator, which takes 32 bits.
            self.dm_env.task.random.seed(seed % 2**32)
        time_step = self.dm_env.reset()
        self._stack = None
        return self._observed(time_step.observation), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: Float array of shape (A,) in [-1, 1].
        :return: Observation, reward summed over the repeated steps, terminated, truncated, empty dict.
        :raises RuntimeError: The episode is over; ``reset`` starts the next one.
        """
        if self._rescales_actions:
            action = self._action_low + (np.asarray(action, np.float64) + 1.0) * self._action_scale
        reward = 0.0
        for _ in range(self.action_repeat):
            time_step = self.dm_env.step(action)
            if time_step.reward is None:
                # dm_env starts the next episode by itself, which would hide the boundary from the agent.
                raise RuntimeError("step() was called after the end of the episode: call reset() first")
            reward += float(time_step.reward)
            if time_step.last():
                terminated = time_step.discount == 0.0
                return self._observed(time_step.observation), reward, terminated, not terminated, {}
        return self._observed(time_step.observation), reward, False, False, {}

    def _observed(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """The observation: the suite's, flat, or the stack with a new picture."""
        if self.stacked_frames is None:
            return _flatten(observation)
        picture = self._picture()
        older = [picture] * (self.stacked_frames - 1) if self._stack is None else [self._stack[len(picture) :]]
        self._stack = np.concatenate([*older, picture])
        # A copy, so that the caller cannot change the stack.
        return self._stack.copy()

    def _picture(self) -> np.ndarray:
        """The picture of the present state, uint8, (C, pixels, pixels)."""
        picture = self.dm_env.physics.render(height=self.pixels, width=self.pixels, camera_id=self.camera)
        if not self.gray:
            return np.ascontiguousarray(picture.transpose(2, 0, 1))
        return ((picture @ _GRAY + 500) // 1000).astype(np.uint8)[None]

    def _check_renders(self) -> None:
        """Draw a picture, so that anything missing for it is reported when the environment is made."""
        try:
            self._picture()
        except ValueError as error:
            raise ValueError(
                f"pixels={self.pixels!r} and camera={self.camera!r} must fit the model: {error}"
            ) from error
        except Exception as error:  # dm_control and the OpenGL libraries can raise anything
            raise ImportError(
                f"pixels={self.pixels!r} needs an OpenGL that draws without a screen, and with MUJOCO_GL="
                f"{os.environ.get('MUJOCO_GL', '')!r} there is none ({error}). Install one (apt-get install libegl1 "
                "libgl1-mesa-dri, or libosmesa6), and set the environment variable MUJOCO_GL=egl, or osmesa, before "
                "Python imports dm_control or mujoco"
            ) from error

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        :return: Uint8 picture of shape (height, width, 3); ``None`` without a render mode.
        """
        if self.render_mode is None:
            return None
        camera = 0 if self.camera is None else self.camera
        return self.dm_env.physics.render(height=self.height, width=self.width, camera_id=camera)

    def close(self) -> None:
        # Frees the OpenGL context; if left to the interpreter's exit, that fails.
        self.dm_env.physics.free()
        self.dm_env.close()


def make(**kwargs: Any) -> DMCEnv:
    """
    Entry point of the registered ids.

    :param kwargs: Arguments of :class:`DMCEnv`.
    :return: The environment.
    """
    return DMCEnv(**kwargs)


def _check_pixels(pixels: Any, frame_stack: Any, gray: Any) -> None:
    for name, value in (("pixels", pixels), ("frame_stack", frame_stack)):
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
            raise ValueError(f"{name} must be a positive int, or None, got {value!r}")
    if not isinstance(gray, bool):
        raise ValueError(f"gray must be True or False, got {gray!r}")
    if pixels is None and (frame_stack is not None or gray):
        raise ValueError(
            f"frame_stack={frame_stack!r} and gray={gray!r} are of pictures that are observed: pass pixels=84 too, or "
            "leave them out"
        )


def _flatten(observation: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([value.ravel() for value in observation.values()], dtype=np.float32)


def _import_suite() -> ModuleType:
    select_gl_backend()
    try:
        return import_library("dm_control.suite", "dmc", _THEN)
    except (ImportError, AttributeError, OSError) as error:
        if isinstance(error.__cause__, ModuleNotFoundError):
            raise
        # dm_control opens its OpenGL at import. Without a usable one everything but rendering still works.
        chosen = os.environ.get("MUJOCO_GL")
        os.environ["MUJOCO_GL"] = "disable"
        try:
            suite = import_library("dm_control.suite", "dmc", _THEN)
        finally:
            if chosen is None:
                del os.environ["MUJOCO_GL"]
            else:
                os.environ["MUJOCO_GL"] = chosen
        gym.logger.warn(f"OpenGL backend {chosen!r} is not usable ({error}): dmc/ environments cannot render.")
        return suite
