"""
All patches of the zoo (``rl_zoo3``), and of other libraries for the zoo's sake. The patches of ``register`` stay; the
others are context managers, in force while a command of ``sb3-sample`` runs.
"""

import argparse
import builtins
import contextlib
import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import gymnasium as gym
import rl_zoo3.hyperparams_opt
import rl_zoo3.utils
import yaml
from rl_zoo3.utils import create_test_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_sample.envs.monitors import go_on
from sb3_sample.errors import ParametersDoNotFit
from sb3_sample.run_logs import read_evaluations, read_monitors
from sb3_sample.saving.model import SafeFiles
from sb3_sample.saving.normalization import load_vec_normalize, save_vec_normalize
from sb3_sample.saving.replay import SafeReplayBuffers
from sb3_sample.saving.training_state import argument_names
from sb3_sample.saving.untrusted import BadFile
from sb3_sample.zoo.algorithms import ALGORITHMS, BUFFERS, HYPERPARAMS, stored_arguments
from sb3_sample.zoo.files import PlottedRuns, Refused, RunError
from sb3_sample.zoo.search import HER_SPACE, sampler
from sb3_sample.zoo.settings import read_settings
from sb3_sample.zoo.trials import check_storage, stored_params

#: Environments whose ``info`` has ``is_success`` at every step.
SUCCESS_PREFIXES = ("metaworld/", "myosuite/")

#: Arguments that are searched, and those that put them out of force.
_REPLACED_BY = {"replay_ratio": ("train_freq", "gradient_steps"), "resets": ("reset_gradient_steps",)}

#: Attributes that ``enjoy`` and ``record_video`` replace in every model, since an old Python's pickles cannot be read.
_OF_OLD_PICKLES = ("learning_rate", "lr_schedule", "clip_range")

#: Whether pickles are read: set by ``reading``, and None outside it, in the stock zoo's own commands.
_allow_pickle: bool | None = None


@contextlib.contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """
    Replace an attribute, for a while.

    :param owner: module, class or object that has the attribute itself, or a module that uses a built-in function of
        that name
    :param name: its name
    :param value: its replacement
    """
    is_own = name in vars(owner)
    before = vars(owner if is_own else builtins)[name]
    setattr(owner, name, value)
    try:
        yield
    finally:
        if is_own:
            setattr(owner, name, before)
        else:
            delattr(owner, name)


# ---------------------------------------------------------------- register: patches that stay


def register() -> None:
    """
    Put the algorithms, their search spaces and their hyperparameters into the zoo. More than one call does no harm.

    A program that uses ``rl_zoo3.exp_manager.ExperimentManager`` itself calls this first; ``sb3-sample`` and, in the
    folder of this repository, ``python -m rl_zoo3.train`` do so.
    """
    # Added to the zoo's tables of algorithms, in place: its other modules hold these same dicts.
    tables: Any = rl_zoo3.hyperparams_opt
    for name, entry in ALGORITHMS.items():
        rl_zoo3.utils.ALGOS[name] = entry.algorithm
        tables.HYPERPARAMS_SAMPLER[name] = sampler(entry.space, entry.convert)
        tables.HYPERPARAMS_CONVERTER[name] = entry.convert
    # Not imported at the top: it imports custom_envs, and the custom_envs of this repository imports this module. If
    # this call comes from there, the zoo is still importing ``rl_zoo3.exp_manager``, which has no manager yet. Of the
    # zoo's commands only record_video starts in this way, and it reads no hyperparameter file.
    module = importlib.import_module("rl_zoo3.exp_manager")
    if hasattr(module, "ExperimentManager") and not hasattr(module.ExperimentManager, "_adapted_by_sb3_sample"):
        module.ExperimentManager._adapted_by_sb3_sample = True
        # The zoo evaluates ``replay_buffer_class`` with this module's names.
        vars(module).update(BUFFERS)
        _adapt_experiment_manager(module)
        _adapt_statistics(module)


