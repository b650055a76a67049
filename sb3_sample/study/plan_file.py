"""
Plans of studies as YAML files.

A plan has agents (an algorithm and arguments), tasks, seeds, steps, an evaluation and a grid of arguments. All of it is
checked before anything runs, and an error names file, line and allowed values.
"""

import difflib
import importlib
import inspect
import itertools
import math
import re
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import yaml
from gymnasium import spaces

from sb3_sample.envs.registration import is_atari_id, register_atari
from sb3_sample.envs.suites import SUITES
from sb3_sample.kinds import check_value
from sb3_sample.shallow_yaml import ShallowLoader
from sb3_sample.study.plan import (
    AGENT_NAME,
    CHECKPOINT_FREQ,
    DATA,
    EPISODES,
    EVERY,
    Comparison,
    Plan,
    PlanError,
    Run,
)
from sb3_sample.study.trial_agents import (
    action_space,
    algorithms,
    constructor_arguments,
    constructor_value,
    make,
    settings_of,
    why_not_acting,
)
from sb3_sample.study_list import part_of_path, short, to_json

#: Entries of a plan; those after the first four have defaults.
ENTRIES = (
    "agents", "tasks", "seeds", "steps", "evaluation", "grid", "checkpoint_freq", "env_kwargs", "gym_packages",
    "groups", "factors", "measure", "diagnostics",
)  # fmt: skip
REQUIRED = ENTRIES[:4]
#: Entries of an agent besides its arguments.
OF_RUN = ("algo", "steps", *DATA)
#: Placeholder in a data set's name for the task, as a part of a path.
TASK = "{task}"
#: Most characters of a plan.
MAX_PLAN = 2**20
#: Most values in one entry, where an alias counts as its content.
MAX_VALUES = 10_000
#: Arguments of ``gymnasium.make`` itself, for every environment.
_OF_MAKE = ("max_episode_steps", "disable_env_checker")
_EXPONENT = re.compile(r"[-+]?(\d[\d_]*)(\.\d*)?[eE][-+]?\d+$")


def read_plan(path: str | Path) -> Plan:
    """
    Read and check a plan.

    :param path: of the YAML file
    :return: the plan, named after the file
    :raises PlanError: (a ``ValueError``) it cannot be read or cannot be run; the message names file, line and allowed
        values
    :raises ImportError: the zoo's commands are not installed
    """
    return _Reader(Path(path)).read()


class _Loader(ShallowLoader):
    """Loader of plain values; ``1e6`` is a number, as everywhere except in YAML 1.1."""

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


class _Variant(NamedTuple):
    """An agent at a point of the grid, and the action space with which it was made on trial."""

    agent: _Agent
    arguments: dict[str, Any]
    point: dict[str, Any]
    made_on: "spaces.Space[Any]"


