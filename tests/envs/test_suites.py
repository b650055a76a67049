"""The papers' lists of tasks."""

import pytest

from sb3_sample.envs import ALL_IDS, published_key, suites

SIZES = {
    "BRO_DMC": 15,
    "BRO_METAWORLD": 15,
    "BRO_MYOSUITE": 10,
    "BRO": 40,
    "BRO_ABLATION": 10,
    "REGULARIZATION_DMC": 7,
    "REGULARIZATION_METAWORLD": 7,
    "REGULARIZATION": 14,
    "DAC_NAMED": 7,
    "VPL_DMC": 10,
    "VPL_METAWORLD": 10,
    "VPL": 20,
    "VPL_ADDITIONAL": 4,
    "MBMA": 14,
    "MBMA_HARD": 4,
    "DMC_DOGS": 4,
    "DMC_HUMANOIDS": 3,
    "DMC_HARD": 7,
}


@pytest.mark.parametrize("name", SIZES)
def test_lists_hold_registered_ids_once(name: str) -> None:
    ids = getattr(suites, name)
    assert len(ids) == len(set(ids)) == SIZES[name]
    assert set(ids) <= set(ALL_IDS)


@pytest.mark.parametrize(
    ("env_id", "key"),
    [
        ("metaworld/push-v3", ("metaworld", "push")),
        ("sb3_sample:metaworld/pick-place-wall-v3", ("metaworld", "pick-place-wall")),
        ("myosuite/key-turn-hard-v0", ("myosuite", "myo-key-turn-hard")),
        ("dmc/ball_in_cup-catch-v0", ("dmc", "ball_in_cup-catch")),
        ("HalfCheetah-v5", ("gymnasium", "HalfCheetah-v4")),
        ("HumanoidStandup-v5", ("gymnasium", "HumanoidStandup-v4")),
        ("h1hand-balance_hard-v0", ("humanoidbench", "h1hand-balance-hard-v0")),
    ],
)
def test_published_key(env_id: str, key: tuple[str, str]) -> None:
    assert published_key(env_id) == key


@pytest.mark.parametrize("env_id", ["CartPole-v1", "dmc/cheetah-run", "other/push-v3", "HalfCheetah", ""])
def test_ids_without_a_key_are_refused(env_id: str) -> None:
    with pytest.raises(ValueError, match="env_id"):
        published_key(env_id)
