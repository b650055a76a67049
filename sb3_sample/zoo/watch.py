"""Additions of ``sb3-sample enjoy`` and ``record_video`` to the zoo's: ``--run-dir``, and files that run no code."""

import argparse
import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from rl_zoo3.utils import create_test_env, get_model_path, get_saved_hyperparams
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
    unwrap_vec_normalize,
)

from sb3_sample.exits import refuse
from sb3_sample.run_logs import has_ended
from sb3_sample.saving import container
from sb3_sample.saving.attributes import Restorer
from sb3_sample.saving.checkpoint import KIND, MODEL, STATE
from sb3_sample.saving.classes import importing_nothing
from sb3_sample.saving.encoding import decode
from sb3_sample.saving.normalization import lacks_vec_normalize
from sb3_sample.saving.statistics import ARGUMENTS, check_normalization, shapes_of
from sb3_sample.saving.untrusted import BadFile
from sb3_sample.zoo.algorithms import ALGORITHMS
from sb3_sample.zoo.files import Refused, RunError, add_trust
from sb3_sample.zoo.patches import make_answering_env, models_checked, reading, reading_settings, watched_with
from sb3_sample.zoo.records import Record, all_checkpoints
from sb3_sample.zoo.settings import check_settings


def watch_parser(command: str) -> argparse.ArgumentParser:
    """
    :param command: ``enjoy`` or ``record_video``
    :return: parser of the options that it takes besides the zoo's
    """
    parser = argparse.ArgumentParser(
        f"sb3-sample {command}", usage=argparse.SUPPRESS, add_help=False, allow_abbrev=False
    )
    group = parser.add_argument_group("runs of our algorithms")
    group.add_argument(
        "--run-dir",
        type=Path,
        metavar="DIR",
        help="Folder of the run, in the place of --folder and --exp-id. --load-last-checkpoint takes the model of its "
        "newest checkpoint, also while it is trained",
    )
    add_trust(group)
    return parser


@contextlib.contextmanager
def watching(options: argparse.Namespace, arguments: Sequence[str], *modules: Any) -> Iterator[list[str]]:
    """
    Prepare the zoo for ``enjoy`` and ``record_video``.

    :param options: what ``watch_parser`` has parsed
    :param arguments: the rest of the command line
    :param modules: the modules that look for a run with ``get_model_path``, read its settings with
        ``get_saved_hyperparams`` and make environments with ``create_test_env``
    :return: command line for the zoo
    :raises RunError: if ``--run-dir`` is not the folder of a run, or the run is of another algorithm than ours
    """
    given = _given(arguments)
    with contextlib.ExitStack() as stack:
        watch = _Watch(options, given, stack)
        stack.enter_context(watched_with(watch.find, watch.read_settings, watch.make_env, *modules))
        yield [*(_of_record(options, given) if options.run_dir is not None else []), *arguments]


