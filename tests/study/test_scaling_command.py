"""``sb3-sample scaling`` on made-up runs."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sb3_sample import cli, study
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
    laws, page = tmp_path / "laws.json", tmp_path / "page.md"
    cli.main(["scaling", "fit", f"BRO={table}", *LEVELS, "-o", str(laws), "--page", str(page)])
    text = page.read_text()
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
    for command, words in (
        (["fit", str(table), *LEVELS], "agent must be given"),
        (["fit", f"BRO={table}", "--levels", "5000"], "give a level that they reach"),
        (["fit"], "sources must be at least one folder"),
        (["fit", f"BRO={table}", "--delta", "-1", *LEVELS], "delta above 0"),
        (["predict", str(laws), "--budget", "1e15"], "is no file of scaling laws"),
    ):
        with pytest.raises(SystemExit) as error:
            cli.main(["scaling", *command])
        said = capsys.readouterr().err
        assert error.value.code == 2 and words in said and "Traceback" not in said, (command, said)


def test_the_figures(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    cli.main(["scaling", "plot", f"BRO={table}", *LEVELS, "-o", str(tmp_path / "figures")])
    names = sorted(path.stem.rpartition("figure_")[2][0] for path in (tmp_path / "figures").iterdir())
    assert names == ["1", "2", "3", "5", "6", "7", "9"]
    assert "not drawn: figure_4_overfitting: the runs have not recorded" in capsys.readouterr().out


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
    cli.main([*command, "-params", "model_size:0.55M", "resets:[]"])
    assert capsys.readouterr().out.startswith("45 runs of 30,000 steps")
    runs = study.read_plan(path).runs
    pairs = {(run.arguments["batch_size"], run.arguments["learning_rate"]) for run in runs}
    assert pairs == {(64, 3e-4), (128, 3e-4), (256, 3e-4), (128, 1.5e-4), (128, 6e-4)}
    with pytest.raises(SystemExit):
        cli.main(command)
    assert "is there already" in capsys.readouterr().err
    path.unlink()
    cli.main([*command, "--full"])
    assert capsys.readouterr().out.startswith("81 runs")
    path.unlink()
    with pytest.raises(SystemExit):
        cli.main([*command, "-params", "model_size:7M"])
    assert "model_size" in capsys.readouterr().err and not path.exists()


@pytest.mark.parametrize(
    ("name", "n"), [("small/scaling", 45), ("papers/scaling_dmc", 5600), ("papers/scaling_gym", 1920)]
)
def test_the_plans_that_are_shipped(name: str, n: int) -> None:
    pytest.importorskip("rl_zoo3")
    assert len(study.read_plan(Path(__file__).parents[2] / "studies" / f"{name}.yml").runs) == n
