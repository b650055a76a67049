"""Runs for a report: one table of all runs, including others', the states of studies, and how the runs were made."""

import dataclasses
import functools
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import pandas as pd

from sb3_sample.plots import COLUMNS as CURVE_COLUMNS
from sb3_sample.plots import Curve, find_runs
from sb3_sample.run_logs import EVALUATIONS
from sb3_sample.run_settings import STUDY_RUNS, study_of
from sb3_sample.saving.untrusted import BadFile, parse_json, read_regular
from sb3_sample.study import table as tables
from sb3_sample.study.aggregate import named_apart
from sb3_sample.study.plan import Run
from sb3_sample.study.plan_file import read_plan
from sb3_sample.study.reporting.pieces import counted
from sb3_sample.study.reporting.planned import missing_runs
from sb3_sample.study.runs import LIST, PLAN, StudyError, checkpointed
from sb3_sample.study.states import FAILED, Status, status
from sb3_sample.study_list import read_list

#: Path of runs, or a table of them.
Source: TypeAlias = str | Path | pd.DataFrame
#: Most bytes of a plan, of a checkpoint's manifest, and of the records beside a table.
_MAX_PLAN, _MAX_MANIFEST, _MAX_RECORDS = 2**20, 8 * 2**20, 64 * 2**20
_MEASURED = ("return", "success_rate")


@dataclasses.dataclass
class Gathered:
    """
    All data behind a report.

    :param names: names of the sources, as given
    :param titles: the names without folders, or their labels
    :param table: runs, agents with different arguments named apart
    :param runs: agent (as its source names it), arguments, task and seed of the sources' runs that have a seed
    :param published: agents in the table that others have measured
    :param asked: names of published agents requested with all their seeds
    :param curves: curves of others, available only as statistics over seeds, by task and metric
    :param states: states of the studies among the sources
    :param plans: plans' texts, by folder or file
    :param planned: runs of the given plan
    :param made_with: for each run that records them: versions, device, processor, commit
    :param notes: what was left out, with the reason
    :param labels: name given to the agents of each of ``states``, None for the names of the plan
    :param shown: the table's name of each of the sources' agents, by its name there and its arguments
    :param scored_by: metrics of the given scores
    """

    names: list[str]
    titles: list[str]
    table: pd.DataFrame
    runs: pd.DataFrame
    published: list[str]
    asked: list[str]
    curves: dict[tuple[str, str], list[Curve]]
    states: list[Status]
    plans: dict[str, str]
    planned: list[Run]
    made_with: list[dict[str, str]]
    notes: list[str]
    labels: list[str | None] = dataclasses.field(default_factory=list)
    shown: dict[tuple[str, str], str] = dataclasses.field(default_factory=dict)
    scored_by: tuple[str, ...] = ()

    @functools.cached_property
    def missing(self) -> list[Run]:
        """The given plan's runs that are not among the sources'."""
        return missing_runs(self.planned, self.runs)

    @property
    def agents(self) -> list[str]:
        """Agents, with others' agents last."""
        found = list(self.table["agent"].unique())
        return sorted(found, key=lambda agent: agent in self.published)

    @property
    def evaluated(self) -> pd.DataFrame:
        """Rows that scores are made from; a run's other logs may continue after its last evaluation."""
        return self.table[self.table["metric"].isin([*_MEASURED, "episode_length", *self.scored_by])]

    @property
    def tasks(self) -> list[str]:
        """Tasks of the table, in its order."""
        return list(self.table["task"].unique())


