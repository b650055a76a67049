"""AdamW against torch's Adam and its definition in float64; sharpness-aware gradients against two by hand."""

import copy
import io
import re
from typing import Any

import pytest
import torch
from torch._inductor.utils import run_and_get_code
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_sample import optim
from sb3_sample.networks import MLP
from sb3_sample.optim import AdamW, sharpness_aware_gradients
from sb3_sample.tracing import compile_graph, trace


def parameters(shapes: list[tuple[int, ...]], seed: int = 0) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(shape, generator=g).requires_grad_() for shape in shapes]


def copies(params: list[torch.Tensor]) -> list[torch.Tensor]:
    return [p.detach().clone().requires_grad_() for p in params]


def gradients(params: list[torch.Tensor], step: int) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(1000 + step)
    return [torch.randn(p.shape, generator=g) * 10 ** (i % 3 - 1) for i, p in enumerate(params)]


def set_gradients(params: list[torch.Tensor], grads: list[torch.Tensor]) -> None:
    for p, g in zip(params, grads, strict=True):
        p.grad = g.clone()


def by_hand(
    p: torch.Tensor,
    grads: list[torch.Tensor],
    lr: float,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-8,
    decay: float = 0.0,
) -> torch.Tensor:
    """``p - lr * (m_hat / (sqrt(v_hat) + eps) + decay * p)``, in float64."""
    p = p.detach().double().clone()
    m, v = torch.zeros_like(p), torch.zeros_like(p)
    for t, g in enumerate(grads, 1):
        g = g.double()
        m = betas[0] * m + (1 - betas[0]) * g
        v = betas[1] * v + (1 - betas[1]) * g * g
        direction = (m / (1 - betas[0] ** t)) / ((v / (1 - betas[1] ** t)).sqrt() + eps)
        p = p - lr * (direction + decay * p)
    return p


SHAPES: list[tuple[int, ...]] = [(), (1,), (7,), (3, 5), (2, 4, 3)]


@pytest.mark.parametrize("betas", [(0.9, 0.999), (0.5, 0.999), (0.0, 0.0)])
@pytest.mark.parametrize("lr", [1e-1, 3e-4, 0.0])
def test_without_decay_it_is_adam(lr: float, betas: tuple[float, float]) -> None:
    ours = parameters(SHAPES)
    theirs = copies(ours)
    a, b = AdamW(ours, lr=lr, betas=betas), torch.optim.Adam(theirs, lr=lr, betas=betas)
    for step in range(20):
        grads = gradients(ours, step)
        set_gradients(ours, grads)
        set_gradients(theirs, grads)
        a.step()
        b.step()
        for p, q in zip(ours, theirs, strict=True):
            torch.testing.assert_close(p, q, rtol=2e-6, atol=2e-6 * max(lr, 1e-6) * (step + 1) + 2e-7)


@pytest.mark.parametrize(("lr", "decay"), [(1e-1, 1e-1), (3e-4, 1e-4), (3e-4, 1e-2), (1e-2, 0.0)])
def test_decay_by_hand(lr: float, decay: float) -> None:
    ours = parameters(SHAPES)
    initial = copies(ours)
    optimizer = AdamW(ours, lr=lr, weight_decay=decay)
    history = []
    for step in range(20):
        history.append(gradients(ours, step))
        set_gradients(ours, history[-1])
        optimizer.step()
    for i, p in enumerate(ours):
        expected = by_hand(initial[i], [grads[i] for grads in history], lr, decay=decay)
        torch.testing.assert_close(p.double(), expected, rtol=5e-6, atol=5e-6)


def effective_decay(optimizer_class: Any, n_steps: int = 400) -> float:
    """Decay measured as a user would see it: how much less the parameters grow than without any decay."""
    lr, decay = 3e-4, 1e-4
    p = [(torch.rand(20_000, generator=torch.Generator().manual_seed(0)) + 0.5).requires_grad_()]
    initial = p[0].detach().double().clone()
    optimizer = optimizer_class(p, lr=lr, weight_decay=decay)
    g = torch.Generator().manual_seed(1)
    history = []
    for _ in range(n_steps):
        # Alternating gradients: the parameters stay where they are, but move by a float32 step each time.
        history.append(torch.randn(20_000, generator=g))
        p[0].grad = history[-1].clone()
        optimizer.step()
    free = by_hand(initial, history, lr)
    lost = (free - p[0].detach().double()).sum() / (free.sum() * n_steps * lr)
    return float(lost)


