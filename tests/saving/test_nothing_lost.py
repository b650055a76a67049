"""
Nothing trained is lost at save: whatever a model consists of, it trains with callbacks that save it, what its files
lack is said once, and it is loaded again.
"""

import functools
import re
import sys
import threading
import types
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sample import MBMAPPO
from sb3_sample.sac import SAC
from sb3_sample.sac.policies import MlpPolicy
from sb3_sample.saving import BadFile
from sb3_sample.saving.classes import may_be_set
from sb3_sample.saving.schedules import ScheduleTable
from tests.ppo.common import tiny
from tests.sac.common import bro, differing, sac, state, taken_or_refused, vec

pytestmark = pytest.mark.filterwarnings("ignore:Evaluation environment is not wrapped", "ignore:Training and eval env")
TRUST = {"trusted_modules": [__name__]}
OBSERVATIONS = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
MAKE: dict[str, Callable[..., Any]] = {"SAC": sac, "BRO": bro, "MBMAPPO": tiny}
#: The same, BRO, the largest of them, with the long tests.
EACH = ["SAC", pytest.param("BRO", marks=pytest.mark.slow), "MBMAPPO"]


class Extractor(BaseFeaturesExtractor):
    """A features extractor of the user's own."""

    def __init__(self, space: spaces.Box, width: int = 4):
        super().__init__(space, width)
        self.net = nn.Linear(3, width)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return self.net(observations).tanh()


class OwnAdam(torch.optim.Adam):
    pass


class OwnActivation(nn.Tanh):
    pass


class OwnPolicy(MlpPolicy):
    pass


class OwnPPOPolicy(ActorCriticPolicy):
    pass


class OwnBuffer(ReplayBuffer):
    """Counts, from a default in the class's body."""

    added = 0
    last: Any = None

    def add(self, *args: Any, **kwargs: Any) -> None:
        self.added += 1
        self.last = {"n": self.added}
        super().add(*args, **kwargs)


class Nested:
    class Activation(nn.ELU):
        pass


class _Private(nn.ReLU):
    pass


class Pink(ActionNoise):
    """Noise with a memory and a generator."""

    scale = 1.0

    def __init__(self, size: int = 2):
        super().__init__()
        self.last, self.generator = np.zeros(size), np.random.default_rng(3)

    def __call__(self) -> np.ndarray:
        self.scale = 0.1
        self.last = 0.9 * self.last + self.scale * self.generator.normal(size=self.last.shape)
        return self.last.astype(np.float32)


class Locked(Pink):
    """Noise that nobody can describe."""

    def __init__(self) -> None:
        super().__init__()
        self.lock = threading.Lock()


class Cosine:
    """A schedule that is an object."""

    def __init__(self, height: float):
        self.height = height

    def __call__(self, progress: float) -> float:
        return self.height * (1 - np.cos(np.pi * progress)) / 2


def linear(start: float) -> Callable[[float], float]:
    """The schedule of Stable-Baselines3's documentation."""

    def rate(progress: float) -> float:
        return start * progress

    return rate


def named_schedule(progress: float) -> float:
    return 1e-3 * progress


def power(progress: float, exponent: float, scale: float) -> float:
    return scale * progress**exponent


def local_class() -> Any:
    class Local(Extractor):
        pass

    return Local


def policy_kwargs(maker: str, **kwargs: Any) -> dict[str, Any]:
    """What a tiny model of the class needs, and more."""
    own = {"actor_network_kwargs": {"width": 8, "n_blocks": 1}} if maker == "BRO" else {"net_arch": [8]}
    return {**own, **kwargs}


