"""Runs of ``sb3-sample train`` that learn from data sets."""

import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("h5py")

import h5py
from rl_zoo3 import ALGOS

from sb3_sample import cli, make_env, zoo
from sb3_sample.zoo.patches import models_checked
from sb3_sample.zoo.records import Record
from tests.test_zoo_runs import check_equal, outcome, steps

zoo.register()

Run = Callable[..., None]
COMMAND = [
    "train", "--env", "Pendulum-v1", "--device", "cpu", "--eval-freq", "20", "--eval-episodes", "1", "--verbose", "0",
    "--num-threads", "1", "--log-interval", "10",
]  # fmt: skip
SMALL = ["-params", "buffer_size:2000", "policy_kwargs:dict(net_arch=[8])", "batch_size:16", "learning_starts:20"]


def write(path: Path, n: int = 120, seed: int = 0) -> None:
    """Random transitions of Pendulum in D4RL's layout, the actions in the environment's units."""
    rng = np.random.default_rng(seed)
    ends = np.zeros(n, bool)
    ends[39::40] = True
    arrays = {
        "observations": rng.normal(size=(n, 3)).astype(np.float32), "rewards": rng.normal(size=n).astype(np.float32),
        "actions": rng.uniform(-2, 2, (n, 1)).astype(np.float32), "terminals": ends, "timeouts": ends & False,
        "next_observations": rng.normal(size=(n, 3)).astype(np.float32),
    }  # fmt: skip
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs the command in a folder that has two data sets only."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    write(tmp_path / "a.hdf5")
    write(tmp_path / "b.hdf5", seed=1)
    return lambda *arguments: cli.main([*COMMAND, *arguments, *SMALL])


@pytest.mark.parametrize(
    "algo", ["bc", "iql", *(pytest.param(name, marks=pytest.mark.slow) for name in ("td3bc", "bro_fast"))]
)
def test_learns_from_a_data_set(run: Run, algo: str) -> None:
    if algo == "bro_fast":
        small = ["buffer_size:2000", "model_size:(1,8)", "batch_size:16"]
        cli.main([*COMMAND, "--algo", algo, "--dataset", "a.hdf5", "-n", "40", "--seed", "0", "-params", *small])
    else:
        run("--algo", algo, "--dataset", "a.hdf5", "-n", "40", "--seed", "0")
    folder = Path("logs") / algo / "Pendulum-v1_1"
    model = ALGOS[algo].load(folder / "Pendulum-v1.zip", device="cpu")
    assert model.num_timesteps == model._n_updates == model._n_offline_updates == 40 and model.num_transitions == 0
    assert model.action_space.high.tolist() == [2.0]
    assert list(np.load(folder / "evaluations.npz")["timesteps"]) == [20, 40]


def test_a_data_set_of_minaris(run: Run) -> None:
    pytest.importorskip("minari", reason="needs the extra [offline]")
    cli.main(["dataset", "convert", "a.hdf5", "sets/a", "--env", "Pendulum-v1"])
    run("--algo", "iql", "--dataset", "sets/a", "-n", "20", "--run-dir", "run")
    dataset = json.loads(Path("run/run.json").read_text())["settings"]["dataset"]
    assert dataset.startswith("Dataset(120 transitions, sha256 ")
    # It is the same data set in another file.
    run("--algo", "iql", "--dataset", "a.hdf5", "-n", "30", "--run-dir", "run")
    assert steps("run") == [20, 30]


FINE_TUNED = ("--algo", "iql", "--dataset", "a.hdf5", "--offline-steps", "50", "--prior-data", "b.hdf5",
              "--checkpoint-freq", "20", "--seed", "3")  # fmt: skip


def test_a_fine_tuned_run_goes_on_wherever_it_was_interrupted(run: Run) -> None:
    def fine_tuned(folder: str) -> None:
        run(*FINE_TUNED, "-n", "110", "--run-dir", folder, "--eval-freq", "40")

    fine_tuned("whole")
    whole = outcome("whole", "iql")
    assert whole["num_timesteps"] == 110 and list(whole["timesteps"]) == [40, 80]
    assert steps("whole/offline") == [40, 50] and steps("whole") == [100, 110]
    # 20 transitions come before the first gradient step.
    assert whole["n_updates"] == 50 + 40

    shutil.copytree("whole", "between")
    for path in (*Path("between").glob("checkpoint-*"), Path("between/replay")):
        shutil.rmtree(path)
    shutil.copytree("between", "early")
    shutil.rmtree("early/offline/checkpoint-000000000050")
    shutil.copytree("whole", "late")
    shutil.rmtree("late/checkpoint-000000000110")
    for name in "between", "early", "late":
        fine_tuned(name)
        check_equal(whole, outcome(name, "iql"))


