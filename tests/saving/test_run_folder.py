"""The run's folder: whole at every moment, whatever the program or the disk does."""

import errno
import multiprocessing
import os
import re
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import pytest

from sb3_sample.saving import run_folder
from sb3_sample.saving.folders import Folder
from sb3_sample.saving.progress import ProgressFile
from sb3_sample.saving.run_folder import Damaged, RunFolder, Segment
from tests.saving.hostile_folders import KINDS, facts_of, put, rewritten, snapshot, user_files


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


# ---------------------------------------------------------------- whose folder it is

#: Something of the user's with a name that a run writes to: a path in the folder.
OF_THE_USER = (
    "replay/a", "replay/.hidden", "replay/model-000000000000-000000000010.zip", "progress.jsonl", ".lock",
    "checkpoint-000000000010/model.zip", "checkpoint-500/weights", "checkpoint-best", ".writing/a", ".removed/a",
    ".writing-0123456789ab/a", "checkpoint-000000000010/manifest.json",
)  # fmt: skip


def entries(folder: Path) -> dict[str, Any]:
    return {
        str(path.relative_to(folder)): (path.lstat().st_mtime_ns, path.read_bytes() if path.is_file() else None)
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize("name", OF_THE_USER)
def test_what_is_of_the_user_is_refused_and_not_touched(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("the user's")
    before = entries(tmp_path)
    with pytest.raises(ValueError, match=rf"holds {re.escape(name.split('/')[0])}, which is of no run.*Nothing was ch"):
        RunFolder(tmp_path)
    assert entries(tmp_path) == before


def test_a_link_is_not_empty(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoint-latest").symlink_to(tmp_path)
    with pytest.raises(ValueError, match="holds checkpoint-latest"):
        RunFolder(tmp_path / "run")


def test_what_is_empty_and_what_has_other_names_may_be_there(tmp_path: Path) -> None:
    for name in ("replay", ".writing", ".removed", "checkpoint-000000000010", "checkpoint-x"):
        (tmp_path / name).mkdir()
    for name in ("progress.jsonl", ".lock"):
        (tmp_path / name).touch()
    for name in (
        "0.monitor.csv",
        "run.json",
        "events.out.tfevents.1",
        "replays",
        "checkpoints",
        "Pendulum-v1/args.yml",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("the user's")
    before = {name: value for name, value in entries(tmp_path).items() if value[1]}
    folder = RunFolder(tmp_path)
    # An empty folder with the name of a checkpoint is one that is damaged.
    with pytest.raises(Damaged, match="000010/manifest.json is missing"):
        folder.newest_good()
    (tmp_path / "checkpoint-000000000010").rmdir()
    write(folder, 20, write(folder, 10))
    assert {name: value for name, value in entries(tmp_path).items() if name in before} == before


@pytest.mark.parametrize("left", [(), (".lock",), (".lock", "progress.jsonl"), ("checkpoint-000000000020", "replay")])
def test_what_a_run_of_ours_has_left_is_taken_up(left: tuple[str, ...], tmp_path: Path) -> None:
    """Killed before its first checkpoint, or copied without its hidden files, or without anything but a checkpoint."""
    folder = RunFolder(tmp_path)
    segments = write(folder, 20, write(folder, 10))
    (tmp_path / "progress.jsonl").write_text("{}\n")
    folder.close()
    for path in tmp_path.iterdir():
        if path.name not in left:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    folder = RunFolder(tmp_path)
    good = folder.newest_good()
    assert (good is None) == ("replay" not in left)
    write(folder, 30, segments if good else None)


def test_a_mark_that_was_written_half_is_completed(tmp_path: Path) -> None:
    (tmp_path / ".lock").write_bytes(run_folder._MARK[:20])
    RunFolder(tmp_path).close()
    assert (tmp_path / ".lock").read_bytes() == run_folder._MARK
    (tmp_path / "progress.jsonl").write_text("{}\n")
    RunFolder(tmp_path).close()


# ---------------------------------------------------------------- links, and names that lead elsewhere

#: What is reached through each of them.
LINKS = ("replay", "progress.jsonl", ".lock", "checkpoint-000000000020", "checkpoint-000000000030",
         ".writing-0123456789ab", ".removed-0123456789ab")  # fmt: skip


@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("target", ["user", "user/file", "nowhere", "run", "copy"])
def test_links_are_not_followed(name: str, target: str, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    write(folder, 20, write(folder, 10))
    folder.close()
    (tmp_path / "user").mkdir()
    (tmp_path / "user" / "file").write_text("the user's")
    (tmp_path / "user" / "model-000000000000-000000000010.zip").write_text("the user's")
    path = tmp_path / "run" / name
    if path.exists():
        path.rename(tmp_path / "copy")
    path.symlink_to(tmp_path / target)
    before = entries(tmp_path)
    with pytest.raises(ValueError, match=f"{re.escape(name)} is a link, and a run follows none"):
        RunFolder(tmp_path / "run")
    assert entries(tmp_path) == before


@pytest.mark.parametrize("name", ["checkpoint-000000000020/model.zip", "checkpoint-000000000020/manifest.json",
                                  "replay/model-000000000010-000000000020.zip"])  # fmt: skip
def test_files_of_a_checkpoint_that_are_links_are_damaged(name: str, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    write(folder, 20, write(folder, 10))
    path = tmp_path / "run" / name
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.warns(UserWarning, match=f"is a link, and none is followed there.*{path.name}.*Going on from .*010"):
        assert folder.newest_good()[1]["steps"] == 10  # type: ignore[index]


def test_the_folder_itself_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk")
    folder = RunFolder(tmp_path / "run")
    write(folder, 20, write(folder, 10))
    assert (tmp_path / "disk" / "checkpoint-000000000020").is_dir()


def test_a_copy_by_hard_links_is_a_run_of_its_own(tmp_path: Path) -> None:
    """As ``cp -al`` makes it: neither the lock nor the log is shared."""
    one = RunFolder(tmp_path / "one")
    write(one, 20, write(one, 10))
    (tmp_path / "one" / "progress.jsonl").write_text('{"step": 1}\n')
    shutil.copytree(tmp_path / "one", tmp_path / "two", copy_function=os.link)
    two = RunFolder(tmp_path / "two")
    log = ProgressFile(two.path)
    log.restore({"size": 12, "pending": ['{"step": 2}\n']})
    log.close()
    with pytest.warns(UserWarning, match="checkpoint-000000000020 was in the way"):
        write(two, 30, write(two, 20))
    assert (tmp_path / "one" / "progress.jsonl").read_text() == '{"step": 1}\n'
    assert (tmp_path / "two" / "progress.jsonl").read_text() == '{"step": 1}\n{"step": 2}\n'
    assert one.newest_good()[1]["steps"] == 20  # type: ignore[index]


# ---------------------------------------------------------------- what is in the way


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "same content elsewhere"])
@pytest.mark.parametrize("name", ["checkpoint-000000000030", "replay/model-000000000020-000000000030.zip"])
def test_a_checkpoint_is_written_whatever_has_its_name(name: str, kind: str, tmp_path: Path) -> None:
    """Put there during the training; a run that begins refuses or renames what it finds."""
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    folder = RunFolder(run)
    segments = write(folder, 20, write(folder, 10))
    user_files(elsewhere)
    put(run / name, kind, elsewhere)
    before = snapshot(elsewhere)
    replaced = name.startswith("replay") and kind in ("sparse file", "hard link", "hard link, empty")
    aside = (run / name).with_name(f"damaged-{Path(name).name}")
    was = (run / name).lstat()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        write(folder, 30, segments)
    said = f"{run / name} was in the way of what a checkpoint writes, and is {aside.name} now"
    assert [str(each.message)[: len(said)] for each in caught] == ([] if replaced else [said])
    assert folder.newest_good()[1]["steps"] == 30  # type: ignore[index]
    assert os.path.lexists(aside) is not replaced and (replaced or os.path.samestat(aside.lstat(), was))
    assert kind != "folder with a file" or (aside / "notes").read_text() == "the user's"
    folder.close()
    # It stays where it is, and so does what comes into the way later.
    again = RunFolder(run)
    put(run / "checkpoint-000000000040", kind, elsewhere)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        segments = write(again, 40, again.newest_good()[1]["segments"])  # type: ignore[index]
    write(again, 50, segments)
    assert again.newest_good()[1]["steps"] == 50  # type: ignore[index]
    assert os.path.lexists(aside) is not replaced and os.path.lexists(run / "damaged-checkpoint-000000000040")
    assert snapshot(elsewhere) == before


def test_what_is_in_the_way_and_cannot_be_renamed(tmp_path: Path, monkeypatch: Any) -> None:
    """Is an error that names it, which the training warns of, and nothing is left of the attempt."""
    folder = RunFolder(tmp_path)
    segments = write(folder, 10)
    way = tmp_path / "replay" / "model-000000000010-000000000020.zip"
    way.mkdir()
    before = sorted(str(p) for p in tmp_path.rglob("*"))
    rename = os.rename

    def refuse(source: Any, target: Any, **kwargs: Any) -> None:
        if source == way.name:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM), source)
        rename(source, target, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", refuse)
        with pytest.raises(PermissionError, match=re.escape(way.name)):
            write(folder, 20, segments)
    assert sorted(str(p) for p in tmp_path.rglob("*")) == before


# ---------------------------------------------------------------- what cannot be removed


def test_foreign_files_stay_and_nothing_is_lost_by_them(tmp_path: Path) -> None:
    """As Jupyter's, which makes a sub-folder wherever somebody looks."""
    folder, segments = RunFolder(tmp_path), {}
    theirs = ["replay/.ipynb_checkpoints/a.zip", "replay/notes", "replay/model-1-2.zip", "replay/a/b"]
    for steps in range(10, 70, 10):
        if steps == 20:
            for name in theirs:
                (tmp_path / name).parent.mkdir(exist_ok=True)
                (tmp_path / name).write_text("the user's")
            (tmp_path / "checkpoint-000000000010" / ".ipynb_checkpoints").mkdir()
            (tmp_path / "checkpoint-000000000010" / "notes").write_text("the user's")
        if steps == 30:
            with pytest.warns(
                UserWarning, match=r"\.removed-\w+, the rest of checkpoint-000000000010, cannot be removed"
            ):
                segments = write(folder, steps, segments)
        else:
            segments = write(folder, steps, segments)
        assert folder.newest_good()[1]["steps"] == steps  # type: ignore[index]
    assert all((tmp_path / name).read_text() == "the user's" for name in theirs)
    (left,) = tmp_path.glob(".removed-*")
    assert sorted(path.name for path in left.iterdir()) == [".ipynb_checkpoints", "notes"]
    assert len(list((tmp_path / "replay").glob("model-0*.zip"))) == 3


#: What can fail when a checkpoint is in its place, by what it does to the disk.
AFTERWARDS = ("unlink", "rmdir", "scandir", "fsync")


@pytest.mark.parametrize("call", AFTERWARDS)
@pytest.mark.parametrize("code", [errno.EPERM, errno.EROFS, errno.EIO, errno.ESTALE, errno.EBUSY])
def test_a_checkpoint_in_its_place_counts_whatever_fails_then(
    call: str, code: int, tmp_path: Path, monkeypatch: Any
) -> None:
    folder, segments = RunFolder(tmp_path), {}
    for steps in (10, 20):
        segments = write(folder, steps, segments)
    rename, original, renamed = os.rename, getattr(os, call), [False]

    def noted(source: Any, target: Any, **kwargs: Any) -> None:
        rename(source, target, **kwargs)
        renamed[0] |= target == "checkpoint-000000000030"

    def fail(*args: Any, **kwargs: Any) -> Any:
        if renamed[0]:
            raise OSError(code, os.strerror(code))
        return original(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", noted)
        patch.setattr(os, call, fail)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            segments = write(folder, 30, segments)
            renamed[0] = False
            write(folder, 40, segments)
    said = ("Nothing of the run is lost by it.", "files in it are complete")
    assert all(any(words in str(each.message) for words in said) for each in caught)
    assert caught or call == "fsync"
    folder.close()
    again = RunFolder(tmp_path)
    assert again.newest_good()[1]["steps"] == 40  # type: ignore[index]
    again.verify(tmp_path / "checkpoint-000000000030")
    write(again, 50, write(again, 45, segments))
    assert not list(tmp_path.glob(".removed-*")) and len(list((tmp_path / "replay").iterdir())) <= 4


def test_rows_of_a_checkpoint_in_its_place_are_not_removed(tmp_path: Path, monkeypatch: Any) -> None:
    """Also not by who believes that it was not written, as after a second Ctrl-C."""
    folder = RunFolder(tmp_path)
    segments = write(folder, 10)

    def interrupt(*args: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "_prune", interrupt)
        with pytest.raises(KeyboardInterrupt):
            write(folder, 20, segments)
    folder.remove_segments(["replay/model-000000000010-000000000020.zip"])
    assert folder.newest_good()[1]["steps"] == 20  # type: ignore[index]


def test_rows_stay_while_it_is_not_known_who_needs_them(tmp_path: Path, monkeypatch: Any) -> None:
    """A manifest that cannot be read for the moment is no reason to remove the rows that it names."""
    folder, segments = RunFolder(tmp_path), {}
    for steps in (10, 20):
        segments = write(folder, steps, segments)
    read = run_folder._read_manifest

    def stale(opened: Any) -> Any:
        if opened.path.name == "checkpoint-000000000020":
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))
        return read(opened)

    with monkeypatch.context() as patch:
        patch.setattr(run_folder, "_read_manifest", stale)
        with pytest.warns(UserWarning, match="cannot be tidied up .*Stale file handle"):
            write(folder, 30, {})
    assert folder.verify(tmp_path / "checkpoint-000000000020")["steps"] == 20


# ---------------------------------------------------------------- the lock


def _hold(ready: Any) -> None:
    ready.send(True)
    time.sleep(1000)


def test_a_forked_process_does_not_keep_the_lock(tmp_path: Path) -> None:
    """As a worker that is started during a training, and busy when that is killed."""
    context = multiprocessing.get_context("fork")
    folder = RunFolder(tmp_path)
    ours, theirs = context.Pipe()
    process = context.Process(target=_hold, args=(theirs,))
    process.start()
    assert ours.recv()
    with pytest.raises(ValueError, match="in use"):
        RunFolder(tmp_path)
    folder.close()
    RunFolder(tmp_path).close()
    process.kill()
    process.join()


def test_no_file_of_a_run_has_the_number_of_a_standard_stream(tmp_path: Path) -> None:
    """What a program prints that has closed its standard error would be in it."""
    child = os.fork()
    if child == 0:
        os.close(0)
        os.close(2)
        with Folder.at(tmp_path) as folder:
            descriptors = [folder.descriptor("a", os.O_RDWR | os.O_CREAT), folder.create("b").fileno()]
        os._exit(0 if min(descriptors) > 2 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


# ---------------------------------------------------------------- killed at any moment


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
