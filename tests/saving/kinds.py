"""
Small environments, each of which keeps its state in another way than in plain attributes of its own, and a training
program over them that the tests kill and start again.
"""

import collections
import dataclasses
import functools
import itertools
import json
import random
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper

from sb3_sample import SupervisedSubprocVecEnv
from tests.sac.common import sac
from tests.saving.program import outcome


class Kind(gym.Env):
    """Episodes of 7 steps, whose observations show a number that depends on all of the state."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.t = 0
        self.set_up()

    def set_up(self) -> None:
        """Called once."""

    def begin(self, seed: int | None) -> None:
        """Called at each reset."""

    def number(self) -> float:
        """Changes the state, too."""
        raise NotImplementedError

    def _observation(self) -> np.ndarray:
        return np.array([self.number(), self.t / 7], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        self.begin(seed)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.t += 1
        return self._observation(), float(action[0]), False, self.t >= 7, {}


# ---------------------------------------------------------------- arrays that share memory


class View(Kind):
    """What is written to a part changes the whole; once in a while another array takes its place."""

    def begin(self, seed: int | None) -> None:
        self.position = np.zeros(2)
        self.state = self.before = self.np_random.uniform(size=5)
        self.position, self.parts = self.state[:2], [self.state[::-2], {"last": self.state[3:].reshape(1, 2)}]
        self.left, self.right = np.arange(6.0)[:4], np.arange(6.0)[2:]
        row = np.arange(6, dtype=np.float32)
        self.left, self.right = row[:4], row[2:].view(np.int32)

    def number(self) -> float:
        self.position += 0.1
        self.parts[0][0] *= 0.9
        self.parts[1]["last"][0, 0] += self.position[1]
        self.left[3] += 1
        if self.t == 3:
            # From now on only some share.
            self.before, self.state = self.state, self.state.copy()
            self.position = self.state[:2]
        return float(self.state.sum() + 3 * self.before.sum() + self.right.view(np.float32)[1])


class TensorView(Kind):
    def begin(self, seed: int | None) -> None:
        self.position = None
        self.state = torch.tensor(self.np_random.uniform(size=4))
        self.position, self.numbers = self.state[:2], self.state.numpy()

    def number(self) -> float:
        self.position += 0.1
        self.numbers[3] *= 1.1
        return float(self.state.sum())


class SharedByEnvironments(Kind):
    """All environments of a process write to one array, and draw from one generator."""

    def __init__(self, memory: np.ndarray, rng: np.random.Generator):
        self.memory, self.rng = memory, rng
        super().__init__()

    def number(self) -> float:
        self.memory += 0.01 * self.rng.uniform()
        return float(self.memory.sum())


# ---------------------------------------------------------------- functions


class BoundMethod(Kind):
    """Draws by methods of generators, of which one is not the environment's any more."""

    def set_up(self) -> None:
        super(Kind, self).reset(seed=5)
        self.draw = self.np_random.uniform
        self.own = random.Random(3)
        self.throw = self.own.random
        self.memory: list[float] = []
        self.remember = self.memory.append
        self.tick = self._tick
        self.counter = collections.Counter[str]()
        self.count = self.counter.update

    def begin(self, seed: int | None) -> None:
        self.sample = self.np_random.normal
        self.state = random.Random(int(self.np_random.integers(1000)))
        self.choose = self.state.randrange

    def _tick(self) -> int:
        return self.t

    def number(self) -> float:
        self.remember(self.draw())
        self.count("a")
        total = self.sample() + self.throw() + self.tick() + self.choose(100) + self.counter["a"]
        return float(sum(self.memory[-9:]) + total + self.own.random())


class Partial(Kind):
    def set_up(self) -> None:
        self.rng = np.random.default_rng(3)
        self.other = functools.partial(self.rng.uniform, high=np.full(2, 2.0), low=0)
        self.inner = functools.partial(functools.partial(np.random.default_rng(4).normal, scale=2), size=2)

    def begin(self, seed: int | None) -> None:
        self.draw = functools.partial(self.np_random.uniform, 0, 1)

    def number(self) -> float:
        return float(self.draw() + self.np_random.uniform() + self.other().sum() + self.inner()[1] + self.rng.normal())


