"""Content of a report: the runs, which agent is better and how certainly, their costs, and their settings."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sb3_sample.plots import METRICS, Curve
from sb3_sample.study.aggregate import Groups, Scores, score_for
from sb3_sample.study.reporting.absent import holes, missing
from sb3_sample.study.reporting.curves import Curves, Looks, dressed, task_curves
from sb3_sample.study.reporting.facts import Facts, compute
from sb3_sample.study.reporting.laws import scaling
from sb3_sample.study.reporting.pieces import (
    BESIDE,
    DASH,
    STEPS,
    TITLE,
    Agent,
    Cell,
    Count,
    Dots,
    Figure,
    Interval,
    Line,
    Lines,
    Report,
    Section,
    Table,
    Text,
    counted,
    distinct,
    p_text,
)
from sb3_sample.study.reporting.reading import Gathered
from sb3_sample.study.reporting.summary import summary
from sb3_sample.study.scaling.result import Laws
from sb3_sample.study.states import FAILED, STATES, Status
from sb3_sample.study.table import RUN
from sb3_sample.version import __version__

#: Most rows of a table of runs that is not folded.
UNFOLDED = 12
#: Circumstances in checkpoints and in records beside tables, in the order of the report's table.
_MADE_WITH = (
    "sb3_sample", "commit", "torch", "stable_baselines3", "gymnasium", "mujoco", "numpy", "python", "processor",
    "device", "threads", "torch threads", "made_by",
)  # fmt: skip
_STATISTICS = {"iqm": "IQM", "mean": "mean", "median": "median", "optimality_gap": "optimality gap"}


def build(
    gathered: Gathered,
    *,
    title: str,
    curves: Sequence[str] | None,
    steps: Sequence[int] | None,
    groups: Groups | None,
    scores: Scores | None,
    all_tasks: bool,
    reps: int,
    confidence: float,
    seed: int,
    laws: Laws | None = None,
) -> Report:
    """
    :param gathered: runs
    :param title: of the report
    :param curves: published algorithms beside the runs
    :param steps: see :func:`~sb3_sample.study.reporting.facts.compute`
    :param groups: likewise
    :param scores: likewise
    :param all_tasks: likewise
    :param reps: likewise
    :param confidence: likewise
    :param seed: likewise
    :param laws: scaling laws to include
    :return: the report
    :raises ValueError: an argument is out of range
    """
    facts = compute(
        gathered,
        steps=steps,
        groups=groups,
        scores=scores,
        all_tasks=all_tasks,
        reps=reps,
        confidence=confidence,
        seed=seed,
    )
    drawn = [task_curves(gathered, task, scores, curves) for task in gathered.tasks]
    looks = dressed(gathered, drawn)
    how = f"{confidence:.0%} intervals, {reps:,} samples of rliable's stratified bootstrap (seed {seed})"
    sections = [
        _runs(gathered),
        _averages(facts, looks.runs, how),
        _training(facts, drawn, looks, scores),
        _tasks(drawn, looks),
        _profiles(facts, looks.runs),
        _improvement(gathered, facts, looks.runs),
        *([] if laws is None else [scaling(laws)]),
        _costs(gathered),
        _settings(gathered, how),
    ]
    return Report(title, summary(gathered, facts), [each for each in sections if each.parts], __version__)


# ---------------------------------------------------------------- sections


def _runs(gathered: Gathered) -> Section:
    parts: list[Any] = []
    for state in gathered.states:
        parts += _of_study(state)
    if absent := missing(gathered):
        lost: list[list[Cell]] = [[agent, task, _ranges(seeds)] for (agent, task), seeds in sorted(absent.items())]
        parts.append(Table("Planned runs that are not here", ["agent", "task", "seeds"], lost, len(lost) > UNFOLDED))
    rows: list[list[Cell]] = []
    ends = gathered.evaluated.groupby(RUN, sort=False, dropna=False)["step"].max().reset_index()
    for (agent, task), found in ends.groupby(["agent", "task"], sort=False):
        rows.append(
            [agent, task, len(found), _ranges(found["seed"]), int(found["step"].min()), int(found["step"].max())]
        )
    for agent, task in holes(gathered):
        rows.append([agent, task, 0, "", None, None])
    head = ["agent", "task", "runs", "seeds", "shortest run", "longest run"]
    if rows:
        caption = f"Runs that were evaluated, and after how many {STEPS} they end"
        parts.append(Table(caption, head, rows, folded=bool(gathered.states) or len(rows) > UNFOLDED))
    return Section("runs", "Runs", [*parts, *gathered.notes])


def _ranges(seeds: Iterable[Any]) -> str:
    """Seeds in words, such as 0 to 4 and 7."""
    parts: list[list[int]] = []
    for seed in sorted(int(seed) for seed in seeds if seed is not pd.NA):
        if parts and seed == parts[-1][-1] + 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    words = [str(part[0]) if len(part) == 1 else f"{part[0]}{DASH}{part[-1]}" for part in parts]
    return ", ".join(words)


def _of_study(state: Status) -> list[Table | Text]:
    by_agent: dict[str, Counter[str]] = {}
    by_task: dict[tuple[str, str], Counter[str]] = {}
    for each in state.runs:
        by_agent.setdefault(each.run.label, Counter())[each.state] += 1
        by_task.setdefault((each.run.label, each.run.task), Counter())[each.state] += 1

    def cells(counts: Counter[str]) -> list[Cell]:
        return [Count(counts[name], name) for name in STATES] + [sum(counts.values())]

    head = [*STATES, "planned"]
    parts: list[Table | Text] = [
        Table("Runs of the study", ["agent", *head], [[agent, *cells(counts)] for agent, counts in by_agent.items()]),
        Table(
            "Runs of the study by task",
            ["agent", "task", *head],
            [[*key, *cells(counts)] for key, counts in by_task.items()],
            folded=True,
        ),
    ]
    for each in state.of(FAILED):
        times = counted(each.outcome.attempts, "attempt")
        parts.append(Text(f"Failed after {times}: {each.run.title}", each.outcome.traceback))
    return parts


def _averages(facts: Facts, agents: dict[str, Agent], how: str) -> Section:
    parts: list[Any] = []
    if facts.averages is None:
        parts.append(f"There are no averages. {facts.reason}")
    else:
        parts.append(_normalised(facts))
        rows = facts.at(facts.step)
        if rows["low"].isna().any():
            parts.append("Agents with a single run on a task have no interval.")
        panels = []
        for key, name in _STATISTICS.items():
            prefix = "" if key == "iqm" else f"{key}_"
            dots = [
                (
                    agents[row["agent"]].short,
                    agents[row["agent"]],
                    Interval(row[key], row[f"{prefix}low"], row[f"{prefix}high"]),
                )
                for _, row in rows.iterrows()
            ]
            panels.append(Dots(name, dots))
        caption = f"Scores at {facts.step:,} steps, {facts.group}: {how}. Higher is better, but for the optimality gap."
        parts += [Figure("averages", caption, panels, []), _averages_table(facts)]
    if facts.lacking:
        why: list[list[Cell]] = [[task, reason] for task, reason in facts.lacking.items()]
        parts.append(Table("Tasks without a score, in no average", ["task", "why"], why))
    return Section("averages", "Averages over tasks", [*parts, *facts.notes])


def _normalised(facts: Facts) -> str:
    n, of = len(facts.tasks), facts.n_scored
    number, is_common = facts.number_of_tasks()
    if is_common:
        which = "all of them" if n == of else f"of {of}: those that every agent has reached {facts.step:,} steps on"
    else:
        which = f"of {of}, each agent over its own"
    return (
        "Scores: DeepMind Control's returns over 1,000; success rates as they are; MuJoCo's returns over a "
        "reference's; those of the games of Atari-100k between random play and a human; others as they were given. "
        "Nothing is clipped. Averages are over "
        f"{number} ({which})."
    )


def _averages_table(facts: Facts) -> Table:
    rows: list[list[Cell]] = []
    for group in facts.groups:
        for step in facts.steps:
            for row in facts.at(step, group).to_dict("records"):
                cells: list[Cell] = [row["agent"], group, step]
                for key in _STATISTICS:
                    prefix = "" if key == "iqm" else f"{key}_"
                    cells.append(Interval(row[key], row[f"{prefix}low"], row[f"{prefix}high"]))
                rows.append([*cells, int(row["tasks"]), int(row["runs"])])
    head = ["agent", "group", "step", *_STATISTICS.values(), "tasks", "runs"]
    return Table("Averages by group of tasks", head, rows)


def _training(facts: Facts, drawn: Sequence[Curves], looks: Looks, scores: Scores | None) -> Section:
    if facts.curves is None:
        return Section("training", "Training", [])
    panels: list[Lines] = []
    titles = _titles(facts.groups)
    for group in facts.groups:
        rows = facts.curves[facts.curves["group"] == group]
        lines = [
            Line(looks.runs[agent], *(found[name].to_numpy(float) for name in ("step", "iqm", "low", "high")))
            for agent, found in rows.groupby("agent", sort=False)
        ]
        panels.append(Lines(titles[group], STEPS, "IQM of the scores", lines, facts.step))
    shown = list(dict.fromkeys(looks.runs[name] for name in facts.curves["agent"]))
    parts: list[Any] = [Figure("training", "Interquartile mean along the training, with intervals", panels, shown)]
    means, others = _mean_panels(facts, drawn, looks, scores)
    if others:
        caption = (
            "Mean of the tasks' means, beside published curves, of which there are statistics over seeds only: dashed, "
            "without intervals, where they have all tasks of the group"
        )
        parts.append(Figure("means", caption, means, [*shown, *others]))
    return Section("training", "Training", parts)


def _titles(groups: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Titles of the panels of groups."""
    numbers = {group: f": {counted(len(tasks), 'task')}" for group, tasks in groups.items()}
    names = distinct(groups, TITLE - max(map(len, numbers.values())))
    return {group: names[group] + number for group, number in numbers.items()}


