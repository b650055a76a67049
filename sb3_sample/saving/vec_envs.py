"""
The state of vectorised environments: of their wrappers, and of each environment, in this process or in a worker.

Stable-Baselines3's workers answer a fixed set of questions. One of them, whether an environment is wrapped in a class,
calls ``isinstance`` on each wrapper, which a class may answer itself (``__instancecheck__``): :class:`_Attach` reaches
the environment in this way and puts a helper into it, whose methods ``env_method`` then calls. Between processes,
values are pickled, as always in Stable-Baselines3; in files they are not.
"""

import contextlib
import random
import signal
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, VecNormalize

from sb3_sample.envs.portable_states import HELPER, pack, pack_all, unpack, unpack_all
from sb3_sample.envs.workers import EnvironmentDied, SupervisedSubprocVecEnv
from sb3_sample.learner.randomness import checked_state
from sb3_sample.saving.attributes import Describer, DoesNotFit, Restorer, class_name
from sb3_sample.saving.statistics import ARGUMENTS, check_normalization, shapes_of
from sb3_sample.warn import warn

#: Attributes of wrappers that are not saved: references to other objects, arguments, and clocks, which count from the
#: creation of the wrapper.
_SKIPPED = (
    "venv", "class_attributes", "observation_space", "action_space", "num_envs", "render_mode", "metadata",
    "reset_infos", "_seeds", "_options", "t_start",
)  # fmt: skip

#: Errors by which a worker shows that it is gone.
_GONE = (EnvironmentDied, EOFError, OSError)


class _Helper:
    """
    Object put into an environment of another process.

    :param env: the environment
    """

    def __init__(self, env: gym.Env):
        self._env = env
        self._sigint: Any = None

    def pack(self) -> tuple[dict[str, Any], list[str]]:
        state, opaque = pack(self._env)
        # The generators of this process, which nothing else saves.
        return {**state, "generators": _global_generators()}, opaque

    def unpack(self, state: dict[str, Any]) -> tuple[str, str] | None:
        # An exception would end the worker.
        try:
            unpack(self._env, state)
            # Checkpoints of earlier versions, and of environments in the training's process, have none.
            if "generators" in state:
                _restore_global_generators(state["generators"])
        except DoesNotFit as error:
            return "does not fit", str(error)
        except Exception as error:
            return "is damaged", f"{type(error).__name__}: {error!s:.500}"
        return None

    def spec(self) -> list[str]:
        return describe_spec(self._env)

    def ignore_sigint(self, ignored: bool) -> None:
        """
        Ignore SIGINT, or stop ignoring it: a terminal's Ctrl-C goes to every process, and a worker that ends by it
        takes the training down.
        """
        if ignored and self._sigint is None:
            self._sigint = signal.signal(signal.SIGINT, signal.SIG_IGN)
        elif not ignored and self._sigint is not None:
            signal.signal(signal.SIGINT, self._sigint)
            self._sigint = None

    def __call__(self, method: str, *args: Any) -> Any:
        return getattr(self, method)(*args)


def _global_generators() -> dict[str, Any]:
    """The generators of this process, as objects that are written in few bytes."""
    python, numpy = random.Random(), np.random.RandomState()
    python.setstate(random.getstate())
    numpy.set_state(np.random.get_state())  # noqa: NPY002  # the one that environments draw from
    return {"python": python, "numpy": numpy, "torch": torch.get_rng_state()}


def _restore_global_generators(state: Any) -> None:
    kinds = {"python": random.Random, "numpy": np.random.RandomState, "torch": torch.Tensor}
    if not isinstance(state, dict) or {name: type(value) for name, value in state.items()} != kinds:
        raise DoesNotFit("the generators of a worker are not described as they must be")
    try:
        torch.set_rng_state(checked_state(state["torch"], "its state"))
    except ValueError as error:
        raise DoesNotFit(f"the state of torch's generator in a worker is none: {error}") from error
    random.setstate(state["python"].getstate())
    np.random.set_state(state["numpy"].get_state())  # noqa: NPY002


class _AttachType(type):
    def __instancecheck__(cls, env: Any) -> bool:
        if HELPER not in vars(env):
            setattr(env, HELPER, _Helper(env))
        return True  # The outermost wrapper is enough.


class _Attach(metaclass=_AttachType):
    """Checking whether an environment is wrapped in this class puts a helper into it, and is always true."""


