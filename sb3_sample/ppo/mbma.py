"""MBMA: extra actions at the real states, their Q-values from rollouts of a learned model."""

import torch
from gymnasium import spaces

from sb3_sample.constructor import argument
from sb3_sample.ppo.model_based import ModelBasedPPO
from sb3_sample.ppo.samples import SimulatedSamples


class MBMAPPO(ModelBasedPPO):
    """
    Model-based many-actions PPO (MBMA, Nauman and Cygan 2023, https://arxiv.org/abs/2210.13011, section 4 and
    appendix E): PPO with ``n_simulated`` extra actions at each real state. Their Q-values are TD(lambda) returns of
    rollouts of a learned model under the policy, ``simulation_horizon`` steps long and bootstrapped with the critic.

    Defaults are those of the paper, appendix B.2. They differ from ``stable_baselines3.PPO`` in the networks (512 and
    1024 instead of 64) and in that advantages are not normalised.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    n_simulated: int = argument(default=8)
    """X, extra actions at each real state; 0 for PPO. Actions of a Discrete space are not drawn: all are taken, with
    the weights that X draws have in expectation"""

    def _simulate(
        self, observations: torch.Tensor, values: torch.Tensor, n_simulated: int, noise: torch.Tensor | None
    ) -> SimulatedSamples:
        """Noise: (H, N, X, A), the first entry for the extra actions, the others for the actions in the rollouts."""
        if noise is not None and not isinstance(self.action_space, spaces.Box):
            raise ValueError("noise is that of Gaussian actions, which a Discrete space has not: leave it out")
        actions, log_probs, weights = self._many_actions(observations, n_simulated, None if noise is None else noise[0])
        n_columns = actions.shape[1]
        flat_actions = actions.flatten(0, 1)
        later = None if noise is None else noise[1:].flatten(1, 2)
        returns = []
        rows = torch.arange(len(flat_actions), device=actions.device)
        for piece in rows.split(self._rows_at_once()):
            piece_noise = None if later is None else later[:, piece]
            starts = observations[torch.div(piece, n_columns, rounding_mode="floor")]
            returns.append(self.roll_out(starts, flat_actions[piece], piece_noise).q_values[0])
        q_values = torch.cat(returns).view(-1, n_columns)
        self._check_finite("returns", q_values)
        return SimulatedSamples(None, actions, log_probs, q_values, q_values - values[:, None], weights)
