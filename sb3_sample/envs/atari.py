"""
Atari games (``ALE/<Game>-v5``) as value learners see them: stacks of gray frames, one decision every four frames.

The wrappers are Stable-Baselines3's, without ``FireResetEnv``, and the screen is the console's own gray one, both as in
Dopamine. OpenCV is not needed: reducing a picture by areas is a product with two small matrices.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.atari_wrappers import ClipRewardEnv, EpisodicLifeEnv, MaxAndSkipEnv, NoopResetEnv
from stable_baselines3.common.monitor import Monitor

from sb3_sample.envs.registration import ATARI, is_atari_id, make_env
from sb3_sample.kinds import TRUE_OR_FALSE, check_value, integer
from sb3_sample.warn import warn

#: Arguments of ``gym.make`` for the game inside :class:`AtariFrames`: every frame, the gray screen.
ENV_KWARGS: dict[str, Any] = {
    "frameskip": 1,
    "repeat_action_probability": 0.0,
    "full_action_space": False,
    "obs_type": "grayscale",
}


def is_atari(env: gym.Env) -> bool:
    """
    :param env: an environment, wrapped or not
    :return: whether it is simulated by the Arcade Learning Environment
    """
    return type(env.unwrapped).__module__.partition(".")[0] == "ale_py"


def check_atari_id(env_id: str) -> None:
    """
    :param env_id: id of an environment
    :raises ValueError: if it is not that of a game
    """
    if not is_atari_id(env_id):
        raise ValueError(f"env_id must be the id of an Atari game, {ATARI}<Game>-v5, not {env_id!r}")


def repeats_actions(env: gym.Env) -> bool:
    """
    :param env: an environment for which :func:`is_atari` holds
    :return: whether its console repeats the last action at random (sticky actions)
    """
    base: Any = env.unwrapped
    return bool(base.ale.getFloat("repeat_action_probability") > 0)


def make_atari_env(env_id: str, training: bool = True, noop_max: int | None = 30, **kwargs: Any) -> gym.Env:
    """
    Make an Atari game whose observations are stacks of frames, for ``SRSPR`` or Stable-Baselines3's ``DQN``.

    :param env_id: ``"ALE/<Game>-v5"``
    :param training: whether a lost life ends an episode and rewards are clipped to their sign, as for learning; False
        for evaluation. ``Monitor``, inside of the wrappers, reports returns of whole games with rewards as they are
    :param noop_max: largest number of no-op frames after a reset (drawn from 1 on); None for none
    :param kwargs: arguments of ``gym.make`` (``render_mode``) and of the game (``mode``, ``difficulty``)
    :return: the environment; observations are uint8, (4, 84, 84), the newest frame last, zeros before an episode
    :raises ImportError: ``ale-py`` is not installed
    :raises gymnasium.error.UnregisteredEnv: there is no such game; the message names the closest ones
    :raises ValueError: ``env_id`` is of another suite, or an argument is out of range
    """
    check_atari_id(env_id)
    env: Any = Monitor(make_env(env_id, **{**ENV_KWARGS, **kwargs}))
    return AtariFrames(env, noop_max=noop_max, episodic_life=training, clip_reward=training)


class AreaResize(gym.ObservationWrapper[np.ndarray, int, np.ndarray]):
    """
    Reduction of gray pictures by the mean over areas (OpenCV's ``INTER_AREA``).

    A pixel of the result is the mean of the pixels under it, each weighted by its overlap. Overlaps are whole multiples
    of a fraction of a pixel, so that the sums are exact in float32, and the same everywhere.

    :param env: environment with pictures of uint8, (rows, columns)
    :param size: rows and columns of the result
    """

    def __init__(self, env: gym.Env, size: int):
        super().__init__(env)
        space = env.observation_space
        assert isinstance(space, spaces.Box)
        self._rows, self._columns = (self._overlaps(n, size) for n in space.shape)
        self._area = float(np.prod(space.shape))
        self.observation_space = spaces.Box(0, 255, (size, size), np.uint8)

    @staticmethod
    def _overlaps(n_given: int, n_wanted: int) -> np.ndarray:
        """How much of each given pixel lies under each wanted one, in ``n_wanted``-ths of a pixel, (wanted, given)."""
        given, wanted = np.arange(n_given) * n_wanted, np.arange(n_wanted)[:, None] * n_given
        ends = np.minimum(given + n_wanted, wanted + n_given)
        return np.maximum(ends - np.maximum(given, wanted), 0).astype(np.float32)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """
        :param observation: picture, (rows, columns)
        :return: the reduced picture, (size, size)
        """
        sums = self._rows @ observation.astype(np.float32) @ self._columns.T
        return np.rint(sums / self._area).astype(np.uint8)


class AtariFrames(gym.Wrapper[np.ndarray, int, np.ndarray, int]):
    """
    The processing between the console and a value learner: no-ops after a reset, the maximum of the last two of four
    frames, episodes that end with a life, 84 x 84 pixels, rewards clipped to their sign, four frames stacked.

    A lost life does not restart the game: ``reset`` continues from there with one no-op (``EpisodicLifeEnv``). Frames
    from before an episode's start, or before the life was lost, are zero. Sticky actions of the game, which repeat in
    every frame here, are warned of.

    :param env: a game made with :data:`ENV_KWARGS`
    :param size: pixels of a frame's sides
    :param frame_stack: frames of an observation
    :param frame_skip: frames of a decision
    :param noop_max: largest number of no-op frames after a reset (drawn from 1 on); None for none
    :param episodic_life: whether a lost life ends an episode
    :param clip_reward: whether rewards are clipped to their sign
    :raises ValueError: an argument is out of range, or the game was made with other arguments
    """

    def __init__(
        self,
        env: gym.Env,
        size: int = 84,
        frame_stack: int = 4,
        frame_skip: int = 4,
        noop_max: int | None = 30,
        episodic_life: bool = True,
        clip_reward: bool = True,
    ):
        check_value("size", size, integer(1, 160))
        check_value("frame_stack", frame_stack, integer(1))
        check_value("frame_skip", frame_skip, integer(2))
        check_value("noop_max", noop_max, integer(1).or_none("no no-ops"))
        check_value("episodic_life", episodic_life, TRUE_OR_FALSE)
        check_value("clip_reward", clip_reward, TRUE_OR_FALSE)
        _check_game(env)
        if noop_max is not None:
            env = NoopResetEnv(env, noop_max)
        env = MaxAndSkipEnv(env, frame_skip)
        if episodic_life:
            env = EpisodicLifeEnv(env)
        env = AreaResize(env, size)
        if clip_reward:
            env = ClipRewardEnv(env)
        super().__init__(gym.wrappers.FrameStackObservation(env, frame_stack, padding_type="zero"))


def _check_game(env: gym.Env) -> None:
    if not is_atari(env):
        raise ValueError(f"env must be an Atari game ({ATARI}<Game>-v5), not {env}")
    game: Any = env.unwrapped
    space, frameskip = env.observation_space, game._frameskip
    if frameskip != 1:
        raise ValueError(
            f"env must be made with frameskip=1, not {frameskip}, since the wrapper skips frames itself: "
            f"gym.make(..., **{ENV_KWARGS})"
        )
    if not isinstance(space, spaces.Box) or space.shape is None or len(space.shape) != 2:
        raise ValueError(
            f"env must be made with obs_type='grayscale', for the console's own gray screen; its observations are "
            f"{space}: gym.make(..., **{ENV_KWARGS})"
        )
    sticky = game.ale.getFloat("repeat_action_probability")
    if sticky != 0:
        warn(
            f"the game repeats its last action with probability {sticky:g} in every frame (repeat_action_probability): "
            f"for the published games, without sticky actions, make it with gym.make(..., **{ENV_KWARGS})"
        )