def _mean_panels(
    facts: Facts, drawn: Sequence[Curves], looks: Looks, scores: Scores | None
) -> tuple[list[Lines], list[Agent]]:
    """Means over tasks of our agents and of published curves, and the published agents that have such a mean."""
    assert facts.curves is not None
    by_label: dict[str, dict[str, Curve]] = {}
    for each in drawn:
        for curve in each.others:
            by_label.setdefault(curve.label, {})[each.task] = curve
    panels, others = [], {}
    titles = _titles(facts.groups)
    for group, tasks in facts.groups.items():
        rows = facts.curves[facts.curves["group"] == group]
        lines = [
            Line(looks.runs[agent], found["step"].to_numpy(float), found["mean"].to_numpy(float))
            for agent, found in rows.groupby("agent", sort=False)
        ]
        for label, by_task in by_label.items():
            if not set(tasks) <= by_task.keys():
                continue
            curves = [by_task[task].data for task in tasks]
            steps = np.unique(np.concatenate([data["env_step"] for data in curves]))
            first, last = (f(data["env_step"].iloc[i] for data in curves) for f, i in ((max, 0), (min, -1)))
            steps = steps[(steps >= first) & (steps <= min(last, facts.step))]
            values = []
            for task, data in zip(tasks, curves, strict=True):
                score = score_for(task, scores)
                assert score is not None
                values.append(score.of(np.interp(steps, data["env_step"], data["mean"])))
            if steps.max(initial=0) > 0:
                others[label] = looks.curves[label]
                lines.append(Line(looks.curves[label], steps.astype(float), np.mean(values, axis=0)))
        panels.append(Lines(titles[group], STEPS, "mean of the scores", lines, facts.step))
    return panels, list(others.values())


