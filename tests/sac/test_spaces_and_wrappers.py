"""What Stable-Baselines3's users combine: spaces, wrappers, buffers, callbacks, schedules."""

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_sample import DeviceReplayBuffer, evaluate_tasks
from sb3_sample.replay.compact import CompactReplayBuffer
from sb3_sample.sac import SAC
from sb3_sample.sac.features import _preprocessed
from tests.sac.common import MAKERS, TINY_SAC, Toy, bro, differing, random_batch, sac, state, vec

BOX = spaces.Box(-10, 10, (3,), np.float32)
DICT = spaces.Dict({"a": BOX, "b": spaces.Box(-5, 5, (2, 2), np.float64)})
DICT_WITH_INTEGER = spaces.Dict({**DICT.spaces, "c": spaces.Discrete(4)})
IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)


def is_finite(model: SAC) -> bool:
    return all(bool(torch.isfinite(value).all()) for value in model.policy.state_dict().values())


def check_trains(model: SAC, n: int = 40) -> SAC:
    """It learns, stays finite, and predicts actions of the space with and without a batch axis."""
    model.learn(n)
    assert model._n_updates > 0 and is_finite(model)
    env = model.get_env()
    assert env is not None
    observation = env.reset()
    action, _ = model.predict(observation, deterministic=True)
    assert action.shape == (env.num_envs, *model.action_space.shape)
    assert np.isfinite(action).all()
    single = {k: v[0] for k, v in observation.items()} if isinstance(observation, dict) else observation[0]
    action, _ = model.predict(single)
    assert action.shape == model.action_space.shape
    return model


# ---------------------------------------------------------------- observation spaces


@pytest.mark.parametrize("truncate", [True, False])
@pytest.mark.parametrize("space", [DICT, DICT_WITH_INTEGER], ids=["boxes", "integer"])
@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_dict_observations(maker: str, space: spaces.Dict, truncate: bool, tmp_path: Path) -> None:
    model = check_trains(MAKERS[maker](vec(2, obs_space=space, truncate=truncate), policy="MultiInputPolicy"))
    model.save(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m", env=vec(2, obs_space=space))
    observation = space.sample()
    np.testing.assert_array_equal(
        model.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0]
    )


@pytest.mark.parametrize("space", [spaces.Discrete(5), spaces.Box(-10, 10, (3,), np.float64),
                                   spaces.Box(-10, 10, (2, 3), np.float32)])  # fmt: skip
@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_other_observations(maker: str, space: spaces.Space) -> None:
    """Discrete ones come as Python's integers, also at the end of an episode."""
    check_trains(MAKERS[maker](vec(2, obs_space=space)))


@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_images(maker: str) -> None:
    kwargs: dict[str, Any] = {"features_extractor_kwargs": {"features_dim": 8}}
    if maker == "SAC":
        kwargs["net_arch"] = [8]
    else:
        kwargs["actor_network_kwargs"] = {"width": 8, "n_blocks": 1}
    model = MAKERS[maker](
        vec(obs_space=IMAGE), policy="CnnPolicy", policy_kwargs=kwargs, buffer_size=50, learning_rate=1e-3
    )
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    check_trains(model, 20)
    assert model.replay_buffer.observations.dtype == np.uint8
    for name, value in model.policy.state_dict().items():
        assert not torch.equal(value, before[name]), f"{name} does not learn"


class BatchNormExtractor(FlattenExtractor):
    """A features extractor with running statistics."""

    def __init__(self, observation_space: spaces.Space):
        super().__init__(observation_space)
        self.norm = torch.nn.BatchNorm1d(self.features_dim)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return self.norm(super().forward(observations))


