"""Bias and variance relative to the gradient's size."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_sample.ppo import MBMAPPO, MBPOPPO, QMAPPO
from sb3_sample.variance import GradientSamples, compare_gradients, policy_gradient
from sb3_sample.variance.bias import jackknife_squares, sample_gradients
from tests.variance.common import Regulator

SMALL: dict[str, Any] = {"dynamics_kwargs": {"width": 16}, "q_kwargs": {"width": 16}}


def make(noise: float = 0.0) -> gym.Env:
    return gym.wrappers.TimeLimit(Regulator(noise), 20)


def agent(steps: int = 0, seed: int = 0, **kwargs: Any) -> PPO:
    kwargs = {"n_steps": 1024, "gamma": 0.9, "policy_kwargs": {"net_arch": [8]}, **kwargs}
    model = PPO("MlpPolicy", make(), seed=seed, device="cpu", **kwargs)
    return model.learn(steps) if steps else model


def gaussians(m: int = 50, seed: int = 0) -> tuple[GradientSamples, dict[str, np.ndarray]]:
    rng = np.random.default_rng(seed)
    means = {"PPO": np.array([1.0, -2.0, 0.5]), "MBMA": np.array([1.5, -1.0, 0.5])}
    common = rng.normal(size=(m, 3))
    return GradientSamples({"PPO": means["PPO"] + common, "MBMA": means["MBMA"] + 0.5 * common}), means


# ---------------------------------------------------------------- definitions


def test_the_papers_definitions() -> None:
    samples, _ = gaussians()
    mine, oracle = samples.gradients["MBMA"], samples.gradients["PPO"]
    bias = variance = 0.0
    for p in range(3):
        mean = mine[:, p].sum() / 50
        bias += abs(mean - oracle[:, p].sum() / 50) / abs(mean) / 3
        variance += ((mine[:, p] - mean) ** 2).sum() / 49 / mean**2 / 3
    assert samples.relative_bias("MBMA") == pytest.approx(bias)
    assert samples.relative_variance("MBMA") == pytest.approx(variance)
    assert samples.relative_bias("PPO") == 0
    assert samples.bias("PPO").value == 0


def test_squares_have_no_bias() -> None:
    values = [jackknife_squares(np.random.default_rng(seed).normal(0.3, 2, (8, 5)))[0] for seed in range(4000)]
    assert abs(np.mean(values) - 5 * 0.3**2) < 4 * np.std(values) / np.sqrt(4000)
    samples = np.random.default_rng(0).normal(size=(6, 5))
    value, left_out = jackknife_squares(samples)
    assert value == pytest.approx(np.mean([samples[i] @ samples[j] for i in range(6) for j in range(6) if i != j]))
    assert left_out[2] == pytest.approx(jackknife_squares(np.delete(samples, 2, axis=0))[0])


@pytest.mark.slow
def test_intervals_cover_bias_and_variance() -> None:
    covered = np.zeros(4)
    for seed in range(300):
        samples, means = gaussians(seed=seed)
        size = {name: mean @ mean for name, mean in means.items()}
        difference = means["MBMA"] - means["PPO"]
        truth = (difference @ difference / size["MBMA"], 3 * 0.25 / size["MBMA"])
        intervals = (
            samples.bias("MBMA"),
            samples.variance("MBMA"),
            samples.difference("variance", "MBMA", "PPO"),
            samples.difference("bias", "MBMA", "PPO"),
        )
        truths = (*truth, truth[1] - 3 / size["PPO"], truth[0])
        covered += [interval.low <= value <= interval.high for interval, value in zip(intervals, truths, strict=True)]
    assert (covered / 300 > 0.90).all() and (covered / 300 < 0.985).all()


def test_the_papers_bias_has_a_floor_of_noise_and_ours_has_not() -> None:
    rng = np.random.default_rng(0)
    samples = GradientSamples({name: rng.normal(0.1, 1.0, size=(40, 500)) for name in ("PPO", "MBMA")})
    # No method is biased here.
    assert samples.relative_bias("MBMA") > 1
    assert samples.noise_floor() > 1
    interval = samples.bias("MBMA")
    assert interval.low < 0 < interval.high


def test_parameters_without_any_gradient_do_not_count() -> None:
    gradients = np.random.default_rng(0).normal(1.0, 0.1, size=(10, 3))
    padded = np.hstack([gradients, np.zeros((10, 2))])
    value = GradientSamples({"PPO": padded}).relative_variance("PPO")
    assert value == GradientSamples({"PPO": gradients}).relative_variance("PPO")


def test_arguments() -> None:
    gradients = np.ones((5, 3))
    with pytest.raises(ValueError, match="oracle must be one of the methods, MBMA, not 'PPO'"):
        GradientSamples({"MBMA": gradients})
    with pytest.raises(ValueError, match="gradients must all be of one shape"):
        GradientSamples({"PPO": gradients, "MBMA": gradients[:4]})
    with pytest.raises(ValueError, match="M at least 4"):
        GradientSamples({"PPO": gradients[:3]})
    four = GradientSamples({name: np.random.default_rng(0).normal(size=(4, 3)) for name in ("PPO", "MBMA")})
    assert np.isfinite(four.bias("MBMA")).all()
    with pytest.raises(ValueError, match="difference needs at least 5 estimates of the gradients, not 4"):
        four.difference("bias", "PPO", "MBMA")
    with pytest.raises(ValueError, match="quantity must be .* not 'size'"):
        GradientSamples({"PPO": gradients}).difference("size", "PPO", "PPO")
    with pytest.raises(ValueError, match="n_estimates .* at least 4, not 3"):
        compare_gradients(agent(), make, n_estimates=3)
    with pytest.raises(ValueError, match="n_simulated .* at least 1, not 0"):
        compare_gradients(agent(), make, n_simulated=0)
    with pytest.raises(ValueError, match="simulation_horizon .* at least 2, not 1"):
        compare_gradients(agent(), make, simulation_horizon=1)
    with pytest.raises(ValueError, match="make_env makes an environment with the action_space Box"):
        compare_gradients(agent(), lambda: gym.wrappers.RescaleAction(make(), -3, 3))
    with pytest.raises(TypeError, match="model must be a PPO or A2C"):
        compare_gradients(SAC("MlpPolicy", make(), buffer_size=1), make)  # type: ignore[arg-type]


# ---------------------------------------------------------------- gradients of the algorithms


@pytest.mark.parametrize("cls", [MBMAPPO, QMAPPO, MBPOPPO])
def test_policy_gradient_is_that_of_the_algorithms_loss(cls: type[Any]) -> None:
    networks = SMALL["q_kwargs" if cls is QMAPPO else "dynamics_kwargs"]
    kwargs: dict[str, Any] = {"q_kwargs" if cls is QMAPPO else "dynamics_kwargs": networks}
    if cls is not QMAPPO:
        kwargs["predict_termination"] = True  # so that MBPO's samples have weights
    model = cls("MlpPolicy", make(), n_steps=32, batch_size=32, seed=0, device="cpu", n_simulated=3, **kwargs)
    _, callback = model._setup_learn(64, None)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, 32)
    rollout = model.current_rollout()
    samples = model.simulate(rollout.observations, rollout.values, 3)
    weights = torch.ones_like(samples.log_probs) if samples.weights is None else samples.weights
    batch = {
        "observations": rollout.observations,
        "values": rollout.values,
        "returns": rollout.returns,
        "actions": torch.cat([rollout.actions[:, None], samples.actions], dim=1),
        "log_probs": torch.cat([rollout.log_probs[:, None], samples.log_probs], dim=1),
        "advantages": torch.cat([rollout.advantages[:, None], samples.advantages], dim=1),
        "weights": torch.cat([torch.ones(32, 1), weights], dim=1),
    }
    if samples.observations is not None:
        batch["simulated_observations"] = samples.observations
    _, scalars = model._losses(batch, 0.2, None)
    parameters = [p for name, p in model.policy.named_parameters() if "value" not in name]
    expected = torch.cat([g.flatten() for g in torch.autograd.grad(-scalars["policy_gradient_loss"], parameters)])
    np.testing.assert_allclose(policy_gradient(model, rollout, samples), expected, rtol=1e-3, atol=1e-5)

    plain = policy_gradient(model, rollout)
    log_probs = model.policy.evaluate_actions(rollout.observations, rollout.actions)[1]
    expected = torch.cat(
        [g.flatten() for g in torch.autograd.grad((rollout.advantages * log_probs).mean(), parameters)]
    )
    np.testing.assert_allclose(plain, expected, rtol=1e-3, atol=1e-5)


def test_estimators_get_every_rollout() -> None:
    estimators = {"PPO": lambda x: np.array([x, 1.0]), "half": lambda x: np.array([x / 2, 1.0])}
    samples = sample_gradients([1.0, 2.0, 3.0, 4.0], estimators)
    np.testing.assert_array_equal(samples.gradients["half"][:, 0], [0.5, 1, 1.5, 2])
    assert samples.n_estimates == 4


def test_comparing_changes_nothing_and_is_reproducible() -> None:
    model, counted = agent(), []
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    compare = functools.partial(
        compare_gradients, model, make, n_estimates=4, n_steps=64, n_fits=1, n_simulated=2, **SMALL
    )
    torch.manual_seed(0)
    expected, numpy_state = torch.rand(1), np.random.get_state()[1].copy()
    torch.manual_seed(0)
    first, second, third = compare(on_estimate=counted.append), compare(), compare(seed=1)
    assert torch.rand(1) == expected
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_state)
    assert counted == [1, 2, 3, 4]
    assert list(first.gradients) == ["PPO", "MBMA", "QMA", "MBPO"]
    for name in first.gradients:
        np.testing.assert_array_equal(first.gradients[name], second.gradients[name])
        assert (first.gradients[name] != third.gradients[name]).any()
    for name, value in model.policy.state_dict().items():
        assert torch.equal(value, before[name])
    assert all(parameter.grad is None for parameter in model.policy.parameters())


def test_comparing_with_normalized_observations() -> None:
    venv = VecNormalize(DummyVecEnv([make]))
    model = PPO("MlpPolicy", venv, n_steps=64, seed=0, device="cpu", policy_kwargs={"net_arch": [8]}).learn(64)
    mean = venv.obs_rms.mean.copy()
    samples = compare_gradients(model, make, n_estimates=4, n_steps=32, n_fits=1, n_simulated=2, **SMALL)
    assert np.isfinite(samples.gradients["MBMA"]).all()
    np.testing.assert_array_equal(venv.obs_rms.mean, mean)


def test_every_transition_that_the_models_learn_from_has_happened(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Any] = []

    def keep(model: MBMAPPO) -> None:
        kept.append(model.transitions.recent(24))

    monkeypatch.setattr(MBMAPPO, "fit_models", keep)
    compare_gradients(agent(), make, n_estimates=4, n_steps=24, n_fits=1, n_simulated=2, **SMALL)
    observations, actions, next_observations, rewards, _ = kept[0]
    assert len(observations) == 24
    x, u = observations[:, 0], 10 * actions[:, 0]  # kept in the models' scale
    np.testing.assert_allclose(next_observations[:, 0], 0.9 * x + 0.3 * u, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(rewards, -(x**2) - 0.1 * u**2, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_bias_and_variance_are_ordered_as_in_the_papers_table_3(seed: int) -> None:
    networks: dict[str, Any] = {"dynamics_kwargs": {"width": 64}, "q_kwargs": {"width": 64}}
    model = agent(4096, seed)
    samples = compare_gradients(model, make, n_estimates=24, n_steps=512, n_fits=5, seed=seed, **networks)
    assert samples.difference("bias", "MBMA", "QMA").high < 0
    for method in ("MBMA", "MBPO"):
        assert samples.difference("variance", method, "PPO").high < 0, method
    # "QMA produces smaller gradients than other methods given the same data" (section 5.2).
    sizes = {name: jackknife_squares(gradients.astype(float))[0] for name, gradients in samples.gradients.items()}
    assert sizes["QMA"] < 0.5 * min(sizes["MBMA"], sizes["MBPO"])
