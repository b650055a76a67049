"""Signals, and what is printed, when nobody reads it: the turn is finished and saved all the same."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HumanOutputFormat

from sb3_sample.console import LossyLog, standard_error
from tests.sac.common import differing, sac, sampled, state
from tests.saving.program import run


class Interrupted(BaseCallback):
    """Sends a signal to its process at a step, by when its standard streams are what they are."""

    def __init__(self, number: int, at: int):
        super().__init__()
        self.number, self.at = number, at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            os.kill(os.getpid(), self.number)
        return True


def _exchange_streams(how: str, folder: Path) -> Any:
    """Make the standard output and the standard error of this process something else."""
    if how == "reader gone":
        reader, writer = os.pipe()
        os.close(reader)
    elif how == "full disk":
        writer = os.open("/dev/full", os.O_WRONLY)
    elif how == "terminal gone":
        terminal, writer = os.openpty()
        os.close(terminal)
    else:
        os.close(2)
        if how == "closed, used by Python":
            file = open(folder / "user", "w")  # noqa: SIM115
            assert file.fileno() == 2
            file.write("the user's")
            file.flush()
            return file
        if how == "closed by its object":
            sys.stderr.close()
        return None
    os.dup2(writer, 1)
    os.dup2(writer, 2)
    return None


HOW = ("reader gone", "full disk", "terminal gone", "closed", "closed, used by Python", "closed by its object")


def train(folder: Path, how: str, number: int) -> None:
    outcome = "none"
    model = sac(verbose=1)
    kept = _exchange_streams(how, folder)
    try:
        # Both before and after the signal the log is written.
        model.learn(50, Interrupted(number, 25), log_interval=1, checkpoint=folder / "run", checkpoint_freq=10)
    except BaseException as error:
        outcome = type(error).__name__
    said = [outcome, model.num_timesteps, None if kept is None else kept.name]
    (folder / "outcome.json").write_text(json.dumps(said))
    os._exit(0)


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
@pytest.mark.parametrize("how", sampled(HOW, ("terminal gone",)))
def test_an_interrupt_that_nobody_reads_of_is_saved(how: str, number: int, tmp_path: Path) -> None:
    run(tmp_path, how, number, target=train)
    outcome, n_steps, kept = json.loads((tmp_path / "outcome.json").read_text())
    assert (outcome, n_steps) == ("KeyboardInterrupt" if number == signal.SIGINT else "SystemExit", 25)
    folder = tmp_path / "run"
    assert sorted(int(path.name.split("-")[1]) for path in folder.glob("checkpoint-*")) == [20, 25]
    if kept is not None:
        assert Path(kept).read_text() == "the user's"
    # Nothing that was printed is in a file of the run.
    assert (folder / ".lock").read_text().startswith("The folder of one run") and len(
        (folder / ".lock").read_text().splitlines()
    ) == 1
    lines = [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [7, 14, 21]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        again = sac().learn(50, checkpoint=folder)
    assert not differing(state(sac().learn(50)), state(again))


def speak(folder: Path, number: int) -> None:
    descriptor = os.open(folder / "said", os.O_WRONLY | os.O_CREAT)
    os.dup2(descriptor, 2)
    with contextlib.suppress(KeyboardInterrupt, SystemExit):
        sac().learn(50, Interrupted(number, 25), checkpoint=folder / "run", checkpoint_freq=10)
    os._exit(0)


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_line_says_where_the_run_was_saved(number: int, tmp_path: Path) -> None:
    run(tmp_path, number, target=speak)
    *_, last = (tmp_path / "said").read_text().splitlines()
    name = signal.Signals(number).name
    assert (
        last == f"{name}: saved at 25 steps in {tmp_path / 'run'}; the same program, started again, goes on from there"
    )


class Late(BaseCallback):
    """Sends this process a signal when no further turn follows."""

    def __init__(self, number: int, ends_at: int | None):
        super().__init__()
        self.number, self.ends_at = number, ends_at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.ends_at:
            os.kill(os.getpid(), self.number)
        return self.num_timesteps != self.ends_at

    def _on_training_end(self) -> None:
        if self.ends_at is None:
            os.kill(os.getpid(), self.number)


@pytest.mark.parametrize(("ends_at", "saved_at"), [(None, 40), (35, 30)])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_after_the_last_turn_ends_the_program(
    number: int, ends_at: int | None, saved_at: int, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt if number == signal.SIGINT else SystemExit):
        sac().learn(40, Late(number, ends_at), checkpoint=tmp_path, checkpoint_freq=10)
    assert max(int(path.name.split("-")[1]) for path in tmp_path.glob("checkpoint-*")) == saved_at


def test_the_standard_error_is_known(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert standard_error() == sys.__stderr__.fileno()  # type: ignore[union-attr]
    monkeypatch.setattr(sys, "__stderr__", None)
    assert standard_error() is None
    with (tmp_path / "log").open("w") as file:
        monkeypatch.setattr(sys, "__stderr__", file)
        assert standard_error() is None  # of a file that this program opened for something else
        os.set_inheritable(file.fileno(), True)
        assert standard_error() == file.fileno()
    assert standard_error() is None


class Broken:
    """A stream that takes nothing."""

    def write(self, text: str) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    def flush(self) -> None:
        raise BrokenPipeError(32, "Broken pipe")


def test_a_log_that_takes_nothing_is_a_warning_once(tmp_path: Path) -> None:
    model = sac(verbose=1)
    model._setup_learn(10, None)
    output = model.logger.output_formats[0]
    assert isinstance(output, HumanOutputFormat)
    model.set_logger(model.logger)
    output.file = Broken()  # type: ignore[assignment]
    with pytest.warns(UserWarning, match="HumanOutputFormat") as caught:
        model.learn(30, log_interval=1, checkpoint=tmp_path / "run")
    messages = [str(w.message) for w in caught if "of the log cannot be written to" in str(w.message)]
    assert len(messages) == 1 and messages[0].startswith(
        "HumanOutputFormat of the log cannot be written to ([Errno 32]"
    )
    assert model.num_timesteps == 30
    # Only while it is trained with checkpoints.
    with pytest.raises(BrokenPipeError):
        sac(verbose=1).set_logger(model.logger) or model.learn(60, log_interval=1, reset_num_timesteps=False)


def test_other_errors_of_a_log_are_no_business_of_it() -> None:
    model = sac(verbose=1)
    model._setup_learn(10, None)
    output = model.logger.output_formats[0]
    output.write = _raise  # type: ignore[method-assign]
    lossy = LossyLog(model.logger)
    with pytest.raises(KeyError):
        output.write({}, {})
    lossy.close()


def _raise(*args: Any, **kwargs: Any) -> None:
    raise KeyError("a bug")


SCRIPT = """
import os, signal, sys, threading, time
from pathlib import Path
from tests.sac.common import sac

