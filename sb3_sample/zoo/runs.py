"""
Runs of ``sb3-sample train`` that resume where they were interrupted (``--run-dir``, ``--checkpoint-freq``,
``--resume``), and runs that learn from data (``--dataset``, ``--offline-steps``, ``--prior-data``).

Besides the checkpoints and the zoo's files, the folder of a run with checkpoints has a record ``run.json`` of how it
was started. A run that learns from data first and then in its environment has the checkpoints of the first part in
``offline``.
"""

import argparse
import contextlib
import difflib
import functools
import json
import os
import re
import shutil
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import rl_zoo3.exp_manager
import rl_zoo3.train
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS, get_wrapper_class
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat, configure
from stable_baselines3.common.monitor import Monitor, get_monitor_files
from stable_baselines3.common.utils import get_latest_run_id
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sample.diagnostics import DiagnosticsCallback
from sb3_sample.envs.atari import AtariFrames
from sb3_sample.envs.registration import check_game, is_atari_id
from sb3_sample.lockstep import Seat, present
from sb3_sample.replay.dataset import Dataset
from sb3_sample.replay.reading import read_dataset
from sb3_sample.run_logs import OFFLINE, monitor_files, monitor_head
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.many import train_together
from sb3_sample.saving.container import replacing
from sb3_sample.saving.folders import Folder, is_plain
from sb3_sample.saving.normalization import lacks_vec_normalize
from sb3_sample.saving.temporary import is_temporary
from sb3_sample.saving.training_state import argument_names
from sb3_sample.saving.untrusted import BadFile, parse_json, read_regular
from sb3_sample.training.seats import all_made
from sb3_sample.warn import warn
from sb3_sample.zoo.algorithms import ALGORITHMS
from sb3_sample.zoo.files import RunError, add_trust
from sb3_sample.zoo.patches import managed_by, monitors_go_on

RECORD = "run.json"
#: Largest size of a record, in bytes.
MAX_RECORD = 2**18
#: Endings of the files that a run writes.
SUFFIXES = (".csv", ".json", ".jsonl", ".npz", ".yml", ".zip")
#: Environment steps between two checkpoints.
CHECKPOINT_FREQ = 10_000
#: Arguments of the zoo that identify a run, besides its hyperparameters. Its length, its device and its output may
#: change.
COMPARED = (
    "algo", "env", "seed", "trained_agent", "truncate_last_trajectory", "vec_env", "env_kwargs", "eval_env_kwargs",
    "eval_freq", "eval_episodes", "n_eval_envs", "save_freq",
)  # fmt: skip
#: Hyperparameters from which the zoo makes ``action_noise``.
_OF_NOISE = {"noise_type", "noise_std"}
#: Settings that change the observations, and belong to a trained model as its arguments do.
_OF_STATISTICS = {"normalize"}
#: Arguments that the zoo's options set.
_OF_OPTIONS = {"env", "seed", "verbose", "device", "tensorboard_log"}


class Record(NamedTuple):
    """
    How a run was started.

    :param algo: name of its algorithm
    :param env: id of its environment
    :param seed: its seed, which the zoo draws if none is given
    :param n_timesteps: ``-n``, or -1 if it was not given
    :param checkpoint_freq: environment steps between two checkpoints
    :param settings: arguments and hyperparameters by name, as Python writes them; only compared, never evaluated
    :param tensorboard: folder of its TensorBoard log, if it has one
    """

    algo: str
    env: str
    seed: int
    n_timesteps: int
    checkpoint_freq: int
    settings: dict[str, str]
    tensorboard: str | None = None

    def write(self, folder: Path) -> None:
        """
        :param folder: the run's folder
        :raises OSError: it cannot be written; one that was there is unchanged then
        """
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(folder / RECORD) as file:
            file.write(json.dumps(self._asdict(), indent=1).encode())

    @classmethod
    def read(cls, folder: Path) -> "Record":
        """
        :param folder: the run's folder
        :return: its record
        :raises RunError: there is none, or it is no such record
        """
        path = folder / RECORD
        try:
            found = parse_json(read_regular(path, MAX_RECORD), "it")
        except FileNotFoundError as error:
            raise RunError(f"{folder} is no folder of a run of sb3-sample train: it has no {RECORD}") from error
        except (OSError, BadFile) as error:
            raise RunError(f"{path} is not what sb3-sample train has written: {error}") from error
        if not isinstance(found, dict) or not cls._field_defaults.keys() | found.keys() == set(cls._fields):
            raise RunError(f"{path} is not what sb3-sample train has written: it has other entries")
        record = cls(**found)
        for name, value in record._asdict().items():
            if not _RECORDED[name](value):
                raise RunError(
                    f"{path} is not what sb3-sample train has written: a value is of the wrong kind, {name} is "
                    f"{value!r:.100}"
                )
        return record


