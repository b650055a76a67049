"""Replay buffers in files that run no code."""

import io
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.her import HerReplayBuffer

from sb3_sample.saving import container, paths
from sb3_sample.saving.classes import NotPortable, check_trusted, checked_path
from sb3_sample.saving.container import BadFile, PickledFile
from sb3_sample.saving.encoding import decode, encode
from sb3_sample.saving.untrusted import MAX_MESSAGE

KIND = "replay buffer"
SUFFIX = "buffer.zip"
#: Transitions that a model's file can ask memory for, which is not touched before they come; and of a HerReplayBuffer,
#: which makes an object for each.
MAX_TRANSITIONS, MAX_HER_TRANSITIONS = 100_000_000, 5_000_000
#: The same of a replay buffer's file, if it is larger than the model's own.
MAX_OTHER, MAX_OTHER_HER = 20_000_000, 1_000_000
#: What belongs to the model and its environment.
_NOT_SAVED = ("device", "env")
#: Arguments with which a buffer is made again that gives and takes its own state.
_ARGUMENTS = ("buffer_size", "n_envs", "handle_timeout_termination", "validation_proportion")
_COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class SafeReplayBuffers(OffPolicyAlgorithm):
    """
    What an algorithm's class gains that stands before Stable-Baselines3's among its bases: ``save_replay_buffer`` and
    ``load_replay_buffer`` with files that run no code. See docs/saving.md.
    """

    def save_replay_buffer(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        *,
        allow_pickle: bool = False,
        trusted_modules: Sequence[str] = (),
    ) -> None:
        """
        Save the replay buffer, as in Stable-Baselines3, but to a file that runs no code when it is loaded. The rows
        that were never filled take no space.

        :param path: path, to which ".buffer.zip" is added if it has no suffix, or a binary file open for writing
        :param allow_pickle: whether to write Stable-Baselines3's own, pickled format instead (".pkl")
        :param trusted_modules: modules, or packages of modules, whose classes the file may name; to be named again when
            it is loaded
        :raises NotPortable: (a ``ValueError``) if the buffer cannot be in such a file; nothing is written then
        :raises ValueError: if there is no replay buffer
        :raises OSError: if the file cannot be written
        """
        trusted = check_trusted(trusted_modules)
        if self.replay_buffer is None:
            raise ValueError("there is no replay buffer to save")
        if allow_pickle:
            super().save_replay_buffer(path)
            return
        tensors: dict[str, torch.Tensor] = {}
        tree = encode_buffer(self.replay_buffer, tensors, trusted)
        container.write(paths.to_write(path, SUFFIX), KIND, tree, tensors)

    def load_replay_buffer(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        truncate_last_traj: bool = True,
        *,
        allow_pickle: bool = False,
        trusted_modules: Sequence[str] = (),
    ) -> None:
        """
        Load a replay buffer, as in Stable-Baselines3. Nothing in the file is run, whoever wrote it.

        :param path: file, or where ``save_replay_buffer`` wrote it
        :param truncate_last_traj: with ``HerReplayBuffer``, whether the last episode counts as ended
        :param allow_pickle: whether a file in Stable-Baselines3's own, pickled format is loaded too, which can run any
            code that its author wanted
        :param trusted_modules: modules, or packages of modules, whose classes the file may name
        :raises BadFile: (a ``ValueError``) if the file is damaged, hostile or pickled
        :raises ValueError: if it is the buffer of other spaces
        """
        trusted = check_trusted(trusted_modules)
        try:
            with paths.opened(path, SUFFIX) as file:
                tree, tensors = container.read(file, KIND)
                name = str(getattr(file, "name", "the file"))
        except (PickledFile, FileNotFoundError):
            if allow_pickle:
                super().load_replay_buffer(path, truncate_last_traj)
                return
            if isinstance(path, (str, pathlib.Path)) and pathlib.Path(f"{path}.pkl").is_file():
                raise PickledFile(
                    f"{path}.pkl is pickled: allow_pickle=True reads it, and runs what is in it"
                ) from None
            raise
        buffer = decode_buffer(tree, tensors, self, name, trusted)
        if isinstance(buffer, HerReplayBuffer):
            if self.env is None:
                raise ValueError("a HerReplayBuffer needs the model's environment: pass env= to load, or call set_env")
            buffer.set_env(self.env)
            if truncate_last_traj:
                buffer.truncate_last_trajectory()
        self.replay_buffer = buffer


def _has_state(buffer: Any) -> bool:
    return hasattr(buffer, "state_dict") and hasattr(buffer, "load_state_dict")


