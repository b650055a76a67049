"""
List of a study's runs, as far as reading and drawing runs needs it, and the names of their folders. It may come from
anybody.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sb3_sample.run_logs import EVALUATIONS
from sb3_sample.run_settings import STUDY_LIST, STUDY_RUNS
from sb3_sample.saving.untrusted import BadFile, parse_json, read_regular

#: Entry of the list with runs that are no longer in the plan, by name.
FORMER = "former"
#: Stands for the value of an argument that was not given.
ABSENT: Any = object()
#: Most bytes of the list.
MAX_LIST = 2**28
#: Most characters in one part of a folder's name.
MAX_NAME = 120


class StudyList(NamedTuple):
    """
    :param agents: agents by the names of their folders, ``<agent and grid>``
    :param former: names of runs that were removed from the plan; they may have been made with other settings
    """

    agents: dict[str, str]
    former: set[str]

    def agent(self, folder: Path) -> str | None:
        """
        :param folder: folder of one of the study's runs
        :return: the agent's name in the plan; None if the list does not have it
        """
        return self.agents.get(folder.absolute().parents[1].name)

    def is_former(self, folder: Path) -> bool:
        """
        :param folder: folder of one of the study's runs
        :return: whether the run was removed from the plan
        """
        return "/".join(folder.absolute().parts[-3:]) in self.former


def read_list(study: Path) -> StudyList:
    """
    :param study: folder of a study
    :return: the needed part of its list of runs
    :raises BadFile: (a ``ValueError``) if it is no such list
    :raises OSError: if it cannot be read
    """
    path = study / STUDY_LIST
    found = parse_json(read_regular(path, MAX_LIST), str(path))
    runs, former = (found.get("runs"), found.get(FORMER, {})) if isinstance(found, dict) else (None, None)
    if not isinstance(runs, list) or not all(map(_is_run, runs)) or not isinstance(former, dict):
        raise BadFile(f"{path} is no list of a study's runs")
    return StudyList({variant_of(run["agent"], run.get("grid", {})): run["agent"] for run in runs}, set(former))


def _is_run(run: Any) -> bool:
    return isinstance(run, dict) and isinstance(run.get("agent"), str) and isinstance(run.get("grid", {}), dict)


def is_evaluated(study: Path) -> bool:
    """
    :param study: folder of a study
    :return: whether any of its runs has evaluations. If so, a run without them has not reached its first one, and its
        training episodes, which explore, do not stand for them
    """
    return any(study.glob(f"{STUDY_RUNS}/*/*/*/{EVALUATIONS}"))


def variant_of(agent: str, grid: Mapping[str, Any]) -> str:
    """
    :param agent: name of an agent in a plan
    :param grid: its arguments that belong to the plan's grid
    :return: name of its folder
    """
    return part_of_path(",".join([agent, *(f"{name}={short(value)}" for name, value in grid.items())]))


def to_json(value: Any) -> str:
    """
    :param value: a plain value, such as arguments by name
    :return: its text in tables of runs, equal for equal values: 2.0 is 2, and true is not 1
    """
    return json.dumps(_plain(value), sort_keys=True)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def part_of_path(name: str) -> str:
    """
    :param name: any name
    :return: the name as a part of a path; a long one ends in a hash instead of the rest
    """
    plain = re.sub(r"[^\w.,=+()-]+", "-", name)
    if len(plain) <= MAX_NAME:
        return plain
    return f"{plain[:MAX_NAME]}-{hashlib.sha256(name.encode()).hexdigest()[:12]}"


def word(value: Any) -> str:
    """
    :param value: of an argument; :data:`ABSENT` if it was not given
    :return: its text in names of agents; a text that reads as another value, such as "2", is in quotation marks
    """
    if value is ABSENT:
        return "default"
    if value is None:
        return "none"
    if not isinstance(value, str):
        return json.dumps(_plain(value))
    try:
        return json.dumps(value) if json.loads(value) is not None else value
    except ValueError:
        return value


def short(value: Any) -> str:
    """
    :param value: value of an argument in a grid
    :return: its text in names
    """
    return value if isinstance(value, str) else json.dumps(value)
