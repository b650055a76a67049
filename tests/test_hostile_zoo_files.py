"""
Hostile files in the places of all that the zoo's commands read: each is refused in one line, within a moment and some
memory, or used; none runs code, writes elsewhere, imports what it names, or hangs.

``python -m tests.test_hostile_zoo_files FOLDER [WORD ...]`` throws the cases that have all the words in them, and
prints a line of JSON for each.
"""

import json
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("rl_zoo3")
pytest.importorskip("seaborn")

from sb3_sample import cli
from sb3_sample.envs.base import select_gl_backend
from sb3_sample.zoo.settings import WRAPPERS, _check_wrapper
from tests import hostile_zoo_files
from tests.hostile_zoo_files import (
    COMMANDS,
    ENV,
    EVAL,
    LOGS,
    PARAMS,
    READERS,
    RUN,
    STEPS,
    TRAIN,
    Case,
    FolderWatch,
    cases,
    set_json,
    set_yaml,
    throw,
)
from tests.saving.hostile import MARKER, Payload


def prepare(folder: Path) -> Path:
    """Make good files in a folder, and have a copy of them read by every command that reads them."""
    folder.mkdir(parents=True)
    before, argv, backend = os.getcwd(), sys.argv, os.environ.get("MPLBACKEND")
    os.environ["MPLBACKEND"] = "Agg"
    os.chdir(folder)
    select_gl_backend()
    try:
        hostile_zoo_files.make()
        used = folder.with_name("used")
        shutil.copytree(folder, used)
        os.chdir(used)
        # What is imported when it is needed does not count as taken by a hostile file.
        for name, command in COMMANDS.items():
            if name != "record":  # which needs a screen
                hostile_zoo_files.run(command)
    finally:
        os.chdir(before)
        sys.argv = argv
        if backend is None:
            del os.environ["MPLBACKEND"]
    return folder


def throw_at(case: Case, good: Path, place: Path, watch: FolderWatch) -> list[dict[str, Any]]:
    results = []
    # A video needs a screen, or what stands for one.
    for command in READERS[case.file]:
        if command != "record" or (case.must and command not in case.but):
            shutil.copytree(good, place)
            os.chdir(place)
            results.append(throw(case, command, watch))
            os.chdir(place.parent)
            shutil.rmtree(place)
    return results


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("hostile") / "good")


@pytest.fixture(scope="session")
def watch() -> FolderWatch:
    return FolderWatch()


