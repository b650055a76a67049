"""
The on-policy family: PPO whose policy gradient also uses further samples, and the class that does the work.

``ExtraSamplesPPO.train`` is the whole iteration after the rollout, in the order of MBMA, algorithm 1. Subclasses
provide the extra samples in ``fit_models`` and ``_simulate``.
"""

import math
import pathlib
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.arguments import check_program, default_of
from sb3_sample.constructor import Given, argument
from sb3_sample.faults import TrainingDiverged, check_finite_parameters, diverged, not_finite
from sb3_sample.kinds import check_value, integer
from sb3_sample.ppo import arguments
from sb3_sample.ppo.arguments import PPOArguments
from sb3_sample.ppo.policy_update import PolicyUpdate
from sb3_sample.ppo.samples import Rollout, SimulatedSamples, log_prob_of_many
from sb3_sample.ppo.spaces import FlatObservations, ModelActions
from sb3_sample.saving.checkpoint import CHECKPOINT_FREQ
from sb3_sample.saving.kept import Kept
from sb3_sample.saving.model import SafeFiles
from sb3_sample.warn import warn

Self = TypeVar("Self", bound="ExtraSamplesPPO")

#: Hidden widths of actor and critic (MBMA, appendix B.2) of policies given by name.
NET_ARCH: dict[str, list[int]] = {"pi": [512, 512], "vf": [1024, 1024]}
#: Share of the training over which the number of samples rises (MBMA, section 5.1).
WARM_UP = 0.15
NAMED_POLICIES = ("MlpPolicy", "MultiInputPolicy")


