"""
Hostile files in the places of those that the zoo's commands read, the folder that they lie in, and the commands.

``CASES`` is the table: a file, what of it is changed, and to what. ``Case.put`` changes the file in any folder of that
layout, which ``make`` makes.
"""

import contextlib
import io
import json
import os
import pickle
import resource
import signal
import sqlite3
import struct
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_sample import cli
from tests.saving.hostile import MARKER, Payload
from tests.saving.test_hostile import BYTES, HEADROOM, SECONDS, Watch, forget_peak, peak

ALGO, ENV = "sac_sample", "Pendulum-v1"
RUN, LOGS = "run", f"logs/{ALGO}/{ENV}_1"
TRAIN = [
    "train", "--algo", ALGO, "--env", ENV, "--device", "cpu", "--eval-freq", "100", "--eval-episodes", "2",
    "--verbose", "0", "--num-threads", "1",
]  # fmt: skip
PARAMS = [
    "-params", "learning_starts:20", "buffer_size:2000", "replay_ratio:0.1", "policy_kwargs:dict(net_arch=[8])",
]  # fmt: skip
NORMALIZE, WRAP = "normalize:True", "env_wrapper:[{'gymnasium.wrappers.ClipReward': {'min_reward': -5.0}}]"
STEPS = ["--no-render", "-n", "5", "--device", "cpu"]
#: What reads the files, by its name.
COMMANDS: dict[str, list[str]] = {
    "enjoy": ["enjoy", "--run-dir", RUN, *STEPS],
    "enjoy a checkpoint": ["enjoy", "--run-dir", RUN, "--load-last-checkpoint", *STEPS],
    "enjoy logs": ["enjoy", "--algo", ALGO, "--env", ENV, "-f", "logs", *STEPS],
    "record": ["record_video", "--run-dir", RUN, "-n", "5"],
    "go on": [*TRAIN, "--run-dir", RUN, "--seed", "1", "-n", "440", *PARAMS, NORMALIZE, WRAP],
    "train on": [*TRAIN, "-i", f"{LOGS}/{ENV}.zip", "-n", "10", "--eval-freq", "-1", *PARAMS, NORMALIZE, WRAP],
    "trial": [*TRAIN, "-n", "10", "--eval-freq", "-1", "--storage", "sqlite:///study.db", "--study-name", "s",
              "--trial-id", "1", *PARAMS],
    "trial of a journal": [*TRAIN, "-n", "10", "--eval-freq", "-1", "--storage", "study.log", "--study-name", "s",
                           "--trial-id", "1", *PARAMS],
    "plot": ["plot", RUN, "-o", "plot.png"],
    "plot episodes": ["plot", "episodes", "-o", "plot.png"],
    "plot_train": ["plot_train", "--algo", ALGO, "--env", ENV, "-f", "logs", "-w", "1"],
    "all_plots": ["all_plots", "--algos", ALGO, "--env", ENV, "-f", "logs", "--no-display"],
    "plot_from_file": ["plot_from_file", "-i", "all.pkl", "-o", "all.svg"],
}  # fmt: skip
#: The files, and the commands that read them.
READERS: dict[str, tuple[str, ...]] = {
    f"{RUN}/run.json": ("enjoy", "record", "go on"),
    f"{RUN}/{ENV}/args.yml": ("enjoy", "record", "enjoy a checkpoint"),
    f"{RUN}/{ENV}/config.yml": ("enjoy", "record", "enjoy a checkpoint"),
    f"{LOGS}/{ENV}/config.yml": ("enjoy logs",),
    f"{LOGS}/{ENV}/args.yml": ("enjoy logs",),
    f"{RUN}/{ENV}/vecnormalize.pkl": ("enjoy",),
    f"{RUN}/{ENV}.zip": ("enjoy",),
    f"{RUN}/checkpoint-000000000220/model.zip": ("enjoy a checkpoint",),
    f"{LOGS}/{ENV}.zip": ("enjoy logs", "train on"),
    f"{LOGS}/{ENV}/vecnormalize.pkl": ("train on",),
    f"{LOGS}/replay_buffer.pkl": ("train on",),
    f"{RUN}/evaluations.npz": ("plot",),
    f"{LOGS}/evaluations.npz": ("all_plots",),
    "episodes/0.monitor.csv": ("plot episodes",),
    f"{LOGS}/0.monitor.csv": ("plot_train",),
    f"{RUN}/0.monitor.csv": ("go on",),
    "study.db": ("trial",),
    "study.log": ("trial of a journal",),
    "all.pkl": ("plot_from_file",),
}


