"""Run folders that somebody has changed, or that hold files of the user's, made from a seed."""

import errno
import hashlib
import json
import os
import random
import shutil
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.saving.hostile import HUGE, Original, at, case_of, places

#: Of what is thrown: the checkpoints, the rows, and the other files of a run, as the program of the test makes them.
OLD, NEW, NEXT = "checkpoint-000000000020", "checkpoint-000000000030", "checkpoint-000000000040"
CHECKPOINT_FILES = ("model.zip", "state.zip", "manifest.json")
ROWS = tuple(f"replay/model-{first:012d}-{first + 10:012d}.zip" for first in (0, 10, 20))
NEXT_ROWS = "replay/model-000000000030-000000000040.zip"
FILES = (".lock", "progress.jsonl", *(f"{c}/{name}" for c in (OLD, NEW) for name in CHECKPOINT_FILES), *ROWS)
FOLDERS = ("replay", OLD, NEW)
HEX = "0123456789ab"
#: Names that are not there and that a run makes, or takes for its own.
COMING = (
    NEXT, NEXT_ROWS, f".writing-{HEX}", f".removed-{HEX}", ".writing", ".removed", f"damaged-{NEW}",
    "replay/.model-000000000030-000000000040.zip." + HEX, f".progress.jsonl.{HEX}", f"..lock.{HEX}",
)  # fmt: skip


def facts_of(data: bytes) -> dict[str, Any]:
    """What a manifest says of a file."""
    return {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def manifest_text(manifest: Any) -> bytes:
    """A manifest behind its right checksum, if it is an object."""
    body = json.dumps(manifest, indent=1)
    if not isinstance(manifest, dict) or not manifest:
        return body.encode()
    return f'{body[:-2]},\n "sha256": "{hashlib.sha256(body.encode()).hexdigest()}"\n}}'.encode()


def rewritten(path: Path, change: Callable[[Any], Any]) -> None:
    """Change a manifest, as anybody can who knows how its checksum is made."""
    manifest = json.loads(path.read_bytes())
    del manifest["sha256"]
    change(manifest)
    path.write_bytes(manifest_text(manifest))


def replaced(run: Path, name: str, data: bytes) -> None:
    """Change a file that manifests name, and what they say of it."""
    (run / name).write_bytes(data)
    folder, _, file = name.partition("/")
    for checkpoint in (OLD, NEW):
        if checkpoint == folder:
            rewritten(run / checkpoint / "manifest.json", lambda manifest: manifest["files"].update(
                {file: facts_of(data)}))  # fmt: skip
        elif folder == "replay":
            rewritten(run / checkpoint / "manifest.json", lambda manifest: _update_rows(manifest, name, data))


def _update_rows(manifest: Any, name: str, data: bytes) -> None:
    if name in manifest["segments"]:
        manifest["segments"][name].update(facts_of(data))


@dataclass
class Case:
    """
    A changed folder.

    :param words: what is changed
    :param change: changes it, given the folder and another one with files of the user's
    :param same: whether nothing that a checkpoint holds has changed behind right checksums, so that a run that goes on
        ends as the one with no change
    :param kept: what must be there afterwards as it was, in the folder
    """

    words: str
    change: Callable[[Path, Path], None]
    same: bool
    kept: tuple[str, ...] = ()


def user_files(elsewhere: Path) -> None:
    """Files of the user's outside of the run's folder, that nobody may touch."""
    (elsewhere / "theirs" / "inner").mkdir(parents=True)
    (elsewhere / "empty-folder").mkdir()
    for name in ("profile", "best_model.zip", "evaluations.npz", "theirs/a.zip", "theirs/model.zip",
                 "theirs/manifest.json", f"theirs/{Path(ROWS[0]).name}", "theirs/inner/b"):  # fmt: skip
        (elsewhere / name).write_text(f"the user's {name}\n")
    (elsewhere / "empty").touch()


# ---------------------------------------------------------------- damage, behind the checksums that were right


def damaged(rng: random.Random, original: dict[str, bytes]) -> Case:
    name = rng.choice(FILES)
    data = original[name]
    what = rng.choice(["truncated", "flipped", "appended", "emptied", "missing", "overwritten", "exchanged"])
    place, other = rng.randrange(len(data)), rng.choice(FILES)

    def change(run: Path, elsewhere: Path) -> None:
        changed = {
            "truncated": data[:place],
            "flipped": data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :],
            "appended": data + rng.randbytes(20),
            "emptied": b"",
            "overwritten": data[:place] + rng.randbytes(min(30, len(data) - place)) + data[place + 30 :],
            "exchanged": original[other],
        }
        if what == "missing":
            (run / name).unlink()
        else:
            (run / name).write_bytes(changed[what])

    return Case(f"{name} {what} at {place}, with {other}", change, True)


