"""Runs of a study, and its plan: the runs to make."""

import dataclasses
import functools
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

from sb3_sample.study_list import part_of_path, variant_of, word

#: Data that an agent learns from besides the environment, and the number of steps on them.
DATA = ("dataset", "offline_steps", "prior_data")
#: Evaluation interval and episodes of the published curves.
EVERY, EPISODES = 25_000, 5
#: Environment steps between two checkpoints, as in ``sb3-sample train``.
CHECKPOINT_FREQ = 10_000
#: Allowed names of agents.
AGENT_NAME = re.compile(r"\w[\w .+()-]*")


class PlanError(ValueError):
    """A plan that cannot be run as it is written."""


@dataclasses.dataclass(frozen=True)
class Run:
    """
    One training.

    :param agent: the agent's name in the plan
    :param algo: its algorithm, as in ``sb3-sample train --algo``
    :param arguments: its arguments that differ from the settings of ``hyperparams/<algo>.yml``, including those of the
        grid
    :param grid: those of the arguments that belong to the grid
    :param task: id of the environment
    :param seed: the seed
    :param steps: environment steps
    :param eval_freq: environment steps between two evaluations
    :param eval_episodes: episodes of an evaluation
    :param checkpoint_freq: environment steps between two checkpoints
    :param env_kwargs: arguments of the environment
    :param gym_packages: modules that register environments
    :param measure: environment steps between two measurements of the noise scale and of overfitting, none if 0
    :param data: data sets that it learns from, ``dataset`` and ``prior_data`` as in ``train``, and the
        ``offline_steps``; only those given
    :param diagnostics: environment steps between two measurements of ``DiagnosticsCallback``, none if 0
    """

    agent: str
    algo: str
    arguments: dict[str, Any]
    grid: dict[str, Any]
    task: str
    seed: int
    steps: int
    eval_freq: int = EVERY
    eval_episodes: int = EPISODES
    checkpoint_freq: int = CHECKPOINT_FREQ
    env_kwargs: dict[str, Any] = dataclasses.field(default_factory=dict)
    gym_packages: tuple[str, ...] = ()
    measure: int = 0
    data: dict[str, Any] = dataclasses.field(default_factory=dict)
    diagnostics: int = 0

    @functools.cached_property
    def name(self) -> str:
        """Name of the run and of its folder in the study: ``<agent>/<task>/<seed>``."""
        return f"{self.variant}/{part_of_path(self.task)}/{self.seed}"

    @property
    def variant(self) -> str:
        """Name of the agent with its place in the grid, as a part of a path."""
        return variant_of(self.agent, self.grid)

    @property
    def label(self) -> str:
        """The agent's name in the plan with its place in the grid, as in tables of results."""
        grid = [f"{n}={word(v)}" for n, v in sorted(self.grid.items())]
        return f"{self.agent} ({', '.join(grid)})" if grid else self.agent

    @property
    def title(self) -> str:
        """The run in words, for messages."""
        grid = "".join(f", {name}={value}" for name, value in self.grid.items())
        return f"{self.agent}{grid} on {self.task}, seed {self.seed}"

    @functools.cached_property
    def kind(self) -> str:
        """Equal for runs that differ only in their seed."""
        what = [self.algo, self.arguments, self.task, self.env_kwargs, self.data, self.steps]
        return json.dumps(what, sort_keys=True, default=str)

    def command(self, folder: Path) -> list[str]:
        """
        :param folder: the run's folder
        :return: the arguments of ``sb3-sample train`` that make the run
        """
        command = [
            "--algo", self.algo, "--env", self.task, "--seed", str(self.seed), "-n", str(self.steps),
            "--eval-freq", str(self.eval_freq), "--eval-episodes", str(self.eval_episodes),
            "--checkpoint-freq", str(self.checkpoint_freq), "--run-dir", str(folder), "--verbose", "0",
        ]  # fmt: skip
        if self.gym_packages:
            command += ["--gym-packages", *self.gym_packages]
        if self.env_kwargs:
            command += ["--env-kwargs", *(f"{name}:{value!r}" for name, value in self.env_kwargs.items())]
        for name, value in self.data.items():
            home = isinstance(value, str) and value.startswith("~")
            command += [f"--{name.replace('_', '-')}", str(Path(value).expanduser() if home else value)]
        arguments = dict(self.arguments)
        callbacks = [
            {f"sb3_sample.diagnostics.{name}": {"every": every}}
            for name, every in (("NoiseScaleCallback", self.measure), ("DiagnosticsCallback", self.diagnostics))
            if every
        ]
        if callbacks:
            arguments["callback"] = callbacks if len(callbacks) > 1 else callbacks[0]
        if arguments:
            command += ["-params", *(f"{name}:{value!r}" for name, value in arguments.items())]
        return command

    def as_json(self) -> dict[str, Any]:
        """
        :return: the run as JSON
        """
        found = {**dataclasses.asdict(self), "gym_packages": list(self.gym_packages)}
        # As in files from before these fields existed.
        for name in ("measure", "data", "diagnostics"):
            if not found[name]:
                del found[name]
        return found

    @classmethod
    def of_json(cls, found: Any) -> "Run":
        """
        :param found: from ``as_json``, through an untrusted file
        :return: the run
        :raises ValueError: it is not a run
        """
        kinds = {"arguments": dict, "grid": dict, "env_kwargs": dict, "gym_packages": list, "data": dict}
        kinds |= dict.fromkeys(("agent", "algo", "task"), str)
        names = {field.name for field in dataclasses.fields(cls)}
        needed = {field.name for field in dataclasses.fields(cls) if not _has_default(field)}
        if not isinstance(found, dict) or not needed <= found.keys() <= names:
            raise ValueError(f"no run: {found!r:.200}")
        for name in found:
            if type(found[name]) is not kinds.get(name, int):
                raise ValueError(f"{name} of a run cannot be {found[name]!r:.100}")
        if not AGENT_NAME.fullmatch(found["agent"]) or found["seed"] < 0 or found["steps"] < 1:
            raise ValueError(f"no run: {found!r:.200}")
        if not found.get("data", {}).keys() <= set(DATA):
            raise ValueError(f"data of a run cannot be {found['data']!r:.100}")
        return cls(**{**found, "gym_packages": tuple(found.get("gym_packages", ()))})


def _has_default(field: dataclasses.Field[Any]) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


class Comparison(NamedTuple):
    """
    Comparison of a study's runs, as given by its plan.

    :param groups: tasks by the name of their group; empty if the plan has none
    :param factors: arguments that together make one choice, by the choice's name; empty if the plan has none
    """

    groups: dict[str, list[str]]
    factors: dict[str, list[str]]


class Plan(NamedTuple):
    """
    A study to be made.

    :param name: its name
    :param runs: its runs, in their order: the first seed of everything first
    :param text: the file as read; empty for a plan that is not from a file
    :param comparison: how its runs are compared
    """

    name: str
    runs: tuple[Run, ...]
    text: str = ""
    comparison: Comparison = Comparison({}, {})
