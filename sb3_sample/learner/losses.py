"""
Losses of the off-policy family: pure functions of tensors.

Shapes use the letters B batch, E critics, K quantiles, A action. The papers cited are BRO
(https://arxiv.org/abs/2405.16158) and DAC (https://arxiv.org/abs/2310.19527).
"""

import math
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F

from sb3_sample.learner.q_values import QValues
from sb3_sample.tracing import is_tracing


def td_target(
    rewards: torch.Tensor,
    dones: torch.Tensor,
    discounts: torch.Tensor | float,
    next_values: torch.Tensor,
    entropy_bonus: torch.Tensor | float,
) -> torch.Tensor:
    """
    TD target of every critic, ``r + discount * (1 - done) * (V(s') + entropy bonus)`` (BRO, algorithm 2, line 8),
    quantile by quantile.

    :param rewards: (B, 1)
    :param dones: (B, 1), 1 where the episode terminated; a time limit is 0
    :param discounts: discount factor, a number or (B, 1) (with n-step returns)
    :param next_values: target ensemble's value of the next state and action, (B, K)
    :param entropy_bonus: ``-alpha * log pi(a'|s')``, (B, 1), or 0 without entropy
    :return: (B, K)
    """
    return rewards + (1 - dones) * discounts * (next_values + entropy_bonus)


def squared_error(q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """
    Squared error of scalar critics: mean over the batch, summed over the critics (no factor 1/2).

    :param q: predictions, (E, B, 1)
    :param target: target, (B, 1), without gradient
    :return: scalar
    """
    return (q - target).square().sum() / target.shape[0]


#: Function of predictions (E, N, K) and targets (N, K') that gives each sample's loss, (N,), and the gradient of their
#: sum for the predictions, (E, N, K).
LossAndGradient = Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]