def in_main(cls: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The class as if the program that runs had made it."""
    copy = types.new_class("MainClass", (cls,), exec_body=lambda body: body.update(__module__="__main__"))
    monkeypatch.setattr(sys.modules["__main__"], "MainClass", copy, raising=False)
    return copy


class Caught(warnings.catch_warnings):
    """The messages about files, in the order in which they came."""

    def __init__(self) -> None:
        super().__init__(record=True)

    def __enter__(self) -> Any:
        caught = super().__enter__()
        warnings.simplefilter("always")
        return _Messages(caught)


class _Messages:
    def __init__(self, caught: Any):
        self._caught = caught

    def __iter__(self) -> Any:
        return iter([str(w.message) for w in self._caught if "What is saved of this" in str(w.message)])

    def __len__(self) -> int:
        return sum(1 for _ in self)


class FirstStep(BaseCallback):
    """How much was said when the training began."""

    def __init__(self, messages: _Messages):
        super().__init__()
        self.messages, self.n = messages, -1

    def _on_step(self) -> bool:
        self.n = len(self.messages) if self.n < 0 else self.n
        return True


def train(model: Any, folder: Path) -> list[str]:
    """Train with the callbacks that save; what was said of the files, all of it before the first step."""
    with Caught() as messages:
        first = FirstStep(messages)
        model.learn(64 * model.n_envs, [
            first, EvalCallback(vec(), eval_freq=16, n_eval_episodes=1, best_model_save_path=str(folder), verbose=0),
            CheckpointCallback(24, str(folder), save_replay_buffer=True),
        ])  # fmt: skip
        model.save(folder / "m")
        if hasattr(model, "replay_buffer"):
            model.save_replay_buffer(folder / "b")
    assert first.n == len(messages)
    models = {f"rl_model_{steps * model.n_envs}_steps.zip" for steps in (24, 48)}
    assert {"best_model.zip", *models} <= {p.name for p in folder.iterdir()}
    return list(messages)


# ---------------------------------------------------------------- classes


CLASSES: dict[str, tuple[str, dict[str, Any]]] = {
    "extractor": ("Extractor", dict(features_extractor_class=Extractor, features_extractor_kwargs=dict(width=5))),
    "activation": ("OwnActivation", dict(activation_fn=OwnActivation)),
    "nested": ("Nested.Activation", dict(activation_fn=Nested.Activation)),
    "private": ("_Private", dict(activation_fn=_Private)),
    "optimizer": ("OwnAdam", dict(optimizer_class=OwnAdam)),
}  # fmt: skip


@pytest.mark.parametrize("kind", CLASSES)
@pytest.mark.parametrize("maker", EACH)
def test_classes_of_ones_own(maker: str, kind: str, tmp_path: Path) -> None:
    name, kwargs = CLASSES[kind]
    if maker == "BRO" and "activation_fn" in kwargs:
        pytest.skip("BRO's networks have their own")
    kwargs = policy_kwargs(maker, **kwargs)
    model = MAKE[maker](policy_kwargs=kwargs)
    cls, path = type(model), f"{__name__}:{name}"
    messages = train(model, tmp_path)
    assert len(messages) == 1 and path in messages[0]
    assert f"load needs trusted_modules=['{__name__}'] or policy_kwargs=" in messages[0]
    for refused in (tmp_path / "m", tmp_path / "best_model", tmp_path / "rl_model_48_steps"):
        with pytest.raises(
            BadFile, match=rf"policy_kwargs\..*{name}.*trusted_modules=\['{__name__}'\] or policy_kwargs="
        ):
            cls.load(refused)
    for loaded in (cls.load(tmp_path / "m", env=vec(), **TRUST), cls.load(tmp_path / "m", vec(), policy_kwargs=kwargs)):
        assert not differing(state(model), state(loaded))
        assert loaded.policy_kwargs == kwargs
        loaded.learn(32)


@pytest.mark.parametrize("maker", EACH)
def test_classes_of_the_program_itself_and_of_a_function(
    maker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model: Any
    for n, extractor in enumerate((in_main(Extractor, monkeypatch), local_class())):
        kwargs = policy_kwargs(maker, features_extractor_class=extractor)
        model = MAKE[maker](policy_kwargs=kwargs)
        (folder := tmp_path / str(n)).mkdir()
        (message,) = train(model, folder)
        assert "__main__:MainClass" in message if n == 0 else "local_class.<locals>.Local" in message
        # A script's name leads other programs to themselves: trust would not help there, and is not offered.
        assert "load needs policy_kwargs=" in message
        with pytest.raises(BadFile, match="load needs policy_kwargs="):
            type(model).load(folder / "m")
        # Where the class has another name by now, too.
        for given in (extractor, Extractor):
            loaded = type(model).load(folder / "m", policy_kwargs={**kwargs, "features_extractor_class": given})
            assert not differing(state(model), state(loaded))
            assert any(type(module) is given for module in loaded.policy.modules())
        custom = type(model).load(folder / "m", custom_objects={"policy_kwargs": kwargs})
        assert not differing(state(model), state(custom))
        if n == 0:
            type(model).load(folder / "m", trusted_modules=["__main__"])
        with pytest.raises(BadFile, match="local_class.<locals>.Local|MainClass"):
            type(model).load(folder / "m", trusted_modules=[__name__] if n else ["main"])


def test_policy_kwargs_given_must_be_the_files_where_that_can_be_said(tmp_path: Path) -> None:
    kwargs = dict(
        net_arch=[8], features_extractor_class=Extractor, activation_fn=nn.Tanh, optimizer_kwargs=dict(eps=0.1)
    )
    sac(policy_kwargs=kwargs).save(tmp_path / "m", **TRUST)
    for change in (
        dict(activation_fn=nn.ReLU), dict(net_arch=[8, 8]), dict(net_arch=8), dict(optimizer_kwargs=dict(eps=0.2)),
        dict(optimizer_kwargs=dict(eps=0.1, betas=(0.1, 0.2))), dict(n_critics=3),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="policy_kwargs must be those of the file"):
            SAC.load(tmp_path / "m", policy_kwargs={**kwargs, **change})


@pytest.mark.parametrize("maker", MAKE)
def test_a_policy_class_of_ones_own(maker: str, tmp_path: Path) -> None:
    policy = OwnPPOPolicy if maker == "MBMAPPO" else OwnPolicy
    model = MAKE[maker](policy=policy)
    (message,) = train(model, tmp_path)
    assert f"policy_class is {__name__}:{policy.__name__}, for which load needs trusted_modules=" in message
    with pytest.raises(BadFile, match=r"load needs trusted_modules=\[.*\] or policy="):
        type(model).load(tmp_path / "m")
    given: list[dict[str, Any]] = [
        TRUST, {"policy": policy}, {"policy_class": policy}, {"custom_objects": {"policy_class": policy}},
    ]  # fmt: skip
    for kwargs in given:
        loaded = type(model).load(tmp_path / "m", **kwargs)
        assert type(loaded.policy) is policy and not differing(state(model), state(loaded))
    with pytest.raises(ValueError, match="policy must be one of .* or a policy class derived from .*, not 'Nothing'"):
        type(model).load(tmp_path / "m", policy="Nothing")


@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_a_replay_buffer_of_ones_own(maker: str, tmp_path: Path) -> None:
    model = MAKE[maker](replay_buffer_class=OwnBuffer)
    (message,) = train(model, tmp_path)
    assert f"replay_buffer is {__name__}:OwnBuffer, for which load_replay_buffer needs trusted_modules=" in message
    with pytest.raises(BadFile, match="replay_buffer_class=$"):
        type(model).load(tmp_path / "m")
    trusting = type(model).load(tmp_path / "m", env=vec(), **TRUST)
    trusting.load_replay_buffer(tmp_path / "b")  # trust is said once
    trusting.set_parameters(tmp_path / "m")
    given = type(model).load(tmp_path / "m", env=vec(), replay_buffer_class=OwnBuffer)
    given.load_replay_buffer(tmp_path / "b")
    with pytest.raises(BadFile, match="OwnBuffer.*load_replay_buffer needs trusted_modules=.* or a model that has it"):
        MAKE[maker]().load_replay_buffer(tmp_path / "b")
    for loaded in (trusting, given):
        assert loaded.replay_buffer.added == 64 and loaded.replay_buffer.last == {"n": 64}
        assert not differing(state(model), state(loaded))
        np.testing.assert_array_equal(loaded.replay_buffer.actions, model.replay_buffer.actions)
        loaded.learn(5)


def test_a_replay_buffer_class_of_a_function(tmp_path: Path) -> None:
    class Local(OwnBuffer):
        pass

    model = sac(replay_buffer_class=Local)
    (message,) = train(model, tmp_path)
    assert "load_replay_buffer needs a model that has it as its replay_buffer_class" in message
    with pytest.raises(BadFile, match="was made inside of a function.*load_replay_buffer needs a model that has it"):
        sac().load_replay_buffer(tmp_path / "b", **TRUST)
    loaded = SAC.load(tmp_path / "m", env=vec(), replay_buffer_class=Local)
    loaded.load_replay_buffer(tmp_path / "b")
    assert type(loaded.replay_buffer) is Local and loaded.replay_buffer.added == 64


def test_what_a_replay_buffer_cannot_hold(tmp_path: Path) -> None:
    model = sac(replay_buffer_class=OwnBuffer).learn(12)
    model.replay_buffer.lock = threading.Lock()
    model.replay_buffer.size = lambda: 12
    with pytest.warns(UserWarning, match="replay_buffer.lock is left out .*; replay_buffer.size is left out"):
        model.save_replay_buffer(tmp_path / "b", **TRUST)
    other = sac(replay_buffer_class=OwnBuffer)
    with pytest.raises(BadFile, match="replay_buffer.lock was left out"):
        other.load_replay_buffer(tmp_path / "b", **TRUST)
    other.replay_buffer.lock = lock = threading.Lock()
    other.load_replay_buffer(tmp_path / "b", **TRUST)
    assert other.replay_buffer.lock is lock and other.replay_buffer.size() == 12


# ---------------------------------------------------------------- schedules


def steps(progress: float) -> float:
    return 1e-3 if progress > 1 / 3 else 1e-4


SCHEDULES: dict[str, Callable[[], Any]] = {
    "closure": lambda: linear(1e-3), "lambda": lambda: lambda progress: 3e-4 * progress + 1e-5,
    "partial": lambda: functools.partial(power, exponent=0.5, scale=1e-3), "method": lambda: Cosine(1e-3).__call__,
    "steps": lambda: lambda progress: steps(progress), "kink": lambda: lambda p: 1e-3 * min(1.0, p / 0.123456),
    "constant": lambda: lambda progress: 0.0, "local class": lambda: type("Local", (Cosine,), {
        "__qualname__": "f.<locals>.Local"})(1e-3),
    "numpy": lambda: lambda progress: np.float32(1e-3) * progress, "tensor": lambda: lambda p: torch.tensor(1e-3) * p,
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *(
            pytest.param(kind, "learning_rate", marks=[] if kind in ("closure", "method", "kink") else pytest.mark.slow)
            for kind in SCHEDULES
        ),
        ("closure", "clip_range"),
        ("steps", "clip_range_vf"),
    ],
)
def test_a_schedule_without_a_name_is_a_table(kind: str, name: str, tmp_path: Path) -> None:
    schedule = SCHEDULES[kind]()
    for make in (sac, tiny) if kind == "closure" else (sac if name == "learning_rate" else tiny,):
        if make is sac and name != "learning_rate":
            continue
        model = make(**{name: schedule})
        assert (train if kind == "closure" else train_quietly)(model, tmp_path) == []
        loaded = type(model).load(tmp_path / "m", env=vec())
        ours = loaded.lr_schedule if name == "learning_rate" else getattr(loaded, name)
        for progress in (*np.linspace(0, 1, 997), 1 / 3, np.nextafter(1 / 3, 1), 0.123456):
            assert ours(progress) == pytest.approx(float(schedule(progress)), rel=1e-4, abs=1e-9), progress
        assert ours(1.5) == ours(1) and ours(-0.1) == ours(0)
        loaded.learn(32)
        # And once more, without any loss.
        loaded.save(tmp_path / "again")
        again = type(model).load(tmp_path / "again")
        again = again.lr_schedule if name == "learning_rate" else getattr(again, name)
        assert all(again(progress) == ours(progress) for progress in np.linspace(0, 1, 97))


def test_tables_are_small() -> None:
    assert len(ScheduleTable.of(linear(1e-3)).table[0]) == 1001
    assert len(ScheduleTable.of(steps).table[0]) < 1100
    assert len(ScheduleTable.of(lambda p: hash(str(p)) % 1000).table[0]) <= 20_001


@pytest.mark.parametrize("make", [sac, tiny])
def test_a_schedule_with_a_name(make: Any, tmp_path: Path) -> None:
    for schedule, path in ((named_schedule, "named_schedule"), (Cosine(1e-3), "Cosine")):
        model = make(learning_rate=schedule)
        (message,) = train(model, tmp_path)
        assert f"learning_rate is {__name__}:{path}, for which load needs trusted_modules=" in message
        with pytest.raises(
            BadFile, match=rf"learning_rate: .*{path}.*trusted_modules=\['{__name__}'\] or learning_rate="
        ):
            type(model).load(tmp_path / "m")
        loaded = type(model).load(tmp_path / "m", **TRUST)
        assert loaded.lr_schedule(0.3) == schedule(0.3) and type(loaded.learning_rate) is type(schedule)
        given = type(model).load(tmp_path / "m", learning_rate=linear(2.0))
        assert given.lr_schedule(0.25) == 0.5 and not differing(
            {k: v for k, v in state(given).items() if not k.endswith("/lr")},
            {k: v for k, v in state(model).items() if not k.endswith("/lr")},
        )


def test_a_schedule_that_has_no_table(tmp_path: Path) -> None:
    def undefined_somewhere(progress: float) -> float:
        return 1e-4 * progress / (progress - 0.001)

    model = sac(learning_rate=undefined_somewhere)
    (message,) = train(model, tmp_path)
    assert "learning_rate is left out (no table" in message and "ZeroDivisionError" in message
    with pytest.warns(UserWarning, match="was saved without learning_rate .*the model has its defaults there"):
        assert SAC.load(tmp_path / "m").lr_schedule(1) == 3e-4


# ---------------------------------------------------------------- objects


@pytest.mark.parametrize(("maker", "n_envs"), [("SAC", 3), ("BRO", 1)])
def test_action_noise_of_ones_own(maker: str, n_envs: int, tmp_path: Path) -> None:
    model = MAKE[maker](vec(n_envs), action_noise=Pink())
    (message,) = train(model, tmp_path)
    assert f"{__name__}:Pink" in message and "or action_noise=" in message
    with pytest.raises(BadFile, match=rf"action_noise.*Pink.*trusted_modules=\['{__name__}'\] or action_noise="):
        type(model).load(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m", env=vec(n_envs), **TRUST)
    for _ in range(3):
        np.testing.assert_array_equal(loaded.action_noise(), model.action_noise())
    noise = Pink()
    given = type(model).load(tmp_path / "m", env=vec(n_envs), action_noise=noise)
    assert given.action_noise is noise
    given.learn(20)


def test_noise_that_nobody_can_describe(tmp_path: Path) -> None:
    model = sac(action_noise=Locked())
    (message,) = train(model, tmp_path)
    assert "action_noise is left out" in message and "lock: an object of _thread.lock" in message
    assert "load needs action_noise=" in message
    with pytest.warns(UserWarning, match="m.zip was saved without action_noise .*_thread.lock"):
        assert SAC.load(tmp_path / "m").action_noise is None
    noise = Locked()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert SAC.load(tmp_path / "m", action_noise=noise).action_noise is noise


def test_an_argument_of_the_networks_that_no_file_can_hold(tmp_path: Path) -> None:
    """A default in its place would be another network, without a word."""
    kwargs = dict(net_arch=[8], activation_fn=functools.partial(nn.LeakyReLU, 0.3))
    model = sac(policy_kwargs=kwargs)
    (message,) = train(model, tmp_path)
    assert "policy_kwargs is left out (policy_kwargs.activation_fn: an object of functools.partial" in message
    with pytest.raises(BadFile, match="policy_kwargs was left out .*, so that load needs policy_kwargs="):
        SAC.load(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", policy_kwargs=kwargs)
    np.testing.assert_array_equal(
        loaded.predict(OBSERVATIONS, deterministic=True)[0], model.predict(OBSERVATIONS, deterministic=True)[0]
    )


class Tracker:
    def __init__(self, n: int):
        self.n, self.seen = n, {"best": -np.inf, "all": [0.5] * 40}


def test_attributes_hung_on_a_model(tmp_path: Path) -> None:
    model = sac()
    model.note, model.lock, model.predict = lambda: None, threading.Lock(), lambda *args: 3
    model.tracker, model.numbers, model.place = Tracker(4), [*range(50)], Path("a")
    (message,) = train_quietly(model, tmp_path)
    for name in ("note", "lock", "predict"):
        assert f"{name} is left out" in message
    assert f"tracker is {__name__}:Tracker, for which load needs trusted_modules=" in message
    with pytest.raises(BadFile, match=r"tracker: .*or custom_objects=\{'tracker': \.\.\.\}"):
        SAC.load(tmp_path / "m")
    with pytest.warns(UserWarning, match="without note .*, lock .*, predict"):
        loaded = SAC.load(tmp_path / "m", **TRUST)
    assert vars(loaded.tracker) == vars(model.tracker) and loaded.numbers == model.numbers and loaded.place == Path("a")
    assert not hasattr(loaded, "note") and loaded.predict(OBSERVATIONS)[0].shape == (5, 2)
    with pytest.warns(UserWarning, match="without note"):
        assert SAC.load(tmp_path / "m", custom_objects={"tracker": None}).tracker is None


def train_quietly(model: Any, folder: Path) -> list[str]:
    with Caught() as messages:
        model.learn(32)
        model.save(folder / "m")
    return list(messages)


def test_it_is_said_once(tmp_path: Path) -> None:
    model = sac(action_noise=Pink())
    with Caught() as messages:
        for _ in range(2):
            model.save(tmp_path / "m")
            assert len(messages) == 1
        model.learn(12)
        model.learn(12)
        assert len(messages) == 1
        # What is new is said, and nothing else.
        model.note = threading.Lock()
        for _ in range(2):
            model.save(tmp_path / "m")
        assert [("Pink" in text, "note" in text) for text in messages] == [(True, False), (False, True)]
        # Nobody needs to be told what they say themselves.
        sac(action_noise=Pink()).save(tmp_path / "m", **TRUST)
        SAC.load(tmp_path / "m", env=vec(), **TRUST).learn(5)
        assert len(messages) == 2


def test_trust_never_comes_from_a_file(tmp_path: Path) -> None:
    model = sac(replay_buffer_class=OwnBuffer)
    model._trusted_modules = (__name__,)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.save(tmp_path / "m", include=["_trusted_modules", "_told"])
        model.save(tmp_path / "pickled", allow_pickle=True)
    with pytest.warns(UserWarning, match="without _trusted_modules"):
        loaded = SAC.load(tmp_path / "m", replay_buffer_class=OwnBuffer)
    assert loaded._trusted_modules == ()
    assert SAC.load(tmp_path / "pickled", allow_pickle=True)._trusted_modules == ()


def test_a_state_too_large_for_a_files_json_is_left_out(tmp_path: Path) -> None:
    model = sac()
    model.visits = {str(i): i for i in range(500_000)}
    model.returns = [0.1 * i for i in range(10**6)]
    with pytest.warns(UserWarning, match="visits is left out .it takes .* bytes of JSON"):
        model.save(tmp_path / "m")
    with pytest.warns(UserWarning, match="without visits"):
        assert SAC.load(tmp_path / "m").returns == model.returns


class OddState(nn.Linear):
    """A layer that keeps an object of its own."""

    def get_extra_state(self) -> Any:
        return {"lock": threading.Lock()}

    def set_extra_state(self, state: Any) -> None:
        pass


def test_a_part_of_a_state_that_no_file_can_hold(tmp_path: Path) -> None:
    model = sac()
    model.policy.odd = OddState(2, 2)
    with pytest.warns(UserWarning, match="policy.odd._extra_state is left out"):
        model.save(tmp_path / "m")
    other = sac(seed=1)
    other.policy.odd = OddState(2, 2)
    other.set_parameters(tmp_path / "m")
    for key, value in model.policy.state_dict().items():
        assert not isinstance(value, torch.Tensor) or torch.equal(value, other.policy.state_dict()[key])


class WithVariable(SAC):
    """Learns a tensor that is no module's, as Stable-Baselines3's own algorithms do."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self.log_x = torch.zeros(2, requires_grad=True)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return names, [*variables, "log_x"]


def test_tensors_that_are_parameters_without_a_module(tmp_path: Path) -> None:
    model = sac(cls=WithVariable)
    model.log_x.data.fill_(3.0)
    assert train(model, tmp_path) == []
    loaded = WithVariable.load(tmp_path / "m")
    assert loaded.log_x.tolist() == [3, 3] and loaded.log_x.requires_grad
    model.log_x.data[0] = np.nan
    with pytest.raises(ValueError, match="log_x cannot be saved, since it holds 1 numbers that are not finite"):
        model.save(tmp_path / "m")


class WithNetwork(SAC):
    """Learns a network that it names nowhere."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self.extra = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))
        self.extra_optimizer = torch.optim.Adam(self.extra.parameters(), lr=1e-2)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        super().train(gradient_steps, batch_size)
        self.extra_optimizer.zero_grad()
        self.extra(torch.randn(8, 3)).square().sum().backward()
        self.extra_optimizer.step()


def test_networks_and_optimizers_of_a_subclass(tmp_path: Path) -> None:
    model = sac(cls=WithNetwork)
    assert train(model, tmp_path) == []
    loaded = WithNetwork.load(tmp_path / "m", env=vec())
    for name in ("extra", "extra_optimizer"):
        own, other = getattr(model, name).state_dict(), getattr(loaded, name).state_dict()
        assert repr(own) == repr(other) and len(own) > 1
    assert loaded.extra_optimizer.param_groups[0]["params"][0] is loaded.extra[0].weight
    loaded.learn(20)
    with pytest.warns(
        UserWarning, match="without extra .a state of something that this model has not.*extra_optimizer"
    ):
        SAC.load(tmp_path / "m")
    # And with checkpoints, bit by bit.
    whole = sac(cls=WithNetwork).learn(96)
    again = interrupted(lambda: sac(cls=WithNetwork), tmp_path / "run")
    assert not differing(state(whole), state(again))
    assert repr(whole.extra_optimizer.state_dict()) == repr(again.extra_optimizer.state_dict())
    model.extra[0].weight.data[0, 0] = np.nan
    with pytest.raises(
        ValueError, match=r"extra.0.weight cannot be saved, since it holds 1 numbers that are not finite"
    ):
        model.save(tmp_path / "m")


# ---------------------------------------------------------------- what save accepts, load takes


class Counting(SAC):
    """Python's habit of defaults in the class's body, of many kinds."""

    rounds, best, label, shape, table, moment = 0, -np.inf, None, (1,), {}, None
    kind: Any = 0
    phase: Any = "first"

    def __init__(self, *args: Any, ema: float = 0.0, **kwargs: Any):
        self.ema: Any = ema
        super().__init__(*args, **kwargs)

    @property
    def twice(self) -> int:
        return 2 * self.rounds

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        self.rounds += 1
        self.best = max(self.best, float(self.rounds))
        self.label, self.shape, self.table = "x", (self.rounds, 2), {"n": [self.rounds]}
        # Other kinds than those of the defaults.
        self.kind, self.phase = np.arange(3), {"now": 1}
        self.ema = 0.9 * self.ema + 0.1 * torch.tensor(1.0)
        self.moment = torch.ones(2)
        super().train(gradient_steps, batch_size)


def test_defaults_of_a_subclass_changed_on_the_object(tmp_path: Path) -> None:
    model = sac(cls=Counting)
    assert train(model, tmp_path) == []
    loaded = Counting.load(tmp_path / "m", env=vec())
    for name in ("rounds", "best", "label", "shape", "table", "phase"):
        assert getattr(loaded, name) == getattr(model, name) != getattr(Counting, name), name
    assert loaded.kind.tolist() == [0, 1, 2] and torch.equal(loaded.moment, torch.ones(2))
    assert loaded.ema == model.ema and loaded.twice == 2 * model.rounds
    # A base in the same family knows nothing of them, and keeps them.
    assert vars(SAC.load(tmp_path / "m"))["rounds"] == model.rounds
    loaded.learn(20)


def test_a_default_of_this_packages_classes_changed_on_the_object(tmp_path: Path) -> None:
    for make in (sac, bro):
        model = make()
        model.temperature_beta1 = 0.25
        model.save(tmp_path / "m")
        loaded = type(model).load(tmp_path / "m", env=vec())
        assert loaded.temperature_beta1 == 0.25
        assert loaded.temperature_optimizer.param_groups[0]["betas"][0] == 0.25


def test_a_subclass_that_has_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trained as a script, loaded by another program."""
    model = sac(cls=in_main(Counting, monkeypatch)).learn(20)
    model.save(tmp_path / "m")
    assert Counting.load(tmp_path / "m").rounds == model.rounds
    with pytest.raises(BadFile, match="holds a model of __main__:MainClass"):
        MBMAPPO.load(tmp_path / "m")


NEEDED = {"policy_class": "policy=", "observation_space": "env=", "action_space": "env="}


@pytest.mark.slow
@pytest.mark.parametrize("maker", EACH)
def test_any_attribute_can_be_left_out(maker: str, tmp_path: Path) -> None:
    """With the default in its place, or, where there is none, what to pass instead."""
    model = MAKE[maker](n_steps=16) if maker == "MBMAPPO" else MAKE[maker]()
    cls = type(model.learn(32))
    model.save(tmp_path / "m")
    for name in [*vars(model), "nothing"]:
        model.save(tmp_path / "m", exclude=[name])
        for env in (None, vec()) if name in NEEDED else (None,):
            load = functools.partial(cls.load, tmp_path / "m", env=env, device="cpu")
            words = NEEDED.get(name, f"lacks {name}, for which the defaults stand (load takes {name}=)")
            loaded = taken_or_refused(load, re.escape(words))
            if loaded is None and name not in ("_has_named_policy", *NEEDED):
                loaded = load(**{name: getattr(model, name)})
            assert (loaded is not None) == (name != "policy_class" and (name not in NEEDED or env is not None)), name
            if loaded is not None:
                assert not differing(state(model), state(loaded)), name
                assert loaded.predict(OBSERVATIONS)[0].shape == (5, 2)


def test_load_with_what_is_missing(tmp_path: Path) -> None:
    model = sac()
    model.save(tmp_path / "m", exclude=["policy_class", "policy_kwargs", "verbose", "observation_space"])
    with pytest.raises(BadFile, match="m.zip lacks policy_class: pass policy= to load"):
        SAC.load(tmp_path / "m")
    with pytest.raises(BadFile, match="m.zip lacks observation_space: pass env= to load"):
        SAC.load(tmp_path / "m", policy="MlpPolicy")
    with pytest.raises(
        ValueError, match=r"m.zip lacks policy_kwargs, verbose, .*load takes policy_kwargs= or verbose="
    ):
        SAC.load(tmp_path / "m", policy="MlpPolicy", env=vec())
    loaded = SAC.load(tmp_path / "m", policy="MlpPolicy", env=vec(), policy_kwargs={"net_arch": [8, 8]}, verbose=0)
    assert not differing(state(model), state(loaded))


@pytest.mark.parametrize("maker", EACH)
def test_include(maker: str, tmp_path: Path) -> None:
    model = MAKE[maker]().learn(32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in {*model._excluded_save_params(), "nothing"}:
            model.save(tmp_path / "m", include=[name])
            loaded = type(model).load(tmp_path / "m", env=vec())
            assert not differing(state(model), state(loaded)), name
            loaded.learn(16)
    if maker == "SAC":
        model._metrics = {"x": torch.tensor(2.0)}
        model.save(tmp_path / "m", include=["_metrics"])
        assert SAC.load(tmp_path / "m")._metrics["x"] == 2
    with pytest.warns(UserWarning, match="env is left out .it belongs to the program"):
        MAKE[maker]().save(tmp_path / "m", include=["env"])


def test_paths_are_held(tmp_path: Path) -> None:
    model = sac(tensorboard_log=tmp_path / "log", replay_buffer_kwargs={"memory_map": tmp_path / "rows"})
    model.save(tmp_path / "m")
    (tmp_path / "rows").rmdir()
    loaded = SAC.load(tmp_path / "m")
    assert loaded.tensorboard_log == tmp_path / "log" and not (tmp_path / "rows").exists()


def test_numbers_of_networks_beyond_what_a_file_may_ask_for(tmp_path: Path) -> None:
    kwargs = dict(net_arch=[8], features_extractor_class=Extractor, features_extractor_kwargs=dict(width=4))
    model = sac(policy_kwargs=kwargs)
    model.policy_kwargs = {**kwargs, "actor_kwargs": {"seed": 10**8}}
    model.save(tmp_path / "m", **TRUST)
    with pytest.raises(BadFile, match="actor_kwargs.seed holds 100000000, .* pass policy_kwargs= to load"):
        SAC.load(tmp_path / "m", **TRUST)


@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        ("rounds", True), ("best", True), ("table", True), ("new", True), ("temperature_beta1", True), ("_new", True),
        ("train", False), ("twice", False), ("load", False), ("logger", False), ("__class__", False), ("a.b", False),
        ("_setup_model", False), ("__dict__", False), ("_abc_impl", True), ("", False), ("_wrap_env", False),
    ],
)  # fmt: skip
def test_what_a_file_may_set(name: str, allowed: bool) -> None:
    assert may_be_set(Counting, name) is allowed


