"""TD target of the gradient step, of the rules of pessimism and of the diagnostics: the only place where it is made."""

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
    found: torch.Tensor = learner.head.values(evaluate(critics, observations, actions))
    return found


def bootstrap(
    learner: Learning,
    batch: Batch,
    alpha: torch.Tensor,
    noise: torch.Tensor | None = None,
    subset: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Target critics' outputs for the actor's action in the next state, and its entropy bonus. Without gradient.

    :param learner: the learner
    :param batch: transitions
    :param alpha: temperature, a scalar
    :param noise: standard normal noise of the action, (B, A); drawn if None
    :param subset: the critics that make the target, (n,); None for all
    :return: (E, B, n_outputs), or (n, B, n_outputs) of a subset; and ``-alpha * log pi(a'|s')``, (B, 1)
    """
    with torch.no_grad():
        actions, log_prob = learner.next_actions(batch.next_observations, noise)
        next_q = evaluate(learner.critic_target, batch.next_observations, actions)
        if subset is not None:
            next_q = next_q[subset]
        return next_q, -alpha.detach() * log_prob


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
