"""The report: what it says of made-up runs, of a study's folder and of the published seeds, and that it is safe."""

import contextlib
import dataclasses
import html
import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import matplotlib
import numpy as np
import pandas as pd
import pytest

from sb3_sample import cli, study
from sb3_sample.envs.scores import Score
from sb3_sample.plots import Curve, all_published_curves, published_curves
from sb3_sample.saving.training_state import commit, processor
from sb3_sample.study.plan import Plan, Run
from sb3_sample.study.reporting import facts as facts_module
from sb3_sample.study.reporting import figures, pieces, published, reading
from sb3_sample.study.reporting import planned as planned_runs
from sb3_sample.study.reporting.absent import missing
from sb3_sample.study.reporting.content import build
from sb3_sample.study.reporting.curves import _repeats as repeats_of
from sb3_sample.study.reporting.curves import task_curves
from sb3_sample.study.reporting.reading import gather
from sb3_sample.study.runs import Outcome, StudyFolder
from tests.study.made_up import made_up, write_evaluations, write_monitor, write_run
from tests.study.test_aggregate import TABLE_9

pytest.importorskip("rliable.library")
pytest.importorskip("jinja2")

ROOT = Path(__file__).parents[2]
CHEETAH, WALKER, PUSH, OWN = "dmc/cheetah-run-v0", "dmc/walker-run-v0", "metaworld/push-v3", "My/Task-v0"
LATER, LATEST = (25_000, 50_000), (50_000, 100_000)
EVIL = '<script>alert("x")</script>'


def runs(agent: str, task: str, ends: list[float], steps: tuple[int, ...] = (100, 200), **arguments: Any) -> list[Any]:
    """Rows of runs, a seed for each return at the end, which is half of it at half of the steps."""
    metric = "success_rate" if task == PUSH else "return"
    return [
        row
        for seed, end in enumerate(ends)
        for step in steps
        for row in (
            (agent, arguments, task, seed, step, metric, end * step / 200),
            (agent, arguments, task, seed, step, "hours", step / 100),
        )
    ]


def two_agents() -> pd.DataFrame:
    rows = runs("good", CHEETAH, [600, 700, 800]) + runs("good", WALKER, [500, 600, 700])
    return made_up(rows + runs("bad", CHEETAH, [100, 200, 300]) + runs("bad", WALKER, [200, 300, 400]))


def text_of(page: str) -> str:
    """A page's text, without tags and its script."""
    page = re.sub(r"<(script|style)>.*?</\1>", "", page, flags=re.DOTALL)
    return html.unescape(re.sub(r"<[^>]*>", " ", page))


def tables_of(page: str) -> dict[str, list[list[str]]]:
    """Cells of a page's tables by caption, the head first."""
    found = {}
    for table in re.findall(r"<table>(.*?)</table>", page, re.DOTALL):
        caption = html.unescape(re.search(r"<caption>(.*?)</caption>", table)[1])  # type: ignore[index]
        rows = [re.findall(r"<t[hd].*?>(.*?)</t[hd]>", row, re.DOTALL) for row in table.split("<tr>")[1:]]
        found[caption] = [[text_of(cell).strip() for cell in row] for row in rows]
    return found


def written(path: Path, *args: Any, drawn: bool = False, **kwargs: Any) -> str:
    """The page of a report. Drawing takes most of the time, so that panels are only named unless it is of them."""
    named = contextlib.nullcontext() if drawn else mock.patch.object(figures, "svg", _name)
    with named:
        study.report(*args, path=path, **{"reps": 20, "curves": [], **kwargs})
    return path.read_text()


def _name(panel: pieces.Lines | pieces.Dots, prefix: str) -> str:
    return f"<svg>{html.escape(panel.title)}</svg>"


# ---------------------------------------------------------------- content


def test_a_reader_sees_first_what_was_compared_who_wins_and_what_is_missing(tmp_path: Path) -> None:
    page = written(tmp_path / "r.html", two_agents(), title="Two agents", drawn=True)
    summary = text_of(page.partition("<section")[0])
    assert "good, bad." in summary and "2 tasks, 3 seeds each, up to 200 simulator steps." in summary
    assert "good is better than bad." in summary
    assert "A run of good beats one of bad on the same task with probability 1.000 (1.000" in summary
    # By hand: of 500, 600, 600, 700, 700, 800 the middle four, and of 100, 200, 200, 300, 300, 400.
    assert "at 200 steps over 2 tasks: good 0.650 (" in summary and "bad 0.250 (" in summary
    assert "Nothing." in summary
    rows = tables_of(page)["Averages by group of tasks"]
    assert rows[0][:4] == ["agent", "group", "step", "IQM"]
    # All tasks are of DeepMind Control: no group beside all of them.
    assert [row[:3] for row in rows[1:]] == [["good", "all", "200"], ["bad", "all", "200"]]
    direct = study.aggregate(two_agents(), [200], ["all"], reps=20).set_index("agent").loc["good"]
    assert rows[1][3] == f"{direct['iqm']:.3f} ({direct['low']:.3f}{pieces.DASH}{direct['high']:.3f})"
    assert rows[1][6] == (
        f"{direct['optimality_gap']:.3f} ({direct['optimality_gap_low']:.3f}{pieces.DASH}"
        f"{direct['optimality_gap_high']:.3f})"
    )
    assert tables_of(page)["Time in training and evaluating"][1] == ["good", "6", "2.00", "12.00", "0.03"]
    # IQM, mean, median and gap; the training; two tasks; the profile; the improvement.
    assert page.count('<svg viewBox="0 0 ') - page.count('aria-hidden="true"') == 4 + 1 + 2 + 1 + 1


@pytest.mark.slow
def test_the_table_9_of_bro_is_on_the_page_of_the_published_seeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(facts_module, "POINTS", 2)
    study.write(study.published_runs(["BRO", "BRO Fast"]), tmp_path / "seeds.csv")
    steps = [100_000, 200_000, 500_000, 1_000_000]
    page = written(tmp_path / "r.html", tmp_path / "seeds.csv", steps=steps, reps=5)
    rows = tables_of(page)["Averages by group of tasks"][1:]
    found = {(row[0], row[1], int(row[2].replace(",", ""))): float(row[3].split()[0]) for row in rows}
    assert len(found) == 2 * 5 * 4
    for group, of_agents in TABLE_9.items():
        for agent, values in zip(("BRO", "BRO Fast"), of_agents, strict=True):
            # Both are rounded to the third digit.
            np.testing.assert_allclose([found[agent, group, step] for step in steps], values, atol=1.01e-3, rtol=0)
    exact = sum(
        found[agent, group, step] == value
        for group, of_agents in TABLE_9.items()
        for agent, values in zip(("BRO", "BRO Fast"), of_agents, strict=True)
        for step, value in zip(steps, values, strict=True)
    )
    assert exact >= 38


