"""
The runs of one task, mean and range over seeds, beside the curves that others have published for it.

``sb3-sample plot`` is :func:`main`; :func:`published_curves`, :func:`summarize` and :func:`draw` are for programs.
"""

import argparse
import functools
import itertools
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pandas as pd

from sb3_sample.envs import published_key
from sb3_sample.exits import refuse
from sb3_sample.extras import needing_matplotlib
from sb3_sample.run_logs import EVALUATIONS, is_truncated, monitor_files, read_evaluations, read_monitors
from sb3_sample.run_settings import RECORD, read_settings, run_env_id, study_of
from sb3_sample.study_list import is_evaluated, read_list

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DATA = Path(__file__).parent / "data" / "published_curves.csv.gz"
#: The published algorithms that are drawn by default.
PUBLISHED = ("BRO", "BRO Fast", "SAC")
#: Columns of the table of a curve, by simulator step, over the seeds. The standard deviation is the sample's (n - 1).
COLUMNS = ["env_step", "n_seeds", "mean", "std", "min", "max", "iqm"]
#: The zoo's names of our algorithms, where they differ from the published names.
ZOO_NAMES = {"flashsac": "flash_sac", "sac": "sac_sample"}
METRICS = {"return": "return", "success_rate": "success rate"}
#: Line styles of curves that share a colour, by how often all colours were taken before: ours, and published ones.
STYLES: tuple[Any, ...] = ("-", "-.", ":")
DASHES: tuple[Any, ...] = ("--", (0, (8, 2)), (0, (2, 1)))
#: Rows of the printed table per curve.
MAX_TABLE_STEPS = 10


@dataclass(frozen=True)
class Run:
    """
    The measurements of one run.

    :param label: name of the curve of which the run is a seed
    :param path: the run's folder
    :param steps: simulator steps, increasing, (T,)
    :param values: mean over the episodes of the evaluation, or of the bin, at each of them, (T,)
    """

    label: str
    path: Path
    steps: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Curve:
    """
    :param label: name of the algorithm, or the user's
    :param data: columns ``COLUMNS``
    :param published: whether others measured it
    """

    label: str
    data: pd.DataFrame
    published: bool = False

    @property
    def seeds(self) -> str:
        """Number of seeds in words, e.g. "5 seeds"."""
        numbers = sorted(set(self.data["n_seeds"]))
        return "1 seed" if numbers == [1] else f"{'-'.join(str(n) for n in numbers)} seeds"


# ---------------------------------------------------------------- published curves


def published_curves(env_id: str) -> pd.DataFrame:
    """
    The curves that others have published (``data/README.md`` names their sources, licences and how they were measured).

    The MuJoCo curves are of the v4 tasks and Meta-World's of the v2 tasks, whatever version ``env_id`` names.

    :param env_id: id of an environment, e.g. ``"dmc/cheetah-run-v0"``, ``"HalfCheetah-v5"``, or HumanoidBench's
        ``"h1-walk-v0"``
    :return: columns algorithm, metric ("return" or "success_rate") and ``COLUMNS``; no rows if nothing was published
    """
    try:
        suite, task = published_key(env_id)
    except ValueError:  # of no published suite
        suite, task = "", ""
    data = all_published_curves()
    rows = data[(data["suite"] == suite) & (data["task"] == task)]
    return rows[["algorithm", "metric", *COLUMNS]].reset_index(drop=True)


@functools.cache
def all_published_curves() -> pd.DataFrame:
    """
    :return: the curves of all tasks, as ``data/README.md`` describes them. The table is cached: do not change it
    """
    return pd.read_csv(DATA)


def named_algorithms(name: str, available: Sequence[str]) -> list[str]:
    """
    :param name: e.g. "BRO (RR=10)" or, without the bracket, "BRO", which means all of that name unless one has exactly
        this name; "all"
    :param available: the algorithms to choose from
    :return: the algorithms that it names
    """
    exact = [algorithm for algorithm in available if name.lower() == algorithm.lower()]
    return exact or [
        algorithm for algorithm in available if name.lower() in ("all", algorithm.partition(" (")[0].lower())
    ]


