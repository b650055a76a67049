"""
The gradient step of soft actor-critic with exchangeable parts, in the order of BRO's pseudo-code (BRO, algorithm 2).

It computes on tensors only and draws nothing, as it is compiled or captured.
"""

from typing import Any

import torch

from sb3_sample.learner import losses
from sb3_sample.learner.batch import SLOTS, Batch, CriticStep, Encoded, Extra, Noise
from sb3_sample.learner.descent import descend
from sb3_sample.learner.objectives import Prepared
from sb3_sample.learner.parts import logged
from sb3_sample.learner.q_values import evaluate
from sb3_sample.learner.reward_scale import task_of
from sb3_sample.learner.scalars import TaskLogScalar
from sb3_sample.learner.target import next_step, online_outputs, step_outputs, td_target
from sb3_sample.optim import sharpness_aware_gradients

#: Name of the TD errors among a gradient step's results, which are not a metric.
TD_ERRORS = "td_errors"


def gradient_step(
    learner: Any, batch: Batch, noise: Noise, extra: Extra | None, moves_targets: bool, moves_actor: bool
) -> dict[str, torch.Tensor]:
    """
    Compute the gradient step.

    :param learner: the learner
    :param batch: transitions, or several copies of each
    :param noise: all random numbers of the step
    :param extra: further transitions for the rule of pessimism
    :param moves_targets: whether the target critics are updated in this step
    :param moves_actor: whether actors and temperature learn in this step
    :return: what to log, by name, scalars, and :data:`TD_ERRORS`, (B,), if the batch has the column ``slots``
    """
    images, copies = batch.observations, _encoded_once(learner, batch)
    batch = learner.first_copies(copies)
    alpha = learner.temperature_of(batch)
    metrics, prepared = learner.objective.prepare(learner, batch)
    if learner.actor_first and moves_actor:
        metrics.update(_learn_actors(learner, batch, noise, alpha, prepared))
        alpha = learner.temperature_of(batch)
    step: CriticStep | None = None
    if learner.objective.learns_critics:
        step, of_critics = _learn_critics(learner, batch, copies, images, noise, alpha, prepared)
        metrics.update(of_critics)
        # Targets, by Polyak averaging.
        if moves_targets:
            learner.move_target(learner.critic_target, learner.critic)
    if moves_actor and not learner.actor_first:
        metrics.update(_learn_actors(learner, batch, noise, alpha, prepared))
    elif learner.actor.trunk.statistics_every_step and not moves_actor:
        with torch.no_grad():
            learner.actor.gaussian(learner.actor.features(learner.encoded(batch.observations)))

    # Pessimism.
    if step is not None:
        rule = learner.pessimism_rule
        metrics.update(logged(rule, "update", rule.update(learner, batch, step, noise.pessimism, extra)))
    return {name: value.detach() for name, value in metrics.items()}


def _encoded_once(learner: Any, batch: Batch) -> Batch:
    """The batch with features in place of observations that several networks read through the online encoder."""
    networks = learner.networks
    if networks.encodes_once:
        task = task_of(batch)
        # Features no longer tell the task, which temperatures by task need.
        columns = batch.columns if task is None else {**batch.columns, "task": task}
        batch = batch._replace(observations=Encoded(networks.features(batch.observations)), columns=columns)
    if networks.encodes_next_once:
        with torch.no_grad():
            batch = batch._replace(next_observations=Encoded(networks.features(batch.next_observations)))
    return batch


def _learn_critics(
    learner: Any,
    batch: Batch,
    copies: Batch,
    observations: Any,
    noise: Noise,
    alpha: torch.Tensor,
    prepared: Prepared,
) -> tuple[CriticStep | None, dict[str, torch.Tensor]]:
    """
    Take the critics' step on all copies of the transitions. Returns the results for the rule of pessimism, None if
    there are none, and the metrics. ``observations`` are those of the copies before they were encoded.
    """
    # Towards the targets' value of the actor's next action, unless the objective has another target.
    step: CriticStep | None = None
    if prepared.target is None:
        # Where tasks have their own, a temperature for each copy.
        of_copies = alpha if alpha.dim() == 0 else alpha.repeat(learner.target_copies, 1)
        next_actions, entropy_bonus = next_step(learner, copies, of_copies, noise.critic)
        q, next_q = step_outputs(learner, copies, next_actions, noise.subset)
        with torch.no_grad():
            target = learner.head.target(copies, next_q, learner.pessimism_rule.value, entropy_bonus)
    else:
        q, target = evaluate(learner.critic, copies.observations, copies.actions), prepared.target
    if learner.has_copies:
        n = len(batch.actions)
        # Each copy gets the mean over the copies.
        target = target.reshape(-1, n, target.shape[-1]).mean(dim=0).repeat(learner.online_copies, 1)
    critic_loss = _critic_loss(learner, q, target)
    if learner.sam_radius is None:
        learner.minimize(learner.critic.optimizer, critic_loss)
    else:
        # Uphill, the features differ too.
        before_encoding = copies._replace(observations=observations)
        _sharpness_aware_step(learner, critic_loss, before_encoding, next_actions, target)
    learner.critic.project()
    q = learner.head.values(q)
    if learner.has_copies:
        q, target = q[:, :n], target[:n]
        if prepared.target is None:
            next_q, entropy_bonus = next_q[:, :n], entropy_bonus[:n]
    metrics = {"train/critic_loss": critic_loss, "train/q_mean": q.mean()}
    if prepared.target is None:
        step = CriticStep(q.detach(), learner.head.values(next_q), entropy_bonus, noise.subset)
    if SLOTS in batch.columns:
        metrics[TD_ERRORS] = _errors(learner, batch, q, step, prepared)
    return step, metrics


