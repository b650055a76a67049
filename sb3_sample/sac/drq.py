"""DrQ and DrQ-v2: soft actor-critic, and DDPG, from images."""

from collections.abc import Sequence
from typing import Any, ClassVar

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_sample.constructor import argument
from sb3_sample.kinds import AT_LEAST_0, TRUE_OR_FALSE, integer
from sb3_sample.learner.exploration import NOISE_SCHEDULE, Exploration
from sb3_sample.sac import checks
from sb3_sample.sac.actors import Actor, NoisyActor
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.encoders import ConvEncoder
from sb3_sample.sac.pixels import check_images
from sb3_sample.sac.policies import CnnPolicy, SACPolicy


class _FromPixels(SAC):
    """SAC with the encoder, the projections, the layers and the augmentation of DrQ."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": CnnPolicy}

    buffer_size: int = argument(default=100_000, kw_only=False)
    """capacity of the replay buffer in transitions; with 84 by 84 pixels, each takes 21 kB if the environment declares
    that it stacks frames"""
    tau: float = argument(default=0.01, kw_only=False)
    """weight of the new critics in the Polyak average of the targets, in (0, 1]"""
    augmentation: str | None = argument(default="shift")
    """"shift": every image of a batch is shifted by a few pixels at random; None for none"""
    layer_norm: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """whether the critics' hidden layers have layer norm: Dense, layer norm, ReLU ("Overestimation, overfitting, and
    plasticity in actor-critic", Nauman et al. 2024, table 2, "+ LN")"""

    def _check_arguments(self) -> None:
        check_images(type(self).__name__, self.observation_space)
        super()._check_arguments()
        if self.layer_norm:
            same = {"layer_norm": "layer_norm"}
            checks.check_once(
                "policy_kwargs['critic_network_kwargs']", self.policy_kwargs.get("critic_network_kwargs"), same
            )
            network = self.policy_kwargs.get("critic_network", "mlp")
            if network != "mlp":
                raise ValueError(f"layer_norm=True is of critic_network='mlp', not of {network!r}: leave it out")

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_policy_kwargs()
        if kwargs.get("features_extractor_class", ConvEncoder) is ConvEncoder:
            own = {**self._encoder_kwargs(), **(kwargs.get("features_extractor_kwargs") or {})}
            kwargs = {**kwargs, "features_extractor_class": ConvEncoder, "features_extractor_kwargs": own}
        kwargs = {"projection": 50, "share_features_extractor": True, **kwargs}
        for name in "actor", "critic":
            if kwargs.get(f"{name}_network", "mlp") == "mlp":
                key = f"{name}_network_kwargs"
                of_mlp: dict[str, Any] = {"gain": 1.0}
                if self.layer_norm and name == "critic":
                    of_mlp["layer_norm"] = True
                if kwargs.get("net_arch") is None:
                    of_mlp["hidden_sizes"] = (1024, 1024)
                kwargs[key] = {**of_mlp, **(kwargs.get(key) or {})}
        return kwargs

    def _encoder_kwargs(self) -> dict[str, Any]:
        """
        :return: the encoder's arguments, if it is DrQ's
        """
        return {}


class DrQ(_FromPixels):
    """
    DrQ (Kostrikov et al. 2021, https://arxiv.org/abs/2004.13649): soft actor-critic from images, which are shifted by a
    few pixels at random. The critics' target is the mean over K shifts of the next image, their loss the sum over M
    shifts of the image. Critics and actor share an encoder of four convolutions, which the critics train; each has its
    own projection to 50 features.

    Defaults are those of the published PyTorch code; docs/drq.md has those of the JAX code behind "The primacy bias".

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_rate: float | Schedule = argument(default=1e-3, kw_only=False)
    """learning rate of all networks and the temperature; a number or a function of the remaining progress (from 1 to
    0)"""
    learning_starts: int = argument(default=1_000, kw_only=False)
    """transitions with uniformly random actions before the first gradient step, counted over the model's life"""
    batch_size: int = argument(default=512, kw_only=False)
    """transitions per gradient step"""
    ent_coef: str | float = argument(default="auto_0.1", kw_only=False)
    """temperature: "auto" learns it from 1, "auto_0.1" from that start, a number fixes it"""
    target_entropy: str | float = argument(default="auto", kw_only=False)
    """entropy that the learned temperature aims at; "auto" is -|A|"""
    target_update_interval: int | None = argument(default=2, kw_only=False)
    """gradient steps between two updates of the targets; None: ``policy_delay``"""
    replay_ratio: float | None = argument(default=1)
    """gradient steps per environment transition after the warm-up, whatever the number of environments; may be below
    1"""
    policy_delay: int = argument(default=2)
    """gradient steps between two updates of actors and temperature"""
    target_copies: int = argument(default=2, kind=integer(1))
    """K, number of shifts of a next image over which the critics' target is averaged"""
    online_copies: int = argument(default=2, kind=integer(1))
    """M, number of shifts of an image over which the critics' loss is summed"""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        copies = {name: name for name in ("target_copies", "online_copies")}
        checks.check_once("augmentation_kwargs", self.augmentation_kwargs, copies)
        if self.augmentation is None and (self.target_copies, self.online_copies) != (1, 1):
            raise ValueError(
                f"target_copies={self.target_copies} and online_copies={self.online_copies} are copies of augmented "
                "images, and augmentation=None has none: pass target_copies=1, online_copies=1"
            )

    def _full_augmentation_kwargs(self) -> dict[str, Any]:
        copies = {"target_copies": self.target_copies, "online_copies": self.online_copies}
        return {**copies, **super()._full_augmentation_kwargs()}

    def _auto_target_entropy(self, action_dim: int) -> float:
        return -float(action_dim)