def test_the_same_runs_give_the_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        with matplotlib.rc_context({"font.size": 10 if name == "a" else 17, "axes.edgecolor": "red"}):
            study.report(
                two_agents(),
                tmp_path / f"{name}.html",
                markdown=tmp_path / name / "r.md",
                title="x",
                reps=20,
                curves=[],
            )
        np.random.rand(3)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert [str(file) for file in files if file.suffix == ".png"] == [
        f"r_files/{name}.png" for name in ("averages", "improvement", "profiles", "tasks", "training")
    ]
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_nothing_is_read_or_averaged_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in (0, 1):
        write_run(tmp_path / "runs" / str(seed), seed=seed)
    calls: list[str] = []

    def counting(module: Any, name: str) -> None:
        function: Callable[..., Any] = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *args, **kwargs: calls.append(name) or function(*args, **kwargs))

    counting(study.table, "read_evaluations")
    for name in ("aggregate", "performance_profiles", "probability_of_improvement", "scored", "unscored"):
        counting(facts_module, name)
    study.report(tmp_path / "runs", tmp_path / "r.html", markdown=tmp_path / "r.md", reps=5)
    assert calls.count("read_evaluations") == 2
    assert all(calls.count(name) == 1 for name in ("performance_profiles", "scored", "unscored"))
    assert calls.count("aggregate") == 2  # at the end, and along the training


# ---------------------------------------------------------------- what is not there


def test_one_agent_one_task_one_seed(tmp_path: Path) -> None:
    text = text_of(written(tmp_path / "r.html", made_up(runs("alone", CHEETAH, [500]))))
    assert "1 task, 1 seed each" in text and "There is one agent." in text
    assert "There are no intervals, since no task has a second run" in text and "alone 0.500." in text
    assert "Left out: there is one agent." in text


def test_agents_that_cannot_be_told_apart(tmp_path: Path) -> None:
    rows = runs("a", CHEETAH, [100, 500, 900]) + runs("b", CHEETAH, [90, 510, 880])
    assert "a and b cannot be told apart." in text_of(written(tmp_path / "r.html", made_up(rows)))


def test_a_verdict_needs_enough_runs(tmp_path: Path) -> None:
    """The interval is [1, 1] in both cases; of 36 ways to part two by two runs on two tasks two are as extreme."""
    rows = runs("a", CHEETAH, [500, 600]) + runs("a", WALKER, [500, 600])
    rows += runs("b", CHEETAH, [100, 200]) + runs("b", WALKER, [100, 200])
    text = text_of(written(tmp_path / "r.html", made_up(rows)))
    assert "a is ahead of b, without certainty." in text and "better than" not in text
    assert "p = 0.056." in text and "p of the permutation test must be below 0.05" in text
    page = written(tmp_path / "r.html", made_up(rows), confidence=0.9)
    assert "a is better than b." in text_of(page)
    assert tables_of(page)["Probability of improvement"][1][3] == "0.056"


def test_single_runs_are_no_evidence(tmp_path: Path) -> None:
    tasks = [f"dmc/task-{i}-v0" for i in range(9)]
    rows = [row for agent, end in (("a", 501), ("b", 500)) for task in tasks for row in runs(agent, task, [end])]
    rows += runs("a", CHEETAH, [500, 510]) + runs("b", CHEETAH, [495, 505])
    text = text_of(written(tmp_path / "r.html", made_up(rows)))
    assert "a is ahead of b, without certainty." in text and "better than" not in text
    assert "There is no interval where a task has a single run: a, b." in text and "no task has a second" not in text


def test_who_is_ahead_and_loses_more_often_is_not_ahead(tmp_path: Path) -> None:
    tasks = [f"dmc/{name}-v0" for name in ("cheetah-run", "walker-run", "hopper-hop", "dog-run", "dog-walk")]
    rows = [row for task, end in zip(tasks, (900, 10, 10, 500, 500), strict=True) for row in runs("A", task, [end])]
    for task, end in zip(tasks, (300, 20, 20, 300, 510), strict=True):
        rows += runs("B", task, [end] * 3)
    text = text_of(written(tmp_path / "a.html", made_up(rows)))
    assert "A and B cannot be told apart." in text and "is ahead of" not in text


def test_a_score_of_another_metric(tmp_path: Path) -> None:
    heads = [(agent, {}, CHEETAH, seed, step) for agent in "AB" for seed in (0, 1) for step in (1, 2)]
    rows = [(*head, "episode_length", 100.0) for head in heads]
    scores = {CHEETAH: Score("episode_length", 200.0)}
    assert "0.500" in written(tmp_path / "a.html", made_up(rows), scores=scores)
    rows = [(*head, "online_return", 100.0) for head in heads]
    assert "0.500" in written(tmp_path / "b.html", made_up(rows), scores={CHEETAH: Score("online_return", 200.0)})


def test_a_run_without_an_evaluation_beside_published_ones(tmp_path: Path) -> None:
    rows = made_up([("A", {}, CHEETAH, 0, 100, "hours", 0.1)])
    page = text_of(written(tmp_path / "a.html", rows, published=["BRO"]))
    assert "No run has been evaluated yet." in page


def test_tasks_without_a_score_have_curves_and_are_named(tmp_path: Path) -> None:
    table = pd.concat([two_agents(), made_up(runs("good", OWN, [-5, -6]) + runs("bad", OWN, [-7, -8]))])
    page = written(tmp_path / "r.html", table)
    (task, why) = tables_of(page)["Tasks without a score, in no average"][1]
    assert task == OWN and f"--score {OWN}=1000" in why
    assert "1 task has no score." in text_of(page) and "over 2 tasks: good 0.650" in text_of(page)
    assert f"<svg>{OWN}</svg>" in page  # title of its panel
    # With a score it is one of three.
    page = written(tmp_path / "r.html", table, scores={OWN: study.Score("return", 0, -10)})
    assert "over 3 tasks" in text_of(page) and "no score" not in text_of(page)
    # None has one.
    page = written(tmp_path / "r.html", table[table["task"] == OWN])
    assert "No averages. No task of these runs has a score." in text_of(page)
    assert f"<svg>{OWN}</svg>" in page and "Performance profiles" not in page
    # A success rate that was not recorded.
    rows = [(*row[:2], PUSH, *row[3:]) for row in runs("good", CHEETAH, [1, 2])]
    text = text_of(written(tmp_path / "r.html", made_up(rows)))
    assert f"{PUSH} is scored by success_rate, which the runs of good there have not recorded" in text


def test_runs_under_way_are_in_their_tasks_and_in_no_average(tmp_path: Path) -> None:
    table = two_agents()
    cut = (table["agent"] == "bad") & (table["seed"] == 2) & (table["step"] > 100)
    page = written(tmp_path / "r.html", table[~cut])
    assert "2 runs have not got to 200 steps." in text_of(page)
    rows = tables_of(page)["Averages by group of tasks"]
    assert [row[-1] for row in rows[1:]] == ["6", "4"]
    # A task that one agent has not reached is none to compare.
    cut = (table["agent"] == "bad") & (table["task"] == WALKER) & (table["step"] > 100)
    text = text_of(written(tmp_path / "r.html", table[~cut]))
    assert "at 200 steps over 1 task:" in text and "(of 2: those that every agent has reached 200 steps on)" in text
    text = text_of(written(tmp_path / "r.html", table[~cut], all_tasks=True))
    assert f"at 200 steps, each over its own 1{pieces.DASH}2 tasks: good" in text
    assert f"Averages are over 1{pieces.DASH}2 tasks (of 2, each agent over its own)." in text
    assert "agents have not the same tasks" in text
    text = text_of(written(tmp_path / "r.html", table[(table["agent"] == "good") | (table["task"] == CHEETAH)]))
    assert "1 pair of agent and task has no evaluated run." in text
    # Agents whose evaluations do not overlap cannot be compared.
    late = made_up(runs("late", CHEETAH, [1, 2], LATER))
    text = text_of(written(tmp_path / "r.html", pd.concat([table, late])))
    assert "late is in no average: no run of it was evaluated around 200 steps." in text


