"""
Logs of a run, read for the plots and to resume it: ``evaluations.npz`` of ``EvalCallback`` and the files of
``Monitor``. A run's folder may come from anybody: anything else is refused before it takes time or memory.
"""

import contextlib
import io
import math
import re
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.monitor import LoadMonitorResultsError, Monitor

from sb3_sample.saving.container import check_table
from sb3_sample.saving.untrusted import BadFile, open_regular, parse_json

if TYPE_CHECKING:
    import pandas as pd

EVALUATIONS = "evaluations.npz"
#: Subfolder of a run's folder, with the checkpoints and the log of its steps on a data set, if other steps follow.
OFFLINE = "offline"
#: Most arrays of the evaluations, and most bytes of all of them: 400,000 evaluations of ten episodes.
MAX_ARRAYS, MAX_BYTES = 16, 32 * 2**20
#: Most bytes of a NumPy header, and of a line of a Monitor file.
MAX_HEADER, MAX_LINE = 1000, 2**16
#: Most bytes of a Monitor file, most numbers in it (of a million episodes), and most columns.
MAX_MONITOR, MAX_FIELDS, MAX_COLUMNS = 64 * 2**20, 3_000_000, 64
#: Columns of Monitor files that plots use.
_COLUMNS = ("r", "l", "t", "is_success")
#: Pattern of Gymnasium's ids.
_ENV_ID = re.compile(r"[\w:.-]+(/[\w:.-]+)*")
_BLOCK = 2**20
#: Beginning of an archive with entries.
_BEGINNING = b"PK\x03\x04"


class Evaluations(dict[str, np.ndarray]):
    """
    Arrays by name, each with the T evaluations as its first axis.

    :param path: the file, for messages
    """

    def __init__(self, path: Path):
        super().__init__()
        self.path = path

    def __missing__(self, key: str) -> np.ndarray:
        raise BadFile(f"{self.path} has no {key!r:.100}, but {', '.join(self)}")


def has_ended(folder: Path) -> bool:
    """
    :param folder: a run's folder
    :return: whether it has a final model at least as new as its checkpoints; a run that was ended and goes on has an
        older one. A pipe or a device in its place counts as one, which its reader refuses
    """
    made = [*folder.glob("checkpoint-[0-9]*"), *(folder / OFFLINE).glob("checkpoint-[0-9]*")]
    final = [path for path in folder.glob("*.zip") if not path.name.startswith(("best_model.", "rl_model_"))]
    if any(path.exists() and not (path.is_file() or path.is_dir()) for path in final):
        return True
    return bool(final) and max(_times(final), default=0) >= max(_times(made), default=0)


def _times(paths: Iterable[Path]) -> Iterator[int]:
    for path in paths:
        # A run under way removes its old checkpoints.
        with contextlib.suppress(FileNotFoundError):
            yield path.stat().st_mtime_ns


def is_truncated(folder: str | Path) -> bool:
    """
    :param folder: a run's folder
    :return: whether its evaluations are truncated because the run is under way, in which case the next evaluation
        writes them anew: the run has checkpoints, and has not ended
    :raises BadFile: if they are a pipe or a device
    """
    folder = Path(folder)
    path = folder / EVALUATIONS
    has_checkpoint = any(folder.glob("checkpoint-*")) or (folder / OFFLINE).exists()
    if not path.exists() or not has_checkpoint or has_ended(folder):
        return False
    with open_regular(path) as file:
        start = file.read(len(_BEGINNING))
        return _BEGINNING.startswith(start) and not zipfile.is_zipfile(file)


def read_evaluations(path: str | Path) -> Evaluations:
    """
    :param path: ``evaluations.npz``
    :return: "timesteps", increasing, of shape (T,); "results", the returns, of shape (T, number of episodes), and
        everything else that was recorded, of one or the other shape
    :raises BadFile: (a ``ValueError``) if it is no such file
    :raises OSError: if it cannot be read
    """
    found = Evaluations(Path(path))
    with open_regular(path) as file:
        try:
            check_table(file, file.seek(0, io.SEEK_END), str(path))
            with zipfile.ZipFile(file) as archive:
                for name, entry in _arrays(archive):
                    found[name] = _read_array(archive, entry)
        except BadFile as error:
            raise BadFile(f"{path} holds no evaluations: {error}") from error
        except Exception as error:  # the readers of archives and of NumPy can raise anything
            raise BadFile(f"{path} holds no evaluations: {type(error).__name__}: {error}") from error
    _check_evaluations(found)
    return found


