"""Participation of ``learn`` in a group of trainings in lockstep (:mod:`sb3_sample.lockstep`)."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_sample.learner.execution import Acting, Execution, Metrics, acting_of
from sb3_sample.learner.exploration import Exploration
from sb3_sample.learner.group import LearnerGroup
from sb3_sample.learner.learner import Learner
from sb3_sample.lockstep import ACTIONS, BEGIN, ENVIRONMENTS, GRADIENT_STEP, MADE, Joint, Seat, present, seat_of


def joint_of(learners: Sequence[Learner]) -> Joint | None:
    """
    Decide how several learners take their gradient steps.

    :param learners: the learners, whose models are made
    :return: object that takes one step of each at once; None if each takes its own, one after the other
    :raises ValueError: if something of theirs cannot be batched, or differs that must not; the message names it
    """
    # On a CPU, one process per core is faster (docs/many_learners.md).
    return LearnerGroup(learners) if learners[0].device.type == "cuda" else None


class Member:
    """
    Execution of the gradient steps of a learner that takes them together with others; see ``Execution``.

    :param seat: place of its training
    :param learner: the learner
    :param method: name of its method that is run
    """

    def __init__(self, seat: Seat, learner: Learner, method: str = "gradient_step"):
        self._seat, self._own = seat, Execution.of(learner, method)

    @classmethod
    def of(cls, seat: Seat, learner: Learner, method: str = "gradient_step") -> "Member | Execution":
        """
        Choose how the steps are run.

        :param seat: place of its training
        :param learner: the learner
        :param method: name of its method that is run
        :return: what runs its steps
        """
        if method not in ("gradient_step", "drawn_step") or not seat.with_others:
            return Execution.of(learner, method)
        return cls(seat, learner, method)

    @property
    def compiled(self) -> bool:
        """Whether the step is compiled."""
        return self._own.compiled

    @property
    def seconds_compiling(self) -> float:
        """Seconds spent on compiling, of all learners together."""
        return self._own.seconds_compiling + self._seat.group.seconds_compiling

    @property
    def leaves_gradients(self) -> bool:
        """Whether a step that is not called as eager leaves its gradients in ``.grad``."""
        return not self._seat.group.steps_together and self._own.leaves_gradients

    def serves(self, learner: Learner) -> bool:
        """
        Check that the step still belongs to the learner.

        :param learner: the learner
        :return: whether it still has the networks, parts, optimizers and loss that this was made for
        """
        serves = self._own.serves(learner)
        if not serves:
            self._seat.group.part()
        return serves

    def prepare(self, learner: Learner) -> None:
        """
        Prepare optimizers and captured steps.

        :param learner: the learner
        """
        if not self._seat.group.steps_together:
            self._own.prepare(learner)

    def __call__(self, learner: Learner, *inputs: Any, eager: bool = False) -> dict[str, torch.Tensor]:
        """
        Run one gradient step.

        :param learner: the learner
        :param inputs: the arguments of ``Learner.gradient_step``
        :param eager: whether to run it alone, neither compiled nor captured this time, which leaves the gradients in
            ``.grad``
        :return: its result
        """
        answer = None if eager else self._seat.together(GRADIENT_STEP, inputs)
        if answer is None:
            self._own.prepare(learner)
            answer = self._own(learner, *inputs, eager=eager)
        return answer


def _acting_of(seat: Seat, learner: Learner) -> Acting | None:
    """Computation of a learner's actions together with those of others; None for an explorer's own ``act``."""
    explorer = learner.explorer
    if type(explorer).act is not Exploration.act or not explorer.can_be_mapped or not seat.with_others:
        return acting_of(learner)
    own = acting_of(learner) or (lambda learner, inputs: learner.action_step(*inputs))

    def act(learner: Learner, inputs: tuple[Any, ...]) -> Metrics:
        # If gradient steps are taken separately, actions are computed separately.
        answer = seat.together(ACTIONS, inputs) if seat.group.steps_together else None
        return own(learner, inputs) if answer is None else answer

    return act


def all_made(model: Any) -> None:
    """
    Wait in a group until the models of all its trainings are made, and check whether their gradient steps can be taken
    together. Without a group nothing happens.

    :param model: this training's model
    :raises LeftWithTheOthers: a model could not be made, or they cannot
    """
    seat = present()
    if seat is not None:
        seat.model, seat.learner, seat.aligned = model, model.learner, _is_aligned(model)
        seat.meet(MADE)
        # Turns of different lengths have no steps in common either.
        lengths = {each.model.train_freq for each in seat.group.seats if each.model is not None}
        seat.aligned = seat.aligned and len(lengths) == 1


def _is_aligned(model: Any) -> bool:
    """Whether its turns end at the same environment steps as those of other seeds."""
    train_freq = model.train_freq
    return not (isinstance(train_freq, TrainFreq) and train_freq.unit is TrainFrequencyUnit.EPISODE)


@contextlib.contextmanager
def seated(model: Any) -> Iterator[Seat | None]:
    """
    Make a ``learn`` part of this thread's group, if it is in one: the environments of all trainings step together.

    :param model: the model, set up for ``learn``
    :return: its place; None if it trains alone, or within another training
    """
    seat = seat_of(model)
    if seat is None:
        yield None
        return
    innermost = model.env.unwrapped
    wait = innermost.step_wait

    def step_wait() -> Any:
        # Environments in processes of their own are already stepping.
        seat.meet(ENVIRONMENTS)
        return wait()

    innermost.step_wait = step_wait
    try:
        yield seat
    finally:
        innermost.step_wait = wait
        seat.group.leave(seat)
        if model.learner.make_execution != Execution.of:
            model.learner.make_execution, model.learner.make_acting = Execution.of, acting_of
            model.learner.forget_execution()


def begin(seat: Seat | None) -> None:
    """
    Begin the turns of a training, all of a group together.

    :param seat: its place; None if it trains alone
    """
    if seat is None:
        return
    seat.meet(BEGIN)
    if seat.group.steps_together:
        seat.learner.make_execution = lambda learner, method: Member.of(seat, learner, method)
        seat.learner.make_acting = lambda learner: _acting_of(seat, learner)
        seat.learner.forget_execution()
