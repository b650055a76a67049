"""Trainings in lockstep: turns, meetings, the generators of the process."""

import os
import random
import signal
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch

from sb3_sample import lockstep
from sb3_sample.lockstep import (
    ACTIONS,
    BEGIN,
    ENVIRONMENTS,
    GRADIENT_STEP,
    MADE,
    Group,
    LeftWithTheOthers,
    Seat,
    _are_alike,
    present,
)


class Sum:
    """Takes "steps together": gives each training the sum of what all have given."""

    def __init__(self, learners: Sequence[Any]):
        self.learners, self.seconds_compiling = list(learners), 0.0
        MADE_OF.append(list(learners))

    def step(self, inputs: Sequence[tuple[Any, ...]]) -> list[dict[str, Any]]:
        return [{"sum": sum(each[0] for each in inputs)} for _ in inputs]

    def act(self, inputs: Sequence[tuple[Any, ...]]) -> list[dict[str, Any]]:
        return [{"largest": max(each[0] for each in inputs)} for _ in inputs]

    def release(self) -> None:
        pass


MADE_OF: list[list[Any]] = []


def group(*bodies: Callable[[Seat], None], joint: Any = lambda learners: None, **kwargs: Any) -> Group:
    seats = [Seat(str(i), lambda body=body: body(present())) for i, body in enumerate(bodies)]  # type: ignore[misc]
    for i, seat in enumerate(seats):
        seat.learner = i
    return Group(seats, joint, **kwargs)


def draw() -> tuple[float, ...]:
    """An odd number of normal numbers, of which NumPy and Python make two at once."""
    # The legacy generator is what is meant.
    return random.gauss(0, 1), random.random(), np.random.normal(), float(torch.randn(())), np.random.rand()


def seed(number: int) -> None:
    random.seed(number)
    np.random.seed(number)
    torch.manual_seed(number)


def test_each_draws_what_it_draws_alone() -> None:
    drawn: dict[int, list[Any]] = {0: [], 1: [], 2: []}

    def body(seat: Seat) -> None:
        seed(int(seat.name))
        for _ in range(5):
            drawn[int(seat.name)].append(draw())
            seat.meet(ENVIRONMENTS)

    seed(7)
    draw()
    state = random.getstate(), torch.get_rng_state(), np.random.mtrand.get_bit_generator()
    group(body, body, body).run()
    assert state[0] == random.getstate()
    assert torch.equal(state[1], torch.get_rng_state())
    assert state[2] is np.random.mtrand.get_bit_generator()
    after = draw()
    seed(7)
    draw()
    assert after == draw()
    for i, own in drawn.items():
        seed(i)
        assert own == [draw() for _ in range(5)]


def test_one_at_a_time_and_always_in_the_same_order() -> None:
    running: list[str] = []
    said: list[str] = []

    def body(seat: Seat) -> None:
        for i in range(20):
            assert not running
            running.append(seat.name)
            said.append(f"{i}{seat.name}")
            running.clear()
            seat.meet(ENVIRONMENTS)

    group(body, body, body).run()
    assert said == [f"{i}{name}" for i in range(20) for name in "012"]
    assert present() is None


def test_gradient_steps_of_unequal_numbers_wait_for_nobody_for_ever() -> None:
    sums: dict[str, list[Any]] = {"0": [], "1": [], "2": []}

    def body(seat: Seat) -> None:
        seat.meet(MADE)
        seat.meet(BEGIN)
        number = int(seat.name)
        for _ in range(3 + number):
            for _ in range(2 * number + 1):
                seat.meet(ENVIRONMENTS)
            for _ in range(3 - number):
                answer = seat.together(GRADIENT_STEP, (10.0**number,))
                sums[seat.name].append(None if answer is None else answer["sum"])
        seat.group.leave(seat)

    MADE_OF.clear()
    group(body, body, body, joint=Sum).run()
    # 9 steps, 8 and 5: all three as long as there are three, two together afterwards, and the last one by itself.
    assert sums == {"0": [111] * 5 + [11] * 3 + [None], "1": [111] * 5 + [11] * 3, "2": [111] * 5}
    assert MADE_OF == [[0, 1, 2], [0, 1, 2], [0, 1]]


