"""The diagnostics against numbers computed by hand, and that training does not notice them."""

import io
import random
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import SAC as SB3SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import HumanOutputFormat, KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecNormalize

from sb3_sample.diagnostics import (
    DiagnosticsCallback,
    NoiseScaleCallback,
    average_value,
    discounted_return,
    dormant_shares,
    effective_rank,
    global_norm,
)
from sb3_sample.sac import SAC
from tests.sac.common import MAKERS, Toy, bro, differing, sac, state, vec
from tests.sac.test_drawn_steps import DRAWN
from tests.sac.test_execution import captured
from tests.sac.test_offline import data

DICT = spaces.Dict({"a": spaces.Box(-10, 10, (3,), np.float32), "b": spaces.Discrete(9)})
LINEAR: dict[str, Any] = {"policy_kwargs": {"net_arch": []}}


class Constant(Toy):
    """A toy whose reward is always the same."""

    def __init__(self, reward: float, **kwargs: Any):
        super().__init__(**kwargs, poison=lambda total, observation, _: (observation, reward))


class GlobalRandomness(Toy):
    """A toy whose reward takes numbers from the three global generators, which is how a callback could disturb it."""

    def step(self, action: np.ndarray) -> Any:
        observation, _, terminated, truncated, info = super().step(action)
        reward = random.random() + np.random.random() + torch.rand(()).item()
        return observation, reward, terminated, truncated, info


