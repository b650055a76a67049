"""The table of runs: of this package, of the zoo, of Monitor files, and published."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sb3_sample import study
from sb3_sample.study import table as tables
from sb3_sample.study.runs import StudyFolder
from tests.study.made_up import made_up, write_monitor, write_run, write_zoo_run


def only(table: pd.DataFrame, metric: str) -> pd.DataFrame:
    return table[table["metric"] == metric].reset_index(drop=True)


# ---------------------------------------------------------------- runs


def test_a_run_of_the_train_command(tmp_path: Path) -> None:
    log = [
        {"step": 1_500, "time/time_elapsed": 1_800, "diagnostics/overestimation": 2.5, "train/critic_loss": 1.0},
        {"step": 3_000, "time/time_elapsed": 3_600, "diagnostics/overestimation": 3.5, "note": "text"},
    ]
    write_run(tmp_path / "a", seed=4, arguments={"replay_ratio": 2, "policy": "MlpPolicy"}, log=log)
    table = study.read([tmp_path])
    assert list(table) == ["agent", "arguments", "task", "seed", "step", "metric", "value"]
    assert set(table["agent"]) == {"bro"} and set(table["task"]) == {"dmc/cheetah-run-v0"} and set(table["seed"]) == {4}
    assert set(table["arguments"]) == {'{"policy": "MlpPolicy", "replay_ratio": 2}'}
    returns = only(table, "return")
    assert list(returns["step"]) == [1_000, 2_000, 3_000] and list(returns["value"]) == [10.0, 20.0, 30.0]
    assert list(only(table, "diagnostics/overestimation")["value"]) == [2.5, 3.5]
    # The log's time, which leaves out what the run did not run, and not that of Monitor.
    np.testing.assert_allclose(only(table, "hours")["value"], [1 / 3, 2 / 3, 1])
    assert set(table["metric"]) == {"return", "hours", "diagnostics/overestimation"}
    assert list(study.read(tmp_path, ["train/*"])["value"]) == [1.0]


def test_a_run_that_learned_from_data_first(tmp_path: Path) -> None:
    """Its steps on the data have a log of their own, and the clock of the others begins anew."""
    online = [{"step": 2_500, "time/time_elapsed": 1_800, "train/critic_loss": 3.0}]
    offline = [
        {"step": 1_000, "time/time_elapsed": 3_600, "train/value_loss": 1.0},
        {"step": 2_000, "time/time_elapsed": 7_200, "train/value_loss": 2.0, "train/critic_loss": 4.0},
    ]
    folder = write_run(tmp_path / "a", log=online)
    (folder / "offline").mkdir()
    (folder / "offline" / "progress.jsonl").write_text("".join(json.dumps(line) + "\n" for line in offline))
    table = study.read(tmp_path, ["hours", "train/*"])
    # After the last line at the mean speed.
    np.testing.assert_allclose(only(table, "hours")["value"], [1, 2, 3])
    assert list(only(table, "train/value_loss")["value"]) == [1.0, 2.0]
    losses = only(table, "train/critic_loss")
    assert list(losses["step"]) == [2_000, 2_500] and list(losses["value"]) == [4.0, 3.0]


def test_a_run_that_is_just_writing_its_evaluations_is_left_out(tmp_path: Path) -> None:
    folders = [write_run(tmp_path / str(seed), seed=seed) for seed in range(3)]
    file = folders[1] / "evaluations.npz"
    whole = file.read_bytes()
    for length in (len(whole) // 2, 2, 0):
        file.write_bytes(whole[:length])
        (folders[1] / "checkpoint-000000000010").mkdir()
        (folders[1] / "best_model.zip").touch()
        with pytest.warns(UserWarning, match=rf"1 runs \({folders[1]}\) are just writing their evaluations.npz"):
            assert set(study.read(tmp_path)["seed"]) == {0, 2}
        # One that has ended writes nothing any more, and neither does one without checkpoints.
        (folders[1] / "dmc-cheetah-run-v0.zip").touch()
        with pytest.raises(ValueError, match="truncated"):
            study.read(tmp_path)
        (folders[1] / "dmc-cheetah-run-v0.zip").unlink()
        (folders[1] / "checkpoint-000000000010").rmdir()
        with pytest.raises(ValueError, match="truncated"):
            study.read(tmp_path)


def test_steps_are_of_the_simulator(tmp_path: Path) -> None:
    write_run(tmp_path / "a", env_kwargs={"action_repeat": 4}, log=[{"step": 10, "diagnostics/x": 1}])
    table = study.read(tmp_path, ["return", "diagnostics/*", "episode_length", "hours"])
    assert list(only(table, "return")["step"]) == [4_000, 8_000, 12_000]
    assert list(only(table, "diagnostics/x")["step"]) == [40]
    (tmp_path / "a" / "evaluations.npz").unlink()
    with pytest.warns(UserWarning, match="1 runs have no evaluations.npz .*training episodes"):
        episodes = study.read(tmp_path, ["return", "episode_length"])
    assert list(only(episodes, "return")["step"]) == [4_000, 8_000, 12_000]
    assert list(only(episodes, "episode_length")["value"]) == [4_000.0] * 3


@pytest.mark.parametrize(
    ("wrapper", "skip"),
    [
        ("sb3_sample.envs.atari.AtariFrames", 4),
        ({"sb3_sample.envs.atari.AtariFrames": {"frame_skip": 3}}, 3),
        ("stable_baselines3.common.atari_wrappers.AtariWrapper", 4),
        ([{"gymnasium.wrappers.AtariPreprocessing": {"frame_skip": 2}}], 2),
    ],
)
def test_atari_counts_frames(tmp_path: Path, wrapper: Any, skip: int) -> None:
    """As Monitor does, below the wrapper."""
    folder = write_run(tmp_path / "a", task="ALE/Pong-v5", algo="srspr", arguments={"env_wrapper": wrapper})
    write_monitor(folder, "ALE/Pong-v5", [1_000 * skip] * 3)
    table = study.read(tmp_path, ["return", "online_return"])
    for metric in ("return", "online_return"):
        assert list(only(table, metric)["step"]) == [1_000 * skip, 2_000 * skip, 3_000 * skip]


def test_a_run_of_the_zoo(tmp_path: Path) -> None:
    config = (
        "  - - policy_kwargs\n    - dict(net_arch=[8])\n  - - learning_rate\n    - lin_1e-3\n"
        "  - - env_wrapper\n    - rl_zoo3.wrappers.FrameSkip:\n        skip: 2\n"
        "  - - replay_buffer_class\n    - !!python/name:stable_baselines3.HerReplayBuffer ''\n"
        "  - - shape\n    - !!python/tuple\n      - 1\n      - 2\n"
    )
    write_zoo_run(tmp_path / "logs" / "sac" / "dmc-cheetah-run-v0_1", config=config, kwargs="{action_repeat: 3}")
    table = study.read(tmp_path / "logs")
    assert set(table["agent"]) == {"sac"} and set(table["seed"]) == {7}
    arguments = json.loads(table["arguments"].iloc[0])
    assert arguments["replay_buffer_class"] == "stable_baselines3.HerReplayBuffer"
    assert arguments["shape"] == [1, 2] and arguments["policy"] == "MlpPolicy" and "n_timesteps" not in arguments
    # Both what the environment repeats and what the wrapper does; Monitor is below the wrapper.
    assert list(only(table, "return")["step"]) == [6_000, 12_000, 18_000]
    assert list(only(table, "hours")["step"]) == [6_000, 12_000, 18_000]


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.system ['true']",
        "- a list",
        "{a: &x [1, 1, 1, 1, 1, 1], b: &y [*x, *x, *x, *x, *x, *x], c: &z [*y, *y, *y, *y, *y, *y],"
        " d: &u [*z, *z, *z, *z, *z, *z], e: [*u, *u, *u, *u, *u, *u]}",
    ],
)
def test_settings_that_are_no_plain_values_are_refused(tmp_path: Path, text: str) -> None:
    folder = write_zoo_run(tmp_path / "a")
    (folder / "dmc-cheetah-run-v0" / "config.yml").write_text(text)
    with pytest.raises(ValueError, match="YAML|settings"):
        study.read(tmp_path)


def test_monitor_files_alone(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_monitor(tmp_path / "mine" / name)
    with pytest.warns(UserWarning, match="2 runs have no evaluations.npz"):
        table = study.read([f"theirs={tmp_path / 'mine' / 'a'}", tmp_path / "mine" / "b"])
    returns = only(table, "return")
    assert list(returns["agent"]) == ["theirs"] * 3 + ["mine"] * 3  # the label, and the folder above
    assert list(returns["step"]) == [1_000, 2_000, 3_000] * 2 and list(returns["value"]) == [1.0, 2.0, 3.0] * 2
    assert set(table["seed"]) == {0} and set(table["arguments"]) == {"{}"}
    np.testing.assert_allclose(only(table, "hours")["value"], [0.5, 1, 1.5] * 2)


def test_seeds_that_no_file_says_are_numbers_of_the_runs(tmp_path: Path) -> None:
    for name in ("run_1", "run_2", "run_10"):
        write_monitor(tmp_path / "x" / name, returns=(float(name[4:]),) * 3)
    with pytest.warns(UserWarning, match="no evaluations"):
        table = only(study.read(tmp_path), "return")
    assert list(table["value"][::3]) == [1.0, 2.0, 10.0] and list(table["seed"][::3]) == [0, 1, 2]


@pytest.mark.parametrize("again", ["x", "x/../x/run_1"])
def test_a_folder_without_a_seed_that_is_named_twice_is_refused(tmp_path: Path, again: str) -> None:
    for name in ("run_1", "run_2"):
        write_monitor(tmp_path / "x" / name)
    with pytest.raises(ValueError, match=r"runs must be named once, and \S*run_1 is there twice\. LABEL=FOLDER"):
        study.read([tmp_path / "x" / "run_1", tmp_path / again])
    with pytest.warns(UserWarning, match="no evaluations"):
        table = study.read([f"other={tmp_path / 'x' / 'run_1'}", tmp_path / "x"], ["return"])
    assert table[["agent", "seed"]].drop_duplicates().to_numpy().tolist() == [["other", 0], ["x", 0], ["x", 1]]


def test_numbers_in_place_of_seeds_leave_out_the_recorded_ones(tmp_path: Path) -> None:
    for name, seed in (("a", None), ("b", 0), ("c", None), ("d", 2)):
        folder = write_run(tmp_path / name)
        record = json.loads((folder / "run.json").read_text())
        (folder / "run.json").write_text(json.dumps({**record, "seed": seed}))
    assert list(only(study.read(tmp_path), "return")["seed"][::3]) == [1, 0, 3, 2]


def test_a_run_of_a_study_before_its_first_evaluation_has_no_return(tmp_path: Path) -> None:
    first, second = (tmp_path / "study" / "runs" / "BRO" / "dmc-cheetah-run-v0" / seed for seed in "01")
    write_run(first)
    write_run(second, seed=1, log=[{"step": 500, "diagnostics/x": 1}])
    (second / "evaluations.npz").unlink()
    (tmp_path / "study" / "study.json").write_text(json.dumps({"name": "x", "runs": [{"agent": "BRO"}]}))
    with pytest.warns(UserWarning, match="1 runs .* are before their first evaluation and have no return yet"):
        table = study.read(tmp_path / "study", ["return", "episode_length", "online_return", "diagnostics/*"])
    assert set(table.loc[table["seed"] == 0, "metric"]) == {"return", "online_return"}
    assert set(table.loc[table["seed"] == 1, "metric"]) == {"online_return", "diagnostics/x"}
    # Of a study without any evaluation the training episodes are what there is.
    (first / "evaluations.npz").unlink()
    with pytest.warns(UserWarning, match="2 runs have no evaluations.npz .*training episodes"):
        table = study.read(tmp_path / "study", ["return"])
    assert set(table["seed"]) == {0, 1}


def test_a_run_before_its_first_evaluation_has_no_return_as_a_source_of_its_own(tmp_path: Path) -> None:
    first, second = (tmp_path / "study" / "runs" / "BRO" / "dmc-cheetah-run-v0" / seed for seed in "01")
    write_run(first)
    write_run(second, seed=1)
    (second / "evaluations.npz").unlink()
    (tmp_path / "study" / "study.json").write_text(json.dumps({"name": "x", "runs": [{"agent": "BRO"}]}))
    for sources in ([first, second], [second, first], [second]):
        with pytest.warns(UserWarning, match="before their first evaluation"):
            table = study.read(sources)
        assert set(table.loc[table["seed"] == 1, "metric"]) == {"hours"}


def test_agents_of_a_study_have_the_names_of_its_plan(tmp_path: Path) -> None:
    folder = tmp_path / "study" / "runs" / "BRO-Fast,replay_ratio=2" / "dmc-cheetah-run-v0"
    write_run(folder / "0", algo="bro_fast", seed=0)
    write_run(folder / "1", algo="bro_fast", seed=1)
    runs = [{"agent": "BRO Fast", "grid": {"replay_ratio": 2}}] * 2
    (tmp_path / "study" / "study.json").write_text(json.dumps({"name": "x", "runs": runs}))
    assert set(study.read(tmp_path / "study")["agent"]) == {"BRO Fast"}
    assert set(study.read(folder / "1")["agent"]) == {"BRO Fast"}
    for bad in ('{"runs": [1]}', '{"runs": [{"agent": "a", "grid": 1}]}', '{"runs": [], "former": []}', "[]"):
        (tmp_path / "study" / "study.json").write_text(bad)
        with pytest.raises(ValueError, match="no list of a study's runs"):
            study.read(tmp_path / "study")


@pytest.mark.parametrize("grid", [{}, {"tau": 0.01}])
def test_agents_with_long_names_keep_them(tmp_path: Path, grid: dict[str, Any]) -> None:
    """Their folders' names are cut at 120 characters, and end in a hash."""
    names = ["x" * 125, "x" * 124 + "y", "z" * 120]
    runs = [study.Run(name, "bro", grid, grid, "dmc/cheetah-run-v0", 0, 3_000) for name in names]
    folder = StudyFolder(tmp_path / "study")
    folder.enter(study.Plan("x", tuple(runs)))
    for i, run in enumerate(runs):
        write_run(folder.place(run), values=[float(i)] * 3, arguments=grid)
    table = only(study.read(folder.path), "return")
    assert dict(zip(table["agent"], table["value"], strict=True)) == dict(zip(names, (0.0, 1.0, 2.0), strict=True))


