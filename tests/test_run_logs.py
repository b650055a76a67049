"""What a run has logged is read as NumPy and Stable-Baselines3 read it. Hostile files: test_hostile_zoo_files.py."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from stable_baselines3.common.monitor import LoadMonitorResultsError, load_results

from sb3_sample import plots, run_logs
from sb3_sample.run_logs import monitor_head, read_evaluations, read_monitors
from sb3_sample.saving import BadFile


def write_monitor(path: Path, start: float, rows: str, columns: str = "r,l,t") -> None:
    path.write_text(f'#{{"t_start": {start}, "env_id": "Pendulum-v1"}}\n{columns}\n{rows}')


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_evaluations_are_those_that_were_saved(save, tmp_path: Path) -> None:
    arrays = {
        "timesteps": np.array([5, 10, 20]), "results": np.random.default_rng(0).normal(size=(3, 4)),
        "ep_lengths": np.arange(12).reshape(3, 4), "successes": np.array([[True, False]] * 3),
    }  # fmt: skip
    save(tmp_path / "evaluations.npz", **arrays)
    found = read_evaluations(tmp_path / "evaluations.npz")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    with pytest.raises(BadFile, match=r"evaluations\.npz has no 'x', but timesteps, results"):
        found["x"]


def test_as_much_as_is_allowed_is_read(tmp_path: Path) -> None:
    n = (run_logs.MAX_BYTES - 2000) // 24
    np.savez(tmp_path / "a.npz", timesteps=np.arange(n), results=np.ones((n, 2)))
    assert len(read_evaluations(tmp_path / "a.npz")["results"]) == n
    np.savez(tmp_path / "a.npz", timesteps=np.arange(n), results=np.ones((n, 3)))
    with pytest.raises(BadFile, match="are more than the 16 of 33,554,432 that are read"):
        read_evaluations(tmp_path / "a.npz")


def test_episodes_are_those_that_stable_baselines3_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_monitor(tmp_path / "0.monitor.csv", 10.0, "-1.5,200,1.0\n2,100,5.5\n", "r,l,t,is_success,name\n".strip())
    rows = "-1.5,200,1.0,True,a\n2,100,5.5,False,b\n"
    write_monitor(tmp_path / "0.monitor.csv", 10.0, rows, "r,l,t,is_success,name")
    write_monitor(tmp_path / "1.monitor.csv", 12.0, "3e2,50,0.5,True,c\n", "r,l,t,is_success,name")
    write_monitor(tmp_path / "2.monitor.csv", 9.0, "", "r,l,t,is_success,name")
    theirs = load_results(str(tmp_path))[["r", "l", "t", "is_success"]].astype(float)
    for block in (2**20, 7):  # in one piece, and in many
        monkeypatch.setattr(run_logs, "_BLOCK", block)
        pd.testing.assert_frame_equal(read_monitors(tmp_path)[["r", "l", "t", "is_success"]], theirs)
    assert monitor_head(tmp_path / "1.monitor.csv") == {"t_start": 12.0, "env_id": "Pendulum-v1"}


def test_what_a_killed_run_has_left_of_a_line_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_monitor(tmp_path / "0.monitor.csv", 1.0, "-1.5,200,1.0\n-1")
    assert list(read_monitors(tmp_path)["l"]) == [200]
    whole, last = "-1.5,200,1.0,False\n", "-3.0,100,12.5,True\n"
    for left in range(len(last)):
        write_monitor(tmp_path / "0.monitor.csv", 1.0, whole + last[:left], "r,l,t,is_success")
        for block in (2**20, 7):
            monkeypatch.setattr(run_logs, "_BLOCK", block)
            assert read_monitors(tmp_path)[["r", "l", "t", "is_success"]].to_numpy().tolist() == [[-1.5, 200, 1.0, 0]]
    write_monitor(tmp_path / "0.monitor.csv", 1.0, "")
    assert len(read_monitors(tmp_path)) == 0
    (tmp_path / "0.monitor.csv").unlink()
    with pytest.raises(LoadMonitorResultsError, match="no files of the form"):
        read_monitors(tmp_path)


def test_a_file_that_a_later_monitor_appended_to_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Monitor writes it with override_existing=False: no second head, and seconds from 0 on."""
    write_monitor(tmp_path / "0.monitor.csv", 10.0, "1,100,2.0\n2,100,4.0\n3,50,1.0\n4,50,3.0\n5,20,0.5\n6,20,0.5\n")
    write_monitor(tmp_path / "1.monitor.csv", 11.0, "7,30,4.5\n")
    for block in (2**20, 7):
        monkeypatch.setattr(run_logs, "_BLOCK", block)
        episodes = read_monitors(tmp_path)
        assert list(episodes["r"]) == [1, 2, 3, 7, 4, 5, 6]
        assert list(episodes["t"]) == [2, 4, 5, 5.5, 7, 7.5, 7.5]


