"""Acting apart from learning: ``learn(asynchronous=True)``."""

import collections
import contextlib
import math
import threading
from collections.abc import Iterator
from typing import Any

import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.her import HerReplayBuffer

from sb3_sample.kinds import ABOVE_0, TRUE_OR_FALSE, check_value
from sb3_sample.learner.execution import CAPTURING
from sb3_sample.learner.exploration import Exploration, HeldNoise, OptimisticActor, OptimisticShift
from sb3_sample.training.acting import ActingThread, Chosen, Step
from sb3_sample.warn import warn

#: Gradient steps after which parameters are handed over to the acting thread.
MAX_AGE = 4
#: Seconds after which gradient steps that could not be taken in time lapse.
LAPSE = 1.0
#: Share of missed periods above which a warning is given, once there are enough periods.
MISSED, ENOUGH = 0.01, 100
#: Share of lapsed gradient steps above which a warning is given, after the same number of periods.
LAPSED = 0.1
#: Explorations that act without the critics; with them, the critics are not handed over.
_WITHOUT_CRITICS = (Exploration, HeldNoise, OptimisticActor, OptimisticShift)


class Apart:
    """
    An acting thread with its own networks, and its counts.

    :param model: the algorithm
    :param frequency: steps a second; None: at the environment's pace
    """

    def __init__(self, model: Any, frequency: float | None):
        self._model, self._frequency = model, frequency
        self._learner = model._make_learner(counts=model)
        self._learner.set_training_mode(False)
        # Not captured: during the capture the learner could not draw from the GPU's generator.
        self._learner.make_acting = lambda learner: None
        # Held while actions are chosen, and while parameters are handed over.
        self._lock = threading.Lock()
        self._handed_over_at = -1
        self._pairs = self._all_pairs()
        norms = [each.networks.observation_norm for each in (self._learner, model.learner)]
        # Running statistics of the observations: the acting networks', and the learner's.
        self._statistics = [list(norm.buffers()) for norm in norms if norm is not None]
        self.hand_over()
        #: Gradient steps that are due.
        self.n_due = 0
        self._n_lapsed = self._n_taken = self._n_stored = 0
        self._n_periods = self._n_missed = 0
        self._has_warned = self._has_warned_of_lapsed = False
        self._ages: list[int] = []
        self._latest = 0.0
        self._n_before = model._n_of_warm_up
        n_left = model._total_timesteps - model.num_timesteps
        self.thread = ActingThread(
            model.env,
            self._choose,
            model._last_obs,
            math.ceil(n_left / model.n_envs),
            None if frequency is None else 1 / frequency,
        )
        #: When the latest steps began, and the gradient steps that are due for each.
        self._recent: collections.deque[tuple[float, int]] = collections.deque()

    # ---------------------------------------------------------------- parameters

    def _all_pairs(self) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """Tensors of the acting networks, and the learner's tensors that they are copied from."""
        learner = self._model.learner
        needs_critics = type(learner.explorer) not in _WITHOUT_CRITICS
        theirs, ours = _tensors(learner), _tensors(self._learner)
        # If the encoder is shared, the actor reads the critics'.
        shared = "networks.critic.features_extractor." if learner.networks.share_features_extractor else None
        names = [
            name
            for name in ours
            if needs_critics or not name.startswith("networks.critic") or (shared and name.startswith(shared))
        ]
        return [ours[name].data for name in names], [theirs[name].data for name in names]

    def hand_over(self) -> None:
        """Copy the learned parameters to the acting networks."""
        with self._lock, torch.no_grad():
            torch._foreach_copy_(*self._pairs)
            self._handed_over_at = self._model._n_updates

    @property
    def age(self) -> int:
        """Gradient steps by which the acting parameters lag behind the learner's."""
        return self._model._n_updates - self._handed_over_at  # type: ignore[no-any-return]

    def after_gradient_steps(self, n: int) -> None:
        """
        Hand over the learned parameters before those that act become too old.

        :param n: gradient steps just taken
        """
        self._n_taken += n
        if self.age >= MAX_AGE:
            self.hand_over()

    # ---------------------------------------------------------------- acting, in the thread

    def _choose(self, observations: Any, n_before: int) -> Chosen:
        model = self._model
        counted = self._n_before + n_before * model.n_envs
        at_random = counted < model.learning_starts and model._n_offline_updates == 0
        with CAPTURING, self._lock:
            age = None if at_random else self.age
            actions, scaled = model._choose(self._learner, observations, at_random, model.n_envs)
        return Chosen(actions, scaled, age)

    # ---------------------------------------------------------------- counting

    def note(self, step: Step, n_due: int) -> None:
        """
        Count a step that was stored.

        :param step: the step
        :param n_due: gradient steps that are due for it
        """
        self._n_stored += len(step.dones)
        self.n_due += n_due
        if self._statistics:
            # They follow the observations, not the gradient steps, of which there are none in the warm-up.
            ours, theirs = self._statistics
            with self._lock, torch.no_grad():
                torch._foreach_copy_(ours, theirs)
        self._recent.append((step.begun, n_due))
        while self._recent[0][0] <= step.begun - LAPSE:
            self._recent.popleft()
        # Gradient steps beyond this number are due for earlier steps.
        most_due = max(sum(n for _, n in self._recent), 1)
        if self.n_due > most_due:
            self._n_lapsed += self.n_due - most_due
            self.n_due = most_due
        self._n_periods += 1 + step.missed
        self._n_missed += step.missed
        self._latest = max(self._latest, step.late)
        if step.age is not None:
            self._ages.append(step.age)
        if not self._has_warned and self._n_periods >= ENOUGH and self._n_missed > MISSED * self._n_periods:
            self._has_warned = True
            warn(
                f"{self._n_missed} of {self._n_periods} periods of 1 / {self._frequency} s were missed: the "
                "environment's step and the choice of an action take longer than a period, or checkpoints and other "
                "programs keep them waiting. Pass a smaller control_frequency"
            )

        self._warn_of_lapsed()

    def _warn_of_lapsed(self) -> None:
        n_due = self._n_taken + self.n_due + self._n_lapsed
        if self._has_warned_of_lapsed or self._n_periods < ENOUGH or self._n_lapsed <= LAPSED * n_due:
            return
        self._has_warned_of_lapsed = True
        warn(
            f"{self._n_lapsed} of {n_due} gradient steps have lapsed: they, or evaluations and other callbacks, take "
            "longer than the environment's steps, so that fewer are taken than "
            f"replay_ratio={self._model.replay_ratio} a transition. Pass a smaller replay_ratio or control_frequency, "
            "or choose smaller networks"
        )

    def record(self) -> None:
        """Log the counts."""
        logger = self._model.logger
        logger.record("asynchronous/replay_ratio", self._n_taken / max(self._n_stored, 1))
        logger.record("asynchronous/lapsed_updates", self._n_lapsed)
        if self._ages:
            logger.record("asynchronous/parameter_age", sum(self._ages) / len(self._ages))
            logger.record("asynchronous/largest_parameter_age", max(self._ages))
            self._ages.clear()
        if self._frequency is not None:
            logger.record("asynchronous/missed_periods", self._n_missed)
            logger.record("asynchronous/largest_lateness_ms", 1_000 * self._latest)
            self._latest = 0.0


