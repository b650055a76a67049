"""Scaling laws: the paper's numbers, laws that are known, and bad input."""

import dataclasses
import json
import math
import re
import shlex
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import minimize

from sb3_sample.study import scaling
from sb3_sample.study.scaling.best import Cell
from sb3_sample.study.scaling.crossings import Configuration, configurations, first_crossing, kept_evaluations
from sb3_sample.study.scaling.fitting import _pick
from sb3_sample.study.scaling.intervals import interval
from sb3_sample.study.table import COLUMNS, to_json

#: "Value-Based Deep RL Scales Predictably", table 2: learning rate and batch size at replay ratio 1.
DMC = {
    "cartpole-swingup": (7.55e-4, 538.2), "cheetah-run": (6.25e-4, 564.9), "finger-spin": (8.77e-4, 608.2),
    "humanoid-stand": (3.86e-4, 451.8), "quadruped-walk": (8.46e-4, 526.4), "walker-walk": (9.38e-4, 313.3),
}  # fmt: skip
GYM = {"Ant-v4": (1.35e-4, 447.0), "HalfCheetah-v4": (1.86e-3, 415.4)}
RATIOS = np.array([0.25, 0.5, 1, 2, 4, 8])
#: Its table 6, batch sizes.
TABLE_6 = {
    "cartpole-swingup": [1040, 752, 544, 384, 288, 208], "cheetah-run": [1088, 784, 560, 400, 288, 208],
    "finger-spin": [1168, 848, 608, 432, 320, 224], "humanoid-stand": [864, 624, 448, 320, 240, 176],
    "quadruped-walk": [1008, 736, 528, 384, 272, 192], "walker-walk": [608, 432, 320, 224, 160, 112],
}  # fmt: skip
#: Its table 7, learning rates.
TABLE_7 = {
    "cartpole-swingup": [0.00108, 0.000902, 0.000755, 0.000631, 0.000528, 0.000442],
    "cheetah-run": [0.000893, 0.000747, 0.000625, 0.000523, 0.000438, 0.000366],
    "dog-stand": [0.000664, 0.000555, 0.000465, 0.000389, 0.000325, 0.000272],
    "finger-spin": [0.00125, 0.00105, 0.000877, 0.000734, 0.000614, 0.000514],
    "humanoid-stand": [0.000551, 0.000461, 0.000386, 0.000323, 0.00027, 0.000226],
    "quadruped-walk": [0.00121, 0.00101, 0.000846, 0.000708, 0.000592, 0.000496],
    "walker-walk": [0.00134, 0.00112, 0.000938, 0.000785, 0.000657, 0.000549],
}
#: Its tables 8 and 9, at 0.25 to 16.
TABLE_8 = {
    "Ant-v4": [704, 560, 448, 352, 288, 224, 176], "HalfCheetah-v4": [672, 528, 416, 336, 256, 208, 160],
    "Humanoid-v4": [560, 432, 352, 272, 224, 176, 144], "Walker2d-v4": [640, 496, 400, 320, 256, 192, 160],
}  # fmt: skip
TABLE_9 = {
    "Ant-v4": [0.000206, 0.000167, 0.000138, 0.000109, 0.000087, 0.000070, 0.000060],
    "HalfCheetah-v4": [0.002820, 0.002280, 0.001900, 0.001510, 0.001210, 0.000972, 0.000827],
    "Humanoid-v4": [0.000251, 0.000203, 0.000169, 0.000134, 0.000107, 0.000086, 0.000073],
    "Walker2d-v4": [0.001180, 0.000958, 0.000806, 0.000640, 0.000512, 0.000412, 0.000347],
}
CHEETAH = scaling.DataLaw(3.5e5, 0.45, 0.74)
CHEETAH_C = scaling.ComputeLaw.of(CHEETAH, scaling.HyperparameterLaw(-0.47, {"cheetah-run": 564.9}), 4.92e6)


def rows(table: dict[str, list[float]]) -> pd.DataFrame:
    ratios = 0.25 * 2.0 ** np.arange(7)
    return pd.DataFrame(
        [(task, ratio, value) for task, values in table.items() for ratio, value in zip(ratios, values, strict=False)],
        columns=["task", "replay_ratio", "value"],
    )


# ---------------------------------------------------------------- the paper's numbers


def test_batch_sizes_of_table_6() -> None:
    law = scaling.HyperparameterLaw(-0.47, {task: values[1] for task, values in DMC.items()})
    for task, expected in TABLE_6.items():
        assert [scaling.rounded_batch_size(law.value(task, ratio)) for ratio in RATIOS] == expected
    for batch, works in ((121.9, True), (129.1, True), (121.5, False), (129.5, False)):
        dog = scaling.HyperparameterLaw(-0.47, {"dog-stand": batch})
        found = [scaling.rounded_batch_size(dog.value("dog-stand", ratio)) for ratio in RATIOS]
        assert (found == [240, 176, 128, 96, 64, 48]) == works