# ---------------------------------------------------------------- checkpoints


class Stop(BaseCallback):
    def __init__(self, at: int):
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            raise KeyboardInterrupt
        return True


def interrupted(make: Callable[[], Any], folder: Path) -> Any:
    """A run that is cut in its midst and goes on."""
    with pytest.raises(KeyboardInterrupt):
        make().learn(96, Stop(70), checkpoint=folder, checkpoint_freq=16)
    return make().learn(96, checkpoint=folder, checkpoint_freq=16)


CHECKPOINTED: dict[str, Callable[[], dict[str, Any]]] = {
    "closure": lambda: dict(learning_rate=linear(1e-3)), "object": lambda: dict(learning_rate=Cosine(1e-3)),
    "named": lambda: dict(learning_rate=named_schedule),
    "partial": lambda: dict(learning_rate=functools.partial(power, exponent=2, scale=1e-2)),
    "local class": lambda: dict(policy_kwargs=policy_kwargs("SAC", features_extractor_class=local_class())),
    "lambda": lambda: dict(policy_kwargs=policy_kwargs("SAC", activation_fn=lambda: nn.ELU())),
    "partial class": lambda: dict(policy_kwargs=policy_kwargs("SAC", activation_fn=functools.partial(nn.ELU, 0.5))),
}  # fmt: skip


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        pytest.param(sac, kind, marks=[pytest.mark.slow] * (kind not in ("closure", "partial", "local class")))
        for kind in CHECKPOINTED
    ]
    + [(tiny, "closure"), pytest.param(tiny, "local class", marks=pytest.mark.slow)],
)
def test_a_run_with_what_the_program_passes_anew_goes_on_bit_by_bit(make: Any, kind: str, tmp_path: Path) -> None:
    whole = make(**CHECKPOINTED[kind]()).learn(96)
    again = interrupted(lambda: make(**CHECKPOINTED[kind]()), tmp_path)
    assert not differing(state(whole), state(again))