def _adapt_experiment_manager(module: Any) -> None:
    """
    Replace methods of ``rl_zoo3.exp_manager.ExperimentManager``: the zoo has no option for what these do.
    """
    manager = module.ExperimentManager
    original_init, original_read = manager.__init__, manager.read_hyperparameters
    original_load_trial, original_optimize = manager.load_trial, manager.hyperparameters_optimization
    original_is_robotics_env = manager.is_robotics_env
    signature = inspect.signature(original_init)

    # ``__init__`` looks for <algorithm>.yml in the zoo's own folder only, takes trial 0 for none, and ignores a trial
    # whose study is not given.
    @functools.wraps(original_init)
    def init(*args: Any, **kwargs: Any) -> None:
        given = signature.bind(*args, **kwargs)
        if given.arguments["algo"] in ALGORITHMS:
            if not given.arguments.get("config"):
                given.arguments["config"] = str(HYPERPARAMS / f"{given.arguments['algo']}.yml")
            _check_arguments(given.arguments)
        original_init(*given.args, **given.kwargs)

    # ``load_trial`` accepts anything stored as hyperparameters, some of which the zoo evaluates as Python or imports.
    def load_trial(self: Any, storage: str, study_name: str, trial_id: int | None = None, convert: bool = True) -> Any:
        if self.algo not in ALGORITHMS:
            return original_load_trial(self, storage, study_name, trial_id, convert)
        params = stored_params(storage, study_name, trial_id)
        return stored_arguments(self.algo, params, f"trial {trial_id} of {storage}") if convert else params

    # ``hyperparameters_optimization`` opens a storage without checking whether Optuna has written it, and ends a search
    # without a completed trial in a traceback.
    def optimize(self: Any) -> None:
        if self.algo in ALGORITHMS and self.storage is not None:
            check_storage(self.storage)
        try:
            original_optimize(self)
        except ValueError as error:
            # Optuna's, of a study without a best trial.
            if self.algo not in ALGORITHMS or "trials are completed" not in str(error):
                raise
            raise RunError(
                "no trial was completed: all were pruned (an error of one is printed above), failed or were "
                "interrupted, so there is none to report"
            ) from error

    # ``read_hyperparameters`` forgets all ``env_kwargs`` of the file for those of the command line, makes environments
    # for evaluation with the latter only, passes the parameters stored by a trial with HerReplayBuffer to any other
    # buffer, and prunes every trial of a search, or searches in vain, if other arguments put the searched ones out of
    # force. The zoo also makes a VecFrameStack from ``frame_stack``, which gives stacks of stacks if an algorithm has
    # an argument of that name.
    def read_hyperparameters(self: Any) -> Any:
        given = self.env_kwargs
        # The zoo does not replace the file's by none.
        with _replaced(self, "env_kwargs", {} if self.algo in ALGORITHMS else given):
            hyperparams, saved = original_read(self)
        ours: Any = ALGORITHMS[self.algo].algorithm if self.algo in ALGORITHMS else None
        if "frame_stack" in hyperparams and "frame_stack" in getattr(ours, "constructor_arguments", ()):
            raise ValueError(
                f"frame_stack={hyperparams['frame_stack']!r} would be the zoo's VecFrameStack around the stacks of "
                f"frames that {self.algo} is given, which are of 4 frames in the zoo: leave it out"
            )
        buffer = hyperparams.get("replay_buffer_kwargs")
        goals = sorted(HER_SPACE.keys() & buffer.keys()) if isinstance(buffer, dict) else []
        if self.algo in ALGORITHMS and goals and "replay_buffer_class" not in hyperparams:
            raise BadFile(f"{', '.join(goals)} belong to a trial with HerReplayBuffer, which this run has not")
        if self.algo in ALGORITHMS and self.optimize_hyperparameters:
            for searched, others in _REPLACED_BY.items():
                found = [name for name in others if hyperparams.get(name) is not None]
                if found and searched in ALGORITHMS[self.algo].space:
                    raise ValueError(f"{found[0]}={hyperparams[found[0]]!r} replaces {searched}, which is searched")
        if self.algo in ALGORITHMS and "env_kwargs" in hyperparams:
            of_file = hyperparams["env_kwargs"] or {}
            hyperparams["env_kwargs"] = saved["env_kwargs"] = {**of_file, **given}
            for_evaluation = self._eval_env_kwargs_args
            self.eval_env_kwargs = {**of_file, **(given if for_evaluation is None else for_evaluation)}
        return hyperparams, saved

    # ``is_robotics_env`` only decides whether Monitor records is_success, which our environments report too.
    def is_robotics_env(env_id: str) -> bool:
        return env_id.startswith(SUCCESS_PREFIXES) or original_is_robotics_env(env_id)

    manager.__init__ = init
    manager.load_trial = load_trial
    manager.hyperparameters_optimization = optimize
    manager.read_hyperparameters = read_hyperparameters
    manager.is_robotics_env = staticmethod(is_robotics_env)


