"""Constructors: one declaration an argument, which the program, its help, type checkers and editors read."""

import inspect
import re
from pathlib import Path
from typing import Any

import pytest
from mypy import api
from stable_baselines3.common.base_class import BaseAlgorithm

import sb3_sample
from sb3_sample import BRO, DAC, MBMAPPO, SAC, BROFast
from sb3_sample.constructor import REQUIRED, _strings_below, argument
from sb3_sample.kinds import integer
from sb3_sample.ppo.arguments import PPOArguments
from sb3_sample.sac.arguments import SACArguments
from tests.sac.common import vec

ROOT = Path(__file__).parents[1]
ALGORITHMS = [
    each
    for name in sb3_sample.__all__
    if isinstance(each := getattr(sb3_sample, name), type) and issubclass(each, BaseAlgorithm)
]


def test_all_algorithms_are_looked_at() -> None:
    assert len(ALGORITHMS) >= 14 and {SAC, BRO, MBMAPPO} <= set(ALGORITHMS)


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_help_shows_every_argument(cls: Any) -> None:
    parameters = inspect.signature(cls).parameters
    assert parameters.keys() == cls.constructor_arguments.keys() and {"policy", "env", "gamma", "seed"} <= set(
        parameters
    )
    shown = re.findall(r"^:param (\w+): (?=\S)", cls.__doc__, re.M)
    assert shown == list(parameters)
    for name, parameter in parameters.items():
        assert parameter.default is cls.constructor_arguments[name].default
        assert parameter.annotation is not parameter.empty


@pytest.mark.parametrize("cls", [*ALGORITHMS, SACArguments, PPOArguments, SACArguments.__base__])
def test_an_editor_shows_the_meaning_beside_every_declaration(cls: Any) -> None:
    """It runs nothing and inherits nothing: below each declaration stands a string."""
    declared = [each.attribute for each in cls.constructor_arguments.values() if each.attribute in cls.__annotations__]
    assert set(declared) <= _strings_below(cls).keys()


def test_the_head_is_stable_baselines3s() -> None:
    import stable_baselines3 as sb3

    for ours, theirs in ((SAC, sb3.SAC), (BRO, sb3.SAC), (MBMAPPO, sb3.PPO)):
        head = [
            name for name, each in inspect.signature(ours).parameters.items() if each.kind is each.POSITIONAL_OR_KEYWORD
        ]
        assert head == list(inspect.signature(theirs).parameters)[: len(head)] and len(head) >= 18


def _mypy(program: str, folder: Path) -> list[str]:
    path = folder / "program.py"
    path.write_text(program)
    out, errors, _ = api.run(["--config-file", str(ROOT / "setup.cfg"), "--no-pretty", str(path)])
    assert not errors, errors
    return out.splitlines()


