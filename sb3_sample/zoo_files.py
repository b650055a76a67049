"""
The files of the zoo's commands that are pickled in the stock zoo: those of our algorithms run no code when they are
read. They keep the zoo's names (``vecnormalize.pkl``, ``replay_buffer.pkl``), by which its commands find them.

The zoo's own algorithms are read and written as in the stock zoo, since their models are pickled too.
"""

import argparse
import ast
import contextlib
import functools
import importlib
import inspect
import pickle
import sys
import types
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import gymnasium as gym
import rl_zoo3.utils
import torch
import yaml
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from sb3_sample.saving import container
from sb3_sample.saving.classes import resolve
from sb3_sample.saving.container import BadFile, PickledFile
from sb3_sample.saving.encoding import decode, encode
from sb3_sample.saving.model import SafeFiles
from sb3_sample.saving.normalization import load_vec_normalize, save_vec_normalize
from sb3_sample.saving.replay import SafeReplayBuffers

#: Whether pickles are read: as ``reading`` says, and None outside of it, in the stock zoo's own commands.
_allow_pickle: bool | None = None
_UNSAFE = "which can run code: --allow-pickle reads it nevertheless"
_PLOT_KIND = "plotted runs"
_YAML = "tag:yaml.org,2002:"
#: What the zoo's settings consist of.
_TAGS = {
    *(_YAML + kind for kind in ("map", "seq", "str", "int", "float", "bool", "null", "python/tuple")),
    f"{_YAML}python/object/apply:collections.OrderedDict",
}


@contextlib.contextmanager
def replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """
    Something else in the place of an attribute, for a while.

    :param owner: module or class whose own attribute it is
    :param name: its name
    :param value: what takes its place
    """
    before = vars(owner)[name]
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


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
        return function(*args, allow_pickle=allow_pickle or pickles, trusted_modules=more, **kwargs)

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
        return load_vec_normalize(path, venv, allow_pickle=_allow_pickle is not False)


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


def check_settings(folder: Path, trusted_modules: Sequence[str] = ()) -> None:
    """
    Look at a run's ``args.yml`` and ``config.yml`` before the zoo does, which makes whatever objects they name and
    evaluates what stands in them as Python.

    :param folder: where they are
    :param trusted_modules: modules, or packages of modules, whose classes they may name
    :raises BadFile: if they hold more than plain values and classes that a model's file may name
    """
    for name in ("args.yml", "config.yml"):
        file = folder / name
        if not file.is_file():
            continue
        text = file.read_text()
        try:
            nodes = [yaml.compose(text, Loader=yaml.SafeLoader)]
            while nodes:
                node = nodes.pop()
                _check_tag(node, file, trusted_modules)
                if isinstance(node, yaml.CollectionNode):
                    pairs = isinstance(node, yaml.MappingNode)
                    nodes += [part for item in node.value for part in (item if pairs else [item])]
            settings: Any = yaml.load(text, Loader=yaml.UnsafeLoader)  # what it makes was looked at
        except (yaml.YAMLError, RecursionError) as error:
            raise BadFile(f"{file} is no YAML file of the zoo: {error}") from error
        if not isinstance(settings, dict):
            raise BadFile(f"{file} does not hold settings by name")
        if name == "config.yml":
            _check_evaluated(settings, file, trusted_modules)


def _check_tag(node: Any, file: Path, trusted_modules: Sequence[str]) -> None:
    if node is None or node.tag in _TAGS:
        return
    kind, _, path = node.tag.removeprefix(_YAML).partition(":")
    if kind != "python/name":
        raise BadFile(f"{file}: it makes an object, {node.tag.removeprefix(_YAML)!r:.100}, {_UNSAFE}")
    module, _, name = path.rpartition(".")
    try:
        resolve(f"{module}:{name}", trusted_modules)
    except ValueError as error:
        raise BadFile(f"{file}: {error}, {_UNSAFE}") from error


def _check_evaluated(settings: dict[str, Any], file: Path, trusted_modules: Sequence[str]) -> None:
    text = settings.get("normalize")
    if isinstance(text, str) and not _is_literal(text):
        raise BadFile(f"{file}: normalize is Python, {text!r:.100}, {_UNSAFE}")
    for key in ("env_wrapper", "vec_env_wrapper"):
        wrappers = settings.get(key) or []
        for wrapper in wrappers if isinstance(wrappers, list) else [wrappers]:
            names = list(wrapper) if isinstance(wrapper, dict) else [wrapper]
            if not all(_is_wrapper(name, trusted_modules) for name in names):
                raise BadFile(f"{file}: {key} is {wrapper!r:.100}, {_UNSAFE}. --trusted-modules takes its module")


def _is_literal(text: str) -> bool:
    """Whether a text is a value, or ``dict(name=value, ...)``."""
    try:
        tree = ast.parse(text, mode="eval").body
        is_dict = isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name) and tree.func.id == "dict"
        if isinstance(tree, ast.Call) and is_dict and not tree.args:
            values: list[ast.expr] = [keyword.value for keyword in tree.keywords]
        else:
            values = [tree]
        for value in values:
            ast.literal_eval(value)
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError):
        return False
    return True


def _is_wrapper(path: Any, trusted_modules: Sequence[str]) -> bool:
    """Whether a path is that of a wrapper of the libraries that are used anyway, or of a trusted module."""
    module, _, name = str(path).rpartition(".")
    if any(module == trusted or module.startswith(f"{trusted}.") for trusted in trusted_modules):
        return True
    if module.partition(".")[0] not in ("gymnasium", "stable_baselines3", "sb3_contrib", "rl_zoo3", "sb3_sample"):
        return False
    try:
        value = getattr(importlib.import_module(module), name, None)
    except ImportError:
        return False
    return inspect.isclass(value) and issubclass(value, (gym.Wrapper, VecEnvWrapper))


# ---------------------------------------------------------------- what all_plots saves


class PlottedRuns:
    """
    Stands for ``pickle`` in the zoo's modules that save and draw tables of runs.

    :param allow_pickle: whether pickled files are read too
    """

    def __init__(self, allow_pickle: bool = False):
        self._allow_pickle = allow_pickle

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
            return decode(*container.read(file, _PLOT_KIND), "runs")  # type: ignore[arg-type]
        except PickledFile:
            if not self._allow_pickle:
                raise
            file.seek(0)
            return pickle.load(file)
