"""
What holds on a CPU holds on a GPU: the same numbers, captured and compiled as well as eager. Skipped without CUDA.

    pytest -m gpu            (make gpu)
"""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sb3_sample import BRO, SAC, DeviceReplayBuffer, train_many
from sb3_sample.faults import TrainingDiverged
from sb3_sample.learner.batch import Batch, Noise
from sb3_sample.learner.execution import CapturedActing, inputs_like, old_torch, why_not_compiled
from sb3_sample.learner.group import LearnerGroup
from tests.learner.test_group import REFUSED, take, together
from tests.sac import test_golden as golden
from tests.sac.common import MAKERS, TINY_BRO, TINY_SAC, Toy, random_batch, state
from tests.sac.test_drawn_steps import n_further
from tests.sac.test_execution import FEW_STEPS, ROUNDING, WITHOUT_GRADIENT

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
]
#: Largest difference of a parameter after 50 updates.
TOLERANCE = 1e-4
HOWS = ("eager", "captured", "compiled")
#: Those whose step is compiled here; it takes the most time by far.
COMPILED = ("SAC", "BRO")


@pytest.fixture(autouse=True)
def as_it_was() -> Iterator[None]:
    torch.backends.cuda.matmul.allow_tf32 = False
    yield
    torch.cuda.set_sync_debug_mode("default")


def model_on(device: str, maker: str, how: str = "eager", seed: int = 0, **kwargs: Any) -> Any:
    """A model with a filled replay buffer, whose gradient steps are run in a given way."""
    if maker == "RegularizedSAC":
        # Weights that are redrawn come from the device's generator.
        kwargs = {"redo_period": 1_000, **kwargs}
    starts = 70 if maker == "DebiasedRQ" else 60
    arguments = {"learning_starts": starts, "compile": how != "eager", "seed": seed, "device": device, **kwargs}
    model = MAKERS[maker](**arguments)
    model.compiled = how == "compiled"
    model.learn(60)
    model.planned_updates = 50
    return model


def largest_difference(a: Any, b: Any) -> float:
    ours, theirs = state(a), state(b)
    assert ours.keys() == theirs.keys()
    pairs = [
        (x.double().cpu(), theirs[name].double().cpu())
        for name, x in ours.items()
        if x.numel() > 0 and "optimizer/" not in name and not WITHOUT_GRADIENT.search(name)
    ]
    return max(float((x - y).abs().max()) for x, y in pairs)


@pytest.mark.parametrize(
    ("maker", "how"),
    [(maker, how) for maker in MAKERS for how in HOWS if how != "compiled" or maker in COMPILED],
)
def test_is_the_cpu(maker: str, how: str) -> None:
    here, there = model_on("cpu", maker), model_on("cuda", maker, how)
    # The first order's differences are those of the simulation alone.
    n = FEW_STEPS.get(maker, 50)
    for model in (here, there):
        take(model, n)
    execution = there.learner._execution
    assert (execution._captured is not None) is (how != "eager")
    assert execution.compiled is (how == "compiled")
    if how != "eager" and n > 6:
        assert execution._captured._recorded
    assert largest_difference(here, there) < (10 * TOLERANCE if maker in ROUNDING else TOLERANCE)


def test_parameters_without_gradient_are_captured() -> None:
    """Those of a deviation that a deterministic actor does not have."""
    here, there = (
        model_on(*of, pessimistic_actor="deterministic") for of in (("cpu", "DAC"), ("cuda", "DAC", "captured"))
    )
    for model in (here, there):
        take(model, 12)
    assert there.learner._execution._captured._recorded
    assert largest_difference(here, there) < TOLERANCE


