"""MBPO: rollouts of a learned model that branch from real states, and the policy gradient at the simulated states."""

import torch

from sb3_sample.constructor import argument
from sb3_sample.ppo.model_based import ModelBasedPPO, draw
from sb3_sample.ppo.samples import SimulatedSamples


class MBPOPPO(ModelBasedPPO):
    """
    PPO with simulated states, a baseline for :class:`MBMAPPO` (MBMA, section 5.1; MBPO by Janner et al. 2019): from
    each real state the learned model is rolled out for ``simulation_horizon`` steps under the policy, and the policy
    gradient is also taken at the first ``n_simulated`` states, which makes the trajectory ``n_simulated`` + 1 times as
    long.

    The many-actions paper uses 8 states and a horizon of 12. This implementation reads it as follows: a rollout begins
    with a fresh action of the policy at the real state; simulated states 1 to X are the samples, each with the
    TD(lambda) return from there to the end of the rollout, which is bootstrapped with the critic's value. A rollout of
    H steps thus has H - 1 states with a return. If X is larger, as in appendix D's ablation (N = 8, 16, 32, 64 at H =
    12), as many rollouts branch from each real state as are needed, ``ceil(X / (H - 1))``, each with its own actions
    and the same number of states (to within one): no state is more than H - 1 model steps from a real one. With
    ``predict_termination`` a sample is weighted by the probability that the rollout reaches it.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    n_simulated: int = argument(default=8)
    """X, simulated states for each real one; 0 for PPO"""
    simulation_horizon: int = argument(default=12)
    """H, steps of a rollout of the model, at least 2"""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.n_simulated > 0 and self.simulation_horizon < 2:
            raise ValueError(
                "simulation_horizon must be at least 2, so that a simulated state has a return, not "
                f"{self.simulation_horizon}"
            )

    def _simulate(
        self, observations: torch.Tensor, values: torch.Tensor, n_simulated: int, noise: torch.Tensor | None
    ) -> SimulatedSamples:
        """
        Noise: (H, R N, A), of the actions in R rollouts from each state; all states' first rollouts come first.
        """
        n_rollouts = -(-n_simulated // (self.simulation_horizon - 1))
        n_kept = -(-n_simulated // n_rollouts)
        pieces, ends = [], False
        rows = torch.arange(n_rollouts * len(observations), device=observations.device)
        for piece in rows.split(self._rows_at_once()):
            starts = observations[piece % len(observations)]
            first = draw(self.distribution_at(starts), None if noise is None else noise[0, piece])
            later = None if noise is None else noise[1:, piece]
            rolled = self.roll_out(starts, first, later, n_kept=n_kept)
            q_values = rolled.q_values[1 : n_kept + 1]
            advantages = q_values - rolled.values[:n_kept]
            # Without terminations every state is reached.
            reached = torch.ones_like(q_values)
            if rolled.continues is not None:
                reached = rolled.continues[:n_kept].cumprod(dim=0)
            ends = rolled.continues is not None
            assert rolled.observations is not None and rolled.actions is not None and rolled.log_probs is not None
            columns = (rolled.observations, rolled.actions, rolled.log_probs, q_values, advantages, reached)
            pieces.append([column.transpose(0, 1) for column in columns])
        joined = [torch.cat(column).unflatten(0, (n_rollouts, -1)) for column in zip(*pieces, strict=True)]
        # By state, then by step, then by rollout, so that only last steps are cut off.
        joined = [column.movedim(0, 2).flatten(1, 2)[:, :n_simulated] for column in joined]
        self._check_finite("returns", joined[3])
        samples = SimulatedSamples(*joined)
        return samples if ends else samples._replace(weights=None)
