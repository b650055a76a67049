"""Objectives of actor and critics on a batch: soft actor-critic's and others."""

from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch.optim import Optimizer

from sb3_sample.learner import losses
from sb3_sample.learner.batch import Batch
from sb3_sample.learner.exploration import spread
from sb3_sample.learner.parts import Learning, Part
from sb3_sample.learner.target import values

#: The largest weight of an action in IQL's regression, as in its published code.
MAX_WEIGHT = 100.0


class Prepared(NamedTuple):
    """
    Results that an objective computes before the critics' step, without gradient: the critics' ``target``, (B, 1), None
    for the TD target of the actor's next action; and the ``weights`` of the batch's actions for the actor, (B, 1).
    """

    target: torch.Tensor | None = None
    weights: torch.Tensor | None = None


class Objective(Part):
    """Objective of soft actor-critic and TD3: the value of the actor's own actions; base class of the others."""

    has_state: ClassVar[bool] = False
    #: Whether the critics learn.
    learns_critics: ClassVar[bool] = True

    def prepare(self, learner: Learning, batch: Batch) -> tuple[dict[str, torch.Tensor], Prepared]:
        """
        Take the learning steps that precede the critics' step.

        :param learner: the learner
        :param batch: transitions
        :return: what to log, by name, scalars; and the results that the later steps need
        """
        return {}, Prepared()

    def own_target(self, learner: Learning, batch: Batch) -> torch.Tensor | None:
        """
        Compute the objective's own target of the critics, without learning.

        :param learner: the learner
        :param batch: transitions
        :return: (B, 1), without gradient; None for the TD target of the actor's next action
        """
        return None

    def actor_loss(
        self,
        learner: Learning,
        batch: Batch,
        observations: Any,
        alpha: torch.Tensor,
        noise: torch.Tensor | None,
        prepared: Prepared,
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """
        Compute the actor's loss.

        :param learner: the learner, after its critics' step, or before it with ``actor_first``
        :param batch: transitions
        :param observations: the batch's observations for the actor, encoded once if there is a shared encoder
        :param alpha: temperature, a scalar, or (B, 1) where tasks have their own
        :param noise: standard normal noise of the sampled actions, (B, A)
        :param prepared: from :meth:`prepare`
        :return: scalar; and the log-probability of the sampled actions, (B, 1), from which the temperature learns, None
            if it does not
        """
        actions, log_prob = sampled(learner, batch, observations, noise)
        value = learner.actor_value(values(learner, learner.critic, observations, actions))
        return losses.actor_loss(log_prob, value, alpha.detach()), log_prob


def sampled(
    learner: Learning, batch: Batch, observations: Any, noise: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Sample the actor's own actions, in one forward pass with the next rows if its network requires them.

    :param learner: the learner
    :param batch: transitions
    :param observations: the batch's observations for the actor
    :param noise: standard normal noise, (B, A)
    :return: actions in [-1, 1], (B, A), and their log-probability, (B, 1)
    """
    if learner.actor.trunk.stacks_actor_rows:
        return learner.actor.sample(observations, noise, learner.encoded(batch.next_observations))  # type: ignore[no-any-return]
    return learner.actor.sample(observations, noise)  # type: ignore[no-any-return]


class OptimisticValue(Objective):
    """
    Objective of one optimistic actor alone (DAC, table 1): it maximises ``Q_mean + optimism * Q_std`` of its actions.

    :param optimism: constant weight of the critics' spread
    :param uncertainty: what Q_std is; see :func:`~sb3_sample.learner.exploration.spread`
    :param entropy: whether the entropy is rewarded too
    """

    def __init__(self, optimism: float, uncertainty: str, entropy: bool):
        super().__init__()
        self.optimism, self.uncertainty, self.entropy = optimism, uncertainty, entropy

    def actor_loss(
        self,
        learner: Learning,
        batch: Batch,
        observations: Any,
        alpha: torch.Tensor,
        noise: torch.Tensor | None,
        prepared: Prepared,
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        actions, log_prob = sampled(learner, batch, observations, noise)
        q = values(learner, learner.critic, observations, actions)
        upper_value = q.mean(dim=0) + self.optimism * spread(q, self.uncertainty)
        return losses.actor_loss(log_prob, upper_value, alpha.detach() if self.entropy else 0.0), log_prob


class Cloning(Objective):
    """
    Behavioural cloning: the likelihood of the batch's actions, or their squared distance from those of a deterministic
    actor. Critics do not learn.
    """

    learns_critics: ClassVar[bool] = False

    def actor_loss(
        self,
        learner: Learning,
        batch: Batch,
        observations: Any,
        alpha: torch.Tensor,
        noise: torch.Tensor | None,
        prepared: Prepared,
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        if learner.actor.has_entropy:
            return -learner.actor.log_prob_of(observations, batch.actions).mean(), None
        return F.mse_loss(learner.actor.sample(observations)[0], batch.actions), None


class ClonedValue(Objective):
    """
    Objective of TD3+BC (Fujimoto and Gu 2021, eq. 5): the actor's value, divided by its mean size, and the squared
    distance from the batch's actions.

    :param weight: of the value, the paper's alpha
    """

    def __init__(self, weight: float):
        super().__init__()
        self.weight = weight

    def actor_loss(
        self,
        learner: Learning,
        batch: Batch,
        observations: Any,
        alpha: torch.Tensor,
        noise: torch.Tensor | None,
        prepared: Prepared,
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        actions, _ = sampled(learner, batch, observations, noise)
        value = learner.actor_value(values(learner, learner.critic, observations, actions))
        return losses.cloned_value_loss(value.mean(dim=1), actions, batch.actions, self.weight), None


class ImplicitQ(Objective):
    """
    Objective of implicit Q-learning (Kostrikov et al. 2021): a value network learns an expectile of the target critics'
    values of the batch's actions, the critics learn from its value of the next state, and the actor repeats the
    batch's actions, weighted by their advantage. Actions outside of the data are never evaluated.

    The order is that of the published update: value network, weights by the new one and the old targets, and then the
    critics, whose targets move last.

    :param learner: the learner, whose networks exist already
    :param expectile: expectile that the value network learns, in (0, 1); 0.5 is the mean
    :param inverse_temperature: weight of the advantage in the exponent of an action's weight
    """

    has_state: ClassVar[bool] = True
    optimizer: Optimizer

    def __init__(self, learner: Learning, expectile: float, inverse_temperature: float):
        super().__init__()
        self.expectile, self.inverse_temperature = expectile, inverse_temperature
        self.value = learner.make_value().to(learner.device)
        self.optimizer = learner.make_optimizer(self.value.parameters())

    def optimizers(self) -> dict[str, Optimizer]:
        return {"optimizer": self.optimizer}

    def prepare(self, learner: Learning, batch: Batch) -> tuple[dict[str, torch.Tensor], Prepared]:
        with torch.no_grad():
            q = learner.pessimism_rule.value(values(learner, learner.critic_target, batch.observations, batch.actions))
            q = q.mean(dim=1, keepdim=True)
        v = self.value(batch.observations)
        loss = losses.expectile_loss(q - v, self.expectile)
        learner.minimize(self.optimizer, loss)
        self.value.project()
        with torch.no_grad():
            advantage = q - self.value(batch.observations)
            weights = losses.advantage_weights(advantage, self.inverse_temperature, MAX_WEIGHT)
        target = self.own_target(learner, batch)
        metrics = {"train/value_loss": loss, "train/value": v.mean(), "train/advantage_weight": weights.mean()}
        return metrics, Prepared(target, weights)

    def own_target(self, learner: Learning, batch: Batch) -> torch.Tensor:
        with torch.no_grad():
            assert batch.discounts is not None
            following = self.value(batch.next_observations)
            return losses.td_target(batch.rewards, batch.dones, batch.discounts, following, 0.0)

    def actor_loss(
        self,
        learner: Learning,
        batch: Batch,
        observations: Any,
        alpha: torch.Tensor,
        noise: torch.Tensor | None,
        prepared: Prepared,
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        return -(prepared.weights * learner.actor.log_prob_of(observations, batch.actions)).mean(), None
