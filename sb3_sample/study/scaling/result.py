"""Laws of a table of runs: their numbers with intervals, and their predictions."""

import dataclasses
import math
import shlex
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sb3_sample.study.scaling.budget import FLOPS, BudgetLaw, ComputeLaw, fit_budget
from sb3_sample.study.scaling.intervals import interval
from sb3_sample.study.scaling.laws import DataLaw, HyperparameterLaw

#: Number of largest budgets held out of the budget's law (appendix D).
HELD_OUT = 2
#: Factor by which a prediction may go beyond the runs' replay ratios; the paper's own checks go to a factor of 4.
BEYOND = 4.0
#: Batch sizes are positive multiples of this.
MULTIPLE = 16


class Estimate(NamedTuple):
    """
    A number with its interval.

    :param value: estimate from all seeds
    :param low: lower bound; NaN if there is none
    :param high: upper bound
    """

    value: float
    low: float = math.nan
    high: float = math.nan

    def __str__(self) -> str:
        if math.isnan(self.low):
            return f"{self.value:.4g}"
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]"


#: Numbers from all seeds (1,), and from the bootstrap samples (R,).
Stages = Sequence[np.ndarray]


@dataclasses.dataclass
class Hyperparameter:
    """
    Law of batch size or learning rate.

    :param values: the choices: task, replay_ratio, name, value, std, decided, edge
    :param tasks: of the law
    :param slopes: (1,), (R,)
    :param intercepts: likewise, with an axis of tasks
    """

    values: pd.DataFrame
    tasks: list[str]
    slopes: list[np.ndarray]
    intercepts: list[np.ndarray]

    def law(self) -> HyperparameterLaw:
        """
        :return: the law from all seeds
        """
        intercepts = map(float, self.intercepts[0][0])
        return HyperparameterLaw(float(self.slopes[0][0]), dict(zip(self.tasks, intercepts, strict=True)))

    def at(self, replay_ratio: Any, task: str | None = None) -> list[np.ndarray]:
        """
        :param replay_ratio: a number, or one per sample for each stage
        :param task: task of the values; the mean over all if None
        :return: values
        """
        ratios = replay_ratio if isinstance(replay_ratio, list) else [replay_ratio] * len(self.slopes)
        found = []
        for slopes, intercepts, ratio in zip(self.slopes, self.intercepts, ratios, strict=True):
            own = intercepts.mean(axis=1) if task is None else intercepts[:, self.tasks.index(task)]
            found.append(own * ratio**slopes)
        return found


@dataclasses.dataclass
class Level:
    """
    Data law of a level.

    :param level: of the return, from 0 to 1000
    :param tasks: tasks of the law
    :param left_out: tasks that reach the level at too few replay ratios
    :param points: (S,) mean environment steps by replay ratio
    :param censored: (S,) where a task does not reach the level, so that its mean is a lower bound
    :param factors: factors from the mean to the steps of each task, (tasks,)
    :param laws: with parameters (1,), (R,)
    """

    level: float
    tasks: list[str]
    left_out: list[str]
    points: np.ndarray
    censored: np.ndarray
    factors: np.ndarray
    laws: list[DataLaw]

    def law(self) -> DataLaw:
        """
        :return: the law from all seeds
        """
        return DataLaw(*(float(each[0]) for each in self.laws[0]))


class Prediction(NamedTuple):
    """
    Settings, with their steps and compute.

    :param replay_ratio: gradient steps per environment step
    :param batch_size: rows, a multiple of 16; None if it has no law and differs
    :param learning_rate: to three digits; None if it has no law and differs
    :param steps: environment steps to the level, as the mean over the tasks or for one task
    :param compute: FLOPs; None without the size of the critics
    :param level: of the return; None for a budget between levels
    :param limits: assumptions and limits of the prediction
    :param others: further arguments that all runs of the laws have
    """

    replay_ratio: Estimate
    batch_size: Estimate | None
    learning_rate: Estimate | None
    steps: Estimate | None
    compute: Estimate | None
    level: float | None
    limits: list[str]
    others: dict[str, Any]

    def params(self) -> str:
        """
        :return: arguments of ``sb3-sample train``, after ``-params``, quoted for a shell
        """
        words = [f"replay_ratio:{self.replay_ratio.value:.4g}"]
        if self.batch_size is not None:
            words.append(f"batch_size:{rounded_batch_size(self.batch_size.value)}")
        if self.learning_rate is not None:
            words.append(f"learning_rate:{self.learning_rate.value:.3g}")
        return " ".join([*words, *(f"{name}:{_quoted(repr(value))}" for name, value in self.others.items())])