def test_tiny_decay_is_exact_where_torchs_is_not() -> None:
    """lr * decay = 3e-8 is below float32's spacing at 1: torch's factor decays about twice and more as fast."""
    assert effective_decay(AdamW) == pytest.approx(1e-4, rel=0.1)
    assert effective_decay(torch.optim.AdamW) > 1.5e-4


@pytest.mark.parametrize("decay", [0.0, 1e-2])
def test_tensors_of_several_pieces(decay: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces of any size, and tensors that do and do not fill them, give the step of whole tensors."""
    shapes: list[tuple[int, ...]] = [(5,), (64, 33), (16,), (1, 7), (3, 100)]
    whole = parameters(shapes)
    cut = copies(whole)
    a, b = AdamW(whole, lr=1e-2, weight_decay=decay), AdamW(cut, lr=1e-2, weight_decay=decay)
    initial = copies(whole)
    history = []
    for step in range(5):
        history.append(gradients(whole, step))
        set_gradients(whole, history[-1])
        set_gradients(cut, history[-1])
        a.step()
        with monkeypatch.context() as patch:
            patch.setattr(optim, "CHUNK", 16, raising=False)
            b.step()
    for i, (p, q) in enumerate(zip(whole, cut, strict=True)):
        torch.testing.assert_close(p, q, rtol=1e-6, atol=1e-7)
        expected = by_hand(initial[i], [grads[i] for grads in history], 1e-2, decay=decay)
        torch.testing.assert_close(q.double(), expected, rtol=1e-5, atol=1e-5)


def test_a_really_large_tensor() -> None:
    p = parameters([(3, 2**18 + 17), (2**18,), (10,)])
    initial = copies(p)
    optimizer = AdamW(p, lr=1e-2, weight_decay=1e-2)
    history = []
    for step in range(2):
        history.append(gradients(p, step))
        set_gradients(p, history[-1])
        optimizer.step()
    for i, q in enumerate(p):
        expected = by_hand(initial[i], [grads[i] for grads in history], 1e-2, decay=1e-2)
        torch.testing.assert_close(q.double(), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("decay", [0.0, 1e-2])
@pytest.mark.parametrize("kind", ["transposed", "expanded", "strided"])
def test_non_contiguous_gradients(kind: str, decay: float) -> None:
    """``torch.autograd.grad`` hands out such gradients, for instance that of a plain sum is expanded."""
    p = parameters([(4, 6)])
    initial = copies(p)
    optimizer = AdamW(p, lr=1e-2, weight_decay=decay)
    history = []
    for step in range(3):
        g = torch.Generator().manual_seed(step)
        grad = {
            "transposed": torch.randn(6, 4, generator=g).t(),
            "expanded": torch.randn(1, 6, generator=g).expand(4, 6),
            "strided": torch.randn(4, 12, generator=g)[:, ::2],
        }[kind]
        assert not grad.is_contiguous()
        history.append(grad.clone(memory_format=torch.contiguous_format))
        p[0].grad = grad
        optimizer.step()
    expected = by_hand(initial[0], history, 1e-2, decay=decay)
    torch.testing.assert_close(p[0].double(), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("decay", [0.0, 1e-2])
def test_non_contiguous_parameters(decay: float) -> None:
    """Channels-last convolution kernels are such parameters; their gradients may be laid out otherwise."""
    kernel = torch.randn(4, 3, 2, 2, generator=torch.Generator().manual_seed(0))
    p = kernel.to(memory_format=torch.channels_last).requires_grad_()
    initial = p.detach().clone()
    optimizer = AdamW([p], lr=1e-2, weight_decay=decay)
    history = []
    for step in range(3):
        history.append(torch.randn(4, 3, 2, 2, generator=torch.Generator().manual_seed(step)))
        p.grad = history[-1].clone()
        optimizer.step()
    torch.testing.assert_close(p.double(), by_hand(initial, history, 1e-2, decay=decay), rtol=1e-5, atol=1e-5)


def test_summed_loss_through_autograd_grad() -> None:
    """The gradient of a sum, as the algorithms ask for it."""
    p = parameters([(3, 4)])
    initial = copies(p)
    optimizer = AdamW(p, lr=1e-2)
    (grad,) = torch.autograd.grad(p[0].sum(), p)
    p[0].grad = grad
    optimizer.step()
    torch.testing.assert_close(p[0].detach(), initial[0].detach() - 1e-2, rtol=1e-5, atol=1e-6)


class _Indexing(TorchDispatchMode):
    """Counts what takes places from an index tensor, which on a GPU would have to be copied there."""

    n = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.n += "index" in str(func)
        return func(*args, **(kwargs or {}))


def test_steps_of_some_parameters_are_counted_without_indices() -> None:
    params = parameters([(2,), (3,), (4,)])
    optimizer = AdamW(params)
    params[0].grad, params[2].grad = torch.ones(2), torch.ones(4)
    optimizer.prepare()
    with _Indexing() as indexing:
        optimizer.step()
    assert [int(optimizer.state[p]["step"]) for p in params] == [1, 0, 1]
    assert indexing.n == 0


def test_parameters_without_gradient_stay() -> None:
    """Neither moved, decayed, nor counted."""
    p = parameters([(3,), (3,)])
    initial = copies(p)
    optimizer = AdamW(p, lr=1e-1, weight_decay=1e-1)
    grads = gradients(p, 0)
    p[1].grad = grads[1]
    optimizer.step()
    assert torch.equal(p[0], initial[0])
    assert not torch.equal(p[1], initial[1])
    # The first step of the other is its own first, with its own bias correction.
    p[0].grad, p[1].grad = grads[0], None
    optimizer.step()
    expected = by_hand(initial[0], [grads[0]], 1e-1, decay=1e-1)
    torch.testing.assert_close(p[0].double(), expected, rtol=1e-5, atol=1e-6)


def test_no_gradient_at_all_and_closure() -> None:
    p = parameters([(3,)])
    optimizer = AdamW(p, lr=1e-1, weight_decay=1e-1)
    before = p[0].detach().clone()
    assert optimizer.step() is None
    assert torch.equal(p[0], before)

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = p[0].square().sum()
        loss.backward()
        return loss

    assert optimizer.step(closure).item() == pytest.approx(float(before.square().sum()))
    assert not torch.equal(p[0], before)


def test_groups_have_their_own_settings() -> None:
    p = parameters([(3,), (3,)])
    initial = copies(p)
    optimizer = AdamW([{"params": [p[0]], "lr": 1e-1, "weight_decay": 0.5}, {"params": [p[1]]}], lr=1e-3)
    grads = gradients(p, 0)
    set_gradients(p, grads)
    optimizer.step()
    for i, (lr, decay) in enumerate([(1e-1, 0.5), (1e-3, 0.0)]):
        expected = by_hand(initial[i], [grads[i]], lr, decay=decay)
        torch.testing.assert_close(p[i].double(), expected, rtol=1e-5, atol=1e-6)


def test_learning_rate_set_between_steps() -> None:
    p = parameters([(3,)])
    optimizer = AdamW(p, lr=1e-2, weight_decay=0.1)
    set_gradients(p, gradients(p, 0))
    optimizer.step()
    before = p[0].detach().clone()
    optimizer.param_groups[0]["lr"] = 0.0
    optimizer.step()
    assert torch.equal(p[0], before)


def test_gradients_are_left_alone() -> None:
    p = parameters([(3, 4)])
    grads = gradients(p, 0)
    set_gradients(p, grads)
    AdamW(p, weight_decay=0.1).step()
    assert p[0].grad is not None and torch.equal(p[0].grad, grads[0])


@pytest.mark.parametrize("through_file", [False, True])
@pytest.mark.parametrize("decay", [0.0, 1e-2])
def test_state_dict_round_trip(decay: float, through_file: bool) -> None:
    p = parameters(SHAPES)
    a = AdamW(p, lr=1e-2, weight_decay=decay)
    for step in range(3):
        set_gradients(p, gradients(p, step))
        a.step()
    q = copies(p)
    state = copy.deepcopy(a.state_dict())
    if through_file:
        file = io.BytesIO()
        torch.save(state, file)
        file.seek(0)
        state = torch.load(file, weights_only=True)
    b = AdamW(q, lr=1.0)
    b.load_state_dict(state)
    for step in range(3, 6):
        grads = gradients(p, step)
        set_gradients(p, grads)
        set_gradients(q, grads)
        a.step()
        b.step()
    for x, y in zip(p, q, strict=True):
        assert torch.equal(x, y)


def test_cleared_state_starts_anew() -> None:
    p = parameters([(5,)])
    optimizer = AdamW(p, lr=1e-2, weight_decay=1e-2)
    for step in range(3):
        set_gradients(p, gradients(p, step))
        optimizer.step()
    optimizer.state.clear()
    initial = copies(p)
    grads = gradients(p, 9)
    set_gradients(p, grads)
    optimizer.step()
    torch.testing.assert_close(p[0].double(), by_hand(initial[0], grads, 1e-2, decay=1e-2), rtol=1e-5, atol=1e-6)


def powers_in_compiled_steps(n_parameters: int) -> int:
    """How often the code of a compiled step of so many parameters computes a power."""
    params = parameters([(3, 16 + i) for i in range(n_parameters)])
    optimizer = AdamW(params, weight_decay=1e-4)
    optimizer.prepare()
    grads = gradients(params, 0)
    state = [*params, *optimizer.read_tensors()]
    state += [optimizer.state[p][name] for p in params for name in ("exp_avg", "exp_avg_sq")]

    def step(*grads: torch.Tensor) -> list[torch.Tensor]:
        with torch.no_grad():
            optimizer.apply(grads)
        return [grads[0].sum()]

    expected = copies(params)
    set_gradients(expected, grads)
    AdamW(expected, weight_decay=1e-4).step()
    graph = trace(step, state, grads)

    def compile_and_run() -> None:
        compile_graph(graph, [*state, *grads])(*state, *grads)

    _, codes = run_and_get_code(compile_and_run)
    for p, q in zip(params, expected, strict=True):
        torch.testing.assert_close(p, q, rtol=1e-6, atol=1e-7)
    return sum(len(re.findall(r"\bpow\(", code)) for code in codes)


@pytest.mark.slow
def test_a_compiled_step_computes_each_correction_once() -> None:
    """Not for every few elements of every parameter, which took a seventh of BRO's whole training."""
    two, five = powers_in_compiled_steps(2), powers_in_compiled_steps(5)
    assert 0 < two == five


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lr", -1e-3),
        ("lr", float("nan")),
        ("betas", (1.0, 0.999)),
        ("betas", (0.9, -0.1)),
        ("eps", 0.0),
        ("eps", -1e-8),
        ("weight_decay", -1e-4),
        ("weight_decay", float("nan")),
    ],
)
def test_bad_arguments(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name) as caught:
        AdamW(parameters([(1,)]), **{name: value})
    assert str(value) in str(caught.value)


