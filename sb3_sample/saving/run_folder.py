"""
The folder of a run on disk: complete checkpoints, each in its own folder, and the rows of replay buffers that they
share.

A complete file is never written to again. A checkpoint is made in a hidden folder and renamed when all of it is on the
disk and has been read back; files of rows are renamed in the same way, and a checkpoint names them with their
checksums. Whenever the program is killed, every file that a checkpoint's ``manifest.json`` names is there. Once
renamed, a checkpoint counts, whatever fails afterwards.

A folder may come from somebody else, and may hold files of the user's: see :mod:`sb3_sample.saving.folders`, and
:meth:`RunFolder._check`.
"""

import contextlib
import hashlib
import json
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

from sb3_sample.saving import temporary
from sb3_sample.saving.container import is_sha256, sync_folder
from sb3_sample.saving.folders import Folder
from sb3_sample.saving.locks import Lock
from sb3_sample.warn import warn

MODEL, STATE, MANIFEST = "model.zip", "state.zip", "manifest.json"
SEGMENTS, LOG = "replay", "progress.jsonl"
_LOCK, _LEFT, _WRITING, _REMOVED = ".lock", ".left", ".writing", ".removed"
_CHECKPOINT = re.compile(r"checkpoint-(\d{12,})")
#: Folders that will be renamed when complete, or were renamed to be removed. Their number is drawn anew each time, so
#: that a folder that cannot be removed is not in the way.
_HIDDEN = re.compile(rf"({re.escape(_WRITING)}|{re.escape(_REMOVED)})-[0-9a-f]{{12}}")
_SEGMENT = re.compile(r"[^\W\d]\w*-\d{12,}-\d{12,}\.zip")
#: Files that will be renamed when complete.
_HIDDEN_FILE = re.compile(rf"\.({_SEGMENT.pattern}|{re.escape(LOG)}|{re.escape(_LOCK)})\.[0-9a-f]{{12}}")
#: Names used here, which must not be links; and names that only a run of ours may give to a file or folder that is not
#: empty.
_USED = re.compile(
    rf"{SEGMENTS}|{re.escape(LOG)}|{re.escape(_LOCK)}|{re.escape(_LEFT)}|{_CHECKPOINT.pattern}|{_HIDDEN.pattern}"
)
_CLAIMED = re.compile(
    rf"{SEGMENTS}|{re.escape(LOG)}|{re.escape(_LOCK)}|checkpoint-.*|({re.escape(_WRITING)}|{re.escape(_REMOVED)})(-.*)?",
    re.DOTALL,
)
#: Content of the first file of a run, which identifies its folder before it has a checkpoint.
_MARK = b"The folder of one run of sb3_sample, made by learn(checkpoint=...). See docs/saving.md.\n"
#: Complete checkpoints that are kept.
KEPT = 2
#: Largest number of pieces for the rows of one buffer.
MAX_SEGMENTS = 10_000
#: Largest size of a manifest in bytes, of which a piece of rows takes about 250; and smallest number of bytes for each
#: value in it, as Python objects take more.
MAX_MANIFEST, MIN_BYTES_PER_VALUE = 8 * 2**20, 24
#: Largest number of reasons that a message names.
_SHOWN = 3


class Damaged(ValueError):
    """A checkpoint that is not as it was written."""


class Segment(NamedTuple):
    """
    Rows of a replay buffer in a file.

    :param ring: name of the buffer
    :param first: first row
    :param last: last row, exclusive
    """

    ring: str
    first: int
    last: int

    @property
    def name(self) -> str:
        """Name of the file."""
        return f"{self.ring}-{self.first:012d}-{self.last:012d}.zip"

    @property
    def path(self) -> str:
        """Path in the run's folder."""
        return f"{SEGMENTS}/{self.name}"


