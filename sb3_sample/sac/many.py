"""``train_many``: the same training with many seeds, in one process."""

import copy
import functools
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback, EvalCallback
from stable_baselines3.common.env_util import is_wrapped, make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_sample.envs.identities import identities
from sb3_sample.faults import TrainingDiverged
from sb3_sample.kinds import SEED, check_value, integer
from sb3_sample.lockstep import Group, Seat
from sb3_sample.sac.algorithm import SAC
from sb3_sample.saving.checkpoint import CHECKPOINT_FREQ
from sb3_sample.saving.interrupts import Interrupts
from sb3_sample.training.seats import all_made, joint_of
from sb3_sample.warn import warn

Agent = TypeVar("Agent", bound=SAC)

#: Evaluations: episodes of each, and environment steps between two.
EPISODES, EVAL_FREQ = 5, 10_000


def train_many(
    cls: type[Agent],
    policy: Any,
    env: str | Callable[[], GymEnv],
    *,
    seeds: Iterable[int],
    total_timesteps: int,
    per_learner: Mapping[str, Sequence[Any]] | None = None,
    callback: Callable[[int], MaybeCallback] | None = None,
    log_interval: int = 4,
    checkpoint: str | Path | None = None,
    checkpoint_freq: int = CHECKPOINT_FREQ,
    eval_env: str | Callable[[], GymEnv] | None = None,
    eval_freq: int = EVAL_FREQ,
    n_eval_episodes: int = EPISODES,
    n_envs: int = 1,
    vec_env_cls: type[VecEnv] | None = None,
    **arguments: Any,
) -> list[Agent]:
    """
    Train many learners in one process, one per seed, in lockstep (docs/many_learners.md). Each training equals
    ``cls(policy, env, seed=seed, **arguments).learn(total_timesteps)`` alone, with its own environments, replay, random
    numbers, log, evaluations and checkpoints; gradient steps are taken together where that pays.

    A learner that diverges is stopped, named in a warning when that happens and again at the end, and returned as it
    was then; the other learners continue. After any other error, the other learners save their checkpoints, if they
    have any, and the error is raised.

    :param cls: class of an off-policy algorithm of this package
    :param policy: as for ``cls``
    :param env: id of the environment, or a function without arguments that makes an environment or a vectorised one
    :param seeds: the learners' seeds
    :param total_timesteps: environment steps of each learner
    :param per_learner: arguments of ``cls`` that differ by learner: for each, a list in the order of the seeds
    :param callback: function of a learner's index that makes its callback
    :param log_interval: as for ``learn``
    :param checkpoint: folder of all runs, in which each learner has a run folder, ``seed-3`` and so on; None for no
        checkpoints. The same program, started again, resumes all of them
    :param checkpoint_freq: environment steps of each learner between two of its checkpoints
    :param eval_env: environment of evaluations, given like ``env``; None for no evaluations. With a ``checkpoint`` they
        are written to each run's folder (``evaluations.npz``)
    :param eval_freq: environment steps of each learner between two evaluations
    :param n_eval_episodes: episodes of an evaluation
    :param n_envs: environments of each learner
    :param vec_env_cls: class of the learners' vectorised environments, such as ``SupervisedSubprocVecEnv``, whose
        workers all step at the same time; in this process if None
    :param arguments: of ``cls``, the same for all learners; an ``action_noise`` is copied for each
    :return: the trained models, in the order of the seeds
    :raises ValueError: if an argument is out of range, contradicts another, or is of what cannot be trained so
    :raises TypeError: if ``cls`` has no such argument
    """
    _check_class(cls)
    _check_arguments(cls, arguments)
    names = _checked_seeds(seeds)
    for name, value in (("env", env), ("eval_env", eval_env)):
        _check_env(name, value)
    check_value("n_envs", n_envs, integer(1))
    check_value("eval_freq", eval_freq, integer(1))
    check_value("n_eval_episodes", n_eval_episodes, integer(1))
    if eval_env is None and (eval_freq, n_eval_episodes) != (EVAL_FREQ, EPISODES):
        raise ValueError("eval_freq and n_eval_episodes mean nothing without eval_env: pass it too, or leave them out")
    if not (vec_env_cls is None or (isinstance(vec_env_cls, type) and issubclass(vec_env_cls, VecEnv))):
        raise ValueError(f"vec_env_cls must be a class of vectorised environments, or None, not {vec_env_cls!r}")
    if isinstance(callback, BaseCallback) or not (callback is None or callable(callback)):
        raise ValueError(
            f"callback must be a function that makes a learner's callback from its index, or None, not {callback!r}: "
            "pass callback=lambda index: ... , so that each learner has its own"
        )
    differing = _checked_per_learner(per_learner or {}, len(names), arguments)
    folders = [None if checkpoint is None else Path(checkpoint) / f"seed-{seed}" for seed in names]
    models: list[Any] = [None] * len(names)
    diverged: dict[int, TrainingDiverged] = {}

    # Identities of what the learners were given, by argument, and the objects, so that no other takes their place.
    given: dict[str, tuple[set[int], list[Any]]] = {}

    def apart(argument: str, what: str, do: str, mine: set[int], owner: Any) -> None:
        theirs, owners = given.setdefault(argument, (set(), []))
        if mine & theirs:
            raise ValueError(
                f"{argument} must make {what} at each call, and gave the same one to two learners, which would {do}: "
                "pass a function that makes a new one"
            )
        theirs |= mine
        owners.append(owner)

    def train(index: int) -> None:
        seed, folder = names[index], folders[index]
        made = _environment(env, n_envs, vec_env_cls)
        own = {**arguments, **{name: values[index] for name, values in differing.items()}}
        if isinstance(noise := own.get("action_noise"), ActionNoise):
            # It may hold the state of a stochastic process, which advances with a learner's steps.
            own["action_noise"] = copy.deepcopy(noise)
        model = models[index] = cls(policy, made, seed=seed, **own)
        own_env: Any = model.env
        if not isinstance(env, str):
            apart("env", "an environment", "step it in turns", identities(own_env), own_env)
        callbacks = None if callback is None else callback(index)
        tops = callbacks if isinstance(callbacks, list) else [callbacks]
        called = [each for top in tops for each in _called(top)]
        apart("callback", "a callback", "call it at the steps of both", {id(each) for each in called}, called)
        if eval_env is not None:
            evaluation = _evaluation(eval_env, seed, eval_freq, n_eval_episodes, model.n_envs, folder)
            if not isinstance(eval_env, str):
                evaluated: Any = evaluation.eval_env
                apart("eval_env", "an environment", "reset it in turns", identities(evaluated), evaluated)
            callbacks = _with(callbacks, evaluation)
        all_made(model)
        try:
            model.learn(
                total_timesteps,
                callbacks,
                log_interval,
                f"{cls.__name__}_seed_{seed}",
                checkpoint=folder,
                checkpoint_freq=checkpoint_freq,
            )
        except TrainingDiverged as error:
            diverged[index] = error
            warn(f"The learner of seed {seed} is stopped, and the others go on: {error}")

    seats = [
        Seat(f"the learner of seed {seed}", functools.partial(train, index), folders[index])
        for index, seed in enumerate(names)
    ]
    train_together(seats, checkpoint)
    if diverged:
        words = "; ".join(f"seed {names[index]}: {error}" for index, error in sorted(diverged.items()))
        warn(f"{len(diverged)} of {len(names)} learners have diverged, and are returned as they were then. {words}")
    return models