@pytest.mark.parametrize("how", HOWS)
@pytest.mark.parametrize("name", ["bro_quantile_public", "dac_edge", "bro_scalar_public"])
def test_golden(name: str, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if how == "compiled" and name != "bro_quantile_public":
        pytest.skip("one file is compiled, for its time")
    monkeypatch.setattr(golden, "DEVICE", "cuda")
    if how == "captured":
        monkeypatch.setattr(golden, "captured", _captured)
    golden.replay(golden.OWN_FOLDER / f"{name}.npz", how)


def _captured(model: Any, warm_up: int = 3) -> None:
    """In the place of the test's recorder: steps are captured by graphs, after three that are run as they are."""
    learner = model.learner
    model.compile = learner.compile = True
    model.compiled = False
    learner.forget_execution()
    assert learner.prepared_execution()._captured is not None


@pytest.mark.parametrize("maker", ["SAC", "BRO", "DAC", "VPLSAC", "SimbaV2", "FlashSAC"])
def test_groups_are_the_cpu(maker: str) -> None:
    assert maker not in REFUSED
    here = [model_on("cpu", maker, seed=seed) for seed in range(3)]
    there = [model_on("cuda", maker, "captured", seed=seed) for seed in range(3)]
    for model in here:
        take(model, 30)
    group = LearnerGroup([model.learner for model in there])
    together(group.learners, lambda i: take(there[i], 30), group)
    assert group._execution is not None and group._execution._captured is not None
    for ours, theirs in zip(here, there, strict=True):
        assert largest_difference(ours, theirs) < (10 * TOLERANCE if maker in ROUNDING else TOLERANCE)
    group.release()
    for ours, theirs in zip(here, there, strict=True):
        theirs.learner.forget_execution()
        for model in (ours, theirs):
            take(model, 3)
        assert largest_difference(ours, theirs) < (10 * TOLERANCE if maker in ROUNDING else TOLERANCE)


@pytest.mark.parametrize("maker", ["SAC", "BRO", "DAC", "FlashSAC"])
def test_actions_of_groups_are_those_of_each(maker: str) -> None:
    there = [model_on("cuda", maker, "captured", seed=seed) for seed in range(3)]
    group = LearnerGroup([model.learner for model in there])
    for i in range(8):
        generator = torch.Generator().manual_seed(i)
        inputs = [
            tuple(torch.randn((1, n), generator=generator).to("cuda") for n in (3, m.actor.action_dim)) for m in there
        ]
        with torch.inference_mode():
            alone = [m.learner.action_step(*own)["actions"].clone() for m, own in zip(there, inputs, strict=True)]
            found = [own["actions"].clone() for own in group.act(inputs)]
        assert all(torch.allclose(*pair, atol=1e-5) for pair in zip(alone, found, strict=True))
        together(group.learners, lambda i: take(there[i], 1), group)
    assert isinstance(group._acting, CapturedActing) and group._acting.captured._recorded


@pytest.mark.parametrize("maker", ["SAC", "BRO", "DAC", "VPLSAC"])
@pytest.mark.parametrize("n", [1, 3])
def test_steps_that_draw_their_batches(maker: str, n: int) -> None:
    """Captured steps draw what those that are run as they are draw, and the counters of the generator go on alike."""
    drawn = {"replay_buffer_class": DeviceReplayBuffer, "replay_buffer_kwargs": {"sampling": "device"}}
    found = []
    for how in ("eager", "captured"):
        models = [model_on("cuda", maker, how, seed=seed, **drawn) for seed in range(n)]
        for model in models:
            assert model._draws_in_steps()
            model.learner.set_training_mode(True)
        group = LearnerGroup([model.learner for model in models]) if n > 1 else None
        torch.manual_seed(0)
        for _ in range(12):
            if group is None:
                models[0].learner.prepared_drawing()
                models[0]._drawn_update(8)
            else:
                group.step([(8, n_further(models[0]), True, True)] * n)
        execution = models[0].learner._drawing if group is None else group._drawing
        assert execution is not None and (execution._captured is not None) == (how == "captured")
        found.append((models, float(torch.rand((), device="cuda"))))
    (eager, after_eager), (captured, after_captured) = found
    assert after_eager == after_captured
    assert all(largest_difference(a, b) < TOLERANCE for a, b in zip(eager, captured, strict=True))


def test_compiled_groups() -> None:
    here = [model_on("cpu", "BRO", seed=seed) for seed in range(2)]
    there = [model_on("cuda", "BRO", "compiled", seed=seed) for seed in range(2)]
    for model in here:
        take(model, 30)
    group = LearnerGroup([model.learner for model in there])
    together(group.learners, lambda i: take(there[i], 30), group)
    assert group.compiled and group.seconds_compiling > 0
    for ours, theirs in zip(here, there, strict=True):
        assert largest_difference(ours, theirs) < TOLERANCE


def test_groups_go_on_after_resets() -> None:
    """Weights are drawn anew in place, and moments are cleared, which moves them."""
    drawing = threading.Lock()

    def train(model: Any) -> None:
        take(model, 12)
        with drawing:
            torch.manual_seed(model.seed)
            model.learner.reinitialize()
        take(model, 12)

    here, there = ([model_on("cuda", "BRO", how, seed=seed) for seed in range(2)] for how in ("eager", "captured"))
    for model in here:
        train(model)
    group = LearnerGroup([model.learner for model in there])
    together(group.learners, lambda i: train(there[i]), group)
    assert group._execution is not None and group._execution._captured is not None
    for ours, theirs in zip(here, there, strict=True):
        assert largest_difference(ours, theirs) < 10 * TOLERANCE
    assert largest_difference(*there) > 1e-2


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="there is one GPU")
def test_steps_and_actions_are_captured_on_the_second_gpu() -> None:
    models = [model_on(device, "SAC", "captured") for device in ("cuda:0", "cuda:1")]
    for model in models:
        take(model, 12)
        observations = torch.ones(1, 3, device=model.device)
        with torch.inference_mode():
            found = [model.learner.explore(observations).clone() for _ in range(8)]
        assert not torch.equal(found[-1], found[-2])
    assert largest_difference(*models) < TOLERANCE


