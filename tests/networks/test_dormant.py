"""Dormant neurons: which are found, what recycling changes, and what it leaves alone bit by bit."""

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn

from sb3_sample.networks import (
    MLP,
    BroNet,
    CReLU,
    SimbaNet,
    SpectralLinear,
    SpectralNet,
    linear,
    neuron_scores,
    recycle,
)
from sb3_sample.networks.normed_mlp import NormedMLP
from sb3_sample.networks.spectral_norm import SpectralNorm
from sb3_sample.optim import AdamW
from tests.networks.common import randomize, take_copy

E, B = 2, 32

# Silent neurons of a layer of 6, by copy; a network without copies has those of copy 0.
SILENT = [[1, 4], [0, 2, 3]]

NETS: dict[str, Callable[[int | None], Any]] = {
    "mlp": lambda n: MLP(3, (6, 6), n_copies=n),
    "mlp with layer norm": lambda n: MLP(3, (6, 6), layer_norm=True, n_copies=n),
    "crelu": lambda n: MLP(3, (6, 6), CReLU, n_copies=n),
    "spectral norm": lambda n: MLP(3, (6, 6), spectral_norm=True, n_copies=n),
    "bronet": lambda n: BroNet(3, 6, 2, n),
    "spectral": lambda n: SpectralNet(3, 6, 2, n),
}


def is_silent(n_copies: int | None) -> torch.Tensor:
    """(E, 6) or (6,)"""
    mask = torch.zeros(E, 6, dtype=torch.bool)
    for e, neurons in enumerate(SILENT):
        mask[e, neurons] = True
    return mask[0] if n_copies is None else mask


@torch.no_grad()
def silence(units: Any, mask: torch.Tensor) -> None:
    """Make the masked neurons 0 whatever the input is, by the last thing before the activation."""
    per_neuron = mask if mask.dim() == 1 else mask.unsqueeze(-2)
    last = units.norm or units.dense
    bias = 0.0 if isinstance(units.activation, CReLU) else -1.0
    if units.norm is not None:
        last.weight.masked_fill_(per_neuron, 0)
    else:
        last.weight.masked_fill_(mask.unsqueeze(-1 if mask.dim() == 1 else -2), 0)
    last.bias.masked_fill_(per_neuron, bias)


def recyclable(trunk: Any, head: Any) -> list[Any]:
    return [units for units in trunk.hidden_units(head) if units.outgoing is not None]


def build(name: str, n_copies: int | None) -> tuple[Any, Any, torch.Tensor]:
    """A trunk, its head and an input that keeps every neuron but the silent ones awake."""
    torch.manual_seed(0)
    trunk = NETS[name](n_copies)
    head = linear(trunk.out_features, 2, n_copies)
    randomize(trunk)
    randomize(head)
    with torch.no_grad():
        for units in trunk.hidden_units(head):
            if units.norm is None:
                units.dense.weight.abs_()
                units.dense.bias.abs_().add_(1)
            else:
                # Six normalised numbers are below the root of six.
                units.norm.bias.copy_(2.5 * units.norm.weight.abs() + 1)
        for layer in trunk.modules():
            if isinstance(layer, SpectralNorm):
                layer.find_direction()
    silence(recyclable(trunk, head)[-1], is_silent(n_copies))
    return trunk, head, torch.randn(512, 3)


