"""Stacked frames stored once, beside Stable-Baselines3's buffers, which store each stack twice."""

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

from sb3_sample.replay.buffers import BatchMemory, ValidationReplayBuffer
from sb3_sample.replay.compact import CompactNStepReplayBuffer, CompactReplayBuffer
from tests.sac.streams import ACTIONS, assert_same, draw, same_bits

K, CHANNELS, SIZE = 3, 2, 4
SPACE = spaces.Box(0, 255, (K * CHANNELS, SIZE, SIZE), np.uint8)


class FrameStream:
    """
    Transitions of environments that stack their latest frames. ``start`` is what fills the stack at a reset: the
    "first" frame, "zeros", or frames of "another" kind, which no rule foresees. Some episodes are broken off.
    """

    def __init__(self, n_envs: int, seed: int, start: str = "first", ends: float = 0.15, breaks: float = 0.05):
        self.n_envs, self.start, self.ends, self.breaks = n_envs, start, ends, breaks
        self.rng = np.random.default_rng(seed)
        self.stacks = np.stack([self._fresh() for _ in range(n_envs)])

    def _frame(self) -> np.ndarray:
        return self.rng.integers(0, 256, (CHANNELS, SIZE, SIZE)).astype(np.uint8)

    def _fresh(self) -> np.ndarray:
        first = self._frame()
        fill = {"first": first, "zeros": np.zeros_like(first)}
        return np.concatenate([*(fill.get(self.start, self._frame()) for _ in range(K - 1)), first])

    def transition(self) -> tuple[Any, ...]:
        now = self.stacks
        after = np.stack([np.concatenate((stack[CHANNELS:], self._frame())) for stack in now])
        dones = self.rng.random(self.n_envs) < self.ends
        infos = [{"TimeLimit.truncated": bool(self.rng.random() < 0.5 and done)} for done in dones]
        starts = dones | (self.rng.random() < self.breaks)
        self.stacks = np.stack([self._fresh() if start else a for a, start in zip(after, starts, strict=True)])
        actions = self.rng.normal(size=(self.n_envs, 2)).astype(np.float32)
        return now.copy(), after, actions, self.rng.normal(size=self.n_envs), dones, infos


def pair(rows: int, n_envs: int, ours: Any = CompactReplayBuffer, theirs: Any = ReplayBuffer, **kwargs: Any) -> Any:
    size, common = rows * n_envs, {k: v for k, v in kwargs.items() if k in ("n_steps", "gamma")}
    return (
        ours(size, SPACE, ACTIONS, "cpu", n_envs, frame_stack=K, **kwargs),
        theirs(size, SPACE, ACTIONS, "cpu", n_envs, **common),
    )


@pytest.mark.parametrize("start", ["first", "zeros", "another"])
@pytest.mark.parametrize(("rows", "n_envs"), [(40, 1), (11, 3), (1, 2), (2, 1), (3, 2)])
def test_what_stable_baselines3s_buffer_holds(rows: int, n_envs: int, start: str) -> None:
    """Over the starts of episodes, time limits, broken episodes and the ring's end: the same samples, bit by bit."""
    ours, theirs = pair(rows, n_envs)
    stream = FrameStream(n_envs, rows, start)
    for step in range(4 * rows + 7):
        transition = stream.transition()
        ours.add(*copy.deepcopy(transition))
        theirs.add(*copy.deepcopy(transition))
        transition[0][...] = 0
        n, frames = ours.size(), ours.observations
        assert len(frames.aside) == (frames.at < 0).sum(), "no place aside is lost"
        assert same_bits(frames[:n], theirs.observations[:n])
        if step % 7 == 0:
            assert same_bits(draw(ours, 32, step), draw(theirs, 32, step))
            np.random.seed(step)
            samples = theirs.sample(32)
            np.random.seed(step)
            gathered = BatchMemory().gather(ours, 32)
            assert all(same_bits(a, b) for a, b in zip(gathered, samples, strict=True) if b is not None)
    for index in [np.s_[0], np.s_[-1, 0], np.s_[:, 0, 2:4], ([0, 0], [0, 0]), np.zeros((n, n_envs), bool) | True]:
        whole = theirs.observations[:n]
        if ours.full:
            assert same_bits(np.asarray(ours.observations[index]), whole[index])
    assert same_bits(np.asarray(ours.observations)[:n], theirs.observations[:n])


def test_the_comparison_can_fail() -> None:
    ours, theirs = pair(10, 1)
    stream = FrameStream(1, 0, ends=0, breaks=0)
    for _ in range(5):
        transition = stream.transition()
        ours.add(*transition), theirs.add(*transition)
    ours.observations.at[4, 0, 0] = 4
    assert not same_bits(ours.observations[4], theirs.observations[4])


