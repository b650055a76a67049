"""Layers with spectral norm: the singular value, its gradient, its buffers, each copy for itself."""

import copy

import pytest
import torch
from torch import nn
from torch.nn.utils import parametrizations

from sb3_sample.networks import (
    MLP,
    SpectralEnsembleLinear,
    SpectralLinear,
    SpectralNet,
    init_orthogonal,
    linear,
)
from tests.networks.common import randomize, take_copy

E, B = 2, 5


@pytest.mark.parametrize("n_copies", [None, E])
@pytest.mark.parametrize(("n_in", "n_out"), [(6, 9), (9, 6)])
def test_every_kernel_has_norm_one(n_copies: int | None, n_in: int, n_out: int) -> None:
    torch.manual_seed(0)
    layer = linear(n_in, n_out, n_copies, spectral_norm=True)
    assert layer.weight.shape == ((n_out, n_in) if n_copies is None else (E, n_in, n_out))
    randomize(layer)
    if n_copies is not None:
        with torch.no_grad():
            layer.weight[1] *= 100
    x = torch.randn(B, n_in)
    for _ in range(300):
        y = layer(x)
    weights = [layer.weight.T] if n_copies is None else list(layer.weight)
    biases = [layer.bias] if n_copies is None else list(layer.bias)
    expected = [x @ (w / torch.linalg.svdvals(w)[0]) + b for w, b in zip(weights, biases, strict=True)]
    torch.testing.assert_close(y, expected[0] if n_copies is None else torch.stack(expected), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("n_copies", [None, E])
@pytest.mark.parametrize(("n_in", "n_out"), [(6, 9), (9, 6), (6, 6)])
def test_starts_at_the_right_value(n_copies: int | None, n_in: int, n_out: int) -> None:
    """In evaluation mode, which makes no iteration, at construction and after another initialisation."""
    layer = linear(n_in, n_out, n_copies, spectral_norm=True).eval()
    for gain in (None, 7.0):
        if gain is not None:
            init_orthogonal(layer, gain)
        basis = torch.eye(n_in) if n_copies is None else torch.eye(n_in).expand(E, -1, -1)
        kernels = layer(basis)
        for kernel in [kernels] if n_copies is None else kernels:
            torch.testing.assert_close(torch.linalg.svdvals(kernel)[0], torch.ones(()), rtol=1e-5, atol=1e-5)


def test_one_iteration_a_forward_pass_in_training_mode_only() -> None:
    torch.manual_seed(0)
    layer = SpectralLinear(6, 9)
    u, weight = layer.u.clone(), layer.weight.detach()
    layer.eval()(torch.randn(B, 6))
    assert torch.equal(layer.u, u)
    layer.train()(torch.randn(B, 6))
    v = nn.functional.normalize(weight.T @ u, dim=0)
    torch.testing.assert_close(layer.v, v)
    torch.testing.assert_close(layer.u, nn.functional.normalize(weight @ v, dim=0))


def test_against_torchs_own() -> None:
    """Outputs and gradients, the layer evaluated twice before the backward pass."""
    torch.manual_seed(0)
    ours, plain = SpectralLinear(6, 9), nn.Linear(6, 9)
    randomize(ours)
    plain.load_state_dict({"weight": ours.weight, "bias": ours.bias})
    theirs = parametrizations.spectral_norm(plain, n_power_iterations=1)
    # torch updates u and v in the other order, which makes no difference once they have converged.
    ours.find_direction(500)
    for name in ("u", "v"):
        getattr(theirs.parametrizations.weight[0], f"_{name}").copy_(getattr(ours, name))
    x1, x2 = torch.randn(B, 6), torch.randn(B, 6)
    y, expected = ((layer(x1), layer(x2)) for layer in (ours, theirs))
    torch.testing.assert_close(y, expected, rtol=1e-4, atol=1e-5)
    for first, second in (y, expected):
        (first.square().sum() + second.sin().sum()).backward()
    raw = theirs.parametrizations.weight.original
    torch.testing.assert_close(ours.weight.grad, raw.grad, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours.bias.grad, theirs.bias.grad, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("n_copies", [None, E])
def test_gradient_by_hand(n_copies: int | None) -> None:
    """For the loss <G, W / sigma> with sigma = u'Wv: (G - <G, W / sigma> u v') / sigma."""
    torch.manual_seed(0)
    layer = linear(4, 3, n_copies, spectral_norm=True)
    randomize(layer)
    layer.find_direction(2)  # far from converged: u and v are constants nevertheless
    layer.eval()
    normalized = layer.normalized_weight()
    grad = torch.randn_like(normalized)
    (grad * normalized).sum().backward()
    assert layer.weight.grad is not None
    for e in range(n_copies or 1):
        w, g, got, u, v = (
            t if n_copies is None else t[e] for t in (layer.weight.detach(), grad, layer.weight.grad, layer.u, layer.v)
        )
        sigma = u @ w @ v
        expected = (g - (g * w / sigma).sum() * torch.outer(u, v)) / sigma
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)


def test_two_passes_before_one_gradient() -> None:
    """The second pass moves u and v; the gradient of the first is with respect to those it used."""
    torch.manual_seed(0)
    layer = SpectralEnsembleLinear(E, 4, 3)
    randomize(layer)
    alone = copy.deepcopy(layer)
    x = torch.randn(B, 4)
    first = layer(x)
    layer(x)
    first.square().sum().backward()
    alone(x).square().sum().backward()
    assert layer.weight.grad is not None and alone.weight.grad is not None
    assert not torch.equal(layer.u, alone.u)
    assert torch.equal(layer.weight.grad, alone.weight.grad)


@pytest.mark.parametrize(
    "make",
    [
        lambda n: MLP(3, (8, 6), layer_norm=True, n_copies=n, spectral_norm=True),
        lambda n: SpectralNet(3, 8, 2, n_copies=n),
    ],
)
def test_copies_against_separate_networks(make) -> None:  # type: ignore[no-untyped-def]
    """Outputs, gradients and buffers over several passes in training mode."""
    torch.manual_seed(0)
    stack, singles = make(E), [make(None) for _ in range(E)]
    randomize(stack)
    for e, single in enumerate(singles):
        take_copy(single, stack, e)
    x = torch.randn(B, 3)
    # SpectralLinear iterates on the transposed kernel: v and u change their places, so let both converge.
    for net in (stack, *singles):
        for layer in net.modules():
            if isinstance(layer, (SpectralLinear, SpectralEnsembleLinear)):
                layer.find_direction(500)
    for _ in range(3):
        y = stack(x)
        expected = torch.stack([single(x) for single in singles])
        torch.testing.assert_close(y, expected, rtol=1e-3, atol=1e-4)
    stack.zero_grad()
    y.square().sum().backward()
    expected.square().sum().backward()
    for e, single in enumerate(singles):
        grads = copy.deepcopy(single)
        for p in grads.parameters():
            p.data.zero_()
        source = copy.deepcopy(stack)
        for p, q in zip(source.parameters(), stack.parameters(), strict=True):
            assert q.grad is not None
            p.data.copy_(q.grad)
        take_copy(grads, source, e)
        for p, q in zip(grads.parameters(), single.parameters(), strict=True):
            assert q.grad is not None and q.grad.any()
            torch.testing.assert_close(p.data, q.grad, rtol=1e-3, atol=1e-3)


def test_spectral_norm_is_on_the_last_hidden_layer_only() -> None:
    assert [isinstance(m, SpectralLinear) for m in MLP(3, (8, 7, 6), spectral_norm=True).layers[::2]] == [
        False, False, True,
    ]  # fmt: skip
    assert [isinstance(m, SpectralEnsembleLinear) for m in MLP(3, (8, 7), n_copies=E, spectral_norm=True).layers] == [
        False, False, True, False,
    ]  # fmt: skip
    assert not any(isinstance(m, SpectralLinear) for m in MLP(3, (8, 7)).modules())


def test_spectral_norm_adds_no_parameter() -> None:
    shapes = [{name: p.shape for name, p in MLP(3, (8, 7), spectral_norm=sn).named_parameters()} for sn in (0, 1)]
    assert shapes[0] == shapes[1]


def test_state_dict_brings_the_buffers() -> None:
    torch.manual_seed(0)
    ours, theirs = (MLP(3, (8, 7), n_copies=E, spectral_norm=True) for _ in range(2))
    randomize(theirs)
    theirs(torch.randn(B, 3))
    ours.load_state_dict(theirs.state_dict())
    x = torch.randn(B, 3)
    assert torch.equal(ours.eval()(x), theirs.eval()(x))
    assert torch.equal(ours.layers[2].u, theirs.layers[2].u)


def test_acting_in_inference_mode_then_learning() -> None:
    layer = SpectralLinear(4, 3)
    u = layer.u.clone()
    with torch.inference_mode():
        layer.eval()(torch.randn(B, 4))
    assert torch.equal(layer.u, u)
    layer.train()(torch.randn(B, 4)).sum().backward()
    assert layer.weight.grad is not None and layer.weight.grad.isfinite().all()


@pytest.mark.parametrize("n_copies", [None, E])
def test_kernel_of_zeros(n_copies: int | None) -> None:
    """It gives zeros, not NaN, and the directions find their way when weights come back."""
    torch.manual_seed(0)
    layer = linear(4, 3, n_copies, spectral_norm=True)
    with torch.no_grad():
        layer.weight.zero_()
    y = layer(torch.randn(B, 4))
    assert not y.any()
    y.sum().backward()
    assert layer.weight.grad is not None and layer.weight.grad.isfinite().all()
    init_orthogonal(layer)
    weight = layer.normalized_weight()
    norms = torch.linalg.svdvals(weight)
    torch.testing.assert_close(norms, torch.ones_like(norms), rtol=1e-4, atol=1e-5)
