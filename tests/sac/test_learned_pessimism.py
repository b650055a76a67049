"""Pessimism learned by gradient descent (GPL, OPL, VPL): every number against one worked by hand."""

import copy
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise

from sb3_sample.learner.batch import Batch, CriticStep, Noise
from sb3_sample.learner.learner import Learner
from sb3_sample.learner.pessimism import TOP, LearnedPessimism, pessimistic_value
from sb3_sample.replay import buffers, sources
from sb3_sample.sac import BRO, GPLSAC, OPLSAC, SAC, TOPSAC, VPLSAC
from tests.sac.common import COMPILES, TINY_BRO, TINY_SAC, differing, random_batch, sac, sampled, state, vec
from tests.sac.test_execution import captured
from tests.sac.test_update import NoSynchronisation
from tests.sac.test_validation_split import Written, tagged


def column(*rows: float) -> torch.Tensor:
    return torch.tensor(rows).reshape(-1, 1)


# Two transitions, two critics, one quantile; the discount is 1/2.
#
#                 Q_mean(s, a)   Q_mean(s', a')  Q_std(s', a')   h     r
# transition 0    (4 + 6) / 2    (10 + 6) / 2    |10 - 6| / 2    1/2   1
# transition 1    (1 + 1) / 2    (3 + 5) / 2     |3 - 5| / 2     -1    2
#
# At beta = 1: V_lb = (8 - 2, 4 - 1) = (6, 3), targets (1 + (6 + 1/2) / 2, 2 + (3 - 1) / 2) = (4.25, 3),
# errors (5 - 4.25, 1 - 3) = (0.75, -2); their derivatives by beta are discount * Q_std = (1, 1/2).
Q = torch.tensor([[[4.0], [1.0]], [[6.0], [1.0]]])
NEXT_Q = torch.tensor([[[10.0], [3.0]], [[6.0], [5.0]]])
STEP = CriticStep(Q, NEXT_Q, column(0.5, -1.0))


def transitions(
    rewards: torch.Tensor | None = None, dones: tuple[float, float] = (0.0, 0.0), discounts: Any = 0.5
) -> Batch:
    nothing = torch.zeros(2, 3)
    rewards = column(1.0, 2.0) if rewards is None else rewards
    return Batch(nothing, torch.zeros(2, 2), nothing, column(*dones), rewards, discounts)


def rule(loss: str, beta: float = 1.0, learning_rate: float = 0.01, source: str = "replay", **learner: Any) -> Any:
    """A rule on its own, and the learner it needs, which is little."""
    stub = SimpleNamespace(minimize=Learner.minimize, **learner)
    return LearnedPessimism(stub, loss, source, beta, learning_rate), stub  # type: ignore[arg-type]


