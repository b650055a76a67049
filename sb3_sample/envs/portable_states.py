"""
The state of an environment as plain values: arrays, numbers, strings, random generators and containers of them, which
can be written to a file and restored in another process, in an environment that was made in the same way.

MuJoCo's data is not written as it lies in memory. The future follows from its integration state
(``mjSTATE_INTEGRATION``); all other numbers follow from that state or are left over from the last step. Some tasks read
these leftovers before they are computed anew, so they are written too.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_sample.envs.atari import is_atari
from sb3_sample.envs.mujoco_model import model_arrays, more_model_arrays, options_of, set_model_numbers
from sb3_sample.envs.states import layers_of, simulator_of
from sb3_sample.saving.attributes import Describer, DoesNotFit, Restorer, class_name

#: Attribute that :mod:`sb3_sample.saving.vec_envs` sets in an environment of another process.
HELPER = "_sb3_sample_state"
#: Attributes of wrappers that lead to the wrapped environment or are this package's.
_SKIPPED = ("env", HELPER)
#: Stable-Baselines3's Monitor counts seconds from its creation, a time that its file records.
_CLOCKS = {"stable_baselines3.common.monitor.Monitor": ("t_start",)}
#: Arrays whose size depends on the contacts, and on which bodies touch each other; they are computed anew at each step,
#: before they are read.
_IN_ARENA = ("efc_", "iefc_", "island_", "map_", "iL", "iM", "iacc", "ifrc")
#: Valid dimensions of MuJoCo's contacts; MuJoCo uses those of a model unchecked.
_CONTACT_DIMENSIONS = (1, 3, 4, 6)


def pack(env: gym.Env) -> tuple[dict[str, Any], list[str]]:
    """
    :param env: an environment, wrapped or not
    :return: its state; and the attributes missing from it because nothing is known about their class (none if it is
        complete), as ``class of the layer: attribute (class)``
    """
    (state,), opaque = pack_all([env])
    return state, opaque


def pack_all(envs: Sequence[gym.Env]) -> tuple[list[dict[str, Any]], list[str]]:
    """
    :param envs: the environments of one process, which may share values, and the attributes of their classes
    :return: their states; and the attributes missing from them, as in :func:`pack`
    """
    describer = Describer(whole=True)
    states, opaque = [], []
    for env in envs:
        layers, simulator = layers_of(env), simulator_of(env)
        describer.enter(_saved_otherwise(env), _origin(simulator))
        described = []
        for layer in layers:
            attributes, unknown = describer.attributes(layer, _skipped(layer))
            described.append({"class": class_name(layer), "attributes": attributes})
            opaque += [f"{type(layer).__name__}: {what}" for what in unknown]
        classes, unknown = describer.classes()
        opaque += unknown
        states.append({
            "layers": described,
            "simulator": None if simulator is None else _pack_simulator(*simulator),
            **({"console": _pack_console(env)} if is_atari(env) else {}),
            "classes": classes,
        })  # fmt: skip
    return states, opaque + describer.finish()


def unpack(env: gym.Env, state: dict[str, Any]) -> None:
    """
    Restore a state: the same actions then give the same observations and rewards, bit for bit.

    :param env: an environment made like the one that was packed
    :param state: from :func:`pack`; it is not changed
    :raises DoesNotFit: the environment was made in another way
    """
    unpack_all([env], [state])


def unpack_all(envs: Sequence[gym.Env], states: Sequence[dict[str, Any]]) -> None:
    """
    :param envs: environments made like those that were packed
    :param states: from :func:`pack_all`; they are not changed
    :raises DoesNotFit: the environments were made in another way
    """
    restorer = Restorer()
    for env, state in zip(envs, states, strict=True):
        _unpack(env, state, restorer)
    if restorer.kept:
        # Keeping them could change what comes next.
        raise DoesNotFit(f"{', '.join(restorer.kept)} name other files than the saved ones")


def _unpack(env: gym.Env, state: dict[str, Any], restorer: Restorer) -> None:
    layers, simulator = layers_of(env), simulator_of(env)
    ours, theirs = [class_name(layer) for layer in layers], [layer["class"] for layer in state["layers"]]
    if ours != theirs:
        raise DoesNotFit(f"the environment consists of {ours}, the saved one of {theirs}")
    if (simulator is None) != (state["simulator"] is None):
        raise DoesNotFit("only one of the environment and the saved one is simulated by MuJoCo")
    if simulator is not None:
        _unpack_simulator(*simulator, state["simulator"])
    if is_atari(env) != ("console" in state):
        raise DoesNotFit("only one of the environment and the saved one is Atari's")
    if "console" in state:
        _unpack_console(env, state["console"])
    restorer.enter(_saved_otherwise(env), _origin(simulator))
    for layer, saved in zip(layers, state["layers"], strict=True):
        restorer.attributes(layer, saved["attributes"], _skipped(layer))
    # Checkpoints of earlier versions have none.
    restorer.classes(state.get("classes", {}))


def _saved_otherwise(env: gym.Env) -> list[Any]:
    """Objects that are not saved as values of attributes: each layer, and the simulator."""
    console = [env.unwrapped.ale] if is_atari(env) else []  # type: ignore[attr-defined]
    return [*layers_of(env), *(simulator_of(env) or ()), *_physics(env), *console]


def _skipped(layer: Any) -> tuple[str, ...]:
    return (*_SKIPPED, *_CLOCKS.get(class_name(layer), ()))


def _physics(env: gym.Env) -> list[Any]:
    dm_env = getattr(env.unwrapped, "dm_env", None)
    return [] if dm_env is None else [dm_env.physics]


def _origin(simulator: tuple[Any, Any] | None) -> int | None:
    """Address of the simulator's data, all of which lies in one block; some tasks of Meta-World keep views of it."""
    return None if simulator is None else int(simulator[1].qpos.__array_interface__["data"][0])


