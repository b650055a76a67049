"""Separate plain networks out of a stack of copies."""

import torch
from torch import nn

from sb3_sample.networks import EnsembleLinear


def randomize(module: nn.Module) -> None:
    """Every parameter at random, so that no zero bias or unit scale hides a mistake."""
    with torch.no_grad():
        for p in module.parameters():
            p.copy_(torch.randn_like(p))


@torch.no_grad()
def take_copy(single: nn.Module, stack: nn.Module, e: int) -> None:
    """Give a network without copies the parameters and buffers of copy e of a stack, which has the same modules."""
    for (name, ours), (other, theirs) in zip(single.named_modules(), stack.named_modules(), strict=True):
        assert name == other
        tensors = [*ours.named_parameters(recurse=False), *ours.named_buffers(recurse=False)]
        for key, value in tensors:
            source = getattr(theirs, key)[e]
            if isinstance(theirs, EnsembleLinear) and key != "bias":
                # (in, out) against (out, in): u and v change their places.
                source = source.t() if key == "weight" else getattr(theirs, {"u": "v", "v": "u"}[key])[e]
            value.copy_(source.reshape(value.shape))
