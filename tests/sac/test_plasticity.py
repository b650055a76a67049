"""Resets: when they happen, what starts anew, what stays."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sb3_sample.sac.plasticity import Resets
from tests.sac.common import MAKERS, bro, sac, vec


class Recorder:
    """Wraps ``reinitialize`` and notes the transitions at which it is called."""

    def __init__(self, model: Any):
        self.at: list[int] = []
        original = model.reinitialize

        def reinitialize() -> None:
            self.at.append(model.num_transitions)
            original()

        model.reinitialize = reinitialize


@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_schedule(maker: str) -> None:
    model = MAKERS[maker](resets=(20, 33))
    recorder = Recorder(model)
    model.learn(50)
    assert recorder.at == [20, 33]
    assert model.plasticity.n_done == 2


def test_no_reset_by_default_in_sac() -> None:
    model = sac()
    recorder = Recorder(model)
    model.learn(50)
    assert recorder.at == [] and model.plasticity.n_done == 0


def test_first_update_at_or_after() -> None:
    """A ratio of 1/4 updates every fourth transition: 14, 18, 22, ... after a warm-up of 10."""
    model = sac(replay_ratio=0.25, resets=(19,))
    recorder = Recorder(model)
    model.learn(40)
    assert recorder.at == [22]


def test_several_due_at_once_are_one() -> None:
    model = sac(vec(8), resets=(17, 18, 19, 24, 40))
    recorder = Recorder(model)
    model.learn(64)
    assert recorder.at == [24, 40]
    assert model.plasticity.n_done == 2


def test_steps_within_the_warm_up() -> None:
    """They are due at the first update, which then starts from fresh networks: one reset at most."""
    model = sac(learning_starts=20, resets=(5, 10))
    recorder = Recorder(model)
    model.learn(40)
    assert recorder.at in ([], [21])


@pytest.mark.parametrize("n_envs", [1, 3, 4])
def test_transitions_are_counted_over_environments_and_learns(n_envs: int) -> None:
    model = sac(vec(n_envs), resets=(30, 60))
    recorder = Recorder(model)
    model.learn(24)
    assert recorder.at == [] and model.num_transitions == 24
    model.learn(24)
    assert recorder.at == [-(-30 // n_envs) * n_envs]
    model.learn(24, reset_num_timesteps=False)
    assert model.num_transitions == 72
    assert recorder.at == [-(-30 // n_envs) * n_envs, -(-60 // n_envs) * n_envs]


@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_everything_starts_anew(maker: str) -> None:
    model = MAKERS[maker](replay_ratio=2, learning_rate=1e-2, tau=0.3, seed=1)
    fresh = MAKERS[maker](seed=2)
    names = ["policy", "temperature", "explorer"]
    initial = {name: {k: v.clone() for k, v in getattr(model, name).state_dict().items()} for name in names}
    model.learn(40)
    stored = model.replay_buffer.observations.copy()
    trained = {name: {k: v.clone() for k, v in getattr(model, name).state_dict().items()} for name in names}
    for name in names:
        for key, value in trained[name].items():
            assert not torch.equal(value, initial[name][key]), f"{name}.{key} was not trained"
    parameters = {id(p) for p in model.policy.parameters()}
    model.reinitialize()

    assert {id(p) for p in model.policy.parameters()} == parameters, "optimizers would hold other tensors"
    for name in names:
        for key, value in getattr(model, name).state_dict().items():
            assert not torch.equal(value, trained[name][key]), f"{name}.{key} was kept"
            # What a constructor fills with a constant is that constant again.
            constant = fresh_value = getattr(fresh, name).state_dict()[key]
            if bool((fresh_value == fresh_value.flatten()[0]).all()):
                assert torch.equal(value, constant), f"{name}.{key}"
            else:
                assert value.std() == pytest.approx(fresh_value.std().item(), rel=0.3)
                assert not torch.equal(value, initial[name][key]), f"{name}.{key} came from the same draw"
    for ours, theirs in zip(model.critic.parameters(), model.critic_target.parameters(), strict=True):
        assert torch.equal(ours, theirs)
        assert not theirs.requires_grad
    for name, optimizer in model._optimizers().items():
        assert not optimizer.state, name
    assert model.temperature().item() == pytest.approx(1.0)
    if maker == "BRO":
        assert model.explorer.optimism().item() == pytest.approx(1.0, rel=1e-5)
        assert model.explorer.kl_weight().item() == pytest.approx(0.25, rel=1e-5)
    np.testing.assert_array_equal(model.replay_buffer.observations, stored)
    assert model.replay_buffer.size() == 40


def test_optimizers_work_after_a_reset() -> None:
    model = bro(resets=(20,), learning_rate=1e-2)
    model.learn(20)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    for optimizer in model._optimizers().values():
        for group in optimizer.param_groups:
            assert group["params"]
    model.learn(10)
    after = model.policy.state_dict()
    assert all(not torch.equal(before[name], after[name]) for name in before)


def test_temperature_starts_from_its_own_start() -> None:
    model = sac(ent_coef="auto_0.3", learning_rate=1e-2)
    model.learn(30)
    assert model.temperature().item() != pytest.approx(0.3, rel=1e-3)
    model.reinitialize()
    assert model.temperature().item() == pytest.approx(0.3)
    fixed = sac(ent_coef=0.2)
    fixed.reinitialize()
    assert fixed.temperature().item() == pytest.approx(0.2)


def test_resets_depend_on_the_seed_alone() -> None:
    first, second = (bro(seed=3, resets=(20,)).learn(40) for _ in range(2))
    for (name, a), b in zip(first.policy.state_dict().items(), second.policy.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


def test_the_log_tells(capsys: pytest.CaptureFixture[str]) -> None:
    model = sac(resets=(20,), verbose=1)
    model.learn(30, log_interval=1)
    assert "reset " in capsys.readouterr().out
    assert model.logger.name_to_value is not None
    model.dump_logs()


def test_logged_value(tmp_path: Path) -> None:
    from stable_baselines3.common.logger import configure

    model = sac(resets=(20,))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(35, log_interval=1)
    header, *rows = (tmp_path / "progress.csv").read_text().splitlines()
    column = header.split(",").index("plasticity/reset")
    # Episodes of 7 steps end at 7, 14, 21, 28 and 35; the log of 21 is written before the update of 21.
    assert [float(row.split(",")[column]) for row in rows] == [0, 0, 1, 1, 1]


def test_a_loaded_model_does_not_reset_again(tmp_path: Path) -> None:
    model = sac(resets=(20, 60)).learn(40)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = type(model).load(tmp_path / "m", env=vec())
    loaded.load_replay_buffer(tmp_path / "b")
    assert loaded.num_transitions == 40 and loaded.plasticity.n_done == 1
    recorder = Recorder(loaded)
    loaded.learn(15)
    assert recorder.at == []
    loaded.learn(15)
    assert recorder.at == [60]
    assert loaded.plasticity.n_done == 2


def test_a_model_saved_between_step_and_update_still_resets(tmp_path: Path) -> None:
    """Step 20 is reached, but a ratio of 1/4 updates only at 22: the loaded model owes the reset."""
    model = sac(resets=(20,), replay_ratio=0.25).learn(21)
    assert model.plasticity.n_done == 0
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = type(model).load(tmp_path / "m", env=vec())
    loaded.load_replay_buffer(tmp_path / "b")
    recorder = Recorder(loaded)
    loaded.learn(10)
    assert recorder.at == [22]


def test_a_schedule_given_at_loading(tmp_path: Path) -> None:
    sac(resets=(20,)).learn(30).save(tmp_path / "m")
    loaded = type(sac()).load(tmp_path / "m", env=vec(), resets=(20, 50))
    recorder = Recorder(loaded)
    loaded.learn(40)
    assert recorder.at == [50]


def test_integers_of_any_kind() -> None:
    assert Resets([10, 20]).steps == (10, 20)
    assert Resets(np.array([10, 20])).steps == (10, 20)
    assert Resets().steps == ()


@pytest.mark.parametrize(
    "steps", [(0,), (-5, 10), (20, 10), (10, 10), (1.5,), (True,), (float("nan"),), (float("inf"),), ("10",), 10]
)
def test_bad_schedules(steps: Any) -> None:
    with pytest.raises(ValueError, match="resets") as caught:
        sac(resets=steps)
    assert str(steps) in str(caught.value)
