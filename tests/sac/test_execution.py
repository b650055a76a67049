"""The three ways to run the gradient step give the same numbers: eager, compiled, captured."""

import contextlib
import copy
import io
import json
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_sample import BRO, SRSPR, DiagnosticsCallback, tracing
from sb3_sample.learner import execution
from sb3_sample.learner.execution import Execution, foreign_parts, old_torch, why_not_compiled
from sb3_sample.learner.heads import ValueHead
from sb3_sample.learner.learner import Learner
from sb3_sample.learner.pessimism import PESSIMISMS, Pessimism
from sb3_sample.replay.buffers import PLAIN_BUFFERS, BatchMemory, DeviceReplayBuffer
from sb3_sample.replay.sources import draw_batches
from sb3_sample.sac import SAC
from sb3_sample.srspr.networks import SPRNetwork
from sb3_sample.srspr.policies import SPRPolicy
from sb3_sample.training import compiling
from tests.agents import OFF_POLICY, env_of
from tests.sac.common import COMPILES, PIXEL_MAKERS, Toy, bro, differing, random_batch, sac, sampled, state, vec
from tests.srspr.common import TINY

#: Largest difference of a parameter after 50 updates, each of which moves it by up to 3e-4. The same arithmetic in
#: another order differs by rounding; Adam makes much of it where a gradient is nearly zero.
TOLERANCE = 3e-5


class Recording(TorchDispatchMode):
    """Lists every operation, with the very tensors that it read and wrote."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[tuple[Any, Any, Any, Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        self.operations.append((func, args, kwargs or {}, out))
        return out


class Recorder:
    """
    In the place of CUDA's graphs: what is recorded takes no effect, and a repetition runs the same operations on the
    same memory, whatever Python would do by then.

    :param learner: whose steps are recorded, or a group of learners
    """

    def __init__(self, learner: Any):
        self.learner = learner
        self.n_recordings = self.n_repetitions = 0

    def _memory(self) -> list[torch.Tensor]:
        tensors = [t for module in self.learner.step_modules() for t in (*module.parameters(), *module.buffers())]
        for optimizer in self.learner.optimizers().values():
            tensors += [t for s in optimizer.state.values() for t in s.values() if isinstance(t, torch.Tensor)]
        return tensors

    def __call__(self, run: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
        self.n_recordings += 1
        memory = self._memory()
        saved = [t.detach().clone() for t in memory]
        with Recording() as recording:
            result = run()
        with torch.no_grad():
            for tensor, value in zip(memory, saved, strict=True):
                tensor.copy_(value)

        def repeat() -> None:
            self.n_repetitions += 1
            with torch.no_grad():
                for func, args, kwargs, out in recording.operations:
                    new = func(*args, **kwargs)
                    olds, news = (x if isinstance(x, (tuple, list)) else (x,) for x in (out, new))
                    for old, fresh in zip(olds, news, strict=True):
                        if isinstance(old, torch.Tensor) and old.data_ptr() != fresh.data_ptr():
                            old.detach().copy_(fresh)

        return repeat, result


def captured(model: Any, warm_up: int = 3) -> Recorder:
    """Let a model's gradient steps be captured by a recorder, after some that are run as they are."""
    recorder = Recorder(model.learner)
    model.learner._execution = Execution(model.learner, False, False, recorder)
    assert model.learner._execution._captured is not None and model.learner._execution._captured.WARM_UP == 3
    model.learner._execution._captured.WARM_UP = warm_up
    return recorder


#: Of networks with batch norm: shifts that the next norm takes off again, whose gradients are rounding, and the means
#: that follow them.
WITHOUT_GRADIENT = re.compile(r"input_norm\.bias|running_mean|critic\.trunk\.dense\.\d\.bias")
#: Agents of whose gradients some elements are rounding, which Adam makes steps of.
ROUNDING = ("CrossQ+WN", "DebiasedRQ", "FlashSAC", "SRSPR", "XQC")
#: Gradient steps of those whose rounding grows fastest, through batch norm over eight rows or convolutions (SRSPR: 3e-7
#: after one step, 4e-5 after ten, 3e-4 after fifty); others take 50.
FEW_STEPS = {"CrossQ+WN": 5, "SRSPR": 10, "XQC": 10}


