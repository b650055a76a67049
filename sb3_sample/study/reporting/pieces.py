"""
A report as data, independent of HTML and Markdown: sections of paragraphs, tables, figures and texts.

Names of agents and tasks, tracebacks and settings come from untrusted files: they are unescaped here, and escaped by
the code that writes them into a file.
"""

import dataclasses
import math
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

#: Stands between the two ends of a range, and for missing values.
DASH = "\N{EN DASH}"
#: Unit of all steps.
STEPS = "simulator steps"
#: Number of colours in figures.
N_COLORS = 8
#: Most letters of a name in a sentence, in the title of a panel, and beside dots.
LETTERS, TITLE, BESIDE = 60, 36, 24
#: Name of an argument in the name of an agent, as in "SAC (tau=0.01, gamma=0.9)".
_ARGUMENT = re.compile(r"(?<=[(, ])[\w.]+=")


class Interval(NamedTuple):
    """
    :param value: an estimate
    :param low: lower end of its interval, NaN if there is none
    :param high: upper end
    """

    value: float
    low: float
    high: float


class Count(NamedTuple):
    """
    A number of runs, shown as a badge.

    :param number: how many
    :param state: one of the states of a study
    """

    number: int
    state: str


Cell = str | int | float | Interval | Count | None


class Table(NamedTuple):
    """
    :param caption: what it shows
    :param head: names of the columns
    :param rows: cells
    :param folded: whether it is shown on demand
    """

    caption: str
    head: list[str]
    rows: list[list[Cell]]
    folded: bool = False


class Text(NamedTuple):
    """
    :param title: title of the text
    :param text: lines, shown unchanged, on demand
    """

    title: str
    text: str


@dataclasses.dataclass(frozen=True)
class Agent:
    """
    An agent's look in all figures.

    :param name: its name
    :param color: number of its colour
    :param turn: how often all colours were taken before
    :param published: whether others have measured it; its lines are then dashed
    :param label: its name with additional words for a legend
    :param short: its name beside dots, other than that of any other agent
    """

    name: str
    color: int
    turn: int = 0
    published: bool = False
    label: str = ""
    short: str = ""


class Line(NamedTuple):
    """
    :param agent: agent of the line
    :param x: numbers
    :param y: numbers
    :param low: lower bounds of the band, if there is one
    :param high: upper end
    :param thin: whether it is a single run
    :param bound: whether it is a point that is a lower bound, drawn as a hollow triangle
    """

    agent: Agent
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] | None = None
    high: Sequence[float] | None = None
    thin: bool = False
    bound: bool = False


class Lines(NamedTuple):
    """
    :param title: of the panel
    :param x_label: of the axis
    :param y_label: likewise
    :param lines: the lines drawn
    :param x_end: last x shown
    :param y_range: lowest and highest y, if fixed
    """

    title: str
    x_label: str
    y_label: str
    lines: list[Line]
    x_end: float
    y_range: tuple[float, float] | None = None


class Dots(NamedTuple):
    """
    :param title: of the panel
    :param rows: label (lines of a name, as short as :data:`BESIDE` asks), agent and estimate
    :param middle: x of a line, if there is one
    """

    title: str
    rows: list[tuple[str, Agent, Interval]]
    middle: float | None = None


class Figure(NamedTuple):
    """
    :param name: of its file
    :param caption: what it shows
    :param panels: its parts
    :param agents: agents in its legend; none if the panels name them
    """

    name: str
    caption: str
    panels: Sequence[Lines | Dots]
    agents: list[Agent]


@dataclasses.dataclass
class Section:
    """
    :param name: of its anchor
    :param title: its heading
    :param parts: paragraphs (strings), tables, figures and texts
    """

    name: str
    title: str
    parts: list[str | Table | Figure | Text]


@dataclasses.dataclass
class Report:
    """
    :param title: of the page
    :param summary: headings and sentences on the most important results
    :param sections: the rest
    :param version: of the package
    """

    title: str
    summary: list[tuple[str, list[str]]]
    sections: list[Section]
    version: str


def number(value: float, digits: int = 3) -> str:
    """
    :param value: any number
    :param digits: digits after the point for numbers of the order of 1
    :return: the number as text for readers; a dash for NaN
    """
    if math.isnan(value):
        return DASH
    if abs(value) >= 1_000:
        return f"{value:,.0f}"
    return f"{value:.{digits}f}" if abs(value) < 100 else f"{value:.1f}"


def interval_text(found: Interval) -> str:
    """
    :param found: an estimate
    :return: the estimate with its interval, as text
    """
    if math.isnan(found.low):
        return number(found.value)
    return f"{number(found.value)} ({number(found.low)}{DASH}{number(found.high)})"


def p_text(p: float) -> str:
    """
    :param p: of a test
    :return: p as text for readers, to two digits
    """
    return f"{p:.2g}" if p >= 1e-3 else "below 0.001"


def counted(n: int, noun: str) -> str:
    """
    :param n: a number
    :param noun: of what, in the singular
    :return: both in words
    """
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def range_text(numbers: Iterable[int], noun: str) -> str:
    """
    :param numbers: at least one
    :param noun: of what, in the singular
    :return: the smallest and the largest in words
    """
    found = sorted(numbers)
    return counted(found[0], noun) if found[0] == found[-1] else f"{found[0]:,}{DASH}{found[-1]:,} {noun}s"


def one_line(name: str) -> str:
    """
    :param name: from a file
    :return: the name in one line
    """
    return " ".join("".join(letter if letter.isprintable() else " " for letter in name).split())


def cut(name: str, letters: int = LETTERS) -> str:
    """
    :param name: from a file
    :param letters: that are kept
    :return: the name in one line, cut at its end if it is too long
    """
    text = one_line(name)
    return text if len(text) <= letters else f"{text[: letters - 1]}…"


def distinct(names: Iterable[str], letters: int = LETTERS) -> dict[str, str]:
    """
    Shorten names together, so that no two of them become equal. Names of a grid differ at their ends, or in the middle.

    :param names: from files
    :param letters: most of a short name
    :return: by each name its short form in one line: whole if all fit, else without the names of the arguments, "SAC
        (0.01, 0.9)", if necessary cut at the end or in the middle or, if this leaves equal ones, numbered
    """
    whole = {name: one_line(name) for name in names}
    values = {name: _ARGUMENT.sub("", text) for name, text in whole.items()}
    ends = {name: cut(text, letters) for name, text in values.items()}
    middles = {name: _without_middle(text, letters) for name, text in values.items()}
    for found in (whole, values, ends, middles):
        if max(map(len, found.values()), default=0) <= letters and len(set(found.values())) == len(found):
            return found
    tails = {name: f" #{i}" for i, name in enumerate(whole, 1)}
    return {name: cut(text, letters - len(tails[name])) + tails[name] for name, text in values.items()}


def _without_middle(text: str, letters: int) -> str:
    if len(text) <= letters:
        return text
    end = letters // 2
    return f"{text[: letters - end - 1]}…{text[-end:]}"
