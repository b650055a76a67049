"""
Write a report of each plan of studies/evidence/QUEUE that has finished runs into its page of ``docs``, between the two
marker lines with the report's title (``sb3-sample study report --markdown``); likewise for results whose page names the
program that made them.

    make evidence-pages
    python studies/evidence_pages.py [PLAN ...] [--grid bro_grid.npz]

The published runs of BRO Fast of size 0.55M, which are shown beside ours, are read from
``bro_grid.npz`` (see ``published_grid.py``): ``--grid``, else in the folder that ``SB3_SAMPLE_REFERENCE`` names, or in
``../shared/reference``. Without this file the pages of ``bro_fast`` and ``bro_fast_seeds`` stay unchanged, and the
program says so.
"""

import argparse
import functools
import math
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from evidence import CHECKOUT, plan_file, queue
from published_grid import read_grid
from rank_tests import markdown, rank_tests

from sb3_sample import study
from sb3_sample.saving.temporary import becoming
from sb3_sample.study.reporting.markdown import around

#: The published runs of ``bro_fast`` and ``bro_fast_seeds``, as in these plans.
GRID = {"agent": "BRO Fast 0.55M", "ratios": [2], "sizes": ["0.55M"]}


def ranks(ours: pd.DataFrame, others: pd.DataFrame | None, steps: tuple[int, ...]) -> str:
    """
    :param ours: a plan's runs
    :param others: the published ones
    :param steps: of the simulator
    :return: the rank tests of both, in Markdown
    """
    assert others is not None
    return markdown({step: rank_tests(ours, others, step) for step in steps})


def figure1(ours: pd.DataFrame, others: pd.DataFrame | None) -> str:
    """
    :param ours: runs of ``mbma_figure1_small``
    :param others: None
    :return: MBMA's figure 1 of them, in Markdown
    """
    return runpy.run_path(str(CHECKOUT / "benchmarks" / "rewound_actions.py"))["figure"](ours)


