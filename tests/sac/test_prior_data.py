"""Prior data in the batches of ``learn``: shares, files, checkpoints, and what they go together with."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_sample import IQL, SAC, VPLSAC, Dataset, DebiasedRQ, PrioritizedReplayBuffer
from sb3_sample.learner.learner import Learner
from sb3_sample.replay.columns import Column
from sb3_sample.replay.compact import CompactReplayBuffer
from tests.sac.common import MAKERS, Toy, differing, sac, state, vec

MARK = 1_000.0


def prior(n: int = 60, keys: tuple[str, ...] = (), **kwargs: Any) -> Dataset:
    """Transitions whose rewards tell them from the toys'."""
    rng = np.random.default_rng(0)
    observations: Any = rng.normal(size=(n, 3)).astype(np.float32)
    observations = dict.fromkeys(keys, observations) if keys else observations
    ends = np.ones(n)
    given = (observations, rng.uniform(-1, 1, (n, 2)).astype(np.float32), MARK + np.arange(n), ends, ends * 0)
    return Dataset.from_arrays(*given, **kwargs)


@pytest.fixture
def batches(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The batches of every gradient step."""
    seen: list[Any] = []
    plain = Learner.step

    def step(self: Learner, batch: Any, *args: Any, **kwargs: Any) -> Any:
        seen.append(batch)
        return plain(self, batch, *args, **kwargs)

    monkeypatch.setattr(Learner, "step", step)
    return seen


@pytest.mark.parametrize("maker", [name for name in MAKERS if name not in ("SRSAC", "DebiasedRQ")])
def test_every_agent_has_the_share_of_prior_data_in_every_batch(maker: str, batches: list[Any]) -> None:
    model = MAKERS[maker](prior_data=prior(), prior_share=0.25)
    model.learn(16)
    assert len(batches) >= 5
    for batch in batches:
        assert (batch.rewards >= MARK).flatten().tolist() == [True] * 2 + [False] * 6
        assert batch.discounts == model.gamma


class TaskReplay(CompactReplayBuffer):
    more_columns = (Column("task", lambda step: np.zeros(len(step.infos)), dtype=np.int64),)


def test_prior_data_have_the_columns_of_the_replay_buffer(batches: list[Any]) -> None:
    data = prior(columns={"task": np.ones(60, np.int64)})
    with pytest.raises(ValueError, match=r"prior_data must have .* of the replay buffer, none, not \['task'\]"):
        sac(prior_data=data)
    with pytest.raises(ValueError, match=r"of replay_buffer_class=TaskReplay, \['task'\], not none"):
        sac(prior_data=prior(), replay_buffer_class=TaskReplay)
    sac(prior_data=data, replay_buffer_class=TaskReplay).learn(12)
    assert batches[0].columns["task"].flatten().tolist() == [1] * 4 + [0] * 4


@pytest.mark.parametrize(("share", "size", "expected"), [(0.5, 8, 4), (0.5, 6, 3), (0.1, 30, 3), (0.9, 10, 9)])
def test_shares(share: float, size: int, expected: int, batches: list[Any]) -> None:
    sac(prior_data=prior(), prior_share=share, batch_size=size, replay_ratio=3).learn(15)
    assert len(batches) > 10 and {int((batch.rewards >= MARK).sum()) for batch in batches} == {expected}


def test_all_prior_transitions_are_drawn_alike(batches: list[Any]) -> None:
    sac(prior_data=prior(10), batch_size=40, replay_ratio=20).learn(15)
    drawn = torch.cat([batch.rewards[:20].flatten() for batch in batches]) - MARK
    counts = torch.bincount(drawn.long(), minlength=10).float()
    expected = len(drawn) / 10
    assert len(drawn) >= 2_000 and ((counts - expected) ** 2 / expected).sum() < 34  # chi-squared, 9 degrees: p = 1e-4


def test_held_out_transitions_are_of_both() -> None:
    model = sac(cls=VPLSAC, validation_proportion=0.25, prior_data=prior(80), batch_size=32, learning_starts=10)
    model.learn(60)
    held, trained = model._source.held_out(), model._source.batches(60, 32)
    assert (held.rewards >= MARK).flatten().tolist() == [True] * 4 + [False] * 4
    seen = {row.item() for batch in trained for row in batch.rewards if row >= MARK}
    later = {row.item() for _ in range(100) for row in model._source.held_out().rewards if row >= MARK}
    assert len(seen) == 60 and len(later) == 20 and not seen & later


def test_prior_data_are_normalised_as_the_replay_buffer() -> None:
    venv = VecNormalize(vec(), norm_reward=True)
    model = sac(venv, prior_data=prior())
    model.learn(20)
    batch = model._source.sample(8)
    original = prior().rows(slice(None))
    allowed = {value.item() for value in venv.normalize_reward(original["rewards"])}
    assert {value.item() for value in batch.rewards[:4, 0]} <= {float(np.float32(value)) for value in allowed}
    normalised = venv.normalize_obs(original["observations"])
    for row in batch.observations[:4].numpy():
        assert (normalised == row).all(1).any()


class Goals(Toy):
    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, infos: Any) -> np.ndarray:
        return np.zeros(len(achieved))


def test_hindsight_relabels_the_replay_buffers_part_only(batches: list[Any]) -> None:
    keys = ("observation", "achieved_goal", "desired_goal")
    space = spaces.Dict({key: spaces.Box(-9, 9, (3,)) for key in keys})
    model = sac(
        DummyVecEnv([lambda: Goals(obs_space=space)]), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer,
        prior_data=prior(keys=keys),
    )  # fmt: skip
    model.learn(20)
    goals = prior(keys=keys).rows(slice(None))["observations"]["desired_goal"]
    for batch in batches:
        assert (batch.rewards >= MARK).flatten().tolist() == [True] * 4 + [False] * 4
        for row in batch.observations["desired_goal"][:4].numpy():
            assert (goals == row).all(1).any()


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"prior_data": [1]}, r"prior_data must be of Dataset, or None, not \[1\]"),
        ({"prior_share": 0.3}, "prior_share=0.3 means nothing with prior_data=None"),
        ({"prior_data": prior(), "prior_share": 1.0}, r"prior_share must lie in \(0, 1\), not 1.0"),
        ({"prior_data": prior(), "prior_share": 0.01}, "prior_share=0.01 of batch_size=8 leaves no transition of one"),
        ({"prior_data": prior(), "n_steps": 3}, "prior_data has transitions of one step, which n_steps=3"),
        ({"prior_data": prior(action_space=spaces.Box(-4, 4, (2,)))}, "prior_data must have actions in the units of"),
        ({"prior_data": prior(), "cls": DebiasedRQ}, "DebiasedRQ has prior_data=None, not .* windows of several"),
        (
            {"prior_data": prior(), "replay_buffer_class": PrioritizedReplayBuffer},
            "prior_data have no priorities, by which replay_buffer_class=PrioritizedReplayBuffer draws",
        ),
        (
            {"prior_data": prior(), "replay_buffer_class": NStepReplayBuffer, "replay_buffer_kwargs": {"n_steps": 3}},
            "prior_data has transitions of one step, which replay_buffer_class=NStepReplayBuffer would mix",
        ),
        ({"prior_data": prior(keys=("a",))}, "prior_data must have observations of the model's shape"),
    ],
)  # fmt: skip
def test_what_is_refused(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        sac(**kwargs)


def test_a_learner_takes_no_prior_data() -> None:
    data = prior()
    with pytest.raises(ValueError, match="prior_data: a learner takes no arguments of training"):
        SAC.learner(data.observation_space, data.action_space, prior_data=data)


def test_a_file_names_the_data_and_asks_for_them(tmp_path: Path) -> None:
    data = prior(2_000)
    model = sac(prior_data=data, prior_share=0.25).learn(14)
    model.save(tmp_path / "m")
    without = sac().learn(14)
    without.save(tmp_path / "without")
    sizes = [(tmp_path / f"{name}.zip").stat().st_size for name in ("m", "without")]
    assert abs(sizes[0] - sizes[1]) < 1_000
    words = f"2,000 transitions of prior data, sha256 {data.fingerprint[:16]}"
    with pytest.raises(ValueError, match=f"prior_data: the model of .* learned with {words}.*pass prior_data="):
        SAC.load(tmp_path / "m", env=vec())
    # To act it needs none; to learn it does.
    acting = SAC.load(tmp_path / "m")
    assert acting.predict(np.zeros((1, 3), np.float32))[0].shape == (1, 2)
    acting.set_env(vec())
    with pytest.raises(ValueError, match=f"prior_data: this model learned with {words}"):
        acting.learn(1)
    again = SAC.load(tmp_path / "m", env=vec(), prior_data=prior(2_000))
    assert again.prior_share == 0.25 and again.learn(2).num_timesteps == 2
    assert SAC.load(tmp_path / "m", env=vec(), prior_data=None).learn(1).prior_data is None
    with pytest.warns(UserWarning, match="prior_data are other transitions than this model has learned from so far"):
        SAC.load(tmp_path / "m", env=vec(), prior_data=prior(50))


@pytest.mark.parametrize("cls", [SAC, IQL])
def test_checkpoints(cls: type[SAC], tmp_path: Path) -> None:
    def made() -> Any:
        return sac(cls=cls, prior_data=prior())

    whole = made().learn(30)

    def interrupt(local: Any, all: Any) -> bool:
        if local["self"].num_timesteps == 23:
            raise KeyboardInterrupt
        return True

    with pytest.raises(KeyboardInterrupt):
        made().learn(30, interrupt, checkpoint=tmp_path / "run", checkpoint_freq=10)
    np.random.seed(5)
    on = made().learn(30, checkpoint=tmp_path / "run", checkpoint_freq=10)
    assert not differing(state(whole), state(on))
    with pytest.raises(ValueError, match=r"prior_data='?Dataset\(50 .*was made with prior_data='?Dataset\(60"):
        sac(cls=cls, prior_data=prior(50)).learn(40, checkpoint=tmp_path / "run")


PROGRAM = """
import os, signal, sys
import numpy as np
from sb3_sample import IQL
from tests.sac.common import TINY_SAC, differing, state, vec
from tests.sac.test_prior_data import prior

def save(model):
    np.savez(sys.argv[2], **{name.replace("/", "|"): value for name, value in state(model).items()})

folder, stop = sys.argv[1], sys.argv[3]
data = prior()
model = IQL("MlpPolicy", vec(), seed=0, prior_data=data, **TINY_SAC)

def kill(local, all):
    if stop == "online" and local["self"].num_timesteps == 13:
        os.kill(os.getpid(), signal.SIGKILL)
    return True

checkpoint = {} if folder == "none" else {"checkpoint_freq": 5}
def at(name):
    return checkpoint and {**checkpoint, "checkpoint": folder + "/" + name}
model.learn_offline(data, 12, **at("offline"))
if stop == "between":
    os.kill(os.getpid(), signal.SIGKILL)
model.learn(25, kill, **at("online"))
save(model)
"""


@pytest.mark.slow
@pytest.mark.parametrize("stop", ["between", "online"])
def test_offline_then_online_after_a_kill_is_the_same(stop: str, tmp_path: Path) -> None:
    def run(folder: Any, output: str, stop: str) -> int:
        command = [sys.executable, "-W", "ignore", "-c", PROGRAM, str(folder), str(tmp_path / output), stop]
        return subprocess.run(command, cwd=Path(__file__).parents[2], env=os.environ, check=False).returncode

    assert run("none", "whole", "never") == 0
    assert run(tmp_path, "no", stop) == -signal.SIGKILL
    assert run(tmp_path, "resumed", "never") == 0
    whole, resumed = np.load(tmp_path / "whole.npz"), np.load(tmp_path / "resumed.npz")
    assert whole.files == resumed.files and len(whole.files) > 20
    assert [name for name in whole.files if not np.array_equal(whole[name], resumed[name])] == []


def test_offline_then_online_in_one_process_is_the_same(tmp_path: Path) -> None:
    """As after a kill between the two: the program starts again, the first call returns what it had."""

    def offline(**kwargs: Any) -> Any:
        return sac(cls=IQL, prior_data=prior()).learn_offline(prior(), 12, **kwargs)

    whole = offline().learn(25)
    offline(checkpoint=tmp_path / "offline", checkpoint_freq=5)
    np.random.seed(77)
    with pytest.warns(UserWarning, match="Nothing is left to train"):
        again = offline(checkpoint=tmp_path / "offline", checkpoint_freq=5)
    assert not differing(state(whole), state(again.learn(25, checkpoint=tmp_path / "online")))
