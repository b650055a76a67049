"""``sb3-sample advise``: the BRO size and replay ratio that get furthest in a number of hours on this machine."""

import argparse
import itertools
import json
import sys
from collections.abc import Sequence

import gymnasium as gym
import pandas as pd
import torch
from stable_baselines3.common.utils import get_device

import sb3_sample.envs  # noqa: F401  # registers the ids
from sb3_sample.study import step_times
from sb3_sample.study.advice import SUITES, Advice, advise, published_grid
from sb3_sample.study.analysis_command import markdown, refusing
from sb3_sample.study.cores import idle_cores
from sb3_sample.study.step_times import StepTimes

#: Fraction of a core that other processes may use while steps are measured.
BUSY = 0.3
#: Measure of each suite: return or success rate.
_MEASURES = {"dmc": "return / 1,000", "metaworld": "success rate", "myosuite": "success rate"}


def main(argv: Sequence[str]) -> None:
    """
    :param argv: command line after ``advise``
    """
    parser = argparse.ArgumentParser(
        "sb3-sample advise",
        description="Which size of BRO and replay ratio gets furthest in some hours of this machine, by published "
        "runs. The first time gradient steps of every size are measured, compiled, which takes some minutes; they are "
        f"kept in {step_times.cache_file()}. See docs/scaling.md.",
    )
    parser.add_argument("--hours", type=float, required=True, help="of one training on this machine")
    parser.add_argument(
        "--env",
        metavar="ID",
        help="environment that is to be trained on (default: one of the suite: "
        + ", ".join(env_id for _, env_id in SUITES.values())
        + ")",
    )
    parser.add_argument(
        "--suite",
        choices=list(SUITES),
        help="whose published runs to go by (default: the environment's; dmc without an environment)",
    )
    parser.add_argument("--threads", type=int, help="of the training (default: those that torch takes here)")
    parser.add_argument("--device", default="auto", help="of the training (default: auto)")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="compile nothing: estimate compiled steps by multiplications and eager steps, in some seconds and roughly",
    )
    parser.add_argument("--again", action="store_true", help="measure step times that are kept once more")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    with refusing("advise"):
        _run(options)


def _run(options: argparse.Namespace) -> None:
    threads = torch.get_num_threads() if options.threads is None else options.threads
    if threads < 1:
        raise ValueError(f"threads must be at least 1, not {threads}")
    if not options.hours > 0:
        raise ValueError(f"hours must be a positive number, not {options.hours!r}")
    suite = options.suite or _suite_of(options.env)
    env_id = options.env or SUITES[suite][1]
    try:
        env = gym.make(env_id)
    except (ImportError, gym.error.Error) as error:
        raise ValueError(f"env must be an environment that can be made here, not {env_id!r}: {error}") from error
    with env:
        environment = step_times.environment_seconds(env)
    episode = getattr(env.spec, "max_episode_steps", None) or 1_000
    times = _times(threads, options)
    # The training uses the threads and the device of the measured times.
    given = [] if options.threads is None else [f"--num-threads {threads}"]
    given += [] if options.device == "auto" else [f"--device {options.device}"]
    found = advise(options.hours, times, environment, suite=suite, env=env_id, episode=episode, options=given)
    if options.json:
        print(json.dumps(_as_json(found, times, environment), indent=2))
    else:
        print(page(found, times, environment))


def _suite_of(env_id: str | None) -> str:
    if env_id is None:
        return next(iter(SUITES))
    suite = env_id.removeprefix("sb3_sample:").partition("/")[0]
    if suite not in SUITES:
        raise ValueError(
            f"suite (--suite) must be given, one of {', '.join(SUITES)}: {env_id} is of none of them, and the "
            "published runs say something of it only as far as it is like one of these"
        )
    return suite


