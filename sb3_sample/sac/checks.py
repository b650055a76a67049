"""Checks of the off-policy family's arguments: combinations, and conditions beyond the kind of a value."""

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.her import HerReplayBuffer

from sb3_sample.arguments import NotAllowed, check_every, check_unused, default_of
from sb3_sample.kinds import (
    check_value,
    choice_of,
    integer,
    one_of,
)
from sb3_sample.learner.augmentation import AUGMENTATIONS
from sb3_sample.learner.exploration import EXPLORATIONS
from sb3_sample.learner.learner import Learner
from sb3_sample.learner.pessimism import PESSIMISMS, LearnedPessimism, Pessimism, check_beta
from sb3_sample.learner.reward_scale import REWARD_SCALES, LinearScale, TaskScale
from sb3_sample.own_classes import is_derived
from sb3_sample.replay.buffers import (
    WITH_SPLIT,
    WITHOUT_SPLIT,
    DeviceReplayBuffer,
    DeviceValidationReplayBuffer,
    ValidationSplit,
)
from sb3_sample.replay.columns import HasColumns, columns_of
from sb3_sample.replay.compact import CompactReplay
from sb3_sample.replay.weighted import FadedReplay, PrioritizedReplay, WindowReplay
from sb3_sample.sac.multi_task import is_multi_task
from sb3_sample.sac.pixels import check_images, stacked_frames


def check(agent: Any) -> None:
    """
    :param agent: an algorithm whose arguments are stored and whose networks do not exist yet
    :raises ValueError: if an argument is out of range or contradicts another
    """
    if agent.augmentation in AUGMENTATIONS and hasattr(agent, "observation_space"):
        # Before the policy's check, which demands less of the images.
        check_images(f"augmentation={agent.augmentation!r}", agent.observation_space)
    check_every(agent)
    n_critics = check_value("n_critics", agent._n_critics(), integer(1))
    check_target_entropy(agent)
    check_use_sde(agent.use_sde)
    if n_critics == 1:
        _check_no_spread(agent)
    if agent.redo_period is None:
        check_unused(agent, ["redo_threshold"], "redo_period=None")
    if agent.reset_gradient_steps is not None and has_resets(agent.resets):
        raise ValueError(
            f"resets={agent.resets!r} and reset_gradient_steps={agent.reset_gradient_steps!r} are two ways to say when "
            "everything starts anew: pass one of them"
        )
    if agent.reset_gradient_steps is None and not has_resets(agent.resets):
        check_unused(agent, ["reset_shrink", "resets_to"], "no resets")
    if agent.compile not in (True, False, "auto") or not isinstance(agent.compile, (bool, str)):
        raise ValueError(f"compile must be True, False or 'auto', not {agent.compile!r}")
    if agent.value_head is None:
        check_unused(agent, ["value_head_kwargs"], "value_head=None")
    elif agent.n_quantiles is not None:
        raise ValueError(
            f"n_quantiles={agent.n_quantiles} and value_head={agent.value_head!r} are two value heads: pass "
            "value_head=None for quantiles, or n_quantiles=None"
        )
    if agent.reward_scale is None:
        check_unused(agent, ["reward_scale_kwargs"], "reward_scale=None")
    check_one_reward_scale(agent)
    shift = (agent.reward_scale_kwargs or {}).get("shift", 0)
    if is_derived(choice_of(agent.reward_scale, REWARD_SCALES), LinearScale) and shift != 0 and agent.n_steps > 1:
        raise ValueError(
            f"shift={shift} of reward_scale_kwargs would be added once to the returns of "
            f"n_steps={agent.n_steps} steps: pass n_steps=1, or no shift"
        )
    _check_schedule(agent)
    _check_tasks(agent)
    _check_augmentation(agent)
    of_policy = ["n_quantiles", "n_outputs", "backbone", "normalize_observations", "width_factor"]
    of_policy += ["n_critics"] if "n_critics" in type(agent).constructor_arguments else []
    for name in of_policy:
        if name in agent.policy_kwargs:
            raise ValueError(f"{name} is an argument of the algorithm, not of policy_kwargs")
    if agent.backbone == "td3":
        _check_no_entropy(agent, "ent_coef")
    _check_pessimism(agent)
    _check_buffer_class(agent)
    _check_replay(agent)
    _check_n_steps(agent)
    _check_memory_map(agent)
    check_device_buffer(agent, agent.get_vec_normalize_env())
    _check_train_freq(agent)
    _check_prior_data(agent)