model = sac(compile=False)
model.verbose = 1
model.learn(10**6, log_interval=1, checkpoint=sys.argv[1], checkpoint_freq=10**5)
"""


@pytest.mark.slow
@pytest.mark.parametrize("shell", ['"$0" "$@" 2>&1 | head -n 1', '"$0" "$@" 2>&-', '"$0" "$@" >/dev/full 2>&1'])
def test_from_a_shell(shell: str, tmp_path: Path) -> None:
    """The real thing: a pipe whose reader leaves, no standard error at all, a full disk."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([os.getcwd(), *sys.path])}
    (tmp_path / "script.py").write_text(SCRIPT)
    log = tmp_path / "run" / "progress.jsonl"
    with (tmp_path / "output").open("w") as output:
        process = subprocess.Popen(
            ["sh", "-c", shell, sys.executable, tmp_path / "script.py", tmp_path / "run"],
            start_new_session=True, env=environment, stdout=output, stderr=output,
        )  # fmt: skip
        try:
            deadline = time.monotonic() + 100
            while not (log.exists() and log.read_text().count("\n") > 20) and time.monotonic() < deadline:
                time.sleep(0.05)
            os.killpg(process.pid, signal.SIGINT)
            process.wait(60)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    # The pipe's other end may be done first.
    deadline = time.monotonic() + 60
    while len(list((tmp_path / "run").glob("checkpoint-*"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    first, last = sorted(int(path.name.split("-")[1]) for path in (tmp_path / "run").glob("checkpoint-*"))
    assert first == 0 < last
    assert "BrokenPipe" not in (tmp_path / "output").read_text()
