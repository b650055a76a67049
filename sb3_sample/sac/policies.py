"""Actor, critic ensemble and target ensemble of the off-policy family, as Stable-Baselines3 policies."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
    get_actor_critic_arch,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_sample.networks import NETWORKS, Network, linear
from sb3_sample.optim import AdamW
from sb3_sample.sac.losses import tanh_gaussian_log_prob

# The log standard deviation is squashed into this interval by a tanh.
LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0


class Actor(BasePolicy):
    """
    Tanh-Gaussian actor: ``a = tanh(mean + std * noise)``, the log standard deviation squashed by a tanh into
    [-10, 2] (P5, section B.1; bounds and squashing as in the published code).

    :param observation_space: observation space
    :param action_space: action space, a bounded Box; the actor works on [-1, 1]
    :param network: class of the trunk
    :param network_kwargs: its arguments
    :param features_extractor: extractor of the observation's features
    :param normalize_images: whether images are divided by 255
    """

    action_space: spaces.Box

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
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.features_dim = features_extractor.features_dim
        self.action_dim = get_action_dim(action_space)
        self.trunk = network(self.features_dim, **network_kwargs)
        self.mean = linear(self.trunk.out_features, self.action_dim, None)
        self.log_std = linear(self.trunk.out_features, self.action_dim, None, gain=1.0)

    def features(self, obs: PyTorchObs) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :return: their features, (B, F)
        """
        assert isinstance(self.features_extractor, BaseFeaturesExtractor)
        return self.extract_features(obs, self.features_extractor)

    def gaussian(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """
        :param features: (B, F)
        :return: mean and log standard deviation of the pre-tanh Gaussian, (B, A) each
        """
        h = self.trunk(features)
        half_range = (LOG_STD_MAX - LOG_STD_MIN) / 2
        return self.mean(h), LOG_STD_MIN + half_range * (1 + torch.tanh(self.log_std(h)))

    def sample(self, obs: PyTorchObs, noise: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Sample an action, reparameterised.

        :param obs: observations, (B, O), or a dict of them
        :param noise: standard normal noise, (B, A); drawn if None
        :return: action in [-1, 1], (B, A), and its log-probability, (B, 1)
        """
        mean, log_std = self.gaussian(self.features(obs))
        noise = torch.randn_like(mean) if noise is None else noise
        x = mean + log_std.exp() * noise
        return torch.tanh(x), tanh_gaussian_log_prob(x, noise, log_std)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :param deterministic: the mean action instead of a sample
        :return: actions in [-1, 1], (B, A)
        """
        mean, log_std = self.gaussian(self.features(obs))
        return torch.tanh(mean if deterministic else mean + log_std.exp() * torch.randn_like(mean))

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        return self(observation, deterministic)


class CriticEnsemble(BaseModel):
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
    """

    action_space: spaces.Box

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
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        in_features = features_extractor.features_dim + get_action_dim(action_space)
        self.trunk = network(in_features, n_copies=n_critics, **network_kwargs)
        self.head = linear(self.trunk.out_features, n_outputs, n_critics)

    def forward(self, obs: PyTorchObs, actions: torch.Tensor) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :param actions: actions in [-1, 1], (B, A)
        :return: (E, B, K)
        """
        assert isinstance(self.features_extractor, BaseFeaturesExtractor)
        features = self.extract_features(obs, self.features_extractor)
        return self.head(self.trunk(torch.cat((features, actions), dim=1)))


class SACPolicy(BasePolicy):
    """
    The networks that act and judge: actor, critics, target critics.

    :param observation_space: observation space
    :param action_space: action space, a bounded Box
    :param lr_schedule: learning rate schedule; its value at the start is used here
    :param net_arch: widths of the hidden layers as in Stable-Baselines3, a list or ``dict(pi=[...], qf=[...])``;
        for the network "mlp" only, the same as ``hidden_sizes`` in the network's arguments
    :param activation_fn: activation of the network "mlp"
    :param critic_network: trunk of the critics, "mlp" or "bronet"
    :param critic_network_kwargs: its arguments (``hidden_sizes``, ``layer_norm``; ``width``, ``n_blocks``)
    :param actor_network: trunk of the actor, "mlp" or "bronet"
    :param actor_network_kwargs: its arguments
    :param n_critics: E, the number of critics
    :param n_quantiles: K quantiles a critic; None for scalar critics
    :param features_extractor_class: features extractor; actor and critics get one each
    :param features_extractor_kwargs: its arguments
    :param normalize_images: whether images are divided by 255
    :param optimizer_class: optimizer of actor and critics
    :param optimizer_kwargs: its arguments, but for the learning rate
    :raises ValueError: if an argument is out of range or contradicts another
    """

    action_space: spaces.Box
    actor: Actor
    critic: CriticEnsemble
    critic_target: CriticEnsemble

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: Sequence[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] | None = None,
        critic_network: str = "mlp",
        critic_network_kwargs: dict[str, Any] | None = None,
        actor_network: str = "mlp",
        actor_network_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        n_quantiles: int | None = None,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[torch.optim.Optimizer] = AdamW,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
            normalize_images=normalize_images,
        )
        if n_critics < 1:
            raise ValueError(f"n_critics must be at least 1, not {n_critics}")
        if n_quantiles is not None and n_quantiles < 1:
            raise ValueError(f"n_quantiles must be at least 1, or None for scalar critics, not {n_quantiles}")
        pi_arch: list[int] | None = None
        qf_arch: list[int] | None = None
        if net_arch is not None:
            pi_arch, qf_arch = get_actor_critic_arch(net_arch if isinstance(net_arch, dict) else list(net_arch))
        actor_args = _network_args("actor", actor_network, actor_network_kwargs, pi_arch, activation_fn)
        critic_args = _network_args("critic", critic_network, critic_network_kwargs, qf_arch, activation_fn)

        def critics() -> CriticEnsemble:
            return CriticEnsemble(
                observation_space,
                action_space,
                *critic_args,
                features_extractor=self.make_features_extractor(),
                n_critics=n_critics,
                n_outputs=1 if n_quantiles is None else n_quantiles,
                normalize_images=normalize_images,
            )

        self.actor = Actor(
            observation_space,
            action_space,
            *actor_args,
            features_extractor=self.make_features_extractor(),
            normalize_images=normalize_images,
        )
        self.critic = critics()
        self.critic_target = critics()
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.requires_grad_(False)
        self.actor.optimizer = self.make_optimizer(self.actor.parameters(), lr_schedule)
        self.critic.optimizer = self.make_optimizer(self.critic.parameters(), lr_schedule)
        self._constructor_args: dict[str, Any] = dict(
            lr_schedule=self._dummy_schedule,
            net_arch=net_arch,
            activation_fn=activation_fn,
            critic_network=critic_network,
            critic_network_kwargs=critic_network_kwargs,
            actor_network=actor_network,
            actor_network_kwargs=actor_network_kwargs,
            n_critics=n_critics,
            n_quantiles=n_quantiles,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
        )

    def make_optimizer(self, parameters: Any, lr_schedule: Schedule) -> torch.optim.Optimizer:
        """
        :param parameters: what to optimise
        :param lr_schedule: learning rate schedule
        :return: an optimizer of the policy's class and settings
        """
        return self.optimizer_class(parameters, lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self._constructor_args}

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :param deterministic: the mean action instead of a sample
        :return: the actor's actions in [-1, 1], (B, A)
        """
        return self.actor(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        return self(observation, deterministic)

    def unscale_action(self, scaled_action: np.ndarray) -> np.ndarray:
        """
        :param scaled_action: actions in [-1, 1], (B, A)
        :return: the same in the action space's own bounds, (B, A), inside them also where scaling rounds
        """
        return np.clip(super().unscale_action(scaled_action), self.action_space.low, self.action_space.high)

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: training (True) or evaluation mode of actor and critics; the targets stay in evaluation mode
        """
        self.actor.set_training_mode(mode)
        self.critic.set_training_mode(mode)
        self.training = mode


MlpPolicy = SACPolicy


class CnnPolicy(SACPolicy):
    """The same with a CNN as features extractor, for images."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs.setdefault("features_extractor_class", NatureCNN)
        super().__init__(*args, **kwargs)


class MultiInputPolicy(SACPolicy):
    """The same with an extractor for dict observations."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs.setdefault("features_extractor_class", CombinedExtractor)
        super().__init__(*args, **kwargs)


def _network_args(
    who: str,
    network: str,
    kwargs: dict[str, Any] | None,
    net_arch: list[int] | None,
    activation_fn: type[nn.Module] | None,
) -> tuple[type[Network], dict[str, Any]]:
    """Class and arguments of a trunk, from its name and from Stable-Baselines3's shorthand."""
    if network not in NETWORKS:
        raise ValueError(f"{who}_network must be one of {sorted(NETWORKS)}, not {network!r}")
    kwargs = dict(kwargs or {})
    for name, key, value in (("net_arch", "hidden_sizes", net_arch), ("activation_fn", "activation_fn", activation_fn)):
        if value is None:
            continue
        if network != "mlp":
            raise ValueError(
                f"{name} describes an MLP, but {who}_network is {network!r}: use {who}_network_kwargs, "
                f"or {who}_network='mlp'"
            )
        if key in kwargs:
            raise ValueError(f"{name} and {who}_network_kwargs[{key!r}] say the same thing: give one of them")
        kwargs[key] = value
    return NETWORKS[network], kwargs
