"""MyoSuite's hand tasks as Gymnasium environments, ``myosuite/<task>-v0``: the ten of BRO's table 4."""

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


class MyoSuiteEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    One MyoSuite task, made by the library.

    Observation: float32, shape (O,). Action: float32 in [-1, 1], shape (A,), the excitations of the muscles before the
    library's own squashing. The registered ids truncate after 100 steps, whatever the library's limit, and never
    terminate: ``info["done"]`` tells whether the library would have ended the episode (an object dropped, the
    simulation unstable). ``info["solved"]`` is the library's flag at this step, ``info["is_success"]`` whether it held
    at any step of the episode so far. The library's copies of the observation and of the reward's terms (``obs_dict``,
    ``rwd_dict``) are left out of ``info``, whose other entries are those terms.

    ``reset(seed=s)`` fixes this and all following episodes.

    :param library_id: The library's id, e.g. ``"myoHandKeyTurnFixed-v0"``.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :param width: Width of a picture in pixels.
    :param height: Height of a picture in pixels.
    :param camera: Number or name of a camera of the model; default: ``"hand_bottom"``, close to the palm, which all
        ten models have (the free camera shows the hand from across the room).
    :raises ImportError: myosuite is not installed.
    :raises ValueError: An argument is out of range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        library_id: str,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: int | str = "hand_bottom",
    ) -> None:
        check_render_arguments(render_mode, width, height)
        select_gl_backend()
        import_library("myosuite", "myosuite")
        # -1 removes the library's time limit; its wrapper that reports an unstable simulation stays.
        self.myo = gym.make(library_id, max_episode_steps=-1, disable_env_checker=True, render_mode=render_mode)
        self.render_mode = render_mode
        self._picture: dict[str, Any] = {"width": width, "height": height}
        self._picture["camera_name" if isinstance(camera, str) else "camera_id"] = camera
        control_seconds = float(self.myo.unwrapped.dt)  # type: ignore[attr-defined]
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / control_seconds)}
        self.observation_space = unbounded_box(_size(self.myo.observation_space))
        self.action_space = unit_box(_size(self.myo.action_space))
        self.succeeded = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """
        :param seed: Restarts the stream of episodes; ``None`` continues it.
        :param options: Not used.
        :return: Observation, float32 of shape (O,), and the library's info.
        """
        super().reset(seed=seed)
        self.myo.unwrapped.np_random = self.np_random
        self.succeeded = False
        observation, info = self.myo.reset()
        return observation.astype(np.float32), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: Float array of shape (A,) in [-1, 1].
        :return: Observation of shape (O,), reward, terminated (always false), truncated, the library's info without
            its copies, with ``done`` and ``is_success`` added.
        """
        observation, reward, done, truncated, info = self.myo.step(action)
        self.succeeded = self.succeeded or bool(info["solved"])
        info = {key: value for key, value in info.items() if key not in ("obs_dict", "rwd_dict")}
        info["done"] = done
        info["is_success"] = self.succeeded
        return observation.astype(np.float32), float(reward), False, truncated, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        :return: Uint8 picture of shape (height, width, 3); ``None`` without a render mode.
        """
        if self.render_mode is None:
            return None
        return self.myo.unwrapped.render(**self._picture)  # type: ignore[call-arg, return-value]

    def close(self) -> None:
        self.myo.close()


def make(**kwargs: Any) -> MyoSuiteEnv:
    """
    Entry point of the registered ids.

    :param kwargs: Arguments of :class:`MyoSuiteEnv`.
    :return: The environment.
    """
    return MyoSuiteEnv(**kwargs)


def _size(space: gym.Space) -> int:
    assert space.shape is not None
    return space.shape[0]