@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_running_statistics_of_an_extractor(maker: str) -> None:
    """Only gradient steps change them, and the targets get the critics' own, however small tau is."""
    kwargs: dict[str, Any] = {"features_extractor_class": BatchNormExtractor}
    if maker == "SAC":
        kwargs["net_arch"] = [8]
    # The actor's step comes after the targets', and passes through the critics again: the last step shall have none.
    every = dict(policy_delay=2, target_update_interval=1, replay_ratio=1)
    model = MAKERS[maker](tau=1e-30, policy_kwargs=kwargs, **every)

    def norms() -> list[torch.nn.BatchNorm1d]:
        return [m.features_extractor.norm for m in (model.actor, model.critic, model.critic_target)]

    def running() -> list[torch.Tensor]:
        return [statistic.clone() for norm in norms() for statistic in (norm.running_mean, norm.running_var)]

    first, weight = running(), norms()[2].weight.clone()
    model.learn(10)  # All of it warm-up.
    model.predict(np.ones((5, 3), np.float32))
    assert all(map(torch.equal, running(), first))
    model.learn(41)
    assert model._n_updates == 41
    last = running()
    assert not any(map(torch.equal, last, first))
    assert all(map(torch.equal, last[2:4], last[4:6]))
    assert torch.equal(norms()[2].weight, weight) and not torch.equal(norms()[1].weight, weight)
    model.predict(np.ones((5, 3), np.float32))
    assert all(map(torch.equal, running(), last))


# ---------------------------------------------------------------- action spaces

ASYMMETRIC = spaces.Box(np.array([-0.1, 2.0, -7.3], np.float32), np.array([0.3, 2.7, -0.7], np.float32))


ACTION_SPACES = [
    ASYMMETRIC,
    spaces.Box(-2, 2, (1,), np.float32),
    spaces.Box(-1, 1, (2, 2), np.float32),
    spaces.Box(-3.0, 1.7, (2,), np.float64),
]


@pytest.mark.parametrize("bias", [40, *(pytest.param(bias, marks=pytest.mark.slow) for bias in (-40, 0))])
@pytest.mark.parametrize("space", ACTION_SPACES)
@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_actions_within_bounds(maker: str, space: spaces.Box, bias: float) -> None:
    """The environment gets actions within its bounds, to the last bit, the buffer the same ones in [-1, 1]."""
    env = vec(action_space=space)
    model = MAKERS[maker](env)
    # A saturated actor reaches the bounds themselves.
    with torch.no_grad():
        model.actor.mean.bias.fill_(bias)
    model.learn(40)
    received = np.array(env.envs[0].unwrapped.actions)
    assert received.shape == (40, *space.shape)
    excess = np.maximum(received - space.high, space.low - received).max()
    assert excess <= 0, f"out of bounds by {excess}"
    stored = model.replay_buffer.actions[:40].reshape(received.shape)
    assert np.abs(stored).max() <= 1
    # The random warm-up uses the whole range.
    assert np.ptp(stored[:10]) > 0.5
    rescaled = 2 * (received - space.low) / (space.high - space.low) - 1
    np.testing.assert_allclose(stored, rescaled, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("bias", [40, -40, 0])
@pytest.mark.parametrize("space", ACTION_SPACES)
def test_predictions_within_bounds(space: spaces.Box, bias: float) -> None:
    model = sac(vec(action_space=space))
    with torch.no_grad():
        model.actor.mean.bias.fill_(bias)
    actions, _ = model.predict(np.zeros((5, 3), np.float32), deterministic=True)
    assert actions.shape == (5, *space.shape)
    excess = np.maximum(actions - space.high, space.low - actions).max()
    assert excess <= 0, f"out of bounds by {excess}"


def test_action_noise() -> None:
    for noise in (NormalActionNoise(np.zeros(2), np.full(2, 5.0)),
                  OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2))):  # fmt: skip
        for n_envs in (1, 3):
            env = vec(n_envs, action_space=spaces.Box(-2, 2, (2,)))
            model = check_trains(bro(env, action_noise=noise))
            received = np.array(env.envs[0].unwrapped.actions)
            assert np.abs(received).max() <= 2
            assert np.abs(model.replay_buffer.actions).max() <= 1
    # A large noise drives actions to the bounds.
    assert (np.abs(received) == 2).any()


# ---------------------------------------------------------------- vectorised environments


def test_subprocesses() -> None:
    env = SubprocVecEnv([lambda: Monitor(Toy()) for _ in range(2)], start_method="fork")
    try:
        check_trains(bro(env))
    finally:
        env.close()


@pytest.mark.parametrize("shape", [(3, 36, 36), (8,)])
def test_integers_of_subprocesses(shape: tuple[int, ...]) -> None:
    """A worker does not survive the question for an attribute that its environment lacks."""
    space = spaces.Box(0, 255, shape, np.uint8)
    env = SubprocVecEnv([lambda: Monitor(Toy(obs_space=space))], start_method="fork")
    try:
        check_trains(sac(env))
        with pytest.raises(ValueError, match="env must be of multi_task_env"):
            evaluate_tasks(sac(env), env)
    finally:
        env.close()


