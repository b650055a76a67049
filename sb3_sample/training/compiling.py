"""Whether compiling the gradient step pays for itself, for every algorithm with a replay buffer."""

from typing import Any

from sb3_sample.console import say
from sb3_sample.learner.execution import PAYS_FROM, foreign_parts, old_torch, warn_not_compiled, why_not_compiled


class DecidesCompiling:
    """Part of an algorithm with a learner, ``compile`` and ``compiled``, before Stable-Baselines3's class."""

    compiled: bool | None

    def _decide_compiling(self: Any, n_updates: float) -> None:
        """
        Decide, with ``compile="auto"`` once and for all, whether the coming gradient steps pay for compiling.

        :param n_updates: gradient steps to come; 0 if unknown
        """
        if self.compiled is not None:
            return
        # Warn of reasons not to compile only if compiling was requested, and of an old torch, which is easily updated.
        foreign = foreign_parts(self.learner) if n_updates >= PAYS_FROM else []
        if foreign and self.verbose >= 1:
            verb = "does" if len(foreign) == 1 else "do"
            say(f"The gradient step is not compiled: {', '.join(foreign)} {verb} not declare compilable = True")
        pays = n_updates >= PAYS_FROM and not foreign
        reason = why_not_compiled(self.learner) if pays else None
        self.compiled = pays and reason is None
        if reason is not None and reason == old_torch():
            warn_not_compiled(self.learner, reason)
        self.learner.forget_execution()