def test_two_runs_that_cannot_be_told_apart_are_refused(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_run(tmp_path / name)
    with pytest.raises(ValueError, match=r"runs must differ .* LABEL=FOLDER"):
        study.read(tmp_path)
    table = study.read([tmp_path / "a", f"other={tmp_path / 'b'}"])
    assert list(table["agent"].unique()) == ["bro", "other"]


def test_a_run_that_has_just_begun_has_no_rows(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    folder = write_run(tmp_path / "b", seed=1)
    (folder / "evaluations.npz").unlink()
    write_monitor(folder, lengths=(), returns=(), times=())
    with pytest.warns(UserWarning, match="1 runs"):
        assert set(study.read(tmp_path)["seed"]) == {0}


def test_a_last_line_that_is_not_whole_is_left_out(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "a", log=[{"step": 5, "diagnostics/x": 1.0}])
    path = folder / "progress.jsonl"
    path.write_text(path.read_text() + '{"step": 6, "diagn')
    assert list(study.read(tmp_path, ["diagnostics/*"])["step"]) == [5]
    path.write_text('{"step": -1}\n')
    with pytest.raises(ValueError, match="line 1 has no step, or -1"):
        study.read(tmp_path)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ("[]", "no record"),
        ('{"settings": {}, "algo": 1, "env": "x", "seed": 0}', "algo is 1"),
        ('{"settings": {"env_kwargs": "{\'action_repeat\': 0}"}, "algo": "a", "env": "x", "seed": 0}', "action_repeat"),
        ('{"settings": {"a": "__import__(\'os\').abort()"}, "algo": "a", "env": "x", "seed": "0"}', "seed '0'"),
    ],
)
def test_records_that_are_none_are_refused(tmp_path: Path, record: str, message: str) -> None:
    folder = write_run(tmp_path / "a")
    (folder / "run.json").write_text(record)
    with pytest.raises(ValueError, match=message):
        study.read(tmp_path)