def _arrays(archive: zipfile.ZipFile) -> Iterator[tuple[str, zipfile.ZipInfo]]:
    entries = archive.infolist()
    size = sum(entry.file_size for entry in entries)
    if len(entries) > MAX_ARRAYS or size > MAX_BYTES:
        raise BadFile(
            f"{len(entries)} arrays of {size:,} bytes are more than the {MAX_ARRAYS} of {MAX_BYTES:,} that are read"
        )
    for entry in entries:
        if not entry.filename.endswith(".npy"):
            raise BadFile(f"{entry.filename!r:.100} is no array")
        yield entry.filename.removesuffix(".npy"), entry


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    """Read an array, whose shape and type must match its bytes."""
    with archive.open(entry) as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise BadFile(f"{entry.filename!r:.100} is in another format")
        header: Any = np.lib.format.read_array_header_1_0(file, max_header_size=MAX_HEADER)
        shape, by_column, dtype = header
        size = entry.file_size - file.tell()
        if dtype.kind not in "biuf" or len(shape) > 2 or by_column or math.prod(shape) * dtype.itemsize != size:
            raise BadFile(f"{entry.filename!r:.100} has {size} bytes for an array of shape {shape} and type {dtype}")
        return np.frombuffer(file.read(size), dtype).reshape(shape)


def _check_evaluations(found: Evaluations) -> None:
    steps, results = found["timesteps"], found["results"]
    if steps.ndim != 1 or not len(steps) or steps.dtype.kind not in "iu":
        raise BadFile(f"{found.path}: timesteps are {steps.dtype} of shape {steps.shape}, not whole numbers, (T,)")
    if steps[0] < 0 or steps[-1] >= 2**53 or not (steps[1:] > steps[:-1]).all():
        raise BadFile(f"{found.path}: timesteps do not increase from 0 on: {steps!r:.200}")
    if results.ndim != 2:
        raise BadFile(f"{found.path}: results are of shape {results.shape}, not (T, number of episodes)")
    for name, array in found.items():
        if not array.size or len(array) != len(steps):
            raise BadFile(f"{found.path}: {name!r:.100} is of shape {array.shape}, not of {len(steps)} evaluations")


# ---------------------------------------------------------------- Monitor


def monitor_files(folder: str | Path) -> list[Path]:
    """
    :param folder: a run's folder
    :return: its Monitor files, one per environment
    """
    return sorted(Path(folder).glob(f"*{Monitor.EXT}"))


def monitor_head(path: str | Path) -> dict[str, Any]:
    """
    :param path: a Monitor file
    :return: content of its first line: "t_start", seconds, and "env_id", None if that names no environment
    :raises BadFile: (a ``ValueError``) if it says something else, or no columns follow
    :raises OSError: if it cannot be read
    """
    with open_regular(path) as file:
        head = _head(file, path)
        _columns(file, path)
        return head


def _head(file: IO[bytes], path: str | Path) -> dict[str, Any]:
    line = file.readline(MAX_LINE)
    if not line.startswith(b"#"):
        raise BadFile(f"{path} is no file of Monitor's: its first line does not begin with #")
    head = parse_json(line[1:], f"the first line of {path}")
    start = head.get("t_start") if isinstance(head, dict) else None
    if isinstance(start, bool) or not isinstance(start, (int, float)) or not 0 <= start < 2**53:
        raise BadFile(f"{path} is no file of Monitor's: its first line has no t_start, or {start!r:.100}")
    env_id = head.get("env_id")
    if env_id is not None and not (isinstance(env_id, str) and len(env_id) < 200 and _ENV_ID.fullmatch(env_id)):
        raise BadFile(f"{path}: env_id cannot be {env_id!r:.100}")
    return {"t_start": start, "env_id": None if env_id == "None" else env_id}