def test_learning_rates_of_table_7() -> None:
    law = scaling.fit_hyperparameter(rows(TABLE_7))
    assert law.slope == pytest.approx(-0.2573, abs=5e-5)
    expected = {
        "cartpole-swingup": 7.548e-4, "cheetah-run": 6.251e-4, "finger-spin": 8.771e-4, "humanoid-stand": 3.858e-4,
        "quadruped-walk": 8.461e-4, "walker-walk": 9.379e-4, "dog-stand": 4.646e-4,
    }  # fmt: skip
    assert law.intercepts == pytest.approx(expected, rel=2e-4)
    for task, values in TABLE_7.items():
        assert law.value(task, RATIOS) == pytest.approx(values, rel=0.0067)


def test_tables_8_and_9() -> None:
    law = scaling.fit_hyperparameter(rows(TABLE_8))
    assert law.slope == pytest.approx(-0.3338, abs=5e-5)
    expected = {"Ant-v4": 447.0, "HalfCheetah-v4": 415.4, "Humanoid-v4": 351.6, "Walker2d-v4": 399.1}
    assert law.intercepts == pytest.approx(expected, abs=0.06)
    exact = 0
    for task, values in TABLE_8.items():
        found = 16 * np.round(expected[task] * (0.25 * 2.0 ** np.arange(7)) ** -0.33 / 16)
        exact += int((found == values).sum())
        assert np.abs(found - values).max() <= 16
    assert exact == 24
    rate = scaling.fit_hyperparameter(rows(TABLE_9))
    assert rate.slope == pytest.approx(-0.3018, abs=5e-5)
    assert rate.intercepts == pytest.approx(
        {"Ant-v4": 1.350e-4, "HalfCheetah-v4": 1.862e-3, "Humanoid-v4": 1.652e-4, "Walker2d-v4": 7.856e-4}, rel=4e-4
    )


def test_the_laws_on_cheetah_run() -> None:
    steps = CHEETAH.steps(RATIOS)
    assert steps == pytest.approx([8.907e5, 6.738e5, 5.438e5, 4.661e5, 4.195e5, 3.916e5], rel=2e-4)
    point = CHEETAH_C.at(RATIOS)
    assert point.compute == pytest.approx([1.187e16, 1.297e16, 1.512e16, 1.870e16, 2.431e16, 3.277e16], rel=4e-4)
    # A.4, written out.
    terms = 564.9 * 3.5e5 * (RATIOS**0.53 + 0.45**0.74 * RATIOS ** (0.53 - 0.74))
    assert point.compute == pytest.approx(10 * 4.92e6 * terms, rel=1e-12)
    assert pytest.approx(1.397e7, rel=1e-3) == 0.45 * (3.5e5) ** (1 / 0.74)  # beta_J of 4.1
    assert scaling.fit_data(RATIOS, steps) == pytest.approx(tuple(CHEETAH), rel=1e-6)
    assert scaling.fit_data(RATIOS, steps, loss="squared") == pytest.approx(tuple(CHEETAH), rel=1e-4)


def test_the_papers_three_questions() -> None:
    cheapest = CHEETAH_C.cheapest(5e5)
    assert (cheapest.replay_ratio, cheapest.compute) == (
        pytest.approx(1.4141, abs=5e-5),
        pytest.approx(1.670e16, rel=4e-4),
    )
    efficient = CHEETAH_C.most_data_efficient(2e16)
    assert (efficient.replay_ratio, efficient.steps) == (
        pytest.approx(2.415, abs=5e-4),
        pytest.approx(4.509e5, rel=1e-4),
    )
    assert CHEETAH_C.least() == pytest.approx(0.1288, abs=5e-5)
    best = CHEETAH_C.best(1e10)
    assert best.replay_ratio == pytest.approx(0.517, abs=5e-4)
    assert best.compute + 1e10 * best.steps == pytest.approx(1.970e16, rel=4e-4)


def test_the_questions_by_brute_force() -> None:
    points = CHEETAH_C.at(np.geomspace(0.01, 100, 200_001))
    within = points.steps <= 4.5e5
    assert CHEETAH_C.cheapest(4.5e5).compute == pytest.approx(points.compute[within].min(), rel=1e-4)
    within = points.compute <= 3e16
    assert CHEETAH_C.most_data_efficient(3e16).steps == pytest.approx(points.steps[within].min(), rel=1e-4)
    # A limit of steps that the least compute keeps anyway.
    assert CHEETAH_C.cheapest(5e6).replay_ratio == pytest.approx(CHEETAH_C.least())


def test_answers_that_there_are_not() -> None:
    with pytest.raises(ValueError, match="steps must be above 3.5e.05"):
        CHEETAH_C.cheapest(3e5)
    with pytest.raises(ValueError, match=r"compute must be at least 1\.157e\+16"):
        CHEETAH_C.most_data_efficient(1e16)
    for question in (CHEETAH_C.cheapest, CHEETAH_C.most_data_efficient, CHEETAH_C.best):
        for value in (-1.0, 0.0, math.nan, math.inf):
            with pytest.raises(ValueError, match="must be a positive number"):
                question(value)
    falling = scaling.ComputeLaw.of(CHEETAH, scaling.HyperparameterLaw(-1.2, {"a": 500.0}), 1e6)
    with pytest.raises(ValueError, match="cannot be traded"):
        falling.most_data_efficient(1e16)


def test_the_authors_form_and_ours() -> None:
    a, b, c = 0.7004, 2.2895, 1.0308
    law = scaling.DataLaw(c, b * c ** (-1 / a), a)
    assert law.steps(RATIOS) == pytest.approx(c + (RATIOS / b) ** -a, rel=1e-12)