def check_spaces(observation_space: Any, action_space: Any, env: Any) -> None:
    """
    Check the spaces passed as arguments.

    :param observation_space: the argument
    :param action_space: the argument
    :param env: the environment, if there is one
    :raises ValueError: if only one of them is there, or they are no spaces, or not the environment's
    """
    given = {"observation_space": observation_space, "action_space": action_space}
    if len({value is None for value in given.values()}) > 1:
        missing = next(name for name, value in given.items() if value is None)
        raise ValueError(f"observation_space and action_space belong together: pass {missing}= too")
    for name, value in given.items():
        if value is not None and not isinstance(value, spaces.Space):
            raise ValueError(f"{name} must be a space of Gymnasium's, or None, not {value!r}")
        if value is not None and env is not None and value != getattr(env, name):
            raise ValueError(f"{name} must be the environment's, {getattr(env, name)}, not {value}: leave it out")


def check_dataset(name: str, dataset: Any, observation_space: Any, action_space: Any) -> None:
    """
    Check that a data set fits a model.

    :param name: the argument
    :param dataset: the data set
    :param observation_space: the model's
    :param action_space: the model's
    :raises ValueError: if its observations or actions are others
    """
    for key, part in _parts(dataset.observation_space).items():
        if is_image_space(part) and part.shape[2] < min(part.shape[:2]):
            raise ValueError(
                f"{name} must have images in {_named(key)} with their channels first, as Stable-Baselines3 turns those "
                f"of environments, not of shape {part.shape}: pass numpy.moveaxis(images, -1, 1) where it is made"
            )
    ours, theirs = _shapes(observation_space), _shapes(dataset.observation_space)
    if ours != theirs:
        raise ValueError(f"{name} must have observations of the model's shape, {ours}, not {theirs}")
    for key, part in _parts(observation_space).items():
        other = _parts(dataset.observation_space)[key]
        if not _means_alike(part, other):
            raise ValueError(
                f"{name} must have {_named(key)} that mean the same numbers as the model's {part}, not {other}: pass "
                "observation_space= where the data set is made, with pictures of its range"
            )
    own, other = action_space, dataset.action_space
    same = own.shape == other.shape and np.allclose([own.low, own.high], [other.low, other.high])
    if not same:
        raise ValueError(
            f"{name} must have actions in the units of the model, {own}, not {other}: pass action_space= where the "
            "data set is made"
        )


def check_offline(agent: Any) -> None:
    """
    Check that an algorithm can learn from a data set alone.

    :param agent: the algorithm
    :raises ValueError: if it asks for steps of an environment, or for returns of several steps
    """
    if agent.n_steps > 1:
        raise ValueError(
            f"n_steps={agent.n_steps} asks for returns of several steps, and a data set has transitions of one: pass "
            "n_steps=1"
        )
    _check_statistics(agent.get_vec_normalize_env())
    scaler = agent.learner.reward_scaler
    if scaler is not None and scaler.needs_steps:
        raise ValueError(
            f"reward_scale={agent.reward_scale!r} divides by a measure of returns in an environment, and learn_offline "
            "takes no steps there: pass reward_scale=None, or 'linear' for rewards of a size that suits the critics"
        )


