"""Runs beside published curves, on made-up runs."""

import itertools
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sb3_sample import plots

ENV = "dmc/cheetah-run-v0"


def write_run(
    folder: Path, steps: Sequence[int], values: Sequence[float], env_id: str = ENV, successes: bool = False
) -> Path:
    """A run's folder as the zoo leaves it, evaluated at the steps; two episodes an evaluation, one above, one below."""
    write_monitor(folder, [1000], [0.0], env_id)
    results = np.array(values)[:, None] + [[-0.25, 0.25]]
    arrays: dict[str, Any] = {"timesteps": np.array(steps), "results": results}
    if successes:
        arrays["successes"] = results
    np.savez(folder / "evaluations.npz", **arrays)
    return folder


def write_monitor(folder: Path, lengths: Sequence[int], returns: Sequence[float], env_id: str = ENV) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    rows = "".join(f"{r},{n},{i}\n" for i, (n, r) in enumerate(zip(lengths, returns, strict=True), 1))
    (folder / "0.monitor.csv").write_text(f'#{{"t_start": 0.0, "env_id": "{env_id}"}}\nr,l,t\n{rows}')
    return folder


# ---------------------------------------------------------------- published curves


def test_published_curves_are_those_of_the_task() -> None:
    curves = plots.published_curves(ENV)
    bro = curves[curves["algorithm"] == "BRO (RR=10)"]
    assert list(bro["env_step"]) == list(range(25_000, 1_000_001, 25_000))
    assert (curves["metric"] == "return").all()
    assert ((curves["min"] <= curves["mean"]) & (curves["mean"] <= curves["max"])).all()
    assert (plots.published_curves("metaworld/push-v3")["metric"] == "success_rate").all()
    assert len(plots.published_curves("HalfCheetah-v5"))
    assert len(plots.published_curves("h1-balance_simple-v0"))  # HumanoidBench's own id
    assert not len(plots.published_curves("Pendulum-v1"))


def test_the_data_files_are_small() -> None:
    assert sum(file.stat().st_size for file in plots.DATA.parent.iterdir()) < 600_000


def test_bro_has_its_ten_seeds_where_its_authors_published_them() -> None:
    """Their 15 + 15 + 10 tasks, and reruns of five seeds elsewhere."""
    data = pd.read_csv(plots.DATA)
    for algorithm in ("BRO (RR=10)", "BRO Fast (RR=2)"):
        rows = data[data["algorithm"] == algorithm]
        ten = rows[rows["n_seeds"] == 10].groupby("suite")["task"].nunique()
        assert dict(ten) == {"dmc": 15, "metaworld": 15, "myosuite": 10}
        assert set(rows["n_seeds"]) == {5, 10}
    row = data[(data["task"] == "cheetah-run") & (data["algorithm"] == "BRO (RR=10)") & (data["env_step"] == 1_000_000)]
    # The last evaluations of the authors' ten runs.
    seeds = np.sort([898.55, 842.58, 852.64, 720.55, 743.99, 786.20, 871.13, 851.55, 839.18, 848.10])
    expected = [seeds.mean(), seeds.std(ddof=1), seeds[0], seeds[-1], seeds[2:8].mean()]
    assert row[["mean", "std", "min", "max", "iqm"]].iloc[0].tolist() == pytest.approx(expected, rel=1e-3)


def test_rows_are_curves() -> None:
    data = pd.read_csv(plots.DATA)
    assert not data.duplicated(["suite", "task", "algorithm", "env_step"]).any()
    assert not data.isna().any(axis=None) and (data["n_seeds"] >= 3).all()
    assert (data["env_step"] <= 2_000_000).all()
    for low, high in itertools.pairwise(("min", "iqm", "max")):
        assert (data[low] <= data[high]).all()
    rates = data[data["metric"] == "success_rate"]
    assert set(rates["suite"]) == {"metaworld", "myosuite"}
    assert (rates["min"] >= 0).all() and (rates["max"] <= 1).all()