class RunFolder:
    """
    A folder that one run has for itself.

    :param path: the folder; it is made if it is not there
    :raises OSError: it cannot be made or written to
    :raises ValueError: another process uses it, it is a file, or its content belongs to no run of ours
    """

    def __init__(self, path: str | Path):
        # Absolute, since the program may change its working directory during the training.
        self.path = Path(os.path.abspath(path))
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"checkpoint must name a folder, but {self.path} is a file")
        self.path.mkdir(parents=True, exist_ok=True)
        #: Returns the folders of runs that resume from the same step as this one, so that a checkpoint is kept until
        #: all of them have a newer one.
        self.beside: Callable[[], Sequence[Path]] = tuple
        #: Warnings given.
        self._told: set[str] = set()
        self._lock: Lock | None = None
        with Folder.at(self.path) as root:
            self._check(root)
            self._lock = self._take_lock(root)
            try:
                if root.look(SEGMENTS) is None:
                    root.make(SEGMENTS)
                    sync_folder(self.path)
                self._clear(root)
            except BaseException:
                self.close()
                raise

    def _check(self, root: Folder) -> None:
        """
        :raises ValueError: the folder has an entry with a name that runs write to, and is the folder of no run of ours;
            or an entry with such a name is a link
        """
        ours = _is_ours(root)
        for name in root.names():
            if _USED.fullmatch(name) and root.is_link(name):
                raise ValueError(
                    f"checkpoint={str(self.path)!r}: {name} is a link, and a run follows none in its folder (the "
                    "folder itself may be one). Nothing was changed."
                )
            if not ours and _CLAIMED.fullmatch(name) and not _is_empty(root, name):
                raise ValueError(
                    f"checkpoint={str(self.path)!r} holds {name}, which is of no run of sb3_sample and would be "
                    "overwritten: name another folder. Nothing was changed."
                )

    def _take_lock(self, root: Folder) -> Lock | None:
        root.separate(_LOCK)
        lock = root.descriptor(_LOCK, os.O_RDWR | os.O_CREAT)
        try:
            held = temporary.lock(lock)
            if held is False:
                raise ValueError(f"checkpoint={str(self.path)!r} is in use: another process trains in this folder")
            # A run writes its mark first, before any file whose origin could be in question.
            said = os.pread(lock, len(_MARK) + 1, 0) if hasattr(os, "pread") else _MARK
            if said != _MARK and _MARK.startswith(said):
                os.ftruncate(lock, 0)
                os.write(lock, _MARK)
                os.fsync(lock)
        except BaseException:
            os.close(lock)
            raise
        if not held:
            os.close(lock)
            return None
        return Lock(lock)

    def close(self) -> None:
        """Release the folder for others."""
        lock, self._lock = self._lock, None
        if lock is not None:
            lock.release()

    def set_left(self, left: bool) -> None:
        """
        Record whether the run has ended before those made together with it, so that these continue without it.

        :param left: whether it has
        """
        # Without the record they go back to a checkpoint that all have.
        with contextlib.suppress(OSError), Folder.at(self.path) as root:
            if left:
                os.close(root.descriptor(_LEFT, os.O_WRONLY | os.O_CREAT))
            elif root.look(_LEFT) is not None:
                root.remove(_LEFT)

    def _warn(self, message: str) -> None:
        """Warn once: the same problem is found again at each checkpoint."""
        if message not in self._told:
            self._told.add(message)
            warn(f"{message}. Nothing of the run is lost by it.")

    # ---------------------------------------------------------------- reading

    def checkpoints(self) -> list[tuple[int, Path]]:
        """
        :return: steps and folder of each checkpoint, the newest first; the checkpoints are not opened
        """
        return _paths(self.path)

    def newest_good(self) -> tuple[Path, dict[str, Any]] | None:
        """
        :return: the newest checkpoint that is as it was written, and its manifest; None if the folder has no checkpoint
        :raises Damaged: it has checkpoints, and all of them are damaged
        """
        reasons = []
        for _, path in self.checkpoints():
            try:
                manifest = self.verify(path)
            except (Damaged, OSError) as error:
                reasons.append(str(error))
                continue
            if reasons:
                warn(f"{_some(reasons)}. Going on from {path} instead.")
                self._put_damaged_aside(path)
            return path, manifest
        if reasons:
            raise Damaged(
                f"checkpoint={str(self.path)!r} has no checkpoint that is whole: {_some(reasons)}. Remove the "
                "folder to start anew."
            )
        return None

    def _put_damaged_aside(self, good: Path) -> None:
        """Rename damaged checkpoints that are newer than a good one, so that their names are free."""
        with Folder.at(self.path) as root:
            for _, name in _checkpoints(root):
                if name == good.name:
                    return
                try:
                    _put_aside(root, name)
                except OSError as error:
                    self._warn(f"{self.path / name} is damaged and cannot be renamed ({error})")

    def manifest_of(self, path: Path) -> dict[str, Any]:
        """
        :param path: folder of a checkpoint that was found to be whole
        :return: its manifest
        :raises Damaged: it is no longer whole
        :raises OSError: it cannot be read
        """
        with Folder.at(self.path) as root, root.inside(path.name) as folder:
            return _read_manifest(folder)

    def go_back_to(self, steps: int) -> None:
        """
        Remove checkpoints that are newer than the one from which the run resumes: it will reach their steps again.

        :param steps: environment steps of the one from which it resumes
        :raises OSError: one cannot be removed
        """
        with Folder.at(self.path) as root:
            for there, name in _checkpoints(root):
                if there > steps:
                    self._remove(root, name)

    @staticmethod
    def verify(path: Path) -> dict[str, Any]:
        """
        :param path: folder of a checkpoint, inside its run's folder
        :return: its manifest
        :raises Damaged: a file is missing or not as it was written; the message names it
        :raises OSError: it cannot be read
        """
        with Folder.at(path.parent) as root, root.inside(path.name) as folder:
            manifest = _read_manifest(folder)
            for name, facts in manifest["files"].items():
                _verify_file(folder, name, facts)
            if manifest["segments"]:
                segments = RunFolder.segments(manifest)
                with root.inside(SEGMENTS) as rows:
                    for segment, facts in zip(segments, manifest["segments"].values(), strict=True):
                        _verify_file(rows, segment.name, facts)
        return manifest

    @staticmethod
    def segments(manifest: dict[str, Any]) -> list[Segment]:
        """
        :param manifest: of a checkpoint
        :return: the rows that it needs, oldest first
        """
        return [Segment(facts["ring"], facts["first"], facts["last"]) for facts in manifest["segments"].values()]

    @contextlib.contextmanager
    def opened(self, path: str) -> Iterator[IO[bytes]]:
        """
        :param path: of a file in a folder of the run's folder
        :return: the file, open for reading, and closed afterwards
        :raises OSError: it cannot be read, or is no regular file
        """
        parent, name = path.split("/")
        with Folder.at(self.path) as root, root.inside(parent) as folder, folder.read(name) as file:
            yield file

    # ---------------------------------------------------------------- writing

    def write_segment(self, segment: Segment, write: Callable[[IO[bytes]], Any]) -> dict[str, Any]:
        """
        Write rows.

        :param segment: which rows
        :param write: writes them to a file
        :return: the manifest's entry for the file
        :raises OSError: they cannot be written
        """
        hidden = f".{segment.name}.{secrets.token_hex(6)}"
        with Folder.at(self.path) as root, root.inside(SEGMENTS) as rows:
            try:
                facts = _write_file(rows, hidden, write)
                self._rename(rows, hidden, segment.name)
            except BaseException:
                with contextlib.suppress(OSError):
                    rows.remove(hidden)
                raise
            sync_folder(rows.path)
        return {"ring": segment.ring, "first": segment.first, "last": segment.last, **facts}

    def remove_segments(self, paths: Iterable[str]) -> None:
        """
        :param paths: paths in the run's folder, of rows whose checkpoint was not written. Rows that a checkpoint names
            nevertheless stay
        """
        with contextlib.suppress(OSError), Folder.at(self.path) as root, root.inside(SEGMENTS) as rows:
            for path in set(paths) - _needed(root).keys():
                with contextlib.suppress(OSError):
                    rows.remove(path.removeprefix(f"{SEGMENTS}/"))

    def write(
        self, steps: int, files: dict[str, Callable[[IO[bytes]], Any]], segments: dict[str, Any], about: dict[str, Any]
    ) -> Path:
        """
        Write a checkpoint and, once it is whole, remove files that are no longer needed. Files that cannot be removed
        are named in a warning.

        :param steps: environment steps, by which it is named
        :param files: functions that write the files, by name
        :param segments: the rows that it needs, by their path in the run's folder, with their entries from
            :meth:`write_segment`
        :param about: further entries of the manifest
        :return: the checkpoint's folder
        :raises OSError: it cannot be written; nothing of it is left
        """
        name, hidden = f"checkpoint-{steps:012d}", f"{_WRITING}-{secrets.token_hex(6)}"
        with Folder.at(self.path) as root:
            try:
                root.make(hidden)
                with root.inside(hidden) as folder:
                    facts = {file: _write_file(folder, file, write) for file, write in files.items()}
                    text = _manifest_text({"steps": steps, **about, "files": facts, "segments": segments})
                    _write_file(folder, MANIFEST, lambda file: file.write(text))
                    sync_folder(folder.path)
                self._rename(root, hidden, name)
            except BaseException:
                with contextlib.suppress(OSError):
                    _empty(root, hidden)
                raise
            # From here on the checkpoint counts.
            try:
                sync_folder(self.path)
                self._prune(root, steps)
            except OSError as error:
                self._warn(f"{self.path} cannot be tidied up ({error})")
        return self.path / name

    def _rename(self, folder: Folder, hidden: str, name: str) -> None:
        """
        Give a complete file or folder its name. A file of that name, left by a program that was killed, is replaced;
        anything else of that name may hold files of the user's, and is renamed.

        :raises OSError: it, or an entry in its way, cannot be renamed
        """
        found = folder.look(name)
        if found is not None and not (_SEGMENT.fullmatch(name) and stat.S_ISREG(found.st_mode)):
            aside = _put_aside(folder, name)
            self._warn(f"{folder.path / name} was in the way of what a checkpoint writes, and is {aside} now")
        folder.rename(hidden, name)

    def _remove(self, root: Folder, name: str) -> None:
        """
        Remove a checkpoint, which at every moment is whole or gone. Files in it that are not ours stay in the renamed
        folder.
        """
        hidden = f"{_REMOVED}-{secrets.token_hex(6)}"
        root.rename(name, hidden)
        self._clear_one(root, hidden, name)

    def _clear_one(self, root: Folder, hidden: str, name: str) -> None:
        try:
            _empty(root, hidden)
        except OSError as error:
            self._warn(f"{self.path / hidden}, the rest of {name}, cannot be removed ({error})")

    def _clear(self, root: Folder) -> None:
        """Remove incomplete files and folders left by a program that was killed."""
        for name in root.names():
            if _HIDDEN.fullmatch(name):
                self._clear_one(root, name, "a checkpoint")
        with root.inside(SEGMENTS) as rows:
            for folder in (root, rows):
                for name in filter(_HIDDEN_FILE.fullmatch, folder.names()):
                    self._remove_file(folder, name)

    def _prune(self, root: Folder, steps: int) -> None:
        """
        Of the checkpoints up to that of ``steps``, keep only the newest and those from which the runs beside this one
        may resume; remove rows that no checkpoint needs.
        """
        made = _checkpoints(root)
        kept = [name for there, name in made if there <= steps][:KEPT]
        if others := [{there for there, _ in _paths(folder)} for folder in self.beside()]:
            common = max((there for there, _ in made if all(there in theirs for theirs in others)), default=0)
            kept += [name for there, name in made if there >= common]
        for name in [name for there, name in made if there <= steps and name not in kept]:
            try:
                self._remove(root, name)
            except OSError as error:
                self._warn(f"{self.path / name} cannot be removed ({error})")
        needed = _needed(root)
        with root.inside(SEGMENTS) as rows:
            for name in rows.names():
                if _SEGMENT.fullmatch(name) and f"{SEGMENTS}/{name}" not in needed:
                    self._remove_file(rows, name)

    def _remove_file(self, folder: Folder, name: str) -> None:
        try:
            folder.remove(name)
        except OSError as error:
            self._warn(f"{folder.path / name} cannot be removed ({error})")