def _is_id(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch(r"\w[\w:./-]{0,200}", value) is not None


def _is_within(low: int, high: int) -> Callable[[Any], bool]:
    return lambda value: type(value) is int and low <= value < high


def _are_texts(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(text, str) for text in value.values())


#: Checks of the entries of a record.
_RECORDED: dict[str, Callable[[Any], bool]] = {
    "algo": _is_id,
    "env": _is_id,
    "seed": _is_within(0, 2**32),
    "n_timesteps": _is_within(-1, 2**53),
    "checkpoint_freq": _is_within(1, 2**53),
    "settings": _are_texts,
    "tensorboard": lambda value: value is None or isinstance(value, str),
}


class Data(NamedTuple):
    """
    Data sets that a run learns from: paths or ids of Minari's, or HDF5 files.

    :param dataset: for the gradient steps without an environment
    :param offline_steps: how many of the run's steps are such gradient steps; None: all
    :param prior_data: for a share of every batch while learning in the environment
    """

    dataset: str | None = None
    offline_steps: int | None = None
    prior_data: str | None = None

    @classmethod
    def of(cls, options: argparse.Namespace) -> "Data":
        """
        :param options: what ``train_parser`` has parsed
        :return: the data sets that they name
        :raises RunError: they do not fit together, or are out of range
        """
        data = cls(*(getattr(options, name) for name in cls._fields))
        if data.offline_steps is not None and data.dataset is None:
            raise RunError(f"--offline-steps {data.offline_steps} means nothing without --dataset: give it too")
        if data.offline_steps is not None and data.offline_steps < 1:
            raise RunError(f"--offline-steps must be at least 1, in gradient steps, not {data.offline_steps}")
        return data


class Start(NamedTuple):
    """
    How a run starts or resumes.

    :param arguments: command line for the zoo, without our options
    :param checkpoint_freq: environment steps between two checkpoints
    :param folder: the run's folder; None for a new one that the zoo chooses
    :param record: how the run was started, if it resumes
    """

    arguments: list[str]
    checkpoint_freq: int
    folder: Path | None = None
    record: Record | None = None


def check_entries(folder: Path) -> None:
    """
    :param folder: a run's folder
    :raises RunError: an entry of it, or of a folder in it, is a link, by which the run would write elsewhere; or a pipe
        or a device, which may never end; or a folder with the name of a file
    """
    for path in (*folder.glob("*"), *folder.glob("*/*")):
        if path.is_symlink():
            raise RunError(
                f"{path} is a link, and a run follows none in its folder (the folder itself may be one): remove it, or "
                "name another --run-dir"
            )
        is_folder = path.is_dir() and path.suffix not in SUFFIXES
        if not (path.is_file() or is_folder):
            raise RunError(f"{path} is no file, where a run has one: remove it, or name another --run-dir")


def check_monitor_files(folder: Path) -> None:
    """
    :param folder: folder of a run that resumes
    :raises RunError: a file that Monitor would append to is no file of Monitor's
    """
    for path in monitor_files(folder):
        try:
            monitor_head(path)
        except (OSError, BadFile) as error:
            raise RunError(f"{error}. The run would append to {path}: remove it, and a new one is begun") from error


def checkpoints(folder: Path) -> list[Path]:
    """
    :param folder: a run's folder
    :return: the folders of its checkpoints, oldest first; the checkpoints are not opened
    """
    return sorted(path for path in folder.glob("checkpoint-*") if re.fullmatch(r"checkpoint-\d{12,}", path.name))


def all_checkpoints(folder: Path) -> list[Path]:
    """
    :param folder: a run's folder
    :return: as ``checkpoints``, those of the steps on a data set first
    """
    return [*checkpoints(folder / OFFLINE), *checkpoints(folder)]


def train_parser() -> argparse.ArgumentParser:
    """
    :return: parser of the options that ``train`` takes besides the zoo's
    """
    parser = argparse.ArgumentParser("sb3-sample train", usage=argparse.SUPPRESS, add_help=False, allow_abbrev=False)
    group = parser.add_argument_group("runs that go on where they were interrupted (our algorithms)")
    group.add_argument(
        "--run-dir",
        type=Path,
        metavar="DIR",
        help="Folder of this run, with checkpoints. The same command, given again, goes on with it",
    )
    group.add_argument(
        "--checkpoint-freq",
        type=int,
        metavar="N",
        help=f"Environment steps between two checkpoints (default: {CHECKPOINT_FREQ}). Without --run-dir the run gets "
        "a new folder below the log folder, as without checkpoints",
    )
    group.add_argument(
        "--resume",
        action="store_true",
        help="Go on, with the same arguments as before, with the run in --run-dir, or else with the run of --algo, "
        "--env and --seed (if given) below the log folder that has the latest checkpoint; an error if there is none",
    )
    group = parser.add_argument_group("many seeds in one process (our off-policy algorithms)")
    group.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        metavar="N",
        help="How many seeds, from 0 on, or several seeds by name: a run of each, with a folder of its own, as by as "
        "many commands with --seed; --run-dir then has the folders seed-0, seed-1 and so on (docs/many_learners.md)",
    )
    group = parser.add_argument_group("data that are there already (the family of SAC; --dataset not dr_q)")
    group.add_argument(
        "--dataset",
        metavar="PATH",
        help="Learn from a data set, -n gradient steps: a folder or an id of Minari's, or an HDF5 file in D4RL's "
        "layout. The environment is for evaluations then",
    )
    group.add_argument(
        "--offline-steps",
        type=int,
        metavar="N",
        help="With --dataset: so many of the -n steps are gradient steps on it, the rest is learned in the environment",
    )
    group.add_argument(
        "--prior-data",
        metavar="PATH",
        help="Data set that a share of every batch is taken from while learning in the environment (prior_share, 0.5)",
    )
    add_trust(parser.add_argument_group("files that run no code (our algorithms)"))
    return parser


