"""Stable-Baselines3's names for attributes that ``SAC`` here has under other names; docs/sac.md has the table."""

import math
from typing import Any

import torch
from stable_baselines3.common.utils import get_parameters_by_name

from sb3_sample.learner.scalars import LogScalar
from sb3_sample.optim import AdamW
from sb3_sample.sac.model_learner import HasLearner


class SB3Names(HasLearner):
    """
    Attributes as ``stable_baselines3.SAC`` has them. Setting a temperature changes it in place, so that it takes effect
    at the next gradient step, however that step is run.
    """

    @property
    def log_ent_coef(self) -> torch.Tensor | None:
        """
        Logarithm of the temperature, a learned scalar, or (n_tasks,) with ``task_temperatures``; None if the
        temperature is fixed.
        """
        return self.temperature.log_value if isinstance(self.temperature, LogScalar) else None

    @log_ent_coef.setter
    def log_ent_coef(self, value: Any) -> None:
        if not isinstance(self.temperature, LogScalar):
            raise ValueError(f"log_ent_coef cannot be set to {value}: the temperature is not learned")
        own = self.temperature.log_value
        given = torch.as_tensor(value, dtype=own.dtype, device=own.device)
        if given.numel() != 1 and given.shape != own.shape:
            shape = f"a number for each of the {own.numel()} tasks, or one for all" if own.dim() else "one number"
            raise ValueError(f"log_ent_coef must be {shape}, not {value}")
        if not given.isfinite().all():
            raise ValueError(f"log_ent_coef must be finite, not {value}")
        own.data.copy_(given.detach() if given.shape == own.shape else given.detach().reshape(()))

    @property
    def ent_coef_tensor(self) -> torch.Tensor:
        """The temperature, a scalar without gradient, learned or not; 0 for a deterministic actor."""
        return self.temperature().detach()

    @ent_coef_tensor.setter
    def ent_coef_tensor(self, value: Any) -> None:
        if isinstance(self.temperature, LogScalar):
            raise ValueError(f"ent_coef_tensor cannot be set to {value}: the temperature is learned, set log_ent_coef")
        if not self.actor.has_entropy:
            raise ValueError(f"ent_coef_tensor cannot be set to {value}: a deterministic actor has no temperature")
        if not 0 <= float(value) < math.inf:
            raise ValueError(f"ent_coef_tensor must be at least 0 and finite, not {value}")
        self.temperature.value.fill_(float(value))

    @property
    def ent_coef_optimizer(self) -> AdamW | None:
        """Optimizer of the temperature; None if it is fixed."""
        return self.temperature_optimizer

    @property
    def batch_norm_stats(self) -> list[torch.Tensor]:
        """Running statistics in the critics' network; ``train`` copies the features extractor's to the targets."""
        return get_parameters_by_name(self.critic, ["running_"])

    @property
    def batch_norm_stats_target(self) -> list[torch.Tensor]:
        """Running statistics in the target critics' network."""
        return get_parameters_by_name(self.critic_target, ["running_"])
