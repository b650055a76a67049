"""
The off-policy family as a Stable-Baselines3 algorithm: acting, storing, when and how often to learn, logging, files.

The learner does the update (``sb3_sample/learner/gradient_step.py``).
"""

import collections
import contextlib
import copy
import pathlib
import time
import warnings
from collections.abc import Collection, Iterator
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, ProgressBarCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import configure_logger
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from stable_baselines3.her import HerReplayBuffer

from sb3_sample.arguments import check_every, check_program, default_of, named_policy
from sb3_sample.constructor import Given
from sb3_sample.envs.no_environment import NoEnvironment
from sb3_sample.faults import MetricWatch, check_finite_parameters, diverged, not_finite
from sb3_sample.kinds import ABOVE_0, check_value, choice_of, instance, integer
from sb3_sample.learner.batch import SLOTS, Batch, Noise
from sb3_sample.learner.learner import Learner
from sb3_sample.learner.reward_scale import REWARD_SCALES, LinearScale
from sb3_sample.learner.scalars import FixedScalar
from sb3_sample.replay.buffers import (
    WITH_SPLIT,
    WITHOUT_SPLIT,
    DeviceReplayBuffer,
    DeviceValidationReplayBuffer,
    ValidationDictReplayBuffer,
    ValidationReplayBuffer,
    ValidationSplit,
    store_float_actions,
)
from sb3_sample.replay.compact import (
    CompactDictReplayBuffer,
    CompactNStepReplayBuffer,
    CompactReplay,
    CompactReplayBuffer,
)
from sb3_sample.replay.dataset import Dataset
from sb3_sample.replay.endings import end_episodes
from sb3_sample.replay.sources import DatasetSource, ReplaySource, n_held_out
from sb3_sample.replay.weighted import PrioritizedReplay
from sb3_sample.sac import checks
from sb3_sample.sac.apart import ActsApart, Apart
from sb3_sample.sac.arguments import SACArguments
from sb3_sample.sac.metrics_log import FamilyLog
from sb3_sample.sac.model_learner import check_action_space
from sb3_sample.sac.multi_task import is_multi_task, told_task
from sb3_sample.sac.pixels import stacked_frames
from sb3_sample.sac.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, SACPolicy
from sb3_sample.sac.sb3_names import SB3Names
from sb3_sample.sac.update_schedule import UpdateSchedule
from sb3_sample.saving.checkpoint import CHECKPOINT_FREQ
from sb3_sample.saving.checks import check_environment
from sb3_sample.saving.container import BadFile
from sb3_sample.saving.encoding import Lenient
from sb3_sample.saving.kept import Kept
from sb3_sample.saving.model import SafeFiles
from sb3_sample.saving.replay import SafeReplayBuffers, encode_buffer
from sb3_sample.saving.unsaved import plain_attributes
from sb3_sample.training.resumable import Resumable
from sb3_sample.training.task_evaluation import check_tasks, tasks_of
from sb3_sample.warn import warn

Self = TypeVar("Self", bound="SAC")

# Batches of at most this many gradient steps are drawn at once, to bound the memory they take.
MAX_BATCHES_AT_ONCE = 64
#: Arguments that mean nothing where another one is None or empty.
_ONLY_WITH = {
    "learning_rate_schedule": ("final_learning_rate", "schedule_steps", "warm_up_steps", "warm_up_learning_rate"),
    "redo_period": ("redo_threshold",),
    "resets": ("reset_shrink", "resets_to", "resets_keep"),
}


class GradientStepBar(ProgressBarCallback):
    """Progress bar of gradient steps, whatever the number of environments."""

    def _on_step(self) -> bool:
        self.pbar.update(1)
        return True