# ---------------------------------------------------------------- sharpness-aware gradients


def test_uphill_gradient_by_hand() -> None:
    """(x^2 + 2 y^2) / 2 at (3, 2): the gradient (3, 4) is 5 long; a radius of 1/2 leads to (3.3, 2.4)."""
    x, y = torch.tensor([3.0], requires_grad=True), torch.tensor([2.0], requires_grad=True)

    def loss() -> torch.Tensor:
        return (x.square() + 2 * y.square()).sum() / 2

    at: list[tuple[float, float]] = []

    def evaluate() -> torch.Tensor:
        at.append((x.item(), y.item()))
        return loss()

    gradients = sharpness_aware_gradients(loss(), evaluate, [x, y], 0.5, [None, None])
    assert at == [pytest.approx((3.3, 2.4))]
    assert [g.item() for g in gradients] == pytest.approx([3.3, 4.8])
    assert (x.item(), y.item()) == (3.0, 2.0)
    assert x.grad is None and y.grad is None


def test_stacked_networks_move_by_the_radius_each() -> None:
    """The second copy's gradient is (6, 0): it moves by 1/2 too, whatever the first one's gradient is."""
    x, y = torch.tensor([[3.0], [6.0]], requires_grad=True), torch.tensor([[[2.0]], [[0.0]]], requires_grad=True)

    def loss() -> torch.Tensor:
        return x.square().sum() / 2 + y.square().sum()

    gradients = sharpness_aware_gradients(loss(), loss, [x, y], 0.5, [2, 2])
    torch.testing.assert_close(gradients[0], torch.tensor([[3.3], [6.5]]))
    torch.testing.assert_close(gradients[1], torch.tensor([[[4.8]], [[0.0]]]))


