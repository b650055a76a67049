"""TOP's bandit: probabilities by hand, one arm for all environments, what is saved."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample.learner.pessimism import TOP
from sb3_sample.sac import TOPSAC
from tests.sac.common import TINY_SAC, differing, random_batch, sac, state, vec
from tests.sac.test_validation_split import tagged


def bandit(n_envs: int = 1, arms: Any = (0.0, 1.0), learning_rate: float = 0.1) -> tuple[TOP, Any]:
    """A bandit on its own; of the learner it needs the number of environments only."""
    return TOP(SimpleNamespace(n_envs=n_envs), arms, learning_rate), SimpleNamespace(n_envs=n_envs)  # type: ignore[arg-type]


def top(env: Any = None, **kwargs: Any) -> TOPSAC:
    return TOPSAC("MlpPolicy", vec() if env is None else env, **{"seed": 0, **TINY_SAC, **kwargs})


@pytest.mark.parametrize("seed", range(6))
def test_two_episodes_by_hand(seed: int) -> None:
    torch.manual_seed(seed)
    rule, agent = bandit()
    assert rule.probabilities() == [0.5, 0.5]
    rule.on_episode_end(agent, 0, 10.0)
    # The first episode has nothing to be compared with.
    assert rule.log_weights == [0.0, 0.0]
    arm = rule.arm
    rule.on_episode_end(agent, 0, 13.0)
    # 3 more than before, with an arm of probability 1/2: 0.1 * 3 / 0.5 = 0.6.
    assert rule.log_weights[arm] == pytest.approx(0.6) and rule.log_weights[1 - arm] == 0
    p = math.exp(0.6) / (1 + math.exp(0.6))
    assert rule.probabilities()[arm] == pytest.approx(p) == pytest.approx(0.645656, rel=1e-5, abs=1e-6)
    # The third loses 2: it is compared with the second, and divided by the probability of its own arm.
    second, expected = rule.arm, list(rule.log_weights)
    rule.on_episode_end(agent, 0, 11.0)
    expected[second] += 0.1 * -2 / (p if second == arm else 1 - p)
    assert rule.log_weights == pytest.approx(expected)


def test_three_arms_by_hand() -> None:
    rule, agent = bandit(arms=(0.0, 0.5, 2.0), learning_rate=0.3)
    assert rule.probabilities() == pytest.approx([1 / 3] * 3)
    rule.on_episode_end(agent, 0, -5.0)
    arm = rule.arm
    rule.on_episode_end(agent, 0, -3.0)
    # 0.3 * 2 / (1/3)
    assert rule.log_weights[arm] == pytest.approx(1.8)
    assert rule.probabilities()[arm] == pytest.approx(math.exp(1.8) / (math.exp(1.8) + 2))


def test_draws_follow_the_probabilities() -> None:
    torch.manual_seed(0)
    rule, _ = bandit(arms=(0.0, 0.5, 1.0))
    rule.log_weights = [0.0, math.log(2.0), math.log(5.0)]  # 1/8, 2/8, 5/8
    drawn = []
    for _ in range(4000):
        rule._draw()
        drawn.append(rule.arm)
        assert rule.beta().item() == rule.arms[rule.arm]
    for arm, p in enumerate((1 / 8, 2 / 8, 5 / 8)):
        assert abs(drawn.count(arm) - 4000 * p) < 5 * math.sqrt(4000 * p * (1 - p))


def test_the_first_arm_is_drawn_too() -> None:
    torch.manual_seed(0)
    assert {bandit()[0].arm for _ in range(40)} == {0, 1}


def test_several_environments_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    rule, agent = bandit(n_envs=3)
    draws: list[int] = []
    draw = rule._draw
    monkeypatch.setattr(rule, "_draw", lambda: (draw(), draws.append(rule.arm)))
    for env, value in ((1, 10.0), (0, 100.0), (1, 14.0)):
        rule.on_episode_end(agent, env, value)
    # Environment 2 has not ended one: the arm stays.
    assert not draws and rule.log_weights == [0.0, 0.0]
    first = rule.arm
    rule.on_episode_end(agent, 2, 7.0)
    # The only improvement is environment 1's: 4. Drawn anew once.
    assert len(draws) == 1
    expected = [0.0, 0.0]
    expected[first] = 0.1 * 4 / 0.5
    assert rule.log_weights == pytest.approx(expected)
    second, p = rule.arm, rule.probabilities()[rule.arm]
    # +2; +5 and -1; -10: one arm for all, the mean of the four is -1.
    for env, value in ((2, 9.0), (0, 105.0), (0, 104.0)):
        rule.on_episode_end(agent, env, value)
        assert rule.arm == second and len(draws) == 1
    rule.on_episode_end(agent, 1, 4.0)
    expected[second] += 0.1 * -1 / p
    assert rule.log_weights == pytest.approx(expected) and len(draws) == 2
    # The improvements of the old arm are not counted again.
    third, p = rule.arm, rule.probabilities()[rule.arm]
    for env, value in ((0, 104.0), (1, 4.0), (2, 12.0)):
        rule.on_episode_end(agent, env, value)
    expected[third] += 0.1 * 1 / p
    assert rule.log_weights == pytest.approx(expected)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("scale", [1e6, 1e12])
def test_no_overflow(sign: int, scale: float) -> None:
    torch.manual_seed(0)
    rule, agent = bandit(arms=(0.0, 0.5, 1.0))
    g = np.random.default_rng(0)
    for _ in range(300):
        rule.on_episode_end(agent, 0, sign * scale * g.random())
        probabilities = rule.probabilities()
        assert all(math.isfinite(w) for w in rule.log_weights)
        assert all(0 <= p <= 1 for p in probabilities) and sum(probabilities) == pytest.approx(1)


def test_an_episode_whose_worker_has_died_is_none() -> None:
    model = top(vec(2))
    infos: Any = [{"worker_died": "a reason"}, {"episode": {"r": 3.0, "l": 7}}]
    model.learner.on_step(np.zeros(2), np.array([True, True]), infos)
    assert model.pessimism_rule._previous == {1: 3.0}
    with pytest.raises(ValueError, match="environment 0 reports none: wrap it in"):
        model.learner.on_step(np.zeros(2), np.array([True, True]), [{}, infos[1]])


def test_the_better_arm_wins() -> None:
    """Returns that rise under one arm and fall under the other."""
    torch.manual_seed(1)
    rule, agent = bandit()
    value = 0.0
    for _ in range(40):
        value += 1.0 if rule.arm == 1 else -1.0
        rule.on_episode_end(agent, 0, value)
    assert rule.probabilities()[1] > 0.95


@pytest.mark.parametrize("lengths", [pytest.param((5,), marks=pytest.mark.slow), (3, 7, 5)])
@pytest.mark.parametrize("normalize", [False, True])
def test_a_run_against_brute_force(lengths: tuple[int, ...], normalize: bool) -> None:
    """The bandit of a model, recomputed from every episode's raw return and arm."""
    n = len(lengths)
    venv: Any = tagged(lengths, truncate=True)
    model = top(VecNormalize(venv) if normalize else venv, arms=(0.0, 0.5, 1.0), bandit_learning_rate=1e-3)
    rule = model.pessimism_rule
    assert isinstance(rule, TOP)
    previous: dict[int, float] = {}
    improvements: dict[int, list[float]] = {}
    log_weights = [0.0] * 3
    returns, n_draws = [0.0] * n, 0
    for step in range(1, 61):
        arm = rule.arm
        model.learn(n, reset_num_timesteps=False)
        for env in range(n):
            returns[env] += 10000 * env + step
            if step % lengths[env]:
                continue
            improvements.setdefault(env, [])
            if env in previous:
                improvements[env].append(returns[env] - previous[env])
            previous[env], returns[env] = returns[env], 0.0
            if len(improvements) < n:
                continue
            gains = [gain for of_env in improvements.values() for gain in of_env]
            if gains:
                weights = np.exp(np.array(log_weights) - max(log_weights))
                log_weights[arm] += 1e-3 * np.mean(gains) / max(weights[arm] / weights.sum(), 1e-3)
            improvements, n_draws, arm = {}, n_draws + 1, rule.arm
        assert rule.log_weights == pytest.approx(log_weights, rel=1e-4, abs=1e-6), step
        assert rule.beta().item() == rule.arms[rule.arm]
    # The slowest environment sets the pace.
    assert n_draws >= 60 // max(lengths) - 1 and any(log_weights)