def test_the_noise_scale() -> None:
    assert scaling.noise_scale(5.5625, 4.09765625) == (4.0, 100.0, 25.0)
    assert scaling.noise_scale(1.0, -1.0)[2] == math.inf


def test_isotonic_regression() -> None:
    values = [100.0, 300.0, 200.0, 400.0, 350.0, 500.0]
    assert scaling.isotonic(values).tolist() == [100, 250, 250, 375, 375, 500]
    assert first_crossing(np.array(values), np.array([300.0, 250.0, 50.0, 500.0, 501.0])).tolist() == [3, 1, 0, 5, 6]


def test_crossings_are_those_of_the_isotonic_regression() -> None:
    rng = np.random.default_rng(0)
    curves = np.cumsum(rng.normal(8, 60, (200, 40)), axis=1)
    curves[100:] = np.round(curves[100:], -2)  # ties and plateaus
    levels = np.array([50.0, 100.0, 137.5, 300.0])
    found = first_crossing(curves, levels)
    for curve, row in zip(curves, found, strict=True):
        smooth = scaling.isotonic(curve)
        expected = [int(np.argmax(smooth >= level - 1e-9)) if smooth[-1] >= level - 1e-9 else 40 for level in levels]
        assert row.tolist() == expected
    kept = rng.random(curves.shape) < 0.7
    for curve, mask, row in zip(curves, kept, first_crossing(curves, levels, kept), strict=True):
        short = first_crossing(curve[mask], levels)
        assert row.tolist() == [*(int(i) for i in np.append(np.flatnonzero(mask), 40)[short])]


def test_evaluations_after_a_reset_are_dropped_until_the_mean_is_back() -> None:
    steps = np.arange(1, 11) * 10
    curve = np.array([10.0, 20, 30, 5, 15, 25, 35, 2, 40, 50])
    kept = kept_evaluations(steps, curve, [30, 75])
    assert kept.tolist() == [True, True, True, False, False, False, True, False, True, True]
    # The second reset comes before the mean is back: its measure is what was there before the first.
    assert kept_evaluations(steps, curve, [30, 45]).tolist()[3:7] == [False, False, False, True]


# ---------------------------------------------------------------- fits


def test_the_fit_is_the_minimum_that_l_bfgs_finds() -> None:
    rng = np.random.default_rng(1)
    for _ in range(4):
        steps = CHEETAH.steps(RATIOS) * np.exp(rng.normal(0, 0.05, len(RATIOS)))

        def error(theta: np.ndarray, y: np.ndarray = steps) -> float:
            return float(
                ((theta[0] + np.log1p((np.exp(theta[1]) / RATIOS) ** np.exp(theta[2])) - np.log(y)) ** 2).sum()
            )

        starts = [(np.log(steps.min()), b, a) for b in (-2.0, 0.0, 2.0) for a in (-1.0, 0.0, 1.0)]
        best = min((minimize(error, start, method="L-BFGS-B") for start in starts), key=lambda f: f.fun)
        law = scaling.fit_data(RATIOS, steps)
        ours = error(np.log([law.d_min, law.beta, law.alpha]))
        assert ours <= best.fun * (1 + 1e-6)


def test_a_level_that_is_not_reached_is_a_bound() -> None:
    steps = CHEETAH.steps(RATIOS)
    low = steps.copy()
    low[0] = 0.7 * steps[0]  # given up there
    censored = np.array([True, False, False, False, False, False])
    assert scaling.fit_data(RATIOS, low, censored=censored) == pytest.approx(tuple(CHEETAH), rel=1e-4)
    # A bound above the law is an error of it.
    high = steps.copy()
    high[0] = 1.5 * steps[0]
    found = scaling.fit_data(RATIOS, high, censored=censored)
    assert found.steps(0.25) > 1.1 * steps[0]
    with pytest.raises(ValueError, match="steps must be finite"):
        scaling.fit_data(RATIOS, [math.nan, *steps[1:]])


def test_bad_points_are_refused() -> None:
    for ratios, steps in (([1, 1, 1], [3, 2, 1]), ([1, 2], [2, 1])):
        with pytest.raises(ValueError, match="at least 3 values"):
            scaling.fit_data(ratios, steps)
    with pytest.raises(ValueError, match="replay_ratio must be positive"):
        scaling.fit_data([0, 1, 2], [3, 2, 1])
    with pytest.raises(ValueError, match="loss must be"):
        scaling.fit_data([1, 2, 4], [3, 2, 1], loss="huber")
    with pytest.raises(ValueError, match="of loss='log' only"):
        scaling.fit_data([1, 2, 4, 8], [4, 3, 2, 1], loss="squared", censored=[True, False, False, False])
    with pytest.raises(ValueError, match="at least two values on one task"):
        scaling.fit_hyperparameter(pd.DataFrame({"task": ["a", "b"], "replay_ratio": [1, 2], "value": [1.0, 2.0]}))
    with pytest.raises(ValueError, match="missing: value"):
        scaling.fit_hyperparameter(pd.DataFrame({"task": ["a"], "replay_ratio": [1]}))
    with pytest.raises(ValueError, match="value must be positive"):
        scaling.fit_hyperparameter(pd.DataFrame({"task": "a", "replay_ratio": [1, 2], "value": [1.0, -2.0]}))