def read_monitors(folder: str | Path) -> "pd.DataFrame":
    """
    The episodes of all Monitor files in a folder, as Stable-Baselines3's ``load_results`` gives them. An incomplete
    last line, of a run that was killed, is left out.

    :param folder: the run's folder
    :return: columns "r", the return, "l", the length in steps, "t", seconds since the run began, by which the episodes
        are sorted, and "is_success", if there is one. Where a Monitor of a later process has appended to a file and
        counted the seconds anew, they go on from the last ones before
    :raises LoadMonitorResultsError: if there are no such files
    :raises BadFile: (a ``ValueError``) if one is no such file
    :raises OSError: if one cannot be read
    """
    # Not above: plots need it, training does not.
    import pandas as pd

    files = monitor_files(folder)
    if not files:
        raise LoadMonitorResultsError(f"no files of the form *{Monitor.EXT} found in {folder}")
    frames, starts = [], []
    for path in files:
        frame, start = _read_monitor(path)
        frame["t"] += start
        frames.append(frame)
        starts.append(start)
    filled = [frame for frame in frames if len(frame)]
    episodes = pd.concat(filled or frames[:1]).sort_values("t", kind="stable").reset_index(drop=True)
    episodes["t"] -= min(starts)
    return episodes


def _read_monitor(path: Path) -> "tuple[pd.DataFrame, float]":
    import pandas as pd

    with open_regular(path) as file:
        head = _head(file, path)
        columns = _columns(file, path)
        _check_size(file, path)
        # In pieces: a table takes many times the bytes of its text.
        parts = [_table(columns, path)]
        while block := file.read(_BLOCK):
            block += file.readline()
            # A last line without its end is incomplete.
            parts.append(_table(columns + block[: block.rfind(b"\n") + 1], path))
    frame = pd.concat([part for part in parts if len(part)] or parts)
    if not {"r", "l", "t"} <= set(frame):
        raise BadFile(f"{path} is no file of Monitor's: it has no columns r, l and t")
    frame = frame.dropna(subset=["l", "t"])
    times, lengths = frame["t"].to_numpy(), frame["l"].to_numpy()
    if not ((lengths >= 1) & (lengths < 2**31)).all() or not (np.abs(times) < 2**53).all():
        raise BadFile(f"{path} is no file of Monitor's: an episode has no length or no time")
    # A Monitor that appends to the file (override_existing=False) counts from 0 again, and writes no second head.
    has_restarted = np.diff(times, prepend=-np.inf) < 0
    frame["t"] = times + np.cumsum(np.where(has_restarted, np.roll(times, 1), 0.0))
    return frame, head["t_start"]


def _columns(file: IO[bytes], path: str | Path) -> bytes:
    line = file.readline(MAX_LINE)
    if not line.endswith(b"\n") or line.count(b",") >= MAX_COLUMNS:
        raise BadFile(f"{path} is no file of Monitor's: its second line names no columns, or too many")
    return line


def _check_size(file: IO[bytes], path: Path) -> None:
    """Check that the rest of a file is not too large to read, and return to the present position."""
    start, fields = file.tell(), 0
    while block := file.read(_BLOCK):
        fields += block.count(b",") + block.count(b"\n")
        if file.tell() > MAX_MONITOR or fields > MAX_FIELDS:
            raise BadFile(f"{path} has more than the {MAX_MONITOR:,} bytes or {MAX_FIELDS:,} numbers that are read")
    file.seek(start)


def _table(data: bytes, path: Path) -> "pd.DataFrame":
    import pandas as pd

    try:
        frame = pd.read_csv(io.BytesIO(data), index_col=False, usecols=lambda name: name in _COLUMNS, low_memory=False)
        return frame.astype(float)
    except Exception as error:  # pandas has many errors for what is no table
        raise BadFile(f"{path} is no file of Monitor's: {type(error).__name__}: {error}") from error
