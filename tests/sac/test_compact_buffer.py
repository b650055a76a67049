"""The buffer that stores one observation a step, beside Stable-Baselines3's, which stores two."""

import copy
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample.sac import memory_map
from sb3_sample.sac.batch import draw_batches
from sb3_sample.sac.buffers import BatchMemory, ValidationDictReplayBuffer, ValidationReplayBuffer
from sb3_sample.sac.compact_buffer import CompactDictReplayBuffer, CompactReplayBuffer
from tests.sac.common import sac, vec

BOX = spaces.Box(-np.inf, np.inf, (2,), np.float32)
DICT = spaces.Dict({"x": BOX, "image": spaces.Box(0, 255, (2, 3), np.uint8), "n": spaces.Discrete(5)})
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
#: Values whose comparison is not that of their bits, and a few more, so that observations repeat.
VALUES = np.array([0.0, -0.0, np.nan, 1.0, 2.0], np.float32)


def transitions(space: spaces.Space, n_envs: int, seed: int, p_end: float = 0.15) -> Iterator[tuple[Any, ...]]:
    """
    Steps as ``add`` takes them: episodes end in each environment by themselves; now and then all of them are reset
    without an end, or next observation and observation differ in the sign of a zero only.
    """
    rng = np.random.default_rng(seed)

    def draw(sub: Any) -> np.ndarray:
        if sub is BOX:
            return rng.choice(VALUES, (n_envs, 2))
        if isinstance(sub, spaces.Discrete):
            return rng.integers(0, 5, n_envs)
        return rng.integers(0, 3, (n_envs, *sub.shape)).astype(np.uint8)

    def observe() -> dict[str, np.ndarray]:
        return {key: draw(sub) for key, sub in (space.items() if isinstance(space, spaces.Dict) else [("", space)])}

    now = observe()
    while True:
        after, done = observe(), rng.random(n_envs) < p_end
        given = [copy.deepcopy(o if isinstance(space, spaces.Dict) else o[""]) for o in (now, after)]
        infos = [{"TimeLimit.truncated": bool(d and rng.random() < 0.5)} for d in done]
        yield *given, rng.uniform(-1, 1, (n_envs, 2)), rng.normal(size=n_envs), done, infos
        fresh = observe()
        now = {key: value.copy() for key, value in after.items()}
        broken = np.full(n_envs, rng.random() < 0.05) | done
        for key, value in now.items():
            value[broken] = fresh[key][broken]


def make(cls: Any, rows: int, n_envs: int, **kwargs: Any) -> Any:
    space = DICT if issubclass(cls, DictReplayBuffer) else BOX
    if "Validation" in cls.__name__:
        kwargs["validation_proportion"] = 0.3
    return cls(rows * n_envs, space, ACTIONS, device="cpu", n_envs=n_envs, **kwargs)


def flat(samples: Any) -> list[torch.Tensor]:
    # The sixth field, discounts, is of n-step returns.
    return [x for field in samples[:5] for x in (field.values() if isinstance(field, dict) else [field])]


def same(a: Any, b: Any) -> bool:
    """Equal bit by bit, NaN and the sign of zeros included."""
    return all(
        x.dtype == y.dtype and x.shape == y.shape and x.numpy().tobytes() == y.numpy().tobytes()
        for x, y in zip(flat(a), flat(b), strict=True)
    )


def compare(ours: Any, theirs: Any, seed: int, n: int = 64) -> None:
    np.random.seed(seed)
    expected = theirs.sample(n)
    after = np.random.random()
    np.random.seed(seed)
    assert same(ours.sample(n), expected)
    assert np.random.random() == after, "as many numbers were drawn"


PAIRS = [(CompactReplayBuffer, ReplayBuffer), (CompactDictReplayBuffer, DictReplayBuffer)]


@pytest.mark.parametrize(("cls", "sb3"), PAIRS)
@pytest.mark.parametrize(("rows", "n_envs"), [(1, 1), (1, 3), (2, 1), (7, 2), (40, 3)])
@pytest.mark.parametrize("p_end", [0.02, 0.5, 1.0])
def test_long_random_run(cls: Any, sb3: Any, rows: int, n_envs: int, p_end: float) -> None:
    ours, theirs = make(cls, rows, n_envs), make(sb3, rows, n_envs)
    steps = transitions(ours.observation_space, n_envs, seed=rows, p_end=p_end)
    for step in range(5 * rows + 3):
        one = next(steps)
        ours.add(*copy.deepcopy(one))
        theirs.add(*copy.deepcopy(one))
        assert (ours.pos, ours.full, ours.size()) == (theirs.pos, theirs.full, theirs.size())
        compare(ours, theirs, seed=step)
        for env, key in [(e, k) for e in range(n_envs) for k in ours.stored()]:
            mine, other = ((b.next_observations[key] if key else b.next_observations) for b in (ours, theirs))
            n = theirs.size()
            assert mine[:n, env].tobytes() == other[:n, env].tobytes()
        n_apart = int((ours.slot >= n_envs).sum())
        assert len(ours.aside) == n_apart, "no slot is lost"


