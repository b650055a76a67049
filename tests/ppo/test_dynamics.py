"""The learned models, what they learn from, and what is logged of them."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_sample import MBMAPPO, MBPOPPO, QMAPPO
from sb3_sample.faults import TrainingDiverged
from sb3_sample.ppo.dynamics import Dynamics, Standardizer, TransitionBuffer, Transitions
from sb3_sample.ppo.spaces import FlatObservations, ModelActions
from tests.ppo.common import ALGORITHMS, TrueModel, collected, linear_model, quiet, tiny
from tests.sac.common import Toy, vec


def numbered(first: int, n: int) -> Transitions:
    x = np.arange(first, first + n, dtype=np.float32)
    return Transitions(x[:, None], -x[:, None], x[:, None] + 1, 10 * x, 0 * x)


# ---------------------------------------------------------------- the buffer


def test_the_buffer_keeps_the_most_recent() -> None:
    buffer = TransitionBuffer(5, 1, 1)
    buffer.add(numbered(0, 3))
    assert buffer.size == 3 and buffer.recent(10).rewards.tolist() == [0, 10, 20]
    buffer.add(numbered(3, 4))
    assert buffer.size == 5 and buffer.recent(5).rewards.tolist() == [20, 30, 40, 50, 60]
    assert buffer.recent(2).observations.tolist() == [[5], [6]]
    buffer.add(numbered(7, 12))
    assert buffer.recent(5).rewards.tolist() == [140, 150, 160, 170, 180]
    rows = buffer.draw(4, 100)
    assert rows.shape == (4, 100)
    drawn = buffer.stored().take(rows.flatten())
    assert set(drawn.rewards.tolist()) == {140, 150, 160, 170, 180}
    np.testing.assert_array_equal(drawn.next_observations[:, 0], drawn.rewards / 10 + 1)


@pytest.mark.parametrize("capacity", [3, 5, 9])
def test_the_buffers_state_goes_into_one_of_another_capacity(capacity: int) -> None:
    buffer = TransitionBuffer(5, 1, 1)
    buffer.add(numbered(0, 7))
    other = TransitionBuffer(capacity, 1, 1)
    other.add(numbered(50, 2))
    other.load_state_dict(buffer.state_dict())
    assert other.recent(10).rewards.tolist() == [20, 30, 40, 50, 60][-capacity:]
    # What can be drawn are the transitions, and no empty rows.
    assert sorted(other.stored().rewards.tolist()) == [20, 30, 40, 50, 60][-capacity:]
    other.add(numbered(7, 1))
    assert other.recent(1).rewards.tolist() == [70]
    assert sorted(other.stored().rewards.tolist()) == [20, 30, 40, 50, 60, 70][-capacity:]


class Remember(BaseCallback):
    """Everything that the environments say."""

    def __init__(self) -> None:
        super().__init__()
        self.actions: list[Any] = []

    def _on_step(self) -> bool:
        self.actions.append(self.locals["actions"].copy())
        return True


@pytest.mark.parametrize("truncate", [False, True])
def test_transitions_are_the_environments(truncate: bool) -> None:
    """The toy's observation counts the steps of its episodes of seven, which the reward does too."""
    model = quiet(tiny(env=vec(2, truncate=truncate, action_space=spaces.Box(-0.5, 0.25, (2,)))))
    remember = Remember()
    model.learn(2 * 16, remember)
    kept = model.transitions.recent(1000)
    assert len(kept.rewards) == 32
    t = np.repeat(np.arange(16) % 7, 2)
    np.testing.assert_array_equal(kept.observations, np.repeat(t[:, None], 3, axis=1))
    np.testing.assert_array_equal(kept.next_observations, np.repeat(t[:, None] + 1, 3, axis=1))
    np.testing.assert_array_equal(kept.rewards, t + 1)  # without the value that PPO adds at a time limit
    np.testing.assert_array_equal(kept.terminations, (t == 6) & (not truncate))
    taken = np.concatenate(remember.actions)
    assert np.abs(taken).max() > 1
    np.testing.assert_allclose(kept.actions, (np.clip(taken, -0.5, 0.25) + 0.125) / 0.375, rtol=1e-5, atol=1e-6)


