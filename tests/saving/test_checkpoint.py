"""What a checkpoint holds, what it refuses, and what happens when it cannot be written or read."""

import collections
import enum
import errno
import gc
import json
import os
import resource
import signal
import stat
import subprocess
import time
import warnings
import zipfile
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EveryNTimesteps, StopTrainingOnMaxEpisodes
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_sample import MBMAPPO, SAC, CompactReplayBuffer
from sb3_sample.replay.buffers import DeviceReplayBuffer
from sb3_sample.sac.policies import MlpPolicy
from sb3_sample.saving import container, run_folder, training_state
from sb3_sample.saving.attributes import Describer, same
from sb3_sample.saving.callbacks import CallbackStates
from sb3_sample.saving.container import BadFile
from sb3_sample.saving.encoding import NotPortable, decode, encode
from sb3_sample.saving.identity import identity_of
from sb3_sample.saving.kept import Kept, declared
from sb3_sample.saving.model_tree import Description
from sb3_sample.saving.normalization import load_vec_normalize, save_vec_normalize
from sb3_sample.saving.run_folder import RunFolder
from tests.agents import OFF_POLICY, env_of
from tests.ppo.common import EVERY, tiny
from tests.sac.common import MAKERS, Toy, bro, differing, sac, state, vec
from tests.saving.hostile_folders import facts_of, rewritten
from tests.saving.program import Goal, outcome

STEPS = dict(checkpoint_freq=10)


def steps_of(folder: Path) -> list[int]:
    return sorted(int(path.name.split("-")[1]) for path in folder.glob("checkpoint-*"))


# ---------------------------------------------------------------- what is held


@pytest.mark.parametrize(
    "maker",
    [
        pytest.param(maker, marks=[] if maker in ("BRO", "VPLSAC", MBMAPPO) else pytest.mark.slow)
        for maker in (*OFF_POLICY, *EVERY)
    ],
)
def test_every_attribute_that_changes_is_held(maker: Any, tmp_path: Path) -> None:
    """Fails when somebody adds state to an algorithm that no checkpoint holds."""

    def model() -> Any:
        if isinstance(maker, str):
            return OFF_POLICY[maker](env_of(maker, 2))
        return tiny(maker, vec(2), warm_up_until=0.5)

    def look(owner: Any) -> dict[str, Any]:
        """Everything about an object, its parts by their identity."""
        seen = {}
        for name, value in vars(owner).items():
            one = type("", (), {})()
            vars(one)[name] = value
            described, opaque = Describer().attributes(one)
            seen[name] = described.get(name, id(value)) if not opaque else id(value)
        return seen

    agent = model()
    agent.learn(32)
    before = look(agent)
    agent.learn(96, reset_num_timesteps=False)
    after = look(agent)
    changed = {name for name in after if not same(after[name], before.get(name))}
    assert len(changed) > 8
    held = training_state.save_attributes(agent).keys()
    modules = {name.split(".")[0] for name in agent._get_torch_save_params()[0]}
    modules |= {"actor", "critic", "critic_target"} & vars(agent).keys()
    derived = {name for name, places in declared(type(agent)).items() if Kept.IN_CHECKPOINTS not in places}
    assert not changed - held - modules - derived
    # Whatever is left out is declared, whether it has changed or not; what is no plain data is given by the program.
    given = {*training_state.argument_names(type(agent)), "observation_space", "policy_class"}
    assert not vars(agent).keys() - held - modules - derived - given
    in_no_file = {name for name, places in declared(type(agent)).items() if Kept.IN_FILES not in places}
    assert set(agent._excluded_save_params()) - modules == in_no_file
    assert Description(agent).encoder.left_out == {}

    # And the other way round: what is restored is the same, down to the attributes of the parts.
    agent = model()
    agent.learn(128, checkpoint=tmp_path / "run", checkpoint_freq=32)
    restored = model()
    restored.learn(128, checkpoint=tmp_path / "run")
    if getattr(agent, "learning_rate_schedule", None) is not None:
        # Rates by a schedule follow from the count of steps, before each step.
        for each in (agent, restored):
            each.learner.set_learning_rate(0.0)
    for name in modules:
        for (path, ours), (_, theirs) in zip(
            _with_parts(getattr(agent, name)), _with_parts(getattr(restored, name)), strict=True
        ):
            assert same(_plain(ours), _plain(theirs)), (name, path)
    assert not differing_outcomes(outcome(agent, str(tmp_path / "run")), outcome(restored, str(tmp_path / "run")))


