"""
Scaling laws on the published grid of BRO, against crossings, fits and constants made with other code.

The data may not be shipped: ``SB3_SAMPLE_REFERENCE`` names their folder, else it is looked for beside the checkout.
"""

import json
import os
import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sb3_sample.study import scaling

ROOT = Path(__file__).parents[2]
REFERENCE = Path(os.environ.get("SB3_SAMPLE_REFERENCE", ROOT.parent / "shared" / "reference"))
LAWS = REFERENCE / "scaling_laws"
LEVELS = [200, 314, 412, 496, 568, 630, 682, 728, 767, 800]
RATIOS = np.array([1.0, 2.0, 5.0, 10.0, 15.0])

pytestmark = pytest.mark.skipif(
    not (REFERENCE / "bro_grid.npz").exists() or not LAWS.exists(),
    reason=f"{REFERENCE} has no bro_grid.npz or scaling_laws (SB3_SAMPLE_REFERENCE)",
)


@pytest.fixture(scope="module")
def found() -> pd.DataFrame:
    """Crossings of the seven tasks, ``name`` as in the reference."""
    table = runpy.run_path(str(ROOT / "studies" / "published_grid.py"))["read_grid"](REFERENCE / "bro_grid.npz")
    names = set(pd.read_csv(LAWS / "crossings_bro_grid.csv")["task"])
    table = table[table["task"].isin([f"dmc/{name}-v0" for name in names])]
    crossed = scaling.crossings(table, LEVELS, keep_after_reset=True)
    return crossed.assign(name=crossed["task"].str.removeprefix("dmc/").str.removesuffix("-v0"))


def test_crossings_are_those_of_the_reference(found: pd.DataFrame) -> None:
    expected = pd.read_csv(LAWS / "crossings_bro_grid.csv")
    assert len(expected) == 175 and len(found) == 1_750
    long = expected.melt(
        ["task", "size", "replay_ratio", "n_runs"], [f"J{level}" for level in LEVELS], "level", "expected"
    )
    long["level"] = long["level"].str[1:].astype(int)
    both = found.merge(long, left_on=["name", "model_size", "replay_ratio", "level"],
                       right_on=["task", "size", "replay_ratio", "level"])  # fmt: skip
    assert len(both) == 1_750 and (both["runs"] == both["n_runs"]).all()
    assert both["step"].isna().sum() == 54
    np.testing.assert_array_equal(both["step"], both["expected"])


def test_fits_are_those_of_the_reference(found: pd.DataFrame) -> None:
    expected = pd.read_csv(LAWS / "crossings_fits.csv")
    differences = []
    for row in expected.itertuples():
        y = np.array([getattr(row, f"y_rr{ratio:g}") for ratio in RATIOS])
        law = scaling.fit_data(RATIOS, y, loss="squared")
        if not row.c_positive:
            continue
        fitted = row.c + (RATIOS / row.b) ** -row.a
        assert law.steps(RATIOS) == pytest.approx(fitted, rel=0.01)
        assert ((law.steps(RATIOS) - y) ** 2).mean() <= row.mse * (1 + 1e-5)  # printed to six digits
        differences.append(np.abs(scaling.fit_data(RATIOS, y).steps(RATIOS) / fitted - 1).max())
    assert len(differences) == 48
    # With logarithms: measured 1.0% in the median, 4.5% at most.
    assert np.median(differences) < 0.02 and max(differences) < 0.06


def test_averages_over_tasks_are_those_of_the_reference(found: pd.DataFrame) -> None:
    expected = pd.read_csv(LAWS / "crossings_fits.csv")
    for size, rows in expected.groupby("size", sort=False):
        own = found[found["model_size"] == size]
        own = own[~own["task"].isin(own.loc[own["step"].isna(), "task"])]
        steps = np.stack([
            part.pivot(index="replay_ratio", columns="level", values="step").loc[list(RATIOS)].to_numpy()
            for _, part in own.groupby("task")
        ])  # fmt: skip
        assert (rows["n_tasks"] == len(steps)).all()
        y, _, factors = scaling.normalize(steps, np.full(steps.shape[:2], 1e6), across_levels=True)
        medians = np.median(steps, axis=(1, 2))
        assert factors[:, 0] == pytest.approx(medians / np.median(medians))
        med = rows["med"].iloc[0]
        table = rows[[f"y_rr{ratio:g}" for ratio in RATIOS]].to_numpy().T
        np.testing.assert_allclose(y / med, table, rtol=1e-6)


