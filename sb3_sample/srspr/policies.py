"""Policy of SR-SPR: the networks, and the greedy action."""

from collections.abc import Sequence
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_sample.kinds import TRUE_OR_FALSE, Kind, check_value, integer, is_integer
from sb3_sample.optim import AdamW
from sb3_sample.srspr.networks import SPRNetwork

#: Added to the root of Adam's second moment, as in Rainbow.
EPS = 1.5e-4
_CHANNELS = Kind(
    "be the channels of three layers, integers of at least 1",
    lambda value: isinstance(value, Sequence) and len(value) == 3 and all(is_integer(n) and n > 0 for n in value),
)


class SPRPolicy(BasePolicy):
    """
    Networks of SR-SPR. The target network acts, in training and in evaluation.

    :param observation_space: images, uint8, (C, height, width)
    :param action_space: the actions
    :param lr_schedule: the learning rate
    :param network: layers between latent state and output layers, see ``SRSPR``
    :param n_atoms: atoms of the distribution of returns
    :param v_min: the lowest atom
    :param v_max: the highest atom
    :param noisy: whether projection and head have noisy layers
    :param dueling: whether the head is dueling
    :param channels: of the encoder's three layers
    :param width: of projection, predictor and BroNet
    :param n_blocks: residual blocks of BroNet
    :param optimizer_class: class of the optimizer
    :param optimizer_kwargs: its arguments besides the learning rate
    :raises ValueError: if an argument is out of range
    """

    atoms: torch.Tensor

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Discrete,
        lr_schedule: Schedule,
        network: str = "nature",
        n_atoms: int = 51,
        v_min: float = -10.0,
        v_max: float = 10.0,
        noisy: bool = False,
        dueling: bool = True,
        channels: Sequence[int] = (32, 64, 64),
        width: int = 512,
        n_blocks: int = 2,
        optimizer_class: type[torch.optim.Optimizer] = AdamW,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        kwargs = {**({"eps": EPS} if optimizer_class is AdamW else {}), **(optimizer_kwargs or {})}
        super().__init__(observation_space, action_space, optimizer_class=optimizer_class, optimizer_kwargs=kwargs)
        check_value("policy_kwargs['channels']", channels, _CHANNELS)
        check_value("policy_kwargs['width']", width, integer(1))
        check_value("policy_kwargs['n_blocks']", n_blocks, integer(0))
        check_value("policy_kwargs['dueling']", dueling, TRUE_OR_FALSE)
        self._of_network: dict[str, Any] = {
            "network": network, "n_atoms": n_atoms, "channels": channels, "width": width, "n_blocks": n_blocks,
            "dueling": dueling, "noisy": noisy,
        }  # fmt: skip
        self._support = {"v_min": v_min, "v_max": v_max}
        self.q_net, self.q_net_target = self.make_network(), self.make_network()
        self.q_net_target.load_state_dict(self.q_net.state_dict())
        self.q_net_target.requires_grad_(False)
        self.register_buffer("atoms", torch.linspace(v_min, v_max, n_atoms), persistent=False)
        self.optimizer = optimizer_class(self.q_net.parameters(), lr=lr_schedule(1), **kwargs)  # type: ignore[call-arg]

    def make_network(self) -> SPRNetwork:
        """
        Make a network.

        :return: a network like the policy's, with separate parameters
        """
        shape = self.observation_space.shape
        assert shape is not None and isinstance(self.action_space, spaces.Discrete)
        return SPRNetwork(shape, int(self.action_space.n), **self._of_network)

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: whether to train; if not, noisy layers of the acting network use their means until noise is drawn
            again
        """
        super().set_training_mode(mode)
        if not mode:
            for layer in self.q_net_target.noisy_layers():
                layer.silence()

    def q_values(self, observations: torch.Tensor) -> torch.Tensor:
        """
        Compute the values of all actions with the target network.

        :param observations: uint8, (B, C, height, width)
        :return: expected returns, (B, A)
        """
        probabilities = self.q_net_target(observations.float() / 255).softmax(dim=-1)
        return (probabilities * self.atoms).sum(dim=-1)

    def forward(self, observations: PyTorchObs, deterministic: bool = True) -> torch.Tensor:
        """
        :param observations: uint8, (B, C, height, width)
        :param deterministic: ignored: the algorithm explores
        :return: the numbers of the best actions, (B,)
        """
        return self._predict(observations, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = True) -> torch.Tensor:
        assert isinstance(observation, torch.Tensor)
        return self.q_values(observation).argmax(dim=1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {
            **self._of_network,
            **self._support,
            "lr_schedule": self._dummy_schedule,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
        }
        # Only those of the base class's parameters that this constructor takes.
        data = super()._get_constructor_parameters()
        return {name: data[name] for name in ("observation_space", "action_space")} | own