def largest_difference(a: Any, b: Any) -> float:
    """Of any parameter or learned number; of the optimizers' moments, which are as large as gradients, relative."""
    ours, theirs = state(a), state(b)
    assert ours.keys() == theirs.keys()
    largest = 0.0
    for name, x in ours.items():
        if x.numel() == 0 or WITHOUT_GRADIENT.search(name):
            continue
        x, y = x.double(), theirs[name].double()
        unit = max(float(y.abs().max()), 1.0) if "optimizer/" in name else 1.0
        largest = max(largest, float((x - y).abs().max()) / unit)
    return largest


def pair(maker: str, **kwargs: Any) -> tuple[Any, Any]:
    """Two equal models with filled buffers and no gradient step taken."""
    models = []
    for compile in (False, kwargs.pop("compile", False)):
        # The ends of episodes count too where they take places in the buffer.
        starts = 70 if maker == "DebiasedRQ" else 60
        model = OFF_POLICY[maker](**{"learning_starts": starts, "compile": compile, **kwargs})
        model.learn(60)
        models.append(model)
    assert not differing(state(models[0]), state(models[1]))
    return models[0], models[1]


def updates(model: Any, n: int, seed: int = 0, each: Callable[[int], None] = lambda i: None) -> None:
    np.random.seed(seed)
    torch.manual_seed(seed)
    for i in range(n):
        each(i)
        model.train(1, 8)


def test_a_loop_that_reads_nothing_of_a_buffer_is_no_error_of_inductor() -> None:
    """FlashSAC's weights of unit norm have it, compiled: test_golden.py."""
    loop_body = pytest.importorskip("torch._inductor.loop_body")
    of_no_reads = SimpleNamespace(memory_usage={loop_body.MemoryUsageType.LOAD: []})
    read = loop_body.LoopBody.get_read_expr
    with tracing._users_that_read_nothing():
        assert loop_body.LoopBody.get_read_expr(of_no_reads, "buf0") is None
    assert loop_body.LoopBody.get_read_expr is read
    with pytest.raises(KeyError):
        read(of_no_reads, "buf0")


# test_golden.py has the published files' steps compiled, test_drq.py those from pixels, with a tolerance for their
# convolutions. SAC's is the one that the short tests compile.
@COMPILES
@pytest.mark.parametrize("maker", sampled((name for name in OFF_POLICY if name not in PIXEL_MAKERS), ("SAC",)))
def test_compiled_is_eager(maker: str) -> None:
    model, compiled = pair(maker, compile=True)
    n = FEW_STEPS.get(maker, 50)
    updates(model, n)
    updates(compiled, n)
    assert compiled.learner._execution is not None and compiled.learner._execution.compiled
    assert compiled.learner._execution.seconds_compiling > 0
    # The gradients of a tiny encoder are large, and so is the rounding of their moments.
    assert largest_difference(model, compiled) < (10 * TOLERANCE if maker in ROUNDING else TOLERANCE)
    for name, value in model._metrics.items():
        assert compiled._metrics[name].item() == pytest.approx(value.item(), rel=1e-2, abs=1e-3), name


@pytest.mark.parametrize("maker", sampled(OFF_POLICY, ("BRO", "VPLSAC", "DebiasedRQ")))
def test_captured_is_eager(maker: str) -> None:
    model, other = pair(maker)
    recorder = captured(other)
    # More than are run as they are, of each kind.
    n = max(FEW_STEPS.get(maker, 50), 10)
    updates(model, n)
    updates(other, n)
    # Learning rates are float32 there.
    assert largest_difference(model, other) < (10 * TOLERANCE if maker in ROUNDING else TOLERANCE)
    # Every kind of step is warmed up three times.
    n_kinds = 2 if getattr(model, "policy_delay", 1) > 1 else 1
    assert recorder.n_recordings == n_kinds
    assert recorder.n_repetitions == n - 3 * n_kinds


def test_float64_numbers_without_axes_are_not_compiled() -> None:
    """torch loses their changes: a compiled temperature would stand still."""
    _, model = pair("SAC")
    assert "float64" not in (why_not_compiled(model.learner) or "")
    model.temperature.double()
    assert "float64" in (why_not_compiled(model.learner) or "")