def test_noise_of_another_number_of_environments(tmp_path: Path) -> None:
    noise = NormalActionNoise(np.zeros(2), np.full(2, 0.1))
    for n_envs, other in ((3, 2), (3, 1), (1, 2), (2, 2)):
        sac(vec(n_envs), action_noise=noise).learn(24).save(tmp_path / "m")
        check_trains(SAC.load(tmp_path / "m", env=vec(other)))


@pytest.mark.parametrize(
    ("space", "plain"),
    [
        (spaces.Discrete(5, start=10), spaces.Discrete(5)),
        (spaces.MultiDiscrete([3, 4], start=[-1, 2]), spaces.MultiDiscrete([3, 4])),
    ],
)
def test_numbers_that_do_not_count_from_0(space: Any, plain: Any) -> None:
    first = torch.as_tensor(np.atleast_1d(space.start))
    numbers = torch.as_tensor(np.stack([np.atleast_1d(plain.sample()) for _ in range(6)]))
    given = (numbers + first, numbers)
    if isinstance(space, spaces.Discrete):
        given = (given[0][:, 0], given[1][:, 0])
    shifted, expected = (_preprocessed(x, of, True) for x, of in zip(given, (space, plain), strict=True))
    assert torch.equal(shifted, expected) and (expected.sum(dim=1) == len(first)).all()


def test_plain_environment_and_id() -> None:
    check_trains(bro(Toy()))
    check_trains(bro("Pendulum-v1"), 20)


def test_vec_wrappers() -> None:
    plain = [lambda: Toy() for _ in range(2)]
    check_trains(bro(VecMonitor(DummyVecEnv(plain))))
    check_trains(bro(VecFrameStack(vec(2), 3)))
    check_trains(bro(VecNormalize(VecFrameStack(vec(2), 3))))


@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_vec_normalize(maker: str) -> None:
    env = VecNormalize(vec(2), gamma=0.99)
    model = check_trains(MAKERS[maker](env))
    assert model.get_vec_normalize_env() is env
    # The buffer holds the environment's own numbers: Toy's rewards count 1, 2, ..., 7 along the episode.
    rewards = model.replay_buffer.rewards[: model.replay_buffer.pos]
    assert set(np.unique(rewards)) == set(range(1, 8))
    assert set(np.unique(model.replay_buffer.observations[:20])) == set(range(7))
    # A sampled batch is normalised with today's statistics.
    batches = []
    update = model._update
    model._update = lambda batch, *args: batches.append(batch) or update(batch, *args)  # type: ignore[method-assign]
    env.obs_rms.mean[:] = 1000.0
    env.obs_rms.var[:] = 1.0
    env.ret_rms.var = np.array(16.0)
    model.train(1, 64)
    assert batches[0].observations.max() <= -9.99, "clipped at -10"
    np.testing.assert_allclose(batches[0].rewards.unique(), np.arange(1, 8) / 4, rtol=1e-4)
    evaluation = VecNormalize(vec(1), training=False)
    assert np.isfinite(evaluate_policy(model, evaluation, 2, warn=False)[0])


def test_vec_normalize_saved_and_loaded(tmp_path: Path) -> None:
    env = VecNormalize(vec(2))
    model = bro(env).learn(30)
    model.save(tmp_path / "m")
    env.save(str(tmp_path / "vn"))
    restored = VecNormalize.load(str(tmp_path / "vn"), vec(2))
    np.testing.assert_array_equal(restored.obs_rms.mean, env.obs_rms.mean)
    loaded = type(model).load(tmp_path / "m", env=restored)
    assert loaded.get_vec_normalize_env() is restored
    loaded.learn(30)


def test_set_env() -> None:
    model = bro(vec(2)).learn(30)
    model.set_env(vec(2))
    check_trains(model)
    with pytest.raises(AssertionError):
        model.set_env(vec(3))
    with pytest.raises(ValueError, match="[Ss]paces"):
        model.set_env(vec(2, action_space=spaces.Box(-1, 1, (5,))))


# ---------------------------------------------------------------- replay buffers


