"""
Command ``sb3-sample train``: its options besides the zoo's, where a run starts or resumes (``--run-dir``,
``--checkpoint-freq``, ``--resume``), and runs of several seeds in one process (``--seeds``).
"""

import argparse
import contextlib
import functools
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import rl_zoo3.train

from sb3_sample.lockstep import Seat, present
from sb3_sample.run_logs import EVALUATIONS, OFFLINE
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.many import train_together
from sb3_sample.saving.temporary import is_temporary
from sb3_sample.zoo.algorithms import ALGORITHMS
from sb3_sample.zoo.files import RunError, add_trust
from sb3_sample.zoo.patches import managed_by
from sb3_sample.zoo.records import RECORD, Record, all_checkpoints, check_entries, check_monitor_files
from sb3_sample.zoo.runs import Data, Manager, RunManager, Start

#: Environment steps between two checkpoints.
CHECKPOINT_FREQ = 10_000


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
        if trained := sorted(path.name for path in (*folder.glob("*.zip"), *folder.glob(EVALUATIONS))):
            raise RunError(
                f"--run-dir {folder} has {trained[0]}, but no checkpoint to go on from, and a new run would write over "
                "it: name another folder, or remove this one"
            )
        return Start(list(arguments), freq or CHECKPOINT_FREQ, folder)
    record = Record.read(folder)
    check_monitor_files(folder)
    # Further arguments of the command line replace these.
    # An earlier version took 0 for -1, as many steps as the hyperparameters say.
    command = ["--seed", str(record.seed), "-n", str(record.n_timesteps or -1), *arguments]
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
    managers: dict[Seat | None, Manager] = {}

    def manager(*positional: Any, **named: Any) -> Manager:
        seat = present()
        start, data = starts[seat]
        managers[seat] = made = (
            Manager(data, *positional, **named) if start is None else RunManager(start, data, *positional, **named)
        )
        return made

    def train(start: Start | None, arguments: Sequence[str], data: Data) -> None:
        seat = present()
        starts[seat] = start, data
        # The zoo reads it at once.
        sys.argv = ["sb3-sample train", *arguments]
        try:
            rl_zoo3.train.train()
        finally:
            if seat in managers:
                managers.pop(seat).close()

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
            unsaved = [
                seat.name
                for seed, seat in zip(seeds, seats, strict=True)
                if seed in failed or not (seat.began and seat.has_ended)
            ]
            on = "all were saved" if not unsaved else f"not saved: {', '.join(unsaved)}"
            if options.run_dir:
                on = f"the same command with --run-dir {options.run_dir} goes on"
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
