"""Signals during a training."""

import os
import signal
import threading
import types
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.console import tell
from sb3_sample.lockstep import LeftWithTheOthers, Seat
from sb3_sample.saving import vec_envs


class Interrupts:
    """
    SIGINT and SIGTERM during a training: the first is noted, so that the turn is finished and saved; a second one ends
    the process at once. Handlers can be set in the main thread only; in other threads signals stay as they are. Ignored
    signals stay ignored: a shell's background jobs ignore SIGINT, so that a Ctrl-C meant for the job in the foreground
    does not end them.

    A handler may interrupt any code, so the first signal raises nothing there, even if writing to the standard error
    fails.

    A training in a group ends together with the others, after a signal that was noted for all of them, or when one of
    them has failed.

    :param envs: environments whose workers are to ignore the SIGINT that a terminal sends to all processes
    :param folder: for the message
    :param seat: place of the training in a group; None for a single training, and for the group itself
    """

    def __init__(self, envs: list[VecEnv], folder: Path, seat: Seat | None = None):
        self.received: int | None = None
        self._process, self._folder, self._seat = os.getpid(), folder, seat
        self._before: dict[int, Any] = {}
        self._envs: list[VecEnv] = []
        if seat is None and threading.current_thread() is not threading.main_thread():
            return
        try:
            for number in (signal.SIGINT, signal.SIGTERM) if seat is None else ():
                # None: a handler that is not Python's, which could not be restored.
                if signal.getsignal(number) not in (signal.SIG_IGN, None):
                    self._before[number] = signal.signal(number, self._receive)
            for env in envs:
                vec_envs.set_sigint_ignored(env, True)
                self._envs.append(env)
        except BaseException:
            self.restore(orderly=False)
            raise

    def _receive(self, number: int, frame: types.FrameType | None) -> None:
        if os.getpid() != self._process:
            # A process that was forked meanwhile: its signals do not concern the training.
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        if self.received is not None:
            self.received = number
            self.leave(orderly=False)
        self.received = number
        name = signal.Signals(number).name
        tell(f"\n{name}: finishing the turn, to save it in {self._folder}; once more to leave at once\n")

    def leaves(self, now: int) -> bool:
        """
        :param now: environment steps at the end of a turn
        :return: whether the training is to be saved and to end
        """
        return self.received is not None if self._seat is None else self._seat.leaves(now)

    def leave(self, orderly: bool = True, saved_at: int | None = None) -> None:
        """
        :param orderly: whether this is between two turns
        :param saved_at: environment steps of the latest checkpoint, which a message tells; None for no message
        :raises KeyboardInterrupt: after SIGINT
        :raises SystemExit: after SIGTERM
        :raises LeftWithTheOthers: after the failure of another training in the group
        """
        number = self.received if self._seat is None else self._seat.group.received()
        self.restore(orderly)
        if saved_at is not None:
            why = "another training has failed" if number is None else signal.Signals(number).name
            tell(
                f"{why}: saved at {saved_at} steps in {self._folder}; the same program, started again, goes on from "
                "there\n"
            )
        if number is None:
            raise LeftWithTheOthers
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + number)

    def restore(self, orderly: bool) -> None:
        """
        Give the signals back.

        :param orderly: whether no exchange with the workers is under way, so that they can be told too
        """
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}
        for env in self._envs if orderly else ():
            if not getattr(env.unwrapped, "closed", False):
                vec_envs.set_sigint_ignored(env, False)
        self._envs = []
