"""``sb3-sample dataset``: record, show and convert data sets."""

import argparse
import ast
import contextlib
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

import sb3_sample
from sb3_sample.envs.registration import is_atari_id, register_atari
from sb3_sample.exits import import_packages, refuse
from sb3_sample.replay.dataset import Dataset
from sb3_sample.replay.dataset_files import minari_target
from sb3_sample.replay.reading import HDF5, read_dataset
from sb3_sample.replay.recording import record
from sb3_sample.saving.classes import path_of
from sb3_sample.saving.container import PickledFile
from sb3_sample.saving.model import class_of
from sb3_sample.saving.normalization import load_vec_normalize

_SOURCE = "a folder or an id of Minari's, or an HDF5 file in D4RL's layout (.hdf5, .h5)"


def parser() -> argparse.ArgumentParser:
    """
    :return: parser of the command's arguments
    """
    main = argparse.ArgumentParser("sb3-sample dataset", description="Record, show and convert data sets.")
    commands = main.add_subparsers(dest="command", required=True)
    recorded = commands.add_parser("record", help="record episodes of a model")
    recorded.add_argument("model", type=Path, help="file of a model of this package")
    recorded.add_argument("output", help="new folder of Minari's format, or an id")
    recorded.add_argument("--env", required=True, help="id of the environment")
    recorded.add_argument("--gym-packages", nargs="+", default=[], help="modules that register environments")
    recorded.add_argument(
        "--env-kwargs",
        nargs="+",
        default=[],
        type=_pair,
        metavar="NAME:VALUE",
        help="arguments of the environment, those of the training, as for train (action_repeat:2)",
    )
    recorded.add_argument("--vecnormalize", type=Path, metavar="FILE", help="saved VecNormalize of the model")
    recorded.add_argument("--episodes", type=int, default=100, help="number of episodes (100)")
    recorded.add_argument("--stochastic", action="store_true", help="sample the actions")
    recorded.add_argument("--seed", type=int, default=0, help="of the environment, and of sampled actions (0)")
    shown = commands.add_parser("info", help="show what is in a data set")
    shown.add_argument("source", help=_SOURCE)
    shown.add_argument("--json", action="store_true", help="as JSON")
    converted = commands.add_parser("convert", help="write a data set in Minari's format")
    converted.add_argument("source", help=_SOURCE)
    converted.add_argument("output", help="new folder of Minari's format, or an id")
    for each in (shown, converted):
        each.add_argument("--env", help="of an HDF5 file: id of the environment whose spaces it has")
        each.add_argument("--memory-map", metavar="FOLDER", help="hold the data on the disk of this folder meanwhile")
    return main


def _pair(text: str) -> tuple[str, Any]:
    name, colon, value = text.partition(":")
    try:
        if not (colon and name.isidentifier()):
            raise ValueError
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        message = f"{text!r} is no name with a value of Python's, as action_repeat:2 or camera:\"'side'\""
        raise argparse.ArgumentTypeError(message) from None


def main(argv: Sequence[str] | None = None) -> None:
    """
    Run the command.

    :param argv: the command's arguments; None for this process's
    """
    args = parser().parse_args(argv)
    try:
        with warnings.catch_warnings():
            # The output shows the steps left out.
            warnings.filterwarnings("ignore", "[0-9]+ of [0-9]+ steps left out")
            _run(args)
    except PickledFile as error:
        refuse("dataset", f"{error}. Load it and call sb3_sample.record in a program of your own")
    except (ValueError, ImportError, OSError, gym.error.Error) as error:
        refuse("dataset", error)


def _run(args: argparse.Namespace) -> None:
    if args.command != "info":
        # Checked first: recording may take hours.
        minari_target(args.output)
    data = _recorded(args) if args.command == "record" else _read(args)
    if args.command != "info":
        folder = data.to_minari(args.output)
        steps = f"{data.n_left_out} step{'s' if data.n_left_out > 1 else ''}"
        left_out = f" ({steps} without a next observation left out)" if data.n_left_out else ""
        print(f"{len(data)} transitions of {data.n_episodes} episodes written to {folder}{left_out}")
    elif args.json:
        print(json.dumps(facts_of(data)))
    else:
        for name, value in facts_of(data).items():
            print(f"{name.replace('_', ' '):<22} {value}")


def _recorded(args: argparse.Namespace) -> Dataset:
    name = class_of(args.model)
    classes = [each for each in vars(sb3_sample).values() if isinstance(each, type) and issubclass(each, BaseAlgorithm)]
    cls: Any = next((each for each in classes if path_of(each) == name), None)
    if cls is None:
        raise ValueError(f"model {args.model} is of {name}, none of this package's algorithms")
    model = cls.load(args.model, device="cpu")
    model.set_random_seed(args.seed)
    import_packages("dataset", args.gym_packages)
    if is_atari_id(args.env):
        register_atari()
    kwargs = dict(args.env_kwargs)
    try:
        env: VecEnv = make_vec_env(args.env, env_kwargs=kwargs)
    except TypeError as error:
        if not kwargs:
            raise
        raise ValueError(f"{args.env} cannot be made with --env-kwargs {kwargs}: {error}") from error
    with contextlib.closing(env):
        if args.vecnormalize is not None:
            env = load_vec_normalize(args.vecnormalize, env)
        return record(model, env, args.episodes, deterministic=not args.stochastic, seed=args.seed)


def _read(args: argparse.Namespace) -> Dataset:
    if args.env is not None and Path(args.source).suffix not in HDF5:
        raise ValueError(f"env={args.env!r} is for HDF5 files, which have no spaces: leave it out")
    return read_dataset(args.source, args.env, memory_map=args.memory_map)


def facts_of(data: Dataset) -> dict[str, Any]:
    """
    :param data: a data set
    :return: facts about it, plain values by name
    """
    ends = {"terminated": 0, "truncated": 0}
    returns, lengths = [], []
    for rows in data.episodes():
        found = data.plain(rows)
        returns.append(float(found["rewards"].astype(np.float64).sum()))
        lengths.append(len(found["rewards"]))
        ends["terminated" if found["terminations"][-1] else "truncated"] += 1
    return {
        "transitions": len(data),
        "episodes": data.n_episodes,
        **ends,
        "steps_left_out": data.n_left_out,
        "mean_return": float(np.mean(returns)),
        "smallest_return": min(returns),
        "largest_return": max(returns),
        "mean_length": float(np.mean(lengths)),
        "observations": _shown(data.observation_space),
        "actions": _shown(data.action_space),
        "fingerprint": data.fingerprint,
    }


def _shown(space: spaces.Space) -> str:
    if isinstance(space, spaces.Dict):
        return ", ".join(f"{key} {part.shape}" for key, part in space.spaces.items())
    return str(space)
