"""
The off-policy family as Stable-Baselines3's: acting, storing, when and how often to learn, logging, files.

The update is the learner's (``sb3_sample/learner/learner.py``).
"""

import pathlib
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.arguments import check_program, default_of
from sb3_sample.constructor import Given
from sb3_sample.faults import MetricWatch, check_finite_parameters, diverged, not_finite
from sb3_sample.learner.batch import SLOTS, Batch, Noise
from sb3_sample.replay.buffers import (
    ValidationDictReplayBuffer,
    ValidationReplayBuffer,
    ValidationSplit,
    store_float_actions,
)
from sb3_sample.replay.columns import has_own_columns
from sb3_sample.replay.compact import CompactDictReplayBuffer, CompactReplay, CompactReplayBuffer
from sb3_sample.replay.sources import ReplaySource
from sb3_sample.replay.weighted import PrioritizedReplay
from sb3_sample.sac import checks
from sb3_sample.sac.arguments import SACArguments
from sb3_sample.sac.metrics_log import MetricsLog
from sb3_sample.sac.model_learner import check_action_space
from sb3_sample.sac.multi_task import is_multi_task, told_task
from sb3_sample.sac.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, SACPolicy
from sb3_sample.sac.sb3_names import SB3Names
from sb3_sample.sac.update_schedule import UpdateSchedule
from sb3_sample.saving.checkpoint import CHECKPOINT_FREQ
from sb3_sample.saving.encoding import Lenient
from sb3_sample.saving.kept import Kept
from sb3_sample.saving.model import SafeFiles
from sb3_sample.saving.replay import SafeReplayBuffers, encode_buffer
from sb3_sample.saving.unsaved import plain_attributes
from sb3_sample.training.resumable import Resumable

Self = TypeVar("Self", bound="SAC")

# Batches of at most this many gradient steps are drawn at once, to bound the memory they take.
MAX_BATCHES_AT_ONCE = 64