def counter() -> Callable[[], float]:
    count, rng = 0, np.random.default_rng(3)

    def add() -> float:
        nonlocal count
        count += 1
        return count + float(rng.uniform())

    return add


def calls() -> Callable[[], int]:
    def f() -> int:
        f.n += 1  # type: ignore[attr-defined]
        return f.n  # type: ignore[attr-defined]

    f.n = 0  # type: ignore[attr-defined]
    return f


class Closure(Kind):
    """Variables of functions, defaults that a function draws from, attributes of functions, and what is wrapped."""

    def set_up(self) -> None:
        self.add, self.calls = counter(), calls()
        self.again = functools.lru_cache(maxsize=0)(counter())

    def begin(self, seed: int | None) -> None:
        self.draw = lambda rng=self.np_random, *, scales=[1.0]: scales.append(len(scales)) or rng.uniform() * scales[-1]
        self.of_itself = lambda: self.t

    def number(self) -> float:
        return self.add() + self.calls() + self.draw() + self.of_itself() + self.again()


class Wrapped(Kind):
    """In a vectorised wrapper with state of these kinds (:class:`Noisy`)."""

    def number(self) -> float:
        return 0.0


class Physics(Kind):
    """A simulator whose gravity, time step and contacts are drawn anew for each episode."""

    def set_up(self) -> None:
        body = '<body pos="0 0 1"><joint type="slide" axis="0 0 1"/><geom size=".1"/></body>'
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{body}</worldbody></mujoco>'
        )
        self.data = mujoco.MjData(self.model)

    def begin(self, seed: int | None) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.model.opt.gravity[2] = self.np_random.uniform(-20, -1)
        self.model.opt.timestep = self.np_random.uniform(0.05, 0.1)
        self.model.geom_contype[:] = self.np_random.integers(2)

    def number(self) -> float:
        mujoco.mj_step(self.model, self.data)
        return float(self.data.qpos[0])


class Noisy(VecEnvWrapper):
    n_steps = 0.0

    def __init__(self, venv: VecEnv):
        super().__init__(venv)
        self.draw = np.random.default_rng(3).uniform
        self.add = counter()
        self.state = np.zeros(3)
        self.first = self.state[:1]

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        type(self).n_steps += 1
        self.first += self.draw()
        return observations + np.float32(self.state.sum() + self.add() + self.n_steps), rewards, dones, infos


# ---------------------------------------------------------------- slots and classes


class Slotted:
    __slots__ = ("__total", "count")

    def add(self) -> float:
        if not hasattr(self, "count"):
            self.count, self.__total = 0, 0.5
        self.count += 1
        self.__total *= 1.1
        return self.count + self.__total


@dataclasses.dataclass(slots=True)
class Point:
    x: float = 0.0
    track: Any = None


class Slots(Slotted, Kind):
    def set_up(self) -> None:
        self.point = Point()

    def number(self) -> float:
        self.point.x += self.np_random.uniform()
        return self.add() + self.point.x


class Helper:
    n_calls = 0

    def call(self) -> int:
        type(self).n_calls += 1
        return self.n_calls


class Curriculum(Kind):
    """A class above the environment's that counts for all of them."""

    level = 0.0


class ClassAttributes(Curriculum):
    episodes = 0
    history: ClassVar[list[float]] = []
    rng = np.random.default_rng(3)
    draw = functools.partial(np.random.default_rng(4).uniform, 1)
    limit: ClassVar[range] = range(4)

    def set_up(self) -> None:
        self.generator, self.helper = self.rng, Helper()

    def begin(self, seed: int | None) -> None:
        type(self).episodes += 1
        Curriculum.level += 0.01
        ClassAttributes.newest = self.episodes  # type: ignore[attr-defined]
        self.history.append(float(self.generator.uniform()))

    def number(self) -> float:
        drawn = self.rng.uniform() + self.generator.uniform() + ClassAttributes.draw()
        return float(sum(self.history[-5:]) + self.episodes + self.level + drawn + self.helper.call() + self.newest)  # type: ignore[attr-defined]