class Chain(gym.Env):
    """A reward of 1 a step in one state that is left, for the end, with some probability."""

    observation_space = spaces.Box(-1, 1, (3,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, probability: float):
        self.probability = probability

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return np.zeros(3, np.float32), 1.0, bool(self.np_random.random() < self.probability), False, {}


class Written(KVWriter):
    """Keeps what is logged."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, dict[str, Any]]] = []

    def write(self, key_values: dict[str, Any], key_excluded: Any, step: int = 0) -> None:
        self.rows.append((step, dict(key_values)))

    def diagnostics(self) -> list[tuple[int, dict[str, float]]]:
        rows = [(s, {k: v for k, v in row.items() if k.startswith("diagnostics/")}) for s, row in self.rows]
        return [(step, row) for step, row in rows if row]


def watched(model: SAC) -> Written:
    written = Written()
    model.set_logger(Logger(None, [written]))
    return written


def ready(model: SAC, eval_env: Any, **kwargs: Any) -> DiagnosticsCallback:
    """A callback that knows its model, to measure by hand."""
    callback = DiagnosticsCallback(eval_env, **{"n_start_states": 2, "rollout_length": 10, "seed": 0, **kwargs})
    callback.init_callback(model)
    return callback


@torch.no_grad()
def answer(critic: Any, *values: Any) -> None:
    """Critics whose answer does not depend on the input; a number, or K numbers, for each."""
    critic.head.weight.zero_()
    for bias, value in zip(critic.head.bias, values, strict=True):
        bias.copy_(torch.as_tensor(value, dtype=torch.float32).expand(bias.shape))


def fill(model: SAC, observations: list[Any], reward: float = 0.0, done: bool = False, timeout: bool = False) -> None:
    """Transitions in the replay buffer of a model with one environment, their next observations all 0."""
    assert model.replay_buffer is not None
    for observation in observations:
        now = np.array([observation], np.float32)
        infos: Any = [{"TimeLimit.truncated": timeout}]
        model.replay_buffer.add(now, np.zeros_like(now), np.zeros((1, 2)), np.array([reward]), np.array([done]), infos)


# ---------------------------------------------------------------- the formulas


def test_discounted_return() -> None:
    rewards = np.array([1.0, 2.0, 4.0])
    assert discounted_return(rewards, 0.5, terminated=True) == pytest.approx(1 + 1 + 1)
    # The mean, 7/3, from the fourth step on: 7/3 * (1/8 + 1/16 + ...).
    assert discounted_return(rewards, 0.5, terminated=False) == pytest.approx(3 + 7 / 3 / 4)
    assert discounted_return(np.full(4, 3.0), 0.9, terminated=False) == pytest.approx(30)


def test_average_value() -> None:
    rewards, log_probs = np.array([1.0, 3.0]), np.array([-1.0, -3.0])
    assert average_value(rewards, log_probs, alpha=0.5, gamma=0.9, terminated=False) == pytest.approx((2 + 1) / 0.1)
    # Two terms of the series are left.
    assert average_value(rewards, log_probs, alpha=0.5, gamma=0.9, terminated=True) == pytest.approx((2 + 1) * 1.9)
    assert average_value(rewards, log_probs, alpha=0.0, gamma=0.9, terminated=False) == pytest.approx(20)


def test_effective_rank() -> None:
    def rank(*singular_values: float) -> float:
        return effective_rank(torch.diag(torch.tensor(singular_values))).item()

    assert rank(99, 1) == 1, "exactly 99 per cent are enough"
    assert rank(98, 2) == 2
    assert rank(1, 98, 1) == 2, "the largest come first"
    assert rank(5, 5, 5, 0) == 3
    assert rank(0, 0) == 0
    assert np.isnan(rank(1, float("inf")))
    q = torch.linalg.qr(torch.randn(20, 20, generator=torch.Generator().manual_seed(0)))[0]
    stack = torch.stack((q[:, :3] @ q[:3], q[:, :7] @ q[:7], torch.full((20, 20), torch.nan)))
    ranks = effective_rank(stack)
    assert ranks[:2].tolist() == [3, 7] and ranks[2].isnan()
    assert effective_rank(torch.diag(torch.tensor([6.0, 3.0, 1.0])), delta=0.2).item() == 2


def test_dormant_shares() -> None:
    scores = {"a": torch.tensor([[1.975, 0.025], [0.0, 2.0]]), "b": torch.tensor([0.0, 0.0, 0.0, 0.0])}
    assert dormant_shares(scores, 0.025) == {"a": 0.5, "b": 1.0, "": 0.75}
    assert dormant_shares(scores, 0.0) == {"a": 0.25, "b": 1.0, "": 0.625}
    assert dormant_shares({}, 0.0) == {}


def test_global_norm() -> None:
    assert global_norm([torch.tensor([3.0]), torch.tensor([[0.0, 4.0]])]) == pytest.approx(5)


# ---------------------------------------------------------------- overestimation


def test_true_value_of_a_constant_reward() -> None:
    """Forever 2 is worth 2 / (1 - gamma), whatever cuts the rollout."""
    model = sac(gamma=0.9, ent_coef=0.0)
    answer(model.critic, 25, 29)
    for env in (Constant(2, length=7, truncate=True), Constant(2, length=50)):
        results = ready(model, env).measure()
        assert results["critic_value"] == pytest.approx(27)
        assert results["overestimation"] == pytest.approx(7, abs=1e-4)
        assert results["overestimation_soft"] == pytest.approx(7, abs=1e-4)


def test_true_value_with_termination() -> None:
    """Of two steps the first is the start pair: 2 + 0.9 * 2."""
    model = sac(gamma=0.9, ent_coef=0.0)
    answer(model.critic, 0, 0)
    results = ready(model, Constant(2, length=2), rollout_length=2).measure()
    assert results["overestimation"] == pytest.approx(-3.8, abs=1e-5)
    assert results["overestimation_soft"] == pytest.approx(-3.8, abs=1e-5)


@pytest.mark.parametrize(("returns", "scale"), [([], 1), ([0, 0], 1), ([0, 8], 4)])
def test_rewards_are_scaled_as_those_of_batches(returns: list[float], scale: float) -> None:
    """XQC's scale leaves rewards as they are until two returns differ."""
    model = sac(gamma=0.9, ent_coef=0.0, reward_scale="xqc")
    answer(model.critic, 0, 0)
    for each in returns:
        model.reward_scaler.on_step(model.learner, np.array([each]), np.array([True]), [{}])
    results = ready(model, Constant(2, length=2), rollout_length=2).measure()
    assert results["overestimation"] == pytest.approx(-3.8 / scale, rel=1e-5)


def test_mean_over_ensemble_and_quantiles() -> None:
    model = bro(gamma=0.5, ent_coef=0.0)
    answer(model.critic, [1, 2, 3, 4, 5], [6, 6, 6, 6, 11])
    results = ready(model, Constant(0.5, length=1)).measure()
    assert results["critic_value"] == pytest.approx(5)
    assert results["overestimation"] == pytest.approx(4.5)


def counting(gamma: float) -> SAC:
    """A model whose value is the observation's first number, which counts the steps of the episode."""
    model = sac(gamma=gamma, ent_coef=0.0, **LINEAR)
    with torch.no_grad():
        for head in (model.critic.head, model.critic_target.head):
            head.weight.zero_()[:, 0] = 1
    return model


@pytest.mark.parametrize(("length", "expected"), [(7, {0, 1, 2, 3, 4}), (3, {0, 1, 2})])
def test_start_pairs_are_visited_states(length: int, expected: set[int]) -> None:
    """They come from the first five of ten steps, over ends of episodes, with that very step's value and return."""
    gamma = 0.8
    callback = ready(counting(gamma), Toy(length=length), n_start_states=1, soft=False)
    starts = []
    for _ in range(40):
        results = callback.measure()
        start = round(results["critic_value"])
        starts.append(start)
        reference = sum(gamma**k * (start + 1 + k) for k in range(length - start))
        assert results["overestimation"] == pytest.approx(start - reference, abs=1e-4)
        assert "overestimation_soft" not in results
    assert set(starts) == expected


def test_start_pairs_lie_in_the_first_half_of_a_time_limit() -> None:
    """Once it was met; what it leaves to come is then at least half of it."""
    callback = ready(counting(0.8), Toy(length=6, truncate=True), n_start_states=1, rollout_length=100)
    callback.measure()
    assert {round(callback.measure()["critic_value"]) for _ in range(40)} == {0, 1, 2}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("probability", "gamma", "rollout_length", "n"), [(0.2, 0.9, 40, 1_500), (0.02, 0.99, 1_000, 900)]
)
def test_episodes_that_end_at_random(probability: float, gamma: float, rollout_length: int, n: int) -> None:
    """
    The value of the one state is 1 / (1 - gamma (1 - p)), and an exact critic overestimates by nothing. A start pair
    chosen from an episode of known length has less ahead of it: it would seem to be worth a fifth less.
    """
    value = 1 / (1 - gamma * (1 - probability))
    model = sac(vec_of(Monitor(Chain(probability))), gamma=gamma, ent_coef=0.0)
    answer(model.critic, value, value)
    callback = ready(model, Chain(probability), n_start_states=n, rollout_length=rollout_length, soft=False)
    results = callback.measure()

    def mean_power(discount: float) -> float:
        """Of discount ** T for the number T of steps to come."""
        return probability * discount / (1 - (1 - probability) * discount)

    # The return is (1 - gamma ** T) / (1 - gamma).
    variance = (mean_power(gamma**2) - mean_power(gamma) ** 2) / (1 - gamma) ** 2
    standard_error = (variance / n) ** 0.5
    # Half of the rollout and more is left to the start pair. Where that is not enough, it counts as endless.
    cut = ((1 - probability) * gamma) ** (rollout_length / 2) * (1 / (1 - gamma) - value)
    assert cut < standard_error / 4
    assert results["critic_value"] == pytest.approx(value, rel=1e-5)
    assert abs(results["overestimation"]) < 4 * standard_error + cut < 0.12 * value


