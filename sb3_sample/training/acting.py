"""Acting in a separate thread, at a fixed frequency or at the environment's pace, during learning."""

import math
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

#: Share of a period by which a step may begin late without counting as the next period's.
GRACE = 0.05
#: Seconds for which another thread that holds the interpreter may keep the acting thread waiting.
SWITCH_INTERVAL = 0.0005


class Clock(Protocol):
    """Time and waiting, in seconds."""

    def now(self) -> float: ...

    def wait_until(self, when: float) -> None: ...


class RealClock:
    """The computer's clock."""

    def now(self) -> float:
        """
        :return: seconds since an arbitrary moment
        """
        return time.perf_counter()

    def wait_until(self, when: float) -> None:
        """
        :param when: a moment, as returned by ``now``
        """
        left = when - time.perf_counter()
        if left > 0:
            time.sleep(left)


#: The clock of all acting.
CLOCK: Clock = RealClock()


class Step(NamedTuple):
    """
    One step of all environments.

    :param observations: observations acted on, (n_envs, O) or a dict
    :param actions: in the environment's units, (n_envs, A)
    :param scaled: in [-1, 1], as they are stored, (n_envs, A)
    :param new_obs: (n_envs, O) or a dict
    :param rewards: (n_envs,)
    :param dones: (n_envs,)
    :param infos: of each environment
    :param age: gradient steps since the parameters that chose the actions were handed over; None for random actions
    :param late: seconds after the beginning of its period
    :param missed: periods before it in which no step began
    :param begun: when it began, in seconds since an arbitrary moment, rests left out
    """

    observations: Any
    actions: np.ndarray
    scaled: np.ndarray
    new_obs: Any
    rewards: np.ndarray
    dones: np.ndarray
    infos: list[dict[str, Any]]
    age: int | None
    late: float
    missed: int
    begun: float


class Chosen(NamedTuple):
    """Actions and the age of the parameters that chose them, as in :class:`Step`."""

    actions: np.ndarray
    scaled: np.ndarray
    age: int | None


class ActingThread:
    """
    Thread that takes environment steps. A step begins with a period; if the previous step and the choice of actions
    last longer, it begins with the next period that can still be met.

    :param env: the environments, which nothing else may step meanwhile
    :param choose: chooses actions, given observations and how many steps were taken before; called in the thread
    :param observations: present observations of the environments
    :param n_steps: number of steps after which the thread ends
    :param period: seconds between the beginnings of two steps; None: each step follows the previous one at once
    """

    def __init__(
        self,
        env: VecEnv,
        choose: Callable[[Any, int], Chosen],
        observations: Any,
        n_steps: int,
        period: float | None,
    ):
        self._env, self._choose, self._observations = env, choose, observations
        self._n_steps, self._period = n_steps, period
        self._clock = CLOCK
        self._taken: queue.SimpleQueue[Step | BaseException] = queue.SimpleQueue()
        self._condition = threading.Condition()
        self._stops = self._rests = self._at_rest = False
        self._rested = 0.0  # seconds
        self._thread = threading.Thread(target=self._run, name="acting", daemon=True)
        self._interval = sys.getswitchinterval()

    def start(self) -> None:
        """Begin to act."""
        # This bounds how long computations in Python keep the acting thread waiting.
        sys.setswitchinterval(SWITCH_INTERVAL)
        self._thread.start()

    def taken(self, wait: bool) -> list[Step]:
        """
        Take over the steps since the last call.

        :param wait: whether to wait for one if there is none, unless the thread rests or has ended
        :return: the steps, in their order
        :raises BaseException: whatever an environment or the choice of actions has raised, after the steps before it
        """
        found: list[Step] = []
        while True:
            try:
                step = self._taken.get(timeout=0.1) if wait and not found else self._taken.get_nowait()
            except queue.Empty:
                if wait and not found and self._thread.is_alive() and not self._at_rest:
                    continue
                return found
            if isinstance(step, BaseException):
                if found:
                    self._taken.put(step)  # nothing follows it
                    return found
                raise step
            found.append(step)

    def rest(self) -> None:
        """Let the step under way finish, and no other begin."""
        with self._condition:
            self._rests = True
            while not self._at_rest and self._thread.is_alive():
                self._condition.wait(0.1)

    def go_on(self) -> None:
        """Act again after a rest."""
        with self._condition:
            self._rests = False
            self._condition.notify_all()

    def stop(self) -> None:
        """Finish the step under way and end the thread."""
        with self._condition:
            self._stops = True
            self._condition.notify_all()
        if self._thread.ident is not None:
            self._thread.join()
            sys.setswitchinterval(self._interval)

    def _has_rested(self) -> bool:
        """Rest if requested, and return whether a rest was requested."""
        with self._condition:
            asked, begin = self._rests and not self._stops, self._clock.now()
            while self._rests and not self._stops:
                self._at_rest = True
                self._condition.notify_all()
                self._condition.wait()
            self._at_rest = False
            if asked:
                self._rested += self._clock.now() - begin
            return asked

    def _run(self) -> None:
        try:
            self._act()
        except BaseException as error:
            self._taken.put(error)

    def _act(self) -> None:
        begin: float | None = None
        number = 0  # of the period
        for n_before in range(self._n_steps):
            self._has_rested()
            observations, late, missed, is_due = self._observations, 0.0, 0, False
            while not is_due:
                if self._stops:
                    return
                chosen = self._choose(observations, n_before)
                if self._period is None:
                    break
                now = self._clock.now()
                begin = now if begin is None else begin
                behind = (now - begin) / self._period - number
                if behind > GRACE:
                    missed += math.ceil(behind - GRACE)
                    number += math.ceil(behind - GRACE)
                due = begin + number * self._period
                self._clock.wait_until(due)
                late = self._clock.now() - due
                # After a rest the action is old and the period over: choose anew, for a period that can be met.
                is_due = not self._has_rested()
            if self._stops:
                return
            number += 1
            begun = self._clock.now() - self._rested
            new_obs, rewards, dones, infos = self._env.step(chosen.actions)
            self._observations = new_obs
            self._taken.put(
                Step(
                    observations,
                    chosen.actions,
                    chosen.scaled,
                    new_obs,
                    rewards,
                    dones,
                    infos,
                    chosen.age,
                    late,
                    missed,
                    begun,
                )
            )
