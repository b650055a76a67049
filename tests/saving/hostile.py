"""Damaged, truncated and hostile files, made from a seed, and what is kept of an attempt to load one."""

import hashlib
import io
import json
import os
import pickle
import pkgutil
import random
import stat
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from sb3_sample.saving.classes import PACKAGES
from sb3_sample.saving.container import CHECKSUMS, DATA, TENSORS

#: A folder that a payload makes in the present one when it runs.
MARKER = "a_payload_ran"
HUGE = (10**4, 10**5, 10**6, 10**7, 10**9, 2**31, 2**40, 10**18, 2**63 - 1)
#: Attributes, and keys in them, whose number decides what is allocated.
SIZES = (
    "net_arch", "n_critics", "n_quantiles", "width", "n_blocks", "depth", "model_size", "n_envs", "buffer_size",
    "batch_size", "n_steps", "n_epochs", "share_features_extractor", "_stats_window_size", "dynamics_buffer_size",
    "n_simulated", "horizon", "n_models", "target_subset", "replay_ratio", "gradient_steps", "policy_delay",
)  # fmt: skip
DANGEROUS = (
    "os:system", "posix:system", "subprocess:Popen", "builtins:eval", "builtins:exec", "torch.hub:load", "torch:load",
    "pickle:loads", "shutil:rmtree", "importlib:import_module", "antigravity:fly", "this:s", "nt:system",
    "sb3_sample.__main__:main", "sb3_sample.saving.model:os", "sb3_sample.saving.container:os.system",
    "torch.nn.modules.module:warnings", "torch.nn.modules:_functions", "torch.nn.modules.lazy:LazyModuleMixin",
    "torch.nn.parallel.data_parallel:DataParallel", "torch.nn.parallel.distributed:DistributedDataParallel",
    "stable_baselines3.common.vec_env.subproc_vec_env:SubprocVecEnv", "torch.nn.modules.module:Module",
    "stable_baselines3.common.save_util:load_from_pkl", "stable_baselines3.common.policies:_x",
    "torch.nn.modules.linear:Linear.forward", "torch.nn.modules.linear:__builtins__", "torch.nn..modules:Linear",
    "torch.nn.modules.container:Sequential", "torch.nn.modules.transformer:Transformer", "torch.nn.init:xavier_normal_",
    "torch.nn:__loader__", "", ":", "a:", ":b", "é:ü", "torch.nn.modules.linear:Linear\n", "x" * 5000 + ":y",
    "rl_zoo3.exp_manager:ExperimentManager", "torch.distributed.run:main", "../evil:x", "/etc/passwd:x",
    "torch.optim.lbfgs:LBFGS", "torch.optim.swa_utils:AveragedModel", "stable_baselines3.sac.policies:SACPolicy",
    "stable_baselines3.common.buffers:RolloutBuffer", "stable_baselines3.common.torch_layers:NatureCNN",
)  # fmt: skip


class Payload:
    """What a pickle of it does when it is read: it makes a folder."""

    def __init__(self, call: Callable[..., Any] = os.mkdir, argument: str = MARKER):
        self.call, self.argument = call, argument

    def __reduce__(self) -> Any:
        return self.call, (self.argument,)


@dataclass
class Original:
    """A good file, of which bad ones are made."""

    name: str
    data: bytes

    def __post_init__(self) -> None:
        with zipfile.ZipFile(io.BytesIO(self.data)) as archive:
            self.entries = {name: archive.read(name) for name in archive.namelist()}
        self.content = json.loads(self.entries[DATA])
        length = struct.unpack("<Q", self.entries[TENSORS][:8])[0]
        self.header = json.loads(self.entries[TENSORS][8 : 8 + length])
        self.numbers = self.entries[TENSORS][8 + length :]


@dataclass
class Case:
    """
    A bad file.

    :param words: what is bad
    :param data: its bytes
    :param damaged: whether its checksums are those of the good file, so that what loads must be equal to that
    """

    words: str
    data: bytes
    damaged: bool