def test_what_is_not_determined_is_said() -> None:
    assert CHEETAH.doubts(RATIOS) == []
    power = scaling.fit_data(RATIOS, 1e6 * RATIOS**-0.5)
    assert any("d_min and beta are not determined" in doubt for doubt in power.doubts(RATIOS))
    assert power.undetermined(RATIOS) == {"d_min", "beta"} and CHEETAH.undetermined(RATIOS) == set()
    assert power.steps(RATIOS) == pytest.approx(1e6 * RATIOS**-0.5, rel=1e-3)
    flat = scaling.fit_data(RATIOS, np.full(6, 1e6))
    assert any("hardly depend" in doubt for doubt in flat.doubts(RATIOS))
    assert flat.undetermined(RATIOS) >= {"alpha", "beta"} and "d_min" not in flat.undetermined(RATIOS)
    assert scaling.DataLaw(1e5, 2.0, 20.0).undetermined([1.0, 2.0, 4.0]) == {"alpha"}
    assert flat.steps(RATIOS) == pytest.approx(1e6, rel=1e-3)


def test_one_exponent_for_several_levels() -> None:
    ratios = [1.0, 2.0, 5.0]
    laws = [scaling.DataLaw(2e5, 1.0, 0.9), scaling.DataLaw(3e5, 2.0, 0.9), scaling.DataLaw(5e5, 0.7, 0.9)]
    steps = np.stack([law.steps(ratios) for law in laws])
    assert scaling.fit_data(ratios, steps[1], alpha=0.9) == pytest.approx((3e5, 2.0, 0.9), rel=1e-5)
    # Noise decides where each level alone is fitted exactly by any exponent's neighbourhood.
    assert scaling.shared_alpha([1.0, 2.0, 5.0, 10.0], np.stack([law.steps([1, 2, 5, 10]) for law in laws])) == (
        pytest.approx(0.9, rel=0.02)
    )


def test_the_law_with_model_size() -> None:
    ratio, size = (each.ravel() for each in np.meshgrid([1.0, 2, 5, 10], [5.5e5, 1.05e6, 2.83e6, 4.92e6, 2.631e7]))
    law = scaling.SizeLaw(1e5, 2.0, 0.8, 5e5, 0.6)
    found = scaling.fit_model_size(ratio, size, law.steps(ratio, size))
    assert found == pytest.approx(tuple(law), rel=1e-3)
    with pytest.raises(ValueError, match="three sizes"):
        scaling.fit_model_size([1, 2, 4, 1, 2, 4], [1e6] * 3 + [2e6] * 3, [6, 5, 4, 3, 2, 1])


# ---------------------------------------------------------------- from a table


def runs(
    tasks: dict[str, float], ratios: list[float], batches: list[int], seeds: int = 5, last: int = 40, **more: object
) -> pd.DataFrame:
    """Runs whose steps to a return of 500 are a known law; the best batch size is 256 * ratio ** -0.5."""
    rng = np.random.default_rng(0)
    parts = []
    for task, d_min in tasks.items():
        for ratio in ratios:
            for batch in batches:
                steps_to = d_min * (1 + (1.5 / ratio) ** 0.8) * (1 + np.log(batch / (256 * ratio**-0.5)) ** 2 / 4)
                steps = (d_min * 0.1 * np.arange(1, last + 1)).astype(int)
                for seed in range(seeds):
                    own = steps_to * np.exp(rng.normal(0, 0.1))
                    values = 1_000 * (1 - 0.5 ** (steps / own)) + rng.normal(0, 5, last)
                    arguments = to_json({"replay_ratio": ratio, "batch_size": batch, **more})
                    parts.append(
                        pd.DataFrame(
                            {
                                "agent": "made up", "arguments": arguments, "task": task, "seed": seed, "step": steps,
                                "metric": "return", "value": values,
                            }
                        )
                    )  # fmt: skip
    return pd.concat(parts, ignore_index=True).astype({"seed": "Int64"})[COLUMNS]


TASKS = {"dmc/cheetah-run-v0": 1e5, "dmc/walker-run-v0": 3e5}


def test_crossings_of_a_table() -> None:
    table = runs({"dmc/cheetah-run-v0": 1e5}, [1.0, 4.0], [256], last=20)
    found = scaling.crossings(table, [300, 999])
    assert list(found["replay_ratio"]) == [1.0, 1.0, 4.0, 4.0]
    assert found["step"].isna().tolist() == [False, True, False, True]
    assert (found["last_step"] == 200_000).all() and (found["runs"] == 5).all()
    curves = table[table["arguments"].str.contains('"replay_ratio": 4[,}]')].groupby("step")["value"].mean()
    expected = curves.index[np.argmax(scaling.isotonic(curves) >= 300)]
    assert found.loc[2, "step"] == expected
    for levels in ([], [0], [-5], [math.nan]):
        with pytest.raises(ValueError, match="levels must be"):
            scaling.crossings(table, levels)


