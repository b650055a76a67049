"""Runs of ``sb3-sample train`` with checkpoints: started, interrupted, started again."""

import argparse
import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml

pytest.importorskip("rl_zoo3")

import optuna
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

from sb3_sample import cli, zoo
from sb3_sample.run_logs import has_ended, read_monitors
from sb3_sample.saving import container
from sb3_sample.saving.decoding import decode
from sb3_sample.saving.locks import take_folder
from sb3_sample.zoo.files import RunError
from sb3_sample.zoo.records import Record
from sb3_sample.zoo.runs import Data, Manager, RunFiles
from sb3_sample.zoo.train import plan, train_parser
from sb3_sample.zoo.watch import model_path

zoo.register()

OFF_POLICY = ["learning_starts:20", "buffer_size:2000", "replay_ratio:0.5", "policy_kwargs:dict(net_arch=[8])"]
ON_POLICY = ["n_steps:16", "batch_size:8", "policy_kwargs:dict(net_arch=[8])", "dynamics_kwargs:dict(width=8)"]
COMMAND = [
    "train", "--algo", "sac_sample", "--env", "Pendulum-v1", "--device", "cpu", "--eval-freq", "100",
    "--eval-episodes", "1", "--log-interval", "1", "--verbose", "0", "--num-threads", "1",
]  # fmt: skip


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Runs the command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    return lambda *arguments: cli.main([*COMMAND, *arguments, "-params", *OFF_POLICY])


def steps(folder: str | Path) -> list[int]:
    """At which environment steps the checkpoints of a run were made."""
    return sorted(int(path.name.removeprefix("checkpoint-")) for path in Path(folder).glob("checkpoint-*"))


def outcome(folder: str | Path, algo: str = "sac_sample", env: str = "Pendulum-v1") -> dict[str, Any]:
    """All that a run has left, but times."""
    folder = Path(folder)
    found: dict[str, Any] = {}
    model: Any = ALGOS[algo].load(folder / f"{env}.zip", device="cpu")
    found["num_timesteps"], found["n_updates"] = model.num_timesteps, model._n_updates
    for name, state in model.get_parameters().items():
        found |= {f"{name}.{key}": value.numpy() for key, value in state.items() if isinstance(value, torch.Tensor)}
    rows: dict[str, list[np.ndarray]] = {}
    for file in sorted((folder / "replay").glob("*.zip")):
        for key, value in decode(*container.read(file, "replay rows"), "rows").items():
            if isinstance(value, np.ndarray):
                rows.setdefault(key, []).append(value)
    found |= {f"replay.{key}": np.concatenate(values) for key, values in rows.items()}
    log = [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]
    found["log"] = [{k: v for k, v in line.items() if not k.startswith("time/")} for line in log]
    for file in folder.glob("*.monitor.csv"):
        with file.open() as lines:
            lines.readline()
            found[file.name] = [(row["r"], row["l"]) for row in csv.DictReader(lines)]
    if (folder / "evaluations.npz").exists():
        found |= dict(np.load(folder / "evaluations.npz"))
    return found


def check_equal(first: dict[str, Any], second: dict[str, Any]) -> None:
    assert first.keys() == second.keys()
    assert [name for name in first if not np.array_equal(first[name], second[name])] == []


# ---------------------------------------------------------------- the command again


def test_the_same_command_goes_on_and_the_run_is_the_same(run, capsys: pytest.CaptureFixture[str]) -> None:
    run("--run-dir", "runs/whole", "--seed", "3", "-n", "440", "--checkpoint-freq", "110", "-tb", "tb")
    run("--run-dir", "runs/parts", "--seed", "3", "-n", "220", "--checkpoint-freq", "110", "-tb", "tb")
    assert steps("runs/parts") == [110, 220]
    before = outcome("runs/parts")
    # What a run leaves that is killed after its last checkpoint.
    with open("runs/parts/0.monitor.csv", "a") as file:
        file.write("-1.0,200,99.0\n")
    run("--run-dir", "runs/parts", "--seed", "3", "-n", "440", "--checkpoint-freq", "110", "-tb", "tb")
    whole, parts = outcome("runs/whole"), outcome("runs/parts")
    check_equal(whole, parts)
    assert parts["num_timesteps"] == 440 and parts["n_updates"] == 210 > before["n_updates"] == 100
    assert [length for _, length in parts["0.monitor.csv"]] == ["200", "200"]
    assert list(parts["timesteps"]) == [100, 200, 300, 400]
    # TensorBoard has one folder for each of the two runs.
    assert sorted(path.name for path in Path("tb/Pendulum-v1").iterdir()) == ["SAC_1", "SAC_2"]
    # When all is done there is nothing to do.
    run("--run-dir", "runs/parts", "--seed", "3", "-n", "440", "--checkpoint-freq", "110", "-tb", "tb")
    check_equal(whole, outcome("runs/parts"))


