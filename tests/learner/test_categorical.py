"""Categorical heads: targets by hand, mixtures of an ensemble, HL-Gauss, and learning."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from gymnasium import spaces

from sb3_sample import BROFast, DiagnosticsCallback
from sb3_sample.learner.batch import Batch
from sb3_sample.learner.categorical import CategoricalHead, HLGaussHead
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.sac import BRC, SAC
from tests.sac.common import MAKERS, TINY_BRO, bro, differing, sac, state, vec


def batch(rewards: list[float], dones: list[float], gamma: float = 0.5) -> Batch:
    o = torch.zeros(len(rewards), 1)
    return Batch(o, o, o, torch.tensor(dones)[:, None], torch.tensor(rewards)[:, None], gamma)


def logits(*probabilities: list[list[float]]) -> torch.Tensor:
    return torch.tensor(probabilities).clamp_min(1e-30).log()


def target(head: CategoricalHead, of: Batch, q: torch.Tensor, beta: float = 0.0, bonus: float = 0.0) -> Any:
    rule = Pessimism(beta)
    return head.target(of, q, rule.value, torch.full((len(of.rewards), 1), bonus))


def test_two_atoms() -> None:
    """The target of two atoms, 0 and 1, is its expectation: what is beyond the support is clipped atom by atom."""
    head = CategoricalHead(n_atoms=2, v_min=0.0, v_max=1.0)
    q = logits([[0.25, 0.75]] * 3)
    assert head.values(q).flatten().tolist() == pytest.approx([0.75] * 3)
    found = target(head, batch([0.2, 0.8, 0.3], [0, 0, 1]), q)
    # Atoms at 0.2 and 0.7; at 0.8 and 1.3, of which 1 is left; at 0.3 both, without a future.
    expected = [0.25 * 0.2 + 0.75 * 0.7, 0.25 * 0.8 + 0.75, 0.3]
    torch.testing.assert_close(found[:, 1], torch.tensor(expected))
    torch.testing.assert_close(found.sum(dim=1), torch.ones(3))
    # Cross-entropy of two critics against it: the mean over the batch, summed over them.
    q = torch.tensor([[[0.0, 1.0]] * 3, [[0.5, 0.0]] * 3])
    by_hand = 0.0
    for e in range(2):
        for b in range(3):
            log_p = torch.log_softmax(q[e, b], dim=0)
            by_hand -= float((found[b] * log_p).sum()) / 3
    assert head.loss(q, found).item() == pytest.approx(by_hand, rel=1e-6)
    averaging = CategoricalHead(n_atoms=2, v_min=0.0, v_max=1.0, average_critics=True)
    assert averaging.loss(q, found).item() == pytest.approx(by_hand / 2, rel=1e-6)


def test_on_atoms_nothing_is_shared() -> None:
    head = CategoricalHead(n_atoms=5, v_min=-2.0, v_max=2.0)
    q = logits([[0.1, 0.2, 0.3, 0.3, 0.1]])
    # Half the distance, one to the right: -1 and 1 come to lie at 0.5, 1.5; -2, 0, 2 on atoms at 0, 1, 2.
    found = target(head, batch([1.0], [0]), q)
    torch.testing.assert_close(found, torch.tensor([[0.0, 0.0, 0.1 + 0.1, 0.1 + 0.3 + 0.15, 0.15 + 0.1]]))
    # The top and the bottom keep what is clipped to them.
    assert target(head, batch([9.0], [0]), q)[0].tolist() == pytest.approx([0, 0, 0, 0, 1])
    assert target(head, batch([-9.0], [0]), q)[0].tolist() == pytest.approx([1, 0, 0, 0, 0])
    # The entropy bonus is inside the brackets: discounted, and masked at a termination.
    assert torch.equal(target(head, batch([1.0], [0]), q, bonus=2.0), target(head, batch([2.0], [0]), q))
    assert torch.equal(target(head, batch([1.0], [1]), q, bonus=2.0), target(head, batch([1.0], [1]), q))


def test_a_support_that_nothing_leaves_keeps_the_expectation() -> None:
    """The projection does not move the mean, so that the value learned is that of the scalar TD target."""
    generator = torch.Generator().manual_seed(0)
    head = CategoricalHead(n_atoms=101, v_min=-20.0, v_max=20.0)
    q = torch.randn(2, 64, 101, generator=generator)
    of = batch(torch.randn(64, generator=generator).tolist(), [0.0, 1.0] * 32, gamma=0.5)
    for beta in (0.0, 0.5, 1.0, 3.0):
        rule = Pessimism(beta)
        bonus = torch.randn(64, 1, generator=generator)
        found = head.target(of, q, rule.value, bonus)
        scalar = of.rewards + 0.5 * (1 - of.dones) * (rule.value(head.values(q)) + bonus)
        torch.testing.assert_close(head.mean_target(found), scalar, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(found.sum(dim=1), torch.ones(64))


def test_an_ensemble_is_one_distribution() -> None:
    head = CategoricalHead(n_atoms=3, v_min=0.0, v_max=2.0)
    first, second = [0.6, 0.3, 0.1], [0.1, 0.3, 0.6]
    q = logits([first, second], [second, second])
    of = batch([0.0, 0.0], [0, 0], gamma=1.0)
    mean = torch.tensor([[0.35, 0.3, 0.35], second])
    torch.testing.assert_close(target(head, of, q, beta=0.0), mean)
    torch.testing.assert_close(target(head, of, q, beta=1.0), torch.tensor([first, second]))
    half = torch.tensor([first, second]).lerp(mean, 0.5)
    torch.testing.assert_close(target(head, of, q, beta=0.5), half)
    # One critic is its own ensemble, whatever the weight.
    torch.testing.assert_close(target(head, of, q[:1], beta=1.0), torch.tensor([first, second]))
    # Of three critics, a weight below the smallest one's value shifts its atoms.
    q = logits([first], [second], [second])
    values = head.values(q)
    wanted = values.mean(dim=0) - 2 * values.var(dim=0, unbiased=False).sqrt()
    shift = float(wanted - values.min(dim=0).values)
    assert shift < 0
    by_hand = head.project(torch.tensor([first]), (head.support + shift)[None])
    torch.testing.assert_close(target(head, batch([0.0], [0], gamma=1.0), q, beta=2.0), by_hand)


def test_an_agents_support_and_loss_are_those_of_a_head_by_class_too(tmp_path: Path) -> None:
    class Mine(CategoricalHead):
        def __init__(self) -> None:
            super().__init__(n_atoms=7, v_min=-1.0, v_max=1.0)

    for head in ("categorical", CategoricalHead):
        model = MAKERS["BRC"](value_head=head, value_head_kwargs={"n_atoms": 7})
        assert (model.head.v_min, model.head.v_max) == (-10, 10)
        assert MAKERS["FlashSAC"](value_head=head).head.average_critics
    for maker in ("BRC", "FlashSAC"):
        assert MAKERS[maker](value_head=Mine, value_head_kwargs=None).head.v_max == 1
    MAKERS["BRC"]().save(tmp_path / "m")
    assert BRC.load(tmp_path / "m", value_head=CategoricalHead).head.v_max == 10


def test_hl_gauss_by_hand() -> None:
    head = HLGaussHead(n_atoms=4, v_min=0.0, v_max=3.0, sigma=0.75)
    q = logits([[0.0, 1.0, 0.0, 0.0]] * 2)
    found = target(head, batch([0.7, 9.0], [0, 0]), q)

    def below(x: float) -> float:
        return 0.5 * (1 + math.erf(x / (math.sqrt(2) * 0.75)))

    for row, y in enumerate((0.7 + 0.5 * 1.0, 3.0)):
        mass = [below(k + 0.5 - y) - below(k - 0.5 - y) for k in range(4)]
        torch.testing.assert_close(found[row], torch.tensor([m / sum(mass) for m in mass]))
    torch.testing.assert_close(head.values(found.log()[None])[0], head.mean_target(found))


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"n_atoms": 1}, "n_atoms must be an integer of at least 2, not 1"),
        ({"v_min": 1.0, "v_max": 1.0}, "v_min must lie below v_max=1.0, not be 1.0"),
        ({"v_max": math.inf}, "v_max must be a finite number, not inf"),
        ({"average_critics": 2}, "average_critics must be True or False, not 2"),
        ({"sigma": 0.0}, "sigma must be above 0 and finite, not 0.0"),
    ],
)
def test_refused(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        sac(value_head="hl_gauss", value_head_kwargs=kwargs)


@pytest.mark.parametrize("head", ["categorical", "hl_gauss"])
@pytest.mark.parametrize("pessimism", [0.0, 1.0, "gpl", "top", "vpl"])
def test_with_every_rule(head: str, pessimism: Any, tmp_path: Path) -> None:
    validation = {"validation_proportion": 0.25} if pessimism == "vpl" else {}
    kwargs: dict[str, Any] = {"value_head": head, "pessimism": pessimism, **validation}
    model = sac(value_head_kwargs={"n_atoms": 11, "v_max": 30.0}, **kwargs).learn(40)
    assert model.critic(torch.zeros(4, 3), torch.zeros(4, 2)).shape == (2, 4, 11)
    model.save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model", env=vec())
    assert not differing(state(model), state(loaded))
    assert loaded.head.n_outputs == 11 and loaded.head.v_max == 30.0


def test_with_an_optimistic_actor_and_diagnostics() -> None:
    model = bro(cls=BROFast, n_quantiles=None, value_head="categorical")
    model.learn(60, callback=DiagnosticsCallback(vec(), every=30))
    assert model._metrics["exploration/q_std"].item() >= 0
    with pytest.raises(ValueError, match="two value heads"):
        bro(value_head="categorical")
    assert TINY_BRO["n_quantiles"] == 5


@pytest.mark.slow
@pytest.mark.parametrize("head", ["categorical", "hl_gauss"])
def test_it_learns_the_returns_of_a_chain(head: str) -> None:
    """The toy's value under discount 0.5: the reward is the number of the step, seven in an episode."""
    model = sac(
        vec(obs_space=spaces.Discrete(8)),
        value_head=head,
        value_head_kwargs={"v_min": 0.0, "v_max": 16.0, "n_atoms": 33},
        gamma=0.5,
        ent_coef=0.0,
        learning_rate=3e-3,
        batch_size=64,
        replay_ratio=4,
        tau=0.05,
        policy_kwargs={"net_arch": [32, 32]},
    ).learn(500)
    expected, following = [], 0.0
    for t in range(7, 0, -1):
        following = t + 0.5 * following
        expected.append(following)
    observations = torch.arange(7)
    with torch.no_grad():
        found = model.head.values(model.critic.q_values(observations, torch.zeros(7, 2))).mean(dim=0)[:, 0]
    assert found.tolist() == pytest.approx(expected[::-1], abs=0.8)
