"""Fixed data sets of transitions as a source of batches."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from sb3_sample.learner.batch import Batch, for_each

Arrays = np.ndarray | dict[str, np.ndarray]


class Dataset:
    """
    Fixed set of transitions, from which batches are drawn uniformly with replacement.

    :param observations: (N, O), or a dict of such arrays; floats as float32, integers as they are
    :param actions: in [-1, 1], float32, (N, A)
    :param next_observations: as the observations
    :param rewards: float32, (N,)
    :param terminations: 1 where the episode terminated (a time limit is 0), float32, (N,)
    :param observation_space: of the observations
    :param action_space: of the actions as an environment takes them
    :param seed: of the generator that the batches are drawn from
    :param columns: further columns of the batches by name, (N, ...) each
    """

    def __init__(
        self,
        observations: Arrays,
        actions: np.ndarray,
        next_observations: Arrays,
        rewards: np.ndarray,
        terminations: np.ndarray,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        seed: int = 0,
        columns: Mapping[str, np.ndarray] | None = None,
    ):
        self.observation_space, self.action_space = observation_space, action_space
        self._rows = Batch(
            for_each(torch.from_numpy, observations),
            torch.from_numpy(actions),
            for_each(torch.from_numpy, next_observations),
            torch.from_numpy(terminations).unsqueeze(1),
            torch.from_numpy(rewards).unsqueeze(1),
            columns={
                name: torch.from_numpy(values.reshape(len(values), -1) if values.ndim == 1 else values)
                for name, values in (columns or {}).items()
            },
        )
        self._generator = torch.Generator().manual_seed(seed)

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
    ) -> "Dataset":
        """
        Make a data set of N steps in the order in which they were taken, episode after episode.

        Without ``next_observations`` a step's next observation is the following step's. A truncated step, and the
        last one, have none then and are left out, unless the episode terminated there.

        :param observations: (N, O), or a dict of such arrays
        :param actions: (N, A), within the bounds of ``action_space``
        :param rewards: (N,)
        :param terminations: whether the episode terminated with the step, (N,)
        :param truncations: whether it was cut off there, by a time limit for example, (N,)
        :param next_observations: as the observations
        :param observation_space: of the observations; None: unbounded, of their shape
        :param action_space: of the actions; None: [-1, 1]
        :param seed: of the generator that the batches are drawn from
        :param columns: further columns of the batches by name, such as the number of a task: numbers, (N,) or (N, ...)
        :return: the data set, its actions scaled to [-1, 1]
        :raises ValueError: if the arrays are not of one length, not of the spaces, or not finite
        """
        observations = _rows("observations", observations)
        actions = np.asarray(actions, np.float32)
        if actions.ndim < 2:
            raise ValueError(f"actions must be of shape (N, A), not {actions.shape}")
        rewards = _column("rewards", rewards)
        flags = {"terminations": _column("terminations", terminations)}
        flags["truncations"] = _column("truncations", truncations)
        given = {}
        if next_observations is not None:
            given["next_observations"] = _rows("next_observations", next_observations)
        more = {name: _numbers(f"columns[{name!r}]", values, 1) for name, values in (columns or {}).items()}
        n = len(rewards)
        if n == 0:
            raise ValueError("rewards must have at least one step, not 0")
        for name, value in {"observations": observations, "actions": actions, **flags, **given, **more}.items():
            for part in value.values() if isinstance(value, dict) else (value,):
                if len(part) != n:
                    raise ValueError(f"{name} must have as many steps as rewards, {n}, not {len(part)}")
        for name, flag in flags.items():
            if not np.isin(flag, (0, 1)).all():
                raise ValueError(f"{name} must be 0 or 1, not {flag[~np.isin(flag, (0, 1))][0]}")
        observation_space = observation_space or _space_of(observations)
        action_space = action_space or spaces.Box(-1, 1, actions.shape[1:], np.float32)
        _check_shapes(observation_space, observations)
        _check_shapes(observation_space, given.get("next_observations", observations))
        low, high = action_space.low, action_space.high
        if actions.shape[1:] != action_space.shape or not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise ValueError(f"actions of shape (N, {actions.shape[1:]}) are none of action_space={action_space}")
        # float32 rounds a bound that float64 has.
        margin = 1e-5 * (high - low)
        if not ((actions >= low - margin) & (actions <= high + margin)).all():
            raise ValueError(f"actions must lie within the bounds of action_space={action_space}")
        scaled = np.clip(2 * (actions - low) / (high - low) - 1, -1, 1).astype(np.float32).reshape(n, -1)
        kept = np.arange(n)
        if next_observations is None:
            # Those of a step that terminated are not bootstrapped from, whatever they are.
            following = np.minimum(kept + 1, n - 1)
            given["next_observations"] = _take(observations, following)
            cut_off = (flags["truncations"] == 1) | (kept == n - 1)
            kept = np.flatnonzero(~cut_off | (flags["terminations"] == 1))
            if not len(kept):
                raise ValueError("next_observations must be given: every step is the last of an episode cut off")
        return cls(
            _take(observations, kept),
            scaled[kept],
            _take(given["next_observations"], kept),
            rewards[kept],
            flags["terminations"][kept],
            observation_space,
            action_space,
            seed,
            _take(more, kept),
        )

    def __len__(self) -> int:
        return len(self._rows.actions)

    def to(self, device: torch.device | str) -> "Dataset":
        """
        Move the data set to a device.

        :param device: device of the transitions, and so of the batches
        :return: the data set
        """
        self._rows = self._rows_by(lambda tensor: tensor.to(device))
        return self

    def _rows_by(self, function: Callable[[torch.Tensor], torch.Tensor]) -> Batch:
        """The rows, their tensors changed by a function."""
        changed: dict[str, Any] = {
            name: None if value is None else for_each(function, value) for name, value in self._rows._asdict().items()
        }
        return Batch(**changed)

    def sample(self, batch_size: int) -> Batch:
        """
        Draw a batch.

        :param batch_size: B
        :return: transitions, whose discount factor is the learner's
        :raises ValueError: if the batch size is below 1
        """
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, not {batch_size}")
        rows = torch.randint(len(self), (batch_size,), generator=self._generator).to(self._rows.actions.device)
        return self._rows_by(lambda tensor: tensor[rows])


def _take(columns: Any, rows: Any) -> Any:
    return for_each(lambda column: column[rows], columns)


def _rows(name: str, values: Any) -> Arrays:
    """Convert arrays to their stored form: floats as float32."""
    if isinstance(values, dict):
        return {key: _rows(f"{name}[{key!r}]", value) for key, value in values.items()}  # type: ignore[misc]
    return _numbers(name, values, 2)


def _numbers(name: str, values: Any, least_axes: int) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind not in "fiub" or array.ndim < least_axes:
        raise ValueError(f"{name} must be numbers of shape (N, ...), not {array.dtype} of shape {array.shape}")
    if array.dtype.kind != "f":
        return array
    with np.errstate(over="ignore"):
        array = array.astype(np.float32)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, within float32")
    return array


def _column(name: str, values: Any) -> np.ndarray:
    with np.errstate(over="ignore"):  # what float32 does not hold is refused below
        array = np.asarray(values).astype(np.float32)
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != 1:
        raise ValueError(f"{name} must be of shape (N,), not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, within float32")
    return array


def _space_of(observations: Arrays) -> spaces.Space:
    if isinstance(observations, dict):
        return spaces.Dict({key: _space_of(value) for key, value in observations.items()})
    if observations.dtype.kind == "f":
        return spaces.Box(-np.inf, np.inf, observations.shape[1:], np.float32)
    kind: Any = observations.dtype.type
    if observations.dtype.kind == "b":
        return spaces.MultiBinary(observations.shape[1:])
    return spaces.Box(np.iinfo(kind).min, np.iinfo(kind).max, observations.shape[1:], kind)


def _check_shapes(space: spaces.Space, observations: Arrays) -> None:
    if isinstance(space, spaces.Dict) != isinstance(observations, dict):
        raise ValueError(f"observations must be arrays of observation_space={space}")
    if isinstance(space, spaces.Dict):
        assert isinstance(observations, dict)
        if space.spaces.keys() != observations.keys():
            raise ValueError(f"observations must have the keys {sorted(space.spaces)}, not {sorted(observations)}")
        for key, part in space.spaces.items():
            _check_shapes(part, observations[key])
        return
    assert isinstance(observations, np.ndarray)
    if observations.shape[1:] != space.shape:
        raise ValueError(f"observations of shape {observations.shape} are none of observation_space={space}")