def test_entropy_of_the_rollout() -> None:
    """Equation 22 with log-probabilities computed by torch's own distributions."""
    alpha, gamma = 0.5, 0.9
    model = sac(gamma=gamma, ent_coef=alpha)
    answer(model.critic, 0, 0)
    with torch.no_grad():
        for layer in (model.actor.mean, model.actor.log_std):
            layer.weight.zero_()
        model.actor.mean.bias.fill_(0.3)
        model.actor.log_std.bias.fill_(1.0)
    std = torch.exp(torch.tensor(-10 + 6 * (1 + np.tanh(1.0))))
    results = ready(model, Constant(2, length=50), n_start_states=1, rollout_length=2, seed=3).measure()
    generator = np.random.default_rng(3)
    generator.integers(2**31)  # the environment's seed
    x = 0.3 + std * torch.as_tensor(np.stack([generator.standard_normal(2, dtype=np.float32) for _ in range(2)]))
    squashed = torch.distributions.TransformedDistribution(
        torch.distributions.Normal(torch.tensor(0.3), std), torch.distributions.TanhTransform(cache_size=1)
    )
    log_prob = squashed.log_prob(squashed.transforms[0](x)).sum(dim=1).mean().item()
    assert results["overestimation"] == pytest.approx(-20, abs=1e-4)
    assert results["overestimation_soft"] == pytest.approx(-(2 - alpha * log_prob) / (1 - gamma), rel=1e-4)


def test_rollouts_are_bounded() -> None:
    env = Toy(length=100)
    model = sac()
    callback = ready(model, env, n_start_states=3, rollout_length=6, validation_size=25)
    callback.measure()
    assert env.total == 18
    assert callback._store is not None and callback._store.size() == 18
    callback.measure()
    assert env.total == 36 and callback._store.size() == 25, "the newest 25"


