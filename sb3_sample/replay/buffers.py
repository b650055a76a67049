"""Replay: transitions by their place in a buffer, and buffers that hold some transitions out for validation."""

# The generator that Stable-Baselines3 seeds and its buffers draw from:
# ruff: noqa: NPY002

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample.replay.columns import (
    HELD_OUT,
    OF_EVERY_BUFFER,
    Column,
    HasColumns,
    columns_of,
    samples_at,
    samples_of,
)
from sb3_sample.replay.compact import (
    CompactDictReplayBuffer,
    CompactNStepReplayBuffer,
    CompactReplayBuffer,
)
from sb3_sample.replay.next_observations import ONLY, taken
from sb3_sample.replay.rows import action_dtype
from sb3_sample.replay.weighted import FadedDictReplayBuffer, FadedReplay, FadedReplayBuffer


class ValidationSplit(HasColumns):
    """
    Mixin of the replay buffers that hold transitions out (VPL, section 4.1 and algorithm 1, lines 4-10): each
    transition of each environment goes to the validation side with a given probability, for as long as it is in the
    buffer. ``sample`` never returns such a transition, ``sample_validation`` nothing else.

    Nothing is stored twice: the split is a mask, and a list of the places that it marks.

    :param args: as in the buffer that it is mixed into, which calls ``_replacing`` and ``_restored``
    :param kwargs: as in that buffer
    :param validation_proportion: probability of the validation side, in (0, 1)
    """

    more_columns = (HELD_OUT,)
    #: Which transitions are held out, (buffer_size, n_envs).
    held_out: np.ndarray
    buffer_size: int
    n_envs: int
    pos: int
    full: bool

    def __init__(self, *args: Any, validation_proportion: float, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.validation_proportion = validation_proportion
        # The places held out (position * n_envs + environment) as a ring, oldest first: the buffer overwrites them in
        # the same order. The two counters are never reduced.
        self._ring = np.zeros(self.buffer_size * self.n_envs, dtype=np.int64)
        self._first = self._last = 0

    @property
    def n_validation(self) -> int:
        """Transitions held out."""
        return self._last - self._first

    @property
    def n_training(self) -> int:
        """Transitions to train on."""
        return (self.buffer_size if self.full else self.pos) * self.n_envs - self.n_validation

    def _replacing(self, row: int) -> None:
        """Draw the sides of a step's transitions."""
        held_out = np.random.random(self.n_envs) < self.validation_proportion
        self._first += int(self.held_out[row].sum())
        self.held_out[row] = held_out
        new = row * self.n_envs + np.flatnonzero(held_out)
        self._ring[(self._last + np.arange(len(new))) % len(self._ring)] = new
        self._last += len(new)

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()  # type: ignore[misc]  # the buffer's
        self.held_out[...] = False
        self._first = self._last = 0

    def _restored(self) -> None:
        super()._restored()
        held_out = self._oldest_first(True)
        self._ring = np.zeros(self.buffer_size * self.n_envs, dtype=np.int64)
        self._first, self._last = 0, len(held_out)
        self._ring[: self._last] = held_out

    def _oldest_first(self, held_out: bool) -> np.ndarray:
        """The places (position * n_envs + environment) of one side, oldest first."""
        size = self.buffer_size if self.full else self.pos
        rows = (np.arange(size) + (self.pos if self.full else 0)) % self.buffer_size
        steps, envs = np.nonzero(self.held_out[rows] == held_out)
        places: np.ndarray = rows[steps] * self.n_envs + envs
        return places

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """
        Draw training transitions, uniformly with replacement.

        :param batch_size: how many
        :param env: normalises observations and rewards
        :return: the transitions
        :raises ValueError: if there is none
        """
        return self._at(self.training_places(batch_size), env)

    def training_places(self, n: int) -> np.ndarray:
        """
        Draw places of training transitions.

        :param n: how many
        :return: places of training transitions (position * n_envs + environment), uniformly with replacement, (n,)
        :raises ValueError: if there is none
        """
        self._check_can_train()
        size = (self.buffer_size if self.full else self.pos) * self.n_envs
        mask = self.held_out.reshape(-1)
        places = np.random.randint(size, size=n)
        again = np.flatnonzero(mask[places])
        while len(again):
            places[again] = np.random.randint(size, size=len(again))
            again = again[mask[places[again]]]
        return places

    def _check_can_train(self) -> None:
        if self.n_training == 0:
            raise ValueError(f"there is no transition to train on: all {self.n_validation} are held out")

    def sample_validation(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """
        Draw held-out transitions, uniformly with replacement.

        :param batch_size: how many
        :param env: normalises observations and rewards
        :return: the transitions
        :raises ValueError: if there is none
        """
        if self.n_validation == 0:
            raise ValueError("no transition is held out yet")
        drawn = np.random.randint(self._first, self._last, size=batch_size)
        return self._at(self._ring[drawn % len(self._ring)], env)

    def _at(self, places: np.ndarray, env: VecNormalize | None) -> Any:
        """The transitions at these places."""
        assert isinstance(self, ReplayBuffer)
        return samples_at(self, *np.divmod(places, self.n_envs), env)


class ValidationReplayBuffer(ValidationSplit, CompactReplayBuffer):  # type: ignore[misc, override]
    """Replay buffer that holds transitions out."""


class ValidationDictReplayBuffer(ValidationSplit, CompactDictReplayBuffer):  # type: ignore[misc, override]
    """Replay buffer for dict observations that holds transitions out."""


def latest(buffer: ReplayBuffer, n_steps: int, vec_normalize: VecNormalize | None = None) -> tuple[Any, torch.Tensor]:
    """
    Gather the latest steps of every environment.

    :param buffer: replay buffer
    :param n_steps: T, steps of each environment
    :param vec_normalize: normalises observations and rewards
    :return: T * n_envs transitions, the oldest step of every environment first; and 1 where an episode ended with
        the step, by termination or truncation, (T, n_envs)
    :raises ValueError: if the buffer holds fewer steps
    """
    if buffer.size() < n_steps:
        raise ValueError(f"the replay buffer holds {buffer.size()} steps, not {n_steps}")
    positions = np.arange(buffer.pos - n_steps, buffer.pos) % buffer.buffer_size
    steps, envs = np.meshgrid(positions, np.arange(buffer.n_envs), indexing="ij")
    transitions = samples_at(buffer, steps.ravel(), envs.ravel(), vec_normalize)
    return transitions, buffer.to_torch(buffer.dones[positions])


class DeviceReplayBuffer(HasColumns, ReplayBuffer):
    """
    Replay buffer in the memory of the model's device: each transition is moved once, when it is stored, and batches
    are gathered where they are needed. For a GPU; on a CPU it is the plain buffer with other arrays.

    Pass ``replay_buffer_class=DeviceReplayBuffer``. It takes single observations, not dicts of them. It draws the same
    transitions as ``ReplayBuffer`` with the same seed, unless the gradient step draws its batch itself.

    :param args: as in Stable-Baselines3
    :param sampling: where the batches of gradient steps are drawn: "host", by NumPy's generator, or "device", by the
        gradient step itself with torch's generator of the device, so that on a GPU a step with its drawing is one
        launch
    :param kwargs: as in Stable-Baselines3; ``optimize_memory_usage`` and ``VecNormalize`` are refused by the algorithm
    :raises ValueError: if ``sampling`` is something else
    """

    def __init__(self, *args: Any, sampling: str = "host", **kwargs: Any):
        if sampling not in ("host", "device"):
            raise ValueError(f"sampling must be 'host' or 'device', not {sampling!r}")
        super().__init__(*args, **kwargs)
        self.sampling = sampling
        # On the device, where a captured step reads them: number of places that can be drawn, and the next row.
        self._drawable = torch.zeros((), dtype=torch.float64, device=self.device)
        self._next_row = torch.zeros((), dtype=torch.int64, device=self.device)
        store_float_actions(self)
        given = {column.name for column in OF_EVERY_BUFFER}
        for name, column in columns_of(self).items():
            if name in vars(self) and name not in given:
                raise ValueError(f"more_columns of {type(self).__name__} has the name {name!r}, which is taken")
            # In the place of the host's arrays, which were never written to, so that they took no memory.
            shape, dtype = column.layout(self)[ONLY]
            rows = (self.buffer_size, self.n_envs, *shape)
            like = torch.from_numpy(np.empty(0, dtype))
            setattr(self, name, torch.zeros(rows, dtype=like.dtype, device=self.device))

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition of each environment, as in Stable-Baselines3.

        :raises ValueError: if something has another shape than its space; nothing is stored then
        """
        given = (obs, next_obs, action, reward, done, infos)
        rows = [(name, write(given)) for name, write in self.writers()]
        for name, row in rows:
            target: Any = getattr(self, name)[self.pos]
            target.copy_(torch.as_tensor(row[ONLY] if isinstance(row, dict) else row))
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full, self.pos = True, 0

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Any:
        if env is not None:
            raise ValueError("VecNormalize normalises on the host: use ReplayBuffer with it, not DeviceReplayBuffer")
        env_indices = np.random.randint(0, high=self.n_envs, size=len(batch_inds))
        return self._taken(torch.from_numpy(batch_inds * self.n_envs + env_indices).to(self.device))

    def draw(self, n: int) -> Any:
        """
        Draw transitions uniformly with replacement, by tensor operations alone and torch's generator of the device,
        from those that were stored at the last :meth:`prepare_draws`.

        :param n: how many
        :return: the transitions
        """
        # Uniform in [0, 1), to 53 binary digits, so that the product stays below the number of places.
        uniform = torch.rand(n, dtype=torch.float64, device=self.device)
        return self._taken((uniform * self._drawable).long())

    def draw_held_out(self, n: int) -> Any:
        """
        Draw transitions of the validation side, as :meth:`draw` draws training transitions.

        :param n: how many
        :return: the transitions
        :raises ValueError: if the buffer holds none out, like this one
        """
        raise ValueError(f"{type(self).__name__} holds no transition out: pass validation_proportion to the algorithm")

    def newest(self, n_steps: int) -> tuple[Any, torch.Tensor]:
        """
        Gather the latest steps of every environment, by tensor operations alone, as stored at the last
        :meth:`prepare_draws`.

        :param n_steps: T, at most as many as are stored
        :return: as in :func:`latest`
        """
        rows = (self._next_row - n_steps + torch.arange(n_steps, device=self.device)) % self.buffer_size
        places = rows.unsqueeze(1) * self.n_envs + torch.arange(self.n_envs, device=self.device)
        ends: Any = self.dones
        return self._taken(places.flatten()), ends.index_select(0, rows)

    def prepare_draws(self) -> None:
        """Make :meth:`draw`, :meth:`draw_held_out` and :meth:`newest` draw from all that is stored now."""
        self._drawable.fill_(self.size() * self.n_envs)
        self._next_row.fill_(self.pos)

    def _taken(self, places: torch.Tensor) -> Any:
        def take(column: Column, array: Any, but: Any = None) -> torch.Tensor:
            rows = array.flatten(0, 1).index_select(0, places)
            if but is not None:
                rows = rows * (1 - but.flatten(0, 1).index_select(0, places))
            return rows.unsqueeze(1) if rows.ndim == 1 else rows

        return samples_of(self, take)

    def to_torch(self, array: Any, copy: bool = True) -> torch.Tensor:
        """
        Move an array to the device.

        :param array: rows of the buffer, or an array of the host
        :param copy: whether the result has its own memory
        :return: the same as a tensor on the device
        """
        if isinstance(array, torch.Tensor):
            return array.clone() if copy else array
        return super().to_torch(array, copy)


class _Places:
    """
    Places of a buffer on its device, oldest first: a ring, from which a gradient step itself draws.

    :param capacity: largest number of places
    :param device: the device
    """

    def __init__(self, capacity: int, device: torch.device):
        self._ring = torch.zeros(capacity, dtype=torch.int64, device=device)
        # Counts of the ring's first place, and of one after its last, never reduced; and the tensors of them that a
        # captured step reads.
        self._first = self._last = 0
        self._start = torch.zeros((), dtype=torch.int64, device=device)
        self._drawable = torch.zeros((), dtype=torch.float64, device=device)

    def replace(self, n_gone: int, new: np.ndarray) -> None:
        """
        Drop the oldest places and add new ones.

        :param n_gone: how many are dropped
        :param new: the new places
        """
        self._first += n_gone
        if len(new) == 0:
            return
        at = torch.from_numpy((self._last + np.arange(len(new))) % len(self._ring))
        self._ring[at.to(self._ring.device)] = torch.from_numpy(new).to(self._ring.device)
        self._last += len(new)

    def restart(self, places: np.ndarray) -> None:
        """
        Hold other places, in the same memory.

        :param places: the new places, oldest first
        """
        self._first = self._last = 0
        self.replace(0, places)

    def prepare(self) -> None:
        """Make :meth:`draw` draw from all current places."""
        self._start.fill_(self._first % len(self._ring))
        self._drawable.fill_(self._last - self._first)

    def draw(self, n: int) -> torch.Tensor:
        """
        Draw places uniformly with replacement; there must be at least one.

        :param n: how many
        :return: (n,)
        """
        uniform = torch.rand(n, dtype=torch.float64, device=self._ring.device)
        at = (self._start + (uniform * self._drawable).long()) % len(self._ring)
        return self._ring.index_select(0, at)


class DeviceValidationReplayBuffer(ValidationSplit, DeviceReplayBuffer):
    """
    Replay buffer in the memory of the model's device that holds transitions out. Both sides are overwritten in the
    order in which they came, so that the places of each are a ring.

    :param args: as in ``DeviceReplayBuffer``
    :param kwargs: as in ``DeviceReplayBuffer``
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        # On the host, where it is read.
        self.held_out = np.zeros((self.buffer_size, self.n_envs), dtype=bool)
        self._make_sides()

    def _make_sides(self) -> None:
        # Places of the two sides, which follow from ``held_out`` and are not saved.
        self._training_side, self._validation_side = (
            _Places(self.buffer_size * self.n_envs, self.device) for _ in range(2)
        )

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition of each environment, as in Stable-Baselines3, each on one of the two sides.

        :raises ValueError: if something has another shape than its space; nothing is stored then
        """
        row, was_full = self.pos, self.full
        n_held_out = int(self.held_out[row].sum())
        super().add(obs, next_obs, action, reward, done, infos)
        self._replacing(row)
        for side, n_gone, which in (
            (self._validation_side, n_held_out, self.held_out[row]),
            (self._training_side, self.n_envs - n_held_out if was_full else 0, ~self.held_out[row]),
        ):
            side.replace(n_gone, row * self.n_envs + np.flatnonzero(which))

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()
        self._restart_sides()

    def _restored(self) -> None:
        super()._restored()
        if not hasattr(self, "_training_side"):
            self._make_sides()
        self._restart_sides()

    def _restart_sides(self) -> None:
        self._validation_side.restart(self._oldest_first(True))
        self._training_side.restart(self._oldest_first(False))

    def draw(self, n: int) -> Any:
        """
        Draw training transitions uniformly with replacement, as ``DeviceReplayBuffer`` draws from all transitions.

        :param n: how many
        :return: the transitions
        """
        return self._taken(self._training_side.draw(n))

    def draw_held_out(self, n: int) -> Any:
        """
        Draw transitions of the validation side, as :meth:`draw` draws training transitions.

        :param n: how many
        :return: the transitions
        """
        return self._taken(self._validation_side.draw(n))

    def prepare_draws(self) -> None:
        """
        Make :meth:`draw`, :meth:`draw_held_out` and :meth:`newest` draw from all that is stored now.

        :raises ValueError: if there is none to train on
        """
        self._check_can_train()
        super().prepare_draws()
        self._training_side.prepare()
        self._validation_side.prepare()

    def _at(self, places: np.ndarray, env: VecNormalize | None) -> Any:
        if env is not None:
            raise ValueError("VecNormalize normalises on the host: use ReplayBuffer with it, not DeviceReplayBuffer")
        return self._taken(torch.from_numpy(places).to(self.device))


#: Buffers in whose place one is taken that holds transitions out, and those that are taken.
WITHOUT_SPLIT = (
    ReplayBuffer,
    DictReplayBuffer,
    CompactReplayBuffer,
    CompactDictReplayBuffer,
    CompactNStepReplayBuffer,
    DeviceReplayBuffer,
)
WITH_SPLIT = (ValidationReplayBuffer, ValidationDictReplayBuffer, DeviceValidationReplayBuffer)


def store_float_actions(buffer: ReplayBuffer) -> None:
    """
    Make an empty buffer store actions as floats where Stable-Baselines3's truncates actions in [-1, 1] to integers.

    :param buffer: the buffer
    """
    dtype = action_dtype(buffer.action_space)
    if isinstance(buffer.actions, np.ndarray) and buffer.actions.dtype != dtype:
        buffer.actions = np.zeros(buffer.actions.shape, dtype)


#: Buffers that hold one transition per place, each of which can be drawn by itself.
PLAIN_BUFFERS = (
    CompactReplayBuffer,
    CompactDictReplayBuffer,
    ValidationReplayBuffer,
    ValidationDictReplayBuffer,
    FadedReplayBuffer,
    FadedDictReplayBuffer,
    ReplayBuffer,
    DictReplayBuffer,
)
#: Buffers whose every transition is drawn independently, so that one large draw can be cut into batches. Others compose
#: each batch (HerReplayBuffer: so many real, so many relabelled transitions) and are sampled once per gradient step.
INDEPENDENT_BUFFERS = (
    *PLAIN_BUFFERS,
    NStepReplayBuffer,
    CompactNStepReplayBuffer,
    DeviceReplayBuffer,
    DeviceValidationReplayBuffer,
)
#: Methods that make a buffer's samples.
_SAMPLING = ("sample", "_get_samples", "_at", "training_places", "to_torch", "_normalize_obs", "_normalize_reward")
_OWN_SAMPLING = {cls: [getattr(cls, name, None) for name in _SAMPLING] for cls in INDEPENDENT_BUFFERS}


def samples_as_its_class(buffer: ReplayBuffer) -> bool:
    """
    Check that a buffer's draws are independent.

    :param buffer: a replay buffer
    :return: whether it is one of ``INDEPENDENT_BUFFERS``, or adds columns to one, and neither the class nor the object
        replaces its sampling
    """
    present = [getattr(type(buffer), name, None) for name in _SAMPLING]
    return _OWN_SAMPLING.get(_without_columns(buffer)) == present and vars(buffer).keys().isdisjoint(_SAMPLING)


def _without_columns(buffer: ReplayBuffer) -> Any:
    """The class of a buffer; if it declares its own columns, the class to which it adds them."""
    cls = type(buffer)
    while "more_columns" in vars(cls) and cls not in _OWN_SAMPLING:
        cls = cls.__bases__[0]
    return cls


class BatchMemory:
    """
    Reused memory into which the transitions of gradient steps are gathered, and from which they are moved to the device
    at once. On a CPU the gathered transitions are valid until the next call of :meth:`gather`.
    """

    def __init__(self) -> None:
        self._columns: dict[Any, torch.Tensor] = {}
        self._moved: torch.cuda.Event | None = None

    @staticmethod
    def serves(buffer: ReplayBuffer, vec_normalize: VecNormalize | None) -> bool:
        """
        Check that transitions can be gathered without the buffer's own ``sample``.

        :param buffer: replay buffer
        :param vec_normalize: normalises the samples
        :return: whether they can
        """
        is_plain = _without_columns(buffer) in PLAIN_BUFFERS and samples_as_its_class(buffer)
        return is_plain and not buffer.optimize_memory_usage and vec_normalize is None

    def gather(self, buffer: ReplayBuffer, n: int) -> Any:
        """
        Draw transitions to train on, with replacement: the same as ``buffer.sample(n)`` would.

        :param buffer: a buffer that this memory serves
        :param n: how many
        :return: the transitions, on the buffer's device
        """
        if isinstance(buffer, (ValidationSplit, FadedReplay)):
            places = buffer.training_places(n)
        else:
            positions = np.random.randint(0, buffer.size(), size=n)
            places = positions * buffer.n_envs + np.random.randint(0, high=buffer.n_envs, size=n)
        if self._moved is not None:
            self._moved.synchronize()
        to_cuda = buffer.device.type == "cuda"

        def gathered(name: Any, array: Any, but: np.ndarray | None = None) -> torch.Tensor:
            shape = array.shape[2:] or (1,)
            if name not in self._columns or len(self._columns[name]) < n:
                dtype = torch.from_numpy(np.empty(0, array.dtype)).dtype
                self._columns[name] = torch.empty((n, *shape), dtype=dtype, pin_memory=to_cuda)
            column = self._columns[name][:n]
            out = column.numpy()
            taken(array, places, out)
            if but is not None:
                out *= 1 - but.reshape(-1, 1).take(places, axis=0)
            return column.to(buffer.device, non_blocking=True) if to_cuda else column

        def take(column: Column, array: Any, but: np.ndarray | None = None) -> Any:
            if isinstance(array, dict):
                return {key: gathered((column.name, key), part) for key, part in array.items()}
            return gathered(column.name, array, but)

        samples = samples_of(buffer, take)
        if to_cuda:
            # The memory is free again when the copies are done.
            self._moved = torch.cuda.Event()
            self._moved.record()
        return samples
