"""
One table of many runs, with one row per run, step and metric.

Columns (:data:`COLUMNS`): ``agent``; ``arguments``, its hyperparameters as JSON with sorted names; ``task``, an
environment's id; ``seed``; ``step``, in simulator steps regardless of the action repeat; ``metric``; ``value``.
"""

import fnmatch
import functools
import itertools
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sb3_sample.envs.suites import published_id, published_key
from sb3_sample.extras import needing
from sb3_sample.plots import DATA, all_published_curves, find_runs, named_algorithms
from sb3_sample.run_logs import EVALUATIONS, OFFLINE, is_truncated, read_evaluations, read_monitors
from sb3_sample.run_settings import RECORD, RunSettings, plain_id, read_settings, study_of
from sb3_sample.saving.untrusted import BadFile, parse_json, read_regular
from sb3_sample.study_list import is_evaluated, read_list, to_json
from sb3_sample.warn import warn

COLUMNS = ["agent", "arguments", "task", "seed", "step", "metric", "value"]
#: Columns that identify a run.
RUN = ["agent", "arguments", "task", "seed"]
#: Metrics read by default, as patterns like those of file names.
METRICS = ("return", "success_rate", "hours", "diagnostics/*")
#: All seeds of the authors' runs of BRO and BRO Fast on their 40 tasks.
SEEDS = DATA.parent / "published_seeds.npz"
#: Statistics of a published curve, as metrics ``return/mean``, ... in the table.
STATISTICS = ("mean", "std", "min", "max", "iqm", "n_seeds")

_EVALUATED = {"return": "results", "success_rate": "successes", "episode_length": "ep_lengths"}
_MONITORED = {"return": "r", "success_rate": "is_success", "episode_length": "l"}
#: Metrics of the training episodes, besides evaluations.
ONLINE = {f"online_{metric}": _MONITORED[metric] for metric in ("return", "success_rate")}
_LOG = "progress.jsonl"
_SECONDS = "time/time_elapsed"
#: A line of the log, up to the time.
_TIMED = re.compile(rb'\{"step": (\d{1,15}), [^\n]*?"time/time_elapsed": (\d{1,15}(?:\.\d+)?)[,}]')
#: Most bytes of a run's log.
_MAX_LOG = 256 * 2**20


class _Rows:
    """Builder of a table: a block of rows for each metric of each run."""

    def __init__(self) -> None:
        self._heads: list[tuple[Any, ...]] = []
        self._steps: list[np.ndarray] = []
        self._values: list[np.ndarray] = []

    def add(
        self,
        agent: str,
        arguments: str,
        task: str,
        seed: int | None,
        metric: str,
        steps: np.ndarray,
        values: np.ndarray,
    ) -> None:
        self._heads.append((agent, arguments, task, pd.NA if seed is None else seed, metric))
        self._steps.append(np.asarray(steps, np.int64))
        self._values.append(np.asarray(values, float))

    def table(self) -> pd.DataFrame:
        heads = pd.DataFrame(self._heads, columns=["agent", "arguments", "task", "seed", "metric"], dtype=object)
        table = heads.loc[heads.index.repeat([len(steps) for steps in self._steps])].reset_index(drop=True)
        table["step"] = np.concatenate([np.empty(0, np.int64), *self._steps])
        table["value"] = np.concatenate([np.empty(0), *self._values])
        return table.astype({"seed": "Int64"})[COLUMNS]


def plain_texts(table: pd.DataFrame) -> pd.DataFrame:
    """
    :param table: with a column ``arguments``
    :return: the same table with these texts as :func:`to_json` writes them: 2.0 is 2, since equal arguments do not tell
        agents apart
    """
    texts = {text: to_json(json.loads(text)) for text in table["arguments"].unique()}
    if all(text == plain for text, plain in texts.items()):
        return table
    return table.assign(arguments=table["arguments"].map(texts))


# ---------------------------------------------------------------- runs


class _Found(NamedTuple):
    """
    A run to be read.

    :param folder: its folder
    :param study: folder of its study, if it is in one
    :param agent: name of its agent in the table
    :param task: id of its environment
    :param settings: from its files
    """

    folder: Path
    study: Path | None
    agent: str
    task: str
    settings: RunSettings


