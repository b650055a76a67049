"""SimBa and SimbaV2."""

from typing import Any

from stable_baselines3.common.type_aliases import Schedule

from sb3_sample.constructor import argument
from sb3_sample.kinds import AT_LEAST_0, integer
from sb3_sample.learner.heads import ValueHead
from sb3_sample.learner.reward_scale import RewardScale
from sb3_sample.sac import checks
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.policy_kwargs import with_networks, with_weight_decay

#: Width and blocks of the published networks.
_SIZES: dict[str, dict[str, Any]] = {
    "critic": {"width": 512, "n_blocks": 2},
    "actor": {"width": 128, "n_blocks": 1},
}


class SimBa(SAC):
    """
    SimBa: soft actor-critic with a simplicity bias of its networks (Lee et al. 2024, https://arxiv.org/abs/2410.09754).

    Observations normalised by their running mean and standard deviation, residual networks with layer norms and
    inverted bottlenecks ("simba"), weight decay, and little else. Defaults are those of the published runs on DeepMind
    Control, with two environment steps per action (``action_repeat=2`` of the environment): one critic, since the
    episodes do not terminate; where they do (Gymnasium's MuJoCo, HumanoidBench), two critics and their minimum,
    ``n_critics=2``. docs/simba.md gives the sources.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_rate: float | Schedule = argument(default=1e-4, kw_only=False)
    """learning rate of actor, critics and temperature; a number or a function of the remaining progress (from 1 to
    0)"""
    learning_starts: int = argument(default=5_000, kw_only=False)
    """transitions with uniformly random actions before the first gradient step, counted over the model's life"""
    ent_coef: str | float = argument(default="auto_0.01", kw_only=False)
    """temperature: "auto_0.01" learns it from that start, a number fixes it"""
    n_critics: int = argument(default=1, kind=integer(1))
    """number of critics; 2 where episodes terminate"""
    weight_decay: float = argument(default=1e-2, kind=AT_LEAST_0)
    """decoupled weight decay of critics and actor"""
    normalize_observations: bool = argument(default=True)
    """whether the networks read observations minus their running mean, divided by their running standard deviation. The
    statistics belong to the policy and are updated only while training"""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        checks.check_weight_decay(self)

    def _n_critics(self) -> int:
        return self.n_critics

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs = {**super()._full_policy_kwargs(), "n_critics": self.n_critics}
        return with_weight_decay(with_networks(kwargs, "simba", _SIZES), self.weight_decay)


class SimbaV2(SAC):
    """
    SimbaV2: hyperspherical normalisation (Lee et al. 2025, https://arxiv.org/abs/2502.15280).

    Networks whose weights have unit norm and whose features lie on a sphere ("simbav2"), critics as classifiers over
    101 atoms in [-5, 5], rewards divided by a running measure of the return, normalised observations, and a learning
    rate that falls linearly to half over the planned gradient steps. Actor and temperature learn before the critics.

    Defaults are those of the published runs on DeepMind Control, with two environment steps per action
    (``action_repeat=2`` of the environment): one critic, since the episodes do not terminate. Where they do
    (Gymnasium's MuJoCo, HumanoidBench), there are two, with the distribution of the smaller one, ``n_critics=2``; and
    ``gamma`` is 1 - 5 / T within [0.95, 0.995], T being the episode's length in actions.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_rate: float | Schedule = argument(default=1e-4, kw_only=False)
    """learning rate of actor, critics and temperature at the start; a function of the remaining progress (from 1 to 0)
    requires ``learning_rate_schedule=None``"""
    learning_starts: int = argument(default=5_000, kw_only=False)
    """transitions with uniformly random actions before the first gradient step, counted over the model's life"""
    ent_coef: str | float = argument(default="auto_0.01", kw_only=False)
    """temperature: "auto_0.01" learns it from that start, a number fixes it"""
    n_critics: int = argument(default=1, kind=integer(1))
    """number of critics; 2 where episodes terminate"""
    value_head: str | type[ValueHead] | None = argument(default="categorical")
    """"categorical", "hl_gauss", or a class derived from ``ValueHead``; None: scalar critics, or ``n_quantiles``"""
    actor_first: bool = argument(default=True)
    """whether actors and temperature learn before the critics in a gradient step"""
    learning_rate_schedule: str | None = argument(default="linear")
    """"linear" or "cosine": decay to ``final_learning_rate`` over the planned gradient steps; None for none"""
    final_learning_rate: float = argument(default=5e-5)
    """rate at the end of the schedule"""
    reward_scale: str | type[RewardScale] | None = argument(default="simbav2")
    """rule by which rewards are divided by a running measure of the return; None for none"""
    normalize_observations: bool = argument(default=True)
    """whether the networks read observations minus their running mean, divided by their running standard deviation. The
    statistics belong to the policy and are updated only while training"""

    def _n_critics(self) -> int:
        return self.n_critics

    def _full_policy_kwargs(self) -> dict[str, Any]:
        return with_networks({**super()._full_policy_kwargs(), "n_critics": self.n_critics}, "simbav2", _SIZES)