def _check_statistics(normalize: Any) -> None:
    """Check that a ``VecNormalize``, if any, has statistics to normalise a data set by."""
    if normalize is None:
        return
    counts = []
    if normalize.norm_obs:
        of_parts = normalize.obs_rms.values() if isinstance(normalize.obs_rms, dict) else [normalize.obs_rms]
        # A reset has counted one observation of each environment.
        counts += [of_part.count - normalize.num_envs for of_part in of_parts]
    if normalize.norm_reward:
        counts.append(normalize.ret_rms.count)
    if any(count < 1 for count in counts):
        raise ValueError(
            "env: VecNormalize has no statistics yet, and learn_offline takes no steps that would give it some: load "
            "saved ones (load_vec_normalize), or pass normalize_observations=True and a reward_scale of 'linear' in "
            "its place"
        )


def check_prior_of(value: Any) -> None:
    """
    Check a file's record of prior data.

    :param value: the record
    :raises ValueError: if it is something else
    """
    kinds = {"fingerprint": str, "size": int}
    if not isinstance(value, dict) or {name: type(each) for name, each in value.items()} != kinds:
        raise ValueError(f"_prior_of cannot be {value!r:.100}")


def prior_words(prior_of: dict[str, Any]) -> str:
    """
    :param prior_of: a file's record of prior data
    :return: the record in words
    """
    return f"{prior_of['size']:,} transitions of prior data, sha256 {prior_of['fingerprint'][:16]}"


def _shapes(space: Any) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: part.shape for key, part in sorted(space.spaces.items())}
    return space.shape


def _parts(space: Any) -> dict[str, Any]:
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {"": space}


def _named(key: str) -> str:
    """Name of a part of the observations, for errors."""
    return f"observations[{key!r}]" if key else "observations"


def _means_alike(ours: Any, theirs: Any) -> bool:
    """Whether numbers of the same shape have the same meaning: equally many classes, or pictures of the same range."""
    if not (isinstance(ours, spaces.Box) and isinstance(theirs, spaces.Box)):
        return bool(ours == theirs)
    return len(ours.shape) != 3 or np.dtype(ours.dtype).kind == np.dtype(theirs.dtype).kind


def _check_prior_data(agent: Any) -> None:
    """Check that batches can have their share of the prior data."""
    if agent._prior_of is not None:
        check_prior_of(agent._prior_of)
    if agent.prior_data is None:
        if agent._prior_of is None:
            check_unused(agent, ["prior_share"], "prior_data=None")
        return
    check_dataset("prior_data", agent.prior_data, agent.observation_space, agent.action_space)
    if not 0 < round(agent.prior_share * agent.batch_size) < agent.batch_size:
        raise ValueError(
            f"prior_share={agent.prior_share} of batch_size={agent.batch_size} leaves no transition of one of the two "
            "sources: pass a larger batch_size or another share"
        )
    cls = agent.replay_buffer_class
    if cls is not None and issubclass(cls, PrioritizedReplay):
        raise ValueError(
            f"prior_data have no priorities, by which replay_buffer_class={cls.__name__} draws: leave one of them out"
        )
    if cls is not None and issubclass(cls, NStepReplayBuffer):
        raise ValueError(
            f"prior_data has transitions of one step, which replay_buffer_class={cls.__name__} would mix with returns "
            "of several: leave one of them out"
        )
    columns = sorted(name for name, column in columns_of(cls).items() if column.in_batch)
    ours, theirs = sorted(set(columns) - set(columns_of(None))), agent.prior_data.column_names
    if ours != theirs:
        of_buffer = "the replay buffer" if cls is None else f"replay_buffer_class={cls.__name__}"
        raise ValueError(
            f"prior_data must have the further columns of {of_buffer}, {ours or 'none'}, not {theirs or 'none'}: all "
            "transitions of a batch have the same"
        )
    if agent.n_steps > 1:
        raise ValueError(
            f"prior_data has transitions of one step, which n_steps={agent.n_steps} would mix with returns of several: "
            "pass n_steps=1"
        )


