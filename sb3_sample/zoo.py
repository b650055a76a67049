"""
The algorithms of this package in the commands of the RL Zoo (``rl_zoo3``).

A new algorithm is one entry of ``ALGORITHMS`` and one file ``hyperparams/<name>.yml``.

How the zoo searches: its sampler suggests a trial's parameters and turns them into constructor arguments, Optuna stores
what was suggested, and ``--trial-id`` sends the stored parameters through the converter. Here both decode with
``decode``, so that a stored trial gives the arguments it was run with.
"""

import functools
import importlib
import inspect
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sb3_sample.extras import install

try:
    import optuna
    import rl_zoo3.hyperparams_opt
    import rl_zoo3.utils
except ModuleNotFoundError as error:
    raise ImportError(f"The zoo's commands need rl_zoo3 ({error}). Install it with: {install('zoo')}") from error
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sample import zoo_files, zoo_trials
from sb3_sample.ppo import MBMAPPO, MBPOPPO, QMAPPO
from sb3_sample.sac import BRO, BROTD3, DAC, GPLSAC, OAC, OPLSAC, SAC, SRSAC, TOPSAC, VPLSAC, BROFast, RegularizedSAC
from sb3_sample.sac.regularized_sac import (
    CRITIC_REGULARIZATIONS,
    NETWORK_REGULARIZATIONS,
    PLASTICITY_REGULARIZATIONS,
)
from sb3_sample.saving.untrusted import BadFile

#: The files ``<algorithm>.yml``, read when ``--conf-file`` is not given.
HYPERPARAMS = Path(__file__).parent / "hyperparams"

#: Environments whose ``info`` has ``is_success`` at every step.
SUCCESS_PREFIXES = ("metaworld/", "myosuite/")

#: Suggests a value for the parameter of that name.
Suggest = Callable[[optuna.Trial, str], Any]
#: A search space: parameters, by the name under which Optuna stores them.
Space = Mapping[str, Suggest]
#: (trial, number of actions, number of environments, what the zoo knows of the replay buffer) to arguments.
Sampler = Callable[[optuna.Trial, int, int, dict[str, Any]], dict[str, Any]]
#: A stored trial's parameters to arguments.
Converter = Callable[[dict[str, Any]], dict[str, Any]]


def _float(low: float, high: float, log: bool = False) -> Suggest:
    return lambda trial, name: trial.suggest_float(name, low, high, log=log)


def _int(low: int, high: int, log: bool = False) -> Suggest:
    return lambda trial, name: trial.suggest_int(name, low, high, log=log)


def _choice(*options: Any) -> Suggest:
    return lambda trial, name: trial.suggest_categorical(name, options)


def _mixture(*group: str) -> Suggest:
    """None or any members of a group: "none", "a", "a+b" and so on, since Optuna stores no lists."""
    members = [member for member in group if member != "none"]
    mixtures = ["+".join(mixture) for n in range(1, len(members) + 1) for mixture in itertools.combinations(members, n)]
    return _choice("none", *mixtures)


# ---------------------------------------------------------------- search spaces
# ``one_minus_<x>`` and ``<x>_pow`` are 1 - x and log2(x): the scales on which a change by the same amount means as much
# anywhere in the range. The ranges contain the defaults of the classes.