def describe_spec(env: gym.Env) -> list[str]:
    """
    :param env: an environment
    :return: its layers, outermost first, and the id and arguments that it was made with, if Gymnasium made it
    """
    layers, inner = [], env
    while isinstance(inner, gym.Wrapper):
        layers.append(class_name(inner))
        inner = inner.env
    layers.append(class_name(inner))
    if env.spec is not None:
        kwargs = {name: _shown(value) for name, value in sorted(env.spec.kwargs.items())}
        layers.append(f"{env.spec.id}, max_episode_steps={env.spec.max_episode_steps}, {kwargs}")
    return layers


def _shown(value: Any) -> str:
    """A value as a text that is the same in every process: without memory addresses."""
    if isinstance(value, dict):
        return str({str(key): _shown(item) for key, item in value.items()})
    if isinstance(value, (list, tuple)):
        return str([_shown(item) for item in value])
    if isinstance(value, np.ndarray):
        return str(value.tolist())
    return repr(value) if isinstance(value, (str, int, float, bool, np.generic, type(None))) else class_name(value)


def _wrappers(venv: VecEnv) -> Iterator[VecEnvWrapper]:
    while isinstance(venv, VecEnvWrapper):
        yield venv
        venv = venv.venv


def call(venv: VecEnv, method: str, each: list[Any] | None = None) -> list[Any] | None:
    """
    Call a method of the helper of each environment.

    :param venv: a vectorised environment
    :param method: name
    :param each: an argument for each environment; none if None
    :return: the answers; None if the environments cannot be reached
    """
    innermost = venv.unwrapped
    arguments: list[tuple[Any, ...]] = [() if each is None else (each[i],) for i in range(innermost.num_envs)]
    if isinstance(innermost, DummyVecEnv):
        # A fresh helper, so that nothing is left in environments of this process.
        return [_Helper(env)(method, *args) for env, args in zip(innermost.envs, arguments, strict=True)]
    if not isinstance(innermost, SubprocVecEnv) or not all(innermost.env_is_wrapped(_Attach)):  # type: ignore[arg-type]
        return None
    return [innermost.env_method(HELPER, method, *args, indices=i)[0] for i, args in enumerate(arguments)]


def fingerprint(venv: VecEnv) -> dict[str, Any]:
    """
    :param venv: a vectorised environment
    :return: what it is made of, as plain values by name
    :raises ValueError: if a ``VecNormalize`` has settings with which no training could resume
    """
    made: dict[str, Any] = {"n_envs": venv.num_envs, "wrappers": [class_name(wrapper) for wrapper in _wrappers(venv)]}
    for wrapper in _wrappers(venv):
        if isinstance(wrapper, VecNormalize):
            check_normalization(vars(wrapper), "env")
        if class_name(wrapper).endswith(".VecNormalize"):
            made["VecNormalize"] = {name: getattr(wrapper, name) for name in ARGUMENTS}
    specs = call(venv, "spec")
    if specs is not None:
        made["environments"] = specs
    return made


def save(venv: VecEnv) -> tuple[dict[str, Any], list[str]]:
    """
    :param venv: a vectorised environment, between two steps
    :return: its state, as plain values; and the reasons, if any, why it lacks the episodes in progress
    """
    innermost = venv.unwrapped
    missing: list[str] = []
    describer = Describer([innermost, *_wrappers(venv)], whole=True)
    wrappers = []
    for wrapper in _wrappers(venv):
        attributes, opaque = describer.attributes(wrapper, _SKIPPED)
        wrappers.append({"class": class_name(wrapper), "attributes": attributes})
        missing += [f"{type(wrapper).__name__}: {what}" for what in opaque]
    classes, opaque = describer.classes()
    missing += [*opaque, *describer.finish()]
    state: dict[str, Any] = {
        "wrappers": wrappers,
        "classes": classes,
        "seeds": list(innermost._seeds),
        "options": list(innermost._options),
        "environments": None,
        # Last observations, which end a worker's episode if it dies.
        "last": innermost.last_observations if isinstance(innermost, SupervisedSubprocVecEnv) else None,
    }
    try:
        packed, opaque = _pack(innermost)
    except _GONE as error:
        if not isinstance(innermost, SubprocVecEnv):
            raise
        # The next step or reset raises the error, or replaces the worker.
        missing.append(f"a worker does not answer ({type(error).__name__}: {error})")
        return state, missing
    if packed is None:
        kind = class_name(innermost)
        reason = "an environment in a worker needs a wrapper, such as Monitor, to be reached"
        missing.append(reason if isinstance(innermost, SubprocVecEnv) else f"{kind} is not known")
    else:
        missing += sorted(set(opaque))
        if not missing:
            state["environments"] = packed
    return state, missing


