"""Dense layers whose kernel is divided by its largest singular value (spectral norm, Miyato et al. 2018)."""

import torch
import torch.nn.functional as F
from torch import nn

from sb3_sample.networks.ensemble import EnsembleLinear


class SpectralNorm(nn.Module):
    """
    Spectral normalisation of a dense layer, for the two layers below: ``weight / sigma(weight)``, per copy.

    The largest singular value is ``sigma = u' weight v``. Its vectors u and v follow the kernel by one power iteration
    at each forward pass in training mode; in evaluation mode they stay. They are buffers, saved with the layer, and
    constants to the gradient. A network whose weights follow another's (a target) updates its own vectors: in its
    forward passes if it is in training mode, else by ``Network.follow_directions``.
    """

    weight: torch.Tensor
    u: torch.Tensor
    v: torch.Tensor

    def add_buffers(self) -> None:
        """Start from random directions; the weight is (m, n), or (E, m, n) for copies."""
        *copies, m, n = self.weight.shape
        self.register_buffer("u", F.normalize(torch.randn(*copies, m), dim=-1))
        self.register_buffer("v", F.normalize(torch.randn(*copies, n), dim=-1))

    @torch.no_grad()
    def find_direction(self, n_iterations: int = 15) -> None:
        """
        Run power iterations, after an abrupt change of the kernel.

        :param n_iterations: how many
        """
        u, v, weight = self.u, self.v, self.weight
        for _ in range(n_iterations):
            v = _direction((weight.mT @ u.unsqueeze(-1)).squeeze(-1), v)
            u = _direction((weight @ v.unsqueeze(-1)).squeeze(-1), u)
        self.u.copy_(u)
        self.v.copy_(v)

    def normalized_weight(self) -> torch.Tensor:
        """
        :return: the kernel of spectral norm 1, of the weight's shape; a kernel of zeros stays zero
        """
        if self.training:
            self.find_direction(1)
        # The next forward pass overwrites the buffers, possibly before this one's gradient is taken.
        u, v = self.u.clone(), self.v.clone()
        sigma = (u * (self.weight @ v.unsqueeze(-1)).squeeze(-1)).sum(dim=-1)
        sigma = torch.where(sigma == 0, 1.0, sigma)
        return self.weight / sigma[..., None, None]


def _direction(x: torch.Tensor, otherwise: torch.Tensor) -> torch.Tensor:
    """Vectors of length 1; ``otherwise`` in place of a vector of length 0, which would stay 0 for ever."""
    length = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    return torch.where(length > 0, x / length, otherwise)


class SpectralLinear(SpectralNorm, nn.Linear):
    """
    ``nn.Linear`` with a kernel of spectral norm 1.

    :param in_features: width of the input
    :param out_features: width of the output
    :param bias: whether the layer has a bias
    """

    def __init__(self, in_features: int, out_features: int, bias: bool = True):
        nn.Linear.__init__(self, in_features, out_features, bias=bias)
        self.add_buffers()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (..., in)
        :return: (..., out)
        """
        return F.linear(x, self.normalized_weight(), self.bias)


class SpectralEnsembleLinear(SpectralNorm, EnsembleLinear):
    """
    E independent dense layers, each kernel of spectral norm 1.

    :param n_copies: E, the number of layers
    :param in_features: width of the input
    :param out_features: width of the output
    :param bias: whether the layers have a bias
    """

    def __init__(self, n_copies: int, in_features: int, out_features: int, bias: bool = True):
        EnsembleLinear.__init__(self, n_copies, in_features, out_features, bias)
        self.add_buffers()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: input, (B, in) shared by the copies or (E, B, in)
        :return: output, (E, B, out)
        """
        return self.multiply(x, self.normalized_weight())
