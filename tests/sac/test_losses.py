"""The losses against arithmetic by hand, plain loops in float64, and ``torch.distributions``."""

import math

import pytest
import torch
from torch.distributions import Independent, Normal, TransformedDistribution, kl_divergence
from torch.distributions.transforms import TanhTransform

from sb3_sample.learner import losses

T = torch.tensor


def reference_quantile_huber(q: torch.Tensor, target: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The pairs' definition in float64: (loss, gradient)."""
    x = q.detach().double().requires_grad_()
    n_critics, batch, k = x.shape
    total = torch.zeros((), dtype=torch.float64)
    tau = (torch.arange(k, dtype=torch.float64) + 0.5) / k
    for e in range(n_critics):
        for b in range(batch):
            u = target[b].double()[None, :] - x[e, b][:, None]
            huber = torch.where(u.abs() <= 1, u.square() / 2, u.abs() - 0.5)
            weight = (tau[:, None] - (u.detach() < 0).double()).abs()
            total = total + (weight * huber).sum() / target.shape[1] / batch
    (grad,) = torch.autograd.grad(total, x)
    return total.detach(), grad


def check_quantile_huber(q: torch.Tensor, target: torch.Tensor, tolerance: float = 1e-5) -> None:
    expected, expected_grad = reference_quantile_huber(q, target)
    q = q.clone().requires_grad_()
    loss = losses.quantile_huber(q, target)
    assert loss.shape == () and loss.dtype == q.dtype
    (grad,) = torch.autograd.grad(loss, q)
    torch.testing.assert_close(loss.double(), expected, rtol=tolerance, atol=tolerance * 1e-3)
    # A gradient is at most 1 / B an entry.
    torch.testing.assert_close(grad.double(), expected_grad, rtol=tolerance, atol=tolerance / q.shape[1])


# ---------------------------------------------------------------- by hand


def test_td_target_by_hand() -> None:
    rewards, dones = T([[1.0], [2.0]]), T([[0.0], [1.0]])
    next_values, bonus = T([[4.0, 6.0], [100.0, 100.0]]), T([[-0.5], [7.0]])
    # Row 0: 1 + 0.5 * (4 - 0.5) = 2.75, 1 + 0.5 * (6 - 0.5) = 3.75. Row 1 terminated: the reward alone.
    expected = T([[2.75, 3.75], [2.0, 2.0]])
    torch.testing.assert_close(losses.td_target(rewards, dones, 0.5, next_values, bonus), expected)


def test_td_target_discount_per_transition_and_no_entropy() -> None:
    discounts = T([[0.5], [0.25]])
    target = losses.td_target(T([[0.0], [1.0]]), torch.zeros(2, 1), discounts, T([[2.0], [8.0]]), 0.0)
    # 0 + 0.5 * 2 = 1, 1 + 0.25 * 8 = 3.
    torch.testing.assert_close(target, T([[1.0], [3.0]]))


def test_squared_error_by_hand() -> None:
    q = T([[[1.0], [2.0]], [[0.0], [5.0]]])
    # Critic 0: ((1 - 3)^2 + (2 - 4)^2) / 2 = 4; critic 1: ((0 - 3)^2 + (5 - 4)^2) / 2 = 5; 9 in all, no factor 1/2.
    assert losses.squared_error(q, T([[3.0], [4.0]])).item() == pytest.approx(9.0)


def test_quantile_huber_by_hand() -> None:
    # K = 2, midpoints 0.25 and 0.75; targets 0.5 and 3.
    # q_0 = 0: u = 0.5, huber 0.125, and u = 3, huber 2.5; both above: 0.25 * (0.125 + 2.5) = 0.65625
    # q_1 = 1: u = -0.5, huber 0.125, weight 1 - 0.75 = 0.25: 0.03125; u = 2, huber 1.5, weight 0.75: 1.125
    # Sum over predictions 1.8125, mean over two targets 0.90625.
    q = T([[[0.0, 1.0]]], requires_grad=True)
    loss = losses.quantile_huber(q, T([[0.5, 3.0]]))
    assert loss.item() == pytest.approx(0.90625)
    loss.backward()
    # d/dq_0 = -0.25 * (0.5 + 1) / 2 = -0.1875; d/dq_1 = (0.25 * 0.5 - 0.75 * 1) / 2 = -0.3125
    torch.testing.assert_close(q.grad, T([[[-0.1875, -0.3125]]]))


def test_quantile_huber_counts_critics_and_averages_batch() -> None:
    q, target = torch.randn(1, 3, 4), torch.randn(3, 5)
    one = losses.quantile_huber(q, target)
    torch.testing.assert_close(losses.quantile_huber(q.repeat(2, 1, 1), target), 2 * one)
    torch.testing.assert_close(losses.quantile_huber(q.repeat(1, 2, 1), target.repeat(2, 1)), one)


def test_actor_loss_by_hand() -> None:
    # mean(0.5 * (-1), 0.5 * 3) = 0.5, mean of Q over batch and quantiles = 2.5: -2.
    assert losses.actor_loss(T([[-1.0], [3.0]]), T([[1.0, 2.0], [3.0, 4.0]]), 0.5).item() == pytest.approx(-2.0)


@pytest.mark.parametrize(("entropy", "sign"), [(-3.0, -1), (2.0, 1)])
def test_temperature_rises_below_the_target_entropy(entropy: float, sign: int) -> None:
    alpha = T(0.5, requires_grad=True)
    loss = losses.temperature_loss(alpha, T(entropy), -1.0)
    # 0.5 * (-3 + 1) = -1, gradient -2: alpha rises. 0.5 * (2 + 1) = 1.5, gradient 3: alpha falls.
    assert loss.item() == pytest.approx(0.5 * (entropy + 1))
    loss.backward()
    assert alpha.grad is not None and alpha.grad.item() == pytest.approx(entropy + 1)
    assert math.copysign(1, alpha.grad.item()) == sign


def test_temperature_loss_does_not_reach_the_entropy() -> None:
    entropy = T(1.0, requires_grad=True)
    losses.temperature_loss(T(1.0, requires_grad=True), entropy, 0.0).backward()
    assert entropy.grad is None


def test_optimistic_actor_loss_by_hand() -> None:
    # 2 * mean(1, 3) - mean(1, 2, 3, 6) = 4 - 3 = 1; the weight is no business of this loss's gradient.
    weight = T(2.0, requires_grad=True)
    kl = T([[1.0], [3.0]], requires_grad=True)
    loss = losses.optimistic_actor_loss(T([[1.0, 2.0], [3.0, 6.0]]), kl, weight)
    assert loss.item() == pytest.approx(1.0)
    loss.backward()
    assert weight.grad is None
    torch.testing.assert_close(kl.grad, T([[1.0], [1.0]]))


@pytest.mark.parametrize("gap", [-0.04, 0.2])
def test_adjustment_losses_by_hand(gap: float) -> None:
    optimism, weight = T(1.5, requires_grad=True), T(0.25, requires_grad=True)
    optimism_loss, weight_loss = (
        losses.optimism_loss(optimism, 0.5, T(gap)),
        losses.kl_weight_loss(weight, T(gap)),
    )
    # (1.5 - 0.5) * gap and -0.25 * gap; too far apart: less optimism, more weight.
    assert optimism_loss.item() == pytest.approx(gap)
    assert weight_loss.item() == pytest.approx(-0.25 * gap)
    (optimism_loss + weight_loss).backward()
    assert optimism.grad is not None and optimism.grad.item() == pytest.approx(gap)
    assert weight.grad is not None and weight.grad.item() == pytest.approx(-gap)


def test_gaussian_kl_by_hand() -> None:
    # Dimension 0: N(1, 1) to N(0, 1): 1/2. Dimension 1: N(0, 1) to N(0, 2): log 2 + 1/8 - 1/2.
    kl = losses.gaussian_kl(T([[1.0, 0.0]]), T([[1.0, 1.0]]), T([[0.0, 0.0]]), T([[1.0, 2.0]]))
    torch.testing.assert_close(kl, T([[0.5 + math.log(2) + 0.125 - 0.5]]))


def test_tanh_gaussian_log_prob_by_hand() -> None:
    # x = 0 from noise 0 with std 1: log N(0) = -log(2 pi) / 2 and tanh'(0) = 1; with std e: one less.
    x = noise = torch.zeros(1, 2)
    expected = -math.log(2 * math.pi) - 1
    log_prob = losses.tanh_gaussian_log_prob(x, noise, T([[0.0, 1.0]]))
    torch.testing.assert_close(log_prob, T([[expected]]))


# ---------------------------------------------------------------- properties


@pytest.mark.parametrize("seed", range(12))
def test_quantile_huber_is_the_double_loop(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    n_critics = 1 + seed % 3
    batch, k, k_target = (int(torch.randint(1, 20, (), generator=g)) for _ in range(3))
    scale = [0.3, 1.0, 5.0, 40.0][seed % 4]
    q = torch.randn(n_critics, batch, k, generator=g) * scale
    check_quantile_huber(q, torch.randn(batch, k_target, generator=g) * scale)


@pytest.mark.parametrize(("k", "k_target"), [(1, 1), (1, 7), (7, 1), (5, 100), (100, 100)])
@pytest.mark.parametrize("n_critics", [1, 2, 3])
def test_quantile_huber_sizes(n_critics: int, k: int, k_target: int) -> None:
    g = torch.Generator().manual_seed(k + k_target)
    check_quantile_huber(torch.randn(n_critics, 3, k, generator=g) * 2, torch.randn(3, k_target, generator=g) * 2)


def test_quantile_huber_ties() -> None:
    """Predictions on a grid of quarters meet the targets, each other, and |u| = 1 exactly."""
    g = torch.Generator().manual_seed(0)
    q = torch.randint(-8, 9, (2, 16, 9), generator=g).float() / 4
    target = torch.randint(-8, 9, (16, 11), generator=g).float() / 4
    check_quantile_huber(q, target)
    check_quantile_huber(torch.zeros(2, 3, 4), torch.zeros(3, 4))
    check_quantile_huber(torch.full((2, 3, 4), 1e3), torch.full((3, 4), 1e3))


@pytest.mark.parametrize("u", [1.0, -1.0, 0.0, 1 + 2**-22, 1 - 2**-22])
def test_quantile_huber_at_the_threshold(u: float) -> None:
    check_quantile_huber(torch.zeros(1, 1, 1), torch.full((1, 1), u))
    check_quantile_huber(torch.zeros(2, 4, 3), torch.full((4, 5), u))


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e5])
def test_quantile_huber_scales(scale: float) -> None:
    g = torch.Generator().manual_seed(1)
    q, target = torch.randn(2, 8, 20, generator=g) * scale, torch.randn(8, 20, generator=g) * scale
    # Tiny losses may lose digits that tiny differences of float64 sums do not carry, but never many.
    check_quantile_huber(q, target, 1e-4)


