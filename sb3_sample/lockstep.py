"""
Trainings of one process in lockstep: each in its own thread, of which exactly one runs at any time.

A training runs until it reaches a meeting. When all have reached one, the meeting's work is done for all of them, and
they continue one after the other, always in the same order. Callbacks, evaluations, logs and checkpoints are therefore
those of a training alone; only the work done together involves several trainings. The generators of the process (torch,
CUDA, NumPy, Python) are exchanged with the thread, so that each training draws the same numbers as alone with its seed.
"""

import copy
import os
import random
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from numpy.random import mtrand

#: Meetings: all models are made; all trainings are about to begin; then actions, a step of the environments, and
#: gradient steps.
MADE, BEGIN, ACTIONS, ENVIRONMENTS, GRADIENT_STEP = "made", "begin", "actions", "environments", "gradient step"
#: Further states of a training.
_READY, _ENDED = "ready", "ended"
#: Seconds that trainings have to end by themselves when all must leave at once.
PATIENCE = 30.0
_HERE = threading.local()


class LeftWithTheOthers(BaseException):
    """Raised in a training that ends because another one of its group has failed."""


class Joint(Protocol):
    """Gradient steps, and actions, of several learners as one."""

    @property
    def seconds_compiling(self) -> float:
        """Seconds spent on compiling."""

    def step(self, inputs: Sequence[tuple[Any, ...]]) -> list[dict[str, torch.Tensor]]:
        """
        Take one gradient step of each learner.

        :param inputs: the arguments of ``Learner.gradient_step``, a tuple per learner, in their order
        :return: the result of each learner
        """

    def act(self, inputs: Sequence[tuple[Any, ...]]) -> list[dict[str, torch.Tensor]]:
        """
        Compute the actions of each learner.

        :param inputs: the arguments of ``Learner.action_step``, a tuple per learner, in their order
        :return: the result of each learner
        """

    def release(self) -> None:
        """Give each learner its own tensors again."""


#: Function that combines the gradient steps and actions of several learners; None if each has its own.
MakeJoint = Callable[[Sequence[Any]], Joint | None]


def present() -> "Seat | None":
    """
    :return: place of the training that this thread runs in its group; None in any other thread
    """
    return getattr(_HERE, "seat", None)


def seat_of(model: Any) -> "Seat | None":
    """
    :param model: a model
    :return: its place in a group, if this thread runs its ``learn`` there; None for any other model
    """
    seat = present()
    return seat if seat is not None and seat.model is model else None


class Seat:
    """
    Place of one training in a group.

    :param name: name in messages
    :param body: function that runs the whole training
    :param folder: folder of its run, if known beforehand
    """

    def __init__(self, name: str, body: Callable[[], None], folder: Path | None = None):
        self.name, self.body = name, body
        # Absolute, as the runs themselves name their folders.
        self.folder = None if folder is None else Path(os.path.abspath(folder))
        #: Called each time that it is this training's turn.
        self.on_turn: Callable[[], None] = lambda: None
        self.at = _READY
        self.turn = threading.Lock()
        self.turn.acquire()
        self.generators = Generators()
        self.group: Group
        #: The model whose ``learn`` takes part, and its learner, once they are made.
        self.model: Any = None
        self.learner: Any = None
        #: Whether its ``learn`` is under way, from the common beginning on.
        self.takes_part = False
        #: Whether its ``learn`` ever was under way.
        self.began = False
        #: Whether it saves checkpoints.
        self.saves = False
        #: Whether its checkpoints are at the same steps as the others'.
        self.aligned = True
        #: Whether it is at another point of its training than the others, and takes its gradient steps by itself.
        self.alone = False
        #: Environment steps at the end of its latest turn.
        self.turned: int | None = None
        self.inputs: tuple[Any, ...] | None = None
        self.answer: dict[str, torch.Tensor] | None = None
        self.error: BaseException | None = None

    @property
    def has_ended(self) -> bool:
        """Whether its body has returned, or raised an error."""
        return self.at is _ENDED

    @property
    def with_others(self) -> bool:
        """Whether it takes gradient steps with others."""
        return self.takes_part and not self.alone

    def meet(self, meeting: str) -> None:
        """
        Wait until the others have reached a meeting too, and its work is done.

        :param meeting: one of the five
        :raises LeftWithTheOthers: another training has failed
        :raises KeyboardInterrupt: the process is to end at once, as by a second Ctrl-C; a ``SystemExit`` likewise
        """
        self.at = meeting
        self.group.pass_on(self)
        stop = self.group.stop
        if isinstance(stop, (KeyboardInterrupt, SystemExit)):
            raise type(stop)(*stop.args)
        if stop is not None or (self.group.failed and not (self.saves and self.takes_part)):
            raise LeftWithTheOthers(f"ended with the others of its group: {stop!r}" if stop else "") from stop

    def together(self, meeting: str, inputs: tuple[Any, ...]) -> dict[str, torch.Tensor] | None:
        """
        Take a gradient step, or compute actions, with the others.

        :param meeting: which of the two
        :param inputs: the arguments of ``Learner.gradient_step``, or ``action_step``
        :return: the result; None if there are no others, or their inputs are of another kind, so that the work has
            still to be done
        """
        if len(self.group.stepping()) < 2:
            return None
        self.inputs = inputs
        self.meet(meeting)
        self.inputs, answer, self.answer = None, self.answer, None
        return answer

    def folders_beside(self) -> list[Path]:
        """
        :return: folders of the runs that are to be continued from the same step as this one
        """
        if not (self.aligned and self.with_others):
            return []
        others = (seat for seat in self.group.seats if seat is not self and seat.aligned and seat.with_others)
        return [seat.folder for seat in others if seat.folder is not None]

    def leaves(self, now: int) -> bool:
        """
        Decide at the end of a turn whether the training is to be saved and ended. All trainings that are equally far
        leave at the end of the same turn, so that their checkpoints are of the same step.

        :param now: environment steps
        :return: whether it is to be saved and ended
        """
        self.turned = now
        group = self.group
        if group.received() is None and not group.failed:
            return False
        if self.alone or not self.aligned:
            return True
        if group.leaves_at is None:
            # A training that has already ended this turn continues to the end of the next one.
            others = [seat.turned for seat in group.seats if seat is not self and seat.with_others and seat.aligned]
            group.leaves_at = max([now, *(steps + 1 for steps in others if steps is not None)])
        return now >= group.leaves_at


