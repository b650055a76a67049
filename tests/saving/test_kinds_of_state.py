"""
In whatever way an environment keeps its state, a run that was interrupted goes on with it, or says at its start what it
cannot hold.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_sample.envs.portable_states import HELPER, pack, unpack
from sb3_sample.saving import vec_envs
from sb3_sample.saving.attributes import DoesNotFit
from tests.sac.common import sac
from tests.saving import kinds
from tests.saving.program import result, run
from tests.saving.test_resume import differing

#: Kinds that are restored, and where: in the training's process, in workers, in supervised workers. What changes
#: classes comes last, so that workers are forked before it does.
RESTORED: dict[str, tuple[str, ...]] = {
    "View": ("dummy", "workers"),
    "TensorView": ("dummy",),
    "SharedByEnvironments": ("dummy",),
    "BoundMethod": ("dummy", "workers"),
    "Partial": ("dummy",),
    "Closure": ("dummy", "workers"),
    "Wrapped": ("dummy",),
    "Physics": ("dummy", "workers"),
    "Slots": ("dummy",),
    "ClassAttributes": ("workers", "dummy"),
    "Globals": ("dummy", "workers", "supervised"),
}
CASES = [(kind, workers) for kind, where in RESTORED.items() for workers in where]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of 48 steps at once, and of 26, which end in the midst of an episode, and the rest in another process."""
    folder = tmp_path_factory.mktemp("runs")
    for part, steps in (("whole", 48), ("parts", 26), ("parts", 48)):
        (folder / part).mkdir(exist_ok=True)
        run(CASES, steps, str(folder / part), target=kinds.train)
    return folder


@pytest.mark.parametrize(("kind", "workers"), CASES)
def test_is_restored(kind: str, workers: str, runs: Path) -> None:
    whole, parts = (result(runs / part / f"{kind}-{workers}") for part in ("whole", "parts"))
    assert whole["said"] == parts["said"] == "[]"
    assert len(whole) > 100
    assert not differing(whole, parts)


#: Kinds that cannot be restored, and what the warning at the start of the training says of them.
NAMED = {
    "ClosureOverIterator": r"ClosureOverIterator: draw \(.*<lambda> with variable numbers: itertools.count\)",
    "PartialOfIterator": r"PartialOfIterator: draw \(functools.partial with arguments: itertools.count\)",
    "IteratorInSlots": r"IteratorInSlots: count \(itertools.count\)",
    "IteratorOfClass": r"IteratorOfClass: ids \(itertools.count\)",
    "Broadcast": r"Broadcast: rows \(an array that shares the memory of another\)",
    "InC": r"InC: error \(builtins.ValueError\)",
}


@pytest.mark.parametrize("workers", ["dummy", "workers"])
@pytest.mark.parametrize("kind", NAMED)
def test_is_named_at_the_start(kind: str, workers: str) -> None:
    venv = kinds.environments(getattr(kinds, kind), workers)
    venv.reset()
    state, missing = vec_envs.save(venv)
    venv.close()
    assert state["environments"] is None and re.search(NAMED[kind], "; ".join(missing)), missing


def test_what_is_named_is_a_warning(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=f"environment cannot be saved.*{NAMED['ClosureOverIterator']}"):
        sac(kinds.environments(kinds.ClosureOverIterator, "dummy")).learn(4, checkpoint=tmp_path)


@pytest.mark.parametrize("workers", ["dummy", "workers"])
def test_an_attribute_that_is_another_function_now(workers: str, tmp_path: Path) -> None:
    """A file does not say what is called, so that the episodes start anew, and it is said, once of all environments."""
    sac(kinds.environments(kinds.ChangesItsMethod, workers)).learn(8, checkpoint=tmp_path)
    match = r"episodes in progress start anew: ChangesItsMethod.mode is .*, but was the function 'ChangesItsMethod.run'"
    with pytest.warns(UserWarning, match=match) as caught:
        sac(kinds.environments(kinds.ChangesItsMethod, workers)).learn(10, checkpoint=tmp_path)
    said = "; ".join(str(warning.message) for warning in caught)
    assert said.count("start anew") == said.count("ChangesItsMethod.run") == 1