def encode_buffer(buffer: ReplayBuffer, tensors: dict[str, torch.Tensor], trusted: Sequence[str] = ()) -> Any:
    """
    :param buffer: a replay buffer
    :param tensors: takes its arrays, without copying them
    :param trusted: modules whose classes it may be of
    :return: its tree of JSON
    :raises NotPortable: if it has no place in such a file
    """
    path = checked_path(type(buffer), "replay_buffer", trusted)
    if _has_state(buffer):
        arguments = {name: getattr(buffer, name) for name in _ARGUMENTS if hasattr(buffer, name)}
        state: Any = buffer.state_dict()  # type: ignore[attr-defined]
        return {"class": path, "arguments": arguments, "state": encode(state, "replay_buffer", tensors, trusted)}
    attributes = {}
    for name, value in vars(buffer).items():
        if name not in _NOT_SAVED:
            attributes[name] = _encode_attribute(buffer, value, f"replay_buffer.{name}", tensors, trusted)
    return {"class": path, "attributes": attributes}


def _encode_attribute(
    buffer: ReplayBuffer, value: Any, name: str, tensors: dict[str, torch.Tensor], trusted: Sequence[str]
) -> dict[str, Any]:
    if isinstance(value, dict) and value and all(isinstance(item, np.ndarray) for item in value.values()):
        return {
            "dict": {
                key: _encode_attribute(buffer, item, f"{name}.{key}", tensors, trusted) for key, item in value.items()
            }
        }
    if not isinstance(value, (np.ndarray, torch.Tensor)) or value.ndim == 0:
        return {"whole": encode(value, name, tensors, trusted)}
    if isinstance(value, np.ndarray) and value.dtype == object:
        # HerReplayBuffer's infos: of the environments if copy_info_dict, else empty.
        if value.ndim != 2 or not all(isinstance(info, dict) for info in value.flat):
            raise NotPortable(f"{name}: an array of other objects than dicts cannot be written to the file")
        infos = [list(row) for row in value]
        while infos and not any(infos[-1]):
            infos.pop()
        return {"infos": list(value.shape), "first": encode(infos, name, tensors, trusted)}
    filled = _filled(buffer, len(value))
    if filled < len(value) and not value[filled:].any():
        return {"rows": len(value), "first": encode(value[:filled], name, tensors, trusted)}
    return {"whole": encode(value, name, tensors, trusted)}


def _filled(buffer: ReplayBuffer, n_rows: int) -> int:
    """Up to where an array can have been written to; one more row than are filled, for the next observation."""
    if buffer.full:
        return n_rows
    steps = min(buffer.pos + 1, buffer.buffer_size)
    return {buffer.buffer_size: steps, buffer.buffer_size * buffer.n_envs: steps * buffer.n_envs}.get(n_rows, n_rows)


def decode_buffer(
    tree: Any, tensors: dict[str, torch.Tensor], model: OffPolicyAlgorithm, name: str, trusted: Sequence[str] = ()
) -> ReplayBuffer:
    """
    :param tree: from :func:`encode_buffer`
    :param tensors: its arrays
    :param model: the model that it is for. If the file's state fits into the model's buffer, it is loaded there
    :param name: the file, for messages
    :param trusted: modules whose classes it may be of
    :return: the buffer, without an environment
    :raises BadFile: if it is no tree of a buffer
    :raises ValueError: if it is the buffer of other spaces
    """
    try:
        cls = decode({"import": tree["class"]}, {}, "replay_buffer", trusted)
        if not (isinstance(cls, type) and issubclass(cls, ReplayBuffer)):
            raise BadFile(f"it holds a {cls.__name__}, which is no replay buffer")
        if _has_state(cls):
            return _with_state(cls, tree, tensors, model, trusted)
        return _with_attributes(cls, tree, tensors, model, trusted)
    except (KeyError, TypeError, IndexError, AttributeError, ArithmeticError, MemoryError, RuntimeError) as error:
        raise BadFile(
            f"{name}: no replay buffer can be made of what it holds: {type(error).__name__}: {error}"
        ) from error
    except BadFile as error:
        raise BadFile(f"{name}: {error}") from error
    except ValueError as error:
        raise ValueError(f"{name}: {error!s:.{MAX_MESSAGE}}") from error


def _with_state(
    cls: Any, tree: Any, tensors: dict[str, torch.Tensor], model: OffPolicyAlgorithm, trusted: Sequence[str]
) -> ReplayBuffer:
    arguments = tree["arguments"]
    if not arguments.keys() <= set(_ARGUMENTS):
        raise BadFile(f"it makes the buffer with {sorted(arguments)!r:.200}")
    size, n_envs = arguments["buffer_size"], arguments["n_envs"]
    _check_size(size, n_envs, cls, model)
    state = decode(tree["state"], tensors, "replay_buffer", trusted)
    own: Any = model.replay_buffer
    buffer = own
    if type(own) is not cls or any(getattr(own, name, None) != value for name, value in arguments.items()):
        same_class = {} if type(own) is not cls else dict(model.replay_buffer_kwargs)
        buffer = cls(
            observation_space=model.observation_space,
            action_space=model.action_space,
            device=model.device,
            **{**same_class, **arguments, "buffer_size": size * n_envs},
        )
    buffer.load_state_dict(state)
    return buffer