def test_the_authors_budget_laws_from_their_stored_fits() -> None:
    for case in json.loads((LAWS / "test_vector.json").read_text())["cases"]:
        given, expected = case["inputs"], case["expected"]
        batch = scaling.HyperparameterLaw(
            given["batch_size_slope"], {task: 10**x for task, x in given["batch_size_intercepts_log10"].items()}
        )
        for ratio, value in expected["mean_batch_size_at"].items():
            assert batch.mean(float(ratio)) == pytest.approx(value, rel=1e-9)
        grid = np.geomspace(given["grid"]["low"], given["grid"]["high"], given["grid"]["points"])
        ratios, totals, fine = [], [], []
        for i, (a, b, c) in enumerate(given["abc"]):
            law = scaling.DataLaw(given["med"] * c, b * c ** (-1 / a), a)
            assert (law.beta, law.d_min) == pytest.approx((expected["beta"][i], expected["D_min"][i]), rel=1e-9)
            compute = scaling.ComputeLaw.of(law, batch, given["N"])
            points = compute.at(grid)
            total = points.compute + given["delta"] * points.steps
            ratios.append(grid[total.argmin()])
            totals.append(total.min())
            fine.append(compute.best(given["delta"]))
        assert ratios == pytest.approx(expected["sigma_star"], rel=1e-9)
        assert totals == pytest.approx(expected["budget"], rel=1e-9)
        found = scaling.fit_budget(totals[:-2], ratios[:-2])
        law = expected["law"]
        assert (found.coefficient, found.exponent) == pytest.approx((law["coefficient"], law["exponent"]), rel=1e-6)
        # Without the grid of 100 replay ratios, which is coarse: -0.75 for the printed -0.74, 0.63 for 0.62.
        budgets = [float(point.compute + given["delta"] * point.steps) for point in fine]
        exact = scaling.fit_budget(budgets[:-2], [float(point.replay_ratio) for point in fine][:-2])
        assert exact.exponent == pytest.approx({"dmc": -0.750, "gym": 0.630}[case["domain"]], abs=1e-3)


def test_all_proposals_of_the_authors_follow_from_their_fits() -> None:
    fits = pd.read_csv(LAWS / "hyperparameter_fits.csv").set_index(["domain", "fit", "quantity", "environment"])
    proposals = pd.read_csv(LAWS / "proposed_hyperparameters.csv")
    # Those of the agent with one batch size and learning rate are of no fit.
    proposals = proposals[proposals["fit"] != "constant"]
    assert len(proposals) == 154
    for row in proposals.itertuples():
        of = fits.loc[(row.domain, row.fit, "batch_size", row.environment)]
        batch = 10 ** (of["intercept_log10"] + of["slope"] * np.log10(row.sigma))
        # They cut to an integer before they round.
        assert scaling.rounded_batch_size(int(batch)) == row.batch_size_rounded


def held_out(found: pd.DataFrame) -> pd.DataFrame:
    """
    Predictions for the two largest replay ratios of fits without them, by size, level and ratio. The exponent is that
    of all levels together, since three points leave nothing over.
    """
    rows = []
    for size, own in found.groupby("model_size", sort=False):
        own = own[~own["task"].isin(own.loc[own["step"].isna(), "task"])]
        wide = own.pivot(index=["task", "level"], columns="replay_ratio", values="step")
        steps = np.stack([wide.xs(level, level="level").to_numpy() for level in LEVELS], axis=2)  # task, ratio, level
        few = steps[:, :3]
        middle = np.median(few, axis=(1, 2), keepdims=True)
        y = (steps / middle).mean(axis=0)
        alpha = scaling.shared_alpha(RATIOS[:3], y[:3].T)
        for i, level in enumerate(LEVELS):
            law = scaling.fit_data(RATIOS[:3], y[:3, i], alpha=alpha)
            for j in (3, 4):
                error = law.steps(RATIOS[j]) / y[j, i] - 1
                rows.append({"size": size, "level": level, "replay_ratio": RATIOS[j], "alpha": alpha, "error": error})
    return pd.DataFrame(rows)


@pytest.mark.slow
def test_the_two_largest_replay_ratios_are_predicted(found: pd.DataFrame) -> None:
    errors = held_out(found)
    assert len(errors) == 100
    mean = errors["error"].abs().groupby(errors["size"], sort=False).mean()
    # Measured: 10.0% over all, 14.2% for the smallest size. The paper's table 5 has 7.8% and 10.6%, of batch sizes and
    # learning rates that were fitted.
    assert mean.max() < 0.18 and mean.mean() < 0.12
