"""``sb3-sample study table``, ``aggregate``, ``marginalize``, ``correlate``, ``heatmap`` and ``cost``."""

import argparse
import contextlib
import math
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from sb3_sample.envs.scores import Score
from sb3_sample.exits import refuse
from sb3_sample.extras import needing_matplotlib
from sb3_sample.plots import STYLES
from sb3_sample.study import analysis
from sb3_sample.study import table as tables
from sb3_sample.study.aggregate import (
    DEFAULT_GROUPS,
    GROUPS,
    REPS,
    aggregate,
    performance_profiles,
    probability_of_improvement,
    warn_of_unknown,
)
from sb3_sample.study.comparison import chosen_groups, comparison

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Endings of the files that commands write.
_TABLES, _PICTURES = (".csv", ".parquet", ".md"), (".png", ".svg")


# ---------------------------------------------------------------- arguments


def steps_of(text: str) -> int:
    """
    :param text: a number of steps, as 100000, 100_000, 100k, 1.5M
    :return: the number
    :raises ArgumentTypeError: it is not a number of steps
    """
    digits = text.replace("_", "")
    factor = {"k": 1_000, "M": 1_000_000}.get(digits[-1:], 1)
    try:
        # A decimal, since the float 4.1 times a million is not a whole number.
        number = Decimal(digits if factor == 1 else digits[:-1]) * factor
    except ArithmeticError:  # not a number, or too large for Decimal
        number = Decimal(-1)
    if not (number.is_finite() and 0 <= number <= 2**53) or number != int(number):
        raise argparse.ArgumentTypeError(f"{text!r} is no number of steps, as 100000, 100k or 1M")
    return int(number)


def _score(text: str) -> tuple[str, Score]:
    task, equals, value = text.rpartition("=")
    metric = "return"
    if value.startswith("success:") or value == "success":
        metric, value = "success_rate", value.removeprefix("success").removeprefix(":") or "1"
    low, colon, high = value.rpartition(":")
    try:
        score = Score(metric, float(high), float(low) if colon else 0.0)
    except ValueError:
        equals = ""
    if not task or not equals:
        raise argparse.ArgumentTypeError(f"{text!r} is no TASK=HIGH, TASK=LOW:HIGH or TASK=success")
    return task, score


def _factor(text: str) -> tuple[str, list[str]]:
    name, equals, arguments = text.partition("=")
    names = arguments.split(",") if equals else [name]
    if not name or not all(names):
        raise argparse.ArgumentTypeError(f"{text!r} is no ARGUMENT or NAME=ARGUMENT,...")
    return name, names


