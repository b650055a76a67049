"""What the parts hear of the environment."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from tests.sac.common import Toy, sac, vec


def listen(model: Any) -> tuple[list[Any], list[Any], list[str]]:
    """Record every call of one part's hooks, and the order of them."""
    steps: list[Any] = []
    episodes: list[Any] = []
    order: list[str] = []
    part = model.pessimism_rule

    def on_step(learner: Any, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        assert learner is model.learner
        steps.append((np.array(rewards), np.array(dones), infos))
        order.append("step")

    def on_episode_end(learner: Any, env_index: int, episode_return: float) -> None:
        episodes.append((env_index, episode_return))
        order.append("episode")

    part.on_step, part.on_episode_end = on_step, on_episode_end
    return steps, episodes, order


@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("truncate", [False, True])
def test_steps_and_episodes(truncate: bool, normalized: bool) -> None:
    env: Any = vec(2, truncate=truncate)
    model = sac(VecNormalize(env) if normalized else env, replay_ratio=0)
    steps, episodes, order = listen(model)
    model.learn(28)
    assert len(steps) == 14
    # Rewards are the environment's own, 1, ..., 7 twice, whatever the wrapper makes of them.
    np.testing.assert_allclose([rewards for rewards, _, _ in steps], [[t % 7 + 1] * 2 for t in range(14)])
    assert [dones.tolist() for _, dones, _ in steps] == [[t % 7 == 6] * 2 for t in range(14)]
    assert all(len(infos) == 2 for _, _, infos in steps)
    assert steps[6][2][0].get("TimeLimit.truncated", False) == truncate
    assert [(int(i), float(r)) for i, r in episodes] == [(0, 28.0), (1, 28.0)] * 2
    assert order == (["step"] * 7 + ["episode"] * 2) * 2


def test_environments_without_monitor() -> None:
    model = sac(DummyVecEnv([Toy]), replay_ratio=0)
    steps, episodes, _ = listen(model)
    model.learn(14)
    assert len(steps) == 14 and episodes == []


def test_the_transition_is_stored_before() -> None:
    model = sac(replay_ratio=0)
    sizes = []
    model.pessimism_rule.on_step = lambda learner, *_: sizes.append(
        (model.replay_buffer.size(), learner.num_transitions)
    )
    model.learn(5)
    assert sizes == [(n, n) for n in range(1, 6)]
