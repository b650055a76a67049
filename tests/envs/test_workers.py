"""Workers that die: killed, by an exception, at every request, and put back in place."""

import functools
import multiprocessing
import os
import pickle
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import psutil
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_sample import MBMAPPO, SAC, EnvironmentDied, SupervisedSubprocVecEnv
from sb3_sample.envs import workers
from sb3_sample.envs.workers import WatchedConnection, watch_workers
from tests.ppo.common import tiny
from tests.sac.common import Toy, sac, vec

ACTIONS = np.zeros((3, 2), np.float32)


class Fragile(Toy):
    """
    Breaks where it is told to, and tells by its observations how it was seeded.

    :param step: of all its steps, the one that breaks it
    :param reset: of its resets, the one that breaks it
    :param how: what happens there
    :param marker: a file that, once it is there, keeps it from breaking
    """

    def __init__(
        self,
        step: int | None = None,
        reset: int | None = None,
        how: Callable[[], Any] | None = None,
        marker: Path | None = None,
    ):
        super().__init__(length=5)
        self.break_step, self.break_reset, self.how, self.marker = step, reset, how or _raise, marker
        self.n_resets = 0

    def _break(self) -> None:
        if self.marker is not None:
            if self.marker.exists():
                return
            self.marker.touch()
        self.how()

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        observation, _ = super().reset(seed=seed)
        self.n_resets += 1
        if self.n_resets == self.break_reset:
            self._break()
        return observation, {"draw": float(self.np_random.random())}

    def step(self, action: np.ndarray) -> Any:
        if self.total + 1 == self.break_step:
            self._break()
        return super().step(action)

    def pid(self) -> int:
        return os.getpid()

    def fail(self) -> None:
        raise RuntimeError("asked to fail")


def _raise() -> None:
    raise ArithmeticError("the joint is out of its socket")


def _kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _exit() -> None:
    sys.exit(3)


def fns(n: int = 3, fragile: int = 1, **kwargs: Any) -> list[Callable[[], Any]]:
    return [lambda i=i: Monitor(Fragile(**(kwargs if i == fragile else {}))) for i in range(n)]


@pytest.fixture
def make() -> Iterator[Callable[..., Any]]:
    """Makes environments, by fork since that is quick, and sees to it that nothing is left of them."""
    made: list[Any] = []

    def _make(cls: Any, *args: Any, start_method: str = "fork", **kwargs: Any) -> Any:
        venv = cls(*args, start_method=start_method, **kwargs)
        made.append((venv, [process.pid for process in venv.processes]))
        if cls is SubprocVecEnv:
            watch_workers(venv)
        return venv

    yield _make
    for venv, pids in made:
        start = time.monotonic()
        venv.close()
        venv.close()
        assert time.monotonic() - start < 5
        assert not any(process.is_alive() for process in venv.processes)
        deadline = time.monotonic() + 3
        for pid in [*pids, *(process.pid for process in venv.processes)]:
            while psutil.pid_exists(pid) and time.monotonic() < deadline:
                time.sleep(0.01)
            assert not psutil.pid_exists(pid)
    assert not [child for child in multiprocessing.active_children() if child.name.startswith("Process")]


def run(venv: Any, n: int) -> None:
    venv.reset()
    for _ in range(n):
        venv.step(ACTIONS)


BOTH = pytest.mark.parametrize("cls", [SubprocVecEnv, SupervisedSubprocVecEnv])


# ---------------------------------------------------------------- who and how


@BOTH
@pytest.mark.parametrize("start_method", ["fork", pytest.param("forkserver", marks=pytest.mark.slow)])
def test_a_killed_worker_is_named(cls: Any, start_method: str, make: Any) -> None:
    """With forked workers its end of the connection stays open in the others."""
    venv = make(cls, fns(), start_method=start_method)
    venv.reset()
    venv.step(ACTIONS)
    pid = venv.processes[1].pid
    os.kill(pid, signal.SIGKILL)
    words = rf"environment 1 died at 'step': its worker, process {pid}, was killed by SIGKILL \(exit code -9\)"
    for _ in range(2):  # It stays dead.
        with pytest.raises(EnvironmentDied, match=words) as caught:
            venv.step(ACTIONS)
        assert (caught.value.index, caught.value.pid, caught.value.exit_code) == (1, pid, -9)


