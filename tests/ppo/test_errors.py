"""Arguments that are refused, and the defaults."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize
from torch import nn

from sb3_sample import MBMAPPO, MBPOPPO, QMAPPO
from tests.ppo.common import ALGORITHMS, EVERY, arguments_of, quiet, tiny
from tests.sac.common import WRONG_ARGUMENTS, WRONG_ARGUMENTS_OF_LEARN, Toy, vec


class OwnBuffer(RolloutBuffer):
    def get(self, batch_size: Any = None) -> Any:
        yield from super().get(batch_size)


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"n_simulated": 2.0}, "n_simulated must be an integer of at least 0, not 2.0"),
        ({"n_simulated": True}, "n_simulated must be an integer of at least 0, not True"),
        ({"anneal_until": 0.0}, r"anneal_until must lie in \(0, 1\], a share of the training, or be None, not 0.0"),
        ({"anneal_until": "15%"}, "anneal_until must lie in"),
        ({"anneal_until": 1.5}, "anneal_until must lie in"),
        ({"warm_up_until": 1.1}, r"warm_up_until must lie in \[0, 1\], a share of the training, or be None, not 1.1"),
        ({"warm_up_until": 0.2, "anneal_until": 0.15}, "warm_up_until must be below anneal_until=0.15, not 0.2"),
        ({"simulation_horizon": 0}, "simulation_horizon must be an integer of at least 1, not 0"),
        ({"dynamics_buffer_size": 0}, "dynamics_buffer_size must be an integer of at least 1, not 0"),
        ({"dynamics_batch_size": 1.5}, "dynamics_batch_size must be an integer of at least 1, not 1.5"),
        ({"dynamics_kwargs": {"hidden": 8}}, r"dynamics_kwargs has 'hidden', but takes \['width', 'depth'"),
        ({"dynamics_kwargs": "abc"}, r"dynamics_kwargs must be a dict with some of \['width', .*, or None, not 'abc'"),
        ({"dynamics_kwargs": []}, r"dynamics_kwargs must be a dict .* not \[\]"),
        ({"dynamics_kwargs": {"width": 0}}, r"dynamics_kwargs\['width'\] must be an integer of at least 1, not 0"),
        (
            {"dynamics_kwargs": {"epochs": 0}},
            r"dynamics_kwargs\['epochs'\] must be an integer of at least 1, or None, not",
        ),
        ({"dynamics_kwargs": {"learning_rate": -1}}, r"dynamics_kwargs\['learning_rate'\] must be at least 0"),
        ({"dynamics_kwargs": {"normalize": 1}}, r"dynamics_kwargs\['normalize'\] must be True or False, not 1"),
        ({"predict_termination": "auto"}, "predict_termination must be True, False or None, not 'auto'"),
        ({"predict_termination": 1}, "predict_termination must be True, False or None, not 1"),
        ({"use_sde": True}, "use_sde=True draws one noise for all actions"),
        ({"rollout_buffer_class": OwnBuffer}, "rollout_buffer_class=OwnBuffer draws its minibatches itself"),
    ],
)
def test_what_is_refused(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        tiny(**kwargs)


@pytest.mark.parametrize("n_simulated", [0, 3])
@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"n_steps": 0}, "n_steps must be an integer of at least 1, not 0"),
        ({"n_steps": 1.5}, "n_steps must be an integer of at least 1, not 1.5"),
        ({"batch_size": 0}, "batch_size must be an integer of at least 1, not 0"),
        ({"batch_size": -1}, "batch_size must be an integer of at least 1, not -1"),
        ({"batch_size": 1, "normalize_advantage": True}, "batch_size must be at least 2 with normalize_advantage=True"),
        ({"n_epochs": 0}, "n_epochs must be an integer of at least 1, not 0"),
        ({"normalize_advantage": "yes"}, "normalize_advantage must be True or False, not 'yes'"),
        ({"learning_rate": -1}, "learning_rate must be at least 0 and finite, or a schedule, not -1"),
        ({"learning_rate": "fast"}, "learning_rate must be .* not 'fast'"),
        ({"gamma": 2}, r"gamma must lie in \[0, 1\], not 2"),
        ({"gae_lambda": -1}, r"gae_lambda must lie in \[0, 1\], not -1"),
        ({"gae_lambda": float("nan")}, r"gae_lambda must lie in \[0, 1\], not nan"),
        ({"clip_range": -1}, "clip_range must be above 0 and finite, or a schedule, not -1"),
        ({"clip_range": None}, "clip_range must be above 0 and finite, or a schedule, not None"),
        ({"clip_range": lambda progress: -1}, "clip_range, .*, at the begin must be at least 0 and finite, not -1.0"),
        ({"clip_range_vf": lambda: 0.2}, "clip_range_vf must be a function of the remaining progress, from 1 to 0"),
        ({"clip_range_vf": 0.0}, "clip_range_vf must be above 0 and finite, or a schedule, or None, not 0.0"),
        ({"ent_coef": "a"}, "ent_coef must be a finite number, not 'a'"),
        ({"vf_coef": -1}, "vf_coef must be at least 0 and finite, not -1"),
        ({"max_grad_norm": None}, r"max_grad_norm must be above 0 \(float\('inf'\) for no limit\), not None"),
        ({"target_kl": -1}, "target_kl must be above 0, or None for no limit, not -1"),
    ],
)
def test_ppos_own_arguments_out_of_range(n_simulated: int, kwargs: dict[str, Any], words: str) -> None:
    arguments = {"n_steps": 16, "batch_size": 8, "n_simulated": n_simulated, "device": "cpu", **kwargs}
    with pytest.raises(ValueError, match=words):
        MBMAPPO("MlpPolicy", vec(), **arguments)


@pytest.mark.parametrize("n_simulated", [0, 3])
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        *WRONG_ARGUMENTS,
        ("clip_range", "0.2", "clip_range must be above 0 and finite, or a schedule, not '0.2'"),
        ("rollout_buffer_class", dict, "rollout_buffer_class must be RolloutBuffer or derived from it, or None, not <"),
        ("rollout_buffer_class", DictRolloutBuffer, r"rollout_buffer_class=DictRolloutBuffer needs a Dict .* not Box"),
        ("rollout_buffer_kwargs", [1], r"rollout_buffer_kwargs must be a dict, or None, not \[1\]"),
        ("sde_sample_freq", -2, "sde_sample_freq must be an integer of at least -1, not -2"),
        ("policy_kwargs", {"net_arch": {"pi": [8], "qf": [8]}}, "net_arch must be .*'vf' for the critic, not .*'qf'"),
    ],
)
def test_arguments_of_another_kind(n_simulated: int, name: str, value: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        tiny(n_simulated=n_simulated, **{name: value})


@pytest.mark.parametrize(("kwargs", "words"), WRONG_ARGUMENTS_OF_LEARN)
def test_arguments_of_learn(kwargs: dict[str, Any], words: str) -> None:
    model = tiny()
    with pytest.raises(ValueError, match=words):
        model.learn(**{"total_timesteps": 10, **kwargs})
    assert model.num_timesteps == 0


def test_another_number_of_environments() -> None:
    model = tiny(env=vec(2))
    with pytest.raises(ValueError, match=r"env has 3 environments, .* made with, 2: use MBMAPPO.load"):
        model.set_env(vec(3))
    model.set_env(vec(2))


def test_networks_that_stable_baselines3_takes() -> None:
    for net_arch in ({"pi": [8]}, {}, [], {"pi": (8,), "vf": [np.int64(8)]}):
        tiny(policy_kwargs={"net_arch": net_arch})
    with pytest.warns(UserWarning, match="shared layers"):
        tiny(policy_kwargs={"net_arch": [{"pi": [8], "vf": [8]}]})


def test_numbers_of_numpy_and_schedules_will_do() -> None:
    model = tiny(
        n_steps=np.int64(8),
        n_simulated=np.int32(2),
        warm_up_until=np.float32(0.0),
        anneal_until=1,
        gamma=np.float32(0.9),
        clip_range=lambda left: 0.2 * left,
        clip_range_vf=np.float64(0.2),
        learning_rate=np.float32(1e-3),
        seed=np.int64(1),
        max_grad_norm=float("inf"),
        ent_coef=-0.01,
        dynamics_kwargs={"width": np.int64(8), "depth": 1, "learning_rate": np.float32(1e-3)},
    )
    model.learn(16)
    assert model.num_timesteps == 16
    assert tiny(warm_up_until=1.0).learn(32).num_timesteps == 32


@pytest.mark.parametrize(
    ("cls", "argument"),
    [
        *((cls, {"anneal_until": 0.5}) for cls in EVERY),
        *((cls, {"warm_up_until": 0.5}) for cls in EVERY),
        (MBMAPPO, {"simulation_horizon": 5}),
        (MBMAPPO, {"dynamics_buffer_size": 5}),
        (MBPOPPO, {"dynamics_batch_size": 5}),
        (MBPOPPO, {"dynamics_kwargs": {"width": 5}}),
        (MBMAPPO, {"predict_termination": True}),
        (QMAPPO, {"q_kwargs": {"width": 5}}),
    ],
)
def test_without_simulated_samples_their_arguments_mean_nothing(cls: Any, argument: dict[str, Any]) -> None:
    name = next(iter(argument))
    with pytest.raises(ValueError, match=f"{name}=.* means nothing with {cls.plain}: leave it out, or at "):
        cls("MlpPolicy", vec(), **arguments_of(cls, {"n_simulated": 0}), **argument)


@pytest.mark.parametrize("name", ["simulation_horizon", "dynamics_buffer_size", "dynamics_kwargs"])
def test_qma_has_no_dynamics(name: str) -> None:
    with pytest.raises(TypeError, match=name):
        tiny(QMAPPO, **{name: 5})


def test_q_kwargs() -> None:
    with pytest.raises(ValueError, match="q_kwargs has 'horizon', but takes"):
        tiny(QMAPPO, q_kwargs={"horizon": 8})


def test_mbpo_needs_a_return_for_its_states() -> None:
    with pytest.raises(ValueError, match="simulation_horizon must be at least 2, so that .* not 1"):
        tiny(MBPOPPO, n_simulated=1, simulation_horizon=1)
    tiny(MBPOPPO, n_simulated=4, simulation_horizon=2)


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(0, 255, (36, 36, 3), np.uint8),
        spaces.Discrete(4),
        spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Discrete(4)}),
    ],
)
def test_observations_that_cannot_be_predicted(cls: Any, space: spaces.Space) -> None:
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy"
    with pytest.raises(ValueError, match="the observation space must be a Box of floats .* pass n_simulated=0"):
        tiny(cls, vec(obs_space=space), policy)


@pytest.mark.parametrize("space", [spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3)])
def test_actions_that_are_neither_drawn_nor_enumerated(space: spaces.Space) -> None:
    for cls in ALGORITHMS:
        with pytest.raises(ValueError, match="the action space must be a Box or Discrete, .* pass n_simulated=0"):
            tiny(cls, vec(action_space=space))


@pytest.mark.parametrize("cls", [MBMAPPO, MBPOPPO])
def test_observations_that_change_after_they_are_normalised(cls: Any) -> None:
    with pytest.raises(ValueError, match="VecNormalize must be around the wrappers that change observations"):
        tiny(cls, VecFrameStack(VecNormalize(vec(2)), 3))
    cls("MlpPolicy", VecFrameStack(VecNormalize(vec(2)), 3), n_simulated=0, device="cpu")
    model = tiny(cls, VecNormalize(VecFrameStack(vec(2), 3)))
    with pytest.raises(ValueError, match="VecNormalize must be around the wrappers that change observations"):
        model.set_env(VecFrameStack(VecNormalize(vec(2)), 3))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.set_env(VecNormalize(VecFrameStack(vec(2), 2)))
    assert model.learn(16).transitions.size == 32


def test_simulating_with_nothing_to_simulate_with() -> None:
    model = MBMAPPO("MlpPolicy", vec(), n_simulated=0, device="cpu")
    with pytest.raises(ValueError, match="n_simulated=0: this model has nothing to simulate with"):
        model.simulate(None)
    with pytest.raises(ValueError, match="n_simulated=0: this model has nothing to simulate with"):
        model.current_rollout()
    with pytest.raises(ValueError, match="n_simulated=0: this model has nothing to simulate with"):
        model.fit_models()
    model = tiny()
    with pytest.raises(ValueError, match="n_simulated must be an integer of at least 1, not 0"):
        model.simulate(None, n_simulated=0)
    with pytest.raises(ValueError, match="n_simulated must be passed, as the current iteration has no simulated"):
        tiny(warm_up_until=0.5).simulate(None)


def test_actions_of_a_discrete_space_take_no_noise() -> None:
    model = tiny(MBMAPPO, vec(action_space=spaces.Discrete(2)), warm_up_until=0).learn(16)
    rollout = model.current_rollout()
    with pytest.raises(ValueError, match="noise is that of Gaussian actions, which a Discrete space has not"):
        model.simulate(rollout.observations, noise=torch.zeros(3, 16, 2, 1))


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_there_is_no_rollout_before_learning_and_after_loading(cls: Any, tmp_path: Path) -> None:
    model = tiny(cls)
    model.learn(16).save(tmp_path / "m")
    for without in (tiny(cls), cls.load(tmp_path / "m", env=vec())):
        for call in (without.current_rollout, without.fit_models):
            with pytest.raises(ValueError, match="there is no rollout: call this after learn, or in a callback's"):
                call()
    assert len(model.current_rollout().values) == 16


def test_a_training_of_one_iteration_simulates_nothing_and_says_so() -> None:
    with pytest.warns(UserWarning, match=r"16 steps are a single iteration \(n_steps=16 times 1 env.* warm_up_until=0"):
        model = quiet(tiny(warm_up_until=None)).learn(16)
    assert model.logger.name_to_value["simulation/n_simulated"] == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tiny(warm_up_until=None).learn(17)
        tiny(warm_up_until=0).learn(16)
        tiny(anneal_until=0.5, warm_up_until=None).learn(16)
        MBMAPPO("MlpPolicy", vec(), n_steps=16, batch_size=8, n_simulated=0, device="cpu").learn(16)


# ---------------------------------------------------------------- defaults


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_the_defaults_are_the_papers(cls: Any) -> None:
    model = cls("MlpPolicy", Toy(), device="cpu")
    assert (model.n_steps, model.batch_size, model.n_epochs) == (2048, 64, 10)
    assert (model.gamma, model.gae_lambda, model.max_grad_norm, model.vf_coef) == (0.99, 0.95, 0.5, 0.5)
    assert model.clip_range(1) == 0.2 and model.clip_range_vf is None and model.ent_coef == 0
    assert model.normalize_advantage is False
    assert (model.n_simulated, model.anneal_until, model.warm_up_until) == (8, None, None)
    group = model.policy.optimizer.param_groups[0]
    assert (group["lr"], group["eps"]) == (3e-4, 1e-5)
    widths = {
        part: [layer.out_features for layer in net if isinstance(layer, nn.Linear)]
        for part, net in (("pi", model.policy.mlp_extractor.policy_net), ("vf", model.policy.mlp_extractor.value_net))
    }
    assert widths == {"pi": [512, 512], "vf": [1024, 1024]}
    if cls is QMAPPO:
        assert model.q_networks.networks[0].layers[2].weight.shape == (2, 1024, 1024)
    else:
        assert (model.simulation_horizon, model.dynamics_buffer_size, model.dynamics_batch_size) == (12, 25_000, 128)
        assert model.dynamics.normalize is True
        assert model.dynamics.transition[0].layers[2].weight.shape == (1024, 1024)


def test_a_policy_of_ones_own_keeps_its_networks() -> None:
    class Own(ActorCriticPolicy):
        pass

    model = tiny(policy=Own, policy_kwargs={})
    assert model.policy.net_arch == dict(pi=[64, 64], vf=[64, 64])


def test_positional_arguments_are_ppos() -> None:
    model = MBMAPPO("MlpPolicy", vec(), 1e-3, 32, 16, 3, 0.9, device="cpu")
    assert (model.learning_rate, model.n_steps, model.batch_size, model.n_epochs, model.gamma) == (1e-3, 32, 16, 3, 0.9)