def test_times_go_on_too_and_each_step_is_in_the_log_of_tensorboard_once(run) -> None:
    pytest.importorskip("tensorboard")
    from stable_baselines3.common.monitor import load_results
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    arguments = ("--run-dir", "a", "--checkpoint-freq", "150", "-tb", "tb", "--eval-freq", "-1")
    run(*arguments, "-n", "220")
    # The last checkpoint is lost, so that the end of the log is written once more.
    assert steps("a") == [150, 220]
    for file in Path("a/checkpoint-000000000220").iterdir():
        file.unlink()
    Path("a/checkpoint-000000000220").rmdir()
    # TensorBoard reads its files in the order of the second in their names, in which two programs never start.
    time.sleep(1.1)
    run(*arguments, "-n", "620")
    episodes = load_results("a")  # sorted by time
    assert list(episodes["l"]) == [200, 200, 200] and list(episodes["index"]) == [0, 1, 2]
    events = EventAccumulator("tb/Pendulum-v1/SAC_1")
    events.Reload()
    assert [event.step for event in events.Scalars("rollout/ep_rew_mean")] == [200, 400, 600]


def test_the_seed_and_the_number_of_steps_are_remembered(run) -> None:
    run("--run-dir", "a", "-n", "60")
    seed, settings = Record.read(Path("a")).seed, Record.read(Path("a")).settings
    run("--run-dir", "a")
    record = Record.read(Path("a"))
    assert (record.seed, record.settings, record.n_timesteps) == (seed, settings, 60)
    assert outcome("a")["num_timesteps"] == 60


def test_a_run_of_other_arguments_is_not_touched(run) -> None:
    run("--run-dir", "a", "-n", "60", "--seed", "1")
    before = {path: path.read_bytes() for path in Path("a").rglob("*") if path.is_file()}
    for arguments, difference in (
        (["--seed", "2"], r"seed 1 \(now 2\)"),
        (["--eval-freq", "10", "--algo", "dac"], r"algo 'sac_sample' \(now 'dac'\), eval_freq 100 \(now 10\)"),
        (["--env-kwargs", "g:3"], r"env_kwargs None \(now \{'g': 3\}\)"),
    ):
        with pytest.raises(SystemExit, match=rf"the run in a was started with {difference}\. Nothing was changed"):
            run("--run-dir", "a", "-n", "60", *arguments)
    with pytest.raises(SystemExit, match=r"replay_ratio 0\.5 \(now 1\), tau not given \(now 0\.1\)"):
        cli.main([*COMMAND, "--run-dir", "a", "-params", *OFF_POLICY[:2], "replay_ratio:1", "tau:0.1", OFF_POLICY[3]])
    assert before == {path: path.read_bytes() for path in Path("a").rglob("*") if path.is_file()}


def test_the_same_settings_in_other_words_are_the_same(run, tmp_path: Path) -> None:
    run("-n", "40", "--eval-freq", "-1")
    first = Path("logs/sac_sample/Pendulum-v1_1/Pendulum-v1.zip")
    start = ["--run-dir", "a", "--checkpoint-freq", "20", "--eval-freq", "-1"]
    run(*start, "-n", "20", "-i", str(first), "--env-kwargs", "g:9.0", "render_mode:None")
    run(*start, "-n", "40", "-i", str(first.absolute()), "--env-kwargs", "render_mode:None", "g:9.0")
    assert steps("a") == [20, 40]
    other = first.with_name("other.zip")
    other.write_bytes(first.read_bytes())
    with pytest.raises(SystemExit, match=r"trained_agent '/.*Pendulum-v1\.zip' \(now 'logs/.*other\.zip'\)"):
        run(*start, "-i", str(other), "--env-kwargs", "render_mode:None", "g:9.0")


def test_resume_goes_on_with_the_run_of_the_latest_checkpoint(run) -> None:
    with pytest.raises(SystemExit, match="no run of sac_sample on Pendulum-v1 below logs has a checkpoint"):
        run("--resume")
    run("--checkpoint-freq", "30", "-n", "60")
    run("--checkpoint-freq", "30", "-n", "60")
    run("--checkpoint-freq", "30", "-n", "60", "--algo", "dac", "--eval-freq", "-1")
    run("-n", "40")
    first, second, third = (Path(f"logs/sac_sample/Pendulum-v1_{i}") for i in (1, 2, 3))
    assert steps(first) == steps(second) == [30, 60] and steps(third) == []
    run("--resume", "-n", "80")
    assert steps(first) == [30, 60] and steps(second) == [60, 80]
    run("--resume", "--run-dir", str(first), "-n", "90")
    assert steps(first) == [60, 90] and steps("logs/dac/Pendulum-v1_1") == [30, 60]
    # The first has the latest checkpoint now.
    run("--resume", "-n", "120")
    assert steps(first) == [90, 120]
    with pytest.raises(SystemExit, match="no run of sr_sac on Pendulum-v1"):
        run("--resume", "--algo", "sr_sac")


