"""Data sets made of Minari's folders, HDF5 files, replay buffers and recorded episodes; and their way back."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_sample import SAC, Dataset, multi_task_env, record
from sb3_sample.replay import dataset_buffers, steps
from tests.sac.common import Toy, sac, vec

BOX = spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 6.0], np.float32))
KEYS = ("observations", "actions", "rewards", "terminations", "truncations", "next_observations")


def made(n: int = 60, as_dict: bool = False, seed: int = 0, **kwargs: Any) -> Dataset:
    """Episodes of random lengths, of which some terminate, some are cut off, and some are both."""
    rng = np.random.default_rng(seed)
    ends = rng.random(n) < 0.15
    kinds = rng.integers(3, size=n)
    observations: Any = rng.normal(size=(n + 1, 3)).astype(np.float32)
    following = np.where(ends[:, None], rng.normal(size=(n, 3)), observations[1:]).astype(np.float32)
    if as_dict:
        observations = {"a": observations, "b": (observations[:, :2] * 100).astype(np.int64)}
        following = {"a": following, "b": (following[:, :2] * 100).astype(np.int64)}
    now = {key: value[:-1] for key, value in observations.items()} if as_dict else observations[:-1]
    actions = rng.uniform(BOX.low, BOX.high, (n, 2)).astype(np.float32)
    given = (now, actions, rng.normal(size=n).astype(np.float32), ends & (kinds != 1), ends & (kinds != 0))
    return Dataset.from_arrays(*given, next_observations=following, action_space=BOX, **kwargs)


def assert_same(ours: Dataset, theirs: Dataset) -> None:
    assert len(ours) == len(theirs)
    a, b = ours.rows(slice(None)), theirs.rows(slice(None))
    for name in KEYS:
        pairs = [(a[name], b[name])] if not isinstance(a[name], dict) else [(a[name][k], b[name][k]) for k in a[name]]
        for one, other in pairs:
            assert one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes(), name
    assert ours.fingerprint == theirs.fingerprint


@pytest.mark.parametrize("as_dict", [False, True])
def test_round_trip_through_minari(as_dict: bool, tmp_path: Path) -> None:
    minari = pytest.importorskip("minari", reason="needs the extra [offline]")
    data = made(as_dict=as_dict)
    data.to_minari(tmp_path / "set", author="me")
    again = Dataset.from_minari(str(tmp_path / "set"))
    assert_same(data, again)
    assert again.action_space == data.action_space and again.observation_space == data.observation_space
    # Minari itself reads it: every transition, terminations and time limits apart.
    theirs, rows = minari.MinariDataset(tmp_path / "set" / "data"), data.rows(slice(None))
    assert theirs.total_steps == 60 and theirs.total_episodes == data.n_episodes and theirs.spec.total_steps == 60
    first = 0
    for episode in theirs.iterate_episodes():
        n = len(episode)
        part = slice(first, first + n)
        for name in ("actions", "rewards", "terminations", "truncations"):
            assert np.array_equal(getattr(episode, name), rows[name][part]), name
        for key in ("a", "b") if as_dict else (None,):
            seen = episode.observations if key is None else episode.observations[key]
            now, then = (rows[k] if key is None else rows[k][key] for k in ("observations", "next_observations"))
            assert np.array_equal(seen[:-1], now[part]) and np.array_equal(seen[1:], then[part])
        first += n
    assert first == 60
    with pytest.raises(ValueError, match="must be new, but .*set/data is there"):
        data.to_minari(tmp_path / "set")


def test_arrays_of_other_types_than_their_spaces_survive_minari(tmp_path: Path) -> None:
    pytest.importorskip("minari", reason="needs the extra [offline]")
    rng = np.random.default_rng(0)
    observations = {"a": np.arange(8)[:, None], "b": np.eye(8, 3, dtype=bool), "c": np.arange(8.0)[:, None]}
    parts = {"a": spaces.Box(-9, 9, (1,), np.float64), "b": spaces.MultiBinary(3), "c": spaces.Discrete(9)}
    ends = np.ones(8)
    for dtype, name in ((np.float32, "single"), (np.float64, "double")):
        given = (observations, rng.uniform(-1, 1, (8, 2)), ends, ends, ends * 0)
        box = spaces.Box(-1, 1, (2,), dtype)
        data = Dataset.from_arrays(*given, observation_space=spaces.Dict(parts), action_space=box)
        data.to_minari(tmp_path / name)
        assert_same(data, Dataset.from_minari(tmp_path / name))
        rows = data.rows(slice(None))
        assert rows["actions"].dtype == dtype and rows["observations"]["a"].dtype == np.float32
        assert [rows["observations"][key].dtype for key in "bc"] == [np.int8, np.int64]


@pytest.mark.parametrize("as_dict", [False, True])
def test_numbers_in_minaris_files_are_of_their_space(as_dict: bool, tmp_path: Path) -> None:
    minari = pytest.importorskip("minari", reason="needs the extra [offline]")
    space: Any = spaces.Dict({"k": spaces.Discrete(5)}) if as_dict else spaces.Discrete(5)
    numbers = np.arange(4)
    data = Dataset.from_arrays(
        {"k": numbers} if as_dict else numbers, np.zeros((4, 1)), np.zeros(4), np.arange(4) == 3, np.zeros(4),
        next_observations={"k": numbers + 1} if as_dict else numbers + 1, observation_space=space,
    )  # fmt: skip
    data.to_minari(tmp_path / "set")
    (episode,) = minari.MinariDataset(tmp_path / "set" / "data").iterate_episodes()
    found = episode.observations["k"] if as_dict else episode.observations
    assert found.tolist() == [0, 1, 2, 3, 4] and (space["k"] if as_dict else space).contains(found[-1])
    assert_same(data, Dataset.from_minari(tmp_path / "set"))
    # Those of another program may count from 1.
    (name,) = (tmp_path / "set" / "data").glob("*.hdf5")
    with pytest.importorskip("h5py").File(name, "r+") as file:
        stored = file["episode_0/observations/k"] if as_dict else file["episode_0/observations"]
        stored[...] = stored[...] + 1
    with pytest.raises(ValueError, match=r"observations.* must .*5"):
        Dataset.from_minari(tmp_path / "set")


def test_a_buffer_of_discrete_actions_is_refused() -> None:
    buffer = ReplayBuffer(10, spaces.Box(-1, 1, (2,)), spaces.Discrete(3))
    with pytest.raises(ValueError, match=r"buffer must have actions of a Box, .* not of Discrete\(3\)"):
        Dataset.from_replay_buffer(buffer)


def test_columns_that_minari_has_no_place_for_are_warned_of(tmp_path: Path) -> None:
    pytest.importorskip("minari", reason="needs the extra [offline]")
    with pytest.warns(UserWarning, match=r"Minari's format has no place for columns=\['task'\]"):
        made(columns={"task": np.arange(60)}).to_minari(tmp_path / "set")
    assert_same(made(), Dataset.from_minari(tmp_path / "set"))


def test_minari_by_id_and_in_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("minari", reason="needs the extra [offline]")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    made().to_minari("toys/random-v0")
    assert_same(made(), Dataset.from_minari("toys/random-v0"))
    assert_same(made(), Dataset.from_minari("toys/random-v0", memory_map=tmp_path / "maps"))
    # By a name that is the path of a folder too, it is not clear where it is to be.
    monkeypatch.chdir(tmp_path / "maps")
    for name, folder in (("here/set-v5", "here"), ("set-v5", "set-v5")):
        Path(folder).mkdir()
        with pytest.raises(
            ValueError, match=rf"id_or_path='{name}' is an id of .* since {folder} is there: .*'./{name}'"
        ):
            made().to_minari(name)
        assert made().to_minari(f"./{name}") == Path(name).absolute()
    assert made().to_minari("other/set-v5") == tmp_path / "other" / "set-v5"
    with pytest.raises(ValueError, match="id_or_path='toys/other-v0' must be a data set of Minari's: there is none"):
        Dataset.from_minari("toys/other-v0")


def test_a_lying_episode_of_minari_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("minari", reason="needs the extra [offline]")
    h5py = pytest.importorskip("h5py")
    data = made()
    data.to_minari(tmp_path / "set")
    longest = max(range(data.n_episodes), key=lambda i: list(data.episodes())[i].stop - list(data.episodes())[i].start)
    with h5py.File(tmp_path / "set" / "data" / "main_data.hdf5", "a") as file:
        file[f"episode_{longest}"]["terminations"][0] = True
    with pytest.raises(ValueError, match=f"episode {longest} of .*none before the last step"):
        Dataset.from_minari(tmp_path / "set")


def test_flags_of_minari_that_are_numbers(tmp_path: Path) -> None:
    pytest.importorskip("minari", reason="needs the extra [offline]")
    h5py = pytest.importorskip("h5py")
    made().to_minari(tmp_path / "set")
    with h5py.File(tmp_path / "set" / "data" / "main_data.hdf5", "a") as file:
        for episode in file.values():
            for name in ("terminations", "truncations"):
                flags = episode[name][:].astype(np.float64)
                del episode[name]
                episode[name] = flags
    assert_same(made(), Dataset.from_minari(tmp_path / "set"))
    with h5py.File(tmp_path / "set" / "data" / "main_data.hdf5", "a") as file:
        file["episode_0"]["terminations"][-1] = 0.5
    with pytest.raises(ValueError, match="episode 0 of .*must be one a step, 0 or 1"):
        Dataset.from_minari(tmp_path / "set")


def test_nothing_is_left_of_a_set_that_was_not_written_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("minari", reason="needs the extra [offline]")
    data, read, n_read = made(), Dataset.rows, 0

    def interrupted(self: Dataset, rows: Any) -> Any:
        nonlocal n_read
        n_read += 1
        if n_read == 3:
            raise KeyboardInterrupt
        return read(self, rows)

    with monkeypatch.context() as patched:
        patched.setattr(Dataset, "rows", interrupted)
        with pytest.raises(KeyboardInterrupt):
            data.to_minari(tmp_path / "set")
    assert not list((tmp_path / "set").iterdir())
    data.to_minari(tmp_path / "set")
    assert_same(data, Dataset.from_minari(tmp_path / "set"))


def test_a_minari_folder_never_makes_an_environment(tmp_path: Path) -> None:
    pytest.importorskip("minari", reason="needs the extra [offline]")
    made().to_minari(tmp_path / "set")
    path = tmp_path / "set" / "data" / "metadata.json"
    text = path.read_text().replace('"observation_space"', '"other"')
    path.write_text(text)
    with pytest.raises(ValueError, match="has no spaces"):
        Dataset.from_minari(tmp_path / "set")


def d4rl(path: Path, **changes: Any) -> Path:
    h5py = pytest.importorskip("h5py", reason="needs the extra [offline]")
    data = made()
    rows = data.rows(slice(None))
    with h5py.File(path, "w") as file:
        names = {"terminations": "terminals", "truncations": "timeouts"}
        for name in KEYS[:-1]:
            file[names.get(name, name)] = rows[name]
        for name, value in changes.items():
            del file[name]
            if value is not None:
                file[name] = value
    return path


def test_d4rl_layout(tmp_path: Path) -> None:
    path = d4rl(tmp_path / "set.hdf5")
    rows = made().rows(slice(None))
    cut = rows["truncations"] & ~rows["terminations"]
    cut[-1] |= not rows["terminations"][-1]
    with pytest.warns(UserWarning, match=rf"{cut.sum()} of 60 steps left out of the data set, the last of episodes"):
        data = Dataset.from_hdf5(path, action_space=BOX)
    assert data.n_left_out == cut.sum() and len(data) == 60 - cut.sum()
    found = data.rows(slice(None))
    for name in ("observations", "actions", "rewards", "terminations"):
        assert np.array_equal(found[name], rows[name][~cut]), name
    stay = ~found["terminations"]
    assert np.array_equal(found["next_observations"][stay], rows["next_observations"][~cut][stay])
    with pytest.warns(UserWarning, match="left out"):
        assert_same(data, Dataset.from_hdf5(path, action_space=BOX, memory_map=tmp_path))


def test_what_of_a_d4rl_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="it lacks timeouts"):
        Dataset.from_hdf5(d4rl(tmp_path / "a.hdf5", timeouts=None), action_space=BOX)
    with pytest.raises(
        ValueError, match="actions must lie within the bounds .* in the environment's units, not .*step"
    ):
        Dataset.from_hdf5(d4rl(tmp_path / "b.hdf5"))
    with pytest.raises(ValueError, match="observations must be finite"):
        Dataset.from_hdf5(d4rl(tmp_path / "c.hdf5", observations=np.full((60, 3), np.nan)), action_space=BOX)
    (tmp_path / "d.hdf5").write_bytes(b"no")
    with pytest.raises(ValueError, match="must be an HDF5 file"):
        Dataset.from_hdf5(tmp_path / "d.hdf5")


def test_the_last_step_before_one_left_out_is_an_end() -> None:
    zeros = np.zeros(6)
    with pytest.warns(UserWarning, match="2 of 6 steps left out"):
        data = Dataset.from_arrays(np.arange(6.0)[:, None], zeros[:, None], zeros, zeros, [0, 0, 1, 0, 0, 0])
    assert [(rows.start, rows.stop) for rows in data.episodes()] == [(0, 2), (2, 4)]
    assert data.rows(slice(None))["next_observations"].ravel().tolist() == [1, 2, 4, 5]


@pytest.mark.parametrize("kind", ["compact", "plain", "memory", "dict", "hindsight", "n_step"])
def test_from_a_replay_buffer(kind: str) -> None:
    """The transitions of a buffer that has gone round, in their order, environment by environment."""
    box = spaces.Box(-3.0, 5.0, (2,), np.float32)
    kwargs: dict[str, Any] = {"truncate": True, "action_space": box}
    goals = spaces.Dict({name: spaces.Box(-9, 9, (2,)) for name in ("observation", "achieved_goal", "desired_goal")})
    more: dict[str, Any] = {"buffer_size": 40, "learning_starts": 100}
    if kind in ("dict", "hindsight"):
        kwargs["obs_space"] = goals
        more["policy"] = "MultiInputPolicy"
        more["replay_buffer_class"] = DictReplayBuffer if kind == "dict" else HerReplayBuffer
    if kind in ("plain", "memory"):
        more["replay_buffer_class"] = ReplayBuffer
    if kind == "memory":
        # Stable-Baselines3's variant knows no time limits.
        more |= {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    if kind == "n_step":
        more["n_steps"] = 3
    if kind == "hindsight":
        env: Any = DummyVecEnv([lambda: Goals(**kwargs)] * 2)
    else:
        env = vec(2, **kwargs)
    model = sac(env, **more).learn(66)
    data = Dataset.from_replay_buffer(model.replay_buffer)
    n = 19 if kind == "memory" else 20
    rows = data.rows(slice(None))
    # Toys count their steps: 33 of each environment, of which the last 20 are there.
    steps = (np.arange(33 - n, 33) % 7).tolist() * 2
    seen = rows["observations"]["observation"] if isinstance(rows["observations"], dict) else rows["observations"]
    then = rows["next_observations"]
    then = then["observation"] if isinstance(then, dict) else then
    assert seen[:, 0].tolist() == steps and rows["rewards"].tolist() == [t + 1 for t in steps]
    if kind != "memory":
        assert then[:, 0].tolist() == [t + 1 for t in steps]
        assert not rows["terminations"].any()
        assert np.flatnonzero(rows["truncations"]).tolist() == [i for i in range(40) if steps[i] == 6 or i in (19, 39)]
    actions = rows["actions"]
    assert actions.dtype == np.float32 and actions.min() < -1 and actions.max() > 1 and actions.shape == (2 * n, 2)
    batch = data.take(torch.arange(2 * n))
    stored = model.replay_buffer.actions.reshape(-1, 2)
    np.testing.assert_allclose(np.sort(batch.actions.numpy(), 0), np.sort(stored, 0)[-2 * n :], atol=1e-6) if (
        kind != "memory"
    ) else None


def test_a_replay_buffer_of_pictures_is_read_in_small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each key of dict observations alone."""
    parts = {"picture": spaces.Box(0, 255, (1, 30, 30), np.uint8), "vector": spaces.Box(-1, 1, (2,), np.float64)}
    space = spaces.Dict(parts)
    buffer = DictReplayBuffer(200, space, BOX, "cpu")
    rng = np.random.default_rng(0)
    for part in (buffer.observations, buffer.next_observations):
        part["picture"][:] = rng.integers(0, 255, part["picture"].shape)
        part["vector"][:] = rng.uniform(-1, 1, part["vector"].shape)
    buffer.pos, buffer.full = 0, True
    monkeypatch.setattr(steps, "CHUNK_BYTES", 10_000)
    gathered: list[int] = []
    gather = dataset_buffers.observations_at

    def noted(*args: Any) -> Any:
        found = gather(*args)
        gathered.append(sum(part.nbytes for part in found.values()) if isinstance(found, dict) else found.nbytes)
        return found

    monkeypatch.setattr(dataset_buffers, "observations_at", noted)
    with pytest.warns(UserWarning, match="are not the following observations"):
        data = Dataset.from_replay_buffer(buffer)
    seen = data.rows(slice(None))["next_observations"]
    assert np.array_equal(seen["picture"], buffer.next_observations["picture"][:, 0])
    assert max(gathered) <= 10_000 and sum(gathered) < 2.2 * buffer.observations["picture"].nbytes


