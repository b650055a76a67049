"""Plans: what they say, and what is refused before anything runs."""

import contextlib
import dataclasses
import shutil
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

pytest.importorskip("rl_zoo3")

from sb3_sample import cli, study
from sb3_sample.envs import suites
from sb3_sample.study import Plan, PlanError, Run, plan_file, read_plan, trial_agents
from sb3_sample.study.runs import StudyError, StudyFolder
from tests.study.made_up import write_run

ROOT = Path(__file__).parents[2]
GOOD = """\
agents:
  SAC:
    algo: sac_sample
    learning_starts: 500
  BRO Fast:
    algo: bro_fast
    model_size: 0.55M
grid:
  replay_ratio: [1, 2]
tasks: [Pendulum-v1, dmc/cheetah-run-v0]
seeds: [0, 7]
steps: 1e5
evaluation: {every: 25_000, episodes: 3}
"""


@pytest.fixture
def plan_of(tmp_path: Path) -> Callable[[str], Plan]:
    def read(text: str) -> Plan:
        path = tmp_path / "some.yml"
        path.write_text(textwrap.dedent(text))
        return read_plan(path)

    return read


def test_a_plan_is_its_runs_the_first_seed_of_everything_first(plan_of) -> None:
    plan = plan_of(GOOD)
    assert plan.name == "some" and plan.text == GOOD
    assert len(plan.runs) == len({run.name for run in plan.runs}) == 2 * 2 * 2 * 2
    assert [run.seed for run in plan.runs] == [0] * 8 + [7] * 8
    first, fourth = plan.runs[0], plan.runs[3]
    assert first == Run(
        "SAC", "sac_sample", {"learning_starts": 500, "replay_ratio": 1}, {"replay_ratio": 1}, "Pendulum-v1", 0,
        100_000, 25_000, 3,
    )  # fmt: skip
    assert fourth.arguments == {"model_size": "0.55M", "replay_ratio": 2}
    assert fourth.name == "BRO-Fast,replay_ratio=2/Pendulum-v1/0"
    assert plan.runs[7].name == "BRO-Fast,replay_ratio=2/dmc-cheetah-run-v0/0"
    assert {run.kind for run in plan.runs[:8]} == {run.kind for run in plan.runs[8:]}
    assert len({run.kind for run in plan.runs}) == 8
    assert Run.of_json(first.as_json()) == first


def test_a_run_is_a_command_of_train(plan_of) -> None:
    text = GOOD + "checkpoint_freq: 50_000\nenv_kwargs: {max_episode_steps: 100}\n"
    assert plan_of(text).runs[2].command(Path("x")) == [
        "--algo", "bro_fast", "--env", "Pendulum-v1", "--seed", "0", "-n", "100000", "--eval-freq", "25000",
        "--eval-episodes", "3", "--checkpoint-freq", "50000", "--run-dir", "x", "--verbose", "0",
        "--env-kwargs", "max_episode_steps:100", "-params", "model_size:'0.55M'", "replay_ratio:1",
    ]  # fmt: skip


MEASURE = "{'sb3_sample.diagnostics.NoiseScaleCallback': {'every': 1000}}"
DIAGNOSTICS = "{'sb3_sample.diagnostics.DiagnosticsCallback': {'every': 1000}}"


@pytest.mark.parametrize(("entry", "callback"), [("measure", MEASURE), ("diagnostics", DIAGNOSTICS)])
def test_a_plan_whose_runs_measure_their_networks(plan_of, entry: str, callback: str) -> None:
    run = plan_of(f"{GOOD}{entry}: 1_000\n").runs[0]
    assert run.command(Path("x"))[-3:] == ["learning_starts:500", "replay_ratio:1", f"callback:{callback}"]
    assert Run.of_json(run.as_json()) == run and run.kind == plan_of(GOOD).runs[0].kind
    assert entry not in plan_of(GOOD).runs[0].as_json()
    with pytest.raises(PlanError, match=f"line 14: {entry} every 100,001 steps is none in the 100,000 of an ag"):
        plan_of(f"{GOOD}{entry}: 100_001\n")
    with pytest.raises(PlanError, match=f"line 14: {entry} must be a whole number of at least 1, not 0"):
        plan_of(f"{GOOD}{entry}: 0\n")
    ppo = GOOD.replace("  BRO Fast:\n    algo: bro_fast\n    model_size: 0.55M\n", "").replace("sac_sample", "mbma_ppo")
    ppo = ppo.replace("    learning_starts: 500\n", "").replace("grid:\n  replay_ratio: [1, 2]\n", "")
    with pytest.raises(PlanError, match=f"{entry} is of off-policy agents, and 'SAC' is mbma_ppo: leave it out"):
        plan_of(f"{ppo}{entry}: 10\n")


