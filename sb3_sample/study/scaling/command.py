"""``sb3-sample scaling``: plan a sweep, fit its laws, predict settings, draw the paper's figures."""

import argparse
import ast
import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from sb3_sample.study import table as tables
from sb3_sample.study.analysis_command import add_scores, add_sources, refusing
from sb3_sample.study.plan_file import read_plan
from sb3_sample.study.scaling import figures
from sb3_sample.study.scaling.budget import DELTA
from sb3_sample.study.scaling.files import read_laws, write_laws
from sb3_sample.study.scaling.fitting import REPS, fit
from sb3_sample.study.scaling.page import page
from sb3_sample.study.scaling.result import Estimate, Laws

#: A command: its help, the function that adds its arguments, and the function that runs it.
Command = tuple[str, Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], None]]


def main(argv: Sequence[str]) -> None:
    """
    :param argv: command line after ``scaling``
    """
    parser = argparse.ArgumentParser(
        "sb3-sample scaling",
        description="Batch size, learning rate and replay ratio for a budget, from small runs. See docs/scaling.md.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (words, add, _) in COMMANDS.items():
        add(commands.add_parser(name, help=words, description=f"{words[0].upper()}{words[1:]}."))
    options = parser.parse_args(argv)
    with refusing(f"scaling {options.command}"):
        COMMANDS[options.command][2](options)


# ---------------------------------------------------------------- plan


def _add_plan(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("output", type=Path, metavar="PLAN", help="file to write, for sb3-sample study run")
    parser.add_argument("--algo", default="bro", help="algorithm, as of train (default: bro)")
    parser.add_argument("--tasks", nargs="+", required=True, help="ids of environments, or names of suites")
    parser.add_argument("--replay-ratios", nargs="+", type=float, default=[1, 2, 4, 8], help="default: 1 2 4 8")
    parser.add_argument(
        "--batch-sizes", nargs="+", type=int, default=[64, 128, 256], help="ascending (default: 64 128 256)"
    )
    parser.add_argument(
        "--learning-rates", nargs="+", type=float, default=[1.5e-4, 3e-4, 6e-4], help="default: 1.5e-4 3e-4 6e-4"
    )
    parser.add_argument(
        "--full",
        action="store_true",
        help="every batch size at every learning rate; without it each at the middle one of the other",
    )
    parser.add_argument("--seeds", type=int, default=3, help="how many (default: 3)")
    parser.add_argument("--steps", type=float, required=True, help="environment steps of each run")
    parser.add_argument("--evaluations", type=int, default=40, help="of each run (default: 40)")
    parser.add_argument("--episodes", type=int, default=5, help="of an evaluation (default: 5)")
    parser.add_argument(
        "-params", "--hyperparams", nargs="+", default=[], metavar="NAME:VALUE", help="further arguments, as of train"
    )
    parser.add_argument(
        "--measure",
        type=float,
        metavar="STEPS",
        help="have the runs measure the noise scale of their gradients and their overfitting every so many steps, for "
        "figures 4, 10 and 11",
    )
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules that register environments")


def pairs(batch_sizes: Sequence[int], learning_rates: Sequence[float], full: bool) -> list[tuple[int, float]]:
    """
    :param batch_sizes: of the sweep
    :param learning_rates: of the sweep
    :param full: whether to take all pairs; if not, each value only with the middle value of the other
    :return: batch sizes and learning rates of the runs
    """
    if full:
        return [(batch, rate) for rate in learning_rates for batch in batch_sizes]
    batch, rate = batch_sizes[len(batch_sizes) // 2], learning_rates[len(learning_rates) // 2]
    return [(each, rate) for each in batch_sizes] + [(batch, each) for each in learning_rates if each != rate]


def _written(value: float) -> str:
    """A number with all its digits, short if it has few."""
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


#: Value that stands for itself, such as 0.55M or auto.
_WORD = re.compile(r"(?![\de.+-]+$)\w[\w.+-]*")


class _Dicts(ast.NodeTransformer):
    """Write ``dict(name=value)`` as a literal."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        names = [keyword.arg for keyword in node.keywords]
        if not isinstance(node.func, ast.Name) or node.func.id != "dict" or node.args or None in names:
            return node
        return ast.Dict([ast.Constant(name) for name in names], [keyword.value for keyword in node.keywords])


def _pair(text: str) -> tuple[str, str]:
    """
    Name and value (in YAML) of NAME:VALUE, as ``sb3-sample train`` takes them; a plan holds plain values only. A single
    word needs no quotes.
    """
    name, _, value = text.partition(":")
    try:
        if not name.isidentifier():
            raise ValueError("no name")
        found = ast.literal_eval(_Dicts().visit(ast.parse(value.lstrip(), mode="eval")))
        # Every JSON text without NaN is one of YAML too, with texts in quotes.
        return name, json.dumps(found, allow_nan=False)
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError) as error:
        if name.isidentifier() and _WORD.fullmatch(value):
            return name, value
        raise ValueError(
            "-params must be NAME:VALUE, the value a number, word, list or dict in Python and a longer text in quotes "
            f"of its own (NAME:\"'a text'\"), not {text!r:.200} ({type(error).__name__}: {error})"
        ) from error


def plan_text(options: argparse.Namespace) -> str:
    """
    :param options: of ``sb3-sample scaling plan``
    :return: the plan
    :raises ValueError: a number is out of range, or a further argument is no plain Python
    """
    for name in ("evaluations", "episodes", "seeds"):
        if getattr(options, name) < 1:
            raise ValueError(f"{name} must be at least 1, not {getattr(options, name)}")
    if not options.evaluations <= options.steps < math.inf:
        raise ValueError(
            f"steps must be a finite number, at least that of the evaluations, {options.evaluations}, not "
            f"{options.steps:g}"
        )
    every = int(options.steps) // options.evaluations
    fixed = "".join(f", {name}: {value}" for name, value in map(_pair, options.hyperparams))
    lines = [
        "# Sweep of batch size and learning rate by replay ratio. One agent under many names: after",
        f"#   sb3-sample study run {options.output}",
        "# all of them are one for the laws:",
        f"#   sb3-sample scaling fit {options.algo}=runs/{options.output.stem} -o laws.json",
        "",
        "agents:",
    ]
    for batch, rate in pairs(sorted(set(options.batch_sizes)), sorted(set(options.learning_rates)), options.full):
        lines.append(
            f"  {options.algo} B{batch} lr{_written(rate)}: "
            f"{{algo: {options.algo}, batch_size: {batch}, learning_rate: {_written(rate)}{fixed}}}"
        )
    ratios = ", ".join(_written(ratio) for ratio in sorted(set(options.replay_ratios)))
    lines += [
        "",
        "grid:",
        f"  replay_ratio: [{ratios}]",
        "",
        f"tasks: [{', '.join(options.tasks)}]",
        f"seeds: {options.seeds}",
        f"steps: {int(options.steps)}",
        f"evaluation: {{every: {every}, episodes: {options.episodes}}}",
    ]
    if options.measure is not None:
        lines.append(f"measure: {_written(options.measure)}")
    if options.gym_packages:
        lines.append(f"gym_packages: [{', '.join(options.gym_packages)}]")
    return "\n".join(lines) + "\n"


def _run_plan(options: argparse.Namespace) -> None:
    if options.output.suffix not in (".yml", ".yaml"):
        raise ValueError(f"output must end in .yml, not {str(options.output)!r}")
    if options.output.exists():
        raise ValueError(f"{options.output} is there already: remove it, or name another file")
    text = plan_text(options)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(text)
    try:
        runs = read_plan(options.output).runs
    except ValueError:
        options.output.unlink()
        raise
    print(f"{len(runs)} runs of {runs[0].steps:,} steps in {options.output}. Their cost:")
    print(f"  sb3-sample study run {options.output} --dry-run")


# ---------------------------------------------------------------- fit


def _add_fit(parser: argparse.ArgumentParser) -> None:
    add_sources(parser, output="file of the laws to write (.json)")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the page that is printed to this file (.md)")
    _add_options(parser)


def _add_options(parser: argparse.ArgumentParser) -> None:
    add_scores(parser, groups=False)
    parser.add_argument(
        "--levels", nargs="+", type=float, metavar="RETURN", help="of 0 to 1000 (default: the authors' ten, 200 to 800)"
    )
    parser.add_argument(
        "--choice-level",
        type=float,
        metavar="RETURN",
        help="at which batch size and learning rate are chosen (default: the largest level)",
    )
    parser.add_argument("--agent", help="whose runs, where there are several agents")
    parser.add_argument("--size", help="model_size of the runs, where there are several")
    parser.add_argument("--critic-params", type=float, metavar="N", help="parameters of the critics, for compute")
    parser.add_argument(
        "--batch-size", type=float, metavar="B", help="of all runs, where their arguments do not say it"
    )
    parser.add_argument(
        "--delta", type=float, default=DELTA, help="FLOPs that an environment step is worth (default: 1e10)"
    )
    parser.add_argument("--loss", choices=("log", "squared"), default="log", help="of the data law (default: log)")
    parser.add_argument(
        "--online",
        action="store_true",
        help="the returns of training episodes in place of evaluations, as the authors' code has them",
    )
    parser.add_argument(
        "--keep-after-reset",
        action="store_true",
        help="count evaluations after a reset before the mean is back, as the authors' code does",
    )
    parser.add_argument(
        "--resets", nargs="+", type=int, metavar="STEP", help="steps of the agent's resets; one: between two"
    )
    parser.add_argument("--reps", type=int, default=REPS, help=f"bootstrap samples (default: {REPS})")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap (default: 0)")


def _table(options: argparse.Namespace) -> pd.DataFrame:
    if not options.sources and not options.published:
        raise ValueError("sources must be at least one folder or table, or --published runs")
    if options.online and options.published:
        raise ValueError("published runs have no online returns: give --online or --published, not both")
    metrics = (*tables.METRICS, "online_*") if options.online else tables.METRICS
    parts = [tables.read(options.sources, metrics)] if options.sources else []
    if options.published:
        parts.append(tables.published_runs(options.published))
    table = pd.concat(parts, ignore_index=True)
    return online(table) if options.online else table


def online(table: pd.DataFrame) -> pd.DataFrame:
    """
    :param table: of :func:`~sb3_sample.study.read`, with ``online_return`` or ``online_success_rate``
    :return: the table with these in place of ``return`` and ``success_rate``
    :raises ValueError: a run does not have them
    """
    prefix = "online_"
    there = table["metric"].str.startswith(prefix)
    evaluated = table["metric"].isin([metric.removeprefix(prefix) for metric in tables.ONLINE])
    runs = set(table.loc[there, tables.RUN].itertuples(index=False, name=None))
    for run in table.loc[evaluated, tables.RUN].itertuples(index=False, name=None):
        if run not in runs:
            agent, _, task, seed = run
            raise ValueError(
                f"online needs the Monitor files of all runs, and {agent} on {task}, seed {seed}, has none"
            )
    kept = table[~evaluated]
    return kept.assign(metric=kept["metric"].str.removeprefix(prefix)).reset_index(drop=True)


def _fitted(options: argparse.Namespace, table: pd.DataFrame) -> Laws:
    resets = options.resets
    return fit(
        table,
        options.levels,
        choice_level=options.choice_level,
        critic_params=options.critic_params,
        delta=options.delta,
        agent=options.agent,
        model_size=options.size,
        batch_size=options.batch_size,
        loss=options.loss,
        reps=options.reps,
        seed=options.seed,
        scores=dict(options.score),
        keep_after_reset=options.keep_after_reset,
        resets=resets[0] if resets is not None and len(resets) == 1 else resets,
    )


def _run_fit(options: argparse.Namespace) -> None:
    if options.output is not None and options.output.suffix != ".json":
        raise ValueError(f"output must end in .json, not {str(options.output)!r}")
    laws = _fitted(options, _table(options))
    text = page(laws)
    print(text)
    if options.page is not None:
        options.page.parent.mkdir(parents=True, exist_ok=True)
        options.page.write_text(text + "\n")
    if options.output is not None:
        write_laws(laws, options.output)
        print(f"\nSaved to {options.output}")


# ---------------------------------------------------------------- predict


def _add_predict(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("laws", type=Path, metavar="LAWS", help="file that fit -o has written")
    asked = parser.add_mutually_exclusive_group(required=True)
    asked.add_argument("--replay-ratio", type=float, metavar="R", help="settings for this replay ratio")
    asked.add_argument("--compute", type=float, metavar="FLOPS", help="fewest environment steps within this compute")
    asked.add_argument("--data", type=float, metavar="STEPS", help="least compute within so many environment steps")
    asked.add_argument("--budget", type=float, metavar="FLOPS", help="best for compute and δ times steps together")
    parser.add_argument("--level", type=float, metavar="RETURN", help="one of the fit (default: the largest)")
    parser.add_argument("--task", help="one of the fit (default: the mean over the tasks)")
    parser.add_argument("--json", action="store_true", help="print JSON")


def _run_predict(options: argparse.Namespace) -> None:
    try:
        laws = read_laws(options.laws)
    except FileNotFoundError as error:
        raise ValueError(
            f"laws must be a file that sb3-sample scaling fit -o has written, and {str(options.laws)!r} is not there"
        ) from error
    found = laws.predict(
        replay_ratio=options.replay_ratio,
        compute=options.compute,
        data=options.data,
        budget=options.budget,
        level=options.level,
        task=options.task,
    )
    if options.json:
        shown = {
            name: value._asdict() if isinstance(value, Estimate) else value for name, value in found._asdict().items()
        }
        cleaned = json.loads(json.dumps({**shown, "params": found.params()}), parse_constant=lambda _: None)
        print(json.dumps(cleaned, indent=2))
        return
    rows = [("replay_ratio", found.replay_ratio), ("batch_size", found.batch_size)]
    rows += [("learning_rate", found.learning_rate), ("environment steps", found.steps), ("FLOPs", found.compute)]
    width = max(len(name) for name, _ in rows)
    level = "between levels" if found.level is None else f"to a return of {found.level:.0f} (of 1000)"
    print(f"Settings {level}, 95% intervals over seeds:")
    for name, value in rows:
        print(f"  {name:<{width}}  {'not known' if value is None else value}")
    for limit in found.limits:
        print(f"  limit: {limit}")
    print(f"\n-params {found.params()}")


# ---------------------------------------------------------------- plot


def _add_plot(parser: argparse.ArgumentParser) -> None:
    add_sources(parser, output="folder of the pictures")
    _add_options(parser)
    parser.add_argument("--format", choices=("png", "svg"), default="png", help="of the pictures (default: png)")


def _run_plot(options: argparse.Namespace) -> None:
    if options.output is None:
        raise ValueError("output (-o) must be a folder for the pictures")
    table = _table(options)
    laws = _fitted(options, table)
    drawn, without = figures.draw_all(laws, table, options)
    options.output.mkdir(parents=True, exist_ok=True)
    for name, figure in drawn.items():
        figure.savefig(options.output / f"{name}.{options.format}")
        print(options.output / f"{name}.{options.format}")
    for name, reason in without.items():
        print(f"not drawn: {name}: {reason}")


COMMANDS: dict[str, Command] = {
    "plan": ("write the sweep of batch size and learning rate by replay ratio as a study's plan", _add_plan, _run_plan),
    "fit": ("fit the laws of a table of runs", _add_fit, _run_fit),
    "predict": ("settings for a replay ratio, or for a limit of compute, steps or budget", _add_predict, _run_predict),
    "plot": ("draw the paper's figures from runs", _add_plot, _run_plot),
}