class Goals(Toy):
    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, infos: Any) -> np.ndarray:
        return np.zeros(len(achieved))


class Linear:
    """A policy that adds its observation to what it does."""

    def predict(self, observation: np.ndarray, state: Any = None, **kwargs: Any) -> tuple[np.ndarray, Any]:
        return np.clip(observation[:, :2] / 10, -1, 1), state


def test_record_whole_episodes_of_several_environments() -> None:
    env = DummyVecEnv([lambda: Toy(length=4), lambda: Toy(length=3, truncate=True)])
    data = record(Linear(), env, 5)
    rows = data.rows(slice(None))
    assert data.n_episodes == 5 and len(data) == 2 * 4 + 3 * 3
    lengths = [each.stop - each.start for each in data.episodes()]
    assert sorted(lengths) == [3, 3, 3, 4, 4]
    for part in data.episodes():
        length = part.stop - part.start
        assert rows["observations"][part, 0].tolist() == list(range(length))
        assert rows["next_observations"][part, 0].tolist() == list(range(1, length + 1))
        assert np.flatnonzero(rows["terminations"][part]).tolist() == ([3] if length == 4 else [])
        assert np.flatnonzero(rows["truncations"][part]).tolist() == ([] if length == 4 else [2])
    np.testing.assert_array_equal(rows["actions"], rows["observations"][:, :2] / np.float32(10))


