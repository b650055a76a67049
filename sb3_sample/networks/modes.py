"""Training and evaluation mode of modules."""

import torch
from torch import nn


class ModeSwitch:
    """
    Training and evaluation mode of modules and all that is in them, without the detours of
    ``nn.Module.train``, which takes as long as a small network's forward pass.

    :param roots: the modules; what they hold must not change afterwards
    """

    def __init__(self, *roots: nn.Module):
        # A module with a train of its own is asked (one that keeps its batch norm in evaluation mode, say), and so is
        # one whose attributes are not Python's.
        def is_special(m: nn.Module) -> bool:
            return type(m).train is not nn.Module.train or isinstance(m, torch.jit.ScriptModule)

        self._own = [root for root in roots if any(map(is_special, root.modules()))]
        self._plain = [m for root in roots if root not in self._own for m in root.modules()]

    def __call__(self, mode: bool) -> None:
        """
        :param mode: training (True) or evaluation mode
        """
        for module in self._plain:
            # The effect of nn.Module's own setattr on this attribute, without its search for much else.
            module.__dict__["training"] = mode
        for root in self._own:
            root.train(mode)