@pytest.mark.parametrize("n_copies", [None, E])
@pytest.mark.parametrize(
    ("name", "names", "outgoing"),
    [
        ("mlp", ["layers.0", "layers.2"], ["layers.2", "head"]),
        ("mlp with layer norm", ["layers.0", "layers.3"], ["layers.3", "head"]),
        ("bronet", ["dense", "blocks.0.dense1", "blocks.1.dense1"], [None, "blocks.0.dense2", "blocks.1.dense2"]),
        ("spectral", ["dense", "blocks.0.dense1", "blocks.1.dense1"], [None, "blocks.0.dense2", "blocks.1.dense2"]),
    ],
)
def test_hidden_units(name: str, names: list[str], outgoing: list[str | None], n_copies: int | None) -> None:
    trunk, head, _ = build(name, n_copies)
    units = trunk.hidden_units(head)
    modules = {**dict(trunk.named_modules()), "head": head, None: None}
    assert [u.name for u in units] == names
    assert [u.dense for u in units] == [modules[n] for n in names]
    assert [u.outgoing for u in units] == [modules[n] for n in outgoing]
    assert {type(u.activation) for u in units} == {nn.ReLU}
    assert len({u.activation for u in units}) == len(units)
    if name == "bronet":
        assert [u.norm for u in units] == [trunk.norm, *(b.norm1 for b in trunk.blocks)]
    elif name == "mlp with layer norm":
        assert [u.norm for u in units] == [trunk.layers[1], trunk.layers[4]]
    else:
        assert all(u.norm is None for u in units)


def test_hidden_units_of_a_copied_network_are_its_own() -> None:
    net = copy.deepcopy(MLP(3, (6, 6)))
    head = linear(6, 2, None)
    assert [u.dense for u in net.hidden_units(head)] == [net.layers[0], net.layers[2]]


def test_hidden_units_with_dropout_and_without_layers() -> None:
    net = MLP(3, (6,), layer_norm=True, dropout=0.5)
    (units,) = net.hidden_units(None)
    assert units[:5] == ("layers.0", net.layers[0], net.layers[2], net.layers[3], None)
    assert MLP(3, ()).hidden_units(None) == []


def test_scores_by_hand() -> None:
    """Two copies of identity layers, whose activations are the positive part of the input."""
    net = MLP(3, (3,), n_copies=2)
    with torch.no_grad():
        net.layers[0].weight.copy_(torch.eye(3) * torch.tensor([1.0, 2.0])[:, None, None])
    x = torch.tensor([[[3.0, -1, 0], [1, 1, 0]], [[1.0, 1, 1], [1, 1, 4]]])
    scores = neuron_scores(net, None, x)
    # Means (2, 0.5, 0) and (2, 2, 5), over their means 2.5/3 and 3.
    expected = torch.tensor([[2.4, 0.6, 0.0], [2 / 3, 2 / 3, 5 / 3]])
    torch.testing.assert_close(scores, {"layers.0": expected})


def test_score_of_crelu_adds_its_halves() -> None:
    net = MLP(2, (2,), CReLU)
    with torch.no_grad():
        net.layers[0].weight.copy_(torch.eye(2))
    scores = neuron_scores(net, None, torch.tensor([[3.0, 1], [-5, 1]]))
    torch.testing.assert_close(scores["layers.0"], torch.tensor([4.0, 1]) / 2.5)


def test_score_of_a_silent_layer_is_zero() -> None:
    net = MLP(3, (4, 4), n_copies=E)
    with torch.no_grad():
        net.layers[0].bias[0] = -100
        net.layers[0].weight[1].abs_()
    scores = neuron_scores(net, None, torch.rand(B, 3) + 0.1)["layers.0"]
    assert not scores[0].any() and scores[1].all()


def test_nan_does_not_pass_for_dormant() -> None:
    net, head = MLP(3, (4,)), linear(4, 1, None)
    assert recycle(net, head, torch.full((B, 3), torch.nan), 0.1) == 0


@pytest.mark.parametrize("name", NETS)
def test_measuring_changes_nothing(name: str) -> None:
    trunk, head, x = build(name, E)
    trunk.train()
    list(trunk.children())[-1].eval()
    modes = [m.training for m in trunk.modules()]
    state = copy.deepcopy(trunk.state_dict())
    trunk.hidden_units(head)[0].dense.weight.grad = torch.ones_like(trunk.hidden_units(head)[0].dense.weight)
    scores = neuron_scores(trunk, head, x.requires_grad_())
    assert all(s.shape == (E, 6) and not s.requires_grad for s in scores.values())
    assert [m.training for m in trunk.modules()] == modes and set(modes) == {True, False}
    assert all(torch.equal(value, state[key]) for key, value in trunk.state_dict().items())
    assert trunk.hidden_units(head)[0].dense.weight.grad.eq(1).all() and x.grad is None
    assert not any(m._forward_hooks for m in trunk.modules())