def test_a_setting_that_is_no_plain_value_is_its_text(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "a")
    record = json.loads((folder / "run.json").read_text())
    record["settings"]["noise"] = "__import__('os').abort()"
    (folder / "run.json").write_text(json.dumps(record))
    arguments = json.loads(study.read(tmp_path)["arguments"].iloc[0])
    assert arguments["noise"] == "__import__('os').abort()"


def test_nothing_to_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="runs must be folders"):
        study.read(tmp_path)
    with pytest.raises(ValueError, match="sources must be at least one"):
        study.read([])
    write_monitor(tmp_path / "a", task="None")
    with pytest.raises(ValueError, match="does not say which task"):
        study.read(tmp_path)


def test_each_file_of_a_run_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(5):
        write_run(tmp_path / str(seed), seed=seed, log=[{"step": 3_000, "time/time_elapsed": 60}])
    opened: list[str] = []
    open_file = os.open

    def counting(path, *args, **kwargs):
        opened.append(str(path))
        return open_file(path, *args, **kwargs)

    monkeypatch.setattr(os, "open", counting)
    study.read(tmp_path)
    names = sorted(name for name in opened if name.startswith(str(tmp_path)))
    files = ("evaluations.npz", "progress.jsonl", "run.json")
    assert names == sorted(str(tmp_path / str(seed) / file) for seed in range(5) for file in files)


