"""Callback that measures the critical batch size of the critics' gradient, and how much the critics overfit."""

from typing import Any

import numpy as np
import torch

from sb3_sample.diagnostics.measures import global_norm, noise_scale
from sb3_sample.diagnostics.periodic import PeriodicMeasurement
from sb3_sample.diagnostics.reading import batch_at, newest_overfitting, td_loss, training_places, untouched
from sb3_sample.sac import SAC

#: Transitions in a small batch, and the number of small batches that make the large one.
SMALL, PARTS = 64, 16
LARGE = SMALL * PARTS


class NoiseScaleCallback(PeriodicMeasurement):
    """
    Measures, every ``every`` environment steps, the noise scale of the critics' gradient and the critics' overfitting
    ("Value-Based Deep RL Scales Predictably", Rybkin et al. 2025, appendices F and B.1), and writes both to the logger
    under ``diagnostics/``, for figures 4, 10 and 11 of ``sb3-sample scaling plot``. It needs no environment.

    *Noise scale*: the squared norms of the gradient of the critics' loss at 64 and at 1,024 transitions of the replay
    buffer, ``gradient_square_64`` and ``gradient_square_1024``. Their means over the last ``window`` measurements give
    the critical batch size, tr(covariance of one transition's gradient) / (squared norm of the true gradient)
    (McCandlish et al. 2018): well below it a batch twice as large is worth twice as many gradient steps, well above it
    no more. ``critical_batch_size`` is not logged where the means show only noise and no gradient. The large batch is
    16 small ones, so that both norms are of the same transitions and the first is a mean of 16.

    *Overfitting*: ``overfitting_newest``, the TD loss on the 16 newest transitions (``td_loss_newest``) minus that on a
    batch of the replay buffer (``td_loss_replay``). ``parameter_norm_critic`` is logged too.

    Transitions are drawn uniformly and with replacement, single steps as they were experienced, without those that are
    held out for validation, whatever the algorithm itself does (priorities, n-step returns); all networks are in
    evaluation mode, so that with batch normalisation the rows of a batch do not depend on each other. Training is bit
    for bit the same with the callback and without.

    Nothing is measured while the algorithm still acts at random (``learning_starts``). In ``learn_offline`` a model
    that has not acted for so long is not measured, with a warning: the replay buffer is read, not the data set.

    :param every: environment steps between two measurements, taken at the first step at or after each multiple
    :param window: measurements whose squared norms are averaged
    :param batch_size: transitions of the replay buffer in ``td_loss_replay``
    :param seed: of the draws; the model's if None
    :param verbose: 0 nothing, 1 a line for each measurement
    :raises TypeError: when training starts, if the model is not a ``SAC`` of this package
    :raises ValueError: if an argument is out of range, or the model has several tasks
    """

    TITLE = "Noise scale"
    SHOWN = ("critical_batch_size", "overfitting_newest")

    def __init__(
        self, every: int = 1_000, window: int = 10, batch_size: int = 256, seed: int | None = None, verbose: int = 0
    ):
        super().__init__(every, verbose)
        for name, value in (("every", every), ("window", window), ("batch_size", batch_size)):
            if not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, not {value!r}")
        self.window, self.batch_size, self.seed = window, batch_size, seed
        #: Squared norms of the last measurements: small, large.
        self._squares: list[tuple[float, float]] = []
        self._measured_model: SAC | None = None

    def _init_callback(self) -> None:
        super()._init_callback()
        model = self.model
        if model is not self._measured_model:  # else a second call of learn
            self._measured_model, self._squares = model, []
            self._rng = np.random.default_rng(model.seed if self.seed is None else self.seed)

    def state_dict(self) -> dict[str, Any]:
        """
        :return: state that the coming measurements depend on
        """
        return {"next": self._next, "squares": self._squares, "rng": self._rng, "last_results": self.last_results}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: from :meth:`state_dict`
        """
        self._next, self._rng, self.last_results = state["next"], state["rng"], state["last_results"]
        self._squares = [(small, large) for small, large in state["squares"]]

    def measure(self) -> dict[str, float]:
        """
        Measure now. Outside of ``learn`` call ``init_callback(model)`` first.

        :return: the quantities by name; only the norm of the parameters before there are transitions
        """
        if self._measured_model is None:
            raise ValueError("the callback knows no model yet: call init_callback(model) first")
        assert self.model.replay_buffer is not None
        results = {"parameter_norm_critic": global_norm(list(self.model.critic.parameters()))}
        with untouched(self.model):
            places = training_places(self.model.replay_buffer)
            if len(places):
                small, large = self._gradient_squares(places)
                self._squares = [*self._squares, (small, large)][-self.window :]
                results |= {f"gradient_square_{SMALL}": small, f"gradient_square_{LARGE}": large}
                means = np.mean(self._squares, axis=0)
                signal, _, critical = noise_scale(float(means[0]), float(means[1]), SMALL, LARGE)
                if signal > 0:
                    results["critical_batch_size"] = critical
                results |= newest_overfitting(self.model, self.batch_size, self._rng)
        self.last_results = results
        return results

    def _gradient_squares(self, places: np.ndarray) -> tuple[float, float]:
        """Squared norms of the critics' gradients: mean over the small batches, and that of their mean gradient."""
        parameters = [parameter for parameter in self.model.critic.parameters() if parameter.requires_grad]
        assert self.model.replay_buffer is not None
        total, squares = [torch.zeros_like(parameter) for parameter in parameters], 0.0
        for _ in range(PARTS):
            drawn = self._rng.choice(places, SMALL, replace=True)
            batch = batch_at(self.model, self.model.replay_buffer, drawn)
            with torch.enable_grad():
                loss = td_loss(self.model, batch, self._rng)
                gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
            for mean, gradient in zip(total, gradients, strict=True):
                if gradient is not None:
                    mean.add_(gradient, alpha=1 / PARTS)
            squares += global_norm([each for each in gradients if each is not None]) ** 2 / PARTS
        return squares, global_norm(total) ** 2