class ExtraSamplesPPO(PolicyUpdate, PPOArguments, SafeFiles, PPO):
    """
    PPO whose policy loss also uses further samples (MBMA, Nauman and Cygan 2023, https://arxiv.org/abs/2210.13011,
    algorithm 1): the common base of :class:`SimulatedPPO` and :class:`RewoundPPO`. The critic learns from the real
    samples only.

    The number of updates is PPO's: each uses ``batch_size`` real samples and their further samples for the policy, and
    only the real ones for the value. Without further samples it *is* Stable-Baselines3's PPO.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    policy_base = ActorCriticPolicy
    _kept: ClassVar[dict[str, Kept]] = {
        "flat_observations": Kept.NOWHERE,
        "model_actions": Kept.NOWHERE,
        # Empty at the end of an iteration.
        "_seconds": Kept.NOWHERE,
    }
    #: The argument that makes it plain PPO.
    plain: ClassVar[str] = ""
    #: Arguments that mean nothing without simulated samples.
    simulation_arguments: ClassVar[tuple[str, ...]] = ("anneal_until", "warm_up_until")

    def _construct(self, given: Given) -> None:
        check_program(type(self), given)
        arguments.check_counts(type(self), given)
        is_set_up = given.pop("_init_setup_model")
        theirs = self._store(given, PPO)
        PPO.__init__(self, **theirs, _init_setup_model=False)
        # A policy class has its own widths. Of a loaded model's policy only the class is known, not the name.
        self._has_named_policy = theirs["policy"] in NAMED_POLICIES
        # Share of the training at which the current rollout began.
        self._progress = 0.0
        # Counted within the current or last call of learn.
        self._iteration = 0
        self._seconds: dict[str, float] = {}
        if is_set_up:
            self._setup_model()

    @property
    def _n_extra(self) -> int:
        """Further samples for each real one, at the maximum of the schedule; 0 for PPO."""
        raise NotImplementedError

    # ---------------------------------------------------------------- construction

    def _setup_model(self) -> None:
        super()._setup_model()
        if self._n_extra > 0:
            self.flat_observations = self._make_flat_observations()
            self.model_actions = ModelActions(self.action_space, self.device)
            # After the policy, so that its initial weights equal Stable-Baselines3's with the same seed.
            self._setup_models()

    def _make_flat_observations(self) -> FlatObservations:
        return FlatObservations(self.observation_space)

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs = dict(self.policy_kwargs)
        if self._has_named_policy:
            kwargs.setdefault("net_arch", {name: list(widths) for name, widths in NET_ARCH.items()})
        optimizer_class = kwargs.get("optimizer_class", torch.optim.Adam)
        # By default Stable-Baselines3's, whose epsilon is also the paper's.
        given = kwargs.get("optimizer_kwargs") or {"eps": 1e-5}
        fusible = optimizer_class is torch.optim.Adam and self.device.type in ("cpu", "cuda")
        if self._n_extra > 0 and fusible and not {"foreach", "differentiable"} & given.keys():
            # The fused kernel takes the same steps in a third of the time.
            kwargs["optimizer_kwargs"] = {"fused": True, **given}
        return kwargs

    def _check_arguments(self) -> None:
        arguments.check(self)

    def _setup_models(self) -> None:
        """Build the models behind the simulated samples."""
        raise NotImplementedError

    def _model_names(self) -> list[str]:
        """
        :return: attributes with a ``state_dict`` that are saved beside the policy
        """
        raise NotImplementedError

    def _maybe_recommend_cpu(self, mlp_class_name: str = "ActorCriticPolicy") -> None:
        # Simulation benefits from a GPU.
        if self._n_extra == 0:
            super()._maybe_recommend_cpu(mlp_class_name)

    # ---------------------------------------------------------------- saving and loading

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, *(self._model_names() if self._n_extra > 0 else [])], variables

    @classmethod
    def _implied(cls, kwargs: dict[str, Any]) -> dict[str, Any]:
        # The file's arguments of further samples contradict plain PPO.
        name, value = cls.plain.split("=")
        is_plain = kwargs.get(name) == int(value)
        return {name: default_of(cls, name) for name in cls.simulation_arguments} if is_plain else {}

    # ---------------------------------------------------------------- the iteration

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
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

        :param total_timesteps: environment steps to take
        :param callback: called at every step
        :param log_interval: iterations between two lines of the log
        :param tb_log_name: name of the run in the TensorBoard log; the class's name if None
        :param reset_num_timesteps: whether ``num_timesteps`` starts at zero again
        :param progress_bar: whether to show a progress bar (needs tqdm and rich)
        :param checkpoint: folder of the run; None for no checkpoints. Each call of ``learn`` needs its own folder
        :param checkpoint_freq: environment steps between two checkpoints, each at the end of an iteration
        :return: the trained model
        :raises ValueError: if an argument is out of range, or the folder is of another run (the message names what
            differs) or of an earlier call of ``learn``, cannot be used, or has checkpoints that are all damaged
        :raises TrainingDiverged: if a loss or a parameter is NaN or infinite
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

    def _before_training(self) -> None:
        self._iteration = 0
        starts_at_none = self._n_extra > 0 and self._warm_up > 0 and self.num_timesteps == 0
        if starts_at_none and self._total_timesteps <= self.n_steps * self.n_envs:
            warn(
                f"{self._total_timesteps} steps are a single iteration (n_steps={self.n_steps} times {self.n_envs} "
                "environments), in which nothing is simulated: the number of simulated samples rises from 0. Train "
                "longer, or pass warm_up_until=0"
            )

    def _turn(self, callback: BaseCallback, log_interval: int) -> bool:
        assert self.env is not None
        if not self.collect_rollouts(self.env, callback, self.rollout_buffer, n_rollout_steps=self.n_steps):
            return False
        self._iteration += 1
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        if log_interval is not None and self._iteration % log_interval == 0:
            self.dump_logs(self._iteration)
        self.train()
        return True

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """
        Collect a rollout, as in Stable-Baselines3.

        :param env: the environments
        :param callback: called at every step
        :param rollout_buffer: the buffer to fill
        :param n_rollout_steps: steps of each environment
        :return: whether the callback lets the training continue
        """
        self._progress = self.num_timesteps / max(self._total_timesteps, 1)
        with self._phase("collect"):
            return self._collect(env, callback, rollout_buffer, n_rollout_steps)

    def _collect(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)

    @property
    def _warm_up(self) -> float:
        """Share of the training over which X rises."""
        if self.warm_up_until is not None:
            return self.warm_up_until
        return WARM_UP if self.anneal_until is None else 0.0

    def current_n_simulated(self) -> int:
        """
        :return: X of the current iteration, from ``n_simulated``, ``anneal_until`` and ``warm_up_until``
        """
        share = 1.0
        if self.anneal_until is not None:
            share *= max(0.0, 1 - self._progress / self.anneal_until)
        if self._warm_up > 0:
            share *= min(1.0, self._progress / self._warm_up)
        # The tolerance keeps 8 times 0.5 from being rounded up to 5 by rounding errors.
        return math.ceil(self._n_extra * share - 1e-9)

    def train(self) -> None:
        """
        Update models, policy and value with the current rollout (MBMA, algorithm 1, lines 5 to 13).

        :raises TrainingDiverged: if a loss or a parameter is NaN or infinite
        """
        # Entries of callbacks that are not dumped yet are no losses.
        before = dict(self.logger.name_to_value)
        try:
            self._train()
        except TrainingDiverged:
            raise
        except ValueError:
            # Possibly from torch's distributions at a mean that is not finite: name the cause.
            self._check_parameters()
            raise
        self._check_losses(before)
        self._check_parameters()

    def _check_losses(self, before: dict[str, Any]) -> None:
        """Check the losses that this iteration has logged; ``before`` is what the logger held before it."""
        logged = {
            name: value
            for name, value in self.logger.name_to_value.items()
            # The explained variance is NaN if all returns are equal.
            if name.startswith(("train/", "dynamics/"))
            and name != "train/explained_variance"
            # Whatever is recorded again is another object.
            and not (name in before and value is before[name])
        }
        bad = not_finite(logged)
        if bad:
            raise diverged(self, bad)

    def _check_parameters(self) -> None:
        """Check all parameters, and the standard deviation: the exponential of a finite one can be 0 or infinite."""
        check_finite_parameters(self)
        if not hasattr(self.policy, "log_std") or self.use_sde:
            return
        std = self.policy.log_std.detach().exp()
        bad = std[~(torch.isfinite(std) & (std > 0))]
        if len(bad) > 0:
            raise diverged(self, {"the policy's standard deviation": bad[0].item()})

    def _train(self) -> None:
        n_simulated = self.current_n_simulated()
        # The models already learn while X is still 0.
        if self._n_extra > 0 and (self.anneal_until is None or self._progress < self.anneal_until):
            with self._phase("dynamics"):
                self.fit_models()
        if n_simulated == 0:
            with self._phase("policy"):
                super().train()
        else:
            rollout = self.current_rollout()
            with self._phase("simulate"):
                samples = self.simulate(rollout.observations, rollout.values, n_simulated)
            with self._phase("policy"):
                self._update_policy(rollout, samples)
        if self._n_extra > 0:
            self.logger.record("simulation/n_simulated", n_simulated)
            self.logger.record("simulation/share", n_simulated / (n_simulated + 1))
        for phase, seconds in self._seconds.items():
            self.logger.record(f"time/{phase}_seconds", seconds)
        self._seconds.clear()

    def current_rollout(self) -> Rollout:
        """
        :return: the rollout buffer's samples as tensors, the steps of one environment after those of another
        :raises ValueError: if there is no rollout yet, as after ``load``; with ``n_simulated=0``, which allows
            observations that are not vectors
        """
        self._check_has_rollout()
        buffer = self.rollout_buffer

        def tensor(values: np.ndarray) -> torch.Tensor:
            # The buffer's own generator flattens the arrays in place when first used.
            values = values if buffer.generator_ready else buffer.swap_and_flatten(values)
            return torch.as_tensor(values, dtype=torch.float32, device=self.device)

        stored: Any = buffer.observations
        if not buffer.generator_ready:
            is_dict = isinstance(stored, dict)
            swap = buffer.swap_and_flatten
            stored = {key: swap(values) for key, values in stored.items()} if is_dict else swap(stored)
        observations = torch.as_tensor(self.flat_observations.flatten(stored), device=self.device)
        actions = tensor(buffer.actions)
        return Rollout(
            observations,
            actions.long().flatten() if self.model_actions.is_discrete else actions,
            *(tensor(x).flatten() for x in (buffer.log_probs, buffer.values, buffer.advantages, buffer.returns)),
        )

    def _check_simulates(self) -> None:
        if self._n_extra == 0:
            raise ValueError(f"{self.plain}: this model has nothing to simulate with")

    def _check_has_rollout(self) -> None:
        self._check_simulates()
        if not self.rollout_buffer.full:
            raise ValueError(
                "there is no rollout: call this after learn, or in a callback's on_rollout_end; files do not keep it"
            )

    def fit_models(self) -> None:
        """
        Train the models behind the simulated samples on the real samples so far, and log their errors.
        """
        raise NotImplementedError

    def simulate(
        self,
        observations: torch.Tensor,
        values: torch.Tensor | None = None,
        n_simulated: int | None = None,
        noise: torch.Tensor | None = None,
    ) -> SimulatedSamples:
        """
        Draw extra samples of the current policy and estimate their Q-values. Nothing but the random generators changes,
        and the number of rewound steps of ``RewoundPPO``; ``train`` calls ``model.simulate(rollout.observations)`` with
        ``rollout = model.current_rollout()``.

        At the real states, actions of a Discrete space are not drawn: all of them are returned, each with the weight X
        pi(a|s), which X draws have in expectation.

        :param observations: real observations, flat, as the policy sees them (normalised by ``VecNormalize``), (N, O)
        :param values: the critic's values of the observations, (N,); computed if None
        :param n_simulated: X, at least 1; the current iteration's if None
        :param noise: random numbers of the simulated actions, in the algorithm's own shape; drawn if None. The same
            noise reproduces the samples of a learned model exactly; ``RewoundPPO`` takes them for the first actions
        :return: N times X samples
        """
        self._check_simulates()
        n = self.current_n_simulated() if n_simulated is None else n_simulated
        if n_simulated is None and n == 0:
            raise ValueError("n_simulated must be passed, as the current iteration has no simulated samples")
        check_value("n_simulated", n, integer(1))
        self.policy.set_training_mode(False)
        with torch.no_grad():
            if values is None:
                values = self.values_of(observations)
            return self._simulate(observations, values, n, noise)

    def _simulate(
        self, observations: torch.Tensor, values: torch.Tensor, n_simulated: int, noise: torch.Tensor | None
    ) -> SimulatedSamples:
        raise NotImplementedError

    # ---------------------------------------------------------------- the policy's part

    def _many_actions(
        self, observations: torch.Tensor, n_simulated: int, noise: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """
        Draw extra actions at real observations, with their log-probabilities and weights.

        :param observations: (N, O)
        :param n_simulated: X
        :param noise: (N, X, A)
        :return: (N, X, A), (N, X), None; or all n actions of a Discrete space: (N, n), (N, n), (N, n)
        """
        distribution = self.distribution_at(observations)
        if isinstance(distribution, CategoricalDistribution):
            log_probs = distribution.distribution.logits
            actions = torch.arange(log_probs.shape[1], device=log_probs.device).expand(len(log_probs), -1)
            return actions, log_probs, n_simulated * log_probs.exp()
        normal: Any = distribution.distribution
        mean, std = normal.mean[:, None], normal.stddev[:, None]
        if noise is None:
            noise = torch.randn(len(mean), n_simulated, mean.shape[2], device=mean.device)
        actions = torch.addcmul(mean, std, noise)
        return actions, log_prob_of_many(distribution, actions), None

    @contextmanager
    def _phase(self, name: str) -> Iterator[None]:
        """Measure the duration of a phase of the iteration, for the log."""
        self._synchronize()
        start = time.perf_counter()
        yield
        self._synchronize()
        self._seconds[name] = time.perf_counter() - start

    def _synchronize(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


class SimulatedPPO(ExtraSamplesPPO):
    """
    PPO with simulated samples: the common base of :class:`MBMAPPO`, :class:`QMAPPO` and :class:`MBPOPPO`.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    plain: ClassVar[str] = "n_simulated=0"

    n_simulated: int = argument(default=8, kind=integer(0))
    """X, simulated samples for each real one, at the maximum of the schedule of ``warm_up_until`` and ``anneal_until``;
    0 for PPO. With a Discrete space: see ``simulate``"""

    @property
    def _n_extra(self) -> int:
        return self.n_simulated
