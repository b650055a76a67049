"""``train_many``: each learner is the training that it is alone, bit by bit."""

import collections
import contextlib
import functools
import os
import random
import shutil
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import SAC as SB3SAC
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_sample import BRO, MBMAPPO, SAC, VPLSAC, DebiasedRQ, train_many
from sb3_sample.learner.execution import Execution
from sb3_sample.learner.group import LearnerGroup
from sb3_sample.sac import many
from sb3_sample.saving import training_state
from sb3_sample.saving.run_folder import RunFolder, common_starts
from tests.sac.common import TINY_BRO, TINY_DR_Q, TINY_SAC, Toy, sampled, state, vec

SEEDS = (3, 0, 5)
STEPS, EVERY = 48, 16


class Drawing(gym.Env):
    """Draws from every generator that a process has once, besides its own; its episodes are of unequal length."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-10, 10, (3,), np.float32)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def _observation(self) -> np.ndarray:
        noise = [random.gauss(0, 1), np.random.normal(), float(torch.randn(())) + self.np_random.normal()]
        return np.clip(np.float32(noise), -9, 9)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(2, 12))
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.left -= 1
        return self._observation(), float(action.sum() + random.random()), False, self.left == 0, {}


class OneAfterTheOther:
    """Takes the place of gradient steps that are one: those of all learners together, by each one's own means."""

    made: list["OneAfterTheOther"] = []

    def __init__(self, learners: Sequence[Any]):
        self.learners, self.released, self.seconds_compiling = list(learners), False, 0.0
        self.n_steps = self.n_actions = 0
        self.made.append(self)

    def step(self, inputs: Sequence[tuple[Any, ...]]) -> list[dict[str, torch.Tensor]]:
        assert not self.released
        self.n_steps += 1
        return [Execution.of(each)(each, *own) for each, own in zip(self.learners, inputs, strict=True)]

    def act(self, inputs: Sequence[tuple[Any, ...]]) -> list[dict[str, torch.Tensor]]:
        assert not self.released
        self.n_actions += 1
        return [each.action_step(*own) for each, own in zip(self.learners, inputs, strict=True)]

    def release(self) -> None:
        assert not self.released
        self.released = True


