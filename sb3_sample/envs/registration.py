"""
The ids, listed so that registering them imports none of the libraries, and ``make_env``.

Gymnasium has no registry that outlives a process (its plugin entry points went with 1.0), so a worker of
``SubprocVecEnv`` started by ``spawn`` or ``forkserver`` knows only Gymnasium's own ids. A parent sends SB3's
``CloudpickleWrapper`` to such a worker; :func:`register_in_workers` makes multiprocessing pickle it in a way that
registers the ids before the environment is made.
"""

import contextlib
import difflib
import os
from collections.abc import Callable
from multiprocessing.reduction import ForkingPickler
from typing import Any

import gymnasium as gym

from sb3_sample.extras import install, needing

PACKAGE = "sb3_sample"
#: Prefix of the ids of Atari games, which are ale-py's own.
ATARI = "ALE/"

#: Domain to tasks: ``dm_control.suite.ALL_TASKS`` without the two lqr tasks (no time limit, unbounded actions).
DMC_TASKS: dict[str, tuple[str, ...]] = {
    "acrobot": ("swingup", "swingup_sparse"),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse", "two_poles", "three_poles"),
    "cheetah": ("run",),
    "dog": ("stand", "walk", "trot", "run", "fetch"),
    "finger": ("spin", "turn_easy", "turn_hard"),
    "fish": ("upright", "swim"),
    "hopper": ("stand", "hop"),
    "humanoid": ("stand", "walk", "run", "run_pure_state"),
    "humanoid_CMU": ("stand", "walk", "run"),
    "manipulator": ("bring_ball", "bring_peg", "insert_ball", "insert_peg"),
    "pendulum": ("swingup",),
    "point_mass": ("easy", "hard"),
    "quadruped": ("walk", "run", "escape", "fetch"),
    "reacher": ("easy", "hard"),
    "stacker": ("stack_2", "stack_4"),
    "swimmer": ("swimmer6", "swimmer15"),
    "walker": ("stand", "walk", "run"),
}

#: The library's names, ``metaworld.env_dict.ALL_V3_ENVIRONMENTS``.
METAWORLD_TASKS: tuple[str, ...] = (
    "assembly-v3",
    "basketball-v3",
    "bin-picking-v3",
    "box-close-v3",
    "button-press-topdown-v3",
    "button-press-topdown-wall-v3",
    "button-press-v3",
    "button-press-wall-v3",
    "coffee-button-v3",
    "coffee-pull-v3",
    "coffee-push-v3",
    "dial-turn-v3",
    "disassemble-v3",
    "door-close-v3",
    "door-lock-v3",
    "door-open-v3",
    "door-unlock-v3",
    "drawer-close-v3",
    "drawer-open-v3",
    "faucet-close-v3",
    "faucet-open-v3",
    "hammer-v3",
    "hand-insert-v3",
    "handle-press-side-v3",
    "handle-press-v3",
    "handle-pull-side-v3",
    "handle-pull-v3",
    "lever-pull-v3",
    "peg-insert-side-v3",
    "peg-unplug-side-v3",
    "pick-out-of-hole-v3",
    "pick-place-v3",
    "pick-place-wall-v3",
    "plate-slide-back-side-v3",
    "plate-slide-back-v3",
    "plate-slide-side-v3",
    "plate-slide-v3",
    "push-back-v3",
    "push-v3",
    "push-wall-v3",
    "reach-v3",
    "reach-wall-v3",
    "shelf-place-v3",
    "soccer-v3",
    "stick-pull-v3",
    "stick-push-v3",
    "sweep-into-v3",
    "sweep-v3",
    "window-close-v3",
    "window-open-v3",
)

#: BRO's short names to the library's ids: "Fixed" is the task, "Random" its hard version.
MYOSUITE_TASKS: dict[str, str] = {
    "key-turn": "myoHandKeyTurnFixed-v0",
    "key-turn-hard": "myoHandKeyTurnRandom-v0",
    "obj-hold": "myoHandObjHoldFixed-v0",
    "obj-hold-hard": "myoHandObjHoldRandom-v0",
    "pen-twirl": "myoHandPenTwirlFixed-v0",
    "pen-twirl-hard": "myoHandPenTwirlRandom-v0",
    "pose": "myoHandPoseFixed-v0",
    "pose-hard": "myoHandPoseRandom-v0",
    "reach": "myoHandReachFixed-v0",
    "reach-hard": "myoHandReachRandom-v0",
}

DMC_IDS = tuple(f"dmc/{domain}-{task}-v0" for domain, tasks in DMC_TASKS.items() for task in tasks)
METAWORLD_IDS = tuple(f"metaworld/{task}" for task in METAWORLD_TASKS)
MYOSUITE_IDS = tuple(f"myosuite/{task}-v0" for task in MYOSUITE_TASKS)
ALL_IDS = DMC_IDS + METAWORLD_IDS + MYOSUITE_IDS


