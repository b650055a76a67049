"""Mistakes in parts of one's own: each is an error, or a warning, that names class, method and argument."""

import copy
import re
import sys
import threading
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import nn

from sb3_sample import BRO, DAC, SAC, Dataset, FadedReplayBuffer
from sb3_sample.learner import first_step
from sb3_sample.parts import (
    Batch,
    BatchTransform,
    Exploration,
    Extra,
    LearnedPessimism,
    Network,
    OptimisticExploration,
    Pessimism,
    ValueHead,
    linear,
)
from tests.sac.common import COMPILES, MAKERS, differing, random_batch, sac, sampled, state, vec


def rule(**methods: Any) -> type[Pessimism]:
    return type("MyRule", (Pessimism,), {"__init__": lambda self, learner: Pessimism.__init__(self, 1.0), **methods})


def head(**methods: Any) -> type[ValueHead]:
    return type("MyHead", (ValueHead,), methods)


def transform(entry: str, change: Any) -> type[BatchTransform]:
    def apply(self: Any, batch: Batch, noise: Any) -> Batch:
        return batch._replace(**{entry: change(getattr(batch, entry))})

    return type("MyTransform", (BatchTransform,), {"transform": apply})


def network(forward: Any, out_features: Any = 8) -> type[Network]:
    class MyNet(Network):
        def __init__(self, in_features: int, n_copies: int | None = None):
            super().__init__()
            if out_features is not None:
                self.out_features = out_features
            self.dense = linear(in_features, 8, n_copies)

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return forward(self.dense(x))  # type: ignore[no-any-return]

    return MyNet


def explorer(act: Any) -> type[Exploration]:
    base = Exploration.act
    return type("MyExplorer", (Exploration,), {"act": lambda self, learner, o: act(base(self, learner, o))})


def critics(cls: type[Network]) -> dict[str, Any]:
    return {"policy_kwargs": {"critic_network": cls}}


