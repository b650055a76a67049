"""Resets: when they happen, what starts anew, what stays."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sb3_sample import BRO, BROTD3, DAC, SRSAC, BROFast
from sb3_sample.learner.plasticity import Resets
from sb3_sample.networks.batch_norm import running_moments
from sb3_sample.sac.bro import BRO_FAST_RESETS, BRO_RESETS
from tests.sac.common import MAKERS, bro, random_batch, sac, sampled, vec


class Recorder:
    """Wraps ``reinitialize`` and notes the transitions at which it is called."""

    def __init__(self, model: Any):
        self.at: list[int] = []
        original = model.learner.reinitialize

        def reinitialize(*args: Any) -> None:
            self.at.append(model.num_transitions)
            original(*args)

        model.learner.reinitialize = reinitialize


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


def begun(model: Any) -> dict[str, torch.Tensor]:
    """A copy of what a reset starts anew: networks and learned numbers, without counts that go on."""
    parts = {
        name: getattr(model, name) for name in ("policy", "temperature", "pessimism_rule", "explorer", "objective")
    }
    return {
        f"{name}.{key}": value.detach().clone()
        for name, part in parts.items()
        for key, value in part.named_parameters()
    }


@pytest.mark.parametrize("name", sampled(MAKERS))
def test_back_to_the_start(name: str) -> None:
    """With ``resets_to="start"`` a run returns to its own first parameters, whatever was drawn since."""
    model = MAKERS[name](seed=1)
    before = begun(model)
    model.learn(24)
    numbers = torch.get_rng_state()
    model.reinitialize(to="start")
    assert torch.equal(torch.get_rng_state(), numbers), "a reset to the start takes no random numbers"
    after = begun(model)
    assert before.keys() == after.keys()
    for key in before:
        assert torch.equal(after[key], before[key]), key
    assert not any(optimizer.state for optimizer in model._optimizers().values())
    model.learn(12)
    model.reinitialize(to="fresh")
    assert any(not torch.equal(value, before[key]) for key, value in begun(model).items())


@pytest.mark.parametrize(
    ("maker", "to"), [("BRO", "start"), ("BROFast", "start"), ("SRSAC", "start"), ("SAC", "fresh")]
)
def test_what_resets_return_to_by_default(maker: str, to: str) -> None:
    """The published code of BRO and of SR-SAC draws every reset's parameters from the key of the start."""
    model = MAKERS[maker](resets=(20,), seed=1)
    assert model.resets_to == to
    before, after = begun(model), {}
    reinitialize = model.learner.reinitialize

    def then_look(*args: Any) -> None:
        reinitialize(*args)
        after.update(begun(model))

    model.learner.reinitialize = then_look
    model.learn(24)
    same = [torch.equal(after[key], value) for key, value in before.items()]
    assert all(same) if to == "start" else not all(same)


@pytest.mark.parametrize("to", ["start", "fresh"])
def test_the_start_is_saved(to: str, tmp_path: Path) -> None:
    """A loaded model returns to the parameters that the run began with, not to those of its own construction."""
    model = bro(resets=(20,), seed=1)
    before = begun(model)
    model.learn(15)
    model.save(tmp_path / "m")
    loaded = BRO.load(tmp_path / "m", **({} if to == "start" else {"resets_to": to}))
    loaded.reinitialize(loaded.reset_shrink, loaded.resets_keep, loaded.resets_to)
    same = [torch.equal(value, before[key]) for key, value in begun(loaded).items()]
    assert all(same) if to == "start" else not all(same)


@pytest.mark.parametrize("kind", ["text", "short", "floats", "past the end"])
def test_a_damaged_start_is_refused_at_once(kind: str) -> None:
    """And not at the reset, hours later; torch would read what lies behind the last kind's numbers."""
    model = bro(resets=(20,))
    state = model.plasticity.get_extra_state()
    start = state["starts"]["explorer"].clone()
    wrong: Any = {"text": "start", "short": start[:10], "floats": start.float()}.get(kind, start)
    if kind == "past the end":
        start[8:12] = torch.from_numpy(np.array([624], np.int32).view(np.uint8))
        start[16:24] = torch.from_numpy(np.array([624], np.int64).view(np.uint8))
    with pytest.raises(ValueError, match="what explorer came from"):
        model.plasticity.set_extra_state({**state, "starts": {**state["starts"], "explorer": wrong}})
    model.plasticity.set_extra_state(state)


