"""The update: PPO's own without simulated samples, and the loss with them."""

import warnings
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample import MBMAPPO, MBPOPPO
from sb3_sample.ppo import SimulatedSamples
from tests.ppo.common import ALGORITHMS, EVERY, arguments_of, collected, quiet, tiny
from tests.sac.common import Toy, differing, state, vec

PPO_ARGUMENTS: dict[str, Any] = dict(n_steps=16, batch_size=8, n_epochs=3, device="cpu", seed=3)


def same_parameters(a: Any, b: Any, **tolerance: float) -> None:
    for (name, ours), theirs in zip(a.policy.named_parameters(), b.policy.parameters(), strict=True):
        torch.testing.assert_close(
            ours, theirs, msg=lambda m, n=name: f"{n}: {m}", **{"rtol": 0, "atol": 0, **tolerance}
        )


# ---------------------------------------------------------------- without simulated samples


@pytest.mark.parametrize("cls", EVERY)
@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"normalize_advantage": True, "ent_coef": 0.01, "clip_range_vf": 0.1, "target_kl": 0.02},
        {"use_sde": True, "sde_sample_freq": 4},
        {"learning_rate": lambda remaining: 1e-3 * remaining, "clip_range": lambda remaining: 0.3 * remaining},
    ],
)
def test_without_samples_it_is_stable_baselines3s_ppo_step_for_step(cls: Any, arguments: dict[str, Any]) -> None:
    def trained(algorithm: Any, **kwargs: Any) -> Any:
        policy_kwargs = {"net_arch": [8, 8]}
        arguments_ = {"normalize_advantage": False, "policy_kwargs": policy_kwargs, **PPO_ARGUMENTS, **arguments}
        return algorithm("MlpPolicy", vec(2), **arguments_, **kwargs).learn(64)

    ours, theirs = trained(cls, **arguments_of(cls, {"n_simulated": 0})), trained(PPO)
    assert ours._n_updates == theirs._n_updates > 0
    same_parameters(ours, theirs)
    assert not differing(state(ours), state(theirs))


def test_the_same_with_vec_normalize_and_discrete_actions() -> None:
    def trained(algorithm: Any, **kwargs: Any) -> Any:
        env = VecNormalize(vec(3, action_space=spaces.Discrete(3)))
        kwargs = {"policy_kwargs": {"net_arch": [8]}, "normalize_advantage": False, **kwargs}
        return algorithm("MlpPolicy", env, **PPO_ARGUMENTS, **kwargs).learn(96)

    same_parameters(trained(MBMAPPO, n_simulated=0), trained(PPO))


def test_the_same_with_the_default_networks() -> None:
    networks = dict(net_arch=dict(pi=[512, 512], vf=[1024, 1024]))
    ours = MBMAPPO("MlpPolicy", vec(), n_simulated=0, **PPO_ARGUMENTS).learn(32)
    theirs = PPO("MlpPolicy", vec(), normalize_advantage=False, policy_kwargs=networks, **PPO_ARGUMENTS).learn(32)
    same_parameters(ours, theirs)


def test_any_space_of_ppo_will_do_without_samples() -> None:
    image = spaces.Box(0, 255, (36, 36, 3), np.uint8)
    model = tiny(n_simulated=0, policy="CnnPolicy", env=vec(obs_space=image), **no_models(), policy_kwargs={})
    assert model.policy.net_arch == []
    tiny(n_simulated=0, env=vec(action_space=spaces.MultiDiscrete([2, 3])), **no_models()).learn(16)


def no_models() -> dict[str, Any]:
    """Arguments of the models at their defaults."""
    return dict(dynamics_kwargs=None, simulation_horizon=12, dynamics_buffer_size=25_000, warm_up_until=None)


@pytest.mark.parametrize("cls", EVERY)
def test_the_policy_starts_as_ppos_of_the_same_seed(cls: Any) -> None:
    theirs = PPO("MlpPolicy", vec(), **PPO_ARGUMENTS, policy_kwargs={"net_arch": [8]})
    same_parameters(tiny(cls, seed=3), theirs)


