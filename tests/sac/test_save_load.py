"""Saving, loading, parameters, and seeds: everything bit for bit."""

import copy
import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import SAC as PlainSAC
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_sample import BRO, CompactReplayBuffer, SimBa
from sb3_sample.sac import SAC, BROFast
from sb3_sample.sac.policies import SACPolicy
from sb3_sample.saving import BadFile, container
from tests.agents import OFF_POLICY, env_of, seen_by
from tests.sac.common import MAKERS, REPRESENTATIVE, Toy, bro, differing, sac, sampled, state, vec

OBSERVATIONS = np.random.default_rng(0).normal(size=(16, 3)).astype(np.float32)


def resetting(maker: str, *steps: int) -> dict[str, Any]:
    """Arguments that have the networks reset at some of the first steps; SR-SPR's resets are apart by an interval."""
    return {"reset_interval": 12} if maker == "SRSPR" else {"resets": steps}


def n_resets(model: Any) -> int:
    return int(model.n_resets if hasattr(model, "n_resets") else model.plasticity.n_done)


def continue_training(maker: str, model: Any, n: int = 25) -> Any:
    """Train on from a fresh environment and a fixed seed."""
    model.set_env(env_of(maker))
    model.set_random_seed(11)
    return model.learn(n, reset_num_timesteps=False)