class _KnownGradient(torch.autograd.Function):
    """
    Mean over the batch of a loss that comes with its gradient. It takes G batches one after the other, so that
    ``torch.vmap`` over it, as over the losses of many learners, is one call.
    """

    @staticmethod
    def forward(
        q: torch.Tensor, target: torch.Tensor, compute: LossAndGradient, n_batches: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        loss, gradient = compute(q, target)
        scale = n_batches / (target.shape[0] * target.shape[1])
        return (loss.view(n_batches, -1).sum(dim=1) * scale).to(q.dtype), (gradient * scale).to(q.dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(output[1])

    @staticmethod
    def backward(ctx: Any, of_loss: torch.Tensor, _: Any) -> tuple[torch.Tensor, None, None, None]:  # type: ignore[override]
        (gradient,) = ctx.saved_tensors
        n_critics, rows, n_quantiles = gradient.shape
        by_batch = gradient.view(n_critics, len(of_loss), -1, n_quantiles) * of_loss.view(-1, 1, 1)
        return by_batch.view(n_critics, rows, n_quantiles), None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: Any, q: torch.Tensor, target: torch.Tensor, compute: Any, n_batches: int) -> Any:
        n = info.batch_size
        q, target = (
            x.expand(n, *x.shape) if axis is None else x.movedim(axis, 0)
            for x, axis in zip((q, target), in_dims, strict=False)
        )
        rows = n * q.shape[2]
        loss, gradient = _KnownGradient.apply(
            q.transpose(0, 1).reshape(q.shape[1], rows, -1), target.reshape(rows, -1), compute, n * n_batches
        )
        return (loss.view(n, n_batches), gradient.view(q.shape[1], n, *q.shape[2:])), (0, 1)


def _huber_sorted(q: torch.Tensor, target: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Quantile Huber loss with threshold 1 from sorted targets, without the K x K pairs.

    For a prediction x with midpoint t, the targets y of its sample lie in four intervals::

        far below    y < x - 1        weight 1 - t    loss (x - y) - 1/2      derivative 1
        near below   x - 1 <= y < x   weight 1 - t    loss (x - y)^2 / 2      derivative x - y
        near above   x <= y <= x + 1  weight t        loss (y - x)^2 / 2      derivative x - y
        far above    y > x + 1        weight t        loss (y - x) - 1/2      derivative -1

    The borders of the intervals are found by binary search, the sums over them as differences of prefix sums of y and
    y^2. The prefix sums are float64 since they are differences of large numbers.
    """
    n_critics, n_rows, n_quantiles = q.shape
    n_targets = target.shape[1]
    y = target.sort(dim=1).values
    # Distances to the sample's middle target: the differences stay the same, of smaller numbers.
    centre = y[:, n_targets // 2, None]
    y = y - centre
    x = (q - centre).transpose(0, 1).reshape(n_rows, -1)
    borders = torch.searchsorted(y.expand(3, -1, -1).contiguous(), torch.stack((x - 1, x, x + 1)))

    y, x = y.double(), x.double()
    sums = F.pad(y.cumsum(dim=1), (1, 0))
    squares = F.pad(y.square().cumsum(dim=1), (1, 0))
    n_far_below, n_below, n_not_far_above = borders
    s_far_below, s_below, s_not_far_above = sums.expand(3, -1, -1).gather(2, borders)
    q_far_below, q_below, q_not_far_above = squares.expand(3, -1, -1).gather(2, borders)
    n_near_below, n_near_above = n_below - n_far_below, n_not_far_above - n_below
    s_near_below, s_near_above = s_below - s_far_below, s_not_far_above - s_below
    n_far_above, s_far_above = n_targets - n_not_far_above, sums[:, -1:] - s_not_far_above
    # Sums of x - y over the near intervals, from which the sums of their squares are computed.
    d_near_below, d_near_above = n_near_below * x - s_near_below, n_near_above * x - s_near_above

    t = ((torch.arange(n_quantiles, device=q.device, dtype=y.dtype) + 0.5) / n_quantiles).repeat(n_critics)
    gradient = torch.lerp(n_far_below + d_near_below, d_near_above - n_far_above, t)
    below = n_far_below * (x - 0.5) - s_far_below
    below += (x * (d_near_below - s_near_below) + q_below - q_far_below) / 2
    above = s_far_above - n_far_above * (x + 0.5)
    above += (x * (d_near_above - s_near_above) + q_not_far_above - q_below) / 2
    return torch.lerp(below, above, t).sum(dim=1), gradient.view(n_rows, n_critics, n_quantiles).transpose(0, 1)


def _huber_pairs(q: torch.Tensor, target: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Quantile Huber loss over all K x K pairs, which a compiler fuses into one pass without storing them."""
    _, n_rows, n_quantiles = q.shape
    n_targets = target.shape[1]
    # Views by strides: the compiler then computes both once, and not once for every pair.
    x = q.contiguous().as_strided(q.shape, (n_rows * n_quantiles, n_quantiles, 1)).unsqueeze(-1)
    y = target.contiguous().as_strided(target.shape, (n_targets, 1))[:, None, :]
    t = ((torch.arange(n_quantiles, device=q.device, dtype=q.dtype) + 0.5) / n_quantiles).unsqueeze(-1)
    difference = x - y
    clipped = difference.clamp(-1, 1)
    weighted = torch.where(difference > 0, 1 - t, t) * clipped
    # u^2 / 2 within the threshold and |u| - 1/2 beyond it are both c (u - c / 2), c being u clipped.
    return (weighted * (difference - 0.5 * clipped)).sum(dim=-1).sum(dim=(0, 2)), weighted.sum(dim=-1)


def quantile_huber(q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """
    Quantile Huber loss, threshold 1: sum over the predicted quantiles, mean over the target quantiles and
    the batch, summed over the critics (BRO, algorithm 2, line 8; Dabney et al. 2018, eq. 10). The midpoint
    of predicted quantile i is ``(i + 1/2) / K``. Exact: value and gradient are those of the K x K pairs.

    :param q: predicted quantiles, (E, B, K)
    :param target: target quantiles in any order, (B, K'), without gradient
    :return: scalar
    """
    if isinstance(q, QValues):
        q = q.tensor  # An autograd Function would not treat it as a tensor: no gradient.
    compute = _huber_pairs if is_tracing() else _huber_sorted
    loss: torch.Tensor = _KnownGradient.apply(q, target, compute, 1)[0]
    return loss.squeeze(0)


def actor_loss(log_prob: torch.Tensor, value: torch.Tensor, alpha: torch.Tensor | float) -> torch.Tensor:
    """
    Loss of the actor, ``mean(alpha * log pi(a|s) - Q(s, a))`` (BRO, algorithm 2, line 10).

    :param log_prob: log-probability of the sampled actions, (B, 1)
    :param value: the ensemble's value of them, (B, K); averaged over quantiles here
    :param alpha: temperature
    :return: scalar
    """
    return (alpha * log_prob).mean() - value.mean()


def temperature_loss(alpha: torch.Tensor, entropy: torch.Tensor, target_entropy: float | torch.Tensor) -> torch.Tensor:
    """
    Loss of the temperature, ``alpha * (H - H*)`` (BRO, algorithm 2, line 13). The gradient goes through ``alpha``
    itself, not its logarithm as in stable_baselines3.

    :param alpha: temperature, with gradient, scalar; (B, 1) where tasks have their own
    :param entropy: mean of ``-log pi`` over the batch, scalar; ``-log pi`` itself, (B, 1), with temperatures by task
    :param target_entropy: H*, a number, or (B, 1)
    :return: scalar, or (B, 1), whose mean over the batch is the loss
    """
    return alpha * (entropy.detach() - target_entropy)


def expectile_loss(difference: torch.Tensor, expectile: float) -> torch.Tensor:
    """
    Squared error whose minimum is an expectile, ``mean(|tau - 1(u < 0)| u^2)`` (Kostrikov et al. 2021, eq. 5); half the
    squared error at 0.5.

    :param difference: u, target minus prediction, any shape
    :param expectile: tau, in (0, 1)
    :return: scalar
    """
    weight = torch.where(difference > 0, expectile, 1 - expectile)
    return (weight * difference.square()).mean()


def advantage_weights(advantage: torch.Tensor, inverse_temperature: float, most: float) -> torch.Tensor:
    """
    Compute the weights of actions in a regression on them, ``min(exp(beta * A), most)`` (Kostrikov et al. 2021, eq. 7).

    :param advantage: A, any shape
    :param inverse_temperature: beta
    :param most: the largest weight
    :return: of the same shape
    """
    return (inverse_temperature * advantage).exp().clamp(max=most)


def cloned_value_loss(value: torch.Tensor, actions: torch.Tensor, cloned: torch.Tensor, weight: float) -> torch.Tensor:
    """
    Loss of an actor that stays near given actions, ``mean((a - a*)^2) - lambda * mean(Q)`` with ``lambda = weight /
    mean(|Q|)`` without gradient (Fujimoto and Gu 2021, eqs. 3 and 5).

    :param value: Q, value of the actor's actions, (B,)
    :param actions: a, the actor's actions, (B, A)
    :param cloned: a*, the actions to stay near, (B, A)
    :param weight: weight of the value
    :return: scalar
    """
    scale = weight / value.detach().abs().mean()
    return F.mse_loss(actions, cloned) - scale * value.mean()


def optimistic_actor_loss(upper_value: torch.Tensor, kl: torch.Tensor, kl_weight: torch.Tensor) -> torch.Tensor:
    """
    Loss of the optimistic actor, ``-mean(Q_upper) + weight * mean(KL)`` (BRO, algorithm 2, line 12; DAC, eq. 11).

    :param upper_value: optimistic value of the sampled actions, (B, K)
    :param kl: divergence of the two policies, summed over the action's dimensions, (B, 1)
    :param kl_weight: weight of the divergence, scalar
    :return: scalar
    """
    return kl_weight.detach() * kl.mean() - upper_value.mean()


def optimism_loss(optimism: torch.Tensor, reference: torch.Tensor | float, kl_gap: torch.Tensor) -> torch.Tensor:
    """
    Loss of the optimism, ``(beta_o - reference) * (KL / |A| - KL*)`` (BRO, algorithm 2, line 14; DAC, eq. 14).

    The reference shifts the loss, not its gradient. In the papers it is beta_p, which is minus our pessimism; in BRO's
    published code it is plus the pessimism.

    :param optimism: beta_o, with gradient, scalar
    :param reference: what optimism is measured from
    :param kl_gap: ``KL / |A| - KL*``, scalar, without gradient
    :return: scalar
    """
    return (optimism - reference) * kl_gap


def kl_weight_loss(kl_weight: torch.Tensor, kl_gap: torch.Tensor) -> torch.Tensor:
    """
    Loss of the divergence's weight, ``-weight * (KL / |A| - KL*)`` (BRO, algorithm 2, line 15; DAC, eq. 14).

    :param kl_weight: tau, with gradient, scalar
    :param kl_gap: ``KL / |A| - KL*``, scalar, without gradient
    :return: scalar
    """
    return -kl_weight * kl_gap


def gaussian_kl(
    mean: torch.Tensor, std: torch.Tensor, reference_mean: torch.Tensor, reference_std: torch.Tensor
) -> torch.Tensor:
    """
    KL divergence from a diagonal Gaussian to a reference one, summed over the dimensions.

    :param mean: (B, A)
    :param std: (B, A)
    :param reference_mean: (B, A)
    :param reference_std: (B, A)
    :return: (B, 1)
    """
    kl = torch.log(reference_std / std) + (std.square() + (mean - reference_mean).square()) / (
        2 * reference_std.square()
    )
    return (kl - 0.5).sum(dim=1, keepdim=True)


def tanh_gaussian_log_prob(x: torch.Tensor, noise: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """
    Log-probability of the action ``tanh(x)``, ``x = mean + exp(log_std) * noise``.

    It is computed from x and the noise that made it, never from the action: ``atanh`` of an action that
    rounds to 1 is infinite, and ``(x - mean) / std`` loses the noise where the std is tiny.

    :param x: pre-tanh sample, (B, A)
    :param noise: standard normal noise, (B, A)
    :param log_std: (B, A)
    :return: (B, 1)
    """
    gaussian = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    log_det = 2 * (math.log(2) - x - F.softplus(-2 * x))
    return (gaussian - log_det).sum(dim=1, keepdim=True)
