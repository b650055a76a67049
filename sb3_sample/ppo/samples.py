"""Samples of an iteration, real and simulated, and the policy's distributions at their states."""

import math
from typing import Any, NamedTuple

import torch
from stable_baselines3.common.distributions import CategoricalDistribution, DiagGaussianDistribution, Distribution


class Rollout(NamedTuple):
    """
    The real samples of an iteration. N is their number, steps times environments.

    :param observations: (N, O)
    :param actions: the policy's, (N, A), or (N,) integers of a Discrete space
    :param log_probs: of the actions under the policy that took them, (N,)
    :param values: the critic's of the observations, before the update, (N,)
    :param advantages: by GAE(lambda), (N,)
    :param returns: TD(lambda), (N,)
    """

    observations: torch.Tensor
    actions: torch.Tensor
    log_probs: torch.Tensor
    values: torch.Tensor
    advantages: torch.Tensor
    returns: torch.Tensor


class SimulatedSamples(NamedTuple):
    """
    Samples of the policy that no environment has seen: X for each of N real observations.

    :param observations: the simulated states, (N, X, O); None if the actions are for the N real observations
    :param actions: the policy's, (N, X, A), or (N, X) integers of a Discrete space
    :param log_probs: of the actions under the policy that drew them, (N, X)
    :param q_values: estimates of Q(s, a), (N, X)
    :param advantages: q_values minus the critic's values of the states, (N, X)
    :param weights: how much each sample counts, a real one counting 1, (N, X); None if each counts 1
    """

    observations: torch.Tensor | None
    actions: torch.Tensor
    log_probs: torch.Tensor
    q_values: torch.Tensor
    advantages: torch.Tensor
    weights: torch.Tensor | None = None


def check_parameters_of(distribution: torch.distributions.Distribution) -> None:
    """
    Check the parameters of a distribution as torch does unless it was told not to: the first ``torch.compile`` of a
    process, of an off-policy model for one, tells all distributions that are made after it not to.

    :param distribution: a distribution
    :raises ValueError: they are out of range or NaN
    """
    if not distribution._validate_args:
        shapes = distribution.batch_shape, distribution.event_shape
        torch.distributions.Distribution.__init__(distribution, *shapes, validate_args=True)


def log_prob_of_many(distribution: Distribution, actions: torch.Tensor) -> torch.Tensor:
    """
    :param distribution: of the actions at B states
    :param actions: M for each state, (B, M, A), or (B, M) integers
    :return: their log-probabilities, (B, M)
    """
    if isinstance(distribution, CategoricalDistribution):
        return distribution.distribution.logits.gather(1, actions.long())
    assert isinstance(distribution, DiagGaussianDistribution)
    normal: Any = distribution.distribution
    mean, std = normal.mean[:, None], normal.stddev[:, None]
    # torch's own formula, without its checks of every argument.
    squares = ((actions - mean) / std).square().sum(dim=2)
    constant = normal.stddev.log().sum(dim=1, keepdim=True) + mean.shape[2] * 0.5 * math.log(2 * math.pi)
    return -0.5 * squares - constant


def entropy_of(distribution: Distribution) -> torch.Tensor:
    """
    :param distribution: Gaussian or categorical, of the actions at B states
    :return: its entropies, (B,)
    """
    entropy = distribution.entropy()
    assert entropy is not None  # Gaussian and categorical distributions have one in closed form
    return entropy