@pytest.mark.slow
def test_a_type_checker_sees_the_constructor_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names, order, what is by name only and what has a default, without running anything."""
    monkeypatch.chdir(ROOT)  # where the cache of `make lint` is
    names = [cls.__name__ for cls in ALGORITHMS]
    lines = [f"from sb3_sample import {', '.join(names)}", *(f"reveal_type({name}.__init__)" for name in names)]
    revealed = [line for line in _mypy("\n".join(lines), tmp_path) if "Revealed type" in line]
    assert len(revealed) == len(names)
    for cls, line in zip(ALGORITHMS, revealed, strict=True):
        seen = re.findall(r"(?:^|, )(\*|\w+)(?:: [^=]*?(=?))?(?=, |$)", _parameters(line))
        expected: list[tuple[str, str]] = []
        for name, each in inspect.signature(cls).parameters.items():
            if each.kind is each.KEYWORD_ONLY and ("*", "") not in expected:
                expected.append(("*", ""))
            expected.append((name, "" if each.default is each.empty else "="))
        assert seen == [("self", ""), *expected], cls


def _parameters(line: str) -> str:
    """What stands between the parentheses of a revealed function, without what types hold in brackets."""
    text = line[line.index("def (") + 5 : line.rindex(')"')]
    while (shorter := re.sub(r"\[[^\[\]]*\]|\([^()]*\)", "", text)) != text:
        text = shorter
    return text


@pytest.mark.slow
def test_a_type_checker_refuses_what_is_no_argument(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    program = (
        "from sb3_sample import BRO\n"
        'BRO("MlpPolicy", "Pendulum-v1", 1e-3, replay_ratio=2, seed=0).learn(100).policy.actor\n'
        'BRO("MlpPolicy", "Pendulum-v1", no_such=1)\n'
        'BRO("MlpPolicy", "Pendulum-v1", batch_size="many")\n'
    )
    errors = _mypy(program, tmp_path)
    assert [int(line.split(":")[1]) for line in errors if ": error:" in line] == [3, 4], errors
    assert any("no_such" in line for line in errors)


def test_a_name_that_is_none_is_refused_with_the_one_that_was_meant() -> None:
    with pytest.raises(TypeError, match=r"^BRO: .*'replay_ration'\. Did you mean 'replay_ratio'\?"):
        BRO("MlpPolicy", "Pendulum-v1", replay_ration=2)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="^BRO: .*'env'"):
        BRO("MlpPolicy")  # type: ignore[call-arg]


def test_an_argument_of_learn_is_refused_with_its_place() -> None:
    for cls in (BRO, MBMAPPO):
        with pytest.raises(
            TypeError, match=rf"^{cls.__name__}: .*'callback'\. It is passed as learn\(callback=\.\.\.\)$"
        ):
            cls("MlpPolicy", "Pendulum-v1", callback=None)  # type: ignore[call-arg]


def test_an_argument_of_the_policy_is_refused_with_its_place() -> None:
    with pytest.raises(TypeError, match=r"'n_critics'\. It is passed as policy_kwargs=dict\(n_critics=\.\.\.\)$"):
        BRO("MlpPolicy", "Pendulum-v1", n_critics=5)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"'ortho_init'\. It is passed as policy_kwargs=dict\(ortho_init=\.\.\.\)$"):
        MBMAPPO("MlpPolicy", "Pendulum-v1", ortho_init=False)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="'lr_schedule'(?!.*policy_kwargs)"):
        BRO("MlpPolicy", "Pendulum-v1", lr_schedule=None)  # type: ignore[call-arg]


class Frugal(BROFast):
    """BRO Fast, with other numbers, and one of its own."""

    batch_size: int = argument(default=16, kw_only=False)
    learning_starts = 20  # as a plain attribute
    patience: int = argument(default=3, kind=integer(1))
    """steps that it waits"""

    @property
    def tau_of_mine(self) -> float:
        return 0.0


class Counting(DAC):
    def __init__(self, *args: Any, **kwargs: Any):
        self.count = 1
        super().__init__(*args, **kwargs)


class Derived(Counting):
    """Of a class with a constructor of its own."""


def test_classes_of_ones_own() -> None:
    small: Any = {"model_size": None, "policy_kwargs": {"critic_network_kwargs": {"width": 8, "n_blocks": 1}}}
    model = Frugal("MlpPolicy", vec(), buffer_size=100, patience=4, **small)
    assert (model.batch_size, model.learning_starts, model.patience, model.replay_ratio) == (16, 20, 4, 2)
    parameters = inspect.signature(Frugal).parameters
    assert (parameters["batch_size"].default, parameters["learning_starts"].default) == (16, 20)
    assert inspect.signature(BROFast).parameters["batch_size"].default == 128
    for line in ":param patience: steps that it waits", ":param batch_size: transitions":
        assert line in (Frugal.__doc__ or "")
    with pytest.raises(ValueError, match="patience must be an integer of at least 1, not 0"):
        Frugal("MlpPolicy", vec(), buffer_size=100, patience=0, **small)
    assert not hasattr(Frugal, "patience") and not hasattr(SAC, "replay_ratio")
    # What a class's own constructor takes is up to it.
    assert "args" in inspect.signature(Counting).parameters and "args" in inspect.signature(Derived).parameters
    assert Derived("MlpPolicy", vec(), buffer_size=100).count == 1


@pytest.mark.parametrize("base", [SAC, Counting, Derived])
def test_a_declaration_that_no_constructor_takes_is_refused(base: Any) -> None:
    body: dict[str, Any] = {"replay_ratio": argument(default=5), "gamma": 0.9}
    if base is SAC:
        body["__init__"] = Counting.__init__
    author = "Own" if base is SAC else "Counting"
    with pytest.raises(TypeError, match=f"^Own declares replay_ratio, gamma, which __init__ of {author} does not take"):
        type("Own", (base,), body)


def test_a_method_of_an_arguments_name_is_no_default() -> None:
    class Strange(SAC):
        @property
        def tau(self) -> float:  # type: ignore[override]
            return 0.1

    assert inspect.signature(Strange).parameters["tau"].default == 0.005


def _documented(name: str, before: str = "") -> dict[str, Any]:
    """Run the program of docs/parts.md that has a class, on a small environment."""
    text = (ROOT / "docs" / "parts.md").read_text()
    (program,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.S) if f"class {name}(" in block]
    environment = '"dmc/cheetah-run-v0", '
    assert environment in program
    names: dict[str, Any] = {"vec": vec, "__name__": "documentation"}
    exec(before + program.replace(environment, "vec(), buffer_size=100, "), names)
    return names


def test_the_agents_of_the_documentation() -> None:
    model = _documented("REDQ")["model"]
    assert (model.replay_ratio, model.target_subset, model.actor_pessimism, model.critic.n_critics) == (20, 2, 0, 10)
    rule = (
        "from sb3_sample.parts import Pessimism\n\nclass Annealed(Pessimism):\n"
        "    def __init__(self, learner, steps):\n        super().__init__(1.0)\n        self.steps = steps\n"
    )
    names = _documented("AnnealedSAC", rule)
    assert names["model"].pessimism_rule.steps == 50_000
    with pytest.raises(ValueError, match="annealing_steps must be an integer of at least 1, not 0"):
        names["AnnealedSAC"]("MlpPolicy", vec(), buffer_size=100, annealing_steps=0)
    assert ":param annealing_steps:" not in (SAC.__doc__ or "")


def test_another_default_leaves_an_argument_in_its_place() -> None:
    class Small(SAC):
        batch_size: int = argument(default=32)
        gamma: float = argument(default=0.9, kw_only=True)

    parameters = inspect.signature(Small).parameters
    assert parameters["batch_size"].kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
    assert parameters["gamma"].kind is inspect.Parameter.KEYWORD_ONLY
    model = Small("MlpPolicy", vec(), 3e-4, 1000, 100, 7)
    assert (model.batch_size, model.tau, model.gamma) == (7, 0.005, 0.9)


def test_a_required_argument_has_no_default() -> None:
    assert SAC.constructor_arguments["policy"].default is REQUIRED
