"""DrQ's gradient steps against the same steps in plain PyTorch, written from the paper."""

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as F

from sb3_sample import DrQ
from sb3_sample.learner.batch import Batch, Noise
from tests.sac.pixels import TINY, drq

N, GAMMA, PAD = 6, 0.9, 1
TARGET_ENTROPY = -2.0
Parameters = dict[str, torch.Tensor]


class Reference:
    """
    DrQ with one hidden layer, from a model's initial parameters.

    :param model: the model
    :param strides: of the convolutions
    :param pads_images: whether convolutions put a row and a column of zeros below and to the right of their images
    """

    def __init__(self, model: DrQ, strides: tuple[int, ...], pads_images: bool):
        self.strides, self.pads_images, self.tau = strides, pads_images, model.tau
        self.n_target, self.n_online = model.target_copies, model.online_copies
        self.critic, self.actor = ({k: v.clone() for k, v in part.state_dict().items()}
                                   for part in (model.critic, model.actor))  # fmt: skip
        self.target = {k: v.clone() for k, v in self.critic.items()}
        self.log_alpha = torch.tensor(math.log(0.1))
        groups: list[list[torch.Tensor]] = [[*self.critic.values()], [*self.actor.values()], [self.log_alpha]]
        self.optimizers = [torch.optim.Adam([p.requires_grad_() for p in group], model.lr_schedule(1.0))
                           for group in groups]  # fmt: skip

    def images(self, stacks: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
        """Crops of the replicate-padded images, from 0 to 1."""
        height, width = stacks.shape[2:]
        padded = F.pad(stacks.float(), (PAD, PAD, PAD, PAD), mode="replicate")
        crops = [
            stack[:, i : i + height, j : j + width] for stack, (i, j) in zip(padded, offsets.tolist(), strict=True)
        ]
        return torch.stack(crops) / 255

    def encoded(self, p: Parameters, x: torch.Tensor) -> torch.Tensor:
        kernels = [name for name in p if name.startswith("features_extractor") and name.endswith("weight")]
        for kernel, stride in zip(kernels, self.strides, strict=True):
            x = F.pad(x, (0, 1, 0, 1)) if self.pads_images else x
            x = F.relu(F.conv2d(x, p[kernel], p[kernel.replace("weight", "bias")], stride))
        return x.flatten(1)

    def projected(self, p: Parameters, features: torch.Tensor) -> torch.Tensor:
        """Dense layer, layer norm, tanh."""
        x = F.linear(features, p["trunk.projection.0.weight"], p["trunk.projection.0.bias"])
        x = (x - x.mean(1, keepdim=True)) / (x.var(1, unbiased=False, keepdim=True) + 1e-5).sqrt()
        return torch.tanh(x * p["trunk.projection.1.weight"] + p["trunk.projection.1.bias"])

    def q_values(self, p: Parameters, features: torch.Tensor, actions: torch.Tensor) -> list[torch.Tensor]:
        x = torch.cat((self.projected(p, features), actions), 1)
        found = []
        for i in (0, 1):
            h = F.relu(x @ p["trunk.network.layers.0.weight"][i] + p["trunk.network.layers.0.bias"][i])
            found.append(h @ p["head.weight"][i] + p["head.bias"][i])
        return found

    def sampled(self, features: torch.Tensor, normal: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions and their log-probabilities, from the density of tanh of a Gaussian."""
        p = self.actor
        x = self.projected(p, features)
        h = F.relu(F.linear(x, p["trunk.network.layers.0.weight"], p["trunk.network.layers.0.bias"]))
        mean = F.linear(h, p["mean.weight"], p["mean.bias"])
        log_std = -10 + 6 * (1 + torch.tanh(F.linear(h, p["log_std.weight"], p["log_std.bias"])))
        before = mean + log_std.exp() * normal
        gaussian = torch.distributions.Normal(mean, log_std.exp()).log_prob(before)
        actions = torch.tanh(before)
        return actions, (gaussian - torch.log1p(-(actions**2))).sum(1, keepdim=True)

    def step(self, batch: Any, noise: Noise, moves_all: bool) -> dict[str, torch.Tensor]:
        """One gradient step: critics with encoder, and, in some steps, actor, temperature and targets; its losses."""
        critic_adam, actor_adam, alpha_adam = self.optimizers
        (offsets,) = noise.transforms  # type: ignore[misc]
        now, following = offsets.split((self.n_online * N, self.n_target * N))
        alpha = self.log_alpha.exp()
        with torch.no_grad():
            targets = []
            for rows, normal in zip(following.split(N), noise.critic.split(N), strict=True):  # type: ignore[union-attr]
                images = self.images(batch.next_observations, rows)
                actions, log_prob = self.sampled(self.encoded(self.critic, images), normal)
                q = torch.minimum(*self.q_values(self.target, self.encoded(self.target, images), actions))
                targets.append(batch.rewards + GAMMA * (1 - batch.dones) * (q - alpha * log_prob))
            y = torch.stack(targets).mean(0)
        loss = torch.zeros(())
        for rows in now.split(N):
            features = self.encoded(self.critic, self.images(batch.observations, rows))
            for q in self.q_values(self.critic, features, batch.actions):
                loss = loss + ((q - y) ** 2).mean()
        losses = {"train/critic_loss": self.descend(critic_adam, loss)}
        if moves_all:
            with torch.no_grad():
                features = self.encoded(self.critic, self.images(batch.observations, now[:N]))
            actions, log_prob = self.sampled(features, noise.actor)  # type: ignore[arg-type]
            q = torch.minimum(*self.q_values(self.critic, features, actions))
            losses["train/actor_loss"] = self.descend(actor_adam, (alpha.detach() * log_prob - q).mean())
            entropy = -log_prob.detach().mean()
            of_alpha = self.log_alpha.exp() * (entropy - TARGET_ENTROPY)
            losses["train/ent_coef_loss"] = self.descend(alpha_adam, of_alpha)
            with torch.no_grad():
                for name, p in self.target.items():
                    p.mul_(1 - self.tau).add_(self.tau * self.critic[name])
        return losses

    def descend(self, optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> torch.Tensor:
        for each in self.optimizers:
            each.zero_grad()
        loss.backward()
        optimizer.step()
        return loss.detach()


def transitions(seed: int) -> Batch:
    g = torch.Generator().manual_seed(seed)
    images = torch.randint(0, 256, (2, N, 3, 8, 8), generator=g, dtype=torch.uint8)
    actions, rewards = torch.rand(N, 2, generator=g) * 1.8 - 0.9, torch.randn(N, 1, generator=g)
    return Batch(images[0], actions, images[1], torch.tensor([[0.0], [1.0]] * (N // 2)), rewards, GAMMA)


#: Arguments of the JAX code behind "The primacy bias" that differ from those of the published PyTorch code.
OF_JAX: dict[str, Any] = {
    "learning_rate": 3e-4, "tau": 0.005, "policy_delay": 1, "target_update_interval": 1,
    "target_copies": 1, "online_copies": 1,
    "policy_kwargs": {**TINY, "features_extractor_kwargs": {"filters": (4, 4), "strides": (2, 2), "padding": "same"},
                      "projection_gain": 2**0.5, "actor_network_kwargs": {"gain": 2**0.5},
                      "critic_network_kwargs": {"gain": 2**0.5}},
}  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "strides", "pads_images"), [({}, (2, 1), False), (OF_JAX, (2, 2), True)], ids=["pytorch", "jax"]
)
def test_gradient_steps(arguments: dict[str, Any], strides: tuple[int, ...], pads_images: bool) -> None:
    """Losses, and all parameters after each of six steps, with given shifts and noise."""
    model = drq(**arguments)
    assert model.target_entropy == TARGET_ENTROPY
    reference, every = Reference(model, strides, pads_images), model.policy_delay
    before = {k: v.clone() for k, v in model.critic.state_dict().items()}
    for i in range(1, 7):
        g = torch.Generator().manual_seed(100 + i)
        k, m = model.target_copies, model.online_copies
        noise = Noise(
            torch.randn(k * N, 2, generator=g), torch.randn(N, 2, generator=g), torch.randn(N, 2, generator=g),
            transforms=(torch.randint(2 * PAD + 1, ((k + m) * N, 2), generator=g),),
        )  # fmt: skip
        batch = transitions(i)
        metrics = model.learner.update(batch, noise)
        for name, loss in reference.step(batch, noise, moves_all=i % every == 0).items():
            torch.testing.assert_close(metrics[name], loss, rtol=1e-4, atol=1e-5)
        for name, ours, theirs in (
            ("critic", model.critic.state_dict(), reference.critic),
            ("target", model.critic_target.state_dict(), reference.target),
            ("actor", model.actor.state_dict(), reference.actor),
        ):
            for parameter, value in theirs.items():
                torch.testing.assert_close(
                    ours[parameter], value.detach(), rtol=1e-4, atol=2e-6,
                    msg=lambda m, name=name, parameter=parameter, i=i: f"{name} {parameter}, step {i}: {m}",
                )  # fmt: skip
        torch.testing.assert_close(model.temperature().detach(), reference.log_alpha.exp().detach())
    assert all((value != before[name]).any() for name, value in model.critic.state_dict().items())