def test_a_plan_whose_runs_measure_both(plan_of) -> None:
    run = plan_of(GOOD + "diagnostics: 1_000\nmeasure: 1_000\n").runs[0]
    assert run.command(Path("x"))[-1] == f"callback:[{MEASURE}, {DIAGNOSTICS}]"


def test_a_suite_is_its_tasks_each_once(plan_of) -> None:
    text = GOOD.replace("[Pendulum-v1, dmc/cheetah-run-v0]", "[bro-dmc, VPL_DMC, Pendulum-v1]")
    tasks = list(dict.fromkeys(run.task for run in plan_of(text.replace("[0, 7]", "2")).runs))
    assert tasks == [*dict.fromkeys(suites.BRO_DMC + suites.VPL_DMC), "Pendulum-v1"]
    assert set(suites.SUITES["BRO"]) == set(suites.BRO) and "PACKAGE" not in suites.SUITES


def test_anchors_and_merges(plan_of) -> None:
    text = GOOD.replace("  SAC:\n", "  SAC: &sac\n").replace(
        "  BRO Fast:", "  Longer SAC:\n    <<: *sac\n    gamma: 0.97\n  BRO Fast:"
    )
    assert plan_of(text).runs[2].arguments == {"learning_starts": 500, "gamma": 0.97, "replay_ratio": 1}


def test_what_is_merged_can_be_there_often(plan_of) -> None:
    shared = "{<<: {net_arch: [8]}, net_arch: &net [16]}"
    text = GOOD.replace("learning_starts: 500", f"policy_kwargs: &kwargs {shared}")
    text = text.replace("  BRO Fast:", "  VPL-SAC:\n    algo: vpl_sac\n    policy_kwargs: *kwargs\n  BRO Fast:")
    runs = plan_of(text.replace("grid:\n", "grid:\n  replay_buffer_kwargs: [{<<: {}}]\n")).runs
    assert [run.arguments["policy_kwargs"] for run in runs[:4]] == [{"net_arch": [16]}] * 4


def test_frames_are_stacked_by_the_game_and_not_by_a_plan(plan_of) -> None:
    with pytest.raises(PlanError, match="'frame_stack' of agent 'A' is no argument of srspr"):
        plan_of("agents: {A: {algo: srspr, frame_stack: 2}}\ntasks: [Pendulum-v1]\nseeds: 1\nsteps: 30_000\n")


def test_a_value_that_holds_itself_is_refused(plan_of) -> None:
    with pytest.raises(PlanError, match="line 4: this is more than 10,000 values, or holds itself"):
        plan_of(GOOD.replace("learning_starts: 500", "learning_starts: &itself [*itself]"))


