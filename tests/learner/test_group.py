"""Many learners in one gradient step: each is what it would be alone."""

import functools
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch

from sb3_sample.learner.batch import Extra, Noise
from sb3_sample.learner.execution import CapturedActing, Execution, inputs_like
from sb3_sample.learner.group import LearnerGroup, _settings_of
from sb3_sample.learner.learner import Learner
from sb3_sample.learner.pessimism import LearnedPessimism
from sb3_sample.networks import EnsembleLayerNorm
from tests.sac.common import COMPILES, MAKERS, PIXEL_MAKERS, TINY_RESIDUAL, random_batch, sac, sampled, state
from tests.sac.test_execution import FEW_STEPS, ROUNDING, TOLERANCE, WITHOUT_GRADIENT, Recorder


class Seat:
    """In the place of a learner's execution: its gradient step waits for those of the others, and is one with them."""

    compiled, leaves_gradients, seconds_compiling = False, False, 0.0

    def __init__(self, group: LearnerGroup, index: int, inputs: list[Any], barrier: threading.Barrier):
        self.group, self.index, self.inputs, self.barrier = group, index, inputs, barrier
        self.results: list[Any] = []

    def serves(self, learner: Learner) -> bool:
        return True

    def prepare(self, learner: Learner) -> None:
        pass

    def __call__(self, learner: Learner, *inputs: Any, eager: bool = False) -> Any:
        self.inputs[self.index] = inputs
        if self.barrier.wait() == 0:
            self.inputs.append(self.group.step(self.inputs))
        self.barrier.wait()
        results = self.inputs[-1]
        if self.barrier.wait() == 0:
            self.inputs.pop()
        self.barrier.wait()
        return results[self.index]


def together(
    learners: Sequence[Learner], step: Callable[[int], None], group: LearnerGroup | None = None
) -> LearnerGroup:
    """Run a function of the index for every learner, in threads, so that their gradient steps are one."""
    group = group or LearnerGroup(learners)
    barrier, inputs = threading.Barrier(len(learners)), [None] * len(learners)
    for i, learner in enumerate(learners):
        learner._execution = Seat(group, i, inputs, barrier)
    with ThreadPoolExecutor(len(learners)) as pool:

        def run(i: int) -> None:
            try:
                step(i)
            except BaseException:
                barrier.abort()
                raise

        futures = [pool.submit(run, i) for i in range(len(learners))]
    for error in filter(None, (future.exception() for future in futures)):
        if not isinstance(error, threading.BrokenBarrierError):
            raise error
    return group


def models_of(maker: str, n: int, **kwargs: Any) -> list[Any]:
    """Models of the seeds 0, 1, ..., none with a gradient step taken."""
    starts = 70 if maker == "DebiasedRQ" else 60
    models = []
    for seed in range(n):
        model = {**MAKERS, **PIXEL_MAKERS}[maker](
            **{"learning_starts": starts, "compile": False, "seed": seed, **kwargs}
        )
        models.append(model.learn(60))
        model.planned_updates = 50
    return models


def take(model: Any, n: int, around: Callable[[Callable[[], Any], int], Any] = lambda step, i: step()) -> None:
    """Gradient steps on batches and noise of the model's seed, the same on every device, each by a function of it."""
    learner, shape = model.learner, (8, model.actor.action_dim)
    for i in range(n):
        seed = 1_000 * (model.seed or 0) + i
        generator = torch.Generator().manual_seed(seed)
        noise = Noise(*(torch.randn(shape, generator=generator) for _ in range(3)))
        if len(model.transforms) > 0:
            k, m = learner.target_copies, learner.online_copies
            offsets = torch.randint(3, ((k + m) * 8, 2), generator=generator)
            critic = torch.randn(8 * k, shape[1], generator=generator)
            noise = noise._replace(critic=critic, transforms=(offsets,))
        extra = None
        if isinstance(learner.pessimism_rule, LearnedPessimism):
            extra = Extra(random_batch(model, seed=seed + 500), torch.zeros(8, 1))
            noise = noise._replace(pessimism=torch.randn(shape, generator=generator))
        inputs = inputs_like((random_batch(model, seed=seed), noise, extra), lambda x: x.to(model.device))
        learner.plasticity.before_gradient_steps(learner, 1)
        learner.set_training_mode(True)
        around(functools.partial(learner.step, *inputs), i)
        learner.set_training_mode(False)