def test_crossings_leave_out_what_comes_after_a_reset() -> None:
    head = {"agent": "a", "task": "dmc/walker-run-v0", "seed": 0, "metric": "return"}
    steps = [1_000, 2_000, 3_000, 4_000, 5_000]
    values = [100.0, 400.0, 0.0, 390.0, 600.0]
    plain = pd.DataFrame({**head, "arguments": "{}", "step": steps, "value": values})
    resetting = plain.assign(arguments=to_json({"replay_ratio": 2, "reset_gradient_steps": 4_000}))
    # With the dip, isotonic regression pools the second and third evaluations to 200.
    for table, options in (
        (plain, {}), (resetting, {"keep_after_reset": True}), (plain.assign(arguments='{"resets": []}'), {}),
    ):  # fmt: skip
        assert scaling.crossings(table, [350], **options)["step"].tolist() == [4_000]
    by_argument = plain.assign(arguments=to_json({"resets": [2_000]}))
    for table, options in ((resetting, {}), (plain, {"resets": [2_000]}), (by_argument, {})):
        assert scaling.crossings(table, [350], **options)["step"].tolist() == [2_000]


def test_gradient_steps_between_resets_count_from_the_warm_up_on() -> None:
    head = {"task": "dmc/walker-run-v0", "seed": 0, "metric": "return", "step": np.arange(1, 11) * 1_000}
    given = {"replay_ratio": 2, "reset_gradient_steps": 6_000}

    def resets(agent: str, **more: Any) -> tuple[float, ...]:
        table = pd.DataFrame({"agent": agent, "arguments": to_json(given | more), **head, "value": 1.0})
        (found,) = configurations(table)
        return found.resets

    assert resets("a") == (3_000, 6_000, 9_000)
    assert resets("a", learning_starts=1_000) == (4_000, 7_000, 10_000)
    # The class's own 2,500.
    assert resets("bro_fast") == resets("BRO Fast") == (5_500, 8_500)
    assert resets("dr_q") == () and resets("drq") == (4_000, 7_000, 10_000)
    assert resets("BRO", learning_starts=0) == (3_000, 6_000, 9_000)
    # In steps of the simulator.
    assert resets("a", learning_starts=1_000, env_kwargs={"action_repeat": 2}) == (8_000,)
    assert resets("a", replay_ratio=7, learning_starts=0)[:2] == pytest.approx([6_000 / 7, 12_000 / 7])


def test_the_best_batch_size_is_found() -> None:
    table = runs(TASKS, [1.0, 4.0, 16.0], [32, 64, 128, 256, 512])
    found = scaling.best_hyperparameters(table, 500)
    assert set(found["name"]) == {"batch_size"} and len(found) == 6
    assert (found["decided"] == 1).all()
    law = scaling.fit_hyperparameter(found)
    assert law.slope == pytest.approx(-0.5, abs=0.12)
    assert law.mean(1.0) == pytest.approx(256, rel=0.25)


def test_a_value_that_never_reaches_the_level_is_not_chosen() -> None:
    table = runs({"dmc/cheetah-run-v0": 1e5}, [1.0], [64, 256])
    # The smallest never learns; then neither does the other.
    dead = table["arguments"].str.contains('"batch_size": 64')
    found = scaling.best_hyperparameters(table.assign(value=table["value"].where(~dead, 0.0)), 500)
    assert found["value"].tolist() == [256.0]
    with pytest.raises(ValueError, match="level must be one that runs reach"):
        scaling.best_hyperparameters(table.assign(value=0.0), 500)