# ---------------------------------------------------------------- the pieces


def archive_of(entries: list[tuple[Any, bytes]], **how: Any) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in entries:
            archive.writestr(name if isinstance(name, zipfile.ZipInfo) else zipfile.ZipInfo(name), data, **how)
    return file.getvalue()


def with_entries(original: Original, honest: bool = True, **changes: bytes) -> bytes:
    """The file with ``data``, ``tensors`` or ``checksums`` replaced; the checksums are right if ``honest``."""
    names = {"data": DATA, "tensors": TENSORS, "checksums": CHECKSUMS}
    entries = {**original.entries, **{names[key]: value for key, value in changes.items()}}
    if honest and "checksums" not in changes:
        sums = {name: hashlib.sha256(entries[name]).hexdigest() for name in (DATA, TENSORS)}
        entries[CHECKSUMS] = json.dumps(sums).encode()
    return archive_of(list(entries.items()))


def tensor_file(header: Any, numbers: bytes) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + numbers


def places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The path of everything in a tree of JSON."""
    inside = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path, *(place for key, item in inside for place in places(item, (*path, key)))]


def at(tree: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        tree = tree[key]
    return tree


def deep(levels: int, kind: str) -> Any:
    tree: Any = 1
    for _ in range(levels):
        tree = [tree] if kind == "list" else {kind: {"a": tree} if kind == "dict" else [tree]}
    return tree


def hostile_value(rng: random.Random, original: Original) -> Any:
    """A value of JSON that hardly belongs where it will stand."""
    tensor = rng.choice([*original.header, "not there"])
    return rng.choice([
        lambda: None, lambda: rng.random() < 0.5, lambda: rng.choice([0, -1, 1, 2, -(2**63)]), lambda: rng.choice(HUGE),
        lambda: -rng.choice(HUGE), lambda: rng.choice([0.5, -0.0, 1e308, -1e308, 1e-320]), lambda: [], lambda: {},
        lambda: rng.choice(["", "x", "auto", "cuda", "auto_1e400", "\0", "../../evil", "\ud800", "é" * 2000]),
        lambda: {"int": rng.choice(["0x" + "f" * 100_000, "1" * 6000, "-0x0", "x", "", 3, None])},
        lambda: {"float": rng.choice(["nan", "inf", "-inf", "x", 3])}, lambda: [None] * 1000, lambda: [[]] * 10,
        lambda: {"import": rng.choice(DANGEROUS)}, lambda: {"import": rng.choice([3, None, [], {}])},
        lambda: {"tensor": tensor}, lambda: {"array": tensor}, lambda: {"tensor": tensor, "requires_grad": "x"},
        lambda: {"raw_array": tensor, "dtype": rng.choice(["|O", "<f8", "<U9", "<f99"]),
                 "shape": [rng.choice(HUGE)]},
        lambda: {"bytes": rng.choice(["AAAA", "!", 3])},
        lambda: {"tuple": rng.choice([[], 3, [1, 2], [{"set": [[]]}]])},
        lambda: {"set": rng.choice([[[1]], [{"dict": {}}], 3])}, lambda: {"complex": [1, "x"]},
        lambda: {"deque": [1, 2], "maxlen": rng.choice([*HUGE, -1, 1, None, "x", True])},
        lambda: {"dict_items": rng.choice([[[[], 1]], [[1]], 3, [[{"float": "nan"}, 1]] * 3, [3]])},
        lambda: {"dict": rng.choice([[], 3, {"": None}, {"__class__": 1}, {"device": "cuda"}])}, lambda: {"unknown": 1},
        lambda: {"scalar": rng.choice([["<f8", "x"], ["<i1", 1000], ["|O", 1], ["<M8[s]", 1], 3, []])},
        lambda: {"scalar_bytes": [rng.choice(["|O", "<U1", "|V0", "<c16"]), rng.choice(["AAAA", "/////w==", ""])]},
        lambda: {"dtype": rng.choice(["|O", "<f4", "O", "<U999999999", "i4,O", 3])},
        lambda: {"numpy_type": rng.choice(["|O", "<f4", "x"])},
        lambda: {"torch_dtype": rng.choice(["load", "float32"])},
        lambda: {"device": rng.choice(["cuda:99", "meta", "cpu", "x", "mps", "xla", 3])},
        lambda: {"object": rng.choice([
            "stable_baselines3.common.utils:ConstantSchedule", "os:system", "subprocess:Popen", 3,
            "stable_baselines3.common.noise:VectorizedActionNoise"]), "attributes": rng.choice([{}, 3, {"val": "x"}, {
                "n_envs": 10**9, "_base_noise": None, "_noises": []}])},
        lambda: {"instance": rng.choice([*DANGEROUS, 3, "sb3_sample.learner.plasticity:ReDo", "threading:Thread"]),
                 "attributes": rng.choice([{}, 3, {"run": 1}, {"__class__": 1}])},
        lambda: {"left_out": rng.choice(["", "x" * 5000, 3, None, {}])}, lambda: {"path": rng.choice(["", "../x", 3])},
        lambda: {"numbers": tensor}, lambda: {"own": {"critic": {"dict": {}}}},
        lambda: {"enum": rng.choice(["signal:Signals", "stable_baselines3.common.type_aliases:TrainFrequencyUnit"]),
                 "member": rng.choice(["STEP", "__class__", "mro", 3])},
        lambda: {"named_tuple": rng.choice(["os:stat_result", "stable_baselines3.common.type_aliases:TrainFreq"]),
                 "items": rng.choice([[], [1, 2], [{"float": "nan"}], 3])},
        lambda: {"space": rng.choice(["Box", "Discrete", "MultiBinary", "MultiDiscrete", "Dict", "Text", "Graph"]),
                 "arguments": rng.choice([{}, {"n": rng.choice(HUGE)}, {"n": -1, "start": 0}, {"spaces": [["a", 1]]},
                                          {"n": {"tuple": [10**5, 10**5]}}, {"nvec": [rng.choice(HUGE)] * 3}]),
                 "np_random": None},
        lambda: {"numpy_random": "Generator", "state": {"dict": rng.choice([{}, {"bit_generator": "PCG64"}, {
            "bit_generator": "MT19937", "state": {"dict": {"pos": 10**6, "key": {"array": tensor}}}}])}},
        lambda: {"random": rng.choice([[3, {"array": tensor}, None], 3])},
        lambda: {"torch_generator": {"tensor": tensor}, "device": rng.choice(["cpu", "cuda", "x"])},
        lambda: deep(rng.choice([10, 59, 61, 200, 400]), rng.choice(["list", "tuple", "dict"])),
    ])()  # fmt: skip


# ---------------------------------------------------------------- the families


def truncated(rng: random.Random, original: Original) -> Case:
    n = rng.randrange(len(original.data))
    return Case(f"truncated to {n} bytes", original.data[:n], True)


def flipped(rng: random.Random, original: Original) -> Case:
    if rng.random() < 0.3:
        # The archive's own checksums right, as after a repair.
        name = rng.choice(["data", "tensors"])
        entry = bytearray(original.entries[{"data": DATA, "tensors": TENSORS}[name]])
        place = rng.randrange(len(entry) // 2, len(entry))
        entry[place] ^= 1
        return Case(f"a bit of {name} flipped at {place}", with_entries(original, False, **{name: bytes(entry)}), True)
    data = bytearray(original.data)
    # The tables at the end are a small part of the bytes and the larger part of what can go wrong.
    start = rng.choice([0, 0, len(data) - 400])
    n = rng.choice([1, 1, 2, 8, 100])
    for _ in range(n):
        data[rng.randrange(start, len(data))] ^= 1 << rng.randrange(8)
    return Case(f"{n} bits flipped from {start} on", bytes(data), True)


def overwritten(rng: random.Random, original: Original) -> Case:
    data = bytearray(original.data)
    n = rng.choice([1, 4, 64, 4096])
    start = rng.randrange(len(data))
    piece = rng.choice([b"\0" * n, b"\xff" * n, rng.randbytes(n), bytes(data[: n // 2])])
    match rng.choice(["over", "insert", "remove", "append", "prepend"]):
        case "over":
            data[start : start + len(piece)] = piece
        case "insert":
            data[start:start] = piece
        case "remove":
            del data[start : start + n]
        case "append":
            data += piece
        case _:
            data[:0] = piece
    return Case(f"{n} bytes changed at {start}", bytes(data), True)


def entries(rng: random.Random, original: Original) -> Case:
    """Swapped, doubled, renamed, missing and further entries; links; names that lead elsewhere; bombs."""
    items: list[tuple[Any, bytes]] = list(original.entries.items())
    i, other = rng.sample(range(len(items)), 2)
    what = rng.choice(["swap", "double", "rename", "drop", "more", "link", "bomb", "order", "encrypt", "comment"])
    how: dict[str, Any] = {}
    name = rng.choice([
        "../evil", "/etc/evil", "..\\evil", "C:\\evil", "a/../../evil", "policy.pth", "data", "data.pkl", "data.json/",
        "DATA.JSON", "data.json\0.pkl", "", "x" * 60_000, "archive/data.pkl", "é", "./data.json", "__init__.py",
    ])  # fmt: skip
    match what:
        case "swap":
            items[i], items[other] = (items[i][0], items[other][1]), (items[other][0], items[i][1])
        case "double":
            items.append(items[i] if rng.random() < 0.5 else (items[i][0], items[other][1]))
        case "rename":
            items[i] = (name, items[i][1])
        case "drop":
            del items[i]
        case "more":
            items += [(name, rng.choice([b"", pickle.dumps(Payload()), rng.randbytes(50)]))] * rng.choice([1, 1, 2000])
        case "link":
            info = zipfile.ZipInfo(items[i][0])
            info.external_attr = (stat.S_IFLNK | 0o777) << 16
            items[i] = (info, items[i][1] if rng.random() < 0.3 else b"/etc/passwd")
        case "bomb":
            size = rng.choice([10**5, 10**7, 3 * 10**7])
            items[i] = (items[i][0], rng.choice([b" ", b"[", b"\0"]) * size)
            how["compress_type"] = rng.choice([zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
        case "order":
            rng.shuffle(items)
    data = bytearray(archive_of(items, **how))
    table = data.rindex(b"PK\x01\x02")
    if what == "encrypt":
        data[table + 8] |= 1
    elif what == "comment":
        comment = rng.choice([b"x", original.data, b"PK\x05\x06" + b"\0" * 18])[: 2**16 - 1]
        data[-2:] = struct.pack("<H", len(comment))
        data += comment
    return Case(f"entries: {what} {name[:20] if what in ('rename', 'more') else ''}", bytes(data), True)


def table(rng: random.Random, original: Original) -> Case:
    """Lies in the zip's own tables: sizes, places, checksums, methods, counts, lengths of names."""
    data = bytearray(original.data)
    n_bytes = rng.choice([2, 4, 4, 8])
    value = rng.choice([0, 1, 2, len(data), len(data) - 1, 2**31 - 1, 2**32 - 2, 2**32 - 1, rng.randrange(2**32)])
    signature, span = rng.choice([(b"PK\x01\x02", 46), (b"PK\x03\x04", 30), (b"PK\x05\x06", 22)])
    starts, start = [], data.find(signature)
    while start >= 0:
        starts.append(start)
        start = data.find(signature, start + 1)
    place = rng.choice(starts) + rng.randrange(4, span, 2)
    data[place : place + n_bytes] = (value % 2 ** (8 * n_bytes)).to_bytes(n_bytes, "little")
    return Case(f"{value} in {n_bytes} bytes at {place} of the tables", bytes(data[: len(original.data)]), True)