class Starts(NamedTuple):
    """
    Where runs that are made together resume.

    :param steps: environment steps of the checkpoints; 0 if there is none
    :param paths: folder of each run's checkpoint, by the run's folder
    """

    steps: int
    paths: dict[Path, Path]


def common_starts(folders: Iterable[Path]) -> Starts:
    """
    Find where runs that are made together resume: at the newest step of which every run has a whole checkpoint. As long
    as they are made together, there is such a step (:attr:`RunFolder.beside`). A run that has left the others
    (:meth:`RunFolder.set_left`) no longer counts among them, unless it stands where they resume; nor does the one that
    is behind if there is no such step. If all have left, those that have come furthest resume together.

    :param folders: folders of the runs
    :return: where they resume, without runs that have no checkpoint or have left the others
    """
    there = {folder: dict(_paths(folder)) for folder in folders}
    there = {folder: made for folder, made in there.items() if made}
    left = {folder: made for folder, made in there.items() if (folder / _LEFT).exists()}
    furthest = max((max(made) for made in there.values()), default=0)
    if len(left) == len(there):
        left = {folder: made for folder, made in left.items() if max(made) < furthest}
    there = {folder: made for folder, made in there.items() if folder not in left}
    reasons = []
    while there:
        for steps in sorted(set.intersection(*map(set, there.values())), reverse=True):
            try:
                for made in there.values():
                    RunFolder.verify(made[steps])
            except (Damaged, OSError) as error:
                reasons.append(str(error))
                continue
            if reasons:
                warn(f"{_some(reasons)}. The runs go on from {steps} steps instead.")
            for folder, made in left.items():
                with contextlib.suppress(Damaged, OSError):
                    if max(made) == steps:
                        RunFolder.verify(made[steps])
                        there[folder] = made
            return Starts(steps, {folder: made[steps] for folder, made in there.items()})
        del there[min(there, key=lambda folder: max(there[folder]))]
    return Starts(0, {})


