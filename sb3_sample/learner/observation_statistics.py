"""Statistics of the observations that the networks' normalisation reads."""

from typing import Any

import numpy as np
import torch

from sb3_sample.learner.batch import for_each
from sb3_sample.learner.parts import Learning, Part


class ObservationStatistics(Part):
    """
    Feeds the networks' running normalisation (``observation_norm``, whose statistics belong to the networks) with the
    observations that are acted on in training, those with random actions included. The first observation after the
    environments were reset by ``learn`` and the last one of an episode are excluded, as in SimbaV2's published code,
    and a batch drawn after a step does not see that step yet. At a reset of the networks the statistics stay.
    """

    def __init__(self) -> None:
        super().__init__()
        # Whether a step was taken before the next observations.
        self._stepped = False

    def on_step(self, learner: Learning, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        self._stepped = True

    def on_observations(self, learner: Learning, observations: Any) -> None:
        if self._stepped:
            norm = learner.observation_norm
            norm.update(for_each(lambda part: torch.as_tensor(part, device=norm.mean.device), observations))
        self._stepped = False

    def on_environment_reset(self, learner: Learning) -> None:
        self._stepped = False

    def get_extra_state(self) -> dict[str, Any]:
        return {"stepped": self._stepped}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._stepped = state["stepped"]
