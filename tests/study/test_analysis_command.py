"""The commands on tables: what they print, what they write and what they refuse."""

import argparse
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from sb3_sample import study
from sb3_sample.study.analysis_command import COMMANDS, _draw_cost, _readable_on, markdown, steps_of
from sb3_sample.study.plan import Comparison, Plan
from sb3_sample.study.plan import Run as Run_
from sb3_sample.study.runs import StudyFolder
from tests.study.made_up import made_up, write_run
from tests.study.test_analysis import CHEETAH, correlated, grid, sized

pytest.importorskip("rliable.library")
Run = Callable[..., str]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command as the command line does; gives what it prints. ``t.csv`` is the table."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str, table: pd.DataFrame | None = None) -> str:
        if table is not None:
            study.write(table, "t.csv")
        _, add, command = COMMANDS[arguments[0]]
        parser = argparse.ArgumentParser()
        add(parser)
        capsys.readouterr()
        command(parser.parse_args(arguments[1:]))
        return capsys.readouterr().out

    return run


def test_the_commands_have_a_help_and_no_arguments_in_common_with_it() -> None:
    assert list(COMMANDS) == ["table", "aggregate", "marginalize", "correlate", "heatmap", "cost"]
    for words, add, _ in COMMANDS.values():
        parser = argparse.ArgumentParser()
        add(parser)
        assert words and "--output" in parser.format_help()


@pytest.mark.parametrize(
    ("text", "steps"),
    [
        ("100000", 100_000), ("100_000", 100_000), ("1e5", 100_000), ("0", 0), ("100k", 100_000), ("1.5M", 1_500_000),
        ("4.1M", 4_100_000), ("2.05M", 2_050_000), ("2.01M", 2_010_000), ("1.001M", 1_001_000), ("2.01k", 2_010),
    ],
)  # fmt: skip
def test_numbers_of_steps(text: str, steps: int) -> None:
    assert steps_of(text) == steps


@pytest.mark.parametrize("text", ["", "k", "x", "-1", "1.5", "1.0005k", "nan", "inf", "1e999999999", "1kk"])
def test_texts_that_are_no_numbers_of_steps(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=f"'{text}' is no number of steps, as 100000, 100k or 1M"):
        steps_of(text)


def test_a_table_of_runs(run: Run, tmp_path: Path) -> None:
    for seed in (0, 1):
        write_run(tmp_path / "runs" / str(seed), seed=seed, log=[{"step": 3_000, "train/x": 1}])
    out = run("table", "runs", "--metrics", "train/*", "-o", "x.csv")
    assert "| agent | task | metric | runs | rows | last_step |" in out
    assert "| bro | dmc/cheetah-run-v0 | return | 2 | 6 | 3,000 |" in out and "train/x | 2 | 2 | 3,000 |" in out
    pd.testing.assert_frame_equal(study.load("x.csv"), study.read(["runs"], [*study.table.METRICS, "train/*"]))
    assert "| me | dmc/cheetah-run-v0 | return | 2 |" in run("table", "me=runs")
    assert "| TD7 | dmc/cheetah-run-v0 | return/mean |" in run("table", "--curves", "TD7")


def test_groups_and_factors_of_the_plan(run: Run, tmp_path: Path) -> None:
    runs = [
        Run_(name, "bro", {"a": a, "b": b}, {"a": a, "b": b}, task, 0, 3_000)
        for name, task in (("x", CHEETAH), ("x", "dmc/dog-run-v0"))
        for a in (1, 2)
        for b in (1, 2)
    ]
    comparison = Comparison({"mine": [CHEETAH], "dogs": ["dmc/dog-run-v0", "dmc/dog-walk-v0"]}, {"both": ["a", "b"]})
    folder = StudyFolder("s")
    folder.enter(Plan("s", tuple(runs), comparison=comparison))
    for each in runs:
        values = [10.0 * each.arguments["a"]] * 3
        write_run(folder.place(each), each.task, values=values, arguments=each.arguments)
    out = run("marginalize", "s", "--reps", "5")
    assert "| group | both |" in out and "| mine | a=1, b=1 | 0.010 |" in out and "| dogs | a=2, b=1 | 0.020 |" in out
    assert "| all |" not in out
    out = run("marginalize", "s", "--factor", "a", "--groups", "mine", "dmc", "--reps", "5")
    assert "| group | a |" in out and "| mine | 1 | 0.010 |" in out and "| dmc | 2 | 0.020 |" in out
    assert "| dogs |" not in out
    out = run("aggregate", "s/runs", "--steps", "3k", "--reps", "5")
    assert "| mine | 3,000 |" in out and "| all | 3,000 |" not in out
    assert "0.015" in run("heatmap", "s", "-x", "b", "-y", "b", "--group", "mine")
    # A group with a task of which there is no run.
    out = run("heatmap", "s", "-x", "b", "-y", "b", "--group", "dogs")
    assert "At 3,000 simulator steps:" in out and "0.015" in out
    assert "| mine | 3,000 |" in run("aggregate", "s", "--steps", "3k", "--common", "--reps", "5")
    assert study.comparison(["s", "label=s/runs"]) == comparison
    with pytest.raises(SystemExit):
        run("aggregate", "s", "--steps", "3k", "--groups", "metaword")
    other = StudyFolder("other")
    other.enter(Plan("o", tuple(runs), comparison=comparison._replace(groups={"mine": ["dmc/dog-run-v0"]})))
    with pytest.raises(ValueError, match="groups of the plans must be the same .* not 'mine'"):
        study.comparison(["s", "other"])


