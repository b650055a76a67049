"""The program that makes the data sets of studies/evidence/offline.yml, at a small size."""

import json
import runpy
from pathlib import Path

import pytest

pytest.importorskip("minari")
pytest.importorskip("rl_zoo3")
pytest.importorskip("dm_control")
pytest.importorskip("gymnasium_robotics")

from sb3_sample import Dataset, study

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_it_makes_the_data_sets_of_the_plan(tmp_path: Path) -> None:
    program = runpy.run_path(str(ROOT / "studies" / "evidence" / "offline.py"))
    small = {"dmc/cartpole-swingup-v0": (2_600, 1), "FetchReach-v4": (1_100, 2)}
    recipes = {
        task: recipe._replace(steps=small[task][0], episodes=small[task][1])
        for task, recipe in program["RECIPES"].items()
    }
    program["main"](["--folder", str(tmp_path)], recipes)
    plan = study.read_plan(ROOT / "studies" / "evidence" / "offline.yml")
    assert {run.task for run in plan.runs} == recipes.keys()
    sources = {source for run in plan.runs for name, source in run.data.items() if name != "offline_steps"}
    assert len(sources) == 4
    for source in sources:
        task, kind = source.removeprefix(f"{program['FOLDER']}/").split("/")
        dataset = Dataset.from_minari(tmp_path / task / kind)
        facts = json.loads((tmp_path / task / "datasets.json").read_text())
        assert facts[kind]["fingerprint"] == dataset.fingerprint and facts["seed"] == 0
        half = next(recipe.steps for name, recipe in recipes.items() if name.replace("/", "-") == task) // 2
        episodes = {"dmc-cartpole-swingup-v0": 1_000, "FetchReach-v4": 100}[task]
        assert len(dataset) == (half if kind == "medium-replay" else episodes)
    # What is there is left.
    made = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")}
    program["main"](["--folder", str(tmp_path)], recipes)
    assert made == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")}
