"""The file format: complete or not there, and nothing but what was written is read."""

import contextlib
import errno
import io
import json
import multiprocessing
import os
import pickle
import re
import resource
import signal
import stat
import struct
import subprocess
import sys
import textwrap
import time
import warnings
import zipfile
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from stable_baselines3 import PPO

from sb3_sample.saving import container
from sb3_sample.saving.container import CHECKSUMS, DATA, TENSORS, BadFile, read, write

TREE = {"a": [1, 2.5, None, "x"], "b": {"tuple": []}}


def some_tensors() -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    tensors = {"w": torch.randn(3, 4, generator=g), "n": torch.arange(3), "bits": torch.tensor([True, False, True])}
    return {
        **tensors,
        "none": torch.zeros(0, 2),
        "half": torch.randn(5, generator=g).bfloat16(),
        "one": torch.tensor(1),
    }


def file_of(tree: Any = TREE, tensors: dict[str, torch.Tensor] | None = None) -> bytes:
    file = io.BytesIO()
    write(file, "model", tree, some_tensors() if tensors is None else tensors)
    return file.getvalue()


def remade(changes: dict[str, bytes | None], honest: bool = True, **how: Any) -> bytes:
    """The file with other entries; their checksums right if ``honest``."""
    with zipfile.ZipFile(io.BytesIO(file_of())) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    entries = {name: data for name, data in {**entries, **changes}.items() if data is not None}
    if honest and CHECKSUMS not in changes:
        import hashlib

        sums = {name: hashlib.sha256(entries.get(name, b"")).hexdigest() for name in (DATA, TENSORS)}
        entries[CHECKSUMS] = json.dumps(sums).encode()
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", **how) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return file.getvalue()


def refused(data: bytes, words: str, kind: str = "model") -> None:
    with pytest.raises(BadFile, match=words):
        read(io.BytesIO(data), kind)


def tensor_file(header: Any, data: bytes) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


@pytest.mark.parametrize("through", [str, Path, io.BytesIO, "file"])
def test_round_trip(through: Any, tmp_path: Path) -> None:
    path = tmp_path / "m.zip"
    if through is io.BytesIO:
        target: Any = io.BytesIO()
        write(target, "model", TREE, some_tensors())
        tree, tensors = read(target, "model")
    elif through == "file":
        with path.open("wb") as file:
            write(file, "model", TREE, some_tensors())
        with path.open("rb") as file:
            tree, tensors = read(file, "model")
    else:
        write(through(path), "model", TREE, some_tensors())
        tree, tensors = read(through(path), "model")
    assert tree == TREE
    assert list(tensors) == list(some_tensors())
    for name, tensor in some_tensors().items():
        assert tensors[name].dtype == tensor.dtype and torch.equal(tensors[name], tensor)


def test_the_tensors_are_a_safetensors_file() -> None:
    """Written for anyone's reader, and read from anyone's writer."""
    with zipfile.ZipFile(io.BytesIO(file_of())) as archive:
        theirs = safetensors.torch.load(archive.read(TENSORS))
        assert all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())
        assert json.loads(archive.read(DATA))["tree"] == TREE
    for name, tensor in some_tensors().items():
        assert theirs[name].dtype == tensor.dtype and torch.equal(theirs[name], tensor)
    written = safetensors.torch.save(some_tensors(), metadata={"format": "pt"})
    _, tensors = read(io.BytesIO(remade({TENSORS: written})), "model")
    assert all(torch.equal(tensors[name], tensor) for name, tensor in some_tensors().items())


def test_every_dtype() -> None:
    tensors = {name: torch.arange(8).to(dtype) for name, dtype in container.DTYPES.items()}
    _, loaded = read(io.BytesIO(file_of(tensors=tensors)), "model")
    for name, tensor in tensors.items():
        assert loaded[name].dtype == tensor.dtype
        assert torch.equal(loaded[name].view(torch.uint8), tensor.view(torch.uint8))


def test_tensors_that_share_memory_do_not_afterwards() -> None:
    weight = torch.zeros(2, 2)
    _, loaded = read(io.BytesIO(file_of(tensors={"a": weight, "b": weight, "c": weight.T, "d": weight[0]})), "model")
    loaded["a"].fill_(1)
    assert all(loaded[name].sum() == 0 for name in "bcd")


def test_equal_content_gives_equal_bytes() -> None:
    assert file_of() == file_of()


# ---------------------------------------------------------------- writing


def test_overwriting_keeps_what_is_there_until_the_new_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "m"
    write(path, "model", TREE, some_tensors())
    before = path.read_bytes()

    def stop(descriptor: int) -> None:
        assert path.read_bytes() == before
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", stop)
    with pytest.raises(KeyboardInterrupt):
        write(path, "model", {"other": 1}, {})
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["m"]