def test_averages_say_whose_tasks_they_are_over(tmp_path: Path) -> None:
    rows = runs("a", CHEETAH, [500, 510]) + runs("b", WALKER, [500, 510])
    text = text_of(written(tmp_path / "r.html", made_up(rows)))
    assert "No two agents have a task in common." in text and "has the highest average" not in text
    assert "at 200 steps, each over its own 1 task: a 0.505 (" in text and "over 2 tasks" not in text
    assert "Averages are over 1 task (of 2, each agent over its own)." in text
    # Two tasks of one agent, one of them the other's.
    rows += runs("a", WALKER, [400, 410])
    text = text_of(written(tmp_path / "r.html", made_up(rows), all_tasks=True))
    assert f"at 200 steps, each over its own 1{pieces.DASH}2 tasks: " in text
    assert "at 200 steps over 1 task: " in text_of(written(tmp_path / "r.html", made_up(rows)))


def test_an_agent_without_averages_is_one_all_the_same(tmp_path: Path) -> None:
    rows = runs("a", CHEETAH, [500, 510])
    late = rows + runs("late", CHEETAH, [1, 2], LATER)
    page = text_of(written(tmp_path / "r.html", made_up(late)))
    assert "Only a has averages." in page and "Left out: only a has averages." in page and "one agent" not in page
    page = text_of(written(tmp_path / "r.html", made_up(rows + runs("own", OWN, [1, 2]))))
    assert "Only a has averages." in page and "own is in no average: none of its tasks has a score." in page
    page = text_of(written(tmp_path / "r.html", made_up(rows + runs("pusher", PUSH, [1, 1])), groups=["dmc"]))
    assert "pusher is in no average: it has no task of the groups." in page and "Only a has averages" in page
    started = [row for row in runs("b", CHEETAH, [1, 2]) if row[5] == "hours"]
    page = text_of(written(tmp_path / "r.html", made_up(rows + started)))
    assert "Not evaluated: b." in page and "b is in no average: no run of it has been evaluated." in page
    page = text_of(written(tmp_path / "r.html", made_up(started)))
    assert "Nothing yet." in page and "Not evaluated: b." in page and "2 runs have no evaluation yet." in page


def test_runs_of_a_table_that_have_no_evaluation_yet(tmp_path: Path) -> None:
    """The table of a running study has the hours of runs before their first evaluation."""
    rows = runs("a", CHEETAH, [500, 510, 520]) + [row for row in runs("a", WALKER, [0, 0]) if row[5] == "hours"]
    page = written(tmp_path / "r.html", made_up(rows))
    assert "1 task, 3 seeds each, up to 200 simulator steps." in text_of(page)
    assert "2 runs have no evaluation yet." in text_of(page) and "Nothing." not in text_of(page)
    assert "1 pair of agent and task has no evaluated run." in text_of(page)
    (rows_of_table,) = [rows for caption, rows in tables_of(page).items() if caption.startswith("Runs that were")]
    assert [row[:3] for row in rows_of_table[1:]] == [["a", CHEETAH, "3"], ["a", WALKER, "0"]]
    # A group of a plan may have a task that no run has been evaluated on yet.
    groups = {"both": [CHEETAH, WALKER]}
    assert "Averages are over 1 task" in text_of(written(tmp_path / "r.html", made_up(rows), groups=groups))


def test_agents_that_share_a_task_of_the_second_group_only(tmp_path: Path) -> None:
    other = "metaworld/reach-v3"
    rows = [row for agent in ("A", "B") for row in runs(agent, CHEETAH, [600, 700, 800])]
    for agent, task in (("A", PUSH), ("B", other)):
        for seed in range(3):
            rows += [(agent, {}, task, seed, step, "success_rate", 0.5) for step in (100, 200)]
    page = written(tmp_path / "r.html", made_up(rows), all_tasks=True, groups=["metaworld", "dmc"])
    averages = tables_of(page)["Averages by group of tasks"]
    assert len(averages) > 4 and "no two agents have a task of the group metaworld in common" in text_of(page)


def test_training_episodes_of_runs_that_end_at_other_steps(tmp_path: Path) -> None:
    for seed, lengths in enumerate([(100, 110, 90), (95, 100, 100), (105, 100, 105)]):
        write_monitor(tmp_path / "mine" / str(seed), CHEETAH, lengths, (1.0, 2.0, 30.0))
    page = written(tmp_path / "r.html", tmp_path / "mine")
    assert "at 295 steps over 1 task: mine 0.0" in text_of(page) and "Nothing." in text_of(page)
    assert tables_of(page)["Averages by group of tasks"][1][-1] == "3"
    assert "their rows are training episodes, which explore" in text_of(page)


def test_training_episodes_of_runs_that_do_not_overlap(tmp_path: Path) -> None:
    write_monitor(tmp_path / "mine" / "0", CHEETAH, (1_000, 1_000), (1.0, 2.0), (1.0, 2.0))
    write_monitor(tmp_path / "mine" / "1", CHEETAH, (2_100, 800), (1.0, 2.0), (1.0, 2.0))
    found = task_curves(gather([tmp_path / "mine"]), CHEETAH, None, [])
    assert list(found.own["mine"].data["env_step"]) == [2_100, 2_900]
    assert [list(run.steps) for run in found.under_way["mine"]] == [[1_000, 2_000]]


def test_agents_of_a_grid_are_told_apart(tmp_path: Path) -> None:
    rows = []
    for i, (size, ratio) in enumerate((size, ratio) for size in ("0.26M", "0.55M") for ratio in (2, 4)):
        rows += runs("bro", CHEETAH, [100 * i + 100, 100 * i + 101], model_size=size, replay_ratio=ratio)
    found = study.report(made_up(rows), tmp_path / "r.html", markdown=tmp_path / "r.md", reps=5, curves=[])
    result = dict(found.summary)["Result"]
    assert result[0] == (
        "bro (model_size=0.55M, replay_ratio=4) is ahead of bro (model_size=0.55M, replay_ratio=2), without certainty."
    )
    drawn = {part.name: part for section in found.sections for part in section.parts if isinstance(part, pieces.Figure)}
    labels = {name: [label for label, _, _ in drawn[name].panels[0].rows] for name in ("averages", "improvement")}
    assert labels["averages"] == ["bro (0.55M, 4)", "bro (0.55M, 2)", "bro (0.26M, 4)", "bro (0.26M, 2)"]
    assert labels["improvement"][0] == "bro (0.55M, 4)\n> bro (0.55M, 2)" and len(set(labels["improvement"])) == 6
    # Both names are in the picture, in lines of their own.
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", figures.svg(drawn["improvement"].panels[0], "p"))
    assert "bro (0.55M, 4)" in texts and "&gt; bro (0.26M, 2)" in texts
    # All names of a table are shown in full: no cell ends in an ellipsis.
    assert "text-overflow" not in (tmp_path / "r.html").read_text()


