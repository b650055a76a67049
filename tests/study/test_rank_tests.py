"""Rank tests of two sets of runs, against numbers worked by hand."""

import runpy
from math import comb, log
from pathlib import Path

import pandas as pd
import pytest

from sb3_sample import study
from sb3_sample.study.table import COLUMNS

SCRIPT = str(Path(__file__).parents[2] / "studies" / "rank_tests.py")


def table(agent: str, returns: dict[str, list[float]], step: int = 50_000) -> pd.DataFrame:
    rows = [
        (agent, "{}", task, seed, at, "return", value + 100 * (at != step))
        for task, values in returns.items()
        for seed, value in enumerate(values)
        for at in (25_000, step)
    ]
    return pd.DataFrame(rows, columns=COLUMNS)


def test_p_values_by_hand() -> None:
    """
    Of the 20 ways to place three of six ranks, one has all lower: p = 1/20, two-sided 1/10. Of k = p² Fisher's method
    makes k (1 - ln k).
    """
    ours = table("ours", {"dmc/a-v0": [1, 2, 3], "dmc/b-v0": [10, 30, 20], "dmc/only-v0": [0]})
    others = table("others", {"dmc/a-v0": [6, 5, 4], "dmc/b-v0": [50, 60, 40]})
    found = runpy.run_path(SCRIPT)["rank_tests"](ours, others, 50_000).set_index("task")
    assert list(found.index) == ["dmc/a-v0", "dmc/b-v0", "all"]
    assert found.loc[["dmc/a-v0", "dmc/b-v0"], "p_lower"].tolist() == pytest.approx([1 / 20] * 2)
    assert found.loc[["dmc/a-v0", "dmc/b-v0"], "p"].tolist() == pytest.approx([1 / 10] * 2)
    for name, p in (("p_lower", 1 / 20), ("p", 1 / 10)):
        assert found.loc["all", name] == pytest.approx(p**2 * (1 - log(p**2)))
    assert found.loc["dmc/b-v0", ["n", "mean", "low", "high"]].tolist() == [3, 20, 10, 30]
    assert found.loc["dmc/b-v0", ["n_others", "mean_others", "low_others", "high_others"]].tolist() == [3, 50, 40, 60]


def test_ten_runs_against_ten_are_exact_unless_returns_are_equal() -> None:
    """One of the 184,756 ways to place ten of twenty ranks has all lower; SciPy's approximation is 17 times that."""
    rank_tests = runpy.run_path(SCRIPT)["rank_tests"]
    ours = table("ours", {"dmc/a-v0": list(range(10)), "dmc/b-v0": list(range(10))})
    others = table("others", {"dmc/a-v0": list(range(10, 20)), "dmc/b-v0": [9, *range(11, 20)]})
    found = rank_tests(ours, others, 50_000).set_index("task")
    assert found.loc["dmc/a-v0", "p_lower"] == pytest.approx(1 / comb(20, 10))
    assert found.loc["dmc/a-v0", "p"] == pytest.approx(2 / comb(20, 10))
    assert found.loc["dmc/b-v0", "p_lower"] == pytest.approx(1e-4, rel=0.2)


def test_tables_without_a_comparison_are_refused() -> None:
    rank_tests = runpy.run_path(SCRIPT)["rank_tests"]
    ours, others = table("ours", {"dmc/a-v0": [1]}), table("others", {"dmc/a-v0": [2]})
    with pytest.raises(ValueError, match="no task has 'return' at step 75,000 in both"):
        rank_tests(ours, others, 75_000)
    with pytest.raises(ValueError, match="first table must have one agent, not ours, others"):
        rank_tests(pd.concat([ours, others]), others, 50_000)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    study.write(table("ours", {"dmc/a-v0": [1, 2, 3], "dmc/only-v0": [0]}), tmp_path / "ours.csv")
    study.write(table("others", {"dmc/a-v0": [4, 5, 6]}), tmp_path / "others.csv")
    files = [str(tmp_path / "ours.csv"), str(tmp_path / "others.csv")]
    monkeypatch.setattr("sys.argv", ["x", *files, "--step", "25k", "50k"])
    runpy.run_path(SCRIPT, run_name="__main__")
    p = "p 0.100, lower 0.050"
    assert capsys.readouterr().out.splitlines() == [
        "In one table only: dmc/only-v0",
        f"25,000 steps, dmc/a-v0:  3 seeds, mean 102 (101 to 103);  3 seeds, mean 105 (104 to 106);  {p}",
        f"25,000 steps, all:  {p}",
        f"50,000 steps, dmc/a-v0:  3 seeds, mean 2 (1 to 3);  3 seeds, mean 5 (4 to 6);  {p}",
        f"50,000 steps, all:  {p}",
    ]


def test_a_table_in_markdown() -> None:
    module = runpy.run_path(SCRIPT)
    ours, others = table("ours", {"dmc/a-v0": [1, 2, 3]}), table("others", {"dmc/a-v0": [4, 5, 6]})
    text = module["markdown"]({step: module["rank_tests"](ours, others, step) for step in (25_000, 50_000)})
    lines = text.splitlines()
    assert lines[4] == "| 50,000 | dmc/a-v0 | 3 | 2 (1 to 3) | 3 | 5 (4 to 6) | 0.10 | 0.05 |" and len(lines) == 6