def test_normalised_samples() -> None:
    venv = VecNormalize(vec(2))
    venv.reset()
    venv.step(np.zeros((2, 2)))
    ours, theirs = (
        cls(30, venv.observation_space, ACTIONS, device="cpu", n_envs=2) for cls in (CompactReplayBuffer, ReplayBuffer)
    )
    rng = np.random.default_rng(0)
    for _ in range(20):
        one = (*rng.normal(size=(2, 2, 3)), rng.normal(size=(2, 2)), rng.normal(size=2), np.zeros(2), [{}, {}])
        ours.add(*one)
        theirs.add(*one)
    np.random.seed(1)
    expected = theirs.sample(50, env=venv)
    np.random.seed(1)
    assert same(ours.sample(50, env=venv), expected)


def test_the_view_is_read_like_an_array() -> None:
    ours, theirs = make(CompactReplayBuffer, 10, 3), make(ReplayBuffer, 10, 3)
    steps = transitions(BOX, 3, seed=0)
    for _ in range(14):
        one = next(steps)
        ours.add(*one)
        theirs.add(*one)
    view, array = ours.next_observations, theirs.next_observations
    assert (view.shape, view.dtype, view.ndim, len(view)) == (array.shape, array.dtype, 3, 10)
    rows, envs = np.array([3, 9, 0, 4]), np.array([0, 2, 1, 2])
    indices: list[Any] = [
        3, -1, slice(2, 7), (4, 1), (slice(None), 2), rows, (rows, envs), (rows, envs, slice(None)), (rows, envs, 1),
        (rows[:, None], envs), (slice(1, 3), slice(None), 0), array[..., 0, 0] > 0, (-rows, envs), np.array([], int),
    ]  # fmt: skip
    for index in indices:
        assert np.array_equal(view[index], array[index], equal_nan=True), index
    assert np.array_equal(np.asarray(view), array, equal_nan=True)
    for index in (10, (rows, envs + 1), (rows + 9, envs)):
        with pytest.raises((IndexError, ValueError)):
            view[index]
    with pytest.raises(TypeError):
        view[0] = 1


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("cls", [CompactReplayBuffer, CompactDictReplayBuffer, ValidationDictReplayBuffer])
def test_gathered(cls: Any, n_envs: int) -> None:
    buffer, memory = make(cls, 20, n_envs), BatchMemory()
    steps = transitions(buffer.observation_space, n_envs, seed=1)
    for i in range(50):
        buffer.add(*next(steps))
        np.random.seed(i)
        expected = draw_batches(buffer, 3, 16, 0.9, None)
        np.random.seed(i)
        assert memory.serves(buffer, None)
        for a, b in zip(draw_batches(buffer, 3, 16, 0.9, None, memory), expected, strict=True):
            assert same(a[:5], b[:5])


# ------------------------------------------------------------------ models


@pytest.mark.parametrize("as_dict", [False, True])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("truncate", [False, True])
def test_trains_the_same_model(as_dict: bool, n_envs: int, truncate: bool) -> None:
    space = spaces.Dict({"a": spaces.Box(-10, 10, (3,)), "b": spaces.Box(-10, 10, (2,))}) if as_dict else None
    models = []
    for cls in (None, DictReplayBuffer if as_dict else ReplayBuffer):
        model = sac(
            vec(n_envs, obs_space=space, truncate=truncate), policy="MultiInputPolicy" if as_dict else "MlpPolicy",
            replay_buffer_class=cls, buffer_size=60,
        )  # fmt: skip
        model.learn(50)
        model.learn(50)  # resets the environments in the midst of an episode
        models.append(model)
    assert type(models[0].replay_buffer) is (CompactDictReplayBuffer if as_dict else CompactReplayBuffer)
    ours, theirs = (model.policy.state_dict() for model in models)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    compare(models[0].replay_buffer, models[1].replay_buffer, seed=0)


