"""
Hundreds of run folders that were damaged, are hostile, or hold files of the user's: each is a clean error, or the run
goes on; nothing outside of the folder is touched, no file of the user's in it, no code is run, and what goes on with
nothing changed behind right checksums ends as if nothing had been.

``python -m tests.saving.test_hostile_folders SEED FIRST N FOLDER`` goes on in N folders and prints a line of JSON for
each, before and after. ``FUZZ`` in the environment says how many the test throws; 400 if it is not there.
"""

import contextlib
import ctypes
import io
import json
import os
import resource
import signal
import subprocess
import sys
import time
import types
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_sample.saving import container, save_vec_normalize, vec_envs
from sb3_sample.saving.encoding import decode, encode
from sb3_sample.saving.run_folder import RunFolder
from tests.sac.common import Toy, differing, sac, state, vec
from tests.saving import hostile_values
from tests.saving.hostile import Original, at
from tests.saving.hostile_folders import (
    FAMILIES,
    FILES,
    NEW,
    NEXT,
    NEXT_ROWS,
    ROWS,
    Case,
    folder_case,
    put,
    replaced,
    snapshot,
    user_files,
)  # fmt: skip
from tests.saving.test_hostile import BYTES, HEADROOM, SECONDS, Watch, forget_peak, peak, thrown

#: Seconds after which a folder is taken for one that would never end.
HANGS = 60


class Remembers(BaseCallback):
    """A callback with state, texts and the name of a file that it writes to."""

    def __init__(self, target: Path):
        super().__init__()
        self.target, self.csv = target, f"{target}/log.csv"
        self.names = [f"{target}/a.zip"]
        self.phase, self.seen = "first", 0
        self.turns = False

    def _on_rollout_start(self) -> None:
        self.turns = True

    def _on_step(self) -> bool:
        self.seen += 1
        self.phase = "second" if self.seen > 5 else "first"
        Path(self.csv).write_text(f"{self.seen}")
        for name in self.names:
            Path(name).write_text("saved")
        return True


def program(folder: Path, steps: int) -> tuple[Any, Remembers]:
    """
    What a user runs, with its own places beside the run's folder.

    :param folder: the run's
    :param steps: environment steps
    :return: the model and a callback
    """
    places = folder.parent / "places"
    places.mkdir(parents=True, exist_ok=True)
    remembers = Remembers(places)
    evaluation = EvalCallback(
        vec(), n_eval_episodes=1, eval_freq=9, best_model_save_path=str(places), log_path=str(places), verbose=0
    )
    model = sac(compile=False)
    model.set_logger(Logger(None, []))  # which makes no folder
    try:
        model.learn(steps, CallbackList([remembers, evaluation]), log_interval=1, checkpoint=folder, checkpoint_freq=10)
    except Exception as error:
        # Whether the training had begun by then.
        error.turns = remembers.turns  # type: ignore[attr-defined]
        raise
    return model, remembers


