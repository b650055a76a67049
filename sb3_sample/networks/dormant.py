"""
Dormant neurons: how active each hidden neuron is, and new weights for those that are not (ReDo, Sokar et al. 2023).

Shapes: E copies, N neurons of a layer, B batch. A network without copies has no axis E.
"""

import torch
from torch import nn

from sb3_sample.networks.activations import width_factor
from sb3_sample.networks.ensemble import Dense, EnsembleLinear
from sb3_sample.networks.network import HiddenUnits, Network
from sb3_sample.networks.spectral_norm import SpectralNorm


@torch.no_grad()
def neuron_scores(trunk: Network, head: Dense | None, x: torch.Tensor) -> dict[str, torch.Tensor]:
    """
    Score of each hidden neuron's activity (Sokar et al. 2023, equation 1): the mean over the batch of its absolute
    activation, divided by the average of these means over the neurons of its layer. A neuron is τ-dormant if its score
    is at most τ. The scores of a layer average 1, or are all 0 if the whole layer is silent. The two halves of a CReLU
    neuron are added up. Dropout is off.

    :param trunk: the network
    :param head: the layer that reads the network's output, None if several do
    :param x: a batch of the network's inputs, (B, in) or (E, B, in)
    :return: scores by the name of the layer, (E, N), or (N,) without copies
    """
    scores: dict[str, torch.Tensor] = {}
    modes = {module: module.training for module in trunk.modules()}
    hooks = []
    try:
        for units in trunk.hidden_units(head):
            hooks.append(units.activation.register_forward_hook(_Measure(scores, units.name)))
        trunk.eval()
        trunk(x)
    finally:
        for hook in hooks:
            hook.remove()
        for module, mode in modes.items():
            module.training = mode
    return scores


class _Measure:
    """A forward hook that records the scores of a layer."""

    def __init__(self, scores: dict[str, torch.Tensor], name: str):
        self.scores, self.name = scores, name

    def __call__(self, activation: nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        activity = output.abs().mean(dim=-2).unflatten(-1, (width_factor(activation), -1)).sum(dim=-2)
        mean = activity.mean(dim=-1, keepdim=True)
        self.scores[self.name] = torch.where(mean == 0, 0.0, activity / mean)


@torch.no_grad()
def recycle(
    trunk: Network,
    head: Dense | None,
    x: torch.Tensor,
    threshold: float,
    optimizer: torch.optim.Optimizer | None = None,
) -> torch.Tensor:
    """
    ReDo (Sokar et al. 2023, algorithm 1): give dormant neurons, those with a score of at most ``threshold``, new
    incoming weights and no outgoing ones, so that a neuron that was silent leaves the output as it was and can learn
    again. Each copy has its own dormant neurons.

    The incoming weights are columns of a kernel drawn as at initialisation (``HiddenUnits.draw``); the bias is 0, scale
    and shift of a layer norm 1 and 0. All layers are scored first, and a weight between two dormant neurons ends at 0,
    as in the published code. The output does change where a layer norm follows, which reads the new neuron with the
    others, and where the kernel of a spectral norm has changed.

    Nothing is copied to the host. Neurons of which something is frozen (``requires_grad_(False)``) are left alone.

    :param trunk: the network
    :param head: the layer that reads the network's output, None if several do (the last neurons are then left alone)
    :param x: a batch of the network's inputs, (B, in) or (E, B, in)
    :param threshold: τ, at least 0; 0 recycles the silent neurons only
    :param optimizer: its state for exactly the weights that change (Adam's moments) is set to zero
    :return: the number of recycled neurons over all layers and copies, a tensor of shape ()
    :raises ValueError: if ``threshold`` is below 0
    """
    if not threshold >= 0:
        raise ValueError(f"threshold must be at least 0, not {threshold}")
    scores = neuron_scores(trunk, head, x)
    recyclable = [units for units in trunk.hidden_units(head) if units.outgoing is not None and not _frozen(units)]
    layers = [(units, scores[units.name] <= threshold) for units in recyclable]
    n_recycled = torch.zeros((), dtype=torch.long, device=x.device)
    for units, dormant in layers:
        n_recycled += dormant.sum()
        weight = units.dense.weight
        _overwrite(weight, _columns(dormant, units.dense), units.draw(torch.empty_like(weight)), optimizer)
        per_neuron = dormant if dormant.dim() == 1 else dormant.unsqueeze(-2)
        if units.dense.bias is not None:
            _overwrite(units.dense.bias, per_neuron, 0.0, optimizer)
        if units.norm is not None:
            _overwrite(units.norm.weight, per_neuron, 1.0, optimizer)
            _overwrite(units.norm.bias, per_neuron, 0.0, optimizer)
    for units, dormant in layers:
        assert units.outgoing is not None
        outputs = torch.cat([dormant] * width_factor(units.activation), dim=-1)
        _overwrite(units.outgoing.weight, _rows(outputs, units.outgoing), 0.0, optimizer)
    for layer in {layer for units, _ in layers for layer in (units.dense, units.outgoing)}:
        if isinstance(layer, SpectralNorm):
            layer.find_direction()
    return n_recycled


def _frozen(units: HiddenUnits) -> bool:
    """Whether something is frozen that recycling would change."""
    layers = (units.dense, units.norm, units.outgoing)
    return not all(p.requires_grad for layer in layers if layer is not None for p in layer.parameters())


def _columns(mask: torch.Tensor, layer: Dense) -> torch.Tensor:
    """A mask of the layer's outputs, (E, out) or (out,), against its weight: (E, in, out), or (out, in)."""
    return mask.unsqueeze(-2) if isinstance(layer, EnsembleLinear) else mask.unsqueeze(-1)


def _rows(mask: torch.Tensor, layer: Dense) -> torch.Tensor:
    """A mask of the layer's inputs, (E, in) or (in,), against its weight: (E, in, out), or (out, in)."""
    return mask.unsqueeze(-1) if isinstance(layer, EnsembleLinear) else mask.unsqueeze(-2)


def _overwrite(
    parameter: torch.Tensor,
    mask: torch.Tensor,
    value: torch.Tensor | float,
    optimizer: torch.optim.Optimizer | None,
) -> None:
    """Set the masked elements to a value, and the optimizer's state for them to zero."""
    parameter.copy_(torch.where(mask, value, parameter))
    state = {} if optimizer is None else optimizer.state.get(parameter, {})
    for tensor in state.values():
        if isinstance(tensor, torch.Tensor) and tensor.shape == parameter.shape:
            tensor.masked_fill_(mask, 0)