def differences(a: Any, b: Any) -> tuple[float, float]:
    """The largest of any parameter or learned number, and of the optimizers' moments, relative to their largest."""
    ours, theirs = state(a), state(b)
    assert ours.keys() == theirs.keys()
    largest = {False: 0.0, True: 0.0}
    for name, x in ours.items():
        if x.numel() == 0 or WITHOUT_GRADIENT.search(name):
            continue
        x, y = x.double(), theirs[name].double()
        of_optimizer = "optimizer/" in name
        unit = max(float(y.abs().max()), 1.0) if of_optimizer else 1.0
        largest[of_optimizer] = max(largest[of_optimizer], float((x - y).abs().max()) / unit)
    return largest[False], largest[True]


#: Of whose steps something cannot be batched.
REFUSED = {"RegularizedSAC": "sam_radius"}
#: Whose explorers act by a method of their own, which is not captured.
NOT_CAPTURED_ACTING = ("OAC",)


def assert_alike(maker: str, ours: Sequence[Any], theirs: Sequence[Any]) -> None:
    tolerance = 10 * TOLERANCE if maker in ROUNDING else TOLERANCE
    for a, b in zip(ours, theirs, strict=True):
        of_parameters, of_moments = differences(a, b)
        assert of_parameters < tolerance and of_moments < 10 * tolerance


@pytest.mark.parametrize(
    "maker",
    sampled([*(name for name in MAKERS if name not in REFUSED), *PIXEL_MAKERS], ("BRO", "VPLSAC", "DebiasedRQ")),
)
def test_each_is_what_it_is_alone(maker: str) -> None:
    alone, others = models_of(maker, 3), models_of(maker, 3)
    n = FEW_STEPS.get(maker, 50)
    for model in alone:
        take(model, n)
    group = together([model.learner for model in others], lambda i: take(others[i], n))
    assert_alike(maker, alone, others)
    group.release()
    # Each goes on alone.
    for model in (*alone, *others):
        model.learner.forget_execution()
        take(model, 3)
    assert_alike(maker, alone, others)


@pytest.mark.parametrize("how", ["eager", "captured"])
@pytest.mark.parametrize("maker", sampled(name for name in MAKERS if name not in (*REFUSED, *NOT_CAPTURED_ACTING)))
def test_actions_are_those_of_each(maker: str, how: str) -> None:
    models = models_of(maker, 3)
    learners = [model.learner for model in models]
    generator = torch.Generator().manual_seed(0)
    for learner in learners:
        with torch.no_grad():
            for p in learner.explorer.parameters():
                p.add_(0.1 * torch.randn(p.shape, generator=generator))
    inputs = []
    for i, learner in enumerate(learners):
        batch = random_batch(models[i], seed=i)
        inputs.append((batch.observations, learner.explorer.draw_noise(learner, batch.observations)))
    with torch.inference_mode():
        alone = [learner.action_step(*own)["actions"].clone() for learner, own in zip(learners, inputs, strict=True)]
    group = LearnerGroup(learners)
    recorder = Recorder(group) if how == "captured" else None
    if recorder is not None:
        group._acting = CapturedActing(group, "mapped_actions", recorder)
    for _ in range(1 if recorder is None else 5):
        with torch.inference_mode():
            found = [each["actions"] for each in group.act(inputs)]
        for ours, theirs in zip(found, alone, strict=True):
            assert torch.allclose(ours, theirs, atol=1e-5)
    assert not torch.allclose(alone[0], alone[1], atol=1e-2)
    assert recorder is None or (recorder.n_recordings, recorder.n_repetitions) == (1, 2)


