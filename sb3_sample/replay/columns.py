"""
Columns of a transition, declared once: they determine what replay buffers store, batches have and files hold.

A custom buffer adds a column by declaring it: ``more_columns = (Column("task", lambda step: ...),)``.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample.learner.batch import for_each
from sb3_sample.replay.next_observations import ONLY
from sb3_sample.replay.rows import action_dtype, as_actions, as_observation, as_row, as_timeouts


class Step(NamedTuple):
    """One step of all environments, as passed to ``add`` of a replay buffer."""

    observation: Any
    next_observation: Any
    action: np.ndarray
    reward: np.ndarray
    done: np.ndarray
    infos: list[dict[str, Any]]


#: The same as an ordinary tuple, which is made in a third of the time.
Given = tuple[Any, Any, Any, Any, Any, Any]


@dataclasses.dataclass(frozen=True)
class Column:
    """
    A column of a transition. It is stored under ``name`` in the buffer, as (buffer_size, n_envs, ...), and in files; a
    batch has it in ``columns[name]``, (B, ...), or (B, 1) if it is one number.

    :param name: its name
    :param read: returns the values of a step, one for each environment; None if the buffer itself writes them
    :param shape: of one environment's value
    :param dtype: of the values; a float must be finite
    :param is_flag: whether it is 0 or 1
    :param in_batch: whether batches have it
    """

    name: str
    read: Callable[[Step], Any] | None
    shape: tuple[int, ...] = ()
    dtype: Any = np.float32
    is_flag: bool = False
    in_batch: bool = True

    @property
    def label(self) -> str:
        """The name in the singular, for messages."""
        return self.name.removesuffix("s").replace("_", " ")

    def layout(self, buffer: Any) -> dict[str, tuple[tuple[int, ...], Any]]:
        """
        Shape and type of one environment's value.

        :param buffer: the buffer that stores it
        :return: both, by the key of an observation, or under ``ONLY``
        """
        return {ONLY: (self.shape, self.dtype)}

    def writer(self, buffer: Any) -> Callable[[Given], Any]:
        """
        Make the function that turns a step into a row.

        :param buffer: the buffer, to which the function keeps no reference
        :return: function from a step to its values in the form in which they are stored, (n_envs, ...). It raises a
            ValueError if they have another shape, are a single value, not finite, no flags where the column has flags,
            or no whole numbers that its type of integers holds
        """
        name, read, shape, dtype = self.name, self.read, (buffer.n_envs, *self.shape), np.dtype(self.dtype)
        is_flag = self.is_flag
        assert read is not None

        where = f"the column {name!r} of {type(buffer).__name__}"

        def write(given: Given) -> np.ndarray:
            try:
                values = np.asarray(read(Step(*given)))
            except Exception as error:
                error.add_note(f"in read of {where}")
                raise
            if values.ndim == 0:
                raise ValueError(f"read of {where} must give a list, one value for each environment, not {values}")
            with np.errstate(invalid="ignore"):  # refused below
                row = as_row(name, values, shape, dtype)
            if row.dtype.kind == "f" and not np.isfinite(row).all():
                raise ValueError(f"the column {name!r} must be finite, not {row[~np.isfinite(row)][0]}")
            if is_flag and (wrong := (values != 0) & (values != 1)).any():
                raise ValueError(f"the column {name!r} must be 0 or 1, not {values[wrong][0]}")
            if row.dtype.kind in "iu" and row.dtype != values.dtype and (row != values).any():
                raise ValueError(f"the column {name!r} must be whole numbers within {row.dtype}, not {values.tolist()}")
            return row

        return write


# Columns of every buffer, whose place in a step is known: each transition passes through them.
class _Observations(Column):
    def layout(self, buffer: Any) -> dict[str, tuple[tuple[int, ...], Any]]:
        space = buffer.observation_space
        if isinstance(space, spaces.Dict):
            return {key: (buffer.obs_shape[key], part.dtype) for key, part in space.spaces.items()}
        return {ONLY: (buffer.obs_shape, space.dtype)}

    def writer(self, buffer: Any) -> Callable[[Given], dict[str, np.ndarray]]:
        """The values by the key of the observation, (n_envs, O) each."""
        space, place = buffer.observation_space, Step._fields.index(self.label.replace(" ", "_"))
        shapes = {key: (buffer.n_envs, *shape) for key, (shape, _) in self.layout(buffer).items()}
        if not isinstance(space, spaces.Dict):
            label, only = self.label, shapes[ONLY]
            return lambda given: {ONLY: as_observation(label, given[place], only, space)}
        parts = [(key, f"{self.label} {key!r}", shapes[key], part) for key, part in space.spaces.items()]
        return lambda given: {
            key: as_observation(name, given[place][key], shape, part) for key, name, shape, part in parts
        }


class _Actions(Column):
    def layout(self, buffer: Any) -> dict[str, tuple[tuple[int, ...], Any]]:
        return {ONLY: ((buffer.action_dim,), action_dtype(buffer.action_space))}

    def writer(self, buffer: Any) -> Callable[[Given], np.ndarray]:
        shape, space = (buffer.n_envs, buffer.action_dim), buffer.action_space
        return lambda given: as_actions(given[2], shape, space)


class _Number(Column):
    def writer(self, buffer: Any) -> Callable[[Given], np.ndarray]:
        # Whether it is finite is checked where it comes from the environment.
        label, place, shape = self.label, Step._fields.index(self.label), (buffer.n_envs,)
        return lambda given: as_row(label, given[place], shape)


class _Timeouts(Column):
    def writer(self, buffer: Any) -> Callable[[Given], Any]:
        n_envs = buffer.n_envs
        return (lambda given: as_timeouts(given[5], n_envs)) if buffer.handle_timeout_termination else lambda given: 0


OBSERVATIONS = _Observations("observations", lambda step: step.observation)
NEXT_OBSERVATIONS = _Observations("next_observations", lambda step: step.next_observation)
ACTIONS = _Actions("actions", lambda step: step.action)
REWARDS = _Number("rewards", lambda step: step.reward)
#: Ends of episodes, and which of them are time limits. A batch's ``dones`` are the ends that are not.
DONES = _Number("dones", lambda step: step.done, is_flag=True)
TIMEOUTS = _Timeouts("timeouts", lambda step: step.infos, is_flag=True)
#: Transitions of the validation side.
HELD_OUT = Column("held_out", None, dtype=bool, is_flag=True, in_batch=False)

#: Columns of every replay buffer, in the order in which a step is checked: Stable-Baselines3's attributes.
OF_EVERY_BUFFER = (OBSERVATIONS, NEXT_OBSERVATIONS, ACTIONS, REWARDS, DONES, TIMEOUTS)
#: Of these, all but the observations.
_PLAIN = OF_EVERY_BUFFER[2:]


class HasColumns:
    """Base of replay buffers that may store further columns."""

    # A slot besides the attributes, since it can neither be copied nor saved, and is derived from them.
    __slots__ = ("_writers",)
    _writers: tuple[tuple[str, Callable[[Given], Any]], ...]

    #: Columns besides those of every replay buffer and of the base classes.
    more_columns: ClassVar[tuple[Column, ...]] = ()
    #: All columns except the observations, those of base classes included.
    plain_columns: ClassVar[tuple[Column, ...]] = _PLAIN
    #: Whether batches have columns that not every buffer has.
    more_in_batch: ClassVar[bool] = False

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if not isinstance(cls.more_columns, (tuple, list)):
            raise TypeError(f"more_columns of {cls.__name__} must be a tuple of Column, not {cls.more_columns!r}")
        more = [column for base in reversed(cls.__mro__) for column in vars(base).get("more_columns", ())]
        taken = {column.name for column in OF_EVERY_BUFFER}
        for column in more:
            if not isinstance(column, Column):
                raise TypeError(f"more_columns of {cls.__name__} must be of Column, not {column!r}")
            if not column.name.isidentifier() or column.name in taken or hasattr(cls, column.name):
                raise ValueError(f"more_columns of {cls.__name__} has the name {column.name!r}, which is taken or none")
            taken.add(column.name)
        cls.plain_columns = (*_PLAIN, *more)
        cls.more_in_batch = any(column.in_batch for column in more)

    def writers(self) -> tuple[tuple[str, Callable[[Given], Any]], ...]:
        """
        Return the functions that turn a step into rows.

        :return: pairs of a column's name, observations first, and the function from the arguments of ``add`` to its row
        """
        try:
            return self._writers
        except AttributeError:
            columns = (c for c in columns_of(self).values() if c.read is not None)
            self._writers = tuple((column.name, column.writer(self)) for column in columns)
            return self._writers

    def __getstate__(self) -> dict[str, Any]:
        return vars(self)

    def _restored(self) -> None:
        """Called when the rows have been restored, from a file or a checkpoint."""


def columns_of(buffer: Any) -> dict[str, Column]:
    """
    :param buffer: a replay buffer of any class, or the class
    :return: its columns by name
    """
    return {column.name: column for column in (*OF_EVERY_BUFFER, *_more(buffer))}


def has_own_columns(cls: Any) -> bool:
    """
    Check whether a buffer's class declares columns of its own.

    :param cls: a replay buffer, its class, or None
    :return: whether batches of it have further columns
    """
    return getattr(cls, "more_in_batch", False)


def _more(buffer: Any) -> tuple[Column, ...]:
    """Columns that not every buffer has."""
    return getattr(buffer, "plain_columns", _PLAIN)[len(_PLAIN) :]  # type: ignore[no-any-return]


class Samples(NamedTuple):
    """Transitions as Stable-Baselines3's buffers give them, and the columns that a buffer has besides."""

    observations: Any
    actions: torch.Tensor
    next_observations: Any
    dones: torch.Tensor
    rewards: torch.Tensor
    discounts: torch.Tensor | None = None
    columns: Mapping[str, torch.Tensor] = {}


