"""Learned model of the environment: a transition and a reward network (MBMA, appendix E), and their transitions."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from sb3_sample.networks.initialization import linear
from sb3_sample.networks.mlp import MLP
from sb3_sample.optim import AdamW, gradients_of

#: Epsilon of Adam for every network of the MBMA paper.
ADAM_EPS = 1e-5


class Transitions(NamedTuple):
    """
    Transitions, as arrays in the buffer and as tensors in a batch.

    :param observations: (B, O)
    :param actions: in the form of the models' input, (B, D)
    :param next_observations: (B, O), of the same episode: after the last step, the episode's last observation, not the
        next episode's first
    :param rewards: (B,)
    :param terminations: (B,), 1 where the episode terminated; a time limit is 0
    """

    observations: Any
    actions: Any
    next_observations: Any
    rewards: Any
    terminations: Any

    def take(self, rows: Any) -> "Transitions":
        """
        :param rows: indices, or a slice
        :return: these transitions; copies, except for a slice
        """
        return Transitions(*(column[rows] for column in self))


class TransitionBuffer:
    """
    The most recent transitions of all environments, in ring buffers.

    :param capacity: transitions kept
    :param observation_size: O
    :param action_size: D
    """

    def __init__(self, capacity: int, observation_size: int, action_size: int):
        self.capacity = capacity
        self.data = Transitions(
            np.zeros((capacity, observation_size), np.float32),
            np.zeros((capacity, action_size), np.float32),
            np.zeros((capacity, observation_size), np.float32),
            np.zeros(capacity, np.float32),
            np.zeros(capacity, np.float32),
        )
        self.size = 0
        self._next = 0

    def add(self, new: Transitions) -> None:
        """
        :param new: transitions, oldest first; if they exceed the capacity, the most recent are kept
        """
        n = min(len(new.rewards), self.capacity)
        rows = (self._next + np.arange(n)) % self.capacity
        for kept, values in zip(self.data, new, strict=True):
            kept[rows] = values[len(values) - n :]
        self._next = int((self._next + n) % self.capacity)
        self.size = min(self.size + n, self.capacity)

    def _by_age(self, newest: int) -> np.ndarray:
        """Rows of the most recent transitions, oldest first."""
        return (self._next - newest + np.arange(newest)) % self.capacity

    def recent(self, n: int) -> Transitions:
        """
        :param n: how many
        :return: the most recent transitions, fewer if fewer are stored
        """
        return self.data.take(self._by_age(min(n, self.size)))

    def stored(self) -> Transitions:
        """
        :return: all transitions, not ordered by age; no copies
        """
        return self.data.take(slice(self.size))

    def draw(self, n_batches: int, batch_size: int) -> np.ndarray:
        """
        :param n_batches: how many batches
        :param batch_size: transitions per batch
        :return: rows of ``stored``, drawn uniformly by NumPy's global generator, (n_batches, batch_size)
        """
        # Stable-Baselines3 seeds this generator.
        return np.random.randint(self.size, size=(n_batches, batch_size))  # noqa: NPY002

    def state_dict(self) -> dict[str, torch.Tensor]:
        """
        :return: the transitions by name, oldest first; and the next row to be written, since ``draw`` draws rows
        """
        kept = self.recent(self.size)
        named = {name: torch.from_numpy(values) for name, values in kept._asdict().items()}
        return {**named, "next": torch.tensor(self._next)}

    def load_state_dict(self, state: Mapping[str, torch.Tensor], strict: bool = True) -> None:
        """
        :param state: transitions as ``state_dict`` gives them; if they exceed the capacity, the most recent are taken
        :param strict: ignored; Stable-Baselines3 passes it
        :raises ValueError: if they do not fit this buffer, or have values that no environment gives
        """
        self._check(state)
        self.size = 0
        n = len(state["rewards"])
        # Full arrays are rotated as they were when saved, so that the same rows are drawn; others are filled from the
        # first row on, which drawing relies on. Files of earlier versions lack "next".
        self._next = (int(state.get("next", 0)) - n) % self.capacity if n >= self.capacity else 0
        self.add(Transitions(*(state[name].cpu().numpy() for name in Transitions._fields)))

    def _check(self, state: Mapping[str, torch.Tensor]) -> None:
        for name, own in self.data._asdict().items():
            values = state[name]
            if values.shape != (len(state["rewards"]), *own.shape[1:]) or values.dtype != torch.from_numpy(own).dtype:
                raise ValueError(f"{name} of transitions must be of shape (N, {own.shape[1:]}), not {values.shape}")
            if not values.isfinite().all() or (name == "terminations" and ((values != 0) & (values != 1)).any()):
                allowed = "0 or 1" if name == "terminations" else "finite"
                raise ValueError(f"{name} of transitions must be {allowed}")


class Standardizer(nn.Module):
    """
    Shifts and scales numbers by the mean and standard deviation of the data that it was fitted to; before, it does
    nothing.

    :param size: length of the vectors
    """

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    def fit(self, x: torch.Tensor) -> None:
        """
        :param x: (B, size)
        """
        self.mean.copy_(x.mean(dim=0))
        std = x.std(dim=0, correction=0)
        # Columns that never change are only shifted.
        self.std.copy_(torch.where(std > 1e-6, std, torch.ones_like(std)))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (..., size)
        :return: (..., size)
        """
        return (x - self.mean) / self.std

    def inverse(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: an output of ``forward``, (..., size)
        :return: the corresponding input of ``forward``, (..., size)
        """
        return torch.addcmul(self.mean, x, self.std)


class Prediction(NamedTuple):
    """
    A model's prediction of one step.

    :param next_observations: (B, O)
    :param rewards: (B,)
    :param continues: probability that the episode does not terminate here, (B,); None if no episode terminates
    """

    next_observations: torch.Tensor
    rewards: torch.Tensor
    continues: torch.Tensor | None


class Dynamics(nn.Module):
    """
    Model of MBMA, appendix E: "Transition model inputs concatenated state-action and outputs a state vector [...]
    trained using MSE loss function with future state used as a target", and likewise the reward model. Two networks
    without shared layers, hidden layers with ReLU.

    :param observation_size: O
    :param action_size: D
    :param width: width of the hidden layers of both networks (MBMA: 1024)
    :param depth: hidden layers of both networks (MBMA: 2)
    :param learning_rate: of Adam, whose epsilon is 1e-5
    :param normalize: whether observations and rewards are shifted and scaled by the mean and standard deviation of the
        transitions that the model is trained on, at the input and in the errors. MBMA's paper does not mention it;
        without it, entries with large values are learned at the cost of all others
    :param terminations: whether a second output of the reward network predicts that the episode terminates, by its
        cross-entropy
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        width: int = 1024,
        depth: int = 2,
        learning_rate: float = 3e-4,
        normalize: bool = True,
        terminations: bool = False,
    ):
        super().__init__()
        self.normalize, self.terminations = normalize, terminations
        n_inputs = observation_size + action_size
        trunks = [MLP(n_inputs, [width] * depth) for _ in range(2)]
        n_outputs = (observation_size, 2 if terminations else 1)
        heads = [linear(t.out_features, n, None, gain=1) for t, n in zip(trunks, n_outputs, strict=True)]
        self.transition = nn.Sequential(trunks[0], heads[0])
        self.reward = nn.Sequential(trunks[1], heads[1])
        self.observation_scale = Standardizer(observation_size)
        self.reward_scale = Standardizer(1)
        self.optimizer = AdamW(self.parameters(), lr=learning_rate, eps=ADAM_EPS)

    def forward(self, observations: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """
        :param observations: (B, O)
        :param actions: (B, D)
        :return: outputs of the transition network, (B, O), and of the reward network, (B, 1) or (B, 2), in the units
            of the errors
        """
        x = self.observation_scale(observations) if self.normalize else observations
        x = torch.cat([x, actions], dim=1)
        return self.transition(x), self.reward(x)

    def predict(self, observations: torch.Tensor, actions: torch.Tensor) -> Prediction:
        """
        :param observations: (B, O)
        :param actions: (B, D)
        :return: the next observations, rewards, and probabilities that the episode continues
        """
        next_observations, outputs = self(observations, actions)
        rewards = outputs[:, :1]
        if self.normalize:
            next_observations = self.observation_scale.inverse(next_observations)
            rewards = self.reward_scale.inverse(rewards)
        continues = torch.sigmoid(-outputs[:, 1]) if self.terminations else None
        return Prediction(next_observations, rewards[:, 0], continues)

    def losses(self, batch: Transitions) -> dict[str, torch.Tensor]:
        """
        :param batch: transitions, as tensors
        :return: mean squared errors of observation and reward, and the cross-entropy of termination, scalars by name
        """
        next_observations, outputs = self(batch.observations, batch.actions)
        target, reward_target = batch.next_observations, batch.rewards[:, None]
        if self.normalize:
            target, reward_target = self.observation_scale(target), self.reward_scale(reward_target)
        losses = {
            "transition_loss": F.mse_loss(next_observations, target),
            "reward_loss": F.mse_loss(outputs[:, :1], reward_target),
        }
        if self.terminations:
            losses["termination_loss"] = F.binary_cross_entropy_with_logits(outputs[:, 1], batch.terminations)
        return losses

    def scale_by(self, transitions: Transitions) -> None:
        """
        With ``normalize``, take the scales of inputs and errors from transitions.

        :param transitions: as tensors
        """
        if self.normalize:
            self.observation_scale.fit(transitions.observations)
            self.reward_scale.fit(transitions.rewards[:, None])

    def fit(self, transitions: Transitions, batches: torch.Tensor) -> dict[str, torch.Tensor]:
        """
        Take one step of Adam for each batch, in the given order.

        :param transitions: transitions, as tensors, which also determine the scales of inputs and errors
        :param batches: rows of the transitions for each step, (steps, B)
        :return: means of the losses before each step, by name
        """
        self.scale_by(transitions)
        # Batches are gathered one by one: together they can be many times as large as the buffer.
        return fit(self, self.optimizer, (self.losses(transitions.take(rows)) for rows in batches))


def fit(
    module: nn.Module, optimizer: torch.optim.Optimizer, steps: Iterator[dict[str, torch.Tensor]]
) -> dict[str, torch.Tensor]:
    """
    Minimise the sum of the losses, one step of the optimizer for each element.

    :param module: the module to train
    :param optimizer: of its parameters
    :param steps: yields each batch's losses by name, computed only when needed
    :return: the means of the losses, by name
    """
    parameters = list(module.parameters())
    sums: dict[str, torch.Tensor] = {}
    n_steps = 0
    for losses in steps:
        gradients = gradients_of(torch.stack(list(losses.values())).sum(), parameters)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        optimizer.step()
        n_steps += 1
        for name, loss in losses.items():
            sums[name] = sums[name] + loss.detach() if name in sums else loss.detach()
    return {name: total / n_steps for name, total in sums.items()}


def minibatches(tensors: Any, batch_size: int) -> Iterator[tuple[torch.Tensor, ...]]:
    """
    :param tensors: contiguous tensors of the same length
    :param batch_size: rows per batch; the last batch may have fewer
    :return: slices of them, without a copy
    """
    for first in range(0, len(tensors[0]), batch_size):
        yield tuple(tensor[first : first + batch_size] for tensor in tensors)
