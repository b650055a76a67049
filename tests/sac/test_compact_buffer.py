"""The buffers that store each observation once, beside Stable-Baselines3's, which stores two."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample import SAC, CompactDictReplayBuffer, CompactReplayBuffer
from sb3_sample.replay.buffers import ValidationReplayBuffer, latest, samples_at
from tests.sac.common import sac, vec
from tests.sac.streams import ACTIONS, BOX, DICT, SPACES, Stream, assert_same, draw, pair, same_bits

# ---------------------------------------------------------------- the same transitions


@pytest.mark.parametrize(("rows", "n_envs"), [(50, 1), (11, 3), (1, 1), (1, 2), (2, 1), (400, 2)])
@pytest.mark.parametrize("space", SPACES)
def test_what_stable_baselines3s_buffer_holds(space: str, rows: int, n_envs: int) -> None:
    """Over long random runs, ring and all: the same samples from the same draws, and the same array when it is read."""
    ours, theirs = pair(SPACES[space], rows, n_envs)
    stream = Stream(SPACES[space], n_envs, seed=rows)
    for step in range(4 * rows + 7):
        transition = stream.transition()
        ours.add(*copy.deepcopy(transition))
        theirs.add(*copy.deepcopy(transition))
        # Nothing of the caller's is kept.
        if isinstance(transition[0], np.ndarray):
            transition[0][...] = transition[1][...] = 0
        assert (ours.pos, ours.full, ours.size()) == (theirs.pos, theirs.full, theirs.size())
        assert len(ours.aside) == (ours.slot >= n_envs).sum(), "no place aside is lost"
        if step % 13 == 0 or step < 5:
            assert same_bits(draw(ours, 64, step), draw(theirs, 64, step))
        if step % 29 == 0:
            n = ours.size()
            for key in SPACES[space] if space == "dict" else [None]:  # type: ignore[attr-defined]
                mine, array = (b.next_observations if key is None else b.next_observations[key] for b in (ours, theirs))
                assert same_bits(mine[:n], array[:n])


def test_the_comparison_can_fail() -> None:
    """A buffer that always takes the next row's observation is found out: by an episode's end, and by -0 for 0."""
    for following in (np.full((1, 3), 5), np.array([[0, -0.0, 0]])):
        ours, theirs = pair(BOX, 10, 1)
        for buffer in (ours, theirs):
            for t, after in ((-1, following), (0, np.ones((1, 3)))):
                buffer.add(np.zeros((1, 3)), after, np.zeros((1, 2)), np.array([t]), np.zeros(1), [{}])
        assert same_bits(draw(ours, 9, 0), draw(theirs, 9, 0))
        assert ours.slot[0, 0] > 0
        ours.slot[0, 0] = -1
        assert not same_bits(draw(ours, 9, 0), draw(theirs, 9, 0))


def test_only_what_differs_is_kept_twice() -> None:
    """Episodes of 50 steps: the memory kept aside stays that of the episodes that are in the buffer."""
    ours, _ = pair(BOX, 500, 2)
    space_aside = []
    for t in range(5000):
        start, end = t % 50 == 0, t % 50 == 49
        now, after = np.full((2, 3), t + 0.5 * start), np.full((2, 3), t + 1.0)
        ours.add(now, after, np.zeros((2, 2)), np.zeros(2), np.full(2, end), [{"TimeLimit.truncated": end}] * 2)
        space_aside.append(len(ours.aside.arrays[""]))
    assert (ours.slot >= 2).sum() == 2 * 9 and (ours.slot == -1).sum() == 2 * 490
    assert space_aside[-1] == space_aside[600] <= 64
    assert ours.observations.shape == (500, 2, 3)
    large = [k for k, v in vars(ours).items() if isinstance(v, np.ndarray) and v.size >= ours.observations.size]
    assert large == ["observations"]


@pytest.mark.parametrize("handle", [True, False])
@pytest.mark.parametrize("optimize", [True, False])
def test_arguments_of_stable_baselines3s_buffer(handle: bool, optimize: bool) -> None:
    ours = CompactReplayBuffer(
        40, BOX, ACTIONS, "cpu", 2, optimize_memory_usage=optimize, handle_timeout_termination=handle
    )
    theirs = ReplayBuffer(40, BOX, ACTIONS, "cpu", 2, handle_timeout_termination=handle)
    stream = Stream(BOX, 2, 0)
    for _ in range(50):
        transition = stream.transition()
        ours.add(*transition)
        theirs.add(*transition)
    assert same_bits(draw(ours, 200, 0), draw(theirs, 200, 0))
    assert handle == bool(ours.timeouts.any())


def test_reset_empties_it() -> None:
    for n_envs in (1, 3):
        ours, theirs = pair(DICT, 20, n_envs)
        stream = Stream(DICT, n_envs, 0)
        for step in range(75):
            if step in (1, 15, 50):
                ours.reset()
                theirs.reset()
                assert ours.size() == 0 and (ours.slot == -1).all()
            transition = stream.transition()
            ours.add(*transition)
            theirs.add(*transition)
            assert same_bits(draw(ours, 30, step), draw(theirs, 30, step))


# ---------------------------------------------------------------- reading the next observations


def test_indices() -> None:
    """Every way of indexing, against the array."""
    ours, theirs = pair(SPACES["float64"], 13, 3)
    stream = Stream(SPACES["float64"], 3, 0, ends=0.3)
    for _ in range(31):
        transition = stream.transition()
        ours.add(*transition)
        theirs.add(*transition)
    view, array = ours.next_observations, theirs.next_observations
    rng = np.random.default_rng(0)
    positions, envs = rng.integers(-13, 13, 40), rng.integers(-3, 3, 40)
    mask = rng.random((13, 3)) < 0.5
    for key in (
        (positions, envs), (positions, envs, slice(None)), (positions, envs, 1), (positions, envs, slice(1), 0),
        positions, list(positions), 3, -1, (4, 2), (-1, -2, 1, 0), slice(None), slice(2, 9, 3), (slice(3, None), 1),
        (slice(None, None, -1), envs), (slice(2), slice(1, 3)), (positions, slice(1, None)), (positions, 2), mask,
        mask[:, 0], (mask, 1), Ellipsis, (Ellipsis, 0), (slice(4), Ellipsis, 1),
        (positions.reshape(8, 5), envs.reshape(8, 5)),
        (np.int64(5), np.array([0, 2])), (np.array(5), np.array(1)), (positions[:0], envs[:0]),
    ):  # fmt: skip
        assert same_bits(view[key], array[key]), key
    assert same_bits(np.asarray(view), array) and same_bits(np.asarray(view, np.float32), array.astype(np.float32))
    assert (len(view), view.shape, view.dtype, view.ndim) == (len(array), array.shape, array.dtype, array.ndim)
    before = np.asarray(view)
    for key in (3, (4, 2), slice(None), positions):
        view[key][...] = 7  # a copy
    assert same_bits(np.asarray(view), before)
    for key in (13, (0, 3), (positions + 13, envs)):
        with pytest.raises(IndexError):
            view[key]
    with pytest.raises(TypeError, match="item assignment"):
        view[0] = 1
    # One that was taken earlier sees what comes later.
    for _ in range(40):
        transition = stream.transition()
        ours.add(*transition)
        theirs.add(*transition)
    assert same_bits(view[:], theirs.next_observations)


@pytest.mark.parametrize("as_dict", [False, True])
def test_named_transitions(as_dict: bool) -> None:
    ours, theirs = pair(DICT if as_dict else BOX, 9, 2)
    stream = Stream(DICT if as_dict else BOX, 2, 0)
    for step in range(30):
        transition = stream.transition()
        ours.add(*copy.deepcopy(transition))
        theirs.add(*copy.deepcopy(transition))
        n = ours.size()
        places = np.divmod(np.arange(2 * n), 2)
        assert same_bits(samples_at(ours, *places), samples_at(theirs, *places))
        assert same_bits(latest(ours, min(n, 5)), latest(theirs, min(n, 5))), step


# ---------------------------------------------------------------- in training


@pytest.mark.parametrize("as_dict", [False, True])
@pytest.mark.parametrize("n_envs", [1, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("normalize", [False, True])
def test_trains_as_with_stable_baselines3s_buffer(as_dict: bool, n_envs: int, normalize: bool) -> None:
    """Bit by bit, over the ring's seam and a second ``learn``, which breaks an episode off."""
    kwargs: dict[str, Any] = {"obs_space": spaces.Dict({"a": BOX, "b": BOX})} if as_dict else {}
    theirs = DictReplayBuffer if as_dict else ReplayBuffer
    models: list[SAC] = []
    for cls in (None, theirs):
        venv: Any = vec(n_envs, **kwargs)
        venv = VecNormalize(venv) if normalize else venv
        policy = "MultiInputPolicy" if as_dict else "MlpPolicy"
        model = sac(venv, policy=policy, replay_buffer_class=cls, buffer_size=60, learning_starts=10)
        models.append(model.learn(50).learn(43))
    ours, other = models
    assert type(ours.replay_buffer) is (CompactDictReplayBuffer if as_dict else CompactReplayBuffer)
    assert type(other.replay_buffer) is theirs
    assert ours._n_updates == other._n_updates > 20
    for (name, a), b in zip(ours.policy.state_dict().items(), other.policy.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


def test_optimize_memory_usage_is_the_default() -> None:
    """Nothing that Stable-Baselines3 does for its variant (a warning, an episode that ends) happens to ours."""
    models = [sac(optimize_memory_usage=optimize).learn(40).learn(40) for optimize in (True, False)]
    assert type(models[0].replay_buffer) is CompactReplayBuffer
    for a, b in zip(models[0].policy.parameters(), models[1].policy.parameters(), strict=True):
        assert torch.equal(a, b)
    assert same_bits(models[0].replay_buffer.dones, models[1].replay_buffer.dones)  # type: ignore[union-attr]


def test_saved_and_loaded(tmp_path: Path) -> None:
    model = sac(replay_buffer_kwargs={"memory_map": str(tmp_path / "map")}, buffer_size=30).learn(45)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = SAC.load(tmp_path / "m", env=vec(), replay_buffer_kwargs={"memory_map": str(tmp_path / "other")})
    assert type(loaded.replay_buffer) is CompactReplayBuffer and loaded.replay_buffer.size() == 0
    loaded.load_replay_buffer(tmp_path / "b")
    assert_same(model.replay_buffer, loaded.replay_buffer)
    loaded.learn(20, reset_num_timesteps=False)
    # A buffer of Stable-Baselines3's own, saved elsewhere, is used as it is.
    plain = sac(replay_buffer_class=ReplayBuffer).learn(20)
    plain.save_replay_buffer(tmp_path / "p")
    loaded.load_replay_buffer(tmp_path / "p")
    assert type(loaded.replay_buffer) is ReplayBuffer
    loaded.learn(10, reset_num_timesteps=False)


@pytest.mark.parametrize("kwargs", [{"n_steps": 3}, {"replay_buffer_class": ReplayBuffer}])
def test_memory_map_needs_our_buffers(kwargs: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="memory_map is known to CompactReplayBuffer"):
        sac(replay_buffer_kwargs={"memory_map": str(tmp_path)}, **kwargs)
    model = sac(replay_buffer_kwargs={"memory_map": str(tmp_path)}, validation_proportion=0.3).learn(30)
    assert isinstance(model.replay_buffer, ValidationReplayBuffer) and model.replay_buffer.memory_map == str(tmp_path)


def test_who_gets_which_buffer() -> None:
    assert type(sac(n_steps=3).replay_buffer) is NStepReplayBuffer
    assert type(sac(replay_buffer_class=ReplayBuffer).replay_buffer) is ReplayBuffer
    assert isinstance(sac(optimize_memory_usage=True, validation_proportion=0.5).replay_buffer, ValidationReplayBuffer)
