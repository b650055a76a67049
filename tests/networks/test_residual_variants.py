"""The variants of BroNet that BRO, figure 14 compares, written out by hand."""

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from sb3_sample.networks import NETWORKS, BroNet, EnsembleLinear, SpectralNet
from tests.networks.common import randomize, take_copy

E, B = 2, 5


@pytest.mark.parametrize("n_copies", [None, E])
@pytest.mark.parametrize("n_blocks", [0, 2])
def test_bronet_without_first_layer_norm(n_blocks: int, n_copies: int | None) -> None:
    torch.manual_seed(0)
    net = BroNet(3, 8, n_blocks, n_copies, first_layer_norm=False)
    randomize(net)
    x = torch.randn(B, 3)
    h = F.relu(net.dense(x))
    for block in net.blocks:
        h = h + block.norm2(block.dense2(F.relu(block.norm1(block.dense1(h)))))
    torch.testing.assert_close(net(x), h)
    removed = BroNet(3, 8, n_blocks, n_copies).state_dict().keys() - net.state_dict().keys()
    assert removed == {"norm.weight", "norm.bias"}


def unit_kernel(layer: nn.Module) -> torch.Tensor:
    """(..., in, out), divided by its largest singular value."""
    assert isinstance(layer, (nn.Linear, EnsembleLinear))
    weight = layer.weight if isinstance(layer, EnsembleLinear) else layer.weight.T
    return weight / torch.linalg.svdvals(weight)[..., :1, None]


@pytest.mark.parametrize("n_copies", [None, E])
def test_spectral_net(n_copies: int | None) -> None:
    torch.manual_seed(0)
    net = SpectralNet(3, 8, 2, n_copies)
    randomize(net)
    x = torch.randn(B, 3)
    for _ in range(500):
        y = net(x)
    h = F.relu(net.dense(x))
    for block in net.blocks:
        inner = F.relu(block.norm(h) @ unit_kernel(block.dense1) + block.dense1.bias)
        h = h + inner @ unit_kernel(block.dense2) + block.dense2.bias
    assert net.out_features == 8
    torch.testing.assert_close(y, h, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    "make", [lambda n: BroNet(3, 8, 2, n, first_layer_norm=False), lambda n: SpectralNet(3, 8, 2, n).eval()]
)
def test_copies_against_separate_networks(make: Callable[[int | None], nn.Module]) -> None:
    torch.manual_seed(0)
    stack = make(E)
    x = torch.randn(B, 3)
    for e in range(E):
        single = make(None)
        take_copy(single, stack, e)
        torch.testing.assert_close(stack(x)[e], single(x), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("make", [lambda: SpectralNet(3, width=0), lambda: SpectralNet(3, n_blocks=-1)])
def test_bad_sizes(make: Callable[[], nn.Module]) -> None:
    with pytest.raises(ValueError, match="SpectralNet needs width >= 1 and n_blocks >= 0, not"):
        make()


def test_spectral_net_has_a_name() -> None:
    assert NETWORKS["spectral"] is SpectralNet
