"""What replay buffers take: the shapes that Stable-Baselines3's take, and no others; and whose ``sample`` is called."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, VecTransposeImage

from sb3_sample.replay.buffers import (
    BatchMemory,
    DeviceReplayBuffer,
    ValidationDictReplayBuffer,
    ValidationReplayBuffer,
)
from sb3_sample.replay.compact import CompactDictReplayBuffer, CompactReplayBuffer
from tests.sac.common import MAKERS, TINY_SAC, Toy, sac, vec

SPACE = spaces.Box(-1, 1, (2, 3), np.float32)
ACTIONS = spaces.Box(-1, 1, (2, 3), np.float32)
OURS = [CompactReplayBuffer, ValidationReplayBuffer, DeviceReplayBuffer]
OURS_OF_DICTS = [CompactDictReplayBuffer, ValidationDictReplayBuffer]


def make(cls: type[ReplayBuffer], n_envs: int, space: spaces.Space = SPACE, **kwargs: Any) -> ReplayBuffer:
    if issubclass(cls, (ValidationReplayBuffer, ValidationDictReplayBuffer)):
        kwargs["validation_proportion"] = 0.5
    return cls(20 * n_envs, space, ACTIONS, device="cpu", n_envs=n_envs, **kwargs)


def step(n_envs: int, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {
        "obs": rng.uniform(-1, 1, (n_envs, 2, 3)).astype(np.float32),
        "next_obs": rng.uniform(-1, 1, (n_envs, 2, 3)).astype(np.float32),
        "action": rng.uniform(-1, 1, (n_envs, 2, 3)).astype(np.float32),
        "reward": rng.normal(size=n_envs).astype(np.float32),
        "done": np.arange(n_envs) % 2 == 0,
        "infos": [{"TimeLimit.truncated": i % 3 == 0} for i in range(n_envs)],
    }


def rows(buffer: ReplayBuffer, key: str | None = None) -> list[np.ndarray]:
    names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
    columns = [getattr(buffer, name) for name in names]
    return [np.asarray(column[key] if isinstance(column, dict) else column)[: buffer.size()] for column in columns]


#: What Stable-Baselines3's buffer takes or refuses, by what is given instead of :func:`step`'s.
GIVEN: dict[str, Any] = {
    "as it is": lambda s, n: {},
    "lists": lambda s, n: {name: s[name].tolist() for name in ("obs", "next_obs", "reward", "done")},
    "float64": lambda s, n: {name: s[name].astype(np.float64) for name in ("obs", "action", "reward")},
    "flat actions": lambda s, n: {"action": s["action"].reshape(n, 6)},
    "one more axis": lambda s, n: {name: s[name][None] for name in ("obs", "next_obs", "reward")},
    "one for all": lambda s, n: {"obs": s["obs"][0], "reward": 0.5, "done": True},
    "one row for all": lambda s, n: {"obs": s["obs"][0, 0]},
    "not contiguous": lambda s, n: {"obs": np.asfortranarray(s["obs"])},
    "flags of one element": lambda s, n: {"infos": [{"TimeLimit.truncated": np.array([True])} for _ in range(n)]},
    "lists of one flag": lambda s, n: {"infos": [{"TimeLimit.truncated": [False]} for _ in range(n)]},
    "flags without axes": lambda s, n: {"infos": [{"TimeLimit.truncated": np.array(True)} for _ in range(n)]},
    "a row of flags": lambda s, n: {"infos": [{"TimeLimit.truncated": np.arange(n) % 2 == 1}]},
    "no info": lambda s, n: {"infos": []},
    "swapped observation": lambda s, n: {"obs": s["obs"].swapaxes(1, 2)},
    "swapped next observation": lambda s, n: {"next_obs": s["next_obs"].swapaxes(1, 2)},
    "flat observation": lambda s, n: {"obs": s["obs"].reshape(n, 6)},
    "too long": lambda s, n: {"obs": np.zeros((n, 2, 4), np.float32)},
    "too many rewards": lambda s, n: {"reward": np.zeros(n + 1, np.float32)},
    "a column of rewards": lambda s, n: {"reward": s["reward"][:, None]},
    "a column of flags": lambda s, n: {"done": s["done"][:, None]},
    "too many flags": lambda s, n: {"done": np.zeros(n + 1, bool)},
    "too few actions": lambda s, n: {"action": s["action"][:, :1]},
}
#: Taken here, and refused by Stable-Baselines3: flags of one element of several environments.
MORE = {("flags of one element", 3), ("lists of one flag", 3)}


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("given", GIVEN)
@pytest.mark.parametrize("cls", [*OURS, *OURS_OF_DICTS])
def test_takes_what_stable_baselines3_takes(cls: Any, given: str, n_envs: int) -> None:
    is_dict = cls in OURS_OF_DICTS
    space: spaces.Space = spaces.Dict({"x": SPACE}) if is_dict else SPACE

    def add(buffer: ReplayBuffer, **instead: Any) -> None:
        values = {**step(n_envs), **instead}
        for name in ("obs", "next_obs"):
            values[name] = {"x": np.asarray(values[name])} if is_dict else values[name]
        buffer.add(**values)

    theirs, ours = make(DictReplayBuffer if is_dict else ReplayBuffer, n_envs, space), make(cls, n_envs, space)
    for buffer in (theirs, ours):
        add(buffer, **step(n_envs, seed=1))
    instead = GIVEN[given](step(n_envs), n_envs)
    try:
        add(theirs, **instead)
    except ValueError:
        before = [column.copy() for column in rows(ours, "x")]
        if (given, n_envs) in MORE:
            add(ours, **instead)
            flag = given == "flags of one element"
            np.testing.assert_array_equal(rows(ours, "x")[-1], [[1, 0, 0], [flag] * 3])
            return
        with pytest.raises(ValueError, match=r"could not (broadcast|put) the .*shape \(.*shape \("):
            add(ours, **instead)
        # Nothing of it was stored.
        for a, b in zip(rows(ours, "x"), before, strict=True):
            np.testing.assert_array_equal(a, b)
    else:
        assert (given, n_envs) not in MORE
        add(ours, **instead)
        for a, b in zip(rows(ours, "x"), rows(theirs, "x"), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("cls", OURS)
def test_an_action_with_its_axes_swapped_is_refused(cls: Any) -> None:
    """Stable-Baselines3's buffer scrambles it."""
    with pytest.raises(ValueError, match=r"the action of shape \(2, 3, 2\) into shape \(2, 2, 3\).*or \(2, 6\)"):
        make(cls, 2).add(**{**step(2), "action": step(2)["action"].swapaxes(1, 2)})


