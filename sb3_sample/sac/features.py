"""Features of observations, as Stable-Baselines3 makes them, by operations on tensors only."""

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.preprocessing import preprocess_obs
from torch import nn

from sb3_sample.networks import RunningNorm
from sb3_sample.networks.modes import evaluated


class TensorFeatures:
    """Part of actors, critics and policies, before Stable-Baselines3's class: their features of observations."""

    observation_space: spaces.Space[Any]
    normalize_images: bool

    def extract_features(self, obs: Any, features_extractor: Any) -> torch.Tensor:
        """
        Extract features, as in Stable-Baselines3.

        :param obs: (B, O), or a dict of them
        :param features_extractor: features extractor
        :return: features, (B, F)
        """
        found: torch.Tensor = features_extractor(_preprocessed(obs, self.observation_space, self.normalize_images))
        return found


class NetworkFeatures(TensorFeatures):
    """The same for actors and critics, which read observations through the policy's normalisation if it has one."""

    #: The policy's running normalisation of observations, None for none.
    observation_norm: RunningNorm | None = None

    def save(self, path: str) -> None:
        """
        Save the network alone, as in Stable-Baselines3.

        :param path: path of the file
        :raises ValueError: observations are normalised by the policy's statistics, which the file would be without
        """
        if self.observation_norm is not None:
            raise ValueError(
                f"the file of a {type(self).__name__} would be without the statistics that its observations are "
                "normalised by, which are the policy's: save the policy (model.policy.save) or the model"
            )
        super().save(path)  # type: ignore[misc]


def share(network: Any, encoder: nn.Module) -> None:
    """
    Have a network read the features of another module's extractor, without a gradient to it and in evaluation mode:
    only its owner's forward passes update its running statistics.

    :param network: actor or critics; their ``_encoder`` is the view in evaluation mode
    :param encoder: features extractor, which is in the parameters, the state and the modes of its owner only
    """
    network._modules.pop("features_extractor", None)
    # Bypass nn.Module's own setattr, which would register them.
    vars(network).update(features_extractor=encoder, _encoder=evaluated(encoder))


def _preprocessed(observations: Any, space: spaces.Space[Any], normalize_images: bool) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _preprocessed(observations[key], part, normalize_images) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Discrete):
        return _one_hot(observations - int(space.start), int(space.n))
    if isinstance(space, spaces.MultiDiscrete):
        columns = zip(observations.split(1, dim=1), space.nvec, space.start, strict=True)
        return torch.cat([_one_hot(column.squeeze(1) - int(first), int(n)) for column, n, first in columns], dim=-1)
    return preprocess_obs(observations, space, normalize_images)


def _one_hot(numbers: torch.Tensor, n: int) -> torch.Tensor:
    """As ``torch.nn.functional.one_hot``, but without reading the largest number on the host."""
    return (numbers.long().unsqueeze(-1) == torch.arange(n, device=numbers.device)).float()