@pytest.mark.parametrize("dict_observations", [False, True])
@pytest.mark.parametrize("truncate", [False, True])
def test_validation_transitions(truncate: bool, dict_observations: bool) -> None:
    """As they were experienced: the last observation of an episode is not the first of the next."""
    kwargs: dict[str, Any] = {"obs_space": DICT} if dict_observations else {}
    model = sac(vec(**kwargs), policy="MultiInputPolicy" if dict_observations else "MlpPolicy")
    callback = ready(model, Toy(length=3, truncate=truncate, **kwargs), n_start_states=6)
    callback.measure()
    store: Any = callback._store
    # Whole episodes: that of a start pair, and those on the way there.
    n = store.size()
    assert n % 3 == 0 and n > 18 - 3 * truncate
    for key in ("a", "b") if dict_observations else (None,):
        now, after = (x if key is None else x[key] for x in (store.observations, store.next_observations))
        assert now[:n, 0].reshape(n, -1)[:, 0].tolist() == [0, 1, 2] * (n // 3)
        assert after[:n, 0].reshape(n, -1)[:, 0].tolist() == [1, 2, 3] * (n // 3)
    assert store.rewards[:n, 0].tolist() == [1, 2, 3] * (n // 3)
    assert store.dones[:n, 0].tolist() == [0, 0, 1] * (n // 3)
    assert store.timeouts[:n, 0].tolist() == [0, 0, float(truncate)] * (n // 3)


# ---------------------------------------------------------------- overfitting


@pytest.mark.parametrize(
    "end", [{}, {"done": True}, {"done": True, "timeout": True}], ids=["goes on", "termination", "time limit"]
)
@pytest.mark.parametrize(("pessimism", "next_value"), [(1.0, 3.0), (0.0, 4.0)])
def test_overfitting(pessimism: float, next_value: float, end: dict[str, bool]) -> None:
    gamma = 0.9
    model = sac(gamma=gamma, ent_coef=0.0, pessimism=pessimism)
    answer(model.critic, 1, 2)
    answer(model.critic_target, 3, 5)
    fill(model, [[0, 0, 0]] * 5, reward=2, **end)
    results = ready(model, Constant(5, length=3, truncate=True)).measure()
    bootstrap = 0 if end.get("done") and not end.get("timeout") else gamma * next_value
    training, validation = (2 + bootstrap - 1.5) ** 2, (5 + gamma * next_value - 1.5) ** 2
    assert results["td_error_training"] == pytest.approx(training, rel=1e-5)
    assert results["td_error_validation"] == pytest.approx(validation, rel=1e-5)
    assert results["overfitting"] == pytest.approx(validation / training, rel=1e-5)


def test_td_error_of_implicit_q_is_to_the_value_of_the_next_state() -> None:
    model = MAKERS["IQL"](gamma=0.5)
    answer(model.critic, 1, 2)
    answer(model.critic_target, 30, 50)
    answer(model.objective.value, 6)
    fill(model, [[0, 0, 0]] * 20, reward=2)
    results = ready(model, Toy()).measure()
    target = 2 + 0.5 * 6
    assert results["td_error_training"] == pytest.approx((target - 1.5) ** 2, rel=1e-5)
    loss = model.learner.head.loss(torch.tensor([1.0, 2.0]).reshape(2, 1, 1), torch.full((1, 1), target)).item()
    assert results["td_loss_newest"] == pytest.approx(loss, rel=1e-5)


def test_td_error_of_a_drawn_subset() -> None:
    """REDQ's target is that of two critics drawn at random, here (1, 3), (1, 7) or (3, 7)."""
    model = sac(gamma=1 / 2, ent_coef=0.0, target_subset=2, policy_kwargs={"net_arch": [8], "n_critics": 3})
    answer(model.critic, 0, 0, 0)
    answer(model.critic_target, 2, 6, 14)
    fill(model, [[0, 0, 0]])
    callback = ready(model, Toy())
    seen = {round(callback.measure()["td_error_training"], 3) for _ in range(20)}
    assert seen == {1.0, 9.0}, "half of the minimum of the two, squared"


def test_td_error_of_quantiles_counts_the_entropy(monkeypatch: pytest.MonkeyPatch) -> None:
    model = bro(gamma=0.5, ent_coef=0.25)
    answer(model.critic, [0, 0, 0, 0, 10], [1, 1, 1, 1, 1])  # mean 1.5
    answer(model.critic_target, [1, 2, 3, 4, 5], [1, 2, 3, 4, 15])  # mean 4, which is BRO's value
    monkeypatch.setattr(
        model.policy, "next_actions", lambda obs, noise: (noise.clamp(-1, 1), torch.full((len(noise), 1), -8.0))
    )
    fill(model, [[0, 0, 0]] * 5, reward=1)
    # 1 + 0.5 * (4 + 0.25 * 8) = 4
    assert ready(model, Toy()).measure()["td_error_training"] == pytest.approx((4 - 1.5) ** 2, rel=1e-5)


def test_one_batch_holds_what_there_is() -> None:
    """Each of the few transitions once, and each of many as often as another."""
    model = sac(gamma=0.0, ent_coef=0.0)
    answer(model.critic, 0, 0)
    for reward in (1, 2, 6):
        fill(model, [[0, 0, 0]], reward=reward)
    callback = ready(model, Constant(1), n_start_states=1, rollout_length=1, batch_size=8)
    assert callback.measure()["td_error_training"] == pytest.approx((1 + 4 + 36) / 3)
    callback.batch_size = 1
    seen = [callback.measure()["td_error_training"] for _ in range(60)]
    assert {round(x) for x in seen} == {1, 4, 36}


def test_without_training_transitions_or_error() -> None:
    model = sac(gamma=0.0, ent_coef=0.0)
    answer(model.critic, 0, 0)
    callback = ready(model, Constant(1))
    results = callback.measure()
    assert not any(name.startswith(("td_error", "overfitting", "dormant", "effective")) for name in results)
    assert "overestimation" in results
    fill(model, [[0, 0, 0]], reward=0)
    results = callback.measure()
    assert results["td_error_training"] == 0 and results["td_error_validation"] == 1 and "overfitting" not in results


def test_held_out_transitions_are_not_training_data() -> None:
    model = sac(gamma=0.0, ent_coef=0.0, validation_proportion=0.5)
    answer(model.critic, 0, 0)
    buffer: Any = model.replay_buffer
    fill(model, [[0, 0, 0]] * 40, reward=1)
    assert 0 < buffer.n_validation < 40
    buffer.rewards[buffer.held_out] = 100
    assert ready(model, Toy()).measure()["td_error_training"] == pytest.approx(1)


def test_memory_optimised_buffer() -> None:
    """When it is full, one transition has lost its next observation, and is left out."""
    model = sac(
        gamma=0.5, ent_coef=0.0, buffer_size=4, optimize_memory_usage=True, replay_buffer_class=ReplayBuffer,
        replay_buffer_kwargs={"handle_timeout_termination": False}, **LINEAR,
    )  # fmt: skip
    answer(model.critic, 0, 0)
    with torch.no_grad():
        model.critic_target.head.weight.zero_()[:, 0] = 1
    for t in range(6):
        now = np.full((1, 3), t, np.float32)
        model.replay_buffer.add(now, now + 1, np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])  # type: ignore[union-attr]
    # Steps 3, 4 and 5 are left, their values half of 4, 5 and 6.
    assert ready(model, Toy()).measure()["td_error_training"] == pytest.approx((4 + 6.25 + 9) / 3)


def test_single_steps_of_n_step_returns() -> None:
    model = sac(gamma=0.5, ent_coef=0.0, n_steps=3)
    answer(model.critic, 0, 0)
    answer(model.critic_target, 8, 8)
    fill(model, [[0, 0, 0]] * 10, reward=1)
    assert ready(model, Toy()).measure()["td_error_training"] == pytest.approx((1 + 0.5 * 8) ** 2)


# ---------------------------------------------------------------- networks


def test_disagreement() -> None:
    model = sac()
    answer(model.critic, 3, 5)
    fill(model, [[0, 0, 0]])
    assert ready(model, Toy()).measure()["critic_disagreement"] == pytest.approx(1)
    single = sac(policy_kwargs={"net_arch": [8], "n_critics": 1})
    fill(single, [[0, 0, 0]])
    assert "critic_disagreement" not in ready(single, Toy()).measure()


def test_rank_and_dormant_neurons_by_copy() -> None:
    model = sac(policy_kwargs={"net_arch": {"qf": [8], "pi": [4]}})
    with torch.no_grad():
        dense = model.critic.trunk.layers[0]
        for parameter in dense.parameters():
            parameter.zero_()
        # The first critic's neurons are all 1; the second one copies the observation into three of its neurons.
        dense.bias[0] = 1
        dense.weight[1, :3, :3] = torch.eye(3)
        actor = model.actor.trunk.layers[0]
        actor.weight.zero_()
        actor.bias.copy_(torch.tensor([1.0, 1.0, 1.0, 0.1]))
    fill(model, [[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    results = ready(model, Toy(), dormant_threshold=0.2).measure()
    assert results["effective_rank/critic_0"] == 1 and results["effective_rank/critic_1"] == 3
    assert results["effective_rank"] == 2
    assert results["dormant_critic"] == results["dormant_critic/layers.0"] == 5 / 16
    assert results["dormant_actor"] == results["dormant_actor/layers.0"] == 1 / 4
    assert ready(model, Toy(), dormant_threshold=0.1).measure()["dormant_actor"] == 0


def test_norms() -> None:
    model = sac()
    callback = ready(model, Toy())
    assert not any(name.startswith("gradient_norm") for name in callback.measure()), "no gradient step yet"
    for module, value in ((model.critic, 2.0), (model.actor, 3.0)):
        for parameter in module.parameters():
            parameter.data.fill_(value)
            parameter.grad = torch.full_like(parameter, value / 10)
    results = callback.measure()
    n_critic, n_actor = (sum(p.numel() for p in m.parameters()) for m in (model.critic, model.actor))
    assert results["parameter_norm_critic"] == pytest.approx(2 * n_critic**0.5, rel=1e-5)
    assert results["gradient_norm_critic"] == pytest.approx(0.2 * n_critic**0.5, rel=1e-5)
    assert results["parameter_norm_actor"] == pytest.approx(3 * n_actor**0.5, rel=1e-5)
    assert results["gradient_norm_actor"] == pytest.approx(0.3 * n_actor**0.5, rel=1e-5)


def test_gradient_norm_is_that_of_the_last_step() -> None:
    model = sac().learn(15)
    results = ready(model, Toy()).measure()
    assert results["gradient_norm_critic"] == pytest.approx(
        sum(float(p.grad.square().sum()) for p in model.critic.parameters() if p.grad is not None) ** 0.5, rel=1e-5
    )
    assert results["gradient_norm_critic"] > 0 and results["gradient_norm_actor"] > 0


def test_gradient_norms_of_captured_steps_if_episodes_set_the_schedule() -> None:
    model = sac(vec(length=7), train_freq=(1, "episode"), replay_ratio=None, gradient_steps=3).learn(7)
    captured(model)
    written = watched(model)
    model.learn(60, callback=DiagnosticsCallback(Toy(), every=20, n_start_states=1, rollout_length=3))
    assert [step for step, row in written.diagnostics() if row.get("diagnostics/gradient_norm_critic")] == [20, 40, 60]


# ---------------------------------------------------------------- training does not notice


@pytest.mark.parametrize(
    ("maker", "normalized", "buffer"),
    [
        ("SAC", True, {}),
        ("BRO", False, {}),
        ("SAC", False, DRAWN),
        pytest.param("SAC", False, {}, marks=pytest.mark.slow),
        pytest.param("BRO", True, {}, marks=pytest.mark.slow),
    ],
)
def test_training_is_the_same_bit_for_bit(maker: str, normalized: bool, buffer: dict[str, Any]) -> None:
    def run(callback: DiagnosticsCallback | None) -> tuple[SAC, list[Any]]:
        env: VecEnv = DummyVecEnv([lambda: Monitor(GlobalRandomness()) for _ in range(2)])
        model = MAKERS[maker](VecNormalize(env) if normalized else env, seed=3, **buffer)
        model.learn(60, callback=callback)
        generators = [random.random(), np.random.random(), torch.rand(()).item()]
        return model, generators

    callback = DiagnosticsCallback(GlobalRandomness(), every=7, n_start_states=2, rollout_length=5)
    (plain, numbers), (observed, observed_numbers) = run(None), run(callback)
    assert callback.last_results and plain._n_updates > 0
    assert differing(state(plain), state(observed)) == []
    np.testing.assert_array_equal(plain.replay_buffer.rewards, observed.replay_buffer.rewards)
    np.testing.assert_array_equal(plain.replay_buffer.actions, observed.replay_buffer.actions)
    assert numbers == observed_numbers
    if normalized:
        for name in ("obs_rms", "ret_rms"):
            one, other = (getattr(m.get_vec_normalize_env(), name) for m in (plain, observed))
            np.testing.assert_array_equal(one.var, other.var)


@pytest.mark.parametrize("fails", [False, True])
def test_modes_and_gradients_stay(fails: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model = sac(policy_kwargs={"net_arch": [8], "critic_network_kwargs": {"dropout": 0.5}}).learn(15)
    model.policy.set_training_mode(True)
    model.actor.eval()
    callback = ready(model, Toy())
    seen = []

    def sample(*args: Any) -> Any:
        seen.append(model.critic.trunk.training)
        if fails:
            raise RuntimeError("broken")
        return type(model.actor).sample(model.actor, *args)

    monkeypatch.setattr(model.actor, "sample", sample)
    modes = [module.training for module in model.policy.modules()]
    assert len(set(modes)) == 2
    gradients = [p.grad.clone() for p in model.critic.parameters() if p.grad is not None]
    before, numbers = state(model), torch.get_rng_state()
    if fails:
        with pytest.raises(RuntimeError, match="broken"):
            callback.measure()
    else:
        callback.measure()
    assert seen and not any(seen), "measured in evaluation mode"
    assert [module.training for module in model.policy.modules()] == modes
    after = [p.grad for p in model.critic.parameters() if p.grad is not None]
    assert len(gradients) == len(after) > 0 and all(map(torch.equal, gradients, after))
    assert differing(before, state(model)) == []
    assert torch.equal(numbers, torch.get_rng_state())


def test_one_seed_fixes_the_measurements() -> None:
    def rewards(seed: int | None) -> list[Any]:
        model = sac("Pendulum-v1", seed=1)
        callback = ready(model, gym.make("Pendulum-v1"), seed=seed)
        callback.measure()
        assert callback._store is not None
        return callback._store.rewards[:20].ravel().tolist()

    assert rewards(None) == rewards(1) != rewards(2)


# ---------------------------------------------------------------- when, and in which environments


@pytest.mark.parametrize(("n_envs", "steps"), [(1, [10, 20, 30, 40]), (4, [12, 20, 32, 40]), (16, [16, 32, 48])])
def test_at_or_after_each_multiple(n_envs: int, steps: list[int]) -> None:
    model = sac(vec(n_envs))
    written = watched(model)
    model.learn(40, callback=DiagnosticsCallback(vec(), every=10, n_start_states=1, rollout_length=3))
    assert [step for step, _ in written.diagnostics()] == steps


def test_not_while_acting_at_random() -> None:
    model = sac(learning_starts=25)
    written = watched(model)
    callback = DiagnosticsCallback(vec(), every=5, n_start_states=1, rollout_length=3)
    model.learn(40, callback=callback)
    assert [step for step, _ in written.diagnostics()] == [25, 30, 35, 40]
    # A second call of learn counts its steps anew, and learns from the first.
    assert callback._store is not None
    n = callback._store.size()
    model.learn(12, callback=callback)
    assert [step for step, _ in written.diagnostics()][4:] == [5, 10]
    assert callback._store.size() > n, "the validation transitions are kept"
    model.learn(8, callback=callback, reset_num_timesteps=False)
    assert [step for step, _ in written.diagnostics()][6:] == [15, 20]


def test_a_warning_tells_that_a_data_set_is_not_measured() -> None:
    model = MAKERS["IQL"](learning_starts=10)
    dataset = data(40)
    for callback in (
        NoiseScaleCallback(every=2),
        DiagnosticsCallback(Toy(), every=2, n_start_states=1, rollout_length=3),
    ):
        with pytest.warns(
            UserWarning, match=rf"{type(callback).__name__} measures nothing .* learning_starts=10 steps"
        ):
            model.learn_offline(dataset, 4, callback=callback)
        assert not callback.last_results
    model.learn(12)
    model.learn_offline(dataset, 4, callback=callback)
    assert callback.last_results["td_error_training"] > 0


NAMES = {
    "critic_value",
    "overestimation",
    "overestimation_soft",
    "td_error_training",
    "td_error_validation",
    "overfitting",
    "td_loss_newest",
    "td_loss_replay",
    "overfitting_newest",
    "critic_disagreement",
    "dormant_critic",
    "dormant_actor",
    "effective_rank",
    "effective_rank/critic_0",
    "effective_rank/critic_1",
    "gradient_norm_critic",
    "gradient_norm_actor",
    "parameter_norm_critic",
    "parameter_norm_actor",
}


@pytest.mark.parametrize("dict_observations", [False, True])
@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_everything_is_logged(maker: str, dict_observations: bool) -> None:
    kwargs: dict[str, Any] = {"obs_space": DICT} if dict_observations else {}
    policy = "MultiInputPolicy" if dict_observations else "MlpPolicy"
    model = MAKERS[maker](vec(3, **kwargs), policy=policy)
    written, table = Written(), io.StringIO()
    model.set_logger(Logger(None, [written, HumanOutputFormat(table)]))
    callback = DiagnosticsCallback(Toy(**kwargs), every=40, n_start_states=2, rollout_length=9, verbose=1)
    model.learn(42, callback=callback)
    [(step, row)] = written.diagnostics()
    assert step == 42
    layers = {"layers.0", "layers.2"} if maker == "SAC" else {"dense", "blocks.0.dense1"}
    actor_layers = layers
    expected = NAMES | {f"dormant_critic/{x}" for x in layers} | {f"dormant_actor/{x}" for x in actor_layers}
    assert set(row) == {f"diagnostics/{name}" for name in expected}
    assert all(isinstance(value, float) and np.isfinite(value) for value in row.values())
    assert row["diagnostics/overestimation"] == callback.last_results["overestimation"]
    assert "overestimation_soft" in table.getvalue()


def test_deterministic_actor() -> None:
    """It has no entropy, so that only the mean reward is left of equation 22."""
    model = sac(backbone="td3", gamma=0.9)
    answer(model.critic, 0, 0)
    fill(model, [[0, 0, 0]])
    results = ready(model, Constant(2, length=50)).measure()
    assert results["overestimation_soft"] == pytest.approx(-20, abs=1e-4)
    assert set(results) >= {"overfitting", "dormant_actor"}


@pytest.mark.parametrize("wrapped", [False, True])
def test_the_training_environments_normalisation(wrapped: bool) -> None:
    """Rewards of 8 are 2 where the returns' deviation is 4; observations are shifted by their mean."""
    env = VecNormalize(vec(2))
    model = sac(env, gamma=0.9, ent_coef=0.0, **LINEAR)
    assert isinstance(env.obs_rms.mean, np.ndarray)
    env.obs_rms.mean[:], env.obs_rms.var[:] = 3, 1
    env.ret_rms.var = np.array(16.0)
    for critic in (model.critic, model.critic_target):
        answer(critic, 0, 0)
        with torch.no_grad():
            critic.head.weight[:, 0] = 1
    eval_env: Any = vec_of(Constant(8, length=2))
    if wrapped:
        eval_env = VecNormalize(eval_env)
    callback = ready(model, eval_env, rollout_length=2)
    assert model.replay_buffer is not None
    model.replay_buffer.add(
        np.full((2, 3), 4.0), np.full((2, 3), 5.0), np.zeros((2, 2)), np.full(2, 4.0), np.zeros(2), [{}, {}]
    )
    results = callback.measure()
    assert results["critic_value"] == pytest.approx(0 - 3, abs=1e-5)
    assert results["overestimation"] == pytest.approx(-3 - 2 * 1.9, abs=1e-5)
    # 4 / 4 + 0.9 * (5 - 3) - (4 - 3), and for the two steps of the rollouts 2 + 0.9 * -2 - -3 and 2 - -2
    assert results["td_error_training"] == pytest.approx(1.8**2, rel=1e-4)
    assert results["td_error_validation"] == pytest.approx((3.2**2 + 4**2) / 2, rel=1e-4)
    if wrapped:
        np.testing.assert_array_equal(eval_env.obs_rms.mean, 0)


def vec_of(env: gym.Env) -> DummyVecEnv:
    return DummyVecEnv([lambda: env])


def test_subprocess() -> None:
    env = SubprocVecEnv([lambda: Constant(2, length=2)], start_method="fork")
    try:
        model = sac(gamma=0.9)
        answer(model.critic, 0, 0)
        assert ready(model, env, rollout_length=2).measure()["overestimation"] == pytest.approx(-3.8, abs=1e-5)
    finally:
        env.close()


def test_images() -> None:
    space = spaces.Box(0, 255, (36, 36, 3), np.uint8)
    model = sac(
        vec(obs_space=space), policy="CnnPolicy", buffer_size=50,
        policy_kwargs={"net_arch": [8], "features_extractor_kwargs": {"features_dim": 8}},
    )  # fmt: skip
    callback = DiagnosticsCallback(
        Toy(obs_space=space), every=15, n_start_states=1, rollout_length=3, validation_size=9
    )
    model.learn(15, callback=callback)
    assert callback.last_results.keys() >= {"overfitting", "effective_rank"}


# ---------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"every": 0}, "every .* at least 1, not 0"),
        ({"n_start_states": 0}, "n_start_states .* not 0"),
        ({"rollout_length": 2.5}, "rollout_length .* whole number .* not 2.5"),
        ({"batch_size": 0}, "batch_size .* not 0"),
        ({"validation_size": -1}, "validation_size .* not -1"),
        ({"dormant_threshold": -0.1}, "dormant_threshold .* not -0.1"),
        ({"dormant_threshold": float("nan")}, "dormant_threshold .* not nan"),
    ],
)
def test_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DiagnosticsCallback(Toy(), **kwargs)


def test_environments_that_do_not_fit() -> None:
    with pytest.raises(TypeError, match="eval_env .* 'Pendulum-v1'"):
        DiagnosticsCallback("Pendulum-v1")  # type: ignore[arg-type]
    with pytest.raises(
        ValueError, match="eval_env must be an environment, not None: only sb3-sample train and studies"
    ):
        ready(sac(), None)
    with pytest.raises(ValueError, match="eval_env must hold one environment, not 2"):
        DiagnosticsCallback(vec(2))
    with pytest.raises(ValueError, match="eval_env has the observation_space"):
        ready(sac(), Toy(obs_space=spaces.Box(-1, 1, (4,), np.float32)))
    with pytest.raises(ValueError, match="eval_env has the action_space"):
        ready(sac(), Toy(action_space=spaces.Box(-2, 2, (2,), np.float32)))
    with pytest.raises(ValueError, match="eval_env is wrapped in VecNormalize"):
        ready(sac(), VecNormalize(vec()))


def test_the_training_environment_is_refused() -> None:
    toy = Toy()
    model = sac(toy)
    training = model.get_env()
    assert training is not None
    for same in (toy, Monitor(toy), training, VecNormalize(training)):
        with pytest.raises(ValueError, match="eval_env is the training environment"):
            ready(model, same)


def test_models_that_do_not_fit() -> None:
    model: Any = SB3SAC("MlpPolicy", Toy(), device="cpu")
    with pytest.raises(TypeError, match=r"sb3_sample\.sac\.SAC"):
        model.learn(1, callback=DiagnosticsCallback(Toy()))
    with pytest.raises(ValueError, match=r"gamma must be below 1 .* not 1"):
        ready(sac(gamma=1.0), Toy())
    with pytest.raises(ValueError, match="init_callback"):
        DiagnosticsCallback(Toy()).measure()


def test_held_out_actions_of_integers_are_whole() -> None:
    """The buffer holds actions scaled to [-1, 1], which integers would cut to 0."""
    space = spaces.Box(0, 10, (2,), np.int64)
    model = sac(vec(action_space=space)).learn(30)
    callback = DiagnosticsCallback(vec(action_space=space), n_start_states=2, rollout_length=20, seed=1, verbose=0)
    callback.init_callback(model)
    callback.measure()
    held = callback._store.actions[: callback._store.size()]
    assert held.dtype == np.float32 and len(np.unique(held)) > 2
