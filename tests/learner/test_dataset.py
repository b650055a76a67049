"""Data sets: which steps they hold, and what they refuse."""

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from sb3_sample import Dataset
from sb3_sample.replay import steps

#: Two episodes: one of three steps that terminates, one of three that is cut off; then two steps of a third.
OBSERVATIONS = np.arange(8, dtype=np.float64)[:, None] * 10
ACTIONS = np.linspace(-1, 1, 8)[:, None]
STEPS = np.arange(8)
REWARDS = np.arange(8.0)
TERMINATIONS = np.array([0, 0, 1, 0, 0, 0, 0, 0])
TRUNCATIONS = np.array([0, 0, 0, 0, 0, 1, 0, 0])


def arrays(**changes: Any) -> dict[str, Any]:
    given = {
        "observations": OBSERVATIONS, "actions": ACTIONS, "rewards": REWARDS, "terminations": TERMINATIONS,
        "truncations": TRUNCATIONS,
    }  # fmt: skip
    return given | changes


def rows(data: Dataset, n: int = 4_000) -> dict[float, tuple[float, float]]:
    """By reward: the next observation and the termination of every step that is ever drawn."""
    batch = data.sample(n)
    columns = (batch.rewards, batch.next_observations, batch.dones)
    return {r.item(): (s.item(), d.item()) for r, s, d in zip(*columns, strict=True)}


def test_next_observations_are_the_following_steps() -> None:
    data = Dataset.from_arrays(**arrays())
    found = rows(data)
    # 5 was cut off and 7 is the last: what came next is not known. 2 terminated: nothing is bootstrapped there.
    assert sorted(found) == [0, 1, 2, 3, 4, 6] and len(data) == 6
    assert {r: s for r, (s, _) in found.items() if r != 2} == {0: 10, 1: 20, 3: 40, 4: 50, 6: 70}
    assert {r for r, (_, done) in found.items() if done} == {2}


def test_given_next_observations_keep_every_step() -> None:
    data = Dataset.from_arrays(**arrays(next_observations=OBSERVATIONS + 1))
    assert {r: s for r, (s, _) in rows(data).items()} == {r: r * 10 + 1 for r in range(8)} and len(data) == 8


def test_steps_out_of_their_order_are_warned_of_and_have_no_range_of_returns() -> None:
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(31, 3)) * 50
    ends = np.zeros(30)
    ends[[9, 19]] = 1
    following = observations[1:] + 10 * ends[:, None]

    def made(order: Any, following: np.ndarray, ends: np.ndarray = ends) -> Dataset:
        given = (observations[:-1], np.zeros((30, 2)), np.arange(30.0), ends * 0, ends)
        return Dataset.from_arrays(*(each[order] for each in given), next_observations=following[order])

    exact = made(slice(None), following)
    assert exact.n_episodes == 3 and exact.return_range == 200
    with pytest.warns(UserWarning, match="next_observations of 2. of 30 steps are not the following observations"):
        rounded = made(slice(None), following * (1 + 1e-6))
    assert rounded.n_episodes > 20 and rounded.return_range == 200
    with pytest.warns(UserWarning, match="not in the order in which they were taken"):
        shuffled = made(rng.permutation(30), following, ends * 0)
    with pytest.raises(ValueError, match=r"\d+ of 30 steps are episodes of their own, .* in the order"):
        _ = shuffled.return_range
    alone = Dataset.from_arrays(**arrays(terminations=np.ones(8)))
    assert alone.n_episodes == 8 and alone.return_range == 7


def test_a_last_step_that_terminates_stays() -> None:
    ended = TERMINATIONS.copy()
    ended[7] = 1
    assert 7 in rows(Dataset.from_arrays(**arrays(terminations=ended)))


def test_actions_are_scaled_to_the_unit_interval() -> None:
    space = spaces.Box(np.array([-2.0]), np.array([6.0]), dtype=np.float64)
    data = Dataset.from_arrays(**arrays(actions=np.linspace(-2, 6, 8)[:, None]), action_space=space)
    batch = data.sample(2_000)
    expected = 2 * batch.rewards / 7 - 1
    torch.testing.assert_close(batch.actions, expected)
    assert batch.actions.dtype == batch.rewards.dtype == batch.dones.dtype == torch.float32
    assert batch.discounts is None


