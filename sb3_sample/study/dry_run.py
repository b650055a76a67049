"""Costs of a plan before it is run: hours, from the step time of this machine, and bytes."""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from sb3_sample.learner.execution import PAYS_FROM
from sb3_sample.sac.bro import BRO, BROFast
from sb3_sample.saving.run_folder import SEGMENTS
from sb3_sample.study.advice import SUITES
from sb3_sample.study.cores import free_cores, threads_of_libraries
from sb3_sample.study.plan import Plan, Run
from sb3_sample.study.plan_file import read_plan
from sb3_sample.study.runs import StudyFolder
from sb3_sample.study.step_times import StepTimes, cache_file, stored
from sb3_sample.study.trial_agents import constructor_arguments
from sb3_sample.study.worker import train

#: Seconds for which the step time of an agent on a task is measured.
SECONDS = 3.0
#: Steps of random actions before the measurement.
WARM_UP = 500
#: Algorithms whose step times may be known, and arguments that change neither these times nor how steps are run.
_TIMED = {"bro": BRO, "bro_fast": BROFast}
_UNTIMED = {
    "replay_ratio", "model_size", "resets", "reset_gradient_steps", "resets_to", "learning_starts", "buffer_size",
    "learning_rate", "gamma", "tau",
}  # fmt: skip
#: Gradient steps per environment step of a probe whose gradient-step time is known: too few to matter.
_HARDLY_ANY = 1e-3
_PROBE = (sys.executable, "-c", "from sb3_sample.study.dry_run import probe; probe()")


class MeasurementFailed(RuntimeError):
    """
    A training to be measured has failed.

    :param title: the run in words
    :param output: end of its printed output, which ``output`` keeps; the message has its last line
    """

    def __init__(self, title: str, output: str):
        self.output = output.strip()
        super().__init__(f"{title} cannot be measured: {self.output.rpartition(chr(10))[2]}")


class Cost(NamedTuple):
    """
    :param seconds: of an environment step, including its gradient steps
    :param bytes_of_run: size of the run's folder without the replay buffer
    :param bytes_of_step: of a transition
    """

    seconds: float
    bytes_of_run: float
    bytes_of_step: float


class Estimate(NamedTuple):
    """
    :param n_runs: runs of the plan
    :param n_done: number of these that are done
    :param hours: remaining hours of the runs that are not done, with one core per thread of a run
    :param workers: runs at once
    :param n_bytes: size of their folders in the end
    :param n_episodes: episodes of their evaluations, which the hours do not include
    """

    n_runs: int
    n_done: int
    hours: float
    workers: int
    n_bytes: float
    n_episodes: int

    def __str__(self) -> str:
        return (
            f"{self.n_runs} runs, {self.n_done} of them done. The others take {self.hours:.2f} hours, "
            f"{self.hours / self.workers:.2f} with {self.workers} at once (evaluations of "
            f"{self.n_episodes:,} episodes apart), and {_size(self.n_bytes)} of disk"
        )


def _size(n_bytes: float) -> str:
    for unit in ("bytes", "kB", "MB", "GB"):
        if n_bytes < 1000:
            return f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} TB"