def test_a_setting_that_is_compiled_changes_under_capture() -> None:
    models = []
    for how in ("eager", "compiled"):
        models.append(model := model_on("cuda", "SAC", how))
        take(model, 8)
        model.learner.tau = 0.5
        model.learner.prepared_execution()
        take(model, 8)
    assert models[1].learner._execution._captured._recorded
    assert largest_difference(*models) < TOLERANCE


def test_resets_and_schedules_under_capture() -> None:
    models = []
    for compile in (False, True):
        rates = lambda progress: 1e-3 * progress  # noqa: E731
        kwargs = {"learning_rate": rates, "resets": (75,), "learning_starts": 20, "device": "cuda", "compile": compile}
        model = MAKERS["BRO"](**kwargs)
        model.compiled = False
        model.learn(100)
        model.tau, model.explorer.kl_target = 0.5, 0.2
        model.learn(20, reset_num_timesteps=False)
        models.append(model)
    assert models[0].plasticity.n_done == models[1].plasticity.n_done == 1
    assert models[1].learner._execution._captured is not None
    assert largest_difference(*models) < 1e-3


def test_training_is_resumed_with_the_generators_of_the_gpu(tmp_path: Path) -> None:
    def made() -> BRO:
        model = BRO("MlpPolicy", Toy(), **{**TINY_BRO, "device": "cuda"}, seed=0)
        model.compiled = False
        return model

    whole = made().learn(80, checkpoint=tmp_path / "whole", checkpoint_freq=40)
    made().learn(40, checkpoint=tmp_path / "parts", checkpoint_freq=40)
    parts = made().learn(80, checkpoint=tmp_path / "parts", checkpoint_freq=40)
    assert parts._n_updates == whole._n_updates
    assert largest_difference(whole, parts) < TOLERANCE


