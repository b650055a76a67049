"""Replay buffers in files that run no code."""

import io
import json
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.her import HerReplayBuffer

from sb3_sample.replay.columns import HasColumns, columns_of
from sb3_sample.replay.endings import leads_to
from sb3_sample.saving import container, notice, paths
from sb3_sample.saving.classes import PACKAGES, check_trusted, has_state, may_be_set, path_of, within
from sb3_sample.saving.container import BadFile, PickledFile
from sb3_sample.saving.decoding import NotTrusted
from sb3_sample.saving.encoding import Lenient, decode, is_left_out
from sb3_sample.saving.rings import check_episodes, check_values
from sb3_sample.saving.untrusted import MAX_MESSAGE

KIND = "replay buffer"
#: Suffix added to a path on writing, and the one that callers who expect a pickle may have added.
SUFFIX, PICKLES_SUFFIX = "buffer.zip", "pkl"
#: Suffixes with which a path stays as it is.
OWN_SUFFIXES = ("zip", PICKLES_SUFFIX)
#: Largest number of transitions for which a model's file can ask memory, which is not touched before they come; and the
#: same for a HerReplayBuffer, which makes an object for each.
MAX_TRANSITIONS, MAX_HER_TRANSITIONS = 100_000_000, 5_000_000
#: The same for a replay buffer's file, if it is larger than the model's own buffer.
MAX_OTHER, MAX_OTHER_HER = 20_000_000, 1_000_000
#: Attributes that belong to the model and its environment, and those that follow from the rows.
_NOT_SAVED = ("device", "env", "_training_side", "_validation_side")
#: Arguments for making anew a buffer that saves and loads its own state.
_ARGUMENTS = (
    "buffer_size", "n_envs", "handle_timeout_termination", "validation_proportion", "horizon", "frame_stack", "n_steps",
    "gamma",
)  # fmt: skip
_ARRAYS = (np.ndarray, torch.Tensor)


