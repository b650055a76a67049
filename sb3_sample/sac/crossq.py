"""CrossQ and CrossQ+WN."""

from typing import Any, ClassVar

import torch
from stable_baselines3.common.type_aliases import Schedule

from sb3_sample.constructor import Given, argument
from sb3_sample.kinds import AT_LEAST_0, TRUE_OR_FALSE, is_number
from sb3_sample.learner.heads import ValueHead
from sb3_sample.optim import AdamW
from sb3_sample.sac import checks
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.policy_kwargs import with_hidden_sizes, with_weight_decay


class CrossQ(SAC):
    """
    CrossQ: soft actor-critic with batch norm and without target networks (Bhatt et al. 2024,
    https://arxiv.org/abs/1902.05605), and CrossQ+WN (Palenicek et al. 2025, https://arxiv.org/abs/2502.07523).

    Networks with batch renormalisation ("crossq"). The critics evaluate current and next states and actions in one
    forward pass of twice the rows, so that batch statistics cover both; the next values come from that pass. One
    gradient step a transition; the actor learns in every third. Defaults are those of the published runs on MuJoCo.
    docs/crossq.md has the differences from ``sb3_contrib.CrossQ``.

    ``weight_norm=True`` is CrossQ+WN in the version that XQC's authors compare with: weights of unit norm, weight decay
    of the other parameters, batch norm in the place of renormalisation, target networks, smaller critics, two gradient
    steps a transition, and a learning rate that falls linearly. Arguments that are not passed then have other defaults:
    ``learning_rate=3e-4``, ``learning_rate_schedule="linear"``, ``final_learning_rate`` a tenth of ``learning_rate``,
    ``ent_coef="auto_0.01"``, ``replay_ratio=2``, ``actor_at_once=True``, ``weight_decay=0.01``.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_rate: float | Schedule = argument(default=1e-3, kw_only=False)
    """learning rate of actor, critics and temperature; a number or a function of the remaining progress (from 1 to
    0)"""
    learning_starts: int = argument(default=5_000, kw_only=False)
    """transitions with uniformly random actions before the first gradient step, counted over the model's life"""
    target_entropy: str | float = argument(default="auto", kw_only=False)
    """entropy that the learned temperature aims at; "auto" is -|A|, with ``weight_norm`` -|A|/2"""
    replay_ratio: float | None = argument(default=1)
    """gradient steps per environment transition after the warm-up, whatever the number of environments; may be below
    1"""
    weight_norm: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """whether it is CrossQ+WN"""
    weight_decay: float = argument(default=0.0, kind=AT_LEAST_0)
    """decoupled weight decay of critics and actor; without effect on weights of unit norm"""
    value_head: str | type[ValueHead] | None = argument(default="half_squared")
    """"half_squared" (scalars, half the squared error), "categorical", "hl_gauss", or a class derived from
    ``ValueHead``; None: scalar critics by the squared error, or ``n_quantiles``"""
    policy_delay: int = argument(default=3)
    """gradient steps between two updates of actors and temperature"""

    #: Defaults with ``weight_norm``, of the published configuration.
    WITH_WEIGHT_NORM: ClassVar[dict[str, Any]] = {
        "learning_rate": 3e-4,
        "learning_rate_schedule": "linear",
        "final_learning_rate": 3e-5,
        "ent_coef": "auto_0.01",
        "replay_ratio": 2,
        "actor_at_once": True,
        "weight_decay": 0.01,
    }

    def _construct(self, given: Given) -> None:
        if TRUE_OR_FALSE.fits(given["weight_norm"]) and given["weight_norm"]:
            for name, value in self.WITH_WEIGHT_NORM.items():
                default = type(self).constructor_arguments[name].default
                if name in given.passed or default != CrossQ.constructor_arguments[name].default:
                    continue
                if name == "final_learning_rate":
                    if given["learning_rate_schedule"] is None:
                        continue
                    rate = checks.plain_rate(given["learning_rate"])
                    if is_number(rate):  # Others are refused later.
                        value *= rate / self.WITH_WEIGHT_NORM["learning_rate"]
                given[name] = value
        super()._construct(given)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        checks.check_weight_decay(self)
        networks = {who: self.policy_kwargs.get(f"{who}_network", "crossq") for who in ("critic", "actor")}
        others = [f"{who}_network={network!r}" for who, network in networks.items() if network != "crossq"]
        if self.weight_norm and others:
            raise ValueError(
                f"weight_norm=True is of the networks 'crossq', not of {', '.join(others)} in policy_kwargs: leave one "
                "of them out"
            )
        for who in ("critic", "actor"):
            if "weight_norm" in (self.policy_kwargs.get(f"{who}_network_kwargs") or {}):
                raise ValueError(
                    f"weight_norm is an argument of the algorithm, not of policy_kwargs['{who}_network_kwargs']"
                )

    def _auto_target_entropy(self, action_dim: int) -> float:
        return -action_dim / 2 if self.weight_norm else -float(action_dim)

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs: dict[str, Any] = super()._full_policy_kwargs()
        if self.weight_norm:
            sizes = {"critic": (512, 512), "actor": (256, 256)}
            more: dict[str, Any] = {"weight_norm": True, "renorm_warm_up": None, "unbiased": False}
        else:
            sizes, more = {"critic": (2048, 2048), "actor": (256, 256)}, {"kernels": "lecun_normal"}
        bounds = {"log_std_min": -10.0 if self.weight_norm else -20.0, "clip_log_std": True}
        kwargs = with_weight_decay(with_hidden_sizes(kwargs, "crossq", sizes, more, bounds), self.weight_decay)
        is_adam = kwargs.get("optimizer_class", AdamW) in (AdamW, torch.optim.Adam, torch.optim.AdamW)
        if is_adam and not self.weight_norm:
            kwargs["optimizer_kwargs"].setdefault("betas", (0.5, 0.999))
        return kwargs