def test_from_a_table_to_settings(tmp_path: Path) -> None:
    table = runs(TASKS, [1.0, 2.0, 4.0, 8.0], [64, 128, 256], model_size="0.55M", learning_rate=3e-4)
    laws = scaling.fit(table, [200, 300, 400, 500], reps=60)
    assert laws.replay_ratios == [1, 2, 4, 8] and laws.seeds == 5 and laws.critic_params == 5.5e5
    slope = laws.interval(laws.hyperparameters["batch_size"].slopes)
    assert slope.low < slope.value < slope.high and slope.value == pytest.approx(-0.4, abs=0.2)
    data = scaling.summary(laws)["data"][-1]
    assert data["fitted"] == pytest.approx(data["steps"], rel=0.1)
    assert all(row["alpha"]["low"] < row["alpha"]["value"] < row["alpha"]["high"] for row in [data])
    scaling.write_laws(laws, tmp_path / "laws.json")
    json.loads((tmp_path / "laws.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    again = scaling.read_laws(tmp_path / "laws.json")
    for asked in ({"replay_ratio": 16.0}, {"compute": 1e15}, {"data": 5e5}, {"budget": 5e15}):
        one, other = laws.predict(**asked), again.predict(**asked)
        assert one.params() == other.params() and one.steps == pytest.approx(other.steps)
        assert one.steps.low <= one.steps.value <= one.steps.high
    found = again.predict(replay_ratio=16.0)
    assert re.fullmatch(
        r"""replay_ratio:16 batch_size:\d+ learning_rate:0.0003 model_size:"'0.55M'\"""", found.params()
    )
    assert found.others == {"model_size": "0.55M"} and shlex.split(found.params())[-1] == "model_size:'0.55M'"
    found = found._replace(others={"resets": [], "buffer_size": 100, "note": 'a "$x"'})
    assert [word.partition(":")[2] for word in shlex.split(found.params())[-3:]] == ["[]", "100", "'a \"$x\"'"]
    of_before = json.loads((tmp_path / "laws.json").read_text())
    del of_before["others"]
    (tmp_path / "before.json").write_text(json.dumps(of_before))
    assert scaling.read_laws(tmp_path / "before.json").predict(replay_ratio=16.0).others == {}
    found = again.predict(replay_ratio=16.0)
    assert any("extrapolated" in limit for limit in found.limits)
    slow, fast = (again.predict(replay_ratio=4.0, task=task).steps.value for task in reversed(TASKS))
    assert slow / fast == pytest.approx(3, rel=0.15)
    for task in (None, *TASKS):
        found = again.predict(budget=5e15, task=task)
        flops = 10 * 5.5e5 * found.batch_size.value * found.replay_ratio.value * found.steps.value
        assert found.compute.value == pytest.approx(flops)
        assert flops + again.delta * found.steps.value == pytest.approx(5e15)
        assert any("replay ratio is that of all tasks" in limit for limit in found.limits) == (task is not None)
    with pytest.raises(ValueError, match="task must be one of the laws', .*, not 'typo'"):
        again.predict(budget=5e15, task="typo")
    levels = [dataclasses.replace(again.levels[0], left_out=["dmc/dog-run-v0"]), *again.levels[1:]]
    limits = dataclasses.replace(again, levels=levels).predict(budget=5e15).limits
    assert any(re.fullmatch(r"level \d+: without dmc/dog-run-v0, which do not reach it", limit) for limit in limits)
    for asked, words in (
        ({}, "exactly one"), ({"data": 1e5, "compute": 1e15}, "exactly one"), ({"budget": -1.0}, "budget must be"),
        ({"replay_ratio": 100.0}, "warrant 0.25 to 32"), ({"data": 10.0}, "steps must be above"),
        ({"compute": 1.0}, "compute must be at least"), ({"replay_ratio": 2.0, "level": 900}, "level must be one of"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            again.predict(**asked)


def test_what_a_table_does_not_allow() -> None:
    with pytest.raises(ValueError, match="at least two replay ratios"):
        scaling.fit(runs(TASKS, [2.0], [256]), [300])
    table = runs(TASKS, [1.0, 2.0, 4.0], [256])
    with pytest.raises(ValueError, match=r"none of 5000 is.*reached at 0 of 3"):
        scaling.fit(table, [5_000], reps=10)
    laws = scaling.fit(table, [300, 5_000], reps=10)
    assert [each.level for each in laws.levels] == [300]
    assert any("level 5000" in note for note in laws.notes) and any("critic_params" in note for note in laws.notes)
    with pytest.raises(ValueError, match="compute needs the size"):
        laws.predict(compute=1e15)
    alone = scaling.fit(table[table["task"] == "dmc/cheetah-run-v0"], [300], reps=10)
    assert any(note.startswith("one task") for note in alone.notes)
    one = scaling.fit(table[table["seed"] == 0], [300], reps=10)
    assert math.isnan(one.predict(replay_ratio=2.0).steps.low) and any("one seed" in note for note in one.notes)
    with pytest.raises(ValueError, match="agent must be given"):
        scaling.fit(pd.concat([table, table.assign(agent="other")]), [300])


def test_a_task_that_fails_at_one_ratio_gives_a_bound_and_one_that_fails_at_most_is_named() -> None:
    table = runs(TASKS, [1.0, 2.0, 4.0, 8.0], [256])
    first = table["arguments"].str.contains('"replay_ratio": 1[,}]') & (table["task"] == "dmc/walker-run-v0")
    laws = scaling.fit(table.assign(value=table["value"].where(~first, 0.0)), [400], reps=10)
    assert laws.levels[0].censored.tolist() == [True, False, False, False] and laws.levels[0].left_out == []
    most = ~table["arguments"].str.contains('"replay_ratio": 8[,}]') & (table["task"] == "dmc/walker-run-v0")
    laws = scaling.fit(table.assign(value=table["value"].where(~most, 0.0)), [400], reps=10)
    assert laws.levels[0].left_out == ["dmc/walker-run-v0"]


def test_what_is_not_determined_has_no_number_and_the_rest_has_one() -> None:
    laws = scaling.fit(runs({"dmc/cheetah-run-v0": 1e5}, [1.0, 2.0, 4.0], [256], seeds=2), [400], reps=4)
    for (d_min, beta, alpha), told in (
        ((1e5, 1.5, 0.8), {"d_min", "beta", "alpha"}),
        ((1e5, 1e-6, 2.0), {"d_min"}),  # flat
        ((1.0, 1e10, 0.5), {"alpha"}),  # a power
    ):
        stages = [scaling.DataLaw(*(np.full(n, value) for value in (d_min, beta, alpha))) for n in (1, 4)]
        (level,) = laws.levels
        found = dataclasses.replace(laws, levels=[dataclasses.replace(level, laws=stages)])
        (row,) = scaling.summary(found)["data"]
        assert {name for name in ("d_min", "beta", "alpha") if row[name] is not None} == told
        assert (row["d_min"] or {}).get("value") == (d_min if "d_min" in told else None)


def test_the_median_of_a_task_does_not_depend_on_how_long_it_was_tried_in_vain() -> None:
    steps = np.array([[10.0, math.inf, 20.0, 30.0], [100.0, 200.0, 300.0, 400.0]])[..., None]
    for last in (5.0, 1_000.0):
        lasts = np.full((2, 4), last)
        mean, bounded, factors = scaling.normalize(steps, lasts)
        # Medians of 10, 20, 30, inf and of 100, 200, 300, 400; their median is 137.5.
        assert factors[:, 0] == pytest.approx([25 / 137.5, 250 / 137.5])
        assert bounded[:, 0].tolist() == [False, True, False, False]
        assert mean[[0, 2, 3], 0] == pytest.approx([55, 137.5, 192.5])
        assert mean[1, 0] == pytest.approx((last * 137.5 / 25 + 110) / 2)
    # A sample in which half is not reached has no median: it alone has no value.
    worse = steps.copy()
    worse[0, 0] = math.inf
    mean, _, factors = scaling.normalize(np.stack([steps, worse]), np.full((2, 4), 5.0))
    assert np.isfinite(mean[0]).all() and np.isnan(mean[1]).all() and np.isnan(factors[1]).all()


def test_a_run_that_ended_early_is_no_quick_one() -> None:
    table = runs(TASKS, [1.0, 2.0, 4.0, 8.0], [256], model_size="0.55M")
    slow = table["arguments"].str.contains('"replay_ratio": 1[,}]') & (table["task"] == "dmc/walker-run-v0")
    short = table[~slow | (table["step"] <= 60_000)]
    whole, found = (scaling.fit(each, [400, 450, 500], reps=40) for each in (table, short))
    for one, other in zip(whole.levels, found.levels, strict=True):
        assert other.censored.tolist() == [True, False, False, False] and one.censored.sum() == 0
        ratio = [each.factors[1] / each.factors[0] for each in (one, other)]
        # Of three steps that are reached the median is the middle one of three, not of four with a small one below.
        assert ratio[1] == pytest.approx(ratio[0], rel=0.1)
        assert other.points[1:] == pytest.approx(one.points[1:], rel=0.1) and other.points[0] <= one.points[0]


def test_samples_without_a_median_have_no_value_and_the_others_an_interval() -> None:
    table = runs({"dmc/cheetah-run-v0": 1e5}, [1.0, 2.0, 4.0, 8.0, 16.0], [256], seeds=4, model_size="0.55M")
    # Two ratios fail in all seeds, a third in three of four: a third of the samples lacks the seed that does not.
    given = table["arguments"].map(lambda text: json.loads(text)["replay_ratio"])
    table = table.assign(value=table["value"].where(given < 8, 0.0))
    table = table.assign(value=table["value"].where((given != 4) | (table["seed"] == 0), 0.0))
    levels = [60, 90, 120, 150]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        laws = scaling.fit(table, levels, reps=60)
        lost = [np.isnan(level.laws[1].d_min) for level in laws.levels]
        assert sum(each.sum() for each in lost) > 0 and all(np.isfinite(each.points).all() for each in laws.levels)
        for level, missing in zip(laws.levels, lost, strict=True):
            assert all(np.array_equal(np.isnan(each), missing) for each in level.laws[1])
        scaling.summary(laws)
        found = laws.predict(replay_ratio=2.0, level=laws.levels[0].level)
    assert found.steps.low <= found.steps.value <= found.steps.high
    best = scaling.ComputeLaw(laws.levels[-1].laws[1], 256.0, 0.0, 5e5).best()
    assert np.array_equal(np.isnan(best.replay_ratio), lost[-1])


def test_the_steps_of_wrappers_that_skip_frames_are_the_agents() -> None:
    table = runs({"dmc/cheetah-run-v0": 1e5}, [1.0, 2.0, 4.0], [256], seeds=2)

    def given(**more: Any) -> pd.DataFrame:
        return table.assign(arguments=[to_json(json.loads(text) | more) for text in table["arguments"]])

    frames = "sb3_sample.envs.AtariFrames"
    for more, repeat in (
        ({"env_wrapper": frames}, 4), ({"env_wrapper": [{frames: {"frame_skip": 3}}]}, 3),
        ({"env_wrapper": frames, "env_kwargs": {"action_repeat": 2}}, 8), ({"env_wrapper": "a.Other"}, 1),
    ):  # fmt: skip
        found = configurations(given(**more, resets=[1_000]))
        assert {each.repeat for each in found} == {repeat} and {each.resets for each in found} == {(1_000 * repeat,)}
        points = scaling.fit(given(**more), [400], reps=2).levels[0].points
        assert points == pytest.approx(scaling.fit(table, [400], reps=2).levels[0].points / repeat)


def swept(more: dict[float, tuple[float, ...]], ratios: tuple[float, ...] = (1.0, 2.0, 4.0)) -> pd.DataFrame:
    """Three batch sizes at the learning rate 3e-4; the middle one at further learning rates too, which come first."""
    parts = []
    for ratio in ratios:
        best = round(256 * ratio**-0.5)
        for rate in more.get(ratio, ()):
            parts.append(runs({"dmc/cheetah-run-v0": 1e5}, [ratio], [best], seeds=2, learning_rate=rate))
        parts.append(
            runs({"dmc/cheetah-run-v0": 1e5}, [ratio], [best // 2, best, 2 * best], seeds=2, learning_rate=3e-4)
        )
    return pd.concat(parts, ignore_index=True)


def test_the_data_law_is_of_one_learning_rate() -> None:
    plain = scaling.fit(swept({}), [400], reps=2, draws=10)
    table = swept({1.0: (1.5e-4, 6e-4)})
    laws = scaling.fit(table, [400], reps=2, draws=10)
    # Swept at one replay ratio only: without a law, so that it has no part in what is nearest.
    assert list(laws.hyperparameters) == ["batch_size"] and laws.learning_rate == plain.learning_rate == 3e-4
    assert laws.levels[0].points == pytest.approx(plain.levels[0].points)
    (said,) = [limit for limit in laws.predict(replay_ratio=2.0).limits if limit.startswith("learning_rate")]
    assert said == "learning_rate was swept, but has no law: it is that of the runs"
    (said,) = [limit for limit in plain.predict(replay_ratio=2.0).limits if limit.startswith("learning_rate")]
    assert said == "learning_rate was not swept: it is that of the runs"
    # One batch size throughout: the learning rate of all runs, though neither has a law.
    batch = table["arguments"].map(lambda text: json.loads(text)["batch_size"])
    ratio = table["arguments"].map(lambda text: json.loads(text)["replay_ratio"])
    middle = table[batch == (256 * ratio**-0.5).round()]
    assert scaling.fit(middle, [400], reps=2, draws=10).learning_rate == 3e-4


def test_without_a_learning_rate_that_all_have_it_is_the_chosen_one_or_none() -> None:
    def cell(ratio: float, rates: list[float]) -> Cell:
        made = Configuration("a", "{}", "t", np.array([1]), np.ones((1, 1)))
        return Cell("t", ratio, np.full(len(rates), 128.0), np.array(rates), [made] * len(rates))

    def rates(grid: list[Cell], values: list[float]) -> list[float]:
        chosen = {"learning_rate": pd.DataFrame({"task": "t", "replay_ratio": [1.0], "value": values})}
        return [float(one.learning_rates[0]) for one in _pick(grid, {}, chosen).values()]

    apart = [cell(1.0, [1e-4, 4e-4]), cell(2.0, [3e-4])]
    assert rates(apart, [3.5e-4]) == [4e-4, 3e-4] and rates(apart, [1.2e-4]) == [1e-4, 3e-4]
    assert rates([cell(1.0, [1e-4, 4e-4, 3e-4]), cell(2.0, [3e-4])], [1e-4]) == [3e-4, 3e-4]
    # Runs that were not given it have the default, which is one value too.
    assert np.isnan(rates([cell(1.0, [1e-4, math.nan]), cell(2.0, [math.nan])], [1e-4])).all()
    with pytest.raises(ValueError, match=r"on t at replay ratio 1 have 2 values of learning_rate, .* \(choice_level="):
        rates(apart, [math.nan])


# ---------------------------------------------------------------- intervals


def test_intervals_cover_a_mean() -> None:
    rng = np.random.default_rng(3)
    n, covered = 10, np.zeros(2)
    for _ in range(400):
        values = rng.normal(1.0, 1.0, n)
        reps = values[rng.integers(0, n, (500, n))].mean(axis=1)
        for i, (low, high) in enumerate((interval(values.mean(), reps, None), interval(values.mean(), reps, n))):
            covered[i] += low <= 1 <= high
    # Measured: 0.91 and 0.96.
    assert covered[0] / 400 < covered[1] / 400
    assert 0.92 <= covered[1] / 400 <= 0.99


def test_few_seeds_have_intervals_beyond_their_samples() -> None:
    rng = np.random.default_rng(4)
    covered = np.zeros(2)
    for _ in range(300):
        values = np.exp(rng.normal(0, 0.3, 3))
        reps = np.exp(np.log(values)[rng.integers(0, 3, (300, 3))].mean(axis=1))
        point = np.exp(np.log(values).mean())
        for i, (low, high) in enumerate((interval(point, reps, None), interval(point, reps, 3))):
            covered[i] += 0 < low <= 1 <= high
    assert covered[0] < 0.85 * 300
    assert covered[1] >= 0.9 * 300


def test_an_interval_of_samples_without_values_is_none() -> None:
    reps = np.array([[1.0, np.nan], [2.0, np.nan], [3.0, np.nan], [np.inf, 4.0]])
    low, high = interval(np.array([2.0, 4.0]), reps, None)
    assert 1 <= low[0] <= high[0] <= 3 and np.isnan(low[1]) and np.isnan(high[1])


def test_samples_of_one_budget_have_no_law() -> None:
    """Levels that a sample passes at the same evaluations; the other samples have theirs."""
    budgets = np.array([[1e12, 1e12, 1e12], [1e12, 2e12, 4e12]])
    law = scaling.fit_budget(budgets, np.array([[4.0, 4.0, 4.0], [8.0, 4.0, 2.0]]))
    assert np.isnan(law.exponent[0]) and law.exponent[1] == pytest.approx(-1)
    with pytest.raises(ValueError, match="budgets must differ"):
        scaling.fit_budget(budgets[:1], np.full((1, 3), 4.0))


def test_a_size_law_far_from_a_replay_ratio_of_1() -> None:
    ratios, sizes = (each.ravel() for each in np.meshgrid([5.0, 10.0, 15.0], [1e6, 4e6, 1.6e7]))
    law = scaling.SizeLaw(1e6, 20.0, 2.0, 2e5, 0.5)
    found = scaling.fit_model_size(ratios, sizes, law.steps(ratios, sizes))
    np.testing.assert_allclose(found, law, rtol=1e-3)