def test_the_recorder_repeats_and_does_not_ask() -> None:
    """What the test above rests on: without its inputs copied into place a step would repeat the first."""
    _, model = pair("SAC")
    recorder = captured(model)
    updates(model, 5)
    assert recorder.n_repetitions == 2
    before = state(model)
    _, (own, repeat, metrics) = next(iter(model.learner._execution._captured._recorded.items()))
    repeat()
    first = metrics["train/critic_loss"].item()
    after = state(model)
    assert "policy/actor.mean.weight" in before
    assert not torch.equal(before["policy/actor.mean.weight"], after["policy/actor.mean.weight"])
    own[0].rewards.add_(10)
    repeat()
    assert metrics["train/critic_loss"].item() > first + 10


def test_captured_survives_what_happens_in_training(tmp_path: Path) -> None:
    """Resets, a schedule of the learning rate, settings changed on the way, saving and loading."""
    kwargs: dict[str, Any] = {"learning_rate": LinearSchedule(1e-3, 0, 1), "resets": (75,), "learning_starts": 20}
    models = []
    for i in range(2):
        # Made one after the other, since the seed is that of all random numbers.
        models.append(model := bro(compile=False, **kwargs))
        if i == 1:
            recorder = captured(model)
        model.learn(100)
        model.tau, model.explorer.kl_target = 0.5, 0.2
        model.learn(20, reset_num_timesteps=False)
    assert models[0].plasticity.n_done == models[1].plasticity.n_done == 1
    assert largest_difference(*models) < 1e-3
    # At first, after the reset, which clears moments, and after the change of settings.
    assert recorder.n_recordings == 3
    for i, model in enumerate(models):
        model.save(tmp_path / f"{i}.zip")
        models[i] = BRO.load(tmp_path / f"{i}.zip", env=vec(), learning_rate=1e-3)
        models[i].set_random_seed(1)
        if i == 1:
            recorder = captured(models[i])
        models[i].learn(60)
    assert recorder.n_recordings == 1
    assert largest_difference(*models) < 1e-3
    # Parameters put into a model whose steps are captured already.
    before = recorder.n_recordings
    for model in models:
        model.set_parameters(bro(seed=5).get_parameters())
        updates(model, 10)
    assert recorder.n_recordings == before + 1
    assert largest_difference(*models) < 1e-4


def test_captured_survives_resets_between_two_gradient_steps_of_a_turn() -> None:
    """Moments are cleared in the midst of them, and what is captured is captured anew."""
    models = []
    for i in range(2):
        models.append(model := bro(compile=False, reset_gradient_steps=30, replay_ratio=8))
        if i == 1:
            recorder = captured(model)
        model.learn(20)
    assert models[0]._n_updates == 80 and models[0].plasticity.n_done == models[1].plasticity.n_done == 2
    assert recorder.n_recordings == 3
    assert largest_difference(*models) < 1e-3


def test_a_captured_step_gives_its_own_metrics_and_no_old_gradients() -> None:
    model = sac(compile=False, redo_period=5, learning_starts=60)
    model.learn(60)
    captured(model)
    recycled = []

    def note(i: int) -> None:
        if i > 0:
            recycled.append("plasticity/n_recycled" in model._metrics)
        model._metrics = {}

    updates(model, 13, each=note)
    assert [i + 1 for i, present in enumerate(recycled) if present] == [5, 10]
    assert model.gradients_are_stale
    model.keep_next_gradients = True
    model.train(3, 8)
    assert not model.gradients_are_stale and model.critic.head.weight.grad is not None
    updates(model, 1)
    assert model.gradients_are_stale


def test_captured_updates_of_a_learner_take_what_was_set() -> None:
    """Without an algorithm, which prepares each turn: rates, settings, and moments that a reset has cleared."""
    models = pair("SAC")
    captured(models[1])
    for model in models:
        learner = model.learner
        torch.manual_seed(0)

        def take(n: int, model: Any = model) -> None:
            for i in range(n):
                model.learner.update(random_batch(model, seed=i))

        take(6)
        before = [p.clone() for p in learner.actor.parameters()]
        learner.set_learning_rate(0.0)
        take(1)
        assert all(map(torch.equal, before, learner.actor.parameters()))
        learner.set_learning_rate(1e-3)
        learner.tau = 0.5
        take(2)
        learner.reinitialize()
        take(5)
    assert largest_difference(*models) < TOLERANCE


