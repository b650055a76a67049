"""
Search spaces of the algorithms, and the functions that turn suggested parameters into arguments.

In a search, the zoo's sampler suggests a trial's parameters and turns them into constructor arguments, Optuna stores
the suggested parameters, and ``--trial-id`` sends the stored ones through the converter. Here both use the same
function, so that a stored trial gives the arguments it was run with.
"""

import itertools
from collections.abc import Callable, Mapping
from typing import Any

import optuna

from sb3_sample.sac.regularized_sac import CRITIC_REGULARIZATIONS, NETWORK_REGULARIZATIONS, PLASTICITY_REGULARIZATIONS
from sb3_sample.zoo.trials import check_params

#: Suggests a value for the parameter of that name.
Suggest = Callable[[optuna.Trial, str], Any]
#: A search space: parameters, by the name under which Optuna stores them.
Space = Mapping[str, Suggest]
#: (trial, number of actions, number of environments, the zoo's facts about the replay buffer) to arguments.
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
# ``one_minus_<x>`` and ``<x>_pow`` are 1 - x and log2(x): scales on which equal changes mean the same anywhere in the
# range. ``final_share_of_<rate>`` is ``final_<rate>`` as a share of the rate, so that no rate rises. The ranges contain
# the defaults of the classes.

_FINAL_SHARE = "final_share_of_"
#: Additional parameters with ``HerReplayBuffer``.
HER_SPACE: Space = {
    "n_sampled_goal": _int(1, 5),
    "goal_selection_strategy": _choice("final", "episode", "future"),
}
#: Settings of every off-policy algorithm.
OFF_POLICY_SPACE: Space = {
    "learning_rate": _float(1e-5, 2e-3, log=True),
    "one_minus_gamma": _float(1e-4, 0.03, log=True),
    "batch_size_pow": _int(5, 10),
    "tau": _float(1e-3, 0.08, log=True),
}
#: Common to BRO's family. The largest model is left out: a trial of it takes as long as several others.
BRO_FAMILY_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "model_size": _choice("0.55M", "1.05M", "2.83M", "4.92M"),
    "pessimism": _float(0.0, 1.0),
    "kl_target": _float(0.01, 0.5, log=True),
    "std_multiplier": _float(0.5, 1.0),
    "weight_decay": _float(1e-5, 1e-2, log=True),
}
BRO_SPACE: Space = {**BRO_FAMILY_SPACE, "replay_ratio": _int(1, 16, log=True)}
BRO_FAST_SPACE: Space = {**BRO_FAMILY_SPACE, "replay_ratio": _int(1, 4)}
#: With TD3 the noise has its own parameters, so that no multiplier is needed.
BRO_TD3_SPACE: Space = {
    **{name: suggest for name, suggest in BRO_FAMILY_SPACE.items() if name != "std_multiplier"},
    "exploration_noise": _float(0.03, 0.4, log=True),
    "target_noise": _float(0.05, 0.5, log=True),
    "policy_delay": _int(1, 4),
    "replay_ratio": _int(1, 16, log=True),
}
# The replay ratio and the resets of the agents below are the regime in which the papers compare them. They are not
# searched, so that a search stays in the regime in which it was started.
SAC_SPACE: Space = {**OFF_POLICY_SPACE, "pessimism": _float(0.0, 1.0)}
#: Replay ratio and resets define this agent.
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
#: The successors of BRO, in their published regime. Widths are not searched, since they determine a trial's time.
SIMBA_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "n_critics": _int(1, 2),
    "weight_decay": _float(1e-5, 1e-1, log=True),
    "replay_ratio": _int(1, 8, log=True),
}
SIMBAV2_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "n_critics": _int(1, 2),
    "final_share_of_learning_rate": _float(0.01, 1.0, log=True),
    "replay_ratio": _int(1, 8, log=True),
}
CROSSQ_SPACE: Space = {
    # Without target networks.
    **{name: suggest for name, suggest in OFF_POLICY_SPACE.items() if name != "tau"},
    "policy_delay": _int(1, 4),
    "replay_ratio": _int(1, 4),
}
XQC_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "final_share_of_learning_rate": _float(0.01, 1.0, log=True),
    "policy_delay": _int(1, 4),
    "replay_ratio": _int(1, 8, log=True),
}
FLASH_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "final_share_of_learning_rate": _float(0.01, 1.0, log=True),
    "target_std": _float(0.05, 0.5, log=True),
    "policy_delay": _int(1, 4),
    "replay_ratio": _int(1, 4),
}
BRC_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "pessimism": _float(0.0, 1.0),
    "weight_decay": _float(1e-5, 1e-2, log=True),
    "replay_ratio": _int(1, 8, log=True),
}
#: Without ``tau``: the targets are copies.
DR_Q_SPACE: Space = {
    **{name: suggest for name, suggest in OFF_POLICY_SPACE.items() if name != "tau"},
    "pessimism": _float(0.0, 1.0),
    "n_steps": _int(1, 5),
    "encoder_horizon": _int(1, 8),
    "target_update_interval": _int(50, 1_000, log=True),
    "exploration_noise": _float(0.05, 0.5, log=True),
    "target_noise": _float(0.05, 0.5, log=True),
    "infonce_weight": _float(0.01, 1.0, log=True),
    "weight_decay": _float(1e-4, 1e-1, log=True),
}
#: From pixels. The replay ratio, which determines a trial's time, is not searched.
DRQ_SPACE: Space = {**OFF_POLICY_SPACE, "pessimism": _float(0.0, 1.0), "policy_delay": _int(1, 4)}
DRQV2_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "pessimism": _float(0.0, 1.0),
    "n_steps": _int(1, 5),
    "noise_clip": _float(0.1, 1.0, log=True),
}
#: Agents that learn from data. A search learns in the environment, with ``--prior-data`` if given; BC, which does not
#: learn there, is not searched; its space is for other callers that sample from it.
BC_SPACE: Space = {name: OFF_POLICY_SPACE[name] for name in ("learning_rate", "batch_size_pow")}
IQL_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "expectile": _float(0.5, 0.95),
    "inverse_temperature": _float(0.3, 10.0, log=True),
    "replay_ratio": _int(1, 8, log=True),
}
SRSPR_SPACE: Space = {
    "learning_rate": _float(1e-5, 1e-3, log=True),
    "one_minus_gamma": _float(1e-3, 0.05, log=True),
    "tau": _float(1e-3, 0.08, log=True),
    "n_steps": _int(1, 20),
    "spr_weight": _float(0.5, 10.0, log=True),
    "replay_ratio": _int(1, 8, log=True),
    "shrink": _float(0.3, 0.95),
}
TD3BC_SPACE: Space = {
    **OFF_POLICY_SPACE,
    "alpha": _float(0.5, 10.0, log=True),
    "policy_delay": _int(1, 4),
    "replay_ratio": _int(1, 8, log=True),
}
#: PPO with simulated samples. The share of the training that has simulated samples is not searched: a trial is shorter
#: than the training that its parameters are for. A trial must be longer than an iteration, which is n_steps times the
#: number of environments, since nothing is simulated in the first one.
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
#: The horizon of its further actions comes from the hyperparameter file.
REWOUND_SPACE: Space = {
    **{name: suggest for name, suggest in ON_POLICY_SPACE.items() if name != "n_simulated"},
    "n_actions": _int(2, 9, log=True),
}
#: Each setting of a regularization, by its argument: the group, the regularization, and the range.
REGULARIZATION_SETTINGS: dict[str, tuple[str, str, Suggest]] = {
    "weight_decay": ("network_regularization", "weight_decay", _float(1e-5, 1e-1, log=True)),
    "sam_radius": ("plasticity_regularization", "sam", _float(5e-3, 0.5, log=True)),
    "resets": ("plasticity_regularization", "resets", _int(10_000, 320_000, log=True)),
    "redo_period": ("plasticity_regularization", "redo", _int(100, 10_000, log=True)),
}
#: The settings are always suggested, so that all trials have the same parameters; only the settings of chosen
#: regularizations are used.
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
    :return: arguments of the constructor: ``one_minus_gamma`` is ``gamma``, ``batch_size_pow`` ``batch_size``,
        ``final_share_of_learning_rate`` times the rate ``final_learning_rate``, and the parameters of ``HER_SPACE`` are
        ``replay_buffer_kwargs``
    """
    arguments: dict[str, Any] = {}
    for name, value in params.items():
        if name.startswith(_FINAL_SHARE):
            rate = name.removeprefix(_FINAL_SHARE)
            arguments[f"final_{rate}"] = value * params[rate]
        elif name in HER_SPACE:
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
    :param convert: turns its parameters into arguments
    :return: the zoo's sampler of it
    """

    def sample(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
        uses_her = additional_args["using_her_replay_buffer"]
        whole = {**space, **(HER_SPACE if uses_her else {})}
        params = {name: suggest(trial, name) for name, suggest in whole.items()}
        # Optuna does not hold a trial that waits in a storage to the space.
        check_params(params, whole, f"trial {trial.number}")
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