class WithClock(SAC):
    """It keeps what no file can hold, and says nothing of it."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self.clock = iter(range(3))
        self.step = 0


class WithDeclaredClock(WithClock):
    _kept: ClassVar[dict[str, Kept]] = {"clock": Kept.NOWHERE, "step": Kept.IN_CHECKPOINTS}


def test_an_attribute_is_declared_or_refused(tmp_path: Path) -> None:
    with pytest.raises(NotPortable, match="WithClock has attributes that a checkpoint cannot hold: clock"):
        training_state.save_attributes(sac(cls=WithClock))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = sac(cls=WithDeclaredClock)
        model.step = 3
        held = training_state.save_attributes(model)
        assert "clock" not in held and "step" in held
        model.save(tmp_path / "m")
        assert WithDeclaredClock.load(tmp_path / "m").step == 0
    # The bases' declarations stay in force.
    assert declared(WithDeclaredClock) == {**declared(SAC), **WithDeclaredClock._kept}


def test_what_is_declared_is_there() -> None:
    """No name in a declaration that no algorithm has any more."""
    trained = [OFF_POLICY[maker](env_of(maker, 2)).learn(32) for maker in ("BRO", "SRSPR")]
    trained += [tiny(cls, vec(2)).learn(32) for cls in EVERY]
    names = {name for model in trained for name in declared(type(model))}
    assert [name for name in names if not any(hasattr(model, name) for model in trained)] == []


def _with_parts(module: Any) -> list[tuple[str, Any]]:
    return list(module.named_modules()) if isinstance(module, torch.nn.Module) else [("", module)]


def _plain(owner: Any) -> dict[str, Any]:
    skip = ("_modules", "training", "_compiled_call_impl")
    ours = isinstance(owner, torch.nn.Module) and type(owner).__module__.startswith("sb3_sample")
    return Describer().attributes(owner, skip)[0] if ours else {}


def differing_outcomes(first: dict[str, str], second: dict[str, str]) -> list[str]:
    return sorted(name for name in first.keys() | second.keys() if first.get(name) != second.get(name))


def test_a_finished_run_returns_at_once_with_its_state(tmp_path: Path) -> None:
    trained = bro().learn(33, checkpoint=tmp_path, **STEPS)
    assert steps_of(tmp_path) == [30, 33]
    again = bro(verbose=1)
    with pytest.warns(
        UserWarning, match=r"Nothing is left to train: .* has 33 steps already, of 33\. .* larger total_"
    ):
        again.learn(33, checkpoint=tmp_path, **STEPS)
    with pytest.warns(UserWarning, match="has 33 steps already, of 20"):
        assert bro().learn(20, checkpoint=tmp_path, **STEPS).num_timesteps == 33
    assert again.num_timesteps == 33 and not differing(state(trained), state(again))
    assert again._n_updates == trained._n_updates and again.replay_buffer.pos == 33
    assert steps_of(tmp_path) == [30, 33]
    # Longer than it was planned.
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="Nothing is left")
        again = bro().learn(45, checkpoint=tmp_path, **STEPS)
    assert not differing(state(bro().learn(45)), state(again))
    assert steps_of(tmp_path) == [40, 45]


@pytest.mark.parametrize("make", [sac, tiny])
def test_a_folder_is_for_one_call_of_learn(make: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    model = make().learn(40, checkpoint="a", checkpoint_freq=20)
    steps, files = model.num_timesteps, {path: path.stat().st_mtime_ns for path in Path("a").rglob("*")}
    for folder, reset in (("a", True), (tmp_path / "b" / ".." / "a", False)):
        with pytest.raises(ValueError, match="another folder for each call of learn"):
            model.learn(40, checkpoint=folder, reset_num_timesteps=reset)
    # One that goes on with the first one's model is a second call, too, whatever object it is.
    model.save("model")
    loaded = type(model).load("model", env=make().env)
    with pytest.raises(ValueError, match=rf"num_timesteps={steps}: the run of checkpoint='a' was made with .*=0"):
        loaded.learn(40, checkpoint="a", reset_num_timesteps=False)
    assert loaded.num_timesteps == model.num_timesteps == steps
    assert {path: path.stat().st_mtime_ns for path in Path("a").rglob("*")} == files
    model.learn(40, checkpoint="b", reset_num_timesteps=False)
    assert model.num_timesteps == 2 * steps


class StopAt(BaseCallback):
    """Interrupts the training, in one call of it."""

    def __init__(self, step: int):
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        if self.num_timesteps == self.step:
            raise KeyboardInterrupt
        return True


def test_a_program_of_two_calls_ends_where_it_would_have_ended(tmp_path: Path) -> None:
    def program(folder: Path, callback: Any = None) -> Any:
        model = sac().learn(30, checkpoint=folder / "first", **STEPS)
        return model.learn(30, callback, reset_num_timesteps=False, checkpoint=folder / "second", **STEPS)

    with pytest.raises(KeyboardInterrupt):
        program(tmp_path / "killed", StopAt(45))
    assert not differing(state(program(tmp_path / "whole")), state(program(tmp_path / "killed")))


def test_a_call_that_was_interrupted_goes_on_with_the_same_model(tmp_path: Path) -> None:
    """As when the cell of a notebook is run once more."""
    model = sac()
    with pytest.raises(KeyboardInterrupt):
        model.learn(40, StopAt(25), checkpoint=tmp_path, **STEPS)
    assert not differing(state(sac().learn(40)), state(model.learn(40, checkpoint=tmp_path, **STEPS)))


class Failing(Toy):
    """Raises once, at a step."""

    left = 1

    def step(self, action: np.ndarray) -> Any:
        if self.total == 28 and Failing.left:
            Failing.left -= 1
            raise OSError("the simulator is gone")
        return super().step(action)


class Counting(BaseCallback):
    """Counts in its own attributes, and marks the beginning of a training."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[int] = []
        self.left = 5
        self.rng = np.random.default_rng(0)
        self.sampler = collections.UserList([self.rng])

    def _on_training_start(self) -> None:
        self.begun = time.perf_counter()

    def _on_step(self) -> bool:
        self.seen.append(self.num_timesteps)
        self.left -= 1
        self.drawn = (*getattr(self, "drawn", ()), self.rng.random(), self.sampler[0].random())
        return True


@pytest.mark.parametrize("every", [1000, 10])
def test_a_call_is_repeated_with_the_same_callbacks(every: int, tmp_path: Path) -> None:
    """They are as at the checkpoint, without what the steps after it have changed."""

    def callbacks(folder: Path) -> list[Any]:
        evaluation = EvalCallback(
            vec(), n_eval_episodes=1, eval_freq=7, log_path=str(folder), best_model_save_path=str(folder), verbose=0
        )
        return [evaluation, Counting()]

    Failing.left = 1
    same_ones, expected = callbacks(tmp_path / "ours"), callbacks(tmp_path / "theirs")
    model = sac(DummyVecEnv([lambda: Monitor(Failing())]))
    with pytest.raises(OSError, match="the simulator is gone"):
        model.learn(40, same_ones, checkpoint=tmp_path / "run", checkpoint_freq=every)
    begun = same_ones[1].begun
    model.learn(40, same_ones, checkpoint=tmp_path / "run", checkpoint_freq=every)
    sac().learn(40, expected)
    assert same_ones[1].seen == expected[1].seen == list(range(1, 41)) and same_ones[1].left == -35
    assert same_ones[1].begun > begun and same_ones[1].drawn == expected[1].drawn
    ours, theirs = (np.load(tmp_path / name / "evaluations.npz") for name in ("ours", "theirs"))
    assert ours["timesteps"].tolist() == theirs["timesteps"].tolist() == [7, 14, 21, 28, 35]
    assert same_ones[0].best_mean_reward == ours["results"].max()


def test_the_training_is_the_same_with_checkpoints_and_without(tmp_path: Path) -> None:
    assert not differing(state(bro().learn(40)), state(bro().learn(40, checkpoint=tmp_path, **STEPS)))


def test_at_the_first_turn_at_or_after_each_multiple(tmp_path: Path) -> None:
    seen = []

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            seen.extend(step for step in steps_of(tmp_path) if step not in seen)
            return True

    sac(vec(3)).learn(60, Watch(), checkpoint=tmp_path, checkpoint_freq=20)
    assert seen == [0, 21, 42]
    assert steps_of(tmp_path) == [42, 60]


def test_the_model_can_be_loaded_alone(tmp_path: Path) -> None:
    trained = bro().learn(30, checkpoint=tmp_path, **STEPS)
    loaded = type(trained).load(tmp_path / "checkpoint-000000000030" / "model.zip")
    assert not differing(state(trained), state(loaded))


def test_many_pieces_become_one(tmp_path: Path, monkeypatch: Any) -> None:
    """So that a manifest stays short, however long the run is."""
    monkeypatch.setattr(run_folder, "MAX_SEGMENTS", 4)
    sac(buffer_size=60).learn(75, checkpoint=tmp_path, checkpoint_freq=5)
    pieces = sorted(path.name for path in (tmp_path / "replay").iterdir())
    assert len(pieces) <= 5 and pieces[0] == "model-000000000005-000000000065.zip"
    again = sac(buffer_size=60).learn(100, checkpoint=tmp_path, checkpoint_freq=5)
    assert not differing(state(sac(buffer_size=60).learn(100)), state(again))


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("buffer", [None, ReplayBuffer])
def test_rows_that_a_manifest_does_not_name_are_missed(which: int, buffer: Any, tmp_path: Path) -> None:
    def model() -> Any:
        return sac() if buffer is None else sac(replay_buffer_class=buffer)

    model().learn(30, checkpoint=tmp_path, **STEPS)
    (path,) = tmp_path.glob("checkpoint-*30/manifest.json")

    def leave_out(manifest: Any) -> None:
        del manifest["segments"][sorted(manifest["segments"])[which]]

    rewritten(path, leave_out)
    with pytest.raises(ValueError, match="the rows|the steps"):
        model().learn(40, checkpoint=tmp_path, **STEPS)