@dataclass(frozen=True)
class Case:
    """
    A hostile file.

    :param file: which, by its path in the folder
    :param field: what of it is changed
    :param value: to what, in words
    :param put: changes the file, given its path
    :param must: whether the commands that read it must refuse it; else they may do their work with it as well
    :param but: those of them that need not
    """

    file: str
    field: str
    value: str
    put: Callable[[Path], Any]
    must: bool = True
    but: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.file}: {self.field} = {self.value}"


# ---------------------------------------------------------------- the folder


def run(command: list[str]) -> None:
    """Run a command in this process, in the present folder."""
    cli.main(list(command))


def make() -> None:
    """Make good files in the present folder, which is empty."""
    import shutil

    import optuna

    train = [*TRAIN, "--seed", "1", "-n", "220", "--save-replay-buffer"]
    run([*train, "--run-dir", RUN, "--checkpoint-freq", "110", *PARAMS, NORMALIZE, WRAP])
    shutil.copytree(RUN, LOGS)
    # Zoo's tables are of two runs.
    shutil.copytree(LOGS, f"logs/{ALGO}/{ENV}_0")
    Path("episodes").mkdir()
    shutil.copy(f"{RUN}/0.monitor.csv", "episodes")
    run(["all_plots", "--algos", ALGO, "--env", ENV, "-f", "logs", "--no-display", "-o", "all"])
    from sb3_sample.zoo import ALGORITHMS

    for storage in ("sqlite:///study.db", journal("study.log")):
        study = optuna.create_study(storage=storage, study_name="s", direction="maximize")
        for value in (1.0, 2.0):
            trial = study.ask()
            for name, suggest in ALGORITHMS[ALGO].space.items():
                suggest(trial, name)
            study.tell(trial, value)


def journal(path: str) -> Any:
    """Optuna's journal."""
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    return JournalStorage(JournalFileBackend(path))


# ---------------------------------------------------------------- whatever the file


def _remove(path: Path) -> None:
    if path.exists() or path.is_symlink():
        path.unlink()


def _with(write: Callable[[Path], Any], path: Path) -> None:
    _remove(path)
    write(path)


def _bytes(data: bytes, path: Path) -> None:
    _remove(path)
    path.write_bytes(data)


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**40)


def _truncated(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


#: What lies there is no file, or none that anything has written.
ANYTHING: dict[str, Callable[[Path], Any]] = {
    "a pipe": partial(_with, os.mkfifo),
    "a link to /dev/zero": partial(_with, lambda path: path.symlink_to("/dev/zero")),
    "a link to nothing": partial(_with, lambda path: path.symlink_to("nothing")),
    "a link to itself": partial(_with, lambda path: path.symlink_to(path.name)),
    "a folder": partial(_with, Path.mkdir),
    "a sparse file of a terabyte": partial(_with, _sparse),
    "nothing in it": partial(_bytes, b""),
    "a pickle": partial(_bytes, pickle.dumps(Payload())),
    "noise": partial(_bytes, np.random.default_rng(0).bytes(50_000)),
    "nine megabytes of brackets": partial(_bytes, b"[" * 9 * 10**6),
    "a line of nine megabytes": partial(_bytes, b"#" + b"1," * 4_500_000),
    "nine megabytes of lines": partial(_bytes, b"{}\n" * 3_000_000),
}
#: What a command does where a file is missing, half there or of no length, is its own affair: a log may be cut.
_HARMLESS = {"a link to nothing", "a link to itself", "a folder", "nothing in it"}


def anything(file: str) -> Iterator[Case]:
    for value, put in ANYTHING.items():
        yield Case(file, "the file", value, put, value not in _HARMLESS)
    yield Case(file, "the file", "cut in half", _truncated, file.endswith((".zip", ".pkl", ".npz")))


# ---------------------------------------------------------------- JSON and YAML

DEEP = "[" * 100_000
BOMB = "a0: &a0 [x,x,x,x,x,x,x,x,x,x]\n" + "\n".join(
    f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)
)
#: Python of a YAML file that leaves a trace.
CODE = f"!!python/object/apply:os.mkdir [{MARKER}]"
EVAL = f"__import__('os').mkdir('{MARKER}')"
#: Texts that lead somewhere else.
PATHS = ("/etc/passwd", "../../x", "~/x", "./x", "a/b.xml", "C:\\x")
HUGE = (10**9, 2**63, 10**30)


def set_json(name: str, value: Any, path: Path) -> None:
    """Change an entry of a JSON file."""
    content = json.loads(path.read_text())
    content[name] = value
    path.write_text(json.dumps(content))


def _without(name: str, path: Path) -> None:
    content = json.loads(path.read_text())
    del content[name]
    path.write_text(json.dumps(content))