def test_hooks_are_gone_after_an_error() -> None:
    net = MLP(3, (4, 4), dropout=0.5)
    with pytest.raises(RuntimeError):
        neuron_scores(net, None, torch.randn(B, 7))
    assert not any(m._forward_hooks for m in net.modules())
    assert all(m.training for m in net.modules())


def test_dropout_is_off() -> None:
    torch.manual_seed(0)
    net = MLP(3, (64, 64), dropout=0.5)
    x = torch.randn(B, 3)
    first, second = neuron_scores(net, None, x), neuron_scores(net, None, x)
    for name in first:
        assert torch.equal(first[name], second[name])


@pytest.mark.parametrize("n_copies", [None, E])
@pytest.mark.parametrize("name", NETS)
@pytest.mark.parametrize("optimizer_class", [AdamW, torch.optim.Adam])
def test_recycle(name: str, n_copies: int | None, optimizer_class: Any) -> None:
    trunk, head, x = build(name, n_copies)
    mask = is_silent(n_copies)
    optimizer = optimizer_class([*trunk.parameters(), *head.parameters()], lr=1e-5)
    randomize_gradients([trunk, head])
    optimizer.step()
    units = recyclable(trunk, head)[-1]
    silence(units, mask)
    trunk.eval()
    scores = neuron_scores(trunk, head, x)
    assert torch.equal(scores[units.name] == 0, mask)
    assert all((s > 0).all() for n, s in scores.items() if n != units.name)

    modules = {"trunk": trunk, "head": head}
    before = {f"{k}.{n}": p.detach().clone() for k, m in modules.items() for n, p in m.named_parameters()}
    identity = {f"{k}.{n}": p for k, m in modules.items() for n, p in m.named_parameters()}
    output = head(trunk(x))
    n_recycled = recycle(trunk, head, x, 0.0, optimizer)
    assert n_recycled.shape == () and n_recycled == mask.sum()

    # Masks of what may change: columns of the dense layer, elements of bias and norm, rows of the outgoing layer.
    flat = n_copies is None
    per_neuron = mask if flat else mask[:, None]
    rows = torch.cat((mask, mask), dim=-1) if name == "crelu" else mask
    changed = {
        id(units.dense.weight): mask[:, None] if flat else mask[:, None, :],
        id(units.dense.bias): per_neuron,
        id(units.outgoing.weight): rows[None, :] if flat else rows[:, :, None],
    }
    if units.norm is not None:
        changed |= {id(units.norm.weight): per_neuron, id(units.norm.bias): per_neuron}
    for key, p in identity.items():
        here = changed.get(id(p), torch.tensor(False)).expand_as(p)
        assert torch.equal(p[~here], before[key][~here]), key
        for moment in ("exp_avg", "exp_avg_sq"):
            value = optimizer.state[p][moment]
            assert not value[here].any() and value[~here].all(), key
        assert optimizer.state[p]["step"] == 1
    targets = {units.dense.bias: 0, units.outgoing.weight: 0}
    if units.norm is not None:
        targets |= {units.norm.weight: 1, units.norm.bias: 0}
    for p, value in targets.items():
        assert p[changed[id(p)].expand_as(p)].eq(value).all()
    incoming = changed[id(units.dense.weight)].expand_as(units.dense.weight)
    name_of_incoming = next(key for key, p in identity.items() if p is units.dense.weight)
    assert units.dense.weight[incoming].ne(before[name_of_incoming][incoming]).all()

    # A layer norm sees the new neurons among the others, a spectral norm the new kernel.
    if name in ("mlp", "crelu"):
        torch.testing.assert_close(head(trunk(x)), output, rtol=1e-5, atol=1e-5)


def randomize_gradients(modules: list[nn.Module]) -> None:
    for module in modules:
        for p in module.parameters():
            p.grad = torch.randn_like(p)


