"""Losses of SPR: the distributional TD loss of C51, and the prediction of future latent states."""

import torch
from torch.nn import functional as F

from sb3_sample.learner import projection


def project(probabilities: torch.Tensor, positions: torch.Tensor, atoms: torch.Tensor) -> torch.Tensor:
    """
    Project probabilities onto the atoms of the support by :func:`sb3_sample.learner.projection.project`.

    :param probabilities: (B, K)
    :param positions: their positions, (B, K); those outside the support are moved to its ends
    :param atoms: evenly spaced, rising, (K,)
    :return: probabilities of the atoms, (B, K)
    """
    spacing = (atoms[-1] - atoms[0]) / (len(atoms) - 1)
    places = (positions.clamp(atoms[0], atoms[-1]) - atoms[0]) / spacing
    return projection.project(probabilities, places.clamp(0, len(atoms) - 1))


def n_step_return(rewards: torch.Tensor, terminated: torch.Tensor, gamma: float) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Compute the discounted rewards up to the first terminal step, and the weight of the value after the last step.

    :param rewards: (B, n)
    :param terminated: 1 where a step ended the episode, (B, n)
    :param gamma: discount factor
    :return: ``sum of gamma ** k * r_k`` up to and including the first terminal step, (B, 1); and ``gamma ** n``, or 0
        if any of the n steps was terminal, (B, 1)
    """
    n = rewards.shape[1]
    alive = alive_after(terminated)
    before = torch.cat((torch.ones_like(alive[:, :1]), alive[:, :-1]), dim=1)
    powers = gamma ** torch.arange(n, device=rewards.device, dtype=rewards.dtype)
    return (powers * before * rewards).sum(dim=1, keepdim=True), gamma**n * alive[:, -1:]


def alive_after(terminated: torch.Tensor) -> torch.Tensor:
    """
    Mark the states of a window that belong to the episode of its first state.

    :param terminated: 1 where a step ended the episode, (B, n)
    :return: for step k, 1 if none of the steps 0, ..., k was terminal, else 0, (B, n)
    """
    return (1 - terminated).cumprod(dim=1)


def spr_loss(predicted: torch.Tensor, targets: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """
    Compute the loss of the predicted projections of future states: the squared distance between the unit vectors,
    ``2 - 2 cos``, averaged over the steps, where those after a terminal step count as 0.

    :param predicted: (B, K, D)
    :param targets: without gradient, (B, K, D)
    :param mask: 1 or 0, (B, K)
    :return: loss of each window, in [0, 4], (B,)
    """
    distance = (F.normalize(predicted, dim=-1) - F.normalize(targets, dim=-1)).square().sum(dim=-1)
    return (distance * mask).mean(dim=1)