class SafeReplayBuffers(OffPolicyAlgorithm):
    """
    Base of the algorithms, before Stable-Baselines3's, with ``save_replay_buffer`` and ``load_replay_buffer`` for files
    that run no code. See docs/saving.md.
    """

    def save_replay_buffer(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        *,
        allow_pickle: bool = False,
        trusted_modules: Sequence[str] = (),
    ) -> None:
        """
        Save the replay buffer, as in Stable-Baselines3, but to a file that runs no code when it is loaded. Rows that
        were never filled take no space. Attributes that no file can hold are left out, with a warning.

        :param path: path, to which ".buffer.zip" is added unless it ends in ".zip" or ".pkl", or a binary file open for
            writing
        :param allow_pickle: whether to write Stable-Baselines3's own, pickled format instead (".pkl")
        :param trusted_modules: modules, or packages of modules, that will be passed as trusted when it is loaded, so
            that no warning is needed
        :raises ValueError: if there is no replay buffer
        :raises OSError: if the file cannot be written
        """
        trusted = check_trusted(trusted_modules)
        buffer = getattr(self, "replay_buffer", None)
        if buffer is None:
            raise ValueError("there is no replay buffer to save")
        if allow_pickle:
            super().save_replay_buffer(paths.to_write(path, PICKLES_SUFFIX, *OWN_SUFFIXES))
            return
        encoder = Lenient({})
        tree = encode_buffer(buffer, encoder)
        notice.say_once(self, encoder, trusted)
        container.write(paths.to_write(path, SUFFIX, *OWN_SUFFIXES), KIND, tree, encoder.tensors)

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

        :param path: file, or where ``save_replay_buffer`` wrote it; its content, not its name, decides how it is read
        :param truncate_last_traj: with ``HerReplayBuffer``, whether the last episode counts as ended; with every
            buffer, whether the next ``learn`` begins with a reset of the environment if its state is not the one to
            which the buffer's last transitions led
        :param allow_pickle: whether a file in Stable-Baselines3's own, pickled format is loaded too, which can run any
            code that its author wanted
        :param trusted_modules: modules, or packages of modules, whose classes the file may name, besides those that the
            model was loaded with
        :raises BadFile: (a ``ValueError``) if the file is damaged, hostile or pickled, or names something that is not
            trusted
        :raises ValueError: if it is the buffer of other spaces or of another number of environments, or holds out
            another share of its transitions than ``validation_proportion``
        """
        trusted = (*self._trusted_modules, *check_trusted(trusted_modules))  # type: ignore[attr-defined]
        # A name with a dot in it may be that of the model.
        dotted = isinstance(path, (str, pathlib.Path)) and pathlib.Path(path).suffix[1:] not in ("", *OWN_SUFFIXES)
        found = paths.find(path, SUFFIX, PICKLES_SUFFIX, first=dotted)
        name = str(getattr(found, "name", "the file")) if not isinstance(found, pathlib.Path) else str(found)
        try:
            with paths.opened(found) as file:
                tree, tensors = container.read(file, KIND)
        except PickledFile:
            if not allow_pickle:
                raise
            buffer = self._pickled_buffer(found, name, truncate_last_traj)
        else:
            buffer = decode_buffer(tree, tensors, self, name, trusted)
            if isinstance(buffer, HerReplayBuffer):
                if self.env is None:
                    raise ValueError(
                        "a HerReplayBuffer needs the model's environment: pass env= to load, or call set_env"
                    )
                buffer.set_env(self.env)
                if truncate_last_traj:
                    buffer.truncate_last_trajectory()
        self._check_replay_buffer(buffer, path)
        self.replay_buffer = buffer
        last: Any = self._last_obs if self.get_vec_normalize_env() is None else self._last_original_obs
        if truncate_last_traj and last is not None and not leads_to(buffer, last):
            # The episode under way is not the buffer's last: the next ``learn`` resets the environment.
            self._last_obs = None

    def _pickled_buffer(self, path: Any, name: str, truncate_last_traj: bool) -> ReplayBuffer:
        before = getattr(self, "replay_buffer", None)
        super().load_replay_buffer(path, truncate_last_traj)
        loaded: Any = self.replay_buffer
        self.replay_buffer = before
        try:
            _check_n_envs(loaded.n_envs, self)
            _check_spaces(loaded, self)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        return loaded  # type: ignore[no-any-return]

    def _check_replay_buffer(self, buffer: ReplayBuffer, path: Any) -> None:
        """
        :param buffer: the loaded buffer
        :param path: where it was loaded from
        :raises ValueError: if the algorithm cannot learn from it
        """


def encode_buffer(buffer: ReplayBuffer, encoder: Lenient, only_small: bool = False) -> Any:
    """
    :param buffer: a replay buffer
    :param encoder: takes its arrays, without copying them
    :param only_small: whether to leave out the rows, as if there were none
    :return: its tree of JSON
    """
    tree: dict[str, Any] = {"class": encoder.attempt(type(buffer), "replay_buffer").get("import")}
    if has_state(type(buffer)):
        tree["arguments"] = {name: getattr(buffer, name) for name in _ARGUMENTS if hasattr(buffer, name)}
        state: Any = {} if only_small else buffer.state_dict()  # type: ignore[attr-defined]
        tree["state"] = {"dict": {key: encoder.attempt(value, f"replay_buffer.{key}") for key, value in state.items()}}
        return tree
    tree["attributes"] = {}
    for name, value in vars(buffer).items():
        if name in _NOT_SAVED or (only_small and isinstance(value, (*_ARRAYS, dict))):
            continue
        if may_be_set(type(buffer), name):
            tree["attributes"][name] = _encode_attribute(buffer, value, f"replay_buffer.{name}", encoder)
        else:
            encoder.leave_out(f"replay_buffer.{name}", "it takes the place of what the class does")
    return tree


def _encode_attribute(buffer: ReplayBuffer, value: Any, name: str, encoder: Lenient) -> dict[str, Any]:
    if isinstance(value, dict) and value and all(isinstance(item, np.ndarray) for item in value.values()):
        return {"dict": {k: _encode_attribute(buffer, item, f"{name}.{k}", encoder) for k, item in value.items()}}
    if not isinstance(value, _ARRAYS) or value.ndim == 0:
        return {"whole": encoder.attempt(value, name)}
    if isinstance(value, np.ndarray) and value.dtype == object and all(isinstance(info, dict) for info in value.flat):
        # HerReplayBuffer's infos: the environments' if copy_info_dict, else empty.
        infos = [list(row) for row in value]
        while infos and not any(infos[-1]):
            infos.pop()
        known = set(encoder.tensors)
        first = [[_encode_info(info, name, encoder) for info in row] for row in infos]
        new = encoder.tensors.keys() - known
        text, n_bytes = json.dumps(first).encode(), sum(tensor.nbytes for tensor in encoder.tensors.values())
        too_large = len(text) > container.MAX_JSON // 2 or len(new) > container.MAX_TENSORS // 2
        if too_large or container.n_values(text) > container.most_values(n_bytes) // 2:
            # More than a reader accepts: the transitions are worth more than their infos.
            encoder.leave_out(name, f"they take {len(text)} bytes of JSON and {len(new)} arrays")
            first = []
            for key in new:
                del encoder.tensors[key]
        return {"infos": list(value.shape), "first": first}
    filled = _filled(buffer, len(value))
    if filled < len(value) and not value[filled:].any():
        return {"rows": len(value), "first": encoder.attempt(value[:filled], name)}
    return {"whole": encoder.attempt(value, name)}


def _encode_info(info: dict[Any, Any], name: str, encoder: Lenient) -> Any:
    """The info of a step, without values that no file can hold."""
    pairs = [(key, encoder.attempt(item, f"{name}.{key}")) for key, item in info.items() if type(key) is str]
    return {"dict": {key: tree for key, tree in pairs if not is_left_out(tree)}}


def _filled(buffer: ReplayBuffer, n_rows: int) -> int:
    """How many rows of an array can have been written: one more than are filled, for the next observation."""
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
    :param trusted: modules whose classes it may have
    :return: the buffer, without an environment
    :raises BadFile: if it is no tree of a buffer
    :raises ValueError: if it is the buffer of other spaces
    """
    try:
        path, classes = tree["class"], [type(getattr(model, "replay_buffer", None)), model.replay_buffer_class]
        # The program's own classes need neither trust nor a path that leads to them: one may be defined in a function.
        own = next((cls for cls in classes if cls is not None and path == path_of(cls)), None)
        cls = decode({"import": path}, {}, "replay_buffer", trusted) if own is None else own
        if not (isinstance(cls, type) and issubclass(cls, ReplayBuffer)):
            raise BadFile(f"it holds a {cls.__name__}, which is no replay buffer")
        if has_state(cls):
            return _with_state(cls, tree, tensors, model, trusted)
        return _with_attributes(cls, tree, tensors, model, trusted)
    except (KeyError, TypeError, IndexError, AttributeError, ArithmeticError, MemoryError, RuntimeError) as error:
        raise BadFile(
            f"{name}: no replay buffer can be made of what it holds: {type(error).__name__}: {error}"
        ) from error
    except NotTrusted as error:
        wanted = notice.need(type(model), "replay_buffer", error.path, trusted)
        raise BadFile(f"{name}: {error}: {wanted}") from error
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
    check_values({key: value for key, value in state.items() if isinstance(value, _ARRAYS)}, "replay_buffer", cls)
    own: Any = getattr(model, "replay_buffer", None)
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
    full, pos = described["full"]["whole"], described["pos"]["whole"]
    if type(full) is not bool or type(pos) is not int or not 0 <= pos < size:
        raise BadFile(f"it is filled up to {pos!r:.50} of {size} rows")
    filled = size if full else pos
    own = getattr(model, "replay_buffer", None)
    buffer: Any = cls.__new__(cls)
    for name, value in described.items():
        if name in _NOT_SAVED or not may_be_set(cls, name):
            raise BadFile(f"it sets {name!r:.100}, which is no attribute of a {cls.__name__}")
        if is_left_out(value.get("whole")) and type(own) is cls and name in vars(own):
            vars(buffer)[name] = vars(own)[name]
        else:
            sizes = (size, n_envs, filled)
            vars(buffer)[name] = _decode_attribute(value, sizes, f"replay_buffer.{name}", tensors, trusted)
    if type(own) is cls:
        _check_alike(buffer, own)
    buffer.device = model.device
    if issubclass(cls, HerReplayBuffer):
        buffer.env = None
    for name, value in vars(buffer).items():
        if isinstance(value, torch.Tensor):
            vars(buffer)[name] = value.to(model.device)
    for name in columns_of(cls):
        # With optimize_memory_usage the next observations are those of the next row.
        columns = {} if name == "next_observations" and buffer.optimize_memory_usage else getattr(buffer, name)
        for column in columns.values() if isinstance(columns, dict) else [columns]:
            if column.shape[:2] != (size, n_envs):
                raise BadFile(f"{name} is of shape {tuple(column.shape)}, not of {size} rows of {n_envs} environments")
            check_values({name: column[:filled]}, "replay_buffer", cls)
    check_episodes(buffer, "replay_buffer")
    _check_spaces(buffer, model)
    if isinstance(buffer, HasColumns):
        buffer._restored()
    return buffer