def moved(loss: str, batch: Batch | None = None, step: CriticStep = STEP, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
    """One update; the gradient is left in ``weight.grad``."""
    learned, stub = rule(loss, **kwargs)
    metrics = learned.update(stub, transitions() if batch is None else batch, step)
    return learned, {name: value.item() for name, value in metrics.items()}


# ------------------------------------------------------------------ the dual loss (GPL)


def test_dual_by_hand() -> None:
    learned, metrics = moved("dual")
    # mean(e) = (0.75 - 2) / 2 = -0.625: the bound promises more than the critics' mean, and beta rises. The first step
    # of Adam has the size of the learning rate.
    assert learned.weight.grad.item() == pytest.approx(-0.625)
    assert learned.beta().item() == pytest.approx(1.01)
    assert metrics == pytest.approx({"pessimism/beta": 1.0, "pessimism/loss": -0.625, "pessimism/error": -0.625})


def test_dual_other_direction() -> None:
    # One unit of reward less on both: the errors (1.75, -1), their mean 0.375, and beta falls.
    learned, metrics = moved("dual", transitions(column(0.0, 1.0)))
    assert learned.weight.grad.item() == pytest.approx(0.375)
    assert learned.beta().item() == pytest.approx(0.99)
    assert metrics["pessimism/error"] == pytest.approx(0.375)


def test_dual_error_holds_the_beta_in_force() -> None:
    # beta = 3: V_lb = (8 - 6, 4 - 3) = (2, 1), targets (1 + 2.5 / 2, 2 + 0) = (2.25, 2), errors (2.75, -1); the
    # loss is 3 * 0.875, its gradient the mean error alone, since the error is a constant.
    learned, metrics = moved("dual", beta=3.0)
    assert learned.weight.grad.item() == pytest.approx(0.875)
    assert metrics["pessimism/loss"] == pytest.approx(2.625)
    assert learned.beta().item() == pytest.approx(2.99)


@pytest.mark.parametrize("loss", ["dual", "squared"])
def test_two_steps_of_adam(loss: str) -> None:
    """Two steps with two gradients, by Adam's formula; no weight decay, no schedule."""
    learned, stub = rule(loss)
    gradients, betas = [], []
    for rewards in (column(1.0, 2.0), column(0.0, 1.0)):
        learned.update(stub, transitions(rewards), STEP)
        gradients.append(learned.weight.grad.item())
        betas.append(learned.beta().item())
    g1, g2 = gradients
    m, v = (0.09 * g1 + 0.1 * g2) / (1 - 0.81), (0.000999 * g1**2 + 0.001 * g2**2) / (1 - 0.999**2)
    # A difference of two float32 numbers near 1.
    assert betas[1] - betas[0] == pytest.approx(-0.01 * m / v**0.5, rel=1e-3)
    if loss == "dual":
        # At beta = 1.01 the errors are (1.76, -0.995).
        assert g1 == pytest.approx(-0.625) and g2 == pytest.approx((1.76 - 0.995) / 2, rel=1e-5)


@pytest.mark.parametrize("loss", ["dual", "squared"])
def test_terminated(loss: str) -> None:
    # Transition 0 terminates: target 1, error 4, which has no derivative by beta.
    learned, metrics = moved(loss, transitions(dones=(1.0, 0.0)))
    assert metrics["pessimism/error"] == pytest.approx((4 - 2) / 2)
    # Squared: (2 * 4 * 0 + 2 * -2 * 1/2) / 2.
    assert learned.weight.grad.item() == pytest.approx(1.0 if loss == "dual" else -1.0)


@pytest.mark.parametrize("loss", ["dual", "squared"])
def test_discounts_of_their_own(loss: str) -> None:
    # n-step returns: transition 1 has the discount 1/4, target 2 + (3 - 1) / 4 = 2.5, error -1.5, derivative 1/4.
    learned, metrics = moved(loss, transitions(discounts=column(0.5, 0.25)))
    assert metrics["pessimism/error"] == pytest.approx((0.75 - 1.5) / 2)
    assert learned.weight.grad.item() == pytest.approx(-0.375 if loss == "dual" else 0.75 - 1.5 / 4)


@pytest.mark.parametrize("loss", ["dual", "squared"])
def test_quantiles_spread_before_they_are_averaged(loss: str) -> None:
    # Transition 0 has the critics' quantiles (10, 2) and (6, 6): means (8, 4), spreads (2, 2), V_lb (6 + 2) / 2 = 4.
    # The critics' own means agree: averaged first there would be no spread. Q(s, a): (3, 5) and (5, 7), mean 5.
    # Transition 1 as before, in both quantiles. Error 0: 5 - (1 + 4.5 / 2) = 1.75.
    q = torch.tensor([[[3.0, 5.0], [1.0, 1.0]], [[5.0, 7.0], [1.0, 1.0]]])
    next_q = torch.tensor([[[10.0, 2.0], [3.0, 3.0]], [[6.0, 6.0], [5.0, 5.0]]])
    learned, metrics = moved(loss, step=CriticStep(q, next_q, column(0.5, -1.0)))
    assert metrics["pessimism/error"] == pytest.approx((1.75 - 2) / 2)
    assert learned.weight.grad.item() == pytest.approx(-0.125 if loss == "dual" else 1.75 - 1.0)


def test_three_critics() -> None:
    # Of (1, 2, 6): mean 3, population deviation (14 / 3)^(1/2).
    next_q = torch.tensor([1.0, 2.0, 6.0]).reshape(3, 1, 1).repeat(1, 2, 1)
    _, metrics = moved("dual", step=CriticStep(Q, next_q, column(0.0, 0.0)))
    v = 3 - (14 / 3) ** 0.5
    assert metrics["pessimism/error"] == pytest.approx(((5 - 1 - v / 2) + (1 - 2 - v / 2)) / 2, rel=1e-5)


def test_never_below_zero() -> None:
    learned, stub = rule("dual", beta=0.005)
    positive = transitions(column(-5.0, -5.0))
    for _ in range(3):
        learned.update(stub, positive, STEP)
        assert learned.weight.grad.item() > 0
        assert learned.beta().item() == 0.0
    # And up again from there: Adam's mean of the gradients takes a few steps to turn.
    for _ in range(30):
        learned.update(stub, transitions(column(50.0, 50.0)), STEP)
    assert learned.beta().item() > 0.05


def test_starts_at_zero() -> None:
    learned, metrics = moved("dual", transitions(column(50.0, 50.0)), beta=0.0)
    assert metrics["pessimism/beta"] == 0.0 and learned.beta().item() == pytest.approx(0.01)


# ------------------------------------------------------------------ the squared loss (VPL)


def test_squared_by_hand() -> None:
    # mean(e^2) = (0.5625 + 4) / 2; its gradient mean(2 e de) = 0.75 * 1 - 2 * 1/2 = -0.25.
    learned, metrics = moved("squared")
    assert metrics["pessimism/loss"] == pytest.approx(2.28125)
    assert learned.weight.grad.item() == pytest.approx(-0.25)
    assert learned.beta().item() == pytest.approx(1.01)


def test_squared_and_dual_can_disagree() -> None:
    # Rewards (0, 2): errors (1.75, -2), mean -0.125: dual, up. Squared: 1.75 * 1 - 2 * 1/2 = 0.75, down.
    batch = transitions(column(0.0, 2.0))
    assert moved("dual", batch)[0].beta() > 1 > moved("squared", batch)[0].beta()


@pytest.mark.parametrize("beta", [0.0, 0.3, 1.0, 4.0])
@pytest.mark.parametrize("n_critics", [2, 3])
def test_squared_by_finite_differences(beta: float, n_critics: int) -> None:
    g = torch.Generator().manual_seed(3)
    q, next_q = (torch.randn(n_critics, 2, 4, generator=g, dtype=torch.float64) * 3 for _ in range(2))
    batch = transitions(column(1.0, -2.0).double(), discounts=column(0.9, 0.5).double())
    step = CriticStep(q, next_q, column(0.5, -1.0).double())

    def loss(at: float) -> float:
        value = next_q.mean(dim=0) - at * next_q.std(dim=0, unbiased=False)
        target = batch.rewards + batch.discounts * (value.mean(dim=1, keepdim=True) + step.entropy_bonus)
        return float((q.mean(dim=(0, 2)) - target[:, 0]).square().mean())

    learned, stub = rule("squared", beta=beta)
    learned.double()
    metrics = learned.update(stub, batch, step)
    assert metrics["pessimism/loss"].item() == pytest.approx(loss(beta), rel=1e-6)
    assert learned.weight.grad.item() == pytest.approx((loss(beta + 1e-4) - loss(beta - 1e-4)) / 2e-4, rel=1e-5)


def test_goes_to_the_least_error() -> None:
    # e(beta) = e(0) + beta * de with e(0) = (5 - 5.25, 1 - 3.5) = (-0.25, -2.5), de = (1, 1/2). Least mean square at
    # beta = -(e . de) / (de . de) = (0.25 + 1.25) / 1.25 = 1.2.
    learned, stub = rule("squared", beta=3.0, learning_rate=0.02)
    for _ in range(800):
        learned.update(stub, transitions(), STEP)
    assert learned.beta().item() == pytest.approx(1.2, abs=1e-2)


# ------------------------------------------------------------------ in a model


RULES: dict[str, tuple[type[SAC], dict[str, Any]]] = {
    "gpl": (GPLSAC, {}),
    "opl": (OPLSAC, {}),
    "vpl": (VPLSAC, {"validation_proportion": 1 / 4}),
    "vpl dual": (VPLSAC, {"validation_proportion": 1 / 4, "pessimism_loss": "dual"}),
    "vpl replay": (VPLSAC, {"pessimism_source": "replay"}),
    "vpl recent": (VPLSAC, {"pessimism_source": "recent"}),
    "vpl recent dual": (VPLSAC, {"pessimism_source": "recent", "pessimism_loss": "dual", "validation_proportion": 0}),
    "top": (TOPSAC, {"arms": (0.0, 0.5, 1.0)}),
}
LEARNED = [name for name in RULES if name != "top"]


def make(name: str, env: Any = None, **kwargs: Any) -> Any:
    """A tiny model with one of the rules; the pessimism moves quickly."""
    cls, own = RULES[name]
    quick = {} if name == "top" else {"pessimism_learning_rate": 1e-2}
    return cls("MlpPolicy", vec() if env is None else env, **{"seed": 0, **TINY_SAC, **quick, **own, **kwargs})


def networks(model: SAC) -> list[torch.nn.Parameter]:
    return [*model.policy.parameters(), *model.temperature.parameters(), *model.explorer.parameters()]


@pytest.mark.parametrize("name", LEARNED)
def test_no_gradient_reaches_the_networks(name: str) -> None:
    model = make(name).learn(60)
    for parameter in networks(model):
        parameter.grad = None
    before = [p.detach().clone() for p in networks(model)]
    beta = model.pessimism_rule.beta().clone()
    batch = random_batch(model)
    with torch.no_grad():
        q = model.critic(batch.observations, batch.actions)
    rule = model.pessimism_rule
    rule.update(model.learner, batch, CriticStep(q, q + 1, column(*[0.1] * 8)), None, rule.draw(model._source))
    assert not torch.equal(beta, model.pessimism_rule.beta())
    assert all(p.grad is None for p in networks(model))
    assert all(torch.equal(a, b) for a, b in zip(before, networks(model), strict=True))


def expected_error(model: SAC, samples: Any, noise: torch.Tensor) -> torch.Tensor:
    """``Q_mean(s, a) - r - gamma (V_lb(s') + h)`` with the online critics, the target critics and the actor as is."""
    beta = float(model.pessimism_rule.beta())
    with torch.no_grad():
        actions, log_prob = model.actor.sample(samples.next_observations, noise)
        next_q = model.critic_target(samples.next_observations, actions)[..., 0]
        lower = next_q.mean(dim=0) - beta * next_q.std(dim=0, unbiased=False)
        bonus = -model.temperature().detach() * log_prob.flatten()
        target = samples.rewards[:, 0] + model.gamma * (1 - samples.dones[:, 0]) * (lower + bonus)
        return model.critic(samples.observations, samples.actions)[..., 0].mean(dim=0) - target


@pytest.mark.parametrize("name", ["vpl", "vpl dual", "vpl recent", "vpl recent dual"])
def test_the_error_of_other_transitions_from_the_networks(name: str) -> None:
    model = make(name, vec(2), initial_pessimism=0.7, gamma=0.9).learn(80)
    np.random.seed(3)
    if "recent" in name:
        samples, _ = buffers.latest(model.replay_buffer, 8)
    else:
        samples = model.replay_buffer.sample_validation(2)
    noise = torch.randn(len(samples.rewards), 2)
    error = expected_error(model, samples, noise)
    beta = model.pessimism_rule.beta().item()
    np.random.seed(3)
    rule = model.pessimism_rule
    metrics = rule.update(model.learner, random_batch(model), STEP, noise, rule.draw(model._source))
    wanted = error.square().mean() if "dual" not in name else beta * error.mean()
    assert metrics["pessimism/loss"].item() == pytest.approx(wanted.item(), rel=1e-4, abs=1e-5)
    assert metrics["pessimism/error"].item() == pytest.approx(error.mean().item(), rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("name", ["gpl", "vpl replay"])
def test_replay_is_the_steps_own_batch_from_before_the_step(name: str) -> None:
    model = make(name, initial_pessimism=0.7, learning_rate=1e-2)
    batch, noise = random_batch(model), torch.randn(8, 2)
    error = expected_error(model, batch, noise)
    metrics = model._update(batch, Noise(critic=noise))
    assert metrics["pessimism/error"].item() == pytest.approx(error.mean().item(), rel=1e-4, abs=1e-5)


@pytest.mark.parametrize(
    ("proportion", "batch_size", "n"), [(1 / 128, 256, 2), (1 / 32, 256, 8), (1 / 8, 256, 32), (1 / 2, 256, 128),
                                        (1 / 32, 8, 1), (1 / 32, 48, 2), (1 / 128, 128, 1)]
)  # fmt: skip
def test_waits_for_a_batch_and_takes_exactly_one(
    proportion: float, batch_size: int, n: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = VPLSAC("MlpPolicy", vec(), **{**TINY_SAC, "batch_size": batch_size, "buffer_size": 50_000},
                   validation_proportion=proportion, seed=0)  # fmt: skip
    split = model.replay_buffer
    assert isinstance(split, buffers.ValidationSplit)
    learned: Any = model.pessimism_rule
    judged: list[int] = []
    judge = LearnedPessimism._judge
    spy = lambda learner, batch, *rest: (judged.append(len(batch.rewards)), judge(learner, batch, *rest))[1]  # noqa: E731
    monkeypatch.setattr(LearnedPessimism, "_judge", staticmethod(spy))
    sides = iter([False] * 5 + [True] * (n - 1) + [False] * 5 + [True] + [False] * 5)
    monkeypatch.setattr(np.random, "random", lambda size: np.array([0.0 if next(sides) else 1.0]))
    for i in range(n + 15):
        split.add(np.ones((1, 3)), np.ones((1, 3)), np.zeros((1, 2)), np.ones(1), np.zeros(1), [{}])
        metrics = learned.update(model.learner, random_batch(model), STEP, None, learned.draw(model._source))
        if i < n + 9:
            assert split.n_validation < n and not judged
            assert learned.beta() == 1 and not learned.optimizer.state
            assert list(metrics) == ["pessimism/beta"]
        else:
            assert split.n_validation == n and "pessimism/loss" in metrics
            assert learned.beta() != 1 and learned.optimizer.state
    assert judged == [n] * 6


@pytest.mark.parametrize("how", ["eager", "captured", pytest.param("compiled", marks=[COMPILES, pytest.mark.slow])])
@pytest.mark.parametrize("name", sampled(("vpl", "vpl dual", "vpl recent", "opl"), ("vpl", "opl")))
def test_the_steps_own_subset_makes_the_lower_bound(name: str, how: str) -> None:
    """
    Of the target critics' answers 2, 6 and 14, the first and the last are drawn: mean 8, spread 6; the mean of all is
    22 / 3, their spread 4.99. Rewards are 0, nothing ends, Q(s, a) is (1 + 2 + 6) / 3 = 3 and the discount 1/2.
    """
    # Nothing but beta moves: the critics' answers stay what they are.
    model = make(name, vec(poison=lambda total, observation, _: (observation, 0.0), length=1_000),
                 policy_kwargs={"net_arch": [8], "n_critics": 3}, target_subset=2, gamma=0.5, ent_coef=0.0,
                 learning_rate=0.0, tau=1e-9, compile=how == "compiled").learn(60)  # fmt: skip
    for critic, answers in ((model.critic, (1.0, 2.0, 6.0)), (model.critic_target, (2.0, 6.0, 14.0))):
        with torch.no_grad():
            critic.head.weight.zero_()
            critic.head.bias.copy_(torch.tensor(answers).view_as(critic.head.bias))
    if how == "captured":
        captured(model)
    for i, (subset, mean, spread) in enumerate([([0, 2], 8, 6), ([1, 0], 4, 2), ([2, 1], 10, 4)] * 3):
        beta = model.pessimism_rule.beta().item()
        metrics = model._update(random_batch(model, seed=i), Noise(subset=torch.tensor(subset)))
        value = mean - beta * spread
        if name == "opl":
            # Of all segments the last step: G = V / 2; before it G = ((1 - lambda) V + lambda G) / 2. Of all critics
            # the bound of (s, a): their spread is that of (1, 2, 6).
            returns = [value / 2]
            for _ in range(7):
                returns.append((0.05 * value + 0.95 * returns[-1]) / 2)
            error = np.mean(returns) - (3 - beta * np.std([1, 2, 6]))
        else:
            error = 3 - value / 2
        assert metrics["pessimism/error"].item() == pytest.approx(error, rel=1e-4, abs=1e-4), subset
    assert model.pessimism_rule.beta().item() != beta


def test_recent_waits_for_eight_steps() -> None:
    model = make("vpl recent", vec(3))
    learned = model.pessimism_rule
    for i in range(10):
        metrics = learned.update(model.learner, random_batch(model), STEP, None, learned.draw(model._source))
        assert ("pessimism/loss" in metrics) == (i >= 8)
        model.replay_buffer.add(np.ones((3, 3)), np.ones((3, 3)), np.zeros((3, 2)), np.ones(3), np.zeros(3), [{}] * 3)


def test_recent_takes_the_latest_of_every_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make("vpl recent", tagged((3, 7)), buffer_size=30, learning_rate=0)
    judged: list[torch.Tensor] = []
    judge = LearnedPessimism._judge
    spy = lambda learner, batch, *rest: (judged.append(batch.rewards), judge(learner, batch, *rest))[1]  # noqa: E731
    monkeypatch.setattr(LearnedPessimism, "_judge", staticmethod(spy))
    model.learn(100)
    # 50 steps of each of two: the rewards are 1, 2, ... and 10001, 10002, ...
    last = judged[-1].view(8, 2)
    assert last.tolist() == [[t, 10000 + t] for t in range(43, 51)]


def test_loss_and_source_are_checked() -> None:
    for kwargs, named in (
        ({"pessimism_loss": "huber"}, "loss.*'huber'"),
        ({"pessimism_source": "buffer"}, "source.*'buffer'"),
        ({"pessimism_source": "on_policy"}, "source.*'on_policy'"),
        ({"initial_pessimism": -1.0}, "initial_pessimism.*-1"),
        ({"initial_pessimism": float("nan")}, "initial_pessimism.*nan"),
        ({"pessimism_learning_rate": -1.0}, "learning_rate.*-1"),
        ({"pessimism_learning_rate": float("nan")}, "learning_rate.*nan"),
        ({"validation_proportion": 0}, "validation_proportion=0"),
    ):
        with pytest.raises(ValueError, match=named):
            make("vpl", **kwargs)
    for kwargs, named in (
        ({"segment_length": 0}, "segment_length.*0"),
        ({"td_lambda": 1.1}, r"td_lambda.*1\.1"),
        ({"td_lambda": -0.1}, r"td_lambda.*-0\.1"),
    ):
        with pytest.raises(ValueError, match=named):
            make("opl", **kwargs)
    for name, contradiction in (("gpl", 0.5), ("opl", 0.5), ("gpl", "opl"), ("opl", "gpl")):
        with pytest.raises(ValueError, match=f"pessimism={contradiction!r}"):
            make(name, pessimism=contradiction)


def test_contradiction_at_load(tmp_path: Path) -> None:
    for name in ("gpl", "opl"):
        make(name).save(tmp_path / "m")
        with pytest.raises(ValueError, match=f"pessimism='{name}'.*0.5"):
            RULES[name][0].load(tmp_path / "m", env=vec(), pessimism=0.5)


# ------------------------------------------------------------------ OPL


def lambda_returns(
    terminated: list[list[float]], ends: list[list[float]], bonus: float = 1.0, td_lambda: float = 0.5
) -> list[list[float]]:
    """Of the rewards 1, 2, 3, 4 and the values 10, 20, 30, 40, the discount 1/2."""
    n = len(terminated[0])
    rewards, values = (torch.tensor([1.0, 2.0, 3.0, 4.0]).mul(x).reshape(4, 1).expand(4, n) for x in (1, 10))
    return LearnedPessimism.lambda_returns(
        rewards, torch.tensor(terminated), torch.tensor(ends), values, torch.full((4, n), bonus), 0.5, td_lambda
    ).tolist()


def test_lambda_returns_within_an_episode() -> None:
    # G3 = 4 + (1 + 40) / 2, G2 = 3 + (1 + 15 + 24.5 / 2) / 2, G1 = 2 + (1 + 10 + 17.125 / 2) / 2 = 11.78125,
    # G0 = 1 + (1 + 5 + 11.78125 / 2) / 2.
    never = [[0.0]] * 4
    assert lambda_returns(never, never) == [[6.9453125], [11.78125], [17.125], [24.5]]


def test_lambda_returns_over_a_time_limit() -> None:
    # Step 1 is cut off by a time limit: it bootstraps fully, G1 = 2 + (1 + 20) / 2, and knows nothing of step 2.
    # G0 = 1 + (1 + 5 + 12.5 / 2) / 2.
    never, cut = [[0.0]] * 4, [[0.0], [1.0], [0.0], [0.0]]
    assert lambda_returns(never, cut) == [[7.125], [12.5], [17.125], [24.5]]


def test_lambda_returns_over_a_termination() -> None:
    # Step 1 terminates: G1 = 2, G0 = 1 + (1 + 5 + 1) / 2.
    over = [[0.0], [1.0], [0.0], [0.0]]
    assert lambda_returns(over, over) == [[4.5], [2.0], [17.125], [24.5]]


def test_lambda_returns_of_a_last_step_that_ends() -> None:
    last = [[0.0]] * 3 + [[1.0]]
    never = [[0.0]] * 4
    # Terminated: G3 = 4, G2 = 3 + (1 + 15 + 2) / 2, G1 = 2 + (1 + 10 + 6) / 2, G0 = 1 + (1 + 5 + 5.25) / 2.
    assert lambda_returns(last, last) == [[6.625], [10.5], [12.0], [4.0]]
    # A time limit there changes nothing: the segment's end bootstraps fully too.
    assert lambda_returns(never, last) == lambda_returns(never, never)


def test_lambda_returns_keep_environments_apart() -> None:
    together = lambda_returns([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0] * 3, [0.0] * 3],
                              [[0.0, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0] * 3, [0.0] * 3])  # fmt: skip
    assert together == [[6.9453125, 7.125, 4.5], [11.78125, 12.5, 2.0], [17.125] * 3, [24.5] * 3]


def test_lambda_returns_at_the_ends_of_lambda() -> None:
    never = [[0.0]] * 4
    # 0: one step each. 1: the discounted sum and the last value.
    assert lambda_returns(never, never, td_lambda=0) == [[6.5], [12.5], [18.5], [24.5]]
    assert lambda_returns(never, never, bonus=0.0, td_lambda=1)[0] == [1 + 2 / 2 + 3 / 4 + 4 / 8 + 40 / 16]


def test_opl_step_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """A real segment of two environments, the critics' answers set by hand."""
    model = OPLSAC("MlpPolicy", tagged((3, 50), truncate=True), **TINY_SAC, seed=0, gamma=0.5, segment_length=2,
                   td_lambda=0.5, pessimism_learning_rate=0.01, initial_pessimism=1.0)  # fmt: skip
    model.replay_ratio = 0
    model.learn(18)  # 9 steps of each; the third episode of the first environment ends with the last
    # Rewards ((8, 10008), (9, 10009)). Lower bounds of the next states 10, 20, 30, 40 (each a critic 2 above, one at
    # the bound), bonus 1. G of the last step r + (1 + V) / 2, of the first r + (1 + V / 2 + G / 2) / 2:
    #   first environment   9 + 31 / 2 = 24.5            8 + (1 + 5 + 12.25) / 2 = 17.125
    #   second              10009 + 41 / 2 = 10029.5     10008 + (1 + 10 + 5014.75) / 2 = 12520.875
    # Lower bounds of Q: 1, 2, 3, 4.
    next_q = torch.tensor([[10.0, 20, 30, 40], [12.0, 22, 32, 42]]).unsqueeze(2)
    q = torch.tensor([[1.0, 2, 3, 4], [5.0, 6, 7, 8]]).unsqueeze(2)
    step = CriticStep(q, next_q, torch.ones(4, 1))
    monkeypatch.setattr(LearnedPessimism, "_judge", staticmethod(lambda *_: step))
    rule = model.pessimism_rule
    metrics = rule.update(model.learner, random_batch(model), STEP, None, rule.draw(model._source))
    errors = [17.125 - 1, 12520.875 - 2, 24.5 - 3, 10029.5 - 4]
    assert metrics["pessimism/error"].item() == pytest.approx(np.mean(errors), rel=1e-6)
    assert metrics["pessimism/loss"].item() == pytest.approx(np.mean(errors), rel=1e-6)  # beta was 1
    # What really followed was more than the bound promised: less pessimism.
    assert model.pessimism_rule.beta().item() == pytest.approx(0.99)


class Segments:
    """Records every segment that a rule asks for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        self.seen: list[tuple[Any, torch.Tensor]] = []
        original = sources.latest

        def spy(*args: Any, **kwargs: Any) -> Any:
            self.seen.append(original(*args, **kwargs))
            return self.seen[-1]

        monkeypatch.setattr(sources, "latest", spy)

    def rewards(self, n_envs: int) -> list[list[list[float]]]:
        """Of every segment, by environment."""
        return [samples.rewards.view(-1, n_envs).T.tolist() for samples, _ in self.seen]


@pytest.mark.parametrize("lengths", [(5,), (3, 7), (3, 7, 11)])
@pytest.mark.parametrize("truncate", [True, False])
def test_segments_are_one_environments_consecutive_steps(
    lengths: tuple[int, ...], truncate: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over a run in which the small buffer is overwritten, from the tags of every step."""
    n = len(lengths)
    segments = Segments(monkeypatch)
    make("opl", tagged(lengths, truncate), buffer_size=12 * n, replay_ratio=1 / n).learn(60 * n)
    assert len(segments.seen) > 40
    for samples, ends in segments.seen:
        rewards = samples.rewards.view(8, n)
        first = rewards[0, 0]
        assert torch.equal(rewards - rewards[:1], torch.arange(8.0)[:, None].expand(8, n))
        assert torch.equal(rewards[0], first + 10000 * torch.arange(float(n)))
        observations, following = (x.view(8, n, 3) for x in (samples.observations, samples.next_observations))
        assert torch.equal(observations[..., 0], torch.arange(float(n)).expand(8, n))
        for i, length in enumerate(lengths):
            # Step s of environment i is its episode's last where s is a multiple of the episode's length.
            over = rewards[:, i] % 10000 % length == 0
            assert torch.equal(ends[:, i].bool(), over)
            assert torch.equal(samples.dones.view(8, n)[:, i].bool(), over & (not truncate))
            # The next state is the one that the episode ended in, never the next episode's first.
            assert torch.equal(following[:, i, 2], observations[:, i, 2] + 1)
            assert torch.equal(following[over, i, 2], torch.full((int(over.sum()),), float(length)))
            assert torch.equal(following[:-1, i][~over[:-1]], observations[1:, i][~over[:-1]])


@pytest.mark.parametrize(
    ("n_envs", "learning_starts", "first_step", "first_use"),
    # One environment: step 11 is the actor's first, after step 18 there are 8. Three: random as long as fewer than
    # 10 are stored, at 0, 3, 6, 9; step 5 is the first, 12 the eighth.
    [(1, 10, 11, 18), (3, 10, 5, 12), (1, 0, 1, 8), (2, 40, 21, 28)],
)
def test_random_actions_are_never_on_policy(
    n_envs: int, learning_starts: int, first_step: int, first_use: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    segments = Segments(monkeypatch)
    model = make("opl", tagged((4, 9, 6)[:n_envs]), learning_starts=learning_starts, replay_ratio=1 / n_envs)
    acted: list[int] = []
    act = model.explorer.act
    monkeypatch.setattr(
        model.explorer, "act", lambda *a: (acted.append(model.num_transitions // n_envs + 1), act(*a))[1]
    )
    model.learn(40 * n_envs)
    assert acted[0] == first_step
    used = segments.rewards(n_envs)
    assert used[0] == [[10000 * i + t for t in range(first_use - 7, first_use + 1)] for i in range(n_envs)]
    assert all(min(segment[0]) in acted for segment in used)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_waits_again_after_a_reset(n_envs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reset follows step 30: the steps up to there are another actor's."""
    segments = Segments(monkeypatch)
    model = make("opl", tagged((4, 9, 6)[:n_envs]), resets=(30 * n_envs,), replay_ratio=1 / n_envs)
    model.learn(29 * n_envs)
    assert segments.seen
    moved_to = model.pessimism_rule.beta().item()
    segments.seen.clear()
    model.learn(1 * n_envs, reset_num_timesteps=False)
    assert model.plasticity.n_done == 1
    assert model.pessimism_rule.beta().item() == 1.0 != moved_to and not segments.seen
    model.learn(20 * n_envs, reset_num_timesteps=False)
    assert segments.rewards(n_envs)[0][0] == list(range(31, 39))


def test_the_first_segment_of_another_learn_is_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    """``learn`` starts a new episode, whatever the old one was in the middle of: no return may run across the break."""
    segments = Segments(monkeypatch)
    model = make("opl", tagged((50,)))
    model.learn(30)
    segments.seen.clear()
    model.learn(30)
    assert segments.seen
    for samples, ends in segments.seen:
        broken = (samples.next_observations[:-1] != samples.observations[1:]).any(dim=1)
        assert not (broken & (ends[:-1, 0] == 0)).any(), "a segment joins two episodes"


def test_a_loaded_models_segment_is_one_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same where a model with its buffer goes on in a fresh environment."""
    model = make("opl", tagged((50,))).learn(30)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = OPLSAC.load(tmp_path / "m", env=tagged((50,)))
    loaded.load_replay_buffer(tmp_path / "b")
    segments = Segments(monkeypatch)
    loaded.learn(20, reset_num_timesteps=False)
    assert segments.seen
    for samples, ends in segments.seen:
        broken = (samples.next_observations[:-1] != samples.observations[1:]).any(dim=1)
        assert not (broken & (ends[:-1, 0] == 0)).any(), "a segment joins two episodes"


def test_without_its_buffer_it_waits_for_new_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make("opl", tagged((5,))).learn(30).save(tmp_path / "m")
    segments = Segments(monkeypatch)
    loaded = OPLSAC.load(tmp_path / "m", env=tagged((5,)))
    loaded.learn(20, reset_num_timesteps=False)
    assert segments.rewards(1)[0][0] == list(range(3, 11))  # from the tenth on, when the buffer is warm again


@pytest.mark.parametrize("exploration", ["oac", "optimistic_actor", "optimistic_shift"])
def test_opl_refuses_other_explorers(exploration: str, tmp_path: Path) -> None:
    named = f"exploration='{exploration}'"
    with pytest.raises(ValueError, match=named):
        make("opl", exploration=exploration)
    with pytest.raises(ValueError, match=named):
        sac(pessimism="opl", exploration=exploration)
    make("opl").save(tmp_path / "m")
    with pytest.raises(ValueError, match=named):
        OPLSAC.load(tmp_path / "m", env=vec(), exploration=exploration)


def test_opl_refuses_action_noise(tmp_path: Path) -> None:
    noise = NormalActionNoise(np.zeros(2), np.ones(2))
    with pytest.raises(ValueError, match="action_noise"):
        make("opl", action_noise=noise)
    make("opl").save(tmp_path / "m")
    with pytest.raises(ValueError, match="action_noise"):
        OPLSAC.load(tmp_path / "m", env=vec(), action_noise=noise)
    # The others take it.
    make("gpl", action_noise=noise).learn(15)


def test_bros_own_exploration_is_refused() -> None:
    with pytest.raises(ValueError, match="exploration='optimistic_shift'"):
        BRO("MlpPolicy", vec(), **TINY_BRO, pessimism="opl")


# ------------------------------------------------------------------ every rule


def test_learning_rate_zero_is_fixed_pessimism() -> None:
    """A rule that does not move is the fixed weight; the shortcuts of a fixed one differ by rounding only."""
    for beta in (0.0, 0.3, 1.0):
        fixed = sac(pessimism=beta)
        learned = GPLSAC("MlpPolicy", vec(), **TINY_SAC, seed=0, initial_pessimism=beta, pessimism_learning_rate=0.0)
        for seed in range(10):
            noise = Noise(torch.randn(8, 2), torch.randn(8, 2))
            ours, theirs = (model._update(random_batch(model, seed=seed), noise) for model in (learned, fixed))
            for name in theirs:
                torch.testing.assert_close(ours[name], theirs[name], rtol=1e-4, atol=1e-5)
        assert learned.pessimism_rule.beta().item() == pytest.approx(beta)


@pytest.mark.parametrize("beta", [0.0, 0.5, 1.0])
def test_a_learned_number_weighs_as_a_fixed_one(beta: float) -> None:
    q = torch.randn(2, 6, 4, generator=torch.Generator().manual_seed(0))
    learned, _ = rule("dual", beta=beta)
    torch.testing.assert_close(learned.value(q), pessimistic_value(q, beta))
    assert not learned.value(q).requires_grad


@pytest.mark.parametrize("name", sampled(RULES, ("gpl", "opl", "vpl", "top")))
@pytest.mark.parametrize("n_envs", [1, 3])
def test_update_makes_the_host_wait_for_nothing(name: str, n_envs: int) -> None:
    model = make(name, vec(n_envs)).learn(20 * n_envs)
    metrics: dict[str, Any] = {}
    with NoSynchronisation():
        model.train(3, 8)
        metrics = model._update(random_batch(model))
    assert name == "top" or "pessimism/loss" in metrics
    assert all(value.shape == () and torch.isfinite(value) and not value.requires_grad for value in metrics.values())


@pytest.mark.parametrize("name", sampled(RULES, ("gpl", "opl", "vpl", "top")))
def test_what_is_logged_is_from_before_and_stays(name: str) -> None:
    """A metric is a number of its own, not a view of what goes on to move."""
    model = make(name).learn(40)
    learned = model.pessimism_rule
    before = learned.beta().item()
    logged = model._update(random_batch(model))["pessimism/beta"]
    assert logged.item() == before
    if name == "top":
        learned.arm = (learned.arm + 1) % 3
        learned.weight.fill_(learned.arms[learned.arm])
    assert logged.item() == before != learned.beta().item()


@pytest.mark.parametrize("name", sampled(RULES, ("gpl", "opl", "vpl", "top")))
def test_beta_is_in_the_log(name: str) -> None:
    log = Written()
    model = make(name)
    model.set_logger(Logger(None, [log]))
    model.learn(50, log_interval=1)
    assert 0 <= log.rows[-1]["pessimism/beta"] <= 2
    if name != "top":
        assert log.rows[-1]["pessimism/beta"] != 1 and np.isfinite(log.rows[-1]["pessimism/loss"])


@pytest.mark.parametrize("name", sampled(RULES, ("vpl", "top")))
def test_three_environments_learn(name: str) -> None:
    model = make(name, vec(3)).learn(120)
    assert model._n_updates > 90
    assert all(torch.isfinite(value) for value in model._metrics.values())
    assert name == "top" or model.pessimism_rule.beta() != 1


@pytest.mark.parametrize("name", sampled(RULES, ("gpl", "opl", "vpl", "top")))
@pytest.mark.parametrize("kwargs", [{"backbone": "td3"}, {"n_quantiles": 5}, {"policy_delay": 2, "target_subset": 2},
                                    {"policy_kwargs": {"n_critics": 3, "net_arch": [8]}}])  # fmt: skip
def test_every_rule_in_other_company(name: str, kwargs: dict[str, Any]) -> None:
    model = make(name, **kwargs).learn(40)
    assert all(torch.isfinite(value) for value in model._metrics.values())


def random_numbers() -> Callable[[], None]:
    """What puts all generators back to where they are now."""
    ours, theirs = torch.get_rng_state(), np.random.get_state()

    def restore() -> None:
        torch.set_rng_state(ours)
        np.random.set_state(theirs)

    return restore


@pytest.mark.parametrize("name", sampled(RULES, ("gpl", "opl", "vpl", "top")))
@pytest.mark.parametrize("n_envs", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_loaded_in_the_middle_of_an_episode_it_goes_on_as_if_uninterrupted(
    name: str, n_envs: int, tmp_path: Path
) -> None:
    lengths = (4, 9, 6)[:n_envs]
    model = make(name, tagged(lengths), resets=(70,)).learn(16 * n_envs)
    env, restore = copy.deepcopy(model.get_env()), random_numbers()
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    rule_before = copy.deepcopy(model.pessimism_rule.state_dict())
    model.learn(30 * n_envs, reset_num_timesteps=False)
    loaded = type(model).load(tmp_path / "m", env=env, force_reset=False)
    loaded.load_replay_buffer(tmp_path / "b")
    assert str(loaded.pessimism_rule.state_dict()) == str(rule_before)
    restore()
    loaded.learn(30 * n_envs, reset_num_timesteps=False)
    assert loaded._n_updates == model._n_updates > 0
    assert torch.equal(loaded.pessimism_rule.beta(), model.pessimism_rule.beta())
    assert str(loaded.pessimism_rule.state_dict()) == str(model.pessimism_rule.state_dict())
    assert not differing(state(model), state(loaded))


@pytest.mark.parametrize("name", LEARNED)
def test_moments_are_saved_and_the_learning_rate_is_the_new_one(name: str, tmp_path: Path) -> None:
    model = make(name).learn(40)
    model.save(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m", env=vec(), pessimism_learning_rate=0.125)
    ours, theirs = (m.pessimism_rule.optimizer for m in (model, loaded))
    moments, others = ours.state[model.pessimism_rule.weight], theirs.state[loaded.pessimism_rule.weight]
    assert moments["step"] > 0 and moments["exp_avg_sq"] > 0
    assert all(torch.equal(moments[key], others[key]) for key in ("step", "exp_avg", "exp_avg_sq"))
    assert ours.param_groups[0]["lr"] == 1e-2 and theirs.param_groups[0]["lr"] == 0.125
    assert torch.equal(loaded.pessimism_rule.beta(), model.pessimism_rule.beta())


def test_a_schedule_is_the_others() -> None:
    model = make("gpl", learning_rate=lambda remaining: 5e-4 * (1 + remaining)).learn(40)
    assert model.pessimism_rule.optimizer.param_groups[0]["lr"] == 1e-2
    assert 5e-4 <= model.critic.optimizer.param_groups[0]["lr"] < 6e-4


@pytest.mark.parametrize("name", sampled(LEARNED, ("opl", "vpl")))
def test_a_reset_starts_it_anew(name: str) -> None:
    model = make(name, initial_pessimism=0.7).learn(60)
    learned = model.pessimism_rule
    weight = learned.weight
    assert learned.beta().item() != pytest.approx(0.7) and learned.optimizer.state
    model.reinitialize()
    assert model.pessimism_rule is learned and learned.weight is weight
    assert learned.beta().item() == pytest.approx(0.7) and not learned.optimizer.state
    assert learned.get_extra_state() == {"n_steps": 0}
    # The next step has Adam's size of a first one, in the same parameter.
    if learned.source == "replay":
        model._update(random_batch(model))
        assert abs(weight.item() - 0.7) == pytest.approx(1e-2, rel=1e-3)


def test_shrink_and_perturb_leaves_a_share() -> None:
    model = make("gpl", initial_pessimism=1.0).learn(40)
    old = model.pessimism_rule.beta().item()
    model.reinitialize(0.25)
    assert model.pessimism_rule.beta().item() == pytest.approx(0.25 * old + 0.75)


def test_names_in_the_base_class() -> None:
    """``pessimism`` by name, with ``pessimism_kwargs``."""
    model = sac(pessimism="gpl", pessimism_kwargs={"learning_rate": 0.01, "initial_pessimism": 0.4})
    assert isinstance(model.pessimism_rule, LearnedPessimism)
    assert (model.pessimism_rule.loss, model.pessimism_rule.source) == ("dual", "replay")
    assert model.pessimism_rule.beta().item() == pytest.approx(0.4)
    assert isinstance(sac(pessimism="top").pessimism_rule, TOP)
    named = sac(pessimism="vpl", validation_proportion=1 / 4)
    assert isinstance(named.pessimism_rule, LearnedPessimism)
    assert (named.pessimism_rule.loss, named.pessimism_rule.source) == ("squared", "validation")
    for kwargs, message in (
        ({"pessimism": "vlp"}, "pessimism.*'vlp'"),
        ({"pessimism": "gpl", "pessimism_kwargs": {"arms": (0, 1)}}, "'arms'"),
        ({"pessimism": 0.5, "pessimism_kwargs": {"learning_rate": 1}}, "pessimism=0.5"),
    ):
        with pytest.raises(ValueError, match=message):
            sac(**kwargs)
