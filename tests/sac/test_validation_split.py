"""Transitions held out of training: which, how many, for how long, and that training never sees them."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_sample.learner.pessimism import LearnedPessimism
from sb3_sample.replay.buffers import (
    DeviceReplayBuffer,
    DeviceValidationReplayBuffer,
    ValidationDictReplayBuffer,
    ValidationReplayBuffer,
    ValidationSplit,
    latest,
    samples_at,
)
from sb3_sample.replay.columns import Column
from sb3_sample.replay.compact import CompactReplayBuffer
from sb3_sample.sac import BRO, SAC, VPLSAC
from tests.sac.common import TINY_BRO, TINY_SAC, differing, sac, state, vec


class Tagged(gym.Env):
    """Every step has its own reward, ``10000 * env + number``; the observation is (env, episode, step)."""

    def __init__(self, env_id: int = 0, length: int = 7, truncate: bool = False, as_dict: bool = False):
        box = spaces.Box(-1e6, 1e6, (3,), np.float32)
        self.observation_space = spaces.Dict({"a": box, "b": box}) if as_dict else box
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.env_id, self.length, self.truncate, self.as_dict = env_id, length, truncate, as_dict
        self.episode = -1
        self.total = self.t = 0

    def _observation(self) -> Any:
        observation = np.array([self.env_id, self.episode, self.t], np.float32)
        return {"a": observation, "b": -observation} if self.as_dict else observation

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        self.episode += 1
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        self.total += 1
        over = self.t >= self.length
        reward = 10000.0 * self.env_id + self.total
        return self._observation(), reward, over and not self.truncate, over and self.truncate, {}


def tagged(lengths: tuple[int, ...] = (7,), truncate: bool = False, as_dict: bool = False) -> DummyVecEnv:
    """One environment for each length of episode."""
    return DummyVecEnv(
        [lambda i=i, n=n: Monitor(Tagged(i, n, truncate, as_dict)) for i, n in enumerate(lengths)]  # type: ignore[misc]
    )


class Written(KVWriter):
    """A log in memory."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0) -> None:
        self.rows.append(dict(key_values))


def vpl(env: Any = None, **kwargs: Any) -> VPLSAC:
    """A tiny VPL-SAC that holds out a quarter and moves its pessimism quickly."""
    own = {"seed": 0, **TINY_SAC, "validation_proportion": 1 / 4}
    if kwargs.get("pessimism", "vpl") == "vpl":
        own["pessimism_learning_rate"] = 1e-2
    return VPLSAC(kwargs.pop("policy", "MlpPolicy"), vec() if env is None else env, **{**own, **kwargs})


def make_buffer(size: int, n_envs: int, p: float) -> ValidationReplayBuffer:
    space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    return ValidationReplayBuffer(
        size, space, spaces.Box(-1, 1, (1,)), device="cpu", n_envs=n_envs, validation_proportion=p
    )


def add(buffer: ReplayBuffer, tags: np.ndarray) -> None:
    """Store one transition of each environment, its tag in every field that can hold it."""
    column = tags[:, None].astype(np.float32)
    zeros = np.zeros(len(tags))
    buffer.add(column, column + 0.5, 0 * column, tags.astype(np.float32), zeros, [{} for _ in tags])


def held_tags(buffer: ValidationReplayBuffer) -> set[int]:
    return set(buffer.rewards[buffer.held_out].astype(int).tolist())


# ------------------------------------------------------------------ the buffer


