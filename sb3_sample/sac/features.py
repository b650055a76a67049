"""Features of observations, as Stable-Baselines3 makes them, by operations on tensors only."""

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.preprocessing import preprocess_obs


def features_of(model: Any, observations: Any, extractor: Any) -> torch.Tensor:
    """
    Extract features.

    :param model: actor or critics, for the observation space and whether images are divided by 255
    :param observations: (B, O), or a dict of them
    :param extractor: features extractor
    :return: features, (B, F)
    """
    found: torch.Tensor = extractor(_preprocessed(observations, model.observation_space, model.normalize_images))
    return found


def _preprocessed(observations: Any, space: spaces.Space[Any], normalize_images: bool) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _preprocessed(observations[key], part, normalize_images) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Discrete):
        return _one_hot(observations, int(space.n))
    if isinstance(space, spaces.MultiDiscrete):
        columns = zip(observations.split(1, dim=1), space.nvec, strict=True)
        return torch.cat([_one_hot(column.squeeze(1), int(n)) for column, n in columns], dim=-1)
    return preprocess_obs(observations, space, normalize_images)


def _one_hot(numbers: torch.Tensor, n: int) -> torch.Tensor:
    """As ``torch.nn.functional.one_hot``, which looks at the largest number on the host."""
    return (numbers.long().unsqueeze(-1) == torch.arange(n, device=numbers.device)).float()