def test_clip_ranges_go_on_as_well(tmp_path: Path) -> None:
    whole = tiny(clip_range=linear(0.3)).learn(96)
    assert not differing(state(whole), state(interrupted(lambda: tiny(clip_range=linear(0.3)), tmp_path)))


@pytest.mark.parametrize("n_envs", [1, 2])
def test_own_noise_goes_on_bit_by_bit(n_envs: int, tmp_path: Path) -> None:
    whole = sac(vec(n_envs), action_noise=Pink()).learn(96)
    again = interrupted(lambda: sac(vec(n_envs), action_noise=Pink()), tmp_path)
    assert not differing(state(whole), state(again))
    np.testing.assert_array_equal(whole.replay_buffer.actions, again.replay_buffer.actions)


class Unseeded(Pink):
    def __init__(self) -> None:
        super().__init__()
        self.generator = np.random.default_rng()


def test_own_noise_without_a_seed_is_not_another_run(tmp_path: Path) -> None:
    assert interrupted(lambda: sac(action_noise=Unseeded()), tmp_path).num_timesteps == 96


def test_a_class_of_several_objects_is_named_once() -> None:
    with pytest.warns(UserWarning, match="What is saved of this SAC") as caught:
        sac(vec(3), action_noise=VectorizedActionNoise(Pink(), 3)).learn(3)
    (said,) = (text for text in (str(warning.message) for warning in caught) if "is saved of" in text)
    assert said.count(f"{__name__}:Pink") == said.count("load needs") == 1