def test_who_gets_which_buffer(tmp_path: Path) -> None:
    assert type(sac(n_steps=3).replay_buffer) is NStepReplayBuffer
    assert type(sac(replay_buffer_class=ReplayBuffer).replay_buffer) is ReplayBuffer
    assert isinstance(sac(optimize_memory_usage=True, validation_proportion=0.5).replay_buffer, ValidationReplayBuffer)
    for kwargs, what in (({"n_steps": 3}, "n_steps=3"), ({"replay_buffer_class": ReplayBuffer}, "ReplayBuffer")):
        with pytest.raises(ValueError, match=f"memory_map .*{what}"):
            sac(replay_buffer_kwargs={"memory_map": str(tmp_path)}, **kwargs)


# ------------------------------------------------------------------ to and from files

ALL = [CompactReplayBuffer, CompactDictReplayBuffer, ValidationReplayBuffer, ValidationDictReplayBuffer]


def check_equal(restored: Any, original: Any, steps: Iterator[tuple[Any, ...]]) -> None:
    """Now and as they go on."""
    for i in range(30):
        assert (restored.pos, restored.full) == (original.pos, original.full)
        if original.size() > 0 and getattr(original, "n_training", 1) > 0:
            compare(restored, original, seed=i)
        if getattr(original, "n_validation", 0) > 0:
            np.random.seed(i)
            expected = original.sample_validation(20)
            np.random.seed(i)
            assert same(restored.sample_validation(20), expected)
            assert (restored.n_validation, restored.n_training) == (original.n_validation, original.n_training)
        one = next(steps)
        for buffer in (restored, original):
            np.random.seed(i)
            buffer.add(*copy.deepcopy(one))


@pytest.mark.parametrize("cls", ALL)
@pytest.mark.parametrize("n", [0, 1, 9, 10, 11, 37])
def test_state_dict(cls: Any, n: int) -> None:
    original, restored = make(cls, 10, 2), make(cls, 10, 2)
    steps = transitions(original.observation_space, 2, seed=n)
    for _ in range(n):
        original.add(*next(steps))
        restored.add(*next(steps))  # whatever it held
    state = copy.deepcopy(original.state_dict())
    assert all(isinstance(value, (int, bool, np.ndarray)) for value in state.values())
    restored.load_state_dict(state)
    check_equal(restored, original, steps)


@pytest.mark.parametrize("cls", ALL)
@pytest.mark.parametrize("sizes", [[3, 4], [10], [4, 6, 1], [7, 2, 9, 9, 5], [1] * 23, [10, 10, 3]])
@pytest.mark.parametrize("rewritten", [False, True])
def test_rows_appended_piece_by_piece(cls: Any, sizes: list[int], rewritten: bool) -> None:
    original, restored = make(cls, 10, 2), make(cls, 10, 2)
    steps = transitions(original.observation_space, 2, seed=len(sizes))
    pieces, total = [], 0
    for n in sizes:
        for _ in range(n):
            original.add(*next(steps))
        again = int(rewritten and total > 0 and n < 10)  # the last step of the piece before, once more
        pieces.append((total - again, original.new_rows(n + again)))
        total += n
    restored.add(*next(steps))
    # Only pieces with a step that is still there are needed.
    needed = [(first, piece) for first, piece in pieces if first + len(piece["actions"]) > total - 10]
    restored.restore_rows(needed)
    check_equal(restored, original, steps)


def test_a_changed_last_row_replaces_it() -> None:
    original, restored = make(CompactReplayBuffer, 10, 2), make(CompactReplayBuffer, 10, 2)
    steps = transitions(BOX, 2, seed=3, p_end=0)
    for _ in range(6):
        original.add(*next(steps))
    pieces = [(0, original.new_rows(6))]
    original.dones[5] = original.timeouts[5] = 1
    original.add(*next(steps))
    pieces.append((5, original.new_rows(2)))
    restored.restore_rows(pieces)
    assert restored.dones[5].all()
    check_equal(restored, original, steps)


