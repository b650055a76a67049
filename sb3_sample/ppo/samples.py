"""Samples of an iteration, real and simulated, and the policy's distributions at their states."""

import math
from typing import Any, NamedTuple

import torch
from stable_baselines3.common.distributions import CategoricalDistribution, DiagGaussianDistribution, Distribution


class Rollout(NamedTuple):
    """
    The N real samples of an iteration, N being steps times environments.

    :param observations: (N, O)
    :param actions: the policy's actions, (N, A), or (N,) integers of a Discrete space
    :param log_probs: log-probabilities of the actions under the policy that took them, (N,)
    :param values: the critic's values of the observations before the update, (N,)
    :param advantages: GAE(lambda) advantages, (N,)
    :param returns: TD(lambda) returns, (N,)
    """

    observations: torch.Tensor
    actions: torch.Tensor
    log_probs: torch.Tensor
    values: torch.Tensor
    advantages: torch.Tensor
    returns: torch.Tensor


class SimulatedSamples(NamedTuple):
    """
    Samples of the policy that were not taken in the real environment: X for each of N real observations.

    :param observations: the simulated states, (N, X, O); None if the actions are for the N real observations
    :param actions: the policy's actions, (N, X, A), or (N, X) integers of a Discrete space
    :param log_probs: log-probabilities of the actions under the policy that drew them, (N, X)
    :param q_values: estimates of Q(s, a), (N, X)
    :param advantages: q_values minus the critic's values of the states, (N, X)
    :param weights: weight of each sample, where a real one has weight 1, (N, X); None if all have weight 1
    """

    observations: torch.Tensor | None
    actions: torch.Tensor
    log_probs: torch.Tensor
    q_values: torch.Tensor
    advantages: torch.Tensor
    weights: torch.Tensor | None = None


def check_parameters_of(distribution: torch.distributions.Distribution) -> None:
    """
    Check the parameters of a distribution as torch does by default: the first ``torch.compile`` of a process, for
    example of an off-policy model, disables the check for all distributions made later.

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
    # torch's formula without its checks of every argument.
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