def plan(options: argparse.Namespace, arguments: Sequence[str]) -> Start | None:
    """
    :param options: what ``train_parser`` has parsed
    :param arguments: the rest of the command line
    :return: how the run starts; None for one without checkpoints
    :raises RunError: if it cannot
    """
    _check_agent(arguments)
    if options.run_dir is None and options.checkpoint_freq is None and not options.resume:
        return None
    freq = options.checkpoint_freq
    if freq is not None and freq < 1:
        raise RunError(f"--checkpoint-freq must be at least 1, in environment steps, not {freq}")
    folder = options.run_dir
    if folder is None:
        if not options.resume:
            return Start(list(arguments), freq)
        folder = _latest(arguments)
    for each in folder, folder / OFFLINE:
        check_entries(each)
    if not all_checkpoints(folder):
        if options.resume:
            raise RunError(f"--resume: {folder} has no checkpoint to go on from")
        # A run that was interrupted before its first checkpoint has its record, or a part of it.
        is_empty = folder.is_dir() and all(is_temporary(path.name) for path in folder.iterdir())
        if folder.exists() and not (is_empty or (folder / RECORD).exists()):
            raise RunError(
                f"--run-dir {folder} holds files, but no run with checkpoints: it must be the folder of such a run, an "
                "empty one or none"
            )
        return Start(list(arguments), freq or CHECKPOINT_FREQ, folder)
    record = Record.read(folder)
    check_monitor_files(folder)
    # Further arguments of the command line replace these.
    command = ["--seed", str(record.seed), "-n", str(record.n_timesteps), *arguments]
    return Start(command, freq or record.checkpoint_freq, folder, record)


