"""
The one file format: a zip of uncompressed entries, JSON and tensors, with checksums.

Entries are ``tensors.safetensors``, ``data.json`` and ``checksums.json``, each stored uncompressed, so that nothing
grows when it is read: a reader needs no more memory than the size of the file, except for the JSON, whose size is
capped. Anything else is refused before it is read.
"""

import contextlib
import errno
import gc
import hashlib
import io
import json
import math
import os
import pathlib
import platform
import re
import struct
import zipfile
from collections.abc import Iterator
from typing import IO, Any

import gymnasium as gym
import numpy as np
import stable_baselines3 as sb3
import torch

from sb3_sample.saving.temporary import becoming, remove_abandoned
from sb3_sample.saving.untrusted import BadFile, PickledFile, open_regular
from sb3_sample.version import __version__ as sb3_sample_version
from sb3_sample.warn import warn

DATA, TENSORS, CHECKSUMS = "data.json", "tensors.safetensors", "checksums.json"
ENTRIES = (TENSORS, DATA, CHECKSUMS)
#: Incremented when older versions can no longer read the files.
FORMAT = 1
#: Largest size of the JSON in bytes, in general and for some kinds: as Python objects it takes up to some thirty times
#: as much memory.
MAX_JSON = 32 * 2**20
MAX_JSON_OF = {"model": 8 * 2**20, "plotted runs": 2**20}
#: Largest number of values in the JSON, however short, without tensors, and the bytes of tensors beside it that allow
#: one more: each value takes some 100 bytes as a Python object, and a microsecond.
MAX_VALUES, BYTES_PER_VALUE = 400_000, 16
#: Largest number of tensors, each of which takes some ten microseconds, and of values in their header.
MAX_TENSORS = 50_000
MAX_HEADER_VALUES = 12 * MAX_TENSORS
#: Largest number of dimensions of a tensor, the same as NumPy's.
MAX_DIMENSIONS = 64
#: The dtypes of the safetensors format.
DTYPES = {
    "F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16, "I64": torch.int64,
    "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8, "BOOL": torch.bool,
    "U16": torch.uint16, "U32": torch.uint32, "U64": torch.uint64, "C64": torch.complex64,
    "F8_E4M3": torch.float8_e4m3fn, "F8_E5M2": torch.float8_e5m2,
}  # fmt: skip
_NAMES = {dtype: name for name, dtype in DTYPES.items()}
_SHA256 = re.compile(r"[0-9a-f]{64}")
_CHUNK = 2**20
_PICKLED = (
    "is pickled, and reading it can run any code that its author wanted. If you trust its author, "
    "read it with allow_pickle=True, and save it again without to have a safe file"
)
#: Errors with which systems report that a folder cannot be opened to be synced, or cannot be synced, though files in it
#: are written.
_NOT_OFFERED = (
    errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF, errno.EACCES, errno.EPERM, errno.EISDIR,
)  # fmt: skip
#: Folders for which the warning was given.
_not_synced: set[pathlib.Path] = set()
PathOrFile = str | pathlib.Path | IO[bytes]


class TooLarge(ValueError):
    """Content larger than a reader accepts, which is not written."""


# ---------------------------------------------------------------- writing