def missing(rng: random.Random, original: dict[str, bytes]) -> Case:
    names = rng.sample([*FILES, *FOLDERS], rng.choice([1, 1, 2, 3]))

    def change(run: Path, elsewhere: Path) -> None:
        for name in names:
            if (run / name).is_dir():
                shutil.rmtree(run / name)
            else:
                (run / name).unlink(missing_ok=True)

    return Case(f"{names} are missing", change, True)


# ---------------------------------------------------------------- what is no file


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def put(path: Path, kind: str, elsewhere: Path) -> None:
    """Put something else in a place."""
    aside = elsewhere.parent / "aside"
    match kind:
        case "same content elsewhere":
            if path.exists():
                path.rename(aside)
            path.symlink_to(aside)
            return
        case "relative link":
            _remove(path)
            path.symlink_to(os.path.relpath(elsewhere / "profile", path.parent))
            return
    _remove(path)
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "socket":
            with socket.socket(socket.AF_UNIX) as one:
                # The path of a socket is short.
                before = os.getcwd()
                os.chdir(path.parent)
                one.bind(path.name)
                os.chdir(before)
        case "folder":
            path.mkdir()
        case "folder with a file":
            path.mkdir()
            (path / "notes").write_text("the user's")
        case "sparse file":
            with path.open("wb") as file:
                file.truncate(2**40)
        case "loop":
            path.symlink_to(path)
        case "hard link":
            os.link(elsewhere / "profile", path)
        case "hard link, empty":
            os.link(elsewhere / "empty", path)
        case _:
            path.symlink_to(kind if kind.startswith("/") else elsewhere / kind)


KINDS = (
    "pipe", "socket", "folder", "folder with a file", "sparse file", "loop", "same content elsewhere", "relative link",
    "hard link", "hard link, empty", "profile", "empty", "theirs", "empty-folder", "not there", "/dev/zero",
    "/dev/null", "/etc/passwd", "/",
)  # fmt: skip


def kinds(rng: random.Random, original: dict[str, bytes]) -> Case:
    name, kind = rng.choice([*FILES, *FOLDERS, *FOLDERS, "progress.jsonl", ".lock"]), rng.choice(KINDS)
    return Case(f"{name} is {kind}", lambda run, elsewhere: put(run / name, kind, elsewhere), True)


def coming(rng: random.Random, original: dict[str, bytes]) -> Case:
    """In the way of what the run is about to make."""
    name, kind = rng.choice(COMING), rng.choice([each for each in KINDS if each != "same content elsewhere"])
    return Case(f"{name} is there as {kind}", lambda run, elsewhere: put(run / name, kind, elsewhere), True)


# ---------------------------------------------------------------- files of the user's


def beside(rng: random.Random, original: dict[str, bytes]) -> Case:
    """What a user, or a program of theirs, puts into the folder: it stays as it is, and the run goes on."""
    names = (
        ".ipynb_checkpoints/a", "replay/.ipynb_checkpoints/model-checkpoint.zip", f"{OLD}/.ipynb_checkpoints/a.json",
        f"{NEW}/.ipynb_checkpoints/a.json", "replay/notes.txt", f"{ROWS[0]}.bak", "replay/model-1.zip", f"{OLD}/notes",
        "replay/a/model-000000000000-000000000010.zip", "0.monitor.csv", "run.json", "best_model.zip", "checkpoint-a/b",
        ".writing/a", ".removed/a", "checkpoint-latest", "replay/.hidden", "replay/other-000000000000.zip", "Makefile",
    )  # fmt: skip
    chosen = tuple(rng.sample(names, rng.choice([1, 2, 5])))

    def change(run: Path, elsewhere: Path) -> None:
        for name in chosen:
            (run / name).parent.mkdir(parents=True, exist_ok=True)
            (run / name).write_text(f"the user's {name}")

    # What lies in a checkpoint's folder goes where that goes when the checkpoint is old.
    return Case(f"{chosen} beside", change, True, tuple(name for name in chosen if not name.startswith((OLD, NEW))))