#: With ``HerReplayBuffer``, in addition.
HER_SPACE: Space = {
    "n_sampled_goal": _int(1, 5),
    "goal_selection_strategy": _choice("final", "episode", "future"),
}
#: What every off-policy algorithm has.
OFF_POLICY_SPACE: Space = {
    "learning_rate": _float(1e-5, 2e-3, log=True),
    "one_minus_gamma": _float(1e-4, 0.03, log=True),
    "batch_size_pow": _int(5, 10),
    "tau": _float(1e-3, 0.08, log=True),
}
#: BRO's own, but for the replay ratio. The largest model is left out: a trial of it takes as long as several others.
BRO_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "model_size": _choice("0.55M", "1.05M", "2.83M", "4.92M"),
    "pessimism": _float(0.0, 1.0),
    "kl_target": _float(0.01, 0.5, log=True),
    "std_multiplier": _float(0.5, 1.0),
    "weight_decay": _float(1e-5, 1e-2, log=True),
}
#: With TD3 the noise has numbers of its own, so that no multiplier is needed.
BRO_TD3_SPACE: Space = {
    **{name: suggest for name, suggest in BRO_SPACE.items() if name != "std_multiplier"},
    "exploration_noise": _float(0.03, 0.4, log=True),
    "target_noise": _float(0.05, 0.5, log=True),
    "policy_delay": _int(1, 4),
    "replay_ratio": _int(1, 16, log=True),
}
# The replay ratio and the resets of the agents below are a regime that the papers compare them in: not searched, so
# that a search stays in the one that it was started in.
SAC_SPACE: Space = {**OFF_POLICY_SPACE, "pessimism": _float(0.0, 1.0)}
#: Replay ratio and resets are what makes this agent.
SR_SAC_SPACE: Space = {
    **SAC_SPACE,
    "replay_ratio": _int(4, 32, log=True),
    "resets": _int(10_000, 320_000, log=True),
}
DAC_SPACE: Space = {
    **SAC_SPACE,
    "kl_target": _float(0.05, 2.0, log=True),
    "std_multiplier": _float(0.75, 2.0),
}
OAC_SPACE: Space = {
    **SAC_SPACE,
    "optimism": _float(0.5, 10.0, log=True),
    "kl_radius": _float(0.1, 20.0, log=True),
}
TOP_SPACE: Space = {**OFF_POLICY_SPACE, "bandit_learning_rate": _float(1e-4, 1.0, log=True)}
#: Pessimism that is learned by gradient descent.
GPL_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "initial_pessimism": _float(0.0, 2.0),
    "pessimism_learning_rate": _float(1e-6, 1e-3, log=True),
}
OPL_SPACE: Space = {
    **GPL_SPACE,
    "segment_length": _int(4, 32, log=True),
    "one_minus_td_lambda": _float(0.01, 0.3, log=True),
}
VPL_SPACE: Space = {**GPL_SPACE, "validation_proportion": _float(1 / 128, 1 / 4, log=True)}
#: PPO with simulated samples. The share of the training in which there are some is not searched: a trial is shorter
#: than the training that its parameters are for. A trial has to be longer than an iteration, of n_steps times the
#: environments, since nothing is simulated in the first one.
ON_POLICY_SPACE: Space = {
    "learning_rate": _float(1e-5, 2e-3, log=True),
    "one_minus_gamma": _float(1e-4, 0.03, log=True),
    "one_minus_gae_lambda": _float(1e-3, 0.2, log=True),
    "n_steps_pow": _int(9, 12),
    "batch_size_pow": _int(5, 9),
    "n_epochs": _int(3, 20),
    "clip_range": _float(0.1, 0.4),
    "n_simulated": _int(1, 16, log=True),
}
MBMA_SPACE: Space = {**ON_POLICY_SPACE, "simulation_horizon": _int(1, 24)}
#: Its horizon lies above the number of simulated states: one rollout from each real state.
MBPO_SPACE: Space = {**ON_POLICY_SPACE, "n_simulated": _int(1, 11, log=True), "simulation_horizon": _int(12, 24)}
#: What each setting of a regularization belongs to, by its argument: the group, the regularization, and the range.
REGULARIZATION_SETTINGS: dict[str, tuple[str, str, Suggest]] = {
    "weight_decay": ("network_regularization", "weight_decay", _float(1e-5, 1e-1, log=True)),
    "sam_radius": ("plasticity_regularization", "sam", _float(5e-3, 0.5, log=True)),
    "resets": ("plasticity_regularization", "resets", _int(10_000, 320_000, log=True)),
    "redo_period": ("plasticity_regularization", "redo", _int(100, 10_000, log=True)),
}
#: The settings are always suggested, so that all trials have the same parameters; only what is chosen uses them.
REGULARIZED_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "critic_regularization": _choice(*CRITIC_REGULARIZATIONS),
    "network_regularization": _mixture(*NETWORK_REGULARIZATIONS),
    "plasticity_regularization": _mixture(*PLASTICITY_REGULARIZATIONS),
    **{name: suggest for name, (_, _, suggest) in REGULARIZATION_SETTINGS.items()},
}


def decode(params: dict[str, Any]) -> dict[str, Any]:
    """
    :param params: suggested parameters, as Optuna stores them
    :return: arguments of the constructor: ``one_minus_gamma`` is ``gamma``, ``batch_size_pow`` ``batch_size``, and the
        parameters of ``HER_SPACE`` are ``replay_buffer_kwargs``
    """
    arguments: dict[str, Any] = {}
    for name, value in params.items():
        if name in HER_SPACE:
            arguments.setdefault("replay_buffer_kwargs", {})[name] = value
        elif name.startswith("one_minus_"):
            arguments[name.removeprefix("one_minus_")] = 1 - value
        elif name.endswith("_pow"):
            arguments[name.removesuffix("_pow")] = 2**value
        else:
            arguments[name] = value
    return arguments