def test_a_run_that_begins_with_another_ones_model(run) -> None:
    run("-n", "60", "--save-replay-buffer", "--seed", "1")
    first = Path("logs/sac_sample/Pendulum-v1_1")
    begin = ("--seed", "2", "--checkpoint-freq", "40", "-i", str(first / "Pendulum-v1.zip"))
    run("--run-dir", "whole", "-n", "80", *begin)
    run("--run-dir", "parts", "-n", "40", *begin)
    run("--run-dir", "parts", "-n", "80", *begin)
    check_equal(outcome("whole"), outcome("parts"))
    assert outcome("parts")["n_updates"] > 40


def test_a_model_keeps_its_settings_but_those_of_the_command(run, capsys: pytest.CaptureFixture[str]) -> None:
    run("-n", "60", "--save-replay-buffer")
    first = "logs/sac_sample/Pendulum-v1_1/Pendulum-v1.zip"
    cli.main([*COMMAND, "-n", "40", "-i", first, "-params", "batch_size:16"])
    # The entry of the task has others.
    assert "the model of -i keeps its own, which -params replaces: learning_starts, policy" in capsys.readouterr().out
    model: Any = ALGOS["sac_sample"].load(first.replace("_1/", "_2/"), device="cpu")
    assert (model.learning_starts, model.gamma, model.replay_ratio, model.batch_size) == (20, 0.99, 0.5, 16)
    assert model.buffer_size == 2000 and model._n_updates == 20 + 20
    settings = yaml.unsafe_load(Path("logs/sac_sample/Pendulum-v1_2/Pendulum-v1/config.yml").read_text())
    assert dict(settings) == {"batch_size": 16, "n_timesteps": 1e4}
    with pytest.raises(SystemExit, match="policy_kwargs must be those of the file, or be left out; .*net_arch"):
        cli.main([*COMMAND, "-n", "40", "-i", first, "-params", "policy_kwargs:dict(net_arch=[16])"])
    cli.main([*COMMAND, "-n", "40", "-i", first, "-params", "policy:'MlpPolicy'", OFF_POLICY[-1]])


def test_a_model_goes_on_with_the_parameters_of_a_trial(run) -> None:
    study = optuna.create_study(storage="sqlite:///study.db", study_name="study")
    for _ in range(2):
        trial = study.ask()
        HYPERPARAMS_SAMPLER["sac_sample"](trial, 1, 1, {"using_her_replay_buffer": False, "her_kwargs": {}})
        study.tell(trial, 0.0)
    run("-n", "30", "--eval-freq", "-1")
    of_study = ["--storage", "sqlite:///study.db", "--study-name", "study", "--trial-id", "1", "--eval-freq", "-1"]
    cli.main([*COMMAND, "-n", "10", "-i", "logs/sac_sample/Pendulum-v1_1/Pendulum-v1.zip", *of_study])
    model: Any = ALGOS["sac_sample"].load("logs/sac_sample/Pendulum-v1_2/Pendulum-v1.zip", device="cpu")
    found = study.trials[1].params
    assert (model.batch_size, model.tau) == (2 ** found["batch_size_pow"], found["tau"])
    assert (model.learning_starts, model.replay_ratio) == (20, 0.5)


def test_networks_of_another_size_than_the_entrys_go_on(run) -> None:
    bro = [*COMMAND, "--algo", "bro_fast", "--eval-freq", "-1", "-n", "30"]
    cli.main([*bro, "-params", "model_size:(1, 8)", *OFF_POLICY[:3]])
    cli.main([*bro, "-i", "logs/bro_fast/Pendulum-v1_1/Pendulum-v1.zip"])
    second: Any = ALGOS["bro_fast"].load("logs/bro_fast/Pendulum-v1_2/Pendulum-v1.zip", device="cpu")
    assert (second.model_size, second.num_transitions) == ((1, 8), 60)


def test_copies_of_the_model_go_on_and_a_progress_bar_may_come(run) -> None:
    arguments = ("--checkpoint-freq", "30", "--save-freq", "40", "--seed", "1")
    run("--run-dir", "parts", "-n", "60", *arguments)
    run("--run-dir", "parts", "-n", "90", *arguments, "--progress")
    assert {path.name for path in Path("parts").glob("rl_model_*")} == {f"rl_model_{n}_steps.zip" for n in (40, 80)}


# ---------------------------------------------------------------- what is refused


def test_what_cannot_have_checkpoints_is_refused(run, tmp_path: Path) -> None:
    for arguments in (["--run-dir", "a"], ["--checkpoint-freq", "10"]):
        with pytest.raises(SystemExit, match=r"--algo ppo has no checkpoints .* of this package, bc, .*, vpl_sac"):
            cli.main(["train", "--algo", "ppo", "--env", "Pendulum-v1", *arguments])
    with pytest.raises(SystemExit, match="-optimize has no checkpoints"):
        run("--run-dir", "a", "-optimize")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("checkpoints", [[], ["--checkpoint-freq", "40"]])
