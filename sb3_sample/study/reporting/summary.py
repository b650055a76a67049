"""Beginning of a report: what was compared, which agent is better and how certainly, and what is missing."""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from sb3_sample.study.plan import Run
from sb3_sample.study.reporting.facts import Facts
from sb3_sample.study.reporting.pieces import STEPS, Interval, counted, cut, interval_text, p_text, range_text
from sb3_sample.study.reporting.reading import Gathered
from sb3_sample.study.states import DONE, FAILED
from sb3_sample.study.table import RUN

#: Most agents that are named.
NAMED = 3


def summary(gathered: Gathered, facts: Facts) -> list[tuple[str, list[str]]]:
    """
    :param gathered: runs
    :param facts: their numbers
    :return: headings with sentences on the comparison, its result, and what is missing
    """
    return [
        ("Compared", _compared(gathered)),
        ("Result", _result(gathered, facts)),
        ("Missing", _missing(gathered, facts)),
    ]


def _compared(gathered: Gathered) -> list[str]:
    own = [agent for agent in gathered.agents if agent not in gathered.published]
    if not own:
        planned = list(dict.fromkeys(each.run.label for state in gathered.states for each in state.runs))
        return ["Nothing yet.", *([f"Planned: {_listed(planned)}."] if planned else [])]
    rows = gathered.table[gathered.table["agent"].isin(own)]
    seeds = rows[RUN].drop_duplicates().groupby(["agent", "task"]).size()
    steps = gathered.evaluated.loc[lambda found: found["agent"].isin(own), "step"]
    up_to = f", up to {steps.max():,} {STEPS}" if len(steps) else ""
    found = [
        f"{_listed(own)}.",
        f"{counted(rows['task'].nunique(), 'task')}, {range_text(seeds, 'seed')} each{up_to}.",
    ]
    return found + ([f"Beside them: {_listed(gathered.published)}."] if gathered.published else [])


def _listed(names: Sequence[str]) -> str:
    shown = names if len(names) <= NAMED + 1 else names[:NAMED]
    more = len(names) - len(shown)
    return ", ".join(cut(name) for name in shown) + (f" and {more} more" if more else "")


def _result(gathered: Gathered, facts: Facts) -> list[str]:
    if facts.averages is None:
        return [f"No averages. {facts.reason}"]
    rows = facts.at(facts.step)
    found = [(cut(row.agent), Interval(row.iqm, row.low, row.high)) for row in rows.itertuples()]
    named = ", ".join(f"{agent} {interval_text(value)}" for agent, value in found[:NAMED])
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    where = f"at {facts.step:,} steps over {counted(len(facts.groups[facts.group]), 'task')}"
    where += f" of {facts.group}" if len(facts.groups[facts.group]) < len(facts.tasks) else ""
    words = f"Interquartile mean of the scores {where}: {named}{more}."
    lost = _lost(gathered, facts)
    if facts.improvement is None:
        verdict = ["There is one agent." if len(found) == 1 else f"{found[0][0]} has the highest average."]
    else:
        best = facts.improvement.iloc[0]
        chance = Interval(best["probability"], best["low"], best["high"])
        favoured = best["x"] if chance.value > 0.5 else best["y"]
        verdict = _verdict(
            cut(best["x"]),
            cut(best["y"]),
            chance,
            best["p"],
            1 - facts.confidence,
            is_whole=not any(favoured in counts for counts in lost.values()),
        )
    verdict += _lost_text(lost, list(rows["agent"]))
    if (rows["runs"] == rows["tasks"]).all():
        verdict.append("There are no intervals, since no task has a second run: nothing is certain here.")
    elif single := [agent for agent, value in found if math.isnan(value.low)]:
        verdict.append(f"There is no interval where a task has a single run: {_listed(single)}.")
    return [*verdict, words]


def _lost(gathered: Gathered, facts: Facts) -> dict[str, Counter[str]]:
    """
    Count by agent the runs that have failed, or may have failed (planned, but not here), and are in no average: without
    its worst runs an agent looks better than it is.
    """
    ends = gathered.evaluated.groupby(["agent", "task", "seed"])["step"].max()
    heads = [
        (row.agent, json.loads(row.arguments))
        for row in gathered.table[["agent", "arguments"]].drop_duplicates().itertuples()
        if row.agent not in gathered.published
    ]

    def counts(runs: Sequence[tuple[str, Run]]) -> Counter[str]:
        found: Counter[str] = Counter()
        for name, run in runs:
            for agent in {
                agent
                for agent, given in heads
                # With its arguments if these distinguish agents of one name.
                if (agent == name or agent.startswith(f"{name} (")) and _is_of_grid(run, given)
            }:
                found[agent] += ends.get((agent, run.task, run.seed), -1) < facts.step
        return +found

    failed = [
        (label or each.run.agent, each.run)
        for state, label in zip(gathered.states, gathered.labels, strict=True)
        for each in state.of(FAILED)
    ]
    return {"failed": counts(failed), "planned": counts([(run.agent, run) for run in missing_runs(gathered)])}