def test_rows_are_written_once(tmp_path: Path) -> None:
    sizes: dict[str, tuple[int, int]] = {}

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            for path in (tmp_path / "replay").iterdir():
                facts = (path.stat().st_mtime_ns, path.stat().st_ino)
                assert sizes.setdefault(path.name, facts) == facts
            return True

    sac(buffer_size=35).learn(100, Watch(), checkpoint=tmp_path, **STEPS)
    assert sorted(sizes) == [f"model-{first:012d}-{first + 10:012d}.zip" for first in range(0, 90, 10)]
    # What the two checkpoints need, of a buffer of 35 rows.
    assert len(list((tmp_path / "replay").iterdir())) == 5


def test_the_log_goes_on(tmp_path: Path) -> None:
    for steps in (30, 60):
        sac().learn(steps, log_interval=1, checkpoint=tmp_path, checkpoint_freq=1000)
        # What was written after the last checkpoint is written again.
        with (tmp_path / "progress.jsonl").open("a") as file:
            file.write('{"step": 1000}\n{"half a li')
    lines = [json.loads(line) for line in (tmp_path / "progress.jsonl").read_text().splitlines()[:-2]]
    assert [line["step"] for line in lines] == [7, 14, 21, 28, 35, 42, 49, 56]
    assert lines[-1]["train/critic_loss"] and lines[-1]["time/episodes"] == 8
    sac().learn(60, checkpoint=tmp_path)
    assert (tmp_path / "progress.jsonl").read_text().splitlines()[-1].startswith('{"step": 56')


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(gamma=0.5), r"gamma=0.5: the run .* was made with gamma=0.99"),
        (dict(seed=1), "seed=1"),
        (dict(replay_ratio=2), "replay_ratio=2"),
        (dict(policy_kwargs={"net_arch": [8, 4]}), r"policy_kwargs=.*\[8, 4\]"),
        (dict(env=vec(2)), "env=.*'n_envs': 2"),
        (dict(env=VecNormalize(vec())), "env=.*VecNormalize"),
        (dict(env=vec(action_space=spaces.Box(-2, 2, (2,)))), "action_space=Box"),
        (dict(cls=type(MAKERS["OAC"]())), "class=.*OAC"),
    ],
)  # fmt: skip
def test_another_run_is_refused(change: dict[str, Any], words: str, tmp_path: Path) -> None:
    sac().learn(20, checkpoint=tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    with pytest.raises(ValueError, match=words):
        sac(**change).learn(40, checkpoint=tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    # The folder is free again, and where and how loudly it computes makes no difference.
    sac(verbose=1, compile=False).learn(30, checkpoint=tmp_path)


def test_a_time_limit_is_part_of_the_run(tmp_path: Path) -> None:
    def env(limit: int) -> Any:
        return gym.make("Pendulum-v1", max_episode_steps=limit)

    sac(env(20)).learn(20, checkpoint=tmp_path)
    with pytest.raises(ValueError, match="env=.*max_episode_steps=30"):
        sac(env(30)).learn(40, checkpoint=tmp_path)


def test_a_folder_of_the_users_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "replay").mkdir()
    (tmp_path / "replay" / "model-000000000000-000000000010.zip").write_text("the user's")
    (tmp_path / "progress.jsonl").write_text("the user's")
    for model in (sac(), tiny()):
        with pytest.raises(ValueError, match=r"holds progress\.jsonl, which is of no run of sb3_sample"):
            model.learn(20, checkpoint=tmp_path)
        assert model.num_timesteps == 0
    assert {path.read_text() for path in tmp_path.rglob("*") if path.is_file()} == {"the user's"}
    assert len(list(tmp_path.rglob("*"))) == 3


def test_a_run_that_was_killed_before_its_first_checkpoint_is_taken_up(tmp_path: Path, monkeypatch: Any) -> None:
    def killed(*args: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "write", killed)
        patch.setattr(RunFolder, "remove_segments", lambda *_: None)
        with pytest.raises(KeyboardInterrupt):
            sac().learn(20, checkpoint=tmp_path)
    (tmp_path / "progress.jsonl").write_text('{"step": 7}\n')
    assert not steps_of(tmp_path)
    assert not differing(state(sac().learn(20)), state(sac().learn(20, checkpoint=tmp_path)))


@pytest.mark.parametrize("freq", [0, -1, 1.5, True, None])
def test_checkpoint_freq_is_checked(freq: Any, tmp_path: Path) -> None:
    for model in (sac(), tiny()):
        with pytest.raises(ValueError, match="checkpoint_freq must be an integer of at least 1"):
            model.learn(10, checkpoint=tmp_path, checkpoint_freq=freq)


class Notes(DeviceReplayBuffer):
    """A buffer with something that nobody knows."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.notes = np.zeros(self.buffer_size)


def test_buffers_that_no_checkpoint_can_hold(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="replay_buffer_class=Notes keeps 'notes'"):
        sac(replay_buffer_class=Notes).learn(10, checkpoint=tmp_path)
    model = sac(
        Monitor(Goal()), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"copy_info_dict": True},
    )  # fmt: skip
    with pytest.raises(ValueError, match="copy_info_dict=True"):
        model.learn(10, checkpoint=tmp_path)
    assert model.num_timesteps == 0 and not steps_of(tmp_path)


class Annealed(CompactReplayBuffer):
    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.exponent, self.n_added, self.mean, self.largest = 0.5, np.int64(0), 0, np.float32(0)

    def add(self, *args: Any) -> None:
        super().add(*args)
        self.exponent, self.n_added, self.mean = self.exponent + 0.125, self.n_added + 1, 0.25
        self.largest = np.float32(self.n_added)


class Drawing(CompactReplayBuffer):
    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.rng = np.random.default_rng(0)


def test_numbers_of_a_buffer_of_ones_own(tmp_path: Path) -> None:
    sac(replay_buffer_class=Annealed).learn(20, checkpoint=tmp_path / "run")
    buffer = sac(replay_buffer_class=Annealed).learn(30, checkpoint=tmp_path / "run").replay_buffer
    assert (buffer.exponent, buffer.n_added, buffer.mean, buffer.largest) == (4.25, 30, 0.25, 30)
    model = sac(replay_buffer_class=Annealed)
    model.replay_buffer = buffer
    model.save_replay_buffer(tmp_path / "buffer")
    again = sac(replay_buffer_class=Annealed)
    again.load_replay_buffer(tmp_path / "buffer")
    assert (again.replay_buffer.exponent, again.replay_buffer.n_added) == (4.25, 30)
    with pytest.raises(ValueError, match="the buffer's missing cannot be 1"):
        again.replay_buffer.load_own_numbers({"missing": 1})
    with pytest.raises(ValueError, match="the buffer's exponent cannot be True"):
        again.replay_buffer.load_own_numbers({"exponent": True})
    with pytest.raises(ValueError, match="the buffer's other cannot be 1"):
        again.replay_buffer.load_state_dict({**buffer.state_dict(), "own/other": 1})
    assert again.replay_buffer.size() == 30
    with pytest.raises(ValueError, match=r"replay_buffer_class=Drawing keeps 'rng' \(Generator\)"):
        sac(replay_buffer_class=Drawing).learn(10, checkpoint=tmp_path / "other")


class OwnPolicy(MlpPolicy):
    """A policy class of the user's own."""


def test_classes_of_ones_own(tmp_path: Path) -> None:
    for steps in (20, 40):
        again = sac(policy=OwnPolicy).learn(steps, checkpoint=tmp_path)
    assert not differing(state(sac(policy=OwnPolicy).learn(40)), state(again))
    file = tmp_path / "checkpoint-000000000040" / "model.zip"
    with pytest.raises(ValueError, match="not trusted"):
        type(again).load(file)
    loaded = type(again).load(file, trusted_modules=["tests.saving.test_checkpoint"])
    assert isinstance(loaded.policy, OwnPolicy)


def test_no_file_is_pickled(tmp_path: Path) -> None:
    sac(vec(2)).learn(40, [Counter()], checkpoint=tmp_path, **STEPS)
    files = sorted(path for path in tmp_path.rglob("*.zip"))
    assert len(files) > 6
    for path in files:
        with zipfile.ZipFile(path) as archive:
            assert sorted(archive.namelist()) == ["checksums.json", "data.json", "tensors.safetensors"]
            json.loads(archive.read("data.json"))
        kind = {"model.zip": "model", "state.zip": "checkpoint"}.get(path.name, "replay rows")
        container.read(path, kind)
    others = {path.name for path in tmp_path.rglob("*") if path.is_file()} - {path.name for path in files}
    assert others == {"manifest.json", "progress.jsonl", ".lock"}


def test_a_file_in_place_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="checkpoint must name a folder, by a text or a path, or be None, not 5"):
        sac().learn(20, checkpoint=5)
    with pytest.raises(ValueError, match=r"checkpoint must name a folder, but .*file is a file"):
        sac().learn(10, checkpoint=tmp_path / "file")
    with pytest.raises(ValueError, match="checkpoint='.*/file/below' cannot be used"):
        sac().learn(10, checkpoint=tmp_path / "file" / "below")