def _quoted(text: str) -> str:
    """A text as one word for a shell."""
    plain = shlex.quote(text)
    return f'"{text}"' if plain != text and not set(text) & set('"$`\\!') else plain


def rounded_batch_size(value: float) -> int:
    """
    :param value: batch size from a law
    :return: the nearest multiple of 16, at least 16, as in the paper's tables 6 and 8
    """
    return max(MULTIPLE, MULTIPLE * round(value / MULTIPLE))


@dataclasses.dataclass
class Laws:
    """
    All laws of a table of runs.

    :param tasks: of the runs
    :param replay_ratios: of the runs, ascending
    :param seeds: fewest seeds of a configuration
    :param hyperparameters: laws by name, "batch_size" and "learning_rate" as far as they were swept
    :param levels: data laws, ascending
    :param critic_params: parameters of the critics; None if they are not known
    :param delta: cost of an environment step in FLOPs
    :param batch_size: of the runs of the data laws, if all share it
    :param learning_rate: of the runs of the data laws, if all share it
    :param loss: of the data laws
    :param choice_level: level at which batch sizes and learning rates were chosen
    :param notes: limits of the laws, in words
    :param others: further arguments that all runs have
    :param without_law: "batch_size" or "learning_rate", if swept at too few replay ratios for a law
    """

    tasks: list[str]
    replay_ratios: list[float]
    seeds: int
    hyperparameters: dict[str, Hyperparameter]
    levels: list[Level]
    critic_params: float | None
    delta: float
    batch_size: float | None
    learning_rate: float | None
    loss: str
    choice_level: float
    notes: list[str]
    others: dict[str, Any] = dataclasses.field(default_factory=dict)
    without_law: list[str] = dataclasses.field(default_factory=list)

    # ------------------------------------------------ numbers

    @property
    def has_compute(self) -> bool:
        """Whether the critics' size and the batch size are known."""
        return self.critic_params is not None and ("batch_size" in self.hyperparameters or self.batch_size is not None)

    def interval(self, stages: Stages) -> Estimate:
        """
        :param stages: (1,), (R,)
        :return: the number with its 95% interval
        """
        value = float(stages[0][0])
        if self.seeds < 2:
            return Estimate(value)
        low, high = interval(stages[0][0], stages[1], self.seeds)
        return Estimate(value, float(low), float(high))

    def level(self, level: float | None = None) -> Level:
        """
        :param level: one of the fit; the largest if None
        :return: its law
        """
        if level is None:
            return self.levels[-1]
        for each in self.levels:
            if abs(each.level - level) <= 0.5:
                return each
        raise ValueError(
            f"level must be one of the fit, {', '.join(f'{x.level:g}' for x in self.levels)}, not {level!r}"
        )

    def compute_laws(self, level: float | None = None, task: str | None = None) -> list[ComputeLaw]:
        """
        :param level: of the fit; the largest if None
        :param task: one of the level's; the mean over the tasks if None
        :return: laws with parameters (1,), (R,)
        """
        if not self.has_compute:
            raise ValueError("compute needs the size of the critics and the batch size, which these laws do not have")
        found = []
        for i, data in enumerate(self._data(self.level(level), task)):
            if "batch_size" in self.hyperparameters:
                law = self.hyperparameters["batch_size"]
                own = (
                    law.intercepts[i].mean(axis=1)
                    if task not in law.tasks
                    else law.intercepts[i][:, law.tasks.index(task)]
                )
                batch, slope = own, law.slopes[i]
            else:
                batch, slope = np.full(data.d_min.shape, self.batch_size), np.zeros(data.d_min.shape)
            found.append(ComputeLaw(data, batch, slope, float(self.critic_params or 0)))
        return found

    def _data(self, level: Level, task: str | None) -> list[DataLaw]:
        if task is None:
            return level.laws
        if task not in level.tasks:
            raise ValueError(f"task must be one of level {level.level:g}, {', '.join(level.tasks)}, not {task!r}")
        factor = float(level.factors[level.tasks.index(task)])
        return [DataLaw(law.d_min * factor, law.beta, law.alpha) for law in level.laws]

    def budgets(self) -> pd.DataFrame:
        """
        :return: for each level, the replay ratio of the least C + δ D and this budget, each with its interval, and
            whether the replay ratio is within those of the runs
        """
        rows = []
        for level in self.levels:
            points = [law.best(self.delta) for law in self.compute_laws(level.level)]
            ratio = self.interval([np.atleast_1d(point.replay_ratio) for point in points])
            budget = self.interval([np.atleast_1d(point.compute + self.delta * point.steps) for point in points])
            rows.append(
                {
                    "level": level.level, "replay_ratio": ratio.value, "replay_ratio_low": ratio.low,
                    "replay_ratio_high": ratio.high, "budget": budget.value, "budget_low": budget.low,
                    "budget_high": budget.high,
                    "within": self.replay_ratios[0] <= ratio.value <= self.replay_ratios[-1],
                }
            )  # fmt: skip
        return pd.DataFrame(rows)

    def budget_laws(self) -> list[BudgetLaw]:
        """
        :return: laws of all but the two largest budgets, with parameters (1,), (R,)
        :raises ValueError: there are fewer than four levels, or no compute
        """
        if len(self.levels) < HELD_OUT + 2:
            raise ValueError(
                f"levels must be at least {HELD_OUT + 2} for a law of the budget, of which the two largest are held "
                f"out; there are {len(self.levels)}"
            )
        points = [[law.best(self.delta) for law in self.compute_laws(level.level)] for level in self.levels]
        found = []
        for stage in zip(*points, strict=True):
            ratios = np.stack([np.atleast_1d(point.replay_ratio) for point in stage], axis=-1)
            budgets = np.stack([np.atleast_1d(p.compute + self.delta * p.steps) for p in stage], axis=-1)
            found.append(fit_budget(budgets[..., :-HELD_OUT], ratios[..., :-HELD_OUT]))
        return found

    # ------------------------------------------------ answers

    def predict(
        self,
        *,
        replay_ratio: float | None = None,
        compute: float | None = None,
        data: float | None = None,
        budget: float | None = None,
        level: float | None = None,
        task: str | None = None,
    ) -> Prediction:
        """
        Predict settings for a replay ratio, for the fewest steps under a limit of compute, for the least compute under
        a limit of steps, or for a budget C + δ D.

        :param replay_ratio: gradient steps per environment step
        :param compute: FLOPs
        :param data: environment steps
        :param budget: FLOPs, including steps at a cost of δ each
        :param level: of the return, a level of the fit; the largest if None. Not with a budget, which determines the
            level
        :param task: task of the prediction; the mean over the tasks if None
        :return: the settings
        :raises ValueError: not exactly one is given, there is no answer, or it is more than four times beyond the
            replay ratios of the runs
        """
        given = {"replay_ratio": replay_ratio, "compute": compute, "data": data, "budget": budget}
        asked = {name: value for name, value in given.items() if value is not None}
        if len(asked) != 1:
            raise ValueError(f"exactly one of {', '.join(given)} must be given, not {', '.join(asked) or 'none'}")
        ((name, value),) = asked.items()
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be a positive number, not {value!r}")
        if name == "budget":
            if level is not None:
                raise ValueError("level is not for a budget, which says by itself how far one gets")
            return self._at_budget(value, task)
        of = self.level(level)
        if name == "replay_ratio":
            self._check_reach(value)
            return self._at([np.full(len(law.d_min), value) for law in of.laws], of, task)
        laws = self.compute_laws(of.level, task)
        answer: Callable[[ComputeLaw], Any] = (
            (lambda law: law.most_data_efficient(value)) if name == "compute" else (lambda law: law.cheapest(value))
        )
        answer(_first(laws[0]))  # raises if there is no answer
        ratios = [np.atleast_1d(answer(law).replay_ratio) for law in laws]
        self._check_reach(float(ratios[0][0]))
        return self._at(ratios, of, task)

    def _check_reach(self, ratio: float) -> None:
        low, high = self.replay_ratios[0] / BEYOND, self.replay_ratios[-1] * BEYOND
        if not low <= ratio <= high:
            raise ValueError(
                f"the answer would be a replay ratio of {ratio:.4g}, and runs at {self.replay_ratios[0]:g} to "
                f"{self.replay_ratios[-1]:g} warrant {low:g} to {high:g} at most: make runs nearer to it"
            )

    def _at_budget(self, budget: float, task: str | None) -> Prediction:
        if task is not None and task not in self.tasks:
            raise ValueError(f"task must be one of the laws', {', '.join(self.tasks)}, not {task!r}")
        laws = self.budget_laws()
        ratios = [np.atleast_1d(law.replay_ratio(budget)) for law in laws]
        ratio = float(ratios[0][0])
        self._check_reach(ratio)
        table = self.budgets()
        limits = self._limits(ratio, task)
        if task is not None:
            limits.append("the replay ratio is that of all tasks together: a budget's law is not of one task")
        for level in self.levels:
            limits += [f"level {level.level:g}: {doubt}" for doubt in level.law().doubts(self.replay_ratios)]
            if level.left_out:
                limits.append(f"level {level.level:g}: without {', '.join(level.left_out)}, which do not reach it")
        inside = table["budget"].min() <= budget <= table["budget"].max()
        if not inside:
            limits.append(
                f"the budget is outside of those of the levels, {table['budget'].min():.3g} to "
                f"{table['budget'].max():.3g} FLOPs: the level is not known"
            )
        reached = float(table.loc[table["budget"] <= budget, "level"].max()) if inside else None
        sizes = self._values("batch_size", ratios, task)
        assert self.critic_params is not None and sizes is not None  # otherwise there are no laws of budgets
        steps = [
            budget / (FLOPS * self.critic_params * size * each + self.delta)
            for size, each in zip(sizes, ratios, strict=True)
        ]
        compute = [budget - self.delta * each for each in steps]
        batch, rate = (self._hyperparameter(name, ratios, task) for name in ("batch_size", "learning_rate"))
        return Prediction(
            self.interval(ratios), batch, rate, self.interval(steps), self.interval(compute), reached, limits,
            self.others,
        )  # fmt: skip

    def _at(self, ratios: list[np.ndarray], level: Level, task: str | None) -> Prediction:
        data = self._data(level, task)
        steps = [law.d_min * (1 + (law.beta / ratio) ** law.alpha) for law, ratio in zip(data, ratios, strict=True)]
        compute = None
        if self.has_compute:
            laws = self.compute_laws(level.level, task)
            compute = self.interval([law.at(r).compute for law, r in zip(laws, ratios, strict=True)])
        ratio = float(ratios[0][0])
        limits = self._limits(ratio, task) + level.law().doubts(self.replay_ratios)
        if level.left_out:
            limits.append(f"tasks that do not reach {level.level:g} are not in it: {', '.join(level.left_out)}")
        exact = all(np.ptp(each) == 0 for each in ratios if len(each))
        batch, rate = (self._hyperparameter(name, ratios, task) for name in ("batch_size", "learning_rate"))
        return Prediction(
            Estimate(ratio) if exact else self.interval(ratios),
            batch, rate, self.interval(steps), compute, level.level, limits, self.others,
        )  # fmt: skip

    def _hyperparameter(self, name: str, ratios: list[np.ndarray], task: str | None) -> Estimate | None:
        values = self._values(name, ratios, task)
        if values is None or name in self.hyperparameters:
            return None if values is None else self.interval(values)
        return Estimate(float(values[0][0]))

    def _values(self, name: str, ratios: list[np.ndarray], task: str | None) -> list[np.ndarray] | None:
        """Batch sizes or learning rates at replay ratios; None if not known."""
        if name in self.hyperparameters:
            law = self.hyperparameters[name]
            return law.at(ratios, task if task in law.tasks else None)
        fixed = self.batch_size if name == "batch_size" else self.learning_rate
        return None if fixed is None else [np.full(each.shape, fixed) for each in ratios]

    def _limits(self, ratio: float, task: str | None) -> list[str]:
        limits = []
        if not self.replay_ratios[0] <= ratio <= self.replay_ratios[-1]:
            limits.append(
                f"extrapolated: the runs have replay ratios of {self.replay_ratios[0]:g} to {self.replay_ratios[-1]:g}"
            )
        for name, law in self.hyperparameters.items():
            if task is not None and task not in law.tasks:
                limits.append(f"{name} is the mean over the tasks: none could be chosen on {task}")
        for name in ("batch_size", "learning_rate"):
            if name not in self.hyperparameters:
                fixed = self.batch_size if name == "batch_size" else self.learning_rate
                why = "was swept, but has no law" if name in self.without_law else "was not swept"
                limits.append(f"{name} {why}" + ("" if fixed is None else ": it is that of the runs"))
        return limits


def _first(law: ComputeLaw) -> ComputeLaw:
    data = DataLaw(*(float(each[0]) for each in law.data))
    return ComputeLaw(data, float(law.batch_size[0]), float(law.slope[0]), law.critic_params)