def tensor_header(rng: random.Random, original: Original) -> Case:
    """A header of tensors that lies, behind right checksums."""
    header = json.loads(json.dumps(original.header))
    numbers, key = original.numbers, rng.choice(list(header))
    entry, other = header[key], header[rng.choice(list(header))]
    what = rng.choice(
        ["offsets", "shape", "dtype", "overlap", "length", "text", "numbers", "drop", "name", "keys", "deep"]
    )
    content: bytes | None = None
    match what:
        case "offsets":
            entry["data_offsets"] = rng.choice([
                [0, rng.choice(HUGE)], [-4, 4], [2**64, 2**64 + 4], entry["data_offsets"][::-1], [0], None, "x",
                [0.5, 4], [[], []], {"a": 1}, [entry["data_offsets"][0], entry["data_offsets"][1] + 1],
            ])  # fmt: skip
        case "shape":
            entry["shape"] = rng.choice([
                [rng.choice(HUGE)], [rng.choice(HUGE)] * 4, [0, 2**62], [-1], [1.5], ["8"], None, [[8]], [1] * 70,
                [*entry["shape"], 1], entry["shape"][::-1], [10**4000], [True], 8, [2**32, 2**32, 0],
            ])  # fmt: skip
        case "dtype":
            entry["dtype"] = rng.choice(
                ["F64", "I8", "U64", "BOOL", "C64", "F8_E5M2", "BF16", "F128", "O", None, 3, []]
            )
        case "overlap":
            entry["data_offsets"] = other["data_offsets"]
        case "length":
            claimed = rng.choice([0, 1, 7, 2**20, 2**31, 2**63, 2**64 - 1, len(numbers)])
            content = struct.pack("<Q", claimed) + json.dumps(header).encode() + numbers
        case "text":
            text = rng.choice(
                [b"", b"{", b"[]", b"null", b"[" * 10**5, b'{"a":' * 10**5, b"9" * 10**5, b"\xff\xfe", b"NaN"]
            )
            content = tensor_file(text, numbers)
        case "numbers":
            numbers = rng.choice([b"", numbers[:-1], numbers + b"\0", numbers * 2])
        case "drop":
            del header[key]
        case "name":
            header = {
                rng.choice(["", "x", "__metadata__", "\ud800", "../x"]) if k == key else k: v for k, v in header.items()
            }
        case "keys":
            entry[rng.choice(["more", "dtype "])] = 1
        case _:
            header[key] = deep(rng.choice([50, 200, 400]), "list")
    content = tensor_file(header, numbers) if content is None else content
    return Case(f"tensors: {what} of {key}", with_entries(original, tensors=content), False)


