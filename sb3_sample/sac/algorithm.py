"""
The off-policy family: soft actor-critic with exchangeable parts, and its one update.

``SAC._update`` is the whole gradient step, in the order of BRO's pseudo-code (P5, algorithm 2).
"""

import inspect
import io
import math
import pathlib
from collections.abc import Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule, TrainFreq
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.envs.finite_check import FiniteCheck
from sb3_sample.optim import AdamW
from sb3_sample.sac import losses
from sb3_sample.sac.batch import Batch, Noise, draw_batches
from sb3_sample.sac.exploration import EXPLORATIONS, Exploration
from sb3_sample.sac.parts import Part
from sb3_sample.sac.pessimism import FixedPessimism, Pessimism
from sb3_sample.sac.plasticity import Resets
from sb3_sample.sac.policies import Actor, CnnPolicy, CriticEnsemble, MlpPolicy, MultiInputPolicy, SACPolicy
from sb3_sample.sac.scalars import FixedScalar, LogScalar

Self = TypeVar("Self", bound="SAC")

# Batches of at most this many gradient steps are drawn at once, to bound the memory they take.
MAX_BATCHES_AT_ONCE = 64


class SAC(OffPolicyAlgorithm):
    """
    Soft actor-critic with exchangeable parts, the base of every off-policy algorithm here. On its own it is the
    SAC that the papers compare with (P2-P5): tanh-Gaussian actor, two critics, clipped double Q-learning.

    It differs from ``stable_baselines3.SAC`` by design: the order of the update (critics, targets, actor,
    temperature), the squared error without the factor 1/2, the temperature's gradient through the temperature
    instead of its logarithm, a target entropy of -|A|/2, orthogonal initialisation, and a log standard
    deviation squashed into [-10, 2] instead of clipped.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: of actor, critics and temperature; a number or a function of the remaining progress
        (from 1 to 0)
    :param buffer_size: capacity of the replay buffer in transitions
    :param learning_starts: transitions with uniformly random actions before the first gradient step, counted over
        the model's life
    :param batch_size: transitions a gradient step
    :param tau: weight of the new critics in the Polyak average of the targets, in (0, 1]
    :param gamma: discount factor
    :param train_freq: as in Stable-Baselines3, every how many steps (or ``(n, "episode")``) to train; if given,
        with ``gradient_steps``, it replaces ``replay_ratio``
    :param gradient_steps: as in Stable-Baselines3, gradient steps each time (-1: as many as transitions were
        collected); if given, it replaces ``replay_ratio``
    :param action_noise: noise added to the actions while training
    :param replay_buffer_class: class of the replay buffer; chosen by the observation space if None
    :param replay_buffer_kwargs: its arguments
    :param optimize_memory_usage: as in Stable-Baselines3's replay buffer
    :param n_steps: n-step returns, as in Stable-Baselines3
    :param ent_coef: temperature: "auto" learns it, "auto_0.1" from that start, a number fixes it
    :param target_update_interval: gradient steps between two updates of the targets
    :param target_entropy: entropy that the learned temperature aims at; "auto" is -|A|/2
    :param replay_ratio: gradient steps per environment transition after the warm-up, whatever the number of
        environments; may be below 1
    :param n_quantiles: quantiles a critic; None for scalar critics
    :param pessimism: weight of the critics' spread that is subtracted from their mean, at least 0; 1 is the
        minimum of two critics, 0 the mean
    :param exploration: who acts while training: "actor", "optimistic_shift" (BRO)
    :param exploration_kwargs: its arguments
    :param resets: environment steps at which all parameters start anew, counted in transitions over the model's life
    :param use_sde: not supported, refused if True
    :param stats_window_size: episodes over which the logged return is averaged
    :param tensorboard_log: folder of the TensorBoard log; none if None
    :param policy_kwargs: arguments of the policy
    :param verbose: 0 nothing, 1 info, 2 debug
    :param seed: seed of everything random
    :param device: "auto", "cpu", "cuda", ...
    :param _init_setup_model: whether to build the networks at once
    :raises ValueError: if an argument is out of range or contradicts another
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: SACPolicy
    actor: Actor
    critic: CriticEnsemble
    critic_target: CriticEnsemble
    #: beta1 of the temperature's Adam.
    temperature_beta1: ClassVar[float] = 0.9

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 10_000,
        batch_size: int = 256,
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
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        replay_ratio: float = 2,
        n_quantiles: int | None = None,
        pessimism: float = 1.0,
        exploration: str = "actor",
        exploration_kwargs: dict[str, Any] | None = None,
        resets: Sequence[int] = (),
        use_sde: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        if use_sde:
            raise ValueError(
                "use_sde=True is not supported by this family of algorithms: use action_noise, "
                f"or exploration=, one of {sorted(EXPLORATIONS)}"
            )
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]  # None when a model is loaded for prediction only
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            1 if train_freq is None else train_freq,
            1 if gradient_steps is None else gradient_steps,
            action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            support_multi_env=True,
        )
        # None: Stable-Baselines3's two arguments are in force.
        self.replay_ratio: float | None = replay_ratio if train_freq is None and gradient_steps is None else None
        self.n_quantiles = n_quantiles
        self.ent_coef = ent_coef
        self.target_update_interval = target_update_interval
        self.target_entropy = target_entropy
        self.pessimism = pessimism
        self.exploration = exploration
        self.exploration_kwargs = exploration_kwargs
        self.resets = resets
        #: Transitions stored over the model's life; unlike ``num_timesteps`` never zeroed by ``learn``.
        self.num_transitions = 0
        # Gradient steps owed but not yet taken, the fraction that a replay ratio leaves over.
        self._updates_owed = 0.0
        self._metrics: dict[str, torch.Tensor] = {}
        if _init_setup_model:
            self._setup_model()

    # ---------------------------------------------------------------- construction

    def _setup_model(self) -> None:
        self._check_arguments()
        given = self.policy_kwargs
        # The policy is built with more than the user's own arguments, and only the latter are saved.
        self.policy_kwargs = self._full_policy_kwargs()
        try:
            super()._setup_model()
        finally:
            self.policy_kwargs = given
        if self.device.type == "cpu":
            # glibc hands freed memory back to the system above a threshold, at first below the size of one gradient,
            # and every update then pays for page faults. The threshold follows the largest block freed so far.
            torch.empty(31 * 2**20, dtype=torch.uint8)
        self.actor, self.critic, self.critic_target = self.policy.actor, self.policy.critic, self.policy.critic_target
        self._target_entropy = (
            -self.actor.action_dim / 2 if self.target_entropy == "auto" else float(self.target_entropy)
        )
        self._critic_loss = losses.squared_error if self.n_quantiles is None else losses.quantile_huber
        self.temperature = self._make_temperature()
        self.explorer = self._make_explorer()
        self.pessimism_rule: Pessimism = FixedPessimism(self.pessimism).to(self.device)
        self.plasticity = Resets(self.resets)
        self.temperature_optimizer: AdamW | None = None
        if isinstance(self.temperature, LogScalar):
            betas = (self.temperature_beta1, 0.999)
            self.temperature_optimizer = AdamW(self.temperature.parameters(), lr=self.lr_schedule(1), betas=betas)

    def _check_arguments(self) -> None:
        """
        :raises ValueError: if an argument is out of range or contradicts another
        """
        for name, low in (
            ("buffer_size", 1),
            ("learning_starts", 0),
            ("batch_size", 1),
            ("target_update_interval", 1),
            ("n_steps", 1),
        ):
            if not getattr(self, name) >= low:
                raise ValueError(f"{name} must be at least {low}, not {getattr(self, name)}")
        if (
            not callable(self.learning_rate)
            and not 0 <= _number("learning_rate", self.learning_rate, "a schedule") < math.inf
        ):
            raise ValueError(f"learning_rate must be at least 0 and finite, or a schedule, not {self.learning_rate}")
        if isinstance(self.replay_ratio, str) or not (self.replay_ratio is None or 0 <= self.replay_ratio < math.inf):
            raise ValueError(f"replay_ratio must be at least 0 and finite, not {self.replay_ratio!r}")
        if not 0 < self.tau <= 1:
            raise ValueError(f"tau must lie in (0, 1], not {self.tau}")
        if not 0 <= self.gamma <= 1:
            raise ValueError(f"gamma must lie in [0, 1], not {self.gamma}")
        if self.target_entropy != "auto" and not math.isfinite(
            _number("target_entropy", self.target_entropy, "'auto'")
        ):
            raise ValueError(f"target_entropy must be finite, or 'auto', not {self.target_entropy}")
        if self.exploration not in EXPLORATIONS:
            raise ValueError(f"exploration must be one of {sorted(EXPLORATIONS)}, not {self.exploration!r}")
        if "n_quantiles" in self.policy_kwargs:
            raise ValueError("n_quantiles is an argument of the algorithm, not of policy_kwargs")
        train_freq: Any = self.train_freq
        if not isinstance(train_freq, TrainFreq):
            every, unit = train_freq if isinstance(train_freq, tuple) else (train_freq, "step")
            if not isinstance(every, int) or every < 1 or unit not in ("step", "episode"):
                raise ValueError(f"train_freq must be at least 1, or (n, 'step' or 'episode'), not {train_freq!r}")
            if unit == "episode" and self.env is not None and self.n_envs > 1:
                raise ValueError(
                    f"train_freq={train_freq!r} counts episodes, which needs one environment, not {self.n_envs}"
                )

    def _full_policy_kwargs(self) -> dict[str, Any]:
        """
        :return: the policy's arguments: the user's and the algorithm's
        """
        return {**self.policy_kwargs, "n_quantiles": self.n_quantiles}

    def _full_exploration_kwargs(self) -> dict[str, Any]:
        """
        :return: the explorer's arguments: the user's and the algorithm's
        """
        return dict(self.exploration_kwargs or {})

    def _make_temperature(self) -> LogScalar | FixedScalar:
        allowed = "'auto' or 'auto_<start above 0>'"
        if isinstance(self.ent_coef, str) and self.ent_coef.startswith("auto"):
            start = self.ent_coef.removeprefix("auto").removeprefix("_") or "1"
            value = _number("ent_coef", start, allowed, shown=self.ent_coef)
            if not 0 < value < math.inf:
                raise ValueError(f"ent_coef must be at least 0 and finite, {allowed}, not {self.ent_coef!r}")
            return LogScalar(value).to(self.device)
        value = _number("ent_coef", self.ent_coef, allowed)
        if not 0 <= value < math.inf:
            raise ValueError(f"ent_coef must be at least 0 and finite, {allowed}, not {self.ent_coef!r}")
        return FixedScalar(value).to(self.device)

    def _make_explorer(self) -> Exploration:
        explorer, kwargs = EXPLORATIONS[self.exploration], self._full_exploration_kwargs()
        allowed = list(inspect.signature(explorer.__init__).parameters)[2:]
        for name in kwargs:
            if name not in allowed:
                raise ValueError(
                    f"exploration_kwargs has {name!r}, but exploration={self.exploration!r} takes {allowed or 'none'}"
                )
        return explorer(self, **kwargs).to(self.device)

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(
                f"policy must be one of {list(self.policy_aliases)} or a policy class, not {policy_name!r}"
            )
        return self.policy_aliases[policy_name]

    @classmethod
    def load(
        cls: type[Self],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: torch.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """
        Load a model, as in Stable-Baselines3.

        :param path: file, or where ``save`` wrote it
        :param env: environment to go on with; none is needed for prediction
        :param device: "auto", "cpu", "cuda", ...
        :param custom_objects: objects that replace what the file holds under their names
        :param print_system_info: whether to print the saved and the present versions
        :param force_reset: whether the environment is reset before training goes on
        :param kwargs: arguments of the constructor that shall differ from the saved ones
        :return: the model
        :raises ValueError: if ``kwargs`` holds something else, or values that are not allowed
        """
        known = {name for c in cls.__mro__ if issubclass(c, SAC) for name in inspect.signature(c.__init__).parameters}
        unknown = sorted(kwargs.keys() - known)
        if unknown:
            raise ValueError(f"{', '.join(unknown)}: not an argument of {cls.__name__}, so load cannot change it")
        if "train_freq" in kwargs or "gradient_steps" in kwargs:
            kwargs.setdefault("replay_ratio", None)
        try:
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except RuntimeError as error:
            if kwargs and "loading state_dict" in str(error):
                raise ValueError(
                    f"{', '.join(sorted(kwargs))}: with these arguments the model has other networks than the file"
                ) from error
            raise

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        space = env.action_space
        if not isinstance(space, spaces.Box):
            raise ValueError(f"env must have a bounded Box action space, not {space}")
        if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            raise ValueError(f"env must have a bounded action space: the bounds of {space} are not finite")
        if not (space.low < space.high).all():
            raise ValueError(f"env must have an action space with low < high in every dimension, not {space}")
        venv = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        FiniteCheck.install(venv)
        return venv

    def make_optimizer(self, parameters: Any) -> torch.optim.Optimizer:
        """
        :param parameters: what to optimise
        :return: an optimizer with the settings of actor and critics
        """
        return self.policy.make_optimizer(parameters, self.lr_schedule)

    def _parts(self) -> dict[str, Part]:
        return {"explorer": self.explorer, "pessimism_rule": self.pessimism_rule, "plasticity": self.plasticity}

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Every optimizer by its path from the algorithm."""
        optimizers: dict[str, torch.optim.Optimizer] = {
            "actor.optimizer": self.actor.optimizer,
            "critic.optimizer": self.critic.optimizer,
        }
        if self.temperature_optimizer is not None:
            optimizers["temperature_optimizer"] = self.temperature_optimizer
        for name, part in self._parts().items():
            optimizers.update({f"{name}.{key}": optimizer for key, optimizer in part.optimizers().items()})
        return optimizers

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "temperature", *self._parts(), *self._optimizers()], []

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor", "critic", "critic_target", "_metrics", "_critic_loss"]

    def reinitialize(self) -> None:
        """
        Start every network, optimizer and learned number anew, in place; the replay buffer stays.
        """
        fresh = self.policy_class(
            self.observation_space, self.action_space, self.lr_schedule, **self._full_policy_kwargs()
        )
        self.policy.load_state_dict(fresh.state_dict())
        self.temperature.load_state_dict(self._make_temperature().state_dict())
        self.explorer.load_state_dict(self._make_explorer().state_dict())
        for optimizer in self._optimizers().values():
            optimizer.state.clear()

    # ---------------------------------------------------------------- acting

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        assert isinstance(self.action_space, spaces.Box)
        if self.num_transitions < learning_starts:
            unscaled = np.array([self.action_space.sample() for _ in range(n_envs)])
            scaled = self.policy.scale_action(unscaled)
        else:
            assert self._last_obs is not None
            with torch.inference_mode():
                observations, _ = self.policy.obs_to_tensor(self._last_obs)
                actions = self.explorer.act(self, observations)
            scaled = actions.cpu().numpy().reshape((n_envs, *self.action_space.shape))
        if action_noise is not None:
            scaled = np.clip(scaled + action_noise(), -1, 1)
        return self.policy.unscale_action(scaled), scaled

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self.num_transitions += len(dones)
        rewards = reward if self._vec_normalize_env is None else self._vec_normalize_env.get_original_reward()
        for part in self._parts().values():
            part.on_step(self, rewards, dones, infos)
            for index in np.flatnonzero(dones):
                if "episode" in infos[index]:  # Monitor's entry; absent if the environment is not monitored
                    part.on_episode_end(self, int(index), infos[index]["episode"]["r"])

    # ---------------------------------------------------------------- learning

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """
        Train, as in Stable-Baselines3.

        :param total_timesteps: environment steps to take
        :param callback: called at every step
        :param log_interval: episodes between two lines of the log
        :param tb_log_name: name of the run in the TensorBoard log; the class's name if None
        :param reset_num_timesteps: whether ``num_timesteps`` starts at zero again
        :param progress_bar: whether to show a progress bar (needs tqdm and rich)
        :return: the trained model
        """
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar
        )
        callback.on_training_start(locals(), globals())
        assert self.env is not None and self.replay_buffer is not None
        while self.num_timesteps < total_timesteps:
            rollout = self.collect_rollouts(
                self.env,
                train_freq=self.train_freq,  # type: ignore[arg-type]  # converted in _setup_model
                action_noise=self.action_noise,
                callback=callback,
                learning_starts=self.learning_starts,
                replay_buffer=self.replay_buffer,
                log_interval=log_interval,
            )
            if not rollout.continue_training:
                break
            n_updates = self._updates_due(rollout.episode_timesteps)
            if n_updates > 0:
                self.train(n_updates, self.batch_size)
        callback.on_training_end()
        return self

    def _updates_due(self, n_collected: int) -> int:
        """
        :param n_collected: transitions just collected
        :return: gradient steps to take now
        """
        assert self.replay_buffer is not None
        if self.num_transitions <= self.learning_starts:
            return 0
        # A model that was loaded without its buffer fills it first, acting with what it has learned.
        capacity = self.replay_buffer.buffer_size * self.n_envs
        if self.replay_buffer.size() * self.n_envs < min(self.learning_starts, capacity):
            return 0
        if self.replay_ratio is None:
            return self.gradient_steps if self.gradient_steps >= 0 else n_collected
        self._updates_owed += self.replay_ratio * n_collected
        # The tolerance keeps 10 times 0.1 from falling short of 1 by rounding.
        n_updates = int(self._updates_owed + 1e-6)
        self._updates_owed -= n_updates
        return n_updates

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        Take gradient steps on batches from the replay buffer.

        :param gradient_steps: how many
        :param batch_size: transitions a step
        """
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        rate = self.lr_schedule(self._current_progress_remaining)
        for optimizer in self._optimizers().values():
            for group in optimizer.param_groups:
                if group.get("scheduled", True):
                    group["lr"] = rate
        self.plasticity.before_updates(self)
        for first in range(0, gradient_steps, MAX_BATCHES_AT_ONCE):
            n_batches = min(MAX_BATCHES_AT_ONCE, gradient_steps - first)
            for batch in draw_batches(self.replay_buffer, n_batches, batch_size, self.gamma, self._vec_normalize_env):
                self._metrics = self._update(batch)

    def _update(self, batch: Batch, noise: Noise | None = None) -> dict[str, torch.Tensor]:
        """
        One gradient step (P5, algorithm 2).

        :param batch: transitions
        :param noise: noise of the sampled actions; drawn if None. A given noise reproduces a step exactly.
        :return: what to log, by name, scalars on the model's device, computed with the parameters from before
            the update of the module in question
        """
        noise = noise or Noise()
        alpha = self.temperature()
        fixed_alpha = alpha.detach()

        # Critics, towards the targets' value of the actor's next action.
        with torch.no_grad():
            next_actions, next_log_prob = self.actor.sample(batch.next_observations, noise.critic)
            next_values = self.pessimism_rule.value(self.critic_target(batch.next_observations, next_actions))
            target = losses.td_target(
                batch.rewards, batch.dones, batch.discounts, next_values, -fixed_alpha * next_log_prob
            )
        q = self.critic(batch.observations, batch.actions)
        critic_loss = self._critic_loss(q, target)
        self.minimize(self.critic.optimizer, critic_loss)

        # Targets, by Polyak averaging.
        self._n_updates += 1
        if self._n_updates % self.target_update_interval == 0:
            with torch.no_grad():
                torch._foreach_lerp_(
                    list(self.critic_target.parameters()), list(self.critic.parameters()), weight=self.tau
                )

        # Actor, on the new critics.
        actions, log_prob = self.actor.sample(batch.observations, noise.actor)
        value = self.pessimism_rule.value(self.critic(batch.observations, actions))
        actor_loss = losses.actor_loss(log_prob, value, fixed_alpha)
        self.minimize(self.actor.optimizer, actor_loss)

        # Whoever explores, on the new critics and the new actor.
        exploration_metrics = self.explorer.update(self, batch, noise.exploration)

        # Temperature.
        entropy = -log_prob.detach().mean()
        metrics = {
            "train/critic_loss": critic_loss,
            "train/q_mean": q.mean(),
            "train/actor_loss": actor_loss,
            "train/entropy": entropy,
            "train/ent_coef": alpha,
            **exploration_metrics,
        }
        if self.temperature_optimizer is not None:
            temperature_loss = losses.temperature_loss(alpha, entropy, self._target_entropy)
            self.minimize(self.temperature_optimizer, temperature_loss)
            metrics["train/ent_coef_loss"] = temperature_loss

        # Pessimism.
        metrics.update(self.pessimism_rule.update(self, batch))
        return {name: value.detach() for name, value in metrics.items()}

    @staticmethod
    def minimize(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
        """
        One step of an optimizer. Only its own parameters get a gradient, whatever else the loss passed through.

        :param optimizer: the optimizer
        :param loss: scalar
        """
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        optimizer.step()

    def dump_logs(self) -> None:
        """
        Write the log. Only here are the metrics fetched from the device.
        """
        for name, value in self._metrics.items():
            self.logger.record(name, value.item())
        self.logger.record("train/learning_rate", self.lr_schedule(self._current_progress_remaining))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("plasticity/n_resets", self.plasticity.n_done)
        super().dump_logs()


def _number(name: str, value: Any, otherwise: str, shown: Any = None) -> float:
    """An argument as a number, or an error that names it, its value and what else is allowed."""
    try:
        return float(value)
    except (TypeError, ValueError):
        shown = value if shown is None else shown
        raise ValueError(f"{name} must be a number, or {otherwise}, not {shown!r}") from None