def train_together(seats: Sequence[Seat], folder: str | Path | None) -> None:
    """
    Run trainings in lockstep.

    :param seats: their places
    :param folder: folder that they save to, for messages; a first SIGINT or SIGTERM then ends them when all are saved.
        None if they save nothing
    :raises Exception: by which a training has ended; a warning names it
    :raises KeyboardInterrupt: after SIGINT; a ``SystemExit`` after SIGTERM
    """
    signals = None if folder is None else Interrupts([], Path(folder))
    group = Group(seats, joint_of, lambda: None if signals is None else signals.received)
    try:
        group.run()
    finally:
        if signals is not None:
            signals.restore(orderly=True)
    for seat in group.failed:
        assert seat.error is not None
        if seat.began:
            saved = " The others are saved" if folder is not None else ""
            warn(f"{seat.name} has ended by {type(seat.error).__name__}.{saved}")
        raise seat.error
    for seat in seats:
        if seat.error is not None:
            raise seat.error
    if signals is not None and signals.received is not None:
        # The signal came when no further turn followed.
        signals.leave()


# ---------------------------------------------------------------- arguments


def _check_class(cls: Any) -> None:
    if isinstance(cls, type) and issubclass(cls, SAC):
        return
    shown = f"{cls.__module__}.{cls.__qualname__}" if isinstance(cls, type) else repr(cls)
    raise ValueError(
        f"cls must be an off-policy algorithm of this package, SAC or a class derived from it, not {shown}: the "
        "learners' gradient steps have to be alike, on batches of a replay buffer"
    )


def _check_arguments(cls: type[SAC], arguments: Mapping[str, Any]) -> None:
    """Refuse arguments of ``learn`` that ``train_many`` does not take, which are none of ``cls``."""
    of_learn = inspect.signature(cls.learn).parameters
    own = inspect.signature(train_many).parameters
    for name in arguments:
        if name in of_learn:
            taken = ", ".join(each for each in of_learn if each in own)
            raise TypeError(
                f"train_many: got an unexpected keyword argument {name!r}, an argument of learn, of which it takes "
                f"{taken}"
            )