def test_names_are_shortened_together() -> None:
    def short(*names: str, letters: int = 12) -> list[str]:
        return list(pieces.distinct(names, letters).values())

    assert short("SAC", "BRO") == ["SAC", "BRO"]
    assert short("SAC (tau=0.5)", "SAC (tau=1)", letters=13) == ["SAC (tau=0.5)", "SAC (tau=1)"]
    assert short("SAC (replay_ratio=0.5)", "SAC (replay_ratio=1)") == ["SAC (0.5)", "SAC (1)"]
    # Arguments that are one name's only leave equal values.
    assert short("SAC (replay_ratio=1)", "SAC (update_ratio=1)") == ["SAC (1) #1", "SAC (1) #2"]
    assert short("a very long name", "another long one") == ["a very long…", "another lon…"]
    assert short("a very long name 1", "a very long name 2") == ["a ver…name 1", "a ver…name 2"]
    assert short("a very long 1 long name", "a very long 2 long name") == ["a very l… #1", "a very l… #2"]
    assert short("a\nb", "a b") == ["a b #1", "a b #2"]
    assert short() == []


def test_tasks_of_one_beginning_have_titles_of_their_own(tmp_path: Path) -> None:
    tasks = [f"My/AnAntThatWalksThroughAMazeOfTheSize{n}-v0" for n in (1, 2)]
    page = written(tmp_path / "r.html", made_up([row for task in tasks for row in runs("a", task, [1, 2])]))
    titles = re.findall(r"<svg>(.*?)</svg>", page)
    assert titles == [f"My/AnAntThatWalks…AMazeOfTheSize{n}-v0" for n in (1, 2)]


# ---------------------------------------------------------------- a study's folder


def planned(agent: str, seed: int, task: str = CHEETAH) -> Run:
    return Run(agent, "bro", {}, {}, task, seed, 3_000, 1_000, 2)


@pytest.fixture
def folder(tmp_path: Path) -> StudyFolder:
    """A study of two agents with three seeds: two runs are done, one has failed, one is under way, two wait."""
    made = tuple(planned(agent, seed) for agent in ("A", "B") for seed in range(3))
    plan = Plan("mixed", made, "agents: {}\n" + EVIL)
    place = StudyFolder(tmp_path / "mixed")
    place.enter(plan)
    for run in plan.runs:
        lock = place.claim(run)
        assert lock is not None
        lock.release()
    for run in plan.runs[:2]:
        write_run(place.place(run), seed=run.seed, algo="bro")
        place.write_outcome(run, Outcome(True, steps=3_000, seconds=60.0, threads=2, last_return=30.0))
    manifest = place.place(plan.runs[0]) / "checkpoint-000000003000" / "manifest.json"
    manifest.parent.mkdir()
    manifest.write_text(json.dumps({"circumstances": {"torch": "9.9", "processor": f"Chip {EVIL}", "commit": "abc"}}))
    failed = plan.runs[3]
    place.place(failed).mkdir(parents=True)
    place.write_outcome(failed, Outcome(False, attempts=2, traceback=f"Traceback\nValueError: {EVIL}\n"))
    under_way = plan.runs[4]
    write_run(place.place(under_way), seed=under_way.seed, steps=(1_000,), values=(5.0,), algo="bro")
    return place


def test_a_study_says_what_is_done_and_what_has_failed(folder: StudyFolder, tmp_path: Path) -> None:
    run = folder.runs()[4]
    lock = folder.claim(run)
    assert lock is not None
    with lock:
        page = written(tmp_path / "r.html", folder.path)
    text = text_of(page)
    assert "2 of 6 planned runs are done; 1 running, 1 failed, 2 waiting." in text
    assert "those of the games of Atari-100k between random play and a human; others as they were given" in text
    by_agent = tables_of(page)["Runs of the study"]
    assert by_agent[0] == ["agent", "done", "running", "failed", "waiting", "planned"]
    assert by_agent[1] == ["A", "2", "0", "0", "1", "3"] and by_agent[2][1:] == ["0", "1", "1", "1", "3"]
    assert tables_of(page)["Runs of the study by task"][1] == ["A", CHEETAH, "2", "0", "0", "1", "3"]
    assert "Failed after 2 attempts: " in text and f"ValueError: {EVIL}" in text
    assert "Plan of " in text and "agents: {}" in text
    made = tables_of(page)["Versions and machines of the runs that say so"]
    assert ["torch", "9.9", "1"] in made and ["commit", "abc", "1"] in made
    assert re.search(r"Machines: .*: 2 runs with 2 threads each", text)
    # The step that a run of each agent has reached.
    assert "at 1,000 steps over 1 task" in text


def test_an_agent_with_failed_runs_is_not_better(tmp_path: Path) -> None:
    place = StudyFolder(tmp_path / "s")
    made = [planned(agent, seed) for agent in ("A", "B") for seed in range(5)]
    place.enter(Plan("s", tuple(made)))
    for run in made:
        values = (100.0 * (run.agent == "A") + run.seed,) * 3
        with place.claim(run):  # type: ignore[union-attr]
            pass
        if (run.agent, run.seed) == ("A", 4):  # got half as far
            write_run(place.place(run), seed=run.seed, steps=(1_000,), values=values[:1])
            place.write_outcome(run, Outcome(False, attempts=2, traceback="NaN"))
        else:
            write_run(place.place(run), seed=run.seed, values=values)
            place.write_outcome(run, Outcome(True, steps=3_000))
    text = text_of(written(tmp_path / "r.html", place.path, steps=[3_000]))
    assert "A is ahead of B, without certainty." in text and "better than" not in text
    assert "1 failed run of A is not counted: the comparison favours it." in text
    # So it is if the source is a folder above, or within.
    for source in (tmp_path, place.path / "runs"):
        text = text_of(written(tmp_path / "other.html", source, steps=[3_000]))
        assert "better than" not in text and "1 failed run of A is not counted: the comparison favours it." in text
    assert "not counted" not in text_of(written(tmp_path / "other.html", place.path / "runs/B", steps=[3_000]))
    # At a step that it has reached it counts.
    text = text_of(written(tmp_path / "r.html", place.path, steps=[1_000]))
    assert "A is better than B." in text and "not counted" not in text
    # The failed run of the worse agent changes nothing.
    place.write_outcome(made[4], Outcome(True, steps=3_000))
    write_evaluations(place.place(made[4]), (1_000, 2_000, 3_000), (100.0,) * 3)
    place.write_outcome(made[9], Outcome(False, attempts=2, traceback="failed"))
    (place.place(made[9]) / "evaluations.npz").unlink()
    text = text_of(written(tmp_path / "r.html", place.path, steps=[3_000]))
    assert "A is better than B." in text and "1 failed run of B is not counted" in text


def study_of_agents(path: Path, agents: dict[str, dict[str, Any]], failed: dict[tuple[str, int], int]) -> StudyFolder:
    """A study of three seeds whose other runs are done; of those that failed, how many evaluations they have."""
    place = StudyFolder(path)
    made = [
        Run(agent, "bro", arguments, {}, CHEETAH, seed, 3_000, 1_000, 2)
        for seed in range(3)
        for agent, arguments in agents.items()
    ]
    place.enter(Plan("s", tuple(made)))
    for run in made:
        with place.claim(run):  # type: ignore[union-attr]
            pass
        n = failed.get((run.agent, run.seed), 3)
        if n:
            steps = (1_000, 2_000, 3_000)[:n]
            write_run(place.place(run), seed=run.seed, steps=steps, values=(1.0,) * n, arguments=run.arguments)
        place.write_outcome(
            run, Outcome((run.agent, run.seed) not in failed, steps=1_000 * n, attempts=2, traceback="failed")
        )
    return place


