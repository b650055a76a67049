"""
Faults during a training: numbers that are no longer finite, and callbacks that raise.

``envs/workers.py`` handles environments that die.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from torch import nn


class TrainingDiverged(FloatingPointError, ValueError):
    """
    A loss, another metric or a parameter is NaN or infinite. Everything learned from here on is worthless.

    It is also a ``ValueError``, at which the zoo's search for hyperparameters ends a trial and continues.

    :param values: what is not finite, by name
    :param when: the gradient step, in words
    :param environment_step: environment steps taken by then, as ``num_timesteps`` counts
    """

    def __init__(self, values: Mapping[str, float], when: str, environment_step: int):
        self.values, self.when, self.environment_step = dict(values), when, environment_step
        shown = [f"{name} is {value}" for name, value in list(self.values.items())[:3]]
        more = len(self.values) - len(shown)
        what = ", ".join(shown) + (f" and {more} more are not finite" if more > 0 else "")
        super().__init__(
            f"{what} at {when} (environment step {environment_step}). The training has diverged and was stopped: a "
            "smaller learning rate, or rewards of a smaller scale, may help."
        )

    def __reduce__(self) -> Any:
        return type(self), (self.values, self.when, self.environment_step)


class MetricWatch:
    """
    Check the metrics of every gradient step without making the host wait for the device: they stay on the device, and
    are checked when the host waits anyway.

    :param device: where the metrics are
    """

    #: Gradient steps after which the metrics are checked in any case, so that their number is bounded.
    WINDOW = 1_000

    def __init__(self, device: torch.device):
        self._device = device
        self._kept = torch.zeros(self.WINDOW, 0, device=device)
        self._steps: list[tuple[Sequence[str], int, int]] = []

    def note(self, metrics: Mapping[str, torch.Tensor], gradient_step: int, environment_step: int) -> None:
        """
        Keep the metrics of a gradient step.

        :param metrics: scalars on the device, by name
        :param gradient_step: its number
        :param environment_step: environment steps taken by then
        :raises TrainingDiverged: it is time to look, and something is not finite
        """
        if not metrics:
            return
        n = len(metrics)
        if n > self._kept.shape[1]:
            self.check()
            self._kept = torch.zeros(self.WINDOW, n, device=self._device)
        torch.stack(tuple(metrics.values()), out=self._kept[len(self._steps), :n])
        self._steps.append((tuple(metrics), gradient_step, environment_step))
        if len(self._steps) == self.WINDOW:
            self.check()

    def check(self) -> None:
        """
        Check the metrics kept since the last check; on a GPU the host waits for them.

        :raises TrainingDiverged: something was not finite; it names the first gradient step at which
        """
        if not self._steps:
            return
        steps, self._steps = self._steps, []
        kept = self._kept[: len(steps)].cpu().numpy()
        if np.isfinite(kept).all():
            return
        for (names, gradient_step, environment_step), row in zip(steps, kept, strict=True):
            bad = not_finite(dict(zip(names, row[: len(names)].tolist(), strict=True)))
            if bad:
                raise TrainingDiverged(bad, f"gradient step {gradient_step}", environment_step)


def not_finite(values: Mapping[str, float]) -> dict[str, float]:
    """
    :param values: numbers by name
    :return: those that are NaN or infinite
    """
    return {name: float(value) for name, value in values.items() if not np.isfinite(value)}


def diverged(model: BaseAlgorithm, values: Mapping[str, float]) -> TrainingDiverged:
    """
    :param model: an algorithm
    :param values: its values that are not finite, by name
    :return: the error that names them and the number of updates
    """
    # PPO counts passes over its rollouts.
    kind = "gradient step" if isinstance(model, OffPolicyAlgorithm) else "update"
    return TrainingDiverged(values, f"{kind} {model._n_updates}", model.num_timesteps)


def check_finite_parameters(model: BaseAlgorithm) -> None:
    """
    Check every parameter of a model, its optimizers' moments, and the metrics not checked yet. Called before a
    checkpoint is written and at the end of ``learn``.

    :param model: an algorithm, of this package or of Stable-Baselines3
    :raises TrainingDiverged: one is not finite
    """
    watch = getattr(model, "_watch", None)
    if watch is not None:
        watch.check()
    named = {name: tensor for name, tensor in _learned(model) if tensor.is_floating_point() and tensor.numel() > 0}
    kinds: dict[Any, dict[str, torch.Tensor]] = {}
    for name, tensor in named.items():
        kinds.setdefault((tensor.device, tensor.dtype), {})[name] = tensor
    bad: dict[str, float] = {}
    for tensors in kinds.values():
        # The largest absolute value, NaN if there is one.
        largest = torch.stack(torch._foreach_norm(list(tensors.values()), float("inf"))).cpu().tolist()
        bad.update(not_finite(dict(zip(tensors, largest, strict=True))))
    if bad:
        raise diverged(model, {name: value for name, value in bad.items() if ".optimizer" not in name} or bad)


def _learned(model: BaseAlgorithm) -> Iterator[tuple[str, torch.Tensor]]:
    """Everything that gradient steps change, by name."""
    for path in model._get_torch_save_params()[0]:
        # A user's replacement for a learned model need not have an optimizer.
        value = recursive_getattr(model, path, None)
        if isinstance(value, nn.Module):
            for name, parameter in value.named_parameters():
                yield f"{path}.{name}", parameter.detach()
        elif isinstance(value, torch.optim.Optimizer):
            for i, state in enumerate(value.state.values()):
                for name, moment in state.items():
                    if isinstance(moment, torch.Tensor):
                        yield f"{path} ({name} of its parameter {i})", moment


class HoldBack(BaseCallback):
    """
    Call a callback, and keep an exception that it raises during a turn of the training loop until the turn is over,
    when the state is consistent and can be saved: Stable-Baselines3 calls callbacks between the environment's step and
    the storing of the transition.

    The other callbacks of a list are still called, and each continues to be called until the turn ends.
    ``KeyboardInterrupt`` and the like are not kept.

    :param callback: the callback, set up
    """

    def __init__(self, callback: BaseCallback):
        super().__init__()
        self.callback = callback
        self._raised: Exception | None = None

    def _init_callback(self) -> None:
        self.callback.init_callback(self.model)

    def _each(self, callback: BaseCallback, call: Callable[[BaseCallback], bool | None]) -> bool:
        if type(callback) is CallbackList:
            # As CallbackList does itself, but each separately.
            callback.num_timesteps = self.model.num_timesteps
            answers = [self._each(one, call) for one in callback.callbacks]
            return all(answers)
        try:
            return call(callback) is not False
        except Exception as error:
            if self._raised is None:
                self._raised = error
            return True

    def _on_training_start(self) -> None:
        self.callback.on_training_start(self.locals, self.globals)

    def _on_rollout_start(self) -> None:
        self._each(self.callback, lambda callback: callback.on_rollout_start())

    def on_step(self) -> bool:
        """
        :return: whether the training goes on
        """
        if type(self.callback) is CallbackList:
            self.callback.n_calls += 1
        self.n_calls += 1
        self.num_timesteps = self.model.num_timesteps
        # Any false value ends a training, NumPy's too.
        return self._each(self.callback, lambda callback: bool(callback.on_step()))

    def _on_step(self) -> bool:
        raise AssertionError("on_step does the work")

    def _on_rollout_end(self) -> None:
        self._each(self.callback, lambda callback: callback.on_rollout_end())

    def _on_training_end(self) -> None:
        self.callback.on_training_end()

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """
        :param locals_: the loop's variables
        """
        self.callback.update_locals(locals_)

    def has_raised(self) -> bool:
        """
        :return: whether an exception is being kept
        """
        return self._raised is not None

    def raise_kept(self) -> None:
        """Raise the exception kept, if any; only once."""
        error, self._raised = self._raised, None
        if error is not None:
            raise error
