"""
Plans of studies: which runs to make, as a YAML file.

A plan has agents (an algorithm and arguments), tasks, seeds, steps, an evaluation and a grid of arguments. What it says
is checked before anything runs, and an error names file, line and what is allowed.
"""

import dataclasses
import difflib
import functools
import hashlib
import importlib
import inspect
import itertools
import json
import math
import re
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium as gym
import numpy as np
import yaml
from gymnasium import spaces

from sb3_sample.envs.no_environment import NoEnvironment
from sb3_sample.envs.registration import is_atari_id, register_atari
from sb3_sample.envs.suites import SUITES
from sb3_sample.kinds import check_value
from sb3_sample.shallow_yaml import ShallowLoader

#: Entries of a plan; those after the first four have defaults.
ENTRIES = (
    "agents", "tasks", "seeds", "steps", "evaluation", "grid", "checkpoint_freq", "env_kwargs", "gym_packages",
    "groups", "factors", "measure",
)  # fmt: skip
REQUIRED = ENTRIES[:4]
#: Entries of an agent besides its arguments: what it learns from, and how long.
DATA = ("dataset", "offline_steps", "prior_data")
OF_RUN = ("algo", "steps", *DATA)
#: Stands in a data set's name for the task, as a part of a path.
TASK = "{task}"
#: The published curves' evaluation.
EVERY, EPISODES = 25_000, 5
#: Environment steps between two checkpoints, as of ``sb3-sample train``.
CHECKPOINT_FREQ = 10_000
#: Arguments of the constructors that are the run's, not the agent's.
NOT_OF_AGENTS = {
    "_init_setup_model", "action_space", "device", "env", "observation_space", "prior_data", "seed", "tensorboard_log",
    "verbose",
}  # fmt: skip
#: Characters of a plan, and of one part of a folder's name.
MAX_PLAN, MAX_NAME = 2**20, 120
#: Values in one entry, where an alias counts as what it stands for.
MAX_VALUES = 10_000
_AGENT = re.compile(r"\w[\w .+()-]*")
#: Arguments of every environment, which ``gymnasium.make`` takes itself.
_OF_MAKE = ("max_episode_steps", "disable_env_checker")
_EXPONENT = re.compile(r"[-+]?(\d[\d_]*)(\.\d*)?[eE][-+]?\d+$")


class PlanError(ValueError):
    """A plan that cannot be run as it stands."""


