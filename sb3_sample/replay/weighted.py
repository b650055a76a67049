"""Replay buffers that do not draw uniformly: faded by age, by priority (LAP), and windows of several steps."""

# The generator that Stable-Baselines3 seeds and its buffers draw from:
# ruff: noqa: NPY002

import math
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample.kinds import AT_LEAST_0, UNIT, check_value, integer, number
from sb3_sample.learner.batch import SLOTS, Windows, for_each
from sb3_sample.replay.columns import Column, Samples, own_columns_of, samples_at
from sb3_sample.replay.compact import CompactDictReplayBuffer, CompactReplay, CompactReplayBuffer
from sb3_sample.replay.next_observations import ONLY, taken
from sb3_sample.replay.weights import DrawWeights

_FADE = number("lie in (0, 1]", lambda value: 0 < value <= 1)


class FadedReplay(CompactReplay):
    """
    Replay buffer that draws older transitions less often: in proportion to ``max(fade ** age, fade_floor)``, the age
    being the number of steps stored after a transition's own, 0 for the newest ("Forget and Grow", 2025; DR.Q). The age
    that belongs to a uniform number is computed in closed form: a draw costs the same whatever the size of the buffer.

    :param args: as in ``CompactReplayBuffer``
    :param kwargs: as in ``CompactReplayBuffer``
    :param fade: factor on a weight at each step, in (0, 1]
    :param fade_floor: factor down to which a weight fades, in [0, 1]
    :raises ValueError: if one of them is out of range
    """

    def __init__(self, *args: Any, fade: float = 0.9999, fade_floor: float = 0.1, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.fade = check_value("replay_buffer_kwargs['fade']", fade, _FADE)
        self.fade_floor = check_value("replay_buffer_kwargs['fade_floor']", fade_floor, UNIT)

    def ages(self, uniform: np.ndarray) -> np.ndarray:
        """
        Draw ages.

        :param uniform: numbers in [0, 1), (n,)
        :return: the age of each, by the inverse of the cumulative weights, (n,)
        """
        assert isinstance(self, ReplayBuffer)
        n, rate = self.size(), math.log(self.fade)
        if rate == 0:
            return (uniform * n).astype(np.int64)
        # Up to this age a weight fades, from there on it is the floor.
        n_fading = n if self.fade_floor == 0 else min(n, math.ceil(math.log(self.fade_floor) / rate))
        # The sum of the first k weights is (1 - fade ** k) / (1 - fade).
        fading = math.expm1(n_fading * rate) / math.expm1(rate)
        share = uniform * (fading + self.fade_floor * (n - n_fading))
        young = np.log1p(np.minimum(share, fading) * math.expm1(rate)) / rate
        # Rounding must not carry an age into the other part, or over the end.
        ages = np.clip(young, 0, max(n_fading - 1, 0)).astype(np.int64)
        if n_fading < n:
            old = n_fading + (np.maximum(share - fading, 0) / max(self.fade_floor, 1e-300)).astype(np.int64)
            ages = np.where(share < fading, ages, np.minimum(old, n - 1))
        return ages

    def training_places(self, n: int) -> np.ndarray:
        """
        Draw places.

        :param n: how many
        :return: places (position * n_envs + environment), with replacement, (n,)
        """
        ages = self.ages(np.random.random(n))
        positions = (self.pos - 1 - ages) % self.buffer_size
        return positions * self.n_envs + np.random.randint(0, high=self.n_envs, size=n)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """
        Draw transitions.

        :param batch_size: how many
        :param env: normalises observations and rewards
        :return: the transitions
        """
        assert isinstance(self, ReplayBuffer)
        return samples_at(self, *np.divmod(self.training_places(batch_size), self.n_envs), env)


class FadedReplayBuffer(FadedReplay, CompactReplayBuffer):  # type: ignore[misc, override]
    __doc__ = FadedReplay.__doc__


class FadedDictReplayBuffer(FadedReplay, CompactDictReplayBuffer):  # type: ignore[misc, override]
    """Replay buffer for dict observations that draws older transitions less often."""


class PrioritizedReplay(CompactReplay):
    """
    Replay buffer whose transitions are drawn by priority, ``max(|TD error|, smallest_error) ** priority_exponent``
    (LAP, Fujimoto et al. 2020; without importance weights), and, with ``fade`` below 1, less often the older they are.
    The TD errors of a gradient step, the largest over its critics, renew the priorities of its transitions. New
    transitions have the largest priority so far.

    LAP uses the Huber loss, as ``n_quantiles=1`` does; with the squared error of scalar critics large errors count
    twice.

    :param args: as in ``CompactReplayBuffer``
    :param kwargs: as in ``CompactReplayBuffer``
    :param fade: factor on a weight at each transition stored, in (0, 1]; 1 for none
    :param fade_floor: factor down to which a weight fades, in [0, 1]
    :param priority_exponent: at least 0
    :param smallest_error: at least 0
    :raises ValueError: if one of them is out of range
    """

    #: Weights of the draws, whose slots are the places of the transitions here.
    weights: DrawWeights

    def __init__(
        self,
        *args: Any,
        fade: float = 1.0,
        fade_floor: float = 0.1,
        priority_exponent: float = 0.4,
        smallest_error: float = 1.0,
        **kwargs: Any,
    ):
        super().__init__(*args, **kwargs)
        kinds = {"fade": _FADE, "fade_floor": UNIT, "priority_exponent": AT_LEAST_0, "smallest_error": AT_LEAST_0}
        values = dict(zip(kinds, (fade, fade_floor, priority_exponent, smallest_error), strict=True))
        checked = {name: check_value(f"replay_buffer_kwargs[{name!r}]", values[name], kinds[name]) for name in kinds}
        if fade < 1 and fade_floor == 0:
            # Weights that are no longer renewed would all be zero after enough steps.
            raise ValueError(f"replay_buffer_kwargs: fade={fade} needs a fade_floor above 0")
        self.weights = DrawWeights(self.buffer_size * self.n_envs, **checked)

    def add(self, *args: Any, **kwargs: Any) -> None:
        """
        Store one transition of each environment, as in Stable-Baselines3.

        :raises ValueError: if something has another shape than its space; nothing is stored then
        """
        row = self.pos
        super().add(*args, **kwargs)
        self._weigh(row)

    def _weigh(self, row: int) -> None:
        """Give the transitions just stored their slots."""
        self.weights.set_ready(self.weights.put(self.n_envs))

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()
        self.weights.clear()

    @property
    def n_drawable(self) -> int:
        """Transitions that may be drawn."""
        return self.weights.n_ready

    def draw(self, n: int) -> np.ndarray:
        """
        Draw slots by their weights, with replacement.

        :param n: how many
        :return: slots, (n,)
        :raises ValueError: if no transition may be drawn
        """
        return self.weights.draw(1 - np.random.random(n))

    def places(self, slots: np.ndarray) -> np.ndarray:
        """
        Find the transitions of slots.

        :param slots: of transitions, (n,)
        :return: their places (position * n_envs + environment), (n,)
        """
        return self.weights.ordinal[slots] % (self.buffer_size * self.n_envs)

    def renew(self, slots: torch.Tensor, errors: torch.Tensor) -> None:
        """
        Renew the priorities of transitions.

        :param slots: column ``slots`` of a batch, (B, 1)
        :param errors: absolute TD errors, (B,)
        """
        self.weights.renew(slots.reshape(-1).cpu().numpy(), errors.cpu().numpy())

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """
        Draw transitions.

        :param batch_size: how many
        :param env: normalises observations and rewards
        :return: the transitions, with the column ``slots``
        :raises ValueError: if no transition may be drawn
        """
        assert isinstance(self, ReplayBuffer)
        slots = self.draw(batch_size)
        samples = samples_at(self, *np.divmod(self.places(slots), self.n_envs), env)
        columns = {**getattr(samples, "columns", {}), SLOTS: self.to_torch(slots).unsqueeze(1)}
        return Samples(*samples[:5], columns=columns)

    # ---------------------------------------------------------------- to and from files

    def changing_state(self) -> dict[str, Any]:
        """
        Collect the state that changes in rows already stored.

        :return: the state of the weights
        """
        return self.weights.state_dict()

    def load_changing_state(self, state: dict[str, Any]) -> None:
        """
        Restore the state that changes in rows already stored, after the rows.

        :param state: from :meth:`changing_state` of a buffer of the same sizes
        :raises ValueError: if it is of another buffer
        """
        self.weights.load_state_dict(state)
        step, env = divmod(self.weights.n_stored, self.n_envs)
        if env != 0 or step % self.buffer_size != self.pos or min(step, self.buffer_size) != self.size():  # type: ignore[attr-defined]
            raise ValueError(f"the weights of {step} steps are not those of a replay buffer with its next step at "
                             f"{self.pos}")  # fmt: skip


class PrioritizedReplayBuffer(PrioritizedReplay, CompactReplayBuffer):  # type: ignore[misc, override]
    __doc__ = PrioritizedReplay.__doc__


class PrioritizedDictReplayBuffer(PrioritizedReplay, CompactDictReplayBuffer):  # type: ignore[misc, override]
    """Replay buffer for dict observations whose transitions are drawn by priority."""


class WindowReplay(PrioritizedReplay):
    """
    Faded prioritised replay buffer of windows of consecutive steps of one episode (DR.Q).

    A transition may start a window when ``horizon`` later ones of its episode are stored; after a termination the last
    ones may too, with windows that run past the end. The last ``horizon`` transitions before a time limit never do. As
    in the published code, the end of an episode takes a slot, so that the buffer holds as many transitions and ends as
    it has slots. Unlike there, the next observation of a terminating transition is the episode's last one, even within
    windows.

    :param args: as in ``CompactReplayBuffer``
    :param kwargs: as in ``CompactReplayBuffer``
    :param horizon: steps of the longest window
    :param fade: factor on a weight at each transition stored, in (0, 1]; 1 for none
    :raises ValueError: if an argument is out of range, or the buffer cannot hold two windows of each environment
    """

    def __init__(self, *args: Any, horizon: int = 5, fade: float = 0.9999, **kwargs: Any):
        super().__init__(*args, fade=fade, **kwargs)
        self.horizon: int = check_value("horizon", horizon, integer(1))
        if self.buffer_size < 2 * self.horizon + 2:
            raise ValueError(
                f"buffer_size must be at least {(2 * self.horizon + 2) * self.n_envs} for windows of {self.horizon} "
                f"steps of {self.n_envs} environments, not {self.buffer_size * self.n_envs}"
            )
        self._windows = OpenWindows(self.n_envs, self.horizon)

    def _weigh(self, row: int) -> None:
        slots = self.weights.put(self.n_envs)
        # A time limit takes precedence over a termination at the same step.
        truncated = self.timeouts[row] == 1  # type: ignore[attr-defined]
        terminated = (self.dones[row] == 1) & ~truncated  # type: ignore[attr-defined]
        self.weights.set_ready(self._windows.push(slots, terminated))
        self._end(terminated | truncated)

    def _end(self, ended: np.ndarray) -> None:
        if ended.any():
            self._windows.close(ended)
            self.weights.skip(int(ended.sum()))

    def cut_episodes(self) -> None:
        """End the episodes under way, whose environments were reset, as a time limit would."""
        self._end(self._windows.n_open > 0)

    def truncate_last_trajectory(self) -> None:
        """End the episodes under way as a time limit would, in the rows too."""
        assert isinstance(self, ReplayBuffer)
        last = (self.pos - 1) % self.buffer_size
        goes_on = self.dones[last] == 0
        self.dones[last][goes_on] = 1
        if self.handle_timeout_termination:
            self.timeouts[last][goes_on] = 1
        self.cut_episodes()

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()
        self._windows = OpenWindows(self.n_envs, self.horizon)

    def windows(self, batch_size: int, length: int, env: VecNormalize | None = None) -> Windows:
        """
        Draw windows.

        :param batch_size: B
        :param length: H, steps of each, up to ``horizon``
        :param env: normalises observations and rewards
        :return: the windows, with the buffer's own columns of their first steps and ``slots``
        :raises ValueError: if there is none
        """
        return self.windows_of(self.draw(batch_size), length, env)

    def windows_of(self, slots: np.ndarray, length: int, env: VecNormalize | None = None) -> Windows:
        """
        Gather windows.

        :param slots: where they start, (B,)
        :param length: H, steps of each, up to ``horizon``
        :param env: normalises observations and rewards
        :return: the windows, with the buffer's own columns of their first steps and ``slots``
        """
        assert isinstance(self, ReplayBuffer)
        first = self.places(slots)
        n = self.buffer_size * self.n_envs
        places = ((first[:, None] + np.arange(length) * self.n_envs) % n).reshape(-1)
        steps = (len(slots), length)

        def observations(parts: dict[str, np.ndarray], *axes: int) -> Any:
            given = self._normalize_obs(parts if isinstance(self.observations, dict) else parts[ONLY], env)
            return for_each(lambda part: self.to_torch(part).reshape(*axes, *part.shape[1:]), given)

        def flat(array: np.ndarray) -> np.ndarray:
            return array.reshape(n, *array.shape[2:])

        def at_start(column: Column, array: np.ndarray) -> torch.Tensor:
            rows = flat(array)[first]
            return self.to_torch(rows.reshape(-1, 1) if rows.ndim == 1 else rows)

        rewards = self._normalize_reward(flat(self.rewards)[places], env)
        return Windows(
            observations({key: taken(array, first) for key, array in self.stored().items()}, len(slots)),
            self.to_torch(flat(self.actions)[places]).reshape(*steps, -1),
            observations(self._following(places), *steps),
            # A time limit does not end the bootstrap.
            self.to_torch(flat(self.dones)[places] * (1 - flat(self.timeouts)[places])).reshape(steps),
            self.to_torch(rewards).reshape(steps),
            {**own_columns_of(self, at_start), SLOTS: self.to_torch(slots).unsqueeze(1)},
        )

    def changing_state(self) -> dict[str, Any]:
        """
        Collect the state that changes in rows already stored.

        :return: the state of the weights, and the windows that are not complete yet
        """
        return {**super().changing_state(), **self._windows.state_dict()}

    def load_changing_state(self, state: dict[str, Any]) -> None:
        """
        Restore the state that changes in rows already stored, after the rows.

        :param state: from :meth:`changing_state` of a buffer of the same sizes
        :raises ValueError: if it is of another buffer
        """
        windows = OpenWindows(self.n_envs, self.horizon)
        names = windows.state_dict().keys()
        if not names <= state.keys():
            raise ValueError(f"the windows of a replay buffer are {sorted(names)}")
        windows.load_state_dict({name: state[name] for name in names}, self.weights.n_slots)
        super().load_changing_state({name: value for name, value in state.items() if name not in names})
        self._windows = windows


class OpenWindows:
    """
    The latest slots of each environment's episode, which may start windows once enough steps follow.

    :param n_envs: number of environments
    :param horizon: how many later transitions complete a window
    """

    def __init__(self, n_envs: int, horizon: int):
        #: Slots, the oldest first from ``n_pushed % horizon`` on, (n_envs, horizon); and how many the episode had.
        self._slots = np.zeros((n_envs, horizon), np.int64)
        self._n_pushed = np.zeros(n_envs, np.int64)
        self._envs, self._horizon = np.arange(n_envs), horizon

    @property
    def n_open(self) -> np.ndarray:
        """Number of waiting slots of each environment, (n_envs,)."""
        return np.minimum(self._n_pushed, self._horizon)

    def push(self, slots: np.ndarray, terminated: np.ndarray) -> np.ndarray:
        """
        Add the slots of one step.

        :param slots: of each environment's transition, (n_envs,)
        :param terminated: whether each environment's episode terminated with it, (n_envs,)
        :return: slots that may be drawn from now on, (n,)
        """
        at = self._n_pushed % self._horizon
        complete = self._slots[self._envs, at][self._n_pushed >= self._horizon]
        self._slots[self._envs, at] = slots
        self._n_pushed += 1
        if not terminated.any():
            return complete
        ends = self._slots[terminated]
        waiting = np.arange(self._horizon) < self.n_open[terminated][:, None]
        return np.concatenate((complete, ends[waiting]))

    def close(self, ended: np.ndarray) -> None:
        """
        Forget the slots of episodes that ended.

        :param ended: whether each environment's episode ended, (n_envs,)
        """
        self._n_pushed[ended] = 0

    def state_dict(self) -> dict[str, np.ndarray]:
        """
        Collect the state.

        :return: two arrays, copied
        """
        return {"open_slots": self._slots.copy(), "n_pushed": self._n_pushed.copy()}

    def load_state_dict(self, state: dict[str, Any], n_slots: int) -> None:
        """
        Restore the state.

        :param state: from :meth:`state_dict` with the same numbers of environments and steps
        :param n_slots: number of slots
        :raises ValueError: if it does not fit these numbers
        """
        for name, own, most in (("open_slots", self._slots, n_slots), ("n_pushed", self._n_pushed, 2**62)):
            value = state[name]
            if not isinstance(value, np.ndarray) or value.shape != own.shape or value.dtype != own.dtype:
                raise ValueError(f"{name} of the replay buffer must be integers of shape {own.shape}")
            if ((value < 0) | (value >= most)).any():
                raise ValueError(f"{name} of the replay buffer must lie in [0, {most})")
            own[...] = value


class WindowReplayBuffer(WindowReplay, CompactReplayBuffer):  # type: ignore[misc, override]
    __doc__ = WindowReplay.__doc__


class WindowDictReplayBuffer(WindowReplay, CompactDictReplayBuffer):  # type: ignore[misc, override]
    """Faded prioritised replay buffer of windows for dict observations."""
