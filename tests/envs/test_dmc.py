"""The DeepMind Control suite: the same numbers as the suite itself, its episodes and the action repeat."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from dm_control import suite

from sb3_sample.envs.registration import DMC_TASKS

# BRO's table 4 and what else the papers give; the humanoid's 24 actions of that table are 21 in the suite.
DIMENSIONS = {
    "acrobot-swingup": (6, 1),
    "cheetah-run": (17, 6),
    "dog-run": (223, 38),
    "finger-turn_hard": (12, 2),
    "fish-swim": (24, 5),
    "hopper-hop": (15, 4),
    "humanoid-run": (67, 21),
    "pendulum-swingup": (3, 1),
    "quadruped-run": (78, 12),
    "walker-run": (24, 6),
}
SAMPLE = [("cheetah", "run"), ("walker", "run"), ("quadruped", "run"), ("finger", "turn_hard"), ("humanoid", "walk")]
ALL_TASKS = [(domain, task) for domain, tasks in DMC_TASKS.items() for task in tasks]
REST = [pytest.param(*task, marks=pytest.mark.slow) for task in ALL_TASKS if task not in SAMPLE]


@pytest.mark.parametrize("task", DIMENSIONS)
def test_dimensions(task: str) -> None:
    env = gym.make(f"dmc/{task}-v0")
    n_observations, n_actions = DIMENSIONS[task]
    assert env.observation_space.shape == (n_observations,) and env.action_space.shape == (n_actions,)


@pytest.mark.parametrize(("domain", "task"), [*SAMPLE, *REST])
def test_the_same_numbers_as_the_suite(domain: str, task: str) -> None:
    env = gym.make(f"dmc/{domain}-{task}-v0")
    raw = suite.load(domain, task, task_kwargs={"random": 11})
    spec = raw.action_spec()
    generator = np.random.default_rng(0)
    for seed in (11, None):
        observation, _ = env.reset(seed=seed)
        time_step = raw.reset()
        for _ in range(5):
            flat = np.concatenate([np.ravel(time_step.observation[name]) for name in raw.observation_spec()])
            np.testing.assert_array_equal(observation, flat.astype(np.float32))
            action = generator.uniform(-1, 1, spec.shape).astype(np.float32)
            observation, reward, *_ = env.step(action)
            if np.all(spec.minimum == -1) and np.all(spec.maximum == 1):
                time_step = raw.step(action)
            else:
                time_step = raw.step(spec.minimum + (action.astype(np.float64) + 1) * (spec.maximum - spec.minimum) / 2)
            assert reward == time_step.reward


def test_actions_span_the_bounds_of_the_suite() -> None:
    env = gym.make("dmc/quadruped-walk-v0")
    dm_env = env.unwrapped.dm_env  # type: ignore[attr-defined]
    env.reset(seed=0)
    for end, bound in ((-1.0, dm_env.action_spec().minimum), (1.0, dm_env.action_spec().maximum)):
        env.step(np.full(12, end, np.float32))
        np.testing.assert_allclose(dm_env.physics.control(), bound)


@pytest.mark.parametrize(("action_repeat", "decisions"), [(1, 1000), (4, 250), (3, 334), (1000, 1)])
def test_an_episode_is_1000_steps_and_truncated(action_repeat: int, decisions: int) -> None:
    env = gym.make("dmc/pendulum-swingup-v0", action_repeat=action_repeat)
    env.reset(seed=0)
    action = np.zeros(1, np.float32)
    ends = [env.step(action)[2:4] for _ in range(decisions)]
    assert ends == [(False, False)] * (decisions - 1) + [(False, True)]
    with pytest.raises(RuntimeError, match="reset"):
        env.step(action)


def test_rewards_of_repeated_steps_are_summed() -> None:
    every = gym.make("dmc/walker-walk-v0")
    fourth = gym.make("dmc/walker-walk-v0", action_repeat=4)
    assert fourth.metadata["render_fps"] == every.metadata["render_fps"] / 4 == 10
    every.reset(seed=0)
    fourth.reset(seed=0)
    generator = np.random.default_rng(0)
    for _ in range(20):
        action = generator.uniform(-1, 1, 6).astype(np.float32)
        steps = [every.step(action) for _ in range(4)]
        observation, reward, *_ = fourth.step(action)
        np.testing.assert_array_equal(observation, steps[-1][0])
        assert float(reward) == pytest.approx(sum(float(step[1]) for step in steps), rel=1e-12)
        assert float(reward) > 0


@pytest.mark.parametrize("action_repeat", [0, -1, 1001, 2.0, True, "4"])
def test_a_wrong_action_repeat_is_refused(action_repeat: object) -> None:
    with pytest.raises(ValueError, match="action_repeat must be an int from 1 to 1000"):
        gym.make("dmc/pendulum-swingup-v0", action_repeat=action_repeat)


def test_discount_zero_terminates(monkeypatch: pytest.MonkeyPatch) -> None:
    env = gym.make("dmc/pendulum-swingup-v0", action_repeat=2)
    env.reset(seed=0)
    task = env.unwrapped.dm_env.task  # type: ignore[attr-defined]
    monkeypatch.setattr(task, "get_termination", lambda physics: 0.0)
    assert env.step(np.zeros(1, np.float32))[2:4] == (True, False)


def test_seeds_beyond_32_bits() -> None:
    env = gym.make("dmc/pendulum-swingup-v0")
    first, _ = env.reset(seed=2**40 + 5)
    second, _ = env.reset(seed=2**40 + 5)
    np.testing.assert_array_equal(first, second)


@pytest.mark.slow
def test_triton_is_loaded_before_an_opengl(tmp_path: Path) -> None:
    """Their two LLVMs in the other order are a segmentation fault (``select_gl_backend``)."""
    (tmp_path / "triton.py").write_text("import sys\nprint('dm_control' in sys.modules)\n")
    program = (
        "import sb3_sample; env = sb3_sample.make_env('dmc/pendulum-swingup-v0'); print(type(env.unwrapped).__name__)"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(tmp_path)}
    )
    assert result.stdout.split() == ["False", "DMCEnv"], result.stderr


@pytest.mark.slow
def test_an_opengl_and_then_an_optimizer() -> None:
    program = (
        "import sb3_sample\n"
        "env = sb3_sample.make_env('dmc/pendulum-swingup-v0')\n"
        "print(type(sb3_sample.SAC('MlpPolicy', env)).__name__)"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.stdout.split() == ["SAC"], (result.returncode, result.stderr)


def test_an_unusable_opengl_does_not_stop_the_simulation() -> None:
    # dm_control opens its EGL device at import; without one this is what it raises there.
    program = (
        "import builtins, sb3_sample, gymnasium as gym\n"
        "original = builtins.__import__\n"
        "def refuse(name, *args, **kwargs):\n"
        "    if 'egl_renderer' in name:\n"
        "        raise ImportError('Cannot initialize a headless EGL display.')\n"
        "    return original(name, *args, **kwargs)\n"
        "builtins.__import__ = refuse\n"
        "env = gym.make('dmc/pendulum-swingup-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "print(env.step(env.action_space.sample())[0].shape)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env={**os.environ, "MUJOCO_GL": "egl"}
    )
    assert result.stdout.strip() == "(3,)", result.stderr
    assert "cannot render" in result.stderr
