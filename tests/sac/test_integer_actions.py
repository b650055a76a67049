"""Boxes of integers: trained as Stable-Baselines3 trains them, but that the replay buffer cuts no action."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sample import DiagnosticsCallback
from sb3_sample.replay.buffers import DeviceReplayBuffer
from tests.sac.common import MAKERS, Toy, sac, sampled, vec

WIDE = spaces.Box(np.array([-10, 0]), np.array([10, 3]), dtype=np.int64)
BYTES = spaces.Box(np.array([-128, 0]), np.array([127, 100]), dtype=np.int8)


def stored(model: Any) -> np.ndarray:
    """What the buffer holds of the actions, (N, A)."""
    actions = model.replay_buffer.actions
    actions = actions.cpu().numpy() if isinstance(actions, torch.Tensor) else np.asarray(actions)
    assert actions.dtype == np.float32
    return actions[: model.replay_buffer.size()].reshape(-1, actions.shape[-1])


def received(model: Any) -> np.ndarray:
    """What the environments got, (N, A)."""
    return np.stack([env.unwrapped.actions for env in model.get_env().envs], axis=1).reshape(-1, 2)


def check(model: Any, space: spaces.Box) -> None:
    """What the environment got is what the buffer holds, in the space's bounds, and fractions are among it."""
    scaled, got = stored(model), received(model)
    low, high = space.low.astype(float), space.high.astype(float)
    assert (np.abs(scaled) <= 1).all() and (low <= got).all() and (got <= high).all()
    np.testing.assert_allclose(low + (scaled + 1) / 2 * (high - low), got, rtol=1e-5, atol=1e-4)
    assert (scaled != np.round(scaled)).any() and (got[30:] != np.round(got[30:])).any()
    assert all(np.isfinite(value.item()) for value in model._metrics.values()) and model._metrics


@pytest.mark.parametrize("maker", sampled(MAKERS))
def test_every_agent_trains(maker: str, tmp_path: Path) -> None:
    model = MAKERS[maker](vec(2, action_space=WIDE), learning_starts=20).learn(60)
    check(model, WIDE)
    model.save_replay_buffer(tmp_path / "buffer")
    before = stored(model)
    model.load_replay_buffer(tmp_path / "buffer")
    np.testing.assert_array_equal(stored(model), before)


@pytest.mark.parametrize("space", [WIDE, BYTES, spaces.Box(0, 255, (2,), np.uint8), spaces.Box(-5, 5, (2,), np.int32)])
@pytest.mark.parametrize("noise", [False, True])
def test_environment_and_predict_get_what_stable_baselines3_gives(space: spaces.Box, noise: bool) -> None:
    types, models = [], []
    for cls in (stable_baselines3.SAC, type(sac())):
        action_noise = NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)) if noise else None
        env = vec(action_space=space)
        kwargs: dict[str, Any] = dict(learning_starts=20, batch_size=8, policy_kwargs={"net_arch": [8]}, device="cpu")
        # Its arithmetic overflows in small signed integers.
        with np.errstate(all="ignore"):
            model = cls("MlpPolicy", env, seed=0, action_noise=action_noise, **kwargs).learn(40)
        predicted = model.predict(np.zeros(3, np.float32), deterministic=True)[0]
        got = env.envs[0].unwrapped.actions
        types.append((got[0].dtype, got[-1].dtype, predicted.dtype))
        models.append(model)
    assert types[0] == types[1]
    if space is WIDE:
        assert set(types[0]) == {np.dtype(np.float64)}
    ours = models[1]
    check(ours, space)
    assert (space.low <= predicted).all() and (predicted <= space.high).all()
    # The same numbers where its own do not overflow.
    if space is not BYTES:
        scaled = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
        theirs = models[0].policy
        np.testing.assert_array_equal(ours.policy.unscale_action(scaled), theirs.unscale_action(scaled))
        whole = np.stack([space.sample() for _ in range(50)])
        np.testing.assert_array_equal(ours.policy.scale_action(whole), theirs.scale_action(whole))
        assert ours.policy.scale_action(whole).dtype == theirs.scale_action(whole).dtype


def test_bounds_of_small_integers() -> None:
    policy = sac(vec(action_space=BYTES)).policy
    np.testing.assert_allclose(policy.unscale_action(np.array([[-1, -1], [0, 0], [1, 1]], np.float32)),
                               [[-128, 0], [-0.5, 50], [127, 100]])  # fmt: skip
    np.testing.assert_allclose(policy.scale_action(np.array([[-128, 0], [127, 100]], np.int8)), [[-1, -1], [1, 1]])


@pytest.mark.parametrize("cls", [ReplayBuffer, DeviceReplayBuffer, None])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_other_buffers(cls: Any, n_steps: int) -> None:
    if cls is not None and n_steps > 1:
        pytest.skip("n-step returns have a buffer of their own")
    check(sac(vec(action_space=WIDE), replay_buffer_class=cls, n_steps=n_steps, learning_starts=20).learn(60), WIDE)


def test_memory_map_and_diagnostics(tmp_path: Path) -> None:
    model = sac(vec(action_space=WIDE), replay_buffer_kwargs={"memory_map": str(tmp_path / "map")}, learning_starts=20)
    callback = DiagnosticsCallback(Toy(action_space=WIDE), every=30)
    check(model.learn(60, callback=callback), WIDE)
    assert np.isfinite(callback.last_results["td_error_validation"])


class Goal(Toy):
    """With a goal."""

    def __init__(self) -> None:
        box = spaces.Box(-10, 10, (3,), np.float32)
        names = ("observation", "achieved_goal", "desired_goal")
        super().__init__(spaces.Dict(dict.fromkeys(names, box)), WIDE, truncate=True)

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return -np.abs(achieved - desired).sum(axis=-1)


def test_hindsight() -> None:
    model = sac(Goal(), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, learning_starts=20).learn(60)
    assert isinstance(model.replay_buffer, HerReplayBuffer)
    scaled = stored(model)
    assert (np.abs(scaled) <= 1).all() and (scaled != np.round(scaled)).any()


def test_a_run_with_checkpoints(tmp_path: Path) -> None:
    def run(folder: Path, *parts: int) -> Any:
        for n in parts:
            model = sac(vec(action_space=WIDE), learning_starts=20)
            stop = (lambda limit: lambda locals_, _: locals_["self"].num_timesteps < limit)(n)
            model.learn(60, checkpoint=folder, checkpoint_freq=10, callback=stop)
        return model

    whole, resumed = run(tmp_path / "a", 100), run(tmp_path / "b", 35, 100)
    np.testing.assert_array_equal(stored(whole), stored(resumed))
    assert all(torch.equal(a, b) for a, b in zip(whole.policy.parameters(), resumed.policy.parameters(), strict=True))
