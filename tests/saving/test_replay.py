"""Replay buffers in files that run no code: the next sample is the same, bit by bit."""

import io
import json
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.her import HerReplayBuffer

from sb3_sample.replay.buffers import DeviceReplayBuffer
from sb3_sample.sac import SAC
from sb3_sample.saving import BadFile, container
from sb3_sample.saving.container import PickledFile
from sb3_sample.saving.encoding import Lenient
from sb3_sample.saving.replay import encode_buffer
from tests.sac.common import sac, vec

DICT = spaces.Dict({"a": spaces.Box(-10, 10, (2,)), "n": spaces.Discrete(9)})


class Goals(gym.Env):
    """Episodes of seven steps towards a goal."""

    def __init__(self) -> None:
        box = spaces.Box(-9, 9, (2,))
        self.observation_space = spaces.Dict({"observation": box, "achieved_goal": box, "desired_goal": box})
        self.action_space = spaces.Box(-1, 1, (2,))

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -np.abs(achieved - desired).sum(axis=-1)

    def _observation(self) -> Any:
        now = np.full(2, self.t, np.float32)
        return {"observation": now, "achieved_goal": now + 1, "desired_goal": now * 0}

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        info = {"place": float(self.t), "array": np.arange(2)}
        return self._observation(), -1.0, False, self.t == 7, info


class OwnBuffer(ReplayBuffer):
    pass


def goals(n_envs: int) -> DummyVecEnv:
    return DummyVecEnv([lambda: Monitor(Goals()) for _ in range(n_envs)])


def make(kind: str, n_envs: int, buffer_size: int) -> Any:
    # Random actions for ever, so that a seed fixes them.
    kwargs: dict[str, Any] = {"buffer_size": buffer_size * n_envs, "learning_starts": 10**9}
    if kind in ("her", "her_infos"):
        kwargs.update(replay_buffer_class=HerReplayBuffer, policy="MultiInputPolicy")
        kwargs["replay_buffer_kwargs"] = {"copy_info_dict": kind == "her_infos", "goal_selection_strategy": "final"}
        return sac(goals(n_envs), **kwargs)
    if kind == "lean":
        kwargs["replay_buffer_kwargs"] = {"handle_timeout_termination": False}
        return sac(vec(n_envs), replay_buffer_class=ReplayBuffer, optimize_memory_usage=True, **kwargs)
    if kind in ("dict", "compact_dict", "validation_dict"):
        kwargs["policy"] = "MultiInputPolicy"
    if kind.startswith("validation"):
        kwargs["validation_proportion"] = 0.25
    space = DICT if kind.endswith("dict") else None
    cls = {"plain": ReplayBuffer, "dict": DictReplayBuffer, "n_step": NStepReplayBuffer, "device": DeviceReplayBuffer}
    return sac(vec(n_envs, obs_space=space), replay_buffer_class=cls.get(kind), **kwargs)


KINDS = ["plain", "dict", "n_step", "device", "lean", "her", "her_infos", "compact", "compact_dict", "validation",
         "validation_dict"]  # fmt: skip


def samples(buffer: Any, env: Any = None) -> list[np.ndarray]:
    np.random.seed(5)
    drawn: list[np.ndarray] = []
    for _ in range(3):
        for value in buffer.sample(16):
            drawn += [np.asarray(v) for v in (value.values() if isinstance(value, dict) else [value]) if v is not None]
    return drawn