def _times(threads: int, options: argparse.Namespace) -> StepTimes:
    """Stored step times; without them they are measured, and stored unless they are quick ones."""

    def say(text: str) -> None:
        print(text, file=sys.stderr)

    kept = None if options.again else step_times.stored(threads, options.device)
    if kept is not None:
        return kept
    if get_device(options.device).type == "cpu" and idle_cores() < threads - BUSY:
        again = "" if options.quick else " (--again)"  # quick measurements are not stored
        say(
            f"fewer cores are free than the {threads} that steps are measured on: they will seem too long. Measure "
            f"again{again} when nothing else runs"
        )
    times = step_times.measure(threads, options.device, quick=options.quick, say=say)
    if not options.quick:
        say(f"kept in {step_times.keep(times)}")
    return times


def page(found: Advice, times: StepTimes, environment: float) -> str:
    """
    :param found: the answer
    :param times: step times behind it
    :param environment: seconds of a step of the environment
    :return: the answer in words
    """
    best, measure = found.best, _MEASURES[found.suite]
    grid = published_grid()
    tasks = int(grid.loc[grid["suite"] == found.suite, "tasks"].max())
    first, last = int(grid["env_step"].min()), int(grid["env_step"].max())
    known = found.table.dropna(subset=["iqm"])
    few = found.table[found.table["iqm"].isna()]
    lines = [
        f"{times}; acting {1e3 * times.acting:.2g}, a step of {found.env} {1e3 * environment:.2g}",
        "",
        f"{best['model_size']} at replay ratio {best['replay_ratio']}: {best['steps']:,} steps in {best['hours']:.2g} "
        f"hours, expected {measure} {_value(best)}",
        f"  {found.command}",
        "",
    ]
    if len(found.equals):
        lines += [f"Not told apart from it, since the intervals overlap: {_names(found.equals)}.", ""]
    shown = [
        {
            "model_size": row["model_size"], "replay ratio": row["replay_ratio"], "steps": f"{row['steps']:,}",
            "hours": f"{row['hours']:.2g}", measure: _value(row),
        }
        for _, row in known.iterrows()
    ]  # fmt: skip
    lines += [markdown(pd.DataFrame(shown)), "", "Limits:"]
    lines += [
        f"- Interpolated between published runs, one evaluation every {first:,} steps: interquartile mean of the runs "
        f"of {tasks} tasks of {SUITES[found.suite][0]}, ten seeds each at most, with its 95% interval over seeds. A "
        "single task may be far from it.",
        "- Source: value-scaling.github.io (Fu et al. 2025, Compute-Optimal Scaling for Value-Based Deep RL), BRO at "
        "25 sizes and replay ratios; the batch size is 128 for two of them and most likely for all.",
    ]
    if times.how == "quick":
        lines.append(
            "- Step times are rough: from multiplications and eager steps. Without --quick compiled ones are measured."
        )
    steps = list(times.gradient_step.items())
    if faster := [(small, large) for (small, a), (large, b) in itertools.pairwise(steps) if b < a]:
        pairs = ", ".join(f"{large} than of {small}" for small, large in faster)
        lines.append(
            f"- Gradient steps were measured shorter of {pairs}: something else ran meanwhile. Measure again when "
            "nothing does."
        )
    if len(few):
        lines.append(
            f"- No number stands for fewer than {first:,} steps, which these would make: {_names(few)} (sizes at "
            "replay ratios)."
        )
    if found.table["ends_early"].any():
        lines.append(
            f"- Where the hours are enough for more than {last:,} steps, the row is of {last:,}: nothing was published "
            "beyond, and no number stands for it."
        )
    return "\n".join(lines)


def _names(rows: pd.DataFrame) -> str:
    return ", ".join(f"{row.model_size} at {row.replay_ratio}" for row in rows.itertuples())


def _value(row: pd.Series) -> str:
    return f"{row['iqm']:.3f} [{row['low']:.3f}, {row['high']:.3f}]"


def _as_json(found: Advice, times: StepTimes, environment: float) -> dict[str, object]:
    rows = json.loads(found.table.to_json(orient="records"))  # NaN is null
    return {
        "suite": found.suite, "env": found.env, "hours": found.hours, "measure": _MEASURES[found.suite],
        "command": found.command, "configurations": rows, "environment_seconds": environment,
        "rough": times.how == "quick", "step_times": times.__dict__,
    }  # fmt: skip
