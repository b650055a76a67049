"""Locks of files: one process has it, and none that is gone."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_sample.saving import locks, temporary
from sb3_sample.saving.locks import take

pytest.importorskip("fcntl")

HOLDER = """
import sys
from pathlib import Path
from sb3_sample.saving.locks import take
lock = take(Path(sys.argv[1]))
print(lock is not None, flush=True)
sys.stdin.read()
"""


def test_one_has_it_and_a_killed_process_has_none(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    command = [sys.executable, "-c", HOLDER, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "True\n"
        assert take(path) is None
        other.kill()
        other.wait()
    lock = take(path)
    assert lock is not None and take(path) is None
    lock.write("who has it")
    assert path.read_text() == "who has it"
    with lock:
        pass
    lock.release()
    again = take(path)
    assert again is not None
    again.release()


def test_a_forked_process_does_not_have_it(tmp_path: Path) -> None:
    lock = take(tmp_path / "lock")
    assert lock is not None
    reading, writing = os.pipe()
    hearing, saying = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(writing)
        os.write(saying, b"here")
        os.read(reading, 1)  # as long as the parent asks
        os._exit(0)
    os.read(hearing, 4)
    lock.release()
    again = take(tmp_path / "lock")
    assert again is not None
    again.release()
    for each in (writing, reading, hearing, saying):
        os.close(each)
    os.waitpid(child, 0)


def test_a_file_that_was_removed_in_between_is_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, lock, removed = tmp_path / "lock", temporary.lock, []

    def locked(descriptor: int) -> bool | None:
        if not removed:
            path.unlink()
            removed.append(True)
        return lock(descriptor)

    monkeypatch.setattr(temporary, "lock", locked)
    first = take(path)
    assert first is not None and removed and path.exists()
    assert take(path) is None
    first.release()


def test_no_locks_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(temporary, "lock", lambda descriptor: None)
    with pytest.raises(OSError, match="has no locks"):
        locks.take(tmp_path / "lock")


def test_whether_a_lock_is_taken_is_found_by_reading(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a folder on a file system that cannot be written to, which a test as root does not get by permissions."""
    path = tmp_path / "lock"
    lock = take(path)
    assert lock is not None
    plain = os.open

    def reading(name: Path, flags: int, *args: int) -> int:
        if flags & (os.O_RDWR | os.O_WRONLY | os.O_CREAT):
            raise PermissionError(13, "Permission denied", str(name))
        return plain(name, flags, *args)

    monkeypatch.setattr(os, "open", reading)
    assert locks.is_taken(path) and not locks.is_taken(tmp_path / "none")
    lock.release()
    assert not locks.is_taken(path)