def check_one_reward_scale(agent: Any) -> None:
    """
    Check that rewards are scaled only once.

    :param agent: an algorithm
    :raises ValueError: if its environment scales them too
    """
    normalize = agent.get_vec_normalize_env()
    if agent.reward_scale is not None and normalize is not None and normalize.norm_reward:
        raise ValueError(
            f"reward_scale={agent.reward_scale!r} scales rewards, and so does the VecNormalize of env: pass it "
            "norm_reward=False, or the model reward_scale=None"
        )


def check_scale_is_known(agent: Any) -> None:
    """
    Check that rewards can be scaled.

    :param agent: an algorithm that is about to learn
    :raises ValueError: if their scale is to follow from a data set that there has not been
    """
    scaler = agent.learner.reward_scaler
    if isinstance(scaler, LinearScale) and scaler.waits_for_data:
        raise ValueError(
            f"return_range={scaler.return_range} of reward_scale_kwargs is that of a data set: call learn_offline "
            "first, or pass prior_data=, or factor in its place"
        )


def plain_rate(learning_rate: Any) -> Any:
    """
    :param learning_rate: the argument
    :return: the number, if it is one in the form in which the zoo passes it on; else the argument
    """
    return learning_rate.val if isinstance(learning_rate, ConstantSchedule) else learning_rate


def _check_schedule(agent: Any) -> None:
    """Check that a schedule over planned gradient steps goes with the learning rate."""
    if agent.learning_rate_schedule is None:
        names = ["final_learning_rate", "schedule_steps", "warm_up_steps", "warm_up_learning_rate"]
        check_unused(agent, names, "learning_rate_schedule=None")
        return
    agent.learning_rate = plain_rate(agent.learning_rate)
    if callable(agent.learning_rate):
        raise ValueError(
            "learning_rate, a function, is a schedule, and so is "
            f"learning_rate_schedule={agent.learning_rate_schedule!r}: pass a number, or learning_rate_schedule=None"
        )
    if 0 < agent.learning_rate < agent.final_learning_rate:
        raise ValueError(
            f"final_learning_rate={agent.final_learning_rate} lies above learning_rate={agent.learning_rate}, from "
            f"which learning_rate_schedule={agent.learning_rate_schedule!r} decays: pass final_learning_rate= too, at "
            "most learning_rate, or learning_rate_schedule=None for none"
        )
    if agent.schedule_steps is not None and agent.schedule_steps <= agent.warm_up_steps:
        raise ValueError(
            f"schedule_steps={agent.schedule_steps} must exceed warm_up_steps={agent.warm_up_steps}, which are part of "
            "them"
        )
    if agent.warm_up_steps == 0:
        check_unused(agent, ["warm_up_learning_rate"], "warm_up_steps=0")


def _check_tasks(agent: Any) -> None:
    """Check that the arguments about tasks go with the observations and the temperature."""
    for name in ("multitask", "task_temperatures"):
        if getattr(agent, name) and not is_multi_task(agent.observation_space):
            raise ValueError(
                f"{name}=True needs observations that tell the task, as those of multi_task_env do, not "
                f"{agent.observation_space}: leave it out"
            )
    if agent.n_tasks > 1 and agent.observation_space["task"].start != 0:
        # Both look up a task's values by its number.
        for name, value, by_task in (
            ("task_temperatures", agent.task_temperatures, agent.task_temperatures),
            ("reward_scale", agent.reward_scale, is_derived(choice_of(agent.reward_scale, REWARD_SCALES), TaskScale)),
        ):
            if by_task:
                raise ValueError(
                    f"{name}={value!r} needs tasks that count from 0, not {agent.observation_space['task']}: have the "
                    "environment give them so"
                )
    if not agent.task_temperatures:
        return
    if agent.backbone == "td3":
        raise ValueError(
            "task_temperatures=True asks for an entropy, which a deterministic actor (backbone='td3') has not: leave "
            "it out"
        )
    if not (isinstance(agent.ent_coef, str) and agent.ent_coef.startswith("auto")):
        raise ValueError(
            f"task_temperatures=True learns a temperature for each task, and ent_coef={agent.ent_coef!r} fixes one for "
            "all: pass ent_coef='auto' or 'auto_<start>'"
        )


