"""The log of a run: whatever its file answers, the training goes on, and what comes after it is right."""

import errno
import json
import os
import subprocess
import warnings
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

from sb3_sample.saving import progress
from sb3_sample.saving.folders import Folder
from sb3_sample.saving.progress import ProgressFile
from tests.sac.common import differing, sac, sampled, state

CODES = (errno.EPERM, errno.EROFS, errno.EIO, errno.ESTALE, errno.ENOSPC, errno.EACCES)
#: What a log asks of the system.
CALLS = ("write", "ftruncate", "fsync", "lseek", "close", "open")


class Failing:
    """Lets calls that concern the log fail, where it is asked to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, calls: tuple[str, ...], code: int):
        self.on, self.code, self.n = False, code, 0
        self.descriptors: set[int] = set()
        descriptor = Folder.descriptor

        def opened(folder: Folder, name: str, flags: int) -> int:
            if name != "progress.jsonl":
                return descriptor(folder, name, flags)
            if self.on and "open" in calls:
                self._fail()
            found = descriptor(folder, name, flags)
            self.descriptors.add(found)
            return found

        monkeypatch.setattr(Folder, "descriptor", opened)
        for call in set(calls) - {"open"}:
            monkeypatch.setattr(os, call, self._wrapped(call, getattr(os, call)))

    def _wrapped(self, call: str, original: Any) -> Any:
        def wrapper(file: Any, *args: Any) -> Any:
            mine = file in self.descriptors
            if call == "close" and mine:
                self.descriptors.discard(file)
                original(file)
            if self.on and mine:
                self._fail()
            return None if call == "close" and mine else original(file, *args)

        return wrapper

    def _fail(self) -> None:
        self.n += 1
        raise OSError(self.code, os.strerror(self.code))


def lines_of(folder: Path) -> list[int]:
    return [json.loads(line)["step"] for line in (folder / "progress.jsonl").read_text().splitlines()]


def learn(folder: Path, steps: int) -> Any:
    return sac().learn(steps, log_interval=1, checkpoint=folder, checkpoint_freq=10)


@pytest.mark.parametrize(
    ("calls", "code"),
    [
        pytest.param(
            calls, code, marks=[] if calls == CALLS and code in (errno.EIO, errno.ENOSPC) else pytest.mark.slow
        )
        for calls in (*((call,) for call in CALLS), CALLS)
        for code in CODES
    ],
)
def test_a_training_goes_on_without_its_log(
    calls: tuple[str, ...], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The training, its checkpoints and what goes on from them; when the log works again it is whole."""
    learn(tmp_path, 15)
    failing = Failing(monkeypatch, calls, code)
    failing.on = True
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = learn(tmp_path, 32)
    failing.on = False
    words = [str(each.message) for each in caught if "its lines are kept" in str(each.message)]
    assert len(words) <= 2 and all(os.strerror(code) in each for each in words)
    assert model.num_timesteps == 32 and not differing(state(sac().learn(32)), state(model))
    assert (tmp_path / "checkpoint-000000000032").is_dir()
    assert failing.n > 0 or calls == ("ftruncate",)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = learn(tmp_path, 45)
    assert not differing(state(sac().learn(45)), state(again))
    assert lines_of(tmp_path) == [7, 14, 21, 28, 35, 42]


@pytest.mark.parametrize("code", sampled(CODES, (errno.EIO, errno.ENOSPC)))
def test_a_new_run_without_a_log(code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failing = Failing(monkeypatch, CALLS, code)
    failing.on = True
    with pytest.warns(UserWarning, match=r"progress\.jsonl cannot be written to .*its lines are kept"):
        learn(tmp_path, 15)
    failing.on = False
    learn(tmp_path, 30)
    assert lines_of(tmp_path) == [7, 14, 21, 28]


def test_what_is_logged_before_the_first_turn(tmp_path: Path) -> None:
    class First(BaseCallback):
        def _on_training_start(self) -> None:
            self.logger.record("eval/first", self.num_timesteps)
            self.logger.dump(self.num_timesteps)

        def _on_step(self) -> bool:
            return True

    for steps in (20, 30):
        sac().learn(steps, First(), checkpoint=tmp_path, log_interval=1)
    lines = [json.loads(line) for line in (tmp_path / "progress.jsonl").read_text().splitlines()]
    # That of the run's beginning, and not that of the program that went on with it.
    assert [line["step"] for line in lines] == [0, 7, 14, 21, 28]
    assert [line.get("eval/first") for line in lines] == [0, None, None, None, None]


def test_a_logger_that_a_callback_sets_has_the_log_too(tmp_path: Path) -> None:
    class Sets(BaseCallback):
        def _on_training_start(self) -> None:
            self.model.set_logger(configure(str(tmp_path / "other"), ["csv"]))

        def _on_step(self) -> bool:
            return True

    for steps in (20, 30):
        sac().learn(steps, Sets(), checkpoint=tmp_path / "run", log_interval=1)
    lines = [json.loads(line) for line in (tmp_path / "run" / "progress.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [7, 14, 21, 28]


def test_a_log_that_is_read_only_for_real(tmp_path: Path) -> None:
    """One file mounted read-only, as a network's file system becomes when its server is gone."""
    learn(tmp_path, 15)
    log = tmp_path / "progress.jsonl"
    if subprocess.run(["mount", "--bind", log, log], capture_output=True).returncode:
        pytest.skip("file systems can be mounted by root only")
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", log], check=True)
        with pytest.warns(UserWarning, match=r"progress\.jsonl cannot be written to .*Read-only"):
            model = learn(tmp_path, 32)
        assert not differing(state(sac().learn(32)), state(model))
    finally:
        subprocess.run(["umount", "-l", log], check=True)
    learn(tmp_path, 45)
    assert lines_of(tmp_path) == [7, 14, 21, 28, 35, 42]


def test_what_is_kept_is_bounded_and_the_newest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "MAX_PENDING", 100)
    failing = Failing(monkeypatch, ("write",), errno.ENOSPC)
    log = ProgressFile(tmp_path)
    log.restore({"size": 0, "pending": []})
    failing.on = True
    with pytest.warns(UserWarning, match="the last 100 characters"):
        log.write({"a": 1.0}, {}, 0)
    for step in range(1, 30):
        log.write({"a": 1.0}, {}, step)
    assert [json.loads(line)["step"] for line in log.state()["pending"]] == [26, 27, 28, 29]
    failing.on = False
    log.write({"a": 1.0}, {}, 30)
    assert lines_of(tmp_path) == [26, 27, 28, 29, 30]


@pytest.mark.parametrize(
    "wrong",
    [{}, {"size": 0}, {"size": -1, "pending": []}, {"size": 2**63, "pending": []}, {"size": True, "pending": []},
     {"size": 0.0, "pending": []}, {"size": 0, "pending": "x"}, {"size": 0, "pending": [1]},
     {"size": 0, "pending": [b"\\ud800".decode("unicode_escape")]}],
)  # fmt: skip
def test_a_state_that_is_none(wrong: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "progress.jsonl").write_text("as it was")
    with pytest.raises(ValueError, match="cannot go on"):
        ProgressFile(tmp_path).restore(wrong)
    assert (tmp_path / "progress.jsonl").read_text() == "as it was"


def test_missing_lines_are_named(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="has 0 bytes instead of 1000: lines are missing"):
        ProgressFile(tmp_path).restore({"size": 1000, "pending": []})
