"""A report as Markdown with pictures beside it, or as a part of a larger page."""

import os
import re
from pathlib import Path

from sb3_sample.saving.temporary import becoming
from sb3_sample.study.reporting import figures
from sb3_sample.study.reporting.html import shown
from sb3_sample.study.reporting.pieces import Figure, Report, Section, Table, Text

#: Marker lines around the report, by which it is found again.
BEGIN, END = "<!-- begin: sb3-sample study report: {} -->", "<!-- end: sb3-sample study report: {} -->"
_SPECIAL = re.compile(r"([\\`*\[\]|~$#!]|(?<!\w)_|_(?!\w))")


def write(report: Report, path: Path, pictures: Path | None = None) -> None:
    """
    Write a report; in a page with the marker lines of an earlier report with this title, replace the text between them.

    :param report: content
    :param path: of the page
    :param pictures: folder of the pictures; ``<page>_files`` beside the page if None
    :raises ValueError: the page exists without these lines
    :raises ImportError: matplotlib is not installed
    :raises OSError: a file cannot be written
    """
    name = re.sub(r"-{2,}|[<>\n\r]", "-", report.title)
    begin, end = BEGIN.format(name), END.format(name)
    # The rest of the page keeps its line ends.
    page = path.read_bytes().decode() if path.exists() else f"{begin}\n{end}\n"
    parts = around(page, begin, end)
    if parts is None:
        raise ValueError(
            f"markdown must name a new file, or one with the lines {begin} and {end}, between which the report stands; "
            f"{path} has not both of them once"
        )
    pictures = path.with_name(f"{path.stem}_files") if pictures is None else pictures
    drawn = {part.name: part for section in report.sections for part in section.parts if isinstance(part, Figure)}
    images = {f"{name}.png": figures.png(figure) for name, figure in drawn.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    if images:
        pictures.mkdir(parents=True, exist_ok=True)
    for file, data in images.items():
        with becoming(pictures / file) as out:
            out.write(data)
    folder = Path(os.path.relpath(pictures, path.parent)).as_posix()
    head, tail = parts
    with becoming(path) as out:
        out.write(f"{head}\n{markdown(report, folder)}{tail}".encode())


def around(page: str, begin: str, end: str) -> tuple[str, str] | None:
    """
    :param page: a text
    :param begin: a line of it
    :param end: another one
    :return: the text up to and including the first line, and from the second line on; None if it does not have each of
        them once, in this order
    """
    if page.count(begin) != 1 or page.count(end) != 1 or page.index(begin) > page.index(end):
        return None
    return page[: page.index(begin) + len(begin)], page[page.index(end) :]


def markdown(report: Report, pictures: str) -> str:
    """
    :param report: content
    :param pictures: folder of the pictures, as the page names it
    :return: the text; equal for equal content
    """
    lines = [f"## {escaped(report.title)}", ""]
    lines += [f"- **{heading}.** {escaped(' '.join(words))}" for heading, words in report.summary]
    for section in report.sections:
        lines += ["", f"### {section.title}", *_section(section, pictures)]
    return "\n".join(lines) + "\n"


def escaped(text: str) -> str:
    """
    :param text: any text, from a file
    :return: the text in one line, with the characters special to Markdown and HTML escaped
    """
    text = " ".join(text.split())
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return _SPECIAL.sub(r"\\\1", text)


def _section(section: Section, pictures: str) -> list[str]:
    lines: list[str] = []
    for part in section.parts:
        lines.append("")
        if isinstance(part, str):
            lines.append(escaped(part))
        elif isinstance(part, Figure):
            caption = escaped(part.caption).rstrip(".")
            lines += [f"![{caption}]({pictures.replace(' ', '%20')}/{part.name}.png)", "", f"*{caption}.*"]
        elif isinstance(part, Table):
            rows = _table(part)
            lines += _folded(part.caption, rows) if part.folded else [f"{escaped(part.caption)}:", "", *rows]
        elif isinstance(part, Text):
            lines += _folded(part.title, ["<pre>", *_lines(part.text), "</pre>"])
    return lines


def _folded(title: str, lines: list[str]) -> list[str]:
    return [f"<details><summary>{_html(title)}</summary>", "", *lines, "", "</details>"]


def _html(text: str) -> str:
    return " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _lines(text: str) -> list[str]:
    # An empty line ends a block of HTML in Markdown, and the rest would be Markdown again.
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return [line if line.strip() else "&nbsp;" for line in text.splitlines()]


def _table(table: Table) -> list[str]:
    right = ["" if isinstance(cell, str) else ":" for cell in table.rows[0]]
    cells = [[escaped(shown(cell)) for cell in row] for row in table.rows]
    heads = [escaped(name) for name in table.head]
    return [f"| {' | '.join(line)} |" for line in (heads, [f"---{colon}" for colon in right], *cells)]