def _published_task(env_id: str) -> str:
    """The task of the published curves, if its version is not that of the id; else empty."""
    suite, task = published_key(env_id)
    return {"metaworld": f"{task}-v2", "gymnasium": task}.get(suite, "")


def _of_task(env_id: str) -> str:
    task = _published_task(env_id)
    return f" (of {task})" if task else ""


def select_published(env_id: str, names: Sequence[str] | None, metric: str) -> list[Curve]:
    """
    :param env_id: id of the environment
    :param names: published algorithms, e.g. "BRO (RR=10)" or, without the bracket, "BRO", which means all of that name
        unless one has exactly this name ("SAC" is one set of curves, "SAC (TD-MPC2 authors)" another); "all"; none if
        empty; if None those of ``PUBLISHED`` that exist
    :param metric: "return" or "success_rate"
    :return: their curves
    :raises ValueError: there is no curve of that name
    """
    data = published_curves(env_id)
    data = data[data["metric"] == metric]
    available = list(data["algorithm"].unique())
    chosen: list[str] = []
    for name in PUBLISHED if names is None else names:
        matches = named_algorithms(name, available)
        if not matches and names is not None:
            raise ValueError(
                f"published must be of {', '.join(available) or 'nothing: there are no curves'} "
                f"({env_id}, {METRICS[metric]}), not {name!r}"
            )
        chosen += [match for match in matches if match not in chosen]
    curves = []
    for algorithm in chosen:
        rows = data[data["algorithm"] == algorithm].sort_values("env_step")
        curves.append(Curve(algorithm, rows[COLUMNS].reset_index(drop=True), published=True))
    return curves


# ---------------------------------------------------------------- runs


def _folders(path: Path) -> Iterator[Path]:
    """The folder and all below it; links are not followed, and the depth is not limited."""
    waiting = [path] if path.is_dir() else []
    while waiting:
        folder = waiting.pop()
        yield folder
        with os.scandir(folder) as entries:
            waiting += [Path(entry) for entry in entries if entry.is_dir(follow_symlinks=False)]


def _is_run(folder: Path) -> bool:
    return (folder / EVALUATIONS).exists() or bool(monitor_files(folder))


def find_runs(path: Path) -> list[Path]:
    """
    :param path: a run's folder, or a folder with such folders at any depth; links are not followed
    :return: the folders of runs: those with ``evaluations.npz`` or Monitor files; ``path`` alone if it is one. Within a
        run with evaluations, a subfolder is a further run only if it has a ``run.json``: others are copies of its files
        or Monitor files of its evaluations. Monitor files above recorded runs, such as those of single tasks, are of a
        training on all of them, and no run
    :raises ValueError: there are none
    """
    found = {folder for folder in _folders(path) if _is_run(folder)}
    if not found:
        raise ValueError(f"runs must be folders with an evaluations.npz or Monitor files in or below them, not {path}")
    recorded = {folder for folder in found if (folder / RECORD).exists()}
    above = {parent for folder in recorded for parent in folder.parents}
    if path in recorded or path in found - above:
        return [path]
    evaluated = {folder for folder in found if (folder / EVALUATIONS).exists()}
    runs = recorded | {folder for folder in found - above if evaluated.isdisjoint(folder.parents)}
    return sorted(runs, key=lambda folder: (len(folder.name), str(folder)))