def gather(
    sources: Source | Iterable[Source], published: Sequence[str | Path] = (), plan: str | Path | None = None
) -> Gathered:
    """
    Read all that a report needs, each file once.

    :param sources: as for :func:`~sb3_sample.study.read`, or tables
    :param published: runs of others: names as for :func:`~sb3_sample.study.published_runs`, or files of tables. Only
        the sources' tasks are kept; without sources, these runs are the ones compared
    :param plan: file of a plan whose runs are looked for among the sources; a label must be one of its agents
    :return: runs and states
    :raises ValueError: there are neither sources nor published runs, a file is damaged, a name is unknown,
        or a source's label is no agent of the plan
    :raises OSError: a file cannot be read
    """
    given: list[Source] = [sources] if isinstance(sources, (str, Path, pd.DataFrame)) else list(sources)
    if not given and not published:
        raise ValueError("sources must be at least one folder or table, or --published runs")
    none = pd.DataFrame(columns=tables.COLUMNS)
    found = Gathered([], [], none, none[tables.RUN], [], [], {}, [], {}, [], [], [])
    parts: list[pd.DataFrame] = []
    paths: list[str | Path] = []
    within: dict[tuple[Path, str | None], list[Path]] = {}
    for source in given:
        if isinstance(source, pd.DataFrame):
            found.names.append("a table")
            found.titles.append("a table")
            parts.append(source)
            continue
        found.names.append(str(source))
        paths += _paths(source, found, within)
    _add_failed(within, found)
    if plan is not None:
        found.planned = list(read_plan(plan).runs)
        agents = dict.fromkeys(run.agent for run in found.planned)
        for label in filter(None, (tables.labelled(source)[0] for source in given if isinstance(source, (str, Path)))):
            if label not in agents:
                raise ValueError(
                    f"plan has the agents {', '.join(agents)}, and {label!r}, the label of a source, is none of them: "
                    "give the source without a label, or with an agent's name"
                )
        found.plans[str(plan)] = read_regular(Path(plan), _MAX_PLAN).decode(errors="replace")
    if paths:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", UserWarning)
            parts.append(tables.read(paths))
        found.notes += [str(warning.message) for warning in told]
    if parts:
        found.runs = pd.concat(parts, ignore_index=True)[tables.RUN].dropna(subset="seed").drop_duplicates()
    own, found.shown = _measured(parts, found)
    theirs, _ = _measured([_published(name, found) for name in published], found)
    if given:
        theirs = theirs[theirs["task"].isin(own["task"].unique())]
        theirs = theirs.assign(agent=tables.marked_published(theirs["agent"]))
        found.published = list(theirs["agent"].unique())
        if published and not len(theirs):
            found.notes.append("The published runs have none of the tasks here, and are left out.")
    found.names += [str(name) for name in published]
    found.titles += [] if given else [Path(name).stem for name in published]
    kept = [part for part in (own, theirs) if len(part)]
    found.table = pd.concat(kept, ignore_index=True) if kept else own
    return found


def _add_failed(within: Mapping[tuple[Path, str | None], Sequence[Path]], found: Gathered) -> None:
    """
    Add the states of studies whose folders are no sources themselves, but above or below them, if runs there have
    failed.

    :param within: the sources' folders, by the study and their label
    :param found: is added to
    """
    for (study, label), folders in sorted(within.items(), key=str):
        try:
            state = status(study)
        except (OSError, StudyError) as error:
            found.notes.append(f"Whether runs of {study} have failed is not known: {error}")
            continue
        places = [(each, study / STUDY_RUNS / each.run.name) for each in state.runs]
        state.runs = [each for each, place in places if any(place.is_relative_to(folder) for folder in folders)]
        if state.of(FAILED):
            found.states.append(state)
            found.labels.append(label)


