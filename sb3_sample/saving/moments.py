"""Checks of an optimizer's state before torch takes it."""

from typing import Any

import torch

from sb3_sample.saving.untrusted import BadFile

#: State that the common optimizers keep for each parameter, in its shape. torch's fused kernels do not check it.
_MOMENTS = ("exp_avg", "exp_avg_sq", "max_exp_avg_sq", "momentum_buffer", "square_avg", "grad_avg")


def check_moments(optimizer: torch.optim.Optimizer, state: Any, name: str) -> None:
    """
    :param optimizer: the optimizer that is to take the state
    :param state: from a file
    :param name: what it is, for messages
    :raises BadFile: if it is no state of an optimizer of these parameters
    """
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    moments = state.get("state") if isinstance(state, dict) else None
    groups = state.get("param_groups") if isinstance(state, dict) else None
    if not isinstance(moments, dict) or not isinstance(groups, list):
        raise BadFile(f"{name} is no state of an optimizer")
    group_of: dict[int, int] = {}
    for n, group in enumerate(groups):
        indices = group.get("params") if isinstance(group, dict) else None
        if not isinstance(indices, list) or not all(type(i) is int for i in indices):
            raise BadFile(f"{name} does not say which parameters are in group {n}")
        group_of.update(dict.fromkeys(indices, n))
    place = {index: i for i, index in enumerate(group_of)}
    kinds: dict[Any, set[Any]] = {}
    for index, kept in moments.items():
        if index not in place or place[index] >= len(parameters) or not isinstance(kept, dict):
            raise BadFile(f"{name} keeps something of a parameter {index!r:.50} that is not there")
        shape = parameters[place[index]].shape
        for key, value in kept.items():
            wanted = shape if key in _MOMENTS else torch.Size(()) if key == "step" else None
            if wanted is not None and (not isinstance(value, torch.Tensor) or value.shape != wanted):
                raise BadFile(f"{name}: {key} of parameter {index} must be a tensor of shape {tuple(wanted)}")
        # An optimizer may keep other values for vectors than for matrices, but the same for all matrices.
        if kinds.setdefault((group_of[index], len(shape)), set(kept)) != set(kept):
            raise BadFile(f"{name} keeps {sorted(map(str, kept))} of parameter {index}, but others of other parameters")
