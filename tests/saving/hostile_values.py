"""
Values that no training comes to and that saving never writes: what is changed in which file, and what is said of it.

Each row of a table is the file, the place in it, the value that is put there, and words of the refusal. A place in a
tensor is its name; a place in a tree is a path. Where a kind of value can stand in several files, each has its row.
"""

import io
import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from sb3_sample.saving import container
from sb3_sample.saving.encoding import encode
from tests.saving.hostile import Original, at, tensor_file, with_entries

#: Numbers that differ by it have one hash.
_PERIOD = 2**61 - 1
NAN = {"float": "nan"}


def same_hash(n: int) -> list[Any]:
    """Integers of one hash as they stand in a file."""
    return [value if (value := _PERIOD * i) < 2**63 else {"int": hex(value)} for i in range(n)]


def generator(kind: str, bits: str, **changes: Any) -> tuple[Any, dict[str, torch.Tensor]]:
    """A generator as it stands in a file, with some of its state replaced."""
    drawn: Any = np.random.Generator(getattr(np.random, bits)(0))
    if kind == "RandomState":
        drawn = np.random.RandomState(getattr(np.random, bits)(0))
    tensors: dict[str, torch.Tensor] = {}
    tree = encode(drawn, "hostile", tensors)
    beside = tree["state"]["dict"]
    for key, value in changes.items():
        inside = beside["state"]["dict"]
        owner = inside if key in inside else beside
        if isinstance(value, torch.Tensor):
            tensors[owner[key]["array"]] = value
        else:
            owner[key] = value
    return tree, tensors


#: States of generators, each of which NumPy takes without a check, and what is said of them.
GENERATORS: tuple[tuple[str, str, dict[str, Any], str], ...] = (
    *(("RandomState", "MT19937", {"pos": pos}, "pos of a generator") for pos in (10**9, -(10**7), 625, -1, True, NAN)),
    ("Generator", "MT19937", {"pos": 10**9}, "pos of a generator"),
    ("Generator", "MT19937", {"key": torch.zeros(600, dtype=torch.uint32)}, "key of a generator"),
    ("Generator", "MT19937", {"key": torch.zeros(624)}, "key of a generator"),
    ("RandomState", "MT19937", {"has_gauss": 2}, "has_gauss of a generator"),
    ("RandomState", "MT19937", {"gauss": "x"}, "gauss of a generator"),
    ("Generator", "Philox", {"buffer_pos": 5}, "buffer_pos of a generator"),
    ("RandomState", "Philox", {"buffer_pos": -(10**7)}, "buffer_pos of a generator"),
    ("Generator", "Philox", {"counter": torch.zeros(3, dtype=torch.uint64)}, "counter of a generator"),
    ("Generator", "SFC64", {"has_uint32": 7}, "has_uint32 of a generator"),
    ("Generator", "PCG64", {"uinteger": 2**32}, "uinteger of a generator"),
    ("Generator", "PCG64DXSM", {"inc": 4}, "inc of a generator"),
    ("Generator", "PCG64", {"more": 1}, "the state of a generator must have"),
)