def samples_of(buffer: Any, take: Callable[..., Any]) -> Any:
    """
    Assemble transitions: the only place that maps columns to entries of the samples.

    :param buffer: replay buffer
    :param take: function of a column and the buffer's array of it (or dict of arrays) that returns tensors of the
        wanted rows, (B, ...), (B, 1) if it is one number; 0 where its keyword argument ``but``, another array, is 1
    :return: the transitions, in the form of the buffer's ``sample``
    """
    samples = (
        take(OBSERVATIONS, buffer.observations),
        take(ACTIONS, buffer.actions),
        # Stable-Baselines3's memory-saving layout has them in the observations' next rows.
        take(NEXT_OBSERVATIONS, getattr(buffer, "next_observations", None)),
        # A time limit does not end the bootstrap.
        take(DONES, buffer.dones, but=buffer.timeouts),
        take(REWARDS, buffer.rewards),
    )
    if has_own_columns(buffer):
        return Samples(*samples, columns=own_columns_of(buffer, take))
    return (DictReplayBufferSamples if isinstance(samples[0], dict) else ReplayBufferSamples)(*samples)


def own_columns_of(buffer: Any, take: Callable[[Column, Any], Any]) -> dict[str, Any]:
    """
    Assemble the columns of batches that not every buffer has.

    :param buffer: replay buffer
    :param take: function of a column and the buffer's array of it that returns the wanted rows
    :return: these rows by name
    """
    return {c.name: take(c, getattr(buffer, c.name)) for c in _more(buffer) if c.in_batch}


