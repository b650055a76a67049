"""FlashSAC's exploration: how long a noise is held, and that it is kept."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sb3_sample.learner.exploration import HeldNoise
from tests.sac.common import MAKERS, differing, sac, state, vec


def held_noise(**kwargs: Any) -> Any:
    return sac(exploration="held_noise", **kwargs)


def test_by_hand() -> None:
    """With lengths of 1 to 3 in proportion to 1, 1/4, 1/9: 36/49, 9/49, 4/49."""
    explorer: Any = held_noise(exploration_kwargs={"longest": 3}).explorer
    np.testing.assert_allclose(explorer._cumulative, [36 / 49, 45 / 49, 1], rtol=1e-6)
    noise = torch.arange(7.0)[:, None, None].expand(7, 1, 2)
    # The uniform number counts where a new noise is taken up: at steps 0, 1, 4 and 6.
    uniform = [0.7, 0.95, 0.0, 0.0, 0.8, 0.99, 0.1]
    found = [float(explorer.hold(noise[t], uniform[t])[0, 0]) for t in range(7)]
    assert found == [0, 1, 1, 1, 4, 4, 6]
    assert explorer.hold(torch.ones(1, 2) * 9, 0.9999999)[0, 0] == 9 and explorer._length == 3


def test_distribution() -> None:
    """Every run of equal noise over many steps, in every environment at once."""
    model = held_noise(env=vec(2), exploration_kwargs={"longest": 4, "exponent": 1.0})
    torch.manual_seed(0)
    observations = torch.zeros(2, 3)
    rows = []
    for _ in range(4_000):
        model.learner.act(observations)
        rows.append(model.explorer._held.clone())
    noise = torch.stack(rows)
    changes = (noise.diff(dim=0) != 0).all(dim=(1, 2))
    assert torch.equal(changes, (noise.diff(dim=0) != 0).any(dim=2).any(dim=1))
    ends = [-1, *changes.nonzero()[:, 0].tolist()]
    lengths = np.diff(ends)
    assert lengths.max() <= 4
    shares = np.bincount(lengths, minlength=5)[1:] / len(lengths)
    wanted = np.array([1, 1 / 2, 1 / 3, 1 / 4])
    # Some 2,000 noises: four standard errors.
    np.testing.assert_allclose(shares, wanted / wanted.sum(), atol=0.045)
    drawn = noise[torch.tensor([True, *changes.tolist()])]
    assert abs(float(drawn.mean())) < 0.07 and abs(float(drawn.std()) - 1) < 0.05


def test_the_action_has_the_noise_that_is_held() -> None:
    """Mean and standard deviation are those of each step; evaluation touches nothing."""
    model = held_noise()
    explorer = model.explorer
    model.learner.act(torch.zeros(1, 3))
    explorer._length = 5
    held = explorer._held.clone()
    for t in range(1, 4):
        observations = torch.full((1, 3), float(t))
        with torch.no_grad():
            mean, log_std = model.actor.gaussian(model.actor.features(observations))
        before = dict(explorer.get_extra_state())
        assert np.array_equal(model.predict(observations.numpy(), deterministic=True)[0], torch.tanh(mean).numpy())
        model.predict(observations.numpy())
        assert explorer.get_extra_state() == before
        action = model.learner.act(observations)
        torch.testing.assert_close(action, torch.tanh(mean + log_std.exp() * held))


def test_outlives_the_end_of_an_episode() -> None:
    explorer: Any = held_noise().explorer
    first = explorer.hold(torch.ones(1, 2), 0.9999)
    for _ in range(3):
        explorer.on_episode_end(None, 0, 1.0)
        explorer.on_environment_reset(None)
        assert torch.equal(explorer.hold(torch.zeros(1, 2), 0.0), first)


@pytest.mark.parametrize("n_envs", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_resumed_bit_by_bit(n_envs: int, tmp_path: Path) -> None:
    """A run that stops while a noise is held goes on with it."""

    def make() -> Any:
        return MAKERS["FlashSAC"](vec(n_envs), exploration_kwargs={"exponent": 0.0}, schedule_steps=80)

    model = make().learn(90, checkpoint=tmp_path / "a", checkpoint_freq=1000)
    stopped = make().learn(42, checkpoint=tmp_path / "b", checkpoint_freq=3)
    assert stopped.explorer._n_held > 0
    resumed = make().learn(90, checkpoint=tmp_path / "b", checkpoint_freq=1000)
    assert not differing(state(model), state(resumed))
    assert model.explorer.get_extra_state() == resumed.explorer.get_extra_state()


def test_saved(tmp_path: Path) -> None:
    model = MAKERS["FlashSAC"](exploration_kwargs={"exponent": 0.0}).learn(30)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model")
    assert isinstance(loaded.explorer, HeldNoise)
    assert loaded.explorer.get_extra_state() == model.explorer.get_extra_state()
    assert model.explorer.get_extra_state()["held"] != []


def test_starts_anew_at_a_reset() -> None:
    model = held_noise()
    model.learner.act(torch.zeros(1, 3))
    model.reinitialize()
    assert model.explorer.get_extra_state() == {"held": [], "length": 0, "n_held": 0}
