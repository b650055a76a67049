"""A report as one HTML page that needs no network and no other file."""

import base64
import hashlib
from pathlib import Path
from typing import Any

from sb3_sample.extras import needing
from sb3_sample.study.reporting import figures
from sb3_sample.study.reporting.pieces import (
    DASH,
    Agent,
    Cell,
    Count,
    Figure,
    Interval,
    Report,
    Table,
    Text,
    interval_text,
    number,
)

_HERE = Path(__file__).parent
TEMPLATE, SCRIPT = "page.html", "page.js"


def page(report: Report) -> str:
    """
    :param report: content
    :return: the page; equal for equal content. All text from files is escaped, and the page allows the browser no
        requests and only its own script
    :raises ImportError: Jinja or matplotlib is not installed
    """
    with needing("reports need Jinja", "study"):
        import jinja2
        import markupsafe
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_HERE),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.tests |= {
        kind.__name__.lower(): lambda part, kind=kind: isinstance(part, kind) for kind in (Table, Figure, Text, Count)
    }
    environment.filters |= {"shown": shown, "order": order, "right": lambda cell: not isinstance(cell, str)}
    script = (_HERE / SCRIPT).read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return environment.get_template(TEMPLATE).render(
        report=report,
        script=markupsafe.Markup(script),
        digest=digest,
        panels=_panels(report, markupsafe.Markup),
        light=figures.LIGHT,
        dark=figures.DARK,
        dash=figures.dash,
        label=_label,
    )


def _panels(report: Report, markup: Any) -> dict[str, list[Any]]:
    """The panels of each figure, as SVG."""
    found = {}
    for part in (part for section in report.sections for part in section.parts):
        if isinstance(part, Figure):
            found[part.name] = [markup(figures.svg(each, f"{part.name}-{i}")) for i, each in enumerate(part.panels)]
    return found


def _label(agent: Agent) -> str:
    return agent.label or agent.name


def shown(cell: Cell) -> str:
    """
    :param cell: of a table
    :return: its text
    """
    if cell is None:
        return DASH
    if isinstance(cell, Interval):
        return interval_text(cell)
    if isinstance(cell, Count):
        return str(cell.number)
    if isinstance(cell, float):
        return number(cell, 2)
    return f"{cell:,}" if isinstance(cell, int) else cell


def order(cell: Cell) -> str:
    """
    :param cell: of a table
    :return: its sort key, as a number for JavaScript; empty for none, and for words
    """
    value = cell.value if isinstance(cell, Interval) else cell.number if isinstance(cell, Count) else cell
    return "" if value is None or isinstance(value, str) or value != value else repr(value)
