"""The papers' studies on made-up tables whose answers are worked by hand."""

import math
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sb3_sample import study
from sb3_sample.study.aggregate import differing_arguments, named_apart
from sb3_sample.study.analysis import argument, final, symlog
from sb3_sample.study.plan import Run
from sb3_sample.study.reporting.planned import missing_runs
from tests.study.made_up import made_up, write_run

pytest.importorskip("rliable.library")

CHEETAH, WALKER, DOG, PUSH = "dmc/cheetah-run-v0", "dmc/walker-run-v0", "dmc/dog-run-v0", "metaworld/push-v3"


def grid(tasks=(CHEETAH, WALKER), seeds=(0, 1), leave_out=()) -> pd.DataFrame:
    """
    Two critic regularizations (0, 100) by two networks (0, 20), whose effects add up, and both together give 40 more;
    the second task 200 more than the first, the second seed 2 more.
    """
    rows = []
    for i, critic in enumerate(("none", "cdq")):
        for j, network in enumerate(("none", "layer_norm")):
            for k, task in enumerate(tasks):
                for seed in seeds:
                    if (critic, network, task) in leave_out:
                        continue
                    value = 100 * i + 20 * j + 40 * i * j + 200 * k + 2 * seed
                    arguments = {"critic": critic, "network": network}
                    rows.append(("a", arguments, task, seed, 10, "return", float(value)))
    return made_up(rows)


# ---------------------------------------------------------------- marginalisation


def test_first_order() -> None:
    found = study.marginalize(grid(), groups=["all"], reps=20)
    assert list(found) == [
        "group", "critic", "network", "mean", "standard_error", "iqm", "low", "high", "tasks", "runs",
    ]  # fmt: skip
    assert [tuple(row) for row in found[["critic", "network"]].to_numpy()] == [
        ("cdq", ""), ("none", ""), ("", "layer_norm"), ("", "none"),
    ]  # fmt: skip
    # cdq: 100 and 160 over the networks, 101 and 161 over the seeds, on the second task 200 more.
    np.testing.assert_allclose(found["mean"], [0.231, 0.111, 0.191, 0.151])
    # Of cdq's eight runs, 100, 102, 160, 162, 300, 302, 360, 362, the middle four.
    assert found["iqm"].iloc[0] == pytest.approx((160 + 162 + 300 + 302) / 4_000)
    values = np.array([100, 102, 160, 162, 300, 302, 360, 362]) / 1_000
    assert found["standard_error"].iloc[0] == pytest.approx(values.std(ddof=1) / math.sqrt(8))
    assert (found["runs"] == 8).all() and (found["tasks"] == 2).all()
    assert (found["low"] <= found["iqm"]).all() and (found["iqm"] <= found["high"]).all()


def test_second_order_and_order_of_all() -> None:
    found = study.marginalize(grid(), order=2, groups=["all"], reps=20).set_index(["critic", "network"])
    assert found["mean"].to_dict() == pytest.approx(
        {("cdq", "layer_norm"): 0.261, ("cdq", "none"): 0.201, ("none", "layer_norm"): 0.121, ("none", "none"): 0.101}
    )
    with pytest.raises(ValueError, match=r"order must be .* 1 to 2, the number of factors \(critic, network\), not 3"):
        study.marginalize(grid(), order=3)


def test_third_order_is_the_cells_and_lower_orders_are_averages_of_them() -> None:
    rows = []
    rng = np.random.default_rng(0)
    for a in "xyz":
        for b in "xy":
            for c in "xy":
                rows += [
                    ("a", {"a": a, "b": b, "c": c, "rr": rr}, CHEETAH, seed, 10, "return", rng.random() * 1_000)
                    for rr in (2, 16)
                    for seed in range(3)
                ]
    table = made_up(rows)
    cells = study.marginalize(table, order=3, by=["rr"], groups=["dmc"], reps=2)
    pairs = study.marginalize(table, order=2, by=["rr"], groups=["dmc"], reps=2)
    assert len(cells) == 2 * 12 and len(pairs) == 2 * (6 + 6 + 4) and list(cells["rr"].unique()) == ["2", "16"]
    of_cells = cells.groupby(["rr", "a", "b"])["mean"].mean()
    of_pairs = pairs[pairs["c"] == ""].set_index(["rr", "a", "b"])["mean"]
    np.testing.assert_allclose(of_pairs, of_cells.reindex(of_pairs.index))
    assert set(pairs[pairs["c"] == ""]["runs"]) == {6} and set(cells["runs"]) == {3}