def test_a_sixth_of_the_memory() -> None:
    """Of what two stacks a transition take, over episodes of 125 decisions, as with an action repeat of 8."""
    space = spaces.Box(0, 255, (9, 84, 84), np.uint8)
    buffer = CompactReplayBuffer(250, space, ACTIONS, "cpu", frame_stack=3)
    frames = np.random.default_rng(0).integers(0, 256, (127, 3, 84, 84)).astype(np.uint8)
    for episode in range(3):
        stacks = [np.concatenate([frames[max(i - j, 0)] for j in (2, 1, 0)]) for i in range(126)]
        for i in range(125):
            buffer.add(stacks[i], stacks[i + 1], np.zeros((1, 2)), np.zeros(1), np.array([i == 124]), [{}])
            # Frames differ from episode to episode.
        frames = np.roll(frames, episode + 1, axis=0)
    assert len(buffer.observations.aside) <= 3
    theirs = 2 * 250 * 9 * 84 * 84
    aside = sum(array.nbytes for array in buffer.aside.arrays.values())
    assert buffer.observations.frames.nbytes < theirs / 5.9
    # What is aside is that of two episodes' ends, with room for as many more.
    assert len(buffer.aside) <= 3 and aside <= 20 * 9 * 84 * 84


@pytest.mark.parametrize("n_envs", [1, 2])
def test_n_steps(n_envs: int) -> None:
    ours, theirs = pair(13, n_envs, CompactNStepReplayBuffer, NStepReplayBuffer, n_steps=3, gamma=0.9)
    stream = FrameStream(n_envs, 5)
    for step in range(60):
        transition = stream.transition()
        ours.add(*transition), theirs.add(*transition)
        assert same_bits(draw(ours, 16, step), draw(theirs, 16, step))


@pytest.mark.parametrize("start", ["first", "another"])
@pytest.mark.parametrize("cls", [CompactReplayBuffer, ValidationReplayBuffer])
def test_rows_to_and_from_files(cls: Any, start: str) -> None:
    """As checkpoints write rows: pieces after pieces, the ring overwritten several times, the last steps replaced."""
    kwargs = {"validation_proportion": 0.3} if cls is ValidationReplayBuffer else {}
    np.random.seed(0)
    buffer, stream = pair(9, 2, cls, **kwargs)[0], FrameStream(2, 1, start)
    pieces: list[tuple[int, Any]] = []
    n = 0
    for length in (4, 3, 1, 8, 2, 9, 5):
        for _ in range(length):
            buffer.add(*stream.transition())
        n += length
        # One more step than is new: it replaces the one that is there.
        again = min(buffer.size(), length + 1) if pieces else length
        pieces.append((n - again, buffer.new_rows(again)))
        other = pair(9, 2, cls, **kwargs)[0]
        other.restore_rows(
            pieces[-1:] if n - again == 0 else [p for p in pieces if p[0] + len(p[1]["actions"]) > n - 18]
        )
        assert_same(other, buffer)
        loaded = pair(9, 2, cls, **kwargs)[0]
        loaded.load_state_dict(copy.deepcopy(buffer.state_dict()))
        assert_same(loaded, buffer)
        for each in (other, loaded):
            state, going_on = np.random.get_state(), copy.deepcopy(stream)
            for twin, follows in ((each, copy.deepcopy(stream)), (copy.deepcopy(buffer), going_on)):
                np.random.set_state(state)
                for _ in range(5):
                    twin.add(*follows.transition())
                if twin is each:
                    first = copy.deepcopy(twin)
            assert_same(first, twin)
            np.random.set_state(state)
    assert "older" in pieces[0][1] and pieces[0][1]["observations"].shape[2] == CHANNELS, "frames once in files too"


def test_rows_that_are_none() -> None:
    buffer, stream = pair(9, 1)[0], FrameStream(1, 1, "another")
    for _ in range(6):
        buffer.add(*stream.transition())
    state = buffer.state_dict()
    older, frames = state["older"].copy(), state["older_frames"]
    wrong = [
        {"older": older.astype(np.int64)},
        {"older": older[:-1]},
        {"older": np.full_like(older, 6)},
        {"older": np.where(np.arange(6)[:, None, None] == 0, np.int32(5), older)},
        {"older": np.where(np.arange(6)[:, None, None] == 5, np.int32(0), older)},
        {"older": np.full_like(older, -3)},
        {"older_frames": frames[:-1]},
        {"older_frames": frames.astype(np.int16)},
    ]
    for each in wrong:
        with pytest.raises(ValueError, match="older"):
            pair(9, 1)[0].load_state_dict({**state, **each})
    with pytest.raises(ValueError, match="columns"):
        pair(9, 1)[0].load_state_dict({k: v for k, v in state.items() if k != "older"})


def test_in_files_and_copies(tmp_path: Path) -> None:
    buffer, theirs = pair(9, 2, memory_map=tmp_path)
    stream = FrameStream(2, 3)
    for _ in range(25):
        transition = stream.transition()
        buffer.add(*transition), theirs.add(*transition)
    assert not buffer.observations.frames.flags.owndata
    for each in (copy.deepcopy(buffer), pickle.loads(pickle.dumps(buffer))):
        assert_same(each, buffer)
        each.reset()
        assert each.observations.nbytes > 0 and len(each.observations.aside) == 0
    assert same_bits(buffer.observations[:], theirs.observations)


def test_wrong_stacks() -> None:
    with pytest.raises(ValueError, match="frame_stack=4"):
        CompactReplayBuffer(5, SPACE, ACTIONS, "cpu", frame_stack=4)
    with pytest.raises(ValueError, match="frame_stack"):
        CompactReplayBuffer(5, SPACE, ACTIONS, "cpu", frame_stack=0)
    assert CompactReplayBuffer(5, SPACE, ACTIONS, "cpu", frame_stack=1).frame_stack is None
