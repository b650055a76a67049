"""The MLP's options: CReLU, dropout, five layers with layer norm."""

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from sb3_sample.networks import MLP, CReLU, EnsembleLayerNorm, EnsembleLinear
from tests.networks.common import randomize, take_copy

E, B = 2, 5


def test_crelu() -> None:
    x = torch.tensor([[1.0, -2.0, 0.0]], requires_grad=True)
    y = CReLU()(x)
    assert y.tolist() == [[1, 0, 0, 0, 2, 0]]
    (y * torch.tensor([1.0, 2, 3, 4, 5, 6])).sum().backward()
    assert x.grad is not None and x.grad.tolist() == [[1, -5, 0]]


@pytest.mark.parametrize("n_copies", [None, E])
def test_mlp_with_crelu(n_copies: int | None) -> None:
    torch.manual_seed(0)
    net = MLP(3, (8, 6), CReLU, n_copies=n_copies)
    randomize(net)
    assert net.out_features == 12
    denses = [m for m in net.layers if isinstance(m, (nn.Linear, EnsembleLinear))]
    assert [(d.in_features, d.out_features) for d in denses] == [(3, 8), (16, 6)]
    h = x = torch.randn(B, 3)
    for dense in denses:
        h = dense(h)
        h = torch.cat((h.clamp(min=0), (-h).clamp(min=0)), dim=-1)
    assert h.shape[-1] == 12
    torch.testing.assert_close(net(x), h)


@pytest.mark.parametrize("options", [{"activation_fn": CReLU}, {"dropout": 0.5}])
def test_copies_against_separate_networks(options: dict) -> None:
    torch.manual_seed(0)
    stack = MLP(3, (8, 6), layer_norm=True, n_copies=E, **options).eval()
    randomize(stack)
    x = torch.randn(B, 3)
    for e in range(E):
        single = MLP(3, (8, 6), layer_norm=True, **options).eval()
        take_copy(single, stack, e)
        torch.testing.assert_close(stack(x)[e], single(x), rtol=1e-5, atol=1e-5)


def test_dropout_is_between_dense_and_layer_norm() -> None:
    net = MLP(3, (8, 6), layer_norm=True, dropout=0.25)
    assert [type(m) for m in net.layers] == 2 * [nn.Linear, nn.Dropout, nn.LayerNorm, nn.ReLU]
    assert all(m.p == 0.25 for m in net.layers if isinstance(m, nn.Dropout))
    assert not any(isinstance(m, nn.Dropout) for m in MLP(3, (8, 6)).layers)


def test_each_copy_drops_its_own_neurons() -> None:
    torch.manual_seed(0)
    net = MLP(3, (64,), nn.Identity, n_copies=E, dropout=0.5)
    x = torch.rand(B, 3) + 1
    with torch.no_grad():
        for p in net.parameters():
            p.fill_(1)
    kept = net(x) != 0
    assert 0.35 < kept.float().mean() < 0.65
    assert not torch.equal(kept[0], kept[1])
    assert not torch.equal(kept[:, 0], kept[:, 1])
    scaled = (2 * (x.sum(dim=1) + 1))[None, :, None].expand_as(kept)
    torch.testing.assert_close(net(x)[0, 0].max(), scaled[0, 0, 0])
    torch.testing.assert_close(net.eval()(x), scaled / 2)


@pytest.mark.parametrize("n_copies", [None, E])
def test_five_layers_with_layer_norm(n_copies: int | None) -> None:
    """ "(Dense + LN) x 5" of BRO, figure 14."""
    torch.manual_seed(0)
    net = MLP(3, [8] * 5, layer_norm=True, n_copies=n_copies)
    randomize(net)
    denses = [m for m in net.layers if isinstance(m, (nn.Linear, EnsembleLinear))]
    norms = [m for m in net.layers if isinstance(m, (nn.LayerNorm, EnsembleLayerNorm))]
    assert len(denses) == len(norms) == 5
    h = x = torch.randn(B, 3)
    for dense, norm in zip(denses, norms, strict=True):
        h = F.relu(norm(dense(h)))
    assert torch.equal(net(x), h)


@pytest.mark.parametrize("dropout", [-0.1, 1.0, float("nan")])
def test_bad_dropout(dropout: float) -> None:
    with pytest.raises(ValueError, match=f"dropout must be .* not {dropout}"):
        MLP(3, dropout=dropout)


def test_spectral_norm_needs_a_layer() -> None:
    with pytest.raises(ValueError, match="spectral_norm needs a hidden layer"):
        MLP(3, (), spectral_norm=True)
