"""Figures of a report with matplotlib: panels as SVG, whose colours the page chooses, or a figure as PNG."""

import contextlib
import io
import math
import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_sample.extras import needing_matplotlib
from sb3_sample.plots import STYLES
from sb3_sample.study.reporting.pieces import BESIDE, N_COLORS, TITLE, Agent, Dots, Figure, Line, Lines, cut

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

#: Colours that people with colour vision deficiency can tell apart (Okabe and Ito 2008 without yellow and black, with
#: violet and olive added), and their counterparts for a dark background.
LIGHT = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6f3fa0", "#7a7a1f")
DARK = ("#4aa8e8", "#ff8552", "#2fcf9f", "#f0a6cf", "#ffc64d", "#a5dcff", "#b58ae6", "#c9c95a")
#: Colours of text and axes, grid lines, and the bands of published agents in a figure that is a separate file.
INK, GRID, BAND = "#222427", "#d9dce1", "#9aa0a8"
#: The same in an SVG, as placeholders for the page's colours.
_INK, _GRID, _BAND = "#010203", "#030201", "#020301"
#: Line style of published agents, and markers of agents that share a colour, by how often all were taken before.
_DASHED = (0, (4, 2))
_MARKERS = ("o", "s", "D")
#: Width and height of a panel of lines and width of a panel of dots in inches, and panels side by side in a file.
WIDTH, HEIGHT, DOTS_WIDTH, COLUMNS = 4.4, 3.1, 5.4, 3
#: Letters of a legend per inch, and dots of a file per inch.
_LETTERS, _DPI = 13, 100


@contextlib.contextmanager
def _style(ink: str, grid: str) -> Iterator[None]:
    """Fix all matplotlib settings that a figure depends on, so that two drawings are equal to the byte."""
    with needing_matplotlib():
        from matplotlib import style
    settings = {
        "svg.fonttype": "none", "svg.hashsalt": "sb3_sample", "text.parse_math": False, "font.size": 10,
        "text.color": ink, "axes.edgecolor": ink, "axes.labelcolor": ink, "xtick.color": ink, "ytick.color": ink,
        "grid.color": grid, "axes.grid": True, "axes.axisbelow": True, "axes.spines.top": False,
        "axes.spines.right": False, "axes.titlesize": 10.5, "axes.titlelocation": "left", "figure.facecolor": "none",
        "axes.facecolor": "none", "savefig.facecolor": "auto", "legend.frameon": False, "axes.unicode_minus": False,
    }  # fmt: skip
    with style.context(["default", settings]):
        yield


def shortened(name: str, letters: int = TITLE) -> str:
    """
    :param name: of an agent or task, from a file
    :param letters: that are kept
    :return: the name for a figure: in one line, not too long. A non-breaking space protects a leading underscore, which
        matplotlib takes for "not in the legend"
    """
    text = cut(name, letters)
    return f"\u00a0{text}" if text.startswith("_") else text


def svg(panel: Lines | Dots, prefix: str) -> str:
    """
    :param panel: of a figure
    :param prefix: of the ids in it, which makes them unique in a page
    :return: an SVG element whose colours are variables of the page: ``--ink``, ``--grid``, ``--band``, ``--c0``, ...
    :raises ImportError: matplotlib is not installed
    """
    with _style(_INK, _GRID):
        drawing = _drawing(*_size(panel))
        _draw(drawing.add_subplot(), panel, _BAND)
        file = io.StringIO()
        drawing.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    text = file.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(
        r"<metadata>.*?</metadata>|<!--.*?-->|<style.*?</style>|<title>.*?</title>", "", text, flags=re.DOTALL
    )
    names = {_INK: "var(--ink)", _GRID: "var(--grid)", _BAND: "var(--band)"}
    names |= {color: f"var(--c{i})" for i, color in enumerate(LIGHT)}
    colors = re.compile("|".join(names))

    def tag(found: re.Match[str]) -> str:
        inside = found[0].replace("xlink:href", "href")
        inside = re.sub(r'(\bid="|\bhref="#|url\(#)', rf"\g<1>{prefix}-", inside)
        return colors.sub(lambda color: names[color[0]], inside)

    # Only inside tags: the text between them contains names from files.
    text = re.sub(r"<[^>]*>", tag, text)
    head, end, rest = text.partition(">")
    # The page sets the size; the view box keeps the proportions.
    head = re.sub(r' (width|height|xmlns|xmlns:xlink|version)="[^"]*"', "", head)
    return f"{head}{end}{rest}".strip()


