"""Atari as value learners see it, and SR-SPR on it."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback

ale_py = pytest.importorskip("ale_py")

from sb3_sample import SRSPR, RewoundPPO, make_atari_env, make_env  # noqa: E402
from sb3_sample.envs import registration  # noqa: E402
from sb3_sample.envs.atari import ENV_KWARGS, AreaResize, AtariFrames  # noqa: E402
from sb3_sample.envs.portable_states import pack, unpack  # noqa: E402
from sb3_sample.saving.attributes import DoesNotFit  # noqa: E402
from sb3_sample.srspr import evaluation  # noqa: E402
from sb3_sample.srspr.evaluation import AtariEvaluation, evaluate_atari, evaluation_env  # noqa: E402
from tests.srspr.common import SIZE, TINY, tiny, venv  # noqa: E402


def until_a_life_is_lost(env: gym.Env) -> tuple[np.ndarray, dict[str, Any]]:
    for _ in range(500):
        observation, _, terminated, _, info = env.step(1)  # fire, and never move
        if terminated:
            return observation, info
    raise AssertionError("no life was lost")


def test_observations_are_stacks_of_gray_frames() -> None:
    env = make_atari_env("ALE/Breakout-v5")
    assert env.observation_space == gym.spaces.Box(0, 255, (4, 84, 84), np.uint8)
    assert isinstance(env.action_space, gym.spaces.Discrete) and env.action_space.n == 4
    first, _ = env.reset(seed=0)
    assert not first[:3].any() and first[3].any()
    second = env.step(1)[0]
    assert not second[:2].any() and np.array_equal(second[2], first[3])
    screen = env.unwrapped.ale.getScreenGrayscale()  # type: ignore[attr-defined]
    assert abs(int(second[3].astype(int).mean()) - int(screen.astype(int).mean())) <= 1


def test_a_lost_life_ends_an_episode_and_does_not_restart_the_game() -> None:
    env = make_atari_env("ALE/Breakout-v5")
    env.reset(seed=0)
    console: Any = env.unwrapped
    _, info = until_a_life_is_lost(env)
    frame, lives = console.ale.getEpisodeFrameNumber(), console.ale.lives()
    assert lives == 4 and "episode" not in info
    observation, _ = env.reset()
    # One decision without an action later, and with nothing of the life before.
    assert console.ale.getEpisodeFrameNumber() == frame + 4 and console.ale.lives() == 4
    assert not observation[:3].any()
    for _ in range(4):
        _, info = until_a_life_is_lost(env)
        env.reset()
    assert info["episode"]["l"] > frame  # of the whole game, in frames
    evaluation = make_atari_env("ALE/Breakout-v5", training=False)
    evaluation.reset(seed=0)
    _, info = until_a_life_is_lost(evaluation)
    assert console.ale.lives() > 0 and info["lives"] == 0


def test_rewards_are_clipped_in_training_only() -> None:
    rewards = {}
    for training in (True, False):
        env = make_atari_env("ALE/Seaquest-v5", training=training)
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        rewards[training] = set()
        for _ in range(300):
            _, reward, terminated, truncated, _ = env.step(int(rng.integers(18)))
            rewards[training].add(float(reward))
            if terminated or truncated:
                env.reset()
    assert rewards[True] <= {-1, 0, 1} and 20 in rewards[False]


def test_a_missing_rom_is_said_to_be_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALE_ROMS_DIR", str(tmp_path))
    for make in (make_env, make_atari_env, lambda env_id: SRSPR("CnnPolicy", env_id, device="cpu")):
        with pytest.raises(ImportError, match=f"ALE/Pong-v5 .*pong.bin.*ALE_ROMS_DIR is '{tmp_path}': unset it"):
            make("ALE/Pong-v5")


def test_every_agent_takes_the_id_of_a_game(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    games = {env_id: spec for env_id, spec in gym.registry.items() if env_id.startswith("ALE/")}

    def forget() -> None:
        """As in a program that has not imported ale-py."""
        for env_id in games:
            monkeypatch.delitem(gym.registry, env_id)

    monkeypatch.setattr(registration, "register_atari", lambda: gym.registry.update(games))
    forget()
    small = {"features_extractor_kwargs": {"features_dim": 4}}
    arguments: dict[str, Any] = {"n_steps": 4, "batch_size": 4, "policy_kwargs": small, "device": "cpu"}
    model = RewoundPPO("CnnPolicy", "ALE/Pong-v5", n_actions=1, **arguments)
    model.save(tmp_path / "model")
    forget()
    assert RewoundPPO.load(tmp_path / "model", env="ALE/Pong-v5", device="cpu").get_env() is not None


def test_pictures_are_reduced_by_areas() -> None:
    class Screen(gym.Env[np.ndarray, int]):
        observation_space = gym.spaces.Box(0, 255, (10, 6), np.uint8)
        action_space = gym.spaces.Discrete(1)

    picture = np.random.default_rng(0).integers(0, 256, (10, 6)).astype(np.uint8)
    got = AreaResize(Screen(), 4).observation(picture)
    fine = np.repeat(np.repeat(picture.astype(float), 4, axis=0), 4, axis=1)  # to 40 x 24, of 4 x 4 areas
    assert np.array_equal(got, np.rint(fine.reshape(4, 10, 4, 6).mean(axis=(1, 3))))


def test_the_state_of_a_game_is_saved_and_restored() -> None:
    first, second = (make_atari_env("ALE/Breakout-v5") for _ in range(2))
    first.reset(seed=0)
    second.reset(seed=9)
    rng = np.random.default_rng(0)
    for _ in range(60):
        if first.step(int(rng.integers(4)))[2]:
            first.reset()
    state, missing = pack(first)
    assert missing == []
    unpack(second, state)
    for _ in range(150):
        action = int(rng.integers(4))
        ours, theirs = first.step(action), second.step(action)
        assert np.array_equal(ours[0], theirs[0]) and ours[1:4] == theirs[1:4]
        if ours[2]:
            assert np.array_equal(first.reset()[0], second.reset()[0])
    for damaged in (np.zeros(100, np.uint8), np.zeros(3)):
        with pytest.raises(DoesNotFit, match="Atari console"):
            unpack(second, {**state, "console": damaged})


def test_srspr_trains_on_a_game_by_its_id_and_goes_on_bit_by_bit(tmp_path: Path) -> None:
    def model(**kwargs: Any) -> SRSPR:
        return SRSPR(
            "CnnPolicy", "ALE/Pong-v5", network="bronet", learning_starts=20, batch_size=2, n_steps=3,
            n_predictions=2, buffer_size=100, policy_kwargs=TINY, seed=0, device="cpu", **kwargs,
        )  # fmt: skip

    whole = model().learn(30, checkpoint=tmp_path / "whole", checkpoint_freq=10)
    half = tmp_path / "half"
    with pytest.raises(KeyboardInterrupt):
        model().learn(30, lambda values, _: stop(values), checkpoint=half, checkpoint_freq=10)
    resumed = model().learn(30, checkpoint=half, checkpoint_freq=10)
    first, second = whole.policy.state_dict(), resumed.policy.state_dict()
    assert whole._n_updates == 20 and all(torch.equal(first[name], second[name]) for name in first)
    whole.save(tmp_path / "model")
    loaded = SRSPR.load(tmp_path / "model", "ALE/Pong-v5", device="cpu")
    assert loaded.observation_space.shape == (4, 84, 84)


def stop(values: dict[str, Any]) -> bool:
    if values["self"].num_timesteps == 25:
        raise KeyboardInterrupt
    return True


def test_the_published_evaluation() -> None:
    model = SRSPR("CnnPolicy", "ALE/Breakout-v5", policy_kwargs=TINY, buffer_size=100, seed=0, device="cpu")
    seen: list[int] = []
    returns, lengths = evaluate_atari(model, "ALE/Breakout-v5", n_episodes=2, seed=3, max_decisions=40, noops=seen)
    assert returns.shape == lengths.shape == (2,) and (lengths == 40).all() and (returns >= 0).all()
    assert len(seen) == 2 and all(0 <= n < 30 for n in seen)
    again = evaluate_atari(model, "ALE/Breakout-v5", n_episodes=2, seed=3, max_decisions=40)
    assert np.array_equal(returns, again[0])
    env = evaluation_env("ALE/Breakout-v5")
    assert not any(word in str(env) for word in ("EpisodicLife", "ClipReward", "NoopReset", "FireReset"))


class Scripted(gym.Env):
    """Games of 40 decisions, each worth 2.5, that remember their actions."""

    observation_space = gym.spaces.Box(0, 255, (4, SIZE, SIZE), np.uint8)
    action_space = gym.spaces.Discrete(3)

    def __init__(self) -> None:
        self.games: list[list[int]] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.games.append([])
        return np.zeros(self.observation_space.shape, np.uint8), {}

    def step(self, action: int) -> Any:
        self.games[-1].append(action)
        return np.zeros(self.observation_space.shape, np.uint8), 2.5, len(self.games[-1]) == 40, False, {}


class Player:
    """Always plays 2, and counts how often it is asked."""

    def __init__(self, rate: float) -> None:
        self.evaluation_eps, self.action_space, self.asked = rate, Scripted.action_space, 0

    def predict(self, observation: np.ndarray, deterministic: bool = False) -> Any:
        assert deterministic
        self.asked += 1
        return np.array(2), None


@pytest.mark.parametrize("rate", [0.0, 0.3, 1.0])
def test_games_of_an_evaluation(rate: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """First decisions without an action, then the model's or, at the rate, a random one; rewards as they are."""
    env, player, noops = Scripted(), Player(rate), list[int]()
    monkeypatch.setattr(evaluation, "evaluation_env", lambda env_id: env)
    returns, lengths = evaluate_atari(player, "ALE/Breakout-v5", n_episodes=12, seed=1, noops=noops)
    assert (returns == 100).all() and (lengths == 40).all()
    assert len(set(noops)) > 5 and all(not any(game[:n]) for game, n in zip(env.games, noops, strict=True))
    played = [action for game, n in zip(env.games, noops, strict=True) for action in game[n:]]
    assert abs(player.asked / len(played) - (1 - rate)) < 0.1 and (
        rate not in (0, 1) or player.asked in (0, len(played))
    )
    # A random action is any of three.
    assert abs(np.mean(np.array(played) == 2) - (1 - 2 / 3 * rate)) < 0.1
    assert set(played) == ({2} if rate == 0 else {0, 1, 2})
    # Broken off in the midst of a game.
    returns, lengths = evaluate_atari(player, "ALE/Breakout-v5", n_episodes=1, max_decisions=30)
    assert returns == 75 and lengths == 30