# ---------------------------------------------------------------- with samples that count nothing


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"ent_coef": 0.01, "clip_range_vf": 0.1},
        {"target_kl": 1e-3, "learning_rate": 1e-2},
        {"batch_size": 12},
    ],
)
def test_samples_of_weight_zero_change_nothing(arguments: dict[str, Any]) -> None:
    class Weightless(MBMAPPO):
        def fit_models(self) -> None:
            pass

        def simulate(self, observations: Any, values: Any = None, n_simulated: Any = None, noise: Any = None) -> Any:
            n = len(observations)
            ones = torch.ones(n, n_simulated)
            return SimulatedSamples(None, ones[..., None].repeat(1, 1, 2), ones, ones, 100 * ones, 0 * ones)

    warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
    policy_kwargs = {"net_arch": [8], "optimizer_kwargs": {"eps": 1e-5, "fused": True}}
    arguments = {**PPO_ARGUMENTS, "policy_kwargs": policy_kwargs, "normalize_advantage": False, **arguments}
    ours = Weightless("MlpPolicy", vec(2), warm_up_until=0.0, n_simulated=3, dynamics_kwargs={"width": 8}, **arguments)
    theirs = PPO("MlpPolicy", vec(2), **arguments)
    for model in (ours, theirs):
        model.set_random_seed(5)
        quiet(model).learn(64)
    assert ours._n_updates == theirs._n_updates
    moved = theirs._n_updates * theirs.lr_schedule(1.0)  # at most, in Adam
    same_parameters(ours, theirs, rtol=1e-6, atol=1e-3 * moved)
    logged = {name: value for name, value in theirs.logger.name_to_value.items() if name.startswith("train/")}
    assert logged["train/value_loss"] > 100, "not of order one, as the simulated advantages are not"
    for name, value in logged.items():
        assert ours.logger.name_to_value[name] == pytest.approx(value, rel=1e-5, abs=1e-6), name


# ---------------------------------------------------------------- the loss


def batch_of(model: Any) -> dict[str, torch.Tensor]:
    rollout = collected(model).current_rollout()
    samples = model.simulate(rollout.observations)
    weights = torch.ones_like(samples.log_probs) if samples.weights is None else samples.weights
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    batch = dict(
        observations=rollout.observations,
        values=rollout.values,
        returns=rollout.returns,
        actions=torch.cat([rollout.actions[:, None], samples.actions], dim=1),
        log_probs=torch.cat([rollout.log_probs[:, None], samples.log_probs], dim=1),
        advantages=torch.cat([rollout.advantages[:, None], samples.advantages], dim=1),
        weights=torch.cat([torch.ones(len(weights), 1), weights], dim=1),
    )
    if samples.observations is not None:
        batch["simulated_observations"] = samples.observations
    return batch


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("normalize", [False, True])
def test_the_loss_is_ppos_over_all_samples_and_its_value_loss_over_the_real_ones(cls: Any, normalize: bool) -> None:
    model = tiny(cls, normalize_advantage=normalize, ent_coef=0.02, vf_coef=0.7, seed=1, **no_termination(cls))
    batch = batch_of(model)
    loss, scalars = model._losses(batch, 0.2, None)

    n, columns = batch["advantages"].shape
    assert (n, columns) == (16, 4)  # batch_size (X + 1) samples
    states = batch["observations"][:, None].repeat(1, columns, 1)
    if "simulated_observations" in batch:
        states[:, 1:] = batch["simulated_observations"]
    actions = batch["actions"].flatten(0, 1)
    _, log_prob, _ = model.policy.evaluate_actions(states.flatten(0, 1), actions)
    values, _, entropy = model.policy.evaluate_actions(batch["observations"], batch["actions"][:, 0])
    advantages = batch["advantages"].flatten()
    if normalize:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    ratio = torch.exp(log_prob - batch["log_probs"].flatten())
    assert (ratio - 1).abs().max() > 0.05
    policy_loss = -torch.min(advantages * ratio, advantages * ratio.clamp(0.8, 1.2)).mean()
    value_loss = F.mse_loss(batch["returns"], values.flatten())
    torch.testing.assert_close(scalars["policy_gradient_loss"], policy_loss)
    torch.testing.assert_close(scalars["value_loss"], value_loss)
    torch.testing.assert_close(loss, policy_loss - 0.02 * entropy.mean() + 0.7 * value_loss)
    torch.testing.assert_close(scalars["clip_fraction"], ((ratio - 1).abs() > 0.2).float().mean())