def test_aggregates(run: Run) -> None:
    arguments = ("aggregate", "-p", "BRO", "BRO Fast", "--steps", "100k", "1M", "--groups", "all", "dmc", "--reps", "5")
    out = run(*arguments, "-o", "x/t.md")
    assert "| BRO | all | 100,000 | 0.254 |" in out and "| BRO Fast | dmc | 1,000,000 | 0.794 |" in out
    assert Path("x/t.md").read_text() in out
    run(*arguments, "-o", "t.csv")
    assert list(pd.read_csv("t.csv")["step"].unique()) == [100_000, 1_000_000]


def test_published_runs_are_not_pooled_with_ones_own_of_the_same_name(run: Run) -> None:
    mine = made_up([("BRO", {"replay_ratio": 10}, CHEETAH, 0, 25_000, "return", 999.0)])
    out = run(
        "aggregate", "t.csv", "--steps", "25k", "--groups", "all", "--reps", "3", "--common", "-p", "BRO", table=mine
    )
    assert "| BRO | all | 25,000 | 0.999 |" in out and "| BRO, published | all | 25,000 |" in out
    assert "| BRO | all | 25,000 |" in run("aggregate", "--steps", "25k", "--groups", "all", "--reps", "3", "-p", "BRO")


def test_profiles_and_improvement(run: Run) -> None:
    shared = ("aggregate", "-p", "BRO", "BRO Fast", "--groups", "myosuite", "--reps", "3", "--steps", "200_000")
    assert "| BRO | BRO Fast | myosuite | 200,000 | 0.6" in run(*shared, "--improvement")
    assert "| BRO | myosuite | 200,000 | 0.500 | 0." in run(*shared, "--profile", "0.5")


def test_marginalisation(run: Run) -> None:
    out = run("marginalize", "t.csv", "--groups", "all", "--reps", "3", table=grid())
    assert "| group | critic | network | mean |" in out and "| all | cdq |  | 0.231 |" in out
    out = run(
        "marginalize", "t.csv", "--groups", "all", "--order", "2", "--factor", "a=critic", "network", "--last", "1"
    )
    assert "| all | cdq | layer_norm | 0.261 |" in out
    assert "| all | cdq | none |" in run("marginalize", "t.csv", "--groups", "all", "--by", "critic", "--reps", "3")


def test_correlations(run: Run) -> None:
    shared = ("correlate", "t.csv", "--metrics", "diagnostics/over", "diagnostics/dormant_critic")
    out = run(*shared, "--groups", "dmc", "-o", "c.png", table=correlated())
    assert "| dmc | score | diagnostics/over | -0.900 | 0.037 | 5 |" in out
    assert Path("c.png").read_bytes().startswith(b"\x89PNG")
    assert "| dmc | score | diagnostics/over | - | 0.037 | 5 |" in run(*shared, "--groups", "dmc", "--level", "0.01")
    assert "| dmc/cheetah-run-v0 | diagnostics/over | True |" in run(*shared, "--regress")


def test_heatmaps_and_costs(run: Run) -> None:
    out = run("heatmap", "t.csv", "-x", "model_size", "-y", "replay_ratio", "-o", "h.svg", table=sized())
    assert "| replay_ratio \\ model_size | 0.55M | 4.92M | 26.3M |" in out and "| 2 | 0.302 | 0.402 | - |" in out
    assert "<svg" in Path("h.svg").read_text()
    assert "| 10 | 20.500 |" in run("heatmap", "t.csv", "-x", "model_size", "-y", "replay_ratio", "--value", "hours")
    out = run("cost", "t.csv", "--steps", "200", "--groups", "all", "--reps", "3", "-o", "c.png")
    assert "| hours | steps_per_second |" in out and "a (model_size=4.92M, replay_ratio=10)" in out
    assert Path("c.png").exists()


def test_a_picture_of_costs_names_each_agents_lines() -> None:
    """A has tasks of the first group only: in each group B has the colour that the legend says."""
    pytest.importorskip("matplotlib")
    row = {"step": 100, "iqm": 0.5, "low": 0.4, "high": 0.6}
    found = pd.DataFrame(
        [
            {"agent": agent, "group": group, "hours": hours, **row}
            for agent, group in (("A", "dmc"), ("B", "dmc"), ("B", "metaworld"), ("C", "metaworld"))
            for hours in (1.0, 2.0, 3.0)
        ]
    )
    figure = _draw_cost(found)
    (legend,) = figure.legends
    colors = {
        text.get_text(): line.get_color() for text, line in zip(legend.get_texts(), legend.get_lines(), strict=True)
    }
    assert list(colors) == ["A", "B", "C"] and len(set(colors.values())) == 3
    drawn = [[line.get_color() for line in axes.get_lines()] for axes in figure.axes]
    assert drawn == [[colors["A"], colors["B"]], [colors["B"], colors["C"]]]
    assert all(axes.get_legend() is None for axes in figure.axes)