def _check_augmentation(agent: Any) -> None:
    """Check that arguments of the augmentation have one, and that ``resets_keep`` has resets and a shared encoder."""
    if agent.augmentation is None:
        check_unused(agent, ["augmentation_kwargs"], "augmentation=None")
    if not agent.resets_keep:
        return
    if agent.reset_gradient_steps is None and not has_resets(agent.resets):
        check_unused(agent, ["resets_keep"], "no resets")
    if not agent._full_policy_kwargs().get("share_features_extractor", False):
        raise ValueError(
            f"resets_keep={agent.resets_keep!r} keeps one encoder that actors share with the critics: pass "
            "policy_kwargs=dict(share_features_extractor=True), or augmentation='shift' for images"
        )


def has_resets(resets: Any) -> bool:
    """
    :param resets: the argument of that name, checked or not
    :return: whether it asks for a reset: it is not an empty sequence
    """
    return not (isinstance(resets, (Sequence, np.ndarray)) and len(resets) == 0)


def check_target_entropy(agent: Any) -> None:
    """
    :param agent: an algorithm
    :raises ValueError: if its ``target_entropy`` is neither finite nor "auto", or a number where there is no entropy
    """
    if agent.backbone == "td3":
        _check_no_entropy(agent, "target_entropy")
    value = agent.target_entropy.tolist() if isinstance(agent.target_entropy, np.ndarray) else agent.target_entropy
    if isinstance(value, Sequence) and not isinstance(value, str):
        n_tasks = agent.n_tasks
        if not agent.task_temperatures or len(value) != n_tasks:
            raise ValueError(
                f"target_entropy must be a number, or 'auto', or with task_temperatures=True one for each of the "
                f"{n_tasks} tasks, not {value!r} with task_temperatures={agent.task_temperatures}"
            )
        for each in value:
            if not math.isfinite(as_number("target_entropy of a task", each, "a finite one")):
                raise ValueError(f"target_entropy of a task must be finite, not {each}")
        return
    if value != "auto" and not math.isfinite(as_number("target_entropy", value, "'auto'")):
        raise ValueError(f"target_entropy must be finite, or 'auto', not {value}")


def check_use_sde(use_sde: bool) -> None:
    """
    :param use_sde: the argument
    :raises ValueError: if it is asked for
    """
    if use_sde:
        raise ValueError(
            "use_sde=True is not supported by this family of algorithms: use action_noise, "
            f"or exploration=, one of {sorted(EXPLORATIONS)}"
        )


def _check_no_entropy(agent: Any, name: str) -> None:
    value = getattr(agent, name)
    if not (isinstance(value, str) and value == "auto"):
        raise ValueError(
            f"{name}={value!r} asks for an entropy, which a deterministic actor (backbone='td3') has "
            f"not: leave {name} out"
        )


def _check_no_spread(agent: Any) -> None:
    """Refuse arguments that weigh the spread of several critics; numbers only if they differ from the class's."""
    weighs = [f"exploration={agent.exploration!r}"] if agent.exploration == "oac" else []
    for name in "pessimism", "actor_pessimism":
        value = getattr(agent, name)
        if isinstance(value, (str, type)) or value not in (None, 0, default_of(type(agent), name)):
            weighs.append(f"{name}={value!r}")
    if weighs:
        instead = "another exploration" if len(weighs) == 1 and agent.exploration == "oac" else "a pessimism of 0"
        raise ValueError(
            f"{weighs[-1]} weighs the critics' spread, which n_critics=1 has not: pass n_critics=2, or {instead}"
        )