class SAC(UpdateSchedule, SB3Names, MetricsLog, SACArguments, SafeReplayBuffers, SafeFiles, OffPolicyAlgorithm):  # type: ignore[misc]  # actor
    """
    Soft actor-critic with exchangeable parts, the base of every off-policy algorithm here. On its own it is the
    SAC that the DAC, VPL and BRO papers and the regularization study (https://arxiv.org/abs/2403.00514) compare with:
    tanh-Gaussian actor, two critics, clipped double Q-learning.

    It differs from ``stable_baselines3.SAC`` by design: the order of the update (critics, targets, actor,
    temperature), the squared error without the factor 1/2, the temperature's gradient through the temperature
    instead of its logarithm, a target entropy of -|A|/2, orthogonal initialisation, and a log standard
    deviation squashed into [-10, 2] instead of clipped.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy_base: ClassVar[type[SACPolicy]] = SACPolicy
    _kept: ClassVar[dict[str, Kept]] = {
        # Saved by its parts.
        "_learner": Kept.NOWHERE,
        "_source": Kept.NOWHERE,
        "_watch": Kept.NOWHERE,
        "_plain_attributes": Kept.NOWHERE,
        # For the log of a run that goes on.
        "_metrics": Kept.IN_CHECKPOINTS,
        # An argument that changes with every step.
        "action_noise": Kept.EVERYWHERE,
    }

    def _construct(self, given: Given) -> None:
        check_program(type(self), given)
        checks.check_use_sde(given["use_sde"])
        if given["policy"] == "MlpPolicy" and is_multi_task(getattr(given["env"], "observation_space", None)):
            # A vector and the number of a task are no more than that policy is for.
            given["policy"] = "MultiInputPolicy"
        if given["train_freq"] is not None or given["gradient_steps"] is not None:
            # Stable-Baselines3's two arguments are in force.
            given["replay_ratio"] = None
        if given["reset_gradient_steps"] is not None and given["resets"] is default_of(type(self), "resets"):
            # Those that a class has of its own give way. By identity: equal ones that are passed are another object.
            given["resets"] = ()
        for name in "train_freq", "gradient_steps":
            given[name] = 1 if given[name] is None else given[name]
        is_set_up = given.pop("_init_setup_model")
        theirs = self._store(given, OffPolicyAlgorithm)
        OffPolicyAlgorithm.__init__(self, **theirs, sde_support=False, support_multi_env=True)
        #: Whether the gradient step is compiled; None while that is not decided. Saved: a loaded model goes on with it.
        self.compiled: bool | None = None
        #: A callback that wants gradients in ``.grad`` sets this: the last of the next gradient steps is run eagerly.
        self.keep_next_gradients = False
        self._keeps_gradients = False
        #: Transitions stored over the model's life; unlike ``num_timesteps`` never zeroed by ``learn``.
        self.num_transitions = 0
        #: Gradient steps planned, for ``learning_rate_schedule``; None while they are not known.
        self.planned_updates: int | None = self.schedule_steps
        # Gradient steps owed but not yet taken, the fraction that a replay ratio leaves over.
        self._updates_owed = 0.0
        self._metrics: dict[str, torch.Tensor] = {}
        if is_set_up:
            self._setup_model()

    # ---------------------------------------------------------------- construction

    def _setup_model(self) -> None:
        super()._setup_model()
        assert self.replay_buffer is not None
        store_float_actions(self.replay_buffer)
        if self.compile != "auto":
            self.compiled = bool(self.compile)
        self._source = ReplaySource(self)
        self.learner = self._make_learner(networks=self.policy, counts=self)
        checks.check_rule(self)
        self._plain_attributes = plain_attributes(self)
        self._watch = MetricWatch(self.device)

    def _check_arguments(self) -> None:
        checks.check(self)

    def _complete_arguments(self) -> None:
        super()._complete_arguments()
        is_dict = isinstance(self.observation_space, spaces.Dict)
        if self.validation_proportion > 0:
            if not has_own_columns(self.replay_buffer_class):
                self.replay_buffer_class = ValidationDictReplayBuffer if is_dict else ValidationReplayBuffer
            self.replay_buffer_kwargs = {
                **self.replay_buffer_kwargs,
                "validation_proportion": self.validation_proportion,
            }
        elif self.replay_buffer_class is not None and issubclass(self.replay_buffer_class, ValidationSplit):
            # Loaded, with validation_proportion=0 instead of the saved one.
            self.replay_buffer_class = None
        if self.replay_buffer_class is None and self.n_steps == 1:
            self.replay_buffer_class = CompactDictReplayBuffer if is_dict else CompactReplayBuffer
        if self.replay_buffer_class is not None and issubclass(self.replay_buffer_class, CompactReplay):
            # It saves the memory in any case. Where Stable-Baselines3 reads the argument, it would end an episode that
            # only its own variant needs to have ended.
            self.optimize_memory_usage = False

    def _n_critics(self) -> int:
        """Number of critics that the arguments ask for."""
        return self.policy_kwargs.get("n_critics", 2)  # type: ignore[no-any-return]

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs = {**self.policy_kwargs, "n_outputs": self._make_head().n_outputs, "backbone": self.backbone}
        if self._width_factor > 1:
            kwargs["width_factor"] = self._width_factor
        return {**kwargs, "normalize_observations": True} if self.normalize_observations else kwargs

    @classmethod
    def _implied(cls, kwargs: dict[str, Any]) -> dict[str, Any]:
        implied: dict[str, Any] = {}
        if "compile" in kwargs:
            implied["compiled"] = None
        if "schedule_steps" in kwargs:
            implied["planned_updates"] = kwargs["schedule_steps"]
        if "train_freq" in kwargs or "gradient_steps" in kwargs:
            implied["replay_ratio"] = None
        # One way to count resets replaces the file's other one.
        if kwargs.get("reset_gradient_steps") is not None:
            implied["resets"] = ()
        elif "resets" in kwargs:
            implied["reset_gradient_steps"] = None
        return implied

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_action_space(env.action_space)
        return Resumable._wrap_env(env, verbose, monitor_wrapper)

    # ---------------------------------------------------------------- acting

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Choose actions, as in Stable-Baselines3.

        :param observation: as the environment gives it, one or a batch. Of several tasks ``{"observation": ...,
            "task": k}``, k being the number of the task, also for a batch
        :param state: as in Stable-Baselines3, without meaning here
        :param episode_start: likewise
        :param deterministic: the mean action instead of a sample
        :return: actions, and ``state``
        :raises ValueError: if the observation is not one of the observation space, or there is no such task
        """
        if is_multi_task(self.observation_space) and isinstance(observation, dict):
            observation = told_task(self.observation_space, observation)  # type: ignore[arg-type]
        return super().predict(observation, state, episode_start, deterministic)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        assert isinstance(self.action_space, spaces.Box)
        self.learner.on_observations(self._last_obs)
        if self._n_of_warm_up < learning_starts:
            unscaled = np.array([self.action_space.sample() for _ in range(n_envs)])
            scaled = self.policy.scale_action(unscaled)
        else:
            assert self._last_obs is not None
            with torch.inference_mode():
                observations, _ = self.policy.obs_to_tensor(self._last_obs)
                actions = self.learner.explore(observations)
            scaled = actions.cpu().numpy().reshape((n_envs, *self.action_space.shape))
            if not np.isfinite(scaled).all():
                check_finite_parameters(self)
                raise diverged(self, not_finite({"the policy's action": scaled.sum()}))
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
        if self._vec_normalize_env is None:
            # Set by it all the same; saved, it says that there was a VecNormalize.
            self._last_original_obs = None
        self.learner.learning_starts = self.learning_starts
        rewards = reward if self._vec_normalize_env is None else self._vec_normalize_env.get_original_reward()
        self.learner.on_step(rewards, dones, infos)

    def _check_replay_buffer(self, buffer: ReplayBuffer, path: Any) -> None:
        share = buffer.validation_proportion if isinstance(buffer, ValidationSplit) else 0.0
        if share != self.validation_proportion:
            raise ValueError(
                f"the replay buffer of {path} holds out {share} of its transitions, but this model has "
                f"validation_proportion={self.validation_proportion}"
            )

    # ---------------------------------------------------------------- learning

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        checkpoint: str | pathlib.Path | None = None,
        checkpoint_freq: int = CHECKPOINT_FREQ,
    ) -> Self:
        """
        Train, as in Stable-Baselines3; with ``checkpoint``, so that nothing is lost when the program ends before it is
        done: the same program, started again, goes on where the folder's last checkpoint is, and the result is the same
        bit by bit (docs/saving.md).

        :param total_timesteps: environment steps to take
        :param callback: called at every step
        :param log_interval: episodes between two lines of the log
        :param tb_log_name: name of the run in the TensorBoard log; the class's name if None
        :param reset_num_timesteps: whether ``num_timesteps`` starts at zero again
        :param progress_bar: whether to show a progress bar (needs tqdm and rich)
        :param checkpoint: folder of the run; None for no checkpoints. Each call of ``learn`` needs a folder of its own
        :param checkpoint_freq: environment steps between two checkpoints
        :return: the trained model
        :raises ValueError: if an argument is out of range, or the folder is of another run (the message names what
            differs) or of an earlier call of ``learn``, cannot be used, or has checkpoints that are all damaged
        :raises TrainingDiverged: if a loss, another metric or a parameter is NaN or infinite
        """
        return self._learn(
            total_timesteps,
            callback,
            log_interval,
            tb_log_name,
            reset_num_timesteps,
            progress_bar,
            checkpoint,
            checkpoint_freq,
        )

    def _described(self) -> Lenient:
        encoder = super()._described()
        if self.replay_buffer is not None:
            encode_buffer(self.replay_buffer, encoder, only_small=True)
        return encoder

    def _turn(self, callback: BaseCallback, log_interval: int) -> bool:
        assert self.env is not None and self.replay_buffer is not None
        rollout = self.collect_rollouts(
            self.env,
            train_freq=self.train_freq,  # type: ignore[arg-type]  # converted in _setup_model
            action_noise=self.action_noise,
            callback=callback,
            learning_starts=self.learning_starts,
            replay_buffer=self.replay_buffer,
            log_interval=log_interval,
        )
        if rollout.continue_training:
            n_updates = self._updates_due(rollout.episode_timesteps)
            if n_updates > 0:
                self.train(n_updates, self.batch_size)
        return rollout.continue_training

    def _on_environment_reset(self) -> None:
        self.learner.on_environment_reset()

    def train(self, gradient_steps: int, batch_size: int | None = None) -> None:
        """
        Take gradient steps on batches from the replay buffer, and record the metrics of the last one.

        :param gradient_steps: how many
        :param batch_size: transitions a step; None: the model's own ``batch_size``
        :raises TrainingDiverged: if a metric is NaN or infinite; on a GPU that may be noticed later, at the latest when
            the log is written
        """
        assert self.replay_buffer is not None
        batch_size = self.batch_size if batch_size is None else batch_size
        self._take_settings()
        self._set_training_mode(True)
        if self.learner.schedule is None:
            self.learner.set_learning_rate(self.lr_schedule(self._current_progress_remaining))
        self.learner.before_updates()
        taken = 0
        # Each step renews the priorities of which the next one's batch is drawn.
        at_once = 1 if isinstance(self.replay_buffer, PrioritizedReplay) else MAX_BATCHES_AT_ONCE
        while taken < gradient_steps:
            n_batches = self.plasticity.before_gradient_steps(self.learner, min(at_once, gradient_steps - taken))
            self.learner.prepared_execution()
            self._before_batches(batch_size)
            for i, batch in enumerate(self._source.batches(n_batches, batch_size), taken + 1):
                self._keeps_gradients = self.keep_next_gradients and i == gradient_steps
                metrics = self._update(batch)
                self._watch.note(metrics, self._n_updates, self.num_timesteps)
                self._metrics.update(metrics)
            taken += n_batches
        self._set_training_mode(False)
        if not self._metrics_wait:
            self._watch.check()
        self._record_metrics()

    def _before_batches(self, batch_size: int) -> None:
        """
        Called before batches of gradient steps are drawn.

        :param batch_size: transitions a step
        """

    def _set_training_mode(self, mode: bool) -> None:
        """Dropout and power iterations: on during gradient steps, off whoever acts."""
        self.learner.set_training_mode(mode)

    def _update(self, batch: Batch, noise: Noise | None = None) -> dict[str, torch.Tensor]:
        """One gradient step of the learner, with what its rule of pessimism judges besides; see ``Learner.step``."""
        eager, self._keeps_gradients = self._keeps_gradients, False
        if eager:
            self.keep_next_gradients = False
        metrics = self.learner.step(batch, noise, self.pessimism_rule.draw(self._source), eager)
        errors = self.learner.td_errors
        if errors is not None and isinstance(self.replay_buffer, PrioritizedReplay):
            self.replay_buffer.renew(batch.columns[SLOTS], errors)
        return metrics
