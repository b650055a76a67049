"""Tasks in the observations of the off-policy family: how networks read them, and how ``predict`` takes them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor
from torch import nn

from sb3_sample.networks import RunningNorm


def is_multi_task(space: spaces.Space | None) -> bool:
    """
    :param space: observation space
    :return: whether observations contain the task: a Dict of "observation", a Box, and "task", a Discrete
    """
    if not isinstance(space, spaces.Dict) or space.spaces.keys() != {"observation", "task"}:
        return False
    return isinstance(space["observation"], spaces.Box) and isinstance(space["task"], spaces.Discrete)


def number_of_tasks(space: spaces.Space | None) -> int:
    """
    :param space: observation space
    :return: number of tasks that observations distinguish; 1 if they contain no task
    """
    return int(space["task"].n) if is_multi_task(space) else 1  # type: ignore[index]


def reads_one_hot(space: spaces.Space) -> bool:
    """
    :param space: observation space
    :return: whether :class:`TaskOneHot` reads them: observations contain the task and are not images
    """
    return is_multi_task(space) and not is_image_space(space["observation"])  # type: ignore[index]


class TaskOneHot(BaseFeaturesExtractor):
    """
    Observation and the one-hot vector of its task (BRO, figure 19); the observation alone if there is one task.

    :param observation_space: a Dict of "observation", a Box, and "task", a Discrete
    """

    def __init__(self, observation_space: spaces.Dict):
        self.n_tasks = number_of_tasks(observation_space)
        size = get_flattened_obs_dim(observation_space["observation"])
        super().__init__(observation_space, size + (self.n_tasks if self.n_tasks > 1 else 0))

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """
        :param observations: "observation", (B, ...), and "task", one-hot, (B, n_tasks)
        :return: (B, O + n_tasks), or (B, O) for one task
        """
        vectors = observations["observation"].flatten(1)
        return torch.cat((vectors, observations["task"].flatten(1)), dim=1) if self.n_tasks > 1 else vectors


def dict_extractor(space: spaces.Space) -> type[BaseFeaturesExtractor]:
    """
    :param space: space of dict observations
    :return: default class of their features extractor
    """
    return TaskOneHot if reads_one_hot(space) else CombinedExtractor


class TaskEmbedding(BaseFeaturesExtractor):
    """
    Observation and the embedding of its task, a learned vector divided by its length (BRC).

    :param observation_space: a Dict of "observation", a Box, and "task", a Discrete
    :param size: size of an embedding
    :raises ValueError: if the observations are images
    """

    def __init__(self, observation_space: spaces.Dict, size: int = 32):
        task = observation_space["task"]
        assert isinstance(task, spaces.Discrete)
        if is_image_space(observation_space["observation"]):
            raise ValueError(
                f"embeddings of tasks stand beside vectors, not beside images of {observation_space['observation']}: "
                "pass multitask=True, for the one-hot vector of the task beside convolutions"
            )
        super().__init__(observation_space, get_flattened_obs_dim(observation_space["observation"]) + size)
        #: A row for each task; its length is learned as well, without effect on the embedding.
        self.table = nn.Parameter(torch.randn(int(task.n), size) / size**0.5)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """
        :param observations: "observation", (B, ...), and "task", one-hot, (B, n_tasks)
        :return: (B, O + size)
        """
        rows = observations["task"].flatten(1) @ self.table
        lengths = torch.linalg.vector_norm(rows, dim=1, keepdim=True)
        return torch.cat((observations["observation"].flatten(1), rows / lengths), dim=1)


class TaskRunningNorm(RunningNorm):
    """Running normalisation of observations that contain their task: one for all tasks, without change to the task."""

    def update(self, values: Any, more_count: float = 0.0) -> None:
        """
        Add observations.

        :param values: "observation", (n, ...), and "task"
        :param more_count: as for :class:`RunningNorm`
        """
        super().update(values["observation"], more_count)

    def forward(self, x: Any) -> Any:
        """
        :param x: "observation", (B, ...), and "task"
        :return: the same with the observation normalised
        """
        return {**x, "observation": super().forward(x["observation"])}


def told_task(space: spaces.Dict, observation: Mapping[str, Any]) -> dict[str, Any]:
    """
    Check the task that ``predict`` is given, and repeat a single one for each row of a batch.

    :param space: space of observations that contain the task
    :param observation: "observation", (O,) or (B, O), and "task", a number, or (B,) of them
    :return: the same with a task for each observation
    :raises ValueError: if it has other entries, a task is no number of one, or their numbers differ
    """
    if observation.keys() != {"observation", "task"}:
        raise ValueError(f"observation must have the entries 'observation' and 'task', not {sorted(observation)}")
    task, first = np.asarray(observation["task"]), int(space["task"].start)  # type: ignore[attr-defined]
    last = first + number_of_tasks(space) - 1
    if task.dtype.kind not in "iu" or ((task < first) | (task > last)).any():
        raise ValueError(
            f"the task of an observation must be its number, an integer from {first} to {last}, not "
            f"{observation['task']!r}"
        )
    vectors = np.asarray(observation["observation"])
    batched = vectors.ndim > len(space["observation"].shape)  # type: ignore[arg-type]
    if task.size == 1:
        task = np.full(len(vectors) if batched else (), task.item())
    elif not batched or task.shape != (len(vectors),):
        rows = (
            f"{len(vectors)} observations must have one task, or one each"
            if batched
            else "one observation has one task"
        )
        raise ValueError(f"{rows}, not tasks of the shape {task.shape}")
    return {"observation": vectors, "task": task}
