"""Networks with a copies axis against separate plain networks, their initialisation, and their sizes."""

import math
from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch import nn

from sb3_sample import BRO
from sb3_sample.learner.exploration import OptimisticShift
from sb3_sample.networks import MLP, BroNet, EnsembleLayerNorm, EnsembleLinear, init_orthogonal, linear
from tests.networks.common import randomize
from tests.sac.common import Toy

E, B = 2, 5


def copy_linear(stack: EnsembleLinear, e: int) -> nn.Linear:
    single = nn.Linear(stack.in_features, stack.out_features, bias=stack.bias is not None)
    with torch.no_grad():
        single.weight.copy_(stack.weight[e].t())
        if stack.bias is not None:
            single.bias.copy_(stack.bias[e, 0])
    return single


def copy_norm(stack: EnsembleLayerNorm, e: int) -> nn.LayerNorm:
    single = nn.LayerNorm(stack.n_features, eps=stack.eps)
    with torch.no_grad():
        single.weight.copy_(stack.weight[e, 0])
        single.bias.copy_(stack.bias[e, 0])
    return single


def copy_layer(layer: nn.Module, e: int) -> nn.Module:
    if isinstance(layer, EnsembleLinear):
        return copy_linear(layer, e)
    return copy_norm(layer, e) if isinstance(layer, EnsembleLayerNorm) else type(layer)()