def test_data_and_name_are_on_the_disk_before_the_call_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[str] = []
    fsync, replace = os.fsync, os.replace

    def logged_fsync(descriptor: int) -> None:
        events.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    def logged_replace(source: Any, target: Any) -> None:
        events.append("replace")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", logged_fsync)
    monkeypatch.setattr(os, "replace", logged_replace)
    write(tmp_path / "m", "model", TREE, {})
    assert events == ["file", "replace", "folder"]


def fail_to_sync_folders(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the system answer an error to ``fsync`` of a folder, and sync files as ever."""
    fsync = os.fsync

    def not_of_folders(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", not_of_folders)


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EPERM])
def test_a_folder_that_cannot_be_synced(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As network shares and some FUSE mounts answer: what is complete is written, which is said once a folder."""
    fail_to_sync_folders(number, monkeypatch)
    (tmp_path / "inside").mkdir()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for name in ("a", "b", "a", "inside/c"):
            write(tmp_path / name, "model", TREE, some_tensors())
    assert [str(w.message) for w in caught] == [
        f"{tmp_path} cannot be synced ({os.strerror(number)}): files in it are complete, but a power cut can cost the "
        "newest"
    ]
    assert read(tmp_path / "b", "model")[0] == TREE


def test_a_folder_that_cannot_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = os.open

    def denied(path: Any, flags: int, *args: Any) -> int:
        if os.path.isdir(path):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, flags, *args)

    monkeypatch.setattr(os, "open", denied)
    with pytest.warns(UserWarning, match="cannot be synced .Permission denied"):
        write(tmp_path / "m", "model", TREE, some_tensors())
    assert [p.name for p in tmp_path.iterdir()] == ["m"]


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC, errno.EROFS])
def test_a_disk_that_fails_is_no_folder_that_cannot_be_synced(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_to_sync_folders(number, monkeypatch)
    with pytest.raises(OSError, match="could not be written"):
        write(tmp_path / "m", "model", TREE, some_tensors())


def test_no_space_left(tmp_path: Path) -> None:
    """A limit on the size of files stands for the full disk: the write fails in the same way."""
    path = tmp_path / "m"
    write(path, "model", TREE, some_tensors())
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(OSError, match="could not be written") as raised:
            write(path, "model", TREE, {"big": torch.zeros(10**6)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert raised.value.errno == errno.EFBIG and raised.value.filename == str(path)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["m"]


def test_a_folder_that_cannot_be_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OSError, match="could not be written") as raised:
        write(tmp_path / "nowhere" / "m", "model", TREE, {})
    assert raised.value.filename == str(tmp_path / "nowhere" / "m") and isinstance(raised.value, FileNotFoundError)

    def denied(source: Any, target: Any) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "replace", denied)
    with pytest.raises(PermissionError, match="could not be written"):
        write(tmp_path / "m", "model", TREE, {})
    assert not list(tmp_path.iterdir())


def _write_until_killed(path: Path, ready: Any) -> None:
    with container.replacing(path) as file:
        file.write(b"half")
        file.flush()
        ready.send(True)
        time.sleep(1000)


def test_what_a_killed_save_left_is_removed_and_what_another_writes_is_not(tmp_path: Path) -> None:
    """Whoever saves next in the folder does it, under whatever name; and only files of this kind."""
    others = [".m.zip.tmp", ".m.zip.0123456789ab", ".m.zip.0123456789AB.tmp", "m.zip.0123456789ab.tmp"]
    for name in others:
        (tmp_path / name).write_text("of somebody else")
    (tmp_path / ".m.zip.0123456789ab.tmp").mkdir()
    (tmp_path / ".n.zip.0123456789ab.tmp").symlink_to(tmp_path / others[0])
    before = {path.name for path in tmp_path.iterdir()}
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    process = context.Process(target=_write_until_killed, args=(tmp_path / "m.zip", theirs))
    process.start()
    assert ours.recv()
    write(tmp_path / "other", "model", TREE, {})
    (halfway,) = {path.name for path in tmp_path.iterdir()} - before - {"other"}
    assert re.fullmatch(r"\.m\.zip\.[0-9a-f]{12}\.tmp", halfway)
    process.kill()
    process.join()
    write(tmp_path / "another", "model", TREE, {})
    assert {path.name for path in tmp_path.iterdir()} == {*before, "other", "another"}
    assert all((tmp_path / name).read_text() == "of somebody else" for name in others)


def _write_often(folder: Path, name: str) -> None:
    for i in range(100):
        write(folder / name, "model", {"i": i}, {})


def test_several_programs_save_in_one_folder(tmp_path: Path) -> None:
    """None takes for abandoned what another has just begun."""
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=_write_often, args=(tmp_path, str(i))) for i in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * 4
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1", "2", "3"]
    assert all(read(tmp_path / str(i), "model")[0] == {"i": 99} for i in range(4))


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write(tmp_path / "link", "model", TREE, {})
    assert (tmp_path / "link").is_symlink() and read(tmp_path / "real", "model")[0] == TREE


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_tree_is_json(bad: float) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        file_of(tree=[bad])


