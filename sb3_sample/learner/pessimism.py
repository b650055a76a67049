"""
Pessimism: value of an ensemble of Q, and rules that move the weight of its spread.

Everywhere in this package pessimism beta >= 0 is subtracted: ``Q_mean - beta * Q_std``, with the population
standard deviation over the critics. With two critics the spread is ``|Q1 - Q2| / 2``, so 1 is clipped double
Q-learning (the minimum) and 0 the mean.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.optim import Optimizer

from sb3_sample.errors import ParametersDoNotFit
from sb3_sample.kinds import is_integer, is_number
from sb3_sample.learner.batch import Batch, CriticStep, Extra, Source
from sb3_sample.learner.parts import Learning, Part
from sb3_sample.learner.target import bootstrap, td_target, values
from sb3_sample.optim import AdamW


def epistemic_std(q: torch.Tensor) -> torch.Tensor:
    """
    Disagreement of the critics: population standard deviation over E, quantile by quantile.

    :param q: (E, B, K)
    :return: (B, K)
    """
    if q.shape[0] == 2:
        # Equal to the formula below, and differentiable where the critics agree.
        return (q[0] - q[1]).abs() / 2
    # The floor keeps the gradient of the root finite where all critics agree.
    return q.var(dim=0, unbiased=False).clamp_min(1e-12).sqrt()


def pessimistic_value(q: torch.Tensor, beta: torch.Tensor | float) -> torch.Tensor:
    """
    Value of an ensemble, ``Q_mean - beta * Q_std``, quantile by quantile.

    :param q: (E, B, K)
    :param beta: pessimism, at least 0
    :return: (B, K)
    """
    if q.shape[0] == 1:
        return q[0]
    if isinstance(beta, float):
        if beta == 0:
            return q.mean(dim=0)
        if beta == 1 and q.shape[0] == 2:
            return torch.minimum(q[0], q[1])
    return q.mean(dim=0) - beta * epistemic_std(q)


class Pessimism(Part):
    """
    Constant weight of pessimism, and base class of the rules that move it; 1 is clipped double Q-learning, 0 the mean
    (BRO).

    :param beta: the weight
    :raises ValueError: if it is negative or not finite
    """

    def __init__(self, beta: float):
        super().__init__()
        check_beta("pessimism", beta)
        self.constant = float(beta)

    def beta(self) -> torch.Tensor | float:
        """
        Weight of pessimism.

        :return: the weight in force, at least 0, a number or a scalar tensor without gradient
        """
        return self.constant

    def smallest_beta(self) -> float:
        """
        Bound the weight at the start of a training.

        :return: the smallest weight that may be in force then; by default the weight in force
        """
        return float(self.beta())

    def value(self, q: torch.Tensor) -> torch.Tensor:
        """
        Value of an ensemble under the weight in force.

        :param q: (E, B, K)
        :return: (B, K)
        """
        return pessimistic_value(q, self.beta())

    def draw(self, source: Source) -> Extra | None:
        """
        Draw the transitions that the next update needs besides the step's batch; called before the step.

        :param source: source of the batches
        :return: the transitions, None if there are none
        """
        return None

    def n_further(self, n_held_out: int, n_steps: int) -> int:
        """
        Count the further transitions of :meth:`draw`, for gradient steps that draw their own batches.

        :param n_held_out: transitions of the validation side that a step may draw, 0 while there are fewer
        :param n_steps: steps of every environment in the replay buffer
        :return: transitions of the validation side, or newest steps; 0 where :meth:`draw` would give None
        """
        return 0

    def update(
        self,
        learner: Learning,
        batch: Batch,
        step: CriticStep,
        noise: torch.Tensor | None = None,
        extra: Extra | None = None,
    ) -> dict[str, torch.Tensor]:
        """
        Update the weight; called last in every gradient step, and compiled with it.

        :param learner: the learner, its networks already updated
        :param batch: the step's batch
        :param step: results of the critics' step for it
        :param noise: standard normal noise of the actions sampled for ``extra``, one row each; drawn if None
        :param extra: from :meth:`draw`
        :return: what to log, by name, scalars
        """
        return {}


class LearnedPessimism(Pessimism):
    """
    Weight that is learned by gradient descent, one step of Adam a gradient step, and kept at least 0: GPL, OPL and
    VPL are choices of ``loss`` and ``source``, and so are the variants of the VPL paper
    (https://arxiv.org/abs/2403.01014, figures 8 and 9).

    With the lower bound's TD error ``e = Q_mean(s, a) - r - gamma * (V_lb(s'))``, where ``V_lb`` contains beta:

    - ``loss="squared"`` is VPL's ``mean(e^2)`` (VPL, eq. 12); the gradient goes through the beta of ``V_lb``;
    - ``loss="dual"`` is ``beta * mean(e)`` with the error as a constant (VPL, eq. 6): beta rises where the target
      by the lower bound of the next state exceeds the critics' mean; for "on_policy", where ``e`` is the return minus
      the lower bound of its state and action, beta rises where that bound exceeds the return.

    - ``source="replay"`` takes the gradient step's own batch (GPL), and the critics' step's results for it;
    - ``source="validation"`` takes transitions that are held out of training (VPL), ``round(validation_proportion *
      batch_size)`` of them, at least 1; beta takes no step before as many are held out;
    - ``source="recent"`` takes the latest 8 steps of every environment;
    - ``source="on_policy"`` (OPL) takes the latest 8 steps too and replaces the estimate ``Q_mean`` by the
      TD(0.95) return of the recorded steps; see :meth:`lambda_returns`.

    Left open by the papers and decided here: the bootstrap ``V_lb`` is the TD target's, from the target critics and a
    fresh action of the actor, with its entropy bonus, since beta corrects the bias of that value; with
    ``target_subset`` it comes from the critics of the step's own target, for every source. ``Q_mean(s, a)`` is the mean
    of all online critics, which are trained towards that target. The error on the batch of replay uses the values from
    before the step, which need no further computation. Quantiles are averaged after the spread over critics is taken.

    At a reset beta and its optimizer start anew, as every learned number does.

    :param learner: the learner
    :param loss: "squared" or "dual"
    :param source: "replay", "validation", "recent" or "on_policy"; the last with "dual" only
    :param initial_pessimism: beta at the start and after a reset
    :param learning_rate: of beta
    :param segment_length: steps of every environment that "recent" and "on_policy" take
    :param td_lambda: lambda of the returns of "on_policy"
    :raises ValueError: if an argument is out of range or contradicts another
    """

    def __init__(
        self,
        learner: Learning,
        loss: str,
        source: str,
        initial_pessimism: float = 1.0,
        learning_rate: float = 5e-5,
        segment_length: int = 8,
        td_lambda: float = 0.95,
    ):
        check_beta("initial_pessimism", initial_pessimism)
        super().__init__(initial_pessimism)
        if loss not in ("squared", "dual"):
            raise ValueError(f"loss of the pessimism must be 'squared' or 'dual', not {loss!r}")
        sources = ("replay", "validation", "recent", "on_policy")
        if source not in sources:
            raise ValueError(f"source of the pessimism's transitions must be one of {sources}, not {source!r}")
        if not is_number(learning_rate) or not 0 <= learning_rate < math.inf:
            raise ValueError(f"learning_rate of the pessimism must be at least 0 and finite, not {learning_rate!r}")
        if not is_integer(segment_length) or segment_length < 1:
            raise ValueError(f"segment_length must be an integer of at least 1, not {segment_length!r}")
        if not is_number(td_lambda) or not 0 <= td_lambda <= 1:
            raise ValueError(f"td_lambda must lie in [0, 1], not {td_lambda!r}")
        if source == "on_policy" and loss != "dual":
            raise ValueError(f"source='on_policy' goes with loss='dual' only, not {loss!r}")
        self.loss, self.source = loss, source
        self.segment_length, self.td_lambda = segment_length, td_lambda
        self.weight = nn.Parameter(torch.tensor(float(initial_pessimism)))
        # Its learning rate does not follow the schedule of the others.
        self.optimizer = AdamW([{"params": [self.weight], "scheduled": False}], lr=learning_rate)
        # Steps of every environment since the actor began to act (or since a reset renewed it).
        self._n_steps = 0

    def optimizers(self) -> dict[str, Optimizer]:
        return {"optimizer": self.optimizer}

    def beta(self) -> torch.Tensor:
        return self.weight.detach()

    def on_step(self, learner: Learning, rewards: Any, dones: Any, infos: list[dict[str, Any]]) -> None:
        # The actions of the warm-up are random.
        self._n_steps = self._n_steps + 1 if learner.num_transitions - len(dones) >= learner.learning_starts else 0

    def on_environment_reset(self, learner: Learning) -> None:
        # The step before belongs to an episode that was broken off, which the buffer does not show.
        self._n_steps = 0

    def get_extra_state(self) -> dict[str, Any]:
        return {"n_steps": self._n_steps}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._n_steps = state["n_steps"]

    def draw(self, source: Source) -> Extra | None:
        """
        Draw the transitions of the source.

        :param source: source of the batches
        :return: the transitions of "validation", "recent" and "on_policy"; None if there are too few yet
        """
        if self.source == "replay":
            return None
        if self.source == "validation":
            held_out = source.held_out()
            return None if held_out is None else Extra(held_out)
        if self.source == "on_policy" and self._n_steps < self.segment_length:
            return None
        return source.latest(self.segment_length)

    def n_further(self, n_held_out: int, n_steps: int) -> int:
        """
        Count the further transitions of :meth:`draw`, for gradient steps that draw their own batches.

        :param n_held_out: transitions of the validation side that a step may draw, 0 while there are fewer
        :param n_steps: steps of every environment in the replay buffer
        :return: transitions of the validation side, or newest steps; 0 where :meth:`draw` would give None
        """
        if self.source == "replay":
            return 0
        if self.source == "validation":
            return n_held_out
        acted = min(self._n_steps, n_steps) if self.source == "on_policy" else n_steps
        return self.segment_length if acted >= self.segment_length else 0

    def update(
        self,
        learner: Learning,
        batch: Batch,
        step: CriticStep,
        noise: torch.Tensor | None = None,
        extra: Extra | None = None,
    ) -> dict[str, torch.Tensor]:
        metrics = {"pessimism/beta": self.beta().clone()}
        if self.source == "replay":
            error = self._td_error(batch, step)
        elif extra is None:
            return metrics
        else:
            error = self._error(learner, extra, noise, step.subset)
        loss = error.square().mean() if self.loss == "squared" else self.weight * error.detach().mean()
        learner.minimize(self.optimizer, loss)
        with torch.no_grad():
            self.weight.copy_(self.weight.clamp(min=0))
        return {**metrics, "pessimism/loss": loss, "pessimism/error": error.mean()}

    def _error(
        self, learner: Learning, extra: Extra, noise: torch.Tensor | None, subset: torch.Tensor | None
    ) -> torch.Tensor:
        """
        Compute the lower bound's error on transitions other than the step's.

        :return: error of the lower bound on transitions other than the step's, (B,), its gradient through beta
        """
        batch = extra.batch
        # The spread is that of the critics to which beta is applied: a subset's differs from that of all critics.
        judged = self._judge(learner, batch, noise, subset)
        if self.source != "on_policy":
            return self._td_error(batch, judged)
        assert extra.ends is not None
        shape = extra.ends.shape
        returns = self.lambda_returns(
            batch.rewards.view(shape),
            batch.dones.view(shape),
            extra.ends,
            self.value(judged.next_q).mean(dim=1).view(shape),
            judged.entropy_bonus.view(shape),
            learner.gamma,
            self.td_lambda,
        )
        return returns.view(-1) - self.value(judged.q).mean(dim=1)

    @staticmethod
    def _judge(
        learner: Learning, batch: Batch, noise: torch.Tensor | None, subset: torch.Tensor | None = None
    ) -> CriticStep:
        """Compute the results of the critics' step on other transitions."""
        with torch.no_grad():
            next_q, entropy_bonus = bootstrap(learner, batch, learner.temperature_of(batch), noise, subset)
            q = values(learner, learner.critic, batch.observations, batch.actions)
            return CriticStep(q, learner.head.values(next_q), entropy_bonus, subset)

    def _td_error(self, batch: Batch, step: CriticStep) -> torch.Tensor:
        """TD error of the lower bound, ``Q_mean(s, a) - r - gamma V_lb(s')``, (B,)."""
        next_value = pessimistic_value(step.next_q, self.weight).mean(dim=1, keepdim=True)
        return step.q.mean(dim=(0, 2)) - td_target(batch, next_value, step.entropy_bonus).squeeze(1)

    @staticmethod
    def lambda_returns(
        rewards: torch.Tensor,
        terminated: torch.Tensor,
        ends: torch.Tensor,
        next_values: torch.Tensor,
        entropy_bonus: torch.Tensor,
        gamma: float,
        td_lambda: float,
    ) -> torch.Tensor:
        """
        TD(lambda) returns of recent segments, OPL's estimate of the true value that the lower bound is compared with
        (VPL, table 2; Kuznetsov et al. 2021)::

            G_t = r_t + gamma * (h + (1 - lambda) * V + lambda * G_{t+1})     within an episode
            G_t = r_t + gamma * (h + V)                                       at the segment's end and at a time limit
            G_t = r_t                                                         at a termination

        V and h are the lower bound of, and the entropy bonus for, a fresh action of the actor in the next state: the
        log-probability of the recorded one is infinite where tanh rounds to 1. After a time limit the next state is the
        one that the episode ended in, not the first of the next episode.

        :param rewards: r, (T, N) for N environments
        :param terminated: 1 where the episode terminated, (T, N)
        :param ends: 1 where it ended, by termination or truncation, (T, N)
        :param next_values: V, (T, N)
        :param entropy_bonus: h, (T, N)
        :param gamma: discount factor
        :param td_lambda: lambda
        :return: (T, N)
        """
        returns = []
        following = next_values[-1]
        for t in reversed(range(len(rewards))):
            weight = td_lambda * (1 - ends[t])
            future = torch.lerp(next_values[t], following, weight) + entropy_bonus[t]
            following = rewards[t] + gamma * (1 - terminated[t]) * future
            returns.append(following)
        return torch.stack(returns[::-1])


