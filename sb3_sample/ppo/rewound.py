"""Extra actions at the real states, with Q-values from the environment itself, which is rewound to each state."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)

from sb3_sample.constructor import Given, argument
from sb3_sample.envs.atari import is_atari, repeats_actions
from sb3_sample.envs.rewinding import rewound_returns, sibling_of
from sb3_sample.envs.states import EnvState, check_restorable, check_step, save_state
from sb3_sample.kinds import Kind, integer
from sb3_sample.ppo.samples import SimulatedSamples
from sb3_sample.ppo.simulated_ppo import ExtraSamplesPPO
from sb3_sample.ppo.spaces import FlatObservations
from sb3_sample.saving.kept import Kept

#: Vectorised wrappers that leave observations, rewards and actions unchanged.
_TRANSPARENT = (VecCheckNan, VecMonitor)
#: About how many steps of a rollout are repeated in a copy, to compare what comes of them.
REPEATED = 32


class RewoundPPO(ExtraSamplesPPO):
    """
    PPO with many actions by the environment itself (MBMA, Nauman and Cygan 2023, https://arxiv.org/abs/2210.13011,
    equation 3, figure 1 and table 1's last columns): at each real state ``n_actions - 1`` further actions are taken in
    copies of the environment that are rewound to that state, and the policy is followed from there. Only the first
    action leads to the next state, and the real environment runs as if there were no further actions.

    A further action has the same kind of return as the action taken: TD(``gae_lambda``), to the rollout's end, a
    termination or a time limit, bootstrapped with the critic. ``gae_lambda=1`` is the paper's equation.

    With ``n_epochs=1`` and ``batch_size`` of the whole rollout it is the plain actor-critic of figure 1: the only
    gradient step of a rollout is at probability ratio 1, where PPO's clipping does nothing.

    The steps of the further actions are logged separately, as ``rewound/steps`` of the iteration and
    ``rewound/total_steps``; they do not count as real steps.

    :raises ValueError: if an argument is out of range or contradicts another, or the environment cannot be rewound
    """

    _kept: ClassVar[dict[str, Kept]] = {
        # Belongs to the current rollout.
        "_states": Kept.NOWHERE,
        # Made from the environment.
        "_siblings": Kept.NOWHERE,
    }
    plain: ClassVar[str] = "n_actions=1"
    simulation_arguments: ClassVar[tuple[str, ...]] = (
        *ExtraSamplesPPO.simulation_arguments,
        "horizon",
        "sample_actions",
        "copies",
    )

    n_actions: int = argument(default=2, kind=integer(1))
    """N, actions at each state of a rollout, including the one carried out; 1 for plain PPO"""
    horizon: int | None = argument(default=None, kind=integer(1).or_none("the rollout's end"))
    """steps after which the return of a further action is bootstrapped, even beyond the rollout's end; None: at the
    rollout's end, as for the action taken"""
    sample_actions: str = argument(
        default="draw", kind=Kind("be 'draw' or 'all'", lambda value: value in ("draw", "all"))
    )
    """"draw": ``n_actions - 1`` actions of the policy. "all": with a Discrete space every action, weighted by its
    probability times ``n_actions - 1``"""
    copies: int = argument(default=16, kind=integer(1))
    """environments made like the real one, in which the further actions are taken side by side"""
    warm_up_until: float | None = argument(default=0.0)
    """share of the training over which the further actions rise linearly from 0 to ``n_actions - 1``; None: 0.15"""
    anneal_until: float | None = argument(default=None)
    """share of the training, of ``total_timesteps``, after which there are no further actions; None for never"""

    def _construct(self, given: Given) -> None:
        #: Steps taken in the copies over the model's life.
        self.num_rewound_steps = 0
        # By step and environment, the states of the current rollout.
        self._states: list[list[EnvState]] = []
        self._siblings: list[gym.Env] = []
        super()._construct(given)

    @property
    def _n_extra(self) -> int:
        return self.n_actions - 1

    def _check_arguments(self) -> None:
        if self.n_actions == 1 and self.horizon is not None:
            # It may come from hyperparams/rewound_ppo.yml instead of the user.
            raise ValueError(
                f"horizon={self.horizon!r} means nothing with {self.plain}: leave it out, or at None (in the zoo, "
                "whose file has one, -params n_actions:1 horizon:None; horizon: null in a plan)"
            )
        super()._check_arguments()
        if self.sample_actions == "all" and not isinstance(self.action_space, spaces.Discrete):
            raise ValueError(
                f"sample_actions='all' takes every action of a Discrete space, which {self.action_space} is not: pass "
                "sample_actions='draw'"
            )

    def _make_flat_observations(self) -> FlatObservations:
        return FlatObservations(self.observation_space, images=True, plain=self.plain)

    def _setup_models(self) -> None:
        self._states, self._siblings = [], []
        if self.env is not None:
            self._make_siblings()

    def _model_names(self) -> list[str]:
        return []

    # ---------------------------------------------------------------- environments

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Set another environment, as in Stable-Baselines3.

        :param env: the environment, with the same spaces and number of environments as the model was made with
        :param force_reset: whether it is reset before training continues
        :raises ValueError: if its spaces or its number of environments differ, or it cannot be rewound
        """
        super().set_env(env, force_reset)
        if self._n_extra > 0:
            self._states = []
            self._make_siblings()

    def _make_siblings(self) -> None:
        """
        Make the copies, and check that a state can be saved in one and restored in another.

        :raises ValueError: if it cannot
        """
        base = self._venv(self.env)
        if base.envs[0].render_mode == "human":
            raise ValueError("env has render_mode='human', and its copies would be shown too: train without")
        try:
            # The other copies are made when they are needed.
            self._siblings = [sibling_of(base.envs[0]) for _ in range(min(self.copies, 2))]
        except Exception as error:  # constructors of environments and wrappers may raise anything
            raise ValueError(
                f"env must be one that can be made once more, to go back to its states, and {base.envs[0]} cannot "
                f"({error!r}): register it and pass its id, or pass {self.plain} for plain PPO"
            ) from error
        try:
            check_restorable(self._siblings[0], self._siblings[-1])
        except Exception as error:
            raise ValueError(f"{error}. Pass {self.plain} for plain PPO") from error
        for index, env in enumerate(base.envs[1:], 1):
            try:
                # Few steps suffice: another constructor or function differs from the first step on.
                check_restorable(sibling_of(env), self._siblings[0], n_steps=5)
            except Exception as error:
                raise ValueError(
                    f"the environments of env must be made in the same way, since copies of the first follow the "
                    f"further actions of all: a state of environment {index} goes on otherwise in a copy of "
                    f"environment 0 ({error}). Pass {self.plain} for plain PPO, or keep what differs in attributes"
                ) from error

    def _venv(self, venv: Any) -> DummyVecEnv:
        """The environments in this process, below the known wrappers."""
        while isinstance(venv, VecEnvWrapper):
            if not isinstance(venv, (*_TRANSPARENT, VecNormalize, VecTransposeImage)):
                raise ValueError(
                    f"env: {type(venv).__name__} changes what the policy sees in a way that cannot be repeated at a "
                    "restored state: wrap the single environments instead (frames by Gymnasium's "
                    f"FrameStackObservation), or pass {self.plain} for plain PPO"
                )
            venv = venv.venv
        if not isinstance(venv, DummyVecEnv):
            raise ValueError(
                f"env must have its environments in this process, where their states can be saved: pass a DummyVecEnv, "
                f"not {type(venv).__name__}, or {self.plain} for plain PPO"
            )
        return venv

    # ---------------------------------------------------------------- the iteration

    def _collect(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        self._states = []
        if self.current_n_simulated() == 0:
            return super()._collect(env, callback, rollout_buffer, n_rollout_steps)
        return super()._collect(env, _Saver(self, callback, n_rollout_steps), rollout_buffer, n_rollout_steps)

    def fit_models(self) -> None:
        """Do nothing: there is no model to fit."""

    def _train(self) -> None:
        before = self.num_rewound_steps
        super()._train()
        if self._n_extra > 0:
            self.logger.record("rewound/steps", self.num_rewound_steps - before)
            self.logger.record("rewound/total_steps", self.num_rewound_steps)

    def _simulate(
        self, observations: torch.Tensor, values: torch.Tensor, n_simulated: int, noise: torch.Tensor | None
    ) -> SimulatedSamples:
        """
        Noise: (N, X, A), of the further actions, or with a Discrete space (N, X), uniform in [0, 1). The observations
        have to be those of the current rollout, whose states are saved.
        """
        n_envs = self.n_envs
        if len(self._states) * n_envs != len(observations) or not torch.equal(
            observations, self.current_rollout().observations
        ):
            raise ValueError(
                f"observations must be those of the present rollout, whose {len(self._states) * n_envs} states are "
                f"saved, not {len(observations)} others: pass model.current_rollout().observations"
            )
        actions, log_probs, weights = self._further_actions(observations, n_simulated, noise)
        n_steps, n_columns = len(self._states), actions.shape[1]
        # In the order of the buffer's rows: the steps of one environment after those of another.
        states = [self._states[t][index] for index in range(n_envs) for t in range(n_steps)]
        left = [n_steps - t if self.horizon is None else self.horizon for _ in range(n_envs) for t in range(n_steps)]
        base = self._venv(self.env).envs[0]
        self._siblings += [sibling_of(base) for _ in range(self.copies - len(self._siblings))]
        flat_actions = actions.flatten(0, 1).cpu().numpy()
        if isinstance(self.action_space, spaces.Box):
            flat_actions = flat_actions.reshape(-1, *self.action_space.shape)
        # From the generator that checkpoints keep. With the random state saved in a state, all its continuations would
        # be equal.
        rng = np.random.default_rng(np.random.randint(2**31))  # noqa: NPY002
        returns, taken = rewound_returns(
            _Follower(self),
            self._siblings,
            [state for state in states for _ in range(n_columns)],
            flat_actions,
            np.repeat(left, n_columns).tolist(),
            rng,
            self.gae_lambda,
        )
        self.num_rewound_steps += taken
        if not np.isfinite(returns).all():
            raise ValueError(
                "returns of the further actions are not finite: allowed are finite rewards and values of the critic"
            )
        q_values = torch.as_tensor(returns, dtype=torch.float32, device=self.device).view(-1, n_columns)
        return SimulatedSamples(None, actions, log_probs, q_values, q_values - values[:, None], weights)

    def _further_actions(
        self, observations: torch.Tensor, n_simulated: int, noise: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        distribution = self.distribution_at(observations)
        if self.sample_actions == "all" or not isinstance(distribution, CategoricalDistribution):
            return self._many_actions(observations, n_simulated, noise)
        logits = distribution.distribution.logits
        if noise is None:
            noise = torch.rand(len(logits), n_simulated, device=logits.device)
        borders = logits.exp().cumsum(dim=1)
        # The last probability is 1, up to rounding.
        actions = torch.searchsorted(borders, noise.contiguous(), right=True).clamp(max=logits.shape[1] - 1)
        return actions, logits.gather(1, actions), None


class _Saver(BaseCallback):
    """
    Wraps the user's callback during a rollout, saves the states in which actions are taken, and repeats some of the
    steps in a copy: a state that changes late in an episode, or that a copy shares with its original, is not seen by
    the check at the start.

    :param agent: the agent that collects the rollout
    :param callback: the user's callback
    :param n_steps: steps of the rollout
    """

    def __init__(self, agent: RewoundPPO, callback: BaseCallback, n_steps: int):
        super().__init__()
        self.agent, self.callback, self.n_steps = agent, callback, n_steps
        self.venv = agent._venv(agent.env)
        self.envs = self.venv.envs
        self.every = max(1, n_steps // REPEATED)
        # Other steps, and of other environments, in each rollout.
        self.rollout = agent.num_timesteps // (n_steps * len(self.envs))
        # The states of Atari's console lack the action that a sticky action repeats.
        self.is_exact = not any(is_atari(env) and repeats_actions(env) for env in self.envs)

    def on_rollout_start(self) -> None:
        self.callback.on_rollout_start()
        self._save()

    def on_rollout_end(self) -> None:
        self.callback.on_rollout_end()

    def update_locals(self, locals_: dict[str, Any]) -> None:
        self.callback.update_locals(locals_)

    def on_step(self) -> bool:
        step = len(self.agent._states) - 1
        if self.is_exact and step % self.every == self.rollout % self.every:
            self._repeat((self.rollout + step // self.every) % len(self.envs))
        # The callback first, since it may change the environment in which the next action is taken.
        goes_on = self.callback.on_step()
        if goes_on and len(self.agent._states) < self.n_steps:
            self._save()
        return goes_on

    def _on_step(self) -> bool:
        return True

    def _repeat(self, index: int) -> None:
        """
        Repeat the last step of an environment in a copy.

        :raises ValueError: if something else comes of it
        """
        held: Any = {key: values[index] for key, values in self.venv.buf_obs.items()}
        agent = self.agent
        try:
            check_step(
                agent._siblings[0], agent._states[-1][index], self.venv.actions[index], held.get(None, held),
                self.venv.buf_rews[index], bool(self.venv.buf_dones[index]),
            )  # fmt: skip
        except ValueError as error:
            raise ValueError(
                f"env must be an environment whose state can be saved and restored, and environment {index} is not: "
                f"{error}. Keep all that changes in attributes of data, without functions and arrays that refer to "
                f"others, or pass {agent.plain} for plain PPO"
            ) from error

    def _save(self) -> None:
        self.agent._states.append([save_state(env) for env in self.envs])


class _Follower:
    """
    Policy and critic in the environment's own units, with the statistics of ``VecNormalize`` frozen.

    :param agent: the algorithm
    """

    def __init__(self, agent: RewoundPPO):
        self.agent, self.gamma = agent, agent.gamma
        self._policy: Any = agent.policy
        self._wrappers: list[VecEnvWrapper] = []
        venv: Any = agent.env
        while isinstance(venv, VecEnvWrapper):
            self._wrappers.insert(0, venv)
            venv = venv.venv

    def _tensor(self, observations: Any) -> Any:
        for wrapper in self._wrappers:
            if isinstance(wrapper, VecNormalize):
                observations = wrapper.normalize_obs(observations)
            elif isinstance(wrapper, VecTransposeImage):
                observations = wrapper.transpose_observations(observations)
        return self._policy.obs_to_tensor(observations)[0]

    def sample(self, observations: Any) -> np.ndarray:
        with torch.no_grad():
            sampled: np.ndarray = self._policy.get_distribution(self._tensor(observations)).sample().cpu().numpy()
        return sampled.reshape(-1, *self.agent.action_space.shape)  # type: ignore[misc]

    def values(self, observations: Any) -> np.ndarray:
        with torch.no_grad():
            # Not every device has float64.
            values: np.ndarray = (
                self._policy.predict_values(self._tensor(observations)).flatten().cpu().double().numpy()
            )
        return values

    def normalize_rewards(self, rewards: np.ndarray) -> np.ndarray:
        for wrapper in self._wrappers:
            if isinstance(wrapper, VecNormalize):
                rewards = wrapper.normalize_reward(rewards)
        return rewards

    def to_env(self, actions: np.ndarray) -> np.ndarray:
        space = self.agent.action_space
        if not isinstance(space, spaces.Box):
            return actions
        if self._policy.squash_output:
            return self._policy.unscale_action(actions)  # type: ignore[no-any-return]
        return np.clip(actions, space.low, space.high)