#: Batches of 8 transitions of observations of 3 and actions of 2 numbers, 2 critics.
SHAPES: list[tuple[dict[str, Any], str]] = [
    (
        {"batch_transforms": [transform("rewards", lambda r: r.squeeze(1))]},
        "MyTransform.transform returns must have rewards that are a tensor of shape (8, 1), not a tensor of shape (8",
    ),
    ({"batch_transforms": [transform("rewards", lambda r: r.T)]}, "of shape (8, 1), not a tensor of shape (1, 8)"),
    (
        {"batch_transforms": [transform("dones", lambda d: d.squeeze(1))]},
        "MyTransform.transform returns must have dones",
    ),
    ({"batch_transforms": [transform("actions", lambda a: a[:, :1])]}, "actions that are a tensor of shape (8, 2)"),
    (
        {"batch_transforms": [transform("observations", lambda o: o[:, :2])]},
        "observations that are a tensor of shape (8, 3)",
    ),
    ({"batch_transforms": [transform("next_observations", lambda o: o[:4])]}, "next_observations that are a tensor of"),
    (
        {"batch_transforms": [transform("discounts", lambda d: torch.full((8,), d))]},
        "discounts that are a number, or a",
    ),
    ({"batch_transforms": [transform("rewards", lambda r: r.numpy())]}, "a tensor of shape (8, 1), not array("),
    (
        {"batch_transforms": [type("MyTransform", (BatchTransform,), {"transform": lambda *_: None})]},
        "what MyTransform.transform returns must be a Batch, not None",
    ),
    (
        {"pessimism": rule(beta=lambda self: torch.ones(1))},
        "MyRule.beta must return a number or a tensor of shape (), not",
    ),
    ({"pessimism": rule(beta=lambda self: None)}, "MyRule.beta must return a number or a tensor of shape (), not None"),
    (
        {"pessimism": rule(beta=lambda self: -1.0)},
        "MyRule.beta must return a number of at least 0 and finite, not -1.0",
    ),
    ({"pessimism": rule(beta=lambda self: torch.tensor(float("nan")))}, "at least 0 and finite, not nan"),
    (
        {"pessimism": rule(value=lambda self, q: q.mean(dim=(0, 2)))},
        "MyRule.value must return the ensemble's value of shape (B, K) = (",
    ),
    ({"pessimism": rule(value=lambda self, q: q)}, "MyRule.value must return the ensemble's value"),
    ({"pessimism": rule(update=lambda *_, **__: None)}, "MyRule.update must return a dict of what to log, not None"),
    ({"pessimism": rule(update=lambda *_, **__: {"a": 1.0})}, "MyRule.update must log scalar tensors; 'a' is 1.0"),
    (
        {"pessimism": rule(after_update=lambda *_: {"a": torch.ones(2)})},
        "MyRule.after_update must log scalar tensors; 'a' is a tensor of shape (2,)",
    ),
    (
        {"pessimism": rule(update=lambda *_, **__: {"a": torch.ones(1)})},
        "MyRule.update must log scalar tensors; 'a' is a tensor of shape (1,)",
    ),
    (
        {"value_head": head(values=lambda self, q: q.squeeze(-1))},
        "MyHead.values must return values of shape (E, B, K) = (2, ",
    ),
    (
        {"value_head": head(values=lambda self, q: q.transpose(0, 1))},
        "MyHead.values must return values of shape (E, B, K) = (2, ",
    ),
    (
        {"value_head": head(target=lambda self, batch, *_: batch.rewards.squeeze(1))},
        "MyHead.target must return a target of shape (B, n_outputs) = (",
    ),
    (
        {"value_head": head(target=lambda self, batch, *_: batch.rewards.mean())},
        "MyHead.target must return a target with B =",
    ),
    (
        {"value_head": head(loss=lambda self, q, target: (q - target).square().mean(dim=(1, 2)))},
        "MyHead.loss must return a loss of shape (), not a tensor of shape (2,)",
    ),
    ({"value_head": head(loss=lambda self, q, target: 0.5)}, "MyHead.loss must return a loss of shape (), not 0.5"),
    (
        {"value_head": head(loss=lambda self, q, target: (q.detach() - target).mean())},
        "MyHead.loss must return a loss through which a gradient",
    ),
    (
        critics(network(lambda h: h[0])),
        "MyNet.forward must return outputs of critics of shape (E, B, out_features) = (2, ",
    ),
    (
        critics(network(lambda h: h.transpose(0, 1))),
        "MyNet.forward must return outputs of critics of shape (E, B, out_features) = (2, ",
    ),
    (
        {"policy_kwargs": {"actor_network": network(lambda h: h[:1])}},
        "MyNet.forward must return outputs of an actor of shape (B, out_features) = (",
    ),
    (
        {"exploration": explorer(lambda a: a[0])},
        "MyExplorer.act must return actions in [-1, 1] of shape (n_envs, A) = (1, 2), not a tensor of shape (2,)",
    ),
    (
        {"exploration": explorer(lambda a: a.numpy())},
        "MyExplorer.act must return actions in [-1, 1] of shape (n_envs, A) = (1, 2), not array",
    ),
    (
        {"exploration": explorer(lambda a: 0 * a + 3)},
        "MyExplorer.act must return actions in [-1, 1], whatever the bounds of the action space, not in [3, 3]",
    ),
    ({"exploration": explorer(lambda a: a / 0 * 0)}, "MyExplorer.act must return finite actions"),
]


