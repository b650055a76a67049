"""Evaluation on Atari by the protocol of the published scores."""

from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sample.envs.atari import check_atari_id, make_atari_env
from sb3_sample.envs.scores import score_of
from sb3_sample.kinds import check_value, integer

#: Most decisions of an episode: 108,000 frames.
MAX_DECISIONS = 27_000
#: Exclusive upper bound of the number of no-ops drawn for the start of an episode.
MAX_NOOPS = 30


def evaluation_env(env_id: str) -> gym.Env:
    """
    Make a game for :func:`evaluate_atari`.

    :param env_id: ``"ALE/<Game>-v5"``
    :return: the game, without its own no-ops, without episodes that end with a life, and without clipped rewards
    """
    return make_atari_env(env_id, training=False, noop_max=None)


def evaluate_atari(
    model: Any,
    env_id: str,
    n_episodes: int = 100,
    seed: int = 0,
    max_decisions: int = MAX_DECISIONS,
    noops: list[int] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Evaluate by the protocol of SPR's and SR-SPR's scores: whole games, unclipped rewards, one action in a thousand
    random (``evaluation_eps``), after 0 to 29 no-ops. The function uses its own random generator.

    :param model: an ``SRSPR``, or another of Stable-Baselines3's models for such observations, which then acts without
        random actions
    :param env_id: ``"ALE/<Game>-v5"``
    :param n_episodes: how many games
    :param seed: of everything random
    :param max_decisions: decisions after which a game is cut off
    :param noops: list to which the number of no-ops of each game is appended, if given
    :return: returns, and numbers of decisions, (n_episodes,) each
    :raises ValueError: if an argument is out of range
    """
    check_value("n_episodes", n_episodes, integer(1))
    check_value("max_decisions", max_decisions, integer(MAX_NOOPS))
    env, rng, rate = evaluation_env(env_id), np.random.default_rng(seed), getattr(model, "evaluation_eps", 0.0)
    returns, lengths = np.zeros(n_episodes), np.zeros(n_episodes, np.int64)
    try:
        for episode in range(n_episodes):
            observation, _ = env.reset(seed=seed if episode == 0 else None)
            waits = int(rng.integers(MAX_NOOPS))
            if noops is not None:
                noops.append(waits)
            for decision in range(max_decisions):
                if decision < waits:
                    action = 0
                elif rng.random() < rate:
                    action = int(rng.integers(model.action_space.n))
                else:
                    action = int(model.predict(observation, deterministic=True)[0])
                observation, reward, terminated, truncated, _ = env.step(action)
                returns[episode] += float(reward)
                lengths[episode] += 1
                if terminated or truncated:
                    break
    finally:
        env.close()
    return returns, lengths


class AtariEvaluation(BaseCallback):
    """
    Evaluates with :func:`evaluate_atari` every ``every`` decisions and records ``eval/mean_reward`` and
    ``eval/human_normalized``.

    :param env_id: ``"ALE/<Game>-v5"``
    :param every: decisions between two evaluations
    :param n_episodes: games of each evaluation
    :param verbose: as for every callback
    :raises ValueError: if an argument is out of range
    """

    def __init__(self, env_id: str, every: int = 10_000, n_episodes: int = 100, verbose: int = 0):
        super().__init__(verbose)
        check_atari_id(env_id)
        self.env_id = env_id
        self.every: int = check_value("every", every, integer(1))
        self.n_episodes: int = check_value("n_episodes", n_episodes, integer(1))
        #: Decisions at the evaluations so far, and their mean returns.
        self.results: list[tuple[int, float]] = []

    def _init_callback(self) -> None:
        env = evaluation_env(self.env_id)
        env.close()
        for name in ("observation_space", "action_space"):
            theirs, ours = getattr(env, name), getattr(self.model, name)
            if theirs != ours:
                raise ValueError(f"env_id={self.env_id!r} has another {name} than the model: {theirs}, not {ours}")

    def _on_step(self) -> bool:
        if self.num_timesteps // self.every == (self.num_timesteps - self.training_env.num_envs) // self.every:
            return True
        returns, _ = evaluate_atari(self.model, self.env_id, self.n_episodes, seed=self.num_timesteps)
        mean = float(returns.mean())
        self.results.append((self.num_timesteps, mean))
        self.logger.record("eval/mean_reward", mean)
        score = score_of(self.env_id)
        if score is not None:
            self.logger.record("eval/human_normalized", score.of(mean))
        return True

    def state_dict(self) -> dict[str, Any]:
        """
        Collect the state that a resumed run needs.

        :return: the results so far
        """
        return {"results": [list(result) for result in self.results]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Restore the results.

        :param state: from :meth:`state_dict`
        """
        self.results = [(int(step), float(mean)) for step, mean in state["results"]]