@pytest.mark.parametrize("cls", [ReplayBuffer, *OURS])
def test_extend_with_rows_of_timeouts(cls: Any) -> None:
    steps = [step(3, seed) for seed in range(4)]
    timeouts = np.random.default_rng(5).random((4, 3)) < 0.5
    buffer = make(cls, 3)
    columns = [np.stack([s[name] for s in steps]) for name in ("obs", "next_obs", "action", "reward", "done")]
    buffer.extend(*columns, [[{"TimeLimit.truncated": row}] for row in timeouts])
    np.testing.assert_array_equal(rows(buffer)[-1], timeouts)
    np.testing.assert_array_equal(rows(buffer)[0], columns[0])


@pytest.mark.parametrize("cls", [ReplayBuffer, *OURS])
def test_timeouts_that_are_not_handled_are_not_looked_at(cls: Any) -> None:
    buffer = make(cls, 3, handle_timeout_termination=False)
    buffer.add(**{**step(3), "infos": np.ones(3)})
    assert not rows(buffer)[-1].any()


@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("cls", OURS)
def test_discrete_observations_without_an_axis(cls: Any, n_envs: int) -> None:
    buffers = [make(each, n_envs, spaces.Discrete(9)) for each in (ReplayBuffer, cls)]
    for buffer in buffers:
        s = step(n_envs)
        buffer.add(**{**s, "obs": np.arange(n_envs), "next_obs": np.arange(n_envs) + 1})
    for a, b in zip(*map(rows, buffers), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="could not broadcast the observation"):
        buffers[1].add(**{**step(n_envs), "obs": np.arange(n_envs + 2), "next_obs": np.arange(n_envs)})


def test_refused_transitions_leave_the_split_as_it_is() -> None:
    buffer = make(ValidationReplayBuffer, 3)
    assert isinstance(buffer, ValidationReplayBuffer)
    for seed in range(25):
        buffer.add(**step(3, seed))
    before = buffer.n_validation, buffer.held_out.copy(), buffer.pos
    with pytest.raises(ValueError, match="reward"):
        buffer.add(**{**step(3), "reward": np.zeros(2)})
    assert (buffer.n_validation, buffer.pos) == (before[0], before[2])
    np.testing.assert_array_equal(buffer.held_out, before[1])


# ---------------------------------------------------------------- in a training


class Images(gym.Env):
    """Small images with the channels last."""

    observation_space = spaces.Box(0, 255, (36, 40, 3), np.uint8)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {}


