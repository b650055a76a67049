"""
Meta-World as Gymnasium environments, ``metaworld/<task>-v3``: one task, goal observable, a new goal each episode.

They use the task classes of ``metaworld.env_dict.ALL_V3_ENVIRONMENTS``. The library's own makers (3.0.0) were examined
and behave differently: ``gym.make("Meta-World/MT1")`` draws from 50 goals made beforehand and adds six wrappers; the
classes of ``ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE`` keep one goal for ever, drawn from NumPy's global generator, and take
no camera or picture size; and every ``reset`` ignores its ``seed``.
"""

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


class MetaWorldEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    One Meta-World task.

    Observation: float32, shape (39,): hand, gripper and objects now (18), the same one step before (18), goal (3). The
    space is unbounded, since the library does not clip the observation of a reset to its own bounds. Action: float32
    in [-1, 1], shape (4,). The registered ids truncate after 200 steps (the library's own limit is 500) and never
    terminate. ``info["success"]`` is the library's flag at this step, ``info["is_success"]`` whether it held at any
    step of the episode so far.

    Goals and start positions are drawn at each ``reset`` from the environment's own generator (``np_random``), so
    ``reset(seed=s)`` fixes this and all following episodes.

    :param task: The library's name of the task, e.g. ``"push-v3"``.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :param width: Width of a picture in pixels.
    :param height: Height of a picture in pixels.
    :param camera: Number or name of a camera of the model (its ``corner`` cameras are mounted upside down); default:
        a free camera in front of the table.
    :raises ImportError: metaworld is not installed.
    :raises ValueError: The library has no such task, or an argument is out of range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 80}

    def __init__(
        self,
        task: str,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: int | str | None = None,
    ) -> None:
        check_render_arguments(render_mode, width, height)
        select_gl_backend()
        classes = import_library("metaworld.env_dict", "metaworld").ALL_V3_ENVIRONMENTS
        if task not in classes:
            raise ValueError(f"task must be one of {sorted(classes)}, got {task!r}")
        self.sawyer = classes[task](
            render_mode=render_mode,
            width=width,
            height=height,
            camera_name=camera if isinstance(camera, str) else None,
            camera_id=camera if isinstance(camera, int) else None,
        )
        # The library sets these three through a pickled "task", which would also freeze the goal.
        self.sawyer._set_task_called = True
        self.sawyer._partially_observable = False
        self.sawyer._freeze_rand_vec = False
        # Draw from the instance's generator, not from NumPy's global one.
        self.sawyer.seeded_rand_vec = True
        # The bounds to which observations are clipped were cached while the goal was hidden (and so zero).
        del self.sawyer.sawyer_observation_space

        self.render_mode = render_mode
        self.observation_space = unbounded_box(self.sawyer.sawyer_observation_space.shape[0])
        self.action_space = unit_box(self.sawyer.action_space.shape[0])
        self.succeeded = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """
        :param seed: Restarts the stream of episodes; ``None`` continues it.
        :param options: Not used.
        :return: Observation, float32 of shape (39,), and the library's info.
        """
        super().reset(seed=seed)
        self.sawyer.np_random = self.np_random
        self.succeeded = False
        observation, info = self.sawyer.reset()
        return observation.astype(np.float32), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: Float array of shape (4,) in [-1, 1].
        :return: Observation of shape (39,), reward in [0, 10], terminated (never), truncated, the library's info with
            ``is_success`` added.
        """
        observation, reward, terminated, truncated, info = self.sawyer.step(action)
        self.succeeded = self.succeeded or bool(info["success"])
        info["is_success"] = self.succeeded
        return observation.astype(np.float32), float(reward), terminated, truncated, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        :return: Uint8 picture of shape (height, width, 3); ``None`` without a render mode.
        """
        return None if self.render_mode is None else self.sawyer.render()

    def close(self) -> None:
        self.sawyer.close()


def make(**kwargs: Any) -> MetaWorldEnv:
    """
    Entry point of the registered ids.

    :param kwargs: Arguments of :class:`MetaWorldEnv`.
    :return: The environment.
    """
    return MetaWorldEnv(**kwargs)
