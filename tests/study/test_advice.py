"""How far one gets in some hours, by given step times and the published grid; what is kept of step times."""

import dataclasses
import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("pandas")

from sb3_sample import cli, study
from sb3_sample.learner.execution import PAYS_FROM
from sb3_sample.sac.bro import MODEL_SIZES
from sb3_sample.study import advice_command, dry_run, step_times
from sb3_sample.study.advice import advise, published_grid
from sb3_sample.study.aggregate import at_steps, blocks_of, iqm, scored
from sb3_sample.study.dry_run import Cost, seconds_of_learning
from sb3_sample.study.plan import Plan, Run
from sb3_sample.study.step_times import StepTimes

#: docs/performance.md, and a minute of compiling.
MS = {"0.55M": 6.4, "1.05M": 10.0, "2.83M": 25.0, "4.92M": 38.0, "26.31M": 199.0}


def times(scale: float = 1.0, **changes: object) -> StepTimes:
    given = {
        "processor": "made up", "torch": "2.13", "threads": 2, "how": "compiled",
        "gradient_step": {size: scale * ms / 1e3 for size, ms in MS.items()},
        "preparation": dict.fromkeys(MS, 60.0), "acting": 0.001,
    }  # fmt: skip
    return StepTimes(**{**given, **changes})  # type: ignore[arg-type]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "sb3_sample" / "step_times.json"


# ---------------------------------------------------------------- the published grid


def test_the_grid_has_every_configuration_at_every_evaluation() -> None:
    grid = published_grid()
    assert len(grid) == 3 * 25 * 40
    assert set(grid["model_size"]) == set(MODEL_SIZES)
    for (suite, _, _), curve in grid.groupby(["suite", "replay_ratio", "model_size"]):
        assert curve["env_step"].tolist() == list(range(25_000, 1_000_001, 25_000))
        assert set(curve["tasks"]) == {10 if suite == "myosuite" else 15}
    assert ((grid["low"] <= grid["iqm"]) & (grid["iqm"] <= grid["high"])).all()
    assert grid["low"].min() >= 0 and grid["high"].max() <= 1


@pytest.mark.parametrize(("agent", "ratio"), [("BRO", 10), ("BRO Fast", 2)])
def test_two_of_its_configurations_are_the_authors_own_runs(agent: str, ratio: int) -> None:
    rows = scored(study.published_runs([agent]))
    grid = published_grid()
    for suite in ("dmc", "metaworld", "myosuite"):
        matrix, _ = at_steps(rows[rows["task"].str.startswith(suite)], None)
        chosen = (grid["suite"] == suite) & (grid["replay_ratio"] == ratio) & (grid["model_size"] == "4.92M")
        expected = iqm(*blocks_of(matrix.reset_index("agent", drop=True)))
        np.testing.assert_allclose(grid.loc[chosen, "iqm"], expected, atol=5.1e-5)


# ---------------------------------------------------------------- the answer


def test_the_steps_are_those_that_fit_into_the_hours() -> None:
    found = advise(1.5, times(), 0.002, episode=1_000)
    assert len(found.table) == 25
    for row in found.table.itertuples():
        gradient = MS[row.model_size] / 1e3 * row.replay_ratio
        # Of 25,000 steps 5,000 of evaluations besides; gradient steps from the 2,500th on; compiling.
        hours = [(60 + n * 0.003 * 1.2 + (n - 2_500) * gradient) / 3600 for n in (row.steps, row.steps + 1_000)]
        assert row.hours == pytest.approx(hours[0])
        assert row.hours <= 1.5 < hours[1]
    best = found.best
    assert found.table["iqm"].max() == best["iqm"]
    # By the table of published IQMs, between two evaluations.
    grid = published_grid().query("suite == 'dmc' and replay_ratio == @best.replay_ratio")
    curve = grid[grid["model_size"] == best["model_size"]].set_index("env_step")
    low = best["steps"] // 25_000 * 25_000
    share = (best["steps"] - low) / 25_000
    expected = (1 - share) * curve["iqm"][low] + share * curve["iqm"][low + 25_000]
    assert best["iqm"] == pytest.approx(expected)
    assert best["low"] < best["iqm"] < best["high"]
    assert (found.equals["high"] >= best["low"]).all() and len(found.equals) < 24


