"""
Workers of vectorised environments that die or hang: errors that say which, how and why, instead of a bare ``EOFError``
or an endless wait; and, on request, a new worker in the dead one's place.
"""

import contextlib
import math
import multiprocessing
import multiprocessing.connection
import numbers
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import (
    CloudpickleWrapper,
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)
from stable_baselines3.common.vec_env.subproc_vec_env import _stack_obs
from stable_baselines3.common.vec_env.subproc_vec_env import _worker as serve

from sb3_sample.envs.monitors import made_again
from sb3_sample.warn import warn

#: Seconds within which a worker that has closed its connection must end.
PATIENCE = 5.0
#: Seconds that making an environment may take, where answers have less: it imports libraries.
MAKING = 60.0
#: Seconds between a worker's checks that its parent lives.
_LOOK = 0.5


class EnvironmentDied(RuntimeError):
    """
    The worker process of an environment has died, or was killed since it gave no answer.

    :param index: of the environment
    :param pid: of the process
    :param exit_code: of the process; the negative number of the signal that killed it; None if it is not known
    :param request: what it was asked to do, as Stable-Baselines3's workers call it ("step", "reset", ...)
    :param trace: the traceback of the exception that ended it; None if it could not report one
    :param note: further text for the message
    :param silence: seconds without an answer after which it was killed; None if it died otherwise
    :param action: the last action that it was given; None if there was none
    """

    def __init__(
        self,
        index: int,
        pid: int | None,
        exit_code: int | None,
        request: str,
        trace: str | None,
        note: str,
        silence: float | None = None,
        action: Any = None,
    ):
        self.index, self.pid, self.exit_code, self.request = index, pid, exit_code, request
        self.trace, self.note, self.silence, self.action = trace, note, silence, action
        verb = "died" if silence is None else "hangs"
        if silence is not None:
            last = "It was given no action yet." if action is None else f"Its last action was {action!r:.500}."
            how = f"gave no answer within {silence:g} s, and was killed. {last}"
        elif trace is not None:
            how = f"raised an exception:\n\n{trace.rstrip()}\n"
        elif exit_code is not None and exit_code < 0:
            name = next((s.name for s in signal.Signals if s == -exit_code), f"signal {-exit_code}")
            how = f"was killed by {name} (exit code {exit_code})."
            if name == "SIGKILL":
                how += " The system does that to a process when memory runs out."
        elif exit_code is None:
            how = "closed its connection."
        else:
            how = f"ended with exit code {exit_code}."
        super().__init__(f"environment {index} {verb} at {request!r}: its worker, process {pid}, {how}{note}")

    def __reduce__(self) -> Any:
        values = (self.index, self.pid, self.exit_code, self.request, self.trace, self.note, self.silence, self.action)
        return type(self), values

    def noting(self, note: str) -> "EnvironmentDied":
        """
        :param note: further text for the message
        :return: the same error with this note
        """
        cls, values = self.__reduce__()
        return cls(*values[:5], note, *values[6:])


class _Failure(NamedTuple):
    """Message of a worker that ends by an exception."""

    trace: str


class _Made(NamedTuple):
    """Message of a worker whose environment is made."""


