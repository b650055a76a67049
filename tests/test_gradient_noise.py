"""The noise scale of the critics' gradient and the overfitting to old transitions, against numbers computed by hand."""

import copy
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import SAC as SB3SAC
from stable_baselines3.common.logger import Logger

from sb3_sample.diagnostics import DiagnosticsCallback, NoiseScaleCallback, noise_scale
from sb3_sample.diagnostics.gradient_noise import PARTS
from sb3_sample.diagnostics.reading import NEWEST, batch_at, targets, training_places
from sb3_sample.learner.target import outputs
from sb3_sample.sac import SAC
from tests.sac.common import MAKERS, Toy, differing, sac, state, vec
from tests.test_diagnostics import LINEAR, Written, answer, fill, watched


def ready(model: SAC, **kwargs: Any) -> NoiseScaleCallback:
    callback = NoiseScaleCallback(**{"seed": 0, **kwargs})
    callback.init_callback(model)
    return callback


def test_the_papers_number() -> None:
    assert noise_scale(5.5625, 4.09765625) == (4.0, 100.0, 25.0)


# ---------------------------------------------------------------- noise scale


def linear(rewards: np.ndarray) -> SAC:
    """Critics of answer 0 towards the reward, on observations of 0, so that only the bias has a gradient."""
    model = sac(gamma=0.0, ent_coef=0.0, buffer_size=20_000, **LINEAR)
    answer(model.critic, 0, 0)
    for reward in rewards:
        fill(model, [[0, 0, 0]], reward=float(reward))
    assert model.replay_buffer is not None
    return model


def test_the_critical_batch_size_of_a_known_gradient() -> None:
    """
    The gradient of a row by the bias of each critic is proportional to its reward, so that signal and noise are the
    rewards' squared mean and variance, whatever the loss's factor and the number of critics.
    """
    callback = ready(linear(np.tile([-2.0, 4.0], 200)), window=60)  # mean 1, variance 9
    for _ in range(60):
        results = callback.measure()
    # 60 means of 1,024 rows each: the standard error of the squared mean is 2.4%, of the variance less.
    assert results["critical_batch_size"] == pytest.approx(9, rel=0.1)


def test_the_large_gradient_is_that_of_all_small_batches_together(monkeypatch: pytest.MonkeyPatch) -> None:
    model = sac(gamma=0.9, ent_coef=0.1)
    rng = np.random.default_rng(1)
    for _ in range(300):
        fill(model, [rng.normal(size=3)], reward=rng.normal())
    callback = ready(model)
    places: list[np.ndarray] = []
    original = np.random.Generator.choice

    class Spy(np.random.Generator):
        def choice(self, a: Any, size: Any = None, replace: bool = True, **kwargs: Any) -> Any:
            drawn = original(self, a, size, replace, **kwargs)
            if replace:
                places.append(drawn)
            return drawn

    callback._rng = Spy(np.random.PCG64(0))
    # Targets without noise, to repeat them.
    monkeypatch.setattr(
        model.policy, "next_actions", lambda obs, noise: (torch.zeros_like(noise), torch.zeros(len(noise), 1))
    )
    results = callback.measure()
    assert [len(each) for each in places] == [64] * PARTS

    def square(drawn: np.ndarray) -> float:
        assert model.replay_buffer is not None
        batch, target = targets(model, batch_at(model, model.replay_buffer, drawn), np.random.default_rng(0))
        q = outputs(model.critic, batch.observations, batch.actions)
        gradients = torch.autograd.grad(model.learner.head.loss(q, target), list(model.critic.parameters()))
        return sum(each.square().sum().item() for each in gradients)

    assert results["gradient_square_1024"] == pytest.approx(square(np.concatenate(places)), rel=1e-4)
    assert results["gradient_square_64"] == pytest.approx(np.mean([square(each) for each in places]), rel=1e-4)


def test_means_over_a_window() -> None:
    """Of the squared norms, not of their ratios; the oldest measurements give way."""
    callback = ready(linear(np.random.default_rng(0).normal(1, 3, 200)), window=3)
    found = [callback.measure() for _ in range(5)]
    squares = np.array([[each["gradient_square_64"], each["gradient_square_1024"]] for each in found])
    for i, each in enumerate(found):
        signal, _, critical = noise_scale(*squares[max(i - 2, 0) : i + 1].mean(axis=0))
        assert each.get("critical_batch_size") == (pytest.approx(critical) if signal > 0 else None)


def test_no_number_stands_for_a_gradient_that_is_lost_in_noise() -> None:
    rewards = np.tile([3.0, -3.0], 500)
    results = [ready(linear(rewards), seed=seed).measure() for seed in range(8)]
    assert any("critical_batch_size" not in each for each in results)
    for each in results:
        signal = (1024 * each["gradient_square_1024"] - 64 * each["gradient_square_64"]) / 960
        assert ("critical_batch_size" in each) == (signal > 0)