@pytest.mark.parametrize("where", ["step", "reset"])
def test_the_traceback_is_told(where: str, make: Any) -> None:
    kwargs = {"step": 3} if where == "step" else {"reset": 1}
    venv = make(SupervisedSubprocVecEnv, fns(**kwargs))
    with pytest.raises(EnvironmentDied) as caught:
        run(venv, 5)
    message = str(caught.value)
    assert message.startswith(
        f"environment 1 died at '{where}': its worker, process {venv.processes[1].pid}, raised an ex"
    )
    assert 'in _raise\n    raise ArithmeticError("the joint is out of its socket")' in message
    assert caught.value.exit_code == 1 and caught.value.trace is not None


def test_of_stable_baselines3_own_it_is_said_where_it_is(make: Any) -> None:
    venv = make(SubprocVecEnv, fns(step=3))
    with pytest.raises(EnvironmentDied, match=r"ended with exit code 1\. What it raised is above"):
        run(venv, 5)


def test_an_environment_that_exits(make: Any) -> None:
    venv = make(SupervisedSubprocVecEnv, fns(step=1, how=_exit))
    venv.reset()
    with pytest.raises(EnvironmentDied, match=r"environment 1 died at 'step': .* ended with exit code 3\.$"):
        venv.step(ACTIONS)


def test_an_environment_that_cannot_be_made() -> None:
    def broken() -> Any:
        raise ImportError("no simulator here")

    for n in (0, 1):
        with pytest.raises(EnvironmentDied, match=f"environment {n} died (?s:.*)ImportError: no simulator here"):
            SupervisedSubprocVecEnv([*fns(n), broken], start_method="fork")
    assert not [child for child in multiprocessing.active_children() if child.name.startswith("Process")]


@BOTH
@pytest.mark.parametrize(
    ("request_name", "ask"),
    [
        ("get_attr", lambda venv: venv.get_attr("length")),
        ("set_attr", lambda venv: venv.set_attr("length", 3)),
        ("env_method", lambda venv: venv.env_method("pid")),
        ("is_wrapped", lambda venv: venv.env_is_wrapped(Monitor)),
        ("has_attr", lambda venv: venv.has_attr("length")),
        ("reset", lambda venv: venv.reset()),
    ],
)
def test_every_request_says_it(cls: Any, request_name: str, ask: Callable[[Any], Any], make: Any) -> None:
    venv = make(cls, fns())
    venv.reset()
    ask(venv)
    os.kill(venv.processes[2].pid, signal.SIGKILL)
    with pytest.raises(EnvironmentDied, match=f"environment 2 died at '{request_name}'"):
        ask(venv)


def test_what_the_others_answered_is_no_answer_to_the_next_question(make: Any) -> None:
    venv = make(SupervisedSubprocVecEnv, fns())
    venv.reset()
    with pytest.raises(EnvironmentDied, match="environment 0 died at 'env_method'(?s:.*)RuntimeError: asked to fail"):
        venv.env_method("fail", indices=0)
    with pytest.raises(EnvironmentDied, match="environment 0 died at 'env_method'"):
        venv.env_method("pid")
    assert venv.get_attr("length", indices=[1, 2]) == [5, 5]


def test_closing_in_the_midst_of_a_step_with_some_dead(make: Any) -> None:
    for cls in (SubprocVecEnv, SupervisedSubprocVecEnv):
        venv = make(cls, fns())
        venv.reset()
        os.kill(venv.processes[0].pid, signal.SIGKILL)
        venv.step_async(ACTIONS)


