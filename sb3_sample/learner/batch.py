"""Inputs of one gradient step."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import torch

#: Column of batches from a replay buffer with priorities: the slots that the transitions were drawn from, (B, 1).
SLOTS = "slots"


class Batch(NamedTuple):
    """
    One gradient step's transitions.

    ``observations`` and ``next_observations`` are (B, O) or dicts of tensors; ``actions``, in [-1, 1], are (B, A);
    ``dones``, 1 where the episode terminated (a time limit is 0), and ``rewards`` are (B, 1); ``discounts`` is a
    number or (B, 1), None for the learner's own; ``columns`` are further columns of the source by name, (B, ...) each.
    """

    observations: Any
    actions: torch.Tensor
    next_observations: Any
    dones: torch.Tensor
    rewards: torch.Tensor
    discounts: torch.Tensor | float | None = None
    columns: Mapping[str, torch.Tensor] = {}

    @classmethod
    def of(cls, samples: Any, gamma: float) -> "Batch":
        """
        Convert samples of a Stable-Baselines3 buffer to a batch.

        :param samples: transitions as Stable-Baselines3's buffers give them
        :param gamma: discount factor of samples that have none of their own
        :return: the same as a batch
        """
        discounts = getattr(samples, "discounts", None)
        return cls(
            samples.observations,
            samples.actions,
            samples.next_observations,
            samples.dones,
            samples.rewards,
            gamma if discounts is None else discounts,
            getattr(samples, "columns", {}),
        )


class Windows(NamedTuple):
    """
    Windows of H consecutive steps, each window from one environment.

    ``observations`` are those of the first steps, (B, O) or a dict of such; ``actions``, in [-1, 1], are (B, H, A);
    ``next_observations`` are (B, H, O) or a dict of such; ``dones``, 1 where the episode terminated (a time limit is
    0), and ``rewards`` are (B, H). Steps after a termination belong to another episode and have no meaning.
    ``columns`` are those of the first steps.
    """

    observations: Any
    actions: torch.Tensor
    next_observations: Any
    dones: torch.Tensor
    rewards: torch.Tensor
    columns: Mapping[str, torch.Tensor] = {}

    def n_step(self, gamma: float) -> Batch:
        """
        Make transitions of H steps, whose reward is the discounted sum up to a termination.

        :param gamma: discount factor of one step
        :return: the transitions
        """
        alive = (1 - self.dones).cumprod(dim=1)
        discounts = gamma ** torch.arange(alive.shape[1], dtype=alive.dtype, device=alive.device)
        # The reward of the terminating step counts.
        counts = torch.cat((torch.ones_like(alive[:, :1]), alive[:, :-1]), dim=1)
        return Batch(
            self.observations,
            self.actions[:, 0],
            for_each(lambda part: part[:, -1], self.next_observations),
            1 - alive[:, -1:],
            (self.rewards * counts * discounts).sum(dim=1, keepdim=True),
            gamma ** alive.shape[1],
            self.columns,
        )


class Encoded(NamedTuple):
    """
    Features that a shared encoder computed from observations. Actors and critics take them in place of observations:
    ``features`` is (B, F), with a gradient to the encoder in the critics' own step only.
    """

    features: torch.Tensor


def for_each(function: Callable[[Any], Any], values: Any) -> Any:
    """
    Apply a function to observations: a tensor or array, or each value of a dict of them.

    :param function: the function
    :param values: the tensor or array, or the dict
    :return: its result, or a dict of them
    """
    return {key: function(value) for key, value in values.items()} if isinstance(values, dict) else function(values)


def widened(batch: Batch, target_copies: int, online_copies: int) -> Batch:
    """
    Repeat a batch for augmentation by several copies, one copy of all transitions after the other.

    :param batch: B transitions
    :param target_copies: K
    :param online_copies: M
    :return: observations and actions M times, (M * B, ...), inputs of the TD target K times, (K * B, ...), columns
        unchanged
    """

    def repeated(values: Any, n: int) -> Any:
        if not isinstance(values, torch.Tensor) or values.dim() == 0:
            return values
        return values.repeat(n, *[1] * (values.dim() - 1))

    return Batch(
        for_each(lambda part: repeated(part, online_copies), batch.observations),
        repeated(batch.actions, online_copies),
        for_each(lambda part: repeated(part, target_copies), batch.next_observations),
        repeated(batch.dones, target_copies),
        repeated(batch.rewards, target_copies),
        repeated(batch.discounts, target_copies),
        batch.columns,
    )


def first_copy(batch: Batch, n: int) -> Batch:
    """
    Take the first copy of each transition.

    :param batch: from :func:`widened`
    :param n: B
    :return: B transitions
    """

    def first(values: Any) -> Any:
        if isinstance(values, Encoded):
            return Encoded(values.features[:n])
        return values[:n] if isinstance(values, torch.Tensor) and values.dim() > 0 else values

    return Batch(*(for_each(first, value) for value in batch))


class Extra(NamedTuple):
    """
    Transitions that the rule of pessimism learns from besides the step's batch.

    ``ends`` is 1 where an episode ended with the step, by termination or truncation, (T, N), if they are the latest T
    steps of N environments in their order; None if they are in no order.
    """

    batch: Batch
    ends: torch.Tensor | None = None


class Source(Protocol):
    """Interface of the source of batches that a rule of pessimism draws from."""

    def held_out(self) -> Batch | None:
        """
        Draw transitions of the validation side.

        :return: transitions that are held out of training, as many as a step learns from; None while there are fewer
        """

    def latest(self, n_steps: int) -> Extra | None:
        """
        Return the newest transitions.

        :param n_steps: T
        :return: the latest T steps of every environment, the oldest first; None while there are fewer
        """


class Store(Protocol):
    """Interface of a replay buffer on the learner's device, from which the gradient step itself draws its batches."""

    def draw(self, n: int) -> Any:
        """
        Draw transitions to train on by tensor operations alone, with torch's generator of the device.

        :param n: how many
        :return: transitions as Stable-Baselines3's buffers give them
        """

    def draw_held_out(self, n: int) -> Any:
        """
        Draw transitions of the validation side in the same way.

        :param n: how many
        :return: transitions as Stable-Baselines3's buffers give them
        """

    def newest(self, n_steps: int) -> tuple[Any, torch.Tensor]:
        """
        Gather the newest transitions by tensor operations alone.

        :param n_steps: T
        :return: the latest T steps of every environment, the oldest first, as Stable-Baselines3's buffers give them;
            and 1 where an episode ended with the step, (T, N)
        """


