"""
The folder of a run on disk: complete checkpoints, each in a folder of its own, and the rows of replay buffers that they
share.

Nothing that is complete is ever written to again. A checkpoint is made in a hidden folder and renamed when all of it is
on the disk; the rows are files that are renamed in the same way, and that a checkpoint names with their checksums. The
program may be killed at any moment: what a checkpoint's ``manifest.json`` names is there.
"""

import contextlib
import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sb3_sample.saving.container import sync_folder

MANIFEST = "manifest.json"
SEGMENTS = "replay"
_LOCK = ".lock"
_WRITING = ".writing"
_REMOVED = ".removed"
_CHECKPOINT = re.compile(r"checkpoint-(\d{12,})")
#: Complete checkpoints that are kept.
KEPT = 2


class Damaged(ValueError):
    """A checkpoint that is not what was written."""


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
    def path(self) -> str:
        """Path in the run's folder."""
        return f"{SEGMENTS}/{self.ring}-{self.first:012d}-{self.last:012d}.zip"


class RunFolder:
    """
    A folder that one run has for itself.

    :param path: the folder; it is made if it is not there
    :raises OSError: it cannot be made or written to
    :raises ValueError: another process has it, or it is a file
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"checkpoint must name a folder, but {self.path} is a file")
        (self.path / SEGMENTS).mkdir(parents=True, exist_ok=True)
        self._lock: int | None = self._take_lock()
        for left in (_WRITING, _REMOVED):
            shutil.rmtree(self.path / left, ignore_errors=True)

    def _take_lock(self) -> int | None:
        try:
            import fcntl
        except ImportError:  # not on Windows
            return None
        lock = os.open(self.path / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(lock)
            raise ValueError(
                f"checkpoint={str(self.path)!r} is in use: another process trains in this folder"
            ) from error
        except OSError:  # a file system without locks
            os.close(lock)
            return None
        return lock

    def close(self) -> None:
        """Let others have the folder."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    # ---------------------------------------------------------------- reading

    def checkpoints(self) -> list[tuple[int, Path]]:
        """
        :return: steps and folder of each checkpoint, the newest first, looked at from outside only
        """
        found = [(int(m[1]), path) for path in self.path.iterdir() if (m := _CHECKPOINT.fullmatch(path.name))]
        return sorted(found, reverse=True)

    def newest_good(self) -> tuple[Path, dict[str, Any]] | None:
        """
        :return: the newest checkpoint that is as it was written, and its manifest; None if the folder has none at all
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
                warnings.warn(f"{'; '.join(reasons)}. Going on from {path} instead.", stacklevel=3)
                self._put_aside(path)
            return path, manifest
        if reasons:
            raise Damaged(
                f"checkpoint={str(self.path)!r} has no checkpoint that is whole: {'; '.join(reasons)}. Remove the "
                "folder to start anew."
            )
        return None

    def _put_aside(self, good: Path) -> None:
        """Damaged checkpoints that are newer get another name, so that theirs is free."""
        for _, path in self.checkpoints():
            if path == good:
                return
            aside = path.with_name(f"damaged-{path.name}")
            shutil.rmtree(aside, ignore_errors=True)
            path.rename(aside)

    def verify(self, path: Path) -> dict[str, Any]:
        """
        :param path: folder of a checkpoint
        :return: its manifest
        :raises Damaged: a file is missing or not as it was written; the message names it
        """
        manifest = _read_manifest(path / MANIFEST)
        for root, part in ((path, "files"), (self.path, "segments")):
            for name, facts in manifest[part].items():
                if name != (Path(name).name if part == "files" else Segment(*_place(facts)).path):
                    raise Damaged(f"{path / MANIFEST} names a file elsewhere: {name}")
                _verify_file(root / name, facts)
        return manifest

    @staticmethod
    def segments(manifest: dict[str, Any]) -> list[Segment]:
        """
        :param manifest: of a checkpoint
        :return: the rows that it needs, oldest first
        """
        return [Segment(*_place(facts)) for facts in manifest["segments"].values()]

    # ---------------------------------------------------------------- writing

    def write_segment(self, segment: Segment, write: Callable[[Path], None]) -> dict[str, Any]:
        """
        Write rows, if they are not there yet.

        :param segment: which rows
        :param write: writes them to a path
        :return: what the manifest says of the file
        :raises OSError: they cannot be written
        """
        path = self.path / segment.path
        hidden = path.with_name(f".{path.name}")
        try:
            write(hidden)
            facts = _facts(hidden)
            os.replace(hidden, path)
        except BaseException:
            with contextlib.suppress(OSError):
                hidden.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)
        _verify_file(path, facts)
        return {"ring": segment.ring, "first": segment.first, "last": segment.last, **facts}

    def remove_segments(self, names: Iterable[str]) -> None:
        """
        :param names: paths, in the run's folder, of rows whose checkpoint was not written
        """
        for name in names:
            with contextlib.suppress(OSError):
                (self.path / name).unlink(missing_ok=True)

    def write(
        self, steps: int, files: dict[str, Callable[[Path], None]], segments: dict[str, Any], about: dict[str, Any]
    ) -> Path:
        """
        Write a checkpoint, and remove what is not needed any more when it is whole.

        :param steps: environment steps, by which it is named
        :param files: by name, what writes it to a path
        :param segments: the rows that it needs, by their path in the run's folder, with what :meth:`write_segment` said
        :param about: what else the manifest says
        :return: the checkpoint's folder
        :raises OSError: it cannot be written; nothing of it is left
        """
        target, hidden = self.path / f"checkpoint-{steps:012d}", self.path / _WRITING
        shutil.rmtree(hidden, ignore_errors=True)
        try:
            hidden.mkdir()
            for name, write in files.items():
                write(hidden / name)
            facts = {name: _facts(hidden / name) for name in files}
            _write_manifest(hidden / MANIFEST, {"steps": steps, **about, "files": facts, "segments": segments})
            sync_folder(hidden)
            if target.exists():
                self._remove(target)
            os.rename(hidden, target)
            sync_folder(self.path)
        except BaseException:
            shutil.rmtree(hidden, ignore_errors=True)
            raise
        try:
            # The rows that were there before were verified when they were new.
            for name in files:
                _verify_file(target / name, facts[name])
            _read_manifest(target / MANIFEST)
        except Damaged as error:
            self._remove(target)
            raise OSError(f"what was written is not what is read: {error}") from error
        self._prune(steps)
        return target

    def _remove(self, path: Path) -> None:
        """Remove a checkpoint, which is whole or not there at every moment."""
        hidden = self.path / _REMOVED
        shutil.rmtree(hidden, ignore_errors=True)
        os.rename(path, hidden)
        shutil.rmtree(hidden, ignore_errors=True)

    def _prune(self, steps: int) -> None:
        """Remove all but the newest checkpoints up to that of ``steps``, and rows that no checkpoint needs."""
        found = [path for there, path in self.checkpoints() if there <= steps]
        for path in found[KEPT:]:
            self._remove(path)
        needed: set[str] = set()
        for _, path in self.checkpoints():
            # One that cannot be read is not worth rows: they would be found to be missing anyway.
            with contextlib.suppress(Damaged, OSError):
                needed |= _read_manifest(path / MANIFEST)["segments"].keys()
        for file in (self.path / SEGMENTS).iterdir():
            if f"{SEGMENTS}/{file.name}" not in needed:
                file.unlink(missing_ok=True)


def _place(facts: dict[str, Any]) -> tuple[str, int, int]:
    ring = str(facts.get("ring"))
    # What follows is a name of a file, and nothing else.
    return ring if ring.isidentifier() else "?", int(facts.get("first", -1)), int(facts.get("last", -1))


def _facts(path: Path) -> dict[str, Any]:
    """Size and checksum of a file, which is on the disk when this returns."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
    return {"size": path.stat().st_size, "sha256": _checksum(path)}


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        digest = hashlib.sha256()
        for block in _blocks(file):
            digest.update(block)
    return digest.hexdigest()


