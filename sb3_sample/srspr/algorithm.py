"""SR-SPR with the interface of Stable-Baselines3's ``DQN``: acting, storing, update schedule, logging, files."""

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
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.arguments import NotAllowed, check_every, check_program
from sb3_sample.console import say
from sb3_sample.constructor import Given
from sb3_sample.envs.atari import make_atari_env
from sb3_sample.envs.registration import is_atari_id
from sb3_sample.faults import MetricWatch
from sb3_sample.saving.checkpoint import CHECKPOINT_FREQ
from sb3_sample.saving.encoding import Lenient
from sb3_sample.saving.kept import Kept
from sb3_sample.saving.model import SafeFiles
from sb3_sample.saving.replay import SafeReplayBuffers, encode_buffer
from sb3_sample.saving.unsaved import plain_attributes
from sb3_sample.srspr.arguments import SRSPRArguments
from sb3_sample.srspr.learner import SPRLearner
from sb3_sample.srspr.policies import SPRPolicy
from sb3_sample.srspr.replay import SETTINGS, SPRReplayBuffer
from sb3_sample.training.compiling import DecidesCompiling
from sb3_sample.training.metrics_log import MetricsLog
from sb3_sample.training.resumable import Resumable
from sb3_sample.training.updates_owed import UpdatesOwed
from sb3_sample.warn import warn

Self = TypeVar("Self", bound="SRSPR")

#: Added to a loss before its square root becomes a priority.
_SMALL = 1e-10