def test_a_failed_run_is_its_own_agents(tmp_path: Path) -> None:
    agents = {"SAC": {"tau": 0.01}, "SAC (no clip)": {"tau": 0.02}}
    place = study_of_agents(tmp_path / "s", agents, {("SAC", 2): 2})
    text = text_of(written(tmp_path / "r.html", place.path))
    assert "1 failed run of SAC is not counted: the comparison favours it." in text and "of each agent" not in text
    # Under one label, agents are known by their arguments.
    text = text_of(written(tmp_path / "r.html", f"X={place.path}"))
    assert "1 failed run of X (tau=0.01) is not counted: the comparison favours it." in text


def test_an_agent_whose_runs_have_all_failed_is_named(tmp_path: Path) -> None:
    agents: dict[str, dict[str, Any]] = {"SAC": {}, "B": {"tau": 0.02}}
    place = study_of_agents(tmp_path / "s", agents, {("B", seed): 0 for seed in range(3)})
    text = text_of(written(tmp_path / "r.html", place.path))
    assert "SAC. 1 task, 3 seeds each, up to 3,000 simulator steps. Not evaluated: B." in " ".join(text.split())
    assert "Only SAC has averages." in text and "There is one agent" not in text
    assert "B is in no average: all of its 3 runs failed." in text
    # Of some runs nothing is known yet.
    (place.path / "s.yml").write_text(
        f"agents: {{SAC: {{algo: bro}}, B: {{algo: bro, gamma: 0.9}}, C: {{algo: bro, gamma: 0.8}}}}\n"
        f"tasks: [{CHEETAH}]\nseeds: 2\nsteps: 3_000\nevaluation: {{every: 1_000}}\n"
    )
    study.write(study.read(place.path), tmp_path / "t.csv")
    text = text_of(written(tmp_path / "r.html", tmp_path / "t.csv", plan=place.path / "s.yml"))
    assert "Not evaluated: B, C." in text and "C is in no average: none of its 2 planned runs is here." in text
    place.write_outcome(place.runs()[1], Outcome(False))
    text = text_of(written(tmp_path / "r.html", place.path))
    assert "B is in no average: none of its 3 runs has been evaluated (2 failed, 1 waiting)." in text


def test_runs_that_were_removed_from_the_plan_are_in_no_count(tmp_path: Path) -> None:
    place = study_of_agents(tmp_path / "s", {"SAC": {}, "B": {"tau": 0.02}}, {("B", 1): 0})
    made = {"circumstances": {"torch": "9.9"}}
    for run in place.runs():
        checkpoint = place.place(run) / "checkpoint-000000003000"
        checkpoint.mkdir(parents=True)
        (checkpoint / "manifest.json").write_text(json.dumps(made))
    write_monitor(place.place(place.runs()[3]), CHEETAH)
    page = written(tmp_path / "r.html", place.path)
    assert ["torch", "9.9", "5"] in tables_of(page)["Versions and machines of the runs that say so"]
    assert "1 run of " in text_of(page)
    place.enter(Plan("s", tuple(run for run in place.runs() if run.agent == "SAC")))
    page = written(tmp_path / "r.html", place.path)
    assert ["torch", "9.9", "3"] in tables_of(page)["Versions and machines of the runs that say so"]
    assert "not in their study's plan any more" in text_of(page) and "without an evaluation yet" not in text_of(page)


@pytest.mark.parametrize(
    ("n_of_c", "sentences"),
    [
        (
            4,
            [
                "2 planned runs of each of A, B are not here: if failed, the comparison favours them.",
                "1 planned run of C is not here: if failed, the comparison favours it.",
            ],
        ),
        (3, ["2 planned runs of each agent are not here."]),
    ],
)
def test_missing_runs_of_several_agents_are_one_sentence(tmp_path: Path, n_of_c: int, sentences: list[str]) -> None:
    plan = tmp_path / "plan.yml"
    plan.write_text(
        "agents: {A: {algo: sac_sample}, B: {algo: sac_sample, gamma: 0.9}, C: {algo: sac_sample, gamma: 0.8}}\n"
        "tasks: [dmc/cheetah-run-v0]\nseeds: 5\nsteps: 200\nevaluation: {every: 100}\n"
    )
    of_agents = {"A": [300.0, 301, 302], "B": [200.0, 201, 202], "C": [100.0, 101, 102, 103][:n_of_c]}
    rows = [row for agent, returns in of_agents.items() for row in runs(agent, "dmc/cheetah-run-v0", returns)]
    text = text_of(written(tmp_path / "r.html", made_up(rows), plan=plan))
    assert all(sentence in text for sentence in sentences)
    assert text.count("the comparison favours") == sum("favours" in sentence for sentence in sentences)


def test_what_a_run_logs_after_its_last_evaluation_is_in_no_average(tmp_path: Path) -> None:
    place = StudyFolder(tmp_path / "s")
    made = [planned(agent, seed) for agent in ("A", "B") for seed in range(5)]
    place.enter(Plan("s", tuple(made)))
    for run in made:
        values = [100.0 * (run.agent == "A") + run.seed] * 3
        failed = (run.agent, run.seed) == ("A", 4)
        n = 2 if failed else 3
        with place.claim(run):  # type: ignore[union-attr]
            pass
        log = [{"step": 2_900, "diagnostics/dormant": 0.5}] if failed else []
        write_run(place.place(run), seed=run.seed, steps=(1_000, 2_000, 3_000)[:n], values=values[:n], log=log)
        place.write_outcome(run, Outcome(not failed, steps=3_000, attempts=2, traceback="failed"))
    page = written(tmp_path / "r.html", place.path, steps=[2_500])
    text = text_of(page)
    assert "1 failed run of A is not counted: the comparison favours it." in text and "better than" not in text
    assert "1 run has not got to 2,500 steps." in text
    ends = next(rows for caption, rows in tables_of(page).items() if caption.startswith("Runs that were evaluated"))
    assert ends[1][-2:] == ["2,000", "3,000"]


def test_planned_runs_that_are_not_here_may_have_failed(tmp_path: Path) -> None:
    (tmp_path / "p.yml").write_text(
        f"agents: {{good: {{algo: bro}}, bad: {{algo: bro_fast}}}}\n"
        f"tasks: [{CHEETAH}, {WALKER}]\nseeds: 4\nsteps: 25_000\n"
    )
    rows = [
        *runs("bad", CHEETAH, [1, 2, 3, 4]),
        *runs("bad", WALKER, [1, 2, 3, 4]),
        *runs("good", WALKER, [7, 8, 9, 9]),
    ]
    rows += runs("good", CHEETAH, [7, 8, 9])
    text = text_of(written(tmp_path / "r.html", made_up(rows), plan=tmp_path / "p.yml"))
    assert "good is ahead of bad, without certainty." in text
    assert "1 planned run of good is not here: if failed, the comparison favours it." in text
    # One agent is compared with none.
    alone = made_up([row for row in rows if row[0] == "good"])
    text = text_of(written(tmp_path / "r.html", alone, plan=tmp_path / "p.yml"))
    assert "1 planned run of good is not here." in text and "favours" not in text


