"""
Exchangeable parts of an off-policy learner, and the learner's interface to them.

A part is a ``torch.nn.Module``, so that its networks, learned numbers and buffers move with the learner's device and
are saved with it (``state_dict``; numbers that are not tensors go into ``get_extra_state``). The learner
calls the methods of :class:`Part` at the steps of the environment and at the gradient steps, and those of the part's
own base class (``Pessimism.update``, ``Exploration.update``).
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import nn
from torch.optim import Optimizer

from sb3_sample.learner.batch import Batch


class Rule(Protocol):
    """Interface of a rule of pessimism to the other parts."""

    def beta(self) -> torch.Tensor | float:
        """
        Weight of pessimism.

        :return: the weight in force, at least 0, a number or a scalar tensor without gradient
        """

    def smallest_beta(self) -> float:
        """
        Bound the weight at the start of a training.

        :return: the smallest weight that may be in force then
        """

    def value(self, q: torch.Tensor) -> torch.Tensor:
        """
        Value of the ensemble.

        :param q: (E, B, K)
        :return: (B, K)
        """


class Learning(Protocol):
    """
    Interface of the learner to its parts.

    ``actor``, ``critic`` and ``critic_target`` are the networks; ``has_critic_targets`` says whether TD targets come
    from ``critic_target``, and not from ``critic`` itself. ``temperature()`` is the entropy's weight, a scalar, or
    (n_tasks,) where each task has its own, ``temperature_of(batch)`` the temperature of transitions, ``head`` gives the
    meaning of the critics' outputs, ``gamma`` is the discount factor, ``target_entropy`` the target of the learned
    temperature, ``observation_norm`` the networks' running normalisation, None for none. ``n_updates`` counts gradient
    steps; ``num_transitions`` counts the environments' transitions over the learner's life, of which the first
    ``learning_starts`` have random actions; ``environment_steps`` counts the same for each task, if several tasks take
    a step together.
    """

    @property
    def actor(self) -> Any: ...

    @property
    def critic(self) -> Any: ...

    @property
    def critic_target(self) -> Any: ...

    @property
    def has_critic_targets(self) -> bool: ...

    @property
    def temperature(self) -> Any: ...

    @property
    def pessimism_rule(self) -> Rule: ...

    @property
    def head(self) -> Any: ...

    @property
    def device(self) -> torch.device: ...

    @property
    def gamma(self) -> float: ...

    @property
    def target_entropy(self) -> float | torch.Tensor: ...

    @property
    def observation_norm(self) -> Any: ...

    @property
    def learning_starts(self) -> int: ...

    @property
    def verbose(self) -> int: ...

    @property
    def n_updates(self) -> int: ...

    @property
    def num_transitions(self) -> int: ...

    @property
    def environment_steps(self) -> int: ...

    @property
    def n_envs(self) -> int: ...

    def temperature_of(self, batch: Batch) -> torch.Tensor:
        """
        Look up the temperature of transitions.

        :param batch: transitions
        :return: a scalar, or (B, 1) where each task has its own
        """

    def next_actions(self, observations: Any, noise: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Sample the actions of a TD target.

        :param observations: next observations, (B, O), or a dict of them
        :param noise: standard normal noise, (B, A); drawn if None
        :return: actions of a TD target in [-1, 1], (B, A), and their log-probability, (B, 1)
        """

    def encoded(self, observations: Any) -> Any:
        """
        Encode observations once for actors and critics, if they share an encoder.

        :param observations: (B, O), or a dict of them
        :return: input of actors and critics in place of the observations, without gradient to the encoder; the
            observations themselves if nothing is shared
        """

    def make_actor(self) -> Any:
        """
        Make an actor.

        :return: an actor like the learner's, with its own parameters
        """

    def make_value(self) -> Any:
        """
        Make a value network.

        :return: a network of the critics' kind that evaluates observations alone, (B, O) to (B, 1)
        """

    def actor_value(self, q: torch.Tensor) -> torch.Tensor:
        """
        Value of the ensemble in the actor's objective.

        :param q: (E, B, K)
        :return: (B, K)
        """

    def make_optimizer(self, parameters: Iterable[nn.Parameter]) -> Optimizer:
        """
        Make an optimizer.

        :param parameters: what to optimise
        :return: an optimizer with the settings of actor and critics
        """

    def minimize(self, optimizer: Optimizer, loss: torch.Tensor) -> None:
        """
        Take one step of an optimizer. Only its own parameters get a gradient, even if the loss depends on others.

        :param optimizer: the optimizer
        :param loss: scalar
        """

    def make_explorer(self) -> Any:
        """
        Make an explorer.

        :return: a freshly initialised explorer
        """

    def restart(self, module: nn.Module, fresh: nn.Module, shrink: float = 0.0) -> None:
        """
        Give a module the values of a fresh one, in place, and start the optimizers of a part anew.

        :param module: the module
        :param fresh: a module of the same kind
        :param shrink: share of the old parameters that stays
        """

    def reinitialize(self, shrink: float = 0.0, keep: Sequence[str] = (), to: str = "fresh") -> None:
        """
        Start every network, optimizer and learned number anew, in place.

        :param shrink: share of the old parameters that stays
        :param keep: what stays as it is: "encoder" for the critics' encoder and their targets' encoder
        :param to: "fresh" for new parameters, "start" for the first ones
        """


