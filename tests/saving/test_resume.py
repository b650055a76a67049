"""A run that is killed and started again is the run that was never killed, bit by bit."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.agents import OFF_POLICY
from tests.sac.common import PIXEL_MAKERS, sampled
from tests.saving.program import PPOS, result, run

N = 96
DUMMY4: dict[str, Any] = {"n": 4}
WORKERS4: dict[str, Any] = {"n": 4, "workers": True}
NORMALIZED: dict[str, Any] = {"n": 2, "wrap": "normalize"}

#: By name: the algorithm, its arguments and its environment.
FAST: dict[str, dict[str, Any]] = {
    "BRO": {"algorithm": "BRO", "kwargs": {"resets": (40, 120)}, "evaluate": True, "diagnose": True},
    "MBMA": {"algorithm": "MBMA"},
}
SLOW: dict[str, dict[str, Any]] = {
    "VPLSAC, workers": {"algorithm": "VPLSAC", "kwargs": {"reset_gradient_steps": 43}, "env": WORKERS4},
    **{name: {"algorithm": name} for name in (
        "SAC", "BROFast", "BROTD3", "DAC", "SRSAC", "OAC", "TOPSAC", "GPLSAC", "OPLSAC", "RegularizedSAC", "SimBa",
        "SimbaV2", "BRC", "DebiasedRQ", "CrossQ", "CrossQ+WN", "XQC", "FlashSAC", "QMA", "MBPO", "rewound",
    )},
    **{f"{name}, workers": {"algorithm": name, "env": WORKERS4} for name in ("BRO", "OPLSAC", "MBMA", "QMA", "MBPO")},
    **{f"{name}, {env}": {"algorithm": name, "env": {"env": env}} for name in ("BRO", "MBMA")
       for env in ("dmc/cartpole-swingup-v0", "metaworld/push-v3", "Hopper-v5")},
    **{f"SAC, workers, {env}": {"algorithm": "SAC", "env": {"env": env, **WORKERS4}}
       for env in ("dmc/reacher-easy-v0", "metaworld/pick-place-v3", "Ant-v5")},
    "SRSPR": {"algorithm": "SRSPR", "env": {"env": "stacks"}, "kwargs": {"reset_interval": 50}},
    "SRSPR, ring, workers": {"algorithm": "SRSPR", "env": {"env": "stacks", **WORKERS4}, "kwargs": {
        "network": "bronet", "noisy": True, "buffer_size": 70, "replay_ratio": 0.7}},
    "SRSPR, ALE/Pong-v5": {"algorithm": "SRSPR", "env": {"env": "ALE/Pong-v5"}},
    "DrQ": {"algorithm": "DrQ", "env": {"env": "frames"}, "kwargs": {"resets": 40, "resets_keep": ("encoder",)}},
    "DrQv2, ring, workers": {"algorithm": "DrQv2", "env": {"env": "frames", **WORKERS4}, "kwargs": {"buffer_size": 70}},
    "workers by forkserver": {"algorithm": "SAC", "env": {"n": 2, "workers": "forkserver"}},
    "normalized": {"algorithm": "SAC", "env": NORMALIZED, "evaluate": True},
    "normalized, PPO": {"algorithm": "MBMA", "env": NORMALIZED, "evaluate": True},
    "stacked": {"algorithm": "BRO", "env": {"n": 2, "wrap": "stack,normalize"}},
    "hindsight": {"algorithm": "SAC", "kwargs": {"her": True}, "env": {"env": "goal"}},
    "hindsight, 4": {"algorithm": "SAC", "kwargs": {"her": True}, "env": {"env": "goal", "n": 4}},
    "n-step returns": {"algorithm": "SAC", "kwargs": {"n_steps": 3}, "env": DUMMY4},
    "memory": {"algorithm": "SAC", "kwargs": {"buffer": "plain",
        "optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}},
    "device ring": {"algorithm": "SAC", "kwargs": {"buffer": "device", "buffer_size": 70}, "env": {"n": 2}},
    "plain ring": {"algorithm": "SAC", "kwargs": {"buffer": "plain", "buffer_size": 70}, "env": {"n": 2}},
    "ring": {"algorithm": "VPLSAC", "kwargs": {"buffer_size": 70}, "env": {"n": 2}},
    "ring, hindsight": {"algorithm": "SAC", "kwargs": {"her": True, "buffer_size": 70}, "env": {"env": "goal"}},
    "ring, windows": {"algorithm": "DebiasedRQ", "kwargs": {"buffer_size": 70}, "env": {"n": 2}},
    "ring, windows, workers": {"algorithm": "DebiasedRQ", "kwargs": {"buffer_size": 70}, "env": WORKERS4},
    "ring, faded": {"algorithm": "SAC", "kwargs": {"buffer": "faded", "buffer_size": 70}, "env": {"n": 2}},
    "ring, priorities": {"algorithm": "BRO", "kwargs": {"buffer": "prioritized", "buffer_size": 70}, "env": {"n": 2},
                         "evaluate": True},
    "noise": {"algorithm": "BROTD3", "kwargs": {"noise": True}, "env": {"n": 2}},
    "episodes": {"algorithm": "SAC", "kwargs": {"train_freq": (1, "episode"), "gradient_steps": -1}},
    "fractions": {"algorithm": "SAC", "kwargs": {"replay_ratio": 0.3, "target_subset": 1}},
    "rewound, normalized": {"algorithm": "rewound", "env": NORMALIZED, "evaluate": True},
    "PPO": {"algorithm": "MBMA", "kwargs": {"n_simulated": 0}, "evaluate": True},
}  # fmt: skip


def differing(first: dict[str, str], second: dict[str, str]) -> list[str]:
    return sorted(name for name in first.keys() | second.keys() if first.get(name) != second.get(name))


def check(case: dict[str, Any], folder: Path, seed: int = 0) -> None:
    """2N steps at once, and N steps, a SIGKILL at a random later moment, and the rest."""
    whole, killed = str(folder / "whole"), str(folder / "killed")
    # Iterations of PPO are long, so that the process is not done before it is killed.
    total = 2 * N if case["algorithm"] not in PPOS else 2 * N + 64 * case.get("env", {}).get("n", 1)
    run(case, total, N, whole)
    seconds = random.Random(seed).uniform(0, 0.02)
    run(case, total, N, killed, (N, seconds), code=-9)
    assert not Path(f"{killed}.json").exists()
    run(case, total, N, killed)
    assert len(result(whole)) > 100
    assert not differing(result(whole), result(killed))


@pytest.mark.parametrize("name", sampled(FAST, ("BRO",)))
def test_killed_and_started_again(name: str, tmp_path: Path) -> None:
    check(FAST[name], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_killed_and_started_again_everywhere(name: str, tmp_path: Path) -> None:
    if "ALE/" in name:
        pytest.importorskip("ale_py")
    check(SLOW[name], tmp_path, seed=len(name))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_killed_while_a_checkpoint_is_written(seed: int, tmp_path: Path) -> None:
    case = {"algorithm": "VPLSAC", "kwargs": {"buffer_size": 70}}
    whole, killed = str(tmp_path / "whole"), str(tmp_path / "killed")
    run(case, 2 * N, 24, whole, (-1, 10**9))
    count = int(Path(f"{whole}.count").read_text())
    run(case, 2 * N, 24, killed, (-1, random.Random(seed).randrange(count // 4, count)), code=-9)
    run(case, 2 * N, 24, killed)
    assert not differing(result(whole), result(killed))


#: Every algorithm, those that stand alone first, and what goes wrong besides the kill.
ALGORITHMS = (*reversed(OFF_POLICY), *PPOS)
TROUBLE = ("tee", "full disk", "no log", "writing", "nothing")
#: How many kills there are; ``KILLS=145`` has every algorithm under every circumstance.
KILLS = int(os.environ.get("KILLS", "20"))


@pytest.fixture(scope="module")
def wholes(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """The folder of an algorithm's run that is never killed, made when it is first asked for."""
    folder = tmp_path_factory.mktemp("wholes")

    def whole(algorithm: str) -> str:
        path = str(folder / algorithm)
        if not Path(f"{path}.json").exists():
            run(_case(algorithm), _total(algorithm), 24, path, (-1, 10**9))
        return path

    return whole