def memory_of(owners: Sequence[Any]) -> int:
    """Bytes of parameters, buffers and moments of learners or groups, each place once."""
    tensors = [
        t for each in owners for module in each.step_modules() for t in (*module.parameters(), *module.buffers())
    ]
    for optimizer in (o for each in owners for o in each.optimizers().values()):
        tensors += [t for state in optimizer.state.values() for t in state.values()]
    return sum({t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in tensors}.values())


def test_memory_is_that_of_as_many_learners() -> None:
    models = models_of("BRO", 4)
    for model in models:
        take(model, 2)
    learners = [model.learner for model in models]
    apart = memory_of(learners)
    group = together(learners, lambda i: take(models[i], 2))
    assert apart <= memory_of([*learners, group]) < 1.1 * apart


@pytest.mark.parametrize("how", [pytest.param("compiled", marks=[COMPILES, pytest.mark.slow]), "captured"])
def test_compiled_and_captured_groups(how: str) -> None:
    alone, others = models_of("SAC", 2), models_of("SAC", 2)
    for model in alone:
        take(model, 20)
    learners = [model.learner for model in others]
    for learner in learners:
        learner.compiled = how == "compiled"
    group = LearnerGroup(learners)
    recorder = None
    if how == "captured":
        recorder = Recorder(group)
        group._execution = Execution(group, False, False, recorder, "mapped_step")
    together(learners, lambda i: take(others[i], 20), group)
    assert_alike("SAC", alone, others)
    if recorder is not None:
        assert recorder.n_recordings == 1 and recorder.n_repetitions == 17
    else:
        assert group.compiled and group.seconds_compiling > 0


@pytest.mark.parametrize(
    ("maker", "arguments"),
    [
        ("SAC", {"learning_rate": [1e-3, 1e-4]}),
        pytest.param("SAC", {"tau": [0.1, 0.5], "gamma": [0.9, 0.99]}, marks=pytest.mark.slow),
        pytest.param("SAC", {"target_entropy": [-1.0, 1.0], "pessimism": [0.2, 0.7]}, marks=pytest.mark.slow),
        ("BRO", {"learning_rate": [1e-3, 1e-4], "tau": [0.1, 0.5], "gamma": [0.9, 0.99]}),
        ("SAC", {"actor_pessimism": [0.25, 0.75]}),
        pytest.param("SAC", {"tau": [1, 0.5], "gamma": [0.9, 1]}, marks=pytest.mark.slow),
        pytest.param("SAC", {"tau": [1, 1], "gamma": [0.9, 0.99]}, marks=pytest.mark.slow),
        ("OPLSAC", {"gamma": [0.5, 0.99]}),
        ("BRO", {"weight_decay": [1e-1, 1e-4]}),
        pytest.param("BRO", {"weight_decay": [0, 1e-1]}, marks=pytest.mark.slow),
        # Where torch takes a number, or two of a kind.
        pytest.param("BROTD3", {"exploration_noise": [0.1, 0.2]}, marks=pytest.mark.slow),
        ("SAC", {"value_head": ["categorical"] * 2, "value_head_kwargs": [{"v_min": -5.0}, {"v_min": -10.0}]}),
        pytest.param(
            "SAC",
            {"value_head": ["hl_gauss"] * 2, "value_head_kwargs": [{"v_max": 5.0}, {"v_max": 10.0}]},
            marks=pytest.mark.slow,
        ),
        ("XQC", {"policy_kwargs": [{"net_arch": [8], "actor_kwargs": {"log_std_min": low}} for low in (0.5, -5.0)]}),
        (
            "SimbaV2",
            {
                "policy_kwargs": [
                    {**TINY_RESIDUAL, "critic_network_kwargs": {"width": 8, "shift": shift}} for shift in (2.0, 3.0)
                ]
            },
        ),
    ],
)
def test_numbers_may_differ(maker: str, arguments: dict[str, Sequence[Any]]) -> None:
    def models() -> list[Any]:
        made = []
        for i in range(2):
            own = {name: values[i] for name, values in arguments.items()}
            (model,) = models_of(maker, 1, **own)
            made.append(model)
        return made

    alone, others = models(), models()
    n = FEW_STEPS.get(maker, 20)
    for model in alone:
        take(model, n)
    learners = [model.learner for model in others]
    together(learners, lambda i: take(others[i], n))
    assert_alike(maker, alone, others)
    assert differences(alone[0], alone[1])[0] > 1e-4