def test_train_many() -> None:
    kwargs: dict[str, Any] = {**TINY_SAC, "device": "cuda", "compile": True, "learning_starts": 20}
    models = train_many(SAC, "MlpPolicy", Toy, seeds=range(3), total_timesteps=60, **kwargs)
    assert [model._n_updates for model in models] == [40] * 3
    for seed, model in enumerate(models):
        alone = SAC("MlpPolicy", Toy(), seed=seed, **kwargs)
        alone.learn(60)
        # Rounding goes through the environment.
        assert largest_difference(alone, model) < 1e-2
        model.learn(10, reset_num_timesteps=False)


def test_divergence_is_noticed() -> None:
    model = SAC("MlpPolicy", Toy(), **{**TINY_SAC, "device": "cuda"}, compile=True, seed=0)
    model.compiled = False
    model.learn(30)
    with torch.no_grad():
        model.critic.head.weight.fill_(float("nan"))
    with pytest.raises(TrainingDiverged):
        model.learn(200, reset_num_timesteps=False)


@pytest.mark.parametrize("maker", ["SAC", "BRO", "DAC", "VPLSAC", "SimbaV2", "XQC"])
def test_the_update_does_not_wait_for_the_gpu(maker: str) -> None:
    model = model_on("cuda", maker, "captured")

    def check(step: Any, i: int) -> None:
        torch.cuda.set_sync_debug_mode("error" if i > 5 else "default")
        step()
        torch.cuda.set_sync_debug_mode("default")

    take(model, 12, check)
    assert model.learner._execution._captured._recorded


def test_the_update_of_a_group_does_not_wait_for_the_gpu() -> None:
    models = [model_on("cuda", "SAC", "captured", seed=i, gamma=gamma) for i, gamma in enumerate((0.9, 0.99))]
    group, inputs = LearnerGroup([model.learner for model in models]), []
    for model in models:
        model.learner.set_training_mode(True)
        batch = random_batch(model, seed=model.seed)._replace(discounts=model.gamma)
        noise = Noise(*(torch.randn((8, model.actor.action_dim)) for _ in range(3)))
        inputs.append(inputs_like((batch, noise, None, True, True), lambda x: x.to("cuda")))
    for i in range(12):
        torch.cuda.set_sync_debug_mode("error" if i > 5 else "default")
        group.step(inputs)
        torch.cuda.set_sync_debug_mode("default")
    assert group._execution is not None and group._execution._captured._recorded


@pytest.mark.parametrize("maker", ["SAC", "BRO", "DAC", "OAC", "BROTD3", "FlashSAC"])
def test_captured_actions_are_the_explorers(maker: str) -> None:
    model = model_on("cuda", maker, "captured")
    learner = model.learner
    assert maker == "OAC" or learner.explorer is not None
    for i in range(8):
        observations = torch.as_tensor(np.random.default_rng(i).normal(size=(1, 3)), dtype=torch.float32, device="cuda")
        with torch.inference_mode():
            torch.manual_seed(i)
            extra = learner.explorer.get_extra_state() if maker == "FlashSAC" else None
            expected = learner.explorer.act(learner, observations).clone()
            torch.manual_seed(i)
            if extra is not None:
                learner.explorer.set_extra_state(extra)
            found = learner.explore(observations)
        assert torch.allclose(expected, found, atol=1e-6)
        take(model, 1)
    assert isinstance(learner._acting[1], CapturedActing) and learner._acting[1].captured._recorded


def test_acting_beside_a_capture() -> None:
    """What acts draws from the generator that is captured: it waits meanwhile."""
    model = SAC("MlpPolicy", Toy(), device="cuda", **{**TINY_SAC, "compile": "auto", "learning_starts": 20})
    model.learn(600, asynchronous=True, control_frequency=200)
    assert model.num_timesteps == 600
    captured = model.learner._execution._captured
    assert captured is not None and captured._recorded


def test_compiles_here() -> None:
    if old_torch() is None:
        assert why_not_compiled(model_on("cuda", "SAC").learner) is None


def test_a_batch_elsewhere_is_refused() -> None:
    model = model_on("cuda", "SAC")
    with pytest.raises((ValueError, RuntimeError), match="device"):
        model.learner.step(Batch(*random_batch(model)))