@pytest.mark.parametrize("name", ["viridis", "RdBu_r"])
def test_numbers_in_cells_are_legible(name: str) -> None:
    colormaps = pytest.importorskip("matplotlib").colormaps
    found = [_readable_on(colormaps[name](share)) for share in (0.0, 0.5, 1.0)]
    assert found == {"viridis": ["white", "black", "black"], "RdBu_r": ["white", "black", "white"]}[name]


def test_scores_of_the_user(run: Run) -> None:
    rows = [("a", {}, "Pendulum-v1", seed, 1, "return", -600.0) for seed in (0, 1)]
    table = made_up([*rows, *[("a", {}, "My/T-v0", seed, 1, "success_rate", 0.25) for seed in (0, 1)]])
    out = run("aggregate", "t.csv", "--score", "Pendulum-v1=-1200:-200", "My/T-v0=success", "--reps", "3", table=table)
    assert "| a | all | 1 | 0.425 |" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["aggregate"], "sources must be at least one"),
        (["aggregate", "nowhere"], "runs must be folders"),
        (["aggregate", "t.csv", "--groups", "gym"], "groups must be of all"),
        (["aggregate", "t.csv", "-o", "t.txt"], "output must end in .csv, .parquet, .md, not 't.txt'"),
        (["aggregate", "t.csv", "--improvement"], "steps must be one step"),
        (["aggregate", "t.csv", "--steps", "1", "--improvement", "--profile", "1"], "ask for one of them"),
        (["aggregate", "t.csv", "--steps", "1", "--improvement", "--common"], "--common is not of"),
        (["aggregate", "-p", "SAC"], "agents must be of BRO"),
        (["marginalize", "t.csv", "--order", "3"], "order must be"),
        (
            ["correlate", "t.csv"],
            "not 'diagnostics/overestimation', which DiagnosticsCallback records: 'diagnostics: 10_000' in a plan",
        ),
        (["correlate", "t.csv", "--metrics", "return", "--regress", "--by", "x"], "--regress is task by task"),
        (["heatmap", "t.csv", "-x", "size", "-y", "critic"], "arguments must be of those"),
        (["cost", "t.csv"], "'hours' of at least one run"),
    ],
)
def test_refusals_are_one_line(
    run: Run, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit) as error:
        run(*arguments, table=grid())
    assert error.value.code == 2
    told = capsys.readouterr().err.strip()
    assert told.startswith(f"sb3-sample study {arguments[0]}: ") and message in told and "\n" not in told


@pytest.mark.parametrize(
    "command",
    [
        "aggregate",
        "aggregate --steps 200 --profile 0.5",
        "marginalize --factor agent",
        "correlate --metrics hours -o c.png",
        "cost",
    ],
)
def test_groups_without_a_task_of_the_runs(run: Run, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    name, *options = command.split()
    with pytest.raises(SystemExit) as error:
        run(name, "t.csv", *options, "--groups", "metaworld", table=sized())
    told = capsys.readouterr().err
    assert error.value.code == 2 and told.count("\n") == 1
    assert "groups must have a task of the runs, and there is none in metaworld" in told


@pytest.mark.parametrize(
    "arguments", [["--steps", "-1"], ["--steps", "1.5"], ["--steps", "x"], ["--score", "x"], ["--score", "x=y"]]
)
def test_bad_options(run: Run, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run("aggregate", *arguments)
    assert f"{arguments[1]!r} is no " in capsys.readouterr().err


def test_warnings_are_lines(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    table = made_up([(a, {}, CHEETAH, s, 10 * s, "return", 1.0) for a in "ab" for s in (1, 2)])
    with pytest.raises(SystemExit):
        run("aggregate", "t.csv", table=table)  # no step in common
    study.write(table, "t.csv")
    parser = argparse.ArgumentParser()
    COMMANDS["aggregate"][1](parser)
    COMMANDS["aggregate"][2](parser.parse_args(["t.csv", "--steps", "10", "--reps", "3"]))
    told = capsys.readouterr().err.splitlines()
    assert "sb3-sample study aggregate: 2 of 4 runs have no evaluations around step 10 and are left out there" in told


def test_numbers_as_markdown() -> None:
    table = pd.DataFrame({"a": [1.0, float("nan")], "b": [12_345, 1], "c": ["x|y", "z"], "d": [1e-9, 123_456.0]})
    assert markdown(table).splitlines() == [
        "| a | b | c | d |",
        "| ---: | ---: | --- | ---: |",
        "| 1.000 | 12,345 | x\\|y | 1e-09 |",
        "| - | 1 | z | 1.23e+05 |",
    ]
