"""BRO trained on a fixed array of transitions: no environment, no replay buffer, no callback."""

import numpy as np

from sb3_sample import BRO, Dataset

rng = np.random.default_rng(0)
observations = rng.normal(size=(10_000, 3)).astype(np.float32)
actions = rng.uniform(-1, 1, (10_000, 1)).astype(np.float32)
rewards = -np.square(actions[:, 0] - np.tanh(observations[:, 0]))  # the best action is known: tanh of the first number
ends = np.ones(10_000, bool)  # every step is a separate episode

data = Dataset.from_arrays(observations, actions, rewards, ends, np.zeros_like(ends))
learner = BRO.learner(data.observation_space, data.action_space, seed=0, model_size="0.55M")
for _ in range(2_000):
    metrics = learner.update(data.sample(128))
best = learner.act(data.sample(1_000).observations, deterministic=True)