def test_another_schedule_is_another_run(tmp_path: Path) -> None:
    sac(learning_rate=linear(1e-3)).learn(12, checkpoint=tmp_path)
    with pytest.raises(ValueError, match=r"learning_rate=ScheduleTable\(1: 0.002, .*was made with .*\(1: 0.001, "):
        sac(learning_rate=linear(2e-3)).learn(24, checkpoint=tmp_path)
    with pytest.raises(ValueError, match="action_noise="):
        sac(learning_rate=linear(1e-3), action_noise=Pink()).learn(24, checkpoint=tmp_path)
    # The same values, however they are computed.
    sac(learning_rate=lambda progress: 1e-3 * progress).learn(24, checkpoint=tmp_path)


def test_only_what_neither_program_nor_file_can_give_is_refused_before_the_first_step(tmp_path: Path) -> None:
    model = sac(action_noise=Locked())
    with pytest.raises(ValueError, match=r"attributes that a checkpoint cannot hold: action_noise .*_thread.lock"):
        model.learn(20, checkpoint=tmp_path / "a")
    assert model.num_timesteps == 0 and not list((tmp_path / "a").glob("checkpoint-*"))

    class Strange(BaseCallback):
        """Gives the model what no file holds, in the midst of the training."""

        def _on_step(self) -> bool:
            self.model.thing = iter([1]) if self.num_timesteps == 15 else None
            return True

    model = sac()
    model.thing = None
    with pytest.warns(UserWarning, match="No checkpoint at 15 steps.*thing .builtins.list_iterator"):
        model.learn(30, Strange(), checkpoint=tmp_path / "b", checkpoint_freq=15)
    assert model.num_timesteps == 30 and (tmp_path / "b" / "checkpoint-000000000030").is_dir()


def test_the_model_of_a_checkpoint_is_loaded_by_itself(tmp_path: Path) -> None:
    model = sac(learning_rate=linear(1e-3), action_noise=Pink()).learn(20, checkpoint=tmp_path)
    file = tmp_path / "checkpoint-000000000020" / "model.zip"
    with pytest.raises(BadFile, match="action_noise"):
        SAC.load(file)
    for loaded in (SAC.load(file, **TRUST), SAC.load(file, action_noise=None)):
        assert [name for name in differing(state(loaded), state(model)) if not name.endswith("/lr")] == []
