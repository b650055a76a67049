"""
BRO at 25 replay ratios and sizes, against the tables made of the same runs with other code.

The runs may not be shipped: ``SB3_SAMPLE_REFERENCE`` names the folder with ``bro_grid.npz`` and ``bro_grid.md``, else
it is looked for beside the checkout.
"""

import os
import re
import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sb3_sample import study
from sb3_sample.study.advice import published_grid

ROOT = Path(__file__).parents[2]
REFERENCE = Path(os.environ.get("SB3_SAMPLE_REFERENCE", ROOT.parent / "shared" / "reference"))
STEPS = (100_000, 200_000, 500_000, 1_000_000)

pytestmark = pytest.mark.skipif(
    not (REFERENCE / "bro_grid.npz").exists(), reason=f"{REFERENCE} has no bro_grid.npz (SB3_SAMPLE_REFERENCE)"
)


@pytest.fixture(scope="module")
def grid() -> pd.DataFrame:
    found: pd.DataFrame = runpy.run_path(str(ROOT / "studies" / "published_grid.py"))["read_grid"](
        REFERENCE / "bro_grid.npz"
    )
    return found[found["step"].isin(STEPS)]


def published(heading: str) -> dict[tuple[str, str], list[float]]:
    """The IQM of a table of ``bro_grid.md`` by replay ratio and size, at four steps."""
    lines = (REFERENCE / "bro_grid.md").read_text().partition(f"**{heading}")[2].split("\n\n")[1].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    return {(row[0], row[1]): [float(re.split(r" ", cell)[0]) for cell in row[2:]] for row in rows}


@pytest.mark.parametrize(
    ("group", "heading", "unit", "digit"),
    [
        ("dmc", "15 DeepMind Control tasks (return, 0 to 1,000): IQM", 1_000, 1.0),
        pytest.param(
            "metaworld", "15 Meta-World v2 tasks (success rate in percent): IQM", 100, 0.1, marks=pytest.mark.slow
        ),
        pytest.param("myosuite", "10 MyoSuite tasks (success rate in percent): IQM", 100, 0.1, marks=pytest.mark.slow),
    ],
)
def test_the_grid_of_bro(grid: pd.DataFrame, group: str, heading: str, unit: float, digit: float) -> None:
    expected = published(heading)
    assert len(expected) == 25
    for i, step in enumerate(STEPS):
        found = study.heatmap(grid, "model_size", "replay_ratio", step=step, group=group)
        assert list(found.index) == ["1", "2", "5", "10", "15"]
        for (ratio, size), values in expected.items():
            difference = abs(found.loc[ratio, size] * unit - values[i])
            assert difference <= 0.51 * digit, (ratio, size, step, found.loc[ratio, size] * unit, values[i])


def test_the_grids_published_agents_are_those_of_the_package(grid: pd.DataFrame) -> None:
    ours = study.published_runs(["BRO Fast"])
    ours = ours[ours["step"].isin(STEPS)]
    theirs = grid[grid["arguments"] == '{"model_size": "4.92M", "replay_ratio": 2}']
    key = ["task", "seed", "step"]
    np.testing.assert_allclose(theirs.sort_values(key)["value"], ours.sort_values(key)["value"], rtol=1e-5, atol=1e-5)


def test_a_part_of_the_grid(grid: pd.DataFrame) -> None:
    read_grid = runpy.run_path(str(ROOT / "studies" / "published_grid.py"))["read_grid"]
    part = read_grid(REFERENCE / "bro_grid.npz", ratios=[2], sizes=["0.55M"])
    part = part[part["step"].isin(STEPS)].reset_index(drop=True)
    whole = grid[grid["arguments"] == '{"model_size": "0.55M", "replay_ratio": 2}']
    pd.testing.assert_frame_equal(part, whole.reset_index(drop=True))
    with pytest.raises(ValueError, match=r"ratios must be of 1, 2, 5, 10, 15, not 3"):
        read_grid(REFERENCE / "bro_grid.npz", ratios=[3])


@pytest.mark.slow
def test_the_statistics_in_the_package_are_those_of_the_grid() -> None:
    """Of the one configuration whose tasks have different numbers of runs, with the intervals."""
    module = runpy.run_path(str(ROOT / "studies" / "published_grid.py"))
    found = module["statistics"](module["read_grid"](REFERENCE / "bro_grid.npz", ratios=[15], sizes=["26.31M"]))
    shipped = published_grid()
    shipped = shipped[(shipped["replay_ratio"] == 15) & (shipped["model_size"] == "26.31M")].reset_index(drop=True)
    names = ["iqm", "low", "high"]
    np.testing.assert_allclose(found[names], shipped[names], atol=1.01e-4)
    others = [name for name in shipped if name not in names]
    pd.testing.assert_frame_equal(found[others], shipped[others], check_dtype=False)


def test_the_package_has_the_tables_beside_the_grid() -> None:
    shipped = published_grid().set_index(["suite", "replay_ratio", "model_size", "env_step"])["iqm"]
    for suite, heading, unit, digit in (
        ("dmc", "15 DeepMind Control tasks (return, 0 to 1,000): IQM", 1_000, 1.0),
        ("metaworld", "15 Meta-World v2 tasks (success rate in percent): IQM", 100, 0.1),
        ("myosuite", "10 MyoSuite tasks (success rate in percent): IQM", 100, 0.1),
    ):
        for (ratio, size), values in published(heading).items():
            for step, value in zip(STEPS, values, strict=True):
                assert abs(shipped[suite, int(ratio), size, step] * unit - value) <= 0.56 * digit