def test_no_number_stands_below_the_first_evaluation_or_above_the_last() -> None:
    found = advise(4.0, times(), 0.002)
    few = found.table[found.table["iqm"].isna()]
    assert len(few) and (few["steps"] < 25_000).all()
    assert (found.table["steps"][found.table["iqm"].notna()] >= 25_000).all()
    # A thousand hours: every one of a million steps, none of more, and of equal returns the one that is there first.
    plenty = advise(10_000.0, times(), 0.002)
    assert (plenty.table["steps"] == 1_000_000).all() and plenty.table["ends_early"].all()
    grid = published_grid().query("suite == 'dmc' and env_step == 1_000_000")
    assert plenty.best["iqm"] == grid["iqm"].max()
    with pytest.raises(ValueError, match=r"hours must be at least 0\.\d+ here: .* 25,000 steps, .* in 0.01 hours"):
        advise(0.01, times(), 0.002)


def test_the_hours_of_the_error_are_enough() -> None:
    with pytest.raises(ValueError, match="hours must be at least") as error:
        advise(0.05, times(), 0.002)
    hours = float(str(error.value).split("at least ")[1].split()[0])
    found = advise(hours * 1.06, times(), 0.002)
    assert found.best["steps"] >= 25_000


def test_disturbed_step_times_are_named() -> None:
    steps = dict(times().gradient_step)
    sizes = list(steps)
    assert "something else ran" not in advice_command.page(advise(4.0, times(), 0.002), times(), 0.002)
    steps[sizes[1]] = steps[sizes[0]] / 2
    disturbed = times(gradient_step=steps)
    shown = advice_command.page(advise(4.0, disturbed, 0.002), disturbed, 0.002)
    assert f"- Gradient steps were measured shorter of {sizes[1]} than of {sizes[0]}: something else ran" in shown


def test_a_faster_machine_is_never_advised_worse() -> None:
    returns = [advise(6.0, times(scale), 0.002).best["iqm"] for scale in (2.0, 1.0, 0.3, 0.05)]
    assert returns == sorted(returns) and returns[0] < returns[-1]


def test_the_command_is_the_published_agent() -> None:
    pytest.importorskip("rl_zoo3")
    found = advise(4.0, times(), 0.002, suite="metaworld", env="metaworld/reach-v3", episode=200)
    command = found.command
    assert command.startswith("sb3-sample train --algo bro") and f"-n {found.best['steps']} " in command
    assert f"model_size:\"'{found.best['model_size']}'\"" in command
    # Two gradient steps a step is BRO Fast, which is reset once.
    found.table.loc[0, ["replay_ratio", "model_size"]] = [2, "1.05M"]
    assert "--algo bro_fast " in found.command and found.command.endswith("-params model_size:\"'1.05M'\"")
    found.table.loc[0, "replay_ratio"] = 5
    assert "--algo bro " in found.command and found.command.endswith(" replay_ratio:5")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"hours": 0.0}, "hours must be a positive number, not 0.0"),
        ({"hours": float("nan")}, "hours must be a positive number, not nan"),
        ({"suite": "atari"}, "suite must be one of dmc, metaworld, myosuite, not 'atari'"),
        ({"environment": -1.0}, "environment must be seconds of at least 0"),
        ({"times": times(gradient_step={"0.55M": 0.01})}, "times must be of every model_size, and have none of 1.05M"),
    ],
)
def test_bad_questions(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        advise(**{"hours": 4.0, "times": times(), "environment": 0.002, **arguments})  # type: ignore[arg-type]


# ---------------------------------------------------------------- step times


def test_times_are_kept_by_processor_torch_and_threads(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step_times, "processor", lambda: "made up")
    monkeypatch.setattr(step_times.torch, "__version__", "2.13")
    assert step_times.stored(2, "cpu") is None
    others = [times(threads=1), times(torch="2.12"), times(processor="another")]
    for each in others:
        step_times.keep(each)
    assert step_times.stored(2, "cpu") is None
    step_times.keep(times(2.0))
    step_times.keep(times(3.0))
    assert step_times.stored(2, "cpu") == times(3.0)
    assert step_times.stored(1, "cpu") == others[0]
    assert len(json.loads(cache.read_text())) == 4


@pytest.mark.parametrize("text", ["{", "[]]", '[{"processor": 1}]', "[3]", json.dumps([times(acting=-1.0).__dict__])])
def test_a_cache_that_holds_something_else_is_named(cache: Path, text: str) -> None:
    cache.parent.mkdir(parents=True)
    cache.write_text(text)
    with pytest.raises(ValueError, match=r"step_times.json holds no step times .*: remove it"):
        step_times.stored(2, "cpu")


def test_what_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Quick, and of the smallest size: the times themselves are the machine's."""
    monkeypatch.setattr(step_times, "QUICK_SECONDS", 0.01)
    monkeypatch.setattr(step_times, "MODEL_SIZES", {"0.55M": (1, 128)})
    said: list[str] = []
    found = step_times.measure(1, "cpu", quick=True, say=said.append)
    assert found.key == step_times._key(1, step_times.get_device("cpu")) and found.how == "quick"
    assert list(found.gradient_step) == ["0.55M"] and found.gradient_step["0.55M"] > 0 and found.acting > 0
    assert said == ["measuring 0.55M"]
    assert "(estimated)" in str(found)
    assert step_times.environment_seconds(gym.make("Pendulum-v1"), 0.0) > 0


def test_without_a_compiler_steps_are_eager(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step_times, "SECONDS", 0.01)
    monkeypatch.setattr(step_times, "MODEL_SIZES", {"0.55M": (1, 128)})
    monkeypatch.setattr(step_times, "why_not_compiled", lambda learner: "there is no compiler")
    found = step_times.measure(1, "cpu")
    assert found.how == "eager" and found.gradient_step["0.55M"] > 0


@pytest.mark.slow
def test_compiled_steps_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step_times, "SECONDS", 0.1)
    monkeypatch.setattr(step_times, "MODEL_SIZES", {"0.55M": (1, 128)})
    found = step_times.measure(1, "cpu")
    assert found.how in ("compiled", "eager")
    assert found.gradient_step["0.55M"] > 0 and found.preparation["0.55M"] >= 0


