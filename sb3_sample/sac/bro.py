"""BRO, BRO Fast, and BRO on TD3."""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_sample.arguments import check_unused
from sb3_sample.kinds import AT_LEAST_0, check_value
from sb3_sample.learner.exploration import Exploration
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.sac import arguments
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.policies import SACPolicy

#: Critic sizes by their names in BRO, table 7 (parameters of all networks): residual blocks and width.
MODEL_SIZES: dict[str, tuple[int, int]] = {
    "0.55M": (1, 128),
    "1.05M": (1, 256),
    "2.83M": (1, 512),
    "4.92M": (2, 512),
    "26.31M": (3, 1024),
}

#: Environment steps at which all parameters are reset.
BRO_RESETS = (15_000, 50_000, 250_000, 500_000, 750_000, 1_000_000, 1_500_000, 2_000_000)
BRO_FAST_RESETS = (15_000,)

#: Arguments that are the optimistic actor's.
OPTIMISTIC_SHIFT_SETTINGS = (
    "kl_target",
    "std_multiplier",
    "initial_optimism",
    "initial_kl_weight",
    "adjustment_learning_rate",
)


class BRO(SAC):
    """
    BRO: bigger, regularized, optimistic (Nauman et al. 2024, https://arxiv.org/abs/2405.16158, algorithm 2).

    Two wide BroNet critics with 100 quantiles each and weight decay, their mean as value (no clipped double
    Q-learning), ten gradient steps a transition, full-parameter resets, and an optimistic actor that explores
    while the pessimistic one learns and is evaluated.

    Defaults are those of the published curves. Where the paper's text and the published code differ, the code is
    followed: the actors have one residual block (of table 5 it is not certain whether it says two), and the divergence
    goes from the optimistic to the pessimistic actor (algorithm 2 writes the other order). docs/bro.md lists all
    differences and misprints.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: of actor, critics, optimistic actor and temperature; a number or a function of the
        remaining progress (from 1 to 0)
    :param buffer_size: capacity of the replay buffer in transitions
    :param learning_starts: transitions with uniformly random actions before the first gradient step, counted over
        the model's life
    :param batch_size: transitions a gradient step
    :param tau: weight of the new critics in the Polyak average of the targets, in (0, 1]
    :param gamma: discount factor
    :param train_freq: as in Stable-Baselines3; if given, it replaces ``replay_ratio``
    :param gradient_steps: as in Stable-Baselines3; if given, it replaces ``replay_ratio``
    :param action_noise: noise added to the actions while training
    :param replay_buffer_class: class of the replay buffer; chosen by the observation space if None, one that stores
        one observation a step
    :param replay_buffer_kwargs: its arguments; ``memory_map="folder"`` keeps the default buffer in files
    :param optimize_memory_usage: for a ``replay_buffer_class`` that knows it. The default buffer saves the memory
        anyway, with time limits handled, and takes either value
    :param n_steps: n-step returns, as in Stable-Baselines3
    :param ent_coef: temperature: "auto" learns it from 1, "auto_0.1" from that start, a number fixes it
    :param target_update_interval: gradient steps between two updates of the targets; None: ``policy_delay``
    :param target_entropy: entropy that the learned temperature aims at; "auto" is -|A|/2
    :param replay_ratio: gradient steps per environment transition after the warm-up, whatever the number of
        environments; may be below 1
    :param model_size: size of the critics by its name in BRO, table 7 ("0.55M", "1.05M", "2.83M", "4.92M",
        "26.31M"), or (residual blocks, width); the actors are the same in all. None if ``policy_kwargs`` describe
        the critics
    :param n_quantiles: quantiles a critic; None for scalar critics
    :param pessimism: weight of the critics' spread that is subtracted from their mean, at least 0
    :param kl_target: KL divergence per action dimension between the two actors that optimism is adjusted to
    :param std_multiplier: factor on the standard deviation of the actor while exploring
    :param initial_optimism: weight of the critics' spread for the optimistic actor, at the start
    :param initial_kl_weight: weight of the divergence in the optimistic actor's loss, at the start
    :param adjustment_learning_rate: learning rate of optimism and of the divergence's weight
    :param weight_decay: decoupled weight decay of critics and both actors
    :param exploration: who acts while training: "optimistic_shift", "actor" for no optimistic actor, or another of
        :class:`SAC`'s
    :param exploration_kwargs: further arguments of the exploration
    :param resets: environment steps at which all parameters start anew, counted in transitions over the model's life;
        or one integer for every so many
    :param reset_gradient_steps: resets after every so many gradient steps of the model's life instead, in the place of
        the default of ``resets``; None for none
    :param use_sde: not supported, refused if True
    :param stats_window_size: episodes over which the logged return is averaged
    :param tensorboard_log: folder of the TensorBoard log; none if None
    :param policy_kwargs: arguments of the policy
    :param verbose: 0 nothing, 1 info, 2 debug
    :param seed: seed of everything random
    :param device: "auto", "cpu", "cuda", ...
    :param _init_setup_model: whether to build the networks at once
    :param kwargs: every other argument of :class:`SAC`, by name
    :raises ValueError: if an argument is out of range or contradicts another
    """

    temperature_beta1: ClassVar[float] = 0.5

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 2_500,
        batch_size: int = 128,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] | None = None,
        gradient_steps: int | None = None,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int | None = 1,
        target_entropy: str | float = "auto",
        replay_ratio: float = 10,
        model_size: str | Sequence[int] | None = "4.92M",
        n_quantiles: int | None = 100,
        pessimism: float | str | type[Pessimism] = 0.0,
        kl_target: float = 0.05,
        std_multiplier: float = 0.75,
        initial_optimism: float = 1.0,
        initial_kl_weight: float = 0.25,
        adjustment_learning_rate: float = 3e-5,
        weight_decay: float = 1e-4,
        exploration: str | type[Exploration] = "optimistic_shift",
        exploration_kwargs: dict[str, Any] | None = None,
        resets: Sequence[int] | int = BRO_RESETS,
        reset_gradient_steps: int | None = None,
        use_sde: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "auto",
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        self.model_size = model_size
        self.kl_target = kl_target
        self.std_multiplier = std_multiplier
        self.initial_optimism = initial_optimism
        self.initial_kl_weight = initial_kl_weight
        self.adjustment_learning_rate = adjustment_learning_rate
        self.weight_decay = weight_decay
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            replay_ratio=replay_ratio,
            n_quantiles=n_quantiles,
            pessimism=pessimism,
            exploration=exploration,
            exploration_kwargs=exploration_kwargs,
            resets=resets,
            reset_gradient_steps=reset_gradient_steps,
            use_sde=use_sde,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
            **kwargs,
        )

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.exploration == "optimistic_shift":
            same = {name: name for name in OPTIMISTIC_SHIFT_SETTINGS}
            arguments.check_once("exploration_kwargs", self.exploration_kwargs, same)
        else:
            check_unused(self, OPTIMISTIC_SHIFT_SETTINGS, f"exploration={self.exploration!r}")
        check_value("weight_decay", self.weight_decay, AT_LEAST_0)
        described = sorted({"critic_network", "critic_network_kwargs"} & self.policy_kwargs.keys())
        if described and self.model_size is not None:
            raise ValueError(
                f"policy_kwargs describe the critics ({', '.join(described)}), and so does "
                f"model_size={self.model_size!r}: pass model_size=None"
            )
        if "weight_decay" in (self.policy_kwargs.get("optimizer_kwargs") or {}):
            raise ValueError("weight_decay is an argument of the algorithm, not of policy_kwargs['optimizer_kwargs']")

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs: dict[str, Any] = {
            "critic_network": "bronet",
            "actor_network": "bronet",
            **super()._full_policy_kwargs(),
        }
        if kwargs["actor_network"] == "bronet":
            kwargs.setdefault("actor_network_kwargs", {"width": 256, "n_blocks": 1})
        if self.model_size is not None:
            kwargs["critic_network_kwargs"] = dict(
                zip(("n_blocks", "width"), _model_size(self.model_size), strict=True)
            )
        kwargs["optimizer_kwargs"] = {**(kwargs.get("optimizer_kwargs") or {}), "weight_decay": self.weight_decay}
        return kwargs

    def _full_exploration_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_exploration_kwargs()
        if self.exploration == "optimistic_shift":
            kwargs = {**{name: getattr(self, name) for name in OPTIMISTIC_SHIFT_SETTINGS}, **kwargs}
        return kwargs


