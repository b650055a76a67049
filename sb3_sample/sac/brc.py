"""BRC, for one task and for several."""

from typing import Any, ClassVar

import torch
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sample.constructor import argument
from sb3_sample.kinds import AT_LEAST_0, integer
from sb3_sample.learner.categorical import VALUE_HEADS, CategoricalHead
from sb3_sample.learner.heads import ValueHead
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.learner.reward_scale import RewardScale
from sb3_sample.sac.algorithm import SAC


class TaskEmbedding(BaseFeaturesExtractor):
    """
    Observation and the embedding of its task, a learned vector divided by its length.

    :param observation_space: a Dict of "observation", a Box, and "task", a Discrete
    :param size: of an embedding
    """

    def __init__(self, observation_space: spaces.Dict, size: int = 32):
        task = observation_space["task"]
        assert isinstance(task, spaces.Discrete)
        super().__init__(observation_space, get_flattened_obs_dim(observation_space["observation"]) + size)
        #: A row for each task, whose length is learned as well and without effect on the embedding.
        self.table = nn.Parameter(torch.randn(int(task.n), size) / size**0.5)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """
        :param observations: "observation", (B, ...), and "task", one-hot, (B, n_tasks)
        :return: (B, O + size)
        """
        rows = observations["task"].flatten(1) @ self.table
        lengths = torch.linalg.vector_norm(rows, dim=1, keepdim=True)
        return torch.cat((observations["observation"].flatten(1), rows / lengths), dim=1)


def is_multi_task(space: spaces.Space) -> bool:
    """
    :param space: of observations
    :return: whether they tell the task: a Dict of "observation", a Box, and "task", a Discrete
    """
    if not isinstance(space, spaces.Dict) or space.spaces.keys() != {"observation", "task"}:
        return False
    return isinstance(space["observation"], spaces.Box) and isinstance(space["task"], spaces.Discrete)


class BRC(SAC):
    """
    BRC: bigger, regularized, categorical (Nauman et al. 2025, https://arxiv.org/abs/2505.23150).

    BroNet critics, far wider than BRO's, as classifiers over 101 atoms in [-10, 10]; the mean of their probabilities in
    target and actor; rewards divided by a measure of the returns of finished episodes; weight decay; no resets and no
    optimism.

    With observations that are a Dict of "observation" and "task" (a Discrete), critics and actor read a learned
    embedding of the task beside the observation, and rewards are scaled by task. The embeddings are the critics', which
    learn them; the actor reads them without gradient. Target entropy and temperature are one for all tasks. The
    published batch is then 1,024.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    learning_starts: int = argument(default=5_000, kw_only=False)
    """transitions with uniformly random actions before the first gradient step, counted over the model's life"""
    ent_coef: str | float = argument(default="auto_0.1", kw_only=False)
    """temperature: "auto_0.1" learns it from that start, a number fixes it"""
    critic_width: int | None = argument(default=4096, kind=integer(1).or_none("what policy_kwargs say"))
    """width of the critics; None if ``policy_kwargs`` describe them"""
    value_head: str | type[ValueHead] | None = argument(default="categorical")
    """"categorical" or "hl_gauss", from -10 to 10 unless ``value_head_kwargs`` say otherwise, or a class derived from
    ``ValueHead``; None: scalar critics, or ``n_quantiles``"""
    pessimism: float | str | type[Pessimism] = argument(default=0.0)
    """weight of the critics' spread that is subtracted from their mean, at least 0; or a rule, as in ``SAC``"""
    reward_scale: str | type[RewardScale] | None = argument(default="brc")
    """rule by which rewards are divided by a running measure of the return; None for none"""
    weight_decay: float = argument(default=1e-4, kind=AT_LEAST_0)
    """decoupled weight decay of critics, embeddings and actor"""
    embedding_size: int = argument(default=32, kind=integer(1))
    """size of a task's embedding, where there are tasks"""

    temperature_beta1: ClassVar[float] = 0.5

    def _check_arguments(self) -> None:
        super()._check_arguments()
        described = sorted({"critic_network", "critic_network_kwargs"} & self.policy_kwargs.keys())
        if described and self.critic_width is not None:
            raise ValueError(
                f"policy_kwargs describe the critics ({', '.join(described)}), and so does "
                f"critic_width={self.critic_width!r}: pass critic_width=None"
            )
        if "weight_decay" in (self.policy_kwargs.get("optimizer_kwargs") or {}):
            raise ValueError("weight_decay is an argument of the algorithm, not of policy_kwargs['optimizer_kwargs']")

    def _full_value_head_kwargs(self) -> dict[str, Any]:
        kwargs: dict[str, Any] = super()._full_value_head_kwargs()
        cls = VALUE_HEADS.get(self.value_head) if isinstance(self.value_head, str) else None
        is_categorical = cls is not None and issubclass(cls, CategoricalHead)
        return {"v_min": -10.0, "v_max": 10.0, **kwargs} if is_categorical else kwargs

    def _full_reward_scale_kwargs(self) -> dict[str, Any]:
        kwargs: dict[str, Any] = super()._full_reward_scale_kwargs()
        if self.reward_scale != "brc" or not is_multi_task(self.observation_space):
            return kwargs
        return {"n_tasks": int(self.observation_space["task"].n), **kwargs}  # type: ignore[index]

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs: dict[str, Any] = {
            "critic_network": "bronet",
            "actor_network": "bronet",
            **super()._full_policy_kwargs(),
        }
        if kwargs["actor_network"] == "bronet":
            kwargs["actor_network_kwargs"] = {
                "width": 256,
                "n_blocks": 1,
                **(kwargs.get("actor_network_kwargs") or {}),
            }
        if self.critic_width is not None:
            kwargs["critic_network_kwargs"] = {"width": self.critic_width, "n_blocks": 2}
        if is_multi_task(self.observation_space) and "features_extractor_class" not in kwargs:
            kwargs["features_extractor_class"] = TaskEmbedding
            kwargs["features_extractor_kwargs"] = {"size": self.embedding_size}
            kwargs["share_features_extractor"] = True
        kwargs["optimizer_kwargs"] = {**(kwargs.get("optimizer_kwargs") or {}), "weight_decay": self.weight_decay}
        return kwargs
