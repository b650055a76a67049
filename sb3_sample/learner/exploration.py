"""Exploration: choice of the actions in training. ``predict`` and evaluation use the pessimistic actor alone."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch.optim import Optimizer

from sb3_sample.kinds import ABOVE_0, AT_LEAST_0, DICT, TRUE_OR_FALSE, Kind, check_value, integer, is_number
from sb3_sample.learner import losses
from sb3_sample.learner.batch import Batch, for_each
from sb3_sample.learner.parts import Learning, Part
from sb3_sample.learner.pessimism import epistemic_std
from sb3_sample.learner.scalars import BoundedLogScalar, FixedScalar, LogScalar
from sb3_sample.learner.target import at_rest, values
from sb3_sample.networks import NETWORKS, Projected, linear, project_weights, widened
from sb3_sample.optim import AdamW
from sb3_sample.warn import warn


class Exploration(Part):
    """
    Exploration by the actor itself, sampled or, if it is deterministic, with added noise; base class of the others.

    :param learner: the learner, whose networks exist already
    """

    #: Whether ``torch.vmap`` can map :meth:`sampled` over learners: it takes no gradients itself.
    can_be_mapped: ClassVar[bool] = True

    def __init__(self, learner: Learning):
        super().__init__()

    def act(self, learner: Learning, observations: Any) -> torch.Tensor:
        """
        Sample the actions of the training. An explorer that overrides :meth:`sampled` and not this method is captured
        on a GPU.

        :param learner: the learner
        :param observations: tensors on the device of the model, (B, O) or a dict of them
        :return: actions in [-1, 1], (B, A)
        """
        return self.sampled(learner, observations, self.draw_noise(learner, observations))

    def draw_noise(self, learner: Learning, observations: Any) -> torch.Tensor:
        """
        Draw the noise of one step's actions.

        :param learner: the learner
        :param observations: tensors on the device of the model, (B, O) or a dict of them
        :return: standard normal noise, (B, A)
        """
        rows = next(iter(observations.values())) if isinstance(observations, dict) else observations
        like = next(learner.actor.parameters())
        return torch.randn_like(like.new_empty((len(rows), learner.actor.action_dim)))

    def sampled(self, learner: Learning, observations: Any, noise: torch.Tensor) -> torch.Tensor:
        """
        Compute actions, on tensors only: this function is captured.

        :param learner: the learner
        :param observations: tensors on the device of the model, (B, O) or a dict of them
        :param noise: from :meth:`draw_noise`, (B, A)
        :return: actions in [-1, 1], (B, A)
        """
        mean, log_std = learner.actor.gaussian(learner.actor.features(observations))
        return learner.actor.act(mean, log_std.exp(), noise)

    def update(self, learner: Learning, batch: Batch, noise: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """
        Learn from the step's batch; called after the critics and the actor were updated.

        :param learner: the learner
        :param batch: the step's batch
        :param noise: standard normal noise of the sampled actions, (B, A); drawn if None
        :return: what to log, by name, scalars
        """
        return {}


class ScaledNoise(Exploration):
    """
    Exploration by the actor itself, its standard deviation multiplied.

    :param learner: the learner, whose networks exist already
    :param std_multiplier: factor on the standard deviation while exploring, above 0
    :raises ValueError: if it is out of range
    """

    def __init__(self, learner: Learning, std_multiplier: float):
        super().__init__(learner)
        self.std_multiplier = check_value("std_multiplier", std_multiplier, ABOVE_0)

    def sampled(self, learner: Learning, observations: Any, noise: torch.Tensor) -> torch.Tensor:
        mean, log_std = learner.actor.gaussian(learner.actor.features(observations))
        return learner.actor.act(mean, self.std_multiplier * log_std.exp(), noise)


class HeldNoise(Exploration):
    """
    FlashSAC's exploration: the actor's noise is held for some steps, ``tanh(mean + std * held)`` with mean and standard
    deviation of each step. The number of steps n is drawn with a probability proportional to ``n ** -exponent``, for
    all environments at once. Noise is held across the end of an episode.

    :param learner: the learner, whose networks exist already
    :param exponent: of the distribution of n, at least 0
    :param longest: largest n
    :raises ValueError: if an argument is out of range
    """

    def __init__(self, learner: Learning, exponent: float = 2.0, longest: int = 16):
        super().__init__(learner)
        check_value("exponent", exponent, AT_LEAST_0)
        check_value("longest", longest, integer(1))
        weights = torch.arange(1, longest + 1, dtype=torch.float64) ** -float(exponent)
        #: Probabilities that a noise is held for at most 1, 2, ... steps, (longest,), on the host.
        self._cumulative = (weights.cumsum(0) / weights.sum()).float()
        self._held: torch.Tensor | None = None
        self._length = self._n_held = 0

    def draw_noise(self, learner: Learning, observations: Any) -> torch.Tensor:
        return self.hold(super().draw_noise(learner, observations), float(torch.rand(())))

    def hold(self, fresh: torch.Tensor, uniform: float) -> torch.Tensor:
        """
        Take one step.

        :param fresh: standard normal noise, (n_envs, A), used if none is held any longer
        :param uniform: number in [0, 1) that then determines how long the new noise is held
        :return: the noise of the step, (n_envs, A)
        """
        held = self._held
        if held is None or held.shape != fresh.shape or self._n_held >= self._length:
            held, self._n_held = fresh, 0
            # The last probability is 1, up to rounding.
            self._length = 1 + min(int((self._cumulative <= uniform).sum()), len(self._cumulative) - 1)
        self._held, self._n_held = held.to(fresh), self._n_held + 1
        return self._held

    def get_extra_state(self) -> dict[str, Any]:
        held = [] if self._held is None else self._held.tolist()
        return {"held": held, "length": self._length, "n_held": self._n_held}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._held = torch.tensor(state["held"]) if state["held"] else None
        self._length, self._n_held = int(state["length"]), int(state["n_held"])


#: Kind of a schedule of the noise.
NOISE_SCHEDULE = Kind(
    "be (first standard deviation, last one, transitions in between), finite and above 0",
    lambda value: (
        isinstance(value, Sequence)
        and len(value) == 3
        and all(is_number(each) and 0 < each < math.inf for each in value)
    ),
)


class ScheduledNoise(Exploration):
    """
    Exploration by a deterministic actor with Gaussian noise, whose standard deviation goes linearly from its first to
    its last value over the transitions of the learner's life, and stays there (DrQ-v2, Yarats et al. 2022). It is the
    actor's ``noise_std``, which the TD target and the actor's loss read too.

    :param learner: the learner, whose networks exist already
    :param schedule: first and last standard deviation, in units of actions in [-1, 1], and the transitions in between
    :raises ValueError: if ``schedule`` is not a schedule, or the actor's noise cannot be changed
    """

    has_state = False

    def __init__(self, learner: Learning, schedule: Sequence[float] = (1.0, 0.1, 500_000)):
        super().__init__(learner)
        check_value("schedule", schedule, NOISE_SCHEDULE)
        if not hasattr(learner.actor, "noise_std"):
            raise ValueError(
                "exploration='scheduled_noise' moves the noise_std of DrQv2's actor, and "
                f"{type(learner.actor).__name__} has none: use DrQv2, or another exploration"
            )
        self._schedule = tuple(float(each) for each in schedule)
        self._set(learner)

    def std(self, n_transitions: int) -> float:
        """
        Compute the standard deviation.

        :param n_transitions: transitions so far
        :return: the standard deviation of the noise
        """
        first, last, n = self._schedule
        return first + (last - first) * min(n_transitions / n, 1.0)

    def _set(self, learner: Learning) -> None:
        learner.actor.noise_std.fill_(self.std(learner.num_transitions))

    def on_step(self, learner: Learning, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        self._set(learner)


#: Kinds of spread of the critics.
UNCERTAINTIES = ("epistemic", "aleatoric", "both")


def spread(q: torch.Tensor, uncertainty: str) -> torch.Tensor:
    """
    Uncertainty of the critics, as optimism adds it (DAC, figure 12; Moskovitz et al. 2021, section 4).

    "epistemic" is the disagreement of the critics, quantile by quantile; "aleatoric" the standard deviation over the
    quantiles of their mean, the spread of the return itself; "both" the root of the sum of the variances, the
    epistemic one averaged over the quantiles.

    :param q: (E, B, K)
    :param uncertainty: one of ``UNCERTAINTIES``
    :return: (B, K) for "epistemic", (B, 1) for the others
    """
    if uncertainty == "epistemic":
        return epistemic_std(q)
    aleatoric = q.mean(dim=0).var(dim=1, unbiased=False, keepdim=True)
    if uncertainty == "both":
        aleatoric = aleatoric + q.var(dim=0, unbiased=False).mean(dim=1, keepdim=True)
    return aleatoric.clamp_min(1e-12).sqrt()


def check_uncertainty(uncertainty: str, learner: Learning) -> None:
    """
    Check the kind of the critics' spread.

    :param uncertainty: the argument
    :param learner: the learner with the critics
    :raises ValueError: if it is unknown, or needs quantiles that the critics do not have
    """
    if uncertainty not in UNCERTAINTIES:
        raise ValueError(f"uncertainty must be one of {UNCERTAINTIES}, not {uncertainty!r}")
    if uncertainty != "epistemic" and (learner.head.n_quantiles or 1) < 2:
        raise ValueError(
            f"uncertainty={uncertainty!r} needs critics with at least two quantiles, "
            f"not n_quantiles={learner.head.n_quantiles}"
        )
    if uncertainty == "epistemic" and learner.critic.n_critics == 1:
        # No error, so that models trained this way can be loaded.
        warn(
            "uncertainty='epistemic' of an optimistic actor is the critics' spread, which is 0 with n_critics=1: it "
            "follows their mean. Pass n_critics of at least 2, n_quantiles with uncertainty='aleatoric', or "
            "exploration='actor'"
        )


class OptimisticExploration(Exploration):
    """
    Base class of the optimistic actors, which only act while training. They maximise the optimistic value ``Q_mean +
    optimism * Q_std`` under a penalty on the KL divergence to the pessimistic actor; optimism and the penalty's
    weight are learned so that the divergence per action dimension approaches ``kl_target``.

    :param learner: the learner, whose networks exist already
    :param kl_target: KL divergence per action dimension to be met, above 0
    :param std_multiplier: factor on the standard deviation while exploring, above 0; left out of the divergence
    :param uncertainty: what Q_std is: "epistemic", "aleatoric" or "both"; see :func:`spread`
    :param adjustment_learning_rate: of optimism and weight, by Adam with beta1 = 0.5
    :raises ValueError: if an argument is out of range or contradicts another
    """

    actor_optimizer: Optimizer
    scalar_optimizer: Optimizer

    def __init__(
        self,
        learner: Learning,
        kl_target: float,
        std_multiplier: float,
        uncertainty: str,
        adjustment_learning_rate: float,
    ):
        super().__init__(learner)
        check_value("kl_target", kl_target, ABOVE_0)
        check_value("std_multiplier", std_multiplier, ABOVE_0)
        check_value("adjustment_learning_rate", adjustment_learning_rate, AT_LEAST_0)
        check_uncertainty(uncertainty, learner)
        self.kl_target = kl_target
        self.std_multiplier = std_multiplier
        self.uncertainty = uncertainty
        self._adjustment_learning_rate = adjustment_learning_rate

    def _make_optimizers(self, learner: Learning, actor: Any, *scalars: tuple[Any, float | None]) -> None:
        """
        Make the optimizers of the optimistic actor and of optimism and weight.

        :param learner: the learner
        :param actor: parameters of the optimistic actor
        :param scalars: parameters of optimism and weight, each with their learning rate; None for the common one
        """
        self.actor_optimizer = learner.make_optimizer(actor)
        common = self._adjustment_learning_rate
        # Their learning rates do not follow the schedule of the others.
        groups = [
            {"params": list(parameters), "lr": common if rate is None else rate, "scheduled": False}
            for parameters, rate in scalars
        ]
        self.scalar_optimizer = AdamW([group for group in groups if group["params"]], betas=(0.5, 0.999))

    def optimizers(self) -> dict[str, Optimizer]:
        return {"actor_optimizer": self.actor_optimizer, "scalar_optimizer": self.scalar_optimizer}

    @abstractmethod
    def _gaussian(
        self, observations: Any, features: torch.Tensor, mean: torch.Tensor, std: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Compute the optimistic actor's Gaussian.

        :param observations: (B, O) or a dict, or as ``learner.encoded`` gives them
        :param features: the pessimistic actor's features of them, (B, F)
        :param mean: the pessimistic actor's pre-tanh mean, (B, A)
        :param std: its standard deviation, (B, A)
        :return: the optimistic actor's mean and, without the multiplier, standard deviation, (B, A) each
        """
        raise NotImplementedError

    def _project(self) -> None:
        """Bring weights of unit norm back to it, after every step of the optimistic actor's optimizer."""
        project_weights(self)

    def _kl(self, learner: Learning, optimistic: Any, pessimistic: Any) -> torch.Tensor:
        """Divergence of the two Gaussians, (B, 1)."""
        return learner.actor.kl(*optimistic, *pessimistic)

    @abstractmethod
    def _optimism(self, learner: Learning) -> torch.Tensor:
        """Optimism, a scalar with gradient."""
        raise NotImplementedError

    @abstractmethod
    def _optimism_loss(self, learner: Learning, optimism: torch.Tensor, kl_gap: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError

    @abstractmethod
    def _kl_weight(self) -> torch.Tensor:
        """Weight of the divergence, a scalar with gradient."""
        raise NotImplementedError

    def _penalty(self, kl_weight: torch.Tensor) -> torch.Tensor:
        """Weight of the divergence in the actor's loss."""
        return kl_weight

    def sampled(self, learner: Learning, observations: Any, noise: torch.Tensor) -> torch.Tensor:
        features = learner.actor.features(observations)
        mean, log_std = learner.actor.gaussian(features)
        mean, std = self._gaussian(observations, features, mean, log_std.exp())
        return learner.actor.act(mean, self.std_multiplier * std, noise)

    def update(self, learner: Learning, batch: Batch, noise: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        observations = learner.encoded(batch.observations)
        with torch.no_grad():
            # In the mode in which it acts: only its own step moves its running statistics.
            pessimistic = at_rest(learner.actor)
            features = pessimistic.features(observations)
            mean, log_std = pessimistic.gaussian(features)
            std = log_std.exp()
        noise = torch.randn_like(mean) if noise is None else noise
        optimism, kl_weight = self._optimism(learner), self._kl_weight()

        optimistic_mean, optimistic_std = self._gaussian(observations, features, mean, std)
        action = learner.actor.learned_action(optimistic_mean, self.std_multiplier * optimistic_std, noise)
        q = values(learner, learner.critic, observations, action)
        q_mean, q_std = q.mean(dim=0), spread(q, self.uncertainty)
        kl = self._kl(learner, (optimistic_mean, optimistic_std), (mean, std))
        upper_value = q_mean + optimism.detach() * q_std
        actor_loss = losses.optimistic_actor_loss(upper_value, kl, self._penalty(kl_weight))
        learner.minimize(self.actor_optimizer, actor_loss)
        self._project()

        kl_gap = kl.detach().mean() / mean.shape[1] - self.kl_target
        optimism_loss = self._optimism_loss(learner, optimism, kl_gap)
        kl_weight_loss = losses.kl_weight_loss(kl_weight, kl_gap)
        learner.minimize(self.scalar_optimizer, optimism_loss + kl_weight_loss)
        return {
            "exploration/actor_loss": actor_loss,
            "exploration/kl": kl_gap + self.kl_target,
            "exploration/optimism": optimism,
            "exploration/optimism_loss": optimism_loss,
            "exploration/kl_weight": kl_weight,
            "exploration/kl_weight_loss": kl_weight_loss,
            "exploration/q_mean": q_mean.mean(),
            "exploration/q_std": q_std.mean(),
        }


class OptimisticShift(OptimisticExploration):
    """
    BRO's optimistic actor (algorithm 2, lines 11, 12, 14, 15; section B.7): a network maps the
    observation and the pessimistic actor's pre-tanh mean to a shift of that mean; the standard deviation is the
    pessimistic one times ``std_multiplier``.

    Where text and published code differ, the code is followed (the published curves were made with it): the
    divergence goes from the optimistic to the pessimistic Gaussian, with the multiplier removed from the
    optimistic standard deviation, so that only the squared shift of the mean remains.

    :param learner: the learner, whose networks exist already
    :param kl_target: KL divergence per action dimension to be met, above 0
    :param std_multiplier: factor on the pessimistic standard deviation, above 0
    :param uncertainty: what Q_std is: "epistemic", "aleatoric" or "both"; see :func:`spread`
    :param initial_optimism: optimism at the start and after a reset
    :param initial_kl_weight: weight of the divergence at the start and after a reset
    :param adjustment_learning_rate: of optimism and weight, by Adam with beta1 = 0.5
    :param network: trunk of the shift network, one of ``NETWORKS``
    :param network_kwargs: its arguments; the defaults are one block, 256 wide, for "bronet", and the network's own
        otherwise
    :param width_factor: factor on the widths of its hidden layers
    :raises ValueError: if an argument is out of range
    """

    def __init__(
        self,
        learner: Learning,
        kl_target: float = 0.05,
        std_multiplier: float = 0.75,
        uncertainty: str = "epistemic",
        initial_optimism: float = 1.0,
        initial_kl_weight: float = 0.25,
        adjustment_learning_rate: float = 3e-5,
        network: str = "bronet",
        network_kwargs: dict[str, Any] | None = None,
        width_factor: int = 1,
    ):
        super().__init__(learner, kl_target, std_multiplier, uncertainty, adjustment_learning_rate)
        check_value("width_factor", width_factor, integer(1))
        if network not in NETWORKS:
            raise ValueError(f"network must be one of {sorted(NETWORKS)}, not {network!r}")
        actor = learner.actor
        action_dim = actor.action_dim
        own = {"width": 256, "n_blocks": 1} if network == "bronet" else {}
        network_kwargs = {**own, **(check_value("network_kwargs", network_kwargs, DICT) or {})}
        made = NETWORKS[network]
        network_kwargs = widened(made, network_kwargs, width_factor)
        if isinstance(actor.trunk, Projected):
            # A projection of its own, like the actor's.
            behind = {"network": made, "network_kwargs": network_kwargs}
            made, network_kwargs = Projected, {**actor.trunk.of_projection, **behind}
        self.trunk = made(actor.features_dim + action_dim, **network_kwargs)
        # Without bias and nearly zero, so that the optimistic actor starts as the pessimistic one.
        self.shift = linear(self.trunk.out_features, action_dim, None, bias=False, gain=0.01)
        self.optimism = BoundedLogScalar("initial_optimism", initial_optimism)
        self.kl_weight = BoundedLogScalar("initial_kl_weight", initial_kl_weight)
        self._make_optimizers(
            learner,
            [*self.trunk.parameters(), *self.shift.parameters()],
            ([*self.optimism.parameters(), *self.kl_weight.parameters()], None),
        )

    def _gaussian(
        self, observations: Any, features: torch.Tensor, mean: torch.Tensor, std: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return mean + self.shift(self.trunk(torch.cat((features, mean), dim=1))), std

    def _project(self) -> None:
        self.trunk.project()

    def _optimism(self, learner: Learning) -> torch.Tensor:
        return self.optimism()

    def _optimism_loss(self, learner: Learning, optimism: torch.Tensor, kl_gap: torch.Tensor) -> torch.Tensor:
        return losses.optimism_loss(optimism, learner.pessimism_rule.beta(), kl_gap)

    def _kl_weight(self) -> torch.Tensor:
        return self.kl_weight()


class OptimisticActor(OptimisticExploration):
    """
    DAC's optimistic actor (algorithm 1, lines 8, 10, 11; eq. 11, 14, 15): a separate policy, with networks like the
    pessimistic one's, that samples with its own standard deviation times ``std_multiplier``.

    Optimism is kept above minus the pessimism in force: ``optimism = exp(p) - beta``, so that at worst both actors
    maximise the same value. A barrier ends its decline 0.001 above that bound.

    Where text and published code differ, the code is followed: the divergence goes from the optimistic to the
    pessimistic Gaussian (eq. 11 writes the other order, ``kl_direction="pessimistic_to_optimistic"``), with the
    multiplier taken out of the sampled distribution (the text's "m-times smaller"; algorithm 1 writes ``m *
    sigma``); the weight of the divergence enters the loss as at most 20; the actor starts from its own weights, not
    from the pessimistic actor's; and it starts anew, with optimism, weight and their optimizers, every 25,000
    environment steps, which the text does not mention (``reinitialize_every=None`` turns it off). At a full reset it
    starts anew like everything else.

    :param learner: the learner, whose networks exist already
    :param kl_target: KL divergence per action dimension to be met, above 0
    :param std_multiplier: m, factor on its standard deviation while exploring, above 0
    :param uncertainty: what Q_std is: "epistemic", "aleatoric" or "both"; see :func:`spread`
    :param initial_optimism: optimism at the start, above minus the pessimism; None: 0.5 above it
    :param initial_kl_weight: weight of the divergence at the start; at 0 it stays 0, while optimism is still adjusted
    :param adjustment_learning_rate: of optimism and weight, by Adam with beta1 = 0.5
    :param optimism_learning_rate: of optimism; None: ``adjustment_learning_rate``; 0: optimism stays at its start
    :param kl_weight_learning_rate: the same for the weight
    :param deterministic: whether it acts and learns by its mean; its standard deviation in the divergence is then the
        pessimistic actor's
    :param kl_direction: "optimistic_to_pessimistic" or "pessimistic_to_optimistic"
    :param reinitialize_every: environment steps after which it starts anew, counted in transitions over the model's
        life, for each task if there are several; None for never
    :raises ValueError: if an argument is out of range
    """

    KL_DIRECTIONS = ("optimistic_to_pessimistic", "pessimistic_to_optimistic")
    MAX_KL_WEIGHT = 20.0
    BARRIER = 1e-3

    def __init__(
        self,
        learner: Learning,
        kl_target: float = 0.5,
        std_multiplier: float = 1.25,
        uncertainty: str = "epistemic",
        initial_optimism: float | None = None,
        initial_kl_weight: float = 1.0,
        adjustment_learning_rate: float = 3e-5,
        kl_direction: str = "optimistic_to_pessimistic",
        reinitialize_every: int | None = 25_000,
        optimism_learning_rate: float | None = None,
        kl_weight_learning_rate: float | None = None,
        deterministic: bool = False,
    ):
        super().__init__(learner, kl_target, std_multiplier, uncertainty, adjustment_learning_rate)
        rule = learner.pessimism_rule
        beta = float(rule.beta())
        distance = 0.5 if initial_optimism is None else initial_optimism + beta
        if learner.num_transitions > 0:
            # Starts during training: a pessimism that moves may have fallen to minus initial_optimism or below.
            distance = max(distance, self.BARRIER)
        # The arm that a bandit draws first must not decide whether an optimism is allowed.
        least = rule.smallest_beta() if learner.num_transitions == 0 else beta
        if not 0 < distance < math.inf or (initial_optimism is not None and distance + least - beta <= 0):
            raise ValueError(
                f"initial_optimism must be above minus the pessimism, {0.0 - least}, not {initial_optimism}"
            )
        check_value("initial_kl_weight", initial_kl_weight, AT_LEAST_0)
        check_value("optimism_learning_rate", optimism_learning_rate, AT_LEAST_0.or_none())
        check_value("kl_weight_learning_rate", kl_weight_learning_rate, AT_LEAST_0.or_none())
        check_value("deterministic", deterministic, TRUE_OR_FALSE)
        if kl_direction not in self.KL_DIRECTIONS:
            raise ValueError(f"kl_direction must be one of {self.KL_DIRECTIONS}, not {kl_direction!r}")
        check_value("reinitialize_every", reinitialize_every, integer(1).or_none("never"))
        self.kl_direction = kl_direction
        self.reinitialize_every = reinitialize_every
        self.actor = learner.make_actor()
        #: How far optimism lies above minus the pessimism.
        self.optimism_distance = LogScalar(distance)
        self.kl_weight = LogScalar(initial_kl_weight) if initial_kl_weight > 0 else FixedScalar(0.0)
        self.deterministic = deterministic
        if deterministic:
            self.std_multiplier = 0.0
        self._make_optimizers(
            learner,
            self.actor.parameters(),
            (self.optimism_distance.parameters(), optimism_learning_rate),
            (self.kl_weight.parameters(), kl_weight_learning_rate),
        )
        self._reached = learner.environment_steps

    def before_updates(self, learner: Learning) -> None:
        every, before, now = self.reinitialize_every, self._reached, learner.environment_steps
        self._reached = now
        if every is not None and now // every > before // every:
            learner.restart(self, learner.make_explorer())

    def get_extra_state(self) -> dict[str, Any]:
        return {"reached": self._reached}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._reached = state["reached"]

    def _gaussian(
        self, observations: Any, features: torch.Tensor, mean: torch.Tensor, std: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        mean, log_std = self.actor.gaussian(self.actor.features(observations))
        return (mean, std) if self.deterministic else (mean, log_std.exp())

    def _project(self) -> None:
        self.actor.project()

    def sampled(self, learner: Learning, observations: Any, noise: torch.Tensor) -> torch.Tensor:
        mean, log_std = self.actor.gaussian(self.actor.features(observations))
        return self.actor.act(mean, self.std_multiplier * log_std.exp(), noise)

    def _kl(self, learner: Learning, optimistic: Any, pessimistic: Any) -> torch.Tensor:
        if not learner.actor.has_std:
            pessimistic = pessimistic[0], optimistic[1]
        if self.kl_direction == "pessimistic_to_optimistic":
            return learner.actor.kl(*pessimistic, *optimistic)
        return learner.actor.kl(*optimistic, *pessimistic)

    def _optimism(self, learner: Learning) -> torch.Tensor:
        return self.optimism_distance() - learner.pessimism_rule.beta()

    def _optimism_loss(self, learner: Learning, optimism: torch.Tensor, kl_gap: torch.Tensor) -> torch.Tensor:
        lowest = -learner.pessimism_rule.beta()
        barrier = torch.clamp(optimism, max=self.BARRIER + lowest)
        return losses.optimism_loss(optimism, lowest, kl_gap) - barrier

    def _kl_weight(self) -> torch.Tensor:
        return self.kl_weight()

    def _penalty(self, kl_weight: torch.Tensor) -> torch.Tensor:
        return kl_weight.clamp(max=self.MAX_KL_WEIGHT)


class OptimisticGradient(Exploration):
    """
    OAC's exploration (Ciosek et al. 2019, proposition 7): the actor's Gaussian with its pre-tanh mean shifted along the
    gradient g of the upper bound ``Q_mean + optimism * Q_std`` there, as far as a KL radius allows::

        mean + sqrt(2 * kl_radius) * S g / sqrt(g' S g),    S the Gaussian's covariance

    which maximises the bound's linear approximation among the Gaussians of the same covariance within that divergence.
    Nothing is learned.

    The defaults are those of the comparison in the DAC paper, as published with its code (optimism 4.36,
    ``sqrt(2 * kl_radius)`` = 3.69).

    :param learner: the learner, whose networks exist already
    :param optimism: weight of the critics' spread in the upper bound, at least 0
    :param kl_radius: KL divergence to the actor's Gaussian, summed over the action's dimensions, at least 0
    :raises ValueError: if an argument is out of range, or if the actor is deterministic
    """

    can_be_mapped = False

    def __init__(self, learner: Learning, optimism: float = 4.36, kl_radius: float = 3.69**2 / 2):
        super().__init__(learner)
        check_value("optimism", optimism, AT_LEAST_0)
        check_value("kl_radius", kl_radius, AT_LEAST_0)
        if not learner.actor.has_entropy:
            raise ValueError("exploration='oac' shifts a Gaussian: it needs backbone='sac', not 'td3'")
        self.optimism = optimism
        self.kl_radius = kl_radius

    def shifted_mean(self, learner: Learning, observations: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Shift the actor's mean along the gradient of the upper bound.

        :param learner: the learner
        :param observations: (B, O) or a dict of them
        :return: the shifted pre-tanh mean and the standard deviation, (B, A) each
        """
        with torch.no_grad():
            mean, log_std = learner.actor.gaussian(learner.actor.features(observations))
        std = log_std.exp()
        # Acting runs in inference mode, which has no gradients.
        with torch.inference_mode(False), torch.enable_grad():
            at = mean.clone().requires_grad_()
            q = values(learner, learner.critic, for_each(torch.clone, observations), torch.tanh(at))
            upper_value = q.mean(dim=(0, 2)) + self.optimism * epistemic_std(q).mean(dim=1)
            (gradient,) = torch.autograd.grad(upper_value.sum(), at)
        scaled = std.square() * gradient
        length = (scaled * gradient).sum(dim=1, keepdim=True).sqrt()
        return mean + math.sqrt(2 * self.kl_radius) * scaled / (length + 1e-6), std

    def sampled(self, learner: Learning, observations: Any, noise: torch.Tensor) -> torch.Tensor:
        mean, std = self.shifted_mean(learner, observations)
        return learner.actor.act(mean, std, noise)


#: Choices by the name that the algorithm's ``exploration`` argument takes.
EXPLORATIONS: dict[str, type[Exploration]] = {
    "actor": Exploration,
    "held_noise": HeldNoise,
    "oac": OptimisticGradient,
    "optimistic_actor": OptimisticActor,
    "optimistic_shift": OptimisticShift,
    "scheduled_noise": ScheduledNoise,
}
