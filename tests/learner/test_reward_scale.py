"""Rewards scaled by the running return, and normalised observations: by hand, saved, and in training."""

import math
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sample.learner.batch import Batch
from sb3_sample.learner.reward_scale import REWARD_SCALES, StdOrMaxScale, StdScale
from sb3_sample.sac import DAC, SAC
from tests.sac.common import MAKERS, differing, random_batch, sac, sampled, state, vec

RULES = sorted(REWARD_SCALES)


def learner(**kwargs: Any) -> Any:
    """What a rule knows of a learner."""
    return SimpleNamespace(gamma=0.9, head=None, temperature=lambda: torch.tensor(0.5), target_entropy=-2.0, **kwargs)


def told(rule: str, rewards: list[float], ends: list[int], **kwargs: Any) -> tuple[Any, Any]:
    """A rule that was told of some steps of one environment."""
    of = learner()
    scale: Any = REWARD_SCALES[rule](of, **kwargs)
    for reward, end in zip(rewards, ends, strict=True):
        scale.on_step(of, np.array([reward]), np.array([bool(end)]), [{"TimeLimit.truncated": end == 2}])
        scale.on_observations(of, np.zeros((1, 3)))
    scale.before_updates(of)
    return scale, of


REWARDS, ENDS = [1.0, -2.0, 4.0, 3.0], [0, 0, 1, 0]
#: G: the last reward of the episode already begins the next one.
RETURNS = [1.0, 0.9 - 2.0, 4.0, 0.9 * 4.0 + 3.0]


def test_xqc_by_hand() -> None:
    scale, _ = told("xqc", REWARDS, ENDS)
    assert scale.divisor(None).item() == pytest.approx(np.std(RETURNS) + 1e-8, rel=1e-12)


def test_xqc_leaves_rewards_as_they_are_until_two_returns_differ() -> None:
    """After one step of one environment the standard deviation is 0, and the reward would be multiplied by 1e8."""
    o = torch.zeros(2, 1)
    batch = Batch(o, o, o, o, torch.tensor([[3.0], [-1.0]]), 0.9, {})
    for rewards, divisor in (([], 1.0), ([3.0], 1.0), ([0.0, 0.0], 1.0), ([3.0, 1.0], np.std([3.0, 3.7]))):
        scale, of = told("xqc", [], [])
        scale.transform(batch, None)  # leaves nothing behind
        for reward in rewards:
            scale.on_step(of, np.array([reward]), np.array([False]), [{}])
        found = scale.transform(batch, None).rewards.flatten()
        assert found.tolist() == pytest.approx([3 / divisor, -1 / divisor], rel=1e-6)


def test_simbav2_by_hand() -> None:
    scale, _ = told("simbav2", REWARDS, ENDS, max_return=100.0)
    mean, var, count = 0.0, 1.0, 1e-4
    for g in RETURNS:
        delta, total = g - mean, count + 1
        mean, var, count = mean + delta / total, (var * count + delta**2 * count / total) / total, total
    assert scale.divisor(None).item() == pytest.approx(math.sqrt(var + 1e-8), rel=1e-12)
    scale, _ = told("simbav2", REWARDS, ENDS)
    assert scale.divisor(None).item() == pytest.approx(max(math.sqrt(var + 1e-8), 6.6 / 5), rel=1e-12)


def test_simbav2_waits_for_the_next_actions() -> None:
    scale, of = told("simbav2", REWARDS, ENDS)
    before = scale.divisor(None).item()
    scale.on_step(of, np.array([1e3]), np.array([False]), [{}])
    assert scale.divisor(None).item() == before
    scale.on_observations(of, None)
    assert scale.divisor(None).item() > 100


def test_flashsac_by_hand() -> None:
    scale, _ = told("flashsac", REWARDS, ENDS, max_return=100.0)
    mean, var, count = 0.0, 1.0, 0
    for g in RETURNS:
        delta, total = g - mean, count + 1
        mean, var = mean + delta / total, (var * (count + 1e-4) + delta**2 * count / total) / total
        count = total
    assert scale.divisor(None).item() == pytest.approx(math.sqrt(var + 1e-8), rel=1e-5)
    assert scale.divisor(None).dtype == torch.float32


@pytest.mark.parametrize("rule", ["brc", "flashsac", "simbav2"])
def test_support_of_costs(rule: str) -> None:
    """Values that end at 0 or below it: the bound is the support's larger end."""

    def divisor(v_min: float, v_max: float) -> float:
        of = learner()
        of.head = SimpleNamespace(v_min=v_min, v_max=v_max)
        scale: Any = REWARD_SCALES[rule](of)
        scale.on_step(of, np.array([-30.0]), np.array([True]), [{}])
        scale.on_observations(of, None)
        scale.before_updates(of)
        return float(scale.divisor(None))

    assert 0 < divisor(-5, 0) == divisor(-5, -1) == divisor(-5, 5) == divisor(0, 5) < math.inf