@cache
def original(folder: Path) -> dict[str, bytes]:
    """The files of a run of 30 steps, made in an empty folder."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program(folder / "first" / "run", 30)
    files = {name: (folder / "first" / "run" / name).read_bytes() for name in FILES}
    assert sorted(files) == sorted(
        str(path.relative_to(folder / "first" / "run"))
        for path in (folder / "first" / "run").rglob("*") if path.is_file()
    )  # fmt: skip
    return files


def lay(run: Path, files: dict[str, bytes]) -> None:
    for name, data in files.items():
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_bytes(data)


@cache
def wanted(folder: Path) -> dict[str, torch.Tensor]:
    """The run of 40 steps, with no change."""
    run = folder / "wanted" / "run"
    lay(run, original(folder))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return content(*program(run, 40))


def content(model: Any, remembers: Remembers) -> dict[str, torch.Tensor]:
    return {**state(model), "seen": torch.tensor([remembers.seen, model.num_timesteps, model._n_updates])}


@cache
def watch() -> "FolderWatch":
    return FolderWatch()


class FolderWatch(Watch):
    """Notes what is done outside of some folders, by a whole path; what is done by a part of one, snapshots tell."""

    INSIDE = ("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.truncate", "os.chmod")

    def __init__(self) -> None:
        self.allowed: tuple[str, ...] = ()
        super().__init__()

    def _hear(self, event: str, args: tuple[Any, ...]) -> None:
        if self.on and (event == "open" or event in self.INSIDE):
            path = os.fsdecode(args[0]) if isinstance(args[0], (str, bytes, os.PathLike)) else ""
            if not path.startswith("/") or path.startswith(self.allowed):
                return
        super()._hear(event, args)


@contextlib.contextmanager
def time_limit() -> Iterator[None]:
    n_ticks = 0

    def tick(number: int, frame: types.FrameType | None) -> None:
        # Counted one by one, since the process may be stopped for a while.
        nonlocal n_ticks
        n_ticks += 1
        if n_ticks == HANGS:
            raise BaseException(f"not done after {HANGS} s")

    before = signal.signal(signal.SIGALRM, tick)
    signal.setitimer(signal.ITIMER_REAL, 1, 1)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def throw(case: Case, base: Path, number: int) -> dict[str, Any]:
    """
    :param case: a change
    :param base: a folder for everything
    :param number: of the case
    :return: what went wrong, None if nothing, and what it took
    """
    files, good = original(base), wanted(base)
    world = base / f"case-{number}"
    run, elsewhere = world / "run", world / "elsewhere"
    elsewhere.mkdir(parents=True)
    (world / "here").mkdir()
    user_files(elsewhere)
    lay(run, files)
    case.change(run, elsewhere)
    kept = {name: (run / name).read_bytes() for name in case.kept}
    before = {name: snapshot(world / name) for name in ("elsewhere", "here")}
    os.chdir(world / "here")
    watch().allowed = (f"{run}", f"{world / 'places'}")
    wrong, outcome = [], "went on"
    # What was freed is given back, or nothing would be seen of what takes its place.
    ctypes.CDLL(None).malloc_trim(0)
    forget_peak()
    bytes_before, start = peak(), time.process_time()
    with warnings.catch_warnings(), watch().watching(), time_limit():
        warnings.simplefilter("ignore")
        try:
            made = program(run, 40)
        except ValueError as error:
            outcome = f"refused: {type(error).__name__}"
            if len(str(error)) > 3000:
                wrong.append(f"a message of {len(str(error))} characters")
        except BaseException as error:  # of any kind: that is what is tested
            outcome = type(error).__name__
            # What was changed behind right checksums can be wrong in the training, but not before it.
            if case.same or not getattr(error, "turns", False):
                wrong.append(f"{outcome}: {error!s:.300}")
    taken = {"seconds": time.process_time() - start, "bytes": peak() - bytes_before}
    os.chdir(base)
    wrong += [f"it did {each}" for each in watch().seen]
    if imported := {name for name in watch().modules if not name.startswith("encodings.")}:
        wrong.append(f"it imported {sorted(imported)!r:.200}")
    wrong += [f"{name} was touched" for name in before if snapshot(world / name) != before[name]]
    wrong += [f"{name} is not what it was" for name, data in kept.items() if (run / name).read_bytes() != data]
    if taken["seconds"] > SECONDS or taken["bytes"] > BYTES:
        wrong.append(f"it took {taken}")
    if outcome == "went on":
        if case.same and (other := differing(content(*made), good)):
            wrong.append(f"it went on, with other {other}")
        if not (run / NEXT / "manifest.json").is_file():
            wrong.append("it left no checkpoint")
        else:
            again = RunFolder(run)
            again.verify(run / NEXT)
            again.close()
    return {"case": case.words, "outcome": outcome, "wrong": "; ".join(wrong) or None, **taken}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    before = os.getcwd()
    yield tmp_path_factory.mktemp("folders")
    os.chdir(before)


@pytest.mark.parametrize("number", range(len(FAMILIES)))
def test_one_of_each_family(number: int, base: Path) -> None:
    result = throw(folder_case(0, number, original(base)), base, number)
    assert result["wrong"] is None, result


@pytest.mark.parametrize("kind", ["folder", "folder with a file", "pipe", "profile", "theirs", "/dev/zero"])
@pytest.mark.parametrize("name", [NEXT, NEXT_ROWS])
def test_in_the_way_of_the_next_checkpoint(name: str, kind: str, base: Path) -> None:
    number = 1000 + len(list(base.glob("case-*")))
    case = Case(f"{name} is there as {kind}", lambda run, elsewhere: put(run / name, kind, elsewhere), True)
    result = throw(case, base, number)
    assert result["wrong"] is None, result
    # A link in the run's folder itself is refused before anything is trained.
    links = name == NEXT and kind in ("profile", "theirs", "/dev/zero")
    assert result["outcome"] == ("refused: ValueError" if links else "went on")
    if kind == "folder with a file":
        kept = (base / f"case-{number}" / "run" / name).with_name(f"damaged-{Path(name).name}") / "notes"
        assert kept.read_text() == "the user's"


def normalised(folder: Path, steps: int) -> Any:
    """A run whose environment has all that a checkpoint holds of one."""
    return sac(VecNormalize(vec()), compile=False).learn(steps, checkpoint=folder, checkpoint_freq=10)


@pytest.fixture(scope="module")
def files_of_a_run(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    run = tmp_path_factory.mktemp("normalised") / "run"
    normalised(run, 30)
    return {str(path.relative_to(run)): path.read_bytes() for path in run.rglob("*") if path.is_file()}


def refused(run: Path, words: str) -> None:
    """A run that would go on is refused, in these words, within the bounds of all, and before it takes a step."""
    forget_peak()
    bytes_before, start = peak(), time.process_time()
    with pytest.raises(ValueError, match=words) as raised:
        normalised(run, 40)
    assert time.process_time() - start < SECONDS and peak() - bytes_before < BYTES
    assert str(run) in str(raised.value) and not (run / NEXT).exists()


def changed(files: dict[str, bytes], run: Path, name: str, kind: str, change: Callable[[Any], Any]) -> None:
    """Lay a run's files with what one holds changed, behind right checksums everywhere."""
    lay(run, files)
    value = decode(*container.read(run / name, kind), kind)
    change(value)
    tensors: dict[str, torch.Tensor] = {}
    file = io.BytesIO()
    container.write(file, kind, encode(value, kind, tensors), tensors)
    replaced(run, name, file.getvalue())


