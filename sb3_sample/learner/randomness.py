"""Random generators of one learner."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch


class OwnGenerators:
    """
    Generators of torch for one learner: inside :meth:`in_force` they replace the global ones, so that initial weights,
    noise and dropout draw from them, and nothing else does.

    :param seed: their seed
    :param device: where the learner computes
    """

    def __init__(self, seed: int, device: torch.device | str = "cpu"):
        self._device = torch.device(device)
        with self._kept():
            torch.manual_seed(seed)
            self._state = self._now()

    @contextmanager
    def in_force(self) -> Iterator[None]:
        """Replace the global generators inside the context."""
        with self._kept():
            self._put(self._state)
            try:
                yield
            finally:
                self._state = self._now()

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