def _paths(folder: Path) -> list[tuple[int, Path]]:
    """Steps and folder of each checkpoint of a run, the newest first; empty if the folder is not there."""
    if not folder.is_dir():
        return []
    with Folder.at(folder) as root:
        return [(steps, folder / name) for steps, name in _checkpoints(root)]


def _some(reasons: list[str]) -> str:
    more = f"; and {len(reasons) - _SHOWN} more" if len(reasons) > _SHOWN else ""
    return "; ".join(reasons[:_SHOWN]) + more


def _is_ours(root: Folder) -> bool:
    """Whether a folder belongs to a run of ours: it has our mark, or a checkpoint, as a partial copy may."""
    with contextlib.suppress(OSError), root.read(_LOCK) as file:
        if file.read(len(_MARK) + 1) == _MARK:
            return True
    for _, name in _checkpoints(root):
        with contextlib.suppress(OSError, Damaged), root.inside(name) as folder:
            _read_manifest(folder)
            return True
    return False


def _is_empty(root: Folder, name: str) -> bool:
    found = root.look(name)
    if found is None:
        return True
    if stat.S_ISDIR(found.st_mode):
        with root.inside(name) as folder:
            return not folder.names()
    if not stat.S_ISREG(found.st_mode):
        return False
    if name == _LOCK and found.st_size < len(_MARK):
        # Left by a run that was killed, or whose disk was full, during its first write.
        with root.read(name) as file:
            return _MARK.startswith(file.read())
    return found.st_size == 0


