"""
Arithmetic of each agent of a plan: GFLOP of a gradient step and of a step of the simulator.

    python benchmarks/agent_flops.py studies/evidence/best_agent.yml

Multiplications and additions of matrix products, forward and backward, counted by ``torch.utils.flop_counter`` over six
gradient steps (of DR.Q over a block of six steps of its encoder too), on cheetah-run's sizes: 17 observations, 6
actions. Acting is left out: it is one row, where a gradient step has a batch.
"""

import argparse
import warnings
from typing import Any

import stable_baselines3
import torch
import yaml
from agent_cost import Noise
from stable_baselines3.common.logger import Logger
from torch.utils.flop_counter import FlopCounterMode

from sb3_sample import study
from sb3_sample.study.trial_agents import constructor_value
from sb3_sample.zoo import ALGORITHMS, HYPERPARAMS

#: Gradient steps that are counted: a multiple of every ``policy_delay`` in use, 1, 2 and 3.
STEPS = 6
#: Random transitions before them.
ROWS = 40


def gflop(algo: str, arguments: dict[str, Any]) -> tuple[float, float]:
    """
    :param algo: name of an algorithm in the zoo
    :param arguments: arguments of its constructor
    :return: GFLOP of a gradient step, and gradient steps of a transition
    """
    cls = ALGORITHMS[algo].algorithm
    quick = {"learning_starts": ROWS, "buffer_size": 10 * ROWS, "compile": False, "device": "cpu", "seed": 0}
    # Targets and encoder of DR.Q: one block in the steps that are counted.
    if algo == "dr_q":
        quick["target_update_interval"] = STEPS
    values = {name: constructor_value(name, value) for name, value in arguments.items()}
    model: Any = cls("MlpPolicy", Noise(), **{**values, **quick})
    model.set_logger(Logger(None, []))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="learn ended without a single gradient step")
        model.learn(ROWS)
    with FlopCounterMode(display=False) as counter:
        model.train(STEPS, model.batch_size)
    return counter.get_total_flops() / STEPS / 1e9, model.replay_ratio


def action_repeat(run: study.Run) -> int:
    """
    :param run: of a plan
    :return: simulator steps of a step of it: the plan's or, where it has no ``env_kwargs``, those of
        ``hyperparams/<algo>.yml``
    """
    entries = yaml.safe_load((HYPERPARAMS / f"{run.algo}.yml").read_text())
    settings = entries.get(run.task) or entries.get("default") or {}
    repeat: int = (run.env_kwargs or settings.get("env_kwargs") or {}).get("action_repeat", 1)
    return repeat


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plans", nargs="+", metavar="PLAN", help="files of plans")
    parser.add_argument("--agent", action="append", help="name of an agent (default: all)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"torch {torch.__version__}, stable_baselines3 {stable_baselines3.__version__}")
    print(f"{'agent':36}{'GFLOP an update':>17}{'updates a step':>16}{'GFLOP a simulator step':>24}")
    for plan in map(study.read_plan, options.plans):
        variants = {run.variant: run for run in reversed(plan.runs)}
        for name, run in reversed(variants.items()):
            if options.agent and run.agent not in options.agent:
                continue
            each, ratio = gflop(run.algo, run.arguments)
            a_step = each * ratio / action_repeat(run)
            print(f"{name:36}{each:17.3f}{ratio:16g}{a_step:24.2f}", flush=True)


if __name__ == "__main__":
    main()