def test_nothing_changes_while_nobody_dies(make: Any) -> None:
    reference = DummyVecEnv(fns())
    for venv in (make(SubprocVecEnv, fns()), make(SupervisedSubprocVecEnv, fns(), restart_envs=True)):
        for env in (reference, venv):
            env.seed(3)
        np.testing.assert_array_equal(reference.reset(), venv.reset())
        assert list(reference.reset_infos) == list(venv.reset_infos)
        for _ in range(12):
            ours, theirs = venv.step(ACTIONS), reference.step(ACTIONS)
            for a, b in zip(ours[:3], theirs[:3], strict=True):
                np.testing.assert_array_equal(a, b)
            for a, b in zip(ours[3], theirs[3], strict=True):
                a, b = ({k: v for k, v in info.items() if k != "episode"} for info in (a, b))
                np.testing.assert_equal(a, b)


def test_installed_once_and_on_nothing_else(make: Any) -> None:
    venv = make(SubprocVecEnv, fns())
    remotes = venv.remotes
    watch_workers(VecNormalize(venv))
    assert venv.remotes is remotes and all(isinstance(remote, WatchedConnection) for remote in remotes)
    watch_workers(vec(2))
    supervised = make(SupervisedSubprocVecEnv, fns())
    remotes = supervised.remotes
    watch_workers(supervised)
    assert supervised.remotes is remotes


# ---------------------------------------------------------------- in a training


@BOTH
@pytest.mark.parametrize("family", [SAC, MBMAPPO])
def test_a_training_stops_with_the_error(cls: Any, family: Any, make: Any) -> None:
    venv = make(cls, fns(step=12))
    model = (sac if family is SAC else tiny)(env=VecNormalize(venv))
    words = "ArithmeticError: the joint" if cls is SupervisedSubprocVecEnv else "ended with exit code 1"
    with pytest.raises(EnvironmentDied, match=f"(?s)environment 1 died at 'step'.*{words}"):
        model.learn(200)
    assert model.num_timesteps == 33


def test_with_make_vec_env() -> None:
    kwargs = {"restart_envs": True, "max_restarts": 2, "start_method": "fork"}
    venv = make_vec_env("Pendulum-v1", 2, vec_env_cls=SupervisedSubprocVecEnv, vec_env_kwargs=kwargs)
    assert venv.restart_envs and venv.max_restarts == 2
    venv.close()


# ---------------------------------------------------------------- restarts


@pytest.mark.parametrize(
    ("how", "start_method"),
    [(_raise, "fork"), (_kill, "fork"), (_exit, "fork"), pytest.param(_kill, "forkserver", marks=pytest.mark.slow)],
)
def test_a_worker_is_replaced_within_a_step(
    how: Callable[[], Any], start_method: str, make: Any, tmp_path: Path
) -> None:
    env_fns = fns(step=4, how=how, marker=tmp_path / "broke")
    venv = make(SupervisedSubprocVecEnv, env_fns, start_method=start_method, restart_envs=True)
    venv.seed(7)
    venv.reset()
    before = [venv.step(ACTIONS) for _ in range(3)][-1]
    pids = venv.env_method("pid")
    with pytest.warns(UserWarning, match=r"environment 1 died at 'step'(?s:.*) It is restarted, as 1 of at most 10"):
        observations, rewards, dones, infos = venv.step(ACTIONS)
    # The others go on; the dead one's episode is cut off where it was last seen.
    np.testing.assert_array_equal(observations[:, 0], [4, 0, 4])
    np.testing.assert_array_equal(rewards, [4, 0, 4])
    np.testing.assert_array_equal(dones, [False, True, False])
    assert infos[1]["TimeLimit.truncated"] and "environment 1 died" in infos[1]["worker_died"]
    np.testing.assert_array_equal(infos[1]["terminal_observation"], before[0][1])
    assert not any("worker_died" in infos[i] for i in (0, 2))
    now = venv.env_method("pid")
    assert [a == b for a, b in zip(pids, now, strict=True)] == [True, False, True]
    observations, rewards, dones, _ = venv.step(ACTIONS)
    np.testing.assert_array_equal(observations[:, 0], [0, 1, 0])
    np.testing.assert_array_equal(dones, [True, False, True])