def _critic_loss(learner: Any, q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """The critics' loss, summed over the copies of transitions, if there are several."""
    loss: torch.Tensor = learner.head.loss(q, target)
    return loss if learner.online_copies == 1 else loss * learner.online_copies


def _sharpness_aware_step(
    learner: Any, loss: torch.Tensor, batch: Batch, next_actions: torch.Tensor, target: torch.Tensor
) -> None:
    """Take one step of the critics' optimizer with the gradient at the point ``sam_radius`` uphill."""
    critic = learner.critic
    parameters = list(critic.parameters())
    copied = {id(p) for p in critic.copied_parameters()}
    statistics = critic.statistics()
    before = [each.clone() for each in statistics]
    gradients = sharpness_aware_gradients(
        loss,
        lambda: _critic_loss(learner, online_outputs(learner, batch, next_actions)[0], target),
        parameters,
        learner.sam_radius,
        [len(p) if id(p) in copied else None for p in parameters],
    )
    with torch.no_grad():
        # The statistics are those after the critics' own pass; the pass uphill must not move them.
        for each, value in zip(statistics, before, strict=True):
            each.copy_(value)
    descend(critic.optimizer, gradients)


@torch.no_grad()
def _errors(learner: Any, batch: Batch, q: torch.Tensor, step: CriticStep | None, prepared: Prepared) -> torch.Tensor:
    """The largest absolute TD error of any critic, between means over quantiles, (B,)."""
    target = prepared.target
    if target is None:
        assert step is not None
        target = td_target(batch, learner.pessimism_rule.value(step.next_q), step.entropy_bonus)
    return (q.mean(dim=2) - target.mean(dim=1)).abs().amax(dim=0)


def _learn_actors(
    learner: Any, batch: Batch, noise: Noise, alpha: torch.Tensor, prepared: Prepared
) -> dict[str, torch.Tensor]:
    """Take the steps of actor, explorer and temperature."""
    # Actor, on the critics, and on their encoder if it is shared.
    observations = learner.encoded(batch.observations)
    actor_loss, log_prob = learner.objective.actor_loss(learner, batch, observations, alpha, noise.actor, prepared)
    learner.minimize(learner.actor.optimizer, actor_loss)
    learner.actor.project()
    metrics = {"train/actor_loss": actor_loss}
    if learner.networks.actor_target is not None:
        learner.move_target(learner.networks.actor_target, learner.actor)
        learner.networks.actor_target.trunk.follow_directions()

    # Explorer, on the critics and the new actor.
    explorer = learner.explorer
    metrics.update(logged(explorer, "update", explorer.update(learner, batch, noise.exploration)))

    # Temperature.
    if learner.actor.has_entropy and log_prob is not None:
        entropy = -log_prob.detach().mean()
        by_task = isinstance(learner.temperature, TaskLogScalar)
        metrics.update({"train/entropy": entropy, "train/ent_coef": alpha.mean() if by_task else alpha})
        if learner.temperature_optimizer is not None:
            if by_task:
                targets = learner.target_entropy
                targets = targets[task_of(batch)] if isinstance(targets, torch.Tensor) else targets
                temperature_loss = losses.temperature_loss(alpha, -log_prob, targets).mean()
            else:
                temperature_loss = losses.temperature_loss(alpha, entropy, learner.target_entropy)
            learner.minimize(learner.temperature_optimizer, temperature_loss)
            metrics["train/ent_coef_loss"] = temperature_loss
    return metrics
