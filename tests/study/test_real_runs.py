"""The table of runs that the train command has made, with a folder of their own and in the zoo's layout."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from sb3_sample import cli, study
from sb3_sample.diagnostics import DiagnosticsCallback
from sb3_sample.study.plan import Run

COMMAND = [
    "train", "--algo", "sac_sample", "--env", "dmc/cartpole-swingup-v0", "--device", "cpu", "--eval-freq", "200",
    "--eval-episodes", "1", "--log-interval", "1", "--verbose", "0", "--num-threads", "1", "-n", "400", "--seed", "3",
    "--env-kwargs", "action_repeat:10",
]  # fmt: skip
PARAMS = ["-params", "learning_starts:50", "buffer_size:500", "replay_ratio:0.1", "policy_kwargs:dict(net_arch=[8])"]


def test_runs_of_the_train_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("dm_control")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    cli.main([*COMMAND, "--run-dir", "own", *PARAMS])
    cli.main([*COMMAND, *PARAMS])
    own, zoo = study.read(["own=own"]), study.read(["zoo=logs"])
    # The log of the one that goes on has the time; of the other Monitor's files have it.
    for agent, table in (("own", own), ("zoo", zoo)):
        assert set(table["task"]) == {"dmc/cartpole-swingup-v0"} and set(table["seed"]) == {3}
        returns = table[table["metric"] == "return"]
        data = np.load(next(Path(agent if agent == "own" else "logs").rglob("evaluations.npz")))
        assert list(returns["step"]) == [2_000, 4_000]  # ten simulator steps a step
        np.testing.assert_allclose(returns["value"], data["results"].mean(axis=1))
        arguments = json.loads(table["arguments"].iloc[0])
        assert arguments["replay_ratio"] == 0.1 and arguments["env_kwargs"] == {"action_repeat": 10}
        hours = table[table["metric"] == "hours"]
        assert list(hours["step"]) == [2_000, 4_000] and hours["value"].between(0, 1).all()
    # The same but for what the zoo's file keeps as Python's text.
    assert json.loads(own["arguments"].iloc[0]).keys() == json.loads(zoo["arguments"].iloc[0]).keys()
    both = study.aggregate(study.read(["own=own", "zoo=logs"]), [4_000], ["dmc"])
    assert list(both["agent"]) == ["own", "zoo"] and both["iqm"].between(0, 1).all()
    np.testing.assert_allclose(*both["iqm"])
    assert set(study.read("own", ["train/critic_loss"])["metric"]) == {"train/critic_loss"}


def test_a_run_that_measures_its_gradients(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    arguments = {"learning_starts": 50, "buffer_size": 500, "replay_ratio": 0.1, "policy_kwargs": {"net_arch": [8]}}
    run = Run("SAC", "sac_sample", arguments, {}, "Pendulum-v1", 0, 400, 200, 1, 1_000, measure=150)
    cli.main(["train", *run.command(tmp_path), "--device", "cpu", "--num-threads", "1"])
    metrics = ["return", "online_return", "diagnostics/*"]
    found = {name: rows.set_index("step")["value"] for name, rows in study.read(tmp_path, metrics).groupby("metric")}
    assert list(found["return"].index) == [200, 400]
    # Two episodes of 200 steps.
    assert list(found["online_return"].index) == [200, 400]
    assert not np.allclose(found["return"], found["online_return"])
    for name in ("gradient_square_64", "gradient_square_1024", "overfitting_newest", "parameter_norm_critic"):
        assert list(found[f"diagnostics/{name}"].index) == [150, 300]


def test_a_run_whose_plan_asks_for_diagnostics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its environment is made as that of the evaluations: with the arguments of the training's, and its statistics."""
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    arguments = {
        "learning_starts": 50, "buffer_size": 500, "replay_ratio": 0.1, "policy_kwargs": {"net_arch": [8]},
        "normalize": True,
    }  # fmt: skip
    run = Run(
        "SAC", "sac_sample", arguments, {}, "Pendulum-v1", 0, 400, 200, 1, 200, {"max_episode_steps": 20},
        measure=200, diagnostics=150,
    )  # fmt: skip
    made = []
    init = DiagnosticsCallback._init_callback

    def watched(callback: DiagnosticsCallback) -> None:
        init(callback)
        made.append(callback)

    monkeypatch.setattr(DiagnosticsCallback, "_init_callback", watched)
    cli.main(["train", *run.command(tmp_path), "--device", "cpu", "--num-threads", "1"])
    (callback,) = made
    assert callback._time_limit == 20
    normalize = callback.model.get_vec_normalize_env()
    assert normalize is not None and callback._env is not normalize.venv
    table = study.read(tmp_path, [*study.analysis.VARIABLES, "diagnostics/gradient_square_64"])
    steps = {name: list(rows["step"]) for name, rows in table.groupby("metric")}
    assert steps.pop("diagnostics/gradient_square_64") == [200, 400]
    assert steps.pop("diagnostics/parameter_norm_critic") == [150, 200, 300, 400]  # which both measure
    assert steps == {name: [150, 300] for name in study.analysis.VARIABLES if "parameter_norm" not in name}
