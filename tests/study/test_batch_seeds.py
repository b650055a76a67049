"""Runs of a study that are made together, in one process."""

import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")

from sb3_sample import cli, study
from sb3_sample.saving.locks import take
from sb3_sample.study import cluster
from sb3_sample.study.plan import Plan, Run
from sb3_sample.study.plan_file import read_plan
from sb3_sample.study.runs import StudyFolder
from sb3_sample.study.schedule import _batches
from sb3_sample.study.worker import attempt_all
from tests.study import nothing
from tests.study.test_kill import PLAN, outcome
from tests.test_zoo_seeds import CALLBACK

ARGUMENTS = {"learning_starts": 20, "buffer_size": 500, "replay_ratio": 0.5, "policy_kwargs": {"net_arch": [8]}}


def runs(n: int, algo: str = "sac_sample", **arguments: Any) -> list[Run]:
    given = {**ARGUMENTS, **arguments}
    return [Run("A", algo, given, {}, "Pendulum-v1", seed, 120, 60, 1, 30) for seed in range(n)]


def same(ours: Any, theirs: Any) -> bool:
    return bool((ours == theirs).all()) if hasattr(ours, "all") else ours == theirs


def test_which_runs_are_made_together() -> None:
    sac, other, ppo = runs(3), runs(2, gamma=0.9), runs(2, "mbma")
    mixed = [sac[0], ppo[0], other[0], sac[1], other[1], ppo[1], sac[2]]
    assert _batches(mixed) == [tuple(sac), (ppo[0],), tuple(other), (ppo[1],)]


@pytest.mark.slow
def test_what_cannot_be_made_together_is_made_one_by_one(tmp_path: Path) -> None:
    found = study.run(nothing.plan(3), tmp_path, worker=nothing.COMMAND, workers=1, batch_seeds=True)
    assert found.counts["done"] == 3


def test_each_run_has_its_own_outcome_output_and_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "called_back.py").write_text(CALLBACK)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("HOW", "error")
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    group = runs(4, callback="called_back.Callback")
    folder = StudyFolder(tmp_path / "study")
    folder.enter(Plan("study", tuple(group)))
    # Another process has the last one.
    (tmp_path / "study/state/A/Pendulum-v1").mkdir(parents=True)
    elsewhere = take(tmp_path / "study/state/A/Pendulum-v1/3.lock")
    assert elsewhere is not None
    options = ["--num-threads", "1", "--device", "cpu"]
    with capfd.disabled():
        streams = [os.fstat(stream.fileno()) for stream in (sys.stdout, sys.stderr)]
        found = attempt_all(folder, group, options, 1)
        # What the process prints then is none of the runs'.
        assert all(map(os.path.samestat, streams, (os.fstat(stream.fileno()) for stream in (sys.stdout, sys.stderr))))
    first, second, third, taken = found
    assert taken is None
    elsewhere.release()
    assert first is not None and second is not None and third is not None
    assert first.done and third.done and not second.done
    assert (first.steps, second.attempts, third.last_return is not None) == (120, 1, True)
    assert "LookupError: what was looked for" in second.traceback
    assert not any(folder.is_claimed(run) for run in group)
    for run in group[:3]:
        text = folder.output(run).read_text()
        assert f"Seed: {run.seed}\n" in text
        assert text.count("Seed: ") == 1
        assert ("LookupError" in text) == (run.seed == 1)
        assert ("Saving to" in text) == (run.seed != 1)
    monkeypatch.setenv("HOW", "")
    # As a task of a cluster, which answers to SIGTERM in its own way.
    before = signal.getsignal(signal.SIGTERM)
    with capfd.disabled():
        again = cluster.make(str(folder.path), [run.as_json() for run in group[:2]], options, 1)
    signal.signal(signal.SIGTERM, before)
    assert [each["done"] for each in again] == [True, True]
    assert again[0] == first._asdict()
    assert again[1]["steps_made"] == 50


def test_an_estimate_is_of_runs_that_are_made_one_by_one(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "plan.yml").write_text(PLAN)
    with pytest.raises(SystemExit):
        cli.main(["study", "run", str(tmp_path / "plan.yml"), "--dry-run", "--batch-seeds"])
    assert "--dry-run measures runs that are made one by one: leave --batch-seeds out" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("how", ["undisturbed", "killed", "a task of a cluster"])
def test_a_study_of_batches_is_that_of_single_runs(tmp_path: Path, how: str) -> None:
    shared: dict[str, Any] = {"workers": 1, "device": "cpu"}
    if how == "a task of a cluster":
        pytest.importorskip("ray")
        shared["ray"] = "local"
    (tmp_path / "plan.yml").write_text(PLAN)
    plan = read_plan(tmp_path / "plan.yml")
    study.run(plan, tmp_path / "single", workers=1, device="cpu")
    if how == "killed":
        threading.Thread(target=_kill, args=(tmp_path / "together",), daemon=True).start()
    found = study.run(plan, tmp_path / "together", batch_seeds=True, **shared)
    assert found.counts["done"] == 2
    assert [each.outcome.attempts for each in found.runs] == [int(how == "killed")] * 2
    hosts = {(tmp_path / f"together/state/SAC/Pendulum-v1/{seed}.lock").read_text() for seed in (3, 4)}
    assert len(hosts) == 1
    for seed in (3, 4):
        single, together = dict(outcome(tmp_path / "single", seed)), dict(outcome(tmp_path / "together", seed))
        assert single.keys() == together.keys()
        assert [name for name in single if not same(single[name], together[name])] == []


def _kill(folder: Path) -> None:
    """SIGKILL the process that makes the runs after one of their checkpoints."""
    lock = folder / "state/SAC/Pendulum-v1/4.lock"
    while not list(folder.glob("runs/SAC/Pendulum-v1/4/checkpoint-000000000600")):
        time.sleep(0.001)
    os.kill(int(lock.read_text().rpartition(" ")[2]), signal.SIGKILL)