class Counting(Kind):
    """Has a constant of its class, and a number that changes."""

    n, limit = 0, 3

    def begin(self, seed: int | None) -> None:
        type(self).n += 1

    def number(self) -> float:
        return 0.0


# ---------------------------------------------------------------- global generators


class Globals(Kind):
    """Draws from what a process has one of, in three ways by a function that it keeps."""

    def set_up(self) -> None:
        self.draws = [random.random, np.random.uniform, np.random.mtrand._rand.normal]
        self.rng = np.random.mtrand._rand

    def begin(self, seed: int | None) -> None:
        if seed is not None:
            random.seed(seed)
            np.random.seed(seed)
            torch.manual_seed(seed)

    def number(self) -> float:
        return float(sum(draw() for draw in self.draws) + torch.rand(()) + self.rng.uniform() + random.random())


# ---------------------------------------------------------------- what cannot be restored


class Iterates(Kind):
    def number(self) -> float:
        return 0.0


class ClosureOverIterator(Iterates):
    def set_up(self) -> None:
        numbers = itertools.count()
        self.draw = lambda: next(numbers)


class PartialOfIterator(Iterates):
    def set_up(self) -> None:
        self.draw = functools.partial(next, itertools.count())


class IteratorInSlots(Slotted, Iterates):
    def set_up(self) -> None:
        self.count = itertools.count()  # type: ignore[assignment]


class IteratorOfClass(Iterates):
    ids = itertools.count()


class Broadcast(Iterates):
    def set_up(self) -> None:
        self.state = np.zeros(3)
        self.rows = np.broadcast_to(self.state, (2, 3))


class InC(Iterates):
    """An object with attributes, and a state besides."""

    def set_up(self) -> None:
        self.error = ValueError(3)


class ChangesItsMethod(Kind):
    """A machine whose states are its methods."""

    def begin(self, seed: int | None) -> None:
        self.mode = self.walk

    def walk(self) -> float:
        if self.t == 2:
            self.mode = self.run
        return 1.0

    def run(self) -> float:
        return 2.0

    def number(self) -> float:
        return self.mode()


# ---------------------------------------------------------------- the program


def environments(cls: type[Kind], workers: str) -> Any:
    """Two of a kind, in this process, in Stable-Baselines3's workers, or in supervised ones."""
    if cls is SharedByEnvironments:
        shared = np.zeros(2), np.random.default_rng(3)
        return DummyVecEnv([lambda: Monitor(cls(*shared)) for _ in range(2)])
    makers: list[Callable[[], gym.Env]] = [lambda: Monitor(cls()) for _ in range(2)]
    if cls is Wrapped:
        return Noisy(DummyVecEnv(makers))
    if workers == "dummy":
        return DummyVecEnv(makers)
    venv = SupervisedSubprocVecEnv if workers == "supervised" else SubprocVecEnv
    return venv(makers, start_method="fork")


class Rows(BaseCallback):
    """Remembers every observation of the training, those of earlier parts of the run too."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[float] = []

    def _on_step(self) -> bool:
        self.seen += self.locals["new_obs"].ravel().tolist()
        return True


def train(cases: list[tuple[str, str]], steps: int, folder: str) -> None:
    """
    Train in environments of several kinds, as a user's program does, and write down what came out, and the warnings.

    :param cases: names of the environments' classes, and where they are, as of :func:`environments`
    :param steps: environment steps; the episodes have 14 in both environments
    :param folder: for the runs' folders
    """
    torch.set_num_threads(1)
    for kind, workers in cases:
        rows, run = Rows(), f"{folder}/{kind}-{workers}"
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            agent = sac(environments(globals()[kind], workers), learning_starts=6, replay_ratio=0.5)
            agent.learn(steps, rows, checkpoint=run, checkpoint_freq=20)
        found = {**outcome(agent, run), "seen": repr(rows.seen)}
        said = [str(w.message) for w in caught if "episodes in progress" in str(w.message)]
        Path(f"{run}.json").write_text(json.dumps({**found, "said": repr(said)}))
        agent.env.close()