def test_runs_are_found_however_deep_they_lie_and_not_through_links(tmp_path: Path) -> None:
    folder = tmp_path
    for _ in range(400):  # more levels than Python calls can be nested, in the paths that systems take
        folder /= "a"
    folder.mkdir(parents=True)
    write_monitor(folder / "0.monitor.csv", 1.0, "1,2,3\n")
    (tmp_path / "link").symlink_to(folder)
    (folder / "back").symlink_to(tmp_path)
    assert plots.find_runs(tmp_path) == [folder]


def test_what_lies_within_a_run_is_no_other_run(tmp_path: Path) -> None:
    folder = tmp_path / "CrossQ" / "seed_0"
    for name in (".", "states/9000", "eval"):
        (folder / name).mkdir(parents=True, exist_ok=True)
        write_monitor(folder / name / "0.monitor.csv", 1.0, "1,2,3\n")
    # Monitor files alone hide nothing below them: they may be another program's.
    assert len(plots.find_runs(tmp_path)) == 3 and plots.find_runs(folder) == [folder]
    (folder / "evaluations.npz").touch()
    assert plots.find_runs(tmp_path) == plots.find_runs(folder) == [folder]
    (folder / "evaluations.npz").rename(folder / "eval" / "evaluations.npz")
    assert {folder, folder / "eval"} < set(plots.find_runs(tmp_path))
    (folder / "eval" / "evaluations.npz").rename(folder / "evaluations.npz")
    # Recorded ones within are runs, of single tasks for example, beside the Monitor files of a training on all.
    for name in ("b", "a"):
        (folder / "tasks" / name).mkdir(parents=True)
        write_monitor(folder / "tasks" / name / "0.monitor.csv", 1.0, "1,2,3\n")
        (folder / "tasks" / name / "run.json").write_text("{}")
    tasks = [folder / "tasks" / name for name in ("a", "b")]
    (folder / "evaluations.npz").unlink()
    shutil.rmtree(folder / "states")
    shutil.rmtree(folder / "eval")
    assert plots.find_runs(tmp_path) == plots.find_runs(folder) == tasks
    # The folder of a recorded run is that run's.
    (folder / "run.json").write_text("{}")
    assert plots.find_runs(folder) == [folder] and plots.find_runs(tmp_path) == [*tasks, folder]


def test_a_run_does_not_choose_which_picture_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run").mkdir()
    Path("run/0.monitor.csv").write_text('#{"t_start": 1.0, "env_id": "holiday"}\nr,l,t\n1,2,3\n')
    plots.main(["run"])
    Path("holiday.png").write_text("the user's")
    with pytest.raises(SystemExit, match=r"output must be given: holiday\.png is there"):
        plots.main(["run"])
    assert Path("holiday.png").read_text() == "the user's"
    plots.main(["run", "--env", "holiday"])
    assert Path("holiday.png").read_bytes().startswith(b"\x89PNG")
