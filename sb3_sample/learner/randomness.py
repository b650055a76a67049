"""Random generators of one learner."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import torch

P = ParamSpec("P")
R = TypeVar("R")


def checked_state(state: Any, name: str) -> torch.Tensor:
    """
    :param state: state of torch's generator on the CPU, from a file
    :param name: name of the state, for the message
    :return: the same state, on the CPU
    :raises ValueError: if it is not such a state
    """
    try:
        state = state.cpu()
        torch.Generator().set_state(state)
    except (AttributeError, TypeError, RuntimeError) as error:
        raise ValueError(f"{name} cannot be {state!r:.200}: it is no state of torch's generator") from error
    # Count of pre-generated numbers left, and place of the next one: torch reads past their end if the two disagree.
    left, following = state.numpy()[8:12].view(np.int32)[0], state.numpy()[16:24].view(np.int64)[0]
    if following < 0 or left + following > 625:
        raise ValueError(f"{name} is no state of torch's generator: {left} numbers left from place {following} on")
    return state  # type: ignore[no-any-return]


def with_own_generators(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """
    Let a method of a learner draw from the learner's own generators, if it has some.

    :param method: the method
    :return: the same with the generators in force
    """

    @functools.wraps(method)
    def wrapped(self: Any, *args: P.args, **kwargs: P.kwargs) -> R:
        with self._random():
            return method(self, *args, **kwargs)

    return wrapped


class OwnGenerators:
    """
    Generators of torch for one learner: inside :meth:`in_force` they replace the global ones, so that initial weights,
    noise and dropout draw from them, and nothing else does.

    :param seed: their seed
    :param device: where the learner computes
    """

    def __init__(self, seed: int, device: torch.device | str = "cpu"):
        self._device = torch.device(device)
        self._are_in_force = False
        with self._kept():
            torch.manual_seed(seed)
            self._state = self._now()

    @contextmanager
    def in_force(self) -> Iterator[None]:
        """Replace the global generators inside the context; nothing changes where they are replaced already."""
        if self._are_in_force:
            yield
            return
        with self._kept():
            self._put(self._state)
            self._are_in_force = True
            try:
                yield
            finally:
                self._state, self._are_in_force = self._now(), False

    @contextmanager
    def _kept(self) -> Iterator[None]:
        before = self._now()
        try:
            yield
        finally:
            self._put(before)

    def _now(self) -> dict[str, Any]:
        states = {"torch": torch.get_rng_state()}
        if self._device.type == "cuda":
            states["cuda"] = torch.cuda.get_rng_state(self._device)
        return states

    def _put(self, states: dict[str, Any]) -> None:
        torch.set_rng_state(states["torch"])
        if self._device.type == "cuda" and "cuda" in states:
            torch.cuda.set_rng_state(states["cuda"], self._device)

    def state_dict(self) -> dict[str, Any]:
        """
        Copy the generators' states.

        :return: their states
        """
        return {name: state.clone() for name, state in self._state.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Restore the generators' states.

        :param state: from :meth:`state_dict`
        """
        self._state = {name: value.clone() for name, value in state.items()}
        self._state["torch"] = checked_state(self._state["torch"], "the learner's generator of torch")