def test_the_file_of_its_monitor_goes_on(make: Any, tmp_path: Path) -> None:
    wrap = functools.partial(gym.wrappers.TransformReward, func=float)  # a Monitor need not be the outermost wrapper

    def env_fns(**kwargs: Any) -> list[Callable[[], Any]]:
        return [
            lambda i=i: wrap(Monitor(Fragile(**(kwargs if i == 1 else {})), str(tmp_path / str(i)))) for i in range(3)
        ]

    venv = make(SupervisedSubprocVecEnv, env_fns(step=8, marker=tmp_path / "broke"), restart_envs=True)
    run(venv, 7)
    path = tmp_path / "1.monitor.csv"
    before = path.read_text()
    assert len(before.splitlines()) == 3
    with pytest.warns(UserWarning, match="environment 1 died"):
        venv.step(ACTIONS)
    for _ in range(10):
        venv.step(ACTIONS)
    after = path.read_text()
    assert after.startswith(before) and len(after.splitlines()) == 5
    seconds = [float(line.split(",")[2]) for line in after.splitlines()[2:]]
    assert seconds == sorted(seconds)
    # A new object begins new files, as Stable-Baselines3's do.
    make(SupervisedSubprocVecEnv, env_fns())
    assert len(path.read_text().splitlines()) == 2


def test_what_of_a_monitors_file_cannot_be_continued(make: Any, tmp_path: Path) -> None:
    def env_fns(name: str, **kwargs: Any) -> list[Callable[[], Any]]:
        return [
            lambda i=i: Monitor(Fragile(**(kwargs if i == 1 else {})), str(tmp_path / f"{name}{i}"), **more)
            for i in range(3)
        ]

    # A line that a killed worker has begun.
    more: dict[str, Any] = {}
    path = tmp_path / "a1.monitor.csv"
    venv = make(SupervisedSubprocVecEnv, env_fns("a", step=8, marker=tmp_path / "broke"), restart_envs=True)
    run(venv, 7)
    before = path.read_text()
    path.write_text(before + "3.0,3,0")
    with pytest.warns(UserWarning, match="environment 1 died"):
        run(venv, 1)
    run(venv, 5)
    assert path.read_text().startswith(before) and len(path.read_text().splitlines()) == 4
    # Stable-Baselines3 writes no head to a new file that is to be appended to: rows follow, as without a death.
    more = {"override_existing": False}
    venv = make(SupervisedSubprocVecEnv, env_fns("b", step=8, marker=tmp_path / "broke too"), restart_envs=True)
    run(venv, 7)
    with pytest.warns(UserWarning, match="environment 1 died"):
        run(venv, 1)
    run(venv, 5)
    assert venv.n_restarts == 1
    assert [line.split(",")[1] for line in (tmp_path / "b1.monitor.csv").read_text().splitlines()] == ["5", "5"]


def test_its_seed_is_another_and_always_the_same(make: Any, tmp_path: Path) -> None:
    draws = []
    for i, seed in enumerate((7, 7, 8)):
        venv = make(SupervisedSubprocVecEnv, fns(step=2, marker=tmp_path / str(i)), restart_envs=True)
        venv.seed(seed)
        venv.reset()
        first = [info["draw"] for info in venv.reset_infos]
        venv.step(ACTIONS)
        with pytest.warns(UserWarning, match="restarted"):
            venv.step(ACTIONS)
        draws.append(venv.reset_infos[1]["draw"])
        assert draws[-1] not in first
    assert draws[0] == draws[1] != draws[2]


def test_a_worker_is_replaced_within_a_reset(make: Any, tmp_path: Path) -> None:
    venv = make(SupervisedSubprocVecEnv, fns(reset=1, marker=tmp_path / "broke"), restart_envs=True)
    with pytest.warns(UserWarning, match="environment 1 died at 'reset'"):
        observations = venv.reset()
    np.testing.assert_array_equal(observations, np.zeros((3, 3)))
    assert venv.n_restarts == 1
    # Between two steps too, where the death is found at the sending.
    os.kill(venv.processes[0].pid, signal.SIGKILL)
    venv.processes[0].join()
    with pytest.warns(UserWarning, match="environment 0 died at 'step'"):
        dones = venv.step(ACTIONS)[2]
    np.testing.assert_array_equal(dones, [True, False, False])