def test_an_episode_whose_worker_died_is_recorded_again() -> None:
    class Dies(DummyVecEnv):
        n_steps = 0

        def step_wait(self) -> Any:
            observations, rewards, dones, infos = super().step_wait()
            Dies.n_steps += 1
            if Dies.n_steps == 6:  # in the second episode, as SupervisedSubprocVecEnv tells
                last, observations = observations, self.reset()
                infos = [{"worker_died": "why", "TimeLimit.truncated": True, "terminal_observation": last[0]}]
                rewards, dones = np.zeros(1, np.float32), np.ones(1, bool)
            return observations, rewards, dones, infos

    data = record(Linear(), Dies([lambda: Toy(length=4)]), 2)
    assert [part.stop - part.start for part in data.episodes()] == [4, 4] and Dies.n_steps == 4 + 2 + 4
    assert data.rows(slice(None))["observations"][:, 0].tolist() == [0, 1, 2, 3] * 2


def test_record_closes_the_environment_that_it_makes(monkeypatch: pytest.MonkeyPatch) -> None:
    made = vec()
    closed: list[bool] = []
    monkeypatch.setattr(made, "close", lambda: closed.append(True))
    monkeypatch.setattr("sb3_sample.replay.recording.make_vec_env", lambda env: made)
    assert record(Linear(), "an id", 2).n_episodes == 2 and closed == [True]


