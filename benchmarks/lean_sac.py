"""
SAC by a bare recipe, that of LeanRL (https://github.com/pytorch-labs/LeanRL): one function per update, captured as a
CUDA graph, Adam fused and with its counts on the device, and nothing else: no parts, no logs, no files. It is what a
gradient step costs without this package's machinery; ``gpu.py`` measures it beside ours.

Networks, batch and numbers are those of this package's ``SAC``, and so is each update, to rounding.
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import nn

GAMMA, TAU, LEARNING_RATE = 0.99, 0.005, 3e-4
#: The log standard deviation is squashed into this interval by a tanh.
LOG_STD = (-10.0, 2.0)


class LeanSAC:
    """
    Two critics and an actor of two layers, their targets, and a learned temperature.

    :param observation: numbers observed, O
    :param action: numbers of an action in [-1, 1], A
    :param width: of the layers
    :param batch_size: B
    :param device: where it computes; on a GPU :meth:`capture` makes an update one launch
    :param compiled: whether the update is compiled by ``torch.compile``
    """

    def __init__(
        self,
        observation: int,
        action: int,
        width: int = 256,
        batch_size: int = 256,
        device: torch.device | str = "cpu",
        compiled: bool = False,
    ):
        self.device, self.target_entropy = torch.device(device), -action / 2
        layers = [nn.Linear(observation, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()]
        self.actor = nn.Sequential(*layers, nn.Linear(width, 2 * action)).to(device)
        sizes = [observation + action, width, width, 1]
        # Weights (2, in, out) and biases (2, 1, out) of both critics, in turns.
        self.critics = [
            nn.Parameter((2 * torch.rand(2, rows, out, device=device) - 1) / math.sqrt(of))
            for of, out in pairwise(sizes)
            for rows in (of, 1)
        ]
        self.targets = [parameter.detach().clone() for parameter in self.critics]
        self.log_alpha = nn.Parameter(torch.zeros((), device=device))
        self.actor_optimizer, self.critic_optimizer, self.alpha_optimizer = (
            torch.optim.Adam(parameters, lr=LEARNING_RATE, fused=True, capturable=self.device.type == "cuda")
            for parameters in (self.actor.parameters(), self.critics, [self.log_alpha])
        )
        shapes = [(batch_size, n) for n in (observation, action, observation, 1, 1)]
        #: The batch of the next update: observations, actions, next observations, terminations, rewards.
        self.inputs = [torch.zeros(shape, device=device) for shape in shapes]
        self._update: Callable[..., None] = torch.compile(self.update) if compiled else self.update
        #: Takes one update on ``inputs``.
        self.launch: Callable[[], None] = self._run

    def sample(self, observations: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Sample actions.

        :param observations: (B, O)
        :param noise: standard normal noise, (B, A)
        :return: actions in [-1, 1], (B, A), and their log-probability, (B, 1)
        """
        mean, log_std = self.actor(observations).chunk(2, dim=1)
        low, high = LOG_STD
        log_std = low + (high - low) / 2 * (1 + torch.tanh(log_std))
        x = mean + log_std.exp() * noise
        normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        jacobian = 2 * (math.log(2) - x - F.softplus(-2 * x))
        return torch.tanh(x), (normal - jacobian).sum(dim=1, keepdim=True)

    @staticmethod
    def q(critics: Sequence[torch.Tensor], observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """
        Values of both critics.

        :param critics: their parameters
        :param observations: (B, O)
        :param actions: (B, A)
        :return: (2, B, 1)
        """
        x = torch.cat((observations, actions), dim=1).expand(2, -1, -1)
        for i in range(0, len(critics) - 2, 2):
            x = torch.relu(torch.baddbmm(critics[i + 1], x, critics[i]))
        return torch.baddbmm(critics[-1], x, critics[-2])

    def update(
        self,
        observations: torch.Tensor,
        actions: torch.Tensor,
        next_observations: torch.Tensor,
        dones: torch.Tensor,
        rewards: torch.Tensor,
        noise: torch.Tensor,
    ) -> None:
        """
        Take one update: critics, their targets, actor, temperature.

        :param observations: (B, O)
        :param actions: (B, A)
        :param next_observations: (B, O)
        :param dones: 1 where the episode terminated, (B, 1)
        :param rewards: (B, 1)
        :param noise: standard normal noise of the next and of the actor's own actions, (2, B, A)
        """
        alpha = self.log_alpha.detach().exp()
        with torch.no_grad():
            following, log_prob = self.sample(next_observations, noise[0])
            value = self.q(self.targets, next_observations, following).amin(dim=0) - alpha * log_prob
            target = rewards + GAMMA * (1 - dones) * value
        difference = self.q(self.critics, observations, actions) - target
        self._descend(self.critic_optimizer, difference.square().mean(dim=(1, 2)).sum())
        with torch.no_grad():
            torch._foreach_lerp_(self.targets, self.critics, TAU)

        own, log_prob = self.sample(observations, noise[1])
        value = self.q([parameter.detach() for parameter in self.critics], observations, own).amin(dim=0)
        self._descend(self.actor_optimizer, (alpha * log_prob - value).mean())

        entropy = -log_prob.detach().mean()
        self._descend(self.alpha_optimizer, self.log_alpha.exp() * (entropy - self.target_entropy))

    @staticmethod
    def _descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def _run(self) -> None:
        shape = (2, *self.inputs[1].shape)
        self._update(*self.inputs, torch.randn(shape, device=self.device))

    def capture(self) -> None:
        """Capture the update as a CUDA graph, after three that are run as they are. On a CPU nothing is captured."""
        if self.device.type != "cuda":
            return
        present, apart = torch.cuda.current_stream(), torch.cuda.Stream()
        apart.wait_stream(present)
        with torch.cuda.stream(apart):
            for _ in range(3):
                self._run()
        present.wait_stream(apart)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._run()
        self.launch = graph.replay

    def step(self, store: Sequence[torch.Tensor]) -> None:
        """
        Draw a batch and take one update.

        :param store: columns of the transitions, on the device, in the order of ``inputs``
        """
        rows = torch.randint(len(store[0]), (len(self.inputs[0]),), device=self.device)
        for own, column in zip(self.inputs, store, strict=True):
            torch.index_select(column, 0, rows, out=own)
        self.launch()