def png(figure: Figure) -> bytes:
    """
    :param figure: of a report
    :return: a PNG file of all its panels, with a legend
    :raises ImportError: matplotlib is not installed
    """
    n = len(figure.panels)
    width, height = _size(figure.panels[0])
    columns = min(n, COLUMNS if width == WIDTH else 2)
    rows = -(-n // columns)
    inches = max(width * columns, 2 * WIDTH)
    labels = [_legend_text(agent, int(inches * _LETTERS)) for agent in figure.agents]
    side_by_side = max(int(inches * _LETTERS) // (max(map(len, labels), default=0) + 8), 1)
    lines = sum(label.count("\n") + 1 for label in labels[::side_by_side])
    with _style(INK, GRID):
        drawing = _drawing(inches, rows * height + 0.21 * lines)
        drawing.patch.set_facecolor("white")
        drawing.subplots(rows, columns, squeeze=False)
        for place, panel in zip(drawing.axes, figure.panels, strict=False):
            _draw(place, panel, BAND)
        for place in drawing.axes[n:]:
            place.set_axis_off()
        if labels:
            _legend(drawing, figure.agents, labels, side_by_side)
        file = io.BytesIO()
        drawing.savefig(file, format="png", dpi=_DPI, metadata={"Software": None})
    return file.getvalue()


def dash(agent: Agent) -> str:
    """
    :param agent: an agent
    :return: the dashes of its lines for SVG; empty for none
    """
    return "6 3" if agent.published else ("", "7 2 2 2", "2 2")[min(agent.turn, 2)]


def _drawing(width: float, height: float) -> "Drawing":
    from matplotlib.figure import Figure as Drawing

    return Drawing(figsize=(width, height), layout="constrained")


def _size(panel: Lines | Dots) -> tuple[float, float]:
    if isinstance(panel, Lines):
        return WIDTH, HEIGHT
    lines = max((label.count("\n") + 1 for label, _, _ in panel.rows), default=1)
    return DOTS_WIDTH, 0.75 + (0.12 + 0.18 * lines) * len(panel.rows)


def _look(agent: Agent) -> dict[str, Any]:
    style: Any = _DASHED if agent.published else STYLES[min(agent.turn, len(STYLES) - 1)]
    return {"color": LIGHT[agent.color % N_COLORS], "linestyle": style}


def _draw(axes: "Axes", panel: Lines | Dots, band: str) -> None:
    if isinstance(panel, Lines):
        _draw_lines(axes, panel, band)
    else:
        _draw_dots(axes, panel)
    axes.set_title(shortened(panel.title))


def _draw_lines(axes: "Axes", panel: Lines, band: str) -> None:
    from matplotlib.ticker import EngFormatter

    for line in panel.lines:
        agent, x, y, low, high, thin, bound = _until(line, panel.x_end)
        look = _look(agent)
        if low is not None and high is not None:
            color = band if agent.published else look["color"]
            axes.fill_between(x, low, high, color=color, alpha=0.2, linewidth=0, zorder=1)
        width = 0.8 if thin else 1.5 if agent.published else 2
        marker = None if len(x) != 1 else "^" if bound else _MARKERS[min(agent.turn, 2)]
        face = "none" if bound else look["color"]
        zorder = 2 if agent.published else 3
        if marker is not None and low is not None and high is not None:
            axes.plot([*x, *x], [*low, *high], linewidth=width, zorder=zorder, clip_on=False, **look)
        axes.plot(x, y, linewidth=width, marker=marker, mfc=face, zorder=zorder, clip_on=marker is None, **look)
    axes.set_xlim(0, panel.x_end or 1)
    if panel.y_range is not None:
        axes.set_ylim(*panel.y_range)
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    if panel.x_end >= 1_000:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.locator_params(axis="x", nbins=6)


def _until(line: Line, end: float) -> Line:
    """
    A line up to an x, so that the hidden rest does not affect the axes. Our own is interpolated there; evaluations of
    others may be far apart, and theirs ends with the last one shown.
    """
    x = np.asarray(line.x, float)
    shown = x <= end
    if shown.all():
        return line
    if not shown.any():
        return Line(line.agent, [], [])
    steps = x[shown] if line.agent.published or x[shown][-1] == end else np.append(x[shown], end)
    y, low, high = (None if ys is None else list(np.interp(steps, x, ys)) for ys in (line.y, line.low, line.high))
    return line._replace(x=list(steps), y=y or [], low=low, high=high)


def _draw_dots(axes: "Axes", panel: Dots) -> None:
    for i, (_, agent, (value, low, high)) in enumerate(panel.rows):
        color = LIGHT[agent.color % N_COLORS]
        alone = math.isnan(low)
        if not alone:
            alpha = 0.25 if agent.published else 0.5
            axes.plot([low, high], [i, i], color=color, linewidth=9, alpha=alpha, solid_capstyle="butt")
        marker = _MARKERS[min(agent.turn, 2)] if alone else "|"
        axes.plot([value], [i], marker=marker, color=color, markersize=7 if alone else 13, markeredgewidth=2.2)
    if panel.middle is not None:
        axes.axvline(panel.middle, color=axes.xaxis.label.get_color(), linewidth=0.8)
        axes.set_xlim(-0.03, 1.03)
    labels = ["\n".join(map(_beside, label.split("\n"))) for label, _, _ in panel.rows]
    axes.set_yticks(range(len(panel.rows)), labels)
    axes.set_ylim(len(panel.rows) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.locator_params(axis="x", nbins=5)


def _beside(line: str) -> str:
    return shortened(line, BESIDE + len("> "))


def _legend(drawing: "Drawing", agents: Sequence[Agent], labels: Sequence[str], columns: int) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], linewidth=1.5 if agent.published else 2, **_look(agent)) for agent in agents]
    drawing.legend(handles, labels, loc="outside lower left", ncols=columns, fontsize=9.5)


def _legend_text(agent: Agent, letters: int) -> str:
    text = "".join(letter if letter.isprintable() else " " for letter in agent.label or agent.name)
    text = "\n".join(textwrap.wrap(text, letters - 8)[:3]) or " "
    return f"\u00a0{text}" if text.startswith("_") else text
