"""Scores over tasks and seeds: BRO's table 9, rliable called directly, and tables worked by hand."""

import warnings
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sb3_sample import study
from sb3_sample.envs.scores import score_of
from sb3_sample.study.aggregate import iqm, scored, warn_of_unknown
from sb3_sample.study.analysis import argument
from tests.study.made_up import made_up

library = pytest.importorskip("rliable.library")
metrics = pytest.importorskip("rliable.metrics")

CHEETAH, WALKER, PUSH = "dmc/cheetah-run-v0", "dmc/walker-run-v0", "metaworld/push-v3"
#: BRO, table 9: IQM of BRO and BRO Fast by group and step.
STEPS = (100_000, 200_000, 500_000, 1_000_000)
TABLE_9 = {
    "all": ((0.254, 0.560, 0.862, 0.945), (0.113, 0.384, 0.772, 0.878)),
    "dmc": ((0.230, 0.442, 0.726, 0.836), (0.123, 0.282, 0.613, 0.794)),
    "metaworld": ((0.247, 0.642, 0.984, 1.000), (0.113, 0.571, 0.929, 0.976)),
    "myosuite": ((0.392, 0.748, 0.888, 0.980), (0.124, 0.400, 0.776, 0.876)),
    "dog & humanoid": ((0.038, 0.238, 0.661, 0.864), (0.008, 0.056, 0.469, 0.772)),
}


@pytest.fixture(scope="module")
def published() -> pd.DataFrame:
    return study.published_runs(["BRO", "BRO Fast"])


def runs_of(agent: str, task: str, scores: list[float], step: int = 10, metric: str = "return", **arguments: object):
    """A row a seed."""
    return [(agent, arguments, task, seed, step, metric, score) for seed, score in enumerate(scores)]


# ---------------------------------------------------------------- published figures


def test_table_9_of_bro(published: pd.DataFrame) -> None:
    found = study.aggregate(published, steps=STEPS, reps=20)
    assert list(found["agent"].unique()) == ["BRO", "BRO Fast"] and list(found["group"].unique()) == list(TABLE_9)
    assert len(found) == 2 * 5 * 4
    for group, rows in TABLE_9.items():
        for agent, expected in zip(("BRO", "BRO Fast"), rows, strict=True):
            ours = found[(found["agent"] == agent) & (found["group"] == group)]
            assert list(ours["step"]) == list(STEPS)
            # Half of the third digit, and what single precision of the published seeds leaves.
            np.testing.assert_allclose(ours["iqm"], expected, atol=5.01e-4, rtol=0, err_msg=f"{agent}, {group}")
    counts = found[found["agent"] == "BRO"].drop_duplicates("group").set_index("group")
    assert dict(counts["tasks"]) == {"all": 40, "dmc": 15, "metaworld": 15, "myosuite": 10, "dog & humanoid": 7}
    assert (counts["runs"] == counts["tasks"] * 10).all()


def test_averages_and_intervals_are_those_of_rliable(published: pd.DataFrame) -> None:
    """Called directly, on a matrix that is made here."""
    dmc = published[(published["agent"] == "BRO") & published["task"].str.startswith("dmc/")]
    matrix = dmc[dmc["step"] == 500_000].pivot(index="seed", columns="task", values="value").to_numpy() / 1_000
    ours = study.aggregate(published, steps=[500_000], groups=["dmc"], reps=2_000).iloc[0]
    direct = {
        "": metrics.aggregate_iqm,
        "mean_": metrics.aggregate_mean,
        "median_": metrics.aggregate_median,
        "optimality_gap_": metrics.aggregate_optimality_gap,
    }
    state = np.random.get_state()
    np.random.seed(1)
    point, interval = library.get_interval_estimates(
        {"x": matrix}, lambda x: np.array([function(x) for function in direct.values()]), reps=2_000
    )
    np.random.set_state(state)
    for i, prefix in enumerate(direct):
        low, high = interval["x"][:, i]
        assert ours[prefix.rstrip("_") or "iqm"] == pytest.approx(point["x"][i], rel=1e-6)
        # Other samples: an end of an interval has some hundredths of its width of noise.
        np.testing.assert_allclose([ours[f"{prefix}low"], ours[f"{prefix}high"]], [low, high], atol=0.15 * (high - low))