@pytest.fixture(params=sampled(("each its own", "together"), ("together",)))
def joint(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Gradient steps that each learner takes by itself, or that are taken together."""
    monkeypatch.setattr(OneAfterTheOther, "made", [])
    if request.param == "together":
        monkeypatch.setattr(many, "joint_of", OneAfterTheOther)
        return OneAfterTheOther
    return None


class Noting(BaseCallback):
    """Notes the generators of the process at each step, and what an evaluation has found."""

    def __init__(self) -> None:
        super().__init__()
        self.drawn: list[tuple[float, float, float]] = []
        self.generators: Any = None
        self.returns: list[float] = []

    def _on_step(self) -> bool:
        if self.n_calls % 7 == 0:
            # An odd number of normal ones, of which NumPy and Python make two at once.
            self.drawn.append((random.gauss(0, 1), np.random.normal(), float(torch.rand(()))))
            self.returns += [each.last_mean_reward for each in self.evaluations]
        return True

    def _on_training_start(self) -> None:
        self.evaluations = [each for each in self.locals["callback"].callbacks if isinstance(each, EvalCallback)]

    def _on_training_end(self) -> None:
        self.generators = training_state.save_generators(torch.device("cpu"))


def same(a: Any, b: Any) -> bool:
    """Equality bit by bit of nested values."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    return bool(a == b)


def learned(model: Any) -> dict[str, Any]:
    """Everything of a model that a training has made."""
    buffer = model.replay_buffer
    rows = {name: value for name, value in vars(buffer).items() if isinstance(value, np.ndarray) and name != "slot"}
    counts = (model.num_timesteps, model._n_updates, model.num_transitions, buffer.pos, buffer.full)
    return {"state": state(model), "rows": rows, "counts": counts}


CASES: dict[str, tuple[Any, dict[str, Any], int]] = {
    "SAC": (SAC, TINY_SAC, 1),
    "BRO": (BRO, {**TINY_BRO, "resets": (25,), "replay_ratio": 2}, 2),
    "VPLSAC": (VPLSAC, {**TINY_SAC, "validation_proportion": 0.25, "pessimism_learning_rate": 1e-2}, 2),
    "DebiasedRQ": (DebiasedRQ, {**TINY_SAC, **TINY_DR_Q}, 1),
    "episodes": (SAC, {**TINY_SAC, "replay_ratio": None, "train_freq": (1, "episode"), "gradient_steps": -1}, 1),
}


@functools.cache
def alone(name: str) -> list[tuple[dict[str, Any], Noting]]:
    """What each learner of a case is when it trains alone."""
    cls, arguments, n_envs = CASES[name]
    found = []
    for seed in SEEDS:
        model = cls("MlpPolicy", DummyVecEnv([lambda: Monitor(Drawing())] * n_envs), seed=seed, **arguments)
        evaluated = DummyVecEnv([lambda: Monitor(Drawing())])
        evaluated.seed(seed)
        noting = Noting()
        evaluation = EvalCallback(evaluated, n_eval_episodes=2, eval_freq=EVERY // n_envs, verbose=0)
        model.learn(STEPS, [noting, evaluation])
        assert model._n_updates > 10
        assert len(noting.drawn) > 2
        assert len(set(noting.returns)) > 1
        found.append((learned(model), noting))
    return found


@pytest.mark.parametrize("name", sampled(CASES, ("BRO", "VPLSAC", "episodes")))
def test_each_learner_is_what_it_is_alone(name: str, joint: Any) -> None:
    cls, arguments, n_envs = CASES[name]
    noting = [Noting() for _ in SEEDS]
    before = training_state.save_generators(torch.device("cpu"))
    models = train_many(
        cls, "MlpPolicy", Drawing, seeds=SEEDS, total_timesteps=STEPS, n_envs=n_envs, eval_env=Drawing,
        eval_freq=EVERY, n_eval_episodes=2, callback=lambda i: noting[i], **arguments,
    )  # fmt: skip
    assert same(before, training_state.save_generators(torch.device("cpu")))
    assert [model.seed for model in models] == list(SEEDS)
    for model, noted, (own, by_itself) in zip(models, noting, alone(name), strict=True):
        assert same(learned(model), own)
        assert same(noted.drawn, by_itself.drawn)
        assert same(noted.generators, by_itself.generators)
        assert noted.returns == by_itself.returns
    if joint is not None:
        assert sum(each.n_steps for each in joint.made) > 10
        # With whole episodes they are at different steps.
        assert sum(each.n_actions for each in joint.made) > (0 if name == "episodes" else 10)
        assert all(each.released for each in joint.made)


class Forked(SubprocVecEnv):
    """Workers that are there at once."""

    def __init__(self, env_fns: Any):
        super().__init__(env_fns, start_method="fork")


def test_worker_processes() -> None:
    models = train_many(
        SAC, "MlpPolicy", Toy, seeds=SEEDS, total_timesteps=30, n_envs=2, vec_env_cls=Forked, **TINY_SAC
    )
    for model, seed in zip(models, SEEDS, strict=True):
        assert isinstance(model.env.unwrapped, SubprocVecEnv)
        own = SAC("MlpPolicy", DummyVecEnv([lambda: Monitor(Toy())] * 2), seed=seed, **TINY_SAC).learn(30)
        assert same(learned(model), learned(own))
        # It goes on alone.
        model.learn(10, reset_num_timesteps=False)
        model.env.close()


#: What vectorised environments were asked, in this order.
ASKED: list[tuple[str, int]] = []


class Recording(DummyVecEnv):
    """Writes down what it is asked."""

    def step_async(self, actions: np.ndarray) -> None:
        ASKED.append(("async", id(self)))
        super().step_async(actions)

    def step_wait(self) -> Any:
        ASKED.append(("wait", id(self)))
        return super().step_wait()


def test_environments_of_all_step_together() -> None:
    ASKED.clear()
    models = train_many(SAC, "MlpPolicy", Toy, seeds=SEEDS, total_timesteps=20, vec_env_cls=Recording, **TINY_SAC)
    envs = [id(model.env.unwrapped) for model in models]
    asked = collections.Counter[tuple[str, int]]()
    for what, env in ASKED:
        asked[what, env] += 1
        if what == "wait":
            # Those of the others are under way, or have come this far already.
            assert all(asked["async", other] >= asked["wait", env] for other in envs)
    assert len(ASKED) == 3 * 2 * 20


def test_normalised_environments_and_further_training() -> None:
    def make() -> VecNormalize:
        return VecNormalize(DummyVecEnv([Drawing]))

    models = train_many(SAC, "MlpPolicy", make, seeds=(1, 2), total_timesteps=25, **TINY_SAC)
    for model, seed in zip(models, (1, 2), strict=True):
        own = SAC("MlpPolicy", make(), seed=seed, **TINY_SAC).learn(25)
        assert same(learned(model), learned(own))
        assert same(model.env.obs_rms.mean, own.env.obs_rms.mean)


def test_numbers_that_differ_by_learner() -> None:
    models = train_many(
        SAC, "MlpPolicy", Toy, seeds=(4, 5), total_timesteps=20,
        per_learner={"learning_rate": [1e-3, 1e-4], "gamma": [0.9, 0.99]}, **TINY_SAC,
    )  # fmt: skip
    assert [(model.learning_rate, model.gamma) for model in models] == [(1e-3, 0.9), (1e-4, 0.99)]
    own = SAC("MlpPolicy", Toy(), seed=5, learning_rate=1e-4, gamma=0.99, **TINY_SAC).learn(20)
    assert same(learned(models[1]), learned(own))


def test_noise_of_actions_is_each_learners_own() -> None:
    def noise() -> OrnsteinUhlenbeckActionNoise:
        return OrnsteinUhlenbeckActionNoise(np.zeros(2), np.full(2, 0.5))

    shared = noise()
    models = train_many(
        SAC, "MlpPolicy", Toy, seeds=(1, 2), total_timesteps=20, action_noise=shared, **TINY_SAC,
    )  # fmt: skip
    assert same(shared.noise_prev, noise().noise_prev)
    for model, seed in zip(models, (1, 2), strict=True):
        own = SAC("MlpPolicy", Toy(), seed=seed, action_noise=noise(), **TINY_SAC).learn(20)
        assert same(learned(model), learned(own))
        assert same(model.action_noise.noise_prev, own.action_noise.noise_prev)


def test_a_learner_that_its_callback_stops(joint: Any) -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return self.n_calls < 15

    models = train_many(
        SAC, "MlpPolicy", Toy, seeds=SEEDS, total_timesteps=30, callback=lambda i: Stop() if i == 1 else None,
        **TINY_SAC,
    )  # fmt: skip
    assert [model.num_timesteps for model in models] == [30, 15, 30]
    if joint is not None:
        assert [len(each.learners) for each in joint.made if each.n_steps] == [3, 2]


def test_the_last_learner_may_leave_while_the_others_wait_to_act(monkeypatch: pytest.MonkeyPatch) -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return self.n_calls < 16

    monkeypatch.setattr(many, "joint_of", LearnerGroup)
    models = train_many(
        SAC, "MlpPolicy", Toy, seeds=SEEDS, total_timesteps=24, callback=lambda i: Stop() if i == 2 else None,
        **{**TINY_SAC, "replay_ratio": 0.25},
    )  # fmt: skip
    assert [model.num_timesteps for model in models] == [24, 24, 16]


def test_a_model_that_is_trained_within_a_callback() -> None:
    """It is none of the group's."""

    class Inner(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls == 12:
                self.inner = SAC("MlpPolicy", Toy(), seed=0, **TINY_SAC).learn(15)
            return True

    own = SAC("MlpPolicy", Toy(), seed=0, **TINY_SAC).learn(15)
    callbacks = [Inner(), Inner()]

    def make(index: int) -> Inner:
        before = SAC("MlpPolicy", Toy(), seed=0, **TINY_SAC).learn(15)
        assert same(learned(before), learned(own))
        return callbacks[index]

    train_many(SAC, "MlpPolicy", Toy, seeds=(1, 2), total_timesteps=20, callback=make, **TINY_SAC)
    for each in callbacks:
        assert same(learned(each.inner), learned(own))


class Poisoned(Toy):
    """The second one gives rewards that no network can learn, from a step on."""

    made = 0

    def __init__(self) -> None:
        Poisoned.made += 1
        self.poisoned = Poisoned.made == 2
        super().__init__()

    def step(self, action: np.ndarray) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, 1e38 if self.poisoned and self.total > 15 else reward, *rest


def test_a_learner_that_diverges(joint: Any) -> None:
    Poisoned.made = 0
    with pytest.warns(UserWarning, match="diverged") as warned:
        models = train_many(SAC, "MlpPolicy", Poisoned, seeds=SEEDS, total_timesteps=40, **TINY_SAC)
    texts = [str(each.message) for each in warned if "diverged" in str(each.message)]
    assert len(texts) == 2
    assert "The learner of seed 0 is stopped, and the others go on" in texts[0]
    assert texts[1].startswith("1 of 3 learners have diverged, and are returned as they were then. seed 0: ")
    assert models[1].num_timesteps < 40
    for i in (0, 2):
        own = SAC("MlpPolicy", Toy(), seed=SEEDS[i], **TINY_SAC).learn(40)
        assert same(learned(models[i]), learned(own))


class Raising(BaseCallback):
    """Raises at a step."""

    def _on_step(self) -> bool:
        if self.n_calls == 15:
            raise LookupError("what was looked for")
        return True


def test_a_learner_whose_callback_raises(joint: Any) -> None:
    with (
        pytest.warns(UserWarning, match="the learner of seed 0 has ended by LookupError"),
        pytest.raises(LookupError, match="what was looked for"),
    ):
        train_many(
            SAC, "MlpPolicy", Toy, seeds=SEEDS, total_timesteps=30, callback=lambda i: Raising() if i == 1 else None,
            **TINY_SAC,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"seeds": ()}, "seeds must have at least one seed, one a learner, and is empty"),
        ({"seeds": 3}, "seeds must be a list of seeds, one a learner, such as range.10., not 3"),
        ({"seeds": (1, 2, 1)}, "seeds must differ, one a learner, but has 1 more than once"),
        ({"seeds": (1, -2)}, "each of seeds must be an integer of at least 0 and at most"),
        ({"seed": 3}, "seed=3 means nothing beside seeds"),
        ({"per_learner": {"gamma": [0.9]}}, r"per_learner\['gamma'\] must be a list of 2 values, one a seed, not"),
        ({"per_learner": {"gamma": 0.9}}, r"per_learner\['gamma'\] must be a list of 2 values, one a seed, not 0.9"),
        ({"per_learner": [1, 2]}, "per_learner must be a dict of lists"),
        ({"per_learner": {"seed": [1, 2]}}, "per_learner has 'seed', which is none of it: pass seeds"),
        ({"gamma": 0.9, "per_learner": {"gamma": [0.9, 0.9]}}, "gamma is both in per_learner and an argument"),
        ({"per_learner": {"gamma": [0.9, 2]}}, r"gamma must lie in \[0, 1\], not 2"),
        ({"env": Toy()}, "env must be the id of an environment, or a function that makes one, not .*pass env=lambda"),
        ({"eval_env": Toy()}, "eval_env must be the id of an environment, or a function"),
        ({"eval_freq": 5}, "eval_freq and n_eval_episodes mean nothing without eval_env"),
        ({"eval_env": Toy, "eval_freq": 0}, "eval_freq must be an integer of at least 1, not 0"),
        ({"n_envs": 0}, "n_envs must be an integer of at least 1, not 0"),
        ({"n_envs": 2, "env": lambda: DummyVecEnv([Toy])}, "n_envs=2 is for env=<a function that makes a single"),
        ({"vec_env_cls": "subproc"}, "vec_env_cls must be a class of vectorised environments"),
        ({"callback": Noting()}, "callback must be a function that makes a learner's callback from its index"),
        ({"cls": MBMAPPO}, r"cls must be an off-policy algorithm of this package, .*, not sb3_sample\..*MBMAPPO"),
        ({"cls": SB3SAC}, r"cls must be an off-policy algorithm of this package, .*, not stable_baselines3\..*\.SAC"),
        ({"cls": "SAC"}, "cls must be an off-policy algorithm of this package, .*, not 'SAC'"),
        ({"checkpoint_freq": 5}, "checkpoint_freq=5 means nothing without checkpoint"),
    ],
)
def test_what_is_refused(arguments: dict[str, Any], words: str) -> None:
    given = {"cls": SAC, "policy": "MlpPolicy", "env": Toy, "seeds": (1, 2), "total_timesteps": 5, **TINY_SAC}
    with pytest.raises(ValueError, match=words):
        train_many(**{**given, **arguments})


