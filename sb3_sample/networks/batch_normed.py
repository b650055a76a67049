"""Multi-layer perceptrons with batch norm: the networks of CrossQ, CrossQ+WN and XQC."""

from collections.abc import Sequence

import torch
from torch import nn

from sb3_sample.kinds import TRUE_OR_FALSE, check_value, integer, one_of
from sb3_sample.networks.batch_norm import BatchNorm, BatchRenorm
from sb3_sample.networks.ensemble import Dense
from sb3_sample.networks.initialization import linear
from sb3_sample.networks.network import HiddenUnits, Network
from sb3_sample.networks.unit_norm import UnitNorm, project_weights


class BatchNormedMLP(Network):
    """
    Base class: batch norm of the input, then hidden layers of a dense layer, a norm and an activation.

    In the critics' step current and next rows are stacked, so that they are normalised by the moments of both.
    """

    def _make(
        self,
        in_features: int,
        hidden_sizes: Sequence[int],
        activation_fn: type[nn.Module],
        norms: Sequence[BatchNorm],
        n_copies: int | None,
        bias: bool,
        unit_norm: bool,
        kernels: str = "orthogonal",
    ) -> None:
        self.input_norm, *of_layers = norms
        self.dense = nn.ModuleList()
        for width in hidden_sizes:
            layer = linear(in_features, width, n_copies, bias=bias, unit_norm=unit_norm, kernels=kernels)
            if isinstance(layer, UnitNorm):
                layer.joint_bias = bias
            self.dense.append(layer)
            in_features = width
        self.norms = nn.ModuleList(of_layers)
        self.activations = nn.ModuleList(activation_fn() for _ in hidden_sizes)
        self.out_features, self.has_unit_norm, self.kernels = in_features, unit_norm, kernels

    def make_head(self, n_outputs: int, n_copies: int | None = None, gain: float | None = None) -> nn.Module:
        gain = self.head_gain if gain is None else gain
        return linear(
            self.out_features, n_outputs, n_copies, gain=gain, unit_norm=self.has_unit_norm, kernels=self.kernels
        )

    def project(self) -> None:
        if self.has_unit_norm:
            project_weights(self)

    def hidden_units(self, head: Dense | None) -> list[HiddenUnits]:
        """
        The neurons are listed for inspection, not for recycling: a batch norm stands between them and their readers or,
        with weights of unit norm, ReDo's fresh weights have another length.

        :param head: the layer that reads the network's output; not used here
        :return: every hidden layer, in the order of the forward pass
        """
        layers = zip(self.dense, self.activations, strict=True)
        return [
            HiddenUnits(f"dense.{k}", dense, None, activation, None)  # type: ignore[arg-type]
            for k, (dense, activation) in enumerate(layers)
        ]


def _check_sizes(cls: type[Network], hidden_sizes: Sequence[int]) -> None:
    if not all(map(integer(1).fits, hidden_sizes)):
        raise ValueError(f"{cls.__name__} needs hidden_sizes that are integers of at least 1, not {hidden_sizes!r}")


class CrossQNet(BatchNormedMLP):
    """
    CrossQ's trunk (Bhatt et al. 2024): batch (re)norm of the input, then Dense, activation, batch (re)norm.

    With ``weight_norm`` it is the trunk of CrossQ+WN: weights and bias of each hidden unit together have length 1, and
    so do the weights of each unit of the output layer; critics have targets, and the actor's running moments move even
    in gradient steps in which it does not learn.

    :param in_features: width of the input
    :param hidden_sizes: widths of the hidden layers
    :param activation_fn: activation after each hidden layer
    :param weight_norm: whether units have weights of length 1
    :param renorm_warm_up: training passes of batch norm before batch renormalisation; None: batch norm throughout
    :param unbiased: whether variances are unbiased, as in sb3_contrib, and not biased, as in the published code
    :param kernels: distribution of the kernels at initialisation, the output layer's included: "orthogonal", or
        "lecun_normal" as in the published code of CrossQ
    :param eps: added to the variance
    :param momentum: share of the batch in the running moments, in (0, 1]
    :param n_copies: E for E independent networks, None for one
    :raises ValueError: if an argument is out of range
    """

    def __init__(
        self,
        in_features: int,
        hidden_sizes: Sequence[int] = (256, 256),
        activation_fn: type[nn.Module] = nn.ReLU,
        weight_norm: bool = False,
        renorm_warm_up: int | None = 100_000,
        unbiased: bool = True,
        kernels: str = "orthogonal",
        eps: float = 1e-3,
        momentum: float = 0.01,
        n_copies: int | None = None,
    ):
        super().__init__()
        _check_sizes(type(self), hidden_sizes)
        check_value("weight_norm", weight_norm, TRUE_OR_FALSE)
        check_value("renorm_warm_up", renorm_warm_up, integer(0).or_none("batch norm"))
        check_value("unbiased", unbiased, TRUE_OR_FALSE)
        check_value("kernels", kernels, one_of(("orthogonal", "lecun_normal")))

        def norm(width: int) -> BatchNorm:
            if renorm_warm_up is None:
                return BatchNorm(width, n_copies, eps, momentum, unbiased)
            return BatchRenorm(width, n_copies, eps, momentum, unbiased, renorm_warm_up)

        norms = [norm(width) for width in (in_features, *hidden_sizes)]
        self._make(
            in_features, hidden_sizes, activation_fn, norms, n_copies, bias=True, unit_norm=weight_norm, kernels=kernels
        )
        self.stacks_rows = "target" if weight_norm else "online"
        self.statistics_every_step = weight_norm

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, out_features), or (E, B, out_features) if there are copies
        """
        h = self.input_norm(x)
        for dense, activation, norm in zip(self.dense, self.activations, self.norms, strict=True):
            h = norm(activation(dense(h)))
        return h


class XQCNet(BatchNormedMLP):
    """
    XQC's trunk (Palenicek et al. 2026): batch norm of the input, then Dense without bias, batch norm, activation. The
    units of all dense layers, the output layer included, have input weights of length 1, which :meth:`project` restores
    after each step of the optimizer. Critics have targets, in training mode; the actor's running moments move even in
    gradient steps in which it does not learn.

    :param in_features: width of the input
    :param hidden_sizes: widths of the hidden layers
    :param activation_fn: activation of each hidden layer
    :param eps: added to the variance
    :param momentum: share of the batch in the running moments, in (0, 1]
    :param n_copies: E for E independent networks, None for one
    :raises ValueError: if an argument is out of range
    """

    stacks_rows = "target"
    statistics_every_step = True

    def __init__(
        self,
        in_features: int,
        hidden_sizes: Sequence[int] = (512, 512, 512, 512),
        activation_fn: type[nn.Module] = nn.ReLU,
        eps: float = 1e-3,
        momentum: float = 0.01,
        n_copies: int | None = None,
    ):
        super().__init__()
        _check_sizes(type(self), hidden_sizes)
        norms = [BatchNorm(width, n_copies, eps, momentum) for width in (in_features, *hidden_sizes)]
        self._make(in_features, hidden_sizes, activation_fn, norms, n_copies, bias=False, unit_norm=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """
        :param x: (B, in), or (E, B, in) if there are copies
        :return: (B, out_features), or (E, B, out_features) if there are copies
        """
        h = self.input_norm(x)
        for dense, norm, activation in zip(self.dense, self.norms, self.activations, strict=True):
            h = activation(norm(dense(h)))
        return h