def test_record_takes_original_observations_of_a_normalized_environment() -> None:
    venv = VecNormalize(vec(), norm_reward=True)
    venv.reset()
    for _ in range(20):
        venv.step(np.zeros((1, 2)))
    before = venv.obs_rms.mean.copy()
    data = record(Linear(), venv, 2)
    rows = data.rows(slice(None))
    assert (
        rows["observations"][:, 0].tolist() == list(range(7)) * 2 and rows["rewards"].tolist() == list(range(1, 8)) * 2
    )
    np.testing.assert_array_equal(venv.obs_rms.mean, before)
    expected = np.clip(venv.normalize_obs(rows["observations"])[:, :2] / 10, -1, 1)
    np.testing.assert_allclose(rows["actions"], expected, rtol=1e-6)


class Numbered(gym.Env):
    """Observations that are the number of the step."""

    observation_space, action_space = spaces.Discrete(9), spaces.Box(-1, 1, (2,))

    def reset(self, **kwargs: Any) -> tuple[int, dict]:
        super().reset(**kwargs)
        self.at = 0
        return self.at, {}

    def step(self, action: Any) -> tuple[int, float, bool, bool, dict]:
        self.at += 1
        return self.at, 1.0, self.at == 3, False, {}


def test_record_refuses_other_actions_before_the_first_step() -> None:
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, device="cpu")
    env = DummyVecEnv([lambda: gym.make("CartPole-v1")])
    env.step = env.reset = None  # type: ignore[assignment, method-assign]  # called by nobody
    with pytest.raises(ValueError, match=r"env: its actions must be of a Box, .*, not of Discrete\(2\)"):
        record(model, env, 1)