def _blocks(file: Any, size: int = 2**20) -> Iterator[bytes]:
    while block := file.read(size):
        yield block


def _verify_file(path: Path, facts: dict[str, Any]) -> None:
    if not path.is_file():
        raise Damaged(f"{path} is missing")
    size = path.stat().st_size
    if size != facts["size"]:
        raise Damaged(f"{path} is damaged: it has {size} bytes instead of {facts['size']}")
    if _checksum(path) != facts["sha256"]:
        raise Damaged(f"{path} is damaged: its checksum is not that of what was written")


def _write_manifest(path: Path, manifest: dict[str, Any]) -> None:
    body = json.dumps(manifest, indent=1)
    digest = hashlib.sha256(body.encode()).hexdigest()
    with path.open("w", encoding="utf-8") as file:
        file.write(f'{body[:-2]},\n "sha256": "{digest}"\n}}')
        file.flush()
        os.fsync(file.fileno())


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        digest = manifest.pop("sha256")
        whole = hashlib.sha256(json.dumps(manifest, indent=1).encode()).hexdigest() == digest
    except FileNotFoundError as error:
        raise Damaged(f"{path} is missing") from error
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise Damaged(f"{path} is damaged: {error}") from error
    if not whole or not {"files", "segments", "steps"} <= manifest.keys():
        raise Damaged(f"{path} is damaged: its checksum is not that of what was written")
    return manifest
