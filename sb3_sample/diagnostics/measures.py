"""
Quantities of the papers (Overestimation, Overfitting and Plasticity, section 3; VPL, appendix E.2; Value-Based Deep RL
Scales Predictably, appendix F), computed from plain numbers, without model or environment.

Shapes use the letters E critics, B batch, N neurons.
"""

from typing import NamedTuple

import numpy as np
import torch


class Rollout(NamedTuple):
    """The n steps of the policy from a state and action on, in the critic's units."""

    #: the critics' mean at the first state and action
    value: float
    #: (n,), from the first state and action on
    rewards: np.ndarray
    #: (n,), of the actions taken
    log_probs: np.ndarray
    #: whether the last step ended the episode, other than by a time limit
    terminated: bool


def discounted_return(rewards: np.ndarray, gamma: float, terminated: bool) -> float:
    """
    Discounted return of a rollout. After a termination nothing follows. If the rollout was merely cut (by a time limit,
    or by its own length), its mean reward is taken to continue for ever, with the weight ``gamma ** n / (1 - gamma)``.

    :param rewards: (n,)
    :param gamma: discount factor, below 1
    :param terminated: whether the episode ended with the last reward, other than by a time limit
    :return: the return
    """
    n = len(rewards)
    seen = float(np.sum(rewards * gamma ** np.arange(n)))
    return seen if terminated else seen + gamma**n / (1 - gamma) * float(rewards.mean())


def average_value(rewards: np.ndarray, log_probs: np.ndarray, alpha: float, gamma: float, terminated: bool) -> float:
    """
    VPL, equation 22: ``(mean reward - alpha * mean log pi) / (1 - gamma)``. The factor is the sum of the geometric
    series of a task without end; if the episode terminated, the sum of its first n terms takes its place.

    :param rewards: (n,)
    :param log_probs: log-probabilities of the actions, (n,)
    :param alpha: temperature
    :param gamma: discount factor, below 1
    :param terminated: whether the episode ended with the last reward, other than by a time limit
    :return: the value
    """
    horizon = (1 - gamma ** len(rewards) if terminated else 1) / (1 - gamma)
    return float(horizon * (rewards.mean() - alpha * log_probs.mean()))


def effective_rank(features: torch.Tensor, delta: float = 0.01) -> torch.Tensor:
    """
    Effective rank of feature matrices (Kumar et al. 2020): the least k such that the k largest singular values sum to
    at least ``1 - delta`` of the sum of all of them. 0 for a matrix of zeros; at most the smaller of B and N.

    :param features: (..., B, N)
    :param delta: the share that may be missing, in (0, 1)
    :return: (...), NaN for a matrix that is not finite
    """
    finite = torch.isfinite(features).all(dim=-1).all(dim=-1)
    # On the CPU since not every device has float64; the sums need it.
    features = torch.where(finite[..., None, None], features, 0.0).cpu().double()
    sums = torch.linalg.svdvals(features).cumsum(dim=-1)
    # sums[k - 1] is the sum of k values, and that of none is 0.
    total = sums[..., -1:]
    rank = (sums < (1 - delta) * total).sum(dim=-1) + (total[..., 0] > 0)
    return torch.where(finite.cpu(), rank.double(), torch.nan)


def dormant_shares(scores: dict[str, torch.Tensor], threshold: float) -> dict[str, float]:
    """
    Share of the neurons whose score is at most the threshold (Sokar et al. 2023), copies taken together.

    :param scores: scores of a network by layer, (E, N) or (N,)
    :param threshold: score up to which a neuron is dormant
    :return: the share by layer, and under "" the share of all neurons together; empty if there is no layer
    """
    dormant = {name: (layer <= threshold).double().flatten() for name, layer in scores.items()}
    if dormant:
        dormant[""] = torch.cat(list(dormant.values()))
    return {name: layer.mean().item() for name, layer in dormant.items()}


def global_norm(tensors: list[torch.Tensor]) -> float:
    """
    :param tensors: parameters or gradients
    :return: the L2 norm of all their elements together
    """
    return torch.stack([torch.linalg.vector_norm(tensor.detach()) for tensor in tensors]).norm().item()


def noise_scale(
    small: float, large: float, small_batch: int = 64, large_batch: int = 1024
) -> tuple[float, float, float]:
    """
    Critical batch size from the gradient norms at two batch sizes ("Value-Based Deep RL Scales Predictably", Rybkin et
    al. 2025, appendix F; McCandlish et al. 2018).

    :param small: squared norm of the gradient of the small batch, averaged over batches first
    :param large: squared norm of the gradient of the large batch
    :param small_batch: rows of the small batch
    :param large_batch: rows of the large batch
    :return: squared norm of the true gradient, trace of the covariance of one row's, and their ratio, the critical
        batch size (inf where the first is not above 0)
    :raises ValueError: the batch sizes do not ascend
    """
    if not 0 < small_batch < large_batch:
        raise ValueError(f"batch sizes must ascend from above 0, not {small_batch}, {large_batch}")
    signal = (large_batch * large - small_batch * small) / (large_batch - small_batch)
    noise = (small - large) / (1 / small_batch - 1 / large_batch)
    return signal, noise, noise / signal if signal > 0 else float("inf")