# What is changed in the plan above, the line that the message names, and what else it says.
BAD = [
    ("    learning_starts: 500", "    learning_start: 500", 4, "'learning_start' .*'learning_starts'. Allowed .*gamma"),
    ("    learning_starts: 500", "    seed: 500", 4, "'seed' of agent 'SAC' is no argument of sac_sample"),
    ("    learning_starts: 500", "    learning_starts: -1", 4, "learning_starts must be an integer of at least 0,"),
    ("0.55M", "0.56M", 5, "agent 'BRO Fast' with replay_ratio=1 of grid .*: model_size must be one of .*'0.55M'"),
    ("    learning_starts: 500", "    learning_starts: .inf", 4, "a number must be finite"),
    ("sac_sample", "sac_simple", 3, "algo must be one of bc, brc, .*, not 'sac_simple'; did you mean 'sac_sample'"),
    ("    algo: sac_sample\n", "", 2, "agent 'SAC' needs algo, one of bc, brc, "),
    ("BRO Fast:", "SAC:", 5, "'SAC' is there twice: once on line 2"),
    ("BRO Fast:", "sac:", 5, "agents 'SAC' and 'sac' would have the same folder"),
    ("bro_fast\n    model_size: 0.55M", "sac_sample\n    learning_starts: 500", 5, "is agent 'SAC' of line 2"),
    (
        "    learning_starts: 500\n  BRO Fast:\n    algo: bro_fast\n    model_size: 0.55M",
        "    pessimism: 2\n  BRO Fast:\n    algo: sac_sample\n    pessimism: 2.0",
        5,
        "agent 'BRO Fast' is agent 'SAC' of line 2",
    ),
    (
        "    learning_starts: 500\n  BRO Fast:\n    algo: bro_fast\n    model_size: 0.55M",
        "    pessimism: 1\n  BRO Fast:\n    algo: sac_sample",
        5,
        "agent 'BRO Fast' is agent 'SAC' of line 2",
    ),
    ("1e5", "1e5\nenv_kwargs: {action_repat: 2}", 13, "'action_repat' of env_kwargs is no argument of dmc/"),
    ("[1, 2]", "[2, 2.0]", 9, "'replay_ratio' of grid has 2.0 twice"),
    ("BRO Fast", "BRO/Fast", 5, "the name of an agent can have letters"),
    ("    learning_starts: 500", "    replay_ratio: 500", 9, "grid crosses .*agent 'SAC' has fixed at 500 on line 4"),
    ("  replay_ratio: [1, 2]", "  model_size: [0.55M]", 9, "grid crosses 'model_size', which agent 'BRO Fast'"),
    ("  replay_ratio: [1, 2]", "  weight_decay: [0.1]", 9, "'weight_decay' of grid, for agent 'SAC', is no argument"),
    ("[1, 2]", "[1, 2, 1]", 9, "'replay_ratio' of grid has 1 twice"),
    (
        "  replay_ratio: [1, 2]",
        "  reward_scale_kwargs: [{max_return: 1}, {max_return: [1]}]",
        9,
        r"'reward_scale_kwargs' of grid has .* and .*, whose runs would have the same folder",
    ),
    ("[1, 2]", "[1, two]", 9, "replay_ratio must .*, not 'two'"),
    ("[1, 2]", "1", 9, "'replay_ratio' of grid must be a list that is not empty, not 1"),
    ("dmc/cheetah-run-v0", "dmc/cheetah-ran-v0", 10, "close are dmc/cheetah-run-v0.*Suites are BRO"),
    ("dmc/cheetah-run-v0", "BRO_DMK", 10, "'BRO_DMK' is neither .*close are .*BRO_DMC"),
    ("dmc/cheetah-run-v0", "Pendulum-v1", 10, "task 'Pendulum-v1' is there twice"),
    ("[0, 7]", "[0, 0]", 11, "seed 0 is there twice"),
    ("[0, 7]", "[0, -7]", 11, "a seed must be a whole number from 0"),
    ("1e5", "many", 12, "steps must be a whole number of at least 1, not 'many'"),
    ("1e5", "0", 12, "steps must be a whole number of at least 1, not 0"),
    ("25_000", "250_000", 13, "an evaluation every 250,000 steps is none in 100,000"),
    ("episodes", "episode", 13, "'episode' is no entry of evaluation; did you mean 'episodes'"),
    ("seeds:", "seed:", 11, "'seed' is no entry of a plan; did you mean 'seeds'. Allowed are agents, tasks"),
    ("steps: 1e5\n", "", 1, "a plan needs steps"),
    ("[0, 7]", "[0, 7", 12, "this is no YAML"),
    ("[0, 7]", "[" * 5_000, 11, "nests deeper than 50"),
    ("[0, 7]", "\n" + "- " * 5_000, 12, "nests deeper than 50"),
    ("    learning_starts: 500", "    learning_starts: 2020-01-01", 4, "a value must be a number"),
    ("0.55M", "!!python/name:os.system", 7, "a value must be a number"),
    ("steps: 1e5\n", "steps: 1e5\ngroups: {x: [dmc/dog-run-v0]}\n", 13, "group .x. has .dmc/dog-run-v0., .* no task"),
    ("steps: 1e5\n", "steps: 1e5\ngroups: {x: [dmc/dig-run-v0]}\n", 13, "'dmc/dig-run-v0' is neither the id"),
    ("steps: 1e5\n", "steps: 1e5\nfactors: {x: [replay_ration]}\n", 13, "factor .x. must be of agent .*replay_ratio"),
    ("steps: 1e5\n", "steps: 1e5\nfactors: {x: gamma}\n", 13, "factor 'x' must be a list that is not empty"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "line", "words"), BAD)
