"""Saving, loading, and seeds: everything bit for bit."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample import MBMAPPO, QMAPPO, RewoundPPO
from sb3_sample.saving import container, load_vec_normalize, save_vec_normalize
from tests.ppo.common import EVERY, tiny
from tests.sac.common import differing, state, vec

OBSERVATIONS = np.random.default_rng(0).normal(size=(16, 3)).astype(np.float32)


@pytest.mark.parametrize("cls", EVERY)
@pytest.mark.parametrize("trained", [False, True])
def test_save_load_gives_the_same_model(cls: Any, trained: bool, tmp_path: Path) -> None:
    model = tiny(cls)
    if trained:
        model.learn(32)
    model.save(tmp_path / "m")
    loaded = cls.load(tmp_path / "m", env=vec(), device="cpu")
    assert not differing(state(model), state(loaded))
    if cls not in (QMAPPO, RewoundPPO):
        assert loaded.transitions.size == (32 if trained else 0)
        assert any(name.startswith("dynamics.optimizer/state") for name in state(loaded)) == trained
    for deterministic in (True, False):
        torch.manual_seed(3)
        ours, _ = model.predict(OBSERVATIONS, deterministic=deterministic)
        torch.manual_seed(3)
        np.testing.assert_array_equal(loaded.predict(OBSERVATIONS, deterministic=deterministic)[0], ours)


@pytest.mark.parametrize("cls", EVERY)
def test_loaded_model_trains_on_identically(cls: Any, tmp_path: Path) -> None:
    model = tiny(cls).learn(32)
    model.save(tmp_path / "m")
    loaded = cls.load(tmp_path / "m", env=vec(), device="cpu")
    for agent in (model, loaded):
        agent.set_env(vec())
        agent.set_random_seed(11)
        agent.learn(32, reset_num_timesteps=False)
    assert model._n_updates == loaded._n_updates
    assert not differing(state(model), state(loaded))


@pytest.mark.parametrize("cls", EVERY)
@pytest.mark.parametrize("discrete", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_seed_fixes_everything(cls: Any, discrete: bool) -> None:
    def trained(seed: int) -> Any:
        space = spaces.Discrete(3) if discrete else None
        return tiny(cls, VecNormalize(vec(2, action_space=space)), seed=seed).learn(96)

    first = state(trained(1))
    assert not differing(first, state(trained(1)))
    assert differing(first, state(trained(2)))


def test_load_without_environment_and_with_more_of_them(tmp_path: Path) -> None:
    model = tiny(predict_termination=False).learn(16)
    model.save(tmp_path / "m")
    loaded = MBMAPPO.load(tmp_path / "m")
    assert loaded.get_env() is None and loaded.predict_termination is False
    loaded.set_env(vec())
    loaded.learn(16)
    more = MBMAPPO.load(tmp_path / "m", env=vec(3))
    more.learn(48)
    assert more.transitions.size == 64


def test_the_models_choice_of_termination_is_saved(tmp_path: Path) -> None:
    pytest.importorskip("dm_control")
    tiny(env="dmc/pendulum-swingup-v0").save(tmp_path / "m")
    assert MBMAPPO.load(tmp_path / "m").predict_termination is False


def test_the_file_holds_arguments_and_tensors(tmp_path: Path) -> None:
    tiny().learn(16).save(tmp_path / "m.zip")
    tree, tensors = container.read(tmp_path / "m.zip", "model")
    attributes = tree["attributes"]
    assert {"dynamics", "dynamics.optimizer", "transitions"} <= tree["parameters"].keys()
    assert not {"dynamics", "transitions", "flat_observations", "model_actions"} & attributes.keys()
    assert attributes["policy_kwargs"] == {"dict": {"net_arch": [8]}}
    assert len(tensors["transitions.rewards"]) == 16


def test_load_with_other_arguments(tmp_path: Path) -> None:
    model = tiny().learn(48)
    model.save(tmp_path / "m")
    loaded = MBMAPPO.load(
        tmp_path / "m", env=vec(), n_simulated=5, simulation_horizon=2, dynamics_buffer_size=20, gamma=0.5,
        dynamics_kwargs={"width": 8, "depth": 1, "learning_rate": 0.01},
    )  # fmt: skip
    assert loaded.transitions.size == 20
    np.testing.assert_array_equal(loaded.transitions.recent(20).rewards, model.transitions.recent(20).rewards)
    assert loaded.dynamics.optimizer.param_groups[0]["lr"] == 0.01
    loaded.learn(16)
    assert loaded.simulate(torch.zeros(2, 3)).actions.shape == (2, 5, 2)


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"n_simulatd": 3}, "n_simulatd: not an argument of MBMAPPO, so load cannot change it"),
        ({"dynamics_kwargs": {"width": 16}}, "dynamics_kwargs: with these arguments the model has other networks"),
        ({"predict_termination": False}, "predict_termination: with these arguments the model has other networks"),
        ({"n_simulated": 0}, "n_simulated: with these arguments the model has other networks"),
        ({"n_simulated": -1}, "n_simulated must be an integer of at least 0, not -1"),
    ],
)
def test_load_refuses(kwargs: dict[str, Any], words: str, tmp_path: Path) -> None:
    tiny().learn(16).save(tmp_path / "m")
    with pytest.raises(ValueError, match=words):
        MBMAPPO.load(tmp_path / "m", env=vec(), **kwargs)


def test_plain_ppo_of_a_file_with_models(tmp_path: Path) -> None:
    MBMAPPO("MlpPolicy", vec(), policy_kwargs={"net_arch": [8]}, device="cpu").save(tmp_path / "m")
    with pytest.raises(ValueError, match="n_simulated: with these arguments the model has other networks or parts"):
        MBMAPPO.load(tmp_path / "m", env=vec(), n_simulated=0)
    with pytest.raises(ValueError, match="dynamics_buffer_size=5 means nothing with n_simulated=0"):
        MBMAPPO.load(tmp_path / "m", env=vec(), n_simulated=0, dynamics_buffer_size=5)


def test_set_parameters_keeps_the_optimizers_settings() -> None:
    trained, fresh = tiny().learn(16), tiny(dynamics_kwargs={"width": 8, "depth": 1, "learning_rate": 0.5})
    fresh.set_parameters(trained.get_parameters())
    assert not differing(
        {k: v for k, v in state(trained).items() if not k.endswith("/lr")},
        {k: v for k, v in state(fresh).items() if not k.endswith("/lr")},
    )
    assert fresh.dynamics.optimizer.param_groups[0]["lr"] == 0.5


def test_vec_normalize_round_trip(tmp_path: Path) -> None:
    env = VecNormalize(vec(2))
    model = tiny(env=env).learn(32)
    model.save(tmp_path / "m")
    save_vec_normalize(env, tmp_path / "v")
    loaded = MBMAPPO.load(tmp_path / "m", env=load_vec_normalize(tmp_path / "v", vec(2)))
    loaded.learn(32)
    assert loaded.transitions.size == 64
