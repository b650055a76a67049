"""
Settings of a run (``args.yml``, ``config.yml``). The stock zoo makes any objects that these files name, evaluates texts
as Python, imports modules, and calls their content with arguments from the file. Here settings are plain values, known
classes of networks, and wrappers from a list.
"""

import ast
import math
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import rl_zoo3.wrappers
import yaml
from gymnasium import wrappers
from sb3_contrib.common.wrappers import TimeFeatureWrapper
from stable_baselines3.common import atari_wrappers, vec_env
from stable_baselines3.common.monitor import Monitor

from sb3_sample.envs.atari import AtariFrames
from sb3_sample.saving.classes import resolve, within
from sb3_sample.saving.untrusted import BadFile, read_regular
from sb3_sample.shallow_yaml import ShallowLoader

#: Largest size of a file in bytes, and number of values in it, where an alias counts as the values that it stands for:
#: some hundred times the size that the zoo writes, and still read in a moment.
MAX_BYTES, MAX_VALUES = 2**15, 5000
#: Largest count in a run's file: frames that are stacked, steps that an action is repeated, ...
MAX_COUNT = 1000
#: The largest whole number among the arguments of an environment that a file gives.
MAX_NUMBER = 10_000
#: Largest number of characters of a text that is Python.
_MAX_TEXT = 1000
_YAML = "tag:yaml.org,2002:"
_NAME, _ORDERED = f"{_YAML}python/name:", f"{_YAML}python/object/apply:collections.OrderedDict"
#: Tags of the zoo's settings.
_TAGS = {_ORDERED, *(_YAML + kind for kind in ("map", "seq", "str", "int", "float", "bool", "null", "python/tuple"))}
_UNSAFE = "which can run code: --allow-pickle reads it nevertheless"
#: A text that is no path of a file.
_WORD = re.compile(r"(?![.~])[\w .:+-]{0,100}")


# ---------------------------------------------------------------- YAML


class _Loader(ShallowLoader):
    """
    Makes plain values, tuples, and classes that a file may name.

    :param text: YAML
    :param trusted_modules: further modules whose classes may be named
    """

    def __init__(self, text: str, trusted_modules: Sequence[str]):
        super().__init__(text)
        self.trusted_modules = trusted_modules

    def read(self) -> Any:
        """
        :return: the value that the text describes
        :raises BadFile: if it holds more than plain values
        """
        node = self.get_single_node()
        if node is None:
            return None
        _count(node, {})
        return self.construct_document(node)

    def _name(self, path: str, node: Any) -> Any:
        module, _, name = path.rpartition(".")
        try:
            return resolve(f"{module}:{name}", self.trusted_modules)
        except ValueError as error:
            raise BadFile(f"{error}, {_UNSAFE}") from error

    def _tuple(self, node: Any) -> tuple[Any, ...]:
        return tuple(self.construct_sequence(node, deep=True))

    def _ordered(self, node: Any) -> dict[Any, Any]:
        (pairs,) = self.construct_sequence(node, deep=True)
        return dict(pairs)


_Loader.add_multi_constructor(_NAME, _Loader._name)
_Loader.add_constructor(f"{_YAML}python/tuple", _Loader._tuple)
_Loader.add_constructor(_ORDERED, _Loader._ordered)


def _count(node: Any, counted: dict[int, int]) -> int:
    """
    Check a value and all that it holds, before anything is made of them.

    :return: the number of values, where an alias counts as all values that it stands for
    """
    if id(node) in counted:
        if not counted[id(node)]:
            raise BadFile("a value holds itself")
        return counted[id(node)]
    if node.tag not in _TAGS and not node.tag.startswith(_NAME):
        raise BadFile(f"it makes an object, {node.tag.removeprefix(_YAML)!r:.100}, {_UNSAFE}")
    counted[id(node)] = 0
    parts: list[Any] = []
    if isinstance(node, yaml.MappingNode):
        parts = [part for pair in node.value for part in pair]
    elif isinstance(node, yaml.SequenceNode):
        parts = node.value
    total = 1 + sum(_count(part, counted) for part in parts)
    if total > MAX_VALUES:
        raise BadFile(f"it holds more than the {MAX_VALUES:,} values that are allowed")
    counted[id(node)] = total
    return total