RECORD: dict[str, tuple[Any, ...]] = {
    "algo": (
        "ppo", "a2c", "tqc", "../x", "--help", "-f", 3, None, [], {}, "sac_sample\n", "\x1b]0;x\a", "os:system", "",
        "é" * 2000, "\ud800", ["ppo"],
    ),
    "env": (
        "CartPole-v1", "os:system", "antigravity:X-v0", "Nope-v0", "--help", 5, None, [], "../../x", "", "x" * 10**5,
        "FrozenLake-v1",
    ),
    "seed": (-1, 2**32, *HUGE[1:], 1.5, "1", True, None, [], {}, float("nan"), 1e308),
    "n_timesteps": (-2, 2**63, 1.5, "1", True, None, []),
    "checkpoint_freq": (0, -1, 2**63, 1.5, "1", True, None, []),
    "settings": ([], None, 3, "x", {"a": 1}, {"a": None}, {"a": []}, {"a": {"b": "c"}}),
    "tensorboard": (3, [], {}, True),
    "another": (1,),
}  # fmt: skip
RECORD_TEXTS = {
    "a list": "[]", "nothing": "null", "a number": "1", "an open bracket": "{", "deep": DEEP,
    "deep inside": '{"algo": ' + DEEP, "many lists": "[" + "[]," * 80_000 + "[]]", "too long": '"' + "x" * 2**19 + '"',
    "a long number": '{"seed": ' + "9" * 10**5 + "}", "no UTF-8": "\udcff", "a list of a record": '[{"algo": "bro"}]',
}  # fmt: skip


def record(file: str) -> Iterator[Case]:
    for name, values in RECORD.items():
        for value in values:
            # To go on, the command says what to train.
            but = ("go on",) if name in ("algo", "env") else ()
            yield Case(file, name, f"{value!r:.60}", partial(set_json, name, value), but=but)
    for name in ("algo", "env", "seed", "settings"):
        yield Case(file, name, "missing", partial(_without, name))
    for words, text in RECORD_TEXTS.items():
        yield Case(file, "the text", words, partial(_bytes, text.encode(errors="surrogateescape")))


def set_yaml(name: str, text: str, path: Path) -> None:
    """Change an entry of a YAML file to what a text of YAML says."""
    settings = yaml.load(path.read_text(), Loader=yaml.UnsafeLoader)
    settings.pop(name, None)
    path.write_text(f"{yaml.dump(dict(settings))}\n{name}: {text}\n")


