"""Plasticity: what keeps the networks able to learn, at the environment steps that it names."""

import itertools
from collections.abc import Sequence
from numbers import Integral
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_sample.sac.parts import Part

if TYPE_CHECKING:
    from sb3_sample.sac.algorithm import SAC


class Resets(Part):
    """
    Full-parameter resets (P5, section 2.2; Nikishin et al. 2022): every network, optimizer and learned number
    starts anew, the replay buffer stays.

    A step counts transitions over the model's life, warm-up included and whatever ``learn`` zeroes; the reset
    happens at the first update at or after it. The step reached is saved with the model, so that a loaded one
    does not reset again.

    :param steps: transitions at which to reset, above 0, strictly ascending; none by default
    :raises ValueError: if the steps are not positive integers in ascending order
    """

    def __init__(self, steps: Sequence[int] = ()):
        super().__init__()
        is_sequence = isinstance(steps, (Sequence, np.ndarray))
        if not is_sequence or not all(_is_integer(step) and step >= 1 for step in steps):
            raise ValueError(f"resets must be a sequence of environment steps, integers of at least 1, not {steps!r}")
        steps = tuple(steps)
        if any(late <= early for early, late in itertools.pairwise(steps)):
            raise ValueError(f"resets must be strictly ascending environment steps, not {steps}")
        self.steps = steps
        self.n_done = 0
        self._reached = 0

    def before_updates(self, agent: "SAC") -> None:
        """
        Called before the gradient steps that follow an environment step.

        :param agent: the algorithm
        """
        due = any(self._reached < step <= agent.num_transitions for step in self.steps)
        self._reached = agent.num_transitions
        if due:
            agent.reinitialize()
            self.n_done += 1
            if agent.verbose >= 1:
                print(f"Reset of all parameters at {agent.num_transitions} environment steps")

    def get_extra_state(self) -> dict[str, Any]:
        return {"reached": self._reached, "n_done": self.n_done}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._reached, self.n_done = state["reached"], state["n_done"]


def _is_integer(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)