def test_shrinking_towards_the_start() -> None:
    model = bro(resets=(20,), seed=1)
    first = model.critic.trunk.dense.weight.detach().clone()
    model.learn(15)
    learned = model.critic.trunk.dense.weight.detach().clone()
    model.reinitialize(0.25, to="start")
    torch.testing.assert_close(model.critic.trunk.dense.weight.detach(), 0.25 * learned + 0.75 * first)


def test_resets_to_is_checked() -> None:
    with pytest.raises(ValueError, match="resets_to.*'elsewhere'"):
        sac(resets=(20,), resets_to="elsewhere")
    with pytest.raises(ValueError, match="resets_to.*no resets"):
        sac(resets_to="start")
    with pytest.raises(ValueError, match="to must be one of"):
        sac().reinitialize(to="elsewhere")


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


@pytest.mark.parametrize("shrink", [0.0, 0.5])
@pytest.mark.parametrize(
    ("maker", "frozen"),
    [("BRO", "critic.trunk"), ("BROTD3", "actor.trunk"), ("CrossQ", "critic.trunk"), ("DebiasedRQ", "encoder")],
)
def test_what_is_frozen_stays_as_it_is(maker: str, frozen: str, shrink: float) -> None:
    """With the moments of its batch norms, and its targets."""
    model = MAKERS[maker]().learn(20)
    model.policy.get_submodule(frozen).requires_grad_(False)
    model.learn(20)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.reinitialize(shrink)
    network, _, rest = frozen.partition(".")
    kept = tuple(".".join(filter(None, (each, rest))) + "." for each in (network, f"{network}_target"))
    if maker == "CrossQ":
        assert any("running" in name or "mean" in name for name in before if name.startswith(kept))
    for name, value in model.policy.state_dict().items():
        if name.startswith(kept):
            assert torch.equal(value, before[name]), name
    learned = [name for name, p in model.policy.named_parameters() if p.requires_grad]
    assert learned and not any(torch.equal(model.policy.get_parameter(name), before[name]) for name in learned)
    # Trained again, it is reset again.
    model.policy.get_submodule(frozen).requires_grad_(True)
    model.reinitialize(shrink)
    changed = (not torch.equal(p, before[name]) for name, p in model.policy.named_parameters() if name.startswith(kept))
    assert any(changed)


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
    "steps",
    [(0,), (-5, 10), (20, 10), (10, 10), (1.5,), (True,), (float("nan"),), (float("inf"),), ("10",), 0, -10, 1.5, True],
)
def test_bad_schedules(steps: Any) -> None:
    with pytest.raises(ValueError, match="resets") as caught:
        sac(resets=steps)
    assert str(steps) in str(caught.value)


# ---------------------------------------------------------------- every so many steps


@pytest.mark.parametrize(("n_envs", "expected"), [(1, [15, 30, 45]), (4, [16, 32, 48]), (20, [20, 40, 60])])
def test_a_period(n_envs: int, expected: list[int]) -> None:
    model = sac(vec(n_envs), cls=SRSAC, resets=15)
    recorder = Recorder(model)
    model.learn(50)
    assert recorder.at == expected and model.plasticity.n_done == 3


def test_a_period_is_counted_over_the_models_life(tmp_path: Path) -> None:
    model = sac(cls=SRSAC, resets=15)
    recorder = Recorder(model)
    model.learn(20)
    model.learn(16)
    assert recorder.at == [15, 30]
    del model.learner.reinitialize
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = SRSAC.load(tmp_path / "m", env=vec())
    loaded.load_replay_buffer(tmp_path / "b")
    assert loaded.plasticity.period == 15 and loaded.plasticity.n_done == 2
    recorder = Recorder(loaded)
    loaded.learn(25)
    assert recorder.at == [45, 60] and loaded.plasticity.n_done == 4