def floats_of(learner: Learner) -> list[tuple[dict[str, Any], str]]:
    """Fractional numbers that a gradient step reads from attributes, but those that torch's own layers read."""
    modules = [module for root in learner.step_modules() for module in root.modules()]
    of_torch = [
        id(vars(module))
        for module in modules
        if type(module).__module__.startswith("torch.") or isinstance(module, EnsembleLayerNorm)
    ]
    return [
        (values, name)
        for values, name, value in _settings_of(learner).held
        if type(value) is float and "params" not in values and id(values) not in of_torch
    ]


@pytest.mark.parametrize(
    "maker", sampled([*(name for name in MAKERS if name not in REFUSED), *PIXEL_MAKERS], ("BROTD3", "XQC", "SimbaV2"))
)
def test_every_number_may_differ(maker: str) -> None:
    """One learner has its numbers, the other 2% more of each: steps and actions are those of each."""
    alone, others = models_of(maker, 2), models_of(maker, 2)
    for models in (alone, others):
        changed = floats_of(models[1].learner)
        for values, name in changed:
            values[name] = 1.02 * values[name] or 0.02
    assert len(changed) > 3
    for model in alone:
        take(model, 3)
    learners = [model.learner for model in others]
    group = together(learners, lambda i: take(others[i], 3))
    assert len(group._differing) >= len(changed)
    assert_alike(maker, alone, others)
    if maker in NOT_CAPTURED_ACTING:
        return
    batches = [random_batch(model, seed=i) for i, model in enumerate(others)]
    with torch.inference_mode():
        inputs = [
            (batch.observations, learner.explorer.draw_noise(learner, batch.observations))
            for batch, learner in zip(batches, learners, strict=True)
        ]
        found = [each["actions"].clone() for each in group.act(inputs)]
        # From the same parameters: a bias before batch norm moves by rounding, which shows in evaluation mode.
        group.release()
        for learner, own, actions in zip(learners, inputs, found, strict=True):
            assert torch.allclose(learner.action_step(*own)["actions"], actions, atol=1e-5)
    assert not torch.allclose(found[0], found[1], atol=1e-2)


def test_frozen_parameters() -> None:
    alone, others = models_of("SAC", 2), models_of("SAC", 2)
    for model in (*alone, *others):
        model.actor.trunk.requires_grad_(False)
    for model in alone:
        take(model, 5)
    together([model.learner for model in others], lambda i: take(others[i], 5))
    assert_alike("SAC", alone, others)
    alone[0].actor.trunk.requires_grad_(True)
    with pytest.raises(ValueError, match="learners must have the same parameters frozen"):
        LearnerGroup([model.learner for model in alone])


def test_an_error_names_the_numbers_that_differ() -> None:
    """A network of one's own may need a number where several learners have a tensor."""
    models = models_of("BRO", 2)
    learners = [model.learner for model in models]
    norm = next(module for module in learners[1].actor.modules() if isinstance(module, torch.nn.LayerNorm))
    norm.eps = 0.1
    with pytest.raises(RuntimeError) as raised:
        together(learners, lambda i: take(models[i], 1))
    assert raised.value.__notes__ == ["in the step of learners that differ in eps"]


def test_numbers_that_differ_are_put_on_the_device_once(monkeypatch: pytest.MonkeyPatch) -> None:
    models = [models_of("SAC", 1, gamma=gamma)[0] for gamma in (0.9, 0.99)]
    learners = [model.learner for model in models]
    group = together(learners, lambda i: take(models[i], 1))
    made: list[Any] = []
    make = torch.tensor
    monkeypatch.setattr(torch, "tensor", lambda *args, **kwargs: made.append(args) or make(*args, **kwargs))
    together(learners, lambda i: take(models[i], 2), group)
    assert made == []


def test_what_is_done_around_the_step_may_be_there_or_not() -> None:
    others = sac(compile=False, seed=1, redo_period=5, reward_scale="xqc")
    LearnerGroup([sac(compile=False, seed=0).learner, others.learner])