def _check_arguments(given: Mapping[str, Any]) -> None:
    """Refuse arguments of ``ExperimentManager`` that the zoo would ignore or take for others."""
    trial, searches = given.get("trial_id"), given.get("optimize_hyperparameters")
    if trial == 0:
        raise ValueError(
            "trial_id must be at least 1, not 0: the zoo takes 0 for no trial and would train with the parameters of "
            "the file; pass trial 0's parameters with -params"
        )
    if trial is not None and trial < 0:
        raise ValueError(f"trial_id must be at least 1, not {trial}")
    of_study = [name for name in ("storage", "study_name") if given.get(name)]
    if trial is not None and len(of_study) < 2:
        lacking = " and ".join(_option(name) for name in ("storage", "study_name") if name not in of_study)
        raise ValueError(f"trial_id={trial} is the number of a trial in a study: give {lacking} too")
    if of_study and trial is None and not searches:
        raise ValueError(f"{_option(of_study[0])} has no effect without -optimize or --trial-id: give one of them too")
    if searches and given.get("trained_agent"):
        raise ValueError(f"-optimize searches with new agents: leave out -i {given['trained_agent']}")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


class _VecNormalize:
    """Replaces the class in the zoo's modules, which call it and its ``load``."""

    def __call__(self, *args: Any, **kwargs: Any) -> VecNormalize:
        return VecNormalize(*args, **kwargs)

    def load(self, path: str, venv: VecEnv) -> VecNormalize:
        try:
            return load_vec_normalize(path, venv, allow_pickle=_allow_pickle is not False)
        except OSError as error:
            raise Refused(str(error)) from error


def _adapt_statistics(module: Any) -> None:
    """
    Replace the functions with which ``rl_zoo3.exp_manager`` and ``rl_zoo3.utils`` write and read ``vecnormalize.pkl``.
    The stock zoo's is a pickle; that of our algorithms runs no code.
    """
    manager, callback = module.ExperimentManager, module.SaveVecNormalizeCallback
    normalize, save_model, on_step = manager._maybe_normalize, manager.save_trained_model, callback._on_step

    # ``_maybe_normalize`` reads the statistics of the agent that is trained on.
    def maybe_normalize(self: Any, env: VecEnv, eval_env: bool) -> VecEnv:
        # A program that uses the manager has not allowed pickles, so they are refused.
        allowed = bool(_allow_pickle) if self.algo in ALGORITHMS else None
        with _replaced(sys.modules[__name__], "_allow_pickle", allowed):
            return normalize(self, env, eval_env)  # type: ignore[no-any-return]

    # ``save_trained_model`` writes those at the end of a training, ...
    def save_trained_model(self: Any, model: Any) -> None:
        with _safe_statistics(self.algo in ALGORITHMS):
            save_model(self, model)

    # ... and ``SaveVecNormalizeCallback`` those of the best model.
    def save_statistics(self: Any) -> bool:
        with _safe_statistics(isinstance(self.model, SafeFiles)):
            return on_step(self)  # type: ignore[no-any-return]

    for each in (module, rl_zoo3.utils):
        each.VecNormalize = _VecNormalize()  # type: ignore[union-attr]
    manager._maybe_normalize = maybe_normalize
    manager.save_trained_model = save_trained_model
    callback._on_step = save_statistics


def _safe_statistics(safe: bool) -> AbstractContextManager[None]:
    return _replaced(VecNormalize, "save", save_vec_normalize) if safe else contextlib.nullcontext()


# ---------------------------------------------------------------- train