def tensor_values(rng: random.Random, original: Original) -> Case:
    """Numbers that are none, of another kind or shape, tensors that are missing, exchanged or too many."""
    from sb3_sample.saving import container

    _, tensors = container.read(io.BytesIO(original.data), original.content["kind"])
    key, other = rng.choice(list(tensors)), rng.choice(list(tensors))
    tensor = tensors[key]
    what = rng.choice(["nan", "nan", "inf", "drop", "more", "swap", "dtype", "shape", "empty", "large", "scalar"])
    match what:
        case "nan" | "inf":
            if tensor.is_floating_point() and tensor.numel():
                tensor.view(-1)[rng.randrange(tensor.numel())] = float(what)
        case "drop":
            del tensors[key]
        case "more":
            tensors["more"] = torch.zeros(rng.choice([0, 1, 10**5]))
        case "swap":
            tensors[key], tensors[other] = tensors[other], tensors[key]
        case "dtype":
            tensors[key] = tensor.to(
                rng.choice([torch.float64, torch.int64, torch.bool, torch.complex64, torch.bfloat16])
            )
        case "shape":
            tensors[key] = rng.choice(
                [tensor.flatten(), tensor[None], tensor.flatten()[:1], torch.cat([tensor.flatten()] * 2)]
            )
        case "empty":
            tensors[key] = tensor.new_zeros(rng.choice([(0,), (0, 10**6), (10**6, 0)]))
        case "large":
            tensors[key] = torch.zeros(10**5)
        case _:
            tensors[key] = torch.tensor(rng.choice([0, -1, 10**9, 1e30]))
    file = io.BytesIO()
    container.write(file, original.content["kind"], original.content["tree"], tensors)
    return Case(f"values: {what} of {key}, {other}", file.getvalue(), False)