class Random(Toy):
    """Begins at random numbers."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        observation, info = super().reset(seed=seed)
        return observation + np.float32(self.np_random.normal()), info


def test_a_first_environment_is_that_of_the_constructor(tmp_path: Path) -> None:
    """Seeded, known to the replay buffer, and asked for its frames."""
    model = sac(Random()).learn(30)
    later = SAC("MlpPolicy", None, seed=0, **TINY_SAC)
    later.set_env(Random())
    later.learn(30)
    assert not differing(state(model), state(later))
    sac(Random()).save(tmp_path / "m")
    loaded, there = SAC.load(tmp_path / "m"), SAC.load(tmp_path / "m", env=Random())
    loaded.set_env(Random())
    np.testing.assert_array_equal(loaded.get_env().reset(), there.get_env().reset())
    her = SAC("MultiInputPolicy", None, replay_buffer_class=HerReplayBuffer, **{**TINY_SAC, "learning_starts": 20})
    her.set_env(Reach())
    assert her.learn(30)._n_updates > 0


def test_a_buffer_on_the_device_refuses_normalization_that_comes_later() -> None:
    model = sac(replay_buffer_class=DeviceReplayBuffer, replay_buffer_kwargs={"sampling": "device"})
    before = model.get_env()
    with pytest.raises(ValueError, match="DeviceReplayBuffer cannot be combined with VecNormalize"):
        model.set_env(VecNormalize(vec()))
    assert model.get_env() is before


def test_n_step_returns() -> None:
    model = bro(n_steps=3, gamma=0.5)
    batches = []
    update = model._update
    model._update = lambda batch, *args: batches.append(batch) or update(batch, *args)  # type: ignore[method-assign]
    check_trains(model)
    batch = batches[-1]
    # After step t the rewards t + 1, t + 2, t + 3 are discounted by 1, 1/2, 1/4, up to the end at 7.
    t = batch.observations[:, 0]
    for i, start in enumerate(t.int().tolist()):
        steps = [s for s in (start + 1, start + 2, start + 3) if s <= 7]
        full = sum(s * 0.5**k for k, s in enumerate(steps))
        # The youngest transitions may have fewer steps yet.
        options = [sum(s * 0.5**k for k, s in enumerate(steps[:m])) for m in range(1, len(steps) + 1)]
        assert batch.rewards[i].item() == pytest.approx(full) or any(
            batch.rewards[i].item() == pytest.approx(option) for option in options
        )
        n = int(batch.next_observations[i, 0].item()) - start
        assert torch.as_tensor(batch.discounts)[i].item() == pytest.approx(0.5**n) or batch.dones[i]


def test_optimize_memory_usage() -> None:
    """The default buffer does it anyway; Stable-Baselines3's own is used where it is named."""
    for value in (True, False):
        model = bro(optimize_memory_usage=value)
        check_trains(model)
        assert type(model.replay_buffer) is CompactReplayBuffer
        assert model.replay_buffer.handle_timeout_termination
    model = bro(
        optimize_memory_usage=True,
        replay_buffer_class=ReplayBuffer,
        replay_buffer_kwargs={"handle_timeout_termination": False},
    )
    check_trains(model)
    assert type(model.replay_buffer) is ReplayBuffer and not hasattr(model.replay_buffer, "next_observations")


@pytest.mark.parametrize("truncate", [True, False])
def test_only_termination_stops_the_bootstrap(truncate: bool) -> None:
    model = bro(vec(truncate=truncate))
    batches = []
    update = model._update
    model._update = lambda batch, *args: batches.append(batch) or update(batch, *args)  # type: ignore[method-assign]
    model.learn(60)
    ends = [batch.dones[batch.next_observations[:, 0] == 7] for batch in batches]
    values = torch.cat(ends)
    assert len(values) > 0 and (values == (0.0 if truncate else 1.0)).all()
    # The next observation of an ended episode is its last one, not the first of the next.
    assert all((b.next_observations[:, 0] == b.observations[:, 0] + 1).all() for b in batches)


