"""Training and evaluation mode of modules."""

from typing import Any

import torch
from torch import nn


def evaluated(module: nn.Module) -> Any:
    """
    Make a view of a module that stays in evaluation mode, whatever the mode of the module: running statistics are read
    but not updated, dropout is off. Parameters and buffers are the module's own, even after it was moved to a device,
    loaded or copied together with its view. A scripted module, which has one mode, is its own view.

    :param module: the module
    :return: a module of the same class; hold it where it is not registered as a submodule
    """
    views: dict[int, nn.Module] = {}

    def view(of: nn.Module) -> nn.Module:
        if isinstance(of, torch.jit.ScriptModule):
            return of
        if id(of) not in views:
            made = views[id(of)] = object.__new__(type(of))
            # The dicts of parameters and buffers are shared, the one of modules is not.
            vars(made).update(vars(of))
            children = {name: None if child is None else view(child) for name, child in of._modules.items()}
            vars(made).update(_modules=children, training=False)
        return views[id(of)]

    return view(module)


class ModeSwitch:
    """
    Switch of modules and all their submodules between training and evaluation mode, without the overhead of
    ``nn.Module.train``, which takes as long as a small network's forward pass.

    :param roots: the modules; their submodules must not change afterwards
    """

    def __init__(self, *roots: nn.Module):
        # ``train`` is called on a module that overrides it (to keep its batch norm in evaluation mode, say), and on one
        # whose attributes are not Python's.
        def is_special(m: nn.Module) -> bool:
            return type(m).train is not nn.Module.train or isinstance(m, torch.jit.ScriptModule)

        self._own = [root for root in roots if any(map(is_special, root.modules()))]
        self._plain = [m for root in roots if root not in self._own for m in root.modules()]

    def __call__(self, mode: bool) -> None:
        """
        :param mode: training (True) or evaluation mode
        """
        for module in self._plain:
            # Same effect as nn.Module's own setattr on this attribute, without its lookups.
            module.__dict__["training"] = mode
        for root in self._own:
            root.train(mode)
