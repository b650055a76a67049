"""QMA: extra actions at the real states, their Q-values from two Q-networks."""

from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn

from sb3_sample.constructor import argument
from sb3_sample.networks.initialization import linear
from sb3_sample.networks.mlp import MLP
from sb3_sample.optim import AdamW
from sb3_sample.ppo.arguments import check_network_kwargs
from sb3_sample.ppo.dynamics import ADAM_EPS, Standardizer, fit, minibatches
from sb3_sample.ppo.samples import SimulatedSamples
from sb3_sample.ppo.simulated_ppo import SimulatedPPO
from sb3_sample.saving.kept import Kept

#: Entries of ``q_kwargs``, with the defaults (MBMA, appendix B.2; ``normalize`` is decided here).
Q_DEFAULTS: dict[str, Any] = {"width": 1024, "depth": 2, "learning_rate": 3e-4, "epochs": None, "normalize": True}


class QNetworks(nn.Module):
    """
    Two Q-networks, stacked along a leading axis, hidden layers with ReLU.

    :param observation_size: O
    :param action_size: D
    :param width: width of the hidden layers (MBMA: 1024)
    :param depth: hidden layers (MBMA: 2)
    :param learning_rate: of Adam, whose epsilon is 1e-5
    :param normalize: whether observations are standardised by the training observations
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        width: int = 1024,
        depth: int = 2,
        learning_rate: float = 3e-4,
        normalize: bool = True,
    ):
        super().__init__()
        self.normalize = normalize
        trunk = MLP(observation_size + action_size, [width] * depth, n_copies=2)
        self.networks = nn.Sequential(trunk, linear(trunk.out_features, 1, 2, gain=1))
        self.observation_scale = Standardizer(observation_size)
        self.optimizer = AdamW(self.parameters(), lr=learning_rate, eps=ADAM_EPS)

    def forward(self, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """
        :param observations: (B, O)
        :param actions: (B, D)
        :return: Q-values of both networks, (2, B)
        """
        x = self.observation_scale(observations) if self.normalize else observations
        return self.networks(torch.cat([x, actions], dim=1)).squeeze(2)

    def loss(self, observations: torch.Tensor, actions: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        """
        :param observations: (B, O)
        :param actions: (B, D)
        :param targets: TD(lambda) returns, (B,)
        :return: mean squared error, summed over the networks, scalar
        """
        return (self(observations, actions) - targets).square().mean(dim=1).sum()


class QMAPPO(SimulatedPPO):
    """
    PPO with many actions by Q-networks, a baseline for :class:`MBMAPPO` (MBMA, section 5.1; Asadi et al. 2017, Petit et
    al. 2019): ``n_simulated`` extra actions at each real state. Their Q-values are the smaller outputs of two
    Q-networks, which are trained on the TD(lambda) returns of each rollout before the policy, with PPO's minibatches
    and epochs.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    _kept: ClassVar[dict[str, Kept]] = {"_network_kwargs": Kept.NOWHERE}
    simulation_arguments: ClassVar[tuple[str, ...]] = (*SimulatedPPO.simulation_arguments, "q_kwargs")

    n_simulated: int = argument(default=8)
    """X, extra actions at each real state; 0 for PPO. Actions of a Discrete space are not drawn: all are taken, with
    the weights that X draws have in expectation"""
    q_kwargs: dict[str, Any] | None = argument(default=None)
    """the Q-networks: ``width`` (1024) and ``depth`` (2) of the hidden layers, ``learning_rate`` (3e-4), ``epochs``
    over each rollout (None: ``n_epochs``), and ``normalize`` (True): whether observations are standardised by those of
    the rollout"""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_network_kwargs("q_kwargs", self.q_kwargs, Q_DEFAULTS)

    def _setup_models(self) -> None:
        self._network_kwargs = check_network_kwargs("q_kwargs", self.q_kwargs, Q_DEFAULTS)
        network = {name: value for name, value in self._network_kwargs.items() if name != "epochs"}
        #: The Q-networks.
        self.q_networks = QNetworks(self.flat_observations.size, self.model_actions.size, **network).to(self.device)

    def _model_names(self) -> list[str]:
        return ["q_networks", "q_networks.optimizer"]

    def fit_models(self) -> None:
        """
        Train the Q-networks on the TD(lambda) returns of the current rollout, and log their loss: before the training,
        on samples that they have not seen (``dynamics/heldout_q_loss``), and during it (``dynamics/train_q_loss``).

        :raises ValueError: if there is no rollout
        """
        rollout = self.current_rollout()
        columns = rollout.observations, self.model_actions(rollout.actions), rollout.returns
        with torch.no_grad():
            self.logger.record("dynamics/heldout_q_loss", self.q_networks.loss(*columns).item())
        if self.q_networks.normalize:
            self.q_networks.observation_scale.fit(rollout.observations)

        def losses() -> Any:
            for _ in range(self._network_kwargs["epochs"] or self.n_epochs):
                order = torch.as_tensor(np.random.permutation(len(columns[0])), device=self.device)  # noqa: NPY002
                for batch in minibatches([column[order] for column in columns], self.batch_size):
                    yield {"q_loss": self.q_networks.loss(*batch)}

        for name, loss in fit(self.q_networks, self.q_networks.optimizer, losses()).items():
            self.logger.record(f"dynamics/train_{name}", loss.item())

    def _simulate(
        self, observations: torch.Tensor, values: torch.Tensor, n_simulated: int, noise: torch.Tensor | None
    ) -> SimulatedSamples:
        """Noise: (N, X, A), for the extra actions."""
        actions, log_probs, weights = self._many_actions(observations, n_simulated, noise)
        n_columns = actions.shape[1]
        model_actions = self.model_actions(actions.flatten(0, 1))
        rows = torch.arange(len(model_actions), device=actions.device)
        smaller = [
            self.q_networks(observations[torch.div(piece, n_columns, rounding_mode="floor")], model_actions[piece])
            .amin(dim=0)
            for piece in rows.split(4096)
        ]  # fmt: skip
        q_values = torch.cat(smaller).view(-1, n_columns)
        return SimulatedSamples(None, actions, log_probs, q_values, q_values - values[:, None], weights)
