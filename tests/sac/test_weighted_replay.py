"""Replay that is faded by age, prioritised (LAP), and of windows: numbers by hand, distributions, files."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample import (
    BRO,
    SAC,
    FadedDictReplayBuffer,
    FadedReplayBuffer,
    PrioritizedDictReplayBuffer,
    PrioritizedReplayBuffer,
    WindowReplayBuffer,
)
from sb3_sample.learner.batch import SLOTS, Windows
from sb3_sample.parts import Column
from sb3_sample.replay.weights import DrawWeights
from sb3_sample.saving.container import BadFile
from tests.sac.common import MAKERS, bro, differing, sac, sampled, state, vec

OBSERVATION, ACTION = spaces.Box(-1e6, 1e6, (1,), np.float32), spaces.Box(-1, 1, (1,), np.float32)


def buffer_of(cls: Any, size: int = 10, n_envs: int = 1, **kwargs: Any) -> Any:
    return cls(size * n_envs, OBSERVATION, ACTION, device="cpu", n_envs=n_envs, **kwargs)


def add(buffer: Any, t: int, done: Any = False, truncated: Any = False) -> None:
    """The step with the number t: its observation is t, the next one t + 1/2 at an end, else t + 1."""
    n = buffer.n_envs
    done, truncated = np.broadcast_to(done, n), np.broadcast_to(truncated, n)
    now = np.full((n, 1), t, np.float32) + 100 * np.arange(n)[:, None]
    buffer.add(
        now, now + np.where(done | truncated, 0.5, 1)[:, None], np.zeros((n, 1), np.float32),
        np.full(n, t, np.float32), (done | truncated).astype(np.float32),
        [{"TimeLimit.truncated": bool(cut)} for cut in truncated],
    )  # fmt: skip


# ---------------------------------------------------------------- faded


def test_ages_by_hand() -> None:
    """Three steps that halve down to a floor of 0.3: weights 1, 0.5, 0.3, 0.3, sum 2.1."""
    buffer = buffer_of(FadedReplayBuffer, fade=0.5, fade_floor=0.3)
    for t in range(4):
        add(buffer, t)
    edges = np.cumsum([1, 0.5, 0.3, 0.3]) / 2.1
    below, above = edges - 1e-6, edges[:-1] + 1e-6
    np.testing.assert_array_equal(buffer.ages(np.array([0.0, *below])), [0, 0, 1, 2, 3])
    np.testing.assert_array_equal(buffer.ages(above), [1, 2, 3])


@pytest.mark.parametrize(("fade", "floor"), [(0.9, 0.0), (0.9, 0.2), (0.9, 1.0), (1.0, 0.1), (0.999, 0.5), (1e-3, 0.1)])
@pytest.mark.parametrize("n", [1, 2, 30])
def test_ages_are_the_inverse_of_the_summed_weights(fade: float, floor: float, n: int) -> None:
    buffer = buffer_of(FadedReplayBuffer, size=30, fade=fade, fade_floor=floor)
    for t in range(n):
        add(buffer, t)
    weights = np.maximum(fade ** np.arange(n), floor)
    edges = np.concatenate(([0], np.cumsum(weights) / weights.sum()))
    uniform = np.random.default_rng(0).random(2_000)
    uniform = uniform[np.abs(uniform[:, None] - edges).min(axis=1) > 1e-9]
    np.testing.assert_array_equal(buffer.ages(uniform), np.searchsorted(edges, uniform, side="right") - 1)
    assert buffer.ages(np.array([0.0, np.nextafter(1, 0)])).tolist() == [0, buffer.ages(np.array([1 - 1e-12]))[0]]


def test_draws_have_the_ages_frequencies_in_a_full_ring() -> None:
    buffer = buffer_of(FadedReplayBuffer, size=5, n_envs=2, fade=0.5, fade_floor=0.25)
    for t in range(13):
        add(buffer, t)
    np.random.seed(0)
    samples = buffer.sample(20_000)
    ages = 12 - samples.observations.numpy().ravel() % 100
    weights = np.array([1, 0.5, 0.25, 0.25, 0.25]) / 2.25
    found = np.bincount(ages.astype(int), minlength=5) / 20_000
    np.testing.assert_allclose(found, weights, atol=4 * np.sqrt(0.25 / 20_000))
    assert abs((samples.observations.numpy() >= 100).mean() - 0.5) < 0.02
    np.testing.assert_array_equal(samples.next_observations, samples.observations + 1)


def test_no_fading_is_uniform_and_a_model_draws_what_the_buffer_does() -> None:
    model = sac(replay_buffer_class=FadedReplayBuffer, replay_buffer_kwargs={"fade": 0.9}, replay_ratio=3).learn(40)
    assert type(model.replay_buffer) is FadedReplayBuffer and model._n_updates == 90
    np.random.seed(3)
    batches = model._source.batches(2, 8)
    np.random.seed(3)
    samples = model.replay_buffer.sample(16)
    assert torch.equal(torch.cat([batch.observations for batch in batches]), samples.observations)


@pytest.mark.parametrize("maker", ["SAC", "DAC", "OPLSAC"])
def test_faded_in_other_agents_saved_and_resumed(maker: str, tmp_path: Path) -> None:
    kwargs: dict[str, Any] = {"replay_buffer_class": FadedReplayBuffer, "replay_buffer_kwargs": {"fade": 0.9}}
    straight = MAKERS[maker](**kwargs).learn(60, checkpoint=tmp_path / "a", checkpoint_freq=100)
    MAKERS[maker](**kwargs).learn(33, checkpoint=tmp_path / "b", checkpoint_freq=100)
    resumed = MAKERS[maker](**kwargs).learn(60, checkpoint=tmp_path / "b", checkpoint_freq=100)
    assert not differing(state(straight), state(resumed))
    straight.save(tmp_path / "m")
    loaded = type(straight).load(tmp_path / "m", env=vec())
    assert (loaded.replay_buffer.fade, loaded.replay_buffer.fade_floor) == (0.9, 0.1)


# ---------------------------------------------------------------- weights


def weights_of(n: int = 4, **kwargs: Any) -> DrawWeights:
    defaults = {"fade": 1.0, "fade_floor": 0.1, "priority_exponent": 0.4, "smallest_error": 1.0}
    return DrawWeights(n, **{**defaults, **kwargs})


def test_priorities_by_hand() -> None:
    """LAP: (max(|δ|, 1)) ** 0.4; new transitions have the largest so far, which is never lowered."""
    weights = weights_of()
    weights.set_ready(weights.put(2))
    assert weights.priority[:2].tolist() == [1, 1]
    weights.renew(np.array([0, 1]), np.array([0.25, 32.0]))
    np.testing.assert_allclose(weights.priority[:2], [1, 4], rtol=1e-6)
    weights.set_ready(weights.put(1))
    weights.renew(np.array([1]), np.array([0.0]))
    np.testing.assert_allclose(weights.priority, [1, 1, 4, 0], rtol=1e-6)
    assert weights.max_priority == pytest.approx(4)
    # Smaller errors than 1 count, and the clamp comes before the power.
    assert weights_of(smallest_error=0.5).priorities(np.array([0.1, 0.7]))[0] == pytest.approx(0.5**0.4)


def test_draws_by_hand() -> None:
    """Weights 1, 4, 3, the third not ready: the first slot up to which they sum to the share."""
    weights = weights_of()
    slots = weights.put(3)
    weights.set_priorities(slots, np.array([1, 4, 3], np.float32))
    weights.set_ready(slots[:2])
    np.testing.assert_array_equal(weights.draw(np.array([1e-12, 0.2, 0.2 + 1e-9, 1.0])), [0, 0, 1, 1])
    weights.set_ready(slots[2:])
    np.testing.assert_array_equal(weights.draw(np.array([0.125, 0.126, 0.625, 0.626, 1.0])), [0, 1, 1, 2, 2])
    with pytest.raises(ValueError, match="there is no transition to draw"):
        weights_of().draw(np.array([0.5]))


def test_fading_by_hand() -> None:
    weights = weights_of(fade=0.5, fade_floor=0.2)
    weights.set_ready(weights.put(4))
    np.testing.assert_allclose(weights.faded(), [0.2, 0.25, 0.5, 1], rtol=1e-6)
    weights.set_ready(weights.put(1))
    np.testing.assert_allclose(weights.faded(), [1, 0.2, 0.25, 0.5], rtol=1e-6)
    weights.set_priorities(np.array([1]), np.array([5.0], np.float32))
    np.testing.assert_allclose(weights.values(), [1, 1, 0.25, 0.5], rtol=1e-6)


def test_errors_that_are_not_finite_change_nothing() -> None:
    weights = weights_of()
    weights.set_ready(weights.put(3))
    weights.renew(np.array([0, 1, 2]), np.array([np.nan, np.inf, 32.0]))
    np.testing.assert_allclose(weights.priority[:3], [1, 1, 4], rtol=1e-6)


# ---------------------------------------------------------------- prioritised


def test_errors_of_a_step_are_the_priorities_of_its_transitions() -> None:
    model = sac(replay_buffer_class=PrioritizedReplayBuffer, replay_buffer_kwargs={"smallest_error": 0.0},
                learning_starts=20, ent_coef=0.0).learn(20)  # fmt: skip
    buffer: Any = model.replay_buffer
    batch = model._source.batches(1, 8)[0]
    slots = batch.columns[SLOTS].ravel()
    with torch.no_grad():
        next_actions, _ = model.learner.next_actions(batch.next_observations, torch.zeros(8, 2))
        next_q = model.critic_target.q_values(batch.next_observations, next_actions).amin(dim=0)
        target = batch.rewards + model.gamma * (1 - batch.dones) * next_q
        errors = (model.critic.q_values(batch.observations, batch.actions) - target).abs().amax(dim=0).ravel()
    from sb3_sample.learner.batch import Noise

    model._update(batch, Noise(*torch.zeros(4, 8, 2)))
    assert model.learner.td_errors is not None
    torch.testing.assert_close(model.learner.td_errors, errors)
    np.testing.assert_allclose(buffer.weights.priority[slots], errors.numpy() ** 0.4, rtol=1e-4)
    untouched = np.setdiff1d(np.arange(20), slots)
    assert (buffer.weights.priority[untouched] == 1).all()


def test_nothing_is_computed_without_priorities() -> None:
    model = sac().learn(20)
    assert model._n_updates and model.learner.td_errors is None


@pytest.mark.parametrize("maker", sampled(["SAC", "BRO", "BROTD3"], ["BRO"]))
def test_prioritised_in_other_agents(maker: str, tmp_path: Path) -> None:
    kwargs: dict[str, Any] = {"replay_buffer_class": PrioritizedReplayBuffer, "replay_ratio": 2,
                              "replay_buffer_kwargs": {"fade": 0.99, "smallest_error": 0.1}}  # fmt: skip
    straight = MAKERS[maker](**kwargs).learn(60, checkpoint=tmp_path / "a", checkpoint_freq=100)
    MAKERS[maker](**kwargs).learn(33, checkpoint=tmp_path / "b", checkpoint_freq=100)
    resumed = MAKERS[maker](**kwargs).learn(60, checkpoint=tmp_path / "b", checkpoint_freq=100)
    assert not differing(state(straight), state(resumed))
    ours, theirs = straight.replay_buffer.weights, resumed.replay_buffer.weights
    np.testing.assert_array_equal(ours.priority, theirs.priority)
    assert len(np.unique(ours.priority[:60])) > 20


def test_dicts_and_normalisation() -> None:
    space = spaces.Dict({"a": spaces.Box(-10, 10, (2,), np.float32), "b": spaces.Discrete(9)})
    for cls in (PrioritizedDictReplayBuffer, FadedDictReplayBuffer):
        env = VecNormalize(vec(2, obs_space=space), norm_obs_keys=["a"])
        model = sac(env, policy="MultiInputPolicy", replay_buffer_class=cls)
        assert model.learn(40)._n_updates == 30


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"fade": 0.0}, r"replay_buffer_kwargs\['fade'\] must lie in \(0, 1\], not 0.0"),
        ({"fade": 1.5}, r"replay_buffer_kwargs\['fade'\] must .*not 1.5"),
        ({"fade": 0.9, "fade_floor": 0.0}, "fade=0.9 needs a fade_floor above 0"),
        ({"fade_floor": 2}, r"replay_buffer_kwargs\['fade_floor'\] must lie in \[0, 1\], not 2"),
        ({"priority_exponent": -1}, "priority_exponent'.* must be at least 0 and finite, not -1"),
        ({"smallest_error": "1"}, "smallest_error'.* must be at least 0 and finite, not '1'"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        sac(replay_buffer_class=PrioritizedReplayBuffer, replay_buffer_kwargs=kwargs)


@pytest.mark.parametrize("cls", [FadedReplayBuffer, PrioritizedReplayBuffer, WindowReplayBuffer])
def test_not_with_transitions_held_out(cls: Any) -> None:
    with pytest.raises(ValueError, match=rf"validation_proportion=0.1 .*={cls.__name__} .*leave one of them out"):
        sac(replay_buffer_class=cls, validation_proportion=0.1)


def test_not_with_n_step_returns() -> None:
    with pytest.raises(ValueError, match="n_steps=3 needs a buffer that makes n-step returns"):
        sac(replay_buffer_class=PrioritizedReplayBuffer, n_steps=3)


# ---------------------------------------------------------------- windows


def ready(buffer: Any) -> list[int]:
    """Numbers of the transitions that start windows."""
    weights = buffer.weights
    return sorted(weights.ordinal[: weights.size][weights.ready[: weights.size]].tolist())


def test_which_transitions_start_windows() -> None:
    """Those with two later ones in their episode; all up to a termination; none of the last two before a time limit."""
    buffer = buffer_of(WindowReplayBuffer, size=20, horizon=2)
    found = []
    for t in range(9):
        add(buffer, t, done=t == 3, truncated=t == 7)
        found.append(ready(buffer))
    assert found == [[], [], [0], [0, 1, 2, 3], [0, 1, 2, 3], [0, 1, 2, 3], [0, 1, 2, 3, 4], [0, 1, 2, 3, 4, 5],
                     [0, 1, 2, 3, 4, 5]]  # fmt: skip
    # Nine transitions and the ends of two episodes, the second of which counts as one more is stored.
    assert buffer.weights.size == buffer.weights.n_taken == 11


def test_windows_are_consecutive_and_end_with_the_episodes_own_observation() -> None:
    buffer = buffer_of(WindowReplayBuffer, size=8, n_envs=2, horizon=3)
    for t in range(21):
        add(buffer, t, done=np.array([t % 5 == 4, False]), truncated=np.array([False, t % 6 == 5]))
    np.random.seed(0)
    windows: Windows = buffer.windows(400, 3)
    starts = windows.observations.ravel()
    counts = np.cumprod(np.concatenate((np.ones((400, 1)), 1 - windows.dones.numpy()), axis=1), axis=1)[:, :3] == 1
    times = starts[:, None] % 100 + torch.arange(3)
    np.testing.assert_array_equal(windows.rewards[counts], times[counts])
    ends = (starts[:, None] < 100) & (times % 5 == 4)
    np.testing.assert_array_equal(windows.dones[counts], ends[counts])
    following = starts[:, None] + torch.arange(3) + torch.where(ends, 0.5, 1)
    np.testing.assert_array_equal(windows.next_observations[:, :, 0][counts], following[counts])
    # Both environments, windows over ends among them, and none over a time limit.
    assert 0 < (starts >= 100).sum() < 400 and (~counts).any()
    assert ((starts[starts >= 100] % 100) % 6 <= 3).all()


class Labelled(WindowReplayBuffer):
    more_columns = (
        Column("label", lambda step: step.reward.astype(np.int64) + 100 * np.arange(len(step.reward)), dtype=np.int64),
        Column("extent", lambda step: np.stack([step.reward, -step.reward], axis=1), shape=(2,)),
        Column("inside", lambda step: step.done, in_batch=False),
    )


def test_windows_have_the_buffers_own_columns_of_their_first_steps() -> None:
    buffer = buffer_of(Labelled, size=8, n_envs=2, horizon=3)
    for t in range(21):
        add(buffer, t)
    windows: Windows = buffer.windows(100, 3)
    assert windows.columns.keys() == buffer.sample(4).columns.keys() == {"label", "extent", SLOTS}
    label, extent = windows.columns["label"], windows.columns["extent"]
    assert (label.dtype, label.shape, extent.shape) == (torch.int64, (100, 1), (100, 2))
    # Both environments' observations count the steps, the second's from 100 on.
    assert torch.equal(label, windows.observations.long()) and len(label.unique()) > 6
    assert torch.equal(extent, torch.cat((windows.rewards[:, :1], -windows.rewards[:, :1]), 1))
    assert torch.equal(windows.n_step(0.9).columns["label"], label)


def test_n_step_returns_by_hand() -> None:
    windows = Windows(
        torch.zeros(3, 1), torch.arange(9.0).reshape(3, 3, 1), torch.arange(9.0).reshape(3, 3, 1),
        torch.tensor([[0.0, 0, 0], [0, 1, 0], [1, 0, 1]]), torch.tensor([[1.0, 2, 4], [1, 2, 4], [1, 2, 4]]),
    )  # fmt: skip
    batch = windows.n_step(0.5)
    assert batch.rewards.ravel().tolist() == [1 + 1 + 1, 1 + 1, 1]
    assert batch.dones.ravel().tolist() == [0, 1, 1] and batch.discounts == 0.125
    assert batch.actions.ravel().tolist() == [0, 3, 6] and batch.next_observations.ravel().tolist() == [2, 5, 8]


def test_no_window_runs_over_a_reset_of_the_environment() -> None:
    """``learn`` once more begins new episodes, without an end of the old ones."""
    model = MAKERS["DebiasedRQ"](vec(length=50), learning_starts=200).learn(12)
    model.learn(12)
    assert ready(model.replay_buffer) == [*range(7), *range(12, 19)]


def test_a_buffer_too_small_for_windows() -> None:
    with pytest.raises(ValueError, match="buffer_size must be at least 24 for windows of 5 steps of 2 environments"):
        MAKERS["DebiasedRQ"](vec(2), buffer_size=20)


# ---------------------------------------------------------------- files


def test_a_buffer_goes_on_as_it_was(tmp_path: Path) -> None:
    model = MAKERS["DebiasedRQ"](buffer_size=40).learn(60)
    model.save_replay_buffer(tmp_path / "b")
    other = MAKERS["DebiasedRQ"](buffer_size=40, seed=3)
    other.load_replay_buffer(tmp_path / "b")
    ours, theirs = model.replay_buffer, other.replay_buffer
    for t in range(100, 115):
        for buffer in (ours, theirs):
            n, done = buffer.n_envs, t == 107
            step = np.full((n, 3), t, np.float32)
            buffer.add(step, step + 1, np.zeros((n, 2)), np.zeros(n), np.full(n, done), [{}] * n)
    a, b = ours.changing_state(), theirs.changing_state()
    assert a.keys() == b.keys()
    for name, value in a.items():
        np.testing.assert_array_equal(value, b[name], err_msg=name)


def test_a_buffer_of_another_horizon_is_refused(tmp_path: Path) -> None:
    MAKERS["DebiasedRQ"]().learn(20).save_replay_buffer(tmp_path / "b")
    other = MAKERS["DebiasedRQ"](encoder_horizon=4)
    with pytest.raises(ValueError, match="windows of 5 steps, but this model needs 4"):
        other.load_replay_buffer(tmp_path / "b")


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("n_taken", lambda value: value + 1),
        ("n_stored", lambda value: value - 1),
        ("n_stored", lambda value: float(value)),
        ("max_priority", lambda value: math.inf),
        ("size", lambda value: 10**9),
        ("ordinal", lambda value: value + 1),
        ("ordinal", lambda value: value[:-1]),
        ("ordinal", lambda value: np.where(value == value.max(), -2, value)),
        ("priority", lambda value: value * np.float32(np.nan)),
        ("priority", lambda value: -value),
        ("priority", lambda value: value.astype(np.float64)),
        ("ready", lambda value: value.astype(np.float32)),
        ("ready", lambda value: ~value),
        ("open_slots", lambda value: value - 1000),
        ("open_slots", lambda value: value[:, :-1]),
        ("n_pushed", lambda value: value.astype(np.float32)),
    ],
)
def test_a_state_that_is_none_is_refused(name: str, change: Any) -> None:
    buffer: Any = MAKERS["DebiasedRQ"]().learn(30).replay_buffer
    good = buffer.changing_state()
    buffer.load_changing_state(good)
    with pytest.raises(ValueError):
        buffer.load_changing_state({**good, name: change(good[name])})
    with pytest.raises(ValueError):
        buffer.load_changing_state({key: value for key, value in good.items() if key != name})


def test_a_file_without_weights_is_refused(tmp_path: Path) -> None:
    sac().learn(20).save_replay_buffer(tmp_path / "b")
    model = sac(replay_buffer_class=PrioritizedReplayBuffer)
    model.load_replay_buffer(tmp_path / "b")
    assert type(model.replay_buffer).__name__ == "CompactReplayBuffer"


def test_they_are_public() -> None:
    assert {BadFile, BRO, SAC} and bro(replay_buffer_class=FadedReplayBuffer).learn(20)._n_updates == 10
