"""What one gradient step learns from."""

from typing import Any, NamedTuple

import torch
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

# Buffers whose every transition is drawn independently, so that one large draw can be cut into batches. Others compose
# each batch (HerReplayBuffer: so many real, so many relabelled transitions) and are asked once a gradient step.
INDEPENDENT_BUFFERS = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer)


class Batch(NamedTuple):
    """
    One gradient step's transitions.

    ``observations`` and ``next_observations`` are (B, O) or dicts of tensors; ``actions``, in [-1, 1], (B, A);
    ``dones``, 1 where the episode terminated (a time limit is 0), and ``rewards``, (B, 1); ``discounts`` a
    number or (B, 1).
    """

    observations: Any
    actions: torch.Tensor
    next_observations: Any
    dones: torch.Tensor
    rewards: torch.Tensor
    discounts: torch.Tensor | float


class Noise(NamedTuple):
    """Standard normal noise of one gradient step's sampled actions, (B, A) each; drawn where it is None."""

    critic: torch.Tensor | None = None
    actor: torch.Tensor | None = None
    exploration: torch.Tensor | None = None


def draw_batches(
    buffer: ReplayBuffer, n_batches: int, batch_size: int, gamma: float, vec_normalize: VecNormalize | None
) -> list[Batch]:
    """
    The batches of several gradient steps, drawn at once where that gives the same distribution.

    :param buffer: replay buffer
    :param n_batches: number of gradient steps
    :param batch_size: transitions a step
    :param gamma: discount factor, where the buffer has none of its own
    :param vec_normalize: normalises observations and rewards as they are drawn
    :return: the batches
    """
    if n_batches > 1 and type(buffer) not in INDEPENDENT_BUFFERS:
        return [draw_batches(buffer, 1, batch_size, gamma, vec_normalize)[0] for _ in range(n_batches)]
    data = buffer.sample(n_batches * batch_size, env=vec_normalize)
    discounts = getattr(data, "discounts", None)

    def cut(x: Any) -> list[Any]:
        if isinstance(x, dict):
            pieces = {key: value.split(batch_size) for key, value in x.items()}
            return [{key: value[i] for key, value in pieces.items()} for i in range(n_batches)]
        return list(x.split(batch_size))

    columns = (data.observations, data.actions, data.next_observations, data.dones, data.rewards)
    constant = [gamma] * n_batches
    return [
        Batch(*row) for row in zip(*map(cut, columns), constant if discounts is None else cut(discounts), strict=True)
    ]