@pytest.mark.parametrize(("resets", "expected"), [(40, [40]), (10, [40, 50]), ((45,), [45]), ((), [])])
def test_another_schedule_at_loading(resets: Any, expected: list[int], tmp_path: Path) -> None:
    """What lies behind is not made up for."""
    model = sac(cls=SRSAC, resets=15).learn(36)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = SRSAC.load(tmp_path / "m", env=vec(), resets=resets)
    loaded.load_replay_buffer(tmp_path / "b")
    recorder = Recorder(loaded)
    loaded.learn(16)
    assert recorder.at == expected


def test_numbers_of_a_period() -> None:
    assert Resets(7).period == 7 and Resets(np.int64(7)).period == 7  # type: ignore[arg-type]
    assert Resets(7).steps == () and Resets((7,)).period is None


# ---------------------------------------------------------------- every so many gradient steps


class UpdateRecorder:
    """Wraps ``reinitialize`` and notes the gradient steps after which it is called."""

    def __init__(self, model: Any):
        self.after: list[int] = []
        original = model.learner.reinitialize

        def reinitialize(*args: Any) -> None:
            self.after.append(model._n_updates)
            original(*args)

        model.learner.reinitialize = reinitialize


@pytest.mark.parametrize(
    ("n_envs", "kwargs", "n_updates"),
    [
        (1, {"replay_ratio": 1}, 60),
        (1, {"replay_ratio": 4}, 240),
        (1, {"replay_ratio": 0.5}, 30),
        # 80 gradient steps at once are more than are drawn at once.
        pytest.param(4, {"replay_ratio": 20}, 1_280, marks=pytest.mark.slow),
        (1, {"train_freq": (1, "episode"), "gradient_steps": -1}, 63),
    ],
)
def test_resets_by_gradient_steps(n_envs: int, kwargs: dict[str, Any], n_updates: int) -> None:
    """After every 25th, in the midst of an environment step's too, and not before there is a next one."""
    model = sac(vec(n_envs), reset_gradient_steps=25, **kwargs)
    recorder = UpdateRecorder(model)
    model.learn(70)
    assert model._n_updates == n_updates
    assert recorder.after == list(range(25, n_updates, 25))
    assert model.plasticity.n_done == len(recorder.after)


def test_a_training_does_not_end_with_networks_that_have_learned_nothing() -> None:
    model = sac(reset_gradient_steps=20)
    recorder = UpdateRecorder(model)
    model.learn(50)
    assert model._n_updates == 40 and recorder.after == [20]
    model.learn(1)
    assert recorder.after == [20, 40]


@pytest.mark.parametrize("maker", sampled(MAKERS))
def test_every_algorithm_takes_resets_by_gradient_steps(maker: str) -> None:
    """They replace the resets that a class has of its own; tiny ones of the makers are taken back."""
    model = MAKERS[maker](reset_gradient_steps=15, resets=(), replay_ratio=1)
    recorder = UpdateRecorder(model)
    model.learn(50)
    assert recorder.after == [15, 30]


@pytest.mark.parametrize("cls", [BRO, BROFast, BROTD3])
def test_a_classes_own_resets_give_way(cls: Any) -> None:
    assert bro(cls=cls).plasticity.steps == (BRO_FAST_RESETS if cls is BROFast else BRO_RESETS)
    model = bro(cls=cls, reset_gradient_steps=15)
    assert model.resets == model.plasticity.steps == () and model.plasticity.period is None
    with pytest.raises(ValueError, match=r"resets=\(15000,\) and reset_gradient_steps=15 .* pass one of them"):
        bro(cls=cls, resets=(15_000,), reset_gradient_steps=15)


def test_sr_sacs_own_resets_give_way() -> None:
    assert sac(cls=SRSAC).plasticity.period == 160_000
    model = sac(cls=SRSAC, reset_gradient_steps=2_560_000)
    assert model.plasticity.period is None and model.plasticity.gradient_steps == 2_560_000
    with pytest.raises(ValueError, match="resets=160000 and reset_gradient_steps=2560000"):
        sac(cls=SRSAC, resets=160_000, reset_gradient_steps=2_560_000)


