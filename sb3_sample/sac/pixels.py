"""Images as observations of the off-policy family: what they must be, and whether they are stacks of frames."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack, VecTransposeImage


def stacked_frames(env: Any, space: Any) -> int | None:
    """
    Ask an environment whether its observations are stacks of its latest frames along the first axis.

    :param env: vectorised environment; None for none
    :param space: the model's observation space
    :return: how many frames: those of ``VecFrameStack``, or the ``stacked_frames`` of the environment itself; None if
        there is no stack of more than one
    """
    if not isinstance(env, VecEnv) or not isinstance(space, spaces.Box) or space.dtype != np.uint8 or not space.shape:
        return None
    n_frames, layer = None, env
    while isinstance(layer, VecEnvWrapper) and n_frames is None:
        n_frames = layer.stacked_obs.n_stack if isinstance(layer, VecFrameStack) else None
        layer = layer.venv
    if n_frames is None:
        # has_attr comes first, since a worker of SubprocVecEnv dies if asked for an attribute that does not exist.
        n_frames = env.get_attr("stacked_frames", 0)[0] if env.has_attr("stacked_frames") else None
    return n_frames if isinstance(n_frames, int) and n_frames > 1 and space.shape[0] % n_frames == 0 else None


def check_images(who: str, space: Any) -> None:
    """
    Check that observations are images as convolutions take them.

    :param who: name of what needs images, for the error
    :param space: observation space
    :raises ValueError: if they are not uint8, 0 to 255, channels first, and nothing else
    """
    must = f"{who} needs observations that are one image, a uint8 Box of shape (channels, height, width)"
    if isinstance(space, spaces.Dict):
        raise ValueError(f"{must}, not {space}: have the environment give the image alone")
    if not isinstance(space, spaces.Box):
        raise ValueError(f"{must}, not {space}")
    if len(space.shape) == 4:
        raise ValueError(
            f"{must}, not one of shape {space.shape}: stack frames along their channels, as "
            "VecFrameStack(venv, 3, channels_order='first') does, or dmc/ with pixels=84, frame_stack=3"
        )
    if len(space.shape) != 3:
        raise ValueError(f"{must}, not one of shape {space.shape}: dmc/ environments take pixels=84")
    if space.dtype != np.uint8:
        raise ValueError(
            f"{must}, not of {space.dtype}: have the environment give 0 to 255 in uint8, a quarter of the memory, and "
            "VecNormalize leave them so, norm_obs=False"
        )
    if not is_image_space(space):
        raise ValueError(f"{must} with the bounds 0 and 255, not {space.low.min()} and {space.high.max()}")
    if np.argmin(space.shape) != 0:
        raise ValueError(
            f"{must}, not channels last, {space.shape}: pass the space of {VecTransposeImage.__name__}(venv), "
            f"{tuple(space.shape[i] for i in (2, 0, 1))}"
        )