def test_images_with_the_channels_last_beneath_vec_normalize() -> None:
    """What is stored is what is beneath ``VecNormalize``, which no wrapper above it transposes."""
    normalized = VecNormalize(DummyVecEnv([Images]), norm_obs=False)
    model = sac(normalized, policy="CnnPolicy", buffer_size=20, policy_kwargs={"net_arch": [8]})
    with pytest.raises(ValueError, match=r"\(1, 36, 40, 3\) into shape \(1, 3, 36, 40\).*VecTransposeImage"):
        model.learn(3)
    assert model.replay_buffer.size() == 0
    right = VecNormalize(VecTransposeImage(DummyVecEnv([Images])), norm_obs=False)
    model = sac(right, policy="CnnPolicy", buffer_size=20, policy_kwargs={"net_arch": [8]})
    assert model.learn(3).replay_buffer.size() == 3


def test_observations_of_another_shape_end_the_training_at_once() -> None:
    class Wrong(Toy):
        def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            observation, *rest = super().step(action)
            return observation.T, *rest  # type: ignore[return-value]

        def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
            observation, info = super().reset(**kwargs)
            return observation.T, info

    class OneProcess(DummyVecEnv):
        """Stacks what environments give, as those of other processes do, and looks at no shape."""

        def _save_obs(self, env_idx: int, obs: Any) -> None:
            self.given = obs

        def _obs_from_buf(self) -> Any:
            return np.stack([self.given])

    model = sac(OneProcess([lambda: Wrong(obs_space=SPACE)]))
    with pytest.raises(ValueError, match=r"the observation of shape \(1, 3, 2\) into shape \(1, 2, 3\)"):
        model.learn(3)
    assert model.num_transitions == 0


@pytest.mark.parametrize("maker", ["SAC", "VPLSAC", "OPLSAC"])
def test_flags_of_one_element(maker: str) -> None:
    class Flags(Toy):
        def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            observation, reward, terminated, truncated, info = super().step(action)
            return observation, reward, np.array([terminated]), np.array([truncated]), info  # type: ignore[return-value]

    states = []
    for cls in (Toy, Flags):
        model = MAKERS[maker](DummyVecEnv([lambda cls=cls: cls(truncate=True)] * 2), learning_starts=10).learn(40)
        states.append([np.asarray(column) for column in (model.replay_buffer.timeouts, model.replay_buffer.dones)])
        assert model.replay_buffer.timeouts[:20].sum() == 4
    for a, b in zip(*states, strict=True):
        np.testing.assert_array_equal(a, b)


# ---------------------------------------------------------------- whose sample is called


def test_a_sample_in_the_place_of_the_buffers_own_is_called() -> None:
    model = sac(replay_ratio=3).learn(15)
    own, asked = model.replay_buffer.sample, []

    def mine(batch_size: int, env: Any = None) -> Any:
        asked.append(batch_size)
        return own(batch_size, env=env)._replace(rewards=torch.full((batch_size, 1), 1e3))

    model.replay_buffer.sample = mine
    before = model._n_updates
    model.learn(4, reset_num_timesteps=False)
    # Once a gradient step: what it composes is known to itself alone.
    assert asked == [TINY_SAC["batch_size"]] * 12 and model._n_updates == before + 12
    assert model._metrics["train/critic_loss"] > 1e5
    del model.replay_buffer.sample
    model.learn(4, reset_num_timesteps=False)
    assert len(asked) == 12 and model._metrics["train/critic_loss"] < 1e5


@pytest.mark.parametrize("name", ["sample", "_get_samples"])
@pytest.mark.parametrize("where", ["object", "subclass", "class"])
@pytest.mark.parametrize("cls", [CompactReplayBuffer, ReplayBuffer, DeviceReplayBuffer])
def test_every_way_to_replace_it(cls: Any, where: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    own = getattr(cls, name)

    def mine(self: Any, *args: Any, **kwargs: Any) -> Any:
        calls.append(len(args))
        return own(self, *args, **kwargs)

    used = type(cls.__name__, (cls,), {name: mine}) if where == "subclass" else cls
    model = sac(replay_buffer_class=used).learn(15)
    if where == "subclass":
        calls.clear()
    elif where == "object":
        monkeypatch.setattr(model.replay_buffer, name, mine.__get__(model.replay_buffer))
    else:
        monkeypatch.setattr(cls, name, mine)
    model.train(3)
    assert len(calls) == 3


def test_validation_batches_of_a_sample_of_ones_own() -> None:
    model = MAKERS["VPLSAC"]().learn(30)
    calls = []
    own = model.replay_buffer.sample_validation
    model.replay_buffer.sample_validation = lambda n, env=None: calls.append(n) or own(n, env=env)
    model.train(2)
    assert calls == [2, 2]


def test_the_buffers_own_sample_is_not_asked() -> None:
    """What is gathered without it is faster: that stays so."""
    assert BatchMemory.serves(sac().replay_buffer, None)
    assert BatchMemory.serves(sac(vec(2), replay_buffer_class=ReplayBuffer).replay_buffer, None)
    assert BatchMemory.serves(MAKERS["VPLSAC"]().replay_buffer, None)