# ---------------------------------------------------------------- manifests, behind their right checksums


def _hostile(rng: random.Random) -> Any:
    return rng.choice([
        lambda: None, lambda: True, lambda: rng.choice([0, -1, 0.5, 1e308]), lambda: rng.choice(HUGE), lambda: [],
        lambda: {}, lambda: -rng.choice(HUGE), lambda: rng.choice(["", "x", "\0", "é" * 2000, "\ud800", "a/b"]),
        lambda: "../../elsewhere/profile", lambda: "/etc/passwd", lambda: {"size": 0, "sha256": "0" * 64},
        lambda: {"size": 20, "sha256": None}, lambda: [[]] * 10, lambda: "1" * 5000,
        lambda: {"ring": "../x", "first": 0, "last": 1, "size": 0, "sha256": "0" * 64},
        lambda: {"ring": "x" * 400, "first": 0, "last": 10**18, "size": 0, "sha256": "0" * 64},
    ])()  # fmt: skip


def manifest(rng: random.Random, original: dict[str, bytes]) -> Case:
    """Anything in a manifest replaced, removed, renamed or exchanged."""
    which = rng.choice([OLD, NEW, NEW])
    content = json.loads(original[f"{which}/manifest.json"])
    del content["sha256"]
    found = [path for path in places(content) if path]
    path, what = rng.choice(found), rng.choice(["value", "value", "remove", "rename", "exchange"])
    parent, value = at(content, path[:-1]), _hostile(rng)
    match what:
        case "value":
            parent[path[-1]] = value
        case "remove":
            del parent[path[-1]]
        case "rename":
            parent[rng.choice(["../x", "/x", "", "model.zip", ROWS[0], "x" * 500, "\ud800"])] = parent.pop(path[-1])
        case _:
            parent[path[-1]] = json.loads(json.dumps(at(content, rng.choice(found))))

    def change(run: Path, elsewhere: Path) -> None:
        (run / which / "manifest.json").write_bytes(manifest_text(content))

    # What it says of where and how a run was made is no part of what is learned.
    return Case(f"the manifest of {which}: {what} at {path} {value!r:.100}", change, True)


def manifest_bytes(rng: random.Random, original: dict[str, bytes]) -> Case:
    """A manifest that is none, or too much, with the right checksum where it can have one."""
    body = rng.choice([
        b"[" * 10**5, b'{"a":' * 10**5, b'{"a": [' + b"[]," * 10**6 + b"[]]", b'{"a": "' + b"x" * 10**7 + b'"',
        b"{" + b",".join(b'"%d":%d' % (i, i) for i in range(10**6)), b"{" + b'"a": NaN', b"{" + b'"a": ' + b"9" * 10**6,
        b"\xff", b"", b"null", b"{" * 10**6, b'{"steps": ' + b"[" * 900 + b"]" * 900,
        b"{" + b",".join(b'"%06d":"%014d"' % (i, i) for i in range(6 * 10**5)),
        b'{"segments": {' + b",".join(b'"%d": {}' % i for i in range(10**6)) + b"}",
    ])  # fmt: skip
    whole = body + b"\n}"
    text = body + b',\n "sha256": "' + hashlib.sha256(whole).hexdigest().encode() + b'"\n}'

    def change(run: Path, elsewhere: Path) -> None:
        (run / NEW / "manifest.json").write_bytes(text)

    return Case(f"a manifest of {len(text)} bytes {body[:20]!r}", change, True)


