"""A study whose runs a Ray cluster makes, of which a machine is lost, beside one that nobody disturbs."""

import dataclasses
import os
import queue
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from sb3_sample import cli, study
from sb3_sample.study import cluster, schedule
from sb3_sample.study.runs import StudyFolder
from tests.study import nothing, test_kill
from tests.study.test_kill import ROOT, outcome, settled

#: Long enough that a machine is lost in the midst of it.
PLAN = test_kill.PLAN.replace("steps: 1_500", "steps: 2_500")
MEMORY = {"object_store_memory": 100_000_000}


def test_arguments_of_a_cluster_are_checked_at_the_door(tmp_path: Path, monkeypatch, capsys) -> None:
    plan = nothing.plan(1)
    with pytest.raises(ValueError, match=r"gpus is for runs in a Ray cluster: .* not gpus=0.5 alone"):
        study.run(plan, tmp_path / "a", gpus=0.5)
    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"ray='local' needs Ray. Install it with: pip install -e \".\[cluster\]\""):
        study.run(plan, tmp_path / "a", ray="local")
    path = tmp_path / "plan.yml"
    path.write_text(PLAN)
    for options, words in (
        (["--ray", "auto"], 'needs Ray. Install it with: pip install -e ".[cluster]"'),
        (["--gpus", "0.5"], "give --ray too, not --gpus 0.5 alone"),
    ):
        with pytest.raises(SystemExit) as caught:
            cli.main(["study", "run", str(path), "--folder", str(tmp_path / "a"), *options])
        assert caught.value.code == 2
        said = capsys.readouterr().err
        assert said.startswith("sb3-sample study run: ") and words in said
    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: name)
    for wrong in (0, 1.5, -1):
        with pytest.raises(ValueError, match=f"gpus must be above 0, and whole above 1, or None, not {wrong}"):
            study.run(plan, tmp_path / "a", ray="local", gpus=wrong)
    with pytest.raises(ValueError, match="ray must be 'local', 'auto' or a cluster's address, not ''"):
        study.run(plan, tmp_path / "a", ray="")
    with pytest.raises(SystemExit):
        cli.main(["study", "run", str(path), "--dry-run", "--ray", "local"])
    assert "--dry-run measures this machine" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_a_machine_that_does_not_see_the_folder_says_so(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="must be one that all machines of the cluster have"):
        cluster.make(str(tmp_path / "elsewhere"), [nothing.plan(1).runs[0].as_json()], [], 1)
    assert not (tmp_path / "elsewhere").exists()


def test_data_sets_are_those_of_where_the_command_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process of Ray's has another working directory."""
    (tmp_path / "data" / "pendulum").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    (run,) = nothing.plan(1).runs
    orders = []

    class Task:
        def remote(self, folder: str, runs: list[dict[str, Any]], *_: Any) -> None:
            orders.append(runs[0]["data"])

    slot = cluster.Slot(Task(), "folder", queue.Queue())
    monkeypatch.setattr(slot, "_listen", lambda order: None)
    data = {"dataset": "data/pendulum", "prior_data": "other.hdf5", "offline_steps": 5}
    for given in (data, {"dataset": "D4RL/pen/human-v2", "prior_data": "~/x.h5"}):
        slot.give((dataclasses.replace(run, data=given),), [], 1)
    slot.wait()
    assert orders == [
        {"dataset": f"{tmp_path}/data/pendulum", "prior_data": f"{tmp_path}/other.hdf5", "offline_steps": 5},
        {"dataset": "D4RL/pen/human-v2", "prior_data": "~/x.h5"},
    ]
    assert slot.runs[0].data["dataset"] == "D4RL/pen/human-v2"


def test_as_many_runs_at_once_as_the_machines_have_room_for(tmp_path: Path, monkeypatch) -> None:
    there = [{"CPU": 5.0, "GPU": 1.0}, {"CPU": 16.0, "GPU": 0.0}, {"CPU": 3.0, "GPU": 2.0}, {"CPU": 1.0, "GPU": 4.0}]
    monkeypatch.setattr(cluster, "_machines", lambda: there)
    monkeypatch.setattr(cluster, "LOOK_EVERY", -1.0)
    assert cluster.Cluster("auto", tmp_path, None, 2, None).slots() == 2 + 8 + 1
    shares = cluster.Cluster("auto", tmp_path, None, 1, 0.25)
    assert shares.slots() == 4 + 0 + 3 + 1
    assert cluster.Cluster("auto", tmp_path, None, 1, 2.0).slots() == 0 + 0 + 1 + 1
    assert cluster.Cluster("auto", tmp_path, 7, 1, 2.0).slots() == 7
    del there[0]
    assert shares.slots() == 4


class Shrinking(schedule.Processes):
    """Three places, of which one is left as soon as a run has ended."""

    def slots(self) -> int:
        made = Path(self._command[-1]) / "made.txt"
        return 1 if made.exists() and "end" in made.read_text() else 3