def read(sources: str | Path | Iterable[str | Path], metrics: Sequence[str] = METRICS) -> pd.DataFrame:
    """
    Read the table of runs: of this package (``--run-dir``), of the zoo, and of folders with only Monitor files.

    A run's values are from its evaluations, each averaged over its episodes. A run without evaluations has its training
    episodes instead, one row per episode, at the step at which it ended; a warning says so. If other runs of its study
    have evaluations, whether or not they are among the sources, it has not reached its first one, and has none of these
    values. A run in progress whose evaluations are truncated, since they are just being written, is left out with a
    warning. ``hours`` is the time that the run had taken, and ``diagnostics/...`` are its logged diagnostics.

    :param sources: folders of runs, or folders with runs at any depth, or tables as :func:`write` writes them.
        ``"LABEL=FOLDER"`` names the agent; else its name is that in the study's plan or, outside a study, that of its
        algorithm or, if no file gives it, that of the folder above the run's
    :param metrics: patterns of the metrics to keep: "return", "success_rate", "episode_length", "hours",
        "online_return" and "online_success_rate" (of the training episodes, which explore, even for runs with
        evaluations) and all entries of ``progress.jsonl``, e.g. "train/*"
    :return: columns :data:`COLUMNS`, in the order of the sources. Runs that were removed from their study's plan are
        left out, with a warning. If a run's files do not give its seed, it has the first number from 0 on that no
        other run of that agent and task has
    :raises ValueError: there is no run in a source, a file is damaged, a run's task is unknown, two runs have the same
        agent, arguments, task and seed, or a folder is there twice under the same agent
    :raises OSError: if a file cannot be read
    """
    given = [sources] if isinstance(sources, (str, Path)) else list(sources)
    if not given:
        raise ValueError("sources must be at least one folder or table, not none")
    tables, rows = [], _Rows()
    found: list[_Found] = []
    listed = functools.cache(read_list)
    evaluated = functools.cache(is_evaluated)
    left_out: list[Path] = []
    for source in given:
        label, path = labelled(source)
        if path.suffix in (".csv", ".parquet") and path.is_file():
            table = load(path)
            tables.append(table if label is None else table.assign(agent=label))
            continue
        for folder in find_runs(path):
            study = study_of(folder)
            if study is not None and listed(study).is_former(folder):
                left_out.append(folder)
                continue
            run = read_settings(folder)
            if run.task is None:
                raise ValueError(
                    f"{folder} does not say which task it is of: it has no {RECORD}, no args.yml of the zoo, and no "
                    "environment's id in its Monitor files"
                )
            of_study = None if study is None else listed(study).agent(folder)
            agent = label or of_study or run.agent or folder.resolve().parent.name
            found.append(_Found(folder, study, agent, run.task, run))
    early: list[Path] = []
    training: list[Path] = []
    writing: list[Path] = []
    folders: set[tuple[str, Path]] = set()
    seen: dict[tuple[Any, ...], Path] = {}
    for (folder, study, agent, task, run), seed in zip(found, _seeds(found), strict=True):
        # Without a recorded seed, the same folder would be two runs with different numbers.
        if (agent, folder.resolve()) in folders:
            raise ValueError(f"runs must be named once, and {folder} is there twice. LABEL=FOLDER names one otherwise")
        folders.add((agent, folder.resolve()))
        arguments = to_json(run.arguments)
        key = (agent, arguments, task, seed)
        if key in seen:
            raise ValueError(
                f"runs must differ in agent, arguments, task or seed, and {folder} has those of {seen[key]}: "
                f"{agent}, {task}, seed {seed}. LABEL=FOLDER names one otherwise"
            )
        seen[key] = folder
        # Directly before its files are read: the run may be under way.
        if is_truncated(folder):
            writing.append(folder)
            continue
        has_evaluations = (folder / EVALUATIONS).exists()
        before_first = not has_evaluations and study is not None and evaluated(study)
        if not has_evaluations:
            (early if before_first else training).append(folder)
        for metric, (steps, values) in _measured(folder, run, metrics).items():
            if before_first and metric in _MONITORED:
                continue
            rows.add(agent, arguments, task, seed, metric, steps, values)
    if left_out:
        warn(
            f"{len(left_out)} runs ({left_out[0]}, ...) are not in their study's plan any more and are left out; "
            "elsewhere their folders are read as any others"
        )
    if writing:
        warn(
            f"{len(writing)} runs ({', '.join(map(str, writing))}) are just writing their {EVALUATIONS}, or were "
            "killed while they did, and are left out"
        )
    if early:
        warn(f"{len(early)} runs ({early[0]}, ...) are before their first evaluation and have no return yet")
    if training:
        warn(
            f"{len(training)} runs have no {EVALUATIONS} ({training[0]}, ...): their rows are training episodes, which "
            "explore"
        )
    table = rows.table()
    table = pd.concat([table, *tables], ignore_index=True) if len(table) else pd.concat(tables or [table])
    if tables and table.duplicated([*RUN, "metric", "step"]).any():
        twice = table[table.duplicated([*RUN, "metric", "step"])].iloc[0]
        raise ValueError(
            f"tables must have one value a run, step and metric: there are two of {twice['agent']}, {twice['task']}, "
            f"seed {twice['seed']}, {twice['metric']} at {twice['step']:,}"
        )
    return table.reset_index(drop=True)


