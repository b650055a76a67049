"""Weights by which transitions are drawn from a replay buffer: by their priority, and fading with their age."""

import math
from typing import Any

import numpy as np


class DrawWeights:
    """
    Weights of a ring of slots, each of which holds a transition or nothing.

    A slot is drawn with a probability in proportion to ``priority * max(fade ** age, fade_floor)``, the age being the
    number of transitions that were stored after its own (DR.Q's faded prioritised replay; with ``fade=1`` LAP,
    Fujimoto et al. 2020). A priority is ``max(|TD error|, smallest_error) ** priority_exponent``, and that of a new
    transition the largest so far. A draw is one cumulative sum and a binary search, without a loop in Python.

    :param n_slots: capacity, in slots
    :param fade: factor on a weight at each transition stored, in (0, 1]; 1 for none
    :param fade_floor: factor down to which a weight fades, in [0, 1]
    :param priority_exponent: exponent of the priorities, at least 0
    :param smallest_error: smaller TD errors count as this one, at least 0
    """

    #: Numbers and arrays that change with what is stored.
    _NUMBERS = ("n_taken", "size", "n_stored", "max_priority")
    _ARRAYS = ("ordinal", "priority", "ready")

    def __init__(self, n_slots: int, fade: float, fade_floor: float, priority_exponent: float, smallest_error: float):
        self.n_slots, self.fade, self.fade_floor = n_slots, fade, fade_floor
        self.priority_exponent, self.smallest_error = priority_exponent, smallest_error
        #: Number of the transition in each slot, counted over all that were stored; -1 where there is none.
        self.ordinal = np.full(n_slots, -1, np.int64)
        self.priority = np.zeros(n_slots, np.float32)
        #: Which slots may be drawn.
        self.ready = np.zeros(n_slots, np.bool_)
        self.clear()

    def clear(self) -> None:
        """Empty all slots."""
        self.ordinal[:], self.priority[:], self.ready[:] = -1, 0, False
        #: Slots ever taken; slots in use when a transition was stored, at most; transitions ever stored.
        self.n_taken = self.size = self.n_stored = 0
        self.max_priority = 1.0
        self._sums: np.ndarray | None = None

    def put(self, n: int) -> np.ndarray:
        """
        Give slots, not ready yet, to new transitions, in place of the oldest ones.

        :param n: how many
        :return: their slots, (n,)
        """
        slots = self._taken(n)
        self.ordinal[slots] = np.arange(self.n_stored, self.n_stored + n)
        self.priority[slots] = self.max_priority
        self.n_stored += n
        self.size = max(self.size, int(slots.max()) + 1)
        return slots

    def skip(self, n: int) -> None:
        """
        Take slots without a transition.

        :param n: how many
        """
        self.ordinal[self._taken(n)] = -1

    def _taken(self, n: int) -> np.ndarray:
        slots = np.arange(self.n_taken, self.n_taken + n) % self.n_slots
        self.ready[slots], self._sums = False, None
        self.n_taken += n
        return slots

    def set_ready(self, slots: np.ndarray) -> None:
        """
        Let slots be drawn.

        :param slots: which
        """
        self.ready[slots], self._sums = True, None

    @property
    def n_ready(self) -> int:
        """Slots that may be drawn."""
        return int(np.count_nonzero(self.ready))

    def faded(self) -> np.ndarray:
        """
        Compute how far each weight has faded.

        :return: the factors ``max(fade ** age, fade_floor)`` of the slots in use, float32, (size,)
        """
        ages = (self.n_stored - 1 - self.ordinal[: self.size]).astype(np.float32)
        return np.maximum(np.exp(ages * np.float32(math.log(self.fade))), np.float32(self.fade_floor))

    def values(self) -> np.ndarray:
        """
        Compute the weights.

        :return: the weights of the slots in use, not normalised, float32, (size,)
        """
        weights = self.priority[: self.size] * self.ready[: self.size]
        return weights if self.fade == 1 else weights * self.faded()

    def draw(self, uniform: np.ndarray) -> np.ndarray:
        """
        Draw slots with replacement.

        :param uniform: numbers in (0, 1], (n,)
        :return: for each number the first slot up to which the weights sum to this share of their total, (n,)
        :raises ValueError: if no slot may be drawn
        """
        if self._sums is None:
            self._sums = np.cumsum(self.values(), dtype=np.float64)
        if self.size == 0 or not self._sums[-1] > 0:
            raise ValueError("there is no transition to draw")
        return np.searchsorted(self._sums, uniform * self._sums[-1])

    def priorities(self, errors: np.ndarray) -> np.ndarray:
        """
        Compute priorities.

        :param errors: absolute TD errors, (n,)
        :return: their priorities, (n,)
        """
        return np.maximum(errors, self.smallest_error) ** self.priority_exponent  # type: ignore[no-any-return]

    def renew(self, slots: np.ndarray, errors: np.ndarray) -> None:
        """
        Give slots new priorities. A slot given several times gets its last one.

        :param slots: which, (n,)
        :param errors: absolute TD errors of their transitions, (n,). A non-finite error, at which training stops,
            changes nothing
        """
        finite = np.isfinite(errors)
        if not finite.all():
            slots, errors = slots[finite], errors[finite]
        if len(slots):
            self.set_priorities(slots, self.priorities(errors))

    def set_priorities(self, slots: np.ndarray, priorities: np.ndarray) -> None:
        """
        Set priorities. The largest priority so far, which new transitions get, is never lowered.

        :param slots: which, (n,)
        :param priorities: their priorities, (n,)
        """
        self.priority[slots], self._sums = priorities, None
        self.max_priority = max(self.max_priority, float(priorities.max()))

    def state_dict(self) -> dict[str, Any]:
        """
        Collect the state.

        :return: numbers, and what is filled of the arrays, copied
        """
        used = min(self.n_taken, self.n_slots)
        arrays = {name: getattr(self, name)[:used].copy() for name in self._ARRAYS}
        return {name: getattr(self, name) for name in self._NUMBERS} | arrays

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Restore the state.

        :param state: from :meth:`state_dict` with the same number of slots
        :raises ValueError: if it does not fit that number
        """
        if state.keys() != {*self._NUMBERS, *self._ARRAYS}:
            raise ValueError(f"the weights of a replay buffer are {sorted({*self._NUMBERS, *self._ARRAYS})}, not "
                             f"{sorted(state)}")  # fmt: skip
        n_taken, size, n_stored, most = (state[name] for name in self._NUMBERS)
        if any(type(value) is not int for value in (n_taken, size, n_stored)) or type(most) is not float:
            raise ValueError("the weights of a replay buffer have a number of another kind")
        arrays = [state[name] for name in self._ARRAYS]
        n = len(arrays[0]) if isinstance(arrays[0], np.ndarray) else -1
        for name, array in zip(self._ARRAYS, arrays, strict=True):
            own = getattr(self, name)
            if not isinstance(array, np.ndarray) or array.shape != (n,) or array.dtype != own.dtype:
                raise ValueError(f"{name} of the replay buffer's weights must be {own.dtype} of shape ({n},)")
        ordinal, priority, ready = arrays
        fits = 0 <= n_stored <= n_taken < 2**62 and n == min(n_taken, self.n_slots) and 0 <= size <= n
        fits = fits and 0 < most < math.inf and bool((ordinal >= -1).all() and (ordinal < n_stored).all())
        # Slots older than all of the buffer are in no row any more.
        fits = fits and bool((ordinal[ready] >= max(n_stored - self.n_slots, 0)).all())
        if not fits or not (np.isfinite(priority).all() and (priority >= 0).all()) or ready[size:].any():
            raise ValueError("the weights of the replay buffer are not those of a replay buffer of this size")
        self.clear()
        self.n_taken, self.size, self.n_stored, self.max_priority = n_taken, size, n_stored, most
        for name, array in zip(self._ARRAYS, arrays, strict=True):
            getattr(self, name)[:n] = array
