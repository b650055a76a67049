"""Steps of optimizers and of targets within a gradient step: of one learner, or of many whose networks are stacked."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch.optim import Optimizer

from sb3_sample.optim import AdamW, gradients_of
from sb3_sample.tracing import is_tracing


def minimize(optimizer: Optimizer, loss: torch.Tensor) -> None:
    """
    Take one step of an optimizer. Only its own parameters get a gradient, even if the loss depends on others.

    :param optimizer: the optimizer
    :param loss: scalar
    """
    descend(optimizer, gradients_of(loss, parameters_of(optimizer)))


def follow(target: Any, online: Any, tau: float) -> None:
    """
    Take one step of Polyak averaging of the parameters.

    :param target: network that follows
    :param online: network that is followed; leading parameters that the target lacks are left out, such as the encoder
        of critics whose targets have none
    :param tau: weight of the online network
    """
    ours, theirs = list(target.parameters()), list(online.parameters())
    with torch.no_grad():
        torch._foreach_lerp_(ours, theirs[len(theirs) - len(ours) :], weight=tau)


def parameters_of(optimizer: Optimizer) -> list[torch.Tensor]:
    """
    List the parameters of an optimizer.

    :param optimizer: the optimizer
    :return: its parameters, group by group
    """
    return [p for group in optimizer.param_groups for p in group["params"]]


def descend(optimizer: Optimizer, gradients: Sequence[torch.Tensor | None]) -> None:
    """
    Take one step of an optimizer with given gradients.

    :param optimizer: the optimizer
    :param gradients: in the order of its parameters; None leaves a parameter alone
    """
    if is_tracing():
        assert isinstance(optimizer, AdamW)
        optimizer.apply(gradients)
        return
    for parameter, gradient in zip(parameters_of(optimizer), gradients, strict=True):
        parameter.grad = gradient
    optimizer.step()


class _Minimize(torch.autograd.Function):
    """
    Optimizer step of S learners inside ``torch.vmap``, where the losses of all learners are available: the gradient of
    their sum holds each learner's own, as nothing couples the learners.
    """

    @staticmethod
    def forward(loss: torch.Tensor, optimizer: AdamW) -> torch.Tensor:
        raise NotImplementedError("inside of torch.vmap only")

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Keep nothing: the result is never differentiated."""

    @staticmethod
    def vmap(info: Any, in_dims: Any, losses: torch.Tensor, optimizer: AdamW) -> tuple[torch.Tensor, int]:
        optimizer.apply(gradients_of(losses.sum(), parameters_of(optimizer)))
        return losses.detach(), 0


class StackedDescent:
    """
    Steps of S learners' optimizers and targets, inside ``torch.vmap`` over the learners.

    :param optimizers: optimizers of the stacked parameters, by the ``id`` of one learner's optimizer
    :param parameters: stacked parameters, (S, ...) each, by the ``id`` of one learner's network
    """

    def __init__(self, optimizers: Mapping[int, AdamW], parameters: Mapping[int, list[torch.Tensor]]):
        self._optimizers, self._parameters = optimizers, parameters
        #: Weights of the online networks, a number or (S,).
        self.tau: float | torch.Tensor = 0.0

    def minimize(self, optimizer: Optimizer, loss: torch.Tensor) -> None:
        """
        Take one step of each learner's optimizer.

        :param optimizer: optimizer of the learner whose networks computed the loss
        :param loss: scalar
        """
        _Minimize.apply(loss, self._optimizers[id(optimizer)])

    def follow(self, target: Any, online: Any, tau: Any) -> None:
        """
        Take one step of each learner's Polyak averaging.

        :param target: network that follows, of the learner whose networks compute the losses
        :param online: network that is followed
        :param tau: ignored, see :attr:`tau`
        """
        ours, theirs = self._parameters[id(target)], self._parameters[id(online)]
        theirs = theirs[len(theirs) - len(ours) :]
        with torch.no_grad():
            if not isinstance(self.tau, torch.Tensor):
                torch._foreach_lerp_(ours, theirs, weight=self.tau)
                return
            for p, q in zip(ours, theirs, strict=True):
                p.lerp_(q, self.tau.view(-1, *[1] * (p.dim() - 1)))
