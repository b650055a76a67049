"""Fixed data sets of transitions as a source of batches."""

import functools
import os
from collections.abc import Callable, Iterator, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from sb3_sample.envs.numbers import check_numbers
from sb3_sample.learner.batch import Batch, for_each
from sb3_sample.replay.dataset_buffers import arrays_of
from sb3_sample.replay.dataset_files import opened_hdf5, read_minari, write_minari
from sb3_sample.replay.memory_map import check_folder, n_bytes, zeros
from sb3_sample.replay.next_observations import ONLY
from sb3_sample.replay.steps import (
    CHUNK,
    Steps,
    action_dtype,
    as_numpy,
    check_action_space,
    check_actions,
    observation_dtypes,
    pieces,
    put,
)
from sb3_sample.warn import warn

Arrays = np.ndarray | dict[str, np.ndarray]
#: Parts of a step that every data set has: all but the observations, and all.
_PLAIN = ("actions", "rewards", "terminations", "truncations")
_OWN_NAMES = ("observations", *_PLAIN, "next_observations")


class Dataset:
    """
    Fixed set of transitions, from which batches are drawn uniformly with replacement. It is made by one of the class
    methods ``from_...``.

    :param steps: the steps, in the types of their spaces, floats of observations and rewards as float32
    :param observation_space: of the observations
    :param action_space: of the actions as an environment takes them
    :param seed: of the generator that :meth:`sample` draws from
    :param n_left_out: number of further steps of the source, left out because their next observation is unknown
    """

    def __init__(
        self,
        steps: Steps,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        seed: int = 0,
        n_left_out: int = 0,
    ):
        self.observation_space, self.action_space, self.n_left_out = observation_space, action_space, n_left_out
        self._steps = _map(torch.from_numpy, steps)
        low, high = action_space.low, action_space.high
        self._low, self._range = (torch.from_numpy(each.astype(np.float64)) for each in (low, high - low.astype(float)))
        self._generator = torch.Generator().manual_seed(seed)
        self._fingerprint = ""
        if n_left_out:
            what = "its next observation is not known" if n_left_out == 1 else "their next observations are not known"
            warn(
                f"{n_left_out} of {n_left_out + len(self)} steps left out of the data set, the last of episodes that "
                f"were cut off: {what}"
            )

    @classmethod
    def from_arrays(
        cls,
        observations: Any,
        actions: Any,
        rewards: Any,
        terminations: Any,
        truncations: Any,
        *,
        next_observations: Any = None,
        observation_space: spaces.Space | None = None,
        action_space: spaces.Box | None = None,
        seed: int = 0,
        columns: Mapping[str, Any] | None = None,
        memory_map: str | os.PathLike[str] | None = None,
    ) -> "Dataset":
        """
        Make a data set of N steps in the order in which they were taken, episode after episode.

        Without ``next_observations`` a step's next observation is the following step's observation. Truncated steps,
        and the last one, then have none and are left out with a warning, unless the episode terminated there.

        Observations and actions are held in the types of their spaces, floats of observations as float32.

        :param observations: (N, O), or (N,) of a Discrete ``observation_space``, or a dict of such arrays; NumPy's,
            ``numpy.memmap`` included, or h5py's data sets
        :param actions: (N, A), in the environment's units, within the bounds of ``action_space``
        :param rewards: (N,)
        :param terminations: whether the episode terminated with the step, (N,)
        :param truncations: whether the episode was cut off there, by a time limit for example, (N,)
        :param next_observations: like the observations
        :param observation_space: of the observations; None: unbounded, of their shape
        :param action_space: of the actions; None: [-1, 1]
        :param seed: of the generator that the batches are drawn from
        :param columns: further columns of the batches by name, such as the number of a task: numbers, (N,) or (N, ...).
            No name may be one of the other arrays'
        :param memory_map: folder whose disk holds the observations and actions, if they are larger than the memory; the
            files are unnamed and vanish with the data set. None: memory
        :return: the data set
        :raises ValueError: if the arrays differ in length, do not match the spaces or are not finite, or a space of
            integers cannot hold their numbers
        """
        observations = _arrays("observations", observations, 2, observation_space)
        actions = _arrays("actions", actions, 1)
        if len(actions.shape) < 2:
            raise ValueError(f"actions must be of shape (N, A), not {actions.shape}")
        rewards = _column("rewards", rewards)
        flags = {"terminations": _column("terminations", terminations)}
        flags["truncations"] = _column("truncations", truncations)
        given = {}
        if next_observations is not None:
            given["next_observations"] = _arrays("next_observations", next_observations, 2, observation_space)
        taken = sorted({*_OWN_NAMES} & {*(columns or {})})
        if taken:
            raise ValueError(f"columns must have names of their own, not {', '.join(taken)}, which every data set has")
        more = {name: _arrays(f"columns[{name!r}]", values, 1) for name, values in (columns or {}).items()}
        n = len(rewards)
        if n == 0:
            raise ValueError("rewards must have at least one step, not 0")
        named = {"observations": observations, "actions": actions, **flags, **given, **more}
        for name, value in named.items():
            for part in value.values() if isinstance(value, dict) else (value,):
                if len(part) != n:
                    raise ValueError(f"{name} must have as many steps as rewards, {n}, not {len(part)}")
        for name, flag in flags.items():
            if not np.isin(flag, (0, 1)).all():
                raise ValueError(f"{name} must be 0 or 1, not {flag[~np.isin(flag, (0, 1))][0]}")
        observation_space = observation_space or _space_of(observations)
        action_space = action_space or spaces.Box(-1, 1, actions.shape[1:], np.float32)
        check_action_space(actions.shape[1:], action_space)
        _check_shapes("observations", observation_space, observations)
        for name, value in given.items():
            _check_shapes(name, observation_space, value)
        of_observations, of_actions = observation_dtypes(observation_space), action_dtype(action_space)
        held = [(values, of_observations) for values in (observations, *given.values())]
        folder = _folder(memory_map, [*held, (actions, of_actions)])
        terminated, truncated = flags["terminations"] == 1, flags["truncations"] == 1
        steps = Steps(
            _copied("observations", observations, of_observations, folder),
            np.arange(n),
            None,
            _copied("next_observations", given["next_observations"], of_observations, folder) if given else None,
            _copied("actions", actions, of_actions, folder),
            rewards,
            terminated,
            truncated,
            {
                name: _copied(
                    f"columns[{name!r}]", values, np.float32 if values.dtype.kind == "f" else values.dtype, None
                )
                for name, values in more.items()
            },
        )
        check_actions(steps.actions, action_space)
        check_numbers("observations", observation_space, steps.observations)
        if given:
            check_numbers("next_observations", observation_space, steps.next_observations)
        n_left_out = 0
        if given:
            breaks = _breaks(steps) & ~terminated & ~truncated
            steps = steps._replace(truncations=truncated | breaks)
            if breaks.sum() > max(n // 2, 1):
                warn(
                    f"next_observations of {breaks.sum()} of {n} steps are not the following observations: each of "
                    "them is the end of an episode here. The steps are not in the order in which they were taken, or "
                    "the two are not of the same numbers"
                )
        else:
            # The target of a terminated step does not use its next observation: its own observation stands in for it.
            cut_off = truncated | (steps.at == n - 1)
            kept = np.flatnonzero(~cut_off | terminated)
            n_left_out = n - len(kept)
            if not len(kept):
                raise ValueError("next_observations must be given: every step is the last of an episode cut off")
            # The step before one that is left out is the last of its episode.
            truncated = truncated | (np.append(cut_off[1:] & ~terminated[1:], False) & ~terminated)
            following = np.where(terminated, steps.at, steps.at + 1)
            plain = _take((steps.actions, steps.rewards, terminated, truncated), kept) if n_left_out else None
            steps = steps._replace(at=steps.at[kept], next_at=following[kept], columns=_take(steps.columns, kept))
            if plain is None:
                steps = steps._replace(truncations=truncated)
            else:
                steps = steps._replace(**dict(zip(_PLAIN, plain, strict=True)))
        return cls(steps, observation_space, action_space, seed, n_left_out)

    @classmethod
    def from_minari(
        cls, id_or_path: str | os.PathLike[str], *, seed: int = 0, memory_map: str | os.PathLike[str] | None = None
    ) -> "Dataset":
        """
        Read one of Minari's data sets from this computer; nothing is downloaded. Needs the extra ``[offline]``.

        :param id_or_path: its folder, or its id among Minari's local data sets
        :param seed: of the generator that the batches are drawn from
        :param memory_map: as in :meth:`from_arrays`
        :return: the data set
        :raises ValueError: if there is none, its spaces are not supported, or its content is invalid
        """
        return cls(*read_minari(id_or_path, memory_map), seed)

    @classmethod
    def from_hdf5(
        cls,
        path: str | os.PathLike[str],
        *,
        observation_space: spaces.Space | None = None,
        action_space: spaces.Box | None = None,
        seed: int = 0,
        memory_map: str | os.PathLike[str] | None = None,
    ) -> "Dataset":
        """
        Read a file in D4RL's layout: ``observations``, ``actions``, ``rewards``, ``terminals``, ``timeouts``, and
        ``next_observations`` if it has them. Dict observations are groups. Needs the extra ``[offline]``.

        :param path: the file
        :param observation_space: as in :meth:`from_arrays`
        :param action_space: as in :meth:`from_arrays`
        :param seed: of the generator that the batches are drawn from
        :param memory_map: as in :meth:`from_arrays`
        :return: the data set
        :raises ValueError: if it is not such a file, or its content is invalid
        """
        with opened_hdf5(path) as given:
            return cls.from_arrays(
                **given,
                observation_space=observation_space,
                action_space=action_space,
                seed=seed,
                memory_map=memory_map,
            )

    @classmethod
    def from_replay_buffer(
        cls, buffer: Any, *, seed: int = 0, memory_map: str | os.PathLike[str] | None = None
    ) -> "Dataset":
        """
        Copy the transitions of a replay buffer, each one step and as stored: without normalisation, n-step returns or
        relabelled goals.

        :param buffer: Stable-Baselines3's replay buffer, or one of this package
        :param seed: of the generator that the batches are drawn from
        :param memory_map: as in :meth:`from_arrays`
        :return: the data set, environment after environment
        :raises ValueError: if the buffer is empty, if its actions are not of a bounded Box, or if one of its own
            columns has the name of a part of every step
        """
        return cls.from_arrays(**arrays_of(buffer), seed=seed, memory_map=memory_map)

    def to_minari(self, id_or_path: str | os.PathLike[str], **metadata: Any) -> Path:
        """
        Write the data set in Minari's format, uncompressed. An end of an episode that is not a termination becomes a
        truncation; further columns are left out with a warning. Needs the extra ``[offline]``.

        :param id_or_path: a new folder, or an id (``cartpole/swingup-v0``) among Minari's local data sets
        :param metadata: further entries that Minari keeps: ``author``, ``algorithm_name``, ``description``, ...
        :return: the folder that it is in
        :raises ValueError: if the target exists already, or an id is also the path of a folder here; a leading ``./``
            makes it a path
        """
        return write_minari(self, id_or_path, metadata)

    def __len__(self) -> int:
        return len(self._steps.actions)

    def __repr__(self) -> str:
        return f"Dataset({len(self):,} transitions, sha256 {self.fingerprint[:16]})"

    @property
    def column_names(self) -> list[str]:
        """Names of the further columns, sorted."""
        return sorted(self._steps.columns)

    @property
    def n_episodes(self) -> int:
        """Number of episodes, those that are cut off included."""
        return int((self._steps.terminations | self._steps.truncations).sum())

    @property
    def n_without_last(self) -> int:
        """Number of episodes that terminated and whose last observation is not known; no target needs it."""
        steps = self._steps
        return int((steps.next_at == steps.at).sum()) if steps.next_observations is None else 0

    @property
    def return_range(self) -> float:
        """
        Largest minus smallest undiscounted return of the episodes, those that are cut off included. Where a next
        observation equals the following observation except for rounding, the episode continues.

        :raises ValueError: if most steps are episodes of one step that did not terminate, as in shuffled data
        """
        rewards, last = as_numpy(self._steps.rewards).astype(np.float64), -1
        returns, n_alone = [], 0
        for end in self._last_steps():
            returns.append(rewards[last + 1 : end + 1].sum())
            n_alone += int(end == last + 1 and not self._steps.terminations[end])
            last = end
        if n_alone > max(len(self) // 2, 1):
            raise ValueError(
                f"{n_alone} of {len(self)} steps are episodes of their own, so that the returns have no meaningful "
                "range: the data set must have its steps in the order in which they were taken"
            )
        return float(max(returns) - min(returns))

    def _last_steps(self) -> np.ndarray:
        """Last steps of the episodes, except where a next observation equals the following one but for rounding."""
        steps, terminated = self._steps, as_numpy(self._steps.terminations)
        ends = np.flatnonzero(terminated | as_numpy(steps.truncations))
        goes_on = np.zeros(len(self), bool)
        cut_off = ends[~terminated[ends] & (ends < len(self) - 1)]
        for piece in pieces(len(cut_off), steps.observations, steps.observations):
            rows = cut_off[piece]
            following, then = _take(steps.observations, steps.at[rows + 1]), self._next_observations(rows)
            # Where they are equal, the end of the episode is the data set's own.
            goes_on[rows] = _rows_agree(then, following, np.isclose) & ~_rows_agree(then, following, np.equal)
        return ends[~goes_on[ends]]

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the transitions, independent of the data set's source; of their numbers, not of the spaces."""
        if not self._fingerprint:
            digest = sha256()
            # Of so many rows each, whatever is read at a time: checkpoints hold the fingerprints of their data sets.
            for first in range(0, len(self), CHUNK):
                last = min(first + CHUNK, len(self))
                for name, readers in self._readers().items():
                    for key, read in sorted(readers.items()):
                        one = as_numpy(read(slice(first, first + 1)))
                        digest.update(f"{name}/{key} {one.dtype} {(last - first, *one.shape[1:])} ".encode())
                        for piece in pieces(last - first, one):
                            found = as_numpy(read(slice(first + piece.start, first + piece.stop)))
                            digest.update(np.ascontiguousarray(found).data)
            self._fingerprint = digest.hexdigest()
        return self._fingerprint

    def rows(self, rows: slice | np.ndarray) -> dict[str, Any]:
        """
        Read transitions as they are, in the environment's units.

        :param rows: which of them
        :return: ``observations``, ``actions``, ``rewards``, ``terminations``, ``truncations``, ``next_observations``
            and the further columns by name, arrays
        """
        found: dict[str, Any] = {}
        for name, readers in self._readers().items():
            parts = {key: as_numpy(read(rows)) for key, read in readers.items()}
            found[name] = parts.get(ONLY, parts)
        return found

    def _readers(self) -> dict[str, dict[str, Callable[[Any], Any]]]:
        """
        Functions from rows to a part of the transitions there, by the names of :meth:`rows` and the keys of dict
        observations, or ``ONLY``: each reads that part alone.
        """
        steps = self._steps

        def readers(parts: Any, places: Any) -> dict[str, Callable[[Any], Any]]:
            by_key = parts if isinstance(parts, dict) else {ONLY: parts}
            if places is None:
                return {key: part.__getitem__ for key, part in by_key.items()}
            return {key: functools.partial(_at, part, places) for key, part in by_key.items()}

        following = steps.observations if steps.next_observations is None else steps.next_observations
        return {
            "observations": readers(steps.observations, steps.at),
            **{name: readers(getattr(steps, name), None) for name in _PLAIN},
            "next_observations": readers(following, steps.next_at if steps.next_observations is None else None),
            **{name: readers(values, None) for name, values in steps.columns.items()},
        }

    def plain(self, rows: slice | np.ndarray) -> dict[str, np.ndarray]:
        """
        Read transitions without their observations.

        :param rows: which of them
        :return: ``actions``, ``rewards``, ``terminations``, ``truncations``
        """
        return {name: as_numpy(getattr(self._steps, name)[rows]) for name in _PLAIN}

    def episodes(self) -> Iterator[slice]:
        """
        Iterate over the episodes.

        :return: the rows of each
        """
        first = 0
        for end in np.flatnonzero(as_numpy(self._steps.terminations | self._steps.truncations)):
            yield slice(first, int(end) + 1)
            first = int(end) + 1

    def to(self, device: torch.device | str) -> "Dataset":
        """
        Move the data set to a device.

        :param device: device of the transitions, and so of the batches
        :return: the data set
        """
        self._steps = _map(lambda tensor: tensor.to(device), self._steps)
        self._low, self._range = self._low.to(device), self._range.to(device)
        return self

    def sample(self, batch_size: int) -> Batch:
        """
        Draw a batch.

        :param batch_size: B
        :return: transitions with actions in [-1, 1], whose discount factor is the learner's
        :raises ValueError: if the batch size is below 1
        """
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, not {batch_size}")
        return self.take(torch.randint(len(self), (batch_size,), generator=self._generator))

    def take(self, rows: torch.Tensor) -> Batch:
        """
        Make a batch of given transitions.

        :param rows: which of them, (B,)
        :return: transitions with actions in [-1, 1], whose discount factor is the learner's
        """
        steps = self._steps
        rows = rows.to(steps.actions.device)
        actions = 2 * (steps.actions[rows].double() - self._low) / self._range - 1
        return Batch(
            _take(steps.observations, steps.at[rows]),
            actions.clamp(-1, 1).float().flatten(1),
            self._next_observations(rows),
            steps.terminations[rows].float().unsqueeze(1),
            steps.rewards[rows].unsqueeze(1),
            columns={name: _as_column(values[rows]) for name, values in steps.columns.items()},
        )

    def _next_observations(self, rows: Any) -> Any:
        steps = self._steps
        if steps.next_observations is not None:
            return _take(steps.next_observations, rows)
        return _take(steps.observations, steps.next_at[rows])


def _at(part: Any, places: Any, rows: Any) -> Any:
    return part[places[rows]]


def _map(function: Callable[[Any], Any], steps: Steps) -> Steps:
    changed: dict[str, Any] = {
        name: None if value is None else for_each(function, value) for name, value in steps._asdict().items()
    }
    return Steps(**changed)


def _take(columns: Any, rows: Any) -> Any:
    if isinstance(columns, tuple):
        return tuple(column[rows] for column in columns)
    return for_each(lambda column: column[rows], columns)


def _as_column(values: torch.Tensor) -> torch.Tensor:
    return values.unsqueeze(1) if values.dim() == 1 else values


def _parts(arrays: Any) -> list[Any]:
    return list(arrays.values()) if isinstance(arrays, dict) else [arrays]


def _arrays(name: str, values: Any, least_axes: int, space: spaces.Space | None = None) -> Any:
    """Arrays, or objects that are read like arrays in pieces; only numbers of a Discrete space are read at once."""
    if isinstance(values, Mapping):
        inside = space.spaces if isinstance(space, spaces.Dict) else {}
        return {key: _arrays(f"{name}[{key!r}]", value, least_axes, inside.get(key)) for key, value in values.items()}
    array = values if hasattr(values, "shape") and hasattr(values, "dtype") else np.asarray(values)
    if isinstance(array, torch.Tensor):
        array = as_numpy(array)
    if isinstance(space, spaces.Discrete) and len(array.shape) == 1:
        # The number of a Discrete space is a row of one.
        array = np.asarray(array)[:, None]
    if array.dtype.kind not in "fiub" or len(array.shape) < least_axes:
        raise ValueError(f"{name} must be numbers of shape (N, ...), not {array.dtype} of shape {array.shape}")
    return array


def _copied(name: str, values: Any, dtype: Any, folder: str | None) -> Any:
    if isinstance(values, dict):
        return {key: _copied(f"{name}[{key!r}]", value, dtype[key], folder) for key, value in values.items()}
    out = zeros(folder, values.shape, dtype)
    put(name, values, out)
    return out


def _folder(memory_map: Any, held: list[tuple[Any, Any]]) -> str | None:
    """The folder, if it has room for arrays, each given with the type in which it is held (or dicts of both)."""
    if memory_map is None:
        return None

    def needed(values: Any, dtype: Any) -> int:
        if isinstance(values, dict):
            return sum(needed(value, dtype[key]) for key, value in values.items())
        return n_bytes(values.shape, dtype)

    return check_folder(memory_map, sum(needed(*each) for each in held))


def _breaks(steps: Steps) -> np.ndarray:
    """Steps whose next observation is not the observation of the following step, (N,)."""
    n = len(steps.actions)
    breaks = np.ones(n, bool)
    for rows in pieces(n - 1, steps.observations, steps.next_observations):
        following = slice(rows.start + 1, rows.stop + 1)
        then, now = _take(steps.next_observations, rows), _take(steps.observations, following)
        breaks[rows] = ~_rows_agree(then, now, np.equal)
    return breaks


def _rows_agree(then: Any, now: Any, agree: Callable[..., np.ndarray]) -> np.ndarray:
    """Whether observations agree in all their numbers, (N,)."""
    pairs = [(as_numpy(a), as_numpy(b)) for a, b in zip(_parts(then), _parts(now), strict=True)]
    return np.logical_and.reduce([agree(a, b).reshape(len(a), -1).all(1) for a, b in pairs])  # type: ignore[no-any-return]


def _column(name: str, values: Any) -> np.ndarray:
    with np.errstate(over="ignore"):  # numbers beyond float32 are refused below
        array = np.array(values).astype(np.float32)
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != 1:
        raise ValueError(f"{name} must be of shape (N,), not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, within float32")
    return array


def _space_of(observations: Any) -> spaces.Space:
    if isinstance(observations, dict):
        return spaces.Dict({key: _space_of(value) for key, value in observations.items()})
    if observations.dtype.kind == "f":
        return spaces.Box(-np.inf, np.inf, observations.shape[1:], np.float32)
    kind: Any = observations.dtype.type
    if observations.dtype.kind == "b":
        return spaces.MultiBinary(observations.shape[1:])
    return spaces.Box(np.iinfo(kind).min, np.iinfo(kind).max, observations.shape[1:], kind)


def _check_shapes(name: str, space: spaces.Space, observations: Any) -> None:
    if isinstance(space, spaces.Dict) != isinstance(observations, dict):
        raise ValueError(f"{name} must be arrays of observation_space={space}")
    if isinstance(space, spaces.Dict):
        if space.spaces.keys() != observations.keys():
            raise ValueError(f"{name} must have the keys {sorted(space.spaces)}, not {sorted(observations)}")
        for key, part in space.spaces.items():
            _check_shapes(f"{name}[{key!r}]", part, observations[key])
        return
    # The number of a Discrete space is a row of one.
    if observations.shape[1:] != (space.shape or (1,)):
        raise ValueError(f"{name} of shape {observations.shape} are none of observation_space={space}")