def _pack(innermost: VecEnv) -> tuple[list[dict[str, Any]] | None, list[str]]:
    """The states of the environments, and what is not in them; None if they cannot be reached."""
    if isinstance(innermost, DummyVecEnv):
        return pack_all(innermost.envs)
    answers = call(innermost, "pack")
    if answers is None:
        return None, []
    return [state for state, _ in answers], [what for _, opaque in answers for what in opaque]


def _unpack(innermost: VecEnv, states: list[dict[str, Any]]) -> list[str]:
    """Restore the environments; return the reasons why the states do not fit, if any."""
    if isinstance(innermost, DummyVecEnv):
        try:
            unpack_all(innermost.envs, states)
        except DoesNotFit as error:
            return [str(error)]
        return []
    answers = call(innermost, "unpack", states)
    if answers is None:
        return [f"{class_name(innermost)} cannot be reached"]
    for answer in answers:
        if answer is not None and answer[0] == "is damaged":
            raise ValueError(f"the state of an environment is none: {answer[1]}")
    # Most workers give the same reason.
    return list(dict.fromkeys(answer[1] for answer in answers if answer is not None))


def restore(venv: VecEnv, state: dict[str, Any]) -> list[str]:
    """
    Restore a saved state. If it lacks the episodes in progress, or they do not fit, the caller has to reset.

    :param venv: a vectorised environment made like the saved one
    :param state: from :func:`save`
    :return: why the episodes in progress were not restored; nothing if they were
    :raises DoesNotFit: the wrappers differ
    """
    innermost = venv.unwrapped
    wrappers = list(_wrappers(venv))
    ours, theirs = [class_name(wrapper) for wrapper in wrappers], [saved["class"] for saved in state["wrappers"]]
    if ours != theirs:
        raise DoesNotFit(f"the environment is wrapped in {ours}, the saved one in {theirs}")
    restorer = Restorer([innermost, *wrappers])
    for wrapper, saved in zip(wrappers, state["wrappers"], strict=True):
        before = _shapes(wrapper)
        restorer.attributes(wrapper, saved["attributes"], _SKIPPED)
        if isinstance(wrapper, VecNormalize):
            check_normalization(vars(wrapper), "the checkpoint")
            if _shapes(wrapper) != before:
                raise DoesNotFit(f"the statistics of VecNormalize are of the shapes {_shapes(wrapper)}, not {before}")
    restorer.classes(state.get("classes", {}))
    if restorer.kept:
        warn(f"{', '.join(restorer.kept)} of the checkpoint name other files, and stay as they are")
    if isinstance(innermost, SupervisedSubprocVecEnv) and state.get("last") is not None:
        innermost.last_observations = list(state["last"])
    innermost._seeds, innermost._options = _for_the_next_reset(state, innermost.num_envs)
    if state["environments"] is None:
        return ["they are not in the checkpoint"]
    return _unpack(innermost, state["environments"])


def _shapes(wrapper: VecEnvWrapper) -> list[Any]:
    """The shapes of the statistics of a VecNormalize; empty for another wrapper."""
    if not isinstance(wrapper, VecNormalize):
        return []
    return [shapes_of(getattr(wrapper, name, None), name) for name in ("obs_rms", "ret_rms")]


def _for_the_next_reset(state: dict[str, Any], n_envs: int) -> tuple[list[Any], list[Any]]:
    """Seeds and options that the next reset of each environment gets."""
    seeds, options = state["seeds"], state["options"]
    for name, values, kind in (("seeds", seeds, int), ("options", options, dict)):
        of_kind = isinstance(values, list) and all(value is None or type(value) is kind for value in values)
        if not of_kind or len(values) != n_envs:
            raise DoesNotFit(f"the {name} of {n_envs} environments cannot be {values!r:.100}")
    return list(seeds), list(options)


def set_sigint_ignored(venv: VecEnv, ignored: bool) -> None:
    """
    Set whether the workers of a vectorised environment ignore SIGINT. An environment without workers, or that cannot be
    reached, stays as it is: a dead worker is reported by the next step, and one in its place ignores SIGINT.

    :param venv: a vectorised environment
    :param ignored: whether they ignore it
    """
    if isinstance(venv.unwrapped, SubprocVecEnv):
        with contextlib.suppress(*_GONE):
            call(venv, "ignore_sigint", [ignored] * venv.num_envs)
