"""
Managers of the runs of ``sb3-sample train``, in the place of the zoo's: runs that resume where they were interrupted,
and runs that learn from data (``--dataset``, ``--offline-steps``, ``--prior-data``).
"""

import argparse
import contextlib
import difflib
import os
import re
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import rl_zoo3.exp_manager
import yaml
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
from sb3_sample.replay.dataset import Dataset
from sb3_sample.replay.reading import read_dataset
from sb3_sample.run_logs import OFFLINE
from sb3_sample.saving.folders import Folder, is_plain
from sb3_sample.saving.locks import Lock, take_folder
from sb3_sample.saving.normalization import lacks_vec_normalize
from sb3_sample.saving.training_state import argument_names
from sb3_sample.training.seats import all_made
from sb3_sample.warn import warn
from sb3_sample.zoo.algorithms import ALGORITHMS
from sb3_sample.zoo.files import RunError
from sb3_sample.zoo.patches import monitors_go_on
from sb3_sample.zoo.records import Record, all_checkpoints, checkpoints
from sb3_sample.zoo.trials import check_search

#: Arguments of the zoo that identify a run, besides its hyperparameters. Its length, its device and its output may
#: change.
COMPARED = (
    "algo", "env", "seed", "trained_agent", "truncate_last_trajectory", "vec_env", "env_kwargs", "eval_env_kwargs",
    "eval_freq", "eval_episodes", "n_eval_envs", "save_freq",
)  # fmt: skip
#: Arguments of the zoo on which the trials of a search depend, besides its hyperparameters.
SEARCHED = ("algo", "env", "env_kwargs", "eval_env_kwargs", "eval_episodes")
#: Hyperparameters from which the zoo makes ``action_noise``.
_OF_NOISE = {"noise_type", "noise_std"}
#: Settings that change the observations, and belong to a trained model as its arguments do.
_OF_STATISTICS = {"normalize"}
#: Arguments that the zoo's options set.
_OF_OPTIONS = {"env", "seed", "verbose", "device", "tensorboard_log"}


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
    #: Whether the run's folder is one that the zoo numbers.
    _is_numbered = True
    # Whether this run has made its folder.
    _has_made_folder = False

    def __init__(self, data: Data, args: argparse.Namespace, *positional: Any, **named: Any):
        _check_data(data, args)
        if args.n_timesteps == 0 or args.n_timesteps < -1:
            raise RunError(f"-n must be at least 1, in steps, not {args.n_timesteps}")
        super().__init__(args, *positional, **named)
        self._data = data
        self._dataset: Dataset | None = None
        # The names of a stored trial's hyperparameters.
        self._of_trial: set[str] = set()
        # Settings of the model that is trained on, for those who read the run's.
        self._of_agent: dict[str, Any] = {}

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        try:
            return super().setup_experiment()  # type: ignore[no-any-return]
        except BaseException:
            # ``enjoy`` would take the folder of a refused run for the latest one.
            if self._has_made_folder:
                shutil.rmtree(self.save_path, ignore_errors=True)
            raise

    def create_log_folder(self) -> None:
        self._make_folder()
        super().create_log_folder()

    def _make_folder(self) -> None:
        """Make the run's folder; a training started at the same time may have taken the number that the zoo chose."""
        if self._has_made_folder:
            return
        try:
            os.makedirs(self.save_path)
        except FileExistsError:
            if not self._is_numbered:
                return
            self.save_path = _make_numbered(self.log_path, self.env_name)
            self.params_path = f"{self.save_path}/{self.env_name}"
        self._has_made_folder = True

    def close(self) -> None:
        """Release the run's folder for others. More than one call does no harm."""

    def load_trial(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        found: dict[str, Any] = super().load_trial(*args, **kwargs)
        self._of_trial = set(found)
        return found

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        try:
            hyperparams, saved = super().read_hyperparameters()
        except (OSError, ImportError, AttributeError, yaml.YAMLError) as error:
            if _is_of_an_object(error):
                raise
            raise RunError(f"--conf-file {self.config} cannot be read: {' '.join(str(error).split())}") from error
        self._settings = saved
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
        except (ImportError, AttributeError) as error:
            if _is_of_an_object(error):
                raise
            raise RunError(f"a hyperparameter names what cannot be imported: {error}") from error
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

    def _preprocess_action_noise(self, hyperparams: dict[str, Any], saved: dict[str, Any], env: VecEnv) -> Any:
        try:
            return super()._preprocess_action_noise(hyperparams, saved, env)
        except KeyError as error:
            raise RunError(f"noise_type={hyperparams['noise_type']} needs {error.args[0]}: give it too") from error
        except (RuntimeError, AssertionError) as error:
            raise RunError(f"noise_type={hyperparams['noise_type']}: {error}") from error

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        try:
            return super()._maybe_normalize(env, eval_env)  # type: ignore[no-any-return]
        except TypeError as error:
            raise RunError(f"normalize={self._settings.get('normalize')}: {error}") from error

    def hyperparameters_optimization(self) -> None:
        if self.algo in ALGORITHMS and self.storage and self.study_name:
            values = {name: getattr(self.args, name) for name in SEARCHED} | self._settings
            values |= {name: getattr(self, name) for name in ("n_timesteps", "n_evaluations")}
            # Objects are written with their place in memory, which means nothing.
            settings = {
                name: re.sub(r" at 0x[0-9a-fA-F]+", "", _spellings(name, value)[0]) for name, value in values.items()
            }
            check_search(self.storage, self.study_name, settings)
        super().hyperparameters_optimization()

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
            self._is_numbered = False
            self.save_path = str(start.folder)
            self.params_path = f"{self.save_path}/{self.env_name}"
        self._start = start
        # Our ``learn`` shows the progress bar, and leaves it out of the callbacks' state: a run's parts may or may not
        # have it.
        self._progress_bar, self.show_progress = self.show_progress, False
        self._record: Record
        # Of the folder, from before its first file to the end.
        self._lock: Lock | None = None

    @property
    def _folder(self) -> Path:
        return Path(self.save_path)

    def _make_folder(self) -> None:
        if self._lock is not None:
            return
        while True:
            super()._make_folder()
            try:
                self._lock = take_folder(self._folder)
                break
            except FileNotFoundError:
                # A run that had made it was refused, and has removed it.
                self._has_made_folder = False
            except BlockingIOError as error:
                # Content of the folder is the other's, even if this run has made it.
                self._has_made_folder = False
                raise RunError(f"{self._folder} is in use: another process trains in it") from error
        if self._start.record is None and all_checkpoints(self._folder):
            raise RunError(
                f"another process has just trained in {self._folder}: the same command, given again, goes on"
            )

    def close(self) -> None:
        if self._lock is not None:
            self._lock.release()

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
        self._make_folder()
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
        return _make_numbered(str(self.tensorboard_log), name)

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


def _make_numbered(parent: str, name: str) -> str:
    """Make a folder ``{name}_{number}``; others may make theirs at the same time."""
    number = get_latest_run_id(parent, name)
    while True:
        number += 1
        folder = os.path.join(parent, f"{name}_{number}")
        with contextlib.suppress(FileExistsError):
            os.makedirs(folder)
            return folder


def _is_of_an_object(error: Exception) -> bool:
    """Whether an attribute is missing that is not a module's: no import has failed, but code that was imported."""
    return isinstance(error, AttributeError) and not isinstance(error.obj, ModuleType)


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
    will be written again. Checkpoints name this class by its module.

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
