"""``sb3-sample scaling`` on made-up runs."""

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
import pytest

from sb3_sample import cli, study
from sb3_sample.study import scaling
from sb3_sample.study.reporting import figures as report_figures
from sb3_sample.study.reporting import laws as report_laws
from sb3_sample.study.reporting import pieces
from sb3_sample.study.scaling import figures, page
from sb3_sample.study.table import COLUMNS, to_json


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of a known law at four replay ratios, as a sweep of the command's plan makes them."""
    rng = np.random.default_rng(0)
    parts = []
    for ratio in (1.0, 2.0, 4.0, 8.0):
        for batch, rate in ((64, 3e-4), (128, 3e-4), (256, 3e-4), (128, 1.5e-4), (128, 6e-4)):
            slower = 1 + 0.2 * np.log(batch / 128) ** 2 + 0.2 * np.log(rate / 3e-4) ** 2
            steps_to = 1e5 * (1 + (1.5 / ratio) ** 0.8) * slower
            steps = 10_000 * np.arange(1, 61)
            for seed in range(3):
                values = 1_000 * (1 - 0.5 ** (steps / (steps_to * np.exp(rng.normal(0, 0.1)))))
                arguments = {"replay_ratio": ratio, "batch_size": batch, "learning_rate": rate, "model_size": "0.55M"}
                head = {"agent": f"B{batch} lr{rate}", "arguments": to_json(arguments), "task": "dmc/walker-run-v0"}
                parts.append(pd.DataFrame({**head, "seed": seed, "step": steps, "metric": "return", "value": values}))
    path = tmp_path_factory.mktemp("scaling") / "runs.csv"
    study.write(pd.concat(parts, ignore_index=True).astype({"seed": "Int64"})[COLUMNS], path)
    return path


LEVELS = ["--levels", "300", "400", "500", "600", "700", "--reps", "40"]