def test_profiles_are_those_of_rliable(published: pd.DataFrame) -> None:
    dmc = published[(published["agent"] == "BRO Fast") & published["task"].str.startswith("dmc/")]
    matrix = dmc[dmc["step"] == 500_000].pivot(index="seed", columns="task", values="value").to_numpy() / 1_000
    taus = np.array([0.1, 0.5, 0.9])
    direct, interval = library.create_performance_profile({"x": matrix}, taus, reps=300)
    ours = study.performance_profiles(published, 500_000, taus, ["dmc"], reps=300)
    ours = ours[ours["agent"] == "BRO Fast"]
    np.testing.assert_allclose(ours["share"], direct["x"])
    np.testing.assert_allclose(ours[["low", "high"]].T, interval["x"], atol=0.02)
    assert len(study.performance_profiles(published, 500_000, groups=["dmc"], reps=2)) == 2 * 101


def test_the_probability_of_improvement_is_that_of_rliable(published: pd.DataFrame) -> None:
    dmc = published[published["task"].str.startswith("dmc/") & (published["step"] == 500_000)]
    x, y = (
        dmc[dmc["agent"] == agent].pivot(index="seed", columns="task", values="value").to_numpy()
        for agent in ("BRO", "BRO Fast")
    )
    direct, interval = library.get_interval_estimates(
        {"x": [x, y]}, lambda a, b: np.array([metrics.probability_of_improvement(a, b)]), reps=200
    )
    ours = study.probability_of_improvement(published, 500_000, ["dmc"], reps=200).iloc[0]
    assert (ours["x"], ours["y"], ours["tasks"]) == ("BRO", "BRO Fast", 15)
    assert ours["probability"] == pytest.approx(direct["x"][0], rel=1e-9)
    np.testing.assert_allclose([ours["low"], ours["high"]], interval["x"][:, 0], atol=0.03)


# ---------------------------------------------------------------- by hand


def test_scores_of_the_suites() -> None:
    assert score_of("dmc/dog-run-v0") == ("return", 1_000, 0) and score_of("sb3_sample:metaworld/push-v3") == (
        "success_rate",
        1,
        0,
    )
    assert score_of("FetchReach-v4") == score_of("myosuite/pose-v0") == ("success_rate", 1, 0)
    found = {name: score_of(f"{name}-v5") for name in ("HalfCheetah", "Walker2d", "Ant", "Humanoid")}
    assert {name: score.high for name, score in found.items() if score} == {
        "HalfCheetah": 8_500, "Walker2d": 4_500, "Ant": 6_625, "Humanoid": 6_125,
    }  # fmt: skip
    assert score_of("HumanoidStandup-v5") is None and score_of("Hopper-v5") is None and score_of("Ant") is None


def test_an_average_by_hand() -> None:
    """Eight runs of two tasks: 100 to 800; the middle four are 300 to 600. One return is above 1,000: not clipped."""
    table = made_up([*runs_of("a", CHEETAH, [100, 300, 500, 700]), *runs_of("a", WALKER, [200, 400, 600, 1_800])])
    row = study.aggregate(table, [10], reps=50).iloc[0]
    assert row["iqm"] == pytest.approx(0.45) and row["mean"] == pytest.approx((0.4 + 0.75) / 2)
    assert row["median"] == pytest.approx(0.575)
    assert row["optimality_gap"] == pytest.approx(1 - (1.6 + 1.2 + 1) / 8)
    assert row["low"] < row["iqm"] < row["high"] and (row["tasks"], row["runs"]) == (2, 8)
    again = study.aggregate(table, [10], reps=50).iloc[0]
    assert (again["low"], again["high"]) == (row["low"], row["high"])


def test_numpys_generator_is_left_as_it_was() -> None:
    np.random.seed(3)
    expected = np.random.random()
    np.random.seed(3)
    study.aggregate(made_up(runs_of("a", CHEETAH, [1, 2, 3])), [10], reps=5)
    assert np.random.random() == expected


def test_tasks_with_different_numbers_of_runs_weigh_the_same() -> None:
    one, two = np.array([[[0.0]], [[1.0]]]), np.array([[[0.0]], [[0.0]], [[1.0]], [[1.0]]])
    assert iqm(one, two)[0] == pytest.approx(0.5)
    table = made_up([*runs_of("a", CHEETAH, [1_000]), *runs_of("a", WALKER, [0, 0, 0])])
    row = study.aggregate(table, [10], reps=20).iloc[0]
    # The one run weighs as the three together: of the scores, the lower half is 0 and the upper 1.
    assert row["mean"] == row["median"] == pytest.approx(0.5) and row["iqm"] == pytest.approx(0.5)


