"""Reports of the project's own runs in the pages of docs: every plan has its place, and results fill it."""

import importlib
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sb3_sample import study
from sb3_sample.study.table import COLUMNS

ROOT = Path(__file__).parents[2]


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "studies"))
    names = ("evidence_pages", "evidence", "published_grid", "rank_tests")
    yield importlib.import_module("evidence_pages")
    for name in names:
        sys.modules.pop(name, None)


def mark(side: str, title: str) -> str:
    return f"<!-- {side}: sb3-sample study report: {title} -->"


def runs(plan: str) -> pd.DataFrame:
    """A table of all runs of a plan whose returns are their seeds."""
    rows = [
        (run.agent, "{}", run.task, run.seed, step, "return", float(run.seed))
        for run in study.read_plan(ROOT / "studies" / "evidence" / f"{plan}.yml").runs
        for step in (25_000, 50_000)
    ]
    return pd.DataFrame(rows, columns=COLUMNS)


def grid(path: Path) -> None:
    """A ``bro_grid.npz`` of three tasks at BRO Fast's size and ratio, ten seeds with the returns 10 to 19."""
    tasks = ["cheetah-run", "walker-run", "dog-run"]
    returns = np.broadcast_to(np.arange(10, 20.0)[:, None], (1, 1, len(tasks), 10, 2))
    np.savez(
        path,
        returns=returns,
        n_runs=np.full((1, 1, len(tasks)), 10),
        env_steps=np.array([25_000, 50_000]),
        replay_ratio=np.array([2]),
        size=np.array(["0.55M"]),
        seed=np.arange(10),
        suite=np.array(["dmc"] * len(tasks)),
        task=np.array(tasks),
    )


def test_every_plan_of_the_queue_has_its_place(module: Any) -> None:
    queued = {name for name, _ in module.queue()}
    assert queued.isdisjoint(module.BY_PROGRAM)
    assert queued.union(module.BY_PROGRAM) == module.PAGES.keys() | module.ELSEWHERE.keys()
    for page in module.PAGES.values():
        text = (ROOT / "docs" / page.page).read_text(encoding="utf-8")
        assert text.count(mark("begin", page.title)) == text.count(mark("end", page.title)) == 1


@pytest.mark.slow
def test_results_are_put_into_their_page(module: Any, tmp_path: Path) -> None:
    plan, page_of = "bro_fast_seeds", module.PAGES["bro_fast_seeds"]
    title = page_of.title
    # Few bootstrap samples are enough here.
    module.PAGES[plan] = page_of._replace(options=(*page_of.options, "--reps", "50"))
    (tmp_path / "evidence").mkdir()
    page = tmp_path / "results.md"
    lines = ["before", *(f"<!-- {side}: table: {title} -->" for side in ("begin", "end")), "between"]
    page.write_text("\n".join([*lines, mark("begin", title), mark("end", title), "after\n"]))

    assert module.write(plan, tmp_path, None) == "no run has ended"
    study.write(runs(plan), tmp_path / "evidence" / f"{plan}.csv")
    assert "bro_grid.npz" in module.write(plan, tmp_path, None)
    assert page.read_text().count("\n") == 7

    grid(tmp_path / "bro_grid.npz")
    assert module.write(plan, tmp_path, tmp_path / "bro_grid.npz") is None
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n")
    # Ten ranks below ten others: one of the 184,756 ways to place them.
    assert "| 50,000 | dmc/cheetah-run-v0 | 10 | 4 (0 to 9) | 10 | 14 (10 to 19) | 0.00 | 0.00 |" in text
    assert "BRO Fast 0.55M, published" in text and "dog-run" not in text
    assert (tmp_path / "evidence" / plan / "tasks.png").exists()
    # Files are named as in the checkout.
    assert f"of docs/evidence/{plan}.csv, published.csv;" in text and str(tmp_path) not in text