def _check_size(size: Any, n_envs: Any, cls: type, model: OffPolicyAlgorithm) -> None:
    if type(size) is not int or type(n_envs) is not int or size < 1 or n_envs < 1:
        raise BadFile(f"its size is {size!r:.50} rows of {n_envs!r:.50} environments")
    own = getattr(model, "replay_buffer", None)
    most = max(
        MAX_OTHER_HER if issubclass(cls, HerReplayBuffer) else MAX_OTHER,
        model.buffer_size if own is None else own.buffer_size * own.n_envs,
    )
    if size * n_envs > most:
        raise BadFile(
            f"its size is {size} rows of {n_envs} environments, at most {most} transitions in all: load the model with "
            "a buffer_size as large first"
        )
    _check_n_envs(n_envs, model)


def _check_n_envs(n_envs: int, model: OffPolicyAlgorithm) -> None:
    if n_envs != model.n_envs:
        raise ValueError(
            f"it is the buffer of {n_envs} environments (n_envs), but the model has {model.n_envs}: load the model "
            "with as many (env=), or go on without the buffer"
        )


def _check_alike(buffer: Any, own: Any) -> None:
    """
    Check a buffer whose class does not check its state itself: it must have the attributes of another, of the same
    types; attributes that a user's own class adds can be anything.
    """
    is_known = within(type(own).__module__, PACKAGES)
    for name, value in vars(own).items():
        if name in _NOT_SAVED or not (is_known or isinstance(value, np.ndarray)):
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
    tree: Any, sizes: tuple[int, int, int], name: str, tensors: dict[str, torch.Tensor], trusted: Sequence[str]
) -> Any:
    if "dict" in tree:
        return {
            key: _decode_attribute(item, sizes, f"{name}.{key}", tensors, trusted) for key, item in tree["dict"].items()
        }
    if "whole" in tree:
        return decode(tree["whole"], tensors, name, trusted)
    size, n_envs, filled = sizes
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
    if len(first) < filled * (n_rows // size):
        # The missing rows would be zeros, which no environment gave.
        raise BadFile(f"{name} has {len(first)} rows in the file, but {filled * (n_rows // size)} count as filled")
    rows: Any
    if isinstance(first, torch.Tensor):
        rows = first.new_zeros((n_rows, *first.shape[1:]))
    else:
        rows = np.zeros((n_rows, *first.shape[1:]), first.dtype)
    rows[: len(first)] = first
    return rows
