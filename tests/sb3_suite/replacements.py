"""
The classes that Stable-Baselines3's and SB3-contrib's tests get in the place of their own.

Each takes the arguments that those tests pass, where ours have another name or another meaning by design, and is small
enough for them. Nothing else is changed.
"""

from typing import Any

import sb3_sample

SAC = sb3_sample.SAC


class BRO(sb3_sample.BRO):
    """BRO with small networks. ``net_arch``, by which tests ask for some, describes an MLP and no BroNet."""

    def __init__(self, *args: Any, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any):
        small = {"n_blocks": 1, "width": 16}
        policy_kwargs = {"actor_network_kwargs": small, **(policy_kwargs or {})}
        policy_kwargs.pop("net_arch", None)
        defaults: dict[str, Any] = {"model_size": (1, 16), "exploration_kwargs": {"network_kwargs": small}}
        super().__init__(*args, policy_kwargs=policy_kwargs, **{**defaults, **kwargs})


class QuantileSAC(sb3_sample.SAC):
    """
    SAC with quantile critics, as TQC has. Their number is an argument of the algorithm here, not of the policy. TQC's
    warm-up, since a test that passes none has updates within 128 steps.
    """

    def __init__(self, *args: Any, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any):
        policy_kwargs = dict(policy_kwargs or {})
        kwargs.setdefault("n_quantiles", policy_kwargs.pop("n_quantiles", 25))
        kwargs.setdefault("learning_starts", 100)
        super().__init__(*args, policy_kwargs=policy_kwargs, **kwargs)


class CrossQ(sb3_sample.CrossQ):
    """
    CrossQ. The warm-up of its renormalisation is an argument of the networks here, under another name. SB3-contrib's
    random steps, since a test that passes none has updates within 128 steps.
    """

    def __init__(self, *args: Any, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any):
        policy_kwargs = dict(policy_kwargs or {})
        if "renorm_warmup_steps" in policy_kwargs:
            warm_up = {"renorm_warm_up": policy_kwargs.pop("renorm_warmup_steps")}
            policy_kwargs |= {"critic_network_kwargs": warm_up, "actor_network_kwargs": warm_up}
        kwargs.setdefault("learning_starts", 100)
        super().__init__(*args, policy_kwargs=policy_kwargs, **kwargs)


class MBMAPPO(sb3_sample.MBMAPPO):
    """MBMA that simulates from the first iteration on, a little, with a small model of the environment."""

    def __init__(self, *args: Any, **kwargs: Any):
        small: dict[str, Any] = dict(
            n_simulated=2, warm_up_until=0.0, simulation_horizon=3, dynamics_kwargs={"width": 16, "depth": 1}
        )
        super().__init__(*args, **{**small, **kwargs})


class PlainMBMAPPO(sb3_sample.MBMAPPO):
    """MBMA without simulated actions, with PPO's networks and normalised advantages, which is PPO."""

    def __init__(self, *args: Any, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any):
        if args[:1] == ("MlpPolicy",):
            policy_kwargs = {"net_arch": {"pi": [64, 64], "vf": [64, 64]}, **(policy_kwargs or {})}
        defaults = {"n_simulated": 0, "normalize_advantage": True}
        super().__init__(*args, policy_kwargs=policy_kwargs, **{**defaults, **kwargs})