def test_bad_rows_are_refused() -> None:
    buffer = make(CompactReplayBuffer, 10, 2)
    steps = transitions(BOX, 2, seed=3)
    for _ in range(6):
        buffer.add(*next(steps))
    good, target = buffer.state_dict(), make(CompactReplayBuffer, 10, 2)
    index = good["next_index"]
    for change, what in (
        ({"actions": good["actions"][:5]}, "actions must be"),
        ({"rewards": good["rewards"].astype(np.float64)}, "rewards must be float32"),
        ({"pos": 10}, "pos=10"), ({"pos": True}, "pos=True"), ({"full": 1}, "full=1"), ({"n_envs": 3}, "n_envs is 2"),
        ({"pos": 7}, "must be"),
        ({"more": np.zeros(3)}, "columns"),
        ({"next_index": index[::-1].copy()}, "rising"), ({"next_index": index + 2}, "rising"),
        ({"next_index": index.astype(float)}, "rising"),
        ({"next_index": index[:-1], "next_observations": good["next_observations"][:-1]}, "all of the newest step"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=what):
            target.load_state_dict({**good, **change})
    with pytest.raises(ValueError, match="columns"):
        target.load_state_dict({name: value for name, value in good.items() if name != "dones"})
    piece = buffer.new_rows(3)
    for pieces in ([(0, piece), (4, piece)], [(3, piece), (2, piece)]):
        with pytest.raises(ValueError, match="are followed by those from"):
            target.restore_rows(pieces)
    with pytest.raises(ValueError, match="n must lie between 0 and 6"):
        buffer.new_rows(7)


def test_copies_and_pickles() -> None:
    buffer = make(ValidationReplayBuffer, 10, 2)
    steps = transitions(BOX, 2, seed=3)
    for _ in range(16):
        buffer.add(*next(steps))
    check_equal(pickle.loads(pickle.dumps(buffer)), buffer, steps)


# ------------------------------------------------------------------ in files


@pytest.mark.parametrize("cls", ALL)
def test_memory_map(cls: Any, tmp_path: Path) -> None:
    in_files, plain = make(cls, 10, 2, memory_map=tmp_path / "new" / "folder"), make(cls, 10, 2)
    assert all(isinstance(array, np.memmap) for array in (*in_files.stored().values(), in_files.actions, in_files.slot))
    assert list((tmp_path / "new" / "folder").glob("*.bin"))
    steps = transitions(plain.observation_space, 2, seed=5, p_end=0.5)
    for i in range(25):
        one = next(steps)
        for buffer in (in_files, plain):
            np.random.seed(i)
            buffer.add(*copy.deepcopy(one))
    check_equal(in_files, plain, steps)
    with pytest.raises(TypeError, match="cannot be pickled"):
        pickle.dumps(in_files)


def test_two_buffers_of_a_process_in_one_folder(tmp_path: Path) -> None:
    """A model that is loaded while the one it was saved from lives."""
    first, plain = make(CompactReplayBuffer, 10, 1, memory_map=tmp_path), make(CompactReplayBuffer, 10, 1)
    steps = transitions(BOX, 1, seed=5, p_end=0.5)
    second = make(CompactReplayBuffer, 10, 1, memory_map=tmp_path)
    for _ in range(30):
        one = next(steps)
        first.add(*one)
        plain.add(*one)
        second.add(*next(steps))
    check_equal(first, plain, steps)


def test_a_folder_belongs_to_one_run(tmp_path: Path) -> None:
    code = (
        "import sys; from tests.sac.test_compact_buffer import *\n"
        f"b = make(CompactReplayBuffer, 10, 1, memory_map={str(tmp_path)!r})\n"
        "print('ready', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"ready\n"
        with pytest.raises(ValueError, match=f"another run, process {other.pid}"):
            make(CompactReplayBuffer, 10, 1, memory_map=tmp_path)
        other.kill()
    # What it left is nobody's, and replaced.
    left = set(tmp_path.glob("*.bin"))
    buffer = make(CompactReplayBuffer, 12, 1, memory_map=tmp_path)
    files = {Path(array.filename) for array in (*buffer.columns().values(), buffer.slot, *buffer.aside.arrays.values())}
    assert len(left) == len(files) == 7 and set(tmp_path.glob("*.bin")) == files
    assert not buffer.observations.any()


def test_folders_that_cannot_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def build(folder: Any) -> None:
        sac(replay_buffer_kwargs={"memory_map": folder})

    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="memory_map=.*must be a folder that can be written to"):
        build(str(tmp_path / "file"))
    for bad in (3, ""):
        with pytest.raises(ValueError, match="memory_map must be a folder"):
            build(bad)
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "replay_buffer.0.bin").write_text("mine")
    with pytest.raises(ValueError, match="no replay buffer's"):
        build(str(tmp_path / "foreign"))
    assert (tmp_path / "foreign" / "replay_buffer.0.bin").read_text() == "mine"
    monkeypatch.setattr(memory_map.shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(ValueError, match=r"the replay buffer takes .* are free there"):
        build(str(tmp_path / "small"))