def test_every_curve_has_a_source_and_a_licence_that_lets_it_be_used() -> None:
    lines = (plots.DATA.parent / "README.md").read_text().splitlines()
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")]
    header, *rows = [row for row in table if not set(row[0]) <= {"-", " "}]
    assert header[:3] == ["algorithm", "source", "licence"]
    assert {row[0] for row in rows} == set(pd.read_csv(plots.DATA)["algorithm"].unique())
    assert {row[2] for row in rows} == {"MIT", "Apache-2.0"}
    for licence in ("MIT", "Apache-2.0"):
        assert (plots.DATA.parent / f"LICENSE-{licence}.txt").read_text()


def test_curves_that_may_not_be_used_commercially_are_not_there() -> None:
    assert not any("mr.q" in name.lower() for name in pd.read_csv(plots.DATA)["algorithm"].unique())


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (None, ["BRO (RR=10)", "BRO Fast (RR=2)", "SAC"]),
        ([], []),
        (["bro fast"], ["BRO Fast (RR=2)"]),
        (["SimbaV2", "SimbaV2 (RR=2)"], [f"SimbaV2 (RR={n})" for n in (1, 2, 4, 8)]),
        (["SAC"], ["SAC"]),
        (["sac (td-mpc2 authors)"], ["SAC (TD-MPC2 authors)"]),
    ],
)
def test_published_curves_by_name(names: list[str] | None, expected: list[str]) -> None:
    assert [curve.label for curve in plots.select_published(ENV, names, "return")] == expected


def test_an_unknown_published_name_is_refused_with_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"published must be of BRO \(RR=10\), .*, not 'BROO'"):
        plots.select_published(ENV, ["BROO"], "return")


# ---------------------------------------------------------------- runs


def test_summary_over_seeds() -> None:
    values = [3.0, 1.0, 100.0, 2.0, 4.0]
    runs = [plots.Run("a", Path(str(v)), np.array([10, 20]), np.array([v, 2 * v])) for v in values]
    table = plots.summarize(runs)
    assert list(table["env_step"]) == [10, 20]
    first = table.iloc[0]
    assert (first["n_seeds"], first["mean"], first["min"], first["max"], first["iqm"]) == (5, 22, 1, 100, 3)
    assert first["std"] == pytest.approx(np.std(values, ddof=1))


def test_only_steps_of_all_seeds_count() -> None:
    long = plots.Run("a", Path("1"), np.array([10, 20, 30]), np.zeros(3))
    short = plots.Run("a", Path("2"), np.array([10, 20]), np.ones(2))
    assert list(plots.summarize([long, short])["env_step"]) == [10, 20]


def test_seeds_without_a_common_step_are_interpolated_where_both_reach() -> None:
    often = plots.Run("a", Path("1"), np.array([5, 15, 25, 35]), np.array([5.0, 15.0, 25.0, 35.0]))
    seldom = plots.Run("a", Path("2"), np.array([20, 40]), np.array([0.0, 0.0]))
    table = plots.summarize([often, seldom])
    assert list(table["env_step"]) == [20]
    assert list(table["max"]) == [20]
    apart = plots.Run("a", Path("3"), np.array([50, 60]), np.zeros(2))
    with pytest.raises(ValueError, match="must overlap"):
        plots.summarize([often, apart])


def test_a_run_reads_its_evaluations_and_else_its_training_episodes(tmp_path: Path) -> None:
    evaluated = plots.read_run(write_run(tmp_path / "bro/x_1", [10, 20], [1, 2]), "a", "return", 1)
    assert (list(evaluated.steps), list(evaluated.values)) == ([10, 20], [1, 2])
    folder = write_monitor(tmp_path / "bro/x_2", [10, 10, 10, 30], [1, 3, 5, 7])
    trained = plots.read_run(folder, "a", "return", 20)
    # Episodes end at 10, 20 | 30 | 60.
    assert (list(trained.steps), list(trained.values)) == ([20, 40, 60], [2, 5, 7])
    with pytest.raises(ValueError, match="metric must be one that was recorded, not 'success_rate'"):
        plots.read_run(folder, "a", "success_rate", 20)


