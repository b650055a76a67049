"""The table of docs/parts.md of what does not go together: every row is refused, by the names of its arguments."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_sample import (
    BC,
    BRC,
    BRO,
    DAC,
    GPLSAC,
    IQL,
    OAC,
    OPLSAC,
    SAC,
    TOPSAC,
    VPLSAC,
    XQC,
    CompactReplayBuffer,
    CrossQ,
    Dataset,
    DebiasedRQ,
    FadedReplayBuffer,
    FlashSAC,
    PrioritizedReplayBuffer,
    RegularizedSAC,
    SimBa,
    SimbaV2,
)
from sb3_sample.parts import ValueHead
from tests.sac.common import MAKERS, TINY_BRO, TINY_FLASH, TINY_RESIDUAL, TINY_SAC, vec

DOCS = Path(__file__).parents[2] / "docs" / "parts.md"
NOISE = NormalActionNoise(np.zeros(2), np.ones(2))
PRIOR = Dataset.from_arrays(np.zeros((9, 3), np.float32), np.zeros((9, 2)), np.zeros(9), np.ones(9), np.zeros(9))

#: By the first cell of a row: classes with arguments that it speaks of, each with the names that the error must have.
ROWS: dict[str, list[tuple[type[SAC], dict[str, Any], tuple[str, ...]]]] = {
    '`pessimism="opl"` with `exploration` other than `"actor"`, or `action_noise`': [
        (SAC, {"pessimism": "opl", "exploration": "oac"}, ("opl", "exploration='oac'")),
        (SAC, {"pessimism": "opl", "action_noise": NOISE}, ("opl", "action_noise")),
    ],
    '`pessimism="vpl"` without `validation_proportion`': [
        (SAC, {"pessimism": "vpl"}, ("pessimism='vpl'", "validation_proportion=0")),
    ],
    "`validation_proportion` with `n_steps` above 1, `HerReplayBuffer`, or one's own buffer that holds none out": [
        (SAC, {"validation_proportion": 0.1, "n_steps": 3}, ("validation_proportion=0.1", "n_steps=3")),
        (VPLSAC, {"n_steps": 3}, ("validation_proportion", "n_steps=3")),
        (
            SAC,
            {"validation_proportion": 0.1, "replay_buffer_class": type("Mine", (ReplayBuffer,), {})},
            ("validation_proportion=0.1", "Mine"),
        ),
        (
            SAC,
            {"validation_proportion": 0.1, "replay_buffer_class": type("Mine", (CompactReplayBuffer,), {})},
            ("validation_proportion=0.1", "Mine", "derive it from ValidationReplayBuffer"),
        ),
    ],
    "`validation_proportion` with `FadedReplayBuffer`, `PrioritizedReplayBuffer`": [
        (
            SAC,
            {"validation_proportion": 0.1, "replay_buffer_class": cls},
            ("validation_proportion=0.1", cls.__name__),
        )
        for cls in (FadedReplayBuffer, PrioritizedReplayBuffer)
    ],
    '`replay_buffer_kwargs={"memory_map": …}` with `n_steps` above 1, unless frames are stacked, or a buffer that does '
    "not know it": [
        (SAC, {"replay_buffer_kwargs": {"memory_map": "x"}, "n_steps": 3}, ("memory_map", "n_steps=3")),
        (
            SAC,
            {"replay_buffer_kwargs": {"memory_map": "x"}, "replay_buffer_class": ReplayBuffer},
            ("memory_map", "replay_buffer_class=ReplayBuffer"),
        ),
    ],
    '`exploration="oac"` with `backbone="td3"`': [(SAC, {"exploration": "oac", "backbone": "td3"}, ("oac", "td3"))],
    '`uncertainty="aleatoric"`, `"both"` without quantiles': [
        (DAC, {"uncertainty": "aleatoric"}, ("uncertainty='aleatoric'", "quantiles")),
        (DAC, {"uncertainty": "both"}, ("uncertainty='both'", "quantiles")),
    ],
    '`ent_coef`, `target_entropy`, `target_std` of `FlashSAC` with `backbone="td3"`': [
        (SAC, {"backbone": "td3", "ent_coef": 0.1}, ("ent_coef=0.1", "td3")),
        (BRC, {"backbone": "td3", "ent_coef": "auto_0.1"}, ("ent_coef='auto_0.1'", "td3")),
        (FlashSAC, {"backbone": "td3", "target_std": 0.3, "policy_kwargs": TINY_FLASH}, ("target_std=0.3", "td3")),
        (SAC, {"backbone": "td3", "target_entropy": -1.0}, ("target_entropy=-1.0", "td3")),
    ],
    "`initial_optimism` of DAC not above -β": [(DAC, {"initial_optimism": -1.0}, ("initial_optimism", "-1.0"))],
    '`DAC` with `optimistic_actor="deterministic"` and a `pessimistic_actor` other than `"stochastic"`, a '
    '`std_multiplier`, or `backbone="td3"`': [
        (DAC, {"optimistic_actor": "deterministic", **more}, (name,))
        for name, more in {
            "pessimistic_actor=None": {"pessimistic_actor": None},
            "pessimistic_actor='deterministic'": {"pessimistic_actor": "deterministic"},
            "std_multiplier=2.0": {"std_multiplier": 2.0},
            "backbone='td3'": {"backbone": "td3"},
        }.items()
    ],
    '`DAC` with `pessimistic_actor="deterministic"` and `ent_coef`, `target_entropy` or `backbone="td3"`': [
        (DAC, {"pessimistic_actor": "deterministic", "ent_coef": 0.1}, ("ent_coef=0.1", "pessimistic_actor")),
        (DAC, {"pessimistic_actor": "deterministic", "target_entropy": -1.0}, ("target_entropy=-1.0",)),
        (DAC, {"pessimistic_actor": "deterministic", "backbone": "td3"}, ("pessimistic_actor", "backbone='td3'")),
    ],
    "`DAC` with `pessimistic_actor=None` and settings of the divergence, or `actor_pessimism`; `optimistic_entropy` "
    "without it": [
        (DAC, {"pessimistic_actor": None, "kl_target": 0.1}, ("kl_target=0.1", "pessimistic_actor=None")),
        (DAC, {"pessimistic_actor": None, "actor_pessimism": 0.0}, ("actor_pessimism=0.0", "pessimistic_actor=None")),
        (DAC, {"optimistic_entropy": True}, ("optimistic_entropy=True", "pessimistic_actor='stochastic'")),
    ],
    "`kl_weight_learning_rate` of `DAC` with `initial_kl_weight=0`": [
        (DAC, {"initial_kl_weight": 0, "kl_weight_learning_rate": 0.1}, ("kl_weight_learning_rate=0.1",)),
    ],
    "`pessimism_kwargs`, or VPL-SAC's settings of its rule, with a number": [
        (SAC, {"pessimism_kwargs": {"arms": (0, 1)}}, ("pessimism_kwargs", "pessimism=1.0")),
        (VPLSAC, {"pessimism": 1.0, "pessimism_loss": "dual"}, ("pessimism_loss='dual'", "pessimism=1.0")),
    ],
    "`kl_target`, `optimism`, … of `DAC`, `BRO`, `OAC` with another class's `exploration`": [
        (DAC, {"exploration": "actor", "kl_target": 0.1}, ("kl_target=0.1", "exploration='actor'")),
        (BRO, {"exploration": "actor", "std_multiplier": 2.0}, ("std_multiplier=2.0", "exploration='actor'")),
        (OAC, {"exploration": "actor", "optimism": 1.0}, ("optimism=1.0", "exploration='actor'")),
    ],
    "`target_subset` above the number of critics": [(SAC, {"target_subset": 3}, ("target_subset", "n_critics", "3"))],
    "a rule of pessimism, a number other than 0 and the class's default, or OAC, with one critic or one target": [
        (SimBa, {"pessimism": 0.5, "policy_kwargs": TINY_RESIDUAL}, ("pessimism=0.5", "n_critics=1")),
        (SAC, {"pessimism": "gpl", "policy_kwargs": {"n_critics": 1}}, ("pessimism='gpl'", "n_critics=1")),
        (OAC, {"policy_kwargs": {"n_critics": 1}}, ("exploration='oac'", "n_critics=1")),
        (SAC, {"pessimism": "gpl", "target_subset": 1}, ("pessimism='gpl'", "target_subset=1")),
    ],
    "`resets` with `reset_gradient_steps`": [
        (SAC, {"resets": 20, "reset_gradient_steps": 20}, ("resets=20", "reset_gradient_steps=20")),
    ],
    "`reset_shrink`, `resets_to` without resets, `redo_threshold` without `redo_period`": [
        (SAC, {"resets_to": "start"}, ("resets_to='start'", "no resets")),
        (BRO, {"resets_to": "fresh", "resets": ()}, ("resets_to='fresh'", "no resets")),
        (SAC, {"reset_shrink": 0.5}, ("reset_shrink=0.5", "no resets")),
        (SAC, {"redo_threshold": 0.5}, ("redo_threshold=0.5", "redo_period=None")),
    ],
    '`redo_period` with `critic_network` `"crossq"`, `"flash"`, `"simbav2"`, `"xqc"`': [
        (CrossQ, {"redo_period": 5}, ("redo_period=5", "no neuron of CrossQNet can be")),
        (XQC, {"redo_period": 5}, ("redo_period=5", "no neuron of XQCNet can be")),
        (
            SimbaV2,
            {"redo_period": 5, "policy_kwargs": TINY_RESIDUAL},
            ("redo_period=5", "no neuron of SimbaV2Net can be"),
        ),
        (FlashSAC, {"redo_period": 5, "policy_kwargs": TINY_FLASH}, ("redo_period=5", "no neuron of FlashNet can be")),
    ],
    '`target_update_interval` with `critic_network="crossq"`, as in `CrossQ` without `weight_norm`; `tau` too, unless '
    '`backbone="td3"`, whose actor has a target': [
        (CrossQ, {"tau": 0.9}, ("tau=0.9", "without target networks")),
        (CrossQ, {"target_update_interval": 7}, ("target_update_interval=7", "without target networks")),
        (CrossQ, {"target_update_interval": 7, "backbone": "td3"}, ("target_update_interval=7", "without target")),
        (SAC, {"policy_kwargs": {"critic_network": "crossq"}, "tau": 0.9}, ("tau=0.9", "without target networks")),
    ],
    "a setting both as an argument and in `exploration_kwargs`, `pessimism_kwargs` or `policy_kwargs`": [
        (DAC, {"exploration_kwargs": {"kl_target": 0.1}}, ("exploration_kwargs", "kl_target")),
        (GPLSAC, {"pessimism_kwargs": {"learning_rate": 0.1}}, ("pessimism_kwargs", "pessimism_learning_rate")),
        (SAC, {"policy_kwargs": {"n_quantiles": 5}}, ("n_quantiles", "policy_kwargs")),
        (BRO, {"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1}}}, ("weight_decay", "optimizer_kwargs")),
    ],
    "`pessimism` in `TOPSAC`, `GPLSAC`, `OPLSAC`, `RegularizedSAC`": [
        (TOPSAC, {"pessimism": 0.5}, ("TOPSAC", "pessimism=0.5")),
        (GPLSAC, {"pessimism": "top"}, ("GPLSAC", "pessimism='top'")),
        (OPLSAC, {"pessimism": 0.5}, ("OPLSAC", "pessimism=0.5")),
        (RegularizedSAC, {"pessimism": 0.5}, ("pessimism", "critic_regularization")),
    ],
    "`critic_network…` in BRO without `model_size=None`": [
        (
            BRO,
            {"model_size": "0.55M", "policy_kwargs": {"critic_network": "mlp"}},
            ("critic_network", "model_size=None"),
        ),
    ],
    "`batch_size=1` with `CrossQ`, `XQC`": [
        (CrossQ, {"batch_size": 1}, ("batch_size", "batch norm")),
        (XQC, {"batch_size": 1}, ("batch_size", "batch norm")),
    ],
    '`net_arch`, `activation_fn` with a network other than `"mlp"`, `"crossq"`, `"xqc"`': [
        (BRO, {"policy_kwargs": {**TINY_BRO["policy_kwargs"], "net_arch": [8]}}, ("net_arch", "bronet")),
        (
            BRO,
            {"policy_kwargs": {**TINY_BRO["policy_kwargs"], "activation_fn": torch.nn.Tanh}},
            ("activation_fn", "bronet"),
        ),
    ],
    '`train_freq=(n, "episode")` with several environments': [
        (SAC, {"train_freq": (1, "episode"), "env": vec(2)}, ("train_freq=(1, 'episode')", "one environment")),
    ],
    "`use_sde=True`": [(SAC, {"use_sde": True}, ("use_sde=True",))],
    "`n_steps` above 1 with a buffer that makes no returns of several steps: `FadedReplayBuffer`, "
    "`PrioritizedReplayBuffer`, one's own": [
        (SAC, {"n_steps": 3, "replay_buffer_class": cls}, ("n_steps=3", f"replay_buffer_class={cls.__name__}"))
        for cls in (FadedReplayBuffer, PrioritizedReplayBuffer, type("Mine", (ReplayBuffer,), {}))
    ],
    "`prior_data` with `n_steps` above 1, `NStepReplayBuffer`, `PrioritizedReplayBuffer` or `DebiasedRQ`": [
        (SAC, {"prior_data": PRIOR, "n_steps": 3}, ("prior_data", "n_steps=3")),
        (
            SAC,
            {"prior_data": PRIOR, "replay_buffer_class": NStepReplayBuffer, "replay_buffer_kwargs": {"n_steps": 3}},
            ("prior_data", "replay_buffer_class=NStepReplayBuffer"),
        ),
        (
            SAC,
            {"prior_data": PRIOR, "replay_buffer_class": PrioritizedReplayBuffer},
            ("prior_data", "replay_buffer_class=PrioritizedReplayBuffer"),
        ),
        (DebiasedRQ, {"prior_data": PRIOR}, ("prior_data=None", "DebiasedRQ")),
    ],
    "`prior_share` without `prior_data`, or so that a batch lacks one of the two": [
        (SAC, {"prior_share": 0.3}, ("prior_share=0.3", "prior_data=None")),
        (SAC, {"prior_data": PRIOR, "prior_share": 0.01}, ("prior_share=0.01", "batch_size=8")),
    ],
    '`IQL` with a rule of pessimism, `sam_radius`, `target_subset`, `value_head`, `actor_pessimism`, `backbone="td3"`, '
    '`share_features_extractor`, or critics whose network stacks rows (`"crossq"`, `"flash"`, `"xqc"`)': [
        (IQL, {"pessimism": "gpl"}, ("pessimism='gpl'", "IQL")),
        (IQL, {"sam_radius": 0.1}, ("sam_radius=0.1", "IQL")),
        (IQL, {"target_subset": 1}, ("target_subset=1", "IQL")),
        (IQL, {"value_head": "categorical"}, ("value_head='categorical'", "IQL")),
        (IQL, {"actor_pessimism": 0.0}, ("actor_pessimism=0.0", "IQL")),
        (IQL, {"backbone": "td3"}, ("backbone='td3'", "IQL")),
        (IQL, {"policy_kwargs": {"share_features_extractor": True}}, ("share_features_extractor=True", "IQL")),
        *(
            (IQL, {"policy_kwargs": {"critic_network": network}}, ("critic_network", "IQL"))
            for network in ("crossq", "flash", "xqc")
        ),
    ],
    (
        "`BC` with anything of critics and their targets (`gamma`, `tau`, `target_update_interval`), `prior_data`, "
        '`reward_scale`, `actor_first`, or `exploration` other than `"actor"`'
    ): [
        (BC, {"gamma": 0.9}, ("gamma=0.9", "BC")),
        (BC, {"prior_data": PRIOR}, ("prior_data", "BC")),
        (BC, {"n_quantiles": 5}, ("n_quantiles=5", "BC")),
        (BC, {"policy_kwargs": {"n_critics": 3}}, ("n_critics", "BC")),
        (BC, {"reward_scale": "xqc"}, ("reward_scale='xqc'", "BC")),
        (BC, {"actor_first": True}, ("actor_first=True", "BC")),
        (BC, {"exploration": "oac"}, ("exploration='oac'", "BC")),
    ],
    "`ent_coef`, `target_entropy`, `task_temperatures` with `BC`, `IQL`": [
        (cls, {name: value}, (f"{name}={value}", cls.__name__))
        for cls in (BC, IQL)
        for name, value in (("ent_coef", 0.1), ("target_entropy", -7.0))
    ],
    "`initial_std` (of `BC`, `IQL` without `actor_kwargs=dict(initial_std=None)`) with `actor_network` "
    '`"flash"`, `"simbav2"`, `"xqc"`': [
        (cls, {"policy_kwargs": {"actor_network": network}}, ("initial_std=1.0", "actor_network"))
        for cls in (BC, IQL)
        for network in ("flash", "simbav2", "xqc")
    ],
    "`augmentation`, `DrQ`, `DrQv2` with observations other than one uint8 image; `augmentation` with `DebiasedRQ`": [
        (SAC, {"augmentation": "shift"}, ("augmentation='shift'", "one image")),
        (DebiasedRQ, {"augmentation": "shift"}, ("DebiasedRQ has augmentation=None",)),
    ],
    "`resets_keep` without resets, or without `share_features_extractor`, or with `BC`, `IQL`": [
        (SAC, {"resets_keep": ("encoder",)}, ("resets_keep", "no resets")),
        (SAC, {"resets": 5, "resets_keep": ("encoder",)}, ("resets_keep", "share_features_extractor=True")),
        *((cls, {"resets": 5, "resets_keep": ("encoder",)}, ("resets_keep", cls.__name__)) for cls in (BC, IQL)),
    ],
    "`target_encoder`, `actor_features`, `encoder_learning_rate` without `share_features_extractor`, the first two "
    "with networks that stack rows": [
        (SAC, {"policy_kwargs": {"target_encoder": "online"}}, ("target_encoder", "share_features_extractor=True")),
        (
            SAC,
            {"policy_kwargs": {"encoder_learning_rate": 1e-4}},
            ("encoder_learning_rate", "share_features_extractor"),
        ),
        (
            CrossQ,
            {"policy_kwargs": {"share_features_extractor": True, "actor_features": "before"}},
            ("actor_features='before'", "CrossQNet"),
        ),
    ],
    '`exploration="scheduled_noise"` with another class than `DrQv2`': [
        (SAC, {"exploration": "scheduled_noise"}, ("scheduled_noise", "DrQv2")),
    ],
    "`value_head` with `n_quantiles`, `value_head_kwargs` without `value_head`": [
        (SAC, {"value_head": ValueHead, "n_quantiles": 5}, ("value_head", "n_quantiles=None")),
        (SAC, {"value_head_kwargs": {"a": 1}}, ("value_head_kwargs", "value_head=None")),
    ],
    "`reward_scale_kwargs` without `reward_scale`": [
        (SAC, {"reward_scale_kwargs": {"max_return": 1}}, ("reward_scale_kwargs", "reward_scale=None")),
    ],
    '`shift` of `reward_scale="linear"` with `n_steps` above 1': [
        (
            SAC,
            {"reward_scale": "linear", "reward_scale_kwargs": {"shift": -1}, "n_steps": 3},
            ("shift=-1", "n_steps=3"),
        ),
    ],
    "`reward_scale` with `VecNormalize(norm_reward=True)`": [
        (SAC, {"reward_scale": "xqc", "env": VecNormalize(vec())}, ("reward_scale='xqc'", "norm_reward=False")),
    ],
    "`learning_rate_schedule` with a function as `learning_rate`; its settings without it": [
        (
            SAC,
            {"learning_rate_schedule": "linear", "learning_rate": lambda progress: progress},
            ("learning_rate_schedule='linear'", "learning_rate, a function"),
        ),
        (SAC, {"final_learning_rate": 1e-5}, ("final_learning_rate=1e-05", "learning_rate_schedule=None")),
        (
            SimbaV2,
            {"policy_kwargs": TINY_RESIDUAL, "learning_rate_schedule": None, "warm_up_steps": 5},
            ("warm_up_steps=5",),
        ),
    ],
    "`final_learning_rate` above `learning_rate`": [
        (SimbaV2, {"policy_kwargs": TINY_RESIDUAL, "learning_rate": 1e-5}, ("final_learning_rate=5e-05", "=1e-05")),
    ],
    "`normalize_observations` with observations other than a Box of floats": [
        (
            SAC,
            {"normalize_observations": True, "env": vec(obs_space=spaces.Discrete(8))},
            ("normalize_observations=True", "Discrete(8)"),
        ),
    ],
    "`n_critics` of `SimBa`, `SimbaV2`, `weight_decay` of `SimBa`, `BRC`, `CrossQ`, `weight_norm` of `CrossQ` also in "
    "`policy_kwargs`; `critic_network…` in `BRC` without `critic_width=None`": [
        (SimBa, {"policy_kwargs": {"n_critics": 2}}, ("n_critics", "policy_kwargs")),
        (SimbaV2, {"policy_kwargs": {"n_critics": 2}}, ("n_critics", "policy_kwargs")),
        (SimBa, {"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1}}}, ("weight_decay", "optimizer_kwargs")),
        (BRC, {"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1}}}, ("weight_decay", "optimizer_kwargs")),
        (CrossQ, {"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1}}}, ("weight_decay", "optimizer_kwargs")),
        (CrossQ, {"policy_kwargs": {"actor_network_kwargs": {"weight_norm": True}}}, ("weight_norm", "policy_kwargs")),
        (BRC, {"policy_kwargs": {"critic_network": "mlp"}}, ("critic_network", "critic_width=None")),
    ],
    "`multitask`, `task_temperatures` with observations that do not tell the task": [
        (BRO, {"multitask": True}, ("multitask=True", "multi_task_env")),
        (SAC, {"task_temperatures": True}, ("task_temperatures=True", "multi_task_env")),
    ],
    '`task_temperatures` with a fixed `ent_coef`, or `backbone="td3"`; a list as `target_entropy` without it': [
        (SAC, {"target_entropy": [-1.0]}, ("target_entropy", "task_temperatures=False")),
    ],
}


def rows() -> list[str]:
    """First cells of the table."""
    section = DOCS.read_text().split("\n## Combinations refused\n")[1].split("\n## ")[0]
    cells = [line.split(" | ")[0].removeprefix("| ") for line in section.splitlines() if line.startswith("| ")]
    return cells[2:]  # below the heading


def test_every_row_is_looked_at() -> None:
    assert rows() == list(ROWS)


@pytest.mark.parametrize(
    ("cls", "arguments", "names"),
    [pytest.param(*case, id=f"{row[:40]}-{i}") for row, cases in ROWS.items() for i, case in enumerate(cases)],
)
def test_it_is_refused(cls: type[SAC], arguments: dict[str, Any], names: tuple[str, ...]) -> None:
    tiny = TINY_BRO if issubclass(cls, BRO) else TINY_SAC
    with pytest.raises(ValueError) as error:
        cls("MlpPolicy", **{"env": vec(), **tiny, **arguments})
    for name in names:
        assert name in str(error.value)


def test_the_rest_of_each_row_is_allowed() -> None:
    """Nothing of what is refused in a combination is refused by itself."""
    for cls in (SAC, DAC, OAC, GPLSAC, OPLSAC, TOPSAC, VPLSAC, RegularizedSAC):
        cls("MlpPolicy", vec(), **TINY_SAC)
    for arguments in (
        {"backbone": "td3"},
        {"redo_period": 5, "redo_threshold": 0.5},
        {"resets": 20, "reset_shrink": 0.5},
        {"validation_proportion": 0.1},
        {"n_steps": 3},
        {"pessimism": "gpl", "pessimism_kwargs": {"learning_rate": 0.1}},
        {"target_subset": 2},
    ):
        SAC("MlpPolicy", vec(), **{**TINY_SAC, **arguments})  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["SimBa", "SimbaV2", "BRC", "XQC", "CrossQ", "CrossQ+WN", "FlashSAC"])
def test_a_deterministic_actor_of_every_agent(name: str) -> None:
    """The temperature that a class begins with is not taken for one that was passed."""
    model = MAKERS[name](backbone="td3").learn(40)
    assert model.ent_coef == "auto" and model._n_updates > 0


def test_targets_that_there_are(tmp_path: Path) -> None:
    """CrossQ+WN has target critics, and a deterministic CrossQ a target actor; files may hold any number."""
    for arguments, target in (({"weight_norm": True}, "critic_target"), ({"backbone": "td3"}, "actor_target")):
        first = {}
        for tau in (0.01, 0.5):
            model: Any = CrossQ("MlpPolicy", vec(), tau=tau, **TINY_SAC, **arguments)  # type: ignore[arg-type]
            model.learn(40)
            first[tau] = next(iter(getattr(model.policy, target).parameters())).clone()
        assert not torch.equal(first[0.01], first[0.5])
    model = CrossQ("MlpPolicy", vec(), **TINY_SAC)
    model.tau = 0.01
    model.save(tmp_path / "model")
    assert CrossQ.load(tmp_path / "model").tau == 0.01
    with pytest.raises(ValueError, match=r"tau=0\.9 means nothing with critics without target networks"):
        CrossQ.learner(model.observation_space, model.action_space, tau=0.9)


def test_her_holds_nothing_out() -> None:
    import gymnasium as gym

    box = gym.spaces.Box(-1, 1, (2,))
    space = gym.spaces.Dict(dict.fromkeys(("observation", "achieved_goal", "desired_goal"), box))
    with pytest.raises(ValueError, match="validation_proportion=0.1.*HerReplayBuffer"):
        SAC(
            "MultiInputPolicy",
            vec(obs_space=space),
            **{**TINY_SAC, "validation_proportion": 0.1, "replay_buffer_class": HerReplayBuffer},
        )