def _given(arguments: Sequence[str]) -> argparse.Namespace:
    """Algorithm and environment's arguments of a command line, in any spelling that the zoo takes."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("--env-kwargs", nargs="+", default=[])
    # With these options, abbreviations are as ambiguous as for the zoo.
    parser.add_argument("--env")
    parser.add_argument("--exp-id")
    return parser.parse_known_args(arguments)[0]


def _of_record(options: argparse.Namespace, given: argparse.Namespace) -> list[str]:
    """
    Algorithm and environment of the run, which the command line can replace. The run's own file must not decide whether
    it is read as one of ours, or as the stock zoo reads its own, whose files can run code.
    """
    record = Record.read(options.run_dir)
    if record.algo not in ALGORITHMS and given.algo is None and not options.allow_pickle:
        raise RunError(
            f"{options.run_dir} says that it is a run of {record.algo}, whose files can run any code that their author "
            f"wanted, and which is none of this package ({', '.join(ALGORITHMS)}). If you trust its author: "
            f"--algo {record.algo}, or --allow-pickle"
        )
    # As one word: a value after an option could be taken for another option.
    return [f"--env={record.env}", *([] if given.algo is not None else [f"--algo={record.algo}"])]


class _Watch:
    """
    Wraps three functions of the zoo.

    :param options: what ``watch_parser`` has parsed
    :param given: what ``_given`` has found
    :param stack: holds the patches in force until the command ends
    """

    def __init__(self, options: argparse.Namespace, given: argparse.Namespace, stack: contextlib.ExitStack):
        self._options, self._stack = options, stack
        self._env_kwargs = [argument.partition(":")[0] for argument in given.env_kwargs]
        #: Whether only files are read that run no code.
        self._is_safe = False
        #: Arguments of the environment in the run's ``config.yml``.
        self._env_kwargs_of_config: Mapping[str, Any] = {}
        self._env: VecEnv | None = None
        #: The checkpoint that the model is of.
        self._checkpoint: Path | None = None

    def find(self, exp_id: int, folder: str, algo: str, env_name: Any, *which: Any) -> tuple[str, str, str]:
        """
        Find the model as ``get_model_path`` does, and check the settings that the zoo is about to read.

        :raises Refused: if the run is refused; it is no ``ValueError``, which the zoo would answer by a download
        """
        options, is_ours = self._options, algo in ALGORITHMS
        if not is_ours and not options.allow_pickle:
            print(
                f"sb3-sample: {algo} is an algorithm of the zoo's own: its files are pickled, and reading them runs "
                "whatever code their author wanted",
                file=sys.stderr,
            )
        try:
            if env_name.gym_id not in gym.registry:
                raise RunError(f"{env_name.gym_id} is not registered: give --env, or --gym-packages")
            if options.run_dir is None:
                found = get_model_path(exp_id, folder, algo, env_name, *which)
                if Path(found[1]).name == f"{env_name}.zip" and not has_ended(Path(found[2])):
                    print(
                        f"sb3-sample: {found[1]} is older than the last checkpoint beside it; for that one give "
                        f"--run-dir {found[2]}",
                        file=sys.stderr,
                    )
            else:
                found = model_path(options.run_dir, algo, env_name, *which)
                beside = Path(found[1]).parent
                self._checkpoint = beside if is_ours and beside in all_checkpoints(options.run_dir) else None
            self._is_safe = is_ours and not options.allow_pickle
            if self._is_safe:
                check_settings(Path(found[2]) / env_name, options.trusted_modules, self._env_kwargs)
                self._stack.enter_context(reading_settings(options.trusted_modules, self._env_kwargs))
        except (ValueError, AssertionError) as error:
            if options.run_dir is None and not is_ours and "rl-trained-agents" in folder:
                raise
            raise Refused(str(error)) from error
        if is_ours:
            self._stack.enter_context(reading(options.allow_pickle, options.trusted_modules))
            self._stack.enter_context(models_checked(self._check))
        return found

    def read_settings(self, *args: Any, **kwargs: Any) -> tuple[dict[str, Any], str | None]:
        """
        As ``get_saved_hyperparams``, and keep ``env_kwargs``: ``record_video`` ignores them, and ``enjoy`` forgets them
        for those in ``args.yml``.
        """
        settings, path = get_saved_hyperparams(*args, **kwargs)
        self._env_kwargs_of_config = settings.get("env_kwargs") or {}
        return settings, path

    def make_env(self, env_id: str, *args: Any, **kwargs: Any) -> VecEnv:
        """
        As ``create_test_env``, but with all ``env_kwargs`` of the run's settings, and a checkpoint has its own
        statistics of ``VecNormalize``.

        :raises Refused: if the run's settings make no environment that works
        """
        make = make_answering_env if self._is_safe else create_test_env
        settings = kwargs.get("hyperparams") or {}
        kwargs["env_kwargs"] = {**self._env_kwargs_of_config, **(kwargs.get("env_kwargs") or {})}
        if self._checkpoint is None or not settings.get("normalize"):
            self._env = make(env_id, *args, **kwargs)
            return self._env
        # Without its folder the zoo adds neither statistics nor a stack of frames.
        env = make(env_id, *args, **{**kwargs, "stats_path": None})
        self._env = _normalized(env, self._checkpoint / STATE, settings.get("normalize_kwargs", {}))
        if settings.get("frame_stack"):
            self._env = VecFrameStack(self._env, settings["frame_stack"])
        return self._env

    def _check(self, model: Any) -> None:
        for name in ("observation_space", "action_space") if self._env is not None else ():
            its, saved = getattr(self._env, name), getattr(model, name)
            if _shapes(_channels_first(its)) != _shapes(saved):
                raise Refused(f"the model is of {saved!r:.200}, the run's environment of {its!r:.200}")
        is_normalized = self._env is not None and unwrap_vec_normalize(self._env) is not None
        if lacks_vec_normalize(model) and not is_normalized:
            raise Refused(
                "the model has learned in a VecNormalize, which the run's settings do not have: its config.yml must "
                "say normalize: true, and vecnormalize.pkl, with the statistics, must lie beside it"
            )


def _normalized(env: VecEnv, path: Path, arguments: Mapping[str, Any]) -> VecNormalize:
    """
    :param env: environment of a run
    :param path: state of a checkpoint of the run
    :param arguments: the run's arguments of ``VecNormalize``
    :return: the environment in the checkpoint's ``VecNormalize``, which learns nothing and leaves rewards as they are
    :raises Refused: if the checkpoint has none that fits
    :raises BadFile: if the state is damaged or hostile
    """
    try:
        with importing_nothing():
            state: Any = decode(*container.read(path, KIND), str(path))
        wrappers = {wrapper["class"]: wrapper["attributes"] for wrapper in state["env"]["wrappers"]}
        described = wrappers[f"{VecNormalize.__module__}.{VecNormalize.__qualname__}"]
        shown = {"training": False, "norm_reward": False}
        wanted = VecNormalize(env, **{**arguments, "norm_obs": described["norm_obs"]["value"], **shown})
        before = [shapes_of(getattr(wanted, name, None), name) for name in ("obs_rms", "ret_rms")]
        names = ({*ARGUMENTS, "obs_rms", "ret_rms"} & described.keys()) - shown.keys()
        Restorer([env]).attributes(wanted, {name: described[name] for name in names})
        check_normalization(vars(wanted), str(path))
        found = [shapes_of(getattr(wanted, name, None), name) for name in ("obs_rms", "ret_rms")]
    except BadFile:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, AssertionError, OSError) as error:
        raise Refused(f"{path} has no VecNormalize of this run: {type(error).__name__}: {error}") from error
    if found != before:
        raise Refused(f"{path}: the statistics of VecNormalize are of the shapes {found}, not {before}")
    return wanted


def _channels_first(space: gym.Space) -> gym.Space:
    """A space as a model learns from it: images have their channels first."""
    if isinstance(space, gym.spaces.Dict):
        return gym.spaces.Dict({name: _channels_first(part) for name, part in space.items()})
    if isinstance(space, gym.spaces.Box) and is_image_space(space) and not is_image_space_channels_first(space):
        return VecTransposeImage.transpose_space(space)
    return space


def _shapes(space: gym.Space) -> Any:
    """The properties of a space in which a model and its environment must agree."""
    if isinstance(space, gym.spaces.Dict):
        return {name: _shapes(part) for name, part in space.items()}
    return type(space), space.shape


def model_path(
    run_dir: Path,
    algo: str,
    env_name: Any,
    load_best: bool = False,
    load_checkpoint: Any = None,
    load_last_checkpoint: bool = False,
) -> tuple[str, str, str]:
    """
    As the zoo's ``get_model_path``, for a run whose folder is given.

    :param run_dir: the folder
    :param algo: name of the algorithm
    :param env_name: name of the environment
    :param load_best: whether to load the best model
    :param load_checkpoint: steps of the model to load: the zoo's copy (``--save-freq``), or else the run's checkpoint
    :param load_last_checkpoint: whether to load the last checkpoint
    :return: name for a video, the model's file, the run's folder
    :raises Refusal: (a ``SystemExit``) if there is no model yet
    :raises RunError: if there is no such model
    """
    made = {int(folder.name.removeprefix("checkpoint-")): folder for folder in all_checkpoints(run_dir)}

    def of_checkpoint(steps: int) -> tuple[str, str, str]:
        return f"checkpoint-{steps}-{algo}-{env_name}", str(made[steps] / MODEL), str(run_dir)

    if not load_best and load_checkpoint is not None:
        steps = int(load_checkpoint)
        if steps in made and not (run_dir / f"rl_model_{load_checkpoint}_steps.zip").exists():
            return of_checkpoint(steps)
    elif load_last_checkpoint and made and not load_best:
        return of_checkpoint(max(made))
    elif not (load_best or load_last_checkpoint):
        has_final = (run_dir / f"{env_name}.zip").exists()
        if not (has_final or made):
            refuse("", f"{run_dir} has neither a model of a finished run nor a checkpoint")
        if made and not (has_final and has_ended(run_dir)):
            why = "has a final model older than its checkpoints" if has_final else "is not finished"
            print(f"The run in {run_dir} {why}: the last one, {made[max(made)].name}, is taken")
            return of_checkpoint(max(made))
    try:
        # The zoo adds the algorithm's name to the folder.
        prefix, path, _ = get_model_path(
            -1, str(run_dir), "", env_name, load_best, load_checkpoint, load_last_checkpoint
        )
    except ValueError as error:
        names = ", ".join(folder.name for folder in made.values()) or "none"
        raise RunError(f"{run_dir} has no such model of {algo} on {env_name}. Its checkpoints: {names}") from error
    return prefix.replace(f"-{env_name}", f"{algo}-{env_name}"), path, str(run_dir)