def test_a_worker_that_is_replaced_within_a_reset_has_its_options(make: Any, tmp_path: Path) -> None:
    class Told(Fragile):
        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return super().reset(seed=seed)[0], {"options": options}

    venv = make(SupervisedSubprocVecEnv, [lambda: Monitor(Told(reset=1, marker=tmp_path / "broke"))], restart_envs=True)
    venv.set_options({"level": 3})
    with pytest.warns(UserWarning, match="It is restarted"):
        venv.reset()
    assert venv.reset_infos == [{"options": {"level": 3}}]


def test_a_worker_that_dies_between_two_evaluations_is_replaced(make: Any) -> None:
    venv = make(SupervisedSubprocVecEnv, fns(n=2), restart_envs=True)
    model = sac(compile=False)
    evaluate_policy(model, venv, n_eval_episodes=2)
    os.kill(venv.processes[1].pid, signal.SIGKILL)
    venv.processes[1].join()
    with pytest.warns(UserWarning, match="environment 1 died at 'is_wrapped'.*It is restarted"):
        evaluate_policy(model, venv, n_eval_episodes=2)
    # Nobody can know it of a class that was not asked for before, and without restart_envs it is an error.
    os.kill(venv.processes[1].pid, signal.SIGKILL)
    venv.processes[1].join()
    with pytest.raises(EnvironmentDied, match="environment 1 died at 'is_wrapped'"):
        venv.env_is_wrapped(gym.wrappers.TimeLimit)
    venv.restart_envs = False
    with pytest.raises(EnvironmentDied, match="environment 1 died at"):
        venv.env_is_wrapped(Monitor)


@BOTH
def test_after_an_interrupted_wait_answers_belong_to_their_questions(cls: Any, make: Any) -> None:
    class Slow(Fragile):
        def step(self, action: np.ndarray) -> Any:
            time.sleep(0.2)
            return super().step(action)

    venv = make(cls, [lambda: Monitor(Slow()) for _ in range(2)])
    venv.reset()

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        venv.step_async(ACTIONS[:2])
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        with pytest.raises(KeyboardInterrupt):
            venv.step_wait()
    finally:
        signal.signal(signal.SIGALRM, before)
    np.testing.assert_array_equal(venv.reset(), np.zeros((2, 3)))
    assert len(venv.step(ACTIONS[:2])) == 4


@pytest.mark.parametrize("kwargs", [{"step": 2}, {"reset": 1}])
def test_an_environment_that_is_broken_for_good_ends_it(kwargs: dict[str, int], make: Any) -> None:
    venv = make(SupervisedSubprocVecEnv, fns(**kwargs), restart_envs=True, max_restarts=3)
    words = r"(?s)the joint is out.*not restarted once more: max_restarts=3"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with pytest.raises(EnvironmentDied, match=words):
            run(venv, 20)
    assert ["It is restarted" in str(warning.message) for warning in caught] == [True] * 3
    assert venv.n_restarts == 3


