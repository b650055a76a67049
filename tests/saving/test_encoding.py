"""Values in files that run no code: what comes back is what was given, and nothing else gets in."""

import collections
import enum
import functools
import json
import math
import random
import subprocess
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy
from torch import nn

from sb3_sample.sac.policies import SACPolicy
from sb3_sample.saving import container
from sb3_sample.saving.classes import MAX_DEPTH
from sb3_sample.saving.container import BadFile
from sb3_sample.saving.decoding import NotTrusted
from sb3_sample.saving.encoding import Encoder, Lenient, NotPortable, decode, encode, is_left_out
from sb3_sample.saving.schedules import ScheduleTable

G = np.random.default_rng(0)


def through_a_file(value: Any, tmp_path: Path, trusted: tuple[str, ...] = ()) -> Any:
    tensors: dict[str, torch.Tensor] = {}
    tree = encode(value, "value", tensors)
    container.write(tmp_path / "f", "test", tree, tensors)
    read_tree, read = container.read(tmp_path / "f", "test")
    decoded = decode(read_tree, read, "value", trusted)
    assert not read
    return decoded


def same(a: Any, b: Any) -> bool:
    """Equal in value and exact type, bit by bit."""
    if type(a) is not type(b):
        return False
    if isinstance(a, float):
        return (math.isnan(a) and math.isnan(b)) or (a == b and math.copysign(1, a) == math.copysign(1, b))
    if isinstance(a, complex):
        return same((a.real, a.imag), (b.real, b.imag))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, np.generic):
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if isinstance(a, torch.Tensor):
        equal = a.dtype == b.dtype and a.shape == b.shape and a.requires_grad == b.requires_grad
        x, y = (t.detach().resolve_conj().reshape(-1).view(torch.uint8).numpy() for t in (a, b))
        return equal and same(x, y)
    if isinstance(a, dict):
        return same(list(a.items()), list(b.items()))
    if isinstance(a, (set, frozenset)):
        return a == b and sorted(map(repr, a)) == sorted(map(repr, b))
    if isinstance(a, collections.deque):
        return a.maxlen == b.maxlen and same(list(a), list(b))
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, spaces.Space):
        return a == b and same(a._np_random, b._np_random) and repr(a) == repr(b)
    if isinstance(a, np.random.Generator):
        return same(a.bit_generator.state, b.bit_generator.state)
    if isinstance(a, np.random.RandomState):
        return same(a.get_state(legacy=False), b.get_state(legacy=False))
    if isinstance(a, random.Random):
        return a.getstate() == b.getstate()
    if isinstance(a, torch.Generator):
        return torch.equal(a.get_state(), b.get_state())
    if type(a).__eq__ is object.__eq__ and hasattr(a, "__dict__") and not isinstance(a, type):
        return same(vars(a), vars(b))
    return bool(a == b)


def drawn_from(generator: Any) -> Any:
    generator.random(7)
    return generator


def seeded(space: spaces.Space, seed: int = 3) -> spaces.Space:
    space.seed(seed)
    space.sample()
    return space


