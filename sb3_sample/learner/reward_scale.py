"""Scaling of rewards: published rules, which divide by a running measure of the return's size, and a fixed scale."""

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch

from sb3_sample.kinds import ABOVE_0, FINITE, check_value, integer
from sb3_sample.learner.batch import Batch
from sb3_sample.learner.parts import Learning
from sb3_sample.learner.transforms import BatchTransform
from sb3_sample.networks.normalization import RunningMoments
from sb3_sample.warn import warn


class RewardScale(BatchTransform):
    """
    Base class of the rules that divide the rewards of every batch; nothing is subtracted. The division is in the
    precision of the divisor, and its result is rounded once. At a reset of the networks the statistics stay, as the
    replay does.

    :param learner: the learner
    """

    #: Whether the scale is computed from steps in an environment, and does not exist without them.
    needs_steps: ClassVar[bool] = True

    @property
    def waits_for_data(self) -> bool:
        """Whether the scale is yet to be computed from a data set."""
        return False

    def on_dataset(self, return_range: float) -> None:
        """
        Called when learning from a data set begins, if the rule waits for one.

        :param return_range: largest minus smallest return of its episodes
        """

    @abstractmethod
    def divisor(self, task: torch.Tensor | None) -> torch.Tensor:
        """
        Look up the divisor.

        :param task: task numbers of transitions, (B, 1); None if there is one task
        :return: the divisor of their rewards, (B, 1) or a scalar
        """
        raise NotImplementedError

    def scaled(self, rewards: torch.Tensor, task: torch.Tensor | None) -> torch.Tensor:
        """
        Scale rewards.

        :param rewards: (B, 1), or of any shape if there is one task
        :param task: as in :meth:`divisor`
        :return: what the critics learn from in their place
        """
        divisor = self.divisor(task)
        return (rewards.to(divisor.dtype) / divisor).to(rewards.dtype)

    def transform(self, batch: Batch, noise: torch.Tensor | None) -> Batch:
        return batch._replace(rewards=self.scaled(batch.rewards, task_of(batch)))


def task_of(batch: Batch) -> torch.Tensor | None:
    """
    Look up the tasks of transitions: the column "task", or the key "task" of dict observations.

    :param batch: transitions
    :return: task numbers, (B, 1); None if the transitions have none
    """
    dicts = batch.observations if isinstance(batch.observations, dict) else {}
    task = batch.columns.get("task", dicts.get("task"))
    return None if task is None else task.long().reshape(-1, 1)


