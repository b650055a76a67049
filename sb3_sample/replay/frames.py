"""Observations that are stacks of the latest frames, each frame stored once."""

import math
from typing import Any

import numpy as np

from sb3_sample.replay import memory_map as files
from sb3_sample.replay.next_observations import ONLY, SideStore

#: Codes of an older frame in files: all zeros; among those that the piece holds apart.
_ZEROS, _APART = -1, -2
#: Entries of files: where the older frames of each observation are, and those that are not of the same piece.
OLDER, OLDER_FRAMES = "older", "older_frames"


class StackedFrames:
    """
    Observations of a buffer, each a stack of k frames along its first axis, the newest last. Read like an array of
    (rows, n_envs, k * C, ...): indices of rows and environments come first.

    A row stores its newest frame. Each older frame is a frame of an earlier row, as referenced by the row before; the
    row's own newest frame, as at an episode's start; all zeros; or, if it equals none of these bit by bit, kept aside.
    So reads return what was stored, whatever the environment does, and frames of consecutive observations are stored
    once.

    :param shape: (rows, n_envs, k * C, ...)
    :param dtype: of the observations
    :param n_frames: k, at least 2
    :param folder: the folder whose files hold the frames; None for the memory
    """

    def __init__(self, shape: tuple[int, ...], dtype: Any, n_frames: int, folder: str | None):
        self.shape, self.dtype, self.ndim, self.n_frames = shape, np.dtype(dtype), len(shape), n_frames
        n_rows, self._n_envs = shape[:2]
        #: Newest frame of each row, (rows + 1, n_envs, C, ...), and a last row of zeros.
        self.frames = files.zeros(folder, self.layout(shape, n_frames), dtype)
        #: Where the frames of each row are, the oldest first, (rows, n_envs, k): place (row * n_envs + environment) of
        #: a newest frame or of zeros; below 0, -1 minus the slot aside.
        self.at = np.empty((n_rows, self._n_envs, n_frames), np.int32)
        self.aside = SideStore({ONLY: (self.frames.shape[2:], dtype)}, 0, folder)
        self.clear()

    @staticmethod
    def layout(shape: tuple[int, ...], n_frames: int) -> tuple[int, ...]:
        """
        Shape of the frames.

        :param shape: (rows, n_envs, k * C, ...)
        :param n_frames: k
        :return: (rows + 1, n_envs, C, ...)
        """
        n_rows, n_envs, n_channels, *rest = shape
        return (n_rows + 1, n_envs, n_channels // n_frames, *rest)

    @property
    def nbytes(self) -> int:
        """Number of bytes used."""
        return int(self.frames.nbytes + self.at.nbytes + self.aside.arrays[ONLY].nbytes)

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def _flat(self) -> np.ndarray:
        """The frames by their place, (places, numbers of a frame)."""
        return self.frames.reshape(-1, math.prod(self.frames.shape[2:]))

    def clear(self) -> None:
        """Forget all rows."""
        n_rows, envs = self.shape[0], np.arange(self._n_envs)
        self.at[...] = (n_rows * self._n_envs + envs)[:, None]
        self.at[..., -1] = np.arange(n_rows)[:, None] * self._n_envs + envs
        self.aside.clear()

    def to_files(self, folder: str) -> None:
        """
        Keep the frames in files from now on.

        :param folder: the files' folder
        """
        self.frames = files.moved(folder, self.frames)
        self.aside.arrays = {key: files.moved(folder, array) for key, array in self.aside.arrays.items()}

    # ---------------------------------------------------------------- reading

    def take(self, places: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """
        Gather observations.

        :param places: row * n_envs + environment of each, (N,)
        :param out: memory for the result, contiguous, (N, k * C, ...); None for new memory
        :return: the observations there
        """
        return self._stacked(self.at.reshape(-1, self.n_frames).take(places, axis=0), out)

    def _stacked(self, at: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        if out is None:
            out = np.empty((*at.shape[:-1], *self.shape[2:]), self.dtype)
        self._gathered(at.reshape(-1), out.reshape(at.size, -1))
        return out

    def _gathered(self, at: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Single frames, (n, numbers of a frame)."""
        self._flat.take(at, axis=0, out=out, mode="clip")
        apart = np.flatnonzero(at < 0)
        if len(apart):
            out[apart] = self.aside.arrays[ONLY].reshape(-1, out.shape[1])[-1 - at[apart]]
        return out

    def __getitem__(self, index: Any) -> np.ndarray:
        parts = index if isinstance(index, tuple) else (index,)
        if any(part is None or part is Ellipsis for part in parts):
            return np.asarray(self)[index]  # type: ignore[no-any-return]
        is_mask = len(parts) > 0 and np.asarray(parts[0]).dtype == bool if not isinstance(parts[0], slice) else False
        n = 1 if is_mask and np.ndim(parts[0]) == 2 else 2
        at = self.at[parts[:n]]
        return self._stacked(at)[(*(slice(None),) * (at.ndim - 1), *parts[n:])]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("stacks of frames are not stored as an array: reading them all makes one")
        rows = self._stacked(self.at)
        return rows if dtype is None else rows.astype(dtype)

    # ---------------------------------------------------------------- writing

    def __setitem__(self, row: int, values: np.ndarray) -> None:
        """
        Store the observations of one step, of all environments.

        :param row: where they go; the row before must be stored already
        :param values: (n_envs, k * C, ...)
        """
        n_rows, n_envs, flat = self.shape[0], self._n_envs, self._flat
        given = np.ascontiguousarray(values).reshape(n_envs, self.n_frames, -1)
        at, before = self.at[row].copy(), self.at[(row - 1) % n_rows]
        zeros = flat[-1].tobytes()
        apart: list[tuple[int, int]] = []
        for env in range(n_envs):
            newest = given[env, -1].tobytes()
            for i in range(self.n_frames - 1):
                wanted, place = given[env, i].tobytes(), int(before[env, i + 1])
                if place >= 0 and place // n_envs != row and flat[place].tobytes() == wanted:
                    at[env, i] = place
                elif wanted == newest:
                    at[env, i] = at[env, -1]
                elif wanted == zeros:
                    at[env, i] = n_rows * n_envs + env
                else:
                    apart.append((env, i))
        self._make_room(np.array([row]))
        if apart:
            envs, places = np.array(apart).T
            at[envs, places] = -1 - np.array(self._put_aside(given[envs, places]))
        self.frames[row] = given[:, -1].reshape(self.frames.shape[1:])
        self.at[row] = at

    def _put_aside(self, frames: np.ndarray) -> list[int]:
        return self.aside.put({ONLY: frames.reshape(-1, *self.frames.shape[2:])})

    def _make_room(self, rows: np.ndarray) -> None:
        """Before rows are overwritten, free the frames that they keep aside, and put aside those that others need."""
        n_rows = self.shape[0]
        if len(rows) == 1:
            # Older frames are of the k - 1 rows before.
            others = np.unique((rows + np.arange(1, self.n_frames)) % n_rows)
            others = others[others != rows]
        else:
            others = np.setdiff1d(np.arange(n_rows), rows)
        older = self.at[others, :, :-1]
        needed = (older >= 0) & np.isin(older // self._n_envs, rows)
        if needed.any():
            frames = self._flat[older[needed]]
            older[needed] = -1 - np.array(self._put_aside(frames))
            self.at[others, :, :-1] = older
        own = self.at[rows]
        self.aside.free((-1 - own[own < 0]).astype(np.int64))
        self.at[rows, :, :-1] = (n_rows * self._n_envs + np.arange(self._n_envs))[:, None]

    # ---------------------------------------------------------------- to and from files

    def described(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """
        Describe the older frames of rows, for files that hold the newest ones.

        :param rows: the rows, (n,)
        :return: ``older``, (n, n_envs, k - 1), which of these rows has the frame as its newest, or a code below 0 for
            zeros or apart; and ``older_frames``, (M, C, ...), the frames apart, in that order
        """
        index_of = np.full(self.shape[0] + 1, _APART, np.int32)
        index_of[rows] = np.arange(len(rows))
        index_of[-1] = _ZEROS
        older = self.at[rows][..., :-1]
        index = np.where(older < 0, _APART, index_of[np.maximum(older, 0) // self._n_envs]).astype(np.int32)
        places = older[index == _APART]
        frames = self._gathered(places, np.empty((len(places), self._flat.shape[1]), self.dtype))
        return {OLDER: index, OLDER_FRAMES: frames.reshape(-1, *self.frames.shape[2:])}

    def check(self, piece: dict[str, np.ndarray], n: int, newest: int) -> None:
        """
        Check a file's entries of older frames.

        :param piece: rows from a file
        :param n: number of rows that they must be
        :param newest: which of them is the newest
        :raises ValueError: if they are not of these rows
        """
        older, frames = piece.get(OLDER), piece.get(OLDER_FRAMES)
        shape = (n, self._n_envs, self.n_frames - 1)
        if not isinstance(older, np.ndarray) or (older.shape, older.dtype) != (shape, np.dtype(np.int32)):
            raise ValueError(f"{OLDER} must be int32 of shape {shape} in this buffer")
        if n > 0 and not (older.min() >= _APART and older.max() < n):
            raise ValueError(f"{OLDER} must name rows of the same piece, {n} of them")
        # From the oldest step to the newest.
        order = (np.arange(n) - newest - 1) % max(n, 1)
        inside = older >= 0
        ages = np.broadcast_to(order[:, None, None], shape)[inside] - order[older[inside]]
        if ages.size and not (ages.min() >= 0 and ages.max() < self.n_frames):
            raise ValueError(f"{OLDER} must name one of the {self.n_frames - 1} rows before")
        wanted = (int((older == _APART).sum()), *self.frames.shape[2:])
        if not isinstance(frames, np.ndarray) or (frames.shape, frames.dtype) != (wanted, self.dtype):
            raise ValueError(f"{OLDER_FRAMES} must be {self.dtype} of shape {wanted} in this buffer")

    def put(self, rows: np.ndarray, newest: np.ndarray, piece: dict[str, np.ndarray]) -> None:
        """
        Write rows from a file.

        :param rows: where they go, (n,)
        :param newest: their newest frames, (n, n_envs, C, ...)
        :param piece: from :meth:`described`, checked
        """
        if len(rows) == 0:
            return
        self._make_room(rows)
        self.frames[rows] = newest
        older, envs = piece[OLDER].astype(np.int64), np.arange(self._n_envs)[:, None]
        at = np.where(older >= 0, rows[np.maximum(older, 0)], self.shape[0]) * self._n_envs + envs
        at[older == _APART] = -1 - np.array(self._put_aside(piece[OLDER_FRAMES]), np.int64)
        self.at[rows, :, :-1] = at
