"""
Replay buffers that store one observation per step: the next observation of a step is, nearly always, the observation
of the step after it.
"""

import functools
import os
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer

from sb3_sample.kinds import check_value, integer
from sb3_sample.replay import memory_map as files
from sb3_sample.replay.columns import NEXT_OBSERVATIONS, OBSERVATIONS, HasColumns, samples_at
from sb3_sample.replay.frames import OLDER, OLDER_FRAMES, StackedFrames
from sb3_sample.replay.next_observations import NEXT_ROW, ONLY, NextObservations, SideStore
from sb3_sample.warn import warn

try:  # As in Stable-Baselines3: without it the free memory is not checked.
    import psutil
except ImportError:
    psutil = None


#: Prefix in files of the names of state that changes in rows already stored; no column's name has it.
_CHANGING = "changing/"
#: Prefix in files of the numbers that a subclass keeps.
_OWN = "own/"
#: Numbers that follow from arguments or rows.
_GIVEN = frozenset(
    (
        "buffer_size", "n_envs", "action_dim", "pos", "full", "optimize_memory_usage", "handle_timeout_termination",
        "frame_stack", "n_steps", "gamma", "fade", "fade_floor", "horizon", "validation_proportion", "_first", "_last",
    )
)  # fmt: skip


def _file_name(column: str, key: str) -> str:
    return f"{column}/{key}" if key else column