class ReturnScale(RewardScale):
    """
    Base class of the rules that use the return so far, ``G <- gamma * (1 - done) * G + r`` of each environment, where
    ``done`` is a termination or truncation at this very step: the last reward of an episode begins the next one's
    return, as in the published code. Statistics are of G over steps and environments.

    :param learner: the learner
    """

    largest: torch.Tensor

    def __init__(self, learner: Learning, count: float, dtype: torch.dtype):
        super().__init__(learner)
        self.moments = RunningMoments((), count, dtype)
        self.register_buffer("largest", torch.zeros((), dtype=dtype))
        # G of each environment.
        self._returns: list[float] = []

    def on_step(self, learner: Learning, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        self.feed(rewards, dones, learner.gamma)

    def on_environment_reset(self, learner: Learning) -> None:
        self._returns = []

    def feed(self, rewards: np.ndarray, dones: np.ndarray, gamma: float) -> None:
        """
        Add one step of all environments to the statistics.

        :param rewards: (n_envs,)
        :param dones: whether each environment's episode ended with this step, (n_envs,)
        :param gamma: discount factor
        """
        rewards, ends = np.asarray(rewards, np.float64), np.asarray(dones, bool)
        before = np.array(self._returns) if len(self._returns) == len(rewards) else np.zeros(len(rewards))
        returns = self._discounts(ends, gamma) * before + rewards
        self._returns = returns.tolist()
        values = torch.as_tensor(returns, dtype=self.largest.dtype, device=self.largest.device)
        self._update(values)
        self.largest.copy_(torch.maximum(self.largest, values.abs().max()))

    def _discounts(self, ends: np.ndarray, gamma: float) -> np.ndarray:
        return gamma * (1.0 - ends)

    def _update(self, returns: torch.Tensor) -> None:
        self.moments.update(returns)

    def get_extra_state(self) -> dict[str, Any]:
        return {"returns": list(self._returns)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._returns = list(state["returns"])


class StdScale(ReturnScale):
    """
    XQC's rule (Palenicek et al. 2026): the divisor is the standard deviation of G plus ``eps``, from population
    statistics in float64 without start values. The rewards are unchanged until two values of G differ.

    :param learner: the learner
    :param eps: added to the standard deviation
    """

    def __init__(self, learner: Learning, eps: float = 1e-8):
        super().__init__(learner, 0.0, torch.float64)
        check_value("eps", eps, ABOVE_0)
        self.eps = eps

    def divisor(self, task: torch.Tensor | None) -> torch.Tensor:
        return self.moments.var.sqrt() + self.eps

    def scaled(self, rewards: torch.Tensor, task: torch.Tensor | None) -> torch.Tensor:
        return torch.where(self.moments.var > 0, super().scaled(rewards, task), rewards)


class StdOrMaxScale(ReturnScale):
    """
    SimbaV2's rule (Lee et al. 2025): the divisor is the standard deviation of G, or the largest ``|G|`` so far divided
    by ``max_return``, whichever is larger. Statistics in float64; the start values (variance 1) count as 1e-4 samples.

    A step enters the statistics when the next actions are chosen, so that a batch drawn after it does not see it yet.

    :param learner: the learner
    :param max_return: bound of the scaled return; None: the largest ``|atom|`` of a categorical head, 5 without one
    """

    def __init__(self, learner: Learning, max_return: float | None = None):
        super().__init__(learner, 1e-4, torch.float64)
        self.max_return = _bound(learner, max_return, 5.0)
        # The latest step's rewards and ends, until they enter the statistics.
        self._waiting: tuple[list[float], list[bool]] | None = None

    def divisor(self, task: torch.Tensor | None) -> torch.Tensor:
        return torch.maximum((self.moments.var + 1e-8).sqrt(), self.largest / self.max_return)

    def on_step(self, learner: Learning, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        self._waiting = (np.asarray(rewards, np.float64).tolist(), np.asarray(dones, bool).tolist())

    def on_observations(self, learner: Learning, observations: Any) -> None:
        if self._waiting is not None:
            rewards, ends = self._waiting
            self.feed(np.array(rewards), np.array(ends), learner.gamma)
        self._waiting = None

    def on_environment_reset(self, learner: Learning) -> None:
        super().on_environment_reset(learner)
        self._waiting = None

    def get_extra_state(self) -> dict[str, Any]:
        return {**super().get_extra_state(), "waiting": list(self._waiting or ())}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        super().set_extra_state(state)
        self._waiting = tuple(state["waiting"]) or None


class Float32Scale(ReturnScale):
    """
    FlashSAC's rule: SimbaV2's with statistics in float32, without start values, and 1e-4 added to the count where it
    weights the old variance (1 at the start). G is in float64, its discount in float32. A step enters the statistics at
    once.

    :param learner: the learner
    :param max_return: bound of the scaled return; None: the largest ``|atom|`` of a categorical head, 5 without one
    """

    def __init__(self, learner: Learning, max_return: float | None = None):
        super().__init__(learner, 0.0, torch.float32)
        self.max_return = _bound(learner, max_return, 5.0)

    def divisor(self, task: torch.Tensor | None) -> torch.Tensor:
        return torch.maximum((self.moments.var + 1e-8).sqrt(), self.largest / self.max_return)

    def _discounts(self, ends: np.ndarray, gamma: float) -> np.ndarray:
        return (np.float32(gamma) * (1 - ends.astype(np.float32))).astype(np.float64)

    def _update(self, returns: torch.Tensor) -> None:
        self.moments.update(returns, more_count=1e-4)


class TaskScale(RewardScale):
    """
    BRC's rule (Nauman et al. 2025), by task. The returns of finished episodes, ``G_t = r_t + gamma * G_{t+1}``, are
    computed backwards; the return after the last reward of a truncated episode (even if it terminated) is ``mean reward
    / (1 - gamma)``. With the largest and smallest return of a task ever seen (in float32) the divisor is::

        (max(largest, |smallest|) - alpha * min(target_entropy, 0) / (2 * (1 - gamma))) / max_return

    and at least 1e-8. The temperature alpha is read before the gradient steps that follow an environment step. The
    divisor is infinite, and the rewards are 0, until the task has finished an episode; a warning comes, once, if
    learning begins before that.

    The task of an environment's step is read from the key "task" of the dict observation that was acted on, or of the
    info; the task of a transition from the same key, or from the batch's column "task". Without either it is 0.

    :param learner: the learner
    :param n_tasks: number of tasks
    :param max_return: bound of the scaled return; None: the largest ``|atom|`` of a categorical head, 10 without one
    """

    smallest: torch.Tensor
    largest: torch.Tensor
    divisors: torch.Tensor

    def __init__(self, learner: Learning, n_tasks: int = 1, max_return: float | None = None):
        super().__init__(learner)
        check_value("n_tasks", n_tasks, integer(1))
        if not learner.gamma < 1:
            raise ValueError(
                f"gamma must be below 1 with reward_scale='brc', which divides by 1 - gamma, not {learner.gamma}"
            )
        self.max_return = _bound(learner, max_return, 10.0)
        self.register_buffer("smallest", torch.full((n_tasks,), torch.inf))
        self.register_buffer("largest", torch.full((n_tasks,), -torch.inf))
        self.register_buffer("divisors", torch.full((n_tasks,), torch.inf, dtype=torch.float64))
        # Rewards of each environment's episode so far, and the tasks read from their observations.
        self._episodes: list[list[float]] = []
        self._tasks: list[int] = []
        self._has_looked = False

    def on_observations(self, learner: Learning, observations: Any) -> None:
        told = observations.get("task") if isinstance(observations, dict) and len(self.largest) > 1 else None
        self._tasks = [] if told is None else torch.as_tensor(told).reshape(-1).tolist()

    def on_step(self, learner: Learning, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        if len(self._episodes) != len(dones):
            self._episodes = [[] for _ in dones]
        for i, (episode, reward, done, info) in enumerate(zip(self._episodes, rewards, dones, infos, strict=True)):
            episode.append(float(reward))
            if done:
                task = 0
                if len(self.largest) > 1:  # with one task, "task" is anything of the environment's own
                    task = self._tasks[i] if self._tasks else int(info.get("task", 0))
                self._take(episode, bool(info.get("TimeLimit.truncated", False)), task, learner.gamma)
                episode.clear()

    def _take(self, rewards: list[float], truncated: bool, task: int, gamma: float) -> None:
        """Add a finished episode to the statistics."""
        n_tasks = len(self.largest)
        if not 0 <= task < n_tasks:
            raise ValueError(f"the task of an environment must lie in [0, {n_tasks - 1}], by n_tasks, not be {task}")
        following = sum(rewards) / len(rewards) / (1 - gamma) if truncated else 0.0
        returns = []
        for reward in reversed(rewards):
            following = reward + gamma * following
            returns.append(following)
        self.largest[task].clamp_(min=max(returns))
        self.smallest[task].clamp_(max=min(returns))

    def on_environment_reset(self, learner: Learning) -> None:
        self._episodes = []

    def before_updates(self, learner: Learning) -> None:
        if not self._has_looked:  # once: on a GPU the check waits for the device
            self._has_looked = True
            if n_without := int(self.largest.isinf().sum()):
                n_tasks = len(self.largest)
                which = f"in {n_without} of the {n_tasks} tasks; their" if n_tasks > 1 else "and"
                warn(
                    f"learning begins before an episode has ended {which} rewards are 0 with reward_scale='brc' until "
                    "one has. More learning_starts, or shorter episodes (gymnasium.wrappers.TimeLimit), avoid it"
                )
        with torch.no_grad():
            alpha = learner.temperature().double()
        size = torch.maximum(self.largest, self.smallest.abs()).double()
        entropy = alpha * learner.target_entropy / (2 * (1 - learner.gamma))
        # Only a bonus widens the range of the values: a positive target would flip the sign of small returns.
        entropy = torch.as_tensor(entropy).clamp(max=0)
        self.divisors.copy_(((size - entropy) / self.max_return).clamp(min=1e-8))

    def divisor(self, task: torch.Tensor | None) -> torch.Tensor:
        if len(self.divisors) == 1:
            return self.divisors[0]
        if task is None:
            raise ValueError(
                f"reward_scale='brc' with n_tasks={len(self.divisors)} needs the task of each transition: dict "
                "observations with the key 'task', or a batch with such a column"
            )
        return self.divisors[task]

    def get_extra_state(self) -> dict[str, Any]:
        return {"episodes": [list(episode) for episode in self._episodes]}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._episodes = [list(episode) for episode in state["episodes"]]
        # The buffers are loaded before. Once every task has finished an episode there is nothing to warn of.
        self._has_looked = not bool(self.largest.isinf().any())


def _bound(learner: Learning, max_return: float | None, otherwise: float) -> float:
    """Bound of the scaled return: as given, else the largest absolute atom, or ``otherwise`` without atoms."""
    if max_return is not None:
        return float(check_value("max_return", max_return, ABOVE_0))
    head: Any = learner.head
    # For costs the support may end at 0 or below.
    return float(max(abs(head.v_min), abs(head.v_max))) if hasattr(head, "v_max") else otherwise


class LinearScale(RewardScale):
    """
    Linear scale of rewards in offline learning: times a factor, plus a shift. Implicit Q-learning (Kostrikov et al.
    2021) adds -1 on AntMaze, and on MuJoCo uses a factor that makes the returns of the data set span 1,000.

    :param learner: the learner
    :param factor: of the rewards
    :param shift: added to the product
    :param return_range: largest minus smallest return of the data set after scaling, which determines the factor when
        learning from the first data set begins; None: ``factor``
    :raises ValueError: if an argument is out of range, or both ``factor`` and ``return_range`` are given
    """

    needs_steps: ClassVar[bool] = False
    factor: torch.Tensor

    def __init__(self, learner: Learning, factor: float = 1.0, shift: float = 0.0, return_range: float | None = None):
        super().__init__(learner)
        check_value("factor", factor, ABOVE_0)
        check_value("shift", shift, FINITE)
        check_value("return_range", return_range, ABOVE_0.or_none())
        if return_range is not None and factor != 1:
            raise ValueError(f"factor={factor} and return_range={return_range} are two scales: leave one out")
        self.shift, self.return_range = float(shift), return_range
        # 0 while the data set is not known.
        self.register_buffer("factor", torch.tensor(float(factor) if return_range is None else 0.0))

    @property
    def waits_for_data(self) -> bool:
        """Whether the factor is yet to be computed from a data set."""
        return self.return_range is not None and not self.factor.item()

    def on_dataset(self, return_range: float) -> None:
        if return_range <= 0:
            raise ValueError(
                f"return_range={self.return_range} cannot be that of a data set whose episodes all have the same "
                "return: pass factor in its place"
            )
        assert self.return_range is not None
        self.factor.fill_(self.return_range / return_range)

    def take_the_place_of(self, former: float | None) -> None:
        """
        Change the factor, taken from a file, to what this ``return_range`` would have given.

        :param former: the file's ``return_range``; None if its factor is not of one
        """
        assert self.return_range is not None
        if former is None:
            self.factor.zero_()
        elif former != self.return_range:
            self.factor.mul_(self.return_range / former)

    def divisor(self, task: torch.Tensor | None) -> torch.Tensor:
        return 1 / self.factor

    def scaled(self, rewards: torch.Tensor, task: torch.Tensor | None) -> torch.Tensor:
        return rewards * self.factor + self.shift


#: Rules by the name that ``reward_scale`` takes: the name of the method that published the rule, or "linear".
REWARD_SCALES: dict[str, type[RewardScale]] = {
    "brc": TaskScale,
    "flashsac": Float32Scale,
    "linear": LinearScale,
    "simbav2": StdOrMaxScale,
    "xqc": StdScale,
}