def _seeds(runs: Iterable[_Found]) -> list[int]:
    """
    Seeds of runs. A run whose files do not give its seed gets the first free number of its agent and task, after all
    recorded seeds. Seeds of tables do not count: a table may be of the same runs, and is then to be refused.
    """
    runs = list(runs)
    recorded: dict[tuple[str, str], set[int]] = {}
    for run in runs:
        if run.settings.seed is not None:
            recorded.setdefault((run.agent, run.task), set()).add(run.settings.seed)
    free: dict[tuple[str, str], Iterator[int]] = {}
    seeds = []
    for run in runs:
        key = run.agent, run.task
        taken = recorded.get(key, set())
        numbers = free.setdefault(key, itertools.filterfalse(taken.__contains__, itertools.count()))
        seeds.append(next(numbers) if run.settings.seed is None else run.settings.seed)
    return seeds


def labelled(source: str | Path) -> tuple[str | None, Path]:
    """
    :param source: a folder or table, or "LABEL=FOLDER"
    :return: the label, if there is one, and the path
    :raises ValueError: the label is empty
    """
    label, equals, path = str(source).partition("=")
    if isinstance(source, Path) or not equals or Path(source).exists():
        return None, Path(source)
    if not label:
        raise ValueError(f"sources must be FOLDER or LABEL=FOLDER, not {source!r}")
    return label, Path(path)


