"""
Validate states of generators from files: NumPy draws from any position that it is given, even outside its numbers.
"""

import random
from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_sample.saving.untrusted import BadFile

_Check = Callable[[Any], bool]


def _whole(most: int) -> _Check:
    return lambda value: type(value) is int and 0 <= value <= most


def _words(n: int, dtype: Any) -> _Check:
    return lambda value: isinstance(value, np.ndarray) and value.dtype == dtype and value.shape == (n,)


def _is_float(value: Any) -> bool:
    return type(value) is float and value == value


_128_BITS, _BIT, _32_BITS = _whole(2**128 - 1), _whole(1), _whole(2**32 - 1)
_REST: dict[str, _Check] = {"has_uint32": _BIT, "uinteger": _32_BITS}
_PCG = {"state": _128_BITS, "inc": lambda value: _128_BITS(value) and value % 2 == 1}
#: By the bit generator: its own state, and the entries beside it. Positions count numbers that were drawn beforehand.
_STATES: dict[str, tuple[dict[str, _Check], dict[str, _Check]]] = {
    "PCG64": (_PCG, _REST),
    "PCG64DXSM": (_PCG, _REST),
    "SFC64": ({"state": _words(4, np.uint64)}, _REST),
    "MT19937": ({"key": _words(624, np.uint32), "pos": _whole(624)}, {}),
    "Philox": (
        {"counter": _words(4, np.uint64), "key": _words(2, np.uint64)},
        {"buffer": _words(4, np.uint64), "buffer_pos": _whole(4), **_REST},
    ),
}
#: Further state of a ``RandomState``.
_LEGACY: dict[str, _Check] = {"has_gauss": _BIT, "gauss": _is_float}
BIT_GENERATORS = tuple(_STATES)


def _check(state: Any, checks: dict[str, _Check], name: str, further: set[str]) -> None:
    if not isinstance(state, dict) or state.keys() != checks.keys() | further:
        raise BadFile(f"{name}: the state of a generator must have {sorted(checks.keys() | further)}")
    for key, fits in checks.items():
        if not fits(state[key]):
            raise BadFile(f"{name}: {key} of a generator cannot be {state[key]!r:.100}")


def numpy_generator(kind: Any, state: Any, name: str) -> np.random.Generator | np.random.RandomState:
    """
    :param kind: "Generator" or "RandomState"
    :param state: as NumPy gives it
    :param name: whose it is, for messages
    :return: a generator in that state
    :raises BadFile: if it is no such state
    """
    bits_name = state.get("bit_generator") if isinstance(state, dict) else None
    if kind not in ("Generator", "RandomState") or bits_name not in BIT_GENERATORS:
        raise BadFile(f"{name}: unknown generator {kind!r:.50} of {bits_name!r:.50}")
    inside, beside = _STATES[bits_name]
    legacy = kind == "RandomState"
    _check(state, beside | (_LEGACY if legacy else {}), name, {"bit_generator", "state"})
    _check(state["state"], inside, name, set())
    bits = getattr(np.random, bits_name)(0)
    if not legacy:
        bits.state = state
        return np.random.Generator(bits)
    made = np.random.RandomState(bits)
    made.set_state(state)
    return made


def set_numpy_state(state: Any) -> None:
    """
    :param state: of NumPy's global generator, as ``numpy.random.get_state`` gives it
    :raises BadFile: if it is no such state
    """
    if not isinstance(state, tuple) or len(state) != 5 or state[0] != "MT19937":
        raise BadFile(f"the state of NumPy's generator cannot be {state!r:.100}")
    _, key, pos, has_gauss, gauss = state
    inside = {"key": key, "pos": pos}
    whole = {"bit_generator": "MT19937", "state": inside, "has_gauss": has_gauss, "gauss": gauss}
    numpy_generator("RandomState", whole, "NumPy")
    np.random.set_state(whole)  # noqa: NPY002


def check_python_state(state: Any, name: str) -> None:
    """
    :param state: as ``random.getstate`` gives it
    :param name: whose it is, for messages
    :raises BadFile: if it is no such state
    """
    fits = isinstance(state, tuple) and len(state) == 3 and (state[2] is None or _is_float(state[2]))
    if not fits:
        raise BadFile(f"{name}: the state of a generator of Python cannot be {state!r:.100}")
    try:
        random.Random(0).setstate(state)
    except (ValueError, TypeError, OverflowError) as error:
        raise BadFile(f"{name}: the state of a generator of Python is none: {error}") from error
