"""Next observations without a separate array: the observations of the next rows, and a side store."""

from typing import Any

import numpy as np

from sb3_sample.replay.memory_map import zeros

#: Value of ``slot`` where the next row's observation is the next observation.
NEXT_ROW = -1
#: Key of the only observation, if observations are not dicts.
ONLY = ""


def taken(array: Any, places: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """
    Gather rows of one environment each.

    :param array: (rows, n_envs, ...), or an object that is read like an array and has its own ``take``
    :param places: row * n_envs + environment of each, (N,)
    :param out: memory for the result, (N, ...), (N, 1) if it is one number; None for new memory
    :return: the rows
    """
    if isinstance(array, np.ndarray):
        return array.reshape(-1, *(array.shape[2:] or (1,))).take(places, axis=0, out=out, mode="clip")
    return array.take(places, out)  # type: ignore[no-any-return]


class SideStore:
    """
    Store of the next observations that no row holds, indexed by a number, their slot. Slots 0 to ``n_envs - 1`` belong
    to the newest row, which no row follows yet. The store grows on demand.

    :param like: shape and type of the observations, by key
    :param n_envs: number of environments
    :param folder: the folder whose files hold it; None for the memory
    """

    def __init__(self, like: dict[str, tuple[tuple[int, ...], Any]], n_envs: int, folder: str | None):
        self._n_envs, self._folder = n_envs, folder
        self.slots_of_newest = np.arange(n_envs, dtype=np.int32)
        #: (capacity, O) each.
        self.arrays = {key: zeros(folder, (n_envs, *shape), dtype) for key, (shape, dtype) in like.items()}
        self._free: list[int] = []

    def __len__(self) -> int:
        """Number of observations stored, without those of the newest row."""
        return self._capacity() - self._n_envs - len(self._free)

    def _capacity(self) -> int:
        return len(next(iter(self.arrays.values())))

    def newest(self) -> dict[str, np.ndarray]:
        """
        Return the slots of the newest row.

        :return: the next observations of the newest row, to be read and written, (n_envs, O) each
        """
        return {key: array[: self._n_envs] for key, array in self.arrays.items()}

    def put(self, values: dict[str, np.ndarray]) -> list[int]:
        """
        Store next observations.

        :param values: next observations, (n, O) each
        :return: their slots
        """
        n = len(next(iter(values.values())))
        if n > len(self._free):
            self._grow(n - len(self._free))
        slots = [self._free.pop() for _ in range(n)]
        for key, array in self.arrays.items():
            array[slots] = values[key]
        return slots

    def _grow(self, n: int) -> None:
        old = self._capacity()
        new = old + max(n, old // 4, 16)
        longer = {key: zeros(self._folder, (new, *array.shape[1:]), array.dtype) for key, array in self.arrays.items()}
        for key, array in self.arrays.items():
            longer[key][:old] = array
        self.arrays = longer
        self._free.extend(range(new - 1, old - 1, -1))

    def free(self, slots: np.ndarray) -> None:
        """
        Free slots.

        :param slots: slots that are not needed any more; those below ``n_envs`` are ignored
        """
        self._free.extend(slots[slots >= self._n_envs].tolist())

    def clear(self) -> None:
        """Free all slots."""
        self._free = list(range(self._capacity() - 1, self._n_envs - 1, -1))


class NextObservations:
    """
    Next observations of a buffer, read like an array: indices of rows and environments come first. Rows that were never
    stored are undefined.

    :param buffer: the buffer
    :param key: key of the observation, in a dict of them
    """

    def __init__(self, buffer: Any, key: str = ONLY):
        self._buffer, self._key = buffer, key
        observations = buffer.stored()[key]
        self.shape, self.dtype, self.ndim = observations.shape, observations.dtype, observations.ndim

    def __len__(self) -> int:
        return self.shape[0]

    def take(self, places: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """
        Gather next observations.

        :param places: position * n_envs + environment of each, (N,)
        :param out: memory for the result, (N, O); None for new memory
        :return: the next observations there
        """
        n_envs, n = self.shape[1], self.shape[0] * self.shape[1]
        following = places + n_envs
        following[following >= n] -= n  # the row after the last one is the first
        rows = taken(self._buffer.stored()[self._key], following, out)
        slots = self._buffer.slot.reshape(n).take(places)
        apart = np.flatnonzero(slots != NEXT_ROW)
        if len(apart):
            rows[apart] = self._buffer.aside.arrays[self._key][slots[apart]].reshape(-1, *rows.shape[1:])
        return rows

    def __getitem__(self, index: Any) -> Any:
        parts = index if isinstance(index, tuple) else (index,)
        if any(part is None or part is Ellipsis for part in parts):
            return np.asarray(self)[index]
        rows, *others = parts
        if not isinstance(rows, slice) and np.asarray(rows).dtype == bool:
            rows, *envs = np.nonzero(rows)
            others = [*envs, *others]
        env, rest = tuple(others[:1]), others[1:]
        if isinstance(rows, slice):
            rows = np.arange(*rows.indices(len(self)))
            if env and not isinstance(env[0], slice):
                rows = rows.reshape(-1, *(1,) * np.ndim(env[0]))
        rows = np.asarray(rows, dtype=np.intp)
        slots = np.asarray(self._buffer.slot[(rows, *env)])
        found = self._buffer.stored()[self._key][((rows + 1) % len(self), *env)]
        if rows.ndim == 0:  # one row, which NumPy does not copy
            found = found.copy()
        apart = slots != NEXT_ROW
        found[apart] = self._buffer.aside.arrays[self._key][slots[apart]]
        return found[(*(slice(None),) * slots.ndim, *rest)]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("next observations are not stored as an array: reading them all makes one")
        rows = self.take(np.arange(self.shape[0] * self.shape[1])).reshape(self.shape)
        return rows if dtype is None else rows.astype(dtype)
