"""
Workers of vectorised environments that die: who, how and why, instead of a bare ``EOFError``; and, where it is asked
for, another in the dead one's place.
"""

import contextlib
import multiprocessing
import multiprocessing.connection
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper, VecEnvObs, VecEnvStepReturn
from stable_baselines3.common.vec_env.subproc_vec_env import _stack_obs
from stable_baselines3.common.vec_env.subproc_vec_env import _worker as serve

#: Seconds for a worker that has hung up to be gone.
PATIENCE = 5.0


class EnvironmentDied(RuntimeError):
    """
    The worker process of an environment has died.

    :param index: of the environment
    :param pid: of the process
    :param exit_code: of the process; the negative number of the signal that killed it; None if it is not known
    :param request: what it was asked to do, as Stable-Baselines3's workers call it ("step", "reset", ...)
    :param trace: the traceback of the exception that ended it; None if it could not tell
    :param note: what else is to be said
    """

    def __init__(self, index: int, pid: int | None, exit_code: int | None, request: str, trace: str | None, note: str):
        self.index, self.pid, self.exit_code, self.request = index, pid, exit_code, request
        self.trace, self.note = trace, note
        if trace is not None:
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
        super().__init__(f"environment {index} died at {request!r}: its worker, process {pid}, {how}{note}")

    def __reduce__(self) -> Any:
        return type(self), (self.index, self.pid, self.exit_code, self.request, self.trace, self.note)


class _Failure(NamedTuple):
    """What a worker answers when it ends by an exception."""

    trace: str


class WatchedConnection:
    """
    The connection to a worker, which says so when the worker has died: at the answer, so that of several workers that
    are asked one after the other each is asked.

    :param connection: the connection
    :param process: the worker
    :param index: of its environment
    :param note: added to the error if the worker did not say why it ended
    """

    def __init__(self, connection: Connection, process: Any, index: int, note: str = ""):
        self._connection, self._process, self._index, self._note = connection, process, index, note
        #: Questions that wait for their answers.
        self._asked: list[str] = []
        self._error: EnvironmentDied | None = None

    def send(self, question: tuple[str, Any]) -> None:
        """
        :param question: for the worker
        """
        # What is left over where the answer of another raised an error, and what this raises, is told at the answer.
        with contextlib.suppress(EnvironmentDied):
            while self._asked:
                self.recv()
        with contextlib.suppress(OSError):
            self._connection.send(question)
        self._asked = [question[0]]

    def recv(self) -> Any:
        """
        :return: the worker's answer
        :raises EnvironmentDied: it has died
        """
        request = self._asked.pop(0) if self._asked else "start"
        if self._error is not None:
            raise self._error
        try:
            if isinstance(self._process, ForkProcess):
                # A forked worker holds copies of the others' ends of their connections, which then never close.
                multiprocessing.connection.wait([self._connection, self._process.sentinel])
                if not self._connection.poll():
                    raise EOFError
            answer = self._connection.recv()
        except (EOFError, OSError):
            raise self._died(request, None) from None
        if isinstance(answer, _Failure):
            raise self._died(request, answer.trace)
        return answer

    def _died(self, request: str, trace: str | None) -> EnvironmentDied:
        self._process.join(PATIENCE)
        note = self._note if trace is None and (self._process.exitcode or 0) > 0 else ""
        self._error = EnvironmentDied(self._index, self._process.pid, self._process.exitcode, request, trace, note)
        return self._error

    def finish(self) -> None:
        """
        Ask the worker to end, if it still can, and wait until it has.
        """
        self.send(("close", None))
        if self._error is not None:
            # Whatever is left of it.
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
    Let a ``SubprocVecEnv`` say which of its workers died and how, and close when some are dead. Other kinds stay as
    they are.

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


def _close(venv: SubprocVecEnv) -> None:
    if venv.closed:
        return
    venv.closed = True
    for remote in venv.remotes:
        assert isinstance(remote, WatchedConnection)
        remote.finish()


def _supervised(remote: Connection, parent_remote: Connection, env_fn: CloudpickleWrapper) -> None:
    """Stable-Baselines3's worker, which says at its end why it ends."""
    # A terminal's Ctrl-C goes to every process: it is for the training to end its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        serve(remote, parent_remote, env_fn)
    except Exception:
        remote.send(_Failure(traceback.format_exc()))
        remote.close()
        sys.exit(1)


