"""Networks of SPR: encoder, transition model, projection, predictor and return distributions of all actions."""

import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import nn
from torch.nn import functional as F

from sb3_sample.networks.bronet import ResidualBlock
from sb3_sample.networks.ensemble import layer_norm

#: Layers between latent state and output layers, by the value of ``network``. "nature": a Dense layer, which is also
#: SPR's projection, and ReLU. "bronet": BroNet in its place, whose first Dense layer is the projection.
#: "bronet_after_projection": the projection, followed by BroNet.
NETWORKS = ("nature", "bronet", "bronet_after_projection")
#: Modules that a reset reinitialises; the others keep a share of their parameters.
FRESH = ("projection", "predictor", "head")


def renormalize(latent: torch.Tensor) -> torch.Tensor:
    """
    Scale each latent state to [0, 1] by its minimum and maximum.

    :param latent: (B, ...)
    :return: ``(x - min) / (max - min + 1e-5)``, of the same shape
    """
    flat = latent.flatten(1)
    low, high = flat.amin(dim=1), flat.amax(dim=1)
    shape = (-1, *[1] * (latent.dim() - 1))
    return (latent - low.view(shape)) / (high - low + 1e-5).view(shape)


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """
    Compute the padding with which a convolution outputs ``ceil(size / stride)`` numbers, as TensorFlow's and JAX's
    "SAME".

    :param size: of the input
    :param kernel: of the convolution
    :param stride: of the convolution
    :return: zeros before and after the input; the odd one comes after
    """
    total = max((math.ceil(size / stride) - 1) * stride + kernel - size, 0)
    return total // 2, total - total // 2


class Encoder(nn.Module):
    """
    The convolutions of DQN (Mnih et al. 2015) with padded borders, ReLU after each, and latent states scaled to [0, 1].

    :param shape: of an observation, (C, height, width)
    :param channels: of the three layers
    """

    LAYERS = ((8, 4), (4, 2), (3, 1))

    def __init__(self, shape: tuple[int, ...], channels: Sequence[int] = (32, 64, 64)):
        super().__init__()
        n_in, *sizes = shape
        self._paddings: list[tuple[int, ...]] = []
        convolutions = []
        for n_out, (kernel, stride) in zip(channels, self.LAYERS, strict=True):
            (top, bottom), (left, right) = (same_padding(size, kernel, stride) for size in sizes)
            # Equal padding on all sides costs nothing inside the convolution.
            inside = (top, left) if (top, left) == (bottom, right) else (0, 0)
            self._paddings.append(() if inside == (top, left) else (left, right, top, bottom))
            convolutions.append(nn.Conv2d(n_in, n_out, kernel, stride, padding=inside))
            n_in, sizes = n_out, [math.ceil(size / stride) for size in sizes]
        self.convolutions = nn.ModuleList(convolutions)
        #: Shape of a latent state, (C, height, width).
        self.latent_shape = (n_in, *sizes)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """
        :param observations: floats in [0, 1], (B, C, height, width)
        :return: latent states in [0, 1], (B, *latent_shape)
        """
        x = observations
        for convolution, padding in zip(self.convolutions, self._paddings, strict=True):
            x = F.relu(convolution(F.pad(x, padding) if padding else x))
        return renormalize(x)


