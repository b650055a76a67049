"""Actions from the rewound environment: exact gradients, the environment's own stream, and what cannot be rewound."""

import dataclasses
import datetime
import enum
import functools
import random
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, RecordVideo, TimeLimit, TransformReward
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_sample import RewoundPPO
from sb3_sample.envs import make_env
from sb3_sample.envs.rewinding import rewound_returns, sibling_of
from sb3_sample.envs.states import check_restorable, restore_state, save_state
from sb3_sample.ppo.rewound import _Follower
from sb3_sample.variance.decomposition import Components
from tests.ppo.common import collected, quiet, tiny
from tests.sac.common import Toy, differing, state, vec
from tests.variance.common import GAMMA, Exact, Tabular

#: The plain actor-critic of figure 1.
ACTOR_CRITIC: dict[str, Any] = dict(n_epochs=1, batch_size=16, gae_lambda=1.0, max_grad_norm=float("inf"))


def rewound(env: Any = None, **kwargs: Any) -> Any:
    return tiny(RewoundPPO, env, **kwargs)


# ---------------------------------------------------------------- a task of which everything is known


class OneHot(gym.ObservationWrapper):
    """The states of a tabular task as vectors."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.n = int(env.observation_space.n)  # type: ignore[attr-defined]
        self.observation_space = spaces.Box(0, 1, (self.n,), np.float32)

    def observation(self, observation: Any) -> np.ndarray:
        return np.eye(self.n, dtype=np.float32)[observation]


#: Logits of the policy, (S, A).
LOGITS = np.array([[0.5, -0.5], [-1.0, 0.3], [0.2, 0.1]])
POLICY = np.exp(LOGITS) / np.exp(LOGITS).sum(axis=1, keepdims=True)


def tabular(deterministic: bool) -> Tabular:
    """A task that starts where the policy's chain is stationary, as lemma 3.1 has it."""
    env = Tabular()
    if deterministic:
        # Q of a step is then no sample.
        env.kernel = np.eye(3)[[[1, 2], [2, 0], [0, 1]]]
    env.start = Exact(env, POLICY).stationary
    return env


def known(env: Tabular, n_envs: int, values: np.ndarray, **kwargs: Any) -> Any:
    """The policy and a critic of given values in many copies of a task."""
    venv = DummyVecEnv([lambda: OneHot(_copy(env)) for _ in range(n_envs)])
    agent = quiet(rewound(venv, gamma=GAMMA, policy_kwargs={"net_arch": []}, copies=64, **kwargs))
    with torch.no_grad():
        for layer, weight in ((agent.policy.action_net, LOGITS.T), (agent.policy.value_net, values[None])):
            layer.weight.copy_(torch.as_tensor(weight))
            layer.bias.zero_()
    return collected(agent)


def _copy(env: Tabular) -> Tabular:
    made = Tabular()
    made.kernel, made.start, made.rewards = env.kernel, env.start, env.rewards
    return made


def gradients(agent: Any, samples: Any) -> np.ndarray:
    """Each environment's gradient of equation 3, of its T states and N actions: rows of weights and biases."""
    rollout = agent.current_rollout()
    actions = torch.cat([rollout.actions[:, None], samples.actions], dim=1).numpy()
    advantages = torch.cat([rollout.advantages[:, None], samples.advantages], dim=1).double().numpy()
    states = rollout.observations.argmax(dim=1).numpy()
    directions = np.eye(2)[actions] - POLICY[states][:, None]
    means = (advantages[..., None] * directions).mean(axis=1)  # over the actions
    inputs = np.concatenate([np.eye(3)[states], np.ones((len(states), 1))], axis=1)
    products = (means[:, :, None] * inputs[:, None]).reshape(len(states), -1)
    return products.reshape(agent.n_envs, agent.n_steps, -1).mean(axis=1)