def _checkpoints(root: Folder) -> list[tuple[int, str]]:
    """Steps and names of the entries that are named like a checkpoint, the newest first."""
    found = [(int(m[1]), name) for name in root.names() if (m := _CHECKPOINT.fullmatch(name))]
    return sorted(found, reverse=True)


def _needed(root: Folder) -> dict[str, Any]:
    """
    Rows that the checkpoints need according to their manifests. A damaged one needs none: its rows would count as
    missing.

    :raises OSError: a manifest is there and cannot be read at present
    """
    needed: dict[str, Any] = {}
    for _, name in _checkpoints(root):
        with contextlib.suppress(Damaged), root.inside(name) as folder:
            needed.update(_read_manifest(folder)["segments"])
    return needed


def _put_aside(folder: Folder, name: str) -> str:
    """
    Rename, but keep, an entry that is not as a run wrote it.

    :return: its new name
    :raises OSError: it cannot be renamed
    """
    aside = f"damaged-{name}"
    if folder.look(aside) is not None:
        aside = f"{aside}-{secrets.token_hex(6)}"
    folder.rename(name, aside)
    return aside


def _empty(root: Folder, name: str) -> None:
    """Remove a folder and the files of a checkpoint in it."""
    with root.inside(name) as folder:
        for file in (MANIFEST, STATE, MODEL):
            folder.remove(file)
    root.remove_folder(name)


