"""Actors of the off-policy family, as Stable-Baselines3 policies."""

import math
from typing import Any, ClassVar

import torch
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
)
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_sample.kinds import ABOVE_0, AT_LEAST_0, FINITE, TRUE_OR_FALSE, check_value
from sb3_sample.learner.batch import Encoded
from sb3_sample.learner.losses import gaussian_kl, tanh_gaussian_log_prob
from sb3_sample.networks import Network, project_weights
from sb3_sample.sac.features import NetworkFeatures, share
from sb3_sample.sac.trunks import keep_at_rest, make_trunk, with_plain_sizes

# The log standard deviation is squashed into this interval by a tanh.
LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0
#: Bound to which actions are clipped before their likelihood is taken, as IQL's published code clips the data.
LARGEST_ACTION = 1 - 1e-5
#: Largest action of DrQ-v2.
INSIDE = 1 - 1e-6
#: Arguments of a Gaussian actor that say how its standard deviation is bounded.
LOG_STD_ARGUMENTS = ("log_std_min", "log_std_max", "clip_log_std")
#: All arguments specific to a Gaussian actor.
GAUSSIAN_ARGUMENTS = (*LOG_STD_ARGUMENTS, "initial_std")


class Actor(NetworkFeatures, BasePolicy):
    """
    Tanh-Gaussian actor: ``a = tanh(mean + std * noise)``, the log standard deviation squashed by a tanh into
    [-10, 2] (BRO, section B.1; bounds and squashing as in the published code), or clipped.

    :param observation_space: observation space
    :param action_space: action space, a bounded Box; the actor works on [-1, 1]
    :param network: class of the trunk
    :param network_kwargs: its arguments
    :param features_extractor: extractor of the observation's features
    :param normalize_images: whether images are divided by 255
    :param shares_encoder: whether the extractor belongs to the critics; its features are then read without gradient
    :param log_std_min: lower bound of the log standard deviation
    :param log_std_max: upper bound
    :param clip_log_std: whether the log standard deviation is clipped to the bounds, without a gradient outside,
        instead of squashed by a tanh
    :param initial_std: approximate standard deviation before the squashing at the start; None: the published code's,
        e^-4 between the usual bounds. If the actor learns by the likelihood of given actions, it starts from a wide
        one; otherwise its first gradients would be thousands
    :raises ValueError: if an argument is out of range
    """

    action_space: spaces.Box
    #: Whether the policy is a distribution, with an entropy that can be rewarded.
    has_entropy: ClassVar[bool] = True
    #: Whether the policy explores with its own standard deviation.
    has_std: ClassVar[bool] = True
    #: Arguments that ``actor_kwargs`` of a policy takes.
    ARGUMENTS: ClassVar[tuple[str, ...]] = GAUSSIAN_ARGUMENTS
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
        log_std_min: float = LOG_STD_MIN,
        log_std_max: float = LOG_STD_MAX,
        clip_log_std: bool = False,
        initial_std: float | None = None,
    ):
        super().__init__(
            with_plain_sizes(observation_space),
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        check_value("log_std_min", log_std_min, FINITE)
        check_value("log_std_max", log_std_max, FINITE)
        check_value("clip_log_std", clip_log_std, TRUE_OR_FALSE)
        check_value("initial_std", initial_std, ABOVE_0.or_none())
        if not log_std_min < log_std_max:
            raise ValueError(f"log_std_min must lie below log_std_max={log_std_max}, not be {log_std_min}")
        self.log_std_min, self.log_std_max, self.clip_log_std = log_std_min, log_std_max, clip_log_std
        self.shares_encoder = shares_encoder
        if shares_encoder:
            self.share(features_extractor)
        self._network_args: dict[str, Any] = {"network": network, "network_kwargs": network_kwargs}
        self.features_dim = features_extractor.features_dim
        self.action_dim = get_action_dim(action_space)
        self.trunk = make_trunk("actor_network", network, self.features_dim, network_kwargs)
        self.mean = self.trunk.make_head(self.action_dim)
        self.log_std = self.trunk.make_head(self.action_dim, gain=1.0)
        if initial_std is not None:
            self._network_args["initial_std"] = initial_std
            self.start_from(initial_std)
        #: Distribution of the actions, for Stable-Baselines3's own use: nothing here reads it.
        self.action_dist = SquashedDiagGaussianDistribution(self.action_dim)
        keep_at_rest(self)

    def start_from(self, initial_std: float) -> None:
        """
        Initialise the log standard deviation to nearly the same value for all observations, however large.

        :param initial_std: standard deviation of the pre-tanh Gaussian
        :raises ValueError: if the output layer is no plain one, or the value does not lie between the bounds
        """
        if type(self.log_std) is not nn.Linear:
            raise ValueError(
                f"initial_std={initial_std} is set by a plain output layer, and that of actor_network="
                f"{type(self.trunk).__name__} has a norm of its own: pass actor_kwargs={{'initial_std': None}}"
            )
        start, low, high = math.log(initial_std), self.log_std_min, self.log_std_max
        if not low < start < high:
            raise ValueError(
                f"initial_std must lie between e^log_std_min and e^log_std_max, e^{low:g} and e^{high:g}, not be "
                f"{initial_std}"
            )
        self.log_std.weight.data.mul_(0.01)
        bias = start if self.clip_log_std else math.atanh(2 * (start - low) / (high - low) - 1)
        nn.init.constant_(self.log_std.bias, bias)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"features_extractor": self.features_extractor, "shares_encoder": self.shares_encoder}
        own |= {name: getattr(self, name) for name in LOG_STD_ARGUMENTS}
        return {**super()._get_constructor_parameters(), **self._network_args, **own}

    def share(self, encoder: nn.Module) -> None:
        """
        Read the features of another module's extractor, without a gradient to it and in evaluation mode: only its
        owner's forward passes update its running statistics.

        :param encoder: features extractor, which is in the parameters, the state and the modes of its owner only
        """
        share(self, encoder)

    def __getstate__(self) -> dict[str, Any]:
        # A copy gets a fresh distribution: the actions last sampled from the old one may have a gradient.
        fresh = SquashedDiagGaussianDistribution(self.action_dim)
        return {name: fresh if name == "action_dist" else value for name, value in vars(self).items()}

    def features(self, obs: PyTorchObs | Encoded) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them, or their features
        :return: their features, (B, F); without gradient if the encoder is shared
        """
        if isinstance(obs, Encoded):
            return obs.features
        seen: PyTorchObs = obs if self.observation_norm is None else self.observation_norm(obs)
        if self.shares_encoder:
            with torch.no_grad():
                return self.extract_features(seen, self._encoder)
        assert isinstance(self.features_extractor, BaseFeaturesExtractor)
        return self.extract_features(seen, self.features_extractor)

    def project(self) -> None:
        """Project weights back onto their constraints, in place; called after every step of the optimizer."""
        self.trunk.project()
        for head in self._heads():
            project_weights(head)

    def _heads(self) -> tuple[nn.Module, ...]:
        return self.mean, self.log_std

    def statistics(self) -> list[torch.Tensor]:
        """
        :return: running statistics that a target actor takes over: the trunk's and those of the actor's own features
            extractor
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
        if self.clip_log_std:
            # One bound after the other: torch refuses a number beside a tensor, which a bound that differs between the
            # learners of a group is.
            return self.mean(h), self.log_std(h).clamp(min=self.log_std_min).clamp(max=self.log_std_max)
        half_range = (self.log_std_max - self.log_std_min) / 2
        return self.mean(h), self.log_std_min + half_range * (1 + torch.tanh(self.log_std(h)))

    def sample(
        self,
        obs: PyTorchObs | Encoded,
        noise: torch.Tensor | None = None,
        following: PyTorchObs | Encoded | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Sample an action, reparameterised.

        :param obs: observations, (B, O), or a dict of them, or their features
        :param noise: standard normal noise, (B, A); drawn if None
        :param following: further observations, stacked below ``obs`` in the forward pass for the batch statistics; None
            for none
        :return: action in [-1, 1], (B, A), and its log-probability, (B, 1)
        """
        features = self.features(obs)
        if following is None:
            mean, log_std = self.gaussian(features)
        else:
            rows = self.gaussian(torch.cat((features, self.features(following))))
            mean, log_std = (each[: len(features)] for each in rows)
        noise = torch.randn_like(mean) if noise is None else noise
        x = mean + log_std.exp() * noise
        return torch.tanh(x), tanh_gaussian_log_prob(x, noise, log_std)

    def log_prob_of(self, obs: PyTorchObs | Encoded, actions: torch.Tensor) -> torch.Tensor:
        """
        Log-probability of given actions.

        :param obs: observations, (B, O), or a dict of them, or their features
        :param actions: in [-1, 1], (B, A); an action on a bound, where the log-probability is infinite, is moved
            slightly inside
        :return: (B, 1)
        """
        mean, log_std = self.gaussian(self.features(obs))
        x = torch.atanh(actions.clamp(-LARGEST_ACTION, LARGEST_ACTION))
        return tanh_gaussian_log_prob(x, (x - mean) / log_std.exp(), log_std)

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
        Exploratory action of a Gaussian.

        :param mean: pre-tanh mean, (B, A)
        :param std: (B, A)
        :param noise: standard normal noise, (B, A)
        :return: action in [-1, 1], (B, A)
        """
        return torch.tanh(mean + std * noise)

    def learned_action(self, mean: torch.Tensor, std: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """
        Action through which the actor's gradient flows.

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
        :param reference_mean: pre-tanh mean of the other policy, (B, A)
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


class MeanActor(Actor):
    """
    Deterministic actor ``a = tanh(mean)``, without target actor, smoothing or exploration noise (DAC, table 1). The
    head of its log standard deviation does not learn; it exists so that an optimistic actor built in the same way is a
    Gaussian.
    """

    has_entropy: ClassVar[bool] = False
    has_std: ClassVar[bool] = False
    _kind: ClassVar[str] = "a deterministic actor"

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """
        :raises AttributeError: always; as with Stable-Baselines3's TD3, there is no distribution
        """
        raise AttributeError(f"{self._kind} has no distribution of its actions")

    def action_log_prob(self, obs: PyTorchObs) -> tuple[torch.Tensor, torch.Tensor]:
        """
        :raises AttributeError: always; as with Stable-Baselines3's TD3, there is no distribution
        """
        raise AttributeError(f"{self._kind} has no distribution of its actions")

    def log_prob_of(self, obs: PyTorchObs | Encoded, actions: torch.Tensor) -> torch.Tensor:
        """
        :raises AttributeError: always; there is no distribution
        """
        raise AttributeError(f"{self._kind} has no distribution of its actions")

    def sample(
        self,
        obs: PyTorchObs | Encoded,
        noise: torch.Tensor | None = None,
        following: PyTorchObs | Encoded | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Action that the actor learns through, without noise, and 0 in place of a log-probability.

        :param obs: observations, (B, O), or a dict of them, or their features
        :param noise: ignored: the action has no noise
        :param following: further observations, stacked below ``obs`` in the forward pass; None for none
        :return: action in [-1, 1], (B, A), and zeros, (B, 1)
        """
        features = self.features(obs)
        rows = features if following is None else torch.cat((features, self.features(following)))
        action = torch.tanh(self.mean(self.trunk(rows)))
        action = action if following is None else action[: len(features)]
        return action, action.new_zeros(action.shape[0], 1)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :param deterministic: ignored: the actor always is deterministic, as in stable_baselines3's TD3
        :return: actions in [-1, 1], (B, A)
        """
        return self.sample(obs)[0]


class DeterministicActor(MeanActor):
    """
    Deterministic actor ``a = tanh(mean)`` of TD3 (Fujimoto et al. 2018): exploration adds Gaussian noise to the
    action, the TD target's action is smoothed by clipped noise, and there is no entropy.

    :param exploration_noise: standard deviation of the noise while exploring, in actions of [-1, 1]
    :param target_noise: standard deviation of the noise on the target's action
    :param target_noise_clip: bound of that noise
    :raises ValueError: if one of them is out of range
    """

    has_std: ClassVar[bool] = True
    #: Whether TD targets use the actions of a target actor, a Polyak average of this one.
    has_target: ClassVar[bool] = True
    ARGUMENTS: ClassVar[tuple[str, ...]] = ("exploration_noise", "target_noise", "target_noise_clip")
    _kind: ClassVar[str] = "a deterministic actor (backbone='td3')"

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
        keep_at_rest(self)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self._noise_args}

    def _heads(self) -> tuple[nn.Module, ...]:
        return (self.mean,)

    def gaussian(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = self.mean(self.trunk(features))
        # A sum: torch fills with no tensor, which the noise is where it differs between the learners of a group.
        return mean, torch.zeros_like(mean) + self.log_exploration_noise

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
        :param reference_mean: pre-tanh mean of the other policy, (B, A)
        :param reference_std: (B, A)
        :return: summed over the dimensions, (B, 1)
        """
        return gaussian_kl(torch.tanh(mean), std, torch.tanh(reference_mean), reference_std)


class NoisyActor(DeterministicActor):
    """
    Deterministic actor of DrQ-v2 (Yarats et al. 2022), ``a = tanh(mean)``: the exploratory action, the TD target's
    action and the action that the actor learns through all have Gaussian noise of the same standard deviation,
    ``noise_std``, which changes during training; the noise is clipped except in exploration. Actions are clamped just
    inside [-1, 1], with a gradient as if they were not. There is no target actor.

    :param args: as for :class:`DeterministicActor`
    :param noise_clip: bound of the noise, except in exploration
    :param noise_std: standard deviation of the noise at the start, in actions of [-1, 1]
    :param kwargs: as for :class:`DeterministicActor`, except the noise
    :raises ValueError: if one of the two is out of range
    """

    has_target: ClassVar[bool] = False
    ARGUMENTS: ClassVar[tuple[str, ...]] = ("noise_clip", "noise_std")
    #: Standard deviation of the noise in actions of [-1, 1], ().
    noise_std: torch.Tensor

    def __init__(self, *args: Any, noise_clip: float = 0.3, noise_std: float = 1.0, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.noise_clip = check_value("noise_clip", noise_clip, AT_LEAST_0)
        check_value("noise_std", noise_std, ABOVE_0)
        self._noise_args = {"noise_clip": noise_clip, "noise_std": noise_std}
        self.register_buffer("noise_std", torch.tensor(float(noise_std)))
        # Anew, with the buffer above.
        keep_at_rest(self)

    def gaussian(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = self.mean(self.trunk(features))
        return mean, self.noise_std.log().expand_as(mean)

    def sample(
        self,
        obs: PyTorchObs | Encoded,
        noise: torch.Tensor | None = None,
        following: PyTorchObs | Encoded | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Action with clipped noise, for TD targets and for the actor's loss.

        :param obs: observations, (B, O), or a dict of them, or their features
        :param noise: standard normal noise, (B, A); drawn if None
        :param following: further observations, stacked below ``obs`` in the forward pass; None for none
        :return: action inside of [-1, 1], (B, A), and zeros, (B, 1)
        """
        action, log_prob = super().sample(obs, None, following)
        noise = torch.randn_like(action) if noise is None else noise
        noisy = action + (self.noise_std * noise).clamp(-self.noise_clip, self.noise_clip)
        return noisy + (noisy.clamp(-INSIDE, INSIDE) - noisy).detach(), log_prob

    def act(self, mean: torch.Tensor, std: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        return (torch.tanh(mean) + std * noise).clamp(-INSIDE, INSIDE)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :param deterministic: ignored: the actor always is deterministic
        :return: actions in [-1, 1], (B, A)
        """
        return super().sample(obs)[0]


#: The actor's class by the name that the policy's ``backbone`` takes; "mean" is for DAC alone.
BACKBONES: dict[str, type[Actor]] = {"sac": Actor, "td3": DeterministicActor, "mean": MeanActor}