Place = tuple[Any, ...]
#: Of a file's tree.
TREE: tuple[tuple[str, Place, Any, str], ...] = (
    # What takes longer than it is long.
    *((target, ("attributes", "seed"), {kind: same_hash(4000)}, "values of one hash")
      for target in ("SAC", "BRO", "MBMAPPO") for kind in ("set", "frozenset")),
    ("SAC", ("attributes", "seed"), {"dict_items": [[key, 0] for key in same_hash(4000)]}, "values of one hash"),
    ("SAC", ("attributes", "seed"), {"set": [{"tuple": [key]} for key in same_hash(4000)]}, "values of one hash"),
    ("buffer", ("state", "dict", "pos"), {"set": same_hash(4000)}, "values of one hash"),
    ("her", ("attributes", "pos", "whole"), {"set": same_hash(4000)}, "it is filled up to"),
    ("her", ("attributes", "her_ratio", "whole"), {"set": same_hash(4000)}, "values of one hash"),
    ("VecNormalize", ("dict", "norm_obs_keys"), {"set": same_hash(4000)}, "values of one hash"),
    # Work and memory beyond what any machine has.
    *((target, ("attributes", name), value, f"{name} must be at most .* pass {name}= to load")
      for target, names in (
          ("SAC", ("replay_ratio", "gradient_steps", "batch_size", "n_steps")), ("BRO", ("replay_ratio", "batch_size")),
          ("MBMAPPO", ("batch_size", "n_steps", "n_epochs", "n_simulated", "simulation_horizon",
                       "dynamics_buffer_size", "dynamics_batch_size")))
      for name in names for value in (10**9, 10**15)),
    ("SAC", ("attributes", "train_freq", "items"), [10**12, {
        "enum": "stable_baselines3.common.type_aliases:TrainFrequencyUnit", "member": "STEP"}],
     "train_freq must be at most .* pass train_freq= to load"),
    *((target, ("attributes", "buffer_size"), 10**9, "pass buffer_size= to load") for target in ("SAC", "BRO")),
    # Counts that no training comes to.
    *((target, ("attributes", "_updates_owed"), value, "_updates_owed must lie in")
      for target in ("SAC", "BRO") for value in (1e9, -1e9, NAN, 2)),
    *((target, ("attributes", "num_timesteps"), value, "num_timesteps must be an integer of at least 0")
      for target in ("SAC", "BRO", "MBMAPPO") for value in (-(10**9), 0.5, 2**60)),
    ("SAC", ("attributes", "num_transitions"), -1, "num_transitions must be an integer of at least 0"),
    # Settings with which nothing is normalised.
    *(("VecNormalize", ("dict", name), value, f"{name} of a VecNormalize must be")
      for name, values in (
          ("clip_obs", (-5, 0, NAN, "x", None, True)), ("clip_reward", (-5, 0, NAN)),
          ("epsilon", (-1e9, NAN, {"float": "inf"})), ("gamma", (7, -0.1, NAN)), ("norm_obs_keys", ("x", [3])))
      for value in values),
    *(("VecNormalize", ("dict", "obs_rms", "attributes", "count"), value, "count") for value in (0, -1, NAN)),
    *(("VecNormalize", ("dict", "ret_rms", "attributes", name), {"scalar": ["<f8", value]}, "ret_rms holds no stat")
      for name, value in (("mean", NAN), ("var", NAN), ("var", -1.0))),
    # Rows that are not there.
    ("her", ("attributes", "pos", "whole"), 400, "rows in the file, but 400 count as filled"),
    ("her", ("attributes", "full", "whole"), True, "rows in the file, but 500 count as filled"),
    ("buffer", ("state", "dict", "pos"), 500, "pos=500"),
    ("buffer", ("state", "dict", "pos"), 400, "must be float32 of shape"),
)  # fmt: skip
#: Of a file's tensors: one number of it.
NUMBERS: tuple[tuple[str, str, float, str], ...] = (
    *((target, f"replay_buffer.{name}", value, f"{name.split('.')[0]}\\S* hold .* not finite")
      for target, names in (
          ("buffer", ("observations", "next_observations", "actions", "rewards")),
          ("her", ("observations.observation", "next_observations.achieved_goal", "actions", "rewards")))
      for name in names for value in (math.nan, math.inf)),
    *((target, f"replay_buffer.{name}", value, f"{name} hold .* but must be 0 or 1")
      for target in ("buffer", "her") for name in ("dones", "timeouts") for value in (7, 0.5, math.nan)),
    *(("her", f"replay_buffer.{name}", value, f"{name} must be integers in")
      for name in ("ep_start", "ep_length", "_current_ep_start") for value in (-(10**12), 10**12)),
    *(("MBMAPPO", f"transitions.{name}", value, f"transitions.{name} .*not finite|{name} of transitions must be")
      for name, value in (("observations", math.nan), ("rewards", math.inf), ("terminations", 7))),
    ("VecNormalize", "VecNormalize.obs_rms.mean", math.nan, "obs_rms holds no statistics"),
    ("VecNormalize", "VecNormalize.obs_rms.var", math.inf, "obs_rms holds no statistics"),
    ("VecNormalize", "VecNormalize.obs_rms.var", -1.0, "obs_rms holds no statistics"),
)  # fmt: skip


def with_value(original: Original, place: Place, value: Any) -> bytes:
    content = json.loads(json.dumps(original.content))
    at(content["tree"], place[:-1])[place[-1]] = value
    return with_entries(original, data=json.dumps(content).encode())


def with_number(original: Original, name: str, value: float) -> bytes:
    tree, tensors = container.read(io.BytesIO(original.data), original.content["kind"])
    tensors[name].view(-1)[0] = value
    return written(original, tree, tensors)


def with_generator(original: Original, place: Place, case: tuple[str, str, dict[str, Any], str]) -> bytes:
    tree, tensors = container.read(io.BytesIO(original.data), original.content["kind"])
    at(tree, place[:-1])[place[-1]], more = generator(*case[:2], **case[2])
    return written(original, tree, {**tensors, **more})


def written(original: Original, tree: Any, tensors: dict[str, torch.Tensor]) -> bytes:
    file = io.BytesIO()
    container.write(file, original.content["kind"], tree, tensors)
    return file.getvalue()


