"""``sb3-sample study``: run plans of many runs, show their status and cost, and make tables of them."""

import argparse
import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from sb3_sample.arguments import check_device
from sb3_sample.exits import refuse
from sb3_sample.study import analysis_command
from sb3_sample.study.cluster import check
from sb3_sample.study.cores import free_cores
from sb3_sample.study.dry_run import MeasurementFailed, estimate
from sb3_sample.study.plan import PlanError
from sb3_sample.study.plan_file import read_plan
from sb3_sample.study.reporting import command as report_command
from sb3_sample.study.runs import StudyError
from sb3_sample.study.schedule import Stopped, run
from sb3_sample.study.states import RUNNING, STATES, Status, status

#: Seconds between two lines of counts without a terminal.
LINE_EVERY = 60.0
#: Number of runs in progress that the live table names.
SHOWN = 20

#: A command: its help, the function that adds its arguments, and the function that runs it.
Command = tuple[str, Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], None]]


def main(argv: Sequence[str]) -> None:
    """
    :param argv: command line after ``study``
    """
    parser = argparse.ArgumentParser("sb3-sample study", description="Many runs as one plan. See docs/studies.md.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (words, add, _) in COMMANDS.items():
        add(commands.add_parser(name, help=words, description=f"{words[0].upper()}{words[1:]}."))
    options = parser.parse_args(argv)
    try:
        COMMANDS[options.command][2](options)
    except (PlanError, StudyError) as error:
        refuse(f"study {options.command}", error)
    except OSError as error:
        if error.errno is None:
            raise
        refuse(f"study {options.command}", error)


# ---------------------------------------------------------------- run


def _count(low: int) -> Callable[[str], int]:
    def count(text: str) -> int:
        if not text.isdigit() or int(text) < low:
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {low}, not {text!r}")
        return int(text)

    return count


def _add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plan", type=Path, metavar="PLAN", help="file of the plan, as in studies/")
    parser.add_argument(
        "--folder", type=Path, metavar="DIR", help="folder of the study (default: runs/<name of the plan>)"
    )
    parser.add_argument(
        "--workers", type=_count(1), metavar="N", help="runs at once (default: as there are free cores)"
    )
    parser.add_argument("--threads", type=_count(1), default=1, metavar="N", help="threads of each run (default: 1)")
    parser.add_argument(
        "--retries",
        type=_count(0),
        default=1,
        metavar="N",
        help="how often a run that fails is tried again (default: 1)",
    )
    parser.add_argument(
        "--batch-seeds",
        action="store_true",
        help="make runs that differ in their seed alone together, in one process (docs/many_learners.md)",
    )
    parser.add_argument("--device", default="auto", help="as of train (default: auto)")
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="a Ray cluster makes the runs: 'local' for one on this machine, 'auto' for the one that this machine is "
        "in, or its address",
    )
    parser.add_argument(
        "--gpus", type=float, metavar="N", help="GPUs of each run, or its share of one, with --ray (default: none)"
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="say how many runs, hours and bytes it takes, and run nothing of it"
    )