class Group:
    """
    Trainings in lockstep.

    :param seats: their places, in their order
    :param make_joint: function that combines their gradient steps
    :param received: returns the signal by which the process was asked to end; None for none
    """

    def __init__(self, seats: Sequence[Seat], make_joint: MakeJoint, received: Callable[[], int | None] = lambda: None):
        self.seats, self._make_joint, self.received = list(seats), make_joint, received
        for seat in self.seats:
            seat.group = self
        #: Error that ends every training at its next meeting.
        self.stop: BaseException | None = None
        #: Trainings that have ended by an error; the others then end as soon as they are saved.
        self.failed: list[Seat] = []
        #: Environment steps at which all leave.
        self.leaves_at: int | None = None
        #: Checkpoints from which the runs resume (``run_folder.Starts``); None until known.
        self.starts: Any = None
        self._joint: Joint | None = None
        self._over = threading.Event()
        # The current GPU of the thread that starts the trainings; None before CUDA is used.
        self._gpu: int | None = None

    # ---------------------------------------------------------------- the whole

    def run(self) -> None:
        """
        Run the trainings. The errors by which they ended are stored at their places.

        :raises BaseException: what is raised in this thread meanwhile, as by Ctrl-C; or what kept all of them from
            being made together
        """
        before = Generators()
        before.take()
        self._gpu = torch.cuda.current_device() if torch.cuda.is_initialized() else None
        threads = [threading.Thread(target=self._make, args=(seat,), daemon=True) for seat in self.seats]
        for thread in threads:
            thread.start()
        try:
            self.seats[0].turn.release()
            while not self._over.wait(1.0):
                pass
        except BaseException as error:
            self.stop = error
            # After a first signal the trainings may save what they have learned, however long it takes; another one
            # ends this too. Where signals are noted, the error is that of the second.
            may_save = isinstance(error, (KeyboardInterrupt, SystemExit)) and self.received() is None
            while not self._over.wait(1.0 if may_save else PATIENCE) and may_save:
                pass
            raise
        finally:
            before.put_back()
        if self.stop is not None:
            raise self.stop

    def _make(self, seat: Seat) -> None:
        seat.turn.acquire()
        _HERE.seat = seat
        try:
            if self._gpu is not None:
                # A new thread begins with the first GPU.
                torch.cuda.set_device(self._gpu)
            seat.generators.put_back()
            if self.stop is None and not self.failed:
                seat.body()
        except BaseException as error:
            seat.error = error
            if isinstance(error, Exception):
                self.failed.append(seat)
        seat.at = _ENDED
        try:
            self.leave(seat)
        except Exception as error:
            self.stop = error
        following = self._following()
        if following is None:
            self._over.set()
        else:
            following.turn.release()

    # ---------------------------------------------------------------- taking turns

    def pass_on(self, seat: Seat) -> None:
        """
        Hand the turn to the next training, and wait until it is this one's turn again.

        :param seat: place of the training whose turn is over; it continues when this returns
        """
        following = self._following()
        assert following is not None
        if following is seat:
            return
        seat.generators.take()
        following.turn.release()
        seat.turn.acquire()
        seat.generators.put_back()
        seat.on_turn()

    def _following(self) -> Seat | None:
        """Place of the training whose turn is next; None when all have ended."""
        while True:
            there = [seat for seat in self.seats if seat.at is not _ENDED]
            if not there:
                return None
            for seat in there:
                if seat.at is _READY:
                    return seat
            self._hold(there)

    def _hold(self, there: list[Seat]) -> None:
        """Hold a meeting that all trainings it needs have reached. All wait at a meeting."""
        try:
            stepping = self.stepping()
            if stepping and all(seat.at is GRADIENT_STEP for seat in stepping):
                # Trainings at other meetings continue too, so that neither they nor these steps wait for the other for
                # ever.
                self._do_together(stepping, GRADIENT_STEP)
                ready = there
            elif acting := [seat for seat in there if seat.at is ACTIONS]:
                # Before the environments' step. If not all act (one may act at random), each computes its actions
                # alone.
                if acting == stepping:
                    self._do_together(stepping, ACTIONS)
                ready = acting
            elif any(seat.at is ENVIRONMENTS for seat in there):
                # First: a learner at a gradient step waits for those that have still to reach one.
                ready = [seat for seat in there if seat.at is ENVIRONMENTS]
            else:
                ready = there
                if all(seat.at is MADE for seat in there):
                    joint = self._joint_of(there)
                    if joint is not None:
                        joint.release()
                elif all(seat.at is BEGIN for seat in there):
                    for seat in there:
                        seat.takes_part = seat.began = True
                    self._joint = self._joint_of(self.stepping())
        except Exception as error:
            self.stop, ready = error, there
        for seat in ready:
            seat.at = _READY

    # ---------------------------------------------------------------- gradient steps and actions

    def stepping(self) -> list[Seat]:
        """
        :return: places of the trainings that take gradient steps together
        """
        return [seat for seat in self.seats if seat.with_others]

    def _joint_of(self, seats: list[Seat]) -> Joint | None:
        return self._make_joint([seat.learner for seat in seats]) if len(seats) > 1 else None

    def _do_together(self, seats: list[Seat], what: str) -> None:
        if self._joint is None:
            self._joint = self._joint_of(seats)
        if self._joint is None:
            return
        inputs = [seat.inputs or () for seat in seats]
        if not all(_are_alike(inputs[0], each) for each in inputs):
            return
        answers = (self._joint.step if what is GRADIENT_STEP else self._joint.act)(inputs)
        for seat, answer in zip(seats, answers, strict=True):
            seat.answer = answer

    @property
    def steps_together(self) -> bool:
        """Whether gradient steps are taken together at present."""
        return self._joint is not None

    @property
    def seconds_compiling(self) -> float:
        """Seconds spent on compiling the gradient steps of all."""
        return 0.0 if self._joint is None else self._joint.seconds_compiling

    def part(self) -> None:
        """Give each learner its own tensors again; the next gradient step together combines them anew."""
        joint, self._joint = self._joint, None
        if joint is not None:
            joint.release()

    def leave(self, seat: Seat) -> None:
        """
        Let a training continue by itself.

        :param seat: its place
        """
        if seat.with_others:
            self.part()
        seat.takes_part = False