def tree(rng: random.Random, original: Original) -> Case:
    """Anything in data.json replaced, removed, doubled or exchanged, behind right checksums."""
    content = json.loads(json.dumps(original.content))
    inside = content["tree"]
    attributes = inside.get("attributes", inside) if isinstance(inside, dict) else inside
    # Half the time a whole attribute, so that each has its turn; else anything.
    options = (
        [p for p in places(attributes) if len(p) == 1] if rng.random() < 0.5 else [p for p in places(content) if p]
    )
    root = attributes if options and len(options[0]) == 1 and options[0][0] in attributes else content
    path = rng.choice(options)
    parent, what = at(root, path[:-1]), rng.choice(["value", "value", "value", "value", "remove", "exchange", "more"])
    value: Any = None
    match what:
        case "value":
            value = parent[path[-1]] = hostile_value(rng, original)
        case "remove":
            del parent[path[-1]]
        case "exchange":
            value = parent[path[-1]] = json.loads(json.dumps(at(root, rng.choice(options))))
        case _ if isinstance(parent, dict):
            key = rng.choice(
                [
                    "__class__",
                    "predict",
                    "_setup_model",
                    "env",
                    "x",
                    "a.b",
                    "",
                    "__dict__",
                    "policy",
                    "device",
                    "own",
                    "temperature_beta1",
                    "policy_aliases",
                    "_trusted_modules",
                    "_metrics",
                ]
            )
            value = parent[key] = hostile_value(rng, original)
        case _:
            parent.append(hostile_value(rng, original))
    # At times the archive's checksums are right, and only ours are not.
    honest = rng.random() < 0.9
    text = json.dumps(content).encode()
    words = f"tree: {what} at {path} {value!r:.150}{'' if honest else ', checksums kept'}"
    return Case(words, with_entries(original, honest, data=text), not honest)