def register_all() -> None:
    """Register all ids with Gymnasium; ids that are registered already are left as they are."""
    for domain, tasks in DMC_TASKS.items():
        for task in tasks:
            # No TimeLimit: the suite counts control steps itself, whatever the action repeat.
            _register(f"dmc/{domain}-{task}-v0", "sb3_sample.envs.dmc:make", {"domain": domain, "task": task}, None)
    for name in METAWORLD_TASKS:
        _register(f"metaworld/{name}", "sb3_sample.envs.metaworld:make", {"task": name}, 200)
    for name, library_id in MYOSUITE_TASKS.items():
        _register(f"myosuite/{name}-v0", "sb3_sample.envs.myosuite:make", {"library_id": library_id}, 100)


def _register(env_id: str, entry_point: str, kwargs: dict[str, Any], max_episode_steps: int | None) -> None:
    if env_id not in gym.registry:
        gym.register(env_id, entry_point=entry_point, kwargs=kwargs, max_episode_steps=max_episode_steps)


def is_atari_id(env_id: Any) -> bool:
    """
    :param env_id: anything
    :return: whether it is the id of an Atari game
    """
    return isinstance(env_id, str) and env_id.removeprefix(f"{PACKAGE}:").startswith(ATARI)


def register_atari() -> None:
    """
    Register the games with Gymnasium, as ``ale-py`` does when it is imported.

    :raises ImportError: ``ale-py`` is not installed; the message says how to install it
    """
    with needing(f"the {ATARI}... environments need ale-py", "atari"):
        import ale_py
    gym.register_envs(ale_py)


def check_game(env_id: str) -> None:
    """
    Register the games with Gymnasium, and check that one of them can be made.

    :param env_id: ``"ALE/<Game>-v5"``; an id that is not registered is left to ``gym.make``
    :raises ImportError: ``ale-py`` is not installed, or finds no ROM of the game; the message says what to do
    """
    register_atari()
    spec = gym.registry.get(env_id.removeprefix(f"{PACKAGE}:"))
    if spec is None:
        return
    from ale_py import roms

    try:
        with contextlib.redirect_stdout(None):
            roms.get_rom_path(spec.kwargs["game"])
    except OSError as error:
        folder = os.environ.get("ALE_ROMS_DIR")
        todo = f"install ale-py again, which has the ROMs: {install('atari')}"
        if folder:
            todo = f"the environment variable ALE_ROMS_DIR is {folder!r}: unset it, or name the folder of the ROMs"
        raise ImportError(f"{env_id} cannot be made without its ROM ({error}); {todo}") from error


def make_env(env_id: str, **kwargs: Any) -> gym.Env:
    """
    Make an environment by its id: the same as ``gym.make(f"sb3_sample:{env_id}", **kwargs)``.

    :param env_id: An id of this package (``dmc/…``, ``metaworld/…``, ``myosuite/…``), of an Atari game
        (``ALE/…``; bare, without the wrappers of ``make_atari_env``) or any that Gymnasium knows.
    :param kwargs: Arguments of ``gym.make`` (``render_mode``, ``max_episode_steps``) and of the environment
        (``action_repeat`` for ``dmc/``; ``width``, ``height``, ``camera``).
    :return: The environment.
    :raises gymnasium.error.UnregisteredEnv: There is no such id; the message names the closest ones.
    :raises ImportError: The environment's library is not installed, or has no ROM of the game; the message says what
        to do.
    """
    register_all()
    env_id = env_id.removeprefix(f"{PACKAGE}:")
    if is_atari_id(env_id):
        check_game(env_id)
    try:
        return gym.make(env_id, **kwargs)
    except (gym.error.UnregisteredEnv, gym.error.DeprecatedEnv) as error:
        close = difflib.get_close_matches(env_id, gym.registry, n=5, cutoff=0.5)
        hint = f"Close matches: {', '.join(close)}." if close else f"{PACKAGE}.envs.ALL_IDS lists this package's."
        raise gym.error.UnregisteredEnv(f"env_id {env_id!r} is not a registered environment. {hint}") from error


def register_in_workers() -> None:
    """Make the workers of SB3's ``SubprocVecEnv`` register the ids, however they are started."""
    from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper

    def reduce(wrapper: CloudpickleWrapper) -> tuple[Callable[[bytes], CloudpickleWrapper], tuple[bytes]]:
        return _load_in_worker, (wrapper.__getstate__(),)

    ForkingPickler.register(CloudpickleWrapper, reduce)


def _load_in_worker(pickled: bytes) -> Any:
    from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper

    register_all()
    wrapper = CloudpickleWrapper(None)
    wrapper.__setstate__(pickled)
    return wrapper