@pytest.mark.parametrize("row", hostile_values.STATE, ids=lambda row: f"{'.'.join(map(str, row[0]))}-{row[1]!r:.30}")
def test_a_state_that_no_training_writes(row: Any, files_of_a_run: dict[str, bytes], tmp_path: Path) -> None:
    place, value, words = row
    changed(files_of_a_run, tmp_path / "run", f"{NEW}/state.zip", "checkpoint",
            lambda state: at(state, place[:-1]).__setitem__(place[-1], value))  # fmt: skip
    refused(tmp_path / "run", words)


@pytest.mark.parametrize("row", hostile_values.ROWS, ids=str)
def test_rows_that_no_training_writes(row: Any, files_of_a_run: dict[str, bytes], tmp_path: Path) -> None:
    name, value, words = row
    changed(files_of_a_run, tmp_path / "run", ROWS[1], "replay rows",
            lambda rows: rows[name].reshape(-1).__setitem__(0, value))  # fmt: skip
    refused(tmp_path / "run", words)


@pytest.mark.parametrize("case", hostile_values.GENERATORS, ids=str)
def test_generators_of_an_environment(case: Any, files_of_a_run: dict[str, bytes], tmp_path: Path) -> None:
    """NumPy takes each of them, and draws from what lies beside its numbers, or crashes."""
    run = tmp_path / "run"
    lay(run, files_of_a_run)
    original = Original("state", files_of_a_run[f"{NEW}/state.zip"])
    attributes = ("dict", "env", "dict", "environments", 0, "dict", "layers", -1, "dict", "attributes", "dict")
    place = (*attributes, "hostile")
    at(original.content["tree"], attributes)  # is there
    replaced(run, f"{NEW}/state.zip", hostile_values.with_generator(original, place, case))
    refused(run, case[3])


