"""How many gradient steps are taken, and when."""

from pathlib import Path
from typing import Any

import pytest

from sb3_sample.sac import SAC
from tests.sac.common import MAKERS, sac, vec


def count(model: SAC) -> SAC:
    """Replace the gradient step, which these tests only count."""

    def update(*args: Any) -> dict[str, Any]:
        model._n_updates += 1
        return {}

    model._update = update  # type: ignore[method-assign, assignment]
    return model


def transitions_after_warm_up(n_transitions: int, learning_starts: int, n_envs: int) -> int:
    """Transitions of the vectorised steps that end after the warm-up."""
    return sum(n_envs for end in range(n_envs, n_transitions + 1, n_envs) if end > learning_starts)


@pytest.mark.parametrize("n_envs", [1, 3, 8])
@pytest.mark.parametrize("ratio", [0.25, 1, 2.5, 10])
@pytest.mark.parametrize("learning_starts", [0, 10, 24])
def test_number_of_gradient_steps(learning_starts: int, ratio: float, n_envs: int) -> None:
    model = count(sac(vec(n_envs), replay_ratio=ratio, learning_starts=learning_starts))
    model.learn(96)
    assert model.num_transitions == 96
    assert model._n_updates == int(ratio * transitions_after_warm_up(96, learning_starts, n_envs))


@pytest.mark.parametrize("ratio", [0.1, 0.3, 1 / 3, 0.7])
def test_fractions_do_not_get_lost(ratio: float) -> None:
    model = count(sac(replay_ratio=ratio, learning_starts=0))
    model.learn(300)
    assert model._n_updates == round(ratio * 300)


@pytest.mark.parametrize("ratio", [0, 1e-3])
def test_no_gradient_step(ratio: float) -> None:
    assert count(sac(replay_ratio=ratio)).learn(100)._n_updates == 0


@pytest.mark.parametrize("n_envs", [1, 3])
def test_warm_up(n_envs: int) -> None:
    model = count(sac(vec(n_envs), learning_starts=30))
    model.learn(30)
    assert model._n_updates == 0
    model.learn(n_envs, reset_num_timesteps=False)
    assert model._n_updates == n_envs


def test_warm_up_is_not_repeated_by_a_second_learn() -> None:
    """It is counted over the model's life, whatever learn zeroes."""
    model = count(sac(learning_starts=20))
    model.learn(30)
    assert model._n_updates == 10
    model.learn(30)
    assert model._n_updates == 40
    assert model.num_timesteps == 30 and model.num_transitions == 60


@pytest.mark.parametrize("reset", [True, False])
def test_owed_fractions_survive_a_second_learn(reset: bool) -> None:
    model = count(sac(replay_ratio=0.25, learning_starts=0))
    for _ in range(10):
        model.learn(3, reset_num_timesteps=reset)
    assert model._n_updates == 7


def test_owed_fraction_is_saved(tmp_path: Path) -> None:
    model = count(sac(replay_ratio=0.25, learning_starts=0)).learn(3)
    del model._update
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = count(SAC.load(tmp_path / "m", env=vec()))
    loaded.load_replay_buffer(tmp_path / "b")
    assert loaded._n_updates == 0
    assert loaded.learn(1)._n_updates == 1


def test_a_loaded_model_fills_its_buffer_first(tmp_path: Path) -> None:
    sac(learning_starts=20).learn(40).save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=vec())
    before = loaded._n_updates
    loaded.learn(19)
    assert loaded._n_updates == before
    loaded.learn(5)
    assert loaded._n_updates > before


def test_a_buffer_smaller_than_the_warm_up() -> None:
    model = count(sac(vec(3), learning_starts=50, buffer_size=20)).learn(81)
    assert model._n_updates == transitions_after_warm_up(81, 50, 3)


# ---------------------------------------------------------------- Stable-Baselines3's arguments


@pytest.mark.parametrize(
    ("kwargs", "n_envs", "expected"),
    [
        # Steps 11..50 of one environment: 40.
        (dict(gradient_steps=1), 1, 40),
        (dict(gradient_steps=3), 1, 120),
        (dict(gradient_steps=-1), 1, 40),
        (dict(gradient_steps=0), 1, 0),
        # train_freq alone: one gradient step every five, at 15, 20, ..., 50.
        (dict(train_freq=5), 1, 8),
        (dict(train_freq=5, gradient_steps=2), 1, 16),
        (dict(train_freq=5, gradient_steps=-1), 1, 40),
        (dict(train_freq=(5, "step")), 1, 8),
        # Episodes of seven steps end at 14, 21, 28, 35, 42, 49 after the warm-up, and the one begun then at 56.
        (dict(train_freq=(1, "episode")), 1, 7),
        (dict(train_freq=(1, "episode"), gradient_steps=-1), 1, 49),
        # Two environments: 25 steps, of which those ending at 12, 14, ..., 50 count.
        (dict(gradient_steps=1), 2, 20),
        (dict(gradient_steps=-1), 2, 40),
        # Every fifth step of two environments: 20, 30, 40, 50 (10 is not after the warm-up).
        (dict(train_freq=5), 2, 4),
        (dict(train_freq=5, gradient_steps=-1), 2, 40),
    ],
)
@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_gradient_steps_and_train_freq(maker: str, kwargs: dict[str, Any], n_envs: int, expected: int) -> None:
    model = count(MAKERS[maker](vec(n_envs), replay_ratio=10, **kwargs))
    assert model.replay_ratio is None
    model.learn(50)
    assert model._n_updates == expected


def test_agrees_with_stable_baselines3() -> None:
    import stable_baselines3 as sb3

    for n_envs, train_freq, gradient_steps in [(1, 3, 2), (2, 4, -1), (1, (2, "episode"), -1), (3, 1, 5)]:
        kwargs: dict[str, Any] = dict(train_freq=train_freq, gradient_steps=gradient_steps)
        theirs = sb3.SAC("MlpPolicy", vec(n_envs), learning_starts=10, buffer_size=500, device="cpu", batch_size=2,
                         policy_kwargs={"net_arch": [2]}, **kwargs).learn(45)  # fmt: skip
        ours = count(sac(vec(n_envs), **kwargs)).learn(45)
        assert ours._n_updates == theirs._n_updates, (n_envs, kwargs)


def test_override_at_loading(tmp_path: Path) -> None:
    sac(replay_ratio=1).learn(12).save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=vec(), replay_ratio=3, learning_starts=0)
    assert loaded.replay_ratio == 3
    before = loaded._n_updates
    count(loaded).learn(20)
    assert loaded._n_updates - before == 60


def test_gradient_steps_override_at_loading(tmp_path: Path) -> None:
    """As at construction, they replace the replay ratio."""
    sac(replay_ratio=1).learn(12).save(tmp_path / "m")
    loaded = count(SAC.load(tmp_path / "m", env=vec(), gradient_steps=4, learning_starts=0))
    before = loaded._n_updates
    assert loaded.learn(20)._n_updates - before == 80


def test_train_freq_is_kept_at_loading(tmp_path: Path) -> None:
    sac(train_freq=5, gradient_steps=2).learn(12).save(tmp_path / "m")
    loaded = count(SAC.load(tmp_path / "m", env=vec(), learning_starts=0))
    assert loaded.replay_ratio is None
    before = loaded._n_updates
    assert loaded.learn(20)._n_updates - before == 8
