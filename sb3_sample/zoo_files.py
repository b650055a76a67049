"""
The files of the zoo's commands that are pickled in the stock zoo: those of our algorithms run no code when they are
read. They keep the zoo's names (``vecnormalize.pkl``, ``replay_buffer.pkl``), by which its commands find them.

The zoo's own algorithms are read and written as in the stock zoo, since their models are pickled too.
"""

import argparse
import builtins
import contextlib
import functools
import os
import pickle
import sys
import types
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import rl_zoo3.utils
import torch
import yaml
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_sample.errors import ParametersDoNotFit
from sb3_sample.saving import container
from sb3_sample.saving.container import BadFile, PickledFile
from sb3_sample.saving.encoding import decode, encode
from sb3_sample.saving.model import SafeFiles
from sb3_sample.saving.normalization import load_vec_normalize, save_vec_normalize
from sb3_sample.saving.replay import SafeReplayBuffers
from sb3_sample.saving.untrusted import open_regular
from sb3_sample.zoo_settings import read_settings

#: Whether pickles are read: as ``reading`` says, and None outside of it, in the stock zoo's own commands.
_allow_pickle: bool | None = None
_PLOT_KIND = "plotted runs"


class Refused(Exception):
    """
    What is refused while the zoo runs, which takes a ``ValueError`` for a model that it can get from a hub.
    """


@contextlib.contextmanager
def replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """
    Something else in the place of an attribute, for a while.

    :param owner: module or class whose own attribute it is, or, of a module, a built-in function that it uses
    :param name: its name
    :param value: what takes its place
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


@contextlib.contextmanager
def pairs_checked(module: types.ModuleType) -> Iterator[None]:
    """
    Options of a zoo's command that are names and values (``-params``, ``--env-kwargs``) refuse what is none of these.

    :param module: the command's, which makes a dict of them with the zoo's ``StoreDict``
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

    with replaced(module, "StoreDict", Pairs):
        yield


@contextlib.contextmanager
def reading(allow_pickle: bool = False, trusted_modules: Sequence[str] = ()) -> Iterator[None]:
    """
    What the zoo may read meanwhile of our algorithms.

    :param allow_pickle: whether pickled files are read too, which can run any code that their author wanted
    :param trusted_modules: modules, or packages of modules, whose classes and functions a file may name
    """
    methods: list[tuple[Any, str, bool]] = [
        (SafeFiles, "save", False),
        (SafeFiles, "load", allow_pickle),
        (SafeFiles, "set_parameters", allow_pickle),
        (SafeReplayBuffers, "save_replay_buffer", False),
        (SafeReplayBuffers, "load_replay_buffer", allow_pickle),
    ]
    with contextlib.ExitStack() as stack:
        stack.enter_context(replaced(sys.modules[__name__], "_allow_pickle", allow_pickle))
        for owner, name, pickles in methods:
            stack.enter_context(replaced(owner, name, _with(vars(owner)[name], pickles, tuple(trusted_modules))))
        yield


def _with(method: Any, pickles: bool, trusted: tuple[str, ...]) -> Any:
    """A method that trusts more than its caller says, since the zoo cannot say anything."""
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


def add_trust(parser: argparse._ActionsContainer) -> None:
    """
    :param parser: gets the options for what a saved run may hold
    """
    parser.add_argument(
        "--allow-pickle",
        action="store_true",
        help="Read pickled files and settings that are Python too, as the stock zoo does: they can run any code that "
        "their author wanted",
    )
    parser.add_argument(
        "--trusted-modules",
        nargs="+",
        default=[],
        metavar="MODULE",
        help="Modules, or packages of modules, whose classes and functions the run's files may name",
    )


# ---------------------------------------------------------------- statistics of VecNormalize


class _VecNormalize:
    """Stands in the zoo's modules for the class, which they call, and whose ``load`` they call."""

    def __call__(self, *args: Any, **kwargs: Any) -> VecNormalize:
        return VecNormalize(*args, **kwargs)

    def load(self, path: str, venv: VecEnv) -> VecNormalize:
        try:
            return load_vec_normalize(path, venv, allow_pickle=_allow_pickle is not False)
        except OSError as error:
            raise Refused(str(error)) from error


def adapt(module: types.ModuleType, algorithms: Sequence[str]) -> None:
    """
    Have the zoo write and read safe files for some algorithms.

    :param module: ``rl_zoo3.exp_manager``
    :param algorithms: names of the algorithms
    """
    manager: Any = module.ExperimentManager
    callback: Any = module.SaveVecNormalizeCallback
    normalize = manager._maybe_normalize
    save_model, on_step = manager.save_trained_model, callback._on_step
    for each in (module, rl_zoo3.utils):
        each.VecNormalize = _VecNormalize()  # type: ignore[attr-defined]

    def maybe_normalize(self: Any, env: VecEnv, eval_env: bool) -> VecEnv:
        # A program that uses the manager has not said anything about pickles: they are refused then.
        allowed = bool(_allow_pickle) if self.algo in algorithms else None
        with replaced(sys.modules[__name__], "_allow_pickle", allowed):
            return normalize(self, env, eval_env)  # type: ignore[no-any-return]

    def save_trained_model(self: Any, model: Any) -> None:
        with _safe_statistics(self.algo in algorithms):
            save_model(self, model)

    def save_statistics(self: Any) -> bool:
        with _safe_statistics(isinstance(self.model, SafeFiles)):
            return on_step(self)  # type: ignore[no-any-return]

    manager._maybe_normalize = maybe_normalize
    manager.save_trained_model = save_trained_model
    callback._on_step = save_statistics


