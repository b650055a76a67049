"""The report's page in a browser: no error, no request, pictures legible in both colour schemes, sorted tables."""

from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

from sb3_sample import study
from tests.study.chromium import PROGRAM, Chromium
from tests.study.test_report import CHEETAH, EVIL, OWN, PUSH, WALKER, made_up, runs

pytestmark = pytest.mark.skipif(
    PROGRAM is None, reason="there is no Chromium to open reports with (apt-get install chromium)"
)
pytest.importorskip("rliable.library")
pytest.importorskip("jinja2")

AGENTS = ("good", "an agent whose name is longer than any table and any figure can bear in one line", EVIL)


def table() -> pd.DataFrame:
    rows = []
    for i, agent in enumerate(AGENTS):
        for task in (CHEETAH, WALKER, PUSH, OWN):
            ends = [(1 if task == PUSH else 900) * (0.9 - 0.2 * i + 0.05 * seed) for seed in range(3)]
            rows += runs(agent, task, ends, steps=(25_000, 50_000, 75_000, 100_000))
    return made_up(rows)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    study.report(table(), path, reps=20, curves=["BRO", "TD-MPC2"], published=["BRO Fast"], title=f"Study {EVIL}")
    return path


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    browser = Chromium(tmp_path_factory.mktemp("chromium"))
    yield browser
    browser.close()


SIZES = (
    "[...document.querySelectorAll('.panels svg')].map(svg => svg.getBoundingClientRect())"
    ".map(box => [box.width, box.height])"
)
#: Of a panel's lines, and of the ground that they are on.
COLORS = (
    "[...new Set([...document.querySelectorAll('.panels svg path')].map(path => getComputedStyle(path).stroke))]"
    ".filter(color => color !== 'none')"
)
GROUND = "getComputedStyle(document.body).backgroundColor"
INK = "getComputedStyle(document.querySelector('.panels svg text')).fill"


def luminance(color: str) -> float:
    """Relative luminance of "rgb(r, g, b)" (WCAG 2.2)."""
    values = [int(value) / 255 for value in color.removeprefix("rgb(").rstrip(")").split(",")[:3]]
    red, green, blue = (v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in values)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(a: str, b: str) -> float:
    low, high = sorted((luminance(a), luminance(b)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1240, 400])
def test_the_page_opens_without_errors_and_requests(chromium: Chromium, page: Path, scheme: str, width: int) -> None:
    chromium.open(page, width, scheme)
    assert chromium.errors() == []
    # The icon is empty and in the page.
    assert [address for address in chromium.requests() if address != "data:,"] == [page.as_uri()]
    assert chromium.run("document.title") == f"Study {EVIL}"
    assert chromium.run("document.scripts.length") == 1
    sizes = chromium.run(SIZES)
    # Averages, training of three groups, means of them, four tasks, profile, improvement.
    assert len(sizes) == 4 + 3 + 3 + 4 + 1 + 1
    assert all(280 <= wide <= width and high >= 80 for wide, high in sizes)
    # Nothing is wider than the screen: tables scroll by themselves.
    assert chromium.run("document.documentElement.scrollWidth") <= width
    ground = chromium.run(GROUND)
    assert (luminance(ground) > 0.5) == (scheme == "light")
    assert contrast(chromium.run(INK), ground) >= 7
    lines = [color for color in chromium.run(COLORS) if contrast(color, ground) > 1.5]
    assert len(lines) >= 5 and all(contrast(color, ground) >= 2 for color in lines)


def test_texts_of_a_picture_do_not_leave_it_nor_touch_each_other(chromium: Chromium, page: Path) -> None:
    chromium.open(page, 1240)
    cut = chromium.run(
        "[...document.querySelectorAll('.panels svg')].flatMap(svg => {"
        " const box = svg.getBoundingClientRect();"
        " return [...svg.querySelectorAll('text')].filter(text => {"
        "  const b = text.getBoundingClientRect();"
        "  return b.left < box.left - 2 || b.right > box.right + 2 || b.top < box.top - 2 || b.bottom > box.bottom + 2;"
        " }).map(text => text.textContent) })"
    )
    assert cut == []
    touching = chromium.run(
        "[...document.querySelectorAll('.panels svg')].flatMap(svg => {"
        " const texts = [...svg.querySelectorAll('text')].map(t => [t.textContent, t.getBoundingClientRect()]);"
        " return texts.flatMap(([s, a], i) => texts.slice(i + 1).filter(([_, b]) =>"
        "  Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1 &&"
        "  Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 4).map(([t]) => [s, t])) })"
    )
    assert touching == []


def test_a_table_is_sorted_by_the_heading_that_is_pressed(chromium: Chromium, page: Path) -> None:
    chromium.open(page)
    table = "[...document.querySelectorAll('table')].find(t => t.caption.textContent.startsWith('Averages by'))"

    def press(column: int) -> list[str]:
        found: list[str] = chromium.run(
            f"(() => {{ const t = {table}; t.querySelectorAll('th button')[{column}].click();"
            f" return [...t.tBodies[0].rows].map(row => row.cells[{column}].textContent); }})()"
        )
        return found

    rows = chromium.run(f"[...{table}.tBodies[0].rows].map(row => row.cells[3].textContent)")
    values = [float(text.split()[0]) for text in press(3)]
    assert values == sorted(values) and len(values) == len(rows) > 8
    assert [float(text.split()[0]) for text in press(3)] == values[::-1]
    assert chromium.run(f"{table}.querySelectorAll('th')[3].getAttribute('aria-sort')") == "descending"
    names = press(0)
    assert len(set(names)) == 4 and names == sorted(names, key=lambda name: (name != EVIL, name.lower()))
    assert press(0) == names[::-1]
    assert [int(text) for text in press(7)] == sorted(int(text) for text in press(7)[::-1])
    assert chromium.errors() == []


def test_the_button_changes_the_colours_and_back(chromium: Chromium, page: Path) -> None:
    chromium.open(page, scheme="light")
    press = (
        "(() => { document.getElementById('theme').click(); return getComputedStyle(document.body).backgroundColor })()"
    )
    bright = chromium.run(GROUND)
    colors = [chromium.run(press) for _ in range(3)]
    assert [luminance(color) < 0.5 for color in colors] == [False, True, False] and colors[2] == bright
    chromium.open(page, scheme="dark")
    assert [luminance(chromium.run(press)) < 0.5 for _ in range(3)] == [False, True, True]


def test_scripts_of_names_do_not_run(chromium: Chromium, page: Path, tmp_path: Path) -> None:
    """Not even in a page that has them as they are: the browser is told to run the page's own script only."""
    broken = tmp_path / "broken.html"
    broken.write_text(page.read_text().replace("</main>", "<script>document.title = 'ran'</script></main>"))
    chromium.open(broken)
    assert chromium.run("document.title") == f"Study {EVIL}"
    assert "Content Security Policy" in str(chromium.errors())


def test_an_empty_page(chromium: Chromium, tmp_path: Path) -> None:
    study.report(made_up(runs("a", OWN, [1.0])), tmp_path / "r.html", reps=5, curves=[])
    chromium.open(tmp_path / "r.html")
    assert chromium.errors() == [] and len(chromium.run(SIZES)) == 1