def _with_attributes(
    cls: Any, tree: Any, tensors: dict[str, torch.Tensor], model: OffPolicyAlgorithm, trusted: Sequence[str]
) -> ReplayBuffer:
    described = tree["attributes"]
    size, n_envs = described["buffer_size"]["whole"], described["n_envs"]["whole"]
    _check_size(size, n_envs, cls, model)
    buffer: Any = cls.__new__(cls)
    for name, value in described.items():
        if not name.isidentifier() or name.startswith("__") or name in _NOT_SAVED or hasattr(cls, name):
            raise BadFile(f"it sets {name!r:.100}, which is no attribute of a {cls.__name__}")
        vars(buffer)[name] = _decode_attribute(value, (size, n_envs), f"replay_buffer.{name}", tensors, trusted)
    if type(model.replay_buffer) is cls:
        _check_alike(buffer, model.replay_buffer)
    buffer.device = model.device
    if issubclass(cls, HerReplayBuffer):
        buffer.env = None
    for name, value in vars(buffer).items():
        if isinstance(value, torch.Tensor):
            vars(buffer)[name] = value.to(model.device)
    if type(buffer.full) is not bool or type(buffer.pos) is not int or not 0 <= buffer.pos < size:
        raise BadFile(f"it is filled up to {buffer.pos!r:.50} of {size} rows")
    for name in _COLUMNS:
        # With optimize_memory_usage the next observations are those of the next row.
        columns = {} if name == "next_observations" and buffer.optimize_memory_usage else getattr(buffer, name)
        for column in columns.values() if isinstance(columns, dict) else [columns]:
            if column.shape[:2] != (size, n_envs):
                raise BadFile(f"{name} is of shape {tuple(column.shape)}, not of {size} rows of {n_envs} environments")
    _check_spaces(buffer, model)
    return buffer


def _check_size(size: Any, n_envs: Any, cls: type, model: OffPolicyAlgorithm) -> None:
    if type(size) is not int or type(n_envs) is not int or size < 1 or n_envs < 1:
        raise BadFile(f"its size is {size!r:.50} rows of {n_envs!r:.50} environments")
    own = model.replay_buffer
    most = max(
        MAX_OTHER_HER if issubclass(cls, HerReplayBuffer) else MAX_OTHER,
        model.buffer_size if own is None else own.buffer_size * own.n_envs,
    )
    if size * n_envs > most:
        raise BadFile(
            f"its size is {size} rows of {n_envs} environments, at most {most} transitions in all: load the model with "
            "a buffer_size as large first"
        )


def _check_alike(buffer: Any, own: Any) -> None:
    """A class that does not look at its state itself: a buffer must have what another has, of the same kinds."""
    for name, value in vars(own).items():
        if name in _NOT_SAVED:
            continue
        if name not in vars(buffer):
            raise BadFile(f"it has no {name}")
        read = vars(buffer)[name]
        if value is not None and type(read) is not type(value):
            raise BadFile(f"its {name} is a {type(read).__name__}, not a {type(value).__name__}")
        if isinstance(value, np.ndarray) and (value.dtype.kind, value.ndim) != (read.dtype.kind, read.ndim):
            raise BadFile(
                f"its {name} is of {read.dtype} and shape {read.shape}, not of {value.dtype} and {value.shape}"
            )


def _check_spaces(buffer: Any, model: OffPolicyAlgorithm) -> None:
    for name in ("observation_space", "action_space"):
        saved, own = getattr(buffer, name), getattr(model, name)
        if _kind(saved) != _kind(own):
            raise ValueError(f"it is the buffer of the {name} {saved}, but the model's is {own}")


def _kind(space: Any) -> Any:
    inside = getattr(space, "spaces", None)
    if isinstance(inside, dict):
        return {key: _kind(part) for key, part in inside.items()}
    return space.shape, space.dtype


def _decode_attribute(
    tree: Any, sizes: tuple[int, int], name: str, tensors: dict[str, torch.Tensor], trusted: Sequence[str]
) -> Any:
    if "dict" in tree:
        return {
            key: _decode_attribute(item, sizes, f"{name}.{key}", tensors, trusted) for key, item in tree["dict"].items()
        }
    if "whole" in tree:
        return decode(tree["whole"], tensors, name, trusted)
    size, n_envs = sizes
    first = decode(tree["first"], tensors, name, trusted)
    if "infos" in tree:
        infos = np.array([[{} for _ in range(n_envs)] for _ in range(size)])
        for row, given in zip(infos, first, strict=False):
            if len(given) != n_envs or not all(isinstance(info, dict) for info in given):
                raise BadFile(f"{name} does not hold a dict for each of {n_envs} environments")
            row[:] = given
        return infos
    n_rows = tree["rows"]
    if n_rows not in (size, size * n_envs) or len(first) > n_rows:
        raise BadFile(f"{name} has {n_rows!r:.50} rows, of which {len(first)} are filled")
    rows: Any
    if isinstance(first, torch.Tensor):
        rows = first.new_zeros((n_rows, *first.shape[1:]))
    else:
        rows = np.zeros((n_rows, *first.shape[1:]), first.dtype)
    rows[: len(first)] = first
    return rows