ENV_KWARGS = (
    "3", "[]", "x", "{1: 2}", "{a b: 1}", "{g: [1, {a: /x}]}", CODE, f"{{g: {CODE}}}", "{unknown: 1}", "{g: x}",
    *(f"{{xml_file: '{path}'}}" for path in PATHS), *(f"{{width: {number}}}" for number in HUGE), "{g: .inf}",
    "{g: .nan}", "&a {g: *a}", "{g: &a [*a]}", "{g: 2024-01-01}", "{g: !!binary eA==}", "{g: !!set {a}}",
)  # fmt: skip
CONFIG: dict[str, tuple[str, ...]] = {
    "frame_stack": ("1000000000", "-1", "1.5", "true", "x", "[]", "{}", ".inf", "'1'", "null", "9" * 5000, CODE),
    "env_kwargs": ("null", *ENV_KWARGS),
    "normalize": (
        f'"{EVAL}"', f'"dict(a={EVAL})"', '"dict(**vars())"', "3", "[]", "x", '"[1, 2]"', '"3"', CODE,
        '"' + "(" * 5000 + '"', '"' + "-" * 5000 + '1"', '"dict(a=' + "[" * 900 + '"',
    ),
    "env_wrapper": (
        "os.system", "rl_zoo3.benchmark", "rl_zoo3.benchmark.main", "rl_zoo3.record_training.x", "this.s",
        "gymnasium.make",
        "antigravity.X", "gymnasium.wrappers.HumanRendering", "gymnasium.wrappers.TransformReward", "..x", "''", "3",
        "true",
        "gymnasium.wrappers.RecordVideo: {video_folder: videos}", "gymnasium.wrappers.RecordVideo",
        "gymnasium.wrappers.JaxToNumpy", "gymnasium.Wrapper", "stable_baselines3.common.vec_env.VecMonitor",
        "stable_baselines3.common.monitor.Monitor: {filename: precious}",
        "stable_baselines3.common.monitor.Monitor: {filename: 3}", "rl_zoo3.wrappers.FrameSkip: {skip: 1000000000}",
        "rl_zoo3.wrappers.HistoryWrapper: {horizon: 100000000}", "rl_zoo3.wrappers.FrameSkip: {env: 1}",
        "rl_zoo3.wrappers.FrameSkip: null", "rl_zoo3.wrappers.FrameSkip: [1]", "[[rl_zoo3.wrappers.FrameSkip]]",
        "gymnasium.wrappers.ResizeObservation: {shape: [100000, 100000]}", "[{a: {}, b: {}}]", "[{}]",
        "gymnasium.wrappers.DtypeObservation: {dtype: object}", "gymnasium.wrappers.RescaleAction: {min_action: x}",
        "gymnasium.wrappers.RescaleAction", "gymnasium.wrappers.FilterObservation: {filter_keys: [/x]}",
        "!!python/name:rl_zoo3.wrappers.FrameSkip ''", CODE, "&a [*a]",
    ),
    "vec_env_wrapper": (
        "stable_baselines3.common.vec_env.VecMonitor: {filename: precious}",
        "stable_baselines3.common.vec_env.VecVideoRecorder: {video_folder: v}", "os.system",
        "gymnasium.wrappers.ClipAction",
        "stable_baselines3.common.vec_env.VecFrameStack: {n_stack: 1000000000}",
        "stable_baselines3.common.vec_env.SubprocVecEnv",
        "stable_baselines3.common.vec_env.VecExtractDictObs: {key: x}",
        "rl_zoo3.benchmark.x",
    ),
    "replay_buffer_class": ("3", "[]", "null", "{}", CODE),
    "another": (
        CODE, "!!python/name:os.system ''", "!!python/name:torch.hub.load ''", "!!python/module:antigravity ''",
        "!!python/object/new:os.system [x]", "!!python/object:argparse.Namespace {}", "!!python/name:this.s ''",
        "!!python/name:sb3_contrib.x ''", "!!python/object/apply:builtins.eval ['1']", "!!python/tuple {a: 1}",
        "!!python/object/apply:collections.OrderedDict [1, 2]", "!!int x", "!!float x", "!!bool x", "!!int ''",
        "!!timestamp 2024-99-99", "9" * 5000, "? [1, 2]\n: 3", "? {a: 1}\n: 3", "{a: 1, <<: {b: 1}}",
        "1" + ":59" * 5000,
        "&a [*a]", "&a {a: *a}", "&a {*a: 1}", "&a !!python/tuple [*a]",
    ),
}  # fmt: skip
YAML_TEXTS = {
    "aliases of aliases": BOMB, "aliases in the place of arguments": f"{BOMB}\nenv_kwargs: {{g: *a9}}",
    "merged aliases": "a: &a {x: 1}\n" + "\n".join(f"b{i}: &b{i} {{<<: [*a, *a]}}" for i in range(9)),
    "a list": "- 1", "an open bracket": "a: [", "deep": "a: " + "[" * 5000, "deep keys": "? " * 5000,
    "many values": "a: [" + "1," * 9000 + "]", "many keys": "\n".join(f"a{i}: 1" for i in range(9000)), "a word": "x",
    "two documents": "a: 1\n---\nb: 2", "a number for a name": "1: 2\nenv_kwargs: null", "no UTF-8": "\udcff",
    "an anchor that is not there": "a: *b", "as long as may be": "a: [" + "1," * 2400 + "]\n#" + "x" * 2**15,
    "anchors": "\n".join(f"a{i}: &a{i} 1" for i in range(2500)), "quotes": "a: '" + "''" * 15_000,
    "a tag": "a: !<" + "x" * 30_000 + "> 1", "escapes": 'a: "' + "\\x41" * 8000 + '"',
    "a directive": "%YAML 9.9\n---\na: 1",
    "long lines": "a: " + "x " * 16_000, "indented": "\n".join(" " * i + "a:" for i in range(250)),
    "nothing but blanks": " \n" * 16_000, "control characters": "a: \x1b]0;x\a",
}  # fmt: skip
#: What says too much for a file of settings, and nothing that the zoo uses.
_SAID = {"anchors", "escapes", "long lines", "many keys", "indented", "as long as may be"}


def settings(file: str) -> Iterator[Case]:
    is_config = file.endswith("config.yml")
    fields = CONFIG if is_config else {"env_kwargs": ENV_KWARGS, "another": CONFIG["another"]}
    for name, texts in fields.items():
        for text in texts:
            # Of another entry nothing is used.
            must = name != "another" or "python" in text or "&" in text
            yield Case(file, name, f"{text:.80}", partial(set_yaml, name, text), must)
    for words, text in YAML_TEXTS.items():
        put = partial(_bytes, text.encode(errors="surrogateescape"))
        yield Case(file, "the text", words, put, words not in _SAID)


# ---------------------------------------------------------------- logs


def npy(shape: str, data: bytes, dtype: str = "'<f8'", fill: int = 0, version: bytes = b"\x01\x00") -> bytes:
    """An array's file, by what its header says."""
    text = f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}".encode() + b" " * fill
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY" + version + struct.pack("<H", len(text)) + text + data