def test_steps_of_another_kind_are_taken_by_oneself() -> None:
    answers: list[Any] = []

    def body(seat: Seat) -> None:
        seat.meet(BEGIN)
        first = seat.name == "0"
        answers.append(seat.together(GRADIENT_STEP, (1.0, torch.zeros(2) if first else None)))
        answers.append(seat.together(GRADIENT_STEP, (1.0, torch.zeros(2 if first else 3))))
        answers.append(seat.together(GRADIENT_STEP, (1.0, first)))
        answers.append(seat.together(GRADIENT_STEP, (1.0 if first else 2.0, {"a": (torch.zeros(2), None)})))

    group(body, body, joint=Sum).run()
    assert answers == [None] * 6 + [{"sum": 3.0}] * 2


def test_actions_are_chosen_together_before_the_environments_step() -> None:
    """Some act at random at first, or take more gradient steps; each then acts, or steps, by itself."""
    answers: dict[str, list[Any]] = {"0": [], "1": [], "2": []}
    steps: list[str] = []

    def body(seat: Seat) -> None:
        seat.meet(BEGIN)
        number = int(seat.name)
        for i in range(5):
            if i >= number:
                answer = seat.together(ACTIONS, (number + 10.0 * i,))
                answers[seat.name].append(None if answer is None else answer["largest"])
            steps.append(seat.name)
            seat.meet(ENVIRONMENTS)
            if i >= 2:
                for _ in range(2 if seat.name == "0" and i == 3 else 1):
                    seat.together(GRADIENT_STEP, (1.0,))
        seat.group.leave(seat)

    group(body, body, body, joint=Sum).run()
    # Step 2 has all three; in step 3 the first one's second gradient step waits for the others' next one, so that it
    # acts by itself from then on.
    assert answers == {"0": [None, None, 22.0, 32.0, None], "1": [None, 22.0, 32.0, None], "2": [22.0, 32.0, None]}
    assert [steps.count(name) for name in "012"] == [5, 5, 5]


def test_a_failure_ends_the_others_at_their_next_meeting() -> None:
    ended: list[str] = []

    def body(seat: Seat) -> None:
        try:
            for i in range(10):
                if seat.name == "1" and i == 3:
                    raise LookupError("what was looked for")
                seat.meet(ENVIRONMENTS)
        except LeftWithTheOthers:
            ended.append(f"{i}{seat.name}")
            raise

    made = group(body, body, body)
    made.run()
    assert ended == ["22", "30"]
    assert [type(seat.error) for seat in made.seats] == [LeftWithTheOthers, LookupError, LeftWithTheOthers]
    assert made.failed == [made.seats[1]]


def test_an_interrupt_of_the_waiting_thread_ends_all() -> None:
    ended: list[str] = []

    def body(seat: Seat) -> None:
        try:
            for i in range(100_000):
                if seat.name == "1" and i == 3:
                    os.kill(os.getpid(), signal.SIGINT)
                seat.meet(ENVIRONMENTS)
        except KeyboardInterrupt:
            ended.append(seat.name)
            raise

    assert threading.current_thread() is threading.main_thread()
    seed(7)
    with pytest.raises(KeyboardInterrupt):
        group(body, body, body).run()
    after = draw()
    seed(7)
    assert after == draw()
    assert sorted(ended) == ["0", "1", "2"]


def test_a_second_signal_does_not_wait_for_a_training_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first was noted, as in runs with checkpoints."""
    ended: list[str] = []
    goes_on = threading.Event()

    def body(seat: Seat) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        goes_on.wait(60)
        ended.append(seat.name)

    monkeypatch.setattr(lockstep, "PATIENCE", 0.1)
    made = group(body)
    made.received = lambda: signal.SIGINT
    with pytest.raises(KeyboardInterrupt):
        made.run()
    assert ended == []
    goes_on.set()


@pytest.mark.parametrize(
    ("a", "b", "alike"),
    [(0.9, 1, True), (0.9, 0.99, True), (1, 1, True), (1, 2, False), (True, 1.0, False), (None, 0.5, False)],
)
def test_inputs_may_differ_in_real_numbers(a: Any, b: Any, alike: bool) -> None:
    assert _are_alike((a, "same"), (b, "same")) is alike


def test_threads_have_the_gpu_of_who_starts_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """It belongs to the thread, and a new one has the first."""
    chosen: list[tuple[Any, int]] = []
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: chosen.append((present().name, device)))
    monkeypatch.setattr(torch.cuda, "get_rng_state_all", list)
    monkeypatch.setattr(torch.cuda, "set_rng_state_all", lambda states: None)
    group(lambda seat: None, lambda seat: None).run()
    assert chosen == [("0", 1), ("1", 1)]