def estimate(
    plan: str | Path | Plan,
    folder: str | Path | None = None,
    *,
    workers: int | None = None,
    threads: int = 1,
    device: str = "auto",
    say: Callable[[str], None] = lambda _: None,
) -> Estimate:
    """
    Estimate the cost of a plan. The step time is measured on this machine, in the first seconds of a training of each
    agent on the first task and of the first agent on each task; for other pairs it is the product of the two ratios. If
    ``sb3-sample advise`` has stored the times of BRO's gradient steps, these are used and not measured again.

    :param plan: a plan or its file
    :param folder: the study's folder, whose finished runs and already made steps are not counted;
        ``runs/<name of the plan>`` if None
    :param workers: runs at once; if None, as many as there are free cores for
    :param threads: of each run
    :param device: of each run
    :param say: called with a message on each measurement
    :return: the estimate
    :raises PlanError: the plan cannot be run as it stands
    :raises MeasurementFailed: a training to be measured has failed
    """
    plan = plan if isinstance(plan, Plan) else read_plan(plan)
    place = StudyFolder(Path("runs") / plan.name if folder is None else folder)
    at_once = max(free_cores() // threads, 1) if workers is None else workers
    left = [run for run in plan.runs if not place.outcome(run).done]
    times = stored(threads, device)
    costs: dict[tuple[str, str], Cost] = {}
    seconds = n_bytes = 0.0
    n_episodes = 0
    of_plan = {(run.variant, run.task): run for run in plan.runs}
    for run in left:
        base = left[0]
        pairs = [(base.variant, base.task), (run.variant, base.task), (base.variant, run.task)]
        if not all(pair in of_plan for pair in pairs):
            # Agents may have data of only some tasks.
            pairs = [(run.variant, run.task)] * 3
        for pair in pairs:
            if pair not in costs:
                probe = of_plan[pair]
                learning = None if times is None else seconds_of_learning(probe, times)
                known = "" if learning is None else f", gradient steps of {cache_file()}"
                say(f"measuring {probe.variant} on {probe.task}{known}")
                if learning is None:
                    cost = measure(probe, threads, device)
                else:
                    arguments = {**probe.arguments, "replay_ratio": _HARDLY_ANY, "compile": False}
                    cost = measure(dataclasses.replace(probe, arguments=arguments), threads, device)
                    cost = cost._replace(seconds=cost.seconds + learning)
                costs[pair] = cost
        first, agent, task = (costs[pair] for pair in pairs)
        # Only the rest of a run that was begun.
        made = min(place.progress(run).steps, run.steps)
        seconds += (run.steps - made) * agent.seconds * task.seconds / first.seconds
        n_episodes += (run.steps // run.eval_freq - made // run.eval_freq) * run.eval_episodes
        # Networks depend on the agent, observations on the task.
        n_bytes += agent.bytes_of_run * task.bytes_of_run / first.bytes_of_run
        n_bytes += min(run.steps, _buffer_size(run)) * (task.bytes_of_step if agent.bytes_of_step else 0.0)
    n_done, at_once = len(plan.runs) - len(left), min(at_once, max(len(left), 1))
    return Estimate(len(plan.runs), n_done, seconds / 3600, at_once, n_bytes, n_episodes)


def seconds_of_learning(run: Run, times: StepTimes) -> float | None:
    """
    :param run: the run
    :param times: of the machine
    :return: seconds of the gradient steps per environment step; None if the times do not apply to such a run
    """
    if run.algo not in _TIMED or not set(run.arguments) <= _UNTIMED or run.data:
        return None
    if run.task.partition("/")[0] not in SUITES:  # only these suites have no settings of their own
        return None
    defaults = _TIMED[run.algo].constructor_arguments
    size, ratio, warm_up = (
        run.arguments.get(name, defaults[name].default) for name in ("model_size", "replay_ratio", "learning_starts")
    )
    if not isinstance(size, str) or size not in times.gradient_step or ratio is None:
        return None
    if times.how == "compiled" and ratio * (run.steps - warm_up) < PAYS_FROM:
        return None
    return float(ratio * times.gradient_step[size])


def _buffer_size(run: Run) -> float:
    return float(run.arguments.get("buffer_size", 1_000_000))


def measure(run: Run, threads: int, device: str) -> Cost:
    """
    Measure a run by its first seconds, in a separate process and folder.

    :param run: the run
    :param threads: its threads
    :param device: its device
    :return: its cost
    :raises MeasurementFailed: it has failed, or ended before anything was learned
    """
    with tempfile.TemporaryDirectory() as folder:
        times, place = Path(folder) / "times.json", Path(folder) / "run"
        stopwatch = {"sb3_sample.study.stopwatch.Stopwatch": {"path": str(times), "seconds": SECONDS}}
        arguments = {**run.arguments, "callback": stopwatch}
        if "learning_starts" in constructor_arguments(run.algo):
            arguments["learning_starts"] = WARM_UP
        # As many steps as the run has, since the choice to compile depends on them.
        order = {
            "run": dataclasses.replace(
                run, arguments=arguments, eval_freq=run.steps, measure=0, diagnostics=0
            ).as_json(),
            "options": ["--num-threads", str(threads), "--device", device],
        }
        env = {**os.environ, **threads_of_libraries(threads)}
        done = subprocess.run(
            [*_PROBE, str(place)], input=json.dumps(order), capture_output=True, text=True, env=env, check=False
        )
        try:
            found = json.loads(times.read_text())
        except FileNotFoundError as error:
            raise MeasurementFailed(run.title, done.stdout[-10_000:] + done.stderr[-10_000:]) from error
        return Cost(found["seconds"] / found["steps"], _bytes(place), found["bytes_of_step"])


def probe() -> None:
    """Make the run that the standard input gives as JSON, in the folder that the command line names."""
    order = json.loads(sys.stdin.read())
    train(Run.of_json(order["run"]), Path(sys.argv[1]), order["options"])


def _bytes(folder: Path) -> float:
    """Bytes of everything except rows of replay buffers when the run has ended."""
    n_checkpoints = max(len(list(folder.glob("**/checkpoint-*"))), 1)
    found = 0.0
    for path in folder.rglob("*"):
        if path.is_file() and path.parent.name != SEGMENTS:
            size = path.stat().st_size
            # Two checkpoints are kept, and both the best and the last model.
            if path.parent.name.startswith("checkpoint-"):
                found += size * 2 / n_checkpoints
            else:
                found += size * (2 if path.suffix == ".zip" else 1)
    return found