def test_record_numbers_as_observations() -> None:
    model = sac(Numbered())
    data = record(model, Numbered(), 2)
    rows = data.rows(slice(None))
    assert data.observation_space == Numbered.observation_space
    assert rows["observations"].ravel().tolist() == [0, 1, 2] * 2
    assert rows["next_observations"].ravel().tolist() == [1, 2, 3] * 2
    assert rows["rewards"].shape == rows["terminations"].shape == (6,)
    assert sac(Numbered()).learn_offline(data, 2).num_timesteps == 2


def test_record_several_tasks() -> None:
    env = multi_task_env(("Pendulum-v1", "MountainCarContinuous-v0"), seed=0, env_kwargs={"max_episode_steps": 5})
    model = sac(env, policy="MultiInputPolicy")
    data = record(model, env, 4)
    rows = data.rows(slice(None))
    assert sorted(rows["observations"]["task"].ravel().tolist()) == [0] * 10 + [1] * 10
    np.testing.assert_array_equal(rows["next_observations"]["task"], rows["observations"]["task"])
    assert model.learn_offline(data, 2).num_timesteps == 2


def test_record_refuses_original_observations_for_a_model_of_normalized_ones(tmp_path: Path) -> None:
    venv = VecNormalize(vec())
    model = sac(venv).learn(30)
    assert len(record(model, venv, 1)) == 7
    with pytest.raises(ValueError, match="env must be in a VecNormalize with the statistics"):
        record(model, vec(), 1)
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="env must be in a VecNormalize with the statistics"):
        record(SAC.load(tmp_path / "model"), vec(), 1)
    with pytest.warns(UserWarning, match="env must be in a VecNormalize with the statistics"):
        record(SAC.load(tmp_path / "model", env=vec()), vec(), 1)
    of_rewards = VecNormalize(vec(), norm_obs=False)
    record(sac(of_rewards).learn(30), vec(), 1)


