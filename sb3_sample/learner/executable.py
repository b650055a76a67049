"""Ways to run a learner's gradient step: eager, compiled, captured."""

from collections.abc import Callable
from typing import Any

from sb3_sample.learner.execution import Execution


class Executable:
    """
    Base class of a learner, which has ``gradient_step``, ``identities``, ``step_modules`` and ``optimizers``,
    ``compile``, ``device`` and ``verbose``.

    :param counts: object that holds ``compiled``, whether the gradient step is compiled, beside the learner's counts
    """

    def __init__(self, counts: Any):
        self._counts = counts
        self._execution: Execution | None = None
        #: Chooses how the gradient steps are run: takes the learner and the method's name.
        self.make_execution: Callable[[Any, str], Any] = Execution.of

    @property
    def compiled(self) -> bool | None:
        """Whether the gradient step is compiled; None while undecided."""
        return self._counts.compiled  # type: ignore[no-any-return]

    @compiled.setter
    def compiled(self, value: bool | None) -> None:
        self._counts.compiled = value

    def exchangeable(self) -> dict[str, Any]:
        """
        List the parts and networks whose classes may come from outside of this package.

        :return: parts and networks of the gradient step, by the argument that names their class
        """
        raise NotImplementedError

    @property
    def seconds_compiling(self) -> float:
        """Seconds spent on compiling the gradient step."""
        return 0.0 if self._execution is None else self._execution.seconds_compiling

    def forget_execution(self) -> None:
        """Drop the execution: how the gradient steps are run is decided anew before the next one."""
        self._execution = None

    def prepared_execution(self) -> Execution:
        """
        Prepare the gradient steps that follow.

        :return: runner of the gradient steps
        """
        if self._execution is None or not self._execution.serves(self):
            self._execution = self.make_execution(self, "gradient_step")
        self._execution.prepare(self)
        return self._execution