@pytest.mark.parametrize("setting", [{"clip_obs": 0.0}, {"clip_reward": -5.0}, {"epsilon": -1.0}, {"gamma": 7.0}])
def test_settings_that_would_be_refused_are_not_saved(setting: dict[str, float], tmp_path: Path) -> None:
    """Rather than at the end of a training, that is said before it begins."""
    env = VecNormalize(vec(), **setting)
    (name,) = setting
    with pytest.raises(ValueError, match=f"env: {name} of a VecNormalize must be"):
        sac(env).learn(20, checkpoint=tmp_path / "run")
    with pytest.raises(ValueError, match=f"venv: {name} of a VecNormalize must be"):
        save_vec_normalize(env, tmp_path / "normalize.zip")
    assert not (tmp_path / "normalize.zip").exists()


def toy() -> Monitor:
    return Monitor(Toy())


@pytest.mark.slow
def test_a_worker_lives_on() -> None:
    """What an environment in another process cannot be given is an error here, and not the end of the worker."""
    env = SubprocVecEnv([toy])
    env.reset()
    state, missing = vec_envs.save(env)
    assert not missing
    for value in (3, {"layers": [3], "simulator": None}, {"layers": state["environments"][0]["layers"]}):
        with pytest.raises(ValueError, match="the state of an environment is none: [A-Z][A-Za-z]*Error"):
            vec_envs.restore(env, {**state, "environments": [value]})
    assert vec_envs.restore(env, state) == []
    env.step(np.zeros((1, 2), np.float32))
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("file", ["state.zip", ROWS[1]])
def test_more_than_the_bytes_say(file: str, files_of_a_run: dict[str, bytes], tmp_path: Path) -> None:
    name = file if "/" in file else f"{NEW}/{file}"
    for number, (_, data, words) in enumerate(
        hostile_values.too_much(Original(name, files_of_a_run[name]), container.MAX_JSON)
    ):
        run = tmp_path / f"{number}" / "run"
        lay(run, files_of_a_run)
        replaced(run, name, data)
        refused(run, words)


@pytest.mark.slow
def test_hundreds_of_folders(tmp_path: Path) -> None:
    n, seed = int(os.environ.get("FUZZ", "400")), 1
    results = thrown("tests.saving.test_hostile_folders", str(seed), "0", str(n), str(tmp_path), n=n)
    counts = Counter(line["outcome"] for line in results)
    print(f"{counts}, at most { ({key: max(line[key] for line in results) for key in ('seconds', 'bytes')}) }")
    assert counts["went on"] > n / 10 and counts["went on"] < n * 0.9


def main(seed: str, first: str, n: str, folder: str) -> None:
    torch.set_num_threads(1)
    base = Path(folder).resolve()
    os.chdir(base)
    wanted(base)
    throw(Case("nothing", lambda run, elsewhere: None, True), base, -1)
    size = int(next(line for line in Path("/proc/self/status").read_text().splitlines() if "VmSize" in line).split()[1])
    resource.setrlimit(resource.RLIMIT_AS, (size * 1024 + HEADROOM,) * 2)
    for number in range(int(first), int(first) + int(n)):
        case = folder_case(int(seed), number, original(base))
        print(json.dumps({"number": number, "case": case.words}), flush=True)
        print(json.dumps({"number": number, **throw(case, base, number)}), flush=True)
        subprocess.run(["rm", "-rf", base / f"case-{number}"], check=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
