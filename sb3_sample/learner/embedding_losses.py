"""
Losses of DR.Q's embeddings ("Debiased model-based Representations for Q-learning", https://arxiv.org/abs/2605.11711):
pure functions of tensors.

Shapes use the letters B batch, D embedding, K atoms.
"""

import torch
import torch.nn.functional as F


def symexp_atoms(low: float, high: float, n: int, like: torch.Tensor) -> torch.Tensor:
    """
    Rewards that the reward model distinguishes, ``sign(x) * (exp(|x|) - 1)`` for x spaced evenly between two numbers.

    :param low: smallest x
    :param high: largest x
    :param n: K, at least 2
    :param like: tensor whose type and device the result has
    :return: atoms, ascending, (K,)
    """
    x = torch.linspace(low, high, n, dtype=like.dtype, device=like.device)
    return x.sign() * x.abs().expm1()


def two_hot(rewards: torch.Tensor, atoms: torch.Tensor) -> torch.Tensor:
    """
    Distribution over the atoms with the reward as its mean: a reward between two atoms is shared between them
    linearly. A reward beyond the outermost atom counts as that atom.

    :param rewards: (B,)
    :param atoms: ascending, (K,)
    :return: (B, K)
    """
    rewards = rewards.clamp(atoms[0], atoms[-1])
    upper = torch.searchsorted(atoms, rewards, right=True).clamp(1, len(atoms) - 1)
    below, above = atoms[upper - 1], atoms[upper]
    share = ((rewards - below) / (above - below)).unsqueeze(1)
    code = torch.zeros(len(rewards), len(atoms), dtype=rewards.dtype, device=rewards.device)
    code = code.scatter(1, (upper - 1).unsqueeze(1), 1 - share)
    return code.scatter(1, upper.unsqueeze(1), share)


def reward_cross_entropy(logits: torch.Tensor, code: torch.Tensor) -> torch.Tensor:
    """
    Cross-entropy of the reward model.

    :param logits: over the atoms, (B, K)
    :param code: from :func:`two_hot`, (B, K)
    :return: (B,)
    """
    return -(code * torch.log_softmax(logits, dim=1)).sum(dim=1)


def infonce(predicted: torch.Tensor, target: torch.Tensor, temperature: float) -> torch.Tensor:
    """
    InfoNCE of predicted embeddings: each must be matched with its own target among those of the whole batch, by
    cosine. Not symmetric.

    :param predicted: (B, D)
    :param target: (B, D), without gradient
    :param temperature: divides the cosines
    :return: (B,)
    """
    logits = F.normalize(predicted, dim=1, eps=1e-12) @ F.normalize(target, dim=1, eps=1e-12).T / temperature
    return logits.logsumexp(dim=1) - logits.diagonal()