class WatchedConnection:
    """
    Connection to a worker, which raises an error if the worker has died or hangs. The error comes when the answer is
    read, so that all of several workers are asked first.

    :param connection: the connection
    :param process: the worker
    :param index: of its environment
    :param note: added to the error if the worker did not say why it ended
    :param timeout: seconds from a question to its answer, after which the worker is killed; None to wait without end.
        The worker must be one that reports when its environment is made
    """

    def __init__(self, connection: Connection, process: Any, index: int, note: str = "", timeout: float | None = None):
        self._connection, self._process, self._index, self._note = connection, process, index, note
        self._timeout = timeout
        #: Questions that wait for their answers, and when they were asked.
        self._asked: list[tuple[str, float]] = []
        self._began, self._made = time.monotonic(), -math.inf
        self._action: Any = None
        self._error: EnvironmentDied | None = None

    def send(self, question: tuple[str, Any]) -> None:
        """
        :param question: for the worker
        """
        # Drop answers left over after the error of another worker; an error here is raised at the next answer.
        with contextlib.suppress(EnvironmentDied):
            while self._asked:
                self.recv()
        if question[0] == "step":
            self._action = question[1]
        with contextlib.suppress(OSError):
            self._connection.send(question)
        self._asked = [(question[0], time.monotonic())]

    def recv(self) -> Any:
        """
        :return: the worker's answer
        :raises EnvironmentDied: it has died, or was killed since it gave none
        """
        request, asked = self._asked[0] if self._asked else ("start", self._began)
        # Until it is here the answer is outstanding, also after a Ctrl-C: the next question reads it first.
        if self._error is not None:
            del self._asked[:1]
            raise self._error
        try:
            answer = self._receive(request, asked)
            while isinstance(answer, _Made):
                self._made = time.monotonic()
                answer = self._receive(request, asked)
            del self._asked[:1]
        except (EOFError, OSError):
            raise self._died(request, None) from None
        if isinstance(answer, _Failure):
            raise self._died(request, answer.trace)
        return answer

    def _receive(self, request: str, asked: float) -> Any:
        """
        :raises EnvironmentDied: it hangs
        :raises OSError: it is gone
        :raises EOFError: it is gone
        """
        # A forked worker holds copies of the others' ends of their connections, which then never close.
        forked = isinstance(self._process, ForkProcess)
        allowed = self._timeout
        if allowed is not None and self._made < 0:
            asked, allowed = self._began, max(allowed, MAKING)
        if forked or allowed is not None:
            left = None if allowed is None else max(0.0, max(asked, self._made) + allowed - time.monotonic())
            waited_for: list[Any] = [self._connection, *([self._process.sentinel] if forked else [])]
            if not multiprocessing.connection.wait(waited_for, left):
                raise self._hangs(request, allowed)
            if not self._connection.poll():
                raise EOFError
        return self._connection.recv()

    def _died(self, request: str, trace: str | None) -> EnvironmentDied:
        self._process.join(PATIENCE)
        note = self._note if trace is None and (self._process.exitcode or 0) > 0 else ""
        self._error = EnvironmentDied(self._index, self._process.pid, self._process.exitcode, request, trace, note)
        return self._error

    def _hangs(self, request: str, allowed: float | None) -> EnvironmentDied:
        self._process.kill()
        self._process.join(PATIENCE)
        note = " Its environment was not made by then." if self._made < 0 else ""
        self._error = EnvironmentDied(
            self._index, self._process.pid, self._process.exitcode, request, None, note, allowed, self._action
        )
        return self._error

    def finish(self) -> None:
        """
        Ask the worker to end, if it still can, and wait until it has.
        """
        self.send(("close", None))
        if self._error is None:
            self._process.join(self._timeout)
        # End it if it is still running.
        self._process.kill()
        self._process.join()
        self._connection.close()

    def close(self) -> None:
        """
        Close this end of the connection.
        """
        self._connection.close()


def watch_workers(venv: VecEnv) -> None:
    """
    Make a ``SubprocVecEnv`` report which of its workers died and how, and let it close when some are dead. Other
    vectorised environments stay as they are.

    :param venv: a vectorised environment, wrapped or not
    """
    innermost = venv.unwrapped
    if not isinstance(innermost, SubprocVecEnv) or isinstance(innermost.remotes[0], WatchedConnection):
        return
    note = (
        " What it raised is above, where this program writes its errors; with "
        "sb3_sample.SupervisedSubprocVecEnv it would be part of this message."
    )
    workers = zip(innermost.remotes, innermost.processes, strict=True)
    innermost.remotes = tuple(
        WatchedConnection(connection, process, index, note)  # type: ignore[arg-type, misc]
        for index, (connection, process) in enumerate(workers)
    )
    innermost.close = lambda: _close(innermost)  # type: ignore[method-assign]
    end_with_this_process(innermost)


def end_with_this_process(venv: VecEnv) -> None:
    """
    Make the forked workers of a ``SubprocVecEnv`` end when this process does, however it ends: each worker holds copies
    of the others' ends of their connections, so that none would notice. Other vectorised environments stay as they are.

    :param venv: a vectorised environment, wrapped or not
    """
    innermost = venv.unwrapped
    if not isinstance(innermost, SubprocVecEnv) or isinstance(innermost, SupervisedSubprocVecEnv):
        return
    if isinstance(innermost.processes[0], ForkProcess) and not innermost.waiting:
        # A worker that has died is reported at the next question.
        with contextlib.suppress(EnvironmentDied, EOFError, OSError):
            innermost.env_is_wrapped(_EndWithThisProcess())  # type: ignore[arg-type]