def archive(entries: Mapping[str, bytes], how: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", how) as made:
        for name, data in entries.items():
            made.writestr(name, data)
    return file.getvalue()


def arrays(**values: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **{"timesteps": np.array([100, 200]), "results": np.ones((2, 2)), **values})
    return file.getvalue()


def _npz(change: Mapping[str, bytes], how: int = zipfile.ZIP_STORED) -> bytes:
    steps = npy("(2,)", struct.pack("<qq", 100, 200), "'<i8'")
    good = {"timesteps.npy": steps, "results.npy": npy("(2, 2)", b"\0" * 32)}
    return archive({**good, **change}, how)


def _lying(size: int) -> bytes:
    """An archive whose table says that an entry has another size."""
    data = bytearray(_npz({}, zipfile.ZIP_DEFLATED))
    place = data.rindex(b"PK\x01\x02")
    data[place + 24 : place + 28] = struct.pack("<I", size)
    return bytes(data)


def evaluations_files() -> dict[str, bytes]:
    """Files of evaluations that are none, in words."""
    zeros = b"\0" * 200 * 10**6
    return {
        "a bomb": _npz({"results.npy": npy("(2, 12500000)", zeros)}, zipfile.ZIP_DEFLATED),
        "a bomb beside": _npz({"another.npy": npy("(25000000,)", zeros)}, zipfile.ZIP_DEFLATED),
        "more numbers than bytes": _npz({"results.npy": npy("(2, 1000000000000)", b"")}),
        "numbers of no bytes": _npz({"results.npy": npy("(2, 1000000000000)", b"", "'|V0'")}),
        "texts of no bytes": _npz({"results.npy": npy("(1000000000000000, 2)", b"", "'<U0'")}),
        "a negative shape": _npz({"results.npy": npy("(-2, -2)", b"\0" * 32)}),
        "a huge shape": _npz({"results.npy": npy(f"({10**30}, 2)", b"")}),
        "a shape of words": _npz({"results.npy": npy("('x', 2)", b"")}),
        "objects": arrays(results=np.array([[Payload(), 1], [2, 3]], dtype=object)),
        "objects by their header": _npz({"results.npy": npy("(1, 1)", pickle.dumps(Payload()), "'|O'")}),
        "a record": _npz({"results.npy": npy("(2, 2)", b"\0" * 32, "[('a', '<f8')]")}),
        "a long header": _npz({"results.npy": npy("(2, 2)", b"\0" * 32, fill=60_000)}),
        "a deep header": _npz({"results.npy": npy("(" * 2000, b"")}),
        "another version": _npz({"results.npy": npy("(2, 2)", b"\0" * 32, version=b"\x03\x00")}),
        "a header that is code": _npz({"results.npy": npy(EVAL, b"\0" * 32)}),
        "many entries": archive({f"{i}.npy": b"" for i in range(20_000)}),
        "an entry that is no array": _npz({"results": b"x"}),
        "names twice": archive({"timesteps.npy": npy("(2,)", b"\0" * 16, "'<i8'"), "results.npy/": b"",
        "x/../y.npy": b""}),
        "a wrong size": _lying(10), "a huge size": _lying(2**31), "a size of all": _lying(2**32 - 1),
        "an archive in an archive": archive({"timesteps.npy": archive({}), "results.npy": archive({})}),
        "no timesteps": archive({"results.npy": npy("(2, 2)", b"\0" * 32)}),
        "timesteps of no axis": arrays(timesteps=np.array(100)), "no evaluation": arrays(
            timesteps=np.array([], int), results=np.ones((0, 2))),
        "timesteps of two axes": arrays(timesteps=np.array([[100, 200]])),
        "timesteps that fall": arrays(timesteps=np.array([200, 100])),
        "negative ones": arrays(timesteps=np.array([-2, -1])),
        "timesteps that are huge": arrays(timesteps=np.array([1, 2**62])),
        "fractions": arrays(timesteps=np.array([0.5, 1])),
        "timesteps that are texts": arrays(timesteps=np.array(["1", "2"])),
        "results of one axis": arrays(results=np.ones(2)), "results of no axis": arrays(results=np.array(1.0)),
        "results of three axes": arrays(results=np.ones((2, 2, 2))),
        "other evaluations": arrays(results=np.ones((3, 2))),
        "no episode": arrays(results=np.ones((2, 0))), "complex results": arrays(results=np.ones((2, 2), complex)),
        "times": arrays(results=np.ones((2, 2), "M8[s]")), "an array of another length": arrays(another=np.ones(5)),
    }  # fmt: skip


def evaluations(file: str) -> Iterator[Case]:
    for words, data in evaluations_files().items():
        yield Case(file, "an array", words, partial(_bytes, data))
    for words, value in (("not finite", np.nan), ("infinite", np.inf), ("huge", 1e308)):
        yield Case(file, "results", words, partial(_bytes, arrays(results=np.full((2, 2), value))), False)


_HEAD = '#{"t_start": 1.0, "env_id": "Pendulum-v1"}\nr,l,t\n'
MONITORS = {
    "no head": "r,l,t\n1,2,3\n", "a head that is no JSON": "#{\nr,l,t\n1,2,3\n", "a deep head": f"#{DEEP}\nr,l,t\n",
    "a head that is a list": "#[]\nr,l,t\n1,2,3\n", "a head of nothing": "#null\nr,l,t\n",
    "no start": "#{}\nr,l,t\n1,2,3\n",
    "a start that is a text": '#{"t_start": "x"}\nr,l,t\n1,2,3\n',
    "one that is none": '#{"t_start": NaN}\nr,l,t\n1,2,3\n',
    "one that is endless": '#{"t_start": 1e999}\nr,l,t\n1,2,3\n',
    "one that is a list": '#{"t_start": []}\nr,l,t\n1,2,3\n',
    "an id that is a number": '#{"t_start": 1, "env_id": 3}\nr,l,t\n1,2,3\n', "only a head": '#{"t_start": 1.0}\n',
    "an id that leads elsewhere": '#{"t_start": 1, "env_id": "../../x/\\u0000"}\nr,l,t\n1,2,3\n',
    "an id of a thousand letters": '#{"t_start": 1, "env_id": "' + "x" * 1000 + '"}\nr,l,t\n1,2,3\n',
    "a head without an end": "#" + "x" * 10**6,
}  # fmt: skip
EPISODES = {
    "no columns": "#{\"t_start\": 1.0}\n\n1,2,3\n", "other columns": _HEAD.replace("r,l,t", "a,b,c") + "1,2,3\n",
    "texts": _HEAD + "x,y,z\n" * 3, "a text among numbers": _HEAD + "1,200,3\n" * 3 + "x,2,3\n",
    "more columns than the head": _HEAD + "1,200,3\n" + "1,200,3,4,5\n" * 3,
    "a length of nothing": _HEAD + "1,0,3\n" * 3,
    "a negative length": _HEAD + "1,-5,3\n" * 3, "an endless length": _HEAD + "1,inf,3\n" * 3,
    "a huge length": _HEAD + "1,1e300,3\n" * 3, "an endless time": _HEAD + "1,200,inf\n" * 3,
    "a line of commas": _HEAD + "," * 9 * 10**6, "columns without end": _HEAD.replace("r,l,t", "r,l,t" + ",x" * 10**6),
    "a quote without end": _HEAD + '"' + "1,200,3\n" * 10**6, "many episodes": _HEAD + "1,200,3\n" * 1_100_000,
    "nul": _HEAD + "1,200,3\n\0\0\0\n", "rows of too many columns": _HEAD + ("1,200,3" + ",1" * 1000 + "\n") * 5000,
}  # fmt: skip
#: Of which what is beside the columns is passed over.
_TAKEN = {"more columns than the head", "nul"}


def monitor(file: str) -> Iterator[Case]:
    for words, text in MONITORS.items():
        yield Case(file, "the head", words, partial(_bytes, text.encode()))
    for words, text in EPISODES.items():
        # A run that goes on appends to it, and reads its head only.
        must = not file.startswith(RUN) and words not in _TAKEN
        yield Case(file, "the episodes", words, partial(_bytes, text.encode()), must)


# ---------------------------------------------------------------- stored trials

TRIALS: dict[str, Any] = {
    "policy_kwargs": EVAL, "replay_buffer_class": EVAL, "normalize": EVAL, "monitor_kwargs": EVAL, "policy": "this.s",
    "env_wrapper": "rl_zoo3.benchmark.x", "callback": "antigravity.X", "n_timesteps": 10**12, "n_envs": 10**9,
    "frame_stack": 10**9, "learning_rate": EVAL, "batch_size_pow": 10**9, "one_minus_gamma": -5.0, "tau": "x",
    "pessimism": float("inf"), "buffer_size": 10**12, "train_freq": "x", "n_sampled_goal": 4, "model_size": "0.55M",
    "goal_selection_strategy": "antigravity",
}  # fmt: skip


def _sql(statements: tuple[tuple[str, tuple[Any, ...]], ...], path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path)) as database:
        for statement, values in statements:
            database.execute(statement, values)
        database.commit()


