"""The scheduler and its processes, with an agent that does nothing on a task that does nothing."""

import ast
import dataclasses
import io
import json
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from sb3_sample import cli, study
from sb3_sample.study import command
from sb3_sample.study.plan import Plan, Run
from sb3_sample.study.runs import Outcome, Progress, StudyFolder
from sb3_sample.study.schedule import _batches
from sb3_sample.study.states import RunStatus, Status
from sb3_sample.study.worker import attempt
from tests.study import nothing

ROOT = Path(__file__).parents[2]
#: The most that a run may cost. What is opened with Python's "opener" is heard twice, and three
#: that the worker's files cost are lines of the test's own.
SCHEDULER = {"opened": 2}
WORKER = {"opened": 11, "fcntl.flock": 2, "os.listdir": 2}


def run(plan: Plan, folder: Path, **kwargs) -> study.Status:
    return study.run(plan, folder, worker=nothing.COMMAND, **{"workers": 1, **kwargs})


def made(folder: Path) -> list[str]:
    return (folder / "made.txt").read_text().splitlines()


@pytest.mark.slow
def test_each_run_is_made_once_and_not_again(tmp_path: Path) -> None:
    plan = nothing.plan(4)
    found = run(plan, tmp_path)
    assert found.counts == {"done": 4, "running": 0, "failed": 0, "waiting": 0}
    # In their order, by one process.
    assert made(tmp_path) == [f"{word} {each.name}" for each in plan.runs for word in ("begin", "end")]
    hosts = {(tmp_path / "state/Nothing/nothing-v0" / f"{i}.lock").read_text() for i in range(4)}
    assert len(hosts) == 1
    assert run(plan, tmp_path).counts["done"] == 4
    assert len(made(tmp_path)) == 8
    # One whose folder was removed is made again, and so is one that shall have more steps.
    (tmp_path / "runs/Nothing/nothing-v0/2").rmdir()
    more = Plan(plan.name, (dataclasses.replace(plan.runs[0], steps=2), *plan.runs[1:]))
    assert run(more, tmp_path).counts["done"] == 4
    assert sorted(made(tmp_path)[8:]) == sorted(f"{w} Nothing/nothing-v0/{i}" for i in (0, 2) for w in ("begin", "end"))


def test_a_run_that_fails_is_tried_again_and_named_and_the_others_go_on(tmp_path: Path, capsys) -> None:
    failing = nothing.plan(1, fail=2).runs[0]
    plan = Plan("mixed", (failing, *nothing.plan(4).runs[1:]))
    found = run(plan, tmp_path, retries=1)
    assert found.counts == {"done": 3, "running": 0, "failed": 1, "waiting": 0}
    assert list(found.failures) == [failing.title]
    assert "RuntimeError: nothing comes of seed 0" in found.failures[failing.title]
    assert found.of("failed")[0].outcome.attempts == 2
    assert "failed after 2 attempts: Nothing on nothing-v0, seed 0" in str(found)
    assert study.status(tmp_path).failures == found.failures
    cli.main(["study", "status", str(tmp_path)])
    said = capsys.readouterr().out
    assert said.splitlines()[1].split() == ["Nothing", "3", "0", "1", "0"]
    assert "RuntimeError: nothing comes of seed 0" in said
    assert (tmp_path / "state/Nothing/nothing-v0/0.txt").read_text().count("nothing comes of seed 0") == 2
    # The same command tries it again, and the third attempt succeeds.
    assert run(plan, tmp_path, retries=0).counts["done"] == 4


@pytest.mark.slow
def test_a_process_that_dies_is_replaced(tmp_path: Path) -> None:
    plan = Plan("mixed", (*nothing.plan(1, die=2).runs, *nothing.plan(3).runs[1:]))
    found = run(plan, tmp_path, retries=1)
    assert found.counts["failed"] == 1 and found.counts["done"] == 2
    assert found.failures[plan.runs[0].title] == "the process that made the run was ended by SIGKILL"
    assert run(plan, tmp_path, retries=0).counts["done"] == 3


