"""Actor, critic ensemble and target ensemble of the off-policy family, as Stable-Baselines3 policies."""

import copy
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
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

from sb3_sample import own_classes
from sb3_sample.arguments import check_net_arch
from sb3_sample.kinds import ABOVE_0, AT_LEAST_0, DICT, TRUE_OR_FALSE, check_value, chosen, integer
from sb3_sample.learner.batch import Encoded
from sb3_sample.learner.losses import gaussian_kl, tanh_gaussian_log_prob
from sb3_sample.learner.q_values import QValues
from sb3_sample.networks import NETWORKS, Network, linear
from sb3_sample.networks.modes import ModeSwitch, evaluated
from sb3_sample.optim import AdamW

# The log standard deviation is squashed into this interval by a tanh.
LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0


class Actor(BasePolicy):
    """
    Tanh-Gaussian actor: ``a = tanh(mean + std * noise)``, the log standard deviation squashed by a tanh into
    [-10, 2] (BRO, section B.1; bounds and squashing as in the published code).

    :param observation_space: observation space
    :param action_space: action space, a bounded Box; the actor works on [-1, 1]
    :param network: class of the trunk
    :param network_kwargs: its arguments
    :param features_extractor: extractor of the observation's features
    :param normalize_images: whether images are divided by 255
    :param shares_encoder: whether the extractor is the critics', whose features are read without gradient
    """

    action_space: spaces.Box
    #: Whether the policy is a distribution, with an entropy that can be rewarded.
    has_entropy: ClassVar[bool] = True
    #: View in evaluation mode, for the actions of TD targets, if the trunk ``stacks_rows``.
    at_rest: Any = None
    _encoder: Any

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        network: type[Network],
        network_kwargs: dict[str, Any],
        features_extractor: BaseFeaturesExtractor,
        normalize_images: bool = True,
        shares_encoder: bool = False,
    ):
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.shares_encoder = shares_encoder
        if shares_encoder:
            self.share(features_extractor)
        self._network_args = {"network": network, "network_kwargs": network_kwargs}
        self.features_dim = features_extractor.features_dim
        self.action_dim = get_action_dim(action_space)
        self.trunk = _make_trunk("actor_network", network, self.features_dim, network_kwargs)
        self.mean = linear(self.trunk.out_features, self.action_dim, None)
        self.log_std = linear(self.trunk.out_features, self.action_dim, None, gain=1.0)
        #: Stable-Baselines3's distribution of the actions, for its own use: nothing here reads it.
        self.action_dist = SquashedDiagGaussianDistribution(self.action_dim)
        _keep_at_rest(self)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"features_extractor": self.features_extractor, "shares_encoder": self.shares_encoder}
        return {**super()._get_constructor_parameters(), **self._network_args, **own}

    def share(self, encoder: nn.Module) -> None:
        """
        Read the features of another module's extractor, without a gradient to it and in evaluation mode: its running
        statistics are moved by its owner's forward passes alone.

        :param encoder: features extractor, which is in the parameters, the state and the modes of its owner only
        """
        self._modules.pop("features_extractor", None)
        # Past nn.Module's own setattr, which would register them.
        vars(self).update(features_extractor=encoder, _encoder=evaluated(encoder))

    def __getstate__(self) -> dict[str, Any]:
        # The last actions that somebody asked the distribution for go with no copy: they may have a gradient.
        fresh = SquashedDiagGaussianDistribution(self.action_dim)
        return {name: fresh if name == "action_dist" else value for name, value in vars(self).items()}

    def features(self, obs: PyTorchObs | Encoded) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them, or their features
        :return: their features, (B, F); without gradient if the encoder is shared
        """
        if isinstance(obs, Encoded):
            return obs.features
        if self.shares_encoder:
            with torch.no_grad():
                return self.extract_features(obs, self._encoder)
        assert isinstance(self.features_extractor, BaseFeaturesExtractor)
        return self.extract_features(obs, self.features_extractor)

    def statistics(self) -> list[torch.Tensor]:
        """
        :return: running statistics that a target actor takes over: those of trunk and own features extractor
        """
        assert self.features_extractor is not None
        extractor = () if self.shares_encoder else self.features_extractor.buffers()
        return [*extractor, *self.trunk.statistics()]

    def gaussian(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """
        :param features: (B, F)
        :return: mean and log standard deviation of the pre-tanh Gaussian, (B, A) each
        """
        h = self.trunk(features)
        half_range = (LOG_STD_MAX - LOG_STD_MIN) / 2
        return self.mean(h), LOG_STD_MIN + half_range * (1 + torch.tanh(self.log_std(h)))

    def sample(self, obs: PyTorchObs | Encoded, noise: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Sample an action, reparameterised.

        :param obs: observations, (B, O), or a dict of them, or their features
        :param noise: standard normal noise, (B, A); drawn if None
        :return: action in [-1, 1], (B, A), and its log-probability, (B, 1)
        """
        mean, log_std = self.gaussian(self.features(obs))
        noise = torch.randn_like(mean) if noise is None else noise
        x = mean + log_std.exp() * noise
        return torch.tanh(x), tanh_gaussian_log_prob(x, noise, log_std)

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """
        As in Stable-Baselines3.

        :param obs: observations, (B, O), or a dict of them
        :return: mean and log standard deviation of the pre-tanh Gaussian, (B, A) each, and no other arguments
        """
        mean, log_std = self.gaussian(self.features(obs))
        return mean, log_std, {}

    def action_log_prob(self, obs: PyTorchObs) -> tuple[torch.Tensor, torch.Tensor]:
        """
        :meth:`sample` as Stable-Baselines3 has it; sets ``action_dist``.

        :param obs: observations, (B, O), or a dict of them
        :return: sampled actions in [-1, 1], (B, A), and their log-probability, (B,)
        """
        mean, log_std, _ = self.get_action_dist_params(obs)
        noise = torch.randn_like(mean)
        x = mean + log_std.exp() * noise
        self.action_dist.proba_distribution(mean, log_std).gaussian_actions = x
        return torch.tanh(x), tanh_gaussian_log_prob(x, noise, log_std).squeeze(1)

    def act(self, mean: torch.Tensor, std: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """
        The action that a Gaussian stands for while exploring.

        :param mean: pre-tanh mean, (B, A)
        :param std: (B, A)
        :param noise: standard normal noise, (B, A)
        :return: action in [-1, 1], (B, A)
        """
        return torch.tanh(mean + std * noise)

    def learned_action(self, mean: torch.Tensor, std: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """
        The action through which an actor's gradient goes.

        :param mean: pre-tanh mean, (B, A)
        :param std: (B, A)
        :param noise: standard normal noise, (B, A)
        :return: action in [-1, 1], (B, A)
        """
        return self.act(mean, std, noise)

    def kl(
        self, mean: torch.Tensor, std: torch.Tensor, reference_mean: torch.Tensor, reference_std: torch.Tensor
    ) -> torch.Tensor:
        """
        KL divergence of two such policies, between their pre-tanh Gaussians (the same as between the actions).

        :param mean: pre-tanh mean, (B, A)
        :param std: (B, A)
        :param reference_mean: pre-tanh mean of the other one, (B, A)
        :param reference_std: (B, A)
        :return: summed over the dimensions, (B, 1)
        """
        return gaussian_kl(mean, std, reference_mean, reference_std)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :param deterministic: the mean action instead of a sample
        :return: actions in [-1, 1], (B, A)
        """
        mean, log_std = self.gaussian(self.features(obs))
        return torch.tanh(mean) if deterministic else self.act(mean, log_std.exp(), torch.randn_like(mean))

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        return self(observation, deterministic)


class DeterministicActor(Actor):
    """
    Deterministic actor ``a = tanh(mean)`` of TD3 (Fujimoto et al. 2018): exploration adds Gaussian noise to the
    action, the TD target's action is smoothed by clipped noise, and there is no entropy.

    :param exploration_noise: standard deviation of the noise while exploring, in actions of [-1, 1]
    :param target_noise: standard deviation of the noise on the target's action
    :param target_noise_clip: bound of that noise
    :raises ValueError: if one of them is out of range
    """

    has_entropy: ClassVar[bool] = False

    def __init__(
        self,
        *args: Any,
        exploration_noise: float = 0.1,
        target_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        **kwargs: Any,
    ):
        super().__init__(*args, **kwargs)
        check_value("exploration_noise", exploration_noise, ABOVE_0)
        check_value("target_noise", target_noise, AT_LEAST_0)
        check_value("target_noise_clip", target_noise_clip, AT_LEAST_0)
        self.log_exploration_noise = math.log(exploration_noise)
        self.target_noise, self.target_noise_clip = target_noise, target_noise_clip
        self._noise_args = {
            "exploration_noise": exploration_noise,
            "target_noise": target_noise,
            "target_noise_clip": target_noise_clip,
        }
        del self.log_std, self.action_dist
        _keep_at_rest(self)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self._noise_args}

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """
        :raises AttributeError: always; as with Stable-Baselines3's TD3, there is no distribution
        """
        raise AttributeError("a deterministic actor (backbone='td3') has no distribution of its actions")

    def action_log_prob(self, obs: PyTorchObs) -> tuple[torch.Tensor, torch.Tensor]:
        """
        :raises AttributeError: always; as with Stable-Baselines3's TD3, there is no distribution
        """
        raise AttributeError("a deterministic actor (backbone='td3') has no distribution of its actions")

    def gaussian(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = self.mean(self.trunk(features))
        return mean, torch.full_like(mean, self.log_exploration_noise)

    def sample(self, obs: PyTorchObs | Encoded, noise: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """
        The action that the actor learns through: no noise, and 0 for the log-probability that it has not.

        :param obs: observations, (B, O), or a dict of them
        :param noise: ignored, there is none
        :return: action in [-1, 1], (B, A), and zeros, (B, 1)
        """
        action = torch.tanh(self.mean(self.trunk(self.features(obs))))
        return action, action.new_zeros(action.shape[0], 1)

    def smoothed(self, obs: PyTorchObs, noise: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """
        The action of a TD target (TD3's target policy smoothing).

        :param obs: observations, (B, O), or a dict of them
        :param noise: standard normal noise, (B, A); drawn if None
        :return: action in [-1, 1], (B, A), and zeros, (B, 1)
        """
        action, log_prob = self.sample(obs)
        noise = torch.randn_like(action) if noise is None else noise
        smoothing = (self.target_noise * noise).clamp(-self.target_noise_clip, self.target_noise_clip)
        return (action + smoothing).clamp(-1, 1), log_prob

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :param deterministic: without meaning, the actor always is, as in stable_baselines3's TD3
        :return: actions in [-1, 1], (B, A)
        """
        return self.sample(obs)[0]

    def act(self, mean: torch.Tensor, std: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        return (torch.tanh(mean) + std * noise).clamp(-1, 1)

    def learned_action(self, mean: torch.Tensor, std: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        return torch.tanh(mean)

    def kl(
        self, mean: torch.Tensor, std: torch.Tensor, reference_mean: torch.Tensor, reference_std: torch.Tensor
    ) -> torch.Tensor:
        """
        KL divergence of two such policies, between Gaussians of the exploration noise around the actions.

        :param mean: pre-tanh mean, (B, A)
        :param std: of the exploration noise, (B, A)
        :param reference_mean: pre-tanh mean of the other one, (B, A)
        :param reference_std: (B, A)
        :return: summed over the dimensions, (B, 1)
        """
        return gaussian_kl(torch.tanh(mean), std, torch.tanh(reference_mean), reference_std)


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
    #: View in evaluation mode, for all but the critics' own step, if the trunk ``stacks_rows``.
    at_rest: Any = None

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
        self._network_args = {"network": network, "network_kwargs": network_kwargs, "n_outputs": n_outputs}
        self.n_critics = n_critics
        in_features = features_extractor.features_dim + get_action_dim(action_space)
        self.trunk = _make_trunk("critic_network", network, in_features, network_kwargs, n_copies=n_critics)
        self.head = linear(self.trunk.out_features, n_outputs, n_critics)
        _keep_at_rest(self)

    def inputs(self, obs: PyTorchObs | Encoded, actions: torch.Tensor) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them, or their features
        :param actions: actions in [-1, 1], (B, A)
        :return: what the trunk takes, (B, F + A)
        """
        if isinstance(obs, Encoded):
            return torch.cat((obs.features, actions), dim=1)
        assert isinstance(self.features_extractor, BaseFeaturesExtractor)
        return torch.cat((self.extract_features(obs, self.features_extractor), actions), dim=1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {**self._network_args, "features_extractor": self.features_extractor, "n_critics": self.n_critics}
        return {**super()._get_constructor_parameters(), **own}

    def q_values(self, obs: PyTorchObs, actions: torch.Tensor) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :param actions: actions in [-1, 1], (B, A)
        :return: (E, B, K)
        """
        return self.head(self.trunk(self.inputs(obs, actions)))

    def forward(self, obs: PyTorchObs, actions: torch.Tensor) -> QValues | torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :param actions: actions in [-1, 1], (B, A)
        :return: Stable-Baselines3's tuple of E tensors, (B, K) each, that is a tensor (E, B, K) too; where it is being
            compiled, the tensor alone
        """
        q = self.q_values(obs, actions)
        return q if torch.compiler.is_compiling() else QValues(q)

    def q1_forward(self, obs: PyTorchObs, actions: torch.Tensor) -> torch.Tensor:
        """
        As in Stable-Baselines3, but that all critics are evaluated.

        :param obs: observations, (B, O), or a dict of them
        :param actions: actions in [-1, 1], (B, A)
        :return: the first critic's value, the mean of its quantiles if it has some, (B, 1)
        """
        return self.q_values(obs, actions)[0].mean(dim=1, keepdim=True)

    @property
    def q_networks(self) -> list[Callable[[torch.Tensor], torch.Tensor]]:
        """
        Each critic as a function of features and actions, (B, F + A) to (B, K). They are no modules as in
        Stable-Baselines3: the parameters of all lie together, (E, ...).
        """

        def network(index: int, inputs: torch.Tensor) -> torch.Tensor:
            return self.head(self.trunk(inputs))[index]

        return [functools.partial(network, index) for index in range(self.n_critics)]

    def statistics(self) -> list[torch.Tensor]:
        """
        :return: running statistics that the target critics take over: those of features extractor and trunk
        """
        assert self.features_extractor is not None
        return [*self.features_extractor.buffers(), *self.trunk.statistics()]

    def copied_parameters(self) -> list[nn.Parameter]:
        """
        :return: the parameters that each critic has a copy of, (E, ...) each: all but the features extractor's
        """
        return [*self.trunk.parameters(), *self.head.parameters()]


class SACPolicy(BasePolicy):
    """
    The networks that act and judge: actor, critics, target critics.

    :param observation_space: observation space
    :param action_space: action space, a bounded Box
    :param lr_schedule: learning rate schedule; its value at the start is used here
    :param net_arch: widths of the hidden layers as in Stable-Baselines3, a list or ``dict(pi=[...], qf=[...])``;
        for the network "mlp" only, the same as ``hidden_sizes`` in the network's arguments
    :param activation_fn: activation of the network "mlp"
    :param critic_network: trunk of the critics, "mlp", "bronet", "spectral", or a class derived from ``Network``
    :param critic_network_kwargs: its arguments (``hidden_sizes``, ``layer_norm``, ``dropout``, ...; ``width``,
        ``n_blocks``)
    :param actor_network: trunk of the actor, the same
    :param actor_network_kwargs: its arguments
    :param n_critics: E, the number of critics
    :param n_outputs: outputs a critic, as the value head asks for
    :param features_extractor_class: features extractor; actor and critics get one each, or share one
    :param features_extractor_kwargs: its arguments
    :param normalize_images: whether images are divided by 255
    :param backbone: "sac" for a tanh-Gaussian actor, "td3" for a deterministic one with a target actor
    :param actor_kwargs: arguments of the actor: with "td3" ``exploration_noise``, ``target_noise``,
        ``target_noise_clip``
    :param optimizer_class: optimizer of actor and critics
    :param optimizer_kwargs: its arguments, but for the learning rate
    :param critic_optimizer_kwargs: arguments of the critics' optimizer alone, over ``optimizer_kwargs``
    :param share_features_extractor: whether actor and critics share one features extractor, the encoder. As in
        Stable-Baselines3, False by default. There the encoder is the actor's, trained by the actor's loss; here it
        is the critics', trained by theirs, and the actors read its features without gradient, encoded anew after
        the critics' step (SAC-AE, Yarats et al. 2021; DrQ, Kostrikov et al. 2021; DrQ-v2 reads those from before
        the step). The actors read it in evaluation mode. The target critics have a Polyak average of it, which a
        target actor reads too
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
        critic_network: str | type[Network] = "mlp",
        critic_network_kwargs: dict[str, Any] | None = None,
        actor_network: str | type[Network] = "mlp",
        actor_network_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        n_outputs: int = 1,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        backbone: str = "sac",
        actor_kwargs: dict[str, Any] | None = None,
        optimizer_class: type[torch.optim.Optimizer] = AdamW,
        optimizer_kwargs: dict[str, Any] | None = None,
        critic_optimizer_kwargs: dict[str, Any] | None = None,
        share_features_extractor: bool = False,
    ):
        check_value("share_features_extractor", share_features_extractor, TRUE_OR_FALSE)
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
        check_value("n_critics", n_critics, integer(1))
        check_value("n_outputs", n_outputs, integer(1))
        check_net_arch(net_arch, ("pi", "qf"), both=True)
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
                n_outputs=n_outputs,
                normalize_images=normalize_images,
            )

        if not isinstance(backbone, str) or backbone not in BACKBONES:
            raise ValueError(f"backbone must be one of {sorted(BACKBONES)}, not {backbone!r}")
        check_value("actor_kwargs", actor_kwargs, DICT)
        check_value("critic_optimizer_kwargs", critic_optimizer_kwargs, DICT)
        actor_kwargs = dict(actor_kwargs or {})
        allowed = ("exploration_noise", "target_noise", "target_noise_clip") if backbone == "td3" else ()
        for name in actor_kwargs:
            if name not in allowed:
                raise ValueError(f"actor_kwargs has {name!r}, but backbone={backbone!r} takes {allowed or 'none'}")
        self._actor_class, self._actor_args = BACKBONES[backbone], (actor_args, actor_kwargs)
        self.share_features_extractor = share_features_extractor
        if share_features_extractor:
            self.critic = critics()
        self.actor = self.make_actor()
        #: The actor of the TD targets: a Polyak average with "td3", the actor itself with "sac".
        self.actor_target: Actor | None = None
        if isinstance(self.actor, DeterministicActor):
            self.actor_target = copy.deepcopy(self.actor).requires_grad_(False)
            self.actor_target.set_training_mode(False)
        if not share_features_extractor:
            self.critic = critics()
        self.critic_target = critics()
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.requires_grad_(False)
        self.critic_target.set_training_mode(False)
        if share_features_extractor and self.actor_target is not None:
            assert self.critic_target.features_extractor is not None
            self.actor_target.share(self.critic_target.features_extractor)
        self.actor.optimizer = self.make_optimizer(self.actor.parameters(), lr_schedule(1))
        self.critic.optimizer = self.make_optimizer(
            self.critic.parameters(), lr_schedule(1), **(critic_optimizer_kwargs or {})
        )
        targets = [self.critic_target.trunk] if self.critic_target.trunk.trains_in_target else []
        self._mode_switch = ModeSwitch(self.actor, self.critic, *targets)
        self._constructor_args: dict[str, Any] = dict(
            lr_schedule=self._dummy_schedule,
            net_arch=net_arch,
            activation_fn=activation_fn,
            critic_network=critic_network,
            critic_network_kwargs=critic_network_kwargs,
            actor_network=actor_network,
            actor_network_kwargs=actor_network_kwargs,
            n_critics=n_critics,
            n_outputs=n_outputs,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
            backbone=backbone,
            actor_kwargs=actor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
            critic_optimizer_kwargs=critic_optimizer_kwargs,
            share_features_extractor=share_features_extractor,
        )

    def make_actor(self) -> Actor:
        """
        :return: an actor of the policy's class and settings, with parameters of its own but for a shared encoder
        """
        args, kwargs = self._actor_args
        shared = self.share_features_extractor
        extractor: Any = self.critic.features_extractor if shared else self.make_features_extractor()
        return self._actor_class(
            self.observation_space,
            self.action_space,
            *args,
            features_extractor=extractor,
            normalize_images=self.normalize_images,
            shares_encoder=shared,
            **kwargs,
        )

    def make_optimizer(self, parameters: Any, learning_rate: float, **kwargs: Any) -> torch.optim.Optimizer:
        """
        :param parameters: what to optimise
        :param learning_rate: at the start
        :param kwargs: settings over the policy's
        :return: an optimizer of the policy's class and settings
        """
        settings = {**self.optimizer_kwargs, **kwargs}
        return self.optimizer_class(parameters, lr=learning_rate, **settings)  # type: ignore[call-arg]

    def encoded(self, obs: Any) -> Any:
        """
        Encode observations once for actors and critics.

        :param obs: observations, (B, O), or a dict of them
        :return: their features, without gradient, if there is a shared encoder; else the observations
        """
        return Encoded(self.actor.features(obs)) if self.share_features_extractor else obs

    def next_actions(self, obs: PyTorchObs, noise: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Actions of a TD target.

        :param obs: next observations, (B, O), or a dict of them
        :param noise: standard normal noise, (B, A); drawn if None
        :return: actions in [-1, 1], (B, A), and their log-probability (0 for a deterministic actor), (B, 1)
        """
        if isinstance(self.actor_target, DeterministicActor):
            return self.actor_target.smoothed(obs, noise)
        actor = self.actor if self.actor.at_rest is None else self.actor.at_rest
        return actor.sample(obs, noise)  # type: ignore[no-any-return]

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

    def scale_action(self, action: np.ndarray) -> np.ndarray:
        """
        :param action: actions in the action space's own bounds, (B, A)
        :return: the same in [-1, 1], (B, A)
        """
        bounds = self._float_bounds(np.asarray(action).dtype)
        if bounds is None:
            return super().scale_action(action)
        low, high = bounds
        return 2.0 * ((action - low) / (high - low)) - 1.0

    def unscale_action(self, scaled_action: np.ndarray) -> np.ndarray:
        """
        :param scaled_action: actions in [-1, 1], (B, A)
        :return: the same in the action space's own bounds, (B, A), inside them also where scaling rounds. As in
            Stable-Baselines3, they are floats also where the space is one of integers
        """
        bounds = self._float_bounds(scaled_action.dtype)
        if bounds is None:
            return np.clip(super().unscale_action(scaled_action), self.action_space.low, self.action_space.high)
        low, high = bounds
        return np.clip(low + (0.5 * (scaled_action + 1.0) * (high - low)), low, high)

    def _float_bounds(self, dtype: Any) -> tuple[np.ndarray, np.ndarray] | None:
        """
        Bounds of a space of integers as floats, since small integers cannot hold their difference.

        :param dtype: of the actions
        :return: the bounds in the type that Stable-Baselines3's arithmetic has; None where the space is one of floats
        """
        space = self.action_space
        if np.issubdtype(space.dtype, np.floating):
            return None
        kind = np.result_type(dtype, space.dtype)
        kind = kind if np.issubdtype(kind, np.floating) else np.dtype(np.float64)
        return space.low.astype(kind), space.high.astype(kind)

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: training (True) or evaluation mode of actor and critics. Of the targets, the features extractors
            stay in evaluation mode, the rest follows: dropout is active in the target critics too (DroQ)
        """
        self._mode_switch(mode)
        self.training = mode


#: The actor's class by the name that the policy's ``backbone`` takes.
BACKBONES: dict[str, type[Actor]] = {"sac": Actor, "td3": DeterministicActor}

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


def _keep_at_rest(owner: Any) -> None:
    """Give an actor or critics, once complete, their view in evaluation mode if they stack rows."""
    choice = owner.trunk.stacks_rows
    if choice not in (None, "online", "target"):
        raise ValueError(f"stacks_rows of a network must be None, 'online' or 'target', not {choice!r}")
    if choice is not None:
        # Past nn.Module's own setattr, which would register it.
        vars(owner)["at_rest"] = evaluated(owner)


def _network_args(
    who: str,
    network: str | type[Network],
    kwargs: dict[str, Any] | None,
    net_arch: list[int] | None,
    activation_fn: type[nn.Module] | None,
) -> tuple[type[Network], dict[str, Any]]:
    """Class and arguments of a trunk, from its name and from Stable-Baselines3's shorthand."""
    check_value(f"{who}_network_kwargs", kwargs, DICT)
    cls = chosen(f"{who}_network", network, NETWORKS, Network)
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
    own_classes.check_arguments(f"{who}_network", network, cls, 1, kwargs=kwargs, n_copies=None)
    return cls, kwargs


def _make_trunk(argument: str, cls: type[Network], in_features: int, kwargs: dict[str, Any], **copies: int) -> Network:
    trunk: Network = own_classes.make(argument, cls, cls, Network, in_features, kwargs=kwargs, **copies)
    check_value(f"{cls.__name__}.out_features", getattr(trunk, "out_features", None), integer(1))
    return trunk