def _check_agent(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("-i", "--trained-agent", default="")
    agent = parser.parse_known_args(arguments)[0].trained_agent
    if agent and not (agent.endswith(".zip") and os.path.isfile(agent)):
        is_missing = agent.endswith(".zip") and not os.path.exists(agent)
        raise RunError(
            f"-i must be a .zip file of a model, not {agent!r}" + (", which is not there" if is_missing else "")
        )


def _latest(arguments: Sequence[str]) -> Path:
    """
    The run with the latest checkpoint, among those of a command line's algorithm, environment and, if given, seed.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo")
    parser.add_argument("--env")
    parser.add_argument("--seed", type=int, default=-1)
    parser.add_argument("-f", "--log-folder", type=Path, default=Path("logs"))
    asked = parser.parse_known_args(arguments)[0]
    if asked.algo is None or asked.env is None:
        raise RunError("--resume needs --run-dir, or --algo and --env, to know which run to go on with")
    is_given = asked.seed >= 0  # otherwise the zoo draws one
    found = []
    for file in asked.log_folder.rglob(RECORD):
        made = all_checkpoints(file.parent)
        with contextlib.suppress(RunError):  # some other program's file of that name
            record = Record.read(file.parent)
            of_seed = not is_given or record.seed == asked.seed
            if made and of_seed and (record.algo, record.env) == (asked.algo, asked.env):
                found.append((made[-1].stat().st_mtime, file.parent))
    if not found:
        raise RunError(
            f"--resume: no run of {asked.algo} on {asked.env}{f' with seed {asked.seed}' if is_given else ''} below "
            f"{asked.log_folder} has a checkpoint. Runs have checkpoints if they are started with --run-dir or "
            "--checkpoint-freq"
        )
    return max(found)[1]


@contextlib.contextmanager
def training() -> Iterator[Callable[[Start | None, Sequence[str], Data], None]]:
    """
    Let the zoo's ``train`` make our runs.

    :return: a function that makes a run. Its arguments are how the run starts (None for one without checkpoints), the
        command line for the zoo, without our options, and the data sets that it learns from. Trainings in lockstep call
        it at the same time
    """
    starts: dict[Seat | None, tuple[Start | None, Data]] = {}

    def manager(*positional: Any, **named: Any) -> Manager:
        start, data = starts[present()]
        return Manager(data, *positional, **named) if start is None else RunManager(start, data, *positional, **named)

    def train(start: Start | None, arguments: Sequence[str], data: Data) -> None:
        starts[present()] = start, data
        # The zoo reads it at once.
        sys.argv = ["sb3-sample train", *arguments]
        rl_zoo3.train.train()

    with managed_by(manager, rl_zoo3.train):
        yield train


def train(start: Start | None, arguments: Sequence[str], data: Data = Data()) -> None:  # noqa: B008  # immutable
    """
    Make a run as the zoo's ``train`` does.

    :param start: how a run with checkpoints starts; None for one without
    :param arguments: command line for the zoo, without our options, of a run without checkpoints
    :param data: data sets that it learns from
    :raises RunError: if it cannot start or resume in this way
    :raises Refused: if an argument is not valid Python
    :raises KeyboardInterrupt: after Ctrl-C, when the zoo has saved the model
    """
    with training() as make:
        make(start, arguments if start is None else start.arguments, data)


def train_seeds(options: argparse.Namespace, arguments: Sequence[str]) -> None:
    """
    Make a run for each seed, all in this process, as separate commands would.

    :param options: what ``train_parser`` has parsed, with ``seeds``
    :param arguments: the rest of the command line
    :raises RunError: if they cannot start or resume in this way
    :raises KeyboardInterrupt: after Ctrl-C, when the zoo has saved the models; a ``SystemExit`` after SIGTERM
    :raises SystemExit: if a run has failed, after the end of the others
    """
    seeds, data = _seeds(options.seeds, arguments), Data.of(options)
    if data.dataset is not None:
        raise RunError(f"--dataset {data.dataset} does not go with --seeds: leave one of them out")
    failed: dict[int, BaseException] = {}

    def body(seed: int, start: Start | None, command: Sequence[str]) -> None:
        try:
            make(start, command, data)
        except Exception as error:
            seat = present()
            assert seat is not None
            if not seat.began:
                raise
            failed[seed] = error
            print(f"The run of seed {seed} has failed, and the others go on:", file=sys.stderr)
            traceback.print_exception(error)

    seats = []
    for seed in seeds:
        folder = None if options.run_dir is None else options.run_dir / f"seed-{seed}"
        command = [*arguments, "--seed", str(seed)]
        start = plan(argparse.Namespace(**{**vars(options), "run_dir": folder}), command)
        own = functools.partial(body, seed, start, command if start is None else start.arguments)
        seats.append(Seat(f"the run of seed {seed}", own, start.folder if folder is None and start else folder))
    saves = options.run_dir is not None or options.checkpoint_freq is not None or options.resume
    with training() as make:
        try:
            train_together(seats, (options.run_dir or Path("logs")) if saves else None)
        except KeyboardInterrupt as error:
            on = f"the same command with --run-dir {options.run_dir} goes on" if options.run_dir else "all were saved"
            raise KeyboardInterrupt(f"interrupted; {on}") from error
    if failed:
        words = "; ".join(f"seed {seed}: {type(error).__name__}: {error}" for seed, error in failed.items())
        print(f"sb3-sample train: {len(failed)} of {len(seeds)} runs have failed: {words}", file=sys.stderr)
        raise SystemExit(1)


def _seeds(given: Sequence[int], arguments: Sequence[str]) -> list[int]:
    """The seeds that ``--seeds`` asks for; refuses a command line that cannot be one of many."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default="ppo")
    for option in ("--seed", "-optimize", "--optimize-hyperparameters", "--progress", "-P", "--track"):
        parser.add_argument(option, dest=option, nargs="?", const=True)
    asked = vars(parser.parse_known_args(arguments)[0])
    if not can_train_together(algo := asked.pop("algo")):
        names = ", ".join(name for name in ALGORITHMS if can_train_together(name))
        raise RunError(f"--seeds is for the off-policy algorithms of this package, {names}, not --algo {algo}")
    for option, value in asked.items():
        if value is not None:
            raise RunError(f"{option} does not go with --seeds: leave one of them out")
    if len(given) == 1:
        if given[0] < 1:
            raise RunError(f"--seeds must be at least 1, if it is how many, not {given[0]}")
        return list(range(given[0]))
    if wrong := [seed for seed in given if not 0 <= seed < 2**32]:
        raise RunError(f"a seed of --seeds must be at least 0 and below {2**32}, not {wrong[0]}")
    if len(set(given)) < len(given):
        raise RunError(f"--seeds must differ, not {' '.join(map(str, given))}")
    return list(given)


def can_train_together(algo: str) -> bool:
    """
    :param algo: name of an algorithm
    :return: whether runs of several seeds can be made in one process
    """
    return algo in ALGORITHMS and issubclass(ALGORITHMS[algo].algorithm, SAC)


class Manager(ExperimentManager):
    """
    The zoo's manager, extended: it names unknown hyperparameters, trains a model on with the settings of its file, does
    not take an interrupted run for a finished one, can learn from data, and evaluates whole games of Atari.

    :param data: data sets to learn from
    :param args: the command line, as parsed by the zoo
    :param positional: further arguments of the zoo's manager
    :param named: further arguments of the zoo's manager
    :raises RunError: if the run cannot learn from such data
    """

    #: Message for an interrupted run.
    _interrupted = "interrupted; the model was saved as it was"

    def __init__(self, data: Data, args: argparse.Namespace, *positional: Any, **named: Any):
        _check_data(data, args)
        super().__init__(args, *positional, **named)
        self._data = data
        self._dataset: Dataset | None = None
        # The names of a stored trial's hyperparameters.
        self._of_trial: set[str] = set()
        # Settings of the model that is trained on, for those who read the run's.
        self._of_agent: dict[str, Any] = {}

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        was_there = os.path.exists(self.save_path)
        try:
            return super().setup_experiment()  # type: ignore[no-any-return]
        except BaseException:
            # ``enjoy`` would take the folder of a refused run for the latest one.
            if not was_there:
                shutil.rmtree(self.save_path, ignore_errors=True)
            raise

    def load_trial(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        found: dict[str, Any] = super().load_trial(*args, **kwargs)
        self._of_trial = set(found)
        return found

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        hyperparams, saved = super().read_hyperparameters()
        if self.continue_training and self.algo in ALGORITHMS:
            # The entry of the task is not what the model was trained with: its file has that.
            given = {*(self.custom_hyperparams or {}), *self._of_trial}
            of_model = argument_names(ALGOS[self.algo]) | _OF_NOISE | _OF_STATISTICS
            if dropped := sorted((of_model & saved.keys()) - given):
                print(f"Of these, the model of -i keeps its own, which -params replaces: {', '.join(dropped)}")
            for name in dropped:
                del hyperparams[name], saved[name]
        self._sets: dict[str, Dataset] = {}
        for name in "dataset", "prior_data":
            source = getattr(self._data, name)
            if source is not None:
                same = source == self._data.dataset and self._sets
                self._sets[name] = self._sets["dataset"] if same else self._read(name, source, hyperparams)
        self._dataset = self._sets.get("dataset")
        return hyperparams, saved

    def _read(self, name: str, source: str, hyperparams: Mapping[str, Any]) -> Dataset:
        try:
            return read_dataset(source, self.env_name.gym_id, hyperparams.get("env_kwargs") or self.env_kwargs)
        except (ValueError, OSError) as error:
            raise RunError(f"--{name.replace('_', '-')} {source}: {error}") from error

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        wrapper = hyperparams.get("env_wrapper")
        try:
            found = super()._preprocess_hyperparams(hyperparams)
        except (SyntaxError, NameError) as error:
            raise RunError(f"a hyperparameter that is a text of Python is none: {error}") from error
        if self.optimize_hyperparameters and any(isinstance(each, DiagnosticsCallback) for each in found[2]):
            raise RunError(
                "callback: DiagnosticsCallback does not go with -optimize, whose trials make no environment for it: "
                "leave it out"
            )
        self._evaluated_in = get_wrapper_class({"env_wrapper": _for_evaluation(wrapper)})
        known = (argument_names(ALGOS[self.algo]) | _OF_NOISE) - _OF_OPTIONS
        for name in found[0].keys() - known:
            near = difflib.get_close_matches(name, known, 1)
            raise RunError(
                f"{name} is no hyperparameter of {self.algo}"
                + (f", you maybe meant {near[0]}" if near else f", which has {', '.join(sorted(known))}")
            )
        if "prior_data" in self._sets:
            found[0]["prior_data"] = self._sets["prior_data"]
        if self._dataset is not None and self.n_envs > 1:
            raise RunError(f"--dataset: n_envs must be 1, not {self.n_envs}: the environment is for evaluations")
        if self._dataset is not None and self.normalize and not self.continue_training:
            raise RunError(
                "--dataset: normalize measures observations and rewards in the environment, where no step is taken: "
                "-params normalize:False, with normalize_observations:True for the data's own statistics"
            )
        steps = self._data.offline_steps
        if steps is not None and steps >= self.n_timesteps:
            raise RunError(
                f"--offline-steps must be fewer than all, -n {self.n_timesteps}, not {steps}: the rest is learned in "
                "the environment"
            )
        return found

    def create_callbacks(self) -> None:
        super().create_callbacks()
        for callback in self.callbacks:
            if isinstance(callback, DiagnosticsCallback) and callback.eval_env is None:
                callback.eval_env = self.create_envs(1, eval_env=True)

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        if is_atari_id(self.env_name.gym_id):
            try:
                check_game(self.env_name.gym_id)
            except ImportError as error:
                raise RunError(str(error)) from error
        wrapper = self.env_wrapper
        if eval_env:
            self.env_wrapper = self._evaluated_in
        try:
            return super().create_envs(n_envs, eval_env, no_log)
        except TypeError as error:
            kwargs = self.eval_env_kwargs if eval_env else self.env_kwargs
            if not kwargs:
                raise
            raise RunError(f"{self.env_name.gym_id} cannot be made with env_kwargs={kwargs}: {error}") from error
        finally:
            self.env_wrapper = wrapper

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        model = (
            self._loaded(hyperparams, env)
            if self.algo in ALGORITHMS
            else super()._load_pretrained_agent(hyperparams, env)
        )
        # The zoo loads statistics wherever they are, but saves them only if the settings ask for them.
        if unwrap_vec_normalize(env) is not None and not self.normalize:
            self.normalize = self._of_agent["normalize"] = True
        # ``enjoy`` gives a model its environment if this setting says so.
        if getattr(model, "replay_buffer_class", None) is HerReplayBuffer:
            self._of_agent["replay_buffer_class"] = HerReplayBuffer.__name__
        return model

    def _loaded(self, hyperparams: Mapping[str, Any], env: VecEnv) -> Any:
        """
        The model of ``-i``. Unlike the zoo, pass on ``policy`` and ``policy_kwargs`` too: our models say in what they
        differ from the file's.
        """
        print("Loading pretrained agent")
        algorithm: Any = ALGOS[self.algo]
        model = algorithm.load(
            self.trained_agent,
            env=env,
            seed=self.seed,
            tensorboard_log=self.tensorboard_log,
            verbose=self.verbose,
            device=self.device,
            **hyperparams,
        )
        if lacks_vec_normalize(model):
            statistics = Path(self.trained_agent).parent / self.env_name / "vecnormalize.pkl"
            raise RunError(
                f"-i {self.trained_agent}: the model has learned in a VecNormalize, whose statistics must be in "
                f"{statistics}, which is not there. -params normalize:True begins new ones"
            )
        replay = Path(self.trained_agent).parent / "replay_buffer.pkl"
        if replay.exists():
            print("Loading replay buffer")
            model.load_replay_buffer(replay, truncate_last_traj=self.truncate_last_trajectory)
        return model

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        saved_hyperparams.update(self._of_agent)
        super()._save_config(saved_hyperparams)

    def _train(self, model: Any, total_timesteps: int, **arguments: Any) -> BaseAlgorithm:
        """Call ``learn``, as the zoo does, or its replacement."""
        if self._dataset is None:
            return model.learn(total_timesteps, **arguments)  # type: ignore[no-any-return]
        n_offline = self._data.offline_steps
        if n_offline is None:
            return model.learn_offline(self._dataset, total_timesteps, **arguments)  # type: ignore[no-any-return]
        self._learn_first(model, self._dataset, n_offline, **arguments)
        if model.num_timesteps < n_offline:  # a callback has ended it
            return model  # type: ignore[no-any-return]
        return model.learn(total_timesteps - n_offline, reset_num_timesteps=False, **arguments)  # type: ignore[no-any-return]

    def _learn_first(self, model: Any, dataset: Dataset, gradient_steps: int, **arguments: Any) -> None:
        """Learn from data, before the steps in the environment."""
        model.learn_offline(dataset, gradient_steps, **arguments)

    def learn(self, model: BaseAlgorithm) -> None:
        all_made(model)
        self._watched = _Watched(model, self._train)
        super().learn(self._watched)  # type: ignore[arg-type]  # all that the zoo's learn uses

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        super().save_trained_model(model)
        if self._watched.interrupted:
            raise KeyboardInterrupt(self._interrupted)


class RunManager(Manager):
    """
    The zoo's manager for a run with checkpoints.

    :param start: how the run starts
    :param data: data sets to learn from
    :param args: the command line, as parsed by the zoo
    :param positional: further arguments of the zoo's manager
    :param named: further arguments of the zoo's manager
    :raises RunError: if there can be no checkpoints of such a run
    """

    def __init__(self, start: Start, data: Data, args: argparse.Namespace, *positional: Any, **named: Any):
        if args.algo not in ALGORITHMS:
            raise RunError(
                f"--algo {args.algo} has no checkpoints to go on from: --run-dir, --checkpoint-freq and --resume are "
                f"for the algorithms of this package, {', '.join(ALGORITHMS)}"
            )
        if args.optimize_hyperparameters:
            raise RunError(
                "-optimize has no checkpoints: without --run-dir, --checkpoint-freq and --resume a search goes on with "
                "the trials in its --storage"
            )
        super().__init__(data, args, *positional, **named)
        if start.folder is not None:
            self.save_path = str(start.folder)
            self.params_path = f"{self.save_path}/{self.env_name}"
        self._start, self._folder = start, Path(self.save_path)
        # Our ``learn`` shows the progress bar, and leaves it out of the callbacks' state: a run's parts may or may not
        # have it.
        self._progress_bar, self.show_progress = self.show_progress, False
        self._record: Record

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        hyperparams, saved = super().read_hyperparameters()
        values = {name: getattr(self.args, name) for name in COMPARED}
        values |= {name: value for name, value in saved.items() if name != "n_timesteps"}
        values |= self._sets
        if self._data.offline_steps is not None:
            values["offline_steps"] = self._data.offline_steps
        spellings = {name: _spellings(name, value) for name, value in values.items()}
        before = self._start.record
        if before is not None:
            self._compare(spellings, before.settings)
        self._record = Record(
            algo=self.algo,
            env=self.env_name.gym_id,
            seed=self.seed,
            n_timesteps=self.args.n_timesteps,
            checkpoint_freq=self._start.checkpoint_freq,
            settings={name: texts[0] for name, texts in spellings.items()},
            tensorboard=None if self.tensorboard_log is None else self._tensorboard_folder(),
        )
        # Before anything else of the run is written.
        self._record.write(self._folder)
        return hyperparams, saved

    def _compare(self, ours: Mapping[str, Sequence[str]], theirs: Mapping[str, str]) -> None:
        nothing = ("not given",)
        differences = [
            f"{name} {theirs.get(name, *nothing)} (now {ours.get(name, nothing)[0]})"
            for name in sorted(ours.keys() | theirs.keys())
            if theirs.get(name, *nothing) not in ours.get(name, nothing)
        ]
        if differences:
            raise RunError(
                f"the run in {self._folder} was started with {', '.join(differences)}. Nothing was changed. Train as "
                "then, or name another --run-dir"
            )

    def _tensorboard_folder(self) -> str:
        """The folder from the run's beginning if it lies where the command says, or a new one."""
        before = self._start.record and self._start.record.tensorboard
        name = ALGORITHMS[self.algo].algorithm.__name__
        is_ours = before and re.fullmatch(rf"{name}_\d+", Path(before).name)
        if before and is_ours and Path(before).parent == Path(str(self.tensorboard_log)):
            return before
        new = f"{self.tensorboard_log}/{name}_{get_latest_run_id(str(self.tensorboard_log), name) + 1}"
        # Made at once, so that a run that is made beside this one gets another folder.
        os.makedirs(new, exist_ok=True)
        return new

    def create_callbacks(self) -> None:
        super().create_callbacks()
        self.callbacks.append(RunFiles(self._folder))

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        goes_on = self._start.record is not None and get_monitor_files(str(self._folder))
        with monitors_go_on(rl_zoo3.exp_manager) if goes_on else contextlib.nullcontext():
            return super().create_envs(n_envs, eval_env, no_log)

    def learn(self, model: BaseAlgorithm) -> None:
        if self._record.tensorboard is not None:
            formats = ["stdout", "tensorboard"] if self.verbose >= 1 else ["tensorboard"]
            model.set_logger(configure(self._record.tensorboard, formats))
        self._interrupted = f"interrupted; the same command with --run-dir {self._folder} goes on"
        super().learn(model)

    def _train(self, model: Any, total_timesteps: int, **arguments: Any) -> BaseAlgorithm:
        more = {
            "checkpoint": self._folder,
            "checkpoint_freq": self._start.checkpoint_freq,
            "progress_bar": self._progress_bar,
        }
        return super()._train(model, total_timesteps, **arguments, **more)

    def _learn_first(self, model: Any, dataset: Dataset, gradient_steps: int, **arguments: Any) -> None:
        if checkpoints(self._folder):
            # The checkpoint that is restored next has all that was learned.
            model.num_timesteps = gradient_steps
            return
        with warnings.catch_warnings():
            # This warning comes if a run was interrupted between the two parts.
            warnings.filterwarnings("ignore", "Nothing is left to train")
            super()._learn_first(model, dataset, gradient_steps, **{**arguments, "checkpoint": self._folder / OFFLINE})


def _spellings(name: str, value: Any) -> list[str]:
    """The texts of a setting that mean the same. The first is recorded; a record may have another."""
    if name == "trained_agent" and value:
        return [repr(path) for path in (value, os.path.abspath(value), os.path.relpath(value))]
    return [repr(_in_order(value)), repr(value)]


def _in_order(value: Any) -> Any:
    """Sort dicts, whose order means nothing."""
    if type(value) is dict:
        return {key: _in_order(value[key]) for key in sorted(value, key=repr)}
    return [_in_order(each) for each in value] if type(value) is list else value


def _for_evaluation(wrapper: Any) -> Any:
    """Adapt ``env_wrapper`` to evaluation: whole games of Atari, with rewards as they are."""
    if isinstance(wrapper, list):
        return [_for_evaluation(each) for each in wrapper]
    path, arguments = next(iter(wrapper.items())) if isinstance(wrapper, dict) and len(wrapper) == 1 else (wrapper, {})
    if path not in (AtariFrames, f"{AtariFrames.__module__}.{AtariFrames.__name__}"):
        return wrapper
    return {path: {**arguments, "episodic_life": False, "clip_reward": False}}


def _check_data(data: Data, args: argparse.Namespace) -> None:
    """Check that an algorithm learns from such data."""
    entry = ALGORITHMS.get(args.algo)
    algorithm: Any = None if entry is None else entry.algorithm
    needs_data = getattr(algorithm, "learns_from_data_only", False)
    if data == Data():
        if needs_data:
            raise RunError(f"--algo {args.algo} learns from data only: give --dataset")
        return
    option = "--dataset" if data.dataset is not None else "--prior-data"
    if not getattr(algorithm, "learns_from_data", False):
        able = [name for name, each in ALGORITHMS.items() if getattr(each.algorithm, "learns_from_data", False)]
        raise RunError(f"{option} is for {', '.join(able)}, not for {args.algo}")
    if needs_data and data.dataset is None:
        raise RunError(f"--algo {args.algo} learns from data only: give --dataset in the place of --prior-data")
    if needs_data and data.offline_steps is not None:
        raise RunError(f"--offline-steps: {args.algo} learns from data only, all of -n: leave it out")
    if data.dataset is not None and args.optimize_hyperparameters:
        raise RunError("-optimize searches by learning in the environment: --dataset cannot be given with it")


class _Watched:
    """
    A model whose ``learn`` is another function, and which tells whether it was interrupted, since the zoo does not.

    :param model: the model
    :param train: trains it, given the model and the zoo's arguments of ``learn``
    """

    def __init__(self, model: Any, train: Callable[..., BaseAlgorithm]):
        self._model, self._train = model, train
        self.interrupted = False

    def learn(self, *args: Any, **kwargs: Any) -> BaseAlgorithm:
        try:
            return self._train(self._model, *args, **kwargs)
        except KeyboardInterrupt:
            self.interrupted = True
            raise

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)


class RunFiles(BaseCallback):
    """
    Cuts the Monitor files and the TensorBoard log back to the checkpoint from which a run resumes, since later entries
    will be written again.

    :param folder: the run's folder
    """

    def __init__(self, folder: Path):
        super().__init__()
        self.folder = folder

    def state_dict(self) -> dict[str, int]:
        """
        :return: the size of each Monitor file, by its name
        """
        return {Path(file).name: os.path.getsize(file) for file in get_monitor_files(str(self.folder))}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """
        :param state: from ``state_dict``
        """
        for name, size in state.items():
            if not is_plain(name) or not name.endswith(Monitor.EXT) or type(size) is not int or not 0 <= size < 2**63:
                raise ValueError(f"{name!r:.200} of {size!r:.50} bytes is no file of Monitor's in {self.folder}")
            self._cut(name, size)
        for each in self.model.logger.output_formats:
            if isinstance(each, TensorBoardOutputFormat):
                each.writer.close()
                # Its own class, which is from another package if tensorboardX replaces TensorBoard.
                each.writer = type(each.writer)(
                    log_dir=self.model.logger.get_dir(), purge_step=self.model.num_timesteps + 1
                )

    def _cut(self, name: str, size: int) -> None:
        path = self.folder / name
        try:
            with Folder.at(self.folder) as folder:
                file = folder.descriptor(name, os.O_RDWR)
            try:
                there = os.fstat(file).st_size
                if there > size:
                    os.ftruncate(file, size)
            finally:
                os.close(file)
        except FileNotFoundError:
            there = 0
        except OSError as error:
            warn(f"{path} cannot be cut back to the checkpoint ({error})")
            return
        if there < size:
            warn(f"{path} has {there} bytes, {size} at the checkpoint: episodes are missing")

    def _on_step(self) -> bool:
        return True
