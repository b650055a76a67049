"""The defaults against the numbers of the published runs, read from the built model where it holds them."""

from typing import Any

import pytest
import torch
from gymnasium import spaces
from torch import nn

from sb3_sample import BRO
from sb3_sample.learner.exploration import Exploration, OptimisticShift
from sb3_sample.networks import BroNet, EnsembleLayerNorm
from sb3_sample.sac import SAC, BROFast
from tests.sac.common import Toy

N_ACTIONS = 3


def build(cls: type[SAC], **kwargs: Any) -> Any:
    env = Toy(spaces.Box(-1, 1, (5,)), spaces.Box(-1, 1, (N_ACTIONS,)))
    return cls("MlpPolicy", env, device="cpu", **kwargs)


@pytest.fixture(scope="module", params=[BRO, BROFast])
def bro(request: pytest.FixtureRequest) -> BRO:
    return build(request.param)


@pytest.fixture(scope="module")
def sac() -> SAC:
    return build(SAC)


def group(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    assert len(optimizer.param_groups) == 1
    return optimizer.param_groups[0]


def widths(trunk: nn.Module) -> tuple[int, int]:
    assert isinstance(trunk, BroNet)
    return trunk.dense.weight.shape[-1 if trunk.dense.weight.dim() == 3 else 0], len(trunk.blocks)


def test_training(bro: BRO) -> None:
    assert bro.replay_ratio == (2 if isinstance(bro, BROFast) else 10)
    assert bro.batch_size == 128
    assert bro.gamma == 0.99
    assert bro.tau == 0.005
    assert bro.learning_starts == 2_500
    assert bro.buffer_size == 1_000_000
    assert bro.replay_buffer is not None and bro.replay_buffer.buffer_size == 1_000_000
    assert bro.target_update_interval == 1
    assert bro.n_steps == 1


def test_resets(bro: BRO) -> None:
    if isinstance(bro, BROFast):
        assert bro.plasticity.steps == (15_000,)
    else:
        assert bro.plasticity.steps == (15_000, 50_000, 250_000, 500_000, 750_000, 1_000_000, 1_500_000, 2_000_000)


def test_networks(bro: BRO) -> None:
    assert widths(bro.critic.trunk) == widths(bro.critic_target.trunk) == (512, 2)
    assert widths(bro.actor.trunk) == (256, 1)
    assert isinstance(bro.explorer, OptimisticShift)
    assert widths(bro.explorer.trunk) == (256, 1)
    assert bro.critic(torch.zeros(4, 5), torch.zeros(4, N_ACTIONS)).shape == (2, 4, 100)
    norms = [m for m in bro.policy.modules() if isinstance(m, (nn.LayerNorm, EnsembleLayerNorm))]
    assert norms and {m.eps for m in norms} == {1e-6}
    # The optimistic actor sees the observation and the mean.
    assert bro.explorer.trunk.dense.in_features == 5 + N_ACTIONS


def test_log_std_interval(bro: BRO) -> None:
    with torch.no_grad():
        for sign, bound in ((-1, -10.0), (1, 2.0)):
            bias = bro.actor.log_std.bias.clone()
            bro.actor.log_std.bias.fill_(sign * 100.0)
            log_std = bro.actor.gaussian(torch.zeros(1, 5))[1]
            bro.actor.log_std.bias.copy_(bias)
            torch.testing.assert_close(log_std, torch.full((1, N_ACTIONS), bound))


def test_pessimism_and_optimism(bro: BRO) -> None:
    assert bro.pessimism_rule.beta() == 0
    exploration = bro.explorer
    assert isinstance(exploration, OptimisticShift)
    assert exploration.kl_target == 0.05
    assert exploration.std_multiplier == 0.75
    assert exploration.optimism().item() == pytest.approx(1.0, rel=1e-5)
    assert exploration.kl_weight().item() == pytest.approx(0.25, rel=1e-5)
    for scalar in (exploration.optimism, exploration.kl_weight):
        value = scalar.raw_value.detach().clone()
        with torch.no_grad():
            for raw, log_value in ((-100.0, -10.0), (100.0, 7.5)):
                scalar.raw_value.fill_(raw)
                assert scalar().log().item() == pytest.approx(log_value, rel=1e-5)
            scalar.raw_value.copy_(value)


def test_optimizers_of_the_networks(bro: BRO) -> None:
    """The same settings for critics and both actors, decay on every parameter, each parameter in one optimizer."""
    assert isinstance(bro.explorer, OptimisticShift)
    shift = [*bro.explorer.trunk.parameters(), *bro.explorer.shift.parameters()]
    for optimizer, parameters in (
        (bro.critic.optimizer, list(bro.critic.parameters())),
        (bro.actor.optimizer, list(bro.actor.parameters())),
        (bro.explorer.actor_optimizer, shift),
    ):
        settings = group(optimizer)
        assert settings["lr"] == 3e-4
        assert settings["weight_decay"] == 1e-4
        assert tuple(settings["betas"]) == (0.9, 0.999)
        assert settings["eps"] == 1e-8
        assert {id(p) for p in settings["params"]} == {id(p) for p in parameters}
        assert all(p.requires_grad for p in parameters)


def test_optimizers_of_the_learned_numbers(bro: BRO) -> None:
    temperature = group(bro.temperature_optimizer)
    assert temperature["lr"] == 3e-4 and tuple(temperature["betas"]) == (0.5, 0.999)
    assert isinstance(bro.explorer, OptimisticShift)
    adjustment = group(bro.explorer.scalar_optimizer)
    assert adjustment["lr"] == 3e-5 and tuple(adjustment["betas"]) == (0.5, 0.999)
    assert temperature["weight_decay"] == adjustment["weight_decay"] == 0


def test_temperature(bro: BRO) -> None:
    assert bro.temperature().item() == 1.0
    assert bro._target_entropy == -N_ACTIONS / 2


def test_initial_targets(bro: BRO) -> None:
    for ours, theirs in zip(bro.critic.parameters(), bro.critic_target.parameters(), strict=True):
        assert torch.equal(ours, theirs) and not theirs.requires_grad
    assert not torch.equal(bro.critic.trunk.dense.weight[0], bro.critic.trunk.dense.weight[1])


def test_sac(sac: SAC) -> None:
    assert sac.replay_ratio == 2
    assert sac.batch_size == 256
    assert sac.gamma == 0.99
    assert sac.tau == 0.005
    assert sac.learning_starts == 10_000
    assert sac.buffer_size == 1_000_000
    assert sac.plasticity.steps == ()
    assert sac.pessimism_rule.beta() == 1
    assert type(sac.explorer) is Exploration
    assert sac.temperature().item() == 1.0
    assert sac._target_entropy == -N_ACTIONS / 2
    assert sac.critic(torch.zeros(4, 5), torch.zeros(4, N_ACTIONS)).shape == (2, 4, 1)
    hidden = [layer.out_features for layer in sac.actor.trunk.layers if isinstance(layer, nn.Linear)]
    assert hidden == [256, 256]
    assert sum(isinstance(layer, nn.ReLU) for layer in sac.actor.trunk.layers) == 2
    assert [p.shape[-1] for name, p in sac.critic.trunk.named_parameters() if name.endswith("weight")] == [256, 256]
    for optimizer in (sac.actor.optimizer, sac.critic.optimizer, sac.temperature_optimizer):
        settings = group(optimizer)
        assert settings["lr"] == 3e-4 and settings["weight_decay"] == 0
        assert tuple(settings["betas"]) == (0.9, 0.999)