@dataclasses.dataclass(frozen=True)
class Run:
    """
    One training.

    :param agent: the agent's name in the plan
    :param algo: its algorithm, as ``sb3-sample train --algo`` has it
    :param arguments: its arguments that differ from the settings of ``hyperparams/<algo>.yml``, those of the grid too
    :param grid: the arguments of them that are the grid's
    :param task: id of the environment
    :param seed: the seed
    :param steps: environment steps
    :param eval_freq: environment steps between two evaluations
    :param eval_episodes: episodes of an evaluation
    :param checkpoint_freq: environment steps between two checkpoints
    :param env_kwargs: arguments of the environment
    :param gym_packages: modules that register environments
    :param measure: environment steps between two measurements of the noise scale and of overfitting, none if 0
    :param data: data sets that it learns from, ``dataset`` and ``prior_data`` as ``train`` has them, and the
        ``offline_steps``; those that there are
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

    @functools.cached_property
    def name(self) -> str:
        """Name among the runs of a study and of its folder there: ``<agent>/<task>/<seed>``."""
        return f"{self.variant}/{_plain(self.task)}/{self.seed}"

    @property
    def variant(self) -> str:
        """Name of the agent with its place in the grid, as a part of a path."""
        return _plain(",".join([self.agent, *(f"{name}={_short(value)}" for name, value in self.grid.items())]))

    @property
    def label(self) -> str:
        """The agent's name in the plan with its place in the grid, as tables of results have it."""
        grid = [f"{n}={_short(v)}" for n, v in sorted(self.grid.items())]
        return f"{self.agent} ({', '.join(grid)})" if grid else self.agent

    @property
    def title(self) -> str:
        """The run in words, for messages."""
        grid = "".join(f", {name}={value}" for name, value in self.grid.items())
        return f"{self.agent}{grid} on {self.task}, seed {self.seed}"

    @functools.cached_property
    def kind(self) -> str:
        """Equal for runs that differ in their seed alone."""
        what = [self.algo, self.arguments, self.task, self.env_kwargs, self.data, self.steps]
        return json.dumps(what, sort_keys=True, default=str)

    def command(self, folder: Path) -> list[str]:
        """
        :param folder: the run's
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
        if self.measure:
            arguments["callback"] = {"sb3_sample.diagnostics.NoiseScaleCallback": {"every": self.measure}}
        if arguments:
            command += ["-params", *(f"{name}:{value!r}" for name, value in arguments.items())]
        return command

    def as_json(self) -> dict[str, Any]:
        """
        :return: the run as JSON has it
        """
        found = {**dataclasses.asdict(self), "gym_packages": list(self.gym_packages)}
        # As runs were written before there were these.
        for name in ("measure", "data"):
            if not found[name]:
                del found[name]
        return found

    @classmethod
    def of_json(cls, found: Any) -> "Run":
        """
        :param found: from ``as_json``, through a file that anybody may have written
        :return: the run
        :raises ValueError: it is no such thing
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
        if not _AGENT.fullmatch(found["agent"]) or found["seed"] < 0 or found["steps"] < 1:
            raise ValueError(f"no run: {found!r:.200}")
        if not found.get("data", {}).keys() <= set(DATA):
            raise ValueError(f"data of a run cannot be {found['data']!r:.100}")
        return cls(**{**found, "gym_packages": tuple(found.get("gym_packages", ()))})


def _has_default(field: dataclasses.Field[Any]) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


class Comparison(NamedTuple):
    """
    How the runs of a study are compared, as its plan says.

    :param groups: tasks by the name of their group; empty if the plan has none
    :param factors: arguments that are one choice together, by the choice's name; empty if the plan has none
    """

    groups: dict[str, list[str]]
    factors: dict[str, list[str]]


class Plan(NamedTuple):
    """
    A study that is to be made.

    :param name: its name
    :param runs: its runs, in their order: the first seed of everything first
    :param text: the file, as it was read; empty for a plan that was made otherwise
    :param comparison: how its runs are compared
    """

    name: str
    runs: tuple[Run, ...]
    text: str = ""
    comparison: Comparison = Comparison({}, {})


def _has_data_on(data: Mapping[str, Any], task: str) -> bool:
    """Whether there is a data set for a task wherever they are named by task."""
    return all(task in value for value in data.values() if isinstance(value, dict))


def _data_on(data: Mapping[str, Any], task: str) -> dict[str, Any]:
    """The data of a task."""
    chosen = {name: value[task] if isinstance(value, dict) else value for name, value in data.items()}
    return {
        name: value.replace(TASK, _plain(task)) if isinstance(value, str) else value for name, value in chosen.items()
    }


def _plain(name: str) -> str:
    """A name as a part of a path; a long one ends in a number that stands for the rest."""
    plain = re.sub(r"[^\w.,=+()-]+", "-", name)
    if len(plain) <= MAX_NAME:
        return plain
    return f"{plain[:MAX_NAME]}-{hashlib.sha256(name.encode()).hexdigest()[:12]}"


def _short(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


# ---------------------------------------------------------------- reading


def read_plan(path: str | Path) -> Plan:
    """
    Read and check a plan.

    :param path: of the YAML file
    :return: the plan, named as the file
    :raises PlanError: (a ``ValueError``) it cannot be read, or it says what cannot be run; the message names file, line
        and what is allowed
    :raises ImportError: the zoo's commands are not installed
    """
    return _Reader(Path(path)).read()


class _Loader(ShallowLoader):
    """Plain values; ``1e6`` is a number, as everywhere but in YAML 1.1."""

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        if _EXPONENT.match(node.value):
            return float(node.value)
        return super().construct_yaml_float(node)


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+0123456789"))
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)