def sizes(rng: random.Random, original: Original) -> Case:
    """Numbers from which a program would make gigabytes or work for hours."""
    content = json.loads(json.dumps(original.content))
    attributes = content["tree"].get("attributes", {}) if isinstance(content["tree"], dict) else {}
    key, huge = rng.choice(SIZES), rng.choice(HUGE)
    value: Any = rng.choice([
        lambda: huge, lambda: [huge], lambda: [huge, huge], lambda: [8] * min(huge, 10**5), lambda: -huge,
        lambda: {"tuple": [huge, 1]}, lambda: {"tuple": [1, huge]}, lambda: float(huge),
        lambda: {"dict": {"pi": [huge], "vf": [1], "qf": [1]}},
    ])()  # fmt: skip
    nested = [name for name in attributes if name.endswith("_kwargs")]
    owner = rng.choice([None, *nested]) if nested else None
    present = [p for p in places(attributes) if p and p[-1] in SIZES]
    if present and rng.random() < 0.5:
        path = rng.choice(present)
        at(attributes, path[:-1])[path[-1]] = value
        owner, key = None, str(path)
    elif key in attributes and owner is None:
        attributes[key] = value
    elif owner is not None:
        held = attributes[owner]["dict"] if isinstance(attributes[owner], dict) and "dict" in attributes[owner] else {}
        inner = rng.choice([None, *(name for name in held if isinstance(held[name], dict) and "dict" in held[name])])
        (held if inner is None else held[inner]["dict"])[key] = value
        attributes[owner] = {"dict": held}
    else:
        numbers = [p for p in places(content["tree"]) if p and type(at(content["tree"], p)) is int]
        path = rng.choice(numbers or [p for p in places(content["tree"]) if p])
        at(content["tree"], path[:-1])[path[-1]] = value
        key = str(path)
    words = f"sizes: {owner}.{key} = {value!r:.100}"
    return Case(words, with_entries(original, data=json.dumps(content).encode()), False)