def test_constants_of_a_class_are_the_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """What no training has changed is not in a checkpoint, so that it can be changed in the program."""
    env = kinds.Counting()
    env.reset()
    pack(env)
    env.reset()
    state, opaque = pack(env)
    assert not opaque and state["classes"] == {"tests.saving.kinds.Counting": {"n": {"value": 2}}}
    monkeypatch.setattr(kinds.Counting, "limit", 5)
    kinds.Counting.n = 0
    unpack(env, state)
    assert (kinds.Counting.n, kinds.Counting.limit) == (2, 5)


# ---------------------------------------------------------------- hostile states

_SELF = {"function": "Generator.uniform", "holds": {"self": {"value": 3}}}
_RUN = {"function": "BoundMethod.close", "holds": {"self": {"inert": "tests.saving.kinds.BoundMethod"}}}
_TUPLE = {"of": "builtins.tuple", "tuple": []}
_VALUE: dict[str, Any] = {"value": 1}
#: By kind: the attribute that a file sets, or of a function's what it holds there, or of a class' attribute.
HOSTILE: list[tuple[str, tuple[Any, ...], Any]] = [
    *(("BoundMethod", (name,), _VALUE) for name in ("step", "env", "unwrapped", HELPER, "__class__", "a b", "_tick")),
    *(("BoundMethod", ("draw",), node) for node in (_VALUE, _SELF, _RUN, {"id": 5})),
    ("BoundMethod", ("tick",), _RUN),
    ("BoundMethod", ("tick", "holds", "self"), _VALUE),
    ("BoundMethod", ("remember", "holds", "self"), {"id": 999, "dict": [], "of": "builtins.dict"}),
    ("BoundMethod", ("remember", "holds"), {}),
    *(("Partial", ("draw", "holds", where), node) for where, node in (
        ("of", _VALUE), ("arguments", _TUPLE), ("arguments", _VALUE), ("keyword x", _VALUE))),
    ("Partial", ("other", "holds", "keyword high"), _VALUE),
    *(("Closure", ("add", "holds", where), _VALUE) for where in ("variable x", "__code__", "attribute x")),
    ("Closure", ("draw", "holds", "__defaults__"), _TUPLE),
    *(("View", ("position", where), value) for where, value in (
        ("memory", 10**6), ("memory", "a"), ("memory", np.zeros(3)), ("memory", np.zeros(3, np.uint8)),
        ("place", [-8, [2], [8], "<f8"]), ("place", [10**6, [2], [8], "<f8"]), ("place", [0, [2], [10**6], "<f8"]),
        ("place", [0, [10**9], [0], "<f8"]), ("place", [0, [2], [-8], "<f8"]), ("place", [0, [2], [8], "O"]),
        ("place", [0, [2], [8], "<U1"]), ("place", [0, [2.5], [8], "<f8"]), ("place", [0]), ("place", 3),
        ("place", [2**70, [2], [8], "<f8"]), ("place", [0, [1] * 100, [8] * 100, "<f8"]),
        ("place", [0, [2], [8], "zz"]))),
    *(("ClassAttributes", ("classes", cls), {name: node}) for cls, name, node in (
        ("tests.saving.kinds.Curriculum", "number", _VALUE), ("tests.saving.kinds.Curriculum", "__doc__", _VALUE),
        ("tests.saving.kinds.ClassAttributes", "draw", _VALUE), ("tests.saving.kinds.Kind", "metadata", _VALUE),
        ("gymnasium.core.Env", "spec", _VALUE), ("builtins.object", "x", _VALUE), ("x", "y", _VALUE))),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(HOSTILE)))
def test_a_state_that_saving_does_not_write(number: int) -> None:
    kind, path, value = HOSTILE[number]
    env = getattr(kinds, kind)()
    env.reset(seed=1)
    state, opaque = pack(env)
    assert not opaque
    before = {cls: dict(vars(cls)) for cls in type(env).__mro__}
    unpack(env, state)
    at = state if path[0] == "classes" else state["layers"][0]["attributes"]
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    with pytest.raises(DoesNotFit):
        unpack(env, state)
    after = {cls: dict(vars(cls)) for cls in type(env).__mro__}
    assert [set(names) for names in before.values()] == [set(names) for names in after.values()]
    assert env.step.__func__ is vars(kinds.Kind)["step"]