def _write_file(folder: Folder, name: str, write: Callable[[IO[bytes]], Any]) -> dict[str, Any]:
    """
    Write a file and read it back.

    :return: its size and checksum; the file is on the disk when this returns
    """
    with folder.create(name) as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
    facts = _facts(folder, name)
    try:
        _verify_file(folder, name, facts)
    except Damaged as error:
        raise OSError(f"what was written is not what is read: {error}") from error
    return facts


def _facts(folder: Folder, name: str) -> dict[str, Any]:
    with folder.read(name) as file:
        return {"size": os.fstat(file.fileno()).st_size, "sha256": _checksum(file)}


def _checksum(file: IO[bytes]) -> str:
    digest = hashlib.sha256()
    while block := file.read(2**20):
        digest.update(block)
    return digest.hexdigest()


def _verify_file(folder: Folder, name: str, facts: dict[str, Any]) -> None:
    path = folder.path / name
    try:
        with folder.read(name) as file:
            size = os.fstat(file.fileno()).st_size
            if size != facts["size"]:
                raise Damaged(f"{path} is damaged: it has {size} bytes instead of {facts['size']}")
            if _checksum(file) != facts["sha256"]:
                raise Damaged(f"{path} is damaged: its checksum is not that of what was written")
    except FileNotFoundError as error:
        raise Damaged(f"{path} is missing") from error


# ---------------------------------------------------------------- manifests


def _manifest_text(manifest: dict[str, Any]) -> bytes:
    """A manifest with the checksum of the rest of it."""
    body = json.dumps(manifest, indent=1)
    digest = hashlib.sha256(body.encode()).hexdigest()
    return f'{body[:-2]},\n "sha256": "{digest}"\n}}'.encode()


def _read_manifest(folder: Folder) -> dict[str, Any]:
    """
    :param folder: of a checkpoint
    :return: its manifest, all of whose entries are of the right kind
    :raises Damaged: it is missing or damaged
    :raises OSError: it cannot be read
    """
    path = folder.path / MANIFEST
    try:
        with folder.read(MANIFEST) as file:
            data = file.read(MAX_MANIFEST + 1)
    except FileNotFoundError as error:
        raise Damaged(f"{path} is missing") from error
    body, _, rest = data.rpartition(b',\n "sha256": "')
    whole = body + b"\n}"
    if rest != hashlib.sha256(whole).hexdigest().encode() + b'"\n}':
        raise Damaged(f"{path} is damaged: its checksum is not that of what was written")
    if len(data) > MAX_MANIFEST or sum(map(whole.count, (b",", b"[", b"{"))) > 100 + len(whole) // MIN_BYTES_PER_VALUE:
        raise Damaged(f"{path} is damaged: it holds more than a checkpoint has to say")
    try:
        manifest = json.loads(whole)
    except (ValueError, RecursionError) as error:
        raise Damaged(f"{path} is damaged: {error!s:.200}") from error
    wrong = _wrong_with(manifest)
    if wrong:
        raise Damaged(f"{path} is damaged: {wrong:.300}")
    return manifest


def _wrong_with(manifest: Any) -> str | None:
    if not isinstance(manifest, dict):
        return "it is no object"
    for part in ("circumstances", "files", "segments"):
        if not isinstance(manifest.setdefault(part, {}), dict):
            return f"it does not say its {part}"
    if not _is_count(manifest.get("steps")):
        return f"its steps are {manifest.get('steps')!r:.50}"
    if not all(isinstance(value, str) for value in manifest["circumstances"].values()):
        return "its circumstances are no words"
    if manifest["files"].keys() != {MODEL, STATE}:
        return f"its files are {sorted(manifest['files'])!r:.200}, not {MODEL} and {STATE}"
    for name, facts in (*manifest["files"].items(), *manifest["segments"].items()):
        if not isinstance(facts, dict) or not _is_count(facts.get("size")) or not is_sha256(facts.get("sha256")):
            return f"it does not say size and checksum of {name!r:.100}"
    for name, facts in manifest["segments"].items():
        ring, first, last = facts.get("ring"), facts.get("first"), facts.get("last")
        if not (
            _is_count(first) and _is_count(last) and first < last and isinstance(ring, str) and ring.isidentifier()
        ):
            return f"it does not say which rows are in {name!r:.100}"
        if name != Segment(ring, first, last).path:
            return f"it names a file elsewhere: {name!r:.200}"
    return None


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**63