def test_trainings_started_together_have_a_folder_each(
    checkpoints: list[str], run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = Path("logs/sac_sample/Pendulum-v1_1/Pendulum-v1.zip")
    original = ExperimentManager.__init__

    def started_together(self: Any, *args: Any, **kwargs: Any) -> None:
        original(self, *args, **kwargs)
        theirs.parent.mkdir(parents=True, exist_ok=True)
        theirs.write_text("another run's")

    monkeypatch.setattr(ExperimentManager, "__init__", started_together)
    with pytest.raises(SystemExit, match="no hyperparameter"):
        cli.main([*COMMAND, "-n", "60", *checkpoints, "-params", "learning_start:20"])
    assert list(theirs.parent.parent.iterdir()) == [theirs.parent]
    theirs.unlink()
    theirs.parent.rmdir()
    run("-n", "60", *checkpoints)
    assert theirs.read_text() == "another run's" and list(theirs.parent.iterdir()) == [theirs]
    ours = theirs.parent.with_name("Pendulum-v1_2")
    assert {"Pendulum-v1.zip", "Pendulum-v1", "0.monitor.csv"} <= {path.name for path in ours.iterdir()}
    assert (ours / "run.json").exists() == bool(steps(ours)) == bool(checkpoints)
    assert (ours / "Pendulum-v1/config.yml").exists()


def test_the_number_of_a_folder_in_one_whose_name_is_a_pattern(run) -> None:
    # The zoo's look-up of the last number finds nothing there.
    for _ in range(2):
        run("-n", "60", "-f", "logs[1]")
    assert {path.name for path in Path("logs[1]/sac_sample").iterdir()} == {"Pendulum-v1_1", "Pendulum-v1_2"}


def test_a_search_without_a_completed_trial_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)

    def prune(self: Any, trial: optuna.Trial) -> float:
        raise optuna.TrialPruned

    monkeypatch.setattr(Manager, "objective", prune)
    search = [*COMMAND, "-n", "60", "-optimize", "--n-trials", "2", "-params", "learning_starts:20"]
    with pytest.raises(SystemExit, match="no trial was completed: all were pruned"):
        cli.main(search)
    callback = "callback:{'sb3_sample.diagnostics.DiagnosticsCallback': {'every': 10}}"
    with pytest.raises(SystemExit, match="callback: DiagnosticsCallback does not go with -optimize"):
        cli.main([*search, callback])