def test_a_bad_plan_is_refused_by_file_line_and_what_is_allowed(plan_of, tmp_path, old, new, line, words) -> None:
    assert GOOD.count(old) == 1
    with pytest.raises(PlanError, match=words) as caught:
        plan_of(GOOD.replace(old, new))
    assert str(caught.value).startswith(f"{tmp_path / 'some.yml'}, line {line}: ")


@pytest.mark.parametrize(
    "text", ["", "- 1", "agents: 1", "agents: {}", "tasks", "? [1]\n: 2", "agents: {SAC: {algo: [1]}}"]
)
def test_a_plan_of_another_shape_is_refused(plan_of, text: str) -> None:
    with pytest.raises(PlanError):
        plan_of(f"{text}\ntasks: [Pendulum-v1]\nseeds: 1\nsteps: 30_000\n" if text.startswith("agents") else text)
    with pytest.raises(PlanError, match="cannot be read"):
        read_plan("nowhere.yml")


def test_nothing_runs_of_a_bad_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.yml"
    path.write_text(GOOD.replace("learning_starts", "learning_start"))
    with pytest.raises(SystemExit) as caught:
        cli.main(["study", "run", str(path), "--folder", str(tmp_path / "folder")])
    assert caught.value.code == 2
    assert capsys.readouterr().err.startswith(f"sb3-sample study run: {path}, line 4: 'learning_start' of agent 'SAC'")
    assert not (tmp_path / "folder").exists()


def test_a_list_of_somebody_elses_leads_nowhere_else(tmp_path: Path) -> None:
    run = Run("A", "sac_sample", {}, {"x": "../../../y"}, "../../../z", 0, 1)
    assert (tmp_path / "runs").resolve() in StudyFolder(tmp_path).place(run).resolve().parents
    with pytest.raises(ValueError, match="no run"):
        Run.of_json({**run.as_json(), "agent": "../x"})
    with pytest.raises(ValueError, match="steps of a run cannot be '1'"):
        Run.of_json({**run.as_json(), "steps": "1"})


def test_groups_and_factors_come_with_the_folder(plan_of, tmp_path: Path) -> None:
    text = (
        GOOD.replace("Pendulum-v1, ", "BRO_DMC, ")
        + "groups: {dmc: [BRO_DMC], two: [dmc/dog-run-v0, dmc/cheetah-run-v0]}\n"
    )
    plan = plan_of(
        text.replace(", dmc/cheetah-run-v0]\nseeds", "]\nseeds") + "factors: {size: [model_size, replay_ratio]}\n"
    )
    groups = {"dmc": list(suites.BRO_DMC), "two": ["dmc/dog-run-v0", "dmc/cheetah-run-v0"]}
    assert plan.comparison == (groups, {"size": ["model_size", "replay_ratio"]})
    folder = StudyFolder(tmp_path / "study")
    folder.enter(plan)
    assert folder.comparison() == plan.comparison
    # A part of the plan that is run besides says nothing of them.
    folder.enter(Plan("some", plan.runs[:1]), keep=True)
    assert folder.comparison() == plan.comparison
    folder.enter(Plan("some", plan.runs[:1]))
    assert folder.comparison() == ({}, {})


