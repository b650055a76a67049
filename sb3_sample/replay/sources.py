"""Sources of batches: the way from a model's replay buffer to its learner."""

from collections.abc import Iterator
from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample.learner.batch import Batch, Extra, Windows
from sb3_sample.replay.buffers import BatchMemory, ValidationSplit, latest, samples_as_its_class


class ReplaySource:
    """
    Source of batches from a model's replay buffer, normalised as its environment is.

    :param model: the algorithm; its ``replay_buffer``, ``gamma``, ``batch_size`` and ``validation_proportion`` are
        those in force when something is drawn
    """

    def __init__(self, model: Any):
        self._model = model
        self._memory = BatchMemory()

    def sample(self, batch_size: int) -> Batch:
        """
        :param batch_size: B
        :return: transitions, with the model's discount factor
        """
        (batch,) = self.batches(1, batch_size)
        return batch

    def batches(self, n_batches: int, batch_size: int) -> list[Batch]:
        """
        Draw the batches of several gradient steps.

        :param n_batches: number of gradient steps
        :param batch_size: transitions a step
        :return: the batches, valid until the next call
        """
        model = self._model
        return draw_batches(
            model.replay_buffer, n_batches, batch_size, model.gamma, model.get_vec_normalize_env(), self._memory
        )

    def held_out(self) -> Batch | None:
        """
        Draw transitions of the validation side.

        :return: ``round(validation_proportion * batch_size)`` transitions that are held out of training, at least one;
            None while there are fewer
        """
        model, split = self._model, self._model.replay_buffer
        assert isinstance(split, ValidationSplit)
        n = max(1, round(model.validation_proportion * model.batch_size))
        if split.n_validation < n:
            return None
        return Batch.of(split.sample_validation(n, env=model.get_vec_normalize_env()), model.gamma)

    def latest(self, n_steps: int) -> Extra | None:
        """
        Return the newest transitions.

        :param n_steps: T
        :return: the latest T steps of every environment, the oldest first; None while there are fewer
        """
        model = self._model
        if model.replay_buffer.size() < n_steps:
            return None
        samples, ends = latest(model.replay_buffer, n_steps, model.get_vec_normalize_env())
        return Extra(Batch.of(samples, model.gamma), ends)


class WindowSource(ReplaySource):
    """
    Source of n-step transitions and of windows, from a model whose buffer holds windows; its ``n_steps`` and
    ``encoder_horizon`` are those in force when something is drawn.

    :param model: the algorithm
    """

    def batches(self, n_batches: int, batch_size: int) -> list[Batch]:
        """
        Draw the batches of several gradient steps.

        :param n_batches: number of gradient steps
        :param batch_size: transitions a step
        :return: the batches, each drawn by the weights of now
        """
        model = self._model
        drawn = (self._window(batch_size, model.n_steps) for _ in range(n_batches))
        return [windows.n_step(model.gamma) for windows in drawn]

    def windows(self, n_batches: int, batch_size: int) -> Iterator[Windows]:
        """
        Draw the batches of several steps of the encoder, each when it is needed.

        :param n_batches: number of steps
        :param batch_size: windows a step
        :return: the batches
        """
        return (self._window(batch_size, self._model.encoder_horizon) for _ in range(n_batches))

    def _window(self, batch_size: int, length: int) -> Windows:
        model = self._model
        found: Windows = model.replay_buffer.windows(batch_size, length, model.get_vec_normalize_env())
        return found


def draw_batches(
    buffer: ReplayBuffer,
    n_batches: int,
    batch_size: int,
    gamma: float,
    vec_normalize: VecNormalize | None,
    memory: BatchMemory | None = None,
) -> list[Batch]:
    """
    Draw the batches of several gradient steps, at once where the distribution is the same.

    :param buffer: replay buffer
    :param n_batches: number of gradient steps
    :param batch_size: transitions a step
    :param gamma: discount factor, where the buffer has none of its own
    :param vec_normalize: normalises observations and rewards as they are drawn
    :param memory: memory that the transitions are gathered into where that is possible
    :return: the batches; with ``memory``, valid until it is used again
    """
    if memory is not None and memory.serves(buffer, vec_normalize):
        return _cut(Batch.of(memory.gather(buffer, n_batches * batch_size), gamma), n_batches, batch_size)
    if n_batches > 1 and not samples_as_its_class(buffer):
        return [draw_batches(buffer, 1, batch_size, gamma, vec_normalize)[0] for _ in range(n_batches)]
    return _cut(Batch.of(buffer.sample(n_batches * batch_size, env=vec_normalize), gamma), n_batches, batch_size)


def _cut(data: Batch, n_batches: int, batch_size: int) -> list[Batch]:
    """Cut one large batch into several."""
    if n_batches == 1:
        return [data]

    def cut(x: Any) -> list[Any]:
        if isinstance(x, (int, float)):
            return [x] * n_batches
        if isinstance(x, dict):
            pieces = {key: value.split(batch_size) for key, value in x.items()}
            return [{key: value[i] for key, value in pieces.items()} for i in range(n_batches)]
        return list(x.split(batch_size))

    return [Batch(*row) for row in zip(*map(cut, data), strict=True)]