def _check_pessimism(agent: Any) -> None:
    if isinstance(agent.pessimism, (str, type)):
        kind = one_of(PESSIMISMS, Pessimism)
        if not kind.fits(agent.pessimism):
            raise ValueError(
                f"pessimism must be a number, or {kind.words.removeprefix('be ')}, not {agent.pessimism!r}"
            )
    elif isinstance(agent.pessimism, Pessimism):
        raise ValueError(
            f"pessimism must be a number, a name or a class, not an object of {type(agent.pessimism).__name__}: pass "
            "the class, and its arguments as pessimism_kwargs"
        )
    else:
        check_beta("pessimism", agent.pessimism)
        if agent.pessimism_kwargs:
            raise ValueError(
                f"pessimism_kwargs={agent.pessimism_kwargs} are arguments of a rule that moves pessimism, but "
                f"pessimism={agent.pessimism} is fixed: pass pessimism as one of {sorted(PESSIMISMS)}, or as "
                "a class derived from Pessimism"
            )
    if agent.actor_pessimism is not None:
        check_beta("actor_pessimism", agent.actor_pessimism)
    if agent.target_subset == 1 and isinstance(agent.pessimism, (str, type)):
        raise ValueError(
            f"pessimism={agent.pessimism!r} weighs the spread of the targets, and target_subset=1 leaves none"
        )
    if agent.target_subset is not None:
        n_critics = agent._n_critics()
        if not integer(1, n_critics).fits(agent.target_subset):
            raise ValueError(
                f"target_subset must lie between 1 and the number of critics, {n_critics} "
                f"(n_critics), or be None for all, not {agent.target_subset!r}"
            )


def _check_buffer_class(agent: Any) -> None:
    """Check that the buffer can hold the observations."""
    cls, space = agent.replay_buffer_class, agent.observation_space
    is_dict = isinstance(space, spaces.Dict)
    if cls is None:
        if agent.n_steps > 1 and is_dict:
            raise NotAllowed(f"n_steps={agent.n_steps} is not supported with Dict observation spaces: pass n_steps=1")
        return
    if issubclass(cls, DictReplayBuffer) and not is_dict:
        raise ValueError(
            f"replay_buffer_class={cls.__name__} needs a Dict observation space, not {space}: leave it out"
        )
    if is_dict and (cls is ReplayBuffer or issubclass(cls, (DeviceReplayBuffer, NStepReplayBuffer))):
        raise ValueError(f"replay_buffer_class={cls.__name__} cannot hold the observations of {space}: leave it out")
    goals = {"observation", "achieved_goal", "desired_goal"}
    if issubclass(cls, HerReplayBuffer) and isinstance(space, spaces.Dict) and not goals <= space.spaces.keys():
        raise ValueError(
            f"replay_buffer_class={cls.__name__} needs an observation space with {sorted(goals)}, not {space}"
        )


def _check_replay(agent: Any) -> None:
    cls, kwargs = agent.replay_buffer_class, agent.replay_buffer_kwargs or {}
    if kwargs.get("validation_proportion", agent.validation_proportion) != agent.validation_proportion:
        check_once("replay_buffer_kwargs", kwargs, {"validation_proportion": "validation_proportion"})
    if agent.validation_proportion > 0 and cls is not None and issubclass(cls, (FadedReplay, PrioritizedReplay)):
        raise ValueError(
            f"validation_proportion={agent.validation_proportion} holds transitions out of uniform draws, which "
            f"replay_buffer_class={cls.__name__} does not make: leave one of them out"
        )
    if cls is not None and issubclass(cls, HasColumns) and cls not in (*WITHOUT_SPLIT, *WITH_SPLIT):
        # A class derived from one of these, in whose place no other is taken.
        is_split = issubclass(cls, ValidationSplit)
        if is_split != (agent.validation_proportion > 0):
            base, which = ("CompactReplayBuffer", "is") if is_split else ("ValidationReplayBuffer", "is not")
            raise ValueError(
                f"validation_proportion={agent.validation_proportion}, but replay_buffer_class={cls.__name__} {which} "
                f"one that holds transitions out: derive it from {base}, or its variant for dicts or devices"
            )
    if agent.validation_proportion > 0:
        known = (ReplayBuffer, DictReplayBuffer, DeviceReplayBuffer)
        ours = (CompactReplay, DeviceValidationReplayBuffer)
        if cls is not None and cls not in known and not issubclass(cls, ours):
            raise ValueError(
                f"validation_proportion={agent.validation_proportion} holds single transitions out, which is known of "
                f"ReplayBuffer, DictReplayBuffer and DeviceReplayBuffer only, not of {cls.__name__} (samples of "
                "several transitions, as relabelled goals are, would carry them into training): leave "
                "replay_buffer_class out, or pass validation_proportion=0"
            )
        if agent.n_steps > 1:
            raise ValueError(
                f"validation_proportion={agent.validation_proportion} holds single transitions out, which "
                f"n_steps={agent.n_steps} would carry into training: pass n_steps=1, or validation_proportion=0"
            )


