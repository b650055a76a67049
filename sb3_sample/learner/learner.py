"""
Learner of the off-policy family: networks, targets, learned numbers, optimizers and parts, and their one update.

``Learner.gradient_step`` is the whole gradient step (``learner/gradient_step.py``).
"""

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.optim import Optimizer

from sb3_sample.kinds import check_value, one_of
from sb3_sample.learner import first_step
from sb3_sample.learner.batch import (
    Batch,
    Extra,
    Noise,
    Store,
    StoreSource,
    first_copy,
    widened,
)
from sb3_sample.learner.descent import follow, minimize, parameters_of
from sb3_sample.learner.executable import Executable
from sb3_sample.learner.execution import Acting, Execution, acting_of
from sb3_sample.learner.exploration import Exploration
from sb3_sample.learner.gradient_step import TD_ERRORS, gradient_step
from sb3_sample.learner.heads import ValueHead
from sb3_sample.learner.objectives import Objective
from sb3_sample.learner.observation_statistics import ObservationStatistics
from sb3_sample.learner.observations import Observations
from sb3_sample.learner.parts import Part, logged
from sb3_sample.learner.pessimism import LearnedPessimism, Pessimism, pessimistic_value
from sb3_sample.learner.plasticity import RESETS_TO, ReDo, Resets, restart
from sb3_sample.learner.randomness import OwnGenerators, with_own_generators
from sb3_sample.learner.reward_scale import RewardScale, task_of
from sb3_sample.learner.scalars import FixedScalar, LogScalar, TaskLogScalar
from sb3_sample.learner.schedules import LearningRateSchedule
from sb3_sample.learner.transforms import BatchTransform
from sb3_sample.networks.batch_norm import BatchNorm
from sb3_sample.networks.modes import ModeSwitch
from sb3_sample.networks.network import Network
from sb3_sample.networks.projected import Projected
from sb3_sample.optim import AdamW
from sb3_sample.warn import warn


def check_is_batch(batch: Any) -> None:
    """
    Check that something is a batch.

    :param batch: anything
    :raises ValueError: if it is not
    """
    if not isinstance(batch, Batch):
        raise ValueError(f"batch must be a Batch, not {batch!r:.100}: data.sample(n) of a Dataset gives one")


def _chosen(trunk: Network) -> Network:
    """The network that was chosen for a trunk: the one behind the projection, if the trunk has one."""
    return trunk.network if isinstance(trunk, Projected) else trunk


class Counts:
    """Counts of a learner over its life, and whether its gradient step is compiled."""

    def __init__(self) -> None:
        #: Gradient steps taken.
        self._n_updates = 0
        #: Gradient steps taken when everything last started anew.
        self._began_at = 0
        #: Transitions reported by :meth:`Learner.on_step`.
        self.num_transitions = 0
        #: The same for each task, if several tasks take a step together.
        self.num_task_steps = 0
        #: Whether the gradient step is compiled; None while undecided.
        self.compiled: bool | None = None
        #: Gradient steps planned, for the schedule of the learning rate; None while unknown.
        self.planned_updates: int | None = None