class _Entry(NamedTuple):
    """A key of a mapping and its value, with their lines."""

    key: yaml.Node
    value: yaml.Node


class _Agent(NamedTuple):
    name: str
    algo: str
    arguments: dict[str, Any]
    data: dict[str, Any]
    steps: int | None
    entries: dict[str, _Entry]
    node: yaml.Node


class _Reader:
    def __init__(self, path: Path):
        self._path = path
        #: Mappings that have been looked at: reading them puts what they merge among their own.
        self._checked: set[int] = set()

    def _fail(self, node: yaml.Node, message: str) -> PlanError:
        return PlanError(f"{self._path}, line {node.start_mark.line + 1}: {message}")

    def read(self) -> Plan:
        try:
            text = self._path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise PlanError(f"{self._path} cannot be read: {error}") from error
        if len(text) > MAX_PLAN:
            raise PlanError(f"{self._path} is longer than a plan can be, {MAX_PLAN:,} characters")
        try:
            self._loader = _Loader(text)
            node = self._loader.get_single_node()
        except yaml.MarkedYAMLError as error:
            line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
            raise PlanError(f"{self._path}{line}: this is no YAML: {error.problem}") from error
        except yaml.YAMLError as error:
            raise PlanError(f"{self._path}: this is no YAML: {error}") from error
        if node is None:
            raise PlanError(f"{self._path} is empty: a plan has {', '.join(REQUIRED)}")
        entries = self._mapping(node, "a plan")
        for name, entry in entries.items():
            if name not in ENTRIES:
                raise self._fail(entry.key, f"{name!r} is no entry of a plan{_meant(name, ENTRIES)}")
        for name in REQUIRED:
            if name not in entries:
                raise self._fail(node, f"a plan needs {name}; it has {', '.join(ENTRIES)}")
        packages = self._packages(entries)
        agents = self._agents(entries["agents"].value)
        grid = self._grid(entries, agents)
        tasks = self._tasks(entries["tasks"].value)
        seeds = self._seeds(entries["seeds"].value)
        steps = self._count(entries["steps"].value, "steps")
        every, episodes = self._evaluation(entries, min([steps, *(agent.steps for agent in agents if agent.steps)]))
        freq = CHECKPOINT_FREQ
        if "checkpoint_freq" in entries:
            freq = self._count(entries["checkpoint_freq"].value, "checkpoint_freq")
        measure = self._count(entries["measure"].value, "measure") if "measure" in entries else 0
        env_kwargs = self._env_kwargs(entries, tasks)
        variants = list(self._variants(agents, grid))
        if measure:
            self._check_measured(entries["measure"].value, agents)
        runs = tuple(
            Run(
                agent.name,
                agent.algo,
                arguments,
                point,
                task,
                seed,
                agent.steps or steps,
                every,
                episodes,
                freq,
                env_kwargs,
                packages,
                measure,
                _data_on(agent.data, task),
            )
            for seed in seeds
            for task in tasks
            for agent, arguments, point in variants
            if _has_data_on(agent.data, task)
        )
        for agent in agents:
            self._check_data(agent, agent.steps or steps, tasks)
        comparison = Comparison(self._groups(entries, tasks), self._factors(entries, agents, grid))
        return Plan(self._path.stem, runs, text, comparison)

    # ------------------------------------------------ YAML

    def _mapping(self, node: yaml.Node, what: str) -> dict[str, _Entry]:
        if not isinstance(node, yaml.MappingNode):
            raise self._fail(node, f"{what} must be a mapping of names to values, not {self._shown(node)}")
        self._check_twice(node)
        self._loader.flatten_mapping(node)
        found = {}
        for key, value in node.value:
            name = self._plain(key)
            if not isinstance(name, str):
                raise self._fail(key, f"the names of {what} must be texts, not {name!r}: put it in quotes")
            found[name] = _Entry(key, value)
        return found

    def _check_twice(self, node: yaml.MappingNode) -> None:
        """YAML's reader lets the last of several equal keys win."""
        if id(node) in self._checked:
            return
        self._checked.add(id(node))
        seen: dict[Any, yaml.Node] = {}
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise self._fail(key, "a name must be a text")
            if key.value in seen:
                first = seen[key.value].start_mark.line + 1
                raise self._fail(
                    key, f"{key.value!r} is there twice: once on line {first}. Each name can be there once"
                )
            seen[key.value] = key

    def _plain(self, node: yaml.Node) -> Any:
        """Plain value of a node."""
        for count, each in enumerate(_nodes(node)):
            if count > MAX_VALUES:
                raise self._fail(node, f"this is more than {MAX_VALUES:,} values, or holds itself")
            if isinstance(each, yaml.MappingNode):
                self._check_twice(each)
            if not each.tag.startswith("tag:yaml.org,2002:") or each.tag.rpartition(":")[2] not in (
                "map", "seq", "str", "int", "float", "bool", "null", "merge",
            ):  # fmt: skip
                raise self._fail(
                    each, f"a value must be a number, a text, true, false, null, a list or a mapping, not {each.tag}"
                )
        try:
            value = self._loader.construct_object(node, deep=True)
        except (yaml.YAMLError, ValueError) as error:
            raise self._fail(node, f"this is no value: {error}") from error
        if isinstance(value, float) and not math.isfinite(value):
            raise self._fail(node, f"a number must be finite, not {value}")
        return value

    def _shown(self, node: yaml.Node) -> str:
        return f"{self._plain(node)!r:.100}"

    def _list(self, node: yaml.Node, what: str) -> list[yaml.Node]:
        if not isinstance(node, yaml.SequenceNode) or not node.value:
            raise self._fail(node, f"{what} must be a list that is not empty, not {self._shown(node)}")
        return list(node.value)

    def _count(self, node: yaml.Node, what: str) -> int:
        value = self._plain(node)
        whole = isinstance(value, (int, float)) and not isinstance(value, bool) and value == int(value)
        if not whole or not 1 <= value < 2**53:
            raise self._fail(node, f"{what} must be a whole number of at least 1, not {value!r}")
        return int(value)

    # ------------------------------------------------ entries

    def _agents(self, node: yaml.Node) -> list[_Agent]:
        algorithms = _algorithms()
        found: list[_Agent] = []
        for name, (key, value) in self._mapping(node, "agents").items():
            if not _AGENT.fullmatch(name):
                raise self._fail(key, f"the name of an agent can have letters, digits, spaces and _.+()-, not {name!r}")
            entries = self._mapping(value, f"agent {name!r}")
            if "algo" not in entries:
                raise self._fail(key, f"agent {name!r} needs algo, one of {', '.join(algorithms)}")
            algo = self._plain(entries["algo"].value)
            if not isinstance(algo, str) or algo not in algorithms:
                raise self._fail(
                    entries["algo"].value,
                    f"algo must be one of {', '.join(algorithms)}, not {algo!r}{_meant(str(algo), algorithms, False)}",
                )
            arguments = {
                argument: self._argument(algo, argument, entry.key, entry.value, f"agent {name!r}")
                for argument, entry in entries.items()
                if argument not in OF_RUN
            }
            data = {each: self._source(entries[each].value, each) for each in DATA if each in entries}
            own_steps = self._count(entries["steps"].value, "steps") if "steps" in entries else None
            same = [other for other in found if _plain(other.name).lower() == _plain(name).lower()]
            if same:
                raise self._fail(key, f"agents {same[0].name!r} and {name!r} would have the same folder: rename one")
            found.append(_Agent(name, algo, arguments, data, own_steps, entries, key))
        if not found:
            raise self._fail(node, "agents must be a mapping that is not empty: a name, then algo and arguments")
        return found

    def _source(self, node: yaml.Node, name: str) -> Any:
        """Data set of all tasks, by ``{task}`` in its name, or of each; or gradient steps on it."""
        if name == "offline_steps":
            return self._count(node, name)
        value = self._plain(node)
        sources = list(value.values()) if isinstance(value, dict) and value else [value]
        if not all(isinstance(each, str) and each for each in sources):
            raise self._fail(node, f"{name} must be a path or an id of Minari's, or such by task, not {value!r:.100}")
        return value

    def _check_data(self, agent: _Agent, steps: int, tasks: list[str]) -> None:
        """Whether an agent can learn from its data so."""
        data, entries = agent.data, agent.entries
        for name in ("dataset", "prior_data"):
            for task in data[name] if isinstance(data.get(name), dict) else ():
                if task not in tasks:
                    raise self._fail(entries[name].value, f"{name} has {task!r}, which is no task of the plan")
        if not any(_has_data_on(data, task) for task in tasks):
            raise self._fail(agent.node, f"agent {agent.name!r} has no task for which all of its data are named")
        algorithm = _algorithms()[agent.algo].algorithm
        if data and not hasattr(algorithm, "learn_offline"):
            raise self._fail(entries[next(iter(data))].key, f"{next(iter(data))} is nothing for {agent.algo}")
        if getattr(algorithm, "learns_from_data_only", False) and data.keys() != {"dataset"}:
            raise self._fail(agent.node, f"agent {agent.name!r}: {agent.algo} learns from a dataset only, and needs it")
        if "offline_steps" in data:
            node = entries["offline_steps"].value
            if "dataset" not in data:
                raise self._fail(node, "offline_steps are gradient steps on a dataset, which the agent needs too")
            if data["offline_steps"] >= steps:
                raise self._fail(
                    node, f"offline_steps must be fewer than the {steps} steps of all, not {data['offline_steps']}"
                )

    def _argument(self, algo: str, name: str, key: yaml.Node, node: yaml.Node, where: str) -> Any:
        known = constructor_arguments(algo)
        if name not in known:
            raise self._fail(key, f"{name!r} of {where} is no argument of {algo}{_meant(name, sorted(known))}")
        value, kind = self._plain(node), known[name].kind
        if kind is not None:
            try:
                check_value(name, constructor_value(name, value), kind)
            except ValueError as error:
                raise self._fail(node, f"{error} ({where})") from error
        return value

    def _grid(self, entries: Mapping[str, _Entry], agents: list[_Agent]) -> dict[str, list[Any]]:
        if "grid" not in entries:
            return {}
        grid: dict[str, list[Any]] = {}
        for name, (key, node) in self._mapping(entries["grid"].value, "grid").items():
            for agent in agents:
                if name in agent.arguments:
                    raise self._fail(
                        key,
                        f"grid crosses {name!r}, which agent {agent.name!r} has fixed at {agent.arguments[name]!r} on "
                        f"line {agent.entries[name].key.start_mark.line + 1}: leave it out of one of the two",
                    )
            values: list[Any] = []
            for each in self._list(node, f"{name!r} of grid"):
                for agent in agents:
                    self._argument(agent.algo, name, key, each, f"grid, for agent {agent.name!r},")
                value = self._plain(each)
                if _key(value) in map(_key, values):
                    raise self._fail(each, f"{name!r} of grid has {value!r} twice: each agent can be there once")
                values.append(value)
            grid[name] = values
        return grid

    def _variants(
        self, agents: list[_Agent], grid: dict[str, list[Any]]
    ) -> Iterator[tuple[_Agent, dict[str, Any], dict[str, Any]]]:
        """Agents with each point of the grid, each of which can be made, and is there once."""
        seen: dict[str, _Agent] = {}
        for agent in agents:
            for values in itertools.product(*grid.values()):
                point = dict(zip(grid, values, strict=True))
                arguments = {**agent.arguments, **point}
                key = _key([agent.algo, _without_defaults(agent.algo, arguments), agent.data, agent.steps])
                first = seen.setdefault(key, agent)
                if first is not agent:
                    line = first.node.start_mark.line + 1
                    raise self._fail(
                        agent.node,
                        f"agent {agent.name!r} is agent {first.name!r} of line {line} once more: an agent can be there "
                        "once",
                    )
                self._check_made(agent, arguments, point)
                yield agent, arguments, point

    def _check_made(self, agent: _Agent, arguments: dict[str, Any], point: dict[str, Any]) -> None:
        if arguments.get("policy", "MlpPolicy") != "MlpPolicy":
            return  # which observations it is for is the task's to say
        if "prior_data" in agent.data:
            # They are read when a run begins; without them their share means nothing.
            arguments = {name: value for name, value in arguments.items() if name != "prior_share"}
        try:
            _make(agent.algo, arguments)
        except (ValueError, TypeError, AssertionError) as error:
            where = f" with {', '.join(f'{k}={v!r}' for k, v in point.items())} of grid" if point else ""
            raise self._fail(agent.node, f"agent {agent.name!r}{where} cannot be made: {error}") from error

    def _check_measured(self, node: yaml.Node, agents: list[_Agent]) -> None:
        """The noise scale is of the critics of the off-policy family."""
        from sb3_sample.sac import SAC

        for agent in agents:
            if not issubclass(_algorithms()[agent.algo].algorithm, SAC):
                raise self._fail(
                    node, f"measure is of off-policy agents, and {agent.name!r} is {agent.algo}: leave it out"
                )

    def _groups(self, entries: Mapping[str, _Entry], tasks: list[str]) -> dict[str, list[str]]:
        if "groups" not in entries:
            return {}
        groups = {}
        for name, (key, node) in self._mapping(entries["groups"].value, "groups").items():
            groups[name] = self._tasks(node)
            if others := [task for task in groups[name] if task not in tasks]:
                raise self._fail(key, f"group {name!r} has {others[0]!r}, which is no task of the plan")
        return groups

    def _factors(
        self, entries: Mapping[str, _Entry], agents: list[_Agent], grid: dict[str, list[Any]]
    ) -> dict[str, list[str]]:
        if "factors" not in entries:
            return {}
        allowed = list(dict.fromkeys(("agent", *grid, *(name for agent in agents for name in agent.arguments))))
        factors: dict[str, list[str]] = {}
        for name, (_, node) in self._mapping(entries["factors"].value, "factors").items():
            factors[name] = []
            for each in self._list(node, f"factor {name!r}"):
                argument = self._plain(each)
                if not isinstance(argument, str) or argument.partition(".")[0] not in allowed:
                    raise self._fail(
                        each,
                        f"factor {name!r} must be of agent and the arguments of the grid and of the agents, not "
                        f"{argument!r}{_meant(str(argument), allowed)}",
                    )
                factors[name].append(argument)
        return factors

    def _tasks(self, node: yaml.Node) -> list[str]:
        found: dict[str, None] = {}
        written: dict[str, yaml.Node] = {}
        for each in self._list(node, "tasks"):
            name = self._plain(each)
            if not isinstance(name, str):
                raise self._fail(each, f"a task must be the id of an environment or the name of a suite, not {name!r}")
            if name in written:
                line = written[name].start_mark.line + 1
                raise self._fail(each, f"task {name!r} is there twice: once on line {line}. Each can be there once")
            written[name] = each
            if is_atari_id(name):
                try:
                    register_atari()
                except ImportError as error:
                    raise self._fail(each, str(error)) from error
            suite = SUITES.get(name.upper().replace("-", "_"))
            if suite is None and name not in gym.registry:
                close = difflib.get_close_matches(name, [*gym.registry, *SUITES], 5, 0.5)
                raise self._fail(
                    each,
                    f"{name!r} is neither the id of a registered environment nor a suite"
                    + (f"; close are {', '.join(close)}" if close else "")
                    + f". Suites are {', '.join(SUITES)}; ids are those of sb3_sample.envs.ALL_IDS, Gymnasium's and "
                    "those of gym_packages",
                )
            found |= dict.fromkeys(suite or (name,))
        return list(found)

    def _seeds(self, node: yaml.Node) -> list[int]:
        if isinstance(node, yaml.ScalarNode):
            return list(range(self._count(node, "seeds, if it is how many,")))
        seeds: list[int] = []
        for each in self._list(node, "seeds"):
            seed = self._plain(each)
            if type(seed) is not int or not 0 <= seed < 2**32 - 1:
                raise self._fail(each, f"a seed must be a whole number from 0 to {2**32 - 2}, not {seed!r}")
            if seed in seeds:
                raise self._fail(each, f"seed {seed} is there twice: each can be there once")
            seeds.append(seed)
        return seeds

    def _evaluation(self, entries: Mapping[str, _Entry], steps: int) -> tuple[int, int]:
        found = {"every": EVERY, "episodes": EPISODES}
        where = entries["steps"].value
        if "evaluation" in entries:
            where = entries["evaluation"].value
            for name, (key, value) in self._mapping(where, "evaluation").items():
                if name not in found:
                    raise self._fail(key, f"{name!r} is no entry of evaluation{_meant(name, found)}")
                found[name] = self._count(value, f"{name} of evaluation")
        if found["every"] > steps:
            raise self._fail(
                where,
                f"an evaluation every {found['every']:,} steps is none in {steps:,}: evaluation needs an every of at "
                "most steps",
            )
        return found["every"], found["episodes"]

    def _env_kwargs(self, entries: Mapping[str, _Entry], tasks: list[str]) -> dict[str, Any]:
        if "env_kwargs" not in entries:
            return {}
        given = self._mapping(entries["env_kwargs"].value, "env_kwargs")
        for suite, task in {task.partition("/")[0]: task for task in reversed(tasks)}.items():
            allowed = _env_arguments(suite, task)
            for name, (key, _) in given.items():
                if allowed is not None and name not in allowed:
                    raise self._fail(key, f"{name!r} of env_kwargs is no argument of {task}{_meant(name, allowed)}")
        return {name: self._plain(value) for name, (_, value) in given.items()}

    def _packages(self, entries: Mapping[str, _Entry]) -> tuple[str, ...]:
        if "gym_packages" not in entries:
            return ()
        names = []
        for node in self._list(entries["gym_packages"].value, "gym_packages"):
            name = self._plain(node)
            try:
                importlib.import_module(name)
            except (ImportError, AttributeError, TypeError, ValueError) as error:
                raise self._fail(
                    node, f"gym_packages must name modules that can be imported, not {name!r}: {error}"
                ) from error
            names.append(name)
        return tuple(names)