def test_steps_are_of_the_simulator_as_those_of_the_published_curves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluated = write_run(tmp_path / "dr_q/x_1", [12_500, 25_000], [1, 2])
    trained = write_monitor(tmp_path / "dr_q/x_2", [10, 10, 10, 30], [1, 3, 5, 7])
    wrapped = write_run(tmp_path / "dr_q/x_3", [10], [1])
    for folder in (evaluated, trained, wrapped):
        settings = {"env_kwargs": "{'action_repeat': 2}"}
        if folder is wrapped:
            settings["env_wrapper"] = "{'rl_zoo3.wrappers.FrameSkip': {'skip': 3}}"
        record = {"algo": "dr_q", "env": ENV, "seed": 0, "settings": settings}
        (folder / "run.json").write_text(json.dumps(record))
    assert list(plots.read_run(evaluated, "a", "return", 1).steps) == [25_000, 50_000]
    assert list(plots.read_run(wrapped, "a", "return", 1).steps) == [60]
    run = plots.read_run(trained, "a", "return", 40)
    assert (list(run.steps), list(run.values)) == ([40, 80, 120], [2, 5, 7])
    plots.main([str(trained), "-o", str(tmp_path / "x.png"), "-p", "none"])
    # Bins of a twentieth of the 120 steps.
    assert "| 120 | dr_q | 1 | 7 |" in capsys.readouterr().out
    plots.main([str(evaluated), "-o", str(tmp_path / "x.png"), "-p", "DR.Q"])
    output = capsys.readouterr().out
    assert "| 50,000 | dr_q | 1 | 2 |" in output and "| 50,000 | DR.Q" in output and "| 12,500 |" not in output


# ---------------------------------------------------------------- command


def test_plot_groups_runs_by_algorithm_beside_the_published(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in (1, 2, 3):
        write_run(tmp_path / f"bro/dmc-cheetah-run-v0_{seed}", [25_000, 50_000], [100 * seed, 200 * seed])
    write_run(tmp_path / "sac/dmc-cheetah-run-v0_1", [25_000, 50_000], [10, 20])
    write_run(tmp_path / "sac/Pendulum-v1_1", [25_000], [5], "Pendulum-v1")
    picture = tmp_path / "out" / "picture.png"
    plots.main([str(tmp_path), "--env", ENV, "-o", str(picture), "--published", "BRO", "--xlim", "60000"])
    output = capsys.readouterr().out
    assert "| 50,000 | bro | 3 | 400 | 200 | 200 | 600 | 400 |" in output
    assert "| 50,000 | sac | 1 | 20 | - | 20 | 20 | 20 |" in output
    assert "| 50,000 | BRO (RR=10), published | 10 |" in output
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_run_that_has_just_begun_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_monitor(tmp_path / "bro/x_1", [1000, 1000], [1.0, 3.0])
    write_monitor(tmp_path / "bro/x_2", [], [])
    write_monitor(tmp_path / "sac/x_1", [], [])
    write_run(tmp_path / "sac/x_2", [1000, 2000], [5, 7])
    picture = tmp_path / "picture.png"
    plots.main([str(tmp_path), "-o", str(picture), "--published", "none"])
    output, errors = capsys.readouterr()
    assert "| 2,000 | bro | 1 | 3 |" in output and "| 2,000 | sac | 1 | 7 |" in output
    for run in ("bro/x_2", "sac/x_1"):
        assert f"{tmp_path / run} has no finished episode yet, and is left out" in errors
    with pytest.raises(SystemExit, match="at least one finished episode; none of them has"):
        plots.main([str(tmp_path / "bro/x_2"), "-o", str(picture)])
    # One that is just writing its evaluations.
    (tmp_path / "sac/x_1/evaluations.npz").write_bytes(b"PK")
    (tmp_path / "sac/x_1/checkpoint-000000000000").mkdir()
    plots.main([str(tmp_path), "-o", str(picture), "--published", "none"])
    assert f"{tmp_path}/sac/x_1/evaluations.npz is just being written" in capsys.readouterr().err
    # So is one that was interrupted before, and has a model of then.
    (tmp_path / "sac/x_1/Pendulum-v1.zip").touch()
    os.utime(tmp_path / "sac/x_1/Pendulum-v1.zip", (1, 1))
    plots.main([str(tmp_path), "-o", str(picture), "--published", "none"])
    assert f"{tmp_path}/sac/x_1/evaluations.npz is just being written" in capsys.readouterr().err


def test_plot_takes_labels_and_infers_the_environment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = write_run(tmp_path / "bro/1", [10], [1], "metaworld/push-v3", successes=True)
    second = write_run(tmp_path / "bro/2", [10], [0], "metaworld/push-v3", successes=True)
    plots.main([f"mine={first}", f"theirs={second}", "-o", str(tmp_path / "x.png"), "-p", "none"])
    output = capsys.readouterr().out
    assert "metaworld/push-v3, success rate" in output
    assert "| 10 | mine | 1 |" in output
    assert "| 10 | theirs | 1 |" in output


def test_the_agents_of_a_study_are_curves_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "study.json").write_text('{"runs": []}')
    for agent, value in (("Good,gamma=0.9", 900), ("Bad", 100)):
        for seed in (0, 1):
            write_run(tmp_path / "runs" / agent / "dmc-cheetah-run-v0" / str(seed), [25_000], [value])
    plots.main([str(tmp_path), "--env", ENV, "-o", str(tmp_path / "x.png"), "-p", "none"])
    output = capsys.readouterr().out
    assert "| 25,000 | Good,gamma=0.9 | 2 | 900 |" in output and "| 25,000 | Bad | 2 | 100 |" in output


