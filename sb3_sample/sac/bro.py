"""BRO, BRO Fast, and BRO on TD3."""

from collections.abc import Sequence
from typing import Any, ClassVar

from stable_baselines3.common.type_aliases import Schedule

from sb3_sample.arguments import check_unused
from sb3_sample.constructor import argument
from sb3_sample.kinds import AT_LEAST_0, DICT, check_value
from sb3_sample.learner.exploration import Exploration
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.sac import checks
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.policy_kwargs import with_weight_decay

#: Critic sizes by their names in BRO, table 7 (parameters of all networks): residual blocks and width.
MODEL_SIZES: dict[str, tuple[int, int]] = {
    "0.55M": (1, 128),
    "1.05M": (1, 256),
    "2.83M": (1, 512),
    "4.92M": (2, 512),
    "26.31M": (3, 1024),
}

#: Environment steps at which all parameters are reset.
BRO_RESETS = (15_000, 50_000, 250_000, 500_000, 750_000, 1_000_000, 1_500_000, 2_000_000)
BRO_FAST_RESETS = (15_000,)

#: Arguments of the optimistic actor.
OPTIMISTIC_SHIFT_SETTINGS = (
    "kl_target",
    "std_multiplier",
    "initial_optimism",
    "initial_kl_weight",
    "adjustment_learning_rate",
)


class BRO(SAC):
    """
    BRO: bigger, regularized, optimistic (Nauman et al. 2024, https://arxiv.org/abs/2405.16158, algorithm 2).

    Two wide BroNet critics with 100 quantiles each and weight decay, their mean as value (no clipped double
    Q-learning), ten gradient steps a transition, full-parameter resets, and an optimistic actor that explores
    while the pessimistic one learns and is evaluated.

    Defaults are those of the published curves. Where the paper's text and the published code differ, the code is
    followed: the actors have one residual block (it is not certain whether table 5 says two), and the divergence goes
    from the optimistic to the pessimistic actor (algorithm 2 has the reverse order). docs/bro.md lists all differences
    and misprints.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_rate: float | Schedule = argument(default=3e-4, kw_only=False)
    """learning rate of actor, critics, optimistic actor and temperature; a number or a function of the remaining
    progress (from 1 to 0)"""
    learning_starts: int = argument(default=2_500, kw_only=False)
    """transitions with uniformly random actions before the first gradient step, counted over the model's life"""
    batch_size: int = argument(default=128, kw_only=False)
    """transitions per gradient step"""
    replay_ratio: float | None = argument(default=10)
    """gradient steps per environment transition after the warm-up, whatever the number of environments; may be below
    1"""
    model_size: str | Sequence[int] | None = argument(default="4.92M")
    """size of the critics by its name in BRO, table 7 ("0.55M", "1.05M", "2.83M", "4.92M", "26.31M"), or (residual
    blocks, width); the actors are the same at every size. None if ``policy_kwargs`` describe the critics"""
    n_quantiles: int | None = argument(default=100)
    """quantiles per critic; None for scalar critics"""
    pessimism: float | str | type[Pessimism] = argument(default=0.0)
    """weight of the critics' spread that is subtracted from their mean, at least 0; or a rule, as in ``SAC``"""
    kl_target: float = argument(default=0.05)
    """target for the KL divergence per action dimension between the two actors, to which optimism is adjusted"""
    std_multiplier: float = argument(default=0.75)
    """factor on the standard deviation of the actor while exploring"""
    initial_optimism: float = argument(default=1.0)
    """weight of the critics' spread for the optimistic actor, at the start"""
    initial_kl_weight: float = argument(default=0.25)
    """weight of the divergence in the optimistic actor's loss, at the start"""
    adjustment_learning_rate: float = argument(default=3e-5)
    """learning rate of optimism and of the divergence's weight"""
    weight_decay: float = argument(default=1e-4, kind=AT_LEAST_0)
    """decoupled weight decay of critics and both actors"""
    exploration: str | type[Exploration] = argument(default="optimistic_shift")
    """policy that acts while training: "optimistic_shift", "actor" for no optimistic actor, or another of ``SAC``'s"""
    exploration_kwargs: dict[str, Any] | None = argument(default=None)
    """further arguments of the exploration"""
    resets: Sequence[int] | int = argument(default=BRO_RESETS)
    """environment steps at which all parameters start anew, counted in transitions over the model's life; or an
    integer, the number of steps between two resets"""
    resets_to: str = argument(default="start")
    """parameters after a reset: "start", those that the model began with, or "fresh", newly drawn ones"""

    temperature_beta1: ClassVar[float] = 0.5

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.exploration == "optimistic_shift":
            same = {name: name for name in OPTIMISTIC_SHIFT_SETTINGS}
            checks.check_once("exploration_kwargs", self.exploration_kwargs, same)
        else:
            check_unused(self, OPTIMISTIC_SHIFT_SETTINGS, f"exploration={self.exploration!r}")
        checks.check_critics_described_once(self, "model_size")
        checks.check_weight_decay(self)

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs: dict[str, Any] = {
            "critic_network": "bronet",
            "actor_network": "bronet",
            **super()._full_policy_kwargs(),
        }
        if kwargs["actor_network"] == "bronet":
            given = check_value("actor_network_kwargs", kwargs.get("actor_network_kwargs"), DICT)
            kwargs["actor_network_kwargs"] = {"width": 256, "n_blocks": 1, **(given or {})}
        if self.model_size is not None:
            kwargs["critic_network_kwargs"] = dict(
                zip(("n_blocks", "width"), _model_size(self.model_size), strict=True)
            )
        return with_weight_decay(kwargs, self.weight_decay)

    def _full_exploration_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_exploration_kwargs()
        if self.exploration == "optimistic_shift":
            kwargs = {**{name: getattr(self, name) for name in OPTIMISTIC_SHIFT_SETTINGS}, **kwargs}
        return kwargs


