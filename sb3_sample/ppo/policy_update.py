"""PPO's update of policy and value on real and simulated samples."""

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from stable_baselines3.common.distributions import CategoricalDistribution, DiagGaussianDistribution, Distribution
from stable_baselines3.common.utils import explained_variance

from sb3_sample.console import say
from sb3_sample.faults import TrainingDiverged, not_finite
from sb3_sample.ppo.dynamics import minibatches
from sb3_sample.ppo.samples import Rollout, SimulatedSamples, check_parameters_of, entropy_of, log_prob_of_many


class PolicyUpdate:
    """Mixin of an on-policy algorithm: its policy at flat observations, and the epochs of an iteration."""

    def distribution_at(self: Any, observations: torch.Tensor) -> Distribution:
        """
        :param observations: flat, (B, O)
        :return: the policy's distribution of the actions
        :raises ValueError: its parameters are not finite, or its kind is not supported in simulation
        """
        distribution = self.policy.get_distribution(self.flat_observations.restore(observations))
        if not isinstance(distribution, (DiagGaussianDistribution, CategoricalDistribution)):
            raise ValueError(
                "policy must give a diagonal Gaussian or a categorical distribution for simulated samples, not "
                f"{type(distribution).__name__}: pass {self.plain} for plain PPO"
            )
        check_parameters_of(distribution.distribution)
        return distribution

    def values_of(self: Any, observations: torch.Tensor) -> torch.Tensor:
        """
        :param observations: flat, (B, O)
        :return: the critic's values, (B,)
        """
        return self.policy.predict_values(self.flat_observations.restore(observations)).flatten()

    def _update_policy(self: Any, rollout: Rollout, samples: SimulatedSamples) -> None:
        """
        Run PPO's epochs over the rollout and its simulated samples (MBMA, algorithm 1, lines 10 to 13).

        :param rollout: the real samples
        :param samples: the simulated ones
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        clip_range_vf = None
        if self.clip_range_vf is not None:
            clip_range_vf = self.clip_range_vf(self._current_progress_remaining)  # type: ignore[operator]

        # Each row has its real sample first, then its simulated ones.
        real_weights = torch.ones_like(rollout.log_probs)[:, None]
        weights = torch.ones_like(samples.log_probs) if samples.weights is None else samples.weights
        columns: dict[str, torch.Tensor] = {
            "observations": rollout.observations,
            "values": rollout.values,
            "returns": rollout.returns,
            "actions": torch.cat([rollout.actions[:, None], samples.actions], dim=1),
            "log_probs": torch.cat([rollout.log_probs[:, None], samples.log_probs], dim=1),
            "advantages": torch.cat([rollout.advantages[:, None], samples.advantages], dim=1),
            "weights": torch.cat([real_weights, weights], dim=1),
        }
        if samples.observations is not None:
            columns["simulated_observations"] = samples.observations

        metrics: list[dict[str, torch.Tensor]] = []
        divergences: list[torch.Tensor] = []
        goes_on = True
        for epoch in range(self.n_epochs):
            divergences = []
            # Draws the same numbers as Stable-Baselines3, with one copy per epoch instead of one per minibatch.
            order = torch.as_tensor(np.random.permutation(len(rollout.values)), device=self.device)  # noqa: NPY002
            shuffled = {name: values[order] for name, values in columns.items()}
            for batch in minibatches(list(shuffled.values()), self.batch_size):
                try:
                    loss, step = self._losses(dict(zip(shuffled, batch, strict=True)), clip_range, clip_range_vf)
                except ValueError:
                    # torch's distributions raise at a mean that is not finite, which is one minibatch late.
                    self._stop_if_diverged(metrics)
                    raise
                metrics.append({name: value.detach() for name, value in step.items()})
                divergences.append(metrics[-1].pop("approx_kl"))
                if self.target_kl is not None and divergences[-1] > 1.5 * self.target_kl:
                    goes_on = False
                    if self.verbose >= 1:
                        say(f"Early stopping at step {epoch} due to reaching max kl: {divergences[-1]:.2f}")
                    break
                self.policy.optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
            self._n_updates += 1
            if not goes_on:
                break

        for name in ("entropy_loss", "policy_gradient_loss", "value_loss", "clip_fraction"):
            mean = torch.stack([step[name] for step in metrics]).mean().item()
            if not math.isfinite(mean):
                self._stop_if_diverged(metrics)
            self.logger.record(f"train/{name}", mean)
        self.logger.record("train/approx_kl", torch.stack(divergences).mean().item())
        self.logger.record("train/loss", loss.item())
        variance = explained_variance(self.rollout_buffer.values.flatten(), self.rollout_buffer.returns.flatten())
        self.logger.record("train/explained_variance", variance)
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", self.policy.log_std.exp().mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip_range)
        if clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", clip_range_vf)

    def _stop_if_diverged(self: Any, metrics: list[dict[str, torch.Tensor]]) -> None:
        """Raise, naming the first minibatch of this iteration whose metrics are not finite, if there is one."""
        for i, step in enumerate(metrics, 1):
            bad = not_finite({f"train/{name}": value.item() for name, value in step.items()})
            if bad:
                raise TrainingDiverged(bad, f"minibatch {i} of the iteration", self.num_timesteps)

    def _losses(
        self: Any, batch: dict[str, torch.Tensor], clip_range: float, clip_range_vf: float | None
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """
        Compute PPO's loss of a minibatch of B real samples with X simulated ones each.

        :param batch: ``observations`` (B, O), ``values`` and ``returns`` (B,); with the real sample in the first column
            ``actions`` (B, 1 + X, A), ``log_probs``, ``advantages`` and ``weights`` (B, 1 + X); optionally
            ``simulated_observations`` (B, X, O)
        :param clip_range: clipping of the probability ratio
        :param clip_range_vf: clipping of the value's change, or None
        :return: the loss, and scalars to log by name
        """
        observations, actions = batch["observations"], batch["actions"]
        simulated = batch.get("simulated_observations")
        if simulated is None:
            # All actions of a row are at one state: the actor is evaluated once for them.
            distribution = self.distribution_at(observations)
            log_probs = log_prob_of_many(distribution, actions)
            entropy = entropy_of(distribution)
        else:
            states = torch.cat([observations[:, None], simulated], dim=1).flatten(0, 1)
            distribution = self.distribution_at(states)
            log_probs = distribution.log_prob(actions.flatten(0, 1)).view(actions.shape[:2])
            entropy = entropy_of(distribution).view(actions.shape[:2])[:, 0]
        values = self.values_of(observations)

        weights = batch["weights"]
        weights = weights / weights.sum()
        advantages = batch["advantages"]
        if self.normalize_advantage:
            centred = advantages - (weights * advantages).sum()
            # With equal weights this is torch.std's estimate, which Stable-Baselines3 divides by.
            variance = (weights * centred.square()).sum() * advantages.numel() / (advantages.numel() - 1)
            advantages = centred / (variance.sqrt() + 1e-8)
        log_ratio = log_probs - batch["log_probs"]
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
        policy_loss = -(weights * torch.minimum(advantages * ratio, advantages * clipped)).sum()
        if clip_range_vf is not None:
            values = batch["values"] + (values - batch["values"]).clamp(-clip_range_vf, clip_range_vf)
        value_loss = F.mse_loss(batch["returns"], values)
        entropy_loss = -entropy.mean()
        loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss
        with torch.no_grad():
            scalars = {
                "policy_gradient_loss": policy_loss,
                "value_loss": value_loss,
                "entropy_loss": entropy_loss,
                "clip_fraction": (weights * ((ratio - 1).abs() > clip_range)).sum(),
                "approx_kl": (weights * (ratio - 1 - log_ratio)).sum(),
            }
        return loss, scalars