def _tasks(drawn: Sequence[Curves], looks: Looks) -> Section:
    panels: list[Lines] = []
    shown: dict[Agent, None] = {}
    later: dict[str, None] = {}
    titles = distinct((each.task for each in drawn), TITLE)
    for each in sorted(drawn, key=lambda curves: curves.task):
        ours = [name for name in each.own if not looks.runs[name].published] or list(each.own)
        if not ours:
            continue
        ends = [each.own[name].data["env_step"].iloc[-1] for name in ours]
        ends += [run.steps[-1] for name in ours for run in each.under_way[name]]
        end = float(max(ends))
        lines = []
        curves = [(looks.runs[name], curve) for name, curve in each.own.items()]
        for curve in each.others:
            # Of others there is at most the return of an untrained policy.
            if curve.data["env_step"].between(0, end, inclusive="right").any():
                curves.append((looks.curves[curve.label], curve))
            else:
                later.setdefault(curve.label)
        for agent, curve in curves:
            data = curve.data[curve.data["n_seeds"] > 0]
            shown[agent] = None
            has_band = (data["n_seeds"] > 1).any()
            columns = [data[name].to_numpy(float) for name in ("env_step", "mean", "min", "max")]
            lines.append(Line(agent, *columns) if has_band else Line(agent, *columns[:2]))
        for name, runs in each.under_way.items():
            lines += [Line(looks.runs[name], list(run.steps), list(run.values), thin=True) for run in runs]
        y_range = (-0.03, 1.03) if each.metric == "success_rate" else None
        panels.append(Lines(titles[each.task], STEPS, METRICS.get(each.metric, each.metric), lines, end, y_range))
    if not panels:
        return Section("tasks", "Single tasks", [])
    caption = "Mean and range over seeds; thin: runs that have not got as far; dashed: measured and published by others"
    if later:
        caption += f", left out where they begin after the last step shown: {', '.join(later)}"
    order = sorted(shown, key=[*looks.runs.values(), *looks.curves.values()].index)
    return Section("tasks", "Single tasks", [Figure("tasks", caption, panels, order)])


def _profiles(facts: Facts, agents: dict[str, Agent]) -> Section:
    if facts.profiles is None:
        return Section("profiles", "Performance profiles", [])
    lines = [
        Line(agents[agent], *(rows[name].to_numpy(float) for name in ("threshold", "share", "low", "high")))
        for agent, rows in facts.profiles.groupby("agent", sort=False)
    ]
    end = float(facts.profiles["threshold"].max())
    panel = Lines(f"{facts.group}, {facts.step:,} steps", "score", "share of runs above it", lines, end, (-0.03, 1.03))
    caption = "Share of the runs whose score is above a threshold, tasks weighing the same, with intervals"
    return Section("profiles", "Performance profiles", [Figure("profiles", caption, [panel], [x.agent for x in lines])])


