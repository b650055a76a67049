"""
Exploration: who acts while the agent trains. ``predict`` and evaluation are the pessimistic actor's alone.
"""

import math
from typing import TYPE_CHECKING, Any

import torch
from torch.optim import Optimizer

from sb3_sample.networks import NETWORKS, linear
from sb3_sample.optim import AdamW
from sb3_sample.sac import losses
from sb3_sample.sac.parts import Part
from sb3_sample.sac.pessimism import epistemic_std
from sb3_sample.sac.scalars import BoundedLogScalar

if TYPE_CHECKING:
    from sb3_sample.sac.algorithm import SAC
    from sb3_sample.sac.batch import Batch


class Exploration(Part):
    """
    Base class, and the plain choice: a sample of the actor itself.

    :param agent: the algorithm, whose policy exists already
    """

    def __init__(self, agent: "SAC"):
        super().__init__()

    def act(self, agent: "SAC", observations: Any) -> torch.Tensor:
        """
        :param agent: the algorithm
        :param observations: tensors on the device of the model, (B, O) or a dict of them
        :return: actions in [-1, 1], (B, A)
        """
        return agent.actor.sample(observations)[0]

    def update(self, agent: "SAC", batch: "Batch", noise: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """
        Learn from the step's batch; called after the critics and the actor were updated.

        :param agent: the algorithm
        :param batch: the step's batch
        :param noise: standard normal noise of the sampled actions, (B, A); drawn if None
        :return: what to log, by name, scalars
        """
        return {}


class OptimisticShift(Exploration):
    """
    BRO's optimistic actor (P5, algorithm 2, lines 11, 12, 14, 15; section B.7): a network that sees the
    observation and the pessimistic actor's pre-tanh mean and answers with a shift of that mean; the standard
    deviation is the pessimistic one times ``std_multiplier``.

    It climbs the optimistic value ``Q_mean + optimism * Q_std`` under a penalty on the KL divergence to the
    pessimistic actor. Optimism and the penalty's weight are learned so that the divergence per action
    dimension meets ``kl_target``.

    Where text and published code differ, the code is followed (the published curves were made with it): the
    divergence goes from the optimistic to the pessimistic Gaussian, with the multiplier removed from the
    optimistic standard deviation, so that only the squared shift of the mean remains.

    :param agent: the algorithm, whose policy exists already
    :param kl_target: KL divergence per action dimension to be met, above 0
    :param std_multiplier: factor on the pessimistic standard deviation, above 0
    :param initial_optimism: optimism at the start and after a reset
    :param initial_kl_weight: weight of the divergence at the start and after a reset
    :param adjustment_learning_rate: of optimism and weight, by Adam with beta1 = 0.5
    :param network: trunk of the shift network, "bronet" or "mlp"
    :param network_kwargs: its arguments; None: one block, 256 wide, for "bronet", the network's own otherwise
    :raises ValueError: if an argument is out of range
    """

    def __init__(
        self,
        agent: "SAC",
        kl_target: float = 0.05,
        std_multiplier: float = 0.75,
        initial_optimism: float = 1.0,
        initial_kl_weight: float = 0.25,
        adjustment_learning_rate: float = 3e-5,
        network: str = "bronet",
        network_kwargs: dict[str, Any] | None = None,
    ):
        super().__init__(agent)
        for name, value in (("kl_target", kl_target), ("std_multiplier", std_multiplier)):
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be above 0 and finite, not {value}")
        if not 0 <= adjustment_learning_rate < math.inf:
            raise ValueError(f"adjustment_learning_rate must be at least 0 and finite, not {adjustment_learning_rate}")
        if network not in NETWORKS:
            raise ValueError(f"network must be one of {sorted(NETWORKS)}, not {network!r}")
        self.kl_target = kl_target
        self.std_multiplier = std_multiplier
        actor = agent.actor
        action_dim = actor.action_dim
        if network_kwargs is None:
            network_kwargs = {"width": 256, "n_blocks": 1} if network == "bronet" else {}
        self.trunk = NETWORKS[network](actor.features_dim + action_dim, **network_kwargs)
        # Without bias and nearly zero, so that the optimistic actor starts as the pessimistic one.
        self.shift = linear(self.trunk.out_features, action_dim, None, bias=False, gain=0.01)
        self.optimism = BoundedLogScalar("initial_optimism", initial_optimism)
        self.kl_weight = BoundedLogScalar("initial_kl_weight", initial_kl_weight)
        self.actor_optimizer = agent.make_optimizer([*self.trunk.parameters(), *self.shift.parameters()])
        # Their learning rate is their own, whatever the schedule of the others.
        scalars = {"params": [*self.optimism.parameters(), *self.kl_weight.parameters()], "scheduled": False}
        self.scalar_optimizer = AdamW([scalars], lr=adjustment_learning_rate, betas=(0.5, 0.999))

    def optimizers(self) -> dict[str, Optimizer]:
        return {"actor_optimizer": self.actor_optimizer, "scalar_optimizer": self.scalar_optimizer}

    def _mean(self, features: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
        """
        :param features: extracted features of the observations, (B, F)
        :param mean: the pessimistic actor's pre-tanh mean, (B, A)
        :return: the optimistic actor's pre-tanh mean, (B, A)
        """
        return mean + self.shift(self.trunk(torch.cat((features, mean), dim=1)))

    def act(self, agent: "SAC", observations: Any) -> torch.Tensor:
        features = agent.actor.features(observations)
        mean, log_std = agent.actor.gaussian(features)
        std = self.std_multiplier * log_std.exp()
        return torch.tanh(self._mean(features, mean) + std * torch.randn_like(std))

    def update(self, agent: "SAC", batch: "Batch", noise: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        with torch.no_grad():
            features = agent.actor.features(batch.observations)
            mean, log_std = agent.actor.gaussian(features)
            std = log_std.exp()
        noise = torch.randn_like(mean) if noise is None else noise
        optimism, kl_weight = self.optimism(), self.kl_weight()

        optimistic_mean = self._mean(features, mean)
        action = torch.tanh(optimistic_mean + self.std_multiplier * std * noise)
        q = agent.critic(batch.observations, action)
        q_mean, q_std = q.mean(dim=0), epistemic_std(q)
        kl = losses.gaussian_kl(optimistic_mean, std, mean, std)
        actor_loss = losses.optimistic_actor_loss(q_mean + optimism.detach() * q_std, kl, kl_weight)
        agent.minimize(self.actor_optimizer, actor_loss)

        kl_gap = kl.detach().mean() / mean.shape[1] - self.kl_target
        optimism_loss = losses.optimism_loss(optimism, agent.pessimism_rule.beta(), kl_gap)
        kl_weight_loss = losses.kl_weight_loss(kl_weight, kl_gap)
        agent.minimize(self.scalar_optimizer, optimism_loss + kl_weight_loss)
        return {
            "exploration/actor_loss": actor_loss,
            "exploration/kl": kl_gap + self.kl_target,
            "exploration/optimism": optimism,
            "exploration/optimism_loss": optimism_loss,
            "exploration/kl_weight": kl_weight,
            "exploration/kl_weight_loss": kl_weight_loss,
            "exploration/q_mean": q_mean.mean(),
            "exploration/q_std": q_std.mean(),
        }


#: Choices by the name that the algorithm's ``exploration`` argument takes.
EXPLORATIONS: dict[str, type[Exploration]] = {"actor": Exploration, "optimistic_shift": OptimisticShift}
