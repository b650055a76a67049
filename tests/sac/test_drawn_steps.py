"""Gradient steps that draw their batches and noise themselves, from a buffer on the device."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from sb3_sample import DeviceReplayBuffer, train_many
from sb3_sample.learner.execution import Execution
from sb3_sample.learner.group import LearnerGroup
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.replay.buffers import PLAIN_BUFFERS, DeviceValidationReplayBuffer, latest
from sb3_sample.sac import SAC, VPLSAC, many
from tests.sac.common import COMPILES, MAKERS, TINY_SAC, Toy, sac, sampled, state, vec
from tests.sac.test_execution import Recorder

DRAWN: dict[str, Any] = {"replay_buffer_class": DeviceReplayBuffer, "replay_buffer_kwargs": {"sampling": "device"}}


def model_of(maker: str, **kwargs: Any) -> Any:
    """A model with 60 transitions, whose gradient steps have been taken."""
    return MAKERS[maker](**{"compile": False, "seed": 0, "buffer_size": 500, **DRAWN, **kwargs}).learn(60)


def refuses(maker: str) -> bool:
    try:
        MAKERS[maker](**DRAWN, buffer_size=100)
    except ValueError:
        return True
    return False


#: Without transforms of batches, or looks at the batch after the step.
ABLE = [name for name in MAKERS if not refuses(name)]


def same(a: Any, b: Any) -> bool:
    ours, theirs = state(a), state(b)
    return ours.keys() == theirs.keys() and all(torch.equal(x, theirs[name]) for name, x in ours.items())


def test_which_can() -> None:
    assert {"SAC", "BRO", "DAC", "OAC", "TOPSAC", "SimBa", "CrossQ", "BROTD3"} <= set(ABLE)
    assert {"VPLSAC", "GPLSAC", "OPLSAC"} <= set(ABLE)
    assert not {"DebiasedRQ", "SimbaV2"} & set(ABLE)


def n_further(model: Any) -> int:
    """What a step of a model is to draw for its rule of pessimism, 2 transitions being held out of 8."""
    buffer = model.replay_buffer
    held_out = 2 if isinstance(buffer, DeviceValidationReplayBuffer) else 0
    return int(model.pessimism_rule.n_further(held_out, buffer.size()))


@pytest.mark.parametrize("n_envs", [1, 3])
def test_every_stored_transition_is_drawn_equally_often(n_envs: int) -> None:
    model = sac(vec(n_envs), buffer_size=20 * n_envs, compile=False, learning_starts=1_000, **DRAWN)
    buffer = model.replay_buffer
    for n_steps in (7, 13, 17):  # filling, full, overwritten
        model.learn(n_steps * n_envs)
        buffer.rewards.copy_(torch.arange(20 * n_envs).reshape(20, n_envs))  # each tells its place
        buffer.prepare_draws()
        torch.manual_seed(0)
        drawn = buffer.draw(20_000)
        n_places = buffer.size() * n_envs
        counts = torch.bincount(drawn.rewards[:, 0].long(), minlength=n_places)
        assert len(counts) == n_places
        assert stats.chisquare(counts.numpy()).pvalue > 1e-3
        places = drawn.rewards[:, 0].long()
        for name in ("observations", "next_observations", "actions"):
            assert torch.equal(getattr(drawn, name), getattr(buffer, name).flatten(0, 1)[places])
    assert buffer.full


@pytest.mark.parametrize("n_envs", [1, 3])
def test_each_side_is_drawn_equally_often(n_envs: int) -> None:
    """The split is that of a replay buffer on the host, by the same seed."""
    arguments = {"learning_starts": 1_000, "compile": False, "buffer_size": 20 * n_envs, "validation_proportion": 0.3}
    model = sac(vec(n_envs), VPLSAC, **arguments, **DRAWN)
    on_host = sac(vec(n_envs), VPLSAC, **arguments)
    buffer = model.replay_buffer
    for n_steps in (7, 13, 17, 12):  # filling, full, overwritten
        for each in (model, on_host):
            each.set_random_seed(n_steps)
            each.learn(n_steps * n_envs)
        buffer.rewards.copy_(torch.arange(20 * n_envs).reshape(20, n_envs))  # each tells its place
        assert (buffer.held_out == on_host.replay_buffer.held_out).all()
        buffer.prepare_draws()
        torch.manual_seed(0)
        stored = np.arange(buffer.size() * n_envs)
        held_out = buffer.held_out.flatten()[stored]
        for draw, side in ((buffer.draw, stored[~held_out]), (buffer.draw_held_out, stored[held_out])):
            drawn = draw(20_000)
            places, counts = np.unique(drawn.rewards.long().numpy(), return_counts=True)
            assert places.tolist() == side.tolist()
            assert len(side) == 1 or stats.chisquare(counts).pvalue > 1e-3
            at = drawn.rewards[:, 0].long()
            assert torch.equal(drawn.observations, buffer.observations.flatten(0, 1)[at])
    assert buffer.full and 0 < buffer.n_validation < buffer.n_training


@pytest.mark.parametrize("n_envs", [1, 3])
def test_the_newest_steps_are_the_latest(n_envs: int) -> None:
    buffer = sac(vec(n_envs), buffer_size=20 * n_envs, compile=False, learning_starts=1_000, **DRAWN)
    for n_steps in (7, 15, 17):
        buffer.learn(n_steps * n_envs)
        store = buffer.replay_buffer
        store.prepare_draws()
        found, expected = store.newest(5), latest(store, 5)
        assert torch.equal(found[1], expected[1]) and found[1].shape == (5, n_envs)
        for name in ("observations", "actions", "next_observations", "dones", "rewards"):
            assert torch.equal(getattr(found[0], name), getattr(expected[0], name))


@pytest.mark.parametrize("source", ["validation", "recent", "replay"])
def test_a_rule_waits_for_as_many_as_it_learns_from(source: str) -> None:
    model = model_of("VPLSAC", pessimism_source=source, validation_proportion=0.25)
    rule = model.pessimism_rule
    assert [rule.n_further(0, n) for n in (7, 8)] == ([0, 8] if source == "recent" else [0, 0])
    assert rule.n_further(2, 7) == (2 if source == "validation" else 0)
    assert model._draws_in_steps()
    assert "pessimism/loss" in model._drawn_update(8)
    # A quarter of these is more than are held out.
    model.batch_size = 1_000
    assert ("pessimism/loss" in model._drawn_update(8)) is (source != "validation")


def test_nothing_to_train_on() -> None:
    buffer = sac(cls=VPLSAC, **DRAWN).replay_buffer
    with pytest.raises(ValueError, match="no transition to train on"):
        buffer.prepare_draws()
    with pytest.raises(ValueError, match="DeviceReplayBuffer holds no transition out"):
        sac(**DRAWN).replay_buffer.draw_held_out(2)


def test_transitions_are_held_out_of_draws_on_the_host_too() -> None:
    """The same training, whichever buffer holds its transitions."""
    ours = model_of("VPLSAC", replay_buffer_kwargs={"sampling": "host"}, buffer_size=30)
    theirs = model_of("VPLSAC", replay_buffer_class=None, replay_buffer_kwargs=None, buffer_size=30)
    assert isinstance(ours.replay_buffer, DeviceValidationReplayBuffer) and ours.replay_buffer.full
    assert same(ours, theirs)


@pytest.mark.parametrize("maker", sampled(ABLE, ("BRO", "VPLSAC", "SAC")))
@pytest.mark.parametrize("how", sampled(("eager", "captured"), ("captured",)))
def test_it_is_the_gradient_step_on_what_it_draws(maker: str, how: str) -> None:
    ours, theirs = model_of(maker), model_of(maker)
    learner, given = ours.learner, theirs.learner

    class Drawing(Recorder):
        def __call__(self, run: Callable[[], Any]) -> Any:
            with torch.random.fork_rng([]):  # a capture draws nothing
                return super().__call__(run)

    recorder = Drawing(learner)
    if how == "captured":
        learner._drawing = Execution(learner, False, False, recorder, "drawn_step")
    for model in (ours, theirs):
        model.learner.set_training_mode(True)
    theirs.replay_buffer.prepare_draws()
    for i in range(8):
        torch.manual_seed(i)
        assert ours._draws_in_steps()
        learner.prepared_drawing()
        metrics = ours._drawn_update(8)
        assert ("pessimism/loss" in metrics) == (maker in ("VPLSAC", "GPLSAC", "OPLSAC"))
        torch.manual_seed(i)
        given.step(*given.drawn_inputs(8, n_further(theirs)))
    assert same(ours, theirs) if how == "eager" else not differing(ours, theirs)
    # With a delay of the actors' steps there are two kinds.
    assert recorder.n_repetitions == 0 if how == "eager" else recorder.n_repetitions in (2, 5)


def differing(a: Any, b: Any) -> list[str]:
    ours, theirs = state(a), state(b)
    return [name for name, x in ours.items() if not torch.allclose(x.double(), theirs[name].double(), atol=1e-5)]


@pytest.mark.parametrize("compiles", [False, pytest.param(True, marks=[COMPILES, pytest.mark.slow])])
@pytest.mark.parametrize("cls", [SAC, VPLSAC])
def test_a_training_goes_on_bit_by_bit(cls: type[SAC], compiles: bool, tmp_path: Path) -> None:
    # Places are overwritten.
    kwargs = {} if cls is SAC else {"validation_proportion": 0.25, "buffer_size": 30}

    def model() -> SAC:
        return cls("MlpPolicy", Toy(), seed=3, compile=compiles, **{**TINY_SAC, **DRAWN, **kwargs})

    whole = model().learn(80, checkpoint=tmp_path / "whole", checkpoint_freq=20)
    stops = lambda local, _: local["self"].num_timesteps < 50  # noqa: E731
    model().learn(80, stops, checkpoint=tmp_path / "parts", checkpoint_freq=20)
    parts = model().learn(80, checkpoint=tmp_path / "parts", checkpoint_freq=20)
    assert whole._n_updates == parts._n_updates == 70
    assert same(whole, parts)
    assert not same(whole, cls("MlpPolicy", Toy(), seed=3, compile=False, **{**TINY_SAC, **kwargs}).learn(80))


@pytest.mark.parametrize(
    "how",
    [
        pytest.param("eager", marks=pytest.mark.slow),
        "captured",
        pytest.param("compiled", marks=[COMPILES, pytest.mark.slow]),
    ],
)
@pytest.mark.parametrize("gammas", [pytest.param((0.9, 0.9, 0.9), marks=pytest.mark.slow), (0.9, 0.99, 0.999)])
@pytest.mark.parametrize("maker", sampled(["SAC", "VPLSAC", "OPLSAC"], ["VPLSAC"]))
def test_learners_draw_together(maker: str, how: str, gammas: tuple[float, ...]) -> None:
    ours, theirs = ([model_of(maker, seed=s, gamma=gamma) for s, gamma in enumerate(gammas)] for _ in range(2))
    n = n_further(ours[0])
    for model in (*ours, *theirs):
        model._draws_in_steps()
        model.learner.set_training_mode(True)
        model.learner.compiled = how == "compiled"
    groups = [LearnerGroup([model.learner for model in models]) for models in (ours, theirs)]
    if how == "captured":
        groups[0]._drawing = Execution(groups[0], False, False, Recorder(groups[0]), "mapped_drawn_step")
    for i in range(6):
        torch.manual_seed(i)
        groups[0].step([(8, n, True, True)] * 3)
        torch.manual_seed(i)
        if how == "eager":
            inputs = [(*model.learner.drawn_inputs(8, n), True, True) for model in theirs]
            groups[1].step(inputs)
    if how == "eager":
        assert not any(differing(a, b) for a, b in zip(ours, theirs, strict=True))
    changed = [differing(a, b) for a, b in zip(ours, theirs, strict=True)]
    assert how == "eager" or all(changed)


def test_train_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(many, "joint_of", LearnerGroup)
    taken: list[Any] = []
    step = LearnerGroup.step
    monkeypatch.setattr(LearnerGroup, "step", lambda group, inputs: taken.append(inputs[0]) or step(group, inputs))
    trained = [
        train_many(SAC, "MlpPolicy", Toy, seeds=[0, 1], total_timesteps=60, compile=False, **TINY_SAC, **DRAWN)
        for _ in range(2)
    ]
    assert [each[0] for each in taken] == [8] * 100
    assert all(same(a, b) for a, b in zip(*trained, strict=True))
    assert not same(*trained[0])


@pytest.mark.parametrize("captured", [False, True])
def test_gradients_are_kept_of_a_given_batch_if_drawn_steps_leave_none(captured: bool) -> None:
    model = model_of("SAC")
    if captured:
        model.learner._drawing = Execution(model.learner, False, False, Recorder(model.learner), "drawn_step")
    model.keep_next_gradients = True
    assert model._draws_in_steps() is not captured
    model.train(2)
    assert not model.learner.gradients_are_stale and not model.keep_next_gradients
    assert model._draws_in_steps()


@pytest.mark.parametrize("maker", ["SAC", "VPLSAC"])
def test_a_loaded_model_and_buffer_draw_too(maker: str, tmp_path: Path) -> None:
    model = model_of(maker, buffer_size=40)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = type(model).load(tmp_path / "model", env=vec(1))
    loaded.load_replay_buffer(tmp_path / "buffer")
    for each in (model, loaded):
        torch.manual_seed(0)
        each.train(3)
    assert loaded.replay_buffer.sampling == "device" and loaded.learner._store is loaded.replay_buffer
    assert same(model, loaded)


class _OwnDraws(Pessimism):
    def __init__(self, learner: Any):
        super().__init__(1.0)

    def draw(self, source: Any) -> Any:
        return source.latest(2)


@pytest.mark.parametrize(
    ("maker", "kwargs", "words"),
    [
        ("SAC", {"replay_buffer_kwargs": {"sampling": "gpu"}}, "sampling must be 'host' or 'device', not 'gpu'"),
        ("SAC", {"pessimism": _OwnDraws}, "sampling='device' .*_OwnDraws draws .* of its own: pass sampling='host'"),
        ("SimbaV2", {}, r"sampling='device' .* transformed .*\(batch_transforms, reward_scale\): pass sampling='host'"),
        ("SAC", {"redo_period": 5}, "sampling='device' .*redo looks at the batch after the gradient step: .*'host'"),
    ],
)
def test_what_is_refused(maker: str, kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        MAKERS[maker](**{**DRAWN, **kwargs})


def test_other_buffers_have_no_such_argument() -> None:
    for cls, sampling in itertools.product(PLAIN_BUFFERS[:1], ("host", "device")):
        with pytest.raises((TypeError, ValueError), match="sampling"):
            sac(replay_buffer_class=cls, replay_buffer_kwargs={"sampling": sampling})
    assert np.dtype(np.float32) == sac(**DRAWN).replay_buffer.observations.numpy().dtype
