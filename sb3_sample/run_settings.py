"""
Algorithm, environment and arguments of a run, from its settings files: ``run.json`` of ``sb3-sample train --run-dir``,
``args.yml`` and ``config.yml`` of the zoo, or the head of a Monitor file. A run's folder may come from anybody: nothing
in it is imported or called.
"""

import ast
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from sb3_sample.envs.registration import PACKAGE
from sb3_sample.run_logs import monitor_files, monitor_head
from sb3_sample.saving.untrusted import BadFile, parse_json, read_regular

RECORD = "run.json"
#: In the folder of a study: the folder of its runs, and the list of the runs.
STUDY_RUNS, STUDY_LIST = "runs", "study.json"
#: Most bytes of a settings file, and most values in it.
_MAX_SETTINGS, _MAX_VALUES = 2**18, 5_000
#: Settings of a run that do not describe the agent.
_OF_THE_RUN = {
    "algo", "env", "seed", "trained_agent", "truncate_last_trajectory", "vec_env", "eval_env_kwargs", "eval_freq",
    "eval_episodes", "n_eval_envs", "save_freq", "n_timesteps", "callback",
}  # fmt: skip
#: Wrappers of the zoo's settings that hold an action for several steps, 4 by default, and the argument that sets how
#: many.
_SKIPPING = {
    **dict.fromkeys(("FrameSkip", "MaxAndSkipEnv", "MaxAndSkipObservation"), "skip"),
    **dict.fromkeys(("AtariFrames", "AtariPreprocessing", "AtariWrapper"), "frame_skip"),
}


class RunSettings(NamedTuple):
    """
    :param agent: name; None if the run's files do not say
    :param arguments: arguments of the agent
    :param task: id of the environment; None if the files do not say
    :param seed: seed; None if the files do not say
    :param repeat: simulator steps per step of the environment
    :param skip: steps of the environment, as Monitor counts them, per step of the agent
    """

    agent: str | None
    arguments: dict[str, Any]
    task: str | None
    seed: int | None
    repeat: int = 1
    skip: int = 1


def run_env_id(folder: Path) -> str | None:
    """
    :param folder: a run's folder
    :return: the environment's id as Monitor wrote it into its files; None if there are none
    """
    ids = (monitor_head(file)["env_id"] for file in monitor_files(folder))
    return next((env_id for env_id in ids if env_id is not None), None)


def study_of(folder: Path) -> Path | None:
    """
    :param folder: a run's folder
    :return: the study that contains it as ``runs/<agent and grid>/<task>/<seed>``; None if there is none
    """
    above = folder.absolute().parents
    is_in_one = len(above) > 3 and above[2].name == STUDY_RUNS and (above[3] / STUDY_LIST).is_file()
    return above[3] if is_in_one else None


def read_settings(folder: Path) -> RunSettings:
    """
    :param folder: a run's folder
    :return: the settings in its files
    :raises BadFile: (a ``ValueError``) a file is damaged
    :raises OSError: if a file cannot be read
    """
    if (folder / RECORD).exists():
        record = parse_json(read_regular(folder / RECORD, _MAX_SETTINGS), str(folder / RECORD))
        if not isinstance(record, dict) or not isinstance(record.get("settings"), dict):
            raise BadFile(f"{folder / RECORD} is no record of a run")
        settings = {name: _literal(text) for name, text in record["settings"].items()}
        return _of_settings(settings, record, folder / RECORD)
    files = sorted(folder.glob("*/args.yml"))
    if files:
        arguments = _yaml(files[0])
        config = files[0].with_name("config.yml")
        settings = {"env_kwargs": arguments.get("env_kwargs"), **(_yaml(config) if config.exists() else {})}
        return _of_settings(settings, arguments, files[0])
    env_id = run_env_id(folder)
    return RunSettings(None, {}, None if env_id is None else plain_id(env_id), None)