#: Plans with many agents or large critics, each of which is made once to have its arguments checked.
MANY = {
    "bro_ablation", "bro_architecture", "bro_architecture_small", "bro_components", "bro_components_small",
    "bro_offline_adroit", "bro_scaling", "bro_scaling_small", "drq", "mbma", "mbma_figure1", "mbma_small",
    "mbma_table1", "regularization", "regularization_pixels", "regularization_pixels_humanoid",
    "regularization_pixels_humanoid_small", "regularization_pixels_small", "regularization_small", "scaling_dmc",
    "scaling_dmc_small", "scaling_gym", "scaling_gym_small",
}  # fmt: skip
#: Runs of the papers' studies: agents, tasks and seeds as the papers state them, or as the head of the plan says.
RUNS = {
    "bro": 6 * 40 * 10,
    "bro_offline_adroit": 6 * 9 * 10,
    "bro_offline_antmaze": 6 * 6 * 10,
    "bro_scaling": 5 * 5 * 40 * 10,
    "bro_ablation": 2 * 7 * 10 * 10,
    "bro_architecture": (5 * 3 + 2 + 5 * 3) * 10 * 10,
    "bro_components": 7 * 3 * 10 * 10,
    "bro_target": 2 * 2 * 40 * 10,
    "bro_batch_size": 2 * 3 * 40 * 10,
    "bro_td3": 4 * 40 * 10,
    "bro_long": 4 * 7 * 5,
    "bro_atari": 4 * 3 * 5,
    "dac": 2 * 6 * 30 * 10,
    "dac_design": 2 * 5 * 15 * 10,
    "dac_table1": 2 * 8 * 15 * 10,
    "dac_overestimation": 2 * 4 * 15 * 10,
    "vpl_sac": 2 * 5 * 20 * 10,
    "vpl_sac_regret": (1 + 4 + 4) * 4 * 10,
    "vpl_sac_learning_rate": 3 * 4 * 4 * 10,
    "vpl_sac_design": 6 * 4 * 10,
    "regularization": 64 * 2 * 14 * 10,
    "regularization_redo": 4 * 4 * 14 * 10,
    "regularization_dogs": 3 * 2 * 2 * 10,
    "mbma": 4 * 14 * 15,
    "mbma_figure1": 4 * 4 * 45,
    "mbma_table1": 2 * 6 * 10,
    "regularization_pixels": 4 * 3 * 3,
    "regularization_pixels_humanoid": 4 * 3 * 3,
    "mbma_quadruped": 3 * 2 * 8,
    "mbma_humanoid": 3 * 2 * 8,
    "scaling_dmc": 4 * 5 * 4 * 7 * 10,
    "scaling_gym": 4 * 3 * 5 * 4 * 8,
}
#: Their steps, where they are neither a million nor half of one.
OTHER_STEPS = {"bro_atari": {100_000}, "bro_long": {3_000_000, 5_000_000}, "regularization_dogs": {4_000_000}}


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=[pytest.mark.slow] if path.stem in MANY else [], id=path.stem)
        for path in sorted(ROOT.glob("studies/*/*.yml"))
    ],
)
def test_the_plans_that_come_with_it_are_good(path: Path) -> None:
    if "ALE/" in path.read_text():
        pytest.importorskip("ale_py")
    plan = read_plan(path)
    text = " ".join(plan.text.replace("\n#", " ").split())
    if path.parent.name == "papers":
        assert len(plan.runs) == RUNS[path.stem] and f"{len(plan.runs):,} runs of" in text
        assert f"| {len(plan.runs):,}" in (ROOT / "docs/studies.md").read_text()
        if path.stem in OTHER_STEPS:
            assert {run.steps for run in plan.runs} == OTHER_STEPS[path.stem]
        # Others are counted in steps of the simulator, or shorter.
        elif not path.stem.startswith(("mbma", "regularization_pixels")):
            assert {run.steps for run in plan.runs} == {500_000 if "half a million" in text else 1_000_000}
    elif path.stem.endswith("_small"):
        assert f"{len(plan.runs)} runs of" in text and f"papers/{path.stem.removesuffix('_small')}.yml" in text


@pytest.mark.parametrize("shape", [(5, 3), (3, 5), (4, 4)])
def test_kernels_of_trial_agents_are_left_as_they_were_drawn(shape: tuple[int, int]) -> None:
    kernels = []
    for mode in (trial_agents._NotOrthogonal(), contextlib.nullcontext()):
        torch.manual_seed(0)
        with mode:
            kernels.append(torch.nn.init.orthogonal_(torch.empty(shape)))
    trial, usual = (kernel @ kernel.T if shape[0] <= shape[1] else kernel.T @ kernel for kernel in kernels)
    torch.testing.assert_close(usual, torch.eye(min(shape)))
    assert torch.isfinite(trial).all() and (trial - usual).abs().max() > 0.1


def test_each_study_of_the_papers_has_a_small_one() -> None:
    assert {path.stem for path in ROOT.glob("studies/papers/*.yml")} == set(RUNS)
    assert {path.stem for path in ROOT.glob("studies/small/*_small.yml")} == {f"{name}_small" for name in RUNS}