VALUES: list[Any] = [
    None, True, False, 0, -1, 2**63 - 1, 2**63, -(2**63), -(2**63) - 1, 1 << 20_000, 0.1, -0.0, 1e-310, math.inf,
    -math.inf, math.nan, "", "ä\ud800\0\n", b"", b"\0\xff", 1 + 2j, complex(math.nan, -math.inf),
    [], [[], [1, [2.0]]], (), (1, (2, [3])), {}, {"a": 1, "tuple": (1,)},
    {1: "a", (1, 2): [3], None: 4, 2.5: 5, "x": 6.0},
    collections.OrderedDict(b=1, a=2), collections.OrderedDict({1: 2}), set(), {1, "a", (2, 3)}, frozenset({1}),
    collections.deque([1, {"r": 2.0}], maxlen=5), collections.deque(),
    np.float32(0.1), np.float64(math.nan), np.int8(-3), np.uint64(2**64 - 1), np.bool_(True), np.float16(math.inf),
    np.str_("é"), np.complex64(1j), np.datetime64("2020-01-01"), np.longdouble("0.1"), np.bytes_(b"ab"),
    np.float32, np.bool_, np.dtype("float32"), np.dtype(">i4"), np.dtype("<U3"),
    torch.float32, torch.bfloat16, torch.device("cpu"), torch.device("cuda", 1),
    TrainFreq(3, TrainFrequencyUnit.EPISODE), TrainFrequencyUnit.STEP, GoalSelectionStrategy.FUTURE,
    ConstantSchedule(0.1), LinearSchedule(1e-3, 0.0, 0.5), FloatSchedule(3e-4), FloatSchedule(LinearSchedule(1, 0, 1)),
    NormalActionNoise(np.zeros(2), np.ones(2)), NormalActionNoise(np.zeros(2), np.ones(2), "float64"),
    OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2)),
    VectorizedActionNoise(OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2), initial_noise=np.ones(2)), 3),
    RunningMeanStd(shape=(3,)), nn.ReLU, nn.Tanh, nn.LayerNorm, torch.optim.Adam, torch.optim.AdamW, ReplayBuffer,
    SACPolicy, Path("a/b"), [*range(17)], [0.5, -math.inf, math.nan] * 6, [*range(16), 2**70], [True] * 20,
    ScheduleTable.of(lambda progress: progress**2), FloatSchedule(ScheduleTable.of(lambda progress: 1.0)),
]  # fmt: skip
ARRAYS: list[np.ndarray] = [
    *(G.normal(size=(3, 2)).astype(t) for t in ("f2", "f4", "f8", "c8", "c16", ">f8", "longdouble")),
    *(G.integers(0, 100, (2, 0, 3)).astype(t) for t in ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", ">i2")),
    G.normal(size=(4, 6)).T[::2], np.array(3.0), np.array([True, False]), np.array(["a", "bcd"]), np.array([b"x"]),
    np.array(["2020"], "M8[Y]"), np.broadcast_to(np.arange(3), (2, 3)), np.array([math.nan, -0.0, math.inf]),
]  # fmt: skip
TENSORS: list[torch.Tensor] = [
    *(torch.randn(2, 3).to(t) for t in (torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.complex64)),
    *(torch.arange(5).to(t) for t in (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.bool)),
    torch.tensor(1.5), torch.zeros(0, 4), torch.randn(4, 5).T, torch.randn(3, requires_grad=True),
    torch.randn(3, dtype=torch.complex64).conj(), torch.randn(4).to(torch.float8_e5m2),
]  # fmt: skip
GENERATORS: list[Any] = [
    np.random.default_rng(3), drawn_from(np.random.default_rng(3)), np.random.RandomState(4),
    *(np.random.Generator(getattr(np.random, name)(5)) for name in ("MT19937", "Philox", "SFC64", "PCG64DXSM")),
    drawn_from(np.random.Generator(np.random.Philox(5))), random.Random(6), torch.Generator().manual_seed(7),
]  # fmt: skip
SPACES: list[spaces.Space] = [
    spaces.Box(-1, 1, (2,)), spaces.Box(-np.inf, np.inf, (2, 3), np.float64), spaces.Box(0, 255, (4, 4, 3), np.uint8),
    spaces.Box(np.float32([-1.0, 0.1]), np.float32([1.0, np.inf])), spaces.Discrete(4),
    spaces.Discrete(3, start=-1), spaces.MultiDiscrete([2, 3]), spaces.MultiDiscrete([[1, 2], [3, 4]]),
    spaces.MultiBinary(3), spaces.MultiBinary([2, 2]), spaces.Tuple((spaces.Discrete(2), spaces.Box(0, 1, (1,)))),
    spaces.Dict({"b": spaces.Box(-1, 1, (2,)), "a": spaces.Discrete(3)}),
    spaces.Dict(collections.OrderedDict(b=spaces.Dict({"x": spaces.Discrete(2)}), a=spaces.MultiBinary(2))),
]  # fmt: skip


@pytest.mark.parametrize(
    "value", [*VALUES, *ARRAYS, *TENSORS, *GENERATORS, *SPACES], ids=lambda value: type(value).__name__
)
def test_what_comes_back_is_what_was_given(value: Any, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert same(through_a_file(value, tmp_path), value)
        assert same(through_a_file([{"k": (value, value)}], tmp_path), [{"k": (value, value)}])


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_a_space_draws_on(space: spaces.Space, tmp_path: Path) -> None:
    loaded = through_a_file(seeded(space), tmp_path)
    assert loaded == space and all(same(loaded.sample(), space.sample()) for _ in range(3))


@pytest.mark.parametrize(
    ("generator", "draw"),
    [
        (drawn_from(np.random.Generator(np.random.MT19937(1))), lambda g: g.normal(size=700)),
        (drawn_from(np.random.Generator(np.random.Philox(1))), lambda g: g.integers(9, size=700, dtype=np.int32)),
        (np.random.RandomState(2), lambda g: g.normal(size=701)),
        (random.Random(3), lambda g: [g.gauss(0, 1) for _ in range(701)]),
        (torch.Generator().manual_seed(4), lambda g: torch.randn(5, generator=g)),
    ],
)
def test_a_generator_draws_on(generator: Any, draw: Any, tmp_path: Path) -> None:
    draw(generator)
    loaded = through_a_file(generator, tmp_path)
    for _ in range(2):
        assert same(draw(loaded), draw(generator))


def test_rl_zoo_linear_schedule(tmp_path: Path) -> None:
    utils = pytest.importorskip("rl_zoo3.utils")
    loaded = through_a_file(FloatSchedule(utils.linear_schedule("3e-4")), tmp_path)
    assert type(loaded.value_schedule) is utils.SimpleLinearSchedule and loaded(0.5) == 1.5e-4


def test_what_is_read_can_be_written_to(tmp_path: Path) -> None:
    frozen = np.arange(3.0)
    frozen.flags.writeable = False
    loaded = through_a_file(frozen, tmp_path)
    loaded += 1
    assert loaded.tolist() == [1, 2, 3] and frozen.tolist() == [0, 1, 2]


def test_arrays_are_not_copied_for_writing() -> None:
    array, tensors = np.zeros(5), {}
    encode({"a": array}, "v", tensors)  # type: ignore[arg-type]
    assert list(tensors) == ["v.a"]
    array[0] = 1
    assert tensors["v.a"][0] == 1


def a_function(progress: float) -> float:
    return progress


class OwnActivation(nn.ReLU):
    pass


class OwnDict(dict):
    pass


class Outer:
    class Inner(nn.ReLU):
        pass


class _Private(nn.ReLU):
    pass


class Own:
    """An object that consists of its attributes."""

    count = 0

    def __init__(self, n: int):
        self.n, self.count, self.array = n, n + 1, np.arange(3)


class Slotted:
    __slots__ = ("n",)


class Overriding:
    def __init__(self) -> None:
        self.method = 3  # type: ignore[method-assign, assignment]

    def method(self) -> None:
        pass

    @property
    def number(self) -> int:
        return 3


class OwnSpace(spaces.Box):
    pass


class Phase(enum.Enum):
    FIRST, LAST = 1, 2


def local_class() -> Any:
    class Local:
        pass

    return Local


LOOP: list[Any] = []
LOOP.append(LOOP)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (lambda progress: progress, "learning_rate: the function .*lambda.* has no name that a file can hold"),
        (FloatSchedule(lambda progress: math.nan), "learning_rate: no table .*its value at 0 is nan"),
        ({"activation_fn": functools.partial(nn.ELU)}, "learning_rate.activation_fn: an object of functools.partial"),
        (Slotted(), f"learning_rate: an object of {__name__}.Slotted"),
        (Overriding(), "learning_rate: its 'method' takes the place of what"),
        ([].append, "learning_rate: the function"),
        (OwnSpace(0, 1), f"learning_rate: an object of {__name__}.OwnSpace"),
        ([1, {"x": (object(),)}], r"learning_rate\[1\].x\[0\]: an object of builtins.object"),
        (OwnDict(), f"learning_rate: an object of {__name__}.OwnDict"),
        (nn.ReLU(), "learning_rate: an object of torch.nn.modules.activation.ReLU"),
        (np.array([object()]), "learning_rate: an array of object"),
        (np.zeros(2, [("a", "f4")]), "learning_rate: an array of"),
        (np.ma.array([1.0]), "learning_rate: an object of numpy.ma"),
        (torch.sparse_coo_tensor([[0]], [1.0], (2,)), "learning_rate: a Tensor of torch.float32 and torch.sparse_coo"),
        (nn.Parameter(torch.zeros(1)), "learning_rate: a Parameter"),
        (torch.zeros(2, device="meta"), "learning_rate: a Tensor"),
        (torch.zeros(2, dtype=torch.complex128), "learning_rate: a Tensor of torch.complex128"),
        (random.SystemRandom(), "learning_rate: an object of random.SystemRandom"), (LOOP, "nested more than"),
        (spaces.Text(3), "learning_rate: an object of gymnasium.spaces.text.Text"),
    ],
)  # fmt: skip
def test_what_has_no_place_in_a_file_is_refused_by_name(value: Any, words: str) -> None:
    with pytest.raises(NotPortable, match=words):
        encode(value, "learning_rate", {})