@pytest.mark.parametrize("temperature", [0.0, 0.5])
@pytest.mark.parametrize("target", [0.0, 1.0, -1.0, torch.tensor([-0.5, 0.19])])
def test_brc_of_returns_of_0(target: Any, temperature: float) -> None:
    """The divisor stays above 0 without an entropy bonus, and with a positive target entropy."""
    of = learner()
    of.target_entropy, of.temperature = target, lambda: torch.tensor(temperature)
    scale: Any = REWARD_SCALES["brc"](of, n_tasks=2)
    for task in 0, 1:
        scale.on_step(of, np.zeros(1), np.ones(1, bool), [{"task": task}])
    scale.before_updates(of)
    assert (scale.divisors > 0).all() and scale.divisors.isfinite().all()
    bonus = (-temperature * torch.as_tensor(target).double() / (2 * (1 - of.gamma) * 10)).clamp(min=1e-8)
    torch.testing.assert_close(scale.divisors, bonus.expand(2), rtol=1e-6, atol=0)


def test_brc_by_hand() -> None:
    scale, _ = told("brc", [1.0, 2.0, 4.0], [0, 0, 1])
    # Returns 4, 2 + 3.6, 1 + 5.04; the temperature is 0.5, the target entropy -2, 1 - gamma 0.1.
    expected = (1 + 0.9 * (2 + 0.9 * 4) + 0.5 * 2 / (2 * 0.1)) / 10
    assert scale.divisor(None).item() == pytest.approx(expected, rel=1e-6)
    # A tail that was cut off goes on at the episode's mean reward.
    scale, _ = told("brc", [-1.0, -3.0], [0, 2])
    returns = [-3 + 0.9 * -2 / 0.1, -1 + 0.9 * (-3 + 0.9 * -2 / 0.1)]
    assert scale.divisor(None).item() == pytest.approx((max(map(abs, returns)) + 5) / 10, rel=1e-6)


def test_brc_before_an_episode_is_over() -> None:
    with pytest.warns(UserWarning, match="before an episode has ended and rewards are 0 with reward_scale='brc' until"):
        scale, of = told("brc", [1.0, 2.0], [0, 0])
    assert scale.divisor(None).item() == math.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scale.before_updates(of)
        told("brc", [1.0, 2.0], [0, 1])
    with pytest.warns(UserWarning, match="before an episode has ended in 2 of the 3 tasks; their rewards are 0"):
        told("brc", [1.0], [1], n_tasks=3)


def test_brc_by_task() -> None:
    of = learner()
    scale: Any = REWARD_SCALES["brc"](of, n_tasks=3)
    ends = np.array([True, True])
    scale.on_step(of, np.array([1.0, 5.0]), ends, [{"task": 2}, {"task": 0}])
    scale.before_updates(of)
    o = torch.zeros(4, 1)
    rewards = torch.full((4, 1), 3.0)
    tasks = torch.tensor([[0], [1], [2], [2]])
    found = scale.transform(Batch(o, o, o, o, rewards, 0.9, {"task": tasks}), None).rewards
    expected = [3 / ((5 + 5) / 10), 0.0, 3 / ((1 + 5) / 10), 3 / ((1 + 5) / 10)]
    assert found.flatten().tolist() == pytest.approx(expected, rel=1e-6)
    with pytest.raises(ValueError, match=r"the task of an environment must lie in \[0, 2\], by n_tasks, not be 3"):
        scale.on_step(of, np.array([1.0, 5.0]), ends, [{"task": 3}, {"task": 0}])


@pytest.mark.parametrize("rule", RULES)
def test_trains_saves_and_goes_on(rule: str, tmp_path: Path) -> None:
    model = sac(reward_scale=rule, normalize_observations=True, env=vec(2)).learn(30)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = SAC.load(tmp_path / "model", env=vec(2))
    assert not differing(state(model), state(loaded))
    if rule != "linear":
        assert loaded.reward_scaler.get_extra_state() == model.reward_scaler.get_extra_state()
    assert loaded.reward_scaler.divisor(None) == model.reward_scaler.divisor(None)
    # With another number of environments the returns so far begin anew.
    SAC.load(tmp_path / "model", env=vec(3)).learn(12)


