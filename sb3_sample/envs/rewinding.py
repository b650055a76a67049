"""
Q-values of actions at visited states: siblings of the environment are restored to the states, and the policy continues.
"""

import collections
import copy
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor

from sb3_sample.envs.states import BOUND, EPISODES, EnvState, is_simulator, layers_of, restore_state, state_attributes


class Follower(Protocol):
    """Policy and critic in the environment's own units."""

    gamma: float

    def sample(self, observations: Any) -> np.ndarray:
        """
        Sample the policy's actions.

        :param observations: the environment's, (B, ...), or a dict of them
        :return: (B, ...)
        """

    def values(self, observations: Any) -> np.ndarray:
        """
        Evaluate the critic.

        :param observations: the environment's, (B, ...), or a dict of them
        :return: (B,)
        """

    def normalize_rewards(self, rewards: np.ndarray) -> np.ndarray:
        """
        Bring rewards into the critic's units.

        :param rewards: the environment's, (B,)
        :return: (B,)
        """

    def to_env(self, actions: np.ndarray) -> np.ndarray:
        """
        Bring actions into the environment's units.

        :param actions: the policy's, (B, ...)
        :return: (B, ...)
        """


def stacked(observations: Sequence[Any]) -> Any:
    """
    Stack observations.

    :param observations: B observations of one space
    :return: (B, ...), or a dict of such arrays
    """
    if isinstance(observations[0], dict):
        return {key: np.stack([each[key] for each in observations]) for key in observations[0]}
    return np.stack(observations)


def rows_of(observations: Any, rows: np.ndarray) -> Any:
    """
    Select rows.

    :param observations: (B, ...), or a dict of such arrays
    :param rows: (B,) of bool
    :return: those rows
    """
    if isinstance(observations, dict):
        return {key: values[rows] for key, values in observations.items()}
    return observations[rows]


def rewound_returns(
    agent: Follower,
    envs: Sequence[gym.Env],
    states: Sequence[EnvState],
    actions: np.ndarray,
    n_steps: Sequence[int],
    rng: np.random.Generator,
    gae_lambda: float = 1.0,
) -> tuple[np.ndarray, int]:
    """
    One sample of Q(s, a) for each state and action: the TD(lambda) return of the action and of the policy after it,
    ``G_k = r_k + gamma ((1 - lambda) V(s_k+1) + lambda G_k+1)``. After the last step, or at a time limit, the critic's
    value counts; after a termination nothing does.

    :param agent: policy and critic
    :param envs: environments to restore the states in, which are stepped side by side
    :param states: B states
    :param actions: as the policy samples them, (B, ...)
    :param n_steps: steps from each state, at least 1, (B,)
    :param rng: generator for the randomness of the environments after the states
    :param gae_lambda: lambda; with 1 the discounted sum of the rewards and the last state's value
    :return: (B,), and how many steps were taken
    """
    returns, total = np.zeros(len(states)), 0
    left = np.array(n_steps)
    # The longest first, so that few rollouts are left running alone at the end.
    waiting = list(np.argsort(-left, kind="stable")[::-1])
    discounts = np.ones(len(states))
    factor = agent.gamma * gae_lambda
    running: dict[int, int] = {}  # environment: row
    pending: dict[int, np.ndarray] = {}  # environment: next action

    while waiting or running:
        for index in range(len(envs)):
            if index not in running and waiting:
                row = int(waiting.pop())
                restore_state(envs[index], states[row], rng)
                running[index], pending[index] = row, actions[row]
        at = sorted(running)
        rows = np.array([running[index] for index in at])
        taken = agent.to_env(np.stack([pending[index] for index in at]))
        results = [envs[index].step(action) for index, action in zip(at, taken, strict=True)]
        total += len(at)
        left[rows] -= 1
        observations = stacked([result[0] for result in results])
        terminated = np.array([result[2] for result in results], dtype=bool)
        # Only a termination ends the sum; a time limit stops the simulation, not the task.
        stopped = ~terminated & (np.array([result[3] for result in results], dtype=bool) | (left[rows] == 0))
        goes_on = ~(terminated | stopped)
        following = np.zeros(len(at))
        valued = stopped if gae_lambda == 1 else ~terminated
        if valued.any():
            following[valued] = agent.values(rows_of(observations, valued))
        # Where a rollout continues, the value counts with 1 - lambda; the rest is in the rewards to come.
        following[goes_on] *= 1 - gae_lambda
        rewards = agent.normalize_rewards(np.array([float(result[1]) for result in results]))
        returns[rows] += discounts[rows] * (rewards + agent.gamma * following)
        discounts[rows] *= factor
        if goes_on.any():
            fresh = iter(agent.sample(rows_of(observations, goes_on)))
        for index, stays in zip(at, goes_on, strict=True):
            if stays:
                pending[index] = next(fresh)
            else:
                del running[index], pending[index]
    return returns, total


def sibling_of(env: gym.Env) -> gym.Env:
    """
    Make another environment like a given one, to restore its states in: from its ``spec`` if it has one, otherwise as a
    copy. Wrappers are made anew from their arguments if these are recorded, otherwise copied.

    :param env: environment, wrapped or not
    :return: another one with the same wrappers, in no particular state. Stable-Baselines3's ``Monitor`` in it writes no
        file
    :raises ValueError: it is recorded as a video, as the other one would be, or a wrapper that can only be copied
        refers to the simulator
    """
    wrappers = []
    while isinstance(env, gym.Wrapper):
        wrappers.append(env)
        env = env.env
    made = copy.deepcopy(env) if env.spec is None else gym.make(env.spec).unwrapped
    for wrapper in reversed(wrappers):
        made = _wrapped_like(wrapper, made)
    return made


def _wrapped_like(wrapper: gym.Wrapper, env: gym.Env) -> gym.Env:
    if isinstance(wrapper, Monitor):
        monitor: Any = Monitor(env, None, info_keywords=wrapper.info_keywords)
        # Its episodes are never read, and would fill the memory.
        for name in EPISODES:
            setattr(monitor, name, collections.deque(maxlen=0))
        return monitor  # type: ignore[no-any-return]
    if isinstance(wrapper, gym.wrappers.RecordVideo):
        raise ValueError("a video is recorded, and would be of the copies too: leave RecordVideo out")
    make: Callable[..., gym.Env] = type(wrapper)
    recorded = getattr(wrapper, "_saved_kwargs", None)
    if recorded is not None:
        return make(env, **recorded)
    # Its state is copied; the other attributes describe it, unless one refers to the environment itself.
    inside = [value for layer in layers_of(wrapper.env) for value in vars(layer).values() if is_simulator(value)]
    for name, value in vars(wrapper).items():
        if name != "env" and (isinstance(value, gym.Env) or any(value is each for each in inside)):
            raise ValueError(
                f"{type(wrapper).__name__} holds on to the environment in its attribute {name!r}, and a copy would "
                "too: derive it from gymnasium.utils.RecordConstructorArgs"
            )
    like = copy.copy(wrapper)
    like.env = env
    # Methods that are bound to the wrapper or to a layer inside it become bound to the copies.
    layers = zip(layers_of(wrapper), layers_of(like), strict=True)
    others: dict[int, Any] = {id(layer): other for layer, other in layers}
    copied = state_attributes(wrapper)
    copied.update({name: value for name, value in vars(wrapper).items() if isinstance(value, BOUND)})
    vars(like).update(copy.deepcopy(copied, others))
    return like
