"""
A report as data that know nothing of HTML and Markdown: sections of paragraphs, tables, figures and texts.

Names of agents and tasks, tracebacks and settings come from files that anybody may have written: they stand here as
they are, and whoever writes them into a file escapes them.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

#: Between two ends, and where there is nothing.
DASH = "\N{EN DASH}"
#: The unit of all steps.
STEPS = "simulator steps"
#: Colours that figures have.
N_COLORS = 8
#: Letters of a name in a sentence or a figure.
LETTERS = 36


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
    A number of runs that is shown as a badge.

    :param number: how many
    :param state: of the states of a study
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
    :param title: what it is
    :param text: lines, shown as they are, on demand
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
    :param published: whether others have measured it, which is dashed
    :param label: name with what there is to say of it in a legend
    """

    name: str
    color: int
    turn: int = 0
    published: bool = False
    label: str = ""


class Line(NamedTuple):
    """
    :param agent: whose it is
    :param x: numbers
    :param y: numbers
    :param low: lower end of the band, if there is one
    :param high: upper end
    :param thin: whether it is a run by itself
    :param bound: whether it is a point that is a lower bound, which is a hollow triangle
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
    :param lines: what is drawn
    :param x_end: last x that is shown
    :param y_range: lowest and highest y, where these are fixed
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
    :param rows: label, agent and estimate
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
    :param agents: those in its legend; none if the panels name them
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
    :param summary: heading and sentences of what a reader should know first
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
    :param digits: after the point, for those of the order of 1
    :return: the same for people; a dash for NaN
    """
    if math.isnan(value):
        return DASH
    if abs(value) >= 1_000:
        return f"{value:,.0f}"
    return f"{value:.{digits}f}" if abs(value) < 100 else f"{value:.1f}"


def interval_text(found: Interval) -> str:
    """
    :param found: an estimate
    :return: it with its interval
    """
    if math.isnan(found.low):
        return number(found.value)
    return f"{number(found.value)} ({number(found.low)}{DASH}{number(found.high)})"


def p_text(p: float) -> str:
    """
    :param p: of a test
    :return: the same for people, to two digits
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


def cut(name: str, letters: int = LETTERS) -> str:
    """
    :param name: from a file
    :param letters: that are kept
    :return: the same in one line, cut where it is longer than a sentence can bear
    """
    text = " ".join("".join(letter if letter.isprintable() else " " for letter in name).split())
    return text if len(text) <= letters else f"{text[: letters - 1]}…"
