"""Agents that learn from data sets: BC, IQL, TD3+BC."""

from collections.abc import Sequence
from typing import Any, ClassVar

from stable_baselines3.common.preprocessing import get_action_dim

from sb3_sample.arguments import check_unused
from sb3_sample.constructor import Given, argument
from sb3_sample.kinds import ABOVE_0, AT_LEAST_0, TRUE_OR_FALSE, number
from sb3_sample.learner.learner import Learner
from sb3_sample.learner.objectives import ClonedValue, Cloning, ImplicitQ, Objective
from sb3_sample.learner.scalars import FixedScalar, LogScalar
from sb3_sample.sac.algorithm import SAC


class BC(SAC):
    """
    Behavioural cloning: ``learn_offline`` maximises the likelihood of the batch's actions under a tanh-Gaussian actor,
    or minimises the squared distance of a deterministic actor's actions to them.

    It needs no critics; those that every policy of the family has consist of one unit here and do not learn. It does
    not learn in an environment, so that arguments of its steps there (``learning_starts``, ``replay_ratio``,
    ``train_freq``, ``gradient_steps``, ``action_noise``) have no effect.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learns_from_data_only: ClassVar[bool] = True
    deterministic: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """whether the actor is deterministic"""

    def _construct(self, given: Given) -> None:
        if TRUE_OR_FALSE.fits(given["deterministic"]) and given["deterministic"]:
            given["backbone"] = "td3"
        super()._construct(given)

    def _check_arguments(self) -> None:
        _check_keeps_no_encoder(self)
        super()._check_arguments()
        backbone = "td3" if self.deterministic else "sac"
        if self.backbone != backbone:
            raise ValueError(
                f"backbone={self.backbone!r} of BC follows from deterministic={self.deterministic}: leave it out"
            )
        _check_no_entropy(self)
        of_values = ("sam_radius", "target_subset", "n_quantiles", "value_head", "actor_first", "reward_scale")
        of_pessimism = ("pessimism", "pessimism_kwargs", "actor_pessimism")
        of_targets = ("gamma", "tau", "target_update_interval")
        check_unused(self, ("prior_data", *of_values, *of_targets, *of_pessimism, "redo_period"), "BC")
        _check_explores_by_actor(self)
        of_critics = ("critic_network", "critic_network_kwargs", "critic_optimizer_kwargs", "n_critics")
        given = sorted({*of_critics, "share_features_extractor"} & self.policy_kwargs.keys())
        if given:
            raise ValueError(f"policy_kwargs describe critics ({', '.join(given)}), which BC has not")

    def _full_policy_kwargs(self) -> dict[str, Any]:
        # Not shared with an augmentation either: the encoder would be the critics', which do not learn.
        kwargs = {**super()._full_policy_kwargs(), "n_critics": 1, "share_features_extractor": False}
        arch = kwargs.get("net_arch")
        if arch is None:
            kwargs["critic_network_kwargs"] = {"hidden_sizes": (1,)}
        elif isinstance(arch, (list, tuple)):
            kwargs["net_arch"] = {"pi": list(arch), "qf": [1]}
        return kwargs if self.deterministic else _starting_wide(kwargs)

    def _make_temperature(self, learner: Learner) -> LogScalar | FixedScalar:
        return FixedScalar(0.0).to(self.device)

    def make_objective(self, learner: Learner) -> Objective:
        _check_copies(learner, ("target_copies", "online_copies"), "BC has no critics to learn from them")
        return Cloning()

    def learn(self, *args: Any, **kwargs: Any) -> Any:
        """
        :raises ValueError: always
        """
        raise ValueError("BC learns from a data set only: call learn_offline(dataset, gradient_steps=...)")


class IQL(SAC):
    """
    Implicit Q-learning (Kostrikov et al. 2021, https://arxiv.org/abs/2110.06169): ``learn_offline`` on a data set, then
    ``learn`` in an environment, with ``prior_data=`` to keep the data set in the batches, as the paper does.

    Defaults are the paper's for MuJoCo; for AntMaze ``expectile=0.9, inverse_temperature=10`` and rewards minus 1, for
    Adroit ``inverse_temperature=0.5`` and a dropout of 0.1 in the actor. The actor differs from the published one: it
    is a tanh-Gaussian, as in the whole family, whose standard deviation depends on the state, and its learning rate is
    constant instead of following a cosine, unless a schedule is passed.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_starts: int = argument(default=1_000, kw_only=False)
    """transitions before the first gradient step of ``learn``, with actions of the policy learned offline, if there is
    one"""
    replay_ratio: float | None = argument(default=1)
    """gradient steps per environment transition of ``learn``"""
    expectile: float = argument(default=0.7, kind=number("lie in (0, 1)", lambda value: 0 < value < 1))
    """expectile of the critics' values that the value network learns; 0.5 is the mean"""
    inverse_temperature: float = argument(default=3.0, kind=AT_LEAST_0)
    """weight of the advantage in an action's weight, ``min(exp(inverse_temperature * advantage), 100)``"""

    def _check_arguments(self) -> None:
        _check_keeps_no_encoder(self)
        super()._check_arguments()
        _check_no_entropy(self)
        check_unused(self, ("backbone",), "IQL, whose actor is a distribution")
        check_unused(self, ("sam_radius", "target_subset", "value_head", "actor_pessimism"), "IQL")
        if isinstance(self.pessimism, (str, type)):
            raise ValueError(f"pessimism={self.pessimism!r} learns from TD errors of the actor, which IQL has not")
        if self.policy_kwargs.get("share_features_extractor"):
            raise ValueError("share_features_extractor=True is not supported by IQL: its value network needs its own")

    def _full_policy_kwargs(self) -> dict[str, Any]:
        # Not shared with an augmentation either.
        return _starting_wide({**super()._full_policy_kwargs(), "share_features_extractor": False})

    def _make_temperature(self, learner: Learner) -> LogScalar | FixedScalar:
        return FixedScalar(0.0).to(self.device)

    def make_objective(self, learner: Learner) -> Objective:
        if learner.critic.trunk.stacks_rows is not None:
            raise ValueError(
                f"critic_network={type(learner.critic.trunk).__name__} sees the actor's next actions in its critics' "
                "step, of which IQL takes none: choose another critic_network in policy_kwargs"
            )
        _check_copies(learner, ("target_copies",), "IQL's critics learn from its value network, which sees one copy")
        return ImplicitQ(learner, self.expectile, self.inverse_temperature)


class TD3BC(SAC):
    """
    TD3+BC (Fujimoto and Gu 2021, https://arxiv.org/abs/2106.06860): TD3 whose actor stays near the batch's actions.
    ``learn`` continues in an environment, near the replay buffer's actions.

    The paper normalises observations by the data set's statistics, as ``normalize_observations=True`` does. Its actor
    climbs the first critic; here it climbs the mean of the critics.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    alpha: float = argument(default=2.5, kind=ABOVE_0)
    """weight of the value, divided by its mean size in the batch, relative to the squared distance"""
    actor_pessimism: float | None = argument(default=0.0)
    """weight of pessimism for the actor's objective alone"""
    policy_delay: int = argument(default=2)
    """gradient steps between two updates of the actor"""
    target_update_interval: int | None = argument(default=None, kw_only=False)
    """gradient steps between two updates of the targets; None: ``policy_delay``"""
    learning_starts: int = argument(default=1_000, kw_only=False)
    """transitions before the first gradient step of ``learn``, with actions of the policy learned offline, if there is
    one"""
    replay_ratio: float | None = argument(default=1)
    """gradient steps per environment transition of ``learn``"""
    backbone: str = argument(default="td3")
    """"td3", no other"""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_unused(self, ("backbone",), "TD3BC, whose actor is deterministic")

    def make_objective(self, learner: Learner) -> Objective:
        return ClonedValue(self.alpha)


def _starting_wide(kwargs: dict[str, Any]) -> dict[str, Any]:
    """Arguments of a policy whose actor learns by the likelihood of actions, starting at a standard deviation of 1."""
    return {**kwargs, "actor_kwargs": {"initial_std": 1.0, **(kwargs.get("actor_kwargs") or {})}}


def _check_no_entropy(agent: SAC) -> None:
    check_unused(agent, ["ent_coef", "task_temperatures"], f"{type(agent).__name__}, which rewards no entropy")
    # A number once a model is made.
    if agent.target_entropy not in ("auto", -get_action_dim(agent.action_space) / 2):
        check_unused(agent, ["target_entropy"], f"{type(agent).__name__}, which rewards no entropy")


def _check_keeps_no_encoder(agent: SAC) -> None:
    if agent.resets_keep:
        raise ValueError(
            f"resets_keep={agent.resets_keep!r} keeps one encoder that actors share with the critics, and the networks "
            f"of {type(agent).__name__} share none: leave it out"
        )


def _check_copies(learner: Learner, names: Sequence[str], why: str) -> None:
    """Check that an augmentation makes no copies of transitions that nothing would learn from."""
    for name in names:
        if (n := getattr(learner, name)) > 1:
            raise ValueError(f"{name}={n} of the augmentation means nothing here, since {why}: leave it out")


def _check_explores_by_actor(agent: SAC) -> None:
    """Check that neither exploration nor pessimism needs critics that learn."""
    if agent.exploration != "actor" or isinstance(agent.pessimism, (str, type)):
        raise ValueError(
            f"exploration={agent.exploration!r} and pessimism={agent.pessimism!r} ask for critics, which "
            f"{type(agent).__name__} has not: leave them out"
        )
