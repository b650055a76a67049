"""Policies of the off-policy family: actor, critics and targets, as Stable-Baselines3 has them."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    FlattenExtractor,
    NatureCNN,
    get_actor_critic_arch,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_sample.arguments import check_net_arch
from sb3_sample.envs.numbers import check_numbers
from sb3_sample.kinds import ABOVE_0, DICT, TRUE_OR_FALSE, check_value, integer, one_of
from sb3_sample.learner.batch import Encoded
from sb3_sample.networks import Network, Projected, RunningNorm
from sb3_sample.networks.modes import ModeSwitch
from sb3_sample.optim import AdamW
from sb3_sample.sac.actors import BACKBONES, Actor, DeterministicActor
from sb3_sample.sac.critics import CriticEnsemble, ValueNetwork
from sb3_sample.sac.multi_task import TaskRunningNorm, dict_extractor, is_multi_task
from sb3_sample.sac.trunks import network_args


class SACPolicy(BasePolicy):
    """
    The family's networks: actor, critics, target critics.

    :param observation_space: observation space
    :param action_space: action space, a bounded Box
    :param lr_schedule: learning rate schedule; its value at the start is used here
    :param net_arch: widths of the hidden layers as in Stable-Baselines3, a list or ``dict(pi=[...], qf=[...])``;
        for the networks "mlp", "crossq" and "xqc" only, the same as ``hidden_sizes`` in the network's arguments
    :param activation_fn: activation of these networks
    :param critic_network: trunk of the critics by its name in ``NETWORKS``, or a class derived from ``Network``
    :param critic_network_kwargs: its arguments (``hidden_sizes``, ``layer_norm``, ``dropout``, ...; ``width``,
        ``n_blocks``)
    :param actor_network: trunk of the actor, given in the same way
    :param actor_network_kwargs: its arguments
    :param n_critics: E, the number of critics
    :param n_outputs: outputs per critic, as the value head requires
    :param features_extractor_class: features extractor; actor and critics get one each, or share one
    :param features_extractor_kwargs: its arguments
    :param normalize_images: whether images are divided by 255
    :param backbone: "sac" for a tanh-Gaussian actor, "td3" for a deterministic one with a target actor
    :param actor_kwargs: arguments of the actor: with "sac" ``log_std_min``, ``log_std_max``, ``clip_log_std``,
        ``initial_std``, with "td3" ``exploration_noise``, ``target_noise``, ``target_noise_clip``
    :param optimizer_class: optimizer of actor and critics
    :param optimizer_kwargs: its arguments, except the learning rate
    :param critic_optimizer_kwargs: arguments of the critics' optimizer alone, which override ``optimizer_kwargs``
    :param share_features_extractor: whether actor and critics share one features extractor, the encoder. As in
        Stable-Baselines3, False by default. There the encoder belongs to the actor and is trained by the actor's loss;
        here it belongs to the critics and is trained by their loss, and the actors read its features without gradient,
        encoded anew after the critics' step (SAC-AE, Yarats et al. 2021; DrQ, Kostrikov et al. 2021; DrQ-v2 reads the
        features from before the step, see ``actor_features``). The actors read it in evaluation mode. The target
        critics have a Polyak average of it, which a target actor reads too, unless ``target_encoder`` says otherwise
    :param normalize_observations: whether all networks read observations through one running normalisation,
        ``observation_norm``, whose statistics are in the policy
    :param width_factor: factor on the widths of all trunks' hidden layers
    :param target_encoder: if the encoder is shared, the one that target critics read: "own", a Polyak average, or
        "online", the critics' without gradient; next observations are then encoded once (DrQ-v2)
    :param actor_features: if the encoder is shared, the features that actors learn from: those encoded "after" the
        critics' step, or "before" it, those of that step; observations are then encoded once (DrQ-v2)
    :param encoder_learning_rate: learning rate of a shared encoder, which no schedule changes; None: the critics'
    :param projection: outputs of a dense layer with layer norm and tanh that features go through first, one for the
        actor and one for all critics (DrQ: 50); None for none
    :param projection_gain: gain of the projection's orthogonal kernel
    :raises ValueError: if an argument is out of range or contradicts another
    """

    action_space: spaces.Box
    actor: Actor
    critic: CriticEnsemble
    critic_target: CriticEnsemble
    #: Class of the actor by the name that ``backbone`` takes.
    backbones: ClassVar[Mapping[str, type[Actor]]] = BACKBONES
    #: Whether observations, and next observations, are encoded once for the whole gradient step.
    encodes_once: bool = False
    encodes_next_once: bool = False

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
        normalize_observations: bool = False,
        width_factor: int = 1,
        target_encoder: str = "own",
        actor_features: str = "after",
        encoder_learning_rate: float | None = None,
        projection: int | None = None,
        projection_gain: float = 1.0,
    ):
        drawn_from = torch.get_rng_state()
        check_value("share_features_extractor", share_features_extractor, TRUE_OR_FALSE)
        check_value("target_encoder", target_encoder, one_of(("own", "online")))
        check_value("actor_features", actor_features, one_of(("after", "before")))
        check_value("encoder_learning_rate", encoder_learning_rate, ABOVE_0.or_none())
        check_value("projection", projection, integer(1).or_none())
        check_value("projection_gain", projection_gain, ABOVE_0)
        of_shared = {
            "target_encoder": target_encoder != "own",
            "actor_features": actor_features != "after",
            "encoder_learning_rate": encoder_learning_rate is not None,
        }
        for name, is_set in of_shared.items():
            if is_set and not share_features_extractor:
                raise ValueError(f"{name} is a choice of one encoder for all: pass share_features_extractor=True too")
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
        #: State of torch's generator from which the parameters were drawn.
        self.drawn_from = drawn_from
        check_value("n_critics", n_critics, integer(1))
        check_value("n_outputs", n_outputs, integer(1))
        check_value("normalize_observations", normalize_observations, TRUE_OR_FALSE)
        check_net_arch(net_arch, ("pi", "qf"), both=True)
        pi_arch: list[int] | None = None
        qf_arch: list[int] | None = None
        if net_arch is not None:
            pi_arch, qf_arch = get_actor_critic_arch(net_arch if isinstance(net_arch, dict) else list(net_arch))
        check_value("width_factor", width_factor, integer(1))
        further = (activation_fn, width_factor)
        actor_args = network_args("actor", actor_network, actor_network_kwargs, pi_arch, *further)
        critic_args = network_args("critic", critic_network, critic_network_kwargs, qf_arch, *further)

        self._projection = projection, projection_gain
        self.observation_norm: RunningNorm | None = None
        if normalize_observations:
            self.observation_norm = _running_norm(observation_space)

        def critics(encoder: Any = None) -> CriticEnsemble:
            extractor: Any = self.make_features_extractor() if encoder is None else encoder
            made = CriticEnsemble(
                observation_space,
                action_space,
                *self._projected(critic_args, extractor),
                features_extractor=extractor,
                n_critics=n_critics,
                n_outputs=n_outputs,
                normalize_images=normalize_images,
                shares_encoder=encoder is not None,
            )
            self._share_norm(made)
            return made

        check_value("critic_optimizer_kwargs", critic_optimizer_kwargs, DICT)
        self._actor_class, actor_kwargs = self._chosen_actor(backbone, actor_kwargs)
        self._actor_args = (actor_args, actor_kwargs)
        self._critic_args = critic_args
        self.share_features_extractor = share_features_extractor
        self.encodes_once, self.encodes_next_once = actor_features == "before", target_encoder == "online"
        if share_features_extractor:
            self.critic = critics()
        self.actor = self.make_actor()
        #: Polyak average of the actor for the TD targets, with "td3"; None if they use the actor itself.
        self.actor_target: Actor | None = None
        if isinstance(self.actor, DeterministicActor) and self.actor.has_target:
            self.actor_target = copy.deepcopy(self.actor).requires_grad_(False)
            self._share_norm(self.actor_target)
            self.actor_target.set_training_mode(False)
        if not share_features_extractor:
            self.critic = critics()
        self.critic_target = critics(self.critic.features_extractor if target_encoder == "online" else None)
        own = self.critic_target.state_dict().keys()
        self.critic_target.load_state_dict({k: v for k, v in self.critic.state_dict().items() if k in own})
        self.critic_target.requires_grad_(False)
        self.critic_target.set_training_mode(False)
        if share_features_extractor and self.actor_target is not None:
            assert self.critic_target.features_extractor is not None
            self.actor_target.share(self.critic_target.features_extractor)
        self.actor.optimizer = self.make_optimizer(self.actor.parameters(), lr_schedule(1))
        parameters: Any = list(self.critic.parameters())
        if encoder_learning_rate is not None:
            n = len(list(self.encoders()[0].parameters()))
            if n == 0:
                raise ValueError(
                    f"encoder_learning_rate={encoder_learning_rate!r} is of an encoder with parameters, and "
                    f"{type(self.encoders()[0]).__name__} has none: leave it out"
                )
            of_encoder = {"params": parameters[:n], "lr": encoder_learning_rate, "scheduled": False}
            parameters = [of_encoder, {"params": parameters[n:]}]
        self.critic.optimizer = self.make_optimizer(parameters, lr_schedule(1), **(critic_optimizer_kwargs or {}))
        if self.critic.trunk.stacks_rows is not None and (self.encodes_once or self.encodes_next_once):
            raise ValueError(
                f"target_encoder={target_encoder!r} and actor_features={actor_features!r} encode current and next "
                f"observations apart, and {type(self.critic.trunk).__name__} stacks them: leave them out"
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
            normalize_observations=normalize_observations,
            width_factor=width_factor,
            target_encoder=target_encoder,
            actor_features=actor_features,
            encoder_learning_rate=encoder_learning_rate,
            projection=projection,
            projection_gain=projection_gain,
        )

    def _projected(
        self, args: tuple[type[Network], dict[str, Any]], extractor: BaseFeaturesExtractor
    ) -> tuple[type[Network], dict[str, Any]]:
        """Class and arguments of a trunk that reads an extractor's features, behind the projection if there is one."""
        width, gain = self._projection
        if width is None:
            return args
        network, kwargs = args
        behind = {"network": network, "network_kwargs": kwargs}
        return Projected, {"n_features": extractor.features_dim, "width": width, "gain": gain, **behind}

    def encoders(self) -> list[nn.Module]:
        """
        :return: encoders that a reset may keep: the critics', and the target critics' if they have their own
        """
        critics = (self.critic, self.critic_target)
        return [critic.features_extractor for critic in critics if not critic.shares_encoder]  # type: ignore[misc]

    def _share_norm(self, network: Any) -> None:
        """Have a network read observations through the policy's own normalisation, which is in the policy's state."""
        if self.observation_norm is not None:
            # Bypass nn.Module's own setattr, which would register it.
            for each in (network, getattr(network, "at_rest", None)):
                if each is not None:
                    vars(each)["observation_norm"] = self.observation_norm

    def _chosen_actor(self, backbone: str, actor_kwargs: dict[str, Any] | None) -> tuple[type[Actor], dict[str, Any]]:
        """The actor's class and arguments, once they are checked."""
        if not isinstance(backbone, str) or backbone not in self.backbones:
            raise ValueError(f"backbone must be one of {sorted(self.backbones)}, not {backbone!r}")
        check_value("actor_kwargs", actor_kwargs, DICT)
        chosen, kwargs = self.backbones[backbone], dict(actor_kwargs or {})
        for name in kwargs:
            if name not in chosen.ARGUMENTS:
                raise ValueError(f"actor_kwargs has {name!r}, but backbone={backbone!r} takes {chosen.ARGUMENTS}")
        return chosen, kwargs

    def make_actor(self) -> Actor:
        """
        :return: an actor of the policy's class and settings, with its own parameters except for a shared encoder
        """
        args, kwargs = self._actor_args
        shared = self.share_features_extractor
        extractor: Any = self.critic.features_extractor if shared else self.make_features_extractor()
        actor = self._actor_class(
            self.observation_space,
            self.action_space,
            *self._projected(args, extractor),
            features_extractor=extractor,
            normalize_images=self.normalize_images,
            shares_encoder=shared,
            **kwargs,
        )
        self._share_norm(actor)
        return actor

    def make_value(self) -> ValueNetwork:
        """
        :return: a value network with the critics' settings and its own features extractor
        """
        extractor = self.make_features_extractor()
        value = ValueNetwork(
            self.observation_space,
            self.action_space,
            *self._projected(self._critic_args, extractor),
            features_extractor=extractor,
            normalize_images=self.normalize_images,
        )
        self._share_norm(value)
        return value

    def make_optimizer(self, parameters: Any, learning_rate: float, **kwargs: Any) -> torch.optim.Optimizer:
        """
        :param parameters: what to optimise
        :param learning_rate: learning rate at the start
        :param kwargs: settings that override the policy's
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
        if isinstance(obs, Encoded):
            return Encoded(obs.features.detach())
        return Encoded(self.actor.features(obs)) if self.share_features_extractor else obs

    def features(self, obs: Any) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them
        :return: the critics' features of them, (B, F), with a gradient to their encoder
        """
        return self.critic.features(obs)

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

    def obs_to_tensor(self, observation: Any) -> Any:
        """
        Convert observations of ``predict``, as in Stable-Baselines3.

        :param observation: one observation or several
        :return: tensors, (B, O), and whether there are several
        :raises ValueError: if a number of a Discrete or MultiDiscrete space lies outside of it
        """
        # Checks shapes first.
        converted = super().obs_to_tensor(observation)
        check_numbers("observation", self.observation_space, observation)
        return converted

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
        :return: the same in the action space's own bounds, (B, A), inside them even if scaling rounds. As in
            Stable-Baselines3, they are floats even if the space is one of integers
        """
        bounds = self._float_bounds(scaled_action.dtype)
        if bounds is None:
            return np.clip(super().unscale_action(scaled_action), self.action_space.low, self.action_space.high)
        low, high = bounds
        return np.clip(low + (0.5 * (scaled_action + 1.0) * (high - low)), low, high)

    def _float_bounds(self, dtype: Any) -> tuple[np.ndarray, np.ndarray] | None:
        """
        Bounds of a space of integers as floats, since small integers cannot hold their difference.

        :param dtype: type of the actions
        :return: the bounds in the type of Stable-Baselines3's arithmetic; None if the space is one of floats
        """
        space = self.action_space
        if np.issubdtype(space.dtype, np.floating):
            return None
        kind = np.result_type(dtype, space.dtype)
        kind = kind if np.issubdtype(kind, np.floating) else np.dtype(np.float64)
        return space.low.astype(kind), space.high.astype(kind)

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: training (True) or evaluation mode of actor and critics. In the targets, the features extractors
            stay in evaluation mode and the rest follows: dropout is active in the target critics too (DroQ)
        """
        self._mode_switch(mode)
        self.training = mode


