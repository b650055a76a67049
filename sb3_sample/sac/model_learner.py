"""Learners of the models: ``BRO.learner(...)`` makes one by itself, ``model.learner`` is the one inside a model."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim, is_image_space
from stable_baselines3.common.utils import get_device
from torch import nn

from sb3_sample import own_classes
from sb3_sample.kinds import check_value, choice_of, chosen, integer
from sb3_sample.learner.augmentation import AUGMENTATIONS
from sb3_sample.learner.categorical import VALUE_HEADS
from sb3_sample.learner.exploration import EXPLORATIONS, Exploration
from sb3_sample.learner.heads import QuantileHead, ValueHead
from sb3_sample.learner.learner import Counts, Learner
from sb3_sample.learner.objectives import Objective
from sb3_sample.learner.observation_statistics import ObservationStatistics
from sb3_sample.learner.pessimism import PESSIMISMS, Pessimism
from sb3_sample.learner.plasticity import ReDo, Resets
from sb3_sample.learner.randomness import OwnGenerators
from sb3_sample.learner.reward_scale import REWARD_SCALES, RewardScale, TaskScale
from sb3_sample.learner.scalars import FixedScalar, LogScalar, TaskLogScalar
from sb3_sample.learner.schedules import LearningRateSchedule
from sb3_sample.learner.transforms import BatchTransform
from sb3_sample.optim import AdamW
from sb3_sample.sac import checks
from sb3_sample.sac.actors import BACKBONES, Actor
from sb3_sample.sac.arguments import transform_choice
from sb3_sample.sac.critics import CriticEnsemble
from sb3_sample.sac.multi_task import number_of_tasks
from sb3_sample.sac.policies import SACPolicy

T = TypeVar("T")


class LearnerOf:
    """Descriptor: on a class, a function that makes a learner; on a model, the model's own learner."""

    def __get__(self, model: Any, cls: Any) -> Any:
        if model is None:
            return _maker(cls)
        try:
            return vars(model)["_learner"]
        except KeyError:
            raise AttributeError(f"this {cls.__name__} has no learner yet: its networks are not made") from None

    def __set__(self, model: Any, learner: Learner) -> None:
        vars(model)["_learner"] = learner


def _maker(cls: Any) -> Callable[..., Learner]:
    def learner(
        observation_space: spaces.Space,
        action_space: spaces.Box,
        seed: int = 0,
        *,
        policy: Any = None,
        device: torch.device | str = "auto",
        **arguments: Any,
    ) -> Learner:
        """
        Make a learner with the parts of this algorithm, without an environment, a replay buffer or a file.

        ``resets`` and the episodes of "top" count environment steps and do nothing unless ``on_step`` is called;
        ``reset_gradient_steps`` counts the learner's own steps. A learning rate that is a function stays at its first
        value until ``set_learning_rate``, and a ``learning_rate_schedule`` does not decay unless ``schedule_steps`` is
        given, or ``planned_updates`` set. ``compile="auto"`` compiles nothing, since the number of steps to come is
        unknown. Statistics of rewards and observations come from ``on_step`` and ``on_observations``.

        :param observation_space: observation space
        :param action_space: action space, a bounded Box; batches have actions in [-1, 1]
        :param seed: seed of the learner's own generators: initial weights, noise, acting
        :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a policy class; None: chosen by the observation
            space, "CnnPolicy" for images
        :param device: "auto", "cpu", "cuda", ...
        :param arguments: arguments of the class that say what is learned and how
        :return: the learner
        :raises ValueError: if an argument is one of training, is out of range or contradicts another
        """
        of_training = sorted(
            name for name, each in cls.constructor_arguments.items() if each.of_training and name in arguments
        )
        if of_training:
            raise ValueError(
                f"{', '.join(of_training)}: a learner takes no arguments of training; what it learns from is up to its "
                "caller"
            )
        check_action_space(action_space, "action_space")
        kinds = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Dict)
        if not isinstance(observation_space, kinds):
            names = ", ".join(kind.__name__ for kind in kinds)
            raise ValueError(f"observation_space must be a space of Gymnasium's, {names}, not {observation_space!r}")
        if policy is None:
            policy = _usual_policy(cls, observation_space)
        generators = OwnGenerators(seed, get_device(device))
        model = cls(policy, None, device=device, _init_setup_model=False, **arguments)
        model.observation_space, model.action_space, model.n_envs = observation_space, action_space, 1
        model._check_arguments()
        model._setup_lr_schedule()
        counts = Counts()
        counts.compiled = None if model.compile == "auto" else bool(model.compile)
        counts.planned_updates = model.schedule_steps
        learner: Learner = model._make_learner(counts=counts, generators=generators)
        checks.check_targets(model, learner, arguments)
        return learner

    learner.__qualname__ = f"{cls.__name__}.learner"
    return learner