def text(rng: random.Random, original: Original) -> Case:
    """JSON that is none, or too much."""
    whole = original.entries[DATA]
    half = rng.randrange(1, len(whole))
    data = rng.choice([
        b"", whole[:half], b"[" * 10**5, b'{"a":' * 10**5, b"[" * 900 + b"]" * 900, b"9" * 10**6, b"NaN", b"null",
        b"\xff", b"[1e999]", whole.replace(b":0,", b":NaN,", 1), whole.replace(b":0,", b":" + b"1" * 5000 + b",", 1),
        b'"' + b"x" * (9 * 2**20) + b'"', b"[" + b"[]," * 10**6 + b"[]]", b"\xef\xbb\xbf" + whole, whole * 2,
        whole.replace(b'"kind"', b'"kind":1,"kind"', 1), whole.decode().encode("utf-16"), b"{" * 10**6,
    ])  # fmt: skip
    return Case(f"JSON {data[:30]!r}...", with_entries(original, data=data), False)


def pickles(rng: random.Random, original: Original) -> Case:
    """Payloads as the whole file, as an entry, behind our entries' names."""
    payload = pickle.dumps(
        rng.choice([Payload(), Payload(os.system, f"mkdir {MARKER}"), [Payload()], {"data": Payload()}]),
        protocol=rng.choice([0, 2, 4, 5]),
    )
    file = io.BytesIO()
    torch.save(Payload(), file, _use_new_zipfile_serialization=rng.random() < 0.7)
    data = rng.choice([
        payload, file.getvalue(), payload + original.data, original.data + payload, b"\x80\x04" + payload,
        archive_of([("data", payload), ("policy.pth", file.getvalue())]),
        archive_of([*original.entries.items(), ("data.pkl", payload)]),
        archive_of([*original.entries.items(), ("pytorch_variables.pth", file.getvalue())]),
        with_entries(original, data=payload), with_entries(original, tensors=payload),
        with_entries(original, checksums=payload), with_entries(original, tensors=file.getvalue()),
    ])  # fmt: skip
    return Case(f"pickle of {len(payload)} bytes, {data[:2]!r}...", data, False)


def _modules() -> list[str]:
    found = []
    for package in PACKAGES:
        # Packages are found by their files, without importing what is in them.
        top = __import__(package.split(".")[0])
        for part in package.split(".")[1:]:
            top = getattr(top, part)
        waiting = [(list(top.__path__), package)]
        while waiting:
            path, prefix = waiting.pop()
            for module in pkgutil.iter_modules(path):
                found.append(f"{prefix}.{module.name}")
                if module.ispkg:
                    waiting.append(([os.path.join(p, module.name) for p in path], f"{prefix}.{module.name}"))
    return sorted(found)


MODULES: list[str] = []


def imports(rng: random.Random, original: Original) -> Case:
    """A path of any module of the packages that a file may name, for what it does and how long it takes to import."""
    if not MODULES:
        MODULES.extend(_modules())
    path = rng.choice([*DANGEROUS, *(f"{module}:Main" for module in MODULES)])
    content = json.loads(json.dumps(original.content))
    options = [p for p in places(content["tree"]) if p and p[-1] == "import"] or [
        p for p in places(content["tree"]) if p
    ]
    place = rng.choice(options)
    at(content["tree"], place[:-1])[place[-1]] = path if place[-1] == "import" else {"import": path}
    return Case(f"import {path!r:.80} at {place}", with_entries(original, data=json.dumps(content).encode()), False)


FAMILIES: tuple[Callable[[random.Random, Original], Case], ...] = (
    truncated, flipped, overwritten, entries, table, tensor_header, tensor_values, tree, tree, tree, sizes, sizes, text,
    pickles, imports,
)  # fmt: skip


def case_of(seed: int, number: int, original: Original) -> Case:
    """The same case for the same numbers; one of each family in turn."""
    family = FAMILIES[number % len(FAMILIES)]
    return family(random.Random(f"{seed}/{number}/{original.name}"), original)
