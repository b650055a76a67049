"""A mixture of sources: batches with a fixed share of each."""

import itertools
import math
from collections.abc import Sequence
from typing import Any, Protocol

import torch

from sb3_sample.learner.batch import Batch


class Samples(Protocol):
    """Interface of a source of batches."""

    def sample(self, batch_size: int) -> Batch: ...


class Mixture:
    """
    Batches of several sources, such as a data set and a replay buffer, the rows of the first source first.

    :param sources: each with ``sample(batch_size)``
    :param shares: share of each source in a batch; they add up to 1. Batches have as many rows of the first sources
        together as their shares together make, rounded
    :raises ValueError: if there are not as many shares as sources, one is negative, or they do not add up to 1
    """

    def __init__(self, sources: Sequence[Samples], shares: Sequence[float]):
        if len(sources) != len(shares) or not sources:
            raise ValueError(f"shares must be one for each of {len(sources)} sources, not {list(shares)}")
        if not all(0 <= share <= 1 for share in shares) or not math.isclose(sum(shares), 1, abs_tol=1e-6):
            raise ValueError(f"shares must be at least 0 and add up to 1, not {list(shares)}")
        self.sources, self.shares = tuple(sources), tuple(shares)

    def sample(self, batch_size: int) -> Batch:
        """
        :param batch_size: B
        :return: transitions of all sources
        :raises ValueError: if the batch size is below 1, or the sources differ in their columns
        """
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, not {batch_size}")
        # Rounding sums instead of shares never makes more rows, or fewer, than batch_size.
        ends = [round(total * batch_size) for total in itertools.accumulate(self.shares[:-1])]
        sizes = [end - begin for begin, end in itertools.pairwise((0, *ends, batch_size))]
        return mixed([source.sample(n) for source, n in zip(self.sources, sizes, strict=True) if n > 0])


def mixed(batches: list[Batch]) -> Batch:
    """
    :param batches: of several sources
    :return: their rows, one after the other
    :raises ValueError: if they differ in their columns
    """
    columns = [sorted(batch.columns) for batch in batches]
    if any(names != columns[0] for names in columns):
        raise ValueError(f"sources must have the same columns to be mixed, not {columns}")
    names = [name for name in Batch._fields if name != "discounts"]
    joined = {name: _joined([getattr(batch, name) for batch in batches]) for name in names}
    return Batch(**joined, discounts=_discounts(batches))


def _joined(columns: list[Any]) -> Any:
    if isinstance(columns[0], dict):
        return {key: torch.cat([column[key] for column in columns]) for key in columns[0]}
    return torch.cat(columns)


def _discounts(batches: list[Batch]) -> torch.Tensor | float | None:
    """One discount factor for all if they agree, else one per row."""
    given = [batch.discounts for batch in batches]
    numbers = {discount for discount in given if not isinstance(discount, torch.Tensor)} - {None}
    if len(numbers) <= 1 and not any(isinstance(discount, torch.Tensor) for discount in given):
        # None stands for the learner's own, and so does a replay buffer's number.
        return next(iter(numbers), None)
    rows = []
    for batch, discount in zip(batches, given, strict=True):
        if discount is None:
            raise ValueError("a source without discounts cannot be mixed with one of several: give them to its batches")
        rows.append(discount if isinstance(discount, torch.Tensor) else torch.full_like(batch.rewards, float(discount)))
    return torch.cat(rows)