def test_the_trials_of_a_search_are_of_the_same_kind(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Manager, "objective", lambda self, trial: float(trial.number))
    for storage in ("sqlite:///study.db", "studies/study.log"):
        search = [*COMMAND, "-n", "60", "-optimize", "--n-trials", "1", "--no-optim-plots", "--storage", storage]
        search += ["--study-name", "s"]
        cli.main([*search, "-params", "learning_starts:20"])
        cli.main([*search, "--seed", "3", "--sampler", "random", "-params", "learning_starts:20"])
        for changed, words in (
            (["--env", "MountainCarContinuous-v0"], "env 'Pendulum-v1' .now 'MountainCarContinuous-v0'"),
            (["-n", "90"], "n_timesteps 60 .now 90"),
        ):
            with pytest.raises(SystemExit, match=f"--study-name s: the search in {storage} was begun with .*{words}"):
                cli.main([*search, *changed, "-params", "learning_starts:20"])
        with pytest.raises(SystemExit, match="gamma not given .now 0.9., learning_starts 20 .now 30"):
            cli.main([*search, "-params", "learning_starts:30", "gamma:0.9"])
        with pytest.raises(SystemExit, match="--study-name s: .*algo 'sac_sample' .now 'dac'"):
            cli.main([*search, "--algo", "dac"])
    # A search of which no trial has come to a value may be begun anew with others.
    with monkeypatch.context() as patch:
        patch.setattr(Manager, "objective", lambda self, trial: float("nan"))
        for words in ("learning_starts:20", "learning_starts:30"):
            with pytest.raises(SystemExit, match="no trial was completed"):
                cli.main([*search[:-1], "failed", "-params", words])
    # Objects are written without their place in memory.
    Path("conf.py").write_text(
        "hyperparams = {'default': dict(n_timesteps=60, policy='MlpPolicy', policy_kwargs=dict(net_arch=[8], "
        "activation_fn=lambda: None))}"
    )
    cli.main([*search[:-1], "objects", "--storage", "sqlite:///objects.db", "--conf-file", "conf.py"])
    recorded = optuna.load_study(storage="sqlite:///objects.db", study_name="objects").user_attrs["sb3_sample"]
    assert "'activation_fn': <function <lambda>>" in recorded["policy_kwargs"]
    names = optuna.get_all_study_names("sqlite:///study.db")
    assert names == ["s"] and len(optuna.load_study(storage="sqlite:///study.db", study_name="s").trials) == 2
    # One that was begun by another program goes on.
    optuna.create_study(storage="sqlite:///study.db", study_name="other", direction="maximize").add_trial(
        optuna.trial.create_trial(value=1.0)
    )
    search = [*COMMAND, "-n", "60", "-optimize", "--n-trials", "1", "--no-optim-plots", "--study-name", "other"]
    cli.main([*search, "--storage", "sqlite:///study.db"])
    assert len(optuna.load_study(storage="sqlite:///study.db", study_name="other").trials) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-n", "0"], "-n must be at least 1, in steps, not 0"),
        (["-n", "-5"], "-n must be at least 1, in steps, not -5"),
        (["--trial-id", "-1"], "trial_id must be at least 1, not -1"),
        (["--storage", "sqlite:///s.db"], "--storage has no effect without -optimize or --trial-id"),
        (["--study-name", "s"], "--study-name has no effect without -optimize or --trial-id"),
        (["-optimize", "-i", "model.zip"], "-optimize searches with new agents: leave out -i model.zip"),
        (["--conf-file", "none.yml"], "--conf-file none.yml cannot be read: .*No such file"),
        (["--conf-file", "broken.yml"], "--conf-file broken.yml cannot be read: while parsing"),
        (["--conf-file", "none"], "--conf-file none cannot be read: No module named 'none'"),
        (["--conf-file", "json"], "--conf-file json cannot be read: module 'json' has no attribute 'hyperparams'"),
        (["--gym-packages", "none"], "--gym-packages none cannot be imported: No module named 'none'"),
        (
            ["-params", "env_wrapper:'none.Wrapper'"],
            "a hyperparameter names what cannot be imported: No module named 'none'",
        ),
        (["-params", "callback:'json.None'"], "names what cannot be imported: module 'json' has no attribute 'None'"),
        (["-params", "noise_type:'normal'"], "noise_type=normal needs noise_std: give it too"),
        (["-params", "noise_type:'x'", "noise_std:0.1"], 'noise_type=x: Unknown noise type "x"'),
        (["--env-kwargs", "g:9.0", "-params", "normalize:'dict(clip=1)'"], "normalize=dict.clip=1.: .*'clip'"),
        (["--env-kwargs", "h:9.0"], "Pendulum-v1 cannot be made with env_kwargs={'h': 9.0}"),
    ],
)
def test_arguments_that_mean_nothing_are_refused_in_a_line(
    arguments: list[str], words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("broken.yml").write_text("a: [")
    Path("model.zip").touch()
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SystemExit, match=words):
        cli.main([*COMMAND, *arguments])
    assert [path for path in sorted(tmp_path.rglob("*")) if path.is_file()] == before


def test_a_folder_in_which_another_process_trains_is_not_touched(run, tmp_path: Path) -> None:
    run("--run-dir", "a", "-n", "60")
    before = {path: path.read_bytes() for path in Path("a").rglob("*") if path.is_file()}
    with take_folder(Path("a")), pytest.raises(SystemExit, match="a is in use: another process trains in it"):
        run("--run-dir", "a", "-n", "90")
    assert {path: path.read_bytes() for path in Path("a").rglob("*") if path.is_file()} == before
    run("--run-dir", "a", "-n", "90")
    # Another process has made it since, and has not begun yet.
    Path("b").mkdir()
    with take_folder(Path("b")), pytest.raises(SystemExit, match="b is in use"):
        run("--run-dir", "b", "-n", "60")
    assert list(Path("b").iterdir()) == []


def test_results_without_a_checkpoint_are_not_written_over(run) -> None:
    run("--run-dir", "a", "-n", "60", "--eval-freq", "30")
    for path in Path("a").glob("checkpoint-*"):
        shutil.rmtree(path)
    before = {path: path.read_bytes() for path in Path("a").rglob("*") if path.is_file()}
    for name in ("Pendulum-v1.zip", "best_model.zip", "evaluations.npz"):
        with pytest.raises(SystemExit, match=f"--run-dir a has {name}, but no checkpoint to go on from"):
            run("--run-dir", "a", "-n", "60", "--eval-freq", "30")
        assert {path: path.read_bytes() for path in Path("a").rglob("*") if path.is_file()} == before
        Path("a", name).unlink()
        del before[Path("a", name)]
    run("--run-dir", "a", "-n", "60", "--eval-freq", "30")
    assert steps("a")[-1] == 60