def _read(path: Path, trusted_modules: Sequence[str]) -> dict[str, Any]:
    try:
        text = read_regular(path, MAX_BYTES).decode()
        settings = _Loader(text, trusted_modules).read()
    except BadFile as error:
        raise BadFile(f"{path}: {error}") from error
    except Exception as error:  # PyYAML's constructors can raise any error
        raise BadFile(f"{path} is no YAML file of the zoo: {type(error).__name__}: {error}") from error
    if not isinstance(settings, dict) or not all(isinstance(name, str) for name in settings):
        raise BadFile(f"{path} does not hold settings by name")
    return settings


# ---------------------------------------------------------------- what wrappers may be given

Check = Callable[[Any], bool]


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value <= MAX_COUNT


def _is_step(value: Any) -> bool:
    return type(value) is int and 0 < value < 2**53


def _is_flag(value: Any) -> bool:
    return type(value) is bool


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < 2**53


def _are_numbers(value: Any) -> bool:
    return all(map(_are_numbers, value)) if isinstance(value, (list, tuple)) else _is_number(value)


def _is_word(value: Any) -> bool:
    return isinstance(value, str) and _WORD.fullmatch(value) is not None


def _are_words(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and all(map(_is_word, value))


def _is_shape(value: Any) -> bool:
    sizes = value if isinstance(value, (list, tuple)) else (value,)
    return all(type(size) is int and size > 0 for size in sizes) and math.prod(sizes) <= 2**22


def _is_dtype(value: Any) -> bool:
    return value in ("float16", "float32", "float64", "uint8", "int32", "int64")


def _is_nothing(value: Any) -> bool:
    return value is None


Arguments = Mapping[str, Check]
_SKIP: Arguments = {"skip": _is_count}
_EXTREMES: Arguments = {"noop_max": _is_count, "frame_skip": _is_count, "terminal_on_life_loss": _is_flag}
#: The wrappers that a run's file may name, and their arguments: only wrappers that just compute. Wrappers that write
#: files, open windows, call functions or collect without end are not among them.
WRAPPERS: dict[type, Arguments] = {
    wrappers.AddRenderObservation: {"render_only": _is_flag, "render_key": _is_word, "obs_key": _is_word},
    wrappers.AtariPreprocessing: {
        **_EXTREMES, "screen_size": _is_shape, "grayscale_obs": _is_flag, "grayscale_newaxis": _is_flag,
        "scale_obs": _is_flag,
    },
    wrappers.Autoreset: {},
    wrappers.ClipAction: {},
    wrappers.ClipReward: {"min_reward": _are_numbers, "max_reward": _are_numbers},
    wrappers.DelayObservation: {"delay": _is_count},
    wrappers.DtypeObservation: {"dtype": _is_dtype},
    wrappers.FilterObservation: {"filter_keys": _are_words},
    wrappers.FlattenObservation: {},
    wrappers.FrameStackObservation: {"stack_size": _is_count, "padding_type": _is_word},
    wrappers.GrayscaleObservation: {"keep_dim": _is_flag},
    wrappers.MaxAndSkipObservation: _SKIP,
    wrappers.NormalizeObservation: {"epsilon": _is_number},
    wrappers.NormalizeReward: {"gamma": _is_number, "epsilon": _is_number},
    wrappers.OrderEnforcing: {"disable_render_order_enforcing": _is_flag},
    wrappers.PassiveEnvChecker: {},
    wrappers.RecordEpisodeStatistics: {"buffer_length": _is_step, "stats_key": _is_word},
    wrappers.RescaleAction: {"min_action": _are_numbers, "max_action": _are_numbers},
    wrappers.RescaleObservation: {"min_obs": _are_numbers, "max_obs": _are_numbers},
    wrappers.ReshapeObservation: {"shape": _is_shape},
    wrappers.ResizeObservation: {"shape": _is_shape},
    wrappers.StickyAction: {"repeat_action_probability": _is_number, "repeat_action_duration": _is_shape},
    wrappers.TimeAwareObservation: {"flatten": _is_flag, "normalize_time": _is_flag, "dict_time_key": _is_word},
    wrappers.TimeLimit: {"max_episode_steps": _is_step},
    Monitor: {
        "filename": _is_nothing, "allow_early_resets": _is_flag, "reset_keywords": _are_words,
        "info_keywords": _are_words,
    },
    AtariFrames: {
        "size": _is_count, "frame_stack": _is_count, "frame_skip": _is_count,
        "noop_max": lambda value: value is None or _is_count(value), "episodic_life": _is_flag, "clip_reward": _is_flag,
    },
    atari_wrappers.AtariWrapper: {
        **_EXTREMES, "screen_size": _is_shape, "clip_reward": _is_flag, "action_repeat_probability": _is_number,
    },
    atari_wrappers.ClipRewardEnv: {},
    atari_wrappers.EpisodicLifeEnv: {},
    atari_wrappers.FireResetEnv: {},
    atari_wrappers.MaxAndSkipEnv: _SKIP,
    atari_wrappers.NoopResetEnv: {"noop_max": _is_count},
    atari_wrappers.StickyActionEnv: {"action_repeat_probability": _is_number},
    atari_wrappers.WarpFrame: {"width": _is_count, "height": _is_count},
    TimeFeatureWrapper: {"max_steps": _is_step, "test_mode": _is_flag},
    rl_zoo3.wrappers.ActionNoiseWrapper: {"noise_std": _is_number},
    rl_zoo3.wrappers.ActionSmoothingWrapper: {"smoothing_coef": _is_number},
    rl_zoo3.wrappers.DelayedRewardWrapper: {"delay": _is_count},
    rl_zoo3.wrappers.FrameSkip: _SKIP,
    rl_zoo3.wrappers.HistoryWrapper: {"horizon": _is_count},
    rl_zoo3.wrappers.HistoryWrapperObsDict: {"horizon": _is_count},
    rl_zoo3.wrappers.MaskVelocityWrapper: {},
    rl_zoo3.wrappers.TruncatedOnSuccessWrapper: {"reward_offset": _is_number, "n_successes": _is_count},
    rl_zoo3.wrappers.YAMLCompatResizeObservation: {"shape": _is_shape},
}  # fmt: skip
#: The same for vectorised environments.
VEC_WRAPPERS: dict[type, Arguments] = {
    vec_env.VecCheckNan: {"raise_exception": _is_flag, "warn_once": _is_flag, "check_inf": _is_flag},
    vec_env.VecExtractDictObs: {"key": _is_word},
    vec_env.VecFrameStack: {"n_stack": _is_count, "channels_order": _is_word},
    vec_env.VecMonitor: {"filename": _is_nothing, "info_keywords": _are_words},
    vec_env.VecNormalize: {
        "training": _is_flag, "norm_obs": _is_flag, "norm_reward": _is_flag, "clip_obs": _is_number,
        "clip_reward": _is_number, "gamma": _is_number, "epsilon": _is_number, "norm_obs_keys": _are_words,
    },
    vec_env.VecTransposeImage: {"skip": _is_flag},
}  # fmt: skip


def _check_wrapper(entry: Any, known: Mapping[type, Arguments], where: str, trusted_modules: Sequence[str]) -> None:
    """
    :param entry: path of a wrapper, or a dict of it and its arguments
    :param known: wrappers that may be named, whichever module holds them
    :param where: file and name of the setting
    :param trusted_modules: further modules whose wrappers may be named, with any arguments
    """
    if isinstance(entry, dict) and len(entry) == 1:
        ((path, arguments),) = entry.items()
    else:
        path, arguments = entry, {}
    if not isinstance(path, str) or not isinstance(arguments, dict) or not all(map(_is_identifier, arguments)):
        raise BadFile(f"{where} is {entry!r:.100}, not the path of a wrapper, or that with its arguments by name")
    module, _, name = path.rpartition(".")
    if within(module, trusted_modules):
        return
    # Only modules that are imported already: importing one could do anything.
    found = getattr(sys.modules.get(module), "__dict__", {}).get(name)
    if not isinstance(found, type) or found not in known:
        raise BadFile(
            f"{where} is {path!r:.100}, which is not one of the wrappers that are known to write nothing: "
            f"{_UNSAFE.partition(': ')[0]}. --trusted-modules takes its module"
        )
    checks = known[found]
    for argument, value in arguments.items():
        if argument not in checks or not checks[argument](value):
            raise BadFile(
                f"{where} is {path}, for which {argument[:50]} cannot be {value!r:.100}: a run's file gives wrappers "
                "no names of files, and no numbers out of all proportion. --trusted-modules takes its module"
            )


def _is_identifier(value: Any) -> bool:
    return isinstance(value, str) and value.isidentifier()


# ---------------------------------------------------------------- the settings that the zoo uses


def read_settings(path: Path, trusted_modules: Sequence[str] = (), given: Sequence[str] = ()) -> dict[str, Any]:
    """
    Read ``args.yml`` or ``config.yml`` as the zoo's commands use them: nothing in them is run or evaluated.

    :param path: the file
    :param trusted_modules: modules, or packages of modules, whose classes it may name
    :param given: arguments of the environment that the command line gives, so that the file's do not count
    :return: the settings
    :raises BadFile: (a ``ValueError``) if they hold more than plain values, known wrappers, and classes that a model's
        file may name
    """
    settings = _read(path, trusted_modules)
    if path.name == "args.yml":
        if "env_kwargs" not in settings:
            raise BadFile(f"{path} has no env_kwargs")
        if settings["env_kwargs"] is not None:
            settings["env_kwargs"] = _env_kwargs(settings["env_kwargs"], path, given)
        return settings
    if "env_kwargs" in settings:
        settings["env_kwargs"] = _env_kwargs(settings["env_kwargs"], path, given)
    if "normalize" in settings:
        settings["normalize"] = _normalize(settings["normalize"], path)
    for key, known in (("env_wrapper", WRAPPERS), ("vec_env_wrapper", VEC_WRAPPERS)):
        # The zoo treats None as an error in one of the two.
        if settings.get(key) is None:
            settings.pop(key, None)
            continue
        entries = settings[key]
        for entry in entries if isinstance(entries, list) else [entries]:
            _check_wrapper(entry, known, f"{path}: {key}", trusted_modules)
    frames = settings.get("frame_stack", 0)
    if not _is_count(frames):
        raise BadFile(f"{path}: frame_stack must be a whole number up to {MAX_COUNT}, not {frames!r:.100}")
    buffer = settings.get("replay_buffer_class", "")
    # The zoo looks for a word in it.
    settings["replay_buffer_class"] = buffer.__name__ if isinstance(buffer, type) else buffer
    if not isinstance(settings["replay_buffer_class"], str):
        raise BadFile(f"{path}: replay_buffer_class cannot be {buffer!r:.100}")
    return settings


def check_settings(folder: Path, trusted_modules: Sequence[str] = (), given: Sequence[str] = ()) -> None:
    """
    Check a run's ``args.yml`` and ``config.yml`` before the zoo reads them.

    :param folder: the folder that holds them
    :param trusted_modules: modules, or packages of modules, whose classes they may name
    :param given: arguments of the environment that the command line gives
    :raises BadFile: see ``read_settings``
    """
    for name in ("args.yml", "config.yml"):
        # The zoo passes over what is there and no file.
        if os.path.lexists(folder / name):
            read_settings(folder / name, trusted_modules, given)


def _env_kwargs(arguments: Any, path: Path, given: Sequence[str]) -> dict[str, Any]:
    if not isinstance(arguments, dict) or not all(map(_is_identifier, arguments)):
        raise BadFile(f"{path}: env_kwargs must be arguments by name, not {arguments!r:.100}")
    kept = {name: value for name, value in arguments.items() if name not in given}
    for name, value in kept.items():
        if not _is_plain(value):
            raise BadFile(
                f"{path}: env_kwargs has {name[:50]}={value!r:.100}: a run's file gives an environment no names of "
                f"files and no whole numbers above {MAX_NUMBER:,}. --env-kwargs {name[:50]}:VALUE gives it one"
            )
    return kept


def _is_plain(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return all(map(_is_plain, value))
    if isinstance(value, dict):
        return all(map(_is_word, value)) and all(map(_is_plain, value.values()))
    if type(value) is int:
        return abs(value) <= MAX_NUMBER
    if type(value) is float:
        return math.isfinite(value)
    return value is None or isinstance(value, bool) or _is_word(value)


def _normalize(value: Any, path: Path) -> Any:
    """Whether there is a ``VecNormalize``, or its arguments, which the zoo writes as Python to be evaluated."""
    if isinstance(value, str):
        try:
            value = _literal(value)
        except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError) as error:
            raise BadFile(f"{path}: normalize is Python, {value!r:.100}, {_UNSAFE}") from error
    if not isinstance(value, (bool, dict, type(None))):
        raise BadFile(f"{path}: normalize must be true, false or arguments by name, not {value!r:.100}")
    return value


def _literal(text: str) -> Any:
    """The value of a literal, or of ``dict(name=value, ...)``."""
    if len(text) > _MAX_TEXT:
        raise ValueError("too long")
    tree = ast.parse(text, mode="eval").body
    if isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name) and tree.func.id == "dict" and not tree.args:
        pairs = [(keyword.arg, ast.literal_eval(keyword.value)) for keyword in tree.keywords]
        if all(name is not None for name, _ in pairs):
            return dict(pairs)
    return ast.literal_eval(tree)
