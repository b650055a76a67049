"""Whether compiling the gradient step pays for itself, for every algorithm with a replay buffer."""

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_sample.console import say
from sb3_sample.learner.execution import (
    PAYS_FROM,
    PAYS_FROM_IMAGES,
    foreign_parts,
    old_torch,
    warn_not_compiled,
    why_not_compiled,
)


def pays_from(observation_space: "spaces.Space[Any]", device: torch.device) -> int:
    """
    :param observation_space: observation space
    :param device: device of the gradient steps
    :return: number of gradient steps from which compiling them pays
    """
    parts = observation_space.spaces.values() if isinstance(observation_space, spaces.Dict) else [observation_space]
    on_images = device.type == "cpu" and any(is_image_space(part) for part in parts)
    return PAYS_FROM_IMAGES if on_images else PAYS_FROM


class DecidesCompiling:
    """Part of an algorithm with a learner, ``compile`` and ``compiled``, before Stable-Baselines3's class."""

    compiled: bool | None

    def _decide_compiling(self: Any, n_updates: float) -> None:
        """
        Decide, with ``compile="auto"`` once and for all, whether the coming gradient steps pay for compiling.

        :param n_updates: gradient steps to come; 0 if unknown
        """
        if self.compiled is not None:
            return
        # Warn of reasons not to compile only if compiling was requested, and of an old torch, which is easily updated.
        threshold = pays_from(self.observation_space, self.device)
        foreign = foreign_parts(self.learner) if n_updates >= threshold else []
        if foreign and self.verbose >= 1:
            verb = "does" if len(foreign) == 1 else "do"
            say(f"The gradient step is not compiled: {', '.join(foreign)} {verb} not declare compilable = True")
        pays = n_updates >= threshold and not foreign
        reason = why_not_compiled(self.learner) if pays else None
        self.compiled = pays and reason is None
        if reason is not None and reason == old_torch():
            warn_not_compiled(self.learner, reason)
        self.learner.forget_execution()