@pytest.mark.slow
def test_a_process_that_dies_while_it_answers_has_ended(tmp_path: Path) -> None:
    code = "import os; input(); os.write(1, b'[{\"done\": fal'); os.kill(os.getpid(), 9)"
    plan = nothing.plan(1)
    found = study.run(plan, tmp_path, workers=1, retries=0, worker=[sys.executable, "-S", "-c", code])
    assert found.failures == {plan.runs[0].title: "the process that made the run was ended by SIGKILL"}


@pytest.mark.slow
def test_two_schedulers_on_one_folder_share_the_runs(tmp_path: Path) -> None:
    program = (
        "import sys; from sb3_sample import study; from tests.study import nothing\n"
        "print(study.run(nothing.plan(40, sleep=0.05), sys.argv[1], workers=1, worker=nothing.COMMAND).counts)"
    )
    both = [
        subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    for each in both:
        assert ast.literal_eval(each.communicate(timeout=300)[0])["done"] == 40
    assert Counter(made(tmp_path)) == Counter(
        f"{w} Nothing/nothing-v0/{i}" for i in range(40) for w in ("begin", "end")
    )


@pytest.mark.slow
def test_a_claimed_run_is_waited_for_and_taken_when_its_process_is_gone(tmp_path: Path, monkeypatch) -> None:
    from sb3_sample.study import schedule

    monkeypatch.setattr(schedule, "ELSEWHERE", 0.1)
    plan, folder = nothing.plan(2), StudyFolder(tmp_path)
    folder.enter(plan)
    other = subprocess.Popen(
        [sys.executable, "-c", "import sys; from sb3_sample.saving.locks import take; from pathlib import Path\n"
         "lock = take(Path(sys.argv[1])); print(lock is not None, flush=True); sys.stdin.read()",
         str(_made_place(folder, plan))],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip
    assert other.stdout is not None and other.stdout.readline() == "True\n"
    assert [each.state for each in study.status(tmp_path).runs] == ["running", "waiting"]
    seen = []

    def show(found: study.Status) -> None:
        seen.append([each.state for each in found.runs])
        if seen[-1] == ["running", "done"] and other.poll() is None:
            assert made(tmp_path) == ["begin Nothing/nothing-v0/1", "end Nothing/nothing-v0/1"]
            other.kill()
            other.wait()

    assert run(plan, tmp_path, show=show).counts["done"] == 2
    assert ["running", "done"] in seen


def _made_place(folder: StudyFolder, plan: Plan) -> Path:
    lock = folder.claim(plan.runs[0])
    assert lock is not None
    lock.release()
    return folder.path / "state/Nothing/nothing-v0/0.lock"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_processes_end_with_the_scheduler_and_the_same_command_goes_on(tmp_path: Path, number: int) -> None:
    program = (
        "import sys; from sb3_sample import study; from tests.study import nothing\n"
        "study.run(nothing.plan(3, sleep=600), sys.argv[1], workers=1, worker=nothing.COMMAND)"
    )
    scheduler = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], cwd=ROOT, stderr=subprocess.DEVNULL)
    wait_for(lambda: (tmp_path / "made.txt").exists() and made(tmp_path))
    assert study.status(tmp_path).counts["running"] == 1
    scheduler.send_signal(number)
    assert scheduler.wait(timeout=60) != 0
    # The process has let go of it: it has ended.
    wait_for(lambda: study.status(tmp_path).counts["running"] == 0)
    assert study.status(tmp_path).counts == {"done": 0, "running": 0, "failed": 0, "waiting": 3}
    assert made(tmp_path) == ["begin Nothing/nothing-v0/0"]


