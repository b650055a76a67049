"""AdamW against torch's Adam and against its definition in float64."""

import copy
import io
from typing import Any

import pytest
import torch

from sb3_sample import optim
from sb3_sample.optim import AdamW


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