def test_what_the_constructor_refuses() -> None:
    with pytest.raises(TypeError, match="SAC: .*'learning_rat'. Did you mean 'learning_rate'"):
        train_many(SAC, "MlpPolicy", Toy, seeds=(1, 2), total_timesteps=5, learning_rat=1.0)


def test_arguments_of_learn_that_are_not_taken_are_refused() -> None:
    words = "train_many: .*'progress_bar', an argument of learn, of which it takes total_timesteps, callback, log_inter"
    with pytest.raises(TypeError, match=words):
        train_many(SAC, "MlpPolicy", Toy, seeds=(1, 2), total_timesteps=5, progress_bar=True)


def test_what_cannot_be_taken_together(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(learners: Sequence[Any]) -> Any:
        raise ValueError(f"{len(learners)} learners: critic_network=Own cannot be batched")

    monkeypatch.setattr(many, "joint_of", refuse)
    seen: list[int] = []
    with pytest.raises(ValueError, match="2 learners: critic_network=Own cannot be batched"):
        train_many(
            SAC, "MlpPolicy", Toy, seeds=(1, 2), total_timesteps=5,
            callback=lambda i: lambda *_: seen.append(i), **TINY_SAC,
        )  # fmt: skip
    assert seen == []


# ---------------------------------------------------------------- checkpoints


class Signal(BaseCallback):
    """Sends this process a signal at a step."""

    def __init__(self, at: int, number: int):
        super().__init__()
        self.at, self.number = at, number

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            os.kill(os.getpid(), self.number)
        return True

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


def trained(folder: Path, callback: Any = None, **arguments: Any) -> list[Any]:
    given = {"seeds": SEEDS, "total_timesteps": 60, "checkpoint_freq": 10, **TINY_SAC, **arguments}
    return train_many(SAC, "MlpPolicy", Toy, checkpoint=folder, callback=callback, **given)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return [learned(model) for model in trained(tmp_path_factory.mktemp("whole"))]


def saved(folder: Path) -> list[list[int]]:
    """Steps of the checkpoints of each run."""
    return [sorted(int(path.name[-12:]) for path in (folder / f"seed-{seed}").glob("checkpoint-*")) for seed in SEEDS]


@pytest.mark.parametrize(
    ("number", "index", "joint"),
    [
        pytest.param(signal.SIGINT, 0, "each its own", marks=pytest.mark.slow),
        (signal.SIGINT, 1, "together"),
        pytest.param(signal.SIGTERM, 2, "together", marks=pytest.mark.slow),
    ],
    indirect=["joint"],
)
def test_a_signal_saves_all_at_the_same_step(number: int, index: int, tmp_path: Path, joint: Any, whole: Any) -> None:
    before = signal.getsignal(number)
    expected = KeyboardInterrupt if number == signal.SIGINT else SystemExit
    with pytest.raises(expected):
        trained(tmp_path, lambda i: Signal(33, number) if i == index else Signal(0, number))
    assert signal.getsignal(number) is before
    steps = saved(tmp_path)
    assert len({each[-1] for each in steps}) == 1
    assert steps[0][-1] in (33, 34)
    models = trained(tmp_path, lambda i: Signal(0, number))
    assert all(same(learned(model), own) for model, own in zip(models, whole, strict=True))
    assert {each[-1] for each in saved(tmp_path)} == {60}


def test_all_go_on_from_the_newest_step_that_every_folder_has(tmp_path: Path, joint: Any, whole: Any) -> None:
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path, lambda i: Signal(43 if i == 0 else 0, signal.SIGINT))
    steps = saved(tmp_path)
    assert {tuple(each) for each in steps} == {(40, steps[0][1])}
    # As if it had been killed before the last one of a run was written.
    shutil.rmtree(tmp_path / "seed-0" / f"checkpoint-{steps[0][1]:012d}")
    seen: list[int] = []
    models = trained(tmp_path, lambda i: First(seen))
    assert seen == [41, 41, 41]
    assert all(same(learned(model), own) for model, own in zip(models, whole, strict=True))