# ---------------------------------------------------------------- the command


@pytest.fixture
def measured(cache: Path, monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Step times as given; whether each measurement that is asked for is to be quick."""
    asked: list[bool] = []

    def measure(threads: int, device: str, *, quick: bool, say: object) -> StepTimes:
        asked.append(quick)
        key = step_times._key(threads, step_times.get_device(device))
        return times(how="quick" if quick else "compiled", processor=key[0], torch=key[1], threads=threads)

    monkeypatch.setattr(step_times, "measure", measure)
    monkeypatch.setattr(step_times, "environment_seconds", lambda env: 0.002)
    return asked


def test_the_command_measures_once(measured: list[bool], cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["advise", "--hours", "1.5", "--env", "Pendulum-v1", "--suite", "dmc"]
    arguments += ["--threads", "2", "--device", "cpu"]
    cli.main(arguments)
    first = capsys.readouterr().out
    assert cache.exists()
    cli.main([*arguments, "--quick"])  # nothing is rough that is known
    assert capsys.readouterr().out == first and measured == [False]
    cli.main([*arguments, "--again"])
    assert measured == [False, False]
    found = advise(1.5, times(), 0.002, episode=200)
    assert f"{found.best['model_size']} at replay ratio {found.best['replay_ratio']}: {found.best['steps']:,}" in first
    assert "--env Pendulum-v1 -n" in first and " --num-threads 2 --device cpu -params " in first
    for word in ("value-scaling.github.io", "No number stands for fewer than 25,000 steps", "Interpolated"):
        assert word in first
    assert "rough" not in first and "beyond" not in first


def test_a_busy_machine_is_told_of(
    measured: list[bool], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "advise",
        "--hours",
        "4",
        "--env",
        "Pendulum-v1",
        "--suite",
        "dmc",
        "--threads",
        "2",
        "--device",
        "cpu",
    ]
    for idle, told in ((1.8, False), (1.2, True)):
        monkeypatch.setattr(advice_command, "idle_cores", lambda idle=idle: idle)
        cli.main([*arguments, "--again"])
        assert ("fewer cores are free than the 2" in capsys.readouterr().err) == told


def test_rough_times_are_said_to_be_rough_and_not_kept(
    measured: list[bool], cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["advise", "--hours", "900", "--env", "Pendulum-v1", "--suite", "myosuite", "--threads", "2", "--quick"]
    cli.main([*arguments, "--device", "cpu"])
    said = capsys.readouterr().out
    assert "Step times are rough" in said and "the row is of 1,000,000: nothing was published beyond" in said
    cli.main([*arguments, "--device", "cpu", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert measured == [True, True] and not cache.exists()
    assert found["rough"] and len(found["configurations"]) == 25 and found["measure"] == "success rate"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--hours", "-1"], "hours must be a positive number, not -1.0"),
        (["--hours", "4", "--env", "Pendulum-v1"], r"suite \(--suite\) must be given, .*: Pendulum-v1 is of none"),
        (["--hours", "4", "--env", "dmc/no-such-v0"], "env must be an environment that can be made here, not"),
        (["--hours", "4", "--threads", "0"], "threads must be at least 1, not 0"),
        (["--hours", "0.001", "--env", "Pendulum-v1", "--suite", "dmc"], "hours must be at least"),
    ],
)
def test_what_cannot_be_answered_is_refused(
    measured: list[bool], capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit, match=message):
        cli.main(["advise", *arguments, "--device", "cpu"])


def test_a_suite_has_its_environment(measured: list[bool], capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("dm_control")
    cli.main(["advise", "--hours", "4", "--device", "cpu"])
    assert "--env dmc/cheetah-run-v0" in capsys.readouterr().out
    assert advice_command._suite_of("sb3_sample:metaworld/push-v3") == "metaworld"


# ---------------------------------------------------------------- study run --dry-run


BASE = Run("BRO", "bro", {}, {}, "dmc/cheetah-run-v0", 0, 100_000)


@pytest.mark.parametrize(
    ("algo", "arguments", "expected"),
    [
        ("bro", {}, 10 * 0.038),
        ("bro_fast", {}, 2 * 0.038),
        ("bro", {"model_size": "0.55M", "replay_ratio": 1, "resets": []}, 0.0064),
        ("sac_sample", {}, None),
        ("bro", {"batch_size": 64}, None),
        ("bro", {"model_size": [1, 64]}, None),
        ("bro", {"replay_ratio": None, "gradient_steps": 1}, None),
    ],
)
def test_whose_learning_is_known(algo: str, arguments: dict[str, object], expected: float | None) -> None:
    run = Run("A", algo, dict(arguments), {}, "dmc/cheetah-run-v0", 0, 100_000)
    found = seconds_of_learning(run, times())
    assert found == (None if expected is None else pytest.approx(expected))


def test_short_runs_are_not_compiled_and_other_tasks_have_settings_of_their_own() -> None:
    short = dataclasses.replace(BASE, steps=2_500 + PAYS_FROM // 10 - 1)
    assert seconds_of_learning(short, times()) is None
    assert seconds_of_learning(short, times(how="eager")) == pytest.approx(0.38)
    assert seconds_of_learning(dataclasses.replace(BASE, task="Pendulum-v1"), times()) is None


def test_a_dry_run_reads_the_step_times(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rl_zoo3")
    key = step_times._key(1, step_times.get_device("cpu"))
    step_times.keep(times(processor=key[0], torch=key[1], threads=1))
    probes = []

    def measure(run: Run, threads: int, device: str) -> Cost:
        probes.append(run.arguments)
        return Cost(0.003, 1.0, 1.0)

    monkeypatch.setattr(dry_run, "measure", measure)
    said: list[str] = []
    sac = Run("SAC", "sac_sample", {}, {}, "dmc/cheetah-run-v0", 0, 3_600)
    found = study.estimate(Plan("made up", (BASE, sac)), tmp_path / "folder", workers=1, device="cpu", say=said.append)
    # BRO apart from its gradient steps, which would be compiled for a minute; SAC as it is.
    assert probes == [{"replay_ratio": 1e-3, "compile": False}, {}]
    assert said[0] == f"measuring BRO on dmc/cheetah-run-v0, gradient steps of {cache}"
    assert said[1] == "measuring SAC on dmc/cheetah-run-v0"
    assert found.hours == pytest.approx((100_000 * 0.383 + 3_600 * 0.003) / 3600)
