"""File of laws: JSON, with the bootstrap samples for intervals of predictions."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_sample.saving.untrusted import BadFile, parse_json, read_regular
from sb3_sample.study.scaling.budget import BudgetLaw
from sb3_sample.study.scaling.laws import DataLaw
from sb3_sample.study.scaling.result import HELD_OUT, Estimate, Hyperparameter, Laws, Level

_MAX_FILE = 64 * 2**20
_FORMAT = "sb3_sample scaling laws 1"


def write_laws(laws: Laws, path: str | Path) -> None:
    """
    :param laws: of :func:`fit`
    :param path: of the JSON file; its entry "summary" has every number with its interval
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"format": _FORMAT, "summary": summary(laws), **_plain(laws)}) + "\n")


def summary(laws: Laws) -> dict[str, Any]:
    """
    :param laws: of :func:`fit`
    :return: all their numbers with intervals, as JSON; None for numbers that are not determined
    """
    found: dict[str, Any] = {"hyperparameters": {}, "data": []}
    for name, law in laws.hyperparameters.items():
        found["hyperparameters"][name] = {
            "slope": _json(laws.interval(law.slopes)),
            "intercepts": {
                task: _json(laws.interval([each[:, i] for each in law.intercepts])) for i, task in enumerate(law.tasks)
            },
        }
    for level in laws.levels:
        row: dict[str, Any] = {"level": level.level, "tasks": level.tasks, "left_out": level.left_out}
        row["doubts"] = level.law().doubts(laws.replay_ratios)
        unknown = level.law().undetermined(laws.replay_ratios)
        for name in DataLaw._fields:
            told = name not in unknown
            row[name] = _json(laws.interval([getattr(law, name) for law in level.laws])) if told else None
        row["replay_ratios"], row["steps"] = laws.replay_ratios, _clean(level.points.tolist())
        row["fitted"] = _clean(level.law().steps(np.array(laws.replay_ratios)).tolist())
        row["censored"] = level.censored.tolist()
        found["data"].append(row)
    notes = list(laws.notes)
    if laws.has_compute:
        found["budgets"] = _clean(laws.budgets().to_dict("records"))
        if len(laws.levels) >= HELD_OUT + 2:
            try:
                of = laws.budget_laws()
            except ValueError as error:
                # Happens if levels are reached at the same evaluations; the other laws remain valid.
                notes.append(f"there is no law of the budget: {error}")
            else:
                found["budget"] = {
                    name: _json(laws.interval([np.atleast_1d(getattr(law, name)) for law in of]))
                    for name in BudgetLaw._fields
                }
    found["notes"] = notes
    return found


def _json(found: Estimate) -> dict[str, float | None]:
    return _clean(found._asdict())  # type: ignore[no-any-return]


def _clean(value: Any) -> Any:
    """A value with None in place of numbers that JSON cannot represent."""
    if isinstance(value, dict):
        return {name: _clean(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_clean(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, pd.DataFrame):
        return _clean(value.to_dict("records"))
    if isinstance(value, np.ndarray):
        return _clean(value.tolist())
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return _clean(value)


def read_laws(path: str | Path) -> Laws:
    """
    :param path: file written by :func:`write_laws`
    :return: the laws
    :raises ValueError: it is not a file of laws
    """
    found = parse_json(read_regular(Path(path), _MAX_FILE), str(path))
    if not isinstance(found, dict) or found.get("format") != _FORMAT:
        raise BadFile(f"{path} is no file of scaling laws; sb3-sample scaling fit writes one")
    try:
        hyperparameters = {
            name: Hyperparameter(
                pd.DataFrame(each["values"]).astype({"value": float, "std": float, "edge": float}),
                each["tasks"],
                [np.array(x, float) for x in each["slopes"]],
                [np.array(x, float) for x in each["intercepts"]],
            )
            for name, each in found["hyperparameters"].items()
        }
        levels = [
            Level(
                each["level"], each["tasks"], each["left_out"], np.array(each["points"], float),
                np.array(each["censored"], bool), np.array(each["factors"], float),
                [DataLaw(*(np.array(x, float) for x in law)) for law in each["laws"]],
            )
            for each in found["levels"]
        ]  # fmt: skip
        rest = {
            field.name: found[field.name]
            for field in dataclasses.fields(Laws)
            # Older files lack "others" and "without_law".
            if field.name not in ("hyperparameters", "levels")
            and (field.name in found or field.name not in ("others", "without_law"))
        }
        return Laws(hyperparameters=hyperparameters, levels=levels, **rest)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BadFile(f"{path} is no file of scaling laws: {type(error).__name__}: {error}") from error