@contextlib.contextmanager
def managed_by(manager: Callable[..., Any], module: ModuleType) -> Iterator[None]:
    """
    Make the zoo's ``train`` use another manager than ``ExperimentManager``, and check its options: it has no argument
    for runs with checkpoints, nor for the manager's class.

    :param manager: makes the manager from the arguments of ``ExperimentManager``
    :param module: ``rl_zoo3.train``
    """
    with _pairs_checked(module), _replaced(module, "ExperimentManager", manager):
        yield


def monitors_go_on(module: ModuleType) -> AbstractContextManager[None]:
    """
    Make Monitors append to existing files, by replacing the zoo's ``make_vec_env``: it has no argument for how they are
    made.

    :param module: ``rl_zoo3.exp_manager``
    """
    make = module.make_vec_env

    def make_vec_env(*args: Any, monitor_kwargs: dict[str, Any], wrapper_class: Any, **kwargs: Any) -> Any:
        def wrap(env: Monitor) -> gym.Env:
            go_on(env)
            return env if wrapper_class is None else wrapper_class(env)

        return make(*args, monitor_kwargs={**monitor_kwargs, "override_existing": False}, wrapper_class=wrap, **kwargs)

    return _replaced(module, "make_vec_env", make_vec_env)


# ---------------------------------------------------------------- train, enjoy and record_video


def _pairs_checked(module: ModuleType) -> AbstractContextManager[None]:
    """
    Make options of names and values (``-params``, ``--env-kwargs``) refuse anything else, by replacing the zoo's
    ``StoreDict``, which evaluates it as Python and shows a traceback.

    :param module: the command's module, which makes a dict of them
    """

    class Pairs(rl_zoo3.utils.StoreDict):
        def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
            found: dict[str, Any] = {}
            for value in values:
                try:
                    super().__call__(parser, one := argparse.Namespace(), [value], option_string)
                except Exception as error:  # the zoo evaluates the value as Python, which can raise anything
                    raise Refused(
                        f"{option_string} must be NAME:VALUE, the value in Python and a text in quotes of its own "
                        f"(NAME:\"'text'\"), not {value!r} ({type(error).__name__}: {error})"
                    ) from error
                found |= vars(one)[self.dest]
            setattr(namespace, self.dest, found)

    return _replaced(module, "StoreDict", Pairs)


@contextlib.contextmanager
def reading(allow_pickle: bool = False, trusted_modules: Sequence[str] = ()) -> Iterator[None]:
    """
    Set which files of our algorithms the zoo may read meanwhile: it calls their methods, which are replaced here,
    without arguments for trust.

    :param allow_pickle: whether pickled files are read too, which can run any code that their author wanted
    :param trusted_modules: modules, or packages of modules, whose classes and functions a file may name
    """
    methods: list[tuple[Any, str]] = [(SafeFiles, name) for name in ("save", "load", "set_parameters")]
    methods += [(SafeReplayBuffers, name) for name in ("save_replay_buffer", "load_replay_buffer")]
    with contextlib.ExitStack() as stack:
        stack.enter_context(_replaced(sys.modules[__name__], "_allow_pickle", allow_pickle))
        for owner, name in methods:
            pickles = allow_pickle and not name.startswith("save")
            stack.enter_context(_replaced(owner, name, _with(vars(owner)[name], pickles, tuple(trusted_modules))))
        yield


def _with(method: Any, pickles: bool, trusted: tuple[str, ...]) -> Any:
    """A method that trusts more than its caller says, since the zoo cannot pass such arguments."""
    function = method.__func__ if isinstance(method, classmethod) else method

    @functools.wraps(function)
    def call(*args: Any, allow_pickle: bool = False, trusted_modules: Sequence[str] = (), **kwargs: Any) -> Any:
        more = (*trusted_modules, *trusted)
        try:
            return function(*args, allow_pickle=allow_pickle or pickles, trusted_modules=more, **kwargs)
        except (BadFile, ParametersDoNotFit):
            raise
        except (ValueError, OSError) as error:
            if not function.__name__.startswith("load"):
                raise
            raise Refused(str(error)) from error

    return classmethod(call) if isinstance(method, classmethod) else call


