"""The project's own evidence: which run is next, under which commit, and what is written of it."""

import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")

from sb3_sample import study

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

    lines = said(evidence(checkout))

    assert [line.split(": commit ")[1][:12] for line in lines if line.startswith("began")] == [first[:12], second[:12]]
    assert [(record["run"]["seed"], record["commit"]) for record in results(checkout)] == [(0, first), (1, second)]
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