class TransitionModel(nn.Module):
    """
    Latent state after an action: two convolutions on the state and one constant plane per action, 1 for the action
    taken, else 0.

    :param n_channels: C of a latent state
    :param n_actions: number of actions
    """

    def __init__(self, n_channels: int, n_actions: int):
        super().__init__()
        self.n_actions = n_actions
        self.conv1 = nn.Conv2d(n_channels + n_actions, n_channels, 3, padding=1)
        self.conv2 = nn.Conv2d(n_channels, n_channels, 3, padding=1)

    def forward(self, latent: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """
        :param latent: (B, C, height, width)
        :param actions: their numbers, (B,)
        :return: the next latent states, in [0, 1], (B, C, height, width)
        """
        planes = (actions.unsqueeze(1) == torch.arange(self.n_actions, device=actions.device)).to(latent.dtype)
        planes = planes[:, :, None, None].expand(-1, -1, *latent.shape[2:])
        return renormalize(F.relu(self.conv2(F.relu(self.conv1(torch.cat((latent, planes), dim=1))))))


class NoisyLinear(nn.Module):
    """
    Dense layer whose weights have learned, factorised Gaussian noise (Fortunato et al. 2018). The two factors of each
    draw are independent. The noise is drawn by :meth:`draw`; without it, the layer uses the means of its weights.

    :param n_in: width of the input
    :param n_out: width of the output
    """

    noise_in: torch.Tensor
    noise_out: torch.Tensor

    def __init__(self, n_in: int, n_out: int):
        super().__init__()
        bound = 1 / math.sqrt(n_in)
        self.weight = nn.Parameter(torch.empty(n_out, n_in).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(n_out).uniform_(-bound, bound))
        self.weight_scale = nn.Parameter(torch.full((n_out, n_in), 0.5 * bound))
        self.bias_scale = nn.Parameter(torch.full((n_out,), 0.5 * bound))
        self.register_buffer("noise_in", torch.zeros(n_in), persistent=False)
        self.register_buffer("noise_out", torch.zeros(n_out), persistent=False)

    @torch.no_grad()
    def draw(self) -> None:
        """Draw noise for all following computations."""
        for noise in (self.noise_in, self.noise_out):
            x = torch.randn_like(noise)
            noise.copy_(x.sign() * x.abs().sqrt())

    @torch.no_grad()
    def silence(self) -> None:
        """Use the means in all following computations."""
        self.noise_in.zero_()
        self.noise_out.zero_()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in)
        :return: (B, out)
        """
        noisy = F.linear(x * self.noise_in, self.weight_scale) * self.noise_out
        return F.linear(x, self.weight, self.bias) + noisy + self.bias_scale * self.noise_out


class Head(nn.Module):
    """
    From projections to logits of the return distribution: the layers named by ``network``, and dueling output layers
    (Wang et al. 2016).

    :param network: one of :data:`NETWORKS`
    :param n_in: width of a projection
    :param n_actions: number of actions
    :param n_atoms: atoms of a distribution
    :param width: of BroNet
    :param n_blocks: of BroNet
    :param dueling: whether logits are the state's logits plus the action's, minus the mean over the actions
    :param dense: makes a Dense layer of two widths
    """

    def __init__(
        self,
        network: str,
        n_in: int,
        n_actions: int,
        n_atoms: int,
        width: int,
        n_blocks: int,
        dueling: bool,
        dense: Callable[[int, int], nn.Module],
    ):
        super().__init__()
        self.n_actions, self.n_atoms = n_actions, n_atoms
        width = width if network == "bronet_after_projection" else n_in
        self.dense = dense(n_in, width) if network == "bronet_after_projection" else None
        self.norm = None if network == "nature" else layer_norm(width, None)
        blocks = 0 if network == "nature" else n_blocks
        self.blocks = nn.ModuleList(ResidualBlock(width, None) for _ in range(blocks))
        self.value = dense(width, n_atoms) if dueling else None
        self.advantage = dense(width, n_actions * n_atoms)

    def forward(self, projected: torch.Tensor) -> torch.Tensor:
        """
        :param projected: (B, in)
        :return: logits of every action, (B, A, K)
        """
        h = projected if self.dense is None else self.dense(projected)
        h = F.relu(h if self.norm is None else self.norm(h))
        for block in self.blocks:
            h = block(h)
        logits: torch.Tensor = self.advantage(h).view(-1, self.n_actions, self.n_atoms)
        if self.value is None:
            return logits
        return logits - logits.mean(dim=1, keepdim=True) + self.value(h).unsqueeze(1)


class SPRNetwork(nn.Module):
    """
    Network of SR-SPR (Schwarzer et al. 2021; D'Oro et al. 2023; BRO, appendix E).

    Kernels are initialised by Xavier's uniform distribution, biases by zero.

    :param shape: of an observation, (C, height, width)
    :param n_actions: number of actions
    :param network: one of :data:`NETWORKS`
    :param n_atoms: atoms of the distribution of returns
    :param channels: of the encoder's layers
    :param width: of projection, predictor and BroNet
    :param n_blocks: of BroNet
    :param dueling: see :class:`Head`
    :param noisy: whether projection and head have noisy layers
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        n_actions: int,
        network: str = "nature",
        n_atoms: int = 51,
        channels: Sequence[int] = (32, 64, 64),
        width: int = 512,
        n_blocks: int = 2,
        dueling: bool = True,
        noisy: bool = False,
    ):
        super().__init__()
        self.noisy = noisy
        dense: Callable[[int, int], nn.Module] = NoisyLinear if noisy else nn.Linear
        self.encoder = Encoder(shape, channels)
        self.transition = TransitionModel(channels[-1], n_actions)
        self.projection = dense(math.prod(self.encoder.latent_shape), width)
        self.predictor = nn.Linear(width, width)
        self.head = Head(network, width, n_actions, n_atoms, width, n_blocks, dueling, dense)
        for module in self.modules():
            if isinstance(module, (nn.Conv2d, nn.Linear)):
                nn.init.xavier_uniform_(module.weight)
                assert module.bias is not None
                nn.init.zeros_(module.bias)

    def noisy_layers(self) -> Iterator[NoisyLinear]:
        """
        List the noisy layers.

        :return: the layers; none if the network has no noise
        """
        return (module for module in (self.modules() if self.noisy else ()) if isinstance(module, NoisyLinear))

    def project(self, latent: torch.Tensor) -> torch.Tensor:
        """
        Project latent states.

        :param latent: (B, C, height, width)
        :return: projections, (B, width)
        """
        # In channels-first order, whatever the memory format.
        projected: torch.Tensor = self.projection(latent.flatten(1))
        return projected

    def logits(self, latent: torch.Tensor) -> torch.Tensor:
        """
        Compute the distributions of the returns.

        :param latent: (B, C, height, width)
        :return: logits of every action's atoms, (B, A, K)
        """
        logits: torch.Tensor = self.head(self.project(latent))
        return logits

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """
        :param observations: floats in [0, 1], (B, C, height, width)
        :return: logits of every action's atoms, (B, A, K)
        """
        return self.logits(self.encoder(observations))