class Learner(Executable):
    """
    Soft actor-critic with exchangeable parts, independent of environments, files and replay buffers.

    :param make_networks: makes freshly initialised networks
    :param head: value head, the meaning of the critics' outputs
    :param make_temperature: makes a freshly initialised temperature
    :param make_pessimism: makes a freshly initialised rule of pessimism for the learner
    :param make_explorer: makes a freshly initialised explorer for the learner
    :param plasticity: resets of networks, optimizers and learned numbers
    :param redo: recycling of dormant neurons; None for none
    :param make_transforms: each makes a batch transform for the learner, applied in this order
    :param make_reward_scaler: makes the rule that scales rewards for the learner, applied before the transforms; None
        for none
    :param make_objective: makes a freshly initialised objective for the learner; None for that of soft actor-critic
    :param learning_rate: of actor, critics and temperature, at the start
    :param schedule: learning rates over the planned gradient steps; None: as set by :meth:`set_learning_rate`
    :param temperature_beta1: beta1 of the temperature's Adam
    :param gamma: discount factor of batches that have none of their own
    :param tau: weight of the new critics in the Polyak average of the targets
    :param target_entropy: target entropy of the learned temperature; one for each task if tasks have their own
        temperatures, or the same for all; None: -|A|/2
    :param n_tasks: number of tasks that the observations distinguish
    :param target_update_interval: gradient steps between two updates of the targets; None: ``policy_delay``
    :param policy_delay: gradient steps between two updates of actors and temperature
    :param actor_at_once: whether the actors learn in the first of ``policy_delay`` gradient steps, not in the last
    :param actor_first: whether actors and temperature learn before the critics, whose target then uses the new ones
    :param target_subset: how many critics, drawn at random, make the TD target; None: all
    :param actor_pessimism: a weight of pessimism for the actor's objective alone; None: the rule's
    :param sam_radius: radius of sharpness-aware minimisation of the critics' loss; None for none
    :param learning_starts: number of transitions at the beginning whose actions are random
    :param compile: whether the gradient step is compiled; "auto": as set in ``counts.compiled``, else not
    :param device: where the learner computes
    :param verbose: 0 nothing, 1 info
    :param networks: the initial networks; made if None
    :param counts: object that holds the learner's counts, with the attributes of :class:`Counts`; made if None
    :param generators: random generators of the learner; None: torch's global ones
    """

    #: Arguments that may be set between two gradient steps, with effect from the next one on.
    SETTINGS = (
        "gamma", "tau", "target_update_interval", "policy_delay", "actor_at_once", "actor_first", "target_subset",
        "actor_pessimism", "sam_radius", "learning_starts", "verbose", "compile",
    )  # fmt: skip

    pessimism_rule: Pessimism
    explorer: Exploration

    def __init__(
        self,
        make_networks: Callable[[], Any],
        *,
        head: ValueHead,
        make_temperature: Callable[[Any], LogScalar | FixedScalar],
        make_pessimism: Callable[[Any], Pessimism],
        make_explorer: Callable[[Any], Exploration],
        plasticity: Resets,
        redo: ReDo | None = None,
        make_transforms: Sequence[Callable[[Any], BatchTransform]] = (),
        make_reward_scaler: Callable[[Any], RewardScale] | None = None,
        make_objective: Callable[[Any], Objective] | None = None,
        learning_rate: float = 3e-4,
        schedule: LearningRateSchedule | None = None,
        temperature_beta1: float = 0.9,
        gamma: float = 0.99,
        tau: float = 0.005,
        target_entropy: float | Sequence[float] | None = None,
        target_update_interval: int | None = 1,
        policy_delay: int = 1,
        actor_at_once: bool = False,
        actor_first: bool = False,
        target_subset: int | None = None,
        actor_pessimism: float | None = None,
        sam_radius: float | None = None,
        learning_starts: int = 0,
        n_tasks: int = 1,
        compile: bool | str = False,
        device: torch.device | str = "cpu",
        verbose: int = 0,
        networks: Any = None,
        counts: Any = None,
        generators: OwnGenerators | None = None,
    ):
        self._make_networks, self._make_temperature = make_networks, make_temperature
        self._make_pessimism, self._make_explorer = make_pessimism, make_explorer
        self._make_objective = make_objective or (lambda learner: Objective())
        self.device, self.verbose, self.learning_rate = torch.device(device), verbose, learning_rate
        self.gamma, self.tau = gamma, tau
        self.schedule = schedule
        self.target_update_interval, self.policy_delay = target_update_interval, policy_delay
        self.actor_at_once, self.actor_first = actor_at_once, actor_first
        self.target_subset, self.actor_pessimism, self.sam_radius = target_subset, actor_pessimism, sam_radius
        self.learning_starts, self.compile = learning_starts, compile
        self.n_tasks, self._n_envs = n_tasks, 1
        super().__init__(Counts() if counts is None else counts)
        self._generators, self.head = generators, head.to(self.device)
        self.plasticity, self.redo = plasticity, redo
        with self._random():
            self.networks = make_networks().to(self.device) if networks is None else networks
            plasticity.starts["networks"] = self.networks.drawn_from
            for critics in (self.critic, self.critic_target):
                # Bypasses nn.Module's own setattr, which would register it.
                vars(critics)["value_head"] = self.head
            self.target_entropy: float | torch.Tensor = 0.0
            self.set_target_entropy(-self.actor.action_dim / 2 if target_entropy is None else target_entropy)
            self.temperature = plasticity.first("temperature", lambda: make_temperature(self))
            self.pessimism_rule = plasticity.first("pessimism", self.make_pessimism)
            self.explorer = plasticity.first("explorer", self.make_explorer)
            self.reward_scaler = None if make_reward_scaler is None else make_reward_scaler(self).to(self.device)
            made: list[Any] = [make(self).to(self.device) for make in make_transforms]
            self.transforms: Any = nn.ModuleList(made)
            #: Copies of each transition in the TD target and in the critics' loss, as the transforms require.
            self.target_copies = math.prod(each.target_copies for each in made)
            self.online_copies = math.prod(each.online_copies for each in made)
            self.objective = plasticity.first("objective", lambda: self._make_objective(self))
        self.observation_statistics = None if self.observation_norm is None else ObservationStatistics()
        if redo is not None:
            redo.check(self)
        self.temperature_optimizer: AdamW | None = None
        if isinstance(self.temperature, LogScalar):
            betas = (temperature_beta1, 0.999)
            self.temperature_optimizer = AdamW(self.temperature.parameters(), lr=learning_rate, betas=betas)
        self._parts_mode = ModeSwitch(*self.parts().values())
        # Store from which :meth:`drawn_step` draws its batches; None: such steps are not possible.
        self._store: Store | None = None
        self._drawing: Execution | None = None
        #: Chooses how the explorer's actions are computed.
        self.make_acting: Callable[[Any], Acting | None] = acting_of
        # The explorer, and what computes its actions; None for its own ``act``.
        self._acting: tuple[Exploration, Acting | None] | None = None
        #: Whether ``.grad`` holds gradients of an earlier gradient step than the last, as a compiled step leaves none.
        self.gradients_are_stale = False
        # Whether the statistics of the observations were checked.
        self._checked_statistics = False
        # Whether the shapes of a gradient step, and those of the explorer's actions, were checked.
        self._checked_step = self._checked_actions = False
        # TD errors of the last gradient step's batch.
        self._td_errors: torch.Tensor | None = None
        # Whether a step was reported since the last gradient step.
        self._heard = False
        self.set_training_mode(False)

    def _random(self) -> AbstractContextManager[None]:
        return nullcontext() if self._generators is None else self._generators.in_force()

    # ---------------------------------------------------------------- components

    @property
    def actor(self) -> Any:
        """Actor of the evaluation, which learns from the pessimistic value."""
        return self.networks.actor

    @property
    def critic(self) -> Any:
        """Critics, E in one module."""
        return self.networks.critic

    @property
    def critic_target(self) -> Any:
        """Target critics."""
        return self.networks.critic_target

    @property
    def has_critic_targets(self) -> bool:
        """Whether TD targets come from target networks of the critics, and not from the critics themselves."""
        return bool(self.critic.trunk.stacks_rows != "online")

    @property
    def observation_norm(self) -> Any:
        """Running normalisation of the networks' observations; None for none."""
        return self.networks.observation_norm

    @property
    def n_updates(self) -> int:
        """Gradient steps taken over the learner's life."""
        return int(self._counts._n_updates)

    @property
    def num_transitions(self) -> int:
        """Transitions reported by :meth:`on_step` over the learner's life."""
        return int(self._counts.num_transitions)

    @property
    def environment_steps(self) -> int:
        """Transitions of each task, if several tasks take a step together; else :attr:`num_transitions`."""
        return self.num_transitions if self.n_tasks == 1 else int(self._counts.num_task_steps)

    @property
    def n_envs(self) -> int:
        """Environments of the latest reported step; 1 before."""
        return self._n_envs

    @property
    def planned_updates(self) -> int | None:
        """Gradient steps planned, for the schedule of the learning rate; None while unknown."""
        return self._counts.planned_updates  # type: ignore[no-any-return]

    @planned_updates.setter
    def planned_updates(self, value: int | None) -> None:
        self._counts.planned_updates = value

    @property
    def td_errors(self) -> torch.Tensor | None:
        """
        TD errors of the last gradient step, for the priorities of its transitions: the largest absolute error of any
        critic, from before the step, (B,). None if the batch came without the column ``slots``.
        """
        return self._td_errors

    def make_explorer(self) -> Exploration:
        """
        Make an explorer.

        :return: a freshly initialised explorer
        """
        return self._make_explorer(self).to(self.device)

    def make_pessimism(self) -> Pessimism:
        """
        Make a rule of pessimism.

        :return: a freshly initialised rule of pessimism
        """
        return self._make_pessimism(self).to(self.device)

    def make_actor(self) -> Any:
        """
        Make an actor.

        :return: an actor like the learner's, with its own parameters
        """
        return self.networks.make_actor()

    def make_value(self) -> Any:
        """
        Make a value network.

        :return: a network of the critics' kind that evaluates observations alone, (B, O) to (B, 1)
        """
        return self.networks.make_value()

    def make_optimizer(self, parameters: Iterable[nn.Parameter]) -> Optimizer:
        """
        Make an optimizer.

        :param parameters: what to optimise
        :return: an optimizer with the settings of actor and critics
        """
        return self.networks.make_optimizer(parameters, self.learning_rate)  # type: ignore[no-any-return]

    def next_actions(self, observations: Any, noise: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Sample the actions of a TD target.

        :param observations: next observations, (B, O), or a dict of them
        :param noise: standard normal noise, (B, A); drawn if None
        :return: actions of a TD target in [-1, 1], (B, A), and their log-probability, (B, 1)
        """
        return self.networks.next_actions(observations, noise)  # type: ignore[no-any-return]

    def encoded(self, observations: Any) -> Any:
        """
        Encode observations once for actors and critics, if they share an encoder.

        :param observations: (B, O), or a dict of them
        :return: input of actors and critics in place of the observations, without gradient to the encoder; the
            observations themselves if nothing is shared
        """
        return self.networks.encoded(observations)

    def parts(self) -> dict[str, Part]:
        """
        List the parts.

        :return: the parts, by the name of the attribute that holds them
        """
        parts: dict[str, Part] = {
            "explorer": self.explorer,
            "pessimism_rule": self.pessimism_rule,
            "plasticity": self.plasticity,
        }
        optional = ("redo", "observation_statistics", "reward_scaler")
        parts |= {name: getattr(self, name) for name in optional if getattr(self, name) is not None}
        parts |= {"objective": self.objective} if self.objective.has_state else {}
        return parts | {f"transforms.{i}": transform for i, transform in enumerate(self.transforms)}

    def optimizers(self) -> dict[str, Optimizer]:
        """
        List the optimizers.

        :return: every optimizer by its path from the learner
        """
        optimizers: dict[str, Optimizer] = {
            "actor.optimizer": self.actor.optimizer,
            "critic.optimizer": self.critic.optimizer,
        }
        if self.temperature_optimizer is not None:
            optimizers["temperature_optimizer"] = self.temperature_optimizer
        for name, part in self.parts().items():
            optimizers.update({f"{name}.{key}": optimizer for key, optimizer in part.optimizers().items()})
        return optimizers

    def set_training_mode(self, mode: bool) -> None:
        """
        Switch networks and parts between training and acting.

        :param mode: whether dropout and power iterations are on, as during gradient steps, or off, as when acting
        """
        self.networks.set_training_mode(mode)
        self._parts_mode(mode)

    def set_target_entropy(self, value: float | Sequence[float]) -> None:
        """
        Set the target entropy of the learned temperature.

        :param value: a number, or one for each task
        """
        if isinstance(value, Sequence):
            targets = torch.tensor(value, dtype=torch.float32, device=self.device)
            if isinstance(self.target_entropy, torch.Tensor):
                # In place, as a captured gradient step reads it there.
                self.target_entropy.copy_(targets)
            else:
                self.target_entropy = targets
        else:
            self.target_entropy = value

    def temperature_of(self, batch: Batch) -> torch.Tensor:
        """
        Look up the temperature of transitions.

        :param batch: transitions
        :return: a scalar with gradient, or (B, 1) where each task has its own
        """
        values: torch.Tensor = self.temperature()
        return values[task_of(batch)] if isinstance(self.temperature, TaskLogScalar) else values

    def set_learning_rate(self, rate: float) -> None:
        """
        Set the learning rate.

        :param rate: of every optimizer that does not have its own
        """
        for optimizer in self.optimizers().values():
            for group in optimizer.param_groups:
                if group.get("scheduled", True):
                    group["lr"] = rate

    @property
    def scheduled_rate(self) -> float | None:
        """Learning rate of the critics' next step by the schedule; None without one."""
        return None if self.schedule is None else self.schedule.rate(self.n_updates, self.planned_updates)

    def _set_scheduled_rates(self, schedule: LearningRateSchedule) -> None:
        """Set the rates of the step just counted, for each optimizer by the number of its own steps."""
        before = self.n_updates - 1
        of_critics = schedule.rate(before, self.planned_updates)
        # One step ahead, at the start and after every delay, if the first of the steps is the actors'.
        ahead = self.policy_delay - 1 if self.actor_at_once else 0
        of_actors = schedule.rate((before + ahead) // self.policy_delay, self.planned_updates)
        every_step = {id(each) for each in (self.critic.optimizer, *self.objective.optimizers().values())}
        for optimizer in self.optimizers().values():
            for group in optimizer.param_groups:
                if group.get("scheduled", True):
                    group["lr"] = of_critics if id(optimizer) in every_step else of_actors
            if isinstance(optimizer, AdamW):
                optimizer.prepare_rates()

    # ---------------------------------------------------------------- events of the environment

    @with_own_generators
    def on_observations(self, observations: Any) -> None:
        """
        Pass the observations that are acted on to the parts, before the actions of a training step are chosen.

        :param observations: arrays or tensors, (n_envs, O), or a dict of them
        """
        for part in self.parts().values():
            part.on_observations(self, observations)

    @with_own_generators
    def on_step(self, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """
        Record one step of all environments, and pass it to the parts.

        :param rewards: unnormalised rewards, (n_envs,)
        :param dones: whether each environment's episode ended, by termination or truncation, (n_envs,)
        :param infos: each environment's info, with Monitor's "episode" at an end
        """
        self._heard, self._n_envs = True, len(dones)
        self._counts.num_transitions += len(dones)
        self._counts.num_task_steps += len(dones) // min(self.n_tasks, len(dones))
        for part in self.parts().values():
            part.on_step(self, rewards, dones, infos)
            for index in np.flatnonzero(dones):
                if "episode" in infos[index]:  # Monitor's entry; absent if the environment is not monitored
                    part.on_episode_end(self, int(index), infos[index]["episode"]["r"])

    @with_own_generators
    def on_environment_reset(self) -> None:
        """Notify the parts that the environments were reset in mid-episode."""
        for part in self.parts().values():
            part.on_environment_reset(self)

    @with_own_generators
    def before_updates(self) -> None:
        """Call ``before_updates`` of the parts, before the gradient steps that follow an environment step."""
        self._heard = False
        for part in self.parts().values():
            part.before_updates(self)

    # ---------------------------------------------------------------- the update

    def step_modules(self) -> tuple[nn.Module, ...]:
        """
        List the modules of the gradient step.

        :return: modules that a gradient step reads or writes
        """
        return self.networks, self.head, self.temperature, self.explorer, self.pessimism_rule, self.objective

    def identities(self) -> tuple[int, ...]:
        """
        Identify what a compiled or captured gradient step is made for.

        :return: identities of networks, parts, optimizers and loss, the optimizers' numbers of parameters, and which of
            these are frozen
        """
        critics = (self.critic, self.critic.trunk, self.critic_target, self.critic_target.trunk)
        optimizers = self.optimizers().values()
        parts = (self.explorer, self.pessimism_rule, self.objective)
        objects = (self.actor, self.actor.trunk, *critics, self.temperature, *parts)
        sizes = (len(group["params"]) for optimizer in optimizers for group in optimizer.param_groups)
        trained = (p.requires_grad for optimizer in optimizers for p in parameters_of(optimizer))
        return (*map(id, (*objects, *optimizers, self.head, self._store)), *sizes, *trained)

    def exchangeable(self) -> dict[str, Any]:
        return {
            "exploration": self.explorer,
            "pessimism": self.pessimism_rule,
            "value_head": self.head,
            "actor_network": _chosen(self.actor.trunk),
            "critic_network": _chosen(self.critic.trunk),
        }

    @property
    def seconds_compiling(self) -> float:
        return super().seconds_compiling + (0.0 if self._drawing is None else self._drawing.seconds_compiling)

    def forget_execution(self) -> None:
        super().forget_execution()
        self._drawing = self._acting = None

    def draw_from(self, store: Store) -> None:
        """
        Set where :meth:`take_drawn_step` draws its batches from.

        :param store: a replay buffer on the learner's device
        """
        self._store = store

    def prepared_drawing(self) -> Execution:
        """
        Prepare the gradient steps that follow, by :meth:`take_drawn_step`.

        :return: runner of these steps
        """
        if self._drawing is None or not self._drawing.serves(self):
            self._drawing = self.make_execution(self, "drawn_step")
        self._drawing.prepare(self)
        return self._drawing

    def update(self, batch: Batch, noise: Noise | None = None, extra: Extra | None = None) -> dict[str, torch.Tensor]:
        """
        Take one gradient step, after the work that is due: resets, and the parts' work after environment steps.

        :param batch: transitions, on the learner's device
        :param noise: random numbers of the step; drawn where it is None. A given noise reproduces a step exactly,
            unless transforms draw for the transitions of ``extra``, always by torch's generator
        :param extra: further transitions for a rule of pessimism that learns from some, from its ``draw``
        :return: what to log, by name, scalars on the learner's device
        :raises ValueError: if ``batch`` is not a batch, or has too few transitions for batch norm
        """
        self._check_batch(batch)
        with self._updating():
            return self.step(batch, noise, extra)

    def _check_batch(self, batch: Any) -> None:
        check_is_batch(batch)
        self.check_rows(len(batch.rewards), "transitions of a batch")

    def check_rows(self, n: int, name: str) -> None:
        """
        Check that a batch is large enough, before anything has learned from it: the critics may see twice its rows, and
        would have taken their step when the actor's batch norm refuses it.

        :param n: transitions of a batch
        :param name: what the message calls them
        :raises ValueError: one transition, of which batch norm can take no variance
        """
        if n >= 2:
            return
        for network, is_stacked in (
            (self.critic, self.critic.trunk.stacks_rows is not None),
            (self.actor, self.actor.trunk.stacks_actor_rows),
            (self.explorer, self.actor.trunk.stacks_actor_rows),
        ):
            if not is_stacked and any(isinstance(layer, BatchNorm) for layer in network.modules()):
                raise ValueError(
                    f"{name} must be at least 2 with batch norm, which takes mean and variance of the batch, not {n}"
                )

    @contextmanager
    def _updating(self) -> Iterator[None]:
        """Prepare a gradient step of :meth:`update`: parts, resets, execution, and training mode until its end."""
        with self._random():
            if self._heard:
                self.before_updates()
            scaler = self.reward_scaler
            if scaler is not None and scaler.needs_steps and self.num_transitions == 0:
                warn(
                    f"{type(scaler).__name__} scales rewards by returns, and this learner was told of no step: call "
                    "its on_step at those of the environments, or pass reward_scale=None, or 'linear'"
                )
            norm = None if self._checked_statistics else self.observation_norm
            self._checked_statistics = True
            if norm is not None and norm.count < 1:
                warn(
                    "normalize_observations=True has no effect, as this learner was shown no observations: call its "
                    "on_observations before each action and on_step after it, or learner.observation_norm.update with "
                    "those of the data, or pass normalize_observations=False"
                )
            self.plasticity.before_gradient_steps(self, 1)
            # A compiled or captured step receives the rates, settings and moments set since the last one.
            self.prepared_execution()
            self.set_training_mode(True)
            try:
                yield
            finally:
                self.set_training_mode(False)

    def act(self, observations: Any, deterministic: bool = False) -> torch.Tensor | np.ndarray:
        """
        Choose actions.

        :param observations: tensors, or NumPy's arrays, (B, O) or a single one (O,); or a dict of either
        :param deterministic: whether to take the actor's mean action, as in evaluation, not the explorer's sample
        :return: actions in [-1, 1], (B, A), or (A,) for a single observation: a tensor on the learner's device for
            tensors, an array for arrays
        :raises ValueError: if the observations have other keys or shapes than the observation space
        """
        given = Observations(observations, self.networks.observation_space, self.device)
        with self._random(), torch.inference_mode():
            if deterministic:
                return given.actions(self.actor(given.batch, deterministic=True))
            return given.actions(self.explore(given.batch))

    def explore(self, observations: Any) -> torch.Tensor:
        """
        Compute the explorer's actions.

        :param observations: tensors on the learner's device, (B, O), or a dict of them
        :return: actions in [-1, 1], (B, A)
        :raises ValueError: if the explorer's first actions are not of this form
        """
        actions = self._actions(observations)
        if not self._checked_actions:
            first_step.check_actions(self, observations, actions)
            self._checked_actions = True
        return actions

    def _actions(self, observations: Any) -> torch.Tensor:
        """The explorer's actions; on a GPU by a captured graph, with those of learners that act together."""
        if self._acting is None or self._acting[0] is not self.explorer:
            self._acting = self.explorer, self.make_acting(self)
        acting = self._acting[1]
        if acting is None:
            actions: torch.Tensor = self.explorer.act(self, observations)
            return actions
        noise = self.explorer.draw_noise(self, observations)
        return acting(self, (observations, noise))["actions"]

    def action_step(self, observations: Any, noise: torch.Tensor) -> dict[str, torch.Tensor]:
        """
        Compute the explorer's actions, on tensors only: this function is captured.

        :param observations: tensors on the learner's device, (B, O), or a dict of them
        :param noise: from the explorer's ``draw_noise``, (B, A)
        :return: "actions", in [-1, 1], (B, A)
        """
        return {"actions": self.explorer.sampled(self, observations, noise)}

    def step(
        self, batch: Batch, noise: Noise | None = None, extra: Extra | None = None, eager: bool = False
    ) -> dict[str, torch.Tensor]:
        """
        Draw the noise, take one gradient step, and count it; without the work that :meth:`update` does before it.

        :param batch: transitions
        :param noise: random numbers of the step; drawn where it is None. A given noise reproduces a step exactly,
            unless transforms draw for the transitions of ``extra``, always by torch's generator
        :param extra: further transitions for the rule of pessimism
        :param eager: run this step neither compiled nor captured, which leaves the gradients in ``.grad``
        :return: what to log, by name, scalars on the learner's device, computed with the parameters from before
            the update of the module in question
        """
        execution = self._execution or self.prepared_execution()
        batch, noise, extra = self._inputs(batch, noise, extra)
        self._count()
        metrics = execution(self, batch, noise, extra, *self._what_moves(), eager=eager)
        self._td_errors = metrics.pop(TD_ERRORS, None)
        self.gradients_are_stale = not (eager or execution.leaves_gradients)
        batch = self.first_copies(batch)
        for part in self.parts().values():
            metrics.update(logged(part, "after_update", part.after_update(self, batch)))
        return metrics

    def take_drawn_step(self, batch_size: int, n_further: int = 0) -> dict[str, torch.Tensor]:
        """
        Take one gradient step that draws its batch itself (:meth:`draw_from`), and count it: on a GPU one launch,
        drawing included.

        :param batch_size: B
        :param n_further: from the rule of pessimism's ``n_further``
        :return: as in :meth:`step`
        """
        if not self._checked_step:
            # A separate batch, so that a continued training draws the same numbers as an uninterrupted one.
            with torch.random.fork_rng([self.device] if self.device.type == "cuda" else []):
                batch, _, extra = self.drawn_inputs(batch_size, n_further)
            first_step.check_batch("batch", batch)
            first_step.check(self, batch, extra)
            self._checked_step = True
        execution = self._drawing or self.prepared_drawing()
        self._count()
        metrics = execution(self, batch_size, n_further, *self._what_moves())
        self._td_errors = None
        self.gradients_are_stale = not execution.leaves_gradients
        return metrics

    def drawn_inputs(self, batch_size: int, n_further: int = 0) -> tuple[Batch, Noise, Extra | None]:
        """
        Draw the inputs of a gradient step by tensor operations alone.

        :param batch_size: B
        :param n_further: from the rule of pessimism's ``n_further``
        :return: transitions, noise, and further transitions for the rule of pessimism, None for ``n_further=0``
        """
        assert self._store is not None
        batch = Batch.of(self._store.draw(batch_size), self.gamma)
        extra = None
        if n_further > 0:
            extra = self.pessimism_rule.draw(StoreSource(self._store, n_further, self.gamma))
        return batch, Noise().completed(batch, extra, self._subset()), extra

    def drawn_step(
        self, batch_size: int, n_further: int, moves_targets: bool, moves_actor: bool
    ) -> dict[str, torch.Tensor]:
        """
        Draw a batch and compute its gradient step: this function is compiled or captured.

        :param batch_size: B
        :param n_further: from the rule of pessimism's ``n_further``
        :param moves_targets: as in :meth:`gradient_step`
        :param moves_actor: as in :meth:`gradient_step`
        :return: as in :meth:`gradient_step`
        """
        batch, noise, extra = self.drawn_inputs(batch_size, n_further)
        return self.gradient_step(batch, noise, extra, moves_targets, moves_actor)

    def why_no_drawn_steps(self) -> str | None:
        """
        Check whether the gradient step can draw its batch itself.

        :return: what needs the batch on the host, in words; None if nothing does
        """
        if self.transforms or self.reward_scaler is not None:
            return "batches are transformed before the gradient step (batch_transforms, reward_scale)"
        rule = type(self.pessimism_rule)
        if rule.draw not in (Pessimism.draw, LearnedPessimism.draw):
            return f"pessimism={rule.__name__} draws further transitions by a method of its own"
        after = [n for n, part in self.parts().items() if type(part).after_update is not Part.after_update]
        return f"{', '.join(after)} looks at the batch after the gradient step" if after else None

    def _subset(self) -> tuple[int, int] | None:
        return None if self.target_subset is None else (self.target_subset, self.critic.n_critics)

    def _count(self) -> None:
        self._counts._n_updates += 1
        if self.schedule is not None:
            self._set_scheduled_rates(self.schedule)

    def _inputs(self, batch: Batch, noise: Noise | None, extra: Extra | None) -> tuple[Batch, Noise, Extra | None]:
        """The gradient step's inputs, transformed, complete and, the first time, checked."""
        if batch.discounts is None:
            batch = batch._replace(discounts=self.gamma)
        if extra is not None and extra.batch.discounts is None:
            extra = extra._replace(batch=extra.batch._replace(discounts=self.gamma))
        if not self._checked_step:
            first_step.check_batch("batch", batch)
        if self.transforms or self.reward_scaler is not None:
            batch, noise, extra = self._transformed(batch, noise, extra)
        noise = (noise or Noise()).completed(batch, extra, self._subset(), (self.target_copies, self.online_copies))
        if not self._checked_step:
            first_step.check(self, self.first_copies(batch), extra)
            self._checked_step = True
        return batch, noise, extra

    def _what_moves(self) -> tuple[bool, bool]:
        """Whether the targets, and whether actors and temperature, are updated in the gradient step just counted."""
        moves_targets = self.n_updates % (self.target_update_interval or self.policy_delay) == 0
        return moves_targets, (self.n_updates - self.actor_at_once) % self.policy_delay == 0

    def _transformed(self, batch: Batch, noise: Noise | None, extra: Extra | None) -> tuple[Batch, Noise, Extra | None]:
        noise = noise or Noise()
        if self.reward_scaler is not None:
            batch = self.reward_scaler.transform(batch, None)
            if extra is not None:
                extra = extra._replace(batch=self.reward_scaler.transform(extra.batch, None))
        if self.has_copies:
            batch = widened(batch, self.target_copies, self.online_copies)
        drawn = noise.transforms or tuple(transform.draw(batch) for transform in self.transforms)
        for transform, numbers in zip(self.transforms, drawn, strict=True):
            before, batch = batch, transform.transform(batch, numbers)
            if not self._checked_step:
                first_step.check_batch(f"what {type(transform).__name__}.transform returns", batch, before)
            if extra is not None:
                extra = extra._replace(batch=transform.transform(extra.batch, transform.draw(extra.batch)))
        return batch, noise._replace(transforms=None), extra

    @property
    def has_copies(self) -> bool:
        """Whether there are several copies of each transition in the critics' step."""
        return self.target_copies > 1 or self.online_copies > 1

    def first_copies(self, batch: Batch) -> Batch:
        """
        Take the first copy of each transition.

        :param batch: transitions, or several copies of each
        :return: B transitions
        """
        return first_copy(batch, len(batch.actions) // self.online_copies) if self.has_copies else batch

    def gradient_step(
        self, batch: Batch, noise: Noise, extra: Extra | None, moves_targets: bool, moves_actor: bool
    ) -> dict[str, torch.Tensor]:
        """
        Compute the gradient step (BRO, algorithm 2), on tensors only: this function is compiled or captured.

        :param batch: transitions, or several copies of each
        :param noise: all random numbers of the step
        :param extra: further transitions for the rule of pessimism
        :param moves_targets: whether the target critics are updated in this step
        :param moves_actor: whether actors and temperature learn in this step
        :return: what to log, by name, scalars
        """
        return gradient_step(self, batch, noise, extra, moves_targets, moves_actor)

    def actor_value(self, q: torch.Tensor) -> torch.Tensor:
        """
        Value of the ensemble in the actor's objective.

        :param q: (E, B, K)
        :return: (B, K)
        """
        if self.actor_pessimism is None:
            return self.pessimism_rule.value(q)
        # A tensor within the step of several learners.
        weight: Any = self.actor_pessimism
        return pessimistic_value(q, weight if isinstance(weight, torch.Tensor) else float(weight))

    def move_target(self, target: Any, online: Any) -> None:
        """
        Take one step of Polyak averaging within the gradient step; with ``tau=1`` the target is the online network.

        :param target: target network
        :param online: its online network
        """
        self.follow(target, online, self.tau)
        with torch.no_grad():
            # Running statistics, as in Stable-Baselines3; a target without its own encoder lacks the encoder's.
            ours, theirs = target.statistics(), online.statistics()
            for own, other in zip(ours, theirs[len(theirs) - len(ours) :], strict=True):
                own.copy_(other)

    @staticmethod
    def follow(target: Any, online: Any, tau: float) -> None:
        """
        Take one step of Polyak averaging of the parameters. A group replaces this method, like :meth:`minimize`.

        :param target: network that follows
        :param online: network that is followed
        :param tau: weight of the online network
        """
        follow(target, online, tau)

    @staticmethod
    def minimize(optimizer: Optimizer, loss: torch.Tensor) -> None:
        """
        Take one step of an optimizer. Only its own parameters get a gradient, even if the loss depends on others.
        A group replaces this method while it takes the step of all its learners.

        :param optimizer: the optimizer
        :param loss: scalar
        """
        minimize(optimizer, loss)

    # ---------------------------------------------------------------- state

    def state_dict(self) -> dict[str, Any]:
        """
        Collect the learner's state.

        :return: everything that later steps depend on, besides the arguments
        """
        state = {name: owner.state_dict() for name, owner in self._owners_of_state().items()}
        counts = {
            "n_updates": self.n_updates,
            "began_at": self._counts._began_at,
            "num_transitions": self.num_transitions,
            "num_task_steps": self._counts.num_task_steps,
            "planned_updates": self.planned_updates,
            "heard": self._heard,
        }
        generators = {} if self._generators is None else {"generators": self._generators.state_dict()}
        return {**state, "counts": counts, **generators}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """
        Restore the learner's state.

        :param state: from ``state_dict`` of a learner with the same arguments
        :raises ValueError: if it has other entries
        """
        own = self.state_dict()
        if own.keys() != state.keys():
            raise ValueError(f"state must have the entries {sorted(own)}, not {sorted(state)}")
        for name, owner in self._owners_of_state().items():
            owner.load_state_dict(state[name])
        counts = state["counts"]
        self._counts._n_updates, self._counts.num_transitions = counts["n_updates"], counts["num_transitions"]
        self._counts.num_task_steps = counts["num_task_steps"]
        # Older states have none.
        self._counts._began_at = counts.get("began_at", 0)
        self.planned_updates, self._heard = counts["planned_updates"], counts["heard"]
        if self._generators is not None:
            self._generators.load_state_dict(state["generators"])

    def _owners_of_state(self) -> dict[str, Any]:
        """Modules and optimizers with a state, in the order in which they are saved and restored."""
        modules = {"networks": self.networks, "temperature": self.temperature, **self.parts_with_state()}
        return {**modules, **self.optimizers()}

    def parts_with_state(self) -> dict[str, nn.Module]:
        """
        List the parts that are saved, with the value head if it has parameters or buffers.

        :return: the parts that are saved, by the path from the learner
        """
        parts: dict[str, nn.Module] = {name: part for name, part in self.parts().items() if part.has_state}
        return {**parts, "head": self.head} if self.head.state_dict() else parts

    # ---------------------------------------------------------------- starting anew

    @with_own_generators
    def reinitialize(self, shrink: float = 0.0, keep: Sequence[str] = (), to: str = "fresh") -> None:
        """
        Start every network, optimizer and learned number anew, in place.

        :param shrink: share of the old parameters that stays
        :param keep: what stays as it is: "encoder" for the critics' encoder and their targets' encoder, with their
            moments and counts of steps in the optimizer
        :param to: "fresh" for new parameters, "start" for the run's own first ones
        :raises ValueError: if ``to`` is neither
        """
        check_value("to", to, one_of(RESETS_TO))
        again = functools.partial(self.plasticity.again, to=to)
        self._counts._began_at = self.n_updates
        fresh = again("networks", self._make_networks)
        encoders: list[nn.Module] = self.networks.encoders() if "encoder" in keep else []
        if encoders:
            for own, other in zip(encoders, fresh.encoders(), strict=True):
                other.load_state_dict(own.state_dict())
        if self.observation_norm is not None:
            # Its statistics describe the replay, which stays.
            fresh.observation_norm.load_state_dict(self.observation_norm.state_dict())
        self.restart(self.networks, fresh, shrink)
        self.restart(self.temperature, again("temperature", lambda: self._make_temperature(self)), shrink)
        # The explorer's start may depend on the pessimism in force.
        self.restart(self.pessimism_rule, again("pessimism", self.make_pessimism), shrink)
        self.restart(self.explorer, again("explorer", self.make_explorer), shrink)
        self.restart(self.objective, again("objective", lambda: self._make_objective(self)), shrink)
        kept: set[Any] = {parameter for encoder in encoders for parameter in encoder.parameters()}
        for optimizer in self.optimizers().values():
            state = {parameter: values for parameter, values in optimizer.state.items() if parameter in kept}
            optimizer.state.clear()
            optimizer.state.update(state)

    @staticmethod
    def restart(module: Any, fresh: Any, shrink: float = 0.0) -> None:
        """
        Give a module the values of a fresh one, in place, and start the optimizers of a part anew. What was frozen
        after it had been made (``requires_grad_(False)``), a pretrained encoder, stays as it is, as do the targets of
        it.

        :param module: the module
        :param fresh: a module of the same kind
        :param shrink: share of the old parameters that stays; above 0 the running moments of batch norms stay whole
        """
        restart(module, fresh, shrink)