@pytest.mark.parametrize("buffer_size", [16, 60])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_the_next_samples_are_the_same(kind: str, n_envs: int, buffer_size: int, tmp_path: Path) -> None:
    model = make(kind, n_envs, buffer_size).learn(24 * n_envs)
    model.save_replay_buffer(tmp_path / "b")
    other = make(kind, n_envs, buffer_size)
    other.load_replay_buffer(tmp_path / "b", truncate_last_traj=False)
    saved, loaded = model.replay_buffer, other.replay_buffer
    assert type(loaded) is type(saved) and (loaded.pos, loaded.full) == (saved.pos, saved.full)
    assert vars(loaded).keys() == vars(saved).keys()
    for a, b in zip(samples(saved), samples(loaded), strict=True):
        np.testing.assert_array_equal(a, b)
    # And it is filled on in the same way.
    for agent in (model, other):
        agent.set_env(goals(n_envs) if kind.startswith("her") else vec(n_envs, obs_space=agent.observation_space))
        agent.set_random_seed(1)
        agent.learn(13 * n_envs)
    np.testing.assert_array_equal(np.asarray(model.replay_buffer.actions), np.asarray(other.replay_buffer.actions))
    for a, b in zip(samples(model.replay_buffer), samples(other.replay_buffer), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("kind", ["plain", "dict", "device", "her", "compact"])
def test_rows_that_were_never_filled_take_no_space(kind: str, tmp_path: Path) -> None:
    make(kind, 1, 100_000).learn(12).save_replay_buffer(tmp_path / "b")
    assert (tmp_path / "b.buffer.zip").stat().st_size < 20_000
    if kind != "her":
        other = make(kind, 1, 50)
        other.load_replay_buffer(tmp_path / "b")
        assert other.replay_buffer.buffer_size == 100_000


def test_truncated_trajectories(tmp_path: Path) -> None:
    model = make("her", 1, 50).learn(24)
    model.save_replay_buffer(tmp_path / "b")
    for truncate in (True, False):
        other = make("her", 1, 50)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            other.load_replay_buffer(tmp_path / "b", truncate_last_traj=truncate)
        assert other.replay_buffer.env is other.env
        assert (other.replay_buffer.ep_length > 0).sum() == (24 if truncate else 21)
    model.save(tmp_path / "m")
    alone = SAC.load(tmp_path / "m", env=goals(1))
    alone.env = None
    with pytest.raises(ValueError, match="needs the model's environment"):
        alone.load_replay_buffer(tmp_path / "b")


def test_names_pickles_and_other_kinds(tmp_path: Path) -> None:
    model = sac().learn(12)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b.pkl")
    model.load_replay_buffer(tmp_path / "b.pkl")
    file = io.BytesIO()
    model.save_replay_buffer(file)
    file.seek(0)
    model.load_replay_buffer(file)
    with pytest.raises(BadFile, match="holds a 'model', not a 'replay buffer'"):
        model.load_replay_buffer(tmp_path / "m.zip")
    model.save_replay_buffer(tmp_path / "pickled", allow_pickle=True)
    for name in ("pickled", "pickled.pkl"):
        with pytest.raises(PickledFile, match="allow_pickle=True"):
            model.load_replay_buffer(tmp_path / name)
        other = sac()
        other.load_replay_buffer(tmp_path / name, allow_pickle=True)
        assert other.replay_buffer.size() == 12
    with pytest.raises(FileNotFoundError):
        model.load_replay_buffer(tmp_path / "nowhere")


def test_what_a_file_holds_says_what_it_is_and_not_its_name(tmp_path: Path) -> None:
    model = sac().learn(12)
    model.save_replay_buffer(tmp_path / "b.pkl")  # by CheckpointCallback's name
    for name in ("b", "b.pkl"):
        model.load_replay_buffer(tmp_path / name)
        model.load_replay_buffer(str(tmp_path / name), allow_pickle=True)
    model.save_replay_buffer(tmp_path / "pickled.buffer.zip", allow_pickle=True)
    for name in ("pickled", "pickled.buffer.zip"):
        with pytest.raises(PickledFile, match="pickled.buffer.zip.*allow_pickle=True"):
            model.load_replay_buffer(tmp_path / name)
        model.load_replay_buffer(tmp_path / name, allow_pickle=True)
    # The name that save_replay_buffer gives comes first, and a folder is no file.
    sac().save_replay_buffer(tmp_path / "b")
    (tmp_path / "b").mkdir()
    model.load_replay_buffer(tmp_path / "b")
    assert model.replay_buffer.size() == 0
    with pytest.raises(FileNotFoundError, match=r"looked for .*/c and .*/c.buffer.zip and .*/c.pkl"):
        model.load_replay_buffer(tmp_path / "c")


@pytest.mark.parametrize("kind", ["plain", "compact", "her"])
def test_a_model_that_was_freed_of_its_buffer(kind: str, tmp_path: Path) -> None:
    model = make(kind, 1, 50).learn(24)
    model.save_replay_buffer(tmp_path / "b")
    model.save_replay_buffer(tmp_path / "pickled", allow_pickle=True)
    rows = samples(model.replay_buffer)
    for name in ("b", "pickled"):
        del model.replay_buffer
        with pytest.raises(ValueError, match="no replay buffer to save"):
            model.save_replay_buffer(tmp_path / "c")
        model.load_replay_buffer(tmp_path / name, truncate_last_traj=False, allow_pickle=True)
        for a, b in zip(rows, samples(model.replay_buffer), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("kind", ["plain", "dict", "device", "compact", "her"])
def test_a_buffer_of_another_number_of_environments(kind: str, tmp_path: Path) -> None:
    one, three = make(kind, 1, 50).learn(24), make(kind, 3, 50).learn(24)
    one.save_replay_buffer(tmp_path / "b")
    three.save_replay_buffer(tmp_path / "pickled", allow_pickle=True)
    for model, name, words in (
        (three, "b", r"b.buffer.zip: it is the buffer of 1 environments \(n_envs\), but the model has 3"),
        (one, "pickled", r"pickled.pkl: it is the buffer of 3 environments \(n_envs\), but the model has 1"),
    ):
        before = model.replay_buffer
        with pytest.raises(ValueError, match=words):
            model.load_replay_buffer(tmp_path / name, allow_pickle=True)
        assert model.replay_buffer is before
    one.load_replay_buffer(tmp_path / "b")


def test_what_environments_say_and_no_file_holds(tmp_path: Path) -> None:
    model = make("her_infos", 1, 50).learn(24)
    for row in model.replay_buffer.infos[:24]:
        row[0]["thing"] = object()
    with pytest.warns(UserWarning, match="replay_buffer.infos.thing is left out .an object of builtins.object"):
        model.save_replay_buffer(tmp_path / "b")
    other = make("her_infos", 1, 50)
    other.load_replay_buffer(tmp_path / "b")
    infos = other.replay_buffer.infos[:24, 0]
    assert [info["place"] for info in infos] == [info["place"] for info in model.replay_buffer.infos[:24, 0]]
    assert not any("thing" in info for info in infos)


def test_classes_and_spaces(tmp_path: Path) -> None:
    model = sac(replay_buffer_class=OwnBuffer)
    with pytest.warns(
        UserWarning, match="replay_buffer is .*OwnBuffer, for which load_replay_buffer needs trusted_modules="
    ):
        model.learn(12)
    model.save_replay_buffer(tmp_path / "b")
    # A class that the model itself has is the program's, and trusted; that of another model is not.
    model.load_replay_buffer(tmp_path / "b")
    with pytest.raises(BadFile, match="b.buffer.zip: .*not trusted"):
        sac().load_replay_buffer(tmp_path / "b")
    sac().load_replay_buffer(tmp_path / "b", trusted_modules=[__name__])
    for kind in (ReplayBuffer, None):
        wide = sac(vec(action_space=spaces.Box(-1, 1, (3,))), replay_buffer_class=kind).learn(12)
        wide.save_replay_buffer(tmp_path / "wide")
        before = model.replay_buffer
        with pytest.raises(ValueError, match=r"wide.*(action_space|actions must be)"):
            model.load_replay_buffer(tmp_path / "wide")
        assert model.replay_buffer is before
    held_out = sac(validation_proportion=0.5).learn(12)
    held_out.save_replay_buffer(tmp_path / "v")
    with pytest.raises(ValueError, match=r"holds out 0.5 of its transitions, but this model has .*=0.0"):
        model.load_replay_buffer(tmp_path / "v")
    assert model.replay_buffer is before
    model.replay_buffer = None
    with pytest.raises(ValueError, match="no replay buffer to save"):
        model.save_replay_buffer(tmp_path / "b")


def attribute(name: str, value: Any) -> Any:
    return lambda tree: tree["attributes"].update({name: {"whole": value}})


def set_tree(*path: str, value: Any) -> Any:
    def change(tree: Any) -> None:
        for key in path[:-1]:
            tree = tree[key]
        tree[path[-1]] = value

    return change


HOSTILE: list[tuple[str, Any]] = [
    ("plain", attribute("pos", -1)), ("plain", attribute("pos", 500)), ("plain", attribute("pos", 1.5)),
    ("plain", attribute("full", 1)), ("plain", attribute("buffer_size", 10**15)), ("plain", attribute("n_envs", 0)),
    ("plain", attribute("buffer_size", 10)), ("plain", attribute("sample", 3)), ("plain", attribute("env", 3)),
    ("plain", attribute("__class__", 3)), ("plain", attribute("observations", 3)), ("plain", attribute("rewards", [])),
    ("plain", attribute("observation_space", 3)), ("plain", lambda tree: tree["attributes"].pop("pos")),
    ("plain", lambda tree: tree["attributes"].pop("actions")),
    ("plain", set_tree("attributes", "rewards", "rows", value=10**15)),
    ("plain", set_tree("attributes", "rewards", "rows", value=1)),
    ("plain", set_tree("attributes", "rewards", value=3)), ("plain", set_tree("attributes", value=3)),
    ("plain", set_tree("class", value="os:system")), ("plain", set_tree("class", value=3)),
    ("plain", set_tree("class", value="sb3_sample.sac.policies:SACPolicy")),
    ("plain", set_tree("class", value="stable_baselines3.common.buffers:RolloutBuffer")),
    ("her", set_tree("attributes", "infos", "first", value=[[3]])),
    ("her", set_tree("attributes", "infos", "first", value=[[]])),
    ("compact", set_tree("arguments", "buffer_size", value=10**12)), ("compact", set_tree("arguments", value=3)),
    ("compact", set_tree("arguments", "memory_map", value="/tmp")), ("compact", set_tree("state", value=3)),
    ("compact", set_tree("arguments", "n_envs", value="x")), ("compact", lambda tree: tree["arguments"].clear()),
    ("compact", set_tree("state", "dict", "pos", value=77)),
    ("compact", set_tree("state", "dict", "pos", value=-3)),
    ("compact", set_tree("state", "dict", "observations", value=3)),
    ("compact", set_tree("state", "dict", "next_index", value=[1, 10**9])),
    ("compact", lambda tree: tree["state"]["dict"].clear()), ("compact", lambda tree: tree.clear()),
]  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("buffers")
    for kind in ("plain", "her", "compact"):
        make(kind, 1, 50).learn(24).save_replay_buffer(folder / kind)
    return folder


@pytest.mark.parametrize(("kind", "change"), HOSTILE)
def test_hostile_files(kind: str, change: Any, files: Path) -> None:
    tree, tensors = container.read(files / f"{kind}.buffer.zip", "replay buffer")
    change(tree)
    file = io.BytesIO()
    container.write(file, "replay buffer", json.loads(json.dumps(tree)), tensors)
    file.seek(0)
    model = make(kind, 1, 50)
    before = model.replay_buffer
    with pytest.raises(ValueError, match="the file: "):
        model.load_replay_buffer(file)
    assert model.replay_buffer is before


def test_a_large_buffer_is_not_copied(tmp_path: Path) -> None:
    """What is written is the buffer's own memory."""
    model = make("plain", 1, 50).learn(24)
    encoder = Lenient({})
    encode_buffer(model.replay_buffer, encoder)
    assert encoder.tensors["replay_buffer.observations"].data_ptr() == model.replay_buffer.observations.ctypes.data


def test_a_buffer_far_larger_than_the_models_own(tmp_path: Path) -> None:
    """What a file does not hold, it cannot make memory of, unless the model has as much anyway."""
    for env, kwargs, size in (
        (vec(), {}, 20_000_001),
        (goals(1), {"policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer}, 1_000_001),
    ):
        model = sac(env, **kwargs)
        model.save_replay_buffer(tmp_path / "b")
        tree, tensors = container.read(tmp_path / "b.buffer.zip", "replay buffer")
        arguments = tree.get("arguments")
        if arguments is None:
            tree["attributes"]["buffer_size"]["whole"] = size
        else:
            arguments["buffer_size"] = size
        container.write(tmp_path / "c.buffer.zip", "replay buffer", tree, tensors)
        with pytest.raises(BadFile, match=f"{size} rows of 1 environments, at most {size - 1} transitions in all"):
            model.load_replay_buffer(tmp_path / "c")


@pytest.mark.parametrize("allow_pickle", [False, True])
def test_a_name_with_a_dot_is_that_of_a_model_too(allow_pickle: bool, tmp_path: Path) -> None:
    model = sac()
    model.learn(20)
    model.save(tmp_path / "sac-lr0.001")
    model.save_replay_buffer(tmp_path / "sac-lr0.001", allow_pickle=allow_pickle)
    loaded = SAC.load(tmp_path / "sac-lr0.001")
    loaded.load_replay_buffer(tmp_path / "sac-lr0.001", allow_pickle=allow_pickle)
    assert loaded.replay_buffer.size() == 20
