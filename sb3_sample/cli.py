"""
The command ``sb3-sample``: the zoo's commands, extended by the algorithms of this package, and ``plot``, ``study``,
``dataset``, ``scaling``, ``advise`` and ``variance``.
"""

import argparse
import contextlib
import importlib
import os
import runpy
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import NamedTuple

from sb3_sample.envs.base import select_gl_backend
from sb3_sample.exits import import_packages, interrupt, refuse
from sb3_sample.extras import install, needing
from sb3_sample.version import __version__


class Command(NamedTuple):
    """
    :param run: what to do with the arguments after the command's name
    :param help: one line
    """

    run: Callable[[list[str]], None]
    help: str


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: command line without the program's name; this process's own if None
    """
    try:
        _run(argv)
        sys.stdout.flush()
    except BrokenPipeError:
        try:
            sys.stdout.flush()
        except BrokenPipeError:
            # The reader of the output, such as `head`, is gone. Python would try to write again at the end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise SystemExit(128 + signal.SIGPIPE) from None
        raise  # another pipe, such as a worker's


def _run(argv: Sequence[str] | None) -> None:
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = arguments[0] if arguments else "--help"
    if name in ("-h", "--help"):
        print(_usage())
    elif name == "--version":
        print(__version__)
    elif name in COMMANDS:
        try:
            COMMANDS[name].run(arguments[1:])
        except KeyboardInterrupt as error:
            interrupt(name, str(error) or "interrupted")
    else:
        refuse("", f"command must be one of {', '.join(COMMANDS)}, not {name!r}")


def _usage() -> str:
    commands = "\n".join(f"  {name:<15} {command.help}" for name, command in COMMANDS.items())
    return (
        "usage: sb3-sample COMMAND [OPTION ...]\n\n"
        f"commands:\n{commands}\n\n"
        "sb3-sample COMMAND --help shows a command's options; those of the zoo's commands are the zoo's own."
    )


@contextlib.contextmanager
def _extras() -> Iterator[None]:
    """Report an extra that is not installed without a traceback."""
    try:
        yield
    except ImportError as error:
        if isinstance(error.__cause__, ModuleNotFoundError):
            sys.exit(f"sb3-sample: {error}")
        raise


def _zoo_module(name: str) -> ModuleType:
    """Import a module of the zoo, with our algorithms and environments registered in the zoo."""
    with _extras():
        from sb3_sample import zoo
    zoo.register()
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        # The zoo itself is complete; its plots need an extra.
        sys.exit(f"sb3-sample: {error}. Install it with: {install('zoo', 'plots')}")


def _set_command_line(command: str, arguments: list[str]) -> None:
    """Set ``sys.argv``, which the zoo's commands read; its first entry is the name in their help."""
    sys.argv = [f"sb3-sample {command}", *arguments]


def _train(arguments: list[str]) -> None:
    _zoo_module("rl_zoo3.train")
    from sb3_sample.zoo import train
    from sb3_sample.zoo.patches import reading
    from sb3_sample.zoo.runs import Data

    options, rest = _own_options(train.train_parser(), arguments)
    _import_packages("train", rest)
    with _arguments("train"), _errors("train"), reading(options.allow_pickle, options.trusted_modules):
        if options.seeds is not None:
            train.train_seeds(options, rest)
        else:
            data = Data.of(options)
            train.train(train.plan(options, rest), rest, data)


def _enjoy(arguments: list[str]) -> None:
    module = _zoo_module("rl_zoo3.enjoy")
    from sb3_sample.zoo import watch

    options, rest = _own_options(watch.watch_parser("enjoy"), arguments)
    _import_packages("enjoy", rest)
    with _errors("enjoy"), watch.watching(options, rest, module) as command:
        _set_command_line("enjoy", command)
        module.enjoy()