# ---------------------------------------------------------------- what goes wrong


def test_a_full_quota_is_survived(tmp_path: Path) -> None:
    """The real thing: the system refuses to let files grow."""

    class Limit(BaseCallback):
        def _on_step(self) -> bool:
            _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
            limited = 15 <= self.num_timesteps < 35
            resource.setrlimit(resource.RLIMIT_FSIZE, (500 if limited else hard, hard))
            return True

    with pytest.warns(UserWarning, match="No checkpoint") as caught:
        model = sac().learn(40, Limit(), checkpoint=tmp_path, log_interval=1, **STEPS)
    messages = [str(w.message) for w in caught if "No checkpoint" in str(w.message)]
    assert len(messages) == 2
    for message, steps in zip(messages, (20, 30), strict=True):
        assert message.startswith(f"No checkpoint at {steps} steps, the last one is of 10 steps: {tmp_path} cannot be")
        assert os.strerror(27) in message
    assert steps_of(tmp_path) == [10, 40]
    assert not [path for path in tmp_path.rglob(".*") if path.name != ".lock"]
    assert len((tmp_path / "progress.jsonl").read_text().splitlines()) == 5
    again = sac().learn(50, checkpoint=tmp_path, **STEPS)
    assert not differing(state(sac().learn(50)), state(again)) and model.num_timesteps == 40


def test_rows_of_a_checkpoint_that_failed_are_removed_and_written_again(tmp_path: Path, monkeypatch: Any) -> None:
    write, rows = RunFolder.write, []

    def fail_at_20(self: RunFolder, steps: int, *args: Any) -> Any:
        if steps == 20:
            raise OSError(28, "No space left on device")
        rows.append(sorted(path.name[6:] for path in (tmp_path / "replay").iterdir()))
        return write(self, steps, *args)

    monkeypatch.setattr(RunFolder, "write", fail_at_20)
    with pytest.warns(UserWarning, match="No checkpoint at 20 steps"):
        sac().learn(30, checkpoint=tmp_path, **STEPS)
    assert rows == [[], ["000000000000-000000000010.zip"],
                    ["000000000000-000000000010.zip", "000000000010-000000000030.zip"]]  # fmt: skip
    assert not differing(state(sac().learn(40)), state(sac().learn(40, checkpoint=tmp_path)))


def test_no_space_and_a_read_only_file_system(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "none", disk], capture_output=True)
    if mounted.returncode:
        pytest.skip("file systems can be mounted by root only")
    try:

        class Fill(BaseCallback):
            def _on_step(self) -> bool:
                if self.num_timesteps == 15:
                    with pytest.raises(OSError, match="No space"):
                        (disk / "filler").write_bytes(bytes(2**20))
                if self.num_timesteps == 25:
                    (disk / "filler").unlink()
                return True

        with pytest.warns(UserWarning, match="No checkpoint at 20 steps.*No space left"):
            sac().learn(30, Fill(), checkpoint=disk / "run", log_interval=1, **STEPS)
        assert steps_of(disk / "run") == [10, 30]
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
        with pytest.raises(ValueError, match=r"checkpoint='.*' cannot be used: .*Read-only"):
            sac().learn(40, checkpoint=disk / "other")
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


def test_a_damaged_checkpoint_is_named_and_the_previous_one_used(tmp_path: Path) -> None:
    sac().learn(30, checkpoint=tmp_path, **STEPS)
    damaged = tmp_path / "checkpoint-000000000030" / "state.zip"
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    with pytest.warns(UserWarning, match=r"000030/state.zip is damaged.*Going on from .*000020"):
        again = sac().learn(50, checkpoint=tmp_path, **STEPS)
    assert not differing(state(sac().learn(50)), state(again))
    for path in tmp_path.glob("checkpoint-*/model.zip"):
        path.unlink()
    with pytest.raises(ValueError, match="no checkpoint that is whole: .*model.zip is missing"):
        sac().learn(60, checkpoint=tmp_path)


class Stop(BaseCallback):
    """Ends the training, or fails, at a step."""

    def __init__(self, at: int, error: type[BaseException] | None = None):
        super().__init__()
        self.at, self.error = at, error

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at and self.error is not None:
            raise self.error
        return self.num_timesteps != self.at