def _measured(folder: Path, run: RunSettings, metrics: Sequence[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Simulator steps and values of a run by metric. Each of its files is read at most once, and only if needed."""
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    monitored: pd.DataFrame | None = None
    if (folder / EVALUATIONS).exists():
        data = read_evaluations(folder / EVALUATIONS)
        steps = data["timesteps"] * run.repeat * run.skip
        for metric, key in _EVALUATED.items():
            if key in data:
                found[metric] = steps, data[key].astype(float).reshape(len(steps), -1).mean(axis=1)
    else:
        monitored = read_monitors(folder)
        steps = monitored["l"].cumsum().to_numpy() * run.repeat
        for metric, column in _MONITORED.items():
            if column in monitored and len(monitored):
                found[metric] = steps, monitored[column].to_numpy(float)
    if any(_matches(metric, metrics) for metric in ONLINE) and any(folder.glob("*monitor.csv")):
        monitored = read_monitors(folder) if monitored is None else monitored
        for metric, column in ONLINE.items():
            if column in monitored and len(monitored):
                ended = monitored["l"].cumsum().to_numpy() * run.repeat
                found[metric] = ended, monitored[column].to_numpy(float)
    if "episode_length" in found:
        found["episode_length"] = (steps, found["episode_length"][1] * run.repeat)
    # A run that learned from data first has a separate log of that phase, and a clock that restarted afterwards.
    before = folder / OFFLINE / _LOG
    logged = _logged(before, run.repeat * run.skip, metrics) if before.exists() else {}
    online = _logged(folder / _LOG, run.repeat * run.skip, metrics)
    if _SECONDS in logged and _SECONDS in online:
        online[_SECONDS] = online[_SECONDS][0], online[_SECONDS][1] + logged[_SECONDS][1][-1]
    for name, (at, values) in online.items():
        first = logged.get(name, (at[:0], values[:0]))
        logged[name] = np.append(first[0], at), np.append(first[1], values)
    seconds = logged.pop(_SECONDS, None)
    if seconds is None and _matches("hours", metrics):
        monitored = read_monitors(folder) if monitored is None and any(folder.glob("*monitor.csv")) else monitored
        if monitored is not None and len(monitored):
            seconds = monitored["l"].cumsum().to_numpy() * run.repeat, monitored["t"].to_numpy(float)
    if seconds is not None:
        found["hours"] = _hours(*seconds, steps)
    found = {metric: pair for metric, pair in found.items() if _matches(metric, metrics)}
    return found | {metric: pair for metric, pair in logged.items() if metric not in found}


def _matches(metric: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(metric, pattern) for pattern in patterns)


def _hours(logged: np.ndarray, seconds: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Hours at the steps of the evaluations. After the last logged time, at most one log interval, the run's mean speed is
    assumed.
    """
    logged, seconds = np.append(0, logged), np.append(0.0, seconds)
    hours = np.interp(steps, logged, seconds)
    late = steps > logged[-1]
    if logged[-1] > 0:
        hours[late] = seconds[-1] * steps[late] / logged[-1]
    return steps, hours / 3_600


def _logged(path: Path, repeat: int, metrics: Sequence[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Values of the lines of a log, by name, and ``_SECONDS``. An incomplete last line is left out."""
    values: dict[str, dict[int, float]] = {}
    try:
        data = read_regular(path, _MAX_LOG)
    except FileNotFoundError:
        return {}
    kept = functools.cache(lambda name: name == _SECONDS or _matches(name, metrics))
    # Most lines have none of the requested metrics except the time, and parsing takes most of the reading time.
    beginnings = {b'"' + re.split(r"[*?[]", pattern)[0].encode() for pattern in metrics}
    beginnings = {beginning for beginning in beginnings if beginning in data}
    for number, text in enumerate(data.splitlines(keepends=True), 1):
        if not text.endswith(b"\n"):
            break
        timed = None if any(beginning in text for beginning in beginnings) else _TIMED.match(text)
        if timed is not None:
            values.setdefault(_SECONDS, {})[int(timed[1])] = float(timed[2])
            continue
        line = parse_json(text, f"line {number} of {path}")
        step = line.get("step") if isinstance(line, dict) else None
        if type(step) is not int or not 0 <= step < 2**53:
            raise BadFile(f"{path} is no log of a run: its line {number} has no step, or {step!r:.100}")
        for name, value in line.items():
            if kept(name) and name != "step" and type(value) in (int, float):
                values.setdefault(name, {})[step] = value
    return {
        name: (np.fromiter(found, np.int64) * repeat, np.fromiter(found.values(), float))
        for name, found in values.items()
    }


# ---------------------------------------------------------------- published


def published_runs(agents: Sequence[str] | None = None, tasks: Sequence[str] | None = None) -> pd.DataFrame:
    """
    Read all seeds of published runs: BRO and BRO Fast on BRO's 40 tasks, ten seeds, 40 evaluations to a million steps
    (naumix/BiggerRegularizedOptimistic, MIT; ``data/README.md``).

    Meta-World's runs are of the v2 tasks, under the ids of v3.

    :param agents: names, as "BRO" or "BRO (RR=10)"; all if None. The table has them as given, without brackets
    :param tasks: ids of environments; all if None
    :return: columns :data:`COLUMNS`
    :raises ValueError: there are no runs of that name or task
    """
    with np.load(SEEDS) as data:
        names, steps, seeds = list(data["algorithm"]), data["env_steps"], data["seed"]
        keys = list(zip(data["suite"], data["task"], strict=True))
        returns = data["returns"].astype(float)
    rows = _Rows()
    chosen = _chosen_tasks(tasks, {(str(suite), str(task)) for suite, task in keys})
    for asked in names if agents is None else agents:
        found = named_algorithms(asked, names)
        if len(found) != 1:
            raise ValueError(f"agents must be of {', '.join(names)} (or without the brackets), not {asked!r}")
        i = names.index(found[0])
        arguments = to_json({"replay_ratio": {"BRO (RR=10)": 10, "BRO Fast (RR=2)": 2}[found[0]]})
        for j, key in enumerate(keys):
            for task in chosen.get(key, ()):
                metric = "return" if key[0] == "dmc" else "success_rate"
                for k, seed in enumerate(seeds):
                    rows.add(_bare(asked), arguments, task, int(seed), metric, steps, returns[i, j, k])
    return rows.table()


def marked_published(agents: Iterable[str]) -> list[str]:
    """
    :param agents: names of agents that others have measured, which may equal names of the user's agents
    :return: names marked as published
    """
    return [name if "published" in name.lower() else f"{name}, published" for name in agents]


def published_curves(agents: Sequence[str] | None = None, tasks: Sequence[str] | None = None) -> pd.DataFrame:
    """
    Read the published curves, available only as statistics over the seeds: metrics ``return/mean``, ``return/iqm``, ...
    or ``success_rate/mean``, ... (:data:`STATISTICS`) and no seed, so that none is taken for a run.

    :param agents: names, as for ``sb3-sample plot --published``; all if None. The table has a name as given, without
        brackets, if it is that of one algorithm, and the full names if it is that of several
    :param tasks: ids of environments, which the table has as given; all if None
    :return: columns :data:`COLUMNS`
    :raises ValueError: there are no curves of that name or task
    """
    curves = all_published_curves()
    names = list(curves["algorithm"].unique())
    asked: dict[str, str] = {}
    for name in ["all"] if agents is None else agents:
        found = named_algorithms(name, names)
        if not found:
            raise ValueError(f"agents must be of {', '.join(names)} (or without the brackets), not {name!r}")
        asked |= {found[0]: _bare(name)} if len(found) == 1 else {each: each for each in found}
    chosen = _chosen_tasks(tasks, set(zip(curves["suite"], curves["task"], strict=True)))
    rows = _Rows()
    curves = curves[curves["algorithm"].isin(list(asked))]
    for (algorithm, suite, name, metric), part in curves.groupby(["algorithm", "suite", "task", "metric"], sort=False):
        for task in chosen.get((suite, name), ()):
            for statistic in STATISTICS:
                rows.add(asked[algorithm], "{}", task, None, f"{metric}/{statistic}", part["env_step"], part[statistic])
    return rows.table()


def _bare(name: str) -> str:
    return name.partition(" (")[0]


def _chosen_tasks(tasks: Sequence[str] | None, available: set[tuple[str, str]]) -> dict[tuple[str, str], list[str]]:
    """Ids for the table by published suite and task."""
    if tasks is None:
        return {key: [published_id(*key)] for key in available}
    chosen: dict[tuple[str, str], list[str]] = {}
    for task in tasks:
        key = published_key(task)
        if key not in available:
            raise ValueError(f"tasks must be of those that were published, not {task!r}")
        chosen.setdefault(key, []).append(plain_id(task))
    return chosen


# ---------------------------------------------------------------- files


def write(table: pd.DataFrame, path: str | Path) -> None:
    """
    :param table: any table
    :param path: .csv, which keeps every digit, or .parquet
    :raises ValueError: the path has another ending
    :raises ImportError: .parquet without pyarrow
    """
    path = Path(path)
    if path.suffix not in (".csv", ".parquet"):
        raise ValueError(f"output must end in .csv or .parquet, not {str(path)!r}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".csv":
        table.to_csv(path, index=False)
    else:
        _check_parquet()
        table.to_parquet(path, index=False)


def load(path: str | Path) -> pd.DataFrame:
    """
    :param path: of a table of runs, as :func:`write` writes it
    :return: the table, with columns :data:`COLUMNS`
    :raises ValueError: it is not a table of runs
    :raises ImportError: .parquet without pyarrow
    """
    path = Path(path)
    text = dict.fromkeys(("agent", "arguments", "task", "metric"), str)
    try:
        if path.suffix == ".parquet":
            _check_parquet()
            table = pd.read_parquet(path)
        else:
            missing = {"seed": [""], "value": [""]}
            table = pd.read_csv(
                path, dtype=text, keep_default_na=False, na_values=missing, float_precision="round_trip"
            )
        table = plain_texts(table[COLUMNS].astype({**text, "seed": "Int64", "step": np.int64, "value": float}))
    except KeyError as error:
        raise BadFile(f"{path} is no table of runs: {error}. It must have {', '.join(COLUMNS)}") from error
    except (ValueError, TypeError, RecursionError) as error:
        raise BadFile(f"{path} is no table of runs: {error}") from error
    return table


def _check_parquet() -> None:
    with needing(".parquet needs pyarrow", "study"):
        import pyarrow  # noqa: F401