def _check_memory_map(agent: Any) -> None:
    """Check a buffer in files, which only this package's buffers support."""
    cls, is_split = agent.replay_buffer_class, agent.validation_proportion > 0
    stacks = "frame_stack" in (agent.replay_buffer_kwargs or {})
    stacks = stacks or stacked_frames(agent.env, agent.observation_space) is not None
    on_device = cls is not None and issubclass(cls, DeviceReplayBuffer)
    made_by_us = (is_split and not on_device) or (
        agent.n_steps == 1 or stacks if cls is None else issubclass(cls, CompactReplay)
    )
    if (agent.replay_buffer_kwargs or {}).get("memory_map") is not None and not made_by_us:
        what = f"n_steps={agent.n_steps}" if cls is None else f"replay_buffer_class={cls.__name__}"
        raise ValueError(
            f"replay_buffer_kwargs: memory_map is known to CompactReplayBuffer, the default, and not to the buffer of "
            f"{what}: leave one of them out"
        )


def check_device_buffer(agent: Any, normalization: Any) -> None:
    """
    Check that a replay buffer on the device goes with the environment.

    :param agent: an algorithm
    :param normalization: the environment's ``VecNormalize``; None for none
    :raises ValueError: if it does not, or with another argument
    """
    cls = agent.replay_buffer_class
    if cls is None or not issubclass(cls, DeviceReplayBuffer):
        return
    if normalization is not None:
        raise ValueError(
            "replay_buffer_class=DeviceReplayBuffer cannot be combined with VecNormalize, which normalises on the "
            "host: leave replay_buffer_class out"
        )
    if agent.optimize_memory_usage:
        raise ValueError("replay_buffer_class=DeviceReplayBuffer cannot be combined with optimize_memory_usage=True")


def _check_n_steps(agent: Any) -> None:
    cls = agent.replay_buffer_class
    makes_returns = (NStepReplayBuffer, WindowReplay) if agent.draws_windows else NStepReplayBuffer
    if agent.n_steps > 1 and cls is not None and not issubclass(cls, makes_returns):
        raise ValueError(
            f"n_steps={agent.n_steps} needs a buffer that makes n-step returns, NStepReplayBuffer, not "
            f"replay_buffer_class={cls.__name__}: leave replay_buffer_class out"
        )


def _check_train_freq(agent: Any) -> None:
    train_freq: Any = agent.train_freq
    if not isinstance(train_freq, TrainFreq):
        every, unit = train_freq if isinstance(train_freq, tuple) else (train_freq, "step")
        if not isinstance(every, int) or every < 1 or unit not in ("step", "episode"):
            raise ValueError(f"train_freq must be at least 1, or (n, 'step' or 'episode'), not {train_freq!r}")
        if unit == "episode" and agent.env is not None and agent.n_envs > 1:
            raise ValueError(
                f"train_freq={train_freq!r} counts episodes, which needs one environment, not {agent.n_envs}"
            )


def check_sampling(agent: Any, buffer: Any) -> None:
    """
    :param agent: an algorithm with its learner
    :param buffer: a replay buffer
    :raises ValueError: if the gradient step is to draw its batches of the buffer itself, and cannot
    """
    if not (isinstance(buffer, DeviceReplayBuffer) and buffer.sampling == "device"):
        return
    reason = agent.learner.why_no_drawn_steps()
    if agent.prior_data is not None:
        reason = "a share of each batch is of prior_data"
    if reason is not None:
        raise ValueError(
            f"replay_buffer_kwargs: sampling='device' has the gradient step draw its batch itself, but {reason}: pass "
            "sampling='host'"
        )


