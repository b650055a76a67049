"""Learning rates over the planned gradient steps: by hand, in training, resumed and continued."""

import math
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import ConstantSchedule

from sb3_sample.learner.schedules import LearningRateSchedule
from sb3_sample.sac import SAC, XQC
from tests.sac.common import COMPILES, MAKERS, bro, differing, random_batch, sac, state, vec


def test_a_learn_that_ends_in_the_warm_up_plans_nothing(tmp_path: Path) -> None:
    model = sac(learning_rate_schedule="linear", replay_ratio=2, learning_starts=10)
    with pytest.warns(UserWarning, match="learn ended without a single gradient step"):
        model.learn(10)
    assert model.planned_updates is None and model._n_updates == 0
    assert model.learn(30, reset_num_timesteps=False).planned_updates == 60
    assert model.learner.scheduled_rate == pytest.approx(0, abs=1e-12)
    with pytest.warns(UserWarning, match="learn ended without a single gradient step"):
        given = sac(learning_rate_schedule="linear", learning_starts=10, schedule_steps=70).learn(10)
    assert given.planned_updates == 70


def test_a_learn_that_was_ended_in_the_warm_up_plans_nothing(tmp_path: Path) -> None:
    arguments = {"learning_rate_schedule": "linear", "replay_ratio": 2, "learning_starts": 10}
    model = sac(**arguments)
    model.learn(20, callback=lambda *_: model.num_timesteps < 5)
    assert model._n_updates == 0 and model.num_timesteps == 5
    model.save(tmp_path / "model.zip")
    assert SAC.load(tmp_path / "model.zip", env=vec()).learn(15, reset_num_timesteps=False).planned_updates == 30
    assert model.learn(30).planned_updates == 60
    assert model.learner.scheduled_rate == pytest.approx(3e-4 * (1 - model._n_updates / 60)) and model._n_updates > 40
    # A run that goes on from a checkpoint of the warm-up plans all of its steps.
    for name, steps in ("again", 20), ("longer", 30):
        run = sac(**arguments)
        run.learn(20, checkpoint=tmp_path / name, checkpoint_freq=4, callback=lambda *_: run.num_timesteps < 7)  # noqa: B023
        assert run._n_updates == 0
        other = sac(**arguments)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert other.learn(steps, checkpoint=tmp_path / name).planned_updates == 2 * steps
        assert other.num_timesteps == steps and other._num_timesteps_at_start == 0
    # So does one that has ended there, at a checkpoint.
    with pytest.warns(UserWarning, match="learn ended without a single gradient step"):
        sac(**arguments).learn(8, checkpoint=tmp_path / "ended", checkpoint_freq=4)
    assert sac(**arguments).learn(30, checkpoint=tmp_path / "ended").planned_updates == 60


def test_a_learn_without_gradient_steps_plans_nothing() -> None:
    model = sac(learning_rate_schedule="linear", replay_ratio=0, learning_starts=10).learn(20)
    assert model.planned_updates is None and model._n_updates == 0
    model.replay_ratio = 2
    assert model.learn(15, reset_num_timesteps=False).planned_updates == 30


def test_linear_by_hand() -> None:
    schedule = LearningRateSchedule("linear", 1e-4, 5e-5)
    found = [schedule.rate(n, 4) for n in (0, 1, 2, 4, 5, 100)]
    assert found == pytest.approx([1e-4, 8.75e-5, 7.5e-5, 5e-5, 5e-5, 5e-5])
    assert schedule.rate(7, None) == 1e-4


def test_cosine_by_hand() -> None:
    schedule = LearningRateSchedule("cosine", 3e-4, 1e-4, warm_up=2, start=1e-4)
    found = [schedule.rate(n, 10) for n in (0, 1, 2, 4, 6, 10, 11)]
    quarter = 1e-4 + 2e-4 * (1 + math.cos(math.pi / 4)) / 2
    assert found == pytest.approx([1e-4, 2e-4, 3e-4, quarter, 2e-4, 1e-4, 1e-4])


def rates(model: Any) -> dict[str, float]:
    return {name: optimizer.param_groups[0]["lr"] for name, optimizer in model.learner.optimizers().items()}


