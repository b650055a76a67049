"""``replay_ratio``, and Stable-Baselines3's ``train_freq`` and ``gradient_steps`` in its place."""

import functools
from pathlib import Path
from typing import Any

import pytest

from sb3_sample import SAC, SRSPR
from tests.srspr.common import tiny

MAKERS: dict[str, tuple[Any, Any]] = {
    "SAC": (SAC, functools.partial(SAC, "MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}, device="cpu")),
    "SRSPR": (SRSPR, tiny),
}


def pace_of(model: Any) -> tuple[float | None, int, int]:
    return model.replay_ratio, model.train_freq.frequency, model.gradient_steps


@pytest.mark.parametrize("name", MAKERS)
def test_one_of_the_two_ways_is_in_force(name: str, tmp_path: Path) -> None:
    cls, make = MAKERS[name]
    assert pace_of(make()) == (2, 1, 1)
    assert pace_of(make(replay_ratio=3, train_freq=None, gradient_steps=None)) == (3, 1, 1)
    model = make(train_freq=4, replay_ratio=None)
    assert pace_of(model) == (None, 4, 1)
    model.save(tmp_path / "m")
    assert pace_of(cls.load(tmp_path / "m", train_freq=None)) == (None, 1, 1)
    assert pace_of(cls.load(tmp_path / "m", replay_ratio=3)) == (3, 1, 1)
    make().save(tmp_path / "m")
    assert pace_of(cls.load(tmp_path / "m", train_freq=None)) == (2, 1, 1)
    assert pace_of(cls.load(tmp_path / "m", gradient_steps=5)) == (None, 1, 5)


@pytest.mark.parametrize("name", MAKERS)
def test_a_replay_ratio_without_effect(name: str, tmp_path: Path) -> None:
    cls, make = MAKERS[name]
    words = "replay_ratio=3 has no effect with gradient_steps=4: pass one of the two"
    with pytest.warns(UserWarning, match=words):
        assert pace_of(make(gradient_steps=4, replay_ratio=3)) == (None, 1, 4)
    make().save(tmp_path / "m")
    with pytest.raises(ValueError, match=words):
        cls.load(tmp_path / "m", gradient_steps=4, replay_ratio=3)
