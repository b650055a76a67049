"""
PPO with a learned model of the environment, the base of MBMA and MBPO, which differ only in where the rollouts go.
"""

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import CategoricalDistribution, Distribution
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_sample.constructor import argument
from sb3_sample.kinds import Kind, integer
from sb3_sample.ppo.arguments import check_network_kwargs
from sb3_sample.ppo.dynamics import Dynamics, TransitionBuffer, Transitions
from sb3_sample.ppo.simulated_ppo import SimulatedPPO
from sb3_sample.saving.kept import Kept
from sb3_sample.warn import warn

#: Entries of ``dynamics_kwargs``, with the defaults (MBMA, appendix B.2; ``normalize`` is decided here).
DYNAMICS_DEFAULTS: dict[str, Any] = {
    "width": 1024,
    "depth": 2,
    "learning_rate": 3e-4,
    "epochs": None,
    "normalize": True,
}
#: Numbers in the widest hidden layer of one chunk of a simulation. On a CPU a chunk's layers stay in the cache.
FLOATS_AT_ONCE = {"cpu": 2**22, "cuda": 2**27}
#: Real trajectories on which the error of the simulated return is measured.
N_COMPARED = 256


class Simulation(NamedTuple):
    """
    Rollouts of the model, of H steps from B states, as kept by ``roll_out``.

    :param q_values: TD(lambda) return from each step on, (H, B)
    :param values: the critic's value of the state after each step, (H, B)
    :param continues: probability that the step does not end the episode, (H, B); None if no episode terminates
    :param observations: states after each of the first n steps, (n, B, O)
    :param actions: the policy's actions at those states, (n, B, A) or (n, B)
    :param log_probs: log-probabilities of those actions, (n, B)
    """

    q_values: torch.Tensor
    values: torch.Tensor
    continues: torch.Tensor | None
    observations: torch.Tensor | None
    actions: torch.Tensor | None
    log_probs: torch.Tensor | None


def lambda_returns(
    rewards: torch.Tensor,
    next_values: torch.Tensor,
    continues: torch.Tensor | None,
    gamma: float,
    gae_lambda: float,
) -> torch.Tensor:
    """
    TD(lambda) returns bootstrapped with the critic (MBMA, algorithm 1, line 9):
    ``G_k = r_k + gamma c_k ((1 - lambda) V(s_{k+1}) + lambda G_{k+1})``, ``G_H = V(s_H)``.

    :param rewards: (H, B)
    :param next_values: the critic's values of the states after each step, (H, B)
    :param continues: probabilities c that the episode continues, (H, B), or None for 1
    :param gamma: discount factor
    :param gae_lambda: lambda
    :return: (H, B)
    """
    following = next_values[-1]
    returns = []
    for k in reversed(range(len(rewards))):
        following = torch.lerp(next_values[k], following, gae_lambda)
        following = rewards[k] + gamma * (following if continues is None else continues[k] * following)
        returns.append(following)
    return torch.stack(returns[::-1])


