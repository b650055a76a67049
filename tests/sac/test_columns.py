"""A column of one's own, by its declaration alone: in batches, in files, in checkpoints and in runs that go on."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_sample import SAC, CompactDictReplayBuffer, CompactReplayBuffer, Dataset
from sb3_sample.parts import Batch, BatchTransform, Column
from sb3_sample.replay import columns
from sb3_sample.replay.buffers import (
    BatchMemory,
    DeviceReplayBuffer,
    ValidationReplayBuffer,
    latest,
    samples_as_its_class,
)
from sb3_sample.replay.mixture import Mixture
from sb3_sample.saving.container import BadFile
from sb3_sample.saving.rings import Ring
from tests.sac.common import Toy, differing, sac, state, vec

TASK = Column("task", lambda step: [info["task"] for info in step.infos], dtype=np.int64)
#: Of the step, not of the infos; several numbers.
EXTENT = Column("extent", lambda step: np.stack([step.reward, -step.reward], axis=1), shape=(2,))


class TaskReplay(CompactReplayBuffer):
    more_columns = (TASK, EXTENT)


class DictTaskReplay(CompactDictReplayBuffer):
    more_columns = (TASK, EXTENT)


class HeldOutTaskReplay(ValidationReplayBuffer):
    more_columns = (TASK, EXTENT)


class DeviceTaskReplay(DeviceReplayBuffer):
    more_columns = (TASK, EXTENT)


class WithPriorities(TaskReplay):
    more_columns = (Column("priority", None, is_flag=True),)


class Tasks(gym.Wrapper):
    """Episode after episode another task: its number is in the infos, and in hundreds in the reward."""

    def __init__(self, env: gym.Env, first: int):
        super().__init__(env)
        self.task = first

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        given = observation, 100 * self.task + float(reward), terminated, truncated, info | {"task": self.task}
        self.task = (self.task + (terminated or truncated)) % 7
        return given


def tasks(n_envs: int = 2, **kwargs: Any) -> DummyVecEnv:
    return DummyVecEnv([lambda i=i: Monitor(Tasks(Toy(**kwargs), 3 * i)) for i in range(n_envs)])


class Spy(BatchTransform):
    """Keeps the batches that are learned from."""

    def __init__(self, learner: Any):
        super().__init__(learner)
        self.seen: list[Batch] = []

    def transform(self, batch: Batch, noise: torch.Tensor | None) -> Batch:
        self.seen.append(
            batch._replace(
                columns={name: x.clone() for name, x in batch.columns.items()}, rewards=batch.rewards.clone()
            )
        )
        return batch


def make(cls: type = TaskReplay, env: Any = None, **kwargs: Any) -> Any:
    return sac(tasks() if env is None else env, replay_buffer_class=cls, **{"buffer_size": 60, **kwargs})


def check(batch: Any) -> None:
    """Every row has the task whose reward it has."""
    n = len(batch.rewards)
    assert batch.columns.keys() == {"task", "extent"}
    task, extent = batch.columns["task"], batch.columns["extent"]
    assert (task.dtype, task.shape, extent.dtype, extent.shape) == (torch.int64, (n, 1), torch.float32, (n, 2))
    assert torch.equal(task, batch.rewards.long() // 100) and len(task.unique()) > 1
    assert torch.equal(extent, torch.cat((batch.rewards, -batch.rewards), 1))


@pytest.mark.parametrize("cls", [TaskReplay, HeldOutTaskReplay, DeviceTaskReplay, DictTaskReplay])
def test_in_batches(cls: Any) -> None:
    env, policy = None, "MlpPolicy"
    if cls is DictTaskReplay:
        env, policy = tasks(obs_space=spaces.Dict({"a": spaces.Box(-9, 9, (2,), np.float32)})), "MultiInputPolicy"
    kwargs = {"validation_proportion": 0.3} if cls is HeldOutTaskReplay else {}
    model = make(cls, env, batch_transforms=[Spy], policy=policy, **kwargs).learn(150)
    seen = model.transforms[0].seen
    assert len(seen) > 50
    check(
        Batch(
            *(
                torch.cat([getattr(b, name) for b in seen]) if name in ("rewards",) else None
                for name in Batch._fields[:-1]
            ),
            columns={name: torch.cat([b.columns[name] for b in seen]) for name in ("task", "extent")},
        )
    )
    # By the buffer's own methods too.
    check(model.replay_buffer.sample(200))
    if cls is not DeviceTaskReplay:
        check(columns.samples_at(model.replay_buffer, np.arange(30), np.zeros(30, int)))
        check(latest(model.replay_buffer, 20)[0])
        assert BatchMemory.serves(model.replay_buffer, None)
    if cls is HeldOutTaskReplay:
        check(model.replay_buffer.sample_validation(100))
    assert samples_as_its_class(model.replay_buffer)


@pytest.mark.parametrize(
    "cls", [TaskReplay, *(pytest.param(cls, marks=pytest.mark.slow) for cls in (HeldOutTaskReplay, DeviceTaskReplay))]
)
def test_in_files_and_checkpoints(cls: Any, tmp_path: Path) -> None:
    kwargs: Any = {"validation_proportion": 0.3} if cls is HeldOutTaskReplay else {}
    model = make(cls, **kwargs).learn(160, checkpoint=tmp_path / "a", checkpoint_freq=50)
    model.save_replay_buffer(tmp_path / "b")
    other = make(cls, seed=4, **kwargs).learn(20)
    other.load_replay_buffer(tmp_path / "b", trusted_modules=[__name__])
    for name in ("task", "extent", "rewards"):
        ours, theirs = (np.asarray(getattr(m.replay_buffer, name)) for m in (model, other))
        assert np.array_equal(ours, theirs) and ours.any()
    # The rows of a checkpoint have them.
    ring = Ring(model.replay_buffer, lambda: 0)
    assert {"task", "extent"} <= ring.rows(ring.n_rows - 5).keys()
    # A run that goes on is the one that was never cut, and knows its tasks.
    make(cls, **kwargs).learn(90, checkpoint=tmp_path / "c", checkpoint_freq=50)
    resumed = make(cls, **kwargs).learn(160, checkpoint=tmp_path / "c", checkpoint_freq=50)
    assert resumed._n_updates == model._n_updates and not differing(state(resumed), state(model))
    for name in ("task", "extent"):
        ours, theirs = (np.asarray(getattr(m.replay_buffer, name)) for m in (model, resumed))
        assert np.array_equal(ours, theirs)
    check(resumed.replay_buffer.sample(200))


def test_a_file_of_other_columns_is_refused(tmp_path: Path) -> None:
    for cls, other in ((CompactReplayBuffer, TaskReplay), (TaskReplay, CompactReplayBuffer)):
        model = make(cls).learn(20)
        state = model.replay_buffer.state_dict()
        with pytest.raises(ValueError, match=r"this buffer's columns are \[.*\], the saved \["):
            make(other).replay_buffer.load_state_dict(state)
    make(CompactReplayBuffer).learn(20, checkpoint=tmp_path / "a", checkpoint_freq=10)
    with pytest.raises(ValueError, match="replay_buffer_class"):
        make(TaskReplay).learn(40, checkpoint=tmp_path / "a", checkpoint_freq=10)
    model = make().learn(20)
    model.replay_buffer.extent[3, 0, 1] = np.nan
    model.save_replay_buffer(tmp_path / "b")
    with pytest.raises(BadFile, match="extent hold nan, which is not finite"):
        make().load_replay_buffer(tmp_path / "b", trusted_modules=[__name__])


def test_one_that_the_buffer_writes_itself(tmp_path: Path) -> None:
    model = make(WithPriorities).learn(40)
    buffer = model.replay_buffer
    assert list(buffer.columns())[-3:] == ["task", "extent", "priority"] and not buffer.priority.any()
    buffer.priority[5] = 1
    model.save_replay_buffer(tmp_path / "b")
    other = make(WithPriorities)
    other.load_replay_buffer(tmp_path / "b", trusted_modules=[__name__])
    assert np.array_equal(other.replay_buffer.priority, buffer.priority)
    assert buffer.sample(50).columns.keys() == {"task", "extent", "priority"}


def test_the_rest_is_as_without() -> None:
    """The same run, bit for bit, in both ways of drawing; without a declaration batches have no such columns."""
    models = [make(cls).learn(100) for cls in (TaskReplay, CompactReplayBuffer, ReplayBuffer)]
    assert not differing(state(models[0]), state(models[1])) and not differing(state(models[1]), state(models[2]))
    assert models[1].learner.update(Batch.of(models[1].replay_buffer.sample(8), 0.9))
    assert Batch.of(models[1].replay_buffer.sample(8), 0.9).columns == {}


def test_in_files_instead_of_memory(tmp_path: Path) -> None:
    model = make(replay_buffer_kwargs={"memory_map": str(tmp_path / "m")}).learn(80)
    check(model.replay_buffer.sample(200))


def test_of_data_sets_and_mixtures() -> None:
    rng = np.random.default_rng(0)
    task = np.repeat([0, 1, 2], 10)
    arrays: Any = (
        rng.normal(size=(30, 3)),
        rng.uniform(-1, 1, (30, 2)),
        100.0 * task,
        np.zeros(30),
        np.arange(30) % 10 == 9,
    )
    extent = np.stack([arrays[2], -arrays[2]], 1)
    data = Dataset.from_arrays(*arrays, columns={"task": task, "extent": extent})
    check(data.sample(50))
    model = make().learn(80)
    mixed = Mixture([data, model._source], (0.5, 0.5)).sample(60)
    check(mixed)
    with pytest.raises(ValueError, match=r"same columns to be mixed, not \[\['extent', 'task'\], \[\]\]"):
        Mixture([data, Dataset.from_arrays(*arrays)], (0.5, 0.5)).sample(8)
    with pytest.raises(ValueError, match="task must have as many steps as rewards, 30, not 29"):
        Dataset.from_arrays(*arrays, columns={"task": task[1:]})


@pytest.mark.parametrize(
    ("column", "words"),
    [
        (Column("rewards", None), "has the name 'rewards', which is taken or none"),
        (Column("sample", None), "has the name 'sample', which is taken or none"),
        (Column("a b", None), "has the name 'a b', which is taken or none"),
    ],
)
def test_names_that_are_taken(column: Column, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        type("Wrong", (CompactReplayBuffer,), {"more_columns": (column,)})
    with pytest.raises(ValueError, match="has the name 'pos', which is taken"):
        make(type("Pos", (CompactReplayBuffer,), {"more_columns": (Column("pos", None),)}))
    with pytest.raises(TypeError, match="more_columns of Wrong must be of Column, not 'task'"):
        type("Wrong", (CompactReplayBuffer,), {"more_columns": ("task",)})
    with pytest.raises(TypeError, match=r"more_columns of Wrong must be a tuple of Column, not Column\(name='task'"):
        type("Wrong", (CompactReplayBuffer,), {"more_columns": TASK})


def test_values_that_are_none() -> None:
    def with_values(read: Any, **kwargs: Any) -> Any:
        columns = (Column("x", read, **kwargs),)
        return make(type("Local", (CompactReplayBuffer,), {"more_columns": columns}), vec()).learn

    with pytest.raises(ValueError, match="read of the column 'x' of Local must give a list, one value .* not 1"):
        with_values(lambda step: 1.0)(5)
    with pytest.raises(KeyError, match="nothing") as raised:
        with_values(lambda step: [info["nothing"] for info in step.infos])(5)
    assert raised.value.__notes__ == ["in read of the column 'x' of Local"]
    with pytest.raises(ValueError, match="the column 'x' must be finite, not nan"):
        with_values(lambda step: [np.nan])(5)
    for dtype in (np.float32, bool, np.uint8):
        with pytest.raises(ValueError, match="the column 'x' must be 0 or 1, not 2"):
            with_values(lambda step: [2], dtype=dtype, is_flag=True)(5)
        with_values(lambda step: [True], dtype=dtype, is_flag=True)(5)
    for value in (300, 1.5, -1):
        with pytest.raises(ValueError, match=rf"the column 'x' must be whole numbers within uint8, not \[{value}\]"):
            with_values(lambda step, value=value: [value], dtype=np.uint8)(5)
    with_values(lambda step: [255.0], dtype=np.uint8)(5)
    with pytest.raises(ValueError, match=r"whole numbers within int32, not \[nan\]"):
        with_values(lambda step: [np.nan], dtype=np.int32)(5)
    for given in ([3], [[1, 2]]):  # repeated or without the first axis, as assignment to an array does
        column = (Column("task", lambda step, given=given: given, dtype=np.int32),)
        model = make(type("Local", (CompactReplayBuffer,), {"more_columns": column}), vec(2)).learn(10)
        assert np.broadcast_to(given, (1, 2)).tolist() == model.replay_buffer.task[:1].tolist()
    with pytest.raises(ValueError, match=r"could not broadcast the x of shape \(2,\) into shape \(1,\)"):
        with_values(lambda step: [1.0, 2.0])(5)


def test_held_out_by_a_buffer_that_can() -> None:
    with pytest.raises(ValueError, match="TaskReplay is not one that holds .* derive it"):
        make(validation_proportion=0.3)
    with pytest.raises(ValueError, match="HeldOutTaskReplay is one that .* CompactReplay"):
        make(HeldOutTaskReplay)


def test_loaded_with_its_model(tmp_path: Path) -> None:
    model = make().learn(40)
    model.save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=tasks(), trusted_modules=[__name__])
    assert type(loaded.replay_buffer) is TaskReplay
    check(loaded.learn(40, reset_num_timesteps=False).replay_buffer.sample(100))