def _are_alike(a: Any, b: Any) -> bool:
    """Whether two learners' inputs differ in numbers only, not in further transitions or an update of the targets."""
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.shape == b.shape
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_are_alike(a[key], b[key]) for key in a)
    if isinstance(a, tuple):
        return isinstance(b, tuple) and len(a) == len(b) and all(map(_are_alike, a, b))
    return are_real((a, b)) or (type(a) is type(b) and a == b)


def are_real(values: Sequence[Any]) -> bool:
    """
    Distinguish real numbers, in which learners may differ, from counts and words.

    :param values: values of learners
    :return: whether they are numbers, of which at least one is a float
    """
    floats = [isinstance(value, float) for value in values]
    return any(floats) and all(is_float or type(value) is int for is_float, value in zip(floats, values, strict=True))


# ---------------------------------------------------------------- generators


class Generators:
    """States of a process's global generators (torch's, NumPy's, Python's) at construction."""

    def __init__(self) -> None:
        self._numpy = copy.deepcopy(mtrand.get_bit_generator())
        self.take(numpy_too=False)

    def take(self, numpy_too: bool = True) -> None:
        """
        Take the states as they are now.

        :param numpy_too: whether to take NumPy's too, an object that keeps its state when it is exchanged
        """
        self._torch, self._python = torch.get_rng_state(), random.getstate()
        self._cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else None
        if numpy_too:
            self._numpy = mtrand.get_bit_generator()
        self._gauss = _spare_gauss()

    def put_back(self) -> None:
        """Restore the states."""
        torch.set_rng_state(self._torch)
        random.setstate(self._python)
        if self._cuda is not None:
            torch.cuda.set_rng_state_all(self._cuda)
        mtrand.set_bit_generator(self._numpy)
        _set_spare_gauss(self._gauss)


class _NoBits:
    """
    Bit generator without a state. With it in place, NumPy's global generator returns what it keeps beside the bit
    generator, a spare normal number, in a microsecond; with its own 624 words that takes 200.
    """

    def __init__(self) -> None:
        self.state = {"bit_generator": "MT19937", "state": {}}


def _spare_gauss() -> dict[str, Any]:
    generator: Any = mtrand._rand
    bits, generator._bit_generator = generator._bit_generator, _NoBits()
    try:
        return generator.get_state(legacy=False)  # type: ignore[no-any-return]
    finally:
        generator._bit_generator = bits


def _set_spare_gauss(state: dict[str, Any]) -> None:
    generator: Any = mtrand._rand
    bits, generator._bit_generator = generator._bit_generator, _NoBits()
    try:
        generator.set_state(state)
    finally:
        generator._bit_generator = bits
