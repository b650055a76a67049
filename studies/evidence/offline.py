"""
Make the data sets of offline.yml with this package's own agents: the replay of the first half of a training, and
episodes of the trained agent.

    python studies/evidence/offline.py [--folder DIR]

It takes about half an hour on one core. Interrupted trainings resume; existing data sets are kept. ``make evidence``
calls it before the plan's first run. ``datasets.json`` describes the agents that made the data, by seeds and returns.
"""

import argparse
import fcntl
import importlib
import json
import shutil
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
from stable_baselines3 import HerReplayBuffer

from sb3_sample import SAC, BROFast, Dataset, record
from sb3_sample.dataset_command import facts_of

#: Folder of the data sets, the same as in the plan.
FOLDER = Path("~/.cache/sb3_sample/datasets/offline")
#: Kinds of data.
REPLAY, EXPERT = "medium-replay", "expert"
SEED = 0


class Recipe(NamedTuple):
    """
    Recipe for the data of a task.

    :param algorithm: class of the agent
    :param arguments: its arguments
    :param steps: environment steps of its training, of which the first half are the replay
    :param episodes: of the trained agent
    :param packages: modules that register the task
    """

    algorithm: type[SAC]
    arguments: dict[str, Any]
    steps: int
    episodes: int
    packages: tuple[str, ...] = ()


#: Recipes by task, with the ids of the plan.
RECIPES = {
    "dmc/cartpole-swingup-v0": Recipe(BROFast, {"policy": "MlpPolicy", "model_size": "0.55M"}, 60_000, 25),
    "FetchReach-v4": Recipe(
        SAC,
        {
            "policy": "MultiInputPolicy",
            "gamma": 0.95,
            "learning_starts": 1_000,
            "replay_buffer_class": HerReplayBuffer,
        },
        20_000,
        500,
        ("gymnasium_robotics",),
    ),
}


def make(task: str, recipe: Recipe, folder: Path) -> dict[str, Any]:
    """
    Train an agent and write its data sets.

    :param task: id of the environment
    :param recipe: how they are made
    :param folder: of the task's data sets
    :return: facts about them
    """
    for package in recipe.packages:
        gym.register_envs(importlib.import_module(package))
    model: Any = recipe.algorithm(
        env=gym.make(task), seed=SEED, device="cpu", buffer_size=recipe.steps, **recipe.arguments
    )
    half = recipe.steps // 2
    run = folder / "training"
    model.learn(half, checkpoint=run / "first")
    made = {REPLAY: Dataset.from_replay_buffer(model.replay_buffer)}
    model.learn(recipe.steps - half, reset_num_timesteps=False, checkpoint=run / "second")
    made[EXPERT] = record(model, task, recipe.episodes, seed=SEED + 1)
    facts: dict[str, Any] = {"steps": recipe.steps, "seed": SEED, "agent": recipe.algorithm.__name__}
    for kind, dataset in made.items():
        shutil.rmtree(folder / kind, ignore_errors=True)
        dataset.to_minari(folder / kind)
        facts[kind] = facts_of(dataset)
    return facts


def main(argv: Sequence[str] | None = None, recipes: dict[str, Recipe] = RECIPES) -> None:
    """
    Make the data sets that are missing.

    :param argv: arguments; None for this process's
    :param recipes: by task, how they are made
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where they are written")
    root = parser.parse_args(argv).folder.expanduser()
    root.mkdir(parents=True, exist_ok=True)
    with (root / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # two runs may begin at the same time
        for task, recipe in recipes.items():
            folder = root / task.replace("/", "-")
            done = folder / "datasets.json"
            if done.exists():
                continue
            with warnings.catch_warnings():
                # Warnings about a training interrupted between its halves, and about steps that a replay cuts off.
                warnings.filterwarnings("ignore", "Nothing is left to train|[0-9]+ of [0-9]+ steps left out")
                facts = make(task, recipe, folder)
            done.write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