def test_a_run_of_a_study_before_its_first_evaluation_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "study.json").write_text('{"runs": []}')
    runs = [tmp_path / "runs" / "A" / "dmc-cheetah-run-v0" / str(seed) for seed in (0, 1)]
    write_run(runs[0], [25_000, 50_000], [500, 600])
    write_monitor(runs[1], [1_000] * 60, [5.0] * 60)  # its episodes reach further than the evaluations
    plots.main([str(tmp_path), "-o", str(tmp_path / "x.png"), "-p", "none"])
    output, errors = capsys.readouterr()
    assert "| 25,000 | A | 1 | 500 |" in output and "| 50,000 | A | 1 | 600 |" in output
    assert f"{runs[1]} is before its first evaluation, and is left out" in errors
    with pytest.raises(SystemExit, match="if no run of their study has one"):
        plots.main([str(runs[1]), "-o", str(tmp_path / "x.png"), "-p", "none"])


def test_a_run_that_was_taken_out_of_the_plan_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    former = "A/dmc-cheetah-run-v0/2"
    (tmp_path / "study.json").write_text(json.dumps({"runs": [{"agent": "A"}], "former": {former: {}}}))
    for seed, value in enumerate((100, 100, 500)):
        write_run(tmp_path / "runs" / "A" / "dmc-cheetah-run-v0" / str(seed), [25_000], [value])
    plots.main([str(tmp_path), "-o", str(tmp_path / "x.png"), "-p", "none"])
    output, errors = capsys.readouterr()
    assert "| 25,000 | A | 2 | 100 |" in output
    assert f"{tmp_path / 'runs' / former} is not in its study's plan any more, and is left out" in errors
    with pytest.raises(SystemExit, match="runs must be in their study's plan; none of them is any more"):
        plots.main([str(tmp_path / "runs" / former), "-o", str(tmp_path / "x.png"), "-p", "none"])