@pytest.mark.parametrize(("kwargs", "words"), SHAPES)
def test_wrong_shapes_are_errors_at_the_first_step(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        sac(**kwargs).learn(30)


class NaiveNorm(Network):
    """Batch norm as for a single network."""

    def __init__(self, in_features: int, n_copies: int | None = None):
        super().__init__()
        self.out_features = 8
        self.dense, self.norm = linear(in_features, 8, n_copies), nn.BatchNorm1d(8)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.norm(self.dense(x))


def raising(*_: Any) -> Any:
    raise KeyError("x")


@pytest.mark.parametrize(
    ("kwargs", "error", "note"),
    [
        (
            critics(NaiveNorm),
            RuntimeError,
            r"in NaiveNorm\.forward, called with n_copies=2 and x \(B, in_features\) = \(\d, 5\), before the first",
        ),
        (
            {"policy_kwargs": {"actor_network": network(raising)}},
            KeyError,
            r"in MyNet\.forward, called with x \(B, in_features\) = \(\d, 3\)",
        ),
        (
            {"value_head": head(loss=lambda self, q, target: (q - target[:3]).mean())},
            RuntimeError,
            r"in MyHead\.loss, called with q \(E, B, n_outputs\), target \(B, n_outputs\) = \(2, \d, 1\), \(\d, 1\)",
        ),
        ({"value_head": head(values=raising)}, KeyError, r"in MyHead\.values, called with outputs \(E, B, n_outputs\)"),
        ({"pessimism": rule(beta=raising)}, KeyError, r"in MyRule\.beta, before the first gradient step"),
        ({"pessimism": rule(value=raising)}, KeyError, r"in MyRule\.value, called with q \(E, B, K\) = \(2, \d, 1\)"),
    ],
)
def test_an_error_that_a_part_raises_has_a_note_of_where(kwargs: dict[str, Any], error: Any, note: str) -> None:
    model = sac(**kwargs)
    with pytest.raises(error) as raised:
        model._update(random_batch(model))
    assert [re.match(note, each) is not None for each in raised.value.__notes__] == [True]


@COMPILES
@pytest.mark.parametrize("compile", [True, pytest.param("auto", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("update", "error", "words"),
    [
        (lambda *_, **__: None, ValueError, r"^MyRule\.update must return a dict"),
        (lambda self, *_, **__: self.nothing, AttributeError, "'MyRule' object has no attribute 'nothing'"),
    ],
)
def test_an_error_inside_of_a_compiled_step_is_the_parts_own(
    update: Any, error: Any, words: str, compile: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_sample.training.compiling.PAYS_FROM", 5)
    model = sac(pessimism=rule(update=update, compilable=True), compile=compile)
    with pytest.raises(error, match=words):
        model.learn(30)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"rewards": torch.zeros(8)},
            "batch must have rewards that are a tensor of shape (8, 1), not a tensor of shape",
        ),
        ({"dones": torch.zeros(1, 8)}, "batch must have dones that are a tensor of shape (8, 1)"),
        ({"observations": torch.zeros(7, 3)}, "batch must have observations that are a tensor of shape (8, 3)"),
        ({"observations": [1.0]}, "batch must have observations that are a tensor of shape (8,), not [1.0]"),
        ({"actions": torch.zeros(8)}, "batch must have actions of shape (B, A), not a tensor of shape (8,)"),
        ({"discounts": torch.ones(8)}, "batch must have discounts that are a number, or a tensor of shape (8, 1)"),
    ],
)
def test_a_batch_of_ones_own_is_checked(change: dict[str, Any], words: str) -> None:
    model = sac()
    with pytest.raises(ValueError, match=re.escape(words)):
        model.learner.update(random_batch(model)._replace(**change))
    extra = Extra(random_batch(model)._replace(**change))
    with pytest.raises(ValueError, match=re.escape("extra." + words)):
        model.learner.update(random_batch(model), extra=extra)
    assert model.learner.n_updates == 0


def test_networks_without_hidden_layers_train() -> None:
    """Stable-Baselines3's ``net_arch=[]``: linear critics, whose network is the identity for all of them."""
    assert sac(policy_kwargs={"net_arch": []}).learn(20)._n_updates > 0


def test_a_data_set_is_no_batch() -> None:
    model = sac().learn(20)
    data = Dataset.from_arrays(np.zeros((8, 3)), np.zeros((8, 2)), *np.zeros((3, 8)))
    learner = SAC.learner(data.observation_space, data.action_space, policy_kwargs={"net_arch": [8]})
    for each in (learner, model.learner):
        with pytest.raises(ValueError, match=r"batch must be a Batch, not .*Dataset.*: data\.sample\(n\) of a Dataset"):
            each.update(data)


def test_a_batch_that_is_as_long_as_something_else_is_not_confused() -> None:
    """As many transitions as critics: a head that exchanges the two has the right shape."""
    model = sac(value_head=head(values=lambda self, q: q.transpose(0, 1)))
    batch = Batch(*(value[:2] if isinstance(value, torch.Tensor) else value for value in random_batch(model)))
    with pytest.raises(ValueError, match=r"MyHead\.values"):
        model._update(batch)