def test_record_by_id_with_a_seed() -> None:
    model = sac("Pendulum-v1")
    one, two, other = (record(model, "Pendulum-v1", 1, seed=seed) for seed in (0, 0, 1))
    assert_same(one, two)
    assert one.fingerprint != other.fingerprint and one.action_space == gym.make("Pendulum-v1").action_space
    with pytest.raises(ValueError, match="episodes must be an integer of at least 1, not 0"):
        record(model, "Pendulum-v1", 0)
    with pytest.raises(ValueError, match="^env: its observation_space is Box.*, and the model's is Box"):
        record(model, "MountainCarContinuous-v0", 1)


def test_a_dataset_in_files_is_the_same(tmp_path: Path) -> None:
    assert_same(made(), made(memory_map=tmp_path))
    a, b = made(seed=1).sample(50), made(seed=1, memory_map=tmp_path).sample(50)
    assert torch.equal(a.observations, b.observations) and torch.equal(a.actions, b.actions)


def test_actions_stay_in_the_environments_units() -> None:
    data = made()
    rows, batch = data.rows(slice(None)), data.take(torch.arange(60))
    assert rows["actions"].max() > 2
    scaled = 2 * (rows["actions"].astype(np.float64) - BOX.low) / (BOX.high.astype(float) - BOX.low) - 1
    np.testing.assert_array_equal(batch.actions.numpy(), scaled.astype(np.float32))