def _end_with(parent: int) -> type:
    """
    End this process when another is no longer its parent.

    :param parent: the other's process id
    :return: a class that the environment may be wrapped in
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
    return gym.Wrapper


class _EndWithThisProcess:
    """
    Sent to a worker of Stable-Baselines3 in place of a class, it becomes a call of :func:`_end_with` there: the workers
    answer a fixed set of questions, and none of them does this.
    """

    def __reduce__(self) -> Any:
        return _end_with, (os.getpid(),)


def _close(venv: SubprocVecEnv) -> None:
    if venv.closed:
        return
    venv.closed = True
    for remote in venv.remotes:
        assert isinstance(remote, WatchedConnection)
        remote.finish()


def _supervised(
    remote: Connection, parent_remote: Connection, env_fn: CloudpickleWrapper, parent: int | None, is_replacement: bool
) -> None:
    """
    Run Stable-Baselines3's worker; report when its environment is made and, if an exception ends it, why. A worker that
    replaces another continues the files of that worker's Monitors.
    """
    # A terminal's Ctrl-C goes to every process, but only the training is to end its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Workers that are not forked have a parent that ends with the training's process.
    _end_with(os.getppid() if parent is None else parent)

    def make() -> gym.Env:
        env = made_again(env_fn.var) if is_replacement else env_fn.var()
        remote.send(_Made())
        return env

    try:
        serve(remote, parent_remote, CloudpickleWrapper(make))
    except Exception:
        remote.send(_Failure(traceback.format_exc()))
        remote.close()
        sys.exit(1)


class SupervisedSubprocVecEnv(SubprocVecEnv):
    """
    Stable-Baselines3's ``SubprocVecEnv`` with the traceback of a dead worker in its errors, and optional replacement of
    dead workers. It can be used wherever a ``SubprocVecEnv`` can, also as ``vec_env_cls`` of ``make_vec_env``.

    A worker is replaced when it dies during ``step`` or ``reset``, by an exception or because the system killed it. Its
    environment is made anew, with its own seed that follows from the one given to ``seed``, and its episode ends as if
    by a time limit: reward 0, ``TimeLimit.truncated``, the last observation that it gave as ``terminal_observation``,
    and ``info["worker_died"]`` with the reason, which is also given as a warning. ``Monitor`` does not count the
    episode, and its file goes on. Values set by ``set_attr`` or ``env_method`` in the old environment are lost.

    :param env_fns: functions that make the environments, each in its own process
    :param start_method: how processes are started, as in ``SubprocVecEnv``
    :param restart_envs: whether a worker that dies is replaced; otherwise its death is an error
    :param max_restarts: how many workers are replaced in the life of this object, so that a broken environment does end
        the training
    :param timeout: seconds without an answer after which a worker is killed, and treated like any dead one; the error
        names its last action. Making an environment may take a minute, if that is longer. None: wait without end for a
        worker that hangs
    :raises ValueError: if an argument is out of range
    :raises EnvironmentDied: if an environment cannot be made
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env]],
        start_method: str | None = None,
        restart_envs: bool = False,
        max_restarts: int = 10,
        timeout: float | None = None,
    ):
        if not env_fns:
            raise ValueError("env_fns must make at least one environment, not none")
        if not isinstance(restart_envs, bool):
            raise ValueError(f"restart_envs must be True or False, not {restart_envs!r}")
        if isinstance(max_restarts, bool) or not isinstance(max_restarts, int) or max_restarts < 0:
            raise ValueError(f"max_restarts must be an integer of at least 0, not {max_restarts!r}")
        number = isinstance(timeout, numbers.Real) and not isinstance(timeout, bool)
        if timeout is not None and not (number and 0 < timeout < math.inf):
            raise ValueError(f"timeout must be a positive number of seconds, or None, not {timeout!r}")
        self.waiting = self.closed = False
        self.restart_envs, self.max_restarts, self.timeout = restart_envs, max_restarts, timeout
        #: Workers replaced so far.
        self.n_restarts = 0
        self._base_seed: int | None = None
        self._env_fns = list(env_fns)
        if start_method is None:
            start_method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
        self._context = multiprocessing.get_context(start_method)
        self.processes: list[Any] = []
        self.remotes: Any = []
        #: Last answers of the workers whether their environments are wrapped in a class, by the class.
        self._wrapped_in: dict[type, list[bool | None]] = {}
        #: The last observation of each environment.
        self.last_observations: list[Any] = [None] * len(self._env_fns)
        try:
            for index in range(len(self._env_fns)):
                process, remote = self._start(index)
                self.processes.append(process)
                self.remotes.append(remote)
            self.remotes[0].send(("get_spaces", None))
            observation_space, action_space = self.remotes[0].recv()
            VecEnv.__init__(self, len(self._env_fns), observation_space, action_space)
        except BaseException:
            _close(self)
            raise

    def _start(self, index: int, is_replacement: bool = False) -> tuple[Any, WatchedConnection]:
        ours, theirs = self._context.Pipe()
        parent = os.getpid() if self._context.get_start_method() == "fork" else None
        arguments = (theirs, ours, CloudpickleWrapper(self._env_fns[index]), parent, is_replacement)
        # A daemon ends with this process when that exits; after SIGKILL :func:`_end_with` ends it.
        process = self._context.Process(target=_supervised, args=arguments, daemon=True)  # type: ignore[attr-defined]
        process.start()
        theirs.close()
        return process, WatchedConnection(ours, process, index, timeout=self.timeout)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        Set the seeds that the environments get at their next ``reset``, as in Stable-Baselines3.

        :param seed: seed of the first environment; drawn if None
        :return: the seeds
        """
        seeds = super().seed(seed)
        self._base_seed = seeds[0]
        return seeds

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """
        Check for a wrapper, as in Stable-Baselines3, whose evaluations begin with this question.

        :param wrapper_class: class of the wrapper
        :param indices: of the environments; all if None
        :return: whether each is wrapped in it. A worker that has died since it was last asked, and that ``reset`` will
            replace, is given its last answer
        :raises EnvironmentDied: if another worker died
        """
        asked = list(self._get_indices(indices))
        for index in asked:
            self.remotes[index].send(("is_wrapped", wrapper_class))
        known = self._wrapped_in.setdefault(wrapper_class, [None] * self.num_envs)
        for index in asked:
            try:
                known[index] = self.remotes[index].recv()
            except EnvironmentDied:
                if known[index] is None or not self.restart_envs:
                    raise
        return [bool(known[index]) for index in asked]

    def reset(self) -> VecEnvObs:
        """
        :return: the first observations
        :raises EnvironmentDied: if a worker died and is not replaced
        """
        for index, remote in enumerate(self.remotes):
            remote.send(("reset", (self._seeds[index], self._options[index])))
        results = []
        for index in range(self.num_envs):
            try:
                results.append(self.remotes[index].recv())
            except EnvironmentDied as error:
                results.append(self._replace(index, error, self._options[index]))
        self.waiting = False
        self.last_observations, self.reset_infos = map(list, zip(*results, strict=True))
        self._reset_seeds()
        self._reset_options()
        return _stack_obs(self.last_observations, self.observation_space)

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations, rewards, dones, infos
        :raises EnvironmentDied: if a worker died and is not replaced
        """
        results = []
        for index in range(self.num_envs):
            try:
                results.append(self.remotes[index].recv())
            except EnvironmentDied as error:
                observation, reset_info = self._replace(index, error)
                info = {
                    "TimeLimit.truncated": True,
                    "terminal_observation": self.last_observations[index],
                    "worker_died": str(error),
                }
                results.append((observation, 0.0, True, info, reset_info))
        self.waiting = False
        observations, rewards, dones, infos, reset_infos = zip(*results, strict=True)
        self.last_observations, self.reset_infos = list(observations), list(reset_infos)
        return _stack_obs(self.last_observations, self.observation_space), np.stack(rewards), np.stack(dones), infos  # type: ignore[return-value]

    def _replace(
        self, index: int, error: EnvironmentDied, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """
        Replace a dead worker.

        :param index: of its environment
        :param error: how it died
        :param options: of its first ``reset``
        :return: first observation and info of the new environment
        :raises EnvironmentDied: replacement is not wanted, or no more is allowed
        """
        while self.restart_envs and self.n_restarts < self.max_restarts:
            self.n_restarts += 1
            warn(f"{error} It is restarted, as {self.n_restarts} of at most {self.max_restarts}.")
            self.remotes[index].finish()
            self.processes[index], self.remotes[index] = self._start(index, is_replacement=True)
            seed = None
            if self._base_seed is not None:
                seed = int(np.random.SeedSequence([self._base_seed, index, self.n_restarts]).generate_state(1)[0])
            self.remotes[index].send(("reset", (seed, options or {})))
            try:
                return self.remotes[index].recv()
            except EnvironmentDied as next_error:
                error = next_error
        if not self.restart_envs:
            raise error
        note = f" It was not restarted once more: max_restarts={self.max_restarts} were."
        raise error.noting(error.note + note)

    def close(self) -> None:
        """
        End the workers that still live.
        """
        _close(self)
