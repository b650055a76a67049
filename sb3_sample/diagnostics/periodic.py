"""Callback that measures something of an agent every so many environment steps."""

from typing import ClassVar

from stable_baselines3.common.callbacks import BaseCallback

from sb3_sample.console import say
from sb3_sample.sac import SAC
from sb3_sample.warn import warn


class PeriodicMeasurement(BaseCallback):
    """
    Base class of callbacks that measure every ``every`` environment steps, and write to the logger under
    ``diagnostics/``. Nothing is measured while the algorithm still acts at random (``learning_starts``). In
    ``learn_offline`` a model that has not acted for so long is not measured, with a warning.

    :param every: environment steps between two measurements, taken at the first step at or after each multiple
    :param verbose: 0 nothing, 1 a line for each measurement
    :raises TypeError: when training starts, if the model is not a ``SAC`` of this package
    :raises ValueError: when training starts, if the model has several tasks
    """

    model: SAC

    #: Beginning of a measurement's line, and the quantities that it shows if they were measured.
    TITLE: ClassVar[str]
    SHOWN: ClassVar[tuple[str, ...]]

    def __init__(self, every: int, verbose: int):
        super().__init__(verbose)
        self.every = every
        #: Results of the last measurement, by name, without the prefix ``diagnostics/``.
        self.last_results: dict[str, float] = {}
        self._next = every

    def _init_callback(self) -> None:
        model, name = self.model, type(self).__name__
        if not isinstance(model, SAC):
            raise TypeError(f"{name} needs a model of sb3_sample.sac.SAC, not a {type(model).__name__}")
        if model.n_tasks > 1:
            raise ValueError(f"{name} measures models of one task, and this one has {model.n_tasks}")

    def _on_training_start(self) -> None:
        self._next = (self.num_timesteps // self.every + 1) * self.every
        if self.model._learns_from is not None and self._is_warm_up():
            warn(
                f"{type(self).__name__} measures nothing in learn_offline before the model has acted for "
                f"learning_starts={self.model.learning_starts} steps: it reads the replay buffer, not the data set"
            )

    def _on_step(self) -> bool:
        if self.num_timesteps < self._next:
            return True
        self._next = (self.num_timesteps // self.every + 1) * self.every
        if self._is_warm_up():
            return True
        results = self.measure()
        for name, value in results.items():
            self.logger.record(f"diagnostics/{name}", value)
        # Written at once, as by EvalCallback, so that the values are logged at the step at which they were measured.
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        if self.verbose >= 1:
            shown = ", ".join(f"{name} {results[name]:.3g}" for name in self.SHOWN if name in results)
            say(f"{self.TITLE} at {self.num_timesteps} steps: {shown}")
        return True

    def _is_warm_up(self) -> bool:
        # The transitions of the current step are stored after this call.
        return self.model.num_transitions + self.model.n_envs < self.model.learning_starts

    def measure(self) -> dict[str, float]:
        """
        Measure now.

        :return: the quantities by name
        """
        raise NotImplementedError