def test_a_setting_may_change_between_a_step_and_actions() -> None:
    """What acts is in inference mode, and what learns is not."""
    models = [models_of("BRO", 1, pessimism=pessimism)[0] for pessimism in (0.2, 0.7)]
    learners = [model.learner for model in models]
    group = together(learners, lambda i: take(models[i], 1))
    for learner in learners:
        learner.explorer.kl_target = 0.2
    observations = random_batch(models[0]).observations
    inputs = [(observations, learner.explorer.draw_noise(learner, observations)) for learner in learners]
    with torch.inference_mode():
        group.act(inputs)
    assert not any(each["actions"].requires_grad for each in group.act(inputs))
    together(learners, lambda i: take(models[i], 1), group)


@pytest.mark.parametrize("how", ["eager", "captured", pytest.param("compiled", marks=[COMPILES, pytest.mark.slow])])
def test_groups_go_on_after_resets(how: str) -> None:
    """Weights are drawn anew in place, and moments are cleared, which moves them."""
    alone, others = models_of("BRO", 2), models_of("BRO", 2)
    drawing = threading.Lock()

    def train(model: Any) -> None:
        take(model, 12)
        with drawing:
            torch.manual_seed(model.seed)
            model.learner.reinitialize()
        take(model, 12)

    for model in alone:
        train(model)
    learners = [model.learner for model in others]
    for learner in learners:
        learner.compiled = how == "compiled"
    group = LearnerGroup(learners)
    if how == "captured":
        group._execution = Execution(group, False, False, Recorder(group), "mapped_step")
    together(learners, lambda i: train(others[i]), group)
    if how == "captured":
        assert group._execution._captured._recorder.n_recordings == 2
    for a, b in zip(alone, others, strict=True):
        # The second twelve updates begin with those on which the gradients of a fresh network are large.
        assert differences(a, b)[0] < 10 * TOLERANCE
        assert all(int(state["step"]) == 12 for state in b.critic.optimizer.state.values())
    assert differences(*others)[0] > 1e-2


@pytest.mark.parametrize("how", ["eager", "captured"])
def test_one_may_be_reset_or_step_alone(how: str) -> None:
    """Its optimizers have then taken another number of steps than the others'."""
    alone, others = models_of("SAC", 2), models_of("SAC", 2)

    def train(model: Any) -> None:
        take(model, 20)
        if model.seed == 0:
            torch.manual_seed(0)
            model.learner.reinitialize()
        take(model, 6)
        if model.seed == 1:
            take_alone(model)
        take(model, 6)

    def take_alone(model: Any) -> None:
        seat, model.learner._execution = model.learner._execution, None
        take(model, 1)
        model.learner._execution = seat

    for model in alone:
        train(model)
    group = LearnerGroup([model.learner for model in others])
    if how == "captured":
        group._execution = Execution(group, False, False, recorder := Recorder(group), "mapped_step")
    together(group.learners, lambda i: train(others[i]), group)
    assert group.counts_differ
    for a, b in zip(alone, others, strict=True):
        assert differences(a, b)[0] < TOLERANCE
    assert how == "eager" or recorder.n_recordings == 2


@pytest.mark.parametrize(
    ("kwargs", "reason"),
    [
        ([{}, {"policy_kwargs": {"net_arch": [8, 9]}}], "same shapes"),
        ([{}, {"policy_delay": 2}], "policy_delay"),
        ([{}, {"pessimism": "gpl"}], "learners must .*"),
        ([{"policy_kwargs": {"net_arch": [8], "optimizer_class": torch.optim.RMSprop}}] * 2, "RMSprop"),
        ([{}, {"value_head": "half_squared"}], "same classes, not .*ValueHead.*HalfSquaredHead"),
        ([{"policy_kwargs": {"net_arch": [8], "optimizer_kwargs": {"eps": eps}}} for eps in (1e-8, 1e-3)], "eps"),
    ],
)
def test_what_differs_is_named(kwargs: list[dict[str, Any]], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        LearnerGroup([sac(compile=False, **of).learner for of in kwargs])
