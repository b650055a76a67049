"""The rivals of the papers: rules of pessimism (TOP, GPL, OPL), OAC's exploration, SR-SAC's resets."""

from collections.abc import Sequence
from typing import Any, ClassVar

from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_sample.arguments import check_unused
from sb3_sample.learner.exploration import Exploration
from sb3_sample.sac import arguments
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.policies import SACPolicy

#: SR-SAC's environment steps between two resets. An object of its own, which no 160_000 in a program is.
SR_SAC_RESETS = int("160_000")


class _RuleSAC(SAC):
    """SAC with one rule that moves pessimism, by the name that ``pessimism`` would take."""

    rule: ClassVar[str]
    #: The rule's arguments by their names here.
    rule_arguments: ClassVar[dict[str, str]]

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        pessimism: float | str | None = None,
        **kwargs: Any,
    ):
        super().__init__(policy, env, learning_rate, pessimism=self.rule if pessimism is None else pessimism, **kwargs)

    def _full_pessimism_kwargs(self) -> dict[str, Any]:
        own = {name: getattr(self, argument) for name, argument in self.rule_arguments.items()}
        return {**own, **super()._full_pessimism_kwargs()}

    def _check_arguments(self) -> None:
        if self.pessimism != self.rule:
            raise ValueError(
                f"{type(self).__name__} moves the pessimism itself, pessimism={self.rule!r}, "
                f"not {self.pessimism!r}: leave pessimism={self.pessimism!r} out, or use SAC"
            )
        arguments.check_once("pessimism_kwargs", self.pessimism_kwargs, self.rule_arguments)
        super()._check_arguments()


class TOPSAC(_RuleSAC):
    """
    Soft actor-critic with tactical optimism and pessimism (Moskovitz et al. 2021): a bandit chooses the pessimism of
    each episode. The settings are those of the VPL paper and of the regularization study (2403.00514);
    :class:`~sb3_sample.learner.pessimism.TOP` has the details.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: of actor, critics and temperature
    :param arms: the pessimisms to choose among
    :param bandit_learning_rate: of the bandit, for returns of up to 1000
    :param kwargs: every other argument of :class:`SAC`, by name
    :raises ValueError: if an argument is out of range or contradicts another
    """

    rule = "top"
    rule_arguments: ClassVar[dict[str, str]] = {"arms": "arms", "learning_rate": "bandit_learning_rate"}

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        arms: Sequence[float] = (0.0, 1.0),
        bandit_learning_rate: float = 0.1,
        **kwargs: Any,
    ):
        self.arms = arms
        self.bandit_learning_rate = bandit_learning_rate
        super().__init__(policy, env, learning_rate, **kwargs)


class GPLSAC(_RuleSAC):
    """
    Soft actor-critic with generalized pessimism learning (Cetin and Celiktutan 2023): the dual step on replay
    transitions.
    :class:`~sb3_sample.learner.pessimism.LearnedPessimism` has the details.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: of actor, critics and temperature
    :param initial_pessimism: pessimism at the start and after a reset
    :param pessimism_learning_rate: of the pessimism; 5e-5 as in the VPL paper (1e-5 in the regularization study,
        2403.00514)
    :param kwargs: every other argument of :class:`SAC`, by name
    :raises ValueError: if an argument is out of range or contradicts another
    """

    rule = "gpl"
    rule_arguments: ClassVar[dict[str, str]] = {
        "initial_pessimism": "initial_pessimism",
        "learning_rate": "pessimism_learning_rate",
    }

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        initial_pessimism: float = 1.0,
        pessimism_learning_rate: float = 5e-5,
        **kwargs: Any,
    ):
        self.initial_pessimism = initial_pessimism
        self.pessimism_learning_rate = pessimism_learning_rate
        super().__init__(policy, env, learning_rate, **kwargs)