def test_a_callback_that_ends_the_training_leaves_a_whole_state(tmp_path: Path) -> None:
    for error in (None, RuntimeError, KeyboardInterrupt):
        run = tmp_path / str(error)
        if error is None:
            sac().learn(50, Stop(25), checkpoint=run, **STEPS)
        else:
            with pytest.raises(error):
                sac().learn(50, Stop(25, error), checkpoint=run, **STEPS)
        # An exception waits until the turn is over and saved (docs/faults.md).
        assert steps_of(run) == ([20, 25] if error is RuntimeError else [10, 20])
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert not differing(state(sac().learn(50)), state(sac().learn(50, checkpoint=run)))


# ---------------------------------------------------------------- signals


class Signal(BaseCallback):
    """Sends itself a signal, and looks who is listening."""

    def __init__(self, number: int, at: int = 25, twice: bool = False):
        super().__init__()
        self.number, self.at, self.twice, self.reached = number, at, twice, False

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            os.kill(os.getpid(), self.number)
            if self.twice:
                os.kill(os.getpid(), self.number)
            self.reached = True
        return True


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_finish_the_turn_and_save(number: int, tmp_path: Path, capfd: Any) -> None:
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    callback = Signal(number)
    model = sac()
    with pytest.raises(KeyboardInterrupt if number == signal.SIGINT else SystemExit) as caught:
        model.learn(50, callback, checkpoint=tmp_path, **STEPS)
    assert number == signal.SIGINT or caught.value.code == 128 + 15  # type: ignore[attr-defined]
    assert callback.reached and model.num_timesteps == 25 and steps_of(tmp_path) == [20, 25]
    assert "once more to leave at once" in capfd.readouterr().err
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert not differing(state(sac().learn(50)), state(sac().learn(50, checkpoint=tmp_path)))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_ignored_signal_stays_ignored(number: int, tmp_path: Path) -> None:
    """As a shell's background jobs ignore the Ctrl-C of the foreground."""
    before = signal.signal(number, signal.SIG_IGN)
    try:
        callback = Signal(number, twice=True)
        model = sac().learn(50, callback, checkpoint=tmp_path, **STEPS)
        assert callback.reached and model.num_timesteps == 50
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)


def test_a_second_signal_leaves_at_once(tmp_path: Path) -> None:
    callback = Signal(signal.SIGINT, twice=True)
    with pytest.raises(KeyboardInterrupt):
        sac().learn(50, callback, checkpoint=tmp_path, **STEPS)
    assert not callback.reached and steps_of(tmp_path) == [10, 20]


class InWorker(gym.Wrapper):
    """Its process gets a SIGINT at a step, as by a terminal's Ctrl-C."""

    def __init__(self, env: gym.Env, at: int):
        super().__init__(env)
        self.at, self.t = at, 0

    def step(self, action: Any) -> Any:
        self.t += 1
        if self.t == self.at:
            os.kill(os.getpid(), signal.SIGINT)
        return self.env.step(action)


def test_workers_survive_the_terminals_sigint(tmp_path: Path) -> None:
    def venv(at: int) -> Any:
        return SubprocVecEnv([lambda: InWorker(Monitor(gym.make("Pendulum-v1")), at)] * 2, start_method="fork")

    env = venv(13)
    with pytest.raises(KeyboardInterrupt):
        sac(env).learn(100, Signal(signal.SIGINT, at=26), checkpoint=tmp_path, **STEPS)
    assert steps_of(tmp_path)[-1] == 26
    assert all(process.is_alive() for process in env.processes)
    # They listen again when the training is over.
    os.kill(env.processes[0].pid, signal.SIGINT)
    env.processes[0].join(5)
    assert not env.processes[0].is_alive()
    again = sac(venv(10**9)).learn(60, checkpoint=tmp_path)
    assert again.num_timesteps == 60


# ---------------------------------------------------------------- callbacks and environments


class Counter(BaseCallback):
    """Remembers things; ``bound`` is an argument."""

    def __init__(self, bound: float = 1.0):
        super().__init__()
        self.bound, self.seen, self.best = bound, [], {"step": -1.0}

    def _on_step(self) -> bool:
        self.seen.append(np.float64(self.num_timesteps))
        self.best["step"] = float(self.num_timesteps)
        return True


def test_what_a_callback_changed_is_restored_and_its_arguments_are_the_programs(tmp_path: Path) -> None:
    sac().learn(20, [Counter(), EveryNTimesteps(5, Counter())], checkpoint=tmp_path, **STEPS)
    first, inner = Counter(bound=2.0), Counter()
    sac().learn(30, [first, EveryNTimesteps(5, inner)], checkpoint=tmp_path, progress_bar=False)
    assert first.seen == list(range(1, 31)) and first.n_calls == 30 and first.best == {"step": 30.0}
    assert inner.seen == [5, 10, 15, 20, 25, 30]
    assert first.bound == 2.0


class Curriculum(BaseCallback):
    """Has an argument behind an attribute that grows."""

    def __init__(self, levels: list[int]):
        super().__init__()
        self.seen: list[dict[str, int]] = []
        self.levels = list(levels)

    def _on_step(self) -> bool:
        self.seen.append({"step": self.num_timesteps})
        return True


def test_arguments_behind_what_grows_come_from_the_program(tmp_path: Path) -> None:
    sac().learn(20, Curriculum([1, 2]), checkpoint=tmp_path)
    callback = Curriculum([5, 6, 7])
    sac().learn(30, callback, checkpoint=tmp_path)
    assert callback.levels == [5, 6, 7] and len(callback.seen) == 30


class Writes(BaseCallback):
    """Knows where it writes, in several ways, and has texts that are its state."""

    def __init__(self, target: str, name_prefix: str = "a"):
        super().__init__()
        self.target, self.name_prefix, self.csv = target, name_prefix, f"{target}/log.csv"
        self.saved = [f"{target}/a.zip"]
        self.phase, self.words = "first", ["a"]

    def _on_step(self) -> bool:
        if self.num_timesteps == 15:
            self.phase, self.words = "second", ["a", "b"]
            self.saved = [f"{self.target}/b.zip"]
            self.target, self.name_prefix, self.csv = "other/place", "b", "here.csv"
        return True


def test_where_a_callback_writes_is_said_by_the_program(tmp_path: Path) -> None:
    """Also where an earlier part of the run has changed it, with a word about it."""
    first = Writes("old/place")
    sac().learn(20, first, checkpoint=tmp_path)
    again = Writes("new/place")
    with pytest.warns(UserWarning, match="of the checkpoint may name files, and stay as they are") as caught:
        sac().learn(21, again, checkpoint=tmp_path)
    (message,) = [str(w.message) for w in caught if "may name files" in str(w.message)]
    assert {word for word in ("target", "name_prefix", "csv", "saved") if f"Writes.{word}" in message} == {
        "target", "name_prefix", "csv", "saved"
    }  # fmt: skip
    assert (again.target, again.name_prefix, again.csv) == ("new/place", "a", "new/place/log.csv")
    assert again.saved == ["new/place/a.zip"]
    assert (again.phase, again.words) == ("second", ["a", "b"])