def test_batches_are_drawn_uniformly_from_a_generator_of_its_own() -> None:
    torch.manual_seed(7)
    before = torch.get_rng_state()
    data = Dataset.from_arrays(**arrays(), seed=3)
    drawn = data.sample(6_000).rewards.flatten()
    assert torch.equal(before, torch.get_rng_state())
    counts = [(drawn == r).sum().item() for r in (0, 1, 2, 3, 4, 6)]
    assert sum((n - 1000) ** 2 / 1000 for n in counts) < 25  # chi-squared with 5 degrees of freedom: p = 1e-4
    again = Dataset.from_arrays(**arrays(), seed=3).sample(6_000).rewards.flatten()
    other = Dataset.from_arrays(**arrays(), seed=4).sample(6_000).rewards.flatten()
    assert torch.equal(drawn, again) and not torch.equal(drawn, other)


def test_dict_and_image_observations() -> None:
    images = np.arange(8 * 12, dtype=np.uint8).reshape(8, 3, 2, 2)
    observations = {"image": images, "vector": OBSERVATIONS}
    data = Dataset.from_arrays(**arrays(observations=observations))
    batch = data.sample(50)
    assert batch.observations["image"].dtype == torch.uint8 and batch.observations["vector"].dtype == torch.float32
    assert isinstance(data.observation_space, spaces.Dict)
    assert data.observation_space["image"] == spaces.Box(0, 255, (3, 2, 2), np.uint8)
    first = (batch.observations["image"][:, 0, 0, 0] / 12 * 10).float()
    torch.testing.assert_close(first, batch.observations["vector"][:, 0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rewards": np.zeros(7)}, "observations must have as many steps as rewards, 7, not 8"),
        ({"rewards": np.zeros((8, 2))}, r"rewards must be of shape \(N,\), not \(8, 2\)"),
        ({"rewards": np.full(8, np.nan)}, "rewards must be finite"),
        ({"rewards": np.full(8, 1e39)}, "rewards must be finite, within float32"),
        ({"terminations": np.full(8, 0.5)}, "terminations must be 0 or 1, not 0.5"),
        ({"truncations": np.full(8, 2)}, "truncations must be 0 or 1, not 2"),
        ({"actions": np.full((8, 1), 1.5)}, "actions must lie within the bounds"),
        ({"actions": np.full((8, 1), np.nan)}, "actions must lie within the bounds"),
        ({"actions": np.zeros(8)}, r"actions must be of shape \(N, A\), not \(8,\)"),
        ({"actions": np.zeros((8, 2)), "action_space": spaces.Box(-1, 1, (3,))}, "are none of action_space"),
        ({"actions": ACTIONS, "action_space": spaces.Box(-np.inf, np.inf, (1,))}, "are none of action_space"),
        ({"observations": np.full((8, 1), np.inf)}, "observations must be finite"),
        ({"observations": np.array([["x"]] * 8)}, "observations must be numbers"),
        ({"observations": np.zeros(8)}, r"observations must be numbers of shape \(N, ...\)"),
        ({"observation_space": spaces.Box(-1, 1, (2,))}, "are none of observation_space"),
        (
            {"observation_space": spaces.Box(0, 255, (1,), np.uint8), "observations": OBSERVATIONS / 100},
            "observations must be whole numbers within uint8, as their space has them, not 0.1",
        ),
        ({"observation_space": spaces.Box(0, 9, (1,), np.uint8), "observations": ACTIONS}, "not -1.0"),
        ({"observation_space": spaces.Discrete(9), "observations": np.full((8, 1), np.nan)}, "whole numbers"),
        (
            {"observation_space": spaces.Discrete(7), "observations": STEPS},
            r"observations must be numbers of Discrete\(7\), not 7",
        ),
        (
            {"observation_space": spaces.Discrete(8), "observations": STEPS, "next_observations": STEPS + 1},
            r"next_observations must be numbers of Discrete\(8\), not 8",
        ),
        (
            {
                "observation_space": spaces.Dict({"k": spaces.MultiDiscrete([9, 4])}),
                "observations": {"k": np.stack((STEPS, STEPS // 2 + 1), axis=1)},
            },
            r"observations\['k'\] must be numbers of MultiDiscrete\(\[9 4\]\), not \[6 4\]",
        ),
        ({"columns": {"task": REWARDS, "rewards": REWARDS}}, "columns must have names of their own, not rewards,"),
        ({"columns": {"next_observations": REWARDS}}, "names of their own, not next_observations,"),
        ({"next_observations": np.zeros((7, 1))}, "next_observations must have as many steps"),
        ({"next_observations": np.zeros((8, 2))}, "are none of observation_space"),
        ({"truncations": np.ones(8), "terminations": np.zeros(8)}, "next_observations must be given"),
        ({name: value[:0] for name, value in arrays().items()}, "at least one step"),
    ],
)  # fmt: skip
def test_what_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Dataset.from_arrays(**arrays(**changes))


def test_numbers_of_a_discrete_space() -> None:
    space = spaces.Dict({"task": spaces.Discrete(8), "x": spaces.Box(0, 70, (1,), np.float64)})
    alone, inside = np.arange(8), {"task": np.arange(8), "x": OBSERVATIONS}
    for given, of in ((alone, space["task"]), (inside, space)):
        rows = Dataset.from_arrays(**arrays(observations=given, observation_space=of)).rows(slice(None))
        seen = rows["observations"]["task"] if of is space else rows["observations"]
        assert seen.tolist() == [[0], [1], [2], [3], [4], [6]]


@pytest.mark.parametrize("as_dict", [False, True])
def test_wide_rows_are_read_in_small_pieces(as_dict: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """At most so many bytes at a time, each once, and with the same fingerprint."""
    rng = np.random.default_rng(0)
    pictures, ends = rng.integers(0, 255, (301, 3, 20, 20)).astype(np.uint8), np.arange(300) % 50 == 49
    given = (rng.uniform(-1, 1, (300, 2)), np.zeros(300), ends, ~ends & False)
    largest: list[int] = []

    def seen(rows: slice, wrap: Any = lambda array: array) -> Any:
        parts = {"picture": wrap(pictures[rows]), "number": wrap(np.arange(301.0)[rows, None])}
        return parts if as_dict else parts["picture"]

    def made(wrap: Any = lambda array: array) -> Dataset:
        now, then = seen(slice(0, -1), wrap), seen(slice(1, None), wrap)
        return Dataset.from_arrays(now, *given, next_observations=then)

    whole = made()

    class Read:
        """Pictures that are read from a file."""

        def __init__(self, array: np.ndarray):
            self.array, self.shape, self.dtype = array, array.shape, array.dtype

        def __len__(self) -> int:
            return len(self.array)

        def __getitem__(self, rows: slice) -> np.ndarray:
            largest.append(self.array[rows].nbytes)
            return self.array[rows]

    monkeypatch.setattr(steps, "CHUNK_BYTES", 10_000)
    monkeypatch.setattr(np, "equal", lambda a, b, equal=np.equal: (largest.append(a.nbytes), equal(a, b))[1])
    pieced = made(Read)
    assert pieced.n_episodes == whole.n_episodes
    assert len(largest) > 150 and max(largest) <= 10_000
    # The fingerprint reads each part alone.
    largest.clear()
    readers = pieced._readers
    monkeypatch.setattr(
        pieced,
        "_readers",
        lambda: {
            name: {key: lambda rows, read=read: noted(read(rows)) for key, read in parts.items()}
            for name, parts in readers().items()
        },
    )

    def noted(values: torch.Tensor) -> torch.Tensor:
        largest.append(values.nbytes)
        return values

    assert pieced.fingerprint == whole.fingerprint
    assert max(largest) <= 10_000 and sum(largest) < 1.1 * 2 * pictures[1:].nbytes


@pytest.mark.parametrize("size", [0, -3])
def test_batches_have_a_size(size: int) -> None:
    with pytest.raises(ValueError, match=f"batch_size must be at least 1, not {size}"):
        Dataset.from_arrays(**arrays()).sample(size)
