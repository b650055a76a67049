"""
Which tests of Stable-Baselines3 and SB3-contrib are run with which of our classes, and which of them fail and shall.

docs/stable_baselines3.md has the reasons in full. An exclusion whose test passes is an error, so that none stays here
that is no longer needed.
"""

import importlib.util

from tests.sb3_suite.suite import Exclusion, Suite

SB3_FILES = (
    "callbacks",
    "cnn",
    "custom_policy",
    "deterministic",
    "dict_env",
    "env_checker",
    "gae",
    "her",
    "identity",
    "logger",
    "monitor",
    "n_step_replay",
    "predict",
    "run",
    "save_load",
    "sde",
    "spaces",
    "tensorboard",
    "train_eval_mode",
    "vec_envs",
    "vec_extract_dict_obs",
    "vec_monitor",
    "vec_normalize",
)
CONTRIB_FILES = ("cnn", "deterministic", "dict_env", "run", "save_load", "train_eval_mode")

#: Why a test fails and shall: the headings of the table in docs/stable_baselines3.md.
REASONS = (
    "State-dependent exploration",
    "Defaults",
    "Initial weights",
    "Quantiles",
    "Errors",
    "`n_steps` with a buffer of one's own",
    "Memory of the replay buffer",
    "Schedules in files",
    "`tau=0`",
    "Weight decay",
    "Simulation",
    "Advantages",
    "The test",
)


def _excluded(reason: str, error: str, *tests: str, by_chance: bool = False) -> tuple[Exclusion, ...]:
    return tuple(Exclusion(test, error, reason, by_chance) for test in tests)


_OFF_POLICY = (
    *_excluded(
        "State-dependent exploration",
        "use_sde=True is not supported",
        "test_her::test_save_load[True-*]",
        "test_run::test_offpolicy_multi_env[*]",
        "test_save_load::test_save_load_policy[True-*]",
        "test_sde::test_state_dependent_noise[True-*]",
        "test_spaces::test_sde_multi_dim",
    ),
    *_excluded("Defaults", "Mean reward below threshold", "test_identity::test_continuous[*]"),
    *_excluded(
        "Defaults",
        "assert 1 == 0",
        "test_her::test_save_load_replay_buffer[False-*]",
        "test_her::test_save_load_replay_buffer[True-*]",
    ),
    *_excluded("Initial weights", "assert", "test_gae::test_infinite_horizon[True-*]", by_chance=True),
    *_excluded("Errors", "ValueError: env must have a bounded Box", "test_spaces::test_action_spaces[CartPole-v1-*]"),
    *_excluded(
        "`n_steps` with a buffer of one's own",
        "n_steps=3 needs a buffer that makes n-step returns",
        "test_n_step_replay::test_n_steps_warns_with_custom_replay_buffer_class[ReplayBuffer]",
        "test_n_step_replay::test_n_steps_with_dict_obs[DictReplayBuffer]",
        "test_n_step_replay::test_n_steps_with_dict_obs[HerReplayBuffer]",
    ),
    *_excluded(
        "`n_steps` with a buffer of one's own",
        "DID NOT WARN",
        "test_n_step_replay::test_n_steps_warns_with_custom_replay_buffer_class[NStepReplayBuffer]",
    ),
    *_excluded("Memory of the replay buffer", "assert 0 == 1", "test_save_load::test_warn_buffer[True-*]"),
    *_excluded("`tau=0`", "tau must lie in (0, 1], not 0", "test_train_eval_mode::test_sac_train_with_batch_norm"),
    *_excluded("The test", "IndexError: list index out of range", "test_save_load::test_save_load[*]"),
    *_excluded(
        "The test",
        "replay_buffer.device.type == model.device.type",
        "test_save_load::test_save_load_replay_buffer[*]",
    ),
)
_BRO = (
    *_excluded(
        "Weight decay",
        "weight_decay is an argument of the algorithm",
        "test_custom_policy::test_custom_optimizer[optimizer_kwargs1-*]",
    ),
    *_excluded("Quantiles", "cannot be converted to Scalar", "test_gae::test_infinite_horizon[*]"),
    *_excluded("The test", "SAC_1", "test_tensorboard::test_tensorboard[sac]"),
)
_PPO = (
    *_excluded("Errors", "ValueError: clip_range_vf must be above 0", "test_run::test_ppo[-0.2-*]"),
    *_excluded("The test", "is truncated, or no file of sb3_sample", "test_save_load::test_load_bad_zip"),
    *_excluded(
        "Schedules in files",
        "has no attribute '__name__'",
        "test_save_load::test_save_load_backward_compatible[*]",
    ),
    *_excluded("The test", "There is no item named 'data'", "test_save_load::test_load_invalid_object"),
    *_excluded("The test", "PPO_1", "test_tensorboard::test_tensorboard[ppo]"),
)
if importlib.util.find_spec("pygame") is None:
    _PPO += _excluded("The test", "pygame is not installed", "test_vec_envs::test_video_recorder")