def test_return_and_success_by_task(module: Any) -> None:
    rows = [
        ("BRC", "{}", task, seed, step, metric, value * (seed + 1))
        for seed in (0, 1)
        for task, metric, step, value in (
            ("metaworld/push-v3", "return", 0, 2.0),
            ("metaworld/push-v3", "return", 5_000, 1_000.0),
            ("metaworld/push-v3", "success_rate", 0, 0.0),
            ("metaworld/push-v3", "success_rate", 5_000, 0.25),
            ("metaworld/reach-v3", "return", 0, 4.0),
            ("metaworld/reach-v3", "return", 5_000, 1_200.0),
            ("metaworld/reach-v3", "success_rate", 0, 0.0),
            ("metaworld/reach-v3", "success_rate", 5_000, 0.5),
        )
    ]
    assert module.by_task(pd.DataFrame(rows, columns=COLUMNS), None).splitlines() == [
        "| task | return, 0 | return, 5,000 | success, 0 | success, 5,000 |",
        "| --- | ---: | ---: | ---: | ---: |",
        "| metaworld/push-v3 | 3 | 1,500 | 0.00 | 0.38 |",
        "| metaworld/reach-v3 | 6 | 1,800 | 0.00 | 0.75 |",
        "| mean | 4 | 1,650 | 0.00 | 0.56 |",
    ]


def test_evaluations_that_are_not_there_are_blank(module: Any) -> None:
    rows = [("a", "{}", "t", 0, 10, "return", 1.0), ("a", "{}", "t", 0, 20, "return", 2.0)]
    agents = pd.DataFrame([*rows, ("b", "{}", "t", 0, 10, "return", 3.0)], columns=COLUMNS)
    assert module.by_agent(agents, None).splitlines()[2:] == ["| a | 1 | 2 |", "| b | 3 |  |"]
    tasks = pd.DataFrame([*rows, ("a", "{}", "u", 0, 10, "return", 3.0)], columns=COLUMNS)
    assert module.by_task(tasks, None).splitlines()[2:] == ["| t | 1 | 2 |", "| u | 3 |  |", "| mean | 2 |  |"]


def test_a_table_in_a_page(module: Any, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    marks = ["<!-- begin: table: A -->", "<!-- end: table: A -->"]
    page.write_text(f"# Before\n\n{marks[0]}\nold\n{marks[1]}\n\nafter\n")
    for _ in range(2):
        module.put(page, "A", "| a |\n| --- |")
        assert page.read_text().splitlines() == ["# Before", "", marks[0], "| a |", "| --- |", marks[1], "", "after"]
    before = page.read_text()
    with pytest.raises(ValueError, match="must have a line <!-- begin: table: B -->"):
        module.put(page, "B", "| b |")
    assert page.read_text() == before


def test_unknown_plan_and_missing_grid_are_refused(module: Any, capsys: pytest.CaptureFixture[str]) -> None:
    for given, said in ((["bro_fats"], "no page for bro_fats"), (["--grid", "nowhere.npz"], "no file nowhere.npz")):
        with pytest.raises(SystemExit):
            module.main(given)
        assert said in capsys.readouterr().err


def test_figure_1_by_hand() -> None:
    """Updates of 16 steps: 31.25 in between, which gain 95 and 10."""
    returns = {0: (100.0, 195.0), 1: (50.0, 60.0)}
    rows = [
        ("T16 N2", "{}", "CartPole-v0", seed, step, "return", value)
        for seed, values in returns.items()
        for step, value in zip((500, 1_000), values, strict=True)
    ]
    figure = runpy.run_path(str(ROOT / "benchmarks" / "rewound_actions.py"))["figure"]
    line = figure(pd.DataFrame(rows, columns=COLUMNS)).splitlines()[-1]
    # Of two seeds the interval's ends are those of one.
    assert line == "| T16 N2 | 2 | 1.00 (1.00 to 1.00) | 1 | 1.68 (0.32 to 3.04) |"
