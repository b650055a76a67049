"""``sb3-sample study report``, also as a function."""

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from sb3_sample.envs.scores import Score
from sb3_sample.plots import PUBLISHED
from sb3_sample.saving.temporary import becoming
from sb3_sample.study import table as tables
from sb3_sample.study.aggregate import REPS, Groups, Scores, check_samples, warn_of_unknown
from sb3_sample.study.analysis_command import add_intervals, add_runs, add_scores, refusing, steps_of
from sb3_sample.study.reporting import html
from sb3_sample.study.reporting import markdown as markdown_pages
from sb3_sample.study.reporting.content import build
from sb3_sample.study.reporting.pieces import Report
from sb3_sample.study.reporting.reading import Source, gather
from sb3_sample.study.scaling.files import read_laws
from sb3_sample.study.scaling.result import Laws


def report(
    folders: Source | Iterable[Source],
    path: str | Path | None = None,
    *,
    markdown: str | Path | None = None,
    pictures: str | Path | None = None,
    title: str | None = None,
    plan: str | Path | None = None,
    published: Sequence[str | Path] = (),
    curves: Sequence[str] | None = None,
    steps: Sequence[int] | None = None,
    groups: Groups | None = None,
    scores: Scores | None = None,
    all_tasks: bool = False,
    laws: Laws | str | Path | None = None,
    reps: int = REPS,
    confidence: float = 0.95,
    seed: int = 0,
) -> Report:
    """
    Write the results of runs as one HTML page, as Markdown with pictures, or both.

    The same runs give the same files, byte by byte.

    :param folders: folders of studies and of runs, tables and files of tables, as for :func:`~sb3_sample.study.read`
    :param path: of the page, ``.html``; None for none
    :param markdown: of a Markdown page, ``.md``; an existing page must have the marker lines of an earlier report with
        this title, and only the text between them is replaced. None for none
    :param pictures: folder of its pictures; ``<page>_files`` beside it if None
    :param title: of the report; the sources' names if None
    :param plan: file of a plan, to list its missing runs; the folder of a study has its own plan. A source's label must
        then be an agent of the plan
    :param published: additional runs of others, each a name as for :func:`~sb3_sample.study.published_runs` or a file
        of a table. They have intervals; without ``folders`` they are the runs compared
    :param curves: published algorithms whose curves, available only as statistics over seeds, are drawn beside the
        runs, named as in ``sb3-sample plot``; none if empty; None for BRO, BRO Fast and SAC where available
    :param steps: simulator steps at which averages are reported; None for the last step that half of each agent's runs
        have reached
    :param groups: of tasks, see :func:`~sb3_sample.study.aggregate`
    :param scores: of tasks without a common score, likewise
    :param all_tasks: whether to average each agent over all its tasks, not only over those on which every agent has
        reached the step
    :param laws: scaling laws to include, from :func:`~sb3_sample.study.scaling.fit` or a file of them
    :param reps: bootstrap samples
    :param confidence: of the intervals
    :param seed: of the bootstrap
    :return: the content
    :raises ValueError: an argument is out of range, a file is damaged, or a source has no run
    :raises ImportError: rliable, Jinja or matplotlib is not installed
    :raises OSError: a file cannot be read or written
    """
    check_samples(reps, confidence)
    if path is None and markdown is None:
        raise ValueError("path must be given, or markdown")
    for name, each, ending in (("path", path, ".html"), ("markdown", markdown, ".md")):
        if each is not None and Path(each).suffix != ending:
            raise ValueError(f"{name} must end in {ending}, not {str(each)!r}")
    if pictures is not None and markdown is None:
        raise ValueError("pictures are those of markdown, which is not given")
    of_runs = laws if laws is None or isinstance(laws, Laws) else read_laws(laws)
    gathered = gather(folders, published, plan)
    warn_of_unknown(gathered.table, scores)
    gathered.scored_by = tuple(each.metric for each in (scores or {}).values() if isinstance(each, Score))
    found = build(
        gathered,
        title=title or ", ".join(gathered.titles),
        curves=curves,
        steps=steps,
        groups=groups,
        scores=scores,
        all_tasks=all_tasks,
        reps=reps,
        confidence=confidence,
        seed=seed,
        laws=of_runs,
    )
    if path is not None:
        text = html.page(found)
        place = Path(path)
        place.parent.mkdir(parents=True, exist_ok=True)
        with becoming(place) as file:
            file.write(text.encode())
    if markdown is not None:
        markdown_pages.write(found, Path(markdown), None if pictures is None else Path(pictures))
    return found


def _default_path(sources: Sequence[str]) -> Path:
    """``report.html`` in the source if it is the only one and a folder, else in the working directory."""
    if len(sources) == 1:
        _, path = tables.labelled(sources[0])
        if path.is_dir():
            return path / "report.html"
    return Path("report.html")


def _add(parser: argparse.ArgumentParser) -> None:
    add_runs(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE.html", help="the page (default: report.html in FOLDER)"
    )
    parser.add_argument(
        "--markdown",
        type=Path,
        metavar="FILE.md",
        help="write Markdown instead, or besides -o: a new file, or between the lines around an earlier report of the "
        "same title in one that is there",
    )
    parser.add_argument(
        "--pictures", type=Path, metavar="DIR", help="folder of the pictures of --markdown (default: FILE_files)"
    )
    parser.add_argument("--title", help="of the report (default: the names of the folders)")
    parser.add_argument(
        "--plan", type=Path, metavar="FILE", help="plan of runs that are no study's folder, to say which are missing"
    )
    parser.add_argument(
        "-p",
        "--published",
        nargs="+",
        default=[],
        metavar="FILE",
        help="runs of others besides: tables (.csv, .parquet) as the table command writes them, or names of those that "
        "are in the package, BRO and 'BRO Fast'",
    )
    parser.add_argument(
        "--curves",
        nargs="+",
        metavar="NAME",
        help="published algorithms whose curves are drawn beside the runs, as of sb3-sample plot; 'all' or 'none' "
        f"(default: {', '.join(PUBLISHED)})",
    )
    parser.add_argument(
        "--steps",
        nargs="+",
        type=steps_of,
        metavar="STEP",
        help="simulator steps at which averages are told, as 100k or 1M; the last is that of the profiles (default: "
        "the last that half of each agent's runs have reached)",
    )
    parser.add_argument(
        "--all-tasks",
        action="store_true",
        help="average each agent over all its tasks, not over those that every agent has reached the step on",
    )
    parser.add_argument(
        "--laws", type=Path, metavar="FILE.json", help="scaling laws, as sb3-sample scaling fit -o writes them"
    )
    add_scores(parser, planned=False)
    add_intervals(parser)


def _run(options: argparse.Namespace) -> None:
    with refusing("study report"):
        output = options.output
        if output is None and options.markdown is None:
            output = _default_path(options.sources)
        report(
            options.sources,
            output,
            markdown=options.markdown,
            pictures=options.pictures,
            title=options.title,
            plan=options.plan,
            published=options.published,
            curves=[] if options.curves == ["none"] else options.curves,
            steps=options.steps,
            groups=options.groups,
            scores=dict(options.score),
            all_tasks=options.all_tasks,
            laws=options.laws,
            reps=options.reps,
            confidence=options.confidence,
            seed=options.seed,
        )
        for path in (output, options.markdown):
            if path is not None:
                print(f"Saved to {path}")


#: The command: its help, the function that adds its arguments, and the function that runs it.
COMMAND = ("write what the runs have come to as one page, HTML or Markdown", _add, _run)