def test_a_tree_that_is_too_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(container.MAX_JSON_OF, "model", 1000)
    with pytest.raises(ValueError, match="bytes of JSON, more than the 1000 allowed"):
        file_of(tree="x" * 1000)


# ---------------------------------------------------------------- reading


def test_every_changed_byte_is_noticed_or_harmless() -> None:
    """A byte that may change is one that no reader looks at, as the date of an entry."""
    data = file_of()
    wanted = some_tensors()
    for place in range(len(data)):
        damaged = bytearray(data)
        damaged[place] ^= 1 << place % 8
        try:
            tree, tensors = read(io.BytesIO(damaged), "model")
        except BadFile:
            continue
        assert tree == TREE and all(torch.equal(tensors[name], wanted[name]) for name in wanted), place


def test_every_truncation_is_noticed() -> None:
    data = file_of()
    for length in range(len(data)):
        refused(data[:length], "truncated|damaged|no file of sb3_sample")
    for more in (b"x", b"\0" * 100, data):
        with pytest.raises(BadFile):
            read(io.BytesIO(data[:-1] + more), "model")


def test_kind_and_format() -> None:
    refused(file_of(), "holds a 'model', not a 'checkpoint'", "checkpoint")
    content = {"kind": "model", "format": 99, "versions": {}, "tree": 1}
    refused(remade({DATA: json.dumps(content).encode()}), "is in format 99, but this version")
    refused(remade({DATA: json.dumps({**content, "format": 1, "more": 2}).encode()}), "does not say what it holds")
    refused(remade({DATA: b"[]"}), "does not say what it holds")


def test_pickles_are_recognised_and_not_read(tmp_path: Path) -> None:
    class Payload:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "ran"),)

    PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, device="cpu").save(tmp_path / "sb3.zip")
    (tmp_path / "b.pkl").write_bytes(pickle.dumps(Payload()))
    torch.save(Payload(), tmp_path / "t.pt")
    for name in ("sb3.zip", "b.pkl", "t.pt"):
        with pytest.raises(BadFile, match=rf"{name}.* pickled, .*allow_pickle=True"):
            read(tmp_path / name, "model")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("changes", "how", "words"),
    [
        ({"../evil": b"x"}, {}, "it holds"), ({"/etc/evil": b"x"}, {}, "it holds"), ({"more": b""}, {}, "it holds"),
        ({TENSORS: None}, {}, "it holds"), ({"data": b"", "policy.pth": b""}, {}, "pickled"),
        ({DATA: b" " * 10**7}, {"compression": zipfile.ZIP_DEFLATED}, "compressed"),
        ({TENSORS: b"\0" * 10**7}, {"compression": zipfile.ZIP_BZIP2}, "compressed"),
        ({DATA: b" " * (8 * 2**20 + 1)}, {}, "more than the 8388608 allowed"),
        ({CHECKSUMS: b"{}"}, {}, "checksums"), ({CHECKSUMS: b"[]"}, {}, "checksums"),
        ({CHECKSUMS: json.dumps({DATA: "0" * 64, TENSORS: "0" * 64}).encode()}, {}, "checksum of data.json"),
        ({CHECKSUMS: json.dumps({DATA: [1], TENSORS: None}).encode()}, {}, "checksum of data.json"),
        ({DATA: b"{"}, {}, "damaged"), ({DATA: b"\xff"}, {}, "damaged"), ({DATA: b""}, {}, "damaged"),
        ({DATA: b"NaN"}, {}, "NaN is no number"), ({DATA: b"[1e999]"}, {}, "1e999 is no number"),
        ({DATA: b"[-Infinity]"}, {}, "no number of JSON"), ({DATA: b"[" * 10**5}, {}, "nested too deeply"),
        ({DATA: b'{"a":' * 10**5}, {}, "nested too deeply"), ({DATA: b"9" * 10**5}, {}, "damaged"),
    ],
)  # fmt: skip
def test_hostile_archives(changes: Any, how: Any, words: str) -> None:
    refused(remade(changes, **how), words)