def too_much(original: Original, most: int) -> Iterator[tuple[str, bytes, str]]:
    """
    Files whose JSON is short for what is in it.

    :param original: a good file
    :param most: bytes that its JSON may have
    """
    for piece in (b"[],", b"0,", b'{"a":0},'):
        data = b"[" + piece * ((most - 1000) // len(piece)) + b"0]"
        yield f"{most} bytes of {piece!r}", with_entries(original, data=data), "its JSON holds .* values, more than"
    for n in (49_000, 60_000, 300_000):
        header = {f"t{i}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for i in range(n)}
        yield f"{n} tensors", with_entries(original, tensors=tensor_file(header, b"")), "refers to the tensor|more than"
    # A name that is written out for each of the parts.
    tree = {"dict": {"k" * (most // 2): [[0] * 100] * 1000}}
    data = json.dumps({**original.content, "tree": tree}).encode()
    yield "a long name", with_entries(original, data=data), ""


# ---------------------------------------------------------------- a run's folder

#: Of the decoded state of a checkpoint: what it consists of is plain values.
STATE: tuple[tuple[Place, Any, str], ...] = (
    *((("attributes", "_updates_owed"), {"value": value}, "_updates_owed must lie in")
      for value in (1e9, -1e9, math.nan)),
    *((("attributes", "num_timesteps"), {"value": value}, "num_timesteps must be|its state is of step")
      for value in (-(10**9), 0.5, 29, 10**9)),
    (("attributes", "num_transitions"), {"value": -5}, "num_transitions must be"),
    (("attributes", "_last_obs"), {"value": np.full((1, 3), math.nan, np.float32)}, "_last_obs must be finite"),
    (("attributes", "_last_obs"), {"value": np.zeros((1, 4), np.float32)}, "_last_obs is of shape"),
    (("attributes", "_last_original_obs"), {"value": np.full((1, 3), math.inf)}, "_last_original_obs must be finite"),
    *((("attributes", name), {"value": 1}, f"'{name}' is not saved of a SAC")
      for name in ("replay_ratio", "policy", "train", "env", "__class__")),
    (("generators", "numpy"), ("MT19937", np.zeros(624, np.uint32), 10**9, 0, 0.0), "pos of a generator"),
    (("generators", "numpy"), ("MT19937", np.zeros(624, np.uint32), -(10**7), 0, 0.0), "pos of a generator"),
    (("generators", "numpy"), ("MT19937", np.zeros(600, np.uint32), 0, 0, 0.0), "key of a generator"),
    (("generators", "numpy"), ("MT19937", np.zeros(624, np.uint32), 0, 2, 0.0), "has_gauss of a generator"),
    (("generators", "numpy"), ("MT19937", np.zeros(624, np.uint32), 0, 0, "x"), "gauss of a generator"),
    (("generators", "python"), (3, (0,) * 624 + (10**9,), None), "generator of Python"),
    (("generators", "python"), (3, (0,) * 624 + (1,), "x"), "generator of Python"),
    *((("env", "wrappers", 0, "attributes", name), {"value": value}, f"{name} of a VecNormalize must be")
      for name, values in (("clip_obs", (-5, 0, math.nan)), ("clip_reward", (-5, 0, math.nan)),
                           ("gamma", (7, math.nan)), ("epsilon", (-1e9, math.nan)),
                           ("returns", (np.array([math.nan]),)), ("training", ("x",)))
      for value in values),
    *((("env", "wrappers", 0, "attributes", name, "attributes", key), {"value": value}, words)
      for name, key, value, words in (
          ("obs_rms", "mean", np.full(3, math.nan), "obs_rms holds no statistics"),
          ("obs_rms", "var", np.full(3, -1.0), "obs_rms holds no statistics"),
          ("obs_rms", "var", np.ones(2), "obs_rms holds no statistics"),
          ("obs_rms", "count", math.inf, "obs_rms holds no statistics"),
          ("ret_rms", "var", np.float64(-1), "ret_rms holds no statistics"))),
    *((("env", "wrappers", 0, "attributes", name), {"value": 1}, f"'{name}' is not saved of a VecNormalize")
      for name in ("venv", "step_wait", "num_envs")),
    (("env", "seeds"), ["x"], "the seeds of 1 environments cannot be"),
    (("env", "options"), [], "the options of 1 environments cannot be"),
    (("env", "environments", 0), 3, "TypeError"),
    (("rings", "model", "n_rows"), -1, "rows"), (("rings", "model", "size"), 10**12, "rows"),
)  # fmt: skip
#: Of the rows of a replay buffer.
ROWS: tuple[tuple[str, float, str], ...] = (
    *((name, value, f"{name} hold .* not finite")
      for name in ("observations", "next_observations", "actions", "rewards") for value in (math.nan, math.inf)),
    *((name, value, f"{name} hold .* but must be 0 or 1")
      for name in ("dones", "timeouts") for value in (7, 0.5, math.nan)),
)  # fmt: skip
