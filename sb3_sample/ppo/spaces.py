"""Observations and actions as the learned models see them: flat vectors of numbers."""

from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

Array = TypeVar("Array", np.ndarray, torch.Tensor)


class FlatObservations:
    """
    Convert observations to vectors and back. The entries of a Dict are concatenated in the order of its keys.

    :param space: a Box of floats, or a Dict of such Boxes
    :param images: whether Boxes of integers, such as images, are also allowed
    :param plain: the argument that gives plain PPO, for the error message; None where there is no such argument
    :raises ValueError: for any other space
    """

    def __init__(self, space: spaces.Space, images: bool = False, plain: str | None = "n_simulated=0"):
        self.keys = list(space.spaces) if isinstance(space, spaces.Dict) else None
        parts = list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]
        self.shapes: list[tuple[int, ...]] = []
        for part in parts:
            is_box = isinstance(part, spaces.Box)
            if not is_box or (not images and (not np.issubdtype(part.dtype, np.floating) or is_image_space(part))):
                kind = "Box" if images else "Box of floats"
                why = "" if images else ", whose next values can be predicted"
                advice = "" if plain is None else f": pass {plain} for plain PPO"
                raise ValueError(
                    f"the observation space must be a {kind} or a Dict of such Boxes{why}, not {space}{advice}"
                )
            assert isinstance(part, spaces.Box)
            self.shapes.append(part.shape)
        self.sizes = [int(np.prod(shape)) for shape in self.shapes]
        #: O, the length of a vector.
        self.size = sum(self.sizes)

    def flatten(self, observations: Any) -> np.ndarray:
        """
        :param observations: a batch of observations in the space's own form
        :return: (B, O), float32
        """
        parts = [observations] if self.keys is None else [observations[key] for key in self.keys]
        flat = [np.asarray(part, np.float32).reshape(-1, size) for part, size in zip(parts, self.sizes, strict=True)]
        return flat[0] if self.keys is None else np.concatenate(flat, axis=1)

    def restore(self, flat: Array) -> Any:
        """
        :param flat: (B, O), an array or a tensor
        :return: the same batch in the space's own form, as the policy takes it
        """
        if self.keys is None:
            return flat.reshape(len(flat), *self.shapes[0])
        restored, first = {}, 0
        for key, shape, size in zip(self.keys, self.shapes, self.sizes, strict=True):
            restored[key] = flat[:, first : first + size].reshape(len(flat), *shape)
            first += size
        return restored


class ModelActions:
    """
    Actions in the form of the models' input. Actions of a Box are clipped to its bounds, as the environment receives
    them, and scaled to [-1, 1]; actions of a Discrete space are one-hot vectors.

    :param space: a bounded Box or a Discrete space
    :param device: where the models are
    """

    def __init__(self, space: spaces.Space, device: torch.device):
        self.is_discrete = isinstance(space, spaces.Discrete)
        if isinstance(space, spaces.Discrete):
            #: D, the length of a vector.
            self.size = int(space.n)
            return
        assert isinstance(space, spaces.Box)
        self.size = int(np.prod(space.shape))
        low, high = space.low.astype(np.float64).ravel(), space.high.astype(np.float64).ravel()
        middle, half = (low + high) / 2, (high - low) / 2
        half[half == 0] = 1  # an entry with one value

        def tensor(x: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(x, dtype=torch.float32, device=device)

        self._low, self._high, self._middle, self._half = tensor(low), tensor(high), tensor(middle), tensor(half)

    def __call__(self, actions: torch.Tensor) -> torch.Tensor:
        """
        :param actions: the policy's actions, (..., A), or (...) integers of a Discrete space
        :return: (..., D)
        """
        if self.is_discrete:
            return F.one_hot(actions.long(), self.size).float()
        clipped = torch.minimum(torch.maximum(actions, self._low), self._high)
        return (clipped - self._middle) / self._half