@pytest.mark.parametrize("joint", ["together"], indirect=True)
def test_a_relative_folder_goes_on_together_too(tmp_path: Path, joint: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for at in (33, 0):
        joint.made.clear()
        with pytest.raises(KeyboardInterrupt) if at else contextlib.nullcontext():
            trained(Path("runs"), lambda i, at=at: Signal(at if i == 0 else 0, signal.SIGINT))
        # Ten random steps come first.
        assert sum(each.n_steps for each in joint.made) == (23 if at else 27)


def test_a_signal_after_the_last_turn_ends_the_program(tmp_path: Path) -> None:
    class Late(Signal):
        def _on_training_end(self) -> None:
            os.kill(os.getpid(), self.number)

    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path, lambda i: Late(0, signal.SIGINT) if i == 2 else Signal(0, 0), total_timesteps=20)
    assert {each[-1] for each in saved(tmp_path)} == {20}


class First(Signal):
    """Notes the first step."""

    def __init__(self, seen: list[int]):
        super().__init__(0, 0)
        self.seen = seen

    def _on_training_start(self) -> None:
        self.first = True

    def _on_step(self) -> bool:
        if self.first:
            self.seen.append(self.num_timesteps)
        self.first = False
        return True


@pytest.mark.parametrize("joint", ["together"], indirect=True)
def test_runs_of_which_one_has_diverged_go_on(tmp_path: Path, joint: Any, whole: Any) -> None:
    """It has left the others: it goes on from its own checkpoint, to the same end, and holds up nobody."""
    found = []
    for steps in (40, 60):
        Poisoned.made = 0
        with pytest.warns(UserWarning, match="1 of 3 learners have diverged, .* seed 0"):
            models = train_many(
                SAC, "MlpPolicy", Poisoned, seeds=SEEDS, total_timesteps=steps, checkpoint=tmp_path,
                checkpoint_freq=10, **TINY_SAC,
            )  # fmt: skip
        found.append(learned(models[1]))
        newest = [each[-1] for each in saved(tmp_path)]
        assert newest[0] == newest[2] == steps
        assert newest[1] == 10
    # Not a number is not equal to itself.
    assert repr(found[0]["counts"]) == repr(found[1]["counts"])
    for i in (0, 2):
        assert same(learned(models[i]), whole[i])