class CompactReplay(HasColumns):
    """
    Replay buffer that stores one observation per step.

    The next observation of row t is the observation of row t + 1, except where the two differ in a bit: at the end of
    an episode, where ``learn`` reset the environment, or where the sequence broke otherwise. The two are compared when
    row t + 1 is stored, and a next observation that differs is kept aside. So every transition equals that of
    Stable-Baselines3's buffer, time limits included, and none is lost when the buffer is full.

    :param buffer_size: capacity in transitions
    :param observation_space: of the environment
    :param action_space: of the environment
    :param device: device of the samples
    :param n_envs: number of environments
    :param optimize_memory_usage: has no effect: the buffer always stores one observation per step
    :param handle_timeout_termination: whether a time limit is not a termination
    :param memory_map: a folder, made if it is missing, whose files hold the buffer instead of the memory. The files
        have no names and vanish with the buffer: runs cannot share them, and nothing is left to delete. None for the
        memory
    :param frame_stack: number of frames in an observation along its first axis, the newest last. Each frame is then
        stored once, and frames are stacked when they are read. 1 or None: observations are stored as they are
    :raises ValueError: if ``memory_map`` cannot be written to or lacks the space, or observations do not consist of so
        many frames
    """

    buffer_size: int
    n_envs: int
    pos: int
    full: bool
    observations: Any
    observation_space: Any
    memory_map: str | None
    #: Where the next observation is: in the next row, or aside, in this slot; (buffer_size, n_envs).
    slot: np.ndarray
    aside: SideStore

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: torch.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        memory_map: str | os.PathLike[str] | None = None,
        frame_stack: int | None = None,
    ):
        assert isinstance(self, ReplayBuffer)
        # The constructors in between make arrays for two observations per step.
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        # True means the layout that overwrites the last next observation of an episode.
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        rows = (self.buffer_size, self.n_envs)
        one = OBSERVATIONS.layout(self)
        #: Frames that an observation consists of; None for none.
        self.frame_stack = _n_frames(frame_stack, observation_space)
        layout = {key: ((*rows, *shape), dtype) for key, (shape, dtype) in one.items()}
        plain = {column.name: column.layout(self)[ONLY] for column in self.plain_columns}
        columns = {name: ((*rows, *shape), dtype) for name, (shape, dtype) in plain.items()} | {
            "slot": (rows, np.int32)
        }
        n_frames = self.frame_stack
        stored_as = {
            key: (shape if n_frames is None else StackedFrames.layout(shape, n_frames), dtype)
            for key, (shape, dtype) in layout.items()
        }
        needed = sum(files.n_bytes(*array) for array in [*stored_as.values(), *columns.values()])
        #: The folder that holds the arrays; None if the memory does.
        self.memory_map = None if memory_map is None else files.check_folder(memory_map, needed)
        if memory_map is None and psutil is not None and needed > (available := psutil.virtual_memory().available):
            warn(
                f"the full replay buffer takes {needed / 1e9:.2f} GB, and {available / 1e9:.2f} GB of memory are free: "
                "pass a smaller buffer_size, or replay_buffer_kwargs={'memory_map': <folder>}"
            )
        zeros = functools.partial(files.zeros, self.memory_map)
        stored: dict[str, Any] = {
            key: zeros(*array) if n_frames is None else StackedFrames(*array, n_frames, self.memory_map)
            for key, array in layout.items()
        }
        self.observations = stored if isinstance(observation_space, spaces.Dict) else stored[ONLY]
        for name, array in columns.items():
            if name in vars(self):
                raise ValueError(f"more_columns of {type(self).__name__} has the name {name!r}, which is taken")
            setattr(self, name, zeros(*array))
        self.slot[...] = NEXT_ROW
        self.aside = SideStore(one, self.n_envs, self.memory_map)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if self.memory_map is None:
            return
        # A copied or unpickled buffer is in memory.
        self.memory_map = files.check_folder(self.memory_map, sum(array.nbytes for array in self.stored().values()))
        frames = self._frames
        if frames is not None:
            frames.to_files(self.memory_map)
        else:
            stored = {key: files.moved(self.memory_map, array) for key, array in self.stored().items()}
            self.observations = stored if isinstance(self.observations, dict) else stored[ONLY]
        for name in (*(column.name for column in self.plain_columns), "slot"):
            setattr(self, name, files.moved(self.memory_map, getattr(self, name)))
        self.aside.arrays = {key: files.moved(self.memory_map, array) for key, array in self.aside.arrays.items()}

    def stored(self) -> dict[str, np.ndarray]:
        """
        Return the arrays of observations.

        :return: the observations by key, (buffer_size, n_envs, O) each
        """
        return self.observations if isinstance(self.observations, dict) else {ONLY: self.observations}

    @property
    def _frames(self) -> StackedFrames | None:
        """The observations, if their frames are stored once."""
        return self.observations if isinstance(self.observations, StackedFrames) else None

    @property
    def next_observations(self) -> Any:
        """Next observations, or a dict of them, to be read like an array of (buffer_size, n_envs, O)."""
        if isinstance(self.observations, dict):
            return {key: NextObservations(self, key) for key in self.observations}
        return NextObservations(self)

    def _following(self, places: np.ndarray) -> dict[str, np.ndarray]:
        return {key: NextObservations(self, key).take(places) for key in self.stored()}

    # ---------------------------------------------------------------- adding

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition of each environment, as in Stable-Baselines3.

        :raises ValueError: if something has another shape than its space; nothing is stored then
        """
        assert isinstance(self, ReplayBuffer)
        given = (obs, next_obs, action, reward, done, infos)
        writers = self.writers()
        now, after, *rows = [write(given) for _, write in writers]
        pos = self.pos
        if self.size() > 0 and self.buffer_size > 1:
            self._settle((pos - 1) % self.buffer_size, now)
        self._replacing(pos)
        if self.full:
            self.aside.free(self.slot[pos])
        for key, array in self.stored().items():
            array[pos] = now[key]
        self._set_newest(pos, after)
        own = vars(self)
        for (name, _), row in zip(writers[2:], rows):  # noqa: B905  # as many, by the line above
            own[name][pos] = row
        self.pos = pos + 1
        if self.pos == self.buffer_size:
            self.full, self.pos = True, 0

    def _replacing(self, row: int) -> None:
        """Called when a step is about to be stored in a row."""

    def _set_newest(self, row: int, following: dict[str, np.ndarray]) -> None:
        for key, array in self.aside.newest().items():
            array[...] = following[key]
        self.slot[row] = self.aside.slots_of_newest

    def _settle(self, row: int, now: dict[str, np.ndarray]) -> None:
        """Decide where the next observation of the newest row is, given the observation of the row that follows."""
        pending = self.aside.newest()
        if all(array.tobytes() == now[key].tobytes() for key, array in pending.items()):
            self.slot[row] = NEXT_ROW
            return  # nearly always
        differs = np.zeros(self.n_envs, dtype=bool)
        for key, array in pending.items():
            a, b = (np.ascontiguousarray(x).reshape(self.n_envs, -1).view(np.uint8) for x in (array, now[key]))
            differs |= (a != b).any(axis=1)
        # The disk may turn out to be full here: nothing has changed yet.
        slots = self.aside.put({key: array[differs] for key, array in pending.items()})
        self.slot[row] = NEXT_ROW
        self.slot[row, differs] = slots

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()  # type: ignore[misc]  # the buffer's
        self.slot[...] = NEXT_ROW
        self.aside.clear()
        if self._frames is not None:
            self._frames.clear()

    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> Any:
        if not self.more_in_batch:
            return super()._get_samples(batch_inds, env)  # type: ignore[misc]  # the buffer's
        # The environments are drawn as in the base class.
        env_indices = np.random.randint(0, high=self.n_envs, size=len(batch_inds))  # noqa: NPY002
        return samples_at(self, batch_inds, env_indices, env)  # type: ignore[arg-type]

    # ---------------------------------------------------------------- to and from files

    def columns(self) -> dict[str, np.ndarray]:
        """
        List the arrays of the rows.

        :return: the columns of a row except its next observation, by name, (buffer_size, n_envs, ...) each; the
            observations are ``observations``, or ``observations/<key>``; for stacked frames the newest ones
        """
        assert isinstance(self, ReplayBuffer)
        frames = self._frames
        stored = self.stored() if frames is None else {ONLY: frames.frames[:-1]}
        columns = {_file_name(OBSERVATIONS.name, key): array for key, array in stored.items()}
        return columns | {column.name: getattr(self, column.name) for column in self.plain_columns}

    def _apart(self, index: np.ndarray, places: np.ndarray) -> dict[str, np.ndarray]:
        """Next observations that are not the next row's, by ``index``, in the layout of files."""
        values = self._following(places)
        return {"next_index": index} | {_file_name(NEXT_OBSERVATIONS.name, key): value for key, value in values.items()}

    def _older(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Older frames of rows, in the layout of files."""
        return {} if self._frames is None else self._frames.described(rows)

    def new_rows(self, n: int) -> dict[str, np.ndarray]:
        """
        Copy the newest steps of every environment, complete without the rows before them.

        :param n: how many
        :return: copies of the :meth:`columns`, oldest step first, (n, n_envs, ...) each; ``next_index``, (M,), the
            places (step * n_envs + environment) whose next observation is not the observation of the next step, among
            them the whole last step; ``next_observations`` (or ``next_observations/<key>``), (M, O), the next
            observations of these places; for stacked frames also the result of ``StackedFrames.described``
        :raises ValueError: if the buffer holds fewer
        """
        assert isinstance(self, ReplayBuffer)
        if not 0 <= n <= self.size():
            raise ValueError(f"n must lie between 0 and {self.size()}, the steps in the replay buffer, not {n}")
        rows = np.arange(self.pos - n, self.pos) % self.buffer_size
        index = np.flatnonzero(self.slot[rows] != NEXT_ROW)
        steps, envs = np.divmod(index, self.n_envs)
        copies = {name: np.array(array[rows]) for name, array in self.columns().items()}
        return copies | self._apart(index, rows[steps] * self.n_envs + envs) | self._older(rows)

    def restore_rows(self, pieces: Iterable[tuple[int, dict[str, np.ndarray]]]) -> None:
        """
        Restore the buffer that :meth:`new_rows` was called on, row for row; its own content is dropped.

        :param pieces: the number of the first step, counted over the run such that step i lies in row
            i % ``buffer_size``; and the steps from there on. A piece continues where the one before ended, or replaces
            its last steps
        :raises ValueError: if they are of another buffer, or a piece is missing
        """
        self.reset()
        begin = end = 0
        for number, (first, piece) in enumerate(pieces):
            n = len(piece["actions"])
            self._check_rows(piece, n, n - 1)
            begin, end = (first, first) if number == 0 else (begin, end)
            if not max(begin, end - self.buffer_size) <= first <= end or first + n < end:
                raise ValueError(f"the steps {begin} to {end} are followed by those from {first} to {first + n}")
            rows = np.arange(first, first + n) % self.buffer_size
            if n > 0:
                self._replace(rows, piece, keeps_before=begin < first and n < self.buffer_size)
            end = first + n
            self.pos, self.full = end % self.buffer_size, end - begin >= self.buffer_size
        if begin % self.buffer_size != 0 and not self.full:
            raise ValueError(f"the steps before step {begin} are missing")
        self._restored()

    def _replace(self, rows: np.ndarray, piece: dict[str, np.ndarray], keeps_before: bool) -> None:
        """
        Store steps, and join them to the row before.

        :param rows: where the steps go, in their order
        :param piece: the steps
        :param keeps_before: whether the row before them holds the step before them
        """
        before = (rows[0] - 1) % self.buffer_size
        if keeps_before:
            # For now the row before is the newest: the place of its next observation may change.
            following = self._following(before * self.n_envs + np.arange(self.n_envs))
            self.aside.free(self.slot[before])
            self._set_newest(before, following)
            self._settle(before, self._first_of(piece))
        self.aside.free(self.slot[rows].reshape(-1))
        self._put(rows, piece, len(rows) - 1)

    def _first_of(self, piece: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Observations of the first step from a file, whose older frames come from no other step of the file."""
        newest = {key: piece[_file_name(OBSERVATIONS.name, key)][0] for key in self.stored()}
        frames = self._frames
        if frames is None:
            return newest
        alone = StackedFrames((1, *frames.shape[1:]), frames.dtype, frames.n_frames, None)
        n_apart = int((piece[OLDER][0] < -1).sum())
        alone.put(
            np.arange(1), newest[ONLY][None], {OLDER: piece[OLDER][:1], OLDER_FRAMES: piece[OLDER_FRAMES][:n_apart]}
        )
        return {ONLY: alone[0]}

    def _put(self, rows: np.ndarray, piece: dict[str, np.ndarray], newest: int) -> None:
        """
        Write steps into rows.

        :param rows: where the steps go
        :param piece: the steps
        :param newest: which of them is the newest
        """
        if self._frames is not None:
            self._frames.put(rows, piece[OBSERVATIONS.name], piece)
        for name, array in self.columns().items():
            array[rows] = piece[name]
        self.slot[rows] = NEXT_ROW
        steps, envs = np.divmod(piece["next_index"], self.n_envs)
        values = {key: piece[_file_name(NEXT_OBSERVATIONS.name, key)] for key in self.stored()}
        last = steps == newest
        slots = self.aside.put({key: value[~last] for key, value in values.items()})
        self.slot[rows[steps[~last]], envs[~last]] = slots
        self._set_newest(rows[newest], {key: value[last] for key, value in values.items()})

    def _check_rows(self, piece: dict[str, np.ndarray], n: int, newest: int) -> None:
        """
        Check rows from a file.

        :param piece: rows from a file
        :param n: number of rows that they must be
        :param newest: which of them is the newest
        :raises ValueError: if they are not rows of this buffer
        """
        shapes = {name: ((n, *array.shape[1:]), array.dtype) for name, array in self.columns().items()}
        index = piece.get("next_index", np.zeros(0, np.int64))
        shapes |= {
            _file_name(NEXT_OBSERVATIONS.name, key): ((len(index), *array.shape[2:]), array.dtype)
            for key, array in self.stored().items()
        }
        names = {*shapes, "next_index", *(() if self._frames is None else (OLDER, OLDER_FRAMES))}
        if piece.keys() != names:
            raise ValueError(f"this buffer's columns are {sorted(names)}, the saved {sorted(piece)}")
        for name, (shape, dtype) in shapes.items():
            if (piece[name].shape, piece[name].dtype) != (shape, dtype):
                raise ValueError(
                    f"{name} must be {dtype} of shape {shape} in this buffer, but the saved ones are "
                    f"{piece[name].dtype} of shape {piece[name].shape}"
                )
        last = np.arange(newest * self.n_envs, (newest + 1) * self.n_envs) if n > 0 else index[:0]
        if n > self.buffer_size:
            raise ValueError(f"{n} steps do not fit into a buffer of {self.buffer_size}")
        rises = index.dtype == np.int64 and index.ndim == 1 and (np.diff(index) > 0).all()
        if (
            not rises
            or not np.isin(last, index).all()
            or (len(index) and not 0 <= index[0] <= index[-1] < n * self.n_envs)
        ):
            raise ValueError("next_index must be rising places of the saved steps, among them all of the newest step")
        if self._frames is not None:
            self._frames.check(piece, n, newest)

    def state_dict(self) -> dict[str, Any]:
        """
        Collect the buffer's state.

        :return: the numbers ``pos``, ``full``, ``buffer_size`` and ``n_envs``, those of a subclass, and arrays: the
            filled part of each of the :meth:`columns`, not copied, and the next observations in the form of
            :meth:`new_rows`, with ``next_index`` naming places of the buffer
        """
        assert isinstance(self, ReplayBuffer)
        size = self.size()
        index = np.flatnonzero(self.slot[:size] != NEXT_ROW)
        numbers = {name: getattr(self, name) for name in ("pos", "full", "buffer_size", "n_envs")}
        numbers |= {f"{_OWN}{name}": value for name, value in self.own_numbers().items()}
        changing = {f"{_CHANGING}{name}": value for name, value in self.changing_state().items()}
        rows = {name: array[:size] for name, array in self.columns().items()}
        return numbers | rows | self._apart(index, index) | self._older(np.arange(size)) | changing

    def own_numbers(self) -> dict[str, float]:
        """
        Collect the numbers that a subclass of one's own keeps, such as an exponent that changes in the training.

        :return: attributes that are numbers or true or false, by name
        """
        return {name: value for name, value in numbers_of(self).items() if name not in _GIVEN}

    def load_own_numbers(self, numbers: dict[str, Any]) -> None:
        """
        Restore the numbers that a subclass keeps.

        :param numbers: from :meth:`own_numbers`
        :raises ValueError: see :meth:`check_own_numbers`
        """
        self.check_own_numbers(numbers)
        vars(self).update(numbers)

    def check_own_numbers(self, numbers: dict[str, Any]) -> None:
        """
        Check numbers before anything is restored.

        :param numbers: from :meth:`own_numbers`
        :raises ValueError: if this buffer has none of a name, or something else is given for it
        """
        own = self.own_numbers()
        for name, value in numbers.items():
            is_alike = is_number_or_flag(value) and isinstance(value, bool) == isinstance(own.get(name), bool)
            if name not in own or not is_alike:
                raise ValueError(f"the buffer's {name:.50} cannot be {value!r:.50}")

    def changing_state(self) -> dict[str, Any]:
        """
        Collect the state that changes in rows already stored.

        :return: numbers and arrays by name; nothing here
        """
        return {}

    def load_changing_state(self, state: dict[str, Any]) -> None:
        """
        Restore the state that changes in rows already stored, after the rows.

        :param state: from :meth:`changing_state` of a buffer of the same sizes
        :raises ValueError: if it is of another buffer
        """
        if state:
            raise ValueError(f"this buffer's rows do not change, but the saved ones have {sorted(state)}")

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Restore the buffer's state.

        :param state: from :meth:`state_dict` of a buffer of the same sizes
        :raises ValueError: if it is of another buffer
        """
        for name in ("buffer_size", "n_envs"):
            if state.get(name) != getattr(self, name):
                raise ValueError(
                    f"{name} is {getattr(self, name)} in this buffer, but {state.get(name)!r} in the saved one"
                )
        pos, full = state.get("pos"), state.get("full")
        if type(pos) is not int or type(full) is not bool or not 0 <= pos < self.buffer_size:
            raise ValueError(f"no state of a replay buffer: pos={pos!r}, full={full!r}")
        changing = {name.removeprefix(_CHANGING): state[name] for name in state if name.startswith(_CHANGING)}
        numbers = {name.removeprefix(_OWN): state[name] for name in state if name.startswith(_OWN)}
        others = ("pos", "full", "buffer_size", "n_envs")
        piece = {name: state[name] for name in state if name not in others and not name.startswith((_CHANGING, _OWN))}
        size = self.buffer_size if full else pos
        newest = (pos - 1) % self.buffer_size
        self._check_rows(piece, size, newest)
        self.check_own_numbers(numbers)
        self.reset()
        if size > 0:
            self._put(np.arange(size), piece, newest)
        self.pos, self.full = pos, full
        self._restored()
        self.load_changing_state(changing)
        self.load_own_numbers(numbers)


def numbers_of(owner: Any) -> dict[str, float]:
    """
    :param owner: an object
    :return: its attributes that are numbers, or true or false, by name, those of NumPy as Python's
    """
    found = {name: value for name, value in vars(owner).items() if is_number_or_flag(value)}
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in found.items()}


def is_number_or_flag(value: Any) -> bool:
    """
    :param value: any value
    :return: whether it is a real number, or true or false, Python's or NumPy's
    """
    return isinstance(value, (bool, int, float, np.bool_, np.integer, np.floating))


def _n_frames(frame_stack: Any, space: spaces.Space) -> int | None:
    """Frames of an observation, checked; None for one."""
    check_value("frame_stack", frame_stack, integer(1).or_none())
    if frame_stack is None or frame_stack == 1:
        return None
    if not isinstance(space, spaces.Box) or len(space.shape) < 1 or space.shape[0] % frame_stack:
        raise ValueError(
            f"frame_stack={frame_stack} must divide the first axis of observations, which are a Box, not {space}"
        )
    return int(frame_stack)


class CompactReplayBuffer(CompactReplay, ReplayBuffer):  # type: ignore[misc, override]  # next_observations is a view
    __doc__ = CompactReplay.__doc__


class CompactDictReplayBuffer(CompactReplay, DictReplayBuffer):  # type: ignore[misc, override]  # next_observations is a view
    """Replay buffer for dict observations that stores one observation per step."""


class CompactNStepReplayBuffer(CompactReplay, NStepReplayBuffer):  # type: ignore[misc, override]  # next_observations is a view
    """
    Replay buffer for n-step returns, like Stable-Baselines3's, that stores one observation per step.

    :param args: as in ``CompactReplayBuffer``
    :param kwargs: as in ``CompactReplayBuffer``
    :param n_steps: steps whose rewards are summed
    :param gamma: discount factor
    """

    def __init__(self, *args: Any, n_steps: int = 3, gamma: float = 0.99, **kwargs: Any):
        if self.more_in_batch:
            raise ValueError(f"more_columns of {type(self).__name__}: n-step returns are of no single transition")
        super().__init__(*args, **kwargs)
        self.n_steps, self.gamma = n_steps, gamma