@pytest.mark.parametrize("offset", [1e2, 1e4, 1e6])
def test_quantile_huber_far_from_zero(offset: float) -> None:
    """Values of a large common offset: what counts are their differences."""
    g = torch.Generator().manual_seed(2)
    q, target = torch.randn(2, 8, 20, generator=g) + offset, torch.randn(8, 20, generator=g) + offset
    check_quantile_huber(q, target)


def test_quantile_huber_outlier() -> None:
    """One target far away must not cost the precision of the others."""
    g = torch.Generator().manual_seed(3)
    q, target = torch.randn(2, 8, 20, generator=g), torch.randn(8, 20, generator=g)
    target[:, 0] = 1e6
    check_quantile_huber(q, target)
    q[:, :, 0] = -1e6
    check_quantile_huber(q, target)


def test_quantile_huber_ignores_the_order_of_targets() -> None:
    g = torch.Generator().manual_seed(4)
    q, target = torch.randn(2, 4, 6, generator=g), torch.randn(4, 9, generator=g)
    kept = target.clone()
    shuffled = target[:, torch.randperm(9, generator=g)]
    torch.testing.assert_close(losses.quantile_huber(q, target), losses.quantile_huber(q, shuffled))
    assert torch.equal(target, kept), "the target was changed in place"