@pytest.mark.parametrize("family", [SAC, MBMAPPO])
@pytest.mark.parametrize("how", [_raise, _kill])
def test_a_training_goes_on(family: Any, how: Callable[[], Any], make: Any, tmp_path: Path) -> None:
    venv = make(SupervisedSubprocVecEnv, fns(step=12, how=how, marker=tmp_path / "broke"), restart_envs=True)
    model = (sac if family is SAC else tiny)(env=VecNormalize(venv))
    with pytest.warns(UserWarning, match="It is restarted"):
        model.learn(96)
    assert model.num_timesteps >= 96 and venv.n_restarts == 1
    if family is SAC:
        buffer = model.replay_buffer
        # Its twelfth step: cut off, which is no termination.
        assert buffer.dones[11, 1] == 1 and buffer.timeouts[11, 1] == 1 and buffer.rewards[11, 1] == 0
        np.testing.assert_array_equal(buffer.next_observations[11, 1], buffer.next_observations[10, 1])
        np.testing.assert_array_equal(buffer.observations[12, 1], np.zeros(3))


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"restart_envs": 1}, "restart_envs must be True or False, not 1"),
        ({"max_restarts": -1}, "max_restarts must be an integer of at least 0, not -1"),
        ({"max_restarts": True}, "max_restarts must be an integer of at least 0, not True"),
        ({"timeout": 0}, "timeout must be a positive number of seconds, or None, not 0"),
        ({"timeout": True}, "timeout must be a positive number of seconds, or None, not True"),
        ({"timeout": float("nan")}, "timeout must be .*not nan"),
        ({"timeout": "5"}, "timeout must be .*not '5'"),
        ({"env_fns": []}, "env_fns must make at least one environment"),
    ],
)
def test_what_is_refused(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        SupervisedSubprocVecEnv(**{"env_fns": fns(), **kwargs})


# ---------------------------------------------------------------- hanging


def _hang() -> None:
    time.sleep(1000)


@pytest.mark.parametrize("start_method", ["fork", pytest.param("forkserver", marks=pytest.mark.slow)])
def test_a_worker_that_hangs_is_named_with_its_last_action(start_method: str, make: Any) -> None:
    venv = make(SupervisedSubprocVecEnv, fns(step=3, how=_hang), start_method=start_method, timeout=2)
    venv.reset()
    actions = ACTIONS.copy()
    actions[1] = [0.25, -0.5]
    for _ in range(2):
        venv.step(ACTIONS)
    words = (
        r"environment 1 hangs at 'step': its worker, process \d+, gave no answer within 2 s, and was killed. Its "
        r"last action was array\(\[ 0.25, -0.5 \], dtype=float32\)\."
    )
    with pytest.raises(EnvironmentDied, match=words) as caught:
        venv.step(actions)
    assert caught.value.silence == 2 and caught.value.exit_code == -signal.SIGKILL
    np.testing.assert_array_equal(caught.value.action, actions[1])
    again = pickle.loads(pickle.dumps(caught.value))
    assert str(again) == str(caught.value) and again.silence == 2


def test_a_worker_that_hangs_is_replaced(make: Any, tmp_path: Path) -> None:
    env_fns = fns(step=3, how=_hang, marker=tmp_path / "hung")
    venv = make(SupervisedSubprocVecEnv, env_fns, restart_envs=True, timeout=2)
    with pytest.warns(UserWarning, match="environment 1 hangs at 'step'.*restarted, as 1 of"):
        run(venv, 6)
    assert venv.n_restarts == 1


def test_a_worker_that_hangs_at_the_end_is_not_waited_for(make: Any) -> None:
    class Stays(Fragile):
        def close(self) -> None:
            _hang()

    venv = make(SupervisedSubprocVecEnv, [Stays], timeout=1)
    venv.reset()


def test_making_an_environment_has_its_own_time(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow() -> Any:
        time.sleep(1.5)
        return Monitor(Fragile())

    venv = make(SupervisedSubprocVecEnv, [slow], timeout=0.5)
    venv.reset()

    def never() -> Any:
        _hang()

    monkeypatch.setattr(workers, "MAKING", 1.0)
    words = "environment 0 hangs at 'get_spaces'.*no action yet. Its environment was not made"
    with pytest.raises(EnvironmentDied, match=words):
        SupervisedSubprocVecEnv([never], start_method="fork", timeout=0.5)


# ---------------------------------------------------------------- the end of the program


def _program(cls: Any, pids: Any) -> None:
    venv = cls(fns(step=2, how=_hang), start_method="fork")
    model = sac(env=venv)
    pids.send([process.pid for process in venv.processes])
    model.learn(100)


@pytest.mark.parametrize("cls", [SubprocVecEnv, SupervisedSubprocVecEnv])
def test_forked_workers_do_not_outlive_a_killed_program(cls: Any) -> None:
    """Busy or not; and no other end of a connection tells them, since each holds copies of the others' ends."""
    ours, theirs = multiprocessing.Pipe()
    program = multiprocessing.get_context("fork").Process(target=_program, args=(cls, theirs))
    program.start()
    pids = ours.recv()
    time.sleep(0.5)
    program.kill()
    program.join()
    deadline = time.monotonic() + 20
    while any(map(_lives, pids)) and time.monotonic() < deadline:
        time.sleep(0.05)
    left = [pid for pid in pids if _lives(pid)]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left


def _lives(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