def test_weights_are_those_of_repeated_runs() -> None:
    rng = np.random.default_rng(0)
    two, three = rng.random((2, 3, 2)), rng.random((3, 4, 2))
    repeated = np.concatenate([np.repeat(two, 3, axis=0), np.repeat(three, 2, axis=0)], axis=1)
    direct = [metrics.aggregate_iqm(repeated[:, :, i]) for i in range(2)]
    np.testing.assert_allclose(iqm(two, three), direct)
    for n in (1, 2, 3, 5, 10):
        blocks = [rng.random((n, 3, 2)), rng.random((n, 4, 2))]
        np.testing.assert_allclose(iqm(*blocks), iqm(np.concatenate(blocks, axis=1)))


def test_one_run_a_task_has_no_interval() -> None:
    row = study.aggregate(made_up([*runs_of("a", CHEETAH, [500]), *runs_of("a", WALKER, [700])]), [10]).iloc[0]
    assert row["iqm"] == pytest.approx(0.6) and np.isnan(row["low"]) and np.isnan(row["high"])


def test_steps_between_evaluations_and_a_curve() -> None:
    rows = []
    for seed, end in ((0, 400), (1, 500)):
        rows += [("a", {}, CHEETAH, seed, step, "return", float(step + seed)) for step in range(100, end, 100)]
    table = made_up(rows)
    curve = study.aggregate(table, reps=5)
    assert list(curve["step"].unique()) == [100, 200, 300]
    np.testing.assert_allclose(curve[curve["group"] == "all"]["mean"], [0.1005, 0.2005, 0.3005])
    assert study.aggregate(table, [150], reps=5).iloc[0]["mean"] == pytest.approx(0.1505)
    with pytest.warns(UserWarning, match="1 of 2 runs have no evaluations around step 400"):
        late = study.aggregate(table, [300, 400], ["all"], reps=5)
    assert list(late["runs"]) == [2, 1] and late["mean"].iloc[1] == pytest.approx(0.401)
    with pytest.raises(ValueError, match="steps must be within those of the runs, 100 to 400, not 500"):
        study.aggregate(table, [500])