@pytest.mark.parametrize(
    "value", [a_function, OwnActivation, FloatSchedule(a_function), Outer.Inner, _Private, Own(3), Phase.LAST]
)
def test_trusted_modules(value: Any, tmp_path: Path) -> None:
    """Anything can be written; what is read is what somebody vouches for."""
    assert same(through_a_file(value, tmp_path, (__name__,)), value)
    assert same(through_a_file(value, tmp_path, ("tests",)), value)
    tree = json.loads(json.dumps(encode(value, "value", {})))
    for trusted in ((), ("test",), (f"{__name__}.x",)):
        with pytest.raises(BadFile, match="value.*not trusted"):
            decode(tree, {}, "value", trusted)
    with pytest.raises(ValueError, match="trusted_modules must be a list of names of modules, not 'tests'"):
        decode(tree, {}, "value", "tests")


@pytest.mark.parametrize(
    "value", [len, int, torch.load, subprocess.Popen, nn.functional.relu, OwnActivation, local_class(), local_class()()]
)
def test_writing_a_name_is_harmless_and_reading_it_is_refused(value: Any) -> None:
    encoder = Encoder({})
    tree = encoder.encode({"a": value}, "value")
    assert list(encoder.foreign) == ["value.a"]
    with pytest.raises(NotTrusted, match="value.a"):
        decode(tree, {}, "value")