@pytest.mark.parametrize("joint", ["together"], indirect=True)
def test_a_failure_has_the_others_save(tmp_path: Path, joint: Any, whole: Any) -> None:
    """All go on from there, whatever the checkpoints before."""
    for folder, every in (tmp_path / "often", 10), (tmp_path / "never", 1000):
        with pytest.warns(UserWarning, match="has ended by LookupError. The others are s"), pytest.raises(LookupError):
            trained(folder, lambda i: Raising() if i == 1 else Signal(0, 0), checkpoint_freq=every)
        assert [each[-1] for each in saved(folder)] == [16, 15, 16]
        seen: list[int] = []
        models = trained(folder, lambda i: First(seen), checkpoint_freq=every)  # noqa: B023
        assert sorted(seen) == [16, 17, 17]
        assert all(same(learned(model), own) for model, own in zip(models, whole, strict=True))


def test_turns_of_different_lengths_go_on_each_from_its_own_checkpoint(tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"per_learner": {"train_freq": [1, 3, 7]}, "replay_ratio": None}
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "parts", lambda i: Signal(33 if i == 0 else 0, signal.SIGINT), **arguments)
    newest = [each[-1] for each in saved(tmp_path / "parts")]
    assert min(newest) >= 33 and all(len(each) <= 2 for each in saved(tmp_path / "parts"))
    seen: list[int] = []
    models = trained(tmp_path / "parts", lambda i: First(seen), **arguments)
    assert sorted(seen) == sorted(steps + 1 for steps in newest)
    ends = trained(tmp_path / "whole", lambda i: Signal(0, 0), **arguments)
    assert all(same(learned(model), learned(end)) for model, end in zip(models, ends, strict=True))


