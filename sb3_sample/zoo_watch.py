"""What ``sb3-sample enjoy`` and ``record_video`` do besides the zoo's: ``--run-dir``, and files that run no code."""

import argparse
import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from rl_zoo3.utils import get_model_path

from sb3_sample.saving.checkpoint import MODEL
from sb3_sample.zoo import ALGORITHMS
from sb3_sample.zoo_files import add_trust, check_settings, reading, replaced
from sb3_sample.zoo_runs import Record, RunError, checkpoints


def watch_parser(command: str) -> argparse.ArgumentParser:
    """
    :param command: ``enjoy`` or ``record_video``
    :return: parser of what it takes besides the zoo's options
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
    What ``enjoy`` and ``record_video`` need while they run.

    :param options: what ``watch_parser`` has parsed
    :param arguments: the rest of the command line
    :param modules: those that look for a run with ``get_model_path``
    :return: command line for the zoo
    :raises RunError: if ``--run-dir`` is no run's
    """
    command = list(arguments)
    if options.run_dir is not None:
        record = Record.read(options.run_dir)
        if not {"--env"} & set(command) and record.env not in gym.registry:
            raise RunError(f"{record.env}, the environment of {options.run_dir}, is not registered: give --env")
        # What the command line says besides replaces these.
        command = ["--algo", record.algo, "--env", record.env, *command]
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default="")
    is_ours = parser.parse_known_args(command)[0].algo in ALGORITHMS

    def find(exp_id: int, folder: str, algo: str, env_name: Any, *which: Any) -> tuple[str, str, str]:
        if options.run_dir is None:
            found = get_model_path(exp_id, folder, algo, env_name, *which)
        else:
            found = model_path(options.run_dir, algo, env_name, *which)
        if is_ours and not options.allow_pickle:
            check_settings(Path(found[2]) / env_name, options.trusted_modules)
        return found

    with contextlib.ExitStack() as stack:
        if is_ours:
            stack.enter_context(reading(options.allow_pickle, options.trusted_modules))
        for module in modules:
            stack.enter_context(replaced(module, "get_model_path", find))
        yield command


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
    :param load_best: whether the best model is asked for
    :param load_checkpoint: steps of the zoo's checkpoint that is asked for
    :param load_last_checkpoint: whether the last checkpoint is asked for
    :return: name for a video, the model's file, the run's folder
    """
    made = checkpoints(run_dir)
    if load_last_checkpoint and made and not (load_best or load_checkpoint is not None):
        steps = int(made[-1].name.removeprefix("checkpoint-"))
        return f"checkpoint-{steps}-{algo}-{env_name}", str(made[-1] / MODEL), str(run_dir)
    if not (load_best or load_last_checkpoint or load_checkpoint is not None or (run_dir / f"{env_name}.zip").exists()):
        if not made:
            # Not an error that the zoo answers by looking for a model on a hub.
            raise SystemExit(f"sb3-sample: {run_dir} has neither a model of a finished run nor a checkpoint")
        print(f"The run in {run_dir} is not finished: its last checkpoint, {made[-1].name}, is taken")
        return model_path(run_dir, algo, env_name, load_last_checkpoint=True)
    # The zoo adds the algorithm's name to the folder.
    prefix, path, _ = get_model_path(-1, str(run_dir), "", env_name, load_best, load_checkpoint, load_last_checkpoint)
    return prefix.replace(f"-{env_name}", f"{algo}-{env_name}"), path, str(run_dir)