def _nodes(node: yaml.Node) -> Iterator[yaml.Node]:
    """A node and all below it. Without an end where one holds itself."""
    waiting = deque([node])
    while waiting:
        yield (each := waiting.popleft())
        if isinstance(each, yaml.CollectionNode):
            for child in each.value:
                waiting.extend(child if isinstance(child, tuple) else (child,))


def _key(value: Any) -> str:
    """Equal for equal values: 1 is 1.0, and True is not 1."""
    return json.dumps(_with_floats(value), sort_keys=True)


def _with_floats(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _with_floats(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_with_floats(each) for each in value]
    return float(value) if type(value) is int and abs(value) < 2**53 else value


def _without_defaults(algo: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments less those that are there anyway, since the settings of no task name them."""
    known, settings = constructor_arguments(algo), _settings(algo).values()
    named = {name for entry in settings for name in entry or ()}
    return {
        name: value
        for name, value in arguments.items()
        if name in named
        or not isinstance(known[name].default, (bool, int, float, str, type(None)))
        or _key(value) != _key(known[name].default)
    }


@functools.cache
def _settings(algo: str) -> dict[str, Any]:
    """Content of ``hyperparams/<algo>.yml``, by task."""
    from sb3_sample.zoo import HYPERPARAMS

    found: dict[str, Any] = yaml.safe_load((HYPERPARAMS / f"{algo}.yml").read_text())
    return found


def _env_arguments(suite: str, task: str) -> list[str] | None:
    """Arguments of a task of this package's; None of another, which is not known before it is made."""
    made = {"dmc": "DMCEnv", "metaworld": "MetaWorldEnv", "myosuite": "MyoSuiteEnv"}.get(suite)
    if made is None:
        return None
    known = inspect.signature(getattr(importlib.import_module(f"sb3_sample.envs.{suite}"), made)).parameters
    return [*(name for name in known if name not in gym.spec(task).kwargs), *_OF_MAKE]


def _meant(name: str, allowed: Collection[str], lists: bool = True) -> str:
    close = difflib.get_close_matches(name, allowed, 1)
    return (f"; did you mean {close[0]!r}?" if close else "") + (
        f" Allowed are {', '.join(allowed)}"
        if lists and close
        else f". Allowed are {', '.join(allowed)}"
        if lists
        else ""
    )


# ---------------------------------------------------------------- algorithms


def _algorithms() -> dict[str, Any]:
    """The algorithms by their names. Imported here: a study that is only looked at needs no zoo."""
    from sb3_sample.zoo import ALGORITHMS

    return ALGORITHMS


def constructor_arguments(algo: str) -> dict[str, Any]:
    """
    :param algo: name of an algorithm
    :return: by name, the arguments of its constructor that an agent of a plan may have
    """
    declared = _algorithms()[algo].algorithm.constructor_arguments
    return {name: argument for name, argument in declared.items() if name not in NOT_OF_AGENTS}


def constructor_value(name: str, value: Any) -> Any:
    """
    :param name: of an argument
    :param value: as a plan has it
    :return: the value for the constructor: a replay buffer of this package by its name, all else as it is
    """
    from sb3_sample.zoo.algorithms import BUFFERS

    return BUFFERS.get(value, value) if name == "replay_buffer_class" and isinstance(value, str) else value


def _make(algo: str, arguments: dict[str, Any]) -> None:
    """
    Make an agent, on a small task and with the settings of ``hyperparams/<algo>.yml``, to have its arguments checked
    together.

    :raises ValueError: they do not go together, or one is out of range; a ``TypeError`` where they are of another kind
    """
    from rl_zoo3.exp_manager import ExperimentManager

    arguments = {name: constructor_value(name, value) for name, value in arguments.items()}
    known = constructor_arguments(algo)
    entries = _settings(algo)
    default = entries.get("default") or entries["atari"]
    settings = {name: value for name, value in default.items() if name in known and not isinstance(value, str)}
    settings = ExperimentManager._preprocess_schedules({**settings, **arguments})
    algorithm: Any = _algorithms()[algo].algorithm
    on: dict[str, Any] = {"policy": "MlpPolicy", "env": "Pendulum-v1"}
    if "MlpPolicy" not in algorithm.policy_aliases:
        # From pictures alone, of which hardly anything is stored here.
        size, actions = (3, 64, 64), cast("spaces.Space[Any]", spaces.Box(-1, 1, (1,), np.float32))
        if not hasattr(algorithm, "learn_offline"):  # that of Atari's games
            size, actions = (4, 84, 84), spaces.Discrete(3)
        on = {"policy": "CnnPolicy", "env": NoEnvironment(spaces.Box(0, 255, size, np.uint8), actions)}
        settings = {**settings, "buffer_size": 1_000}
    algorithm(**{**on, "device": "cpu", **settings})