@pytest.mark.parametrize("resets", [(20,), [20, 30], 20, np.array([20])])
def test_two_ways_to_count_are_refused(resets: Any) -> None:
    with pytest.raises(ValueError, match="resets=.* and reset_gradient_steps=7 .* pass one of them"):
        sac(resets=resets, reset_gradient_steps=7)
    sac(resets=np.array([], int), reset_gradient_steps=7)


@pytest.mark.parametrize("period", [0, -5, 1.5, True, "10", (10,), float("nan")])
def test_bad_numbers_of_gradient_steps(period: Any) -> None:
    with pytest.raises(ValueError, match="reset_gradient_steps must be an integer of at least 1, or None") as caught:
        sac(reset_gradient_steps=period)
    assert repr(period) in str(caught.value)


def test_gradient_steps_are_counted_over_the_models_life(tmp_path: Path) -> None:
    """Saved where a reset is due but not done, and loaded: it comes once."""
    model = sac(reset_gradient_steps=15, reset_shrink=0.25).learn(40)
    assert model._n_updates == 30 and model.plasticity.n_done == 1
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = type(model).load(tmp_path / "m", env=vec())
    loaded.load_replay_buffer(tmp_path / "b")
    assert (loaded.plasticity.gradient_steps, loaded.plasticity.shrink, loaded.plasticity.n_done) == (15, 0.25, 1)
    recorder = UpdateRecorder(loaded)
    loaded.learn(20)
    assert recorder.after == [30, 45] and loaded.plasticity.n_done == 3


def test_one_way_to_count_replaces_the_other_at_loading(tmp_path: Path) -> None:
    sac(cls=SRSAC).save(tmp_path / "by transitions")
    sac(cls=SRSAC, reset_gradient_steps=9).save(tmp_path / "by gradient steps")

    def loaded(name: str, **kwargs: Any) -> tuple[Any, Any]:
        model = SRSAC.load(tmp_path / name, env=vec(), **kwargs)
        return model.plasticity.period, model.plasticity.gradient_steps

    assert loaded("by transitions") == (160_000, None)
    assert loaded("by transitions", reset_gradient_steps=7) == (None, 7)
    assert loaded("by transitions", resets=(), reset_gradient_steps=7) == (None, 7)
    assert loaded("by gradient steps") == (None, 9)
    assert loaded("by gradient steps", reset_gradient_steps=7) == (None, 7)
    assert loaded("by gradient steps", resets=30) == (30, None)
    assert loaded("by gradient steps", resets=()) == (None, None)
    assert loaded("by gradient steps", reset_gradient_steps=None) == (None, None)
    for name in ("by transitions", "by gradient steps"):
        with pytest.raises(ValueError, match="resets=30 and reset_gradient_steps=7"):
            loaded(name, resets=30, reset_gradient_steps=7)


def test_resets_by_gradient_steps_are_told_of(capsys: pytest.CaptureFixture[str]) -> None:
    sac(reset_gradient_steps=15, verbose=1).learn(30)
    assert "Reset of all parameters after 15 gradient steps" in capsys.readouterr().out


# ---------------------------------------------------------------- shrink and perturb


@pytest.mark.parametrize("shrink", [0.0, 0.3, 0.8])
@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_shrink_and_perturb_by_hand(maker: str, shrink: float) -> None:
    """Every parameter, target networks and learned numbers included: shrink * old + (1 - shrink) * fresh."""
    model = MAKERS[maker](learning_rate=1e-2, tau=0.3).learn(16)
    old = {name: p.detach().clone() for name, p in model.policy.named_parameters()}
    log_alpha = model.temperature.log_value.item()
    assert log_alpha != 0
    identities = [id(p) for p in model.policy.parameters()]
    torch.manual_seed(7)
    fresh = model.policy_class(
        model.observation_space, model.action_space, model.lr_schedule, **model._full_policy_kwargs()
    )
    torch.manual_seed(7)
    model.reinitialize(shrink)
    for (name, value), new in zip(model.policy.named_parameters(), fresh.parameters(), strict=True):
        if shrink == 0:
            assert torch.equal(value, new), name
        else:
            torch.testing.assert_close(value, shrink * old[name] + (1 - shrink) * new, rtol=1e-6, atol=1e-7)
    assert any("critic_target" in name for name in old)
    assert model.temperature.log_value.item() == pytest.approx(shrink * log_alpha, rel=1e-5, abs=1e-7)
    assert [id(p) for p in model.policy.parameters()] == identities
    assert not any(optimizer.state for optimizer in model._optimizers().values())