def test_the_arm_is_in_force() -> None:
    """Each arm gives the loss that fixed pessimism of its value gives."""
    for arm, beta in enumerate((0.0, 0.4, 1.0)):
        model, fixed = top(arms=(0.0, 0.4, 1.0)), sac(pessimism=beta)
        rule = model.pessimism_rule
        assert isinstance(rule, TOP)
        rule.arm = arm
        rule.weight.fill_(beta)
        losses = []
        for m in (model, fixed):
            m.policy.load_state_dict(fixed.policy.state_dict())
            torch.manual_seed(0)
            losses.append(m._update(random_batch(m)))
        for name, value in losses[1].items():
            torch.testing.assert_close(losses[0][name], value, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_saved_and_loaded(n_envs: int, tmp_path: Path) -> None:
    lengths = (3, 7, 5)[:n_envs]
    # Arms none of which is what a fresh tensor would hold.
    model = top(tagged(lengths), arms=(0.25, 0.5, 0.75), bandit_learning_rate=1e-3).learn(31 * n_envs)
    model.save(tmp_path / "m")
    for seed in range(5):
        loaded = TOPSAC.load(tmp_path / "m", env=tagged(lengths), seed=seed)
        ours, theirs = model.pessimism_rule, loaded.pessimism_rule
        assert isinstance(ours, TOP) and isinstance(theirs, TOP)
        assert theirs.arm == ours.arm and theirs.log_weights == ours.log_weights != [0.0] * 3
        assert theirs._previous == ours._previous and len(ours._previous) == n_envs
        assert theirs._improvements == ours._improvements
        assert n_envs == 1 or ours._improvements
        assert theirs.beta().item() == theirs.arms[ours.arm] == ours.beta().item()
        assert not differing(state(model), state(loaded))
    # Nothing is shared: what the loaded one hears changes nothing in the other.
    before = str(ours.state_dict())
    for env in range(n_envs):
        theirs.on_episode_end(loaded, env, 1e5)
    assert str(ours.state_dict()) == before != str(theirs.state_dict())


def test_a_state_dict_is_a_copy() -> None:
    """``get_parameters`` taken before an episode ends is what it was after it has ended."""
    rule, agent = bandit(n_envs=2)
    rule.on_episode_end(agent, 0, 1.0)
    kept = rule.state_dict()
    before = str(kept)
    rule.on_episode_end(agent, 0, 2.0)
    assert str(kept) == before


def test_loaded_with_fewer_environments(tmp_path: Path) -> None:
    """An environment that is gone counts for nothing: both that are left must end an episode."""
    model = top(tagged((3, 3, 3))).learn(30)
    rule: Any = model.pessimism_rule
    rule._improvements = {2: [1.0]}
    model.save(tmp_path / "m")
    loaded = TOPSAC.load(tmp_path / "m", env=tagged((3, 3)))
    rule = loaded.pessimism_rule
    draws = []
    draw = rule._draw
    rule._draw = lambda: (draw(), draws.append(rule.arm))
    loaded.learner.on_step(np.zeros(2), np.zeros(2), [{}] * 2)
    rule.on_episode_end(loaded.learner, 0, 5.0)
    assert not draws
    rule.on_episode_end(loaded.learner, 1, 5.0)
    assert len(draws) == 1


def test_loaded_with_other_arms(tmp_path: Path) -> None:
    top(arms=(0.0, 0.5)).save(tmp_path / "m")
    loaded = TOPSAC.load(tmp_path / "m", env=vec(), arms=(0.1, 0.6))
    rule = loaded.pessimism_rule
    assert isinstance(rule, TOP)
    assert rule.beta().item() == pytest.approx((0.1, 0.6)[rule.arm])
    with pytest.raises(ValueError, match="arms"):
        TOPSAC.load(tmp_path / "m", env=vec(), arms=(0.0, 0.5, 1.0))


def test_a_reset_starts_the_bandit_anew() -> None:
    model = top(tagged((3,)), bandit_learning_rate=0.01).learn(30)
    rule = model.pessimism_rule
    assert isinstance(rule, TOP)
    weight = rule.weight
    assert any(rule.log_weights) and rule._previous
    model.reinitialize()
    assert model.pessimism_rule is rule and rule.weight is weight
    assert rule.log_weights == [0.0, 0.0] and not rule._previous and not rule._improvements
    assert rule.beta().item() == rule.arms[rule.arm]
    # No feedback for the first episode after it.
    rule.on_episode_end(model.learner, 0, 1e3)
    assert rule.log_weights == [0.0, 0.0]


@pytest.mark.parametrize("contradiction", [0.5, 0.0, 1.0, "gpl", "vpl"])
def test_fixed_pessimism_is_refused(contradiction: Any, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"pessimism={contradiction!r}"):
        top(pessimism=contradiction)
    top().save(tmp_path / "m")
    with pytest.raises(ValueError, match=f"pessimism='top', not {contradiction!r}"):
        TOPSAC.load(tmp_path / "m", env=vec(), pessimism=contradiction)


def test_its_own_name_is_allowed() -> None:
    assert top(pessimism="top").pessimism == top().pessimism == "top"


@pytest.mark.parametrize(
    "arms", [(), (0.5,), "01", (-0.1, 1.0), (0.0, float("nan")), (0.0, float("inf")), ("0", "1"), 0.5, (None, 1.0)]
)
def test_bad_arms(arms: Any) -> None:
    with pytest.raises(ValueError, match="arms"):
        top(arms=arms)


@pytest.mark.parametrize("rate", [-0.1, float("nan"), float("inf")])
def test_bad_learning_rate(rate: float) -> None:
    with pytest.raises(ValueError, match=f"learning_rate of the bandit.*{rate}"):
        top(bandit_learning_rate=rate)


def test_whole_numbers_and_arrays_are_arms_too(tmp_path: Path) -> None:
    for arms in ((0, 1), [0, 1, 2], np.array([0.0, 1.0])):
        model = top(arms=arms).learn(15)
        model.save(tmp_path / "m")
        loaded = TOPSAC.load(tmp_path / "m", env=vec())
        assert loaded.pessimism_rule.beta().item() == model.pessimism_rule.beta().item()
