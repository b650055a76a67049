"""``sb3-sample scaling``: plan a sweep, fit its laws, predict settings, draw the paper's figures."""

import argparse
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from sb3_sample.study import table as tables
from sb3_sample.study.analysis_command import add_scores, add_sources, markdown, refusing
from sb3_sample.study.plan import read_plan
from sb3_sample.study.scaling import figures
from sb3_sample.study.scaling.budget import DELTA
from sb3_sample.study.scaling.files import read_laws, summary, write_laws
from sb3_sample.study.scaling.fitting import REPS, fit
from sb3_sample.study.scaling.result import Estimate, Laws

#: A command: its help, what adds its arguments, and what runs it.
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
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules that register environments")


def pairs(batch_sizes: Sequence[int], learning_rates: Sequence[float], full: bool) -> list[tuple[int, float]]:
    """
    :param batch_sizes: of the sweep
    :param learning_rates: of the sweep
    :param full: whether every one at every other; each at the middle one of the other if not
    :return: batch sizes and learning rates of the runs
    """
    if full:
        return [(batch, rate) for rate in learning_rates for batch in batch_sizes]
    batch, rate = batch_sizes[len(batch_sizes) // 2], learning_rates[len(learning_rates) // 2]
    return [(each, rate) for each in batch_sizes] + [(batch, each) for each in learning_rates if each != rate]


def plan_text(options: argparse.Namespace) -> str:
    """
    :param options: of ``sb3-sample scaling plan``
    :return: the plan
    """
    every = int(options.steps) // options.evaluations
    if every < 1 or options.seeds < 1 or options.evaluations < 1:
        raise ValueError(
            f"steps, evaluations and seeds must be at least 1, and no fewer steps than evaluations, not "
            f"{options.steps:g}, {options.evaluations}, {options.seeds}"
        )
    given = [each.partition(":")[::2] for each in options.hyperparams]
    fixed = "".join(f", {name}: {value}" for name, value in given)
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
            f"  {options.algo} B{batch} lr{rate:g}: "
            f"{{algo: {options.algo}, batch_size: {batch}, learning_rate: {rate:g}{fixed}}}"
        )
    ratios = ", ".join(f"{ratio:g}" for ratio in sorted(set(options.replay_ratios)))
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
    print(f"{len(runs)} runs of {runs[0].steps:,} steps in {options.output}. What they cost:")
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
    parts = [tables.read(options.sources)] if options.sources else []
    if options.published:
        parts.append(tables.published_runs(options.published))
    return pd.concat(parts, ignore_index=True)


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


def _words(found: dict[str, float | None] | None) -> str:
    if found is None or found["value"] is None:
        return "not determined"
    return str(Estimate(*(math.nan if value is None else value for value in found.values())))


def page(laws: Laws) -> str:
    """
    :param laws: of :func:`fit`
    :return: their numbers with 95% intervals and their limits, as Markdown
    """
    found = summary(laws)
    parts = [
        f"# Scaling laws of {len(laws.tasks)} tasks, {laws.seeds} seeds\n",
        f"Replay ratios {', '.join(f'{ratio:g}' for ratio in laws.replay_ratios)}. In brackets 95% intervals over "
        "seeds.",
    ]
    for name, law in found["hyperparameters"].items():
        parts.append(f"\n## {name}: intercept · sigma^slope\n\nslope {_words(law['slope'])}\n")
        rows = [{"task": task, "at sigma = 1": _words(value)} for task, value in law["intercepts"].items()]
        parts.append(markdown(pd.DataFrame(rows)))
        chosen = laws.hyperparameters[name].values.drop(columns="name")
        parts.append(f"\nChosen at {laws.choice_level:g}:\n\n{_plain_table(chosen)}")
    parts.append("\n## Environment steps: d_min · (1 + (beta / sigma)^alpha)\n")
    rows = [
        {
            "level": f"{row['level']:.0f}", "d_min": _words(row["d_min"]), "beta": _words(row["beta"]),
            "alpha": _words(row["alpha"]), "tasks": len(row["tasks"]),
            "worst fit": f"{max(abs(f / s - 1) for f, s in zip(row['fitted'], row['steps'], strict=True)):.1%}",
        }
        for row in found["data"]
    ]  # fmt: skip
    parts.append(markdown(pd.DataFrame(rows)))
    if "budgets" in found:
        parts.append("\n## Budget: least C + δ D\n")
        rows = [
            {
                "level": f"{row['level']:.0f}",
                **{
                    name: str(Estimate(*(_number(row[f"{name}{end}"]) for end in ("", "_low", "_high"))))
                    for name in ("replay_ratio", "budget")
                },
                "within the runs": "yes" if row["within"] else "no",
            }
            for row in found["budgets"]
        ]
        parts.append(markdown(pd.DataFrame(rows)))
    if "budget" in found:
        words = {name: _words(value) for name, value in found["budget"].items()}
        parts.append(
            "\nBest replay ratio = coefficient · F^exponent: logarithm of the coefficient "
            f"{words['log_coefficient']}, exponent {words['exponent']}"
        )
        held = laws.budgets().iloc[-2:]
        law = laws.budget_laws()[0]
        errors = [
            f"{float(law.replay_ratio(row.budget)[0]) / row.replay_ratio - 1:+.0%} at {row.level:.0f}"
            for row in held.itertuples()
        ]
        parts.append(f"The two largest budgets are held out; the law's replay ratio there: {', '.join(errors)}")
    limits = list(laws.notes)
    for row in found["data"]:
        limits += [f"level {row['level']:.0f}: {doubt}" for doubt in row["doubts"]]
        if row["left_out"]:
            limits.append(f"level {row['level']:.0f}: without {', '.join(row['left_out'])}, which do not reach it")
        if any(row["censored"]):
            at = [f"{r:g}" for r, hit in zip(row["replay_ratios"], row["censored"], strict=True) if hit]
            limits.append(
                f"level {row['level']:.0f}: not reached by every task at replay ratio {', '.join(at)}: a bound"
            )
    if limits:
        parts.append("\n## Limits\n\n" + "\n".join(f"- {limit}" for limit in limits))
    return "\n".join(parts)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _plain_table(table: pd.DataFrame) -> str:
    shown = table.copy()
    for name in ("replay_ratio", "value", "std", "decided", "edge"):
        shown[name] = [f"{value:.3g}" for value in shown[name]]
    return markdown(shown)


# ---------------------------------------------------------------- predict


def _add_predict(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("laws", type=Path, metavar="LAWS", help="file that fit has written")
    asked = parser.add_mutually_exclusive_group(required=True)
    asked.add_argument("--replay-ratio", type=float, metavar="R", help="settings for this replay ratio")
    asked.add_argument("--compute", type=float, metavar="FLOPS", help="fewest environment steps within this compute")
    asked.add_argument("--data", type=float, metavar="STEPS", help="least compute within so many environment steps")
    asked.add_argument("--budget", type=float, metavar="FLOPS", help="best for compute and δ times steps together")
    parser.add_argument("--level", type=float, metavar="RETURN", help="one of the fit (default: the largest)")
    parser.add_argument("--task", help="one of the fit (default: the mean over the tasks)")
    parser.add_argument("--json", action="store_true", help="print JSON")


def _run_predict(options: argparse.Namespace) -> None:
    laws = read_laws(options.laws)
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