def no_termination(cls: Any) -> dict[str, Any]:
    return {"predict_termination": False} if issubclass(cls, MBPOPPO) else {}


def test_enumerated_actions_give_the_exact_gradient() -> None:
    """At the old policy the simulated part of the gradient is sum_a pi(a|s) A(s, a) grad log pi(a|s)."""
    model = tiny(env=Toy(action_space=spaces.Discrete(4)), n_simulated=3)
    rollout = collected(model).current_rollout()
    samples = model.simulate(rollout.observations)
    n = len(rollout.values)
    batch = dict(
        observations=rollout.observations,
        values=rollout.values,
        returns=rollout.values,
        actions=torch.cat([rollout.actions[:, None], samples.actions], dim=1),
        log_probs=torch.cat([rollout.log_probs[:, None], samples.log_probs], dim=1),
        advantages=torch.cat([torch.zeros(n, 1), samples.advantages], dim=1),
        weights=torch.cat([torch.ones(n, 1), samples.weights], dim=1),
    )
    parameters = [model.policy.action_net.weight, model.policy.action_net.bias]
    loss, _ = model._losses(batch, 0.2, None)
    got = torch.autograd.grad(loss, parameters)
    probabilities = model.policy.get_distribution(rollout.observations).distribution.probs
    objective = (probabilities * samples.advantages).sum(dim=1).mean()
    # X of the X + 1 samples are simulated.
    for ours, theirs in zip(got, torch.autograd.grad(objective, parameters), strict=True):
        torch.testing.assert_close(ours, -3 / 4 * theirs)


def test_updates_are_as_many_as_ppos() -> None:
    for cls in ALGORITHMS:
        model = tiny(cls)
        steps = []
        step = model.policy.optimizer.step
        model.policy.optimizer.step = lambda *args, s=step, n=steps: (n.append(1), s(*args))[1]
        model.learn(32)
        assert len(steps) == 2 * 2 * (16 // 8)  # iterations, epochs, minibatches


def test_the_fused_kernel_unless_the_user_says_otherwise() -> None:
    assert tiny().policy.optimizer.defaults["fused"] is True
    assert tiny().policy.optimizer.defaults["eps"] == 1e-5
    slow = {"net_arch": [8], "optimizer_kwargs": {"fused": False, "eps": 1e-7}}
    defaults = tiny(policy_kwargs=slow).policy.optimizer.defaults
    assert (defaults["fused"], defaults["eps"]) == (False, 1e-7)
    decay = {"net_arch": [8], "optimizer_kwargs": {"weight_decay": 0.1}}
    defaults = tiny(policy_kwargs=decay).policy.optimizer.defaults
    assert (defaults["fused"], defaults["eps"], defaults["weight_decay"]) == (True, 1e-8, 0.1)
    foreach = {"net_arch": [8], "optimizer_kwargs": {"foreach": True}}
    assert not tiny(policy_kwargs=foreach).policy.optimizer.defaults["fused"]
    sgd = {"net_arch": [8], "optimizer_class": torch.optim.SGD}
    assert isinstance(tiny(policy_kwargs=sgd).policy.optimizer, torch.optim.SGD)


def test_the_critic_learns_from_the_real_samples_alone() -> None:
    """The critic's parameters do not depend on the simulated samples, as long as nothing is clipped jointly."""

    def critic(n_simulated: int) -> Any:
        model = tiny(n_simulated=n_simulated, max_grad_norm=1e9, n_epochs=1)
        model.fit_models = lambda: None
        collected(model)
        model.set_random_seed(0)
        np.random.seed(0)
        model.train()
        return model.policy.value_net.weight

    torch.testing.assert_close(critic(1), critic(5), rtol=1e-5, atol=1e-6)