def observations_at(
    buffer: ReplayBuffer,
    positions: np.ndarray,
    env_indices: np.ndarray,
    column: Column = OBSERVATIONS,
    key: str | None = None,
) -> Any:
    """
    Gather observations of a replay buffer at given places.

    :param buffer: Stable-Baselines3's replay buffer or a subclass
    :param positions: places in the buffer, (N,)
    :param env_indices: which environment's transition, (N,)
    :param column: ``OBSERVATIONS`` or ``NEXT_OBSERVATIONS``
    :param key: of dict observations, which part; None for all
    :return: as they are stored, (N, O), or a dict of such arrays
    """
    is_next = column is NEXT_OBSERVATIONS
    if is_next and buffer.optimize_memory_usage:
        is_next, positions = False, (positions + 1) % buffer.buffer_size
    array: Any = buffer.next_observations if is_next else buffer.observations
    if key is not None:
        array = array[key]
    return for_each(lambda part: part[positions, env_indices], array)


def rows_at(array: Any, positions: np.ndarray, env_indices: np.ndarray) -> Any:
    """
    Gather values of a column other than the observations.

    :param array: the column's, (buffer_size, n_envs, ...)
    :param positions: places in the buffer, (N,)
    :param env_indices: which environment's transition, (N,)
    :return: (N, ...), or (N, 1) if it is one number
    """
    rows = array[positions, env_indices]
    return rows.reshape(-1, 1) if rows.ndim == 1 else rows


def samples_at(
    buffer: ReplayBuffer, positions: np.ndarray, env_indices: np.ndarray, vec_normalize: VecNormalize | None = None
) -> Any:
    """
    Gather transitions of a replay buffer at given places, each one step, without the changes that the buffer's own
    ``sample`` makes (n-step returns, relabelled goals).

    :param buffer: Stable-Baselines3's replay buffer or a subclass
    :param positions: places in the buffer, (N,)
    :param env_indices: which environment's transition, (N,)
    :param vec_normalize: normalises observations and rewards
    :return: N transitions, in the form of the buffer's ``sample``
    """

    def take(column: Column, array: Any, but: Any = None) -> Any:
        if isinstance(column, _Observations):
            given = observations_at(buffer, positions, env_indices, column)
            return for_each(buffer.to_torch, buffer._normalize_obs(given, vec_normalize))
        rows = rows_at(array, positions, env_indices)
        if but is not None:
            rows = rows * (1 - rows_at(but, positions, env_indices))
        return buffer.to_torch(buffer._normalize_reward(rows, vec_normalize) if column is REWARDS else rows)

    return samples_of(buffer, take)