@pytest.mark.parametrize("shrink", [0.0, 0.8])
@pytest.mark.parametrize("maker", ["CrossQ", "XQC", "FlashSAC"])
def test_running_moments_outlive_a_shrink(maker: str, shrink: float) -> None:
    """They are of weights most of which stay; a full reset starts them anew."""
    model = MAKERS[maker](exploration="optimistic_actor", exploration_kwargs=None)
    fresh = dict(running_moments(model.policy))
    fresh = {name: moment.clone() for name, moment in fresh.items()}
    for i in range(3):
        model.learner.update(random_batch(model, 16, seed=i))
    owners = (model.policy, model.explorer)
    before = [{name: moment.clone() for name, moment in running_moments(owner)} for owner in owners]
    assert all(not torch.equal(before[0][name], fresh[name]) for name in fresh if name.startswith("critic."))
    model.reinitialize(shrink)
    for owner, old in zip(owners, before, strict=True):
        new = dict(running_moments(owner))
        assert len(new) > 0
        assert all(torch.equal(new[name], old[name]) for name in new) == (shrink > 0)
    if shrink == 0:
        assert all(torch.equal(moment, fresh[name]) for name, moment in running_moments(model.policy))


def test_shrinks_the_explorers_numbers() -> None:
    model = sac(cls=DAC, adjustment_learning_rate=0.1, initial_kl_weight=2.0).learn(16)
    old = model.explorer.kl_weight.log_value.item()
    assert old != pytest.approx(np.log(2), rel=1e-2)
    model.reinitialize(0.25)
    assert model.explorer.kl_weight.log_value.item() == pytest.approx(0.25 * old + 0.75 * np.log(2), rel=1e-5)


@pytest.mark.parametrize("shrink", [0.0, 0.5, 0.8])
def test_shrunk_kernels_have_spectral_norm_one(shrink: float) -> None:
    """The directions of a spectral norm belong to its kernel, which has just been mixed of two."""
    kwargs = {"critic_network_kwargs": {"hidden_sizes": [16, 16], "spectral_norm": True}}
    model = sac(policy_kwargs=kwargs, learning_rate=1e-2).learn(30)
    model.reinitialize(shrink)
    model.policy.set_training_mode(False)
    for critic in (model.critic, model.critic_target):
        values = torch.linalg.svdvals(critic.trunk.layers[2].normalized_weight().detach())
        torch.testing.assert_close(values[:, 0], torch.ones(2), rtol=0.05, atol=0)


def test_shrink_is_what_the_resets_use() -> None:
    shrinks = []
    model = sac(resets=(20,), reset_shrink=0.4)
    reinitialize = model.learner.reinitialize
    model.learner.reinitialize = lambda shrink, *others: shrinks.append(shrink) or reinitialize(shrink, *others)
    model.learn(25)
    assert shrinks == [0.4]


@pytest.mark.parametrize("shrink", [1.0, -0.1, 1.5, float("nan")])
def test_bad_shrink(shrink: float) -> None:
    with pytest.raises(ValueError, match="reset_shrink") as caught:
        sac(reset_shrink=shrink)
    assert str(shrink) in str(caught.value)


def test_shrink_at_loading(tmp_path: Path) -> None:
    sac(resets=(20,)).save(tmp_path / "m")
    assert type(sac()).load(tmp_path / "m", env=vec(), reset_shrink=0.5).plasticity.shrink == 0.5
