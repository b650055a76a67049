"""Replay buffers that are saved whole, or row by row as they grow, and put back."""

import copy
from collections import deque
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_sample import CompactDictReplayBuffer, CompactReplayBuffer
from sb3_sample.replay.buffers import ValidationDictReplayBuffer, ValidationReplayBuffer
from tests.sac.streams import ACTIONS, BOX, SPACES, Stream, assert_same, pair, same_bits


def split_pair(space: spaces.Space, rows: int, n_envs: int, share: float) -> list[Any]:
    is_dict = isinstance(space, spaces.Dict)
    if share:
        cls: Any = ValidationDictReplayBuffer if is_dict else ValidationReplayBuffer
        kwargs = {"validation_proportion": share}
    else:
        cls, kwargs = CompactDictReplayBuffer if is_dict else CompactReplayBuffer, {}
    return [cls(rows * n_envs, space, ACTIONS, "cpu", n_envs, **kwargs) for _ in range(2)]


CASES = pytest.mark.parametrize(
    ("space", "rows", "n_envs", "share"),
    [("float32", 20, 1, 0.0), ("dict", 13, 3, 0.0), ("float32", 13, 3, 0.4), ("dict", 7, 2, 0.4), ("uint8", 1, 2, 0.0),
     ("float32", 2, 1, 0.5)],
)  # fmt: skip


@CASES
def test_state(space: str, rows: int, n_envs: int, share: float) -> None:
    buffer, other = split_pair(SPACES[space], rows, n_envs, share)
    stream = Stream(SPACES[space], n_envs, 0)
    for step in range(4 * rows):
        state = copy.deepcopy(buffer.state_dict())
        assert all(type(value) in (int, bool, np.ndarray) for value in state.values())
        other.load_state_dict(state)  # over whatever was in it
        assert_same(buffer, other)
        assert same_bits(state, other.state_dict())
        if share:
            assert buffer._last - buffer._first == other._last - other._first
        transition = stream.transition()
        # It goes on as the first does.
        np.random.seed(step)
        buffer.add(*copy.deepcopy(transition))
        np.random.seed(step)
        other.add(*transition)
        assert_same(buffer, other)


@CASES
@pytest.mark.parametrize("longest", [pytest.param(1, marks=pytest.mark.slow), 4, 30])
def test_appended_pieces(space: str, rows: int, n_envs: int, share: float, longest: int) -> None:
    """Only what is new is taken each time; the pieces that reach back far enough are the buffer."""
    buffer, other = split_pair(SPACES[space], rows, n_envs, share)
    stream = Stream(SPACES[space], n_envs, 1)
    rng = np.random.default_rng(longest)
    pieces: deque[tuple[int, dict[str, np.ndarray]]] = deque()
    n_rows = written = 0
    for _ in range(60):
        for _ in range(rng.integers(0, longest + 1)):
            buffer.add(*stream.transition())
            n_rows += 1
        if rng.random() < 0.3 and written:
            # The newest row is changed after it was written, and written once more.
            buffer.dones[buffer.pos - 1] = 1
            written = max(min(written, n_rows - 1), n_rows - buffer.size())
        first = max(written, n_rows - buffer.size())
        pieces.append((first, buffer.new_rows(n_rows - first)))
        assert all(len(pieces[-1][1][name]) == n_rows - first for name in ("actions", "rewards", "dones"))
        written = n_rows
        # As the files do: a piece of which nothing is needed is removed.
        while pieces and pieces[0][0] + len(pieces[0][1]["actions"]) <= n_rows - buffer.size() and len(pieces) > 1:
            pieces.popleft()
        other.restore_rows(copy.deepcopy(list(pieces)))
        assert_same(buffer, other)
    assert n_rows > rows
    for step in range(2 * rows + 3):  # they go on alike
        transition = stream.transition()
        for each in (buffer, other):
            np.random.seed(step)
            each.add(*copy.deepcopy(transition))
        assert_same(buffer, other)
    # What is taken does not depend on where the buffer has been.
    assert same_bits(buffer.new_rows(buffer.size()), other.new_rows(other.size()))


def test_a_piece_costs_what_is_new() -> None:
    ours, _ = pair(BOX, 1000, 2)
    for t in range(700):
        now, after = np.full((2, 3), t), np.full((2, 3), t + 1 + 0.5 * (t % 100 == 99))
        ours.add(now, after, np.zeros((2, 2)), np.zeros(2), np.zeros(2), [{}] * 2)
    piece = ours.new_rows(200)
    assert piece["observations"].shape == (200, 2, 3)
    # Two broken sequences, of which the second is the last step itself.
    assert piece["next_index"].tolist() == [2 * 99, 2 * 99 + 1, 2 * 199, 2 * 199 + 1]
    assert piece["next_observations"][:, 0].tolist() == [600.5, 600.5, 700.5, 700.5]


def damage(rows: dict[str, np.ndarray], what: str) -> dict[str, np.ndarray]:
    rows, index = dict(rows), rows["next_index"]
    if what == "missing":
        del rows["dones"]
    elif what == "more":
        rows["held_out"] = rows["dones"]
    elif what == "shape":
        rows["observations"] = rows["observations"][..., :2]
    elif what == "dtype":
        rows["actions"] = rows["actions"].astype(np.float64)
    elif what == "length":
        rows["rewards"] = rows["rewards"][1:]
    elif what == "values":
        rows["next_observations"] = rows["next_observations"][1:]
    else:
        rows["next_index"] = {"negative": index - 10**6, "beyond": index + 10**6, "unsorted": index[::-1].copy(),
                              "not newest": np.arange(len(index)), "float": index.astype(float)}[what]  # fmt: skip
    return rows


@pytest.mark.parametrize(
    "what",
    ["missing", "more", "shape", "dtype", "length", "values", "negative", "beyond", "unsorted", "not newest", "float"],
)
def test_rows_of_something_else(what: str) -> None:
    ours, other = split_pair(BOX, 20, 2, 0.0)
    stream = Stream(BOX, 2, 0)
    for _ in range(16):
        ours.add(*stream.transition())
    with pytest.raises(ValueError, match="saved|next_index"):
        other.restore_rows([(0, damage(ours.new_rows(16), what))])
    state = ours.state_dict()
    with pytest.raises(ValueError, match="saved|next_index"):
        other.load_state_dict(damage(state, what))


def test_pieces_that_do_not_fit() -> None:
    ours, other = split_pair(BOX, 20, 2, 0.0)
    stream = Stream(BOX, 2, 0)
    for _ in range(16):
        ours.add(*stream.transition())
    piece = ours.new_rows(10)
    with pytest.raises(ValueError, match="steps 0 to 10 are followed by those from 11 to 21"):
        other.restore_rows([(0, piece), (11, piece)])
    with pytest.raises(ValueError, match="those from 3 to 13"):
        other.restore_rows([(5, piece), (3, piece)])
    with pytest.raises(ValueError, match="steps before step 5 are missing"):
        other.restore_rows([(5, piece)])
    with pytest.raises(ValueError, match="16 steps do not fit into a buffer of 5"):
        split_pair(BOX, 5, 2, 0.0)[0].restore_rows([(0, ours.new_rows(16))])
    with pytest.raises(ValueError, match="between 0 and 16, the steps in the replay buffer, not 17"):
        ours.new_rows(17)
    state = ours.state_dict()
    with pytest.raises(ValueError, match="buffer_size is 21 in this buffer, but 20"):
        split_pair(BOX, 21, 2, 0.0)[0].load_state_dict(state)
    with pytest.raises(ValueError, match="pos=20"):
        other.load_state_dict({**state, "pos": 20})
