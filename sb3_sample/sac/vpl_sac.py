"""VPL-SAC."""

from typing import Any

from sb3_sample.arguments import check_unused
from sb3_sample.constructor import argument
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.sac import checks
from sb3_sample.sac.algorithm import SAC


class VPLSAC(SAC):
    """
    VPL-SAC: soft actor-critic with validation pessimism learning (Nauman et al. 2024,
    https://arxiv.org/abs/2403.01014, eq. 12 and algorithm 1).

    A share of the transitions is held out of training, and the pessimism of the critics' targets is learned on it: it
    moves to the value with the least error of the targets on data that the critics have not seen. With
    ``replay_ratio=16, resets=160_000`` it is the paper's SR-SAC-VPL.

    :class:`~sb3_sample.learner.pessimism.LearnedPessimism` states what the paper leaves open and what is decided here.
    The paper's variants are arguments: ``pessimism_source="replay"`` or ``"recent"``, ``pessimism_loss="dual"``,
    ``validation_proportion``, and ``pessimism=1.0`` for the "regret" run, which holds the transitions out and leaves
    the pessimism fixed.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    validation_proportion: float | None = argument(  # type: ignore[assignment]  # None until it is checked
        default=None
    )
    """share of the transitions that is held out, in [0, 1); the validation batch has the same proportion to
    ``batch_size``. None: 1/32, or 0 if the pessimism learns from another source"""
    initial_pessimism: float = argument(default=1.0)
    """pessimism at the start and after a reset"""
    pessimism_learning_rate: float = argument(default=5e-5)
    """learning rate of the pessimism"""
    pessimism_source: str = argument(default="validation")
    """transitions that the pessimism learns from: "validation", "replay" or "recent" ones"""
    pessimism_loss: str = argument(default="squared")
    """"squared" (eq. 12) or "dual" (eq. 6)"""
    pessimism: float | str | type[Pessimism] = argument(default="vpl")
    """"vpl", or a number for a fixed pessimism"""

    def _check_arguments(self) -> None:
        if isinstance(self.pessimism, (str, type)) and self.pessimism != "vpl":
            raise ValueError(f"VPLSAC has pessimism='vpl' or a fixed number, not {self.pessimism!r}: use SAC")
        if self.validation_proportion is None:
            self.validation_proportion = 1 / 32 if self.pessimism_source == "validation" else 0.0
        checks.check_once(
            "pessimism_kwargs",
            self.pessimism_kwargs,
            {
                "initial_pessimism": "initial_pessimism",
                "learning_rate": "pessimism_learning_rate",
                "source": "pessimism_source",
                "loss": "pessimism_loss",
            },
        )
        super()._check_arguments()
        if self.pessimism != "vpl":
            own = ("initial_pessimism", "pessimism_learning_rate", "pessimism_source", "pessimism_loss")
            check_unused(self, own, f"pessimism={self.pessimism}, which is fixed")

    def _full_pessimism_kwargs(self) -> dict[str, Any]:
        return {
            "initial_pessimism": self.initial_pessimism,
            "learning_rate": self.pessimism_learning_rate,
            "source": self.pessimism_source,
            "loss": self.pessimism_loss,
            **super()._full_pessimism_kwargs(),
        }