# ---------------------------------------------------------------- contents, behind right checksums everywhere


def contents(rng: random.Random, original: dict[str, bytes]) -> Case:
    """The families of hostile files in the places of a checkpoint's."""
    name = rng.choice([f"{NEW}/state.zip", f"{NEW}/state.zip", f"{NEW}/model.zip", rng.choice(ROWS)])
    case = case_of(rng.randrange(2**40), rng.randrange(15), Original(name, original[name]))
    return Case(f"{name}: {case.words}", lambda run, elsewhere: replaced(run, name, case.data), case.damaged)


#: Names that a file could give to what a program writes to.
PLACES = ("../elsewhere", "../elsewhere/profile", "../elsewhere/best_model.zip", "../elsewhere/theirs/new")


def paths(rng: random.Random, original: dict[str, bytes]) -> Case:
    """Names of files in the state, of callbacks above all."""
    name = f"{NEW}/state.zip"
    file = Original(name, original[name])
    content = json.loads(json.dumps(file.content))
    texts = [path for path in places(content["tree"]) if path and isinstance(at(content["tree"], path), str)]
    callbacks = _inside(content["tree"], "callbacks")
    where = rng.choice(sorted(_inside(content["tree"], "callbacks")))
    attributes = _dict(_dict(callbacks[where])["attributes"])
    said = rng.choice(PLACES)
    attribute = rng.choice([
        "best_model_save_path", "log_path", "save_path", "csv", "names", "target", "name_prefix", "_file", "filename",
        "model", "logger", "eval_env", "_on_step", "on_step", "callback", "locals", "__class__", "__dict__",
    ])  # fmt: skip
    value: Any = rng.choice([
        {"dict": {"value": said}}, {"dict": {"value": [said]}}, {"dict": {"id": 10**6, "list": [{"dict": {
            "value": said}}]}}, {"dict": {"value": {"bytes": "Li4vZWxzZXdoZXJl"}}}, {"dict": {"value": "profile"}},
    ])  # fmt: skip
    attributes[attribute] = value
    if rng.random() < 0.3:
        path = rng.choice(texts)
        at(content["tree"], path[:-1])[path[-1]] = said
    from tests.saving.hostile import with_entries

    data = with_entries(file, data=json.dumps(content).encode())
    words = f"{where}.{attribute} = {value!r:.100}"
    return Case(words, lambda run, elsewhere: replaced(run, name, data), False)


def _dict(tree: Any) -> dict[str, Any]:
    return tree["dict"] if tree.keys() == {"dict"} else tree


def _inside(tree: Any, key: str) -> dict[str, Any]:
    return _dict(_dict(tree)[key])


FAMILIES: tuple[Callable[[random.Random, dict[str, bytes]], Case], ...] = (
    damaged, damaged, missing, kinds, kinds, kinds, coming, coming, beside, manifest, manifest, manifest_bytes,
    contents, contents, contents, paths, paths,
)  # fmt: skip


def folder_case(seed: int, number: int, original: dict[str, bytes]) -> Case:
    """The same case for the same numbers; one of each family in turn."""
    return FAMILIES[number % len(FAMILIES)](random.Random(f"{seed}/{number}"), original)


# ---------------------------------------------------------------- what was touched


def snapshot(folder: Path) -> dict[str, Any]:
    """Everything below a folder, with what tells whether somebody has written to it."""
    return dict(_entries(folder, folder))


def _entries(folder: Path, top: Path) -> Iterator[tuple[str, Any]]:
    for path in sorted(folder.iterdir()):
        facts = path.lstat()
        what: Any = (facts.st_mode, facts.st_size if not path.is_dir() else 0, facts.st_mtime_ns)
        if path.is_symlink():
            what = (*what, os.readlink(path))
        elif path.is_file():
            what = (*what, path.read_bytes() if facts.st_size < 10**6 else None)
        yield str(path.relative_to(top)), what
        if path.is_dir() and not path.is_symlink():
            try:
                yield from _entries(path, top)
            except OSError as error:
                if error.errno != errno.EACCES:
                    raise