def decode_regularized(params: dict[str, Any]) -> dict[str, Any]:
    """
    :param params: suggested parameters of ``REGULARIZED_SPACE``, as Optuna stores them
    :return: arguments of ``RegularizedSAC``: as ``decode``, a mixture "a+b" as the list of its members, and None for
        the setting of a regularization that is not chosen
    """
    arguments = decode(params)
    for name in ("network_regularization", "plasticity_regularization"):
        members = arguments[name].split("+")
        arguments[name] = members if len(members) > 1 else members[0]
    for name, (group, regularization, _) in REGULARIZATION_SETTINGS.items():
        if regularization not in params[group].split("+"):
            arguments[name] = None
    return arguments


def sampler(space: Space, convert: Converter = decode) -> Sampler:
    """
    :param space: search space of an algorithm
    :param convert: what turns its parameters into arguments
    :return: the zoo's sampler of it
    """

    def sample(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
        uses_her = additional_args["using_her_replay_buffer"]
        whole = {**space, **(HER_SPACE if uses_her else {})}
        params = {name: suggest(trial, name) for name, suggest in whole.items()}
        # What waits in a storage to be tried is not held to the space by Optuna.
        zoo_trials.check_params(params, whole, f"trial {trial.number}")
        arguments = convert(params)
        for name in arguments.keys() - params.keys() - {"replay_buffer_kwargs"}:
            trial.set_user_attr(name, arguments[name])  # so that reports show the value itself, not its code
        if uses_her:
            arguments["replay_buffer_kwargs"] = {
                **additional_args["her_kwargs"],
                **arguments["replay_buffer_kwargs"],
            }
        return arguments

    return sample


# ---------------------------------------------------------------- registration


class ZooAlgorithm(NamedTuple):
    """
    An algorithm as the zoo needs it.

    :param algorithm: the class
    :param space: its search space
    :param convert: turns suggested parameters, of a trial under way or a stored one, into arguments
    """

    algorithm: type[BaseAlgorithm]
    space: Space
    convert: Converter = decode


#: The algorithms by their names in the zoo (``--algo``, log folders, ``hyperparams/<name>.yml``). "sac" is the zoo's
#: own, Stable-Baselines3's.
ALGORITHMS: dict[str, ZooAlgorithm] = {
    "bro": ZooAlgorithm(BRO, {**BRO_SPACE, "replay_ratio": _int(1, 16, log=True)}),
    "bro_fast": ZooAlgorithm(BROFast, {**BRO_SPACE, "replay_ratio": _int(1, 4)}),
    "bro_td3": ZooAlgorithm(BROTD3, BRO_TD3_SPACE),
    "dac": ZooAlgorithm(DAC, DAC_SPACE),
    "gpl_sac": ZooAlgorithm(GPLSAC, GPL_SPACE),
    "mbma_ppo": ZooAlgorithm(MBMAPPO, MBMA_SPACE),
    "mbpo_ppo": ZooAlgorithm(MBPOPPO, MBPO_SPACE),
    "oac": ZooAlgorithm(OAC, OAC_SPACE),
    "opl_sac": ZooAlgorithm(OPLSAC, OPL_SPACE),
    "qma_ppo": ZooAlgorithm(QMAPPO, ON_POLICY_SPACE),
    "regularized_sac": ZooAlgorithm(RegularizedSAC, REGULARIZED_SPACE, decode_regularized),
    "sac_sample": ZooAlgorithm(SAC, SAC_SPACE),
    "sr_sac": ZooAlgorithm(SRSAC, SR_SAC_SPACE),
    "top_sac": ZooAlgorithm(TOPSAC, TOP_SPACE),
    "vpl_sac": ZooAlgorithm(VPLSAC, VPL_SPACE),
}


def stored_arguments(algo: str, params: dict[str, Any], where: str) -> dict[str, Any]:
    """
    :param algo: name of an algorithm of ours
    :param params: parameters of a stored trial, which anybody may have written
    :param where: whose they are, for messages
    :return: arguments of the constructor
    :raises BadFile: (a ``ValueError``) if they are not what a search of the algorithm stores
    """
    entry = ALGORITHMS[algo]
    zoo_trials.check_params(params, {**entry.space, **HER_SPACE}, where)
    try:
        return entry.convert(params)
    except KeyError as error:
        raise BadFile(f"{where} has no {error}, which a search of {algo} stores") from error


def register() -> None:
    """
    Put the algorithms, their search spaces and their hyperparameters into the zoo. More than one call does no harm.

    A program that uses ``rl_zoo3.exp_manager.ExperimentManager`` itself calls this first; ``sb3-sample`` and, in the
    folder of this repository, ``python -m rl_zoo3.train`` do so.
    """
    samplers: dict[str, Any] = rl_zoo3.hyperparams_opt.HYPERPARAMS_SAMPLER
    converters: dict[str, Any] = rl_zoo3.hyperparams_opt.HYPERPARAMS_CONVERTER
    for name, entry in ALGORITHMS.items():
        # In place: the zoo's other modules hold these same dicts.
        rl_zoo3.utils.ALGOS[name] = entry.algorithm
        samplers[name] = sampler(entry.space, entry.convert)
        converters[name] = entry.convert
    _adapt_experiment_manager()


def _adapt_experiment_manager() -> None:
    """
    Have the zoo's ``ExperimentManager`` take our hyperparameter files for our algorithms, evaluate them in environments
    with the ``env_kwargs`` of those files (the zoo does so with the command line's only), record successes in the
    Monitor files of our environments that report them, and write files that run no code. The zoo has no option for
    these.
    """
    # Not at the top: it imports custom_envs, and the custom_envs of this repository imports this module.
    module = importlib.import_module("rl_zoo3.exp_manager")
    if not hasattr(module, "ExperimentManager"):
        # The zoo is in the midst of importing that module and has come to custom_envs. Of its commands only
        # record_video starts there, which reads no hyperparameter file.
        return
    manager: Any = module.ExperimentManager
    if hasattr(manager, "_adapted_by_sb3_sample"):
        return
    manager._adapted_by_sb3_sample = True
    original_init = manager.__init__
    original_is_robotics_env = manager.is_robotics_env
    original_read = manager.read_hyperparameters
    original_load_trial, original_optimize = manager.load_trial, manager.hyperparameters_optimization
    signature = inspect.signature(original_init)

    @functools.wraps(original_init)
    def init(*args: Any, **kwargs: Any) -> None:
        given = signature.bind(*args, **kwargs)
        if given.arguments["algo"] in ALGORITHMS:
            if not given.arguments.get("config"):
                given.arguments["config"] = str(HYPERPARAMS / f"{given.arguments['algo']}.yml")
            if given.arguments.get("trial_id") == 0:
                raise ValueError(
                    "trial_id must be at least 1, not 0: the zoo takes 0 for no trial and would train with the "
                    "parameters of the file; pass trial 0's parameters with -params"
                )
        original_init(*given.args, **given.kwargs)

    def load_trial(self: Any, storage: str, study_name: str, trial_id: int | None = None, convert: bool = True) -> Any:
        if self.algo not in ALGORITHMS:
            return original_load_trial(self, storage, study_name, trial_id, convert)
        params = zoo_trials.stored_params(storage, study_name, trial_id)
        return stored_arguments(self.algo, params, f"trial {trial_id} of {storage}") if convert else params

    def optimize(self: Any) -> None:
        if self.algo in ALGORITHMS and self.storage is not None:
            zoo_trials.check_storage(self.storage)
        original_optimize(self)

    def read_hyperparameters(self: Any) -> Any:
        hyperparams, saved = original_read(self)
        buffer = hyperparams.get("replay_buffer_kwargs")
        goals = sorted(HER_SPACE.keys() & buffer.keys()) if isinstance(buffer, dict) else []
        if self.algo in ALGORITHMS and goals and "replay_buffer_class" not in hyperparams:
            raise BadFile(f"{', '.join(goals)} belong to a trial with HerReplayBuffer, which this run has not")
        if self.algo in ALGORITHMS and "env_kwargs" in hyperparams and self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = hyperparams["env_kwargs"]
        return hyperparams, saved

    def is_robotics_env(env_id: str) -> bool:
        # The zoo asks this question only to decide whether Monitor records is_success.
        return env_id.startswith(SUCCESS_PREFIXES) or original_is_robotics_env(env_id)

    zoo_files.adapt(module, list(ALGORITHMS))
    manager.__init__ = init
    manager.load_trial = load_trial
    manager.hyperparameters_optimization = optimize
    manager.read_hyperparameters = read_hyperparameters
    manager.is_robotics_env = staticmethod(is_robotics_env)