def _distribution(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps({"name": "CategoricalDistribution", "attributes": {"choices": [value]}})
    name, attributes = (
        ("IntDistribution", {"step": 1}) if isinstance(value, int) else ("FloatDistribution", {"step": None})
    )
    return json.dumps({"name": name, "attributes": {"log": False, "low": value, "high": value, **attributes}})


def _stored(name: str, value: Any, path: Path) -> None:
    """Set a parameter of trial 1 in a database."""
    trial = "(SELECT trial_id FROM trials WHERE number = 1)"
    internal = 0 if isinstance(value, str) else value
    _sql((
        (f"DELETE FROM trial_params WHERE trial_id = {trial} AND param_name = ?", (name,)),
        ("INSERT INTO trial_params (trial_id, param_name, param_value, distribution_json) VALUES "
         f"({trial}, ?, ?, ?)", (name, internal, _distribution(value))),
    ), path)  # fmt: skip


DATABASES: dict[str, tuple[str, ...]] = {
    "endless view": (
        "ALTER TABLE studies RENAME TO s2",
        "CREATE VIEW studies AS WITH RECURSIVE c(study_id, study_name) AS (SELECT 1, "
        "'s' UNION ALL SELECT study_id + 1, 'x' FROM c) SELECT * FROM c",
    ),
    "trigger": ("CREATE TRIGGER x AFTER INSERT ON trials BEGIN DELETE FROM trials; END",),
    "computed column": ("ALTER TABLE studies ADD COLUMN x GENERATED ALWAYS AS (hex(zeroblob(900000000)))",),
    "no tables": ("DROP TABLE trials", "DROP TABLE studies"),
    "no study": ("DELETE FROM studies",),
    "no trials": ("DELETE FROM trials",),
    "a distribution that is none": ("UPDATE trial_params SET distribution_json = '[]'",),
    "a deep distribution": (f"UPDATE trial_params SET distribution_json = '{DEEP}'",),
    "a distribution of code": (
        """UPDATE trial_params SET distribution_json = '{"name": "__class__", "attributes": {}}'""",
    ),
    "values that are texts": ("UPDATE trial_params SET param_value = 'x'",),
}


def database(file: str) -> Iterator[Case]:
    for name, value in TRIALS.items():
        yield Case(file, name, f"{value!r:.60}", partial(_stored, name, value))
    for words, statements in DATABASES.items():
        put = partial(_sql, tuple((statement, ()) for statement in statements))
        yield Case(file, "the database", words, put)


def _logged(name: str, value: Any, path: Path) -> None:
    """Set a parameter of trial 1 in a journal."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    place = next(i for i, line in enumerate(lines) if line["op_code"] == 5 and line["trial_id"] == 1)
    internal = 0 if isinstance(value, str) else value
    changed = {
        **lines[place],
        "param_name": name,
        "param_value_internal": internal,
        "distribution": _distribution(value),
    }
    # Those of the other trial would have to be of the same kind. The last line ends the trial.
    kept = [line for line in lines if line.get("param_name") != name]
    kept.insert(len(kept) - 1, changed)
    path.write_text("".join(json.dumps(line) + "\n" for line in kept))


JOURNALS = {
    "no operation": "{}\n", "a list": "[]\n", "a number": "1\n", "an operation that is none": '{"op_code": 99}\n',
    "deep": DEEP + "\n", "of a study that is not there": '{"op_code": 4, "worker_id": "x", "study_id": 7}\n',
    "an operation of code": '{"op_code": "__import__", "worker_id": "x"}\n', "no end": '{"op_code": 0',
}  # fmt: skip


def journal_cases(file: str) -> Iterator[Case]:
    for name, value in TRIALS.items():
        yield Case(file, name, f"{value!r:.60}", partial(_logged, name, value))
    for words, text in JOURNALS.items():
        yield Case(file, "the journal", words, partial(_bytes, text.encode()))


# ---------------------------------------------------------------- tables of plots


def _tables(value: Any, path: Path) -> None:
    from sb3_sample.saving import container
    from sb3_sample.saving.encoding import encode

    tensors: dict[str, Any] = {}
    container.write(path, "plotted runs", encode(value, "runs", tensors), tensors)


_CURVE = {"timesteps": np.arange(3), "mean": np.ones(3), "std_error": np.ones(3), "last_evals": np.ones(2)}
_TABLE = {"headers": ["a"], "value_matrix": [["b"]]}
TABLES: dict[str, Any] = {
    "a list": [], "a number": 3, "nothing": {}, "no curves": {"results_table": _TABLE, "a": 3},
    "a curve that is none": {"results_table": _TABLE, "a": {"b": 3}}, "no table": {"a": {"b": _CURVE}},
    "a curve of texts": {"results_table": _TABLE, "a": {"b": {**_CURVE, "mean": "x"}}},
    "an empty curve": {"results_table": _TABLE, "a": {"b": {}}}, "tables that are none": {"results_table": [], "a": {}},
    "no headers": {"results_table": {"value_matrix": []}, "a": {"b": _CURVE}},
    "rows that are none": {"results_table": {"headers": ["a"], "value_matrix": 3}, "a": {"b": _CURVE}},
    "cells that are none": {"results_table": {"headers": ["a"], "value_matrix": [[{}]]}, "a": {"b": _CURVE}},
    "a word to the terminal": {"results_table": {"headers": ["\x1b]0;x\a"], "value_matrix": [["b"]]},
    "a": {"b": _CURVE}},
    "axes that do not fit": {"results_table": _TABLE, "a": {"b": {**_CURVE, "mean": np.ones((7, 7, 7))}}},
    "names that are numbers": {1: {"b": _CURVE}, "results_table": _TABLE},
}  # fmt: skip


def tables(file: str) -> Iterator[Case]:
    for words, value in TABLES.items():
        yield Case(file, "the tables", words, partial(_tables, value))


# ---------------------------------------------------------------- the table

_KINDS: dict[str, Callable[[str], Iterator[Case]]] = {
    "run.json": record, "args.yml": settings, "config.yml": settings, "evaluations.npz": evaluations,
    "0.monitor.csv": monitor, "study.db": database, "study.log": journal_cases, "all.pkl": tables,
}  # fmt: skip


def cases() -> Iterator[Case]:
    """All of them."""
    for file in READERS:
        yield from anything(file)
        yield from _KINDS.get(Path(file).name, lambda _: iter(()))(file)


# ---------------------------------------------------------------- what a command does with it


class FolderWatch(Watch):
    """Notes what is run, and what is written outside of the present folder."""

    def _hear(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "import":
            self.modules.add(args[0])
        elif event == "open" and not (isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
            return
        elif event == "open" or event in self.EVENTS:
            # Of these the first argument is what is changed.
            is_file = event == "open" or event.startswith(
                ("os.re", "os.mk", "os.rm", "os.tr", "os.ch", "shutil.rmtree")
            )
            if not (is_file and _is_inside(args[0])):
                self.seen.append(f"{event} {args!r:.200}")


def _is_inside(path: Any) -> bool:
    if not isinstance(path, (str, bytes, os.PathLike)):
        return isinstance(path, int)
    name = os.path.abspath(os.fsdecode(path))
    # Stable-Baselines3 makes a folder for the log of every training.
    allowed = (f"{Path.cwd()}/", os.devnull, f"{tempfile.gettempdir()}/SB3-")
    return f"{name}/".startswith(allowed)


#: Modules that a hostile file names.
NAMED = {"antigravity", "this", "rl_zoo3.benchmark", "rl_zoo3.record_training"}


class Hangs(BaseException):
    """What nothing takes for an error in a file."""


@contextlib.contextmanager
def limits(seconds: int = 300) -> Iterator[None]:
    """A command that hangs or takes the machine's memory fails instead."""

    def stop(*_: Any) -> None:
        raise Hangs

    before = signal.signal(signal.SIGALRM, stop)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    size = next(int(line.split()[1]) for line in Path("/proc/self/status").read_text().splitlines() if "VmSize" in line)
    resource.setrlimit(resource.RLIMIT_AS, (size * 1024 + HEADROOM // 4, hard))
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def throw(case: Case, command: str, watch: FolderWatch) -> dict[str, Any]:
    """
    Run a command with a hostile file, in the present folder, which was made for it.

    :return: what came out, what is wrong with it (None if nothing), and what it took
    """
    precious = {Path("precious.monitor.csv"): b"the user's", Path("precious"): b"the user's"}
    for path, data in precious.items():
        path.write_bytes(data)
    case.put(Path(case.file))
    said, outcome, wrong = io.StringIO(), "done", None
    forget_peak()
    before, start = peak(), time.process_time()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()), limits(), watch.watching():
        try:
            run(COMMANDS[command])
        except SystemExit as end:
            outcome = "refused"
            lines = [line for line in said.getvalue().splitlines() if line.startswith("sb3-sample")]
            if end.code != 2 or len(lines) != 1 or lines[0] != str(end) or not lines[0].isprintable():
                wrong = f"it ended with {end.code!r} and {said.getvalue()[-300:]!r}"
        except BaseException as error:  # of any kind: that is what is tested
            outcome = type(error).__name__
            wrong = f"{outcome}: {error!s:.300}"
    taken = {"seconds": time.process_time() - start, "bytes": peak() - before}
    if outcome == "done" and case.must and command not in case.but:
        wrong = "it was not refused"
    if outcome == "refused" and (taken["seconds"] > SECONDS or taken["bytes"] > BYTES):
        wrong = f"{wrong or ''} to refuse it took {taken}"
    if watch.seen or NAMED & watch.modules:
        wrong = f"{wrong or ''} it did {watch.seen}, and imported {NAMED & watch.modules}"
    if Path(MARKER).exists():
        wrong = f"{wrong or ''} code was run"
        Path(MARKER).rmdir()
    if changed := [str(path) for path, data in precious.items() if path.read_bytes() != data]:
        wrong = f"{wrong or ''} {changed} changed"
    message = said.getvalue().strip().splitlines()[-1:]
    return {"case": str(case), "command": command, "outcome": outcome, "wrong": wrong, "message": message, **taken}