def test_from_runs_to_settings(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    laws, file = tmp_path / "laws.json", tmp_path / "page.md"
    cli.main(["scaling", "fit", f"BRO={table}", *LEVELS, "-o", str(laws), "--page", str(file)])
    text = file.read_text()
    for words in ("batch_size: intercept", "learning_rate: intercept", "d_min", "held out", "one task", "3 seeds"):
        assert words in text, words
    assert "nan" not in text
    capsys.readouterr()
    cli.main(["scaling", "predict", str(laws), "--replay-ratio", "16", "--level", "500"])
    said = capsys.readouterr().out
    assert "-params replay_ratio:16 batch_size:" in said and "learning_rate:" in said and "extrapolated" in said
    cli.main(["scaling", "predict", str(laws), "--data", "3e5", "--level", "500", "--json"])
    assert '"params": "replay_ratio:' in capsys.readouterr().out


def test_errors_are_one_line(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    laws = tmp_path / "laws.json"
    laws.write_text("{}")
    plan = ["plan", str(tmp_path / "plan.yml"), "--tasks", "Pendulum-v1", "--steps"]
    for command, words in (
        (["fit", str(table), *LEVELS], "agent must be given"),
        (["fit", f"BRO={table}", "--levels", "5000"], "give a level that they reach"),
        (["fit"], "sources must be at least one folder"),
        (["fit", f"BRO={table}", "--delta", "-1", *LEVELS], "delta above 0"),
        (["predict", str(laws), "--budget", "1e15"], "is no file of scaling laws"),
        (
            ["predict", "nowhere.json", "--budget", "1e15"],
            "laws must be a file that sb3-sample scaling fit -o has written, and 'nowhere.json' is not there",
        ),
        ([*plan, "1e4", "--evaluations", "0"], "evaluations must be at least 1, not 0"),
        ([*plan, "1e4", "--episodes", "0"], "episodes must be at least 1, not 0"),
        ([*plan, "1e4", "--seeds", "-1"], "seeds must be at least 1, not -1"),
        ([*plan, "inf"], "steps must be a finite number, at least that of the evaluations, 40, not inf"),
        ([*plan, "nan"], "steps must be a finite number, at least that of the evaluations, 40, not nan"),
        ([*plan, "39"], "steps must be a finite number, at least that of the evaluations, 40, not 39"),
    ):
        with pytest.raises(SystemExit) as error:
            cli.main(["scaling", *command])
        said = capsys.readouterr().err
        assert error.value.code == 2 and words in said and "Traceback" not in said, (command, said)


@pytest.fixture(scope="module")
def measured(table: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with what they have measured: a gradient of 1 with a noise of 40 times the replay ratio."""
    runs = study.load(table)
    parts = [runs]
    for (_, arguments, seed), rows in runs.groupby(["agent", "arguments", "seed"]):
        noise = 40 * json.loads(str(arguments))["replay_ratio"]
        for metric, value in (
            ("gradient_square_64", 1 + noise / 64), ("gradient_square_1024", 1 + noise / 1024),
            ("overfitting_newest", noise), ("parameter_norm_critic", 1.0),
        ):  # fmt: skip
            parts.append(rows.assign(metric=f"diagnostics/{metric}", value=value * (0.9 + 0.1 * seed)))
    path = tmp_path_factory.mktemp("measured") / "runs.csv"
    study.write(pd.concat(parts, ignore_index=True)[COLUMNS], path)
    return path


@pytest.mark.slow
def test_the_figures(measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    cli.main(["scaling", "plot", f"BRO={measured}", *LEVELS, "-o", str(tmp_path / "figures")])
    names = {path.stem.rpartition("figure_")[2].partition("_")[0] for path in (tmp_path / "figures").iterdir()}
    assert names == {"1", "2", "3", "4", "5", "6", "7", "9", "10", "11"}
    assert "not drawn" not in capsys.readouterr().out


def options(**more: object) -> argparse.Namespace:
    """Of ``scaling plot``, as far as the figures need them."""
    names = ("resets", "choice_level", "critic_params", "agent", "size", "batch_size")
    given = {"delta": 1e10, "loss": "log", "score": [], "keep_after_reset": False, "seed": 0}
    return argparse.Namespace(**dict.fromkeys(names), **given | more)


def test_bounds_are_told_from_data(table: Path) -> None:
    pytest.importorskip("matplotlib")
    rows = study.read(f"BRO={table}")
    first = rows["arguments"].str.contains('"replay_ratio": 1[,}]')
    # At the smallest replay ratio the runs end before the level.
    rows = rows[~first | (rows["step"] <= 60_000)].reset_index(drop=True)
    rows = rows[rows["arguments"].str.contains('"batch_size": 128') & rows["arguments"].str.contains("0.0003")]
    # A fifth replay ratio: three are reached without the largest too.
    fifth = rows[rows["arguments"].str.contains('"replay_ratio": 8[,}]')]
    fifth = fifth.assign(arguments=fifth["arguments"].str.replace('"replay_ratio": 8', '"replay_ratio": 16'))
    rows = pd.concat([rows, fifth], ignore_index=True)
    laws = scaling.fit(rows, [300, 500, 700], reps=4)
    last = laws.levels[-1]
    assert last.censored.tolist() == [True, False, False, False, False]
    fitted = last.law().steps(np.array(laws.replay_ratios))
    assert fitted[0] > 2 * last.points[0]
    worst = page.parts(laws)[0].table["worst fit"].iloc[-1]
    assert worst == f"{np.abs(fitted / last.points - 1)[1:].max():.1%}"
    # A law below a bound is in error.
    low = dataclasses.replace(last, points=np.where(last.censored, 2 * fitted, last.points))
    below = dataclasses.replace(laws, levels=[*laws.levels[:-1], low])
    assert page.parts(below)[0].table["worst fit"].iloc[-1] == "50.0%"

    def drawn(axes: Any) -> dict[str, tuple[str, list[float]]]:
        found = [line for line in axes.get_lines() if line.get_marker() not in (None, "None", "")]
        return {line.get_label(): (line.get_marker(), list(line.get_xdata())) for line in found}

    assert drawn(figures.steps_and_compute(laws).axes[0]) == {
        "runs": ("o", [2.0, 4.0, 8.0, 16.0]), "a lower bound": ("^", [1.0]),
    }  # fmt: skip
    nine = figures.levels(laws).axes[0]
    legend = [text.get_text() for text in nine.get_legend().get_texts()]
    assert legend == ["300", "500", "700", "a lower bound"]
    left, right = figures.extrapolation(laws, rows, options()).axes
    assert left.get_title() == "J = 700, sigma = 1 held out: above the bound" and "%" in right.get_title()
    assert drawn(left)["held out, a bound"] == ("^", [1.0]) and drawn(right)["held out"] == ("x", [16.0])
    figure = report_laws.scaling(laws).parts[1]
    assert isinstance(figure, pieces.Figure) and "lower bounds hollow triangles" in figure.caption
    points = [line for line in figure.panels[0].lines if len(line.x) == 1][-5:]
    assert [line.bound for line in points] == [True, False, False, False, False]
    assert report_figures.png(figure).startswith(b"\x89PNG")


def test_figures_have_environment_steps(measured: Path) -> None:
    pytest.importorskip("matplotlib")
    rows = study.read(f"BRO={measured}")
    rows = rows[rows["arguments"].str.contains('"replay_ratio": [12][,}]')]
    texts = {text: to_json(json.loads(text) | {"env_kwargs": {"action_repeat": 2}}) for text in rows["arguments"]}
    repeated = rows.assign(arguments=rows["arguments"].map(texts))
    laws = mock.Mock(choice_level=500.0)
    for draw in (lambda table: figures.choice(laws, table, options()), figures.critical):
        one, other = (draw(each).axes[0] for each in (rows, repeated))
        assert one.get_xlabel() == "environment steps"
        one, other = (axes.get_lines()[0].get_xdata() for axes in (one, other))
        np.testing.assert_allclose(one, 10_000 * np.arange(1, 61))
        np.testing.assert_allclose(other, one / 2)


def test_what_was_not_recorded_is_not_drawn(table: Path) -> None:
    runs = study.read(f"BRO={table}")
    with pytest.raises(ValueError, match="the runs have recorded none of diagnostics/overfitting_newest, "):
        figures.logged(runs)
    with pytest.raises(ValueError, match="the runs have not recorded diagnostics/gradient_square_64 and "):
        figures.critical(runs)


def test_the_critical_batch_size_is_of_the_mean_squared_norms(measured: Path) -> None:
    pytest.importorskip("matplotlib")
    table = study.read(f"BRO={measured}")
    found = figures.squares(table)
    assert list(found) == [("dmc/walker-run-v0", ratio) for ratio in (1.0, 2.0, 4.0, 8.0)]
    for (_, ratio), means in found.items():
        # Seeds have 0.9, 1 and 1.1 of it: the mean is the whole.
        np.testing.assert_allclose(means[64], 1 + 40 * ratio / 64)
        np.testing.assert_allclose(means[1024], 1 + 40 * ratio / 1024)
    lines = figures.critical(table).axes[0].get_lines()
    assert [line.get_label() for line in lines] == ["1", "2", "4", "8"]
    for line, ratio in zip(lines, (1, 2, 4, 8), strict=True):
        np.testing.assert_allclose(line.get_ydata(), 40 * ratio)
    laws = scaling.fit(table, [300, 400, 500, 600, 700], reps=4)
    (points,) = figures.critical_and_best(laws, table).axes[0].get_lines()
    np.testing.assert_allclose(points.get_xdata(), [40, 80, 160, 320])
    best = laws.hyperparameters["batch_size"].values
    np.testing.assert_allclose(points.get_ydata(), best["value"])
    # Where no gradient is left beside the noise there is no number.
    lost = table.assign(value=np.where(table["metric"].str.endswith("_1024"), 0.01, table["value"]))
    assert np.isnan(figures.critical(lost).axes[0].get_lines()[0].get_ydata()).all()
    with pytest.raises(ValueError, match="no task and replay ratio has both"):
        figures.critical_and_best(laws, lost)


def test_online_returns(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = study.load(table)
    path, poor = tmp_path / "runs.csv", runs.assign(value=0.0)
    study.write(pd.concat([poor, runs.assign(metric="online_return")], ignore_index=True), path)
    for source in (f"BRO={table}", f"BRO={path}"):
        cli.main(["scaling", "fit", source, *LEVELS, *(["--online"] if source.endswith(str(path)) else [])])
    first, second = capsys.readouterr().out.split("# Scaling laws of")[1:]
    assert first == second
    with pytest.raises(
        SystemExit, match="online needs the Monitor files of all runs, and BRO on dmc/walker-run-v0, seed 0"
    ):
        cli.main(["scaling", "fit", f"BRO={table}", *LEVELS, "--online"])
    with pytest.raises(SystemExit, match="published runs have no online returns"):
        cli.main(["scaling", "fit", f"BRO={table}", "-p", "BRO", *LEVELS, "--online"])


def test_the_laws_are_in_the_report(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("jinja2")
    pytest.importorskip("rliable.library")
    file = tmp_path / "laws.json"
    cli.main(["scaling", "fit", f"BRO={table}", *LEVELS, "-o", str(file)])
    said = capsys.readouterr().out
    command = ["study", "report", str(table), "--curves", "none", "--reps", "5", "--laws", str(file)]
    with mock.patch.object(report_figures, "png", lambda figure: figure.name.encode()):
        cli.main([*command, "--markdown", str(tmp_path / "report.md")])
    page = (tmp_path / "report.md").read_text()
    assert (tmp_path / "report_files" / "scaling.png").exists()
    section = page.partition("Scaling laws")[2].partition("Costs")[0]
    # Every number of the page of "fit".
    rows = [line for line in said.splitlines() if line.startswith("| ") and "---" not in line]
    assert len(rows) > 20
    plain = section.replace("\\", "")
    for row in rows:
        for cell in row.strip("| ").split(" | "):
            assert cell in plain, cell
    for limit in said.partition("## Limits")[2].partition("Saved")[0].strip().splitlines():
        assert limit.removeprefix("- ") in plain
    (tmp_path / "none.json").write_text("{}")
    with pytest.raises(SystemExit, match="is no file of scaling laws"):
        cli.main([*command[:-1], str(tmp_path / "none.json"), "-o", str(tmp_path / "r.html")])


def test_the_reports_figure_has_laws_and_points(table: Path) -> None:
    pytest.importorskip("matplotlib")
    laws = scaling.fit(study.read(f"BRO={table}"), [300, 500, 700], reps=4)
    figure = report_laws.scaling(laws).parts[1]
    assert isinstance(figure, pieces.Figure) and len(figure.panels) == 3
    steps = figure.panels[0]
    assert isinstance(steps, pieces.Lines)
    for level in laws.levels:
        lines = [line for line in steps.lines if line.agent.name == f"level {level.level:.0f}"]
        assert [len(line.x) for line in lines] == [60, 1, 1, 1, 1]
        assert [line.y[0] for line in lines[1:]] == level.points.tolist()
        np.testing.assert_allclose(lines[0].y, level.law().steps(np.array(lines[0].x)))
    assert report_figures.png(figure).startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_plan_is_one_that_study_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rl_zoo3")
    path = tmp_path / "sweep.yml"
    command = [
        "scaling",
        "plan",
        str(path),
        "--tasks",
        "Pendulum-v1",
        "--replay-ratios",
        "1",
        "2",
        "4",
        "--steps",
        "3e4",
    ]
    cli.main([*command, "--measure", "1e3", "-params", "model_size:0.55M", "resets:[]"])
    assert capsys.readouterr().out.startswith("45 runs of 30,000 steps")
    runs = study.read_plan(path).runs
    assert {run.measure for run in runs} == {1_000}
    pairs = {(run.arguments["batch_size"], run.arguments["learning_rate"]) for run in runs}
    assert pairs == {(64, 3e-4), (128, 3e-4), (256, 3e-4), (128, 1.5e-4), (128, 6e-4)}
    with pytest.raises(SystemExit):
        cli.main(command)
    assert "is there already" in capsys.readouterr().err
    path.unlink()
    cli.main([*command, "--full"])
    assert capsys.readouterr().out.startswith("81 runs")
    path.unlink()
    # No digit is lost, in values or names.
    rates = (1.2345678e-4, 1.2345679e-4, 3e-5)
    command[6:9] = ["0.3333333", "2"]
    cli.main([*command, "--measure", "12345", "--batch-sizes", "64", "--learning-rates", *map(repr, rates)])
    runs = study.read_plan(path).runs
    assert {run.arguments["learning_rate"] for run in runs} == set(rates)
    assert {run.grid["replay_ratio"] for run in runs} == {0.3333333, 2} and {run.measure for run in runs} == {12_345}
    assert {run.agent for run in runs} == {"bro B64 lr0.00012345678", "bro B64 lr0.00012345679", "bro B64 lr3e-05"}
    path.unlink()
    with pytest.raises(SystemExit):
        cli.main([*command, "-params", "model_size:7M"])
    assert "model_size" in capsys.readouterr().err and not path.exists()


def test_further_arguments_of_a_plan_are_those_of_train(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rl_zoo3")
    path = tmp_path / "sweep.yml"
    command = ["scaling", "plan", str(path), "--algo", "sac_sample", "--tasks", "Pendulum-v1", "--steps", "3e4"]
    command += ["--replay-ratios", "1", "--batch-sizes", "64", "--learning-rates", "1e-3"]
    params = [
        "policy_kwargs:dict(net_arch=dict(pi=[64, 64], qf=(32,)))", "action_noise:None", "tau:1e-2",
        "ent_coef:'auto_0.1'", "exploration:actor", "compile:False", "resets:[]",
    ]  # fmt: skip
    cli.main([*command, "-params", *params])
    (arguments,) = {run.seed: run.arguments for run in study.read_plan(path).runs if run.seed == 0}.values()
    assert {name: arguments[name] for name in arguments if name not in ("batch_size", "learning_rate")} == {
        "replay_ratio": 1, "policy_kwargs": {"net_arch": {"pi": [64, 64], "qf": [32]}}, "action_noise": None,
        "tau": 0.01, "ent_coef": "auto_0.1", "exploration": "actor", "compile": False, "resets": [],
    }  # fmt: skip
    path.unlink()
    capsys.readouterr()
    for wrong in ("tau:0.55 M", "tau", "tau:", ":1", "tau:print(1)", "tau:{1, 2}", "tau:1e999", "tau:dict([1])"):
        with pytest.raises(SystemExit) as error:
            cli.main([*command, "-params", wrong])
        said = capsys.readouterr().err
        assert error.value.code == 2 and said.count("\n") == 1
        assert "-params must be NAME:VALUE" in said and repr(wrong) in said and not path.exists()


@pytest.mark.parametrize(
    ("name", "n"),
    [
        ("small/scaling", 45),
        pytest.param("papers/scaling_dmc", 5600, marks=pytest.mark.slow),
        ("papers/scaling_gym", 1920),
    ],
)
def test_the_plans_that_are_shipped(name: str, n: int) -> None:
    pytest.importorskip("rl_zoo3")
    assert len(study.read_plan(Path(__file__).parents[2] / "studies" / f"{name}.yml").runs) == n