def test_transitions_are_normalised_when_they_are_used() -> None:
    env = VecNormalize(vec(2), clip_obs=50.0)
    model = quiet(tiny(env=env))
    model.learn(64)
    model.learn(32, reset_num_timesteps=False)
    kept = model.transitions.recent(1000)
    t = np.repeat(np.arange(32) % 7, 2)
    np.testing.assert_allclose(kept.observations[:64], np.repeat(t[:, None], 3, axis=1), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(kept.next_observations[:64], np.repeat(t[:, None] + 1, 3, axis=1), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(kept.rewards[:64], t + 1, rtol=1e-6)
    # A second learn goes on in the midst of an episode.
    np.testing.assert_allclose(kept.observations[64:66], kept.next_observations[62:64], rtol=1e-5, atol=1e-4)
    used = model._as_tensors(kept)
    np.testing.assert_allclose(used.observations, env.normalize_obs(kept.observations), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(used.next_observations, env.normalize_obs(kept.next_observations), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(used.rewards, env.normalize_reward(kept.rewards), rtol=1e-6)


def test_dict_observations() -> None:
    space = spaces.Dict({"b": spaces.Box(-10, 10, (2, 2), np.float64), "a": spaces.Box(-10, 10, (1,), np.float32)})
    for cls in ALGORITHMS:
        model = quiet(tiny(cls, vec(2, obs_space=space), "MultiInputPolicy")).learn(64)
        assert model.flat_observations.size == 5
        if cls is not QMAPPO:
            assert model.transitions.recent(1).observations.shape == (1, 5)
        model.predict(space.sample())
    env = VecNormalize(vec(2, obs_space=space), norm_obs_keys=["a"])
    quiet(tiny(env=env, policy="MultiInputPolicy")).learn(64)


def test_observations_there_and_back() -> None:
    space = spaces.Dict({"b": spaces.Box(-1, 1, (2, 3)), "a": spaces.Box(-1, 1, (1,))})
    codec = FlatObservations(space)
    batch = {key: np.stack([sub.sample() for _ in range(4)]) for key, sub in space.items()}
    flat = codec.flatten(batch)
    assert flat.shape == (4, 7)
    for there in (codec.restore(flat), codec.restore(torch.as_tensor(flat))):
        for key, values in batch.items():
            np.testing.assert_array_equal(there[key], values)


def test_actions_of_the_models() -> None:
    device = torch.device("cpu")
    box = ModelActions(spaces.Box(np.array([-2.0, 0.0, 3.0]), np.array([2.0, 1.0, 3.0]), dtype=np.float64), device)
    got = box(torch.tensor([[[1.0, 0.0, 3.0], [9.0, 0.5, 7.0]]]))
    assert got.tolist() == [[[0.5, -1.0, 0.0], [1.0, 0.0, 0.0]]]
    one_hot = ModelActions(spaces.Discrete(3), device)
    assert one_hot(torch.tensor([[0, 2]])).tolist() == [[[1, 0, 0], [0, 0, 1]]]


# ---------------------------------------------------------------- the networks


def test_two_networks_of_the_papers_size() -> None:
    model = Dynamics(17, 6)
    shapes = {name: tuple(p.shape) for name, p in model.named_parameters()}
    assert shapes["transition.0.layers.0.weight"] == shapes["reward.0.layers.0.weight"] == (1024, 23)
    assert shapes["transition.0.layers.2.weight"] == shapes["reward.0.layers.2.weight"] == (1024, 1024)
    assert shapes["transition.1.weight"] == (17, 1024) and shapes["reward.1.weight"] == (1, 1024)
    group = model.optimizer.param_groups[0]
    assert (group["lr"], group["eps"], group["weight_decay"]) == (3e-4, 1e-5, 0)
    assert Dynamics(17, 6, terminations=True).reward[-1].weight.shape == (2, 1024)


@pytest.mark.parametrize("normalize", [False, True])
def test_it_learns_a_linear_environment_with_ends(normalize: bool) -> None:
    torch.manual_seed(0)
    scale = torch.tensor([1.0, 100.0]) if normalize else torch.ones(2)
    observations, actions = torch.randn(2_000, 2) * scale, torch.rand(2_000, 1) * 2 - 1
    following = (observations / scale) @ torch.tensor([[0.9, -0.1], [0.2, 0.8]]) * scale + 5
    rewards = 3 + observations[:, 0] + actions[:, 0]
    ends = (observations[:, 0] > 1).float()
    data = Transitions(observations, actions, following, rewards, ends)
    model = Dynamics(2, 1, width=64, depth=1, learning_rate=3e-3, normalize=normalize, terminations=True)
    first = {name: loss.item() for name, loss in model.losses(data).items()}
    for _ in range(60):
        trained = model.fit(data, torch.randperm(2_000).view(20, 100))
    assert trained.keys() == first.keys() == {"transition_loss", "reward_loss", "termination_loss"}
    with torch.no_grad():
        prediction = model.predict(observations, actions)
    error = (prediction.next_observations - following) / following.std(dim=0)
    assert error.square().mean() < 0.01
    assert (prediction.rewards - rewards).square().mean() < 0.05
    assert prediction.continues is not None
    assert ((prediction.continues < 0.5) == (ends > 0.5)).float().mean() > 0.95
    if normalize:
        torch.testing.assert_close(model.observation_scale.mean, observations.mean(dim=0))


def test_standardizer() -> None:
    scale = Standardizer(2)
    x = torch.tensor([[1.0, 5.0], [3.0, 5.0]])
    torch.testing.assert_close(scale(x), x)
    scale.fit(x)
    torch.testing.assert_close(scale(x), torch.tensor([[-1.0, 0.0], [1.0, 0.0]]))
    torch.testing.assert_close(scale.inverse(scale(x)), x)


@pytest.mark.parametrize("epochs", [None, 3])
def test_the_model_takes_epochs_times_minibatches_steps(epochs: int | None) -> None:
    model = tiny(dynamics_kwargs={"width": 8, "epochs": epochs}, dynamics_batch_size=5, n_epochs=2, batch_size=8)
    seen = []
    losses = model.dynamics.losses
    model.dynamics.losses = lambda batch: (seen.append(len(batch.rewards)), losses(batch))[1]
    quiet(model).learn(16)
    assert seen[0] == 16  # the new transitions, before the training
    assert seen[1:] == [5] * (epochs or 2) * (16 // 8)


def test_the_q_networks_are_drawn_to_the_returns() -> None:
    model = collected(tiny(QMAPPO, n_steps=64, q_kwargs={"width": 32, "learning_rate": 3e-3, "epochs": 40}))
    rollout = model.current_rollout()
    model.fit_models()
    logged = model.logger.name_to_value
    assert logged["dynamics/train_q_loss"] < logged["dynamics/heldout_q_loss"]
    with torch.no_grad():
        q = model.q_networks(rollout.observations, model.model_actions(rollout.actions))
    # The mean return of each step of the toy's episode is all that there is to learn.
    for loss in (q - rollout.returns).square().mean(dim=1):
        assert loss < 0.5 * rollout.returns.var()
    assert not torch.equal(q[0], q[1])


def test_the_models_are_trained_while_the_number_rises_and_not_after_it_has_fallen() -> None:
    def fits(**kwargs: Any) -> list[float]:
        model = tiny(n_steps=10, batch_size=10, **kwargs)
        seen = []
        model.fit_models = lambda: seen.append(model._progress)
        model.simulate = lambda *args: None
        model._update_policy = lambda *args: None
        model.learn(50)
        return seen

    assert fits(anneal_until=0.5) == [0.0, 0.2, 0.4]
    assert fits(warm_up_until=0.5) == [0.0, 0.2, 0.4, 0.6, 0.8]


class Ends(gym.Env):
    """The observation walks to the right and the episode terminates beyond 1, as in Hopper a fall ends it."""

    observation_space = spaces.Box(-10, 10, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x = float(self.np_random.uniform(-1, 1))
        return np.array([self.x], np.float32), {}

    def step(self, action: np.ndarray) -> Any:
        self.x += 0.3
        return np.array([self.x], np.float32), 1.0, self.x > 1, False, {}


def test_ends_are_learned_and_the_return_is_cut_there() -> None:
    model = tiny(
        env=Ends(), n_steps=256, batch_size=32, n_epochs=20, gae_lambda=1.0, gamma=1.0, simulation_horizon=8,
        dynamics_kwargs={"width": 64, "learning_rate": 3e-3}, dynamics_buffer_size=10_000,
    )  # fmt: skip
    assert model.predict_termination is True
    quiet(model).learn(1024)
    with torch.no_grad():
        model.policy.value_net.weight.zero_()
        model.policy.value_net.bias.zero_()
    starts = torch.tensor([[0.9], [0.55], [0.25], [-0.95]])
    q = model.simulate(starts, n_simulated=4).q_values.mean(dim=1)
    # One reward for each step until beyond 1.
    np.testing.assert_allclose(q, [1, 2, 3, 7], atol=0.5)


def test_an_environment_can_say_that_it_never_terminates() -> None:
    class Endless(Toy):
        never_terminates = True

    assert tiny(env=Endless(truncate=True)).predict_termination is False
    assert tiny(env=DummyVecEnv([Endless, Toy])).predict_termination is True


def test_terminations_that_are_not_predicted_are_warned_of_once() -> None:
    """A wrapper ends episodes of an environment that says that it never does."""

    class Endless(Toy):
        never_terminates = True

    model = quiet(tiny(env=Endless()))  # it terminates
    assert model.predict_termination is False
    with pytest.warns(UserWarning, match="predict_termination=False, and episodes have terminated") as warned:
        model.learn(96)
    assert sum("predict_termination" in str(each.message) for each in warned) == 1 and model.transitions.size > 32
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        quiet(tiny(env=Endless(truncate=True))).learn(32)


def test_subprocesses() -> None:
    env = SubprocVecEnv([Toy, Toy], start_method="fork")
    model = quiet(tiny(env=env)).learn(32)
    assert model.predict_termination is True and model.transitions.size == 32
    env.close()


def test_the_default_of_termination() -> None:
    assert tiny(env="Pendulum-v1").predict_termination is True
    assert tiny(MBPOPPO, env="Pendulum-v1", predict_termination=False).predict_termination is False
    pytest.importorskip("dm_control")
    agent = tiny(env="dmc/pendulum-swingup-v0")
    assert agent.predict_termination is False
    assert agent.dynamics.predict(torch.zeros(2, 3), torch.zeros(2, 1)).continues is None
    assert tiny(env="dmc/pendulum-swingup-v0", predict_termination=True).predict_termination is True


# ---------------------------------------------------------------- what is logged


def test_what_is_logged() -> None:
    expected = {"simulation/n_simulated", "simulation/share", "time/collect_seconds", "time/dynamics_seconds",
                "time/simulate_seconds", "time/policy_seconds"}  # fmt: skip
    models = {f"dynamics/{part}_{loss}_loss" for part in ("train", "heldout") for loss in ("transition", "reward")}
    ends = {"dynamics/train_termination_loss", "dynamics/heldout_termination_loss"}
    errors = {f"simulation/return_error_{h}" for h in (1, 2, 4)}
    for cls in ALGORITHMS:
        model = quiet(tiny(cls)).learn(16)
        logged = model.logger.name_to_value
        assert expected <= logged.keys()
        assert logged["simulation/share"] == 0.75
        if cls is QMAPPO:
            assert {"dynamics/train_q_loss", "dynamics/heldout_q_loss"} <= logged.keys()
        else:
            assert models | ends | errors | {"dynamics/buffer_size"} <= logged.keys()
    without = quiet(MBMAPPO("MlpPolicy", vec(), n_simulated=0, n_steps=16, batch_size=8, device="cpu")).learn(16)
    assert {
        name for name in without.logger.name_to_value if name.startswith(("time/", "simulation/", "dynamics/"))
    } == {
        "time/collect_seconds",
        "time/policy_seconds",
    }


def test_the_error_of_the_return_is_zero_with_the_true_model_and_what_it_should_be_with_a_wrong_one() -> None:
    for wrong, expected in ((0.0, [0, 0, 0]), (1.0, [1, 1.9, 1 + 0.9 + 0.81 + 0.729])):
        agent = linear_model(bound=64.0, simulation_horizon=4, n_steps=32)
        collected(agent)
        model = TrueModel()
        predict = model.predict
        model.predict = lambda *args, p=predict, w=wrong: p(*args)._replace(rewards=p(*args).rewards + w)
        agent.dynamics = model
        agent._compare_returns()
        got = [agent.logger.name_to_value[f"simulation/return_error_{h}"] for h in (1, 2, 4)]
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("length", [1, 2, 3])
def test_short_episodes_are_compared_as_far_as_they_go(length: int) -> None:
    model = quiet(tiny(env=vec(2, length=length))).learn(32)
    logged = {int(name.split("_")[-1]) for name in model.logger.name_to_value if "return_error" in name}
    # The step that ends an episode is left out.
    assert logged == {h for h in (1, 2, 4) if h < length}


def test_the_error_is_measured_before_the_model_has_seen_the_rollout() -> None:
    model = tiny()
    order = []
    model._compare_returns = lambda: order.append("compare")
    fit = model.dynamics.fit
    model.dynamics.fit = lambda *args: (order.append("fit"), fit(*args))[1]
    quiet(model).learn(32)
    assert order == ["compare", "fit"] * 2


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_a_callback_can_train_the_models_and_simulate_at_the_end_of_a_rollout(cls: Any) -> None:
    class Extra(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            model: Any = self.model
            rollout = model.current_rollout()
            model.fit_models()
            sizes.append(None if cls is QMAPPO else model.transitions.size)
            shapes.append(model.simulate(rollout.observations, rollout.values, n_simulated=2).q_values.shape)

    sizes: list[Any] = []
    shapes: list[Any] = []
    quiet(tiny(cls)).learn(48, Extra())
    assert shapes == [(16, 2)] * 3
    assert sizes == [None] * 3 if cls is QMAPPO else sizes == [16, 32, 48]


def test_the_first_losses_are_measured_by_a_scale() -> None:
    """By the scale of the rewards, 1,000, and not in their units."""

    def large(total: int, observation: Any, reward: float) -> Any:
        return observation, 1000 * reward

    model = quiet(tiny(env=Toy(poison=large))).learn(16)
    logged = model.logger.name_to_value
    assert logged["dynamics/heldout_reward_loss"] < 10
    assert model.dynamics.reward_scale.std.item() > 100


@pytest.mark.parametrize("seed", range(4))
def test_however_it_diverges_it_is_a_divergence(seed: int) -> None:
    with pytest.raises(TrainingDiverged):
        tiny(learning_rate=1e12, seed=seed).learn(64)


@pytest.mark.usefixtures("checks_of_distributions")
def test_a_standard_deviation_of_zero_is_a_divergence() -> None:
    model = collected(tiny())
    with torch.no_grad():
        model.policy.log_std[1] = -1e6
    with pytest.raises(TrainingDiverged, match="the policy's standard deviation is 0.0 at update 0"):
        model.train()


@pytest.mark.parametrize("n_simulated", [0, 2])
def test_a_callbacks_own_entries_are_no_losses(n_simulated: int) -> None:
    """With a log_interval above 1 they are still in the logger when the iteration is checked."""

    class Records(BaseCallback):
        def _on_rollout_end(self) -> None:
            self.logger.record("train/return", float("nan"))
            self.logger.record("train/comment", "text")

        def _on_step(self) -> bool:
            return True

    kwargs = {"dynamics_kwargs": None, "simulation_horizon": 12, "dynamics_buffer_size": 25_000, "warm_up_until": None}
    model = quiet(tiny(n_simulated=n_simulated, **({} if n_simulated else kwargs)))
    model.learn(64, Records(), log_interval=10)
    assert np.isnan(model.logger.name_to_value["train/return"])
    model._train = lambda: model.logger.record("train/loss", float("nan"))
    with pytest.raises(TrainingDiverged, match="train/loss"):
        model.learn(16, Records(), log_interval=10)


def test_a_callback_that_stops_the_training() -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return self.n_calls < 5

    model = quiet(tiny())
    model.learn(64, Stop())
    assert model.num_timesteps == 5 and model.transitions.size == 5
    model.learn(16, reset_num_timesteps=False)


def test_a_toy_that_gives_nan_is_stopped() -> None:
    def poison(total: int, observation: Any, reward: float) -> Any:
        return (observation * np.nan if total == 9 else observation), reward

    with pytest.raises(ValueError, match="not finite"):
        tiny(env=Toy(poison=poison)).learn(16)