class SupervisedSubprocVecEnv(SubprocVecEnv):
    """
    Stable-Baselines3's ``SubprocVecEnv``, whose errors have the traceback of the worker that died, and which can put
    another worker in its place: to use where that stands, as ``vec_env_cls`` of ``make_vec_env`` too.

    A worker is replaced when it dies during ``step`` or ``reset``, by an exception or because the system killed it. Its
    environment is made anew, with a seed of its own that follows from the one that ``seed`` was given, and its episode
    ends as one that a time limit ends does: reward 0, ``TimeLimit.truncated``, the last observation that it gave as
    ``terminal_observation``, and ``info["worker_died"]`` with the reason, which is also a warning. ``Monitor`` does not
    count the episode. What was set by ``set_attr`` or ``env_method`` in the old one is lost.

    :param env_fns: make the environments, each in a process of its own
    :param start_method: how processes are started, as there
    :param restart_envs: whether a worker that dies is replaced; otherwise its death is an error
    :param max_restarts: how many are replaced in the life of this object, so that an environment that is broken does
        end the training
    :raises ValueError: if an argument is out of range
    :raises EnvironmentDied: if an environment cannot be made
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env]],
        start_method: str | None = None,
        restart_envs: bool = False,
        max_restarts: int = 10,
    ):
        if not env_fns:
            raise ValueError("env_fns must make at least one environment, not none")
        if not isinstance(restart_envs, bool):
            raise ValueError(f"restart_envs must be True or False, not {restart_envs!r}")
        if isinstance(max_restarts, bool) or not isinstance(max_restarts, int) or max_restarts < 0:
            raise ValueError(f"max_restarts must be an integer of at least 0, not {max_restarts!r}")
        self.waiting = self.closed = False
        self.restart_envs, self.max_restarts = restart_envs, max_restarts
        #: Workers replaced so far.
        self.n_restarts = 0
        self._base_seed: int | None = None
        self._env_fns = list(env_fns)
        if start_method is None:
            start_method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
        self._context = multiprocessing.get_context(start_method)
        self.processes: list[Any] = []
        self.remotes: Any = []
        #: Of each environment, what it observed last.
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

    def _start(self, index: int) -> tuple[Any, WatchedConnection]:
        ours, theirs = self._context.Pipe()
        arguments = (theirs, ours, CloudpickleWrapper(self._env_fns[index]))
        # A daemon ends with this process, however that ends.
        process = self._context.Process(target=_supervised, args=arguments, daemon=True)  # type: ignore[attr-defined]
        process.start()
        theirs.close()
        return process, WatchedConnection(ours, process, index)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        Set the seeds that the environments get at their next ``reset``, as in Stable-Baselines3.

        :param seed: the first one's; drawn if None
        :return: the seeds
        """
        seeds = super().seed(seed)
        self._base_seed = seeds[0]
        return seeds

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
                results.append(self._replace(index, error))
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

    def _replace(self, index: int, error: EnvironmentDied) -> tuple[Any, dict[str, Any]]:
        """
        Put another worker in the place of a dead one.

        :param index: of its environment
        :param error: how it died
        :return: first observation and info of the new environment
        :raises EnvironmentDied: that is not wanted, or no more
        """
        while self.restart_envs and self.n_restarts < self.max_restarts:
            self.n_restarts += 1
            warnings.warn(
                f"{error} It is restarted, as {self.n_restarts} of at most {self.max_restarts}.", stacklevel=4
            )
            self.remotes[index].finish()
            self.processes[index], self.remotes[index] = self._start(index)
            seed = None
            if self._base_seed is not None:
                seed = int(np.random.SeedSequence([self._base_seed, index, self.n_restarts]).generate_state(1)[0])
            self.remotes[index].send(("reset", (seed, {})))
            try:
                return self.remotes[index].recv()
            except EnvironmentDied as next_error:
                error = next_error
        if not self.restart_envs:
            raise error
        note = f" It was not restarted once more: max_restarts={self.max_restarts} were."
        raise EnvironmentDied(error.index, error.pid, error.exit_code, error.request, error.trace, note)

    def close(self) -> None:
        """
        End the workers, those that still live.
        """
        _close(self)
