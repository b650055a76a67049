"""What one gradient step learns from."""

from typing import Any, NamedTuple

import torch
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample.sac.buffers import ValidationDictReplayBuffer, ValidationReplayBuffer

# Buffers whose every transition is drawn independently, so that one large draw can be cut into batches. Others compose
# each batch (HerReplayBuffer: so many real, so many relabelled transitions) and are asked once a gradient step.
INDEPENDENT_BUFFERS = (
    ReplayBuffer,
    DictReplayBuffer,
    NStepReplayBuffer,
    ValidationReplayBuffer,
    ValidationDictReplayBuffer,
)


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

    @classmethod
    def of(cls, samples: Any, gamma: float) -> "Batch":
        """
        :param samples: transitions as Stable-Baselines3's buffers give them
        :param gamma: discount factor, where they have none of their own
        :return: the same as a batch
        """
        discounts = getattr(samples, "discounts", None)
        return cls(
            samples.observations,
            samples.actions,
            samples.next_observations,
            samples.dones,
            samples.rewards,
            gamma if discounts is None else discounts,
        )


class Noise(NamedTuple):
    """Standard normal noise of one gradient step's sampled actions, (B, A) each; drawn where it is None."""

    critic: torch.Tensor | None = None
    actor: torch.Tensor | None = None
    exploration: torch.Tensor | None = None
    pessimism: torch.Tensor | None = None


class CriticStep(NamedTuple):
    """
    What the critics' step computed, before it changed them: a rule of pessimism that learns from the same
    transitions need not compute it again. Without gradient.

    ``q`` is (E, B, K), the critics' predictions; ``next_q`` (E, B, K), the target critics' of the next state and the
    actor's action there (of the drawn subset, if one is drawn); ``entropy_bonus``, ``-alpha * log pi`` of that
    action, (B, 1).
    """

    q: torch.Tensor
    next_q: torch.Tensor
    entropy_bonus: torch.Tensor


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
    data = Batch.of(buffer.sample(n_batches * batch_size, env=vec_normalize), gamma)

    def cut(x: Any) -> list[Any]:
        if isinstance(x, (int, float)):
            return [x] * n_batches
        if isinstance(x, dict):
            pieces = {key: value.split(batch_size) for key, value in x.items()}
            return [{key: value[i] for key, value in pieces.items()} for i in range(n_batches)]
        return list(x.split(batch_size))

    return [Batch(*row) for row in zip(*map(cut, data), strict=True)]
