"""Networks of DR.Q as Stable-Baselines3 policies: an encoder, and values and policy that read its embeddings."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    FlattenExtractor,
    NatureCNN,
    get_actor_critic_arch,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_sample.arguments import check_net_arch
from sb3_sample.kinds import check_value, integer
from sb3_sample.learner.batch import Encoded
from sb3_sample.networks import RunningNorm
from sb3_sample.networks.modes import ModeSwitch, evaluated
from sb3_sample.networks.normed_mlp import NormedMLP, xavier_linear
from sb3_sample.optim import AdamW
from sb3_sample.sac.actors import BACKBONES, Actor
from sb3_sample.sac.critics import CriticEnsemble
from sb3_sample.sac.features import TensorFeatures
from sb3_sample.sac.multi_task import dict_extractor
from sb3_sample.sac.policies import SACPolicy


class Encoder(BaseFeaturesExtractor):
    """
    Encoder of states and actions, with a linear model of the next state's embedding, the reward, and the end of the
    episode, whose output the published code does not train.

    :param observation_space: observation space
    :param features_extractor: extractor that the observation goes through first
    :param action_dim: A
    :param width: width of the hidden layers
    :param state_embedding: size of a state's embedding, D
    :param action_embedding: size of an action's embedding
    :param pair_embedding: size of the embedding of both, P
    :param n_reward_atoms: K, number of rewards that the model distinguishes
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        features_extractor: BaseFeaturesExtractor,
        action_dim: int,
        width: int,
        state_embedding: int,
        action_embedding: int,
        pair_embedding: int,
        n_reward_atoms: int,
    ):
        super().__init__(observation_space, state_embedding)
        self.n_reward_atoms, self.pair_dim = n_reward_atoms, pair_embedding
        self.features_extractor = features_extractor
        self.state = NormedMLP(features_extractor.features_dim, (width, width, state_embedding))
        self.action = xavier_linear(action_dim, action_embedding)
        self.pair_hidden = NormedMLP(state_embedding + action_embedding, (width, width))
        self.pair_output = xavier_linear(width, pair_embedding)
        self.model = xavier_linear(pair_embedding, 1 + state_embedding + n_reward_atoms)

    def forward(self, observations: Any) -> torch.Tensor:
        """
        :param observations: (B, O), or a dict of them, preprocessed as Stable-Baselines3 does
        :return: the states' embeddings, (B, D)
        """
        features: torch.Tensor = self.features_extractor(observations)
        # Stable-Baselines3 preprocesses to float32.
        return self.state(features.to(self.action.weight.dtype))  # type: ignore[no-any-return]

    def pair(self, states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """
        :param states: embeddings of states, (B, D)
        :param actions: in [-1, 1], (B, A)
        :return: the pairs' embeddings, (B, P)
        """
        return self.pair_output(self.pair_hidden(torch.cat((states, F.elu(self.action(actions))), dim=1)))  # type: ignore[no-any-return]

    def predict(self, pairs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """
        :param pairs: embeddings of states and actions, (B, P)
        :return: predicted embeddings of the next states, (B, D), and logits of the reward's atoms, (B, K)
        """
        _, following, reward = self.model(pairs).split((1, self.features_dim, self.n_reward_atoms), dim=1)
        return following, reward


class EmbeddedCritics(CriticEnsemble):
    """
    E critics that read embeddings of states and actions. The encoder is not part of them: they give it no gradient, and
    it is in the parameters, the state and the modes of its owner only.

    :param observation_space: observation space
    :param action_space: action space
    :param encoder: encoder of states and actions
    :param hidden_sizes: widths of the hidden layers
    :param n_critics: E
    :param n_outputs: K, the number of quantiles, or 1
    :param normalize_images: whether images are divided by 255
    """

    _encoder: Any

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        encoder: Encoder,
        hidden_sizes: Sequence[int],
        n_critics: int = 2,
        n_outputs: int = 1,
        normalize_images: bool = True,
    ):
        BaseModel.__init__(self, observation_space, action_space, normalize_images=normalize_images)
        self.n_critics = n_critics
        self._embedded_args = {"hidden_sizes": hidden_sizes, "n_outputs": n_outputs}
        self.trunk = NormedMLP(encoder.pair_dim, hidden_sizes, n_copies=n_critics)
        self.head = xavier_linear(self.trunk.out_features, n_outputs, n_critics)
        # Bypass nn.Module's own setattr, which would register it.
        vars(self)["_encoder"] = evaluated(encoder)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {**self._embedded_args, "encoder": self._encoder, "n_critics": self.n_critics}
        return {**BaseModel._get_constructor_parameters(self), **own}

    def inputs(self, obs: PyTorchObs | Encoded, actions: torch.Tensor) -> torch.Tensor:
        """
        :param obs: observations, (B, O), or a dict of them, or their embeddings
        :param actions: actions in [-1, 1], (B, A)
        :return: embeddings of both, (B, P), with a gradient to the actions only
        """
        with torch.no_grad():
            states = obs.features if isinstance(obs, Encoded) else self.extract_features(obs, self._encoder)
        return self._encoder.pair(states, actions)  # type: ignore[no-any-return]

    def statistics(self) -> list[torch.Tensor]:
        """
        :return: empty: the networks have no running statistics
        """
        return []


class DebiasedRQPolicy(TensorFeatures, SACPolicy):
    """
    The networks of DR.Q: encoder, actor and critics, and the targets of encoder, critics and, with "td3", actor.

    :param observation_space: observation space
    :param action_space: action space, a bounded Box
    :param lr_schedule: learning rate schedule; its value at the start is used here
    :param net_arch: widths of the hidden layers as in Stable-Baselines3, a list or ``dict(pi=[...], qf=[...])``; if
        None, two of 512 for the actor and three for the critics
    :param encoder_width: width of the encoder's hidden layers
    :param state_embedding: size of a state's embedding
    :param action_embedding: size of an action's embedding
    :param pair_embedding: size of the embedding of both
    :param n_reward_atoms: rewards that the model of the environment distinguishes
    :param n_critics: E, the number of critics
    :param n_outputs: outputs per critic, as the value head requires
    :param features_extractor_class: features extractor, the first part of the encoder
    :param features_extractor_kwargs: its arguments
    :param normalize_images: whether images are divided by 255
    :param backbone: "td3" for a deterministic actor with a target actor, "sac" for a tanh-Gaussian one without
    :param actor_kwargs: with "td3" ``exploration_noise``, ``target_noise``, ``target_noise_clip``; with "sac"
        ``log_std_min``, ``log_std_max``, ``clip_log_std``, ``initial_std``
    :param optimizer_class: optimizer of encoder, actor and critics
    :param optimizer_kwargs: its arguments, except the learning rate
    :param width_factor: factor on the widths of all hidden layers and embeddings
    :raises ValueError: if an argument is out of range
    """

    backbones: ClassVar[Mapping[str, type[Actor]]] = {name: BACKBONES[name] for name in ("sac", "td3")}
    encoder: Encoder
    encoder_target: Encoder
    observation_norm: RunningNorm | None = None

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: Sequence[int] | dict[str, list[int]] | None = None,
        encoder_width: int = 750,
        state_embedding: int = 512,
        action_embedding: int = 256,
        pair_embedding: int = 512,
        n_reward_atoms: int = 65,
        n_critics: int = 2,
        n_outputs: int = 1,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        backbone: str = "td3",
        actor_kwargs: dict[str, Any] | None = None,
        optimizer_class: type[torch.optim.Optimizer] = AdamW,
        optimizer_kwargs: dict[str, Any] | None = None,
        width_factor: int = 1,
    ):
        drawn_from = torch.get_rng_state()
        # Not SACPolicy's own constructor, which makes other networks.
        BasePolicy.__init__(
            self,
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
            normalize_images=normalize_images,
        )
        self.drawn_from = drawn_from
        sizes = {
            "width": ("encoder_width", encoder_width),
            "state_embedding": ("state_embedding", state_embedding),
            "action_embedding": ("action_embedding", action_embedding),
            "pair_embedding": ("pair_embedding", pair_embedding),
        }
        check_value("width_factor", width_factor, integer(1))
        sizes_of_encoder = {key: width_factor * check_value(*named, integer(1)) for key, named in sizes.items()}
        check_value("n_reward_atoms", n_reward_atoms, integer(2))
        check_value("n_critics", n_critics, integer(1))
        check_value("n_outputs", n_outputs, integer(1))
        self._actor_class, actor_args = self._chosen_actor(backbone, actor_kwargs)
        check_net_arch(net_arch, ("pi", "qf"), both=True)
        pi_arch, qf_arch = [512] * 2, [512] * 3
        if net_arch is not None:
            pi_arch, qf_arch = get_actor_critic_arch(net_arch if isinstance(net_arch, dict) else list(net_arch))
        pi_arch, qf_arch = ([width_factor * width for width in arch] for arch in (pi_arch, qf_arch))
        self.share_features_extractor = True
        self.encoder = Encoder(
            observation_space,
            self.make_features_extractor(),
            get_action_dim(action_space),
            **sizes_of_encoder,
            n_reward_atoms=n_reward_atoms,
        )
        self._actor_args: Any = (pi_arch, actor_args)
        self.actor = self.make_actor()
        self.critic = EmbeddedCritics(
            observation_space, action_space, self.encoder, qf_arch, n_critics, n_outputs, normalize_images
        )
        # Copied together, so that the copies read the encoder's copy.
        online: Any = (self.encoder, self.actor, self.critic)
        targets = copy.deepcopy(online)
        self.encoder_target, self.actor_target, self.critic_target = targets
        if self.actor.has_entropy:
            self.actor_target = None
        for target in targets:
            target.requires_grad_(False)
            target.train(False)
        for module in online:
            module.optimizer = self.make_optimizer(module.parameters(), lr_schedule(1))
        self._mode_switch = ModeSwitch(self.encoder, self.actor, self.critic)
        self._constructor_args = dict(
            lr_schedule=self._dummy_schedule,
            net_arch=net_arch,
            encoder_width=encoder_width,
            state_embedding=state_embedding,
            action_embedding=action_embedding,
            pair_embedding=pair_embedding,
            n_reward_atoms=n_reward_atoms,
            n_critics=n_critics,
            n_outputs=n_outputs,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
            backbone=backbone,
            actor_kwargs=actor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
            width_factor=width_factor,
        )

    def make_actor(self) -> Actor:
        """
        :return: an actor with the policy's settings and its own parameters, which reads the encoder's embeddings
        """
        hidden_sizes, kwargs = self._actor_args
        actor = self._actor_class(
            self.observation_space,
            self.action_space,
            NormedMLP,
            {"hidden_sizes": hidden_sizes, "activation_fn": nn.ReLU},
            features_extractor=self.encoder,
            normalize_images=self.normalize_images,
            shares_encoder=True,
            **kwargs,
        )
        actor.mean = xavier_linear(actor.trunk.out_features, actor.action_dim)
        if actor.has_entropy:
            actor.log_std = xavier_linear(actor.trunk.out_features, actor.action_dim)
            if kwargs.get("initial_std") is not None:
                actor.start_from(kwargs["initial_std"])
        return actor

    def embedded(self, obs: Any, target: bool = False) -> torch.Tensor:
        """
        Embed states, with a gradient to the encoder.

        :param obs: observations, (B, O), or a dict of them
        :param target: whether by the target encoder
        :return: their embeddings, (B, D)
        """
        return self.extract_features(obs, self.encoder_target if target else self.encoder)  # type: ignore[no-any-return]


class DebiasedRQCnnPolicy(DebiasedRQPolicy):
    """Networks of DR.Q with a CNN before the encoder, for images."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs.setdefault("features_extractor_class", NatureCNN)
        super().__init__(*args, **kwargs)


class DebiasedRQMultiInputPolicy(DebiasedRQPolicy):
    """
    Networks of DR.Q with an extractor for dict observations before the encoder; ``TaskOneHot`` if they are a vector and
    the task.

    :param observation_space: observation space
    """

    def __init__(self, observation_space: spaces.Space, *args: Any, **kwargs: Any):
        kwargs.setdefault("features_extractor_class", dict_extractor(observation_space))
        super().__init__(observation_space, *args, **kwargs)