# ---------------------------------------------------------------- files


def test_a_table_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    table = pd.concat([study.published_runs(["BRO"]), study.published_curves(["TD7"])], ignore_index=True)
    table.loc[0, "value"] = 0.1 + 0.2
    study.write(table, tmp_path / "x" / "t.csv")
    pd.testing.assert_frame_equal(study.load(tmp_path / "x" / "t.csv"), table)
    pd.testing.assert_frame_equal(study.read([str(tmp_path / "x" / "t.csv")]), table)
    assert set(study.read([f"me={tmp_path / 'x' / 't.csv'}"])["agent"]) == {"me"}


def test_a_table_as_parquet(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    table = pd.concat([study.published_runs(["BRO"]), study.published_curves(["TD7"])], ignore_index=True)
    study.write(table, tmp_path / "t.parquet")
    pd.testing.assert_frame_equal(study.load(tmp_path / "t.parquet"), table)


def test_a_missing_pyarrow_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(ImportError, match=r"pyarrow .*\[study\]"):
        study.write(made_up([]), tmp_path / "t.parquet")


def test_tables_that_are_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("agent,task\na,b\n")
    with pytest.raises(ValueError, match="no table of runs.*It must have agent, arguments"):
        study.load(tmp_path / "t.csv")
    for row in ("a,{},b,0,x,return,1", "a,,b,0,1,return,1"):
        (tmp_path / "t.csv").write_text(f"agent,arguments,task,seed,step,metric,value\n{row}\n")
        with pytest.raises(ValueError, match="no table of runs"):
            study.load(tmp_path / "t.csv")
    with pytest.raises(ValueError, match="output must end in .csv or .parquet"):
        study.write(made_up([]), tmp_path / "t.txt")


def test_the_same_run_in_two_tables_is_refused(tmp_path: Path) -> None:
    for name in ("a.csv", "b.csv"):
        study.write(made_up([("x", {}, "dmc/cheetah-run-v0", 0, 1, "return", 1.0)]), tmp_path / name)
    with pytest.raises(ValueError, match="two of x, dmc/cheetah-run-v0, seed 0, return at 1"):
        study.read([tmp_path / "a.csv", tmp_path / "b.csv"])


# ---------------------------------------------------------------- published


def test_published_runs_are_all_seeds_of_bro() -> None:
    table = study.published_runs(["BRO", "bro fast (RR=2)"])
    assert list(table["agent"].unique()) == ["BRO", "bro fast"]
    assert len(table) == 2 * 40 * 10 * 40 and table["task"].nunique() == 40
    cheetah = table[(table["task"] == "dmc/cheetah-run-v0") & (table["step"] == 1_000_000) & (table["agent"] == "BRO")]
    expected = [898.55, 842.58, 852.64, 720.55, 743.99, 786.20, 871.13, 851.55, 839.18, 848.10]
    np.testing.assert_allclose(np.sort(cheetah["value"]), np.sort(expected), atol=0.01)
    assert set(cheetah["metric"]) == {"return"} and sorted(cheetah["seed"]) == list(range(10))
    success = table[table["metric"] == "success_rate"]
    assert success["value"].between(0, 1).all() and success["task"].str.startswith(("metaworld/", "myosuite/")).all()
    assert list(study.published_runs()["agent"].unique()) == ["BRO", "BRO Fast"]
    with pytest.raises(ValueError, match=r"agents must be of BRO \(RR=10\), BRO Fast \(RR=2\).*not 'SAC'"):
        study.published_runs(["SAC"])


def test_published_runs_agree_with_the_published_curves() -> None:
    runs = study.published_runs(["BRO"])
    curves = study.published_curves(["BRO"], list(runs["task"].unique()))
    mean = runs.groupby(["task", "step"])["value"].mean()
    published = curves[curves["metric"].str.endswith("/mean")].set_index(["task", "step"])["value"]
    np.testing.assert_allclose(mean, published.reindex(mean.index), rtol=1e-3, atol=1e-4)
    assert curves["seed"].isna().all()


def test_published_tasks_have_the_names_that_are_asked_for() -> None:
    table = study.published_curves(["SAC"], ["HalfCheetah-v5", "sb3_sample:dmc/dog-run-v0"])
    assert set(table["task"]) == {"HalfCheetah-v5", "dmc/dog-run-v0"}
    assert set(study.published_runs(["BRO"], ["metaworld/push-v3"])["task"]) == {"metaworld/push-v3"}
    with pytest.raises(ValueError, match="tasks must be of those that were published, not 'dmc/point_mass-easy-v0'"):
        study.published_runs(["BRO"], ["dmc/point_mass-easy-v0"])
    assert list(study.published_curves(["SimbaV2"])["agent"].unique()) == [f"SimbaV2 (RR={n})" for n in (1, 2, 4, 8)]


def test_columns_are_those_that_are_said() -> None:
    for table in (study.published_runs(["BRO"]), study.published_curves(["TD7"]), made_up([])):
        assert list(table) == tables.COLUMNS and str(table["seed"].dtype) == "Int64"