#: Of the state of callbacks, by name: what a hostile file says there.
HOSTILE_ATTRIBUTES: dict[str, Any] = {
    "best_model_save_path": {"value": "victim"}, "log_path": {"value": "victim/evaluations"},
    "eval_env": {"value": 1}, "model": {"value": None}, "_on_step": {"value": True},
    "verbose": {"value": 10}, "__class__": {"value": 1},
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE_ATTRIBUTES)
def test_another_runs_best_model_is_not_overwritten(name: str, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    Path("victim").mkdir()
    for file in ("best_model.zip", "evaluations.npz"):
        (tmp_path / "victim" / file).write_text("the user's")

    def evaluation() -> EvalCallback:
        return EvalCallback(
            vec(), eval_freq=5, n_eval_episodes=1, best_model_save_path="mine", log_path="mine", verbose=0
        )

    sac().learn(20, evaluation(), checkpoint="run")
    (path,) = Path("run").glob("checkpoint-*20/state.zip")
    state_ = decode(*container.read(path, "checkpoint"), "checkpoint")
    state_["callbacks"]["callback"]["attributes"][name] = HOSTILE_ATTRIBUTES[name]
    state_["callbacks"]["callback"]["attributes"]["best_mean_reward"] = {"value": -1e9}
    tensors: dict[str, Any] = {}
    container.write(path, "checkpoint", encode(state_, "checkpoint", tensors), tensors)
    rewritten(path.parent / "manifest.json", lambda m: m["files"].update({"state.zip": facts_of(path.read_bytes())}))
    callback = evaluation()
    with pytest.warns(UserWarning, match=f"{name}.* stay as they are|starts anew: '{name}' is not saved of it"):
        sac().learn(40, callback, checkpoint="run")
    assert (callback.best_model_save_path, callback.log_path) == ("mine", "mine/evaluations")
    assert {path.read_text() for path in Path("victim").iterdir()} == {"the user's"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "run", "victim"]


def test_callbacks_that_come_and_go_are_named(tmp_path: Path) -> None:
    sac().learn(20, StopTrainingOnMaxEpisodes(100), checkpoint=tmp_path)
    with pytest.warns(UserWarning, match=r"state of a .*StopTrainingOnMaxEpisodes \(callback\)"):
        sac().learn(30, Counter(), checkpoint=tmp_path)


class Best(BaseCallback):
    """Has its defaults in the class body, as in Stable-Baselines3's documentation."""

    best, hits = -np.inf, 0

    def _on_step(self) -> bool:
        self.hits += 1
        self.best = max(self.best, float(self.locals["rewards"].max()))
        return True


def test_defaults_in_the_class_body_go_on_too(tmp_path: Path) -> None:
    sac().learn(20, Best(), checkpoint=tmp_path)
    again = Best()
    sac().learn(30, again, checkpoint=tmp_path)
    whole = Best()
    sac().learn(30, whole)
    assert (again.hits, again.best) == (whole.hits, whole.best) and again.hits == 30


class Secretive(BaseCallback):
    def __init__(self) -> None:
        super().__init__()
        self.numbers = iter(range(10**6))

    def _on_step(self) -> bool:
        next(self.numbers)
        return True


def test_a_callback_whose_state_cannot_be_held_is_named(tmp_path: Path) -> None:
    with pytest.warns(
        UserWarning, match=r"callbacks' state: Secretive \(callback\): numbers \(builtins.range_iterator"
    ):
        sac().learn(20, Secretive(), checkpoint=tmp_path)


class Secret(gym.Env):
    """Its state is where nobody finds it."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,))
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.counter = iter(range(10**6))
        return self.np_random.normal(size=1).astype(np.float32), {}

    def step(self, action: Any) -> Any:
        t = next(self.counter)
        return np.array([t + 1.0], np.float32), 0.0, False, t >= 18, {}


@pytest.mark.parametrize("n_steps", [1, 3])
def test_an_episode_that_cannot_be_held_starts_anew(n_steps: int, tmp_path: Path) -> None:
    def model() -> Any:
        return sac(VecNormalize(DummyVecEnv([lambda: Monitor(Secret())])), n_steps=n_steps, replay_ratio=0.1)

    with pytest.warns(UserWarning, match=r"environment cannot be saved.*Secret: counter \(builtins.range_iterator\)"):
        first = model().learn(25, checkpoint=tmp_path)
    with pytest.warns(UserWarning, match=r"episodes in progress start anew: .*Secret: counter") as caught:
        again = model().learn(40, checkpoint=tmp_path)
    assert "; ".join(str(warning.message) for warning in caught).count("start anew") == 1
    buffer = again.replay_buffer
    # The old episode was cut, as by a time limit, and the new one starts with a reset of its own.
    assert buffer.dones[24] == buffer.timeouts[24] == 1 and buffer.dones[23] == 0
    assert buffer.next_observations[24, 0, 0] == 6 and buffer.observations[26, 0, 0] == 1
    assert buffer.observations[25, 0, 0] not in buffer.observations[:25]
    assert first.env.obs_rms.count < again.env.obs_rms.count
    # And what was cut stays cut.
    with pytest.warns(UserWarning, match="episodes in progress start anew"):
        third = model().learn(41, checkpoint=tmp_path)
    assert third.replay_buffer.dones[24] == third.replay_buffer.timeouts[24] == 1


def test_hindsight_does_not_reach_over_the_cut(tmp_path: Path) -> None:
    class SecretGoal(Goal):
        def __init__(self) -> None:
            super().__init__()
            self.secret = iter([])

    def model() -> Any:
        return sac(
            Monitor(SecretGoal()), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, learning_starts=20
        )

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model().learn(22, checkpoint=tmp_path)
        buffer = model().learn(40, checkpoint=tmp_path).replay_buffer
    # Episodes of 9 steps; the one from 18 on was cut after 4.
    assert list(buffer.ep_length[16:27, 0]) == [9, 9, 4, 4, 4, 4, 9, 9, 9, 9, 9]


def test_workers_without_a_wrapper_say_what_they_need(tmp_path: Path) -> None:
    env = SubprocVecEnv([Goal] * 2, start_method="fork")
    model = sac(env, policy="MultiInputPolicy")
    with pytest.warns(UserWarning, match="an environment in a worker needs a wrapper, such as Monitor"):
        model.learn(20, checkpoint=tmp_path)
    env.close()


def test_other_circumstances_are_named(tmp_path: Path, monkeypatch: Any) -> None:
    sac().learn(20, checkpoint=tmp_path)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 77)
    with pytest.warns(UserWarning, match=r"need not be the same to the last bit: .*torch threads \d+ \(now 77\)"):
        sac().learn(30, checkpoint=tmp_path)


def test_the_elapsed_time_goes_on(tmp_path: Path) -> None:
    sac().learn(20, checkpoint=tmp_path)
    model = sac()
    states: list[float] = []

    class Watch(BaseCallback):
        def _on_training_start(self) -> None:
            states.append((model.start_time, model._num_timesteps_at_start))

        def _on_step(self) -> bool:
            return True

    model.learn(30, Watch(), checkpoint=tmp_path)
    import time

    assert 0 < time.time_ns() - states[0][0] < 600e9 and states[0][1] == 0


def test_compile_is_the_present_programs_and_what_auto_decided_stays() -> None:
    decided = sac(compile="auto")
    decided.compiled = True
    attributes = training_state.save_attributes(decided)
    for present, compiled in (("auto", True), (False, False)):
        model = sac(compile=present)
        training_state.restore_attributes(model, attributes)
        assert model.compiled is compiled


def test_callback_states_notice_changes_in_place() -> None:
    model = sac()
    callback = Counter()
    model._setup_learn(10, callback)
    states = CallbackStates(callback)
    assert states.save()["callback"]["attributes"] == {}
    callback.best["step"] = 3.0
    assert set(states.save()["callback"]["attributes"]) == {"best"}


class Aliases(BaseCallback):
    """Attributes that hold what others hold, of which some never change."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.best, self.names = [0.0, None], None, ["a"]
        for i in range(8):
            setattr(self, f"here{i}", [])
            setattr(self, f"there{i}", [])

    def _on_step(self) -> bool:
        self.best, self.named = self.first, [self.names, {}]
        for i in range(8):
            here = getattr(self, f"here{i}")
            here.append({self.num_timesteps: i})
            getattr(self, f"there{i}").append(here)
        return True


def test_what_several_attributes_of_a_callback_hold_stays_one() -> None:
    """As Stable-Baselines3's EvalCallback has its latest successes in two of them."""
    first, again = Aliases(), Aliases()
    states = [CallbackStates(callback) for callback in (first, again)]
    sac().learn(2, first)
    saved = states[0].save()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        states[1].restore(saved)
    assert again.best is again.first and again.named[0] is again.names
    for i in range(8):
        here, there = getattr(again, f"here{i}"), getattr(again, f"there{i}")
        assert here == [{1: i}, {2: i}] and len(there) == 2 and there[0] is there[1] is here


def test_evaluations_with_successes_go_on(tmp_path: Path) -> None:
    def evaluation() -> EvalCallback:
        env = DummyVecEnv([lambda: Monitor(Goal())])
        return EvalCallback(env, eval_freq=24, n_eval_episodes=1, verbose=0, log_path=str(tmp_path / "evaluations"))

    def learn(stop: int, callback: EvalCallback) -> None:
        model = sac(env=DummyVecEnv([lambda: Monitor(Goal())]), policy="MultiInputPolicy", verbose=0)
        model.learn(stop, callback, checkpoint=tmp_path / "run", checkpoint_freq=12)

    learn(60, evaluation())
    again = evaluation()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*starts anew")
        learn(96, again)
    assert again.evaluations_timesteps == [24, 48, 72, 96] and len(again.evaluations_successes) == 4


def test_a_folder_that_cannot_be_synced(tmp_path: Path, monkeypatch: Any) -> None:
    """Checkpoints are kept there, which is said once, and the run goes on from them."""
    fsync = os.fsync

    def not_of_folders(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", not_of_folders)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sac().learn(30, checkpoint=tmp_path / "run", **STEPS)
        again = sac().learn(50, checkpoint=tmp_path / "run", **STEPS)
    assert ["cannot be synced" in str(w.message) for w in caught] == [True]
    assert steps_of(tmp_path / "run") == [40, 50] and not differing(state(sac().learn(50)), state(again))


class Levels(gym.Wrapper):
    """Tells the level of each step, as ids of tasks tell theirs."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, "level": "maps/3"}


def _levels() -> Monitor:
    return Monitor(Levels(gym.make("Pendulum-v1", max_episode_steps=10)), info_keywords=("level",))


def test_what_monitor_tells_of_episodes_is_no_file(tmp_path: Path) -> None:
    first = sac(env=DummyVecEnv([_levels]))
    first.learn(32, checkpoint=tmp_path / "run", **STEPS)
    assert [each["level"] for each in first.ep_info_buffer] == ["maps/3"] * 3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        second = sac(env=DummyVecEnv([_levels])).learn(38, checkpoint=tmp_path / "run", **STEPS)
    assert list(second.ep_info_buffer) == list(first.ep_info_buffer)


class Exporting(SAC):
    """Writes somewhere that no argument says."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self.export_path = "here"


def test_where_an_attribute_writes_is_said_by_the_program(tmp_path: Path) -> None:
    first = sac(cls=Exporting)
    first.export_path = "elsewhere/model.onnx"  # type: ignore[attr-defined]
    first.learn(32, checkpoint=tmp_path / "run", **STEPS)
    with pytest.warns(UserWarning, match=r"Exporting.export_path of the checkpoint may name files"):
        second = sac(cls=Exporting).learn(32, checkpoint=tmp_path / "run", **STEPS)
    assert second.num_timesteps == 32 and second.export_path == "here"


class Colour(enum.Enum):
    RED, BLUE = 1, 2


class Mode(enum.Flag):
    FAST, LOUD = enum.auto(), enum.auto()


class Learned(SAC):
    """A multiplier of its own that it learns, and values of kinds that a list of numbers is not."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self.log_multiplier = torch.zeros(1, requires_grad=True)
        self.multiplier_optimizer = torch.optim.SGD([self.log_multiplier], lr=0.5)
        self.halving = torch.optim.lr_scheduler.MultiStepLR(self.multiplier_optimizer, [1000])
        self.unnamed = torch.zeros(2, requires_grad=True)
        self.shape, self.mode, self.rest = torch.Size([1]), Mode.FAST, Mode.FAST
        self.seen: list[Any] = []
        self.counts: Any = {}

    def _get_torch_save_params(self) -> Any:
        names, variables = super()._get_torch_save_params()
        return [*names, "multiplier_optimizer"], [*variables, "log_multiplier"]


def test_values_of_other_kinds_and_what_is_learned_besides(tmp_path: Path) -> None:
    first = sac(cls=Learned)
    first.shape, first.mode, first.rest = torch.Size([3, 4]), Mode.FAST | Mode.LOUD, Mode(0)
    first.seen, first.counts = [Colour.RED, Colour.BLUE], collections.Counter(a=2)
    with torch.no_grad():
        first.log_multiplier += 3
        first.unnamed += 5
    first.learn(32, checkpoint=tmp_path / "run", **STEPS)
    second = sac(cls=Learned)
    learned, unnamed = second.log_multiplier, second.unnamed
    second.learn(38, checkpoint=tmp_path / "run", **STEPS)
    assert (second.shape, second.mode, second.rest) == (torch.Size([3, 4]), Mode.FAST | Mode.LOUD, Mode(0))
    assert second.seen == [Colour.RED, Colour.BLUE] and second.counts == collections.Counter(a=2)
    assert type(second.shape) is torch.Size and type(second.counts) is collections.Counter
    # The optimizer goes on with the tensor that it has.
    assert second.log_multiplier is learned and learned.requires_grad and learned.item() == 3
    assert second.unnamed is unnamed and unnamed.tolist() == [5, 5]
    (2 * second.log_multiplier).backward()
    second.multiplier_optimizer.step()
    assert second.log_multiplier.item() == 2

    second.save(tmp_path / "model")
    loaded = Learned.load(tmp_path / "model", trusted_modules=[__name__])
    assert loaded.log_multiplier.item() == 2


class Visits(BaseCallback):
    """Gives a state that no file holds from some step on."""

    def __init__(self) -> None:
        super().__init__()
        self.visited: set[Any] = set()
        self.counts = collections.Counter[str]()

    def _on_step(self) -> bool:
        self.counts["steps"] += 1
        if self.num_timesteps > 20:
            self.visited.add((0, self.num_timesteps))
        return True

    def state_dict(self) -> dict[str, Any]:
        return {"counts": self.counts} | ({"visited": self.visited} if self.visited else {})

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.counts = state["counts"]


def test_a_callback_whose_state_comes_to_be_more_than_a_file_holds(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"does not hold the state of Visits \(callback\): state_dict") as told:
        sac().learn(60, callback=Visits(), checkpoint=tmp_path / "run", **STEPS)
    assert len([each for each in told if "Visits" in str(each.message)]) == 1
    assert steps_of(tmp_path / "run")[-1] == 60
    first, second = Visits(), Visits()
    sac().learn(20, callback=first, checkpoint=tmp_path / "other", **STEPS)
    sac().learn(20, callback=second, checkpoint=tmp_path / "other", **STEPS)
    assert second.counts == first.counts and type(second.counts) is collections.Counter


class Moving(gym.Wrapper):
    """Changes the folder that the process is in."""

    def __init__(self, env: gym.Env, folder: Path) -> None:
        super().__init__(env)
        self._folder = str(folder)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        os.chdir(self._folder)
        return self.env.step(action)


def test_a_relative_folder_is_that_of_the_beginning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    model = sac(env=DummyVecEnv([lambda: Monitor(Moving(gym.make("Pendulum-v1"), tmp_path / "elsewhere"))]))
    model.learn(40, checkpoint="run", **STEPS)
    assert steps_of(tmp_path / "run")[-1] == 40 and not (tmp_path / "elsewhere/run").exists()


class Prices(gym.Wrapper):
    """Keeps what no file holds, from the beginning or in the course of time."""

    def __init__(self, env: gym.Env, folder: Path, kind: str) -> None:
        super().__init__(env)
        np.save(folder / "p.npy", np.arange(3.0))
        self._kind, self.visits = kind, dict[Any, int]()
        self.prices = np.load(folder / "p.npy", mmap_mode="r") if kind == "on disk" else None

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if self._kind == "many":
            self.visits.update({(len(self.visits), i): 0 for i in range(1500)})
        return self.env.step(action)


@pytest.mark.parametrize("kind", ["on disk", pytest.param("many", marks=pytest.mark.slow)])
def test_a_checkpoint_without_the_episodes_is_better_than_none(kind: str, tmp_path: Path) -> None:
    def learn(steps: int) -> Any:
        env = DummyVecEnv([lambda: Monitor(Prices(gym.make("Pendulum-v1"), tmp_path, kind))])
        return sac(env=env).learn(steps, checkpoint=tmp_path / "run", **STEPS)

    with pytest.warns(UserWarning, match="does not hold the episodes in progress: env") as told:
        learn(40)
    assert len([each for each in told if "episodes in progress" in str(each.message)]) == 1
    assert steps_of(tmp_path / "run")[-1] == 40
    with pytest.warns(UserWarning, match="The episodes in progress start anew"):
        assert learn(60).num_timesteps == 60


class Log(BaseCallback):
    """Notes more than a file holds."""

    def __init__(self) -> None:
        super().__init__()
        self.notes: list[Any] = []

    def _on_step(self) -> bool:
        self.notes += [(i, "note") for i in range(2000)]
        return True


@pytest.mark.slow
def test_a_checkpoint_without_a_callbacks_state_is_better_than_none(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="does not hold the state of callback: callback takes"):
        sac().learn(40, callback=Log(), checkpoint=tmp_path / "run", **STEPS)
    assert steps_of(tmp_path / "run")[-1] == 40
    with pytest.warns(UserWarning, match=r"Log \(callback\) starts anew: it is not in the checkpoint"):
        assert sac().learn(60, callback=Log(), checkpoint=tmp_path / "run", **STEPS).num_timesteps == 60


def test_sets_in_arguments_are_the_same_whatever_their_order() -> None:
    one, other = {0, 8}, {8, 0}
    assert list(one) != list(other)
    model = sac()
    digests = set()
    for keys in (one, other):
        model.policy_kwargs = {"features_extractor_kwargs": {"keys": keys}}
        digests.add(identity_of(model, model.env)["policy_kwargs"][0])
    assert len(digests) == 1


class Closing:
    """Removes a file when it goes away."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __del__(self) -> None:
        Path(self.path).unlink(missing_ok=True)


@pytest.mark.parametrize("path", ["tempfile:_TemporaryFileCloser", f"{__name__}:Closing"])
def test_a_checkpoint_makes_no_object_that_does_something_when_it_goes_away(path: str, tmp_path: Path) -> None:
    victim = tmp_path / "thesis.tex"
    victim.write_text("years")
    sac().learn(20, checkpoint=tmp_path / "run", **STEPS)
    attributes = {"file": 1, "name": str(victim), "delete": True, "path": str(victim)}
    for folder in (tmp_path / "run").glob("checkpoint-*"):
        file = folder / "model.zip"
        tree, tensors = container.read(file, "model")
        tree["parameters"]["x"] = {"instance": path, "attributes": attributes}
        container.write(file, "model", tree, tensors)
        rewritten(
            folder / "manifest.json", lambda m, f=file: m["files"].update({"model.zip": facts_of(f.read_bytes())})
        )
    with pytest.raises(BadFile, match="Closing goes away|does something when|may not be named|is no class|not trusted"):
        sac().learn(40, checkpoint=tmp_path / "run", **STEPS)
    gc.collect()
    assert victim.read_text() == "years"


def test_numbers_that_numpy_has_not_are_compared() -> None:
    model = sac()
    digests = []
    for value in (1.0, 2.0, 1.0):
        model.policy_kwargs = {"x": torch.full((), value, dtype=torch.bfloat16)}
        digests.append(identity_of(model, model.env)["policy_kwargs"][0])
    assert digests[0] == digests[2] != digests[1]


def test_statistics_of_observations_that_are_not_normalised_any_more(tmp_path: Path) -> None:
    venv = VecNormalize(vec())
    sac(env=venv).learn(20)
    venv.norm_obs = False
    save_vec_normalize(venv, tmp_path / "statistics")
    loaded = load_vec_normalize(tmp_path / "statistics", vec())
    assert not loaded.norm_obs and loaded.obs_rms.count == venv.obs_rms.count > 20
    np.testing.assert_array_equal(loaded.obs_rms.mean, venv.obs_rms.mean)
