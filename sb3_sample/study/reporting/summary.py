"""Beginning of a report: what was compared, which agent is better and how certainly, and what is missing."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from sb3_sample.study.reporting.absent import holes, lost, unevaluated, without_runs
from sb3_sample.study.reporting.facts import Facts
from sb3_sample.study.reporting.pieces import (
    STEPS,
    Interval,
    counted,
    distinct,
    interval_text,
    one_line,
    p_text,
    range_text,
)
from sb3_sample.study.reporting.reading import Gathered
from sb3_sample.study.states import DONE
from sb3_sample.study.table import RUN

#: Most agents that are named.
NAMED = 3


def summary(gathered: Gathered, facts: Facts) -> list[tuple[str, list[str]]]:
    """
    :param gathered: runs
    :param facts: their numbers
    :return: headings with sentences on the comparison, its result, and what is missing
    """
    absent = without_runs(gathered)
    short = distinct(dict.fromkeys([*gathered.agents, *absent]))
    return [
        ("Compared", _compared(gathered, absent, short)),
        ("Result", _result(gathered, facts, short)),
        ("Missing", _missing(gathered, facts, short)),
    ]


def _compared(gathered: Gathered, absent: Iterable[str], short: Mapping[str, str]) -> list[str]:
    rows = gathered.evaluated[~gathered.evaluated["agent"].isin(gathered.published)]
    evaluated = set(rows["agent"])
    ours = [agent for agent in gathered.agents if agent not in gathered.published]
    rest = [*(agent for agent in ours if agent not in evaluated), *absent]
    found = ["Nothing yet."]
    if evaluated:
        seeds = rows[RUN].drop_duplicates().groupby(["agent", "task"]).size()
        found = [
            f"{_listed([agent for agent in ours if agent in evaluated], short)}.",
            f"{counted(rows['task'].nunique(), 'task')}, {range_text(seeds, 'seed')} each, up to "
            f"{rows['step'].max():,} {STEPS}.",
        ]
    if rest:
        found.append(f"Not evaluated: {_listed(rest, short)}.")
    return found + ([f"Beside them: {_listed(gathered.published, short)}."] if gathered.published else [])


def _listed(names: Sequence[str], short: Mapping[str, str]) -> str:
    shown = names if len(names) <= NAMED + 1 else names[:NAMED]
    more = len(names) - len(shown)
    return ", ".join(short[name] for name in shown) + (f" and {more} more" if more else "")


def _result(gathered: Gathered, facts: Facts, short: Mapping[str, str]) -> list[str]:
    if facts.averages is None:
        return [f"No averages. {facts.reason}"]
    rows = facts.at(facts.step)
    found = [(row.agent, Interval(row.iqm, row.low, row.high)) for row in rows.itertuples()]
    named = ", ".join(f"{short[agent]} {interval_text(value)}" for agent, value in found[:NAMED])
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    n_tasks, is_common = facts.number_of_tasks(facts.group)
    where = f" over {n_tasks}" if is_common else f", each over its own {n_tasks}"
    where += f" of {facts.group}" if len(facts.groups[facts.group]) < len(facts.tasks) else ""
    words = f"Interquartile mean of the scores at {facts.step:,} steps{where}: {named}{more}."
    missed = lost(gathered, facts.step)
    if facts.improvement is None:
        why = facts.why_no_pair(gathered)
        verdict = [f"{why[0].upper()}{why[1:]}."]
    else:
        best = facts.improvement.iloc[0]
        chance = Interval(best["probability"], best["low"], best["high"])
        favoured = best["x"] if chance.value > 0.5 else best["y"]
        verdict = _verdict(
            one_line(best["x"]),
            one_line(best["y"]),
            chance,
            best["p"],
            1 - facts.confidence,
            is_whole=not any(favoured in counts for counts in missed.values()),
        )
    verdict += _lost_text(missed, list(rows["agent"]), short)
    if (rows["runs"] == rows["tasks"]).all():
        verdict.append("There are no intervals, since no task has a second run: nothing is certain here.")
    elif single := [agent for agent, value in found if math.isnan(value.low)]:
        verdict.append(f"There is no interval where a task has a single run: {_listed(single, short)}.")
    return [*verdict, words]


def _lost_text(missed: Mapping[str, Counter[str]], agents: Sequence[str], short: Mapping[str, str]) -> list[str]:
    """Sentences on runs that are in no average, one for all agents that lack the same number."""
    found = []
    for kind, counts in missed.items():
        together: dict[int, list[str]] = {}
        for agent in agents:
            if n := counts[agent]:
                together.setdefault(n, []).append(agent)
        for n, those in together.items():
            state = f"{'is' if n == 1 else 'are'} {'not counted' if kind == 'failed' else 'not here'}"
            favoured = f": {'' if kind == 'failed' else 'if failed, '}the comparison favours "
            if len(those) == 1:
                whose, end = short[those[0]], "" if len(agents) == 1 else f"{favoured}it"
            elif len(those) == len(agents):
                whose, end = "each agent", ""
            else:
                whose, end = f"each of {', '.join(short[agent] for agent in those)}", f"{favoured}them"
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
        unsure = unsure if chance.value > 0.5 else f"{x} and {y} cannot be told apart."
        return [unsure, why, "This probability has no interval, since a task has a single run of one of them."]
    if p >= level:
        few = f"Too few runs for a verdict: p of the permutation test must be below {level:.3g}."
        return [unsure, why, few]
    if not is_whole:
        return [unsure, why]
    if chance.low > 0.5:
        return [f"{x} is better than {y}.", why]
    return [f"{x} is ahead of {y} by the averages, but its runs lose to those of {y} more often than not.", why]


def _missing(gathered: Gathered, facts: Facts, short: Mapping[str, str]) -> list[str]:
    found = []
    for state in gathered.states:
        rest = ", ".join(f"{n} {name}" for name, n in state.counts.items() if name != DONE and n)
        where = f" of {state.folder.path.name}" if len(gathered.states) > 1 else ""
        found.append(
            f"{state.counts[DONE]} of {counted(len(state.runs), 'planned run')}{where} are done"
            + (f"; {rest}." if rest else ".")
        )
    if gathered.planned:
        n = len(gathered.missing)
        found.append(f"{len(gathered.planned) - n} of {counted(len(gathered.planned), 'planned run')} are here.")
    if facts.steps:
        own = gathered.evaluated[~gathered.evaluated["agent"].isin(gathered.published)]
        late = int((own.groupby(RUN, dropna=False)["step"].max() < facts.step).sum())
        if late:
            found.append(f"{counted(late, 'run')} {'has' if late == 1 else 'have'} not got to {facts.step:,} steps.")
    if n := unevaluated(gathered):
        found.append(f"{counted(n, 'run')} {'has' if n == 1 else 'have'} no evaluation yet.")
    if pairs := holes(gathered):
        verb = "has" if len(pairs) == 1 else "have"
        found.append(f"{counted(len(pairs), 'pair')} of agent and task {verb} no evaluated run.")
    if facts.lacking:
        found.append(f"{counted(len(facts.lacking), 'task')} {'has' if len(facts.lacking) == 1 else 'have'} no score.")
    found += [f"{short[agent]} is in no average: {reason}." for agent, reason in facts.left_out.items()]
    return found or ["Nothing."]
