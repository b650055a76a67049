"""
Replay buffers as rings of rows: find the rows added since the last checkpoint, and put them back.

A row is one step of all environments. Rows are counted over the whole run: row ``i`` lies at place ``i % capacity``, so
that rows ``first`` to ``last`` are a piece of the run that never changes once it is written. Only the last ``capacity``
rows of the run are needed.
"""

import enum
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_sample.replay.columns import HasColumns, columns_of
from sb3_sample.replay.compact import CompactReplay, is_number_or_flag, numbers_of
from sb3_sample.replay.endings import end_episodes
from sb3_sample.saving.attributes import is_inert
from sb3_sample.saving.untrusted import BadFile

#: Attributes that hindsight keeps for each row besides the columns.
_OF_HINDSIGHT = ("ep_start",)
#: Attributes that change in existing rows, or are not rows; written anew each time.
_SMALL = ("ep_length", "_current_ep_start")
#: Attributes that are never used (infos, without copy_info_dict), never change, or follow from the rows.
_DERIVED = (
    "infos", "obs_shape", "device", "observation_space", "action_space", "env", "slot", "_ring", "_drawable",
    "_next_row",
)  # fmt: skip


#: Numbers of Stable-Baselines3's buffers.
_COUNTS = (
    "buffer_size", "n_envs", "optimize_memory_usage", "handle_timeout_termination", "action_dim", "pos", "full",
)  # fmt: skip


#: Values of settings, which nothing changes in place.
_SETTINGS = (
    str, bytes, type(None), type, enum.Enum, torch.device, torch.dtype, np.dtype, spaces.Space,
)  # fmt: skip


def _is_kept(value: Any) -> bool:
    """Whether a buffer's attribute is in checkpoints, or has no state. This package's objects belong to its buffers."""
    if isinstance(value, tuple):
        return all(map(_is_kept, value))
    is_ours = type(value).__module__.partition(".")[0] == "sb3_sample"
    return is_number_or_flag(value) or isinstance(value, _SETTINGS) or is_inert(value) or is_ours


def check_values(columns: Mapping[str, Any], name: str, buffer: Any) -> None:
    """
    Check the rows of a replay buffer; entries that are not its columns are ignored.

    :param columns: arrays or tensors by the column's name
    :param name: where they are from, for messages
    :param buffer: the replay buffer that they are for, or its class, which knows its columns
    :raises BadFile: if observations, actions or rewards are not finite, or flags are neither 0 nor 1: no training
        stores such values
    """
    known = columns_of(buffer)
    for column, values in columns.items():
        declared = known.get(column.split("/")[0])
        if isinstance(values, torch.Tensor):
            values = values.cpu().numpy()
        if isinstance(values, Mapping):
            check_values({f"{column}/{key}": inside for key, inside in values.items()}, name, buffer)
        elif declared is None or values.size == 0:
            continue
        elif not declared.is_flag and values.dtype.kind == "f":
            # If a number is not finite, the smallest or the largest is not: no copy is made.
            low, high = values.min(), values.max()
            if not (np.isfinite(low) and np.isfinite(high)):
                bad = low if not np.isfinite(low) else high
                raise BadFile(f"{name}: {column} hold {bad}, which is not finite, and no training stores it")
        elif declared.is_flag and (wrong := values[(values != 0) & (values != 1)]).size > 0:
            raise BadFile(f"{name}: {column} hold {wrong[0]!r:.50}, but must be 0 or 1")


def check_episodes(buffer: ReplayBuffer, name: str) -> None:
    """
    :param buffer: a replay buffer of any class
    :param name: where its content is from, for messages
    :raises BadFile: if it keeps where episodes begin and how long they are, as hindsight does, and one lies outside it
    """
    for key, most in (
        ("ep_start", buffer.buffer_size - 1), ("_current_ep_start", buffer.buffer_size - 1),
        ("ep_length", buffer.buffer_size),
    ):  # fmt: skip
        places = getattr(buffer, key, None)
        if not isinstance(places, np.ndarray) or places.size == 0:
            continue
        if places.dtype.kind not in "iu" or places.min() < 0 or places.max() > most:
            raise BadFile(f"{name}: {key} must be integers in [0, {most}], where the buffer has rows")