def test_threshold_is_inclusive_and_relative_to_the_layer() -> None:
    net, head = MLP(3, (3,)), linear(3, 1, None)
    with torch.no_grad():
        net.layers[0].weight.copy_(torch.diag(torch.tensor([0.5, 1.0, 1.5])))
    x = torch.ones(B, 3)
    assert neuron_scores(net, head, x)["layers.0"].tolist() == [0.5, 1, 1.5]
    assert recycle(copy.deepcopy(net), head, x, 0.49) == 0
    assert recycle(copy.deepcopy(net), head, x, 0.5) == 1
    assert recycle(copy.deepcopy(net), head, x, 1.25) == 2


@pytest.mark.parametrize("n_copies", [None, E])
def test_new_kernels_are_orthogonal_with_root_two(n_copies: int | None) -> None:
    """With every neuron recycled the kernel is a whole fresh one, each copy its own."""
    torch.manual_seed(0)
    net, head = MLP(3, (6,), n_copies=n_copies), linear(6, 2, n_copies)
    randomize(net)
    assert recycle(net, head, torch.randn(B, 3), 1e6) == 6 * (n_copies or 1)
    weight = net.layers[0].weight.detach()
    norms = torch.linalg.svdvals(weight)
    torch.testing.assert_close(norms, torch.full_like(norms, 2**0.5), rtol=1e-4, atol=1e-5)
    if n_copies is not None:
        assert not torch.allclose(weight[0], weight[1])


@pytest.mark.parametrize("n_copies", [None, E])
@pytest.mark.parametrize("name", ["mlp", "simba", "normed"])
def test_new_kernels_are_drawn_as_at_initialisation(name: str, n_copies: int | None) -> None:
    """Each network as it draws them itself: the same sizes, from the same distribution."""
    torch.manual_seed(0)
    # A layer of 40 x 160 numbers, whose standard deviation is known to some percent.
    nets: dict[str, Callable[[], Any]] = {
        "mlp": lambda: MLP(40, (160,), gain=1.0, n_copies=n_copies),
        "simba": lambda: SimbaNet(3, 40, 1, 4, n_copies=n_copies),
        "normed": lambda: NormedMLP(40, (160,), n_copies=n_copies),
    }
    net, original = nets[name](), nets[name]()
    head = linear(net.out_features, 2, n_copies)
    randomize(net)
    assert recycle(net, head, torch.randn(B, 3 if name == "simba" else 40), 1e6) == 160 * (n_copies or 1)
    drawn, made = (recyclable(each, head)[0].dense.weight.detach() for each in (net, original))
    assert not torch.equal(drawn, made)
    assert drawn.std().item() == pytest.approx(made.std().item(), rel=0.05)
    assert drawn.abs().max().item() == pytest.approx(made.abs().max().item(), rel=0.25)
    if name == "mlp":
        norms = torch.linalg.svdvals(drawn)
        torch.testing.assert_close(norms, torch.ones_like(norms), rtol=1e-4, atol=1e-5)
    if n_copies is not None:
        assert not torch.allclose(drawn[0], drawn[1])


def test_zero_wins_between_two_dormant_neurons() -> None:
    """A recycled neuron of the second layer does not read a recycled one of the first."""
    torch.manual_seed(0)
    net, head = MLP(3, (6, 6)), linear(6, 2, None)
    first, second = net.hidden_units(head)
    masks = [torch.tensor([i in neurons for i in range(6)]) for neurons in ([0, 3], [1, 2])]
    silence(first, masks[0])
    silence(second, masks[1])
    x = torch.randn(512, 3)
    output = head(net(x))
    assert recycle(net, head, x, 0.0) == 4
    assert not second.dense.weight[:, masks[0]].any()
    assert second.dense.weight[masks[1]][:, ~masks[0]].all()
    torch.testing.assert_close(head(net(x)), output)