class SRSPR(  # type: ignore[misc]
    MetricsLog, DecidesCompiling, UpdatesOwed, SRSPRArguments, SafeReplayBuffers, SafeFiles, OffPolicyAlgorithm
):
    """
    SR-SPR, the scaled-by-resetting agent for Atari with 100,000 decisions (D'Oro et al. 2023, on SPR, Schwarzer et al.
    2021), with the regular Q-network or BroNet (BRO, appendix E): Rainbow's value learning (C51, dueling, double,
    n-step returns, prioritised replay), the prediction of future latent states, and shrink and perturb. docs/srspr.md.

    :raises ValueError: if an argument is out of range or contradicts another, or the environment's observations are not
        stacks of uint8 frames
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": SPRPolicy}
    policy_base: ClassVar[type[BasePolicy]] = SPRPolicy
    _kept: ClassVar[dict[str, Kept]] = {
        # Saved as the policy.
        "learner": Kept.NOWHERE,
        "_watch": Kept.NOWHERE,
        "_plain_attributes": Kept.NOWHERE,
        # For the log of a resumed run.
        "_metrics": Kept.IN_CHECKPOINTS,
    }

    def _construct(self, given: Given) -> None:
        check_program(type(self), given)
        given["env"] = _made(given["env"])
        self._settle_replay_ratio(given)
        is_set_up = given.pop("_init_setup_model")
        theirs = self._store(given, OffPolicyAlgorithm)
        OffPolicyAlgorithm.__init__(self, **theirs, sde_support=False, support_multi_env=True)
        #: Whether the gradient step is compiled; None while undecided. Saved: a loaded model keeps it.
        self.compiled: bool | None = None
        #: Transitions stored over the model's life; unlike ``num_timesteps`` never reset by ``learn``.
        self.num_transitions = 0
        #: Resets over the model's life.
        self.n_resets = 0
        # Fraction of a gradient step that the replay ratio has left over so far.
        self._updates_owed = 0.0
        self._metrics: dict[str, torch.Tensor] = {}
        if is_set_up:
            self._setup_model()

    # ---------------------------------------------------------------- construction

    def _setup_model(self) -> None:
        n_steps = self.n_steps
        try:
            super()._setup_model()
        finally:
            self.n_steps = n_steps
        if self.compile != "auto":
            self.compiled = bool(self.compile)
        self.learner = SPRLearner(
            self.policy,
            self,
            gamma=self.gamma,
            tau=self.tau,
            n_steps=n_steps,
            n_predictions=self.n_predictions,
            spr_weight=self.spr_weight,
            compile=self.compile,
            device=self.device,
            verbose=self.verbose,
        )
        self._plain_attributes = plain_attributes(self)
        self._watch = MetricWatch(self.device)

    def _check_arguments(self) -> None:
        check_every(self)
        shape = self.observation_space.shape
        assert shape is not None
        if min(shape[1:]) < 8 or shape[0] % self.frame_stack:
            raise NotAllowed(
                f"env has observations of shape {shape}: their first axis must be frame_stack={self.frame_stack} "
                "frames, and their sides at least 8 pixels. Stable-Baselines3's VecFrameStack stacks single pictures"
            )
        if not self.v_min < self.v_max:
            raise ValueError(f"v_min must be below v_max, not v_min={self.v_min} and v_max={self.v_max}")

    def _complete_arguments(self) -> None:
        super()._complete_arguments()
        if self.replay_buffer_class is None:
            self.replay_buffer_class = SPRReplayBuffer
        own = {"frame_stack": self.frame_stack, "horizon": max(self.n_steps, self.n_predictions)}
        if taken := (own.keys() | set(SETTINGS)) & self.replay_buffer_kwargs.keys():
            raise ValueError(
                f"replay_buffer_kwargs has {sorted(taken)}, which are the algorithm's, or follow from its arguments: "
                "leave them out"
            )
        self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, **own}
        self.optimize_memory_usage = False
        # Stable-Baselines3 would read it as an argument for its n-step buffer.
        self.n_steps = 1

    def _full_policy_kwargs(self) -> dict[str, Any]:
        return {
            **self.policy_kwargs,
            "network": self.network,
            "noisy": self.noisy,
            "n_atoms": self.n_atoms,
            "v_min": self.v_min,
            "v_max": self.v_max,
        }

    @classmethod
    def _implied(cls, kwargs: dict[str, Any]) -> dict[str, Any]:
        implied = super()._implied(kwargs)
        return {**implied, "compiled": None} if "compile" in kwargs else implied

    @classmethod
    def _made(  # type: ignore[override]
        cls, content: Any, attributes: dict[str, Any], kwargs: dict[str, Any], custom: Any, env: Any, *args: Any
    ) -> Any:
        return super()._made(content, attributes, kwargs, custom, _made(env), *args)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        space = env.action_space
        if not isinstance(space, spaces.Discrete) or space.start != 0:
            raise NotAllowed(f"env must have Discrete actions that count from 0, not {space}: BRO is for Box actions")
        seen = env.observation_space
        if not isinstance(seen, spaces.Box) or not is_image_space(seen, check_channels=False):
            raise NotAllowed(
                "env must have observations that are stacks of frames, uint8 in [0, 255], (frame_stack * C, height, "
                f"width), not {seen}: make_atari_env gives them, and Stable-Baselines3's VecFrameStack makes them of "
                "single pictures"
            )
        return Resumable._wrap_env(env, verbose, monitor_wrapper)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "learner"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []

    def _described(self) -> Lenient:
        encoder = super()._described()
        if self.replay_buffer is not None:
            encode_buffer(self.replay_buffer, encoder, only_small=True)
        return encoder

    def _check_replay_buffer(self, buffer: ReplayBuffer, path: Any) -> None:
        super()._check_replay_buffer(buffer, path)
        needed = max(self.n_steps, self.n_predictions)
        horizon = getattr(buffer, "horizon", None)
        if not isinstance(buffer, SPRReplayBuffer) or horizon != needed:
            raise ValueError(
                f"the replay buffer of {path} is a {type(buffer).__name__} of windows of {horizon} steps, but this "
                f"model needs an SPRReplayBuffer of {needed}, the larger of n_steps and n_predictions"
            )

    # ---------------------------------------------------------------- acting

    @property
    def exploration_rate(self) -> float:
        """Rate of random decisions in training, given the decisions so far."""
        past = self.num_transitions - self.learning_starts
        left = 1.0 if past < 0 else max(0.0, 1 - past / self.exploration_steps) if self.exploration_steps else 0.0
        return self.exploration_final_eps + left * (self.exploration_initial_eps - self.exploration_final_eps)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Choose actions with the target network, as in evaluation.

        :param observation: as the environment gives it, one or a batch
        :param state: as in Stable-Baselines3, ignored here
        :param episode_start: likewise
        :param deterministic: whether to always take the best action, without random ones at the rate ``evaluation_eps``
        :return: actions, and ``state``
        :raises ValueError: if the observation is not one of the observation space
        """
        actions, state = self.policy.predict(observation, state, episode_start, deterministic=True)
        return (actions if deterministic else self._with_random(actions, self.evaluation_eps)), state

    def _with_random(self, actions: np.ndarray, rate: float) -> np.ndarray:
        """Replace actions by random ones at a rate."""
        chosen = np.random.random(actions.shape) < rate  # noqa: NPY002  # the generator that Stable-Baselines3 seeds
        if not chosen.any():
            return actions
        drawn = np.array([self.action_space.sample() for _ in range(actions.size)]).reshape(actions.shape)
        return np.where(chosen, drawn, actions)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        rate = self.exploration_rate
        if rate < 1:
            policy: Any = self.policy
            for layer in policy.q_net_target.noisy_layers():
                layer.draw()
            # Not with the policy's predict, which computes without noise.
            with torch.no_grad():
                actions = policy(policy.obs_to_tensor(self._last_obs)[0]).cpu().numpy()
        else:
            actions = np.zeros(n_envs, np.int64)
        actions = self._with_random(actions, rate)
        return actions, actions

    def _store_transition(self, replay_buffer: ReplayBuffer, *args: Any, **kwargs: Any) -> None:
        super()._store_transition(replay_buffer, *args, **kwargs)
        if self._vec_normalize_env is None:
            # The base class sets it anyway; in a file it would mean that there was a VecNormalize.
            self._last_original_obs = None
        self.num_transitions += self.n_envs

    def _on_step(self) -> None:
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    def _on_environment_reset(self) -> None:
        assert isinstance(self.replay_buffer, SPRReplayBuffer)
        self.replay_buffer.cut_episodes()

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
        Train, as in Stable-Baselines3; with ``checkpoint``, so that nothing is lost if the program ends early: started
        again, the same program resumes from the folder's last checkpoint, and the result is the same bit by bit
        (docs/saving.md).

        :param total_timesteps: decisions to take
        :param callback: called at every step
        :param log_interval: episodes between two lines of the log
        :param tb_log_name: name of the run in the TensorBoard log; the class's name if None
        :param reset_num_timesteps: whether ``num_timesteps`` starts at zero again
        :param progress_bar: whether to show a progress bar (needs tqdm and rich)
        :param checkpoint: folder of the run; None for no checkpoints. Each call of ``learn`` needs its own folder
        :param checkpoint_freq: decisions between two checkpoints
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

    def _before_turns(self) -> None:
        n_of_warm_up = max(self.learning_starts - self.num_transitions, 0)
        self._decide_compiling(self._updates_in(self._total_timesteps - self.num_timesteps - n_of_warm_up))

    def _turn(self, callback: BaseCallback, log_interval: int) -> bool:
        assert self.env is not None and self.replay_buffer is not None
        before = self.num_transitions
        rollout = self.collect_rollouts(
            self.env,
            train_freq=self.train_freq,  # type: ignore[arg-type]  # converted in _setup_model
            action_noise=None,
            callback=callback,
            learning_starts=self.learning_starts,
            replay_buffer=self.replay_buffer,
            log_interval=log_interval,
        )
        if rollout.continue_training:
            n_updates = self._updates_due(rollout.episode_timesteps)
            if n_updates > 0:
                self.train(n_updates, self.batch_size)
            self._reset_if_due(before)
        return rollout.continue_training

    def _updates_due(self, n_collected: int) -> int:
        """Number of gradient steps to take now."""
        buffer = self.replay_buffer
        assert isinstance(buffer, SPRReplayBuffer)
        # A model that was loaded without its buffer fills it first, acting with the learned policy.
        n_needed = min(self.learning_starts, buffer.buffer_size * buffer.n_envs)
        if self.num_transitions <= self.learning_starts or buffer.size() * buffer.n_envs < n_needed:
            return 0
        if buffer.n_drawable == 0:
            return 0
        return self._updates_for(n_collected)

    def _reset_if_due(self, before: int) -> None:
        """Reset if the last decisions have reached a multiple of the interval, and a whole interval is left."""
        every, now = self.reset_interval, self.num_transitions
        left = self._total_timesteps - self.num_timesteps
        if every is None or before // every == now // every or left < every:
            return
        self.learner.reset(self.shrink)
        self.n_resets += 1
        if self.verbose >= 1:
            say(f"Reset at {now} decisions")

    def _after_turns(self) -> None:
        """Warn if no gradient step was taken because there were too few decisions, or none in a row."""
        wanted = self.gradient_steps if self.replay_ratio is None else self.replay_ratio
        if self._n_updates > 0 or wanted == 0 or self.num_transitions == 0:
            return
        assert isinstance(self.replay_buffer, SPRReplayBuffer)
        if self.num_transitions > self.learning_starts and self.replay_buffer.n_drawable == 0:
            warn(
                "learn ended without a single gradient step: a window of n_steps and n_predictions needs "
                f"{max(self.n_steps, self.n_predictions)} decisions of an episode, and one more, or a termination: no "
                "episode has had them. Train for more, or pass smaller ones"
            )
        if self.num_transitions <= self.learning_starts:
            warn(
                f"learn ended without a single gradient step: learning_starts={self.learning_starts} decisions come "
                f"before the first, and this model has taken {self.num_transitions}. Train for more, or pass a smaller "
                "learning_starts="
            )

    def train(self, gradient_steps: int, batch_size: int | None = None) -> None:
        """
        Take gradient steps on windows from the replay buffer, and record the metrics of the last one.

        :param gradient_steps: how many
        :param batch_size: windows per step; None: the model's ``batch_size``
        :raises TrainingDiverged: if a metric is NaN or infinite; on a GPU this may be detected later, at the latest
            when the log is written
        """
        buffer = self.replay_buffer
        assert isinstance(buffer, SPRReplayBuffer)
        for name in SPRLearner.SETTINGS:
            setattr(self.learner, name, getattr(self, name))
        for group in self.policy.optimizer.param_groups:
            group["lr"] = self._rate_in_force()
        self.learner.prepared_execution()
        for _ in range(gradient_steps):
            slots = buffer.draw(self.batch_size if batch_size is None else batch_size)
            windows = buffer.states_of(slots, self.n_steps, self.n_predictions, self._vec_normalize_env)
            metrics, td_losses = self.learner.step(windows)
            # Each step updates the priorities with which the next batch is drawn.
            buffer.weights.renew(slots, td_losses.cpu().numpy() + _SMALL)
            self._watch.note(metrics, self._n_updates, self.num_timesteps)
            self._metrics.update(metrics)
        if not self._metrics_wait:
            self._watch.check()
        self._record_metrics()

    def _record_counts(self) -> None:
        super()._record_counts()
        self.logger.record("plasticity/reset", self.n_resets)


def _made(env: Any) -> Any:
    """The environment for the id of an Atari game, with its wrappers; anything else unchanged."""
    return make_atari_env(env) if is_atari_id(env) else env