class PlainBroNet(nn.Module):
    """BroNet written out, from one copy of a stack."""

    def __init__(self, stack: BroNet, e: int):
        super().__init__()
        self.dense, self.norm = copy_linear(stack.dense, e), copy_norm(stack.norm, e)
        self.blocks = nn.ModuleList(
            nn.ModuleList([copy_layer(getattr(b, n), e) for n in ("dense1", "norm1", "dense2", "norm2")])
            for b in stack.blocks
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        h = F.relu(self.norm(self.dense(x)))
        for dense1, norm1, dense2, norm2 in self.blocks:
            h = h + norm2(dense2(F.relu(norm1(dense1(h)))))
        return h


def check_against_singles(stack: nn.Module, singles: list[nn.Module], x: torch.Tensor) -> None:
    """Outputs, gradients of every parameter, and the gradient of the input."""
    x = x.clone().requires_grad_()
    y = stack(x)
    inputs = [x.detach().clone() if x.dim() == 2 else x[e].detach().clone() for e in range(E)]
    outputs = [single(i.requires_grad_()) for single, i in zip(singles, inputs, strict=True)]
    torch.testing.assert_close(y, torch.stack(outputs), rtol=1e-5, atol=1e-5)
    weight = torch.randn_like(y)
    (y * weight).sum().backward()
    for e in range(E):
        (outputs[e] * weight[e]).sum().backward()
    grads = [i.grad for i in inputs]
    expected = grads[0] + grads[1] if x.dim() == 2 else torch.stack(grads)  # type: ignore[operator, arg-type]
    torch.testing.assert_close(x.grad, expected, rtol=1e-4, atol=1e-4)
    stacked = [m for m in stack.modules() if isinstance(m, (EnsembleLinear, EnsembleLayerNorm))]
    for e in range(E):
        plain = [m for m in singles[e].modules() if isinstance(m, (nn.Linear, nn.LayerNorm))]
        assert len(plain) == len(stacked)
        for ours, theirs in zip(stacked, plain, strict=True):
            assert ours.weight.grad is not None and theirs.weight.grad is not None
            if isinstance(ours, EnsembleLinear):
                torch.testing.assert_close(ours.weight.grad[e], theirs.weight.grad.t(), rtol=1e-4, atol=1e-4)
            else:
                torch.testing.assert_close(ours.weight.grad[e, 0], theirs.weight.grad, rtol=1e-4, atol=1e-4)
            if ours.bias is not None:
                assert ours.bias.grad is not None
                torch.testing.assert_close(ours.bias.grad[e, 0], theirs.bias.grad, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("shape", [(B, 3), (E, B, 3)])
@pytest.mark.parametrize("bias", [True, False])
def test_ensemble_linear(shape: tuple[int, ...], bias: bool) -> None:
    torch.manual_seed(0)
    stack = EnsembleLinear(E, 3, 4, bias=bias)
    randomize(stack)
    check_against_singles(stack, [copy_linear(stack, e) for e in range(E)], torch.randn(shape))


def test_ensemble_linear_with_as_many_copies_as_samples() -> None:
    """(B, in) is shared by the copies also where B = E."""
    stack = EnsembleLinear(E, 3, 4)
    randomize(stack)
    check_against_singles(stack, [copy_linear(stack, e) for e in range(E)], torch.randn(E, 3))


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_ensemble_layer_norm(scale: float) -> None:
    torch.manual_seed(0)
    stack = EnsembleLayerNorm(E, 6, eps=1e-6)
    randomize(stack)
    # At the small scale the variance meets eps; the input's gradient is then as much larger.
    x = torch.randn(E, B, 6) * scale
    y = torch.stack([copy_norm(stack, e)(x[e]) for e in range(E)])
    torch.testing.assert_close(stack(x), y, rtol=1e-5, atol=1e-5)
    if scale == 1:
        check_against_singles(stack, [copy_norm(stack, e) for e in range(E)], x)


@pytest.mark.parametrize("shape", [(B, 3), (E, B, 3)])
@pytest.mark.parametrize("n_blocks", [0, 1, 3])
def test_bronet(n_blocks: int, shape: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    stack = BroNet(3, width=8, n_blocks=n_blocks, n_copies=E)
    randomize(stack)
    assert stack.out_features == 8
    check_against_singles(stack, [PlainBroNet(stack, e) for e in range(E)], torch.randn(shape))


def test_bronet_has_layer_norms_epsilon() -> None:
    assert {m.eps for m in BroNet(3, 8, 2, E).modules() if isinstance(m, EnsembleLayerNorm)} == {1e-6}
    assert {m.eps for m in BroNet(3, 8, 2).modules() if isinstance(m, nn.LayerNorm)} == {1e-6}


@pytest.mark.parametrize("layer_norm", [True, False])
@pytest.mark.parametrize("activation_fn", [nn.ReLU, nn.Tanh])
def test_mlp(layer_norm: bool, activation_fn: type[nn.Module]) -> None:
    torch.manual_seed(0)
    stack = MLP(3, (8, 6), activation_fn, layer_norm, n_copies=E)
    randomize(stack)
    singles: list[nn.Module] = [nn.Sequential(*(copy_layer(layer, e) for layer in stack.layers)) for e in range(E)]
    assert stack.out_features == 6
    check_against_singles(stack, singles, torch.randn(B, 3))


@pytest.mark.parametrize("make", [lambda n: MLP(3, (8, 6), layer_norm=True, n_copies=n), lambda n: BroNet(3, 8, 1, n)])
def test_one_network_is_a_stack_of_one(make: Callable[[int | None], nn.Module]) -> None:
    torch.manual_seed(0)
    stack, single = make(1), make(None)
    randomize(stack)
    ours = [m for m in single.modules() if isinstance(m, (nn.Linear, nn.LayerNorm))]
    theirs = [m for m in stack.modules() if isinstance(m, (EnsembleLinear, EnsembleLayerNorm))]
    with torch.no_grad():
        for plain, stacked in zip(ours, theirs, strict=True):
            plain.load_state_dict(copy_layer(stacked, 0).state_dict())
    x = torch.randn(B, 3)
    torch.testing.assert_close(single(x), stack(x)[0], rtol=1e-5, atol=1e-5)


def test_copies_are_independent() -> None:
    """A copy's output has no gradient with respect to another's parameters."""
    stack = BroNet(3, 8, 1, E)
    randomize(stack)
    stack(torch.randn(B, 3))[0].sum().backward()
    for p in stack.parameters():
        assert p.grad is not None and not p.grad[1].any()
        assert p.grad[0].any()


@pytest.mark.parametrize("gain", [math.sqrt(2), 1.0, 0.01])
@pytest.mark.parametrize(("n_in", "n_out"), [(4, 9), (9, 4), (6, 6)])
@pytest.mark.parametrize("n_copies", [None, 1, 3])
def test_orthogonal_kernels(n_copies: int | None, n_in: int, n_out: int, gain: float) -> None:
    layer = linear(n_in, n_out, n_copies, gain=gain)
    kernels = [layer.weight.t()] if n_copies is None else list(layer.weight)
    for kernel in kernels:
        assert kernel.shape == (n_in, n_out)
        gram = kernel.t() @ kernel if n_in >= n_out else kernel @ kernel.t()
        torch.testing.assert_close(gram, torch.eye(min(n_in, n_out)) * gain**2, rtol=1e-4, atol=1e-5 * gain)
    assert layer.bias is not None and not layer.bias.any()
    if n_copies is not None and n_copies > 1:
        assert not torch.allclose(kernels[0], kernels[1])


def test_default_gain_is_root_two() -> None:
    layer = EnsembleLinear(2, 5, 5, bias=False)
    assert not layer.weight.any()
    init_orthogonal(layer)
    for kernel in layer.weight:
        torch.testing.assert_close(kernel @ kernel.t(), 2 * torch.eye(5), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("stack", [BroNet(5, 8, 2, 3), MLP(5, (8, 7), n_copies=3), BroNet(5, 8, 2), MLP(5, (8, 7))])
def test_trunks_are_orthogonal_with_root_two(stack: nn.Module) -> None:
    layers = [m for m in stack.modules() if isinstance(m, (nn.Linear, EnsembleLinear))]
    assert layers
    for layer in layers:
        for kernel in layer.weight if layer.weight.dim() == 3 else [layer.weight]:
            norms = torch.linalg.svdvals(kernel)
            torch.testing.assert_close(norms, torch.full_like(norms, math.sqrt(2)), rtol=1e-4, atol=1e-5)
        assert layer.bias is not None and not layer.bias.any()


def test_gains_of_a_model() -> None:
    """Root two everywhere but for the actor's log standard deviation (1) and the optimistic shift (0.01, no bias)."""
    model = BRO("MlpPolicy", Toy(), model_size=(1, 16), buffer_size=1, device="cpu")
    assert isinstance(model.explorer, OptimisticShift)
    gains = {
        "mean": (model.actor.mean.weight, math.sqrt(2)),
        "log_std": (model.actor.log_std.weight, 1.0),
        "shift": (model.explorer.shift.weight, 0.01),
        "head of critic 0": (model.critic.head.weight[0], math.sqrt(2)),
        "head of critic 1": (model.critic.head.weight[1], math.sqrt(2)),
    }
    for name, (kernel, gain) in gains.items():
        norms = torch.linalg.svdvals(kernel)
        torch.testing.assert_close(norms, torch.full_like(norms, gain), rtol=1e-4, atol=1e-6, msg=name)
    assert model.explorer.shift.bias is None


@pytest.mark.parametrize(
    "make",
    [
        lambda: BroNet(3, width=0),
        lambda: BroNet(3, n_blocks=-1),
        lambda: MLP(3, (8, 0)),
    ],
)
def test_bad_sizes(make: Callable[[], nn.Module]) -> None:
    with pytest.raises(ValueError, match=r"width|n_blocks|hidden_sizes"):
        make()


# BRO, table 7, in parameters of all networks. An observation of 67 and an action of 24 are humanoid-run's in size.
@pytest.mark.parametrize(
    ("size", "millions", "tolerance"),
    [
        ("0.55M", 0.55, 0.02),
        ("1.05M", 1.05, 0.02),
        ("2.83M", 2.83, 0.02),
        ("4.92M", 4.92, 0.02),
        ("26.31M", 26.31, 0.02),
    ],
)
def test_number_of_parameters(size: str, millions: float, tolerance: float) -> None:
    env = Toy(spaces.Box(-1, 1, (67,)), spaces.Box(-1, 1, (24,)))
    model = BRO("MlpPolicy", env, model_size=size, buffer_size=1, device="cpu")
    modules = (model.actor, model.critic, model.critic_target, model.explorer)
    n = sum(p.numel() for module in modules for p in module.parameters()) / 1e6
    critics = sum(p.numel() for m in (model.critic, model.critic_target) for p in m.parameters()) / 1e6
    print(f"{size}: {n:.2f}M parameters, of which critics and targets {critics:.2f}M")
    assert abs(n / millions - 1) < tolerance, f"{n:.2f}M parameters in all, critics and targets {critics:.2f}M"