class BROFast(BRO):
    """
    BRO Fast: BRO with two gradient steps a transition and, as in the published code, the first reset only. The
    arguments are BRO's.
    """

    replay_ratio: float | None = argument(default=2)
    """gradient steps per environment transition"""
    resets: Sequence[int] | int = argument(default=BRO_FAST_RESETS)
    """environment steps at which all parameters start anew"""


class BROTD3(BRO):
    """
    BRO on TD3 instead of soft actor-critic (section E.3 and figure 17; TD3 by Fujimoto et al. 2018): deterministic
    actors, a target actor, smoothed target actions, delayed actor updates, and no entropy. Everything else, including
    the two actors, is BRO's.

    The paper says no more than that; the following is decided here: exploration adds Gaussian noise to the optimistic
    actor's action; the KL divergence of the two actors is taken between Gaussians of that noise around their actions;
    the actors, the target actor and the targets move every second gradient step, as in TD3; ``std_multiplier`` is 1, so
    that the noise has the standard deviation ``exploration_noise``; and pessimism stays at BRO's 0, where TD3 has the
    minimum (``pessimism=1``).

    ``ent_coef`` and ``target_entropy`` have no meaning here.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    exploration_noise: float = argument(default=0.1)
    """standard deviation of the noise while exploring, in actions of [-1, 1]"""
    target_noise: float = argument(default=0.2)
    """standard deviation of the noise on the target's action"""
    target_noise_clip: float = argument(default=0.5)
    """bound of the noise on the target's action"""
    policy_delay: int = argument(default=2)
    """gradient steps between two updates of the actors"""
    target_update_interval: int | None = argument(default=None, kw_only=False)
    """gradient steps between two updates of the target critics; None: ``policy_delay``"""
    std_multiplier: float = argument(default=1.0)
    """factor on the noise of the optimistic actor"""
    backbone: str = argument(default="td3")
    """"td3"; for "sac", use ``BRO``"""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        noise = ("exploration_noise", "target_noise", "target_noise_clip")
        given = self.policy_kwargs.get("actor_kwargs")
        checks.check_once("policy_kwargs['actor_kwargs']", given, {name: name for name in noise})
        if self.backbone != "td3":
            raise ValueError(f"BROTD3 has backbone='td3', not {self.backbone!r}: use BRO")

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_policy_kwargs()
        own = {name: getattr(self, name) for name in ("exploration_noise", "target_noise", "target_noise_clip")}
        return {**kwargs, "actor_kwargs": {**own, **(kwargs.get("actor_kwargs") or {})}}


def _model_size(model_size: str | Sequence[int]) -> tuple[int, int]:
    """Residual blocks and width of a size given by name or by these two numbers."""
    size: Any = MODEL_SIZES.get(model_size) if isinstance(model_size, str) else model_size
    if isinstance(size, Sequence) and len(size) == 2 and all(isinstance(n, int) for n in size):
        return size[0], size[1]
    raise ValueError(f"model_size must be one of {list(MODEL_SIZES)} or (residual blocks, width), not {model_size!r}")