def write(run: Path, *steps: int, beside: Sequence[Path] = ()) -> list[int]:
    """Write checkpoints of a run, in words of no meaning. Returns the steps of those that are there then."""
    folder = RunFolder(run)
    folder.beside = lambda: beside
    for number in steps:
        files = {name: (lambda file: file.write(b"of any kind")) for name in ("model.zip", "state.zip")}
        folder.write(number, files, {}, {"circumstances": {}})
    folder.close()
    return [number for number, _ in reversed(folder.checkpoints())]


def test_checkpoints_are_kept_until_all_runs_have_newer_ones(tmp_path: Path) -> None:
    x, y, z = (tmp_path / name for name in "xyz")
    # The others have none so far.
    assert write(x, 0, 10, 20, 30, beside=[y, z]) == [0, 10, 20, 30]
    write(y, 0, 10)
    assert write(x, 40, beside=[y, z]) == [0, 10, 20, 30, 40]
    write(z, 10, 20)
    assert write(x, 50, beside=[y, z]) == [10, 20, 30, 40, 50]
    write(y, 20, 30, beside=[x, z])
    assert common_starts([x, y, z]).steps == 20
    write(z, 30, 40, 50, beside=[x, y])
    write(y, 40, 50, beside=[x, z])
    assert write(x, 60, beside=[y, z]) == [50, 60]
    # One that trains alone.
    assert write(tmp_path / "alone", 10, 20, 30) == [20, 30]