@pytest.mark.slow
def test_fewer_runs_at_once_when_there_is_less_room(tmp_path: Path) -> None:
    plan, folder = nothing.plan(8, sleep=0.3), StudyFolder(tmp_path)
    folder.enter(plan)
    crew = Shrinking([*nothing.COMMAND, str(tmp_path)], 3, 1)
    scheduler = schedule.Scheduler(plan.runs, folder, crew, 0, 1, "cpu", lambda _: None)
    assert scheduler.run().counts["done"] == 8
    lines = (tmp_path / "made.txt").read_text().splitlines()
    open_runs, most = 0, []
    for line in lines:
        open_runs += 1 if line.startswith("begin") else -1
        most.append(open_runs)
    # The three that were under way end; after that there is one at a time.
    assert max(most[6:]) == 1 and len(lines) == 16


@pytest.fixture(scope="module")
def machines() -> Iterator[object]:
    pytest.importorskip("ray", reason='Ray is not installed (pip install -e ".[cluster]")')
    from ray.cluster_utils import Cluster

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    found = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False, **MEMORY})
    yield found
    found.shutdown()


def start(plan: Path, folder: Path, address: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "sb3_sample.cli", "study", "run", str(plan), "--folder", str(folder)]
    return subprocess.Popen(
        [*command, "--device", "cpu", "--retries", "0", "--ray", address],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def checkpointed(folder: Path, seed: int, steps: int, scheduler: "subprocess.Popen[str]") -> int:
    """The process that makes a run, as soon as that has a checkpoint, and before its end."""
    run, end = folder / f"runs/SAC/Pendulum-v1/{seed}", time.monotonic() + 400
    while not (run / f"checkpoint-{steps:012d}").exists():
        assert scheduler.poll() is None, scheduler.communicate()[0]
        assert time.monotonic() < end
        time.sleep(0.005)
    assert not (run / "Pendulum-v1.zip").exists()
    return int((folder / f"state/SAC/Pendulum-v1/{seed}.lock").read_text().split()[-1])


def newest(folder: Path, seed: int) -> int:
    return max(int(path.name[11:]) for path in (folder / f"runs/SAC/Pendulum-v1/{seed}").glob("checkpoint-0*"))


@pytest.mark.slow
def test_a_study_whose_cluster_loses_machines_ends_where_an_undisturbed_one_does(tmp_path: Path, machines) -> None:
    plan, whole, disturbed = tmp_path / "plan.yml", tmp_path / "whole", tmp_path / "disturbed"
    plan.write_text(PLAN)
    assert study.run(plan, whole, workers=1, device="cpu").counts["done"] == 2

    # Two machines make a run each, and one is lost: without a retry, since the run is none the worse.
    second = machines.add_node(num_cpus=1, **MEMORY)
    scheduler = start(plan, disturbed, machines.address)
    processes = {seed: checkpointed(disturbed, seed, 300, scheduler) for seed in (3, 4)}
    assert study.status(disturbed).counts["running"] == 2
    machines.remove_node(second, allow_graceful=False)
    # Then the process that goes on with the lost run dies with the scheduler.
    lost = first_to_end(processes)
    other = 7 - lost
    while newest(disturbed, other) < 1_200:
        assert scheduler.poll() is None
        time.sleep(0.01)
    scheduler.kill()
    scheduler.wait()
    settled(disturbed)
    # Ctrl-C: a training under way finishes its turn and saves.
    scheduler = start(plan, disturbed, machines.address)
    process = checkpointed(disturbed, lost, 900, scheduler)
    said_before = (disturbed / f"state/SAC/Pendulum-v1/{lost}.txt").read_text()
    scheduler.send_signal(signal.SIGINT)
    said = scheduler.communicate(timeout=200)[0]
    assert scheduler.returncode == 130 and "the same command goes on" in said
    assert process not in processes.values()
    found = study.status(disturbed)
    assert not found.counts["running"] and not found.failures
    printed = (disturbed / f"state/SAC/Pendulum-v1/{lost}.txt").read_text().removeprefix(said_before)
    assert "finishing the turn" in printed and "saved at" in printed

    scheduler = start(plan, disturbed, machines.address)
    said = scheduler.communicate(timeout=500)[0]
    assert scheduler.returncode == 0 and "2 done, 0 running, 0 failed, 0 waiting" in said, said
    assert [each.outcome.attempts for each in study.status(disturbed).runs] == [0, 0]
    for seed in (3, 4):
        mine, undisturbed = dict(outcome(disturbed, seed)), dict(outcome(whole, seed))
        assert undisturbed.keys() == mine.keys() and undisturbed["steps"] == 2500
        assert [name for name in undisturbed if not np.array_equal(undisturbed[name], mine[name])] == []


def first_to_end(processes: dict[int, int]) -> int:
    end = time.monotonic() + 100
    while time.monotonic() < end:
        for seed, process in processes.items():
            try:
                os.kill(process, 0)
            except ProcessLookupError:
                return seed
        time.sleep(0.05)
    raise AssertionError("no process has ended")