def described(dtype: Any = "F32", shape: Any = (2,), offsets: Any = (0, 8), **more: Any) -> dict[str, Any]:
    return {"t": {"dtype": dtype, "shape": shape, "data_offsets": offsets, **more}}


@pytest.mark.parametrize(
    ("tensors", "words"),
    [
        (b"", "header of the tensors is missing"), (struct.pack("<Q", 2**63), "claims"),
        (struct.pack("<Q", 100) + b"{}", "claims"), (tensor_file(b"[", b""), "damaged"),
        (tensor_file([], b""), "no object"),
        (tensor_file(described(), b"1234567"), "take 8 bytes, but 7 are there"),
        (tensor_file(described(), b"123456789"), "take 8 bytes, but 9 are there"),
        (tensor_file(described(shape=[2**40], offsets=[0, 2**42]), b""), "take .* bytes, but 0 are there"),
        (tensor_file(described(shape=[2**62, 4]), b"1" * 8), "shape"),
        (tensor_file(described(shape=[2**61, 2**61]), b"1" * 8), "shape"),
        (tensor_file(described(shape=[-2], offsets=[0, -8]), b"1" * 8), "shape"),
        (tensor_file(described(shape=[2.0]), b"1" * 8), "shape"),
        (tensor_file(described(shape=[True]), b"1" * 4), "shape"),
        (tensor_file(described(shape="x"), b"1" * 8), "shape"),
        (tensor_file(described(shape=[1] * 65), b"1" * 4), "shape"),
        (tensor_file(described(shape=[0, 2**61, 2**61], offsets=[0, 0]), b""), "shape"),
        (tensor_file(described(offsets=[4, 12]), b"1" * 12), "header says"),
        (tensor_file(described(offsets=[0, 4]), b"1" * 4), "header says"),
        (tensor_file(described(offsets=None), b"1" * 8), "header says"),
        (tensor_file(described("F31"), b"1" * 8), "is of 'F31'"), (tensor_file(described(["F32"]), b"1" * 8), "is of"),
        (tensor_file(described(more=1), b"1" * 8), "not described"), (tensor_file({"t": 3}, b""), "not described"),
        (tensor_file({**described(), "u": described()["t"]}, b"1" * 8), "'u' of shape .* header says"),
        (tensor_file(described("BOOL", [2], [0, 2]), b"\0\2"), "booleans"),
    ],
)  # fmt: skip
def test_tensors_whose_header_lies(tensors: bytes, words: str) -> None:
    refused(remade({TENSORS: tensors}), words)


def test_a_table_of_contents_that_is_far_too_long() -> None:
    """It is not read into memory: the number of entries that it claims is enough."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for i in range(2000):
            archive.writestr(str(i), b"")
    refused(file.getvalue(), "it has 2000 entries")
    # A few entries claimed, in a table of many megabytes.
    data = bytearray(file.getvalue())
    data[-14:-10] = struct.pack("<HH", 3, 3)
    refused(bytes(data), "damaged|no file of sb3_sample")


def test_a_large_zip64_file_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the limits lowered instead of four gigabytes written."""
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 50)
    write(tmp_path / "m", "model", TREE, some_tensors())
    assert b"PK\x06\x06" in (tmp_path / "m").read_bytes()
    assert read(tmp_path / "m", "model")[0] == TREE
    data = (tmp_path / "m").read_bytes()
    for place in range(len(data) - 98, len(data)):
        damaged = bytearray(data)
        damaged[place] ^= 0xFF
        with contextlib.suppress(BadFile):
            assert read(io.BytesIO(damaged), "model")[0] == TREE


def test_entries_over_each_other() -> None:
    data = bytearray(file_of())
    first = data.index(b"PK\x01\x02")
    second = data.index(b"PK\x01\x02", first + 4)
    data[second + 42 : second + 46] = data[first + 42 : first + 46]
    refused(bytes(data), "over another entry|damaged")


@pytest.mark.slow
def test_memory_is_bounded_by_the_file(tmp_path: Path) -> None:
    """Reading 64 MiB of tensors takes that and little more; writing takes no copy at all."""
    program = textwrap.dedent(
        f"""
        import torch
        from sb3_sample.saving.container import read, write
        from tests.memory import peak
        tensors = {{str(i): torch.ones(2**22) for i in range(4)}}
        start = peak()
        write({str(tmp_path / "m")!r}, "model", 1, tensors)
        written = peak()
        del tensors
        read({str(tmp_path / "m")!r}, "model")
        print(written - start, peak() - start)
        """
    )
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=True)
    writing, reading = map(int, done.stdout.split())
    assert writing < 12 * 2**20 and reading < 12 * 2**20