@pytest.mark.parametrize("name", NETS)
def test_copies_against_separate_networks(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stack, head, x = build(name, E)
    singles, heads = [NETS[name](None) for _ in range(E)], [linear(stack.out_features, 2, None) for _ in range(E)]
    for e in range(E):
        take_copy(singles[e], stack, e)
        take_copy(heads[e], head, e)
    # One and the same new value, since the drawn ones come in another order.
    monkeypatch.setattr(nn.init, "orthogonal_", lambda kernel, gain: kernel.fill_(gain))
    threshold = 0.4
    n_recycled = [recycle(singles[e], heads[e], x, threshold) for e in range(E)]
    assert recycle(stack, head, x, threshold) == sum(n_recycled)
    assert all(n >= len(neurons) for n, neurons in zip(n_recycled, SILENT, strict=True))
    for e in range(E):
        for single, whole in ((singles[e], stack), (heads[e], head)):
            expected = copy.deepcopy(single)
            take_copy(expected, whole, e)
            for (key, p), q in zip(single.named_parameters(), expected.parameters(), strict=True):
                assert torch.equal(p, q), key


def test_only_blocks_are_recycled_in_residual_networks() -> None:
    for net in (BroNet(3, 6, 1), SpectralNet(3, 6, 1)):
        randomize(net)
        head = linear(6, 2, None)
        before = [net.dense.weight.clone(), head.weight.clone(), net.blocks[0].dense1.weight.clone()]
        assert recycle(net, head, torch.randn(B, 3), 1e6) == 6
        assert torch.equal(net.dense.weight, before[0]) and torch.equal(head.weight, before[1])
        assert not torch.equal(net.blocks[0].dense1.weight, before[2])


def test_without_a_head_the_last_layer_is_left_alone() -> None:
    net = MLP(3, (6, 5))
    randomize(net)
    assert recycle(net, None, torch.randn(B, 3), 1e6) == 6
    assert net.layers[2].bias.all()


@pytest.mark.parametrize(("layer", "n"), [(0, 5), (2, 0), (None, 11)])
def test_frozen_neurons_are_left_alone(layer: int | None, n: int) -> None:
    """Those of a frozen layer, and those that it reads."""
    net, head = MLP(3, (6, 5)), linear(5, 2, None)
    randomize(net)
    if layer is not None:
        net.layers[layer].requires_grad_(False)
    before = [parameter.clone() for parameter in net.parameters()]
    assert recycle(net, head, torch.randn(B, 3), 1e6) == n
    for old, new in zip(before, net.parameters(), strict=True):
        assert torch.equal(old, new) != new.requires_grad or n == 0


def test_spectral_norm_follows_at_once() -> None:
    torch.manual_seed(0)
    net, head = MLP(3, (6, 6), spectral_norm=True), linear(6, 2, None)
    with torch.no_grad():
        net.layers[2].weight.mul_(1e-3)
    recycle(net, head, torch.randn(B, 3), 0.5)
    layer = net.layers[2]
    assert isinstance(layer, SpectralLinear)
    norm = torch.linalg.svdvals(layer.eval().normalized_weight())[0]
    torch.testing.assert_close(norm, torch.ones(()), rtol=0.02, atol=0)


def test_optimizer_without_state() -> None:
    """Before the first step, or for parameters that it does not hold, no state appears."""
    net, head = MLP(3, (6,)), linear(6, 2, None)
    optimizer = AdamW(net.parameters())
    recycle(net, head, torch.randn(B, 3), 1e6, optimizer)
    assert not optimizer.state


@pytest.mark.parametrize("name", NETS)
def test_nothing_is_read_on_the_host(name: str) -> None:
    """Tensors of the meta device have no values that could be read."""
    trunk, head, x = build(name, E)
    optimizer = AdamW([*trunk.to("meta").parameters(), *head.to("meta").parameters()])
    optimizer.prepare()
    assert recycle(trunk, head, x.to("meta"), 0.1, optimizer).is_meta


@pytest.mark.parametrize("threshold", [-0.1, float("nan")])
def test_bad_threshold(threshold: float) -> None:
    with pytest.raises(ValueError, match=f"threshold must be at least 0, not {threshold}"):
        recycle(MLP(3, (6,)), linear(6, 2, None), torch.randn(B, 3), threshold)