class Programs:
    """In the place of compiled steps: notes whether a program is made within a recording."""

    seconds = 0.0

    def __init__(self, recorder: "Noting"):
        self.recorder, self.version, self.made = recorder, 0, -1
        self.made_within: list[bool] = []

    def prepare(self, learner: Any) -> None:
        pass

    def __call__(self, step: Any, learner: Any, inputs: Any) -> Any:
        if self.made != self.version:
            self.made = self.version
            self.made_within.append(self.recorder.records)
        return step(learner, *inputs)


class Noting(Recorder):
    """Knows whether it is recording."""

    records = False

    def __call__(self, run: Any) -> Any:
        self.records = True
        try:
            return super().__call__(run)
        finally:
            self.records = False


def test_nothing_is_compiled_within_a_capture() -> None:
    """After a setting has changed, a compiled step is made anew in one that is run as it is."""
    _, model = pair("SAC")
    recorder = Noting(model.learner)
    model.learner._execution = Execution(model.learner, False, False, recorder)
    programs = model.learner._execution._compiled = Programs(recorder)
    updates(model, 5)
    model.tau, programs.version = 0.3, 1
    updates(model, 5)
    assert programs.made_within == [False, False]
    assert (recorder.n_recordings, recorder.n_repetitions) == (2, 4)


def test_captures_are_made_on_the_learners_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    current, seen = [torch.device("cuda:0")], []

    @contextlib.contextmanager
    def change(device: torch.device) -> Iterator[None]:
        current.append(device)
        yield
        current.pop()

    def record(run: Callable[[], Any]) -> Any:
        seen.append(current[-1])
        return lambda: None, {}

    monkeypatch.setattr(torch.cuda, "device", change)
    monkeypatch.setattr(execution, "_aside", lambda run: seen.append(current[-1]) or {})
    learner = SimpleNamespace(device=torch.device("cuda:1"), step_modules=tuple, optimizers=dict)
    captured = execution.Captured(learner, record)
    for _ in range(5):
        captured(lambda learner: {}, learner, ())
    assert seen == [learner.device] * 4


