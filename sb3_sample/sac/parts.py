"""
What every exchangeable part of an off-policy agent has in common.

A part is a ``torch.nn.Module``, so that its networks, learned numbers and buffers move with the model's
device and are saved with the model (``state_dict``; numbers that are not tensors go into
``get_extra_state``). It hears of the environment through the two methods below and of the gradient
steps through what its own base class names (``Pessimism.update``, ``Exploration.update``, ...).
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from torch import nn
from torch.optim import Optimizer

from sb3_sample.saving.checks import ParametersDoNotFit as ParametersDoNotFit

if TYPE_CHECKING:
    from sb3_sample.sac.algorithm import SAC


class Part(nn.Module):
    """A part of an off-policy agent; its subclasses override what they need."""

    def optimizers(self) -> dict[str, Optimizer]:
        """
        The part's optimizers by the name of the attribute that holds them. The algorithm saves them with the
        model and clears their state at a reset.
        """
        return {}

    def before_updates(self, agent: "SAC") -> None:
        """
        Called before the gradient steps that follow an environment step.

        :param agent: the algorithm
        """

    def on_environment_reset(self, agent: "SAC") -> None:
        """
        Called when ``learn`` has reset the environments, whose episodes so far have no end in the replay buffer.

        :param agent: the algorithm
        """

    def on_step(self, agent: "SAC", rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """
        Called when the transitions of one step of all environments are in the replay buffer.

        :param agent: the algorithm
        :param rewards: unnormalised rewards, (n_envs,)
        :param dones: whether each environment's episode ended, for whatever reason, (n_envs,)
        :param infos: each environment's info; ``TimeLimit.truncated`` tells a time limit from a termination
        """

    def on_episode_end(self, agent: "SAC", env_index: int, episode_return: float) -> None:
        """
        Called when an episode ended, after ``on_step``.

        :param agent: the algorithm
        :param env_index: which environment's episode
        :param episode_return: undiscounted, unnormalised return
        """
