"""Observations in the forms that callers pass: tensors or arrays, one or a batch, alone or in a dict."""

from typing import Any

import numpy as np
import torch


class Observations:
    """
    Observations as a batch of tensors, and the conversion of the chosen actions back to the caller's form.

    :param given: tensors or arrays, (B, O) or (O,), or a dict of either
    :param space: Gymnasium's observation space
    :param device: of the tensors
    :raises ValueError: if they have other keys or shapes than the space
    """

    def __init__(self, given: Any, space: Any, device: torch.device):
        keys = sorted(space.keys()) if hasattr(space, "keys") else None
        found = sorted(given) if isinstance(given, dict) else None
        if keys != found:
            wanted = "be a tensor or an array" if keys is None else f"have the keys {keys}"
            raise ValueError(f"observations must {wanted}, not {found or type(given).__name__}")
        entries = {"": (given, space)} if keys is None else {key: (given[key], space[key]) for key in keys}
        self._is_array, self._is_single = True, True
        tensors: dict[str, torch.Tensor] = {}
        for key, (value, of) in entries.items():
            self._is_array = not isinstance(value, torch.Tensor)
            shape = tuple(np.shape(value)) if self._is_array else tuple(value.shape)
            is_single = shape == of.shape
            # A batch of one may tell its task by a number alone.
            self._is_single = self._is_single and is_single
            # Integers of a Discrete space are (B,) or (B, 1).
            if not (is_single or (len(shape) > 0 and (shape[1:] == of.shape or of.shape == ()))):
                what = f"observations[{key!r}]" if key else "observations"
                batch = f"({', '.join(map(str, ('B', *of.shape)))}{',' if not of.shape else ''})"
                raise ValueError(f"{what} must have the shape {batch} or {of.shape}, not {shape}")
            tensor = torch.as_tensor(value, device=device)
            tensors[key] = tensor.unsqueeze(0) if is_single else tensor
        if len({len(tensor) for tensor in tensors.values()}) > 1:
            sizes = {key: len(tensor) for key, tensor in tensors.items()}
            raise ValueError(f"observations must be as many under each key, not {sizes}")
        #: Tensors, (B, O), or a dict of them.
        self.batch: Any = tensors[""] if keys is None else tensors

    def actions(self, actions: torch.Tensor) -> torch.Tensor | np.ndarray:
        """
        Convert actions to the kind of the observations.

        :param actions: (B, A)
        :return: a tensor for tensors, an array for arrays; (B, A), or (A,) for a single observation
        """
        actions = actions[0] if self._is_single else actions
        return actions.cpu().numpy() if self._is_array else actions