def test_stacked_beside_unstacked() -> None:
    """
    sum_e (w v_e)^2 / 2 at w = 1, v = (1, 2): the gradients are 5 and (1, 2), each by itself of the radius 0.1, and the
    gradient at w = 1.1, v = (1.1, 2.1) is 1.1 (1.21 + 4.41) and 1.21 (1.1, 2.1).
    """
    w, v = torch.tensor([1.0], requires_grad=True), torch.tensor([1.0, 2.0], requires_grad=True)

    def loss() -> torch.Tensor:
        return (w * v).square().sum() / 2

    dw, dv = sharpness_aware_gradients(loss(), loss, [w, v], 0.1, [None, 2])
    torch.testing.assert_close(dw, torch.tensor([6.182]))
    torch.testing.assert_close(dv, torch.tensor([1.331, 2.541]))


def test_two_copies_are_two_networks() -> None:
    torch.manual_seed(0)
    both = MLP(3, (5, 4), n_copies=2)
    alone = [MLP(3, (5, 4), n_copies=1) for _ in range(2)]
    for e, network in enumerate(alone):
        for own, shared in zip(network.parameters(), both.parameters(), strict=True):
            own.data.copy_(shared[e : e + 1])
    x, target = torch.randn(6, 3), torch.randn(2, 6, 4)
    target[1] *= 100  # gradients of very different lengths

    def loss(network: MLP, of: torch.Tensor) -> torch.Tensor:
        return (network(x) - of).square().sum()

    def gradients(network: MLP, of: torch.Tensor, copies: int) -> list[torch.Tensor]:
        parameters = list(network.parameters())
        return sharpness_aware_gradients(
            loss(network, of), lambda: loss(network, of), parameters, 0.5, [copies] * len(parameters)
        )

    together = gradients(both, target, 2)
    for e, network in enumerate(alone):
        for ours, theirs in zip(together, gradients(network, target[e : e + 1], 1), strict=True):
            torch.testing.assert_close(ours[e : e + 1], theirs, rtol=1e-4, atol=1e-4)
    plain = torch.autograd.grad(loss(both, target), list(both.parameters()))
    assert not torch.allclose(plain[0], together[0], rtol=1e-2), "the radius would not show"