@pytest.mark.parametrize("maker", OFF_POLICY)
@pytest.mark.parametrize("trained", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_save_load_gives_the_same_model(maker: str, trained: bool, tmp_path: Path) -> None:
    model = OFF_POLICY[maker](**resetting(maker, 18))
    if trained:
        model.learn(30)
    path = tmp_path / "model.zip"
    model.save(path)
    loaded = type(model).load(path, env=env_of(maker), device="cpu")
    assert type(loaded) is type(model)
    assert not differing(state(model), state(loaded))
    for deterministic in (True, False):
        torch.manual_seed(3)
        np.random.seed(3)
        ours, _ = model.predict(seen_by(model), deterministic=deterministic)
        torch.manual_seed(3)
        np.random.seed(3)
        np.testing.assert_array_equal(loaded.predict(seen_by(model), deterministic=deterministic)[0], ours)


@pytest.mark.parametrize("maker", sampled(OFF_POLICY, ("BRO", "VPLSAC", "TOPSAC", "DebiasedRQ")))
def test_loaded_model_trains_on_identically(maker: str, tmp_path: Path) -> None:
    interval = {} if maker in ("SRSPR", "CrossQ") else {"target_update_interval": 2}
    model = OFF_POLICY[maker](**resetting(maker, 18, 50), replay_ratio=1.5, **interval).learn(30)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = type(model).load(tmp_path / "m", env=env_of(maker), device="cpu")
    loaded.load_replay_buffer(tmp_path / "b")
    continue_training(maker, model)
    continue_training(maker, loaded)
    assert model._n_updates == loaded._n_updates and model.num_transitions == loaded.num_transitions == 55
    assert n_resets(model) == n_resets(loaded) == 2
    assert not differing(state(model), state(loaded))
    np.testing.assert_array_equal(model.replay_buffer.actions, loaded.replay_buffer.actions)


@pytest.mark.parametrize("maker", REPRESENTATIVE)
def test_through_memory_and_a_second_time(maker: str) -> None:
    model = MAKERS[maker]().learn(20)
    for _ in range(2):
        file = io.BytesIO()
        model.save(file)
        file.seek(0)
        loaded = type(model).load(file, env=vec())
        assert not differing(state(model), state(loaded))
        model = loaded


@pytest.mark.parametrize("kwargs", [{}, {"ent_coef": 0.2}, {"target_entropy": -3.0}])
def test_another_actor_than_the_files_is_what_is_refused(kwargs: dict[str, Any], tmp_path: Path) -> None:
    """And not the entropy in the file, which no argument of ``load`` could leave out."""
    sac(**kwargs).save(tmp_path / "model")
    with pytest.raises(ValueError, match="^backbone: with these arguments the model has other networks"):
        SAC.load(tmp_path / "model", backbone="td3")


def test_a_deterministic_actors_file_may_be_told_so(tmp_path: Path) -> None:
    """In a class whose own default weighs an entropy, which such an actor has not."""
    MAKERS["SimBa"](backbone="td3").save(tmp_path / "model")
    assert SimBa.load(tmp_path / "model", backbone="td3").backbone == "td3"


@pytest.mark.parametrize(
    ("made", "given", "left"),
    [
        (
            {"learning_rate_schedule": "cosine", "final_learning_rate": 1e-5, "schedule_steps": 90, "warm_up_steps": 9},
            {"learning_rate_schedule": None},
            {"final_learning_rate": 0.0, "schedule_steps": None, "warm_up_steps": 0},
        ),
        ({"redo_period": 50, "redo_threshold": 0.1}, {"redo_period": None}, {"redo_threshold": 0.025}),
        (
            {"redo_period": 50, "redo_threshold": 0.1},
            {"redo_period": None, "reset_gradient_steps": 50},
            {"redo_threshold": 0.025},
        ),
        ({"resets": [100], "reset_shrink": 0.5}, {"resets": ()}, {"reset_shrink": 0.0}),
        ({"resets": [100], "reset_shrink": 0.5}, {"resets": (), "reset_gradient_steps": 50}, {"reset_shrink": 0.5}),
    ],
)
def test_what_goes_with_an_argument_goes_with_it(
    made: dict[str, Any], given: dict[str, Any], left: dict[str, Any], tmp_path: Path
) -> None:
    sac(**made).save(tmp_path / "model")
    loaded: Any = SAC.load(tmp_path / "model", **given)
    assert {name: getattr(loaded, name) for name in left} == left
    loaded.save(tmp_path / "again")
    SAC.load(tmp_path / "again")


@pytest.mark.parametrize("maker", sampled(OFF_POLICY))
def test_load_without_environment(maker: str, tmp_path: Path) -> None:
    model = OFF_POLICY[maker]().learn(20)
    model.save(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m")
    assert loaded.get_env() is None
    np.testing.assert_array_equal(
        loaded.predict(seen_by(model), deterministic=True)[0], model.predict(seen_by(model), deterministic=True)[0]
    )
    loaded.set_env(env_of(maker))
    loaded.learn(15)


def test_the_file_holds_arguments_and_tensors(tmp_path: Path) -> None:
    """Networks and parts are named tensors, and what follows from the arguments is not there."""
    model = bro(resets=(15,)).learn(20)
    model.save(tmp_path / "m.zip")
    tree, tensors = container.read(tmp_path / "m.zip", "model")
    modules = {"policy", "actor", "critic", "critic_target", "temperature", "explorer", "pessimism_rule", "plasticity"}
    assert not modules & tree["attributes"].keys()
    assert {"num_transitions", "_updates_owed", "replay_ratio", "resets", "ent_coef", "n_quantiles", "target_entropy",
            "target_update_interval", "exploration_kwargs"} <= tree["attributes"].keys()  # fmt: skip
    assert tree["attributes"]["replay_ratio"] == 1
    for name, tensor in model.policy.state_dict().items():
        assert torch.equal(tensors[f"policy.{name}"], tensor)


def test_load_with_more_environments(tmp_path: Path) -> None:
    bro(replay_ratio=1).learn(20).save(tmp_path / "m")
    loaded = BRO.load(tmp_path / "m", env=vec(3))
    assert loaded.n_envs == 3
    before = loaded._n_updates
    loaded.learn(60)
    assert loaded.num_transitions == 80
    assert 0 < loaded._n_updates - before <= 60


def test_load_checks_the_spaces(tmp_path: Path) -> None:
    bro().save(tmp_path / "m")
    with pytest.raises(ValueError, match=r"[Ss]paces do not match"):
        BRO.load(tmp_path / "m", env=vec(action_space=spaces.Box(-1, 1, (3,))))


def test_brofast_round_trip(tmp_path: Path) -> None:
    model = bro(cls=BROFast)
    assert model.replay_ratio == 1 and model.resets == (15_000,)
    model.save(tmp_path / "m")
    loaded = BROFast.load(tmp_path / "m", env=vec())
    assert isinstance(loaded, BROFast)
    assert loaded.replay_ratio == 1 and tuple(loaded.plasticity.steps) == (15_000,)
    loaded.learn(20)
    assert BROFast.load(tmp_path / "m", env=vec(), replay_ratio=0.5).replay_ratio == 0.5


@pytest.mark.parametrize("name", ["learning_rate", "gamma", "tau", "batch_size", "learning_starts"])
def test_overrides_at_loading(name: str, tmp_path: Path) -> None:
    value = {"learning_rate": 1e-3, "gamma": 0.5, "tau": 0.5, "batch_size": 3, "learning_starts": 3}[name]
    sac().learn(12).save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=vec(), **{name: value})
    assert getattr(loaded, name) == value
    loaded.learn(15)
    if name == "learning_rate":
        assert {group["lr"] for group in loaded.critic.optimizer.param_groups} == {1e-3}


def test_a_part_given_at_loading_is_taken_or_refused(tmp_path: Path) -> None:
    """Never dropped without a word."""
    bro().save(tmp_path / "m")
    assert BRO.load(tmp_path / "m", env=vec(), pessimism=0.25).pessimism_rule.beta() == 0.25
    assert BRO.load(tmp_path / "m", env=vec(), kl_target=0.3).explorer.kl_target == 0.3
    with pytest.raises(ValueError, match="exploration, exploration_kwargs: with these arguments"):
        BRO.load(tmp_path / "m", env=vec(), exploration="actor", exploration_kwargs=None)
    with pytest.raises(ValueError, match="exploration_kwargs has 'network_kwargs', but exploration='actor' takes none"):
        BRO.load(tmp_path / "m", env=vec(), exploration="actor")
    sac(value_head="categorical", value_head_kwargs={"v_min": -5.0}).save(tmp_path / "m")
    # A class without an __init__ of its own.
    with pytest.raises(ValueError, match="value_head_kwargs has 'v_min', but value_head='half_squared' takes none"):
        SAC.load(tmp_path / "m", env=vec(), value_head="half_squared")


def test_n_step_returns_are_those_of_the_arguments(tmp_path: Path) -> None:
    """Of the caller's at loading, in files too that have them among the buffer's arguments; and nothing is ignored."""
    given: dict[str, Any] = {}
    model = sac(n_steps=5, gamma=0.9, replay_buffer_kwargs=given)
    assert given == model.replay_buffer_kwargs == {}
    model.save(tmp_path / "m")
    model.replay_buffer_kwargs = {"n_steps": 5, "gamma": 0.9}
    model.save(tmp_path / "before")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in "m", "before":
            for kwargs in ({}, {"n_steps": 2}, {"gamma": 0.5}, {"n_steps": 2, "gamma": 0.5}):
                loaded: Any = SAC.load(tmp_path / name, env=vec(), **kwargs)
                buffer = loaded.replay_buffer
                assert type(buffer) is NStepReplayBuffer
                assert {"n_steps": 5, "gamma": 0.9} | kwargs == {"n_steps": buffer.n_steps, "gamma": buffer.gamma}
            assert type(SAC.load(tmp_path / name, env=vec(), n_steps=1).replay_buffer) is CompactReplayBuffer
        sac().save(tmp_path / "one")
        assert SAC.load(tmp_path / "one", env=vec(), n_steps=3).replay_buffer.n_steps == 3  # type: ignore[union-attr]


def test_bad_override_at_loading(tmp_path: Path) -> None:
    sac().save(tmp_path / "m")
    with pytest.raises(ValueError, match="replay_ratio.*-1"):
        SAC.load(tmp_path / "m", env=vec(), replay_ratio=-1)
    with pytest.raises(ValueError, match="replay_rato: not an argument of SAC"):
        SAC.load(tmp_path / "m", replay_rato=3)
    with pytest.raises(ValueError, match="n_quantiles: with these arguments the model has other networks"):
        SAC.load(tmp_path / "m", n_quantiles=7)


# ---------------------------------------------------------------- parameters


@pytest.mark.parametrize("maker", sampled(OFF_POLICY))
def test_get_and_set_parameters(maker: str) -> None:
    model, other = OFF_POLICY[maker](seed=0).learn(20), OFF_POLICY[maker](seed=1)
    assert differing(state(model), state(other))
    other.set_parameters(model.get_parameters())
    assert not differing(state(model), state(other))
    np.testing.assert_array_equal(
        model.predict(seen_by(model), deterministic=True)[0], other.predict(seen_by(model), deterministic=True)[0]
    )


def test_set_parameters_from_a_file(tmp_path: Path) -> None:
    model, other = bro(seed=0).learn(20), bro(seed=1)
    model.save(tmp_path / "m")
    other.set_parameters(str(tmp_path / "m"))
    assert not differing(state(model), state(other))


@pytest.mark.parametrize("maker", OFF_POLICY)
def test_exact_match(maker: str) -> None:
    model = OFF_POLICY[maker]()
    parameters = model.get_parameters()
    with pytest.raises(ValueError, match="foo"):
        model.set_parameters({**parameters, "foo": {}}, exact_match=True)
    missing = dict(parameters)
    missing.pop("policy")
    with pytest.raises(ValueError, match="policy"):
        model.set_parameters(missing, exact_match=True)
    model.set_parameters(missing, exact_match=False)
    wrong = dict(parameters["policy"])
    wrong.pop(next(iter(wrong)))
    with pytest.raises(RuntimeError, match="Missing key"):
        model.set_parameters({**parameters, "policy": wrong}, exact_match=True)


def test_every_learned_tensor_is_in_the_parameters() -> None:
    """Two models with equal parameters (and seeds, and data) train on equally: nothing learned is left out."""
    model, other = bro(seed=0).learn(30), bro(seed=5).learn(30)
    # A copy, because torch's optimizers keep the very tensors that they load.
    other.set_parameters(copy.deepcopy(model.get_parameters()))
    other.replay_buffer = model.replay_buffer
    for m in (model, other):
        torch.manual_seed(0)
        np.random.seed(0)
        m.train(5, 8)
    assert not differing(state(model), state(other))


@pytest.mark.parametrize("maker", sampled(OFF_POLICY))
def test_policy_save_load(maker: str, tmp_path: Path) -> None:
    model = OFF_POLICY[maker]().learn(20)
    policy = model.policy
    policy.save(tmp_path / "p")
    loaded = (type(policy) if maker in ("DebiasedRQ", "DrQv2", "SRSPR") else SACPolicy).load(tmp_path / "p")
    for (name, a), b in zip(policy.state_dict().items(), loaded.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    np.testing.assert_array_equal(
        policy.predict(seen_by(model), deterministic=True)[0], loaded.predict(seen_by(model), deterministic=True)[0]
    )


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        dict(net_arch=[7, 5]),
        dict(net_arch=dict(pi=[4], qf=[6, 6]), activation_fn=nn.Tanh, n_critics=3),
        dict(critic_network="bronet", critic_network_kwargs=dict(width=8, n_blocks=1)),
        dict(optimizer_class=torch.optim.Adam, optimizer_kwargs=dict(betas=(0.5, 0.9))),
    ],
)
def test_custom_policy_kwargs(policy_kwargs: dict[str, Any], tmp_path: Path) -> None:
    model = sac(policy_kwargs=policy_kwargs).learn(20)
    model.save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=vec())
    assert not differing(state(model), state(loaded))
    loaded.learn(20)