class TOP(Pessimism):
    """
    Tactical optimism and pessimism (Moskovitz et al. 2021, algorithm 2): an exponential-weights bandit chooses beta
    among a few values, one arm at a time, and is rewarded with the improvement of the episodic return.

    With the arm's probability p at the time it was drawn, its log-weight grows by ``learning_rate * improvement /
    p``. The improvement is the return of an episode minus that of the same environment's episode before, undiscounted
    and in the rewards' own unit, averaged over the episodes that ended under the arm; an environment's first episode
    has none. One arm is in force for all environments. Once each of them has ended an episode under it, the bandit
    learns and draws anew; a second episode of a fast environment counts as well.

    The papers' learning rate is for raw returns, up to 1000 an episode, with which the bandit decides quickly. Lower it
    for larger returns.

    At a reset the bandit starts anew too, so that the drop of the return does not count against the arm in force.

    :param learner: the learner
    :param arms: the values of beta
    :param learning_rate: of the bandit
    :raises ValueError: if an argument is out of range
    """

    #: Smallest probability by which an arm's feedback is divided.
    MIN_PROBABILITY = 1e-3

    weight: torch.Tensor

    def __init__(self, learner: Learning, arms: Sequence[float] = (0.0, 1.0), learning_rate: float = 0.1):
        if isinstance(arms, str) or not isinstance(arms, (Sequence, np.ndarray)) or len(arms) < 2:
            raise ValueError(f"arms must be at least two values of the pessimism, not {arms!r}")
        for beta in arms:
            check_beta("each of arms", beta)
        if not is_number(learning_rate) or not 0 <= learning_rate < math.inf:
            raise ValueError(f"learning_rate of the bandit must be at least 0 and finite, not {learning_rate!r}")
        super().__init__(arms[0])
        self.arms = tuple(float(beta) for beta in arms)
        self.learning_rate = learning_rate
        #: The bandit's weights, kept on the host.
        self.log_weights = [0.0] * len(self.arms)
        self.arm = 0
        self.register_buffer("weight", torch.tensor(0.0), persistent=False)
        # By environment: the last episode's return, and the improvements under the arm in force.
        self._previous: dict[int, float] = {}
        self._improvements: dict[int, list[float]] = {}
        self._draw()

    def probabilities(self) -> list[float]:
        """
        Compute the bandit's distribution.

        :return: each arm's probability of being drawn
        """
        top = max(self.log_weights)
        weights = [math.exp(w - top) for w in self.log_weights]
        return [w / sum(weights) for w in weights]

    def _draw(self) -> None:
        probabilities = torch.tensor(self.probabilities(), dtype=torch.float64)
        self.arm = int(torch.multinomial(probabilities, 1))
        self.weight.fill_(self.arms[self.arm])
        self._improvements = {}

    def beta(self) -> torch.Tensor:
        return self.weight

    def smallest_beta(self) -> float:
        return min(self.arms)

    def on_step(self, learner: Learning, rewards: Any, dones: Any, infos: list[dict[str, Any]]) -> None:
        for index in np.flatnonzero(dones):
            # An episode whose worker has died has no return.
            if "episode" not in infos[index] and "worker_died" not in infos[index]:
                raise ValueError(
                    f"TOP learns from episodic returns, and environment {index} reports none: wrap it in "
                    "stable_baselines3.common.monitor.Monitor, as make_vec_env does"
                )

    def on_episode_end(self, learner: Learning, env_index: int, episode_return: float) -> None:
        # A loaded model may have had more environments.
        for gone in [index for index in self._improvements if index >= learner.n_envs]:
            del self._improvements[gone]
        improvements = self._improvements.setdefault(env_index, [])
        if env_index in self._previous:
            improvements.append(episode_return - self._previous[env_index])
        self._previous[env_index] = episode_return
        if len(self._improvements) < learner.n_envs:
            return
        all_improvements = [x for of_env in self._improvements.values() for x in of_env]
        if all_improvements:
            feedback = sum(all_improvements) / len(all_improvements)
            p = max(self.probabilities()[self.arm], self.MIN_PROBABILITY)
            self.log_weights[self.arm] += self.learning_rate * feedback / p
        self._draw()

    def get_extra_state(self) -> dict[str, Any]:
        return {
            "arm": self.arm,
            "log_weights": list(self.log_weights),
            "previous": list(self._previous.items()),
            "improvements": [(index, list(values)) for index, values in self._improvements.items()],
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        if len(state["log_weights"]) != len(self.arms):
            raise ParametersDoNotFit(
                f"arms={self.arms} are not as many as the {len(state['log_weights'])} of the saved bandit"
            )
        self.arm, self.log_weights = state["arm"], list(state["log_weights"])
        self.weight.fill_(self.arms[self.arm])
        self._previous = dict(state["previous"])
        self._improvements = {index: list(values) for index, values in state["improvements"]}

    def update(
        self,
        learner: Learning,
        batch: Batch,
        step: CriticStep,
        noise: torch.Tensor | None = None,
        extra: Extra | None = None,
    ) -> dict[str, torch.Tensor]:
        return {"pessimism/beta": self.weight.clone()}


def check_beta(name: str, beta: Any) -> None:
    """
    Check a weight of pessimism.

    :param name: name of the argument
    :param beta: a weight of pessimism
    :raises ValueError: if it is not a finite number of at least 0
    """
    if not is_number(beta) or not 0 <= beta < math.inf:
        raise ValueError(f"{name} must be at least 0 and finite (0 is the mean, 1 the minimum of two), not {beta!r}")


def gpl(learner: Learning, initial_pessimism: float = 1.0, learning_rate: float = 5e-5) -> LearnedPessimism:
    """
    Generalized pessimism learning (Cetin and Celiktutan 2023; VPL, eq. 6): the dual loss on replay.

    :param learner: the learner
    :param initial_pessimism: beta at the start
    :param learning_rate: of beta; 5e-5 in the VPL paper, 1e-5 in the regularization study (2403.00514)
    :return: the rule
    """
    return LearnedPessimism(learner, "dual", "replay", initial_pessimism, learning_rate)


def opl(
    learner: Learning,
    initial_pessimism: float = 1.0,
    learning_rate: float = 5e-5,
    segment_length: int = 8,
    td_lambda: float = 0.95,
) -> LearnedPessimism:
    """
    On-policy pessimism learning (Kuznetsov et al. 2021; VPL, tables 2 and 5): the dual loss against the TD(lambda)
    returns of the latest steps.

    :param learner: the learner
    :param initial_pessimism: beta at the start
    :param learning_rate: of beta
    :param segment_length: steps of every environment
    :param td_lambda: lambda of the returns
    :return: the rule
    """
    return LearnedPessimism(learner, "dual", "on_policy", initial_pessimism, learning_rate, segment_length, td_lambda)


def vpl(
    learner: Learning,
    initial_pessimism: float = 1.0,
    learning_rate: float = 5e-5,
    loss: str = "squared",
    source: str = "validation",
) -> LearnedPessimism:
    """
    Validation pessimism learning (VPL, eq. 12 and algorithm 1), and its variants.

    :param learner: the learner
    :param initial_pessimism: beta at the start
    :param learning_rate: of beta
    :param loss: "squared" or "dual"
    :param source: "validation", "replay" or "recent"
    :return: the rule
    :raises ValueError: if the source is another
    """
    if source == "on_policy":
        raise ValueError("source must be 'validation', 'replay' or 'recent', not 'on_policy', which is OPL's")
    return LearnedPessimism(learner, loss, source, initial_pessimism, learning_rate)


#: Rules that move pessimism, by the name that the algorithm's ``pessimism`` argument takes; a number is constant.
PESSIMISMS: dict[str, Any] = {"gpl": gpl, "opl": opl, "top": TOP, "vpl": vpl}
