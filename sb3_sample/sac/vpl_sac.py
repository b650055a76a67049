"""VPL-SAC."""

from typing import Any

from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_sample.arguments import check_unused
from sb3_sample.sac import arguments
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.policies import SACPolicy


class VPLSAC(SAC):
    """
    VPL-SAC: soft actor-critic with validation pessimism learning (Nauman et al. 2024,
    https://arxiv.org/abs/2403.01014, eq. 12 and algorithm 1).

    A share of the transitions is held out of training, and the pessimism of the critics' targets is learned on it: it
    moves to where the targets' error is least on data that the critics have not seen. With ``replay_ratio=16,
    resets=160_000`` it is the paper's SR-SAC-VPL.

    :class:`~sb3_sample.learner.pessimism.LearnedPessimism` says what the paper leaves open and how it is decided. The
    paper's variants are arguments: ``pessimism_source="replay"`` or ``"recent"``, ``pessimism_loss="dual"``,
    ``validation_proportion``, and ``pessimism=1.0`` for the "regret" run, which holds the transitions out and leaves
    the pessimism fixed.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class
    :param env: the environment, an id, or a vectorised environment; its action space a bounded Box
    :param learning_rate: of actor, critics and temperature; a number or a function of the remaining progress
        (from 1 to 0)
    :param validation_proportion: share of the transitions that is held out, in [0, 1); the validation batch has the
        same proportion to ``batch_size``. None: 1/32, or 0 if the pessimism learns from another source
    :param initial_pessimism: pessimism at the start and after a reset
    :param pessimism_learning_rate: of the pessimism
    :param pessimism_source: where the pessimism learns: "validation", "replay" or "recent"
    :param pessimism_loss: "squared" (eq. 12) or "dual" (eq. 6)
    :param pessimism: "vpl", or a number for a fixed one
    :param kwargs: every other argument of :class:`SAC`, by name
    :raises ValueError: if an argument is out of range or contradicts another
    """

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        validation_proportion: float | None = None,
        initial_pessimism: float = 1.0,
        pessimism_learning_rate: float = 5e-5,
        pessimism_source: str = "validation",
        pessimism_loss: str = "squared",
        pessimism: float | str = "vpl",
        **kwargs: Any,
    ):
        self.initial_pessimism = initial_pessimism
        self.pessimism_learning_rate = pessimism_learning_rate
        self.pessimism_source = pessimism_source
        self.pessimism_loss = pessimism_loss
        super().__init__(
            policy,
            env,
            learning_rate,
            validation_proportion=validation_proportion,  # type: ignore[arg-type]  # None until it is checked
            pessimism=pessimism,
            **kwargs,
        )

    def _check_arguments(self) -> None:
        if isinstance(self.pessimism, (str, type)) and self.pessimism != "vpl":
            raise ValueError(f"VPLSAC has pessimism='vpl' or a fixed number, not {self.pessimism!r}: use SAC")
        if self.validation_proportion is None:
            self.validation_proportion = 1 / 32 if self.pessimism_source == "validation" else 0.0
        arguments.check_once(
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
