"""Replay buffers in files."""

import copy
import pickle
import resource
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from sb3_sample import CompactReplayBuffer
from tests.sac.streams import ACTIONS, BOX, SPACES, Stream, draw, pair, same_bits


@pytest.mark.parametrize("space", ["float32", "dict"])
def test_in_a_folder(space: str, tmp_path: Path) -> None:
    folder = tmp_path / "made" / "here"
    ours, theirs = pair(SPACES[space], 30, 2, memory_map=folder)
    stream = Stream(SPACES[space], 2, 0)
    for step in range(100):
        transition = stream.transition()
        ours.add(*copy.deepcopy(transition))
        theirs.add(*copy.deepcopy(transition))
        if step % 9 == 0:
            assert same_bits(draw(ours, 64, step), draw(theirs, 64, step))
    # The arrays are in files of this folder, which has nothing that would be left behind.
    assert n_mapped(folder) >= 7
    assert list(folder.iterdir()) == []
    for copied in (copy.deepcopy(ours), pickle.loads(pickle.dumps(ours))):
        before = n_mapped(folder)
        assert same_bits(draw(copied, 64, 1), draw(theirs, 64, 1))
        assert before >= 14
        transition = stream.transition()
        copied.add(*transition)
        assert same_bits(draw(ours, 64, 1), draw(theirs, 64, 1))
        del copied
    del ours
    assert n_mapped(folder) == 0


def n_mapped(folder: Path, process: int | str = "self") -> int:
    """How many mappings a process has of files in a folder."""
    return sum(str(folder) in line for line in Path(f"/proc/{process}/maps").read_text().splitlines())


@pytest.mark.slow
def test_a_killed_run_leaves_nothing(tmp_path: Path) -> None:
    """And while it lives, another may use the folder."""
    code = (
        "import sys; from tests.sac.streams import *\n"
        f"b, _ = pair(BOX, 1000, 1, memory_map={str(tmp_path)!r})\n"
        "print('ready', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"ready\n"
        assert list(tmp_path.iterdir()) == [] and n_mapped(tmp_path, other.pid) >= 7
        ours, theirs = pair(BOX, 10, 1, memory_map=tmp_path)
        stream = Stream(BOX, 1, 0)
        for _ in range(15):
            transition = stream.transition()
            ours.add(*transition)
            theirs.add(*transition)
        assert same_bits(draw(ours, 64, 1), draw(theirs, 64, 1))
        other.kill()
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_refuses(tmp_path: Path) -> None:
    """Found when the buffer is made, not by a write to it, which would kill the process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        pair(BOX, 1000, 1, memory_map=tmp_path)
        with pytest.raises(OSError, match=r"GB of a replay buffer with memory_map: '.*test_a_disk"):
            pair(BOX, 20_000, 1, memory_map=tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_disk_that_gets_full(tmp_path: Path) -> None:
    """Where every step breaks the sequence: the step that does not fit is refused, and the buffer is as before."""
    ours, theirs = pair(BOX, 2000, 1, memory_map=tmp_path)
    stream = Stream(BOX, 1, 0, ends=1.0)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    transition = stream.transition()

    def fill() -> None:
        nonlocal transition
        while True:
            ours.add(*transition)
            theirs.add(*transition)
            transition = stream.transition()

    try:
        with pytest.raises(OSError, match="GB of a replay buffer"):
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert 300 < theirs.size() == ours.size() < 1000
    assert same_bits(draw(ours, 500, 0), draw(theirs, 500, 0))
    for _ in range(2500):
        ours.add(*transition)
        theirs.add(*transition)
        transition = stream.transition()
    assert same_bits(draw(ours, 500, 0), draw(theirs, 500, 0))


def test_two_buffers_in_a_folder(tmp_path: Path) -> None:
    """Each has files of its own."""
    (first, plain), (second, _) = (pair(BOX, 10, 1, memory_map=str(tmp_path)) for _ in range(2))
    stream, other = Stream(BOX, 1, 0), Stream(BOX, 1, 1)
    for _ in range(15):
        transition = stream.transition()
        first.add(*transition)
        plain.add(*transition)
        second.add(*other.transition())
    assert same_bits(draw(first, 64, 1), draw(plain, 64, 1))


def test_folders_that_will_not_do(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for bad in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ValueError, match=r"memory_map='.*file.*' must be a folder that can be written to"):
            pair(BOX, 10, 1, memory_map=bad)
    with pytest.raises(ValueError, match=r"memory_map must be a folder, or None for the memory, not 3"):
        pair(BOX, 10, 1, memory_map=3)
    with pytest.raises(ValueError, match=r"GB free, and 36000000.* GB are needed: .*buffer_size"):
        CompactReplayBuffer(10**15, BOX, ACTIONS, memory_map=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_too_large_for_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=35_999))
    with pytest.warns(UserWarning, match=r"takes 0\.00 GB.*memory_map"):
        CompactReplayBuffer(1000, BOX, ACTIONS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        CompactReplayBuffer(999, BOX, ACTIONS)