def write(path_or_file: PathOrFile, kind: str, tree: Any, tensors: dict[str, torch.Tensor]) -> None:
    """
    Write a file. At a path it replaces an existing file in one step, and only when it is complete, so that whatever
    happens either the old or the new file is there, and whole.

    :param path_or_file: a path, or a binary file open for writing
    :param kind: what the file is, "model" for example; checked when it is read
    :param tree: a tree that JSON can hold
    :param tensors: strided tensors on the CPU
    :raises OSError: if it cannot be written; it names the path
    :raises TooLarge: (a ``ValueError``) if the tree takes more than 32 MiB of JSON, or 8 MiB for a model; if it holds
        more values, or there are more tensors, than a reader takes
    """
    content = {"kind": kind, "format": FORMAT, "versions": versions(), "tree": tree}
    try:
        data = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
    except RecursionError as error:
        raise ValueError(f"the {kind} is nested too deeply to be written") from error
    if len(data) > _max_json(kind):
        raise TooLarge(f"the {kind} takes {len(data)} bytes of JSON, more than the {_max_json(kind)} allowed")
    n_bytes = sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())
    if n_values(data) > most_values(n_bytes):
        raise TooLarge(f"the {kind} consists of {n_values(data)} values, more than the {most_values(n_bytes)} allowed")
    if len(tensors) > MAX_TENSORS:
        raise TooLarge(f"the {kind} consists of {len(tensors)} arrays, more than the {MAX_TENSORS} allowed")
    if not isinstance(path_or_file, (str, pathlib.Path)):
        _write(path_or_file, data, tensors)
        path_or_file.flush()
        return
    with replacing(pathlib.Path(path_or_file)) as file:
        _write(file, data, tensors)


def n_values(data: bytes) -> int:
    """
    :param data: JSON
    :return: the largest number of values that it can hold; commas and brackets in texts count too
    """
    return sum(map(data.count, (b",", b"[", b"{")))


def most_values(n_bytes: int) -> int:
    """
    :param n_bytes: of the tensors in a file
    :return: how many values its JSON may hold
    """
    return MAX_VALUES + n_bytes // BYTES_PER_VALUE


def versions() -> dict[str, str]:
    """
    :return: the versions of the libraries that are involved in a file
    """
    modules = {"sb3_sample": sb3_sample_version, "stable_baselines3": sb3.__version__, "gymnasium": gym.__version__}
    libraries = {"torch": str(torch.__version__), "numpy": np.__version__, "python": platform.python_version()}
    return {**modules, **libraries}


@contextlib.contextmanager
def replacing(path: pathlib.Path) -> Iterator[IO[bytes]]:
    """
    A file that takes the place of another when it is complete and on the disk.

    :param path: of the file to replace
    :return: the file to write to
    :raises OSError: if it cannot be written; the old file is then unchanged, and nothing else is left
    """
    # A link stays one.
    path = pathlib.Path(os.path.realpath(path))
    try:
        remove_abandoned(path.parent)
        with becoming(path) as file:
            yield file
        sync_folder(path.parent)
    except OSError as error:
        raise OSError(error.errno, f"{error.strerror or error}: this file could not be written", str(path)) from error


def sync_folder(folder: pathlib.Path) -> None:
    """
    Make sure that the names of a folder's files are on the disk, where the system offers it. Where it does not, as on
    network shares, warn once.

    :param folder: the folder
    :raises OSError: if the disk is at fault
    """
    if os.name != "posix":
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in _NOT_OFFERED:
            raise
        _say_not_synced(pathlib.Path(os.path.abspath(folder)), error)


def _say_not_synced(folder: pathlib.Path, error: OSError) -> None:
    known = any(folder == other or folder in other.parents or other in folder.parents for other in _not_synced)
    _not_synced.add(folder)
    if not known:
        warn(
            f"{folder} cannot be synced ({error.strerror}): files in it are complete, but a power cut can cost the "
            "newest"
        )


def is_sha256(value: Any) -> bool:
    """
    :param value: anything
    :return: whether it has the form of the checksums in files and manifests
    """
    return isinstance(value, str) and _SHA256.fullmatch(value) is not None


def _max_json(kind: str) -> int:
    return MAX_JSON_OF.get(kind, MAX_JSON)


def _write(file: IO[bytes], data: bytes, tensors: dict[str, torch.Tensor]) -> None:
    checksums = {}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, chunks in ((TENSORS, _safetensors(tensors)), (DATA, iter([data]))):
            digest = hashlib.sha256()
            with archive.open(zipfile.ZipInfo(name), "w", force_zip64=True) as entry:
                for chunk in chunks:
                    entry.write(chunk)
                    digest.update(chunk)
            checksums[name] = digest.hexdigest()
        archive.writestr(zipfile.ZipInfo(CHECKSUMS), json.dumps(checksums))