def _running_norm(space: spaces.Space) -> RunningNorm:
    """Running normalisation of observations, without their task if they contain one."""
    if is_multi_task(space):
        return TaskRunningNorm(_normalized_shape(space["observation"]))  # type: ignore[index]
    return RunningNorm(_normalized_shape(space))


def _normalized_shape(space: spaces.Space) -> tuple[int, ...]:
    """Shape of observations whose running normalisation makes sense."""
    if isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating) and not is_image_space(space):
        return space.shape
    if is_image_space(space):
        raise ValueError(
            f"normalize_observations=True is not for images, which are divided by 255 (observations {space}): pass "
            "normalize_observations=False"
        )
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {"": space}
    vectors = [key for key, part in parts.items() if isinstance(part, spaces.Box) and not is_image_space(part)]
    keys = f", norm_obs_keys={vectors}" if isinstance(space, spaces.Dict) else ""
    wrapped = f", and the environment in VecNormalize(env{keys}), norm_reward=False with a reward_scale"
    raise ValueError(
        f"normalize_observations=True needs observations of a Box of floats, not of {space}: pass "
        f"normalize_observations=False{wrapped if vectors else ''}"
    )


MlpPolicy = SACPolicy


class CnnPolicy(SACPolicy):
    """:class:`SACPolicy` with a CNN as features extractor, for images."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs.setdefault("features_extractor_class", NatureCNN)
        super().__init__(*args, **kwargs)


class MultiInputPolicy(SACPolicy):
    """
    :class:`SACPolicy` with an extractor for dict observations; ``TaskOneHot`` if they are a vector and the task.

    :param observation_space: observation space
    """

    def __init__(self, observation_space: spaces.Space, *args: Any, **kwargs: Any):
        kwargs.setdefault("features_extractor_class", dict_extractor(observation_space))
        super().__init__(observation_space, *args, **kwargs)
