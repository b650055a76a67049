"""Sources of batches: the way from a model's replay buffer, or from a data set, to its learner."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample.learner.batch import Batch, Extra, Windows, for_each
from sb3_sample.replay.buffers import BatchMemory, ValidationSplit, latest, samples_as_its_class
from sb3_sample.replay.dataset import Dataset
from sb3_sample.replay.mixture import mixed


class DatasetSource:
    """
    Source of batches from a data set, normalised as a model's environment is. Rows are drawn by NumPy's global
    generator, like those of replay buffers.

    :param model: the algorithm; its ``batch_size`` and normalisation are those in force when something is drawn
    :param dataset: the data set; the model's ``validation_proportion`` of its steps are held out, always the same ones
    """

    def __init__(self, model: Any, dataset: Dataset):
        self._model, self.dataset = model, dataset
        self._training: np.ndarray | None = None
        self._held_out = np.empty(0, np.int64)
        if model.validation_proportion > 0:
            order = np.random.default_rng(0).permutation(len(dataset))
            n = min(round(model.validation_proportion * len(dataset)), len(dataset) - 1)
            self._held_out, self._training = order[:n], order[n:]

    def sample(self, batch_size: int) -> Batch:
        """
        :param batch_size: B
        :return: transitions, with the learner's discount factor
        """
        (batch,) = self.batches(1, batch_size)
        return batch

    def batches(self, n_batches: int, batch_size: int) -> list[Batch]:
        """
        Draw the batches of several gradient steps.

        :param n_batches: number of gradient steps
        :param batch_size: transitions per step
        :return: the batches
        """
        n = len(self.dataset) if self._training is None else len(self._training)
        rows = np.random.randint(0, n, size=n_batches * batch_size)  # noqa: NPY002  # which checkpoints hold
        return _cut(self._taken(rows if self._training is None else self._training[rows]), n_batches, batch_size)

    def held_out(self) -> Batch | None:
        """
        Draw transitions of the validation side.

        :return: as many transitions as :meth:`ReplaySource.held_out` draws; None while there are fewer
        """
        n = n_held_out(self._model)
        return self.drawn_held_out(n) if len(self._held_out) >= n else None

    def drawn_held_out(self, n: int) -> Batch:
        """
        :param n: how many, at least one and at most as many as there are
        :return: transitions of the validation side
        """
        return self._taken(np.random.choice(self._held_out, n))  # noqa: NPY002

    @property
    def n_held_out(self) -> int:
        """Number of transitions of the validation side."""
        return len(self._held_out)

    def observations(self) -> Iterator[Any]:
        """
        :return: observations of all transitions, the held-out ones included, some thousand at a time, (n, O)
        """
        for rows in np.array_split(np.arange(len(self.dataset)), -(-len(self.dataset) // 10_000)):
            yield self._taken(rows).observations

    def latest(self, n_steps: int) -> Extra | None:
        """
        :param n_steps: T
        :return: None: a data set has no newest steps
        """
        return None

    def _taken(self, rows: np.ndarray) -> Batch:
        batch, venv = self.dataset.take(torch.from_numpy(rows)), self._model.get_vec_normalize_env()
        if venv is not None:

            def normalized(observations: Any) -> Any:
                return for_each(
                    torch.from_numpy, venv.normalize_obs(for_each(lambda part: part.cpu().numpy(), observations))
                )

            batch = batch._replace(
                observations=normalized(batch.observations),
                next_observations=normalized(batch.next_observations),
                rewards=torch.from_numpy(venv.normalize_reward(batch.rewards.cpu().numpy()).astype(np.float32)),
            )
        device = self._model.device
        moved: dict[str, Any] = {
            name: None if value is None else for_each(lambda part: part.to(device), value)
            for name, value in batch._asdict().items()
        }
        return Batch(**moved)


class ReplaySource:
    """
    Source of batches from a model's replay buffer, normalised as its environment is, and from its prior data, if any,
    whose rows come first.

    :param model: the algorithm; its ``replay_buffer``, ``gamma``, ``batch_size`` and ``validation_proportion`` are
        those in force when something is drawn
    """

    def __init__(self, model: Any):
        self._model = model
        self._memory = BatchMemory()
        self._prior = None if model.prior_data is None else DatasetSource(model, model.prior_data)

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
        :param batch_size: transitions per step
        :return: the batches, valid until the next call
        """
        model, n_prior = self._model, 0
        if self._prior is not None:
            n_prior = round(model.prior_share * batch_size)
        online = draw_batches(
            model.replay_buffer,
            n_batches,
            batch_size - n_prior,
            model.gamma,
            model.get_vec_normalize_env(),
            self._memory,
        )
        if self._prior is None:
            return online
        pairs = zip(self._prior.batches(n_batches, n_prior), online, strict=True)
        return [mixed([prior, replayed]) for prior, replayed in pairs]

    def held_out(self) -> Batch | None:
        """
        Draw transitions of the validation side.

        :return: ``round(validation_proportion * batch_size)`` transitions that are held out of training, at least one;
            None while there are fewer
        """
        model, split = self._model, self._model.replay_buffer
        assert isinstance(split, ValidationSplit)
        n, n_prior = n_held_out(model), 0
        if self._prior is not None:
            n_prior = round(model.prior_share * n)
        if split.n_validation < n - n_prior or (self._prior is not None and self._prior.n_held_out < n_prior):
            return None
        theirs = [] if self._prior is None or n_prior == 0 else [self._prior.drawn_held_out(n_prior)]
        if n > n_prior:
            replayed = split.sample_validation(n - n_prior, env=model.get_vec_normalize_env())
            theirs.append(Batch.of(replayed, model.gamma))
        return theirs[0] if len(theirs) == 1 else mixed(theirs)

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
        :param batch_size: transitions per step
        :return: the batches, each drawn by the current weights
        """
        model = self._model
        drawn = (self._window(batch_size, model.n_steps) for _ in range(n_batches))
        return [windows.n_step(model.gamma) for windows in drawn]

    def windows(self, n_batches: int, batch_size: int) -> Iterator[Windows]:
        """
        Draw the batches of several steps of the encoder, each when it is needed.

        :param n_batches: number of steps
        :param batch_size: windows per step
        :return: the batches
        """
        return (self._window(batch_size, self._model.encoder_horizon) for _ in range(n_batches))

    def _window(self, batch_size: int, length: int) -> Windows:
        model = self._model
        found: Windows = model.replay_buffer.windows(batch_size, length, model.get_vec_normalize_env())
        return found


def n_held_out(model: Any) -> int:
    """
    :param model: the algorithm
    :return: transitions of the validation side that a gradient step learns from
    """
    return max(1, round(model.validation_proportion * model.batch_size))


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
    :param batch_size: transitions per step
    :param gamma: discount factor, if the buffer has none of its own
    :param vec_normalize: normalises observations and rewards as they are drawn
    :param memory: memory into which the transitions are gathered if possible
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
        if x is None or isinstance(x, (int, float)):
            return [x] * n_batches
        if isinstance(x, dict):
            pieces = {key: value.split(batch_size) for key, value in x.items()}
            return [{key: value[i] for key, value in pieces.items()} for i in range(n_batches)]
        return list(x.split(batch_size))

    return [Batch(*row) for row in zip(*map(cut, data), strict=True)]
