"""Plasticity: resets and recycling of neurons, which keep the networks able to learn."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from torch import nn

from sb3_sample.console import say
from sb3_sample.kinds import check_value, is_integer, one_of
from sb3_sample.learner.batch import Batch
from sb3_sample.learner.execution import CAPTURING
from sb3_sample.learner.parts import Learning, Part
from sb3_sample.learner.randomness import checked_state
from sb3_sample.networks.batch_norm import running_moments
from sb3_sample.networks.dormant import recycle
from sb3_sample.networks.network import Network
from sb3_sample.networks.unit_norm import project_weights

T = TypeVar("T")

#: Destinations of a reset: newly drawn parameters, or the first ones.
RESETS_TO = ("fresh", "start")


class Resets(Part):
    """
    Full-parameter resets (BRO, section 2.2; Nikishin et al. 2022): every network, optimizer and learned number
    starts anew, the replay buffer stays.

    With ``shrink`` above 0 it is shrink and perturb (Ash and Adams 2020, in the form of D'Oro et al. 2022): every
    parameter becomes ``shrink * old + (1 - shrink) * fresh``, target networks and learned numbers (on the scale on
    which they are learned, that of the logarithm for a temperature) included; the optimizers start anew.

    Steps are counted in transitions over the model's life (for each task, if several tasks take a step together), with
    the warm-up and independently of ``num_timesteps``, which ``learn`` sets to zero; the reset happens at the first
    update at or after the step. The step reached is saved with the model, so that a loaded one does not reset again.

    With ``gradient_steps`` the resets are counted in gradient steps instead, over the model's life too (D'Oro et al.
    2022: every 2,560,000). The reset comes just before the gradient step that follows each such number of them, so that
    networks that have learned nothing neither act nor are saved.

    New parameters are drawn; with ``to="start"``, as in BRO's published code, the run's first parameters are drawn
    again, from the states of torch's generator that they came from, which are saved with the model.

    :param steps: transitions at which to reset, above 0, strictly ascending; an integer: a reset every so many; none by
        default
    :param shrink: share of the old parameters that stays, in [0, 1)
    :param gradient_steps: gradient steps between two resets; None for none
    :param keep: what stays as it is, "encoder" for an encoder that the critics share with the actors (Nikishin et al.
        2022, whose resets from pixels leave the convolutions)
    :param to: "fresh" for new parameters, "start" for the run's own first ones
    :raises ValueError: if the steps are not positive integers in ascending order, or another argument is out of range
    """

    def __init__(
        self,
        steps: Sequence[int] | int = (),
        shrink: float = 0.0,
        gradient_steps: int | None = None,
        keep: Sequence[str] = (),
        to: str = "fresh",
    ):
        super().__init__()
        check_value("resets_to", to, one_of(RESETS_TO))
        if not 0 <= shrink < 1:
            raise ValueError(f"reset_shrink must lie in [0, 1), not {shrink}")
        if gradient_steps is not None and (not is_integer(gradient_steps) or gradient_steps < 1):
            raise ValueError(
                f"reset_gradient_steps must be an integer of at least 1, or None for no such resets, not "
                f"{gradient_steps!r}"
            )
        self.shrink, self.gradient_steps, self.keep, self.returns_to = shrink, gradient_steps, tuple(keep), to
        #: State of torch's generator from which each part of the learner was first drawn, by the part's name; None if
        #: it draws nothing.
        self.starts: dict[str, torch.Tensor | None] = {}
        self.period: int | None = None
        self.steps: tuple[int, ...] = ()
        self.n_done = 0
        self._reached = 0
        if is_integer(steps):
            self.period = int(steps)
            if self.period < 1:
                raise ValueError(f"resets must be at least 1 environment step apart, not {steps}")
            return
        if not isinstance(steps, (Sequence, np.ndarray)) or not all(is_integer(step) and step >= 1 for step in steps):
            raise ValueError(
                "resets must be a sequence of environment steps, integers of at least 1, or one integer for every so "
                f"many, not {steps!r}"
            )
        self.steps = tuple(steps)
        if any(late <= early for early, late in itertools.pairwise(self.steps)):
            raise ValueError(f"resets must be strictly ascending environment steps, not {self.steps}")

    def before_updates(self, learner: Learning) -> None:
        now, due = learner.environment_steps, self.follows_environment_steps(learner)
        self._reached = now
        if due:
            self._reset(learner, f"at {now} environment steps")

    def follows_environment_steps(self, learner: Learning) -> bool:
        """
        Foresee the reset of :meth:`before_updates`.

        :param learner: the learner
        :return: whether a reset is due after the environment steps taken so far
        """
        now = learner.environment_steps
        if self.period is None:
            return any(self._reached < step <= now for step in self.steps)
        return now // self.period > self._reached // self.period

    def follows_gradient_steps(self, learner: Learning) -> bool:
        """
        Foresee the reset of :meth:`before_gradient_steps`.

        :param learner: the learner
        :return: whether a reset is due after the gradient steps taken so far
        """
        taken = learner.n_updates
        return self.gradient_steps is not None and taken > 0 and taken % self.gradient_steps == 0

    def before_gradient_steps(self, learner: Learning, n: int) -> int:
        """
        Reset now, if a reset is due after the gradient steps taken so far.

        :param learner: the learner
        :param n: gradient steps that are to be taken, at least 1
        :return: how many of them may be taken before this is called again
        """
        if self.gradient_steps is None:
            return n
        taken = learner.n_updates
        if self.follows_gradient_steps(learner):
            self._reset(learner, f"after {taken} gradient steps")
        return min(n, self.gradient_steps - taken % self.gradient_steps)

    def first(self, name: str, make: Callable[[], T]) -> T:
        """
        :param name: name of a part of the learner
        :param make: makes it
        :return: the part that the run begins with
        """
        before = torch.get_rng_state()
        made = make()
        self.starts[name] = None if torch.equal(before, torch.get_rng_state()) else before
        return made

    def again(self, name: str, make: Callable[[], T], to: str) -> T:
        """
        :param name: name of a part of the learner
        :param make: makes it
        :param to: "fresh" or "start"
        :return: the part that a reset begins with
        """
        start = None if to == "fresh" else self.starts[name]
        if start is None:
            return make()
        # Parameters are drawn on the CPU, wherever they are moved afterwards. The lock keeps the acting thread of
        # asynchronous learning, which draws from the same generator, from drawing in between.
        with CAPTURING, torch.random.fork_rng(devices=[]):
            torch.set_rng_state(start)
            return make()

    def _reset(self, learner: Learning, when: str) -> None:
        learner.reinitialize(self.shrink, self.keep, self.returns_to)
        self.n_done += 1
        if learner.verbose >= 1:
            kept = f" but the {', '.join(self.keep)}," if self.keep else ""
            first = ", to the first ones of the run" if self.returns_to == "start" else ""
            say(f"Reset of all parameters{kept} {when}{first}")

    def get_extra_state(self) -> dict[str, Any]:
        return {"reached": self._reached, "n_done": self.n_done, "starts": self.starts}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._reached, self.n_done = state["reached"], state["n_done"]
        self.starts = {
            name: None if start is None else checked_state(start, f"what {name} came from")
            for name, start in state["starts"].items()
        }


def frozen_since(module: nn.Module, fresh: nn.Module) -> set[str]:
    """
    Find what a reset leaves as it is.

    :param module: a module
    :param fresh: one of its kind
    :return: names in the module's state of parameters that the fresh one trains and it does not, of the buffers of
        modules with no others, such as the moments of batch norms, and of the same in target networks
    """
    trained = {name for name, parameter in fresh.named_parameters() if parameter.requires_grad}
    frozen = {name for name, parameter in module.named_parameters() if name in trained and not parameter.requires_grad}
    for path, part in module.named_modules() if frozen else ():
        before = f"{path}." if path else ""
        names = {before + name for name, _ in part.named_parameters()}
        if names and names <= frozen:
            frozen |= {before + name for name, _ in part.named_buffers()}
    of_targets = (f"{network}_target.{rest}" for network, _, rest in (name.partition(".") for name in frozen))
    return frozen.union(of_targets)


def restart(module: nn.Module, fresh: nn.Module, shrink: float = 0.0) -> None:
    """
    Give a module the values of a fresh one, in place, and start the optimizers of a part anew; see
    :meth:`~sb3_sample.learner.learner.Learner.restart`.

    :param module: the module
    :param fresh: a module of the same kind
    :param shrink: share of the old parameters that stays
    """
    state = fresh.state_dict()
    if shrink > 0:
        for name, parameter in module.named_parameters():
            state[name] = torch.lerp(state[name].to(parameter.device), parameter.detach(), shrink)
        # Fresh moments would fit neither the old network nor the mixed one.
        state.update({name: moment for name, moment in running_moments(module) if name in state})
    if frozen := frozen_since(module, fresh):
        state.update({name: value for name, value in module.state_dict().items() if name in frozen})
    module.load_state_dict(state)
    if shrink > 0:
        project_weights(module)
        # Quantities computed from the weights, such as the directions of spectral norms, are refreshed.
        for network in module.modules():
            if isinstance(network, Network):
                network.refresh()
    if isinstance(module, Part):
        for optimizer in module.optimizers().values():
            optimizer.state.clear()


class ReDo(Part):
    """
    Recycling of dormant neurons (Sokar et al. 2023, algorithm 1) in the critics: every ``period`` gradient steps,
    hidden neurons whose score on a batch is at most ``threshold`` get fresh incoming and zero outgoing weights. The
    score is the mean absolute activation divided by that of the layer's average neuron, for each critic separately.

    The targets keep their weights and follow by Polyak averaging, as after any other step.

    :param period: gradient steps between two recyclings; 1,000 as in the original for DQN
    :param threshold: score up to which a neuron is dormant; 0.025 as in the original at the default replay ratio
    :raises ValueError: if an argument is out of range
    """

    has_state = False

    def __init__(self, period: int = 1_000, threshold: float = 0.025):
        super().__init__()
        if not is_integer(period) or period < 1:
            raise ValueError(f"redo_period must be an integer of at least 1, or None for no recycling, not {period!r}")
        if not threshold >= 0:
            raise ValueError(f"redo_threshold must be at least 0, not {threshold}")
        self.period, self.threshold = period, threshold

    def check(self, learner: Learning) -> None:
        """
        Check that there is something to recycle.

        :param learner: the learner, its networks built
        :raises ValueError: if the critics' network lists no neurons that can be recycled
        """
        trunk = learner.critic.trunk
        listed = trunk.hidden_units(learner.critic.head)
        if not listed:
            raise ValueError(
                f"redo_period={self.period} recycles hidden neurons that a network lists in hidden_units(head), and "
                f"{type(trunk).__name__} lists none: define it, or leave redo_period out"
            )
        if all(units.outgoing is None for units in listed):
            raise ValueError(
                f"redo_period={self.period} recycles hidden neurons, and no neuron of {type(trunk).__name__} can be "
                "recycled: weights have unit norm, or a norm stands before the next layer (hidden_units(head) lists no "
                "outgoing layer). Leave redo_period out"
            )

    def after_update(self, learner: Learning, batch: Batch) -> dict[str, torch.Tensor]:
        if learner.n_updates % self.period:
            return {}
        with torch.no_grad():
            inputs = learner.critic.inputs(batch.observations, batch.actions)
            critic = learner.critic
            return {
                "plasticity/n_recycled": recycle(critic.trunk, critic.head, inputs, self.threshold, critic.optimizer)
            }