class StoreSource:
    """
    Source for a gradient step that itself draws from a store, which always has as many transitions as are drawn.

    :param store: the store
    :param n: transitions of the validation side that :meth:`held_out` draws
    :param gamma: discount factor of transitions that have none of their own
    """

    def __init__(self, store: Store, n: int, gamma: float):
        self._store, self._n, self._gamma = store, n, gamma

    def held_out(self) -> Batch:
        """
        :return: n transitions of the validation side
        """
        return Batch.of(self._store.draw_held_out(self._n), self._gamma)

    def latest(self, n_steps: int) -> Extra:
        """
        :param n_steps: T
        :return: the latest T steps of every environment, the oldest first
        """
        samples, ends = self._store.newest(n_steps)
        return Extra(Batch.of(samples, self._gamma), ends)


class Noise(NamedTuple):
    """
    All random numbers of one gradient step: standard normal noise of its sampled actions, (B, A) each; the indices of
    the critics that make the TD target, (n,), if they are drawn; and one entry for each batch transform. Entries that
    are None are drawn by :meth:`completed`, after those of the batch transforms.
    """

    critic: torch.Tensor | None = None
    actor: torch.Tensor | None = None
    exploration: torch.Tensor | None = None
    pessimism: torch.Tensor | None = None
    subset: torch.Tensor | None = None
    transforms: tuple[torch.Tensor | None, ...] | None = None

    def completed(
        self, batch: Batch, extra: Extra | None, subset: tuple[int, int] | None, copies: tuple[int, int] = (1, 1)
    ) -> "Noise":
        """
        Draw what is missing.

        :param batch: the step's transitions
        :param extra: further transitions that the rule of pessimism learns from, if any
        :param subset: how many critics are drawn for the TD target, and from how many; None: none are drawn
        :param copies: copies of the transitions in the TD target, K, and in the critics' loss, M (:func:`widened`). The
            critics' noise is then (K * B, A)
        :return: the same noise, with what was None drawn
        """
        like, (k, m) = batch.actions, copies
        n = len(like) // m
        rows = {"critic": k * n, "actor": n, "exploration": n}
        if extra is not None:
            rows["pessimism"] = len(extra.batch.actions)
        missing = {name: n for name, n in rows.items() if getattr(self, name) is None}
        drawn: dict[str, Any] = {}
        if missing:
            values = torch.randn(sum(missing.values()), like.shape[1], dtype=like.dtype, device=like.device)
            drawn.update(zip(missing, values.split(list(missing.values())), strict=True))
        if subset is not None and self.subset is None:
            n, of = subset
            drawn["subset"] = torch.randperm(of, device=like.device)[:n]
        return self._replace(**drawn)


class CriticStep(NamedTuple):
    """
    Results of the critics' step, computed before the critics changed, for a rule of pessimism that learns from the
    same transitions. Without gradient.

    ``q`` are the critics' predictions, (E, B, K); ``next_q`` those of the target critics for the next state and the
    actor's action there (of the drawn subset, if one is drawn), (E, B, K); ``entropy_bonus`` is ``-alpha * log pi`` of
    that action, (B, 1); ``subset`` the critics that make the step's TD target, (n,), None for all.
    """

    q: torch.Tensor
    next_q: torch.Tensor
    entropy_bonus: torch.Tensor
    subset: torch.Tensor | None = None