def _safetensors(tensors: dict[str, torch.Tensor]) -> Iterator[bytes | memoryview]:
    """The safetensors format piece by piece: the library's own writer needs all of it in memory a second time."""
    header: dict[str, Any] = {}
    end = 0
    for name, tensor in tensors.items():
        start, end = end, end + tensor.numel() * tensor.element_size()
        header[name] = {"dtype": _NAMES[tensor.dtype], "shape": list(tensor.shape), "data_offsets": [start, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    if len(text) > MAX_JSON or n_values(text) > MAX_HEADER_VALUES:
        raise TooLarge("the arrays' names and shapes take more than a reader takes")
    # The numbers start at a multiple of eight.
    text += b" " * (-len(text) % 8)
    yield struct.pack("<Q", len(text)) + text
    for tensor in tensors.values():
        if tensor.numel():
            raw: Any = tensor.resolve_conj().resolve_neg().contiguous().view(-1).view(torch.uint8).numpy()
            yield memoryview(raw)


# ---------------------------------------------------------------- reading


def read(path_or_file: PathOrFile, kind: str) -> tuple[Any, dict[str, torch.Tensor]]:
    """
    Read a file that :func:`write` made, and check all of it.

    :param path_or_file: a path, or a binary file open for reading
    :param kind: the kind that it must be
    :return: the tree and the tensors
    :raises BadFile: if it is anything else, or damaged
    :raises OSError: if it cannot be read
    """
    tree, tensors, _ = read_with_versions(path_or_file, kind)
    return tree, tensors


def read_with_versions(path_or_file: PathOrFile, kind: str) -> tuple[Any, dict[str, torch.Tensor], dict[str, str]]:
    """
    Read a file as :func:`read` does, and its versions.

    :param path_or_file: a path, or a binary file open for reading
    :param kind: the kind that it must be
    :return: the tree, the tensors, and the versions of the libraries that it was written with
    """
    if not isinstance(path_or_file, (str, pathlib.Path)):
        return _read(path_or_file, kind, str(getattr(path_or_file, "name", "the file")))
    with open_regular(path_or_file) as file:
        return _read(file, kind, str(path_or_file))


def _read(file: IO[bytes], kind: str, name: str) -> tuple[Any, dict[str, torch.Tensor], dict[str, str]]:
    try:
        with _opened(file, kind, name) as archive:
            checksums = _json(_text(archive.read(CHECKSUMS), name, 10), name)
            if not isinstance(checksums, dict) or checksums.keys() != {DATA, TENSORS}:
                raise BadFile(f"{name}: the checksums are not those of {DATA} and {TENSORS}")
            size = archive.getinfo(TENSORS).file_size
            tree, versions = _checked(_data(archive, checksums[DATA], most_values(size), name), kind, name)
            with archive.open(TENSORS) as entry:
                tensors, digest = _read_safetensors(entry, size, name)
            _compare(digest, checksums[TENSORS], name, TENSORS)
    except BadFile:
        raise
    except (
        zipfile.BadZipFile,
        NotImplementedError,
        EOFError,
        struct.error,
        ArithmeticError,
        ValueError,
        RuntimeError,
    ) as error:
        raise BadFile(f"{name} is damaged, or no file of sb3_sample: {error}") from error
    return tree, tensors, versions


def _opened(file: IO[bytes], kind: str, name: str) -> zipfile.ZipFile:
    """Open the archive, if its table of contents holds our entries and nothing else."""
    size = file.seek(0, io.SEEK_END)
    check_table(file, size, name)
    archive = zipfile.ZipFile(file)
    entries = archive.infolist()
    names = [entry.filename for entry in entries]
    if any(entry.endswith((".pth", "/data.pkl")) for entry in names):
        raise PickledFile(f"{name} is a model of Stable-Baselines3 or torch and {_PICKLED}")
    if sorted(names) != sorted(ENTRIES):
        raise BadFile(f"{name} is no file of sb3_sample: it holds {sorted(names)!r:.300}, not {sorted(ENTRIES)}")
    end = 0
    for entry in sorted(entries, key=lambda entry: entry.header_offset):
        plain = entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 1
        if not plain or entry.file_size != entry.compress_size:
            raise BadFile(f"{name}: {entry.filename} is compressed or encrypted, which no file of sb3_sample is")
        start = entry.header_offset + 30 + len(entry.filename)
        if entry.header_offset < end or start + entry.file_size > size:
            raise BadFile(f"{name}: {entry.filename} lies outside of the file, or over another entry")
        end = start + entry.file_size
        if entry.filename != TENSORS and entry.file_size > _max_json(kind):
            raise BadFile(
                f"{name}: {entry.filename} has {entry.file_size} bytes, more than the {_max_json(kind)} allowed"
            )
    return archive


def check_table(file: IO[bytes], size: int, name: str) -> None:
    """Look at the end of the file by hand: the library would read a table of contents of any length into memory."""
    file.seek(0)
    start = file.read(2)
    file.seek(max(0, size - 98))
    tail = file.read(98)
    file.seek(0)
    if size < 22 or tail[-22:-18] != b"PK\x05\x06" or tail[-2:] != b"\0\0":
        # A comment may follow the table of a zip, but not of ours.
        if start[:1] == b"\x80":
            raise PickledFile(f"{name} {_PICKLED}")
        raise BadFile(f"{name} is truncated, or no file of sb3_sample")
    n_entries, length, offset = struct.unpack("<HII", tail[-12:-2])
    table_end = size - 22
    if tail[-42:-38] == b"PK\x06\x07":
        if tail[-98:-94] != b"PK\x06\x06":
            raise BadFile(f"{name} is damaged: its table of contents does not end where it must")
        n_entries, length, offset = struct.unpack("<QQQ", tail[-66:-42])
        table_end = size - 98
    # Stable-Baselines3's files are recognised later, by the names of their entries.
    if n_entries > 1000 or length > 2**18:
        raise BadFile(f"{name} is no file of sb3_sample: it has {n_entries} entries")
    if offset + length != table_end:
        raise BadFile(f"{name} is damaged: its table of contents lies elsewhere than it says")


def _data(archive: zipfile.ZipFile, checksum: Any, most: int, name: str) -> Any:
    data = archive.read(DATA)
    _compare(hashlib.sha256(data), checksum, name, DATA)
    text = _text(data, name, most)
    # The texts parsed from it would be a third copy.
    del data
    return _json(text, name)


def _text(data: bytes, name: str, most: int) -> str:
    """The text of JSON, if it holds at most ``most`` values."""
    if (n := n_values(data)) > most:
        raise BadFile(f"{name} is damaged or hostile: its JSON holds {n} values, more than the {most} allowed")
    return data.decode()


def _json(text: str, name: str) -> Any:
    def refuse(constant: str) -> Any:
        raise BadFile(f"{name}: {constant} is no number of JSON")

    def finite(text: str) -> float:
        value = float(text)
        return value if math.isfinite(value) else refuse(text)

    collecting = gc.isenabled()
    # The data read have no cycles, and looking for them again and again takes ten times as long as reading.
    gc.disable()
    try:
        return json.loads(text, parse_constant=refuse, parse_float=finite)
    except RecursionError as error:
        raise BadFile(f"{name} is nested too deeply") from error
    finally:
        if collecting:
            gc.enable()


def _checked(content: Any, kind: str, name: str) -> tuple[Any, dict[str, str]]:
    if not isinstance(content, dict) or content.keys() != {"kind", "format", "versions", "tree"}:
        raise BadFile(f"{name} does not say what it holds")
    if content["format"] != FORMAT:
        raise BadFile(
            f"{name} is in format {content['format']!r:.50}, but this version of sb3_sample reads format {FORMAT}"
        )
    if content["kind"] != kind:
        raise BadFile(f"{name} holds a {content['kind']!r:.50}, not a {kind!r}")
    versions = content["versions"]
    if not isinstance(versions, dict) or not all(isinstance(value, str) for value in versions.values()):
        raise BadFile(f"{name} does not say what it was written with")
    return content["tree"], versions


def _compare(digest: Any, expected: Any, name: str, entry: str) -> None:
    if not is_sha256(expected) or digest.hexdigest() != expected:
        raise BadFile(f"{name} is damaged: the checksum of {entry} is another than the one written with it")


def _read_safetensors(entry: IO[bytes], size: int, name: str) -> tuple[dict[str, torch.Tensor], Any]:
    """Read the tensors, each into its own memory, after checking that the header fits the bytes that are there."""
    digest = hashlib.sha256()
    start = entry.read(8)
    if len(start) < 8:
        raise BadFile(f"{name}: the header of the tensors is missing")
    (length,) = struct.unpack("<Q", start)
    if length > min(size - 8, MAX_JSON):
        raise BadFile(f"{name}: the header of the tensors claims {length} bytes")
    data = entry.read(length)
    digest.update(start + data)
    header = _json(_text(data, name, MAX_HEADER_VALUES), name)
    if not isinstance(header, dict):
        raise BadFile(f"{name}: the header of the tensors is no object")
    if len(header) > MAX_TENSORS + 1:
        raise BadFile(f"{name}: the header of the tensors names {len(header)}, more than the {MAX_TENSORS} allowed")
    header.pop("__metadata__", None)
    layout, end = [], 0
    for key, described in header.items():
        dtype, shape, n_bytes = _described(described, end, f"{name}: the tensor {key!r:.200}")
        layout.append((key, dtype, shape, n_bytes))
        end += n_bytes
    if end != size - 8 - length:
        raise BadFile(f"{name}: the tensors take {end} bytes, but {size - 8 - length} are there")
    tensors = {}
    for key, dtype, shape, n_bytes in layout:
        memory = torch.empty(n_bytes, dtype=torch.uint8)
        raw: Any = memory.numpy()
        view = memoryview(raw)
        for place in range(0, n_bytes, _CHUNK):
            chunk = entry.read(min(_CHUNK, n_bytes - place))
            view[place : place + len(chunk)] = chunk
            digest.update(chunk)
        if dtype == torch.bool and n_bytes and int(memory.max()) > 1:
            raise BadFile(f"{name}: the tensor {key!r:.200} of booleans holds other numbers than 0 and 1")
        tensors[key] = memory.view(dtype).view(shape)
    # The library compares the archive's own checksum at the end.
    entry.read(1)
    return tensors, digest


def _described(described: Any, start: int, name: str) -> tuple[torch.dtype, list[int], int]:
    if not isinstance(described, dict) or described.keys() != {"dtype", "shape", "data_offsets"}:
        raise BadFile(f"{name} is not described as it must be")
    shape, offsets = described["shape"], described["data_offsets"]
    dtype = DTYPES.get(described["dtype"]) if isinstance(described["dtype"], str) else None
    if dtype is None:
        raise BadFile(f"{name} is of {described['dtype']!r:.50}, not of one of {sorted(DTYPES)}")
    sizes: list[Any] = shape if isinstance(shape, list) else [None]
    fits = len(sizes) <= MAX_DIMENSIONS and all(type(n) is int and n >= 0 for n in sizes)
    if not fits or math.prod(n or 1 for n in sizes) >= 2**60:
        raise BadFile(f"{name} has the shape {shape!r:.200}")
    n_bytes = math.prod(sizes) * dtype.itemsize
    if not isinstance(offsets, list) or offsets != [start, start + n_bytes]:
        raise BadFile(
            f"{name} of shape {shape!r:.200} takes {n_bytes} bytes from {start} on, but the header says "
            f"{offsets!r:.200}"
        )
    return dtype, sizes, n_bytes