def test_quantile_huber_scaled_gradient() -> None:
    """The gradient arriving from above is a factor."""
    q = torch.randn(2, 4, 6, requires_grad=True)
    target = torch.randn(4, 6)
    (one,) = torch.autograd.grad(losses.quantile_huber(q, target), q)
    (three,) = torch.autograd.grad(3 * losses.quantile_huber(q, target), q)
    torch.testing.assert_close(three, 3 * one)


def test_quantile_huber_non_contiguous() -> None:
    q, target = torch.randn(5, 4, 3), torch.randn(7, 4)
    check_quantile_huber(q.transpose(0, 2), target.t())
    check_quantile_huber(torch.randn(1, 4, 3).expand(2, 4, 3), torch.randn(4, 1).expand(4, 6))


@pytest.mark.parametrize("seed", range(4))
def test_gaussian_kl_is_torchs(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    mean, reference_mean = torch.randn(6, 3, generator=g), torch.randn(6, 3, generator=g)
    std, reference_std = (torch.randn(6, 3, generator=g).exp() for _ in range(2))
    expected = kl_divergence(Normal(mean, std), Normal(reference_mean, reference_std)).sum(1, keepdim=True)
    torch.testing.assert_close(losses.gaussian_kl(mean, std, reference_mean, reference_std), expected)


def test_gaussian_kl_of_equal_spreads_is_the_squared_shift() -> None:
    std = T([[0.5, 2.0]])
    kl = losses.gaussian_kl(T([[1.0, 1.0]]), std, T([[0.0, 0.0]]), std)
    # 1 / (2 * 0.25) + 1 / (2 * 4) = 2.125
    torch.testing.assert_close(kl, T([[2.125]]))


@pytest.mark.parametrize("seed", range(4))
def test_tanh_gaussian_log_prob_is_torchs(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    mean, log_std = torch.randn(6, 3, generator=g), torch.randn(6, 3, generator=g) - 1
    noise = torch.randn(6, 3, generator=g)
    x = (mean + log_std.exp() * noise).double()
    # In float64, because torch goes through atanh of the action.
    normal = Normal(mean.double(), log_std.double().exp())
    distribution = TransformedDistribution(Independent(normal, 1), [TanhTransform()])
    expected = distribution.log_prob(torch.tanh(x))[:, None]
    ours = losses.tanh_gaussian_log_prob(x.float(), noise, log_std)
    torch.testing.assert_close(ours.double(), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("x", [-30.0, 30.0, -1e4, 1e4])
@pytest.mark.parametrize("log_std", [-10.0, 2.0])
def test_tanh_gaussian_log_prob_at_extremes(x: float, log_std: float) -> None:
    points, spread = torch.full((1, 1), x, requires_grad=True), torch.full((1, 1), log_std, requires_grad=True)
    log_prob = losses.tanh_gaussian_log_prob(points, torch.ones(1, 1), spread)
    # log(1 - tanh(x)^2) -> 2 (log 2 - |x|)
    expected = -0.5 - log_std - 0.5 * math.log(2 * math.pi) - 2 * (math.log(2) - abs(x))
    assert log_prob.item() == pytest.approx(expected, rel=1e-5)
    log_prob.backward()
    assert points.grad is not None and spread.grad is not None
    # d/dx of -log(1 - tanh(x)^2) = 2 tanh(x)
    assert points.grad.item() == pytest.approx(math.copysign(2, x), rel=1e-5)
    assert spread.grad.item() == pytest.approx(-1)