def _paths(source: str | Path, found: Gathered, within: dict[tuple[Path, str | None], list[Path]]) -> list[str | Path]:
    """
    Runs of a source (of a study only evaluated ones); adds its state and how its runs were made to ``found``, and its
    folder to those of ``_add_failed`` if it is no study's.
    """
    label, path = tables.labelled(source)
    found.titles.append(label or (path.stem if path.is_file() else path.resolve().name))
    if path.is_file():
        found.made_with += _recorded(path.with_suffix(".json"))
        return [source]
    is_study = (path / LIST).is_file()
    folders = []
    try:
        folders = find_runs(path)
    except BadFile:
        raise
    except ValueError:  # there is no run
        if not is_study:
            raise
    listed = functools.cache(read_list)
    former = {
        folder for folder in folders if (study := study_of(folder)) is not None and listed(study).is_former(folder)
    }
    for study in {each for each in map(study_of, folders) if each is not None} if not is_study else ():
        within.setdefault((study, label), []).append(path.absolute())
    if is_study:
        found.states.append(status(path))
        found.labels.append(label)
        if (path / PLAN).is_file():
            found.plans[str(source)] = read_regular(path / PLAN, _MAX_PLAN).decode(errors="replace")
        evaluated = [folder for folder in folders if (folder / EVALUATIONS).exists()]
        n = len(set(folders) - set(evaluated) - former)
        if n:
            found.notes.append(f"{counted(n, 'run')} of {source} without an evaluation yet: in no figure.")
        folders = evaluated
    found.made_with += [made for folder in folders if folder not in former and (made := made_with(folder))]
    return [folder if label is None else f"{label}={folder}" for folder in folders]


def made_with(folder: Path) -> dict[str, str]:
    """
    :param folder: folder of a run
    :return: circumstances of its last checkpoint, by name; empty if none are recorded
    """
    path = folder / f"checkpoint-{checkpointed(folder):012d}" / "manifest.json"
    try:
        manifest = parse_json(read_regular(path, _MAX_MANIFEST), str(path))
    except (OSError, BadFile):  # no checkpoint, or one that is being replaced
        return {}
    found = manifest.get("circumstances") if isinstance(manifest, dict) else None
    return {str(name): str(value) for name, value in found.items()} if isinstance(found, dict) else {}


def _recorded(path: Path) -> list[dict[str, str]]:
    """Versions and machines of a table's runs, from the file beside it that ``studies/evidence.py`` writes."""
    if not path.is_file():
        return []
    try:
        records = parse_json(read_regular(path, _MAX_RECORDS), str(path))
    except BadFile:  # a file of another kind
        return []
    kept = [record for record in records if isinstance(record, dict)] if isinstance(records, list) else []
    return [
        {name: str(value) for name, value in record.items() if name != "run"}
        for record in kept
        if isinstance(record.get("run"), dict) and isinstance(record.get("commit"), str)
    ]


def _published(name: str | Path, found: Gathered) -> pd.DataFrame:
    path = Path(name)
    if path.suffix in (".csv", ".parquet"):
        return tables.load(path)
    found.asked.append(str(name).partition(" (")[0])
    return tables.published_runs([str(name)])


def _measured(parts: list[pd.DataFrame], found: Gathered) -> tuple[pd.DataFrame, dict[tuple[str, str], str]]:
    """
    Runs of tables, named apart, and these names by agent and arguments; rows of statistics over seeds become curves.
    """
    parts = [part for part in parts if len(part)]
    if not parts:
        return found.table, {}
    table = pd.concat(parts, ignore_index=True)
    heads = table["metric"].str.partition("/")
    statistics = table["seed"].isna() & heads[0].isin(_MEASURED) & heads[2].isin(tables.STATISTICS)
    for (agent, task, metric), rows in table[statistics].groupby(["agent", "task", heads[0]], sort=False):
        data = rows.assign(name=heads[2]).pivot_table(index="step", columns="name", values="value").reset_index()
        data = data.rename(columns={"step": "env_step"}).rename_axis(columns=None).reindex(columns=CURVE_COLUMNS)
        found.curves.setdefault((task, metric), []).append(Curve(agent, data, published=True))
    runs = table[~statistics].reset_index(drop=True)
    named = named_apart(runs)
    return named, dict(zip(zip(runs["agent"], runs["arguments"], strict=True), named["agent"], strict=True))