@pytest.mark.parametrize("n_batches", [200, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("n_actions", [2, 4])
def test_the_gradient_is_exact_and_its_variance_lemma_3_1s(n_batches: int, n_actions: int) -> None:
    """The mean over many batches, and the variance, which falls with the actions as far as the lemma lets it."""
    env, n_steps = tabular(deterministic=True), 3
    exact = Exact(env, POLICY, baseline=True)
    agent = known(env, n_batches, exact.values, n_steps=n_steps, n_actions=n_actions, gae_lambda=0.0, horizon=1)
    found = gradients(agent, agent.simulate(agent.current_rollout().observations))
    mean = np.einsum("s,sa,sap->p", exact.stationary, POLICY, exact.y[:3])
    error = found.std(axis=0, ddof=1) / np.sqrt(n_batches)
    assert (np.abs(found.mean(axis=0) - mean) <= 4 * error + 1e-6).all()
    variances = {n: Components(*exact.components(n_steps)).variance(n_steps, n) for n in (1, n_actions)}
    assert variances[1] == pytest.approx(exact.enumerated_variance(n_steps, 1), rel=1e-9)
    assert variances[n_actions] < 0.8 * variances[1]
    measured = found.var(axis=0, ddof=1).sum()
    # Four standard errors of it.
    spread = (np.square(found - found.mean(axis=0)).sum(axis=1)).std() / np.sqrt(n_batches)
    assert abs(measured - variances[n_actions]) < 4 * spread
    assert n_batches < 10_000 or 4 * spread < 0.1 * measured


@pytest.mark.parametrize("n_batches", [150, pytest.param(10_000, marks=pytest.mark.slow)])
def test_returns_to_the_rollouts_end_are_unbiased(n_batches: int) -> None:
    """From every step of the rollout, with a critic that is wrong and transitions that are random."""
    env, n_steps = tabular(deterministic=False), 4
    values = np.array([1.0, -2.0, 0.5])
    agent = known(env, n_batches, values, n_steps=n_steps, n_actions=3, gae_lambda=1.0)
    rollout = agent.current_rollout()
    samples = agent.simulate(rollout.observations)
    chain = np.einsum("sa,sat->st", POLICY, env.kernel)
    q, following = [], values
    for _ in range(n_steps):
        q.append(env.rewards + GAMMA * env.kernel @ following)
        following = (POLICY * env.rewards).sum(axis=1) + GAMMA * chain @ following
    states = rollout.observations.argmax(dim=1).numpy().reshape(n_batches, n_steps)
    actions = samples.actions.numpy().reshape(n_batches, n_steps, 2)
    returns = samples.q_values.double().numpy().reshape(n_batches, n_steps, 2)
    for t in range(n_steps):
        errors = returns[:, t] - q[n_steps - t - 1][states[:, t, None], actions[:, t]]
        assert abs(errors.mean()) <= 4 * errors.std() / np.sqrt(errors.size) + 1e-6
    # Two actions of a state go on with noise of their own.
    errors = returns[:, 0] - q[-1][states[:, :1], actions[:, 0]]
    assert abs(np.corrcoef(errors.T)[0, 1]) < 4 / np.sqrt(n_batches)
    # T - t steps from step t.
    assert agent.num_rewound_steps == n_batches * 2 * (4 + 3 + 2 + 1)


def test_all_actions_are_weighted_by_their_probabilities() -> None:
    env = tabular(deterministic=True)
    exact = Exact(env, POLICY)
    kwargs = dict(n_steps=2, n_actions=4, gae_lambda=0.0, horizon=1)
    agent = known(env, 5, exact.values, sample_actions="all", **kwargs)
    rollout = agent.current_rollout()
    samples = agent.simulate(rollout.observations)
    states = rollout.observations.argmax(dim=1).numpy()
    assert samples.actions.tolist() == [[0, 1]] * 10
    np.testing.assert_allclose(samples.weights, 3 * POLICY[states], rtol=1e-5)
    np.testing.assert_allclose(samples.q_values, exact.q[states], rtol=1e-5, atol=1e-6)


def test_drawn_discrete_actions_follow_the_policy() -> None:
    agent = known(tabular(deterministic=True), 5, np.zeros(3), n_steps=2, n_actions=201, horizon=1)
    rollout = agent.current_rollout()
    samples = agent.simulate(rollout.observations)
    states = rollout.observations.argmax(dim=1).numpy()
    for s in range(3):
        share, n = samples.actions[states == s].double().mean().item(), 200 * (states == s).sum()
        assert abs(share - POLICY[s, 1]) < 4 * 0.5 / np.sqrt(n)
    _, log_prob, _ = agent.policy.evaluate_actions(rollout.observations, samples.actions[:, 0])
    torch.testing.assert_close(samples.log_probs[:, 0], log_prob.detach())
    noise = torch.full((10, 1), 0.999)
    again = [agent.simulate(rollout.observations, n_simulated=1, noise=noise).q_values for _ in range(2)]
    assert torch.equal(*again)


def test_one_gradient_step_of_a_rollout_is_plain_actor_critics() -> None:
    """The policy's gradient is the mean of A grad log pi over N T samples, whatever the clipping."""
    agent = collected(rewound(**{**ACTOR_CRITIC, "clip_range": 1e-6}, n_actions=3, vf_coef=0.5))
    rollout = agent.current_rollout()
    samples = agent.simulate(rollout.observations)
    policy = agent.policy
    actions = torch.cat([rollout.actions[:, None], samples.actions], dim=1)
    advantages = torch.cat([rollout.advantages[:, None], samples.advantages], dim=1)
    repeated = rollout.observations[:, None].expand(-1, 3, -1).flatten(0, 1)
    _, log_prob, _ = policy.evaluate_actions(repeated, actions.flatten(0, 1))
    value = policy.predict_values(rollout.observations).flatten()
    loss = -(advantages.flatten() * log_prob).mean() + 0.5 * (rollout.returns - value).square().mean()
    expected = torch.autograd.grad(loss, list(policy.parameters()))
    found: list[torch.Tensor] = []
    policy.optimizer.step = lambda: found.extend(p.grad.clone() for p in policy.parameters())
    agent._update_policy(rollout, samples)
    assert len(found) == len(expected), "one step"
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


# ---------------------------------------------------------------- the taken action's own return


def certain(agent: Any) -> Any:
    """The agent with a policy that is all but deterministic, and values that differ from state to state."""
    with torch.no_grad():
        if hasattr(agent.policy, "log_std"):
            agent.policy.log_std.fill_(-30.0)
        else:
            agent.policy.action_net.weight.mul_(1e6)
        agent.policy.value_net.weight.normal_(0.0, 1.0)
    return agent


class Ends(gym.Env):
    """Counts its steps, pays their number plus the action, and ends at ``length``; a wrapper may set a time limit."""

    def __init__(self, length: int):
        self.observation_space = spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.length, self.t, self.place = length, 0, 0.0

    def _observation(self) -> np.ndarray:
        return np.array([self.t / self.length, self.place], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t, self.place = 0, float(self.np_random.uniform(-1, 1))
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.t += 1
        self.place = 0.9 * self.place + 0.1 * float(action[0])
        return self._observation(), self.t + float(action[0]), self.t >= self.length, False, {}


def _dmc() -> gym.Env:
    pytest.importorskip("dm_control")
    return TimeLimit(make_env("dmc/walker-walk-v0", action_repeat=2), 10)


@pytest.mark.parametrize(
    ("make", "gae_lambda", "normalized"),
    [
        *(
            pytest.param(make, gae_lambda, normalized, id=f"{what}, {gae_lambda}, {normalized}")
            for what, make in {
                "terminations": lambda: Ends(5),
                "time limits": lambda: TimeLimit(Ends(100), 6),
                "the rollout's end": lambda: Ends(100),
            }.items()
            for gae_lambda in (1.0, 0.9, 0.0)
            for normalized in (False, True)
        ),
        pytest.param(_dmc, 0.9, False, id="dm_control"),
    ],
)
def test_the_return_of_the_action_taken_is_found_again(
    make: Callable[[], gym.Env], gae_lambda: float, normalized: bool
) -> None:
    """
    At every state of the rollout, by its own value, in the midst of its episode and to that episode's end: none of what
    a new environment into which positions are written would give (the published code's, which also takes the first
    state's value for all).
    """
    venv: Any = DummyVecEnv([make for _ in range(2)])
    if normalized:
        venv = VecNormalize(venv)
        venv.reset()
        for _ in range(30):
            venv.step(np.array([venv.action_space.sample() for _ in range(2)]))
        venv.training = False
    agent = certain(rewound(venv, n_steps=16, gamma=0.95, gae_lambda=gae_lambda, n_actions=2))
    agent = collected(agent)
    rollout = agent.current_rollout()
    states = [agent._states[t][index] for index in range(2) for t in range(16)]
    left = [16 - t for _ in range(2) for t in range(16)]
    found, _ = rewound_returns(
        _Follower(agent), agent._siblings, states, rollout.actions.numpy(), left, np.random.default_rng(0), gae_lambda
    )
    np.testing.assert_allclose(found, rollout.returns.numpy(), rtol=1e-3, atol=1e-3)


def test_a_discrete_task_whose_episodes_end_early() -> None:
    venv = make_vec_env("CartPole-v1", 2, seed=0)
    agent = collected(certain(rewound(venv, n_steps=32, gae_lambda=0.9, n_actions=2, policy_kwargs={"net_arch": [4]})))
    assert agent.rollout_buffer.episode_starts[1:].any()
    rollout = agent.current_rollout()
    states = [agent._states[t][index] for index in range(2) for t in range(32)]
    left = [32 - t for _ in range(2) for t in range(32)]
    found, _ = rewound_returns(
        _Follower(agent), agent._siblings, states, rollout.actions.numpy(), left, np.random.default_rng(0), 0.9
    )
    np.testing.assert_allclose(found, rollout.returns.numpy(), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("horizon", "expected"), [(1, 1), (3, 3), (None, None)])
def test_steps_of_the_further_actions(horizon: int | None, expected: int | None) -> None:
    agent = rewound(Ends(1_000), n_steps=16, n_actions=3, horizon=horizon)
    agent.learn(16)
    assert agent.num_rewound_steps == 2 * (16 * 17 // 2 if expected is None else 16 * expected)


@pytest.mark.parametrize("copies", [1, 3, 50])
def test_the_number_of_copies_does_not_matter(copies: int) -> None:
    """But for the order in which noise is drawn: here there is none."""
    agents = [collected(certain(rewound(Ends(7), n_actions=4, copies=n))) for n in (16, copies)]
    observations = agents[0].current_rollout().observations
    noise = torch.randn(16, 3, 1)
    samples = [agent.simulate(observations, noise=noise) for agent in agents]
    for ours, theirs in zip(*samples, strict=True):
        if ours is not None:
            torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)


# ---------------------------------------------------------------- the environment's own stream


class Record(BaseCallback):
    """Everything that the environments give."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[Any] = []

    def _on_step(self) -> bool:
        self.seen.append([np.array(self.locals[name]) for name in ("new_obs", "rewards", "dones", "actions")])
        return True


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: make_vec_env("CartPole-v1", 2, seed=5), id="CartPole"),
        pytest.param(lambda: VecNormalize(make_vec_env("Pendulum-v1", 1, seed=5)), id="Pendulum"),
        pytest.param(lambda: make_vec_env(lambda: OneHot(tabular(False)), 2, seed=5), id="tabular"),
    ],
)
def test_the_environments_stream_is_unchanged(make: Callable[[], Any]) -> None:
    """With a policy that is certain and does not learn, all that is real is the same, the normalisation included."""
    runs = []
    for n_actions in (1, 3):
        kwargs: dict[str, Any] = {} if n_actions == 1 else {"copies": 4, "horizon": 6}
        agent, record = certain(rewound(make(), n_actions=n_actions, learning_rate=0.0, **kwargs)), Record()
        agent.learn(48 * agent.n_envs, record)
        assert (agent.num_rewound_steps > 0) == (n_actions > 1)
        runs.append((record.seen, agent.num_timesteps))
    assert runs[0][1] == runs[1][1] and len(runs[0][0]) == 48
    for ours, theirs in zip(runs[0][0], runs[1][0], strict=True):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a, b)


def test_monitors_file_has_the_real_episodes_alone(tmp_path: Path) -> None:
    venv = make_vec_env("CartPole-v1", 1, seed=0, monitor_dir=str(tmp_path))
    agent = rewound(venv, n_actions=3).learn(64)
    lines = (tmp_path / "0.monitor.csv").read_text().splitlines()[2:]
    assert sum(int(line.split(",")[1]) for line in lines) <= 64 < agent.num_rewound_steps


def test_real_and_rewound_steps_are_logged_apart() -> None:
    agent = quiet(rewound(Ends(1_000), n_actions=2)).learn(32)
    logged = agent.logger.name_to_value
    assert (logged["rewound/steps"], logged["rewound/total_steps"]) == (136, 272)
    assert agent.num_timesteps == 32 and logged["simulation/n_simulated"] == 1


# ---------------------------------------------------------------- one action


@pytest.mark.parametrize("arguments", [{}, ACTOR_CRITIC])
def test_with_one_action_it_is_the_base_algorithm(arguments: dict[str, Any]) -> None:
    """Bit for bit; the actor-critic is PPO with one step a rollout."""

    def trained(cls: Any, **kwargs: Any) -> Any:
        common = {"n_steps": 16, "batch_size": 8, "n_epochs": 2, "normalize_advantage": False, "device": "cpu"}
        kwargs = {**common, **arguments, "policy_kwargs": {"net_arch": [8]}, **kwargs}
        return cls("MlpPolicy", make_vec_env("CartPole-v1", 1, seed=0), seed=3, **kwargs).learn(64)

    ours, theirs = trained(RewoundPPO, n_actions=1), trained(PPO)
    assert ours._n_updates == theirs._n_updates > 0 and not differing(state(ours), state(theirs))
    assert ours.num_rewound_steps == 0


def test_the_number_of_rewound_steps_is_saved(tmp_path: Path) -> None:
    agent = rewound().learn(32)
    agent.save(tmp_path / "m")
    loaded = RewoundPPO.load(tmp_path / "m", env=vec())
    assert loaded.num_rewound_steps == agent.num_rewound_steps > 0
    plain = RewoundPPO.load(tmp_path / "m", env=vec(), n_actions=1, copies=16).learn(16)
    assert plain.num_rewound_steps == agent.num_rewound_steps


def test_images(tmp_path: Path) -> None:
    """Any observations do that a policy takes: nothing is predicted."""
    venv = vec(obs_space=spaces.Box(0, 255, (36, 36, 3), np.uint8))
    agent = rewound(venv, policy="CnnPolicy", n_actions=2, n_steps=4, batch_size=4, copies=2, policy_kwargs={}).learn(8)
    assert agent.num_rewound_steps > 0
    space = spaces.Dict({"a": spaces.Box(-10, 10, (2,)), "b": spaces.Box(0, 9, (1,), np.int64)})
    rewound(VecNormalize(vec(obs_space=space), norm_obs_keys=["a"]), policy="MultiInputPolicy", n_actions=2).learn(16)


# ---------------------------------------------------------------- siblings


def test_a_sibling_shares_nothing_that_changes() -> None:
    env = Monitor(FrameStackObservation(OneHot(TimeLimit(tabular(False), 9)), 2))
    env.reset(seed=0)
    sibling = sibling_of(env)
    check_restorable(sibling, sibling_of(env))
    assert sibling.unwrapped is not env.unwrapped
    first = [env.step(0)[0].tolist() for _ in range(3)]
    env.reset(seed=0)
    sibling.reset(seed=1)
    for _ in range(5):
        sibling.step(1)
    assert [env.step(0)[0].tolist() for _ in range(3)] == first


class Noisy(gym.Wrapper):
    """Has a generator of its own, which starts with it, and keeps what it has drawn."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.rng, self.drawn = np.random.default_rng(0), []

    def step(self, action: Any) -> Any:
        observation, *rest = self.env.step(action)
        self.drawn.append(self.rng.normal())
        return observation + np.float32(self.drawn[-1]), *rest


def test_the_course_of_a_copied_wrapper_is_its_own() -> None:
    envs = [Noisy(Toy()), Noisy(Toy())]
    for n_actions, env in enumerate(envs, 1):
        rewound(env, n_actions=n_actions, n_steps=8, batch_size=8, copies=16).learn(8)
    assert len(envs[0].drawn) == 8 and envs[0].drawn == envs[1].drawn


class Shaped(gym.Wrapper):
    """Keeps methods, of its own and of the environment."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.t = 0
        self.bonus, self.inner = self.linear, functools.partial(env.step)

    def linear(self) -> float:
        return float(self.t)

    def step(self, action: Any) -> Any:
        self.t += 1
        observation, reward, *rest = self.inner(action)
        return observation, float(reward) + self.bonus(), *rest


def test_methods_of_a_copied_wrapper_are_its_own() -> None:
    env = Shaped(Ends(3))
    sibling: Any = sibling_of(env)
    assert sibling.bonus.__self__ is sibling and sibling.inner.func.__self__ is sibling.env is not env.env
    check_restorable(sibling, sibling_of(env))
    assert env.t == 0


def test_atari_states() -> None:
    """Sticky actions, which the console draws, and the stack of frames are restored bit by bit."""
    ale_py = pytest.importorskip("ale_py", reason="needs ale-py")
    from gymnasium.wrappers import GrayscaleObservation
    from stable_baselines3.common.atari_wrappers import EpisodicLifeEnv, MaxAndSkipEnv, NoopResetEnv

    gym.register_envs(ale_py)
    env = gym.make("ALE/Pong-v5", frameskip=1, repeat_action_probability=0.25, full_action_space=False)
    env = FrameStackObservation(GrayscaleObservation(EpisodicLifeEnv(MaxAndSkipEnv(NoopResetEnv(env), 4))), 4)
    sibling, other = sibling_of(env), sibling_of(env)
    check_restorable(sibling)
    check_restorable(sibling, other)
    agent = rewound(env, policy="CnnPolicy", n_steps=4, batch_size=4, copies=2, n_actions=2, policy_kwargs={}).learn(8)
    assert agent.num_rewound_steps == 2 * (4 + 3 + 2 + 1)
    state_of_pong = save_state(env)
    with pytest.raises(ValueError, match="only one of the two is Atari's"):
        restore_state(env, state_of_pong._replace(console=None))


# ---------------------------------------------------------------- at the door


class Hidden(gym.Env):
    """What comes next is in a place that nothing knows of."""

    def __init__(self) -> None:
        self.observation_space, self.action_space = spaces.Box(-9, 9, (1,), np.float32), spaces.Discrete(2)
        self._hidden = iter(functools.partial(next, iter(range(10**9))), None)

    def __deepcopy__(self, memo: Any) -> Any:
        return type(self)()

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.full(1, next(self._hidden) % 9, np.float32), 0.0, False, False, {}


class HoldsOn(gym.Wrapper):
    """Not made by recorded arguments, and with a way of its own to the environment."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.inner = env.unwrapped


class NoCopy(Ends):
    def __deepcopy__(self, memo: Any) -> Any:
        raise TypeError("cannot be copied")


class Bonus(gym.Wrapper):
    """Pays a bonus, which a callback raises."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.bonus = 0.0

    def step(self, action: Any) -> Any:
        observation, _, *rest = self.env.step(action)
        return observation, self.bonus, *rest


class Raises(BaseCallback):
    def _on_step(self) -> bool:
        self.training_env.set_attr("bonus", float(self.num_timesteps))
        return True


def test_states_are_saved_after_the_callback() -> None:
    agent = rewound(DummyVecEnv([lambda: Bonus(Toy())]), gamma=0.0, horizon=1, n_actions=2)
    samples = collected(agent, Raises()).simulate(agent.current_rollout().observations)
    assert samples.q_values.flatten().tolist() == list(range(agent.n_steps))


def test_environments_that_differ() -> None:
    """A function of a wrapper is no part of a state."""

    def make(scale: float) -> Any:
        return lambda: TransformReward(gym.make("CartPole-v1"), lambda reward: scale * reward)

    with pytest.raises(ValueError, match=r"made in the same way.* environment 1 .*n_actions=1 for plain PPO"):
        rewound(DummyVecEnv([make(1.0), make(100.0)]))
    rewound(DummyVecEnv([make(2.0), make(2.0)]))


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"n_actions": 0}, "n_actions must be an integer of at least 1, not 0"),
        ({"n_actions": 2.0}, "n_actions must be an integer of at least 1, not 2.0"),
        ({"horizon": 0}, "horizon must be an integer of at least 1, or None for the rollout's end, not 0"),
        ({"copies": 0}, "copies must be an integer of at least 1, not 0"),
        ({"sample_actions": "some"}, "sample_actions must be 'draw' or 'all', not 'some'"),
        ({"sample_actions": "all"}, "sample_actions='all' takes every action of a Discrete space.*'draw'"),
        ({"n_actions": 1, "horizon": 3}, "horizon=3 means nothing with n_actions=1.* -params n_actions:1 horizon:None"),
        ({"n_actions": 1, "copies": 3}, "copies=3 means nothing with n_actions=1"),
        ({"use_sde": True}, "use_sde=True .* pass n_actions=1"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], words: str) -> None:
    arguments = {"n_actions": 3, "device": "cpu", **kwargs}
    with pytest.raises(ValueError, match=words):
        RewoundPPO("MlpPolicy", vec(), **arguments)


def test_n_simulated_is_no_argument() -> None:
    with pytest.raises(TypeError, match="n_simulated"):
        RewoundPPO("MlpPolicy", vec(), n_simulated=3, device="cpu")  # type: ignore[call-arg]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Hidden(), "state can be saved and restored.* n_actions=1 for plain PPO"),
        (lambda: NoCopy(3), "can be made once more.*cannot be copied.* n_actions=1 for plain PPO"),
        (lambda: HoldsOn(Ends(3)), "HoldsOn holds on to the environment in its attribute 'inner'"),
        (lambda: VecFrameStack(vec(), 2), "VecFrameStack changes what the policy sees.*FrameStackObservation"),
        (lambda: gym.make("CartPole-v1", render_mode="human"), "render_mode='human'"),
        (
            lambda: RecordVideo(gym.make("CartPole-v1", render_mode="rgb_array"), "/tmp"),
            "a video is recorded.*leave RecordVideo out",
        ),
        (lambda: vec(action_space=spaces.MultiDiscrete([2, 3])), "must be a Box or Discrete.* n_actions=1"),
        (lambda: vec(obs_space=spaces.Discrete(3)), "the observation space must be a Box .* n_actions=1"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_environments_that_cannot_be_rewound(make: Callable[[], Any], words: str) -> None:
    env = make()
    with pytest.raises(ValueError, match=words):
        rewound(env)
    rewound(env, n_actions=1)


def test_environments_in_other_processes() -> None:
    venv = SubprocVecEnv([lambda: Toy()], start_method="fork")
    try:
        with pytest.raises(ValueError, match="pass a DummyVecEnv, not SubprocVecEnv, or n_actions=1"):
            rewound(venv)
        agent = rewound()
        with pytest.raises(ValueError, match="pass a DummyVecEnv, not SubprocVecEnv"):
            agent.set_env(venv)
    finally:
        venv.close()


def test_states_are_those_of_the_present_rollout() -> None:
    agent = rewound().learn(16)
    observations = agent.current_rollout().observations
    for others in (observations[:3], observations + 1):
        with pytest.raises(ValueError, match=r"pass model.current_rollout\(\).observations"):
            agent.simulate(others)
    assert agent.simulate(observations).q_values.shape == (16, 3)


def test_rewards_that_are_not_finite() -> None:
    venv = DummyVecEnv([lambda: Toy(poison=lambda total, obs, r: (obs, np.inf if total > 40 else r))])
    with pytest.raises(ValueError, match="not finite"):
        rewound(venv, n_actions=9, copies=1).learn(64)


@pytest.mark.slow
def test_it_is_exported_as_the_others(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    from tests.test_export import check, shake

    check(shake(rewound(n_actions=2)), tmp_path)


# ---------------------------------------------------------------- what the check at the start does not see


class Phase(enum.Enum):
    DAY = 0
    NIGHT = 1


@dataclasses.dataclass(slots=True)
class Cell:
    number: int


class Changing(gym.Env):
    """Pays 1 after step 50 of an episode, by an attribute of some kind; the actions change nothing."""

    def __init__(self, kind: str = "int"):
        self.observation_space, self.action_space = spaces.Box(-1, 1, (1,), np.float32), spaces.Discrete(2)
        self.kind = kind

    def _of(self, number: int) -> Any:
        return {
            "int": number, "enum": Phase(number), "frozenset": frozenset([number]), "list": [Phase(number)],
            "slots": Cell(number), "date": datetime.date(2000, 1, 1 + number),
        }[self.kind]  # fmt: skip

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.t, self.phase = 0, self._of(0)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.t += 1
        if self.t == 50:
            self.phase = self._of(1)
        return np.zeros(1, np.float32), float(self.phase == self._of(1)), False, self.t >= 100, {}


def rewards_and_further(make: Callable[[], gym.Env], n_steps: int = 100, n_actions: int = 2) -> tuple[Any, Any]:
    """Rewards of a rollout, and those of the further actions at its states, (n_steps, n_actions - 1)."""
    model = RewoundPPO(
        "MlpPolicy", DummyVecEnv([make]), n_actions=n_actions, horizon=1, gamma=0.0, n_steps=n_steps,
        batch_size=n_steps, n_epochs=1, policy_kwargs={"net_arch": [4]}, seed=0, device="cpu", copies=2,
        sample_actions="draw",
    ).learn(n_steps)  # fmt: skip
    rollout = model.current_rollout()
    found = model.simulate(rollout.observations, rollout.values, n_actions - 1).q_values
    return model.rollout_buffer.rewards.flatten(), found.numpy()


@pytest.mark.parametrize("kind", ["int", "enum", "frozenset", "list", "slots", "date"])
def test_attributes_of_every_kind_go_back(kind: str) -> None:
    real, further = rewards_and_further(lambda: Changing(kind))
    assert real.sum() == 51 and np.array_equal(real, further[:, 0])


class Late(Changing):
    """Gets its attribute in the midst of an episode."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        vars(self).pop("bonus", None)
        return super().reset(seed=seed)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        observation, _, *rest = super().step(action)
        if self.t == 50:
            self.bonus = 1.0
        return observation, getattr(self, "bonus", 0.0), *rest  # type: ignore[return-value]


def test_attributes_that_came_later_are_gone() -> None:
    env = Late()
    env.reset()
    state = save_state(env)
    assert sum(env.step(0)[1] for _ in range(60)) == 11
    restore_state(env, state)
    assert env.step(0)[1] == 0.0


class Closure(Changing):
    """Its reward is of a function that refers to the environment it was made by, in a copy too."""

    def __init__(self) -> None:
        super().__init__()
        self.t = 0
        self.paid = lambda: float(self.t)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        observation, _, *rest = super().step(action)
        return observation, self.paid(), *rest  # type: ignore[return-value]


class Views(Changing):
    """Observes an array that is a part of another one."""

    def __init__(self) -> None:
        super().__init__()
        self.whole = np.zeros(4, np.float32)
        self.part = self.whole[:1]

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.whole[:] = (self.whole + 0.01) % 1
        return self.part.copy(), *super().step(action)[1:]  # type: ignore[return-value]


@pytest.mark.parametrize(("make", "words"), [(Closure, "another reward"), (Views, "another observation")])
def test_copies_that_are_wrong_alike_are_seen_in_the_first_rollout(make: Any, words: str) -> None:
    with pytest.raises(ValueError, match=rf"environment 0 is not: after its state was restored.*{words}.*plain PPO"):
        rewards_and_further(make)


class Wind:
    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def normal(self) -> float:
        return float(self.rng.normal())


class Windy(Changing):
    """Pays noise of a generator that is kept in some place."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        if seed is not None or not hasattr(self, "wind"):
            self.wind: Any = {
                "attribute": lambda: np.random.default_rng(seed),
                "nested": lambda: Wind(seed or 0),
                "in a dict": lambda: {"a": [np.random.RandomState(seed)]},
                "legacy": lambda: np.random.RandomState(seed),
                "python": lambda: random.Random(seed),
            }[self.noise]()
        return super().reset(seed=seed)

    def __init__(self, noise: str) -> None:
        super().__init__()
        self.noise = noise

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        observation, _, *rest = super().step(action)
        wind = self.wind["a"][0] if self.noise == "in a dict" else self.wind
        drawn = wind.gauss(0, 1) if self.noise == "python" else wind.normal()
        return observation, float(drawn), *rest  # type: ignore[return-value]


@pytest.mark.parametrize("noise", ["attribute", "nested", "in a dict", "legacy", "python"])
def test_generators_draw_anew(noise: str) -> None:
    real, further = rewards_and_further(lambda: Windy(noise), n_steps=20, n_actions=3)
    assert len({*real, *further.flatten()}) == 60
    # Without a generator to seed them by they go on as they would have.
    env = Windy(noise)
    env.reset(seed=3)
    state = save_state(env)
    first = [env.step(0)[1] for _ in range(3)]
    restore_state(env, state)
    assert [env.step(0)[1] for _ in range(3)] == first
    # By the same one they draw the same.
    drawn = []
    for _ in range(2):
        restore_state(env, state, np.random.default_rng(5))
        drawn.append([env.step(0)[1] for _ in range(3)])
    assert drawn[0] == drawn[1] != first


def test_a_generator_of_two_attributes_stays_one() -> None:
    env = Windy("attribute")
    env.reset(seed=3)
    env.alias = {"of": env.wind}
    restore_state(env, save_state(env), np.random.default_rng(0))
    assert env.alias["of"] is env.wind


def test_seeds_are_those_of_spawned_generators_too() -> None:
    env = Windy("attribute")
    env.reset(seed=3)
    # As the generators of any environment, whatever Monitor keeps under that name.
    env.rewards = np.random.default_rng(1)
    state, drawn = save_state(env), []
    for seed in (0, 1):
        restore_state(env, state, np.random.default_rng(seed))
        drawn.append((env.rewards.random(), env.wind.spawn(1)[0].random()))
    assert drawn[0][0] != drawn[1][0] and drawn[0][1] != drawn[1][1]


def test_what_is_in_a_c_librarys_memory_is_no_state() -> None:
    env = Changing()
    env.reset()
    with socket.socket() as env.handle:
        assert "handle" not in save_state(env).layers[0]


class OwnArray(Changing):
    """Gives its own array as the observation, and changes it at the reset."""

    def __init__(self) -> None:
        super().__init__()
        self.own = np.zeros(1, np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.own[:] = 0
        return self.own, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        _, reward, _, _, info = super().step(action)
        self.own[:] = self.t / 100
        return self.own, reward, self.t >= 20, False, info


def test_an_environments_own_array_is_no_reason_to_stop() -> None:
    real, further = rewards_and_further(OwnArray)
    assert np.array_equal(real, further[:, 0])


def test_sticky_actions_are_no_reason_to_stop() -> None:
    """The console's state lacks the action that would be repeated."""
    pytest.importorskip("ale_py")
    model = RewoundPPO(
        "MlpPolicy", make_env("ALE/Pong-v5", obs_type="ram"), n_actions=2, horizon=1, n_steps=64, batch_size=64,
        n_epochs=1, copies=2, seed=1, device="cpu", policy_kwargs={"net_arch": [4]},
    )  # fmt: skip
    assert model.learn(64).num_rewound_steps == 64