def test_an_empty_study_and_one_without_evaluations(tmp_path: Path) -> None:
    place = StudyFolder(tmp_path / "empty")
    place.enter(Plan("empty", (planned("A", 0), planned("B", 0))))
    page = written(tmp_path / "r.html", place.path)
    assert "Nothing yet." in text_of(page) and "Not evaluated: A, B." in text_of(page)
    assert "0 of 2 planned runs are done; 2 waiting." in text_of(page)
    assert "No averages. No run has been evaluated yet." in text_of(page) and "<figure" not in page
    write_run(place.place(place.runs()[0]))
    (place.place(place.runs()[0]) / "evaluations.npz").unlink()
    page = written(tmp_path / "r.html", place.path)
    assert "1 run of " in text_of(page) and "without an evaluation yet" in text_of(page)
    write_evaluations(place.place(place.runs()[0]), (1_000,), (5.0,))
    assert "A 0.005." in text_of(written(tmp_path / "r.html", place.path))


@pytest.mark.slow
def test_a_real_study(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rl_zoo3")
    plan = tmp_path / "plan.yml"
    plan.write_text(
        "agents: {SAC: {algo: sac_sample, learning_starts: 20, policy_kwargs: {net_arch: [8]}, compile: false}}\n"
        "grid: {replay_ratio: [0.1]}\ntasks: [Pendulum-v1]\nseeds: 2\nsteps: 200\n"
        "evaluation: {every: 100, episodes: 1}\ncheckpoint_freq: 100\n"
    )
    cli.main(["study", "run", str(plan), "--folder", str(tmp_path / "s"), "--workers", "1", "--device", "cpu"])
    cli.main(["study", "report", str(tmp_path / "s"), "--score", "Pendulum-v1=-2000:0", "--reps", "5"])
    assert f"Saved to {tmp_path / 's' / 'report.html'}" in capsys.readouterr().out
    page = (tmp_path / "s" / "report.html").read_text()
    text = text_of(page)
    assert "SAC." in text and "2 of 2 planned runs are done." in text
    made = {row[0]: row[1:] for row in tables_of(page)["Versions and machines of the runs that say so"]}
    assert made["torch"][1] == "2" and made["torch threads"] == ["1", "2"]
    assert made["processor"] == [" ".join(processor().split()), "2"] and made.get("commit", ["", "2"])[1] == "2"
    assert ["learning_starts", "20"] in tables_of(page)["Arguments"]
    assert len(tables_of(page)["Time in training and evaluating"]) == 2


def test_planned_runs_are_known_by_the_plans_names(tmp_path: Path) -> None:
    """A bracket in an agent's name is part of it."""
    plan = tmp_path / "plan.yml"
    agents = "agents: {SAC: {algo: sac_sample}, SAC (no resets): {algo: sac_sample, gamma: 0.9}}\n"
    rest = "tasks: [Pendulum-v1]\nseeds: 2\nsteps: 200\nevaluation: {every: 100}\n"
    plan.write_text(agents + rest)
    found = gather([made_up(runs("SAC (no resets)", "Pendulum-v1", [-900, -800]))], plan=plan)
    assert missing(found) == {("SAC", "Pendulum-v1"): [0, 1]}
    found = gather([made_up(runs("SAC", "Pendulum-v1", [-900, -800]))], plan=plan)
    assert missing(found) == {("SAC (no resets)", "Pendulum-v1"): [0, 1]}
    plan.write_text("agents: {SAC (ours): {algo: sac_sample}}\ngrid: {gamma: [0.9, 0.99]}\n" + rest)
    rows = [row for gamma in (0.9, 0.99) for row in runs("SAC (ours)", "Pendulum-v1", [-900, -800], gamma=gamma)]
    assert missing(gather([made_up(rows)], plan=plan)) == {}
    found = gather([made_up([row for row in rows if row[1]["gamma"] == 0.9])], plan=plan)
    assert missing(found) == {("SAC (ours) (gamma=0.99)", "Pendulum-v1"): [0, 1]}
    # A table that does not say seeds says of no planned run that it is here.
    seedless = made_up(rows).assign(seed=pd.array([pd.NA] * len(rows), "Int64"))
    assert len(missing(gather([seedless], plan=plan))) == 2


def test_a_plan_knows_its_agents_by_name_not_by_a_label(tmp_path: Path) -> None:
    plan = tmp_path / "plan.yml"
    plan.write_text(
        "agents: {SAC: {algo: sac_sample}, B: {algo: sac_sample, gamma: 0.9}}\n"
        "tasks: [Pendulum-v1]\nseeds: 2\nsteps: 200\nevaluation: {every: 100}\n"
    )
    study.write(made_up(runs("mine", "Pendulum-v1", [-900, -800])), tmp_path / "t.csv")
    with pytest.raises(ValueError, match="plan has the agents SAC, B, and 'Mine', the label of a source, is none"):
        gather(f"Mine={tmp_path / 't.csv'}", plan=plan)
    assert missing(gather(f"SAC={tmp_path / 't.csv'}", plan=plan)) == {("B", "Pendulum-v1"): [0, 1]}


def test_planned_runs_are_looked_up_and_not_compared_with_every_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Values of the grid are read once for each run that is there and each that is planned."""
    calls: list[Any] = []
    original = planned_runs._values
    monkeypatch.setattr(planned_runs, "_values", lambda *args: calls.append(args) or original(*args))
    made = [
        Run("a", "bro", {}, {"x": x, "y": [x, 0.5]}, CHEETAH, seed, 1_000, 1_000)
        for x in range(40)
        for seed in range(5)
    ]
    # Numbers are equal as in Python, and lists as in JSON.
    rows = [("a", {"y": [x, 0.5], "x": float(x), "z": 1}, CHEETAH, seed) for x in range(39) for seed in range(5)]
    known = made_up([(*row, 1_000, "return", 1.0) for row in rows])
    assert planned_runs.missing_runs(made, known) == made[-5:]
    assert len(calls) == len(rows) + len(made)
    shown = {("a", text): text for text in known["arguments"].unique()}
    calls.clear()
    agents_of = planned_runs.namer(shown)
    assert [len(agents_of("a", run)) for run in made] == [1] * 195 + [0] * 5
    assert len(calls) == len(shown) + len(made)


def test_missing_runs_are_looked_for_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = tmp_path / "plan.yml"
    plan.write_text(f"agents: {{a: {{algo: bro}}}}\ntasks: [{CHEETAH}]\nseeds: 3\nsteps: 25_000\n")
    calls: list[Any] = []
    original = planned_runs.missing_runs
    monkeypatch.setattr(reading, "missing_runs", lambda *args: calls.append(args) or original(*args))
    assert "2 of 3 planned runs are here." in text_of(
        written(tmp_path / "r.html", made_up(runs("a", CHEETAH, [1, 2])), plan=plan)
    )
    assert len(calls) == 1


def test_a_table_with_its_plan_and_the_records_beside_it(tmp_path: Path) -> None:
    """As ``make evidence`` leaves them in docs/evidence."""
    rows = runs("SAC", "Pendulum-v1", [-900, -800], replay_ratio=1) + runs("SAC", "Pendulum-v1", [-700], replay_ratio=2)
    study.write(made_up(rows), tmp_path / "t.csv")
    record = {"run": {}, "commit": "0123abc", "torch": "2.0", "python": "3.11.7", "processor": "A chip", "threads": 1}
    records = [record, record, {**record, "made_by": "a program"}]
    (tmp_path / "t.json").write_text(json.dumps(records))
    (tmp_path / "plan.yml").write_text(
        "agents: {SAC: {algo: sac_sample}}\ngrid: {replay_ratio: [1, 2]}\ntasks: [Pendulum-v1]\nseeds: 3\nsteps: 200\n"
        "evaluation: {every: 100}\n"
    )
    page = written(tmp_path / "r.html", tmp_path / "t.csv", plan=tmp_path / "plan.yml")
    assert "3 of 6 planned runs are here." in text_of(page)
    assert tables_of(page)["Planned runs that are not here"][1:] == [
        ["SAC (replay_ratio=1)", "Pendulum-v1", "2"],
        ["SAC (replay_ratio=2)", "Pendulum-v1", f"1{pieces.DASH}2"],
    ]
    made = tables_of(page)["Versions and machines of the runs that say so"]
    assert ["commit", "0123abc", "3"] in made and ["threads", "1", "3"] in made and ["torch", "2.0", "3"] in made
    assert ["made_by", "a program", "1"] in made
    for other in ("[1, 2]", "{}", "no JSON"):  # a file of something else
        (tmp_path / "t.json").write_text(other)
        assert "Versions and machines" not in written(tmp_path / "r.html", tmp_path / "t.csv")


def test_the_commit_is_that_of_the_checkout() -> None:
    if (ROOT / ".git").exists():
        assert re.fullmatch(r"[0-9a-f]{12,}(-dirty)?", commit())


# ---------------------------------------------------------------- files that anybody may have written


def test_names_and_tracebacks_are_only_text(folder: StudyFolder, tmp_path: Path) -> None:
    table = two_agents()
    table["agent"] = table["agent"].replace({"good": EVIL, "bad": "_$\\bad$ | [x](javascript:y) \n#0072b2 url(#a)"})
    table["task"] = table["task"].replace({WALKER: f"dmc/{EVIL}-v0"})
    page = written(tmp_path / "r.html", [folder.path, table], title=EVIL, markdown=tmp_path / "r.md", drawn=True)
    script = (ROOT / "sb3_sample/study/reporting/page.js").read_text()
    assert page.count("<script") == 1 and f"<script>{script}</script>" in page
    assert EVIL not in page and EVIL in text_of(page)
    assert "#0072b2 url(#a)" in text_of(page)
    written_text = (tmp_path / "r.md").read_text()
    assert "<script" not in written_text and "[x](javascript" not in written_text
    assert r"\_\$\\bad\$ \| \[x\](javascript:y) \#0072b2" in written_text
    # A page that asks for nothing: no address but the anchors.
    assert set(re.findall(r'(?:href|src)="(.)', page)) <= {"#", "d"} and "@import" not in page
    assert "default-src 'none'" in page


# ---------------------------------------------------------------- beside published figures


def test_published_runs_and_curves_beside_ours(tmp_path: Path) -> None:
    rows = runs("BRO", CHEETAH, [200, 300], LATEST) + runs("BRO", PUSH, [0.1, 0.2], LATEST)
    page = written(tmp_path / "r.html", made_up(rows), published=["BRO Fast"], curves=["BRO", "TD-MPC2"])
    legend = [html.unescape(re.sub("<.*?>", "", item)) for item in re.findall(r"<li>(.*?)</li>", page)]
    assert "BRO Fast, published: 10 seeds; of the v2 task on 1 of 2 tasks" in legend
    assert "BRO (RR=10), published: 10 seeds; of the v2 task on 1 of 2 tasks" in legend
    assert (
        "TD-MPC2, published: 3 seeds; action repeat 2; success at the last step on 1 of 2 tasks; "
        "of the v2 task on 1 of 2 tasks"
    ) in legend
    # Ours and the published one of its name have one colour, and that is dashed.
    look = looks(page)
    assert look["BRO"] == ("0", "none")
    assert look["BRO (RR=10), published: 10 seeds; of the v2 task on 1 of 2 tasks"] == ("0", "6 3")
    # Every seed is there: in the averages, but not among what is missing or compared.
    assert [row[0] for row in tables_of(page)["Averages by group of tasks"][1:3]] != ["BRO", "BRO"]
    assert "Beside them: BRO Fast, published." in text_of(page) and "1 agent" not in text_of(page)
    # Means over tasks of what has statistics only, by hand.
    assert "beside published curves, of which there are statistics over seeds only" in text_of(page)


def test_a_published_curve_that_is_called_as_ours_is_another(tmp_path: Path) -> None:
    rows = runs("SAC", CHEETAH, [200, 300], LATEST) + runs("DAC", CHEETAH, [200, 300], LATEST)
    look = looks(written(tmp_path / "r.html", made_up(rows), curves=["SAC"]))
    assert look["SAC"] == ("0", "none") and look["DAC"] == ("1", "none")
    assert look["SAC, published: 3 seeds; action repeat not stated"] == ("0", "6 3") and len(look) == 3


def figures_of(table: pd.DataFrame, curve: str) -> dict[str, pieces.Figure]:
    """Figures of a report by name, with a published curve."""
    found = build(
        gather(table), title="", curves=[curve], steps=None, groups=None, scores=None, all_tasks=False, reps=2,
        confidence=0.95, seed=0,
    )  # fmt: skip
    parts = (part for section in found.sections for part in section.parts)
    return {part.name: part for part in parts if isinstance(part, pieces.Figure)}


def test_nothing_is_drawn_where_others_have_not_measured(tmp_path: Path) -> None:
    """SimbaV2's published curve has the untrained policy and then 100,000 steps; CrossQ's begins at 50,000."""

    def lines_of(task: str, name: str, end: int) -> list[pieces.Line]:
        table = made_up(runs("a", task, [1, 2], (end // 2, end)))
        figure = figures_of(table, name)["tasks"]
        assert figure.caption.endswith(f"left out where they begin after the last step shown: {name}") == (end < 50_000)
        assert [agent.published for agent in figure.agents].count(True) == (end >= 50_000)
        return [line for panel in figure.panels for line in panel.lines if line.agent.published]  # type: ignore[union-attr]

    assert not lines_of("dmc/walker-run-v0", "SimbaV2 (RR=2)", 20_000)
    (line,) = lines_of("dmc/walker-run-v0", "SimbaV2 (RR=2)", 150_000)
    assert list(figures._until(line, 150_000).x) == [0, 100_000]  # not interpolated to 150,000
    ours = line._replace(agent=dataclasses.replace(line.agent, published=False))
    assert list(figures._until(ours, 150_000).x) == [0, 100_000, 150_000]
    (line,) = lines_of("HalfCheetah-v5", "CrossQ", 50_000)
    assert list(figures._until(line, 50_000).x) == [50_000]  # a marker, and its range
    _, _, _, low, high, *_ = figures._until(line, 50_000)
    assert low is not None and high is not None and list(low) < list(high)


def looks(page: str) -> dict[str, tuple[str, str]]:
    """Colour and dashes of what legends name."""
    items = re.findall(r"<li>(.*?)</li>", page)
    styles = [re.search(r"var\(--c(\d)\).*dasharray: ([^\"]*)", item) for item in items]
    return {text_of(item).strip(): (style[1], style[2]) for item, style in zip(items, styles, strict=True) if style}


def test_the_mean_of_published_curves_over_tasks() -> None:
    table = made_up(runs("a", CHEETAH, [1], LATER) + runs("a", PUSH, [1], LATER))
    line = next(line for line in figures_of(table, "BRO")["means"].panels[0].lines if line.agent.published)  # type: ignore[union-attr]
    means = [
        published_curves(task).query("algorithm == 'BRO (RR=10)'").set_index("env_step")["mean"][[25_000, 50_000]]
        for task in (CHEETAH, PUSH)
    ]
    np.testing.assert_allclose(line.y, (means[0].to_numpy() / 1_000 + means[1].to_numpy()) / 2)
    assert list(line.x) == [25_000, 50_000]


def test_a_table_of_published_curves_is_drawn(tmp_path: Path) -> None:
    table = pd.concat([made_up(runs("a", CHEETAH, [1, 2], LATER)), study.published_curves(["TD7"], [CHEETAH])])
    text = text_of(written(tmp_path / "r.html", table))
    assert "TD7, published: 5 seeds; action repeat not stated; its steps look one evaluation late" in text


@pytest.mark.parametrize("name", sorted(all_published_curves()["algorithm"].unique()))
def test_how_curves_were_measured_is_as_the_data_say(name: str) -> None:
    """Action repeats, against the table of sources."""
    text = (ROOT / "sb3_sample/data/README.md").read_text()
    rows = [row.split("|") for row in text.splitlines() if row.startswith(f"| {name} |")]
    assert rows
    stated = " ".join(row[4] for row in rows)
    curves = all_published_curves()
    curves = curves[curves["algorithm"] == name]
    found = {
        (key[0], published.action_repeat(name, *key, int(part["n_seeds"].min())))
        for key, part in curves.groupby(["suite", "task"])
    }
    repeats = {repeat for _, repeat in found}
    assert (0 in repeats) == ("stated" in stated)
    assert {str(repeat) for repeat in repeats - {0}} <= set(re.findall(r"\d", stated))
    for suite, word in (("gymnasium", "MuJoCo"), ("myosuite", "MyoSuite")):
        if match := re.search(rf"\({word} (\d)\)", stated):
            assert {repeat for which, repeat in found if which == suite} <= {int(match[1])}


def test_differences_are_named() -> None:
    def named(algorithm: str, task: str, metric: str = "return", ours: int = 1) -> list[str]:
        data = published_curves(task)
        curve = Curve(algorithm, data[(data["algorithm"] == algorithm) & (data["metric"] == metric)], published=True)
        return published.differences(curve, task, metric, [ours])

    assert named("BRO (RR=10)", CHEETAH) == [] and named("BRO (RR=10)", CHEETAH, ours=2) == ["action repeat 1"]
    assert named("BRO (RR=10)", "dmc/cartpole-swingup-v0") == ["action repeat not stated"]
    assert named("SimbaV2 (RR=2)", CHEETAH) == ["action repeat 2"] and named("SimbaV2 (RR=2)", CHEETAH, ours=2) == []
    assert named("SimbaV2 (RR=2)", "HalfCheetah-v5") == ["of the v4 task"]
    assert named("TD-MPC2", PUSH, "success_rate") == [
        "3 seeds only", "action repeat 2", "success at the last step", "of the v2 task",
    ]  # fmt: skip
    assert named("FlashSAC", "myosuite/pose-v0", "success_rate") == ["success at any or the last step: not stated"]
    assert named("TD-MPC2", "myosuite/pose-v0", "success_rate")[:1] == ["3 seeds only"]


def test_frames_that_wrappers_skip_are_an_action_repeat() -> None:
    given = {"env_wrapper": "sb3_sample.envs.AtariFrames"}
    assert repeats_of(made_up(runs("a", CHEETAH, [1]) + runs("b", OWN, [1], **given))) == {CHEETAH: {1}, OWN: {4}}
    both = runs("a", OWN, [1], env_kwargs={"action_repeat": 3}, env_wrapper=[{"my.FrameSkip": {"skip": 2}}])
    assert repeats_of(made_up(both)) == {OWN: {6}}


def test_the_published_runs_of_other_tasks_are_left_out(tmp_path: Path) -> None:
    text = text_of(written(tmp_path / "r.html", made_up(runs("a", OWN, [1, 2])), published=["BRO"]))
    assert "The published runs have none of the tasks here, and are left out." in text
    # Of our two tasks one: in the curves of the task, in no average.
    rows = runs("a", CHEETAH, [1, 2], steps=(25_000, 50_000)) + runs(
        "a", "HalfCheetah-v5", [1, 2], steps=(25_000, 50_000)
    )
    text = text_of(written(tmp_path / "r.html", made_up(rows), published=["BRO"]))
    assert "BRO, published is in no average: it has 1 of the 2 tasks." in text


# ---------------------------------------------------------------- Markdown and the command


def test_a_page_of_markdown_keeps_what_stands_around_the_report(tmp_path: Path) -> None:
    page = tmp_path / "docs" / "results.md"
    given = {"title": "Ours", "markdown": page, "pictures": tmp_path / "docs" / "images", "reps": 20, "curves": []}
    study.report(two_agents(), **given)
    text = page.read_text()
    assert text.startswith("<!-- begin: sb3-sample study report: Ours -->\n## Ours\n")
    assert "![" in text and "](images/training.png)" in text and (page.parent / "images" / "training.png").exists()
    assert "| good | all | 200 | 0.650 (" in text
    page.write_text(f"# Results\n\nWords.\n\n{text}\nMore words.\n")
    study.report(two_agents(), **given)
    assert page.read_text() == f"# Results\n\nWords.\n\n{text}\nMore words.\n"
    page.write_text("# Results\n")
    with pytest.raises(ValueError, match="has not both of them once"):
        study.report(two_agents(), **given)
    assert page.read_text() == "# Results\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "sources must be at least one"),
        (["nowhere"], "runs must be folders"),
        (["t.csv", "-o", "r.txt"], "path must end in .html, not 'r.txt'"),
        (["t.csv", "--markdown", "r.txt"], "markdown must end in .md, not 'r.txt'"),
        (["t.csv", "--pictures", "x"], "pictures are those of markdown"),
        (["t.csv", "--curves", "XYZ"], "curves must be of "),
        (["t.csv", "--published", "XYZ"], "agents must be of BRO"),
        (["t.csv", "--published", "x.csv"], "x.csv"),
        (["t.csv", "--steps", "1M"], "steps must be within those of the runs, up to 200, not 1,000,000"),
        (["t.csv", "--groups", "myosuite"], "groups must have a task of the runs, and there is none in myosuite"),
        (["t.csv", "--groups", "gym"], "groups must be of all"),
        (["t.csv", "--reps", "0"], "reps must be"),
    ],
)
def test_refusals_are_one_line(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    study.write(two_agents(), "t.csv")
    with pytest.raises(SystemExit) as error:
        cli.main(["study", "report", *arguments])
    told = capsys.readouterr().err.strip()
    assert error.value.code == 2 and "\n" not in told
    assert told.startswith("sb3-sample study report: ") and message in told
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]


def test_the_command_writes_both(tmp_path: Path, monkeypatch: Any, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    study.write(two_agents(), "t.csv")
    cli.main(["study", "report", "t.csv", "--curves", "none", "--reps", "5", "--title", "T"])
    assert capsys.readouterr().out == "Saved to report.html\n" and "<h1>T</h1>" in Path("report.html").read_text()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cli.main(
            ["study", "report", "t.csv", "--markdown", "x/r.md", "--reps", "5", "--groups", "all", "--curves", "none"]
        )
    assert Path("x/r.md").read_text().count("## t\n") == 1 and Path("x/r_files/tasks.png").exists()