def wait_for(what, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_other_settings_in_a_folder_are_refused(tmp_path: Path) -> None:
    run(nothing.plan(1), tmp_path)
    before = (tmp_path / "study.json").read_text()
    with pytest.raises(
        study.StudyError,
        match=r"Nothing on nothing-v0, seed 0, with arguments \{\}, and the plan now says \{'sleep': 0\}",
    ):
        run(nothing.plan(2, sleep=0), tmp_path)
    assert (tmp_path / "study.json").read_text() == before
    with pytest.raises(ValueError, match="workers must be an integer of at least 1, or None, not 0"):
        run(nothing.plan(1), tmp_path, workers=0)
    with pytest.raises(study.StudyError, match=r"^\S+ is no folder of sb3-sample study run: it has no study.json$"):
        study.status(tmp_path / "runs")


def test_lines_and_the_live_table(tmp_path: Path, capsys) -> None:
    console = pytest.importorskip("rich.console")
    plan, folder = nothing.plan(30), StudyFolder(tmp_path)
    folder.enter(plan)
    done = Outcome(True, steps=1, steps_made=1, seconds=10.0, last_return=-3.25, finished=5.0)
    states = [RunStatus(plan.runs[0], "done", done), RunStatus(plan.runs[1], "failed", Outcome(False, 1, "why"))]
    states += [RunStatus(each, "running", Outcome(False)) for each in plan.runs[2:27]]
    states += [RunStatus(each, "waiting", Outcome(False)) for each in plan.runs[27:]]
    found = Status(folder, states, states[:2])
    # 28 runs of one step, each of 10 seconds, 25 at once.
    line = (
        "1 done, 25 running, 1 failed, 3 waiting, last return -3.2 (Nothing on nothing-v0, seed 0), about 0:00:11 left"
    )
    assert found.line() == line
    drawn = console.Console(record=True, width=150, file=io.StringIO())
    drawn.print(command.table(found))
    text = " ".join(drawn.export_text().split())
    assert line in text and "and 5 more" in text and "nothing-v0" in text
    lines = command._Lines()
    lines(found)
    said = "done: Nothing on nothing-v0, seed 0, last return -3.2\nfailed: Nothing on nothing-v0, seed 1\n"
    assert capsys.readouterr().out == said


def test_the_time_left_while_no_run_is_done(tmp_path: Path) -> None:
    plan, folder = nothing.plan(3), StudyFolder(tmp_path)
    runs = [dataclasses.replace(run, steps=1_000) for run in plan.runs]
    folder.enter(plan._replace(runs=tuple(runs)))
    found = Status(
        folder,
        [
            RunStatus(run, state, Outcome(False))
            for run, state in zip(runs, ("running", "running", "waiting"), strict=True)
        ],
    )
    assert "left" not in found.line()
    folder.place(runs[0]).mkdir(parents=True)
    lines = [
        {"step": 200, "time/total_timesteps": 200, "time/time_elapsed": 50},
        {"step": 250, "time/total_timesteps": 250},
    ]
    (folder.place(runs[0]) / "progress.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    # 750, 1,000 and 1,000 steps of a quarter of a second each, two runs at once.
    assert folder.progress(runs[0]) == (250, None, 200, 50)
    assert found.line().endswith("about 0:05:44 left")


@pytest.mark.slow
def test_the_work_for_a_run_does_not_grow_with_the_number_of_runs(tmp_path: Path) -> None:
    """Files opened and locks taken, by the scheduler and by the process that makes the runs."""
    counts = {}
    for number in (10, 40):
        folder = tmp_path / str(number)
        own = nothing.count_work(folder)
        run(nothing.plan(number), folder)
        worker = Counter(ast.literal_eval((folder / "work.txt").read_text().splitlines()[-1]))
        counts[number] = {"scheduler": own.copy(), "worker": worker}
        assert own.total() > number
    for who, most in (("scheduler", SCHEDULER), ("worker", WORKER)):
        more = counts[40][who] - counts[10][who]
        for what, number in more.items():
            assert number <= 30 * most.get(what, 0), (who, what, number)
        assert more["opened"] > 0


def test_the_time_left_of_runs_that_learn_from_data_first(tmp_path: Path) -> None:
    """Its two logs have a clock each; the steps of the second begin where the first ends."""
    data = {"dataset": "d", "offline_steps": 500}
    runs = tuple(Run("I", "iql", {}, {}, "Pendulum-v1", seed, 1_000, data=data) for seed in (0, 1))
    folder = StudyFolder(tmp_path)
    folder.enter(Plan("o", runs))
    states = zip(runs, ("running", "waiting"), strict=True)
    found = Status(folder, [RunStatus(each, state, Outcome(False)) for each, state in states])
    place = folder.place(runs[0])
    (place / "offline").mkdir(parents=True)

    def log(path: Path, steps: int, seconds: float) -> None:
        path.write_text(json.dumps({"time/total_timesteps": steps, "time/time_elapsed": seconds}) + "\n")

    log(place / "offline" / "progress.jsonl", 250, 100.0)
    assert folder.progress(runs[0]) == Progress(250, None, 250, 100.0)
    log(place / "offline" / "progress.jsonl", 500, 200.0)
    log(place / "progress.jsonl", 800, 40.0)
    assert folder.progress(runs[0]) == Progress(800, None, 800, 240.0)
    assert found.seconds_left(found.progress()) == pytest.approx(1_200 * 0.3)


def test_the_time_left_of_runs_that_are_to_have_more_steps(tmp_path: Path) -> None:
    few, more = nothing.plan(2), [dataclasses.replace(each, steps=4) for each in nothing.plan(2).runs]
    folder = StudyFolder(tmp_path)
    folder.enter(few)
    for each in few.runs:
        folder.place(each).mkdir(parents=True)
        folder.claim(each)
        folder.write_outcome(each, Outcome(True, steps=each.steps, steps_made=each.steps, seconds=10.0))
    log = json.dumps({"time/total_timesteps": 1, "time/time_elapsed": 10.0}) + "\n"
    (folder.place(few.runs[0]) / "progress.jsonl").write_text(log)
    states = zip(more, ("running", "waiting"), strict=True)
    found = Status(folder, [RunStatus(each, state, folder.outcome(each)) for each, state in states])
    # Three steps of each, at ten seconds a step.
    assert found.seconds_left(found.progress()) == pytest.approx(60)


def test_a_run_whose_next_attempt_was_interrupted_waits(tmp_path: Path) -> None:
    (only,) = nothing.plan(1).runs
    folder = StudyFolder(tmp_path)
    folder.enter(Plan("one", (only,)))

    def ends(error: BaseException):
        def make(*_) -> None:
            raise error

        return make

    attempt(folder, only, [], 1, ends(RuntimeError("nothing comes of it")))
    assert study.status(tmp_path).counts["failed"] == 1
    with pytest.raises(KeyboardInterrupt):
        attempt(folder, only, [], 1, ends(KeyboardInterrupt()))
    found = study.status(tmp_path)
    assert (found.counts["failed"], found.counts["waiting"]) == (0, 1) and found.runs[0].outcome.attempts == 1


def test_seeds_that_learn_from_data_are_made_one_by_one() -> None:
    seeds = [Run("I", "iql", {}, {}, "Pendulum-v1", seed, 1_000, data={"dataset": "d"}) for seed in (0, 1)]
    assert _batches(seeds) == [(seeds[0],), (seeds[1],)]
    assert _batches([dataclasses.replace(each, data={}) for each in seeds])[0][1].seed == 1


def test_a_folder_that_cannot_be_one_is_refused_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = "agents: {SAC: {algo: sac_sample}}\ntasks: [Pendulum-v1]\nseeds: [0]\nsteps: 25_000\n"
    (tmp_path / "plan.yml").write_text(plan)
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit):
        cli.main(["study", "run", str(tmp_path / "plan.yml"), "--folder", str(tmp_path / "file")])
    assert "sb3-sample study run: " in (said := capsys.readouterr().err) and "Traceback" not in said
    with pytest.raises(SystemExit):
        cli.main(["study", "run", str(tmp_path / "plan.yml"), "--folder", str(tmp_path / "new"), "--device", "gpu"])
    assert "study run: device must be 'auto', 'cpu', 'cuda' or another of torch's, not 'gpu'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