class Reach(gym.Env):
    """A goal environment: the achieved goal is the step's number, the desired one is always -1."""

    def __init__(self) -> None:
        goal = spaces.Box(-100, 100, (1,), np.float32)
        self.observation_space = spaces.Dict({"observation": goal, "achieved_goal": goal, "desired_goal": goal})
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.t = 0

    def observation(self) -> dict[str, np.ndarray]:
        now = np.array([self.t], np.float32)
        return {"observation": now, "achieved_goal": now, "desired_goal": np.array([-1], np.float32)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self.observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.t += 1
        return self.observation(), -1.0, False, self.t >= 10, {}

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        return np.where(np.abs(achieved_goal - desired_goal).max(axis=-1) < 0.5, 0.0, -1.0)


@pytest.mark.parametrize("replay_ratio", [1, 10])
def test_hindsight_is_mixed_into_every_batch(replay_ratio: int) -> None:
    """Every gradient step sees real and relabelled goals in the buffer's proportion, 1 : 4."""
    model = sac(
        Reach(), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, learning_starts=20, batch_size=50,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"}, replay_ratio=replay_ratio,
    )  # fmt: skip
    real = []
    update = model._update

    def record(batch: Any, *args: Any) -> Any:
        real.append((batch.observations["desired_goal"] == -1).float().mean().item())
        return update(batch, *args)

    model._update = record  # type: ignore[method-assign]
    model.learn(30)
    assert len(real) == 10 * replay_ratio
    assert np.mean(real) == pytest.approx(0.2, abs=0.03)
    assert min(real) > 0 and max(real) < 0.6, f"share of real goals by batch: {np.round(real, 2)}"


def test_her_on_fetch_reach() -> None:
    robotics = pytest.importorskip("gymnasium_robotics", reason="needs gymnasium-robotics (extra robotics)")
    gym.register_envs(robotics)
    ids = [i for i in ("FetchReach-v4", "FetchReach-v3", "FetchReach-v2") if i in gym.registry]
    assert ids
    env = DummyVecEnv([lambda: Monitor(gym.make(ids[0]))])
    model = bro(
        env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, learning_starts=60, buffer_size=200,
        replay_buffer_kwargs={"n_sampled_goal": 4}, replay_ratio=2,
    )  # fmt: skip
    check_trains(model, 120)
    assert model._n_updates == 120
    env.close()


# ---------------------------------------------------------------- callbacks and logs


def test_callbacks(tmp_path: Path) -> None:
    evaluation = EvalCallback(
        vec(1), best_model_save_path=str(tmp_path), log_path=str(tmp_path), eval_freq=10, n_eval_episodes=2, verbose=0
    )
    checkpoint = CheckpointCallback(15, str(tmp_path), "check", save_replay_buffer=True)
    model = bro(vec(1)).learn(40, callback=CallbackList([evaluation, checkpoint]))
    assert (tmp_path / "best_model.zip").exists()
    assert len(np.load(tmp_path / "evaluations.npz")["timesteps"]) == 4
    assert (tmp_path / "check_30_steps.zip").exists()
    loaded = type(model).load(tmp_path / "check_30_steps", env=vec(1))
    assert loaded.num_timesteps == 30
    # Toy's return is 1 + 2 + ... + 7.
    assert evaluation.last_mean_reward == pytest.approx(28)


def test_eval_callback_does_not_warn() -> None:
    """Both environments are wrapped in the same way by the user; the check within is not the user's business."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="Training and eval env")
        bro(vec(1)).learn(20, callback=EvalCallback(vec(1), eval_freq=10, verbose=0))


def test_eval_callback_with_vec_normalize() -> None:
    """The callback carries the statistics from the training to the evaluation environment."""
    train, evaluation = VecNormalize(vec(1)), VecNormalize(vec(1), training=False)
    bro(train).learn(20, callback=EvalCallback(evaluation, eval_freq=10, verbose=0))
    np.testing.assert_allclose(evaluation.obs_rms.mean, train.obs_rms.mean, rtol=0.2)


def test_stop_callbacks() -> None:
    model = bro(vec(1)).learn(1000, callback=StopTrainingOnMaxEpisodes(3))
    assert model.num_timesteps == 21
    stop = EvalCallback(vec(1), callback_on_new_best=StopTrainingOnRewardThreshold(20), eval_freq=15, verbose=0)
    assert bro(vec(1)).learn(1000, callback=stop).num_timesteps == 15
    model = bro(vec(1))
    model.learn(1000, callback=lambda *_: model.num_timesteps < 17)
    assert model.num_timesteps == 17
    model.learn(20)


def test_callback_events() -> None:
    class Events(BaseCallback):
        def __init__(self) -> None:
            super().__init__()
            self.events: list[str] = []

        def _on_training_start(self) -> None:
            self.events.append("start")

        def _on_rollout_start(self) -> None:
            self.events.append("rollout")

        def _on_step(self) -> bool:
            self.events.append("step")
            assert {"infos", "rewards", "dones", "new_obs"} <= self.locals.keys()
            return True

        def _on_rollout_end(self) -> None:
            self.events.append("end")

        def _on_training_end(self) -> None:
            self.events.append("stop")

    events = Events()
    bro().learn(2, callback=events)
    assert events.events == ["start", *["rollout", "step", "end"] * 2, "stop"]


def test_tensorboard(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="needs tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    model = bro(tensorboard_log=str(tmp_path)).learn(60, log_interval=1)
    model.learn(30, log_interval=1, tb_log_name="mine", reset_num_timesteps=False)
    assert {path.name.rsplit("_", 1)[0] for path in tmp_path.iterdir()} == {"BRO", "mine"}
    events = EventAccumulator(str(tmp_path / "BRO_1"))
    events.Reload()
    tags = set(events.Tags()["scalars"])
    assert {
        "rollout/ep_rew_mean", "train/critic_loss", "train/actor_loss", "train/ent_coef", "train/ent_coef_loss",
        "train/learning_rate", "exploration/optimism", "exploration/kl", "plasticity/reset",
    } <= tags  # fmt: skip
    assert all(np.isfinite(e.value) for tag in tags for e in events.Scalars(tag))


def test_progress_bar() -> None:
    pytest.importorskip("rich", reason="needs rich")
    pytest.importorskip("tqdm", reason="needs tqdm")
    bro().learn(30, progress_bar=True)


def test_evaluate_policy() -> None:
    mean, std = evaluate_policy(bro().learn(20), Monitor(Toy()), 3)
    assert (mean, std) == (28, 0)


# ---------------------------------------------------------------- schedules


def rates(model: SAC) -> dict[str, float]:
    return {name: opt.param_groups[0]["lr"] for name, opt in model._optimizers().items()}


def test_constant_learning_rate() -> None:
    model = bro(learning_rate=7e-4).learn(20)
    own = rates(model).pop("explorer.scalar_optimizer")
    assert own == 3e-5
    assert {r for name, r in rates(model).items() if name != "explorer.scalar_optimizer"} == {7e-4}


def test_scheduled_learning_rate(tmp_path: Path) -> None:
    """A schedule moves every rate but that of optimism and its weight."""
    model = bro(learning_rate=LinearSchedule(1e-3, 0, 1), adjustment_learning_rate=2e-5).learn(40)
    for name, rate in rates(model).items():
        expected = 2e-5 if name == "explorer.scalar_optimizer" else 1e-3 * model._current_progress_remaining
        assert rate == pytest.approx(expected), name
    assert model._current_progress_remaining < 0.05
    model.save(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m", env=vec()).learn(30)
    assert rates(loaded)["explorer.scalar_optimizer"] == 2e-5
    assert rates(loaded)["critic.optimizer"] == pytest.approx(1e-3 * loaded._current_progress_remaining)


def test_target_update_interval() -> None:
    model = sac(target_update_interval=3, tau=0.5, learning_rate=1e-2)
    batch = random_batch(model)
    previous = [p.clone() for p in model.critic_target.parameters()]
    for step in range(1, 7):
        model._update(batch)
        now = list(model.critic_target.parameters())
        moved = any(not torch.equal(a, b) for a, b in zip(previous, now, strict=True))
        assert moved == (step % 3 == 0), step
        if moved:
            for old, new, critic in zip(previous, now, model.critic.parameters(), strict=True):
                torch.testing.assert_close(new, (old + critic) / 2)
        previous = [p.clone() for p in now]


@pytest.mark.parametrize(
    ("space", "wrong"), [(spaces.Discrete(3), 3), (spaces.MultiDiscrete([3, 4]), [[0, 3], [0, 4]])]
)
def test_predict_refuses_numbers_outside_of_their_space(space: spaces.Space, wrong: Any) -> None:
    for of, given in ((space, np.array(wrong)), (spaces.Dict({"k": space}), {"k": np.array(wrong)})):
        policy = "MultiInputPolicy" if isinstance(of, spaces.Dict) else "MlpPolicy"
        model = sac(vec(obs_space=of), policy=policy)
        model.predict(of.sample())
        with pytest.raises(ValueError, match=r"^observation.* must be numbers of (Multi)?Discrete\(.*\), not"):
            model.predict(given)
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        sac(vec(obs_space=spaces.MultiDiscrete([3, 4]))).predict(np.array([0, 1, 2]))