@pytest.mark.parametrize("name", ["vpl_sac_regret", "vpl_sac_regret_small"])
def test_the_regret_study_is_the_papers(name: str) -> None:
    plan = read_plan(next(ROOT.glob(f"studies/*/{name}.yml")))
    agents = {run.agent: (run.algo, run.arguments) for run in plan.runs}
    high = {"replay_ratio": 16, "resets": 160_000}
    assert agents["SR-SAC"] == ("sr_sac", high) and len(agents) == 9
    for proportion in (128, 32, 8, 2):
        held_out = {**high, "validation_proportion": 1 / proportion}
        assert agents[f"idle 1-{proportion}"] == ("sr_sac", held_out)
        assert agents[f"VPL 1-{proportion}"] == ("vpl_sac", held_out)
    assert {run.task for run in plan.runs} <= set(suites.VPL_ADDITIONAL)


DATA = """\
agents:
  BC:
    algo: bc
    dataset: data/{task}/expert
  IQL:
    algo: iql
    dataset: {Pendulum-v1: ~/pendulum}
    prior_data: D4RL/pen/human-v2
    prior_share: 0.25
    offline_steps: 500
    steps: 800
  SAC:
    algo: sac_sample
tasks: [Pendulum-v1, dmc/cheetah-run-v0]
seeds: 1
steps: 1_000
evaluation: {every: 200, episodes: 3}
"""


def test_agents_that_learn_from_data(plan_of) -> None:
    plan = plan_of(DATA)
    assert [(run.agent, run.task, run.steps) for run in plan.runs] == [
        ("BC", "Pendulum-v1", 1_000), ("IQL", "Pendulum-v1", 800), ("SAC", "Pendulum-v1", 1_000),
        ("BC", "dmc/cheetah-run-v0", 1_000), ("SAC", "dmc/cheetah-run-v0", 1_000),
    ]  # fmt: skip
    cloned, tuned, plain, elsewhere, _ = plan.runs
    assert cloned.data == {"dataset": "data/Pendulum-v1/expert"} and not cloned.arguments
    assert elsewhere.data == {"dataset": "data/dmc-cheetah-run-v0/expert"}
    command = tuned.command(Path("x"))
    at = command.index("--dataset")
    assert command[at : at + 6] == [
        "--dataset", str(Path.home() / "pendulum"), "--offline-steps", "500", "--prior-data", "D4RL/pen/human-v2",
    ]  # fmt: skip
    assert command[-2:] == ["-params", "prior_share:0.25"] and command[command.index("-n") + 1] == "800"
    for run in plan.runs:
        assert Run.of_json(run.as_json()) == run
    # What was written before there were data sets is the same run.
    assert "data" not in plain.as_json()
    with pytest.raises(ValueError, match="data of a run cannot be"):
        Run.of_json({**plain.as_json(), "data": {"x": 1}})


@pytest.mark.parametrize(
    ("before", "now", "message"),
    [
        ("    dataset: data/{task}/expert\n", "", "agent 'BC': bc learns from a dataset only, and needs it"),
        ("algo: sac_sample", "algo: mbma_ppo\n    dataset: x", "line 14: dataset is nothing for mbma_ppo"),
        ("algo: sac_sample", "algo: dr_q\n    prior_data: x", "line 14: prior_data is nothing for dr_q"),
        ("offline_steps: 500", "offline_steps: 800", "line 10: offline_steps must be fewer than the 800 steps of all"),
        ("    dataset: {Pendulum-v1: ~/pendulum}\n", "", "line 9: offline_steps are gradient steps on a dataset"),
        ("{Pendulum-v1: ~/pendulum}", "{Ant-v5: x}", "line 7: dataset has 'Ant-v5', which is no task of the plan"),
        ("{Pendulum-v1: ~/pendulum}", "[a]", "line 7: dataset must be a path or an id of Minari's, or such by task"),
        ("prior_share: 0.25", "prior_share: 2", r"line 9: prior_share must lie in \(0, 1\)"),
        ("prior_share: 0.25", "n_steps: 3", "agent 'IQL' cannot be made: prior_data has transitions of one step"),
        ("prior_share: 0.25", "replay_buffer_class: PrioritizedReplayBuffer", "'IQL' .* prior_data have no priorities"),
        ("prior_share: 0.25", "prior_share: 0.001", "'IQL' .* leaves no transition of one of the two"),
        ("steps: 800", "steps: 0", "line 11: steps must be a whole number of at least 1"),
        ("steps: 800", "steps: 150", "an evaluation every 200 steps is none in 150"),
    ],
)
def test_data_of_a_plan_that_are_refused(plan_of, before: str, now: str, message: str) -> None:
    assert before in DATA
    with pytest.raises(PlanError, match=message):
        plan_of(DATA.replace(before, now))