def test_lines_that_share_a_colour_differ_in_style() -> None:
    pytest.importorskip("matplotlib")
    run = plots.Run("", Path("1"), np.array([25_000, 50_000]), np.array([1.0, 2.0]))
    data = plots.summarize([run])
    ours = [plots.Curve(f"c{i}", data) for i in range(12)]
    # The last two have the colours of the algorithms' own runs, of which the second is the eleventh.
    theirs = [plots.Curve(f"d{i}", data, published=True) for i in range(12)]
    theirs += [plots.Curve(f"{name} (RR=2)", data, published=True) for name in ("c0", "c10")]
    lines = plots.draw(ENV, [*ours, *theirs], "return").axes[0].get_lines()
    looks = [(line.get_color(), line._dash_pattern) for line in lines]  # type: ignore[attr-defined]
    assert len(looks) == len(set(map(str, looks))) == 26
    assert {line.get_linestyle() for line in lines[:10]} == {"-"}
    assert lines[0].get_color() == lines[10].get_color() == lines[-2].get_color() == lines[-1].get_color()
    assert all(line.get_linestyle() == "--" for line in lines[12:])


def test_picture_has_a_line_a_curve_and_the_colour_tells_the_algorithm() -> None:
    pytest.importorskip("matplotlib")
    run = plots.Run("bro_fast", Path("1"), np.array([25_000, 50_000]), np.array([1.0, 2.0]))
    curves = [plots.Curve("bro_fast", plots.summarize([run])), *plots.select_published(ENV, None, "return")]
    axes = plots.draw(ENV, curves, "return").axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    assert list(lines) == ["bro_fast, 1 seed", "BRO (RR=10), 10 seeds", "BRO Fast (RR=2), 10 seeds", "SAC, 3 seeds"]
    assert lines["bro_fast, 1 seed"].get_color() == lines["BRO Fast (RR=2), 10 seeds"].get_color()
    assert len({line.get_color() for line in axes.lines}) == 3
    assert axes.get_xlim() == (0, 50_000)
    assert axes.get_title() == ENV
    assert axes.get_xlabel()
    assert axes.get_ylabel()


def test_published_sac_has_the_colour_of_the_papers_sac_where_it_is_drawn() -> None:
    pytest.importorskip("matplotlib")
    runs = [plots.Run(name, Path("1"), np.array([25_000]), np.ones(1)) for name in ("sac", "sac_sample")]
    (published,) = plots.select_published(ENV, ["SAC"], "return")

    def colours(*ours: plots.Run) -> list[str]:
        curves = [*(plots.Curve(run.label, plots.summarize([run])) for run in ours), published]
        return [str(line.get_color()) for line in plots.draw(ENV, curves, "return").axes[0].lines]

    stock, paper, theirs = colours(*runs)
    assert stock != paper == theirs
    assert len(set(colours(runs[0]))) == len(set(colours(runs[1]))) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{0}/nowhere"], "runs must be folders with an evaluations.npz or Monitor files"),
        (["{0}"], "env must be given: the runs are of Pendulum-v1, dmc/cheetah-run-v0"),
        (["{0}", "-e", "Ant-v5"], "env must be one that the runs are of, not 'Ant-v5'"),
        (["{0}/bro/1", "-e", "Pendulum-v1"], "runs must be of Pendulum-v1"),
        (["{0}/bro/1", "{0}/bro/../bro/1"], "runs must be named once"),
        (["{0}/bro/1", "--xlim", "5", "5"], "xlim must be"),
        (["{0}/bro/1", "--bin", "0"], "bin must be at least 1, not 0"),
        (["{0}/bro/1", "--metric", "success_rate"], "metric must be one that was recorded"),
    ],
)
def test_wrong_arguments_are_named(tmp_path: Path, arguments: list[str], message: str) -> None:
    write_run(tmp_path / "bro/1", [10], [1])
    write_run(tmp_path / "bro/2", [10], [1], "Pendulum-v1")
    with pytest.raises(SystemExit, match=message):
        plots.main([argument.format(tmp_path) for argument in arguments])
