"""The plans of the best agent: equal arithmetic, as their heads say, and candidates that train."""

import dataclasses
import importlib
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("rl_zoo3")
pytest.importorskip("dm_control")

from sb3_sample import FadedReplayBuffer, cli
from sb3_sample.learner.exploration import OptimisticShift
from sb3_sample.study import Plan, PlanError, Run, read_plan
from sb3_sample.study.trial_agents import constructor_value
from sb3_sample.zoo import ALGORITHMS
from tests.sac.common import sampled

ROOT = Path(__file__).parents[2]
EVIDENCE = ROOT / "studies" / "evidence"


def agents(plan: Plan) -> dict[str, Run]:
    """The first run of each agent of a plan."""
    return {run.agent: run for run in reversed(plan.runs)}


def names(name: str) -> list[str]:
    """Agents of a plan, without reading it whole, which makes each of them."""
    head = (EVIDENCE / f"{name}.yml").read_text().split("\nagents:\n")[1].split("\n\ntasks:")[0]
    return re.findall(r"^  (\w[^:\n]*):", head, re.MULTILINE)


@pytest.fixture(scope="module")
def plan() -> Plan:
    return read_plan(EVIDENCE / "best_agent.yml")


@pytest.fixture(scope="module")
def screening(plan: Plan) -> dict[str, Run]:
    return agents(plan)


@pytest.fixture(scope="module")
def agent_flops() -> Any:
    """The program in ``benchmarks``."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        return importlib.import_module("agent_flops")
    finally:
        sys.path.pop(0)


@pytest.fixture(scope="module")
def gflop(agent_flops: Any) -> Callable[[str, dict[str, Any]], tuple[float, float]]:
    return agent_flops.gflop  # type: ignore[no-any-return]


def test_there_are_eight_candidates_and_bro(plan: Plan, screening: dict[str, Run]) -> None:
    assert list(reversed(screening)) == names("best_agent") and len(screening) == 9
    runs = plan.runs
    assert {(run.task, run.seed) for run in runs} == {
        (f"dmc/{task}-v0", seed) for task in ("cheetah-run", "walker-run") for seed in (0, 1)
    }
    assert {run.steps for run in runs} == {50_000}


@pytest.mark.parametrize("name", ["best_agent", "best_agent_final"])
def test_all_agents_have_action_repeat_1(name: str, agent_flops: Any) -> None:
    """Also those whose file of hyperparameters has another."""
    for run in read_plan(EVIDENCE / f"{name}.yml").runs:
        assert "action_repeat:1" in run.command(Path("run")) and agent_flops.action_repeat(run) == 1


def test_action_repeat_of_a_plan_that_does_not_say_it_is_the_zoos(plan: Plan, agent_flops: Any) -> None:
    repeats = {run.agent: agent_flops.action_repeat(dataclasses.replace(run, env_kwargs={})) for run in plan.runs}
    assert repeats == {name: 1 if name in ("BRO", "BRO categorical") else 2 for name in names("best_agent")}


def test_what_goes_into_the_final_is_as_it_was_screened(screening: dict[str, Run]) -> None:
    final = agents(read_plan(EVIDENCE / "best_agent_final.yml"))
    assert "BRO" in final and len(final) <= 3
    for name, run in final.items():
        assert (run.algo, run.arguments) == (screening[name].algo, screening[name].arguments)


@pytest.mark.slow
@pytest.mark.parametrize("name", names("best_agent"))
def test_arithmetic_is_bros_as_the_head_says(name: str, screening: dict[str, Run], gflop) -> None:
    each, ratio = gflop(screening[name].algo, screening[name].arguments)
    said = re.search(rf"^#   {re.escape(name)} +(\d+\.\d\d) ", (EVIDENCE / "best_agent.yml").read_text(), re.MULTILINE)
    assert said is not None
    # Matrix products are the same on every processor; other versions of torch may take others.
    assert each * ratio == pytest.approx(float(said[1]), rel=0.01)
    assert each * ratio == pytest.approx(1.92, rel=0.03)


@pytest.mark.parametrize("name", sampled(names("best_agent"), ("SimbaV2 optimistic faded",)))
def test_candidates_train(name: str, screening: dict[str, Run]) -> None:
    run = screening[name]
    arguments = {key: constructor_value(key, value) for key, value in run.arguments.items()}
    toy = {"learning_starts": 50, "replay_ratio": 1, "buffer_size": 1_000, "batch_size": 16, "compile": False}
    if run.algo == "dr_q":
        toy["target_update_interval"] = 20
    model = ALGORITHMS[run.algo].algorithm("MlpPolicy", "Pendulum-v1", seed=0, device="cpu", **{**arguments, **toy})
    before = {key: value.clone() for key, value in model.actor.state_dict().items()}
    model.learn(200)
    assert model._n_updates >= 140
    after = model.actor.state_dict()
    assert all(torch.isfinite(value).all() for value in after.values())
    assert any(not torch.equal(before[key], after[key]) for key in before)
    assert isinstance(model.explorer, OptimisticShift) == (name.split()[0] == "BRO" or "optimistic" in name)
    assert isinstance(model.replay_buffer, FadedReplayBuffer) == ("faded" in name)
    assert np.isfinite(model.predict(model.observation_space.sample())[0]).all()


def test_a_buffer_is_named_in_a_plan_as_in_the_zoos_files(tmp_path: Path) -> None:
    text = "agents: {SAC: {algo: sac_sample, replay_buffer_class: %s}}\ntasks: [Pendulum-v1]\nseeds: 1\nsteps: 1e5\n"
    path = tmp_path / "plan.yml"
    path.write_text(text % "FadedReplayBuffer")
    (run,) = read_plan(path).runs
    assert "replay_buffer_class:'FadedReplayBuffer'" in run.command(tmp_path)
    path.write_text(text % "FadeReplayBuffer")
    with pytest.raises(PlanError, match="line 1: replay_buffer_class must be .*, not 'FadeReplayBuffer'"):
        read_plan(path)


def test_training_takes_a_buffer_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cli.main(
        [
            "train", "--algo", "sac_sample", "--env", "Pendulum-v1", "-n", "60", "--run-dir", "run", "--verbose", "0",
            "-params", "learning_starts:20", "replay_buffer_class:'FadedReplayBuffer'", "buffer_size:100",
        ]
    )  # fmt: skip
    (kind,) = {path.read_text() for path in (tmp_path / "run").rglob("config.yml")}
    assert "FadedReplayBuffer" in kind