class BROFast(BRO):
    """
    BRO Fast: BRO with two gradient steps a transition and, as in the published code, the first reset only. The
    arguments are BRO's.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: a number or a function of the remaining progress (from 1 to 0)
    :param replay_ratio: gradient steps per environment transition
    :param resets: environment steps at which all parameters start anew
    :param kwargs: every other argument of ``BRO``, by name
    """

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        replay_ratio: float = 2,
        resets: Sequence[int] | int = BRO_FAST_RESETS,
        **kwargs: Any,
    ):
        super().__init__(policy, env, learning_rate, replay_ratio=replay_ratio, resets=resets, **kwargs)


class BROTD3(BRO):
    """
    BRO on TD3 instead of soft actor-critic (section E.3 and figure 17; TD3 by Fujimoto et al. 2018): deterministic
    actors, a target actor, smoothed target actions, delayed actor updates, and no entropy. The rest, the two actors
    included, is BRO's.

    The paper says no more than that; decided here: exploration adds Gaussian noise to the optimistic actor's action;
    the KL divergence of the two actors is taken between Gaussians of that noise around their actions; the actors, the
    target actor and the targets move every second gradient step, as in TD3; ``std_multiplier`` is 1, so that the noise
    is what ``exploration_noise`` says; and pessimism stays at BRO's 0, where TD3 has the minimum
    (``pessimism=1``).

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: a number or a function of the remaining progress (from 1 to 0)
    :param exploration_noise: standard deviation of the noise while exploring, in actions of [-1, 1]
    :param target_noise: standard deviation of the noise on the target's action
    :param target_noise_clip: bound of that noise
    :param policy_delay: gradient steps between two of the actors'
    :param target_update_interval: gradient steps between two updates of the target critics; None: ``policy_delay``
    :param std_multiplier: factor on the noise of the optimistic actor
    :param kwargs: every other argument of ``BRO``, by name; ``ent_coef`` and ``target_entropy`` have no meaning here
    :raises ValueError: if an argument is out of range or contradicts another
    """

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        exploration_noise: float = 0.1,
        target_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        policy_delay: int = 2,
        target_update_interval: int | None = None,
        std_multiplier: float = 1.0,
        backbone: str = "td3",
        **kwargs: Any,
    ):
        self.exploration_noise = exploration_noise
        self.target_noise = target_noise
        self.target_noise_clip = target_noise_clip
        super().__init__(
            policy,
            env,
            learning_rate,
            policy_delay=policy_delay,
            target_update_interval=target_update_interval,
            std_multiplier=std_multiplier,
            backbone=backbone,
            **kwargs,
        )

    def _check_arguments(self) -> None:
        super()._check_arguments()
        noise = ("exploration_noise", "target_noise", "target_noise_clip")
        given = self.policy_kwargs.get("actor_kwargs")
        arguments.check_once("policy_kwargs['actor_kwargs']", given, {name: name for name in noise})
        if self.backbone != "td3":
            raise ValueError(f"BROTD3 has backbone='td3', not {self.backbone!r}: use BRO")

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_policy_kwargs()
        own = {name: getattr(self, name) for name in ("exploration_noise", "target_noise", "target_noise_clip")}
        return {**kwargs, "actor_kwargs": {**own, **(kwargs.get("actor_kwargs") or {})}}


def _model_size(model_size: str | Sequence[int]) -> tuple[int, int]:
    """Residual blocks and width of a size given by name or by these two numbers."""
    size: Any = MODEL_SIZES.get(model_size) if isinstance(model_size, str) else model_size
    if isinstance(size, Sequence) and len(size) == 2 and all(isinstance(n, int) for n in size):
        return size[0], size[1]
    raise ValueError(f"model_size must be one of {list(MODEL_SIZES)} or (residual blocks, width), not {model_size!r}")
