"""Laws as words and tables, for the page of ``sb3-sample scaling fit`` and for a study's report."""

import math
from typing import Any, NamedTuple

import pandas as pd

from sb3_sample.study.analysis_command import markdown
from sb3_sample.study.scaling.files import summary
from sb3_sample.study.scaling.result import Estimate, Laws


class Part(NamedTuple):
    """
    A part of the page.

    :param title: of the part
    :param table: cells as text
    :param words: sentences; may be empty
    """

    title: str
    table: pd.DataFrame
    words: str = ""


def beginning(laws: Laws) -> str:
    """
    :param laws: of :func:`~sb3_sample.study.scaling.fit`
    :return: a description of their runs
    """
    ratios = ", ".join(f"{ratio:g}" for ratio in laws.replay_ratios)
    return f"Replay ratios {ratios}. In brackets 95% intervals over seeds."


def parts(laws: Laws) -> list[Part]:
    """
    :param laws: of :func:`~sb3_sample.study.scaling.fit`
    :return: their numbers with 95% intervals
    """
    found = summary(laws)
    pieces = []
    for name, law in found["hyperparameters"].items():
        rows: list[dict[str, Any]] = [
            {"task": task, "at sigma = 1": _words(value)} for task, value in law["intercepts"].items()
        ]
        pieces.append(Part(f"{name}: intercept · sigma^slope", pd.DataFrame(rows), f"slope {_words(law['slope'])}"))
        chosen = laws.hyperparameters[name].values.drop(columns="name")
        pieces.append(Part(f"{name} chosen at {laws.choice_level:g}", _plain_table(chosen)))
    rows = [
        {
            "level": f"{row['level']:.0f}", "d_min": _words(row["d_min"]), "beta": _words(row["beta"]),
            "alpha": _words(row["alpha"]), "tasks": f"{len(row['tasks'])}",
            "worst fit": f"{_worst(row):.1%}",
        }
        for row in found["data"]
    ]  # fmt: skip
    pieces.append(Part("Environment steps: d_min · (1 + (beta / sigma)^alpha)", pd.DataFrame(rows)))
    if "budgets" in found:
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
        pieces.append(Part("Budget: least C + δ D", pd.DataFrame(rows), _budget(laws, found)))
    return pieces


def _worst(row: dict[str, Any]) -> float:
    """Largest relative error of a fit; a law above a lower bound has no error."""
    errors = [fitted / steps - 1 for fitted, steps in zip(row["fitted"], row["steps"], strict=True)]
    return max(max(-error, 0.0) if hit else abs(error) for error, hit in zip(errors, row["censored"], strict=True))


def _budget(laws: Laws, found: dict[str, Any]) -> str:
    if "budget" not in found:
        return ""
    words = {name: _words(value) for name, value in found["budget"].items()}
    law = laws.budget_laws()[0]
    errors = [
        f"{float(law.replay_ratio(row.budget)[0]) / row.replay_ratio - 1:+.0%} at {row.level:.0f}"
        for row in laws.budgets().iloc[-2:].itertuples()
    ]
    return (
        f"Best replay ratio = coefficient · F^exponent: logarithm of the coefficient {words['log_coefficient']}, "
        f"exponent {words['exponent']}. The two largest budgets are held out; the law's replay ratio there: "
        f"{', '.join(errors)}"
    )


def limits(laws: Laws) -> list[str]:
    """
    :param laws: of :func:`~sb3_sample.study.scaling.fit`
    :return: their limits, one sentence each
    """
    numbers = summary(laws)
    found = list(numbers["notes"])
    for row in numbers["data"]:
        found += [f"level {row['level']:.0f}: {doubt}" for doubt in row["doubts"]]
        if row["left_out"]:
            found.append(f"level {row['level']:.0f}: without {', '.join(row['left_out'])}, which do not reach it")
        if any(row["censored"]):
            at = [f"{r:g}" for r, hit in zip(row["replay_ratios"], row["censored"], strict=True) if hit]
            found.append(
                f"level {row['level']:.0f}: not reached by every task at replay ratio {', '.join(at)}: a bound"
            )
    return found


def page(laws: Laws) -> str:
    """
    :param laws: of :func:`~sb3_sample.study.scaling.fit`
    :return: their numbers with 95% intervals and their limits, as Markdown
    """
    lines = [f"# Scaling laws of {len(laws.tasks)} tasks, {laws.seeds} seeds\n", beginning(laws)]
    for part in parts(laws):
        lines.append(f"\n## {part.title}\n\n{markdown(part.table)}" + (f"\n\n{part.words}" if part.words else ""))
    if found := limits(laws):
        lines.append("\n## Limits\n\n" + "\n".join(f"- {limit}" for limit in found))
    return "\n".join(lines)


def _words(found: dict[str, float | None] | None) -> str:
    if found is None or found["value"] is None:
        return "not determined"
    return str(Estimate(*(math.nan if value is None else value for value in found.values())))


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _plain_table(table: pd.DataFrame) -> pd.DataFrame:
    shown = table.copy()
    for name in ("replay_ratio", "value", "std", "decided", "edge"):
        shown[name] = [f"{value:.3g}" for value in shown[name]]
    return shown