@pytest.mark.parametrize("radius", [1e-3, 0.05, 1e8])
@pytest.mark.parametrize("fails", [False, True])
def test_parameters_are_restored_bit_for_bit(radius: float, fails: bool) -> None:
    params = parameters(SHAPES[1:])
    before = copies(params)

    def loss() -> torch.Tensor:
        return sum((p.square() * 1.7).sum() for p in params)  # type: ignore[return-value]

    def evaluate() -> torch.Tensor:
        assert not any(torch.equal(a, b) for a, b in zip(params, before, strict=True)), "not moved"
        if fails:
            raise KeyError("the evaluation fails")
        return loss()

    if fails:
        with pytest.raises(KeyError, match="the evaluation fails"):
            sharpness_aware_gradients(loss(), evaluate, params, radius, [None] * len(params))
    else:
        sharpness_aware_gradients(loss(), evaluate, params, radius, [None] * len(params))
    assert all(torch.equal(a, b) for a, b in zip(params, before, strict=True))


@pytest.mark.parametrize("n_copies", [None, 2])
def test_gradient_of_zero_stays_zero(n_copies: int | None) -> None:
    p = torch.ones(2, 3, requires_grad=True)
    (gradient,) = sharpness_aware_gradients((0 * p).sum(), lambda: (0 * p).sum(), [p], 0.05, [n_copies])
    assert torch.equal(gradient, torch.zeros(2, 3)) and torch.equal(p.detach(), torch.ones(2, 3))


def test_uphill_gradient_of_a_number() -> None:
    """A parameter without axes: x^3 at 2 has the gradient 12, that at 2.5 is 18.75."""
    x = torch.tensor(2.0, requires_grad=True)
    (gradient,) = sharpness_aware_gradients(x**3, lambda: x**3, [x], 0.5, [None])
    assert gradient.shape == () and gradient.item() == pytest.approx(18.75) and x.item() == 2