@pytest.mark.parametrize(("size", "n_envs", "p"), [(20, 3, 0.3), (7, 1, 0.5), (1, 1, 0.5), (12, 4, 0.9), (50, 2, 0.02)])
def test_long_random_run_against_brute_force(size: int, n_envs: int, p: float) -> None:
    """The buffer wraps around many times; each step its counters, mask and samples are compared with a plain list."""
    np.random.seed(size)
    buffer = make_buffer(size, n_envs, p)
    rows = max(size // n_envs, 1)
    side: dict[int, bool] = {}  # every transition's side, decided once
    for step in range(25 * rows + 3):
        tags = 1 + step * n_envs + np.arange(n_envs)
        place = buffer.pos
        add(buffer, tags)
        side.update(zip(tags.tolist(), buffer.held_out[place].tolist(), strict=True))
        alive = [tag for tag in side if tag > (step + 1 - rows) * n_envs]
        held, training = {t for t in alive if side[t]}, {t for t in alive if not side[t]}
        assert (buffer.n_validation, buffer.n_training) == (len(held), len(training))
        assert held_tags(buffer) == held
        for wanted, sample in ((held, buffer.sample_validation), (training, buffer.sample)):
            if not wanted:
                with pytest.raises(ValueError, match="no transition"):
                    sample(3)
                continue
            drawn = sample(30)
            assert drawn.rewards.shape == (30, 1) and drawn.dones.shape == (30, 1)
            seen = drawn.rewards.flatten().int().tolist()
            assert set(seen) <= wanted
            # The row is one transition's: all its fields carry the same tag.
            torch.testing.assert_close(drawn.observations, drawn.rewards)
            torch.testing.assert_close(drawn.next_observations, drawn.rewards + 0.5)
    assert 0 < sum(side.values()) < len(side)


def test_both_samples_are_uniform() -> None:
    np.random.seed(1)
    buffer = make_buffer(30, 3, 0.4)
    for step in range(25):  # wrapped around twice and a half
        add(buffer, 1 + step * 3 + np.arange(3))
    for sample, n in ((buffer.sample, buffer.n_training), (buffer.sample_validation, buffer.n_validation)):
        counts = np.unique(sample(2000 * n).rewards.numpy(), return_counts=True)[1]
        assert len(counts) == n
        # Binomial: mean 2000, deviation below sqrt(2000) = 45; five of them.
        assert abs(counts - 2000).max() < 5 * 45, counts


@pytest.mark.parametrize("p", [1 / 128, *(pytest.param(p, marks=pytest.mark.slow) for p in (1 / 32, 1 / 8)), 1 / 2])
def test_share_held_out(p: float) -> None:
    np.random.seed(2)
    buffer = make_buffer(20000, 2, p)
    for step in range(10000):
        add(buffer, step * 2 + np.arange(2))
    assert abs(buffer.n_validation - 20000 * p) < 5 * np.sqrt(20000 * p * (1 - p))
    # Each environment by itself, and independently of the other.
    assert (abs(buffer.held_out.sum(axis=0) - 10000 * p) < 5 * np.sqrt(10000 * p * (1 - p))).all()
    both = buffer.held_out.all(axis=1).sum()
    assert abs(both - 10000 * p**2) < 5 * np.sqrt(10000 * p**2) + 1


@pytest.mark.parametrize("kind", ["box", "memory", "dict", "validation"])
@pytest.mark.parametrize("normalize", [True, False])
def test_named_transitions_are_stable_baselines_own(kind: str, normalize: bool) -> None:
    """``samples_at`` against the buffer's own ``_get_samples`` for the same places."""
    venv: Any = tagged((3, 5), truncate=True, as_dict=kind == "dict")
    venv = VecNormalize(venv) if normalize else venv
    cls: Any = {"dict": DictReplayBuffer, "validation": ValidationReplayBuffer}.get(kind, ReplayBuffer)
    kwargs: dict[str, Any] = {"validation_proportion": 0.5} if kind == "validation" else {}
    if kind == "memory":
        kwargs = {"optimize_memory_usage": True, "handle_timeout_termination": False}
    buffer = cls(40, venv.observation_space, venv.action_space, device="cpu", n_envs=2, **kwargs)
    obs = venv.reset()
    for _ in range(33):  # more than the 20 rows
        actions = np.random.uniform(-1, 1, (2, 2)).astype(np.float32)
        new, rewards, dones, infos = venv.step(actions)
        if normalize:
            buffer.add(venv.unnormalize_obs(obs), venv.unnormalize_obs(new), actions, rewards, dones, infos)
        else:
            buffer.add(obs, new, actions, rewards, dones, infos)
        obs = new
    positions = np.random.randint(0, 20, 64)
    positions = positions[positions != buffer.pos] if kind == "memory" else positions
    vec_normalize = venv if normalize else None
    np.random.seed(5)
    envs = np.random.randint(0, 2, len(positions))
    np.random.seed(5)
    theirs = buffer._get_samples(positions, env=vec_normalize)
    ours = samples_at(buffer, positions, envs, vec_normalize)
    assert type(ours) is type(theirs)
    for name in ("observations", "actions", "next_observations", "dones", "rewards"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=0, atol=0)
    if kind != "memory":
        # Time limits are no terminations.
        assert not ours.dones.any() and buffer.dones.any()


def test_latest_over_the_seam() -> None:
    buffer = make_buffer(30, 3, 0.5)
    for step in range(13):  # 10 rows: the ring stands at row 3
        add(buffer, np.array([step, 100 + step, 200 + step]))
    samples, ends = latest(buffer, 5)
    assert samples.rewards.view(5, 3).tolist() == [[t, 100 + t, 200 + t] for t in range(8, 13)]
    assert ends.shape == (5, 3)


def test_latest_needs_as_many() -> None:
    buffer = make_buffer(30, 3, 0.5)
    add(buffer, np.arange(3))
    with pytest.raises(ValueError, match="1 steps, not 2"):
        latest(buffer, 2)


# ------------------------------------------------------------------ a model that trains


@pytest.mark.parametrize("lengths", [pytest.param((7,), marks=pytest.mark.slow), (3, 7, 10)])
@pytest.mark.parametrize("as_dict", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_training_never_sees_what_is_held_out(
    lengths: tuple[int, ...], as_dict: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over a run in which the buffer is overwritten several times, each transition is seen by one side only."""
    policy = "MultiInputPolicy" if as_dict else "MlpPolicy"
    model = vpl(tagged(lengths, as_dict=as_dict), policy=policy, buffer_size=40, replay_ratio=2)
    trained: set[float] = set()
    judged: set[float] = set()
    update, judge = model._update, LearnedPessimism._judge

    def spy_update(batch: Any, noise: Any = None) -> Any:
        assert batch.rewards.shape == (8, 1)
        trained.update(batch.rewards.flatten().tolist())
        if not as_dict:
            assert (batch.observations[:, 0] == batch.rewards.flatten() // 10000).all()
        return update(batch, noise)

    def spy_judge(learner: Any, batch: Any, *rest: Any) -> Any:
        assert batch.rewards.shape == (2, 1)
        judged.update(batch.rewards.flatten().tolist())
        return judge(learner, batch, *rest)

    monkeypatch.setattr(model, "_update", spy_update)
    monkeypatch.setattr(LearnedPessimism, "_judge", staticmethod(spy_judge))
    model.learn(210)
    assert isinstance(model.replay_buffer, ValidationDictReplayBuffer if as_dict else ValidationReplayBuffer)
    assert len(judged) > 15 and len(trained) > 80
    assert not judged & trained


def test_regret_run_holds_out_and_leaves_the_pessimism(monkeypatch: pytest.MonkeyPatch) -> None:
    model = vpl(tagged(), pessimism=1.0, buffer_size=60)
    trained: set[float] = set()
    held: set[float] = set()
    update = model._update

    def spy(batch: Any, noise: Any = None) -> Any:
        assert isinstance(model.replay_buffer, ValidationSplit)
        trained.update(batch.rewards.flatten().tolist())
        held.update(model.replay_buffer.rewards[model.replay_buffer.held_out].tolist())
        return update(batch, noise)

    monkeypatch.setattr(model, "_update", spy)
    model.learn(200)
    assert model.pessimism_rule.beta() == 1.0
    assert held and trained and not held & trained


@pytest.mark.parametrize("n_envs", [1, 2])
def test_nothing_held_out_and_fixed_pessimism_is_sac(n_envs: int) -> None:
    """The same seed, the same numbers, bit for bit after some learning."""
    ours = vpl(tagged((7, 5)[:n_envs]), validation_proportion=0, pessimism=1.0).learn(80)
    plain = sac(tagged((7, 5)[:n_envs])).learn(80)
    assert ours._n_updates == plain._n_updates > 60
    assert type(ours.replay_buffer) is CompactReplayBuffer
    assert not differing(state(ours), state(plain))
    # The comparison can fail.
    other = vpl(tagged((7, 5)[:n_envs]), pessimism=1.0).learn(80)
    assert differing(state(other), state(plain))


@pytest.mark.parametrize("as_dict", [False, True])
def test_the_split_is_saved_with_the_buffer(as_dict: bool, tmp_path: Path) -> None:
    policy = "MultiInputPolicy" if as_dict else "MlpPolicy"
    model = vpl(tagged((3, 5), as_dict=as_dict), policy=policy, buffer_size=60).learn(150)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = VPLSAC.load(tmp_path / "m", env=tagged((3, 5), as_dict=as_dict))
    assert isinstance(loaded.replay_buffer, ValidationSplit) and loaded.replay_buffer.n_validation == 0
    loaded.load_replay_buffer(tmp_path / "b")
    ours, theirs = model.replay_buffer, loaded.replay_buffer
    assert isinstance(ours, ValidationSplit) and isinstance(theirs, ValidationSplit)
    np.testing.assert_array_equal(ours.held_out, theirs.held_out)
    assert (ours.n_validation, ours.n_training) == (theirs.n_validation, theirs.n_training)
    assert ours.n_validation == ours.held_out.sum() > 0
    for method in ("sample", "sample_validation"):
        np.random.seed(0)
        mine = getattr(ours, method)(50).rewards
        np.random.seed(0)
        assert torch.equal(mine, getattr(theirs, method)(50).rewards)
    # It goes on counting.
    loaded.learn(100, reset_num_timesteps=False)
    assert theirs is loaded.replay_buffer and theirs.n_validation == theirs.held_out.sum()
    assert held_rewards(theirs, 400) == set(theirs.rewards[theirs.held_out].tolist())


def held_rewards(buffer: ValidationSplit, n: int) -> set[float]:
    return set(buffer.sample_validation(n).rewards.flatten().tolist())


def test_loaded_with_another_proportion(tmp_path: Path) -> None:
    vpl(pessimism=1.0).learn(20).save(tmp_path / "m")
    assert isinstance(VPLSAC.load(tmp_path / "m", env=vec()).replay_buffer, ValidationReplayBuffer)
    without = VPLSAC.load(tmp_path / "m", env=vec(), validation_proportion=0)
    assert type(without.replay_buffer) is CompactReplayBuffer
    with pytest.raises(ValueError, match=r"validation_proportion=1/32"):
        VPLSAC.load(tmp_path / "m", env=vec(), validation_proportion=0, pessimism="vpl")


class Counting(ValidationReplayBuffer):
    """A buffer of one's own."""

    n_added = 0

    def add(self, *args: Any) -> None:
        super().add(*args)
        self.n_added += 1


@pytest.mark.parametrize("base", [ValidationReplayBuffer, ValidationDictReplayBuffer, DeviceValidationReplayBuffer])
def test_a_class_of_ones_own_stays(base: Any) -> None:
    as_dict = base is ValidationDictReplayBuffer
    env, policy = tagged(as_dict=as_dict), "MultiInputPolicy" if as_dict else "MlpPolicy"
    own = Counting if base is ValidationReplayBuffer else type("Own", (base,), {})
    model = sac(env, policy=policy, validation_proportion=0.5, replay_buffer_class=own).learn(20)
    assert type(model.replay_buffer) is own and model.replay_buffer.n_validation > 0
    assert base is not ValidationReplayBuffer or model.replay_buffer.n_added == 20
    with pytest.raises(ValueError, match="validation_proportion=0.0, but .* is one that .* derive it from Compact"):
        sac(env, policy=policy, replay_buffer_class=own)


@pytest.mark.parametrize("columns", [(), (Column("note", lambda step: [1.0], in_batch=False),)])
@pytest.mark.parametrize("base", [CompactReplayBuffer, DeviceReplayBuffer])
def test_a_class_of_ones_own_that_holds_nothing_out_is_refused(base: Any, columns: Any) -> None:
    own = type("Own", (base,), {"more_columns": columns})
    with pytest.raises(ValueError, match="class=Own is not one that holds transitions out: derive it from Validation"):
        sac(validation_proportion=0.5, replay_buffer_class=own)


def test_one_proportion() -> None:
    kwargs = {"validation_proportion": 0.25}
    assert sac(**kwargs, replay_buffer_kwargs=kwargs).replay_buffer.validation_proportion == 0.25
    for proportion in (0.5, 0.0):
        with pytest.raises(ValueError, match="replay_buffer_kwargs has 'validation_proportion', which is the argument"):
            sac(validation_proportion=proportion, replay_buffer_kwargs=kwargs)


def test_bro_and_sac_can_hold_out_too() -> None:
    model = BRO("MlpPolicy", vec(), **{**TINY_BRO, "validation_proportion": 0.5, "seed": 0}).learn(30)
    assert isinstance(model.replay_buffer, ValidationReplayBuffer)
    assert 5 <= model.replay_buffer.n_validation <= 25
    assert isinstance(sac(validation_proportion=0.5).replay_buffer, ValidationReplayBuffer)


@pytest.mark.parametrize("p", [-0.1, 1.0, 1.5, float("nan")])
def test_bad_proportion(p: float) -> None:
    with pytest.raises(ValueError, match=f"validation_proportion.*{p}"):
        vpl(validation_proportion=p)


class Goal(gym.Env):
    observation_space = spaces.Dict(
        {k: spaces.Box(-10, 10, (2,), np.float32) for k in ("observation", "achieved_goal", "desired_goal")}
    )
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -np.linalg.norm(achieved - desired, axis=-1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), 0.0, False, False, {}


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [
        ({"n_steps": 3}, "n_steps=3"),
        ({"replay_buffer_class": NStepReplayBuffer, "replay_buffer_kwargs": {"n_steps": 3}}, "NStepReplayBuffer"),
        ({"replay_buffer_class": HerReplayBuffer}, "HerReplayBuffer"),
    ],
)
@pytest.mark.parametrize("pessimism", ["vpl", 1.0])
def test_refused_together_with(kwargs: dict[str, Any], named: str, pessimism: Any) -> None:
    is_her = kwargs.get("replay_buffer_class") is HerReplayBuffer
    env: Any = Goal() if is_her else vec()
    policy = "MultiInputPolicy" if is_her else "MlpPolicy"
    with pytest.raises(ValueError, match=named):
        vpl(env, policy=policy, pessimism=pessimism, **kwargs)
    # And where it is changed at load.
    if kwargs == {"n_steps": 3}:
        with pytest.raises(ValueError, match=r"validation_proportion=0\.5"):
            sac(n_steps=3, validation_proportion=0.5)


@pytest.mark.parametrize("as_dict", [False, True])
def test_vec_normalize_reaches_what_is_held_out(as_dict: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    env = VecNormalize(tagged((4, 6), as_dict=as_dict), gamma=0.9)
    model = vpl(env, policy="MultiInputPolicy" if as_dict else "MlpPolicy").learn(60)
    split = model.replay_buffer
    assert isinstance(split, ValidationSplit)
    np.random.seed(0)
    raw = split.sample_validation(20)
    np.random.seed(0)
    normalized = split.sample_validation(20, env=env)
    assert raw.rewards.abs().max() >= 20 > 10 >= normalized.rewards.abs().max()
    np.testing.assert_allclose(normalized.rewards, env.normalize_reward(raw.rewards.numpy()), rtol=1e-6)
    for name in ("observations", "next_observations"):
        plain: Any = getattr(raw, name)
        plain = {k: v.numpy() for k, v in plain.items()} if as_dict else plain.numpy()
        expected = env.normalize_obs(plain)
        for key in "ab" if as_dict else [()]:
            got = getattr(normalized, name)
            got, wanted = (got[key], expected[key]) if as_dict else (got, expected)
            np.testing.assert_allclose(got, wanted, rtol=1e-5, atol=1e-6)
    # The update asks with the same normalisation.
    asked: list[Any] = []
    sample = split.sample_validation
    monkeypatch.setattr(split, "sample_validation", lambda n, env=None: (asked.append((n, env)), sample(n, env))[1])
    model.train(3, 8)
    assert asked == [(2, env)] * 3


@pytest.mark.parametrize("pessimism", ["vpl", 1.0])
def test_size_is_logged(pessimism: Any) -> None:
    log = Written()
    model = vpl(pessimism=pessimism)
    model.set_logger(Logger(None, [log]))
    model.learn(70, log_interval=1)
    assert isinstance(model.replay_buffer, ValidationSplit)
    sizes = [row["validation/size"] for row in log.rows]
    assert len(sizes) == 10 and sizes[-1] == model.replay_buffer.n_validation > 0
    assert sizes == sorted(sizes)
    assert ("pessimism/beta" in log.rows[-1]) == (pessimism == "vpl")


def test_size_is_not_logged_without_a_split() -> None:
    log = Written()
    model = sac()
    model.set_logger(Logger(None, [log]))
    model.learn(14, log_interval=1)
    assert log.rows and not any("validation/size" in row for row in log.rows)


def test_everything_held_out_waits() -> None:
    """No gradient step is taken as long as there is nothing to train on."""
    np.random.seed(0)
    model = vpl(validation_proportion=0.9999, seed=None)
    model.learn(40)
    assert isinstance(model.replay_buffer, ValidationSplit) and isinstance(model, SAC)
    assert model.replay_buffer.n_training == 0 and model._n_updates == 0