def add_runs(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: parser to which the option for a command's runs is added
    """
    parser.add_argument(
        "sources",
        nargs="*",
        metavar="[LABEL=]FOLDER",
        help="folder of a study or with runs at any depth, or a table (.csv, .parquet) that the table command has "
        "written. A label names the agent",
    )


def add_sources(parser: argparse.ArgumentParser, pictures: bool = False, output: str = "") -> None:
    """
    :param parser: parser to which the options for a command's runs and output are added
    :param pictures: whether the command draws
    :param output: help of the output, if it is not a table or a picture
    """
    add_runs(parser)
    parser.add_argument(
        "-p",
        "--published",
        nargs="+",
        default=[],
        metavar="NAME",
        help="published runs besides, every seed of them: BRO, 'BRO Fast'",
    )
    endings = _TABLES + (_PICTURES if pictures else ())
    parser.add_argument("-o", "--output", type=Path, help=output or f"file to write ({', '.join(endings)})")
    parser.set_defaults(endings=endings)


def add_scores(parser: argparse.ArgumentParser, groups: bool = True, planned: bool = True) -> None:
    """
    :param parser: parser of a command that computes scores
    :param groups: whether the command takes groups of tasks
    :param planned: whether the groups can be those of a study's plan
    """
    parser.add_argument(
        "--score",
        nargs="+",
        default=[],
        type=_score,
        metavar="TASK=HIGH",
        help="return whose score is 1, LOW:HIGH for those of 0 and 1, or 'success', for tasks without a common scale",
    )
    if groups:
        parser.add_argument(
            "--groups",
            nargs="+",
            metavar="GROUP",
            help=f"groups of tasks, of {'the study plan and ' if planned else ''}{', '.join(GROUPS)} (default: "
            f"{'those of the plan, or ' if planned else ''}{', '.join(DEFAULT_GROUPS)})",
        )


def add_intervals(parser: argparse.ArgumentParser, reps: int = REPS) -> None:
    """
    :param parser: parser of a command that computes intervals
    :param reps: bootstrap samples by default
    """
    parser.add_argument("--reps", type=int, default=reps, help=f"bootstrap samples (default: {reps:,})")
    parser.add_argument("--confidence", type=float, default=0.95, help="of the intervals (default: 0.95)")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap (default: 0)")


def _add_steps(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--steps",
        nargs="+",
        type=steps_of,
        metavar="STEP",
        help="simulator steps, as 100k or 1M (default: all that the runs have in common)",
    )
    parser.add_argument("--common", action="store_true", help="only the tasks that all agents have")


def _add_ends(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--last",
        type=int,
        default=analysis.LAST,
        help=f"evaluations at the end of a run that are averaged (default: {analysis.LAST})",
    )
    parser.add_argument("--by", nargs="+", default=[], metavar="ARGUMENT", help="arguments by which runs are parted")


def _read(options: argparse.Namespace, *more: str) -> pd.DataFrame:
    if options.output is not None and options.output.suffix not in options.endings:
        raise ValueError(f"output must end in {', '.join(options.endings)}, not {str(options.output)!r}")
    curves = getattr(options, "curves", [])
    if not options.sources and not options.published and not curves:
        raise ValueError("sources must be at least one folder or table, or --published runs")
    parts = []
    if options.sources:
        parts.append(tables.read(options.sources, (*tables.METRICS, *more)))
    if options.published:
        theirs = tables.published_runs(options.published)
        if parts:  # tables may have the same names
            theirs = theirs.assign(agent=tables.marked_published(theirs["agent"]))
        parts.append(theirs)
    if curves:
        parts.append(tables.published_curves(curves))
    return pd.concat(parts, ignore_index=True)


def _groups(options: argparse.Namespace, table: pd.DataFrame) -> Any:
    return chosen_groups(comparison(options.sources).groups, options.groups, table)


def _shared(options: argparse.Namespace, table: pd.DataFrame, *names: str) -> dict[str, Any]:
    warn_of_unknown(table, dict(options.score))
    return {"scores": dict(options.score), **{name: getattr(options, name) for name in names}}


_INTERVALS = ("reps", "confidence", "seed")


# ---------------------------------------------------------------- output


@contextlib.contextmanager
def refusing(command: str) -> Iterator[None]:
    """
    End the command with one line on errors of arguments, files and missing extras; show each warning as one line.

    :param command: its name, after ``sb3-sample``
    """

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        print(f"sb3-sample {command}: {message}", file=sys.stderr)

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show
            yield
    except (ValueError, ImportError, OSError) as error:
        refuse(command, error)


def markdown(table: pd.DataFrame) -> str:
    """
    :param table: any table
    :return: the table as Markdown, numbers with three decimals, steps with separators, gaps as "-"
    """
    rows = [[_cell(name, value) for name, value in row.items()] for row in table.to_dict("records")]
    numeric = [pd.api.types.is_numeric_dtype(table[name]) for name in table]
    lines = [[str(name) for name in table], ["---:" if right else "---" for right in numeric], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(name: Any, value: Any) -> str:
    if isinstance(value, float):
        if math.isnan(value):
            return "-"
        return f"{value:.3f}" if abs(value) < 1_000 and (abs(value) >= 5e-4 or value == 0) else f"{value:.3g}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return str(value).replace("|", "\\|")


def _put(table: pd.DataFrame, output: Path | None, draw: Callable[[], "Figure"] | None = None) -> None:
    print(markdown(table))
    if output is None:
        return
    output.parent.mkdir(parents=True, exist_ok=True)
    if output.suffix == ".md":
        output.write_text(markdown(table) + "\n")
    elif output.suffix in _PICTURES:
        assert draw is not None
        draw().savefig(output)
    else:
        tables.write(table, output)
    print(f"\nSaved to {output}")


# ---------------------------------------------------------------- commands


def _add_table(parser: argparse.ArgumentParser) -> None:
    add_sources(parser)
    parser.add_argument(
        "--curves",
        nargs="+",
        default=[],
        metavar="NAME",
        help="published curves besides, of which there are statistics over seeds only, e.g. SAC, SimBa, TD-MPC2",
    )
    parser.add_argument(
        "--metrics",
        nargs="+",
        default=[],
        metavar="PATTERN",
        help=f"metrics besides {', '.join(tables.METRICS)}, as 'train/*' of the runs' logs",
    )


def _run_table(options: argparse.Namespace) -> None:
    with refusing("study table"):
        table = _read(options, *options.metrics)
        runs = table.groupby([*tables.RUN, "metric"], sort=False, dropna=False)["step"].agg(["count", "max"])
        summary = (
            runs.groupby(["agent", "task", "metric"], sort=False)
            .agg(runs=("count", "size"), rows=("count", "sum"), last_step=("max", "max"))
            .reset_index()
        )
        print(markdown(summary))
        if options.output is not None:
            if options.output.suffix == ".md":
                options.output.parent.mkdir(parents=True, exist_ok=True)
                options.output.write_text(markdown(summary) + "\n")
            else:
                tables.write(table, options.output)
            print(f"\nSaved to {options.output}")


def _add_aggregate(parser: argparse.ArgumentParser) -> None:
    add_sources(parser)
    _add_steps(parser)
    add_scores(parser)
    add_intervals(parser)
    parser.add_argument(
        "--improvement", action="store_true", help="the probability that one agent is better than another, by pair"
    )
    parser.add_argument(
        "--profile",
        nargs="+",
        type=float,
        metavar="SCORE",
        help="the share of runs whose score is above these, in the place of the averages",
    )


def _run_aggregate(options: argparse.Namespace) -> None:
    with refusing("study aggregate"):
        if (options.improvement or options.profile) and (options.steps is None or len(options.steps) != 1):
            raise ValueError(f"steps must be one step for --improvement and --profile, not {options.steps}")
        if options.improvement and options.profile:
            raise ValueError("--improvement and --profile are two tables: ask for one of them")
        if options.improvement and options.common:
            raise ValueError("--common is not of --improvement, which compares each pair on the tasks that both have")
        table = _read(options)
        groups, shared = _groups(options, table), _shared(options, table, *_INTERVALS)
        if options.improvement:
            found = probability_of_improvement(table, options.steps[0], groups, **shared)
        elif options.profile:
            found = performance_profiles(
                table, options.steps[0], options.profile, groups, common=options.common, **shared
            )
        else:
            found = aggregate(table, options.steps, groups, common=options.common, **shared)
        _put(found, options.output)


def _add_marginalize(parser: argparse.ArgumentParser) -> None:
    add_sources(parser)
    parser.add_argument(
        "--factor",
        nargs="+",
        type=_factor,
        dest="factors",
        metavar="[NAME=]ARGUMENT[,...]",
        help="arguments of which one choice each was made, several that are one choice under a name (default: the "
        "plan's factors, or each argument in which the runs of a task differ)",
    )
    parser.add_argument("--order", type=int, default=1, help="how many factors are fixed (default: 1)")
    _add_ends(parser)
    add_scores(parser)
    add_intervals(parser, analysis.STUDY_REPS)


def _run_marginalize(options: argparse.Namespace) -> None:
    with refusing("study marginalize"):
        table = _read(options)
        factors = comparison(options.sources).factors if options.factors is None else dict(options.factors)
        shared = _shared(options, table, "by", "last", *_INTERVALS)
        found = analysis.marginalize(table, factors or None, options.order, groups=_groups(options, table), **shared)
        _put(found, options.output)


def _add_correlate(parser: argparse.ArgumentParser) -> None:
    add_sources(parser, pictures=True)
    parser.add_argument(
        "--metrics",
        nargs="+",
        default=list(analysis.VARIABLES),
        metavar="METRIC",
        help=f"variables beside the score (default: {', '.join(analysis.VARIABLES)})",
    )
    parser.add_argument("--level", type=float, default=0.05, help="blank above this p (default: 0.05)")
    parser.add_argument(
        "--regress", action="store_true", help="least squares of the score on each metric, task by task, instead"
    )
    _add_ends(parser)
    add_scores(parser)


def _run_correlate(options: argparse.Namespace) -> None:
    with refusing("study correlate"):
        if options.regress and (
            options.by or options.groups or (options.output and options.output.suffix in _PICTURES)
        ):
            raise ValueError("--regress is task by task, a table: it has no --by, no --groups and no picture")
        table = _read(options, *options.metrics)
        shared = _shared(options, table, "last")
        if options.regress:
            _put(analysis.regress(table, options.metrics, **shared), options.output)
            return
        found = analysis.correlate(
            table, options.metrics, by=options.by, groups=_groups(options, table), level=options.level, **shared
        )
        _put(found, options.output, lambda: _draw_correlations(found, options.by))


def _add_heatmap(parser: argparse.ArgumentParser) -> None:
    add_sources(parser, pictures=True)
    parser.add_argument("-x", required=True, metavar="ARGUMENT", help="argument of the columns, as model_size")
    parser.add_argument("-y", required=True, metavar="ARGUMENT", help="argument of the rows, as replay_ratio")
    parser.add_argument(
        "--value", default="score", metavar="METRIC", help="score, or a metric as hours (default: score)"
    )
    parser.add_argument("--step", type=steps_of, help="simulator step (default: the last that all runs reach)")
    parser.add_argument(
        "--group", default="all", help=f"of tasks, of the study's plan and of {', '.join(GROUPS)} (default: all)"
    )
    add_scores(parser, groups=False)


def _run_heatmap(options: argparse.Namespace) -> None:
    with refusing("study heatmap"):
        table = _read(options, *([] if options.value == "score" else [options.value]))
        chosen = chosen_groups(comparison(options.sources).groups, [options.group], table)
        if isinstance(chosen, dict) and not chosen:
            raise ValueError(f"group must have a task of the runs, and {options.group!r} has none")
        group = chosen[options.group] if isinstance(chosen, dict) else options.group
        shared = _shared(options, table, "value", "step")
        found = analysis.heatmap(table, options.x, options.y, group=group, **shared)
        shown = found.reset_index().rename(columns={options.y: f"{options.y} \\ {options.x}"})
        print(f"At {found.attrs['step']:,} simulator steps:\n")
        _put(shown, options.output, lambda: _draw_heatmap(found, options.value))


def _add_cost(parser: argparse.ArgumentParser) -> None:
    add_sources(parser, pictures=True)
    _add_steps(parser)
    add_scores(parser)
    add_intervals(parser)


def _run_cost(options: argparse.Namespace) -> None:
    with refusing("study cost"):
        table = _read(options)
        shared = _shared(options, table, "common", *_INTERVALS)
        found = analysis.cost(table, options.steps, _groups(options, table), **shared)
        _put(found, options.output, lambda: _draw_cost(found))


# ---------------------------------------------------------------- pictures


def new_figure(width: float, height: float) -> "Figure":
    """
    :param width: inches
    :param height: inches
    :return: an empty figure
    :raises ImportError: matplotlib is not installed
    """
    with needing_matplotlib():
        from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained", dpi=150)


def _draw_grid(axes: Any, values: pd.DataFrame, **kwargs: Any) -> Any:
    image = axes.imshow(values.to_numpy(float), aspect="auto", **kwargs)
    axes.set_xticks(range(values.shape[1]), [str(name) for name in values.columns], rotation=45, ha="right")
    axes.set_yticks(range(values.shape[0]), [str(name) for name in values.index])
    for (row, column), value in _cells(values):
        if not math.isnan(value):
            color = _readable_on(image.cmap(image.norm(value)))
            axes.text(column, row, f"{value:.3g}", ha="center", va="center", color=color, fontsize=8)
    return image


def _readable_on(color: Sequence[float]) -> str:
    """Black or white, whichever has more contrast with a colour (WCAG 2)."""
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in color[:3]]
    luminance = sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
    return "black" if (luminance + 0.05) ** 2 > 0.05 * 1.05 else "white"


def _cells(values: pd.DataFrame) -> Iterator[tuple[tuple[int, int], float]]:
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            yield (row, column), float(values.iloc[row, column])


def _draw_heatmap(values: pd.DataFrame, name: str) -> "Figure":
    figure = new_figure(2 + 0.9 * values.shape[1], 1.5 + 0.6 * values.shape[0])
    axes = figure.add_subplot()
    figure.colorbar(_draw_grid(axes, values, cmap="viridis"), label="IQM of the scores" if name == "score" else name)
    axes.set_title(f"{values.attrs['step']:,} simulator steps")
    axes.set_xlabel(values.columns.name)
    axes.set_ylabel(values.index.name)
    return figure


def _draw_correlations(found: pd.DataFrame, by: list[str]) -> "Figure":
    parts = list(found.groupby(["group", *by], sort=False))
    variables = list(found["x"].unique())
    size = 1.5 + 0.7 * len(variables)
    figure = new_figure((size + 0.5) * len(parts), size)
    for axes, (head, part) in zip(figure.subplots(1, len(parts), squeeze=False)[0], parts, strict=True):
        matrix = part.pivot(index="x", columns="y", values="spearman").loc[variables, variables]
        matrix = matrix.rename(index=_last_word, columns=_last_word)
        _draw_grid(axes, matrix, cmap="RdBu_r", vmin=-1, vmax=1)
        axes.set_title(", ".join(map(str, head)))
    return figure


def _last_word(metric: str) -> str:
    return metric.rpartition("/")[2].replace("_", " ")


def _draw_cost(found: pd.DataFrame) -> "Figure":
    groups = list(found["group"].unique())
    figure = new_figure(4.5 * len(groups), 4)
    # An agent has one look in all groups, and not every agent has tasks of every group.
    looks = {agent: (f"C{i % 10}", STYLES[i // 10 % len(STYLES)]) for i, agent in enumerate(found["agent"].unique())}
    drawn: dict[str, Any] = {}
    for axes, group in zip(figure.subplots(1, len(groups), squeeze=False)[0], groups, strict=True):
        for agent, rows in found[found["group"] == group].dropna(subset="hours").groupby("agent", sort=False):
            color, style = looks[agent]
            marker = "o" if len(rows) < 3 else None
            (drawn[agent],) = axes.plot(rows["hours"], rows["iqm"], style, marker=marker, color=color)
            axes.fill_between(rows["hours"], rows["low"], rows["high"], alpha=0.2, color=color)
        axes.set_title(group)
        axes.set_xlabel("hours")
        axes.set_ylabel("IQM of the scores")
        axes.grid(alpha=0.3)
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=2 * len(groups), frameon=False)
    return figure


#: Commands by name: help, function that adds the arguments, and function that runs it.
COMMANDS: dict[str, tuple[str, Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], None]]] = {
    "table": ("read runs into one table", _add_table, _run_table),
    "aggregate": ("scores over tasks and seeds, with intervals", _add_aggregate, _run_aggregate),
    "marginalize": ("what a choice does, whatever is chosen besides", _add_marginalize, _run_marginalize),
    "correlate": ("rank correlations of score and diagnostics, or regressions", _add_correlate, _run_correlate),
    "heatmap": ("a score over two arguments", _add_heatmap, _run_heatmap),
    "cost": ("scores against hours", _add_cost, _run_cost),
}