class ModelBasedPPO(SimulatedPPO):
    """
    :class:`SimulatedPPO` with a learned model of the environment (MBMA, appendix E), the base of :class:`MBMAPPO` and
    :class:`MBPOPPO`. In each iteration the model is trained on the most recent transitions, before the policy.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    _kept: ClassVar[dict[str, Kept]] = {"_model_kwargs": Kept.NOWHERE}
    simulation_arguments: ClassVar[tuple[str, ...]] = (
        *SimulatedPPO.simulation_arguments,
        "simulation_horizon",
        "dynamics_buffer_size",
        "dynamics_batch_size",
        "dynamics_kwargs",
        "predict_termination",
    )

    simulation_horizon: int = argument(default=12, kind=integer(1))
    """H, steps of a rollout of the model, which is bootstrapped with the critic's value"""
    dynamics_buffer_size: int = argument(default=25_000, kind=integer(1))
    """number of transitions, of all environments together, that the model learns from"""
    dynamics_batch_size: int = argument(default=128, kind=integer(1))
    """transitions per batch of the model"""
    dynamics_kwargs: dict[str, Any] | None = argument(default=None)
    """the model: ``width`` (1024) and ``depth`` (2) of the hidden layers of each of its two networks, ``learning_rate``
    (3e-4), ``epochs`` (None: ``n_epochs``; an iteration trains it for ``epochs`` times PPO's minibatches), and
    ``normalize`` (True): whether observations and rewards are standardised, at the input and in the errors, by the
    transitions that the model learns from"""
    predict_termination: bool | None = argument(
        default=None, kind=Kind("be True, False or None", lambda value: value is None or isinstance(value, bool))
    )
    """whether the model predicts that episodes terminate: off suits tasks whose episodes end only by time limits. None:
    off for the tasks of the DeepMind Control suite, ``dmc/...``, none of which terminates (MBMA's setting), and for
    other environments with a true attribute ``never_terminates``; else on"""

    # ---------------------------------------------------------------- construction

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_network_kwargs("dynamics_kwargs", self.dynamics_kwargs, DYNAMICS_DEFAULTS)
        self._check_normalizer(self._vec_normalize_env, self.observation_space)

    def _check_normalizer(self, normalizer: VecNormalize | None, space: spaces.Space) -> None:
        if self.n_simulated > 0 and normalizer is not None and normalizer.observation_space != space:
            raise ValueError(
                "VecNormalize must be around the wrappers that change observations, so that the model can normalise "
                f"what it learns from: its observations are {normalizer.observation_space}, the policy's "
                f"{self.observation_space}. Allowed: VecNormalize(VecFrameStack(env, n))"
            )

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Set another environment, as in Stable-Baselines3.

        :param env: the environment, with the same spaces and number of environments as the model was made with
        :param force_reset: whether it is reset before training continues
        :raises ValueError: if its spaces or its number of environments differ, or a wrapper around its ``VecNormalize``
            changes observations
        """
        self._check_normalizer(unwrap_vec_normalize(env) if isinstance(env, VecEnv) else None, env.observation_space)
        super().set_env(env, force_reset)

    def _setup_models(self) -> None:
        if self.predict_termination is None:
            self.predict_termination = not self._never_terminates()
        self._model_kwargs = check_network_kwargs("dynamics_kwargs", self.dynamics_kwargs, DYNAMICS_DEFAULTS)
        network = {name: value for name, value in self._model_kwargs.items() if name != "epochs"}
        sizes = self.flat_observations.size, self.model_actions.size
        #: The model. For ``simulate`` any object with its ``predict`` can replace it, elsewhere only a subclass.
        self.dynamics = Dynamics(*sizes, **network, terminations=self.predict_termination).to(self.device)
        #: The model's training transitions, as the environments gave them, not normalised by ``VecNormalize``; but the
        #: last observation of an episode comes from it, within its ``clip_obs``, as in Stable-Baselines3's replay.
        self.transitions = TransitionBuffer(self.dynamics_buffer_size, *sizes)
        # Number of transitions in the buffer that the model has not been trained on.
        self._n_new = 0

    def _never_terminates(self) -> bool:
        # has_attr first, since get_attr of a missing attribute kills a worker of SubprocVecEnv.
        env = self.env
        return env is not None and env.has_attr("never_terminates") and all(env.get_attr("never_terminates"))

    def _model_names(self) -> list[str]:
        return ["dynamics", "dynamics.optimizer", "transitions"]

    # ---------------------------------------------------------------- collecting

    def _collect(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        if self.n_simulated == 0:
            return super()._collect(env, callback, rollout_buffer, n_rollout_steps)
        recorder = _Recorder(self, callback)
        goes_on = super()._collect(env, recorder, rollout_buffer, n_rollout_steps)
        # If a callback ends the training, on_rollout_end is not called.
        recorder.store()
        return goes_on

    # ---------------------------------------------------------------- the model

    def fit_models(self) -> None:
        """
        Train the model for ``epochs`` times PPO's minibatches on batches drawn from the transitions so far (MBMA,
        algorithm 1, lines 5 to 7), and log its losses: before the training on the new transitions, which it has not
        seen (``dynamics/heldout_...``), and during it (``dynamics/train_...``).

        :raises ValueError: if there is no rollout
        """
        self._check_has_rollout()
        stored = self._as_tensors(self.transitions.stored())
        if not self.dynamics.optimizer.state:
            # A model that was never trained has no scales for its losses.
            self.dynamics.scale_by(stored)
        n_new, self._n_new = min(self._n_new, self.transitions.size), 0
        ends = 0 if self.predict_termination else stored.terminations.sum()
        # The first ones.
        if ends > 0 and self.transitions.recent(n_new).terminations.sum() == ends:
            warn(
                "predict_termination=False, and episodes have terminated: simulated rollouts go on where they would "
                "have ended. Pass predict_termination=True (an environment says by never_terminates that none does, "
                "and a wrapper around it may make this untrue)"
            )
        if n_new > 0:
            with torch.no_grad():
                for name, loss in self.dynamics.losses(self._as_tensors(self.transitions.recent(n_new))).items():
                    self.logger.record(f"dynamics/heldout_{name}", loss.item())
                self._compare_returns()
        n_minibatches = -(-self.n_steps * self.n_envs // self.batch_size)
        n_steps = (self._model_kwargs["epochs"] or self.n_epochs) * n_minibatches
        batches = torch.as_tensor(self.transitions.draw(n_steps, self.dynamics_batch_size), device=self.device)
        for name, loss in self.dynamics.fit(stored, batches).items():
            self.logger.record(f"dynamics/train_{name}", loss.item())
        self.logger.record("dynamics/buffer_size", self.transitions.size)

    def _as_tensors(self, transitions: Transitions) -> Transitions:
        """Transitions of the buffer as the policy sees them: normalised by the current statistics of VecNormalize."""
        if self._vec_normalize_env is not None:
            venv, codec = self._vec_normalize_env, self.flat_observations
            transitions = transitions._replace(
                observations=codec.flatten(venv.normalize_obs(codec.restore(transitions.observations))),
                next_observations=codec.flatten(venv.normalize_obs(codec.restore(transitions.next_observations))),
                rewards=venv.normalize_reward(transitions.rewards),
            )
        return Transitions(*(torch.as_tensor(values, device=self.device) for values in transitions))

    @torch.no_grad()
    def _compare_returns(self) -> None:
        """
        Log the root mean squared error of the simulated h-step return, bootstrapped with the critic, against the real
        return (``simulation/return_error_<h>``). The model is given the real states and all real actions of the
        rollout, which it has not been trained on.
        """
        buffer = self.rollout_buffer
        if buffer.generator_ready:  # already flattened: the order of the steps is lost
            return
        horizons = sorted({*(2**i for i in range(10) if 2**i < self.simulation_horizon), self.simulation_horizon})
        horizons = [h for h in horizons if h < buffer.buffer_size]
        # Steps from t on in the same episode, without the step that ends it, since its reward may contain a value.
        steps = np.zeros((buffer.buffer_size, self.n_envs), np.int64)
        for t in reversed(range(buffer.buffer_size - 1)):
            steps[t] = np.where(buffer.episode_starts[t + 1] > 0, 0, steps[t + 1] + 1)
        starts, envs = np.nonzero(steps > 0)
        if len(starts) == 0 or not horizons:
            return
        chosen = np.random.permutation(len(starts))[:N_COMPARED]  # noqa: NPY002
        starts, envs, steps = starts[chosen], envs[chosen], steps[starts[chosen], envs[chosen]]

        def tensor(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=self.device)

        def at(values: Any, k: int) -> Any:
            rows = np.minimum(starts + k, buffer.buffer_size - 1)
            return (
                {key: sub[rows, envs] for key, sub in values.items()}
                if isinstance(values, dict)
                else values[rows, envs]
            )

        observations = tensor(self.flat_observations.flatten(at(buffer.observations, 0)))
        discount = torch.ones(len(starts), device=self.device)
        simulated, real = torch.zeros_like(discount), torch.zeros_like(discount)
        for k in range(horizons[-1]):
            actions = tensor(at(buffer.actions, k))
            actions = actions.flatten() if self.model_actions.is_discrete else actions
            prediction = self.dynamics.predict(observations, self.model_actions(actions))
            observations = prediction.next_observations
            simulated = simulated + discount * prediction.rewards
            real = real + self.gamma**k * tensor(at(buffer.rewards, k))
            discount = self.gamma * (discount if prediction.continues is None else discount * prediction.continues)
            there = torch.as_tensor(steps > k, device=self.device)
            if k + 1 in horizons and there.any():
                ours = simulated + discount * self.values_of(observations)
                theirs = real + self.gamma ** (k + 1) * tensor(at(buffer.values, k + 1))
                error = (ours - theirs)[there].square().mean().sqrt()
                self.logger.record(f"simulation/return_error_{k + 1}", error.item())

    @torch.no_grad()
    def roll_out(
        self, observations: torch.Tensor, actions: torch.Tensor, noise: torch.Tensor | None = None, n_kept: int = 0
    ) -> Simulation:
        """
        Roll the model out for ``simulation_horizon`` steps under the current policy: the given actions first, then the
        policy's. Each step of all B states is one batch.

        :param observations: states to start from, (B, O)
        :param actions: the first actions, as the policy gives them (not clipped), (B, A), or (B,) integers
        :param noise: standard Gaussian noise of the later actions, (H - 1, B, A); drawn if None. Ignored for Discrete
            actions
        :param n_kept: number of steps whose states are kept
        :return: TD(lambda) returns from each step on, values, and the kept states
        """
        rewards, continues, values = [], [], []
        kept: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = []
        for k in range(self.simulation_horizon):
            prediction = self.dynamics.predict(observations, self.model_actions(actions))
            observations = prediction.next_observations
            rewards.append(prediction.rewards)
            values.append(self.values_of(observations))
            if prediction.continues is not None:
                continues.append(prediction.continues)
            if k + 1 < self.simulation_horizon:
                try:
                    distribution = self.distribution_at(observations)
                except ValueError:
                    # torch's distributions reject NaN, but do not say where it comes from.
                    self._check_finite("states", observations)
                    raise
                actions = draw(distribution, None if noise is None else noise[k])
                if k < n_kept:
                    kept.append((observations, actions, distribution.log_prob(actions)))
        c = torch.stack(continues) if continues else None
        next_values = torch.stack(values)
        q_values = lambda_returns(torch.stack(rewards), next_values, c, self.gamma, self.gae_lambda)
        states = [torch.stack(column) for column in zip(*kept, strict=True)] if kept else [None] * 3
        return Simulation(q_values, next_values, c, *states)

    def _rows_at_once(self) -> int:
        """Number of rollouts in a chunk of a simulation."""
        floats = FLOATS_AT_ONCE.get(self.device.type, FLOATS_AT_ONCE["cuda"])
        return max(1, floats // self._model_kwargs["width"])

    @staticmethod
    def _check_finite(name: str, simulated: torch.Tensor) -> None:
        if not torch.isfinite(simulated).all():
            raise ValueError(
                f"simulated {name} are not finite: the model has diverged. Allowed are finite numbers; try a smaller "
                "dynamics_kwargs['learning_rate'] or simulation_horizon"
            )


def draw(distribution: Distribution, noise: torch.Tensor | None) -> torch.Tensor:
    """
    :param distribution: of the actions at B states
    :param noise: standard Gaussian noise, (B, A), or None; ignored for Discrete actions
    :return: one action for each state, (B, A) or (B,)
    """
    if noise is None or isinstance(distribution, CategoricalDistribution):
        return distribution.sample()
    normal: Any = distribution.distribution  # type: ignore[attr-defined]
    return torch.addcmul(normal.mean, normal.stddev, noise)


class _Recorder(BaseCallback):
    """
    Wraps the user's callback during a rollout and records the transitions: the rollout buffer lacks the last
    observation of an episode, the termination, and the numbers before ``VecNormalize``.

    :param agent: the agent that collects the rollout
    :param callback: the user's callback
    """

    def __init__(self, agent: ModelBasedPPO, callback: BaseCallback):
        super().__init__()
        self.agent, self.callback = agent, callback
        self.venv = agent._vec_normalize_env
        last = agent._last_original_obs if self.venv is not None else agent._last_obs
        self.observations = agent.flat_observations.flatten(last)
        self.noted: list[tuple[np.ndarray, ...]] = []

    def on_rollout_start(self) -> None:
        self.callback.on_rollout_start()

    def on_rollout_end(self) -> None:
        # First, since the callback may want to train the model.
        self.store()
        self.callback.on_rollout_end()

    def update_locals(self, locals_: dict[str, Any]) -> None:
        self.locals = locals_
        self.callback.update_locals(locals_)

    def on_step(self) -> bool:
        flatten = self.agent.flat_observations.flatten
        dones, infos = self.locals["dones"], self.locals["infos"]
        if self.venv is None:
            new, rewards = self.locals["new_obs"], self.locals["rewards"]
        else:
            new, rewards = self.venv.get_original_obs(), self.venv.get_original_reward()
            self.agent._last_original_obs = new  # type: ignore[assignment]
        new = flatten(new)
        following = new.copy()
        terminated = np.zeros(len(dones), np.float32)
        for index in np.flatnonzero(dones):
            last = infos[index]["terminal_observation"]
            if self.venv is not None:
                last = self.venv.unnormalize_obs(last)
            following[index] = flatten(
                {key: np.asarray(value)[None] for key, value in last.items()} if isinstance(last, dict) else last
            )
            terminated[index] = not infos[index].get("TimeLimit.truncated", False)
        # Copied, since Stable-Baselines3 adds the value after a time limit to the rewards in place.
        actions = np.array(self.locals["actions"], np.float32)
        self.noted.append((self.observations, actions, following, np.array(rewards, np.float32), terminated))
        self.observations = new.copy()
        return self.callback.on_step()

    def store(self) -> None:
        """Put the recorded transitions into the model's buffer."""
        if not self.noted:
            return
        columns = [np.concatenate(column) for column in zip(*self.noted, strict=True)]
        actions = torch.as_tensor(columns[1], device=self.agent.device)
        if isinstance(self.agent.action_space, spaces.Box):
            actions = actions.reshape(len(actions), -1)
        columns[1] = self.agent.model_actions(actions).cpu().numpy()
        self.agent.transitions.add(Transitions(*columns))
        self.agent._n_new += len(actions)
        self.noted = []

    def _on_step(self) -> bool:
        return True