def test_evaluations_of_the_offline_phase_outlive_a_kill_before_the_next(run: Run) -> None:
    arguments = (*FINE_TUNED, "-n", "110", "--eval-freq", "40", "--run-dir")
    run(*arguments, "whole")
    run(*FINE_TUNED, "-n", "70", "--eval-freq", "40", "--run-dir", "cut")
    assert steps("cut") == [60, 70] and list(outcome("cut", "iql")["timesteps"]) == [40]
    run(*arguments, "cut")
    whole, again = outcome("whole", "iql"), outcome("cut", "iql")
    assert list(again["timesteps"]) == list(whole["timesteps"]) == [40, 80]


def test_prior_data_of_a_run_in_its_environment(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    online = ("--algo", "sac_sample", "-n", "60", "--run-dir", "run", "--checkpoint-freq", "30")
    cli.main([*COMMAND, *online, "--prior-data", "a.hdf5", *SMALL, "prior_share:0.25"])
    with pytest.raises(SystemExit):
        cli.main([*COMMAND, *online, "--prior-data", "b.hdf5", *SMALL, "prior_share:0.25"])
    said = capsys.readouterr().err
    assert "the run in run was started with prior_data Dataset(120 transitions, sha256" in said
    model = ALGOS["sac_sample"].load("run/Pendulum-v1.zip", device="cpu")
    assert model._prior_of["size"] == 120 and model.prior_share == 0.25 and model._n_updates == 80
    # To act it needs none.
    enjoy = ["enjoy", "--run-dir", "run", "--no-render", "-n", "5", "--device", "cpu", "--num-threads", "1"]
    cli.main(enjoy)
    # Nor if it is loaded with its environment, as by record_video, and by enjoy with HerReplayBuffer.
    with models_checked(lambda _: None):
        shown = ALGOS["sac_sample"].load("run/Pendulum-v1.zip", env=make_env("Pendulum-v1"), device="cpu")
    assert shown.prior_data is None and shown.num_timesteps == 60


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--algo", "bc"], "--algo bc learns from data only: give --dataset"),
        (["--algo", "bc", "--prior-data", "a.hdf5"], "give --dataset in the place of --prior-data"),
        (["--algo", "bc", "--dataset", "a.hdf5", "--offline-steps", "5"], "bc learns from data only, all of -n"),
        (["--algo", "iql", "--offline-steps", "5"], "--offline-steps 5 means nothing without --dataset"),
        (["--algo", "iql", "--dataset", "a.hdf5", "--offline-steps", "0"], "--offline-steps must be at least 1"),
        (["--algo", "iql", "--dataset", "a.hdf5", "--offline-steps", "30"], "must be fewer than all, -n 30, not 30"),
        (["--algo", "iql", "--dataset", "c.hdf5"], "--dataset c.hdf5: path='c.hdf5' must be an HDF5 file"),
        (["--algo", "iql", "--dataset", "none"], "--dataset none: id_or_path='none' must be a data set of Minari's"),
        (["--algo", "mbma_ppo", "--dataset", "a.hdf5"], "--dataset is for bc, brc, .*, not for mbma_ppo"),
        (["--algo", "sac", "--prior-data", "a.hdf5"], "--prior-data is for bc, brc, .*, not for sac"),
        (["--algo", "iql", "--dataset", "a.hdf5", "-optimize"], "--dataset cannot be given with it"),
    ],
)  # fmt: skip
def test_what_is_refused(run: Run, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    if "none" in arguments:
        pytest.importorskip("minari", reason="needs the extra [offline]")
    with pytest.raises(SystemExit) as end:
        run(*arguments, "-n", "30")
    error = capsys.readouterr().err
    assert end.value.code == 2 and re.search(words, error), error


def test_several_environments_are_refused(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([*COMMAND, "--algo", "iql", "--dataset", "a.hdf5", "-n", "30", *SMALL, "n_envs:2"])
    assert "--dataset: n_envs must be 1, not 2" in capsys.readouterr().err


def test_statistics_of_the_environment_are_refused(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([*COMMAND, "--algo", "iql", "--dataset", "a.hdf5", "-n", "30", *SMALL, "normalize:True"])
    assert "--dataset: normalize measures observations and rewards in the environment" in capsys.readouterr().err


def test_a_record_without_data_says_nothing_of_them(run: Run) -> None:
    run("--algo", "sac_sample", "-n", "20", "--run-dir", "run")
    assert not {"dataset", "prior_data", "offline_steps"} & Record.read(Path("run")).settings.keys()