class Ring:
    """
    A replay buffer of Stable-Baselines3, or of this package, as a ring of rows.

    :param buffer: the buffer
    :param counter: returns the number of rows ever added to it, counted from any start
    :raises ValueError: it keeps an attribute that is not known here
    """

    def __init__(self, buffer: ReplayBuffer, counter: Callable[[], int]):
        self.buffer, self._counter = buffer, counter
        self.capacity = int(buffer.buffer_size)
        kind = type(buffer).__name__
        if getattr(buffer, "copy_info_dict", False):
            raise ValueError(
                "replay_buffer_kwargs: copy_info_dict=True keeps what environments say as Python objects, which a "
                "checkpoint cannot hold: leave it out, or train without checkpoint"
            )
        known = (*columns_of(buffer), *_OF_HINDSIGHT, *_SMALL, *_DERIVED)
        for name, value in vars(buffer).items():
            if name not in known and not _is_kept(value):
                raise ValueError(
                    f"replay_buffer_class={kind} keeps {name!r} ({type(value).__name__}), of which checkpoints know "
                    "nothing: they have declared columns (more_columns) and numbers. Use one of Stable-Baselines3's or "
                    "this package's buffers, or train without checkpoint"
                )
        #: Rows added over the run, and how many of them the files have.
        self.n_rows = self.size() + (int(buffer.pos) if buffer.full else 0)
        self.n_written = 0
        self._count = counter()

    def size(self) -> int:
        """
        :return: rows in the buffer
        """
        return self.capacity if self.buffer.full else int(self.buffer.pos)

    def advance(self) -> tuple[int, int]:
        """
        Count the rows added since the last call.

        :return: first and last row (exclusive) that the files lack
        """
        count = self._counter()
        self.n_rows, self._count = self.n_rows + count - self._count, count
        if self.n_rows % self.capacity != self.buffer.pos or self.n_rows < self.size():
            # The buffer was emptied or filled in another way: all of its rows are new.
            self.n_rows += self.capacity + (int(self.buffer.pos) - self.n_rows) % self.capacity
        return max(self.n_written, self.n_rows - self.size()), self.n_rows

    def rows(self, first: int) -> dict[str, np.ndarray]:
        """
        :param first: first row
        :return: copies of the rows from there on, by the column's name
        """
        if isinstance(self.buffer, CompactReplay):
            return self.buffer.new_rows(self.n_rows - first)
        places = np.arange(first, self.n_rows) % self.capacity
        return {
            name: array[torch.from_numpy(places).to(array.device)].cpu().numpy()
            if isinstance(array, torch.Tensor)
            else array[places]
            for name, array in self._columns().items()
        }

    def _columns(self) -> dict[str, Any]:
        """The arrays (or tensors) whose first axis counts the rows, by name."""
        found: dict[str, Any] = {}
        for name in (*columns_of(self.buffer), *_OF_HINDSIGHT):
            value = getattr(self.buffer, name, None)
            if isinstance(value, dict):
                found.update({f"{name}/{key}": array for key, array in value.items()})
            elif value is not None:
                found[name] = value
        return found

    def small(self) -> dict[str, Any]:
        """
        :return: everything else of the buffer, as plain values
        """
        small: dict[str, Any] = {"n_rows": self.n_rows, "size": self.size()}
        if isinstance(self.buffer, CompactReplay):
            parts = {"changing": self.buffer.changing_state(), "own": self.buffer.own_numbers()}
            return small | {name: part for name, part in parts.items() if part}
        own = vars(self.buffer)
        small["numbers"] = numbers_of(self.buffer)
        small["arrays"] = {name: own[name] for name in _SMALL if name in own}
        # The last next observation, which lies at the place of the next row.
        small["head"] = self.buffer.observations[self.buffer.pos] if self.buffer.optimize_memory_usage else None
        return small

    def restore(self, small: dict[str, Any], pieces: Iterable[tuple[int, dict[str, np.ndarray]]]) -> None:
        """
        Put rows back into a buffer made like the saved one.

        :param small: from :meth:`small`
        :param pieces: first row and rows, oldest first
        :raises ValueError: they are of another buffer, or some are missing
        """
        n_rows, size = small.get("n_rows"), small.get("size")
        if type(n_rows) is not int or type(size) is not int or not 0 <= size <= n_rows < 2**63:
            raise ValueError(f"of the buffer's rows {size!r:.50} of {n_rows!r:.50} are to be there")
        followed = _Followed(pieces, self.buffer)
        if isinstance(self.buffer, CompactReplay):
            changing, own = small.get("changing", {}), small.get("own", {})
            if not (isinstance(changing, dict) and isinstance(own, dict)):
                raise ValueError(f"what changes in the buffer cannot be {changing!r:.50} and {own!r:.50}")
            self.buffer.check_own_numbers(own)
            self.buffer.restore_rows(followed)
            self.buffer.load_changing_state(changing)
            self.buffer.load_own_numbers(own)
        else:
            self._restore(small, followed)
        complete = followed.end == n_rows and n_rows - followed.begin >= size
        if self.size() != size or not (complete or size == 0):
            raise ValueError(f"the rows {followed.begin} to {followed.end} are there, of {size} up to {n_rows}")
        self.n_rows = self.n_written = n_rows
        self._count = self._counter()

    def _restore(self, small: dict[str, Any], pieces: Iterable[tuple[int, dict[str, np.ndarray]]]) -> None:
        columns = self._columns()
        own = numbers_of(self.buffer)
        numbers = small["numbers"]
        for name, value in numbers.items():
            fixed = name in ("buffer_size", "n_envs", "optimize_memory_usage")
            # A subclass's number may begin as 0 and become 0.5.
            like = type(value) is type(own.get(name)) or (
                name not in _COUNTS and {type(value), type(own.get(name))} == {int, float}
            )
            if name not in own or not like or (fixed and value != own[name]):
                raise ValueError(f"the buffer's {name:.50} cannot be {value!r:.50}")
        if numbers["pos"] != small["n_rows"] % self.capacity:
            raise ValueError(f"the buffer's pos cannot be {numbers['pos']} after {small['n_rows']} rows")
        for first, rows in pieces:
            if rows.keys() != columns.keys():
                raise ValueError(f"the buffer has the columns {sorted(columns)}, the saved one {sorted(rows)}")
            places = np.arange(first, first + len(rows["actions"])) % self.capacity
            for name, values in rows.items():
                array = columns[name]
                if values.shape != (len(places), *array.shape[1:]):
                    raise ValueError(f"the buffer's {name} are {tuple(array.shape[1:])}, the saved {values.shape[1:]}")
                if isinstance(array, torch.Tensor):
                    array[torch.from_numpy(places).to(array.device)] = torch.from_numpy(values).to(array)
                else:
                    array[places] = values
        for name, value in numbers.items():
            setattr(self.buffer, name, value)
        for name, value in small["arrays"].items():
            array = getattr(self.buffer, name) if name in _SMALL else None
            if not isinstance(value, np.ndarray) or array is None or value.shape != array.shape:
                raise ValueError(f"the buffer has no {name:.50} of shape {np.shape(value)}")
            array[...] = value
        if small["head"] is not None:
            head = self.buffer.observations[self.buffer.pos]
            if np.shape(small["head"]) != head.shape:
                raise ValueError(f"the buffer's observations are {head.shape}, the last one {np.shape(small['head'])}")
            check_values({"observations": np.asarray(small["head"])}, "the last row", self.buffer)
            head[...] = small["head"]
        check_episodes(self.buffer, "the buffer")
        if isinstance(self.buffer, HasColumns):
            self.buffer._restored()

    def interrupt(self) -> None:
        """
        End the episodes in progress, without a signal from their environments: no later row belongs to them.
        """
        if self.size() == 0:
            return
        end_episodes(self.buffer)
        # The last row has changed, and is written once more.
        self.n_written = max(self.n_rows - 1, 0)


class _Followed:
    """
    Pieces, and the rows at which the first begins and the last ends.

    :param pieces: first row and rows, oldest first
    :param buffer: the replay buffer that they are for
    """

    def __init__(self, pieces: Iterable[tuple[int, dict[str, np.ndarray]]], buffer: ReplayBuffer):
        self._pieces, self._buffer = pieces, buffer
        self.begin = self.end = 0

    def __iter__(self) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        for number, (first, rows) in enumerate(self._pieces):
            if not (isinstance(rows, dict) and all(isinstance(value, np.ndarray) for value in rows.values())):
                raise ValueError(f"the rows from {first} on are no arrays")
            check_values(rows, f"the rows from {first} on", self._buffer)
            if number == 0:
                self.begin = first
            elif not self.begin <= first <= self.end:
                raise ValueError(f"the rows {self.begin} to {self.end} are followed by those from {first} on")
            self.end = first + len(rows["actions"])
            yield first, rows
