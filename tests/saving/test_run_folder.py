"""The run's folder: whole at every moment, whatever the program or the disk does."""

import errno
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import pytest

from sb3_sample.saving import run_folder
from sb3_sample.saving.run_folder import Damaged, RunFolder, Segment
from tests.saving.hostile_folders import facts_of, rewritten


def writer(content: bytes) -> Callable[[IO[bytes]], Any]:
    return lambda file: file.write(content)


def write(folder: RunFolder, steps: int, segments: dict[str, Any] | None = None) -> dict[str, Any]:
    """A checkpoint with one more segment; what the manifest says of all that it needs."""
    segment = Segment("model", steps - 10, steps)
    known = {k: v for k, v in (segments or {}).items() if v["last"] > steps - 20}
    known[segment.path] = folder.write_segment(segment, writer(b"rows %d" % steps))
    folder.write(steps, {"model.zip": writer(b"model %d" % steps), "state.zip": writer(b"s" * 1000)}, known, {})
    return known


def contents(path: Path) -> bytes:
    return (path / "model.zip").read_bytes()


def test_the_last_two_are_kept_with_the_rows_that_they_need(tmp_path: Path) -> None:
    folder, segments = RunFolder(tmp_path / "run"), {}
    for steps in (10, 20, 30, 40):
        segments = write(folder, steps, segments)
    assert [steps for steps, _ in folder.checkpoints()] == [40, 30]
    path, manifest = folder.newest_good()  # type: ignore[misc]
    assert contents(path) == b"model 40" and manifest["steps"] == 40
    assert [(s.first, s.last) for s in folder.segments(manifest)] == [(20, 30), (30, 40)]
    assert sorted(p.name for p in (tmp_path / "run" / "replay").iterdir()) == [
        Path(Segment("model", first, first + 10).path).name for first in (10, 20, 30)
    ]


def damages() -> dict[str, Callable[[Path], Any]]:
    """What can happen to files, by name; each gets the newest checkpoint's folder."""

    def flip(path: Path) -> None:
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)

    def cut(path: Path) -> None:
        path.write_bytes(path.read_bytes()[:-1])

    def newest_rows(path: Path) -> Path:
        return max((path.parent / "replay").iterdir())

    files = ("model.zip", "state.zip", "manifest.json")
    found: dict[str, Callable[[Path], Any]] = {}
    for name in files:
        found[f"{name} flipped"] = lambda path, name=name: flip(path / name)
        found[f"{name} cut"] = lambda path, name=name: cut(path / name)
        found[f"{name} missing"] = lambda path, name=name: (path / name).unlink()
        found[f"{name} empty"] = lambda path, name=name: (path / name).write_bytes(b"")
    found["replay flipped"] = lambda path: flip(newest_rows(path))
    found["replay missing"] = lambda path: newest_rows(path).unlink()
    found["manifest is something else"] = lambda path: (path / "manifest.json").write_text("[1, 2]")
    return found