class Logged(BaseCallback):
    def _on_step(self) -> bool:
        self.values = {key: value for key, value in self.logger.name_to_value.items() if key.startswith("eval/")}
        return True


def test_evaluations_while_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "evaluation_env", lambda env_id: Scripted())
    callback, logged = AtariEvaluation("ALE/Breakout-v5", every=10, n_episodes=2), Logged()
    tiny(venv(2)).learn(24, [callback, logged])
    assert callback.results == [(10, 100.0), (20, 100.0)]
    # Breakout's scores of random play and of humans are 1.7 and 30.5.
    assert logged.values == {"eval/mean_reward": 100.0, "eval/human_normalized": pytest.approx((100 - 1.7) / 28.8)}
    again = AtariEvaluation("ALE/Breakout-v5")
    again.load_state_dict(callback.state_dict())
    assert again.results == callback.results
    for wrong in ({"every": 0}, {"n_episodes": 0}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be an integer of at least 1, not 0"):
            AtariEvaluation("ALE/Breakout-v5", **wrong)
    with pytest.raises(ValueError, match="env_id must be the id of an Atari game, ALE/<Game>-v5, not 'Pong-v5'"):
        AtariEvaluation("Pong-v5")
    monkeypatch.setattr(Scripted, "action_space", gym.spaces.Discrete(9))
    with pytest.raises(ValueError, match=r"'ALE/Breakout-v5' has another action_space than the model: Discrete\(9\)"):
        tiny(venv(1)).learn(1, AtariEvaluation("ALE/Breakout-v5"))


def test_games_that_there_are_not() -> None:
    with pytest.raises(gym.error.UnregisteredEnv, match="ALE/Breakout-v5"):
        SRSPR("CnnPolicy", "ALE/Brekout-v5")
    with pytest.raises(ValueError, match="env_id must be the id of an Atari game"):
        make_atari_env("CartPole-v1")
    with pytest.raises(ValueError, match="env must be an Atari game"):
        AtariFrames(gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match="frameskip=1, not 4"):
        AtariFrames(make_env("ALE/Pong-v5"))
    with pytest.raises(ValueError, match="obs_type='grayscale'"):
        AtariFrames(make_env("ALE/Pong-v5", **{**ENV_KWARGS, "obs_type": "rgb"}))
    with pytest.warns(UserWarning, match=r"repeats its last action with probability 0\.25 in every frame"):
        AtariFrames(make_env("ALE/Pong-v5", frameskip=1, obs_type="grayscale"))
    with pytest.raises(ValueError, match="noop_max must be"):
        make_atari_env("ALE/Pong-v5", noop_max=0)
