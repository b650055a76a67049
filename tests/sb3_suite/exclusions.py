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
    "Errors",
    "`n_steps` with a buffer of one's own",
    "Memory of the replay buffer",
    "`tau=0`",
    "Weight decay",
    "What can be simulated",
    "Advantages",
    "The test",
)

_OFF_POLICY = (
    Exclusion("test_gae::test_infinite_horizon[True-*]", "assert", "Initial weights", by_chance=True),
    Exclusion("test_her::test_save_load[True-*]", "use_sde=True is not supported", "State-dependent exploration"),
    Exclusion("test_identity::test_continuous[*]", "Mean reward below threshold", "Defaults"),
    Exclusion(
        "test_n_step_replay::test_n_steps_warns_with_custom_replay_buffer_class[ReplayBuffer]",
        "n_steps=3 needs a buffer that makes n-step returns",
        "`n_steps` with a buffer of one's own",
    ),
    Exclusion(
        "test_n_step_replay::test_n_steps_with_dict_obs[DictReplayBuffer]",
        "n_steps=3 needs a buffer that makes n-step returns",
        "`n_steps` with a buffer of one's own",
    ),
    Exclusion(
        "test_n_step_replay::test_n_steps_with_dict_obs[HerReplayBuffer]",
        "n_steps=3 needs a buffer that makes n-step returns",
        "`n_steps` with a buffer of one's own",
    ),
    Exclusion("test_run::test_offpolicy_multi_env[*]", "use_sde=True is not supported", "State-dependent exploration"),
    Exclusion("test_save_load::test_warn_buffer[True-*]", "assert 0 == 1", "Memory of the replay buffer"),
    Exclusion(
        "test_save_load::test_save_load_policy[True-*]", "use_sde=True is not supported", "State-dependent exploration"
    ),
    Exclusion(
        "test_sde::test_state_dependent_noise[True-*]", "use_sde=True is not supported", "State-dependent exploration"
    ),
    Exclusion("test_spaces::test_action_spaces[CartPole-v1-*]", "ValueError: env must have a bounded Box", "Errors"),
    Exclusion("test_spaces::test_sde_multi_dim", "use_sde=True is not supported", "State-dependent exploration"),
    Exclusion("test_train_eval_mode::test_sac_train_with_batch_norm", "tau must lie in (0, 1], not 0", "`tau=0`"),
)
_BRO = (
    Exclusion(
        "test_custom_policy::test_custom_optimizer[optimizer_kwargs1-*]",
        "weight_decay is an argument of the algorithm",
        "Weight decay",
    ),
    Exclusion("test_tensorboard::test_tensorboard[sac]", "SAC_1", "The test"),
)
_PPO = (
    Exclusion("test_run::test_ppo[-0.2-*]", "ValueError: clip_range_vf must be above 0", "Errors"),
    Exclusion("test_run::test_ppo_warnings", "DID NOT RAISE AssertionError", "Advantages"),
    Exclusion("test_save_load::test_load_bad_zip", "is truncated, or no file of sb3_sample", "The test"),
    Exclusion("test_save_load::test_load_invalid_object", ":serialized:", "The test"),
    Exclusion("test_tensorboard::test_tensorboard[ppo]", "PPO_1", "The test"),
)
if importlib.util.find_spec("pygame") is None:
    _PPO += (Exclusion("test_vec_envs::test_video_recorder", "pygame is not installed", "The test"),)

_SIMULATED = "pass n_simulated=0"
_MBMA = tuple(
    Exclusion(test, _SIMULATED, "What can be simulated")
    for test in (
        "test_cnn::test_cnn[*]",
        "test_dict_env::test_dict_spaces[*]",
        "test_dict_env::test_dict_vec_framestack[*]",
        "test_dict_env::test_goal_env[*]",
        "test_dict_env::test_multiprocessing[*]",
        "test_dict_env::test_vec_normalize[*]",
        "test_identity::test_discrete[*]",
        "test_logger::test_rollout_success_rate_onpolicy_algo",
        "test_save_load::test_save_load_policy[False-CnnPolicy-*]",
        "test_save_load::test_save_load_policy[True-CnnPolicy-*]",
        "test_spaces::test_discrete_obs_space[*]",
    )
) + (
    Exclusion("test_save_load::test_save_load[*]", "diverged", "The test"),
    Exclusion(
        "test_save_load::test_save_load_policy[True-MlpPolicy-*]",
        "use_sde=True draws one noise",
        "State-dependent exploration",
    ),
    Exclusion("test_sde::test_state_dependent_noise[*]", "use_sde=True draws one noise", "State-dependent exploration"),
)

_TQC = (
    Exclusion("test_run::test_sde[*]", "use_sde=True is not supported", "State-dependent exploration"),
    Exclusion("test_train_eval_mode::test_tqc_train_with_batch_norm", "tau must lie in (0, 1], not 0", "`tau=0`"),
)
_CROSSQ = (Exclusion("test_run::test_sde[*]", "use_sde=True is not supported", "State-dependent exploration"),)

SUITES: dict[Suite, tuple[Exclusion, ...]] = {
    Suite("stable_baselines3", "SAC", "SAC", SB3_FILES): _OFF_POLICY,
    Suite("stable_baselines3", "SAC", "BRO", SB3_FILES): _OFF_POLICY + _BRO,
    Suite("stable_baselines3", "PPO", "MBMAPPO", SB3_FILES): _PPO + _MBMA,
    Suite("stable_baselines3", "PPO", "PlainMBMAPPO", SB3_FILES): _PPO,
    Suite("sb3_contrib", "TQC", "QuantileSAC", CONTRIB_FILES): _TQC,
    Suite("sb3_contrib", "CrossQ", "BRO", CONTRIB_FILES): _CROSSQ,
}