@contextlib.contextmanager
def watched_with(find: Any, read: Any, make_env: Any, *modules: ModuleType) -> Iterator[None]:
    """
    Replace the functions with which ``enjoy`` and ``record_video`` look for a run, read its settings and make its
    environments: the zoo finds no run by its folder, trusts its settings and does not use all of them. Their options
    are checked too.

    :param find: replaces ``get_model_path``
    :param read: replaces ``get_saved_hyperparams``
    :param make_env: replaces ``create_test_env``
    :param modules: the modules that call them
    """
    with contextlib.ExitStack() as stack:
        for module in modules:
            stack.enter_context(_pairs_checked(module))
            stack.enter_context(_replaced(module, "get_model_path", find))
            stack.enter_context(_replaced(module, "get_saved_hyperparams", read))
            stack.enter_context(_replaced(module, "create_test_env", make_env))
        yield


def models_checked(check: Callable[[Any], None]) -> AbstractContextManager[None]:
    """
    Load models of our algorithms to act only, and check them: the zoo replaces schedules, which contradicts a file's
    other settings, has no argument for prior data, does not check whether a model fits the environment that it has
    made, and may call ``load`` without that environment.

    :param check: raises an error if a model does not fit
    """
    load = vars(SafeFiles)["load"].__func__

    def call(cls: type[SafeFiles], *args: Any, custom_objects: Mapping[str, Any] | None = None, **kwargs: Any) -> Any:
        kept = {name: value for name, value in (custom_objects or {}).items() if name not in _OF_OLD_PICKLES}
        if "prior_data" in argument_names(cls):
            kwargs.setdefault("prior_data", None)
        model = load(cls, *args, custom_objects=kept, **kwargs)
        check(model)
        return model

    return _replaced(SafeFiles, "load", classmethod(call))


def make_answering_env(env_id: str, *args: Any, **kwargs: Any) -> VecEnv:
    """
    Make environments with the zoo's ``create_test_env``, and wrap it and their methods: errors of an environment or a
    wrapper, whose arguments come from a run's file, are attributed to these settings, where the zoo shows a traceback.

    :param env_id: see ``create_test_env``, as for the rest
    :return: the environments
    :raises Refused: if the run's settings make no environment that works; the methods raise it too, later on
    """
    env: VecEnv = _answering_for(env_id, create_test_env)(env_id, *args, **kwargs)
    for name in ("reset", "step_async", "step_wait", "render"):
        setattr(env, name, _answering_for(env_id, getattr(env, name)))
    return env


def _answering_for(env_id: str, function: Any) -> Any:
    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except (BadFile, Refused):
            raise
        except Exception as error:
            why = f"{type(error).__name__}: {error}"
            raise Refused(f"{env_id} with the settings of the run does not work: {why}") from error

    return call


def reading_settings(trusted_modules: Sequence[str] = (), given: Sequence[str] = ()) -> AbstractContextManager[None]:
    """
    Make the zoo read a run's settings with ``read_settings`` instead of ``yaml.load`` with its ``UnsafeLoader``, which
    makes any objects that they name.

    :param trusted_modules: see ``read_settings``
    :param given: see ``read_settings``
    """
    load = yaml.load

    def read(stream: Any, Loader: Any) -> Any:
        if Loader is yaml.UnsafeLoader:
            return read_settings(Path(stream.name), trusted_modules, given)
        return load(stream, Loader)

    return _replaced(yaml, "load", read)


# ---------------------------------------------------------------- plots


def reading_monitors(module: ModuleType) -> AbstractContextManager[None]:
    """
    Read Monitor files, which anybody may have written, with ``read_monitors`` instead of Stable-Baselines3's
    ``load_results``.

    :param module: ``rl_zoo3.plots.plot_train``
    """
    return _replaced(module, "load_results", read_monitors)


@contextlib.contextmanager
def reading_tables(module: ModuleType, runs: PlottedRuns) -> Iterator[None]:
    """
    Read evaluations, and write and read the tables that are made of them, without running code: replace ``np.load``,
    ``pickle`` and ``open``.

    :param module: ``rl_zoo3.plots.all_plots`` or ``rl_zoo3.plots.plot_from_file``
    :param runs: replaces ``pickle``
    """
    # NumPy as the zoo uses it, with another function for opening files.
    numpy = SimpleNamespace(**{**vars(module.np), "load": read_evaluations})
    with _replaced(module, "np", numpy), _replaced(module, "pickle", runs), _replaced(module, "open", runs.open):
        yield