class _Reader:
    def __init__(self, path: Path):
        self._path = path
        #: Mappings already checked for equal keys, before reading adds the keys that they merge.
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
        measured = {n: self._count(entries[n].value, n) for n in ("measure", "diagnostics") if n in entries}
        env_kwargs = self._env_kwargs(entries, tasks)
        for agent in agents:
            self._check_data(agent, agent.steps or steps, tasks)
        variants = list(self._variants(agents, grid))
        self._check_actions(variants, tasks, env_kwargs)
        for name, count in measured.items():
            self._check_measured(name, count, steps, entries[name].value, agents)
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
                data=_data_on(agent.data, task),
                **measured,
            )
            for seed in seeds
            for task in tasks
            for agent, arguments, point, _ in variants
            if _has_data_on(agent.data, task)
        )
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
        """Reject equal keys, of which YAML's reader would silently keep the last."""
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
        known = algorithms()
        found: list[_Agent] = []
        for name, (key, value) in self._mapping(node, "agents").items():
            if not AGENT_NAME.fullmatch(name):
                raise self._fail(key, f"the name of an agent can have letters, digits, spaces and _.+()-, not {name!r}")
            entries = self._mapping(value, f"agent {name!r}")
            if "algo" not in entries:
                raise self._fail(key, f"agent {name!r} needs algo, one of {', '.join(known)}")
            algo = self._plain(entries["algo"].value)
            if not isinstance(algo, str) or algo not in known:
                raise self._fail(
                    entries["algo"].value,
                    f"algo must be one of {', '.join(known)}, not {algo!r}{_meant(str(algo), known, False)}",
                )
            arguments = {
                argument: self._argument(algo, argument, entry.key, entry.value, f"agent {name!r}")
                for argument, entry in entries.items()
                if argument not in OF_RUN
            }
            data = {each: self._source(entries[each].value, each) for each in DATA if each in entries}
            own_steps = self._count(entries["steps"].value, "steps") if "steps" in entries else None
            same = [other for other in found if part_of_path(other.name).lower() == part_of_path(name).lower()]
            if same:
                raise self._fail(key, f"agents {same[0].name!r} and {name!r} would have the same folder: rename one")
            found.append(_Agent(name, algo, arguments, data, own_steps, entries, key))
        if not found:
            raise self._fail(node, "agents must be a mapping that is not empty: a name, then algo and arguments")
        return found

    def _source(self, node: yaml.Node, name: str) -> Any:
        """Data set for all tasks, with ``{task}`` in its name, or for each task; or number of gradient steps on it."""
        if name == "offline_steps":
            return self._count(node, name)
        value = self._plain(node)
        sources = list(value.values()) if isinstance(value, dict) and value else [value]
        if not all(isinstance(each, str) and each for each in sources):
            raise self._fail(node, f"{name} must be a path or an id of Minari's, or such by task, not {value!r:.100}")
        return value

    def _check_data(self, agent: _Agent, steps: int, tasks: list[str]) -> None:
        """Check that an agent can learn from its data in this way."""
        data, entries = agent.data, agent.entries
        for name in ("dataset", "prior_data"):
            for task in data[name] if isinstance(data.get(name), dict) else ():
                if task not in tasks:
                    raise self._fail(entries[name].value, f"{name} has {task!r}, which is no task of the plan")
        if not any(_has_data_on(data, task) for task in tasks):
            raise self._fail(agent.node, f"agent {agent.name!r} has no task for which all of its data are named")
        algorithm = algorithms()[agent.algo].algorithm
        if data and not getattr(algorithm, "learns_from_data", False):
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
                if to_json(value) in map(to_json, values):
                    raise self._fail(each, f"{name!r} of grid has {value!r} twice: each agent can be there once")
                for other in values:
                    if part_of_path(short(other)).lower() == part_of_path(short(value)).lower():
                        raise self._fail(
                            each,
                            f"{name!r} of grid has {other!r} and {value!r}, whose runs would have the same folder: "
                            "make them two agents with names of their own",
                        )
                values.append(value)
            grid[name] = values
        return grid

    def _variants(self, agents: list[_Agent], grid: dict[str, list[Any]]) -> Iterator[_Variant]:
        """
        Agents with each point of the grid, checked to be possible and without repeats; and the action space with which
        each was made.
        """
        seen: dict[str, _Agent] = {}
        for agent in agents:
            for values in itertools.product(*grid.values()):
                point = dict(zip(grid, values, strict=True))
                arguments = {**agent.arguments, **point}
                key = to_json([agent.algo, _without_defaults(agent.algo, arguments), agent.data, agent.steps])
                first = seen.setdefault(key, agent)
                if first is not agent:
                    line = first.node.start_mark.line + 1
                    raise self._fail(
                        agent.node,
                        f"agent {agent.name!r} is agent {first.name!r} of line {line} once more: an agent can be there "
                        "once",
                    )
                yield _Variant(agent, arguments, point, self._made_on(agent, arguments, point))

    def _made_on(self, agent: _Agent, arguments: dict[str, Any], point: dict[str, Any]) -> "spaces.Space[Any]":
        try:
            return make(agent.algo, arguments, has_prior_data="prior_data" in agent.data)
        except (ValueError, TypeError, AssertionError) as error:
            where = f" with {', '.join(f'{k}={v!r}' for k, v in point.items())} of grid" if point else ""
            raise self._fail(agent.node, f"agent {agent.name!r}{where} cannot be made: {error}") from error

    def _check_actions(
        self,
        variants: list[_Variant],
        tasks: list[str],
        env_kwargs: dict[str, Any],
    ) -> None:
        """Check that each agent supports the action spaces of its tasks."""
        of_tasks = {task: action_space(task, env_kwargs) for task in tasks}
        for agent, arguments, _, made_on in variants:
            tried = set()
            for task, actions in of_tasks.items():
                if actions is None or repr(actions) in tried or not _has_data_on(agent.data, task):
                    continue
                tried.add(repr(actions))
                has_prior_data = "prior_data" in agent.data
                if why := why_not_acting(agent.algo, arguments, actions, made_on, has_prior_data):
                    raise self._fail(agent.node, f"agent {agent.name!r} cannot act in task {task!r}: {why}")

    def _check_measured(self, name: str, every: int, steps: int, node: yaml.Node, agents: list[_Agent]) -> None:
        """
        Check that all agents are of the off-policy family, whose networks the measurements need, and that one of them
        acts in an environment for so long.
        """
        from sb3_sample.sac import SAC

        for agent in agents:
            if not issubclass(algorithms()[agent.algo].algorithm, SAC):
                raise self._fail(
                    node, f"{name} is of off-policy agents, and {agent.name!r} is {agent.algo}: leave it out"
                )
        acting = [agent for agent in agents if "dataset" not in agent.data or "offline_steps" in agent.data]
        most = max((agent.steps or steps for agent in acting), default=0)
        if every > most:
            raise self._fail(node, f"{name} every {every:,} steps is none in the {most:,} of an agent's environment")

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


def _has_data_on(data: Mapping[str, Any], task: str) -> bool:
    """Check whether a task has a data set in each entry that names them by task."""
    return all(task in value for value in data.values() if isinstance(value, dict))


def _data_on(data: Mapping[str, Any], task: str) -> dict[str, Any]:
    """The data of a task."""
    chosen = {name: value[task] if isinstance(value, dict) else value for name, value in data.items()}
    return {
        name: value.replace(TASK, part_of_path(task)) if isinstance(value, str) else value
        for name, value in chosen.items()
    }


def _nodes(node: yaml.Node) -> Iterator[yaml.Node]:
    """A node and all nodes below it; endless if a node contains itself."""
    waiting = deque([node])
    while waiting:
        yield (each := waiting.popleft())
        if isinstance(each, yaml.CollectionNode):
            for child in each.value:
                waiting.extend(child if isinstance(child, tuple) else (child,))


def _without_defaults(algo: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments without those at their defaults, unless the settings of a task name them."""
    known, settings = constructor_arguments(algo), settings_of(algo).values()
    named = {name for entry in settings for name in entry or ()}
    return {
        name: value
        for name, value in arguments.items()
        if name in named
        or not isinstance(known[name].default, (bool, int, float, str, type(None)))
        or to_json(value) != to_json(known[name].default)
    }


def _env_arguments(suite: str, task: str) -> list[str] | None:
    """Arguments of a task of this package; None for other tasks, whose arguments are unknown before they are made."""
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