@pytest.mark.parametrize("maker", MAKERS)
def test_the_check_leaves_nothing_behind(maker: str) -> None:
    model = MAKERS[maker]()
    batch = random_batch(model)._replace(discounts=0.9)
    model.learner.set_training_mode(True)
    before = copy.deepcopy(state(model))
    modes = [module.training for module in model.policy.modules()]
    random, arrays = torch.get_rng_state(), np.random.get_state()[1].copy()  # type: ignore[union-attr]
    first_step.check(model.learner, batch, None)
    assert not differing(before, state(model)) and modes == [module.training for module in model.policy.modules()]
    assert torch.equal(random, torch.get_rng_state())
    assert np.array_equal(arrays, np.random.get_state()[1])  # type: ignore[arg-type]


def test_who_acts_in_another_thread_meanwhile_finds_all_parameters() -> None:
    model = sac()
    modules = list(model.policy.modules())
    n, found, is_over = len(list(model.policy.parameters())), set(), threading.Event()

    def read() -> None:
        while not is_over.is_set():
            try:
                found.add(len(list(model.policy.parameters())))
            except AttributeError as error:
                found.add(repr(error))

    switch = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    thread = threading.Thread(target=read)
    thread.start()
    try:
        for _ in range(3_000):
            with first_step._untouched(modules):
                pass
    finally:
        is_over.set()
        thread.join()
        sys.setswitchinterval(switch)
    assert found == {n}


class Counting(Network):
    """Random, with statistics of its own and an attribute: whatever a check could leave behind."""

    n: torch.Tensor

    def __init__(self, in_features: int, n_copies: int | None = None):
        super().__init__()
        self.out_features, self.n_calls = 8, 0
        self.dense = linear(in_features, 8, n_copies)
        self.register_buffer("n", torch.tensor(0))
        self.register_buffer("latest", None)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.n += 1
        self.latest = x.detach().mean()
        self.n_calls += 1
        return self.dense(x) + torch.rand(())


def test_nor_does_it_in_a_network_of_ones_own() -> None:
    model = sac(policy_kwargs={"critic_network": Counting, "actor_network": Counting})
    trunk, seen = model.critic.trunk, []
    trunk.register_forward_hook(lambda *_: seen.append(1))
    random = torch.get_rng_state()
    first_step.check(model.learner, random_batch(model)._replace(discounts=0.9), None)
    assert (trunk.n_calls, int(trunk.n), trunk.latest, seen) == (0, 0, None, [])
    assert torch.equal(random, torch.get_rng_state())
    model._update(random_batch(model))
    assert trunk.n_calls == int(trunk.n) == len(seen) > 0 and trunk.latest is not None


# ---------------------------------------------------------------- at construction


class NoForward(Network):
    def __init__(self, in_features: int, n_copies: int | None = None):
        super().__init__()
        self.out_features = 8


class NoTransform(BatchTransform):
    pass


class NoGaussian(OptimisticExploration):
    pass


class NoSuper(Pessimism):
    def __init__(self, learner: Any):
        self.module = nn.Linear(1, 1)


class NoSuperPlain(BatchTransform):
    def __init__(self, learner: Any):
        self.text = "a"

    def transform(self, batch: Batch, noise: Any) -> Batch:
        return batch


class NoLearner(Pessimism):
    def __init__(self) -> None:
        super().__init__(1.0)


class OnlyStart(Pessimism):
    def __init__(self, start: float):
        super().__init__(start)


class OnlyDefault(Pessimism):
    def __init__(self, start: float = 1.0):
        super().__init__(1.0)
        self.start = start


class NoInit(Pessimism):
    pass


class OtherName(Pessimism):
    def __init__(self, of: Any, weight: float = 0.5):
        super().__init__(weight)


class Stacked(NoForward):
    stacks_rows = "target"
    trains_in_target = False

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x


class Needs(Pessimism):
    def __init__(self, learner: Any, rate: float):
        super().__init__(rate)


class Unlisted(Pessimism):
    def __init__(self, learner: Any):
        super().__init__(1.0)
        self.weight = nn.Parameter(torch.tensor(1.0))
        self.optimizer = learner.make_optimizer([self.weight])


class AnyKwargs(Pessimism):
    def __init__(self, learner: Any, **kwargs: Any):
        super().__init__(**kwargs)


class Jitter(BatchTransform):
    def __init__(self, learner: Any, jitter: float = 0.0):
        super().__init__(learner)
        self.jitter = jitter

    def transform(self, batch: Batch, noise: Any) -> Batch:
        return batch