@pytest.mark.parametrize("damage", damages())
def test_damage_is_found_and_named_and_the_previous_one_used(damage: str, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    write(folder, 20, write(folder, 10))
    damages()[damage](folder.checkpoints()[0][1])
    with pytest.warns(UserWarning, match=f"{damage.split()[0]}.*(damaged|missing).*Going on from"):
        path, manifest = folder.newest_good()  # type: ignore[misc]
    assert manifest["steps"] == 10 and contents(path) == b"model 10"
    # The damaged one is out of the way, and kept.
    assert [steps for steps, _ in folder.checkpoints()] == [10]
    assert (tmp_path / "damaged-checkpoint-000000000020").is_dir()
    write(folder, 20, manifest["segments"])
    assert contents(folder.newest_good()[0]) == b"model 20"  # type: ignore[index]


def test_nothing_whole_is_an_error_and_nothing_there_is_none(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    assert folder.newest_good() is None
    write(folder, 20, write(folder, 10))
    for _, path in folder.checkpoints():
        (path / "model.zip").write_bytes(b"")
    with pytest.raises(Damaged, match=r"000010/model.zip is damaged.*Remove the folder to start anew"):
        folder.newest_good()
    assert len(folder.checkpoints()) == 2


def test_a_manifest_that_points_elsewhere(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    write(folder, 10)
    path = folder.checkpoints()[0][1] / "manifest.json"
    (tmp_path / "elsewhere").write_bytes(b"x")
    for part, name in (
        ("files", "../../elsewhere"),
        ("segments", "../elsewhere"),
        ("files", str(tmp_path / "elsewhere")),
    ):
        before = path.read_text()

        def point(manifest: Any, part: str = part, name: str = name) -> None:
            manifest[part] = {
                name: {**next(iter(manifest[part].values())), **facts_of((tmp_path / "elsewhere").read_bytes())}
            }

        rewritten(path, point)
        with pytest.raises(Damaged, match="names a file elsewhere|its files are"):
            folder.verify(path.parent)
        path.write_text(before)


def test_one_run_at_a_time(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    with pytest.raises(ValueError, match=r"checkpoint='.*' is in use: another process"):
        RunFolder(tmp_path)
    folder.close()
    RunFolder(tmp_path).close()


def killed_at(k: int, work: Callable[[], None]) -> bool:
    """Whether work in a process of its own was killed by SIGKILL at the k-th thing that it did to the disk."""
    child = os.fork()
    if child == 0:
        count = 0

        def hook(event: str, args: Any) -> None:
            nonlocal count
            if event == "open" or event.startswith(("os.", "shutil.", "fsync")):
                count += 1
                if count == k:
                    os.kill(os.getpid(), signal.SIGKILL)

        os.fsync = lambda fd: hook("fsync", fd)
        sys.addaudithook(hook)
        try:
            work()
        except BaseException:
            os._exit(1)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
    return os.WIFSIGNALED(status)


def test_killed_at_every_step_of_writing(tmp_path: Path, monkeypatch: Any) -> None:
    # What is written survives the process, if not the machine, without waiting for the disk.
    monkeypatch.setattr(os, "fsync", lambda fd: None)
    at, seen = 1, set()
    while True:
        path = tmp_path / str(at)
        folder = RunFolder(path)
        segments = write(folder, 30, write(folder, 20, write(folder, 10)))
        killed = killed_at(at, lambda folder=folder, segments=segments: write(folder, 40, segments) and None)
        folder.close()
        again = RunFolder(path)
        good, manifest = again.newest_good()  # type: ignore[misc]  # and no warning: nothing is damaged
        seen.add(manifest["steps"])
        assert contents(good) == b"model %d" % manifest["steps"]
        # It goes on, and no trace of the interruption is left.
        segments = manifest["segments"]
        for steps in (40, 50, 60) if manifest["steps"] == 30 else (50, 60):
            segments = write(again, steps, segments)
        assert sorted(p.name for p in path.iterdir()) == [
            ".lock", "checkpoint-000000000050", "checkpoint-000000000060", "replay"
        ]  # fmt: skip
        assert len(list((path / "replay").iterdir())) == 3
        if not killed:
            break
        at += 1
    assert at > 20 and seen == {30, 40}


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EFBIG, errno.EROFS, errno.EDQUOT, errno.EACCES])
@pytest.mark.parametrize("where", ["segment", "file", "rename"])
def test_what_cannot_be_written_leaves_nothing(code: int, where: str, tmp_path: Path, monkeypatch: Any) -> None:
    folder = RunFolder(tmp_path)
    segments = write(folder, 10)
    before = sorted(str(p) for p in tmp_path.rglob("*"))

    def fail(file: Any, *args: Any, **kwargs: Any) -> None:
        if where != "rename":
            file.write(b"half")
        raise OSError(code, os.strerror(code), "the file")

    def attempt() -> None:
        if where == "segment":
            folder.write_segment(Segment("model", 10, 20), fail)
        files = {"model.zip": writer(b"m"), "state.zip": fail if where == "file" else writer(b"s")}
        folder.write(20, files, segments, {})

    with monkeypatch.context() as patch:
        if where == "rename":
            patch.setattr(os, "rename", fail)
        with pytest.raises(OSError, match=os.strerror(code)):
            attempt()
    assert sorted(str(p) for p in tmp_path.rglob("*")) == before
    write(folder, 20, segments)
    assert folder.newest_good()[1]["steps"] == 20  # type: ignore[index]


def test_what_is_read_back_otherwise_is_no_checkpoint(tmp_path: Path, monkeypatch: Any) -> None:
    folder = RunFolder(tmp_path)
    segments = write(folder, 10)
    checksum, n_read = run_folder._checksum, [0]

    def other_the_second_time(file: Any) -> str:
        n_read[0] += Path(file.name).name == "state.zip"
        return checksum(file) if n_read[0] != 2 else "other"

    with monkeypatch.context() as patch:
        patch.setattr(run_folder, "_checksum", other_the_second_time)
        with pytest.raises(OSError, match="what was written is not what is read"):
            folder.write(20, {"model.zip": writer(b"m"), "state.zip": writer(b"s")}, segments, {})
    assert folder.newest_good()[1]["steps"] == 10  # type: ignore[index]