def mark(run: Path, left: bool) -> None:
    folder = RunFolder(run)
    folder.set_left(left)
    folder.close()


def test_where_runs_go_on(tmp_path: Path) -> None:
    x, y, z = (tmp_path / name for name in "xyz")
    assert common_starts([x, y, z]) == (0, {})
    write(x, 20, 30)
    write(y, 10, 20)
    found = common_starts([x, y, z])
    assert (found.steps, found.paths.keys()) == (20, {x, y})
    # One that has left the others.
    write(z, 20, 30)
    write(x, 80, 90)
    write(y, 80)
    found = common_starts([x, y, z])
    assert (found.steps, found.paths.keys()) == (80, {x, y})
    run = RunFolder(x)
    assert run.manifest_of(found.paths[x])["steps"] == 80
    run.go_back_to(80)
    run.close()
    assert write(x) == [80]
    # Damaged.
    write(x, 90)
    write(y, 90)
    (x / "checkpoint-000000000090" / "model.zip").write_bytes(b"of other kind")
    with pytest.warns(UserWarning, match=r"model.zip is damaged: .*\. The runs go on from 80 steps instead"):
        assert common_starts([x, y]).steps == 80


def test_where_runs_go_on_some_of_which_have_left(tmp_path: Path) -> None:
    x, y, z = (tmp_path / name for name in "xyz")

    def found() -> tuple[int, str]:
        starts = common_starts([x, y, z])
        assert all(path.parent == run and path.name.endswith(f"{starts.steps}") for run, path in starts.paths.items())
        return starts.steps, "".join(sorted(run.name for run in starts.paths))

    write(x, 0, 80)
    write(y, 0, 100)
    write(z, 0, 100)
    assert found() == (0, "xyz")
    mark(x, True)
    assert found() == (100, "yz")
    mark(z, True)
    # It stands where the others do.
    assert found() == (100, "yz")
    write(y, 110)
    assert found() == (110, "y")
    # All have left, perhaps together.
    write(z, 110)
    mark(y, True)
    assert found() == (110, "yz")
    mark(x, False)
    assert found() == (80, "x")


def test_one_environment_for_two_learners_is_refused() -> None:
    for env in (Toy(), vec(2)):
        with pytest.raises(ValueError, match="env must make an environment at each call, and gave the same one to two"):
            train_many(SAC, "MlpPolicy", lambda env=env: env, seeds=[0, 1], total_timesteps=20, **TINY_SAC)


def test_what_is_given_to_two_learners_is_refused() -> None:
    one = Raising()
    for shared in (one, [Raising(), one], CallbackList([one])):
        with pytest.raises(ValueError, match="callback must make a callback at each call, and gave the same one to tw"):
            train_many(
                SAC,
                "MlpPolicy",
                Toy,
                seeds=[0, 1],
                total_timesteps=20,
                callback=lambda i, shared=shared: shared,
                **TINY_SAC,
            )
    evaluated = Toy()
    with pytest.raises(
        ValueError, match="eval_env must make an environment at each call, and gave the same one to two"
    ):
        train_many(SAC, "MlpPolicy", Toy, seeds=[0, 1], total_timesteps=20, eval_env=lambda: evaluated, **TINY_SAC)
    # A function is none's own.
    seen: list[int] = []

    def note(variables: Any, _: Any) -> bool:
        return not seen.append(variables["self"].seed)  # type: ignore[func-returns-value]

    train_many(SAC, "MlpPolicy", Toy, seeds=[0, 1], total_timesteps=20, callback=lambda i: note, **TINY_SAC)
    assert seen.count(0) == seen.count(1) == 20
