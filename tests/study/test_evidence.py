"""The project's own evidence: which run is next, under which commit, and what is written of it."""

import fcntl
import importlib.util
import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")

from sb3_sample import study
from sb3_sample.study.runs import StudyFolder
from tests.study.made_up import write_run

ROOT = Path(__file__).parents[2]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (ROOT / ".git").exists(), reason="the files are no git checkout"),
]
PLAN = """
agents:
  SAC: {algo: sac_sample, learning_starts: 400}
tasks: [Pendulum-v1]
seeds: [0, 1]
steps: 600
evaluation: {every: 200, episodes: 1}
checkpoint_freq: 100
"""


def git(checkout: Path, *words: str) -> str:
    command = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", *words]
    return subprocess.run(command, cwd=checkout, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A repository with the files of this checkout, as they are now, and a small plan."""
    place = tmp_path / "checkout"
    place.mkdir()
    git(place, "init", "-q")
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        if name.startswith(("sb3_sample/", "studies/", "hyperparams/", "setup")) and (ROOT / name).exists():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, place / name)
    for each in (place / "studies" / "evidence").iterdir():
        each.unlink()
    (place / "studies" / "evidence" / "small.yml").write_text(PLAN)
    (place / "studies" / "evidence" / "small.py").write_text(
        f"def main(argv):\n    open({str(tmp_path / 'prepared')!r}, 'a').write('x')\n"
    )
    (place / "studies" / "evidence" / "QUEUE").write_text("# plan, seeds\nsmall 1\nsmall 2\n")
    git(place, "add", "-A")
    git(place, "commit", "-qm", "first")
    return place


def evidence(checkout: Path, *words: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "studies/evidence.py", "--root", str(checkout.parent / "root"), "--python"]
    return subprocess.Popen([*command, sys.executable, *words], cwd=checkout, text=True, stdout=subprocess.PIPE)


def said(process: "subprocess.Popen[str]") -> list[str]:
    output, _ = process.communicate(timeout=500)
    assert process.returncode == 0
    return output.splitlines()


def results(checkout: Path) -> list[dict[str, object]]:
    path = checkout / "docs" / "evidence" / "small.json"
    return json.loads(path.read_text()) if path.exists() else []


def test_a_killed_run_goes_on_under_its_commit_and_new_ones_have_the_last(checkout: Path) -> None:
    first = git(checkout, "rev-parse", "HEAD")
    process = evidence(checkout)
    place = checkout.parent / "root" / "studies" / "small" / first / "runs" / "SAC" / "Pendulum-v1" / "0"
    until = time.monotonic() + 300
    while not list(place.glob("checkpoint-*")):
        assert time.monotonic() < until and process.poll() is None
        time.sleep(0.1)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    # The run's own process notices, saves and ends.
    while study.status(place.parents[3]).counts["running"]:
        assert time.monotonic() < until
        time.sleep(0.1)
    assert not results(checkout)
    (checkout / "sb3_sample" / "marker.py").write_text("")
    git(checkout, "add", "-A")
    git(checkout, "commit", "-qm", "second")
    second = git(checkout, "rev-parse", "HEAD")
    # What is being edited is not what runs.
    (checkout / "sb3_sample" / "__init__.py").write_text("raise RuntimeError('half an edit')")

    lines = said(evidence(checkout, "--threads", "2"))

    assert [line.split(": commit ")[1][:12] for line in lines if line.startswith("began")] == [first[:12], second[:12]]
    assert [(record["run"]["seed"], record["commit"]) for record in results(checkout)] == [(0, first), (1, second)]
    assert [record["threads"] for record in results(checkout)] == [2, 2]
    table = study.read(checkout / "docs" / "evidence" / "small.csv")
    evaluations = table[table["metric"] == "return"]
    assert set(evaluations["agent"]) == {"SAC"} and set(evaluations["task"]) == {"Pendulum-v1"}
    assert list(zip(evaluations["seed"], evaluations["step"], strict=True)) == [
        (seed, step) for seed in (0, 1) for step in (200, 400, 600)
    ]
    assert (table["metric"] == "hours").sum() == 6

    # What a run reads is made before it, by the killed one's process, its successor's and the other seed's.
    assert (checkout.parent / "prepared").read_text() == "xxx"

    # What is written down is not made again, also where the folder of the evidence is another machine's.
    shutil.rmtree(checkout.parent / "root")
    git(checkout, "worktree", "prune")
    assert said(evidence(checkout)) == []
    # A plan that says something else is another run.
    git(checkout, "checkout", "-q", "--", "sb3_sample")
    plan = checkout / "studies" / "evidence" / "small.yml"
    plan.write_text(PLAN.replace("learning_starts: 400", "learning_starts: 450"))
    git(checkout, "commit", "-qam", "third")
    (began,) = (line for line in said(evidence(checkout, "--most", "1")) if line.startswith("began"))
    assert git(checkout, "rev-parse", "HEAD")[:12] in began and len(results(checkout)) == 3


def test_a_run_that_fails_is_tried_twice_and_named(checkout: Path, capfd: pytest.CaptureFixture[str]) -> None:
    environment = checkout / "sb3_sample" / "study" / "worker.py"
    environment.write_text(
        environment.read_text().replace("    zoo.register()\n", '    zoo.register()\n    raise OSError(28, "full")\n')
    )
    git(checkout, "commit", "-qam", "fails")
    process = evidence(checkout, "--workers", "2")
    output, _ = process.communicate(timeout=500)
    assert process.returncode == 1 and output.count("began") == 4 and "done" not in output
    errors = capfd.readouterr().err
    assert "full" in errors and "failed: small/SAC/Pendulum-v1/0, small/SAC/Pendulum-v1/1" in errors
    assert not results(checkout)


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The program as a module, with a small plan of one seed in the place of the plans."""
    spec = importlib.util.spec_from_file_location("evidence", ROOT / "studies" / "evidence.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    plans = tmp_path / "plans"
    plans.mkdir()
    (plans / "small.yml").write_text(PLAN)
    (plans / "QUEUE").write_text("small 2\n")
    monkeypatch.setattr(module, "PLANS", plans)
    monkeypatch.setattr(module, "is_at_hand", lambda root, commit: True)
    (tmp_path / "root").mkdir()
    return module


def make_done(program: Any, root: Path, run: study.Run, commit: str = "abc") -> None:
    folder = StudyFolder(root / "studies" / "small" / commit)
    folder.enter(study.Plan("small", (run,)), keep=True)
    write_run(folder.place(run), run.task, run.algo, run.seed, (200, 400, 600))
    with folder.claim(run):
        folder.write_outcome(run, study.Outcome(True, steps=run.steps))


def test_results_are_whole_after_a_kill_between_their_files(
    program: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, results = tmp_path / "root", tmp_path / "results"
    first, second = program.plan_of("small").runs
    make_done(program, root, first)
    program.collect(root, results)
    table, records = ((results / f"small.{ending}").read_bytes() for ending in ("csv", "json"))
    make_done(program, root, second)

    def collect_killed(n: int) -> None:
        """Collect, and be killed when the n-th file would take its place."""
        replace, left = os.replace, [None] * (n - 1)

        def replace_some(*paths: Any) -> None:
            if not left:
                raise KeyboardInterrupt
            left.pop()
            replace(*paths)

        with monkeypatch.context() as patch:
            patch.setattr("sb3_sample.saving.temporary.os.replace", replace_some)
            with pytest.raises(KeyboardInterrupt):
                program.collect(root, results)

    # In the midst of the first file: both are as they were.
    collect_killed(1)
    assert [(results / f"small.{ending}").read_bytes() for ending in ("csv", "json")] == [table, records]
    # Between the two: the run comes to the table once.
    collect_killed(2)
    assert (results / "small.csv").read_bytes() != table and (results / "small.json").read_bytes() == records
    program.collect(root, results)
    assert [record["run"]["seed"] for record in program.recorded(results, "small")] == [0, 1]
    found = study.read(results / "small.csv", ["return"])
    evaluations = found[found["metric"] == "return"]
    assert list(zip(evaluations["seed"], evaluations["step"], strict=True)) == [
        (seed, step) for seed in (0, 1) for step in (200, 400, 600)
    ]


def test_what_is_recorded_of_a_run_has_the_versions_of_its_checkpoint(program: Any, tmp_path: Path) -> None:
    root, results = tmp_path / "root", tmp_path / "results"
    first, second = program.plan_of("small").runs
    make_done(program, root, first)
    make_done(program, root, second)
    checkpoint = StudyFolder(root / "studies" / "small" / "abc").place(first) / "checkpoint-000000000600"
    checkpoint.mkdir()
    versions = {"torch": "2.0", "numpy": "1.26", "commit": "abc-dirty", "device": "cpu"}
    (checkpoint / "manifest.json").write_text(json.dumps({"circumstances": versions}))
    program.collect(root, results)
    records = {record["run"]["seed"]: record for record in program.recorded(results, "small")}
    assert (records[0]["torch"], records[0]["numpy"], records[0]["device"]) == ("2.0", "1.26", "cpu")
    assert records[0]["commit"] == "abc" and records[0]["threads"] == 1
    # Whose checkpoint says nothing.
    assert "torch" not in records[1] and records[1]["commit"] == "abc"


def test_a_folder_that_a_killed_process_has_begun_is_passed_over(program: Any, tmp_path: Path) -> None:
    root = tmp_path / "root"
    run, _ = program.plan_of("small").runs
    make_done(program, root, run)
    (root / "studies" / "small" / "abd" / "runs").mkdir(parents=True)
    assert program.found(root, "small", run).commit == "abc"


def test_no_two_processes_write_results_at_once(
    program: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "root"
    locked = []

    def is_locked(*_: Any) -> None:
        with (root / ".lock").open("w") as file, pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        locked.append(True)

    monkeypatch.setattr(program, "collect", is_locked)
    monkeypatch.setattr(program, "choose", is_locked)
    monkeypatch.setattr(sys, "argv", ["evidence.py", "next", str(root), str(tmp_path / "results")])
    program.main()
    assert locked == [True, True] and capsys.readouterr().out == "null\n"


def test_bad_numbers_are_refused(checkout: Path) -> None:
    process = evidence(checkout, "--workers", "0")
    process.communicate()
    assert process.returncode == 2 and not os.path.exists(checkout.parent / "root" / "trees")


def test_every_plan_of_the_queue_is_there() -> None:
    module = runpy.run_path(str(ROOT / "studies" / "evidence.py"))
    names = [name for name, _ in module["queue"]()]
    assert {"bro_fast", "scaling"} <= set(names)
    for name in names:
        assert module["plan_file"](name).is_file(), name
    assert module["plan_file"]("scaling") == ROOT / "studies" / "small" / "scaling.yml"