def _tensors(learner: Any) -> dict[str, torch.Tensor]:
    """Tensors that acting depends on, by name; a shared tensor has several names."""
    networks = learner.networks
    found = dict(networks.named_parameters("networks", remove_duplicate=False))
    found |= dict(networks.named_buffers("networks", remove_duplicate=False))
    found |= dict(learner.explorer.named_parameters("explorer"))
    # Running statistics of the explorer's networks, but not its own buffers, which may hold the progress of the acting
    # explorer itself.
    for name, network in learner.explorer.named_children():
        found |= dict(network.named_buffers(f"explorer.{name}"))
    return found | dict(learner.pessimism_rule.named_parameters("pessimism"))


class ActsApart:
    """Part of an off-policy algorithm, before Stable-Baselines3's class: acting in a thread while it learns."""

    _apart: Apart | None
    _acts_at: tuple[bool, float | None]
    _last_obs: Any

    @contextlib.contextmanager
    def _acting(self: Any, asynchronous: bool, control_frequency: float | None) -> Iterator[None]:
        """
        Act in the given way during a ``learn``.

        :param asynchronous: its argument
        :param control_frequency: its argument
        :raises ValueError: if they do not go together, or with the model
        """
        self._check_acting(asynchronous, control_frequency)
        self._acts_at = (asynchronous, control_frequency)
        try:
            yield
        finally:
            self._acts_at = (False, None)
            apart, self._apart = self._apart, None
            if apart is not None:
                apart.thread.stop()
                if self.num_timesteps < self._total_timesteps:
                    # The environment may be ahead of the stored transitions, so its episode cannot be continued.
                    self._last_obs = None

    def _check_acting(self: Any, asynchronous: bool, control_frequency: float | None) -> None:
        check_value("asynchronous", asynchronous, TRUE_OR_FALSE)
        check_value("control_frequency", control_frequency, ABOVE_0.or_none())
        if not asynchronous:
            if control_frequency is not None:
                raise ValueError(
                    f"control_frequency={control_frequency} means nothing without asynchronous=True: pass it too"
                )
            return
        if self.replay_ratio is None:
            raise ValueError(
                "asynchronous=True takes gradient steps by replay_ratio, which train_freq and gradient_steps replace: "
                "pass replay_ratio in their place"
            )
        if self.get_vec_normalize_env() is not None:
            raise ValueError(
                "asynchronous=True does not go with VecNormalize, whose statistics the acting thread would change "
                "while batches are drawn: pass normalize_observations=True, or reward_scale, in its place"
            )
        if isinstance(self.replay_buffer, HerReplayBuffer):
            raise ValueError(
                "asynchronous=True does not go with HerReplayBuffer, which calls the environment while the acting "
                "thread is in its step"
            )
        if self.action_noise is not None:
            raise ValueError(
                f"asynchronous=True does not go with action_noise={self.action_noise!r}: choose an exploration"
            )

    def _turn_apart(self: Any, callback: BaseCallback, log_interval: int) -> bool:
        """Take over the acting thread's steps, then take gradient steps that are due."""
        if self._apart is None:
            self._apart = Apart(self, self._acts_at[1])
            self._apart.thread.start()
        apart = self._apart
        apart.thread.go_on()
        if not self._take_over_all(apart.thread.taken(wait=apart.n_due == 0), callback, log_interval):
            return False
        if apart.age >= MAX_AGE:
            # A callback has taken gradient steps.
            apart.hand_over()
        n_updates = min(apart.n_due, MAX_AGE - apart.age)
        if n_updates > 0:
            apart.n_due -= n_updates
            self.train(n_updates, self.batch_size)
            apart.after_gradient_steps(n_updates)
        return True

    def _rest(self: Any, callback: BaseCallback, log_interval: int) -> bool:
        if self._apart is None:
            return True
        self._apart.thread.rest()
        return self._take_over_all(self._apart.thread.taken(wait=False), callback, log_interval)

    def _take_over_all(self: Any, steps: list[Step], callback: BaseCallback, log_interval: int) -> bool:
        """Treat steps in their order. Where a callback ends the training, acting ends too, before anything else."""
        if all(self._take_over(step, callback, log_interval) for step in steps):
            return True
        self._apart.thread.stop()
        return False

    def _take_over(self: Any, step: Step, callback: BaseCallback, log_interval: int) -> bool:
        """Treat a step as Stable-Baselines3 treats its own; callbacks read these names among the local variables."""
        env, replay_buffer = self.env, self.replay_buffer
        actions, buffer_actions, new_obs = step.actions, step.scaled, step.new_obs
        rewards, dones, infos = step.rewards, step.dones, step.infos
        callback.on_rollout_start()
        self.learner.on_observations(self._last_obs)
        self.num_timesteps += env.num_envs
        callback.update_locals(locals())
        if not callback.on_step():
            return False
        self._update_info_buffer(infos, dones)
        self._store_transition(replay_buffer, buffer_actions, new_obs, rewards, dones, infos)
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        self._on_step()
        self._apart.note(step, self._updates_due(env.num_envs))
        for _ in range(int(dones.sum())):
            self._episode_num += 1
            if log_interval is not None and self._episode_num % log_interval == 0:
                self._apart.record()
                self.dump_logs()
        callback.on_rollout_end()
        del actions
        return True