def _pack_simulator(model: Any, data: Any) -> dict[str, Any]:
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    integration = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, integration, kind)
    return {
        "integration": integration,
        "data": {name: getattr(data, name).copy() for name in _data_arrays()},
        "model": {name: getattr(model, name).copy() for name in (*model_arrays(), *more_model_arrays())},
        "options": options_of(model),
    }


def _unpack_simulator(model: Any, data: Any, state: dict[str, Any]) -> None:
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    # Checkpoints of earlier versions have no options and masks; those of the environment stay.
    recent = "options" in state
    own_arrays = (*model_arrays(), *more_model_arrays()) if recent else model_arrays()
    owners = {"model": (model, own_arrays), "data": (data, _data_arrays())}
    if state.keys() - {"options"} != {"integration", *owners}:
        raise DoesNotFit("the state of the simulator is not what is saved of one")
    _check_like(np.empty(mujoco.mj_stateSize(model, kind)), state["integration"], "integration")
    for part, (owner, names) in owners.items():
        # Indices into MuJoCo's memory are never written: MuJoCo would use them unchecked.
        if not isinstance(state[part], dict) or state[part].keys() != set(names):
            raise DoesNotFit(f"the arrays of the simulator's {part} are not those that are saved of one")
        for name in names:
            _check_like(getattr(owner, name), state[part][name], name)
    if recent and not np.isin(state["model"]["geom_condim"], _CONTACT_DIMENSIONS).all():
        raise DoesNotFit(f"geom_condim of the simulator holds other numbers than {_CONTACT_DIMENSIONS}")
    options = state.get("options", {})
    if recent:
        _check_options(options_of(model), options)
    set_model_numbers(model, {**state["model"], **options})
    mujoco.mj_setState(model, data, state["integration"], kind)
    # Compute contacts and constraints, as dm_control does at the end of a step for the next one.
    mujoco.mj_step1(model, data)
    for name in _data_arrays():
        getattr(data, name)[...] = state["data"][name]


def _check_options(own: dict[str, Any], options: Any) -> None:
    """Check numbers that are to replace those of the model's structures."""
    import mujoco

    if not isinstance(options, dict) or options.keys() != own.keys():
        raise DoesNotFit("the options of the simulator are not those that are saved of one")
    ends = {
        "opt.integrator": len(mujoco.mjtIntegrator.__members__), "opt.cone": len(mujoco.mjtCone.__members__),
        "opt.jacobian": len(mujoco.mjtJacobian.__members__), "opt.solver": len(mujoco.mjtSolver.__members__),
        "opt.disableflags": 2 ** int(mujoco.mjtDisableBit.mjNDISABLE),
        "opt.enableflags": 2 ** int(mujoco.mjtEnableBit.mjNENABLE),
    }  # fmt: skip
    for name, value in own.items():
        given = options[name]
        if isinstance(value, np.ndarray):
            _check_like(value, given, name)
        elif type(given) is not type(value) or not math.isfinite(given):
            raise DoesNotFit(f"{name} of the simulator is {given!r:.50}, which no {type(value).__name__} of it is")
        elif isinstance(given, int) and not 0 <= given < ends.get(name, 2**31):
            raise DoesNotFit(f"{name} of the simulator is {given}, which MuJoCo does not know")


def _pack_console(env: Any) -> np.ndarray:
    """The whole state of an Atari console, including its generator, as the bytes that the emulator writes."""
    return np.frombuffer(env.unwrapped.clone_state(include_rng=True).serialize(), np.uint8).copy()


def _unpack_console(env: Any, state: Any) -> None:
    import ale_py

    if not isinstance(state, np.ndarray) or state.dtype != np.uint8 or state.ndim != 1:
        raise DoesNotFit("the state of the Atari console is not what is saved of one")
    try:
        env.unwrapped.restore_state(ale_py.ALEState(state.tobytes()))
    except SystemError as error:  # the emulator's error for bytes that it did not write
        raise DoesNotFit("the state of the Atari console is damaged, or of another game") from error


def _check_like(own: np.ndarray, array: Any, name: str) -> None:
    """Check an array that is to replace one of the simulator."""
    if not isinstance(array, np.ndarray) or array.shape != own.shape or array.dtype != own.dtype:
        saved = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else f"{array!r:.50}"
        raise DoesNotFit(
            f"the environment has another MuJoCo model than the saved one: {name} {own.dtype} {own.shape} instead of "
            f"{saved}"
        )
    if not np.isfinite(array).all():
        raise DoesNotFit(f"{name} of the simulator holds what is not finite")


@functools.cache
def _data_arrays() -> tuple[str, ...]:
    """Names of the arrays of floats whose size the model alone determines."""
    import mujoco

    data = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
    names = [name for name in dir(data) if not name.startswith(("_", *_IN_ARENA))]
    arrays = {name: value for name in names if isinstance(value := getattr(data, name), np.ndarray)}
    return tuple(name for name, value in arrays.items() if value.dtype == np.float64)
