"""
Layers of which several independent copies are evaluated at once.

The copies are the leading axis E of every parameter, so that E networks cost one batched matmul per layer
instead of a Python loop. Nothing couples the copies: copy e of the output depends on copy e of the
parameters alone.
"""

import torch
import torch.nn.functional as F
from torch import nn

from sb3_sample.tracing import is_tracing


class EnsembleLinear(nn.Module):
    """
    E independent dense layers: ``y[e] = x[e] @ weight[e] + bias[e]``.

    :param n_copies: E, the number of layers
    :param in_features: width of the input
    :param out_features: width of the output
    :param bias: whether the layers have a bias
    """

    def __init__(self, n_copies: int, in_features: int, out_features: int, bias: bool = True):
        super().__init__()
        self.n_copies, self.in_features, self.out_features = n_copies, in_features, out_features
        self.weight: torch.Tensor = nn.Parameter(torch.zeros(n_copies, in_features, out_features))
        self.bias = nn.Parameter(torch.zeros(n_copies, 1, out_features)) if bias else None

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: input, (B, in) shared by the copies or (E, B, in)
        :return: output, (E, B, out)
        """
        return self.multiply(x, self.weight)

    def multiply(self, x: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        """
        :param x: input, (B, in) shared by the copies or (E, B, in)
        :param weight: kernels in place of the layer's own, (E, in, out)
        :return: output, (E, B, out)
        """
        if x.dim() == 2:
            x = x.expand(self.n_copies, -1, -1)
        if self.bias is None:
            return torch.bmm(x, weight)
        if is_tracing():
            # As two operations, of which the second is fused with what follows.
            return torch.bmm(x, weight) + self.bias
        return torch.baddbmm(self.bias, x, weight)

    def extra_repr(self) -> str:
        return f"n_copies={self.n_copies}, in_features={self.in_features}, out_features={self.out_features}"


class EnsembleLayerNorm(nn.Module):
    """
    E independent layer norms over the last axis (biased variance).

    :param n_copies: E, the number of layer norms
    :param n_features: width of the normalised axis
    :param eps: added to the variance
    """

    def __init__(self, n_copies: int, n_features: int, eps: float):
        super().__init__()
        self.n_copies, self.n_features, self.eps = n_copies, n_features, eps
        self.weight = nn.Parameter(torch.ones(n_copies, 1, n_features))
        self.bias = nn.Parameter(torch.zeros(n_copies, 1, n_features))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: input, (E, B, features)
        :return: output, (E, B, features)
        """
        return torch.addcmul(self.bias, F.layer_norm(x, (self.n_features,), eps=self.eps), self.weight)

    def extra_repr(self) -> str:
        return f"n_copies={self.n_copies}, n_features={self.n_features}, eps={self.eps}"


#: One layer, or a stack of them.
Dense = nn.Linear | EnsembleLinear
Norm = nn.LayerNorm | EnsembleLayerNorm


def layer_norm(n_features: int, n_copies: int | None, eps: float = 1e-6) -> Norm:
    """
    A layer norm: one, or a stack of independent ones.

    :param n_features: width of the normalised axis
    :param n_copies: E for a stack of E layer norms, None for a plain ``nn.LayerNorm``
    :param eps: added to the variance; 1e-6 as in the published code of BRO and DAC (torch's default is 1e-5)
    """
    return nn.LayerNorm(n_features, eps=eps) if n_copies is None else EnsembleLayerNorm(n_copies, n_features, eps)