class DrQv2Policy(CnnPolicy):
    """
    The networks of DrQ-v2: a deterministic actor whose noise changes during training.

    :param args: as for ``CnnPolicy``
    :param kwargs: as for ``CnnPolicy``; ``actor_kwargs`` has ``noise_clip`` and ``noise_std``
    """

    backbones: ClassVar[dict[str, type[Actor]]] = {"td3": NoisyActor}


class DrQv2(_FromPixels):
    """
    DrQ-v2 (Yarats et al. 2022, https://arxiv.org/abs/2107.09645): DDPG with two critics from images, which are shifted
    by a few pixels at random; returns of three steps, and Gaussian noise that declines during training, clipped in the
    critics' target and in the actor's loss. The encoder has no target, and the actor learns from the features that the
    critics saw. Actor and critics each have their own projection to 50 features.

    Defaults are those of the published code for its tasks of medium difficulty.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": DrQv2Policy}
    policy_base: ClassVar[type[SACPolicy]] = DrQv2Policy

    learning_rate: float | Schedule = argument(default=1e-4, kw_only=False)
    """learning rate of all networks; a number or a function of the remaining progress (from 1 to 0)"""
    buffer_size: int = argument(default=1_000_000, kw_only=False)
    """capacity of the replay buffer in transitions, 21 GB with 84 by 84 pixels; ``replay_buffer_kwargs`` with
    ``memory_map`` keeps the transitions in files"""
    learning_starts: int = argument(default=2_000, kw_only=False)
    """transitions with uniformly random actions before the first gradient step, counted over the model's life"""
    n_steps: int = argument(default=3, kw_only=False)
    """n-step returns, as in Stable-Baselines3"""
    replay_ratio: float | None = argument(default=0.5)
    """gradient steps per environment transition after the warm-up, whatever the number of environments; may be below
    1"""
    noise_schedule: Sequence[float] = argument(default=(1.0, 0.1, 500_000), kind=NOISE_SCHEDULE)
    """standard deviation of the noise at the beginning and at the end of its linear decline, in actions of [-1, 1], and
    the length of the decline, in transitions over the model's life: 100,000 for DrQ-v2's easy tasks, 2,000,000 for its
    hard ones"""
    noise_clip: float = argument(default=0.3, kind=AT_LEAST_0)
    """bound of the noise in the critics' target and in the actor's loss"""
    exploration: str | type[Exploration] = argument(default="scheduled_noise")
    """policy that acts while training: "scheduled_noise", which follows ``noise_schedule``; with any other the noise
    stays at the schedule's first standard deviation"""
    backbone: str = argument(default="td3")
    """"td3"; no other"""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.backbone != "td3":
            raise ValueError(f"DrQv2 has backbone='td3', not {self.backbone!r}: use DrQ")
        same = {"noise_clip": "noise_clip", "noise_std": "noise_schedule"}
        checks.check_once("policy_kwargs['actor_kwargs']", self.policy_kwargs.get("actor_kwargs"), same)
        checks.check_once("exploration_kwargs", self.exploration_kwargs, {"schedule": "noise_schedule"})

    def _encoder_kwargs(self) -> dict[str, Any]:
        return {"offset": 0.5}

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_policy_kwargs()
        own = {"noise_clip": self.noise_clip, "noise_std": float(self.noise_schedule[0])}
        noise = {**own, **(kwargs.get("actor_kwargs") or {})}
        choices = {"target_encoder": "online", "actor_features": "before"} if kwargs["share_features_extractor"] else {}
        return {**choices, **kwargs, "actor_kwargs": noise}

    def _full_exploration_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_exploration_kwargs()
        return {"schedule": self.noise_schedule, **kwargs} if self.exploration == "scheduled_noise" else kwargs