def _of_settings(settings: dict[str, Any], head: Mapping[str, Any], path: Path) -> RunSettings:
    """
    :param settings: the agent's and those of ``_OF_THE_RUN``
    :param head: has "algo", "env" and "seed"
    :param path: the file, for messages
    """
    algo, env, seed = (head.get(name) for name in ("algo", "env", "seed"))
    if not isinstance(algo, str) or not isinstance(env, str) or not (seed is None or type(seed) is int):
        raise BadFile(f"{path} is no record of a run: algo is {algo!r:.50}, env {env!r:.50}, seed {seed!r:.50}")
    # None is a value as any other, but the command line's ``env_kwargs`` are None if they are not given.
    arguments = {
        name: value
        for name, value in settings.items()
        if name not in _OF_THE_RUN and not (name == "env_kwargs" and value is None)
    }
    repeat = _action_repeat(settings)
    if type(repeat) is not int or repeat < 1:
        raise BadFile(f"{path}: action_repeat is {repeat!r:.50}, not a whole number from 1 on")
    return RunSettings(algo, arguments, plain_id(env), seed, repeat, _skipped(settings.get("env_wrapper")))


def simulator_steps(arguments: Mapping[str, Any]) -> int:
    """
    :param arguments: arguments of a run, as in a table of runs
    :return: simulator steps per step of the agent: the action repeat of its environment, times the steps for which its
        wrappers hold an action
    """
    return int(_action_repeat(arguments)) * _skipped(arguments.get("env_wrapper"))


def _action_repeat(settings: Mapping[str, Any]) -> Any:
    env_kwargs = settings.get("env_kwargs")
    return env_kwargs.get("action_repeat", 1) if isinstance(env_kwargs, dict) else 1


def _skipped(wrappers: Any) -> int:
    skip = 1
    for entry in wrappers if isinstance(wrappers, list) else [wrappers]:
        ((path, arguments),) = entry.items() if isinstance(entry, dict) and len(entry) == 1 else [(entry, {})]
        name = _SKIPPING.get(str(path).rpartition(".")[2])
        if name is not None:
            count = arguments.get(name, 4) if isinstance(arguments, dict) else 4
            skip *= count if type(count) is int and count >= 1 else 1
    return skip


def plain_id(env_id: str) -> str:
    """
    :param env_id: id of an environment
    :return: the id without this package's name as its prefix
    """
    return env_id.removeprefix(f"{PACKAGE}:")


def _literal(text: Any) -> Any:
    """The value of a setting that ``repr`` has written; the text itself if it is no plain value."""
    try:
        value = ast.literal_eval(text)
        return _plain(value, [_MAX_VALUES])
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return str(text)


def _plain(value: Any, left: list[int]) -> Any:
    """
    :param value: value from a settings file
    :param left: number of values that are still allowed, since an alias in YAML stands for many
    :return: the value in JSON's types
    """
    left[0] -= 1
    if left[0] < 0:
        raise BadFile(f"settings hold more than {_MAX_VALUES:,} values")
    if isinstance(value, dict):
        return {str(name): _plain(each, left) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each, left) for each in value]
    if value is None or isinstance(value, (bool, int, str)) or (isinstance(value, float) and math.isfinite(value)):
        return value
    return str(value)


class _Settings(yaml.CSafeLoader if hasattr(yaml, "CSafeLoader") else yaml.SafeLoader):  # type: ignore[misc]
    """Make plain values only: a class becomes its name, and nothing is imported or called."""


def _named(_: Any, name: str, __: Any) -> str:
    return name


def _tuple(loader: Any, node: Any) -> list[Any]:
    return loader.construct_sequence(node, deep=True)  # type: ignore[no-any-return]


def _ordered(loader: Any, node: Any) -> dict[Any, Any]:
    (pairs,) = loader.construct_sequence(node, deep=True)
    return dict(pairs)


_PYTHON = "tag:yaml.org,2002:python"
_Settings.add_multi_constructor(f"{_PYTHON}/name:", _named)
_Settings.add_constructor(f"{_PYTHON}/tuple", _tuple)
_Settings.add_constructor(f"{_PYTHON}/object/apply:collections.OrderedDict", _ordered)


def _yaml(path: Path) -> dict[str, Any]:
    data = read_regular(path, _MAX_SETTINGS)
    try:
        settings = yaml.load(data, _Settings)  # a safe loader
    except Exception as error:  # PyYAML's constructors can raise anything
        raise BadFile(f"{path} is no YAML file of the zoo: {type(error).__name__}: {error}") from error
    if not isinstance(settings, dict):
        raise BadFile(f"{path} does not hold settings by name")
    return _plain(settings, [_MAX_VALUES])  # type: ignore[no-any-return]
