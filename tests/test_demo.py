"""``make demo`` on a task of seconds."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from sb3_sample.envs import make_env

pytest.importorskip("matplotlib")

from sb3_sample.plots import draw


@pytest.fixture
def demo(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("demo", Path(__file__).parents[1] / "examples" / "demo.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "ENV", "Pendulum-v1")
    monkeypatch.setattr(module, "ENV_ARGUMENTS", {"max_episode_steps": 5})
    monkeypatch.setattr(module, "STEPS", 80)
    monkeypatch.setattr(module, "EVERY", 20)
    monkeypatch.setattr(module, "SOLVED", -1000)  # so every evaluation passes
    monkeypatch.setattr(module, "AGENT", dict(model_size=(1, 8), replay_ratio=1, learning_starts=70, device="cpu"))
    return module


def test_the_learning_curve_is_over_steps_of_the_simulator(
    demo: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    returns(demo, monkeypatch, -3000, -1001, -1000, -7)
    monkeypatch.setattr(demo, "ENV_ARGUMENTS", {"max_episode_steps": 5, "action_repeat": 4})
    monkeypatch.setattr(demo, "make_env", lambda env, action_repeat, **kwargs: make_env(env, **kwargs))
    drawn = []
    monkeypatch.setattr(demo, "draw", lambda env, curves, metric: drawn.extend(curves) or draw(env, curves, metric))
    demo.main(["--folder", str(tmp_path)])
    assert list(drawn[0].data["env_step"]) == [80, 160]  # after 20 and 40 decisions


def returns(module: ModuleType, monkeypatch: pytest.MonkeyPatch, *means: float) -> list[Any]:
    """Give the fresh episodes these returns; gives who played them."""
    left, asked = list(means), []

    def fresh_returns(policy: Any, seed: int) -> np.ndarray:
        asked.append((getattr(policy, "num_timesteps", None), seed))
        return np.full(10, left.pop(0))

    monkeypatch.setattr(module, "fresh_returns", fresh_returns)
    return asked


def test_training_ends_when_fresh_episodes_confirm_it(
    demo: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    asked = returns(demo, monkeypatch, -3000, -1001, -1000, -7)
    demo.main(["--folder", str(tmp_path), "--seed", "2"])
    out, err = capfd.readouterr()
    # Random actions; the evaluations after 20 steps, not confirmed, and 40; the result, in other episodes.
    assert [steps for steps, _ in asked] == [None, 20, 40, 40]
    assert len({seed for _, seed in asked}) == 4
    assert "Random actions reach -3000" in out
    assert "ten fresh episodes -1001" in out and "ten fresh episodes -1000" in out
    assert "After 40 steps" in out and "reaches -7 ± 0 of" in out and "Not solved" not in out
    assert {"model.zip", "learning_curve.png"} <= {path.name for path in tmp_path.iterdir()}
    # No terminal: lines, one after each evaluation.
    assert "\r" not in out + err and out.count("of 80 steps") == 4


def test_compiling_is_told_of_before_it_begins(
    demo: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(demo.AGENT, "compile", True)
    monkeypatch.setattr(demo.BRO, "train", lambda model, *_: print(f"step {model.num_timesteps}", flush=True))
    monkeypatch.setattr(demo, "SOLVED", 0)
    returns(demo, monkeypatch, -3000, -1500)
    demo.main(["--folder", str(tmp_path)])
    before, _, after = capfd.readouterr().out.partition("Compiling the update")
    assert "60 of 80 steps" in before and "step 71" not in before and "step 71" in after
    assert "Compiling" not in after


def test_what_is_not_solved_is_called_so(
    demo: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(demo, "SOLVED", 0)
    asked = returns(demo, monkeypatch, -3000, -1500)
    demo.main(["--folder", str(tmp_path)])
    out, _ = capfd.readouterr()
    assert len(asked) == 2
    assert "Not solved" in out and "After 80 steps" in out and "reaches -1500 ± 0 of" in out
    assert (tmp_path / "model.zip").exists()


def test_fresh_episodes_are_ten_others(demo: ModuleType) -> None:
    first, again, other = (demo.fresh_returns(demo.RandomActions(s), seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert first.shape == (10,) and len({*first, *other}) == 20