def test_prior_data_change_nothing_about_actions_that_are_refused() -> None:
    usual = gym.spaces.Box(-1, 1, (1,), np.float32)
    for actions in gym.spaces.Box(-np.inf, np.inf, (1,), np.float32), gym.spaces.Discrete(3):
        why = [trial_agents.why_not_acting("bro", {}, actions, usual, has) for has in (False, True)]
        assert why[0] is not None and why[0] == why[1]


def test_a_run_that_was_taken_out_of_the_plan_is_not_forgotten(tmp_path: Path) -> None:
    folder = StudyFolder(tmp_path)
    first, other = (Run("A", "bro", {"gamma": 0.9}, {}, "dmc/cheetah-run-v0", seed, 3_000) for seed in (0, 1))
    folder.enter(Plan("s", (first, other)))
    for run in (first, other):
        write_run(folder.place(run), seed=run.seed, arguments=run.arguments)
    folder.enter(Plan("s", (other,)))
    folder.enter(Plan("s", (other,)))  # for good
    with pytest.warns(UserWarning, match="1 runs .* are not in their study's plan any more and are left out"):
        assert list(study.read(tmp_path)["seed"].unique()) == [1]
    changed = dataclasses.replace(first, arguments={"gamma": 0.5})
    with pytest.raises(StudyError, match="gamma.: 0.9.*the plan now says .*0.5"):
        folder.enter(Plan("s", (changed, other)))
    folder.enter(Plan("s", (first, other)))
    assert list(study.read(tmp_path)["seed"].unique()) == [0, 1]
    # One whose folder is gone may come back with other settings.
    folder.enter(Plan("s", (other,)))
    shutil.rmtree(folder.place(first))
    folder.enter(Plan("s", (changed, other)))
    assert folder.runs() == [changed, other]


@pytest.mark.parametrize(
    ("agent", "task", "words"),
    [
        ("algo: sac_sample", "CartPole-v1", r"env must have a bounded Box action space, not Discrete\(2\)"),
        ("algo: dac, policy: CnnPolicy, augmentation: shift", "CartPole-v1", "bounded Box action space"),
        ("algo: bro, policy: MultiInputPolicy", "CartPole-v1", "bounded Box"),
        ("algo: srspr", "Pendulum-v1", "Discrete"),
        ("algo: srspr", "dmc/cheetah-run-v0", "Discrete"),
        ("algo: rewound_ppo, sample_actions: all", "Pendulum-v1", "every action of a Discrete space"),
        ("algo: rewound_ppo, sample_actions: all", "dmc/cheetah-run-v0", "every action of a Discrete space"),
        (
            "algo: rewound_ppo, policy: CnnPolicy, sample_actions: all",
            "Pendulum-v1",
            "every action of a Discrete space",
        ),
    ],
)
def test_an_agent_that_cannot_act_in_a_task_is_refused(plan_of, agent: str, task: str, words: str) -> None:
    tasks = f"[dmc/cheetah-run-v0, {task}]" if task == "CartPole-v1" else f"[{task}]"
    with pytest.raises(PlanError, match=rf"some.yml, line 2: agent 'A' cannot act in task '{task}': .*{words}"):
        plan_of(f"agents:\n  A: {{{agent}}}\ntasks: {tasks}\nseeds: 1\nsteps: 30_000\n")


def test_the_actions_are_those_of_the_task_with_its_arguments(plan_of) -> None:
    text = "agents: {A: {algo: sac_sample}}\ntasks: [MountainCar-v0]\nseeds: 1\nsteps: 30_000\n"
    with pytest.raises(PlanError, match="cannot act in task 'MountainCar-v0'"):
        plan_of(text)
    plan_of(text.replace("MountainCar-v0", "MountainCarContinuous-v0"))