class Half(Jitter):
    pass


class NoCopies(Network):
    def __init__(self, in_features: int):
        super().__init__()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x


class Head(ValueHead):
    def __init__(self, width: int = 1):
        super().__init__()
        self.n_outputs = width


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        (critics(NoForward), "critic_network: NoForward must define forward(), which Network leaves to it"),
        ({"batch_transforms": [NoTransform]}, "batch_transforms[0]: NoTransform must define transform()"),
        ({"exploration": NoGaussian}, "exploration: NoGaussian must define _gaussian()"),
        (
            {"policy_kwargs": {"critic_net": "mlp"}},
            "policy_kwargs has 'critic_net', which is no argument of SACPolicy. Did you mean 'critic_network'?",
        ),
        (
            {"policy_kwargs": {"qqq": 1}},
            "policy_kwargs has 'qqq', which is no argument of SACPolicy. It takes ['activation_fn', 'actor_features',",
        ),
        (
            {"policy_kwargs": {"optimizer_kwargs": {"weight_dcay": 1}}},
            "policy_kwargs['optimizer_kwargs'] has 'weight_dcay', which is no argument of AdamW. Did you mean 'weight_",
        ),
        (
            {"policy_kwargs": {"optimizer_class": torch.optim.SGD, "optimizer_kwargs": {"lr": 1}}},
            "policy_kwargs['optimizer_kwargs'] has 'lr', which follows from learning_rate: pass that instead",
        ),
        (
            {"replay_buffer_kwargs": {"fade": 1}},
            "replay_buffer_kwargs has 'fade', which is no argument of CompactReplayBuffer. It takes ['frame_stack', '",
        ),
        (
            {"replay_buffer_class": FadedReplayBuffer, "replay_buffer_kwargs": {"fades": 1}},
            "replay_buffer_kwargs has 'fades', which is no argument of FadedReplayBuffer. Did you mean 'fade'?",
        ),
        (
            {"replay_buffer_kwargs": {"buffer_size": 5}},
            "replay_buffer_kwargs has 'buffer_size', which follows from buffer_size: pass that instead",
        ),
        (
            {"pessimism_kwargs": {"a": 1}},
            "pass pessimism as one of ['gpl', 'opl', 'top', 'vpl'], or as a class derived from Pessimism",
        ),
        (
            critics(Stacked),
            "Stacked: stacks_rows='target' has the targets use statistics of the stacked rows",
        ),
        ({"pessimism": NoSuper}, "pessimism: NoSuper.__init__ must call super().__init__(...) before"),
        ({"batch_transforms": [NoSuperPlain]}, "batch_transforms[0]: NoSuperPlain.__init__ must call super().__init__"),
        ({"pessimism": NoLearner}, "pessimism: NoLearner.__init__ must take self, learner first, not nothing"),
        (
            {"pessimism": NoLearner, "pessimism_kwargs": {"start": 1}},
            "pessimism: NoLearner.__init__ must take self, learner first, not nothing",
        ),
        ({"pessimism": OnlyStart}, "pessimism: OnlyStart.__init__ must take self, learner first, not start (pessimism"),
        (
            {"pessimism": OnlyStart, "pessimism_kwargs": {"start": 1}},
            "pessimism: OnlyStart.__init__ must take self, learner first, not start",
        ),
        ({"pessimism": OnlyDefault}, "pessimism: OnlyDefault.__init__ must take self, learner first, not start"),
        ({"pessimism": NoInit}, "pessimism: NoInit.__init__ must take self, learner first, not beta (pessimism must"),
        ({"pessimism": Needs}, "missing a required argument: 'rate'"),
        ({"pessimism": AnyKwargs}, "beta"),
        ({"pessimism": Unlisted}, "pessimism: Unlisted.optimizers() must list self.optimizer, so that it is saved"),
        (
            {"batch_transforms": [Jitter, (Jitter, {"jiter": 1})]},
            "batch_transforms[1] has 'jiter', but batch_transforms[1]=",
        ),
        ({"value_head": Head, "value_head_kwargs": {"widht": 2}}, "value_head_kwargs has 'widht', but value_head="),
        ({"value_head": Head, "value_head_kwargs": {"widht": 2}}, "takes ['width']"),
        (
            {"value_head": Head, "value_head_kwargs": {"width": 0}},
            "Head.n_outputs must be an integer of at least 1, not 0",
        ),
        (
            {"pessimism": rule(update=lambda self, learner, batch: {})},
            "pessimism: MyRule.update must take (self, learner, batch, step, noise=None, extra=None), as Pessimism.upd",
        ),
        (
            {"exploration": type("Fast", (Exploration,), {"act": lambda self, observations: observations})},
            "exploration: Fast.act must take (self, learner, observations), as Exploration.act does: too many",
        ),
        (
            {"value_head": head(target=lambda self, batch, next_q, value: batch.rewards)},
            "value_head: MyHead.target must take (self, batch, next_q, value, entropy_bonus), as",
        ),
        (
            {"batch_transforms": [type("Short", (BatchTransform,), {"transform": lambda self, batch: batch})]},
            "batch_transforms[0]: Short.transform must take (self, batch, noise), as",
        ),
        (
            critics(type("Two", (Network,), {"forward": lambda self, x, y: x})),
            "critic_network: Two.forward must take (self, x), as Network.forward does: missing a required argument:",
        ),
        (
            critics(NoCopies),
            "critic_network: NoCopies is made as NoCopies(in_features, n_copies=...) with the arguments {}",
        ),
        (critics(network(lambda h: h, None)), "MyNet.out_features must be an integer of at least 1, not None"),
        (
            {**critics(network(lambda h: h)), "redo_period": 10},
            "redo_period=10 recycles hidden neurons that a network lists in hidden_units(head), and MyNet lists none",
        ),
    ],
)
def test_what_is_missing_is_an_error_at_construction(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises((ValueError, TypeError), match=re.escape(words)):
        sac(**kwargs)


def test_the_learner_may_have_another_name() -> None:
    assert sac(pessimism=OtherName, pessimism_kwargs={"weight": 0.25}).pessimism_rule.beta() == 0.25


def test_arguments_that_a_class_hands_on() -> None:
    assert sac(pessimism=AnyKwargs, pessimism_kwargs={"beta": 0.25}).pessimism_rule.beta() == 0.25


@pytest.mark.parametrize(
    ("argument", "base", "name", "near"),
    [
        ("pessimism", rule(), "aftr_update", "after_update"),
        ("pessimism", rule(), "bta", "beta"),
        ("pessimism", rule(), "compilabel", "compilable"),
        ("exploration", Exploration, "on_stp", "on_step"),
        ("value_head", ValueHead, "targets", "target"),
    ],
)
def test_a_name_that_is_nearly_a_hook_is_warned_of_once(argument: str, base: type, name: str, near: str) -> None:
    cls = type("Mine", (base,), {name: lambda self: None, "__module__": __name__})
    with pytest.warns(UserWarning, match=rf"Mine\.{name} is called by nobody; did you mean {near}\? \({argument}=Mine"):
        sac(**{argument: cls})
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*called by nobody")
        sac(**{argument: cls})


class Helped(Pessimism):
    """Names of its own that it makes use of, or that are near to a hook that it has."""

    def __init__(self, learner: Any):
        super().__init__(1.0)
        self.register_buffer("weight", torch.tensor(self.betas()))

    def betas(self) -> float:
        return 0.5

    def before_updates(self, learner: Any) -> None:
        [self.weight.fill_(self.values_()) for _ in range(1)]

    def before_update(self) -> None:
        """Not called, but ``before_updates`` is there."""

    def values_(self) -> float:
        return 0.25


def test_names_of_ones_own_are_left_alone() -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*called by nobody")
        sac(pessimism=Helped)
        DAC("MlpPolicy", vec(), seed=0)


# ---------------------------------------------------------------- loading transforms


def test_transforms_at_loading(tmp_path: Path) -> None:
    sac(batch_transforms=[Jitter, (Jitter, {"jitter": 0.5})]).save(tmp_path / "m")

    def jitters(*transforms: Any, **kwargs: Any) -> list[float]:
        model = SAC.load(tmp_path / "m", env=vec(), batch_transforms=transforms, **kwargs)
        return [each.jitter for each in model.transforms]

    assert jitters(Jitter, Jitter) == [0, 0.5]
    assert jitters((Jitter, {"jitter": 2}), Jitter) == [2, 0.5]
    assert jitters(Jitter, (Jitter, {})) == [0, 0]
    assert jitters(Jitter, Half) == [0, 0], "the file's arguments are those of another class"
    for given in ([], [Jitter], [Jitter] * 3):
        with pytest.raises(
            ValueError, match=rf"batch_transforms has {len(given)} entries.* file has 2 transforms \(Jitter, Jitter\)"
        ):
            jitters(*given)
    # Arguments that take the place of the file's are not read from it: no trust is asked for.
    sac(batch_transforms=[(Jitter, {"jitter": Needs})]).save(tmp_path / "m")
    assert jitters((Jitter, {"jitter": 1})) == [1]
    with pytest.raises(ValueError, match=r"test_mistakes:Needs.*trusted_modules"):
        jitters(Jitter)
    assert jitters(Jitter, trusted_modules=[__name__]) == [Needs]
    sac().save(tmp_path / "m")
    assert jitters() == []
    with pytest.raises(ValueError, match="batch_transforms has 1 entries.* file has 0"):
        jitters(Jitter)


# ---------------------------------------------------------------- the learner alone


@pytest.mark.parametrize(
    ("spaces_", "words"),
    [
        ((3, 1), "action_space must be a bounded Box, not 1"),
        ((spaces.Box(-1, 1, (3,)), spaces.Discrete(2)), r"action_space must be a bounded Box, not Discrete\(2\)"),
        ((spaces.Box(-1, 1, (3,)), spaces.Box(-np.inf, np.inf, (1,))), "action_space must be bounded"),
        ((spaces.Box(-1, 1, (3,)), spaces.Box(1, 1, (1,))), "action_space must be a space with low < high"),
        ((3, spaces.Box(-1, 1, (1,))), "observation_space must be a space of Gymnasium's, Box, .*, not 3"),
        ((spaces.Tuple([]), spaces.Box(-1, 1, (1,))), "observation_space must be a space"),
    ],
)
def test_spaces_of_a_learner(spaces_: tuple[Any, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        BRO.learner(*spaces_)


BOX, ACTIONS = spaces.Box(-1, 1, (3,)), spaces.Box(-2, 2, (2,))


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("cls", [SAC, DAC])
def test_actions_for_arrays_and_tensors(cls: Any, deterministic: bool) -> None:
    def act(observations: Any) -> Any:
        return cls.learner(BOX, ACTIONS, seed=1, device="cpu").act(observations, deterministic)

    many = np.random.default_rng(0).normal(size=(4, 3))
    theirs = act(torch.as_tensor(many))
    assert isinstance(theirs, torch.Tensor) and theirs.shape == (4, 2) and theirs.abs().max() <= 1
    for array in (many, many.astype(np.float32)):
        ours = act(array)
        assert isinstance(ours, np.ndarray) and ours.shape == (4, 2) and ours.dtype == np.float32
        np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-5, atol=1e-6)
    single = act(many[0])
    assert isinstance(single, np.ndarray) and single.shape == (2,)
    np.testing.assert_allclose(single, act(many[:1])[0], rtol=1e-5, atol=1e-6)
    alone = act(torch.as_tensor(many[0]))
    assert isinstance(alone, torch.Tensor) and alone.shape == (2,)
    np.testing.assert_allclose(alone.numpy(), single, rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match=r"observations must have the shape \(B, 3\) or \(3,\), not \(4,\)"):
        act(np.zeros(4))


def test_actions_for_dicts() -> None:
    space = spaces.Dict({"a": BOX, "b": spaces.Box(-1, 1, (2,))})
    learner = SAC.learner(space, ACTIONS, device="cpu")
    many = {"a": np.zeros((5, 3), np.float32), "b": np.ones((5, 2), np.float32)}
    theirs = learner.act({key: torch.as_tensor(value) for key, value in many.items()}, deterministic=True)
    ours = learner.act(many, deterministic=True)
    assert isinstance(theirs, torch.Tensor) and isinstance(ours, np.ndarray)
    np.testing.assert_array_equal(ours, theirs.numpy())
    one = learner.act({key: value[0] for key, value in many.items()}, deterministic=True)
    np.testing.assert_allclose(one, ours[0], rtol=1e-5)
    with pytest.raises(ValueError, match=r"observations must have the keys \['a', 'b'\], not \['a'\]"):
        learner.act({"a": many["a"]})


class Recent(LearnedPessimism):
    def __init__(self, learner: Any, loss: str):
        super().__init__(learner, loss, "recent")


@pytest.mark.parametrize("loss", ["squared", "dual"])
def test_further_transitions_have_the_learners_discount(loss: str) -> None:
    """The same step as with it spelled out."""
    kwargs: dict[str, Any] = {"pessimism": Recent, "pessimism_kwargs": {"loss": loss}, "gamma": 0.9}
    learners = [SAC.learner(BOX, ACTIONS, device="cpu", **kwargs) for _ in range(2)]
    rng = torch.Generator().manual_seed(0)

    def batch() -> Batch:
        rows = [torch.randn(6, n, generator=rng) for n in (3, 2, 3)]
        return Batch(*rows, torch.zeros(6, 1), torch.randn(6, 1, generator=rng))

    step, further = batch(), batch()
    first = learners[0].update(step, extra=Extra(further))
    second = learners[1].update(step, extra=Extra(further._replace(discounts=0.9)))
    assert first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)
    assert "pessimism/loss" in first


# ---------------------------------------------------------------- what is not saved


class Counter:
    def __init__(self) -> None:
        self.n = 0


class Counts(Pessimism):
    """Counts in a plain attribute, in an object, in an array; constants, and a reference to the learner."""

    def __init__(self, learner: Any):
        super().__init__(1.0)
        self.learner_of_mine, self.constant, self.names = (learner,), 0.5, ["a"]
        self.k, self.counter, self.seen = 0, Counter(), np.zeros(2)
        self.optimizer = learner.make_optimizer([nn.Parameter(torch.tensor(1.0))])

    def optimizers(self) -> dict[str, Any]:
        return {"optimizer": self.optimizer}

    def after_update(self, learner: Any, batch: Batch) -> dict[str, torch.Tensor]:
        self.count()
        return {}

    def count(self) -> None:
        self.k += 1
        self.counter.n += 1
        self.seen[0] += 1


class Saves(Counts):
    def get_extra_state(self) -> Any:
        return {"k": self.k}

    def set_extra_state(self, state: Any) -> None:
        self.k = state["k"]


class Buffered(Counts):
    """The remedy: a buffer."""

    def __init__(self, learner: Any):
        super().__init__(learner)
        self.register_buffer("n", torch.tensor(0))

    def count(self) -> None:
        self.n += 1


def messages(caught: list[warnings.WarningMessage]) -> list[str]:
    return [str(each.message) for each in caught if "changes and is no buffer" in str(each.message)]


@pytest.mark.parametrize("checkpoint", [False, True])
def test_what_changes_and_is_in_no_file_is_warned_of(checkpoint: bool, tmp_path: Path) -> None:
    model = sac(pessimism=Counts, policy_kwargs={"critic_network": Counting, "actor_network": Counting})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(
            30, checkpoint=tmp_path / "run" if checkpoint else None, **{"checkpoint_freq": 15} if checkpoint else {}
        )
        assert bool(messages(caught)) is checkpoint
        model.save(tmp_path / "m")
        model.save(tmp_path / "m")
    said = messages(caught)
    assert len(said) == 1
    for name in ("Counts.k", "Counts.counter", "Counts.seen", "Counting.n_calls"):
        assert said[0].count(f"{name} changes and is no buffer: use register_buffer") == 1
    for name in ("constant", "names", "learner_of_mine", "optimizer", "latest"):
        assert f".{name} changes" not in said[0]


@pytest.mark.parametrize("cls", [Saves, Buffered])
def test_what_is_saved_is_not(cls: type, tmp_path: Path) -> None:
    model = sac(pessimism=cls)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(30).save(tmp_path / "m")
    assert messages(caught) == []
    loaded = SAC.load(tmp_path / "m", pessimism=cls)
    assert (loaded.pessimism_rule.k, getattr(loaded.pessimism_rule, "n", None)) == (
        model.pessimism_rule.k,
        getattr(model.pessimism_rule, "n", None),
    )


@pytest.mark.parametrize("maker", sampled(MAKERS))
def test_nor_is_anything_of_this_package(maker: str, tmp_path: Path) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        MAKERS[maker]().learn(30).save(tmp_path / "m")
    assert messages(caught) == []