def logged(part: nn.Module, method: str, metrics: Any) -> dict[str, torch.Tensor]:
    """
    Check the metrics of a part.

    :param part: the part
    :param method: its method that returned them
    :param metrics: the returned metrics
    :return: the same metrics
    :raises ValueError: if they are not a dict of scalar tensors
    """
    if not isinstance(metrics, dict):
        raise ValueError(f"{type(part).__name__}.{method} must return a dict of what to log, not {metrics!r}")
    for name, value in metrics.items():
        if not isinstance(value, torch.Tensor) or value.dim() != 0:
            shown = f"a tensor of shape {tuple(value.shape)}" if isinstance(value, torch.Tensor) else repr(value)
            raise ValueError(f"{type(part).__name__}.{method} must log scalar tensors; {name!r} is {shown}")
    return metrics


class Networks(Protocol):
    """
    Actor, critics and their targets, an ``nn.Module``.

    ``actor.optimizer`` and ``critic.optimizer`` are their optimizers; ``actor_target`` is the actor of the TD targets
    if it is not the actor itself. ``encodes_once`` and ``encodes_next_once`` say whether observations and next
    observations are encoded once for the whole gradient step, by ``features``. ``drawn_from`` is the state of torch's
    generator from which the parameters were drawn.
    """

    drawn_from: torch.Tensor
    encodes_once: bool
    encodes_next_once: bool

    observation_space: Any
    actor: Any
    critic: Any
    critic_target: Any
    actor_target: Any
    observation_norm: Any

    def next_actions(self, obs: Any, noise: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]: ...

    def encoded(self, obs: Any) -> Any: ...

    def features(self, obs: Any) -> torch.Tensor: ...

    def encoders(self) -> Sequence[nn.Module]: ...

    def make_actor(self) -> Any: ...

    def make_value(self) -> Any: ...

    def make_optimizer(self, parameters: Any, learning_rate: float) -> Optimizer: ...

    def set_training_mode(self, mode: bool) -> None: ...

    def state_dict(self) -> Any: ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any: ...


class Part(nn.Module):
    """Part of an off-policy learner; subclasses override what they need."""

    #: Whether it has parameters, numbers or optimizers that are saved.
    has_state: ClassVar[bool] = True
    #: Whether its code in a gradient step can be compiled. A class from outside of this package declares it itself.
    compilable: ClassVar[bool] = True

    def optimizers(self) -> dict[str, Optimizer]:
        """
        List the part's optimizers by the name of the attribute that holds them. The learner saves them and clears their
        state at a reset.
        """
        return {}

    def before_updates(self, learner: Learning) -> None:
        """
        Called before the gradient steps that follow an environment step.

        :param learner: the learner
        """

    def after_update(self, learner: Learning, batch: Batch) -> dict[str, torch.Tensor]:
        """
        Called after every gradient step; not compiled.

        :param learner: the learner
        :param batch: the step's batch
        :return: what to log, by name, scalars
        """
        return {}

    def on_environment_reset(self, learner: Learning) -> None:
        """
        Called when the environments were reset; their episodes so far have no end in the replay buffer.

        :param learner: the learner
        """

    def on_observations(self, learner: Learning, observations: Any) -> None:
        """
        Called before the actions of a training step are chosen, random actions included.

        :param learner: the learner
        :param observations: observations that are acted on, arrays or tensors, (n_envs, O), or a dict of them
        """

    def on_step(self, learner: Learning, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """
        Called when the transitions of one step of all environments are in the replay buffer.

        :param learner: the learner
        :param rewards: unnormalised rewards, (n_envs,)
        :param dones: whether each environment's episode ended, by termination or truncation, (n_envs,)
        :param infos: each environment's info; ``TimeLimit.truncated`` is true at a time limit
        """

    def on_episode_end(self, learner: Learning, env_index: int, episode_return: float) -> None:
        """
        Called when an episode ended, after ``on_step``.

        :param learner: the learner
        :param env_index: the environment whose episode ended
        :param episode_return: undiscounted, unnormalised return
        """
