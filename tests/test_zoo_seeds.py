"""Many seeds in one command of the zoo, and in one process of a study: the runs are those of as many commands."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")

from sb3_sample import cli, lockstep, zoo
from tests.test_zoo_runs import COMMAND, OFF_POLICY, check_equal, outcome, steps

zoo.register()

RUN = (*COMMAND, "-n", "120", "--checkpoint-freq", "30", "--eval-freq", "50")
Call = Callable[..., None]


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Call:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    return lambda *arguments, more=(): cli.main([*RUN, *arguments, "-params", *OFF_POLICY, *more])


def test_the_runs_are_those_of_as_many_commands(call: Call, tmp_path: Path, capsys: Any) -> None:
    call("--seeds", "3", "--run-dir", "together", "-tb", "tb")
    call("--seed", "2", "--run-dir", "alone")
    check_equal(outcome("together/seed-2"), outcome("alone"))
    assert sorted(os.listdir("together")) == ["seed-0", "seed-1", "seed-2"]
    record = json.loads(Path("together/seed-1/run.json").read_text())
    assert record["seed"] == 1
    assert sorted(os.listdir("tb/Pendulum-v1")) == ["SAC_1", "SAC_2", "SAC_3"]
    # Once more goes on: there is nothing left.
    with pytest.warns(UserWarning, match="Nothing is left to train"):
        call("--seeds", "3", "--run-dir", "together", "-tb", "tb")


@pytest.mark.slow
def test_without_a_folder_each_run_has_one_where_the_zoo_says(call: Call) -> None:
    call("--seeds", "4", "7", "--log-folder", "logs")
    folders = [Path(f"logs/sac_sample/Pendulum-v1_{i}") for i in (1, 2)]
    assert [json.loads((folder / "run.json").read_text())["seed"] for folder in folders] == [4, 7]
    assert [steps(folder)[-1] for folder in folders] == [120, 120]
    # Each goes on with its own.
    call("--seeds", "4", "7", "--log-folder", "logs", "--resume", "-n", "150")
    assert [steps(folder)[-1] for folder in folders] == [150, 150]
    call("--seed", "4", "--log-folder", "logs", "--resume", "-n", "180")
    assert [steps(folder)[-1] for folder in folders] == [180, 150]
    with pytest.raises(SystemExit, match="no run of sac_sample on Pendulum-v1 with seed 5 below logs has a checkpoint"):
        call("--seeds", "4", "5", "--log-folder", "logs", "--resume", "-n", "150")


CALLBACK = """
import os, signal
from stable_baselines3.common.callbacks import BaseCallback
from sb3_sample import zoo

class Callback(BaseCallback):
    def _on_step(self):
        if self.model.seed == 1 and self.num_timesteps == 70:
            if os.environ.get("HOW") == "signal":
                os.kill(os.getpid(), signal.SIGINT)
            if os.environ.get("HOW") == "error":
                raise LookupError("what was looked for")
        return True

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass
"""


@pytest.fixture
def callback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    (tmp_path / "called_back.py").write_text(CALLBACK)
    monkeypatch.syspath_prepend(str(tmp_path))
    return ["callback:'called_back.Callback'"]


@pytest.mark.slow
def test_interrupted_and_started_again(
    call: Call, callback: list[str], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setenv("HOW", "signal")
    with pytest.raises(SystemExit) as caught:
        call("--seeds", "3", "--run-dir", "together", more=callback)
    assert caught.value.code == 130
    assert "interrupted; the same command with --run-dir together goes on" in capsys.readouterr().err
    newest = {steps(f"together/seed-{seed}")[-1] for seed in range(3)}
    assert len(newest) == 1
    assert newest < {70, 71}
    monkeypatch.setenv("HOW", "")
    call("--seeds", "3", "--run-dir", "together", more=callback)
    call("--seed", "1", "--run-dir", "alone", more=callback)
    # Where the rows' files are cut is not the same.
    ours, theirs = (
        {name: value for name, value in outcome(folder).items() if not name.startswith("replay.next_")}
        for folder in ("together/seed-1", "alone")
    )
    check_equal(ours, theirs)
    assert "replay.rewards" in ours


def test_interrupted_without_a_folder_all_are_saved(
    call: Call, callback: list[str], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setenv("HOW", "signal")
    # Saving takes longer than those are waited for that need not save.
    monkeypatch.setattr(lockstep, "PATIENCE", 0.0)
    with pytest.raises(SystemExit) as caught:
        cli.main([*COMMAND, "-n", "120", "--seeds", "3", "-params", *OFF_POLICY, *callback])
    assert caught.value.code == 130
    assert "interrupted; all were saved" in capsys.readouterr().err
    folders = sorted(Path("logs/sac_sample").iterdir())
    assert len(folders) == 3 and all((folder / "Pendulum-v1.zip").exists() for folder in folders)


def test_a_run_that_fails_and_the_others_go_on(
    call: Call, callback: list[str], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setenv("HOW", "error")
    with pytest.raises(SystemExit) as caught:
        call("--seeds", "3", "--run-dir", "together", more=callback)
    assert caught.value.code == 1
    said = capsys.readouterr().err
    assert "The run of seed 1 has failed, and the others go on:\nTraceback" in said
    assert "sb3-sample train: 1 of 3 runs have failed: seed 1: LookupError: what was looked for" in said
    assert [steps(f"together/seed-{seed}")[-1] for seed in range(3)] == [120, 70, 120]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seeds", "0"], "--seeds must be at least 1, if it is how many, not 0"),
        (["--seeds", "1", "2", "1"], "--seeds must differ, not 1 2 1"),
        (["--seeds", "1", "-2"], "a seed of --seeds must be at least 0 and below"),
        (["--seeds", "2", "--seed", "3"], "--seed does not go with --seeds: leave one of them out"),
        (["--seeds", "2", "-P"], "-P does not go with --seeds"),
        (["--seeds", "2", "-optimize"], "-optimize does not go with --seeds"),
        (
            ["--seeds", "2", "--algo", "mbma"],
            "--seeds is for the off-policy algorithms of this package, .*, not --algo",
        ),
        (["--seeds", "2", "--algo", "ppo"], "--seeds is for the off-policy algorithms of this package"),
        (["--seeds", "2", "--resume", "--run-dir", "none"], "none/seed-0 has no checkpoint to go on from"),
        (["--seeds", "2", "-params", "gamme:1"], "gamme is no hyperparameter of sac_sample"),
        (["--seeds", "2", "-params", "gamma:2"], r"gamma must lie in \[0, 1\], not 2"),
    ],
)
def test_what_is_refused(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    import re

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    with pytest.raises(SystemExit) as caught:
        cli.main([*COMMAND, *arguments])
    assert caught.value.code == 2
    assert re.search(words, capsys.readouterr().err)