def _case(algorithm: str) -> dict[str, Any]:
    envs = {"SRSPR": "stacks", **dict.fromkeys(PIXEL_MAKERS, "frames")}
    return {"algorithm": algorithm, "env": {"env": envs[algorithm]} if algorithm in envs else {}}


def _total(algorithm: str) -> int:
    return 3 * N if algorithm in PPOS else 2 * N


@pytest.mark.slow
@pytest.mark.parametrize("number", range(KILLS))
def test_killed_under_all_circumstances(number: int, wholes: Callable[[str], str], tmp_path: Path) -> None:
    """
    Ctrl-C with nobody who reads what is printed, and SIGKILL while the disk is full, while the log cannot be written,
    while a checkpoint is being written, and anywhere.
    """
    algorithm = ALGORITHMS[number % len(ALGORITHMS)]
    trouble = TROUBLE[(number + number // len(ALGORITHMS)) % len(TROUBLE)]
    rng = random.Random(number)
    case, total, killed = _case(algorithm), _total(algorithm), str(tmp_path / "killed")
    whole = wholes(algorithm)
    kill: tuple[int, float] = (N, rng.uniform(0, 0.02))
    if trouble == "writing":
        count = int(Path(f"{whole}.count").read_text())
        kill = (-1, rng.randrange(count // 4, count))
    run(case, total, 24, killed, kill, (trouble, number), code=1 if trouble == "tee" else -9)
    assert not Path(f"{killed}.json").exists()
    if trouble == "tee":
        assert max(int(path.name.split("-")[1]) for path in Path(killed).glob("checkpoint-*")) > N
    run(case, total, 24, killed)
    assert len(result(whole)) > 100
    assert not differing(result(whole), result(killed))
    left = {path.name for path in Path(killed).iterdir()} | {path.name[0] for path in Path(killed, "replay").iterdir()}
    assert {name for name in left if not name.startswith(("checkpoint-", "m"))} == {".lock", "progress.jsonl", "replay"}


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_of_a_terminal_and_of_a_scheduler(number: int, code: int, tmp_path: Path) -> None:
    """A program with workers, started as from a shell: Ctrl-C goes to all of its processes, kill to one."""
    case = {"algorithm": "SAC", "env": {"n": 2, "workers": "forkserver"}}
    text = f"from tests.saving.program import train\ntrain({case}, 10**6, 10**5, {str(tmp_path / 'run')!r})"
    script = f"if __name__ == '__main__':\n    {text.replace(chr(10), chr(10) + '    ')}\n"
    (tmp_path / "script.py").write_text(script)
    environment = {**os.environ, "PYTHONPATH": os.getcwd()}
    process = subprocess.Popen(
        [sys.executable, tmp_path / "script.py"], start_new_session=True, env=environment, stderr=subprocess.PIPE
    )
    try:
        deadline = time.monotonic() + 100
        log = tmp_path / "run" / "progress.jsonl"
        while not (log.exists() and log.stat().st_size) and time.monotonic() < deadline:
            time.sleep(0.05)
        if number == signal.SIGINT:
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode in (code, -number), errors.decode()
    assert b"finishing the turn, to save it" in errors and b"BrokenPipe" not in errors and b"EOFError" not in errors
    first, last = sorted(int(path.name.split("-")[1]) for path in (tmp_path / "run").glob("checkpoint-*"))
    assert first == 0 < last