def test_agents_with_other_tasks_are_said_and_compared_on_those_they_share() -> None:
    table = made_up([*runs_of("a", CHEETAH, [0, 0]), *runs_of("a", WALKER, [800, 800]), *runs_of("b", CHEETAH, [1, 1])])
    with pytest.warns(UserWarning, match="not the same tasks of the 2 of 'all' \\(a 2, b 1\\).*--common"):
        study.aggregate(table, [10], ["all"], reps=5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        common = study.aggregate(table, [10], ["all"], common=True, reps=5)
    np.testing.assert_allclose(common["mean"], [0, 0.001])
    with pytest.raises(ValueError, match="no task that all agents have"):
        study.aggregate(made_up([*runs_of("a", CHEETAH, [0]), *runs_of("b", WALKER, [0])]), [10], common=True)


def test_agents_with_several_settings_are_kept_apart() -> None:
    rows = [*runs_of("a", CHEETAH, [0, 0], replay_ratio=2), *runs_of("a", CHEETAH, [500, 500], replay_ratio=10)]
    # Settings that differ from task to task, as the zoo's files have them, are one agent.
    rows += [*runs_of("b", CHEETAH, [0, 0], lr=1), *runs_of("b", WALKER, [0, 0], lr=2)]
    with pytest.warns(UserWarning, match="not the same tasks"):
        found = study.aggregate(made_up(rows), [10], ["all"], reps=5)
    assert list(found["agent"]) == ["a (replay_ratio=2)", "a (replay_ratio=10)", "b"]


def test_equal_numbers_are_one_setting_and_true_is_not_one() -> None:
    rows = made_up(
        [*runs_of("A", CHEETAH, [0.1, 0.3, 0.2], replay_ratio=2), *runs_of("A", CHEETAH, [0.5], replay_ratio=1)]
    )
    rows.loc[rows["seed"] == 2, "arguments"] = '{"replay_ratio": 2.0}'
    found = study.aggregate(rows, reps=5)
    assert dict(zip(found["agent"], found["runs"], strict=True)) == {"A (replay_ratio=2)": 3, "A (replay_ratio=1)": 1}
    assert argument(rows, "replay_ratio") == ["2", "2", "2", "1"]
    for one, other, names in ((True, 1, {"A (x=true)", "A (x=1)"}), ("2", 2, {'A (x="2")', "A (x=2)"})):
        rows = made_up([*runs_of("A", CHEETAH, [0.1], x=one), *runs_of("A", CHEETAH, [0.9], x=other)])
        assert set(study.aggregate(rows, reps=5)["agent"]) == names
        assert len(set(argument(rows, "x"))) == 2


def test_groups_of_ones_own() -> None:
    table = made_up([*runs_of("a", CHEETAH, [0, 0]), *runs_of("a", WALKER, [800, 800])])
    found = study.aggregate(table, [10], {"mine": [WALKER]}, reps=5)
    assert list(found["group"]) == ["mine"] and found["iqm"].iloc[0] == pytest.approx(0.8)
    with pytest.raises(ValueError, match=f"groups must be of tasks in the table, not {PUSH}"):
        study.aggregate(table, [10], {"mine": [PUSH]})
    with pytest.raises(ValueError, match="groups must be of all, dmc, .*not 'gym'"):
        study.aggregate(table, [10], ["gym"])


def test_tasks_without_a_score_need_the_users() -> None:
    table = made_up(runs_of("a", "Pendulum-v1", [-1_200, -150]))
    with pytest.raises(ValueError, match=r"how Pendulum-v1 is scored.*scores=.*--score Pendulum-v1="):
        study.aggregate(table, [10])
    found = study.aggregate(table, [10], scores={"Pendulum-v1": study.Score("return", -150, -1_200)}, reps=5)
    assert found["mean"].iloc[0] == pytest.approx(0.5)
    np.testing.assert_allclose(scored(table, {"Pendulum-v1": 300})["score"], [-4, -0.5])
    # A low of 0 is above a negative high: the worse run would score more.
    for bad in (0.0, -150, float("nan"), float("inf"), study.Score("return", 1, -float("inf"))):
        with pytest.raises(ValueError, match=r"finite high above the low, .*--score Pendulum-v1=LOW:HIGH"):
            study.aggregate(table, [10], scores={"Pendulum-v1": bad})
    by_prefix = study.aggregate(
        table, [10], scores={"sb3_sample:Pendulum-v1": study.Score("return", -150, -1_200)}, reps=5
    )
    assert by_prefix.equals(found)
    with pytest.warns(UserWarning, match="scores has Pendulum-v0, of which the table has no run: .*Pendulum-v1"):
        warn_of_unknown(table, {"sb3_sample:Pendulum-v1": 1.0, "Pendulum-v0": 3.0})


def test_returns_do_not_stand_for_success() -> None:
    table = made_up([*runs_of("a", PUSH, [1, 2], metric="success_rate"), *runs_of("b", PUSH, [900, 1_000])])
    with pytest.raises(ValueError, match=f"{PUSH} is scored by success_rate, which the runs of b there have not"):
        study.aggregate(table, [10])
    as_return = study.aggregate(table[table["agent"] == "b"], [10], scores={PUSH: 2_000}, reps=5)
    assert as_return["mean"].iloc[0] == pytest.approx(0.475)


def test_a_task_that_is_not_evaluated_yet_is_in_no_average() -> None:
    """Its early runs have other metrics only: hours, and returns of the training episodes."""
    early = [*runs_of("a", WALKER, [1, 2], metric="online_return"), *runs_of("a", WALKER, [3, 4], metric="hours")]
    table = made_up([*runs_of("a", CHEETAH, [100, 300]), *early])
    found = study.aggregate(table, [10], {"mine": [CHEETAH, WALKER]}, reps=5)
    assert found[["group", "mean", "tasks", "runs"]].to_numpy().tolist() == [["mine", 0.2, 1, 2]]
    # One of the task's runs is evaluated, the other has not reached its first evaluation.
    some = pd.concat([table, made_up(runs_of("a", WALKER, [600]))])
    found = study.aggregate(some, [10], {"mine": [CHEETAH, WALKER]}, reps=5)
    assert found["mean"].tolist() == pytest.approx([0.4]) and found["runs"].tolist() == [3]
    profiles = study.performance_profiles(table, 10, [0.15], groups={"mine": [CHEETAH, WALKER]}, reps=5)
    assert profiles["share"].tolist() == [0.5]
    with pytest.raises(ValueError, match="groups must be of tasks in the table, not metaworld/push-v3"):
        study.aggregate(table, [10], {"mine": [CHEETAH, PUSH]}, reps=5)
    with pytest.raises(ValueError, match="groups must have a task of the runs, and there is none in mine"):
        study.aggregate(table, [10], {"mine": [WALKER]}, reps=5)


def test_a_score_of_another_metric() -> None:
    table = made_up([*runs_of("a", CHEETAH, [1, 3], metric="online_return"), *runs_of("a", WALKER, [400])])
    found = study.aggregate(table, [10], ["dmc"], scores={CHEETAH: study.Score("online_return", 10)}, reps=5)
    assert found["mean"].tolist() == pytest.approx([0.3]) and found["tasks"].tolist() == [2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reps": 0}, "reps must be"),
        ({"confidence": 1.0}, "confidence must be"),
        ({"steps": []}, "steps must be whole numbers"),
        ({"steps": [10, 10]}, "steps must be whole numbers"),
        ({"steps": [-1]}, "steps must be whole numbers"),
    ],
)
def test_bad_arguments(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        study.aggregate(made_up(runs_of("a", CHEETAH, [0, 0])), **arguments)


def test_bad_tables() -> None:
    with pytest.raises(ValueError, match="two of a, dmc/cheetah-run-v0, seed 0 at 10"):
        study.aggregate(made_up(runs_of("a", CHEETAH, [0]) * 2))
    # Equal arguments are one agent, however they are written.
    equal = [*runs_of("a", CHEETAH, [0], replay_ratio=2), *runs_of("a", CHEETAH, [1], replay_ratio=2.0)]
    with pytest.raises(ValueError, match="two of a, dmc/cheetah-run-v0, seed 0 at 10"):
        study.aggregate(made_up(equal))
    with pytest.raises(ValueError, match="table must have numbers"):
        study.aggregate(made_up(runs_of("a", CHEETAH, [float("nan")])))
    with pytest.raises(ValueError, match="table must have returns or success rates"):
        study.aggregate(study.published_curves(["TD7"]))


def test_a_missing_rliable_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rliable.library", None)
    monkeypatch.setitem(__import__("sys").modules, "rliable", None)
    with pytest.raises(ImportError, match=r"intervals need rliable .*\[study\]"):
        study.aggregate(made_up(runs_of("a", CHEETAH, [0, 1])), [10])


def test_improvement_by_hand() -> None:
    """Of the six pairs x is better in two and equal in one."""
    rows = [*runs_of("x", CHEETAH, [5, 3]), *runs_of("y", CHEETAH, [4, 3, 6]), *runs_of("y", WALKER, [9, 9, 9])]
    found = study.probability_of_improvement(made_up(rows), 10, ["all"], reps=20).iloc[0]
    assert found["probability"] == pytest.approx((2 + 0.5) / 6) and found["tasks"] == 1
    other = study.probability_of_improvement(made_up(rows), 10, ["all"], pairs=[("y", "x")], reps=20).iloc[0]
    assert other["probability"] == pytest.approx(1 - 2.5 / 6)
    with pytest.raises(ValueError, match="pairs must be of x, y, not 'z'"):
        study.probability_of_improvement(made_up(rows), 10, pairs=[("x", "z")])


def test_a_single_run_of_any_task_leaves_no_interval() -> None:
    """Nine tasks with one run each would else be as if they had no noise, and the interval nearly a point."""
    tasks = [f"dmc/{i}" for i in range(9)]
    rows = [row for agent, score in (("x", 501), ("y", 500)) for task in tasks for row in runs_of(agent, task, [score])]
    rows += [*runs_of("x", CHEETAH, [500, 510]), *runs_of("y", CHEETAH, [505, 495])]
    assert study.aggregate(made_up(rows), [10], ["all"], reps=20)[["low", "high", "mean_low"]].isna().all(axis=None)
    assert study.performance_profiles(made_up(rows), 10, [0.5], ["all"], reps=20)["low"].isna().all()
    found = study.probability_of_improvement(made_up(rows), 10, ["all"], reps=20).iloc[0]
    assert found["probability"] > 0.9 and np.isnan(found["low"]) and np.isnan(found["high"])
    # A single run of one side suffices.
    rows = [*runs_of("x", CHEETAH, [5, 6]), *runs_of("y", CHEETAH, [1])]
    assert np.isnan(study.probability_of_improvement(made_up(rows), 10, ["all"], reps=20).iloc[0]["low"])


def p_of(x: np.ndarray, y: np.ndarray, **arguments: Any) -> float:
    """x and y (runs, tasks)."""
    rows = [
        row
        for agent, values in (("x", x), ("y", y))
        for task, scores in enumerate(values.T)
        for row in runs_of(agent, f"dmc/{task}", list(scores))
    ]
    found = study.probability_of_improvement(made_up(rows), 10, ["all"], **{"reps": 20, **arguments})
    return float(found["p"].iloc[0])


def test_p_of_improvement_is_that_of_mann_and_whitney_on_one_task() -> None:
    mannwhitneyu = pytest.importorskip("scipy.stats").mannwhitneyu
    rng = np.random.default_rng(0)
    x, y = rng.normal(0.8, 1, 5), rng.normal(0, 1, 4)
    assert p_of(x[:, None], y[:, None]) == pytest.approx(mannwhitneyu(x, y, method="exact").pvalue)


def test_p_of_improvement_by_hand() -> None:
    # Two runs each of two tasks: 36 labelings, of which one and its opposite are as extreme.
    best, worst = np.array([[3.0, 3], [4, 4]]), np.array([[1.0, 1], [2, 2]])
    assert p_of(best, worst) == p_of(worst, best) == pytest.approx(2 / 36)
    assert p_of(best, best) == 1
    # 252 to the power of three: drawn, and the labels as they are are one of them.
    many = np.arange(5.0)[:, None].repeat(3, axis=1)
    assert p_of(many + 10, many, reps=500) == 1 / 501
    middling = many + np.array([0.5, 1.5, -1.0])
    assert p_of(middling, many, reps=4_000) == pytest.approx(p_of(middling, many, reps=4_000, seed=1), abs=0.03)
    # Tasks with different numbers of runs: 3 * 6 labelings.
    rows = [*runs_of("x", CHEETAH, [5]), *runs_of("y", CHEETAH, [1, 2])]
    rows += [*runs_of("x", WALKER, [5, 6]), *runs_of("y", WALKER, [1, 2])]
    found = study.probability_of_improvement(made_up(rows), 10, ["all"], reps=5)
    assert found["p"].iloc[0] == pytest.approx(2 / 18)


@pytest.mark.slow
def test_two_seeds_of_equal_agents_are_seldom_told_apart() -> None:
    """The interval alone tells them apart in more than a tenth of the cases, with p in a twentieth at most."""
    rng = np.random.default_rng(0)
    interval = both = 0
    for _ in range(150):
        rows = [
            row
            for agent in "xy"
            for task in range(4)
            for row in runs_of(agent, f"dmc/{task}", list(rng.normal(500, 100, 2)))
        ]
        found = study.probability_of_improvement(made_up(rows), 10, ["all"], reps=100).iloc[0]
        apart = found["low"] > 0.5 or found["high"] < 0.5
        interval, both = interval + apart, both + (apart and found["p"] < 0.05)
    assert interval > 15 and both <= 11


def test_common_tasks_are_of_groups_and_of_each_step() -> None:
    """b has all tasks, but of WALKER the first step only."""
    rows = []
    for agent, task, steps in (("a", CHEETAH, (10, 20)), ("a", WALKER, (10, 20)), ("b", CHEETAH, (10, 20))):
        rows += [row for step in steps for row in runs_of(agent, task, [100, 100], step)]
    rows += runs_of("b", WALKER, [900, 900], 10)
    with pytest.warns(UserWarning, match="1 of 2 tasks are common to all agents at step 20"):
        found = study.aggregate(made_up(rows), [10, 20], ["all"], common=True, reps=5)
    assert list(found["tasks"]) == [2, 1, 2, 1]
    # A group with a task that b has not at all.
    rows += runs_of("a", PUSH, [1, 1], metric="success_rate")
    groups = {"mine": [CHEETAH, PUSH], "push": [PUSH]}
    found = study.aggregate(made_up(rows), [10], groups, common=True, reps=5)
    assert list(found["group"]) == ["mine", "mine"] and list(found["tasks"]) == [1, 1]
    profiles = study.performance_profiles(made_up(rows), 10, [0.5], groups, common=True, reps=5)
    assert set(profiles["group"]) == {"mine"}
    with pytest.raises(ValueError, match="the groups have no task that all agents have"):
        study.aggregate(made_up(rows), [10], {"push": [PUSH]}, common=True)