def test_classes_of_a_function_are_never_found() -> None:
    for value in (local_class(), local_class()()):
        with pytest.raises(NotTrusted, match="was made inside of a function"):
            decode(encode(value, "value", {}), {}, "value", (__name__,))


@pytest.mark.parametrize("key", ["method", "number", "__class__", "a.b", "__dict__"])
def test_a_file_sets_no_method_of_an_object(key: str) -> None:
    tree = {"instance": f"{__name__}:Overriding", "attributes": {key: 3}}
    with pytest.raises(BadFile, match=f"must not have its {key!r} set"):
        decode(tree, {}, "value", (__name__,))


def test_what_is_refused_leaves_nothing(tmp_path: Path) -> None:
    encoder = Lenient({})
    tree = encoder.attempt([np.zeros(3), Own(1), object()], "value")
    assert is_left_out(tree) and not encoder.tensors and not encoder.foreign
    assert encoder.left_out == {"value": "value[2]: an object of builtins.object cannot be written to a file that runs "
                                "no code"}  # fmt: skip
    with pytest.raises(BadFile, match="value was left out when the file was written"):
        decode(tree, {}, "value")


def test_a_trusted_module_stands_for_its_own_names_only() -> None:
    """What it imported from elsewhere may be anything."""
    for name in ("subprocess", "Path", "encode", "G", "no_such_name", "_private", "__name__"):
        with pytest.raises(BadFile, match="value"):
            decode({"import": f"{__name__}:{name}"}, {}, "value", (__name__,))