@pytest.fixture
def here(good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with good files, which is the present one."""
    place = tmp_path / "here"
    shutil.copytree(good, place)
    monkeypatch.chdir(place)
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    monkeypatch.setenv("MPLBACKEND", "Agg")
    return place


# ---------------------------------------------------------------- the table


def _throw_all(chosen: list[Case], good: Path, place: Path, watch: FolderWatch) -> None:
    results = [result for case in chosen for result in throw_at(case, good, place / "case", watch)]
    wrong = [(result["case"], result["command"], result["wrong"]) for result in results if result["wrong"]]
    assert not wrong, f"{len(wrong)} of {len(results)}: {wrong[:20]}"


@pytest.mark.slow
@pytest.mark.parametrize("file", READERS)
def test_some_hostile_files(
    file: str, good: Path, here: Path, tmp_path: Path, watch: FolderWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of thirty-two."""
    chosen = [case for case in cases() if case.file == file][len(file) % 5 :: 32]
    _throw_all(chosen, good, tmp_path, watch)


@pytest.mark.slow
@pytest.mark.parametrize("file", READERS)
def test_all_hostile_files(file: str, good: Path, here: Path, tmp_path: Path, watch: FolderWatch) -> None:
    _throw_all([case for case in cases() if case.file == file], good, tmp_path, watch)


def test_the_watch_notices(here: Path, watch: FolderWatch) -> None:
    """A test that could not fail would be none."""
    with watch.watching():
        pickle.loads(pickle.dumps(Payload()))
        Path("inside").write_text("x")
        Path("../outside").write_text("x")
        Path("inside").unlink()
        os.system("true")
    seen = " ".join(watch.seen)
    assert all(word in seen for word in ("pickle.find_class", "../outside", "os.system")), seen
    assert "inside" not in seen, seen

    Path(MARKER).rmdir()
    # What is thrown is refused for what was done to it.
    case = Case(f"{RUN}/run.json", "algo", "nothing changed", lambda path: None)
    result = throw(case, "enjoy", watch)
    assert result["outcome"] == "done" and result["wrong"] == "it was not refused"


# ---------------------------------------------------------------- who says which algorithm it is


def _pickled(here: Path) -> None:
    """A run of Stable-Baselines3's PPO, by its own word, whose files are pickles that run code."""
    set_json("algo", "ppo", here / RUN / "run.json")
    (here / RUN / f"{ENV}.zip").write_bytes(pickle.dumps(Payload()))
    set_yaml("normalize", f'"{EVAL}"', here / RUN / ENV / "config.yml")


@pytest.mark.parametrize("command", ["enjoy", "record"])
def test_a_run_does_not_say_that_it_is_read_as_the_stock_zoo_reads(command: str, here: Path) -> None:
    _pickled(here)
    with pytest.raises(SystemExit, match=r"run of ppo, .* run any code .* --algo ppo, or --allow-pickle") as end:
        cli.main(COMMANDS[command])
    assert end.value.code == 2 and not (here / MARKER).exists()


@pytest.mark.parametrize("option", [["--algo", "ppo"], ["--al", "ppo"], ["--algo=ppo"], ["--allow-pickle"]])
def test_the_command_line_says_it(option: list[str], here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _pickled(here)
    with pytest.raises(TypeError, match="NoneType"):  # the stock zoo's, of what the code has returned
        cli.main([*COMMANDS["enjoy"], *option])
    assert (here / MARKER).exists()
    warned = "ppo is an algorithm of the zoo's own: its files are pickled" in capsys.readouterr().err
    assert warned == ("--allow-pickle" not in option)


@pytest.mark.parametrize("spelling", [["--algo", "sac_sample"], ["--alg", "sac_sample"], ["--a=sac_sample"]])
def test_our_algorithms_are_read_safely_however_they_are_spelled(spelling: list[str], here: Path) -> None:
    set_yaml("another", f"!!python/object/apply:os.mkdir [{MARKER}]", here / LOGS / ENV / "args.yml")
    with pytest.raises(SystemExit, match="it makes an object"):
        cli.main(["enjoy", *spelling, "--env", ENV, "-f", "logs", *STEPS])
    assert not (here / MARKER).exists()


# ---------------------------------------------------------------- settings


@pytest.mark.parametrize("folder", ["rl-trained-agents", "run"])
def test_a_refused_run_is_no_reason_to_ask_a_hub(folder: str, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import rl_zoo3.enjoy

    def download(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("a download is offered")

    monkeypatch.setattr(rl_zoo3.enjoy, "download_from_hub", download)
    set_yaml("normalize", f'"{EVAL}"', here / RUN / ENV / "config.yml")
    (here / RUN).rename(here / folder)
    with pytest.raises(SystemExit, match="normalize is Python"):
        cli.main(["enjoy", "--run-dir", folder, *STEPS])
    (here / folder / f"{ENV}.zip").unlink()
    (here / folder / ENV / "config.yml").unlink()
    with pytest.raises(SystemExit, match="has no such model of"):
        cli.main(["enjoy", "--run-dir", folder, "--load-checkpoint", "3", *STEPS])


def test_what_a_file_must_not_give_an_environment_the_command_line_can(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    set_yaml("env_kwargs", "{g: 20000}", here / RUN / ENV / "args.yml")
    with pytest.raises(SystemExit, match=r"env_kwargs has g=20000: .* --env-kwargs g:VALUE"):
        cli.main(COMMANDS["enjoy"])
    cli.main([*COMMANDS["enjoy"], "--env-kwargs", "g:9.0"])


@pytest.mark.parametrize(
    ("key", "wrappers"),
    [
        ("env_wrapper", ["gymnasium.wrappers.TimeLimit: {max_episode_steps: 50}", "gymnasium.wrappers.ClipAction"]),
        ("env_wrapper", ["rl_zoo3.wrappers.FrameSkip: {skip: 2}", "rl_zoo3.wrappers.ActionNoiseWrapper"]),
        ("env_wrapper", ["stable_baselines3.common.monitor.Monitor: {allow_early_resets: true}"]),
        ("vec_env_wrapper", ["stable_baselines3.common.vec_env.VecCheckNan: {raise_exception: true}"]),
        ("vec_env_wrapper", ["stable_baselines3.common.vec_env.vec_monitor.VecMonitor: {filename: null}"]),
        ("env_wrapper", ["null"]), ("vec_env_wrapper", ["null"]),
    ],
)  # fmt: skip
def test_wrappers_that_only_compute_are_taken(key: str, wrappers: list[str], here: Path) -> None:
    text = wrappers[0] if wrappers == ["null"] else f"[{', '.join(f'{{{w}}}' if ':' in w else w for w in wrappers)}]"
    set_yaml(key, text, here / RUN / ENV / "config.yml")
    cli.main(COMMANDS["enjoy"])


@pytest.mark.parametrize("noop_max", [None, 30])
def test_no_ops_at_the_start_of_an_atari_game_may_be_left_out(noop_max: int | None) -> None:
    wrapper = {"sb3_sample.envs.atari.AtariFrames": {"noop_max": noop_max}}
    _check_wrapper(wrapper, WRAPPERS, "config.yml: env_wrapper", ())


def test_wrappers_of_trusted_modules_may_have_any_argument(here: Path) -> None:
    wrapper = "stable_baselines3.common.monitor.Monitor: {filename: written}"
    set_yaml("env_wrapper", f"{{{wrapper}}}", here / RUN / ENV / "config.yml")
    with pytest.raises(SystemExit, match=r"Monitor, for which filename cannot be 'written'.*--trusted-modules"):
        cli.main(COMMANDS["enjoy"])
    assert not Path("written.monitor.csv").exists()
    cli.main([*COMMANDS["enjoy"], "--trusted-modules", "stable_baselines3.common.monitor"])
    assert Path("written.monitor.csv").exists()


def test_shared_values_are_read_as_the_zoo_writes_them(here: Path) -> None:
    shared = ["x", 1]
    path = here / RUN / ENV / "config.yml"
    settings = yaml.load(path.read_text(), Loader=yaml.UnsafeLoader)
    settings.update(a=shared, b=shared, c=(1, 2))
    path.write_text(yaml.dump(settings))
    assert "&id001" in path.read_text()
    cli.main(COMMANDS["enjoy"])


# ---------------------------------------------------------------- stored trials


def test_a_stored_trial_gives_what_was_searched(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import optuna

    from sb3_sample.zoo import decode

    for name, storage in (
        ("trial", "sqlite:///study.db"),
        ("trial of a journal", hostile_zoo_files.journal("study.log")),
    ):
        params = optuna.load_study(storage=storage, study_name="s").trials[1].params
        cli.main(COMMANDS[name])
        printed = capsys.readouterr().out
        assert all(f"'{key}', {value!r}" in " ".join(printed.split()) for key, value in decode(params).items())


def test_a_search_does_not_try_what_waits_in_a_storage_outside_of_the_space(here: Path) -> None:
    import optuna

    study = optuna.load_study(storage="sqlite:///study.db", study_name="s")
    study.enqueue_trial({"learning_rate": 1e9})
    with (
        pytest.warns(UserWarning, match="out of range"),
        pytest.raises(SystemExit, match=r"learning_rate must be a number of .*, not 1000000000\.0"),
    ):
        cli.main(
            [*TRAIN, "-n", "40", "-optimize", "--n-trials", "1", "--storage", "sqlite:///study.db", "--study-name", "s",
             *PARAMS]
        )  # fmt: skip


# ---------------------------------------------------------------- how a command ends


@pytest.mark.parametrize(
    "command",
    [
        ["enjoy", "--run-dir", "\x1b[31m"],
        *(
            pytest.param(command, marks=pytest.mark.slow)
            for command in (["plot", "nowhere"], ["trian"], ["train", "-i", "nowhere.zip"])
        ),
    ],
)
def test_a_refusal_is_one_line_and_no_traceback(command: list[str], tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sb3_sample.cli", *command], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    lines = [line for line in done.stderr.splitlines() if "Warning" not in line]
    assert done.returncode == 2, done.stderr
    assert lines[-1].startswith("sb3-sample") and lines[-1].isprintable() and "Traceback" not in done.stderr


def main(root: str, *words: str) -> None:
    os.environ["MPLBACKEND"] = "Agg"
    folder, watch = prepare(Path(root) / "good"), FolderWatch()
    for case in cases():
        if all(word in str(case) for word in words):
            for result in throw_at(case, folder, Path(root) / "case", watch):
                print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
