"""Groups of tasks and factors for comparing a study's runs, from its plan, for the commands that analyse it."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from sb3_sample.study.aggregate import GROUPS
from sb3_sample.study.plan import Comparison
from sb3_sample.study.runs import LIST, RUNS, StudyFolder
from sb3_sample.study.table import labelled


def comparison(sources: str | Path | Iterable[str | Path]) -> Comparison:
    """
    Read from the plans of studies how their runs are compared.

    :param sources: folders of studies or of runs in them, as for :func:`~sb3_sample.study.read`; other sources
        contribute nothing
    :return: groups of tasks and factors by their names, as ``groups=`` and ``factors=`` of
        :func:`~sb3_sample.study.marginalize` take them
    :raises ValueError: two plans have different tasks or arguments under the same name
    """
    found = Comparison({}, {})
    for source in [sources] if isinstance(sources, (str, Path)) else sources:
        path = labelled(source)[1].absolute()
        study = next(
            (each for each in (path, *path.parents) if (each / LIST).is_file() and (each / RUNS).is_dir()), None
        )
        if study is None:
            continue
        for known, more, what in zip(found, StudyFolder(study).comparison(), Comparison._fields, strict=True):
            for name, members in more.items():
                if known.setdefault(name, members) != members:
                    raise ValueError(
                        f"{what} of the plans must be the same where they have the same name, not {name!r}"
                    )
    return found


def chosen_groups(
    planned: dict[str, list[str]], names: Sequence[str] | None, table: pd.DataFrame
) -> dict[str, list[str]] | Sequence[str] | None:
    """
    :param planned: tasks of the plans' groups by their names
    :param names: requested groups; None for the plans' groups, or the default groups if there are none
    :param table: of the runs
    :return: the groups, as for :func:`~sb3_sample.study.aggregate`; the plans' groups have only tasks of the table, and
        are left out if they have none
    :raises ValueError: there is no such group
    """
    if not planned:
        return names
    tasks = list(table["task"].unique())
    groups = {}
    for name in planned if names is None else names:
        if name not in planned and name not in GROUPS:
            raise ValueError(f"groups must be of {', '.join([*planned, *GROUPS])}, not {name!r}")
        groups[name] = [task for task in tasks if (task in planned[name] if name in planned else GROUPS[name](task))]
    return {name: members for name, members in groups.items() if members}