class SAC(  # type: ignore[misc]  # actor
    ActsApart, UpdateSchedule, SB3Names, FamilyLog, SACArguments, SafeReplayBuffers, SafeFiles, OffPolicyAlgorithm
):
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
    #: Whether there is ``learn_offline`` only.
    learns_from_data_only: ClassVar[bool] = False
    #: Whether there is ``learn_offline``, and ``prior_data``.
    learns_from_data: ClassVar[bool] = True
    #: Whether batches are windows of several steps of the replay buffer, and single steps otherwise.
    draws_windows: ClassVar[bool] = False
    _kept: ClassVar[dict[str, Kept]] = {
        # Saved by its parts.
        "_learner": Kept.NOWHERE,
        "_source": Kept.NOWHERE,
        # Files refer to it by its fingerprint.
        "prior_data": Kept.NOWHERE,
        "_learns_from": Kept.NOWHERE,
        # Of the ``learn`` under way.
        "_apart": Kept.NOWHERE,
        "_acts_at": Kept.NOWHERE,
        # Attributes of Stable-Baselines3, and arguments only for a model without an environment.
        "observation_space": Kept.EVERYWHERE,
        "action_space": Kept.EVERYWHERE,
        "_watch": Kept.NOWHERE,
        "_plain_attributes": Kept.NOWHERE,
        # For the log of a resumed run.
        "_metrics": Kept.IN_CHECKPOINTS,
        # An argument that changes with every step.
        "action_noise": Kept.EVERYWHERE,
    }

    def _construct(self, given: Given) -> None:
        check_program(type(self), given)
        checks.check_use_sde(given["use_sde"])
        if given["policy"] == "MlpPolicy" and is_multi_task(getattr(given["env"], "observation_space", None)):
            # "MlpPolicy" is accepted, since the observation is only a vector and the number of a task.
            given["policy"] = "MultiInputPolicy"
        if isinstance(kwargs := given["policy_kwargs"], dict) and kwargs.get("use_sde") is False:
            # Stable-Baselines3's SAC writes it into the dict that it is given, which a script may pass to both.
            given["policy_kwargs"] = {name: value for name, value in kwargs.items() if name != "use_sde"}
        self._settle_replay_ratio(given)
        if given["reset_gradient_steps"] is not None and given["resets"] is default_of(type(self), "resets"):
            # A class's default resets give way. Compared by identity: resets that are passed, even equal ones, are
            # another object.
            given["resets"] = ()
        if given["backbone"] == "td3" and "ent_coef" not in given.passed:
            # A class's default weighs an entropy, which this actor has not.
            given["ent_coef"] = "auto"
        is_set_up = given.pop("_init_setup_model")
        spaces_given = {name: given.pop(name) for name in ("observation_space", "action_space")}
        theirs = self._store(given, OffPolicyAlgorithm)
        OffPolicyAlgorithm.__init__(self, **theirs, sde_support=False, support_multi_env=True)
        checks.check_spaces(**spaces_given, env=self.env)
        if self.env is None and spaces_given["action_space"] is not None:
            check_action_space(spaces_given["action_space"], "action_space")
            vars(self).update(spaces_given, n_envs=1)
        #: Whether the gradient step is compiled; None until that is decided. Saved: a loaded model keeps it.
        self.compiled: bool | None = None
        #: A callback that wants gradients in ``.grad`` sets this: the last of the next gradient steps is run eagerly,
        #: on a given batch, unless all steps leave theirs.
        self.keep_next_gradients = False
        self._keeps_gradients = False
        #: Transitions stored over the model's life; unlike ``num_timesteps`` never zeroed by ``learn``.
        self.num_transitions = 0
        #: The same per task, where several tasks take a step together.
        self.num_task_steps = 0
        # Gradient steps taken when everything last started anew.
        self._began_at = 0
        #: Gradient steps of ``learn_offline`` over the model's life.
        self._n_offline_updates = 0
        # The data set of a ``learn_offline`` under way.
        self._learns_from: Dataset | None = None
        # Whether the ``learn`` under way acts in a separate thread, and at how many steps a second; and that thread.
        self._acts_at: tuple[bool, float | None] = (False, None)
        self._apart: Apart | None = None
        #: Ids of the tasks of ``multi_task_env``, in the order of their numbers; None for other environments.
        self.task_ids: list[str] | None = None
        # Record of the prior data for the model's file.
        self._prior_of: dict[str, Any] | None = None
        #: Gradient steps planned, for ``learning_rate_schedule``; None until known.
        self.planned_updates: int | None = self.schedule_steps
        #: Number of frames that the environment stacks in an observation; the replay stores each frame once. None for
        #: none. Saved: a model loaded without an environment needs it.
        self.frame_stack: int | None = None
        # Gradient steps owed but not yet taken, the fraction that a replay ratio leaves over.
        self._updates_owed = 0.0
        self._metrics: dict[str, torch.Tensor] = {}
        if is_set_up and hasattr(self, "observation_space"):
            self._setup_model()
            checks.check_targets(self, self.learner, given.passed)
        elif is_set_up:
            # A model that is to learn from data: its networks are made once the spaces are known.
            check_every(self, needs_spaces=False)

    # ---------------------------------------------------------------- construction

    def _setup_model(self) -> None:
        with warnings.catch_warnings():
            # From Stable-Baselines3, which passes n_steps to its own n-step buffer only if it has chosen that buffer
            # itself. Here every n-step buffer gets it, and other buffers are refused.
            warnings.filterwarnings("ignore", message="`n_steps=")
            super()._setup_model()
        assert self.replay_buffer is not None
        store_float_actions(self.replay_buffer)
        self._take_tasks(self.env)
        if self.compile != "auto":
            self.compiled = bool(self.compile)
        if self.prior_data is not None:
            self._take_prior_data(self.prior_data)
        self._source: ReplaySource | DatasetSource = ReplaySource(self)
        self.learner = self._make_learner(networks=self.policy, counts=self)
        self.learner.check_rows(self.batch_size, "batch_size")
        checks.check_rule(self)
        checks.check_sampling(self, self.replay_buffer)
        self._plain_attributes = plain_attributes(self)
        self._watch = MetricWatch(self.device)

    def _take_tasks(self, env: GymEnv | None) -> None:
        """Record the tasks of an environment of several, and warn if the model has learned others."""
        if not is_multi_task(self.observation_space) or (now := tasks_of(env)) is None:
            return
        if self.task_ids is not None and self.task_ids != now:
            warn(f"env has the tasks {now}, numbered as those that this model has learned so far, {self.task_ids}")
        self.task_ids = now

    def _take_prior_data(self, data: Dataset) -> None:
        """Record which data the prior data are, and warn if a loaded model had others."""
        now = {"fingerprint": data.fingerprint, "size": len(data)}
        if self._prior_of is not None and self._prior_of != now:
            warn(
                f"prior_data are other transitions than this model has learned from so far: {data!r}, not "
                f"{checks.prior_words(self._prior_of)}"
            )
        self._prior_of = now

    def _tell_of(self, data: Dataset) -> None:
        """Pass a data set's return range to the rule that scales rewards, if the rule waits for one."""
        if self.learner.reward_scaler is not None and self.learner.reward_scaler.waits_for_data:
            self.learner.reward_scaler.on_dataset(data.return_range)

    def _check_arguments(self) -> None:
        if named_policy(self) == "MlpPolicy" and is_multi_task(getattr(self, "observation_space", None)):
            # As in ``_construct``, for spaces that were unknown there.
            self.policy_class = self.policy_aliases["MultiInputPolicy"]
        checks.check(self)

    def _complete_arguments(self) -> None:
        super()._complete_arguments()
        is_dict = isinstance(self.observation_space, spaces.Dict)
        if self.validation_proportion > 0:
            if self.replay_buffer_class in (None, *WITHOUT_SPLIT, *WITH_SPLIT):
                ours = ValidationDictReplayBuffer if is_dict else ValidationReplayBuffer
                on_device = self.replay_buffer_class in (DeviceReplayBuffer, DeviceValidationReplayBuffer)
                self.replay_buffer_class = DeviceValidationReplayBuffer if on_device else ours
            self.replay_buffer_kwargs = {
                **self.replay_buffer_kwargs,
                "validation_proportion": self.validation_proportion,
            }
        elif self.replay_buffer_class in WITH_SPLIT:
            # Loaded, with validation_proportion=0 instead of the saved one.
            on_device = self.replay_buffer_class is DeviceValidationReplayBuffer
            self.replay_buffer_class = DeviceReplayBuffer if on_device else None
        can_stack = self.replay_buffer_class is None or issubclass(self.replay_buffer_class, CompactReplay)
        if can_stack and "frame_stack" not in self.replay_buffer_kwargs:
            if self.env is not None:
                self.frame_stack = stacked_frames(self.env, self.observation_space)
            if self.frame_stack is not None:
                self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "frame_stack": self.frame_stack}
        if self.replay_buffer_class is None and self.n_steps > 1:
            stacks = "frame_stack" in self.replay_buffer_kwargs
            self.replay_buffer_class = CompactNStepReplayBuffer if stacks else NStepReplayBuffer
        # With n_steps=1, Stable-Baselines3's NStepReplayBuffer keeps its own settings.
        told = NStepReplayBuffer if self.n_steps > 1 else CompactNStepReplayBuffer
        if self.replay_buffer_class is not None and issubclass(self.replay_buffer_class, told):
            of_steps = {"n_steps": self.n_steps, "gamma": self.gamma}
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, **of_steps}
        if self.replay_buffer_class is None:
            self.replay_buffer_class = CompactDictReplayBuffer if is_dict else CompactReplayBuffer
        if self.replay_buffer_class is not None and issubclass(self.replay_buffer_class, CompactReplay):
            # Compact replay saves the memory in any case. If set, the argument would make Stable-Baselines3 end an
            # episode, which only its own variant needs.
            self.optimize_memory_usage = False

    def _n_critics(self) -> int:
        """Number of critics that the arguments ask for."""
        return self.policy_kwargs.get("n_critics", 2)  # type: ignore[no-any-return]

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs = {**self.policy_kwargs, "n_outputs": self._make_head().n_outputs, "backbone": self.backbone}
        if self.augmentation is not None:
            kwargs.setdefault("share_features_extractor", True)
        if self._width_factor > 1:
            kwargs["width_factor"] = self._width_factor
        return {**kwargs, "normalize_observations": True} if self.normalize_observations else kwargs

    @classmethod
    def _implied(cls, kwargs: dict[str, Any]) -> dict[str, Any]:
        implied = super()._implied(kwargs)
        if "compile" in kwargs:
            implied["compiled"] = None
        if "schedule_steps" in kwargs:
            implied["planned_updates"] = kwargs["schedule_steps"]
        if "prior_data" in kwargs and kwargs["prior_data"] is None:
            implied |= {"_prior_of": None, "prior_share": default_of(cls, "prior_share")}
        if kwargs.get("backbone") == "td3":
            # That a file's networks are others is said of the backbone, not of entropies.
            implied |= {"ent_coef": "auto", "target_entropy": default_of(cls, "target_entropy")}
        without = [name for name in ("learning_rate_schedule", "redo_period") if kwargs.get(name, name) is None]
        # One way to count resets replaces the file's other one.
        if kwargs.get("reset_gradient_steps") is not None:
            implied["resets"] = ()
        elif "resets" in kwargs:
            implied["reset_gradient_steps"] = None
            without += [] if checks.has_resets(kwargs["resets"]) else ["resets"]
        # The file's arguments of what is left out mean nothing.
        return implied | {other: default_of(cls, other) for name in without for other in _ONLY_WITH[name]}

    @classmethod
    def _completed(cls, content: Any, kwargs: dict[str, Any]) -> dict[str, Any]:
        kwargs = super()._completed(content, kwargs)
        if "reward_scale" not in kwargs:
            return kwargs
        try:
            theirs = _in_file(content, "reward_scale")
        except BadFile:
            # A class that is not trusted to be named by the file, and is passed in its place.
            return kwargs
        if choice_of(kwargs["reward_scale"], REWARD_SCALES) is choice_of(theirs, REWARD_SCALES):
            return kwargs
        # Another rule has other statistics.
        content.start_anew("reward_scaler")
        return {"reward_scale_kwargs": default_of(cls, "reward_scale_kwargs"), **kwargs}

    @classmethod
    def _made(cls, content: Any, attributes: dict[str, Any], kwargs: dict[str, Any], *args: Any) -> Any:
        chosen = NStepReplayBuffer, CompactNStepReplayBuffer, CompactReplayBuffer, CompactDictReplayBuffer
        if "n_steps" in kwargs and attributes.get("replay_buffer_class") in chosen:
            # The class was chosen for the file's n_steps, which older files list among the buffer's arguments.
            attributes["replay_buffer_class"] = None
            of_buffer = attributes.get("replay_buffer_kwargs")
            if isinstance(of_buffer, dict):
                others = {name: value for name, value in of_buffer.items() if name not in ("n_steps", "gamma")}
                attributes["replay_buffer_kwargs"] = others
        prior_of, (_, env, *_) = attributes.get("_prior_of"), args
        buffer_class = kwargs.get("replay_buffer_class", attributes.get("replay_buffer_class"))
        if env is None and isinstance(buffer_class, type) and issubclass(buffer_class, HerReplayBuffer):
            raise ValueError(
                f"env must be passed with replay_buffer_class={buffer_class.__name__}, which asks it for rewards; for "
                "prediction alone pass replay_buffer_class=None, replay_buffer_kwargs=None"
            )
        if prior_of is not None and env is not None and "prior_data" not in kwargs:
            checks.check_prior_of(prior_of)
            raise ValueError(
                f"prior_data: the model of {content.name} learned with {checks.prior_words(prior_of)}, which the file "
                "does not hold: pass prior_data=, or prior_data=None to go on without"
            )
        check_tasks(attributes.get("task_ids"), tasks_of(env))
        model = super()._made(content, attributes, kwargs, *args)
        scale = model.learner.reward_scaler
        if "reward_scale_kwargs" in kwargs and isinstance(scale, LinearScale) and scale.return_range is not None:
            scale.take_the_place_of(_return_range_of(content))
        return model

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_action_space(env.action_space)
        return Resumable._wrap_env(env, verbose, monitor_wrapper)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Set another environment, as in Stable-Baselines3; for a model without spaces, its first.

        :param env: the environment, with the spaces and the number of environments that the model was made with
        :param force_reset: whether it is reset before training continues
        :raises ValueError: if its spaces or its number of environments differ, or a task of ``multi_task_env`` has
            another number
        """
        venv, is_first = self._wrap_env(env, self.verbose), self.env is None
        if not hasattr(self, "observation_space"):
            self.observation_space, self.action_space = venv.observation_space, venv.action_space
            self.n_envs, self.env, self._vec_normalize_env = venv.num_envs, venv, unwrap_vec_normalize(venv)
            self._setup_model()
        check_environment(venv, self.observation_space, self.action_space)
        checks.check_device_buffer(self, unwrap_vec_normalize(venv))
        check_tasks(self.task_ids, tasks_of(venv))
        super().set_env(venv, force_reset)
        self._take_tasks(venv)
        if is_first and self.seed is not None:
            # As if the environment had been a constructor argument.
            venv.seed(self.seed)
        if isinstance(self.replay_buffer, HerReplayBuffer):
            # Its own ``set_env`` accepts the first environment only.
            self.replay_buffer.env = venv

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

        :param observation: as the environment gives it, one or a batch. With several tasks ``{"observation": ...,
            "task": k}``, where k is the number of the task, also for a batch
        :param state: as in Stable-Baselines3; ignored here
        :param episode_start: likewise
        :param deterministic: the mean action instead of a sample
        :return: actions, and ``state``
        :raises ValueError: if the observation is not one of the observation space, or there is no such task
        """
        space = self.observation_space
        if isinstance(space, spaces.Dict) and isinstance(observation, (np.ndarray, list, torch.Tensor)):
            keys = sorted(space.spaces)
            raise ValueError(f"observation must be a dict with the keys {keys}, not a {type(observation).__name__}")
        if is_multi_task(space) and isinstance(observation, dict):
            observation = told_task(space, observation)  # type: ignore[arg-type]
        return super().predict(observation, state, episode_start, deterministic)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        self.learner.on_observations(self._last_obs)
        # A model that has learned from data acts by its policy from the beginning.
        at_random = self._n_of_warm_up < learning_starts and self._n_offline_updates == 0
        unscaled, scaled = self._choose(self.learner, self._last_obs, at_random, n_envs)
        if action_noise is None:
            return unscaled, scaled
        scaled = np.clip(scaled + action_noise(), -1, 1)
        return self.policy.unscale_action(scaled), scaled

    def _choose(
        self, learner: Learner, observations: Any, at_random: bool, n_envs: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Choose the actions of a step in training.

        :param learner: learner whose networks act
        :param observations: of all environments
        :param at_random: whether the actions are uniformly random
        :param n_envs: number of environments
        :return: actions in the environment's units and in [-1, 1], (n_envs, A) each
        """
        assert isinstance(self.action_space, spaces.Box)
        if at_random:
            unscaled = np.array([self.action_space.sample() for _ in range(n_envs)])
            scaled = self.policy.scale_action(unscaled)
        else:
            assert observations is not None
            with torch.inference_mode():
                tensors, _ = self.policy.obs_to_tensor(observations)
                actions = learner.explore(tensors)
            scaled = actions.cpu().numpy().reshape((n_envs, *self.action_space.shape))
            if not np.isfinite(scaled).all():
                check_finite_parameters(self)
                raise diverged(self, not_finite({"the policy's action": scaled.sum()}))
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
            # Stable-Baselines3 sets it all the same; in a file it would mean that there was a VecNormalize.
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
        checks.check_sampling(self, buffer)

    def _arguments_in_parameters(self, given: Collection[str] | None) -> list[torch.Tensor]:
        scale, found = self.learner.reward_scaler, []
        if (given is None or "ent_coef" in given) and isinstance(self.learner.temperature, FixedScalar):
            found.append(self.learner.temperature.value)
        of_scale = given is None or "reward_scale_kwargs" in given
        if of_scale and isinstance(scale, LinearScale) and scale.return_range is None:
            found.append(scale.factor)
        return found

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
        asynchronous: bool = False,
        control_frequency: float | None = None,
    ) -> Self:
        """
        Train, as in Stable-Baselines3. With ``checkpoint``, nothing is lost if the program ends before the training is
        done: the same program, started again, resumes from the folder's last checkpoint, and the result is the same bit
        for bit (docs/saving.md).

        :param total_timesteps: environment steps to take
        :param callback: called at every step
        :param log_interval: episodes between two lines of the log
        :param tb_log_name: name of the run in the TensorBoard log; the class's name if None
        :param reset_num_timesteps: whether ``num_timesteps`` starts at zero again
        :param progress_bar: whether to show a progress bar (needs tqdm and rich)
        :param checkpoint: folder of the run; None for no checkpoints. Each call of ``learn`` needs a folder of its own
        :param checkpoint_freq: environment steps between two checkpoints
        :param asynchronous: whether a separate thread acts while gradient steps are taken, up to the replay ratio, for
            robots and other environments whose steps take time (docs/asynchronous.md). The result is then not the same
            bit for bit
        :param control_frequency: steps a second of the acting thread; None: at the environment's own pace
        :return: the trained model
        :raises ValueError: if an argument is out of range, or the folder is of another run (the message names what
            differs) or of an earlier call of ``learn``, cannot be used, or has checkpoints that are all damaged
        :raises TrainingDiverged: if a loss, another metric or a parameter is NaN or infinite
        """
        if self._prior_of is not None and self.prior_data is None:
            raise ValueError(
                f"prior_data: this model learned with {checks.prior_words(self._prior_of)}, which its file does not "
                "hold: pass prior_data= to load, or prior_data=None to go on without"
            )
        with self._acting(asynchronous, control_frequency):
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

    def learn_offline(
        self: Self,
        dataset: Dataset,
        gradient_steps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1_000,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        checkpoint: str | pathlib.Path | None = None,
        checkpoint_freq: int = CHECKPOINT_FREQ,
    ) -> Self:
        """
        Train on a data set. Steps are gradient steps here: ``num_timesteps`` counts them, callbacks are called after
        each (``EvalCallback(eval_freq=1_000)`` evaluates every 1,000), and checkpoints and log count them. The
        environment, if there is one, is left alone. A later ``learn`` acts by the learned policy from its first step
        on.

        :param dataset: the transitions. They are drawn by NumPy's global generator, which the model's seed sets and
            checkpoints hold
        :param gradient_steps: gradient steps to take
        :param callback: called after every gradient step
        :param log_interval: gradient steps between two lines of the log
        :param tb_log_name: name of the run in the TensorBoard log; the class's name if None
        :param reset_num_timesteps: whether ``num_timesteps`` starts at zero again
        :param progress_bar: whether to show a progress bar (needs tqdm and rich)
        :param checkpoint: folder of the run, as in ``learn``; each call needs its own
        :param checkpoint_freq: gradient steps between two checkpoints
        :return: the trained model
        :raises ValueError: if an argument is out of range, or the data set has other observations or actions than the
            model; for ``checkpoint`` as in ``learn``
        :raises TrainingDiverged: if a loss, another metric or a parameter is NaN or infinite
        """
        check_value("dataset", dataset, instance(Dataset))
        check_value("gradient_steps", gradient_steps, integer(0))
        with self._learning_from(dataset):
            return self._learn(
                gradient_steps,
                callback,
                log_interval,
                tb_log_name,
                reset_num_timesteps,
                progress_bar,
                checkpoint,
                checkpoint_freq,
                learns_from=repr(dataset),
            )

    @contextlib.contextmanager
    def _learning_from(self, dataset: Dataset) -> Iterator[None]:
        """Put a data set in the place of the replay buffer, and a placeholder in the place of a missing environment."""
        is_new = not hasattr(self, "observation_space")
        own: Any = dataset if is_new else self
        checks.check_dataset("dataset", dataset, own.observation_space, own.action_space)
        if is_new:
            self.observation_space, self.action_space, self.n_envs = dataset.observation_space, dataset.action_space, 1
            self._setup_model()
        env, source = self.env, self._source
        checks.check_offline(self)
        self._tell_of(dataset)
        data = DatasetSource(self, dataset)
        # Before anything is put in a place: it may take minutes, and be interrupted.
        self._take_statistics(data)
        self._learns_from, self._source = dataset, data
        if env is None:
            self.env = NoEnvironment(self.observation_space, self.action_space)
        try:
            yield
        finally:
            self._learns_from, self._source, self.env = None, source, env

    def _take_statistics(self, data: DatasetSource) -> None:
        """Normalise observations by all of the data; a model that has acted keeps its statistics."""
        norm = self.learner.observation_norm
        if norm is None or norm.count >= 1:
            return
        before = copy.deepcopy(norm.state_dict())
        try:
            for observations in data.observations():
                norm.update(observations)
        except BaseException:
            # Statistics of a part would be taken for those of all.
            norm.load_state_dict(before)
            raise

    def _set_up_training(
        self, total_timesteps: int, callback: MaybeCallback, reset_num_timesteps: bool, name: str, progress_bar: bool
    ) -> tuple[int, BaseCallback]:
        if self._learns_from is None:
            return super()._set_up_training(total_timesteps, callback, reset_num_timesteps, name, progress_bar)
        # As Stable-Baselines3 sets up, without a reset of the environment.
        self.start_time = time.time_ns()
        if reset_num_timesteps:
            self.num_timesteps = self._episode_num = 0
        if self.ep_info_buffer is None or reset_num_timesteps:
            self.ep_info_buffer = collections.deque(maxlen=self._stats_window_size)
            self.ep_success_buffer = collections.deque(maxlen=self._stats_window_size)
        self._total_timesteps = self.num_timesteps + total_timesteps
        self._num_timesteps_at_start = self.num_timesteps
        if not self._custom_logger:
            self._logger = configure_logger(self.verbose, self.tensorboard_log, name, reset_num_timesteps)
        if progress_bar:
            # Beside a single callback, as Stable-Baselines3 adds its own bar: checkpoints know the callback with and
            # without it.
            one = CallbackList(callback) if isinstance(callback, list) else callback
            callback = [one if isinstance(one, BaseCallback) else ConvertCallback(one), GradientStepBar()]
        return self._total_timesteps, self._init_callback(callback)

    def _described(self) -> Lenient:
        encoder = super()._described()
        if self.replay_buffer is not None:
            encode_buffer(self.replay_buffer, encoder, only_small=True)
        return encoder

    def _turn(self, callback: BaseCallback, log_interval: int) -> bool:
        if self._learns_from is not None:
            return self._offline_turn(callback, log_interval)
        if self._acts_at[0]:
            return self._turn_apart(callback, log_interval)
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

    def _offline_turn(self, callback: BaseCallback, log_interval: int) -> bool:
        """One gradient step on the data set, and what follows a step."""
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        self.train(1)
        self.num_timesteps += 1
        self._n_offline_updates += 1
        callback.update_locals(locals())
        if not callback.on_step():
            return False
        if log_interval is not None and self.num_timesteps % log_interval == 0:
            self.dump_logs()
        return True

    def _on_environment_reset(self) -> None:
        self.learner.on_environment_reset()
        if isinstance(self.replay_buffer, (NStepReplayBuffer, HerReplayBuffer)):
            # Otherwise returns would include rewards of the next episode, and goals would be those reached in it.
            end_episodes(self.replay_buffer)

    def train(self, gradient_steps: int, batch_size: int | None = None) -> None:
        """
        Take gradient steps on batches from the replay buffer, and record the metrics of the last one.

        :param gradient_steps: how many
        :param batch_size: transitions a step; None: the model's own ``batch_size``
        :raises ValueError: one transition a step, for networks with batch norm
        :raises TrainingDiverged: if a metric is NaN or infinite; on a GPU that may be noticed later, at the latest when
            the log is written
        """
        assert self.replay_buffer is not None
        batch_size = self.batch_size if batch_size is None else batch_size
        self.learner.check_rows(batch_size, "batch_size")
        self._take_settings()
        self._set_training_mode(True)
        if self.learner.schedule is None:
            self.learner.set_learning_rate(self.lr_schedule(self._current_progress_remaining))
        self.learner.before_updates()
        taken = 0
        # Each step updates the priorities by which the next step's batch is drawn.
        at_once = 1 if isinstance(self.replay_buffer, PrioritizedReplay) else MAX_BATCHES_AT_ONCE
        while taken < gradient_steps:
            n_batches = self.plasticity.before_gradient_steps(self.learner, min(at_once, gradient_steps - taken))
            draws_itself = self._draws_in_steps()
            if draws_itself:
                self.learner.prepared_drawing()
            else:
                self.learner.prepared_execution()
            self._before_batches(batch_size)
            given = None if draws_itself else self._source.batches(n_batches, batch_size)
            for i in range(n_batches):
                self._keeps_gradients = self.keep_next_gradients and taken + i + 1 == gradient_steps
                metrics = self._drawn_update(batch_size) if given is None else self._update(given[i])
                self._watch.note(metrics, self._n_updates, self.num_timesteps)
                self._metrics.update(metrics)
            taken += n_batches
        self._set_training_mode(False)
        if not self._metrics_wait:
            self._watch.check()
        self._record_metrics()

    def _draws_in_steps(self) -> bool:
        """Whether the gradient steps that follow draw their batches themselves, from all that is stored now."""
        buffer = self.replay_buffer
        # Offline training has another source.
        if (
            not (isinstance(buffer, DeviceReplayBuffer) and buffer.sampling == "device")
            or self._learns_from is not None
        ):
            return False
        self.learner.draw_from(buffer)
        # A compiled or captured step that draws its batch leaves no gradients.
        if self.keep_next_gradients and not self.learner.prepared_drawing().leaves_gradients:
            return False
        buffer.prepare_draws()
        return True

    def _drawn_update(self, batch_size: int) -> dict[str, torch.Tensor]:
        """One gradient step for which the learner draws the batch itself, and what its rule of pessimism needs."""
        if self._keeps_gradients:
            self._keeps_gradients = self.keep_next_gradients = False
        buffer = self.replay_buffer
        assert buffer is not None
        held_out = n_held_out(self)
        if not isinstance(buffer, ValidationSplit) or buffer.n_validation < held_out:
            held_out = 0
        return self.learner.take_drawn_step(batch_size, self.pessimism_rule.n_further(held_out, buffer.size()))

    def _before_batches(self, batch_size: int) -> None:
        """
        Called before batches of gradient steps are drawn.

        :param batch_size: transitions a step
        """

    def _set_training_mode(self, mode: bool) -> None:
        """Switch dropout and power iterations: on during gradient steps, off for acting."""
        self.learner.set_training_mode(mode)

    def _update(self, batch: Batch, noise: Noise | None = None) -> dict[str, torch.Tensor]:
        """One gradient step of the learner, with more transitions for its rule of pessimism; see ``Learner.step``."""
        eager, self._keeps_gradients = self._keeps_gradients, False
        if eager:
            self.keep_next_gradients = False
        metrics = self.learner.step(batch, noise, self.pessimism_rule.draw(self._source), eager)
        errors = self.learner.td_errors
        if errors is not None and isinstance(self.replay_buffer, PrioritizedReplay):
            self.replay_buffer.renew(batch.columns[SLOTS], errors)
        return metrics


def _in_file(content: Any, name: str) -> Any:
    """An argument's value in a model's file, None if it has none; raises BadFile if it cannot be read."""
    return content.attributes(content.tree["attributes"].keys() - {name}, {}).get(name)


def _return_range_of(content: Any) -> float | None:
    """The ``return_range`` of a model's file, from which its scale of rewards follows; None if there is none."""
    with contextlib.suppress(BadFile):
        kwargs = _in_file(content, "reward_scale_kwargs")
        found = kwargs.get("return_range") if isinstance(kwargs, dict) else None
        return found if ABOVE_0.fits(found) else None
    return None