def test_each_optimizer_goes_by_its_own_steps() -> None:
    model = bro(
        learning_rate=1e-3, learning_rate_schedule="linear", final_learning_rate=0.0, schedule_steps=10, policy_delay=2
    )
    batch, own = random_batch(model), model.explorer.scalar_optimizer.param_groups[0]["lr"]
    for k in range(6):
        model._update(batch)
        found = rates(model)
        assert found["critic.optimizer"] == pytest.approx(1e-3 * (1 - k / 10))
        for name in ("actor.optimizer", "temperature_optimizer", "explorer.actor_optimizer"):
            assert found[name] == pytest.approx(1e-3 * (1 - k // 2 / 10)), (name, k)
    assert found["explorer.scalar_optimizer"] == own


def test_a_value_network_goes_by_the_critics_steps() -> None:
    """That of IQL learns in every step, whatever the actor's delay."""
    model = MAKERS["IQL"](
        learning_rate=1e-3, learning_rate_schedule="linear", final_learning_rate=0.0, schedule_steps=10, policy_delay=2
    )
    batch = random_batch(model)
    for k in range(6):
        model._update(batch)
        found = rates(model)
        assert found["critic.optimizer"] == found["objective.optimizer"] == pytest.approx(1e-3 * (1 - k / 10))
        assert found["actor.optimizer"] == pytest.approx(1e-3 * (1 - k // 2 / 10))


def test_planned_are_the_first_learns(tmp_path: Path) -> None:
    """Its environment steps times the replay ratio, the random ones included; later calls and files keep that."""
    model = sac(learning_rate_schedule="linear", replay_ratio=2, learning_starts=10)
    model.learn(40)
    assert model.planned_updates == 80 and model._n_updates == 60
    assert model.learner.scheduled_rate == pytest.approx(3e-4 * (1 - 60 / 80))
    model.learn(5, reset_num_timesteps=False)
    assert model.learner.planned_updates == 80 and model.learner.scheduled_rate == pytest.approx(3e-4 * 10 / 80)
    model.save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model", env=vec())
    assert loaded.planned_updates == 80
    loaded.learn(60)
    assert loaded.planned_updates == 80 and loaded.learner.scheduled_rate == 0
    assert SAC.load(tmp_path / "model", schedule_steps=200).learner.planned_updates == 200
    assert sac(learning_rate_schedule="cosine", schedule_steps=7).learn(40).planned_updates == 7


def test_a_schedule_that_comes_at_loading_begins_there(tmp_path: Path) -> None:
    sac(replay_ratio=2, learning_starts=10).learn(40).save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model", env=vec(), learning_rate_schedule="linear", learning_starts=0)
    loaded.learn(30)
    # 60 steps before it, and 60 of its own.
    assert loaded.planned_updates == 120 and loaded._n_updates == 120
    assert loaded.learner.scheduled_rate == pytest.approx(0, abs=1e-12)


def test_stable_baselines3s_arguments() -> None:
    model = sac(learning_rate_schedule="linear", train_freq=2, gradient_steps=3, env=vec(2)).learn(40)
    assert model.planned_updates == 30
    model = sac(learning_rate_schedule="linear", train_freq=(1, "episode"), gradient_steps=-1).learn(40)
    assert model.planned_updates == 40
    model = sac(learning_rate_schedule="linear", train_freq=(1, "episode"), gradient_steps=5)
    with pytest.raises(ValueError, match="schedule_steps must be given"):
        model.learn(40)
    # Collected first, to be learned from later.
    model = sac(learning_rate_schedule="linear", train_freq=1, gradient_steps=0).learn(40)
    assert model.num_timesteps == 40 and model._n_updates == 0 and model.planned_updates is None


def test_the_zoos_numbers_are_numbers(tmp_path: Path) -> None:
    """The zoo makes a schedule of every learning rate that it is given."""
    model = sac(learning_rate_schedule="linear", learning_rate=ConstantSchedule(1e-3), schedule_steps=60).learn(40)
    assert model.learning_rate == 1e-3 and model.learner.scheduled_rate == pytest.approx(1e-3 * 30 / 60)
    model.save(tmp_path / "model")
    assert SAC.load(tmp_path / "model", env=vec(), learning_rate=ConstantSchedule(2e-3)).learning_rate == 2e-3


def test_no_learning(tmp_path: Path) -> None:
    """The zoo, and scripts that follow it, load a model to watch with a learning rate of 0."""
    model = sac(learning_rate_schedule="cosine", final_learning_rate=1e-5, warm_up_steps=5, schedule_steps=60).learn(40)
    model.save(tmp_path / "model")
    to_watch = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}
    loaded = SAC.load(tmp_path / "model", env=vec(), custom_objects=to_watch)
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.learner.n_updates > model.learner.n_updates and loaded._rate_in_force() == 0
    for part, moves in (("actor.", False), ("critic.", False), ("critic_target.", True)):
        now, before = (
            {name: value for name, value in each.policy.state_dict().items() if name.startswith(part)}
            for each in (loaded, model)
        )
        assert now and any(not torch.equal(value, before[name]) for name, value in now.items()) is moves, part
    assert torch.equal(loaded.temperature(), model.temperature())


def test_a_plan_that_is_over(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        # With 10 random steps it takes 30 of its 40 planned ones.
        model = sac(learning_rate_schedule="linear").learn(40).learn(10, reset_num_timesteps=False)
    assert model._n_updates == model.planned_updates == 40
    model.save(tmp_path / "model")
    words = (
        "of the 20 coming gradient steps the critics' learning rate is final_learning_rate=0: they come after the 40 p"
    )
    with pytest.warns(UserWarning, match=f"in 20 {words}"):
        model.learn(20, reset_num_timesteps=False)
    with pytest.warns(UserWarning, match=f"in 10 {words}"):
        sac(learning_rate_schedule="linear").learn(40).learn(20, reset_num_timesteps=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        SAC.load(tmp_path / "model", env=vec(), final_learning_rate=1e-5).learn(10, reset_num_timesteps=False)
        SAC.load(tmp_path / "model", env=vec(), schedule_steps=100).learn(10, reset_num_timesteps=False)


@pytest.mark.parametrize("rate", [3e-4, 1e-5, ConstantSchedule(2e-5), 0.0])
def test_the_final_rate_of_crossq_with_weight_norm(rate: Any) -> None:
    model = MAKERS["CrossQ+WN"](learning_rate=rate)
    assert model.final_learning_rate == pytest.approx(model.learning_rate / 10, rel=1e-12)
    assert MAKERS["CrossQ+WN"]().final_learning_rate == 3e-5
    assert MAKERS["CrossQ+WN"](learning_rate=rate, final_learning_rate=0.0).final_learning_rate == 0


def test_resumed(tmp_path: Path) -> None:
    def run(folder: Path, stop: int | None = None) -> Any:
        model = sac(learning_rate_schedule="cosine", final_learning_rate=1e-5, warm_up_steps=5)
        stopped = (lambda _l, _g: model.num_timesteps < stop) if stop else None
        return model.learn(60, callback=stopped, checkpoint=folder, checkpoint_freq=10)

    whole = run(tmp_path / "a")
    run(tmp_path / "b", stop=35)
    resumed = run(tmp_path / "b")
    assert resumed.planned_updates == whole.planned_updates == 60
    assert not differing(state(whole), state(resumed))


@pytest.mark.slow
@COMPILES
def test_compiled_and_logged(tmp_path: Path) -> None:
    """A compiled step reads the rates of every step, and is compiled once."""
    models = [sac(learning_rate_schedule="linear", schedule_steps=20, compile=compile) for compile in (False, True)]
    ends = []
    for model in models:
        torch.manual_seed(0)
        for k in range(20):
            model._update(random_batch(model, seed=k))
        ends.append({name: value for name, value in state(model).items() if "optimizer" not in name})
    assert models[1].learner._execution.compiled
    for name, value in ends[0].items():
        assert torch.allclose(value, ends[1][name], atol=3e-5), name
    models[1]._update(random_batch(models[1]))
    moved = [name for name in differing(ends[1], state(models[1])) if name.startswith("policy/actor.")]
    assert not moved, "the rate at the end is 0"
    models[1].set_logger(configure(str(tmp_path), ["csv"]))
    models[1]._record_counts()
    assert models[1].logger.name_to_value["train/learning_rate"] == 0


def test_a_learner_alone() -> None:
    model = sac()
    spaces = model.observation_space, model.action_space
    learner = SAC.learner(*spaces, learning_rate_schedule="linear", learning_rate=1.0)
    assert learner.planned_updates is None and learner.scheduled_rate == 1.0
    learner.planned_updates = 4
    learner._counts._n_updates = 2
    other = SAC.learner(*spaces, learning_rate_schedule="linear", learning_rate=1.0)
    other.load_state_dict(learner.state_dict())
    assert other.scheduled_rate == 0.5
    assert SAC.learner(*spaces, learning_rate_schedule="linear", schedule_steps=9).planned_updates == 9


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"learning_rate_schedule": "exponential"}, r"learning_rate_schedule must be one of \['linear', 'cosine'\]"),
        ({"final_learning_rate": 1e-5}, "final_learning_rate=1e-05 means nothing with learning_rate_schedule=None"),
        ({"schedule_steps": 5}, "schedule_steps=5 means nothing with learning_rate_schedule=None"),
        (
            {"learning_rate_schedule": "linear", "learning_rate": lambda p: p},
            "learning_rate, a function, is a schedule, and so is learning_rate_schedule='linear'",
        ),
        (
            {"cls": XQC, "learning_rate": 1e-5},
            "final_learning_rate=3e-05 lies above learning_rate=1e-05, .* pass final_learning_rate= too",
        ),
        (
            {"learning_rate_schedule": "linear", "schedule_steps": 5, "warm_up_steps": 5},
            "schedule_steps=5 must exceed warm_up_steps=5",
        ),
        (
            {"learning_rate_schedule": "linear", "warm_up_learning_rate": 1e-3},
            "warm_up_learning_rate=0.001 means nothing with warm_up_steps=0",
        ),
    ],
)
def test_refused(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        sac(**kwargs)