@pytest.mark.parametrize(
    ("before", "after"),
    [("xqc", None), (None, "xqc"), ("xqc", "simbav2"), ("simbav2", "xqc"), ("simbav2", "brc"), ("xqc", "flashsac")],
)
def test_another_rule_at_loading_starts_anew(before: str | None, after: str | None, tmp_path: Path) -> None:
    kwargs = {"max_return": 3.0} if before == "simbav2" else None
    model = sac(reward_scale=before, reward_scale_kwargs=kwargs).learn(30)
    model.save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model", env=vec(), reward_scale=after)
    fresh = sac(reward_scale=after)
    assert loaded.reward_scale == after and loaded.reward_scale_kwargs is None
    ours, theirs = loaded.policy.state_dict(), model.policy.state_dict()
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)
    if after is not None:
        ours, theirs = loaded.reward_scaler.state_dict(), fresh.reward_scaler.state_dict()
        assert ours.keys() == theirs.keys() and str(ours) == str(theirs)
    assert loaded.learn(20).num_timesteps == 20
    # The file's own rule keeps its statistics.
    again = SAC.load(tmp_path / "model", env=vec(), reward_scale=before)
    assert not differing(state(model), state(again)) and again.reward_scale_kwargs == kwargs


class Mine(StdOrMaxScale):
    """A rule of one's own, which a file is not trusted to name."""


@pytest.mark.parametrize(("before", "again"), [(Mine, Mine), ("xqc", StdScale), (StdScale, "xqc")])
def test_the_same_rule_at_loading_keeps_its_statistics(before: Any, again: Any, tmp_path: Path) -> None:
    kwargs = {"max_return": 3.0} if before is Mine else {"eps": 1e-3}
    model = sac(reward_scale=before, reward_scale_kwargs=kwargs).learn(30)
    model.save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model", reward_scale=again)
    assert loaded.reward_scale_kwargs == kwargs
    assert loaded.reward_scaler.divisor(None) == model.reward_scaler.divisor(None) != 1


@pytest.mark.parametrize("rule", sampled(RULES, ("linear", "simbav2")))
def test_resumes(rule: str, tmp_path: Path) -> None:
    def run(folder: Path, n: int, stop: int | None = None) -> Any:
        model = sac(reward_scale=rule, normalize_observations=True, reset_gradient_steps=25)
        stopped = (lambda _l, _g: model.num_timesteps < stop) if stop else None
        return model.learn(n, callback=stopped, checkpoint=folder, checkpoint_freq=10)

    whole = run(tmp_path / "a", 60)
    run(tmp_path / "b", 60, stop=35)
    assert not differing(state(whole), state(run(tmp_path / "b", 60)))


