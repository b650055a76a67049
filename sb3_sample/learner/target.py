"""TD target of the gradient step, the rules of pessimism and the diagnostics: the only place where it is computed."""

from typing import Any

import torch

from sb3_sample.learner import losses
from sb3_sample.learner.batch import Batch
from sb3_sample.learner.parts import Learning
from sb3_sample.learner.q_values import evaluate


def values(learner: Learning, critics: Any, observations: Any, actions: torch.Tensor) -> torch.Tensor:
    """
    Evaluate critics.

    :param learner: the learner
    :param critics: its critics, or the target critics
    :param observations: (B, O), or a dict of them
    :param actions: actions in [-1, 1], (B, A)
    :return: values for rules of pessimism and actors, (E, B, K)
    """
    found: torch.Tensor = learner.head.values(outputs(critics, observations, actions))
    return found


def outputs(critics: Any, observations: Any, actions: torch.Tensor) -> torch.Tensor:
    """
    Outputs of critics, as the head's loss and target take them, outside of the critics' step.

    :param critics: its critics, or the target critics
    :param observations: (B, O), or a dict of them
    :param actions: actions in [-1, 1], (B, A)
    :return: (E, B, n_outputs)
    """
    return evaluate(at_rest(critics), observations, actions)


def at_rest(network: Any) -> Any:
    """
    Return an actor or critics in the mode in which they are evaluated outside of their own step.

    :param network: the actor, or the critics
    :return: their view in evaluation mode, if the modes differ
    """
    view = getattr(network, "at_rest", None)
    return network if view is None else view


def next_step(
    learner: Learning, batch: Batch, alpha: torch.Tensor, noise: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Sample the action of the TD target. Without gradient.

    :param learner: the learner
    :param batch: transitions
    :param alpha: temperature, a scalar, or (B, 1) where tasks have their own
    :param noise: standard normal noise of the action, (B, A); drawn if None
    :return: the actor's action in the next state, (B, A), and its entropy bonus, ``-alpha * log pi(a'|s')``, (B, 1)
    """
    with torch.no_grad():
        actions, log_prob = learner.next_actions(batch.next_observations, noise)
        return actions, -alpha.detach() * log_prob


def online_outputs(
    learner: Learning, batch: Batch, next_actions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """
    Outputs of the critics that are trained.

    :param learner: the learner
    :param batch: transitions
    :param next_actions: from :func:`next_step`, (B, A)
    :return: (E, B, n_outputs) for the batch; the same for the next state and action if one forward pass gives both
        (``Network.stacks_rows``), else None
    """
    if learner.critic.trunk.stacks_rows is None:
        return evaluate(learner.critic, batch.observations, batch.actions), None
    return _stacked(learner.critic, batch, next_actions)


def step_outputs(
    learner: Learning, batch: Batch, next_actions: torch.Tensor, subset: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Outputs of critics and targets in the critics' step.

    :param learner: the learner
    :param batch: transitions
    :param next_actions: from :func:`next_step`, (B, A)
    :param subset: the critics that make the target, (n,); None for all
    :return: outputs for the batch, (E, B, n_outputs); and, without gradient, those for the next state and action,
        (E, B, n_outputs), or (n, B, n_outputs) of a subset
    """
    rows, next_q = learner.critic.trunk.stacks_rows, None
    with torch.no_grad():
        if rows is None:
            next_q = evaluate(learner.critic_target, batch.next_observations, next_actions)
        elif rows == "target":
            _, next_q = _stacked(learner.critic_target, batch, next_actions)
    q, stacked = online_outputs(learner, batch, next_actions)
    if next_q is None:
        assert stacked is not None
        next_q = stacked.detach()
    return q, next_q if subset is None else next_q[subset]


def _stacked(critics: Any, batch: Batch, next_actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Outputs for current and next rows, (E, B, n_outputs) each, by one forward pass."""
    now, following = batch.observations, batch.next_observations
    if isinstance(now, dict):
        rows: Any = {key: torch.cat((now[key], following[key])) for key in now}
    else:
        rows = torch.cat((now, following))
    sizes = [len(batch.actions), len(next_actions)]
    q, next_q = evaluate(critics, rows, torch.cat((batch.actions, next_actions))).split(sizes, dim=1)
    return q, next_q


def bootstrap(
    learner: Learning,
    batch: Batch,
    alpha: torch.Tensor,
    noise: torch.Tensor | None = None,
    subset: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Target critics' outputs for the actor's action in the next state, and its entropy bonus, outside of the critics'
    step. Without gradient.

    :param learner: the learner
    :param batch: transitions
    :param alpha: temperature, a scalar, or (B, 1) where tasks have their own
    :param noise: standard normal noise of the action, (B, A); drawn if None
    :param subset: the critics that make the target, (n,); None for all
    :return: (E, B, n_outputs), or (n, B, n_outputs) of a subset; and ``-alpha * log pi(a'|s')``, (B, 1)
    """
    actions, entropy_bonus = next_step(learner, batch, alpha, noise)
    with torch.no_grad():
        critics = learner.critic_target if learner.has_critic_targets else learner.critic
        next_q = evaluate(at_rest(critics), batch.next_observations, actions)
        return next_q if subset is None else next_q[subset], entropy_bonus


def td_target(batch: Batch, next_values: torch.Tensor, entropy_bonus: torch.Tensor) -> torch.Tensor:
    """
    Compute the TD target.

    :param batch: transitions, with discounts
    :param next_values: value of the ensemble by a rule of pessimism, from :func:`bootstrap`'s outputs, (B, K)
    :param entropy_bonus: from :func:`bootstrap`, (B, 1)
    :return: target of every critic, (B, K); see :func:`~sb3_sample.learner.losses.td_target`
    """
    assert batch.discounts is not None
    return losses.td_target(batch.rewards, batch.dones, batch.discounts, next_values, entropy_bonus)