def test_groups_of_tasks_are_marginalised_by_themselves() -> None:
    found = study.marginalize(grid((CHEETAH, DOG)), {"critic": ["critic"]}, groups=["dmc without dogs", "dogs"], reps=2)
    np.testing.assert_allclose(found["mean"], [0.131, 0.011, 0.331, 0.211])


def test_several_arguments_can_be_one_choice() -> None:
    factors = {"both": ["critic", "network"]}
    found = study.marginalize(grid(), factors, groups=["all"], reps=2)
    assert found["both"].iloc[0] == "critic=cdq, network=layer_norm" and len(found) == 4


def test_the_agent_can_be_a_factor() -> None:
    table = pd.concat([grid(), grid().assign(agent="b", value=lambda rows: rows["value"] + 50)])
    found = study.marginalize(table, {"agent": ["agent"], "critic": ["critic"]}, groups=["all"], reps=2)
    assert found.set_index(["agent", "critic"])["mean"].to_dict() == pytest.approx(
        {("a", ""): 0.171, ("b", ""): 0.221, ("", "cdq"): 0.256, ("", "none"): 0.136}
    )
    of_b = study.marginalize(table, by=["agent"], groups=["all"], reps=2)
    np.testing.assert_allclose(of_b[of_b["agent"] == "b"]["mean"], [0.281, 0.161, 0.241, 0.201])