def _improvement(gathered: Gathered, facts: Facts, agents: dict[str, Agent]) -> Section:
    section = Section("improvement", "Probability of improvement", [])
    if facts.averages is None:
        return section
    if facts.improvement is None:
        section.parts.append(f"Left out: {facts.why_no_pair(gathered)}.")
        return section
    rows = facts.improvement.to_dict("records")
    values = [Interval(row["probability"], row["low"], row["high"]) for row in rows]
    pairs = [(agents[row["x"]].short, agents[row["y"]].short) for row in rows]
    between = " > " if all(len(x) + len(y) < BESIDE for x, y in pairs) else "\n> "
    names = [between.join(pair) for pair in pairs]
    dots = [(name, agents[row["x"]], value) for name, row, value in zip(names, rows, values, strict=True)]
    which = "" if facts.all_pairs else ", the best agent with each other one"
    caption = (
        f"How likely a run of the first scores more than one of the second on the same task, ties a half, at "
        f"{facts.step:,} steps, {facts.group}{which}; p is that of a permutation test"
    )
    section.parts.append(Figure("improvement", caption, [Dots("probability of improvement", dots, middle=0.5)], []))
    cells: list[list[Cell]] = [
        [row["x"], row["y"], value, p_text(row["p"]), row["tasks"]] for row, value in zip(rows, values, strict=True)
    ]
    section.parts.append(Table("Probability of improvement", ["agent", "over", "probability", "p", "tasks"], cells))
    return section


def _costs(gathered: Gathered) -> Section:
    timed = gathered.table[gathered.table["metric"] == "hours"].sort_values("step", kind="stable")
    ends = timed.groupby(RUN, sort=False, dropna=False)[["step", "value"]].last().reset_index()
    ends = ends[ends["value"] > 0]
    section = Section("costs", "Costs", [])
    if not len(ends):
        return section
    for names, folded in ((["agent"], False), (["agent", "task"], True)):
        rows: list[list[Cell]] = []
        for key, found in ends.groupby(names, sort=False):
            speed = found["step"].sum() / found["value"].sum() / 3_600
            rows.append([*key, len(found), float(found["value"].mean()), float(found["value"].sum()), float(speed)])
        head = [*names, "runs", "hours a run", "hours in all", f"{STEPS} a second"]
        caption = "Time in training and evaluating" + (" by task" if folded else "")
        section.parts.append(Table(caption, head, rows, folded))
    outcomes = [each.outcome for state in gathered.states for each in state.runs if each.outcome.host]
    if outcomes:
        found = Counter((each.host, each.threads) for each in outcomes)
        words = [
            f"{host}: {counted(n, 'run')} with {counted(t, 'thread')} each" for (host, t), n in sorted(found.items())
        ]
        section.parts.append(f"Machines: {'; '.join(words)}.")
    section.parts.append(
        "Times compare only where all ran on one machine, with as many threads and neighbours. Runs that were made "
        "together (--batch-seeds) have the time of all of them each."
    )
    return section


def _settings(gathered: Gathered, how: str) -> Section:
    parts: list[Any] = []
    found: dict[str, dict[str, list[str]]] = {}
    for row in gathered.table[["agent", "arguments"]].drop_duplicates().itertuples():
        for name, value in json.loads(row.arguments).items():
            values = found.setdefault(name, {}).setdefault(row.agent, [])
            text = value if isinstance(value, str) else json.dumps(value)
            values += [] if text in values else [text]
    if found:
        agents = [agent for agent in gathered.agents if any(agent in by_agent for by_agent in found.values())]
        rows: list[list[Cell]] = [
            [name, *(" / ".join(by_agent.get(agent, ["default"])) for agent in agents)]
            for name, by_agent in sorted(found.items())
        ]
        parts.append(Table("Arguments", ["argument", *agents], rows, folded=True))
    if gathered.made_with:
        rows = []
        for name in _MADE_WITH:
            counts = Counter(made[name] for made in gathered.made_with if name in made)
            for value, n in counts.most_common():
                rows.append([name, value, n])
        parts.append(Table("Versions and machines of the runs that say so", ["of", "value", "runs"], rows))
    for source, text in gathered.plans.items():
        parts.append(Text(f"Plan of {source}", text))
    parts.append(
        f"Made by sb3_sample {__version__} (sb3-sample study report) of {', '.join(gathered.names)}; {how}. Steps are "
        "of the simulator, whatever the action repeat."
    )
    return Section("settings", "Settings and versions", parts)
