"""
The DeepMind Control suite as Gymnasium environments, ``dmc/<domain>-<task>-v0``.

They stand on ``dm_control`` itself. Shimmy's ``DmControlCompatibilityV0`` was looked at (2.0.1) and not used: behind it
``FlattenObservation`` concatenates the observation in alphabetical order, not in the order of the suite's observation
spec that the published agents saw; observations and actions are float64 with the suite's own action bounds, so three
more wrappers are needed, which together cost half a simulation step of cheetah-run; ``render_fps`` is the control
period in milliseconds, written to an attribute that all instances share; and every step carries two entries in
``info`` that SB3 copies and nobody reads.
"""

import os
import sys
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_sample.envs.base import (
    check_render_arguments,
    import_library,
    select_gl_backend,
    unbounded_box,
    unit_box,
)

EPISODE_STEPS = 1000
#: dm-control asks for labmaze, which has no wheel after Python 3.12 and which the suite never imports. There the extra
#: has everything but dm-control itself (setup.cfg).
_THEN = "pip install --no-deps dm-control" if sys.version_info >= (3, 13) else ""


class DMCEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    One task of the DeepMind Control suite.

    Observation: float32, shape (O,), the entries of the suite's observation in the order of its spec. Action: float32
    in [-1, 1], shape (A,), rescaled to the bounds of the suite's action spec where these differ (the quadruped). An
    episode has 1,000 control steps and then is ``truncated``; a task that ended itself with discount 0 would be
    ``terminated``, no task of the suite does.

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
    :param camera: Number or name of the camera; default: the first of the model.
    :raises ImportError: dm_control is not installed.
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
    ) -> None:
        check_render_arguments(render_mode, width, height)
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

        observation_spec = self.dm_env.observation_spec()
        self.observation_space = unbounded_box(sum(int(np.prod(spec.shape)) for spec in observation_spec.values()))
        action_spec = self.dm_env.action_spec()
        self.action_space = unit_box(action_spec.shape[0])
        low = np.broadcast_to(action_spec.minimum, action_spec.shape)
        high = np.broadcast_to(action_spec.maximum, action_spec.shape)
        self._action_low = low
        self._action_scale = 0.5 * (high - low)
        self._rescales_actions = bool(np.any(low != -1.0) or np.any(high != 1.0))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """
        :param seed: Restarts the stream of episodes; ``None`` goes on with it.
        :param options: Not used.
        :return: Observation, float32 of shape (O,), and an empty dict.
        """
        super().reset(seed=seed)
        if seed is not None:
            # The suite's tasks draw from one legacy generator, which takes 32 bits.
            self.dm_env.task.random.seed(seed % 2**32)
        return _flatten(self.dm_env.reset().observation), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: Float array of shape (A,) in [-1, 1].
        :return: Observation of shape (O,), reward summed over the repeated steps, terminated, truncated, empty dict.
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
                return _flatten(time_step.observation), reward, terminated, not terminated, {}
        return _flatten(time_step.observation), reward, False, False, {}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        :return: Uint8 picture of shape (height, width, 3); ``None`` without a render mode.
        """
        if self.render_mode is None:
            return None
        camera = 0 if self.camera is None else self.camera
        return self.dm_env.physics.render(height=self.height, width=self.width, camera_id=camera)

    def close(self) -> None:
        # Frees the OpenGL context; left to the interpreter's exit it fails there.
        self.dm_env.physics.free()
        self.dm_env.close()


def make(**kwargs: Any) -> DMCEnv:
    """
    Entry point of the registered ids.

    :param kwargs: Arguments of :class:`DMCEnv`.
    :return: The environment.
    """
    return DMCEnv(**kwargs)


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