@contextlib.contextmanager
def _safe_statistics(safe: bool) -> Iterator[None]:
    with replaced(VecNormalize, "save", save_vec_normalize) if safe else contextlib.nullcontext():
        yield


# ---------------------------------------------------------------- settings of a run


def check_settings(folder: Path, trusted_modules: Sequence[str] = (), given: Sequence[str] = ()) -> None:
    """
    Look at a run's ``args.yml`` and ``config.yml`` before the zoo does.

    :param folder: where they are
    :param trusted_modules: modules, or packages of modules, whose classes they may name
    :param given: arguments of the environment that the command line gives
    :raises BadFile: see ``read_settings``
    """
    for name in ("args.yml", "config.yml"):
        # The zoo passes over what is there and no file.
        if os.path.lexists(folder / name):
            read_settings(folder / name, trusted_modules, given)


@contextlib.contextmanager
def reading_settings(trusted_modules: Sequence[str] = (), given: Sequence[str] = ()) -> Iterator[None]:
    """
    The zoo reads a run's settings with ``read_settings`` meanwhile.

    :param trusted_modules: see there
    :param given: see there
    """
    load = yaml.load

    def read(stream: Any, Loader: Any) -> Any:
        if Loader is yaml.UnsafeLoader:
            return read_settings(Path(stream.name), trusted_modules, given)
        return load(stream, Loader)

    with replaced(yaml, "load", read):
        yield


# ---------------------------------------------------------------- what all_plots saves


class PlottedRuns:
    """
    Stands for ``pickle`` in the zoo's modules that save and draw tables of runs.

    :param allow_pickle: whether pickled files are read too
    """

    def __init__(self, allow_pickle: bool = False):
        self._allow_pickle = allow_pickle

    @staticmethod
    def open(path: str, mode: str) -> IO[Any]:
        """
        As the built-in function, but for pipes and devices, which are not read.

        :param path: of a file
        :param mode: see there
        :return: the file
        """
        return open_regular(path) if mode == "rb" else open(path, mode)

    def dump(self, value: Any, file: IO[bytes]) -> None:
        """
        :param value: what ``all_plots`` gathered
        :param file: file to write to
        """
        tensors: dict[str, torch.Tensor] = {}
        container.write(file, _PLOT_KIND, encode(value, "runs", tensors), tensors)  # type: ignore[arg-type]

    def load(self, file: IO[bytes]) -> Any:
        """
        :param file: file to read
        :return: what ``all_plots`` gathered
        :raises BadFile: if it is damaged, or pickled and not allowed to be
        """
        try:
            runs = decode(*container.read(file, _PLOT_KIND), "runs")  # type: ignore[arg-type]
        except PickledFile:
            if not self._allow_pickle:
                raise
            file.seek(0)
            return pickle.load(file)
        _check_runs(runs, str(getattr(file, "name", "the file")))
        return runs


def _check_runs(runs: Any, name: str) -> None:
    """
    :param runs: tables by name of the task and of the curve, and one for the terminal
    :param name: the file, for messages
    :raises BadFile: if they hold other values than numbers and words
    """
    if not _is_table(runs):
        raise BadFile(f"{name} does not hold what all_plots has gathered")
    for task, curves in runs.items():
        if task == "results_table":
            fits = _is_table(curves) and all(map(_are_words, (curves.get("headers"), *_rows(curves))))
        else:
            fits = _is_table(curves) and all(
                _is_table(curve) and all(map(_are_numbers, curve.values())) for curve in curves.values()
            )
        if not fits:
            raise BadFile(f"{name}: {task} is not what all_plots has gathered")


def _is_table(value: Any) -> bool:
    return isinstance(value, dict) and _are_words(list(value))


def _rows(table: dict[str, Any]) -> list[Any]:
    rows = table.get("value_matrix")
    return rows if isinstance(rows, list) else [None]


def _are_words(value: Any) -> bool:
    # What is not printable could tell a terminal what to do.
    return isinstance(value, list) and all(isinstance(word, str) and word.isprintable() for word in value)


def _are_numbers(value: Any) -> bool:
    array = np.asarray(value) if isinstance(value, (np.ndarray, np.generic, float, int, list)) else None
    return array is not None and array.dtype.kind in "biuf"