def check_targets(agent: Any, learner: Learner, passed: Collection[str]) -> None:
    """
    :param agent: an algorithm
    :param learner: its learner
    :param passed: names of the arguments that were passed; files may hold others, which nothing reads
    :raises ValueError: if they say how targets follow, and there are none
    """
    if learner.has_critic_targets:
        return
    unused = ["target_update_interval", *(["tau"] if learner.networks.actor_target is None else [])]
    check_unused(agent, [name for name in unused if name in passed], "critics without target networks")


def check_rule(agent: Any) -> None:
    """
    :param agent: an algorithm with its rule of pessimism
    :raises ValueError: if the transitions that the rule learns from are none that the algorithm has
    """
    rule = agent.pessimism_rule
    if not isinstance(rule, LearnedPessimism):
        return
    source, segment_length = rule.source, rule.segment_length
    if source in ("recent", "on_policy") and segment_length > max(agent.buffer_size // agent.n_envs, 1):
        raise ValueError(
            f"segment_length={segment_length} is more than a replay buffer of buffer_size={agent.buffer_size} "
            f"holds of each of {agent.n_envs} environments"
        )
    if source == "validation" and agent.validation_proportion == 0:
        raise ValueError(
            "pessimism='vpl' learns from transitions held out, and validation_proportion=0 holds none out: "
            "pass validation_proportion=1/32, or another source of its transitions"
        )
    if source == "on_policy":
        if agent.exploration != "actor":
            raise ValueError(
                f"the segments of pessimism='opl' must be on-policy, but exploration={agent.exploration!r}: "
                "it goes with exploration='actor' only"
            )
        if agent.action_noise is not None:
            raise ValueError("the segments of pessimism='opl' must be on-policy: leave action_noise out")


def check_weight_decay(agent: Any) -> None:
    """
    :param agent: an algorithm with an argument ``weight_decay`` for all networks
    :raises ValueError: if the policy's arguments have one too
    """
    if "weight_decay" in (agent.policy_kwargs.get("optimizer_kwargs") or {}):
        raise ValueError("weight_decay is an argument of the algorithm, not of policy_kwargs['optimizer_kwargs']")


def check_critics_described_once(agent: Any, name: str) -> None:
    """
    :param agent: an algorithm
    :param name: its argument that describes the critics, unless it is None
    :raises ValueError: if the policy's arguments describe them too
    """
    described = sorted({"critic_network", "critic_network_kwargs"} & agent.policy_kwargs.keys())
    value = getattr(agent, name)
    if described and value is not None:
        raise ValueError(
            f"policy_kwargs describe the critics ({', '.join(described)}), and so does {name}={value!r}: pass "
            f"{name}=None"
        )


def check_once(kwargs_name: str, kwargs: dict[str, Any] | None, arguments: dict[str, str]) -> None:
    """
    :param kwargs_name: name of an argument that is a dict
    :param kwargs: its value
    :param arguments: for each key of the dict, the argument of the class that is the same setting
    :raises ValueError: if the dict has such a key
    """
    for key in kwargs or {}:
        if key in arguments:
            raise ValueError(f"{kwargs_name} has {key!r}, which is the argument {arguments[key]} here: pass that")


def as_number(name: str, value: Any, otherwise: str, shown: Any = None) -> float:
    """
    :param name: name of an argument
    :param value: its value
    :param otherwise: what else is allowed, for the error
    :param shown: the value as the error shows it, if different
    :return: the value as a number
    :raises ValueError: if it is not one
    """
    try:
        return float(value)
    except (TypeError, ValueError):
        shown = value if shown is None else shown
        raise ValueError(f"{name} must be a number, or {otherwise}, not {shown!r}") from None
