"""Ends of episodes that the environment has not told of."""

from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer


def end_episodes(replay_buffer: ReplayBuffer) -> None:
    """
    End the episodes under way in a replay buffer: nothing that follows belongs to them. The newest transitions of
    environments in mid-episode end by a time limit, so that the bootstrap goes on; in a buffer that does not know time
    limits they terminate, as Stable-Baselines3 has it where the following row holds the next observation.

    :param replay_buffer: the buffer, which may be empty
    """
    buffer: Any = replay_buffer
    if replay_buffer.size() == 0:
        return
    if hasattr(buffer, "truncate_last_trajectory"):
        buffer.truncate_last_trajectory()
        return
    last = (buffer.pos - 1) % buffer.buffer_size
    goes_on = buffer.dones[last] == 0
    buffer.dones[last][goes_on] = 1
    if buffer.handle_timeout_termination:
        buffer.timeouts[last][goes_on] = 1