# ---------------------------------------------------------------- overfitting


def test_overfitting_to_old_transitions() -> None:
    model = linear(np.array([1.0] * 84 + [3.0] * NEWEST))
    results = ready(model, batch_size=1_000).measure()
    loss = {
        reward: model.learner.head.loss(torch.zeros(2, 1, 1), torch.full((1, 1), reward)).item() for reward in (1, 3)
    }
    assert results["td_loss_newest"] == pytest.approx(loss[3], rel=1e-5)
    assert results["td_loss_replay"] == pytest.approx(0.84 * loss[1] + 0.16 * loss[3], rel=1e-5)
    assert results["overfitting_newest"] == pytest.approx(0.84 * (loss[3] - loss[1]), rel=1e-5)
    theirs = DiagnosticsCallback(Toy(), n_start_states=1, rollout_length=5, batch_size=1_000, seed=0)
    theirs.init_callback(model)
    assert theirs.measure()["overfitting_newest"] == pytest.approx(results["overfitting_newest"], rel=1e-5)


def test_the_newest_transitions_are_those_before_the_position() -> None:
    model = sac(buffer_size=10, gamma=0.0, ent_coef=0.0)
    for reward in range(13):
        fill(model, [[0, 0, 0]], reward=reward)
    buffer: Any = model.replay_buffer
    assert buffer.rewards[training_places(buffer), 0].tolist() == list(range(3, 13))
    assert "td_loss_newest" not in ready(model).measure(), "16 of 10"


def test_of_several_environments_and_without_those_held_out() -> None:
    model = sac(vec(2), gamma=0.0, ent_coef=0.0, validation_proportion=0.5, buffer_size=40)
    buffer: Any = model.replay_buffer
    for step in range(30):  # 20 of them are kept
        now = np.zeros((2, 3), np.float32)
        buffer.add(now, now, np.zeros((2, 2)), np.array([2.0 * step, 2 * step + 1]), np.zeros(2), [{}, {}])
    places = training_places(buffer)
    assert 0 < len(places) < 40
    found = buffer.rewards[np.divmod(places, 2)]
    expected = [r for r in range(20, 60) if not buffer.held_out[(r // 2) % 20, r % 2]]
    assert found.tolist() == expected


# ---------------------------------------------------------------- in training


#: Scalars, quantiles and batch statistics; the others take their time.
FAST = ("SAC", "BRO", "CrossQ")


@pytest.mark.parametrize(
    "name", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in MAKERS]
)
def test_training_does_not_notice_it(name: str) -> None:
    trained = []
    for callback in (None, NoiseScaleCallback(every=10, batch_size=8)):
        model = MAKERS[name](seed=3)
        written = watched(model)
        model.learn(20, callback=callback)
        trained.append((state(model), written))
    assert differing(trained[0][0], trained[1][0]) == []
    rows = trained[1][1].diagnostics()
    assert rows and all("diagnostics/gradient_square_64" in row for _, row in rows)
    assert all(np.isfinite(value) for _, row in rows for value in row.values())


def test_when_it_measures() -> None:
    model = sac(learning_starts=20)
    written = watched(model)
    model.learn(50, callback=NoiseScaleCallback(every=15))
    assert [step for step, _ in written.diagnostics()] == [30, 45]
    model.learn(20, callback=NoiseScaleCallback(every=15), reset_num_timesteps=False)
    assert [step for step, _ in written.diagnostics()][2:] == [60]


def test_it_goes_on_as_it_was() -> None:
    model = linear(np.random.default_rng(0).normal(1, 3, 200))
    first = ready(model)
    first.measure()
    second = ready(model, seed=7)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    assert second.measure() == first.measure()


def test_one_line_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    model = sac(learning_starts=5)
    model.set_logger(Logger(None, [Written()]))
    model.learn(30, callback=NoiseScaleCallback(every=30, verbose=1))
    assert "Noise scale at 30 steps:" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["every", "window", "batch_size"])
@pytest.mark.parametrize("value", [0, 1.5])
def test_bad_arguments(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be a whole number of at least 1, not {value}"):
        NoiseScaleCallback(**{name: value})  # type: ignore[arg-type]


def test_other_models_are_refused() -> None:
    with pytest.raises(TypeError, match="NoiseScaleCallback needs a model of sb3_sample.sac.SAC, not a SAC"):
        SB3SAC("MlpPolicy", Toy()).learn(1, callback=NoiseScaleCallback())
    with pytest.raises(ValueError, match="knows no model yet"):
        NoiseScaleCallback().measure()
