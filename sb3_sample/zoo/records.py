"""
Folder of a run with checkpoints: its record ``run.json`` of how it was started, the checks of its other files, and its
checkpoints. A run that learns from data first and then in its environment has the checkpoints of the first part in
``offline``.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from sb3_sample.run_logs import OFFLINE, monitor_files, monitor_head
from sb3_sample.saving.container import replacing
from sb3_sample.saving.untrusted import BadFile, parse_json, read_regular
from sb3_sample.zoo.files import RunError

RECORD = "run.json"
#: Largest size of a record, in bytes.
MAX_RECORD = 2**18
#: Endings of the files that a run writes.
SUFFIXES = (".csv", ".json", ".jsonl", ".npz", ".yml", ".zip")


class Record(NamedTuple):
    """
    How a run was started.

    :param algo: name of its algorithm
    :param env: id of its environment
    :param seed: its seed, which the zoo draws if none is given
    :param n_timesteps: ``-n``, or -1 if it was not given
    :param checkpoint_freq: environment steps between two checkpoints
    :param settings: arguments and hyperparameters by name, as Python writes them; only compared, never evaluated
    :param tensorboard: folder of its TensorBoard log, if it has one
    """

    algo: str
    env: str
    seed: int
    n_timesteps: int
    checkpoint_freq: int
    settings: dict[str, str]
    tensorboard: str | None = None

    def write(self, folder: Path) -> None:
        """
        :param folder: the run's folder
        :raises OSError: it cannot be written; one that was there is unchanged then
        """
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(folder / RECORD) as file:
            file.write(json.dumps(self._asdict(), indent=1).encode())

    @classmethod
    def read(cls, folder: Path) -> "Record":
        """
        :param folder: the run's folder
        :return: its record
        :raises RunError: there is none, or it is no such record
        """
        path = folder / RECORD
        try:
            found = parse_json(read_regular(path, MAX_RECORD), "it")
        except FileNotFoundError as error:
            raise RunError(f"{folder} is no folder of a run of sb3-sample train: it has no {RECORD}") from error
        except (OSError, BadFile) as error:
            raise RunError(f"{path} is not what sb3-sample train has written: {error}") from error
        if not isinstance(found, dict) or not cls._field_defaults.keys() | found.keys() == set(cls._fields):
            raise RunError(f"{path} is not what sb3-sample train has written: it has other entries")
        record = cls(**found)
        for name, value in record._asdict().items():
            if not _RECORDED[name](value):
                raise RunError(
                    f"{path} is not what sb3-sample train has written: a value is of the wrong kind, {name} is "
                    f"{value!r:.100}"
                )
        return record


def _is_id(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch(r"\w[\w:./-]{0,200}", value) is not None


def _is_within(low: int, high: int) -> Callable[[Any], bool]:
    return lambda value: type(value) is int and low <= value < high


def _are_texts(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(text, str) for text in value.values())


#: Checks of the entries of a record.
_RECORDED: dict[str, Callable[[Any], bool]] = {
    "algo": _is_id,
    "env": _is_id,
    "seed": _is_within(0, 2**32),
    "n_timesteps": _is_within(-1, 2**53),
    "checkpoint_freq": _is_within(1, 2**53),
    "settings": _are_texts,
    "tensorboard": lambda value: value is None or isinstance(value, str),
}


def check_entries(folder: Path) -> None:
    """
    :param folder: a run's folder
    :raises RunError: an entry of it, or of a folder in it, is a link, by which the run would write elsewhere; or a pipe
        or a device, which may never end; or a folder with the name of a file
    """
    for path in (*folder.glob("*"), *folder.glob("*/*")):
        if path.is_symlink():
            raise RunError(
                f"{path} is a link, and a run follows none in its folder (the folder itself may be one): remove it, or "
                "name another --run-dir"
            )
        is_folder = path.is_dir() and path.suffix not in SUFFIXES
        if not (path.is_file() or is_folder):
            raise RunError(f"{path} is no file, where a run has one: remove it, or name another --run-dir")


def check_monitor_files(folder: Path) -> None:
    """
    :param folder: folder of a run that resumes
    :raises RunError: a file that Monitor would append to is no file of Monitor's
    """
    for path in monitor_files(folder):
        try:
            monitor_head(path)
        except (OSError, BadFile) as error:
            raise RunError(f"{error}. The run would append to {path}: remove it, and a new one is begun") from error


def checkpoints(folder: Path) -> list[Path]:
    """
    :param folder: a run's folder
    :return: the folders of its checkpoints, oldest first; the checkpoints are not opened
    """
    return sorted(path for path in folder.glob("checkpoint-*") if re.fullmatch(r"checkpoint-\d{12,}", path.name))


def all_checkpoints(folder: Path) -> list[Path]:
    """
    :param folder: a run's folder
    :return: as ``checkpoints``, those of the steps on a data set first
    """
    return [*checkpoints(folder / OFFLINE), *checkpoints(folder)]