def read_run(folder: Path, label: str, metric: str, bin_steps: int) -> Run:
    """
    Read ``evaluations.npz``, or, if there is none, the training episodes in the Monitor files. Steps are simulator
    steps, like those of the published curves, whatever the action repeat.

    :param folder: the run's folder
    :param label: name of its curve
    :param metric: "return" or "success_rate"
    :param bin_steps: simulator steps over which training episodes are averaged
    :return: the run
    :raises ValueError: the run did not record the metric, or has no episode
    """
    file = folder / EVALUATIONS
    if file.exists():
        key = {"return": "results", "success_rate": "successes"}[metric]
        data = read_evaluations(file)
        if key not in data:
            raise ValueError(f"metric must be one that was recorded, not {metric!r}: {file} has no {key!r}")
        settings = read_settings(folder)
        steps = data["timesteps"] * settings.repeat * settings.skip
        return Run(label, folder, steps, data[key].astype(float).reshape(len(steps), -1).mean(axis=1))
    steps, values = _episodes(folder, metric)
    filled, bins = np.unique(np.ceil(steps / bin_steps).astype(int), return_inverse=True)
    means = np.bincount(bins, values) / np.bincount(bins)
    return Run(label, folder, filled * bin_steps, means)


def _episodes(folder: Path, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Simulator step at the end of each training episode, and its return or success."""
    episodes = read_monitors(folder)
    key = {"return": "r", "success_rate": "is_success"}[metric]
    if key not in episodes:
        raise ValueError(f"metric must be one that was recorded, not {metric!r}: {folder} has no column {key!r}")
    if not len(episodes):
        raise ValueError(f"runs must have at least one finished episode; {folder} has none")
    return _ends(folder, episodes), episodes[key].to_numpy(float)


def _ends(folder: Path, episodes: pd.DataFrame) -> np.ndarray:
    """Simulator step at the end of each of Monitor's episodes."""
    return episodes["l"].cumsum().to_numpy() * read_settings(folder).repeat


def _with_episodes(labelled: Sequence[tuple[str, Path]]) -> list[tuple[str, Path]]:
    """
    :param labelled: labels and folders of runs
    :return: those that have evaluations or a finished training episode, which is not enough where other runs of their
        study have evaluations; a line on stderr names each of the others, which have just begun or are just writing
        their evaluations
    :raises ValueError: there are none
    """
    found = []
    evaluated = functools.cache(is_evaluated)
    for label, folder in labelled:
        study = study_of(folder)
        if is_truncated(folder):
            print(f"{folder / EVALUATIONS} is just being written, and the run is left out", file=sys.stderr)
        elif (folder / EVALUATIONS).exists():
            found.append((label, folder))
        elif study is not None and evaluated(study):
            print(f"{folder} is before its first evaluation, and is left out", file=sys.stderr)
        elif len(read_monitors(folder)):
            found.append((label, folder))
        else:
            print(f"{folder} has no finished episode yet, and is left out", file=sys.stderr)
    if not found:
        raise ValueError(
            "runs must have an evaluation or, if no run of their study has one, at least one finished episode; none "
            "of them has"
        )
    return found


def _default_bin(folders: Sequence[Path]) -> int:
    """The published curves' 25,000 steps; for short runs about a twentieth of the shortest, as a round number."""
    lengths = [_ends(folder, read_monitors(folder))[-1] for folder in folders]
    width = max(min(lengths, default=0) / 20, 1)
    if width >= 25_000:
        return 25_000
    magnitude = 10 ** int(np.log10(width))
    return int(magnitude * max(factor for factor in (1, 2, 5) if factor * magnitude <= width))


def summarize(runs: Sequence[Run]) -> pd.DataFrame:
    """
    Mean, standard deviation, range and interquartile mean over seeds, at the steps that all runs have. If they have
    none in common, the runs are interpolated linearly at the steps of the run with the fewest, as far as all reach.

    :param runs: at least one
    :return: columns ``COLUMNS``
    :raises ValueError: the runs do not overlap
    """
    steps = functools.reduce(np.intersect1d, [run.steps for run in runs])
    if not len(steps):
        steps = min((run.steps for run in runs), key=len)
        first, last = max(run.steps[0] for run in runs), min(run.steps[-1] for run in runs)
        steps = steps[(first <= steps) & (steps <= last)]
    if not len(steps):
        raise ValueError(f"runs of {runs[0].label!r} must overlap: " + ", ".join(str(run.path) for run in runs))
    values = np.sort([np.interp(steps, run.steps, run.values) for run in runs], axis=0)
    n_seeds = len(runs)
    cut = n_seeds // 4
    return pd.DataFrame(
        {
            "env_step": steps,
            "n_seeds": n_seeds,
            "mean": values.mean(axis=0),
            "std": values.std(axis=0, ddof=1) if n_seeds > 1 else np.nan,
            "min": values[0],
            "max": values[-1],
            "iqm": values[cut : n_seeds - cut].mean(axis=0),
        },
        columns=COLUMNS,
    )


# ---------------------------------------------------------------- picture and table


def draw(env_id: str, curves: Sequence[Curve], metric: str, xlim: tuple[float, float] | None = None) -> "Figure":
    """
    :param env_id: id of the environment, the title
    :param curves: what to draw; published ones are dashed. Beyond ten curves the styles of the lines differ too
    :param metric: "return" or "success_rate"
    :param xlim: first and last simulator step; if None from 0 to the end of the longest curve that is not published
    :return: the picture: lines are means, shaded areas the range over seeds
    :raises ImportError: matplotlib is not installed
    """
    with needing_matplotlib():
        from matplotlib import colormaps
        from matplotlib.figure import Figure
        from matplotlib.ticker import EngFormatter

    if xlim is None:
        own = [curve for curve in curves if not curve.published] or curves
        xlim = (0.0, float(max(curve.data["env_step"].iloc[-1] for curve in own)))
    figure = Figure(figsize=(7, 4.8), layout="constrained", dpi=150)
    axes = figure.add_subplot()
    colors: Any = colormaps["tab10"].colors  # type: ignore[attr-defined]
    looks = ((colors[i % len(colors)], min(i // len(colors), len(STYLES) - 1)) for i in itertools.count())
    looks_of_ours: dict[str, tuple[Any, int]] = {}
    for curve in sorted(curves, key=lambda curve: curve.published):
        shown = curve.data[curve.data["env_step"].between(*xlim)]
        # A published curve has the colour of ours of the same algorithm ("bro_fast" is "BRO Fast (RR=2)").
        name = curve.label.partition(" (")[0].lower().replace(" ", "_")
        if curve.published and ZOO_NAMES.get(name) in looks_of_ours:
            name = ZOO_NAMES[name]
        color, turn = looks_of_ours.pop(name) if curve.published and name in looks_of_ours else next(looks)
        if not curve.published:
            looks_of_ours[name] = color, turn
        axes.fill_between(
            shown["env_step"],
            shown["min"],
            shown["max"],
            color=color,
            alpha=0.1 if curve.published else 0.25,
            linewidth=0,
            zorder=1,
        )
        axes.plot(
            shown["env_step"],
            shown["mean"],
            color=color,
            linestyle=(DASHES if curve.published else STYLES)[turn],
            linewidth=1.5 if curve.published else 2.2,
            marker="o" if len(shown) == 1 else None,
            label=f"{curve.label}, {curve.seeds}",
            zorder=2 if curve.published else 3,
        )
    axes.set_title(env_id)
    axes.set_xlabel("simulator steps")
    axes.set_ylabel({"return": "undiscounted return", "success_rate": "success rate"}[metric])
    axes.set_xlim(*xlim)
    if metric == "success_rate":
        axes.set_ylim(-0.03, 1.03)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    title = "mean and range over seeds"
    if any(curve.published for curve in curves):
        title += f"; dashed: published{_of_task(env_id)}"
    # Below the axes, where it covers nothing.
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9, title=title, title_fontsize=9)
    return figure


def format_table(curves: Sequence[Curve], all_steps: bool = False) -> str:
    """
    :param curves: at least one that is not published
    :param all_steps: every step, not only ``MAX_TABLE_STEPS`` spread over them
    :return: Markdown table of the curves at the steps that all have in common, or else that one of our curves and a
        published one have in common, or else at our steps
    """
    own = np.unique(np.concatenate([curve.data["env_step"] for curve in curves if not curve.published]))
    others = [curve.data["env_step"] for curve in curves if curve.published]
    # Preferably steps at which all curves have a value, else those at which one of ours and a published one do.
    shared_by_any = np.intersect1d(own, np.concatenate(others)) if others else own
    shared_by_all = functools.reduce(np.intersect1d, [curve.data["env_step"] for curve in curves])
    steps = next((steps for steps in (shared_by_all, shared_by_any) if len(steps)), own)
    if not all_steps and len(steps) > MAX_TABLE_STEPS:
        steps = steps[np.linspace(0, len(steps) - 1, MAX_TABLE_STEPS).round().astype(int)]
    lines = ["| step | curve | seeds | mean | std | min | max | IQM |", "| ---: | --- " + "| ---: " * 6 + "|"]
    for step in steps:
        for curve in curves:
            label = f"{curve.label}, published" if curve.published else curve.label
            for _, row in curve.data[curve.data["env_step"] == step].iterrows():
                numbers = " | ".join(_number(row[name]) for name in COLUMNS[2:])
                lines.append(f"| {step:,} | {label} | {row['n_seeds']:.0f} | {numbers} |")
    if others and not len(shared_by_any):
        lines.append("\nNo step is shared with a published curve: evaluate every 25,000 steps to compare numbers.")
    return "\n".join(lines)


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


# ---------------------------------------------------------------- command


def main(arguments: Sequence[str] | None = None) -> None:
    """
    ``sb3-sample plot``.

    :param arguments: the command line after the command's name; the process's own if None
    """
    parser = argparse.ArgumentParser(
        "sb3-sample plot",
        description="Draw the runs of one task, mean and range over seeds, beside the published curves of that task, "
        "and print a table of both.",
    )
    parser.add_argument(
        "runs",
        nargs="+",
        metavar="[LABEL=]FOLDER",
        help="folder of a run, or a folder with runs below it (logs/bro, logs). Runs with the same label are the seeds "
        "of one curve; without a label it is the name of the folder above the run, in the zoo's layout the algorithm, "
        "and in a study that of the agent with its place in the grid",
    )
    parser.add_argument("-e", "--env", help="id of the environment; needed if the runs are of several, or do not say")
    parser.add_argument("-o", "--output", type=Path, help="picture to write (default: the id, as .png)")
    parser.add_argument(
        "-p",
        "--published",
        nargs="+",
        metavar="NAME",
        help=f"published algorithms, 'all' or 'none' (default: {', '.join(PUBLISHED)})",
    )
    parser.add_argument("--metric", choices=list(METRICS), help="default: that of the published curves, else return")
    parser.add_argument(
        "--xlim", nargs="+", type=float, metavar="STEP", help="last, or first and last, simulator step of the picture"
    )
    parser.add_argument(
        "--bin",
        type=int,
        metavar="STEPS",
        help="average training episodes over so many simulator steps (runs without evaluations)",
    )
    parser.add_argument("--all-steps", action="store_true", help="print every step in the table")
    args = parser.parse_args(arguments)
    try:
        _plot(args)
    except (ValueError, ImportError, OSError) as error:
        refuse("plot", error)


def _plot(args: argparse.Namespace) -> None:
    if args.bin is not None and args.bin < 1:
        raise ValueError(f"bin must be at least 1, not {args.bin}")
    if args.xlim is not None and (len(args.xlim) > 2 or [0.0, *args.xlim][-2] >= args.xlim[-1]):
        raise ValueError(f"xlim must be a last step, or a first and a last step, not {args.xlim}")
    env_id, labelled = _labelled_folders(args.runs, args.env)
    published = published_curves(env_id)
    metric = args.metric or (published["metric"].iloc[0] if len(published) else "return")

    labelled = _with_episodes(labelled)
    without_evaluations = [folder for _, folder in labelled if not (folder / EVALUATIONS).exists()]
    for folder in without_evaluations:
        print(f"{folder} has no evaluations.npz: its training episodes are shown, which explore", file=sys.stderr)
    bin_steps = args.bin or _default_bin(without_evaluations)
    groups: dict[str, list[Run]] = {}
    for label, folder in labelled:
        groups.setdefault(label, []).append(read_run(folder, label, metric, bin_steps))
    curves = []
    for label, runs in groups.items():
        data = summarize(runs)
        last = max(run.steps[-1] for run in runs)
        if data["env_step"].iloc[-1] < last:
            print(
                f"{label}: the runs end at different steps, the curve at {data['env_step'].iloc[-1]:,} of {last:,}",
                file=sys.stderr,
            )
        curves.append(Curve(label, data))

    names = [] if args.published == ["none"] else args.published
    curves += select_published(env_id, names, metric)
    if not len(published) and names != []:
        print(f"no curves of {env_id} were published", file=sys.stderr)

    figure = draw(env_id, curves, metric, None if args.xlim is None else tuple([0.0, *args.xlim][-2:]))
    output = args.output or _picture(env_id, args.env is not None)
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output)
    of_task = f"; published{_of_task(env_id)}" if len(curves) > len(groups) and _published_task(env_id) else ""
    print(f"{env_id}, {METRICS[metric]}{of_task}\n\n{format_table(curves, args.all_steps)}\n\nSaved to {output}")


def _picture(env_id: str, is_given: bool) -> Path:
    """The picture's name, if it is not given. A run's file must not choose which of the user's files is replaced."""
    path = Path(env_id.replace("/", "-") + ".png")
    if path.exists() and not is_given and env_id not in gym.registry:
        raise ValueError(f"output must be given: {path} is there, and {env_id!r} is known from the runs' files only")
    return path


def _labelled_folders(arguments: Sequence[str], env_id: str | None) -> tuple[str, list[tuple[str, Path]]]:
    """
    :param arguments: folders, or "label=folder"
    :param env_id: the environment's id, if the user has named it
    :return: the id, and the folders of its runs with their labels
    """
    labelled: list[tuple[str, Path, str | None]] = []
    listed = functools.cache(read_list)
    former: list[Path] = []
    for argument in arguments:
        label, equals, path = argument.partition("=")
        if not equals or Path(argument).exists():
            label, path = "", argument
        folders = find_runs(Path(path))
        for folder in folders:
            found = run_env_id(folder)
            if env_id is not None and found not in (None, env_id):
                if folders == [Path(path)]:
                    raise ValueError(f"runs must be of {env_id}; {folder} is of {found}")
                continue
            if any(folder.samefile(other) for _, other, _ in labelled):
                raise ValueError(f"runs must be named once; {folder} is there twice")
            study = study_of(folder)
            if study is not None and listed(study).is_former(folder):
                former.append(folder)
                continue
            labelled.append((label or _name_of(folder), folder, found))
    for folder in former:
        print(f"{folder} is not in its study's plan any more, and is left out", file=sys.stderr)
    if former and not labelled:
        raise ValueError("runs must be in their study's plan; none of them is any more")
    if not labelled:
        raise ValueError(f"env must be one that the runs are of, not {env_id!r}")
    if env_id is None:
        found_ids = {found for _, _, found in labelled if found is not None}
        if len(found_ids) != 1:
            what = f"the runs are of {', '.join(sorted(found_ids))}" if found_ids else "the runs do not say which it is"
            raise ValueError(f"env must be given: {what}")
        env_id = found_ids.pop()
    return env_id, [(label, folder) for label, folder, _ in labelled]


def _name_of(folder: Path) -> str:
    """Name of a run's curve: in a study that of the agent's folder, which is above the task's."""
    folder = folder.resolve()
    return folder.parent.name if study_of(folder) is None else folder.parents[1].name


if __name__ == "__main__":
    main()
