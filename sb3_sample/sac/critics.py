"""Ensemble of critics, and of target critics, of the off-policy family."""

import functools
from collections.abc import Callable
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
)
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_sample.learner.batch import Encoded
from sb3_sample.learner.q_values import QValues
from sb3_sample.networks import Network, project_weights
from sb3_sample.sac.features import NetworkFeatures, share
from sb3_sample.sac.trunks import keep_at_rest, make_trunk, with_plain_sizes


class CriticEnsemble(NetworkFeatures, BaseModel):
    """
    E critics with K outputs each, evaluated at once.

    :param observation_space: observation space
    :param action_space: action space
    :param network: class of the trunk
    :param network_kwargs: its arguments
    :param features_extractor: extractor of the observation's features, shared by the critics
    :param n_critics: E
    :param n_outputs: K, the number of quantiles, or 1
    :param normalize_images: whether images are divided by 255
    :param shares_encoder: whether the extractor belongs to other critics; its features are then read without gradient
        and in evaluation mode
    """

    action_space: spaces.Box
    #: View in evaluation mode, for all but the critics' own step, if the trunk ``stacks_rows``.
    at_rest: Any = None
    #: Whether the features extractor belongs to other critics.
    shares_encoder: bool = False
    #: The learner's value head, which says what the outputs mean; None without a learner.
    value_head: Any = None
    _encoder: Any

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        network: type[Network],
        network_kwargs: dict[str, Any],
        features_extractor: BaseFeaturesExtractor,
        n_critics: int = 2,
        n_outputs: int = 1,
        normalize_images: bool = True,
        shares_encoder: bool = False,
    ):
        super().__init__(
            with_plain_sizes(observation_space),
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
        )
        self.shares_encoder = shares_encoder
        if shares_encoder:
            share(self, features_extractor)
        self._network_args = {"network": network, "network_kwargs": network_kwargs, "n_outputs": n_outputs}
        self.n_critics = n_critics
        in_features = features_extractor.features_dim + get_action_dim(action_space)
        self.trunk = make_trunk("critic_network", network, in_features, network_kwargs, n_copies=n_critics)
        self.head: Any = self.trunk.make_head(n_outputs, n_critics)
        keep_at_rest(self)

    def inputs(self, obs: PyTorchObs | Encoded, actions: torch.Tensor) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them, or their features
        :param actions: actions in [-1, 1], (B, A)
        :return: input of the trunk, (B, F + A)
        """
        if isinstance(obs, Encoded):
            return torch.cat((obs.features, actions), dim=1)
        return torch.cat((self.features(obs), actions), dim=1)

    def features(self, obs: PyTorchObs) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :return: their features, (B, F), with a gradient to the encoder if it is the critics' own
        """
        seen: PyTorchObs = obs if self.observation_norm is None else self.observation_norm(obs)
        if self.shares_encoder:
            with torch.no_grad():
                return self.extract_features(seen, self._encoder)
        assert isinstance(self.features_extractor, BaseFeaturesExtractor)
        return self.extract_features(seen, self.features_extractor)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {**self._network_args, "features_extractor": self.features_extractor, "n_critics": self.n_critics}
        own["shares_encoder"] = self.shares_encoder
        return {**super()._get_constructor_parameters(), **own}

    def q_values(self, obs: PyTorchObs, actions: torch.Tensor) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :param actions: actions in [-1, 1], (B, A)
        :return: (E, B, K)
        """
        return self.head(self.trunk(self.inputs(obs, actions)))

    def forward(self, obs: PyTorchObs, actions: torch.Tensor) -> QValues:
        """
        :param obs: observations, (B, O), or a dict of them
        :param actions: actions in [-1, 1], (B, A)
        :return: Stable-Baselines3's tuple of E tensors, (B, K) each, which is also a tensor (E, B, K)
        """
        q = self.q_values(obs, actions)
        return QValues(q)

    def q1_forward(self, obs: PyTorchObs, actions: torch.Tensor) -> torch.Tensor:
        """
        As in Stable-Baselines3, except that all critics are evaluated.

        :param obs: observations, (B, O), or a dict of them
        :param actions: actions in [-1, 1], (B, A)
        :return: the first critic's value, (B, 1): the mean of its quantiles if it has some, the expectation over its
            atoms if it is a classifier
        :raises ValueError: if the critics have several outputs and belong to no learner, whose value head says what
            they mean
        """
        outputs = self.q_values(obs, actions)
        if self.value_head is not None:
            outputs = self.value_head.values(outputs)
        elif outputs.shape[-1] > 1:
            raise ValueError(
                f"q1_forward: a model's value head says what {outputs.shape[-1]} outputs a critic mean, and these "
                "critics have none: call it on those of a model (model.critic), or q_values for the outputs"
            )
        return outputs[0].mean(dim=1, keepdim=True)

    @property
    def q_networks(self) -> list[Callable[[torch.Tensor], torch.Tensor]]:
        """
        Each critic as a function of features and actions, (B, F + A) to (B, K). Unlike in Stable-Baselines3, they are
        not modules: the parameters of all critics are stored together, (E, ...).
        """

        def network(index: int, inputs: torch.Tensor) -> torch.Tensor:
            return self.head(self.trunk(inputs))[index]

        return [functools.partial(network, index) for index in range(self.n_critics)]

    def project(self) -> None:
        """Project weights back onto their constraints, in place; called after every step of the optimizer."""
        self.trunk.project()
        project_weights(self.head)

    def statistics(self) -> list[torch.Tensor]:
        """
        :return: running statistics that the target critics take over: the features extractor's and the trunk's
        """
        assert self.features_extractor is not None
        extractor = () if self.shares_encoder else self.features_extractor.buffers()
        return [*extractor, *self.trunk.statistics()]

    def copied_parameters(self) -> list[nn.Parameter]:
        """
        :return: the parameters that each critic has a copy of, (E, ...) each: all but the features extractor's
        """
        return [*self.trunk.copied_parameters(), *self.head.parameters()]


class ValueNetwork(NetworkFeatures, BaseModel):
    """
    Value of observations alone, by a network of the critics' kind.

    :param observation_space: observation space
    :param action_space: action space
    :param network: class of the trunk
    :param network_kwargs: its arguments
    :param features_extractor: extractor of the observation's features
    :param normalize_images: whether images are divided by 255
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        network: type[Network],
        network_kwargs: dict[str, Any],
        features_extractor: BaseFeaturesExtractor,
        normalize_images: bool = True,
    ):
        super().__init__(
            with_plain_sizes(observation_space),
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
        )
        self._network_args = {"network": network, "network_kwargs": network_kwargs}
        self.trunk = make_trunk("critic_network", network, features_extractor.features_dim, network_kwargs)
        self.head: Any = self.trunk.make_head(1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {**self._network_args, "features_extractor": self.features_extractor}
        return {**super()._get_constructor_parameters(), **own}

    def forward(self, obs: PyTorchObs) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :return: their value, (B, 1)
        """
        assert isinstance(self.features_extractor, BaseFeaturesExtractor)
        seen: PyTorchObs = obs if self.observation_norm is None else self.observation_norm(obs)
        return self.head(self.trunk(self.extract_features(seen, self.features_extractor)))

    def project(self) -> None:
        """Project weights back onto their constraints, in place; called after every step of the optimizer."""
        self.trunk.project()
        project_weights(self.head)