def test_the_bound_is_the_heads() -> None:
    model = sac(reward_scale="simbav2", value_head="categorical", value_head_kwargs={"v_max": 7.0})
    assert model.reward_scaler.max_return == 7.0
    assert sac(reward_scale="simbav2").reward_scaler.max_return == 5.0
    assert sac(reward_scale="brc").reward_scaler.max_return == 10.0
    assert sac(reward_scale="brc", reward_scale_kwargs={"max_return": 3}).reward_scaler.max_return == 3.0


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"reward_scale": "std"}, r"reward_scale must be one of \['brc', 'flashsac', 'linear', .*\], .* not 'std'"),
        ({"reward_scale": "linear", "reward_scale_kwargs": {"factor": 0}}, "factor must be above 0 and finite, not 0"),
        (
            {"reward_scale": "linear", "reward_scale_kwargs": {"factor": 2, "return_range": 3}},
            "factor=2 and return_range=3 are two scales",
        ),
        (
            {"reward_scale": "linear", "reward_scale_kwargs": {"shift": -1}, "n_steps": 3},
            "shift=-1 of reward_scale_kwargs would be added once to the returns of n_steps=3 steps",
        ),
        ({"reward_scale_kwargs": {"eps": 1e-8}}, "reward_scale_kwargs=.* means nothing with reward_scale=None"),
        ({"reward_scale": "xqc", "reward_scale_kwargs": {"max_return": 1}}, "reward_scale_kwargs has 'max_return'"),
        ({"reward_scale": "brc", "reward_scale_kwargs": {"n_tasks": 0}}, "n_tasks must be an integer of at least 1"),
        ({"reward_scale": "simbav2", "reward_scale_kwargs": {"max_return": 0}}, "max_return must be above 0"),
        ({"policy_kwargs": {"normalize_observations": True}}, "is an argument of the algorithm, not of policy_kwargs"),
    ],
)
def test_refused(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        sac(**kwargs)


# ---------------------------------------------------------------- observations


def test_which_observations_count() -> None:
    """Those that are acted on: not the first, nor the last of an episode; the latest step is not seen yet."""
    model = sac(normalize_observations=True, learning_starts=100).learn(10)
    # The toy counts its steps, of which an episode has 7: 0 to 6, then 0 to 2; the first is not among them.
    seen = np.array([1, 2, 3, 4, 5, 6, 0, 1, 2], dtype=float)
    norm = model.policy.observation_norm
    count = 1e-4 + len(seen)
    mean = seen.sum() / count
    assert norm.count.item() == pytest.approx(count)
    assert norm.mean.tolist() == pytest.approx([mean] * 3)
    second = (1e-4 * 1.0 + (seen**2).sum()) / count
    assert norm.var.tolist() == pytest.approx([second - mean**2] * 3)
    before = norm.mean.clone()
    model.predict(np.full(3, 50.0))
    assert torch.equal(norm.mean, before)
    model.learn(3, reset_num_timesteps=False)
    assert norm.count.item() == pytest.approx(count + 3)
    # A new run begins with an observation that does not count.
    model.learn(3)
    assert norm.count.item() == pytest.approx(count + 5)


@pytest.mark.parametrize("maker", ["SAC", "CrossQ", "XQC", "FlashSAC", "BROTD3"])
def test_every_network_reads_them(maker: str) -> None:
    """Networks on raw observations with statistics are those without on normalised ones."""
    given: dict[str, Any] = {"reward_scale": None, "reward_scale_kwargs": None} if maker in ("XQC", "FlashSAC") else {}
    model, plain = MAKERS[maker](normalize_observations=True, **given), MAKERS[maker](**given)
    norm = model.policy.observation_norm
    norm.update(torch.tensor([[1.0, -3.0, 0.5], [2.0, 5.0, 0.5]]))
    weights = {name: value for name, value in model.policy.state_dict().items() if "observation_norm" not in name}
    plain.policy.load_state_dict(weights)
    batch = random_batch(model)
    seen = batch._replace(observations=norm(batch.observations), next_observations=norm(batch.next_observations))
    torch.manual_seed(0)
    ours = model._update(batch)
    torch.manual_seed(0)
    theirs = plain._update(seen)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    o = batch.observations.numpy()
    assert np.array_equal(
        model.predict(o, deterministic=True)[0], plain.predict(norm(batch.observations).numpy(), deterministic=True)[0]
    )


@pytest.mark.parametrize("maker", ["SAC", "BRO", "BROTD3", "DAC", "VPLSAC"])
def test_statistics_stay_at_a_reset(maker: str, tmp_path: Path) -> None:
    model = MAKERS[maker](normalize_observations=True, resets=25).learn(24)
    norm = model.policy.observation_norm
    before = norm.count.item()
    model.reinitialize()
    assert norm.count.item() == before > 20
    model.learn(20, reset_num_timesteps=False)
    for network in (model.actor, model.critic, model.critic_target, model.policy.actor_target):
        assert network is None or network.observation_norm is norm
    if isinstance(model, DAC):
        assert model.explorer.actor.observation_norm is norm
    names = [name for name in model.policy.state_dict() if "observation_norm" in name]
    assert names == ["observation_norm.mean", "observation_norm.var", "observation_norm.count"]
    model.save(tmp_path / "model")
    assert not differing(state(model), state(type(model).load(tmp_path / "model")))


@pytest.mark.parametrize("maker", ["SimbaV2", "FlashSAC"])
def test_parameters_of_a_file_of_another_moment(maker: str, tmp_path: Path) -> None:
    """What a rule or an explorer keeps for the next step is not there in its midst, when callbacks save, or before."""

    class Saves(BaseCallback):
        def _on_step(self) -> bool:
            self.model.save(tmp_path / "m")
            return True

    never = MAKERS[maker]()
    never.save(tmp_path / "never")
    model = MAKERS[maker]().learn(24, Saves())
    model.set_parameters(tmp_path / "m")
    model.set_parameters(tmp_path / "never")
    never.set_parameters(tmp_path / "m")
    never.learn(12)


def test_a_fixed_scale_and_temperature_are_those_of_the_arguments(tmp_path: Path) -> None:
    linear: dict[str, Any] = {"reward_scale": "linear", "reward_scale_kwargs": {"factor": 2.0}}
    sac(ent_coef=0.2, **linear).save(tmp_path / "m")
    batch = random_batch(sac())
    for kwargs, temperature, factor, shift in (
        ({}, 0.2, 2.0, 0.0),
        ({"ent_coef": 0.5}, 0.5, 2.0, 0.0),
        ({"reward_scale_kwargs": {"factor": 10.0, "shift": -1.0}}, 0.2, 10.0, -1.0),
    ):
        model = SAC.load(tmp_path / "m", env=vec(), **kwargs)  # type: ignore[arg-type]
        assert model.learner.temperature().item() == pytest.approx(temperature)
        scaled = model.learner.reward_scaler.transform(batch, None).rewards
        assert torch.allclose(scaled, batch.rewards * factor + shift)


def test_brcs_rule_divides_by_one_minus_gamma(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="gamma must be below 1 with reward_scale='brc', .* not 1"):
        sac(reward_scale="brc", gamma=1.0)
    sac(reward_scale="brc").save(tmp_path / "m")
    with pytest.raises(ValueError, match="gamma must be below 1"):
        SAC.load(tmp_path / "m", env=vec(), gamma=1.0)


def test_tasks_told_by_tensors() -> None:
    of = learner()
    for told_of in (np.array([1]), torch.tensor([[1]]), [1]):
        scale: Any = REWARD_SCALES["brc"](of, n_tasks=2)
        scale.on_observations(of, {"observation": np.zeros((1, 3)), "task": told_of})
        scale.on_step(of, np.array([3.0]), np.array([True]), [{}])
        assert scale.largest.tolist() == [-math.inf, 3.0]


def test_several_tasks_need_the_task_of_each_transition() -> None:
    scale: Any = REWARD_SCALES["brc"](learner(), n_tasks=2)
    with pytest.raises(ValueError, match="reward_scale='brc' with n_tasks=2 needs the task of each transition"):
        scale.divisor(None)


def test_a_shift_by_class_is_refused_like_one_by_name() -> None:
    for rule in ("linear", REWARD_SCALES["linear"]):
        with pytest.raises(ValueError, match="shift=-1 of reward_scale_kwargs would be added once"):
            sac(reward_scale=rule, reward_scale_kwargs={"shift": -1}, n_steps=3)


def test_a_learner_that_is_told_of_no_step() -> None:
    given = SAC.learner(*(getattr(vec(), f"{name}_space") for name in ("observation", "action")), reward_scale="xqc")
    batch = random_batch(sac(), seed=0)
    with pytest.warns(UserWarning, match="StdScale scales rewards by returns, and this learner was told of no step"):
        given.update(batch)
    given.on_step(np.ones(1), np.zeros(1, dtype=bool), [{}])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        given.update(batch)


def test_a_learner_that_was_shown_no_observations() -> None:
    spaces = [getattr(vec(), f"{name}_space") for name in ("observation", "action")]
    batch = random_batch(sac(), seed=0)
    given = SAC.learner(*spaces, normalize_observations=True)
    with pytest.warns(UserWarning, match="normalize_observations=True has no effect, as this learner was shown no"):
        given.update(batch)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        given.update(batch)  # once
        of_data, of_steps = (SAC.learner(*spaces, normalize_observations=True) for _ in range(2))
        of_data.observation_norm.update(batch.observations)
        of_data.update(batch)
        for _ in range(2):
            of_steps.on_observations(np.ones((1, 3), np.float32))
            of_steps.on_step(np.ones(1), np.zeros(1, dtype=bool), [{}])
        of_steps.update(batch)
    assert of_steps.observation_norm.mean.tolist() == pytest.approx([1, 1, 1], rel=1e-3)


def test_one_task_is_not_looked_up() -> None:
    """With one task, "task" is anything: a name in the infos, two numbers among the observations."""
    of, o = learner(), torch.zeros(2, 1)
    scale: Any = REWARD_SCALES["brc"](of)
    scale.on_observations(of, {"observation": np.zeros((1, 3)), "task": np.array([[-0.3, 5.0]])})
    scale.on_step(of, np.array([3.0]), np.array([True]), [{"task": "reach"}])
    scale.before_updates(of)
    assert scale.largest.tolist() == [3.0]
    observations = {"observation": torch.zeros(2, 3), "task": torch.tensor([[-0.3, 5.0], [7.0, 1.0]])}
    found = scale.transform(Batch(observations, o, observations, o, torch.full((2, 1), 4.0), 0.9), None).rewards
    assert found.flatten().tolist() == pytest.approx([4 / ((3 + 5) / 10)] * 2, rel=1e-6)


def test_spaces_that_are_not_normalised() -> None:
    from gymnasium import spaces

    with pytest.raises(ValueError, match="normalize_observations=True needs observations of a Box of floats, not of"):
        sac(vec(obs_space=spaces.Discrete(8)), normalize_observations=True)