class AbsoluteHead(ValueHead):
    def loss(self, q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return 3 * (q - target).abs().mean()


@pytest.mark.parametrize("how", [pytest.param("compiled", marks=[COMPILES, pytest.mark.slow]), "captured"])
@pytest.mark.parametrize(
    "change",
    [
        lambda m: setattr(m, "actor_pessimism", 1),
        lambda m: setattr(m.learner, "head", AbsoluteHead()),
        lambda m: setattr(m.learner, "pessimism_rule", Pessimism(0.3)),
        lambda m: m.critic.optimizer.param_groups[0].update(eps=0.1),
        lambda m: m.actor.trunk.requires_grad_(False),
    ],
    ids=["integer", "loss", "part", "optimizer", "frozen"],
)
def test_changes_on_the_way_are_noticed(how: str, change: Callable[[SAC], None]) -> None:
    model, other = pair("SAC", compile=how == "compiled", learning_rate=1e-3)
    if how == "captured":
        captured(other)
    for m in (model, other):
        updates(m, 5)
        change(m)
        if how == "captured" and m is other and not m.learner._execution.serves(m.learner):
            captured(m)
        updates(m, 6, seed=1)
    assert largest_difference(model, other) < TOLERANCE


@pytest.mark.slow
@COMPILES
def test_moments_are_found_in_any_order_of_the_file() -> None:
    model, compiled = pair("SAC", compile=True, learning_rate=1e-3)
    for m in (model, compiled):
        updates(m, 5)
        saved = m.critic.optimizer.state_dict()
        order = list(saved["state"])
        order[1], order[3] = order[3], order[1]
        saved["state"] = {i: saved["state"][i] for i in order}
        m.critic.optimizer.load_state_dict(saved)
        updates(m, 10, seed=1)
    assert largest_difference(model, compiled) < TOLERANCE


@pytest.mark.slow
def test_diagnostics_do_not_have_steps_captured_anew() -> None:
    model = sac(compile=False, learning_starts=10)
    recorder = captured(model)
    model.learn(100, callback=DiagnosticsCallback(Toy(), every=10))
    assert recorder.n_recordings == 1


@pytest.mark.slow
@COMPILES
def test_a_gradient_step_of_ones_own() -> None:
    class OwnLearner(Learner):
        def gradient_step(self, *args: Any) -> dict[str, torch.Tensor]:
            return super().gradient_step(*args)

    class Own(SAC):
        learner_class = OwnLearner

    assert sac(cls=Own, compile=True).learn(20).learner._execution.compiled


def test_a_copied_model_trains_on_and_a_file_holds_no_transitions(tmp_path: Path) -> None:
    model = sac(compile=False, batch_size=1_000).learn(30)
    before = copy.deepcopy(model).learn(10).num_timesteps
    assert before == 10
    model.save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as file:
        assert "_batch_memory" not in json.loads(file.read("data.json"))["tree"]["attributes"]
        sizes = {entry.filename: entry.file_size for entry in file.infolist()}
    # 1,000 transitions of 10 numbers would be 40,000 bytes.
    assert sizes["data.json"] + sizes["tensors.safetensors"] < 30_000


@pytest.mark.slow
@COMPILES
def test_learning_rates_of_a_schedule_compile_once() -> None:
    model, compiled = pair("SAC", compile=True)
    for m in (model, compiled):
        rates = np.linspace(1e-2, 1e-4, 20)
        updates(m, 20, each=lambda i, m=m, rates=rates: setattr(m, "lr_schedule", lambda _: float(rates[i])))
    assert len(compiled.learner._execution._compiled._programs) == 1
    assert compiled.learner._execution._compiled.version == 0
    assert largest_difference(model, compiled) < 1e-3


@pytest.mark.slow
@COMPILES
def test_settings_changed_on_the_way_count_in_a_compiled_step() -> None:
    model, compiled = pair("SAC", compile=True, learning_rate=1e-3)
    for m in (model, compiled):
        updates(m, 5)
        m.tau, m.gamma, m.target_entropy = 0.7, 0.3, 5.0
        updates(m, 5, seed=1)
    assert largest_difference(model, compiled) < TOLERANCE


@COMPILES
@pytest.mark.slow
def test_compiled_models_do_not_share() -> None:
    """Two models of one class and one shape, which differ in a number that the compiled code holds."""
    eager = [sac(tau=tau, learning_starts=60, compile=False).learn(60) for tau in (0.1, 0.9)]
    compiled = [sac(tau=tau, learning_starts=60, compile=True).learn(60) for tau in (0.1, 0.9)]
    for _ in range(2):
        for model in (*eager, *compiled):
            updates(model, 3)
    for a, b in zip(eager, compiled, strict=True):
        assert largest_difference(a, b) < TOLERANCE


# ---------------------------------------------------------------- when


def set_threshold(monkeypatch: pytest.MonkeyPatch, n_updates: int) -> None:
    for name in ("PAYS_FROM", "PAYS_FROM_IMAGES"):
        monkeypatch.setattr(compiling, name, n_updates)


@pytest.mark.slow
@COMPILES
@pytest.mark.parametrize("maker", ["SAC", "SRSPR"])
def test_auto_compiles_where_it_pays_and_the_file_remembers(
    maker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_threshold(monkeypatch, 50)
    model, other = (OFF_POLICY[maker](learning_starts=20, replay_ratio=1, compile="auto") for _ in range(2))
    assert model.compiled is None
    assert other.learn(69).compiled is False
    model.learn(70)
    assert model.compiled is True and model.learner._execution.compiled
    model.save(tmp_path / "model.zip")
    load = type(model).load
    assert load(tmp_path / "model.zip").compiled is True
    assert load(tmp_path / "model.zip", compile=False).compiled is False
    undecided = load(tmp_path / "model.zip", env=env_of(maker), compile="auto")
    assert undecided.compiled is None and undecided.learn(10).compiled is False


@COMPILES
@pytest.mark.parametrize(
    ("kwargs", "n_updates"),
    [
        ({"replay_ratio": 0.5}, 40),
        ({"train_freq": 4, "gradient_steps": 2}, 40),
        ({"train_freq": 4, "gradient_steps": -1}, 80),
        ({"train_freq": (1, "episode"), "gradient_steps": -1}, 80),
        ({"env": vec(4), "replay_ratio": 0.5}, 40),
        ({"env": vec(4), "train_freq": 1, "gradient_steps": 2}, 40),
        ({"env": vec(4), "train_freq": 1, "gradient_steps": -1}, 80),
    ],
)
def test_counts_the_gradient_steps_to_come(
    kwargs: dict[str, Any], n_updates: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for threshold, expected in ((n_updates, True), (n_updates + 1, False)):
        set_threshold(monkeypatch, threshold)
        model = sac(learning_starts=20, **kwargs)
        model._total_timesteps = 100
        model._before_turns()
        assert model.compiled is expected


def test_episodes_of_unknown_length_stay_uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    set_threshold(monkeypatch, 1)
    model = sac(learning_starts=20, train_freq=(1, "episode"), gradient_steps=2)
    model._total_timesteps = 100
    model._before_turns()
    assert model.compiled is False


@COMPILES
@pytest.mark.parametrize("maker", ["SAC", "SRSPR"])
@pytest.mark.parametrize("compile", [True, "auto"])
def test_without_a_compiler_training_goes_on_uncompiled(
    compile: Any, maker: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_threshold(monkeypatch, 5)
    model = OFF_POLICY[maker](compile=compile)
    without = torch._inductor.config.patch({"cpp.cxx": ("/nonexistent/c++",)})
    with without, warnings.catch_warnings(record=True) as caught:
        assert "C++ compiler" in (why_not_compiled(model.learner) or "")
        warnings.simplefilter("always")
        model.learn(30)
    said = [str(w.message) for w in caught if "not compiled" in str(w.message)]
    assert len(said) == (1 if compile is True else 0)
    assert model.compiled is False and model._n_updates == 20


@pytest.mark.parametrize("compile", [True, "auto"])
@pytest.mark.parametrize("version", sampled(["2.10.0+cu130", "2.4.1", "1.13.1"], ("2.10.0+cu130",)))
def test_an_old_torch_is_told_of_once(compile: Any, version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over several models, calls of ``learn`` and a file that says to go on compiled; and the numbers are eager's."""
    set_threshold(monkeypatch, 5)
    eager = sac(compile=False).learn(30)
    monkeypatch.setattr(torch, "__version__", version)
    monkeypatch.setattr(execution, "_told", set())
    file = io.BytesIO()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert sac(compile="auto").learn(12).compiled is False  # too short to pay
        assert not caught
        models = [sac(compile=compile).learn(30) for _ in range(3)]
        models[1].learn(30)
        elsewhere = sac(compile=compile)
        elsewhere.compiled = True
        elsewhere.save(file)
        file.seek(0)
        models.append(SAC.load(file, env=vec()))
        models[3].learn(30)
    said = [str(w.message) for w in caught if "not compiled" in str(w.message)]
    assert said == [
        f"The gradient step is not compiled: that needs torch 2.11 or newer, and this is {version}. It is run eagerly, "
        "on a GPU captured"
    ]
    assert not any(model.compiled or model.learner._execution.compiled for model in models)
    assert not differing(state(models[0]), state(eager))


@pytest.mark.parametrize(("version", "old"), [("2.11.0", False), ("2.11.0a0+git1234", False), ("2.14.1+cpu", False),
                                              ("3.0.0", False), ("2.10.1", True), ("2.4", True)])  # fmt: skip
def test_which_torch_is_old(version: str, old: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "__version__", version)
    assert (old_torch() is not None) is old


class Peeking(BaseFeaturesExtractor):
    """Looks at a value on the host, which cannot be compiled."""

    def __init__(self, observation_space: Any):
        super().__init__(observation_space, 3)
        self.layer = nn.Linear(3, 3)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        y = self.layer(observations)
        return y if y.sum().item() > 1e9 else y + 1


@COMPILES
def test_what_cannot_be_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    set_threshold(monkeypatch, 5)
    kwargs = {"policy_kwargs": {"net_arch": [8], "features_extractor_class": Peeking}}
    model = sac(compile="auto", **kwargs)
    with pytest.warns(UserWarning, match="not compiled, as it cannot be"):
        model.learn(30)
    assert model.compiled is False and model._n_updates == 20
    eager = sac(compile=False, **kwargs).learn(30)
    assert not differing(state(model), state(eager))
    with pytest.raises(RuntimeError, match=r"compile=True, but .*compile=False"):
        sac(compile=True, **kwargs).learn(30)


@COMPILES
@pytest.mark.slow
def test_parts_of_ones_own_are_compiled_when_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    class Own(Pessimism):
        def __init__(self, agent: SAC):
            super().__init__(1.0)

    class Counting(Own):
        """Not made to be compiled: its number changes at every step."""

        def before_updates(self, agent: SAC) -> None:
            self.constant += 0.01

    set_threshold(monkeypatch, 5)
    monkeypatch.setitem(PESSIMISMS, "own", Own)
    monkeypatch.setitem(PESSIMISMS, "counting", Counting)
    assert sac(pessimism="own").learn(20).compiled is False
    assert sac(pessimism="own", compile=True).learn(20).learner._execution.compiled
    monkeypatch.setattr(execution.Compiled, "MAX_PROGRAMS", 2)
    with pytest.raises(RuntimeError, match=r"compile=True, but .*changes again and again.*compile=False"):
        sac(pessimism="counting", compile=True).learn(20)


@pytest.mark.parametrize("maker", ["SAC", "SRSPR"])
def test_foreign_optimizers_stay_uncompiled(maker: str, monkeypatch: pytest.MonkeyPatch) -> None:
    set_threshold(monkeypatch, 5)
    make = OFF_POLICY[maker]
    small: dict[str, Any] = TINY if maker == "SRSPR" else {"net_arch": [8]}
    kwargs = {"policy_kwargs": {**small, "optimizer_class": torch.optim.RMSprop}}
    assert make(**kwargs).learn(30).compiled is False
    with pytest.warns(UserWarning, match="AdamW only, not of RMSprop"):
        assert make(compile=True, **kwargs).learn(30).compiled is False


@COMPILES
def test_a_network_of_ones_own_is_compiled_when_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where the networks are one, in a policy of one's own."""
    set_threshold(monkeypatch, 5)
    kwargs: dict[str, Any] = {"learning_starts": 10, "policy_kwargs": TINY, "verbose": 1}
    model = SRSPR(OwnSPRPolicy, env_of("SRSPR"), buffer_size=100, batch_size=4, n_steps=3, n_predictions=2, **kwargs)
    assert model.learn(16).compiled is False
    words = "The gradient step is not compiled: policy=OwnSPRNetwork does not declare compilable = True\n"
    assert words in capsys.readouterr().out
    monkeypatch.setattr(OwnSPRNetwork, "compilable", True, raising=False)
    assert not foreign_parts(model.learner)


class OwnSPRNetwork(SPRNetwork):
    pass


class OwnSPRPolicy(SPRPolicy):
    def make_network(self) -> SPRNetwork:
        network = super().make_network()
        network.__class__ = OwnSPRNetwork
        return network


@COMPILES
@pytest.mark.slow
def test_says_how_long_it_takes(capsys: pytest.CaptureFixture[str]) -> None:
    model = sac(compile=True, verbose=1)
    model.learn(30)
    out = capsys.readouterr().out
    assert "Compiling the gradient step ..." in out and "Compiled in" in out
    assert out.count("Compiled in") == 1


@pytest.mark.slow
@COMPILES
@pytest.mark.parametrize("replay_ratio", [0.5, 1, 3])
def test_diagnostics_find_gradients_of_a_compiled_model(replay_ratio: float) -> None:
    model = sac(compile=True, learning_starts=10, replay_ratio=replay_ratio)
    callback = DiagnosticsCallback(Toy(), every=20)
    model.learn(35, callback=callback)
    assert model.learner._execution.compiled
    # Measured at 20 steps, of the gradient step after 19; the last left none.
    assert callback.last_results["gradient_norm_critic"] > 0
    assert not any(name.startswith("gradient_norm") for name in callback.measure())


# ---------------------------------------------------------------- batches


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("cls", PLAIN_BUFFERS)
def test_gathers_what_the_buffer_would_give(cls: Any, n_envs: int) -> None:
    from gymnasium import spaces

    is_dict = issubclass(cls, DictReplayBuffer)
    box = spaces.Box(-1, 1, (3,), np.float32)
    space = spaces.Dict({"x": box, "image": spaces.Box(0, 255, (4, 4), np.uint8)}) if is_dict else box
    kwargs = {"validation_proportion": 0.3} if "Validation" in cls.__name__ else {}
    buffer = cls(20, space, spaces.Box(-1, 1, (2,), np.float32), n_envs=n_envs, device="cpu", **kwargs)
    rng = np.random.default_rng(0)
    memory = BatchMemory()
    for i in range(30):
        obs = {key: np.stack([sub.sample() for _ in range(n_envs)]) for key, sub in space.items()} if is_dict else (
            rng.normal(size=(n_envs, 3)))  # fmt: skip
        done = rng.random(n_envs) < 0.5
        infos = [{"TimeLimit.truncated": bool(rng.random() < 0.5)} for _ in range(n_envs)]
        after = obs if rng.random() < 0.3 else {k: v[::-1] for k, v in obs.items()} if is_dict else -obs
        buffer.add(obs, after, rng.normal(size=(n_envs, 2)), rng.normal(size=n_envs), done, infos)
        if i not in (10, 25):
            continue
        np.random.seed(i)
        expected = draw_batches(buffer, 3, 16, 0.9, None)
        np.random.seed(i)
        got = draw_batches(buffer, 3, 16, 0.9, None, memory)
        assert len(got) == 3
        for ours, theirs in zip(got, expected, strict=True):
            for a, b in zip(ours, theirs, strict=True):
                pairs = [(a[k], b[k]) for k in b] if isinstance(b, dict) else [(a, b)]
                for x, y in pairs:
                    assert torch.equal(torch.as_tensor(x), torch.as_tensor(y))
                    assert torch.as_tensor(x).dtype == torch.as_tensor(y).dtype
    # The same memory, for as many.
    places = [b.actions.data_ptr() for b in draw_batches(buffer, 3, 16, 0.9, None, memory)]
    assert places == [b.actions.data_ptr() for b in draw_batches(buffer, 3, 16, 0.9, None, memory)]


def test_n_step_returns_need_their_buffer() -> None:
    with pytest.raises(ValueError, match=r"n_steps=3 .*NStepReplayBuffer.*DeviceReplayBuffer"):
        sac(n_steps=3, replay_buffer_class=DeviceReplayBuffer)


@pytest.mark.parametrize("value", ["yes", 1, None])
def test_compile_is_checked(value: Any) -> None:
    with pytest.raises(ValueError, match=f"compile must be True, False or 'auto', not {value!r}"):
        sac(compile=value)


def test_pays_from_is_documented() -> None:
    text = (Path(__file__).parents[2] / "docs" / "performance.md").read_text()
    assert f"{execution.PAYS_FROM:,}" in text and f"{execution.PAYS_FROM_IMAGES:,} from images on a CPU" in text


def test_gradient_steps_on_images_pay_sooner() -> None:
    images, numbers = spaces.Box(0, 255, (3, 64, 64), np.uint8), spaces.Box(-1, 1, (3,), np.float32)
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    for space in (images, spaces.Dict({"camera": images, "joints": numbers})):
        assert compiling.pays_from(space, cpu) == execution.PAYS_FROM_IMAGES
        assert compiling.pays_from(space, gpu) == execution.PAYS_FROM
    for space in (numbers, spaces.Dict({"joints": numbers})):
        assert compiling.pays_from(space, cpu) == execution.PAYS_FROM


def test_device_buffer_gives_what_the_plain_one_gives() -> None:
    models = [sac(vec(2), replay_buffer_class=cls, buffer_size=60, compile=False) for cls in (None, DeviceReplayBuffer)]
    for model in models:
        model.set_random_seed(0)
        model.learn(100)
    plain, on_device = (model.replay_buffer for model in models)
    assert isinstance(on_device, DeviceReplayBuffer) and isinstance(on_device.observations, torch.Tensor)
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        assert np.array_equal(getattr(plain, name), getattr(on_device, name).numpy())
    assert plain.full and on_device.full and plain.pos == on_device.pos
    assert not differing(state(models[0]), state(models[1]))
    with pytest.raises(ValueError, match="DeviceReplayBuffer.*VecNormalize"):
        sac(VecNormalize(vec()), replay_buffer_class=DeviceReplayBuffer)
    with pytest.raises(ValueError, match="DeviceReplayBuffer.*optimize_memory_usage=True"):
        sac(replay_buffer_class=DeviceReplayBuffer, optimize_memory_usage=True)