@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_policy_kwargs_repeated_at_loading(maker: str, tmp_path: Path) -> None:
    """Stable-Baselines3 lets a user repeat the arguments given at construction, and refuses others."""
    given: dict[str, Any] = {"n_critics": 3}
    model = MAKERS[maker](policy_kwargs=dict(given))
    model.save(tmp_path / "m")
    with pytest.raises(ValueError, match="policy"):
        type(model).load(tmp_path / "m", env=vec(), policy_kwargs={"n_critics": 4})
    loaded = type(model).load(tmp_path / "m", env=vec(), policy_kwargs=dict(given))
    assert not differing(state(model), state(loaded))


def test_the_callers_arguments_are_left_alone() -> None:
    policy_kwargs: dict[str, Any] = {"actor_network_kwargs": {"width": 8, "n_blocks": 1}}
    exploration_kwargs: dict[str, Any] = {"network_kwargs": {"width": 8, "n_blocks": 1}}
    for _ in range(2):
        bro(policy_kwargs=policy_kwargs, exploration_kwargs=exploration_kwargs)
    assert policy_kwargs == {"actor_network_kwargs": {"width": 8, "n_blocks": 1}}
    assert exploration_kwargs == {"network_kwargs": {"width": 8, "n_blocks": 1}}


def test_replay_buffer(tmp_path: Path) -> None:
    model = sac().learn(30)
    model.save_replay_buffer(tmp_path / "b")
    other = sac(seed=1)
    other.load_replay_buffer(tmp_path / "b")
    assert other.replay_buffer.size() == 30
    for name in ("observations", "actions", "rewards", "dones"):
        np.testing.assert_array_equal(getattr(model.replay_buffer, name), getattr(other.replay_buffer, name))
    other.learn(20)


