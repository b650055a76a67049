"""BRC, for one task and for several."""

from typing import Any, ClassVar

from sb3_sample.arguments import check_unused
from sb3_sample.constructor import argument
from sb3_sample.kinds import AT_LEAST_0, choice_of, integer
from sb3_sample.learner.categorical import VALUE_HEADS, CategoricalHead
from sb3_sample.learner.heads import ValueHead
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.learner.reward_scale import RewardScale
from sb3_sample.own_classes import defaults_for
from sb3_sample.sac import checks
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.multi_task import TaskEmbedding
from sb3_sample.sac.policy_kwargs import with_weight_decay
from sb3_sample.warn import warn

#: Width of the critics from which on a CPU takes seconds a gradient step.
TOO_WIDE = 2048


class BRC(SAC):
    """
    BRC: bigger, regularized, categorical (Nauman et al. 2025, https://arxiv.org/abs/2505.23150).

    BroNet critics, far wider than BRO's, as classifiers over 101 atoms in [-10, 10]; the mean of their probabilities in
    target and actor; rewards divided by a measure of the returns of finished episodes; weight decay; no resets and no
    optimism.

    With observations that contain the task (``multi_task_env``), critics and actor read a learned embedding of the task
    beside the observation, and rewards are scaled per task. The embeddings belong to the critics, which learn them; the
    actor reads them without gradient. All tasks share one target entropy and one temperature, unless
    ``task_temperatures``. The published batch size is then 1,024. With ``multitask=True`` the task is a one-hot vector,
    as in BRO, instead of an embedding.

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
        checks.check_critics_described_once(self, "critic_width")
        checks.check_weight_decay(self)
        if self.device.type == "cpu" and (self.critic_width or 0) >= TOO_WIDE:
            warn(
                f"Critics {self.critic_width:,} wide (critic_width) are for a GPU: on a CPU a gradient step takes "
                "seconds, and making the model up to minutes. critic_width=512 is for CPUs"
            )
        if self.multitask:
            check_unused(self, ["embedding_size"], "multitask=True")
        elif "features_extractor_class" in self.policy_kwargs:
            check_unused(self, ["embedding_size"], "policy_kwargs['features_extractor_class']")
        elif self.n_tasks > 1:
            given = self.policy_kwargs.get("features_extractor_kwargs")
            checks.check_once("policy_kwargs['features_extractor_kwargs']", given, {"size": "embedding_size"})
            shares = self.policy_kwargs.get("share_features_extractor", True)
            if not shares:
                raise ValueError(
                    f"share_features_extractor={shares!r} in policy_kwargs gives the actor an encoder of its own, and "
                    "the embeddings of the tasks are the critics': leave it out, or pass a features_extractor_class"
                )

    def _value_head_defaults(self) -> dict[str, Any]:
        return defaults_for(choice_of(self.value_head, VALUE_HEADS), CategoricalHead, v_min=-10.0, v_max=10.0)

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
        if self.n_tasks > 1 and not self.multitask and "features_extractor_class" not in kwargs:
            kwargs["features_extractor_class"] = TaskEmbedding
            of_extractor = kwargs.get("features_extractor_kwargs") or {}
            kwargs["features_extractor_kwargs"] = {**of_extractor, "size": self.embedding_size}
            kwargs["share_features_extractor"] = True
        return with_weight_decay(kwargs, self.weight_decay)