HOSTILE: list[Any] = [
    {"import": "os:system"}, {"import": "builtins:eval"}, {"import": "torch.nn:Module.forward"},
    {"import": "torch.nn.modules.activation:ReLU.forward"}, {"import": "torch.nn.functional:relu"},
    {"import": "torch.nn.modules.module:torch"}, {"import": "torch:load"}, {"import": "torch.nn.."}, {"import": ":"},
    {"import": "stable_baselines3.common.save_util:load_from_pkl"}, {"import": "torch.nnx:ReLU"}, {"import": 3},
    {"import": "torch.optim._adafactor:Adafactor"}, {"import": "torch.nn.nothing:ReLU"}, {"import": None},
    {"import": "stable_baselines3.common.vec_env.subproc_vec_env:SubprocVecEnv"}, {"import": "gymnasium:make"},
    {"object": "subprocess:Popen", "attributes": {}}, {"object": ["a"], "attributes": {}}, {"object": "x"},
    {"object": "stable_baselines3.common.utils:ConstantSchedule", "attributes": {"val": "1"}},
    {"object": "stable_baselines3.common.utils:ConstantSchedule", "attributes": {"val": 1, "__class__": 2}},
    {"object": "stable_baselines3.common.utils:FloatSchedule", "attributes": {"value_schedule": 3}},
    {"enum": "stable_baselines3.common.type_aliases:TrainFrequencyUnit", "member": "__class__"},
    {"enum": "stable_baselines3.common.type_aliases:TrainFrequencyUnit", "member": []}, {"enum": "enum:Enum"},
    {"named_tuple": "stable_baselines3.common.type_aliases:TrainFreq", "items": ["x", 1]},
    {"named_tuple": "stable_baselines3.common.type_aliases:TrainFreq", "items": "xy"},
    {}, {"unknown": 1}, {"tuple": 3}, {"tuple": [1], "more": 2}, {"dict": [1]}, {"dict_items": [[[1], 2]]},
    {"dict_items": [[1]]}, {"dict_items": 3}, {"set": [[1]]}, {"deque": [1, 2], "maxlen": 1},
    {"deque": [], "maxlen": -1}, {"deque": []}, {"deque": [], "maxlen": 1e9}, {"int": "x"}, {"int": 3}, {"float": "1"},
    {"float": []}, {"complex": [1]}, {"complex": ["a", "b"]}, {"bytes": "é"}, {"bytes": 3}, {"scalar": ["<f4", "x"]},
    {"scalar": ["<f4"]}, {"scalar": ["O", 1]}, {"scalar": ["|u1", 300]}, {"scalar": ["|b1", 2]},
    {"scalar_bytes": ["<U9999999", ""]}, {"scalar_bytes": ["<U1", "////fw=="]},
    {"scalar_bytes": ["|O8", "AAAAAAAAAAA="]},
    {"array": "nothing"}, {"array": "bf16"}, {"array": ["t"]}, {"tensor": "nothing"}, {"tensor": {}},
    {"tensor": "ints", "requires_grad": True}, {"raw_array": "t", "dtype": "<f4", "shape": [2]},
    {"raw_array": "bytes", "dtype": "<f4", "shape": [3]}, {"raw_array": "bytes", "dtype": "|O8", "shape": [1]},
    {"raw_array": "bytes", "dtype": "<f4", "shape": [-2, -1]}, {"raw_array": "bytes", "dtype": "<f4", "shape": "2"},
    {"raw_array": "bytes", "dtype": "<f4,(1000000000,)f8", "shape": []}, {"raw_array": "bytes"},
    {"dtype": "O"}, {"dtype": "V8"}, {"dtype": 3}, {"numpy_type": "O"}, {"torch_dtype": "load"}, {"torch_dtype": 1},
    {"device": "nowhere"}, {"device": 3}, [{"tensor": "t"}, {"tensor": "t"}],
    {"space": "Box", "arguments": {"low": 1, "high": 2, "dtype": {"dtype": "<f4"}}, "np_random": None},
    {"space": "Box", "arguments": {"low": {"array": "t"}, "high": {"array": "f8"}, "dtype": 3}, "np_random": None},
    {"space": "Box", "arguments": {"low": {"array": "nan"}, "high": {"array": "t"}, "dtype": {"dtype": "<f4"}},
     "np_random": None},
    {"space": "Text", "arguments": {"max_length": 3}, "np_random": None}, {"space": "Discrete"},
    {"space": "Discrete", "arguments": {"n": -1}, "np_random": None},
    {"space": "Discrete", "arguments": {"n": "a"}, "np_random": None},
    {"space": "Discrete", "arguments": {"n": 3, "seed": 3, "nope": 1}, "np_random": None},
    {"space": "Discrete", "arguments": {"n": 3}, "np_random": 3},
    {"space": "Dict", "arguments": {"spaces": [["a", 3]]}, "np_random": None},
    {"numpy_random": "Generator", "state": {"dict": {"bit_generator": "os"}}},
    {"numpy_random": "Generator", "state": {"dict": {"bit_generator": "PCG64"}}}, {"numpy_random": "x", "state": {}},
    {"numpy_random": "Generator", "state": 3}, {"random": [3, 4, None]}, {"random": 3},
    {"random": [3, {"array": "ints"}, None]}, {"torch_generator": {"tensor": "bytes"}, "device": "cpu"},
    {"torch_generator": 3, "device": "cpu"},
    {"path": 3}, {"path": []}, {"numbers": "t"}, {"numbers": "nothing"}, {"numbers": 3}, {"left_out": "x"},
    {"left_out": 3}, {"instance": "subprocess:Popen", "attributes": {}}, {"instance": 3, "attributes": {}},
    {"instance": "torch.nn.modules.activation:ReLU", "attributes": {}}, {"instance": "x"},
    {"enum": "signal:Signals", "member": 1},
    {"object": "sb3_sample.saving.schedules:ScheduleTable", "attributes": {"table": {"array": "t"}}},
    {"object": "sb3_sample.saving.schedules:ScheduleTable", "attributes": {"table": [[0, 1], [1, 0]]}},
]  # fmt: skip