def _run(options: argparse.Namespace) -> None:
    try:
        if options.ray is not None:
            check(options.ray, options.gpus)
        elif options.gpus is not None:
            raise ValueError(f"--gpus is for runs in a Ray cluster: give --ray too, not --gpus {options.gpus:g} alone")
        if options.ray is None:
            check_device(options.device)
        if options.ray is not None and options.dry_run:
            raise ValueError("--dry-run measures this machine: leave --ray out")
        if options.batch_seeds and options.dry_run:
            raise ValueError("--dry-run measures runs that are made one by one: leave --batch-seeds out")
    except (ValueError, ImportError) as error:
        refuse("study run", error)
    plan = read_plan(options.plan)
    shared: dict[str, Any] = {"workers": options.workers, "threads": options.threads, "device": options.device}
    if options.dry_run:
        try:
            print(estimate(plan, options.folder, say=lambda words: print(words, file=sys.stderr), **shared))
        except MeasurementFailed as error:
            print(error.output, file=sys.stderr)
            refuse("study run", error)
        return
    folder = Path("runs") / plan.name if options.folder is None else options.folder
    if options.workers is None and options.ray is None:
        shared["workers"] = max(free_cores() // options.threads, 1)
    at_once = f", {shared['workers']} at once" if shared["workers"] else ""
    print(f"{len(plan.runs)} runs in {folder}{at_once}", flush=True)
    try:
        with _showing() as show:
            found = run(
                plan, folder, retries=options.retries, ray=options.ray, gpus=options.gpus, show=show,
                batch_seeds=options.batch_seeds, **shared,
            )  # fmt: skip
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(f"interrupted; the same command goes on with {folder}") from error
    except Stopped as error:
        print(f"sb3-sample study run: {error}; the same command goes on with {folder}", file=sys.stderr)
        raise SystemExit(128 + error.number) from error
    print(found)
    if found.failures:
        raise SystemExit(1)


@contextlib.contextmanager
def _showing() -> Iterator[Callable[[Status], None]]:
    """A live table in a terminal if rich is installed; lines otherwise."""
    try:
        from rich.console import Console
        from rich.live import Live
    except ModuleNotFoundError:
        yield _Lines()
        return
    console = Console()
    if not console.is_terminal:
        yield _Lines()
        return
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def show(found: Status) -> None:
            for line in ended(found):
                console.print(line, markup=False, highlight=False)
            live.update(table(found), refresh=True)

        yield show


class _Lines:
    """Prints a line for each run that has ended, and counts once a minute."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def __call__(self, found: Status) -> None:
        for line in ended(found):
            print(line, flush=True)
        if time.monotonic() - self._last >= LINE_EVERY:
            self._last = time.monotonic()
            print(found.line(), flush=True)


def ended(found: Status) -> list[str]:
    """
    :param found: a status
    :return: a line for each run that has ended since the last status
    """
    lines = []
    for each in found.ended:
        last = "" if each.outcome.last_return is None else f", last return {each.outcome.last_return:.1f}"
        lines.append(f"{each.state}: {each.run.title}{last}")
    return lines


def table(found: Status) -> Any:
    """
    :param found: a status
    :return: the live table for rich
    """
    from rich.table import Table

    drawn = Table(title=str(found.folder.path), caption=found.line(), title_justify="left", caption_justify="left")
    for column in ("agent", "task", "seed", "steps", "of", "last return"):
        drawn.add_column(column, justify="left" if column in ("agent", "task") else "right")
    for each, progress in found.progress()[:SHOWN]:
        last = "" if progress.last_return is None else f"{progress.last_return:.1f}"
        drawn.add_row(each.variant, each.task, str(each.seed), f"{progress.steps:,}", f"{each.steps:,}", last)
    more = found.counts[RUNNING] - SHOWN
    if more > 0:
        drawn.add_row(f"and {more} more", "", "", "", "", "")
    return drawn


# ---------------------------------------------------------------- status


def _add_status(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the study")


def _status(options: argparse.Namespace) -> None:
    found = status(options.folder)
    width = max((len(each.run.variant) for each in found.runs), default=0)
    print(f"{'agent':<{width}}  " + "  ".join(f"{state:>7}" for state in STATES))
    for variant in dict.fromkeys(each.run.variant for each in found.runs):
        counts = [sum(each.state == state and each.run.variant == variant for each in found.runs) for state in STATES]
        print(f"{variant:<{width}}  " + "  ".join(f"{count:>7}" for count in counts))
    print(found)


COMMANDS: dict[str, Command] = {
    "run": ("make the runs of a plan, or go on with them", _add_run, _run),
    "status": ("say what is done, running, failed and waiting of a study", _add_status, _status),
    **analysis_command.COMMANDS,
    "report": report_command.COMMAND,
}