def _usual_policy(cls: Any, space: spaces.Space) -> str:
    """Name of the policy for such observations, or the only one that the class has."""
    if len(cls.policy_aliases) == 1:
        return str(next(iter(cls.policy_aliases)))
    if isinstance(space, spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if is_image_space(space) else "MlpPolicy"


def check_action_space(space: spaces.Space, argument: str = "env") -> None:
    """
    Check an action space.

    :param space: action space
    :param argument: where it comes from: "env", or the argument "action_space" itself
    :raises ValueError: if it is not a Box with finite bounds, low below high
    """
    must = f"{argument} must have an action space" if argument == "env" else f"{argument} must be a space"
    if not isinstance(space, spaces.Box):
        must = "env must have a bounded Box action space" if argument == "env" else f"{argument} must be a bounded Box"
        raise ValueError(f"{must}, not {space}")
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        must = "env must have a bounded action space" if argument == "env" else f"{argument} must be bounded"
        raise ValueError(f"{must}: the bounds of {space} are not finite")
    if not (space.low < space.high).all():
        raise ValueError(f"{must} with low < high in every dimension, not {space}")


class OfLearner(Generic[T]):
    """Descriptor: an attribute of the model's learner, by the same name. It can only be read."""

    def __set_name__(self, cls: type, name: str) -> None:
        self._name = name

    def __get__(self, model: Any, cls: Any) -> T:
        return self if model is None else getattr(model.learner, self._name)  # type: ignore[return-value]

    def __set__(self, model: Any, value: Any) -> None:
        raise AttributeError(f"{self._name} cannot be set: it is the learner's")


class HasLearner:
    """A model's learner: how it is made from the arguments, and its parts as attributes of the model."""

    policy: SACPolicy
    learner = LearnerOf()
    actor = OfLearner[Actor]()
    """the actor, which acts in evaluation"""
    critic = OfLearner[CriticEnsemble]()
    """the critics"""
    critic_target = OfLearner[CriticEnsemble]()
    """the target critics"""
    temperature = OfLearner[LogScalar | FixedScalar]()
    """the entropy's weight"""
    temperature_optimizer = OfLearner[AdamW | None]()
    """optimizer of the temperature; None if it is fixed"""
    pessimism_rule = OfLearner[Pessimism]()
    """the rule of pessimism"""
    explorer = OfLearner[Exploration]()
    """explorer, which acts while training"""
    plasticity = OfLearner[Resets]()
    """resets"""
    redo = OfLearner[ReDo | None]()
    """recycling of dormant neurons; None for none"""
    objective = OfLearner[Objective]()
    """what actor and critics learn from a batch"""
    head = OfLearner[nn.Module]()
    """value head of the critics"""
    transforms = OfLearner[nn.ModuleList]()
    """batch transforms, in their order"""
    reward_scaler = OfLearner[RewardScale | None]()
    """rule by which rewards are scaled; None for none"""
    observation_statistics = OfLearner[ObservationStatistics | None]()
    """updates the observations' statistics; None without them"""
    gradients_are_stale = OfLearner[bool]()
    """whether ``.grad`` holds the gradients of a gradient step other than the last"""
    #: The class of the learner.
    learner_class: ClassVar[type[Learner]] = Learner
    #: beta1 of the temperature's Adam.
    temperature_beta1: ClassVar[float] = 0.9

    def _make_learner(self: Any, **kwargs: Any) -> Learner:
        """
        :param kwargs: networks, counts and generators of the learner
        :return: a learner with the parts and the settings of the arguments
        """
        self._take_target_entropy()
        return self.learner_class(
            self._make_networks,
            head=self._make_head(),
            make_temperature=self._make_temperature,
            make_pessimism=self.make_pessimism,
            make_explorer=self.make_explorer,
            plasticity=Resets(
                self.resets, self.reset_shrink, self.reset_gradient_steps, self.resets_keep, self.resets_to
            ),
            redo=None if self.redo_period is None else ReDo(self.redo_period, self.redo_threshold),
            make_transforms=[
                *(functools.partial(_make_transform, *each) for each in enumerate(self.batch_transforms)),
                *([] if self.augmentation is None else [self._make_augmentation]),
            ],
            make_objective=self.make_objective,
            make_reward_scaler=None if self.reward_scale is None else self.make_reward_scaler,
            learning_rate=self.lr_schedule(1),
            schedule=self._make_schedule(),
            temperature_beta1=self.temperature_beta1,
            target_entropy=self._target_entropy,
            n_tasks=self.n_tasks,
            device=self.device,
            **{name: getattr(self, name) for name in Learner.SETTINGS},
            **kwargs,
        )

    @classmethod
    def _completed(cls, content: Any, kwargs: dict[str, Any]) -> dict[str, Any]:
        """Give transforms without arguments those of the file's transform at the same place, if of the same class."""
        given, theirs = kwargs.get("batch_transforms"), content.classes_in("batch_transforms")
        if theirs is None or not isinstance(given, Sequence):
            return kwargs
        if len(given) != len(theirs):
            names = ", ".join(name for name, _ in theirs)
            raise ValueError(
                f"batch_transforms has {len(given)} entries, but the model in the file has {len(theirs)} transforms"
                f"{f' ({names})' if names else ''}: pass as many, in that order, or leave batch_transforms out"
            )
        completed = [
            (each, arguments()) if isinstance(each, type) and each.__qualname__ == name else each
            for each, (name, arguments) in zip(given, theirs, strict=True)
        ]
        return {**kwargs, "batch_transforms": completed}

    @property
    def n_tasks(self: Any) -> int:
        """Number of tasks that the observations distinguish; 1 if they contain no task."""
        return number_of_tasks(self.observation_space)

    @property
    def _width_factor(self: Any) -> int:
        """Factor on the widths of the networks: 2 with ``multitask`` and several tasks, else 1."""
        return 2 if self.multitask and self.n_tasks > 1 else 1

    @property
    def _has_entropy(self: Any) -> bool:
        """Whether the actor is a distribution."""
        return BACKBONES[self.backbone].has_entropy

    def _make_head(self: Any) -> ValueHead:
        if self.value_head is not None:
            cls = chosen("value_head", self.value_head, VALUE_HEADS, ValueHead)
            kwargs = self._full_value_head_kwargs()
            head = own_classes.make("value_head", self.value_head, cls, ValueHead, kwargs=kwargs)
            check_value(f"{cls.__name__}.n_outputs", head.n_outputs, integer(1))
            return head  # type: ignore[no-any-return]
        return ValueHead() if self.n_quantiles is None else QuantileHead(self.n_quantiles)

    def _make_networks(self: Any) -> SACPolicy:
        kwargs = self._full_policy_kwargs()
        return self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **kwargs)

    def _take_settings(self: Any) -> None:
        """Pass to the learner the settings changed since the last gradient step."""
        self._take_target_entropy()
        self.learner.set_target_entropy(self._target_entropy)
        for name in Learner.SETTINGS:
            setattr(self.learner, name, getattr(self, name))

    def _take_target_entropy(self: Any) -> None:
        """Resolve ``target_entropy``, which is then a number, or a list of numbers, one per task."""
        checks.check_target_entropy(self)
        if isinstance(self.target_entropy, np.ndarray):
            self.target_entropy = self.target_entropy.tolist()
        if self.target_entropy == "auto":
            self._target_entropy = self._auto_target_entropy(get_action_dim(self.action_space))
        elif isinstance(self.target_entropy, Sequence) and not isinstance(self.target_entropy, str):
            targets = [float(each) for each in self.target_entropy]
            self._target_entropy = targets if self.n_tasks > 1 else targets[0]
        else:
            self._target_entropy = float(self.target_entropy)
        if self._has_entropy:
            self.target_entropy = self._target_entropy

    def _auto_target_entropy(self: Any, action_dim: int) -> float:
        """
        :param action_dim: dimension of the actions
        :return: value of ``target_entropy="auto"``
        """
        return -action_dim / 2

    def _full_exploration_kwargs(self: Any) -> dict[str, Any]:
        """
        :return: the explorer's arguments: the user's and the algorithm's
        """
        kwargs = dict(self.exploration_kwargs or {})
        if self._width_factor > 1 and self.exploration == "optimistic_shift":
            return {"width_factor": self._width_factor, **kwargs}
        return kwargs

    def _full_value_head_kwargs(self: Any) -> dict[str, Any]:
        """
        :return: the value head's arguments: the user's and the algorithm's
        """
        return {**self._value_head_defaults(), **(self.value_head_kwargs or {})}

    def _value_head_defaults(self: Any) -> dict[str, Any]:
        """
        :return: the algorithm's own defaults of the value head's arguments
        """
        return {}

    def _full_reward_scale_kwargs(self: Any) -> dict[str, Any]:
        """
        :return: the arguments of the rule that scales rewards: the user's and the algorithm's
        """
        rule = choice_of(self.reward_scale, REWARD_SCALES)
        defaults = own_classes.defaults_for(rule, TaskScale, n_tasks=self.n_tasks)
        return {**defaults, **(self.reward_scale_kwargs or {})}

    def _full_pessimism_kwargs(self: Any) -> dict[str, Any]:
        """
        :return: the arguments of the rule that moves pessimism: the user's and the algorithm's
        """
        return dict(self.pessimism_kwargs or {})

    def _make_temperature(self: Any, learner: Learner) -> LogScalar | FixedScalar:
        if not learner.actor.has_entropy:
            return FixedScalar(0.0).to(self.device)
        allowed = "'auto' or 'auto_<start above 0>'"
        if isinstance(self.ent_coef, str) and self.ent_coef.startswith("auto"):
            start = self.ent_coef.removeprefix("auto").removeprefix("_") or "1"
            value = checks.as_number("ent_coef", start, allowed, shown=self.ent_coef)
            if not 0 < value < np.inf:
                raise ValueError(f"ent_coef must be at least 0 and finite, {allowed}, not {self.ent_coef!r}")
            by_task = self.task_temperatures and self.n_tasks > 1
            return (TaskLogScalar(value, self.n_tasks) if by_task else LogScalar(value)).to(self.device)
        value = checks.as_number("ent_coef", self.ent_coef, allowed)
        if not 0 <= value < np.inf:
            raise ValueError(f"ent_coef must be at least 0 and finite, {allowed}, not {self.ent_coef!r}")
        return FixedScalar(value).to(self.device)

    def make_explorer(self: Any, learner: Learner) -> Exploration:
        """
        :param learner: learner that it belongs to
        :return: a freshly initialised explorer
        """
        make = chosen("exploration", self.exploration, EXPLORATIONS, Exploration)
        kwargs = self._full_exploration_kwargs()
        return own_classes.make("exploration", self.exploration, make, Exploration, learner, kwargs=kwargs)  # type: ignore[no-any-return]

    def make_pessimism(self: Any, learner: Learner) -> Pessimism:
        """
        :param learner: learner that it belongs to
        :return: a freshly initialised rule of pessimism
        """
        if not isinstance(self.pessimism, (str, type)):
            return Pessimism(self.pessimism)
        make = chosen("pessimism", self.pessimism, PESSIMISMS, Pessimism)
        kwargs = self._full_pessimism_kwargs()
        return own_classes.make("pessimism", self.pessimism, make, Pessimism, learner, kwargs=kwargs)  # type: ignore[no-any-return]

    def make_objective(self: Any, learner: Learner) -> Objective:
        """
        :param learner: learner that it belongs to
        :return: a freshly initialised objective
        """
        return Objective()

    def make_reward_scaler(self: Any, learner: Learner) -> RewardScale:
        """
        :param learner: learner that it belongs to
        :return: a rule that scales rewards, without statistics yet
        """
        make = chosen("reward_scale", self.reward_scale, REWARD_SCALES, RewardScale)
        kwargs = self._full_reward_scale_kwargs()
        return own_classes.make("reward_scale", self.reward_scale, make, RewardScale, learner, kwargs=kwargs)  # type: ignore[no-any-return]

    def _make_schedule(self: Any) -> LearningRateSchedule | None:
        peak, start = self.lr_schedule(1), self.warm_up_learning_rate
        if self.learning_rate_schedule is None or peak == 0:
            return None
        return LearningRateSchedule(
            self.learning_rate_schedule,
            peak,
            self.final_learning_rate,
            self.warm_up_steps,
            peak if start is None else start,
        )

    def _optimizers(self: Any) -> dict[str, torch.optim.Optimizer]:
        """Every optimizer by its path from the algorithm."""
        return self.learner.optimizers()

    def _get_torch_save_params(self: Any) -> tuple[list[str], list[str]]:
        return ["policy", "temperature", *self.learner.parts_with_state(), *self._optimizers()], []

    def reinitialize(self: Any, shrink: float = 0.0, keep: Sequence[str] = (), to: str = "fresh") -> None:
        """
        Start every network, optimizer and learned number anew, in place; the replay buffer stays.

        :param shrink: share of the old parameters that stays
        :param keep: parts that stay as they are, "encoder" for an encoder that the critics share with the actors
        :param to: "fresh" for new parameters, "start" for those that the model began with
        :raises ValueError: if ``to`` is neither
        """
        self.learner.reinitialize(shrink, keep, to)

    def _make_augmentation(self: Any, learner: Learner) -> BatchTransform:
        cls, kwargs = AUGMENTATIONS[self.augmentation], self._full_augmentation_kwargs()
        return own_classes.make("augmentation", self.augmentation, cls, BatchTransform, learner, kwargs=kwargs)  # type: ignore[no-any-return]

    def _full_augmentation_kwargs(self: Any) -> dict[str, Any]:
        """
        :return: the augmentation's arguments: the user's and the algorithm's
        """
        return dict(self.augmentation_kwargs or {})


def _make_transform(index: int, choice: Any, learner: Learner) -> BatchTransform:
    cls, kwargs = transform_choice(choice)
    return own_classes.make(f"batch_transforms[{index}]", cls, cls, BatchTransform, learner, kwargs=kwargs)  # type: ignore[no-any-return]