class OPLSAC(_RuleSAC):
    """
    Soft actor-critic with on-policy pessimism learning (Kuznetsov et al. 2021): the dual step against the TD(lambda)
    returns of the latest steps. :class:`~sb3_sample.learner.pessimism.LearnedPessimism` has the details.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: of actor, critics and temperature
    :param initial_pessimism: pessimism at the start and after a reset
    :param pessimism_learning_rate: of the pessimism
    :param segment_length: steps of each environment that it looks back
    :param td_lambda: lambda of the returns
    :param kwargs: every other argument of :class:`SAC`, by name
    :raises ValueError: if an argument is out of range or contradicts another
    """

    rule = "opl"
    rule_arguments: ClassVar[dict[str, str]] = {
        "initial_pessimism": "initial_pessimism",
        "learning_rate": "pessimism_learning_rate",
        "segment_length": "segment_length",
        "td_lambda": "td_lambda",
    }

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        initial_pessimism: float = 1.0,
        pessimism_learning_rate: float = 5e-5,
        segment_length: int = 8,
        td_lambda: float = 0.95,
        **kwargs: Any,
    ):
        self.initial_pessimism = initial_pessimism
        self.pessimism_learning_rate = pessimism_learning_rate
        self.segment_length = segment_length
        self.td_lambda = td_lambda
        super().__init__(policy, env, learning_rate, **kwargs)


class OAC(SAC):
    """
    Optimistic actor-critic (Ciosek et al. 2019): soft actor-critic that explores with its actor's mean shifted along
    the gradient of an upper bound. The settings are those of the DAC paper's comparison;
    :class:`~sb3_sample.learner.exploration.OptimisticGradient` has the details.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: of actor, critics and temperature
    :param optimism: weight of the critics' spread in the upper bound
    :param kl_radius: KL divergence to the actor, summed over the action's dimensions, that the shift may cost
    :param kwargs: every other argument of :class:`SAC`, by name
    :raises ValueError: if an argument is out of range or contradicts another
    """

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        optimism: float = 4.36,
        kl_radius: float = 3.69**2 / 2,
        exploration: str | type[Exploration] = "oac",
        **kwargs: Any,
    ):
        self.optimism = optimism
        self.kl_radius = kl_radius
        super().__init__(policy, env, learning_rate, exploration=exploration, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.exploration == "oac":
            same = {"optimism": "optimism", "kl_radius": "kl_radius"}
            arguments.check_once("exploration_kwargs", self.exploration_kwargs, same)
        else:
            check_unused(self, ("optimism", "kl_radius"), f"exploration={self.exploration!r}")

    def _full_exploration_kwargs(self) -> dict[str, Any]:
        kwargs = super()._full_exploration_kwargs()
        if self.exploration == "oac":
            kwargs = {"optimism": self.optimism, "kl_radius": self.kl_radius, **kwargs}
        return kwargs


class SRSAC(SAC):
    """
    SR-SAC: soft actor-critic scaled by resetting (D'Oro et al. 2022), with the settings of DAC, VPL and the
    regularization study (2403.00514): sixteen gradient steps a transition, and full-parameter resets every 160,000
    environment steps. (The BRO paper compares with ``replay_ratio=32``.) The original resets every 2,560,000 gradient
    steps, whatever the replay ratio: ``reset_gradient_steps=2_560_000``; at sixteen a transition that is as often.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: of actor, critics and temperature
    :param replay_ratio: gradient steps per environment transition
    :param resets: environment steps between two resets, or the steps of all of them; the default gives way to
        ``reset_gradient_steps``
    :param kwargs: every other argument of :class:`SAC`, by name
    :raises ValueError: if an argument is out of range or contradicts another
    """

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        replay_ratio: float = 16,
        resets: Sequence[int] | int = SR_SAC_RESETS,
        **kwargs: Any,
    ):
        super().__init__(policy, env, learning_rate, replay_ratio=replay_ratio, resets=resets, **kwargs)
