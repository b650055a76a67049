"""Transitions to fill replay buffers with, and what compares two buffers."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

from sb3_sample.replay.compact import CompactDictReplayBuffer, CompactReplayBuffer

BOX = spaces.Box(-np.inf, np.inf, (3,), np.float32)
DICT = spaces.Dict(
    {
        "x": BOX,
        "image": spaces.Box(0, 255, (2, 4, 4), np.uint8),
        "which": spaces.Discrete(3),
        "bits": spaces.MultiBinary(2),
    }
)
SPACES = {
    "float32": BOX,
    "float64": spaces.Box(-1, 1, (2, 2), np.float64),
    "uint8": spaces.Box(0, 255, (1, 3, 3), np.uint8),
    "discrete": spaces.Discrete(4),
    "dict": DICT,
}
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)


class Stream:
    """Transitions of several environments whose episodes end, or are broken off, at random."""

    def __init__(self, space: spaces.Space, n_envs: int, seed: int, ends: float = 0.15, breaks: float = 0.05):
        self.space, self.n_envs, self.ends, self.breaks = space, n_envs, ends, breaks
        self.rng = np.random.default_rng(seed)
        self.now = self._draw()

    def _draw(self) -> Any:
        def draw(space: Any) -> np.ndarray:
            shape = (self.n_envs, *space.shape)
            if isinstance(space, spaces.Box) and space.dtype.kind == "f":
                # Observations that differ in bits only, and one that differs from itself.
                special = np.array([0.0, -0.0, np.nan, 1.0], space.dtype)
                return np.where(
                    self.rng.random(shape) < 0.5, self.rng.choice(special, shape), self.rng.normal(size=shape)
                ).astype(space.dtype)
            return self.rng.integers(0, 3 if isinstance(space, spaces.Discrete) else 2, shape).astype(space.dtype)

        if isinstance(self.space, spaces.Dict):
            return {key: draw(space) for key, space in self.space.items()}
        return draw(self.space)

    def _map(self, function: Any, *observations: Any) -> Any:
        if isinstance(self.space, spaces.Dict):
            return {key: function(*(o[key] for o in observations)) for key in self.space}
        return function(*observations)

    def transition(self) -> tuple[Any, ...]:
        after, fresh = self._draw(), self._draw()
        dones = self.rng.random(self.n_envs) < self.ends
        infos = [{"TimeLimit.truncated": bool(self.rng.random() < 0.5 and done)} for done in dones]
        actions = self.rng.normal(size=(self.n_envs, 2)).astype(np.float32)
        given = self._map(np.copy, self.now), self._map(np.copy, after), actions, self.rng.normal(size=self.n_envs)
        starts = dones | (self.rng.random() < self.breaks)

        def follow(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            return np.where(starts.reshape(-1, *(1,) * (a.ndim - 1)), b, a)

        self.now = self._map(follow, after, fresh)
        return (*given, dones, infos)


def pair(space: spaces.Space, rows: int, n_envs: int, **kwargs: Any) -> tuple[Any, Any]:
    is_dict = isinstance(space, spaces.Dict)
    ours = CompactDictReplayBuffer if is_dict else CompactReplayBuffer
    theirs = DictReplayBuffer if is_dict else ReplayBuffer
    size = rows * n_envs
    return ours(size, space, ACTIONS, "cpu", n_envs, **kwargs), theirs(size, space, ACTIONS, "cpu", n_envs)


def same_bits(a: Any, b: Any) -> bool:
    if isinstance(b, dict):
        return a.keys() == b.keys() and all(same_bits(a[key], b[key]) for key in b)
    if isinstance(b, tuple):
        return type(a) is type(b) and all(same_bits(x, y) for x, y in zip(a, b, strict=True))
    a, b = np.asarray(a), np.asarray(b)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def draw(buffer: Any, n: int, seed: int, env: Any = None) -> Any:
    np.random.seed(seed)
    return buffer.sample(n, env=env), np.random.get_state()[2]


def assert_same(a: Any, b: Any) -> None:
    """Bit by bit: what is stored, where it lies, and what the next samples are."""
    assert (a.pos, a.full) == (b.pos, b.full)
    n = a.size()
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "held_out"):
        x, y = getattr(a, name, np.zeros(0)), getattr(b, name, np.zeros(0))
        pairs = [(x[k], y[k]) for k in x] if isinstance(x, dict) else [(x, y)]
        assert all(same_bits(p[:n], q[:n]) for p, q in pairs), name
    # The same rows are kept aside, if at other places there.
    assert same_bits(np.sign(a.slot[:n].clip(-1, a.n_envs)), np.sign(b.slot[:n].clip(-1, b.n_envs)))
    draws = ["sample"] if n else []
    if hasattr(a, "held_out"):
        assert (a.n_validation, a.n_training) == (b.n_validation, b.n_training)
        draws = ["sample"] * (a.n_training > 0) + ["sample_validation"] * (a.n_validation > 0)
    for method in draws:
        results = []
        for buffer in (a, b):
            np.random.seed(n)
            results.append(getattr(buffer, method)(64))
        assert same_bits(*results), method