def _own_options(parser: argparse.ArgumentParser, arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """Separate our options from the zoo's, whose help comes after ours."""
    if {"-h", "--help"} & set(arguments):
        print(parser.format_help())
    return parser.parse_known_args(arguments)


def _import_packages(command: str, arguments: list[str]) -> None:
    """Import what the zoo's command is about to import, which would end in a traceback."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    import_packages(command, parser.parse_known_args(arguments)[0].gym_packages)


@contextlib.contextmanager
def _errors(command: str) -> Iterator[None]:
    """Report a refused run or file without a traceback."""
    from sb3_sample.errors import ParametersDoNotFit
    from sb3_sample.saving.container import BadFile, PickledFile
    from sb3_sample.saving.encoding import NotPortable
    from sb3_sample.zoo.files import Refused, RunError

    try:
        yield
    except PickledFile as error:
        refuse(command, f"{error}. Here it is the option --allow-pickle")
    except (BadFile, NotPortable, ParametersDoNotFit, Refused, RunError) as error:
        refuse(command, error)


@contextlib.contextmanager
def _arguments(command: str) -> Iterator[None]:
    """
    Print errors of arguments, of this package or the zoo, without a traceback. Any other error, such as an
    environment's, keeps its traceback, and so does a training that diverges.
    """
    from sb3_sample.faults import TrainingDiverged

    try:
        yield
    except TrainingDiverged:
        raise
    except ValueError as error:
        *_, (frame, _) = traceback.walk_tb(error.__traceback__)
        if frame.f_globals.get("__name__", "").split(".")[0] not in ("sb3_sample", "rl_zoo3"):
            raise
        refuse(command, error)


@contextlib.contextmanager
def _drawing(command: str) -> Iterator[None]:
    """
    Refuse what the zoo cannot draw: it takes any logged numbers, and fails in many ways with those of several runs.
    """
    try:
        yield
    except (ValueError, TypeError, LookupError, ArithmeticError, OSError) as error:
        refuse(command, f"these runs cannot be drawn: {type(error).__name__}: {error}")


def _zoo_plot(function: str) -> Callable[[list[str]], None]:
    def draw(arguments: list[str]) -> None:
        _set_command_line(function, arguments)
        getattr(_zoo_module("rl_zoo3.plots"), function)()

    def run(arguments: list[str]) -> None:
        # These commands look for the id in the names of the log folders, in which a dash stands for the slash.
        import gymnasium as gym

        from sb3_sample.envs.registration import is_atari_id  # registers the ids but Atari's

        names = [
            argument.replace("/", "-") if argument in gym.registry or is_atari_id(argument) else argument
            for argument in arguments
        ]
        module = _zoo_module(f"rl_zoo3.plots.{function}")
        from sb3_sample.zoo.files import PlottedRuns
        from sb3_sample.zoo.patches import reading_monitors, reading_tables

        if function == "plot_train":
            with _drawing(function), _errors(function), reading_monitors(module):
                draw(names)
            return
        parser = argparse.ArgumentParser(f"sb3-sample {function}", usage=argparse.SUPPRESS, add_help=False)
        parser.add_argument(
            "--allow-pickle", action="store_true", help="Read a pickled file too, which can run any code"
        )
        options, names = _own_options(parser, names)
        runs = PlottedRuns(options.allow_pickle)
        said: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
        if function == "plot_from_file":
            from sb3_sample.zoo import scores

            rliable, *tasks = scores.rliable_options(names)
            if rliable:
                runs, said = scores.NormalizedRuns(options.allow_pickle, *tasks), scores.saying_so()
        with _drawing(function), _errors(function), said, reading_tables(module, runs):
            draw(names)

    return run


def _record_video(arguments: list[str]) -> None:
    # The zoo's other commands have the option --gym-packages, this one does not.
    select_gl_backend()
    utils = _zoo_module("rl_zoo3.utils")
    from sb3_sample.zoo import watch

    parser = watch.watch_parser("record_video")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="Packages to import, as for enjoy")
    options, rest = _own_options(parser, arguments)
    import_packages("record_video", options.gym_packages)
    with _errors("record_video"), watch.watching(options, rest, utils) as command:
        _set_command_line("record_video", command)
        runpy.run_module("rl_zoo3.record_video", run_name="__main__")  # it has no function to call


def _plot(arguments: list[str]) -> None:
    with _extras(), needing("plots need pandas", "plots"):
        from sb3_sample.plots import main as plot

    plot(arguments)


def _variance(arguments: list[str]) -> None:
    from sb3_sample.variance.command import main as variance

    variance(arguments)


def _dataset(arguments: list[str]) -> None:
    from sb3_sample.dataset_command import main as dataset

    dataset(arguments)


def _study(arguments: list[str]) -> None:
    with _extras(), needing("studies need pandas", "study"):
        from sb3_sample.study.command import main as study

    with _extras():
        study(arguments)


def _scaling(arguments: list[str]) -> None:
    with _extras(), needing("scaling laws need pandas", "study"):
        from sb3_sample.study.scaling.command import main as scaling

    with _extras():
        scaling(arguments)


def _advise(arguments: list[str]) -> None:
    with _extras(), needing("advice needs pandas", "study"):
        from sb3_sample.study.advice_command import main as advise

    with _extras():
        advise(arguments)


COMMANDS: dict[str, Command] = {
    "train": Command(_train, "train an agent, or search for hyperparameters"),
    "enjoy": Command(_enjoy, "run a trained agent"),
    "record_video": Command(_record_video, "write a video of a trained agent"),
    "plot": Command(_plot, "draw the runs of a task, mean and range over seeds, beside the published curves"),
    "study": Command(_study, "make the runs of a plan: agents, tasks, seeds and a grid of arguments"),
    "scaling": Command(_scaling, "fit scaling laws: batch size, learning rate and replay ratio for a budget"),
    "advise": Command(_advise, "which size of BRO and replay ratio gets furthest in some hours of this machine"),
    "dataset": Command(_dataset, "record, show and convert data sets for offline learning"),
    "variance": Command(_variance, "measure a policy gradient's variance: more actions or a longer trajectory?"),
    "plot_train": Command(_zoo_plot("plot_train"), "draw the return of the training episodes"),
    "all_plots": Command(_zoo_plot("all_plots"), "draw and tabulate the evaluations of several runs"),
    "plot_from_file": Command(_zoo_plot("plot_from_file"), "draw what all_plots has saved"),
}

if __name__ == "__main__":
    main()
