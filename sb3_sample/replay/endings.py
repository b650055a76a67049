"""Ends of episodes that the environment did not report."""

import warnings
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_sample.replay.columns import samples_at


def end_episodes(replay_buffer: ReplayBuffer) -> None:
    """
    End the episodes under way in a replay buffer: nothing that follows belongs to them. The newest transitions of
    environments in mid-episode end by a time limit, so that targets still bootstrap; in a buffer without time limits
    they terminate, as in Stable-Baselines3 where the following row holds the next observation.

    :param replay_buffer: the buffer, which may be empty
    """
    buffer: Any = replay_buffer
    if replay_buffer.size() == 0:
        return
    if hasattr(buffer, "truncate_last_trajectory"):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The last trajectory in the replay buffer will be truncated")
            buffer.truncate_last_trajectory()
        return
    last = (buffer.pos - 1) % buffer.buffer_size
    goes_on = buffer.dones[last] == 0
    buffer.dones[last][goes_on] = 1
    if buffer.handle_timeout_termination:
        buffer.timeouts[last][goes_on] = 1


def leads_to(replay_buffer: ReplayBuffer, observations: Any) -> bool:
    """
    Check whether the environments continue where a replay buffer ends.

    :param replay_buffer: the buffer
    :param observations: current observations of its environments, (n_envs, O) or a dict of them
    :return: whether the newest transition of each environment led to its observation, or ended an episode; for an empty
        buffer True
    """
    buffer: Any = replay_buffer
    if replay_buffer.size() == 0:
        return True
    last, envs = (buffer.pos - 1) % buffer.buffer_size, np.arange(buffer.n_envs)
    following = samples_at(buffer, np.full(buffer.n_envs, last), envs).next_observations
    pairs = [(following, observations)]
    if isinstance(observations, dict):
        pairs = [(following[key], each) for key, each in observations.items()]
    goes_on = np.flatnonzero(torch.as_tensor(buffer.dones[last]).cpu().numpy() == 0)
    return all(
        torch.equal(ours[i].cpu().reshape(-1), torch.as_tensor(theirs[i]).to(ours.dtype).reshape(-1))
        for ours, theirs in pairs
        for i in goes_on
    )
