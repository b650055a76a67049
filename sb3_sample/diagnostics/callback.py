"""
Callback that measures overestimation, overfitting and plasticity in a run of the off-policy family without changing the
training.
"""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import GymEnv, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_sample.diagnostics.measures import (
    Rollout,
    average_value,
    discounted_return,
    dormant_shares,
    effective_rank,
    global_norm,
)
from sb3_sample.diagnostics.periodic import PeriodicMeasurement
from sb3_sample.diagnostics.reading import batch_at, newest_overfitting, noise, targets, training_places, untouched
from sb3_sample.envs.identities import identities
from sb3_sample.learner.batch import Batch
from sb3_sample.learner.pessimism import epistemic_std
from sb3_sample.learner.target import values
from sb3_sample.networks import neuron_scores
from sb3_sample.replay.buffers import store_float_actions
from sb3_sample.sac import SAC
from sb3_sample.saving.rings import Ring


class DiagnosticsCallback(PeriodicMeasurement):
    """
    Measures, every ``every`` environment steps, how wrong the critics are, how much they overfit and how much
    plasticity the networks have left, and writes it to the logger under ``diagnostics/``.

    Each measurement takes ``n_start_states`` rollouts of at most ``rollout_length`` steps in ``eval_env``, each from a
    reset, with samples of the actor, whose value the critics estimate (not with its mean action, and not with an
    optimistic actor). The networks are evaluated in evaluation mode throughout.

    *Overestimation* is the critics' value minus a Monte-Carlo reference, averaged over the start pairs; the critics'
    value is the mean over ensemble and quantiles. An arbitrary environment cannot be put into a state of the replay
    buffer. Hence the start pair is a visited state and action of the rollout itself. Its step is drawn before the
    rollout begins, uniformly from the first half of ``rollout_length`` (of the time limit, if episodes were seen to be
    cut earlier), and counted across the ends of episodes, so that the choice of the state does not depend on the length
    of its episode. The rest of the episode is the reference, which is unbiased even where episodes end at random.
    ``overestimation`` compares with the discounted return (Overestimation, Overfitting and Plasticity);
    ``overestimation_soft`` with VPL's equation 22, which also counts the entropy that a soft critic contains. The paper
    writes the entropy target for the policy's entropy; here the entropy is measured in the rollout, which is also right
    where the temperature is fixed or the entropy has not reached its target. As printed in the paper, the first
    action's own log-probability counts too. Without entropy (temperature 0, deterministic actor) that part vanishes.

    *Overfitting* is VPL's equation 23: the mean squared TD error, of the critics' mean to the target under the current
    pessimism, on transitions of the rollouts, which are never trained on, divided by the error on transitions of the
    replay buffer. Both are single steps as they were experienced, even if the algorithm learns from n-step returns or
    relabelled goals; transitions that the buffer holds out for validation are left out.

    All quantities are in the units in which the critics learn: with ``VecNormalize`` around the training environment,
    observations and rewards of ``eval_env`` are normalised by the training environment's current statistics; the
    statistics of a ``VecNormalize`` around ``eval_env`` are neither used nor changed.

    Training is bit for bit the same with the callback and without where gradient steps are eager (see ``compile``): it
    has its own random numbers, and restores the modules' modes and the global generators, which an environment may use.
    Steps that are compiled, captured on a GPU or taken for several seeds together leave no gradients, so the last one
    before a measurement (before every end of an episode if ``train_freq`` counts episodes) is run eagerly. Its numbers
    differ by rounding; with ``sampling="device"``, batches and noise are drawn by another generator until then.

    Nothing is measured while the algorithm still acts at random (``learning_starts``). In ``learn_offline`` a model
    that has not acted for so long is not measured, with a warning: the replay buffer is read, not the data set.

    :param eval_env: environment for the rollouts, a single one, not the training environment; its normalisation, if
        any, has to be the same as the training environment's. None, the default, is for ``sb3-sample train`` and plans
        of studies, which make one in the same way as for their evaluations
    :param every: environment steps between two measurements, taken at the first step at or after each multiple
    :param n_start_states: rollouts a measurement, each with one start pair (5 in VPL's paper)
    :param rollout_length: maximum number of steps in a rollout, over several episodes if they are short. Choose it well
        above the length of episodes that terminate, since a rollout that is cut counts as one that never ends. With the
        default a measurement adds up to 5,000 validation transitions, as in VPL's paper
    :param soft: whether to log ``overestimation_soft``
    :param batch_size: transitions from each side, training and validation; fewer if fewer are stored
    :param dormant_threshold: score up to which a neuron counts as dormant
    :param validation_size: validation transitions kept; the oldest are dropped first
    :param seed: of the rollouts' noise and of ``eval_env``; the model's if None
    :param verbose: 0 nothing, 1 a line for each measurement
    :raises TypeError: if ``eval_env`` is not an environment, or, when training starts, the model is not a ``SAC`` of
        this package
    :raises ValueError: if an argument is out of range, or, when training starts, ``eval_env`` is missing or does not
        fit the model
    """

    TITLE = "Diagnostics"
    SHOWN = ("overestimation", "overfitting")

    def __init__(
        self,
        eval_env: GymEnv | None = None,
        every: int = 10_000,
        n_start_states: int = 5,
        rollout_length: int = 1_000,
        soft: bool = True,
        batch_size: int = 256,
        dormant_threshold: float = 0.025,
        validation_size: int = 100_000,
        seed: int | None = None,
        verbose: int = 0,
    ):
        super().__init__(every, verbose)
        if not isinstance(eval_env, (gym.Env, VecEnv, type(None))):
            raise TypeError(f"eval_env must be a gymnasium.Env or a VecEnv, not {eval_env!r}")
        if isinstance(eval_env, VecEnv) and eval_env.num_envs != 1:
            raise ValueError(f"eval_env must hold one environment, not {eval_env.num_envs}")
        for name, value in (
            ("every", every),
            ("n_start_states", n_start_states),
            ("rollout_length", rollout_length),
            ("batch_size", batch_size),
            ("validation_size", validation_size),
        ):
            if not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, not {value!r}")
        if not 0 <= dormant_threshold < math.inf:
            raise ValueError(f"dormant_threshold must be at least 0 and finite, not {dormant_threshold}")
        self.eval_env = eval_env
        self.n_start_states = n_start_states
        self.rollout_length = rollout_length
        self.soft = soft
        self.batch_size = batch_size
        self.dormant_threshold = dormant_threshold
        self.validation_size = validation_size
        self.seed = seed
        # The fewest steps after which an episode was cut by a time limit.
        self._time_limit: int | None = None
        # Transitions ever added to the store.
        self._n_stored = 0
        self._store: ReplayBuffer | None = None
        self._measured_model: SAC | None = None

    # ---------------------------------------------------------------- construction

    def _init_callback(self) -> None:
        super()._init_callback()
        model = self.model
        if not model.gamma < 1:
            raise ValueError(f"gamma must be below 1 for the Monte-Carlo reference, not {model.gamma}")
        env = self._checked_env()
        if model is self._measured_model:  # a second call of learn
            return
        self._env, self._measured_model = env, model
        seed = model.seed if self.seed is None else self.seed
        self._rng = np.random.default_rng(seed)
        if seed is not None:
            # Not the model's own seed, with which the episodes would start like those of the training.
            self._env.seed(int(self._rng.integers(2**31)))
        store: Any = DictReplayBuffer if isinstance(model.observation_space, spaces.Dict) else ReplayBuffer
        self._store = store(self.validation_size, model.observation_space, model.action_space, device=model.device)
        store_float_actions(self._store)

    def _checked_env(self) -> VecEnv:
        """The environment of the rollouts, vectorised and below its normalisation."""
        if self.eval_env is None:
            raise ValueError("eval_env must be an environment, not None: only sb3-sample train and studies make one")
        if identities(self.eval_env) & identities(self.training_env):
            raise ValueError("eval_env is the training environment: its rollouts need an environment of their own")
        env = self.model._wrap_env(self.eval_env, monitor_wrapper=False)
        normalize = unwrap_vec_normalize(env)
        if normalize is not None:
            if self.model.get_vec_normalize_env() is None:
                raise ValueError("eval_env is wrapped in VecNormalize, but the training environment is not")
            env = normalize.venv
        for name in ("observation_space", "action_space"):
            ours, theirs = getattr(self.model, name), getattr(env, name)
            if ours != theirs:
                raise ValueError(f"eval_env has the {name} {theirs}, but the model has {ours}")
        return env

    # ---------------------------------------------------------------- schedule

    def _on_step(self) -> bool:
        # The gradient step after this call may be the last before a measurement, which then finds its gradients.
        if self._next <= self.num_timesteps + self.model.n_envs * self._steps_between_updates():
            self.model.keep_next_gradients = True
        return super()._on_step()

    def _steps_between_updates(self) -> float:
        """Upper bound on steps (of all environments) between two gradient steps; none if episodes set the schedule."""
        model = self.model
        if model.replay_ratio is None:
            assert isinstance(model.train_freq, TrainFreq)
            return model.train_freq.frequency if model.train_freq.unit is TrainFrequencyUnit.STEP else math.inf
        return math.ceil(1 / max(min(model.replay_ratio * model.n_envs, 1), 1e-3))

    # ---------------------------------------------------------------- checkpoints

    def state_dict(self) -> dict[str, Any]:
        """
        :return: state that the coming measurements depend on, besides ``eval_env`` and the validation transitions,
            which a checkpoint also holds
        """
        return {
            "next": self._next,
            "time_limit": self._time_limit,
            "n_stored": self._n_stored,
            "rng": self._rng,
            "last_results": self.last_results,
            "gradients": self._gradients(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: from :meth:`state_dict`
        """
        self._next, self._n_stored, self._rng = state["next"], state["n_stored"], state["rng"]
        self._time_limit = state["time_limit"]
        self.last_results = state["last_results"]
        for parameter, gradient in zip(self._measured_parameters(), state["gradients"] or (), strict=False):
            parameter.grad = None if gradient is None else gradient.to(parameter.device)

    def _measured_parameters(self) -> list[torch.nn.Parameter]:
        return [*self.model.critic.parameters(), *self.model.actor.parameters()]

    def _gradients(self) -> list[torch.Tensor | None] | None:
        """Gradients of the last gradient step, if the next environment step measures their norms before new ones."""
        if self.model.gradients_are_stale or self.model.num_timesteps + self.model.n_envs < self._next:
            return None
        return [parameter.grad for parameter in self._measured_parameters()]

    def checkpoint_rings(self) -> dict[str, Ring]:
        """
        :return: the validation transitions, for checkpoints, which write only the new ones
        """
        return {} if self._store is None else {"store": Ring(self._store, lambda: self._n_stored)}

    # ---------------------------------------------------------------- measurements

    def measure(self) -> dict[str, float]:
        """
        Measure now. Outside of ``learn`` call ``init_callback(model)`` first.

        :return: the quantities by name, without those that cannot be measured (an empty replay buffer, no gradient step
            yet, a single critic)
        """
        if self._store is None:
            raise ValueError("the callback knows no model yet: call init_callback(model) first")
        with untouched(self.model), torch.no_grad():
            results = self._overestimation()
            training = self._training_batch()
            if training is not None:
                results |= self._overfitting(training) | self._networks(training)
                results |= newest_overfitting(self.model, self.batch_size, self._rng)
            results |= self._norms()
        self.last_results = results
        return results

    def _overestimation(self) -> dict[str, float]:
        rollouts = [self._rollout() for _ in range(self.n_start_states)]
        alpha, gamma = self.model.temperature().item(), self.model.gamma
        results = {
            "critic_value": np.mean([r.value for r in rollouts]),
            "overestimation": np.mean([r.value - discounted_return(r.rewards, gamma, r.terminated) for r in rollouts]),
        }
        if self.soft:
            results["overestimation_soft"] = np.mean(
                [r.value - average_value(r.rewards, r.log_probs, alpha, gamma, r.terminated) for r in rollouts]
            )
        return {name: float(value) for name, value in results.items()}

    def _rollout(self) -> Rollout:
        """
        Follow the actor from a reset, over as many episodes as it takes to reach the step of the start pair, and from
        there to the end of the episode; keep the transitions.
        """
        assert self._store is not None and isinstance(self.model.action_space, spaces.Box)
        # Drawn before anything is known of the episodes: a state drawn from an episode of known length has fewer, or
        # more, steps ahead of it than a state that the policy happens to visit.
        longest = min(self.rollout_length, self._time_limit or self.rollout_length)
        start = int(self._rng.integers((longest + 1) // 2))
        value, terminated = math.nan, False
        rewards, log_probs = [], []
        n_steps = 0
        observation: Any = self._env.reset()
        for step in range(self.rollout_length):
            tensors = self._to_tensors(observation)
            action, log_prob = self.model.actor.sample(tensors, noise(self.model, self._rng, 1))
            scaled = action.cpu().numpy().reshape(1, *self.model.action_space.shape)
            next_observation, reward, done, infos = self._env.step(self.model.policy.unscale_action(scaled))
            last: Any = next_observation
            if done[0]:
                last = infos[0]["terminal_observation"]
                last = {k: np.asarray(v)[None] for k, v in last.items()} if isinstance(last, dict) else np.array([last])
            self._store.add(observation, last, scaled, reward, done, infos)
            self._n_stored += 1
            if step == start:
                value = values(self.model.learner, self.model.critic, tensors, action).mean().item()
            if step >= start:
                rewards.append(reward[0])
                log_probs.append(log_prob.item())
            observation = next_observation
            n_steps += 1
            if done[0]:
                terminated = not infos[0].get("TimeLimit.truncated", False)
                if not terminated:
                    self._time_limit = min(n_steps, self._time_limit or n_steps)
                if step >= start:
                    break
                n_steps, terminated = 0, False
        following = np.array(rewards)
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None:
            following = normalize.normalize_reward(following)
        scaler = self.model.reward_scaler
        if scaler is not None:
            unscaled = torch.as_tensor(following, dtype=torch.float64, device=self.model.device)
            following = scaler.scaled(unscaled, None).cpu().numpy()
        return Rollout(value, following.astype(np.float64), np.array(log_probs), terminated)

    def _overfitting(self, training: Batch) -> dict[str, float]:
        assert self._store is not None
        n = self._store.size()
        positions = self._rng.choice(n, min(self.batch_size, n), replace=False)
        on_validation = self._td_error(batch_at(self.model, self._store, positions))
        on_training = self._td_error(training)
        results = {"td_error_validation": on_validation, "td_error_training": on_training}
        if on_training != 0:
            results["overfitting"] = on_validation / on_training
        return results

    def _td_error(self, batch: Batch) -> float:
        """Mean squared TD error of the critics' mean."""
        model = self.model
        batch, target = targets(model, batch, self._rng)
        q = values(model.learner, model.critic, batch.observations, batch.actions)
        return (q.mean(dim=(0, 2)) - model.learner.head.mean_target(target).squeeze(1)).square().mean().item()

    def _networks(self, batch: Batch) -> dict[str, float]:
        """Disagreement, dormant neurons and rank, on a batch of the replay buffer."""
        actor, critic = self.model.actor, self.model.critic
        results: dict[str, float] = {}
        q = values(self.model.learner, critic, batch.observations, batch.actions)
        if len(q) > 1:
            results["critic_disagreement"] = epistemic_std(q).mean().item()
        x = critic.inputs(batch.observations, batch.actions)
        for who, scores in (
            ("critic", neuron_scores(critic.trunk, critic.head, x)),
            ("actor", neuron_scores(actor.trunk, None, actor.features(batch.observations))),
        ):
            for layer, share in dormant_shares(scores, self.dormant_threshold).items():
                results[f"dormant_{who}/{layer}".rstrip("/")] = share
        features = critic.trunk(x)
        ranks = effective_rank(features.expand(len(q), *features.shape[-2:]))
        results["effective_rank"] = ranks.mean().item()
        results.update({f"effective_rank/critic_{i}": rank.item() for i, rank in enumerate(ranks)})
        return results

    def _norms(self) -> dict[str, float]:
        """Norms of the parameters, and of the gradients that the last gradient step left."""
        results: dict[str, float] = {}
        for who, module in (("critic", self.model.critic), ("actor", self.model.actor)):
            parameters = list(module.parameters())
            gradients = [p.grad for p in parameters if p.grad is not None and not self.model.gradients_are_stale]
            if gradients:
                results[f"gradient_norm_{who}"] = global_norm(gradients)
            results[f"parameter_norm_{who}"] = global_norm(list(parameters))
        return results

    # ---------------------------------------------------------------- data

    def _to_tensors(self, observation: Any) -> Any:
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None:
            observation = normalize.normalize_obs(observation)
        return self.model.policy.obs_to_tensor(observation)[0]

    def _training_batch(self) -> Batch | None:
        """Transitions that the algorithm trains on, without repeats; None if there are none yet."""
        buffer = self.model.replay_buffer
        assert buffer is not None
        places = training_places(buffer)
        if len(places) == 0:
            return None
        return batch_at(self.model, buffer, self._rng.choice(places, min(self.batch_size, len(places)), replace=False))