def _checked_seeds(seeds: Any) -> list[int]:
    try:
        found = list(seeds)
    except TypeError:
        raise ValueError(f"seeds must be a list of seeds, one a learner, such as range(10), not {seeds!r}") from None
    if not found:
        raise ValueError("seeds must have at least one seed, one a learner, and is empty")
    found = [check_value("each of seeds", seed, SEED) for seed in found]
    if twice := [seed for seed in dict.fromkeys(found) if found.count(seed) > 1]:
        raise ValueError(f"seeds must differ, one a learner, but has {', '.join(map(str, twice))} more than once")
    return found


def _check_env(name: str, env: Any) -> None:
    if isinstance(env, str) or (env is None and name == "eval_env"):
        return
    if isinstance(env, (gym.Env, VecEnv)) or not callable(env):
        raise ValueError(
            f"{name} must be the id of an environment, or a function that makes one, not {env!r:.200}: each learner "
            f"has its own, so pass {name}=lambda: ... , which makes another one each time"
        )


def _checked_per_learner(
    per_learner: Mapping[str, Sequence[Any]], n: int, arguments: Mapping[str, Any]
) -> dict[str, list[Any]]:
    if not isinstance(per_learner, Mapping):
        raise ValueError(
            f"per_learner must be a dict of lists, such as {{'learning_rate': [1e-4, 3e-4]}}, not {per_learner!r}"
        )
    found = {}
    for name in ("seed", "device"):
        if name in per_learner:
            raise ValueError(f"per_learner has {name!r}, which is none of it: {_ELSEWHERE[name]}")
    if "seed" in arguments:
        raise ValueError(f"seed={arguments['seed']!r} means nothing beside seeds, of which each learner has one")
    for name, values in per_learner.items():
        if name in arguments:
            raise ValueError(f"{name} is both in per_learner and an argument of all learners: pass it once")
        if isinstance(values, str) or not hasattr(values, "__len__") or len(values) != n:
            length = f" of {len(values)}" if hasattr(values, "__len__") and not isinstance(values, str) else ""
            raise ValueError(
                f"per_learner[{name!r}] must be a list of {n} values, one a seed, not {values!r:.200}{length}"
            )
        found[name] = list(values)
    return found


_ELSEWHERE = {"seed": "pass seeds", "device": "all learners compute on the same one"}


# ---------------------------------------------------------------- environments


def _environment(env: Any, n_envs: int, vec_env_cls: type[VecEnv] | None) -> Any:
    """Environment, or id of one, for a learner's constructor."""
    if isinstance(env, str):
        if n_envs == 1 and vec_env_cls is None:
            return env
        return make_vec_env(env, n_envs, vec_env_cls=vec_env_cls)  # type: ignore[arg-type]
    first = env()
    if isinstance(first, VecEnv):
        if n_envs not in (1, first.num_envs) or vec_env_cls is not None:
            first.close()
            given = f"n_envs={n_envs}" if vec_env_cls is None else f"vec_env_cls={vec_env_cls.__name__}"
            raise ValueError(
                f"{given} is for env=<a function that makes a single environment>, and this one makes a vectorised one "
                f"of {first.num_envs}: leave {given.partition('=')[0]} out"
            )
        return first
    if n_envs == 1 and vec_env_cls is None:
        return first
    first.close()
    make: Any = vec_env_cls or DummyVecEnv
    return make([functools.partial(_monitored, env)] * n_envs)


def _monitored(env: Callable[[], gym.Env]) -> gym.Env:
    made = env()
    return made if is_wrapped(made, Monitor) else Monitor(made)


def _evaluation(env: Any, seed: int, every: int, episodes: int, n_envs: int, folder: Path | None) -> EvalCallback:
    made = make_vec_env(env, 1) if isinstance(env, str) else env()
    venv = made if isinstance(made, VecEnv) else DummyVecEnv([functools.partial(_monitored, lambda: made)])
    venv.seed(seed)
    log = None if folder is None else str(folder)
    # EvalCallback counts steps that all environments take together.
    return EvalCallback(venv, n_eval_episodes=episodes, eval_freq=max(every // n_envs, 1), log_path=log, verbose=0)


def _called(callback: Any) -> Iterator[BaseCallback]:
    """A callback, and those that it calls as Stable-Baselines3's do."""
    if not isinstance(callback, BaseCallback):
        return
    yield callback
    for name in ("callbacks", "callback", "callback_on_new_best"):
        inside = getattr(callback, name, None)
        for each in inside if isinstance(inside, list) else [inside]:
            yield from _called(each)


def _with(callbacks: Any, evaluation: EvalCallback) -> list[Any]:
    if callbacks is None:
        return [evaluation]
    if isinstance(callbacks, list):
        return [*callbacks, evaluation]
    if isinstance(callbacks, BaseCallback):
        return [callbacks, evaluation]
    return [ConvertCallback(callbacks), evaluation]