def test_an_agent_that_can_act_in_a_task_is_not_made_again(plan_of, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def make(*given: Any, **named: Any) -> gym.Space[Any]:
        made.append(given)
        return gym.spaces.Box(-1, 1, (1,))

    monkeypatch.setattr(plan_file, "make", make)
    monkeypatch.setattr(trial_agents, "make", lambda *_: pytest.fail("made"))
    plan_of(
        "agents: {A: {algo: mbma_ppo}, B: {algo: sac_sample}}\ntasks: [Pendulum-v1, dmc/cheetah-run-v0]\nseeds: 2\n"
        "steps: 30_000\n"
    )
    assert len(made) == 2


@pytest.mark.parametrize(
    "agent",
    [
        "algo: mbma_ppo",
        "algo: rewound_ppo, sample_actions: all",
        "algo: rewound_ppo, sample_actions: all, policy: CnnPolicy",
    ],
)
def test_discrete_actions_of_an_agent_that_takes_them(plan_of, agent: str) -> None:
    plan = plan_of(f"agents: {{A: {{{agent}}}}}\ntasks: [CartPole-v1]\nseeds: 1\nsteps: 30_000\n")
    assert len(plan.runs) == 1


def test_a_task_that_cannot_be_made_is_left_to_its_runs(plan_of) -> None:
    text = "agents: {A: {algo: sac_sample}}\ntasks: [CartPole-v1]\nseeds: 1\nsteps: 30_000\n"
    with pytest.warns(UserWarning, match="CartPole-v1 cannot be made here, .* its actions .*colour"):
        assert len(plan_of(f"{text}env_kwargs: {{colour: red}}\n").runs) == 1


def test_arguments_of_an_agent_with_another_policy_are_checked(plan_of) -> None:
    with pytest.raises(PlanError, match="agent 'A' cannot be made: .*model_size"):
        plan_of(
            "agents: {A: {algo: bro, policy: MultiInputPolicy, model_size: 0.56M}}\ntasks: [dmc/cheetah-run-v0]\n"
            "seeds: 1\nsteps: 30_000\n"
        )


GRID = """
agents:
  SAC: {algo: sac_sample}
grid: {GRID}
tasks: [Pendulum-v1]
seeds: [0]
steps: 25_000
"""


@pytest.mark.parametrize("other", ["{gamma: [0.9], replay_ratio: [1]}", "{replay_ratio: [1.0], gamma: [0.9]}"])
def test_a_grid_that_is_written_otherwise_makes_no_run_anew(plan_of, other: str, tmp_path: Path) -> None:
    folder = StudyFolder(tmp_path / "study")
    first = plan_of(GRID.replace("{GRID}", "{replay_ratio: [1], gamma: [0.9]}"))
    folder.enter(first)
    again = plan_of(GRID.replace("{GRID}", other))
    # While there is no run of it.
    folder.enter(again)
    folder.enter(first)
    folder.place(first.runs[0]).mkdir(parents=True)
    folder.enter(first)
    with pytest.raises(
        StudyError, match=r"has SAC, replay_ratio=1, gamma=0.9 .* which the plan now names .*Nothing was"
    ):
        folder.enter(again)
    assert folder.runs() == list(first.runs)


def test_settings_of_runs_that_are_not_there_can_be_changed(tmp_path: Path) -> None:
    def plan(gamma: float) -> Plan:
        return Plan("s", (Run("A", "bro", {"gamma": gamma}, {}, "dmc/cheetah-run-v0", 0, 3_000),))

    folder = StudyFolder(tmp_path)
    folder.enter(plan(0.9))
    folder.enter(plan(0.5))
    folder.place(folder.runs()[0]).mkdir(parents=True)
    with pytest.raises(StudyError, match="arguments {'gamma': 0.5}, and the plan now says {'gamma': 0.9}"):
        folder.enter(plan(0.9))


def test_a_run_has_the_name_of_its_agent_in_tables() -> None:
    for value, text in (("2", 'A (x="2")'), (2.0, "A (x=2)"), ("adam", "A (x=adam)"), (True, "A (x=true)")):
        assert Run("A", "bro", {"x": value}, {"x": value}, "dmc/cheetah-run-v0", 0, 1).label == text
