"""The program of ``benchmarks/gpu_evidence.py``: its table and its exit code, without any training."""

import csv
import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(("codes", "expected"), [((0, 0), 0), ((0, 1), 1), ((-9, 0), 1)])
def test_the_table_is_of_this_call_and_every_failure_is_told(
    codes: tuple[int, ...], expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = importlib.util.spec_from_file_location("gpu_evidence", ROOT / "benchmarks" / "gpu_evidence.py")
    assert spec is not None and spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    ended = iter(codes)

    class Training:
        def __init__(self, command: list[str], env: dict[str, str]):
            for seed in command[command.index("--end") + 3 :]:  # after --end TIME --seeds
                with (tmp_path / f"cheetah-run-{seed}.csv").open("a", newline="") as file:
                    csv.writer(file).writerow(("cheetah-run", seed, 100, "1.00", 5, 1, 10))

        def wait(self) -> int:
            return next(ended)

    monkeypatch.setattr(module.subprocess, "Popen", Training)
    monkeypatch.setattr(sys, "argv", ["gpu_evidence.py", str(tmp_path), "--processes", "2", "--seeds", "0", "1"])
    # Left by a call that was interrupted.
    (tmp_path / "cheetah-run-1.csv").write_text("cheetah-run,1,50,0.00,5,1,10\n")
    (tmp_path / "cheetah-run-7.csv").write_text("cheetah-run,7,50,0.00,5,1,10\n")
    with pytest.raises(SystemExit) as caught:
        module.main()
    assert caught.value.code == expected
    rows = list(csv.DictReader((tmp_path / "cheetah-run.csv").open()))
    assert [(row["seed"], row["step"]) for row in rows] == [("0", "100"), ("1", "100")]
    assert [path.name for path in tmp_path.iterdir()] == ["cheetah-run.csv"]