# ---------------------------------------------------------------- seeds


@pytest.mark.parametrize("n_envs", [pytest.param(1, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("maker", sampled(REPRESENTATIVE, ("SAC", "BRO", "VPLSAC", "RegularizedSAC")))
def test_seeds(maker: str, n_envs: int) -> None:
    first, same, different = (MAKERS[maker](vec(n_envs), seed=s, resets=(20,)).learn(36) for s in (4, 4, 5))
    assert not differing(state(first), state(same))
    np.testing.assert_array_equal(first.replay_buffer.actions, same.replay_buffer.actions)
    assert differing(state(first), state(different))
    assert not np.array_equal(first.replay_buffer.actions, different.replay_buffer.actions)


def test_logging_and_prediction_change_nothing() -> None:
    """The log, deterministic predictions and verbosity draw no random numbers."""
    quiet, loud = bro(seed=4).learn(36, log_interval=None), bro(seed=4, verbose=1)
    loud.predict(OBSERVATIONS, deterministic=True)
    loud.learn(36, log_interval=1)
    assert not differing(state(quiet), state(loud))


@pytest.mark.parametrize("as_file", [True, False])
def test_a_fixed_temperature_stays_the_models(as_file: bool, tmp_path: Path) -> None:
    """As in Stable-Baselines3, whose parameters do not include it."""
    theirs, model = sac(ent_coef=0.2), sac(ent_coef=0.5)
    theirs.save(tmp_path / "model")
    model.set_parameters(str(tmp_path / "model") if as_file else theirs.get_parameters())
    assert model.ent_coef == 0.5 and float(model.ent_coef_tensor) == 0.5
    assert float(SAC.load(tmp_path / "model").ent_coef_tensor) == pytest.approx(0.2)
    assert float(SAC.load(tmp_path / "model", ent_coef=0.7).ent_coef_tensor) == pytest.approx(0.7)


def test_a_fixed_temperature_that_was_set_goes_on(tmp_path: Path) -> None:
    kwargs = {"checkpoint": tmp_path, "checkpoint_freq": 10}
    model = sac(ent_coef=0.25)
    model.ent_coef_tensor = 0.125
    model.learn(20, **kwargs)
    assert float(sac(ent_coef=0.25).learn(30, **kwargs).ent_coef_tensor) == 0.125


def test_the_replay_ratio_replaces_stable_baselines3s_arguments(tmp_path: Path) -> None:
    sac(train_freq=64, gradient_steps=64).save(tmp_path / "model")
    loaded: Any = SAC.load(tmp_path / "model", env=vec(), replay_ratio=2)
    assert loaded.train_freq.frequency == 1 and loaded.gradient_steps == 1
    assert loaded.learn(20).num_timesteps == 20
    # The constructor's defaults mean the same here.
    defaults: dict[str, Any] = {"replay_buffer_kwargs": None, "train_freq": None, "gradient_steps": None}
    again: Any = SAC.load(tmp_path / "model", replay_ratio=2, **defaults)
    assert again.replay_ratio == 2 and again.train_freq.frequency == 1
    loaded.save(tmp_path / "other")
    kept: Any = SAC.load(tmp_path / "other", train_freq=3)
    assert kept.replay_ratio is None and kept.train_freq.frequency == 3


def test_gradient_steps_that_are_assigned_beside_a_replay_ratio() -> None:
    model = sac(replay_ratio=2)
    model.gradient_steps = 8
    with pytest.warns(UserWarning, match="gradient_steps=8 was assigned, and has no effect beside replay_ratio=2"):
        model.learn(20)
    model.replay_ratio = None
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="gradient_steps")
        assert model.learn(10)._n_updates == 2 * 10 + 8 * 10


def test_a_dict_of_stable_baselines3s_sac(tmp_path: Path) -> None:
    """It writes ``use_sde=False`` into the dict that it is given."""
    kwargs = {"net_arch": [8]}
    PlainSAC("MlpPolicy", vec(), policy_kwargs=kwargs, buffer_size=1)
    assert kwargs["use_sde"] is False
    assert "use_sde" not in sac(policy_kwargs=kwargs).policy_kwargs and "use_sde" in kwargs
    with pytest.raises(ValueError, match="policy_kwargs has 'use_sde'"):
        sac(policy_kwargs={"use_sde": True})


def test_a_model_with_hindsight_needs_its_environment(tmp_path: Path) -> None:
    space = spaces.Dict({key: spaces.Box(-10, 10, (3,)) for key in ("observation", "achieved_goal", "desired_goal")})
    env = DummyVecEnv([lambda: Goals(obs_space=space)])
    model = sac(env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="^env must be passed with replay_buffer_class=HerReplayBuffer") as error:
        SAC.load(tmp_path / "model")
    assert not isinstance(error.value, BadFile)
    alone = SAC.load(tmp_path / "model", replay_buffer_class=None, replay_buffer_kwargs=None)
    observation = space.sample()
    assert np.array_equal(*(each.predict(observation, deterministic=True)[0] for each in (model, alone)))


class Goals(Toy):
    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, infos: Any) -> np.ndarray:
        return np.zeros(len(achieved))