@pytest.mark.parametrize("tree", HOSTILE, ids=lambda tree: json.dumps(tree)[:70])
def test_hostile_trees(tree: Any) -> None:
    def tensors() -> dict[str, torch.Tensor]:
        return {
            "t": torch.zeros(2), "bf16": torch.zeros(2, dtype=torch.bfloat16), "ints": torch.zeros(624).long(),
            "bytes": torch.zeros(8).byte(), "f8": torch.zeros(2).double(), "nan": torch.full((2,), math.nan),
        }  # fmt: skip

    for wrapped in (tree, [tree], {"dict": {"a": tree}}, {"tuple": [tree]}):
        with pytest.raises(BadFile, match="value"):
            decode(wrapped, tensors(), "value")


@pytest.mark.parametrize(("kind", "key"), [("MT19937", "pos"), ("Philox", "buffer_pos")])
@pytest.mark.parametrize("position", [-1, 625, 10**6, 2**40, 1.5, None, "1"])
def test_a_generator_never_reads_beside_its_numbers(kind: str, key: str, position: Any) -> None:
    """NumPy sets the position without a check, and crashes, or tells of other memory, at the next draw."""
    tensors: dict[str, torch.Tensor] = {}
    tree = encode(np.random.Generator(getattr(np.random, kind)(0)), "g", tensors)
    state = tree["state"]["dict"]
    (state["state"]["dict"] if kind == "MT19937" else state)[key] = position
    with pytest.raises(BadFile, match=key):
        decode(tree, tensors, "g")


def test_depth_is_bounded() -> None:
    value: Any = 1
    for _ in range(MAX_DEPTH):
        value = [value]
    assert decode(encode(value, "v", {}), {}, "v") == value
    with pytest.raises(NotPortable, match="nested more than"):
        encode([value], "v", {})
    for wrap in (lambda tree: [tree], lambda tree: {"tuple": [tree]}, lambda tree: {"dict": {"a": tree}}):
        tree: Any = 1
        for _ in range(900):
            tree = wrap(tree)
        with pytest.raises(BadFile, match="nested more than"):
            decode(tree, {}, "v")


class Bits(enum.Flag):
    ONE, TWO = enum.auto(), enum.auto()


@pytest.mark.parametrize("value", [Bits.ONE, Bits.ONE | Bits.TWO, Bits(0)])
def test_flags(value: Bits) -> None:
    tree = encode(value, "x", {})
    assert decode(json.loads(json.dumps(tree)), {}, "x", (__name__,)) is value


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.uint8])
def test_actions_of_another_kind_of_number(dtype: Any) -> None:
    space = spaces.Discrete(4, start=1, dtype=dtype)
    tensors: dict[str, torch.Tensor] = {}
    read = decode(json.loads(json.dumps(encode(space, "x", tensors))), tensors, "x")
    assert read == space and read.dtype == dtype


@pytest.mark.parametrize("kind", [np.object_, np.str_, np.bytes_, np.void])
def test_kinds_of_numpy_that_are_no_numbers(kind: type) -> None:
    with pytest.raises(NotPortable, match="^x: an array of"):
        encode(kind, "x", {})


def test_no_part_of_torch_is_imported_by_a_name() -> None:
    with pytest.raises(BadFile, match="no kind of number of torch"):
        decode({"torch_dtype": "_inductor"}, {}, "x")
    assert decode({"torch_dtype": "float16"}, {}, "x") is torch.float16