def test_a_record_that_was_not_written_whole_is_no_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)

    def full(*paths: Any) -> None:
        raise OSError(28, "No space left on device")

    record = Record("bro", "X", 0, 1, 1, {})
    for name in ("fsync", "replace"):
        with monkeypatch.context() as patched:
            patched.setattr(f"sb3_sample.saving.temporary.os.{name}", full)
            with pytest.raises(OSError, match="No space left"):
                record.write(Path("a"))
        assert list(Path("a").iterdir()) == []
    Path("a/.run.json.0123456789ab.tmp").touch()  # of a process that was killed
    start = plan(*train_parser().parse_known_args(["--run-dir", "a"]))
    assert start is not None and start.folder == Path("a") and start.record is None
    record.write(Path("a"))
    assert [path.name for path in Path("a").iterdir()] == ["run.json"] and Record.read(Path("a")) == record


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--run-dir", "full"], "--run-dir full holds files, but no run with checkpoints"),
        (["--run-dir", "full/file"], "--run-dir full/file holds files"),
        (["--run-dir", "a", "--checkpoint-freq", "0"], "--checkpoint-freq must be at least 1, .*, not 0"),
        (["--run-dir", "a", "--resume"], "--resume: a has no checkpoint to go on from"),
        (["--resume"], "--resume needs --run-dir, or --algo and --env"),
        (["--resume", "--algo", "bro", "--env", "X"], "no run of bro on X below logs has a checkpoint"),
        (["--run-dir", "lost"], r"lost is no folder of a run of sb3-sample train: it has no run\.json"),
        (["--run-dir", "odd"], r"odd/run\.json is not what sb3-sample train has written"),
        (["--run-dir", "wrong"], r"wrong/run\.json is not what sb3-sample train has written: a value"),
    ],
)
def test_bad_arguments(arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("full").mkdir()
    Path("full/file").touch()
    for name in ("lost", "odd", "wrong"):
        Path(name, "checkpoint-000000000010").mkdir(parents=True)
    Path("odd/run.json").write_text('{"arguments": []}')
    Path("wrong/run.json").write_text(json.dumps(Record("bro", "X", "--help", 1, 1, {})._asdict()))  # type: ignore[arg-type]
    with pytest.raises(RunError, match=message):
        plan(*train_parser().parse_known_args(arguments))


def test_the_last_checkpoint_of_a_run_that_is_not_finished_is_watched(
    run, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run("--run-dir", "a", "--checkpoint-freq", "50", "-n", "120", "--eval-freq", "-1")
    assert model_path(Path("a"), "sac_sample", "Pendulum-v1")[1].endswith("Pendulum-v1.zip")
    Path("a/Pendulum-v1.zip").unlink()
    last = f"checkpoint-{steps('a')[-1]:012d}"
    assert Path(model_path(Path("a"), "sac_sample", "Pendulum-v1")[1]) == Path("a") / last / "model.zip"
    assert f"not finished: the last one, {last}, is taken" in capsys.readouterr().out
    # That of a run which was interrupted, goes on and has not ended again is older.
    run("--run-dir", "a", "-n", "120", "--eval-freq", "-1")
    assert has_ended(Path("a"))
    os.utime("a/Pendulum-v1.zip", (1, 1))
    assert not has_ended(Path("a"))
    assert Path(model_path(Path("a"), "sac_sample", "Pendulum-v1")[1]) == Path("a") / last / "model.zip"
    cli.main([*["enjoy", "--algo", "sac_sample", "--env", "Pendulum-v1", "--no-render", "-n", "5", "--run-dir", "a"]])
    assert f"older than its checkpoints: the last one, {last}, is taken" in capsys.readouterr().out
    Path("logs/sac_sample").mkdir(parents=True)
    os.rename("a", "logs/sac_sample/Pendulum-v1_1")
    cli.main([*["enjoy", "--algo", "sac_sample", "--env", "Pendulum-v1", "--no-render", "-n", "5", "-f", "logs"]])
    assert "Pendulum-v1.zip is older than the last checkpoint beside it" in capsys.readouterr().err
    (tmp_path / "b").mkdir()
    with pytest.raises(SystemExit, match="neither a model of a finished run nor a checkpoint"):
        model_path(tmp_path / "b", "sac_sample", "Pendulum-v1")


def test_a_folder_of_a_run_that_never_had_a_checkpoint_starts_anew(run) -> None:
    Record("sac_sample", "Pendulum-v1", 1, 60, 30, {}).write(Path("a"))
    Path("a/0.monitor.csv").write_text("#{}\nr,l,t\n")
    run("--run-dir", "a", "-n", "220")
    assert outcome("a")["0.monitor.csv"][0][1] == "200"


def files_of(folder: Path) -> RunFiles:
    callback = RunFiles(folder)
    callback.model = SimpleNamespace(logger=SimpleNamespace(output_formats=[]))  # type: ignore[assignment]
    return callback


@pytest.mark.parametrize(
    ("name", "size"),
    [("/absolute", 0), ("../b/0.monitor.csv", 0), ("run.json", 0), ("", 0), ("0.monitor.csv", -1), (3, 0),
     ("0.monitor.csv", True), ("0.monitor.csv", 1.0), ("0.monitor.csv", 2**70), ("a\0.monitor.csv", 0)],
)  # fmt: skip
def test_only_files_of_monitor_in_the_folder_are_cut(name: Any, size: Any, tmp_path: Path) -> None:
    """What they are is said by a file, which may be anybody's."""
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        for file in ("0.monitor.csv", "run.json"):
            (tmp_path / folder / file).write_text("the user's")
    name = str(tmp_path / "b" / "0.monitor.csv") if name == "/absolute" else name
    with pytest.raises(ValueError, match="is no file of Monitor's"):
        files_of(tmp_path / "a").load_state_dict({name: size})
    assert {path.read_text() for path in tmp_path.glob("*/*")} == {"the user's"}
    files_of(tmp_path / "a").load_state_dict({"0.monitor.csv": 3})
    assert (tmp_path / "a" / "0.monitor.csv").read_text() == "the"


@pytest.mark.parametrize("make", [os.symlink, os.link])
def test_what_leads_elsewhere_is_not_cut(make: Any, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "profile").write_text("the user's")
    make(tmp_path / "profile", tmp_path / "a" / "0.monitor.csv")
    with pytest.warns(UserWarning, match="cannot be cut back to the checkpoint"):
        files_of(tmp_path / "a").load_state_dict({"0.monitor.csv": 0})
    assert (tmp_path / "profile").read_text() == "the user's"


@pytest.mark.parametrize("name", ["0.monitor.csv", "best_model.zip", "Pendulum-v1/args.yml", "Pendulum-v1", "run.json"])
def test_a_folder_with_links_is_refused(name: str, run, tmp_path: Path) -> None:
    Record("sac_sample", "Pendulum-v1", 1, 60, 30, {}).write(Path("a"))
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_text("the user's")
    Path("a", name).parent.mkdir(exist_ok=True)
    Path("a", name).unlink(missing_ok=True)
    Path("a", name).symlink_to(tmp_path / "there" / "file")
    with pytest.raises(SystemExit, match=f"a/{name} is a link, and a run follows none"):
        run("--run-dir", "a", "-n", "60")
    assert (tmp_path / "there" / "file").read_text() == "the user's"


@pytest.mark.parametrize("name", ["0.monitor.csv", "evaluations.npz", "run.json", "Pendulum-v1/args.yml"])
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
@pytest.mark.parametrize("goes_on", [False, True])
def test_a_folder_with_pipes_or_folders_for_files_is_refused(
    name: str, make: Callable[[Path], None], goes_on: bool, run
) -> None:
    Record("sac_sample", "Pendulum-v1", 1, 60, 30, {}).write(Path("a"))
    if goes_on:
        Path("a/checkpoint-000000000030").mkdir()
    Path("a", name).parent.mkdir(exist_ok=True)
    Path("a", name).unlink(missing_ok=True)
    make(Path("a", name))
    with pytest.raises(SystemExit, match=f"a/{name} is no file, where a run has one: remove it"):
        run("--run-dir", "a", "-n", "60")


@pytest.mark.parametrize("text", ["", "r,l,t\n", '#{"t_start": 1.0}\n'])
def test_a_run_does_not_append_to_what_is_no_file_of_monitor(text: str, run) -> None:
    run("--run-dir", "a", "--checkpoint-freq", "50", "-n", "60", "--eval-freq", "-1")
    Path("a/0.monitor.csv").write_text(text)
    with pytest.raises(SystemExit, match="is no file of Monitor's: .* remove it, and a new one is begun"):
        run("--run-dir", "a", "--checkpoint-freq", "50", "-n", "120", "--eval-freq", "-1")
    assert Path("a/0.monitor.csv").read_text() == text


def test_one_of_several_monitor_files_may_be_missing(run) -> None:
    command = [*COMMAND, "--run-dir", "a", "--eval-freq", "-1", "-params", *OFF_POLICY, "n_envs:2"]
    cli.main([*command, "-n", "500"])
    Path("a/1.monitor.csv").unlink()
    with pytest.warns(UserWarning, match=r"1\.monitor\.csv has \d+ bytes, .* episodes are missing"):
        cli.main([*command, "-n", "900"])
    assert [len(outcome("a")[f"{k}.monitor.csv"]) for k in (0, 1)] == [2, 1]
    assert len(read_monitors("a")) == 3


@pytest.mark.parametrize("arguments", [["--run-dir", "a"], []])
def test_ctrl_c_is_one_line_and_130(
    arguments: list[str], run, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: Any, *_: Any) -> None:
        if self.num_timesteps == 50:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(ALGOS["sac_sample"], "train", interrupted)
        with pytest.raises(SystemExit) as caught:
            run("-n", "200", *arguments)
    assert caught.value.code == 128 + signal.SIGINT
    *before, last = capfd.readouterr().err.splitlines()
    assert last.startswith("sb3-sample train: interrupted; ")
    assert ("--run-dir a goes on" in last) == bool(arguments) == any("finishing the turn" in line for line in before)
    assert not [line for line in before if "Traceback" in line]
    assert ALGOS["sac_sample"].load(next(Path().rglob("Pendulum-v1.zip"))).num_timesteps == 50
    if arguments:
        run("-n", "60", *arguments)
        assert steps("a") == [50, 60]


def test_help_has_both_kinds_of_options(run, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        cli.main(["train", "--help"])
    assert exit_.value.code == 0
    output = capsys.readouterr().out
    assert all(option in output for option in ("--run-dir DIR", "--checkpoint-freq N", "--resume", "--save-freq"))


# ---------------------------------------------------------------- Atari


def atari_run(folder: Path, **hyperparams: Any) -> Manager:
    """A manager of a run of SR-SPR on a game, whose settings are read."""
    pytest.importorskip("ale_py")
    args = argparse.Namespace(algo="srspr", optimize_hyperparameters=False, n_timesteps=-1)
    options: dict[str, Any] = {"eval_freq": -1, "device": "cpu", "verbose": 0, "hyperparams": hyperparams}
    found = Manager(Data(), args, "srspr", "ALE/Breakout-v5", str(folder), **options)
    _, found.env_wrapper, _, _ = found._preprocess_hyperparams(found.read_hyperparameters()[0])
    return found


def test_games_are_evaluated_whole_and_with_their_own_rewards(tmp_path: Path) -> None:
    manager = atari_run(tmp_path)
    for eval_env in (True, False, True):
        env: Any = manager.create_envs(1, eval_env=eval_env, no_log=True)
        words = str(env.envs[0])
        assert "NoopReset" in words and env.observation_space.shape == (4, 84, 84)
        assert [each in words for each in ("EpisodicLife", "ClipReward")] == [not eval_env] * 2


def test_a_game_without_its_rom_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manager = atari_run(tmp_path)
    monkeypatch.setenv("ALE_ROMS_DIR", str(tmp_path))
    with pytest.raises(RunError, match="ALE/Breakout-v5 .*ALE_ROMS_DIR"):
        manager.create_envs(1, no_log=True)


def test_frames_that_are_stacked_are_not_stacked_again(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="frame_stack=3 would be the zoo's VecFrameStack .* srspr .* leave it out"):
        atari_run(tmp_path, frame_stack=3)


# ---------------------------------------------------------------- killed


def start(folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "sb3_sample.cli", *COMMAND, *arguments],
        cwd=folder, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL,
        stderr=(folder / "stderr.txt").open("ab"), start_new_session=True,
    )  # fmt: skip


def finish(process: subprocess.Popen[bytes], folder: Path) -> None:
    assert process.wait(240) == 0, (folder / "stderr.txt").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "arguments"),
    [
        ("sac_sample", ["-params", *OFF_POLICY]),
        ("sac_sample", ["--vec-env", "subproc", "-params", *OFF_POLICY, "n_envs:4", "normalize:True"]),
        ("mbma_ppo", ["--vec-env", "subproc", "-params", *ON_POLICY, "n_envs:4"]),
    ],
)
def test_a_killed_run_is_started_again_and_ends_as_one_that_never_was(
    algo: str, arguments: list[str], tmp_path: Path
) -> None:
    common = ["--algo", algo, "--seed", "5", "-n", "3200", "--eval-freq", "600", "--checkpoint-freq", "400"]
    finish(start(tmp_path, *common, "--run-dir", "whole", *arguments), tmp_path)
    for after in (400, 1200, 2000):
        process = start(tmp_path, *common, "--run-dir", "killed", *arguments)
        until = time.monotonic() + 120
        while max(steps(tmp_path / "killed"), default=0) < after and time.monotonic() < until:
            time.sleep(0.001)
        time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        assert process.wait(10) == -signal.SIGKILL
    assert max(steps(tmp_path / "killed")) < 3200
    finish(start(tmp_path, *common, "--run-dir", "killed", *arguments), tmp_path)
    check_equal(outcome(tmp_path / "whole", algo), outcome(tmp_path / "killed", algo))


@pytest.mark.slow
def test_a_run_that_is_interrupted_saves_and_leaves(tmp_path: Path) -> None:
    arguments = ["--run-dir", "a", "--checkpoint-freq", "400", "--eval-freq", "-1"]
    for sign, code in ((signal.SIGTERM, 128 + signal.SIGTERM), (signal.SIGINT, 128 + signal.SIGINT)):
        before = max(steps(tmp_path / "a"), default=0)
        process = start(tmp_path, *arguments, "-n", "1000000", "-params", *OFF_POLICY)
        until = time.monotonic() + 120
        while max(steps(tmp_path / "a"), default=0) < before + 800 and time.monotonic() < until:
            time.sleep(0.01)
        process.send_signal(sign)
        # The zoo saves the model after a KeyboardInterrupt.
        assert process.wait(60) == code
        assert max(steps(tmp_path / "a")) % 400 != 0 or before > 0
        assert (tmp_path / "a/Pendulum-v1.zip").exists() == (sign == signal.SIGINT)
