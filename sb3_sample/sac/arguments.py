"""Arguments of the off-policy family: their meaning and their allowed values."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.constructor import argument
from sb3_sample.kinds import (
    ABOVE_0,
    AT_LEAST_0,
    DICT,
    LEARNING_RATE,
    TRUE_OR_FALSE,
    UNIT,
    Kind,
    instance,
    integer,
    number,
    one_of,
    subclass,
)
from sb3_sample.learner.augmentation import AUGMENTATIONS
from sb3_sample.learner.categorical import VALUE_HEADS
from sb3_sample.learner.exploration import EXPLORATIONS, Exploration
from sb3_sample.learner.heads import ValueHead
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.learner.plasticity import RESETS_TO
from sb3_sample.learner.reward_scale import REWARD_SCALES, RewardScale
from sb3_sample.learner.schedules import SCHEDULES
from sb3_sample.learner.transforms import BatchTransform
from sb3_sample.replay.dataset import Dataset
from sb3_sample.sac.policies import SACPolicy
from sb3_sample.training.resumable import Resumable


def transform_choice(value: Any) -> tuple[Any, Any]:
    """
    Read an entry of ``batch_transforms``.

    :param value: a class, or a pair of a class and its arguments
    :return: the class and its arguments
    """
    return tuple(value) if isinstance(value, (tuple, list)) and len(value) == 2 else (value, {})


def _is_transform(value: Any) -> bool:
    cls, kwargs = transform_choice(value)
    return isinstance(cls, type) and issubclass(cls, BatchTransform) and isinstance(kwargs, dict)


class SACArguments(Resumable):
    """Arguments of every off-policy algorithm; those of Stable-Baselines3 come first and work by position too."""

    _policy: str | type[SACPolicy] = argument(alias="policy", kw_only=False, of_training=True)
    """"MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class"""
    _env: gym.Env[Any, Any] | VecEnv | str | None = argument(alias="env", kw_only=False, of_training=True)
    """the environment, an id, or a vectorised environment; its action space must be a bounded Box. None for a model
    that learns from data: its spaces are those of the data set, unless they are passed as arguments"""
    learning_rate: float | Schedule = argument(default=3e-4, kind=LEARNING_RATE, kw_only=False)
    """learning rate of all networks and the temperature; a number or a function of the remaining progress (from 1 to
    0)"""
    buffer_size: int = argument(default=1_000_000, kind=integer(1), kw_only=False, of_training=True)
    """capacity of the replay buffer in transitions"""
    learning_starts: int = argument(default=10_000, kind=integer(0), kw_only=False, of_training=True)
    """transitions with uniformly random actions before the first gradient step, counted over the model's life"""
    batch_size: int = argument(default=256, kind=integer(1), kw_only=False, of_training=True)
    """transitions per gradient step"""
    tau: float = argument(default=0.005, kind=number("lie in (0, 1]", lambda value: 0 < value <= 1), kw_only=False)
    """weight of the new critics in the Polyak average of the targets, in (0, 1]"""
    gamma: float = argument(default=0.99, kind=UNIT, kw_only=False)
    """discount factor"""
    _train_freq: int | tuple[int, str] | None = argument(
        alias="train_freq", default=None, kw_only=False, of_training=True
    )
    """as in Stable-Baselines3, number of steps between two trainings, or ``(n, "episode")``; if given, it and
    ``gradient_steps`` replace ``replay_ratio``"""
    _gradient_steps: int | None = argument(
        alias="gradient_steps",
        default=None,
        kind=Kind("be an integer of at least 0, or -1 for as many as transitions", integer(-1).fits),
        kw_only=False,
        of_training=True,
    )
    """as in Stable-Baselines3, gradient steps per training (-1: as many as transitions were collected); if given, it
    replaces ``replay_ratio``"""
    action_noise: ActionNoise | None = argument(
        default=None, kind=instance(ActionNoise).or_none(), kw_only=False, of_training=True
    )
    """noise added to the actions while training"""
    replay_buffer_class: type[ReplayBuffer] | None = argument(
        default=None, kind=subclass(ReplayBuffer).or_none(), kw_only=False, of_training=True
    )
    """class of the replay buffer; None: one that fits the observation space and stores one observation per step"""
    _replay_buffer_kwargs: dict[str, Any] | None = argument(
        alias="replay_buffer_kwargs", default=None, kind=DICT, kw_only=False, of_training=True
    )
    """arguments of the replay buffer; ``memory_map="folder"`` keeps the default buffer in files"""
    optimize_memory_usage: bool = argument(default=False, kw_only=False, of_training=True)
    """for a ``replay_buffer_class`` that supports it. The default buffer saves the memory anyway, handles time limits,
    and accepts either value"""
    n_steps: int = argument(default=1, kind=integer(1), kw_only=False, of_training=True)
    """n-step returns, as in Stable-Baselines3"""
    ent_coef: str | float = argument(default="auto", kw_only=False)
    """temperature: "auto" learns it from 1, "auto_0.1" from that start, a number fixes it"""
    target_update_interval: int | None = argument(default=1, kind=integer(1).or_none("policy_delay"), kw_only=False)
    """gradient steps between two updates of the targets; None: ``policy_delay``"""
    target_entropy: str | float | Sequence[float] = argument(default="auto", kw_only=False)
    """entropy that the learned temperature aims at; "auto" is -|A|/2, where |A| counts all dimensions of the action,
    including those that a task does not use. As in Stable-Baselines3, it is a number once the model is made; a new
    value takes effect at the next ``train``. With ``task_temperatures`` also a list, one for each task"""
    replay_ratio: float | None = argument(default=2, kind=AT_LEAST_0.or_none(), of_training=True)
    """gradient steps per environment transition after the warm-up, whatever the number of environments; may be below
    1. Where several tasks take a step together, per transition of each task"""
    n_quantiles: int | None = argument(default=None, kind=integer(1).or_none("scalar critics"))
    """quantiles per critic; None for scalar critics"""
    value_head: str | type[ValueHead] | None = argument(
        default=None, kind=one_of(VALUE_HEADS, ValueHead).or_none("scalars or quantiles")
    )
    """"categorical", "hl_gauss", "half_squared" (scalars, half the squared error), or a class derived from
    ``ValueHead``, instead of scalars or quantiles; requires ``n_quantiles=None``"""
    value_head_kwargs: dict[str, Any] | None = argument(default=None, kind=DICT)
    """arguments of the value head"""
    pessimism: float | str | type[Pessimism] = argument(default=1.0)
    """weight of the critics' spread that is subtracted from their mean, at least 0; 1 is the minimum of two critics, 0
    the mean. Or a rule that moves the weight: "gpl", "opl", "top", "vpl", or a class derived from ``Pessimism``"""
    pessimism_kwargs: dict[str, Any] | None = argument(default=None, kind=DICT)
    """arguments of the rule of pessimism"""
    actor_pessimism: float | None = argument(default=None)
    """weight of the spread for the actor's objective alone (REDQ and DroQ: 0); None: the same as for the target"""
    target_subset: int | None = argument(default=None)
    """number of critics, drawn at random, that make the TD target (REDQ: 2); None: all"""
    validation_proportion: float = argument(
        default=0.0, kind=number("lie in [0, 1)", lambda value: 0 <= value < 1), of_training=True
    )
    """share of the transitions that is held out of training, in [0, 1); "vpl" learns from them"""
    exploration: str | type[Exploration] = argument(default="actor", kind=one_of(EXPLORATIONS, Exploration))
    """policy that acts while training: "actor", "held_noise" (FlashSAC), "oac", "optimistic_actor" (DAC),
    "optimistic_shift" (BRO), "scheduled_noise" (DrQ-v2), or a class derived from ``Exploration``"""
    exploration_kwargs: dict[str, Any] | None = argument(default=None, kind=DICT)
    """arguments of the exploration"""
    backbone: str = argument(
        default="sac",
        kind=Kind("be one of ['sac', 'td3']", lambda value: isinstance(value, str) and value in ("sac", "td3")),
    )
    """"sac", or "td3": a deterministic actor, without entropy"""
    policy_delay: int = argument(default=1, kind=integer(1))
    """gradient steps between two updates of actors and temperature"""
    actor_at_once: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """whether the actors learn in the first of every ``policy_delay`` gradient steps instead of the last (XQC,
    FlashSAC)"""
    actor_first: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """whether actors and temperature learn before the critics in a gradient step; the TD target then uses the new actor
    and temperature (SimbaV2, FlashSAC)"""
    learning_rate_schedule: str | None = argument(
        default=None,
        kind=Kind(f"be one of {list(SCHEDULES)}", lambda value: value in SCHEDULES).or_none("no such schedule"),
    )
    """"linear" or "cosine": decay from ``learning_rate``, a number, to ``final_learning_rate`` over the planned
    gradient steps, for each optimizer by its own number of steps; the final rate thereafter. ``learning_rate=0`` stays
    0, as when the zoo loads a model to watch it"""
    final_learning_rate: float = argument(default=0.0, kind=AT_LEAST_0)
    """rate at the end of the schedule"""
    schedule_steps: int | None = argument(default=None, kind=integer(1).or_none("those of the first learn"))
    """planned gradient steps, counted from the model's first; None: environment steps of the first ``learn`` with
    gradient steps, random ones included, times the replay ratio; later calls do not change the number. A schedule given
    to ``load`` continues from the gradient steps taken, as if it had been there before"""
    warm_up_steps: int = argument(default=0, kind=integer(0))
    """planned gradient steps before the decay, in which the rate rises linearly to ``learning_rate``"""
    warm_up_learning_rate: float | None = argument(default=0.0, kind=AT_LEAST_0.or_none("learning_rate"))
    """learning rate at the start of the warm-up; None: ``learning_rate``, throughout the warm-up"""
    resets: Sequence[int] | int = argument(default=())
    """environment steps at which all parameters start anew, counted in transitions over the model's life (of each task,
    where several tasks take a step together); or an integer, the number of steps between two resets"""
    reset_gradient_steps: int | None = argument(default=None, kind=integer(1).or_none("no such resets"))
    """gradient steps of the model's life between two resets (SR-SAC's original: 2,560,000); it replaces a class's
    default ``resets`` and cannot be combined with ``resets`` that are passed. None for none"""
    reset_shrink: float = argument(default=0.0, kind=number("lie in [0, 1)", lambda value: 0 <= value < 1))
    """share of the old parameters that a reset keeps (shrink and perturb), in [0, 1)"""
    resets_keep: Sequence[str] = argument(
        default=(),
        kind=Kind(
            "be a sequence of what resets keep, of 'encoder'",
            lambda value: isinstance(value, (list, tuple)) and all(each == "encoder" for each in value),
        ),
    )
    """parts that a reset leaves as they are: ``("encoder",)`` for the features extractor that actors share with the
    critics, the targets' extractor, and their part of the optimizer (the primacy bias, Nikishin et al. 2022, from
    pixels)"""
    resets_to: str = argument(default="fresh", kind=one_of(RESETS_TO))
    """parameters after a reset: "fresh", newly drawn ones, or "start", those that the model began with, as in BRO's
    published code; if the parameters come from a file (``load``, ``set_parameters``), those that the file's model began
    with"""
    redo_period: int | None = argument(default=None, kind=integer(1).or_none("no recycling"))
    """gradient steps between two recyclings of the critics' dormant neurons (ReDo; the original: 1,000); None for
    none"""
    redo_threshold: float = argument(default=0.025, kind=number("be at least 0", lambda value: value >= 0))
    """score up to which a neuron is dormant"""
    sam_radius: float | None = argument(default=None, kind=ABOVE_0.or_none("no SAM"))
    """radius of sharpness-aware minimisation of the critics' loss (the original: 0.05); None for none"""
    batch_transforms: Sequence[Any] = argument(
        default=(),
        kind=Kind(
            "be classes derived from BatchTransform, or pairs of one and its arguments",
            lambda value: isinstance(value, Sequence) and all(map(_is_transform, value)),
        ),
    )
    """classes derived from ``BatchTransform``, or pairs of a class and its arguments, applied to every batch before it
    is learned from"""
    augmentation: str | None = argument(default=None, kind=one_of(AUGMENTATIONS).or_none("images as they are"))
    """"shift": every image of a batch is shifted by a few pixels at random (DrQ), after ``batch_transforms``. Actors,
    except those of BC and IQL, then share the critics' features extractor, unless ``policy_kwargs`` has
    ``share_features_extractor=False``"""
    augmentation_kwargs: dict[str, Any] | None = argument(default=None, kind=DICT)
    """arguments of the augmentation: ``pad``, 4 pixels, and DrQ's K and M, ``target_copies`` and ``online_copies``, 1
    each"""
    reward_scale: str | type[RewardScale] | None = argument(
        default=None, kind=one_of(REWARD_SCALES, RewardScale).or_none("rewards as they are")
    )
    """rule by which rewards are divided by a running measure of the return: "simbav2", "xqc", "flashsac", "brc", or a
    class derived from ``RewardScale``; or "linear": rewards times a factor, plus a number"""
    reward_scale_kwargs: dict[str, Any] | None = argument(default=None, kind=DICT)
    """arguments of the rule that scales rewards"""
    normalize_observations: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """whether the networks read observations minus their running mean, divided by their running standard deviation. The
    statistics belong to the policy and are updated only while training"""
    multitask: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """for observations that contain the task (``multi_task_env``), whether the networks read it as a one-hot vector and
    are all twice as wide (BRO, figure 19). False: of the usual width, with the one-hot vector, or in ``BRC`` with an
    embedding of the task"""
    task_temperatures: bool = argument(default=False, kind=TRUE_OR_FALSE)
    """whether each of several tasks has its own learned temperature"""
    use_sde: bool = argument(default=False, of_training=True)
    """not supported, refused if True"""
    sde_sample_freq: int = argument(default=-1, kind=integer(-1), of_training=True)
    """as in Stable-Baselines3, without effect if ``use_sde`` is False"""
    use_sde_at_warmup: bool = argument(default=False, of_training=True)
    """as in Stable-Baselines3, without effect if ``use_sde`` is False"""
    prior_data: Dataset | None = argument(default=None, kind=instance(Dataset).or_none(), of_training=True)
    """existing transitions, from which ``learn`` takes a share of every batch (RLPD, Ball et al. 2023). Files hold only
    a fingerprint of the data; pass the data to ``load`` too"""
    prior_share: float = argument(
        default=0.5, kind=number("lie in (0, 1)", lambda value: 0 < value < 1), of_training=True
    )
    """share of ``prior_data`` in every batch"""
    _observation_space: spaces.Space | None = argument(alias="observation_space", default=None, of_training=True)
    """observation space of a model without an environment, passed together with ``action_space``; None: the
    environment's, or the data set's"""
    _action_space: spaces.Box | None = argument(alias="action_space", default=None, of_training=True)
    """action space of a model without an environment, passed together with ``observation_space``"""
    compile: bool | str = argument(default="auto")
    """whether Inductor compiles the gradient step into one program; "auto": if that pays off within the run, on a CPU
    or a GPU with a compiler available, see docs/performance.md"""
