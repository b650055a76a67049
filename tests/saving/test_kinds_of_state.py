"""
In whatever way an environment keeps its state, a run that was interrupted goes on with it, or says at its start what it
cannot hold.
"""

from pathlib import Path

import pytest

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
