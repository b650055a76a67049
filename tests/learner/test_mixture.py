"""Mixtures of sources."""

from typing import Any

import numpy as np
import pytest
import torch

from sb3_sample import Dataset
from sb3_sample.learner.batch import Batch
from sb3_sample.replay.mixture import Mixture
from tests.sac.common import sac


def data(value: float, seed: int = 0, as_dict: bool = False) -> Dataset:
    observations: Any = np.full((20, 3), value, np.float32)
    ends = np.ones(20)
    observations = {"a": observations, "b": observations[:, :1]} if as_dict else observations
    return Dataset.from_arrays(observations, np.zeros((20, 2)), np.full(20, value), ends, ends * 0, seed=seed)


@pytest.mark.parametrize(
    ("shares", "batch_size", "sizes"),
    [((0.5, 0.5), 8, (4, 4)), ((0.25, 0.75), 128, (32, 96)), ((1 / 3, 2 / 3), 10, (3, 7)), ((0.0, 1.0), 5, (0, 5)),
     ((1.0, 0.0), 5, (5, 0))],
)  # fmt: skip
def test_every_batch_has_the_shares(shares: tuple[float, float], batch_size: int, sizes: tuple[int, int]) -> None:
    batch = Mixture([data(1.0), data(2.0)], shares).sample(batch_size)
    assert batch.rewards.flatten().tolist() == [1.0] * sizes[0] + [2.0] * sizes[1]
    assert torch.equal(batch.observations[:, :1], batch.rewards) and batch.discounts is None


@pytest.mark.parametrize(
    ("shares", "batch_size", "sizes"),
    [((0.3, 0.3, 0.3, 0.1), 5, (2, 1, 1, 1)), ((0.3, 0.3, 0.3, 0.1), 2, (1, 0, 1, 0)), ((0.5, 0.5, 0.0), 3, (2, 1, 0)),
     ((1 / 3, 1 / 3, 1 / 3, 0.0), 10, (3, 4, 3, 0))],
)  # fmt: skip
def test_rounding_keeps_the_batch_size(shares: tuple[float, ...], batch_size: int, sizes: tuple[int, ...]) -> None:
    """Sums of shares times the batch size are rounded, half to even."""
    batch = Mixture([data(float(i)) for i in range(len(shares))], shares).sample(batch_size)
    assert batch.rewards.flatten().tolist() == [float(i) for i, n in enumerate(sizes) for _ in range(n)]


def test_dicts_are_joined_by_key() -> None:
    batch = Mixture([data(1.0, as_dict=True), data(2.0, as_dict=True)], (0.5, 0.5)).sample(4)
    assert batch.observations["b"].flatten().tolist() == [1, 1, 2, 2] and batch.observations["a"].shape == (4, 3)


def test_a_replay_buffer_and_a_data_set() -> None:
    model = sac(gamma=0.9).learn(20)
    batch = Mixture([model._source, data(100.0)], (0.5, 0.5)).sample(8)
    assert (batch.rewards.flatten() == 100).tolist() == [False] * 4 + [True] * 4 and batch.discounts == 0.9
    assert np.isfinite(model._update(batch)["train/critic_loss"].item())


class Given:
    def __init__(self, discounts: Any):
        self.discounts = discounts

    def sample(self, n: int) -> Batch:
        zeros = torch.zeros(n, 1)
        discounts = torch.full((n, 1), self.discounts[0]) if isinstance(self.discounts, tuple) else self.discounts
        return Batch(zeros, zeros, zeros, zeros, zeros, discounts)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [(0.9, 0.9, 0.9), (None, 0.9, 0.9), (0.9, 0.8, [0.9, 0.9, 0.8, 0.8]), ((0.7,), 0.8, [0.7, 0.7, 0.8, 0.8]),
     ((0.7,), (0.6,), [0.7, 0.7, 0.6, 0.6])],
)  # fmt: skip
def test_discounts(first: Any, second: Any, expected: Any) -> None:
    found = Mixture([Given(first), Given(second)], (0.5, 0.5)).sample(4).discounts
    if isinstance(expected, list):
        torch.testing.assert_close(found, torch.tensor(expected)[:, None])
    else:
        assert found == expected


def test_discounts_that_do_not_mix() -> None:
    with pytest.raises(ValueError, match="a source without discounts"):
        Mixture([Given(None), Given((0.5,))], (0.5, 0.5)).sample(4)


@pytest.mark.parametrize("shares", [(1.0,), (0.5, 0.6), (-0.5, 1.5), (float("nan"), 0.5), ()])
def test_shares_add_up(shares: Any) -> None:
    with pytest.raises(ValueError, match="shares must be"):
        Mixture([data(1.0), data(2.0)], shares)


def test_a_batch_has_a_size() -> None:
    with pytest.raises(ValueError, match="batch_size must be at least 1, not 0"):
        Mixture([data(1.0)], (1.0,)).sample(0)