def test_missing_combinations_are_said() -> None:
    with pytest.warns(UserWarning, match=r"1 of 8 combinations of choices and tasks have no run in 'all'"):
        study.marginalize(grid(leave_out=[("cdq", "none", WALKER)]), groups=["all"], reps=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study.marginalize(grid(), groups=["all"], reps=2)


def test_factors_that_are_none() -> None:
    with pytest.raises(ValueError, match="arguments must be of those of the runs, critic, network, not 'size'"):
        study.marginalize(grid(), {"size": ["size"]})
    with pytest.raises(ValueError, match="differ in no argument"):
        study.marginalize(made_up([("a", {}, CHEETAH, 0, 10, "return", 1.0)]))
    with pytest.raises(ValueError, match="other names than the table's columns, not mean"):
        study.marginalize(grid(), {"mean": ["critic"]})


# ---------------------------------------------------------------- ends of runs


def test_the_last_evaluations_are_averaged() -> None:
    rows = [("a", {}, CHEETAH, 0, step, "return", float(step)) for step in range(1, 21)]
    rows += [("a", {}, CHEETAH, 0, step, "diagnostics/x", float(step)) for step in range(0, 20, 4)]
    found = final(made_up(rows[::-1]), ["diagnostics/x"]).iloc[0]
    assert found["score"] == pytest.approx(0.0155) and found["step"] == 20 and found["diagnostics/x"] == 8
    assert final(made_up(rows), last=2)["score"].iloc[0] == pytest.approx(0.0195)
    rows.append(("a", {}, CHEETAH, 1, 5, "return", 1.0))
    with pytest.warns(UserWarning, match="runs end at different steps, from 5 to 20") as record:
        both = final(made_up(rows), ["diagnostics/x"])
    assert np.isnan(both["diagnostics/x"].iloc[1])
    assert len(record) == 1
    with pytest.raises(ValueError, match="metrics must be of diagnostics/x, return, not 'y'"):
        final(made_up(rows[:-1]), ["y"])
    with pytest.raises(ValueError, match="last must be"):
        final(made_up(rows), last=0)


def test_arguments_as_text() -> None:
    rows = made_up(
        [("a", {"p": {"n": [8]}, "q": "x"}, CHEETAH, 0, 1, "return", 1.0), ("a", {}, WALKER, 0, 1, "r", 1.0)]
    )
    assert argument(rows, "p.n") == ["[8]", "default"] and argument(rows, "q") == ["x", "default"]


def test_no_value_is_another_than_the_default(tmp_path: Path) -> None:
    """BRO without quantile critics is n_quantiles=None; by default it has 100."""
    for name, arguments in (("given", {"n_quantiles": None}), ("not", {})):
        write_run(tmp_path / name, seed=len(name), arguments=arguments)
    rows = study.read(tmp_path)
    assert set(rows["arguments"]) == {'{"n_quantiles": null}', "{}"}
    assert set(argument(rows, "n_quantiles")) == {"none", "default"}
    assert differing_arguments(rows) == ["n_quantiles"]
    assert set(named_apart(rows)["agent"]) == {"bro (n_quantiles=none)", "bro (n_quantiles=default)"}
    grid = [Run("A", "bro", {"n_quantiles": each}, {"n_quantiles": each}, CHEETAH, 0, 10) for each in (None, 50)]
    assert [run.label for run in grid] == ["A (n_quantiles=none)", "A (n_quantiles=50)"]
    there = pd.DataFrame({"agent": ["A"], "arguments": ["{}"], "task": [CHEETAH], "seed": [0]})
    assert missing_runs(grid, there) == grid
    assert missing_runs(grid, there.assign(arguments='{"n_quantiles": null}')) == grid[1:]


# ---------------------------------------------------------------- correlation


def correlated() -> pd.DataFrame:
    """Five runs of a task: the score falls as the overestimation rises, but for a swap; a share is one number."""
    rows = []
    for seed, (score, over) in enumerate(zip((500, 400, 300, 200, 100), (1, 10, 100, 10_000, 1_000), strict=True)):
        rows.append(("a", {}, CHEETAH, seed, 10, "return", float(score)))
        rows.append(("a", {}, CHEETAH, seed, 10, "diagnostics/over", float(over)))
        rows.append(("a", {}, CHEETAH, seed, 10, "diagnostics/dormant_critic", 0.5))
    return made_up(rows)


def test_rank_correlations_by_hand() -> None:
    """rho = 1 - 6 sum(d^2) / (n (n^2 - 1)) of the ranks 5 4 3 2 1 and 1 2 3 5 4: 1 - 6 * 38 / 120 = -0.9."""
    metrics = ["diagnostics/over", "diagnostics/dormant_critic"]
    found = study.correlate(correlated(), metrics, groups=["dmc"]).set_index(["x", "y"])
    assert len(found) == 9 and set(found["runs"]) == {5}
    cell = found.loc["score", "diagnostics/over"]
    assert cell["spearman"] == pytest.approx(-0.9)
    # t = rho sqrt((n - 2) / (1 - rho^2)) = -3.5762, with three degrees of freedom.
    assert cell["p"] == pytest.approx(0.0373861, rel=1e-4)
    assert found.loc["diagnostics/over", "score"]["spearman"] == pytest.approx(-0.9)
    assert found.loc["score", "score"]["spearman"] == pytest.approx(1)
    assert np.isnan(found.loc["score", "diagnostics/dormant_critic"]["spearman"])


def test_correlations_that_may_be_chance_are_blank() -> None:
    found = study.correlate(correlated(), ["diagnostics/over"], groups=["dmc"], level=0.03).set_index(["x", "y"])
    cell = found.loc["score", "diagnostics/over"]
    assert np.isnan(cell["spearman"]) and cell["p"] == pytest.approx(0.0373861, rel=1e-4)
    with pytest.raises(ValueError, match="level must be"):
        study.correlate(correlated(), ["diagnostics/over"], level=2)


def test_correlations_by_an_argument() -> None:
    table = correlated().assign(arguments='{"rr": 2}')
    other = table.assign(arguments='{"rr": 16}', value=np.where(table["metric"] == "return", -1, 1) * table["value"])
    found = study.correlate(pd.concat([table, other]), ["diagnostics/over"], by=["rr"], groups=["all"])
    rho = found[(found["x"] == "score") & (found["y"] == "diagnostics/over")].set_index("rr")["spearman"]
    assert rho.to_dict() == pytest.approx({"2": -0.9, "16": 0.9})


def test_regressions_by_hand() -> None:
    """Score (x 1,000) on u = 0, 1, 2, 3: 0, 2, 2, 4. Slope 1.2, intercept 0.2, residuals -0.2, 0.6, -0.6, 0.2."""
    rows = []
    for seed, score in enumerate((0.0, 2_000.0, 2_000.0, 4_000.0)):
        rows.append(("a", {}, CHEETAH, seed, 10, "return", score))
        # Of these the symmetric logarithm is 0, 1, 2, 3; and of a share it is not taken.
        rows.append(("a", {}, CHEETAH, seed, 10, "diagnostics/norm", math.expm1(seed)))
        rows.append(("a", {}, CHEETAH, seed, 10, "diagnostics/dormant_critic", float(seed)))
    found = study.regress(made_up(rows), ["diagnostics/norm", "diagnostics/dormant_critic"])
    assert list(found["log"]) == [True, False]
    for _, row in found.iterrows():
        assert row["slope"] == pytest.approx(1.2) and row["intercept"] == pytest.approx(0.2)
        # Residual sum of squares 0.8, total 8; variance of the slope 0.8 / 2 / 5.
        assert row["r_squared"] == pytest.approx(0.9) and row["standard_error"] == pytest.approx(math.sqrt(0.08))
        # t = 1.2 / sqrt(0.08) = 4.2426 with two degrees of freedom: p = 1 - t / sqrt(t^2 + 2).
        assert row["p"] == pytest.approx(1 - math.sqrt(0.9), rel=1e-6) and row["runs"] == 4
    np.testing.assert_allclose(symlog([-math.expm1(2), 0, math.expm1(1)]), [-2, 0, 1])


def test_regressions_are_task_by_task() -> None:
    table = pd.concat([correlated(), correlated().assign(task=WALKER)])
    assert list(study.regress(table, ["diagnostics/over"])["task"]) == [CHEETAH, WALKER]
    few = correlated()[correlated()["seed"] < 2]
    assert study.regress(few, ["diagnostics/over"])[["slope", "p"]].isna().all(axis=None)


def test_regressions_leave_out_infinite_values_and_say_so() -> None:
    rows = []
    for seed, score in enumerate((0.0, 2_000.0, 2_000.0, 4_000.0)):
        rows.append(("a", {}, CHEETAH, seed, 10, "return", score))
        rows.append(("a", {}, CHEETAH, seed, 10, "diagnostics/norm", math.expm1(seed)))
    rows += [("a", {}, CHEETAH, 4, 10, "return", 1.0), ("a", {}, CHEETAH, 4, 10, "diagnostics/norm", math.inf)]
    with pytest.warns(UserWarning, match=f"1 of 5 runs on {CHEETAH} have an infinite diagnostics/norm or score"):
        (row,) = study.regress(made_up(rows), ["diagnostics/norm"]).to_dict("records")
    # As without the run, by hand above.
    assert (row["slope"], row["intercept"], row["r_squared"]) == pytest.approx((1.2, 0.2, 0.9)) and row["runs"] == 4


def test_groups_may_have_tasks_that_are_not_evaluated_yet() -> None:
    early = correlated()[lambda table: table["metric"] != "return"].assign(task=WALKER)
    table = pd.concat([correlated(), early])
    groups = {"mine": [CHEETAH, WALKER]}
    found = study.correlate(table, ["diagnostics/over"], groups=groups).set_index(["x", "y"])
    assert found.loc["score", "diagnostics/over"]["spearman"] == pytest.approx(-0.9)
    hours = made_up([("a", {}, WALKER, 0, 10, "hours", 1.0)])
    found = study.marginalize(pd.concat([grid(tasks=(CHEETAH,)), hours]), groups=groups, reps=5)
    assert set(found["group"]) == {"mine"} and set(found["tasks"]) == {1}
    table = pd.concat([sized(), hours])
    (first, second) = (study.cost(table, [100], each, reps=5) for each in (["dmc"], groups))
    pd.testing.assert_frame_equal(first.drop(columns="group"), second.drop(columns="group"))


# ---------------------------------------------------------------- two arguments, and costs


def sized() -> pd.DataFrame:
    rows = []
    for i, size in enumerate(("26.3M", "0.55M", "4.92M")):
        for rr in (10, 2):
            if (size, rr) == ("26.3M", 2):
                continue
            arguments = {"model_size": size, "replay_ratio": rr}
            for step in (100, 200):
                for seed in (0, 1):
                    rows.append(("a", arguments, CHEETAH, seed, step, "return", 100.0 * i + rr + step))
                    rows.append(("a", arguments, CHEETAH, seed, step, "hours", rr * step / 100 + seed))
    return made_up(rows)


def test_two_arguments_against_a_score() -> None:
    found = study.heatmap(sized(), "model_size", "replay_ratio")
    assert list(found.columns) == ["0.55M", "4.92M", "26.3M"] and list(found.index) == ["2", "10"]
    np.testing.assert_allclose(found, [[0.302, 0.402, np.nan], [0.310, 0.410, 0.210]])
    early = study.heatmap(sized(), "model_size", "replay_ratio", step=150)
    np.testing.assert_allclose(early.loc["2", "0.55M"], 0.252)
    hours = study.heatmap(sized(), "model_size", "replay_ratio", "hours")
    np.testing.assert_allclose(hours.loc["10"], [20.5, 20.5, 20.5])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x": "size"}, "arguments must be of those of the runs, model_size, replay_ratio, not 'size'"),
        ({"value": "minutes"}, "value must be score or of hours, return, not 'minutes'"),
        ({"step": 1_000}, "step must be within those of the runs, up to 200, not 1,000"),
        ({"group": "metaworld"}, "there is none in metaworld"),
    ],
)
def test_heatmaps_that_there_are_not(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        study.heatmap(sized(), **{"x": "model_size", "y": "replay_ratio"} | arguments)


def test_score_against_hours() -> None:
    table = pd.concat([sized(), made_up([("b", {}, CHEETAH, 0, step, "return", 5.0) for step in (100, 200)])])
    found = study.cost(table, [100, 200], ["all"], reps=5).set_index(["agent", "step"])
    name = "a (model_size=4.92M, replay_ratio=10)"
    assert found.loc[(name, 200), "iqm"] == pytest.approx(0.41) and found.loc[(name, 200), "hours"] == pytest.approx(
        20.5
    )
    assert found.loc[(name, 100), "hours"] == pytest.approx(10.5)
    assert found.loc[(name, 200), "steps_per_second"] == pytest.approx(200 / 20.5 / 3_600)
    assert np.isnan(found.loc[("b", 200), "hours"])
    with pytest.raises(ValueError, match="'hours' of at least one run"):
        study.cost(grid())


def test_a_heatmap_says_its_step_and_what_it_leaves_out() -> None:
    table = sized()
    short = (table["seed"] == 1) & (table["step"] == 200) & table["arguments"].str.contains("4.92M")
    with pytest.warns(UserWarning, match="are left out") as told:
        found = study.heatmap(table[~short], "model_size", "replay_ratio", step=200)
    assert found.attrs["step"] == 200
    assert [str(each.message) for each in told] == [
        f"1 of 2 runs of model_size=4.92M, replay_ratio={rr} have no evaluations around step 200 and are left out"
        for rr in (10, 2)
    ]
    other = table[table["arguments"].str.contains("0.55M")].assign(task=WALKER)
    with pytest.warns(
        UserWarning, match=r"cells are not of the same tasks \(.*model_size=4.92M, replay_ratio=2 1.* of 2\)"
    ):
        assert study.heatmap(pd.concat([table, other]), "model_size", "replay_ratio").attrs["step"] == 200


def test_common_costs_are_of_the_tasks_of_the_score() -> None:
    """Of the second task, which b lacks, a step takes ten times as long."""
    rows = []
    for agent, task, hours in (("a", CHEETAH, 1.0), ("a", WALKER, 10.0), ("b", CHEETAH, 2.0)):
        for seed in (0, 1):
            rows += [(agent, {}, task, seed, 100, "return", 5.0), (agent, {}, task, seed, 100, "hours", hours)]
    found = study.cost(made_up(rows), [100], {"mine": [CHEETAH, WALKER]}, common=True, reps=5).set_index("agent")
    assert found["hours"].to_dict() == {"a": 1.0, "b": 2.0} and (found["tasks"] == 1).all()
    assert found["steps_per_second"]["a"] == pytest.approx(100 / 3_600)


def test_marginals_of_unequal_numbers_of_runs_are_said() -> None:
    table = grid()
    more = grid(seeds=(2, 3))
    more = more[more["arguments"] == more["arguments"].iloc[0]]
    with pytest.warns(UserWarning, match="combinations of choices and tasks have 2 to 4 runs in 'all'"):
        study.marginalize(pd.concat([table, more]), groups=["all"], reps=2)