def _lost_text(lost: Mapping[str, Counter[str]], agents: Sequence[str]) -> list[str]:
    """Sentences on runs that are in no average, one for all agents that lack the same number."""
    found = []
    for kind, counts in lost.items():
        together: dict[int, list[str]] = {}
        for agent in agents:
            if n := counts[agent]:
                together.setdefault(n, []).append(agent)
        for n, those in together.items():
            state = f"{'is' if n == 1 else 'are'} {'not counted' if kind == 'failed' else 'not here'}"
            favoured = f": {'' if kind == 'failed' else 'if failed, '}the comparison favours "
            if len(those) == 1:
                whose, end = cut(those[0]), f"{favoured}it"
            elif len(those) == len(agents):
                whose, end = "each agent", ""
            else:
                whose, end = f"each of {', '.join(map(cut, those))}", f"{favoured}them"
            found.append(f"{counted(n, f'{kind} run')} of {whose} {state}{end}.")
    return found


def _verdict(x: str, y: str, chance: Interval, p: float, level: float, is_whole: bool) -> list[str]:
    """
    Probability of improvement, in words, of the two agents with the highest averages. A verdict needs the interval,
    which is too narrow with few runs, the permutation test, and all runs of the favoured agent.
    """
    why = f"A run of {x} beats one of {y} on the same task with probability {interval_text(chance)}, p = {p_text(p)}."
    if chance.low <= 0.5 <= chance.high:
        return [f"{x} and {y} cannot be told apart.", why]
    unsure = f"{x} is ahead of {y}, without certainty."
    if math.isnan(chance.low):
        return [unsure, why, "This probability has no interval, since a task has a single run of one of them."]
    if p >= level:
        few = f"Too few runs for a verdict: p of the permutation test must be below {level:.3g}."
        return [unsure, why, few]
    if not is_whole:
        return [unsure, why]
    if chance.low > 0.5:
        return [f"{x} is better than {y}.", why]
    return [f"{x} is ahead of {y} by the averages, but its runs lose to those of {y} more often than not.", why]


def _missing(gathered: Gathered, facts: Facts) -> list[str]:
    found = []
    for state in gathered.states:
        rest = ", ".join(f"{n} {name}" for name, n in state.counts.items() if name != DONE and n)
        where = f" of {state.folder.path.name}" if len(gathered.states) > 1 else ""
        found.append(
            f"{state.counts[DONE]} of {counted(len(state.runs), 'planned run')}{where} are done"
            + (f"; {rest}." if rest else ".")
        )
    if gathered.planned:
        n = sum(map(len, missing(gathered).values()))
        found.append(f"{len(gathered.planned) - n} of {counted(len(gathered.planned), 'planned run')} are here.")
    if facts.steps:
        own = gathered.evaluated[~gathered.evaluated["agent"].isin(gathered.published)]
        short = int((own.groupby(RUN, dropna=False)["step"].max() < facts.step).sum())
        if short:
            found.append(f"{counted(short, 'run')} {'has' if short == 1 else 'have'} not got to {facts.step:,} steps.")
    if pairs := holes(gathered):
        found.append(f"{counted(len(pairs), 'pair')} of agent and task {'has' if len(pairs) == 1 else 'have'} no run.")
    if facts.lacking:
        found.append(f"{counted(len(facts.lacking), 'task')} {'has' if len(facts.lacking) == 1 else 'have'} no score.")
    found += [f"{cut(agent)} is in no average: {reason}." for agent, reason in facts.left_out.items()]
    return found or ["Nothing."]


def holes(gathered: Gathered) -> list[tuple[str, str]]:
    """
    :param gathered: runs
    :return: agents and tasks that have runs, but not with each other
    """
    own = gathered.table[~gathered.table["agent"].isin(gathered.published)]
    there = set(zip(own["agent"], own["task"], strict=True))
    return [(a, t) for a in own["agent"].unique() for t in own["task"].unique() if (a, t) not in there]


def missing(gathered: Gathered) -> dict[tuple[str, str], list[int]]:
    """
    :param gathered: runs
    :return: seeds of the given plan's runs that are missing, by agent (with the grid's arguments) and task
    """
    found: dict[tuple[str, str], list[int]] = {}
    for run in missing_runs(gathered):
        found.setdefault((run.label, run.task), []).append(run.seed)
    return found


def _is_of_grid(run: Run, given: Mapping[str, Any]) -> bool:
    """Whether arguments are those of a planned run's place in the grid."""
    return all(given.get(key) == value for key, value in run.grid.items())


def missing_runs(gathered: Gathered) -> list[Run]:
    """
    :param gathered: runs
    :return: the given plan's runs that are missing
    """
    runs = gathered.runs
    arguments = [json.loads(text) for text in runs["arguments"]]
    known = list(zip(runs["agent"], arguments, runs["task"], runs["seed"], strict=True))
    return [
        run
        for run in gathered.planned
        if not any(
            (agent, task, seed) == (run.agent, run.task, run.seed) and _is_of_grid(run, given)
            for agent, given, task, seed in known
        )
    ]