_MBMA = (
    *_excluded(
        "Simulation",
        "pass n_simulated=0",
        "test_cnn::test_cnn[*]",
        "test_dict_env::test_dict_spaces[*]",
        "test_dict_env::test_dict_vec_framestack[*]",
        "test_dict_env::test_goal_env[*]",
        "test_dict_env::test_multiprocessing[*]",
        "test_dict_env::test_vec_normalize[*]",
        "test_identity::test_discrete[*]",
        "test_logger::test_rollout_success_rate_onpolicy_algo",
        "test_save_load::test_save_load_policy[*-CnnPolicy-*]",
        "test_spaces::test_discrete_obs_space[*]",
    ),
    *_excluded(
        "State-dependent exploration",
        "use_sde=True draws one noise",
        "test_save_load::test_save_load_policy[True-MlpPolicy-*]",
        "test_sde::test_state_dependent_noise[*]",
    ),
    *_excluded("Defaults", "Mean reward below threshold", "test_identity::test_continuous[*]", by_chance=True),
    *_excluded("Advantages", "DID NOT RAISE AssertionError", "test_run::test_ppo_warnings"),
    *_excluded("The test", "terminations of transitions must be 0 or 1", "test_save_load::test_save_load[*]"),
)
_PLAIN = _excluded("The test", "trying to run PPO on the GPU", "test_run::test_ppo_warnings")
_TQC = (
    *_excluded("State-dependent exploration", "use_sde=True is not supported", "test_run::test_sde[*]"),
    *_excluded("`tau=0`", "tau must lie in (0, 1], not 0", "test_train_eval_mode::test_tqc_train_with_batch_norm"),
    *_excluded("The test", "IndexError: list index out of range", "test_save_load::test_save_load[*]"),
)
_CROSSQ = (
    *_excluded("State-dependent exploration", "use_sde=True is not supported", "test_run::test_sde[*]"),
    *_excluded("The test", "IndexError: list index out of range", "test_save_load::test_save_load[*]"),
)

SUITES: dict[Suite, tuple[Exclusion, ...]] = {
    Suite("stable_baselines3", "SAC", "SAC", SB3_FILES): _OFF_POLICY,
    Suite("stable_baselines3", "SAC", "BRO", SB3_FILES): _OFF_POLICY + _BRO,
    Suite("stable_baselines3", "PPO", "MBMAPPO", SB3_FILES): _PPO + _MBMA,
    Suite("stable_baselines3", "PPO", "PlainMBMAPPO", SB3_FILES): _PPO + _PLAIN,
    Suite("sb3_contrib", "TQC", "QuantileSAC", CONTRIB_FILES): _TQC,
    Suite("sb3_contrib", "CrossQ", "CrossQ", CONTRIB_FILES): _CROSSQ,
}