def evaluations(ours: pd.DataFrame, others: pd.DataFrame | None, index: str) -> str:
    """
    :param ours: runs of one agent on several tasks, or of several agents on one
    :param others: None
    :param index: "task" or "agent"
    :return: return, and success where it is recorded, by task or agent at each evaluation, means over the seeds; for
        tasks with their mean, if all have got there; in Markdown
    """
    means = ours.pivot_table(index=index, columns=["metric", "step"], values="value")
    if index == "task":
        means.loc["mean"] = means.mean(skipna=False)
    columns = [column for metric in ("return", "success_rate") for column in means.columns if column[0] == metric]
    lines = [
        f"| {index} | " + " | ".join(f"{metric.removesuffix('_rate')}, {step:,}" for metric, step in columns) + " |",
        "| --- |" + " ---: |" * len(columns),
    ]
    for name, values in means.iterrows():
        cells = [
            "" if math.isnan(values[column]) else f"{values[column]:,.{2 if column[0] == 'success_rate' else 0}f}"
            for column in columns
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


by_task, by_agent = (functools.partial(evaluations, index=index) for index in ("task", "agent"))


class Page(NamedTuple):
    """
    Place of a plan's report.

    :param page: file in ``docs``
    :param title: of the report
    :param options: of ``study report``
    :param beside_grid: whether the published runs of ``GRID`` are shown beside it
    :param table: makes a further Markdown table for the page (see ``put``) from our runs and those beside them
    """

    page: str
    title: str
    options: tuple[str, ...] = ()
    beside_grid: bool = False
    table: Callable[[pd.DataFrame, pd.DataFrame | None], str] | None = None


PAGES = {
    "bro_fast_seeds": Page(
        "results.md",
        "BRO Fast, 0.55M, two tasks",
        ("--groups", "all", "--steps", "50k", "--curves", "none"),
        beside_grid=True,
        table=functools.partial(ranks, steps=(25_000, 50_000)),
    ),
    "bro_fast": Page(
        "results.md",
        "BRO Fast, 0.55M, 14 tasks",
        ("--curves", "none"),
        beside_grid=True,
        table=functools.partial(ranks, steps=(50_000, 100_000)),
    ),
    "sac_dac_vpl": Page("results.md", "SAC, DAC and VPL-SAC", ("--groups", "all")),
    "mbma_figure1_small": Page("many_actions.md", "CartPole, rewound", ("--score", "CartPole-v0=200"), table=figure1),
    "published_agents": Page(
        "after_bro.md", "SimBa, XQC and DR.Q", ("--groups", "all", "--curves", "SimBa (RR=2)", "XQC", "DR.Q")
    ),
    "crossq": Page("after_bro.md", "CrossQ", ("--groups", "all", "--curves", "CrossQ")),
    "crossq_contrib": Page("after_bro.md", "CrossQ of sb3_contrib", ("--groups", "all", "--curves", "CrossQ")),
    "brc": Page("after_bro.md", "BRC, 512 wide", ("--groups", "all", "--curves", "BRO Fast")),
    "simbav2": Page("after_bro.md", "SimbaV2", ("--groups", "all", "--curves", "SimbaV2 (RR=2)")),
    "flash_sac": Page("after_bro.md", "FlashSAC", ("--groups", "all", "--curves", "FlashSAC")),
    # The curves of SimbaV2 and XQC begin at 100,000 steps.
    "best_agent": Page("best_agent.md", "Screening", ("--curves", "BRO", "BRO Fast", "DR.Q")),
    "best_agent_final": Page(
        "best_agent.md", "Final", ("--curves", "BRO", "BRO Fast", "DR.Q", "SimbaV2 (RR=2)", "XQC")
    ),
    "drq": Page("drq.md", "DrQ at 64 by 64", ("--groups", "all", "--curves", "none"), table=by_agent),
    "drqv2": Page("drq.md", "DrQ-v2", ("--groups", "all", "--curves", "none")),
    "srspr": Page("srspr.md", "SR-SPR on Breakout", ("--groups", "all", "--curves", "none")),
    "offline": Page("offline_study.md", "Figure 11 on data of our own"),
    "brc_mt10": Page("multi_task.md", "BRC on MT10", ("--groups", "metaworld", "--curves", "none"), table=by_task),
}
#: Results without a plan.
BY_PROGRAM = ["crossq_contrib", "brc_mt10"]
#: Plans whose page needs more than a report, and where this is described.
ELSEWHERE = {"scaling": "docs/scaling.md has the commands, which fit its laws first"}


def grid() -> Path | None:
    """
    :return: ``bro_grid.npz`` of the reference data, if it exists
    """
    folder = os.environ.get("SB3_SAMPLE_REFERENCE") or CHECKOUT.parent / "shared" / "reference"
    path = Path(folder) / "bro_grid.npz"
    return path if path.exists() else None


def published(plan: str, path: Path) -> pd.DataFrame:
    """
    :param plan: name of a plan
    :param path: ``bro_grid.npz``
    :return: the published runs of the plan's tasks
    """
    tasks = {run.task for run in study.read_plan(plan_file(plan)).runs}
    table = read_grid(path, GRID["agent"], GRID["ratios"], GRID["sizes"])
    return table[table["task"].isin(tasks)]


def write(plan: str, docs: Path, path: Path | None) -> str | None:
    """
    Write a plan's report into its page.

    :param plan: name of the plan
    :param docs: folder of the pages; tables and pictures are in ``evidence`` there
    :param path: ``bro_grid.npz``
    :return: the reason why nothing was written; None if it is written
    :raises CalledProcessError: the report cannot be made; its process has printed the reason
    """
    results, page = docs / "evidence" / f"{plan}.csv", PAGES[plan]
    if not results.exists():
        return "no run has ended"
    if page.beside_grid and path is None:
        return "bro_grid.npz is not here: --grid FILE"
    others = published(plan, path) if page.beside_grid and path is not None else None
    with tempfile.TemporaryDirectory() as folder:
        # The report names files by the paths it is given: those of the checkout, wherever this runs.
        here = Path(folder)
        (here / "docs").symlink_to(docs.resolve())
        (here / "studies").symlink_to(CHECKOUT / "studies")
        command = ["study", "report", f"docs/evidence/{plan}.csv", "--title", page.title, *page.options]
        if plan not in BY_PROGRAM:
            command += ["--plan", str(plan_file(plan).relative_to(CHECKOUT))]
        command += ["--markdown", f"docs/{page.page}", "--pictures", f"docs/evidence/{plan}"]
        if others is not None:
            study.write(others, here / "published.csv")
            command += ["--published", "published.csv"]
        subprocess.run([sys.executable, "-m", "sb3_sample.cli", *command], cwd=here, check=True)
    if page.table is not None:
        put(docs / page.page, page.title, page.table(study.load(results), others))
    return None


def put(page: Path, title: str, text: str) -> None:
    """
    Put a table into a page, between its lines ``<!-- begin: table: TITLE -->`` and ``<!-- end: table: TITLE -->``.

    :param page: file with these lines
    :param title: of the report that the table belongs to
    :param text: the table
    :raises ValueError: the file does not have each of these lines once, in this order
    """
    begin, end = (f"<!-- {side}: table: {title} -->" for side in ("begin", "end"))
    parts = around(page.read_text(encoding="utf-8"), begin, end)
    if parts is None:
        raise ValueError(f"{page} must have a line {begin} and one {end} after it")
    with becoming(page) as file:
        file.write(f"{parts[0]}\n{text}\n{parts[1]}".encode())


def main(given: list[str] | None = None) -> None:
    """
    :param given: arguments of the command line; None: the program's own
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plans", nargs="*", metavar="PLAN", help="default: all of the queue that have runs")
    parser.add_argument("--grid", type=Path, help="bro_grid.npz")
    options = parser.parse_args(given)
    known = PAGES.keys() | ELSEWHERE.keys()
    if unknown := [plan for plan in options.plans if plan not in known]:
        parser.error(f"no page for {', '.join(unknown)}: a plan is one of {', '.join(sorted(known))}")
    if options.grid is not None and not options.grid.exists():
        parser.error(f"--grid: no file {options.grid}")
    failed = False
    for plan in options.plans or [*dict.fromkeys(name for name, _ in queue()), *BY_PROGRAM]:
        try:
            reason = ELSEWHERE.get(plan) or write(plan, CHECKOUT / "docs", options.grid or grid())
        except (ValueError, subprocess.CalledProcessError) as error:
            # The other pages are still written.
            reason, failed = f"not written: {error}", True
        print(f"{plan}: {reason or f'docs/{PAGES[plan].page}'}", flush=True)
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    main()
