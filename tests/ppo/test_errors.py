"""Arguments that are refused, and the defaults."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize
from torch import nn

from sb3_sample import MBMAPPO, MBPOPPO, QMAPPO
from tests.ppo.common import ALGORITHMS, tiny
from tests.sac.common import Toy, vec


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
        ({"warm_up_until": 1.0}, "warm_up_until must be at least 0 and below 1"),
        ({"warm_up_until": 0.2, "anneal_until": 0.15}, "warm_up_until must be below anneal_until=0.15, not 0.2"),
        ({"simulation_horizon": 0}, "simulation_horizon must be an integer of at least 1, not 0"),
        ({"dynamics_buffer_size": 0}, "dynamics_buffer_size must be an integer of at least 1, not 0"),
        ({"dynamics_batch_size": 1.5}, "dynamics_batch_size must be an integer of at least 1, not 1.5"),
        ({"dynamics_kwargs": {"hidden": 8}}, r"dynamics_kwargs has 'hidden', but takes \['width', 'depth'"),
        ({"dynamics_kwargs": {"width": 0}}, r"dynamics_kwargs\['width'\] must be an integer of at least 1, not 0"),
        ({"dynamics_kwargs": {"epochs": 0}}, r"dynamics_kwargs\['epochs'\] must be an integer of at least 1, not 0"),
        ({"dynamics_kwargs": {"learning_rate": -1}}, r"dynamics_kwargs\['learning_rate'\] must be at least 0"),
        ({"dynamics_kwargs": {"normalize": 1}}, r"dynamics_kwargs\['normalize'\] must be True or False, not 1"),
        ({"predict_termination": "auto"}, "predict_termination must be True, False or None, not 'auto'"),
        ({"use_sde": True}, "use_sde=True draws one noise for all actions"),
        ({"rollout_buffer_class": OwnBuffer}, "rollout_buffer_class=OwnBuffer draws its minibatches itself"),
    ],
)
def test_what_is_refused(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        tiny(**kwargs)


@pytest.mark.parametrize(
    ("cls", "argument"),
    [
        *((cls, {"anneal_until": 0.5}) for cls in ALGORITHMS),
        *((cls, {"warm_up_until": 0.5}) for cls in ALGORITHMS),
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
    with pytest.raises(ValueError, match=f"{name}=.* means nothing with n_simulated=0: leave it out"):
        cls("MlpPolicy", vec(), n_simulated=0, **argument)


@pytest.mark.parametrize("name", ["simulation_horizon", "dynamics_buffer_size", "dynamics_kwargs"])
def test_qma_has_no_dynamics(name: str) -> None:
    with pytest.raises(TypeError, match=name):
        tiny(QMAPPO, **{name: 5})


def test_q_kwargs() -> None:
    with pytest.raises(ValueError, match="q_kwargs has 'horizon', but takes"):
        tiny(QMAPPO, q_kwargs={"horizon": 8})


def test_mbpo_needs_a_return_for_its_last_state() -> None:
    with pytest.raises(ValueError, match="simulation_horizon must be above n_simulated=4, so that .* not 4"):
        tiny(MBPOPPO, n_simulated=4, simulation_horizon=4)
    tiny(MBPOPPO, n_simulated=4, simulation_horizon=5)


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
    assert tiny(cls, VecNormalize(VecFrameStack(vec(2), 3))).learn(16).transitions.size == 32


def test_simulating_with_nothing_to_simulate_with() -> None:
    model = MBMAPPO("MlpPolicy", vec(), n_simulated=0, device="cpu")
    with pytest.raises(ValueError, match="n_simulated=0: this model has nothing to simulate with"):
        model.simulate(None)
    with pytest.raises(ValueError, match="n_simulated=0: this model has nothing to simulate with"):
        model.current_rollout()
    model = tiny()
    with pytest.raises(ValueError, match="n_simulated must be an integer of at least 1, not 0"):
        model.simulate(None, n_simulated=0)


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
